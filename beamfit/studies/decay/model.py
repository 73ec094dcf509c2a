"""A decay as a least-squares problem, and its fast path."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.compile_cache import SELDOM
from beamfit.greybox.descend import descend_one
from beamfit.greybox.problem import Free, Prior, Problem, Record, padded_length
from beamfit.studies.decay.law import (
    DecayNumbers,
    Expansion,
    Moments,
    Physical,
    Shape,
    beam_current,
    bent_current,
    cumulative,
    physical,
    scaled_numbers,
)
from beamfit.studies.decay.record import DecayRecord

RECORD = "decay"
# Width of a prior on the quadratic part, in units of the whole loss (whose own error counts in).
# Physics allows 0 to 1, so 30 moves no value that the record determines (by 4e-5 of it where the
# verdict turns, nothing beyond); it keeps records too short for their noise from running away.
PRIOR_WIDTH = 30.0
# Where the search for the plain law may rest: one more step of Gauss and Newton ends each
# search at rounding.
NEAR = 1e-8
CONSTANT = np.array([1.0, 1.0, 1.0, 0.0])
# Most steps with a shape: in a valley without a bottom the record cannot tell anyway.
FEW_STEPS = 100


class Solution(NamedTuple):
    """Values and errors for weights of 1/error, what a straight drift of the readings by 1 mA over
    the record adds to each value, the correlation of a and b, residuals in mA, the weighted sum of
    squares, what a free exponent would take off it, and whether the search came to rest.
    """

    values: Physical
    errors: Physical
    drift: Physical
    correlation: Array
    residuals: Array
    sum_squares: Array
    fall: Array
    converged: Array


def padded_size(rows: int) -> int:
    """A few lengths from 64: each is compiled once, for a second or two."""
    return padded_length(max(rows, 64))


def padded(record: DecayRecord) -> tuple[np.ndarray, ...]:
    """Time, current, weight 1/error, and gauge if any, lengthened by readings of no weight."""
    weight = np.ones(len(record)) if record.error is None else 1 / record.error
    extra = (0, padded_size(len(record)) - len(record))
    columns = [record.time, record.current] + ([] if record.gauge is None else [record.gauge])
    time, current, *gauge = (np.pad(column, extra, mode="edge") for column in columns)
    return time, current, np.pad(weight, extra), *gauge


@lru_cache(maxsize=64)
def _predicted(shape: Shape | None) -> Callable[[DecayNumbers, Moments], Array]:
    """One function for each shape, so that it is compiled once."""
    return partial(beam_current, shape=shape)


def apart(model: DecayNumbers, at: Moments) -> Array:
    """Time between neighbouring readings over the correlation time of their errors."""
    return jnp.diff(at.time) * jnp.exp(-model.log_memory)


def decay_problem(
    record: DecayRecord, shape: Shape | None = None, memory: float | None = None
) -> Problem:
    """State the fit of a decay: I0, a and b free, one record, a weak prior on a.

    Parameters
    ----------
    record : DecayRecord
        The readings.
    shape : callable, optional
        As for `beam_current`.
    memory : float, optional
        Correlation time of the errors, s.

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
    start, noise, width = (np.asarray(part) for part in _start(scaled))
    span, mean = record.span, float(record.current.mean())
    loss, quadratic = start[1] / span, start[2] / span
    numbers = DecayNumbers(start[0] * mean, quadratic / mean, loss - quadratic)
    at = Moments(record.time, mean, record.gauge)
    readings = Record(RECORD, _predicted(shape), at, record.current, record.error)
    if memory is not None:
        numbers = numbers._replace(log_memory=math.log(memory))
        readings = replace(readings, apart=apart)
    priors = [] if shape else [Prior("a", 0.0, width / noise / span / mean)]
    return Problem(numbers, [Free("i0"), Free("a"), Free("b")], [readings], priors)


class _Readings(NamedTuple):
    """Times from 0 to 1, currents about 1, weights; the span, s, and the mean current, mA."""

    at: Moments
    measured: Array
    weight: Array
    unit: tuple[Array, Array]

    @property
    def pressure(self) -> Array:
        """Over its mean, at the first and the last reading."""
        if self.at.gauge is None:
            return jnp.ones(2)
        last = jnp.sum(self.weight > 0) - 1
        pairs = jnp.array([1, last]), jnp.array([0, last - 1])
        gauge, time = (part[pairs[0]] - part[pairs[1]] for part in (self.at.gauge, self.at.time))
        return gauge / time


