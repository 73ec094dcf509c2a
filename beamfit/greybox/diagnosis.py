"""Errors in the statement of a problem, conflicting constraints and dependent constraints."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.greybox import assess, problem, tree
from beamfit.greybox.assess import TEST_DISTANCE, SearchState
from beamfit.greybox.covariance import directions
from beamfit.greybox.descend import descend_all
from beamfit.greybox.problem import Problem, with_slope
from beamfit.noise.correlated import CUT

# Constraints are badly scaled if their changes differ by more than this: half the digits are lost.
MAX_SCALE_RATIO = 1e8
# Gradients of active constraints are dependent below this singular value: at an optimum ...
DEPENDENT_AT_OPTIMUM = 1e-8
# ... and elsewhere, since solvers only approach a point without multipliers.
DEPENDENT_ELSEWHERE = 1e-2
# The gradient of a constraint vanishes if it is below this share of the constraint's change nearby:
# a squared violation that a solver keeps below 1e-9 has a gradient of 6e-5.
VANISHING_GRADIENT = 1e-3
# Coefficients of a linear combination below this share of the largest are rounding.
MIN_COEFFICIENT = 1e-3


def listed(names: Iterable[str]) -> str:
    """Join the first four names for a sentence, and count the others."""
    names = list(names)
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")


class Ailment(NamedTuple):
    """An error in a problem: its kind, the names concerned, and a message with cause and remedy.

    Kinds are ``contradictory_bounds, not_finite, unused, constant, undetermined,
    dependent_equations, badly_scaled``.
    """

    kind: str
    names: tuple[str, ...]
    message: str


def diagnose(p: Problem) -> tuple[Ailment, ...]:
    """Look for errors that make a problem unsolvable or its answer meaningless, without solving it.

    Parameters
    ----------
    p : Problem
        The problem.

    Returns
    -------
    tuple of Ailment
        The gravest first; empty if no error was found.

    Notes
    -----
    The structure follows from the derivatives at the start and at a few random points nearby. A
    number is unused if all derivatives by it are exactly zero at all points. Numbers are
    undetermined if residuals, priors and equations have a rank below the number of free numbers at
    every point (their structural rank). A problem with an objective is not tested for this.

    Examples
    --------
    >>> from beamfit.greybox.problem import Free, Record
    >>> def line(model, x):
    ...     return (model["a"] + model["b"]) * x
    >>> p = Problem({"a": 1.0, "b": 1.0, "c": 1.0}, [Free("a"), Free("b"), Free("c")],
    ...             [Record("scan", line, np.arange(3.0), [0.0, 2.0, 4.0], error=0.1)])
    >>> for found in diagnose(p):
    ...     print(found.kind, found.names)
    unused ('c',)
    undetermined ('a', 'b')
    """
    start = np.clip(p.start, p.lower, p.upper)
    if errors := contradictory(p):
        return tuple(errors)
    points = [start, *assess.points_nearby(p, p.start, np.maximum(np.abs(p.start), 1.0))]
    first, *others = assess.slopes_at(p, np.array(points))
    # Test part by part only if something is wrong: each part must be traced anew.
    if not first.finite and (errors := not_finite(p, start)):
        return tuple(errors)
    samples = [at for at in (first, *others) if at.finite]
    if not samples:  # no point nearby has finite derivatives
        return ()
    return (
        *_unused(p, samples),
        *_undetermined(p, samples),
        *_dependent(p, samples),
        *_scaled(p, samples),
    )


def contradictory(p: Problem) -> list[Ailment]:
    """Find bounds and limits whose lower end lies above the upper."""
    names = (*p.names, *p.constraint_names)
    low, high = np.append(p.lower, p.constraint_lower), np.append(p.upper, p.constraint_upper)
    return [
        Ailment(
            "contradictory_bounds", (names[i],),
            f"the lower bound of {names[i]}, {low[i]:g}, lies above its upper bound, {high[i]:g}; "
            "correct the bounds.",
        )
        for i in np.flatnonzero(~(low <= high))
    ]  # fmt: skip


def not_finite(p: Problem, theta: np.ndarray) -> list[Ailment]:
    """Find records, priors, objectives and constraints with a value or derivative not finite."""
    found = []
    for kind, name, function in _parts(p):

        def flat(t, function=function):
            return jnp.ravel(function(tree.replace(p.core.model, p.core.chosen, t)))

        value, slope = map(np.asarray, with_slope(flat, jnp.asarray(theta, float)))
        bad = np.flatnonzero(~np.isfinite(value))
        steep = np.argwhere(~np.isfinite(slope))
        if bad.size:
            text = f"{kind} '{name}' is {value[bad[0]]}"
            text += f" in {bad.size} of {value.size} values, the first [{bad[0]}]" * (
                value.size > 1
            )
        elif len(steep):
            row, column = steep[0]
            text = f"the derivative of {kind} '{name}'" + f"[{row}]" * (value.size > 1)
            text += f" by {p.names[column]} is {slope[row, column]}"
        else:
            continue
        remedy = (
            "start elsewhere, bound the numbers, or use a parametrisation that is defined there."
        )
        found.append(Ailment("not_finite", (name,), f"not finite at the start: {text}; {remedy}"))
    return found


def _parts(p: Problem) -> Iterator[tuple[str, str, Callable[[Any], jax.Array]]]:
    """Yield kind, name and function of each record, prior, objective and constraint."""
    for kind, group in (("record", p.records), ("prior", p.priors)):
        for part in group:
            yield kind, part.name, part.residual
    for kind, group in (("objective", p.objectives), ("constraint", p.constraints)):
        for part in group:
            yield kind, part.name, lambda model, part=part: part.function(model, part.data)


def _depends(samples: list[np.ndarray]) -> np.ndarray:
    """True for each row and number if the row depends on the number at any of the points."""
    return np.any([rows != 0 for rows in samples], axis=0)


def _error_about(
    kind: str, names: Sequence[str], selected: np.ndarray, message: str
) -> Iterator[Ailment]:
    """Yield an error about the selected names, if any; {} in the message stands for them."""
    found = tuple(np.array(names)[selected].tolist())
    if found:
        yield Ailment(kind, found, message.format(listed(found)))


def _unused(p: Problem, samples: list[assess.Slopes]) -> Iterator[Ailment]:
    every = [np.vstack([a.residual_jacobian, a.gradient[None], a.jacobian]) for a in samples]
    unused = p.moving & ~_depends(every).any(axis=0)
    message = "nothing depends on {}; fix or remove what is not needed."
    yield from _error_about("unused", p.names, unused, message)
    idle = ~_depends([at.jacobian for at in samples])[:, p.moving].any(axis=1)
    message = "{} depends on no free number; free what it limits, or remove it."
    yield from _error_about("constant", p.constraint_names, idle, message)


def _undetermined(p: Problem, samples: list[assess.Slopes]) -> Iterator[Ailment]:
    """Find numbers of which residuals, priors and equations determine only combinations."""
    if p.objectives:
        return
    every = [np.vstack([at.residual_jacobian, at.jacobian[p.equations]]) for at in samples]
    used = np.flatnonzero(_depends(every).any(axis=0) & p.moving)
    message = (
        f"{len(every[0])} rows do not determine {{}} each: only combinations of them; fix some, or "
        "add data or priors."
    )
    undetermined = used[_undetermined_columns([rows[:, used] for rows in every])]
    yield from _error_about("undetermined", p.names, undetermined, message)


def _undetermined_columns(samples: list[np.ndarray]) -> np.ndarray:
    """True for each column that the rows do not determine at any of the points."""
    every = np.ones(samples[0].shape[1], bool)
    for rows in samples:
        _, undetermined, reach = directions(rows)
        every &= np.max(np.abs(undetermined), axis=1, initial=0.0) > CUT**0.5 * reach
        if not every.any():
            break
    return every


def _dependent(p: Problem, samples: list[assess.Slopes]) -> Iterator[Ailment]:
    """Find equations of which one follows from the others or contradicts them."""
    equal = np.flatnonzero(p.equations)
    if not len(equal):
        return
    dependent = equal[_undetermined_columns([at.jacobian[equal][:, p.moving].T for at in samples])]
    message = "the equations {} are not independent; remove what follows from others."
    yield from _error_about("dependent_equations", p.constraint_names, dependent, message)


def _scaled(p: Problem, samples: list[assess.Slopes]) -> Iterator[Ailment]:
    """Find constraints that change far less or far more with the numbers than the others."""
    unit = assess.scale_of(p, p.start, samples[0]).unit
    size = np.max([np.max(np.abs(at.jacobian) * unit, axis=1, initial=0) for at in samples], axis=0)
    typical = np.median(size[size > 0]) if (size > 0).any() else 1.0
    off = (size > 0) & ((size > MAX_SCALE_RATIO * typical) | (size < typical / MAX_SCALE_RATIO))
    worst = size[off][np.argmax(np.abs(np.log(size[off] / typical)))] if off.any() else typical
    message = (
        f"{{}} changes by {worst:.1e} where others change by {typical:.1e}; state it in units in "
        "which it is of their size."
    )
    yield from _error_about("badly_scaled", p.constraint_names, off, message)


# ---- conflicting constraints


class Conflict(NamedTuple):
    """The point nearest to all constraints, and the names of a minimal set that conflicts.

    `constraints` is empty if all hold at the point. `bounds` are the bounds that take part, written
    as inequalities, and `numbers` the names of the numbers they bound.
    """

    theta: np.ndarray
    constraints: tuple[str, ...]
    bounds: tuple[str, ...] = ()
    numbers: tuple[str, ...] = ()

    @property
    def about(self) -> tuple[str, ...]:
        """Names of all constraints and numbers that take part."""
        return (*self.constraints, *self.numbers)

    @property
    def feasible(self) -> bool:
        """True if all constraints hold at the point."""
        return not self.constraints


def excess(data, theta):
    """Compute the violation of each constraint in units of its scale, times its weight."""
    core, lower, upper, size, weight = data
    c = problem.constraints(core, theta)
    return weight * (jnp.maximum(lower - c, 0) + jnp.maximum(c - upper, 0)) / size


def find_conflict(p: Problem, s: SearchState, starts: Iterable[np.ndarray]) -> Conflict:
    """Find the point within the bounds nearest to all constraints, and name those that conflict.

    Parameters
    ----------
    p : Problem
        A problem for which no feasible point was found.
    s : SearchState
        The point nearest to feasibility so far.
    starts : iterable of array, shape (n,)
        Further starting points.

    Returns
    -------
    Conflict
    """
    points = np.array([s.theta, *starts])

    def nearest_point(weight, low, high):
        data = (p.core, p.constraint_lower, p.constraint_upper, s.limits.scale, weight)
        found = descend_all(excess, data, np.clip(points, low, high), low, high)
        cost = np.where(np.isfinite(found.cost), found.cost, np.inf)
        theta = np.asarray(found.theta[int(np.argmin(cost))])
        return theta, np.asarray(excess(data, theta))

    theta, violation = nearest_point(np.ones(len(s.limits.scale)), p.lower, p.upper)
    if not np.max(violation) > p.tolerance:
        return Conflict(theta, ())
    weight = (violation > p.tolerance).astype(float)
    for i in np.flatnonzero(weight):
        without = weight * (np.arange(len(weight)) != i)
        if np.max(nearest_point(without, p.lower, p.upper)[1]) > p.tolerance:
            weight = without
    low, high = np.array(p.lower), np.array(p.upper)
    nearest = nearest_point(weight, low, high)[0]
    needed, numbers = [], []
    for i, at_low in _at_bounds(p, nearest):
        freed = [edge.copy() for edge in (low, high)]
        freed[0 if at_low else 1][i] = -np.inf if at_low else np.inf
        if np.max(nearest_point(weight, *freed)[1]) > p.tolerance:
            low, high = freed
        else:
            numbers.append(p.names[i])
            needed.append(f"{p.names[i]} {'>=' if at_low else '<='} {nearest[i]:.4g}")
    names = np.array(p.constraint_names)[weight > 0]
    return Conflict(theta, tuple(names.tolist()), tuple(needed), tuple(numbers))


def _at_bounds(p: Problem, theta: np.ndarray) -> list[tuple[int, bool]]:
    """List the free numbers at a bound, with True for the lower one."""
    sides = ((p.lower, True), (p.upper, False))
    return [(i, low) for edge, low in sides for i in np.flatnonzero((theta == edge) & p.moving)]


# ---- dependent constraints


class Dependence(NamedTuple):
    """Names of active limits with dependent gradients, and of those whose gradient vanishes."""

    names: tuple[str, ...]
    flat: tuple[str, ...]


def dependence(p: Problem, s: SearchState, stationary: bool) -> Dependence | None:
    """Test the constraint qualification: find active limits whose gradients are dependent.

    Parameters
    ----------
    p : Problem
        The problem.
    s : SearchState
        A feasible point.
    stationary : bool
        True if the point has multipliers, which must then be unique. Otherwise a combination of
        gradients that nearly vanishes is the reason for their absence.

    Returns
    -------
    Dependence or None
        None if the gradients of the active limits are independent.
    """
    moving, unit = p.moving, s.scale.unit
    if not s.at.finite or not moving.any():
        return None
    gradients = np.vstack([np.diag(unit), s.at.jacobian * unit])[:, moving]
    size = np.concatenate([unit, _changes_nearby(p, s)])
    low, high = (
        np.concatenate(pair) for pair in zip(s.bounds.reached, s.limits.reached, strict=True)
    )
    active = (low | high) & np.concatenate([moving, np.ones(len(s.limits.scale), bool)])
    # Coefficients of either sign are allowed for equations, and for multipliers that are not zero.
    equal = low & high
    force = np.concatenate([s.bounds.multiplier, s.limits.multiplier])
    gradient_length = np.concatenate([unit, np.linalg.norm(s.at.jacobian * unit, axis=1)])
    strength = np.max(assess.gradient_size(p, s.at, s.scale) * unit)
    free = equal | (stationary & (np.abs(force) * gradient_length > p.tolerance * strength))
    outward = np.where(low, 1.0, -1.0)[:, None] * gradients
    length = np.linalg.norm(gradients, axis=1)
    steep = length > VANISHING_GRADIENT * size
    rows = np.where(steep[:, None], outward / np.where(steep, length, 1.0)[:, None], 0.0)[active]
    part = _vanishing_combination(
        rows, free[active], DEPENDENT_AT_OPTIMUM if stationary else DEPENDENT_ELSEWHERE
    )
    if part is None:
        return None
    names = np.array([*p.names, *p.constraint_names])
    involved = np.flatnonzero(active)[np.abs(part) > MIN_COEFFICIENT * np.max(np.abs(part))]
    flat = involved[~steep[involved]]
    return Dependence(tuple(names[involved].tolist()), tuple(names[flat].tolist()))


def _changes_nearby(p: Problem, s: SearchState) -> np.ndarray:
    """Compute the largest change of each constraint, per unit step, at random points nearby."""
    points = assess.points_nearby(p, s.theta, assess.scale_of(p, s.theta, s.at).unit)
    evaluate = p.compiled(problem.constraints)
    values = np.array([evaluate(point) for point in points])
    change = np.abs(values - s.at.constraints) / TEST_DISTANCE
    return np.max(np.where(np.isfinite(change), change, 0.0), axis=0, initial=0.0)


def _vanishing_combination(rows: np.ndarray, free: np.ndarray, cut: float) -> np.ndarray | None:
    """Find a linear combination of rows that vanishes; None if there is none.

    Coefficients may be negative only where `free`. A combination with rows that are not free is
    preferred to one of free rows alone.
    """
    held, v = ~free, np.zeros(len(rows))
    if held.any():
        from scipy.optimize import nnls  # slow to import, needed only here

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
    vectors, sizes, _ = np.linalg.svd(rows[free], full_matrices=True)
    rank = int(np.sum(sizes > cut * max(1.0, np.max(sizes))))
    if rank == free.sum():
        return None
    v[free] = vectors[:, rank]
    return v
