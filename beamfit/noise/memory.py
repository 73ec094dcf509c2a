"""Noise of readings with a memory: white, correlated, or 1/f, with a probability for each.

Errors may be correlated as exp(-time/correlation time). For evenly spaced readings this is a
first-order autoregressive process; uneven spacing needs nothing else. Whitening subtracts from each
error its prediction from the previous one, in O(n). Each noise of a list with prior probabilities
whitens the same columns once. A fit then needs only their Gram matrices, whatever the number of
readings.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import groupby
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg.lapack import dpttrf, dpttrs, dtbtrs
from scipy.special import logsumexp

from beamfit.compile_cache import OPTIMISED, prepare_jax

prepare_jax()
# Correlation of neighbouring residuals above which they count as correlated, in standard errors of
# that of independent residuals.
MIN_CORRELATION = 2.0
# Variances of a white part, over the gain in variance of the correlated part from one reading to
# the next: a monitor that drifts by a third of its noise per reading has 10.
BESIDE = (0.0, 1.0, 10.0, 100.0, 1000.0)
# Means over this many neighbours are also tested: they show a slow drift under white noise.
BLOCK_SIZES = (4, 16)
# Prior probabilities of white noise, noise with one correlation time, and a random walk; 1/f noise
# has the rest. Readings are white unless something slow acts on the monitor: amplifiers have 1/f
# noise, and temperature changes add up to a walk.
WHITE, CORRELATED, WALK = 0.5, 0.25, 0.1
FLICKER = 1.0 - WHITE - CORRELATED - WALK
# Shortest correlation time in intervals between readings, longest in records, and number of times,
# equally spaced in the logarithm.
MIN_TIME, MAX_TIME, TIMES = 0.5, 3.0, 17
# Powers of spectra 1/f^power. Devices have powers of 0.8 to 1.4 (P. Dutta and P. M. Horn, Rev. Mod.
# Phys. 53 (1981) 497); above 1 the noise resembles a random walk.
POWERS = (0.4, 0.7, 1.0)
# Number of correlation times for a verdict on the noise level, which needs closer ones.
CLOSE = 49
# Relative ridge added to the Gram matrix of columns that may be linearly dependent.
RIDGE = 1e-11
# Weight of stated errors as a number of readings that determine the noise level: right within 25 %.
STATED_READINGS = 8.0
# Alternative to right stated errors: a noise level flat in its logarithm over a factor 30 to either
# side, on this many nodes.
LN_SIZE_RANGE, SIZE_NODES = np.log(30.0), 121


def whitened(rows, distance):
    """Transform rows with correlated errors to rows with independent errors of the same variance.

    Parameters
    ----------
    rows : array, shape (n, ...)
        One row per value.
    apart : array, shape (n - 1,)
        Time between neighbours over the correlation time, positive.

    Returns
    -------
    array, shape (n, ...)
        r[0], then (r[k] - c r[k-1])/sqrt(1 - c²) with c = exp(-apart[k-1]).

    Notes
    -----
    This is the inverse of the Cholesky factor of the correlation matrix exp(-|t_j - t_k|/time). It
    has two diagonals: D. T. Gillespie, Phys. Rev. E 54 (1996) 2084, eq. 1.9a, inverted.

    Examples
    --------
    >>> whitened(np.array([1.0, 2.0, 2.0]), np.log([2.0, 2.0])).round(4).tolist()
    [1.0, 1.7321, 1.1547]
    """
    shape = (-1,) + (1,) * (rows.ndim - 1)
    memory = np.exp(-distance).reshape(shape)
    innovation = np.sqrt(-np.expm1(-2 * distance)).reshape(shape)
    return np.concatenate([rows[:1], (rows[1:] - memory * rows[:-1]) / innovation])


def log_volume(distance):
    """Log determinant of the whitening matrix: -sum ln sqrt(1 - c²)."""
    return -0.5 * np.sum(np.log(-np.expm1(-2 * distance)))


def is_correlated(residuals: np.ndarray, parameters: int, seen: float = MIN_CORRELATION) -> bool:
    """Test whether neighbouring residuals are more correlated than independent ones.

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


