"""Alarm on a change of the loss, reading by reading: which of a and b changed, when, by how much.

Sequential likelihood-ratio test over windows of 4 to 128 minutes, for a change of a and for a
change of b. Windows in geometric progression lose little against all windows: T. L. Lai,
J. R. Stat. Soc. B 57 (1995) 613.
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
# Longest age of each window, s, and the offset of its start: four windows of each length start in
# turn, so that there is always one of nearly any age.
LENGTHS = np.repeat([4.0, 8.0, 16.0, 32.0, 64.0, 128.0], 4) * MINUTE
PHASES = LENGTHS * np.tile([0.0, 0.25, 0.5, 0.75], 6)
# Standard deviation of the prior of the relative changes of a and b after an alarm: chosen wide, so
# that it matters only where the readings determine nothing.
CHANGE_PRIOR_WIDTH = 0.3
# Relative standard deviation of a and of b on an ordinary day, and from fill to fill where that is
# not known: changes of this size raise no alarm.
WANDER = 0.005


class AlarmState(NamedTuple):
    """Sums kept between readings. Arrays may have leading axes, for many beams at once.

    The last of the w windows is not periodic: it begins at the alarm.

    Attributes
    ----------
    time, current : array
        Last reading, s and mA.
    interval, excess_rate : array
        Interval between the last two readings, s, and rise of ln I over the expected in it, 1/s.
    expected : array, shape (..., 2)
        Factors of a and b expected at the last reading.
    clock, wait : array
        Time watched, s, and time still to wait after a step, s.
    path : array, shape (..., 3)
        ln I less the expected ln I since the last step, and its derivatives by relative changes of
        a and b.
    noise_estimate, estimate_variance : array, shapes (..., 4), (...)
        Correlated noise estimated by the Kalman filter, for the path and for an offset of 1, and
        the variance of this estimate over the noise variance.
    noise : array
        Variance of the readings over that of the reference.
    factor, covariance : array, shapes (..., 2), (..., 2, 2)
        a and b over the reference's after earlier alarms, and their relative covariance.
    fill_variance : array
        Relative variance of a and of b from fill to fill.
    age : array, shape (..., w)
        Age of each window, s.
    weight, mean, products : array, shapes (..., w), (..., w, 3), (..., w, 2, 3)
        Sums over the last piece of each window: total weight, mean path, and central cross products
        of the derivatives with themselves (the information) and with ln I (the score).
    past_products : array, shape (..., w, 2, 3)
        Cross products of the earlier pieces, summed, with a and b of each piece integrated out.
    raised, excess, window_age : array
        Time since the alarm, s, NaN where there is none; ln I less the expected at the alarm, and
        age, s, of the window that raised it.
    """

    time: np.ndarray
    current: np.ndarray
    interval: np.ndarray
    excess_rate: np.ndarray
    expected: np.ndarray
    clock: np.ndarray
    wait: np.ndarray
    path: np.ndarray
    noise_estimate: np.ndarray
    estimate_variance: np.ndarray
    noise: np.ndarray
    factor: np.ndarray
    covariance: np.ndarray
    fill_variance: np.ndarray
    age: np.ndarray
    weight: np.ndarray
    mean: np.ndarray
    products: np.ndarray
    past_products: np.ndarray
    raised: np.ndarray
    excess: np.ndarray
    window_age: np.ndarray


def choose(chosen: np.ndarray, new: np.ndarray, old: np.ndarray) -> np.ndarray:
    """Select `new` where `chosen`, else `old`, along the leading axes."""
    shape = np.shape(chosen) + (1,) * (np.ndim(old) - np.ndim(chosen))
    return np.where(np.reshape(chosen, shape), new, old)


def reset_windows(state: AlarmState, chosen: np.ndarray) -> AlarmState:
    """Reset the chosen windows, shape (..., w)."""
    names = ("age", "weight", "products", "past_products")
    return state._replace(**{name: choose(chosen, 0.0, getattr(state, name)) for name in names})


def update_windows(
    state: AlarmState,
    weight_before: np.ndarray,
    path: np.ndarray,
    weight: np.ndarray,
    seconds: np.ndarray,
) -> dict[str, np.ndarray]:
    """Add a reading to the sums of all windows (Welford's update); restart windows that are full.

    A piece begins, with a free offset, where `weight_before` is zero.
    """
    clock = state.clock[..., None]
    periods = np.floor((clock - PHASES) / LENGTHS)
    due = np.floor((clock + seconds[..., None] - PHASES) / LENGTHS) > periods
    due = np.concatenate([due, np.zeros_like(clock, bool)], axis=-1)
    state, weight_before = reset_windows(state, due), np.where(due, 0.0, weight_before)
    total = weight_before + weight[..., None]
    share = np.where(total > 0, weight[..., None] / np.where(total > 0, total, 1.0), 0.0)
    deviation = np.where((weight_before > 0)[..., None], path[..., None, :] - state.mean, 0.0)
    start = (weight_before == 0)[..., None] & (weight > 0)[..., None, None]
    mean = np.where(start, path[..., None, :], state.mean + share[..., None] * deviation)
    pairs = deviation[..., 1:, None] * deviation[..., None, [1, 2, 0]]
    products = state.products + (share * weight_before)[..., None, None] * pairs
    age = state.age + seconds[..., None]
    return {
        "age": age,
        "weight": total,
        "mean": mean,
        "products": products,
        "past_products": state.past_products,
    }


def integrate_out(products: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Integrate out independent changes of a and b with covariance C.

    For information J and score s the result is (1 + J C)⁻¹ (J, s).
    """
    return np.linalg.solve(np.eye(2) + products[..., :2] @ covariance, products)


def window_products(state: AlarmState, windows: slice = slice(None)) -> np.ndarray:
    """Information and score on a lasting change from all pieces of some windows."""
    variance = state.fill_variance[..., None, None, None] * np.eye(2)
    products = state.products[..., windows, :, :]
    return state.past_products[..., windows, :, :] + integrate_out(products, variance)


class ChangeStatistics(NamedTuple):
    """Test statistics of a change of a alone, b alone, and b in addition to a, in each window.

    Attributes
    ----------
    squares : array, shape (3, ..., w)
        (change / error)².
    information : array, shape (3, ..., w)
        1 / error² of the relative change.
    """

    squares: np.ndarray
    information: np.ndarray

    @property
    def evidence(self) -> np.ndarray:
        """Log evidence ratio of a change of a, of b, and of both, to no change."""
        a, b, b_after_a = log_evidence_of_change(*self)
        return np.stack([a, b, a + b_after_a])


def change_statistics(state: AlarmState, windows: slice = slice(None)) -> ChangeStatistics:
    """Test statistics of a change in some of the windows."""
    found = integrate_out(window_products(state, windows), state.covariance[..., None, :, :])
    (maa, mab, sa), (_, mbb, sb) = np.moveaxis(found, (-2, -1), (0, 1))
    ratio = mab / np.where(maa > 0, maa, np.inf)
    score_left, information_left = sb - sa * ratio, mbb - mab * ratio
    # Where only rounding errors are left a and b are not separable.
    information_left = np.where(information_left > 1e-9 * mbb, information_left, 0.0)
    scores, information = np.stack([sa, sb, score_left]), np.stack([maa, mbb, information_left])
    return ChangeStatistics(scores**2 / np.where(information > 0, information, np.inf), information)


def estimate_change(
    state: AlarmState, moved: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Estimate relative changes of a and b since the alarm, with errors, and their covariance.

    If `moved` is 1 or 2 only a or b changes, else both. Errors include those of the reference; the
    covariance does not.
    """
    products = window_products(state, slice(-1, None))[..., 0, :, :]
    products = products + CHANGE_PRIOR_WIDTH**-2 * np.eye(2, 3)
    information, score = products[..., :2], products[..., 2]
    information_alone = np.diagonal(information, axis1=-2, axis2=-1)
    share, covariance = information / information_alone[..., None], np.linalg.inv(information)
    both = np.einsum("...ij,...j->...i", covariance, score)
    variance = np.diagonal(covariance + state.covariance, axis1=-2, axis2=-1)
    variance_alone = np.einsum("...ij,...jk,...ik->...i", share, state.covariance, share)
    variance_alone = variance_alone + 1 / information_alone
    alone = np.asarray(moved)[..., None] == [1, 2]
    only_one = alone.any(axis=-1, keepdims=True)
    change = np.where(only_one, alone * score / information_alone, both)
    return change, np.sqrt(np.where(only_one, alone * variance_alone, variance)), covariance


def raise_alarm(state: AlarmState, raised: np.ndarray, best: np.ndarray) -> AlarmState:
    """Raise the alarm: start the window from which the change is identified.

    `best` is the index of the window that raised it.
    """
    restarted = raised[..., None] & (np.arange(LENGTHS.size + 1) == LENGTHS.size)
    level = np.take_along_axis(state.mean[..., 0], best[..., None], -1)[..., 0]
    age = np.take_along_axis(state.age, best[..., None], -1)[..., 0]
    return reset_windows(state, restarted)._replace(
        raised=np.where(raised, 0.0, state.raised),
        excess=np.where(raised, state.path[..., 0] - level, state.excess),
        window_age=np.where(raised, age, state.window_age),
    )


# Readings per false alarm, at least: twelve days at a reading a second.
READINGS_PER_FALSE_ALARM = 1e6
# Readings are ignored for this time after a step, s: chosen, for monitor and beam to settle.
SETTLING_TIME = 10.0
# Deviation from the loss rate of the previous interval, in standard errors plus a share of the
# loss, beyond which a new piece begins: a refill, a lost bunch, a step of the clock.
STEP_ERRORS, STEP_SHARE = 6.0, 0.15
# Relative change of the expected a or b, by a setting or a gauge, at which a new piece begins:
# beam and read-back do not change at the same instant.
EXPECTATION_STEP = 0.02
# Number of readings over which the noise level is averaged: chosen, five minutes at 1 Hz.
NOISE_READINGS = 300.0
# Labels of what changed, by the number `AlarmStep.moved`.
NAMES = ("", "a", "b", "a and b", "a or b")


class Reference(NamedTuple):
    """Usual loss and noise of a beam, against which readings are compared.

    Attributes
    ----------
    a, b : float
        Coefficients of dI/dt = -a I² - b I, 1/(mA s) and 1/s.
    noise : float
        Standard deviation of a reading, mA.
    correlation_time : float
        Correlation time of the correlated part of the noise, s; 0 where readings are independent.
    interval : float
        Usual time between readings, s.
    covariance : array, shape (2, 2)
        Covariance of the relative errors of a and b: of the estimate and of the ordinary wander.
    white : float
        Share of the noise variance without correlation.
    wander : float
        Relative standard deviation of a and of b from fill to fill, independent of each other.
    power, current : float
        a goes as (I / current)^power, with `current` in mA.
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
        """Loss rates of a and of b at a current, 1/s."""
        bent = (current / self.current) ** self.power if self.power else 1.0
        return self.a * current * bent, np.full_like(current, self.b)


class Reading(NamedTuple):
    """A reading of the beam current.

    Attributes
    ----------
    time : float
        Time, s, of any origin.
    current : float
        Beam current, mA; a value that is zero, negative or NaN is ignored.
    a_factor, b_factor : float
        Expected a and b at the present settings and pressure, over those of the reference: with
        them a change of pressure that the gauge shows raises no alarm.
    """

    time: float
    current: float
    a_factor: float = 1.0
    b_factor: float = 1.0


class AlarmStep(NamedTuple):
    """Result of one reading.

    Attributes
    ----------
    raised : array of bool
        Whether this reading raises an alarm.
    moved : array of int
        What changed, as index of `NAMES`, once it is identified; 0 otherwise.
    change, error : array, shape (..., 2)
        Relative changes of a and b with their errors; 0 and 0 for what did not change.
    since : array
        Time at which the change began, s.
    """

    raised: np.ndarray
    moved: np.ndarray
    change: np.ndarray
    error: np.ndarray
    since: np.ndarray


def initial_state(reference: Reference, shape: tuple[int, ...] = ()) -> AlarmState:
    """Begin to watch.

    Parameters
    ----------
    reference : Reference
        Usual loss.
    shape : tuple of int, optional
        Shape of the leading axes, for many beams at once.

    Returns
    -------
    AlarmState
    """
    windows = (*shape, LENGTHS.size + 1)
    none, zero = np.full(shape, np.nan), np.zeros(shape)
    return AlarmState(
        time=none, current=none, interval=zero, excess_rate=zero,
        expected=np.ones((*shape, 2)), clock=zero, wait=zero, path=np.zeros((*shape, 3)),
        noise_estimate=np.zeros((*shape, 4)), estimate_variance=zero,
        noise=np.ones(shape), factor=np.ones((*shape, 2)),
        covariance=np.broadcast_to(np.asarray(reference.covariance, float), (*shape, 2, 2)),
        fill_variance=np.full(shape, reference.wander**2),
        age=np.zeros(windows), weight=np.zeros(windows), mean=np.zeros((*windows, 3)),
        products=np.zeros((*windows, 2, 3)), past_products=np.zeros((*windows, 2, 3)), raised=none,
        excess=zero, window_age=zero,
    )  # fmt: skip


def watched(
    reference: Reference, state: AlarmState, reading: Reading
) -> tuple[AlarmState, AlarmStep]:
    """Take a reading.

    Parameters
    ----------
    reference : Reference
        Usual loss.
    state : AlarmState
        From `initial_state` or from the previous reading.
    reading : Reading
        The reading; arrays for many beams.

    Returns
    -------
    AlarmState
        State for the next reading.
    AlarmStep
        Whether an alarm is raised, and what changed once that is identified. From then on the new
        loss is the usual one.

    Notes
    -----
    ln I follows -∫(a I + b)dt, so its deviation from the expected is linear in relative changes of
    a and b. Each window fits them, and an offset for every piece between refills, gaps and steps,
    by sums over whitened readings: the innovations of a Kalman filter of white noise and noise with
    correlation exp(-dt/correlation_time). With information J, score s and the covariance C of the
    reference, M = (1 + J C)⁻¹ J and s' = (1 + J C)⁻¹ s, and the test statistic of a change of a or
    b is s'ᵢ²/Mᵢᵢ.
    Only readings after the alarm identify what changed: in a window that spans the change, the
    step itself looks like curvature.

    Examples
    --------
    >>> usual = Reference(a=3.7e-8, b=9.3e-6, noise=1e-3)
    >>> state, beam = initial_state(usual), 500.0
    >>> for second in range(1800):
    ...     worse = 1.1 if second > 600 else 1.0
    ...     beam *= 1 - worse * usual.a * beam - usual.b
    ...     state, step = watched(usual, state, Reading(second, beam))
    ...     if step.raised or step.moved:
    ...         print(second, NAMES[step.moved] or "raised", f"{100 * step.change[0]:.0f} % in a")
    618 raised 0 % in a
    1055 a 10 % in a
    """
    usable = np.isfinite(reading.current) & (np.nan_to_num(reading.current) > 0)
    reading = reading._replace(current=np.where(usable, reading.current, 1.0))
    after = _advance(reference, state, reading)
    after = AlarmState(*(choose(usable, new, old) for new, old in zip(after, state, strict=True)))
    return _judge(reference, after, usable)


def is_gap(seconds: np.ndarray | float, interval: float) -> np.ndarray | bool:
    """Return True if two readings are so far apart that a new piece begins."""
    return seconds > max(GAP * interval, MINUTE)


class _Increment(NamedTuple):
    """Difference of a reading from the previous one.

    Attributes
    ----------
    seconds : array
        Time between them, s; 1 across a gap.
    continues, ended : array of bool
        Whether the piece continues, and whether a step (no gap) ends it.
    moved : array, shape (..., 3)
        Change of ln I less the expected change, and its derivatives by relative changes of a and b.
    expected : array, shape (..., 2)
        Expected factors of a and b.
    noise, memory, change : array
        Relative noise of a reading, its correlation with the previous reading, and the standard
        deviation of the difference of the two.
    """

    seconds: np.ndarray
    continues: np.ndarray
    ended: np.ndarray
    moved: np.ndarray
    expected: np.ndarray
    noise: np.ndarray
    memory: np.ndarray
    change: np.ndarray


def _increment(reference: Reference, state: AlarmState, reading: Reading) -> _Increment:
    with np.errstate(invalid="ignore", divide="ignore"):
        seconds = np.asarray(reading.time - state.time)
        going = (seconds > 0) & ~is_gap(seconds, reference.interval)
        seconds = np.where(going, seconds, 1.0)
        middle = (reading.current + state.current) / 2
        by_a, by_b = reference.rates(middle)
        a_part = by_a * state.factor[..., 0] * reading.a_factor * seconds
        b_part = by_b * state.factor[..., 1] * reading.b_factor * seconds
        excess = np.log(reading.current / state.current) + a_part + b_part
        noise = reference.noise / reading.current * np.sqrt(state.noise)
        memory = np.zeros_like(seconds)
        if reference.correlation_time:
            memory = np.exp(-seconds / reference.correlation_time)
        # The excess expected from the rate in the last interval, over at most its length.
        extrapolated = np.where(state.interval > 0, np.minimum(seconds, state.interval), 0.0)
        ratio = extrapolated / np.where(state.interval > 0, state.interval, 1.0)
        change = noise * np.sqrt(2 * (1 - (1 - reference.white) * memory))
        sigma = change * np.sqrt(1 + ratio + ratio**2)
        deviation = np.abs(excess - state.excess_rate * extrapolated)
        continues = deviation <= STEP_ERRORS * sigma + STEP_SHARE * (a_part + b_part)
        continues &= excess - a_part - b_part <= STEP_ERRORS * sigma  # a rising current is a refill
        expected = np.stack(np.broadcast_arrays(reading.a_factor, reading.b_factor, noise)[:2], -1)
        continues &= (np.abs(expected / state.expected - 1) <= EXPECTATION_STEP).all(-1)
    moved = np.stack([excess, -a_part, -b_part], axis=-1)
    ended = going & ~continues
    return _Increment(seconds, going & continues, ended, moved, expected, noise, memory, change)


def _advance(reference: Reference, state: AlarmState, reading: Reading) -> AlarmState:
    """Advance path, noise and windows by one reading."""
    step = _increment(reference, state, reading)
    elapsed = np.where(step.continues, step.seconds, 0.0)
    wait = np.where(step.ended, SETTLING_TIME, np.maximum(state.wait - elapsed, 0.0))
    path = np.where(step.continues[..., None], state.path + step.moved, 0.0)
    begins = ~step.continues | (state.wait > 0)
    memory = np.where(begins, 0.0, step.memory)
    whitened, weight, noise_estimate, estimate_variance = _whiten(reference, state, path, memory)
    weight = np.where(wait > 0, 0.0, weight / step.noise**2)
    if begins.any():
        # A new piece begins: add the finished one to the past of each window.
        past_products = choose(begins, window_products(state), state.past_products)
        products = choose(begins, 0.0, state.products)
        state = state._replace(past_products=past_products, products=products)
    weight_before = np.where(begins[..., None], 0.0, state.weight)
    windows = update_windows(state, weight_before, whitened, weight, elapsed)
    no_gap = step.continues | step.ended
    square = np.minimum(step.moved[..., 0] ** 2 / step.change**2, STEP_ERRORS**2)
    trend = np.where(step.continues, square * state.noise - state.noise, 0.0)
    return state._replace(
        time=np.broadcast_to(reading.time, state.time.shape).astype(float),
        current=np.broadcast_to(reading.current, state.time.shape).astype(float),
        interval=np.where(no_gap, step.seconds, 0.0),
        excess_rate=np.where(no_gap, step.moved[..., 0] / step.seconds, 0.0),
        expected=step.expected,
        clock=state.clock + elapsed,
        wait=wait,
        path=path,
        noise_estimate=noise_estimate,
        estimate_variance=estimate_variance,
        noise=np.maximum(state.noise + trend / NOISE_READINGS, 1.0),
        raised=state.raised + elapsed,
        **windows,
    )


def _whiten(
    reference: Reference, state: AlarmState, path: np.ndarray, memory: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Whiten a reading: subtract the correlated noise predicted by a Kalman filter.

    The correlated part of the noise keeps the share `memory` from one reading to the next. The
    filter also runs over a column of ones, by which the innovation is divided, so that an offset
    of the piece stays an offset.

    Returns
    -------
    whitened, weight : array, shapes (..., 3), (...)
        Path of the reading without the predicted noise, and its weight in units of 1 / variance
        of the noise.
    noise_estimate, estimate_variance : array
        Estimated noise and its variance after this reading.
    """
    predicted = memory[..., None] * state.noise_estimate
    estimate_variance = memory**2 * state.estimate_variance + (1 - reference.white) * (
        1 - memory**2
    )
    innovation = np.concatenate([path, np.ones_like(path[..., :1])], axis=-1) - predicted
    gain = estimate_variance / (estimate_variance + reference.white)
    weight = innovation[..., 3] ** 2 / (estimate_variance + reference.white)
    whitened = innovation[..., :3] / innovation[..., 3:]
    noise_estimate = predicted + gain[..., None] * innovation
    return whitened, weight, noise_estimate, (1 - gain) * estimate_variance


def _judge(
    reference: Reference, state: AlarmState, usable: np.ndarray
) -> tuple[AlarmState, AlarmStep]:
    quiet = np.isnan(state.raised)
    raised, best = _detect(reference, state)
    raised &= quiet & usable
    if raised.any():
        state = raise_alarm(state, raised, best)
    identified = np.zeros(quiet.shape, int)
    if not quiet.all():
        a, b, both = change_statistics(state, slice(-1, None)).evidence[..., 0]
        a, b = (np.where(_may_be_loss(state, k), v, -np.inf) for k, v in ((1, a), (2, b)))
        single = np.logaddexp(a, b)
        clear = [both - single, a - np.logaddexp(b, 0.0), b - np.logaddexp(a, 0.0)]
        clear = [odds > CLEAR_ODDS for odds in clear]
        identified = np.select(clear, [3, 1, 2], 0)
    timed_out = 4 * (state.raised > HOUR)  # not identified within an hour: "a or b"
    settled = ~quiet & usable & (state.age[..., -1] >= MINUTE)
    moved = np.where(settled, np.where(identified > 0, identified, timed_out), 0)
    if not moved.any():
        nothing = np.zeros_like(state.factor)
        return state, AlarmStep(raised, moved, nothing, nothing, state.time)
    change, error, covariance = estimate_change(state, moved)
    step = AlarmStep(raised, moved, change, error, _change_start(reference, state, change))
    return _adopt(state, moved > 0, change, covariance), step


def _may_be_loss(state: AlarmState, moved: int) -> np.ndarray:
    """Return True if the changed a or b may still be above zero.

    A current that no longer falls, as of a monitor that is stuck, has lost both.
    """
    change, error, _ = estimate_change(state, np.full(state.raised.shape, moved))
    return (1 + change + MIN_SINGULAR_VALUE * error)[..., moved - 1] > 0


def _detect(reference: Reference, state: AlarmState) -> tuple[np.ndarray, np.ndarray]:
    """Return whether a window shows a change of a or b, and the index of the clearest one.

    Without a change the evidence ratio of a window ever exceeds c with probability 1/c at most, so
    the threshold is the number of windows that begin in `READINGS_PER_FALSE_ALARM` readings.
    """
    threshold = math.log(READINGS_PER_FALSE_ALARM * reference.interval * np.sum(1 / LENGTHS))
    statistics = change_statistics(state, slice(None, -1))
    old_enough = state.age[..., :-1] >= MINUTE
    largest = np.where(old_enough, np.maximum(*statistics.squares[:2]), 0.0)
    # The log evidence is at most half of the largest square.
    if largest.max(initial=0.0) <= 2 * threshold:
        return np.zeros(state.time.shape, bool), np.zeros(state.time.shape, int)
    evidence = np.where(old_enough, np.logaddexp(*statistics.evidence[:2]) - math.log(2.0), -np.inf)
    return evidence.max(-1) > threshold, np.argmax(evidence, axis=-1)


def _change_start(reference: Reference, state: AlarmState, change: np.ndarray) -> np.ndarray:
    """Time at which the change began: the new loss made the excess at the alarm since then.

    It lies within the window that raised the alarm.
    """
    rates = np.stack(reference.rates(state.current), axis=-1)
    excess_rate = -np.sum(rates * state.factor * change, axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        duration = np.clip(np.nan_to_num(state.excess / excess_rate), 0.0, state.window_age)
    return state.time - state.raised - duration


def _adopt(
    state: AlarmState, identified: np.ndarray, change: np.ndarray, covariance: np.ndarray
) -> AlarmState:
    """Take the new loss as the usual one after an identified change."""
    factor, covariance = state.factor * (1 + change), state.covariance + covariance
    new = {"factor": factor, "covariance": covariance, "raised": np.full_like(state.raised, np.nan)}
    state = reset_windows(state, identified[..., None])
    return state._replace(**{n: choose(identified, v, getattr(state, n)) for n, v in new.items()})


class Alarm(NamedTuple):
    """A change of the loss.

    Attributes
    ----------
    time : float
        Time of the alarm, s.
    since : float
        Time at which the change began, s.
    told : float or None
        Time at which the change was identified, s; None if the record ends before.
    moved : str
        What changed: "a", "b", "a and b", or "a or b" if the readings do not show which.
    a, b : Quantity or None
        Relative change; None for what did not change.
    """

    time: float
    since: float
    told: float | None
    moved: str
    a: Quantity | None
    b: Quantity | None

    def text(self, dated: bool) -> str:
        """Sentence on the change; `dated` if times are Unix times."""
        changes = [
            f"{name} moved by {relative_change(found)}"
            for name, found in (("a", self.a), ("b", self.b))
            if found is not None and self.moved != "a or b"
        ]
        what = " and ".join(changes) or "a or b moved, the readings do not tell which,"
        return f"{what} since {time_label(self.since, dated)}"


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
        Usual loss.
    time, current : array, shape (n,)
        Readings, s and mA, with refills and gaps.
    a_factor, b_factor : float or array, shape (n,)
        Expected a and b over those of the reference.

    Returns
    -------
    tuple of Alarm
        In order of time.
    """
    state, alarms, raised_at = initial_state(reference), [], None
    for row in np.stack(np.broadcast_arrays(time, current, a_factor, b_factor), axis=-1):
        state, step = watched(reference, state, Reading(*row))
        raised_at = float(row[0]) if step.raised else raised_at
        if step.moved:
            alarms.append(make_alarm(raised_at, step, float(row[0])))
            raised_at = None
    if raised_at is not None:
        change, error, _ = estimate_change(state, np.int64(4))
        since = _change_start(reference, state, change)
        alarms.append(make_alarm(raised_at, AlarmStep(True, 4, change, error, since), None))
    return tuple(alarms)


def make_alarm(raised_at: float, step: AlarmStep, identified_at: float | None) -> Alarm:
    """Alarm from the result of a reading, raised and identified at these times, s."""
    moved = NAMES[int(step.moved)]
    a, b = (
        Quantity(float(v), float(e), "1") if name in moved.split() else None
        for name, v, e in zip("ab", step.change, step.error, strict=True)
    )
    # Refills are not counted as time, so the computed start may be too late.
    return Alarm(raised_at, min(float(step.since), raised_at), identified_at, moved, a, b)


def time_label(time: float, dated: bool) -> str:
    """Time as a date, or in hours of the record."""
    if not dated:
        return f"{time / HOUR:.2f} h"
    return datetime.fromtimestamp(60 * round(time / 60), UTC).strftime("%Y-%m-%d %H:%M")