def _scaled(rows: Array) -> _Readings:
    time, measured, weight, *gauge = rows
    used = weight > 0
    span = jnp.max(jnp.where(used, time, 0.0))
    mean = jnp.sum(jnp.where(used, measured, 0.0)) / jnp.sum(used)
    at = Moments(time / span, 1.0, gauge[0] / span if gauge else None)
    return _Readings(at, measured / mean, weight * mean, (span, mean))


@jax.jit
def _start(readings: _Readings) -> tuple[Array, Array, Array]:
    """Start, noise in units of the weights, and width of the prior on the quadratic part.

    Integrated once, the law is linear in theta: I(t) = p0 - p1 ∫I dt - p2 ∫I(I - 1) dt in scaled
    units. The integrals average the noise, so the start is good for a decay of any length.
    """
    time, measured, weight = readings.at.time, readings.measured, readings.weight
    steps = jnp.diff(time, prepend=0.0)

    def integral(values: Array) -> Array:
        return cumulative(steps * (values + jnp.roll(values, 1)) / 2)

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


def _law(theta: Array, at: Moments, shape: Shape | None) -> Array:
    """Currents from the four numbers; without a shape to first order in the exponent."""
    numbers = scaled_numbers(theta)
    return bent_current(numbers, at) if shape is None else beam_current(numbers, at, shape)


def _expanded(theta: Array, readings: _Readings, shape: Shape | None) -> tuple[Array, ...]:
    """Residuals over errors and physical values at four scaled numbers, and their slopes."""

    def answer(numbers: Array) -> tuple[Array, Array]:
        model = _law(numbers, readings.at, shape)
        values = physical(numbers, model[-1], readings.pressure, readings.unit, shape)
        return readings.weight * (model - readings.measured), values

    (residual, values), (rows, slopes) = jax.vmap(
        lambda step: jax.jvp(answer, (theta,), (step,)), out_axes=(None, 0)
    )(jnp.eye(4))
    return residual, values, rows, slopes


def _in_units(shape: Shape | None, mean: Array) -> Shape | None:
    """A shape of the current over its mean."""
    return None if shape is None else lambda beam: shape(beam * mean)


def _solve(rows: Array, free: Array, shape: Shape | None = None) -> tuple[Array, Array]:
    """Scale, search, and turn theta into physical numbers; few arrays out, for each costs time."""
    readings = _scaled(rows)
    shape = _in_units(shape, readings.unit[1])
    start, noise, width = _start(readings)
    readings = readings._replace(weight=readings.weight / noise)
    at, measured, weight, unit = readings

    def constant(theta: Array) -> Array:
        """Residuals of the plain law, from which a search with a shape begins, and the prior."""
        model = beam_current(scaled_numbers(jnp.append(theta, 0.0)), at)
        return jnp.append(weight * (model - measured), theta[2] / width)

    # A start taken from noise can lie where the law has no value; a plain decay never does.
    start, plain = start * free[:3], jnp.array([1.0, 0.1, 0.05]) * free[:3]
    start = jnp.where(jnp.isfinite(constant(start)).all(), start, plain)
    reach = jnp.where(free > 0, jnp.inf, 0.0)
    found = descend_one(constant, start, -reach[:3], reach[:3], tolerance=NEAR)
    theta, prior = jnp.append(found.theta, 0.0), jnp.eye(4)[2] / width
    if shape is not None:

        def shaped(theta: Array) -> Array:
            return weight * (_law(theta, at, shape) - measured)

        found = descend_one(shaped, theta, -reach, reach, FEW_STEPS)
        theta, prior = found.theta, jnp.zeros(4)
    residual, values, rows, slopes = _expanded(theta, readings, shape)
    used = free.at[3].set(1.0)
    rows, slopes = rows * used[:, None], slopes * used[:, None]
    step, root, score = _stepped(residual, rows, prior * used, theta, free[3])
    step = jnp.where(found.rested, step, 0.0)
    values, residual = values + step @ slopes, residual + step @ rows
    spread = slopes.T @ root
    errors = jnp.linalg.norm(spread, axis=1)
    correlation = (spread[1] @ spread[2]) / (errors[1] * errors[2])
    drift = spread @ (root.T @ (rows @ (weight * at.time))) / unit[1]
    values = values.at[-1].set(jnp.where(free[3] > 0, values[-1], score[0]))
    errors = errors.at[-1].set(jnp.where(free[3] > 0, errors[-1], score[1]))
    fall = jnp.where(free[3] > 0, 0.0, noise**2 * score[2])
    rest = jnp.stack([correlation, noise**2 * (residual @ residual), fall, found.rested])
    residuals = jnp.where(weight > 0, residual / weight, 0.0) * unit[1]
    return jnp.concatenate([values, errors / noise, drift, rest]), residuals