def remembers(residuals: np.ndarray, parameters: int, slow: float = MIN_CORRELATION) -> bool:
    """Test whether residuals, or their means over neighbours, are correlated.

    The means count as correlated above ``slow`` standard errors.

    Examples
    --------
    >>> slow = 0.3 * np.sin(np.arange(400) / 60) + np.random.default_rng(0).normal(size=400)
    >>> is_correlated(slow, 0), remembers(slow, 0)
    (False, True)
    """
    if is_correlated(residuals, parameters):
        return True
    means = [residuals[: len(residuals) // k * k].reshape(-1, k).mean(axis=1) for k in BLOCK_SIZES]
    return any(is_correlated(m, parameters, slow) for m in means if len(m) > 2 * parameters)


class CorrelatedNoise(NamedTuple):
    """Correlation time of the correlated part, and share of variance of a white part."""

    time: float
    white: float = 0.0


def innovations(
    rows: np.ndarray, time: np.ndarray, noise: CorrelatedNoise
) -> tuple[np.ndarray, float]:
    """Prediction errors of rows over their standard deviations, and sum of the logs of these.

    Each row is predicted from the previous ones, by the Cholesky factors of W⁻¹ and T as in
    `products_by_each`.

    Examples
    --------
    >>> innovations(np.ones(3), np.arange(3.0), CorrelatedNoise(1.0, 1.0))[0].tolist()
    [1.0, 1.0, 1.0]
    """
    distance = np.diff(time) / noise.time
    (size, below), whitened_rows = (
        _factor(noise.white, *_whitening(distance)),
        whitened(rows, distance),
    )
    band = np.stack([np.ones_like(size), np.append(below, 0.0)])
    white = dtbtrs(band, whitened_rows.reshape(len(whitened_rows), -1), uplo="L", diag="U")[0]
    white = white / np.sqrt(size)[:, None]
    volume = 0.5 * float(np.sum(np.log(size))) - float(log_volume(distance))
    return white.reshape(whitened_rows.shape), volume


def _whitening(distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Main diagonal and subdiagonal of the matrix of `whitened`."""
    innovation = np.sqrt(-np.expm1(-2 * distance))
    return np.append(1.0, 1.0 / innovation), np.append(0.0, -np.exp(-distance) / innovation)


def _factor(
    white: float, main: np.ndarray, subdiagonal: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Factor T of `products_by_each` as L D Lᵀ; return D and the subdiagonal of L."""
    pivots = 1.0 - white + white * (main**2 + subdiagonal**2)
    return dpttrf(pivots, white * subdiagonal[1:] * main[:-1])[:2]


def filtered(rows: jax.Array, time: jax.Array, noise: CorrelatedNoise) -> jax.Array:
    """Innovations in JAX, for rows of a search that needs derivatives.

    Kalman filter of an Ornstein-Uhlenbeck process observed with white noise (A. C. Harvey,
    Forecasting, structural time series models and the Kalman filter, 1989, section 3.4), O(n).
    """
    wander = 1.0 - noise.white
    memory = jnp.exp(-jnp.diff(time, append=time[-1:]) / noise.time)

    def step(carry, current):
        mean, variance = carry
        row, k = current
        total = variance + noise.white
        surprise = row - mean
        mean = k * (mean + variance / total * surprise)
        variance = k**2 * variance * noise.white / total + wander * (1.0 - k**2)
        return (mean, variance), surprise / jnp.sqrt(total)

    start = jnp.zeros(rows.shape[1:]), jnp.asarray(wander)
    return jax.lax.scan(step, start, (rows, memory))[1]


def white_shares(distance, ratios=BESIDE) -> np.ndarray:
    """Shares of white variance, from its ratio to the variance gained by the correlated part.

    Parameters
    ----------
    apart : array, shape (t,)
        Time between readings over each correlation time.
    ratios : array, shape (r,)
        White variances over the variance that the correlated part gains between readings.

    Returns
    -------
    array, shape (t, r)

    Examples
    --------
    >>> white_shares([np.log(2.0)], [0.0, 1.0]).round(6).tolist()
    [[0.0, 0.428571]]
    """
    white = np.outer(-np.expm1(-2.0 * np.asarray(distance)), ratios)
    return white / (1.0 + white)


def noises(
    ends: tuple[float, float], usual: float, count: int, ratios: Sequence[float] = (0.0,)
) -> list[CorrelatedNoise]:
    """Grid of noises: correlation times between two ends, each with all ratios of `white_shares`.

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
    """Gram matrices of rows whitened by each noise, and log determinants of the whitening.

    Parameters
    ----------
    noises : sequence of CorrelatedNoise or MemoryKind, length k
        Noises, with those of one correlation time next to each other.
    rows : array, shape (n, ..., m)
        One row per reading, of one or more sets.
    interval : array, shape (n - 1,)
        Times between readings, s.

    Returns
    -------
    matrix : array, shape (k, ..., m, m)
    volume : array, shape (k,)

    Notes
    -----
    With W of `whitened`, the covariance of correlated and white noise is W⁻¹ T W⁻ᵀ with
    T = (1 - white) 1 + white W Wᵀ. T has three diagonals, so that the work is O(n).

    Examples
    --------
    >>> rows, noises = np.array([[1.0], [2.0]]), [CorrelatedNoise(1.0, 1.0)]
    >>> matrix, volume = products_by_each(noises, rows, np.array([1.0]))
    >>> matrix.ravel().round(9).tolist(), (volume.round(9) + 0.0).tolist()
    ([5.0], [0.0])
    """
    matrix, volumes = [], []
    for time, same_time in groupby(noises, key=lambda noise: noise.time):
        with np.errstate(divide="ignore"):
            distance = interval / time
        whitened_rows = np.asfortranarray(whitened(rows, distance).reshape(len(rows), -1))
        columns = whitened_rows.T.reshape(*rows.shape[1:], -1)
        diagonals, volume = _whitening(distance), float(log_volume(distance))
        for noise in same_time:
            size, below = _factor(noise.white, *diagonals)
            solved = dpttrs(size, below, whitened_rows)[0] if noise.white else whitened_rows
            solved = solved.T.reshape(columns.shape)
            matrix.append(columns @ np.swapaxes(solved, -1, -2))
            volumes.append(volume - 0.5 * float(np.sum(np.log(size))))
    return np.array(matrix), np.array(volumes)


class Levels(NamedTuple):
    """Free levels, such as one per cycle, each of which acts on the rows of one block only.

    Attributes
    ----------
    first : array of int, shape (k,)
        First row of each block; that of the first block is 0.
    slope : array, shape (n,)
        Derivative of each residual with respect to the level of its block.
    """

    first: np.ndarray
    slope: np.ndarray

    def left(self, rows: np.ndarray) -> np.ndarray:
        """Project the levels out of rows with independent noise.

        It is done twice, to remove the rounding errors of the first pass.
        """
        squares = np.add.reduceat(self.slope**2, self.first)
        lengths = np.diff(self.first, append=len(rows))
        for _ in range(2):
            levels = np.add.reduceat(self.slope[:, None] * rows, self.first) / squares[:, None]
            rows = rows - self.slope[:, None] * np.repeat(levels, lengths, axis=0)
        return rows


@partial(jax.jit, compiler_options=OPTIMISED)
def levelled_products(
    noises: CorrelatedNoise, rows: jax.Array, time: jax.Array, begins: jax.Array, slope: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Gram matrices of rows whitened by each noise with levels projected out, and log determinants.

    Parameters
    ----------
    noises : CorrelatedNoise of array, shape (k,)
        Noises of the readings.
    rows : array, shape (n, m)
        Residuals and their derivatives.
    time : array, shape (n,)
        Times of the rows. Noise is continuous from block to block; rows at the time of the previous
        one are padding.
    begins : array of bool, shape (n,)
        True at the first row of each block, whose level is unknown.
    slope : array, shape (n,)
        As in `Levels`; the levels have flat priors.

    Notes
    -----
    The filter of `filtered` with the level as a second state. The first row of a block determines
    the level and nothing else: a diffuse start (A. C. Harvey, 1989, section 3.3.4).
    """
    interval = jnp.diff(time, append=time[-1:])
    memory, white = jnp.exp(-interval[:, None] / noises.time), noises.white
    used = jnp.append(True, interval[:-1] > 0)

    def step(carry, current):
        value, level, (value_variance, covariance, level_variance), products, volume = carry
        row, k, begin, s, counts = current
        size = jnp.where(
            begin, 1.0, value_variance + 2 * s * covariance + s**2 * level_variance + white
        )
        surprise = row - value - s * level
        gain = jnp.where(begin, 0.0, (value_variance + s * covariance) / size)
        rise = jnp.where(begin, 1.0 / s, (covariance + s * level_variance) / size)
        value, level = value + gain[:, None] * surprise, level + rise[:, None] * surprise
        updated = (
            value_variance - gain * (value_variance + s * covariance),
            covariance - gain * (covariance + s * level_variance),
        )
        updated += (level_variance - rise * (covariance + s * level_variance),)
        at_begin = value_variance, -value_variance / s, (value_variance + white) / s**2
        value_variance, covariance, level_variance = (
            jnp.where(begin, f, g) for f, g in zip(at_begin, updated, strict=True)
        )
        states = (
            k**2 * value_variance + (1.0 - white) * (1.0 - k**2),
            k * covariance,
            level_variance,
        )
        counted = counts & ~begin
        squares = surprise[:, :, None] * surprise[:, None, :] / size[:, None, None]
        products = products + jnp.where(counted, squares, 0.0)
        volume = volume - jnp.where(counted, 0.5 * jnp.log(size), 0.0)
        return (k[:, None] * value, level, states, products, volume), None

    none = jnp.zeros((len(white), rows.shape[1]))
    start = none, none, (1.0 - white, 0.0 * white, 0.0 * white)
    start += none[:, :, None] * none[:, None, :], 0.0 * white
    *_, products, volume = jax.lax.scan(step, start, (rows, memory, begins, slope, used))[0]
    return products, volume


class MemoryKind(NamedTuple):
    """A noise: prior probability, correlation time, white share, and power of 1/f."""

    chance: float
    time: float = 0.0
    white: float = 1.0
    power: float = 0.0


def kinds_of(time: np.ndarray, count: int = TIMES) -> list[MemoryKind]:
    """List the noises that readings at these times may have, with ``count`` correlation times.

    Examples
    --------
    >>> found = kinds_of(np.arange(100.0))
    >>> len(found), round(sum(kind.chance for kind in found), 9)
    (89, 1.0)
    """
    interval, span = float(np.median(np.diff(time))), float(time[-1] - time[0])
    chance = np.full(count, CORRELATED / count)
    chance[-1] += WALK  # with the longest memory, noise is a random walk over the record
    chances = np.repeat(chance / len(BESIDE), len(BESIDE)).tolist()
    found = noises((MIN_TIME * interval, MAX_TIME * span), interval, count, BESIDE)
    memory = [MemoryKind(chance, *noise) for chance, noise in zip(chances, found, strict=True)]
    flicker = [MemoryKind(FLICKER / len(POWERS), power=power) for power in POWERS]
    return [MemoryKind(WHITE), *flicker, *memory]


def without_flicker(rows: np.ndarray, power: float) -> np.ndarray:
    """Whiten rows of evenly spaced readings whose noise has the spectrum 1/f^power.

    Fractional differences (1 - B)^(power/2): J. R. M. Hosking, Biometrika 68 (1981) 165, eq. 2.2.

    Examples
    --------
    >>> without_flicker(np.array([[1.0], [2.0], [4.0]]), 2.0).ravel().round(9).tolist()
    [1.0, 1.0, 2.0]
    """
    if not power:
        return rows
    from scipy.fft import irfft, next_fast_len, rfft  # slow to import, needed only here

    j = np.arange(1, len(rows))
    weights = np.append(1.0, np.cumprod((j - 1 - power / 2) / j))
    size = next_fast_len(2 * len(rows), real=True)
    filtered_rows = irfft(rfft(rows, size, axis=0) * rfft(weights, size)[:, None], size, axis=0)
    return filtered_rows[: len(rows)]


class Products(NamedTuple):
    """Gram matrices of columns, whitened by each of k noises.

    Attributes
    ----------
    kinds : list of MemoryKind
        The noises.
    log_prior : array, shape (k,)
        Logs of their prior probability plus the log determinant of the whitening.
    matrix : array, shape (k, m, m)
        Gram matrices of the m columns.
    count : int
        Number of readings.
    known : float
        Weight of stated errors as a number of readings; 0 without stated errors.
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

        Columns are in units of the stated errors if there are any; `times` is the number of
        correlation times.

        Examples
        --------
        >>> rows = np.random.default_rng(1).normal(size=(200, 1))
        >>> found = Products.of(rows, np.arange(200.0), stated=True)
        >>> found.matrix.shape, found.kinds[int(np.argmax(found.log_likelihood()))].white
        ((89, 1, 1), 1.0)
        """
        kinds = kinds_of(time, times)
        without_time = [without_flicker(columns, kind.power) for kind in kinds if not kind.time]
        matrix, volumes = products_by_each(kinds[len(without_time) :], columns, np.diff(time))
        logs = np.log([kind.chance for kind in kinds]) + np.append(
            np.zeros(len(without_time)), volumes
        )
        matrix = np.concatenate([[own.T @ own for own in without_time], matrix])
        return cls(kinds, logs, matrix, len(columns), STATED_READINGS if stated else 0.0)

    def some(self, kept: np.ndarray) -> Products:
        """Select some of the noises."""
        kinds = [kind for kind, keep in zip(self.kinds, kept, strict=True) if keep]
        return self._replace(kinds=kinds, log_prior=self.log_prior[kept], matrix=self.matrix[kept])

    def combined(self, columns: np.ndarray) -> Products:
        """Gram matrices of linear combinations of the columns, shape (m, p)."""
        return self._replace(matrix=columns.T @ self.matrix @ columns)

    def by_each(self, sets: np.ndarray, chance: np.ndarray) -> Products:
        """Gram matrices of each of w sets of combinations, (w, m, p), with a probability each."""
        matrix = np.swapaxes(sets, 1, 2)[:, None] @ self.matrix @ sets[:, None]
        log_prior = np.add.outer(np.log(chance), self.log_prior).ravel()
        kinds = self.kinds * len(sets)
        return self._replace(kinds=kinds, log_prior=log_prior, matrix=np.concatenate(matrix))

    def between(self, sets: np.ndarray) -> np.ndarray:
        """Products (p, p, k, s), by noise, of p combinations of the columns in s sets (m, p, s)."""
        sets = np.ascontiguousarray(np.moveaxis(sets, 2, 0))
        count, columns, some = sets.shape
        left_product = np.swapaxes(sets, 1, 2).reshape(-1, columns) @ np.swapaxes(
            self.matrix, 0, 1
        ).reshape(columns, -1)
        found = left_product.reshape(count, -1, columns) @ sets
        found = found.reshape(count, some, -1, some).transpose(1, 3, 2, 0)
        return np.ascontiguousarray(found)

    def left(self, columns: int | None = None) -> np.ndarray:
        """Residual sum of squares, by noise, of column 0 fitted by columns 1 to ``columns`` - 1."""
        gram, cross = self.matrix[:, 1:columns, 1:columns], self.matrix[:, 1:columns, 0]
        gram = gram * (1.0 + RIDGE * np.eye(gram.shape[1]))
        step = np.linalg.solve(gram, cross[:, :, None])[:, :, 0]
        return np.maximum(self.matrix[:, 0, 0] - np.sum(cross * step, axis=1), 0.0)

    def log_size(self, squares: np.ndarray) -> np.ndarray:
        """Log likelihood of residual sums of squares, integrated over the noise level.

        The prior of the noise level is flat in its logarithm without stated errors; otherwise it is
        an inverse χ² prior with `known` degrees of freedom about 1.
        """
        return -0.5 * (self.count + self.known) * np.log(self.known + squares)

    def log_likelihood(self) -> np.ndarray:
        """Log likelihood of the first column with nothing fitted, plus the log prior, by noise."""
        return self.log_prior + self.log_size(self.matrix[:, 0, 0])

    def variance(self, squares: np.ndarray, numbers: int) -> np.ndarray:
        """Mean variance of a reading after a fit of ``numbers`` parameters."""
        return (self.known + squares) / max(self.known + self.count - numbers, 1.0)

    def stated_odds(self, squares: np.ndarray, numbers: int) -> float:
        """Log odds that stated errors are right, against any noise level.

        The alternative is a noise level flat in its logarithm.

        Parameters
        ----------
        squares : array, shape (k,)
            Residual sum of squares of a fit by noise, in units of the stated errors.
        numbers : int
            Number of fitted parameters.
        """
        dof = max(self.count - numbers, 1)
        size = np.linspace(-LN_SIZE_RANGE, LN_SIZE_RANGE, SIZE_NODES)  # ln of the noise level
        log = -dof * size - 0.5 * squares[:, None] * np.exp(-2 * size)
        log = logsumexp(self.log_prior[:, None] + log, axis=0)
        return float(log[SIZE_NODES // 2] - logsumexp(log) + np.log(SIZE_NODES))
