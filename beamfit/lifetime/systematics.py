"""Systematic errors of a decay, which residuals do not show, and the bias of simpler analyses."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from beamfit.answer import json_of, shown
from beamfit.errors import InputError
from beamfit.lifetime.alternatives import ConstantA
from beamfit.lifetime.evidence import UNITS
from beamfit.lifetime.expansion import (
    LEVEL,
    LOSS,
    POWER,
    Pieces,
    fit_law,
    further_columns,
    lifetime_of,
)
from beamfit.lifetime.fit import MIN_FITTED_READINGS, DecayFit, bare, fit_decay
from beamfit.lifetime.free_law import Law
from beamfit.lifetime.record import DecayRecord
from beamfit.quantity import HOUR, Quantity, Status

# Sizes of the causes in the table, chosen: shifts for other sizes are proportional.
# Relative rise of the pressure over the record.
PRESSURE_RISE = 0.01
# Drift of the monitor over the record, and its offset, mA.
MONITOR_DRIFT, MONITOR_OFFSET = 0.01, 0.1
# Exponent of a, as of a bunch that lengthens.
EXPONENT = -0.1
# Share of the pressure that follows the current: in electron rings the pressure with beam is often
# twice that without (O. Gröbner, CERN 99-05, p. 127).
FOLLOWING_SHARE = 0.5
# Below this current, mA, drift and offset of the monitor are proportional to the current: a monitor
# for small currents is better.
SMALL_CURRENT = 10.0


@shown
class Systematic(NamedTuple):
    """Systematic error: a cause, and the shifts of the fitted values.

    Attributes
    ----------
    cause : str
        Cause in words, with its size.
    a, b, lifetime_mean : float
        Fitted minus true value, 1/(mA s), 1/s and h.
    """

    cause: str
    a: float
    b: float
    lifetime_mean: float

    def to_json(self) -> dict[str, Any]:
        """Cause and shifts as JSON's types."""
        moved = {name: bare(getattr(self, name), UNITS[name]) for name in self._fields[1:]}
        return json_of({"cause": self.cause, **moved})


def systematics(fit: DecayFit) -> tuple[Systematic, ...]:
    """Systematic errors of a fitted decay, one cause at a time.

    Parameters
    ----------
    fit : DecayFit
        Fit with constant a, with its readings.

    Returns
    -------
    tuple of Systematic
        Empty where a and b are infeasible or not determined, a has a given shape, or cycles were
        fitted together. Each shift is proportional to its cause in first order. A rise of the
        pressure and a bunch that lengthens are left out where the errors contain them.

    Notes
    -----
    A change d of the readings shifts the parameters by (JᵀWJ)⁻¹ JᵀW d. A pressure that rises by
    the share e over the record adds -b e (t/T - 1/2) I to dI/dt: a column of the law, like an
    exponent. Of a pressure P0 + P1 I the part that follows the current adds to a exactly, so no
    decay can separate it from a.

    Examples
    --------
    >>> from beamfit.lifetime.decay_law import current
    >>> from beamfit.lifetime.fit import fit_decay
    >>> from beamfit.lifetime.record import DecayRecord
    >>> t = np.linspace(0, 8 * 3600, 500)
    >>> noise = 1e-3 * np.random.default_rng(1).normal(size=t.size)
    >>> fit = fit_decay(DecayRecord(t, np.array(current(t, 500.0, 2e-8, 1e-6)) + noise))
    >>> [f"{100 * row.a / fit.a.value:.2f} %" for row in systematics(fit)]
    ['0.03 %', '0.00 %', '11.52 %']
    """
    a, b = fit.if_constant("a").value, fit.if_constant("b").value
    record, other_law = fit.readings, fit.shaped or fit.first is not None
    if other_law or fit.status is Status.infeasible or fit.a.error is None:
        return ()
    expansion = fit.expansion
    errors, share = expansion.pieces.divisor, record.time / record.span
    rise = further_columns(expansion, "drift", np.zeros(1))[:, 0] * errors * record.span
    rises = f"pressure rises by {100 * PRESSURE_RISE:g} % over the record"
    bends = f"a goes as I^{EXPONENT:g}, as of a bunch that lengthens"
    causes = {rises: b * PRESSURE_RISE * rise, **_monitor(record, share)}
    causes |= {bends: EXPONENT * (expansion.rows[:, POWER] * errors)}
    if fit.free_law is not None:
        contained = {bends} if fit.free_law.drift is None else {bends, rises}
        causes = {cause: change for cause, change in causes.items() if cause not in contained}
    rate, rows = a * fit.mean_current + b, []
    for cause, change in causes.items():
        moved = expansion.value_shifts(change / errors)
        lifetime = -moved.rate_mean / rate**2 / HOUR
        rows.append(Systematic(cause, moved.a, moved.b, lifetime))
    gas = max(b, 0.0) * FOLLOWING_SHARE / (1 - FOLLOWING_SHARE)
    cause_words = f"{100 * FOLLOWING_SHARE:g} % of the pressure follows the current"
    return (*rows, Systematic(cause_words, gas / fit.mean_current, -gas, 0.0))


