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
    MappingStep,
    Net,
    Read,
    Scope,
    check_problem,
    located,
    reads,
    scope_of,
    whole_of,
    widened,
)

# Owner of an element that no statement defines.
NOBODY = -1
# Largest number of names in the message about a loop.
MOST_NAMED = 8
# Largest number of elements of all statements of a mapping: about a minute of checks.
MOST_WORK = 60_000_000
# Largest number of statements of a mapping.
MOST_STEPS = 5_000
# Largest number of combinations of time indices that are tried for the statements of a recurrence,
# and of statements from which the cycle of a loop is sought.
MOST_TRIED = 64


# ---- arrays that steps write and read, mappings that they call


def callee_of(scope: Scope, call: d.Call) -> Scope | Net:
    """Find the mapping or network of a call, and check the names of its inputs and outputs."""
    callee = scope.callees.get(call.mapping)
    if callee is None:
        known = nearest(call.mapping, list(scope.callees))
        raise error_at(call.at, f"unknown mapping '{call.mapping}'", known)
    for wire in call.inputs:
        if wire.target.name not in callee.inputs:
            known = nearest(wire.target.name, list(callee.inputs))
            found = f"unknown input '{wire.target.name}' of {call.mapping}"
            raise error_at(wire.target.at, found, known)
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
    wire: d.Assignment, callee: Scope | Net, label: str
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
    for e, face, what in zip(names, faces, ["output", *["input"] * (len(names) - 1)], strict=True):
        if e.name not in face:
            known = nearest(e.name, list(face))
            raise error_at(e.at, f"unknown {what} '{e.name}' of {label}", known)
    return names[0], names[1:]


def targets(scope: Scope, step: MappingStep) -> list[tuple[x.Name, Axes]]:
    """Return the names that a step writes, with the iterators active there."""
    if isinstance(step.what, d.Assignment):
        return [(step.what.target, step.axes)]
    return [(w.target, widened(scope, step.axes, w.each)) for w in step.what.outputs]


def sources(scope: Scope, step: MappingStep) -> list[tuple[x.Expression, Axes]]:
    """Return the expressions that a step reads, with the iterators active there."""
    if isinstance(step.what, d.Assignment):
        return [(step.what.value, step.axes)]
    return [(w.value, widened(scope, step.axes, w.each)) for w in step.what.inputs]


def written(scope: Scope, node: x.Name, axes: Axes) -> Read:
    """Find the elements that a target writes; it must be an output or a local variable."""
    found = scope.arrays.get(node.name)
    if found is None or found.role not in ("output", "real"):
        free = [a.name for a in scope.arrays.values() if a.role in ("output", "real")]
        known = nearest(node.name, free)
        if found is None:
            raise error_at(node.at, f"unknown name '{node.name}'", f"{known}, or real {node.name};")
        raise error_at(node.at, f"{found.role} '{node.name}' set by a statement", known)
    return Read(found, node, axes, located(scope, node, found, axes))


# ---- recurrences: statements that need earlier values of themselves


class Written(NamedTuple):
    """Time dimension of an array, and the first position that is computed in it."""

    dim: int
    start: int


class Lagged(NamedTuple):
    """A read of an array of the recurrence itself: time lag, and positions in the other dimensions."""

    name: str
    lag: np.ndarray
    rest: list[np.ndarray]
    whole: int


class RecurrencePlan(NamedTuple):
    """Plan of a recurrence: steps in their order at one time, their time iterators and reads.

    `reads` has the lagged reads by the identity of their nodes, `depth` is the largest lag.
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
    """Plan steps that need one another as a recurrence; None if they form an algebraic loop."""
    choices = [list(_advances(scope, step)) for step in steps]
    for chosen in islice(product(*choices), MOST_TRIED):
        plan = _planned(scope, steps, owners, chosen)
        if plan is not None:
            return plan
    return None


def _advances(scope: Scope, step: MappingStep) -> Iterator[tuple[str, dict[str, Written], int]]:
    """Yield the iterators along which all arrays that a step writes advance by one."""
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
    """Make the plan for one choice of time iterators; None if a read lies in the future."""
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
    """Find the lag of a read along the time axis k; None if it is not constant or negative."""
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
        found = {name: owner[owner != NOBODY] for name, owner in self.owners.items()}
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
    """Raise an error for a mapping that is too large."""
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
    """Record the elements that a step defines."""
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
    """Find the steps that define the elements of a read."""
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
    """Check the indices of the called mapping's arrays, and that all its inputs are given."""
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


def _loop(scope: Scope, steps: tuple[MappingStep, ...], needs, owners) -> InputError:
    """Make the error for an algebraic loop, with the names along a cycle that is no recurrence."""
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
    """Find the shortest cycle from a step to itself, in the order of need; empty if none."""
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
    """A mapping compared by identity: an equal one may have other line numbers."""

    mapping: d.Mapping

    def __hash__(self) -> int:
        return id(self.mapping)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and self.mapping is other.mapping


def checked(mapping: d.Mapping, shapes=None) -> Order:
    """Check a mapping and return its order, without computing anything.

    Results of the last mappings are cached, so that compiled code is reused when a document is
    solved again.
    """
    return _ordered(_Same(mapping), tuple(sorted((shapes or {}).items())))


@lru_cache(maxsize=64)
def _ordered(same: _Same, shapes: tuple[tuple[str, tuple[int, ...]], ...]) -> Order:
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
    checked(document.mapping, shapes)
    if document.problem is not None:
        check_problem(document, given)
