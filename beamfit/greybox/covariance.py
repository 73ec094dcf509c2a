"""Errors, shares and degrees of freedom of the free numbers, by residuals, priors and bounds.

The one place for singular values and factors. Up to `FEW` free numbers columns are scaled to unit
length, rows are reduced by QR before any singular value is taken, and one cut tells what is seen
from what is not. Above, errors come from factors of JᵀJ (`beamfit.greybox.sparse`). Bounds count as
information, since a number that the data leave open ends on a bound or anywhere between two.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy import sparse

from beamfit.greybox.problem import Record
from beamfit.greybox.sparse import Factor, Rows, in_units, lengths, with_diagonal
from beamfit.noise.correlated import CUT

# Free numbers up to which all is dense, by orthogonal factors and singular values.
FEW = 200
# A quantity counts as determined while bounds carry less than this share of its variance.
MOST_SHARE = 0.5
# A quantity moves along an open direction if more than this share of its terms remains.
PART = 1e-6
# Standard deviation of an undetermined direction, in units of the best determined one.
FAR = 1e12
# Least eigenvalue of the normal equations, as a share of the largest with columns of unit length,
# down to which their errors are good to 1e-6.
SAFE = 1e-10


class Group(NamedTuple):
    """The noise of one record.

    `rows` are its rows among the residuals, `count` those of a weight above zero, `dof` is `count`
    less the trace of the hat matrix over them. `scale` is sqrt(chi2/dof), at least 1 where errors
    were given, NaN without a degree of freedom; a guess at the noise adds its own to both.
    """

    name: str
    rows: slice
    errors_given: bool
    chi2: float
    count: int
    dof: float
    scale: float

    @property
    def factor(self) -> float:
        """Divisor of the residuals before their information counts; 1 if the scatter is unknown."""
        # A model that meets its data exactly must not divide by zero.
        return 1.0 if math.isnan(self.scale) else max(self.scale, 1e-30)

    @property
    def unknown(self) -> bool:
        """True if the noise is known neither from errors nor from the scatter."""
        return not (self.errors_given or self.scale >= 0)


class Spread(NamedTuple):
    """Error of the free numbers: directions that the data determine, and open ones.

    `half` (n, k) has the covariance of the directions that are seen, half @ half.T; `open` (n, u)
    are the others, `FAR` long, `reach` (n,) how far each number moves along one at most;
    `from_bounds` (n,) is the information of the bounds.
    """

    half: np.ndarray
    open: np.ndarray
    reach: np.ndarray
    from_bounds: np.ndarray

    @property
    def seen(self) -> np.ndarray:
        """Covariance of what residuals, priors or bounds limit, shape (n, n)."""
        return self.half @ self.half.T

    @property
    def covariance(self) -> np.ndarray:
        """Covariance, huge along open directions: for designs, which add information."""
        return self.seen + self.open @ self.open.T

    @property
    def rank(self) -> int:
        """Number of directions that the data determine."""
        return self.half.shape[1]

    @property
    def errors(self) -> np.ndarray:
        """Standard error of each number."""
        return self.error(np.eye(len(self.half)))

    @property
    def shares(self) -> np.ndarray:
        """`share` of each number."""
        return self.share(np.eye(len(self.half)))

    def times(self, factor: float) -> Spread:
        """The spread where all rows are divided by a factor, bounds telling nothing."""
        return self._replace(half=factor * self.half)

    def trace(self, rows: np.ndarray) -> float:
        """Trace of these rows' part of the hat matrix J (JᵀJ)⁻¹ Jᵀ."""
        return float(np.sum((rows @ self.half) ** 2))

    def size(self, gradient: np.ndarray) -> np.ndarray:
        """Standard error along the directions that are seen."""
        return np.linalg.norm(gradient @ self.half, axis=-1)

    def error(self, gradient: np.ndarray) -> np.ndarray:
        """Standard error of quantities by their gradients, shape (..., n) to (...)."""
        return np.where(self._open(gradient), np.inf, self.size(gradient))

    def share(self, gradient: np.ndarray) -> np.ndarray:
        """Share of each quantity's variance that rests on bounds or on nothing, from 0 to 1."""
        along = gradient @ self.half
        with np.errstate(over="ignore", invalid="ignore"):  # of what nothing is known: no share
            from_bounds = (along @ self.half.T) ** 2 @ self.from_bounds
        whole = np.sum(along**2, axis=-1)
        share = from_bounds / np.where(whole > 0, whole, 1.0)
        return np.where(self._open(gradient), 1.0, share)

    def _open(self, gradient: np.ndarray) -> np.ndarray:
        moved = np.max(np.abs(gradient @ self.open), axis=-1, initial=0.0)
        return moved > PART * (np.abs(gradient) @ self.reach)


