"""Optimality of a point and multipliers of its limits, judged here and not by a solver.

At an optimum of cost f within limits on c(theta) and bounds on theta there are multipliers y, z
with grad f = J_c^T y + z (stationarity), y and z zero where a limit is not reached, not negative at
a lower and not positive at an upper limit (Nocedal & Wright, Numerical Optimization, 2nd ed.,
section 12.1). So a multiplier is d(cost)/d(limit), with cost = chi-square/2. All is judged in the
problem's own sizes, so that no answer hangs on units.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import numpy as np
from scipy import sparse

from beamfit.greybox import problem
from beamfit.greybox.problem import Problem
from beamfit.greybox.sparse import Rows, lengths

# A bound also counts as reached if moving onto it changes the cost by less than this share.
CLOSE = 1e-8
# The size of a limited value is at most this many times the one at the end: a start at which it was
# exp(100) must not make every end feasible.
GROWN = 1e3
# Random test points about a point, and their distance in sizes of the numbers.
LOOKS, NEAR = 4, 0.3


class Slopes(NamedTuple):
    """Values and first derivatives at a point."""

    residual: np.ndarray
    residual_jacobian: Rows
    cost: float
    gradient: np.ndarray
    constraints: np.ndarray
    jacobian: np.ndarray

    @property
    def finite(self) -> bool:
        """True if every part is finite."""
        parts = (part.data if sparse.issparse(part) else part for part in self)
        return all(np.all(np.isfinite(part)) for part in parts)


class Scale(NamedTuple):
    """Sizes taken from the problem itself: of the free numbers, constraint values and the cost."""

    unit: np.ndarray
    limit: np.ndarray
    cost: float


class LimitedValues(NamedTuple):
    """Values with their lower and upper limits, their sizes, and how near counts as reached."""

    value: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    size: np.ndarray
    near: np.ndarray

    @property
    def violation(self) -> np.ndarray:
        """Violation of each limit, in units of the limited value's size."""
        return (
            np.maximum(np.maximum(self.lower - self.value, self.value - self.upper), 0) / self.size
        )

    @property
    def reached(self) -> tuple[np.ndarray, np.ndarray]:
        """True for each lower and each upper limit that is reached."""
        return self.value - self.lower <= self.near, self.upper - self.value <= self.near

    def distance(self, multiplier: np.ndarray) -> np.ndarray:
        """Distance from the limit a multiplier belongs to; zero where there is none."""
        low, high = self.value - self.lower, self.upper - self.value
        return np.where(multiplier > 0, low, np.where(multiplier < 0, high, 0.0))

    def states(self, multiplier: np.ndarray) -> np.ndarray:
        """State of each value: free, at its lower or upper limit, or fixed."""
        low, high = self.reached
        cases = [self.lower == self.upper, low & ((multiplier > 0) | ~high), high]
        return np.select(cases, ["fixed", "lower", "upper"], "free")


class Multipliers(NamedTuple):
    """Multipliers of the bounds (reduced gradients) and of the constraints."""

    bounds: np.ndarray
    constraints: np.ndarray


class KKT(NamedTuple):
    """Residuals of the conditions of Karush, Kuhn and Tucker; all three are zero at an optimum.

    `stationarity` is the largest component of the Lagrangian's gradient in units of its terms,
    `feasibility` the largest violation in the size of what is limited, `complementarity` the
    largest multiplier times distance from its limit, in units of the cost.
    """

    stationarity: float
    feasibility: float
    complementarity: float

    @property
    def worst(self) -> float:
        """The largest of the three."""
        return max(self)


LOST = KKT(np.inf, np.inf, np.inf)


class Bend(NamedTuple):
    """The second-order test: the lowest curvature, the direction down, the Newton step.

    `direction` (n,) leads to lower cost, None where there is none; `clear` tells that the curvature
    alone says so.
    """

    direction: np.ndarray | None
    newton: float = 0.0
    flat: bool = False
    clear: bool = False


class SearchState(NamedTuple):
    """A point with its limits, their multipliers and its distance from an optimum."""

    theta: np.ndarray
    at: Slopes
    bounds: LimitedValues
    limits: LimitedValues
    found: Multipliers
    kkt: KKT
    scale: Scale
    tolerance: float
    bend: Bend | None = None

    @property
    def feasible(self) -> bool:
        """True if all limits hold within the tolerance."""
        return self.kkt.feasibility <= self.tolerance

    @property
    def optimal(self) -> bool:
        """True if the conditions of first order hold within the tolerance."""
        return self.kkt.worst <= self.tolerance


