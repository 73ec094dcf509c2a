"""A stored beam watched reading by reading: its lifetime over a sliding window, and what moved.

Pure: a state and a step. Memory is that of the window, whatever the time and the rate of readings.
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
from beamfit.lifetime.course import BEST_MONITOR, normalised, reference_of
from beamfit.lifetime.cycles import alike, joined
from beamfit.lifetime.evidence import UNITS
from beamfit.lifetime.fit import DecayFit, bare, fit_decay, fit_pieces
from beamfit.lifetime.free_law import Law
from beamfit.lifetime.mechanisms import added, loss_coefficients, terms_of
from beamfit.lifetime.pieces import DROPOUT, FEWEST, split_record
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
    """The mean of some neighbouring readings.

    Attributes
    ----------
    piece : int
        Rises by one at every gap and step of the clock.
    time, current : float
        s and mA.
    settings : Conditions
        In SI; NaN of what has not been read yet.
    """

    piece: int
    time: float
    current: float
    settings: Conditions


class Window(NamedTuple):
    """A fit to the last decays of a window.

    Attributes
    ----------
    fit : DecayFit or None
        One a, one b; None where nothing can be fitted.
    readings : DecayRecord or None
        Of those decays.
    pieces : int
        How many decays they are.
    why : str
        Why there is no fit.
    """

    fit: DecayFit | None
    readings: DecayRecord | None
    pieces: int
    why: str = ""

    def decay(self, machine: Machine | None) -> Decay:
        """The decays as one, with the losses of a ring; `InputError` if it stores no beam there."""
        return Decay.of(self.readings, 0.0, self.fit, machine)


class Answer(NamedTuple):
    """Answer of the window.

    Attributes
    ----------
    time, current : float
        Of the last reading, s and mA.
    window : Window
        The fit.
    status, message : Status, str
        Of the fit, or why there is none.
    normalised : Quantity or None
        Current times lifetime, mA h, by the ring at the reference current and its usual settings.
        None where the readings do not determine it.
    """

    time: float
    current: float
    window: Window
    status: Status
    message: str
    normalised: Quantity | None = None

    @property
    def lifetime(self) -> Quantity | None:
        """At the mean current, h; None where the readings do not determine it."""
        return self._told("lifetime_mean")

    @property
    def a(self) -> Quantity | None:
        """1/(mA s), likewise."""
        return self._told("a")

    @property
    def b(self) -> Quantity | None:
        """1/s, likewise."""
        return self._told("b")

    def _told(self, name: str) -> Quantity | None:
        found = self.window.fit and getattr(self.window.fit, name)
        return found if found and found.error is not None else None

    def to_json(self) -> dict[str, Any]:
        """Return it as `beamfit lifetime --json` does a decay, with what is normalised."""
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
    """Cut a window at refills and changes of setting, and fit what is as it is now.

    Parameters
    ----------
    rows : sequence of WindowRow
        In order of time.
    name : str
        What to call the result.
    law : Law
        As of `fit_decay`.

    Returns
    -------
    Window
        Decays at the settings of the last one together, each with a current of its own at its
        start; a pressure that does not follow the current is a setting, too.

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
        for piece in _pieces(rows, name)
        for section in split_at_settings(piece)
        for decay in split_record(section).segments
    ]
    if not decays:
        return Window(None, None, 0, f"fewer than {FEWEST} readings in a row of a stored beam")
    group = _at_last(decays)
    alone = len(group) == 1
    one = replace(group[0], name=name) if alone else joined(group, name)
    if len(one) < FEWEST:
        return Window(None, one, len(group), f"{len(one)} readings since the last change")
    try:
        if alone:
            fit = fit_decay(one, law=law)
        else:
            fit = fit_pieces(group, name, law, found=len(group) > 2)
    except InputError as error:  # a current that rises
        return Window(None, one, len(group), error.found)
    return Window(fit, one, len(group))


