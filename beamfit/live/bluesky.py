"""A machine's magnets and screen as devices of ophyd-async, and its scan as a plan of bluesky.

The plan is the loop of `beamfit.live.scan` itself: an ``async def`` whose awaits all end in
messages is a plan.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from types import SimpleNamespace, coroutine
from typing import Any

import bluesky.plan_stubs as bps
import bluesky.preprocessors as bpp
import numpy as np
from bluesky.utils import FailedStatus, MsgGenerator
from ophyd_async.core import Array1D, AsyncStatus, DeviceMap, SignalR, StandardReadable
from ophyd_async.core import StandardReadableFormat as Format
from ophyd_async.epics.core import epics_signal_r, epics_signal_rw

import beamfit
from beamfit.io.machine import Guard, Magnet, Profiler, ScanMachine, moved
from beamfit.live.channel import INVALID, Described, Protocols, Reading, Variable, described
from beamfit.live.devices import BeamGuard, Connected, ScreenShots, Supply, checked
from beamfit.live.journal import Journal, check_none_left, journal_of
from beamfit.live.next_setting import warmed
from beamfit.live.restore import reach
from beamfit.live.scan import Outcome, Running, Told, back, begun, journal_for
from beamfit.optics.beamline import Beamline
from beamfit.studies.scan.fit import EmittanceFit
from beamfit.writing import alone

# What a fit's event says of each plane.
QUOTED = ("emittance", "normalized_emittance", "beta", "alpha")


class MagnetDevice(StandardReadable):
    """A magnet of a machine file: moved within its limits, from its side, until it has settled.

    Parameters
    ----------
    magnet : Magnet
        Its variables, limits, tolerance and times; limits of the control system that are tighter
        take their place when it is connected.
    timeout : float
        Within which a variable has to answer, s.

    Examples
    --------
    >>> magnet = MagnetDevice(Magnet("Q1", "SIM:SET", "pva://SIM:READ", "A", -1.0, 1.0, 0.01, 0.1))
    >>> magnet.readback.source, magnet.hints
    ('pva://SIM:READ', {'fields': ['Q1']})
    """

    def __init__(self, magnet: Magnet, timeout: float = 5.0) -> None:
        with self.add_children_as_readables(Format.HINTED_UNCACHED_SIGNAL):
            self.readback = epics_signal_r(float, magnet.read)
        self.setpoint = epics_signal_rw(float, magnet.set)
        setting = _variable(self.setpoint, magnet.set, magnet.timeout)
        self.supply = Supply(magnet, setting, _variable(self.readback, magnet.read, timeout))
        self.arrived = float("nan")
        self._move: asyncio.Task[None] | None = None
        super().__init__(magnet.name)

    def set_name(self, name: str, **more: Any) -> None:
        """Name it, and what it reads like it."""
        super().set_name(name, **more)
        self.readback.set_name(name)

    async def connect(self, mock: Any = False, **more: Any) -> None:
        """Connect it, and check units and limits.

        Raises
        ------
        InputError
            If the control system has another unit, or no limits in common with the file.
        """
        await super().connect(mock, **more)
        if not mock:
            self.supply, _ = await checked(self.supply)

    def set(self, value: float) -> AsyncStatus:
        """Move it; done when it is read back and stays.

        Raises
        ------
        InputError
            If the setting is outside the limits: nothing is written then.
        """
        moved(self.supply.magnet, value)
        if self._move is not None and not self._move.done():
            raise RuntimeError(f"{self.name} is moving")
        self._move = asyncio.ensure_future(self._reach(value))
        return AsyncStatus(self._ended(self._move), self.name)

    async def _reach(self, value: float) -> None:
        self.arrived = await reach(self.supply.magnet, self.supply, value)

    async def _ended(self, move: asyncio.Task[None]) -> None:
        """A move that was stopped on purpose ends without an error, as bluesky wants it."""
        await asyncio.wait([move])
        if not move.cancelled():
            move.result()

    async def stop(self, success: bool = True) -> None:
        """Write nothing more; the supply itself goes on to what was written last."""
        while self._move is not None and not self._move.done():
            self._move.cancel()  # which is lost where an answer comes at the same time
            await asyncio.wait([self._move], timeout=0.1)

    async def locate(self) -> dict[str, float]:
        """Its setting, and what is read back."""
        setting, read = self.supply.setting, self.supply.readback
        return {"setpoint": (await setting.get()).value, "readback": (await read.get()).value}


class ScreenDevice(StandardReadable):
    """The screen of a machine file: each trigger a new shot, rms sizes in um by plane.

    Parameters
    ----------
    profiler : Profiler
        Its variables.
    guard : Guard
        Beam-present and beam-loss variables, which are in its readings too.
    timeout : float
        Within which a variable has to answer, s.

    Examples
    --------
    >>> sizes = {"x": "SIM:X", "y": "SIM:Y"}
    >>> ScreenDevice(Profiler("OTR", sizes, {}, 1e-6, None, 5, 10.0)).hints
    {'fields': ['OTR-x', 'OTR-y']}
    """

    def __init__(self, profiler: Profiler, guard: Guard = Guard(), timeout: float = 5.0) -> None:  # noqa: B008
        names = profiler.sizes or profiler.profiles
        kind: Any = float if profiler.sizes else Array1D[np.float64]
        self.variables = DeviceMap({p: epics_signal_r(kind, name) for p, name in names.items()})
        named = {"present": guard.present, "loss": guard.loss}
        self.beam = DeviceMap({key: epics_signal_r(float, v) for key, v in named.items() if v})
        self.add_readables(list(self.beam.values()), Format.UNCACHED_SIGNAL)
        channels = {p: _variable(self.variables[p], name, timeout) for p, name in names.items()}
        watched = {key: _variable(s, named[key], timeout) for key, s in self.beam.items()}
        self.shots = ScreenShots(replace(profiler, shots=1), channels)
        self.guard = BeamGuard(guard, watched.get("present"), watched.get("loss"))
        self.taken: dict[str, tuple[float, float]] = {}
        super().__init__(profiler.name)

    @AsyncStatus.wrap
    async def trigger(self) -> None:
        """Wait for a shot with new time stamps.

        Raises
        ------
        NoSizesError
            If there is none in time, or none with a size.
        """
        self.taken = {plane: shot for plane, (shot,) in (await self.shots.timed()).items()}

    async def read(self) -> dict[str, Any]:
        """Sizes with their time stamps, then the variables of the beam."""
        if not self.taken:
            await self.trigger()
        sizes = {
            self.key(plane): {"value": 1e6 * size, "timestamp": at}
            for plane, (at, size) in self.taken.items()
        }
        return sizes | await super().read()

    async def describe(self) -> dict[str, Any]:
        """What `read` gives."""
        how = {"dtype": "number", "shape": [], "units": "um", "precision": 2}
        sizes = {self.key(p): {"source": s.source, **how} for p, s in self.variables.items()}
        return sizes | await super().describe()

    @property
    def hints(self) -> dict[str, Any]:
        """The sizes."""
        return {"fields": [self.key(plane) for plane in self.variables]}

    def key(self, plane: str) -> str:
        """The name of a plane's size in events."""
        return f"{self.name}-{plane}"


