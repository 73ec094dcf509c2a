"""Fit of the rate equation when a depends on the current."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.optimize import least_squares

from beamfit.lifetime.decay import current_by_rate
from beamfit.lifetime.solve import Physical, Solution, solve_decay

__all__ = ["PowerFit", "solve_power", "solve_shaped"]


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


def _model(
    theta: Array, time: Array, shape: Callable[[Array, Array], Array]
) -> Array:
    """Scaled current for the solver's parameters; `shape` is 1 at the mean current, 1 here."""
    start, loss, quadratic = theta[:3]

    def rate(beam_current: Array) -> Array:
        return loss + quadratic * (shape(beam_current, theta) * beam_current - 1)

    return current_by_rate(time, start, rate)


def _minimise(
    time: np.ndarray,
    measured: np.ndarray,
    weight: np.ndarray,
    shape: Callable[[Array, Array], Array],
    extra: tuple[float, ...],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, bool]:
    """Parameters, their covariance, scaled residuals, and success; started from constant a."""
    span, reference = float(time[-1]), float(measured.mean())
    start = solve_decay(time, measured, weight)
    values = start.values
    loss = float(values.rate_mean) * span
    first = np.array([float(values.i0) / reference, loss, float(values.a) * reference * span, *extra])
    # Weights of their own size keep the optimiser's tolerances meaningful.
    unit = weight * reference
    size = np.sqrt(np.mean(unit**2))

    @jax.jit
    def residual(theta: Array) -> Array:
        return unit / size * (_model(theta, time / span, shape) - measured / reference)

    slopes = jax.jit(jax.jacfwd(residual))
    found = least_squares(
        residual, first, slopes, method="lm", xtol=1e-13, ftol=1e-13, gtol=1e-15, x_scale="jac"
    )
    triangle = np.linalg.qr(found.jac * size, mode="r")
    inverse = np.linalg.pinv(triangle)
    residuals = found.fun * size / unit * reference
    finite = bool(np.isfinite(found.x).all())
    return found.x, inverse @ inverse.T, residuals, found.success and finite


def _physical(theta: Array, time: Array, reference: float, shape) -> Physical:
    span = time[-1]
    start, loss, quadratic = theta[:3]
    end = _model(theta, time / span, shape)[-1]

    def rate(beam_current: Array) -> Array:
        return (loss + quadratic * (shape(beam_current, theta) * beam_current - 1)) / span

    return Physical(
        i0=start * reference,
        a=quadratic / (reference * span),
        b=(loss - quadratic) / span,
        rate_start=rate(start),
        rate_end=rate(end),
        rate_mean=loss / span,
        share=quadratic / loss,
    )


def solve_shaped(
    time: np.ndarray,
    measured: np.ndarray,
    weight: np.ndarray,
    shape: Callable[[Array], Array],
) -> Solution:
    """Fit I0, a and b where a has a known dependence on the current.

    Parameters
    ----------
    time, measured, weight : array, shape (n,)
        Times from 0 s, currents mA, 1/error 1/mA.
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
    reference = float(measured.mean())
    level = shape(jnp.asarray(reference))

    def relative(beam_current: Array, theta: Array) -> Array:
        return shape(beam_current * reference) / level

    theta, covariance, residuals, success = _minimise(time, measured, weight, relative, ())
    values = _physical(theta, time, reference, relative)
    slopes = jax.jacfwd(lambda p: jnp.stack(_physical(p, time, reference, relative)))(theta)
    spread = np.asarray(slopes @ covariance @ slopes.T)
    errors = np.sqrt(np.diag(spread))
    return Solution(
        values=values,
        errors=Physical(*errors),
        correlation=spread[1, 2] / (errors[1] * errors[2]),
        residuals=residuals,
        sum_squares=np.sum((weight * residuals) ** 2),
        converged=success,
    )


def solve_power(time: np.ndarray, measured: np.ndarray, weight: np.ndarray) -> PowerFit:
    """Fit I0, b and a(I) = a (I/mean)^s with the exponent s free.

    Parameters
    ----------
    time, measured, weight : array, shape (n,)
        Times from 0 s, currents mA, 1/error 1/mA.

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

    def power(beam_current: Array, theta: Array) -> Array:
        return beam_current ** theta[3]

    theta, covariance, residuals, success = _minimise(time, measured, weight, power, (0.0,))
    squares = float(np.sum((weight * residuals) ** 2))
    error = float(np.sqrt(covariance[3, 3]))
    return PowerFit(float(theta[3]), error, residuals, squares, success)
