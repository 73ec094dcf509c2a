"""Posterior samples of a decay, from the draws of its fit: I0, a, b, exponent and drift of b."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import nullcontext
from os import PathLike
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.errors import Finding, InputError, Status, judge
from beamfit.lifetime.free_law import (
    CONSTANT,
    DRIFT,
    EXPONENT_SD_ABOVE,
    EXPONENT_SD_BELOW,
    INTEGRAL,
    LOSS_WANDERS,
    MAX_EXPONENT,
    MIN_EXPONENT,
    NODES,
    POWER,
    SMOOTH_PRIOR,
    Draws,
    LawProposal,
    ReducedDecay,
    at_bounds,
    from_nodes,
    gas_change,
    gas_change_integral,
    interval_probabilities,
    law_currents,
    log_drift_prior,
    log_exponent_prior,
    log_outgassing_prior,
    loss_rates,
    mean_current_time,
    mixture,
    node_currents,
    proposals,
)
from beamfit.noise.memory import WHITE, MemoryKind
from beamfit.quantity import HOUR
from beamfit.sampling import store as disk
from beamfit.sampling.convergence import RULES, ChainEvidence, Diagnostics, held_by_priors
from beamfit.sampling.ensemble import draw
from beamfit.sampling.likelihood import NoiseGroup
from beamfit.sampling.posterior import Expected, Posterior
from beamfit.sampling.priors import Distribution, checked
from beamfit.sampling.store import FROM_PYTHON, Checkpoint, Provenance
from beamfit.sampling.target import PosteriorLaw, SamplingTarget
from beamfit.writing import alone

# Units and bounds of the sampled parameters, names of those that are shown, units of the derived
# lifetimes, and priors in words.
UNITS = {"i0": "mA", "a": "1/(mA s)", "b": "1/s", "exponent": "1", "drift": "1", "pace": "1"}
BOUNDS = {
    "i0": (0.0, np.inf),
    "a": (0.0, np.inf),
    "b": (0.0, np.inf),
    "exponent": (MIN_EXPONENT, MAX_EXPONENT),
}
SHOWN = ("i0", "a", "b", "exponent", "drift")
LIFETIMES = {"lifetime_start": "h", "lifetime_end": "h", "lifetime_mean": "h"}
PRIOR_WORDS = {
    "exponent": f"normal about 0, {EXPONENT_SD_BELOW} below and {EXPONENT_SD_ABOVE} above",
    "drift": f"normal, 0 ± {DRIFT}, or that of gas that is pumped away",
}
# Law to which a noise applies: any. A noise that includes a disturbed monitor applies only to the
# free law or only to constant a and b.
ANY_LAW, FREE_LAW, CONSTANT_LAW = range(3)
# Quantile at which the 95 % interval of a or b ends where all of the loss may be of that kind.
BOUND_QUANTILE = 0.999
# Smallest effective sample size for intervals.
MIN_EFFECTIVE = 200.0
# Shape of the chain, walkers and steps, and largest number of steps of proposals: chosen for speed.
WALKERS, STEPS, MAX_STEPS = 16, 1024, 16384


class DecayNumbers(NamedTuple):
    """Parameters of a decay.

    dI/dt = -a I² (I/mean)^exponent - b (1 + drift f(t)) I - (a mean + b) walk(t) I.

    Attributes
    ----------
    i0, a, b : float
        Current at the first reading, mA, and loss coefficients, 1/(mA s) and 1/s.
    exponent, drift, pace : float
        Exponent of a, and drift of b with its pace in `beamfit.lifetime.free_law.gas_change`; a
        pace of 0 is a straight line.
    walk : array
        Relative wander of the loss rate at the nodes of `beamfit.lifetime.free_law`, or 0.
    """

    i0: Array
    a: Array
    b: Array
    exponent: Array = 0.0
    drift: Array = 0.0
    pace: Array = 0.0
    walk: Array = 0.0


class _Data(NamedTuple):
    """Data of the log posterior.

    Attributes
    ----------
    matrix, log_prior : array, shapes (k, p, p), (k,)
        Gram matrix of the whitened residuals and node columns under each noise, and log prior of
        the noise, as in `ReducedDecay.products`.
    applies_to : array, shape (k,)
        Law to which each noise applies: `ANY_LAW`, `FREE_LAW` or
        `CONSTANT_LAW`.
    count, known, origin, gas, ends : array
        As in `ReducedDecay` and its products.
    middle : float
        Time of the mean current over the span.
    moments : array, shape (3, nodes)
        Interpolation from nodes to the first reading, `middle` and the last reading.
    mean, span : float
        Mean current, mA, and span, s.
    monitor_shifts : array, shape (m, 3)
        Shifts of I0, a and b by one standard deviation of each stated error of the monitor.
    """

    matrix: Array
    log_prior: Array
    applies_to: Array
    count: Array
    known: Array
    origin: Array
    gas: Array
    ends: Array
    middle: Array
    moments: Array
    mean: Array
    span: Array
    monitor_shifts: Array


def _read_parameters(data: _Data, theta: Array) -> DecayNumbers:
    """Parameters as the monitor reads them; theta ends with its errors in standard deviations."""
    errors = data.monitor_shifts.shape[0]
    parameters, shifts = theta[: theta.size - errors], theta[theta.size - errors :]
    last = len(UNITS)
    walk = parameters[last:] if parameters.size > last else jnp.zeros(NODES)
    law = jnp.append(parameters[3:last], jnp.zeros(last - parameters[:last].size))
    return DecayNumbers(*(parameters[:3] - shifts @ data.monitor_shifts), *law, walk)


def _nodes(data: _Data, numbers: DecayNumbers) -> Array:
    """Current at the nodes over the mean current, shape (nodes, 1)."""
    quadratic, linear = numbers.a * data.mean * data.span, numbers.b * data.span
    lost = linear * (data.gas[:, None] + numbers.drift * gas_change_integral(numbers.pace))
    found = node_currents(numbers.i0 / data.mean, quadratic, numbers.exponent, lost)
    return found * jnp.exp(-(quadratic + linear) * (INTEGRAL @ numbers.walk))[:, None]


def _log_walk(walk: Array) -> Array:
    """Log prior density of a wandering loss rate at the nodes, with its prior odds."""
    roots, probability = LOSS_WANDERS.shapes, LOSS_WANDERS.chance
    chi2 = jnp.sum((np.linalg.inv(roots) @ walk) ** 2, axis=1)
    volume = np.log(np.diagonal(roots, axis1=1, axis2=2)).sum(axis=1)
    log = jax.nn.logsumexp(np.log(probability / SMOOTH_PRIOR) - 0.5 * chi2 - volume)
    log = log - 0.5 * NODES * np.log(2 * np.pi)
    return jnp.where(jnp.any(walk != 0), log, 0.0)


def _log_density(data: _Data, theta: Array) -> Array:
    """Log posterior averaged over the noises, flat in I0, loss rate and share of a."""
    p = _read_parameters(data, theta)
    residual = jnp.append(-1.0, _nodes(data, p)[:, 0] - data.origin)
    chi2 = jnp.maximum(jnp.einsum("p,kpq,q->k", residual, data.matrix, residual), 1e-30)
    noises = data.log_prior - 0.5 * (data.count + data.known) * jnp.log(data.known + chi2)
    any_law, free_law, constant_law = (
        data.applies_to == law for law in (ANY_LAW, FREE_LAW, CONSTANT_LAW)
    )
    constant = (p.exponent == 0) & (p.drift == 0) & jnp.any(constant_law)
    free_law &= (p.pace == 0) & jnp.all(p.walk == 0)
    applies = jnp.where(constant, constant_law, any_law | free_law)
    noises = jnp.where(applies, noises, -jnp.inf)
    rate = p.a * data.mean + p.b
    share = p.a * data.mean / rate
    gas_drift, pace = (1 - share) * p.drift, jnp.maximum(p.pace, 1.0)
    pumped = log_outgassing_prior(share, gas_drift, pace) + jnp.log1p(-share)
    smooth = log_exponent_prior(p.exponent)[0] + log_drift_prior(p.drift)
    smooth = smooth + _log_walk(p.walk)
    law = jnp.where(p.pace > 0, pumped, jnp.where(constant, 0.0, smooth))
    shifts = theta[theta.size - data.monitor_shifts.shape[0] :]
    inside = (p.a >= 0) & (p.b >= 0)
    log_density = jax.scipy.special.logsumexp(noises) + law
    log_density = log_density - jnp.log(rate) - 0.5 * jnp.sum(shifts**2)
    return jnp.where(inside, log_density, -jnp.inf)


def _derived(data: _Data, theta: Array) -> Array:
    """Lifetimes at the first and last reading and at the mean current, h."""
    n = _parameters(data, theta)
    moments, total = jnp.stack([0.0, data.middle, 1.0]), n.a * data.mean + n.b
    wander = total * (data.moments @ n.walk)
    wander_loss = total * data.span * (data.moments @ (INTEGRAL @ n.walk))
    changed = n.b * n.drift * gas_change(moments, n.pace) + wander
    currents = _nodes(data, n)[:, 0]
    x = law_currents(currents, wander_loss)
    rates = loss_rates(n.a * data.mean, n.b, n.exponent, changed, x, data.ends)
    return 1.0 / HOUR / jnp.stack(rates)


def _no_residual(data: _Data, theta: Array) -> tuple[Array]:
    return (jnp.zeros(0),)


def _parameters(data: _Data, theta: Array) -> DecayNumbers:
    return DecayNumbers(*theta[:3], *_read_parameters(data, theta)[3:])


DENSITY = PosteriorLaw(_no_residual, _log_density, _derived, _parameters)


class _Prepared(NamedTuple):
    """Fit prepared for sampling: its laws, and shifts of I0, a and b by errors of the monitor."""

    fit: Any
    seen: ReducedDecay
    laws: list[LawProposal]
    monitor_shifts: np.ndarray

    @classmethod
    def of(cls, fit) -> _Prepared:
        """Prepare a fit with its law and, if a and b are constant, its noise."""
        expansion = fit.expansion
        seen = ReducedDecay.of(fit.readings, expansion.values)
        if fit.free_law is None and fit.correlation_time is None:
            white = np.array([kind == MemoryKind(WHITE) for kind in seen.products.kinds])
            # There is no white noise where nothing fits.
            seen = seen.of_noises(white) if white.any() else seen
        laws = [LawProposal.of(seen, CONSTANT)] if fit.free_law is None else proposals(seen)
        moved = [expansion.value_shifts(change)[:3] for change in expansion.pieces.monitor_changes]
        return cls(fit, seen, laws, np.reshape(moved, (-1, 3)))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the sampled parameters."""
        law = max(max(one.free) for one in self.laws) + 1
        walk = NODES * any(one.disturbance is LOSS_WANDERS for one in self.laws)
        hidden = [("walk", walk), ("monitor", len(self.monitor_shifts))]
        return *list(UNITS)[:law], *(f"{n}_{k + 1}" for n, count in hidden for k in range(count))

    def draws(self, number: int, seed: int = 0) -> Draws:
        """Draw `number` samples from each law."""
        return mixture([law.weighted_draws(number, seed) for law in self.laws])

    def thetas(self, draws: Draws, rng: np.random.Generator) -> np.ndarray:
        """Draws as parameter vectors of the target."""
        found, span, mean = draws.numbers, self.fit.readings.span, self.fit.readings.mean_current
        a, b = found.share * found.rate / mean / span, (1 - found.share) * found.rate / span
        law = [found.level * mean, a, b, found.power, found.drift, found.pace]
        parameters = np.column_stack([*law, draws.walk.T])
        shifts = rng.normal(size=(len(parameters), len(self.monitor_shifts)))
        parameters[:, :3] += shifts @ self.monitor_shifts
        return np.hstack([parameters[:, : len(self.names) - len(self.monitor_shifts)], shifts])

    def target(self, priors: Mapping[str, Distribution]) -> SamplingTarget:
        """Target of the sampler: the posterior with its data, bounds and priors."""
        fit, seen, draws = self.fit, self.seen, self.draws(STEPS * WALKERS)
        record, thetas = fit.readings, self.thetas(draws, np.random.default_rng(0))
        middle = mean_current_time(draws.currents, draws.weight)
        noises = [(seen.products, ANY_LAW)]
        noises += [
            (law.reduced.products, FREE_LAW if POWER in law.free else CONSTANT_LAW)
            for law in self.laws
            if law.disturbance not in (None, LOSS_WANDERS)
        ]
        applies_to = np.concatenate([np.full(len(one.kinds), which) for one, which in noises])
        matrix, log_prior = (
            np.concatenate([getattr(one, name) for one, _ in noises])
            for name in ("matrix", "log_prior")
        )
        count = len(self.names)
        data = _Data(
            matrix, log_prior, applies_to, seen.products.count, seen.products.known,
            seen.origin[:, 0], seen.gas, np.array(seen.ends),
            middle, from_nodes(np.array([0.0, middle, 1.0])),
            record.mean_current, record.span, self.monitor_shifts,
        )  # fmt: skip
        lower, upper = np.array([BOUNDS.get(name, (-np.inf, np.inf)) for name in self.names]).T
        separable = fit.identifiability.separable or {"a", "b"} & set(priors)
        held = () if separable else ("a", "b")
        held = held if fit.lifetime_mean.error is not None else (*self.names, *LIFETIMES)
        return SamplingTarget(
            DENSITY, data, self.names, tuple(UNITS.get(name, "1") for name in self.names),
            lower, upper, thetas[np.argmax(draws.weight)],
            np.cov(thetas.T, aweights=draws.weight).reshape(count, count),
            groups=(NoiseGroup("", "averaged"),), priors=checked(priors, self.names),
            derived=LIFETIMES, observed=_observed(fit), priors_own=held,
            verdict=Finding(fit.status, fit.message), reaching=_interval_ends(draws),
            hidden=tuple(name for name in self.names if name not in SHOWN),
            stated={name: PRIOR_WORDS[name] for name in self.names if name in PRIOR_WORDS},
        )  # fmt: skip


