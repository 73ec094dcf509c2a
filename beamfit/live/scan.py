"""Live scans: settings chosen after every fit, an end at the goal, and restored magnets."""

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
    reach,
    restore,
    settings_words,
)
from beamfit.optics.beamline import Beamline
from beamfit.tuning.fit import TuningFit

# Number of consecutive settings without a measurement after which a scan ends.
MAX_FAILURES = 3
# Time between checks for the return of the beam, s.
CHECK_INTERVAL = 0.2


class ScanProgress(NamedTuple):
    """Progress of a scan: its points, the fit to them if there is one, and the last event.

    If ``measured`` is true, the event is the last of the points and ``news`` the reason for it.
    """

    points: tuple[MeasuredPoint, ...]
    fit: EmittanceFit | TuningFit | None
    news: str
    measured: bool = False


class Outcome(NamedTuple):
    """Result of a scan.

    Attributes
    ----------
    points : tuple of MeasuredPoint
        The measured points.
    fit : EmittanceFit, TuningFit or None
        The fit to them; a TuningFit if the machine has knobs.
    reason : str
        Reason of the end.
    problem : Exception or None
        Exception that ended the scan, if any. The magnets are restored nevertheless.
    signal : int
        Number of the signal that ended it; 0 if none.
    doubt : str
        Why the line may be wrong; "" if the sizes follow it.
    """

    points: tuple[MeasuredPoint, ...]
    fit: EmittanceFit | TuningFit | None
    reason: str
    problem: Exception | None = None
    signal: int = 0
    doubt: str = ""


@dataclass
class Running:
    """State of a running scan, the only object that changes."""

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
        """Report the progress."""
        self.tell(ScanProgress(tuple(self.points), self.fit, news, measured))


async def scan(
    at: Connected,
    line: Beamline,
    journal: Path,
    *,
    keep: Callable[[Sequence[MeasuredPoint], Mapping[str, float]], None] = lambda *given: None,
    tell: Callable[[ScanProgress], None] = lambda progress: None,
    ready: Callable[[], Awaitable[None]] = lambda: asyncio.sleep(0),
) -> Outcome:
    """Scan magnets until the emittances are known to the goal, and restore the magnets.

    A machine with knobs is tuned until the best setting is close enough to the minimum.

    Parameters
    ----------
    at : Connected
        The machine: magnets, screen and guard with the methods of `beamfit.live.devices`, and
        the content of the machine file.
    line : Beamline
        Its optics.
    journal : Path
        File for the settings to restore, written before anything moves.
    keep : callable
        Called after each new point with all points and the settings before the scan, to save them.
    tell : callable
        Called with the progress.
    ready : callable
        Awaited before each setting; the scan pauses until it returns.

    Returns
    -------
    Outcome
        Result, also after a signal or a fault.

    Raises
    ------
    NotRestoredError
        If the read-back of a magnet does not confirm its restoring; the journal stays then.
    InputError
        If the scan could not begin: a journal remains from before, another scan uses it or a
        magnet, or it cannot be written.

    Examples
    --------
    See docs/live_adapters.md, where a simulation replaces a control system.
    """
    aim = aim_of(at.machine, line)
    aim.warm()
    with alone_with(journal, at.machine.magnets):
        check_none_left(journal)
        magnets = at.machine.magnets  # `check_setting` refuses magnets that could not be restored
        before = {m.name: check_setting(m, await at.magnets[m.name].get()) for m in magnets}
        log = _journal_for(journal, at.machine, before)
        run = Running(at, aim, before, keep, tell, ready)
        measuring = asyncio.ensure_future(_run(run, log))
        reason, problem = "", None
        with ended_by_signals(measuring, run.say) as came:
            try:
                reason = await measuring
            except asyncio.CancelledError:
                if not came:  # cancelled by the caller: restore first
                    await _shielded(_restore(run, log))
                    raise
                reason = f"stopped by {signal.Signals(came[0]).name}"
            except Exception as error:  # any error: the magnets are restored first
                problem, reason = error, str(error)
            await _shielded(_restore(run, log))
        number, doubt = came[0] if came else 0, aim.doubt(run.points, run.fit)
        return Outcome(tuple(run.points), run.fit, reason, problem, number, doubt)


def _journal_for(path: Path, machine: ScanMachine, before: Mapping[str, float]) -> Journal:
    """Make the journal of a scan without writing it."""
    settings = tuple((m, before[m.name]) for m in machine.magnets)
    whose = os.path.abspath(machine.path)
    return Journal(path, whose, settings, machine.timeout, machine.restore)


