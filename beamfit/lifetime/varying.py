"""Fit of the rate equation when a depends on the current."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.optimize import least_squares

from beamfit.lifetime.decay import current_by_rate
from beamfit.lifetime.solve import Physical, Solution, solve_decay

__all__ = ["PowerFit", "constant_shape", "solve_power", "solve_shaped"]

Shape = Callable[[Array], Array]


class PowerFit(NamedTuple):
    """Fit with a proportional to a power of the current.

    Attributes
    ----------
    exponent, error : float
        The power, zero for a constant a, and its standard deviation for weights 1/error.
    residuals : array, shape (n,)
        Model minus measurement, mA.
    sum_squares : float
        Weighted sum of squares.
    converged : bool
        Whether the search ended at a minimum.
    """

    exponent: float
    error: float
    residuals: np.ndarray
    sum_squares: float
    converged: bool


def constant_shape(beam_current: Array) -> Array:
    """The shape of a constant a.

    Parameters
    ----------
    beam_current : float or array
        Current, mA.

    Returns
    -------
    float or array
        Ones.

    Examples
    --------
    >>> print(constant_shape(500.0))
    1.0
    """
    return jnp.ones_like(beam_current, dtype=float)


# theta: current at the start over the mean, loss in one span at the mean current, the part of it
# that is proportional to a, and the power of the current by which a departs from its shape.
def _rate(theta: Array, reference: Array, shape: Shape) -> Shape:
    """Loss in one span as a function of the current over the mean."""
    _, loss, quadratic, exponent = theta

    def rate(scaled: Array) -> Array:
        relative = shape(scaled * reference) / shape(reference) * scaled**exponent
        return loss + quadratic * (relative * scaled - 1)

    return rate


@partial(jax.jit, static_argnames="shape")
def _residual(
    theta: Array, time: Array, scaled: Array, weight: Array, reference: Array, shape: Shape
) -> Array:
    model = current_by_rate(time, theta[0], _rate(theta, reference, shape))
    return weight * (model - scaled)


_jacobian = jax.jit(jax.jacfwd(_residual), static_argnames="shape")


class _Minimum(NamedTuple):
    theta: np.ndarray
    covariance: np.ndarray
    residuals: np.ndarray
    success: bool


def _minimise(
    time: np.ndarray, measured: np.ndarray, weight: np.ndarray, shape: Shape, free: int
) -> _Minimum:
    """Fit the first `free` parameters, starting from a constant a."""
    span, reference = float(time[-1]), float(measured[weight > 0].mean())
    values = solve_decay(time, measured, weight).values
    quadratic = float(values.a) * reference * span
    start = np.array([values.i0 / reference, values.rate_mean * span, quadratic, 0.0])
    # Weights of order one keep the optimiser's tolerances meaningful.
    size = np.sqrt(np.mean(weight[weight > 0] ** 2))
    data = (time / span, measured / reference, weight / size, reference)

    def full(parameters: np.ndarray) -> np.ndarray:
        return np.concatenate([parameters, start[free:]])

    found = least_squares(
        lambda p: np.asarray(_residual(full(p), *data, shape=shape)),
        start[:free],
        lambda p: np.asarray(_jacobian(full(p), *data, shape=shape))[:, :free],
        method="lm",
        x_scale="jac",
        xtol=1e-12,
        ftol=1e-12,
        gtol=1e-15,
    )
    inverse = np.linalg.pinv(np.linalg.qr(found.jac * size * reference, mode="r"))
    residuals = found.fun * size / np.where(weight > 0, weight, np.inf) * reference
    success = bool(found.success and np.isfinite(found.x).all())
    return _Minimum(full(found.x), inverse @ inverse.T, residuals, success)


@partial(jax.jit, static_argnames="shape")
def _physical(theta: Array, time: Array, reference: Array, shape: Shape) -> Array:
    span = time[-1]
    start, loss, quadratic, _ = theta
    rate = _rate(theta, reference, shape)
    end = current_by_rate(time / span, start, rate)[-1]
    values = Physical(
        i0=start * reference,
        a=quadratic / (reference * span),
        b=(loss - quadratic) / span,
        rate_start=rate(start) / span,
        rate_end=rate(end) / span,
        rate_mean=loss / span,
        share=quadratic / loss,
    )
    return jnp.stack(values)


def solve_shaped(
    time: np.ndarray,
    measured: np.ndarray,
    weight: np.ndarray,
    shape: Shape,
) -> Solution:
    """Fit I0, a and b where a has a known dependence on the current.

    Parameters
    ----------
    time, measured, weight : array, shape (n,)
        Times from 0 s, currents mA, 1/error 1/mA; zero for padding.
    shape : callable
        Dependence of a on the current in mA, up to a factor; written with JAX.

    Returns
    -------
    Solution
        As `solve_decay` returns it, with a at the mean current.

    Notes
    -----
    Report equation 42 with a(I), integrated by `current_by_rate`; scipy's Levenberg-Marquardt.

    Examples
    --------
    >>> time = np.linspace(0.0, 36000.0, 40)
    >>> rate = lambda i: 2e-8 * (i / 500) ** -0.2 * i + 1e-6
    >>> measured = np.array(current_by_rate(time, 500.0, rate))
    >>> fit = solve_shaped(time, measured, np.ones(40), lambda i: i**-0.2)
    >>> print(f"{fit.values.b:.4e}")
    1.0000e-06
    """
    found = _minimise(time, measured, weight, shape, free=3)
    point = (jnp.asarray(found.theta), time, float(measured[weight > 0].mean()))
    slopes = np.asarray(jax.jacfwd(_physical)(*point, shape=shape))[:, :3]
    spread = slopes @ found.covariance @ slopes.T
    errors = np.sqrt(np.diag(spread))
    return Solution(
        values=Physical(*np.asarray(_physical(*point, shape=shape))),
        errors=Physical(*errors),
        correlation=spread[1, 2] / (errors[1] * errors[2]),
        residuals=found.residuals,
        sum_squares=np.sum((weight * found.residuals) ** 2),
        converged=found.success,
    )


def solve_power(time: np.ndarray, measured: np.ndarray, weight: np.ndarray) -> PowerFit:
    """Fit I0, b and a(I) = a (I/mean)^s with the exponent s free.

    Parameters
    ----------
    time, measured, weight : array, shape (n,)
        Times from 0 s, currents mA, 1/error 1/mA; zero for padding.

    Returns
    -------
    PowerFit
        The exponent, with its error. Bunch lengthening gives -1/3 to 0, intrabeam scattering
        more negative values.

    Examples
    --------
    >>> time = np.linspace(0.0, 36000.0, 40)
    >>> rate = lambda i: 2e-8 * (i / 500) ** -0.2 * i + 1e-6
    >>> measured = np.array(current_by_rate(time, 500.0, rate))
    >>> print(f"{solve_power(time, measured, np.ones(40)).exponent:.3f}")
    -0.200
    """

    found = _minimise(time, measured, weight, constant_shape, free=4)
    squares = float(np.sum((weight * found.residuals) ** 2))
    error = float(np.sqrt(found.covariance[3, 3]))
    return PowerFit(float(found.theta[3]), error, found.residuals, squares, found.success)
