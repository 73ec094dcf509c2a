"""Windows on the loss of a beam: sums over readings of each, and what they say of a and b."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

MINUTE = 60.0
# Windows, s: four begin in turn in each length, so that one of nearly any age is at hand.
LENGTHS = np.repeat([4.0, 8.0, 16.0, 32.0, 64.0, 128.0], 4) * MINUTE
PHASES = LENGTHS * np.tile([0.0, 0.25, 0.5, 0.75], 6)
# Before an alarm a and b may be off by this much.
WIDE = 0.3


class State(NamedTuple):
    """What is remembered between readings; arrays may have leading axes, of many beams at once.

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
    noise : array
        Variance of readings over that of the reference.
    factor, covariance : array, shapes (..., 2), (..., 2, 2)
        a and b over the reference's after earlier alarms, and their relative covariance.
    age, weight, mean, product : array, shapes (..., w), (..., w), (..., w, 3), (..., w, 5)
        Of each window and of what came since the alarm, in the last place: seconds, sum of
        weights, means and central products of the path.
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
    noise: np.ndarray
    factor: np.ndarray
    covariance: np.ndarray
    age: np.ndarray
    weight: np.ndarray
    mean: np.ndarray
    product: np.ndarray
    raised: np.ndarray
    excess: np.ndarray
    before: np.ndarray


def either(chosen: np.ndarray, new: np.ndarray, old: np.ndarray) -> np.ndarray:
    """One or the other, by the leading axes."""
    shape = np.shape(chosen) + (1,) * (np.ndim(old) - np.ndim(chosen))
    return np.where(np.reshape(chosen, shape), new, old)


def with_reading(
    state: State, before: np.ndarray, path: np.ndarray, weight: np.ndarray, step: np.ndarray
) -> dict[str, np.ndarray]:
    """Weighted means and central products with one reading more (Welford); those due, anew.

    Where the weight before is zero the piece begins, and its offset is free.
    """
    clock = state.clock[..., None]
    turns = np.floor((clock - PHASES) / LENGTHS)
    due = np.floor((clock + step[..., None] - PHASES) / LENGTHS) > turns
    due = np.concatenate([due, np.zeros_like(clock, bool)], axis=-1)
    before = np.where(due, 0.0, before)
    total = before + weight[..., None]
    share = np.where(total > 0, weight[..., None] / np.where(total > 0, total, 1.0), 0.0)
    off = np.where((before > 0)[..., None], path[..., None, :] - state.mean, 0.0)
    start = (before == 0)[..., None] & (weight > 0)[..., None, None]
    mean = np.where(start, path[..., None, :], state.mean + share[..., None] * off)
    y, u, v = np.moveaxis(off, -1, 0)
    pairs = np.stack([u * u, u * v, v * v, u * y, v * y], axis=-1)
    product = np.where(due[..., None], 0.0, state.product)
    product = product + (share * before)[..., None] * pairs
    age = np.where(due, 0.0, state.age) + step[..., None]
    return {"age": age, "weight": total, "mean": mean, "product": product}


def falls_of(state: State) -> tuple[np.ndarray, ...]:
    """Fall of chi² if a, if b, if both moved, in each window."""
    uu, uv, vv, uy, vy = np.moveaxis(state.product, -1, 0)
    covariance = state.covariance[..., None, :, :]
    caa, cab, cbb = covariance[..., 0, 0], covariance[..., 0, 1], covariance[..., 1, 1]
    # 1 + J C and its inverse times (J, s), written out: 2 by 2.
    p, q = 1 + uu * caa + uv * cab, uu * cab + uv * cbb
    r, t = uv * caa + vv * cab, 1 + uv * cab + vv * cbb
    det = p * t - q * r
    maa, mab, mbb = (t * uu - q * uv) / det, (t * uv - q * vv) / det, (p * vv - r * uv) / det
    sa, sb = (t * uy - q * vy) / det, (p * vy - r * uy) / det
    by_a = sa**2 / np.where(maa > 0, maa, np.inf)
    by_b = sb**2 / np.where(mbb > 0, mbb, np.inf)
    left = mbb - mab**2 / np.where(maa > 0, maa, np.inf)
    rest = sb - sa * mab / np.where(maa > 0, maa, np.inf)
    # Where the two are not told apart by rounding, both explain no more than one.
    both = by_a + np.where(left > 1e-9 * mbb, rest**2 / np.where(left > 0, left, np.inf), 0.0)
    return by_a, by_b, np.maximum(both, np.maximum(by_a, by_b))


def change_since(state: State, moved: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Relative changes since the alarm, of what moved alone, their errors, and the covariance.

    Errors contain those of the reference.
    """
    uu, uv, vv, uy, vy = np.moveaxis(state.product[..., -1, :], -1, 0)
    uu, vv = uu + WIDE**-2, vv + WIDE**-2
    det = uu * vv - uv**2
    rows = np.stack([np.stack([vv, -uv], -1), np.stack([-uv, uu], -1)], axis=-2)
    covariance = rows / det[..., None, None]
    both = np.stack([vv * uy - uv * vy, uu * vy - uv * uy], axis=-1) / det[..., None]
    total = np.diagonal(covariance + state.covariance, axis1=-2, axis2=-1)
    caa, cab, cbb = (state.covariance[..., i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
    a_error = 1 / uu + caa + 2 * uv / uu * cab + (uv / uu) ** 2 * cbb
    b_error = 1 / vv + cbb + 2 * uv / vv * cab + (uv / vv) ** 2 * caa

    def told(a: np.ndarray, b: np.ndarray, whole: np.ndarray) -> np.ndarray:
        """Of a alone, of b alone, or of both."""
        zero = np.zeros_like(a)
        rest = either(moved == 2, np.stack([zero, b], -1), whole)
        return either(moved == 1, np.stack([a, zero], -1), rest)

    change, square = told(uy / uu, vy / vv, both), told(a_error, b_error, total)
    return change, np.sqrt(square), covariance


def set_off(state: State, raised: np.ndarray, best: np.ndarray) -> State:
    """An alarm begins: what comes from now on tells what moved."""
    anew = raised[..., None] & (np.arange(LENGTHS.size + 1) == LENGTHS.size)
    level = np.take_along_axis(state.mean[..., 0], best[..., None], -1)[..., 0]
    age = np.take_along_axis(state.age, best[..., None], -1)[..., 0]
    return state._replace(
        age=np.where(anew, 0.0, state.age),
        weight=np.where(anew, 0.0, state.weight),
        product=np.where(anew[..., None], 0.0, state.product),
        raised=np.where(raised, 0.0, state.raised),
        excess=np.where(raised, state.path[..., 0] - level, state.excess),
        before=np.where(raised, age, state.before),
    )
