"""Noise of beam sizes: kinds of noise, their likelihood, and means of repeated shots.

Functions work on one plane, with NumPy or JAX arrays; leading axes are planes and draws.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.special import expit

from beamfit.arrays import registered
from beamfit.noise.model import LN_2PI, UNTESTABLE_PROBABILITY, Lognormal, Noise
from beamfit.statistics import log_student

# Nodes over ln of the noise scale; nodes cover the range in which the log posterior is within this
# distance of its peak.
NODES, MAX_LOG_DROP = 12, 12.0
# Half range of the first nodes, in standard deviations of the prior.
PRIOR_REACH = 4.5
# Factors that are multiplied before one logarithm is taken: fewer logarithms, no underflow.
FACTORS_PER_LOG = 8
# Slow noise: white share of its variance, and correlation time as a share of the scan. Faster noise
# averages out; slower noise changes all sizes alike.
WHITE_SHARE, CORRELATION_TIME = 0.2, 0.25
# From this many points on there is no slow kind of noise: its time grows with the cube of the
# number of points.
LONG_SCAN = 100
# Prior weight, in degrees of freedom, of the pooled scatter of all settings: the scatter of one
# setting differs from it by a third at most (Gelman et al., sect. 2.6).
POOLED_FREEDOM = 20.0
# Iterations of expectation and maximisation over the shots.
MAX_ITERATIONS = 20
# A shot that shows no beam has any size up to this multiple of the largest median.
MAX_SHOT_RATIO = 2.0


@dataclass(frozen=True, eq=False)
class NoiseKind:
    """One kind of noise, with standard deviation (floor² + (s unit)²)^½ model^power of a point.

    Attributes
    ----------
    power : int
        1 where the noise is a share of the size, 0 where it is the same at every size.
    floor, unit : array
        Shape (..., n): fixed part of the noise, and the part multiplied by the scale s.
    prior : Lognormal
        Prior of s, per plane.
    special_probability : array
        Probability that s has its special value, per plane.
    log_weight : array
        Log prior probability of the kind, per plane.
    special : float or None
        Special value of s, such as 1 for stated errors that are right.
    least : float
        Lower limit of s: 1 for stated errors, which are right or too small. An error that seems too
        large may cover effects that these points do not show.
    slow : bool
        Whether the noise is correlated from row to row, as from a drift of beam or screen. Such
        noise has no bad readings: one would act as a step, and steps mimic sizes of no beam.
    """

    power: int
    floor: Any
    unit: Any
    prior: Lognormal
    special_probability: Any
    log_weight: Any
    special: float | None = None
    least: float = 0.0
    slow: bool = False

    @property
    def log_continuous(self) -> Any:
        """Log of the probability that s is not special over that of the prior above `least`."""
        return np.log1p(-self.special_probability) - self.prior.log_probability_above(self.least)

    def deviation(self, scale: Any) -> Any:
        """Standard deviation over model^power of each point, at one scale per plane."""
        return np.hypot(self.floor, np.asarray(scale)[..., None] * self.unit)


# JAX treats a kind as a tree of arrays; these fields are part of its structure.
registered(NoiseKind, ("power", "special", "least", "slow"))


class Scales(NamedTuple):
    """Nodes over the scale of a kind of noise, shape (..., k), and their log prior weights."""

    scale: Any
    log_weight: Any


def is_share_of_size(error: np.ndarray, size: np.ndarray) -> bool:
    """Test whether errors, shape (..., n), are one share of the sizes to within 1 % of it.

    Examples
    --------
    >>> is_share_of_size(np.array([1.0, 2.0]), np.array([50.0, 100.0]))
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
    """Kinds of noise that measured sizes may have.

    Parameters
    ----------
    noise : Noise
        The priors.
    size : ndarray
        Measured, shape (..., n).
    error : ndarray or None
        Stated, shape (..., n).
    of_shots : bool
        Whether errors are those of means of shots; settings scatter beyond them.
    alike : bool, optional
        Whether stated errors are one share of the size; tested if None.

    Returns
    -------
    tuple of NoiseKind
        Without errors: a share of the size, and one value at all sizes. With stated errors: too
        small by a factor, or by the scatter of settings. Below `LONG_SCAN` points the last kind is
        the first one as slow noise.
    """
    zero, one, planes = np.zeros_like(size), np.ones_like(size), np.ones(size.shape[:-1])
    uncorrelated, slow = math.log1p(-noise.slow) * planes, math.log(noise.slow) * planes

    def of_planes(prior: Lognormal) -> Lognormal:
        return Lognormal(prior.middle * planes, prior.spread * planes)

    scatter = of_planes(noise.scatter)
    if of_shots:
        kinds = (
            NoiseKind(0, error, size, scatter, noise.even * planes, uncorrelated, special=0.0),
        )
    elif error is None:
        middle = np.median(size, axis=-1, keepdims=True) * one
        unstated = of_planes(noise.unstated)
        share, constant = (
            math.log(noise.share) + uncorrelated,
            math.log1p(-noise.share) + uncorrelated,
        )
        kinds = (
            NoiseKind(1, zero, one, unstated, zero[..., 0], share),
            NoiseKind(0, zero, middle, unstated, zero[..., 0], constant),
        )
    else:
        right, factor = noise.stated(np.median(error / size, axis=-1))
        slow = slow + np.log(right)
        if power := int(is_share_of_size(error, size) if alike is None else alike):
            error, size = error / size, one
        # Errors that are not right lack a factor or the scatter: equally probable.
        scattered = 0.5 * (1.0 - right)
        by_factor, by_scatter = (
            uncorrelated + np.log1p(-scattered),
            uncorrelated + np.log(scattered),
        )
        kinds = (
            NoiseKind(power, zero, error, factor, right / (1.0 - scattered), by_factor, 1.0, 1.0),
            NoiseKind(power, error, size, scatter, zero[..., 0], by_scatter),
        )
    if size.shape[-1] >= LONG_SCAN:
        return kinds
    first = replace(kinds[0], slow=True, log_weight=slow)
    # Slow noise larger than the stated errors would be a drift, which is a rival: s is 1.
    nearly_one = (1.0 - UNTESTABLE_PROBABILITY) * planes
    return (*kinds, replace(first, special_probability=nearly_one) if first.least else first)


