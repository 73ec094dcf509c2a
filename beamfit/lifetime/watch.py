"""Watch of a stored beam, reading by reading: lifetime over a sliding window, and alarms.

Pure functions: a state and a step from one state to the next. Memory is bounded by the window,
whatever the duration and the rate of readings.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from beamfit.answer import json_of
from beamfit.errors import InputError
from beamfit.lifetime import alarm
from beamfit.lifetime.course import MIN_RELATIVE_NOISE, normalised_lifetime, reference_of
from beamfit.lifetime.cycles import group_by_settings, join_cycles
from beamfit.lifetime.evidence import UNITS
from beamfit.lifetime.fit import DecayFit, bare, fit_decay, fit_pieces
from beamfit.lifetime.free_law import Law
from beamfit.lifetime.mechanisms import loss_coefficients, losses_from_terms, mechanism_terms
from beamfit.lifetime.pieces import DROPOUT, MIN_READINGS, split_record
from beamfit.lifetime.record import PLAUSIBLE, Conditions, DecayRecord
from beamfit.lifetime.study import (
    SETTING_STEP,
    Decay,
    Machine,
    operation_during,
    split_at_settings,
)
from beamfit.quantity import Quantity, Status


class WindowRow(NamedTuple):
    """Mean of some neighbouring readings.

    Attributes
    ----------
    piece : int
        Number of the piece: rises by one at every gap and step of the clock.
    time, current : float
        Means, s and mA.
    settings : Conditions
        Settings in SI units; NaN for what has not been read yet.
    """

    piece: int
    time: float
    current: float
    settings: Conditions


class Window(NamedTuple):
    """Fit to the last decays of a window.

    Attributes
    ----------
    fit : DecayFit or None
        Fit with one a and one b; None where nothing can be fitted.
    readings : DecayRecord or None
        Readings of those decays.
    pieces : int
        Number of decays.
    reason : str
        Reason why there is no fit.
    """

    fit: DecayFit | None
    readings: DecayRecord | None
    pieces: int
    reason: str = ""

    def decay(self, machine: Machine | None) -> Decay:
        """Decay with the loss budget of a ring; `InputError` if the ring stores no beam."""
        return Decay.of(self.readings, 0.0, self.fit, machine)


class Answer(NamedTuple):
    """Answer of a watch at one time.

    Attributes
    ----------
    time, current : float
        Last reading, s and mA.
    window : Window
        The fit.
    status, message : Status, str
        Verdict of the fit, or the reason why there is none.
    normalised : Quantity or None
        Current times lifetime, mA h, scaled by the ring to the reference current and its usual
        settings. None where the readings do not determine it.
    """

    time: float
    current: float
    window: Window
    status: Status
    message: str
    normalised: Quantity | None = None

    @property
    def lifetime(self) -> Quantity | None:
        """Lifetime at the mean current, h; None where the readings do not determine it."""
        return self._if_determined("lifetime_mean")

    @property
    def a(self) -> Quantity | None:
        """Quadratic loss coefficient, 1/(mA s); None where it is not determined."""
        return self._if_determined("a")

    @property
    def b(self) -> Quantity | None:
        """Linear loss coefficient, 1/s; None where it is not determined."""
        return self._if_determined("b")

    def _if_determined(self, name: str) -> Quantity | None:
        found = self.window.fit and getattr(self.window.fit, name)
        return found if found and found.error is not None else None

    def to_json(self) -> dict[str, Any]:
        """Decay as in `beamfit lifetime --json`, with the normalised lifetime."""
        unknown = dict.fromkeys(("chi2", "dof", "identifiability"))
        unknown |= {name: bare(None, unit) for name, unit in UNITS.items()}
        fit = unknown if self.window.fit is None else self.window.fit.to_json()
        named = {
            "status": self.status,
            "message": self.message,
            "current": bare(self.current, "mA"),
        }
        more = {"normalised": self.normalised or bare(None, "mA h"), "decays": self.window.pieces}
        return fit | json_of(named | more)


def fit_window(rows: Sequence[WindowRow], name: str, law: Law = Law.free) -> Window:
    """Split a window at refills and changes of settings, and fit the decays at the last settings.

    Parameters
    ----------
    rows : sequence of WindowRow
        In order of time.
    name : str
        Name of the result.
    law : Law
        As for `fit_decay`.

    Returns
    -------
    Window
        Joint fit of the decays at the settings of the last one, each with its own initial current.
        A pressure that does not follow the current counts as a setting.

    Examples
    --------
    >>> settings = Conditions(*[np.nan] * 5)
    >>> times = np.arange(0.0, 3600.0, 10.0)
    >>> rows = [WindowRow(0, t, 500 * np.exp(-t / 36000), settings) for t in times]
    >>> found = fit_window(rows, "ring")
    >>> found.pieces, f"{found.fit.lifetime_mean.value:.3f} h"
    (1, '10.000 h')
    """
    decays = [
        decay
        for piece in _records(rows, name)
        for section in split_at_settings(piece)
        for decay in split_record(section).segments
    ]
    if not decays:
        return Window(
            None, None, 0, f"fewer than {MIN_READINGS} readings in a row of a stored beam"
        )
    group = _at_last_settings(decays)
    alone = len(group) == 1
    one = replace(group[0], name=name) if alone else join_cycles(group, name)
    if len(one) < MIN_READINGS:
        return Window(None, one, len(group), f"{len(one)} readings since the last change")
    try:
        if alone:
            fit = fit_decay(one, law=law)
        else:
            fit = fit_pieces(group, name, law, found=len(group) > 2)
    except InputError as error:  # a current that rises
        return Window(None, one, len(group), error.found)
    return Window(fit, one, len(group))


def _records(rows: Sequence[WindowRow], name: str) -> list[DecayRecord]:
    """Records without gaps; a setting has its first value also before it was read."""
    if not rows:
        return []
    piece, time, current = np.array([row[:3] for row in rows]).T
    settings = np.array([row.settings for row in rows])
    finite = [column[np.isfinite(column)] for column in settings.T]
    filled = [
        np.where(np.isfinite(column), column, first_read[0]) if first_read.size else None
        for column, first_read in zip(settings.T, finite, strict=True)
    ]
    parts = np.split(np.arange(len(rows)), np.flatnonzero(np.diff(piece)) + 1)
    return [
        DecayRecord(
            time[part], current[part], None, name, time[part[0]],
            Conditions(*(None if column is None else column[part] for column in filled)),
        )
        for part in parts if part.size >= MIN_READINGS
    ]  # fmt: skip


def _at_last_settings(decays: list[DecayRecord]) -> list[DecayRecord]:
    """Select decays at the settings of the last, and its pressure unless that follows the beam."""
    compared = decays
    if join_cycles(decays, "").gauge is None:
        compared = [replace(d, conditions=d.conditions._replace(pressure=None)) for d in decays]
    starts = next(
        {decay.start for decay in group}
        for group in group_by_settings(compared)
        if compared[-1] in group
    )
    return [decay for decay in decays if decay.start in starts]


# Largest relative error of a and b that become the reference of the alarm: chosen.
MAX_REFERENCE_ERROR = 0.05
# Time, s, over which the expected loss follows the settings, chosen; steps are followed at once.
SMOOTHING_TIME = 300.0


class RingTerms(NamedTuple):
    """Loss terms of a ring at an operating point.

    Attributes
    ----------
    point : array
        Current, mA, and settings for which the terms were computed.
    terms : tuple
        Terms of the mechanisms, from `mechanism_terms`.
    losses : array, shape (2,)
        a, 1/(mA s), and b, 1/s.
    """

    point: np.ndarray
    terms: tuple[Any, ...]
    losses: np.ndarray


class ActiveAlarm(NamedTuple):
    """Alarm with its reference and what it expects now.

    Attributes
    ----------
    reference : Reference
        Usual loss.
    state : AlarmState
        State of the alarm.
    ring : RingTerms or None
        Losses of the ring at the present settings.
    losses : array, shape (2,), or None
        a and b of the ring at the settings of the reference.
    expected : (float, float)
        Expected a and b at the present settings over those at the reference.
    raised : float or None
        Time of an alarm that is not identified yet, s.
    """

    reference: alarm.Reference
    state: alarm.AlarmState
    ring: RingTerms | None = None
    losses: np.ndarray | None = None
    expected: tuple[float, float] = (1.0, 1.0)
    raised: float | None = None


def learn_reference(
    before: ActiveAlarm | None, window: Window, rows: Sequence[WindowRow], machine: Machine | None
) -> ActiveAlarm | None:
    """Take the loss of a fit as the reference, if it is the first or its errors are half as large.

    Parameters
    ----------
    before : ActiveAlarm or None
        Present reference; a raised alarm keeps it.
    window : Window
        Fit of the rows.
    rows : sequence of WindowRow
        Rows of the window.
    machine : Machine or None
        Ring whose ratio of a to b is used where the fit does not separate them.

    Returns
    -------
    ActiveAlarm or None
        Alarm with a new reference; None to keep the present one.
    """
    fit = window.fit
    # Where the pressure does not follow the current, a has no gas loss and b is that of the mean
    # pressure only.
    if fit is None or window.readings.gauge is not None or (before and before.raised is not None):
        return None
    reference = _reference(window, machine)
    if reference is None:
        return None
    if before and not np.trace(reference.covariance) < np.trace(before.reference.covariance) / 4:
        return None
    active = ActiveAlarm(reference, alarm.initial_state(reference))
    if machine is None:
        return active
    ring = _terms(machine, None, rows[-1])  # what the gauge shows now
    return active._replace(ring=ring, losses=ring.losses)


def _reference(window: Window, machine: Machine | None) -> alarm.Reference | None:
    """Reference from a fit that determines constant a and b, or a loss rate and a ring's ratio."""
    fit, ring = window.fit, None
    if fit.status not in (Status.converged, Status.unidentified):
        return None
    quantities = tuple(fit.if_constant(name) for name in "ab")
    if not all(one.determined for one in quantities):
        if machine is None:
            return None
        quantities = (fit.lifetime_mean,)
        try:
            ring = window.decay(machine).budget.losses
        except InputError:
            return None
    if not all(one.error and abs(one.relative) < MAX_REFERENCE_ERROR for one in quantities):
        return None
    return reference_of((window.decay(None),), np.ones(1), np.ones(1), ring)


