"""The noise of a laboratory's sizes, learned from an archive of scans."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.special import log_ndtr

from beamfit.errors import InputError
from beamfit.noise.model import Lognormal, Noise
from beamfit.noise.sizes import NoiseKind, Scales, log_average

# Smallest number of planes from which a prior is learned.
MIN_PLANES = 5
# Standard deviations of the prior of learned numbers about beamfit's own: of ln of a middle, of ln
# of a spread, and of the logit of a probability. Chosen so that a few scans move them little.
MIDDLE_SPREAD, SPREAD_SPREAD, LOGIT_SPREAD = 1.5, 0.5, 2.0
# Step of the second differences that give the errors.
DIFFERENCE_STEP = 0.05
# Priors of the scale and its probability, by the kind of errors that a scan has.
PRIORS = {
    "shots": ("scatter", "even"),
    "stated": ("factor", "right"),
    "none": ("unstated", "share"),
}


class Sample(NamedTuple):
    """Evidence of one plane about the scale of its noise.

    Attributes
    ----------
    noise : str
        "shots", "stated" or "none": the kind of errors, which selects the prior.
    kinds_under : callable
        Kinds of noise under given priors.
    kinds : tuple of NoiseKind
        Kinds under the priors of the fit.
    scales : tuple of Scales
        Nodes of each kind.
    log_evidence : tuple of ndarray
        Log evidence of the beam at each node, shape (k,).
    """

    noise: str
    kinds_under: Callable[[Noise], tuple[NoiseKind, ...]]
    kinds: tuple[NoiseKind, ...]
    scales: tuple[Scales, ...]
    log_evidence: tuple[np.ndarray, ...]


class Learned(NamedTuple):
    """Learned priors, their errors in words by name, and the number of planes by kind of errors."""

    noise: Noise
    errors: dict[str, str]
    planes: dict[str, int]


def learn_noise(samples: Sequence[Sample], noise: Noise, source: str) -> Learned:
    """Learn the noise priors from many planes whose sizes are a beam's.

    Parameters
    ----------
    samples : sequence of Sample
        One per plane.
    noise : Noise
        Priors of the fits.
    source : str
        Origin of the scans.

    Returns
    -------
    Learned
        Priors with at least five planes; the others are unchanged.

    Raises
    ------
    InputError
        If no prior has five planes.

    Notes
    -----
    Empirical Bayes: the numbers of a prior maximise the product of the planes' evidences, each
    averaged over its own noise scale under that prior (A. Gelman et al., Bayesian Data Analysis,
    3rd ed. (2013), sect. 5.3). Errors are from second differences. At the nodes the evidence is
    reweighted by the ratio of the new prior to that of the fit.
    """
    found, errors, planes = noise, {}, {}
    for kind, (scale, chance) in PRIORS.items():
        own = [s for s in samples if s.noise == kind]
        planes[kind] = len(own)
        if len(own) < MIN_PLANES:
            continue
        values, spread = _fit_prior(own, noise, scale, chance)
        middle, width, probability = _prior_numbers(values)
        found = replace(found, **{scale: Lognormal(middle, width), chance: probability})
        errors[scale] = (
            f"± [{middle * spread[0]:.2g}, {width * spread[1]:.2g}], from {len(own)} planes"
        )
        errors[chance] = f"± {probability * (1 - probability) * spread[2]:.2g}"
    if not errors:
        counts = ", ".join(f"{n} of {kind}" for kind, n in planes.items())
        raise InputError(
            f"{counts} planes whose sizes are surely a beam's", f"{MIN_PLANES} of a kind"
        )
    return Learned(replace(found, source=source), errors, planes)


def _prior_numbers(values: np.ndarray) -> tuple[float, float, float]:
    """Convert ln middle, ln spread and logit to middle, spread and probability."""
    return math.exp(values[0]), math.exp(values[1]), 1.0 / (1.0 + math.exp(-values[2]))


def _fit_prior(
    samples: Sequence[Sample], noise: Noise, scale: str, chance: str
) -> tuple[np.ndarray, np.ndarray]:
    """Maximise the evidence of planes; return ln middle, ln spread, logit, and their errors."""
    (middle, spread), odds = getattr(noise, scale), getattr(noise, chance)
    start = np.array([math.log(middle), math.log(spread), math.log(odds / (1.0 - odds))])
    width = np.array([MIDDLE_SPREAD, SPREAD_SPREAD, LOGIT_SPREAD])

    def cost(values: np.ndarray) -> float:
        """Negative log posterior of the numbers of the prior."""
        middle, spread, probability = _prior_numbers(values)
        new = replace(noise, **{scale: Lognormal(middle, spread), chance: probability})
        each = [_log_evidence(s, new) for s in samples]
        return 0.5 * float(np.sum(((values - start) / width) ** 2)) - float(np.sum(each))

    best = minimize(cost, start, method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-4}).x
    return best, np.sqrt(np.diag(np.linalg.inv(_second_differences(cost, best))))


def _second_differences(cost: Callable[[np.ndarray], float], at: np.ndarray) -> np.ndarray:
    """Matrix of second derivatives by finite differences."""
    steps = DIFFERENCE_STEP * np.eye(len(at))

    def second_difference(a: np.ndarray, b: np.ndarray) -> float:
        difference = cost(at + a + b) - cost(at + a - b) - cost(at - a + b) + cost(at - a - b)
        return difference / (4.0 * DIFFERENCE_STEP**2)

    return np.array([[second_difference(a, b) for b in steps] for a in steps])


def _log_masses(prior: Lognormal, log: np.ndarray) -> np.ndarray:
    """Log probabilities of the cells around nodes; exact even for a prior narrower than a cell."""
    ends = np.concatenate([log[:1], 0.5 * (log[1:] + log[:-1]), log[-1:]])
    z = (ends - math.log(prior.middle)) / prior.spread
    # Each difference is taken in the lower tail, where small probabilities keep their precision.
    low, high = np.where(z[:-1] > 0, -z[1:], z[:-1]), np.where(z[:-1] > 0, -z[:-1], z[1:])
    with np.errstate(divide="ignore"):
        return log_ndtr(high) + np.log(-np.expm1(log_ndtr(low) - log_ndtr(high)))


def _log_evidence(s: Sample, noise: Noise) -> float:
    """Log evidence of a plane under other priors than those of its fit."""
    parts = []
    kinds = s.kinds_under(noise)
    for old, new, scales, evidence in zip(s.kinds, kinds, s.scales, s.log_evidence, strict=True):
        skip = int(old.special is not None)
        log = np.log(scales.scale[skip:])
        ratio = _log_masses(new.prior, log) - _log_masses(old.prior, log)
        ratio += new.log_continuous - old.log_continuous
        if skip:
            ratio = np.append(
                np.log(new.special_probability) - np.log(old.special_probability), ratio
            )
        parts.append(log_average(evidence + scales.log_weight + ratio + new.log_weight, 0.0))
    return float(np.logaddexp.reduce(parts))