def _pieces(rows: Sequence[WindowRow], name: str) -> list[DecayRecord]:
    """Records without gaps; before it was first read a setting is taken as it was then."""
    if not rows:
        return []
    piece, time, current = np.array([row[:3] for row in rows]).T
    settings = np.array([row.settings for row in rows])
    known = [column[np.isfinite(column)] for column in settings.T]
    filled = [
        np.where(np.isfinite(column), column, seen[0]) if seen.size else None
        for column, seen in zip(settings.T, known, strict=True)
    ]
    parts = np.split(np.arange(len(rows)), np.flatnonzero(np.diff(piece)) + 1)
    return [
        DecayRecord(
            time[part], current[part], None, name, time[part[0]],
            Conditions(*(None if column is None else column[part] for column in filled)),
        )
        for part in parts if part.size >= FEWEST
    ]  # fmt: skip


def _at_last(decays: list[DecayRecord]) -> list[DecayRecord]:
    """Those at the settings of the last, and its pressure if that does not follow the beam."""
    compared = decays
    if joined(decays, "").gauge is None:
        compared = [replace(d, conditions=d.conditions._replace(pressure=None)) for d in decays]
    starts = next(
        {decay.start for decay in group} for group in alike(compared) if compared[-1] in group
    )
    return [decay for decay in decays if decay.start in starts]


# a and b so well known are the usual ones; errors half as large replace them before an alarm.
KNOWN = 0.05
# What the ring is expected to lose follows its settings over so long, s, and steps at once.
SMOOTH = 300.0


class Terms(NamedTuple):
    """A ring's terms, the settings they are for, and the a and b they make."""

    place: np.ndarray
    parts: tuple[Any, ...]
    losses: np.ndarray


class Alarmed(NamedTuple):
    """The alarm at work: the usual loss, what the ring loses now and lost where that was found,
    what is expected now over then, and since when an alarm is raised.
    """

    usual: alarm.Reference
    state: alarm.AlarmState
    ring: Terms | None = None
    losses: np.ndarray | None = None
    expected: tuple[float, float] = (1.0, 1.0)
    raised: float | None = None


def learnt(
    before: Alarmed | None, window: Window, rows: Sequence[WindowRow], machine: Machine | None
) -> Alarmed | None:
    """The usual loss, where a fit is the first to tell it, or tells it twice as well.

    Parameters
    ----------
    before : Alarmed or None
        What is known; an alarm that is raised keeps it.
    window : Window
        The fit, of these rows.
    rows : sequence of WindowRow
    machine : Machine or None
        The ring: where the fit does not tell a from b, they have its shares.

    Returns
    -------
    Alarmed or None
        None where nothing is learnt.
    """
    fit = window.fit
    # Where the gauge does not follow the current a is without gas, and b of no moment.
    if fit is None or window.readings.gauge is not None or (before and before.raised is not None):
        return None
    usual = _usual(window, machine)
    if usual is None:
        return None
    if before and not np.trace(usual.covariance) < np.trace(before.usual.covariance) / 4:
        return None
    known = Alarmed(usual, alarm.started(usual))
    if machine is None:
        return known
    ring = _terms(machine, None, rows[-1])  # what the gauge shows now
    return known._replace(ring=ring, losses=ring.losses)


def _usual(window: Window, machine: Machine | None) -> alarm.Reference | None:
    """The loss of a fit that knows a and b if they are constant, or the loss rate and a ring their
    ratio.
    """
    fit, ring = window.fit, None
    if fit.status not in (Status.converged, Status.unidentified):
        return None
    known = tuple(fit.if_constant(name) for name in "ab")
    if not all(one.determined for one in known):
        if machine is None:
            return None
        known = (fit.lifetime_mean,)
        try:
            ring = window.decay(machine).budget.losses
        except InputError:
            return None
    if not all(one.error and abs(one.relative) < KNOWN for one in known):
        return None
    return reference_of((window.decay(None),), np.ones(1), np.ones(1), ring)


def _terms(machine: Machine, before: Terms | None, row: WindowRow) -> Terms:
    """Losses of the ring at the settings of a row; anew but for the pressure if they moved."""
    at = Conditions(*(None if math.isnan(value) else [value, value] for value in row.settings))
    moment = DecayRecord([0.0, 1.0], row.current * np.array([1.0, 1 - 1e-6]), conditions=at)
    operation = operation_during(moment, machine)
    place = np.array([row.current, *row.settings._replace(pressure=0.0)])
    if before and np.allclose(place, before.place, rtol=SETTING_STEP, atol=0.0, equal_nan=True):
        place, parts = before.place, before.parts
    else:
        parts = terms_of(machine.ring, operation, row.current)
    losses = added(parts, operation.pressure_base, operation.pressure_slope)
    return Terms(place, parts, np.array([losses.a, losses.b], float))


