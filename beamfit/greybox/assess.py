"""Optimality of a point and multipliers of its limits, judged here and not by a solver.

At an optimum of cost f within limits on c(theta) and bounds on theta there are multipliers y, z
with grad f = J_c^T y + z (stationarity), y and z zero where a limit is not reached, not negative at
a lower and not positive at an upper limit (Nocedal & Wright, Numerical Optimization, 2nd ed.,
section 12.1). So a multiplier is d(cost)/d(limit), with cost = chi-square/2. All is judged in the
problem's own sizes, so that no answer hangs on units.

Nor does an optimum's Lagrangian bend downward along the limits that hold (section 12.5). Objectives
are tested with exact derivatives, squares by looking at points beside the end: what their residuals
bend is not in their Jacobian.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import numpy as np
from scipy import sparse

from beamfit.greybox import problem
from beamfit.greybox.covariance import FEW, null_space, triangle
from beamfit.greybox.descend import slopes_of_few
from beamfit.greybox.problem import Problem
from beamfit.greybox.sparse import Rows, in_units, lengths, weakest

# A bound also counts as reached if moving onto it changes the cost by less than this share.
CLOSE = 1e-8
# The size of a limited value is at most this many times the one at the end: a start at which it was
# exp(100) must not make every end feasible.
GROWN = 1e3
# Random test points about a point, and their distance in sizes of the numbers.
LOOKS, NEAR = 4, 0.3
# A search has not ended while the next Newton step exceeds this, in sizes of the numbers.
STEP = 1e-3
# Negative curvature below this share of the strongest curvature is rounding.
FLAT = 1e-6
# Negative curvature above this share is a saddle even if no lower point was found nearby.
PLAIN = 2e-3
# Slopes below this share of the terms that cancel in them are rounding.
ROUNDING = 1e-13
# A slope at a bound is rounding where it predicts these parts of the cost as a change and less than
# this share of that happens: b/(1 - exp(-b t)) has lost its figures at b = 1e-18.
SHARE, PARTS = 1e-2, (1.0, 1e-2)
# Test points: distance in sizes of the numbers, count along the weakest directions of a sum of
# squares, and count at random or inward from bounds.
BESIDE, WEAKEST, AROUND = 1e-3, 2, 4


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
    """Values with limits, their sizes, how near counts as reached, and the limits' multipliers."""

    value: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    size: np.ndarray
    near: np.ndarray
    multiplier: np.ndarray | float = 0.0

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

    @property
    def distance(self) -> np.ndarray:
        """Distance from the limit a multiplier belongs to; zero where there is none."""
        low, high = self.value - self.lower, self.upper - self.value
        return np.where(self.multiplier > 0, low, np.where(self.multiplier < 0, high, 0.0))

    @property
    def states(self) -> np.ndarray:
        """State of each value: free, at its lower or upper limit, or fixed."""
        low, high = self.reached
        cases = [self.lower == self.upper, low & ((self.multiplier > 0) | ~high), high]
        return np.select(cases, ["fixed", "lower", "upper"], "free")


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
    kkt: KKT
    scale: Scale
    tolerance: float
    bend: Bend | None = None

    @property
    def feasible(self) -> bool:
        """True if all limits hold within the tolerance."""
        return self.kkt.feasibility <= self.tolerance

    @property
    def left(self) -> np.ndarray:
        """Gradient of the Lagrangian: what multipliers leave of that of the cost."""
        pull = self.at.jacobian.T @ self.limits.multiplier
        return self.at.gradient - self.bounds.multiplier - pull

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
    return slopes_at(p, np.asarray(theta, float)[None])[0]


