"""A scan that chooses its settings: fitted after every point, ended by a goal, restored always."""

from __future__ import annotations

import asyncio
import math
import os
import signal
import time
from collections.abc import Awaitable, Callable, Coroutine, Mapping, Sequence
from contextlib import AsyncExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from beamfit.emittance.fit import EmittanceFit
from beamfit.errors import InputError
from beamfit.io.machine import ScanMachine, check_setting
from beamfit.live.aims import Aim, Next, aim_of
from beamfit.live.devices import Connected, NoSizesError, Shots
from beamfit.live.points import MeasuredPoint
from beamfit.live.restore import (
    Journal,
    alone_with,
    check_none_left,
    ended_by_signals,
    named,
    reach,
    restore,
)
from beamfit.optics.beamline import Beamline
from beamfit.tuning.fit import TuningFit

# Settings in a row at which nothing can be measured, after which a scan ends.
BARREN = 3
# Seconds between two looks at whether the beam is back.
LOOK = 0.2


class ScanProgress(NamedTuple):
    """Progress of a scan: its points, the fit to them where there is one, and what is new.

    ``measured`` says whether that is the last of the points; ``news`` is then why it was chosen.
    """

    points: tuple[MeasuredPoint, ...]
    fit: EmittanceFit | TuningFit | None
    news: str
    measured: bool = False


class Outcome(NamedTuple):
    """End of a scan.

    Attributes
    ----------
    points : tuple of MeasuredPoint
        What was measured.
    fit : EmittanceFit, TuningFit or None
        The fit to them; the latter if the machine has knobs.
    reason : str
        Why it ended.
    problem : Exception or None
        What went wrong, if something did. The magnets are restored all the same.
    signal : int
        Number of the signal that ended it; 0 if none.
    doubt : str
        Why the line may be wrong, in words; "" where the sizes follow it.
    """

    points: tuple[MeasuredPoint, ...]
    fit: EmittanceFit | TuningFit | None
    reason: str
    problem: Exception | None = None
    signal: int = 0
    doubt: str = ""


@dataclass
class Running:
    """State of a scan; the one thing that changes as it goes on."""

    at: Connected
    aim: Aim
    before: Mapping[str, float]
    keep: Callable[[Sequence[MeasuredPoint], Mapping[str, float]], None]
    tell: Callable[[ScanProgress], None]
    ready: Callable[[], Awaitable[None]]
    points: list[MeasuredPoint] = field(default_factory=list)
    barred: list[dict[str, float]] = field(default_factory=list)
    fit: EmittanceFit | TuningFit | None = None
    armed: bool = False

    def say(self, news: str, measured: bool = False) -> None:
        """Tell how it stands."""
        self.tell(ScanProgress(tuple(self.points), self.fit, news, measured))


async def scan(
    at: Connected,
    line: Beamline,
    journal: Path,
    *,
    keep: Callable[[Sequence[MeasuredPoint], Mapping[str, float]], None] = lambda *given: None,
    tell: Callable[[ScanProgress], None] = lambda told: None,
    ready: Callable[[], Awaitable[None]] = lambda: asyncio.sleep(0),
) -> Outcome:
    """Scan magnets until the emittances are known as well as is wanted, and put them back.

    Of a machine with knobs: tune until the best setting is as near to the minimum as is wanted.

    Parameters
    ----------
    at : Connected
        The machine: magnets, screen and guard with the methods of `beamfit.live.devices`, and
        what the machine file says.
    line : Beamline
        Its optics.
    journal : Path
        Where the settings to restore are written before anything moves.
    keep : callable
        Is given all points after each new one, to write them, and the settings before the scan.
    tell : callable
        Is told how the scan stands.
    ready : callable
        Is awaited before each setting: the scan stands still as long as that takes.

    Returns
    -------
    Outcome
        Whatever ended it: goal, stop rule, signal or fault.

    Raises
    ------
    NotRestoredError
        If a magnet is not seen to be back; the journal stays then.
    InputError
        If nothing was begun: a journal is left from before, another scan has it or a magnet, or
        it cannot be written.

    Examples
    --------
    See docs/live.md, where a simulation takes the place of a control system.
    """
    aim = aim_of(at.machine, line)
    aim.warm()
    with alone_with(journal, at.machine.magnets):
        check_none_left(journal)
        magnets = at.machine.magnets  # what could not be put back is not moved
        before = {m.name: check_setting(m, await at.magnets[m.name].get()) for m in magnets}
        log = _journal_for(journal, at.machine, before)
        run = Running(at, aim, before, keep, tell, ready)
        measuring = asyncio.ensure_future(_begun(run, log))
        reason, problem = "", None
        with ended_by_signals(measuring, run.say) as came:
            try:
                reason = await measuring
            except asyncio.CancelledError:
                if not came:  # whoever runs this one wants it to end: restored before it does
                    await _to_the_end(_back(run, log))
                    raise
                reason = f"stopped by {signal.Signals(came[0]).name}"
            except Exception as error:  # of whatever kind: the magnets are put back first
                problem, reason = error, str(error)
            await _to_the_end(_back(run, log))
        number, doubt = came[0] if came else 0, aim.doubt(run.points, run.fit)
        return Outcome(tuple(run.points), run.fit, reason, problem, number, doubt)


