"""Errors and degrees of freedom of the free numbers, from residuals, priors and bounds.

All singular values and covariances of fits are computed here. Up to `MAX_DENSE` free numbers,
columns are scaled to unit length, rows are reduced by QR, and one cut on the singular values
separates determined from undetermined directions. Above, errors come from factors of JᵀJ
(`beamfit.greybox.sparse`). Bounds count as information: a number that the data do not determine
lies somewhere between its bounds.
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

# Largest number of free numbers for dense matrices, orthogonal factors and singular values.
MAX_DENSE = 200
# A quantity counts as determined if less than this share of its variance comes from bounds.
MOST_SHARE = 0.5
# A quantity depends on an undetermined direction if its change along it exceeds this share of the
# sum of the changes by each number; below, the terms cancel to rounding.
MIN_CHANGE = 1e-6
# Standard deviation assigned to an undetermined direction, in units of the best determined one.
UNDETERMINED_ERROR = 1e12
# Smallest eigenvalue of the normal equations, relative to the largest with columns of unit length,
# at which errors computed from them are still good to 1e-6.
MIN_EIGENVALUE = 1e-10


class Group(NamedTuple):
    """Noise of one record.

    `rows` are its rows among the residuals, `count` is the number of them with a weight above zero,
    and `dof` is `count` less the trace of the hat matrix over them. `scale` is sqrt(chi2/dof): at
    least 1 where errors were given, NaN without a degree of freedom. Guessed errors add their
    degrees of freedom to both chi2 and dof (`groups_of`).
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
        """Divisor that turns the residuals into units of the noise; 1 if the scatter is unknown."""
        # A model that fits its data exactly must not lead to a division by zero.
        return 1.0 if math.isnan(self.scale) else max(self.scale, 1e-30)

    @property
    def unknown(self) -> bool:
        """True if neither given errors nor the scatter determine the noise."""
        return not (self.errors_given or self.scale >= 0)


class Spread(NamedTuple):
    """Errors of the free numbers, split into determined and undetermined directions.

    `half` (n, k) is a square root of the covariance of the determined directions: half @ half.T.
    The columns of `open` (n, u) are the undetermined directions, `UNDETERMINED_ERROR` long.
    `reach` (n,) is the largest change of each number along such a direction. `from_bounds` (n,) is
    the information (inverse variance) of the bounds.
    """

    half: np.ndarray
    open: np.ndarray
    reach: np.ndarray
    from_bounds: np.ndarray

    @property
    def seen(self) -> np.ndarray:
        """Covariance along the determined directions, shape (n, n)."""
        return self.half @ self.half.T

    @property
    def covariance(self) -> np.ndarray:
        """Covariance, huge along undetermined directions: for designs, which add information."""
        return self.seen + self.open @ self.open.T

    @property
    def rank(self) -> int:
        """Number of determined directions."""
        return self.half.shape[1]

    @property
    def errors(self) -> np.ndarray:
        """Standard error of each number."""
        return self.error(np.eye(len(self.half)))

    @property
    def shares(self) -> np.ndarray:
        """Share of each number's variance that comes from bounds."""
        return self.share(np.eye(len(self.half)))

    def times(self, factor: float) -> Spread:
        """Multiply all errors by a factor; only valid without information from bounds."""
        return self._replace(half=factor * self.half)

    def trace(self, rows: np.ndarray) -> float:
        """Trace over some rows of the hat matrix J (JᵀJ)⁻¹ Jᵀ."""
        return float(np.sum((rows @ self.half) ** 2))

    def size(self, gradient: np.ndarray) -> np.ndarray:
        """Standard error of quantities along the determined directions."""
        return np.linalg.norm(gradient @ self.half, axis=-1)

    def error(self, gradient: np.ndarray) -> np.ndarray:
        """Standard error of quantities from their gradients, shape (..., n) to (...)."""
        return np.where(self._open(gradient), np.inf, self.size(gradient))

    def share(self, gradient: np.ndarray) -> np.ndarray:
        """Share of each quantity's variance that comes from bounds; 1 where it is undetermined."""
        along = gradient @ self.half
        with np.errstate(over="ignore", invalid="ignore"):  # undetermined: replaced below
            from_bounds = (along @ self.half.T) ** 2 @ self.from_bounds
        variance = np.sum(along**2, axis=-1)
        share = from_bounds / np.where(variance > 0, variance, 1.0)
        return np.where(self._open(gradient), 1.0, share)

    def _open(self, gradient: np.ndarray) -> np.ndarray:
        moved = np.max(np.abs(gradient @ self.open), axis=-1, initial=0.0)
        return moved > MIN_CHANGE * (np.abs(gradient) @ self.reach)


