"""Identifiability, probabilities, intervals of draws, and control limits."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc, fdtrc, gammaln, logsumexp, ndtr, stdtr, stdtrit

from beamfit.quantity import NORMAL_REACH, Quantity

# χ² probability below which a fit is poor, as defined in the contract of the JSON output.
POOR_FIT = 1e-3
# Log odds above which a statement counts as certain: one in a thousand is then wrong
# (A. Wald, Sequential Analysis, 1947).
CLEAR_ODDS = -math.log(POOR_FIT)
# A direction is undetermined if its singular value is below this: a relative error above a third.
MIN_SINGULAR_VALUE = 3.0
# A positive value is useful if its 95 % interval spans less than this factor.
USEFUL = 2.5
# Baseline of a series: largest and smallest number of its first points (at most half of all).
MAX_BASELINE = 20
MIN_BASELINE = 3
# Degrees of freedom below which the message gives the 95 % interval of Student's distribution.
FEW_DOF = 8
# Ends of the central 68 % and 95 % intervals of draws.
CENTRAL = (0.16, 0.84)
WIDE = (0.025, 0.975)
# Effective sample size below which draws give no error.
MIN_EFFECTIVE_DRAWS = 10.0
# Prior widths of a relative change: smaller ones are undetectable, larger ones rare.
CHANGE_WIDTHS = np.geomspace(1e-4, 0.5, 16)
# Mean range of two normal numbers in standard deviations (d2 of control charts).
MEAN_RANGE = 1.128
# Degrees of freedom of a moving range, per range.
RANGE_DOF = 0.62
# Probability below 3 standard deviations; one point in 370 lies outside ±3.
THREE_SIGMA = float(ndtr(3.0))


class Directions(NamedTuple):
    """Singular values of a scaled Jacobian, and the directions that the data do not determine.

    Attributes
    ----------
    singular_values : ndarray
        In descending order; each is the inverse of the relative error along its direction.
    condition : float
        Largest divided by smallest; infinite if the smallest is zero.
    undetermined : tuple of str
        Directions with a relative error above a third, as texts such as ``a - b``.
    """

    singular_values: np.ndarray
    condition: float
    undetermined: tuple[str, ...]


def scaled_directions(jacobian: np.ndarray, scale: np.ndarray, names: list[str]) -> Directions:
    """Find the parameter combinations that residuals determine, by the SVD of J · diag(scale).

    Parameters
    ----------
    jacobian : ndarray
        Shape (points, parameters): derivative of model/error with respect to the parameters.
    scale : ndarray
        Shape (parameters,): magnitude of each parameter, so that a unit step means 100 %.
    names : list of str
        Parameter names.

    Returns
    -------
    Directions

    Notes
    -----
    With unit errors the covariance is (JᵀJ)⁻¹ = V S⁻² Vᵀ (the linear theory of least
    squares), so the relative error along column k of V is 1/S_k.

    Examples
    --------
    >>> found = scaled_directions(np.array([[10.0, 10.0], [10.0, 10.0]]), np.ones(2), ["a", "b"])
    >>> found.undetermined
    ('a - b',)
    """
    scaled = np.asarray(jacobian) * scale
    if not np.isfinite(scaled).all():
        return Directions(np.zeros(len(names)), np.inf, tuple(names))
    # Full V also for fewer points than parameters, to include the null space.
    _, values, rows = np.linalg.svd(scaled, full_matrices=scaled.shape[0] < scaled.shape[1])
    values = np.concatenate([values, np.zeros(len(names) - len(values))])
    smallest = values[-1] if values[-1] > 1e-13 * values[0] else 0.0
    open_rows = [row for value, row in zip(values, rows, strict=True) if value < MIN_SINGULAR_VALUE]
    return Directions(
        singular_values=values,
        condition=float(values[0] / smallest) if smallest else np.inf,
        undetermined=tuple(_in_words(row, names) for row in open_rows),
    )


def _in_words(row: np.ndarray, names: list[str]) -> str:
    """Write a direction as the sum of its larger components."""
    row = row / row[np.argmax(np.abs(row))]
    terms = [(c, n) for c, n in zip(row, names, strict=True) if abs(c) >= 0.1]
    words = ""
    for coefficient, name in terms:
        sign = " - " if coefficient < 0 else " + "
        size = "" if round(abs(coefficient), 1) == 1.0 else f"{abs(coefficient):.1f} "
        words += f"{sign}{size}{name}"
    return words.removeprefix(" + ").strip()


def chi2_probability(chi2: float, dof: float, error_dof: float = math.inf) -> float | None:
    """Probability of a χ² at least this large if the errors are right; None if ``dof`` is zero.

    Parameters
    ----------
    chi2, dof : float
        χ² and its degrees of freedom.
    error_dof : float
        Degrees of freedom from which the errors were estimated: χ²/dof then follows Fisher's F
        distribution.

    Examples
    --------
    >>> round(chi2_probability(18.3, 2), 7), round(chi2_probability(18.3, 2, 20), 7)
    (0.0001062, 0.0015077)
    """
    if not dof > 0:
        return None
    if math.isinf(error_dof):
        return float(chdtrc(dof, chi2))
    return float(fdtrc(dof, error_dof, chi2 / dof))


def log_student(t: np.ndarray, dof: np.ndarray | float) -> np.ndarray:
    """Log density of Student's t distribution.

    Examples
    --------
    >>> f"{np.exp(log_student(0.0, 1.0)) * math.pi:.6f}"
    '1.000000'
    """
    top = gammaln(0.5 * (dof + 1)) - gammaln(0.5 * dof) - 0.5 * np.log(math.pi * dof)
    return top - (dof + 1) * np.log(np.hypot(1.0, t / np.sqrt(dof)))  # t² may overflow


def log_evidence_of_change(
    squares: np.ndarray, information: np.ndarray, dof: float = math.inf
) -> np.ndarray:
    """Log evidence ratio of a change against no change.

    Parameters
    ----------
    squares : array
        Squared changes divided by their variances.
    information : array
        Inverse variances of the relative changes.
    dof : float, optional
        Degrees of freedom from which the noise level was estimated; known if infinite (default).

    Returns
    -------
    array

    Notes
    -----
    The ratio of two normal densities of the observed change, with variances V + W and V, integrated
    over the noise level if that was estimated. The prior of the change is normal about zero, with a
    width W flat in the logarithm (`CHANGE_WIDTHS`). Without a change the ratio is a martingale in
    time, so that the probability that it ever exceeds c is at most 1/c (G. Shafer et al., Statist.
    Sci. 26 (2011) 84).

    Examples
    --------
    >>> log_evidence_of_change(np.array([0.0, 36.0]), np.array([1e4, 1e4])).round(1).tolist()
    [-0.5, 14.2]
    """
    sizes = CHANGE_WIDTHS.reshape(-1, *(1,) * np.ndim(squares))
    worth = information * sizes**2
    if math.isinf(dof):
        log = 0.5 * squares * (worth / (1 + worth))
    else:
        log = np.log1p(squares / dof) - np.log1p(squares / (1 + worth) / dof)
        log = 0.5 * (dof + 1) * log
    return logsumexp(log - 0.5 * np.log1p(worth), axis=0) - math.log(CHANGE_WIDTHS.size)


def quantity_of_draws(draws: np.ndarray, unit: str, value: float | None = None) -> Quantity:
    """Make a quantity from posterior draws.

    Parameters
    ----------
    draws : ndarray
        Shape (d,); non-finite draws are left out.
    unit : str
        Unit of the draws.
    value : float, optional
        Quoted value; the median if None.

    Returns
    -------
    Quantity
        Its error is half of the central 68 % interval, its interval the central 95 %. It has
        neither if 2.5 % or more of the draws are not finite.

    Examples
    --------
    >>> quantity_of_draws(np.linspace(0.0, 2.0, 101), "m")
    <Quantity 1.00 ± 0.68 m>
    >>> quantity_of_draws(np.append(np.linspace(0.0, 2.0, 101), 9 * [np.nan]), "m").error is None
    True
    """
    found = np.isfinite(draws)
    if not found.any():
        return Quantity(math.nan, None, unit)
    lost, draws = float(np.mean(~found)), draws[found]
    value = float(np.median(draws)) if value is None else float(value)
    if lost >= WIDE[0]:
        return Quantity(value, None, unit)
    low, high = np.quantile(draws, CENTRAL)
    ends = np.quantile(draws, WIDE)
    return Quantity(value, 0.5 * float(high - low), unit, None, (float(ends[0]), float(ends[1])))


def of_use(interval_95: tuple[float, float] | None) -> bool:
    """Check that the 95 % interval of a positive value spans less than a factor `USEFUL`.

    Examples
    --------
    >>> of_use((1.0, 2.0)), of_use((1.0, 3.0)), of_use((-0.1, 0.1)), of_use(None)
    (True, False, False, False)
    """
    low, high = interval_95 or (0.0, 0.0)
    return low > 0.0 and high < USEFUL * low


def one_sided_probability(deviations: float, dof: float) -> float:
    """Probability that noise alone gives a value this many standard errors above zero.

    Parameters
    ----------
    deviations : float
        Value divided by its standard error.
    dof : float
        Degrees of freedom from which the error was estimated (Student's distribution); infinite for
        a known error (normal distribution).

    Examples
    --------
    >>> round(one_sided_probability(3.0, math.inf), 5)
    0.00135
    >>> round(one_sided_probability(3.0, 2), 3)
    0.048
    """
    if math.isinf(dof):
        return float(ndtr(-deviations))
    return float(stdtr(dof, -deviations)) if dof > 0 else 1.0


def reach_of(dof: float) -> float:
    """Half-width of the 95 % interval of Student's distribution, in standard errors.

    Examples
    --------
    >>> round(reach_of(2), 2), round(reach_of(math.inf), 2)
    (4.3, 1.96)
    """
    return float(stdtrit(dof, 0.975)) if 0 < dof < math.inf else NORMAL_REACH


def few_dof_words(dof: float) -> str:
    """Sentence part with the 95 % interval in σ, if there are few degrees of freedom.

    Examples
    --------
    >>> few_dof_words(2.0)
    '; 2 degrees of freedom: the 95 % interval is ±4.3 σ'
    """
    if not 0 < dof < FEW_DOF:
        return ""
    reach = f"±{reach_of(dof):.1f} σ"
    return f"; {dof:.3g} degrees of freedom: the 95 % interval is {reach}"


def baseline(count: int) -> int:
    """Number of first points that form the baseline of a series.

    Examples
    --------
    >>> [baseline(n) for n in (4, 10, 1000)]
    [3, 5, 20]
    """
    return min(MAX_BASELINE, max(count // 2, MIN_BASELINE))


def control_limits(values: np.ndarray) -> tuple[float, float]:
    """Mean of some points, and the distance from it that a further one exceeds in one case of 370.

    Control limits of an individuals chart (D. C. Montgomery, Introduction to Statistical Quality
    Control, 7th ed., section 6.4). The standard deviation is the mean moving range divided by
    1.128, which a slow drift does not increase; the quantile is Student's, because the points are
    few. The limit is infinite for fewer than three points.

    Examples
    --------
    >>> centre, limit = control_limits(np.array([1.0, 1.1, 0.9, 1.0, 1.1, 0.9] * 3))
    >>> round(centre, 3), round(limit, 2)
    (1.0, 0.48)
    """
    if values.size < MIN_BASELINE:
        return float(values.mean()), math.inf
    spread = float(np.abs(np.diff(values)).mean()) / MEAN_RANGE
    reach = stdtrit(RANGE_DOF * (values.size - 1), THREE_SIGMA) * math.sqrt(1 + 1 / values.size)
    return float(values.mean()), float(reach) * spread
