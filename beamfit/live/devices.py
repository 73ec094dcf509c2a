"""Devices of a scan by EPICS: magnets, a screen and a guard."""

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

# Of the time a read-back has to stay, between two looks at it; not shorter, not longer, s.
LOOKS, SHORTEST, LONGEST = 8, 0.02, 0.25
# Seconds for which a reading of the beam as new as the last shot is waited for: a variable that
# does not change may send none. Seconds for the first reading of a variable that is followed.
AFTER, FIRST = 1.0, 5.0
# Bad shots of a plane, over those wanted, after which there is no beam on the screen.
BAD = 2
# Heights over the scatter of the background below which a projection shows no beam.
SEEN = 5.0
# A Gaussian is within 1 % of its height over 0.28 of its size: a top wider than this, and some
# pixels, is cut off by the camera.
FLAT, PIXELS = 0.6, 2
# Share of the projection at either end that is background, to begin with.
ENDS = 0.1


class NotSettledError(InputError):
    """A magnet whose read-back does not come to its setting, or does not stay there."""


class NoSizesError(InputError):
    """A screen that shows no new sizes, or none that are numbers."""


class Shots(NamedTuple):
    """New shots: rms sizes by plane, m, and the time stamp of the last one, Unix time in s."""

    sizes: Mapping[str, np.ndarray]
    time: float


# Asked with the time stamp of the last shot: how something left what it had to be, "" if it stayed.
Left = Callable[[float], Awaitable[str]]


class Device(Protocol):
    """Magnet that can be moved, of any control system or of a simulation."""

    async def put(self, value: float) -> None:
        """Begin to move it to a setting, and return when it says that it is there."""

    async def get(self) -> float:
        """Its setting, as `put` would restore it."""

    async def settled(self, value: float) -> float:
        """Wait until it has arrived and stays, and give what is read back.

        Raises
        ------
        NotSettledError
            If it does not.
        """

    def followed(self, value: float) -> AbstractAsyncContextManager[Left]:
        """Follow it while the block lasts, and say in the end how it left a setting."""


class SizeMonitor(Protocol):
    """Screen that measures the beam at a setting."""

    async def shots(self) -> Shots:
        """Take new shots.

        Raises
        ------
        NoSizesError
            If there are none.
        """


class Watchman(Protocol):
    """Guard that tells whether there is beam, and none of it is lost."""

    async def amiss(self) -> str:
        """Fault in words; "" if there is none."""

    def followed(self) -> AbstractAsyncContextManager[Left]:
        """Follow the beam while the block lasts, and say in the end how it was lost."""


class Connected(NamedTuple):
    """A machine at hand: magnets by name, screen, guard, and what was found besides."""

    magnets: Mapping[str, Device]
    screen: SizeMonitor
    guard: Watchman
    machine: ScanMachine
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Supply:
    """A magnet by EPICS: one variable to set it, one to read it back."""

    magnet: Magnet
    setting: Channel
    readback: Channel

    async def put(self, value: float) -> None:
        """As `Device.put`; nothing outside the limits is ever written."""
        magnet = self.magnet
        try:
            await self.setting.put(check_setting(magnet, value))
        except SilentError:
            await self.setting.get()  # or its IOC is what does not answer
            found = f"{magnet.name} not at {value:.6g} {magnet.unit} within {magnet.timeout:g} s"
            expected = "a supply that is on; its IOC answers, but does not say that it is done"
            raise NotSettledError(found, expected) from None

    async def get(self) -> float:
        """As `Device.get`."""
        return _sound(await self.setting.get(), self.magnet.set).value

    async def settled(self, value: float) -> float:
        """As `Device.settled`: the mean over the time for which it has to stay."""
        magnet, clock = self.magnet, time.monotonic
        began, seen, within = clock(), [], None
        pause = min(max(magnet.settle / LOOKS, SHORTEST), LONGEST)
        while True:
            read = _sound(await self.readback.get(), magnet.read).value
            if abs(read - value) <= magnet.tolerance:
                within = clock() if within is None else within
                seen.append(read)
                if clock() - within >= magnet.settle:
                    break
            else:
                within, seen = None, []
            if clock() - began > magnet.timeout + magnet.settle:
                raise NotSettledError(*_unsettled(magnet, value, read))
            await asyncio.sleep(pause)
        # Its alarm may outlive the write that defined it: the number and the read-back count.
        if not np.all(np.abs((await self.setting.get()).value - value) <= magnet.tolerance):
            found = f"{magnet.name} set by someone else while it was scanned"
            raise NotSettledError(found, "nobody else who sets it")
        return float(np.mean(seen))

    def followed(self, value: float) -> AbstractAsyncContextManager[Left]:
        """As `Device.followed`: by set point and read-back."""
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
        """Its setting, if that is within the limits and is what is read back."""
        value = check_setting(self.magnet, await self.get())
        await self.settled(value)
        return value