def _stepped(
    residual: Array, rows: Array, prior: Array, theta: Array, free: Array
) -> tuple[Array, Array, tuple[Array, ...]]:
    """The last step of Gauss and Newton, the root of the covariance, and of an exponent that is
    not free what it would be: estimate, error, and the squares that it would take away.
    """
    matrix = jnp.concatenate([rows.T, residual[:, None]], axis=1)
    known = jnp.append(prior, prior @ theta)
    # What moves nothing, as a number held at zero does, gets a row of its own.
    blind = 1.0 * (jnp.abs(rows).sum(axis=1) == 0)
    held = jnp.append(jnp.diag(blind), jnp.zeros((4, 1)), axis=1)
    factor = jnp.linalg.qr(jnp.concatenate([matrix, known[None], held]), mode="r")
    root = jax.scipy.linalg.solve_triangular(factor[:4, :4], jnp.eye(4))
    error = jnp.where(blind[3] > 0, jnp.inf, jnp.abs(root[3, 3]))
    score = -root[3, 3] * factor[3, 4], error, factor[3, 4] ** 2
    loose = jnp.ones(4).at[3].set(free)
    root = root * jnp.outer(loose, loose)
    return -root @ factor[:4, 4], root, score


_solve_one = jax.jit(_solve, static_argnames="shape")
_solve_many = jax.jit(jax.vmap(_solve, in_axes=(0, None)))


def _unpacked(summary: Array, residuals: Array) -> Solution:
    leaves = np.moveaxis(np.asarray(summary), -1, 0)
    size = len(Physical._fields)
    values, errors, drift = (Physical(*leaves[k * size : (k + 1) * size]) for k in range(3))
    correlation, squares, fall, done = leaves[3 * size :]
    # The exponent is only looked at, and may have no value.
    finite = np.isfinite(leaves[: size - 1]).all(axis=0)
    residuals, converged = np.asarray(residuals), (done > 0) & finite
    return Solution(values, errors, drift, correlation, residuals, squares, fall, converged)


@partial(jax.jit, static_argnames="shape", compiler_options=SELDOM)
def _expansion(rows: Array, theta: Array, shape: Shape | None) -> tuple[Array, ...]:
    readings = _scaled(rows)
    shape = _in_units(shape, readings.unit[1])
    residual, _, slopes, physical_slopes = _expanded(theta, readings, shape)
    return residual, slopes, physical_slopes


def expanded(
    record: DecayRecord, values: Physical, shape: Shape | None = None, exponent: float = 0.0
) -> Expansion:
    """Expand the law about a solution's values, for what plain least squares does not do."""
    mean, rows = float(record.current.mean()), len(record)
    span = record.span
    theta = [values.i0 / mean, values.rate_mean * span, values.a * mean * span, exponent]
    found = _expansion(np.stack(padded(record)), np.array(theta, float), shape)
    residuals, slopes, of_physical = (np.asarray(part) for part in found)
    return Expansion(residuals[:rows], slopes[:, :rows].T, of_physical.T)


def solve_decay(
    time: np.ndarray,
    measured: np.ndarray,
    weight: np.ndarray,
    gauge: np.ndarray | None = None,
    *,
    free: np.ndarray = CONSTANT,
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
    gauge : array, shape (n,), optional
        As of `Moments`.
    free : array, shape (4,), optional
        Ones where a parameter is fitted; (1, 1, 0, 0) holds a at zero: a single exponential. The
        last is the exponent, which only a search with a shape may fit.
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
    >>> from beamfit.lifetime.decay import current
    >>> time = np.linspace(0.0, 36000.0, 100)
    >>> fit = solve_decay(time, np.array(current(time, 500.0, 2e-8, 1e-6)), np.ones(100))
    >>> print(f"{fit.values.a:.6e} {fit.values.b:.6e} {fit.converged}")
    2.000000e-08 1.000000e-06 True
    """
    rows = (time, measured, weight) if gauge is None else (time, measured, weight, gauge)
    return _unpacked(*_solve_one(np.stack(rows), free, shape))


def solve_decays(*rows: np.ndarray) -> Solution:
    """`solve_decay` for records of one padded length at once, arrays of shape (m, n)."""
    return _unpacked(*_solve_many(np.stack(rows, axis=1), CONSTANT))
