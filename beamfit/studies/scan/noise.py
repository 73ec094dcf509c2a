"""What is known of the errors of a plane's sizes, before and after its fit."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

from beamfit.quantity import NORMAL_REACH
from beamfit.statistics import POOR_FIT, chi2_probability
from beamfit.studies.scan.scans import QuadScan

__all__ = ["DOUBTFUL", "GUESS", "GUESS_DOF", "Noise", "noise_of", "reach_of"]

# Noise without errors in the file: a guess of 5 % of the size, worth two degrees of freedom, so
# that a few accidentally small residuals are not taken for precision, nor equal sizes for none.
GUESS, GUESS_DOF = 0.05, 2.0
# A setting's own scatter counts beside this many degrees of freedom of all settings' together.
POOL_DOF = 20.0
# Errors that are the same share of every size to this relative spread were made as a share of it.
SAME_SHARE = 0.01
# Below this probability of χ² the residuals, and no longer the stated errors, tell the noise.
DOUBTFUL = 0.01


class Noise(NamedTuple):
    """The errors of a plane's sizes.

    Attributes
    ----------
    error : ndarray
        Shape (n,), m, of the measured sizes; where not known `GUESS` of them.
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
        return Noise(GUESS * size, 1.0, False, GUESS_DOF, "inferred from the residuals")
    error = scan.error[plane][measured]
    freedom = None if scan.shots is None else np.asarray(scan.shots, float)[measured] - 1.0
    if freedom is not None and freedom.sum() > 0:
        scatter = (error / size) ** 2 * (freedom + 1.0)
        pooled = float(freedom @ scatter / freedom.sum())
        shrunken = (POOL_DOF * pooled + freedom * scatter) / (POOL_DOF + freedom)
        error = size * np.sqrt(shrunken / (freedom + 1.0))
        return Noise(error, 1.0, True, float(freedom.sum()), "of the shots")
    share = error / size
    same = len(share) > 1 and float(np.ptp(share)) < SAME_SHARE * float(share.mean())
    return Noise(error, float(same), True, math.inf)


def reach_of(dof: float) -> float:
    """Errors that 95 % of answers lie within, by Student's distribution.

    Examples
    --------
    >>> round(reach_of(2), 2), round(reach_of(math.inf), 2)
    (4.3, 1.96)
    """
    return float(stdtrit(dof, 0.975)) if 0 < dof < math.inf else NORMAL_REACH