def devices_of(machine: ScanMachine) -> tuple[dict[str, MagnetDevice], ScreenDevice]:
    """The magnets, by name, and the screen of a machine file, to be connected.

    Parameters
    ----------
    machine : ScanMachine
        As read by `beamfit.io.machine.read_scan_machine`.

    Returns
    -------
    dict of str to MagnetDevice, ScreenDevice
        Variables NAME and ca://NAME by Channel Access, pva://NAME by PV Access.

    Examples
    --------
    See docs/live_adapters.md, which is run as it stands.
    """
    magnets = {m.name: MagnetDevice(m, machine.timeout) for m in machine.magnets}
    return magnets, ScreenDevice(machine.screen, machine.guard, machine.timeout)


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
    with alone(place := journal_of(machine, journal)):
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
        return {key: {"value": value, "timestamp": at} for key, (value, _) in self._rows()}

    def describe(self) -> dict[str, Any]:
        return {
            key: {
                "source": "beamfit", "shape": [], "units": unit,
                "dtype": "string" if isinstance(value, str) else "number",
            }
            for key, (value, unit) in self._rows()
        }  # fmt: skip

    def _rows(self) -> Iterator[tuple[str, tuple[float | str, str]]]:
        for plane in self.fit.planes:
            yield f"{plane.plane}-status", (str(plane.status), "")
            for name in QUOTED:
                found, key = getattr(plane, name), f"{plane.plane}-{name}"
                yield key, (found.value, found.unit)
                error = np.nan if found.error is None else found.error
                yield f"{key}-error", (error, found.unit)


def _variable(signal: SignalR[Any], name: str, timeout: float) -> Variable:
    """A signal of ophyd-async as a variable that is asked."""

    async def get(_: str) -> Reading:
        return _reading(await signal.read(cached=False))

    async def put(_: str, value: float) -> None:
        await signal.set(value, timeout=None)

    async def describe(_: str) -> Described:
        (found,) = (await signal.describe()).values()
        limits = found.get("limits", {}).get("control", {})
        ends = [limits.get(end) for end in ("low", "high")]
        return described(found.get("units"), *(ends if None not in ends else (0.0, 0.0)))

    def follow(_: str, come: Callable[[Reading | None], None]) -> Any:
        def arrived(found: dict[str, Any]) -> None:
            come(_reading(found))

        signal.subscribe_reading(arrived)
        return SimpleNamespace(close=lambda: signal.clear_sub(arrived))

    speech = Protocols(get, put, describe, follow, Exception)
    return Variable(name.rpartition("://")[2], timeout, speech)


def _reading(found: dict[str, Any]) -> Reading:
    """Of the one signal that is read; bluesky's severity of INVALID is -1."""
    (one,) = found.values()
    severity = one.get("alarm_severity", 0)
    return Reading(one["value"], one["timestamp"], INVALID if severity < 0 else severity)
