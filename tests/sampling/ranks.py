"""Simulation-based calibration: whether a sampler's posteriors are those of the stated problem.

S. Talts, M. Betancourt, D. Simpson, A. Vehtari and A. Gelman, arXiv:1804.06788 (2018): draw a truth
from the prior, simulate data, sample the posterior. Over many repetitions the rank of the truth
among the posterior's draws is uniform if and only if sampler, likelihood and prior agree.
"""

from __future__ import annotations

import numpy as np
from scipy.special import chdtrc

from beamfit.sampling.posterior import Posterior

__all__ = ["DRAWS", "rank", "uniformity"]

# Draws among which a truth is ranked: 100 possible ranks, that many bins divide evenly.
DRAWS = 99


def rank(posterior: Posterior, name: str, truth: float) -> int:
    """Rank of a truth among nearly independent draws, 0 to 99.

    Parameters
    ----------
    posterior : Posterior
        Of the data simulated from the truth.
    name : str
        A sampled or derived number.
    truth : float
        Its true value.

    Returns
    -------
    int
        How many of 99 draws, evenly spaced along the chain, lie below.
    """
    values = posterior.values(name)
    places = np.linspace(0, len(values) - 1, DRAWS).astype(int)
    return int(np.sum(values[places] < truth))


def uniformity(ranks: np.ndarray, bins: int = 10) -> float:
    """Probability of ranks at least as uneven as these if they are uniform.

    Parameters
    ----------
    ranks : array of int
        From `rank`.
    bins : int
        A divisor of 100.

    Returns
    -------
    float
        Of Pearson's chi-square test.

    Examples
    --------
    >>> round(uniformity(np.arange(100)), 3), uniformity(np.full(100, 3)) < 1e-9
    (1.0, True)
    """
    count = np.bincount(np.asarray(ranks) * bins // (DRAWS + 1), minlength=bins)
    expected = len(ranks) / bins
    return float(chdtrc(bins - 1, np.sum((count - expected) ** 2) / expected))
