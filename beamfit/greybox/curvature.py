"""Second-order test of an optimum: directions in which the cost bends down.

An optimum's Lagrangian does not bend downward along the limits that hold (Nocedal & Wright,
Numerical Optimization, 2nd ed., section 12.5). Objectives are tested with exact derivatives,
squares by looking at points beside the end: what their residuals bend is not in their Jacobian.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import numpy as np

from beamfit.greybox import assess, problem
from beamfit.greybox.covariance import FEW, null_space, triangle
from beamfit.greybox.problem import Problem
from beamfit.greybox.sparse import in_units, weakest

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
LOST, PARTS = 1e-2, (1.0, 1e-2)
# Test points: distance in sizes of the numbers, count along the weakest directions of a sum of
# squares, and count at random or inward from bounds.
NEAR, WEAKEST, AROUND = 1e-3, 2, 4

# Newton steps that bring a point back onto its constraints, and the tolerance of these.
RESTORED, CLOSE = 10, 1e-10

# Lagrangian at points, shape (k, n) to (k,).
Look = Callable[[np.ndarray], np.ndarray]


def lagrangian_hessian(core, theta, sigma, y):
    """Hessian of the Lagrangian sigma * cost - y @ constraints."""

    def lagrangian(t):
        return sigma * problem.cost(core, t) - y @ problem.constraints(core, t)

    return jax.hessian(lagrangian)(theta)


def second_order(
    p: Problem, s: assess.SearchState, exact: bool
) -> tuple[assess.SearchState, np.ndarray | None]:
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
    assess.SearchState
        With its `assess.Bend`.
    array, shape (n,), or None
        Another point, from where to go on, if the cost falls beside this one.
    """

    def lagrangian(points):
        found = (p.compiled(problem.values)(point) for point in points)
        return np.array([float(c) - s.found.constraints @ np.asarray(held) for c, held in found])

    if not (p.objectives and exact):
        point = lower_beside(p, s, lagrangian)
        return s._replace(bend=assess.Bend(None if point is None else point - s.theta)), point
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


def lower_beside(p: Problem, s: assess.SearchState, lagrangian: Look) -> np.ndarray | None:
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
    short = pushes * np.minimum(size / slope, NEAR)[:, None]
    steps = np.vstack([0 * unit, NEAR * sides, NEAR * pushes, *(t * short for t in PARTS)])
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
            if NEAR * slope[k] > size and gain[i + at * len(pushes)] > -LOST * t * size:
                return points[i + at * len(pushes)]
    return None


def _weakest(p: Problem, s: assess.SearchState) -> np.ndarray:
    """The weakest directions of squares that keep to the limits held by a force."""
    unit = s.scale.unit
    held, on = assess.holding(p, s, p.tolerance)
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
    p: Problem,
    s: assess.SearchState,
    direction: np.ndarray,
    lagrangian: Look,
) -> np.ndarray | None:
    """The best of some points along a direction, None if none is better by what counts."""
    steps = [sign * step for step in (NEAR, 10 * NEAR, 100 * NEAR, 0.5) for sign in (1.0, -1.0)]
    points = [s.theta, *(np.clip(s.theta + t * direction, p.lower, p.upper) for t in steps)]
    if p.constraints:
        restored = (_restored(p, s, point) for point in points[1:])
        points = [s.theta, *(point for point in restored if point is not None)]
    cost = lagrangian(np.array(points))
    cost = np.where(np.isfinite(cost), cost, np.inf)
    best = int(np.argmin(cost))
    return points[best] if cost[0] - cost[best] > _worth(p, s) else None


def _worth(p: Problem, s: assess.SearchState) -> float:
    """The decrease of the cost from which on a point is lower."""
    if p.objectives:
        return 1e-9 * s.scale.cost
    count = max(len(s.at.residual) - len(s.theta), 1)
    noise = 1.0 if p.errors_known or not p.records else 2 * s.at.cost / count
    return max(1e-3 * noise, 1e-6 * s.at.cost)


def _restored(p: Problem, s: assess.SearchState, point: np.ndarray) -> np.ndarray | None:
    """A point moved onto the constraints that hold at another one, and inside all; None if not.

    Beside curved constraints a straight step leaves them, and a cost that is lower there is no
    lower cost: along a ridge of equal costs it would be taken for a way down.
    """
    held, on = assess.holding(p, s, p.tolerance)
    unit = np.where(held, 0.0, s.scale.unit)
    for _ in range(RESTORED):
        at = assess.slopes(p, point)
        if not at.finite:
            return None
        inside = np.clip(at.constraints, p.constraint_lower, p.constraint_upper)
        gap = at.constraints - np.where(on, s.at.constraints, inside)
        if np.all(np.abs(gap) <= CLOSE * s.limits.size):
            return point
        left = gap != 0
        step = np.linalg.lstsq(at.jacobian[left] * unit, gap[left], rcond=None)[0]
        point = np.clip(point - unit * step, p.lower, p.upper)
    return None


def _bend(p: Problem, s: assess.SearchState) -> assess.Bend:
    """Curvature on the directions that active limits leave, from exact derivatives."""
    unit, cost = s.scale.unit, s.scale.cost
    h = np.asarray(p.compiled(lagrangian_hessian)(s.theta, 1.0, s.found.constraints))
    h = h * np.outer(unit, unit) / cost
    tangent = _tangent(p, s)
    if not tangent.shape[1] or not np.all(np.isfinite(h)):
        return assess.Bend(None)
    values, vectors = np.linalg.eigh(tangent.T @ h @ tangent)
    left = s.at.gradient - s.found.bounds - s.at.jacobian.T @ s.found.constraints
    slope = vectors.T @ (tangent.T @ (left * unit / cost))
    largest = np.max(np.abs(values))
    steep = values > FLAT * largest
    terms = np.abs(s.at.gradient) + np.abs(s.found.constraints) @ np.abs(s.at.jacobian)
    told = steep & (np.abs(slope) > ROUNDING * np.max(terms * unit / cost))
    newton = np.max(np.abs(slope[told] / values[told]), initial=0.0)
    down = tangent @ vectors[:, 0] * unit if values[0] < -FLAT * max(largest, FLAT) else None
    clear = values[0] < -PLAIN * max(largest, 1.0) and np.all(
        np.abs(NEAR * down) < np.minimum(s.theta - p.lower, p.upper - s.theta)
    )
    return assess.Bend(down, float(newton), not steep.all() or largest < p.tolerance, clear)


def _tangent(p: Problem, s: assess.SearchState) -> np.ndarray:
    """Directions, in the sizes of the numbers, that keep to the limits held by a force."""
    unit = s.scale.unit
    held, on = assess.holding(p, s, p.tolerance)
    return null_space(np.vstack([np.eye(len(unit))[held], s.at.jacobian[on] * unit]))
