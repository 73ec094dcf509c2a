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
from beamfit.noise.sizes import NoiseKind, Scales, averaged

# With fewer planes nothing is learned of a prior.
FEWEST = 5
# Standard deviations of what is learned about beamfit's own priors: of the ln of a middle, of the
# ln of a spread, of the logit of a probability. A few scans move them little.
MIDDLE, SPREAD, LOGIT = 1.5, 0.5, 2.0
# The step of the second differences that the errors are taken from.
STEP = 0.05
PRIORS = {
    "shots": ("scatter", "even"),
    "stated": ("factor", "right"),
    "none": ("unstated", "share"),
}


class Sample(NamedTuple):
    """Evidence of one plane for the scale of its noise.

    Attributes
    ----------
    noise : str
        "shots", "stated" or "none": which prior it tells of.
    kinds_under : callable
        From priors to kinds of noise.
    kinds : tuple of NoiseKind
        Those under the priors that it was looked at with.
    scales : tuple of Scales
        Their nodes.
    log_evidence : tuple of ndarray
        Log evidence of the beam at every node, shape (k,).
    """

    noise: str
    kinds_under: Callable[[Noise], tuple[NoiseKind, ...]]
    kinds: tuple[NoiseKind, ...]
    scales: tuple[Scales, ...]
    log_evidence: tuple[np.ndarray, ...]


class Learned(NamedTuple):
    """Priors that were learned, their errors in words by name, and of how many planes."""

    noise: Noise
    errors: dict[str, str]
    planes: dict[str, int]


def learn_noise(samples: Sequence[Sample], noise: Noise, source: str) -> Learned:
    """Learn the priors of the noise from many planes whose sizes are a beam's.

    Parameters
    ----------
    samples : sequence of Sample
        One a plane.
    noise : Noise
        The priors they were looked at with.
    source : str
        Where the scans are from.

    Returns
    -------
    Learned
        Priors of which at least five planes tell something; others are as they were.

    Raises
    ------
    InputError
        If no prior has five planes.

    Notes
    -----
    Empirical Bayes: the evidence of all planes, each averaged over its own noise by the prior, is
    made as large as possible in the numbers of that prior (A. Gelman et al., Bayesian Data
    Analysis, 3rd ed. (2013), sect. 5.3); errors are from its second differences. The present prior
    is divided out at the nodes.
    """
    found, errors, planes = noise, {}, {}
    for kind, (scale, chance) in PRIORS.items():
        own = [s for s in samples if s.noise == kind]
        planes[kind] = len(own)
        if len(own) < FEWEST:
            continue
        values, spread = _learned(own, noise, scale, chance)
        middle, width, probability = _numbers(values)
        found = replace(found, **{scale: Lognormal(middle, width), chance: probability})
        errors[scale] = (
            f"± [{middle * spread[0]:.2g}, {width * spread[1]:.2g}], from {len(own)} planes"
        )
        errors[chance] = f"± {probability * (1 - probability) * spread[2]:.2g}"
    if not errors:
        counts = ", ".join(f"{n} of {kind}" for kind, n in planes.items())
        raise InputError(f"{counts} planes whose sizes are surely a beam's", f"{FEWEST} of a kind")
    return Learned(replace(found, source=source), errors, planes)


def _numbers(values: np.ndarray) -> tuple[float, float, float]:
    """Middle, spread and probability from ln, ln and logit."""
    return math.exp(values[0]), math.exp(values[1]), 1.0 / (1.0 + math.exp(-values[2]))


def _learned(
    samples: Sequence[Sample], noise: Noise, scale: str, chance: str
) -> tuple[np.ndarray, np.ndarray]:
    (middle, spread), odds = getattr(noise, scale), getattr(noise, chance)
    start = np.array([math.log(middle), math.log(spread), math.log(odds / (1.0 - odds))])
    width = np.array([MIDDLE, SPREAD, LOGIT])

    def cost(values: np.ndarray) -> float:
        middle, spread, probability = _numbers(values)
        new = replace(noise, **{scale: Lognormal(middle, spread), chance: probability})
        each = [_log_evidence(s, new) for s in samples]
        return 0.5 * float(np.sum(((values - start) / width) ** 2)) - float(np.sum(each))

    best = minimize(cost, start, method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-4}).x
    return best, np.sqrt(np.diag(np.linalg.inv(_second_differences(cost, best))))


def _second_differences(cost: Callable[[np.ndarray], float], at: np.ndarray) -> np.ndarray:
    steps = STEP * np.eye(len(at))

    def across(a: np.ndarray, b: np.ndarray) -> float:
        four = cost(at + a + b) - cost(at + a - b) - cost(at - a + b) + cost(at - a - b)
        return four / (4.0 * STEP**2)

    return np.array([[across(a, b) for b in steps] for a in steps])


def _log_masses(prior: Lognormal, log: np.ndarray) -> np.ndarray:
    """Log probabilities of the cells of nodes: a density may be narrower than their distance."""
    ends = np.concatenate([log[:1], 0.5 * (log[1:] + log[:-1]), log[-1:]])
    z = (ends - math.log(prior.middle)) / prior.spread
    # In the lower of the two tails, whose small numbers are exact.
    low, high = np.where(z[:-1] > 0, -z[1:], z[:-1]), np.where(z[:-1] > 0, -z[:-1], z[1:])
    with np.errstate(divide="ignore"):
        return log_ndtr(high) + np.log(-np.expm1(log_ndtr(low) - log_ndtr(high)))


def _log_evidence(s: Sample, noise: Noise) -> float:
    """Log evidence of a plane under other priors than those of its nodes."""
    parts = []
    kinds = s.kinds_under(noise)
    for old, new, scales, evidence in zip(s.kinds, kinds, s.scales, s.log_evidence, strict=True):
        skip = int(old.special is not None)
        log = np.log(scales.scale[skip:])
        ratio = _log_masses(new.prior, log) - _log_masses(old.prior, log)
        ratio += new.log_range - old.log_range
        if skip:
            ratio = np.append(np.log(new.chance) - np.log(old.chance), ratio)
        parts.append(averaged(evidence + scales.log_weight + ratio + new.log_weight, 0.0))
    return float(np.logaddexp.reduce(parts))
