"""Moves of walkers: leaps informed by the fit, steps along differences between walkers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import gammaln

# Degrees of freedom that are tried, from heavy tails to nearly normal.
DEGREES = (4.0, 6.0, 10.0, 30.0)


class Widening(NamedTuple):
    """Widening of the numbers with an inferred noise: twice the noise, twice as wide.

    Attributes
    ----------
    centre : array, shape (n,)
        From where distances are measured, the logarithm of the noise included.
    source : array of int, shape (n,)
        Place of the logarithm that widens each number; -1 for none.
    """

    centre: np.ndarray
    source: np.ndarray

    def log_factors(self, points: np.ndarray) -> np.ndarray:
        """Log of how much wider than at the centre each number is, shape (m, n)."""
        logs = points[:, self.source] - self.centre[self.source]
        return np.where(self.source < 0, 0.0, logs)

    def evened(self, points: np.ndarray) -> np.ndarray:
        """Points in distances that do not widen, shape (m, n)."""
        return (points - self.centre) * np.exp(-self.log_factors(points))

    def widened(self, evened: np.ndarray) -> np.ndarray:
        """The inverse: a source is widened by nothing, so its own distance is at hand."""
        logs = np.where(self.source < 0, 0.0, evened[:, self.source])
        return self.centre + evened * np.exp(logs)


@dataclass(frozen=True, eq=False)
class Student:
    """A multivariate Student distribution.

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


@dataclass(frozen=True, eq=False)
class IndependenceProposal:
    """Proposal of long moves, independent of the walker's present place.

    As a proposal of `emcee.moves.MHMove` it makes an independence sampler (L. Tierney, Annals of
    Statistics 22, 1701 (1994), section 2.3): exact whatever the proposal, fast where it is near
    the posterior.

    Parameters
    ----------
    widening : Widening
        In which distances the parts are Student distributions.
    blocks : tuple of array of int
        Which numbers each part is for; together all of them, each once.
    parts : tuple of Student
        Independent of each other: one heavy tail should not make all of them heavy.

    Examples
    --------
    >>> plain = Widening(np.zeros(2), np.array([-1, -1]))
    >>> leap = about(np.eye(2), plain, (np.array([0, 1]),))
    >>> new, log_ratio = leap(np.zeros((4, 2)), np.random.RandomState(0))
    >>> new.shape, bool((log_ratio > 0).all())  # from the centre one only leaps outwards
    ((4, 2), True)
    """

    widening: Widening
    blocks: tuple[np.ndarray, ...]
    parts: tuple[Student, ...]

    def draw(self, random: np.random.RandomState, number: int) -> np.ndarray:
        """Draw points, shape (number, n)."""
        evened = np.empty((number, len(self.widening.centre)))
        for block, part in zip(self.blocks, self.parts, strict=True):
            evened[:, block] = part.draw(random, number)
        return self.widening.widened(evened)

    def log_density(self, points: np.ndarray) -> np.ndarray:
        """Log density at points of shape (m, n)."""
        logs = self.widening.log_factors(points)
        evened = (points - self.widening.centre) * np.exp(-logs)
        pairs = zip(self.blocks, self.parts, strict=True)
        found = sum(part.log_density(evened[:, block]) for block, part in pairs)
        return found - logs.sum(axis=1)

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


def about(
    covariance: np.ndarray, widening: Widening, blocks: tuple[np.ndarray, ...], degrees: float = 5.0
) -> IndependenceProposal:
    """Leap about a centre with the covariance of a fit.

    Parameters
    ----------
    covariance : array, shape (n, n)
        Of which each block is used.
    widening, blocks
        As of `IndependenceProposal`.
    degrees : float
        Of freedom.

    Returns
    -------
    IndependenceProposal
    """
    parts = (
        Student(np.zeros(len(block)), _root(covariance[np.ix_(block, block)]), degrees)
        for block in blocks
    )
    return IndependenceProposal(widening, blocks, tuple(parts))


def fitted(points: np.ndarray, before: IndependenceProposal) -> IndependenceProposal:
    """Fit a proposal to draws from a posterior.

    Parameters
    ----------
    points : array, shape (m, n)
        Draws.
    before : IndependenceProposal
        Whose widening and blocks to keep.

    Returns
    -------
    IndependenceProposal
        Each part with the draws' mean and covariance and, of a few degrees of freedom, those of
        the highest likelihood.

    Examples
    --------
    >>> draws = np.random.RandomState(0).standard_normal((4000, 2))
    >>> plain = Widening(np.zeros(2), np.array([-1, -1]))
    >>> fitted(draws, about(np.eye(2), plain, (np.array([0, 1]),))).parts[0].degrees
    30.0
    """
    evened = before.widening.evened(points)
    parts = tuple(_student(evened[:, block]) for block in before.blocks)
    return IndependenceProposal(before.widening, before.blocks, parts)


def _student(points: np.ndarray) -> Student:
    location, covariance = points.mean(axis=0), np.atleast_2d(np.cov(points, rowvar=False))
    # A Student distribution is wider than its scale matrix by dof/(dof - 2).
    tried = [Student(location, _root(covariance * (dof - 2) / dof), dof) for dof in DEGREES]
    return max(tried, key=lambda part: float(np.mean(part.log_density(points))))


def share_of(
    proposal: IndependenceProposal,
    points: np.ndarray,
    log_prob: np.ndarray,
    drawn: np.ndarray,
    found: np.ndarray,
) -> float:
    """Share of steps to leap: the more leaps are accepted, the more are tried.

    Parameters
    ----------
    proposal : IndependenceProposal
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


def moves_of(proposal: IndependenceProposal, share: float) -> list[tuple[Any, float]]:
    """Mix moves for emcee.

    Parameters
    ----------
    proposal : IndependenceProposal
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
