"""Points that lie off: what one of them does to a fit of σ, and a fit that doubts each point."""

from __future__ import annotations

import math
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.special import expit, fdtrc

from beamfit.statistics import POOR_FIT
from beamfit.studies.scan.model import coefficients, size_squared
from beamfit.studies.scan.noise import DOUBTFUL, ENOUGH_POINTS, Noise
from beamfit.studies.scan.results import Points
from beamfit.studies.scan.sigma import error_at, fit_sizes

# A point carries the answer if the emittance moves by so many of its errors without it.
CARRIES = 2.0


class Influence(NamedTuple):
    """What single points do.

    Attributes
    ----------
    outlier : str
        The one point, or two neighbours, without which the others agree; empty if there is none.
    without : float
        Probability of the others' χ², where errors are known.
    chance : float
        How often noise puts some point, or two neighbours, so far from the others.
    carrying : str
        Where the point lies without which the emittance moves most, if it moves far.
    shift : float
        How far, in errors of the emittance; NaN where the others give none.
    """

    outlier: str = ""
    without: float = math.nan
    chance: float = 1.0
    carrying: str = ""
    shift: float = 0.0


def influence_of(p: Points, noise: Noise, sigma: np.ndarray, error: float) -> Influence:
    """Leave out each point in turn.

    Parameters
    ----------
    p : Points
        n points, n > 4.
    noise : Noise
        Of their sizes.
    sigma : ndarray
        Shape (3,), the best symmetric matrix.
    error : float
        Of the emittance, as quoted.

    Returns
    -------
    Influence

    Notes
    -----
    Of weighted rows a_i with residuals r_i and leverages h_i = a_iᵀ(AᵀA)⁻¹a_i, leaving out row i
    changes σ by -(AᵀA)⁻¹ a_i r_i/(1 - h_i) and χ² by -r_i²/(1 - h_i): R. D. Cook and S. Weisberg,
    Residuals and Influence in Regression (1982), eqs. 2.2.3 and 2.2.8. That χ² over the others'
    χ²/dof is distributed as F(1, dof) (the externally studentised residual); of n points the
    largest is asked for, so its probability counts n times. Two neighbours that are off to one
    side hide each other; left out together they leave r_Kᵀ(1 - H_KK)⁻¹r_K less, F(2, dof - 2).
    """
    n = len(p.size)
    scale = 0.5 / (p.weighed * p.error)
    rows = np.stack(coefficients(p.r11, p.r12), -1) * scale[:, None]
    left = (p.size**2 - p.known) * scale - rows @ sigma
    q, r = np.linalg.qr(rows)
    leverage = np.sum(q**2, axis=1)
    free = np.maximum(1.0 - leverage, 1e-12)
    chi2, dof = float(left @ left), n - 3
    rest = np.maximum(chi2 - left**2 / free, 1e-30)
    worst = int(np.argmin(rest))
    chance = min(n * float(fdtrc(1, dof - 1, (chi2 / rest[worst] - 1.0) * (dof - 1))), 1.0)
    without = noise.probability(float(rest[worst]), dof - 1)
    spoiled = noise.poor(chi2, dof) if noise.known else chance < POOR_FIT
    single = spoiled and (without is None or without > DOUBTFUL)
    outlier = f"the point at {p.where(worst)}" if single else ""
    if not (noise.known or single or n < ENOUGH_POINTS):
        pair, rare = _neighbours(np.argsort(np.arctan2(p.r12, p.r11) % math.pi), q, left)
        if rare < DOUBTFUL:
            chance, outlier = rare, f"the points at {p.where(pair[0])} and {p.where(pair[1])}"
    shifts = _shifts(sigma, np.linalg.solve(r, q.T).T * (left / free)[:, None], error)
    most = int(np.argmax(np.where(np.isnan(shifts), np.inf, np.abs(shifts))))
    carries = not abs(shifts[most]) <= CARRIES and not (single and most == worst)
    return Influence(
        outlier=outlier,
        without=math.nan if without is None else without,
        chance=chance,
        carrying=p.where(most) if carries else "",
        shift=float(shifts[most]),
    )


def _neighbours(
    order: np.ndarray, q: np.ndarray, left: np.ndarray
) -> tuple[tuple[int, int], float]:
    """The two neighbours that lie farthest off, and how often noise puts some two there."""
    i, j, dof = order[:-1], order[1:], len(left) - 5
    a, b, c = (np.sum(q[k] * q[m], axis=1) for k, m in ((i, i), (j, j), (i, j)))
    falls = left[i] ** 2 * (1 - b) + left[j] ** 2 * (1 - a) + 2 * left[i] * left[j] * c
    falls /= np.maximum((1 - a) * (1 - b) - c**2, 1e-12)
    most = int(np.argmax(falls))
    ratio = falls[most] / max(float(left @ left) - falls[most], 1e-30) * dof / 2
    return (int(i[most]), int(j[most])), min(len(i) * float(fdtrc(2, dof, ratio)), 1.0)


def _shifts(sigma: np.ndarray, moves: np.ndarray, error: float) -> np.ndarray:
    """Of the emittance in errors, as each point is left out; NaN where no emittance is left."""
    s11, s12, s22 = (sigma - moves).T
    determinant = np.where((s11 > 0) & (s22 > 0), s11 * s22 - s12**2, np.nan)
    with np.errstate(invalid="ignore", divide="ignore"):
        whole = math.sqrt(max(sigma[0] * sigma[2] - sigma[1] ** 2, 0.0))
        return (np.sqrt(determinant) - whole) / error


