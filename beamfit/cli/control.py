"""`beamfit control`: a controller from records of runs, in a simulated loop."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

import beamfit
from beamfit.cli.option_text import gains_of, named_of
from beamfit.cli.options import Command, Output, option, options
from beamfit.dynamics.control_checks import check_limits, check_rates, check_steps, check_targets
from beamfit.errors import InputError
from beamfit.io.files import digest
from beamfit.io.run import read_run

if TYPE_CHECKING:
    from beamfit.cli.show import Terminal
    from beamfit.dynamics.control import Loop


EXAMPLE = """\b
Examples:
  beamfit control run.csv --set level=2.5 --limit valve=0:3 --rate valve=0.2
  beamfit control run.csv --map network --set level=12 --set level=14@60 --limit level=:15 \\
    --disturb level=-1@90 --report loop.html
"""
READING = ("columns", "inputs", "outputs", "step", "ignore", "skip_bad")
TARGET = "OUTPUT=VALUE or OUTPUT=VALUE@SECONDS such as level=2.5@60"
RATE = "INPUT=PER_SECOND such as valve=0.2"
LIMIT = "NAME=LOW:HIGH, one of them may be left out, such as level=:3"


@click.command(cls=Command, epilog=EXAMPLE)
@click.argument("record", nargs=-1, required=True)
@options("model map input output step delay no-offset")
@option(
    "--set OUTPUT=VALUE[@SECONDS]",
    "Target of an output, from a time on.",
    name="targets",
    multiple=True,
    required=True,
)
@option(
    "--limit NAME=LOW:HIGH",
    "Limits of an input (default: the range of the runs) or of an output.",
    multiple=True,
)
@option("--rate INPUT=PER_SECOND", "Largest change of an input in a second.", multiple=True)
@option(
    "--disturb OUTPUT=VALUE[@SECONDS]",
    "Added to an output in the simulation, from a time on.",
    multiple=True,
)
@option("--horizon STEPS", "Number of steps of a plan.", type=click.IntRange(2))
@option("--every SAMPLES", "Samples of the runs per control step.", type=click.IntRange(1))
@option(
    "--smooth",
    "Cost of input changes against errors.",
    type=click.FloatRange(0.0, min_open=True),
    default=0.1,
)
@option("--for SECONDS", "Simulated time.", name="duration", type=float)
@options("hidden columns ignore skip-bad seed report json")
def control(
    record: tuple[str, ...],
    no_offset: bool,
    targets: tuple[str, ...],
    limit: tuple[str, ...],
    rate: tuple[str, ...],
    disturb: tuple[str, ...],
    output: Output,
    **arguments: Any,
) -> None:
    """Control a process: identify it, plan its inputs within limits, and simulate the loop.

    RECORD is a run in the format of `beamfit identify`. The loop is simulated with the fitted model
    and the noise of its residuals. Inputs and their rates always keep their limits, outputs if any
    inputs can achieve that; limits that cannot be kept are named.
    """
    targets, loads = _steps(targets, "set"), _steps(disturb, "disturb")
    limits = gains_of(limit, "limit", LIMIT)
    rates = named_of(rate, "rate", RATE, float)
    # Before the runs are identified, which takes long.
    check_limits(limits)
    check_rates(rates)
    for steps in (targets, loads):
        check_steps(steps)
    check_targets(targets, limits)
    arguments |= {"limits": limits, "rates": rates}
    reading = {n: arguments.pop(n) for n in READING}
    runs = [read_run(path, **reading) for path in record]
    arguments |= {"offset": not no_offset, "disturbances": loads}
    loop = beamfit.control(runs, targets, **arguments)  # JAX from here on
    digests = {path: digest(path) for path in record}
    output.write(loop, digests)
    output.answer([loop], digests, lambda terminal: _show(terminal, loop))


def _steps(texts: tuple[str, ...], option: str) -> list[tuple[str, float, float]]:
    """Read OUTPUT=VALUE@SECONDS."""
    found = []
    for text in texts:
        name, _, rest = text.partition("=")
        value, _, at = rest.partition("@")
        try:
            found.append((name.strip(), float(value), float(at or 0.0)))
        except ValueError:
            raise InputError(f"--{option} '{text}'", TARGET) from None
    return found


def _show(terminal: Terminal, loop: Loop) -> None:
    for fit in loop.fits:
        terminal.line(fit.headline, style="bold")
    c = loop.control
    terminal.line(f"A step of {c.step:.4g} s, plans of {c.horizon} steps; SIMULATED loop of "
                  f"{len(loop.time)} steps")  # fmt: skip
    terminal.answer(loop.headline, loop.status, loop.message)
    for table in loop.tables():
        terminal.line()
        terminal.table(table)