def followed(known: Alarmed, row: WindowRow, apart: float, machine: Machine | None) -> Alarmed:
    """Follow the expected loss at the settings of a row, smoothed: noise of a gauge would bend it.

    Parameters
    ----------
    known : Alarmed
        As it was at the row before.
    row : WindowRow
    apart : float
        Time between the two, s.
    machine : Machine or None
        The ring; without one the expected loss stays.

    Returns
    -------
    Alarmed
    """
    if machine is None:
        return known
    try:
        ring = _terms(machine, known.ring, row)
    except InputError:  # settings at which the ring stores no beam are none
        return known
    new, old = ring.losses / known.losses, np.array(known.expected)
    share = 1.0 if np.abs(new / old - 1).max() > alarm.SET else min(apart / SMOOTH, 1.0)
    a, b = old + share * (new - old)
    return known._replace(ring=ring, expected=(float(a), float(b)))


CURRENT = "beam_current"
# Readings in a row that are believed against all before: of no beam, of a far higher one, and of
# a clock that was set back.
IN_A_ROW = 5
# A window is kept as the means of readings over so many parts of it.
ROWS = 4096
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
    highest, zero, noise, due : float
        Highest current of the window, farthest reading from zero without beam, and noise of a
        reading, mA; when to fit, s.
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
    zero: float = 0.0
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
            return "no usual loss yet: it needs a fit that tells constant a from b, or a ring"
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
    if usual and alarm.is_gap(apart, usual):
        said = f"no reading for {apart:.0f} s, or the clock was set forward"
        state = _counted(noted(_cut(plan, state), time, said), gaps=1)
    interval = usual * (1.2 if apart > usual else 1 / 1.2) if usual else apart
    return _placed(plan, state._replace(interval=interval, late=(0, -math.inf)), own, value)


def _behind(plan: Plan, state: State, time: float, value: float) -> State:
    """A reading no newer than the last."""
    count, latest = state.late
    count = count + 1 if time > latest else 1
    if count < IN_A_ROW:
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
        if state.dead + 1 == IN_A_ROW:
            state = noted(_cut(plan, state), time, "the beam was lost")._replace(zero=0.0)
        zero = max(state.zero, abs(value)) if state.dead >= IN_A_ROW else state.zero
        return state._replace(dead=state.dead + 1, zero=zero)
    if state.dead >= IN_A_ROW:
        state = noted(state, time, "beam again")
    if state.highest and DROPOUT * value > state.highest and state.spikes + 1 < IN_A_ROW:
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
    law = Law.free if plan.machine is None else Law.constant  # a ring knows more of its law
    window = fit_window(state.rows, plan.name, law) if state.dead < IN_A_ROW else none
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
        # Without a beam in the window one must stand as far above zero as a spike above a beam.
        highest=max((row.current for row in state.rows), default=state.zero / DROPOUT**2),
        noise=state.noise if fit is None else _noise_of_one(plan, state, fit.rms_residual),
    )


def _noise_of_one(plan: Plan, state: State, noise: float) -> float:
    """Noise of a reading, from that of a row."""
    readings = plan.window / ROWS / max(state.interval, 1e-6)
    return max(noise * math.sqrt(max(readings, 1.0)), BEST_MONITOR * state.highest)


def _answer(plan: Plan, state: State, window: Window) -> Answer:
    current = state.rows[-1].current if state.rows and state.dead < IN_A_ROW else 0.0
    time, fit = state.last - state.shift, window.fit
    if fit is None:
        return Answer(time, current, window, Status.unidentified, f"No lifetime: {window.why}.")
    answer = Answer(time, current, window, fit.status, fit.message)
    if answer.lifetime is None:
        return answer
    machine, at = plan.machine, plan.current or fit.mean_current
    try:
        ring = None if machine is None else loss_coefficients(*machine, at)
        return answer._replace(normalised=normalised(window.decay(machine), ring, at))
    except InputError as error:
        return answer._replace(message=f"{fit.message} Not normalised: {error}.")


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