def _interval_ends(draws: Draws) -> dict[str, tuple[float, float]]:
    """Quantiles at which the 95 % intervals of a and b end if they reach a bound, as in the fit."""
    at_zero, at_one = at_bounds(draws.numbers.share, draws.weight)
    found = {}
    for name, (low, high) in (("a", (at_zero, at_one)), ("b", (at_one, at_zero))):
        if low or high:
            low_end, high_end = interval_probabilities(low, high)
            found[name] = (0.0 if low else low_end, BOUND_QUANTILE if high else high_end)
    return found


def _observed(fit) -> dict[str, np.ndarray]:
    error = fit.readings.error
    found = {"decay measured": fit.readings.current}
    return found if error is None else found | {"decay error": error}


def sample_decay(
    fit,
    priors: Mapping[str, Distribution] | None = None,
    *,
    seed: int = 0,
    target_ess: float = 4000.0,
    store: str | PathLike[str] | None = None,
    provenance: Provenance = FROM_PYTHON,
    progress: bool = False,
) -> Posterior:
    """Draw samples from the posterior of a fit.

    Parameters
    ----------
    fit : DecayFit
        Fit with its readings.
    priors : mapping of str to distribution, optional
        Priors in addition to those of the fit.
    seed, target_ess, store, provenance, progress
        As for `beamfit.sampling.ensemble.draw`; a decay takes a second, and shows no progress.

    Returns
    -------
    Posterior

    Raises
    ------
    InputError
        If the fit has a shape of a, and as for `draw`.

    Notes
    -----
    The weighted draws of `beamfit.lifetime.free_law` are resampled by their weight (importance
    resampling): no chain has to converge, and there is no burn-in.
    """
    if fit.shaped:
        expected = "a fit of eq. 44 with constant a and b; sample fit_decay(record) without shape"
        raise InputError("a fit with a shape of a(I), which is not sampled", expected)
    if not 0 <= seed < 2**32 or not target_ess > 0:
        expected = "a whole number from 0 to 4294967295, and draws above zero"
        raise InputError(f"seed {seed!r}, {target_ess} draws", expected)
    if not fit.rms_residual > 0 and fit.readings.error is None:
        reason = f"the readings show neither decay nor noise; {fit.message}".rstrip(".")
        return _not_sampled(reason, seed)
    with np.errstate(all="ignore"):
        ready = _Prepared.of(fit)
        if not ready.draws(STEPS).effective_size > 0:
            return _not_sampled(
                f"no a and b that are not negative fit; {fit.message}".rstrip("."), seed
            )
        target = ready.target(priors or {})
    with nullcontext() if store is None else alone(store), np.errstate(all="ignore"):
        if store is not None:
            disk.load(store, target, seed, WALKERS)
        posterior = _resample(ready, target, seed, target_ess)
        if store is not None and not disk.finished(store):
            random = np.random.RandomState(seed).get_state()
            chain = posterior.chain, posterior.log_prob
            state = Checkpoint(*chain, random, 1.0, 0, True, seed)
            disk.save(store, target, state, provenance, posterior.to_json())
    return posterior


