"""The posterior of a decay: I0, a and b, none of them negative."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.errors import InputError
from beamfit.greybox import tree
from beamfit.greybox.memory import range_of
from beamfit.greybox.posterior import Optimum, Sampled, Statement, target_of
from beamfit.greybox.problem import Free, Prior, Problem, Record
from beamfit.lifetime.decay_law import Moments, beam_current, current
from beamfit.lifetime.expansion import Pieces, solved
from beamfit.lifetime.record import DecayRecord
from beamfit.noise.correlated import (
    CorrelatedNoise,
    innovations,
    log_volume,
    whitened,
    whitened_of_both,
)
from beamfit.quantity import HOUR
from beamfit.sampling.posterior import Expected, Posterior
from beamfit.sampling.priors import Distribution
from beamfit.sampling.target import SamplingTarget
from beamfit.verdict import Finding

RECORD = "decay"
UNITS = {"i0": "mA", "a": "1/(mA s)", "b": "1/s"}
SAMPLED = UNITS | {"log_memory": "1", "log_wander": "1", "drift": "mA/s", "offset": "mA"}
# A share of the noise below which it is rounding.
ROUNDING = 1e-9
# Variances that noise with a memory gets anew in a usual interval, over that of the white part,
# beyond which one of the two would not be seen.
LEAST_NEW, MOST_NEW = 1e-4, 10.0
# The monitor is taken to be within so many of its stated errors.
WIDEST = 8.0
LIFETIMES = {"lifetime_start": "h", "lifetime_mean": "h", "lifetime_end": "h"}


class DecayNumbers(NamedTuple):
    """Current at the first reading, mA, and a, 1/(mA s), and b, 1/s, of dI/dt = -a I² - b I.

    `log_memory` is the logarithm of the correlation time of the readings' errors, s, and
    `log_wander` that of the variance that they get anew in a usual interval over that of their
    white part; `drift`, mA/s, and `offset`, mA, are the monitor's.
    """

    i0: Array
    a: Array
    b: Array
    log_memory: Array = 0.0
    log_wander: Array = 0.0
    drift: Array = 0.0
    offset: Array = 0.0


class Readings(NamedTuple):
    """Times, s, the mean current, mA, and the integral of the pressure as of `Moments`."""

    time: Array
    mean: Array
    gas: Array | None = None


def monitored_current(numbers: DecayNumbers, at: Readings) -> Array:
    """Current that a monitor with a drift and an offset reads, mA."""
    quadratic = numbers.a * at.mean
    law = jnp.stack([quadratic + numbers.b, quadratic, 0.0])
    beam = beam_current(numbers.i0 / at.mean, law, Moments(at.time, at.gas))
    return at.mean * beam + numbers.offset + numbers.drift * at.time


def apart(model: DecayNumbers, at: Readings) -> Array:
    """Time between neighbouring readings over the correlation time of their errors."""
    return jnp.diff(at.time) * jnp.exp(-model.log_memory)


def decay_problem(record: DecayRecord, memory: float | None = None) -> Problem:
    """State the fit of a decay: I0, a and b free, one record.

    Parameters
    ----------
    record : DecayRecord
        The readings.
    memory : float, optional
        Correlation time of the errors, s.

    Returns
    -------
    Problem
        Whose solution `fit_decay` finds faster.

    Examples
    --------
    >>> from beamfit.greybox.solve import solve
    >>> t = np.linspace(0, 36000, 50)
    >>> fit = solve(decay_problem(DecayRecord(t, 500 / (1 + 500 * 2e-8 * t))))
    >>> print(f"{fit['a'].value:.3e}")
    2.000e-08
    """
    found, mean = solved(Pieces.of(record)).values, float(record.current.mean())
    numbers = DecayNumbers(*map(float, found[:3]))
    at = Readings(record.time, mean, record.gauge)
    readings = Record(RECORD, monitored_current, at, record.current, record.error)
    if memory is not None:
        numbers = numbers._replace(log_memory=math.log(memory))
        readings = replace(readings, apart=apart)
    return Problem(numbers, [Free("i0"), Free("a"), Free("b")], [readings])


def _lifetimes(numbers: DecayNumbers, at: tuple[Array, Array]) -> Array:
    """Lifetime at the first reading, at the mean current and at the last reading, h."""
    mean, last, _ = at
    levels = jnp.stack([numbers.i0, mean, current(last, numbers.i0, numbers.a, numbers.b)])
    return 1.0 / (numbers.a * levels + numbers.b) / HOUR


def decay_target(
    fit,
    noise: str | None = None,
    outliers: bool = False,
    priors: Mapping[str, Distribution] | None = None,
) -> SamplingTarget:
    """State the posterior of a fitted decay.

    Parameters
    ----------
    fit : DecayFit
        The fit, with its readings.
    noise, outliers, priors
        As of `beamfit.greybox.posterior.target_of`; priors on i0, a, b.

    Returns
    -------
    SamplingTarget
        Lifetimes are its derived numbers.

    Raises
    ------
    InputError
        If the fit has no readings or another law than a constant a, or as `target_of`.

    Notes
    -----
    Errors that are correlated are so in the likelihood, and the correlation time is sampled too,
    flat in its logarithm as in `beamfit.greybox.memory.memory_of` but only up to the length of
    the record: in a longer memory i0 loses its hold, and a walk its way, for nothing of a and b.
    The white part beside, where there is one, is sampled by the variance that the rest gets anew
    over the white, flat in its logarithm: the record tells that whatever the correlation time.

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
    problem, monitor = _with_monitor(decay_problem(record, memory=fit.correlation_time), record)
    theta, rate = _start(fit, record)
    theta = np.append(theta, np.zeros(len(monitor)))
    scale = fit.noise if record.error is None else max(1.0, np.sqrt(fit.chi2 / fit.dof))
    if fit.correlation_time is not None:
        inferred = noise == "inferred" or (noise is None and (record.error is None or scale > 1))
        remembered = _noise_of(fit)
        problem = _with_memory(problem, fit, remembered, inferred)
        theta = np.append(theta, np.log(remembered.time))
        theta = np.append(theta, log_wander(remembered, record)) if remembered.white else theta
    stated = _statement(fit, problem, monitor, rate, priors or {})
    verdict, given = Finding(fit.status, fit.message), [record.error is not None]
    optimum = Optimum(theta, verdict, [max(scale, 1e-12)], given)
    return target_of(problem, optimum, stated, noise=noise, outliers=outliers, priors=priors)


