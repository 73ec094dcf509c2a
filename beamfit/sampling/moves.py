"""Moves of walkers: long moves from a fitted proposal, steps along differences of walkers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import gammaln

# Degrees of freedom that are tried for a proposal, from heavy tails to nearly normal.
DEGREES = (4.0, 6.0, 10.0, 30.0)


class Widening(NamedTuple):
    """Widening of numbers in proportion to an inferred noise: twice the noise, twice as wide.

    Attributes
    ----------
    centre : array, shape (n,)
        Origin of the distances, the logarithm of the noise included.
    noise_index : array of int, shape (n,)
        Index of the logarithm of the noise that widens each number; -1 for none.
    """

    centre: np.ndarray
    noise_index: np.ndarray

    def log_factors(self, points: np.ndarray) -> np.ndarray:
        """Compute the log of each number's width relative to that at the centre, shape (m, n)."""
        logs = points[:, self.noise_index] - self.centre[self.noise_index]
        return np.where(self.noise_index < 0, 0.0, logs)

    def to_scaled(self, points: np.ndarray) -> np.ndarray:
        """Convert points to distances divided by their widening, shape (m, n)."""
        return (points - self.centre) * np.exp(-self.log_factors(points))

    def from_scaled(self, scaled: np.ndarray) -> np.ndarray:
        """Invert `to_scaled`; the logarithms of the noise themselves are not widened."""
        logs = np.where(self.noise_index < 0, 0.0, scaled[:, self.noise_index])
        return self.centre + scaled * np.exp(logs)


