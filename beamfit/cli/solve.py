"""`beamfit solve`: a formulation as text in, its solution explained."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from beamfit.cli.options import command_line, options
from beamfit.errors import InputError
from beamfit.io.files import digest

if TYPE_CHECKING:
    from beamfit.language.solution import Solution

EXAMPLE = """\b
Examples:
  beamfit solve formulations/appendix_d.bf
  beamfit solve formulations/appendix_a.xml --data d=formulations/fitdata_simulated.csv --start 20
  beamfit solve model.nl --start 20 --json
"""


@click.command(epilog=EXAMPLE)
@click.argument("document")
@click.option(
    "--data",
    multiple=True,
    metavar="NAME=FILE",
    help="File of a data table; the document's own, beside it, unless given.",
)
@click.option(
    "--start",
    default="seeds",
    show_default=True,
    metavar="seeds|N",
    help="One search from the document's seeds, or N: from there and from random numbers.",
)
@options("report json")
def solve(
    document: str, data: tuple[str, ...], start: str, report: str | None, as_json: bool
) -> None:
    """Solve a formulation: a constrained problem as text (.bf), the report's XML, or AMPL's .nl.

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
    if report is not None:
        from beamfit.report.page import write_report  # matplotlib from here on

        write_report(report, found, command=command_line(), inputs=inputs)
    if as_json:
        from beamfit.io.result import results_text

        click.echo(results_text([found], inputs, command_line()))
    else:
        _show(found, report)


def _solved(document: str, given: dict[str, str], starts: int) -> tuple[Solution, tuple[str, ...]]:
    """The solution of a document or a ``.nl`` file, and the files of its data."""
    if document.lower().endswith(".nl"):
        if given:
            raise InputError("--data for a .nl file", "none: it holds its numbers", path=document)
        from beamfit.io.nl import read_nl
        from beamfit.language.solution import solve_problem

        return solve_problem(read_nl(document), starts), ()
    from beamfit.io.formulation import read_formulation, read_tables, solved_formulation

    formulation = read_formulation(document)
    tables, files = read_tables(formulation, document, given)
    return solved_formulation(formulation, document, tables, starts), tuple(files.values())


def _show(found: Solution, report: str | None) -> None:
    from beamfit.cli.show import Terminal

    terminal = Terminal()
    for table in found.tables():
        terminal.table(table)
        terminal.line()
    asked = found.made.document.solver if found.made else None
    terminal.line(f"Solver: {found.solver}" + (f" (asked for: {asked.name})" if asked else ""))
    for note in found.notes:
        terminal.line(note)
    terminal.verdict(found.headline, found.status, found.message)
    terminal.report(report)
