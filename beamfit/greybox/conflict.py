"""Constraints that cannot hold together, and those whose multipliers are not unique."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.optimize import nnls

from beamfit.greybox import problem
from beamfit.greybox.assess import NEAR, SearchState, gradient_size, nearby, scale_of
from beamfit.greybox.descend import descend_all
from beamfit.greybox.problem import Problem


class Conflict(NamedTuple):
    """The point nearest to all constraints, and names of those that conflict, if any do.

    `bounds` says which bounds take part, `numbers` names the numbers they bound.
    """

    theta: np.ndarray
    constraints: tuple[str, ...]
    bounds: tuple[str, ...] = ()
    numbers: tuple[str, ...] = ()

    @property
    def about(self) -> tuple[str, ...]:
        """Names of everything that takes part."""
        return (*self.constraints, *self.numbers)

    @property
    def feasible(self) -> bool:
        """True if all constraints hold at the point."""
        return not self.constraints


def excess(data, theta):
    """Violation of each constraint in units of its size, times its weight."""
    core, lower, upper, size, weight = data
    c = problem.constraints(core, theta)
    return weight * (jnp.maximum(lower - c, 0) + jnp.maximum(c - upper, 0)) / size


def relaxed(p: Problem, s: SearchState, starts: Iterable[np.ndarray]) -> Conflict:
    """Come as near to the constraints as the bounds allow, and name what conflicts.

    Parameters
    ----------
    p : Problem
        Of which no feasible point was found.
    s : SearchState
        The nearest one.
    starts : iterable of array, shape (n,)
        From where to try besides.

    Returns
    -------
    Conflict
    """
    points = np.array([s.theta, *starts])

    def least(weight, low, high):
        data = (p.core, p.constraint_lower, p.constraint_upper, s.limits.size, weight)
        found = descend_all(excess, data, np.clip(points, low, high), low, high)
        cost = np.where(np.isfinite(found.cost), found.cost, np.inf)
        theta = np.asarray(found.theta[int(np.argmin(cost))])
        return theta, np.asarray(excess(data, theta))

    theta, over = least(np.ones(len(s.limits.size)), p.lower, p.upper)
    if not np.max(over) > p.tolerance:
        return Conflict(theta, ())
    weight = (over > p.tolerance).astype(float)
    for i in np.flatnonzero(weight):
        without = weight * (np.arange(len(weight)) != i)
        if np.max(least(without, p.lower, p.upper)[1]) > p.tolerance:
            weight = without
    low, high = np.array(p.lower), np.array(p.upper)
    nearest = least(weight, low, high)[0]
    needed, numbers = [], []
    for i, at_low in _held(p, nearest):
        freed = [edge.copy() for edge in (low, high)]
        freed[0 if at_low else 1][i] = -np.inf if at_low else np.inf
        if np.max(least(weight, *freed)[1]) > p.tolerance:
            low, high = freed
        else:
            numbers.append(p.names[i])
            needed.append(f"{p.names[i]} {'>=' if at_low else '<='} {nearest[i]:.4g}")
    names = np.array(p.constraint_names)[weight > 0]
    return Conflict(theta, tuple(names.tolist()), tuple(needed), tuple(numbers))


def _held(p: Problem, theta: np.ndarray) -> list[tuple[int, bool]]:
    """Numbers on a bound, and whether it is the lower one; fixed ones apart."""
    sides = ((p.lower, True), (p.upper, False))
    return [(i, low) for edge, low in sides for i in np.flatnonzero((theta == edge) & p.moving)]


# Gradients are dependent below this singular value: the first at an optimum; the second elsewhere,
# since solvers only approach a point without multipliers.
DEPENDENT, NEARLY = 1e-8, 1e-2
# A constraint has no slope if that is below this share of its change nearby: a squared violation
# that a solver keeps below 1e-9 has a slope of 6e-5.
SLOPELESS = 1e-3
# Entries of a combination below this share of its largest are rounding.
PART = 1e-3


class Dependence(NamedTuple):
    """Names of what depends on one another where it holds, and of what has no slope there."""

    names: tuple[str, ...]
    slopeless: tuple[str, ...]


def dependence(p: Problem, s: SearchState, stationary: bool) -> Dependence | None:
    """Find what is wrong with the limits that hold at a feasible point, if anything is.

    Parameters
    ----------
    p : Problem
        The problem.
    s : SearchState
        The point.
    stationary : bool
        Whether the point has multipliers. If so they must be unique; if not, a combination of
        gradients that all but vanishes tells why.

    Returns
    -------
    Dependence or None
    """
    moving, unit = p.moving, s.scale.unit
    if not s.at.finite or not moving.any():
        return None
    gradients = np.vstack([np.diag(unit), s.at.jacobian * unit])[:, moving]
    size = np.concatenate([unit, _changes(p, s)])
    low, high = (
        np.concatenate(pair) for pair in zip(s.bounds.reached, s.limits.reached, strict=True)
    )
    on = (low | high) & np.concatenate([moving, np.ones(len(s.limits.size), bool)])
    # Free in sign: equalities, and multipliers that may become smaller.
    equal = low & high
    force = np.concatenate([s.bounds.multiplier, s.limits.multiplier])
    pull = np.concatenate([unit, np.linalg.norm(s.at.jacobian * unit, axis=1)])
    strength = np.max(gradient_size(p, s.at, s.scale) * unit)
    free = equal | (stationary & (np.abs(force) * pull > p.tolerance * strength))
    outward = np.where(low, 1.0, -1.0)[:, None] * gradients
    length = np.linalg.norm(gradients, axis=1)
    steep = length > SLOPELESS * size
    rows = np.where(steep[:, None], outward / np.where(steep, length, 1.0)[:, None], 0.0)[on]
    part = _combination(rows, free[on], DEPENDENT if stationary else NEARLY)
    if part is None:
        return None
    names = np.array([*p.names, *p.constraint_names])
    told = np.flatnonzero(on)[np.abs(part) > PART * np.max(np.abs(part))]
    flat = told[~steep[told]]
    return Dependence(tuple(names[told].tolist()), tuple(names[flat].tolist()))


def _changes(p: Problem, s: SearchState) -> np.ndarray:
    """Largest change of each constraint per unit of the numbers, at random points nearby."""
    points = nearby(p, s.theta, scale_of(p, s.theta, s.at).unit)
    look = p.compiled(problem.constraints)
    values = np.array([look(point) for point in points])
    change = np.abs(values - s.at.constraints) / NEAR
    return np.max(np.where(np.isfinite(change), change, 0.0), axis=0, initial=0.0)


def _combination(rows: np.ndarray, free: np.ndarray, cut: float) -> np.ndarray | None:
    """A combination of rows that vanishes, not negative where it is not free to be.

    Prefer one with rows that are not free; otherwise take one of the free rows alone.
    """
    held, v = ~free, np.zeros(len(rows))
    if held.any():
        signed = np.vstack([rows[held], rows[free], -rows[free]])
        total = np.append(np.ones(held.sum()), np.zeros(2 * free.sum()))
        one = np.append(np.zeros(rows.shape[1]), 1.0)
        found, miss = nnls(np.vstack([signed.T, total]), one, maxiter=50 * len(signed))
        if miss <= cut:
            v[held], (up, down) = found[: held.sum()], np.split(found[held.sum() :], 2)
            v[free] = up - down
            return v
    if not free.any():
        return None
    left, sizes, _ = np.linalg.svd(rows[free], full_matrices=True)
    rank = int(np.sum(sizes > cut * max(1.0, np.max(sizes))))
    if rank == free.sum():
        return None
    v[free] = left[:, rank]
    return v