def _sound(reading: PvReading, name: str) -> PvReading:
    if np.ndim(reading.value):
        raise LostError(f"'{plain(name)}' with {np.size(reading.value)} numbers", "one number")
    if not reading.good:
        found = f"'{plain(name)}' reads {reading.value} (severity {reading.severity})"
        raise LostError(found, "a number without an INVALID alarm")
    return reading


def _unsettled(magnet: Magnet, value: float, read: float) -> tuple[str, str]:
    """Behaviour of a read-back that does not arrive, and where to look."""
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
    """A screen by EPICS: rms sizes, or projections whose rms is taken, with new time stamps."""

    profiler: Profiler
    channels: Mapping[str, Channel]

    async def shots(self) -> Shots:
        """As `SizeMonitor.shots`; the planes at the same time."""
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
            if bad > BAD * self.profiler.shots:
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
    """Beam-present and beam-loss variables by EPICS."""

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
        return [(channel, wrong, AFTER) for channel, wrong in each if channel is not None]

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
    """Follow variables while the block lasts.

    Parameters
    ----------
    each : tuple of (Channel, callable, float)
        A variable, what is wrong with a reading of it in words, and how long at most, in s, a
        reading as new as the last shot is waited for in the end.

    Yields
    ------
    callable
        Says what was wrong first, asked with the time stamp of the last shot.

    Raises
    ------
    LostError
        If one does not answer.
    """
    async with AsyncExitStack() as stack:
        all_left = [await stack.enter_async_context(_followed(*one)) for one in each]

        async def left(last: float) -> str:
            return next(filter(None, [await one(last) for one in all_left]), "")

        yield left


