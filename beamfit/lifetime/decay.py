"""The decay law of a stored beam, its lifetime, and its rate equation when a varies."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array

from beamfit.quantity import HOUR as HOUR

# Mean of exp(-x) over [0, x]: below this x the series is exact to rounding, above it the quotient.
SERIES_BELOW = 0.1


def mean_exponential(x: Array) -> Array:
    """(1 - exp(-x))/x, smooth through x = 0 with all derivatives.

    Parameters
    ----------
    x : float or array
        Any real number.

    Returns
    -------
    float or array
        The mean of exp(-u) for u between 0 and x; 1 at zero.

    Examples
    --------
    >>> print(mean_exponential(0.0), f"{mean_exponential(1.0):.6f}")
    1.0 0.632121
    """
    x = jnp.asarray(x, float)
    small = jnp.abs(x) < SERIES_BELOW
    inner = jnp.where(small, x, 0.0)
    series = jnp.ones_like(x)
    for order in range(11, 1, -1):
        series = 1 - inner / order * series
    outer = jnp.where(small, 1.0, x)
    return jnp.where(small, series, -jnp.expm1(-outer) / outer)


def current(time: Array, i0: Array, a: Array, b: Array) -> Array:
    """Beam current after a decay with dI/dt = -a I² - b I.

    Parameters
    ----------
    time : float or array
        Time since the start, s.
    i0 : float
        Current at the start, mA.
    a : float
        Coefficient of the losses that grow with the square of the current, 1/(mA s).
    b : float
        Coefficient of the losses proportional to the current, 1/s; may be zero.

    Returns
    -------
    float or array
        Current, mA.

    Notes
    -----
    Report equation 44, I0 exp(-bt)/(1 + (a/b) I0 (1 - exp(-bt))), with the quotient written as
    t times `mean_exponential`, so that b = 0 gives equation 43 and nothing is divided by zero.

    Examples
    --------
    >>> print(f"{current(3600.0, 500.0, 2e-8, 1e-6):.3f} {current(3600.0, 500.0, 2e-8, 0.0):.3f}")
    480.921 482.625
    """
    return i0 * jnp.exp(-b * time) / (1 + a * i0 * time * mean_exponential(b * time))


def lifetime(beam_current: Array, a: Array, b: Array) -> Array:
    """Momentary lifetime -I/(dI/dt) at a current.

    Parameters
    ----------
    beam_current : float or array
        Current, mA.
    a, b : float
        As for `current`.

    Returns
    -------
    float or array
        1/(a I + b), s.

    Examples
    --------
    >>> print(f"{lifetime(500.0, 2e-8, 1e-6) / 3600:.2f} h")
    25.25 h
    """
    return 1 / (a * beam_current + b)


def current_by_rate(
    time: Array, i0: Array, rate: Callable[[Array], Array], steps: int = 4
) -> Array:
    """Beam current for any loss rate that depends on the current: report equation 42 integrated.

    The model to use when a is not constant, as when the bunch lengthens with its current. A
    constant a fitted to such a decay puts the difference into b, a gas loss that is not there.

    Parameters
    ----------
    time : array, shape (n,)
        Times, s, not falling; the first is the start.
    i0 : float
        Current at the first time, mA.
    rate : callable
        Relative loss rate 1/s as a function of the current in mA.
    steps : int, optional
        Runge-Kutta steps between two times.

    Returns
    -------
    array, shape (n,)
        Currents, mA.

    Notes
    -----
    Fourth-order Runge-Kutta for ln I, which varies slowly: a step over a tenth of the lifetime
    is exact to 1e-8. Differentiable in `i0` and in whatever `rate` closes over.

    Examples
    --------
    >>> import numpy as np
    >>> t = np.linspace(0, 36000, 11)
    >>> by_rate = current_by_rate(t, 500.0, lambda i: 2e-8 * i + 1e-6)
    >>> print(bool(abs(by_rate / current(t, 500.0, 2e-8, 1e-6) - 1).max() < 1e-10))
    True
    """

    def slope(log_current: Array) -> Array:
        return -rate(jnp.exp(log_current))

    def advance(log_current: Array, step: Array) -> tuple[Array, Array]:
        k1 = slope(log_current)
        k2 = slope(log_current + step / 2 * k1)
        k3 = slope(log_current + step / 2 * k2)
        k4 = slope(log_current + step * k3)
        log_current = log_current + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return log_current, log_current

    start = jnp.log(jnp.asarray(i0, float))
    intervals = jnp.repeat(jnp.diff(jnp.asarray(time, float)) / steps, steps)
    _, logs = jax.lax.scan(advance, start, intervals)
    return jnp.exp(jnp.concatenate([start[None], logs[steps - 1 :: steps]]))