async def _run(run: Running, log: Journal) -> str:
    """Write the journal, measure, and return the reason of the end."""
    log.write()
    run.armed = True  # from here on magnets may have moved
    run.say(f"Restored at the end: {settings_words(log.before)}. Until then it is in {log.path}")
    return await _measure_all(run)


async def _shielded(work: Coroutine[Any, Any, None]) -> None:
    """Wait for the end of `work` despite cancellations, and re-raise them only then."""
    task, cancelled = asyncio.ensure_future(work), None
    while not task.done():
        try:
            await asyncio.shield(task)
        except asyncio.CancelledError as error:
            cancelled = error
    task.result()
    if cancelled is not None:
        raise cancelled


async def _restore(run: Running, log: Journal) -> None:
    """Restore the magnets if they may have been moved."""
    if run.armed:
        await restore(log, run.at.magnets)
        run.say(f"Restored and read back: {settings_words(log.before)}")


async def _measure_all(run: Running) -> str:
    """Measure setting after setting, and return the reason of the end."""
    machine, failures = run.at.machine, 0
    for magnet in machine.magnets:
        for value in magnet.degauss:
            await reach(magnet, run.at.magnets[magnet.name], value)
    while isinstance(chosen := run.aim.next(run.points, run.fit, run.barred, run.before), Next):
        await run.ready()
        point, why = await _measure_point(run, chosen.settings)
        if point is None:
            run.barred.append(chosen.settings)
            failures += 1
            words = ", ".join(f"{name} {value:.6g}" for name, value in chosen.settings.items())
            run.say(f"Left out: {words} ({why})")
            if failures == MAX_FAILURES:
                found = f"no sizes at {MAX_FAILURES} settings in a row ({why})"
                raise NoSizesError(found, "a beam on the screen")
            continue
        failures = 0
        run.keep([*run.points, point], run.before)
        run.points.append(point)
        run.fit = run.aim.fit(run.points) or run.fit
        run.say(chosen.why, measured=True)
    return chosen


async def _measure_point(
    run: Running, settings: Mapping[str, float]
) -> tuple[MeasuredPoint | None, str]:
    """Measure at a setting; return None and the reason if that fails.

    The measurement is repeated once if a magnet left the setting or the beam was lost during the
    shots. After a beam loss the magnets return to their initial settings until the beam is back.
    """
    lost = left = ""
    for _ in range(2):
        await _wait_for_beam(run, lost)
        reads = await _move(run, settings, math.nan if left else None)
        shots, none, lost, left = await _take_shots(run, settings)
        if lost:
            run.say(f"Paused: {lost}")
            await _move(run, run.before)
        elif left:
            run.say(f"Measured again: {left}")
        elif shots is None:
            return None, none
        elif plane := _stuck_plane(run, reads, shots.sizes):
            return None, f"{plane} as before the magnets moved, to the last digit: is it stuck?"
        else:
            return MeasuredPoint(reads, dict(shots.sizes), shots.time), ""
    return None, lost or left


async def _take_shots(
    run: Running, settings: Mapping[str, float]
) -> tuple[Shots | None, str, str, str]:
    """Take shots at a setting; return them or the reason for none, beam loss and magnet motion.

    Magnets and beam are monitored from before the first shot to the time stamp of the last one.
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


def _stuck_plane(run: Running, reads: Mapping[str, float], shots: Mapping[str, np.ndarray]) -> str:
    """Return a plane whose sizes equal those of the previous point: a stuck camera; else ""."""
    if not run.points or not shots:
        return ""
    last, magnets = run.points[-1], run.at.machine.magnets
    if all(abs(reads[m.name] - last.settings[m.name]) <= m.tolerance for m in magnets):
        return ""
    return next((p for p, each in shots.items() if np.all(each == last.shots[p][-1])), "")


async def _move(
    run: Running, settings: Mapping[str, float], present: float | None = None
) -> dict[str, float]:
    """Move magnets; with `present` NaN their approach passes the setting from either side."""
    magnets = {m.name: m for m in run.at.machine.magnets if m.name in settings}
    devices = run.at.magnets
    return {n: await reach(m, devices[n], settings[n], present) for n, m in magnets.items()}


async def _wait_for_beam(run: Running, lost: str) -> None:
    """Wait until there is beam without losses.

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
        await asyncio.sleep(CHECK_INTERVAL)
    if lost:
        run.say("Going on")