def slopes_at(p: Problem, points: np.ndarray) -> list[Slopes]:
    """The same at points, shape (k, n); of few squares alone by what their search compiles."""
    if not (p.constraints or p.objectives) and len(p.start) <= FEW:
        return [of_squares(*each) for each in zip(*slopes_of_few(p)(points), strict=True)]
    call = p.compiled(first_order)
    return [Slopes(*map(np.asarray, call(point))) for point in points]


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
    held = ~p.moving | (np.abs(s.bounds.multiplier) > least * size)
    pulls = np.abs(s.limits.multiplier) * np.linalg.norm(s.at.jacobian / size, axis=1)
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
    bounds = LimitedValues(theta, p.lower, p.upper, scale.unit, near, np.zeros(len(theta)))
    # A number that ends at zero does not make what it limits small.
    largest = np.maximum(np.abs(theta), scale.unit)
    here = scale_of(p, largest, at) if p.constraints else scale
    size_here = np.fmin(scale.limit, GROWN * here.limit)
    ends, near = (p.constraint_lower, p.constraint_upper), p.tolerance * size_here
    limits = LimitedValues(at.constraints, *ends, size_here, near, np.zeros(len(near)))
    s = SearchState(theta, at, bounds, limits, LOST, scale, p.tolerance)
    if not at.finite:
        return s
    pulls, forces = multipliers(at.gradient, at.jacobian, bounds, limits, size)
    bounds, limits = bounds._replace(multiplier=pulls), limits._replace(multiplier=forces)
    return _at_distance(s._replace(bounds=bounds, limits=limits), size, cost)


