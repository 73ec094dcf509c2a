"""Emittance against charge, core and halo of densities in phase space."""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

import numpy as np

from beamfit.density.tomography import AXIS, EDGE, POINT

# Step of the fine grid, in rms sizes.
FINE = 0.18
FINE_AXIS = np.arange(-EDGE, EDGE + FINE / 2, FINE)
# Largest squared radius, in rms sizes, and number of rings of equal width in it.
MAX_RADIUS2 = 100.0
RINGS = 2000
# Squared radii, in rms sizes, beyond which charge is halo and within which it is core.
HALO = 9.0
CORE = 1.0


class ChargeParts(NamedTuple):
    """Core and halo of each density, emittances in units of the frame's.

    Attributes
    ----------
    emittance : ndarray
        Rms emittance of the charge within the ellipse that holds each share, shape (d, f). The
        ellipse has the shape of the rms beam of all densities; NaN where the charge in it has no
        rms.
    halo, core : ndarray
        Shares of the charge beyond 3 rms and within one, shape (d,).
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
        Densities on the grid of `tomography`, shape (d, g).
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
    powers, fine = powers_of(FINE_AXIS), refine(values)
    # Where windows cut the beam, single densities may be negative and have no rms.
    radius, rms = rms_beam(fine.mean(axis=0), powers)
    found = [parts_of(density, powers, radius, shares) for density in fine]
    return ChargeParts(*map(np.array, zip(*found, strict=True)), rms)


def powers_of(axis: np.ndarray) -> np.ndarray:
    """Give 1, q, p, q², qp, p² at the points of a square grid, shape (6, m²)."""
    q, p = (v.ravel() for v in np.meshgrid(axis, axis, indexing="ij"))
    return np.stack([np.ones_like(q), q, p, q * q, q * p, p * p])


def negative_charge(values: np.ndarray) -> float:
    """Charge in the regions of negative mean density, in standard deviations below zero.

    Examples
    --------
    >>> from beamfit.density.tomography import _gaussian
    >>> below = np.where(np.arange(len(_gaussian())) < 200, -1e-5, 0.0)  # at the edge
    >>> draws = np.array([_gaussian() + k * below for k in (2.0, 3.0, 4.0)])
    >>> round(negative_charge(draws), 1)
    3.7
    """
    spread, n = _spread(), len(AXIS)
    negative = refine(values.mean(axis=0)[None])[0] < 0.0
    # Weight of the charge at each point.
    weight = spread.T @ negative.reshape(len(spread), -1) @ spread
    charge = values @ weight.reshape(n * n)
    return float(-charge.mean() / charge.std()) if charge.std() > 0.0 else 0.0


@cache
def _spread() -> np.ndarray:
    """Share of the charge at each grid point of an axis that each fine point has."""
    spread = np.exp(-0.5 * ((FINE_AXIS[:, None] - AXIS) / POINT) ** 2)
    return spread * FINE / POINT / math.sqrt(2.0 * math.pi)


def refine(values: np.ndarray) -> np.ndarray:
    """Interpolate densities to the fine grid, shape (d, m²), as charge at each point."""
    spread, n = _spread(), len(AXIS)
    return (spread @ values.reshape(-1, n, n) @ spread.T).reshape(len(values), -1)


def rms_beam(density: np.ndarray, powers: np.ndarray) -> tuple[np.ndarray, float]:
    """Give squared distances of points from the centre, in rms sizes, and the rms emittance."""
    sums = powers @ density
    square, (a, b, c) = _second_moments(sums)
    if not (square > 0.0 and a > 0.0):
        return np.full_like(density, math.nan), math.nan
    dq, dp = powers[1] - sums[1] / sums[0], powers[2] - sums[2] / sums[0]
    return (c * dq * dq - 2.0 * b * dq * dp + a * dp * dp) / square, math.sqrt(square)


def parts_of(
    density: np.ndarray, powers: np.ndarray, radius: np.ndarray, shares: tuple[float, ...]
) -> tuple[list[float], float, float]:
    """Give emittances of the shares, halo and core of one density, as in `ChargeParts`."""
    if not np.isfinite(radius).all():
        return [math.nan] * len(shares), math.nan, math.nan
    ring = np.minimum((radius * (RINGS / MAX_RADIUS2)).astype(int), RINGS)
    inside = np.cumsum([np.bincount(ring, density * power, RINGS + 1) for power in powers], axis=1)
    edges, cumulative = (
        np.linspace(MAX_RADIUS2 / RINGS, MAX_RADIUS2, RINGS),
        inside[0] / inside[0, -1],
    )
    emittances = []
    for share in shares:
        # The first ellipse that holds the share: further out the charge may fall again by noise.
        k = int(np.argmax(cumulative >= share)) if share < 1.0 else RINGS
        sums = inside[:, k]
        if 0 < k < RINGS:
            fraction = (share - cumulative[k - 1]) / (cumulative[k] - cumulative[k - 1])
            sums = inside[:, k - 1] + fraction * (sums - inside[:, k - 1])
        emittances.append(_emittance(sums))
    halo, core = (float(np.interp(radius2, edges, cumulative[:RINGS])) for radius2 in (HALO, CORE))
    return emittances, 1.0 - halo, core


def _emittance(sums: np.ndarray) -> float:
    """Rms emittance from sums of powers; NaN if there is none."""
    square, (a, _, _) = _second_moments(sums)
    return math.sqrt(square) if square > 0.0 and a > 0.0 else math.nan


def _second_moments(sums: np.ndarray) -> tuple[float, tuple[float, float, float]]:
    """Square of the rms emittance, and second moments, from sums of powers."""
    total, q, p, qq, qp, pp = sums
    q, p = q / total, p / total
    a, b, c = qq / total - q * q, qp / total - q * p, pp / total - p * p
    return float(a * c - b * b), (float(a), float(b), float(c))
