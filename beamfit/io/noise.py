"""A laboratory's own priors on the noise of beam sizes, as a TOML file."""

from __future__ import annotations

from os import PathLike
from typing import TYPE_CHECKING, Any

from beamfit.errors import InputError
from beamfit.io.toml import LIST, NUMBER, TEXT, Key, is_number, read_toml
from beamfit.noise.model import Noise
from beamfit.writing import write_atomically

if TYPE_CHECKING:
    from beamfit.noise.learn import Learned

FORMAT = "beamfit-noise-1"
# Key of the file: its unit and meaning, and whether it is a list of middle and spread.
PAIRS = ("factor", "unstated", "scatter")
SINGLE = ("right", "share", "even", "bad", "width", "bad_shot")


def read_noise(path: str | PathLike[str]) -> Noise:
    """Read priors on the noise of beam sizes.

    Parameters
    ----------
    path : str or path
        A TOML file with any of the fields of `beamfit.Noise`; ``factor``, ``unstated`` and
        ``scatter`` are lists of the middle and the standard deviation of the logarithm.

    Returns
    -------
    Noise
        beamfit's own where the file is silent.

    Raises
    ------
    InputError
        Naming file, line and key.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> file = pathlib.Path(tempfile.mkdtemp()) / "noise.toml"
    >>> _ = file.write_text('scatter = [0.03, 0.5]\\nsource = "our OTR screens, 2026"\\n')
    >>> read_noise(file).scatter.middle
    0.03
    """
    top = read_toml(path, "priors of noise", FORMAT, needed=False)
    schema = {name: Key(default=None, kind=NUMBER) for name in SINGLE}
    schema |= {name: Key(default=None, kind=LIST) for name in PAIRS}
    top.values(schema | {"source": Key(default=str(path), kind=TEXT)})
    told: dict[str, Any] = {"source": top.table.get("source", str(path))}
    for name in (*SINGLE, *PAIRS):
        if name not in top.table:
            continue
        value = top.table[name]
        if name in PAIRS and not (len(value) == 2 and all(map(is_number, value))):
            expected = "two numbers: the middle and the standard deviation of the logarithm"
            raise top.error(f"{name} = {value}", expected, name)
        told[name] = value
        try:
            Noise(**{name: value})
        except InputError as error:
            raise top.error(error.found, error.expected, name) from None
    return Noise(**told)


def write_noise(path: str | PathLike[str], learned: Learned) -> None:
    """Write learned priors, with their errors as comments.

    Parameters
    ----------
    path : str or path
        Where to; an existing file is replaced whole.
    learned : Learned
        From `beamfit.noise.learn.learn_noise`.
    """
    lines = [
        f'format = "{FORMAT}"',
        f'source = "{learned.noise.source}"',
        "# What was learned, with standard errors; the rest is beamfit's own.",
    ]
    for name in (*SINGLE, *PAIRS):
        value = getattr(learned.noise, name)
        text = f"[{value[0]:.4g}, {value[1]:.4g}]" if name in PAIRS else f"{value:.4g}"
        said = f"  # {learned.errors[name]}" if name in learned.errors else ""
        lines.append(f"{name} = {text}{said}")
    write_atomically(path, ("\n".join(lines) + "\n").encode())
