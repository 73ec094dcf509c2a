"""Watch of a beam: readings of the control system, passed to `beamfit.lifetime.watch`."""

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
from beamfit.live.channel import Channel, LostError, PvReading, open_channel, put_latest
from beamfit.live.restore import ended_by_signals

# Time without a reading after which the view is out of date: this many seconds, or this many
# typical intervals.
STALE_AFTER = 10.0
STALE_INTERVALS = 5.0
# Longest wait for a batch of readings, and time between updates of the view, s.
BATCH_WAIT = 0.2
SHOW_EVERY = 1.0
# Largest number of readings queued during a fit.
MAX_QUEUE = 100_000


@dataclass(frozen=True)
class WatchView:
    """State of a watch at one moment.

    Attributes
    ----------
    plan, state
        Plan of the watch, and its state after the readings.
    lost : tuple of str
        Variables that do not answer.
    silent : float or None
        Time since the last reading of the current in s, if it is too long; otherwise None.
    age : float or None
        Age of the newest fitted reading in s; None before the first fit.
    old : bool
        True if the age exceeds the fit interval plus the allowed time without readings.
    """

    plan: Plan
    state: State
    lost: tuple[str, ...] = ()
    silent: float | None = None
    age: float | None = None
    old: bool = False

    @property
    def sound(self) -> bool:
        """True if the numbers are up to date."""
        return self.silent is None and not self.old and self.state.answer is not None

    @property
    def headline(self) -> tuple[str, str]:
        """Colour, and the most important message."""
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
        """Return the content of the page."""
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
    """Reading of a variable (None for a lost connection), and its time of arrival in s."""

    watched: Watched
    reading: PvReading | None
    at: float


@dataclass
class _RunningWatch:
    """State of a running watch."""

    plan: Plan
    queue: asyncio.Queue[Arrived]
    state: State = field(default_factory=State)
    lost: dict[str, bool] = field(default_factory=dict)
    arrived: float = field(default_factory=time.monotonic)
    apart: float = 0.0
    fitted: float | None = None

    def view(self) -> WatchView:
        """Return the present view."""
        now, patience = time.monotonic(), max(STALE_AFTER, STALE_INTERVALS * self.apart)
        silent = now - self.arrived if now - self.arrived > patience else None
        age = None if self.fitted is None else now - self.fitted
        old = age is not None and age > self.plan.every + patience
        lost = tuple(name for name, gone in self.lost.items() if gone)
        return WatchView(self.plan, self.state, lost, silent, age, old)

    async def take(self) -> None:
        """Process all queued readings in a thread, so that the page stays responsive."""
        batch: list[Arrived] = []
        with suppress(TimeoutError):
            batch.append(await asyncio.wait_for(self.queue.get(), BATCH_WAIT))
        while not self.queue.empty():
            batch.append(self.queue.get_nowait())
        for one in batch:
            self._note_connection(one.watched, one.reading)
        self.state, fitted = await asyncio.to_thread(_stepped, self.plan, self.state, batch)
        self.fitted = fitted or self.fitted

    def _note_connection(self, watched: Watched, reading: PvReading | None) -> None:
        gone = reading is None
        if self.lost.get(watched.variable, False) != gone:
            said = f"{'no' if gone else 'again a'} connection to {watched.variable}"
            self.state = add_event(self.state, time.time(), said)
        self.lost[watched.variable] = gone

    async def follow(self, watched: Watched, channel: Channel) -> None:
        """Queue the readings of a variable as they arrive, also during long fits."""
        lost = False
        async for reading in channel.monitor():
            lost = lost or reading is None
            if lost and reading is not None:  # an IOC may return with another unit
                with suppress(LostError):
                    watched.check((await channel.describe()).unit)
                    lost = False
            now = time.monotonic()
            if watched.quantity == CURRENT and reading is not None:
                self.apart += 0.1 * (now - self.arrived - self.apart)
                self.arrived = now
            put_latest(self.queue, Arrived(watched, reading, now))


def _stepped(plan: Plan, state: State, batch: Sequence[Arrived]) -> tuple[State, float | None]:
    """Return the state after some readings, and the arrival time of the newest fitted one."""
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
    """Check that every variable answers, in the unit of the machine file.

    Parameters
    ----------
    machine : WatchMachine
        Machine to watch.

    Returns
    -------
    list of str
        Notes on unknown units.

    Raises
    ------
    InputError
        If a variable does not answer, or has another unit.
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
    """Watch until the time is over, or a signal ends it.

    Parameters
    ----------
    machine : WatchMachine
        Machine to watch.
    plan : Plan
        Plan of the watch.
    show : callable
        Called every second with the present view.
    seconds : float, optional
        Duration; default: without end.

    Returns
    -------
    WatchView, int
        View at the end, and the signal that ended it, 0 for none.
    """
    queue: asyncio.Queue[Arrived] = asyncio.Queue(MAX_QUEUE)
    running = _RunningWatch(plan, queue)
    followers = [
        asyncio.create_task(running.follow(one, open_channel(one.variable, machine.timeout)))
        for one in machine.variables
    ]
    begun, shown, over = time.monotonic(), -SHOW_EVERY, asyncio.get_running_loop().create_future()
    try:
        with ended_by_signals(over, lambda text: None) as came:
            while not came and (seconds is None or time.monotonic() - begun < seconds):
                await running.take()
                for task in followers:
                    if task.done():
                        task.result()
                if (now := time.monotonic()) - shown >= SHOW_EVERY:
                    show(running.view())
                    shown = now
            return running.view(), came[0] if came else 0
    finally:
        for task in followers:
            task.cancel()
        await asyncio.gather(*followers, return_exceptions=True)