def _monitor(record: DecayRecord, share: np.ndarray) -> dict[str, np.ndarray]:
    """Changes of the readings, mA, by errors of the monitor, stated or assumed."""
    if record.monitor is None:
        scale = min(float(record.current.max()) / SMALL_CURRENT, 1.0)
        drift, offset = MONITOR_DRIFT * scale, MONITOR_OFFSET * scale
        return {
            f"monitor drifts by {1e3 * drift:.2g} µA over the record": drift * share,
            f"monitor reads {offset:.2g} mA too much": np.full(len(record), offset),
        }
    stated = record.monitor.changes(record.time)
    return {f"monitor {cause} (in the errors)": moved for cause, moved in stated.items()}


@shown
@dataclass(frozen=True)
class OneLifetime:
    """Lifetime from an analysis that assumes it constant, and its bias.

    Parameters
    ----------
    lifetime : Quantity
        Lifetime, h.
    rms_residual : float
        Root mean square of the residuals, mA.
    bias_start, bias_mean : float
        Relative difference from the lifetime of the (a, b) fit at the first reading and at the
        mean current; NaN where that fit has none.
    """

    lifetime: Quantity
    rms_residual: float
    bias_start: float
    bias_mean: float

    def to_json(self) -> dict[str, Any]:
        """Fields as JSON's types; an unknown bias is null."""
        return json_of(vars(self) | {"rms_residual": bare(self.rms_residual, "mA")})


def _one_lifetime(
    rate: float, error: float, residuals: np.ndarray, record: DecayRecord, fit: DecayFit | None
) -> OneLifetime:
    """Compare a constant loss rate with the fit of a record, which is made if not given."""
    lifetime, fit = lifetime_of(rate, error), fit or fit_decay(record, law=Law.constant)
    values = fit.lifetime_start.value, fit.lifetime_mean.value
    bias = [lifetime.value / value - 1 for value in values]
    rms = float(np.sqrt(np.mean(residuals**2)))
    return OneLifetime(replace(lifetime, error_raw=lifetime.error), rms, *bias)


def single_exponential(record: DecayRecord, fit: DecayFit | None = None) -> OneLifetime:
    """Fit I0 exp(-t/tau), report equation 41, for comparison.

    Parameters
    ----------
    record : DecayRecord
        One decay.
    fit : DecayFit, optional
        Fit of the record, if there is one already.

    Returns
    -------
    OneLifetime
        Lifetime with its formal error, which does not contain the stated bias.

    Examples
    --------
    >>> t = np.linspace(0, 8 * 3600, 500)
    >>> print(single_exponential(DecayRecord(t, 500 / (1 + t / 36000))).lifetime.value > 10)
    True
    """
    found = fit_law(Pieces.of(record), (LOSS,))
    moments = found.memory((LEVEL, LOSS), True).moments(np.eye(2)[1:], found.min_factor)
    error = float(moments.error[0]) / record.span
    return _one_lifetime(float(found.values.b), error, found.current_residuals, record, fit)


def log_linear(record: DecayRecord, fit: DecayFit | None = None) -> OneLifetime:
    """Fit a straight line to ln I, as is common in control rooms, for comparison.

    Parameters
    ----------
    record : DecayRecord
        One decay with positive currents.
    fit : DecayFit, optional
        As for `single_exponential`.

    Returns
    -------
    OneLifetime
        Lifetime with its formal error, which does not contain the stated bias.

    Raises
    ------
    InputError
        If a current is zero.

    Examples
    --------
    >>> t = np.linspace(0, 8 * 3600, 500)
    >>> print(f"{log_linear(DecayRecord(t, 500 / (1 + t / 36000))).bias_start:.2f}")
    0.38
    """
    if record.current.min() <= 0:
        raise InputError("a current of zero", "positive ones for a logarithm", path=record.name)
    logs = np.log(record.current)
    (slope, level), covariance = np.polyfit(record.time, logs, 1, cov=True)
    residuals = np.exp(level + slope * record.time) - record.current
    return _one_lifetime(-slope, math.sqrt(covariance[0, 0]), residuals, record, fit)


