"""The scan of a machine as a plan of bluesky.

It is the loop of `beamfit.live.scan` itself: an ``async def`` whose awaits all end in messages is a
plan.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from types import coroutine
from typing import Any

import bluesky.plan_stubs as bps
import bluesky.preprocessors as bpp
import numpy as np
from bluesky.utils import FailedStatus, MsgGenerator

import beamfit
from beamfit.io.machine import Magnet, ScanMachine
from beamfit.live.devices import Connected, Supply
from beamfit.live.journal import Journal, alone_with, check_none_left, journal_of
from beamfit.live.next_setting import warmed
from beamfit.live.ophyd import MagnetDevice, ScreenDevice
from beamfit.live.scan import Outcome, Running, Told, back, begun, journal_for
from beamfit.optics.beamline import Beamline
from beamfit.studies.scan.fit import EmittanceFit

# What a fit's event says of each plane.
QUOTED = ("emittance", "normalized_emittance", "beta", "alpha")


def emittance_scan(
    magnets: Mapping[str, MagnetDevice],
    screen: ScreenDevice,
    machine: ScanMachine,
    line: Beamline,
    *,
    journal: str | None = None,
    tell: Callable[[Told], None] = lambda told: None,
    md: Mapping[str, Any] | None = None,
) -> MsgGenerator[Outcome]:
    """Scan magnets until the emittances are known as well as is wanted, and put them back.

    Parameters
    ----------
    magnets, screen
        Of `devices_of`, connected.
    machine : ScanMachine
        Limits, goal, settings to begin with.
    line : Beamline
        Its optics.
    journal : str, optional
        Where the settings to restore are written before anything moves; beside the machine's file
        unless said.
    tell : callable
        Is told how the scan stands.
    md : mapping, optional
        Metadata of the run.

    Yields
    ------
    Msg
        One run: each shot an event of the stream "primary", the fit one of the stream "fit".

    Returns
    -------
    Outcome
        As of `beamfit.live.scan.scan`.

    Raises
    ------
    NotRestoredError
        If a magnet is not seen to be back; the journal stays then.
    InputError
        If a magnet cannot be moved, nothing can be measured, or nothing was begun: a journal is
        left from before, a magnet is outside its limits.

    Examples
    --------
    See docs/live_adapters.md, which is run as it stands.
    """
    supplies = {m.name: magnets[m.name].supply for m in machine.magnets}
    machine = replace(machine, magnets=tuple(s.magnet for s in supplies.values()))
    seen = _Messages({name: magnets[name] for name in supplies}, screen, machine.screen.shots)
    warmed(machine, line)
    with alone_with(place := journal_of(machine, journal), machine.magnets):
        check_none_left(place)
        before = {}
        for name, supply in supplies.items():
            before[name] = yield from _asked(supply.standing)
        run = Running(
            Connected(supplies, seen, seen, machine), line, before, lambda points: None, tell,
            reach=seen.reach, sleep=seen.sleep,
        )  # fmt: skip
        plan = _one_run(run, journal_for(place, machine, before), seen, _said(machine, md or {}))
        reason = yield from bpp.subs_wrapper(plan, seen.keep)
    return Outcome(tuple(run.points), run.fit, reason)


def _said(machine: ScanMachine, md: Mapping[str, Any]) -> dict[str, Any]:
    """What the run says of itself."""
    names = [m.name for m in machine.magnets]
    return {
        "plan_name": "emittance_scan", "detectors": [machine.screen.name], "motors": names,
        "machine": machine.name, "machine_sha256": machine.sha256,
        "lattice_sha256": machine.lattice.sha256, "goal": machine.goal,
        "beamfit": beamfit.__version__, "hints": {"dimensions": [(names[:1], "primary")]}, **md,
    }  # fmt: skip


def _one_run(run: Running, log: Journal, seen: _Messages, md: dict[str, Any]) -> MsgGenerator[str]:
    """One run of bluesky: measured, restored whatever came, the fit said."""

    def measured() -> MsgGenerator[str]:
        loop = begun(run, log).__await__()
        reason = yield from bpp.finalize_wrapper(loop, lambda: _restored(run, log, seen))
        if run.fit is not None:
            yield from bps.trigger_and_read([_Fitted(run.fit)], "fit")
        yield from bps.close_run("success", reason)
        return reason

    def closed(error: Exception) -> MsgGenerator[None]:
        yield from bps.close_run(getattr(error, "exit_status", "fail"), str(error))

    yield from bps.open_run(md)
    return (yield from bpp.contingency_wrapper(measured(), except_plan=closed))


def _restored(run: Running, log: Journal, seen: _Messages) -> MsgGenerator[None]:
    """Restore in a task of its own, which goes on whatever becomes of these messages."""

    async def stopped_and_back() -> None:
        for magnet in seen.magnets.values():
            await magnet.stop()  # or it might write after what is restored
        await back(run, log)

    task = asyncio.ensure_future(stopped_and_back())
    while not task.done():
        with suppress(FailedStatus):  # of what was still going on when the plan ended
            yield from bps.checkpoint()
            yield from bps.wait_for([lambda: asyncio.wait([task])])
    task.result()


@dataclass
class _Messages:
    """Magnets, screen and guard as the loop asks of them: each answer by messages of a plan.

    Sizes are those of the events: a pause repeats a setting, and the last ones are what counts.
    """

    magnets: Mapping[str, MagnetDevice]
    screen: ScreenDevice
    count: int
    stream: str = ""
    events: list[dict[str, Any]] = field(default_factory=list)

    def keep(self, name: str, document: Mapping[str, Any]) -> None:
        if name == "descriptor" and document["name"] == "primary":
            self.stream = document["uid"]
        if name == "event" and document["descriptor"] == self.stream:
            self.events.append(document["data"])

    @coroutine
    def reach(self, magnet: Magnet, supply: Supply, value: float) -> MsgGenerator[float]:
        with _as_raised():
            yield from bps.mv(self.magnets[magnet.name], value)
        return self.magnets[magnet.name].arrived

    @coroutine
    def shots(self) -> MsgGenerator[dict[str, np.ndarray]]:
        with _as_raised():
            for _ in range(self.count):
                yield from bps.trigger_and_read([*self.magnets.values(), self.screen])
        taken = self.events[-self.count :]
        keys = {plane: self.screen.key(plane) for plane in self.screen.variables}
        return {p: 1e-6 * np.array([shot[key] for shot in taken]) for p, key in keys.items()}

    @coroutine
    def amiss(self) -> MsgGenerator[str]:
        # Asked before and after each setting: what a pause repeats is one setting.
        yield from bps.checkpoint()
        return (yield from _asked(self.screen.guard.amiss))

    @coroutine
    def sleep(self, seconds: float) -> MsgGenerator[None]:
        yield from bps.sleep(seconds)


@contextmanager
def _as_raised() -> Iterator[None]:
    """A device's own error, which bluesky wraps."""
    try:
        yield
    except FailedStatus as error:
        raise error.__cause__ or error from None