def _not_sampled(reason: str, seed: int) -> Posterior:
    """Posterior that is not sampled, with the reason."""
    names = list(UNITS)[:3]
    ends, units = (np.zeros(3), np.full(3, np.inf)), tuple(UNITS[name] for name in names)
    given = DENSITY, np.zeros(0), tuple(names), units, *ends, np.zeros(3), np.eye(3)
    return draw(SamplingTarget(*given, open_directions=reason), seed=seed)


def _resample(ready: _Prepared, target: SamplingTarget, seed: int, target_ess: float) -> Posterior:
    """Resample proposals by weight, with more proposals until the effective sample size is met."""
    steps = STEPS
    while True:
        rng = np.random.default_rng(seed)
        draws = ready.draws(steps * WALKERS, seed)
        thetas, weight = ready.thetas(draws, rng), draws.weight
        weight = weight * ((thetas >= target.lower) & (thetas <= target.upper)).all(axis=1)
        for name, prior in target.priors.items():
            weight = weight * np.exp(prior.logpdf(thetas[:, target.names.index(name)]))
        if not weight.sum() > 0:
            raise InputError("priors that leave no draw", "priors nearer to what the record shows")
        weight = weight / weight.sum()
        effective = 1 / np.sum(weight**2)
        if effective >= target_ess or 2 * steps > MAX_STEPS:
            break
        steps *= 2
    chain = thetas[rng.choice(weight.size, (STEPS, WALKERS), p=weight)]
    # Resampled draws are independent; their effective sample size is limited by the proposals.
    effective, size = min(effective, STEPS * WALKERS), np.ones(chain.shape[2])
    autocorrelation = STEPS * WALKERS / effective * size
    diagnostics = Diagnostics(autocorrelation, effective * size, size, STEPS, WALKERS)
    held = held_by_priors(target, chain.reshape(-1, chain.shape[2]))
    held = tuple(dict.fromkeys((*target.priors_own, *held)))
    shown = tuple(name for name in held if name not in target.hidden)
    enough = min(target_ess, MIN_EFFECTIVE)
    evidence = ChainEvidence(diagnostics, target, enough, steps, shown)
    verdict = judge(evidence, (_few_effective, *RULES))
    count = f"{min(diagnostics.effective):.0f} effective draws."
    log = target.log_probability(chain.reshape(-1, chain.shape[2])).reshape(chain.shape[:2])
    return Posterior(target, chain, log, verdict.status, f"{verdict.message} {count}", diagnostics,
                     effective / weight.size, 0, seed, held)  # fmt: skip


