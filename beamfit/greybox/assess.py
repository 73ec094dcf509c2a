"""Optimality conditions at a point and multipliers of its limits, independent of any solver.

At an optimum of the cost f, with limits on c(theta) and bounds on theta, there are multipliers y
and z with grad f = J_c^T y + z (stationarity). They are zero where a limit is not reached, not
negative at a lower and not positive at an upper limit (Nocedal & Wright, Numerical Optimization,
2nd ed., section 12.1). A multiplier is therefore d(cost)/d(limit), with cost = chi-square/2. All
conditions are measured in scales taken from the problem, so that no verdict depends on units.

The Lagrangian of an optimum has no negative curvature along the active limits (section 12.5).
Objectives are tested with exact second derivatives. Sums of squares are tested by the cost at
nearby points, because their Jacobian does not contain the curvature of the residuals.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import numpy as np
from scipy import sparse

from beamfit.greybox import problem
from beamfit.greybox.covariance import MAX_DENSE, null_space, triangle
from beamfit.greybox.descend import dense_slopes
from beamfit.greybox.problem import Problem
from beamfit.greybox.sparse import Rows, in_units, lengths, weakest

# A bound also counts as reached if moving onto it changes the cost by less than this share.
NEGLIGIBLE_COST = 1e-8
# The scale of a constraint is at most this many times its scale at the end of the search. Without
# this limit, a start at which the constraint was exp(100) would make every end feasible.
MAX_SCALE_GROWTH = 1e3
# Number of random test points about a point.
TEST_POINTS = 4
# Standard deviation of their displacement, in scales of the free numbers.
TEST_DISTANCE = 0.3
# A search has not converged while the next Newton step exceeds this, in scales of the numbers.
MAX_NEWTON_STEP = 1e-3
# Negative curvature below this share of the strongest curvature is rounding.
CURVATURE_ROUNDING = 1e-6
# Negative curvature above this share is a saddle even if no lower point was found nearby.
SADDLE_CURVATURE = 2e-3
# A gradient below this share of the terms that cancel in it is rounding.
GRADIENT_ROUNDING = 1e-13
# Test for a gradient at a bound that is only rounding, as b/(1 - exp(-b t)) has at b = 1e-18. Steps
# inward are as long as the gradient says is needed to change the cost by these shares of itself.
PREDICTED_SHARES = (1.0, 1e-2)
# The gradient is rounding if less than this share of the predicted increase occurs.
MIN_OCCURRED = 1e-2
# Distance of probe points, in scales of the numbers.
PROBE_DISTANCE = 1e-3
# Number of probe directions: those in which a sum of squares is weakest ...
WEAK_DIRECTIONS = 2
# ... and those taken at random or inward from bounds.
OTHER_PROBES = 4


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
    """Scales taken from the problem itself: of the free numbers, the constraints and the cost."""

    unit: np.ndarray
    limit: np.ndarray
    cost: float


class LimitedValues(NamedTuple):
    """Values with their limits, scales and multipliers.

    A limit counts as reached within `tolerance` of it.
    """

    value: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    scale: np.ndarray
    tolerance: np.ndarray
    multiplier: np.ndarray | float = 0.0

    @property
    def violation(self) -> np.ndarray:
        """Violation of each limit, in units of the value's scale."""
        return (
            np.maximum(np.maximum(self.lower - self.value, self.value - self.upper), 0) / self.scale
        )

    @property
    def reached(self) -> tuple[np.ndarray, np.ndarray]:
        """True for each lower and each upper limit that is reached."""
        return self.value - self.lower <= self.tolerance, self.upper - self.value <= self.tolerance

    @property
    def distance(self) -> np.ndarray:
        """Distance of each value from the limit of its multiplier; zero without a multiplier."""
        low, high = self.value - self.lower, self.upper - self.value
        return np.where(self.multiplier > 0, low, np.where(self.multiplier < 0, high, 0.0))

    @property
    def states(self) -> np.ndarray:
        """State of each value: free, at its lower or upper limit, or fixed."""
        low, high = self.reached
        cases = [self.lower == self.upper, low & ((self.multiplier > 0) | ~high), high]
        return np.select(cases, ["fixed", "lower", "upper"], "free")