@asynccontextmanager
async def _followed(
    channel: Channel, wrong: Callable[[PvReading], str], patience: float
) -> AsyncIterator[Left]:
    said: list[str] = []
    begun = asyncio.Event()

    async def follow() -> None:
        async for reading in channel.monitor():
            words = f"'{plain(channel.name)}' is gone" if reading is None else wrong(reading)
            said.extend([words] * bool(words))
            begun.set()

    def ended(task: asyncio.Task) -> None:  # whatever ends it sees no more
        said.append(f"'{plain(channel.name)}' is followed no more")

    async def left(last: float) -> str:
        until = time.monotonic() + patience
        while not said:  # an answer comes behind whatever the monitor sent before it
            reading = await channel.get()
            if words := wrong(reading):
                return words
            if reading.time >= last or time.monotonic() >= until:
                break
            await asyncio.sleep(SHORTEST)
        return "".join(said[:1])

    task = asyncio.create_task(follow())
    task.add_done_callback(ended)
    try:
        with suppress(TimeoutError):
            async with asyncio.timeout(FIRST):
                await begun.wait()
        if not begun.is_set():
            found = f"no reading of '{plain(channel.name)}' within {FIRST:g} s"
            raise LostError(found, "a variable that can be followed")
        yield left
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def connect(machine: ScanMachine) -> Connected:
    """Connect to a machine, and check units, limits and that every variable answers.

    Parameters
    ----------
    machine : ScanMachine
        As read from its file.

    Returns
    -------
    Connected
        Limits are those of the file or the control system, whichever are tighter.

    Raises
    ------
    InputError
        If a variable does not answer, has another unit than the file says, a read-back does not
        agree with its setting, or a magnet is outside the limits already.
    """
    notes: list[str] = []
    magnets, supplies = [], {}
    for magnet in machine.magnets:
        supply, said = await checked(supply_of(magnet, machine.timeout))
        supplies[magnet.name] = supply
        magnets.append(supply.magnet)
        notes += said
        await supply.standing()
    machine = replace(machine, magnets=tuple(magnets))
    wanted, guard = machine.screen, machine.guard
    names = wanted.sizes or wanted.profiles
    screen = {plane: open_channel(name, machine.timeout) for plane, name in names.items()}
    for channel in screen.values():
        await channel.get()
        if wanted.sizes:
            given = (await channel.describe()).unit
            note = check_unit(given, channel.name, wanted.unit, UNITS["length"])
            notes += [note] * bool(note)
    watchmen = [
        None if name is None else open_channel(name, machine.timeout)
        for name in (guard.present, guard.loss)
    ]
    ready = BeamGuard(guard, *watchmen)
    await ready.amiss()
    return Connected(supplies, ScreenShots(wanted, screen), ready, machine, tuple(notes))


def supply_of(magnet: Magnet, timeout: float) -> Supply:
    """A magnet's variables; writing may take as long as the magnet needs to arrive."""
    return Supply(
        magnet, open_channel(magnet.set, magnet.timeout), open_channel(magnet.read, timeout)
    )


async def checked(supply: Supply) -> tuple[Supply, list[str]]:
    """A magnet with the tighter limits, and what to say of them.

    Raises
    ------
    InputError
        If it has another unit or other limits than the file says.
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
    """Rms size of a projection: that of a Gaussian on a level background.

    Parameters
    ----------
    counts : ndarray
        Shape (n,), the projection.
    pixel : float
        Size of a pixel at the screen, m.

    Returns
    -------
    float or None
        m; None where there is no beam, its spot does not fit on the screen, or its top is cut off.

    Notes
    -----
    Least squares of h exp(-(x - x0)²/(2 s²)) + c, the size most laboratories quote; moments depend
    on where the background is cut.

    Examples
    --------
    >>> x = np.arange(200.0)
    >>> round(1e6 * rms_of(900 * np.exp(-0.5 * ((x - 90) / 12) ** 2) + 20, 10e-6), 3)
    120.0
    """
    n = counts.size
    if n < 8 or not np.isfinite(counts).all():
        return None
    place, few = np.arange(n, dtype=float), max(int(ENDS * n), 2)
    ends = np.concatenate([counts[:few], counts[-few:]])
    level, scatter = float(np.median(ends)), float(np.std(ends))
    height = float(counts.max() - level)
    if height <= SEEN * scatter or height <= 0:
        return None
    above = counts - level > 0.5 * height
    width = max(above.sum() / 2.355, 1.0)
    start = (height, float(place[above].mean()), width, level)
    try:
        found, _ = curve_fit(_gaussian, place, counts, start, maxfev=400)
    except RuntimeError:  # which has no minimum within 400 steps
        return None
    size = abs(float(found[2]))
    inside = 0 < found[1] < n - 1 and found[0] > 0 and 0.3 < size < n / 4
    flat = np.count_nonzero(counts - level > 0.99 * height) > PIXELS + FLAT * size
    return size * pixel if inside and not flat else None


def _gaussian(x: np.ndarray, height: float, middle: float, size: float, level: float) -> np.ndarray:
    return height * np.exp(-0.5 * ((x - middle) / size) ** 2) + level
