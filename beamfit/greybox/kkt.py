"""Is a point an optimum, and what does it cost to hold its limits? Our own answer, not a solver's.

At an optimum of cost f within limits on c(theta) and bounds on theta there are multipliers y, z
with grad f = J_c^T y + z (stationarity), y and z zero where a limit is not reached, not negative at
a lower and not positive at an upper limit (Nocedal & Wright, Numerical Optimization, 2nd ed.,
section 12.1). So a multiplier is d(cost)/d(limit), with cost = chi-square/2.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import nnls

__all__ = ["KKT", "TOLERANCE", "Limits", "Multipliers", "multipliers", "residual"]

TOLERANCE = 1e-6  # within which a limit counts as reached and a point as an optimum


class Limits(NamedTuple):
    """Values with their lower and upper limits."""

    value: np.ndarray
    lower: np.ndarray
    upper: np.ndarray

    @property
    def violation(self) -> np.ndarray:
        """By how much each limit is crossed, relative to 1 + |limit|."""
        low = (self.lower - self.value) / (1 + np.abs(_finite(self.lower)))
        high = (self.value - self.upper) / (1 + np.abs(_finite(self.upper)))
        return np.maximum(np.maximum(low, high), 0.0)

    def reached(self, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
        """Which lower and upper limits are reached."""
        low = self.value - self.lower <= tolerance * (1 + np.abs(_finite(self.lower)))
        high = self.upper - self.value <= tolerance * (1 + np.abs(_finite(self.upper)))
        return low, high

    def distance(self, multiplier: np.ndarray) -> np.ndarray:
        """Distance from the limit a multiplier belongs to; zero where there is none."""
        low, high = self.value - self.lower, self.upper - self.value
        return np.where(multiplier > 0, low, np.where(multiplier < 0, high, 0.0))


class Multipliers(NamedTuple):
    """Multipliers of the bounds (reduced gradients) and of the constraints."""

    bounds: np.ndarray
    constraints: np.ndarray


class KKT(NamedTuple):
    """How far a point is from an optimum; all three are zero at one.

    `stationarity` is the largest component of the Lagrangian's gradient in units of its terms,
    `feasibility` the largest violation relative to 1 + |limit|, `complementarity` the largest
    multiplier times distance from its limit, in units of the cost.
    """

    stationarity: float
    feasibility: float
    complementarity: float

    @property
    def worst(self) -> float:
        """The largest of the three."""
        return max(self)


def _finite(limit: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(limit), limit, 0.0)


def multipliers(
    gradient: np.ndarray,
    jacobian: np.ndarray,
    bounds: Limits,
    limits: Limits,
    scale: np.ndarray,
    tolerance: float = TOLERANCE,
) -> Multipliers:
    """Find the multipliers of the right signs that come nearest to stationarity.

    Parameters
    ----------
    gradient : array, shape (n,)
        Of the cost.
    jacobian : array, shape (m, n)
        Of the constraints.
    bounds, limits : Limits
        Of the n free numbers and of the m constraints.
    scale : array, shape (n,)
        Size of a component of the gradient that matters.
    tolerance : float
        Within which a limit counts as reached.

    Returns
    -------
    Multipliers

    Examples
    --------
    Minimise (x-3)^2/2 with x <= 1: the cost falls by 2 for each unit the bound gives way.

    >>> at = Limits(np.array([1.0]), np.array([-np.inf]), np.array([1.0]))
    >>> none = Limits(np.zeros(0), np.zeros(0), np.zeros(0))
    >>> multipliers(np.array([-2.0]), np.zeros((0, 1)), at, none, np.ones(1)).bounds.tolist()
    [-2.0]
    """
    n = len(gradient)
    rows = np.vstack([np.eye(n), np.reshape(jacobian, (-1, n))])
    low, high = (
        np.concatenate(pair)
        for pair in zip(bounds.reached(tolerance), limits.reached(tolerance), strict=True)
    )
    chosen = np.concatenate([np.flatnonzero(low), np.flatnonzero(high)])
    sign = np.concatenate([np.ones(low.sum()), -np.ones(high.sum())])
    found = np.zeros(len(rows))
    if chosen.size:
        columns = (sign[:, None] * rows[chosen] / scale).T
        size = np.linalg.norm(columns, axis=0)
        columns = columns / np.where(size > 0, size, 1.0)
        right = gradient / scale
        guess, _ = nnls(columns, right, maxiter=50 * columns.shape[1])
        used = guess > 0
        # One plain least-squares solution on the support: nnls stops at a tolerance.
        sharp = np.linalg.lstsq(columns[:, used], right, rcond=None)[0]
        guess[used] = np.where(sharp > 0, sharp, guess[used])
        np.add.at(found, chosen, sign * guess / np.where(size > 0, size, 1.0))
    return Multipliers(found[:n], found[n:])


def residual(
    gradient: np.ndarray,
    jacobian: np.ndarray,
    bounds: Limits,
    limits: Limits,
    scale: np.ndarray,
    found: Multipliers,
    cost: float,
) -> KKT:
    """Measure how far a point with multipliers is from an optimum.

    Parameters
    ----------
    gradient, jacobian, bounds, limits, scale
        As for `multipliers`.
    found : Multipliers
        Its multipliers.
    cost : float
        Size of the cost.

    Returns
    -------
    KKT
    """
    pull = np.reshape(jacobian, (-1, len(gradient)))
    left = gradient - found.bounds - pull.T @ found.constraints
    size = scale + np.abs(found.constraints) @ np.abs(pull)
    parts = ((found.bounds, bounds), (found.constraints, limits))
    products = [np.abs(y * part.distance(y)) for y, part in parts]
    crossed = np.concatenate([bounds.violation, limits.violation, [0.0]])
    return KKT(
        float(np.max(np.abs(left) / size, initial=0.0)),
        float(np.max(crossed)),
        float(np.max(np.concatenate(products), initial=0.0) / max(1.0, abs(cost))),
    )