class KKT(NamedTuple):
    """Residuals of the Karush-Kuhn-Tucker conditions; all three are zero at an optimum.

    `stationarity` is the largest component of the Lagrangian's gradient, relative to its terms.
    `feasibility` is the largest violation of a limit, in the scale of the limited value.
    `complementarity` is the largest product of a multiplier and the distance from its limit, in
    units of the cost.
    """

    stationarity: float
    feasibility: float
    complementarity: float

    @property
    def worst(self) -> float:
        """The largest of the three."""
        return max(self)


INFINITE_KKT = KKT(np.inf, np.inf, np.inf)


class CurvatureTest(NamedTuple):
    """Result of the second-order test at a stationary point.

    `direction` (n,) leads to lower cost, None where there is none. `newton` is the length of the
    next Newton step in scales of the numbers. `flat` is true if some curvature is not
    distinguishable from zero, `clear` if the curvature alone proves a saddle.
    """

    direction: np.ndarray | None
    newton: float = 0.0
    flat: bool = False
    clear: bool = False


class SearchState(NamedTuple):
    """A point with its derivatives `at` it, its limits, their multipliers and its KKT residuals."""

    theta: np.ndarray
    at: Slopes
    bounds: LimitedValues
    limits: LimitedValues
    kkt: KKT
    scale: Scale
    tolerance: float
    curvature: CurvatureTest | None = None

    @property
    def feasible(self) -> bool:
        """True if all limits hold within the tolerance."""
        return self.kkt.feasibility <= self.tolerance

    @property
    def lagrangian_gradient(self) -> np.ndarray:
        """Gradient of the Lagrangian, shape (n,)."""
        constraint_gradient = self.at.jacobian.T @ self.limits.multiplier
        return self.at.gradient - self.bounds.multiplier - constraint_gradient

    @property
    def optimal(self) -> bool:
        """True if the first-order conditions hold within the tolerance."""
        return self.kkt.worst <= self.tolerance


def first_order(core, theta):
    """Compute the fields of `Slopes`; compiled once for each structure of problem."""
    r, j = problem.with_slope(partial(problem.residual, core), theta)
    further, gradient = jax.value_and_grad(problem.further, 1)(core, theta)
    c = problem.constraints(core, theta)
    # Reverse mode takes a sweep for each constraint, forward mode one for each variable.
    few = jax.eval_shape(problem.constraints, core, theta).shape < theta.shape
    slopes = (jax.jacrev if few else jax.jacfwd)(problem.constraints, 1)(core, theta)
    return r, j, 0.5 * r @ r + further, r @ j + gradient, c, slopes


def slopes(p: Problem, theta: np.ndarray) -> Slopes:
    """Evaluate values and first derivatives at a point."""
    return slopes_at(p, np.asarray(theta, float)[None])[0]


def slopes_at(p: Problem, points: np.ndarray) -> list[Slopes]:
    """Evaluate values and first derivatives at points, shape (k, n).

    A small problem of squares alone uses the function that its search has compiled already.
    """
    if not (p.constraints or p.objectives) and len(p.start) <= MAX_DENSE:
        return [slopes_of_squares(*each) for each in zip(*dense_slopes(p)(points), strict=True)]
    call = p.compiled(first_order)
    return [Slopes(*map(np.asarray, call(point))) for point in points]


