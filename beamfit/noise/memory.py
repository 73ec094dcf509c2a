"""Noise of a series of readings that may have a memory: white, correlated, 1/f; none is chosen.

Each noise of a list with prior probabilities whitens the same columns once. Their products are all
that a fit needs later, however many readings there are.
"""

from __future__ import annotations

from itertools import groupby
from typing import NamedTuple

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.linalg.lapack import dpttrs
from scipy.special import logsumexp

from beamfit.noise.correlated import BESIDE, beside, log_volume, white_shares, whitened

# Prior probabilities of white noise, of noise with one correlation time, and of a random walk; 1/f
# noise has the rest. Readings are white unless something slow moves the monitor: amplifiers have
# 1/f noise, and what a changing temperature adds up in a monitor is a walk.
WHITE, CORRELATED, WALK = 0.5, 0.25, 0.1
# Correlation times, from this share of the interval between readings to so many records, flat in
# the logarithm.
SHORTEST, LONGEST, TIMES = 0.5, 3.0, 17
# Spectra 1/f^power. P. Dutta and P. M. Horn, Rev. Mod. Phys. 53 (1981) 497: 1/f noise of devices
# has powers of 0.8 to 1.4; beyond 1 it is as a random walk.
POWERS = (0.4, 0.7, 1.0)
# A verdict on the size of the noise needs correlation times as close as this many.
CLOSE = 49
# Stated errors are worth so many readings that tell the size of the noise: right within 25 %.
STATED = 8.0
# The rival to stated errors is a size flat in its logarithm, a factor 30 to either side.
WRONG, SIZES = np.log(30.0), 121


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
    times = np.geomspace(SHORTEST * usual, LONGEST * span, count)
    chance = np.full(count, CORRELATED / count)
    chance[-1] += WALK  # the longest memory is as a walk of the record
    memory = [
        MemoryKind(float(each) / len(BESIDE), float(t), float(white))
        for t, each, row in zip(times, chance, white_shares(usual / times), strict=True)
        for white in row
    ]
    flicker = (1.0 - WHITE - CORRELATED - WALK) / len(POWERS)
    return [MemoryKind(WHITE), *(MemoryKind(flicker, power=power) for power in POWERS), *memory]


def without_flicker(rows: np.ndarray, power: float) -> np.ndarray:
    """Whiten rows of readings in even time whose noise has the spectrum 1/f^power.

    Fractional differences (1 - B)^(power/2): J. R. M. Hosking, Biometrika 68 (1981) 165, eq. 2.2.

    Examples
    --------
    >>> without_flicker(np.array([[1.0], [2.0], [4.0]]), 2.0).ravel().round(9).tolist()
    [1.0, 1.0, 2.0]
    """
    j = np.arange(1, len(rows))
    weights = np.append(1.0, np.cumprod((j - 1 - power / 2) / j))
    size = next_fast_len(2 * len(rows), real=True)
    found = irfft(rfft(rows, size, axis=0) * rfft(weights, size)[:, None], size, axis=0)
    return found[: len(rows)]


def _products(kinds: list[MemoryKind], rows: np.ndarray, time: np.ndarray):
    """Yield products of the rows whitened by each noise, in order, with the log of the volume."""
    interval = np.diff(time)
    for length, alike in groupby(kinds, key=lambda kind: kind.time):
        begun, volume = rows, 0.0
        if length:
            apart = interval / length
            begun = np.asfortranarray(whitened(rows, apart, np))
            volume = float(log_volume(apart, np))
        for kind in alike:
            if not length:
                own = without_flicker(rows, kind.power) if kind.power else rows
                yield own.T @ own, 0.0
            elif not kind.white:
                yield begun.T @ begun, volume
            else:
                size, next_ = beside(apart, kind.white)
                solved = dpttrs(size, next_, begun)[0]
                yield begun.T @ solved, volume - 0.5 * float(np.sum(np.log(size)))


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
        matrix, volumes = zip(*_products(kinds, columns, time), strict=True)
        logs = np.log([kind.chance for kind in kinds]) + volumes
        return cls(kinds, logs, np.array(matrix), len(columns), STATED if stated else 0.0)

    def some(self, kept: np.ndarray) -> Products:
        """Keep some of the noises."""
        kinds = [kind for kind, keep in zip(self.kinds, kept, strict=True) if keep]
        return self._replace(kinds=kinds, log_prior=self.log_prior[kept], matrix=self.matrix[kept])

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
