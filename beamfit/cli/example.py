"""`beamfit example`: files to begin with."""

from __future__ import annotations

import shlex
from importlib.resources import files
from os import PathLike
from pathlib import Path

import click

from beamfit.errors import InputError
from beamfit.writing import write_atomically

EXAMPLE_FILES = ("scan.csv", "lattice.toml", "decay.csv")
EXAMPLE = """\b
Examples:
  beamfit example first
"""


@click.command(epilog=EXAMPLE)
@click.argument("folder", metavar="DIR")
def example(folder: str) -> None:
    """Write a scan, its lattice and a decay record into DIR, to begin with.

    The files are small, commented and SIMULATED; what is already in DIR is not overwritten.
    """
    scan, lattice, decay = (shlex.quote(str(path)) for path in write_example(folder))
    click.echo(f"Written: {scan}, {lattice}, {decay} (simulated). Now run")
    click.echo(f"  beamfit check {scan} {lattice} {decay}")
    click.echo(f"  beamfit emittance {scan} --lattice {lattice}")
    click.echo(f"  beamfit lifetime {decay}")


def write_example(folder: str | PathLike[str]) -> tuple[Path, ...]:
    """Write the example files into a folder, which is created if necessary.

    Parameters
    ----------
    folder : str or path
        Target folder.

    Returns
    -------
    tuple of Path
        The scan, its lattice, and a decay record; all SIMULATED.

    Raises
    ------
    InputError
        If one of the files exists (then nothing is written), or the folder cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> [path.name for path in write_example(tempfile.mkdtemp())]
    ['scan.csv', 'lattice.toml', 'decay.csv']
    """
    targets = tuple(Path(folder) / name for name in EXAMPLE_FILES)
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
        there = [path for path in targets if path.exists() or path.is_symlink()]
    except (OSError, ValueError) as error:  # a name with a zero byte is a ValueError
        cause = getattr(error, "strerror", None) or error
        found = f"a place where no folder can be ({cause})"
        raise InputError(found, "a folder to write into", path=folder) from None
    if there:
        found = "a file that is there already and is not overwritten"
        raise InputError(found, "a folder without it, such as a new one", path=there[0])
    for path in targets:
        write_atomically(path, (files("beamfit") / "example" / path.name).read_bytes())
    return targets