def points_nearby(p: Problem, theta: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """Draw random test points about a point, within the bounds, shape (`TEST_POINTS`, n)."""
    steps = np.random.default_rng(0).normal(size=(TEST_POINTS, len(unit)))
    return np.clip(theta + TEST_DISTANCE * steps * unit, p.lower, p.upper)


def slopes_of_squares(residual: np.ndarray, jacobian: Rows) -> Slopes:
    """Make the `Slopes` of a problem of squares alone from residuals and Jacobian."""
    none = np.zeros(0)
    cost = 0.5 * residual @ residual
    with np.errstate(invalid="ignore"):
        gradient = jacobian.T @ residual
    return Slopes(residual, jacobian, cost, gradient, none, none.reshape(0, jacobian.shape[1]))


def scale_of(p: Problem, start: np.ndarray, at: Slopes) -> Scale:
    """Choose the scales of a problem from a start, the bounds and the derivatives there.

    The scale of a number is its start or a tenth of its range, whichever is larger; without both,
    the change that moves the residuals by one or doubles the cost. The scale of a constraint is
    the largest of its limits, its value at the start, and its change when a number changes by its
    scale. The scale of the cost is the latter change, else the cost itself, else 1.
    """
    width = p.upper - p.lower
    length, slope = lengths(at.residual_jacobian), np.abs(at.gradient)
    unit = np.maximum(np.abs(start), np.where(np.isfinite(width), 0.1 * width, 0.0))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for other in (1.0 / length, abs(at.cost) / slope):
            usable = (unit == 0) & np.isfinite(other) & (other > 0)
            unit = np.where(usable, other, unit)
    unit = np.where(unit > 0, unit, 1.0)
    ends = [
        np.where(np.isfinite(e), np.abs(e), 0.0) for e in (p.constraint_lower, p.constraint_upper)
    ]
    moved = np.max(np.abs(at.jacobian) * unit, axis=1, initial=0.0)
    limit = np.max([*ends, np.abs(at.constraints), moved], axis=0, initial=0.0)
    sizes = [float(np.max(slope * unit, initial=0.0)), abs(float(at.cost)), 1.0]
    return Scale(unit, np.where(limit > 0, limit, 1.0), next(v for v in sizes if v > 0))


def gradient_size(p: Problem, at: Slopes, scale: Scale) -> np.ndarray:
    """Compute the size relative to which a component of the gradient counts as zero, shape (n,).

    It is the length of the Jacobian's column times that of the residuals, at least
    `Problem.least_residual`; with further objectives, the scale of the cost is added.
    """
    size = max(np.linalg.norm(at.residual), p.least_residual)
    found = lengths(at.residual_jacobian) * size
    if p.objectives:
        found = found + scale.cost / scale.unit
    largest = np.max(found * scale.unit, initial=0.0)
    return np.maximum(found, max(1e-12 * largest, 1e-100) / scale.unit)


def active_set(p: Problem, s: SearchState, least: float) -> tuple[np.ndarray, np.ndarray]:
    """Find which numbers are held and which constraints are active, by their multipliers."""
    size = gradient_size(p, s.at, s.scale)
    held = ~p.moving | (np.abs(s.bounds.multiplier) > least * size)
    forces = np.abs(s.limits.multiplier) * np.linalg.norm(s.at.jacobian / size, axis=1)
    return held, p.equations | (forces > least)


def state(p: Problem, theta: np.ndarray, scale: Scale, at: Slopes | None = None) -> SearchState:
    """Find the multipliers at a point and its KKT residuals.

    Parameters
    ----------
    p : Problem
        The problem.
    theta : array, shape (n,)
        The point.
    scale : Scale
        Scales of the problem.
    at : Slopes, optional
        Values and derivatives at the point; computed by default.

    Returns
    -------
    SearchState
        Its KKT residuals are infinite where a value or derivative is not finite.
    """
    at = slopes(p, theta) if at is None else at
    size = gradient_size(p, at, scale) if at.finite else 1.0 / scale.unit
    cost = scale.cost if p.objectives else max(float(at.cost), 0.5 * p.least_residual**2)
    margin = p.tolerance * np.minimum(np.maximum(np.abs(theta), np.abs(p.start)), p.upper - p.lower)
    with np.errstate(divide="ignore", invalid="ignore"):
        # If the gradient pushes towards a bound, it counts as reached when moving there hardly
        # changes the cost.
        pushed = np.abs(at.gradient) > p.tolerance * size
        harmless = NEGLIGIBLE_COST * cost / np.abs(at.gradient)
        margin = np.where(pushed, np.maximum(margin, harmless), margin)
    margin = np.where(np.isfinite(margin), margin, 0.0)
    bounds = LimitedValues(theta, p.lower, p.upper, scale.unit, margin, np.zeros(len(theta)))
    # A number that ends at zero must not reduce the scales of the constraints to zero.
    largest = np.maximum(np.abs(theta), scale.unit)
    local_scale = scale_of(p, largest, at) if p.constraints else scale
    limit_scale = np.fmin(scale.limit, MAX_SCALE_GROWTH * local_scale.limit)
    ends, margin = (p.constraint_lower, p.constraint_upper), p.tolerance * limit_scale
    limits = LimitedValues(at.constraints, *ends, limit_scale, margin, np.zeros(len(margin)))
    s = SearchState(theta, at, bounds, limits, INFINITE_KKT, scale, p.tolerance)
    if not at.finite:
        return s
    of_bounds, of_limits = multipliers(at.gradient, at.jacobian, bounds, limits, size)
    bounds, limits = bounds._replace(multiplier=of_bounds), limits._replace(multiplier=of_limits)
    return _with_kkt(s._replace(bounds=bounds, limits=limits), size, cost)


def multipliers(
    gradient: np.ndarray,
    jacobian: np.ndarray,
    bounds: LimitedValues,
    limits: LimitedValues,
    scale: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Find the multipliers of correct sign that come nearest to stationarity.

    Parameters
    ----------
    gradient : array, shape (n,)
        Gradient of the cost.
    jacobian : array, shape (m, n)
        Jacobian of the constraints.
    bounds, limits : LimitedValues
        The n free numbers and the m constraints.
    scale : array, shape (n,)
        Result of `gradient_size`.

    Returns
    -------
    (array, shape (n,); array, shape (m,))
        Multipliers of the bounds (reduced gradients) and of the constraints.

    Examples
    --------
    Minimise (x-3)^2/2 with x <= 1: the cost falls by 2 per unit by which the bound is raised.

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
    from scipy.optimize import nnls  # takes a third of a second, needed only here

    guess, _ = nnls(columns, right, maxiter=50 * columns.shape[1])
    used = guess > 0
    # Solve once more by least squares on the support: nnls stops at a tolerance.
    sharp = np.linalg.lstsq(columns[:, used], right, rcond=None)[0]
    guess[used] = np.where(sharp > 0, sharp, guess[used])
    np.add.at(found, chosen, sign * guess / np.where(size > 0, size, 1.0))
    return found[:n], found[n:]


def _with_kkt(s: SearchState, scale: np.ndarray, cost: float) -> SearchState:
    """Compute the KKT residuals of a point with multipliers, `cost` being the scale of its cost."""
    size = scale + np.abs(s.limits.multiplier) @ np.abs(s.at.jacobian)
    products = [np.abs(part.multiplier * part.distance) for part in (s.bounds, s.limits)]
    crossed = np.concatenate([s.bounds.violation, s.limits.violation, [0.0]])
    stationarity = np.max(np.abs(s.lagrangian_gradient) / size, initial=0.0)
    complementarity = np.max(np.concatenate(products), initial=0.0) / cost
    return s._replace(kkt=KKT(*map(float, (stationarity, np.max(crossed), complementarity))))


# ---- second order

# Values of the Lagrangian at points, shape (k, n) to (k,).
Lagrangian = Callable[[np.ndarray], np.ndarray]


def lagrangian_hessian(core, theta, sigma, y):
    """Hessian of the Lagrangian sigma * cost - y @ constraints."""

    def lagrangian(t):
        return sigma * problem.cost(core, t) - y @ problem.constraints(core, t)

    return jax.hessian(lagrangian)(theta)


def second_order(p: Problem, s: SearchState, exact: bool) -> tuple[SearchState, np.ndarray | None]:
    """Test the second-order conditions at a point that meets those of first order.

    Parameters
    ----------
    p : Problem
        The problem.
    s : SearchState
        The point.
    exact : bool
        True if the model has second derivatives.

    Returns
    -------
    SearchState
        The point with its `CurvatureTest`.
    array, shape (n,), or None
        A point nearby with a lower cost, from which the search continues.
    """

    def lagrangian(points):
        found = (p.compiled(problem.values)(point) for point in points)
        return np.array([float(c) - s.limits.multiplier @ np.asarray(held) for c, held in found])

    if not (p.objectives and exact):
        point = find_lower_point(p, s, lagrangian)
        down = None if point is None else point - s.theta
        return s._replace(curvature=CurvatureTest(down)), point
    test = _test_curvature(p, s)
    directions = [] if test.direction is None else [test.direction]
    if test.flat:
        # The second-order test is undecided: probe around, always in the same directions.
        random = np.random.default_rng(0).normal(size=(OTHER_PROBES, len(s.theta)))
        tangent = _tangent_basis(p, s)
        around = random @ tangent @ tangent.T * s.scale.unit
        # From a reached bound without a multiplier only the inward direction is allowed.
        low, high = s.bounds.reached
        directions += list(np.where(low, np.abs(around), np.where(high, -np.abs(around), around)))
    for direction in directions:
        point = _lowest_along(p, s, direction, lagrangian)
        if point is not None:
            return s._replace(curvature=test._replace(direction=direction)), point
    if not test.clear:
        test = test._replace(direction=None)
    return s._replace(curvature=test), None


def find_lower_point(p: Problem, s: SearchState, lagrangian: Lagrangian) -> np.ndarray | None:
    """Look for a point of lower cost near the end of a least-squares search.

    The Gauss-Newton part JᵀJ of the Hessian is never negative, so curvature of the residuals
    prevails first in the directions where JᵀJ is weakest. Numbers at a bound are also moved inward,
    whatever their multiplier.
    """
    unit, weak = s.scale.unit, _weakest_directions(p, s)
    if not weak.shape[1]:
        return None
    low, high = s.bounds.reached
    inward = np.flatnonzero((low ^ high) & ~p.nuisance & p.moving)[:OTHER_PROBES]
    inward_steps = np.zeros((len(inward), len(unit)))
    inward_steps[np.arange(len(inward)), inward] = np.where(low, unit, -unit)[inward]
    weak_steps = np.repeat(weak.T, 2, axis=0)
    weak_steps[1::2] *= -1.0
    # Steps inward over which the gradient predicts a change by the cost, or by a share of it.
    size = max(float(s.at.cost), 0.5 * p.least_residual**2)
    slope = np.maximum(np.abs(s.at.gradient * unit)[inward], 1e-300)
    short = inward_steps * np.minimum(size / slope, PROBE_DISTANCE)[:, None]
    probes = PROBE_DISTANCE * np.vstack([weak_steps, inward_steps])
    steps = np.vstack([0 * unit, probes, *(t * short for t in PREDICTED_SHARES)])
    points = np.clip(s.theta + steps, p.lower, p.upper)
    cost = lagrangian(points)
    gain = cost[0] - cost
    gain = np.where(np.isfinite(gain), gain, -np.inf)
    least = 1e-9 * abs(cost[0]) + 1e-12 * p.least_residual**2
    for i in range(0, len(weak_steps), 2):
        forth, back = gain[1 + i], gain[2 + i]
        if forth + back > least:
            return _lowest_along(p, s, weak_steps[i if forth > back else i + 1], lagrangian)
    for k, step in enumerate(inward_steps):
        i = 1 + len(weak_steps) + k
        if gain[i] > least:
            return _lowest_along(p, s, step, lagrangian)
        for t in PREDICTED_SHARES if PROBE_DISTANCE * slope[k] > size else ():
            i += len(inward_steps)
            if gain[i] > -MIN_OCCURRED * t * size:
                return points[i]
    return None


def _weakest_directions(p: Problem, s: SearchState) -> np.ndarray:
    """Find the directions along the active limits in which the sum of squares changes least."""
    unit = s.scale.unit
    held, active = active_set(p, s, p.tolerance)
    if len(unit) > MAX_DENSE and not active.any():
        found = np.zeros((len(unit), min(WEAK_DIRECTIONS, int(np.sum(~held)))))
        rows = in_units(s.at.residual_jacobian, 1 / unit)[:, ~held]
        found[~held] = weakest(rows, found.shape[1])
    else:
        tangent = _tangent_basis(p, s)
        rows = triangle(s.at.residual_jacobian * unit) @ tangent
        found = tangent @ np.linalg.svd(rows, full_matrices=True)[2][-WEAK_DIRECTIONS:].T
    return found * unit[:, None]


def _lowest_along(
    p: Problem, s: SearchState, direction: np.ndarray, lagrangian: Lagrangian
) -> np.ndarray | None:
    """Return the lowest of some points along a direction, None if none is clearly lower."""
    distances = (PROBE_DISTANCE, 10 * PROBE_DISTANCE, 100 * PROBE_DISTANCE, 0.5)
    steps = [sign * distance for distance in distances for sign in (1.0, -1.0)]
    points = [s.theta, *(np.clip(s.theta + t * direction, p.lower, p.upper) for t in steps)]
    if p.constraints:
        restored = (_restore_constraints(p, s, point) for point in points[1:])
        points = [s.theta, *(point for point in restored if point is not None)]
    cost = lagrangian(np.array(points))
    cost = np.where(np.isfinite(cost), cost, np.inf)
    best = int(np.argmin(cost))
    return points[best] if cost[0] - cost[best] > _min_decrease(p, s) else None


def _min_decrease(p: Problem, s: SearchState) -> float:
    """Return the smallest decrease of the cost that counts as one."""
    if p.objectives:
        return 1e-9 * s.scale.cost
    count = max(len(s.at.residual) - len(s.theta), 1)
    noise = 1.0 if p.errors_known or not p.records else 2 * s.at.cost / count
    return max(1e-3 * noise, 1e-6 * s.at.cost)


def _restore_constraints(p: Problem, s: SearchState, point: np.ndarray) -> np.ndarray | None:
    """Move a point onto the constraints that are active at the state, and inside all others.

    A straight step leaves curved constraints. The cost outside may be lower without there being a
    lower feasible point. Returns None if Newton's method does not get there.
    """
    held, active = active_set(p, s, p.tolerance)
    unit = np.where(held, 0.0, s.scale.unit)
    for _ in range(10):  # Newton steps
        at = slopes(p, point)
        if not at.finite:
            return None
        inside = np.clip(at.constraints, p.constraint_lower, p.constraint_upper)
        gap = at.constraints - np.where(active, s.at.constraints, inside)
        if np.all(np.abs(gap) <= 1e-10 * s.limits.scale):
            return point
        violated = gap != 0
        step = np.linalg.lstsq(at.jacobian[violated] * unit, gap[violated], rcond=None)[0]
        point = np.clip(point - unit * step, p.lower, p.upper)
    return None


def _test_curvature(p: Problem, s: SearchState) -> CurvatureTest:
    """Compute the curvature of the Lagrangian along the active limits, from exact derivatives."""
    unit, cost = s.scale.unit, s.scale.cost
    h = np.asarray(p.compiled(lagrangian_hessian)(s.theta, 1.0, s.limits.multiplier))
    h = h * np.outer(unit, unit) / cost
    tangent = _tangent_basis(p, s)
    if not tangent.shape[1] or not np.all(np.isfinite(h)):
        return CurvatureTest(None)
    values, vectors = np.linalg.eigh(tangent.T @ h @ tangent)
    slope = vectors.T @ (tangent.T @ (s.lagrangian_gradient * unit / cost))
    largest = np.max(np.abs(values))
    steep = values > CURVATURE_ROUNDING * largest
    terms = np.abs(s.at.gradient) + np.abs(s.limits.multiplier) @ np.abs(s.at.jacobian)
    significant = steep & (np.abs(slope) > GRADIENT_ROUNDING * np.max(terms * unit / cost))
    newton = np.max(np.abs(slope[significant] / values[significant]), initial=0.0)
    negative = values[0] < -CURVATURE_ROUNDING * max(largest, CURVATURE_ROUNDING)
    down = tangent @ vectors[:, 0] * unit if negative else None
    clear = values[0] < -SADDLE_CURVATURE * max(largest, 1.0) and np.all(
        np.abs(PROBE_DISTANCE * down) < np.minimum(s.theta - p.lower, p.upper - s.theta)
    )
    return CurvatureTest(down, float(newton), not steep.all() or largest < p.tolerance, clear)


def _tangent_basis(p: Problem, s: SearchState) -> np.ndarray:
    """Return a basis of the directions along the active limits, in scales of the numbers."""
    unit = s.scale.unit
    held, active = active_set(p, s, p.tolerance)
    return null_space(np.vstack([np.eye(len(unit))[held], s.at.jacobian[active] * unit]))
