"""Mistakes in a problem as it is stated, and limits that conflict or depend on one another."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import nnls

from beamfit.greybox import assess, problem, tree
from beamfit.greybox.assess import TEST_DISTANCE, SearchState
from beamfit.greybox.covariance import directions
from beamfit.greybox.descend import descend_all
from beamfit.greybox.problem import Problem, with_slope
from beamfit.noise.correlated import CUT

# Rows are badly scaled if their sizes differ by more than this: half the digits are lost.
APART = 1e8
# Gradients are dependent below this singular value: the first at an optimum; the second elsewhere,
# since solvers only approach a point without multipliers.
DEPENDENT, NEARLY = 1e-8, 1e-2
# A constraint has no slope if that is below this share of its change nearby: a squared violation
# that a solver keeps below 1e-9 has a slope of 6e-5.
SLOPELESS = 1e-3
# Entries of a combination below this share of its largest are rounding.
PART = 1e-3


def listed(names: Iterable[str]) -> str:
    """A few names for a sentence."""
    names = list(names)
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")


class Ailment(NamedTuple):
    """A finding: its kind, the numbers, rows or constraints concerned, cause and remedy in words.

    Kinds are ``contradictory_bounds, not_finite, unused, constant, undetermined,
    dependent_equations, badly_scaled``.
    """

    kind: str
    names: tuple[str, ...]
    message: str


def diagnose(p: Problem) -> tuple[Ailment, ...]:
    """Look for what makes a problem unsolvable or its answer meaningless, without solving it.

    Parameters
    ----------
    p : Problem
        The problem, as stated.

    Returns
    -------
    tuple of Ailment
        Empty where nothing was found; what stands first is graver. Structure is read off the
        derivatives at the start and a few points beside it, in exact arithmetic of zeros: a number
        on which nothing depends at any of them is unused. Numbers are undetermined where residuals,
        priors and equations have a lower rank at every point than there are numbers, which is their
        structural rank at points at random; an objective may determine any.

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
    if wrong := contradictory(p):
        return tuple(wrong)
    points = [start, *assess.points_nearby(p, p.start, np.maximum(np.abs(p.start), 1.0))]
    first, *others = assess.slopes_at(p, np.array(points))
    # Part by part only what is known to be wrong: that is traced anew each time.
    if not first.finite and (wrong := not_finite(p, start)):
        return tuple(wrong)
    looks = [at for at in (first, *others) if at.finite]
    if not looks:  # a slope is not finite anywhere near: nothing to read off
        return ()
    return (*_unused(p, looks), *_undetermined(p, looks), *_dependent(p, looks), *_scaled(p, looks))


def contradictory(p: Problem) -> list[Ailment]:
    """Bounds and limits of which the lower lies above the upper."""
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
    """Rows that are NaN or infinite at a point, or whose derivative is, by name."""
    found = []
    for what, name, function in _parts(p):

        def flat(t, function=function):
            return jnp.ravel(function(tree.replace(p.core.model, p.core.chosen, t)))

        value, slope = map(np.asarray, with_slope(flat, jnp.asarray(theta, float)))
        bad = np.flatnonzero(~np.isfinite(value))
        steep = np.argwhere(~np.isfinite(slope))
        if bad.size:
            told = f"{what} '{name}' is {value[bad[0]]}"
            told += f" in {bad.size} of {value.size} values, the first [{bad[0]}]" * (
                value.size > 1
            )
        elif len(steep):
            row, column = steep[0]
            told = f"the derivative of {what} '{name}'" + f"[{row}]" * (value.size > 1)
            told += f" by {p.names[column]} is {slope[row, column]}"
        else:
            continue
        remedy = (
            "start elsewhere, bound the numbers, or use a parametrisation that is defined there."
        )
        found.append(Ailment("not_finite", (name,), f"not finite at the start: {told}; {remedy}"))
    return found


