"""A stored beam watched reading by reading: its lifetime over a sliding window, and what moved.

Pure: a state and a step. Memory is that of the window, whatever the time and the rate of readings.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from beamfit.errors import InputError
from beamfit.lifetime import alarm
from beamfit.lifetime.course import BEST_MONITOR
from beamfit.lifetime.pieces import DROPOUT, GAP
from beamfit.lifetime.record import PLAUSIBLE, Conditions
from beamfit.lifetime.sliding_fit import (
    Alarmed,
    Answer,
    Window,
    WindowRow,
    fit_window,
    followed,
    learnt,
    normalised,
)
from beamfit.lifetime.study import Machine
from beamfit.quantity import Status

CURRENT = "beam_current"
# Dead readings in a row from which the beam is gone.
DEAD = 5
# A window is kept as the means of readings over so many parts of it.
ROWS = 4096
# So many readings in a row, each older than the newest before them, are of a clock set back.
LATE = 5
# Beyond what a ring stores, mA, or a clock shows, s, a reading is none.
MOST, LATEST = (math.inf, 1e6), 1e11
# Events and points of the course that are kept.
EVENTS, POINTS = 20, 360
RULE = (
    "raised where a change of a or b is so much likelier than none that one in 1e6 readings "
    "at most is false (none in 9e6 simulated, benchmarks/alarm.py)"
)


class Plan(NamedTuple):
    """Plan of a watch.

    Attributes
    ----------
    name : str
        Of the ring.
    window, every : float
        Length of the sliding window, and time from fit to fit, s.
    machine : Machine or None
        The ring, by which lifetimes are normalised and expected.
    current : float or None
        To which lifetimes are normalised, mA; without it that of the first fit.
    """

    name: str = "ring"
    window: float = 7200.0
    every: float = 10.0
    machine: Machine | None = None
    current: float | None = None


class Counts(NamedTuple):
    """Readings of all variables; those without a number, those that came late; gaps and steps."""

    readings: int = 0
    bad: int = 0
    late: int = 0
    gaps: int = 0
    clock: int = 0


class Point(NamedTuple):
    """One fit, for a picture: time, s, current, mA, lifetime and its error, h; NaN where none."""

    time: float
    current: float
    lifetime: float
    error: float


class State(NamedTuple):
    """State of a watch between readings.

    Attributes
    ----------
    rows : tuple of WindowRow
        The window.
    sums : tuple
        Of the row that grows: readings, where it begins, sums of time since then and of current.
    last, shift, interval : float or None
        Time of the last reading, what is added to times since the clock was set back, and the
        usual interval, s.
    piece, dead, spikes, late : int, int, int, tuple
        As of `WindowRow`; readings in a row without beam or far too high, or late, and the last
        late one.
    settings : Conditions
        Last ones read, in SI.
    highest, noise, due : float
        Highest current of the window and noise of a reading, mA; when to fit, s.
    counts, events, course, answer
        What happened, with its time; what was found.
    alarm, alarms : Alarmed or None, tuple of Alarm
        None until the usual loss is known; those within the window.
    """

    rows: tuple[WindowRow, ...] = ()
    sums: tuple[int, float, float, float] = (0, 0.0, 0.0, 0.0)
    last: float | None = None
    shift: float = 0.0
    interval: float = 0.0
    piece: int = 0
    dead: int = 0
    spikes: int = 0
    late: tuple[int, float] = (0, -math.inf)
    settings: Conditions = Conditions(*[math.nan] * len(Conditions._fields))
    highest: float = 0.0
    noise: float = math.inf
    due: float = -math.inf
    counts: Counts = Counts()
    events: tuple[tuple[float, str], ...] = ()
    course: tuple[Point, ...] = ()
    answer: Answer | None = None
    alarm: Alarmed | None = None
    alarms: tuple[alarm.Alarm, ...] = ()

    @property
    def alarmed(self) -> str:
        """Name of what moved, "raised" where it is not told yet, "" where nothing did."""
        if self.alarm is not None and self.alarm.raised is not None:
            return "raised"
        return self.alarms[-1].moved if self.alarms else ""

    def said(self) -> str:
        """The alarm in words."""
        if self.alarm is None:
            return "no usual loss yet: it needs a fit that tells a from b, or a ring"
        if self.alarm.raised is not None:
            raised = alarm.when(self.alarm.raised - self.shift, True)
            return f"the loss moved, raised {raised}; what moved is told from the readings since"
        return self.alarms[-1].said(True) if self.alarms else "nothing moved"


def stepped(plan: Plan, state: State, variable: str, time: float, value: float) -> State:
    """Take a reading of a variable.

    Parameters
    ----------
    plan : Plan
        What is watched, and how.
    state : State
        ``State()``, or that of the reading before.
    variable : str
        ``beam_current``, or a name in `Conditions`.
    time : float
        Its time stamp, Unix time in s.
    value : float
        In mA or SI; NaN where it is none.

    Returns
    -------
    State
        With a new answer where one is due.

    Notes
    -----
    A reading that is no newer than the last is dropped, but five in a row that rise are of a clock
    set back. A gap (ten usual intervals and a minute) and a step of the clock begin a new piece,
    with a current of its own; so does a beam that was lost. Once an alarm has told what moved,
    what was read before that is no longer of the window.

    Examples
    --------
    >>> state, beam = State(), 500.0
    >>> for time in range(0, 1201, 20):
    ...     beam *= 1 - 20 * (3.7e-8 * beam + 9.3e-6)
    ...     state = stepped(Plan(every=1200), state, "beam_current", 1.7e9 + time, beam)
    >>> print(f"{state.answer.lifetime.value:.2f} h, {state.counts.late} late")
    10.10 h, 0 late
    """
    state = _counted(state, readings=1)
    if not (abs(value) <= MOST[variable == CURRENT] and abs(time) < LATEST):
        return _counted(state, bad=1)
    if variable != CURRENT:
        low, high, _ = PLAUSIBLE[variable]
        if not low <= value <= high:
            return _counted(state, bad=1)
        return state._replace(settings=state.settings._replace(**{variable: value}))
    state = _current(plan, state, time, value)
    return _answered(plan, state) if state.last >= state.due else state


def _counted(state: State, **more: int) -> State:
    counts = {name: getattr(state.counts, name) + n for name, n in more.items()}
    return state._replace(counts=state.counts._replace(**counts))


def noted(state: State, time: float, text: str) -> State:
    """Keep what happened, for whoever looks."""
    return state._replace(events=(*state.events[1 - EVENTS :], (time, text)))


def _current(plan: Plan, state: State, time: float, value: float) -> State:
    own, last = time + state.shift, state.last
    if last is None:
        return _placed(plan, state._replace(due=own + plan.every), own, value)
    if own <= last:
        return _behind(plan, state, time, value)
    apart, usual = own - last, state.interval
    if usual and apart > max(GAP * usual, alarm.MINUTE):
        said = f"no reading for {apart:.0f} s, or the clock was set forward"
        state = _counted(noted(_cut(plan, state), time, said), gaps=1)
    interval = usual * (1.2 if apart > usual else 1 / 1.2) if usual else apart
    return _placed(plan, state._replace(interval=interval, late=(0, -math.inf)), own, value)


def _behind(plan: Plan, state: State, time: float, value: float) -> State:
    """A reading no newer than the last."""
    count, latest = state.late
    count = count + 1 if time > latest else 1
    if count < LATE:
        return _counted(state._replace(late=(count, time)), late=1)
    said = f"the clock was set back by {state.last - state.shift - time:.0f} s"
    state = _counted(noted(_cut(plan, state), time, said), clock=1)
    shift = state.last + max(state.interval, 1e-3) - time
    return _current(plan, state._replace(shift=shift, late=(0, -math.inf)), time, value)


def _cut(plan: Plan, state: State) -> State:
    """Begin a piece with a current of its own."""
    state = _closed(plan, state)
    return state._replace(piece=state.piece + 1)


def _placed(plan: Plan, state: State, own: float, value: float) -> State:
    """A reading into its row, if there is a beam."""
    state, time = state._replace(last=own), own - state.shift
    if not value > DROPOUT * state.highest:
        if state.dead + 1 == DEAD:
            state = noted(_cut(plan, state), time, "the beam was lost")
        return state._replace(dead=state.dead + 1)
    if state.dead >= DEAD:
        state = noted(state, time, "beam again")
    if state.highest and DROPOUT * value > state.highest and state.spikes + 1 < DEAD:
        return _counted(state._replace(spikes=state.spikes + 1), bad=1)
    count, begin, times, currents = state.sums
    refilled = count and value - currents / count > alarm.JUMP * state.noise
    if count and (refilled or own - begin >= plan.window / ROWS):
        state = _closed(plan, state)
        count, times, currents = 0, 0.0, 0.0
    begin = begin if count else own
    sums = (count + 1, begin, times + own - begin, currents + value)
    return state._replace(sums=sums, dead=0, spikes=0, highest=max(state.highest, value))


def _closed(plan: Plan, state: State) -> State:
    """The row that grew is one of the window, and the alarm sees it."""
    count, begin, times, currents = state.sums
    if not count:
        return state
    row = WindowRow(state.piece, begin + times / count, currents / count, state.settings)
    state = state._replace(rows=(*state.rows[1 - 2 * ROWS :], row), sums=(0, 0.0, 0.0, 0.0))
    return state if state.alarm is None else _watched(plan, state, state.alarm, row)


def _kept(state: State, begin: float) -> State:
    """Rows from a time on."""
    return state._replace(rows=tuple(row for row in state.rows if row.time >= begin))


def _answered(plan: Plan, state: State) -> State:
    """Fit the window, and learn what is usual."""
    begin, shift = state.last - plan.window, state.shift
    state = _kept(state, begin)
    none = Window(None, None, 0, "no beam")
    window = fit_window(state.rows, plan.name) if state.dead < DEAD else none
    answer = _answer(plan, state, window)
    found = answer.lifetime
    known = (found.value, found.error) if found else (math.nan, math.nan)
    point = Point(answer.time, answer.current, *known)
    course = tuple(p for p in state.course if p.time >= begin - shift)
    if not course or point.time - course[-1].time >= plan.window / POINTS:
        course = (*course, point)
    fit = window.fit
    usual = None if state.alarms else learnt(state.alarm, window, state.rows, plan.machine)
    return state._replace(
        answer=answer,
        course=course,
        due=state.last + plan.every,
        alarm=usual or state.alarm,
        alarms=tuple(a for a in state.alarms if (a.told or a.time) >= begin - shift),
        highest=max((row.current for row in state.rows), default=0.0),
        noise=state.noise if fit is None else _noise_of_one(plan, state, fit.rms_residual),
    )


def _noise_of_one(plan: Plan, state: State, noise: float) -> float:
    """Noise of a reading, from that of a row."""
    readings = plan.window / ROWS / max(state.interval, 1e-6)
    return max(noise * math.sqrt(max(readings, 1.0)), BEST_MONITOR * state.highest)


def _answer(plan: Plan, state: State, window: Window) -> Answer:
    current = state.rows[-1].current if state.rows and state.dead < DEAD else 0.0
    time, fit = state.last - state.shift, window.fit
    if fit is None:
        return Answer(time, current, window, Status.unidentified, f"No lifetime: {window.why}.")
    known = [None if q.error is None else q for q in (fit.lifetime_mean, fit.a, fit.b)]
    scaled, message = None, fit.message
    try:
        scaled = normalised(window, plan.machine, plan.current)
    except InputError as error:
        message += f" Not normalised: {error}."
    return Answer(time, current, window, fit.status, message, *known, scaled)


def nothing_yet(state: State) -> Answer:
    """The answer before the first fit."""
    why = "No lifetime: the watch ended before its first fit."
    time = math.nan if state.last is None else state.last - state.shift
    return Answer(time, math.nan, Window(None, None, 0), Status.unidentified, why)


def _watched(plan: Plan, state: State, known: Alarmed, row: WindowRow) -> State:
    """A row seen by the alarm."""
    apart = row.time - state.rows[-2].time if len(state.rows) > 1 else 0.0
    known = followed(known, row, apart, plan.machine)
    reading = alarm.Reading(row.time, row.current, *known.expected)
    after, told = alarm.watched(known.usual, known.state, reading)
    raised = row.time if told.raised else known.raised
    state = state._replace(alarm=known._replace(state=after, raised=raised))
    if told.raised:
        state = noted(state, row.time - state.shift, "alarm: the loss moved")
    if not told.moved:
        return state
    found = alarm.alarm_of(raised, told, row.time)
    state = _kept(state, found.since)
    shown = {n: getattr(found, n) - state.shift for n in ("time", "since", "told")}
    found = found._replace(**shown)
    state = noted(state, found.told, f"alarm: {found.said(True)}")
    alarms = (*state.alarms, found)[-EVENTS:]
    known = state.alarm._replace(raised=None)
    return state._replace(alarm=known, alarms=alarms, due=-math.inf)  # fit the new loss now
