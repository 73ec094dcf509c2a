"""The magnets and the screen of a machine file as devices of ophyd-async."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
from ophyd_async.core import Array1D, AsyncStatus, DeviceMap, SignalR, StandardReadable
from ophyd_async.core import StandardReadableFormat as Format
from ophyd_async.epics.core import epics_signal_r, epics_signal_rw

from beamfit.io.machine import Guard, Magnet, Profiler, ScanMachine, moved
from beamfit.live.channel import INVALID, Described, Protocols, Reading, Variable, described
from beamfit.live.devices import BeamGuard, ScreenShots, Supply, check_lengths, checked
from beamfit.live.restore import reach


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

    async def connect(self, mock: Any = False, **more: Any) -> None:
        """Connect it, and check the unit of its sizes.

        Raises
        ------
        InputError
            If the control system has another unit of length than the file.
        """
        await super().connect(mock, **more)
        if not mock and self.shots.profiler.sizes:
            for channel in self.shots.channels.values():
                await check_lengths(channel, self.shots.profiler)

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