# A point is an outlier with this probability before it is seen, and its error is then at least
# this many times larger.
FRACTION, WIDTH = 0.05, 10.0
# Starts from so many triples of points at most (and rows in all of them), and how often each is
# fitted to the half of the points that it meets best.
TRIPLES, ROWS, STEPS = 500, 2_000_000, 2


class Doubted(NamedTuple):
    """What a robust fit thinks of each point, arrays of shape (n,).

    ``error`` is that of the sizes in m, widened as far as each is thought an outlier.
    """

    outlier_probability: np.ndarray
    error: np.ndarray


def doubts(pull: np.ndarray, width: float = WIDTH) -> tuple[np.ndarray, float, np.ndarray]:
    """How likely each point is an outlier, how wide outliers scatter, and the factor on errors.

    Parameters
    ----------
    pull : ndarray
        Shape (n,), residuals over their errors.
    width : float
        Of the outliers so far, in errors.

    Examples
    --------
    >>> doubts(np.array([0.5, -1.0, 20.0]))[0].round(2).tolist()
    [0.01, 0.01, 1.0]
    """
    # Odds by their logarithm: far out both densities are zero, their ratio is not.
    odds = np.log(FRACTION / width / (1 - FRACTION)) + 0.5 * pull**2 * (1 - width**-2)
    probability = expit(odds)
    # The outliers' own width: a point off by 300 errors must not pull by 30.
    width = max(WIDTH, float(np.sqrt(probability @ pull**2 / probability.sum())))
    return probability, width, 1.0 / np.sqrt((1.0 - probability) + probability / width**2)


def fit_robust(
    r11: np.ndarray,
    r12: np.ndarray,
    size: np.ndarray,
    noise: Noise,
    known: np.ndarray,
    weights: str = "model",
) -> Doubted:
    """Fit size² with a mixture of good points and outliers.

    Parameters
    ----------
    r11, r12, size, known : ndarray
        As `fit_sizes`, each of shape (n,).
    noise : Noise
        Errors of the sizes. Those that are a guess are right up to a factor, which the median
        residual gives (1.4826 times it is one standard deviation of a normal distribution).
    weights : str
        As `fit_sizes`.

    Returns
    -------
    Doubted
        The maximum of the mixture likelihood nearest the start.

    Notes
    -----
    Expectation-maximisation for a normal mixture (1 - f) N(0, 1) + f N(0, 10²) of the
    residuals over their errors with f = 5 %, the good-and-bad-data model of D. W. Hogg,
    J. Bovy and D. Lang, arXiv:1008.4686 (2010), section 3. It starts from least trimmed squares,
    P. J. Rousseeuw and K. Van Driessen, Data Min. Knowl. Discov. 12, 29 (2006): of fits through
    three points, each fitted again to the better half, the one that meets its half best. All
    triples are tried, or 500 drawn from the points in the order of their sizes, so that the order
    of the rows of a file does not matter.

    Examples
    --------
    >>> r11, r12 = np.linspace(1, -1, 9), np.full(9, 2.0)
    >>> true = np.sqrt(r11**2 * 4e-8 + r12**2 * 1e-8)
    >>> size = true * np.where(np.arange(9) == 2, 1.5, 1.0)
    >>> noise = Noise(0.02 * true, 0.0, True, math.inf)
    >>> fit_robust(r11, r12, size, noise, np.zeros(9)).outlier_probability.round(2).tolist()
    [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    """
    n = len(size)

    def off_by(widening: np.ndarray) -> np.ndarray:
        """How many unwidened errors each point is off a fit with errors widened."""
        options = {"relative": noise.relative, "weights": weights}
        fit = fit_sizes(r11, r12, size, noise.error * widening, known, **options)
        model = size_squared(np.moveaxis(fit.sigma, -1, 0)[..., None], r11, r12, known)
        error = error_at(np.asarray(fit.weighed), size, noise.error, noise.relative)
        return (model - size**2) / (2.0 * np.asarray(fit.weighed) * error)

    pull, factor = _least_trimmed(off_by, np.lexsort((r12, r11, size))), 1.0
    if not noise.known:
        factor = 1.4826 * np.median(np.abs(pull)) * np.sqrt(n / max(n - 3, 1))
        factor = max(factor, 1e-9)  # points that fit exactly have no noise to scale by
    width = WIDTH
    for _ in range(200):
        probability, width, widening = doubts(pull / factor, width)
        last, pull = pull, off_by(widening)
        if np.max(np.abs(pull - last)) < 1e-9 * max(1.0, np.max(np.abs(last))):
            break
    return Doubted(probability, noise.error * widening)


def _least_trimmed(off_by, order: np.ndarray) -> np.ndarray:
    """Residuals of the fit that meets its better half of the points best."""
    n = len(order)
    half, most = (n + 4) // 2, max(min(TRIPLES, ROWS // n), 1)
    if math.comb(n, 3) <= TRIPLES:
        chosen = np.array(list(combinations(range(n), 3)))
    else:
        draws = np.random.default_rng(0)
        chosen = np.array([draws.choice(n, 3, replace=False) for _ in range(most)])
    kept = np.zeros((len(chosen) + 1, n), bool)
    kept[np.arange(len(chosen))[:, None], order[chosen]] = True
    kept[-1] = True  # the fit of all points
    for _ in range(STEPS + 1):
        off = np.abs(off_by(np.where(kept, 1.0, np.inf)))
        off = np.where(np.isfinite(off), off, np.inf)
        best = np.argsort(off, axis=1, kind="stable")[:, :half]
        kept = np.zeros_like(kept)
        np.put_along_axis(kept, best, True, axis=1)
    trimmed = np.sum(np.take_along_axis(off, best, 1) ** 2, axis=1)
    winner = kept[np.argmin(trimmed)]
    return off_by(np.where(winner, 1.0, np.inf))