class FactoredSpread:
    """`Spread` of many numbers, all of them determined, from a factorized information matrix.

    `free` marks the numbers that move, `unit` are the lengths of their columns, and `factor` is the
    factorization of the information matrix in these units.
    """

    def __init__(self, free: np.ndarray, unit: np.ndarray, factor: Factor, from_bounds):
        self.free, self.unit, self.factor, self.from_bounds = free, unit, factor, from_bounds
        self.rank = int(free.sum())
        self.open = np.zeros((len(free), 0))

    def times(self, factor: float) -> FactoredSpread:
        """Multiply all errors by a factor; only valid without information from bounds."""
        return FactoredSpread(self.free, self.unit / factor, self.factor, self.from_bounds)

    @property
    def safe(self) -> bool:
        """True if the normal equations determine every direction despite rounding.

        The trace of the inverse is an upper limit on 1 over the smallest eigenvalue.
        """
        own = self.factor.inverse.diagonal()
        largest = np.max(np.asarray(abs(self.factor.matrix).sum(axis=0)), initial=0.0)
        return bool(np.all(own > 0) and np.sum(own) * largest < 1 / MIN_EIGENVALUE)

    @cached_property
    def seen(self) -> np.ndarray:
        """Covariance, shape (n, n)."""
        covariance = np.zeros((len(self.free),) * 2)
        block = self.factor.solve(np.diag(1.0 / self.unit)) / self.unit[:, None]
        covariance[np.ix_(self.free, self.free)] = block
        return covariance

    @property
    def covariance(self) -> np.ndarray:
        """Covariance, shape (n, n); no direction is undetermined."""
        return self.seen

    @cached_property
    def errors(self) -> np.ndarray:
        """Standard error of each number."""
        return self._at_free(np.sqrt(self.factor.inverse.diagonal()) / self.unit)

    @cached_property
    def shares(self) -> np.ndarray:
        """Share of each number's variance that comes from bounds."""
        bounds = self.from_bounds[self.free] / self.unit**2
        if not bounds.any():
            return np.zeros(len(self.free))
        return self._at_free(self.factor.loss(bounds) / self.factor.inverse.diagonal())

    def _at_free(self, values: np.ndarray) -> np.ndarray:
        spread = np.zeros(len(self.free))
        spread[self.free] = values
        return spread

    def trace(self, rows: Rows) -> float:
        """Trace over some rows of the hat matrix."""
        part = in_units(rows[:, self.free], self.unit)
        squares, inverse = part.T @ part, self.factor.inverse
        both = inverse.multiply(squares) if sparse.issparse(inverse) else inverse * squares
        return float(both.sum())

    def _along(self, gradient: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        flat = np.reshape(gradient, (-1, len(self.free)))[:, self.free] / self.unit
        return flat, self.factor.solve(flat.T).T

    def size(self, gradient: np.ndarray) -> np.ndarray:
        """Standard error of quantities from their gradients, shape (..., n) to (...)."""
        flat, along = self._along(gradient)
        return np.sqrt(np.sum(flat * along, axis=-1)).reshape(np.shape(gradient)[:-1])

    def error(self, gradient: np.ndarray) -> np.ndarray:
        """Standard error of quantities, as `size`: no direction is undetermined."""
        return self.size(gradient)

    def share(self, gradient: np.ndarray) -> np.ndarray:
        """Share of each quantity's variance that comes from bounds."""
        flat, along = self._along(gradient)
        variance = np.sum(flat * along, axis=-1)
        part = along**2 @ (self.from_bounds[self.free] / self.unit**2)
        share = part / np.where(variance > 0, variance, 1.0)
        return share.reshape(np.shape(gradient)[:-1])


def triangle(rows: Rows) -> Rows:
    """Reduce rows to the triangle R of rows = Q R if that is smaller; large problems stay."""
    if rows.shape[0] <= rows.shape[1] or rows.shape[1] > MAX_DENSE:
        return rows
    return np.linalg.qr(rows, mode="r")


def directions(
    rows: np.ndarray, equations: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Split the space of numbers into determined and undetermined directions.

    A direction is determined if its singular value exceeds `CUT` of the largest, with columns
    scaled to unit length.

    Parameters
    ----------
    rows : ndarray
        Shape (m, n), Jacobian of residuals in units of their errors.
    equations : ndarray, optional
        Shape (e, n); directions are orthogonal to these rows.

    Returns
    -------
    half : ndarray, shape (n, k)
        Square root of the covariance: half @ half.T is the inverse of rowsᵀrows on the k determined
        directions.
    open : ndarray, shape (n, u)
        Undetermined directions, `UNDETERMINED_ERROR` long.
    reach : ndarray, shape (n,)
        Largest change of each number along an undetermined direction.
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
    _, sizes, right = np.linalg.svd(rows * unit @ tangent, full_matrices=True)
    largest = np.max(sizes, initial=0.0)
    rank = int(np.sum(sizes > CUT * largest))
    along = unit[:, None] * (tangent @ right.T)
    far = UNDETERMINED_ERROR / largest if largest > 0 else UNDETERMINED_ERROR
    return along[:, :rank] / sizes[:rank], along[:, rank:] * far, unit * far


def null_space(rows: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis of the null space of a few rows."""
    # Rows of unit length: the rank must not depend on the units of equations.
    length = np.linalg.norm(rows, axis=1, keepdims=True)
    rows = rows / np.where(length > 0, length, 1.0)
    _, sizes, right = np.linalg.svd(rows, full_matrices=True)
    return right[int(np.sum(sizes > CUT * np.max(sizes, initial=0.0))) :].T


def spread_of(
    jacobian: Rows,
    lower: np.ndarray,
    upper: np.ndarray,
    held: np.ndarray | None = None,
    with_prior: np.ndarray | None = None,
    equations: np.ndarray | None = None,
) -> Spread | FactoredSpread:
    """Compute the errors of numbers from the Jacobian of residuals, with bounds as information.

    Parameters
    ----------
    jacobian : ndarray
        Shape (m, n), of residuals in units of their errors, priors among them.
    lower, upper : ndarray
        Shape (n,); infinite where there is no bound.
    held : ndarray of bool, optional
        Numbers that do not move.
    with_prior : ndarray of bool, optional
        Numbers with a prior; their bounds add no information.
    equations : ndarray, optional
        Shape (e, n), gradients of the active constraints.

    Returns
    -------
    Spread
        A `FactoredSpread` if there are more than `MAX_DENSE` numbers, all well determined.

    Notes
    -----
    The fit puts a number that the data do not determine on one of its bounds, while the true value
    may lie anywhere between them: the mean square distance from an end of a range of width w is
    w²/3 (from its middle it would be w²/12). So the covariance is C = (JᵀJ + B)⁻¹ with
    B = diag(3/w²), the variance of a quantity with gradient g is gᵀ C g, and C B C is the part of C
    that comes from the bounds.

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
    free = np.ones(n, bool) if held is None else ~held
    information = np.where(usable & free, 3.0 / np.where(usable, width, 1.0) ** 2, 0.0)
    if n > MAX_DENSE and (equations is None or not len(equations)):
        factored = _factored(jacobian, information, free)
        if factored is not None:
            return factored
    if sparse.issparse(jacobian):
        jacobian = jacobian.toarray()
    rows = np.vstack([triangle(jacobian), np.diag(np.sqrt(information))])[:, free]
    found = directions(rows, None if equations is None else equations[:, free])
    parts = [np.zeros((n, *part.shape[1:])) for part in found]
    for out, part in zip(parts, found, strict=True):
        out[free] = part
    return Spread(*parts, information)


def _factored(jacobian: Rows, information: np.ndarray, free: np.ndarray) -> FactoredSpread | None:
    """Compute the errors by normal equations; None if these are not accurate enough."""
    rows = jacobian[:, free]
    unit = np.sqrt(lengths(rows) ** 2 + information[free])
    if not np.all(unit > 0):
        return None
    rows = in_units(rows, unit)
    normal = with_diagonal(rows.T @ rows, information[free] / unit**2)
    try:
        found = FactoredSpread(free, unit, Factor(normal), information)
    except np.linalg.LinAlgError:
        return None
    return found if found.safe else None


def groups_of(
    records: Sequence[Record],
    residuals: Sequence[np.ndarray],
    blocks: Sequence[np.ndarray],
    spread: Spread | FactoredSpread,
) -> tuple[Group, ...]:
    """Compute chi-square, degrees of freedom and noise of each record.

    Parameters
    ----------
    records : sequence of Record
        The records with their errors and weights.
    residuals : sequence of ndarray
        Residuals of each record in units of their errors, zero where the weight is zero.
    blocks : sequence of ndarray
        `triangle` of each record's rows of the Jacobian, and of those of the priors.
    spread : Spread
        Spread from all rows together.

    Returns
    -------
    tuple of Group

    Notes
    -----
    If the errors are a guess worth ν0 degrees of freedom, the variance in their units is
    (ν0 + χ²)/(ν0 + dof): a scaled inverse χ² prior, A. Gelman et al., Bayesian Data Analysis (3rd
    ed., 2013), section 2.6.
    """
    groups, first, row_count = [], 0, sum(block.shape[0] for block in blocks)
    for record, r, block in zip(records, residuals, blocks, strict=False):
        chi2, count = float(r @ r), int(record.used.sum())
        # The trace of the whole hat matrix is the rank.
        hat = spread.rank if block.shape[0] == row_count else spread.trace(block)
        dof = round(count - hat, 9)
        guess = record.prior_freedom
        scale = math.sqrt((guess + chi2) / (guess + dof)) if dof > 0 else math.nan
        scale = max(1.0, scale) if record.errors_given else scale
        rows = slice(first, first := first + len(r))
        groups.append(Group(record.name, rows, record.errors_given, chi2, count, dof, scale))
    return tuple(groups)
