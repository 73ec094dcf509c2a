"""A gas loss that relaxes after a fill: an alternative where constant a and b are refuted."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.greybox.descend import descend_one
from beamfit.lifetime.decay import HOUR
from beamfit.noise.correlated import is_correlated
from beamfit.quantity import Quantity
from beamfit.shown import shown
from beamfit.studies.decay.departures import (
    BETTER,
    CLEAR,
    Change,
    averaged,
    power_law,
    quantity_errors,
)
from beamfit.studies.decay.law import (
    NODES,
    WEIGHTS,
    Expansion,
    Physical,
    cumulative,
    lifetime_of,
)
from beamfit.studies.decay.model import padded
from beamfit.studies.decay.record import DecayRecord

# Time constants, over the span of the record, with which searches begin, and the longest believed.
STARTS, LONGEST = (0.05, 0.2, 0.7), 1.0
# The relaxing loss and its time constant are known to a third at least.
TELLING = 1 / 3
# I0, a, b, the relaxing loss and its time constant.
NUMBERS = 5
LEAST = 1e-3


@shown
class Outgassing(NamedTuple):
    """A gas loss b0 + b1 exp(-t/T): what a fill sets free is pumped away.

    Attributes
    ----------
    time_constant : Quantity
        T, h.
    a, b : Quantity
        The law's a, 1/(mA s), and b0, 1/s, that is left in the end.
    before, after : Quantity
        Lifetime at the first current, h: with the loss there was at first, and with b0 alone.
    current : float
        That current, mA.
    """

    time_constant: Quantity
    a: Quantity
    b: Quantity
    before: Quantity
    after: Quantity
    current: float

    def __str__(self) -> str:
        return (
            f"the gas loss falls with a time constant of {self.time_constant}, as in a vacuum that "
            f"recovers after a fill (outgassing): at {self.current:.4g} mA the lifetime goes from "
            f"{self.before} to {self.after}, with a = {self.a}, b = {self.b}"
        )


class _Fitted(NamedTuple):
    """Five numbers of the search, residuals over errors (n,) and their slopes (n, 5)."""

    theta: np.ndarray
    residuals: np.ndarray
    rows: np.ndarray

    @property
    def squares(self) -> float:
        return float(self.residuals @ self.residuals)


def _course(kind: str, time: Array, at: Array) -> Array:
    """Integral from zero of a further loss of 1: one that relaxes within `at`, or begins there."""
    if kind == "step":
        return jnp.maximum(time - at, 0.0)
    return -at * jnp.expm1(-time / at)


def _current(kind: str, theta: Array, time: Array) -> Array:
    """The current of dI/dt = -a I² - b(t) I: 1/I = exp(B) (1/I0 + a ∫ exp(-B) dt), B = ∫ b dt.

    Numbers are I0, a, b, the further loss, and when; time from 0 to 1, currents about 1.
    """
    start, a, b, further, at = theta

    def gas(time: Array) -> Array:
        return b * time + further * _course(kind, time, at)

    step = jnp.diff(time)
    inner = jnp.exp(-gas(time[:-1, None] + step[:, None] * NODES)) @ WEIGHTS
    whole = cumulative(jnp.concatenate([jnp.zeros(1), step * inner]))
    return start * jnp.exp(-gas(time)) / (1 + a * start * whole)


@partial(jax.jit, static_argnames="kind")
def _search(kind: str, rows: Array, start: Array, unit: Array) -> tuple[Array, Array, Array]:
    time, measured, weight = rows

    def residual(theta: Array) -> Array:
        return weight * (_current(kind, theta, time) - measured) / unit

    lower = jnp.full(5, -jnp.inf).at[4].set(LEAST)
    upper = jnp.full(5, jnp.inf).at[4].set(1.0 if kind == "step" else 10.0)
    theta = descend_one(residual, start, lower, upper).theta
    return theta, unit * residual(theta), unit * jax.jacfwd(residual)(theta)


def _fitted(kind: str, record: DecayRecord, starts: np.ndarray) -> _Fitted:
    """The best of some searches."""
    time, measured, weight = padded(record)
    mean, size = float(record.current.mean()), len(record)
    rows = np.stack([time / record.span, measured / mean, weight * mean])
    # Residuals of a search are about one, whatever the record's errors.
    unit = float(np.median(rows[2, :size])) * 1e-4
    found = [_search(kind, rows, start, unit) for start in starts]
    theta, residuals, slopes = min(found, key=lambda one: float(jnp.sum(one[1] ** 2)))
    return _Fitted(*(np.asarray(part) for part in (theta, residuals[:size], slopes[:size])))


def outgassing_of(record: DecayRecord, plain: Physical, change: Change | None) -> Outgassing | None:
    """A relaxing gas loss, where it explains a record better than an exponent of the current and
    than a change at one time; searched from the numbers of the plain law.

    Notes
    -----
    Least squares on all three; by the likelihood of residuals as alike as those that are left, and
    with a number more than the exponent.
    """
    if len(record) <= NUMBERS:  # nothing is left that tells the noise
        return None
    record = averaged(record)
    power = power_law(record)
    mean, span = float(record.current.mean()), record.span
    numbers = plain.i0 / mean, plain.a * mean * span, plain.b * span
    starts = np.array([[*numbers, 0.1 * abs(plain.rate_mean) * span, at] for at in STARTS])
    found = _fitted("relaxing", record, starts)
    noise = _noise(record, found)
    rivals = [float(power.sum_squares) - BETTER * noise] if power.converged else []
    if change is not None:
        begin = np.array([[*numbers, 0.0, change.time / span]])
        rivals.append(_fitted("step", record, begin).squares)
    answer = _quoted(record, found)
    better = all(found.squares < rival for rival in rivals)
    return answer if better and found.theta[3] > 0 and _is_told(answer, record) else None


def _noise(record: DecayRecord, found: _Fitted) -> float:
    """The square of a residual, times how many neighbours say the same."""
    unit = found.squares / (len(record) - NUMBERS)
    unit = unit if record.error is None else max(unit, 1.0)
    alike = float(found.residuals[1:] @ found.residuals[:-1]) / found.squares
    alike = min(max(alike, 0.0), 0.99)
    return unit * (1 + alike) / (1 - alike)


def _quoted(record: DecayRecord, found: _Fitted) -> Outgassing:
    mean, span = float(record.current.mean()), record.span
    start, a, b, further, at = found.theta
    values = np.array([at * span / HOUR, a / mean / span, b / span,
                       (a * start + b + further) / span, (a * start + b) / span])  # fmt: skip
    slopes = np.array([
        [0, 0, 0, 0, span / HOUR], [0, 1 / mean / span, 0, 0, 0], [0, 0, 1 / span, 0, 0],
        np.array([a, start, 1, 1, 0]) / span, np.array([a, start, 1, 0, 0]) / span,
    ])  # fmt: skip
    about = Expansion(found.residuals, found.rows, slopes)
    remembered = is_correlated(found.residuals, NUMBERS)
    errors = quantity_errors(slopes, about, record, remembered)
    pairs = zip(values, errors, ("h", "1/(mA s)", "1/s", "1/s", "1/s"), strict=True)
    constant, own_a, own_b, *rates = (Quantity(float(v), float(e), u) for v, e, u in pairs)
    before, after = (lifetime_of(rate.value, rate.error, CLEAR) for rate in rates)
    return Outgassing(constant, own_a, own_b, before, after, float(start * mean))


def _is_told(found: Outgassing, record: DecayRecord) -> bool:
    """Whether the record tells the time constant, and lasts as long."""
    constant = found.time_constant
    return constant.error < TELLING * constant.value < TELLING * LONGEST * record.span / HOUR
