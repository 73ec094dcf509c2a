"""Least squares for the decay law: one compiled Levenberg-Marquardt solve, vmappable."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from beamfit.lifetime.decay import current

__all__ = ["Physical", "Solution", "physical_values", "solve_decay"]

MAX_ITERATIONS = 60
# A step that would lower the sum of squares by less than this share of it ends the search.
ENOUGH = 1e-13
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

    i0: jax.Array
    a: jax.Array
    b: jax.Array
    rate_start: jax.Array
    rate_end: jax.Array
    rate_mean: jax.Array
    share: jax.Array


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
    correlation: jax.Array
    residuals: jax.Array
    sum_squares: jax.Array
    converged: jax.Array


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


def _linear_guess(
    time: Array, measured: Array, weight: Array, free: Array
) -> tuple[Array, Array]:
    """Start and standard deviation of a weak prior on the quadratic part.

    Integrated once, the law is linear in the solver's parameters: I(t) = p0 - p1 ∫I dt -
    p2 ∫I(I - 1) dt in scaled units. The integrals of the readings average their noise, so this
    start is good for a decay of any length.
    """
    steps = jnp.diff(time, prepend=0.0)

    def integral(values: Array) -> Array:
        return jnp.cumsum(steps * (values + jnp.roll(values, 1)) / 2)

    columns = jnp.stack(
        [jnp.ones_like(time), -integral(measured), -integral(measured * (measured - 1))]
    )
    rows = weight * columns
    target = weight * measured

    def solve(rows: Array, ridge: Array) -> tuple[Array, Array, Array]:
        scale = jnp.sqrt(jnp.sum(rows**2, axis=1) + ridge) + 1e-300
        normal = (rows @ rows.T + jnp.diag(ridge)) / scale / scale[:, None]
        normal = normal + 1e-15 * jnp.eye(scale.size)
        theta = jnp.linalg.solve(normal, rows @ target / scale) / scale
        squares = jnp.sum((theta @ rows - target) ** 2)
        return theta, squares, jnp.sqrt(jnp.linalg.inv(normal)[1, 1]) / scale[1]

    count = jnp.maximum(jnp.sum(weight > 0) - 3, 1)
    straight, squares, error = solve(rows[:2], jnp.zeros(2))
    noise = jnp.sqrt(squares / count)
    width = PRIOR_WIDTH * (jnp.abs(straight[1]) + 3 * noise * error) + 1e-300
    bent, squares, _ = solve(rows, jnp.array([0.0, 0.0, 1.0]) * (noise / width) ** 2)
    noise = jnp.minimum(noise, jnp.sqrt(squares / count))
    return jnp.where(free[2] > 0, bent, jnp.append(straight, 0.0)), width / noise


def _search(time: Array, measured: Array, weight: Array, free: Array) -> tuple[Array, Array]:
    """Levenberg-Marquardt in scaled time (0 to 1) and current (about 1)."""

    def residual(theta: Array) -> Array:
        values = physical_values(theta, 1.0, 1.0)
        return weight * (current(time, values.i0, values.a, values.b) - measured)

    def normal_equations(theta: Array) -> tuple[Array, Array, Array]:
        value = residual(theta)
        jacobian = jax.vmap(lambda d: jax.jvp(residual, (theta,), (d,))[1])(jnp.diag(free))
        pull = jnp.array([0.0, 0.0, theta[2] / width**2])
        normal = jacobian @ jacobian.T + jnp.diag(1 - free) + prior
        return normal, jacobian @ value + pull, value @ value + (theta[2] / width) ** 2

    theta, width = _linear_guess(time, measured, weight, free)
    prior = jnp.diag(jnp.array([0.0, 0.0, width**-2]))
    floor = 1e-30 * jnp.sum((weight * measured) ** 2)

    def body(state):
        theta, normal, gradient, squares, damping, _, count = state
        scale = jnp.sqrt(jnp.diag(normal)) + 1e-300
        scaled = normal / scale / scale[:, None]
        step = -jnp.linalg.solve(scaled + damping * jnp.eye(3), gradient / scale) / scale
        gain = -(gradient @ step)
        trial_theta = theta + step
        trial = normal_equations(trial_theta)
        better = trial[2] <= squares
        # Judged on a nearly undamped step only, or strong damping would look like convergence.
        done = (gain <= ENOUGH * squares + floor) & (damping <= 1e-3)
        kept = jax.tree.map(
            lambda new, old: jnp.where(better, new, old),
            (trial_theta, *trial),
            (theta, normal, gradient, squares),
        )
        damping = jnp.where(better, damping / 30, jnp.maximum(damping, 1e-7) * 10)
        # A step refused although the model promised no gain is rounding, not failure.
        stuck = (gain <= 1e3 * (ENOUGH * squares + floor)) & ~better
        return *kept, damping, done | stuck, count + 1

    def unfinished(state):
        return ~state[-2] & (state[-1] < MAX_ITERATIONS)

    # A start taken from noise can lie where the law has no value; a plain decay never does.
    plain = jnp.array([1.0, 0.1, 0.05]) * free
    theta = jnp.where(jnp.isfinite(residual(theta)).all(), theta, plain)
    state = (theta, *normal_equations(theta), 1e-6, False, 0)
    theta, normal, _, _, _, done, _ = jax.lax.while_loop(unfinished, body, state)
    return theta, normal, done


@jax.jit
def solve_decay(time: Array, measured: Array, weight: Array, free: Array) -> Solution:
    """Fit the decay law to one record; `jax.vmap` it for many of one padded length.

    Parameters
    ----------
    time : array, shape (n,)
        Times from 0, s.
    measured : array, shape (n,)
        Currents, mA.
    weight : array, shape (n,)
        1/error, 1/mA; zero for padding.
    free : array, shape (3,)
        Ones; (1, 1, 0) holds a at zero and so fits a single exponential.

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
    >>> import jax.numpy as jnp
    >>> time = jnp.linspace(0.0, 36000.0, 100)
    >>> fit = solve_decay(time, current(time, 500.0, 2e-8, 1e-6), jnp.ones(100), jnp.ones(3))
    >>> print(f"{fit.values.a:.6e} {fit.values.b:.6e} {fit.converged}")
    2.000000e-08 1.000000e-06 True
    """
    used = weight > 0
    span = jnp.max(jnp.where(used, time, 0.0))
    reference = jnp.sum(jnp.where(used, measured, 0.0)) / jnp.sum(used)
    unit = weight * reference
    theta, normal, done = _search(time / span, measured / reference, unit, free)
    scale = jnp.sqrt(jnp.diag(normal)) + 1e-300
    covariance = jnp.linalg.inv(normal / scale / scale[:, None]) / scale / scale[:, None]
    covariance = covariance * free * free[:, None]

    values = physical_values(theta, span, reference)
    slopes = jnp.stack(jax.jacfwd(lambda p: physical_values(p, span, reference))(theta))
    spread = slopes @ covariance @ slopes.T
    errors = jnp.sqrt(jnp.diag(spread))
    model = current(time, values.i0, values.a, values.b)
    residuals = jnp.where(used, model - measured, 0.0)
    return Solution(
        values=values,
        errors=Physical(*errors),
        correlation=spread[1, 2] / (errors[1] * errors[2]),
        residuals=residuals,
        sum_squares=jnp.sum((weight * residuals) ** 2),
        converged=done & jnp.isfinite(theta).all(),
    )
