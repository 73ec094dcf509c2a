"""Scan of a machine as a bluesky plan: the loop of `beamfit.live.scan`, with documents."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Coroutine, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import bluesky.plan_stubs as bps
import bluesky.preprocessors as bpp
from bluesky.utils import FailedStatus, MsgGenerator

import beamfit
from beamfit.emittance.fit import EmittanceFit
from beamfit.errors import InputError
from beamfit.io.machine import ScanMachine
from beamfit.live.devices import connect
from beamfit.live.points import MeasuredPoint
from beamfit.live.restore import journal_of
from beamfit.live.scan import Outcome, ScanProgress, scan
from beamfit.optics.beamline import Beamline

# Quantities of each plane in the event of a fit.
FIT_QUANTITIES = ("emittance", "normalized_emittance", "beta", "alpha")


def emittance_scan(
    machine: ScanMachine,
    line: Beamline,
    *,
    journal: str | None = None,
    tell: Callable[[ScanProgress], None] = lambda progress: None,
    md: Mapping[str, Any] | None = None,
) -> MsgGenerator[Outcome]:
    """Scan magnets until the emittances are known to the goal, and restore the magnets.

    Parameters
    ----------
    machine : ScanMachine
        Variables, limits, goal, first settings.
    line : Beamline
        Its optics.
    journal : str, optional
        File of the settings to restore, written before anything moves; default: next to the
        machine file.
    tell : callable
        Called with the progress.
    md : mapping, optional
        Metadata of the run.

    Yields
    ------
    Msg
        One run: an event of the stream "primary" per shot, one event of the stream "fit".

    Returns
    -------
    Outcome
        As for `beamfit.live.scan.scan`.

    Raises
    ------
    NotRestoredError
        If the read-back of a magnet does not confirm its restoring; the journal stays then.
    InputError
        If a magnet cannot be moved, nothing can be measured, or the scan could not begin.

    Examples
    --------
    See docs/live_adapters.md, whose code the tests run.
    """
    _check_no_knobs(machine)
    steps: asyncio.Queue[MsgGenerator[None] | None] = asyncio.Queue()
    turn = asyncio.Semaphore(0)

    async def ready() -> None:  # a paused plan does not release the semaphore
        steps.put_nowait(_release(turn))
        await turn.acquire()

    def report(now: ScanProgress) -> None:
        tell(now)
        if now.measured:
            steps.put_nowait(_shot_events(machine, now.points[-1]))

    async def scanned() -> Outcome:
        at, place = await connect(machine), journal_of(machine, journal)
        return await scan(at, line, place, tell=report, ready=ready)

    def measured() -> MsgGenerator[Outcome]:
        while step := (yield from _await_result(steps.get())):
            yield from step
        found = task.result()
        if found.problem is not None:
            raise found.problem
        if found.fit is not None:
            yield from _event("fit", _fit_values(found.fit), time.time())
        yield from bps.close_run("success", f"{found.reason}. {found.doubt}".removesuffix(". "))
        return found

    def closed(error: Exception) -> MsgGenerator[None]:
        yield from bps.close_run(getattr(error, "exit_status", "fail"), str(error))

    yield from bps.open_run(_metadata(machine, md or {}))
    yield from bps.checkpoint()
    task = asyncio.ensure_future(scanned())
    task.add_done_callback(lambda _: steps.put_nowait(None))
    try:
        plan = bpp.finalize_wrapper(measured(), lambda: _end_scan(task))
        return (yield from bpp.contingency_wrapper(plan, except_plan=closed))
    finally:  # also after a halt: the loop restores in the background
        task.cancel()


def _check_no_knobs(machine: ScanMachine) -> None:
    if machine.knobs:
        raise InputError("knobs in a plan of bluesky", "beamfit scan for them", machine.path)


def _metadata(machine: ScanMachine, md: Mapping[str, Any]) -> dict[str, Any]:
    """Make the metadata of the run."""
    names = [m.name for m in machine.magnets]
    return {
        "plan_name": "emittance_scan", "detectors": [machine.screen.name], "motors": names,
        "machine": machine.name, "machine_sha256": machine.sha256,
        "lattice_sha256": machine.lattice.sha256, "goal": machine.goal,
        "beamfit": beamfit.__version__, "hints": {"dimensions": [(names[:1], "primary")]}, **md,
    }  # fmt: skip


def _release(turn: asyncio.Semaphore) -> MsgGenerator[None]:
    yield from bps.checkpoint()
    turn.release()


def _await_result(work: Coroutine[Any, Any, Any]) -> MsgGenerator[Any]:
    """Wait for the return value of a coroutine, also through pauses."""
    task = asyncio.ensure_future(work)
    yield from bps.wait_for([lambda: asyncio.wait([task])])
    return task.result()


def _end_scan(task: asyncio.Future[Outcome]) -> MsgGenerator[None]:
    """Cancel a scan and wait until it has restored, also if these messages fail."""
    task.cancel()
    while not task.done():
        with suppress(FailedStatus):
            yield from bps.checkpoint()
            yield from bps.wait_for([lambda: asyncio.wait([task])])
    if not task.cancelled():
        task.result()


def _shot_events(machine: ScanMachine, point: MeasuredPoint) -> MsgGenerator[None]:
    """Emit an event for each shot of a point."""
    settings = {m.name: (point.settings[m.name], m.unit) for m in machine.magnets}
    sizes = {f"{machine.screen.name}-{p}": 1e6 * each for p, each in point.shots.items()}
    for shot in zip(*sizes.values(), strict=True):
        here = {name: (float(size), "um") for name, size in zip(sizes, shot, strict=True)}
        yield from _event("primary", settings | here, point.time)


def _fit_values(fit: EmittanceFit) -> dict[str, tuple[Any, str]]:
    """Return status and quantities of each plane; NaN for an error that is not determined."""
    found: dict[str, tuple[Any, str]] = {}
    for fitted in fit.planes:
        found[f"{fitted.plane}-status"] = str(fitted.status), ""
        for name in FIT_QUANTITIES:
            one, key = getattr(fitted, name), f"{fitted.plane}-{name}"
            error = float("nan") if one.error is None else one.error
            found |= {key: (one.value, one.unit), f"{key}-error": (error, one.unit)}
    return found


def _event(stream: str, data: Mapping[str, tuple[Any, str]], at: float) -> MsgGenerator[None]:
    yield from bps.create(stream)
    yield from bps.read(_Reading(stream, data, at))
    yield from bps.save()


@dataclass(frozen=True)
class _Reading:
    """Device of bluesky that returns given values with their units; one per stream."""

    name: str
    data: Mapping[str, tuple[Any, str]] = field(compare=False)
    at: float = field(compare=False)
    parent: None = None

    def read(self) -> dict[str, Any]:
        return {
            key: {"value": value, "timestamp": self.at} for key, (value, _) in self.data.items()
        }

    def describe(self) -> dict[str, Any]:
        how = {"source": "beamfit", "shape": []}
        return {
            key: {"dtype": "string" if isinstance(value, str) else "number", "units": unit, **how}
            for key, (value, unit) in self.data.items()
        }