def _few_effective(e: ChainEvidence) -> Finding | None:
    if np.min(e.diagnostics.effective) >= e.target_ess:
        return None
    cause = f"The draws are worth less than the {e.target_ess:.0f} that intervals need:"
    remedy = "the posterior is far from normal, distrust the intervals."
    return Finding(Status.not_converged, cause, remedy)


def _expected(data: _Data, theta: Array) -> tuple[Array, Array]:
    """Currents at the nodes over the mean, and gas loss over the span, as the monitor reads."""
    numbers = _read_parameters(data, theta)
    return _nodes(data, numbers)[:, 0], numbers.b * data.span


def expected_current(posterior: Posterior, fit) -> Expected:
    """Expected currents at the readings of a decay, mA, over its posterior.

    Parameters
    ----------
    posterior : Posterior
        From `DecayFit.sample`.
    fit : DecayFit
        The fit.
    """
    record, data = fit.readings, posterior.target.data
    at = from_nodes(record.time / record.span)
    nodes, lost = posterior.target.each(_expected, posterior.thinned())
    draws = record.mean_current * nodes @ at.T
    if record.gauge is not None:  # the part that interpolation between nodes misses
        draws *= np.exp(-np.outer(lost, record.gauge / record.span - at @ np.asarray(data.gas)))
    error = (
        fit.noise if record.error is None else record.error * max(1, (fit.chi2 / fit.dof) ** 0.5)
    )
    return posterior.expected(draws, np.broadcast_to(error, record.time.shape))