def scales_between(kind: NoiseKind, low: np.ndarray, high: np.ndarray) -> Scales:
    """Nodes between two values of ln s, shape (...,), after the special value if there is one."""
    if kind.least:
        low = np.maximum(low, math.log(kind.least))
        high = np.maximum(high, low + 0.01)
    step = (high - low) / (NODES - 1)
    log = low[..., None] + step[..., None] * np.arange(NODES)
    prior = Lognormal(*(np.asarray(v)[..., None] for v in kind.prior))
    weight = prior.log_density(log) + (kind.log_continuous + np.log(step))[..., None]
    # Trapezoidal rule.
    weight = weight - math.log(2.0) * np.isin(np.arange(NODES), (0, NODES - 1))
    if kind.special is None:
        return Scales(np.exp(log), weight)
    first = np.ones_like(log[..., :1])
    scale = np.concatenate([kind.special * first, np.exp(log)], axis=-1)
    special_probability = np.log(kind.special_probability)[..., None] * first
    return Scales(scale, np.concatenate([special_probability, weight], axis=-1))


def prior_scales(kind: NoiseKind, lead: tuple[int, ...]) -> Scales:
    """Nodes over the whole prior, for planes of leading shape ``lead``."""
    middle, reach = np.log(kind.prior.middle), PRIOR_REACH * kind.prior.spread
    low, high = (np.broadcast_to(end, lead) for end in (middle - reach, middle + reach))
    return scales_between(kind, low, high)


def posterior_scales(
    kind: NoiseKind, lead: tuple[int, ...], log_of: Callable[[np.ndarray], np.ndarray]
) -> Scales:
    """Nodes over the posterior of the scale; ``log_of(scale)`` is shape (..., d, k), of d draws."""
    scales = prior_scales(kind, lead)
    for _ in range(2):
        log = np.logaddexp.reduce(log_of(scales.scale), axis=-2)
        scales = narrow_scales(kind, scales, log + scales.log_weight)
    return scales


