"""How walkers move: leaps informed by the fit, steps along differences between walkers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import gammaln, logsumexp

__all__ = ["Student", "fitted", "moves_of", "share_of", "student_about"]

# Degrees of freedom tried: from tails that cover anything to a normal distribution in effect.
DEGREES = (3.0, 5.0, 10.0, 30.0, 1e4)


@dataclass(frozen=True, eq=False)
class Student:
    """A multivariate Student distribution to leap with, whatever the place one leaps from.

    As a proposal of `emcee.moves.MHMove` it makes an independence sampler (L. Tierney, Annals of
    Statistics 22, 1701 (1994), section 2.3): exact whatever the proposal, fast where it is near
    the posterior.

    Parameters
    ----------
    location : array, shape (n,)
        Centre.
    root : array, shape (n, n)
        Lower triangle L; the scale matrix is L Lᵀ.
    degrees : float
        Of freedom.

    Examples
    --------
    >>> t = Student(np.zeros(1), np.eye(1), 5.0)
    >>> t.draw(np.random.RandomState(1), 3).shape, t.log_density(np.zeros((1, 1))).round(4)
    ((3, 1), array([-0.9686]))
    """

    location: np.ndarray
    root: np.ndarray
    degrees: float

    def draw(self, random: np.random.RandomState, number: int) -> np.ndarray:
        """Draw points, shape (number, n)."""
        normal = random.standard_normal((number, len(self.location)))
        wide = np.sqrt(self.degrees / random.chisquare(self.degrees, (number, 1)))
        return self.location + (wide * normal) @ self.root.T

    @cached_property
    def _inverse(self) -> np.ndarray:
        return solve_triangular(self.root, np.eye(len(self.location)), lower=True)

    @cached_property
    def _norm(self) -> float:
        n, dof = len(self.location), self.degrees
        norm = gammaln(0.5 * (dof + n)) - gammaln(0.5 * dof) - 0.5 * n * np.log(dof * np.pi)
        return norm - float(np.sum(np.log(np.diag(self.root))))

    def log_density(self, points: np.ndarray) -> np.ndarray:
        """Log density at points of shape (m, n)."""
        off = (points - self.location) @ self._inverse.T
        squares = np.einsum("ij,ij->i", off, off)
        power = 0.5 * (self.degrees + len(self.location))
        return self._norm - power * np.log1p(squares / self.degrees)

    def __call__(
        self, coords: np.ndarray, random: np.random.RandomState
    ) -> tuple[np.ndarray, np.ndarray]:
        """Propose new points, and the log of q(old)/q(new) of Metropolis and Hastings."""
        new = self.draw(random, len(coords))
        return new, self.log_density(coords) - self.log_density(new)


def _root(covariance: np.ndarray) -> np.ndarray:
    """Lower triangle of a covariance, of unit columns first: its numbers differ by 1e20."""
    scale = np.sqrt(np.diag(covariance))
    scale = np.where(scale > 0, scale, 1.0)
    inner = covariance / scale / scale[:, None]
    inner = 0.5 * (inner + inner.T)
    for power in range(-15, 0):
        try:
            return scale[:, None] * np.linalg.cholesky(inner + 10.0**power * np.eye(len(scale)))
        except np.linalg.LinAlgError:
            continue
    return np.diag(scale)


def student_about(location: np.ndarray, covariance: np.ndarray, degrees: float = 5.0) -> Student:
    """Make a Student distribution of a location and the covariance of a fit.

    Examples
    --------
    >>> student_about(np.zeros(2), np.array([[4.0, 0.0], [0.0, 1.0]])).root.round(3).tolist()
    [[2.0, 0.0], [0.0, 1.0]]
    """
    return Student(np.asarray(location, float), _root(covariance), degrees)


def fitted(points: np.ndarray, log_prob: np.ndarray) -> Student:
    """Fit a Student distribution to draws from a posterior.

    Parameters
    ----------
    points : array, shape (m, n)
        Draws.
    log_prob : array, shape (m,)
        Log of their posterior density.

    Returns
    -------
    Student
        With the draws' mean and covariance and, of a few degrees of freedom, those for which the
        ratio w of posterior to proposal varies least, by the mean of w times that of 1/w: walkers
        stick where w is large, in tails that the proposal does not reach.

    Examples
    --------
    >>> draws = np.random.RandomState(0).standard_normal((4000, 2))
    >>> fitted(draws, -0.5 * np.sum(draws**2, axis=1)).degrees > 20
    True
    """
    location, covariance = points.mean(axis=0), np.atleast_2d(np.cov(points, rowvar=False))
    # A Student distribution is wider than its scale matrix by dof/(dof - 2).
    tried = [
        student_about(location, covariance * max((dof - 2) / dof, 0.5), dof) for dof in DEGREES
    ]

    def uneven(proposal: Student) -> float:
        ratio = log_prob - proposal.log_density(points)
        return float(logsumexp(ratio) + logsumexp(-ratio))

    return min(tried, key=uneven)


def share_of(
    proposal: Student, points: np.ndarray, log_prob: np.ndarray, drawn: np.ndarray, found: np.ndarray
) -> float:
    """Share of steps to leap: the more leaps are accepted, the more are tried.

    Parameters
    ----------
    proposal : Student
        To be used.
    points, log_prob : array, shape (m, n) and (m,)
        Draws from the posterior.
    drawn, found : array, shape (k, n) and (k,)
        Draws from the proposal, and their posterior log density.

    Returns
    -------
    float
        0.9, 0.5 or 0.1: a leap that is taken once in seven times is still worth more than steps.
    """
    take = np.linspace(0, len(points) - 1, len(drawn)).astype(int)
    now = log_prob[take] - proposal.log_density(points[take])
    then = found - proposal.log_density(drawn)
    accepted = float(np.mean(np.exp(np.minimum(then - now, 0.0))))
    return 0.9 if accepted > 0.15 else (0.5 if accepted > 0.03 else 0.1)


def moves_of(proposal: Student, share: float) -> list[tuple[Any, float]]:
    """Mix moves for emcee.

    Parameters
    ----------
    proposal : Student
        For the leaps.
    share : float
        Of steps that leap.

    Returns
    -------
    list of (move, float)
        The leaps; differential evolution (B. Nelson, E. Ford and M. Payne, ApJS 210, 11 (2014)),
        some of it by whole distances between walkers, for separate peaks; and the stretch move
        (J. Goodman and J. Weare, CAMCoS 5, 65 (2010)). The last two need no fit, and keep bananas
        and edges right where the leaps would seldom land.
    """
    from emcee import moves  # half a second that only sampling should cost

    rest = 1.0 - share
    return [
        (moves.MHMove(proposal), share),
        (moves.DEMove(1e-2), 0.6 * rest),
        (moves.DEMove(1e-2, gamma0=1.0), 0.2 * rest),
        (moves.StretchMove(), 0.2 * rest),
    ]
