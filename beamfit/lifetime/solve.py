"""Least squares for the decay law: one compiled Levenberg-Marquardt solve, vmappable."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.lifetime.decay import current

__all__ = ["Physical", "Solution", "physical_values", "solve_decay", "solve_decays"]

MAX_ITERATIONS = 200
# A step that would lower the sum of squares by less than this share of it ends the search.
ENOUGH = 1e-11
# Width of a prior on the quadratic part, in units of the whole loss (whose own error counts in).
# Physics allows 0 to 1, so 30 moves no value that the record determines (by 4e-5 of it where the
# verdict turns, nothing beyond); it keeps records too short for their noise from running away.
PRIOR_WIDTH = 30.0


class Physical(NamedTuple):
    """What one decay says, in the units of the record (s and mA).

    Attributes
    ----------
    i0 : float
        Current at the first time, mA.
    a, b : float
        Loss coefficients, 1/(mA s) and 1/s.
    rate_start, rate_end, rate_mean : float
        Relative loss rate at the first and last time and at the mean current, 1/s.
    share : float
        Share of a in the loss at the mean current: 1 all Touschek-like, 0 all gas-like.
    """

    i0: Array
    a: Array
    b: Array
    rate_start: Array
    rate_end: Array
    rate_mean: Array
    share: Array


class Solution(NamedTuple):
    """Least-squares solution of the decay law.

    Attributes
    ----------
    values, errors : Physical
        Values, and standard deviations for weights that are 1/error.
    correlation : float
        Correlation of a and b.
    residuals : array, shape (n,)
        Model minus measurement, mA.
    sum_squares : float
        Weighted sum of squares.
    converged : bool
        Whether the last step was small enough.
    """

    values: Physical
    errors: Physical
    correlation: Array
    residuals: Array
    sum_squares: Array
    converged: Array


def physical_values(theta: Array, span: Array, reference: Array) -> Physical:
    """Physical values from the well-scaled parameters the solver works in.

    Parameters
    ----------
    theta : array, shape (3,)
        Current at the start over the reference, loss in one span at the reference current, and
        the part of it that is proportional to current. The second is well determined by any
        record, the third only by a long one, and the two are nearly uncorrelated.
    span, reference : float
        Length of the record s, mean current mA.

    Returns
    -------
    Physical
        Values in s and mA.

    Examples
    --------
    >>> import jax.numpy as jnp
    >>> print(physical_values(jnp.array([1.0, 0.2, 0.1]), 100.0, 50.0).b)
    0.001
    """
    start, loss, quadratic = theta
    a = quadratic / (reference * span)
    b = (loss - quadratic) / span
    end = current(span, start * reference, a, b)
    return Physical(
        i0=start * reference,
        a=a,
        b=b,
        rate_start=a * start * reference + b,
        rate_end=a * end + b,
        rate_mean=loss / span,
        share=quadratic / loss,
    )


def _cumulative(values: Array) -> Array:
    """Cumulative sum by two small triangular products: JAX's own takes seconds to compile."""
    side = math.isqrt(values.size - 1) + 1
    square = jnp.pad(values, (0, side**2 - values.size)).reshape(side, side)
    within = square @ jnp.triu(jnp.ones((side, side)))
    before = jnp.tril(jnp.ones((side, side)), -1) @ within[:, -1]
    return (within + before[:, None]).ravel()[: values.size]


