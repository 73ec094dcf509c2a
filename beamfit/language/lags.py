"""Statements that need their own earlier values: along which index, and how far back."""

from __future__ import annotations

from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from itertools import islice, product
from typing import NamedTuple

import numpy as np

from beamfit.language import expression as x
from beamfit.language.scope import MappingStep, Read, Scope, located, reads
from beamfit.language.steps import sources, targets

# Most combinations of time indices, one for each statement of a loop, that are tried.
MOST_TRIED = 64


class Written(NamedTuple):
    """Dimension along which an array advances, and its first index there."""

    dim: int
    start: int


class Lagged(NamedTuple):
    """A read of what the group itself computes: how many steps back, and which element there."""

    name: str
    lag: np.ndarray
    rest: list[np.ndarray]
    whole: int


class RecurrencePlan(NamedTuple):
    """Steps in their order at one time, their time iterators, and what each reads of the past.

    `reads` are by identity of the node, `depth` is the longest way back.
    """

    steps: tuple[MappingStep, ...]
    time: dict[int, str]
    written: dict[str, Written]
    length: int
    reads: dict[int, Lagged]
    depth: int


def plan_of(
    scope: Scope, steps: tuple[MappingStep, ...], owners: dict[str, np.ndarray]
) -> RecurrencePlan | None:
    """Find how steps that need one another advance in time; None if they form a true loop."""
    choices = [list(_advances(scope, step)) for step in steps]
    for chosen in islice(product(*choices), MOST_TRIED):
        plan = _planned(scope, steps, owners, chosen)
        if plan is not None:
            return plan
    return None


def _advances(scope: Scope, step: MappingStep) -> Iterator[tuple[str, dict[str, Written], int]]:
    """The iterators along which all that a step writes advances by one."""
    for k, (axis, over) in enumerate(step.axes.items()):
        found: dict[str, Written] = {}
        for node, axes in targets(scope, step):
            array = scope.arrays[node.name]
            indices = located(scope, node, array, axes)
            moving = [i for i, index in enumerate(indices) if index.shape[k] > 1]
            if len(moving) != 1 or indices[moving[0]].size != len(over):
                break
            values = indices[moving[0]].ravel()
            if np.any(np.diff(values) != 1):
                break
            here = Written(moving[0], int(values[0]))
            if found.setdefault(node.name, here) != here:
                break
        else:
            yield axis, found, len(over)


def _planned(scope, steps, owners, chosen) -> RecurrencePlan | None:
    """The plan for one choice of time iterators, if every read lies at this time or before."""
    if len({n for _, _, n in chosen}) > 1:
        return None
    written: dict[str, Written] = {}
    for _, found, _ in chosen:
        for name, here in found.items():
            if written.setdefault(name, here) != here:
                return None
    numbers = np.array([step.number for step in steps])
    lagged: dict[int, Lagged] = {}
    now: dict[int, set[int]] = {step.number: set() for step in steps}
    for step, (axis, _, length) in zip(steps, chosen, strict=True):
        k = list(step.axes).index(axis)
        for read in (r for e, axes in sources(scope, step) for r in reads(scope, e, axes)):
            owner = owners.get(read.array.name)
            if owner is None or not np.isin(owner[read.flat], numbers).any():
                continue
            found = _lag(read, written.get(read.array.name), k, length)
            if found is None:
                return None
            lagged[id(read.node)] = found
            shape = np.broadcast_shapes(*(i.shape for i in read.indices))
            here = np.broadcast_to(found.lag == 0, shape).ravel()
            now[step.number] |= set(owner[read.flat[here]].tolist()) & set(numbers.tolist())
    try:
        order = list(TopologicalSorter(now).static_order())
    except CycleError:
        return None
    by_number = {step.number: step for step in steps}
    time = {step.number: axis for step, (axis, _, _) in zip(steps, chosen, strict=True)}
    depth = max((int(np.max(r.lag)) for r in lagged.values()), default=0)
    ordered = tuple(by_number[n] for n in order)
    return RecurrencePlan(ordered, time, written, chosen[0][2], lagged, depth)


def _lag(read: Read, written: Written | None, k: int, length: int) -> Lagged | None:
    """Lag of a read along the time axis k; None if it changes or is negative."""
    if written is None:
        return None
    rank = read.indices[0].ndim
    times = written.start + np.arange(length).reshape([-1 if i == k else 1 for i in range(rank)])
    lag = times - read.indices[written.dim]
    rest = [index for i, index in enumerate(read.indices) if i != written.dim]
    first = np.take(lag, [0], axis=k)
    if np.any(lag != first) or np.any(first < 0) or any(index.shape[k] > 1 for index in rest):
        return None
    whole = sum(isinstance(i, x.Whole) for i in read.node.indices)
    return Lagged(read.array.name, first, rest, whole)