def _statement(
    fit, problem: Problem, monitor: dict[str, float], rate: float, priors: Mapping[str, object]
) -> Statement:
    """Units, bounds, widths and derived numbers of the posterior."""
    record, memory = fit.readings, fit.correlation_time is not None
    nothing = f"the readings show neither decay nor noise; {fit.message}".rstrip(".")
    seen = fit.rms_residual > 0 or record.error is not None
    # A prior on one of the two tells them apart, if anything does.
    told = fit.identifiability.separable or {"a", "b"} & set(priors)
    widths = {"a": rate / fit.mean_current, "b": rate, "log_memory": 1.0, "log_wander": 1.0}
    return Statement(
        derived=LIFETIMES,
        derive=_lifetimes,
        data=(fit.mean_current, record.time[-1], problem.records[0].data),
        units=SAMPLED,
        lower=dict.fromkeys(UNITS, 0.0),
        width=widths | monitor,
        noise_unit="mA",
        priors_own=() if told else ("a", "b"),
        nothing="" if seen else nothing,
        **{"log_volume": _log_volume, "along": "log_memory"} if memory else {},
    )


def _with_monitor(problem: Problem, record: DecayRecord) -> tuple[Problem, dict[str, float]]:
    """The problem with what is stated of the monitor as numbers of a prior, and their sizes."""
    stated = {} if record.monitor is None else record.monitor._asdict()
    units = {"drift": HOUR, "offset": 1.0}
    size = {name: value / units[name] for name, value in stated.items() if value > 0}
    if not size:
        return problem, size
    free = [Free(name, -WIDEST * sd, WIDEST * sd, nuisance=True) for name, sd in size.items()]
    priors = [Prior(name, 0.0, sd) for name, sd in size.items()]
    return replace(problem, free=[*problem.free, *free], priors=priors), size


class Remembered(NamedTuple):
    """Data of whitened residuals: when, what was read, its error, the usual interval, the
    logarithm of what was new in it by the fitted noise, or NaN where the errors are known, and the
    fitted share without a memory, None where there is none.
    """

    at: Readings
    measured: Array
    error: Array
    usual: Array
    quoted: Array
    white: Array | None


def _noise_of(fit) -> CorrelatedNoise:
    """Correlation time of a fit's errors, and the share without, by how neighbours are alike."""
    usual = np.median(np.diff(fit.readings.time)) / fit.correlation_time
    white = 1.0 - fit.identifiability.residual_correlation * np.exp(usual)
    return CorrelatedNoise(fit.correlation_time, float(white) if white > ROUNDING else 0.0)