def _journal_for(path: Path, machine: ScanMachine, before: Mapping[str, float]) -> Journal:
    """The journal of a scan, not written yet."""
    settings = tuple((m, before[m.name]) for m in machine.magnets)
    whose = os.path.abspath(machine.path)
    return Journal(path, whose, settings, machine.timeout, machine.restore)


async def _begun(run: Running, log: Journal) -> str:
    """Write the journal, measure, and say why that ended."""
    log.write()
    run.armed = True  # from here on something may have moved
    run.say(f"Restored at the end: {named(log.before)}. Until then it is in {log.path}")
    return await _measured(run)


async def _to_the_end(work: Coroutine[Any, Any, None]) -> None:
    """Wait until something is done, whoever cancels that; be cancelled only then."""
    task, cancelled = asyncio.ensure_future(work), None
    while not task.done():
        try:
            await asyncio.shield(task)
        except asyncio.CancelledError as error:
            cancelled = error
    task.result()
    if cancelled is not None:
        raise cancelled


async def _back(run: Running, log: Journal) -> None:
    """Restore what may have been moved."""
    if run.armed:
        await restore(log, run.at.magnets)
        run.say(f"Restored and read back: {named(log.before)}")


async def _measured(run: Running) -> str:
    """Measure setting after setting, and say why it ends."""
    machine, barren = run.at.machine, 0
    for magnet in machine.magnets:
        for value in magnet.degauss:
            await reach(magnet, run.at.magnets[magnet.name], value)
    while isinstance(chosen := run.aim.next(run.points, run.fit, run.barred, run.before), Next):
        await run.ready()
        point, why = await _point(run, chosen.settings)
        if point is None:
            run.barred.append(chosen.settings)
            barren += 1
            words = ", ".join(f"{name} {value:.6g}" for name, value in chosen.settings.items())
            run.say(f"Left out: {words} ({why})")
            if barren == BARREN:
                found = f"no sizes at {BARREN} settings in a row ({why})"
                raise NoSizesError(found, "a beam on the screen")
            continue
        barren = 0
        run.keep([*run.points, point], run.before)
        run.points.append(point)
        run.fit = run.aim.fit(run.points) or run.fit
        run.say(chosen.why, measured=True)
    return chosen


async def _point(run: Running, settings: Mapping[str, float]) -> tuple[MeasuredPoint | None, str]:
    """Measure at a setting; None, and why, where that cannot be done.

    Once more is tried where a magnet left it or the beam was lost during the shots; for a lost beam
    the magnets go back until it has returned.
    """
    lost = left = ""
    for _ in range(2):
        await _well(run, lost)
        reads = await _moved(run, settings, math.nan if left else None)
        shots, none, lost, left = await _taken(run, settings)
        if lost:
            run.say(f"Paused: {lost}")
            await _moved(run, run.before)
        elif left:
            run.say(f"Measured again: {left}")
        elif shots is None:
            return None, none
        elif plane := _stuck(run, reads, shots.sizes):
            return None, f"{plane} as before the magnets moved, to the last digit: is it stuck?"
        else:
            return MeasuredPoint(reads, dict(shots.sizes), shots.time), ""
    return None, lost or left


async def _taken(run: Running, settings: Mapping[str, float]) -> tuple[Shots | None, str, str, str]:
    """Shots at a setting, else why there are none; how the beam was lost, how a magnet moved.

    Magnets and beam are followed from before the first shot to the time stamp of the last one.
    """
    async with AsyncExitStack() as stack:
        devices = [run.at.magnets[name].followed(value) for name, value in settings.items()]
        magnets = [await stack.enter_async_context(one) for one in devices]
        beam = await stack.enter_async_context(run.at.guard.followed())
        shots, none, last = None, "", -math.inf
        try:
            shots = await run.at.screen.shots()
            last = shots.time
        except NoSizesError as error:
            none = error.found
        lost = await beam(last)
        return shots, none, lost, "; ".join(filter(None, [await one(last) for one in magnets]))


def _stuck(run: Running, reads: Mapping[str, float], shots: Mapping[str, np.ndarray]) -> str:
    """A plane that still shows what it showed at the point before; a dead camera has no scatter."""
    if not run.points or not shots:
        return ""
    last, magnets = run.points[-1], run.at.machine.magnets
    if all(abs(reads[m.name] - last.settings[m.name]) <= m.tolerance for m in magnets):
        return ""
    return next((p for p, each in shots.items() if np.all(each == last.shots[p][-1])), "")


async def _moved(
    run: Running, settings: Mapping[str, float], present: float | None = None
) -> dict[str, float]:
    """Move magnets; from NaN each passes its setting, from wherever somebody has moved it."""
    magnets = {m.name: m for m in run.at.machine.magnets if m.name in settings}
    devices = run.at.magnets
    return {n: await reach(m, devices[n], settings[n], present) for n, m in magnets.items()}


async def _well(run: Running, lost: str) -> None:
    """Wait until there is beam and none is lost.

    Raises
    ------
    InputError
        If that takes too long.
    """
    until = time.monotonic() + run.at.machine.guard.wait
    while wrong := await run.at.guard.amiss():
        if time.monotonic() > until:
            expected = f"it to be over within {run.at.machine.guard.wait:g} s"
            raise InputError(f"{wrong}", expected)
        await asyncio.sleep(LOOK)
    if lost:
        run.say("Going on")