def narrow_scales(kind: NoiseKind, scales: Scales, log_posterior: np.ndarray) -> Scales:
    """Replace nodes by others over the range where their log posterior, (..., k), matters."""
    skip = int(kind.special is not None)
    log = np.log(scales.scale[..., skip:])
    step = log[..., 1] - log[..., 0]
    at_nodes = log_posterior[..., skip:]
    counts = at_nodes > at_nodes.max(-1, keepdims=True) - MAX_LOG_DROP
    low = np.where(counts, log, np.inf).min(-1) - step
    high = np.where(counts, log, -np.inf).max(-1) + step
    return scales_between(kind, low, high)


def variance_of(kind: NoiseKind, scale: Any) -> Any:
    """Variance over model^(2 power) of each point at each scale, shape (..., k, n)."""
    scaled = scale[..., :, None] * kind.unit[..., None, :]
    return kind.floor[..., None, :] ** 2 + scaled**2


def _points_first(values: Any, xp: Any) -> Any:
    """Move the last axis to the front and copy, so that sums over points run along memory."""
    points = xp.moveaxis(values, -1, 0)
    return xp.reshape(xp.reshape(points, (-1,)), points.shape)


def log_likelihood(residual: Any, model: Any, kind: NoiseKind, scale: Any, noise: Noise) -> Any:
    """Log likelihood of sizes at each noise scale, averaged over bad readings.

    Parameters
    ----------
    residual, model : array
        Shape (..., d, n): measured minus predicted sizes, and predicted sizes, of d draws.
    kind : NoiseKind
        With arrays of shape (..., n).
    scale : array
        Shape (..., k).
    noise : Noise
        Prior of bad readings.

    Returns
    -------
    array, shape (..., d, k)

    Notes
    -----
    A reading is good with probability 1 - f; otherwise it has a Cauchy distribution W times as
    wide, since a slip of the decimal point may be any number of errors off. This is the
    good-and-bad-data model of D. W. Hogg, J. Bovy and D. Lang, arXiv:1008.4686 (2010), eq. 17,
    with a width proportional to the noise level.
    """
    xp = residual.__array_namespace__()
    n = residual.shape[-1]
    found = n * (math.log1p(-noise.bad) - 0.5 * LN_2PI)
    if kind.power:
        residual = residual / model
        found = found - xp.sum(xp.log(model), axis=-1)[..., None]
    if kind.slow:
        whitener = whitening(slow_covariance(kind, scale))
        log_determinant = xp.sum(xp.log(xp.linalg.diagonal(whitener)), axis=-1)[..., None, :]
        pull = (residual[..., None, :, :] @ xp.swapaxes(whitener, -1, -2)) ** 2
        return found + log_determinant - 0.5 * xp.swapaxes(xp.sum(pull, axis=-1), -1, -2)
    variance = variance_of(kind, scale)
    # Points come first, so that sums over them run along memory.
    squared = _points_first(residual**2, xp)[..., None, :]
    density = _points_first(1.0 / variance, xp)[..., None] * squared
    density = xp.exp(-0.5 * density) + bad_density(density, noise)
    log = -0.5 * xp.sum(xp.log(variance), axis=-1)[..., None]
    for first in range(0, n, FACTORS_PER_LOG):
        log = log + xp.log(xp.prod(density[first : first + FACTORS_PER_LOG], axis=0))
    return found + xp.moveaxis(log, -1, -2)


def slow_correlation(n: int) -> np.ndarray:
    """Correlation matrix of slow noise between n rows in the order of the file."""
    distance = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    return WHITE_SHARE * np.eye(n) + (1.0 - WHITE_SHARE) * np.exp(
        -distance / (CORRELATION_TIME * n)
    )


