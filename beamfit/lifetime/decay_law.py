"""Decay law dI/dt = -a I² (I/mean)^s - b(t) I: closed form, lifetimes, loss rates."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.arrays import array_module
from beamfit.compile_cache import prepare_jax

prepare_jax()

# (1 - exp(-x))/x is computed by a series below this x, by the quotient above it; both are exact to
# rounding there.
SERIES_BELOW = 0.1
# Nodes and weights of Gauss quadrature on [0, 1], three points.
NODES = 0.5 + np.array([-0.5, 0.0, 0.5]) * math.sqrt(0.6)
WEIGHTS = np.array([5.0, 8.0, 5.0]) / 18
# Smallest current over the mean of which powers and logarithms are taken.
MIN_CURRENT = 1e-12


def mean_exponential(x):
    """(1 - exp(-x))/x, smooth through x = 0 with all derivatives.

    Parameters
    ----------
    x : float or array
        Any number, NumPy's or JAX's.

    Returns
    -------
    float or array
        Mean of exp(-u) for u between 0 and x; 1 at zero.

    Examples
    --------
    >>> print(mean_exponential(0.0), f"{mean_exponential(1.0):.6f}")
    1.0 0.632121
    """
    xp = array_module(x)
    small = xp.abs(x) < SERIES_BELOW
    inner = xp.where(small, x, 0.0)
    series = 1.0
    for order in range(11, 1, -1):
        series = 1 - inner * (1.0 / order) * series  # complex numbers are slow to divide
    outer = xp.where(small, 1.0, x)
    return xp.where(small, series, -xp.expm1(-outer) / outer)


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
    return closed_form(i0, a, 0.0, b * time, time * mean_exponential(b * time))


class Moments(NamedTuple):
    """Times of readings.

    Attributes
    ----------
    time : array, shape (n,)
        Times since the first reading of a piece, in any unit.
    gas : array, shape (n,), or None
        Integral of the pressure over its mean, in the same unit; None if the pressure is constant.
    """

    time: np.ndarray
    gas: np.ndarray | None = None


def closed_form(level, quadratic, power, lost, whole):
    """Solve dx/dt = -A x^(1 + c) - b(t) x by Bernoulli's substitution, with c = 1 + power.

    x = x0 exp(-B) (1 + c A x0^c W)^(-1/c), where B (`lost`) is the integral of b, and W (`whole`)
    that of exp(-c B). NaN where a negative loss has no finite solution.

    Examples
    --------
    >>> print(f"{closed_form(1.0, 0.5, 0.0, 0.0, 2.0):.3f}")
    0.500
    """
    xp, c = array_module(level, quadratic, power, lost, whole), 1.0 + power
    base = 1.0 + c * quadratic * level**c * whole
    physical = xp.real(base) > 0
    factor = xp.where(physical, base, 1.0) ** (-1.0 / c)
    return level * xp.exp(-lost) * xp.where(physical, factor, np.nan)


def course(kind: str, time: np.ndarray, when: complex) -> np.ndarray:
    """Integral from 0 to `time` of a further loss rate of unit size.

    Kinds: "relaxing" (exp(-t/when)), a "step" at the time `when`, a "drift" (t - 1/2), or "sudden"
    (all of it at the time `when`).
    """
    if kind == "step":
        return np.where(time > np.real(when), time - when, 0.0)
    if kind == "drift":
        return time * (time - 1.0) / 2
    if kind == "sudden":
        return np.where(time > np.real(when), 1.0, 0.0)
    return -when * np.expm1(-time / when)


def beam_current(
    level: np.ndarray,
    numbers: Sequence[np.ndarray],
    at: Moments,
    kind: str | None = None,
    shape: Callable[[Array], Array] | None = None,
) -> np.ndarray:
    """Beam current over its mean, for any power of a and any b(t).

    Parameters
    ----------
    level : float or array, shape (n,)
        Current over the mean at the first reading of each reading's piece.
    numbers : sequence, of length 3 or 3 + 2 k
        Loss rate at the mean current, its quadratic part, the power by which a departs from its
        shape, and k times a further loss and its time; complex for slopes by imaginary steps.
    at : Moments
        Times; with a gauge or further losses those of a single piece.
    kind : {"relaxing", "step", "drift", "sudden", "step of a"}, optional
        Kind of the further losses, as for `course`, or a step of a, proportional to the current;
        not with a gauge.
    shape : callable, optional
        Dependence of a on the current over its mean, up to a factor, if it is no power. The rate
        equation of a single piece is then integrated, without further losses.

    Returns
    -------
    array, shape (n,)

    Notes
    -----
    The integral of exp(-c B) in `closed_form` is taken between readings by three-point Gauss
    quadrature; for constant b it has a closed form. Report equations 42 and 44.

    Examples
    --------
    >>> at = Moments(np.array([0.0, 1.0]))
    >>> print(beam_current(1.0, np.array([0.5, 0.5, 0.0]), at).round(6))
    [1.       0.666667]
    """
    loss, quadratic, power, *further = numbers
    linear = loss - quadratic
    if shape is not None:
        return np.asarray(_integrate_shape(at.time, level, quadratic, linear, power, shape))
    if at.gas is None and kind in (None, "step of a"):
        lost = linear * at.time

        def whole(time: np.ndarray) -> np.ndarray:
            return time * mean_exponential((1.0 + power) * linear * time)

        at_readings = whole(at.time)
        total = quadratic * at_readings  # A W, with steps of A
        for size, when in zip(further[::2], further[1::2], strict=True):
            after = np.where(at.time > np.real(when), at_readings - whole(when), 0)
            total = total + size * after
        return closed_form(level, 1.0, power, lost, total)

    def lost_until(time: np.ndarray, gas: np.ndarray) -> np.ndarray:
        pairs = zip(further[::2], further[1::2], strict=True)
        return linear * gas + sum(f * course(kind, time, w) for f, w in pairs)

    gas = at.time if at.gas is None else at.gas
    interval, gas_interval = np.diff(at.time, prepend=0.0), np.diff(gas, prepend=0.0)
    node = at.time[:, None] + interval[:, None] * (NODES - 1)
    node_gas = gas[:, None] + gas_interval[:, None] * (NODES - 1)
    whole = np.cumsum(interval * (np.exp(-(1.0 + power) * lost_until(node, node_gas)) @ WEIGHTS))
    return closed_form(level, quadratic, power, lost_until(at.time, gas), whole)


@partial(jax.jit, static_argnames="shape")
def _integrate_shape(
    time: Array, level: Array, quadratic: Array, linear: Array, power: Array, shape
):
    def rate(x: Array) -> Array:
        x = jnp.maximum(x, MIN_CURRENT)
        return quadratic * shape(x) / shape(1.0) * x ** (1.0 + power) + linear

    return current_by_rate(time, level, rate)


def lifetime(beam_current: Array, a: Array, b: Array) -> Array:
    """Lifetime -I/(dI/dt) at a current.

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
    """Beam current for any loss rate that depends on the current: report equation 42, integrated.

    It is the model for an a that is not constant, such as that of a bunch that lengthens with its
    current. A constant a fitted to such a decay shows up as a false gas loss in b.

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
    Fourth-order Runge-Kutta for ln I, which varies slowly: a step over a tenth of the lifetime is
    exact to 1e-8. Differentiable in `i0` and in whatever `rate` closes over.

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
