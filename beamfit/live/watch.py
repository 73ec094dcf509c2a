"""Following a beam: readings as they come, given to a watch. Nothing is ever written."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from beamfit.answer import cell, json_of
from beamfit.errors import Status
from beamfit.io.machine import Watched, WatchMachine
from beamfit.lifetime.watch import CURRENT, RULE, Plan, State, add_event, stepped
from beamfit.live.channel import Channel, LostError, PvReading, kept, open_channel
from beamfit.live.restore import ended_by_signals

# Without a reading for so long, or so many usual intervals, what is shown is old, s.
STALE, INTERVALS = 10.0, 5.0
# Readings are taken together every so often, and shown, s.
TAKEN, SHOWN = 0.2, 1.0
# Readings that wait for a fit to end.
WAITING = 100_000


@dataclass(frozen=True)
class WatchView:
    """Knowledge at a moment.

    Attributes
    ----------
    plan, state
        What is watched, and what the readings say.
    lost : tuple of str
        Variables that do not answer.
    silent : float or None
        For how long there has been no reading of the current, s; None while there are.
    age : float or None
        How long ago the newest reading that is fitted came, s; None before the first fit.
    old : bool
        Whether that is longer than fits are apart, and readings may be silent.
    """

    plan: Plan
    state: State
    lost: tuple[str, ...] = ()
    silent: float | None = None
    age: float | None = None
    old: bool = False

    @property
    def sound(self) -> bool:
        """Tell numbers that are of now."""
        return self.silent is None and not self.old and self.state.answer is not None

    @property
    def headline(self) -> tuple[str, str]:
        """Its colour, and what to look at first."""
        state, answer = self.state, self.state.answer
        gone = f"No connection to {', '.join(self.lost)}" if self.lost else ""
        if self.silent is not None:
            old = f"o reading of the current for {self.silent:.0f} s: all below is old"
            return "red", f"{gone}, n{old}" if gone else f"N{old}"
        if self.old:
            return "red", f"The newest reading fitted is {self.age:.0f} s old: fits fall behind"
        if gone:
            return "red", gone
        if state.alarmed:
            return "red", f"Alarm: {state.alarm_text()}"
        if answer is None and not state.last and state.counts.bad:
            return "red", f"{state.counts.bad} readings without a number, none of a current"
        if answer is None:
            left = max(0.0, state.due - state.last) if state.last else self.plan.every
            return "yellow", f"The first fit comes in {left:.0f} s"
        moved = "nothing moved" if state.alarm else "no alarm yet"
        return answer.status.colour, f"{cell(answer.status)}, {moved}"

    def to_json(self) -> dict[str, Any]:
        """Return what the page shows."""
        state, answer = self.state, self.state.answer
        colour, headline = self.headline
        names = ("lifetime", "a", "b", "normalised")
        found = {name: getattr(answer, name, None) for name in names}
        fit = answer and answer.window.fit
        return json_of({
            "name": self.plan.name, "colour": colour, "headline": headline,
            "status": answer.status if answer else Status.unidentified,
            "message": answer.message if answer else "", "sound": self.sound,
            "time": state.last and state.last - state.shift,
            "current": state.rows[-1].current if state.rows else None,
            "mean_current": fit and fit.mean_current,
            "quantities": {n: q and q.to_json() | {"text": cell(q)} for n, q in found.items()},
            "alarm": {
                "moved": state.alarmed, "text": state.alarm_text(), "rule": RULE,
                "since": state.alarms[-1].since if state.alarms else None,
            },
            "lost": self.lost, "silent": self.silent, "age": self.age, "window": self.plan.window,
            "course": [tuple(point) for point in state.course],
            "events": state.events[::-1], "counts": state.counts,
        })  # fmt: skip


class Arrived(NamedTuple):
    """A reading of a variable, None where its connection was lost, and when it came, s."""

    watched: Watched
    reading: PvReading | None
    at: float


@dataclass
class _Course:
    """A watch that goes on."""

    plan: Plan
    queue: asyncio.Queue[Arrived]
    state: State = field(default_factory=State)
    lost: dict[str, bool] = field(default_factory=dict)
    arrived: float = field(default_factory=time.monotonic)
    apart: float = 0.0
    fitted: float | None = None

    def told(self) -> WatchView:
        """Knowledge now."""
        now, patience = time.monotonic(), max(STALE, INTERVALS * self.apart)
        silent = now - self.arrived if now - self.arrived > patience else None
        age = None if self.fitted is None else now - self.fitted
        old = age is not None and age > self.plan.every + patience
        lost = tuple(name for name, gone in self.lost.items() if gone)
        return WatchView(self.plan, self.state, lost, silent, age, old)

    async def take(self) -> None:
        """All readings that wait; a fit leaves the page and the served variables alive."""
        batch: list[Arrived] = []
        with suppress(TimeoutError):
            batch.append(await asyncio.wait_for(self.queue.get(), TAKEN))
        while not self.queue.empty():
            batch.append(self.queue.get_nowait())
        for one in batch:
            self._seen(one.watched, one.reading)
        self.state, fitted = await asyncio.to_thread(_stepped, self.plan, self.state, batch)
        self.fitted = fitted or self.fitted

    def _seen(self, watched: Watched, reading: PvReading | None) -> None:
        gone = reading is None
        if self.lost.get(watched.variable, False) != gone:
            said = f"{'no' if gone else 'again a'} connection to {watched.variable}"
            self.state = add_event(self.state, time.time(), said)
        self.lost[watched.variable] = gone

    async def follow(self, watched: Watched, channel: Channel) -> None:
        """Have readings wait as they come; that fits take long is no silence of the current."""
        lost = False
        async for reading in channel.monitor():
            lost = lost or reading is None
            if lost and reading is not None:  # an IOC may come back with another unit
                with suppress(LostError):
                    watched.check((await channel.describe()).unit)
                    lost = False
            now = time.monotonic()
            if watched.quantity == CURRENT and reading is not None:
                self.apart += 0.1 * (now - self.arrived - self.apart)
                self.arrived = now
            kept(self.queue, Arrived(watched, reading, now))


def _stepped(plan: Plan, state: State, batch: Sequence[Arrived]) -> tuple[State, float | None]:
    """The state after some readings, and when the newest that was fitted came."""
    fitted = None
    for watched, reading, arrived in batch:
        if reading is None:
            continue
        scalar = reading.good and np.ndim(reading.value) == 0
        value = watched.factor * float(reading.value) if scalar else float("nan")
        before, state = state, stepped(plan, state, watched.quantity, reading.time, value)
        fitted = fitted if state.answer is before.answer else arrived
    return state, fitted


async def connect(machine: WatchMachine) -> list[str]:
    """See that every variable answers, in the unit of the machine file.

    Parameters
    ----------
    machine : WatchMachine
        What to watch.

    Returns
    -------
    list of str
        Notes on units that nobody knows.

    Raises
    ------
    InputError
        If one does not answer, or has another unit.
    """
    channels = [open_channel(one.variable, machine.timeout) for one in machine.variables]
    described = await asyncio.gather(*(channel.describe() for channel in channels))
    notes = [one.check(d.unit) for one, d in zip(machine.variables, described, strict=True)]
    return [note for note in notes if note]


async def watch(
    machine: WatchMachine,
    plan: Plan,
    show: Callable[[WatchView], None],
    seconds: float | None = None,
) -> tuple[WatchView, int]:
    """Watch until the time is over, or somebody ends it.

    Parameters
    ----------
    machine : WatchMachine
        What to watch.
    plan : Plan
        How.
    show : callable
        Is given what is known, every second.
    seconds : float, optional
        Duration; default: without end.

    Returns
    -------
    WatchView, int
        What is known at the end, and the signal that ended it, 0 for none.
    """
    queue: asyncio.Queue[Arrived] = asyncio.Queue(WAITING)
    course = _Course(plan, queue)
    followers = [
        asyncio.create_task(course.follow(one, open_channel(one.variable, machine.timeout)))
        for one in machine.variables
    ]
    begun, shown, over = time.monotonic(), -SHOWN, asyncio.get_running_loop().create_future()
    try:
        with ended_by_signals(over, lambda text: None) as came:
            while not came and (seconds is None or time.monotonic() - begun < seconds):
                await course.take()
                for task in followers:
                    if task.done():
                        task.result()
                if (now := time.monotonic()) - shown >= SHOWN:
                    show(course.told())
                    shown = now
            return course.told(), came[0] if came else 0
    finally:
        for task in followers:
            task.cancel()
        await asyncio.gather(*followers, return_exceptions=True)
