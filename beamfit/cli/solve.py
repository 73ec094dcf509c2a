"""`beamfit solve`: solve a formulation given as text."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Any

import click

import beamfit
from beamfit.cli.option_text import named_of
from beamfit.cli.options import Command, Output, option, options
from beamfit.errors import InputError, located
from beamfit.io.files import digest

if TYPE_CHECKING:
    from beamfit.cli.show import Terminal
    from beamfit.language.compiled import Computed
    from beamfit.language.solution import ProblemSolution

EXAMPLE = """\b
Examples:
  beamfit solve formulations/appendix_d.bf
  beamfit solve formulations/appendix_a.xml --data d=formulations/fitdata_simulated.csv --start 20
  beamfit solve formulations/figure_3.xml --set x1=0.5 --set x2=2 --set x3=1 --set x4=1 \\
      --derivative dy5/dx4
"""
# Names of `beamfit.greybox.solve.solve`, repeated here so that help does not import JAX.
SOLVERS = ["levenberg-marquardt", "filtersqp", "ipopt", "slsqp"]
COUNT = re.compile(r"[1-9]\d{0,5}")


@click.command(cls=Command, epilog=EXAMPLE)
@click.argument("document")
@option(
    "--data NAME=FILE",
    "File of a data table; default: the file named in the document, next to it.",
    multiple=True,
)
@option(
    "--set NAME=NUMBERS",
    "Value of an input: one number, or a whole array with commas, row by row. For a variable it is "
    "the start of the search.",
    "values",
    multiple=True,
)
@option(
    "--derivative dY/dX",
    "A gain to print: the derivative of an output with respect to an input.",
    "derivatives",
    multiple=True,
)
@option(
    "--start seeds|N",
    "One search from the seeds of the document, or N: further ones from random points.",
    default="seeds",
)
@option("--solver", "The solver to use; default: all suitable ones in turn.", choices=SOLVERS)
@option("--tolerance X", "Tolerance of limits and of optimality.", type=float)
@option("--within S", "Time limit of the search in seconds, including compilation.", type=float)
@options("report json")
def solve(
    document: str,
    data: tuple[str, ...],
    values: tuple[str, ...],
    derivatives: tuple[str, ...],
    start: str,
    output: Output,
    **arguments: Any,
) -> None:
    """Solve a formulation: a constrained problem as text (.bf) or the report's XML.

    Variables have bounds, states and reduced gradients, constraints have multipliers; there are
    errors if the objective is a sum of squares. A mapping without an objective is evaluated.
    """
    if start != "seeds" and not COUNT.fullmatch(start):
        raise InputError(f"--start '{start}'", "seeds, or a number of starts from 1 to 999999")
    for name in ("tolerance", "within"):
        if arguments[name] is not None and not 0 < arguments[name] < math.inf:
            raise InputError(f"--{name} {arguments[name]:g}", "a number above 0")
    arguments["seconds"] = arguments.pop("within")
    tables = named_of(data, "data", "NAME=FILE")
    numbers = {
        name: _numbers(name, text) for name, text in named_of(values, "set", "NAME=NUMBER").items()
    }
    starts = 1 if start == "seeds" else int(start)
    from beamfit.io.formulation import read_formulation, read_tables  # scipy

    formulation = read_formulation(document)
    numbers_of, files = read_tables(formulation, document, tables)
    arguments |= {"starts": starts, "values": numbers, "derivatives": derivatives}
    with located(document):
        found = beamfit.solve(formulation, numbers_of, **arguments)
    inputs = {path: digest(path) for path in (document, *files.values())}
    output.write(found, inputs)
    output.answer([found], inputs, lambda terminal: _show(terminal, found))


def _numbers(name: str, text: str) -> list[float]:
    try:
        found = [float(word) for word in text.split(",")]
    except ValueError:
        found = []
    if not found or not all(map(math.isfinite, found)):
        raise InputError(f"--set {name}={text}", "a number, or numbers with commas between them")
    return found


def _show(terminal: Terminal, found: ProblemSolution | Computed) -> None:
    from beamfit.language.solution import ProblemSolution

    if isinstance(found, ProblemSolution):
        terminal.verdict(found.headline, found.status, found.message)
        for note in found.notes:
            terminal.line(note)
        terminal.line()
    terminal.tables(found.tables())
    if isinstance(found, ProblemSolution):
        requested = found.made.document.solver
        said = f"Solver: {found.solver}" + (f" (asked for: {requested.name})" if requested else "")
        terminal.line(said, style="dim")
