"""`beamfit scan`: measure a scan on a running machine, fit the emittance, restore the magnets."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

import click

import beamfit
from beamfit.answer import cell
from beamfit.cli.options import Command, Output, command_line, option, options
from beamfit.errors import InputError, Status, plain
from beamfit.io.files import digest
from beamfit.io.line import build_line, read_inputs
from beamfit.io.machine import ScanMachine, read_scan_machine
from beamfit.io.result import results_text

if TYPE_CHECKING:
    from beamfit.emittance.fit import EmittanceFit
    from beamfit.live.scan import Outcome, ScanProgress
    from beamfit.tuning.fit import TuningFit

EXAMPLE = """\b
Examples:
  beamfit scan machine.toml --dry-run
  beamfit scan machine.toml --goal 3% --save scan.csv --report scan.html
  beamfit scan --recover machine.journal
"""


@click.command(cls=Command, epilog=EXAMPLE)
@click.argument("machine", required=False)
@option("--dry-run", "Check the machine, print the plan, move nothing.", is_flag=True)
@option("--recover JOURNAL", "Restore the magnets after a killed scan, and move nothing else.")
@option("--save FILE.csv", "File of the scan; default: NAME_DATE_TIME.csv.")
@option("--journal FILE", "File with the settings to restore; default: next to MACHINE.")
@options("goal")
@option("--points", "Largest number of settings.", type=click.IntRange(4, 200))
@options("report json")
def scan(
    machine: str | None,
    dry_run: bool,
    recover: str | None,
    save: str | None,
    journal: str | None,
    goal: float | None,
    points: int | None,
    output: Output,
) -> int:
    """Scan the quadrupoles of a machine, choosing the most informative settings, and fit.

    MACHINE is a TOML file (docs/live.md) that names the variables of the magnets and the screen,
    and their limits. If it has knobs, the setting of the lowest emittance is searched. The magnets
    are restored in every case. Needs beamfit[live].
    """
    if (machine is None) == (recover is None):
        raise InputError("both or neither of MACHINE and --recover", "one of them")
    say = _ProgressLines(err=output.as_json)
    if recover is not None:
        if dry_run or save or journal or goal or points or output.report:
            raise InputError("--recover with an option of a scan", "--recover JOURNAL alone")
        return _recover(recover, say, output.as_json)
    given = {"goal": goal, "points": points}
    plan = replace(read_scan_machine(machine), **{k: v for k, v in given.items() if v})

    from beamfit.live.channel import run
    from beamfit.live.restore import journal_of

    if dry_run:
        return run(_show_plan(plan, journal_of(plan, journal), output.as_json))
    target = Path(save or time.strftime(f"{_file_name(plan.name)}_%Y%m%d_%H%M%S.csv"))
    found = beamfit.scan_machine(plan, target, journal=journal, tell=say.progress, note=say)
    return _answer(found, plan, target, output)


class _ProgressLines:
    """Progress of a scan: a line for each point, with normalised emittances."""

    def __init__(self, err: bool) -> None:
        self.err = err

    def __call__(self, text: str) -> None:
        for err in dict.fromkeys((self.err, True)):
            with suppress(OSError):  # a closed output does not end a scan
                click.echo(plain(text), err=err)
                return
            self.err = True

    def progress(self, now: ScanProgress) -> None:
        """Print a new point with the present result, or another event."""
        from beamfit.live.aims import MIN_POINTS

        if not now.measured:
            self(now.news)
            return
        count, fit = len(now.points), now.fit
        last = now.points[-1]
        at = ", ".join(f"{name} {value:.4g}" for name, value in last.settings.items())
        sizes = ", ".join(f"{p} {1e6 * median(s):.1f} um" for p, s in last.shots.items())
        result = ", ".join(_result_words(fit)) if fit and count >= MIN_POINTS else ""
        self(f"{count:3d}  {at:<12}  {sizes:<26}  {result}".rstrip())


def _result_words(fit: EmittanceFit | TuningFit) -> Iterator[str]:
    """Describe the emittance of each plane, or the best setting, in a few words."""
    from beamfit.emittance.fit import EmittanceFit

    if not isinstance(fit, EmittanceFit):
        yield fit.headline
        return
    for plane in fit.planes:
        if plane.emittance.error is None:
            yield f"{plane.plane}: open"
        else:
            sure = "" if plane.status is Status.converged else f" ({cell(plane.status)})"
            yield f"{plane.plane}: {plane.normalized_emittance}{sure}"


async def _show_plan(machine: ScanMachine, journal: Path, as_json: bool) -> int:
    """Check that the machine answers, and print the plan of the scan."""
    from beamfit.live.aims import first_settings
    from beamfit.live.devices import connect
    from beamfit.live.restore import settings_words

    at = await connect(machine)
    before = [(m, await at.magnets[m.name].get()) for m in at.machine.magnets]
    first = first_settings(at.machine)
    plan = {
        "magnets": [
            {"name": m.name, "set": m.set, "read": m.read, "unit": m.unit, "low": m.low,
             "high": m.high, "now": value, "approach": m.approach, "degauss": m.degauss}
            for m, value in before
        ],
        "screen": machine.screen.name,
        "shots": machine.screen.shots,
        "first": first,
        "goal": machine.goal,
        "points": machine.points,
        "journal": str(journal),
        "amiss": await at.guard.amiss(),
        "notes": at.notes,
    }  # fmt: skip
    if as_json:
        click.echo(results_text([{"plan": plan}], _inputs(machine), command_line()))
        return 0
    for m, value in before:
        click.echo(
            f"{m.name}: {m.set} from {m.low:g} to {m.high:g} {m.unit}, read back by {m.read}, "
            f"within {m.tolerance:g} for {m.settle:g} s; now {value:.6g}"
        )
    values, goal = ", ".join(f"{value:.4g}" for value in first), f"{100 * machine.goal:.3g} %"
    begin = f"{machine.magnets[0].name} at {values}"
    until = f"the emittances are known to {goal}"
    if machine.knobs:
        begin = f"rows spread over the limits of {', '.join(m.name for m in machine.magnets)}"
        until = f"the best setting of {', '.join(machine.knobs)} is within {goal} of the minimum"
    click.echo(f"First {begin}; then the most informative settings.")
    click.echo(
        f"{machine.screen.shots} shots on {machine.screen.name} at each, at most {machine.points} "
        f"settings, or until {until}."
    )
    click.echo(f"Restored at the end: {settings_words(before)}. Until then it is in {journal}.")
    for line in (*at.notes, *([f"Now: {plan['amiss']}."] if plan["amiss"] else [])):
        click.echo(plain(line))
    click.echo("Nothing was moved.")
    return 0


def _answer(found: Outcome, machine: ScanMachine, out: Path, output: Output) -> int:
    """Print the answer of `beamfit emittance` for the file, and how the scan ended."""
    from beamfit.cli.emittance import results_of, show
    from beamfit.cli.tune import show_tuning

    if found.problem is not None:
        if not isinstance(found.problem, InputError):
            raise found.problem
        kept = f"; {len(found.points)} points are in {out}" if found.points and out.exists() else ""
        raise replace(found.problem, found=f"{found.problem.found}{kept}; all is restored")
    said = {
        "file": str(out),
        "points": len(found.points),
        "ended": found.reason,
        "doubt": found.doubt,
        "restored": True,
    }
    inputs = _inputs(machine) | ({str(out): digest(out)} if found.points else {})
    if found.fit is None:
        few = f"The scan ended: {found.reason}; too few points for a fit."
        few += f" It is in {out}." if found.points else ""
        output._replace(report=None).answer([], inputs, lambda terminal: click.echo(few), scan=said)
    else:
        if machine.knobs:
            results, shown, fit = [found.fit], partial(show_tuning, fit=found.fit), found.fit
        else:
            measured, described, _ = read_inputs(str(out), machine.lattice)
            fit = beamfit.fit_emittance(measured, build_line(described))
            results, shown = results_of(fit), partial(show, fit=fit)
        output.write(fit, inputs)
        if not output.as_json:
            click.echo(
                f"The scan ended: {found.reason}. It is in {out}. {found.doubt}".rstrip() + "\n"
            )
        output.answer(results, inputs, shown, scan=said)
    return 128 + found.signal if found.signal else 0


def _recover(journal: str, say: _ProgressLines, as_json: bool) -> int:
    """Restore the magnets of a journal."""
    from beamfit.live.channel import run
    from beamfit.live.devices import supply_of
    from beamfit.live.restore import alone_with, read_journal, restore, settings_words

    left = read_journal(journal)
    found = digest(journal)
    magnets = [m for m, _ in left.before]

    async def back() -> None:
        supplies = {m.name: supply_of(m, left.timeout) for m in magnets}
        await restore(left, supplies)

    with alone_with(Path(journal), magnets):
        run(back())
    if as_json:
        settings = {m.name: {"value": v, "unit": m.unit} for m, v in left.before}
        click.echo(results_text([{"restored": settings}], {journal: found}, command_line()))
    else:
        say(f"Restored and read back: {settings_words(left.before)}. {journal} is removed.")
    return 0


def _inputs(machine: ScanMachine) -> dict[str, str | None]:
    return {machine.path: machine.sha256, str(machine.lattice.path): machine.lattice.sha256}


def _file_name(name: str) -> str:
    """Make a name valid as a file name."""
    return "".join(c if c.isalnum() else "_" for c in name)[:40]
