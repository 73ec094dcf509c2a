"""What is known of the errors of a plane's sizes, before and after its fit."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.special import fdtrc

from beamfit.statistics import POOR_FIT, chi2_probability
from beamfit.studies.scan.scans import QuadScan

# Noise without errors in the file: a guess of 5 % of the size, worth two degrees of freedom, so
# that a few accidentally small residuals are not taken for precision, nor equal sizes for none.
GUESS, GUESS_DOF = 0.05, 2.0
# With up to so many residuals left that leaves 2 % of scans with 10 % of noise beyond 3 errors: the
# guess is 7 % there, worth 2.5, and the more of it is forgotten as their number squared.
FEW, GUESS_OF_FEW, DOF_OF_FEW = 3, 0.07, 2.5
# A setting's own scatter counts beside this many degrees of freedom of all settings' together.
POOL_DOF = 20.0
# With fewer repeats in all, or points, nothing is told of their kind.
ENOUGH, ENOUGH_POINTS = 3, 8
# Errors that are the same share of every size to this relative spread were made as a share of it.
SAME_SHARE = 0.01
# Below this probability of χ² the residuals, and no longer the stated errors, tell the noise.
DOUBTFUL = 0.01


class Noise(NamedTuple):
    """The errors of a plane's sizes.

    Attributes
    ----------
    error : ndarray
        Shape (n,), m, of the measured sizes; where not known `guess` of them.
    relative : float
        1 where errors are shares of the size, so that the fit takes them of the model's size; a
        size that noise made small would count for more otherwise. 0 where they are as they stand.
    known : bool
        Whether they are errors, and no guess.
    dof : float
        Degrees of freedom they are worth: those of the shots, infinite where they are given.
    words : str
        Where they come from.
    """

    error: np.ndarray
    relative: float
    known: bool
    dof: float
    words: str = "given"

    def probability(self, chi2: float, dof: int) -> float | None:
        """How often noise alone gives such a χ², the errors' own uncertainty included."""
        return chi2_probability(chi2, dof, self.dof) if self.known else None

    def poor(self, chi2: float, dof: int) -> bool:
        """Whether it does so less than once in a thousand."""
        probability = self.probability(chi2, dof)
        return probability is not None and probability < POOR_FIT

    def rests_on(self, chi2: float, dof: int) -> float:
        """Degrees of freedom of the errors as scaled by a fit: infinite for stated ones.

        Student's distribution serves where the residuals tell the noise: where nothing else does,
        and where they speak against the stated errors.
        """
        if not self.known:
            return self.dof + dof
        probability = self.probability(chi2, dof)
        return dof if probability is not None and probability < DOUBTFUL else self.dof


def guess(points: int) -> tuple[float, float]:
    """The share of the size that noise is guessed at, and how many residuals that is worth.

    Examples
    --------
    >>> [tuple(round(v, 3) for v in guess(n)) for n in (5, 6, 9, 30)]
    [(0.07, 2.5), (0.07, 2.5), (0.057, 2.125), (0.05, 2.006)]
    """
    more = min(1.0, (FEW / max(points - 3, 1)) ** 2)
    dof = GUESS_DOF + more * (DOF_OF_FEW - GUESS_DOF)
    square = GUESS_DOF * GUESS**2
    square += more * (DOF_OF_FEW * GUESS_OF_FEW**2 - square)
    return float(np.sqrt(square / dof)), dof


