"""Convergence of a chain, its effective size, and the rules of its verdict."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from beamfit.answer import plain_name
from beamfit.errors import Finding, Status
from beamfit.sampling.likelihood import FRACTION, noise_words
from beamfit.sampling.target import SamplingTarget

# R-hat below which chains agree: Vehtari et al., Bayesian Analysis 16, 667 (2021).
AGREED = 1.01
# Autocorrelation times in a chain from which on their estimate is reliable (emcee's advice).
LONG = 50
# Posterior width, as a share of the prior's, above which the prior decides the answer: the data
# then weigh about half as much as the prior.
LITTLE = 0.8


class Diagnostics(NamedTuple):
    """Judgement of a chain, number by number.

    Attributes
    ----------
    autocorrelation : array, shape (n,)
        Integrated autocorrelation time, steps; never below 1.
    effective : array, shape (n,)
        Effective sample size: draws over that time.
    rhat : array, shape (n,)
        Split R-hat.
    steps, walkers : int
        Size of the chain judged.
    """

    autocorrelation: np.ndarray
    effective: np.ndarray
    rhat: np.ndarray
    steps: int
    walkers: int

    @property
    def settled(self) -> bool:
        """True if the walkers agree and the chain is many autocorrelation times long."""
        agreed = bool(np.max(self.rhat) < AGREED)
        return agreed and self.steps >= LONG * float(np.max(self.autocorrelation))


def split_rhat(chain: np.ndarray) -> np.ndarray:
    """Compare walkers with each other, and each one's first half with its second.

    Parameters
    ----------
    chain : array, shape (steps, walkers, n)
        At least four steps.

    Returns
    -------
    array, shape (n,)
        sqrt of the pooled variance over the variance within, 1 where all agree, infinite where a
        number never moved: A. Gelman et al., Bayesian Data Analysis, 3rd edition, equation 11.4.

    Examples
    --------
    >>> chain = np.random.default_rng(1).normal(size=(200, 8, 1))
    >>> bool(split_rhat(chain)[0] < 1.01), bool(split_rhat(chain + np.arange(8)[:, None])[0] > 2)
    (True, True)
    """
    half = len(chain) // 2
    parts = np.concatenate([chain[:half], chain[half : 2 * half]], axis=1)
    within = np.var(parts, axis=0, ddof=1).mean(axis=0)
    between = np.var(parts.mean(axis=0), axis=0, ddof=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.sqrt((half - 1) / half + between / within)
    return np.where(within > 0, ratio, np.inf)


def autocorrelation_times(chain: np.ndarray) -> np.ndarray:
    """Integrated autocorrelation time by emcee's estimator (A. Sokal's window), in steps.

    Parameters
    ----------
    chain : array, shape (steps, walkers, n)
        The chain.

    Returns
    -------
    array, shape (n,)
        At least 1; infinite where a walker never moved.

    Examples
    --------
    >>> chain = np.random.default_rng(1).normal(size=(400, 16, 1))
    >>> bool(autocorrelation_times(chain)[0] < 1.1)
    True
    """
    from emcee.autocorr import integrated_time

    # Numbers as small as 1e-16 are as good as any other for the estimator if they are scaled.
    spread = np.std(chain, axis=(0, 1))
    moved = np.all(np.ptp(chain, axis=0) > 0, axis=0)
    times = np.full(chain.shape[2], np.inf)
    if moved.any():
        scaled = (chain - chain.mean(axis=(0, 1)))[..., moved] / spread[moved]
        times[moved] = np.maximum(integrated_time(scaled, tol=0, quiet=True), 1.0)
    return times


def diagnose(chain: np.ndarray) -> Diagnostics:
    """Judge a chain.

    Parameters
    ----------
    chain : array, shape (steps, walkers, n)
        Without its warm-up.

    Returns
    -------
    Diagnostics
        Of a chain too short for any judgement: no effective samples, infinite R-hat.
    """
    steps, walkers, n = chain.shape
    if steps < 4:
        nothing = np.full(n, np.inf)
        return Diagnostics(nothing, np.zeros(n), nothing, steps, walkers)
    times = autocorrelation_times(chain)
    return Diagnostics(times, steps * walkers / times, split_rhat(chain), steps, walkers)


class ChainEvidence(NamedTuple):
    """Input of the rules: the chain's diagnostics, the target, and the requested draws.

    `held` names the numbers asked for that the prior or the bounds decide.
    """

    diagnostics: Diagnostics
    target: SamplingTarget
    target_ess: float
    budget: int
    held: tuple[str, ...]


def held_by_priors(target: SamplingTarget, draws: np.ndarray) -> tuple[str, ...]:
    """Name the numbers whose posterior is about as wide as what held them beforehand.

    Parameters
    ----------
    target : SamplingTarget
        The problem.
    draws : array, shape (m, n)
        Its draws.

    Returns
    -------
    tuple of str
        Numbers spread by 0.8 or more of their prior, or of a flat one between their bounds.
    """
    before = (target.upper - target.lower) / np.sqrt(12.0)
    for name, prior in target.priors.items():
        i = target.names.index(name)
        before[i] = min(float(prior.std()), before[i])
    wide = np.isfinite(before) & (np.std(draws, axis=0) > LITTLE * before)
    # The share of outliers is a by-product; its prior is the sampler's own.
    return tuple(
        name
        for name, held in zip(target.names, wide, strict=True)
        if held and not name.endswith(FRACTION)
    )


def _never_settled(e: ChainEvidence) -> Finding | None:
    if e.diagnostics.steps:
        return None
    said = f"The walkers did not settle within the budget of {e.budget} steps: raise it."
    return Finding(Status.not_converged, said)


def _walkers_disagree(e: ChainEvidence) -> Finding | None:
    if e.diagnostics.settled:
        return None
    allowed = 1 + 1 / np.maximum(e.diagnostics.effective, 1.0)
    worst = e.target.names[int(np.argmax(e.diagnostics.rhat / allowed))]
    cause = f"The budget of {e.budget} steps ended before the walkers agreed"
    said = f"{cause} (slowest: {plain_name(worst)}): raise it, and distrust the intervals."
    return Finding(Status.not_converged, said)


def _too_few_draws(e: ChainEvidence) -> Finding | None:
    if np.min(e.diagnostics.effective) >= e.target_ess:
        return None
    cause = f"The walkers agree, but the budget of {e.budget} steps ended before"
    said = f"{cause} {e.target_ess:.0f} effective draws: raise it for smoother intervals."
    return Finding(Status.not_converged, said)


def _priors_decide(e: ChainEvidence) -> Finding | None:
    if not e.held:
        return None
    named = ", ".join(plain_name(name) for name in e.held)
    cause = f"What is said of {named} is the prior's or the bounds', not the data's:"
    return Finding(
        Status.unidentified, f"{cause} measure more, or bring a prior of which you are sure."
    )


def _poor_model(e: ChainEvidence) -> Finding | None:
    forgiving = any(group.inferred or group.outliers for group in e.target.groups)
    if e.target.verdict.status is not Status.poor_fit or forgiving:
        return None
    cause = "The fit is poor, and with errors taken as known the intervals are too narrow:"
    return Finding(Status.poor_fit, f"{cause} mend the model, or infer the noise.")


def _agreed(e: ChainEvidence) -> Finding:
    return Finding(Status.converged, f"The walkers agree; errors {noise_words(e.target.groups)}.")


RULES = (_never_settled, _walkers_disagree, _too_few_draws, _priors_decide, _poor_model, _agreed)
