"""`beamfit check`: show how files are read, before anything is fitted."""

from __future__ import annotations

import sys
from typing import Any

import click

import beamfit
from beamfit.answer import text_of
from beamfit.cli.options import Command, Output, command_line, options
from beamfit.errors import InputError
from beamfit.io.check import FileSummary, misfit, proposed_layout, with_lattice
from beamfit.io.columns import Layout
from beamfit.io.result import results_text

EXAMPLE = """\b
Examples:
  beamfit check measurements/lcls_otr2.csv lattices/lcls_otr2.toml
  beamfit check fill1.csv fill2.h5 ring.toml --json
"""


@click.command(cls=Command, epilog=EXAMPLE)
@click.argument("files", nargs=-1, required=True, metavar="FILE...")
@options("columns ignore skip-bad use energy json")
def check(files: tuple[str, ...], output: Output, **reading: Any) -> None:
    """Show how scans, lattices, records, rings, runs and formulations are read.

    For each FILE it shows the kind, the rows, the magnets and their units, the range of the sizes
    and the source of their errors, the energy, and anything odd; for a scan also whether each given
    lattice has its magnets and screens. All files are checked. An unusable file, or a scan that
    fits none of the lattices, gives its error line and exit status 2; for unknown columns a layout
    is proposed.
    """
    found: list[FileSummary] = []
    wrong: list[tuple[str, InputError]] = []
    layouts: list[str] = []
    for path in dict.fromkeys(files):
        try:
            found.append(beamfit.check(path, **reading))
        except InputError as error:
            wrong.append((path, error))
            layouts += filter(None, [_propose_layout(path, reading["columns"])])
    lattices = [each for each in found if each.kind == "lattice"]
    found = [_with_lattices(each, lattices) if each.kind == "scan" else each for each in found]
    if output.as_json:
        said: list[Any] = [*found]
        said += [{"file": path, "kind": None, "error": str(error)} for path, error in wrong]
        inputs = {each.path: each.sha256 for each in found}
        click.echo(results_text(said, inputs, command_line()))
    else:
        _show(found)
        for layout in layouts:
            click.echo(f"# Complete and save as layout.toml, for --columns layout.toml\n{layout}\n")
    reasons = [*filter(None, map(misfit, found)), *(str(error) for _, error in wrong)]
    for reason in reasons:
        click.echo(f"beamfit: {reason}", err=True)
    sys.exit(2 if reasons else 0)


def _propose_layout(path: str, columns: Layout | None) -> str | None:
    """Propose a layout for unknown columns; None if the problem is not one of columns."""
    try:
        return proposed_layout(path, columns)
    except InputError:
        return None


def _with_lattices(scan: FileSummary, lattices: list[FileSummary]) -> FileSummary:
    for lattice in lattices:
        scan = with_lattice(scan, lattice)
    return scan


def _show(found: list[FileSummary]) -> None:
    """Print a table for each file, with its notes below."""
    for each in found:
        click.echo("\n".join([text_of(each.table()), *(f"Note: {n}" for n in each.notes), ""]))