def multipliers(
    gradient: np.ndarray,
    jacobian: np.ndarray,
    bounds: LimitedValues,
    limits: LimitedValues,
    scale: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
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
    (array, shape (n,); array, shape (m,))
        Of the bounds (reduced gradients) and of the constraints.

    Examples
    --------
    Minimise (x-3)^2/2 with x <= 1: the cost falls by 2 for each unit the bound gives way.

    >>> one, none = np.ones(1), np.zeros(0)
    >>> at = LimitedValues(one, np.array([-np.inf]), one, one, 1e-6 * one)
    >>> free = LimitedValues(none, none, none, none, none)
    >>> multipliers(np.array([-2.0]), np.zeros((0, 1)), at, free, one)[0].tolist()
    [-2.0]
    """
    n = len(gradient)
    low, high = (np.concatenate(pair) for pair in zip(bounds.reached, limits.reached, strict=True))
    if not (low[n:].any() or high[n:].any()):
        own = np.where(low[:n] & (gradient > 0) | high[:n] & (gradient < 0), gradient, 0.0)
        return own, np.zeros(len(limits.value))
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
    return found[:n], found[n:]


def _at_distance(s: SearchState, scale: np.ndarray, cost: float) -> SearchState:
    """Measure how far a point with multipliers is from an optimum, `cost` being a size of it."""
    size = scale + np.abs(s.limits.multiplier) @ np.abs(s.at.jacobian)
    products = [np.abs(part.multiplier * part.distance) for part in (s.bounds, s.limits)]
    crossed = np.concatenate([s.bounds.violation, s.limits.violation, [0.0]])
    stationarity = np.max(np.abs(s.left) / size, initial=0.0)
    complementarity = np.max(np.concatenate(products), initial=0.0) / cost
    return s._replace(kkt=KKT(*map(float, (stationarity, np.max(crossed), complementarity))))


# ---- second order

# Lagrangian at points, shape (k, n) to (k,).
Look = Callable[[np.ndarray], np.ndarray]


def lagrangian_hessian(core, theta, sigma, y):
    """Hessian of the Lagrangian sigma * cost - y @ constraints."""

    def lagrangian(t):
        return sigma * problem.cost(core, t) - y @ problem.constraints(core, t)

    return jax.hessian(lagrangian)(theta)


def second_order(p: Problem, s: SearchState, exact: bool) -> tuple[SearchState, np.ndarray | None]:
    """The second-order test of a point that is an optimum to first order.

    Parameters
    ----------
    p : Problem
        The problem.
    s : State
        The point.
    exact : bool
        Whether second derivatives may be asked for.

    Returns
    -------
    SearchState
        With its `Bend`.
    array, shape (n,), or None
        Another point, from where to go on, if the cost falls beside this one.
    """

    def lagrangian(points):
        found = (p.compiled(problem.values)(point) for point in points)
        return np.array([float(c) - s.limits.multiplier @ np.asarray(held) for c, held in found])

    if not (p.objectives and exact):
        point = lower_beside(p, s, lagrangian)
        return s._replace(bend=Bend(None if point is None else point - s.theta)), point
    bent = _bend(p, s)
    directions = [] if bent.direction is None else [bent.direction]
    if bent.flat:
        # Nothing of second order tells: look around, always at the same points.
        random = np.random.default_rng(0).normal(size=(AROUND, len(s.theta)))
        tangent = _tangent(p, s)
        around = random @ tangent @ tangent.T * s.scale.unit
        # From a bound that nothing pushes to there is one way only.
        low, high = s.bounds.reached
        directions += list(np.where(low, np.abs(around), np.where(high, -np.abs(around), around)))
    for direction in directions:
        point = _along(p, s, direction, lagrangian)
        if point is not None:
            return s._replace(bend=bent._replace(direction=direction)), point
    if not bent.clear:
        bent = bent._replace(direction=None)
    return s._replace(bend=bent), None


def lower_beside(p: Problem, s: SearchState, lagrangian: Look) -> np.ndarray | None:
    """A lower point beside one where squares end, if the cost bends down there.

    The squares' own curvature never does; what their residuals bend shows first where that is
    weakest. Numbers at a bound are tried inward, whatever the force that holds them.
    """
    unit, weak = s.scale.unit, _weakest(p, s)
    if not weak.shape[1]:
        return None
    low, high = s.bounds.reached
    inward = np.flatnonzero((low ^ high) & ~p.nuisance & p.moving)[:AROUND]
    pushes = np.zeros((len(inward), len(unit)))
    pushes[np.arange(len(inward)), inward] = np.where(low, unit, -unit)[inward]
    sides = np.repeat(weak.T, 2, axis=0)
    sides[1::2] *= -1.0
    # Steps inward over which the slope predicts a change as large as the cost, and a part of it.
    size = max(float(s.at.cost), 0.5 * p.least_residual**2)
    slope = np.maximum(np.abs(s.at.gradient * unit)[inward], 1e-300)
    short = pushes * np.minimum(size / slope, BESIDE)[:, None]
    steps = np.vstack([0 * unit, BESIDE * sides, BESIDE * pushes, *(t * short for t in PARTS)])
    points = np.clip(s.theta + steps, p.lower, p.upper)
    cost = lagrangian(points)
    gain = cost[0] - cost
    gain = np.where(np.isfinite(gain), gain, -np.inf)
    least = 1e-9 * abs(cost[0]) + 1e-12 * p.least_residual**2
    for i in range(1, len(sides), 2):
        if gain[i] + gain[i + 1] > least:
            return _along(p, s, sides[i - 1 if gain[i] > gain[i + 1] else i], lagrangian)
    for k, i in enumerate(range(1 + len(sides), 1 + len(sides) + len(pushes))):
        if gain[i] > least:
            return _along(p, s, pushes[k], lagrangian)
        for at, t in enumerate(PARTS, 1):
            if BESIDE * slope[k] > size and gain[i + at * len(pushes)] > -SHARE * t * size:
                return points[i + at * len(pushes)]
    return None


def _weakest(p: Problem, s: SearchState) -> np.ndarray:
    """The weakest directions of squares that keep to the limits held by a force."""
    unit = s.scale.unit
    held, on = holding(p, s, p.tolerance)
    if len(unit) > FEW and not on.any():
        found = np.zeros((len(unit), min(WEAKEST, int(np.sum(~held)))))
        rows = in_units(s.at.residual_jacobian, 1 / unit)[:, ~held]
        found[~held] = weakest(rows, found.shape[1])
    else:
        tangent = _tangent(p, s)
        rows = triangle(s.at.residual_jacobian * unit) @ tangent
        found = tangent @ np.linalg.svd(rows, full_matrices=True)[2][-WEAKEST:].T
    return found * unit[:, None]


def _along(
    p: Problem, s: SearchState, direction: np.ndarray, lagrangian: Look
) -> np.ndarray | None:
    """The best of some points along a direction, None if none is better by what counts."""
    steps = [
        sign * step for step in (BESIDE, 10 * BESIDE, 100 * BESIDE, 0.5) for sign in (1.0, -1.0)
    ]
    points = [s.theta, *(np.clip(s.theta + t * direction, p.lower, p.upper) for t in steps)]
    if p.constraints:
        restored = (_restored(p, s, point) for point in points[1:])
        points = [s.theta, *(point for point in restored if point is not None)]
    cost = lagrangian(np.array(points))
    cost = np.where(np.isfinite(cost), cost, np.inf)
    best = int(np.argmin(cost))
    return points[best] if cost[0] - cost[best] > _worth(p, s) else None


def _worth(p: Problem, s: SearchState) -> float:
    """The decrease of the cost from which on a point is lower."""
    if p.objectives:
        return 1e-9 * s.scale.cost
    count = max(len(s.at.residual) - len(s.theta), 1)
    noise = 1.0 if p.errors_known or not p.records else 2 * s.at.cost / count
    return max(1e-3 * noise, 1e-6 * s.at.cost)


def _restored(p: Problem, s: SearchState, point: np.ndarray) -> np.ndarray | None:
    """A point moved onto the constraints that hold at another one, and inside all; None if not.

    Beside curved constraints a straight step leaves them, and a cost that is lower there is no
    lower cost: along a ridge of equal costs it would be taken for a way down.
    """
    held, on = holding(p, s, p.tolerance)
    unit = np.where(held, 0.0, s.scale.unit)
    for _ in range(10):  # Newton steps
        at = slopes(p, point)
        if not at.finite:
            return None
        inside = np.clip(at.constraints, p.constraint_lower, p.constraint_upper)
        gap = at.constraints - np.where(on, s.at.constraints, inside)
        if np.all(np.abs(gap) <= 1e-10 * s.limits.size):
            return point
        left = gap != 0
        step = np.linalg.lstsq(at.jacobian[left] * unit, gap[left], rcond=None)[0]
        point = np.clip(point - unit * step, p.lower, p.upper)
    return None


def _bend(p: Problem, s: SearchState) -> Bend:
    """Curvature on the directions that active limits leave, from exact derivatives."""
    unit, cost = s.scale.unit, s.scale.cost
    h = np.asarray(p.compiled(lagrangian_hessian)(s.theta, 1.0, s.limits.multiplier))
    h = h * np.outer(unit, unit) / cost
    tangent = _tangent(p, s)
    if not tangent.shape[1] or not np.all(np.isfinite(h)):
        return Bend(None)
    values, vectors = np.linalg.eigh(tangent.T @ h @ tangent)
    slope = vectors.T @ (tangent.T @ (s.left * unit / cost))
    largest = np.max(np.abs(values))
    steep = values > FLAT * largest
    terms = np.abs(s.at.gradient) + np.abs(s.limits.multiplier) @ np.abs(s.at.jacobian)
    told = steep & (np.abs(slope) > ROUNDING * np.max(terms * unit / cost))
    newton = np.max(np.abs(slope[told] / values[told]), initial=0.0)
    down = tangent @ vectors[:, 0] * unit if values[0] < -FLAT * max(largest, FLAT) else None
    clear = values[0] < -PLAIN * max(largest, 1.0) and np.all(
        np.abs(BESIDE * down) < np.minimum(s.theta - p.lower, p.upper - s.theta)
    )
    return Bend(down, float(newton), not steep.all() or largest < p.tolerance, clear)


def _tangent(p: Problem, s: SearchState) -> np.ndarray:
    """Directions, in the sizes of the numbers, that keep to the limits held by a force."""
    unit = s.scale.unit
    held, on = holding(p, s, p.tolerance)
    return null_space(np.vstack([np.eye(len(unit))[held], s.at.jacobian[on] * unit]))
