"""The law of a decay: the current it gives, its loss rates, and what an exponent would change."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.lifetime.decay import HOUR, current, current_by_rate, mean_exponential
from beamfit.quantity import Quantity

Shape = Callable[[Array], Array]
# The least current whose logarithm is taken, in units of the mean.
LEAST = 1e-12
# Gauss's nodes and weights for an interval of 1.
NODES = 0.5 + np.array([-0.5, 0.0, 0.5]) * math.sqrt(0.6)
WEIGHTS = np.array([5.0, 8.0, 5.0]) / 18


class DecayNumbers(NamedTuple):
    """Current at the first reading, mA, and a, 1/(mA s), and b, 1/s, of dI/dt = -a I² - b I.

    `exponent` is the power of the current by which a departs from its known dependence,
    `log_memory` the logarithm of the correlation time of the readings' errors, s, and `log_wander`
    that of the variance that they get anew in a usual interval over that of their white part;
    `drift`, mA/s, and `offset`, mA, are the monitor's.
    """

    i0: Array
    a: Array
    b: Array
    exponent: Array = 0.0
    log_memory: Array = 0.0
    log_wander: Array = 0.0
    drift: Array = 0.0
    offset: Array = 0.0


class Moments(NamedTuple):
    """When a current is asked for: times, s, and the record's mean current, mA.

    `gauge` is the integral of the pressure over its mean, s, where the pressure changes in the
    record: the gas loss is then b times the pressure over its mean.
    """

    time: Array
    mean: Array
    gauge: Array | None = None


class Physical(NamedTuple):
    """What one decay says, in s and mA: loss rates at the first and last time and at the mean
    current, the share of a in the loss there, the power by which a departs from its shape (where
    it is not free, its estimate beside the other numbers in linear approximation).
    """

    i0: Array
    a: Array
    b: Array
    rate_start: Array
    rate_end: Array
    rate_mean: Array
    share: Array
    exponent: Array


class Expansion(NamedTuple):
    """A law about a solution: residuals over errors (n,), their slopes by p scaled numbers (n, p),
    the last of them the exponent, and the slopes of `Physical` by the same (8, p).
    """

    residuals: np.ndarray
    rows: np.ndarray
    slopes: np.ndarray

    @property
    def left(self) -> np.ndarray:
        """Residuals after all numbers, the exponent too, took their part, which is no noise."""
        step = np.linalg.lstsq(self.rows, self.residuals, rcond=None)[0]
        return self.residuals - self.rows @ step

    def moved(self, change: np.ndarray) -> Physical:
        """What a change of the readings, over their errors, does to the values by least squares;
        to an exponent beside the other numbers.
        """
        step = np.linalg.lstsq(self.rows[:, :-1], change, rcond=None)[0]
        beside = np.linalg.lstsq(self.rows, change, rcond=None)[0]
        return Physical(*(self.slopes[:, :-1] @ step))._replace(exponent=beside[-1])


def lifetime_of(rate: float, error: float, clear: float | None = None) -> Quantity:
    """Lifetime, h, of a loss rate, 1/s; unknown of one not so many of its errors above zero."""
    if clear is not None and not rate > clear * error:
        return Quantity(math.nan, None, "h")
    return Quantity(float(1 / rate / HOUR), float(error / rate**2 / HOUR), "h")


def power_rates(numbers: np.ndarray, unit: float, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Loss rates, 1/s, at currents x over the mean where a goes as a power of the current.

    Numbers are the loss in the unit of time, s, at the mean current, its quadratic part, and the
    exponent; with slopes by the three.
    """
    loss, quadratic, exponent = numbers
    power = x ** (1 + exponent)
    slopes = np.stack([np.ones_like(x), power - 1, quadratic * power * np.log(x)], axis=1)
    return (quadratic * power + loss - quadratic) / unit, slopes / unit


def constant_shape(beam: Array) -> Array:
    """The shape of a constant a: ones."""
    return jnp.ones_like(beam, dtype=float)


def _quadratic(numbers: DecayNumbers, mean: Array, shape: Shape, beam: Array) -> Array:
    """The part of the relative loss rate that a makes at a current."""
    # A search through noise may pass a current without a logarithm.
    log = jnp.log(jnp.maximum(beam / mean, LEAST))
    relative = shape(beam) / shape(mean) * jnp.exp(numbers.exponent * log)
    return numbers.a * relative * beam


