"""Order of computation of a mapping's steps, from the elements that each defines and needs.

Statements that need earlier values of themselves are computed together, step by step along an
index called time (a recurrence).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from graphlib import CycleError, TopologicalSorter
from itertools import islice, product
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from beamfit.errors import InputError, nearest
from beamfit.language import document as d
from beamfit.language import expression as x
from beamfit.language.expression import error_at
from beamfit.language.scope import (
    Array,
    Axes,
    CalledNetwork,
    MappingStep,
    Read,
    Scope,
    add_iterators,
    check_problem,
    find_positions,
    reads,
    scope_of,
    whole_dimensions,
)

# Owner of an element that no statement defines.
NO_OWNER = -1
# Largest number of names in the message about a loop.
MAX_NAMED = 8
# Largest number of elements of all statements of a mapping: about a minute of checks.
MAX_TOTAL_ELEMENTS = 60_000_000
# Largest number of statements of a mapping.
MAX_STEPS = 5_000
# Largest number of combinations of time indices that are tried for the statements of a recurrence,
# and of statements from which the cycle of a loop is sought.
MAX_TRIED = 64


# ---- arrays that steps write and read, mappings that they call


def callee_of(scope: Scope, call: d.Call) -> Scope | CalledNetwork:
    """Find the mapping or network of a call, and check the names of its inputs and outputs."""
    callee = scope.callees.get(call.mapping)
    if callee is None:
        suggestion = nearest(call.mapping, list(scope.callees))
        raise error_at(call.at, f"unknown mapping '{call.mapping}'", suggestion)
    for wire in call.inputs:
        if wire.target.name not in callee.inputs:
            suggestion = nearest(wire.target.name, list(callee.inputs))
            found = f"unknown input '{wire.target.name}' of {call.mapping}"
            raise error_at(wire.target.at, found, suggestion)
    given = [w.target.name for w in call.inputs if not w.target.indices]
    for name, wanted in callee.inputs.items():
        if wanted.values is None and name not in [w.target.name for w in call.inputs]:
            found = f"input '{name}' of {call.mapping} is not given"
            raise error_at(call.at, found, f"{name} = ... before '::'")
        if given.count(name) > 1:
            raise error_at(call.at, f"input '{name}' of {call.mapping} given twice", "once")
    if not call.outputs:
        raise error_at(call.at, f"a call of {call.mapping} without outputs", "outputs behind '::'")
    for wire in call.outputs:
        gains_of(wire, callee, call.mapping)
    return callee


def gains_of(
    wire: d.Assignment, callee: Scope | CalledNetwork, label: str
) -> tuple[x.Name, tuple[x.Name, ...]]:
    """Return the output of a call's wire, and the inputs of its derivative `gain(y, x)`."""
    names = (wire.value,)
    if isinstance(wire.value, x.Application) and wire.value.function == "gain":
        names = wire.value.arguments
    wrong = [e for e in names if not isinstance(e, x.Name)]
    if wrong or not names:
        at = (wrong or [wire.value])[0].at
        raise error_at(at, f"'{wire.value}'", f"an output of {label}, or gain(output, input)")
    faces = [callee.outputs, *[callee.inputs] * (len(names) - 1)]
    for e, face, kind in zip(names, faces, ["output", *["input"] * (len(names) - 1)], strict=True):
        if e.name not in face:
            suggestion = nearest(e.name, list(face))
            raise error_at(e.at, f"unknown {kind} '{e.name}' of {label}", suggestion)
    return names[0], names[1:]


def targets(scope: Scope, step: MappingStep) -> list[tuple[x.Name, Axes]]:
    """Return the names that a step writes, with the iterators active there."""
    if isinstance(step.statement, d.Assignment):
        return [(step.statement.target, step.axes)]
    return [(w.target, add_iterators(scope, step.axes, w.each)) for w in step.statement.outputs]


def sources(scope: Scope, step: MappingStep) -> list[tuple[x.Expression, Axes]]:
    """Return the expressions that a step reads, with the iterators active there."""
    if isinstance(step.statement, d.Assignment):
        return [(step.statement.value, step.axes)]
    return [(w.value, add_iterators(scope, step.axes, w.each)) for w in step.statement.inputs]


