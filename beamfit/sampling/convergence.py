"""Convergence of a chain, effective sample size, and the rules of the verdict."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from beamfit.answer import plain_name
from beamfit.errors import Finding, Status
from beamfit.sampling.likelihood import FRACTION, noise_words
from beamfit.sampling.target import SamplingTarget

# R-hat below which chains agree: Vehtari et al., Bayesian Analysis 16, 667 (2021).
MAX_RHAT = 1.01
# Length of a chain, in autocorrelation times, from which on their estimate is reliable (emcee's
# documentation).
MIN_TIMES = 50
# The prior determines a number if its posterior is wider than this share of the prior's width: the
# data then have about half the weight of the prior.
MAX_WIDTH_SHARE = 0.8


class Diagnostics(NamedTuple):
    """Diagnostics of a chain for each number.

    Attributes
    ----------
    autocorrelation : array, shape (n,)
        Integrated autocorrelation time in steps, at least 1.
    effective : array, shape (n,)
        Effective sample size: draws divided by the autocorrelation time.
    rhat : array, shape (n,)
        Split R-hat.
    steps, walkers : int
        Size of the chain.
    """

    autocorrelation: np.ndarray
    effective: np.ndarray
    rhat: np.ndarray
    steps: int
    walkers: int

    @property
    def settled(self) -> bool:
        """True if the walkers agree and the chain has enough autocorrelation times."""
        agreed = bool(np.max(self.rhat) < MAX_RHAT)
        return agreed and self.steps >= MIN_TIMES * float(np.max(self.autocorrelation))


def split_rhat(chain: np.ndarray) -> np.ndarray:
    """Compute split R-hat: compare walkers with each other, and each one's halves.

    Parameters
    ----------
    chain : array, shape (steps, walkers, n)
        At least four steps.

    Returns
    -------
    array, shape (n,)
        Square root of the pooled variance over the variance within; 1 if all agree, infinite if a
        number never moved (A. Gelman et al., Bayesian Data Analysis, 3rd edition, equation 11.4).

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
    """Compute integrated autocorrelation times in steps, with emcee's estimator (Sokal's window).

    Parameters
    ----------
    chain : array, shape (steps, walkers, n)
        The chain.

    Returns
    -------
    array, shape (n,)
        At least 1; infinite if a walker never moved.

    Examples
    --------
    >>> chain = np.random.default_rng(1).normal(size=(400, 16, 1))
    >>> bool(autocorrelation_times(chain)[0] < 1.1)
    True
    """
    from emcee.autocorr import integrated_time

    # Scaled, because the estimator fails for numbers as small as 1e-16.
    spread = np.std(chain, axis=(0, 1))
    moved = np.all(np.ptp(chain, axis=0) > 0, axis=0)
    times = np.full(chain.shape[2], np.inf)
    if moved.any():
        scaled = (chain - chain.mean(axis=(0, 1)))[..., moved] / spread[moved]
        times[moved] = np.maximum(integrated_time(scaled, tol=0, quiet=True), 1.0)
    return times


def diagnose(chain: np.ndarray) -> Diagnostics:
    """Compute the diagnostics of a chain.

    Parameters
    ----------
    chain : array, shape (steps, walkers, n)
        The chain without its warm-up.

    Returns
    -------
    Diagnostics
        For fewer than four steps, no effective draws and an infinite R-hat.
    """
    steps, walkers, n = chain.shape
    if steps < 4:
        infinite = np.full(n, np.inf)
        return Diagnostics(infinite, np.zeros(n), infinite, steps, walkers)
    times = autocorrelation_times(chain)
    return Diagnostics(times, steps * walkers / times, split_rhat(chain), steps, walkers)


class ChainEvidence(NamedTuple):
    """Input of the rules: diagnostics, target, requested effective draws and budget.

    `held` names the shown numbers that the prior or the bounds determine.
    """

    diagnostics: Diagnostics
    target: SamplingTarget
    target_ess: float
    budget: int
    held: tuple[str, ...]


def held_by_priors(target: SamplingTarget, draws: np.ndarray) -> tuple[str, ...]:
    """Name the numbers whose posterior is about as wide as their prior.

    Parameters
    ----------
    target : SamplingTarget
        The target.
    draws : array, shape (m, n)
        Draws of its numbers.

    Returns
    -------
    tuple of str
        Numbers with a standard deviation above 0.8 of their prior's, or of a flat prior's between
        their bounds.
    """
    prior_width = (target.upper - target.lower) / np.sqrt(12.0)
    for name, prior in target.priors.items():
        i = target.names.index(name)
        prior_width[i] = min(float(prior.std()), prior_width[i])
    wide = np.isfinite(prior_width) & (np.std(draws, axis=0) > MAX_WIDTH_SHARE * prior_width)
    # The fraction of outliers is a nuisance number with a prior of the sampler.
    return tuple(
        name
        for name, held in zip(target.names, wide, strict=True)
        if held and not name.endswith(FRACTION)
    )


def _not_warmed_up(e: ChainEvidence) -> Finding | None:
    if e.diagnostics.steps:
        return None
    message = f"The walkers did not settle within the budget of {e.budget} steps: raise it."
    return Finding(Status.not_converged, message)


def _walkers_disagree(e: ChainEvidence) -> Finding | None:
    if e.diagnostics.settled:
        return None
    allowed = 1 + 1 / np.maximum(e.diagnostics.effective, 1.0)
    worst = e.target.names[int(np.argmax(e.diagnostics.rhat / allowed))]
    cause = f"The budget of {e.budget} steps ended before the walkers agreed"
    message = f"{cause} (slowest: {plain_name(worst)}): raise it, and distrust the intervals."
    return Finding(Status.not_converged, message)


def _too_few_draws(e: ChainEvidence) -> Finding | None:
    if np.min(e.diagnostics.effective) >= e.target_ess:
        return None
    cause = f"The walkers agree, but the budget of {e.budget} steps ended before"
    message = f"{cause} {e.target_ess:.0f} effective draws: raise it for smoother intervals."
    return Finding(Status.not_converged, message)


def _not_separable(e: ChainEvidence) -> Finding | None:
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


def _converged(e: ChainEvidence) -> Finding:
    return Finding(Status.converged, f"The walkers agree; errors {noise_words(e.target.groups)}.")


RULES = (_not_warmed_up, _walkers_disagree, _too_few_draws, _not_separable, _poor_model, _converged)
