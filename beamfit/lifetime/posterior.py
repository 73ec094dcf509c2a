"""The posterior of a decay, by the draws of the fit: I0, a, b, exponent and drift of b."""

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

UNITS = {"i0": "mA", "a": "1/(mA s)", "b": "1/s", "exponent": "1", "drift": "1", "pace": "1"}
BOUNDS = {
    "i0": (0.0, np.inf),
    "a": (0.0, np.inf),
    "b": (0.0, np.inf),
    "exponent": (MIN_EXPONENT, MAX_EXPONENT),
}
SHOWN = ("i0", "a", "b", "exponent", "drift")
LIFETIMES = {"lifetime_start": "h", "lifetime_end": "h", "lifetime_mean": "h"}
STATED = {"exponent": f"normal about 0, {EXPONENT_SD_BELOW} below and {EXPONENT_SD_ABOVE} above",
          "drift": f"normal, 0 ± {DRIFT}, or that of gas that is pumped away"}  # fmt: skip
# Laws that a noise is beside: with a monitor that is off it is beside one of these alone.
ANY, FREE, SETTLED = range(3)
# Where all of the loss may be of one kind its interval ends, as the last of a thousand draws does.
UTMOST = 0.999
# Independent draws that intervals need at least.
ENOUGH = 200.0
# Draws are laid out as so many chains of so many steps; at most so many steps of proposals.
WALKERS, STEPS, BUDGET = 16, 1024, 16384


class DecayNumbers(NamedTuple):
    """Numbers of dI/dt = -a I² (I/mean)^exponent - b (1 + drift f(t)) I - (a mean + b) walk(t) I.

    Current at the first reading, mA, a, 1/(mA s), and b, 1/s; f is as of
    `beamfit.lifetime.free_law.gas_change`, whose pace is 0 where the drift is a straight line. The
    walk is at the nodes of `beamfit.lifetime.free_law`, zero where the loss rate does not wander.
    """

    i0: Array
    a: Array
    b: Array
    exponent: Array = 0.0
    drift: Array = 0.0
    pace: Array = 0.0
    walk: Array = 0.0


class _Data(NamedTuple):
    """Readings as of `ReducedDecay`, the matrix that takes nodes to the first reading, the middle
    and the last one, mean current, mA, and span, s; shifts of I0, a and b by what is stated of the
    monitor, shape (k, 3). Of each noise, beside which law it is: any; with a monitor that is off
    the free one, or constant a and b.
    """

    matrix: Array
    log_prior: Array
    beside: Array
    count: Array
    known: Array
    origin: Array
    gas: Array
    ends: Array
    middle: Array
    moments: Array
    mean: Array
    span: Array
    moved: Array


def _numbers(data: _Data, theta: Array) -> DecayNumbers:
    """Numbers that the monitor shows; theta ends with how far that is off, in stated errors."""
    more = data.moved.shape[0]
    own, shifts = theta[: theta.size - more], theta[theta.size - more :]
    last = len(UNITS)
    walk = own[last:] if own.size > last else jnp.zeros(NODES)
    law = jnp.append(own[3:last], jnp.zeros(last - own[:last].size))
    return DecayNumbers(*(own[:3] - shifts @ data.moved), *law, walk)


def _nodes(data: _Data, numbers: DecayNumbers) -> Array:
    quadratic, linear = numbers.a * data.mean * data.span, numbers.b * data.span
    lost = linear * (data.gas[:, None] + numbers.drift * gas_change_integral(numbers.pace))
    found = node_currents(numbers.i0 / data.mean, quadratic, numbers.exponent, lost)
    return found * jnp.exp(-(quadratic + linear) * (INTEGRAL @ numbers.walk))[:, None]


def _log_walk(walk: Array) -> Array:
    """Log density of a loss rate that wanders at the nodes, with the odds of there being any."""
    halves, chance = LOSS_WANDERS.shapes, LOSS_WANDERS.chance
    squares = jnp.sum((np.linalg.inv(halves) @ walk) ** 2, axis=1)
    volume = np.log(np.diagonal(halves, axis1=1, axis2=2)).sum(axis=1)
    log = jax.nn.logsumexp(np.log(chance / SMOOTH_PRIOR) - 0.5 * squares - volume)
    log = log - 0.5 * NODES * np.log(2 * np.pi)
    return jnp.where(jnp.any(walk != 0), log, 0.0)