@dataclass(frozen=True, eq=False)
class Student:
    """A multivariate Student distribution.

    Parameters
    ----------
    location : array, shape (n,)
        Centre.
    root : array, shape (n, n)
        Cholesky factor L (lower triangle); the scale matrix is L Lᵀ.
    degrees : float
        Degrees of freedom.

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
        """Compute the log density at points of shape (m, n)."""
        distance = (points - self.location) @ self._inverse.T
        squares = np.einsum("ij,ij->i", distance, distance)
        power = 0.5 * (self.degrees + len(self.location))
        return self._norm - power * np.log1p(squares / self.degrees)


@dataclass(frozen=True, eq=False)
class IndependenceProposal:
    """Proposal of long moves, independent of the walker's present place.

    With `emcee.moves.MHMove` it makes an independence sampler (L. Tierney, Annals of Statistics 22,
    1701 (1994), section 2.3): exact for any proposal, and fast if this is close to the posterior.

    Parameters
    ----------
    widening : Widening
        Scaling of the distances in which the parts are Student distributions.
    blocks : tuple of array of int
        Indices of the numbers of each part; each number is in one block.
    parts : tuple of Student
        Independent distributions, so that one heavy tail does not make all tails heavy.

    Examples
    --------
    >>> plain = Widening(np.zeros(2), np.array([-1, -1]))
    >>> leap = proposal_about(np.eye(2), plain, (np.array([0, 1]),))
    >>> new, log_ratio = leap(np.zeros((4, 2)), np.random.RandomState(0))
    >>> new.shape, bool((log_ratio > 0).all())  # all moves from the centre go outwards
    ((4, 2), True)
    """

    widening: Widening
    blocks: tuple[np.ndarray, ...]
    parts: tuple[Student, ...]

    def draw(self, random: np.random.RandomState, number: int) -> np.ndarray:
        """Draw points, shape (number, n)."""
        scaled = np.empty((number, len(self.widening.centre)))
        for block, part in zip(self.blocks, self.parts, strict=True):
            scaled[:, block] = part.draw(random, number)
        return self.widening.from_scaled(scaled)

    def log_density(self, points: np.ndarray) -> np.ndarray:
        """Compute the log density at points of shape (m, n)."""
        logs = self.widening.log_factors(points)
        scaled = (points - self.widening.centre) * np.exp(-logs)
        pairs = zip(self.blocks, self.parts, strict=True)
        found = sum(part.log_density(scaled[:, block]) for block, part in pairs)
        return found - logs.sum(axis=1)

    def __call__(
        self, coords: np.ndarray, random: np.random.RandomState
    ) -> tuple[np.ndarray, np.ndarray]:
        """Propose new points; also return log q(old)/q(new) for Metropolis-Hastings."""
        new = self.draw(random, len(coords))
        return new, self.log_density(coords) - self.log_density(new)


def _root(covariance: np.ndarray) -> np.ndarray:
    """Compute the Cholesky factor, of the correlations first: variances differ by up to 1e20."""
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


def proposal_about(
    covariance: np.ndarray, widening: Widening, blocks: tuple[np.ndarray, ...], degrees: float = 5.0
) -> IndependenceProposal:
    """Make a proposal about a centre with the covariance of a fit.

    Parameters
    ----------
    covariance : array, shape (n, n)
        Covariance; the diagonal blocks are used.
    widening, blocks
        As for `IndependenceProposal`.
    degrees : float
        Degrees of freedom.

    Returns
    -------
    IndependenceProposal
    """
    parts = (
        Student(np.zeros(len(block)), _root(covariance[np.ix_(block, block)]), degrees)
        for block in blocks
    )
    return IndependenceProposal(widening, blocks, tuple(parts))


def fit_proposal(points: np.ndarray, before: IndependenceProposal) -> IndependenceProposal:
    """Fit a proposal to draws from a posterior.

    Parameters
    ----------
    points : array, shape (m, n)
        Draws.
    before : IndependenceProposal
        Proposal with the widening and the blocks, which are kept.

    Returns
    -------
    IndependenceProposal
        Each part has the draws' mean and covariance, and the degrees of freedom of the highest
        likelihood among `DEGREES`.

    Examples
    --------
    >>> draws = np.random.RandomState(0).standard_normal((4000, 2))
    >>> plain = Widening(np.zeros(2), np.array([-1, -1]))
    >>> fit_proposal(draws, proposal_about(np.eye(2), plain, (np.array([0, 1]),))).parts[0].degrees
    30.0
    """
    scaled = before.widening.to_scaled(points)
    parts = tuple(_fit_student(scaled[:, block]) for block in before.blocks)
    return IndependenceProposal(before.widening, before.blocks, parts)


def _fit_student(points: np.ndarray) -> Student:
    location, covariance = points.mean(axis=0), np.atleast_2d(np.cov(points, rowvar=False))
    # The covariance of a Student distribution is dof/(dof - 2) times its scale matrix.
    tried = [Student(location, _root(covariance * (dof - 2) / dof), dof) for dof in DEGREES]
    return max(tried, key=lambda part: float(np.mean(part.log_density(points))))


def long_move_share(
    proposal: IndependenceProposal,
    points: np.ndarray,
    log_prob: np.ndarray,
    drawn: np.ndarray,
    found: np.ndarray,
) -> float:
    """Choose the share of long moves from the share that would be accepted.

    Parameters
    ----------
    proposal : IndependenceProposal
        The proposal to use.
    points, log_prob : array, shape (m, n) and (m,)
        Draws from the posterior and their log density.
    drawn, found : array, shape (k, n) and (k,)
        Draws from the proposal, and their posterior log density.

    Returns
    -------
    float
        0.9, 0.5 or 0.1. A long move that is accepted once in seven times is still worth more than
        several steps.
    """
    take = np.linspace(0, len(points) - 1, len(drawn)).astype(int)
    log_ratio_now = log_prob[take] - proposal.log_density(points[take])
    log_ratio_new = found - proposal.log_density(drawn)
    accepted = float(np.mean(np.exp(np.minimum(log_ratio_new - log_ratio_now, 0.0))))
    return 0.9 if accepted > 0.15 else (0.5 if accepted > 0.03 else 0.1)


def mix_moves(proposal: IndependenceProposal, share: float) -> list[tuple[Any, float]]:
    """List the moves of emcee with their shares.

    Parameters
    ----------
    proposal : IndependenceProposal
        Proposal of the long moves.
    share : float
        Share of long moves.

    Returns
    -------
    list of (move, float)
        The long moves; differential evolution (B. Nelson, E. Ford and M. Payne, ApJS 210, 11
        (2014)), partly by whole distances between walkers, for separate peaks; and the stretch move
        (J. Goodman and J. Weare, CAMCoS 5, 65 (2010)). The last two need no fitted proposal and
        explore curved ridges and edges, where long moves rarely land.
    """
    from emcee import moves  # takes half a second, needed only here

    rest = 1.0 - share
    return [
        (moves.MHMove(proposal), share),
        (moves.DEMove(1e-2), 0.6 * rest),
        (moves.DEMove(1e-2, gamma0=1.0), 0.2 * rest),
        (moves.StretchMove(), 0.2 * rest),
    ]
