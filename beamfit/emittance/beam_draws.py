"""Draws from the posterior of a beam matrix, the noise averaged over: importance sampling.

Arrays of planes: shapes begin with the planes, n is the number of points, d that of draws.
"""

from __future__ import annotations

import math
from functools import lru_cache
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.special import fdtri, gammaln, ndtri

from beamfit.emittance.model import carried
from beamfit.noise.model import LN_2PI, Noise
from beamfit.noise.sizes import (
    NoiseKind,
    Scales,
    averaged,
    drifting,
    log_likelihood,
    scales_of,
    variance_of,
    whitening,
)

# Draws of a beam of no emittance, of which the evidence alone is wanted.
FEW = 256
# Draws of a plane, and degrees of freedom of the Student distributions they are drawn from.
DRAWS, TAIL = 3072, 4.0
# One draw in so many is from the prior: no weight is large by luck where the sizes say little.
DEFENSIVE = 8
# The shares of so many proposals are flattened by this power.
FLATTER, PARTS = 0.5, 24
# Rounds in which weights are taken anew from the model, within this factor of the measured size.
ROUNDS, FURTHEST = 6, 3.0
# Fits leave out every two of up to so many points, every one of up to so many more, and of any
# number the worst ones up to this share in so many steps.
PAIRS, SINGLES, WORST, STEPS = 24, 50, 0.25, 12
# Variance that makes a point of no weight.
LEFT_OUT = 1e8
# Numbers that one draw of many points may have, with all draws of few: memory and time.
ROOM, FEWEST = 500_000, 128
# Numbers worked on at once: what a processor has at hand.
BLOCK = 200_000
# A direction of the beam is lost below this share of the best seen one.
RANK = 1e-12
# Standard deviation of ln of the beam's mean square over the scan: anything near the sizes.
BRIGHT = 1.0


class Coordinates(NamedTuple):
    """Coordinates in which the scan looks at the beam evenly, in units of the mean size.

    Attributes
    ----------
    w : ndarray
        Shape (..., n, 2): rows of R11 and R12 in them.
    rows : ndarray
        Shape (..., n, 3): derivatives of size² by T, T p_1 and T p_2.
    back : ndarray
        Shape (..., 2, 2): σ = back σ_w backᵀ, in m and rad.
    size, known : ndarray
        Shape (..., n): sizes, and size² that is not due to the beam, in units of the mean size.
    unit : ndarray
        Shape (...,): the mean size, m.
    seen : ndarray of bool
        Shape (...,): whether the settings separate the numbers of the beam at all.
    """

    w: np.ndarray
    rows: np.ndarray
    back: np.ndarray
    size: np.ndarray
    known: np.ndarray
    unit: np.ndarray
    seen: np.ndarray

    def sigma(self, x: np.ndarray) -> np.ndarray:
        """σ11, σ12, σ22 in SI of T, T p_1, T p_2, shape (..., d, 3)."""
        s = 0.5 * np.stack([x[..., 0] + x[..., 1], x[..., 2], x[..., 0] - x[..., 1]])
        back = np.moveaxis(self.back, (-2, -1), (0, 1))[..., None]
        return np.stack(carried(back, s), -1) * self.unit[..., None, None] ** 2


def coordinates(
    r11: np.ndarray, r12: np.ndarray, size: np.ndarray, known: np.ndarray
) -> Coordinates:
    """Turn to coordinates in which the scan looks evenly; all arrays of shape (..., n)."""
    # R12 is a length: the columns are scaled to one size before they are turned.
    u = np.stack([r11, r12], -1)
    norm = np.sqrt((u**2).mean(-2, keepdims=True))
    norm = np.where(norm > 0, norm, 1.0)
    likely = _plausible(u / norm, size)
    unit = np.exp(np.log(likely).mean(-1))
    size, likely = size / unit[..., None], likely / unit[..., None]
    known = known / unit[..., None] ** 2
    v = u / norm / likely[..., None]
    values, vectors = np.linalg.eigh(np.swapaxes(v, -1, -2) @ v / size.shape[-1])
    seen = values[..., 0] > RANK * values[..., 1]
    values = np.where(seen[..., None], values, np.maximum(values, 1.0))
    turn = vectors / np.sqrt(values)[..., None, :]
    back, w = turn / np.swapaxes(norm, -1, -2), (u / norm) @ turn
    a, b = w[..., 0], w[..., 1]
    rows = 0.5 * np.stack([a**2 + b**2, a**2 - b**2, 2.0 * a * b], -1)
    return Coordinates(w, rows, back, size, known, unit, seen)


