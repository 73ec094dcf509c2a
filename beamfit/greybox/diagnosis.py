"""Mistakes in a problem as it is stated, found before anything is searched for."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.greybox import assess, tree
from beamfit.greybox.covariance import directions
from beamfit.greybox.judge import listed
from beamfit.greybox.problem import Problem, with_slope
from beamfit.noise.correlated import CUT

# Rows are badly scaled if their sizes differ by more than this: half the digits are lost.
APART = 1e8


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
    points = [start, *assess.nearby(p, p.start, np.maximum(np.abs(p.start), 1.0))]
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