def _log_density(data: _Data, theta: Array) -> Array:
    """Log posterior, the noise averaged over: flat in I0, loss rate and share of a."""
    numbers = _numbers(data, theta)
    away = jnp.append(-1.0, _nodes(data, numbers)[:, 0] - data.origin)
    squares = jnp.maximum(jnp.einsum("p,kpq,q->k", away, data.matrix, away), 1e-30)
    noises = data.log_prior - 0.5 * (data.count + data.known) * jnp.log(data.known + squares)
    constant = (numbers.exponent == 0) & (numbers.drift == 0) & jnp.any(data.beside == SETTLED)
    freed = (data.beside == FREE) & (numbers.pace == 0) & jnp.all(numbers.walk == 0)
    known = jnp.where(constant, data.beside == SETTLED, (data.beside == ANY) | freed)
    noises = jnp.where(known, noises, -jnp.inf)
    rate = numbers.a * data.mean + numbers.b
    share = numbers.a * data.mean / rate
    gas, pace = (1 - share) * numbers.drift, jnp.maximum(numbers.pace, 1.0)
    pumped = log_outgassing_prior(share, gas, pace) + jnp.log1p(-share)
    smooth = log_exponent_prior(numbers.exponent)[0] + log_drift_prior(numbers.drift)
    smooth = smooth + _log_walk(numbers.walk)
    law = jnp.where(numbers.pace > 0, pumped, jnp.where(constant, 0.0, smooth))
    shifts = theta[theta.size - data.moved.shape[0] :]
    inside = (numbers.a >= 0) & (numbers.b >= 0)
    log = jax.scipy.special.logsumexp(noises) + law - jnp.log(rate) - 0.5 * jnp.sum(shifts**2)
    return jnp.where(inside, log, -jnp.inf)


def _derived(data: _Data, theta: Array) -> Array:
    """Lifetimes at the first and last reading and at the mean current, h."""
    n = _built(data, theta)
    moments, whole = jnp.stack([0.0, data.middle, 1.0]), n.a * data.mean + n.b
    walked = whole * (data.moments @ n.walk)
    lost = whole * data.span * (data.moments @ (INTEGRAL @ n.walk))
    changed = n.b * n.drift * gas_change(moments, n.pace) + walked
    x = _nodes(data, n)[:, 0]
    rates = loss_rates(n.a * data.mean, n.b, n.exponent, changed, law_currents(x, lost), data)
    return 1.0 / HOUR / jnp.stack(rates)


def _no_residual(data: _Data, theta: Array) -> tuple[Array]:
    return (jnp.zeros(0),)


def _built(data: _Data, theta: Array) -> DecayNumbers:
    return DecayNumbers(*theta[:3], *_numbers(data, theta)[3:])


DENSITY = PosteriorLaw(_no_residual, _log_density, _derived, _built)


