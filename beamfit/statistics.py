"""Identifiability of parameters from data, by singular values."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc, fdtrc, gammaln, logsumexp, ndtr, stdtr, stdtrit

from beamfit.quantity import NORMAL_REACH, Quantity

# Probability of the residuals below which a fit is poor: the contract of the JSON output.
POOR_FIT = 1e-3
# Logarithm of the odds from which something is taken for so: one in a thousand is wrong then
# (A. Wald, Sequential Analysis, 1947).
CLEAR_ODDS = -math.log(POOR_FIT)
# A direction is undetermined if its value is below this many standard errors.
OPEN = 3.0
# A value is of use where its 95 % interval spans less than this factor.
USEFUL = 2.5
# Points of a baseline at most (the first ones; at most half of all), and at least.
BASELINE, FEWEST = 20, 3
# Degrees of freedom below which the message gives the 95 % interval of Student's distribution.
MANY = 8
# Ends of the central 68 and 95 % of draws.
CENTRAL, WIDE = (0.16, 0.84), (0.025, 0.975)
# Draws that are worth fewer independent ones tell no error.
LEAST_WORTH = 10.0
# Widths of a change as a share of what changes: smaller ones are not seen, larger ones seldom.
CHANGED = np.geomspace(1e-4, 0.5, 16)
# Mean range of two normal numbers in standard deviations; degrees of freedom of a moving range.
RANGE, RANGE_DOF = 1.128, 0.62
# Probability below 3 standard deviations; one point in 370 lies beyond them to either side.
BEYOND = float(ndtr(3.0))


class Directions(NamedTuple):
    """Singular values of a scaled Jacobian and the directions the data leave open.

    Attributes
    ----------
    singular_values : ndarray
        Descending; each is one over the relative error along its direction.
    condition : float
        Largest over smallest; infinite if the smallest is zero.
    undetermined : tuple of str
        The directions whose relative error exceeds a third, in words.
    """

    singular_values: np.ndarray
    condition: float
    undetermined: tuple[str, ...]


def scaled_directions(jacobian: np.ndarray, scale: np.ndarray, names: list[str]) -> Directions:
    """Decompose J · diag(scale): which combinations of parameters the residuals see.

    Parameters
    ----------
    jacobian : ndarray
        Shape (points, parameters): derivative of (model/error) by the parameters.
    scale : ndarray
        Shape (parameters,): the size of each parameter, so that a unit step means 100 %.
    names : list of str
        Parameter names, for the words.

    Returns
    -------
    Directions
        Singular values and open directions.

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
    # All right-hand directions, also those that fewer points than parameters leave out.
    _, values, rows = np.linalg.svd(scaled, full_matrices=scaled.shape[0] < scaled.shape[1])
    values = np.concatenate([values, np.zeros(len(names) - len(values))])
    smallest = values[-1] if values[-1] > 1e-13 * values[0] else 0.0
    open_rows = [row for value, row in zip(values, rows, strict=True) if value < OPEN]
    return Directions(
        singular_values=values,
        condition=float(values[0] / smallest) if smallest else np.inf,
        undetermined=tuple(_in_words(row, names) for row in open_rows),
    )


def _in_words(row: np.ndarray, names: list[str]) -> str:
    """Write a direction as a sum of its larger components."""
    row = row / row[np.argmax(np.abs(row))]
    terms = [(c, n) for c, n in zip(row, names, strict=True) if abs(c) >= 0.1]
    words = ""
    for coefficient, name in terms:
        sign = " - " if coefficient < 0 else " + "
        size = "" if round(abs(coefficient), 1) == 1.0 else f"{abs(coefficient):.1f} "
        words += f"{sign}{size}{name}"
    return words.removeprefix(" + ").strip()


