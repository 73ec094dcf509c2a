"""The law of a decay: what is free in it, the least-squares problem, and its fast path."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.greybox.descend import descend_one
from beamfit.greybox.problem import Free, Prior, Problem, Record, padded_length
from beamfit.lifetime.decay import current, current_by_rate
from beamfit.studies.decay.record import DecayRecord

__all__ = [
    "DecayNumbers",
    "Moments",
    "Physical",
    "Shape",
    "Solution",
    "beam_current",
    "constant_shape",
    "decay_problem",
    "decay_record",
    "padded",
    "padded_size",
    "solve_decay",
    "solve_decays",
]

Shape = Callable[[Array], Array]
RECORD = "decay"
# Width of a prior on the quadratic part, in units of the whole loss (whose own error counts in).
# Physics allows 0 to 1, so 30 moves no value that the record determines (by 4e-5 of it where the
# verdict turns, nothing beyond); it keeps records too short for their noise from running away.
PRIOR_WIDTH = 30.0
# Where the search for the plain law may rest: one more step of Gauss and Newton ends each
# search at rounding.
NEAR = 1e-8
# Most steps with a shape: in a valley without a bottom the record cannot tell anyway.
FEW_STEPS = 100


class DecayNumbers(NamedTuple):
    """Current at the first reading, mA, and a, 1/(mA s), and b, 1/s, of dI/dt = -a I² - b I.

    `exponent` is the power of the current by which a departs from its known dependence.
    """

    i0: Array
    a: Array
    b: Array
    exponent: Array = 0.0


class Moments(NamedTuple):
    """When a current is asked for: times, s, and the record's mean current, mA."""

    time: Array
    mean: Array


class Physical(NamedTuple):
    """What one decay says, in s and mA: loss rates at the first and last time and at the mean
    current, the share of a in the loss there, the power by which a departs from its shape.
    """

    i0: Array
    a: Array
    b: Array
    rate_start: Array
    rate_end: Array
    rate_mean: Array
    share: Array
    exponent: Array


class Solution(NamedTuple):
    """Values and errors for weights of 1/error, the correlation of a and b, residuals in mA,
    the weighted sum of squares, and whether the search came to rest.
    """

    values: Physical
    errors: Physical
    correlation: Array
    residuals: Array
    sum_squares: Array
    converged: Array


def constant_shape(beam: Array) -> Array:
    """The shape of a constant a: ones."""
    return jnp.ones_like(beam, dtype=float)


def _rate(numbers: DecayNumbers, mean: Array, shape: Shape | None) -> Shape:
    """Relative loss rate as a function of the current."""

    def rate(beam: Array) -> Array:
        if shape is None:
            return numbers.a * beam + numbers.b
        relative = shape(beam) / shape(mean) * (beam / mean) ** numbers.exponent
        return numbers.a * relative * beam + numbers.b

    return rate


def beam_current(numbers: DecayNumbers, at: Moments, shape: Shape | None = None) -> Array:
    """Current, mA: report equation 44, or 42 integrated where a has a shape.

    The shape is a dependence on the current in mA, up to a factor, in JAX; a is then the value at
    the mean current.
    """
    if shape is None:
        return current(at.time, numbers.i0, numbers.a, numbers.b)
    return current_by_rate(at.time, numbers.i0, _rate(numbers, at.mean, shape))


def padded_size(rows: int) -> int:
    """A few lengths from 64: each is compiled once, for a second or two."""
    return padded_length(max(rows, 64))