def first_order(core, theta):
    """The parts of `Slopes`, compiled once for each structure of problem."""
    r, j = problem.with_slope(partial(problem.residual, core), theta)
    further, pull = jax.value_and_grad(problem.further, 1)(core, theta)
    c = problem.constraints(core, theta)
    # By as few sweeps as there are variables or constraints.
    few = jax.eval_shape(problem.constraints, core, theta).shape < theta.shape
    slopes = (jax.jacrev if few else jax.jacfwd)(problem.constraints, 1)(core, theta)
    return r, j, 0.5 * r @ r + further, r @ j + pull, c, slopes


def slopes(p: Problem, theta: np.ndarray) -> Slopes:
    """Evaluate values and first derivatives at a point."""
    parts = p.compiled(first_order)(np.asarray(theta, float))
    return Slopes(*(np.asarray(part) for part in parts))


def nearby(p: Problem, theta: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """Test points about a point, within the bounds, shape (`LOOKS`, n)."""
    steps = np.random.default_rng(0).normal(size=(LOOKS, len(unit)))
    return np.clip(theta + NEAR * steps * unit, p.lower, p.upper)


def of_squares(residual: np.ndarray, jacobian: Rows) -> Slopes:
    """The slopes of a problem of squares alone, from residuals and Jacobian."""
    none = np.zeros(0)
    cost = 0.5 * residual @ residual
    with np.errstate(invalid="ignore"):
        gradient = jacobian.T @ residual
    return Slopes(residual, jacobian, cost, gradient, none, none.reshape(0, jacobian.shape[1]))


def scale_of(p: Problem, start: np.ndarray, at: Slopes) -> Scale:
    """The sizes of a problem, from a start, the bounds and the slopes there.

    A number is as large as its start or a tenth of its range, else as the change that moves the
    residuals by one or doubles the cost; what is limited as its limits, its value at the start and
    the change along the numbers; a further objective as its change along them.
    """
    width = p.upper - p.lower
    length, pull = lengths(at.residual_jacobian), np.abs(at.gradient)
    unit = np.maximum(np.abs(start), np.where(np.isfinite(width), 0.1 * width, 0.0))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for other in (1.0 / length, abs(at.cost) / pull):
            usable = (unit == 0) & np.isfinite(other) & (other > 0)
            unit = np.where(usable, other, unit)
    unit = np.where(unit > 0, unit, 1.0)
    ends = [
        np.where(np.isfinite(e), np.abs(e), 0.0) for e in (p.constraint_lower, p.constraint_upper)
    ]
    moved = np.max(np.abs(at.jacobian) * unit, axis=1, initial=0.0)
    limit = np.max([*ends, np.abs(at.constraints), moved], axis=0, initial=0.0)
    sizes = [float(np.max(pull * unit, initial=0.0)), abs(float(at.cost)), 1.0]
    return Scale(unit, np.where(limit > 0, limit, 1.0), next(v for v in sizes if v > 0))


def gradient_size(p: Problem, at: Slopes, scale: Scale) -> np.ndarray:
    """Size of a gradient component that matters, per unit of each number.

    A residual vector as long as `Problem.least_residual` is the least that counts; for further
    objectives, the scale of the cost.
    """
    size = max(np.linalg.norm(at.residual), p.least_residual)
    found = lengths(at.residual_jacobian) * size
    if p.objectives:
        found = found + scale.cost / scale.unit
    largest = np.max(found * scale.unit, initial=0.0)
    return np.maximum(found, max(1e-12 * largest, 1e-100) / scale.unit)


def holding(p: Problem, s: SearchState, least: float) -> tuple[np.ndarray, np.ndarray]:
    """Numbers that do not move and constraints that hold, by forces above a share."""
    size = gradient_size(p, s.at, s.scale)
    held = ~p.moving | (np.abs(s.found.bounds) > least * size)
    pulls = np.abs(s.found.constraints) * np.linalg.norm(s.at.jacobian / size, axis=1)
    return held, p.equations | (pulls > least)


def state(p: Problem, theta: np.ndarray, scale: Scale, at: Slopes | None = None) -> SearchState:
    """Find the multipliers at a point and measure how far it is from an optimum.

    Parameters
    ----------
    p : Problem
        The problem.
    theta : array, shape (n,)
        The point.
    scale : Scale
        Of the problem.
    at : Slopes, optional
        At the point, where they are known.

    Returns
    -------
    SearchState
        With an infinite residual where something is not finite.
    """
    at = slopes(p, theta) if at is None else at
    size = gradient_size(p, at, scale) if at.finite else 1.0 / scale.unit
    cost = scale.cost if p.objectives else max(float(at.cost), 0.5 * p.least_residual**2)
    near = p.tolerance * np.minimum(np.maximum(np.abs(theta), np.abs(p.start)), p.upper - p.lower)
    with np.errstate(divide="ignore", invalid="ignore"):
        # A bound to which the gradient pushes counts when moving there gains nothing.
        pushed = np.abs(at.gradient) > p.tolerance * size
        near = np.where(pushed, np.maximum(near, CLOSE * cost / np.abs(at.gradient)), near)
    near = np.where(np.isfinite(near), near, 0.0)
    bounds = LimitedValues(theta, p.lower, p.upper, scale.unit, near)
    size_here = np.fmin(scale.limit, GROWN * scale_of(p, theta, at).limit)
    limits = LimitedValues(
        at.constraints, p.constraint_lower, p.constraint_upper, size_here, p.tolerance * size_here
    )
    none = Multipliers(np.zeros(len(theta)), np.zeros(len(at.constraints)))
    s = SearchState(theta, at, bounds, limits, none, LOST, scale, p.tolerance)
    if not at.finite:
        return s
    s = s._replace(found=multipliers(at.gradient, at.jacobian, bounds, limits, size))
    return s._replace(kkt=_distance(s, size, cost))


def multipliers(
    gradient: np.ndarray,
    jacobian: np.ndarray,
    bounds: LimitedValues,
    limits: LimitedValues,
    scale: np.ndarray,
) -> Multipliers:
    """Find the multipliers of the right signs that come nearest to stationarity.

    Parameters
    ----------
    gradient : array, shape (n,)
        Of the cost.
    jacobian : array, shape (m, n)
        Of the constraints.
    bounds, limits : LimitedValues
        Of the n free numbers and of the m constraints.
    scale : array, shape (n,)
        Size of a component of the gradient that matters.

    Returns
    -------
    Multipliers

    Examples
    --------
    Minimise (x-3)^2/2 with x <= 1: the cost falls by 2 for each unit the bound gives way.

    >>> one, none = np.ones(1), np.zeros(0)
    >>> at = LimitedValues(one, np.array([-np.inf]), one, one, 1e-6 * one)
    >>> free = LimitedValues(none, none, none, none, none)
    >>> multipliers(np.array([-2.0]), np.zeros((0, 1)), at, free, one).bounds.tolist()
    [-2.0]
    """
    n = len(gradient)
    low, high = (np.concatenate(pair) for pair in zip(bounds.reached, limits.reached, strict=True))
    if not (low[n:].any() or high[n:].any()):
        own = np.where(low[:n] & (gradient > 0) | high[:n] & (gradient < 0), gradient, 0.0)
        return Multipliers(own, np.zeros(len(limits.value)))
    rows = np.vstack([np.eye(n), np.reshape(jacobian, (-1, n))])
    chosen = np.concatenate([np.flatnonzero(low), np.flatnonzero(high)])
    sign = np.concatenate([np.ones(low.sum()), -np.ones(high.sum())])
    found = np.zeros(len(rows))
    columns = (sign[:, None] * rows[chosen] / scale).T
    size = np.linalg.norm(columns, axis=0)
    columns = columns / np.where(size > 0, size, 1.0)
    right = gradient / scale
    from scipy.optimize import nnls  # a third of a second that only limits should cost

    guess, _ = nnls(columns, right, maxiter=50 * columns.shape[1])
    used = guess > 0
    # One plain least-squares solution on the support: nnls stops at a tolerance.
    sharp = np.linalg.lstsq(columns[:, used], right, rcond=None)[0]
    guess[used] = np.where(sharp > 0, sharp, guess[used])
    np.add.at(found, chosen, sign * guess / np.where(size > 0, size, 1.0))
    return Multipliers(found[:n], found[n:])


def _distance(s: SearchState, scale: np.ndarray, cost: float) -> KKT:
    """Measure how far a point with multipliers is from an optimum, `cost` being a size of it."""
    at, found = s.at, s.found
    left = at.gradient - found.bounds - at.jacobian.T @ found.constraints
    size = scale + np.abs(found.constraints) @ np.abs(at.jacobian)
    parts = ((found.bounds, s.bounds), (found.constraints, s.limits))
    products = [np.abs(y * part.distance(y)) for y, part in parts]
    crossed = np.concatenate([s.bounds.violation, s.limits.violation, [0.0]])
    return KKT(
        float(np.max(np.abs(left) / size, initial=0.0)),
        float(np.max(crossed)),
        float(np.max(np.concatenate(products), initial=0.0) / cost),
    )