def _terms(machine: Machine, before: RingTerms | None, row: WindowRow) -> RingTerms:
    """Losses of the ring at the settings of a row; terms are reused if only the pressure moved."""
    settings = Conditions(*(None if math.isnan(v) else [v, v] for v in row.settings))
    instant = DecayRecord([0.0, 1.0], row.current * np.array([1.0, 1 - 1e-6]), conditions=settings)
    operation = operation_during(instant, machine)
    point = np.array([row.current, *row.settings._replace(pressure=0.0)])
    if before and np.allclose(point, before.point, rtol=SETTING_STEP, atol=0.0, equal_nan=True):
        point, terms = before.point, before.terms
    else:
        terms = mechanism_terms(machine.ring, operation, row.current)
    losses = losses_from_terms(terms, operation.pressure_base, operation.pressure_slope)
    return RingTerms(point, terms, np.array([losses.a, losses.b], float))


def follow_settings(
    active: ActiveAlarm, row: WindowRow, elapsed: float, machine: Machine | None
) -> ActiveAlarm:
    """Update the expected loss to the settings of a row, smoothed against noise of the gauge.

    Parameters
    ----------
    active : ActiveAlarm
        Alarm after the previous row.
    row : WindowRow
        New row.
    elapsed : float
        Time between the two rows, s.
    machine : Machine or None
        Ring; without it the expected loss does not change.

    Returns
    -------
    ActiveAlarm
    """
    if machine is None:
        return active
    try:
        ring = _terms(machine, active.ring, row)
    except InputError:  # ignore settings at which the ring stores no beam
        return active
    new, old = ring.losses / active.losses, np.array(active.expected)
    is_step = np.abs(new / old - 1).max() > alarm.EXPECTATION_STEP
    share = 1.0 if is_step else min(elapsed / SMOOTHING_TIME, 1.0)
    a, b = old + share * (new - old)
    return active._replace(ring=ring, expected=(float(a), float(b)))