def target_elements(scope: Scope, node: x.Name, axes: Axes) -> Read:
    """Find the elements that a target writes; it must be an output or a local variable."""
    found = scope.arrays.get(node.name)
    if found is None or found.role not in ("output", "real"):
        free = [a.name for a in scope.arrays.values() if a.role in ("output", "real")]
        suggestion = nearest(node.name, free)
        if found is None:
            raise error_at(
                node.at, f"unknown name '{node.name}'", f"{suggestion}, or real {node.name};"
            )
        raise error_at(node.at, f"{found.role} '{node.name}' set by a statement", suggestion)
    return Read(found, node, axes, find_positions(scope, node, found, axes))


# ---- recurrences: statements that need earlier values of themselves


class TimeAxis(NamedTuple):
    """Time dimension of an array, and the first position that is computed in it."""

    dim: int
    start: int


class LaggedRead(NamedTuple):
    """A read of the recurrence's own arrays: time lag, and positions in the other dimensions."""

    name: str
    lag: np.ndarray
    other_indices: list[np.ndarray]
    whole: int


class RecurrencePlan(NamedTuple):
    """Plan of a recurrence: steps in their order at one time, their time iterators and reads.

    `reads` has the lagged reads by the identity of their nodes, `depth` is the largest lag.
    """

    steps: tuple[MappingStep, ...]
    time_iterators: dict[int, str]
    time_axes: dict[str, TimeAxis]
    length: int
    reads: dict[int, LaggedRead]
    depth: int


def plan_of(
    scope: Scope, steps: tuple[MappingStep, ...], owners: dict[str, np.ndarray]
) -> RecurrencePlan | None:
    """Plan steps that need one another as a recurrence; None if they form an algebraic loop."""
    choices = [list(_time_choices(scope, step)) for step in steps]
    for chosen in islice(product(*choices), MAX_TRIED):
        plan = _try_plan(scope, steps, owners, chosen)
        if plan is not None:
            return plan
    return None


def _time_choices(
    scope: Scope, step: MappingStep
) -> Iterator[tuple[str, dict[str, TimeAxis], int]]:
    """Yield the iterators along which all arrays that a step writes advance by one."""
    for k, (axis, over) in enumerate(step.axes.items()):
        found: dict[str, TimeAxis] = {}
        for node, axes in targets(scope, step):
            array = scope.arrays[node.name]
            indices = find_positions(scope, node, array, axes)
            moving = [i for i, index in enumerate(indices) if index.shape[k] > 1]
            if len(moving) != 1 or indices[moving[0]].size != len(over):
                break
            values = indices[moving[0]].ravel()
            if np.any(np.diff(values) != 1):
                break
            time_axis = TimeAxis(moving[0], int(values[0]))
            if found.setdefault(node.name, time_axis) != time_axis:
                break
        else:
            yield axis, found, len(over)


def _try_plan(scope, steps, owners, chosen) -> RecurrencePlan | None:
    """Make the plan for one choice of time iterators; None if a read lies in the future."""
    if len({n for _, _, n in chosen}) > 1:
        return None
    time_axes: dict[str, TimeAxis] = {}
    for _, found, _ in chosen:
        for name, here in found.items():
            if time_axes.setdefault(name, here) != here:
                return None
    numbers = np.array([step.number for step in steps])
    lagged: dict[int, LaggedRead] = {}
    same_time: dict[int, set[int]] = {step.number: set() for step in steps}
    for step, (axis, _, length) in zip(steps, chosen, strict=True):
        k = list(step.axes).index(axis)
        for read in (r for e, axes in sources(scope, step) for r in reads(scope, e, axes)):
            owner = owners.get(read.array.name)
            if owner is None or not np.isin(owner[read.flat], numbers).any():
                continue
            found = _lagged_read(read, time_axes.get(read.array.name), k, length)
            if found is None:
                return None
            lagged[id(read.node)] = found
            shape = np.broadcast_shapes(*(i.shape for i in read.indices))
            here = np.broadcast_to(found.lag == 0, shape).ravel()
            same_time[step.number] |= set(owner[read.flat[here]].tolist()) & set(numbers.tolist())
    try:
        order = list(TopologicalSorter(same_time).static_order())
    except CycleError:
        return None
    by_number = {step.number: step for step in steps}
    time = {step.number: axis for step, (axis, _, _) in zip(steps, chosen, strict=True)}
    depth = max((int(np.max(r.lag)) for r in lagged.values()), default=0)
    ordered = tuple(by_number[n] for n in order)
    return RecurrencePlan(ordered, time, time_axes, chosen[0][2], lagged, depth)


