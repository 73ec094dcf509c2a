"""Noise of readings with a memory: white, correlated, 1/f; none is chosen.

Errors may be correlated as exp(-time/correlation time). Of evenly spaced readings this is an
autoregressive process of first order; uneven ones need no more. Whitening takes off each error what
the one before foretells, in O(n). Each noise of a list with prior probabilities whitens the same
columns once; their products are all that a fit needs later, however many readings there are.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import groupby
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.linalg.lapack import dpttrf, dpttrs, dtbtrs
from scipy.special import logsumexp

from beamfit.compile_cache import OPTIMISED, prepare_jax

prepare_jax()
# Correlation of neighbouring residuals, in standard errors of that of independent ones, from which
# they count as correlated.
SEEN = 2.0
# White variances beside a memory that are looked at, over what the part with a memory gains from
# one reading to the next: a monitor that walks by a third of its noise a reading has 10.
BESIDE = (0.0, 1.0, 10.0, 100.0, 1000.0)
# Means of so many neighbours are looked at: a slow drift hides under white noise.
BLOCKS = (4, 16)
# Prior probabilities of white noise, of noise with one correlation time, and of a random walk; 1/f
# noise has the rest. Readings are white unless something slow moves the monitor: amplifiers have
# 1/f noise, and what a changing temperature adds up in a monitor is a walk.
WHITE, CORRELATED, WALK = 0.5, 0.25, 0.1
FLICKER = 1.0 - WHITE - CORRELATED - WALK
# Correlation times, from this share of the interval between readings to so many records, flat in
# the logarithm.
SHORTEST, LONGEST, TIMES = 0.5, 3.0, 17
# Spectra 1/f^power. P. Dutta and P. M. Horn, Rev. Mod. Phys. 53 (1981) 497: 1/f noise of devices
# has powers of 0.8 to 1.4; beyond 1 it is as a random walk.
POWERS = (0.4, 0.7, 1.0)
# A verdict on the size of the noise needs correlation times as close as this many.
CLOSE = 49
# Columns may repeat each other: their products are enlarged by such a share.
SINGULAR = 1e-11
# Stated errors are worth so many readings that tell the size of the noise: right within 25 %.
STATED = 8.0
# The rival to stated errors is a size flat in its logarithm, a factor 30 to either side.
WRONG, SIZES = np.log(30.0), 121


def whitened(rows, apart):
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
    >>> whitened(np.array([1.0, 2.0, 2.0]), np.log([2.0, 2.0])).round(4).tolist()
    [1.0, 1.7321, 1.1547]
    """
    shape = (-1,) + (1,) * (rows.ndim - 1)
    kept = np.exp(-apart).reshape(shape)
    new = np.sqrt(-np.expm1(-2 * apart)).reshape(shape)
    return np.concatenate([rows[:1], (rows[1:] - kept * rows[:-1]) / new])


def log_volume(apart):
    """Logarithm of the density's normalisation, whitened over not: -sum ln sqrt(1 - c²)."""
    return -0.5 * np.sum(np.log(-np.expm1(-2 * apart)))


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


def innovations(
    rows: np.ndarray, time: np.ndarray, noise: CorrelatedNoise
) -> tuple[np.ndarray, float]:
    """Rows less what those before foretell, over the error of that; and log sum of the errors.

    Both by the Cholesky factor of the covariance: W⁻¹ and that of T, as in `products_by_each`.

    Examples
    --------
    >>> innovations(np.ones(3), np.arange(3.0), CorrelatedNoise(1.0, 1.0))[0].tolist()
    [1.0, 1.0, 1.0]
    """
    apart = np.diff(time) / noise.time
    (size, below), begun = _factor(noise.white, *_whitening(apart)), whitened(rows, apart)
    band = np.stack([np.ones_like(size), np.append(below, 0.0)])
    white = dtbtrs(band, begun.reshape(len(begun), -1), uplo="L", diag="U")[0]
    white = white / np.sqrt(size)[:, None]
    volume = 0.5 * float(np.sum(np.log(size))) - float(log_volume(apart))
    return white.reshape(begun.shape), volume