CURRENT = "beam_current"
# Readings in a row that confirm a lost beam, a far higher current, or a clock that was set back:
# fewer are bad readings.
CONFIRMING_READINGS = 5
# Number of rows of a window: readings are averaged over this part of its length.
WINDOW_ROWS = 4096
# Largest valid value of a setting (its range is checked apart) and of the current, mA, more than
# any ring stores; latest valid time, s, more than any clock shows.
MAX_VALUE, MAX_TIME = (math.inf, 1e6), 1e11
# Numbers of events, and of points of the displayed course, that are kept.
MAX_EVENTS, MAX_POINTS = 20, 360
RULE = (
    "raised where a change of a or b is so much likelier than none that one in 1e6 readings "
    "at most is false (none in 9e6 simulated, benchmarks/alarm.py)"
)


class Plan(NamedTuple):
    """Plan of a watch.

    Attributes
    ----------
    name : str
        Name of the ring.
    window, every : float
        Length of the sliding window, and time from fit to fit, s.
    machine : Machine or None
        Ring by which lifetimes are normalised and the loss at other settings is expected.
    current : float or None
        Current to which lifetimes are normalised, mA; default: the mean current of each fit.
    """

    name: str = "ring"
    window: float = 7200.0
    every: float = 10.0
    machine: Machine | None = None
    current: float | None = None