class FactoredSpread:
    """A `Spread` of many numbers without an open direction, from factors of the information.

    `loose` are the numbers that move, `unit` the lengths of their columns, `factor` is of the
    information in those units.
    """

    def __init__(self, loose: np.ndarray, unit: np.ndarray, factor: Factor, from_bounds):
        self.loose, self.unit, self.factor, self.from_bounds = loose, unit, factor, from_bounds
        self.rank = int(loose.sum())
        self.open = np.zeros((len(loose), 0))

    def times(self, factor: float) -> FactoredSpread:
        """The spread where all rows are divided by a factor, bounds telling nothing."""
        return FactoredSpread(self.loose, self.unit / factor, self.factor, self.from_bounds)

    @property
    def safe(self) -> bool:
        """True if the normal equations determine every direction beyond rounding errors.

        The trace of the inverse is not below 1 over the least eigenvalue.
        """
        own = self.factor.inverse.diagonal()
        largest = np.max(np.asarray(abs(self.factor.matrix).sum(axis=0)), initial=0.0)
        return bool(np.all(own > 0) and np.sum(own) * largest < 1 / SAFE)

    @cached_property
    def seen(self) -> np.ndarray:
        """Covariance, shape (n, n)."""
        found = np.zeros((len(self.loose),) * 2)
        half = self.factor.solve(np.diag(1.0 / self.unit)) / self.unit[:, None]
        found[np.ix_(self.loose, self.loose)] = half
        return found

    @property
    def covariance(self) -> np.ndarray:
        """The same: no direction is open."""
        return self.seen

    @cached_property
    def errors(self) -> np.ndarray:
        """Standard error of each number."""
        return self._spread(np.sqrt(self.factor.inverse.diagonal()) / self.unit)

    @cached_property
    def shares(self) -> np.ndarray:
        """Share of each number's variance that rests on bounds."""
        bounds = self.from_bounds[self.loose] / self.unit**2
        if not bounds.any():
            return np.zeros(len(self.loose))
        return self._spread(self.factor.loss(bounds) / self.factor.inverse.diagonal())

    def _spread(self, values: np.ndarray) -> np.ndarray:
        found = np.zeros(len(self.loose))
        found[self.loose] = values
        return found

    def trace(self, rows: Rows) -> float:
        """Trace of these rows' part of the hat matrix."""
        part = in_units(rows[:, self.loose], self.unit)
        squares, inverse = part.T @ part, self.factor.inverse
        both = inverse.multiply(squares) if sparse.issparse(inverse) else inverse * squares
        return float(both.sum())

    def _along(self, gradient: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        flat = np.reshape(gradient, (-1, len(self.loose)))[:, self.loose] / self.unit
        return flat, self.factor.solve(flat.T).T

    def size(self, gradient: np.ndarray) -> np.ndarray:
        """Standard error of quantities by their gradients, shape (..., n) to (...)."""
        flat, along = self._along(gradient)
        return np.sqrt(np.sum(flat * along, axis=-1)).reshape(np.shape(gradient)[:-1])

    def error(self, gradient: np.ndarray) -> np.ndarray:
        """The same."""
        return self.size(gradient)

    def share(self, gradient: np.ndarray) -> np.ndarray:
        """Share of each quantity's variance that rests on bounds."""
        flat, along = self._along(gradient)
        whole = np.sum(flat * along, axis=-1)
        part = along**2 @ (self.from_bounds[self.loose] / self.unit**2)
        share = part / np.where(whole > 0, whole, 1.0)
        return share.reshape(np.shape(gradient)[:-1])


def triangle(rows: Rows) -> Rows:
    """The triangle R of rows = Q R where that is smaller, RᵀR = rowsᵀrows; many numbers stay."""
    if rows.shape[0] <= rows.shape[1] or rows.shape[1] > FEW:
        return rows
    return np.linalg.qr(rows, mode="r")


def directions(
    rows: np.ndarray, equations: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Split the space of numbers into what rows see, in units of its error, and what they do not.

    What is seen has a singular value above `CUT` of the largest, columns scaled to unit length.

    Parameters
    ----------
    rows : ndarray
        Shape (m, n), a Jacobian of residuals in units of their errors.
    equations : ndarray, optional
        Shape (e, n): directions must be orthogonal to these.

    Returns
    -------
    half : ndarray, shape (n, k)
        half @ half.T is the inverse of rowsᵀrows on the k directions that are seen.
    open : ndarray, shape (n, u)
        The others, `FAR` long.
    reach : ndarray, shape (n,)
        How far each number can move along one of those.
    """
    n = rows.shape[1]
    if rows.shape[0] > n:
        rows = np.linalg.qr(rows, mode="r")
    length = np.linalg.norm(rows, axis=0)
    unit = 1.0 / np.where(length > 0, length, 1.0)
    tangent = np.eye(n)
    if equations is not None and len(equations):
        tangent = null_space(equations * unit)
    if not tangent.shape[1]:
        return np.zeros((n, 0)), np.zeros((n, 0)), unit
    _, sizes, turned = np.linalg.svd(rows * unit @ tangent, full_matrices=True)
    largest = np.max(sizes, initial=0.0)
    rank = int(np.sum(sizes > CUT * largest))
    along = unit[:, None] * (tangent @ turned.T)
    far = FAR / largest if largest > 0 else FAR
    return along[:, :rank] / sizes[:rank], along[:, rank:] * far, unit * far


def null_space(rows: np.ndarray) -> np.ndarray:
    """An orthonormal basis of what is orthogonal to a few rows."""
    # Rows of one size each: the rank of equations does not depend on their units.
    length = np.linalg.norm(rows, axis=1, keepdims=True)
    rows = rows / np.where(length > 0, length, 1.0)
    _, sizes, turned = np.linalg.svd(rows, full_matrices=True)
    return turned[int(np.sum(sizes > CUT * np.max(sizes, initial=0.0))) :].T


def spread_of(
    jacobian: Rows,
    lower: np.ndarray,
    upper: np.ndarray,
    held: np.ndarray | None = None,
    with_prior: np.ndarray | None = None,
    equations: np.ndarray | None = None,
) -> Spread | FactoredSpread:
    """Spread of numbers from the Jacobian of residuals, bounds counted as information.

    Parameters
    ----------
    jacobian : ndarray
        Shape (m, n), of residuals in units of their errors, priors among them.
    lower, upper : ndarray
        Shape (n,); infinite where there is no bound.
    held : ndarray of bool, optional
        Numbers that do not move.
    with_prior : ndarray of bool, optional
        Numbers with a prior of their own, whose bounds add nothing.
    equations : ndarray, optional
        Shape (e, n): gradients of the constraints that hold.

    Returns
    -------
    Spread
        A `FactoredSpread` of more than `FEW` numbers that are all seen clearly.

    Notes
    -----
    A number that data leave open ends on one of its bounds, while the truth may lie anywhere
    between them: the mean square distance from an end of a range of width w is w²/3 (and not
    w²/12, as from its middle). Then Var(q) = g C g with C = (JᵀJ + B)⁻¹, B = diag(3/w²), and
    C B C is the part of C that B carries.

    Examples
    --------
    >>> s = spread_of(np.array([[1.0, 0.0]]), np.array([0.0, 0.0]), np.array([100.0, 6.0]))
    >>> s.share(np.eye(2)).round(3).tolist(), s.error(np.eye(2)).round(2).tolist()
    ([0.0, 1.0], [1.0, 3.46])
    """
    n = jacobian.shape[1]
    width = np.asarray(upper, float) - np.asarray(lower, float)
    usable = np.isfinite(width) & (width > 0)
    if with_prior is not None:
        usable &= ~with_prior
    loose = np.ones(n, bool) if held is None else ~held
    information = np.where(usable & loose, 3.0 / np.where(usable, width, 1.0) ** 2, 0.0)
    if n > FEW and (equations is None or not len(equations)):
        known = _factored(jacobian, information, loose)
        if known is not None:
            return known
    if sparse.issparse(jacobian):
        jacobian = jacobian.toarray()
    rows = np.vstack([triangle(jacobian), np.diag(np.sqrt(information))])[:, loose]
    found = directions(rows, None if equations is None else equations[:, loose])
    whole = [np.zeros((n, *part.shape[1:])) for part in found]
    for out, part in zip(whole, found, strict=True):
        out[loose] = part
    return Spread(*whole, information)


def _factored(jacobian: Rows, information: np.ndarray, loose: np.ndarray) -> FactoredSpread | None:
    """Spread by normal equations, if they are safe."""
    rows = jacobian[:, loose]
    unit = np.sqrt(lengths(rows) ** 2 + information[loose])
    if not np.all(unit > 0):
        return None
    rows = in_units(rows, unit)
    normal = with_diagonal(rows.T @ rows, information[loose] / unit**2)
    try:
        found = FactoredSpread(loose, unit, Factor(normal), information)
    except np.linalg.LinAlgError:
        return None
    return found if found.safe else None


def groups_of(
    records: Sequence[Record],
    residuals: Sequence[np.ndarray],
    blocks: Sequence[np.ndarray],
    seen: Spread | FactoredSpread,
) -> tuple[Group, ...]:
    """Chi-square, degrees of freedom and noise of each record.

    Parameters
    ----------
    records : sequence of Record
        Which values count, whether their errors were given, the guess at their noise.
    residuals : sequence of ndarray
        In units of their errors, zero where the weight is.
    blocks : sequence of ndarray
        `triangle` of each record's rows of the Jacobian, and of those of the priors.
    seen : Spread
        Of the directions that all rows together see.

    Returns
    -------
    tuple of Group

    Notes
    -----
    Errors that are guessed, worth ν0 degrees of freedom, make the variance (ν0 + χ²)/(ν0 + dof) in
    their units: a scaled inverse χ² prior, A. Gelman et al., Bayesian Data Analysis (3rd ed.,
    2013), section 2.6.
    """
    found, first, whole = [], 0, sum(block.shape[0] for block in blocks)
    for record, r, block in zip(records, residuals, blocks, strict=False):
        chi2, count = float(r @ r), int(record.used.sum())
        # The trace over all rows is their rank.
        hat = seen.rank if block.shape[0] == whole else seen.trace(block)
        dof = round(count - hat, 9)
        guess = record.prior_freedom
        scale = math.sqrt((guess + chi2) / (guess + dof)) if dof > 0 else math.nan
        scale = max(1.0, scale) if record.errors_given else scale
        rows = slice(first, first := first + len(r))
        found.append(Group(record.name, rows, record.errors_given, chi2, count, dof, scale))
    return tuple(found)