def _lagged_read(read: Read, time_axis: TimeAxis | None, k: int, length: int) -> LaggedRead | None:
    """Find the lag of a read along the time axis k; None if it is not constant or negative."""
    if time_axis is None:
        return None
    rank = read.indices[0].ndim
    times = time_axis.start + np.arange(length).reshape([-1 if i == k else 1 for i in range(rank)])
    lag = times - read.indices[time_axis.dim]
    other_indices = [index for i, index in enumerate(read.indices) if i != time_axis.dim]
    first = np.take(lag, [0], axis=k)
    constant = np.all(lag == first) and all(index.shape[k] == 1 for index in other_indices)
    if not constant or np.any(first < 0):
        return None
    whole = sum(isinstance(i, x.Whole) for i in read.node.indices)
    return LaggedRead(read.array.name, first, other_indices, whole)


# ---- the order


class StepGroup(NamedTuple):
    """Steps that are computed together; a plan if they are a recurrence."""

    steps: tuple[MappingStep, ...]
    plan: RecurrencePlan | None


@dataclass(frozen=True, eq=False)
class Order:
    """Steps of a mapping in an order of computation.

    `owners` has the number of the step that defines each element of an array. For each step,
    `needs` has the steps it depends on, and `given` the inputs, parameters and tables it reads.
    `inner` has the orders of the inner mappings.
    """

    scope: Scope
    groups: tuple[StepGroup, ...]
    owners: dict[str, np.ndarray]
    needs: dict[int, set[int]]
    given: dict[int, set[str]] = field(default_factory=dict)
    inner: dict[str, Order] = field(default_factory=dict)

    @cached_property
    def setters(self) -> dict[str, list[int]]:
        """Steps that set elements of each array."""
        found = {name: owner[owner != NO_OWNER] for name, owner in self.owners.items()}
        return {name: np.flatnonzero(np.bincount(owner)).tolist() for name, owner in found.items()}

    def closure(self, names: Iterable[str]) -> tuple[set[int], set[str]]:
        """Return all steps and given names on which some names depend."""
        todo = {n for name in names for n in self.setters.get(name, ())}
        found: set[int] = set()
        while todo := todo - found:
            found |= todo
            todo = {before for n in todo for before in self.needs[n]}
        direct = {name for name in names if name not in self.owners}
        return found, direct.union(*(self.given[n] for n in found))

    def needed(self, names: Iterable[str]) -> Iterator[StepGroup]:
        """Yield the groups on which some names depend, in the order of computation."""
        wanted, _ = self.closure(names)
        return (g for g in self.groups if not wanted.isdisjoint(step.number for step in g.steps))


def order_of(scope: Scope) -> Order:
    """Sort the steps of a mapping and of its inner mappings.

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
        With its place: an unknown name, an element that is defined twice or never, an index
        outside its set, an algebraic loop with its cycle.
    """
    inner = {name: order_of(c) for name, c in scope.callees.items() if isinstance(c, Scope)}
    owners: dict[str, np.ndarray] = {}
    _check_work(scope)
    for step in scope.steps:
        if isinstance(step.statement, d.Call):
            _check_wires(scope, step, step.statement)
        for node, axes in targets(scope, step):
            _set_owner(scope, owners, step, target_elements(scope, node, axes))
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
    groups = tuple(_make_group(scope, sorted(c), needs, owners) for c in _dependent_groups(needs))
    return Order(scope, groups, owners, needs, given, inner)