class Counts(NamedTuple):
    """Numbers of readings, of bad and late ones, of gaps, and of steps of the clock."""

    readings: int = 0
    bad: int = 0
    late: int = 0
    gaps: int = 0
    clock: int = 0


class Point(NamedTuple):
    """Point of a picture: time, s, current, mA, lifetime and its error, h, NaN if there is none."""

    time: float
    current: float
    lifetime: float
    error: float


class State(NamedTuple):
    """State of a watch between readings.

    Attributes
    ----------
    rows : tuple of WindowRow
        Rows of the window.
    sums : tuple
        Unfinished row: number of readings, start, s, sum of times since the start, and of currents.
    last, shift, interval : float or None
        Time of the last reading, correction added to time stamps since the clock was set back, and
        usual interval of readings, s.
    piece : int
        Number of the present piece.
    dead, spikes : int
        Readings in a row without beam, and far above all before.
    late : tuple
        Number of late readings in a row, and the time of the last, s.
    settings : Conditions
        Last settings read, in SI units.
    highest, zero, noise : float
        Highest current of the window, largest reading without beam, and noise of a reading, mA.
    due : float
        Time of the next fit, s.
    counts, events, course, answer
        Counts of readings, events with their times, points of the picture, last answer.
    alarm : ActiveAlarm or None
        None until the usual loss is known.
    alarms : tuple of Alarm
        Alarms within the window.
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
    zero: float = 0.0
    noise: float = math.inf
    due: float = -math.inf
    counts: Counts = Counts()
    events: tuple[tuple[float, str], ...] = ()
    course: tuple[Point, ...] = ()
    answer: Answer | None = None
    alarm: ActiveAlarm | None = None
    alarms: tuple[alarm.Alarm, ...] = ()

    @property
    def alarmed(self) -> str:
        """Label of what changed, "raised" until it is identified, "" if nothing changed."""
        if self.alarm is not None and self.alarm.raised is not None:
            return "raised"
        return self.alarms[-1].moved if self.alarms else ""

    def alarm_text(self) -> str:
        """Sentence on the alarm."""
        if self.alarm is None:
            return "no usual loss yet: it needs a fit that tells constant a from b, or a ring"
        if self.alarm.raised is not None:
            raised = alarm.time_label(self.alarm.raised - self.shift, True)
            return f"the loss moved, raised {raised}; what moved is told from the readings since"
        return self.alarms[-1].text(True) if self.alarms else "nothing moved"


def stepped(plan: Plan, state: State, variable: str, time: float, value: float) -> State:
    """Take a reading of a variable.

    Parameters
    ----------
    plan : Plan
        Plan of the watch.
    state : State
        ``State()``, or the state after the previous reading.
    variable : str
        ``beam_current``, or a name of `Conditions`.
    time : float
        Time stamp, Unix time in s.
    value : float
        Value in mA or SI units; NaN where there is none.

    Returns
    -------
    State
        Next state, with a new answer if one is due.

    Notes
    -----
    A reading that is no newer than the last is dropped, but five such readings in increasing order
    of time mean that the clock was set back. A gap (ten usual intervals and a minute), a step of
    the clock and a lost beam begin a new piece, with its own initial current. Once an alarm is
    identified, readings before the change leave the window.

    Examples
    --------
    >>> state, beam = State(), 500.0
    >>> for time in range(0, 1201, 20):
    ...     beam *= 1 - 20 * (3.7e-8 * beam + 9.3e-6)
    ...     state = stepped(Plan(every=1200), state, "beam_current", 1.7e9 + time, beam)
    >>> print(f"{state.answer.lifetime.value:.2f} h, {state.counts.late} late")
    10.10 h, 0 late
    """
    state = _count(state, readings=1)
    if not (abs(value) <= MAX_VALUE[variable == CURRENT] and abs(time) < MAX_TIME):
        return _count(state, bad=1)
    if variable != CURRENT:
        low, high, _ = PLAUSIBLE[variable]
        if not low <= value <= high:
            return _count(state, bad=1)
        return state._replace(settings=state.settings._replace(**{variable: value}))
    state = _take_current(plan, state, time, value)
    return _refit(plan, state) if state.last >= state.due else state


def _count(state: State, **more: int) -> State:
    counts = {name: getattr(state.counts, name) + n for name, n in more.items()}
    return state._replace(counts=state.counts._replace(**counts))


def add_event(state: State, time: float, text: str) -> State:
    """Append an event to the list of the last events."""
    return state._replace(events=(*state.events[1 - MAX_EVENTS :], (time, text)))


def _take_current(plan: Plan, state: State, time: float, value: float) -> State:
    clock, last = time + state.shift, state.last
    if last is None:
        return _add_to_row(plan, state._replace(due=clock + plan.every), clock, value)
    if clock <= last:
        return _take_late_reading(plan, state, time, value)
    elapsed, usual = clock - last, state.interval
    if usual and alarm.is_gap(elapsed, usual):
        text = f"no reading for {elapsed:.0f} s, or the clock was set forward"
        state = _count(add_event(_begin_piece(plan, state), time, text), gaps=1)
    interval = usual * (1.2 if elapsed > usual else 1 / 1.2) if usual else elapsed
    return _add_to_row(plan, state._replace(interval=interval, late=(0, -math.inf)), clock, value)


def _take_late_reading(plan: Plan, state: State, time: float, value: float) -> State:
    """Take a reading that is no newer than the last."""
    count, latest = state.late
    count = count + 1 if time > latest else 1
    if count < CONFIRMING_READINGS:
        return _count(state._replace(late=(count, time)), late=1)
    text = f"the clock was set back by {state.last - state.shift - time:.0f} s"
    state = _count(add_event(_begin_piece(plan, state), time, text), clock=1)
    shift = state.last + max(state.interval, 1e-3) - time
    return _take_current(plan, state._replace(shift=shift, late=(0, -math.inf)), time, value)


def _begin_piece(plan: Plan, state: State) -> State:
    """Begin a new piece, with its own initial current."""
    state = _close_row(plan, state)
    return state._replace(piece=state.piece + 1)


def _add_to_row(plan: Plan, state: State, clock: float, value: float) -> State:
    """Add a reading to its row, if there is a beam."""
    state, time = state._replace(last=clock), clock - state.shift
    if not value > DROPOUT * state.highest:
        if state.dead + 1 == CONFIRMING_READINGS:
            state = add_event(_begin_piece(plan, state), time, "the beam was lost")
            state = state._replace(zero=0.0)
        zero = max(state.zero, abs(value)) if state.dead >= CONFIRMING_READINGS else state.zero
        return state._replace(dead=state.dead + 1, zero=zero)
    if state.dead >= CONFIRMING_READINGS:
        state = add_event(state, time, "beam again")
    if state.highest and DROPOUT * value > state.highest and state.spikes + 1 < CONFIRMING_READINGS:
        return _count(state._replace(spikes=state.spikes + 1), bad=1)
    count, begin, times, currents = state.sums
    refilled = count and value - currents / count > alarm.STEP_ERRORS * state.noise
    if count and (refilled or clock - begin >= plan.window / WINDOW_ROWS):
        state = _close_row(plan, state)
        count, times, currents = 0, 0.0, 0.0
    begin = begin if count else clock
    sums = (count + 1, begin, times + clock - begin, currents + value)
    return state._replace(sums=sums, dead=0, spikes=0, highest=max(state.highest, value))


def _close_row(plan: Plan, state: State) -> State:
    """Append the unfinished row to the window, and give it to the alarm."""
    count, begin, times, currents = state.sums
    if not count:
        return state
    row = WindowRow(state.piece, begin + times / count, currents / count, state.settings)
    state = state._replace(rows=(*state.rows[1 - 2 * WINDOW_ROWS :], row), sums=(0, 0.0, 0.0, 0.0))
    return state if state.alarm is None else _watch_row(plan, state, state.alarm, row)


def _drop_before(state: State, begin: float) -> State:
    """Drop the rows before a time."""
    return state._replace(rows=tuple(row for row in state.rows if row.time >= begin))


def _refit(plan: Plan, state: State) -> State:
    """Fit the window, and update the reference of the alarm."""
    begin, shift = state.last - plan.window, state.shift
    state = _drop_before(state, begin)
    none = Window(None, None, 0, "no beam")
    # With a ring, first principles give the loss at other currents.
    law = Law.free if plan.machine is None else Law.constant
    window = fit_window(state.rows, plan.name, law) if state.dead < CONFIRMING_READINGS else none
    answer = _answer(plan, state, window)
    found = answer.lifetime
    lifetime = (found.value, found.error) if found else (math.nan, math.nan)
    point = Point(answer.time, answer.current, *lifetime)
    course = tuple(p for p in state.course if p.time >= begin - shift)
    if not course or point.time - course[-1].time >= plan.window / MAX_POINTS:
        course = (*course, point)
    fit = window.fit
    learnt = None
    if not state.alarms:
        learnt = learn_reference(state.alarm, window, state.rows, plan.machine)
    return state._replace(
        answer=answer,
        course=course,
        due=state.last + plan.every,
        alarm=learnt or state.alarm,
        alarms=tuple(a for a in state.alarms if (a.told or a.time) >= begin - shift),
        # In a window without beam, a beam must exceed the zero readings as a spike exceeds a beam.
        highest=max((row.current for row in state.rows), default=state.zero / DROPOUT**2),
        noise=state.noise if fit is None else _noise_of_reading(plan, state, fit.rms_residual),
    )


def _noise_of_reading(plan: Plan, state: State, noise: float) -> float:
    """Noise of a reading, mA, from that of a row."""
    readings = plan.window / WINDOW_ROWS / max(state.interval, 1e-6)
    return max(noise * math.sqrt(max(readings, 1.0)), MIN_RELATIVE_NOISE * state.highest)


def _answer(plan: Plan, state: State, window: Window) -> Answer:
    current = state.rows[-1].current if state.rows and state.dead < CONFIRMING_READINGS else 0.0
    time, fit = state.last - state.shift, window.fit
    if fit is None:
        return Answer(time, current, window, Status.unidentified, f"No lifetime: {window.reason}.")
    answer = Answer(time, current, window, fit.status, fit.message)
    if answer.lifetime is None:
        return answer
    machine, at = plan.machine, plan.current or fit.mean_current
    try:
        ring = None if machine is None else loss_coefficients(*machine, at)
        return answer._replace(normalised=normalised_lifetime(window.decay(machine), ring, at))
    except InputError as error:
        return answer._replace(message=f"{fit.message} Not normalised: {error}.")


def empty_answer(state: State) -> Answer:
    """Answer before the first fit."""
    reason = "No lifetime: the watch ended before its first fit."
    time = math.nan if state.last is None else state.last - state.shift
    return Answer(time, math.nan, Window(None, None, 0), Status.unidentified, reason)


def _watch_row(plan: Plan, state: State, active: ActiveAlarm, row: WindowRow) -> State:
    """Give a row to the alarm."""
    elapsed = row.time - state.rows[-2].time if len(state.rows) > 1 else 0.0
    active = follow_settings(active, row, elapsed, plan.machine)
    reading = alarm.Reading(row.time, row.current, *active.expected)
    after, step = alarm.watched(active.reference, active.state, reading)
    raised = row.time if step.raised else active.raised
    state = state._replace(alarm=active._replace(state=after, raised=raised))
    if step.raised:
        state = add_event(state, row.time - state.shift, "alarm: the loss moved")
    if not step.moved:
        return state
    found = alarm.make_alarm(raised, step, row.time)
    state = _drop_before(state, found.since)
    times = {n: getattr(found, n) - state.shift for n in ("time", "since", "told")}
    found = found._replace(**times)
    state = add_event(state, found.told, f"alarm: {found.text(True)}")
    alarms = (*state.alarms, found)[-MAX_EVENTS:]
    active = state.alarm._replace(raised=None)
    return state._replace(alarm=active, alarms=alarms, due=-math.inf)  # fit the new loss now
