"""An alarm on the loss of a beam, reading by reading: what moved, a or b, since when, by how much.

A likelihood-ratio test over windows of 4 to 128 minutes (T. L. Lai, J. R. Stat. Soc. B 57 (1995)
613: windows in geometric progression lose little against all of them), and of the two hypotheses
that a, or that b, is what moved.
"""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import NamedTuple

import numpy as np

from beamfit.lifetime.pieces import GAP
from beamfit.quantity import HOUR, Quantity, relative_change
from beamfit.statistics import CLEAR_ODDS, MIN_SINGULAR_VALUE, log_evidence_of_change

MINUTE = 60.0
# Windows, s: four begin in turn in each length, so that one of nearly any age is at hand.
LENGTHS = np.repeat([4.0, 8.0, 16.0, 32.0, 64.0, 128.0], 4) * MINUTE
PHASES = LENGTHS * np.tile([0.0, 0.25, 0.5, 0.75], 6)
# Before an alarm a and b may be off by this much.
WIDE = 0.3
# a and b wander by so much on an ordinary day, and from fill to fill where that is not known.
WANDER = 0.005


class AlarmState(NamedTuple):
    """Sums kept between readings; arrays may have leading axes, of many beams at once.

    Attributes
    ----------
    time, current, step, pace : array
        Last reading, s and mA, seconds since the one before, and by how much ln I rose over the
        expected in a second of them.
    expected : array, shape (..., 2)
        Its factors of a and b.
    clock, hold : array
        Seconds watched, and seconds still to wait after a step.
    path : array, shape (..., 3)
        Since the last cut: ln I over the expected, and its derivatives by relative changes of a, b.
    foretold, unsure : array, shapes (..., 4), (...)
        Noise with a memory, in the path and a 1 beside it, as the readings tell it; variance of
        that over the reference's.
    noise : array
        Variance of readings over that of the reference.
    factor, covariance : array, shapes (..., 2), (..., 2, 2)
        a and b over the reference's after earlier alarms, and their relative covariance.
    spread : array
        Relative variance of a and of b from fill to fill.
    age, weight, mean, product : array, shapes (..., w), (..., w), (..., w, 3), (..., w, 2, 3)
        Of each window and of what came since the alarm, in the last place: seconds, and of its last
        piece the sum of weights, means of the path, and central products of its derivatives with
        these (the information) and with ln I (the score).
    past : array, shape (..., w, 2, 3)
        What its earlier pieces say, each beside a and b of its own, as products.
    raised, excess, before : array
        Seconds since an alarm was raised, NaN where none is; ln I over the expected at that moment,
        and the age, s, of the window that showed it.
    """

    time: np.ndarray
    current: np.ndarray
    step: np.ndarray
    pace: np.ndarray
    expected: np.ndarray
    clock: np.ndarray
    hold: np.ndarray
    path: np.ndarray
    foretold: np.ndarray
    unsure: np.ndarray
    noise: np.ndarray
    factor: np.ndarray
    covariance: np.ndarray
    spread: np.ndarray
    age: np.ndarray
    weight: np.ndarray
    mean: np.ndarray
    product: np.ndarray
    past: np.ndarray
    raised: np.ndarray
    excess: np.ndarray
    before: np.ndarray


def either(chosen: np.ndarray, new: np.ndarray, old: np.ndarray) -> np.ndarray:
    """One or the other, by the leading axes."""
    shape = np.shape(chosen) + (1,) * (np.ndim(old) - np.ndim(chosen))
    return np.where(np.reshape(chosen, shape), new, old)


def emptied(state: AlarmState, chosen: np.ndarray) -> AlarmState:
    """Let windows begin anew."""
    names = ("age", "weight", "product", "past")
    return state._replace(**{name: either(chosen, 0.0, getattr(state, name)) for name in names})


