"""`beamfit control`: records of runs and wishes in, a controller in a simulated loop out."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import TYPE_CHECKING

import click

from beamfit.cli.options import command_line, options
from beamfit.errors import InputError, nearest
from beamfit.io.files import digest
from beamfit.studies.scan.typed import gains_of

if TYPE_CHECKING:
    from beamfit.studies.response.loop import Loop


EXAMPLE = """\b
Examples:
  beamfit control run.csv --set level=2.5 --limit valve=0:3 --rate valve=0.2
  beamfit control run.csv --map network --set level=12 --set level=14@60 --limit level=:15 \\
    --disturb level=-1@90 --report loop.html
"""
WISH = "OUTPUT=VALUE or OUTPUT=VALUE@SECONDS such as level=2.5@60"
LIMIT = "NAME=LOW:HIGH, one of them may be left out, such as level=:3"


@click.command(epilog=EXAMPLE)
@click.argument("record", nargs=-1, required=True)
@options("model map input output step delay no-offset gain")
@click.option(
    "--set",
    "wishes",
    multiple=True,
    required=True,
    metavar="OUTPUT=VALUE[@SECONDS]",
    help="What an output shall be, from a time on.",
)
@click.option(
    "--limit",
    multiple=True,
    metavar="NAME=LOW:HIGH",
    help="Of an input, the range of the runs unless said, or of an output.",
)
@click.option(
    "--rate",
    multiple=True,
    metavar="INPUT=PER_SECOND",
    help="Largest change of an input in a second.",
)
@click.option(
    "--disturb",
    multiple=True,
    metavar="OUTPUT=VALUE[@SECONDS]",
    help="Added to an output in the simulation, from a time on.",
)
@click.option(
    "--hard",
    multiple=True,
    metavar="OUTPUT=SHARE:LOAD",
    help="Keep an output's limits for certain: with gains off by a share, such as 0.2, and with "
    "disturbances up to a size.",
)
@click.option("--horizon", type=click.IntRange(2), metavar="STEPS", help="Of a plan.")
@click.option(
    "--every",
    type=click.IntRange(1),
    metavar="SAMPLES",
    help="Of the runs to a step of the controller.",
)
@click.option(
    "--smooth",
    type=float,
    default=0.1,
    show_default=True,
    help="Cost of input changes against errors.",
)
@click.option("--for", "duration", type=float, metavar="SECONDS", help="Time simulated.")
@options("hidden ignore skip-bad seed report json")
def control(
    record: tuple[str, ...],
    model: str,
    map: str,
    inputs: tuple[str, ...],
    outputs: tuple[str, ...],
    step: float | None,
    delay: int | None,
    no_offset: bool,
    gains: dict[str, tuple[float, float]],
    wishes: tuple[str, ...],
    limit: tuple[str, ...],
    rate: tuple[str, ...],
    disturb: tuple[str, ...],
    hard: tuple[str, ...],
    horizon: int | None,
    every: int | None,
    smooth: float,
    duration: float | None,
    hidden: int,
    ignore: tuple[str, ...],
    skip_bad: bool,
    seed: int,
    report: str | None,
    as_json: bool,
) -> None:
    """Control a process: identify it, plan its inputs within limits, and simulate the loop.

    RECORD is a run as `beamfit identify` reads it. The loop runs on the fitted model with the noise
    of its residuals. Inputs and their rates keep their limits always, outputs wherever any inputs
    can keep them; what cannot be kept is named.
    """
    from beamfit.io.run import read_run  # numpy

    targets, loads = _steps(wishes, "set"), _steps(disturb, "disturb")
    limits, rates = gains_of(limit, "limit", LIMIT), _rates(rate)
    said = {"inputs": inputs, "outputs": outputs, "step": step}
    runs = [read_run(path, **said, ignore=ignore, skip_bad=skip_bad) for path in record]
    _check("limit", limits, [*runs[0].inputs, *runs[0].outputs])
    _check("rate", rates, list(runs[0].inputs))
    _check("set", [t[0] for t in targets], list(runs[0].outputs))
    _check("disturb", [t[0] for t in loads], list(runs[0].outputs))

    from beamfit.studies.response.control import controller  # JAX from here on
    from beamfit.studies.response.fit import identify
    from beamfit.studies.response.loop import simulate_loop

    settings = {"delay": delay, "offset": not no_offset, "hidden": hidden, "seed": seed}
    settings |= {"gains": gains}
    wished = [name for name in runs[0].outputs if name in {t[0] for t in targets} | set(limits)]
    fits = [identify(runs, model, map, output=name, **settings)
            for name in wished or runs[0].outputs]  # fmt: skip
    made = controller(
        fits,
        inputs={n: v for n, v in limits.items() if n in runs[0].inputs},
        rates=rates,
        outputs={n: v for n, v in limits.items() if n in runs[0].outputs},
        hard=gains_of(hard, "hard", "OUTPUT=SHARE:LOAD such as level=0.2:0.5"),
        horizon=horizon,
        every=every,
        smooth=smooth,
    )
    loop = simulate_loop(fits, made, targets, disturbances=loads, duration=duration, seed=seed)
    digests = {path: digest(path) for path in record}
    if report is not None:
        from beamfit.report.page import write_report

        write_report(report, loop, command=command_line(), inputs=digests)
    if as_json:
        from beamfit.io.result import results_text

        click.echo(results_text([loop.to_json()], digests, command_line()))
        return
    _show(loop, report)


def _check(option: str, names: Iterable[str], known: list[str]) -> None:
    for name in names:
        if name not in known:
            raise InputError(f"--{option} of '{name}'", nearest(name, known))


def _steps(texts: tuple[str, ...], option: str) -> list[tuple[str, float, float]]:
    """Read OUTPUT=VALUE@SECONDS."""
    found = []
    for text in texts:
        name, _, rest = text.partition("=")
        value, _, at = rest.partition("@")
        try:
            found.append((name.strip(), float(value), float(at or 0.0)))
        except ValueError:
            raise InputError(f"--{option} '{text}'", WISH) from None
    return found


def _rates(texts: tuple[str, ...]) -> dict[str, float]:
    found = {}
    for text in texts:
        if not (match := re.fullmatch(r"\s*([^=]+?)\s*=\s*([-+.\deE]+)\s*", text)):
            raise InputError(f"--rate '{text}'", "INPUT=PER_SECOND such as valve=0.2")
        found[match[1]] = float(match[2])
    return found


def _show(loop: Loop, report: str | None) -> None:
    from beamfit.cli.show import Terminal

    terminal = Terminal()
    for fit in loop.fits:
        terminal.line(fit.headline, style="bold")
    c = loop.control
    terminal.line(f"A step of {c.step:.4g} s, plans of {c.horizon} steps; SIMULATED loop of "
                  f"{len(loop.time)} steps")  # fmt: skip
    terminal.answer(loop.headline, loop.status, loop.message)
    for table in loop.tables():
        terminal.line()
        terminal.table(table)
    terminal.report(report)
