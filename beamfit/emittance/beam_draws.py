"""Importance sampling of a plane's beam matrix, averaged over the noise.

Array shapes begin with the planes; n is the number of points, d the number of draws.
"""

from __future__ import annotations

import math
from functools import lru_cache
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.special import fdtri, gammaln, ndtri

from beamfit.emittance.model import transport_sigma
from beamfit.noise.model import LN_2PI, Noise
from beamfit.noise.sizes import (
    NoiseKind,
    Scales,
    log_average,
    log_likelihood,
    posterior_scales,
    slow_correlation,
    variance_of,
    whitening,
)

# Draws for the evidence of a zero-emittance beam, which needs no other result.
ZERO_EMITTANCE_DRAWS = 256
# Draws of each plane and kind of noise.
DRAWS = 3072
# Degrees of freedom of the Student distributions that propose beams: tails wider than the
# posterior's.
DEGREES_OF_FREEDOM = 4.0
# One draw in 8 comes from the prior, which bounds the weights where the sizes determine little.
DRAWS_PER_PRIOR_DRAW = 8
# Largest number of Student distributions in the proposal.
MAX_PROPOSALS = 24
# Their mixture weights are proportional to the posterior at their centres to this power.
SHARE_POWER = 0.5
# Iterations of a weighted fit: weights are taken at the model's size of the previous one.
FIT_ITERATIONS = 6
# Model sizes in the weights stay within this factor of the measured ones.
MAX_SIZE_RATIO = 3.0
# Fits leave out each pair of points up to this number of points, each single point up to this one.
MAX_POINTS_PAIRS, MAX_POINTS_SINGLES = 24, 50
# Other fits discard the worst points, up to this share of all, in at most this many steps.
MAX_DISCARDED, DISCARD_STEPS = 0.25, 12
# Variance added to an excluded point under correlated noise: large enough to remove its weight.
EXCLUDED_VARIANCE = 1e8
# Limit on draws times points, for memory and time, and the least number of draws under it.
MAX_DRAWN_SIZES, MIN_DRAWS = 500_000, 128
# Likelihood values computed at once: what the processor's cache holds.
BLOCK_NUMBERS = 200_000
# The scan does not separate the beam's numbers below this ratio of eigenvalues.
RANK_TOLERANCE = 1e-12
# Prior standard deviation of ln T, T the mean square of the beam's size over the scan, about the
# mean measured size²: any value near the sizes.
LN_T_SPREAD = 1.0


class Coordinates(NamedTuple):
    """Normalised coordinates in which the scan's mean Gram matrix of (R11, R12) is 1.

    Sizes are in units of the mean size. The beam matrix in these coordinates is
    σ_w = T/2 (1 + p·(Z, X)), with T the mean square of the beam's size over the scan.

    Attributes
    ----------
    w : ndarray
        Shape (..., n, 2): R11 and R12 in these coordinates.
    rows : ndarray
        Shape (..., n, 3): derivatives of size² with respect to T, T p_1 and T p_2.
    back : ndarray
        Shape (..., 2, 2): σ = back σ_w backᵀ, in m and rad.
    size, known : ndarray
        Shape (..., n): sizes, and size² not due to the beam, in units of the mean size.
    unit : ndarray
        Shape (...,): the mean size, m.
    seen : ndarray of bool
        Shape (...,): whether the settings separate the three numbers of the beam.
    """

    w: np.ndarray
    rows: np.ndarray
    back: np.ndarray
    size: np.ndarray
    known: np.ndarray
    unit: np.ndarray
    separable: np.ndarray

    def sigma(self, x: np.ndarray) -> np.ndarray:
        """Convert T, T p_1, T p_2, shape (..., d, 3), to σ11, σ12, σ22 in SI."""
        s = 0.5 * np.stack([x[..., 0] + x[..., 1], x[..., 2], x[..., 0] - x[..., 1]])
        back = np.moveaxis(self.back, (-2, -1), (0, 1))[..., None]
        return np.stack(transport_sigma(back, s), -1) * self.unit[..., None, None] ** 2


