"""`beamfit example`: files to begin with."""

from __future__ import annotations

import shlex

import click

from beamfit.io.example import write_example

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
