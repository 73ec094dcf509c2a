"""`beamfit solve`: a formulation as text in, its solution explained."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from beamfit.cli.options import answered, option, options, reported
from beamfit.errors import InputError
from beamfit.io.files import digest

if TYPE_CHECKING:
    from beamfit.cli.show import Terminal
    from beamfit.language.solution import Solution

EXAMPLE = """\b
Examples:
  beamfit solve formulations/appendix_d.bf
  beamfit solve formulations/appendix_a.xml --data d=formulations/fitdata_simulated.csv --start 20
"""


@click.command(epilog=EXAMPLE)
@click.argument("document")
@option(
    "--data NAME=FILE",
    "File of a data table; the document's own, beside it, unless given.",
    multiple=True,
)
@option(
    "--start seeds|N",
    "One search from the document's seeds, or N: from there and from random numbers.",
    default="seeds",
)
@options("report json")
def solve(
    document: str, data: tuple[str, ...], start: str, report: str | None, as_json: bool
) -> None:
    """Solve a formulation: a constrained problem as text (.bf) or the report's XML.

    Variables come with bounds, states and reduced gradients, constraints with multipliers; errors
    where the objective is a sum of squares.
    """
    starts = 1 if start == "seeds" else int(start) if start.isdigit() and len(start) < 7 else 0
    if starts < 1:
        raise InputError(f"--start '{start}'", "seeds, or a number of starts from 1 to 999999")
    given = {}
    for text in data:
        name, equals, file = text.partition("=")
        if not (name and equals and file) or name in given:
            raise InputError(f"--data '{text}'", "NAME=FILE, each name once")
        given[name.strip()] = file.strip()
    found, files = _solved(document, given, starts)
    inputs = {path: digest(path) for path in (document, *files)}
    reported(report, found, inputs)
    answered(as_json, [found], inputs, lambda terminal: _show(terminal, found), report)


def _solved(document: str, given: dict[str, str], starts: int) -> tuple[Solution, tuple[str, ...]]:
    """The solution of a document, and the files of its data."""
    from beamfit.io.formulation import read_formulation, read_tables, solved_formulation

    formulation = read_formulation(document)
    tables, files = read_tables(formulation, document, given)
    return solved_formulation(formulation, document, tables, starts), tuple(files.values())


def _show(terminal: Terminal, found: Solution) -> None:
    for table in found.tables():
        terminal.table(table)
        terminal.line()
    asked = found.made.document.solver
    terminal.line(f"Solver: {found.solver}" + (f" (asked for: {asked.name})" if asked else ""))
    for note in found.notes:
        terminal.line(note)
    terminal.verdict(found.headline, found.status, found.message)