def coordinates(
    r11: np.ndarray, r12: np.ndarray, size: np.ndarray, known: np.ndarray
) -> Coordinates:
    """Find the normalised coordinates of a scan; all arrays have shape (..., n)."""
    # R12 is a length: both columns are scaled to the same rms before the eigenvectors are taken.
    u = np.stack([r11, r12], -1)
    norm = np.sqrt((u**2).mean(-2, keepdims=True))
    norm = np.where(norm > 0, norm, 1.0)
    plausible = _limit_outliers(u / norm, size)
    unit = np.exp(np.log(plausible).mean(-1))
    size, plausible = size / unit[..., None], plausible / unit[..., None]
    known = known / unit[..., None] ** 2
    v = u / norm / plausible[..., None]
    values, vectors = np.linalg.eigh(np.swapaxes(v, -1, -2) @ v / size.shape[-1])
    separable = values[..., 0] > RANK_TOLERANCE * values[..., 1]
    values = np.where(separable[..., None], values, np.maximum(values, 1.0))
    whiten = vectors / np.sqrt(values)[..., None, :]
    back, w = whiten / np.swapaxes(norm, -1, -2), (u / norm) @ whiten
    a, b = w[..., 0], w[..., 1]
    rows = 0.5 * np.stack([a**2 + b**2, a**2 - b**2, 2.0 * a * b], -1)
    return Coordinates(w, rows, back, size, known, unit, separable)


