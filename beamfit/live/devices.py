"""EPICS devices of a scan: magnets, a screen and a guard."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import (
    AbstractAsyncContextManager,
    AsyncExitStack,
    asynccontextmanager,
    suppress,
)
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple, Protocol

import numpy as np
from scipy.optimize import curve_fit

from beamfit.errors import InputError, plain
from beamfit.io.columns import UNITS
from beamfit.io.machine import (
    LENGTHS,
    Guard,
    Magnet,
    Profiler,
    ScanMachine,
    check_setting,
    check_unit,
    unit_of,
)
from beamfit.live.channel import Channel, LostError, PvReading, SilentError, open_channel

# Polls of a read-back per settle time, and the limits of their interval, s.
POLLS = 8
MIN_POLL_INTERVAL = 0.02
MAX_POLL_INTERVAL = 0.25
# Longest wait for a reading of the beam as new as the last shot, s; a variable that does not change
# may send none.
LAST_READING_WAIT = 1.0
# Longest wait for the first reading of a monitored variable, s.
FIRST_READING_WAIT = 5.0
# Ratio of bad to required shots of a plane above which there is no beam on the screen.
MAX_BAD_RATIO = 2
# Smallest height of a projection over the scatter of its background that counts as a beam.
MIN_SIGNAL = 5.0
# A Gaussian is within 1 % of its height over 0.28 of its size. A top wider than FLAT_WIDTH sizes
# plus FLAT_PIXELS pixels is cut off by the camera.
FLAT_WIDTH = 0.6
FLAT_PIXELS = 2
# Fraction of the projection at either end used for the initial background.
BACKGROUND_FRACTION = 0.1


class NotSettledError(InputError):
    """Error of a magnet whose read-back does not reach its setting or does not stay there."""


class NoSizesError(InputError):
    """Error of a screen without new valid sizes."""


class Shots(NamedTuple):
    """New shots: rms sizes by plane in m, and the time stamp of the last one, Unix time in s."""

    sizes: Mapping[str, np.ndarray]
    time: float


# Function of the time stamp of the last shot: how a device deviated, or "" if it stayed.
Left = Callable[[float], Awaitable[str]]


class Device(Protocol):
    """Magnet of any control system or of a simulation."""

    async def put(self, value: float) -> None:
        """Move to a setting, and return when the device reports completion."""

    async def get(self) -> float:
        """Return the setting, as `put` would restore it."""

    async def settled(self, value: float) -> float:
        """Wait until the magnet has settled, and return the read-back.

        Raises
        ------
        NotSettledError
            If it does not settle.
        """

    def followed(self, value: float) -> AbstractAsyncContextManager[Left]:
        """Monitor the magnet inside the context; yields a function that reports deviations."""


class SizeMonitor(Protocol):
    """Screen that measures the beam size."""

    async def shots(self) -> Shots:
        """Take new shots.

        Raises
        ------
        NoSizesError
            If there are none.
        """


class Watchman(Protocol):
    """Guard that reports a missing beam or beam losses."""

    async def amiss(self) -> str:
        """Return the fault, or "" if there is none."""

    def followed(self) -> AbstractAsyncContextManager[Left]:
        """Monitor the beam inside the context; yields a function that reports its loss."""


class Connected(NamedTuple):
    """Connected machine: magnets by name, screen, guard, machine file, and notes."""

    magnets: Mapping[str, Device]
    screen: SizeMonitor
    guard: Watchman
    machine: ScanMachine
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Supply:
    """Magnet controlled through EPICS: a set-point and a read-back variable."""

    magnet: Magnet
    setting: Channel
    readback: Channel

    async def put(self, value: float) -> None:
        """As `Device.put`; nothing outside the limits is ever written."""
        magnet = self.magnet
        try:
            await self.setting.put(check_setting(magnet, value))
        except SilentError:
            await self.setting.get()  # raises if the IOC does not answer
            found = f"{magnet.name} not at {value:.6g} {magnet.unit} within {magnet.timeout:g} s"
            expected = "a supply that is on; its IOC answers, but does not say that it is done"
            raise NotSettledError(found, expected) from None

    async def get(self) -> float:
        """As `Device.get`."""
        return _valid(await self.setting.get(), self.magnet.set).value

    async def settled(self, value: float) -> float:
        """As `Device.settled`: returns the mean read-back over the settle time."""
        magnet, clock = self.magnet, time.monotonic
        began, readings, within = clock(), [], None
        pause = min(max(magnet.settle / POLLS, MIN_POLL_INTERVAL), MAX_POLL_INTERVAL)
        while True:
            read = _valid(await self.readback.get(), magnet.read).value
            if abs(read - value) <= magnet.tolerance:
                within = clock() if within is None else within
                readings.append(read)
                if clock() - within >= magnet.settle:
                    break
            else:
                within, readings = None, []
            if clock() - began > magnet.timeout + magnet.settle:
                raise NotSettledError(*_unsettled_words(magnet, value, read))
            await asyncio.sleep(pause)
        # The alarm of an undefined set point may remain after the write, so only the value counts.
        if not np.all(np.abs((await self.setting.get()).value - value) <= magnet.tolerance):
            found = f"{magnet.name} set by someone else while it was scanned"
            raise NotSettledError(found, "nobody else who sets it")
        return float(np.mean(readings))

    def followed(self, value: float) -> AbstractAsyncContextManager[Left]:
        """As `Device.followed`: monitors set point and read-back."""
        magnet = self.magnet

        def wrong(name: str, found: PvReading) -> str:
            if found.good and np.all(np.abs(found.value - value) <= magnet.tolerance):
                return ""
            return f"{magnet.name} left {value:.6g} {magnet.unit}, '{plain(name)}' {found.value}"

        return followed(
            (self.setting, partial(wrong, magnet.set), 0.0),
            (self.readback, partial(wrong, magnet.read), magnet.settle),
        )

    async def standing(self) -> float:
        """Return the setting after checking it against the limits and the read-back."""
        value = check_setting(self.magnet, await self.get())
        await self.settled(value)
        return value


def _valid(reading: PvReading, name: str) -> PvReading:
    if np.ndim(reading.value):
        raise LostError(f"'{plain(name)}' with {np.size(reading.value)} numbers", "one number")
    if not reading.good:
        found = f"'{plain(name)}' reads {reading.value} (severity {reading.severity})"
        raise LostError(found, "a number without an INVALID alarm")
    return reading


def _unsettled_words(magnet: Magnet, value: float, read: float) -> tuple[str, str]:
    """Describe a read-back that does not reach the setting, and the possible cause."""
    found = (
        f"{magnet.name} set to {value:.6g} {magnet.unit}, read back {read:.6g} after "
        f"{magnet.timeout:g} s"
    )
    if abs(read + value) <= magnet.tolerance:
        return found, f"the same sign; is the sign of '{magnet.read}' right?"
    within = f"within {magnet.tolerance:g} for {magnet.settle:g} s"
    said = "its IOC answers: is the supply on"
    return found, f"{within}; {said}, is '{magnet.read}' its read-back?"


@dataclass(frozen=True)
class ScreenShots:
    """Screen read through EPICS: rms sizes, or projections, with new time stamps."""

    profiler: Profiler
    channels: Mapping[str, Channel]

    async def shots(self) -> Shots:
        """As `SizeMonitor.shots`; the planes are read in parallel."""
        found = await asyncio.gather(*map(self._of_plane, self.channels))
        each = dict(zip(self.channels, map(np.array, found), strict=True))
        sizes = {plane: shots[:, 1] for plane, shots in each.items()}
        return Shots(sizes, max(shots[-1, 0] for shots in each.values()))

    async def _of_plane(self, plane: str) -> list[tuple[float, float]]:
        kept: list[tuple[float, float]] = []
        try:
            async with asyncio.timeout(self._patience):
                await self._collect(self.channels[plane], kept)
        except TimeoutError:
            found = f"{len(kept)} of {self.profiler.shots} new shots of {plane} in time"
            expected = f"one at least every {self.profiler.timeout:g} s; are the time stamps new?"
            raise NoSizesError(found, expected) from None
        return kept

    @property
    def _patience(self) -> float:
        return self.profiler.timeout * (1 + self.profiler.shots / 4)

    async def _collect(self, channel: Channel, kept: list[tuple[float, float]]) -> None:
        last, bad = (await channel.get()).time, 0
        async for reading in channel.monitor():
            if reading is None:
                raise LostError(f"'{plain(channel.name)}' is gone", "an IOC that stays")
            if reading.time <= last:
                continue
            last = reading.time
            size = self._size(reading)
            if size is None:
                bad += 1
            else:
                kept.append((last, size))
            if len(kept) == self.profiler.shots:
                return
            if bad > MAX_BAD_RATIO * self.profiler.shots:
                found = f"{bad} shots of '{plain(channel.name)}' without a size"
                raise NoSizesError(found, "a beam that fits on the screen")

    def _size(self, reading: PvReading) -> float | None:
        if not reading.good:
            return None
        if self.profiler.profiles:
            return rms_of(np.atleast_1d(reading.value), self.profiler.pixel)
        size = reading.value * LENGTHS[self.profiler.unit]
        return float(size) if np.ndim(size) == 0 and size > 0 else None


@dataclass(frozen=True)
class BeamGuard:
    """Beam-present and beam-loss variables of EPICS."""

    guard: Guard
    present: Channel | None
    loss: Channel | None

    async def amiss(self) -> str:
        """As `Watchman.amiss`."""
        for channel, wrong, _ in self._each:
            if said := wrong(await channel.get()):
                return said
        return ""

    def followed(self) -> AbstractAsyncContextManager[Left]:
        """As `Watchman.followed`."""
        return followed(*self._each)

    @property
    def _each(self) -> list[tuple[Channel, Callable[[PvReading], str], float]]:
        each = ((self.present, self._no_beam), (self.loss, self._loss))
        return [
            (channel, wrong, LAST_READING_WAIT) for channel, wrong in each if channel is not None
        ]

    def _no_beam(self, found: PvReading) -> str:
        there = found.good and np.all(found.value > self.guard.present_above)
        return "" if there else f"no beam ('{plain(self.guard.present)}' reads {found.value})"

    def _loss(self, found: PvReading) -> str:
        small = found.good and np.all(found.value < self.guard.loss_below)
        return "" if small else f"beam loss ('{plain(self.guard.loss)}' reads {found.value})"


@asynccontextmanager
async def followed(
    *each: tuple[Channel, Callable[[PvReading], str], float],
) -> AsyncIterator[Left]:
    """Monitor variables inside the context.

    Parameters
    ----------
    each : tuple of (Channel, callable, float)
        A variable, a function that describes the fault of a reading ("" if none), and the longest
        wait in s for a reading as new as the last shot.

    Yields
    ------
    callable
        Function of the time stamp of the last shot that returns the first fault.

    Raises
    ------
    LostError
        If a variable does not answer.
    """
    async with AsyncExitStack() as stack:
        all_left = [await stack.enter_async_context(_follow_channel(*one)) for one in each]

        async def left(last: float) -> str:
            return next(filter(None, [await one(last) for one in all_left]), "")

        yield left


@asynccontextmanager
async def _follow_channel(
    channel: Channel, wrong: Callable[[PvReading], str], patience: float
) -> AsyncIterator[Left]:
    said: list[str] = []
    begun = asyncio.Event()

    async def follow() -> None:
        async for reading in channel.monitor():
            words = f"'{plain(channel.name)}' is gone" if reading is None else wrong(reading)
            said.extend([words] * bool(words))
            begun.set()

    def ended(task: asyncio.Task) -> None:  # nothing is monitored after the end of the task
        said.append(f"'{plain(channel.name)}' is followed no more")

    async def left(last: float) -> str:
        until = time.monotonic() + patience
        while not said:  # the answer to `get` arrives after earlier readings of the monitor
            reading = await channel.get()
            if words := wrong(reading):
                return words
            if reading.time >= last or time.monotonic() >= until:
                break
            await asyncio.sleep(MIN_POLL_INTERVAL)
        return "".join(said[:1])

    task = asyncio.create_task(follow())
    task.add_done_callback(ended)
    try:
        with suppress(TimeoutError):
            async with asyncio.timeout(FIRST_READING_WAIT):
                await begun.wait()
        if not begun.is_set():
            found = f"no reading of '{plain(channel.name)}' within {FIRST_READING_WAIT:g} s"
            raise LostError(found, "a variable that can be followed")
        yield left
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def connect(machine: ScanMachine) -> Connected:
    """Connect to a machine; check units, limits and the answer of every variable.

    Parameters
    ----------
    machine : ScanMachine
        Content of the machine file.

    Returns
    -------
    Connected
        With the tighter limits of the file and the control system.

    Raises
    ------
    InputError
        If a variable does not answer, its unit differs from the file, a read-back does not agree
        with its setting, or a magnet is outside the limits.
    """
    notes: list[str] = []
    magnets, supplies = [], {}
    for magnet in machine.magnets:
        supply, said = await check_supply(supply_of(magnet, machine.timeout))
        supplies[magnet.name] = supply
        magnets.append(supply.magnet)
        notes += said
        await supply.standing()
    machine = replace(machine, magnets=tuple(magnets))
    profiler, guard = machine.screen, machine.guard
    names = profiler.sizes or profiler.profiles
    screen = {plane: open_channel(name, machine.timeout) for plane, name in names.items()}
    for channel in screen.values():
        await channel.get()
        if profiler.sizes:
            given = (await channel.describe()).unit
            note = check_unit(given, channel.name, profiler.unit, UNITS["length"])
            notes += [note] * bool(note)
    watchmen = [
        None if name is None else open_channel(name, machine.timeout)
        for name in (guard.present, guard.loss)
    ]
    ready = BeamGuard(guard, *watchmen)
    await ready.amiss()
    return Connected(supplies, ScreenShots(profiler, screen), ready, machine, tuple(notes))


def supply_of(magnet: Magnet, timeout: float) -> Supply:
    """Open the variables of a magnet; writing may take as long as the magnet needs to settle."""
    return Supply(
        magnet, open_channel(magnet.set, magnet.timeout), open_channel(magnet.read, timeout)
    )


async def check_supply(supply: Supply) -> tuple[Supply, list[str]]:
    """Check unit and limits of a magnet; return it with the tighter limits, and notes.

    Raises
    ------
    InputError
        If unit or limits contradict the file.
    """
    magnet = supply.magnet
    setting = await supply.setting.describe()
    readback = await supply.readback.describe()
    for name, unit in ((supply.readback.name, readback.unit), (supply.setting.name, setting.unit)):
        if unit and (unit_of(unit) or unit) != magnet.unit:
            said = f"'{plain(name)}' in '{plain(unit)}'"
            raise InputError(said, f"{magnet.unit}, as the machine file says of {magnet.name}")
    low, high = max(magnet.low, setting.low), min(magnet.high, setting.high)
    if not low < high:
        found = f"limits {setting.low:g} to {setting.high:g} of '{plain(magnet.set)}'"
        raise InputError(found, f"some of {magnet.low:g} to {magnet.high:g}, of the machine file")
    if (low, high) == (magnet.low, magnet.high):
        return supply, []
    magnet = replace(magnet, low=low, high=high)
    if not magnet.tolerance < 0.1 * (magnet.span[1] - magnet.span[0]):
        found = f"tolerance {magnet.tolerance:g} of {magnet.name} within {low:g} to {high:g}"
        raise InputError(found, "less than a tenth of what the control system lets it move")
    for value in magnet.degauss:
        check_setting(magnet, value)
    said = f"Limits of {magnet.name}: {low:g} to {high:g} {magnet.unit}, of the control system."
    return replace(supply, magnet=magnet), [said]


def rms_of(counts: np.ndarray, pixel: float) -> float | None:
    """Rms size of a projection from a Gaussian on a constant background.

    Parameters
    ----------
    counts : ndarray
        Shape (n,), the projection.
    pixel : float
        Size of a pixel at the screen, m.

    Returns
    -------
    float or None
        Size in m; None without a beam, for a spot too large for the screen, or for a saturated one.

    Notes
    -----
    Least squares of h exp(-(x - x0)²/(2 s²)) + c, the size most laboratories quote; moments depend
    on the cut of the background.

    Examples
    --------
    >>> x = np.arange(200.0)
    >>> round(1e6 * rms_of(900 * np.exp(-0.5 * ((x - 90) / 12) ** 2) + 20, 10e-6), 3)
    120.0
    """
    n = counts.size
    if n < 8 or not np.isfinite(counts).all():
        return None
    place, few = np.arange(n, dtype=float), max(int(BACKGROUND_FRACTION * n), 2)
    ends = np.concatenate([counts[:few], counts[-few:]])
    level, scatter = float(np.median(ends)), float(np.std(ends))
    height = float(counts.max() - level)
    if height <= MIN_SIGNAL * scatter or height <= 0:
        return None
    above = counts - level > 0.5 * height
    width = max(above.sum() / 2.355, 1.0)
    start = (height, float(place[above].mean()), width, level)
    try:
        found, _ = curve_fit(_gaussian, place, counts, start, maxfev=400)
    except RuntimeError:  # no minimum within 400 evaluations
        return None
    size = abs(float(found[2]))
    inside = 0 < found[1] < n - 1 and found[0] > 0 and 0.3 < size < n / 4
    flat = np.count_nonzero(counts - level > 0.99 * height) > FLAT_PIXELS + FLAT_WIDTH * size
    return size * pixel if inside and not flat else None


def _gaussian(x: np.ndarray, height: float, middle: float, size: float, level: float) -> np.ndarray:
    return height * np.exp(-0.5 * ((x - middle) / size) ** 2) + level