def _whitening(apart: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Diagonals of the matrix of `whitened`: of each row itself and of the one before."""
    new = np.sqrt(-np.expm1(-2 * apart))
    return np.append(1.0, 1.0 / new), np.append(0.0, -np.exp(-apart) / new)


def _factor(white: float, own: np.ndarray, before: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """T of `products_by_each` as L D Lᵀ: D, and what is below the ones of L."""
    diagonal = 1.0 - white + white * (own**2 + before**2)
    return dpttrf(diagonal, white * before[1:] * own[:-1])[:2]


def filtered(rows: jax.Array, time: jax.Array, noise: CorrelatedNoise) -> jax.Array:
    """The innovations in JAX, of rows that a search derives.

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
        return (mean, variance), surprise / jnp.sqrt(whole)

    begin = jnp.zeros(rows.shape[1:]), jnp.asarray(wander)
    return jax.lax.scan(on, begin, (rows, kept))[1]


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


def noises(
    ends: tuple[float, float], usual: float, count: int, ratios: Sequence[float] = (0.0,)
) -> list[CorrelatedNoise]:
    """Noises that are looked at: correlation times between two, and with each the ratios of the
    white variance to what the part with a memory gets anew in a usual interval.

    Examples
    --------
    >>> [noise.time for noise in noises((1.0, 4.0), 1.0, 3)]
    [1.0, 2.0, 4.0]
    """
    times = np.geomspace(*ends, count)
    rows = zip(times.tolist(), white_shares(usual / times, ratios).tolist(), strict=True)
    return [CorrelatedNoise(time, white) for time, row in rows for white in row]


def products_by_each(
    noises: Sequence[CorrelatedNoise], rows: np.ndarray, interval: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Products of rows whitened by each noise, and logs of the volume.

    Parameters
    ----------
    noises : sequence of CorrelatedNoise or MemoryKind, length k
        Those of one correlation time in a row.
    rows : array, shape (n, ..., m)
        One row for each reading, of one or more sets.
    interval : array, shape (n - 1,)
        Times between readings, s.

    Returns
    -------
    matrix : array, shape (k, ..., m, m)
    volume : array, shape (k,)

    Notes
    -----
    With W of `whitened`, the covariance of both parts of the noise is that of W⁻¹ T W⁻ᵀ with
    T = (1 - white) 1 + white W Wᵀ, of three diagonals: all is done in O(n).

    Examples
    --------
    >>> rows, noises = np.array([[1.0], [2.0]]), [CorrelatedNoise(1.0, 1.0)]
    >>> matrix, volume = products_by_each(noises, rows, np.array([1.0]))
    >>> matrix.ravel().round(9).tolist(), (volume.round(9) + 0.0).tolist()
    ([5.0], [0.0])
    """
    matrix, volumes = [], []
    for time, alike in groupby(noises, key=lambda noise: noise.time):
        with np.errstate(divide="ignore"):
            apart = interval / time
        begun = np.asfortranarray(whitened(rows, apart).reshape(len(rows), -1))
        columns = begun.T.reshape(*rows.shape[1:], -1)
        diagonals, volume = _whitening(apart), float(log_volume(apart))
        for noise in alike:
            size, below = _factor(noise.white, *diagonals)
            solved = dpttrs(size, below, begun)[0] if noise.white else begun
            solved = solved.T.reshape(columns.shape)
            matrix.append(columns @ np.swapaxes(solved, -1, -2))
            volumes.append(volume - 0.5 * float(np.sum(np.log(size))))
    return np.array(matrix), np.array(volumes)


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


@partial(jax.jit, compiler_options=OPTIMISED)
def levelled_products(
    noises: CorrelatedNoise, rows: jax.Array, time: jax.Array, begins: jax.Array, slope: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Products of rows without levels whitened by each noise, and logs of the volume, as of
    `products_by_each`.

    Parameters
    ----------
    noises : CorrelatedNoise of array, shape (k,)
        Of the readings.
    rows : array, shape (n, m)
        Residuals and their slopes, which the noise of the readings is beside.
    time : array, shape (n,)
        When. Noise goes on from block to block; rows at the time of the one before are padding.
    begins : array of bool, shape (n,)
        Where a block begins, of whose level nothing is known.
    slope : array, shape (n,)
        As of `Levels`, which are all free: their density is flat.

    Notes
    -----
    The filter of `filtered` has the level as a second state. The first row of a block says what
    the level is, and no more: a diffuse start (A. C. Harvey, 1989, section 3.3.4).
    """
    interval = jnp.diff(time, append=time[-1:])
    kept, white = jnp.exp(-interval[:, None] / noises.time), noises.white
    used = jnp.append(True, interval[:-1] > 0)

    def on(carry, now):
        value, level, (own, both, whole), found, volume = carry
        row, k, begin, s, counts = now
        size = jnp.where(begin, 1.0, own + 2 * s * both + s**2 * whole + white)
        surprise = row - value - s * level
        gain = jnp.where(begin, 0.0, (own + s * both) / size)
        rise = jnp.where(begin, 1.0 / s, (both + s * whole) / size)
        value, level = value + gain[:, None] * surprise, level + rise[:, None] * surprise
        known = own - gain * (own + s * both), both - gain * (both + s * whole)
        known += (whole - rise * (both + s * whole),)
        fresh = own, -own / s, (own + white) / s**2
        own, both, whole = (jnp.where(begin, f, g) for f, g in zip(fresh, known, strict=True))
        states = k**2 * own + (1.0 - white) * (1.0 - k**2), k * both, whole
        tells = counts & ~begin
        squares = surprise[:, :, None] * surprise[:, None, :] / size[:, None, None]
        found = found + jnp.where(tells, squares, 0.0)
        volume = volume - jnp.where(tells, 0.5 * jnp.log(size), 0.0)
        return (k[:, None] * value, level, states, found, volume), None

    nothing = jnp.zeros((len(white), rows.shape[1]))
    start = nothing, nothing, (1.0 - white, 0.0 * white, 0.0 * white)
    start += nothing[:, :, None] * nothing[:, None, :], 0.0 * white
    *_, found, volume = jax.lax.scan(on, start, (rows, kept, begins, slope, used))[0]
    return found, volume


class MemoryKind(NamedTuple):
    """A noise: its prior probability, correlation time, white share, and power of 1/f."""

    chance: float
    time: float = 0.0
    white: float = 1.0
    power: float = 0.0


def kinds_of(time: np.ndarray, count: int = TIMES) -> list[MemoryKind]:
    """List the noises that readings at these times may have, with so many correlation times.

    Examples
    --------
    >>> found = kinds_of(np.arange(100.0))
    >>> len(found), round(sum(kind.chance for kind in found), 9)
    (89, 1.0)
    """
    usual, span = float(np.median(np.diff(time))), float(time[-1] - time[0])
    chance = np.full(count, CORRELATED / count)
    chance[-1] += WALK  # the longest memory is as a walk of the record
    each = np.repeat(chance / len(BESIDE), len(BESIDE)).tolist()
    found = noises((SHORTEST * usual, LONGEST * span), usual, count, BESIDE)
    memory = [MemoryKind(chance, *noise) for chance, noise in zip(each, found, strict=True)]
    flicker = [MemoryKind(FLICKER / len(POWERS), power=power) for power in POWERS]
    return [MemoryKind(WHITE), *flicker, *memory]


def without_flicker(rows: np.ndarray, power: float) -> np.ndarray:
    """Whiten rows of readings in even time whose noise has the spectrum 1/f^power.

    Fractional differences (1 - B)^(power/2): J. R. M. Hosking, Biometrika 68 (1981) 165, eq. 2.2.

    Examples
    --------
    >>> without_flicker(np.array([[1.0], [2.0], [4.0]]), 2.0).ravel().round(9).tolist()
    [1.0, 1.0, 2.0]
    """
    if not power:
        return rows
    j = np.arange(1, len(rows))
    weights = np.append(1.0, np.cumprod((j - 1 - power / 2) / j))
    size = next_fast_len(2 * len(rows), real=True)
    found = irfft(rfft(rows, size, axis=0) * rfft(weights, size)[:, None], size, axis=0)
    return found[: len(rows)]


class Products(NamedTuple):
    """Sums of products of columns, whitened by each of k noises.

    Attributes
    ----------
    kinds : list of MemoryKind
        The noises.
    log_prior : array, shape (k,)
        Logarithms of their prior probability and the volume of their density.
    matrix : array, shape (k, m, m)
        Products of the m columns.
    count : int
        Readings.
    known : float
        Readings that stated errors are worth; 0 where none are stated.
    """

    kinds: list[MemoryKind]
    log_prior: np.ndarray
    matrix: np.ndarray
    count: int
    known: float

    @classmethod
    def of(
        cls, columns: np.ndarray, time: np.ndarray, stated: bool, times: int = TIMES
    ) -> Products:
        """Whiten columns, shape (n, m), of readings at increasing times, shape (n,).

        Columns are in units of the stated errors where there are any; `times` is how many
        correlation times are looked at.

        Examples
        --------
        >>> rows = np.random.default_rng(1).normal(size=(200, 1))
        >>> found = Products.of(rows, np.arange(200.0), stated=True)
        >>> found.matrix.shape, found.kinds[int(np.argmax(found.log_likelihood()))].white
        ((89, 1, 1), 1.0)
        """
        kinds = kinds_of(time, times)
        short = [without_flicker(columns, kind.power) for kind in kinds if not kind.time]
        matrix, volumes = products_by_each(kinds[len(short) :], columns, np.diff(time))
        logs = np.log([kind.chance for kind in kinds]) + np.append(np.zeros(len(short)), volumes)
        matrix = np.concatenate([[own.T @ own for own in short], matrix])
        return cls(kinds, logs, matrix, len(columns), STATED if stated else 0.0)

    def some(self, kept: np.ndarray) -> Products:
        """Keep some of the noises."""
        kinds = [kind for kind, keep in zip(self.kinds, kept, strict=True) if keep]
        return self._replace(kinds=kinds, log_prior=self.log_prior[kept], matrix=self.matrix[kept])

    def combined(self, columns: np.ndarray) -> Products:
        """Products of combinations of the columns, shape (m, p)."""
        return self._replace(matrix=columns.T @ self.matrix @ columns)

    def by_each(self, sets: np.ndarray, chance: np.ndarray) -> Products:
        """The same of each of some sets of combinations, shape (w, m, p), with a probability."""
        matrix = np.swapaxes(sets, 1, 2)[:, None] @ self.matrix @ sets[:, None]
        log_prior = np.add.outer(np.log(chance), self.log_prior).ravel()
        kinds = self.kinds * len(sets)
        return self._replace(kinds=kinds, log_prior=log_prior, matrix=np.concatenate(matrix))

    def between(self, sets: np.ndarray) -> np.ndarray:
        """Products (p, p, k, s) of p combinations of the columns by noise, of sets (m, p, s)."""
        sets = np.ascontiguousarray(np.moveaxis(sets, 2, 0))
        count, columns, some = sets.shape
        half = np.swapaxes(sets, 1, 2).reshape(-1, columns) @ np.swapaxes(
            self.matrix, 0, 1
        ).reshape(columns, -1)
        found = half.reshape(count, -1, columns) @ sets
        found = found.reshape(count, some, -1, some).transpose(1, 3, 2, 0)
        return np.ascontiguousarray(found)

    def left(self, columns: int | None = None) -> np.ndarray:
        """Squares of the first column that the others, up to one, leave, by noise."""
        known, along = self.matrix[:, 1:columns, 1:columns], self.matrix[:, 1:columns, 0]
        known = known * (1.0 + SINGULAR * np.eye(known.shape[1]))
        step = np.linalg.solve(known, along[:, :, None])[:, :, 0]
        return np.maximum(self.matrix[:, 0, 0] - np.sum(along * step, axis=1), 0.0)

    def log_size(self, squares: np.ndarray) -> np.ndarray:
        """Log likelihood of sums of squares, the size of the noise integrated over.

        A size flat in its logarithm where no errors are stated, else an inverse χ² prior with
        `known` degrees of freedom about 1.
        """
        return -0.5 * (self.count + self.known) * np.log(self.known + squares)

    def log_likelihood(self) -> np.ndarray:
        """The same of the first column by itself, with the prior, by noise."""
        return self.log_prior + self.log_size(self.matrix[:, 0, 0])

    def variance(self, squares: np.ndarray, numbers: int) -> np.ndarray:
        """Mean variance of a reading where so many numbers were fitted."""
        return (self.known + squares) / max(self.known + self.count - numbers, 1.0)

    def stated_odds(self, squares: np.ndarray, numbers: int) -> float:
        """Log odds that stated errors are right against any size of the noise.

        Each noise has the size that is stated, or one flat in its logarithm.

        Parameters
        ----------
        squares : array, shape (k,)
            Sum of squares of what is left after the fit, by noise, in stated errors.
        numbers : int
            How many were fitted.
        """
        dof = max(self.count - numbers, 1)
        size = np.linspace(-WRONG, WRONG, SIZES)  # of its logarithm
        log = -dof * size - 0.5 * squares[:, None] * np.exp(-2 * size)
        log = logsumexp(self.log_prior[:, None] + log, axis=0)
        return float(log[SIZES // 2] - logsumexp(log) + np.log(SIZES))