def _limit_outliers(v: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Limit sizes to a factor around the median of neighbours in phase; ``v`` is (..., n, 2).

    Otherwise one bad reading would set the scale of the prior of T.
    """
    length = np.maximum(np.linalg.norm(v, axis=-1), 1e-300)
    order = np.argsort(np.arctan2(v[..., 1], v[..., 0]) % math.pi, axis=-1)
    scaled = np.take_along_axis(size / length, order, -1)
    first = np.clip(np.arange(size.shape[-1]) - 1, 0, max(size.shape[-1] - 3, 0))
    middle = np.median(
        [scaled[..., np.minimum(first + i, size.shape[-1] - 1)] for i in range(3)], 0
    )
    expected = np.take_along_axis(middle, np.argsort(order, axis=-1), -1) * length
    return np.clip(size, expected / MAX_SIZE_RATIO, expected * MAX_SIZE_RATIO)


class BeamDraws(NamedTuple):
    """Weighted draws of a plane's beam under one kind of noise.

    Attributes
    ----------
    x : ndarray
        Shape (..., d, 3): T, T p_1, T p_2.
    log_weight : ndarray
        Shape (..., d): log weights; the weights add up to the evidence.
    scales : Scales
        Nodes over the noise scale.
    scale_log_evidence : ndarray
        Shape (..., k): log evidence of a beam at each node.
    best, best_log_likelihood : ndarray
        Shape (..., 3) and (...): T, T p_1, T p_2 of the most probable of the starting fits, and
        its log likelihood averaged over the noise scale.
    """

    x: np.ndarray
    log_weight: np.ndarray
    scales: Scales
    scale_log_evidence: np.ndarray
    best: np.ndarray
    best_log_likelihood: np.ndarray

    @property
    def scale_weight(self) -> np.ndarray:
        """Posterior probability of each node, shape (..., k)."""
        log = np.nan_to_num(
            self.scale_log_evidence + self.scales.log_weight, nan=-1e300, neginf=-1e300
        )
        weight = np.exp(log - log.max(-1, keepdims=True))
        return weight / weight.sum(-1, keepdims=True)


def draw_beams(c: Coordinates, kind: NoiseKind, noise: Noise) -> BeamDraws:
    """Draw beams from their posterior.

    Parameters
    ----------
    c : Coordinates
        The scan in normalised coordinates.
    kind : NoiseKind
        In the same units.
    noise : Noise
        Prior of bad readings.

    Returns
    -------
    BeamDraws

    Notes
    -----
    σ = T/2 (1 + p·(Z, X)) has the emittance ε = T/2 (1 - |p|²)^½: each beam is a point
    (T p_1, T p_2, 2ε) of a half space, at distance T from the origin. The prior is lognormal in T
    and uniform in direction; by Archimedes it is uniform in ε between 0 and T/2, and needs no
    boundary at zero emittance. The proposal is a mixture of Student distributions about the fits
    to all points and to all but one or two. Each draw is weighted by posterior over proposal
    density (importance sampling; A. B. Owen and Y. Zhou, J. Am. Stat. Assoc. 95, 135 (2000),
    sect. 4).
    """
    proposals = _proposals(c, kind, noise, zero_emittance=False)
    mixture, scales = proposals.mixture, proposals.scales
    count = int(np.clip(MAX_DRAWN_SIZES // c.size.shape[-1], MIN_DRAWS, DRAWS))
    s = mixture.draw(count)
    from_prior = _prior_points(count)
    s[..., -len(from_prior) :, :] = from_prior
    # Points mirrored at the plane 2ε = 0 are the same beam: their densities add up.
    log_density = np.logaddexp(mixture.log_density(s), mixture.log_density(s * (1.0, 1.0, -1.0)))
    # The share drawn from the prior bounds all weights.
    prior_share = 1.0 / DRAWS_PER_PRIOR_DRAW
    prior = log_prior(s)
    log_density = np.logaddexp(
        math.log1p(-prior_share) + log_density, math.log(prior_share) + prior
    )
    x = _from_half_space(s)
    each = _log_likelihood(x, c, kind, scales.scale, noise)
    importance = prior - log_density - math.log(count)
    weight = (
        log_average(each, scales.log_weight[..., None, :]) + importance + kind.log_weight[..., None]
    )
    weight = np.where(np.isnan(weight), -np.inf, weight)
    scale_log_evidence = log_average(np.swapaxes(each, -1, -2), importance[..., None, :])
    return BeamDraws(
        x,
        weight,
        scales,
        scale_log_evidence,
        proposals.best,
        proposals.best_log_likelihood + kind.log_weight,
    )


def zero_emittance_evidence(c: Coordinates, kind: NoiseKind, noise: Noise) -> np.ndarray:
    """Log evidence of a zero-emittance beam, shape (...,).

    Parameters
    ----------
    c, kind, noise
        As for `draw_beams`; the prior is the same, restricted to 2ε = 0.
    """
    proposals = _proposals(c, kind, noise, zero_emittance=True)
    spatial, scales = proposals.mixture, proposals.scales
    centre = spatial.centre[..., :2]
    planar = Mixture(centre, spatial.root[..., :2, :2], np.zeros_like(centre), spatial.share)
    s = planar.draw(ZERO_EMITTANCE_DRAWS)
    log_density = planar.log_density(s)
    s = np.concatenate([s, np.zeros_like(s[..., :1])], -1)
    x = _from_half_space(s)
    each = _log_likelihood(x, c, kind, scales.scale, noise)
    found = log_average(each, scales.log_weight[..., None, :])
    found = found + log_prior(s) + np.log(x[..., 0]) - log_density
    return log_average(found, -math.log(ZERO_EMITTANCE_DRAWS)) + kind.log_weight


def _from_half_space(s: np.ndarray) -> np.ndarray:
    """Convert T p_1, T p_2, 2ε to T, T p_1, T p_2."""
    return np.concatenate([np.linalg.norm(s, axis=-1, keepdims=True), s[..., :2]], -1)


class _Proposals(NamedTuple):
    """Proposal mixture, nodes over the noise scale, and the best of the starting fits.

    ``best`` is T, T p_1, T p_2 and ``best_log_likelihood`` its noise-averaged log likelihood.
    """

    mixture: Mixture
    scales: Scales
    best: np.ndarray
    best_log_likelihood: np.ndarray


def _proposals(c: Coordinates, kind: NoiseKind, noise: Noise, zero_emittance: bool) -> _Proposals:
    """Build the proposal from the starting fits, with a component for the best of them."""
    fitted, covariance, deviation = deletion_fits(c, kind)
    centre = _nearest_beam(fitted, covariance, zero_emittance)

    def at_centres(scale: np.ndarray) -> np.ndarray:
        return _log_likelihood(centre, c, kind, scale, noise)

    scales = posterior_scales(kind, c.unit.shape, at_centres)
    log = at_centres(scales.scale) + scales.log_weight[..., None, :]
    # Right stated errors give a peak of their own, up to a thousand times narrower than the others.
    special = int(kind.special is not None)
    groups = [slice(special)] * special + [slice(special, None)]
    parts = []
    for group in groups:
        scale, group_log = scales.scale[..., group], log[..., group]
        fit_covariance = (
            _noise_variance_ratio(group_log, scale, kind, deviation)[..., None, None] * covariance
        )
        # Posterior volume of the three beam numbers: proportional to the cube of the noise level.
        volume = 1.5 * np.log(variance_of(kind, scale).mean(-1))[..., None, :]
        height = np.nan_to_num(log_average(group_log, volume), nan=-np.inf)
        parts.append(
            _take_highest(
                MAX_PROPOSALS // len(groups),
                height,
                *_to_half_space(fitted, centre, fit_covariance),
            )
        )
    height, *columns = (np.concatenate(part, log.ndim - 2) for part in zip(*parts, strict=True))
    share = np.exp(SHARE_POWER * (height - height.max(-1, keepdims=True)))
    mixture = Mixture(*columns, share / share.sum(-1, keepdims=True))
    found = log_average(log, 0.0)
    found = np.where(np.isfinite(found), found, -np.inf)
    first = np.argmax(found, axis=-1)[..., None, None]
    best = np.take_along_axis(centre, first, -2)[..., 0, :]
    return _Proposals(mixture, scales, best, found.max(-1))


def _take_highest(count: int, height: np.ndarray, *columns: np.ndarray) -> list[np.ndarray]:
    """Select the highest entries along one axis, and the same entries of the other columns."""
    # Sorted by position: rounding must not decide the order of equal heights.
    top = np.sort(np.argsort(height, axis=-1)[..., -count:], axis=-1)
    ranks = (np.expand_dims(top, tuple(range(top.ndim, v.ndim))) for v in (height, *columns))
    pairs = zip((height, *columns), ranks, strict=True)
    return [np.take_along_axis(v, at, top.ndim - 1) for v, at in pairs]


def _noise_variance_ratio(
    log: np.ndarray, scale: np.ndarray, kind: NoiseKind, deviation: np.ndarray
) -> np.ndarray:
    """Ratio of the noise variance found at each fit to the variance that the fit assumed.

    ``log`` are log probabilities of the scales, shape (..., m, k), and ``deviation`` the assumed
    standard deviations of the points, shape (..., m, n).
    """
    variance = variance_of(kind, scale)[..., None, :, :] / deviation[..., None, :] ** 2
    variance = variance.mean(-1)
    # Posterior volume of the three beam numbers: proportional to the cube of the noise level.
    log = np.nan_to_num(log + 1.5 * np.log(variance), nan=-1e300, neginf=-1e300)
    weight = np.exp(log - log.max(-1, keepdims=True))
    return (weight * variance).sum(-1) / weight.sum(-1)


def _to_half_space(
    fitted: np.ndarray, beam: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Convert Gaussian fits of T, T p_1, T p_2 to components in (T p_1, T p_2, 2ε).

    Parameters
    ----------
    fitted, covariance : ndarray
        Shape (..., 3) and (..., 3, 3): fits, some of which are not physical beams.
    beam : ndarray
        Shape (..., 3): the nearest physical beam to each fit.

    Returns
    -------
    tuple of ndarray
        ``centre``, ``root`` and ``bend`` of a `Mixture`.

    Notes
    -----
    (2ε)² = T² - |Tp|², linearised about the beam, is normal with mean m and standard deviation s,
    and correlated with T p. The normal distribution in 2ε with centre c and deviation w that is
    nearest to it (C. M. Bishop, Pattern Recognition and Machine Learning (2006), eq. 10.4) has
    c² + 3w² = m and 12w⁴ - 4mw² + s² = 0, or c = 0 and 6w⁴ - 2mw² = s².
    """
    slope = 2.0 * beam * (1.0, -1.0, -1.0)
    covariance_slope = (covariance @ slope[..., None])[..., 0]
    variance = np.maximum((slope * covariance_slope).sum(-1), 1e-300)
    mean = (slope * (fitted - 0.5 * beam)).sum(-1)
    root_term = np.sqrt(np.maximum(mean**2 - 3.0 * variance, 0.0))
    off_plane = mean > np.sqrt(3.0 * variance)
    below = np.sqrt(mean**2 + 6.0 * variance) - mean
    width = variance / np.where(off_plane, 2.0 * (mean + root_term), below)
    height = np.sqrt(np.maximum(np.where(off_plane, mean - 3.0 * width, 0.0), 0.0))
    bend = covariance_slope[..., 1:] / variance[..., None]
    across_covariance = (
        covariance[..., 1:, 1:] - covariance_slope[..., 1:, None] * bend[..., None, :]
    )
    root = np.zeros_like(covariance)
    root[..., :2, :2] = np.linalg.cholesky(across_covariance + _ridge(across_covariance))
    root[..., 2, 2] = np.sqrt(width)
    centre = np.concatenate([fitted[..., 1:] - bend * mean[..., None], height[..., None]], -1)
    return centre, root, np.concatenate([bend, 0.0 * height[..., None]], -1)


def log_prior(s: np.ndarray) -> np.ndarray:
    """Log prior density of T p_1, T p_2, 2ε; shape (..., 3) to (...)."""
    log_t = 0.5 * np.log(np.maximum((s**2).sum(-1), 1e-200))
    log_t_density = -0.5 * (log_t / LN_T_SPREAD) ** 2 - math.log(LN_T_SPREAD) - 0.5 * LN_2PI
    return log_t_density - math.log(2.0 * math.pi) - 3.0 * log_t


def model_sizes(x: np.ndarray, c: Coordinates) -> np.ndarray:
    """Predicted sizes, shape (..., d, n), in units of the mean size."""
    return np.sqrt(np.maximum(x @ np.swapaxes(c.rows, -1, -2) + c.known[..., None, :], 1e-12))


def _log_likelihood(
    x: np.ndarray, c: Coordinates, kind: NoiseKind, scale: np.ndarray, noise: Noise
) -> np.ndarray:
    """Log likelihood of beams ``x``, shape (..., d, k), computed in blocks of draws."""
    step = max(1, int(BLOCK_NUMBERS / (scale.size * c.size.shape[-1])))
    parts = []
    for start in range(0, x.shape[-2], step):
        model = model_sizes(x[..., start : start + step, :], c)
        parts.append(log_likelihood(c.size[..., None, :] - model, model, kind, scale, noise))
    return np.concatenate(parts, axis=-2)


def kept_points(n: int) -> np.ndarray:
    """Points kept in each fit, 1 or 0, shape (fits, n): all, all but one, all but two."""
    max_left_out = min(max(n - 3, 0), (n <= MAX_POINTS_PAIRS) + (n <= MAX_POINTS_SINGLES))
    excluded = [s for k in range(1 + max_left_out) for s in combinations(range(n), k)]
    kept = np.ones((len(excluded), n))
    for row, points in zip(kept, excluded, strict=True):
        row[list(points)] = 0.0
    return kept


def deletion_fits(c: Coordinates, kind: NoiseKind) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fit size² to all points and to all but one, two or the worst.

    Returns
    -------
    tuple of ndarray
        Fits, shape (..., m, 3), their covariances, (..., m, 3, 3), and the standard deviations
        assumed for the points, (..., m, n).
    """
    n = c.size.shape[-1]
    kept = kept_points(n)
    kept = np.broadcast_to(kept, (*c.unit.shape, *kept.shape))
    # Points are weighted by the stated errors and, again, by the typical scatter of the prior.
    right_scale = [] if kind.special is None else [kind.special]
    typical_scale = [] if kind.least else [kind.prior.middle]
    deviations = [kind.deviation(scale) for scale in right_scale + typical_scale]
    found = [_weighted_fit(c, kind, deviation, kept) for deviation in deviations]
    for deviation in deviations if MAX_DISCARDED * n > 2 else ():
        found += _discard_fits(c, kind, deviation)
    fitted, covariances, used = zip(*found, strict=True)
    return np.concatenate(fitted, -2), np.concatenate(covariances, -3), np.concatenate(used, -2)


def _weighted_fit(
    c: Coordinates, kind: NoiseKind, deviation: np.ndarray, kept: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fit size² by iterated weighted least squares to the kept points, shape (..., m, n)."""
    rows, target = c.rows[..., None, :, :], (c.size**2 - c.known)[..., None, :]
    size = c.size[..., None, :]
    model = np.broadcast_to(size, kept.shape)
    weights = kept[..., None]
    if kind.slow:  # correlated noise: excluded points get a large variance of their own
        weights = whitening(
            slow_correlation(size.shape[-1])
            + EXCLUDED_VARIANCE * (1.0 - weights) * np.eye(size.shape[-1])
        )
    for _ in range(FIT_ITERATIONS):
        inverse_error = 1.0 / (2.0 * model * deviation[..., None, :] * model**kind.power)[..., None]
        design, wanted = (
            _apply_weights(weights, inverse_error * rows),
            _apply_weights(weights, inverse_error * target[..., None]),
        )
        transposed = np.swapaxes(design, -1, -2)
        normal = transposed @ design
        normal = normal + _ridge(normal)
        x = np.linalg.solve(normal, transposed @ wanted)[..., 0]
        squared = (rows @ x[..., None])[..., 0] + c.known[..., None, :]
        model = np.sqrt(
            np.clip(squared, (size / MAX_SIZE_RATIO) ** 2, (size * MAX_SIZE_RATIO) ** 2)
        )
    covariance = np.linalg.inv(normal)
    deviation = np.broadcast_to(deviation[..., None, :], kept.shape)
    return x, covariance, deviation


def _apply_weights(weights: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Multiply columns by point weights, shape (..., n, 1), or by a whitening matrix."""
    return weights * columns if weights.shape[-1] == 1 else weights @ columns


def _ridge(normal: np.ndarray) -> np.ndarray:
    """Small multiple of the unit matrix that keeps a singular normal matrix invertible."""
    trace = np.trace(normal, axis1=-2, axis2=-1)[..., None, None]
    return 1e-9 * np.maximum(trace, 1e-30) * np.eye(normal.shape[-1])


def _discard_fits(
    c: Coordinates, kind: NoiseKind, deviation: np.ndarray
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Fit repeatedly, each time without the worst points of the previous fit."""
    n = c.size.shape[-1]
    kept, found, max_discarded = np.ones((*c.unit.shape, 1, n)), [], int(MAX_DISCARDED * n)
    steps = min(max_discarded, DISCARD_STEPS)
    for _ in range(steps):
        x, covariance, _ = _weighted_fit(c, kind, deviation, kept)
        model = model_sizes(_nearest_beam(x, covariance), c)
        pull = np.abs(c.size[..., None, :] - model) / deviation[..., None, :] / model**kind.power
        worst = np.argsort(np.where(kept > 0, pull, -1.0), axis=-1)[
            ..., -(max_discarded // steps) :
        ]
        kept = kept.copy()
        np.put_along_axis(kept, worst, 0.0, axis=-1)
        found.append(_weighted_fit(c, kind, deviation, kept))
    return found


def _nearest_beam(
    x: np.ndarray, covariance: np.ndarray, zero_emittance: bool = False
) -> np.ndarray:
    """Move an unphysical fit to the nearest zero-emittance beam, in the metric of its covariance.

    With ``zero_emittance`` every fit is moved there.
    """
    for _ in range(FIT_ITERATIONS):
        t, vector = x[..., :1], x[..., 1:]
        p = np.linalg.norm(vector, axis=-1, keepdims=True) + 1e-12
        slope = np.concatenate([-np.ones_like(t), vector / p], -1)
        covariance_slope = (covariance @ slope[..., None])[..., 0]
        slope_variance = (slope * covariance_slope).sum(-1, keepdims=True)
        x = (
            x
            - (p - t if zero_emittance else np.maximum(p - t, 0.0))
            * covariance_slope
            / slope_variance
        )
    t = np.where(x[..., :1] > 0.05, x[..., :1], 0.3)
    p = np.linalg.norm(x[..., 1:], axis=-1, keepdims=True) + 1e-12
    return np.concatenate([t, x[..., 1:] * np.minimum(1.0, t / p)], -1)


def _halton_points(dim: int, number: int) -> np.ndarray:
    """Quasi-random points in a cube, shape (number, dim): radical inverses in the first primes.

    J. H. Halton, Numer. Math. 2, 84 (1960), eq. 1.
    """
    base, place = np.array([[2], [3], [5], [7]])[:dim], np.arange(number.bit_length())
    digits = np.arange(1, number + 1)[:, None, None] // base**place % base
    return (digits / base ** (place + 1.0)).sum(-1)


@lru_cache(maxsize=8)
def _student_points(dim: int, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Quasi-random points of a Student distribution in 2 or 3 dimensions, and numbers in [0, 1).

    The squared radius over the dimension has an F distribution, the direction is uniform. The
    further numbers choose the component of a mixture.
    """
    cube = _halton_points(dim + 1, number)
    radius, angle = (
        np.sqrt(dim * fdtri(dim, DEGREES_OF_FREEDOM, cube[:, 0])),
        2.0 * math.pi * cube[:, 1],
    )
    height = np.zeros(number) if dim == 2 else 2.0 * cube[:, 2] - 1.0
    ring = np.sqrt(1.0 - height**2)
    direction = np.stack([ring * np.cos(angle), ring * np.sin(angle), height], -1)
    return radius[:, None] * direction[:, :dim], cube[:, -1]


class Mixture(NamedTuple):
    """Mixture of Student distributions in 2 or 3 dimensions, curved along the last axis.

    A component is x = y + bend y_last², with y of a Student distribution.

    Attributes
    ----------
    centre, root, bend : ndarray
        Shape (..., m, dim), (..., m, dim, dim), a lower triangular square root of the scale
        matrix, and (..., m, dim), whose last entry is 0: the curvature preserves volume.
    share : ndarray
        Shape (..., m): mixture weights.
    """

    centre: np.ndarray
    root: np.ndarray
    bend: np.ndarray
    share: np.ndarray

    def draw(self, number: int) -> np.ndarray:
        """Quasi-random draws, shape (..., number, dim)."""
        z, cut = _student_points(self.centre.shape[-1], number)
        part = (cut[:, None] > np.cumsum(self.share, -1)[..., None, :]).sum(-1)
        part = np.minimum(part, self.share.shape[-1] - 1)[..., None]
        root = np.take_along_axis(self.root, part[..., None], -3)
        x = np.take_along_axis(self.centre, part, -2) + (root @ z[..., None])[..., 0]
        return x + np.take_along_axis(self.bend, part, -2) * x[..., -1:] ** 2

    def log_density(self, x: np.ndarray) -> np.ndarray:
        """Log density at points, shape (..., d, dim) to (..., d)."""
        *lead, parts, dim = self.centre.shape
        inverse = np.linalg.inv(self.root)
        # L⁻¹(x - bend x_last²) of all components in one matrix product, minus L⁻¹ centre.
        rows = np.concatenate([inverse, -inverse @ self.bend[..., None]], -1)
        extended = np.concatenate([x, x[..., -1:] ** 2], -1)
        distance = rows.reshape(*lead, parts * dim, dim + 1) @ np.swapaxes(extended, -1, -2)
        distance = distance.reshape(*lead, parts, dim, -1)
        distance -= inverse @ self.centre[..., None]
        kernel = 1.0 / (1.0 + np.square(distance, out=distance).sum(-2) / DEGREES_OF_FREEDOM)
        kernel **= 0.5 * (DEGREES_OF_FREEDOM + dim)
        volume = np.abs(np.diagonal(self.root, axis1=-2, axis2=-1))
        with np.errstate(divide="ignore"):
            height = np.log(self.share) - np.log(volume).sum(-1)
        top = height.max(-1, keepdims=True)
        log = np.log((np.exp(height - top)[..., None, :] @ kernel)[..., 0, :]) + top
        constant = gammaln(0.5 * (DEGREES_OF_FREEDOM + dim)) - gammaln(0.5 * DEGREES_OF_FREEDOM)
        return log + constant - 0.5 * dim * math.log(DEGREES_OF_FREEDOM * math.pi)


@lru_cache(maxsize=8)
def _prior_points(number: int) -> np.ndarray:
    """Quasi-random draws from the prior of T p_1, T p_2, 2ε, for their share of the draws."""
    trace, height, turns = _halton_points(3, number // DRAWS_PER_PRIOR_DRAW).T
    t, p = np.exp(LN_T_SPREAD * ndtri(trace)), np.sqrt(1.0 - height**2)
    angle = 2.0 * math.pi * turns
    return np.stack([t * p * np.cos(angle), t * p * np.sin(angle), t * height], -1)