def _linear_guess(time: Array, measured: Array, weight: Array) -> tuple[Array, Array]:
    """Start, and standard deviation of a weak prior on the quadratic part.

    Integrated once, the law is linear in the solver's parameters: I(t) = p0 - p1 ∫I dt -
    p2 ∫I(I - 1) dt in scaled units. The integrals of the readings average their noise, so this
    start is good for a decay of any length.
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
    return bent, width / jnp.maximum(jnp.minimum(noise, less), 1e-300)


def _inverse(matrix: Array) -> Array:
    """Inverse of a 3 by 3 matrix by cross products: no library call inside the loop."""
    first, second, third = matrix
    columns = [jnp.cross(second, third), jnp.cross(third, first), jnp.cross(first, second)]
    return jnp.stack(columns, axis=1) / (first @ columns[0])


def _search(time: Array, measured: Array, weight: Array, free: Array) -> tuple[Array, Array, Array]:
    """Levenberg-Marquardt in scaled time (0 to 1) and current (about 1)."""
    start, width = _linear_guess(time, measured, weight)
    prior = jnp.diag(jnp.array([0.0, 0.0, width**-2]))

    def residual(theta: Array) -> Array:
        values = physical_values(theta, 1.0, 1.0)
        return weight * (current(time, values.i0, values.a, values.b) - measured)

    def normal_equations(theta: Array) -> tuple[Array, Array, Array]:
        value = residual(theta)
        jacobian = jax.vmap(lambda d: jax.jvp(residual, (theta,), (d,))[1])(jnp.diag(free))
        pull = jnp.array([0.0, 0.0, theta[2] / width**2])
        normal = jacobian @ jacobian.T + jnp.diag(1 - free) + prior
        return normal, jacobian @ value + pull, value @ value + (theta[2] / width) ** 2

    floor = 1e-30 * jnp.sum((weight * measured) ** 2)

    def body(state):
        theta, normal, gradient, squares, damping, _, count = state
        scale = jnp.sqrt(jnp.diag(normal)) + 1e-300
        scaled = normal / scale / scale[:, None]
        step = -_inverse(scaled + damping * jnp.eye(3)) @ (gradient / scale) / scale
        gain = -(gradient @ step)
        trial_theta = theta + step
        trial = normal_equations(trial_theta)
        better = trial[2] <= squares
        # Judged on a nearly undamped step only, or strong damping would look like convergence.
        done = (gain <= ENOUGH * squares + floor) & (damping <= 1e-3) & (count > 0)
        kept = jax.tree.map(
            lambda new, old: jnp.where(better, new, old),
            (trial_theta, *trial),
            (theta, normal, gradient, squares),
        )
        damping = jnp.where(better, damping / 30, jnp.maximum(damping, 1e-7) * 10)
        # A step refused although the model promised no gain is rounding, not failure.
        stuck = (gain <= 1e3 * (ENOUGH * squares + floor)) & ~better & (count > 0)
        return *kept, damping, done | stuck, count + 1

    def unfinished(state):
        return ~state[-2] & (state[-1] < MAX_ITERATIONS)

    # A start taken from noise can lie where the law has no value; a plain decay never does.
    plain = jnp.array([1.0, 0.1, 0.05]) * free
    theta = jnp.where(jnp.isfinite(residual(start * free)).all(), start * free, plain)
    # The first step is none: it brings the first normal equations, compiled once this way.
    state = (theta, jnp.eye(3), jnp.zeros(3), jnp.inf, 1e-6, False, 0)
    theta, normal, _, _, _, done, _ = jax.lax.while_loop(unfinished, body, state)
    return theta, normal, done


def _solve(readings: Array, free: Array) -> tuple[Array, Array]:
    """Scale, search, and turn the solver's parameters into physical ones.

    Few arrays in and out: each costs more than an iteration of the search.
    """
    time, measured, weight = readings
    used = weight > 0
    span = jnp.max(jnp.where(used, time, 0.0))
    reference = jnp.sum(jnp.where(used, measured, 0.0)) / jnp.sum(used)
    unit = weight * reference
    theta, normal, done = _search(time / span, measured / reference, unit, free)
    scale = jnp.sqrt(jnp.diag(normal)) + 1e-300
    covariance = _inverse(normal / scale / scale[:, None]) / scale / scale[:, None]
    covariance = covariance * free * free[:, None]

    values = physical_values(theta, span, reference)
    slopes = jnp.stack(jax.jacfwd(lambda p: physical_values(p, span, reference))(theta))
    spread = slopes @ covariance @ slopes.T
    errors = jnp.sqrt(jnp.diag(spread))
    correlation = spread[1, 2] / (errors[1] * errors[2])
    model = current(time, values.i0, values.a, values.b)
    residuals = jnp.where(used, model - measured, 0.0)
    rest = jnp.array([correlation, jnp.sum((weight * residuals) ** 2), done])
    return jnp.concatenate([jnp.stack(values), errors, rest]), residuals


_solve_one = jax.jit(_solve)
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


def solve_decay(
    time: np.ndarray, measured: np.ndarray, weight: np.ndarray, free: np.ndarray | None = None
) -> Solution:
    """Fit the decay law to one record.

    Parameters
    ----------
    time : array, shape (n,)
        Times from 0, s.
    measured : array, shape (n,)
        Currents, mA.
    weight : array, shape (n,)
        1/error, 1/mA; zero for padding.
    free : array, shape (3,), optional
        Ones where a parameter is fitted; (1, 1, 0) holds a at zero: a single exponential.

    Returns
    -------
    Solution
        Values with their errors, residuals, and whether the search converged.

    Notes
    -----
    The bend that tells a from b is of the order (span/lifetime)²/8 of the current, 4e-7 for a
    minute at ten hours. Fitting the loss at the mean current instead of b keeps the normal
    equations well conditioned all the same.

    Examples
    --------
    >>> time = np.linspace(0.0, 36000.0, 100)
    >>> fit = solve_decay(time, np.array(current(time, 500.0, 2e-8, 1e-6)), np.ones(100))
    >>> print(f"{fit.values.a:.6e} {fit.values.b:.6e} {fit.converged}")
    2.000000e-08 1.000000e-06 True
    """
    free = np.ones(3) if free is None else free
    return _unpacked(*_solve_one(np.stack([time, measured, weight]), free))


def solve_decays(time: np.ndarray, measured: np.ndarray, weight: np.ndarray) -> Solution:
    """Fit the decay law to many records of one padded length at once.

    Parameters
    ----------
    time, measured, weight : array, shape (m, n)
        As for `solve_decay`, one row a record.

    Returns
    -------
    Solution
        Each leaf with a first axis of length m.

    Examples
    --------
    >>> time = np.linspace(0.0, 36000.0, 100) * np.ones((2, 1))
    >>> measured = np.array(current(time, np.array([[500.0], [100.0]]), 2e-8, 1e-6))
    >>> print(solve_decays(time, measured, np.ones((2, 100))).values.i0)
    [500. 100.]
    """
    return _unpacked(*_solve_many(np.stack([time, measured, weight], axis=1), np.ones(3)))
