"""Whether a chain has settled and how much it is worth."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

__all__ = ["Diagnostics", "autocorrelation_times", "diagnose", "split_rhat"]

# Chains that agree; Vehtari et al., Bayesian Analysis 16, 667 (2021), advise 1.01.
AGREED = 1.01
# emcee's advice for an estimate of the autocorrelation time that can be believed.
LONG = 50


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
        """Whether the walkers agree and the chain is long against its own memory."""
        if self.steps == 0:
            return False
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
