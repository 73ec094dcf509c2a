"""The noise of beam sizes: their likelihood under noise of uncertain kind and size, and shots.

One-plane functions of NumPy or JAX arrays; leading axes are planes and draws.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.special import expit

from beamfit.arrays import registered
from beamfit.noise.model import LN_2PI, UNTESTED, Lognormal, Noise
from beamfit.statistics import log_student

# Nodes over the scale of the noise, and how far below its peak the likelihood still counts.
NODES, DEEP = 12, 12.0
# Standard deviations of the prior that nodes begin with.
REACH = 4.5
# Densities that are multiplied before a logarithm is taken.
AT_ONCE = 8
# Slow noise: the share of its variance that is new at each row, and its correlation time as a part
# of the scan. What is faster averages out, and what is slower changes all sizes alike.
WHITE, MEMORY = 0.2, 0.25
# From so many points on none is looked for: time goes with their number cubed.
LONG = 100
# Degrees of freedom that the scatter of all settings counts beside a setting's own: the scatter
# of a setting differs from the others' by a third of itself at most (Gelman et al., sect. 2.6).
POOLED = 20.0
# Rounds in which shots are sorted and means taken anew.
ROUNDS = 20
# A shot that shows no beam may have any size up to this many times the largest median.
LARGEST = 2.0


@dataclass(frozen=True, eq=False)
class NoiseKind:
    """One kind of noise: a point's standard deviation is (floor² + (s unit)²)^½ model^power.

    Attributes
    ----------
    power : int
        1 where the noise is a share of the size, 0 where it is the same at every size.
    floor, unit : array
        Shape (..., n): what is there in any case, and what the scale s multiplies.
    prior : Lognormal
        Of s, of every plane.
    chance : array
        Probability of the special value of s, of every plane.
    log_weight : array
        Log prior probability of the kind, of every plane.
    special : float or None
        A value that s may have: 1 where stated errors are right.
    least : float
        s is no less than this: stated errors are right or too small, since an error that seems too
        large may hold what these points do not show.
    slow : bool
        Whether s goes on from row to row, as that of a beam or screen that drifts. A bad reading
        is none of these: it would be a step, and steps explain a curve that is no beam's.
    """

    power: int
    floor: Any
    unit: Any
    prior: Lognormal
    chance: Any
    log_weight: Any
    special: float | None = None
    least: float = 0.0
    slow: bool = False

    @property
    def log_range(self) -> Any:
        """Log probability that s is not the special value, over that of its prior above `least`."""
        return np.log1p(-self.chance) - self.prior.log_probability_above(self.least)

    def deviation(self, scale: Any) -> Any:
        """Standard deviation of every point over model^power, at one scale of each plane."""
        return np.hypot(self.floor, np.asarray(scale)[..., None] * self.unit)


# A tree of arrays for JAX: what all planes share is structure.
registered(NoiseKind, ("power", "special", "least", "slow"))


class Scales(NamedTuple):
    """Nodes over the scale of a noise, shape (..., k), with the logs of their prior weights."""

    scale: Any
    log_weight: Any


def of_one_share(error: np.ndarray, size: np.ndarray) -> bool:
    """Tell errors, shape (..., n), that are one share of the sizes, to a hundredth of it.

    Examples
    --------
    >>> of_one_share(np.array([1.0, 2.0]), np.array([50.0, 100.0]))
    True
    """
    share = error / size
    return bool(np.all(np.ptp(share, axis=-1) <= 0.01 * share.mean(-1)))


def kinds_of(
    noise: Noise,
    size: np.ndarray,
    error: np.ndarray | None,
    of_shots: bool = False,
    alike: bool | None = None,
) -> tuple[NoiseKind, ...]:
    """Kinds of noise that sizes may have.

    Parameters
    ----------
    noise : Noise
        The priors.
    size : ndarray
        Shape (..., n), measured.
    error : ndarray or None
        Shape (..., n), stated.
    of_shots : bool
        Whether errors are those of means of shots, beyond which settings scatter.
    alike : bool, optional
        Whether stated errors are one share of the size; by themselves if None.

    Returns
    -------
    tuple of NoiseKind
        Of sizes without errors a share and the same everywhere. Of stated errors that are too small
        by a factor, or by what settings scatter beyond them. The last one is the first, slow (where
        errors are stated with these), of fewer than `LONG` points.
    """
    zero, one, every = np.zeros_like(size), np.ones_like(size), np.ones(size.shape[:-1])
    swift, slow = math.log1p(-noise.slow) * every, math.log(noise.slow) * every

    def of_all(prior: Lognormal) -> Lognormal:
        return Lognormal(prior.middle * every, prior.spread * every)

    scatter = of_all(noise.scatter)
    if of_shots:
        kinds = (NoiseKind(0, error, size, scatter, noise.even * every, swift, special=0.0),)
    elif error is None:
        middle = np.median(size, axis=-1, keepdims=True) * one
        unstated = of_all(noise.unstated)
        share, same = math.log(noise.share) + swift, math.log1p(-noise.share) + swift
        kinds = (
            NoiseKind(1, zero, one, unstated, zero[..., 0], share),
            NoiseKind(0, zero, middle, unstated, zero[..., 0], same),
        )
    else:
        right, factor = noise.stated(np.median(error / size, axis=-1))
        slow = slow + np.log(right)
        if power := int(of_one_share(error, size) if alike is None else alike):
            error, size = error / size, one
        # A factor or a scatter: nobody knows which before the sizes are seen.
        wrong = 0.5 * (1.0 - right)
        by_factor, beyond = swift + np.log1p(-wrong), swift + np.log(wrong)
        kinds = (
            NoiseKind(power, zero, error, factor, right / (1.0 - wrong), by_factor, 1.0, 1.0),
            NoiseKind(power, error, size, scatter, zero[..., 0], beyond),
        )
    if size.shape[-1] >= LONG:
        return kinds
    first = replace(kinds[0], slow=True, log_weight=slow)
    # Errors that are stated too small, and go on from row to row, are a drift: a rival.
    sure = (1.0 - UNTESTED) * every
    return (*kinds, replace(first, chance=sure) if first.least else first)


def scales_between(kind: NoiseKind, low: np.ndarray, high: np.ndarray) -> Scales:
    """Nodes between two logs of the scale, shape (...,), and the special value before them."""
    if kind.least:
        low = np.maximum(low, math.log(kind.least))
        high = np.maximum(high, low + 0.01)
    step = (high - low) / (NODES - 1)
    log = low[..., None] + step[..., None] * np.arange(NODES)
    prior = Lognormal(*(np.asarray(v)[..., None] for v in kind.prior))
    weight = prior.log_density(log) + (kind.log_range + np.log(step))[..., None]
    # The trapezoidal rule.
    weight = weight - math.log(2.0) * np.isin(np.arange(NODES), (0, NODES - 1))
    if kind.special is None:
        return Scales(np.exp(log), weight)
    first = np.ones_like(log[..., :1])
    scale = np.concatenate([kind.special * first, np.exp(log)], axis=-1)
    chance = np.log(kind.chance)[..., None] * first
    return Scales(scale, np.concatenate([chance, weight], axis=-1))


def wide_scales(kind: NoiseKind, lead: tuple[int, ...]) -> Scales:
    """Nodes over all of the prior, for planes of leading shape ``lead``."""
    middle, far = np.log(kind.prior.middle), REACH * kind.prior.spread
    low, high = (np.broadcast_to(end, lead) for end in (middle - far, middle + far))
    return scales_between(kind, low, high)


def scales_of(
    kind: NoiseKind, lead: tuple[int, ...], log_of: Callable[[np.ndarray], np.ndarray]
) -> Scales:
    """Nodes where the posterior of a scale counts: ``log_of(scale)`` has shape (..., d, k)."""
    scales = wide_scales(kind, lead)
    for _ in range(2):
        log = np.logaddexp.reduce(log_of(scales.scale), axis=-2)
        scales = narrowed(kind, scales, log + scales.log_weight)
    return scales


def narrowed(kind: NoiseKind, scales: Scales, log_posterior: np.ndarray) -> Scales:
    """New nodes where the log posterior of the present ones, shape (..., k), counts."""
    skip = int(kind.special is not None)
    log = np.log(scales.scale[..., skip:])
    step = log[..., 1] - log[..., 0]
    here = log_posterior[..., skip:]
    counts = here > here.max(-1, keepdims=True) - DEEP
    low = np.where(counts, log, np.inf).min(-1) - step
    high = np.where(counts, log, -np.inf).max(-1) + step
    return scales_between(kind, low, high)


def variance_of(kind: NoiseKind, scale: Any) -> Any:
    """Variance over model^(2 power) of every point at every scale, shape (..., k, n)."""
    grown = scale[..., :, None] * kind.unit[..., None, :]
    return kind.floor[..., None, :] ** 2 + grown**2


def _points_first(values: Any, xp: Any) -> Any:
    """The last axis first, laid out anew, so that sums over points run along memory."""
    turned = xp.moveaxis(values, -1, 0)
    return xp.reshape(xp.reshape(turned, (-1,)), turned.shape)


def log_likelihood(off: Any, model: Any, kind: NoiseKind, scale: Any, noise: Noise) -> Any:
    """Log likelihood of sizes at every scale of a noise, bad readings averaged over.

    Parameters
    ----------
    off, model : array
        Shape (..., d, n): measured less predicted sizes, and the predicted ones, of d draws.
    kind : NoiseKind
        With arrays of shape (..., n).
    scale : array
        Shape (..., k).
    noise : Noise
        Of bad readings.

    Returns
    -------
    array, shape (..., d, k)

    Notes
    -----
    A reading is good with probability 1 - f or else scatters W times as wide (the good-and-bad-data
    model of D. W. Hogg, J. Bovy and D. Lang, arXiv:1008.4686 (2010), eq. 17, with a width that
    goes with the noise), and as a Cauchy distribution: a slip of the decimal point is as far off
    as it is, whatever the noise.
    """
    xp = off.__array_namespace__()
    n = off.shape[-1]
    found = n * (math.log1p(-noise.bad) - 0.5 * LN_2PI)
    if kind.power:
        off = off / model
        found = found - xp.sum(xp.log(model), axis=-1)[..., None]
    if kind.slow:
        whiten = whitening(covariance_of(kind, scale))
        own = xp.sum(xp.log(xp.linalg.diagonal(whiten)), axis=-1)[..., None, :]
        pull = (off[..., None, :, :] @ xp.swapaxes(whiten, -1, -2)) ** 2
        return found + own - 0.5 * xp.swapaxes(xp.sum(pull, axis=-1), -1, -2)
    variance = variance_of(kind, scale)
    # Points first, so that sums over them run along memory.
    squared = _points_first(off**2, xp)[..., None, :]
    either = _points_first(1.0 / variance, xp)[..., None] * squared
    either = xp.exp(-0.5 * either) + bad_density(either, noise)
    log = -0.5 * xp.sum(xp.log(variance), axis=-1)[..., None]
    for first in range(0, n, AT_ONCE):
        log = log + xp.log(xp.prod(either[first : first + AT_ONCE], axis=0))
    return found + xp.moveaxis(log, -1, -2)


def drifting(n: int) -> np.ndarray:
    """Correlation of slow noise between n rows in the order of the file."""
    apart = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    return WHITE * np.eye(n) + (1.0 - WHITE) * np.exp(-apart / (MEMORY * n))


def covariance_of(kind: NoiseKind, scale: Any) -> Any:
    """Covariance over model^(2 power) at every scale, shape (..., k, n, n), of slow noise."""
    grown = scale[..., :, None] * kind.unit[..., None, :]
    n = grown.shape[-1]
    slow = grown[..., :, None] * grown[..., None, :] * drifting(n)
    return slow + kind.floor[..., None, :, None] ** 2 * np.eye(n)


def whitening(covariance: Any) -> Any:
    """Inverse Cholesky factors of covariances, shape (..., n, n)."""
    xp = covariance.__array_namespace__()
    return xp.linalg.inv(xp.linalg.cholesky(covariance))


def bad_density(pull: Any, noise: Noise) -> Any:
    """Density of bad readings by their squared pulls, where that of good ones is e^(-pull/2)."""
    peak = noise.bad / (1.0 - noise.bad) * math.sqrt(2.0 / math.pi) / noise.width
    return peak / (1.0 + pull / noise.width**2)


def averaged(log: Any, log_weight: Any) -> Any:
    """Log of the average over the last axis."""
    xp = log.__array_namespace__()
    sum_of = log + log_weight
    top = xp.max(sum_of, axis=-1, keepdims=True)
    top = xp.where(xp.isfinite(top), top, 0.0)
    return xp.log(xp.sum(xp.exp(sum_of - top), axis=-1)) + top[..., 0]


class ShotMeans(NamedTuple):
    """Mean sizes and errors of the shots at each setting.

    Attributes
    ----------
    size, error : ndarray
        Shape (n,), m: mean of the shots that show the beam, and its standard error.
    bad : ndarray
        Shape (n, m): probability that a shot shows something else; NaN where there is none.
    scatter : float
        Median scatter of single shots, as a share of the size.
    """

    size: np.ndarray
    error: np.ndarray
    bad: np.ndarray
    scatter: float


def means_of(shots: np.ndarray, noise: Noise = Noise()) -> ShotMeans | None:  # noqa: B008
    """Means of shots, each shot with a probability of being none of the beam.

    Parameters
    ----------
    shots : ndarray
        Shape (n, m), m; NaN where a setting has fewer shots than m.
    noise : Noise
        With the prior probability of a bad shot.

    Returns
    -------
    ShotMeans or None
        None where fewer than three repeats in all, or shots that all agree, say nothing.

    Notes
    -----
    A mixture of the beam's normal scatter and of anything up to twice the largest size, by
    expectation and maximisation (D. W. Hogg, J. Bovy and D. Lang, arXiv:1008.4686 (2010), sect. 3);
    how large that scatter is is averaged over, or plain shots of an unlucky setting seem far off.
    The error of a mean includes what the doubtful shots would move it by. The variance of m shots
    is s² = (20 s_pool² + (m - 1) s_i²)/(20 + m - 1): a scaled inverse χ² prior around the scatter
    of all settings (A. Gelman et al., Bayesian Data Analysis, 3rd ed. (2013), sect. 2.6), a share
    of the size or the same at each, whichever is likelier.

    Examples
    --------
    >>> shots = 1e-4 * np.array([[1.0, 1.02, 0.98], [2.0, 2.04, 0.0], [3.0, 2.94, 3.06]])
    >>> found = means_of(shots)
    >>> (found.size * 1e4).round(3).tolist(), found.bad[1].round(2).tolist()
    ([1.0, 2.02, 3.0], [0.0, 0.0, 1.0])
    """
    there = ~np.isnan(shots)
    value = np.where(there, shots, 0.0)
    middle = np.nanmedian(np.where(shots > 0.0, shots, np.nan), axis=1)
    if (there.sum(1) - 1.0).clip(0).sum() < 3 or not np.any(np.nan_to_num(shots - middle[:, None])):
        return None
    far = LARGEST * float(np.max(middle))
    good, mean = there.astype(float), middle
    deviation = np.maximum(_first_scatter(shots, middle), 1e-6 * middle)
    for _ in range(ROUNDS):
        freedom = _freedom(good)
        z = (value - mean[:, None]) / deviation[:, None]
        density = log_student(z, freedom) - np.log(deviation / far)[:, None]
        odds = math.log(noise.bad_shot / (1.0 - noise.bad_shot)) - density
        last, good = good, np.where(there, expit(-odds), 0.0)
        mean = _means(value, good, middle)
        deviation = _scatter(value, good, mean, (freedom + 1.0) / (freedom + z**2))
        if np.max(np.abs(good - last)) < 1e-6:
            break
    deviation = _scatter(value, good, mean)
    count = np.maximum(good.sum(1), 0.5)
    doubtful = (good * (there - good) * (value - mean[:, None]) ** 2).sum(1) / count**2
    error = np.sqrt(deviation**2 / count + doubtful)
    # Shots of which none is like another: some are bad, and nothing says which.
    torn = good.sum(1) < 1.0
    number = there.sum(1)
    own = (value * there).sum(1) / number
    apart = np.sqrt((there * (value - own[:, None]) ** 2).sum(1) / number)
    mean, error = np.where(torn, own, mean), np.where(torn, np.maximum(apart, deviation), error)
    good = np.where(torn[:, None], 0.5 * there, good)
    bad = np.where(there, 1.0 - good, np.nan)
    return ShotMeans(mean, error, bad, float(np.median(deviation / mean)))


def _freedom(good: np.ndarray) -> np.ndarray:
    """Degrees of freedom that a setting's deviation is known by, shape (n, 1).

    Those of a setting about all settings together, and of all together about the truth.
    """
    own = np.maximum(good.sum(1, keepdims=True) - 1.0, 0.0)
    of_all = (POOLED / (POOLED + own)) ** 2 / max(own.sum(), 1.0)
    return 1.0 / (1.0 / (POOLED + own) + of_all)


def _first_scatter(shots: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """A robust deviation of each setting's shots to begin with: the same share for all."""
    share = np.abs(shots - middle[:, None]) / middle[:, None]
    # 1.4826 median absolute deviations are a standard deviation of a normal distribution.
    return 1.4826 * max(float(np.nanmedian(share[share > 0])), 1e-4) * middle


