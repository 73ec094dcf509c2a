"""Shots of one setting: their mean, how sure it is, and which of them show no beam."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.special import expit

from beamfit.noise.model import LN_2PI, Noise

# Degrees of freedom that the scatter of all settings counts beside a setting's own: the scatter
# of a setting differs from the others' by a third of itself at most (Gelman et al., sect. 2.6).
POOLED = 20.0
# Rounds in which shots are sorted and means taken anew.
ROUNDS = 20
# A shot that shows no beam may have any size up to this many times the largest median.
LARGEST = 2.0


class ShotMeans(NamedTuple):
    """Mean sizes and errors of the shots at each setting.

    Attributes
    ----------
    size, error : ndarray
        Shape (n,), m: mean of the shots that show the beam, and its standard error.
    bad : ndarray
        Shape (n, m): probability that a shot shows something else; NaN where there is none.
    scatter : float
        Median scatter of single shots, as a share of the size.
    """

    size: np.ndarray
    error: np.ndarray
    bad: np.ndarray
    scatter: float


def means_of(shots: np.ndarray, noise: Noise = Noise()) -> ShotMeans | None:  # noqa: B008
    """Means of shots, each shot with a probability of being none of the beam.

    Parameters
    ----------
    shots : ndarray
        Shape (n, m), m; NaN where a setting has fewer shots than m.
    noise : Noise
        With the prior probability of a bad shot.

    Returns
    -------
    ShotMeans or None
        None where fewer than three repeats in all, or shots that all agree, say nothing.

    Notes
    -----
    A mixture of the beam's normal scatter and of anything up to twice the largest size, by
    expectation and maximisation (D. W. Hogg, J. Bovy and D. Lang, arXiv:1008.4686 (2010), sect. 3).
    The error of a mean includes what the doubtful shots would move it by. The variance of m shots
    is s² = (20 s_pool² + (m - 1) s_i²)/(20 + m - 1): a scaled inverse χ² prior around the scatter
    of all settings (A. Gelman et al., Bayesian Data Analysis, 3rd ed. (2013), sect. 2.6), a share
    of the size or the same at each, whichever is likelier.

    Examples
    --------
    >>> shots = 1e-4 * np.array([[1.0, 1.02, 0.98], [2.0, 2.04, 0.0], [3.0, 2.94, 3.06]])
    >>> found = means_of(shots)
    >>> (found.size * 1e4).round(3).tolist(), found.bad[1].round(2).tolist()
    ([1.0, 2.02, 3.0], [0.0, 0.0, 1.0])
    """
    there = ~np.isnan(shots)
    value = np.where(there, shots, 0.0)
    middle = np.nanmedian(shots, axis=1)
    if (there.sum(1) - 1.0).clip(0).sum() < 3 or not np.any(np.nan_to_num(shots - middle[:, None])):
        return None
    far = LARGEST * float(np.max(middle))
    good, mean = there.astype(float), middle
    deviation = np.maximum(_first_scatter(shots, middle), 1e-6 * middle)
    for _ in range(ROUNDS):
        z2 = ((value - mean[:, None]) / deviation[:, None]) ** 2
        density = -0.5 * (z2 + LN_2PI) - np.log(deviation / far)[:, None]
        odds = math.log(noise.bad_shot / (1.0 - noise.bad_shot)) - density
        last, good = good, np.where(there, expit(-odds), 0.0)
        mean = _means(value, good, middle)
        deviation = _scatter(value, good, mean)
        if np.max(np.abs(good - last)) < 1e-6:
            break
    count = np.maximum(good.sum(1), 0.5)
    doubtful = (good * (there - good) * (value - mean[:, None]) ** 2).sum(1) / count**2
    error = np.sqrt(deviation**2 / count + doubtful)
    # Shots of which none is like another: some are bad, and nothing says which.
    torn = good.sum(1) < 1.0
    number = there.sum(1)
    own = (value * there).sum(1) / number
    apart = np.sqrt((there * (value - own[:, None]) ** 2).sum(1) / number)
    mean, error = np.where(torn, own, mean), np.where(torn, np.maximum(apart, deviation), error)
    good = np.where(torn[:, None], 0.5 * there, good)
    bad = np.where(there, 1.0 - good, np.nan)
    return ShotMeans(mean, error, bad, float(np.median(deviation / mean)))


def _first_scatter(shots: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """A robust deviation of each setting's shots to begin with: the same share for all."""
    share = np.abs(shots - middle[:, None]) / middle[:, None]
    # 1.4826 median absolute deviations are a standard deviation of a normal distribution.
    return 1.4826 * max(float(np.nanmedian(share[share > 0])), 1e-4) * middle


def _means(value: np.ndarray, good: np.ndarray, middle: np.ndarray) -> np.ndarray:
    total = good.sum(1)
    return np.where(total > 0.5, (good * value).sum(1) / np.maximum(total, 0.5), middle)


def _scatter(value: np.ndarray, good: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Standard deviation of the shots of each setting, evened out over the settings."""
    square = (good * (value - mean[:, None]) ** 2).sum(1)
    freedom = np.maximum(good.sum(1) - 1.0, 0.0)
    return np.sqrt(evened(square, freedom, mean))


def evened(square: np.ndarray, freedom: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Variance of one shot at each setting, from sums of squares with degrees of freedom.

    Examples
    --------
    >>> evened(np.array([4.0, 16.0]), np.array([4.0, 4.0]), np.array([1.0, 2.0])).tolist()
    [1.0, 4.0]
    """
    least, shape, pooled = math.inf, size, 1.0
    for each in (size, np.full(len(size), np.median(size))):
        variance = float((square / each**2).sum() / max(freedom.sum(), 1.0))
        unlikely = float(freedom @ np.log(variance * each**2)) if variance > 0 else -math.inf
        if unlikely < least:
            least, shape, pooled = unlikely, each, variance
    own = POOLED * pooled * shape**2 + square
    return np.maximum(own / (POOLED + freedom), 1e-12 * size**2)
