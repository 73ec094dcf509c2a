"""Log evidences of what sizes may be besides those of a beam, under the same noise."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from beamfit.emittance.beam_draws import BRIGHT, WIDER, Coordinates, student_mixture
from beamfit.noise.model import LN_2PI, Noise
from beamfit.noise.sizes import (
    Kind,
    Scales,
    averaged,
    log_likelihood,
    narrowed,
    variance_of,
    wide_scales,
)

# Steps of ln size of sizes at random or in a drift; bends of a curve as shares of the mean size,
# and over which share of the scan it bends.
STEPS = np.geomspace(0.05, 1.0, 6)
BENDS, LENGTHS = np.array([0.2, 0.4, 0.7, 1.2]), (0.25, 0.5)
# Standard deviation of ln of a constant size.
LEVEL = 1.0
# Draws of a beam of no emittance, of which the evidence alone is wanted.
FEW = 256


def flat_beam(c: Coordinates, kind: Kind, noise: Noise) -> np.ndarray:
    """A beam of no emittance: sizes |w·v|, shape (...,).

    Notes
    -----
    A line in phase space. Sorted by their directions, the rows before some row see it from one
    side, those after it from the other: n linear fits, of which the best is drawn about.
    """
    n = c.size.shape[-1]
    w = c.w * np.where(c.w[..., 1:] < 0, -1.0, 1.0)
    order = np.argsort(np.arctan2(w[..., 1], w[..., 0]), axis=-1)
    w = np.take_along_axis(w, order[..., None], -2)
    size, known = (np.take_along_axis(v, order, -1) for v in (c.size, c.known))
    own = (np.take_along_axis(v, order, -1) for v in (kind.floor, kind.unit, kind.usual))
    kind = kind._replace(**dict(zip(("floor", "unit", "usual"), own, strict=True)))
    target = np.sqrt(np.maximum(size**2 - known, 0.0))
    scale = kind.special or kind.prior.middle
    deviation = np.hypot(kind.floor, scale * kind.unit) * (size if kind.power else 1.0)
    side = np.where(np.arange(n) < np.arange(n)[:, None], -1.0, 1.0)
    rows = (w / deviation[..., None])[..., None, :, :] * side[..., None]
    normal = np.swapaxes(rows, -1, -2) @ rows
    right = np.swapaxes(rows, -1, -2) @ (target / deviation)[..., None, :, None]
    trace = np.trace(normal, axis1=-2, axis2=-1)[..., None, None]
    normal = normal + 1e-9 * np.maximum(trace, 1e-30) * np.eye(2)
    v = np.linalg.solve(normal, right)
    off = (rows @ v)[..., 0] - (target / deviation)[..., None, :]
    chi2 = (off**2).sum(-1)
    best = np.argmin(chi2, axis=-1)[..., None]
    v = np.take_along_axis(v[..., 0], best[..., None], -2)
    normal = np.take_along_axis(normal, best[..., None, None], -3)
    least = np.take_along_axis(chi2, best, -1)
    factor = np.maximum(1.0, least / max(n - 2, 1)) if kind.chance else (2.0 + least) / n
    root = WIDER * np.linalg.cholesky(np.linalg.inv(normal)) * np.sqrt(factor)[..., None, None]
    scales = wide_scales(kind, c.unit.shape)

    def each(v: np.ndarray, scale: np.ndarray) -> np.ndarray:
        seen = np.abs(v @ np.swapaxes(w, -1, -2))
        model = np.sqrt(np.maximum(seen**2 + known[..., None, :], 1e-8))
        return log_likelihood(size[..., None, :] - model, model, kind, scale, noise)

    for _ in range(2):
        scales = narrowed(kind, scales, each(v, scales.scale)[..., 0, :] + scales.log_weight)
    x, log_density = student_mixture(v, root, np.ones((*v.shape[:-2], 1)), FEW)
    t = np.maximum((x**2).sum(-1), 1e-300)
    # v and -v are one beam: twice the density of the whole plane.
    bright = -0.5 * LN_2PI - math.log(BRIGHT) - 0.5 * (np.log(t) / BRIGHT) ** 2
    prior = bright - np.log(0.5 * math.pi * t)
    found = averaged(each(x, scales.scale), scales.log_weight[..., None, :])
    found = found + prior - log_density - math.log(FEW)
    return averaged(found, 0.0) + kind.log_weight


@lru_cache(maxsize=64)
def _walk(n: int) -> np.ndarray:
    """Covariance of a walk over n rows in the order of the file."""
    return 1.0 * np.minimum.outer(np.arange(n), np.arange(n))


def _bends(w: np.ndarray, length: float) -> np.ndarray:
    """Covariance of a smooth curve of the setting, shape (..., n, n): Matérn 3/2 in its rank."""
    n = w.shape[-2]
    with np.errstate(divide="ignore", invalid="ignore"):
        rank = np.argsort(np.argsort(w[..., 0] / w[..., 1], axis=-1), axis=-1)
    far = np.abs(rank[..., :, None] - rank[..., None, :]) / n / length
    return (1.0 + far) * np.exp(-far)


class CurveEvidence(NamedTuple):
    """Log evidences of sizes that are no beam's, each of shape (...,)."""

    constant: np.ndarray
    random: np.ndarray
    drift: np.ndarray
    curve: np.ndarray


