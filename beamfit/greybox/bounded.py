"""Errors where bounds may be all that is known of a number.

A number that the data leave open ends on a bound or anywhere between two; its error is then a
matter of the bounds. Here bounds count as such information, and every quantity is asked which
share of its variance rests on them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

__all__ = ["MOST_SHARE", "Spread", "spread_of"]

# A quantity counts as determined while bounds carry less than this share of its variance.
MOST_SHARE = 0.5
# The variance of what nothing limits.
UNSEEN = 1e60


class Spread(NamedTuple):
    """Covariance of free numbers, shape (n, n), and the information their bounds add, (n,)."""

    covariance: np.ndarray
    from_bounds: np.ndarray

    def error(self, gradient: np.ndarray) -> np.ndarray:
        """Standard error of quantities by their gradients, shape (..., n) to (...)."""
        variance = np.einsum("...i,ij,...j", gradient, self.covariance, gradient)
        return np.sqrt(np.maximum(variance, 0.0))

    def share(self, gradient: np.ndarray) -> np.ndarray:
        """Share of each quantity's variance that rests on bounds, between 0 and 1."""
        moved = gradient @ self.covariance
        from_bounds = np.einsum("...i,i,...i", moved, self.from_bounds, moved)
        whole = np.einsum("...i,...i", moved, gradient)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(whole > 0, from_bounds / whole, 0.0)


def spread_of(
    jacobian: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    held: np.ndarray | None = None,
    with_prior: np.ndarray | None = None,
) -> Spread:
    """Covariance of numbers from the Jacobian of residuals, bounds counted as information.

    Parameters
    ----------
    jacobian : ndarray
        Shape (m, n), of residuals in units of their errors, priors among them.
    lower, upper : ndarray
        Shape (n,); infinite where there is no bound.
    held : ndarray of bool, optional
        Numbers that do not move.
    with_prior : ndarray of bool, optional
        Numbers with a prior of their own, whose bounds add nothing.

    Returns
    -------
    Spread
        Huge along directions that neither residuals nor bounds limit.

    Notes
    -----
    A number that data leave open ends on one of its bounds, while the truth may lie anywhere
    between them: the mean square distance from an end of a range of width w is w²/3 (and not
    w²/12, as from its middle). Then Var(q) = g C g with C = (JᵀJ + B)⁻¹, B = diag(3/w²), and
    C B C is the part of C that B carries.

    Examples
    --------
    >>> s = spread_of(np.array([[1.0, 0.0]]), np.array([0.0, 0.0]), np.array([100.0, 6.0]))
    >>> s.share(np.eye(2)).round(3).tolist(), s.error(np.eye(2)).round(2).tolist()
    ([0.0, 1.0], [1.0, 3.46])
    """
    n = jacobian.shape[1]
    width = np.asarray(upper, float) - np.asarray(lower, float)
    usable = np.isfinite(width) & (width > 0)
    if with_prior is not None:
        usable &= ~with_prior
    information = np.where(usable, 3.0 / np.where(usable, width, 1.0) ** 2, 0.0)
    loose = np.ones(n, bool) if held is None else ~held
    rows = np.vstack([jacobian, np.diag(np.sqrt(information))])[:, loose]
    length = np.linalg.norm(rows, axis=0)
    unit = np.where(length > 0, 1.0 / np.where(length > 0, length, 1.0), 0.0)
    _, sizes, directions = np.linalg.svd(rows * unit, full_matrices=False)
    covariance = np.zeros((n, n))
    with np.errstate(divide="ignore"):
        inverse = 1.0 / np.maximum(sizes, 1e-12 * sizes[0])
    half = unit[:, None] * (directions.T * inverse)
    inner = half @ half.T
    np.fill_diagonal(inner, np.where(length > 0, np.diagonal(inner), UNSEEN))
    covariance[np.ix_(loose, loose)] = inner
    return Spread(covariance, np.where(loose, information, 0.0))