def noise_of(scan: QuadScan, plane: str) -> Noise:
    """The errors of the sizes of a plane, from its file, its shots, or a guess.

    Parameters
    ----------
    scan : QuadScan
        The scan.
    plane : str
        "x" or "y".

    Returns
    -------
    Noise
        Of the rows in which the plane was measured.

    Notes
    -----
    Scatter is relative or the same in µm at every setting, whichever its likelihood prefers (of
    sample variances with f_i degrees of freedom the smaller Σ f_i ln v_i, v_i the pooled variance
    there). A setting that scatters far more than all others is not pooled and stays as it is.
    The variance of m shots of a setting is s² = (20 s_pool² + (m - 1) s_i²)/(20 + m - 1), with
    their own relative scatter s_i and that of all settings s_pool: few shots can agree by chance.
    This is how a scaled inverse χ² prior of 20 degrees of freedom around s_pool is updated, A.
    Gelman et al., Bayesian Data Analysis (3rd ed., 2013), section 2.6.

    Examples
    --------
    >>> shots = QuadScan({"Q": [0.0, 1.0, 2.0]}, {"Q": "A"}, {"x": [1e-4] * 3},
    ...                  {"x": [1e-6, 2e-6, 3e-6]}, shots=np.array([5, 5, 5]))
    >>> noise = noise_of(shots, "x")
    >>> (noise.error * 1e6).round(2).tolist(), noise.dof
    ([2.01, 2.13, 2.32], 12.0)
    """
    measured = ~np.isnan(scan.size[plane])
    size = scan.size[plane][measured]
    if plane not in scan.error:
        share, dof = guess(len(size))
        return Noise(share * size, 1.0, False, dof, "inferred from the residuals")
    error = scan.error[plane][measured]
    freedom = None if scan.shots is None else np.asarray(scan.shots, float)[measured] - 1.0
    if freedom is not None and freedom.sum() > 0:
        return _of_shots(size, error, freedom)
    share = error / size
    same = len(share) > 1 and float(np.ptp(share)) < SAME_SHARE * float(share.mean())
    return Noise(error, float(same), True, math.inf)


def _of_shots(size: np.ndarray, error: np.ndarray, freedom: np.ndarray) -> Noise:
    """Errors of means of ``freedom`` + 1 shots, evened out over the settings."""
    scatter = error**2 * (freedom + 1.0)
    shape, pooled, least, kept = size, 1.0, math.inf, freedom > 0
    for each in (size, np.full(len(size), np.median(size))):
        alike = outstanding(freedom * scatter / each**2, freedom) >= POOR_FIT
        own = freedom * alike
        variance = float(own @ (scatter / each**2) / own.sum())
        unlikely = float(own @ np.log(variance * each**2))
        if unlikely < least:
            shape, pooled, least, kept = each, variance, unlikely, alike
    own = scatter / shape**2
    shrunken = np.where(kept, (POOL_DOF * pooled + freedom * own) / (POOL_DOF + freedom), own)
    error = shape * np.sqrt(shrunken / (freedom + 1.0))
    return Noise(error, float(shape is size), True, float(freedom.sum()), "of the shots")


def outstanding(square: np.ndarray, degrees: np.ndarray) -> np.ndarray:
    """How likely some setting scatters so much more than all others, by the F test of each.

    Parameters
    ----------
    square, degrees : ndarray
        Shape (n,): sums of squares and degrees of freedom.

    Returns
    -------
    ndarray
        Shape (n,); 1 where there is nothing to compare.

    Examples
    --------
    >>> outstanding(np.array([4.0, 4.0, 400.0]), np.array([4.0, 4.0, 4.0])).round(4).tolist()
    [1.0, 1.0, 0.0]
    """
    others, rest = degrees.sum() - degrees, square.sum() - square
    tested = (degrees > 0) & (others >= ENOUGH)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.nan_to_num((square / degrees) / (rest / others), nan=1.0)
    chance = np.where(tested, fdtrc(np.maximum(degrees, 1), np.maximum(others, 1), ratio), 1.0)
    return np.minimum(chance * max(int(tested.sum()), 1), 1.0)


def constant_noise(size: np.ndarray) -> Noise:
    """A guess at noise that is the same in µm at every point."""
    share, dof = guess(len(size))
    error = np.full(len(size), share * float(np.median(size)))
    return Noise(error, 0.0, False, dof, "inferred from the residuals, the same in µm")


def unlikely(off: np.ndarray, shape: np.ndarray) -> float:
    """Minus the logarithm of the likelihood of normal residuals whose deviations go as a shape.

    Their common factor is at its best, and constants are left out.

    Examples
    --------
    >>> off = np.array([1.0, -1.0, 1.0])
    >>> unlikely(off, np.ones(3)) < unlikely(off, np.array([1.0, 2.0, 3.0]))
    True
    """
    scatter = max(float(np.mean((off / shape) ** 2)), 1e-300)
    return 0.5 * len(off) * math.log(scatter) + float(np.log(shape).sum())