class _Prepared(NamedTuple):
    """A fit made ready: its laws, and shifts of I0, a and b by the monitor."""

    fit: Any
    seen: ReducedDecay
    laws: list[LawProposal]
    moved: np.ndarray

    @classmethod
    def of(cls, fit) -> _Prepared:
        """With the law of the fit, and where a and b are constant its noise."""
        about = fit.about
        seen = ReducedDecay.of(fit.readings, about.values)
        if fit.free_law is None and fit.correlation_time is None:
            white = np.array([kind == MemoryKind(WHITE) for kind in seen.products.kinds])
            seen = seen.of_noises(white) if white.any() else seen  # hopeless where nothing fits
        laws = [LawProposal.of(seen, CONSTANT)] if fit.free_law is None else proposals(seen)
        moved = [about.value_shifts(change)[:3] for change in about.pieces.monitor_changes]
        return cls(fit, seen, laws, np.reshape(moved, (-1, 3)))

    @property
    def names(self) -> tuple[str, ...]:
        """Numbers that are drawn."""
        law = max(max(one.free) for one in self.laws) + 1
        walk = NODES * any(one.disturbance is LOSS_WANDERS for one in self.laws)
        hidden = [("walk", walk), ("monitor", len(self.moved))]
        return *list(UNITS)[:law], *(f"{n}_{k + 1}" for n, count in hidden for k in range(count))

    def draws(self, number: int, seed: int = 0) -> Draws:
        """Draw so many numbers from each law."""
        return mixture([law.weighted_draws(number, seed) for law in self.laws])

    def thetas(self, draws: Draws, rng: np.random.Generator) -> np.ndarray:
        """Draws as numbers of the target."""
        found, span, mean = draws.numbers, self.fit.readings.span, self.fit.readings.mean_current
        a, b = found.share * found.rate / mean / span, (1 - found.share) * found.rate / span
        law = [found.level * mean, a, b, found.power, found.drift, found.pace]
        own = np.column_stack([*law, draws.walk.T])
        shifts = rng.normal(size=(len(own), len(self.moved)))
        own[:, :3] += shifts @ self.moved
        return np.hstack([own[:, : len(self.names) - len(self.moved)], shifts])

    def target(self, priors: Mapping[str, Distribution]) -> SamplingTarget:
        """State the posterior."""
        fit, seen, draws = self.fit, self.seen, self.draws(STEPS * WALKERS)
        record, thetas = fit.readings, self.thetas(draws, np.random.default_rng(0))
        middle = mean_current_time(draws.currents, draws.weight)
        own = [(seen.products, ANY)]
        own += [
            (law.reduced.products, FREE if POWER in law.free else SETTLED)
            for law in self.laws
            if law.disturbance not in (None, LOSS_WANDERS)
        ]
        beside = np.concatenate([np.full(len(one.kinds), which) for one, which in own])
        matrix, log_prior = (
            np.concatenate([getattr(one, name) for one, _ in own])
            for name in ("matrix", "log_prior")
        )
        count = len(self.names)
        data = _Data(
            matrix, log_prior, beside, seen.products.count, seen.products.known,
            seen.origin[:, 0], seen.gas, np.array(seen.ends),
            middle, from_nodes(np.array([0.0, middle, 1.0])),
            record.mean_current, record.span, self.moved,
        )  # fmt: skip
        lower, upper = np.array([BOUNDS.get(name, (-np.inf, np.inf)) for name in self.names]).T
        told = fit.identifiability.separable or {"a", "b"} & set(priors)
        held = () if told else ("a", "b")
        held = held if fit.lifetime_mean.error is not None else (*self.names, *LIFETIMES)
        return SamplingTarget(
            DENSITY, data, self.names, tuple(UNITS.get(name, "1") for name in self.names),
            lower, upper, thetas[np.argmax(draws.weight)],
            np.cov(thetas.T, aweights=draws.weight).reshape(count, count),
            groups=(NoiseGroup("", "averaged"),), priors=checked(priors, self.names),
            derived=LIFETIMES, observed=_observed(fit), priors_own=held,
            verdict=Finding(fit.status, fit.message), reaching=_reaching(draws),
            hidden=tuple(name for name in self.names if name not in SHOWN),
            stated={name: STATED[name] for name in self.names if name in STATED},
        )  # fmt: skip


def _reaching(draws: Draws) -> dict[str, tuple[float, float]]:
    """Ends of the 95 % of a and b that reach to a bound, as the fit quotes them."""
    none, all_ = at_bounds(draws.numbers.share, draws.weight)
    found = {}
    for name, (low, high) in (("a", (none, all_)), ("b", (all_, none))):
        if low or high:
            least, most = interval_probabilities(low, high)
            found[name] = (0.0 if low else least, UTMOST if high else most)
    return found


def _observed(fit) -> dict[str, np.ndarray]:
    error = fit.readings.error
    found = {"decay measured": fit.readings.current}
    return found if error is None else found | {"decay error": error}


def sampled(
    fit,
    priors: Mapping[str, Distribution] | None = None,
    *,
    seed: int = 0,
    target_ess: float = 4000.0,
    store: str | PathLike[str] | None = None,
    provenance: Provenance = FROM_PYTHON,
    progress: bool = False,
) -> Posterior:
    """Draw from the posterior that a fit quotes.

    Parameters
    ----------
    fit : DecayFit
        The fit, with its readings.
    priors : mapping of str to distribution, optional
        In addition to the fit's own.
    seed, target_ess, store, provenance, progress
        As of `beamfit.sampling.ensemble.draw`; a decay takes a second, and shows no progress.

    Returns
    -------
    Posterior

    Raises
    ------
    InputError
        If the fit has a shape of a, or as `draw`.

    Notes
    -----
    The weighed draws of `beamfit.lifetime.free_law`, drawn again by their weight (importance
    resampling): no chain has to settle, and no step is left out.
    """
    if fit.shaped:
        expected = "a fit of eq. 44 with constant a and b; sample fit_decay(record) without shape"
        raise InputError("a fit with a shape of a(I), which is not sampled", expected)
    if not 0 <= seed < 2**32 or not target_ess > 0:
        expected = "a whole number from 0 to 4294967295, and draws above zero"
        raise InputError(f"seed {seed!r}, {target_ess} draws", expected)
    if not fit.rms_residual > 0 and fit.readings.error is None:
        said = f"the readings show neither decay nor noise; {fit.message}".rstrip(".")
        return _refused(said, seed)
    with np.errstate(all="ignore"):
        ready = _Prepared.of(fit)
        if not ready.draws(STEPS).effective_size > 0:
            return _refused(
                f"no a and b that are not negative fit; {fit.message}".rstrip("."), seed
            )
        target = ready.target(priors or {})
    with nullcontext() if store is None else alone(store), np.errstate(all="ignore"):
        if store is not None:
            disk.load(store, target, seed, WALKERS)
        posterior = _chains(ready, target, seed, target_ess)
        if store is not None and not disk.finished(store):
            random = np.random.RandomState(seed).get_state()
            chain = posterior.chain, posterior.log_prob
            state = Checkpoint(*chain, random, 1.0, 0, True, seed)
            disk.save(store, target, state, provenance, posterior.to_json())
    return posterior