def curve_evidences(u: np.ndarray, c: Coordinates, kind: Kind, noise: Noise) -> CurveEvidence:
    """Evidences of one size, sizes at random, a drift in time, a smooth curve of the setting.

    Parameters
    ----------
    u : ndarray
        Shape (..., n, 2): R11 and R12.
    c, kind, noise
        As for `draw_beams`.

    Notes
    -----
    Gaussian processes about a constant mean, in ln of the size (of a curve in the size): C. E.
    Rasmussen and C. K. I. Williams, Gaussian Processes for Machine Learning (2006), eq. 2.30 and
    sect. 2.7. With the covariance a²C + D of n points the eigenvalues of D^-½ C D^-½ give all
    amplitudes a at once.
    """
    n = c.size.shape[-1]
    x = np.log(c.size)
    # In ln size the noise of one size for all is a share of it.
    own = kind if kind.power else kind._replace(floor=kind.floor / c.size, unit=kind.unit / c.size)
    flat = own._replace(power=0)
    mean = x.mean(-1)
    levels = np.linspace(-4.0, 4.0, 65)
    spread = np.maximum(x.std(-1, ddof=1), 0.02)[..., None] / math.sqrt(n) * 2.5
    mu = mean[..., None] + levels * spread
    off = x[..., None, :] - mu[..., None]
    scales = wide_scales(flat, c.unit.shape)
    for _ in range(2):
        here = log_likelihood(off, off, flat, scales.scale, noise)
        scales = narrowed(flat, scales, np.logaddexp.reduce(here, axis=-2) + scales.log_weight)
    here = averaged(
        log_likelihood(off, off, flat, scales.scale, noise), scales.log_weight[..., None, :]
    )
    prior = -0.5 * (mu / LEVEL) ** 2 - 0.5 * LN_2PI - math.log(LEVEL)
    constant = averaged(here + prior, np.log(8.0 / 64 * spread))
    wide = wide_scales(flat, c.unit.shape)
    variance = variance_of(flat, wide.scale)
    same = np.broadcast_to(np.eye(n), (*c.unit.shape, n, n))
    random = _process(x, same, STEPS, variance, wide)
    drift = _process(x, np.broadcast_to(_walk(n), same.shape), STEPS, variance, wide)
    by_size = variance * c.size[..., None, :] ** 2
    curves = [_process(c.size - 1.0, _bends(u, each), BENDS, by_size, wide) for each in LENGTHS]
    curve = np.logaddexp(*curves) - math.log(2.0) + x.sum(-1)
    return CurveEvidence(*(v + kind.log_weight for v in (constant, random, drift, curve)))


def _process(
    x: np.ndarray, kernel: np.ndarray, amplitudes: np.ndarray, variance: np.ndarray, scales: Scales
) -> np.ndarray:
    """Log evidence of a Gaussian process about a constant, amplitudes and noise averaged over."""
    n = x.shape[-1]
    root = np.sqrt(variance)
    values, vectors = np.linalg.eigh(
        kernel[..., None, :, :] / root[..., :, None] / root[..., None, :]
    )
    turned = np.swapaxes(vectors, -1, -2)
    q = (turned @ (x[..., None, :] / root)[..., None])[..., None, :, 0]
    one = (turned @ (LEVEL / root)[..., None])[..., None, :, 0]
    grown = 1.0 + amplitudes[:, None] ** 2 * np.maximum(values, 0.0)[..., None, :]
    qq, qo, oo = (np.sum(v / grown, axis=-1) for v in (q * q, q * one, one * one))
    log_det = np.log(grown).sum(-1) + np.log1p(oo) + np.log(variance).sum(-1)[..., None]
    log = -0.5 * (qq - qo**2 / (1.0 + oo) + log_det + n * LN_2PI)
    log = averaged(log, -math.log(len(amplitudes)))
    return averaged(log, scales.log_weight)