def with_reading(
    state: AlarmState, before: np.ndarray, path: np.ndarray, weight: np.ndarray, step: np.ndarray
) -> dict[str, np.ndarray]:
    """Weighted means and central products with one reading more (Welford); those due, anew.

    Where the weight before is zero the piece begins, and its offset is free.
    """
    clock = state.clock[..., None]
    turns = np.floor((clock - PHASES) / LENGTHS)
    due = np.floor((clock + step[..., None] - PHASES) / LENGTHS) > turns
    due = np.concatenate([due, np.zeros_like(clock, bool)], axis=-1)
    state, before = emptied(state, due), np.where(due, 0.0, before)
    total = before + weight[..., None]
    share = np.where(total > 0, weight[..., None] / np.where(total > 0, total, 1.0), 0.0)
    off = np.where((before > 0)[..., None], path[..., None, :] - state.mean, 0.0)
    start = (before == 0)[..., None] & (weight > 0)[..., None, None]
    mean = np.where(start, path[..., None, :], state.mean + share[..., None] * off)
    pairs = off[..., 1:, None] * off[..., None, [1, 2, 0]]
    product = state.product + (share * before)[..., None, None] * pairs
    age = state.age + step[..., None]
    return {"age": age, "weight": total, "mean": mean, "product": product, "past": state.past}