def _check_work(scope: Scope) -> None:
    """Raise an error for a mapping that is too large."""
    total = sum(a.size for a in scope.arrays.values())
    for step in scope.steps:
        combined = int(np.prod([len(s) for s in step.axes.values()], dtype=np.int64))
        if isinstance(step.statement, d.Call):
            callee = scope.callees.get(step.statement.mapping)
            if isinstance(callee, Scope):
                combined *= sum(a.size for a in callee.arrays.values())
        total += combined
        if total > MAX_TOTAL_ELEMENTS or step.number > MAX_STEPS:
            found = (
                f"more than {MAX_TOTAL_ELEMENTS} elements or {MAX_STEPS} statements in a mapping"
            )
            raise error_at(step.at, found, "fewer")


def _make_group(scope, numbers: list[int], needs, owners) -> StepGroup:
    steps = tuple(scope.steps[n] for n in numbers)
    if len(steps) == 1 and numbers[0] not in needs[numbers[0]]:
        return StepGroup(steps, None)
    plan = plan_of(scope, steps, owners)
    if plan is None:
        raise _loop_error(scope, steps, needs, owners)
    return StepGroup(steps, plan)


def _set_owner(scope: Scope, owners: dict[str, np.ndarray], step: MappingStep, write: Read) -> None:
    """Record the elements that a step defines."""
    array, node = write.array, write.node
    owner = owners.setdefault(array.name, np.full(max(array.size, 1), NO_OWNER))
    shape = [len(s) for s in write.axes.values()]
    combined = int(np.prod(shape, dtype=np.int64))
    whole = np.prod([len(dim) for dim in whole_dimensions(node, array)], dtype=np.int64)
    mark = np.zeros(owner.size, bool)
    mark[write.flat] = True
    flat = np.flatnonzero(mark)
    if flat.size < combined * whole:
        unused = [n for n in write.axes if n not in _names(node)]
        reason = f"'{node}' has no index {', '.join(unused)}" if unused else "its index repeats"
        found = f"'{node}' set more than once by one statement ({reason})"
        raise error_at(node.at, found, "each element once")
    taken = flat[owner[flat] != NO_OWNER]
    if taken.size:
        other = scope.steps[owner[taken[0]]]
        found = f"'{array.element(taken[0])}' set twice (also in line {other.at.line})"
        raise error_at(node.at, found, "each element once")
    owner[flat] = step.number


def _names(e: x.Expression) -> set[str]:
    inner = set().union(*map(_names, x.children(e)))
    return inner | {e.name} if isinstance(e, x.Name) else inner


def _owners_of(owners: dict[str, np.ndarray], read: Read) -> np.ndarray:
    """Find the steps that define the elements of a read."""
    owner = owners.get(read.array.name)
    if owner is None:
        found = f"'{read.array.name}' is used, and no statement sets it"
        raise error_at(read.node.at, found, f"a statement {read.array.name} = ...")
    if owner[0] != NO_OWNER and np.all(owner == owner[0]):
        return owner[:1]
    flat = read.flat
    missing = flat[owner[flat] == NO_OWNER]
    if missing.size:
        text = f"'{read.array.element(missing[0])}', used in '{read.node}', which no statement sets"
        raise error_at(read.node.at, text, "a statement that sets this element")
    return np.flatnonzero(np.bincount(owner[flat]))


def _check_defined(array: Array, owners: dict[str, np.ndarray]) -> None:
    owner = owners.get(array.name)
    if owner is None or np.any(owner == NO_OWNER):
        at = 0 if owner is None else int(np.argmax(owner == NO_OWNER))
        name = array.name if owner is None else array.element(at)
        raise error_at(array.at, f"output '{name}' that no statement sets", f"{name} = ...;")