@shown
@dataclass(frozen=True, eq=False)
class LifetimeTrace:
    """Momentary lifetime along a record.

    Parameters
    ----------
    time : array, shape (m,)
        Mean time of each window, s.
    current : array, shape (m,)
        Mean current in it, mA.
    lifetime : array, shape (m,)
        Lifetime, h; infinite where the current is constant, negative where it rises.
    error : array, shape (m,)
        Standard error, h, from the scatter within the window; NaN where the current is constant.
    """

    time: np.ndarray
    current: np.ndarray
    lifetime: np.ndarray
    error: np.ndarray


def moving_lifetime(record: DecayRecord, window: float) -> LifetimeTrace:
    """Momentary lifetime from straight lines over a moving window.

    Parameters
    ----------
    record : DecayRecord
        A record without steps.
    window : float
        Length of the window, s.

    Returns
    -------
    LifetimeTrace
        One value for each reading whose window lies within the record and contains five readings.
        Neighbouring values share readings. The lifetime is that at the mean current of the window,
        too long by the relative amount (window/lifetime)²/60, for gas and Touschek losses alike.

    Raises
    ------
    InputError
        If no window fits.

    Examples
    --------
    >>> t = np.arange(0.0, 7200.0, 10.0)
    >>> trace = moving_lifetime(DecayRecord(t, 100 * np.exp(-t / 36000)), 600.0)
    >>> print(f"{trace.lifetime.min():.4f} to {trace.lifetime.max():.4f} h")
    10.0000 to 10.0000 h
    """
    time, current = record.time, record.current
    centres = np.flatnonzero((time >= window / 2) & (time <= record.span - window / 2))
    first = np.searchsorted(time, time[centres] - window / 2, side="left")
    last = np.searchsorted(time, time[centres] + window / 2, side="right")
    full = last - first >= MIN_FITTED_READINGS
    if not full.any():
        expected = (
            f"one that holds {MIN_FITTED_READINGS} readings and fits into {record.span:.6g} s"
        )
        raise InputError(f"a window of {window:.6g} s", expected, path=record.name)
    rows = []
    for start, end in zip(first[full], last[full], strict=True):
        middle = time[start:end].mean()
        centred = time[start:end] - middle
        (slope, level), spread = np.polyfit(centred, current[start:end], 1, cov=True)
        rows.append((middle, level, slope, math.sqrt(max(spread[0, 0], 0.0))))
    middle, level, slope, error = np.transpose(rows)
    with np.errstate(divide="ignore", invalid="ignore"):
        return LifetimeTrace(middle, level, -level / slope / HOUR, level * error / slope**2 / HOUR)


def constant_a_test(record: DecayRecord) -> ConstantA:
    """Test whether a is constant, against a power of the current.

    Parameters
    ----------
    record : DecayRecord
        One decay.

    Returns
    -------
    ConstantA
        Exponent, probability, and verdict. Every fit has it as `DecayFit.constant_a`.

    Raises
    ------
    InputError
        As for `fit_decay`, and for readings that are all equal.

    Notes
    -----
    A bunch that lengthens with its current loses less at high current than with a constant a. A fit
    with constant a then puts part of the loss into b: repeat it with the law of the bunch,
    `fit_decay(record, shape=...)`. The exponent is estimated together with I0, a and b in linear
    approximation about a constant a (score test), and its error includes the correlation of the
    noise (`beamfit.noise.memory`).

    Examples
    --------
    >>> from beamfit.lifetime.decay_law import current
    >>> from beamfit.quantity import HOUR
    >>> t = np.linspace(0, 8 * 3600, 500)
    >>> noise = 1e-3 * np.random.default_rng(1).normal(size=t.size)
    >>> record = DecayRecord(t, np.array(current(t, 500.0, 2e-8, 1e-6)) + noise)
    >>> print(constant_a_test(record).status)
    converged
    """
    found = fit_decay(record, law=Law.constant).constant_a
    if found is None:
        raise InputError("readings that are all equal", "a decay", path=record.name)
    return found