def cumulative(values: Array) -> Array:
    """Cumulative sum by two small triangular products: JAX's own takes seconds to compile."""
    side = math.isqrt(values.size - 1) + 1
    square = jnp.pad(values, (0, side**2 - values.size)).reshape(side, side)
    within = square @ jnp.triu(jnp.ones((side, side)))
    before = jnp.tril(jnp.ones((side, side)), -1) @ within[:, -1]
    return (within + before[:, None]).ravel()[: values.size]


def _integral(parts: Array) -> Array:
    return cumulative(jnp.concatenate([jnp.zeros(1), parts]))


def _plain_current(numbers: DecayNumbers, at: Moments) -> Array:
    """Report equation 44; with a gauge, the same Bernoulli equation for b P(t)/mean.

    1/I = exp(B) (1/I0 + a ∫ exp(-B) dt) with B = b ∫ P dt/mean, the pressure constant between
    readings.
    """
    if at.gauge is None:
        return current(at.time, numbers.i0, numbers.a, numbers.b)
    gas = numbers.b * at.gauge
    parts = jnp.diff(at.time) * jnp.exp(-gas[:-1]) * mean_exponential(jnp.diff(gas))
    return numbers.i0 * jnp.exp(-gas) / (1 + numbers.a * numbers.i0 * _integral(parts))


def beam_current(numbers: DecayNumbers, at: Moments, shape: Shape | None = None) -> Array:
    """Current, mA: report equation 44, or 42 integrated where a has a shape.

    The shape is a dependence on the current in mA, up to a factor, in JAX; a is then the value at
    the mean current.
    """
    if shape is None:
        return _plain_current(numbers, at)

    def rate(beam: Array) -> Array:
        return _quadratic(numbers, at.mean, shape, beam) + numbers.b

    return current_by_rate(at.time, numbers.i0, rate)


def monitored_current(numbers: DecayNumbers, at: Moments) -> Array:
    """What a monitor with a drift and an offset reads, mA."""
    return beam_current(numbers, at) + numbers.offset + numbers.drift * at.time


def bent_current(numbers: DecayNumbers, at: Moments) -> Array:
    """Current of the plain law to first order in the exponent, the mean current being 1.

    The change u of dI/dt = -a I^(2 + s) - b I obeys du/dt = -(2 a I + b) u - a I² ln I, and
    I² exp(B) solves this without its last term, so u = -a I² exp(B) ∫ exp(-B) ln I dt.
    """
    beam, step = _plain_current(numbers, at), jnp.diff(at.time)
    if at.gauge is None:
        gas = numbers.b * at.time
        node = at.time[:-1, None] + step[:, None] * NODES
        inner = current(node, numbers.i0, numbers.a, numbers.b)
        logs = jnp.exp(-numbers.b * node) * jnp.log(jnp.maximum(inner, LEAST))
        parts = step * (logs @ WEIGHTS)
    else:
        gas = numbers.b * at.gauge
        logs = jnp.exp(-gas) * jnp.log(jnp.maximum(beam, LEAST))
        parts = step * (logs[1:] + logs[:-1]) / 2
    bend = -numbers.a * beam**2 * jnp.exp(gas) * _integral(parts)
    return beam + numbers.exponent * bend


def scaled_numbers(theta: Array) -> DecayNumbers:
    """Numbers of the law from those of the search.

    Its four are: current at the start over the mean, loss in one span at the mean current, the
    part of it that is proportional to current, and the exponent. The second is well determined by
    any record, the third only by a long one, and the two are nearly uncorrelated.
    """
    start, loss, quadratic, exponent = theta
    return DecayNumbers(start, quadratic, loss - quadratic, exponent)


def physical(
    theta: Array, end: Array, pressure: Array, unit: tuple[Array, Array], shape: Shape | None
) -> Array:
    """`Physical` values from the numbers of the search, the last current, and the pressure over
    its mean at both ends; `unit` is the span, s, and the mean current, mA.
    """
    span, mean = unit
    numbers = scaled_numbers(theta)

    def rate(beam: Array, gas: Array) -> Array:
        found = _quadratic(numbers, 1.0, shape or constant_shape, beam) + numbers.b * gas
        return found / span

    return jnp.stack(
        Physical(
            i0=numbers.i0 * mean,
            a=numbers.a / (mean * span),
            b=numbers.b / span,
            rate_start=rate(numbers.i0, pressure[0]),
            rate_end=rate(end, pressure[1]),
            rate_mean=theta[1] / span,
            share=theta[2] / theta[1],
            exponent=theta[3],
        )
    )
