"""`beamfit identify`: responses with verdicts, from records of runs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

import beamfit
from beamfit.cli.options import Command, Output, option, options
from beamfit.commands import check_model
from beamfit.errors import InputError
from beamfit.io.files import digest
from beamfit.io.run import read_run

if TYPE_CHECKING:
    from beamfit.answer import Table
    from beamfit.cli.show import Terminal
    from beamfit.dynamics.fedbatch import FedBatchFit
    from beamfit.dynamics.fit import ResponseFit
    from beamfit.dynamics.state_fit import StatesFit


# Longest table shown whole without --full; of longer ones three rows are shown.
MAX_ROWS_BRIEF = 4
EXAMPLE = """\b
Examples:
  beamfit identify run.csv --model first-order
  beamfit identify monday.csv tuesday.csv --model second-order --map network --report process.html
  beamfit identify log.csv --input Valve --output Level --step 4 --hold-back friday.csv --json
  beamfit identify tanks.csv --model state-space --order 3 --map network
  beamfit identify batch_1.csv batch_2.csv --model fed-batch --map network
"""


@click.command(cls=Command, epilog=EXAMPLE)
@click.argument("record", nargs=-1, required=True)
@options("model order map input output step delay no-offset")
@option("--hold-back RECORD", "A run that is only predicted.", multiple=True)
@options("hidden columns ignore skip-bad seed report full json")
def identify(
    record: tuple[str, ...],
    model: str,
    order: int | None,
    map: str,
    delay: float | None,
    no_offset: bool,
    hidden: int,
    hold_back: tuple[str, ...],
    seed: int,
    output: Output,
    **reading: Any,
) -> None:
    """Identify how the outputs of a process respond to its inputs.

    RECORD is a CSV or HDF5 file with time_s, inputs u_… that are held from row to row, and outputs
    y_…; several runs are identified together. Each output gets its parameters with errors (as
    curves of the operating point with --map network), tests of the residuals, and a verdict. A
    state space is one model of all outputs, with time constants and gains; a fed-batch process has
    the rates of its balances.
    """
    settings = {"order": order, "delay": delay, "offset": not no_offset}
    check_model(model, map, **settings)
    twice = [path for path in record if (*record, *hold_back).count(path) > 1]
    if twice:
        raise InputError("a run given twice", "each run once", path=twice[0])
    runs = [read_run(path, **reading) for path in record]
    held = [read_run(path, **reading) for path in hold_back]
    settings |= {"hidden": hidden, "seed": seed, "held": held}
    fits = beamfit.identify(runs, model, map, **settings)  # JAX from here on
    digests = {path: digest(path) for path in (*record, *hold_back)}
    output.write(fits, digests)
    output.answer(fits, digests, lambda terminal: _show(terminal, fits))


def _show(terminal: Terminal, fits: tuple[ResponseFit | StatesFit | FedBatchFit, ...]) -> None:
    for run in fits[0].runs:
        terminal.line(run.headline, style="bold")
        for note in run.notes:
            terminal.line(f"Note: {note}")
    for fit in fits:
        terminal.answer(fit.headline, fit.status, fit.message)
        terminal.line()
        numbers, *curves = fit.tables()
        terminal.tables([numbers, *(curves if terminal.full else map(_ends, curves))])
    terminal.rest()


def _ends(curve: Table) -> Table:
    """Keep the first, middle and last row of a long table."""
    rows = curve.rows
    few = [rows[0], rows[len(rows) // 2], rows[-1]] if len(rows) > MAX_ROWS_BRIEF else rows
    return curve._replace(rows=few)
