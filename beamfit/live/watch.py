"""Following a beam: readings as they come, given to a watch. Nothing is ever written."""

from __future__ import annotations

import asyncio
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from beamfit.io.machine import Watched, WatchMachine
from beamfit.live.channel import Channel, LostError, Reading, kept, open_channel
from beamfit.status import Status
from beamfit.studies.decay.watch import CURRENT, RULE, Plan, State, noted, stepped
from beamfit.table import cell, json_of

# Without a reading for so long, or so many usual intervals, what is shown is old, s.
STALE, INTERVALS = 10.0, 5.0
# Readings are taken together every so often, and shown, s.
TAKEN, SHOWN = 0.2, 1.0
# Readings that wait for a fit to end.
WAITING = 100_000


@dataclass(frozen=True)
class Told:
    """What is known at a moment.

    Attributes
    ----------
    plan, state
        What is watched, and what the readings say.
    lost : tuple of str
        Variables that do not answer.
    silent : float or None
        For how long there has been no reading of the current, s; None while there are.
    """

    plan: Plan
    state: State
    lost: tuple[str, ...] = ()
    silent: float | None = None

    @property
    def sound(self) -> bool:
        """Whether the numbers are of now."""
        return self.silent is None and self.state.answer is not None

    @property
    def headline(self) -> tuple[str, str]:
        """Its colour, and what to look at first."""
        state, answer = self.state, self.state.answer
        if self.silent is not None:
            return "red", f"No reading of the current for {self.silent:.0f} s: all below is old"
        if self.lost:
            return "red", f"No connection to {', '.join(self.lost)}"
        if state.alarmed:
            return "red", f"Alarm: {state.said()}"
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
                "moved": state.alarmed, "text": state.said(), "rule": RULE,
                "since": state.alarms[-1].since if state.alarms else None,
            },
            "lost": self.lost, "silent": self.silent, "window": self.plan.window,
            "course": [tuple(point) for point in state.course],
            "events": state.events[::-1], "counts": state.counts,
        })  # fmt: skip


@dataclass
class _Course:
    """A watch that goes on."""

    plan: Plan
    queue: asyncio.Queue[tuple[Watched, Reading | None]]
    state: State = field(default_factory=State)
    lost: dict[str, bool] = field(default_factory=dict)
    arrived: float = field(default_factory=time.monotonic)
    apart: float = 0.0

    def told(self) -> Told:
        """What is known now."""
        silent = time.monotonic() - self.arrived
        still = silent <= max(STALE, INTERVALS * self.apart)
        lost = tuple(name for name, gone in self.lost.items() if gone)
        return Told(self.plan, self.state, lost, None if still else silent)

    async def take(self) -> None:
        """All readings that wait; a fit leaves the page and the served variables alive."""
        batch: list[tuple[Watched, Reading | None]] = []
        with suppress(TimeoutError):
            batch.append(await asyncio.wait_for(self.queue.get(), TAKEN))
        while not self.queue.empty():
            batch.append(self.queue.get_nowait())
        for watched, reading in batch:
            self._seen(watched, reading)
        readings = [(watched, reading) for watched, reading in batch if reading is not None]
        self.state = await asyncio.to_thread(_stepped, self.plan, self.state, readings)

    def _seen(self, watched: Watched, reading: Reading | None) -> None:
        gone = reading is None
        if self.lost.get(watched.variable, False) != gone:
            said = f"{'no' if gone else 'again a'} connection to {watched.variable}"
            self.state = noted(self.state, time.time(), said)
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
            if watched.quantity == CURRENT and reading is not None:
                now = time.monotonic()
                self.apart += 0.1 * (now - self.arrived - self.apart)
                self.arrived = now
            kept(self.queue, (watched, reading))


def _stepped(plan: Plan, state: State, readings: Sequence[tuple[Watched, Reading]]) -> State:
    for watched, reading in readings:
        scalar = reading.good and np.ndim(reading.value) == 0
        value = watched.factor * float(reading.value) if scalar else float("nan")
        state = stepped(plan, state, watched.quantity, reading.time, value)
    return state


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
    show: Callable[[Told], None],
    seconds: float | None = None,
) -> tuple[Told, int]:
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
        How long; for good unless said.

    Returns
    -------
    Told, int
        What is known at the end, and the signal that ended it, 0 for none.
    """
    queue: asyncio.Queue[tuple[Watched, Reading | None]] = asyncio.Queue(WAITING)
    course = _Course(plan, queue)
    followers = [
        asyncio.create_task(course.follow(one, open_channel(one.variable, machine.timeout)))
        for one in machine.variables
    ]
    begun, shown = time.monotonic(), -SHOWN
    try:
        with _signals() as came:
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


@contextmanager
def _signals() -> Iterator[list[int]]:
    """What came; a second one ends the process as it would any."""
    came: list[int] = []
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def stop(number: int, frame: Any) -> None:
        came.append(number)
        signal.signal(number, before[number])

    for number in before:
        signal.signal(number, stop)
    try:
        yield came
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