def slow_covariance(kind: NoiseKind, scale: Any) -> Any:
    """Covariance of slow noise over model^(2 power) at each scale, shape (..., k, n, n)."""
    scaled = scale[..., :, None] * kind.unit[..., None, :]
    n = scaled.shape[-1]
    slow = scaled[..., :, None] * scaled[..., None, :] * slow_correlation(n)
    return slow + kind.floor[..., None, :, None] ** 2 * np.eye(n)


def whitening(covariance: Any) -> Any:
    """Invert the Cholesky factors of covariances, shape (..., n, n)."""
    xp = covariance.__array_namespace__()
    return xp.linalg.inv(xp.linalg.cholesky(covariance))


def bad_density(pull: Any, noise: Noise) -> Any:
    """Density of bad readings at squared pulls, relative to good ones with e^(-pull/2)."""
    peak = noise.bad / (1.0 - noise.bad) * math.sqrt(2.0 / math.pi) / noise.width
    return peak / (1.0 + pull / noise.width**2)


def log_average(log: Any, log_weight: Any) -> Any:
    """Log of the weighted sum of exp(log) over the last axis."""
    xp = log.__array_namespace__()
    total = log + log_weight
    top = xp.max(total, axis=-1, keepdims=True)
    top = xp.where(xp.isfinite(top), top, 0.0)
    return xp.log(xp.sum(xp.exp(total - top), axis=-1)) + top[..., 0]


class ShotMeans(NamedTuple):
    """Mean sizes and errors of the shots at each setting.

    Attributes
    ----------
    size, error : ndarray
        Shape (n,), m: mean of the shots that show the beam, and its standard error.
    bad : ndarray
        Shape (n, m): probability that a shot does not show the beam; NaN for missing shots.
    scatter : float
        Median scatter of single shots, as a share of the size.
    """

    size: np.ndarray
    error: np.ndarray
    bad: np.ndarray
    scatter: float


def shot_means(shots: np.ndarray, noise: Noise = Noise()) -> ShotMeans | None:  # noqa: B008
    """Average the shots of each setting, weighted by their probability of showing the beam.

    Parameters
    ----------
    shots : ndarray
        Shape (n, m), m; NaN where a setting has fewer shots than m.
    noise : Noise
        Prior probability of a bad shot.

    Returns
    -------
    ShotMeans or None
        None if there are fewer than three repeats in all, or if all shots agree.

    Notes
    -----
    Mixture of the beam's normal scatter and a uniform distribution up to twice the largest size,
    by expectation and maximisation (D. W. Hogg, J. Bovy and D. Lang, arXiv:1008.4686 (2010),
    sect. 3). Averaged over the unknown scatter, the normal distribution becomes Student's;
    otherwise good shots of a setting with little scatter by chance would look bad. The error of a
    mean includes the shift by doubtful shots. The variance at a setting with m shots is
    s² = (20 s_pool² + (m - 1) s_i²)/(20 + m - 1), from a scaled inverse χ² prior around the scatter
    of all settings (A. Gelman et al., Bayesian Data Analysis, 3rd ed. (2013), sect. 2.6), which is
    a share of the size or the same at each setting, whichever is more probable.

    Examples
    --------
    >>> shots = 1e-4 * np.array([[1.0, 1.02, 0.98], [2.0, 2.04, 0.0], [3.0, 2.94, 3.06]])
    >>> found = shot_means(shots)
    >>> (found.size * 1e4).round(3).tolist(), found.bad[1].round(2).tolist()
    ([1.0, 2.02, 3.0], [0.0, 0.0, 1.0])
    """
    measured = ~np.isnan(shots)
    value = np.where(measured, shots, 0.0)
    middle = np.nanmedian(np.where(shots > 0.0, shots, np.nan), axis=1)
    if (measured.sum(1) - 1.0).clip(0).sum() < 3 or not np.any(
        np.nan_to_num(shots - middle[:, None])
    ):
        return None
    max_size = MAX_SHOT_RATIO * float(np.max(middle))
    good, mean = measured.astype(float), middle
    deviation = np.maximum(_initial_scatter(shots, middle), 1e-6 * middle)
    for _ in range(MAX_ITERATIONS):
        freedom = _freedom(good)
        z = (value - mean[:, None]) / deviation[:, None]
        density = log_student(z, freedom) - np.log(deviation / max_size)[:, None]
        odds = math.log(noise.bad_shot / (1.0 - noise.bad_shot)) - density
        last, good = good, np.where(measured, expit(-odds), 0.0)
        mean = _means(value, good, middle)
        deviation = _scatter(value, good, mean, (freedom + 1.0) / (freedom + z**2))
        if np.max(np.abs(good - last)) < 1e-6:
            break
    deviation = _scatter(value, good, mean)
    count = np.maximum(good.sum(1), 0.5)
    doubtful = (good * (measured - good) * (value - mean[:, None]) ** 2).sum(1) / count**2
    error = np.sqrt(deviation**2 / count + doubtful)
    # Shots that all disagree: some are bad, but nothing shows which.
    ambiguous = good.sum(1) < 1.0
    number = measured.sum(1)
    plain_mean = (value * measured).sum(1) / number
    plain_scatter = np.sqrt((measured * (value - plain_mean[:, None]) ** 2).sum(1) / number)
    mean, error = (
        np.where(ambiguous, plain_mean, mean),
        np.where(ambiguous, np.maximum(plain_scatter, deviation), error),
    )
    good = np.where(ambiguous[:, None], 0.5 * measured, good)
    bad = np.where(measured, 1.0 - good, np.nan)
    return ShotMeans(mean, error, bad, float(np.median(deviation / mean)))