def beside(product: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Products that are left where a and b depart by themselves with such a covariance C: with
    information J and score s (1 + J C)⁻¹ (J, s).
    """
    return np.linalg.solve(np.eye(2) + product[..., :2] @ covariance, product)


def shown_in(state: AlarmState, windows: slice = slice(None)) -> np.ndarray:
    """Products of all pieces of some windows, as they tell a lasting change."""
    spread = state.spread[..., None, None, None] * np.eye(2)
    product = state.product[..., windows, :, :]
    return state.past[..., windows, :, :] + beside(product, spread)


class Seen(NamedTuple):
    """Squares of changes over their errors, and one over the squares of these, in each window,
    shape (3, ..., w): of a alone, of b alone, and of b beside a.
    """

    squares: np.ndarray
    information: np.ndarray

    @property
    def evidence(self) -> np.ndarray:
        """Logarithms of how many times likelier a change of a, of b, of both is than none."""
        a, b, beside = log_evidence_of_change(*self)
        return np.stack([a, b, a + beside])


def seen_in(state: AlarmState, windows: slice = slice(None)) -> Seen:
    """Changes that some of the windows show."""
    found = beside(shown_in(state, windows), state.covariance[..., None, :, :])
    (maa, mab, sa), (_, mbb, sb) = np.moveaxis(found, (-2, -1), (0, 1))
    slope = mab / np.where(maa > 0, maa, np.inf)
    rest, left = sb - sa * slope, mbb - mab * slope
    left = np.where(left > 1e-9 * mbb, left, 0.0)  # else rounding: the two are not told apart
    scores, information = np.stack([sa, sb, rest]), np.stack([maa, mbb, left])
    return Seen(scores**2 / np.where(information > 0, information, np.inf), information)


def change_since(state: AlarmState, moved: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Relative changes since the alarm, of what moved alone, their errors, and the covariance.

    Errors contain those of the reference.
    """
    product = shown_in(state, slice(-1, None))[..., 0, :, :] + WIDE**-2 * np.eye(2, 3)
    information, score = product[..., :2], product[..., 2]
    own = np.diagonal(information, axis1=-2, axis2=-1)
    share, covariance = information / own[..., None], np.linalg.inv(information)
    both = np.einsum("...ij,...j->...i", covariance, score)
    total = np.diagonal(covariance + state.covariance, axis1=-2, axis2=-1)
    single = 1 / own + np.einsum("...ij,...jk,...ik->...i", share, state.covariance, share)
    alone = np.asarray(moved)[..., None] == [1, 2]
    which = alone.any(axis=-1, keepdims=True)
    change = np.where(which, alone * score / own, both)
    return change, np.sqrt(np.where(which, alone * single, total)), covariance


def set_off(state: AlarmState, raised: np.ndarray, best: np.ndarray) -> AlarmState:
    """An alarm begins: what comes from now on tells what moved."""
    anew = raised[..., None] & (np.arange(LENGTHS.size + 1) == LENGTHS.size)
    level = np.take_along_axis(state.mean[..., 0], best[..., None], -1)[..., 0]
    age = np.take_along_axis(state.age, best[..., None], -1)[..., 0]
    return emptied(state, anew)._replace(
        raised=np.where(raised, 0.0, state.raised),
        excess=np.where(raised, state.path[..., 0] - level, state.excess),
        before=np.where(raised, age, state.before),
    )


# Readings in which one false alarm is raised at most.
QUIET = 1e6
# After a step nothing is looked at for so long, s; after a gap all begins anew.
SETTLE = 10.0
# A reading off the pace before it by so many of its errors, or by such a share of the loss, begins
# anew: a refill, a lost bunch, a step of the clock.
JUMP, SHARE = 6.0, 0.15
# So does a setting, or a gauge, that moves what is expected by more: the two do not answer at once.
SET = 0.02
# Readings over which the noise is followed.
MEMORY = 300.0
# What an alarm is called before and after it is named.
NAMES = ("", "a", "b", "a and b", "a or b")


class Reference(NamedTuple):
    """Loss of the beam as long as nothing moves.

    Attributes
    ----------
    a, b : float
        Of dI/dt = -a I² - b I, 1/(mA s) and 1/s.
    noise : float
        Standard deviation of a reading, mA.
    correlation_time : float
        Of the part of that noise that has one, s; 0 where readings are independent.
    interval : float
        Usual time between readings, s.
    covariance : array, shape (2, 2)
        Of relative errors of a and b: how well they are known, and how far they wander on an
        ordinary day.
    white : float
        Share of the noise's variance without memory.
    wander : float
        By what share of themselves a and b differ from fill to fill, each by itself.
    power, current : float
        a goes as this power of the current, and is `a` at this one, mA.
    """

    a: float
    b: float
    noise: float
    correlation_time: float = 0.0
    interval: float = 1.0
    covariance: np.ndarray = WANDER**2 * np.eye(2)
    white: float = 0.0
    wander: float = WANDER
    power: float = 0.0
    current: float = 1.0

    def rates(self, current: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Loss rates by a and by b at a current, 1/s."""
        bent = (current / self.current) ** self.power if self.power else 1.0
        return self.a * current * bent, np.full_like(current, self.b)


class Reading(NamedTuple):
    """A reading of the beam current.

    Attributes
    ----------
    time : float
        s, of any origin.
    current : float
        mA; zero, negative or NaN is no reading.
    a_factor, b_factor : float
        a and b that are expected at the settings and the pressure of the moment, over those of the
        reference. A pressure that the gauge shows is then no alarm.
    """

    time: float
    current: float
    a_factor: float = 1.0
    b_factor: float = 1.0


class AlarmStep(NamedTuple):
    """Finding of the alarm at one reading.

    Attributes
    ----------
    raised : array of bool
        Whether an alarm is raised by this reading.
    moved : array of int
        What moved, once it is told: a place in `NAMES`; 0 otherwise.
    change, error : array, shape (..., 2)
        Relative changes of a and b with their errors; 0 and 0 of what did not move.
    since : array
        When the change began, s.
    """

    raised: np.ndarray
    moved: np.ndarray
    change: np.ndarray
    error: np.ndarray
    since: np.ndarray


def started(reference: Reference, shape: tuple[int, ...] = ()) -> AlarmState:
    """Begin to watch.

    Parameters
    ----------
    reference : Reference
        The usual loss.
    shape : tuple of int, optional
        Of many beams watched at once.

    Returns
    -------
    AlarmState
    """
    windows = (*shape, LENGTHS.size + 1)
    none, zero = np.full(shape, np.nan), np.zeros(shape)
    return AlarmState(
        time=none, current=none, step=zero, pace=zero, expected=np.ones((*shape, 2)), clock=zero,
        hold=zero, path=np.zeros((*shape, 3)), foretold=np.zeros((*shape, 4)), unsure=zero,
        noise=np.ones(shape), factor=np.ones((*shape, 2)),
        covariance=np.broadcast_to(np.asarray(reference.covariance, float), (*shape, 2, 2)),
        spread=np.full(shape, reference.wander**2),
        age=np.zeros(windows), weight=np.zeros(windows), mean=np.zeros((*windows, 3)),
        product=np.zeros((*windows, 2, 3)), past=np.zeros((*windows, 2, 3)), raised=none,
        excess=zero, before=zero,
    )  # fmt: skip


def watched(
    reference: Reference, state: AlarmState, reading: Reading
) -> tuple[AlarmState, AlarmStep]:
    """Take a reading.

    Parameters
    ----------
    reference : Reference
        The usual loss.
    state : AlarmState
        Of `started`, or of the reading before.
    reading : Reading
        The reading; of many beams, arrays.

    Returns
    -------
    AlarmState
        To be given with the next reading.
    AlarmStep
        Whether an alarm is raised, and what moved once that is told; after that the loss found is
        the usual one.

    Notes
    -----
    ln I follows -∫(a I + b)dt, so that its excess over the expected is linear in relative changes
    of a and b; each window fits them with an offset for every piece between refills, gaps and
    steps, by weighted sums of what each reading says beside those before it (Kalman filter of white
    noise and of one with the correlation exp(-dt/time)). With information J, score s and the
    reference's covariance C, the test of a change d = (1, 0) or (0, 1) is (dᵀ M s')²/(dᵀ M d),
    M = (1 + J C)⁻¹ J, s' = (1 + J C)⁻¹ s.
    What moved is told by readings after the alarm alone: a window that spans the change bends.

    Examples
    --------
    >>> usual = Reference(a=3.7e-8, b=9.3e-6, noise=1e-3)
    >>> state, beam = started(usual), 500.0
    >>> for second in range(1800):
    ...     worse = 1.1 if second > 600 else 1.0
    ...     beam *= 1 - worse * usual.a * beam - usual.b
    ...     state, told = watched(usual, state, Reading(second, beam))
    ...     if told.raised or told.moved:
    ...         print(second, NAMES[told.moved] or "raised", f"{100 * told.change[0]:.0f} % in a")
    618 raised 0 % in a
    1055 a 10 % in a
    """
    usable = np.isfinite(reading.current) & (np.nan_to_num(reading.current) > 0)
    reading = reading._replace(current=np.where(usable, reading.current, 1.0))
    after = _moved_on(reference, state, reading)
    after = AlarmState(*(either(usable, new, old) for new, old in zip(after, state, strict=True)))
    return _judged(reference, after, usable)


def is_gap(seconds: np.ndarray | float, interval: float) -> np.ndarray | bool:
    """True between readings so far apart that a piece begins anew."""
    return seconds > max(GAP * interval, MINUTE)


def _step(usual: Reference, state: AlarmState, reading: Reading) -> tuple[np.ndarray, ...]:
    """From one reading to the next: seconds, whether the path goes on, and whether it was cut by
    a step; how far ln I moved against the expected, with derivatives; what is expected of a and b;
    noise, its memory, and its change from reading to reading.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        seconds = np.asarray(reading.time - state.time)
        going = (seconds > 0) & ~is_gap(seconds, usual.interval)
        seconds = np.where(going, seconds, 1.0)
        middle = (reading.current + state.current) / 2
        by_a, by_b = usual.rates(middle)
        a_part = by_a * state.factor[..., 0] * reading.a_factor * seconds
        b_part = by_b * state.factor[..., 1] * reading.b_factor * seconds
        excess = np.log(reading.current / state.current) + a_part + b_part
        noise = usual.noise / reading.current * np.sqrt(state.noise)
        memory = np.zeros_like(seconds)
        if usual.correlation_time:
            memory = np.exp(-seconds / usual.correlation_time)
        # A longer interval than the last is held to the pace of the last and to the share.
        alike = np.where(state.step > 0, np.minimum(seconds, state.step), 0.0)
        ratio = alike / np.where(state.step > 0, state.step, 1.0)
        change = noise * np.sqrt(2 * (1 - (1 - usual.white) * memory))
        spread = change * np.sqrt(1 + ratio + ratio**2)
        off = np.abs(excess - state.pace * alike)
        level = off <= JUMP * spread + SHARE * (a_part + b_part)
        level &= excess - a_part - b_part <= JUMP * spread  # what rises is a refill
        expected = np.stack(np.broadcast_arrays(reading.a_factor, reading.b_factor, noise)[:2], -1)
        level &= (np.abs(expected / state.expected - 1) <= SET).all(-1)
    moved = np.stack([excess, -a_part, -b_part], axis=-1)
    return seconds, going & level, going & ~level, moved, expected, noise, memory, change


def _moved_on(usual: Reference, state: AlarmState, reading: Reading) -> AlarmState:
    """The path from the last reading to this one, and every window with it."""
    seconds, going, cut, moved, expected, noise, memory, change = _step(usual, state, reading)
    between = np.where(going, seconds, 0.0)
    hold = np.where(cut, SETTLE, np.maximum(state.hold - between, 0.0))
    path = np.where(going[..., None], state.path + np.where(going[..., None], moved, 0.0), 0.0)
    begins = ~going | (state.hold > 0)
    alone, weight, foretold, unsure = _alone(usual, state, path, np.where(begins, 0.0, memory))
    weight = np.where(hold > 0, 0.0, weight / noise**2)
    if begins.any():
        # The last piece of each window with those before it: another begins.
        past = either(begins, shown_in(state), state.past)
        state = state._replace(past=past, product=either(begins, 0.0, state.product))
    windows = with_reading(
        state, np.where(begins[..., None], 0.0, state.weight), alone, weight, between
    )
    known = going | cut
    off = moved[..., 0] ** 2 / change**2
    grown = np.where(going, np.minimum(off, JUMP**2) * state.noise - state.noise, 0.0) / MEMORY
    return state._replace(
        time=np.broadcast_to(reading.time, state.time.shape).astype(float),
        current=np.broadcast_to(reading.current, state.time.shape).astype(float),
        step=np.where(known, seconds, 0.0),
        pace=np.where(known, moved[..., 0] / seconds, 0.0),
        expected=expected,
        clock=state.clock + between,
        hold=hold,
        path=path,
        foretold=foretold,
        unsure=unsure,
        noise=np.maximum(state.noise + grown, 1.0),
        raised=state.raised + between,
        **windows,
    )


def _alone(
    usual: Reference, state: AlarmState, path: np.ndarray, kept: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Value and weight of a reading beside those before it, and the noise foretold by all of them.

    The Kalman filter of noise of which a part keeps so much from one reading to the next; the
    column of ones shows how much of an offset is left.
    """
    ahead = kept[..., None] * state.foretold
    unsure = kept**2 * state.unsure + (1 - usual.white) * (1 - kept**2)
    news = np.concatenate([path, np.ones_like(path[..., :1])], axis=-1) - ahead
    gain = unsure / (unsure + usual.white)
    weight = news[..., 3] ** 2 / (unsure + usual.white)
    alone = news[..., :3] / news[..., 3:]
    return alone, weight, ahead + gain[..., None] * news, (1 - gain) * unsure


def _judged(
    usual: Reference, state: AlarmState, usable: np.ndarray
) -> tuple[AlarmState, AlarmStep]:
    quiet = np.isnan(state.raised)
    raised, best = _shown(usual, state)
    raised &= quiet & usable
    if raised.any():
        state = set_off(state, raised, best)
    apart = np.zeros(quiet.shape, int)
    if not quiet.all():
        a, b, both = seen_in(state, slice(-1, None)).evidence[..., 0]
        a, b = (np.where(_is_loss(state, k), v, -np.inf) for k, v in ((1, a), (2, b)))
        either_one = np.logaddexp(a, b)
        found = [both - either_one, a - np.logaddexp(b, 0.0), b - np.logaddexp(a, 0.0)]
        found = [odds > CLEAR_ODDS for odds in found]
        apart = np.select(found, [3, 1, 2], 0)
    late = 4 * (state.raised > HOUR)  # it goes without a name
    settled = ~quiet & usable & (state.age[..., -1] >= MINUTE)
    moved = np.where(settled, np.where(apart > 0, apart, late), 0)
    if not moved.any():
        nothing = np.zeros_like(state.factor)
        return state, AlarmStep(raised, moved, nothing, nothing, state.time)
    change, error, covariance = change_since(state, moved)
    told = AlarmStep(raised, moved, change, error, _since(usual, state, change))
    return _adopted(state, moved > 0, change, covariance), told


def _is_loss(state: AlarmState, moved: int) -> np.ndarray:
    """Tell if what moved alone, a or b, may still be above zero: a current that stops to fall, as
    of a monitor that stands still, has lost both.
    """
    change, error, _ = change_since(state, np.full(state.raised.shape, moved))
    return (1 + change + MIN_SINGULAR_VALUE * error)[..., moved - 1] > 0


def _shown(usual: Reference, state: AlarmState) -> tuple[np.ndarray, np.ndarray]:
    """If a window shows a change of a or b, and which shows it best.

    Each one that begins ever shows so much with one over that as probability, at most.
    """
    least = math.log(QUIET * usual.interval * np.sum(1 / LENGTHS))
    seen = seen_in(state, slice(None, -1))
    old = state.age[..., :-1] >= MINUTE
    most = np.where(old, np.maximum(*seen.squares[:2]), 0.0)
    if most.max(initial=0.0) <= 2 * least:  # no evidence is above half of that
        return np.zeros(state.time.shape, bool), np.zeros(state.time.shape, int)
    evidence = np.where(old, np.logaddexp(*seen.evidence[:2]) - math.log(2.0), -np.inf)
    return evidence.max(-1) > least, np.argmax(evidence, axis=-1)


def _since(usual: Reference, state: AlarmState, change: np.ndarray) -> np.ndarray:
    """When the loss found later had made the excess that raised the alarm, within its window."""
    rates = np.stack(usual.rates(state.current), axis=-1)
    pace = -np.sum(rates * state.factor * change, axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        made = np.clip(np.nan_to_num(state.excess / pace), 0.0, state.before)
    return state.time - state.raised - made


def _adopted(
    state: AlarmState, done: np.ndarray, change: np.ndarray, covariance: np.ndarray
) -> AlarmState:
    """After a named alarm, take the loss that was found as the usual one."""
    factor, covariance = state.factor * (1 + change), state.covariance + covariance
    new = {"factor": factor, "covariance": covariance, "raised": np.full_like(state.raised, np.nan)}
    state = emptied(state, done[..., None])
    return state._replace(**{n: either(done, v, getattr(state, n)) for n, v in new.items()})


class Alarm(NamedTuple):
    """A change of the loss.

    Attributes
    ----------
    time : float
        When it was raised, s.
    since : float
        When the change began, s.
    told : float or None
        When it was told what moved, s; None where the record ends before.
    moved : str
        "a", "b", "a and b", or "a or b" where the readings do not tell.
    a, b : Quantity or None
        Relative change, of 1; None of what did not move.
    """

    time: float
    since: float
    told: float | None
    moved: str
    a: Quantity | None
    b: Quantity | None

    def said(self, dated: bool) -> str:
        """In words, with the date where times are Unix times."""
        changes = [
            f"{name} moved by {relative_change(found)}"
            for name, found in (("a", self.a), ("b", self.b))
            if found is not None and self.moved != "a or b"
        ]
        what = " and ".join(changes) or "a or b moved, the readings do not tell which,"
        return f"{what} since {when(self.since, dated)}"


def alarms_of(
    reference: Reference,
    time: np.ndarray,
    current: np.ndarray,
    a_factor: float | np.ndarray = 1.0,
    b_factor: float | np.ndarray = 1.0,
) -> tuple[Alarm, ...]:
    """Watch readings from the first to the last.

    Parameters
    ----------
    reference : Reference
        The usual loss.
    time, current : array, shape (n,)
        s and mA, with refills and gaps.
    a_factor, b_factor : float or array, shape (n,)
        Expected a and b over those of the reference.

    Returns
    -------
    tuple of Alarm
        In order of time.
    """
    state, alarms, raised = started(reference), [], None
    for row in np.stack(np.broadcast_arrays(time, current, a_factor, b_factor), axis=-1):
        state, told = watched(reference, state, Reading(*row))
        raised = float(row[0]) if told.raised else raised
        if told.moved:
            alarms.append(alarm_of(raised, told, float(row[0])))
            raised = None
    if raised is not None:
        change, error, _ = change_since(state, np.int64(4))
        since = _since(reference, state, change)
        alarms.append(alarm_of(raised, AlarmStep(True, 4, change, error, since), None))
    return tuple(alarms)


def alarm_of(raised: float, told: AlarmStep, at: float | None) -> Alarm:
    """Make the alarm of a finding, with its time."""
    moved = NAMES[int(told.moved)]
    a, b = (
        Quantity(float(v), float(e), "1") if name in moved.split() else None
        for name, v, e in zip("ab", told.change, told.error, strict=True)
    )
    # Time is not counted at refills: a change seems to begin late by them.
    return Alarm(raised, min(float(told.since), raised), at, moved, a, b)


def when(time: float, dated: bool) -> str:
    """A time as a date, or in hours of the record."""
    if not dated:
        return f"{time / HOUR:.2f} h"
    return datetime.fromtimestamp(60 * round(time / 60), UTC).strftime("%Y-%m-%d %H:%M")