def _check_wires(scope: Scope, step: MappingStep, call: d.Call) -> None:
    """Check the indices of the called mapping's arrays, and that all its inputs are given."""
    callee = callee_of(scope, call)
    given: dict[str, np.ndarray] = {}
    for wire in call.inputs:
        array = callee.inputs[wire.target.name]
        axes = add_iterators(scope, {}, wire.each)
        found = Read(array, wire.target, axes, find_positions(scope, wire.target, array, axes))
        given.setdefault(array.name, np.zeros(max(array.size, 1), bool))[found.flat] = True
    for name, hit in given.items():
        array = callee.inputs[name]
        if not hit.all() and array.values is None:
            missing = array.element(int(np.argmin(hit)))
            found = f"'{missing}' of {call.mapping} is not given"
            raise error_at(call.at, found, f"all of {array.text}")
    for wire in call.outputs:
        axes = add_iterators(scope, step.axes, wire.each)
        output, inputs = gains_of(wire, callee, call.mapping)
        find_positions(scope, output, callee.outputs[output.name], axes)
        for e in inputs:
            array = callee.inputs[e.name]
            if len(e.indices) != len(array.dims):
                found = f"'{e}' in '{wire.value}'"
                raise error_at(
                    e.at, found, f"one number of {array.text} such as {array.element(0)}"
                )
            find_positions(scope, e, array, axes)


def _dependent_groups(needs: dict[int, set[int]]) -> list[list[int]]:
    """Group steps that depend on one another; the groups are in the order of computation."""
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


def _loop_error(scope: Scope, steps: tuple[MappingStep, ...], needs, owners) -> InputError:
    """Make the error for an algebraic loop, with the names along a cycle that is no recurrence."""
    members = {s.number for s in steps}
    cycles = (_cycle(n, needs, members) for n in sorted(members)[:MAX_TRIED])
    found = sorted((c for c in cycles if c), key=len)
    parts = ((c, tuple(scope.steps[n] for n in sorted(set(c)))) for c in found)
    cycle = next((c for c, part in parts if plan_of(scope, part, owners) is None), found[0])
    names = [str(targets(scope, scope.steps[n])[0][0]) for n in cycle]
    lines = [str(n) for n in sorted({scope.steps[n].at.line for n in cycle})]
    text = f"an algebraic loop: {' -> '.join(_shorten(names))} (line {', '.join(_shorten(lines))})"
    expected = "statements of which each needs earlier ones only, or earlier times such as y[t-1]"
    return error_at(scope.steps[min(cycle)].at, text, expected)


def _shorten(words: list[str]) -> list[str]:
    return words if len(words) <= MAX_NAMED else [*words[: MAX_NAMED - 2], "...", words[-1]]


def _cycle(start: int, needs: dict[int, set[int]], members: set[int]) -> list[int]:
    """Find the shortest cycle from a step to itself, in the order of need; empty if none."""
    previous: dict[int, int | None] = {start: None}
    todo = [start]
    for at in todo:
        for before in sorted(needs[at] & members):
            if before == start:
                cycle: list[int] = [start]
                back: int | None = at
                while back is not None:
                    cycle.append(back)
                    back = previous[back]
                return cycle
            if before not in previous:
                previous[before] = at
                todo.append(before)
    return []


class _ById(NamedTuple):
    """A mapping compared by identity: an equal one may have other line numbers."""

    mapping: d.Mapping

    def __hash__(self) -> int:
        return id(self.mapping)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _ById) and self.mapping is other.mapping


def check_mapping(mapping: d.Mapping, shapes=None) -> Order:
    """Check a mapping and return its order, without computing anything.

    Results of the last mappings are cached, so that compiled code is reused when a document is
    solved again.
    """
    return _cached_order(_ById(mapping), tuple(sorted((shapes or {}).items())))


@lru_cache(maxsize=64)
def _cached_order(same: _ById, shapes: tuple[tuple[str, tuple[int, ...]], ...]) -> Order:
    return order_of(scope_of(same.mapping, dict(shapes)))


def check_document(
    document: d.Document,
    shapes: Mapping[str, tuple[int, int]] | None = None,
    given: Iterable[str] = (),
) -> None:
    """Check the names, indices and order of a document, its variables and their bounds.

    Parameters
    ----------
    document : Document
        From a file.
    shapes : mapping of str to (int, int), optional
        Rows and columns of its tables, if these have been read.
    given : iterable of str, optional
        Inputs whose values do not come from the document.

    Raises
    ------
    InputError
        With the place in the document.
    """
    check_mapping(document.mapping, shapes)
    if document.problem is not None:
        check_problem(document, given)
