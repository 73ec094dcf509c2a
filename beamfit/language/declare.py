"""The declarations of a mapping, and of the mappings in it, as a scope."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping

import numpy as np

from beamfit.errors import nearest
from beamfit.language import document as d
from beamfit.language import expression as x
from beamfit.language.expression import REDUCTIONS, Place, error_at
from beamfit.language.scope import (
    FUNCTIONS,
    MOST_ELEMENTS,
    Array,
    IndexSet,
    MappingStep,
    Net,
    Scope,
    check_size,
    reads,
    set_of,
    widened,
)

# Most operations in one use of a function, nested functions included.
MOST_WORK = 20_000


def scope_of(m: d.Mapping, shapes: Mapping[str, tuple[int, int]] | None = None) -> Scope:
    """Give the names of a mapping their meaning.

    Parameters
    ----------
    m : Mapping
        From a document.
    shapes : mapping of str to (int, int), optional
        Rows and columns of its tables, where they have been read.

    Returns
    -------
    Scope

    Raises
    ------
    InputError
        With the place in the document: a name given twice, unknown or used as what it is not, a
        set that is empty, an index outside.
    """
    scope = Scope(m.name)
    _declare_numbers(scope, m)
    _declare_sets(scope, m)
    for group, role in ((m.inputs, "input"), (m.outputs, "output"), (m.parameters, "parameter")):
        for one in group:
            if one.dimensions or role != "parameter":
                _declare(scope, one, role)
    _declare_tables(scope, m, shapes or {})
    for inner in m.mappings:
        _new(scope, inner.name, inner.at)
        if isinstance(inner, d.NetworkDefinition):
            scope.callees[inner.name] = _net(inner)
        else:
            scope.callees[inner.name] = scope_of(inner)
    _declare_statements(scope, m.statements, {})
    for function in scope.functions.values():
        _check_function(scope, function)
    return scope


def _net(network: d.NetworkDefinition) -> Net:
    from beamfit.greybox import tree  # JAX from here on
    from beamfit.language.network_xml import network_of, weight_leaves

    mlp = network_of(network)
    values = tuple(tree.read(mlp, weight_leaves(mlp)).tolist())
    known = any(part.values is not None for part in network.parts)
    count = IndexSet("", np.arange(len(values)))
    ports = {name: Array(name, "input", (), network.at) for name in mlp.inputs}
    ports["weights"] = Array("weights", "input", (count,), network.at, values if known else None)
    return Net(mlp, ports, {n: Array(n, "output", (), network.at) for n in mlp.outputs})


def _new(scope: Scope, name: str, at: Place) -> None:
    """Refuse a name that means something already."""
    for kind in (scope.sets, scope.arrays, scope.functions, scope.callees):
        if name in kind:
            raise error_at(at, f"'{name}' declared twice", "each name once in a mapping")


def _declare_numbers(scope: Scope, m: d.Mapping) -> None:
    """Parameters that are numbers come first: ranges of sets may use them."""
    for one in m.parameters:
        if not one.dimensions:
            if one.values is None or len(one.values) != 1:
                raise error_at(one.at, f"parameter '{one.name}' without a value", "a number")
            _declare(scope, one, "parameter")


def _declare(scope: Scope, one: d.Declared | d.Real, role: str) -> None:
    _new(scope, one.name, one.at)
    dims = tuple(_dimension(scope, dim, one) for dim in one.dimensions)
    values = one.values if isinstance(one, d.Declared) else None
    made = Array(one.name, role, dims, one.at, values)
    check_size([*made.shape], one.at)
    if role == "parameter" and values is None:
        raise error_at(one.at, f"parameter '{one.name}' without values", f"{made.size} numbers")
    if values is not None and len(values) != made.size:
        found = f"{len(values)} values for {made.said}"
        raise error_at(one.at, found, f"{made.size}")
    scope.arrays[one.name] = made


def _dimension(scope: Scope, dim: str | int, one: d.Declared | d.Real) -> IndexSet:
    if isinstance(dim, int):
        check_size([dim], one.at, MOST_ELEMENTS)
        return IndexSet("", np.arange(dim))
    if dim not in scope.sets:
        raise error_at(one.at, f"no set '{dim}' for '{one.name}'", nearest(dim, list(scope.sets)))
    return scope.sets[dim]


def _declare_sets(scope: Scope, m: d.Mapping) -> None:
    for statement in _flat(m.statements):
        if isinstance(statement, d.IndexedSet):
            _new(scope, statement.name, statement.at)
            scope.sets[statement.name] = set_of(scope, statement.elements, statement.name)


def _flat(statements: tuple[d.Statement, ...]) -> Iterator[d.Statement]:
    for statement in statements:
        if isinstance(statement, d.Block):
            yield from _flat(statement.statements)
        else:
            yield statement


def _declare_tables(scope: Scope, m: d.Mapping, shapes: Mapping[str, tuple[int, int]]) -> None:
    for table in m.tables:
        _new(scope, table.name, table.at)
        shape = shapes.get(table.name, (table.rows, table.columns))
        if None in shape:
            found = f"table '{table.name}' of unknown size"
            raise error_at(table.at, found, "its file, or its rows and columns")
        check_size([*shape], table.at)
        dims = tuple(
            IndexSet(f"{what} of {table.name}", np.arange(1, n + 1))
            for what, n in zip(("rows", "columns"), shape, strict=True)
        )
        scope.arrays[table.name] = Array(table.name, "table", dims, table.at)


def _declare_statements(
    scope: Scope, statements: tuple[d.Statement, ...], axes: dict[str, IndexSet]
) -> None:
    """Declare what statements declare, then number the steps, blocks spread out."""
    for s in _flat(statements) if not axes else ():
        if isinstance(s, d.Real):
            _declare(scope, s, "real")
        elif isinstance(s, d.Function):
            _new(scope, s.name, s.at)
            if s.name in FUNCTIONS or s.name in REDUCTIONS:
                raise error_at(s.at, f"a function '{s.name}'", "a name that is not built in")
            scope.functions[s.name] = s
    for s in statements:
        if isinstance(s, d.Block):
            _declare_statements(scope, s.statements, widened(scope, axes, s.each))
        elif isinstance(s, d.Real) and s.value is not None:
            what = d.Assignment(x.Name(s.name, at=s.at), s.value, at=s.at)
            scope.steps.append(MappingStep(len(scope.steps), {}, what))
        elif isinstance(s, d.Assignment | d.Call):
            inner = widened(scope, axes, s.each)
            scope.steps.append(MappingStep(len(scope.steps), inner, s))


# ---- functions


def _check_function(scope: Scope, f: d.Function) -> None:
    """Check the names of a function's body, and that using it ends."""
    twice = [a for a in f.arguments if f.arguments.count(a) > 1]
    if twice:
        raise error_at(f.at, f"argument '{twice[0]}' twice", "each once")
    _work(scope, f, ())
    constants = {n: a for n, a in scope.arrays.items() if scope.constant(n) is not None}
    arguments = {name: Array(name, "argument", (), f.at) for name in f.arguments}
    inside = Scope(f.name, scope.sets, constants | arguments, scope.functions)
    for _ in reads(inside, f.body, {}):
        pass


