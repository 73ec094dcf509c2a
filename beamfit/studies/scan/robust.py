"""A fit that gives each point a probability of being an outlier instead of dropping it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import expit

from beamfit.studies.scan.model import size_squared
from beamfit.studies.scan.sigma import SigmaFit, fit_sizes

__all__ = ["RobustFit", "fit_robust"]

# A point is an outlier with this probability before it is seen, and its error is then at least
# this many times larger.
FRACTION, WIDTH = 0.05, 10.0
# At most this many points are left out in turn for a start.
STARTS = 50


class RobustFit(NamedTuple):
    """A weighted fit and what it thinks of each point.

    Attributes
    ----------
    fit : SigmaFit
        With each point's error widened as far as it is thought an outlier.
    outlier_probability : ndarray
        Shape (n,).
    error : ndarray
        The widened errors, m.
    """

    fit: SigmaFit
    outlier_probability: np.ndarray
    error: np.ndarray


def fit_robust(
    r11: np.ndarray,
    r12: np.ndarray,
    size: np.ndarray,
    error: np.ndarray,
    known: np.ndarray,
    noise_known: bool = True,
) -> RobustFit:
    """Fit size² with a mixture of good points and outliers.

    Parameters
    ----------
    r11, r12, size, error, known : ndarray
        As `fit_sizes`, each of shape (n,).
    noise_known : bool
        If not, the errors are right up to a factor, which the median residual of the start
        gives (1.4826 times it is one standard deviation of a normal distribution).

    Returns
    -------
    RobustFit
        The maximum of the mixture likelihood nearest the least-median-of-squares start.

    Notes
    -----
    Expectation-maximisation for a normal mixture (1 - f) N(0, 1) + f N(0, 10²) of the
    residuals over their errors with f = 5 %, the good-and-bad-data model of D. W. Hogg,
    J. Bovy and D. Lang, arXiv:1008.4686 (2010), section 3. It starts from whichever fit
    without one point has the smallest median residual, so that one wild point cannot choose
    the start.

    Examples
    --------
    >>> r11, r12 = np.linspace(1, -1, 9), np.full(9, 2.0)
    >>> true = np.sqrt(r11**2 * 4e-8 + r12**2 * 1e-8)
    >>> size = true * np.where(np.arange(9) == 2, 1.5, 1.0)
    >>> fit_robust(r11, r12, size, 0.02 * true, np.zeros(9)).outlier_probability.round(2).tolist()
    [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    """

    def pulls(sigma: np.ndarray, error: np.ndarray) -> np.ndarray:
        return (size_squared(sigma, r11, r12, known) - size**2) / (2.0 * size * error)

    n = len(size)
    left_out = np.unique(np.linspace(0, n - 1, min(n, STARTS)).round().astype(int))
    without = np.where(np.arange(n) == left_out[:, None], np.inf, error)
    starts = np.vstack(
        [
            fit_sizes(r11, r12, size, error, known).sigma[None],
            fit_sizes(r11, r12, size, without, known).sigma,
        ]
    )
    pull = pulls(min(starts, key=lambda s: np.median(np.abs(pulls(s, error)))), error)
    if not noise_known:
        factor = 1.4826 * np.median(np.abs(pull)) * np.sqrt(n / max(n - 3, 1))
        factor = max(factor, 1e-9)  # points that fit exactly have no noise to scale by
        pull, error = pull / factor, error * factor
    width = WIDTH
    for _ in range(200):
        # Odds by their logarithm: far out both densities are zero, their ratio is not.
        odds = np.log(FRACTION / width / (1 - FRACTION)) + 0.5 * pull**2 * (1 - width**-2)
        probability = expit(odds)
        # The outliers' own width: a point off by 300 errors must not pull by 30.
        width = max(WIDTH, float(np.sqrt(probability @ pull**2 / probability.sum())))
        widened = error / np.sqrt((1.0 - probability) + probability / width**2)
        fit = fit_sizes(r11, r12, size, widened, known)
        moved = pulls(np.asarray(fit.sigma), error)
        settled = np.max(np.abs(moved - pull)) < 1e-9
        pull = moved
        if settled:
            break
    return RobustFit(fit._replace(converged=np.bool_(settled)), probability, widened)