def chi2_probability(chi2: float, dof: float, error_dof: float = math.inf) -> float | None:
    """Probability of a χ² at least this large if the errors are right; None without freedom.

    Parameters
    ----------
    chi2, dof : float
        χ² and its degrees of freedom.
    error_dof : float
        Degrees of freedom that the errors themselves were taken from: χ²/dof is then distributed
        as Fisher's F.

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
    """Log density of Student's t.

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
    """Logarithm of how many times likelier a change is than none.

    Parameters
    ----------
    squares : array
        Squares of changes over their errors.
    information : array
        One over the squares of the errors of relative changes.
    dof : float, optional
        Readings that tell the size of the noise, less numbers; by default it is known.

    Returns
    -------
    array

    Notes
    -----
    The ratio of two normal densities of what is seen, of variance V + W and V, the size of the
    noise integrated over where readings tell it. The change is normal about none, its width flat in
    the logarithm (`CHANGED`). In time the ratio is a martingale while nothing changes, so that it
    ever exceeds c with a probability of 1/c at most (G. Shafer et al., Statist. Sci. 26 (2011) 84).

    Examples
    --------
    >>> log_evidence_of_change(np.array([0.0, 36.0]), np.array([1e4, 1e4])).round(1).tolist()
    [-0.5, 14.2]
    """
    sizes = CHANGED.reshape(-1, *(1,) * np.ndim(squares))
    worth = information * sizes**2
    if math.isinf(dof):
        log = 0.5 * squares * (worth / (1 + worth))
    else:
        log = np.log1p(squares / dof) - np.log1p(squares / (1 + worth) / dof)
        log = 0.5 * (dof + 1) * log
    return logsumexp(log - 0.5 * np.log1p(worth), axis=0) - math.log(CHANGED.size)


def quantity_of_draws(draws: np.ndarray, unit: str, value: float | None = None) -> Quantity:
    """Make the quantity that draws of a posterior say.

    Parameters
    ----------
    draws : ndarray
        Shape (d,); those that are not finite are left out.
    unit : str
        Its unit.
    value : float, optional
        The median if None.

    Returns
    -------
    Quantity
        Its error is half of the central 68 %, its interval the central 95 %; none where more draws
        have no value than lie beyond an end of it.

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
    """Tell whether a positive value is known well enough to be of use.

    Examples
    --------
    >>> of_use((1.0, 2.0)), of_use((1.0, 3.0)), of_use((-0.1, 0.1)), of_use(None)
    (True, False, False, False)
    """
    low, high = interval_95 or (0.0, 0.0)
    return low > 0.0 and high < USEFUL * low


def one_sided_probability(deviations: float, dof: float) -> float:
    """Chance that noise alone lifts a quantity this many standard errors above zero.

    Parameters
    ----------
    deviations : float
        Value over its standard error.
    dof : float
        Degrees of freedom from which the error was taken, for Student's distribution; infinite
        where the errors were known beforehand, for the normal one.

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
    """Half-width of the 95 % interval in standard errors, by Student's distribution.

    Examples
    --------
    >>> round(reach_of(2), 2), round(reach_of(math.inf), 2)
    (4.3, 1.96)
    """
    return float(stdtrit(dof, 0.975)) if 0 < dof < math.inf else NORMAL_REACH


def few_words(rests_on: float) -> str:
    """Sentence part on the 95 % interval, if it rests on few degrees of freedom.

    Examples
    --------
    >>> few_words(2.0)
    '; 2 degrees of freedom: the 95 % interval is ±4.3 σ'
    """
    if not 0 < rests_on < MANY:
        return ""
    reach = f"±{reach_of(rests_on):.1f} σ"
    return f"; {rests_on:.3g} degrees of freedom: the 95 % interval is {reach}"


def baseline(count: int) -> int:
    """Number of first points that form the baseline of a series.

    Examples
    --------
    >>> [baseline(n) for n in (4, 10, 1000)]
    [3, 5, 20]
    """
    return min(BASELINE, max(count // 2, FEWEST))


def control_limits(values: np.ndarray) -> tuple[float, float]:
    """Mean of some points, and how far from it a further one lies in one case of 370.

    Of an individuals chart (D. C. Montgomery, Introduction to Statistical Quality Control, 7th
    ed., section 6.4): 3 standard deviations, these from the mean moving range over 1.128, which a
    slow drift does not widen; Student's quantile, since they come from few points. Infinite for
    fewer than three.

    Examples
    --------
    >>> centre, limit = control_limits(np.array([1.0, 1.1, 0.9, 1.0, 1.1, 0.9] * 3))
    >>> round(centre, 3), round(limit, 2)
    (1.0, 0.48)
    """
    if values.size < FEWEST:
        return float(values.mean()), math.inf
    spread = float(np.abs(np.diff(values)).mean()) / RANGE
    reach = stdtrit(RANGE_DOF * (values.size - 1), BEYOND) * math.sqrt(1 + 1 / values.size)
    return float(values.mean()), float(reach) * spread