def _asked(work: Callable[[], Awaitable[Any]]) -> MsgGenerator[Any]:
    """What an async function answers; where a pause came between, bluesky asks it again."""
    found: list[tuple[Any, Exception | None]] = []

    async def kept() -> None:
        try:
            found.append((await work(), None))
        except Exception as error:
            found.append((None, error))

    yield from bps.wait_for([kept])
    answer, error = found[-1]
    if error is not None:
        raise error
    return answer


@dataclass(frozen=True, eq=False)
class _Fitted:
    """A fit to be read: what is quoted of each plane, NaN for an error that is open."""

    fit: EmittanceFit
    name: str = "fit"
    parent: None = None

    def read(self) -> dict[str, Any]:
        at = time.time()
        return {key: {"value": value, "timestamp": at} for key, (value, _) in self._said().items()}

    def describe(self) -> dict[str, Any]:
        how = {"source": "beamfit", "shape": []}
        return {
            key: {"dtype": "string" if isinstance(value, str) else "number", "units": unit, **how}
            for key, (value, unit) in self._said().items()
        }

    def _said(self) -> dict[str, tuple[Any, str]]:
        said: dict[str, tuple[Any, str]] = {}
        for fit in self.fit.planes:
            said[f"{fit.plane}-status"] = str(fit.status), ""
            for key, found in ((f"{fit.plane}-{name}", getattr(fit, name)) for name in QUOTED):
                said[key] = found.value, found.unit
                said[f"{key}-error"] = np.nan if found.error is None else found.error, found.unit
        return said
