"""Errors with a memory: readings whose errors are correlated as exp(-time/correlation time).

Of evenly spaced readings this is an autoregressive process of first order; uneven ones need no
more. Whitening takes off each error what the one before foretells, in O(n).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg.lapack import dpttrf, dtbtrs

# Correlation of neighbouring residuals, in standard errors of that of independent ones, from which
# they count as correlated.
SEEN = 2.0
# White variances beside a memory that are looked at, over what the part with a memory gains from
# one reading to the next: a monitor that walks by a third of its noise a reading has 10.
BESIDE = (0.0, 1.0, 10.0, 100.0, 1000.0)
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
    """Tell if residuals lie closer to their neighbours than independent ones would.

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
    """Tell if residuals, or their means over some neighbours, are correlated, these by `slow`.

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


class CorrelatedNoise(NamedTuple):
    """Correlation time of the part that wanders, and the share of variance without memory."""

    time: float
    white: float = 0.0


@jax.jit  # a scan that is called as it is would be compiled at every call
def innovations(
    rows: jax.Array, time: jax.Array, noise: CorrelatedNoise
) -> tuple[jax.Array, jax.Array]:
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
    rows: np.ndarray, interval: np.ndarray, noise: CorrelatedNoise
) -> tuple[np.ndarray, float]:
    """Rows as those with independent errors of the same size, and the log of the volume.

    With W of `whitened`, the covariance of both parts of the noise is that of W⁻¹ T W⁻ᵀ with
    T = (1 - white) 1 + white W Wᵀ, of three diagonals: its Cholesky factor ends the work, in O(n).

    Examples
    --------
    >>> noise = CorrelatedNoise(1.0, 1.0)
    >>> both, volume = whitened_of_both(np.array([1.0, 2.0]), np.array([1.0]), noise)
    >>> both.round(9).tolist(), round(volume, 9) + 0.0
    ([1.0, 2.0], 0.0)
    """
    apart = interval / noise.time
    rows, volume = whitened(rows, apart, np), float(log_volume(apart, np))
    if not noise.white:
        return rows, volume
    rows, more = white_beside(rows, apart, noise.white)
    return rows, volume + more


def white_shares(apart, ratios=BESIDE) -> np.ndarray:
    """Shares of variance without memory, from ratios to what the memory's part gains in a time.

    Parameters
    ----------
    apart : array, shape (t,)
        The time over each correlation time.
    ratios : array, shape (r,)
        White variances, in units of the gain.

    Returns
    -------
    array, shape (t, r)

    Examples
    --------
    >>> white_shares([np.log(2.0)], [0.0, 1.0]).round(6).tolist()
    [[0.0, 0.428571]]
    """
    white = np.outer(-np.expm1(-2.0 * np.asarray(apart)), ratios)
    return white / (1.0 + white)


def beside(apart: np.ndarray, white: float) -> tuple[np.ndarray, np.ndarray]:
    """Diagonals D and l of T = L D Lᵀ, of `whitened_of_both`: L has ones and l."""
    kept, new = np.exp(-apart), np.sqrt(-np.expm1(-2 * apart))
    own, before = np.append(1.0, 1.0 / new), np.append(0.0, -kept / new)
    diagonal = 1.0 - white + white * (own**2 + before**2)
    return dpttrf(diagonal, white * before[1:] * own[:-1])[:2]


def white_beside(rows: np.ndarray, apart: np.ndarray, white: float) -> tuple[np.ndarray, float]:
    """Rows that are whitened for a memory alone as whitened for a white share beside it."""
    size, next_ = beside(apart, white)
    factor = np.stack([np.ones_like(size), np.append(next_, 0.0)])
    solved = dtbtrs(factor, rows.reshape(len(rows), -1), uplo="L", diag="U")[0]
    solved /= np.sqrt(size)[:, None]
    return solved.reshape(rows.shape), -0.5 * float(np.sum(np.log(size)))


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

    def left(self, rows: np.ndarray) -> np.ndarray:
        """Rows less what the levels can explain, in independent noise.

        Done twice, for what rounding leaves of the first time.
        """
        squares = np.add.reduceat(self.slope**2, self.first)
        lengths = np.diff(self.first, append=len(rows))
        for _ in range(2):
            found = np.add.reduceat(self.slope[:, None] * rows, self.first) / squares[:, None]
            rows = rows - self.slope[:, None] * np.repeat(found, lengths, axis=0)
        return rows


@jax.jit
def levelled(
    rows: jax.Array, time: jax.Array, begins: jax.Array, slope: jax.Array, noise: CorrelatedNoise
) -> tuple[jax.Array, jax.Array]:
    """Rows without levels, whitened as by `innovations`; and log sum of the errors.

    Parameters
    ----------
    rows : array, shape (n, p)
        Residuals and their slopes, which the noise of the readings is beside.
    time : array, shape (n,)
        When. Noise goes on from block to block; rows at the time of the one before are padding.
    begins : array of bool, shape (n,)
        Where a block begins, of whose level nothing is known.
    slope : array, shape (n,)
        As of `Levels`, which are all free: their density is flat.
    noise : CorrelatedNoise
        Of the readings.

    Notes
    -----
    The filter has the level as a second state. The first row of a block says what the level is,
    and no more: a diffuse start (A. C. Harvey, 1989, section 3.3.4).
    """
    interval = jnp.diff(time, append=time[-1:])
    kept, wander = jnp.exp(-interval / noise.time), 1.0 - noise.white
    used = jnp.append(True, interval[:-1] > 0)

    def on(carry, now):
        (value, level), (own, both, whole) = carry
        row, k, begin, s, counts = now
        size = jnp.where(begin, 1.0, own + 2 * s * both + s**2 * whole + noise.white)
        surprise = row - value - s * level
        gains = (own + s * both) / size, (both + s * whole) / size
        gains = jnp.where(begin, 0.0, gains[0]), jnp.where(begin, 1.0 / s, gains[1])
        value, level = value + gains[0] * surprise, level + gains[1] * surprise
        known = own - gains[0] * (own + s * both), both - gains[1] * (own + s * both)
        known += (whole - gains[1] * (both + s * whole),)
        fresh = own, -own / s, (own + noise.white) / s**2
        own, both, whole = (jnp.where(begin, f, g) for f, g in zip(fresh, known, strict=True))
        carry = (k * value, level), (k**2 * own + wander * (1.0 - k**2), k * both, whole)
        tells = counts & ~begin
        return carry, (jnp.where(tells, surprise / jnp.sqrt(size), 0.0),
                       jnp.where(tells, 0.5 * jnp.log(size), 0.0))  # fmt: skip

    nothing = jnp.zeros(rows.shape[1])
    start = (nothing, nothing), (jnp.asarray(wander), jnp.zeros(()), jnp.zeros(()))
    _, (white, sizes) = jax.lax.scan(on, start, (rows, kept, begins, slope, used))
    return white, jnp.sum(sizes)