def _plausible(v: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Sizes within a factor of what rows (..., n, 2) of neighbouring phases make likely.

    One bad reading would decide what the prior takes for near the sizes.
    """
    length = np.maximum(np.linalg.norm(v, axis=-1), 1e-300)
    turn = np.argsort(np.arctan2(v[..., 1], v[..., 0]) % math.pi, axis=-1)
    seen = np.take_along_axis(size / length, turn, -1)
    first = np.clip(np.arange(size.shape[-1]) - 1, 0, max(size.shape[-1] - 3, 0))
    middle = np.median([seen[..., np.minimum(first + i, size.shape[-1] - 1)] for i in range(3)], 0)
    near = np.take_along_axis(middle, np.argsort(turn, axis=-1), -1) * length
    return np.clip(size, near / FURTHEST, near * FURTHEST)


class BeamDraws(NamedTuple):
    """Draws of the beam of a plane under one kind of noise.

    Attributes
    ----------
    x : ndarray
        Shape (..., d, 3): T, T p_1, T p_2.
    log_weight : ndarray
        Shape (..., d): their sum is the evidence.
    scales : Scales
        The nodes that the noise was averaged over.
    by_scale : ndarray
        Shape (..., k): log evidence of a beam at every node.
    best, best_log : ndarray
        Shape (..., 3) and (...): the likeliest of the fits without some points.
    """

    x: np.ndarray
    log_weight: np.ndarray
    scales: Scales
    by_scale: np.ndarray
    best: np.ndarray
    best_log: np.ndarray

    @property
    def scale_weight(self) -> np.ndarray:
        """Posterior probability of every node, shape (..., k)."""
        log = np.nan_to_num(self.by_scale + self.scales.log_weight, nan=-1e300, neginf=-1e300)
        weight = np.exp(log - log.max(-1, keepdims=True))
        return weight / weight.sum(-1, keepdims=True)


def draw_beams(c: Coordinates, kind: NoiseKind, noise: Noise) -> BeamDraws:
    """Draw beams from their posterior.

    Parameters
    ----------
    c : Coordinates
        The scan, in its own coordinates.
    kind : NoiseKind
        In the same units.
    noise : Noise
        Priors of bad readings.

    Returns
    -------
    BeamDraws

    Notes
    -----
    σ = T/2 (1 + p·(Z, X)) has the emittance ε = T/2 (1 - |p|²)^½: every beam is a point
    (T p_1, T p_2, 2ε) of half a space, as far from its origin as T. The prior is lognormal in T and
    has no preferred direction: flat in the emittance that T allows (Archimedes), without an edge
    at a beam of no emittance. Proposals are Student distributions about the fits of all points, and
    of those without one or two; each draw has the weight of its posterior over the density of the
    mixture (importance sampling; A. B. Owen and Y. Zhou, J. Am. Stat. Assoc. 95, 135 (2000),
    sect. 4).
    """
    about = _proposals(c, kind, noise, flat=False)
    mixture, scales = about.mixture, about.scales
    count = int(np.clip(ROOM // c.size.shape[-1], FEWEST, DRAWS))
    s = mixture.draw(count)
    further = _prior_points(count)
    s[..., -len(further) :, :] = further
    # Both heights are one beam.
    log_density = np.logaddexp(mixture.log_density(s), mixture.log_density(s * (1.0, 1.0, -1.0)))
    # Draws from the prior among them bound every weight.
    part = 1.0 / DEFENSIVE
    prior = log_prior(s)
    log_density = np.logaddexp(math.log1p(-part) + log_density, math.log(part) + prior)
    x = _numbers(s)
    each = _log_likelihood(x, c, kind, scales.scale, noise)
    drawn = prior - log_density - math.log(count)
    weight = averaged(each, scales.log_weight[..., None, :]) + drawn + kind.log_weight[..., None]
    weight = np.where(np.isnan(weight), -np.inf, weight)
    by_scale = averaged(np.swapaxes(each, -1, -2), drawn[..., None, :])
    return BeamDraws(x, weight, scales, by_scale, about.best, about.best_log + kind.log_weight)


def flat_evidence(c: Coordinates, kind: NoiseKind, noise: Noise) -> np.ndarray:
    """Log evidence of a beam of no emittance, a line in phase space, shape (...,).

    Parameters
    ----------
    c, kind, noise
        As of `draw_beams`; with the same prior at 2ε = 0.
    """
    about = _proposals(c, kind, noise, flat=True)
    whole, scales = about.mixture, about.scales
    centre = whole.centre[..., :2]
    plane = Mixture(centre, whole.root[..., :2, :2], np.zeros_like(centre), whole.share)
    s = plane.draw(FEW)
    log_density = plane.log_density(s)
    s = np.concatenate([s, np.zeros_like(s[..., :1])], -1)
    x = _numbers(s)
    each = _log_likelihood(x, c, kind, scales.scale, noise)
    found = averaged(each, scales.log_weight[..., None, :])
    found = found + log_prior(s) + np.log(x[..., 0]) - log_density
    return averaged(found, -math.log(FEW)) + kind.log_weight


def _numbers(s: np.ndarray) -> np.ndarray:
    """T, T p_1, T p_2 of T p_1, T p_2, 2ε."""
    return np.concatenate([np.linalg.norm(s, axis=-1, keepdims=True), s[..., :2]], -1)


class _Proposals(NamedTuple):
    """Likely beams: a mixture, nodes of the noise's scale, and the likeliest of the fits, T, T p_1,
    T p_2, with its log likelihood.
    """

    mixture: Mixture
    scales: Scales
    best: np.ndarray
    best_log: np.ndarray


def _proposals(c: Coordinates, kind: NoiseKind, noise: Noise, flat: bool) -> _Proposals:
    fitted, covariance, deviation = fits(c, kind)
    centre = _nearest(fitted, covariance, flat)

    def at_centres(scale: np.ndarray) -> np.ndarray:
        return _log_likelihood(centre, c, kind, scale, noise)

    scales = scales_of(kind, c.unit.shape, at_centres)
    log = at_centres(scales.scale) + scales.log_weight[..., None, :]
    # Right errors give a peak of their own, which may be a thousand times narrower than all others.
    special = int(kind.special is not None)
    groups = [slice(special)] * special + [slice(special, None)]
    parts = []
    for own in groups:
        scale, here = scales.scale[..., own], log[..., own]
        wide = _variance_found(here, scale, kind, deviation)[..., None, None] * covariance
        # A beam's three numbers take a volume of so many deviations cubed.
        volume = 1.5 * np.log(variance_of(kind, scale).mean(-1))[..., None, :]
        height = np.nan_to_num(averaged(here, volume), nan=-np.inf)
        parts.append(_highest(PARTS // len(groups), height, *_in_half_space(fitted, centre, wide)))
    height, *columns = (np.concatenate(part, log.ndim - 2) for part in zip(*parts, strict=True))
    share = np.exp(FLATTER * (height - height.max(-1, keepdims=True)))
    mixture = Mixture(*columns, share / share.sum(-1, keepdims=True))
    found = averaged(log, 0.0)
    found = np.where(np.isfinite(found), found, -np.inf)
    first = np.argmax(found, axis=-1)[..., None, None]
    likeliest = np.take_along_axis(centre, first, -2)[..., 0, :]
    return _Proposals(mixture, scales, likeliest, found.max(-1))


def _highest(count: int, height: np.ndarray, *columns: np.ndarray) -> list[np.ndarray]:
    """The highest of some parts, and their columns, of shape (..., m, ...)."""
    # In their own order: which of two equals is the better, rounding would decide.
    top = np.sort(np.argsort(height, axis=-1)[..., -count:], axis=-1)
    ranks = (np.expand_dims(top, tuple(range(top.ndim, v.ndim))) for v in (height, *columns))
    pairs = zip((height, *columns), ranks, strict=True)
    return [np.take_along_axis(v, at, top.ndim - 1) for v, at in pairs]


def _variance_found(
    log: np.ndarray, scale: np.ndarray, kind: NoiseKind, deviation: np.ndarray
) -> np.ndarray:
    """Variances of the fits over those by their deviations, by the noise that each of them finds:
    from log probabilities of its scales, shape (..., m, k), and deviations, shape (..., m, n).
    """
    variance = variance_of(kind, scale)[..., None, :, :] / deviation[..., None, :] ** 2
    variance = variance.mean(-1)
    # The three numbers of a beam about the fit take a volume of so many deviations cubed.
    log = np.nan_to_num(log + 1.5 * np.log(variance), nan=-1e300, neginf=-1e300)
    weight = np.exp(log - log.max(-1, keepdims=True))
    return (weight * variance).sum(-1) / weight.sum(-1)


def _in_half_space(
    fitted: np.ndarray, beam: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres, roots and bends of distributions of (T p_1, T p_2, 2ε) by fits of T, T p_1, T p_2.

    Parameters
    ----------
    fitted, covariance : ndarray
        Shape (..., 3) and (..., 3, 3): fits, some of which are no beams.
    beam : ndarray
        Shape (..., 3): the nearest beams to them.

    Returns
    -------
    tuple of ndarray
        As of a `Mixture`.

    Notes
    -----
    (2ε)² = T² - |Tp|² is normal with mean m and deviation s, linear about the beam, and T p goes
    with it. What is normal in 2ε about c with deviation w is nearest to that (C. M. Bishop, Pattern
    Recognition and Machine Learning (2006), eq. 10.4) where c² + 3w² = m and
    12w⁴ - 4mw² + s² = 0, or with c = 0 where 6w⁴ - 2mw² = s².
    """
    slope = 2.0 * beam * (1.0, -1.0, -1.0)
    along = (covariance @ slope[..., None])[..., 0]
    variance = np.maximum((slope * along).sum(-1), 1e-300)
    mean = (slope * (fitted - 0.5 * beam)).sum(-1)
    far = np.sqrt(np.maximum(mean**2 - 3.0 * variance, 0.0))
    apart = mean > np.sqrt(3.0 * variance)
    below = np.sqrt(mean**2 + 6.0 * variance) - mean
    width = variance / np.where(apart, 2.0 * (mean + far), below)
    height = np.sqrt(np.maximum(np.where(apart, mean - 3.0 * width, 0.0), 0.0))
    bend = along[..., 1:] / variance[..., None]
    across = covariance[..., 1:, 1:] - along[..., 1:, None] * bend[..., None, :]
    root = np.zeros_like(covariance)
    root[..., :2, :2] = np.linalg.cholesky(across + little(across))
    root[..., 2, 2] = np.sqrt(width)
    centre = np.concatenate([fitted[..., 1:] - bend * mean[..., None], height[..., None]], -1)
    return centre, root, np.concatenate([bend, 0.0 * height[..., None]], -1)


def log_prior(s: np.ndarray) -> np.ndarray:
    """Log prior density of T p_1, T p_2, 2ε, shape (..., 3) to (...)."""
    log_t = 0.5 * np.log(np.maximum((s**2).sum(-1), 1e-200))
    bright = -0.5 * (log_t / BRIGHT) ** 2 - math.log(BRIGHT) - 0.5 * LN_2PI
    return bright - math.log(2.0 * math.pi) - 3.0 * log_t


def model_sizes(x: np.ndarray, c: Coordinates) -> np.ndarray:
    """Predicted sizes, shape (..., d, n), in units of the mean size."""
    return np.sqrt(np.maximum(x @ np.swapaxes(c.rows, -1, -2) + c.known[..., None, :], 1e-12))


def _log_likelihood(
    x: np.ndarray, c: Coordinates, kind: NoiseKind, scale: np.ndarray, noise: Noise
) -> np.ndarray:
    """Log likelihood of beams x, shape (..., d, k), in blocks of draws that memory holds."""
    step = max(1, int(BLOCK / (scale.size * c.size.shape[-1])))
    parts = []
    for start in range(0, x.shape[-2], step):
        model = model_sizes(x[..., start : start + step, :], c)
        parts.append(log_likelihood(c.size[..., None, :] - model, model, kind, scale, noise))
    return np.concatenate(parts, axis=-2)


def left_out(n: int) -> np.ndarray:
    """Which of n points each fit has: all, all but one, all but two; shape (fits, n)."""
    most = min(max(n - 3, 0), (n <= PAIRS) + (n <= SINGLES))
    chosen = [s for k in range(1 + most) for s in combinations(range(n), k)]
    kept = np.ones((len(chosen), n))
    for row, points in zip(kept, chosen, strict=True):
        row[list(points)] = 0.0
    return kept


def fits(c: Coordinates, kind: NoiseKind) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fits of size² with all points and without some, their covariances, and the deviations of
    points that these are by.

    Returns
    -------
    tuple of ndarray
        Shape (..., m, 3), (..., m, 3, 3) and (..., m, n).
    """
    n = c.size.shape[-1]
    kept = left_out(n)
    kept = np.broadcast_to(kept, (*c.unit.shape, *kept.shape))
    # Points are weighed by what is stated, and with the usual scatter beside.
    special = [] if kind.special is None else [kind.special]
    usual = [] if kind.least else [kind.prior.middle]
    deviations = [kind.deviation(scale) for scale in special + usual]
    found = [_fitted(c, kind, deviation, kept) for deviation in deviations]
    for deviation in deviations if WORST * n > 2 else ():
        found += _greedy(c, kind, deviation)
    fitted, covariances, by = zip(*found, strict=True)
    return np.concatenate(fitted, -2), np.concatenate(covariances, -3), np.concatenate(by, -2)


def _fitted(
    c: Coordinates, kind: NoiseKind, deviation: np.ndarray, kept: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rows, target = c.rows[..., None, :, :], (c.size**2 - c.known)[..., None, :]
    size = c.size[..., None, :]
    model = np.broadcast_to(size, kept.shape)
    weigh = kept[..., None]
    if kind.slow:  # what is left out is of no weight
        weigh = whitening(
            drifting(size.shape[-1]) + LEFT_OUT * (1.0 - weigh) * np.eye(size.shape[-1])
        )
    for _ in range(ROUNDS):
        each = 1.0 / (2.0 * model * deviation[..., None, :] * model**kind.power)[..., None]
        design, wanted = _weighed(weigh, each * rows), _weighed(weigh, each * target[..., None])
        turned = np.swapaxes(design, -1, -2)
        normal = turned @ design
        normal = normal + little(normal)
        x = np.linalg.solve(normal, turned @ wanted)[..., 0]
        squared = (rows @ x[..., None])[..., 0] + c.known[..., None, :]
        model = np.sqrt(np.clip(squared, (size / FURTHEST) ** 2, (size * FURTHEST) ** 2))
    covariance = np.linalg.inv(normal)
    deviation = np.broadcast_to(deviation[..., None, :], kept.shape)
    return x, covariance, deviation


def _weighed(weigh: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Columns times weights of points, shape (..., n, 1), or a matrix of them."""
    return weigh * columns if weigh.shape[-1] == 1 else weigh @ columns


def little(normal: np.ndarray) -> np.ndarray:
    """A little of the unit matrix: points may say nothing of a direction."""
    trace = np.trace(normal, axis1=-2, axis2=-1)[..., None, None]
    return 1e-9 * np.maximum(trace, 1e-30) * np.eye(normal.shape[-1])


def _greedy(
    c: Coordinates, kind: NoiseKind, deviation: np.ndarray
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Fits that leave out the worst point of the one before, up to a share of them."""
    n = c.size.shape[-1]
    kept, found, most = np.ones((*c.unit.shape, 1, n)), [], int(WORST * n)
    steps = min(most, STEPS)
    for _ in range(steps):
        x, covariance, _ = _fitted(c, kind, deviation, kept)
        model = model_sizes(_nearest(x, covariance), c)
        pull = np.abs(c.size[..., None, :] - model) / deviation[..., None, :] / model**kind.power
        worst = np.argsort(np.where(kept > 0, pull, -1.0), axis=-1)[..., -(most // steps) :]
        kept = kept.copy()
        np.put_along_axis(kept, worst, 0.0, axis=-1)
        found.append(_fitted(c, kind, deviation, kept))
    return found


def _nearest(x: np.ndarray, covariance: np.ndarray, flat: bool = False) -> np.ndarray:
    """The nearest beam, one of no emittance, in the place of what is no beam (of everything if
    `flat`), by how far errors of this covariance reach.
    """
    for _ in range(ROUNDS):
        t, turned = x[..., :1], x[..., 1:]
        p = np.linalg.norm(turned, axis=-1, keepdims=True) + 1e-12
        slope = np.concatenate([-np.ones_like(t), turned / p], -1)
        along = (covariance @ slope[..., None])[..., 0]
        reach = (slope * along).sum(-1, keepdims=True)
        x = x - (p - t if flat else np.maximum(p - t, 0.0)) * along / reach
    t = np.where(x[..., :1] > 0.05, x[..., :1], 0.3)
    p = np.linalg.norm(x[..., 1:], axis=-1, keepdims=True) + 1e-12
    return np.concatenate([t, x[..., 1:] * np.minimum(1.0, t / p)], -1)


def _even_cube(dim: int, number: int) -> np.ndarray:
    """Points that fill a cube evenly, shape (number, dim): radical inverses in the first primes.

    J. H. Halton, Numer. Math. 2, 84 (1960), eq. 1.
    """
    base, place = np.array([[2], [3], [5], [7]])[:dim], np.arange(number.bit_length())
    digits = np.arange(1, number + 1)[:, None, None] // base**place % base
    return (digits / base ** (place + 1.0)).sum(-1)


@lru_cache(maxsize=8)
def _even_points(dim: int, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Even points of a Student distribution in two or three dimensions, and a cut of [0, 1).

    The square of its radius over the dimension has an F distribution, its direction is uniform.
    """
    cube = _even_cube(dim + 1, number)
    radius, turn = np.sqrt(dim * fdtri(dim, TAIL, cube[:, 0])), 2.0 * math.pi * cube[:, 1]
    height = np.zeros(number) if dim == 2 else 2.0 * cube[:, 2] - 1.0
    ring = np.sqrt(1.0 - height**2)
    direction = np.stack([ring * np.cos(turn), ring * np.sin(turn), height], -1)
    return radius[:, None] * direction[:, :dim], cube[:, -1]


class Mixture(NamedTuple):
    """Student distributions in two or three dimensions, each bent as the square of the last one.

    Attributes
    ----------
    centre, root, bend : ndarray
        Shape (..., m, dim), (..., m, dim, dim), lower triangles, and (..., m, dim), whose last is
        nothing: a bend moves no volume.
    share : ndarray
        Shape (..., m).
    """

    centre: np.ndarray
    root: np.ndarray
    bend: np.ndarray
    share: np.ndarray

    def draw(self, number: int) -> np.ndarray:
        """Even draws, shape (..., number, dim)."""
        z, cut = _even_points(self.centre.shape[-1], number)
        part = (cut[:, None] > np.cumsum(self.share, -1)[..., None, :]).sum(-1)
        part = np.minimum(part, self.share.shape[-1] - 1)[..., None]
        own = np.take_along_axis(self.root, part[..., None], -3)
        x = np.take_along_axis(self.centre, part, -2) + (own @ z[..., None])[..., 0]
        return x + np.take_along_axis(self.bend, part, -2) * x[..., -1:] ** 2

    def log_density(self, x: np.ndarray) -> np.ndarray:
        """Log density at points, shape (..., d, dim) to (..., d)."""
        *lead, parts, dim = self.centre.shape
        inverse = np.linalg.inv(self.root)
        # L⁻¹(x - bend x_dim²) of every part in one product, less L⁻¹centre.
        rows = np.concatenate([inverse, -inverse @ self.bend[..., None]], -1)
        seen = np.concatenate([x, x[..., -1:] ** 2], -1)
        far = rows.reshape(*lead, parts * dim, dim + 1) @ np.swapaxes(seen, -1, -2)
        far = far.reshape(*lead, parts, dim, -1)
        far -= inverse @ self.centre[..., None]
        near = 1.0 / (1.0 + np.square(far, out=far).sum(-2) / TAIL)
        near **= 0.5 * (TAIL + dim)
        volume = np.abs(np.diagonal(self.root, axis1=-2, axis2=-1))
        with np.errstate(divide="ignore"):
            height = np.log(self.share) - np.log(volume).sum(-1)
        top = height.max(-1, keepdims=True)
        log = np.log((np.exp(height - top)[..., None, :] @ near)[..., 0, :]) + top
        constant = gammaln(0.5 * (TAIL + dim)) - gammaln(0.5 * TAIL)
        return log + constant - 0.5 * dim * math.log(TAIL * math.pi)


@lru_cache(maxsize=8)
def _prior_points(number: int) -> np.ndarray:
    """Even draws from the prior of T p_1, T p_2, 2ε, one for every `DEFENSIVE` draws."""
    bright, flat, turn = _even_cube(3, number // DEFENSIVE).T
    t, p = np.exp(BRIGHT * ndtri(bright)), np.sqrt(1.0 - flat**2)
    angle = 2.0 * math.pi * turn
    return np.stack([t * p * np.cos(angle), t * p * np.sin(angle), t * flat], -1)
