"""Systematics of a decay that no residual shows, and the bias of simpler analyses."""

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

# The size of each cause that the table assumes; those of the monitor in mA, and in proportion
# below so many: a monitor of small currents is as good as that.
PRESSURE, DRIFT, OFFSET, EXPONENT = 0.01, 0.01, 0.1, -0.1
# The part of the gas that the beam makes: in electron rings the pressure with beam is often twice
# that without (O. Gröbner, CERN 99-05, p. 127).
FOLLOWING = 0.5
SMALL = 10.0


@shown
class Systematic(NamedTuple):
    """A cause and by how much it moves what was fitted.

    Attributes
    ----------
    cause : str
        In words, with its size.
    a, b, lifetime_mean : float
        Fitted less true value, 1/(mA s), 1/s and h.
    """

    cause: str
    a: float
    b: float
    lifetime_mean: float

    def to_json(self) -> dict[str, Any]:
        """Return the cause and the shifts as JSON's types."""
        moved = {name: bare(getattr(self, name), UNITS[name]) for name in self._fields[1:]}
        return json_of({"cause": self.cause, **moved})


def systematics(fit: DecayFit) -> tuple[Systematic, ...]:
    """Table of systematic errors of a fitted decay, each cause by itself.

    Parameters
    ----------
    fit : DecayFit
        With its readings, of a constant a.

    Returns
    -------
    tuple of Systematic
        Empty where a and b are impossible or not determined, a was given a shape, or many cycles
        were fitted. To first order each shift is proportional to its cause. A pressure that rises
        in the record and a bunch that lengthens are left out where the errors contain them.

    Notes
    -----
    A change of the readings d moves the numbers by (JᵀWJ)⁻¹ JᵀW d. A pressure that rises by the
    share e over the record adds -b e (t/T - 1/2) I to dI/dt: a column of the law, as an exponent
    is. A pressure P0 + P1 I adds the part that follows the current to a exactly: no decay tells it
    from a.

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
    record, another = fit.readings, fit.shaped or fit.first is not None
    if another or fit.status is Status.infeasible or fit.a.error is None:
        return ()
    about = fit.about
    over, share = about.pieces.divisor, record.time / record.span
    grown = further_columns(about, "drift", np.zeros(1))[:, 0] * over * record.span
    rises = f"pressure rises by {100 * PRESSURE:g} % over the record"
    bends = f"a goes as I^{EXPONENT:g}, as of a bunch that lengthens"
    causes = {rises: b * PRESSURE * grown, **_monitor(record, share)}
    causes |= {bends: EXPONENT * (about.rows[:, POWER] * over)}
    if fit.free_law is not None:
        contained = {bends} if fit.free_law.drift is None else {bends, rises}
        causes = {cause: change for cause, change in causes.items() if cause not in contained}
    rate, found = a * fit.mean_current + b, []
    for cause, change in causes.items():
        moved = about.value_shifts(change / over)
        lifetime = -moved.rate_mean / rate**2 / HOUR
        found.append(Systematic(cause, moved.a, moved.b, lifetime))
    gas = max(b, 0.0) * FOLLOWING / (1 - FOLLOWING)
    said = f"{100 * FOLLOWING:g} % of the pressure follows the current"
    return (*found, Systematic(said, gas / fit.mean_current, -gas, 0.0))


def _monitor(record: DecayRecord, share: np.ndarray) -> dict[str, np.ndarray]:
    """Instability of the monitor as stated, or else assumed."""
    if record.monitor is None:
        size = min(float(record.current.max()) / SMALL, 1.0)
        return {
            f"monitor drifts by {1e3 * DRIFT * size:.2g} µA over the record": DRIFT * size * share,
            f"monitor reads {OFFSET * size:.2g} mA too much": np.full(len(record), OFFSET * size),
        }
    stated = record.monitor.changes(record.time)
    return {f"monitor {cause} (in the errors)": moved for cause, moved in stated.items()}


@shown
@dataclass(frozen=True)
class OneLifetime:
    """A lifetime from an analysis that takes it as constant, and its bias.

    Parameters
    ----------
    lifetime : Quantity
        The lifetime, h.
    rms_residual : float
        Root mean square of the residuals, mA.
    bias_start, bias_mean : float
        Relative difference from the lifetime that the (a, b) fit gives at the first reading and
        at the mean current; NaN where that fit gives none.
    """

    lifetime: Quantity
    rms_residual: float
    bias_start: float
    bias_mean: float

    def to_json(self) -> dict[str, Any]:
        """Return the fields as JSON's types; a bias that is not known is null."""
        return json_of(vars(self) | {"rms_residual": bare(self.rms_residual, "mA")})


def _one_lifetime(
    rate: float, error: float, residuals: np.ndarray, record: DecayRecord, fit: DecayFit | None
) -> OneLifetime:
    """A constant loss rate beside the fit of a record, which is made where there is none."""
    found, fit = lifetime_of(rate, error), fit or fit_decay(record, law=Law.constant)
    known = fit.lifetime_start.value, fit.lifetime_mean.value
    bias = [found.value / value - 1 for value in known]
    rms = float(np.sqrt(np.mean(residuals**2)))
    return OneLifetime(replace(found, error_raw=found.error), rms, *bias)


def single_exponential(record: DecayRecord, fit: DecayFit | None = None) -> OneLifetime:
    """Fit I0 exp(-t/tau), the law of report equation 41, for comparison.

    Parameters
    ----------
    record : DecayRecord
        One decay.
    fit : DecayFit, optional
        Of the record, where there is one.

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
    """Fit a straight line to ln I, as control rooms do, for comparison.

    Parameters
    ----------
    record : DecayRecord
        One decay, all currents positive.
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
        Lifetime, h; infinite where no decay is seen, negative where the current rises.
    error : array, shape (m,)
        Standard deviation, h, from the scatter within the window; NaN where nothing changes.
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
        One value for each reading whose window lies within the record and holds five readings.
        Neighbouring values share readings. The lifetime is that at the window's mean current,
        too long by a share of (window/lifetime)²/60, for a decay by gas and by Touschek alike.

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
        at = time[start:end].mean()
        (slope, level), spread = np.polyfit(time[start:end] - at, current[start:end], 1, cov=True)
        rows.append((at, level, slope, math.sqrt(max(spread[0, 0], 0.0))))
    at, level, slope, error = np.transpose(rows)
    with np.errstate(divide="ignore", invalid="ignore"):
        return LifetimeTrace(at, level, -level / slope / HOUR, level * error / slope**2 / HOUR)


def constant_a_test(record: DecayRecord) -> ConstantA:
    """Test whether a is constant, against a power of the current.

    Parameters
    ----------
    record : DecayRecord
        One decay.

    Returns
    -------
    ConstantA
        Exponent, probability, and the verdict: part of every fit, as `DecayFit.constant_a`.

    Raises
    ------
    InputError
        As for `fit_decay`, and for readings that are all equal.

    Notes
    -----
    A bunch that lengthens with its current loses less at high current than a constant a says. A
    constant a then leaves a remainder that the fit takes for a gas term: repeat the fit with
    the bunch's own law, `fit_decay(record, shape=...)`. The exponent is estimated beside I0, a and
    b in linear approximation about a constant a, and its error contains the noise's memory
    (`beamfit.noise.memory`): the score test.

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