def _with_memory(problem: Problem, fit, noise: CorrelatedNoise, inferred: bool) -> Problem:
    """The problem with the correlation time free, and residuals of independent errors.

    An unknown noise is sampled by what is new in a usual interval, which a record tells well
    whatever the memory, and quoted as the whole noise at the fitted memory; beside a white part,
    where the record does not show how far the rest wanders, as the scatter of the residuals.
    """
    readings, record = problem.records[0], fit.readings
    error = np.ones(1) if record.error is None else record.error
    usual, white = np.median(np.diff(record.time)), noise.white or None
    fresh = noise.white - (1.0 - noise.white) * np.expm1(-2 * usual / noise.time)
    quoted = 0.5 * np.log(fresh) if inferred else np.nan
    if noise.white:
        over = fit.residuals / error
        new, _ = whitened_of_both(over, np.diff(record.time), noise)
        quoted += 0.5 * np.log((new @ new) / (over @ over))
    data = Remembered(readings.data, readings.measured, error, usual, quoted, white)
    own = Record(RECORD, _new, data, np.zeros(len(record)), None if record.error is None else 1.0)
    lower, upper = np.log([range_of(record.time)[0], record.span])
    free = [*problem.free, Free("log_memory", lower, upper)]
    if noise.white:
        free += [Free("log_wander", np.log(LEAST_NEW), np.log(MOST_NEW))]
    return replace(problem, free=free, records=[own])


def log_wander(noise: CorrelatedNoise, record: DecayRecord) -> float:
    """Logarithm of the variance that is new in a usual interval over that of the white part."""
    new = (1.0 - noise.white) * -np.expm1(-2 * np.median(np.diff(record.time)) / noise.time)
    return float(np.log(np.clip(new / noise.white, LEAST_NEW, MOST_NEW)))


def _parts(model: DecayNumbers, data: Remembered) -> tuple[Array, Array]:
    """Variances of the white part and of the rest, over what the rest gets anew."""
    white = 0.0 if data.white is None else jnp.exp(-model.log_wander)
    return white, -1.0 / jnp.expm1(-2 * data.usual * jnp.exp(-model.log_memory))


def _log_size(model: DecayNumbers, data: Remembered) -> Array:
    """Logarithm of what whitened residuals are multiplied by."""
    white, rest = _parts(model, data)
    known, new = jnp.isnan(data.quoted), 0.5 * jnp.log((white + 1.0) / (white + rest))
    return jnp.where(known, 0.0, new - jnp.where(known, new, data.quoted))


def _whitened(model: DecayNumbers, data: Remembered) -> tuple[Array, Array]:
    """Residuals as independent ones of the same size, and what that adds to the log density."""
    rows = (monitored_current(model, data.at) - data.measured) / data.error
    if data.white is None:
        between = apart(model, data.at)
        return whitened(rows, between), log_volume(between)
    white, rest = _parts(model, data)
    noise = CorrelatedNoise(jnp.exp(model.log_memory), white / (white + rest))
    white, sizes = innovations(rows, jnp.asarray(data.at.time), noise)
    return white, -sizes


def _new(model: DecayNumbers, data: Remembered) -> Array:
    return _whitened(model, data)[0] * jnp.exp(_log_size(model, data))


def _log_volume(model: DecayNumbers, data: tuple[Array, Array, Remembered]) -> Array:
    remembered = data[2]
    volume = _whitened(model, remembered)[1]
    return volume + remembered.measured.size * _log_size(model, remembered)


def _start(fit, record: DecayRecord) -> tuple[np.ndarray, float]:
    """Start values, a and b not negative, and the whole loss rate at the mean current, 1/s."""
    mean = fit.mean_current
    a, b = fit.if_constant("a").value, fit.if_constant("b").value
    rate = a * mean + b
    if not (np.isfinite(rate) and rate > 0):
        rate = 1.0 / max(record.span, 1.0)
    share = np.clip(np.nan_to_num(a * mean / rate, nan=0.5), 0.0, 1.0)
    return np.array([fit.i0.value, share * rate / mean, (1.0 - share) * rate]), rate


def _currents(data: Sampled, theta: Array) -> Array:
    """Readings that one draw predicts."""
    core = data.core
    at = core.records[0].data
    model = tree.replace(core.model, core.chosen, data.theta.at[data.moving].set(theta))
    return monitored_current(model, at.at if isinstance(at, Remembered) else at)


def expected_current(posterior: Posterior) -> Expected:
    """Currents that the posterior of a decay expects at its readings, mA.

    Parameters
    ----------
    posterior : Posterior
        Of `DecayFit.sample`.
    """
    target = posterior.target
    record = target.data.core.records[0]
    error = np.ones(1) if record.error is None else np.asarray(record.error)
    if isinstance(record.data, Remembered):
        error = np.asarray(record.data.error)
    draws = target.each(_currents, posterior.thinned())
    return posterior.expected(draws, np.broadcast_to(error, draws.shape[1:]))
