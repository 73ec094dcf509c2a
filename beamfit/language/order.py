"""Order in which the steps of a mapping are computed, from the elements each defines and needs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from graphlib import TopologicalSorter
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from beamfit.errors import InputError
from beamfit.language import document as d
from beamfit.language import expression as x
from beamfit.language.declare import scope_of
from beamfit.language.expression import error_at
from beamfit.language.lags import RecurrencePlan, plan_of
from beamfit.language.scope import (
    Array,
    MappingStep,
    Read,
    Scope,
    located,
    reads,
    whole_of,
    widened,
)
from beamfit.language.steps import callee_of, gains_of, sources, targets, written

# Owner of an element that no statement defines.
NOBODY = -1
# Most names shown in the message about a loop.
MOST_NAMED = 8
# Limits of a mapping: elements of all statements together, statements, and statements from which
# the cycle of a loop is sought.
MOST_WORK, MOST_STEPS, MOST_TRIED = 60_000_000, 5_000, 50


class StepGroup(NamedTuple):
    """Steps that are computed together; those with a plan need their own earlier values."""

    steps: tuple[MappingStep, ...]
    plan: RecurrencePlan | None


@dataclass(frozen=True, eq=False)
class Order:
    """Steps of a mapping in an order of computation.

    `owners` tells for each element of an array which step defines it, `needs` the steps before each
    step, `given` the inputs, parameters and tables that each reads; `inner` are the orders of the
    mappings it calls.
    """

    scope: Scope
    groups: tuple[StepGroup, ...]
    owners: dict[str, np.ndarray]
    needs: dict[int, set[int]]
    given: dict[int, set[str]] = field(default_factory=dict)
    inner: dict[str, Order] = field(default_factory=dict)

    @cached_property
    def setters(self) -> dict[str, list[int]]:
        """The steps that set each array."""
        found = {name: owner[owner != NOBODY] for name, owner in self.owners.items()}
        return {name: np.flatnonzero(np.bincount(owner)).tolist() for name, owner in found.items()}

    def closure(self, names: Iterable[str]) -> tuple[set[int], set[str]]:
        """The steps, and the names given, that some names hang on."""
        todo = {n for name in names for n in self.setters.get(name, ())}
        found: set[int] = set()
        while todo := todo - found:
            found |= todo
            todo = {before for n in todo for before in self.needs[n]}
        direct = {name for name in names if name not in self.owners}
        return found, direct.union(*(self.given[n] for n in found))

    def needed(self, names: Iterable[str]) -> Iterator[StepGroup]:
        """Groups that some names hang on, each after what it needs."""
        wanted, _ = self.closure(names)
        return (g for g in self.groups if not wanted.isdisjoint(step.number for step in g.steps))


# ---- the order


def order_of(scope: Scope) -> Order:
    """Sort the steps of a mapping and of all mappings in it.

    Parameters
    ----------
    scope : Scope
        From `beamfit.language.scope.scope_of`.

    Returns
    -------
    Order

    Raises
    ------
    InputError
        With its place: a name that is unknown, an element that is defined twice or never, an index
        outside, an algebraic loop with its cycle.
    """
    inner = {name: order_of(c) for name, c in scope.callees.items() if isinstance(c, Scope)}
    owners: dict[str, np.ndarray] = {}
    _check_work(scope)
    for step in scope.steps:
        if isinstance(step.what, d.Call):
            _check_wires(scope, step, step.what)
        for node, axes in targets(scope, step):
            _own(scope, owners, step, written(scope, node, axes))
    needs: dict[int, set[int]] = {step.number: set() for step in scope.steps}
    given: dict[int, set[str]] = {step.number: set() for step in scope.steps}
    for step in scope.steps:
        for e, axes in sources(scope, step):
            for read in reads(scope, e, axes):
                if read.array.role in ("output", "real"):
                    needs[step.number] |= set(_owners_of(owners, read).tolist())
                else:
                    given[step.number].add(read.array.name)
    for array in scope.outputs.values():
        _check_defined(array, owners)
    groups = tuple(_group(scope, sorted(c), needs, owners) for c in _components(needs))
    return Order(scope, groups, owners, needs, given, inner)


def _check_work(scope: Scope) -> None:
    """Refuse more than any computer would go through in a minute."""
    total = sum(a.size for a in scope.arrays.values())
    for step in scope.steps:
        combined = int(np.prod([len(s) for s in step.axes.values()], dtype=np.int64))
        if isinstance(step.what, d.Call):
            callee = scope.callees.get(step.what.mapping)
            if isinstance(callee, Scope):
                combined *= sum(a.size for a in callee.arrays.values())
        total += combined
        if total > MOST_WORK or step.number > MOST_STEPS:
            found = f"more than {MOST_WORK} elements or {MOST_STEPS} statements in a mapping"
            raise error_at(step.at, found, "fewer")


def _group(scope, numbers: list[int], needs, owners) -> StepGroup:
    steps = tuple(scope.steps[n] for n in numbers)
    if len(steps) == 1 and numbers[0] not in needs[numbers[0]]:
        return StepGroup(steps, None)
    plan = plan_of(scope, steps, owners)
    if plan is None:
        raise _loop(scope, steps, needs, owners)
    return StepGroup(steps, plan)


def _own(scope: Scope, owners: dict[str, np.ndarray], step: MappingStep, write: Read) -> None:
    """Note which elements a step defines."""
    array, node = write.array, write.node
    owner = owners.setdefault(array.name, np.full(max(array.size, 1), NOBODY))
    shape = [len(s) for s in write.axes.values()]
    combined = int(np.prod(shape, dtype=np.int64))
    whole = np.prod([len(dim) for dim in whole_of(node, array)], dtype=np.int64)
    mark = np.zeros(owner.size, bool)
    mark[write.flat] = True
    flat = np.flatnonzero(mark)
    if flat.size < combined * whole:
        unused = [n for n in write.axes if n not in _names(node)]
        said = f"'{node}' has no index {', '.join(unused)}" if unused else "its index repeats"
        found = f"'{node}' set more than once by one statement ({said})"
        raise error_at(node.at, found, "each element once")
    taken = flat[owner[flat] != NOBODY]
    if taken.size:
        other = scope.steps[owner[taken[0]]]
        found = f"'{array.element(taken[0])}' set twice (also in line {other.at.line})"
        raise error_at(node.at, found, "each element once")
    owner[flat] = step.number


def _names(e: x.Expression) -> set[str]:
    inner = set().union(*map(_names, x.children(e)))
    return inner | {e.name} if isinstance(e, x.Name) else inner


def _owners_of(owners: dict[str, np.ndarray], read: Read) -> np.ndarray:
    """The steps that define what is read there."""
    owner = owners.get(read.array.name)
    if owner is None:
        found = f"'{read.array.name}' is used, and no statement sets it"
        raise error_at(read.node.at, found, f"a statement {read.array.name} = ...")
    if owner[0] != NOBODY and np.all(owner == owner[0]):
        return owner[:1]
    flat = read.flat
    missing = flat[owner[flat] == NOBODY]
    if missing.size:
        said = f"'{read.array.element(missing[0])}', used in '{read.node}', which no statement sets"
        raise error_at(read.node.at, said, "a statement that sets this element")
    return np.flatnonzero(np.bincount(owner[flat]))


def _check_defined(array: Array, owners: dict[str, np.ndarray]) -> None:
    owner = owners.get(array.name)
    if owner is None or np.any(owner == NOBODY):
        at = 0 if owner is None else int(np.argmax(owner == NOBODY))
        name = array.name if owner is None else array.element(at)
        raise error_at(array.at, f"output '{name}' that no statement sets", f"{name} = ...;")


def _check_wires(scope: Scope, step: MappingStep, call: d.Call) -> None:
    """Check indices on the side of what is called, and that each input is given whole."""
    callee = callee_of(scope, call)
    given: dict[str, np.ndarray] = {}
    for wire in call.inputs:
        array = callee.inputs[wire.target.name]
        axes = widened(scope, {}, wire.each)
        found = Read(array, wire.target, axes, located(scope, wire.target, array, axes))
        given.setdefault(array.name, np.zeros(max(array.size, 1), bool))[found.flat] = True
    for name, hit in given.items():
        array = callee.inputs[name]
        if not hit.all() and array.values is None:
            missing = array.element(int(np.argmin(hit)))
            found = f"'{missing}' of {call.mapping} is not given"
            raise error_at(call.at, found, f"all of {array.said}")
    for wire in call.outputs:
        axes = widened(scope, step.axes, wire.each)
        output, inputs = gains_of(wire, callee, call.mapping)
        located(scope, output, callee.outputs[output.name], axes)
        for e in inputs:
            array = callee.inputs[e.name]
            if len(e.indices) != len(array.dims):
                found = f"'{e}' in '{wire.value}'"
                raise error_at(
                    e.at, found, f"one number of {array.said} such as {array.element(0)}"
                )
            located(scope, e, array, axes)


def _components(needs: dict[int, set[int]]) -> list[list[int]]:
    """Steps that need one another, each by itself where none does; needed ones first."""
    pairs = [(a, b) for a, before in needs.items() for b in before]
    ends = np.array(pairs, int).reshape(-1, 2).T
    graph = csr_matrix((np.ones(len(pairs)), ends), shape=(len(needs), len(needs)))
    _, label = connected_components(graph, connection="strong")
    members: dict[int, list[int]] = {}
    for number, at in enumerate(label.tolist()):
        members.setdefault(at, []).append(number)
    before = {
        at: {int(label[b]) for n in group for b in needs[n]} - {at} for at, group in members.items()
    }
    return [members[at] for at in TopologicalSorter(before).static_order()]


def _loop(scope: Scope, steps: tuple[MappingStep, ...], needs, owners) -> InputError:
    """An algebraic loop, with the names along a cycle that no time takes apart."""
    members = {s.number for s in steps}
    cycles = (_cycle(n, needs, members) for n in sorted(members)[:MOST_TRIED])
    found = sorted((c for c in cycles if c), key=len)
    parts = ((c, tuple(scope.steps[n] for n in sorted(set(c)))) for c in found)
    cycle = next((c for c, part in parts if plan_of(scope, part, owners) is None), found[0])
    names = [str(targets(scope, scope.steps[n])[0][0]) for n in cycle]
    lines = [str(n) for n in sorted({scope.steps[n].at.line for n in cycle})]
    said = f"an algebraic loop: {' -> '.join(_few(names))} (line {', '.join(_few(lines))})"
    expected = "statements of which each needs earlier ones only, or earlier times such as y[t-1]"
    return error_at(scope.steps[min(cycle)].at, said, expected)


def _few(words: list[str]) -> list[str]:
    return words if len(words) <= MOST_NAMED else [*words[: MOST_NAMED - 2], "...", words[-1]]


def _cycle(start: int, needs: dict[int, set[int]], members: set[int]) -> list[int]:
    """The shortest way from a step to itself, what is needed first; empty if there is none."""
    came: dict[int, int | None] = {start: None}
    todo = [start]
    for at in todo:
        for before in sorted(needs[at] & members):
            if before == start:
                way: list[int] = [start]
                back: int | None = at
                while back is not None:
                    way.append(back)
                    back = came[back]
                return way
            if before not in came:
                came[before] = at
                todo.append(before)
    return []


class _Same(NamedTuple):
    """A mapping as itself: an equal one may stand at other lines."""

    mapping: d.Mapping

    def __hash__(self) -> int:
        return id(self.mapping)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and self.mapping is other.mapping


def checked(mapping: d.Mapping, shapes=None) -> Order:
    """Names, indices and order of a mapping, checked without computing anything.

    Kept for the mappings seen last: what is compiled for one order serves when it is solved again.
    """
    return _ordered(_Same(mapping), tuple(sorted((shapes or {}).items())))


@lru_cache(maxsize=64)
def _ordered(same: _Same, shapes: tuple[tuple[str, tuple[int, ...]], ...]) -> Order:
    return order_of(scope_of(same.mapping, dict(shapes)))