def _means(value: np.ndarray, good: np.ndarray, middle: np.ndarray) -> np.ndarray:
    total = good.sum(1)
    return np.where(total > 0.5, (good * value).sum(1) / np.maximum(total, 0.5), middle)


def _scatter(
    value: np.ndarray, good: np.ndarray, mean: np.ndarray, weight: np.ndarray | float = 1.0
) -> np.ndarray:
    """Standard deviation of the shots of each setting, evened out over the settings."""
    square = (good * weight * (value - mean[:, None]) ** 2).sum(1)
    freedom = np.maximum(good.sum(1) - 1.0, 0.0)
    return np.sqrt(evened(square, freedom, mean))


def evened(square: np.ndarray, freedom: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Variance of one shot at each setting, from sums of squares with degrees of freedom.

    Examples
    --------
    >>> evened(np.array([4.0, 16.0]), np.array([4.0, 4.0]), np.array([1.0, 2.0])).tolist()
    [1.0, 4.0]
    """
    least, shape, pooled = math.inf, size, 1.0
    for each in (size, np.full(len(size), np.median(size))):
        variance = float((square / each**2).sum() / max(freedom.sum(), 1.0))
        unlikely = float(freedom @ np.log(variance * each**2)) if variance > 0 else -math.inf
        if unlikely < least:
            least, shape, pooled = unlikely, each, variance
    own = POOLED * pooled * shape**2 + square
    return np.maximum(own / (POOLED + freedom), 1e-12 * size**2)
