"""`beamfit tune`: the knob setting of the lowest emittance, from sizes at settings of knobs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from beamfit.cli.options import Command, Output, option, options
from beamfit.errors import InputError
from beamfit.io.line import build_line, lattice_of
from beamfit.io.priors import read_noise
from beamfit.io.scan import read_tuning_scan
from beamfit.tuning.knobs import GOALS, EmittanceTable, knobs_of, planes_of

if TYPE_CHECKING:
    from beamfit.cli.show import Terminal
    from beamfit.tuning.fit import TuningFit

EXAMPLE = """\b
Examples:
  beamfit tune measurements/gun_tuning_simulated.csv --lattice lattices/gun_tuning.toml \\
    --vary SOL=190:210 --vary phase_deg=-12:12
  beamfit tune table.csv --lattice line.toml --vary SOL=190:210 --goal emittance_x --json
"""


@click.command(cls=Command, epilog=EXAMPLE)
@click.argument("table")
@options("columns ignore skip-bad maybe-lattice use from to screen energy particle vary")
@option("--goal", "Quantity to minimise; emittance is the mean of x and y.", choices=GOALS,
        default=GOALS[0])  # fmt: skip
@options("close noise seed report json")
def tune(
    table: str,
    limits: dict[str, tuple[float, float]],
    goal: str,
    close: float,
    noise: str | None,
    seed: int,
    output: Output,
    columns: Any,
    ignore: tuple[str, ...],
    skip_bad: bool,
    **part: Any,
) -> None:
    """Find the knob setting with the lowest emittance, and the next row to measure.

    TABLE is a scan with columns of knobs in addition to quadrupoles and sizes: Q2_A, SOL_A,
    phase_deg, size_x_um, ... Rows may be in any order; no knob setting needs a whole scan. Or it
    has finished emittances, emittance_x_um and emittance_x_error_um: these need no lattice.
    """
    if not limits:
        raise InputError("no --vary", "NAME=LOW:HIGH such as SOL=190:210")
    scan = read_tuning_scan(table, limits, columns=columns, ignore=ignore, skip_bad=skip_bad)
    knobs_of(scan, limits)
    planes_of(scan, goal)
    own, line, inputs = None if noise is None else read_noise(noise), None, [scan]
    if isinstance(scan, EmittanceTable):
        if given := [name for name, value in part.items() if value]:
            expected = "none of it: they need no optics"
            raise scan.unusable(f"--{given[0]} beside finished emittances", expected)
    else:
        described = lattice_of(scan.without_settings(limits), part.pop("lattice"), **part)
        inputs.append(described)
        line = build_line(described) if scan.transfer is None else None  # JAX from here on

    from beamfit.tuning.fit import fit_tuning

    fit = fit_tuning(scan, line, limits, goal=goal, within=close, noise=own, seed=seed)
    inputs = {str(each.path): each.sha256 for each in inputs}
    output.write(fit, inputs)
    output.answer([fit], inputs, lambda terminal: show_tuning(terminal, fit))


def show_tuning(terminal: Terminal, fit: TuningFit) -> None:
    """Show the verdict, the best setting and the next row."""
    terminal.result(fit)
    terminal.line()
    terminal.line(fit.next_words)