def _freedom(good: np.ndarray) -> np.ndarray:
    """Degrees of freedom of a setting's standard deviation, shape (n, 1).

    They combine the setting's own scatter about the pooled one and the pooled one about the truth.
    """
    own = np.maximum(good.sum(1, keepdims=True) - 1.0, 0.0)
    pooled_term = (POOLED_FREEDOM / (POOLED_FREEDOM + own)) ** 2 / max(own.sum(), 1.0)
    return 1.0 / (1.0 / (POOLED_FREEDOM + own) + pooled_term)


def _initial_scatter(shots: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """Robust starting value of each setting's standard deviation: one share of the size for all."""
    share = np.abs(shots - middle[:, None]) / middle[:, None]
    # 1.4826 median absolute deviations are one standard deviation of a normal distribution.
    return 1.4826 * max(float(np.nanmedian(share[share > 0])), 1e-4) * middle


def _means(value: np.ndarray, good: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """Mean of each setting's good shots; the median where none is good."""
    total = good.sum(1)
    return np.where(total > 0.5, (good * value).sum(1) / np.maximum(total, 0.5), middle)


def _scatter(
    value: np.ndarray, good: np.ndarray, mean: np.ndarray, weight: np.ndarray | float = 1.0
) -> np.ndarray:
    """Standard deviation of the shots of each setting, with the pooled scatter as prior."""
    square = (good * weight * (value - mean[:, None]) ** 2).sum(1)
    freedom = np.maximum(good.sum(1) - 1.0, 0.0)
    return np.sqrt(pooled_variance(square, freedom, mean))


def pooled_variance(square: np.ndarray, freedom: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Variance of one shot at each setting, from sums of squares and their degrees of freedom.

    Examples
    --------
    >>> pooled_variance(np.array([4.0, 16.0]), np.array([4.0, 4.0]), np.array([1.0, 2.0])).tolist()
    [1.0, 4.0]
    """
    min_cost, shape, pooled = math.inf, size, 1.0
    for each in (size, np.full(len(size), np.median(size))):
        variance = float((square / each**2).sum() / max(freedom.sum(), 1.0))
        cost = float(freedom @ np.log(variance * each**2)) if variance > 0 else -math.inf
        if cost < min_cost:
            min_cost, shape, pooled = cost, each, variance
    total = POOLED_FREEDOM * pooled * shape**2 + square
    return np.maximum(total / (POOLED_FREEDOM + freedom), 1e-12 * size**2)
