"""Errors with a memory: readings whose errors are correlated as exp(-time/correlation time).

Of evenly spaced readings this is an autoregressive process of first order; uneven ones need no
more. Whitening takes off each error what the one before foretells, in O(n).
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.special import stdtr

# Correlation of neighbouring residuals, in standard errors of that of independent ones, from which
# they count as correlated.
SEEN = 2.0
# Correlation times looked at: from this share of the usual interval to so many times the record.
SHORTEST, LONGEST, TIMES = 0.3, 5.0, 40


def whitened(rows, apart, xp=jnp):
    """Rows of values with correlated errors as rows with independent errors of the same size.

    Parameters
    ----------
    rows : array, shape (n, ...)
        One row for each value.
    apart : array, shape (n - 1,)
        Time between neighbours over the correlation time, positive.

    Returns
    -------
    array, shape (n, ...)
        r[0], then (r[k] - c r[k-1])/sqrt(1 - c²) with c = exp(-apart[k-1]).

    Notes
    -----
    The inverse of the Cholesky factor of the correlation matrix exp(-|t_j - t_k|/time), which has
    two diagonals: D. T. Gillespie, Phys. Rev. E 54 (1996) 2084, eq. 1.9a, read backwards.

    Examples
    --------
    >>> whitened(np.array([1.0, 2.0, 2.0]), np.log([2.0, 2.0]), np).round(4).tolist()
    [1.0, 1.7321, 1.1547]
    """
    shape = (-1,) + (1,) * (rows.ndim - 1)
    kept = xp.exp(-apart).reshape(shape)
    new = xp.sqrt(-xp.expm1(-2 * apart)).reshape(shape)
    return xp.concatenate([rows[:1], (rows[1:] - kept * rows[:-1]) / new])


def log_volume(apart, xp=jnp):
    """Logarithm of the density's normalisation, whitened over not: -sum ln sqrt(1 - c²)."""
    return -0.5 * xp.sum(xp.log(-xp.expm1(-2 * apart)))


def is_correlated(residuals: np.ndarray, parameters: int) -> bool:
    """Whether residuals lie closer to their neighbours than independent ones would.

    The mean correlation of residuals of independent errors is -parameters/n.

    Examples
    --------
    >>> is_correlated(np.sin(np.arange(50.0) / 4), 3), is_correlated(np.cos(9 * np.arange(50)), 3)
    (True, False)
    """
    squares, count = float(residuals @ residuals), residuals.size
    if squares == 0:
        return False
    found = float(residuals[1:] @ residuals[:-1]) / squares + parameters / count
    return bool(found > SEEN / np.sqrt(count))


class Levels(NamedTuple):
    """Numbers of which each moves the rows of one block alone: a level for every cycle.

    Attributes
    ----------
    first : array of int, shape (k,)
        Where each block begins; the first at row 0.
    slope : array, shape (n,)
        Derivative of each residual by the number of its block.
    """

    first: np.ndarray
    slope: np.ndarray

    def left(self, rows: np.ndarray, apart: np.ndarray) -> tuple[np.ndarray, float]:
        """Whitened rows less what the levels can explain, and half the log of the levels' matrix.

        Whitening carries the last row of a block into the first of the next, so the matrix has
        three diagonals: O(n). Done twice, for what rounding leaves of the first time.
        """
        kept, new, begins = np.exp(-apart), np.sqrt(-np.expm1(-2 * apart)), self.first[1:]
        own = np.append(self.slope[:1], (self.slope[1:] - kept * self.slope[:-1]) / new)
        own[begins] = self.slope[begins] / new[begins - 1]
        carried = -(kept * self.slope[:-1] / new)[begins - 1]
        matrix = np.zeros((2, self.first.size))
        matrix[1] = np.add.reduceat(own**2, self.first)
        matrix[1, :-1] += carried**2
        matrix[0, 1:] = carried * own[begins]
        factor = cholesky_banded(matrix)
        lengths = np.diff(self.first, append=len(rows))
        for _ in range(2):
            moment = np.add.reduceat(own[:, None] * rows, self.first)
            moment[:-1] += carried[:, None] * rows[begins]
            found = cho_solve_banded((factor, False), moment)
            rows = rows - own[:, None] * np.repeat(found, lengths, axis=0)
            rows[begins] -= carried[:, None] * found[:-1]
        return rows, float(np.sum(np.log(factor[1])))


class Moments(NamedTuple):
    """Quantities that are linear in the numbers: how far each moves from where the rows were
    taken, its error (68 % lie within), the reach within which 95 % lie, and the chance of a
    larger distance from zero movement if that is the truth.
    """

    shift: np.ndarray
    error: np.ndarray
    reach: np.ndarray
    chance: np.ndarray