def _parts(p: Problem) -> Iterator[tuple[str, str, Callable[[Any], jax.Array]]]:
    """Every function of the model in the problem: what it is, its name, and it."""
    for what, group in (("record", p.records), ("prior", p.priors)):
        for part in group:
            yield what, part.name, part.residual
    for what, group in (("objective", p.objectives), ("constraint", p.constraints)):
        for part in group:
            yield what, part.name, lambda model, part=part: part.function(model, part.data)


def _depends(looks: list[np.ndarray]) -> np.ndarray:
    """True for each row and number that it depends on, at any of the points."""
    return np.any([rows != 0 for rows in looks], axis=0)


def _named(kind: str, names: Sequence[str], which: np.ndarray, said: str) -> Iterator[Ailment]:
    """An ailment of some names, if there are any; they stand in the place of {} in what is said."""
    found = tuple(np.array(names)[which].tolist())
    if found:
        yield Ailment(kind, found, said.format(listed(found)))


def _unused(p: Problem, looks: list[assess.Slopes]) -> Iterator[Ailment]:
    every = [np.vstack([a.residual_jacobian, a.gradient[None], a.jacobian]) for a in looks]
    loose = p.moving & ~_depends(every).any(axis=0)
    said = "nothing depends on {}; fix or remove what is not needed."
    yield from _named("unused", p.names, loose, said)
    idle = ~_depends([at.jacobian for at in looks])[:, p.moving].any(axis=1)
    said = "{} depends on no free number; free what it limits, or remove it."
    yield from _named("constant", p.constraint_names, idle, said)


def _undetermined(p: Problem, looks: list[assess.Slopes]) -> Iterator[Ailment]:
    """Numbers of which rows, priors and equations see fewer combinations than there are."""
    if p.objectives:
        return
    every = [np.vstack([at.residual_jacobian, at.jacobian[p.equations]]) for at in looks]
    used = np.flatnonzero(_depends(every).any(axis=0) & p.moving)
    said = (
        f"{len(every[0])} rows do not determine {{}} each: only combinations of them; fix some, or "
        "add data or priors."
    )
    loose = used[_open([rows[:, used] for rows in every])]
    yield from _named("undetermined", p.names, loose, said)


def _open(looks: list[np.ndarray]) -> np.ndarray:
    """Columns along which the rows see nothing at any point."""
    every = np.ones(looks[0].shape[1], bool)
    for rows in looks:
        _, unseen, reach = directions(rows)
        every &= np.max(np.abs(unseen), axis=1, initial=0.0) > CUT**0.5 * reach
        if not every.any():
            break
    return every


def _dependent(p: Problem, looks: list[assess.Slopes]) -> Iterator[Ailment]:
    """Equations among which one follows from the others or contradicts them."""
    equal = np.flatnonzero(p.equations)
    if not len(equal):
        return
    loose = equal[_open([at.jacobian[equal][:, p.moving].T for at in looks])]
    said = "the equations {} are not independent; remove what follows from others."
    yield from _named("dependent_equations", p.constraint_names, loose, said)


def _scaled(p: Problem, looks: list[assess.Slopes]) -> Iterator[Ailment]:
    """Constraints that change far less, or far more, than the others when numbers do."""
    unit = assess.scale_of(p, p.start, looks[0]).unit
    size = np.max([np.max(np.abs(at.jacobian) * unit, axis=1, initial=0) for at in looks], axis=0)
    usual = np.median(size[size > 0]) if (size > 0).any() else 1.0
    off = (size > 0) & ((size > APART * usual) | (size < usual / APART))
    worst = size[off][np.argmax(np.abs(np.log(size[off] / usual)))] if off.any() else usual
    said = (
        f"{{}} changes by {worst:.1e} where others change by {usual:.1e}; state it in units in "
        "which it is of their size."
    )
    yield from _named("badly_scaled", p.constraint_names, off, said)


# ---- limits that conflict


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


# ---- limits that depend on one another


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
    strength = np.max(assess.gradient_size(p, s.at, s.scale) * unit)
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
    points = assess.points_nearby(p, s.theta, assess.scale_of(p, s.theta, s.at).unit)
    look = p.compiled(problem.constraints)
    values = np.array([look(point) for point in points])
    change = np.abs(values - s.at.constraints) / TEST_DISTANCE
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
