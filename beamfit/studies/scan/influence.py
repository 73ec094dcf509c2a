"""What single points do to a fit of σ: one may refute the others, one may carry the answer."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.special import fdtrc

from beamfit.statistics import POOR_FIT
from beamfit.studies.scan.model import coefficients
from beamfit.studies.scan.noise import DOUBTFUL, Noise
from beamfit.studies.scan.results import Points

# A point carries the answer if the emittance moves by so many of its errors without it.
CARRIES = 2.0


class Influence(NamedTuple):
    """What single points do.

    Attributes
    ----------
    outlier : str
        Where the one point lies without which the others agree; empty if there is no such point.
    without : float
        Probability of the others' χ², where errors are known.
    chance : float
        How often noise puts some point so far from the others.
    carrying : str
        Where the point lies without which the emittance moves most, if it moves far.
    shift : float
        How far, in errors of the emittance; NaN where the others give none.
    """

    outlier: str = ""
    without: float = math.nan
    chance: float = 1.0
    carrying: str = ""
    shift: float = 0.0


def influence_of(p: Points, noise: Noise, sigma: np.ndarray, error: float) -> Influence:
    """Leave out each point in turn.

    Parameters
    ----------
    p : Points
        n points, n > 4.
    noise : Noise
        Of their sizes.
    sigma : ndarray
        Shape (3,), the best symmetric matrix.
    error : float
        Of the emittance, as quoted.

    Returns
    -------
    Influence

    Notes
    -----
    Of weighted rows a_i with residuals r_i and leverages h_i = a_iᵀ(AᵀA)⁻¹a_i, leaving out row i
    changes σ by -(AᵀA)⁻¹ a_i r_i/(1 - h_i) and χ² by -r_i²/(1 - h_i): R. D. Cook and S. Weisberg,
    Residuals and Influence in Regression (1982), eqs. 2.2.3 and 2.2.8. That χ² over the others'
    χ²/dof is distributed as F(1, dof) (the externally studentised residual); of n points the
    largest is asked for, so its probability counts n times.
    """
    n = len(p.size)
    scale = 0.5 / (p.weighed * p.error)
    rows = np.stack(coefficients(p.r11, p.r12), -1) * scale[:, None]
    left = (p.size**2 - p.known) * scale - rows @ sigma
    q, r = np.linalg.qr(rows)
    leverage = np.sum(q**2, axis=1)
    free = np.maximum(1.0 - leverage, 1e-12)
    chi2, dof = float(left @ left), n - 3
    rest = np.maximum(chi2 - left**2 / free, 1e-30)
    worst = int(np.argmin(rest))
    chance = min(n * float(fdtrc(1, dof - 1, (chi2 / rest[worst] - 1.0) * (dof - 1))), 1.0)
    without = noise.probability(float(rest[worst]), dof - 1)
    spoiled = noise.poor(chi2, dof) if noise.known else chance < POOR_FIT
    single = spoiled and (without is None or without > DOUBTFUL)
    shifts = _shifts(sigma, np.linalg.solve(r, q.T).T * (left / free)[:, None], error)
    most = int(np.argmax(np.where(np.isnan(shifts), np.inf, np.abs(shifts))))
    carries = not abs(shifts[most]) <= CARRIES and not (single and most == worst)
    return Influence(
        outlier=p.where(worst) if single else "",
        without=math.nan if without is None else without,
        chance=chance,
        carrying=p.where(most) if carries else "",
        shift=float(shifts[most]),
    )


def _shifts(sigma: np.ndarray, moves: np.ndarray, error: float) -> np.ndarray:
    """Of the emittance in errors, as each point is left out; NaN where no emittance is left."""
    s11, s12, s22 = (sigma - moves).T
    determinant = np.where((s11 > 0) & (s22 > 0), s11 * s22 - s12**2, np.nan)
    with np.errstate(invalid="ignore", divide="ignore"):
        whole = math.sqrt(max(sigma[0] * sigma[2] - sigma[1] ** 2, 0.0))
        return (np.sqrt(determinant) - whole) / error