class Memory(NamedTuple):
    """What rows of slopes and residuals say of the correlation time of their errors.

    Attributes
    ----------
    weight : array, shape (g,)
        Probability of each correlation time.
    time : array, shape (g,)
        The correlation times.
    step : array, shape (g, p)
        Generalised least-squares step of the numbers at each.
    half : array, shape (g, p, p)
        half @ half.T is the covariance of the numbers for errors of size 1.
    squares : array, shape (g,)
        Sum of squares of the whitened residuals after the step.
    dof : int
        Values less numbers.
    """

    weight: np.ndarray
    time: np.ndarray
    step: np.ndarray
    half: np.ndarray
    squares: np.ndarray
    dof: int

    @property
    def likely(self) -> int:
        """Index of the median correlation time."""
        return int(np.searchsorted(np.cumsum(self.weight), 0.5))

    @property
    def mean_step(self) -> np.ndarray:
        """The step, averaged over correlation times."""
        return self.weight @ self.step

    def moments(self, slopes: np.ndarray, least: float = 0.0) -> Moments:
        """Quantities by their slopes, shape (q, p), averaged over correlation times.

        `least` is the least size of the errors: 1 where they were given and rows are in their
        unit.
        """
        centre = self.step @ slopes.T
        size = np.maximum(np.sqrt(self.squares / self.dof), least)
        spread = np.linalg.norm(np.einsum("qp,gpr->gqr", slopes, self.half), axis=2)
        spread = np.maximum(spread * size[:, None], 1e-300)
        shift = self.weight @ centre

        def within(reach: np.ndarray) -> np.ndarray:
            ends = [(shift + sign * reach - centre) / spread for sign in (1, -1)]
            return self.weight @ (stdtr(self.dof, ends[0]) - stdtr(self.dof, ends[1]))

        reaches = [_inverted(within, np.max(np.abs(centre - shift) + spread, 0), p)
                   for p in (0.6827, 0.95)]  # fmt: skip
        chance = self.weight @ (2 * stdtr(self.dof, -np.abs(centre) / spread))
        return Moments(shift, *reaches, chance)


def _inverted(within, scale: np.ndarray, probability: float) -> np.ndarray:
    """By bisection: the reach within which so much lies."""
    low, high = np.zeros_like(scale), 100.0 * scale
    for _ in range(50):
        middle = 0.5 * (low + high)
        less = within(middle) < probability
        low, high = np.where(less, middle, low), np.where(less, high, middle)
    return 0.5 * (low + high)


def range_of(time: np.ndarray) -> tuple[float, float]:
    """Correlation times that readings at these times can tell from none and from a random walk."""
    usual = float(np.median(np.diff(time)))
    return SHORTEST * usual, LONGEST * float(time[-1] - time[0])


def memory_of(
    slopes: np.ndarray,
    residuals: np.ndarray,
    time: np.ndarray,
    levels: Levels | None = None,
    known: float | None = None,
) -> Memory:
    """Least squares with correlated errors, averaged over what the residuals leave open of them.

    Parameters
    ----------
    slopes : array, shape (n, p)
        Derivatives of the residuals by the numbers, in units of the errors.
    residuals : array, shape (n,)
        Model less reading, in the same units.
    time : array, shape (n,)
        When each was taken, increasing.
    levels : Levels, optional
        Further numbers, one a block, that are eliminated.
    known : float, optional
        The correlation time; 0 for independent errors. Otherwise it is averaged over.

    Returns
    -------
    Memory

    Notes
    -----
    At each correlation time generalised least squares; its probability is the density of the
    residuals integrated over the numbers (flat) and over the size of the errors (flat in its
    logarithm): the restricted likelihood of D. A. Harville, Biometrika 61 (1974) 383, which the
    fitted numbers do not bias, times a prior flat in the logarithm of the correlation time, from
    0.3 usual intervals to five times the record. Near the upper end the errors are a random walk,
    whose level nothing tells, but whose slope and bend the rows still do.

    Examples
    --------
    >>> noise = np.random.default_rng(3).normal(size=300)
    >>> walk = np.zeros(300)
    >>> for k in range(1, 300):
    ...     walk[k] = 0.8 * walk[k - 1] + 0.6 * noise[k]
    >>> found = memory_of(np.ones((300, 1)), walk - 5.0, np.arange(300.0))
    >>> print(f"{found.mean_step[0]:.1f}, {np.exp(-1 / found.time[found.likely]):.1f}")
    4.9, 0.8
    """
    count, p = slopes.shape
    rows, interval = np.column_stack([slopes, residuals]), np.diff(time)
    times = np.geomspace(*range_of(time), TIMES) if known is None else np.array([known])
    with np.errstate(divide="ignore"):
        found = [_at(rows, interval / each, levels) for each in times]
    count -= 0 if levels is None else levels.first.size
    logs, step, half, squares = (np.array(part) for part in zip(*found, strict=True))
    weight = np.exp(logs - logs.max())
    return Memory(weight / weight.sum(), times, step, half, squares, count - p)


def _at(
    rows: np.ndarray, apart: np.ndarray, levels: Levels | None
) -> tuple[float, np.ndarray, np.ndarray, float]:
    """Log probability, step, half and squares at one correlation time."""
    white, volume, count = whitened(rows, apart, np), 0.0, len(rows)
    if levels is not None:
        white, volume = levels.left(white, apart)
        count -= levels.first.size
    factor = np.linalg.qr(white, mode="r")
    p = rows.shape[1] - 1
    half = np.linalg.inv(factor[:p, :p])
    squares = max(float(factor[p, p] ** 2), 1e-300)
    log = log_volume(apart, np) - volume - np.sum(np.log(np.abs(np.diag(factor)[:p])))
    log -= 0.5 * (count - p) * np.log(squares)
    return log, -half @ factor[:p, p], half, squares
