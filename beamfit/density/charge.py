"""Emittance against charge: what densities in phase space say of the core and of the halo."""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

import numpy as np

from beamfit.density.tomography import AXIS, EDGE, POINT

# Points of the fine grid, in rms sizes, and the rings into which squares of radii are counted.
FINE = 0.18
FINE_AXIS = np.arange(-EDGE, EDGE + FINE / 2, FINE)
FAR, RINGS = 100.0, 2000
# Squared radii, in rms sizes, beyond which charge is halo, and within which it is core.
HALO, CORE = 9.0, 1.0


class ChargeParts(NamedTuple):
    """Core and halo of each density, emittances in units of the frame's.

    Attributes
    ----------
    emittance : ndarray
        Shape (d, f): rms emittance of the charge within the ellipse, of the shape of the rms beam
        of all densities, that holds each share; NaN where the charge inside has no rms.
    halo, core : ndarray
        Shape (d,): shares of the charge beyond 3 rms, and within one.
    rms : float
        Emittance of the rms beam of all densities.
    """

    emittance: np.ndarray
    halo: np.ndarray
    core: np.ndarray
    rms: float


def charge_parts(values: np.ndarray, shares: tuple[float, ...]) -> ChargeParts:
    """Find the emittances of shares of the charge.

    Parameters
    ----------
    values : ndarray
        Shape (d, g), densities on the grid of `tomography`.
    shares : tuple of float
        Above 0, and 1 for all charge.

    Returns
    -------
    ChargeParts

    Notes
    -----
    The ellipses are about the centroid. Of a Gaussian beam a share 1 - exp(-u) has the rms
    emittance 1 - u exp(-u) / (1 - exp(-u)) of all.

    Examples
    --------
    >>> from beamfit.density.tomography import _gaussian
    >>> parts = charge_parts(_gaussian()[None], (0.5, 0.9, 1.0))
    >>> parts.emittance.round(3).tolist(), parts.halo.round(3).tolist()
    ([[0.307, 0.744, 1.0]], [0.011])
    """
    powers, fine = powers_of(FINE_AXIS), finely(values)
    # Where windows cut the beam single densities may have no rms: noise may be negative.
    radius, rms = rms_beam(fine.mean(axis=0), powers)
    found = [parts_of(density, powers, radius, shares) for density in fine]
    return ChargeParts(*map(np.array, zip(*found, strict=True)), rms)


def powers_of(axis: np.ndarray) -> np.ndarray:
    """Give 1, q, p, q², qp, p² at the points of a square grid, shape (6, m²)."""
    q, p = (v.ravel() for v in np.meshgrid(axis, axis, indexing="ij"))
    return np.stack([np.ones_like(q), q, p, q * q, q * p, p * p])


def negative_charge(values: np.ndarray) -> float:
    """Find how many standard deviations the charge is below zero where the mean density is.

    Examples
    --------
    >>> from beamfit.density.tomography import _gaussian
    >>> below = np.where(np.arange(len(_gaussian())) < 200, -1e-5, 0.0)  # at the edge
    >>> draws = np.array([_gaussian() + k * below for k in (2.0, 3.0, 4.0)])
    >>> round(negative_charge(draws), 1)
    3.7
    """
    spread, n = _spread(), len(AXIS)
    negative = finely(values.mean(axis=0)[None])[0] < 0.0
    below = spread.T @ negative.reshape(len(spread), -1) @ spread  # of the charge at each point
    charge = values @ below.reshape(n * n)
    return float(-charge.mean() / charge.std()) if charge.std() > 0.0 else 0.0


@cache
def _spread() -> np.ndarray:
    """Share of the charge at each point of the axis that each of the fine one has."""
    spread = np.exp(-0.5 * ((FINE_AXIS[:, None] - AXIS) / POINT) ** 2)
    return spread * FINE / POINT / math.sqrt(2.0 * math.pi)


def finely(values: np.ndarray) -> np.ndarray:
    """Densities on the fine grid, shape (d, m²), as charge at each point."""
    spread, n = _spread(), len(AXIS)
    return (spread @ values.reshape(-1, n, n) @ spread.T).reshape(len(values), -1)


def rms_beam(density: np.ndarray, powers: np.ndarray) -> tuple[np.ndarray, float]:
    """Squares of the distances of points from the centre, in rms sizes, and the rms emittance."""
    sums = powers @ density
    square, (a, b, c) = _second(sums)
    if not (square > 0.0 and a > 0.0):
        return np.full_like(density, math.nan), math.nan
    dq, dp = powers[1] - sums[1] / sums[0], powers[2] - sums[2] / sums[0]
    return (c * dq * dq - 2.0 * b * dq * dp + a * dp * dp) / square, math.sqrt(square)


def parts_of(
    density: np.ndarray, powers: np.ndarray, radius: np.ndarray, shares: tuple[float, ...]
) -> tuple[list[float], float, float]:
    """Emittances of the shares, halo and core of one density, as `ChargeParts`."""
    if not np.isfinite(radius).all():
        return [math.nan] * len(shares), math.nan, math.nan
    ring = np.minimum((radius * (RINGS / FAR)).astype(int), RINGS)
    inside = np.cumsum([np.bincount(ring, density * power, RINGS + 1) for power in powers], axis=1)
    edges, held = np.linspace(FAR / RINGS, FAR, RINGS), inside[0] / inside[0, -1]
    emittances = []
    for share in shares:
        # The first ellipse that holds it: beyond, noise may be negative.
        k = int(np.argmax(held >= share)) if share < 1.0 else RINGS
        part = inside[:, k]
        if 0 < k < RINGS:
            within = (share - held[k - 1]) / (held[k] - held[k - 1])
            part = inside[:, k - 1] + within * (part - inside[:, k - 1])
        emittances.append(_emittance(part))
    halo, core = (float(np.interp(at, edges, held[:RINGS])) for at in (HALO, CORE))
    return emittances, 1.0 - halo, core


def _emittance(sums: np.ndarray) -> float:
    """Rms emittance of sums of powers; NaN where there is none."""
    square, (a, _, _) = _second(sums)
    return math.sqrt(square) if square > 0.0 and a > 0.0 else math.nan


def _second(sums: np.ndarray) -> tuple[float, tuple[float, float, float]]:
    """Square of the rms emittance, and the second moments, of sums of powers."""
    total, q, p, qq, qp, pp = sums
    q, p = q / total, p / total
    a, b, c = qq / total - q * q, qp / total - q * p, pp / total - p * p
    return float(a * c - b * b), (float(a), float(b), float(c))
