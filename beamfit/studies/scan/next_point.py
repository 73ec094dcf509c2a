"""Which one further setting would sharpen the emittance most."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from beamfit.greybox.design import Information, rows_of, scores
from beamfit.studies.scan.results import Points

# Candidates reach half the scanned range beyond either end.
REACH, COUNT = 0.5, 41
# A setting below this share of the range is the rounding of zero.
ROUNDING = 1e-9


class Candidate(NamedTuple):
    """A setting worth measuring, and the relative emittance error expected with it."""

    magnet: str
    setting: float
    relative_error: float


def candidate_settings(
    settings: Mapping[str, np.ndarray],
    limits: Mapping[str, tuple[float, float]] | None = None,
) -> list[tuple[str, dict[str, np.ndarray]]]:
    """Settings to consider: one magnet after the other over its range, the others held.

    Parameters
    ----------
    settings : mapping of str to ndarray
        The settings already measured.
    limits : mapping of str to (float, float), optional
        Magnets and their ranges; each scanned one, half its range beyond either end if None.

    Returns
    -------
    list of (str, dict)
        For each magnet the settings of all, each of shape (41,). The others stay at their median.

    Examples
    --------
    >>> [(name, table)] = candidate_settings({"Q": np.array([0.0, 2.0])})
    >>> name, table["Q"][[0, -1]].tolist()
    ('Q', [-1.0, 3.0])
    """
    if limits is None:
        spans = {n: (v.min(), v.max(), REACH * np.ptp(v)) for n, v in settings.items()}
        limits = {n: (low - far, high + far) for n, (low, high, far) in spans.items() if far > 0}
    held = {n: np.full(COUNT, np.median(v)) for n, v in settings.items()}
    found = []
    for name, (low, high) in limits.items():
        values = np.linspace(low, high, COUNT)
        values[np.abs(values) < ROUNDING * (high - low)] = 0.0
        found.append((name, held | {name: values}))
    return found


def best_symmetric(points: Points) -> np.ndarray:
    """The least-squares matrix with no regard to its sign, shape (3,)."""
    weight = 1.0 / (2.0 * points.weighed * points.error)
    r11, r12 = points.r11, points.r12
    design = np.stack([r11**2, 2 * r11 * r12, r12**2], -1) * weight[:, None]
    norm = np.linalg.norm(design, axis=0)
    target = (points.size**2 - points.known) * weight
    return np.linalg.lstsq(design / norm, target, rcond=None)[0] / norm


def plausible_sigma(sigma: np.ndarray, covariance: np.ndarray) -> np.ndarray | None:
    """Find a beam near the fit with a positive emittance, to predict sizes with.

    Where the best matrix has det σ below its standard error it is moved along the direction
    that raises det most for its χ², until it has that much; None if that fails.

    Examples
    --------
    >>> plausible_sigma(np.array([1.0, 0.0, 0.0]), 1e-4 * np.eye(3)).round(2).tolist()
    [1.0, 0.0, 0.01]
    """
    gradient = np.array([sigma[2], -2.0 * sigma[1], sigma[0]])
    determinant = sigma[0] * sigma[2] - sigma[1] ** 2
    error = float(np.sqrt(max(gradient @ covariance @ gradient, 0.0)))
    if not error > 0.0:
        return None
    if determinant > error:
        return sigma
    moved = sigma + covariance @ gradient / error * (1.0 - determinant / error)
    good = moved[0] > 0 and moved[0] * moved[2] > moved[1] ** 2
    return moved if good else None


def best_candidate(
    sigma: np.ndarray,
    covariance: np.ndarray,
    relative: float,
    rows: list[tuple[str, np.ndarray, np.ndarray]],
) -> Candidate | None:
    """Choose the setting that leaves the smallest emittance error.

    Parameters
    ----------
    sigma : ndarray
        Shape (3,), a positive definite beam near the fit.
    covariance : ndarray
        Shape (3, 3), of the scan so far, scaled.
    relative : float
        Relative size error a further point would have.
    rows : list of (str, ndarray, ndarray)
        Magnet, its candidate settings (m,), and the rows (R11², 2 R11 R12, R12²) (m, 3).

    Returns
    -------
    Candidate or None
            None without a candidate.

    Examples
    --------
    >>> rows = [("Q", np.array([0.0, 1.0]), np.array([[1.0, 0, 0], [0, 0, 1.0]]))]
    >>> best_candidate(np.array([1.0, 0, 1.0]), np.diag([1e-4, 1e-4, 1.0]), 0.02, rows).setting
    1.0
    """
    emittance = np.sqrt(sigma[0] * sigma[2] - sigma[1] ** 2)
    gradient = np.array([[sigma[2], -2.0 * sigma[1], sigma[0]]]) / (2.0 * emittance)
    free = np.full(3, np.inf)
    known = Information(
        rows_of(covariance), np.array([emittance]), gradient, np.ones(3, bool), -free, free
    )
    found = []
    for name, settings, design in rows:
        squared = np.maximum(design @ sigma, 1e-30)
        errors = scores(known, (design / (2.0 * relative * squared)[:, None])[:, None, :])
        best = int(np.argmin(errors))
        found.append(Candidate(name, float(settings[best]), float(errors[best])))
    return min(found, key=lambda c: c.relative_error, default=None)
