"""Optimal design: the next measurement that reduces errors most, in linear approximation.

A candidate measurement is given by rows of the Jacobian: derivatives of its predicted values by the
free numbers, divided by its errors.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from beamfit.greybox.covariance import Spread, spread_of


class Information(NamedTuple):
    """Information on some quantities from the present data, to which candidates add.

    Attributes
    ----------
    jacobian : ndarray
        Shape (m, n), Jacobian of residuals in units of their errors, priors among them.
    value, slope : ndarray
        The quantities, shape (k,), and their derivatives by the free numbers, (k, n).
    asked : ndarray of bool
        Shape (n,), numbers whose error ellipsoid counts for the score `volume`.
    lower, upper : ndarray
        Bounds, shape (n,).
    held, with_prior : ndarray of bool, optional
        Numbers that do not move, and numbers with a prior on themselves.

    Examples
    --------
    >>> one = Information(np.eye(2), np.ones(1), np.array([[0.6, 0.8]]), np.ones(2, bool),
    ...                   np.full(2, -np.inf), np.full(2, np.inf))
    >>> one.relative_error.tolist(), one.with_rows(np.sqrt(3.0) * np.eye(2)).relative_error.tolist()
    ([1.0], [0.5])
    """

    jacobian: np.ndarray
    value: np.ndarray
    slope: np.ndarray
    asked: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    held: np.ndarray | None = None
    with_prior: np.ndarray | None = None

    @property
    def spread(self) -> Spread:
        """Errors of the numbers, with bounds as information."""
        return spread_of(self.jacobian, self.lower, self.upper, self.held, self.with_prior)

    @property
    def share(self) -> np.ndarray:
        """Share of each quantity's variance that comes from bounds, shape (k,)."""
        return self.spread.share(self.slope)

    @property
    def error(self) -> np.ndarray:
        """Standard error of each quantity, shape (k,)."""
        return self.spread.error(self.slope)

    @property
    def relative_error(self) -> np.ndarray:
        """Relative error of each quantity, shape (k,)."""
        return self.error / np.abs(self.value)

    def with_rows(self, rows: np.ndarray) -> Information:
        """The information with further rows of the Jacobian."""
        return self._replace(jacobian=np.vstack([self.jacobian, rows]))


class Choice(NamedTuple):
    """The best candidate after those chosen before: its index, gain, and the information with it.

    `gain` is the relative decrease of the score.
    """

    index: int
    gain: float
    known: Information


def rows_of(covariance: np.ndarray) -> np.ndarray:
    """Make rows of a Jacobian whose information is the inverse of a covariance, shape (n, n).

    Examples
    --------
    >>> np.abs(rows_of(np.diag([4.0, 0.25]))).tolist()
    [[0.5, 0.0], [0.0, 2.0]]
    """
    unit = np.sqrt(np.diagonal(covariance))
    sizes, vectors = np.linalg.eigh(covariance / np.outer(unit, unit))
    return (vectors / np.sqrt(np.maximum(sizes, 1e-14 * sizes[-1]))).T / unit


def scores(information: Information, candidates: np.ndarray, volume: bool = False) -> np.ndarray:
    """Score each candidate alone by the expected error with it; smaller is better.

    Parameters
    ----------
    information : Information
        Information so far.
    candidates : ndarray
        Shape (candidates, rows, n); rows of zeros are padding.
    volume : bool
        True to score the logarithm of the determinant of the covariance of the numbers `asked`
        (D-optimality) instead of the root of the summed squares of the relative errors.

    Returns
    -------
    ndarray, shape (candidates,)

    Notes
    -----
    Rows G change the covariance C to C - C Gᵀ (1 + G C Gᵀ)⁻¹ G C (Woodbury).

    Examples
    --------
    >>> one = Information(np.eye(2), np.ones(1), np.array([[1.0, 0.0]]), np.ones(2, bool),
    ...                   np.full(2, -np.inf), np.full(2, np.inf))
    >>> scores(one, np.array([[[0.0, 9.0]], [[np.sqrt(3.0), 0.0]]])).round(6).tolist()
    [1.0, 0.5]
    """
    covariance = information.spread.covariance
    moved = candidates @ covariance
    inner = np.eye(candidates.shape[1]) + moved @ np.swapaxes(candidates, 1, 2)
    if volume:
        at = np.flatnonzero(information.asked)
        unit = np.sqrt(np.diagonal(covariance)[at])
        gain = np.swapaxes(moved[..., at], 1, 2) @ np.linalg.solve(inner, moved[..., at])
        return np.linalg.slogdet((covariance[np.ix_(at, at)] - gain) / np.outer(unit, unit))[1]
    slope = information.slope / information.value[:, None]
    change = moved @ slope.T
    before = np.einsum("ij,jk,ik->", slope, covariance, slope)
    gain = np.einsum("cij,cij->c", change, np.linalg.solve(inner, change))
    return np.sqrt(np.maximum(before - gain, 0.0))


def greedy(
    information: Information, candidates: np.ndarray, volume: bool = False
) -> Iterator[Choice]:
    """Yield candidates without end, each the best one after those chosen before.

    Parameters
    ----------
    information, candidates, volume
        As for `scores`.

    Yields
    ------
    Choice

    Notes
    -----
    D-optimality of a set chosen so is at least (1 - 1/e) of the best set's gain (submodularity of
    the log-determinant; Nemhauser, Wolsey, Fisher, Math. Programming 14, 265 (1978)).

    Examples
    --------
    >>> one = Information(np.eye(2), np.ones(2), np.eye(2), np.ones(2, bool),
    ...                   np.full(2, -np.inf), np.full(2, np.inf))
    >>> steps = greedy(one, np.array([[[2.0, 0.0]], [[0.0, 1.0]]]))
    >>> [next(steps).index for _ in range(3)]
    [0, 1, 1]
    """
    none = np.zeros((1, *candidates.shape[1:]))
    while True:
        [before] = scores(information, none, volume)
        after = scores(information, candidates, volume)
        best = int(np.argmin(after))
        information = information.with_rows(candidates[best])
        yield Choice(best, float(1.0 - after[best] / before), information)