def _work(scope: Scope, f: d.Function, stack: tuple[str, ...], seen: dict | None = None) -> int:
    seen = {} if seen is None else seen
    if f.name in stack:
        loop = " -> ".join([*stack[stack.index(f.name) :], f.name])
        raise error_at(f.at, f"a function that needs itself: {loop}", "functions that end")
    if f.name not in seen:
        total, todo = 0, [f.body]
        while todo:
            e = todo.pop()
            todo += x.children(e)
            total += 1
            if isinstance(e, x.Application) and e.function in scope.functions:
                total += _work(scope, scope.functions[e.function], (*stack, f.name), seen)
        if total > MOST_WORK:
            raise error_at(f.at, f"a function '{f.name}' of more than {MOST_WORK} operations",
                           "smaller functions")  # fmt: skip
        seen[f.name] = total
    return seen[f.name]


# ---- the problem


def check_problem(document: d.Document, given: Iterable[str] = ()) -> None:
    """Refuse names that the mapping has not, bounds that contradict, and inputs without a value."""
    p, m = document.problem, document.mapping
    faces = (p.variables, m.inputs, "input"), ((*p.goals, *p.limits), m.outputs, "output")
    for group, face, what in faces:
        known = [one.name for one in face]
        for one in group:
            if one.model not in known:
                found = f"no {what} '{one.model}' in the mapping"
                raise error_at(one.at, found, nearest(one.model, known))
    sizes = {one.name: one.dimensions for one in m.outputs}
    for one in p.goals:
        if sizes[one.model]:
            found = f"'{one.model}' of {len(sizes[one.model])} dimension(s) as an objective"
            raise error_at(one.at, found, "an output that is a number, such as a sum(... | ...)")
    _check_variables(p)
    names = [*(v.model for v in p.variables), *given]
    for one in m.inputs:
        if one.values is None and one.name not in names:
            expected = f"variable {one.name};, input {one.name} = VALUE;, or --set {one.name}=VALUE"
            raise error_at(one.at, f"input '{one.name}' without a value", expected)


def _check_variables(p: d.ProblemStatement) -> None:
    for one in (*p.variables, *p.limits):
        if not one.lower <= one.upper:
            found = f"bounds of '{one.label}' from {one.lower:g} up to {one.upper:g}"
            raise error_at(one.at, found, "a lower bound that is not above the upper one")
    names = [v.model for v in p.variables]
    for v in p.variables:
        if names.count(v.model) > 1:
            raise error_at(v.at, f"variable '{v.model}' twice", "each variable once")
        low, high = v.random or (0.0, 0.0)
        if not (low <= high and math.isfinite(high - low)):
            found = f"a random start of '{v.label}' in [{low:g}, {high:g}]"
            raise error_at(v.at, found, "a finite range, the lower end first")