def padded(record: DecayRecord) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time, current and weight 1/error of a record, lengthened by readings of no weight."""
    weight = np.ones(len(record)) if record.error is None else 1 / record.error
    extra = (0, padded_size(len(record)) - len(record))
    time = np.pad(record.time, extra, mode="edge")
    return time, np.pad(record.current, extra, mode="edge"), np.pad(weight, extra)


@lru_cache(maxsize=64)
def _predicted(shape: Shape | None) -> Callable[[DecayNumbers, Moments], Array]:
    """One function for each shape, so that it is compiled once."""
    return partial(beam_current, shape=shape)


def decay_record(record: DecayRecord, shape: Shape | None = None) -> Record:
    """The readings, and what the law predicts of them."""
    at = Moments(record.time, record.current.mean())
    return Record(RECORD, _predicted(shape), at, record.current, record.error)


def decay_problem(record: DecayRecord, shape: Shape | None = None) -> Problem:
    """State the fit of a decay: I0, a and b free, one record, a weak prior on a.

    Parameters
    ----------
    record : DecayRecord
        The readings.
    shape : callable, optional
        As for `beam_current`.

    Returns
    -------
    Problem
        Whose solution `solve_decay` finds faster.

    Examples
    --------
    >>> from beamfit.greybox.solve import solve
    >>> t = np.linspace(0, 36000, 50)
    >>> fit = solve(decay_problem(DecayRecord(t, 500 / (1 + 500 * 2e-8 * t))))
    >>> print(f"{fit['a'].value:.3e}")
    2.000e-08
    """
    scaled = _scaled(np.stack(padded(record)))
    start, noise, width = (np.asarray(part) for part in _start(*scaled[:3]))
    span, mean = record.span, float(record.current.mean())
    loss, quadratic = start[1] / span, start[2] / span
    return Problem(
        DecayNumbers(start[0] * mean, quadratic / mean, loss - quadratic),
        [Free("i0"), Free("a"), Free("b")],
        [decay_record(record, shape)],
        [] if shape else [Prior("a", 0.0, width / noise / span / mean)],
    )


# The fast path works with theta: current at the start over the mean, loss in one span at the mean
# current, the part of it that is proportional to current, and the exponent. The second is well
# determined by any record, the third only by a long one, and the two are nearly uncorrelated.
def _numbers(theta: Array) -> DecayNumbers:
    start, loss, quadratic, *exponent = theta
    return DecayNumbers(start, quadratic, loss - quadratic, *exponent)


def _physical(theta: Array, end: Array, unit: tuple[Array, Array], shape: Shape | None) -> Array:
    """Physical values from theta and the last current."""
    span, mean = unit
    numbers = _numbers(theta)
    rate = _rate(numbers, 1.0, shape)
    return jnp.stack(
        Physical(
            i0=numbers.i0 * mean,
            a=numbers.a / (mean * span),
            b=numbers.b / span,
            rate_start=rate(numbers.i0) / span,
            rate_end=rate(end) / span,
            rate_mean=theta[1] / span,
            share=theta[2] / theta[1],
            exponent=jnp.asarray(numbers.exponent, float),
        )
    )


def _cumulative(values: Array) -> Array:
    """Cumulative sum by two small triangular products: JAX's own takes seconds to compile."""
    side = math.isqrt(values.size - 1) + 1
    square = jnp.pad(values, (0, side**2 - values.size)).reshape(side, side)
    within = square @ jnp.triu(jnp.ones((side, side)))
    before = jnp.tril(jnp.ones((side, side)), -1) @ within[:, -1]
    return (within + before[:, None]).ravel()[: values.size]


def _scaled(readings: Array) -> tuple[Array, Array, Array, tuple[Array, Array]]:
    """Time from 0 to 1, currents about 1, their weight; the span, s, and the mean current, mA."""
    time, measured, weight = readings
    used = weight > 0
    span = jnp.max(jnp.where(used, time, 0.0))
    mean = jnp.sum(jnp.where(used, measured, 0.0)) / jnp.sum(used)
    return time / span, measured / mean, weight * mean, (span, mean)


@jax.jit
def _start(time: Array, measured: Array, weight: Array) -> tuple[Array, Array, Array]:
    """Start, noise in units of the weights, and width of the prior on the quadratic part.

    Integrated once, the law is linear in theta: I(t) = p0 - p1 ∫I dt - p2 ∫I(I - 1) dt in scaled
    units. The integrals average the noise, so the start is good for a decay of any length.
    """
    steps = jnp.diff(time, prepend=0.0)

    def integral(values: Array) -> Array:
        return _cumulative(steps * (values + jnp.roll(values, 1)) / 2)

    columns = (jnp.ones_like(time), -integral(measured), -integral(measured * (measured - 1)))
    rows, target = weight * jnp.stack(columns), weight * measured
    normal, moment = rows @ rows.T, rows @ target
    count = jnp.maximum(jnp.sum(weight > 0) - 3, 1)

    def solve(ridge: Array) -> tuple[Array, Array, Array]:
        """Parameters, noise of unit weight, error of the loss."""
        part = normal + jnp.diag(jnp.array([0.0, 0.0, 1.0])) * ridge
        scale = jnp.sqrt(jnp.diag(part)) + 1e-300
        inverse = _inverse(part / scale / scale[:, None] + 1e-15 * jnp.eye(3))
        theta = inverse @ (moment / scale) / scale
        noise = jnp.sqrt(jnp.sum((theta @ rows - target) ** 2) / count)
        return theta, noise, jnp.sqrt(inverse[1, 1]) / scale[1]

    # A ridge that leaves nothing of the quadratic part gives the straight decay.
    straight, noise, error = solve(1e9 * normal[2, 2] + 1e-300)
    width = PRIOR_WIDTH * (jnp.abs(straight[1]) + 3 * noise * error) + 1e-300
    bent, less, _ = solve((noise / width) ** 2)
    least = 1e-15 * jnp.sqrt(jnp.mean(target**2))
    return bent, jnp.maximum(jnp.minimum(noise, less), least), width


def _inverse(matrix: Array) -> Array:
    """Inverse of a 3 by 3 matrix by cross products: no library call."""
    first, second, third = matrix
    columns = [jnp.cross(second, third), jnp.cross(third, first), jnp.cross(first, second)]
    return jnp.stack(columns, axis=1) / (first @ columns[0])


