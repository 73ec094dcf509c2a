"""Which constraints cannot hold together, and the nearest point to keeping them all.

Elastic relaxation: every constraint may give way, at the price of its violation squared. Where even
the cheapest point pays, the deletion filter drops one constraint after the other and keeps dropped
what the rest conflicts without; what is left is a set of which every part is needed
(J. W. Chinneck, Feasibility and Infeasibility in Optimization, Springer 2008, sections 6.1 and
6.2.1). The searches are local, so that the set is the smallest as far as they see.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from beamfit.greybox import problem
from beamfit.greybox.assess import TOLERANCE, State
from beamfit.greybox.descend import descend_all
from beamfit.greybox.problem import Problem


class Conflict(NamedTuple):
    """The point nearest to all constraints, and names of those that conflict, if any do."""

    theta: np.ndarray
    constraints: tuple[str, ...]
    bounds: tuple[str, ...]

    @property
    def feasible(self) -> bool:
        """Whether all constraints hold at the point."""
        return not self.constraints


def excess(data, theta):
    """By how much each constraint is crossed, in sizes, where its weight is 1."""
    core, lower, upper, size, weight = data
    c = problem.constraints(core, theta)
    return weight * (jnp.maximum(lower - c, 0) + jnp.maximum(c - upper, 0)) / size


def relaxed(p: Problem, s: State, starts: Iterable[np.ndarray]) -> Conflict:
    """Come as near to the constraints as the bounds allow, and name what conflicts.

    Parameters
    ----------
    p : Problem
        Of which no feasible point was found.
    s : State
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
    if not np.max(over) > TOLERANCE:
        return Conflict(theta, (), ())
    weight = (over > TOLERANCE).astype(float)
    for i in np.flatnonzero(weight):
        without = weight * (np.arange(len(weight)) != i)
        if np.max(least(without, p.lower, p.upper)[1]) > TOLERANCE:
            weight = without
    low, high = np.array(p.lower), np.array(p.upper)
    nearest = least(weight, low, high)[0]
    needed = []
    for i, at_low in _held(p, nearest):
        freed = [edge.copy() for edge in (low, high)]
        freed[0 if at_low else 1][i] = -np.inf if at_low else np.inf
        if np.max(least(weight, *freed)[1]) > TOLERANCE:
            low, high = freed
        else:
            needed.append(f"{p.names[i]} {'>=' if at_low else '<='} {nearest[i]:.4g}")
    names = np.array(p.constraint_names)[weight > 0]
    return Conflict(theta, tuple(names.tolist()), tuple(needed))


def _held(p: Problem, theta: np.ndarray) -> list[tuple[int, bool]]:
    """Numbers on a bound, and whether it is the lower one; fixed ones apart."""
    loose = p.lower < p.upper
    sides = ((p.lower, True), (p.upper, False))
    return [(i, low) for edge, low in sides for i in np.flatnonzero((theta == edge) & loose)]
