"""Errors with a memory: readings whose errors are correlated as exp(-time/correlation time).

Of evenly spaced readings this is an autoregressive process of first order; uneven ones need no
more. Whitening takes off each error what the one before foretells, in O(n).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.linalg.lapack import dtbtrs
from scipy.special import stdtr

# Correlation of neighbouring residuals, in standard errors of that of independent ones, from which
# they count as correlated.
SEEN = 2.0
# Correlation times looked at: from this share of the usual interval to so many times the record.
SHORTEST, LONGEST, TIMES = 0.3, 5.0, 40
# Variances of a part without memory that are looked at beside, in those that the part with a
# memory gets anew from one reading to the next; correlation times are fewer then.
WHITE, FEWER = (0.0, 1.0, 10.0, 100.0, 1000.0), 20
# Means of so many neighbours are looked at: a slow drift hides under white noise.
BLOCKS = (4, 16)


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


def is_correlated(residuals: np.ndarray, parameters: int, seen: float = SEEN) -> bool:
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
    return bool(found > seen / np.sqrt(count))


def remembers(residuals: np.ndarray, parameters: int, slow: float = SEEN) -> bool:
    """Whether residuals, or their means over some neighbours, are correlated, these by `slow`.

    Examples
    --------
    >>> slow = 0.3 * np.sin(np.arange(400) / 60) + np.random.default_rng(0).normal(size=400)
    >>> is_correlated(slow, 0), remembers(slow, 0)
    (False, True)
    """
    if is_correlated(residuals, parameters):
        return True
    means = [residuals[: len(residuals) // k * k].reshape(-1, k).mean(axis=1) for k in BLOCKS]
    return any(is_correlated(m, parameters, slow) for m in means if len(m) > 2 * parameters)


class Noise(NamedTuple):
    """Correlation time of the part that wanders, and the share of variance without memory."""

    time: float
    white: float = 0.0


@jax.jit  # a scan that is called as it is would be compiled at every call
def innovations(rows: jax.Array, time: jax.Array, noise: Noise) -> tuple[jax.Array, jax.Array]:
    """Rows less what those before foretell, over the error of that; and log sum of the errors.

    The Kalman filter of an Ornstein-Uhlenbeck process read with white noise (A. C. Harvey,
    Forecasting, structural time series models and the Kalman filter, 1989, section 3.4), O(n).
    """
    wander = 1.0 - noise.white
    kept = jnp.exp(-jnp.diff(time, append=time[-1:]) / noise.time)

    def on(carry, now):
        mean, variance = carry
        row, k = now
        whole = variance + noise.white
        surprise = row - mean
        mean = k * (mean + variance / whole * surprise)
        variance = k**2 * variance * noise.white / whole + wander * (1.0 - k**2)
        return (mean, variance), (surprise / jnp.sqrt(whole), 0.5 * jnp.log(whole))

    begin = jnp.zeros(rows.shape[1:]), jnp.asarray(wander)
    _, (white, sizes) = jax.lax.scan(on, begin, (rows, kept))
    return white, jnp.sum(sizes)


def whitened_of_both(
    rows: np.ndarray, interval: np.ndarray, noise: Noise
) -> tuple[np.ndarray, float]:
    """Rows as those with independent errors of the same size, and the log of the volume.

    With W of `whitened`, the covariance of both parts of the noise is that of W⁻¹ T W⁻ᵀ with
    T = (1 - white) 1 + white W Wᵀ, of three diagonals: its Cholesky factor ends the work, in O(n).

    Examples
    --------
    >>> both, volume = whitened_of_both(np.array([1.0, 2.0]), np.array([1.0]), Noise(1.0, 1.0))
    >>> both.round(9).tolist(), round(volume, 9) + 0.0
    ([1.0, 2.0], 0.0)
    """
    apart = interval / noise.time
    rows, volume = whitened(rows, apart, np), float(log_volume(apart, np))
    if not noise.white:
        return rows, volume
    kept, new = np.exp(-apart), np.sqrt(-np.expm1(-2 * apart))
    own, before = np.append(1.0, 1.0 / new), np.append(0.0, -kept / new)
    matrix = np.zeros((2, len(rows)))
    matrix[0] = 1.0 - noise.white + noise.white * (own**2 + before**2)
    matrix[1, :-1] = noise.white * before[1:] * own[:-1]
    factor = cholesky_banded(matrix, lower=True)
    solved = dtbtrs(factor, rows.reshape(len(rows), -1), uplo="L")[0]
    return solved.reshape(rows.shape), volume - float(np.sum(np.log(factor[0])))


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
    time, white : array, shape (g,)
        The correlation times, and the shares of variance without memory.
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
    white: np.ndarray
    step: np.ndarray
    half: np.ndarray
    squares: np.ndarray
    dof: int

    @property
    def likely(self) -> int:
        """Index of the median correlation time, and of the share that is likeliest with it."""
        median = self.time[np.searchsorted(np.cumsum(self.weight), 0.5)]
        return int(np.argmax(np.where(self.time == median, self.weight, -1.0)))

    @property
    def noise(self) -> Noise:
        """That."""
        return Noise(float(self.time[self.likely]), float(self.white[self.likely]))

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
    0.3 usual intervals to five times the record. Without levels a part of the noise may be white: a
    monitor that drifts, read by a noisy converter, would pass for a short memory otherwise, and its
    errors come out several times too small; the ratio of both is averaged over, too, at even odds
    that there is one. Near the upper end the errors are a random walk: nothing tells its level, but
    slope and bend the rows do tell.

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
    looked_at = (FEWER, WHITE) if levels is None else (TIMES,)
    usual = float(np.median(interval))
    grid = noises(range_of(time), usual, *looked_at) if known is None else [Noise(known)]
    with np.errstate(divide="ignore"):
        found = [_at(rows, interval, each, levels) for each in grid]
    count -= 0 if levels is None else levels.first.size
    logs, step, half, squares = (np.array(part) for part in zip(*found, strict=True))
    times, white = np.array(grid).T
    # Even odds for a white part.
    weight = np.exp(logs - logs.max()) * np.where(white == 0, 1.0, 1.0 / (len(WHITE) - 1))
    return Memory(weight / weight.sum(), times, white, step, half, squares, count - p)


def noises(
    ends: tuple[float, float], usual: float, count: int, ratios: Sequence[float] = (0.0,)
) -> list[Noise]:
    """Noises that are looked at: correlation times between two, and with each the ratios of the
    white variance to what the part with a memory gets anew in a usual interval.

    Examples
    --------
    >>> noises((1.0, 4.0), 1.0, 3)
    [Noise(time=1.0, white=0.0), Noise(time=2.0, white=0.0), Noise(time=4.0, white=0.0)]
    """
    return [
        Noise(float(each), float(ratio / (ratio + 1.0 / -np.expm1(-2.0 * usual / each))))
        for each in np.geomspace(*ends, count)
        for ratio in ratios
    ]


def _at(
    rows: np.ndarray, interval: np.ndarray, noise: Noise, levels: Levels | None
) -> tuple[float, np.ndarray, np.ndarray, float]:
    """Log probability, step, half and squares for one noise."""
    count, beside = len(rows), 0.0
    white, volume = whitened_of_both(rows, interval, noise)
    if levels is not None:
        white, beside = levels.left(white, interval / noise.time)
        count -= levels.first.size
    factor = np.linalg.qr(white, mode="r")
    p = rows.shape[1] - 1
    half = np.linalg.inv(factor[:p, :p])
    squares = max(float(factor[p, p] ** 2), 1e-300)
    log = volume - beside - np.sum(np.log(np.abs(np.diag(factor)[:p])))
    log -= 0.5 * (count - p) * np.log(squares)
    return log, -half @ factor[:p, p], half, squares