def _refused(said: str, seed: int) -> Posterior:
    """A posterior that is not sampled, and why."""
    names = list(UNITS)[:3]
    ends, units = (np.zeros(3), np.full(3, np.inf)), tuple(UNITS[name] for name in names)
    given = DENSITY, np.zeros(0), tuple(names), units, *ends, np.zeros(3), np.eye(3)
    return draw(SamplingTarget(*given, open_directions=said), seed=seed)


def _chains(ready: _Prepared, target: SamplingTarget, seed: int, target_ess: float) -> Posterior:
    """Draws by weight, from more and more proposals until these are worth as many as are wanted."""
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
        worth = 1 / np.sum(weight**2)
        if worth >= target_ess or 2 * steps > BUDGET:
            break
        steps *= 2
    chain = thetas[rng.choice(weight.size, (STEPS, WALKERS), p=weight)]
    # Drawn one by one they are independent, and worth no more than what they were drawn from.
    worth, size = min(worth, STEPS * WALKERS), np.ones(chain.shape[2])
    found = Diagnostics(STEPS * WALKERS / worth * size, worth * size, size, STEPS, WALKERS)
    held = held_by_priors(target, chain.reshape(-1, chain.shape[2]))
    held = tuple(dict.fromkeys((*target.priors_own, *held)))
    shown = tuple(name for name in held if name not in target.hidden)
    enough = min(target_ess, ENOUGH)
    verdict = judge(ChainEvidence(found, target, enough, steps, shown), (_worth_little, *RULES))
    said = f"{min(found.effective):.0f} effective draws."
    log = target.log_probability(chain.reshape(-1, chain.shape[2])).reshape(chain.shape[:2])
    return Posterior(target, chain, log, verdict.status, f"{verdict.message} {said}", found,
                     worth / weight.size, 0, seed, held)  # fmt: skip


def _worth_little(e: ChainEvidence) -> Finding | None:
    if np.min(e.diagnostics.effective) >= e.target_ess:
        return None
    cause = f"The draws are worth less than the {e.target_ess:.0f} that intervals need:"
    remedy = "the posterior is far from normal, distrust the intervals."
    return Finding(Status.not_converged, cause, remedy)


def _expected(data: _Data, theta: Array) -> tuple[Array, Array]:
    """Currents at the nodes over the mean, and the loss to gas in the span, that readings show."""
    numbers = _numbers(data, theta)
    return _nodes(data, numbers)[:, 0], numbers.b * data.span


def expected_current(posterior: Posterior, fit) -> Expected:
    """Currents that the posterior of a decay expects at its readings, mA.

    Parameters
    ----------
    posterior : Posterior
        Of `DecayFit.sample`.
    fit : DecayFit
        The fit.
    """
    record, data = fit.readings, posterior.target.data
    at = from_nodes(record.time / record.span)
    nodes, lost = posterior.target.each(_expected, posterior.thinned())
    draws = record.mean_current * nodes @ at.T
    if record.gauge is not None:  # what of it no smooth curve follows
        draws *= np.exp(-np.outer(lost, record.gauge / record.span - at @ np.asarray(data.gas)))
    error = (
        fit.noise if record.error is None else record.error * max(1, (fit.chi2 / fit.dof) ** 0.5)
    )
    return posterior.expected(draws, np.broadcast_to(error, record.time.shape))
