"""The posterior of a decay: I0, a and b, none of them negative."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.errors import InputError
from beamfit.lifetime.decay import current
from beamfit.sampling.likelihood import Group, Likelihood
from beamfit.sampling.priors import Distribution, checked
from beamfit.sampling.target import Derived, Law, Target, covariance_of
from beamfit.studies.decay.record import DecayRecord
from beamfit.studies.decay.result import DecayFit

__all__ = ["DecayNumbers", "Readings", "decay_target"]

HOUR = 3600.0
NAMES, UNITS = ("i0", "a", "b"), ("mA", "1/(mA s)", "1/s")
LIFETIMES = ("lifetime_start", "lifetime_mean", "lifetime_end")


class DecayNumbers(NamedTuple):
    """One draw: current at the first reading, mA, and the coefficients of dI/dt = -a I² - b I."""

    i0: Array
    a: Array
    b: Array


class Readings(NamedTuple):
    """A record as the sampler sees it; times s and currents mA, of shape (n,).

    Attributes
    ----------
    time, current, error : Array
        Error 1 mA where none was stated.
    mean_current : Array
        Mean of the record, mA.
    """

    time: Array
    current: Array
    error: Array
    mean_current: Array


def residual(data: Readings, theta: Array) -> tuple[Array, ...]:
    """Of report equation 44."""
    return ((current(data.time, *theta) - data.current) / data.error,)


def flat(data: Readings, theta: Array) -> Array:
    """Flat; the bounds keep the numbers from being negative."""
    return jnp.zeros(())


def numbers(data: Readings, theta: Array) -> DecayNumbers:
    """The draw by name."""
    return DecayNumbers(*theta)


def lifetimes(data: Readings, theta: Array) -> Array:
    """Lifetime at the first reading, at the mean current and at the last reading, h."""
    i0, a, b = theta
    at = jnp.stack([i0, data.mean_current, current(data.time[-1], i0, a, b)])
    return 1.0 / (a * at + b) / HOUR


LAW = Law(residual, flat, lifetimes, numbers)


def decay_target(
    fit: DecayFit,
    noise: str | None = None,
    outliers: bool = False,
    priors: Mapping[str, Distribution] | None = None,
) -> Target:
    """State the posterior of a fitted decay.

    Parameters
    ----------
    fit : DecayFit
        The fit, with its readings.
    noise : {"known", "inferred"}, optional
        None: inferred where the record has no errors or the fit enlarged them, else known.
    outliers : bool
        Whether some readings may be outliers.
    priors : mapping of str to distribution, optional
        On i0, a, b, besides the flat prior above zero.

    Returns
    -------
    Target
        Lifetimes are its derived numbers.

    Raises
    ------
    InputError
        If the fit has no readings or another law than a constant a, an option is not understood,
        or a prior's name is not known.

    Notes
    -----
    Where the record does not tell a from b, the two bounds a ≥ 0 and b ≥ 0 make the posterior a
    line across all shares of a in the loss. The lifetime at the mean current is then as well
    determined as ever; a and b are marked as the bounds'.
    """
    record = fit.readings
    if record is None:
        raise InputError("a fit without its readings", "the result of fit_decay or fit_decays")
    if fit.shaped:
        expected = "a fit of eq. 44 with constant a and b; sample fit_decay(record) without shape"
        raise InputError("a fit with a shape of a(I), which is not sampled", expected)
    priors = checked(priors, NAMES)
    inferred = record.error is None or fit.chi2 > fit.dof
    stated = np.ones(len(record)) if record.error is None else record.error
    data = Readings(record.time, record.current, stated, np.asarray(fit.mean_current))
    mode, width = _start(fit, record, priors)
    scale = fit.rms_residual * np.sqrt(len(record) / max(fit.dof, 1))
    factor = scale if record.error is None else max(1.0, np.sqrt(fit.chi2 / max(fit.dof, 1)))
    covariance = _covariance(data, mode, width, max(factor, 1e-12))
    nothing_seen = not fit.rms_residual > 0 and record.error is None
    separable = fit.identifiability.separable
    return Target(
        law=LAW,
        data=data,
        names=NAMES,
        units=UNITS,
        lower=np.zeros(3),
        upper=np.full(3, np.inf),
        mode=mode,
        covariance=covariance,
        likelihood=Likelihood(
            (Group("", noise or ("inferred" if inferred else "known"), outliers),)
        ),
        noise=(max(factor, 1e-12),),
        noise_unit="mA" if record.error is None else "1",
        priors=priors,
        derived=Derived(LIFETIMES, ("h",) * 3),
        observed=_observed(record),
        # A prior on one of the two tells them apart, if anything does.
        priors_own=() if separable or {"a", "b"} & set(priors) else ("a", "b"),
        remark=_correlated(fit),
        open_directions=_nothing(fit) if nothing_seen else "",
        verdict=(fit.status.value, fit.message),
    )


def _correlated(fit: DecayFit) -> str:
    """The likelihood takes readings as independent; say so where they are not."""
    larger = fit.identifiability.error_inflation
    if larger <= 1:
        return ""
    return (
        "Neighbouring residuals are correlated, which this likelihood does not know: true "
        f"intervals are about {larger:.1f} times as wide, or more."
    )


def _nothing(fit: DecayFit) -> str:
    return f"the readings show neither decay nor noise; {fit.message}".rstrip(".")


def _start(
    fit: DecayFit, record: DecayRecord, priors: Mapping[str, Distribution]
) -> tuple[np.ndarray, np.ndarray]:
    """Where to begin, within the bounds, and how far each number can be from there at most."""
    values = np.array([fit.i0.value, fit.a.value, fit.b.value])
    mean = fit.mean_current
    rate = values[1] * mean + values[2]
    if not (np.isfinite(rate) and rate > 0):
        rate = 1.0 / max(record.span, 1.0)
    share = np.clip(np.nan_to_num(values[1] * mean / rate, nan=0.5), 0.0, 1.0)
    mode = np.array([values[0], share * rate / mean, (1.0 - share) * rate])
    width = np.array([np.inf, rate / mean, rate])
    for i, name in enumerate(NAMES):
        if name in priors:
            width[i] = min(width[i], float(priors[name].std()))
    return mode, width


def _covariance(data: Readings, mode: np.ndarray, width: np.ndarray, factor: float) -> np.ndarray:
    # The residuals are in stated errors, the widths are absolute: bring both to the true noise.
    return covariance_of(LAW, data, mode, width / factor) * factor**2


def _observed(record: DecayRecord) -> dict[str, np.ndarray]:
    found = {"time s": record.time, "current mA": record.current}
    return found if record.error is None else found | {"error mA": record.error}