def _solve(readings: Array, free: Array, shape: Shape | None = None) -> tuple[Array, Array]:
    """Scale, search, and turn theta into physical numbers; few arrays out, for each costs time."""
    time, measured, weight, unit = _scaled(readings)
    scaled_shape = None if shape is None else lambda beam: shape(beam * unit[1])
    start, noise, width = _start(time, measured, weight)
    weight = weight / noise

    def off(theta: Array, law: Shape | None) -> tuple[Array, Array]:
        model = beam_current(_numbers(theta), Moments(time, 1.0), law)
        residual = weight * (model - measured)
        # The prior holds the plain law, from which a search with a shape begins.
        return (jnp.append(residual, theta[2] / width) if law is None else residual), model[-1]

    def constant(theta: Array) -> Array:
        return off(theta, None)[0]

    def answer(theta: Array) -> tuple[Array, Array]:
        residual, end = off(theta, scaled_shape)
        return residual, _physical(theta, end, unit, scaled_shape)

    # A start taken from noise can lie where the law has no value; a plain decay never does.
    start, plain = start * free[:3], jnp.array([1.0, 0.1, 0.05]) * free[:3]
    start = jnp.where(jnp.isfinite(constant(start)).all(), start, plain)
    reach = jnp.where(free > 0, jnp.inf, 0.0)
    found = descend_one(constant, start, -reach[:3], reach[:3], tolerance=NEAR)
    if shape is not None:
        begin = jnp.append(found.theta, 0.0)
        found = descend_one(lambda t: off(t, scaled_shape)[0], begin, -reach, reach, FEW_STEPS)
    (residual, values), (jacobian, slopes) = jax.vmap(
        lambda step: jax.jvp(answer, (found.theta,), (step,)), out_axes=(None, 0)
    )(jnp.diag(free))
    root = _root(jacobian, free)
    step = jnp.where(found.rested, -root @ (root.T @ (jacobian @ residual)), 0.0)
    values, residual = values + step @ slopes, residual + step @ jacobian
    spread = slopes.T @ root
    errors = jnp.linalg.norm(spread, axis=1) / noise
    correlation = (spread[1] @ spread[2]) / noise**2 / (errors[1] * errors[2])
    residual = residual[: time.size]
    rest = jnp.stack([correlation, noise**2 * (residual @ residual), found.rested])
    residuals = jnp.where(weight > 0, residual / weight, 0.0) * unit[1]
    return jnp.concatenate([values, errors, rest]), residuals


def _root(jacobian: Array, free: Array) -> Array:
    """Root R of the covariance R Rᵀ of theta, from the slopes by its free numbers, shape (n, m)."""
    factor = jnp.linalg.qr(jnp.concatenate([jacobian.T, jnp.diag(1 - free)]), mode="r")
    return jax.scipy.linalg.solve_triangular(factor, jnp.eye(len(free)))


_solve_one = jax.jit(_solve, static_argnames="shape")
_solve_many = jax.jit(jax.vmap(_solve, in_axes=(0, None)))


def _unpacked(summary: Array, residuals: Array) -> Solution:
    leaves = np.moveaxis(np.asarray(summary), -1, 0)
    size = len(Physical._fields)
    correlation, squares, done = leaves[2 * size :]
    finite = np.isfinite(leaves[:size]).all(axis=0)
    return Solution(
        values=Physical(*leaves[:size]),
        errors=Physical(*leaves[size : 2 * size]),
        correlation=correlation,
        residuals=np.asarray(residuals),
        sum_squares=squares,
        converged=(done > 0) & finite,
    )


CONSTANT, SHAPED = np.ones(3), np.array([1.0, 1.0, 1.0, 0.0])


def solve_decay(
    time: np.ndarray,
    measured: np.ndarray,
    weight: np.ndarray,
    free: np.ndarray | None = None,
    shape: Shape | None = None,
) -> Solution:
    """Fit the decay law to one record: the fast path of `decay_problem`.

    Parameters
    ----------
    time : array, shape (n,)
        Times from 0, s.
    measured : array, shape (n,)
        Currents, mA.
    weight : array, shape (n,)
        1/error, 1/mA; zero for padding.
    free : array, shape (3,) or (4,), optional
        Ones where a parameter is fitted; (1, 1, 0) holds a at zero: a single exponential. With a
        shape the fourth is the exponent, held at zero by default.
    shape : callable, optional
        As for `beam_current`.

    Returns
    -------
    Solution
        Values with their errors, residuals, and whether the search converged.

    Notes
    -----
    The bend that tells a from b is of the order (span/lifetime)²/8 of the current, 4e-7 for a
    minute at ten hours. Fitting the loss at the mean current instead of b keeps the equations
    well conditioned all the same.

    Examples
    --------
    >>> time = np.linspace(0.0, 36000.0, 100)
    >>> fit = solve_decay(time, np.array(current(time, 500.0, 2e-8, 1e-6)), np.ones(100))
    >>> print(f"{fit.values.a:.6e} {fit.values.b:.6e} {fit.converged}")
    2.000000e-08 1.000000e-06 True
    """
    if free is None:
        free = CONSTANT if shape is None else SHAPED
    return _unpacked(*_solve_one(np.stack([time, measured, weight]), free, shape))


def solve_decays(time: np.ndarray, measured: np.ndarray, weight: np.ndarray) -> Solution:
    """`solve_decay` for records of one padded length at once, arrays of shape (m, n)."""
    return _unpacked(*_solve_many(np.stack([time, measured, weight], axis=1), CONSTANT))
