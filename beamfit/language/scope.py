"""Scope of a mapping: its sets, arrays, functions, inner mappings and steps.

Elements of sets are whole numbers. Every index is therefore checked, and the elements that each
statement reads and writes are determined, before anything is computed and without JAX.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from beamfit.errors import InputError, nearest
from beamfit.language import document as d
from beamfit.language import expression as x
from beamfit.language.expression import FUNCTIONS, REDUCTIONS, Place, error_at

# Limits on the size of documents, chosen so that none takes all memory or minutes of time.
# Largest number of elements of a set.
MAX_ELEMENTS = 2_000_000
# Largest number of combinations of indices in a statement.
MAX_COMBINATIONS = 5_000_000
# Largest number of operations in one use of a function, nested functions included.
MAX_OPERATIONS = 20_000
# Suffix that hides the names of a caller's iterators from a function's body.
HIDDEN_SUFFIX = "'"
CONSTANTS = {"pi": float(np.pi)}


@dataclass(frozen=True, eq=False)
class IndexSet:
    """Ordered set of whole numbers, with a lookup of positions."""

    name: str
    elements: np.ndarray

    def __len__(self) -> int:
        return len(self.elements)

    @cached_property
    def _sorted(self) -> np.ndarray:
        return np.argsort(self.elements, kind="stable")

    def positions(self, values: np.ndarray) -> np.ndarray:
        """Return the positions of values in the set; -1 for values that are not elements."""
        order = self._sorted
        at = np.minimum(np.searchsorted(self.elements, values, sorter=order), len(self) - 1)
        found = order[at]
        return np.where(self.elements[found] == values, found, -1)

    def __str__(self) -> str:
        ends = f"{self.elements[0]} to {self.elements[-1]}"
        return f"{self.name} ({ends})" if self.name else ends


Axes = Mapping[str, IndexSet]
"""Sets of the active iterators by name, outermost first."""


class Array(NamedTuple):
    """A number or an array of a mapping, with its role (input, output, ...) and dimensions."""

    name: str
    role: str
    dims: tuple[IndexSet, ...] = ()
    at: Place = x.NOWHERE
    values: tuple[float, ...] | None = None

    @property
    def shape(self) -> tuple[int, ...]:
        """Length of each dimension."""
        return tuple(map(len, self.dims))

    @property
    def size(self) -> int:
        """Number of elements."""
        return int(np.prod(self.shape, dtype=np.int64))

    @property
    def text(self) -> str:
        """Name with dimensions, for messages."""
        inner = ", ".join(dim.name or str(len(dim)) for dim in self.dims)
        return f"{self.name}[{inner}]" if self.dims else self.name

    def element(self, position: int) -> str:
        """Return the name with the index of an element, in C order."""
        if not self.dims:
            return self.name
        at = np.unravel_index(position, self.shape)
        inner = ", ".join(str(dim.elements[i]) for dim, i in zip(self.dims, at, strict=True))
        return f"{self.name}[{inner}]"


class MappingStep(NamedTuple):
    """An assignment or a call with its iterators; `number` is its index in the mapping."""

    number: int
    axes: dict[str, IndexSet]
    statement: d.Assignment | d.Call

    @property
    def at(self) -> Place:
        """Place in the document."""
        return self.statement.at


class Read(NamedTuple):
    """A place where an array is read or written: node, iterators, positions in each dimension."""

    array: Array
    node: x.Name
    axes: Axes
    indices: list[np.ndarray]

    @property
    def flat(self) -> np.ndarray:
        """Positions of the elements in C order, one for each combination of indices."""
        if not self.array.dims:
            return np.zeros(1, int)
        return np.ravel_multi_index(np.broadcast_arrays(*self.indices), self.array.shape).ravel()


@dataclass(frozen=True, eq=False)
class Scope:
    """Names of one mapping.

    `callees` has the scopes of inner mappings, and networks, by name.
    """

    name: str
    sets: dict[str, IndexSet] = field(default_factory=dict)
    arrays: dict[str, Array] = field(default_factory=dict)
    functions: dict[str, d.Function] = field(default_factory=dict)
    callees: dict[str, Any] = field(default_factory=dict)
    steps: list[MappingStep] = field(default_factory=list)

    @property
    def inputs(self) -> dict[str, Array]:
        """Arrays that are inputs."""
        return {k: a for k, a in self.arrays.items() if a.role == "input"}

    @property
    def outputs(self) -> dict[str, Array]:
        """Arrays that are outputs."""
        return {k: a for k, a in self.arrays.items() if a.role == "output"}

    def constant(self, name: str) -> float | None:
        """Return the value of a scalar parameter or built-in constant, else None."""
        found = self.arrays.get(name)
        if found is not None and found.role == "parameter" and not found.dims:
            return found.values[0]
        return CONSTANTS.get(name) if found is None else None


class CalledNetwork(NamedTuple):
    """A network in a call: the network with its inputs and outputs as arrays."""

    mlp: Any
    inputs: dict[str, Array]
    outputs: dict[str, Array]


# ---- sets and iterators


def check_size(lengths: list[int], at: Place, most: int = MAX_COMBINATIONS) -> None:
    """Raise an error if a length is zero or their product too large."""
    total = 1
    for length in lengths:
        total *= length
    if total > most or min(lengths, default=1) < 1:
        found = f"{total} elements" if total < 10**12 else "more than 1e12 elements"
        raise error_at(at, found, f"1 to {most}")


def set_of(scope: Scope, over: x.Elements, name: str = "") -> IndexSet:
    """Compute the elements of a set from its numbers and parameters."""
    ends = [int(index_values(scope, part, {})) for part in over.parts]
    if not over.ranged:
        found = np.array(ends)
        if len(np.unique(found)) < len(found):
            raise error_at(over.at, f"{over}, which has an element twice", "each element once")
        return IndexSet(name, found)
    start, stop, step = (*ends, 1)[:3]
    if step == 0 or (stop - start) * step < 0:
        text = f"set {name} = {over}" if name else f"{over}"
        raise error_at(over.at, f"{text}, an empty set", "a start before the stop")
    check_size([abs((stop - start) // step) + 1], over.at, MAX_ELEMENTS)
    return IndexSet(name, np.arange(start, stop + np.sign(step), step))


def add_iterators(scope: Scope, axes: Axes, each: tuple[x.Iterator, ...]) -> dict[str, IndexSet]:
    """Add iterators to the active ones, as the innermost."""
    found = dict(axes)
    for it in each:
        if it.name in found:
            raise error_at(it.at, f"'{it.name}' runs already", "another name for this iterator")
        if it.name in scope.arrays or it.name in scope.sets:
            kind = "an array or a set" if it.name in scope.sets else "a variable"
            raise error_at(it.at, f"'{it.name}', which is {kind}", "a new name for the iterator")
        if isinstance(it.over, x.Elements):
            found[it.name] = set_of(scope, it.over)
        elif it.over in scope.sets:
            found[it.name] = scope.sets[it.over]
        else:
            suggestion = nearest(it.over, list(scope.sets))
            raise error_at(it.at, f"no set '{it.over}' in '{it}'", suggestion)
    check_size([len(s) for s in found.values()], each[0].at if each else x.NOWHERE)
    return found


# ---- indices


def index_values(scope: Scope, e: x.Expression, axes: Axes) -> np.ndarray:
    """Compute the values of an index, with one axis for each iterator."""
    match e:
        case x.Literal():
            if e.value != int(min(e.value, 2**53)):
                raise error_at(e.at, f"'{e}' as an index", "a whole number")
            return np.int64(e.value)
        case x.Name(name, ()) if name in axes:
            place = list(axes).index(name)
            return axes[name].elements.reshape([-1 if i == place else 1 for i in range(len(axes))])
        case x.Name(name, ()) if (value := scope.constant(name)) is not None:
            return index_values(scope, x.Literal(repr(value), at=e.at), axes)
        case x.Arithmetic(symbol, parts) if symbol in "+-*":
            found = [index_values(scope, part, axes) for part in parts]
            if max(float(np.max(np.abs(f))) for f in found) > 2**31:
                raise error_at(e.at, f"'{e}' as an index", "numbers below 2e9")
            if len(found) == 1:
                return -found[0]
            return {"+": np.add, "-": np.subtract, "*": np.multiply}[symbol](*found)
    known = [*axes, *(n for n in scope.arrays if scope.constant(n) is not None)]
    if isinstance(e, x.Name) and not e.indices and e.name not in scope.arrays:
        raise error_at(
            e.at, f"index '{e}', which is no iterator here", _iterator_hint(e.name, known)
        )
    raise error_at(e.at, f"'{e}' as an index", "iterators and whole numbers with + - *")


def _iterator_hint(name: str, known: list[str]) -> str:
    usage = f"'foreach {name} in SET' behind the statement, or sum({name} in SET | ...)"
    return f"{usage}, or {nearest(name, known)}" if known else usage


def find_positions(scope: Scope, node: x.Name, array: Array, axes: Axes) -> list[np.ndarray]:
    """Find positions in each dimension of an array, with axes of iterators and whole dimensions."""
    given = node.indices or (x.Whole(),) * len(array.dims)
    if len(given) != len(array.dims):
        count = len(given)
        found = f"{count} {'index' if count == 1 else 'indices'} in '{node}'"
        wanted = f"{len(array.dims)}: {array.text}" if array.dims else "none: it is a number"
        raise error_at(node.at, found, wanted)
    whole = len(whole_dimensions(node, array))
    rank, indices = len(axes) + whole, []
    whole_axis = len(axes)
    for i, dim in zip(given, array.dims, strict=True):
        if isinstance(i, x.Whole):
            values = np.arange(len(dim)).reshape(
                [-1 if k == whole_axis else 1 for k in range(rank)]
            )
            indices.append(values)
            whole_axis += 1
            continue
        values = index_values(scope, i, axes)
        at = dim.positions(values)
        if np.any(at < 0):
            raise _outside_error(node, i, dim, axes, np.broadcast_to(values, at.shape), at)
        shape = np.shape(at) or [1] * len(axes)
        indices.append(np.reshape(at, [*shape, *[1] * whole]))
    return indices


def whole_dimensions(node: x.Name, array: Array) -> list[IndexSet]:
    """Return the dimensions of an array that a name takes whole."""
    if not node.indices:
        return list(array.dims)
    pairs = zip(node.indices, array.dims, strict=True)
    return [dim for i, dim in pairs if isinstance(i, x.Whole)]


def _outside_error(node, index, dim, axes, values, at) -> InputError:
    """Make the error for an index outside its set, with the values of the iterators."""
    first = np.argwhere(np.atleast_1d(at) < 0)[0]
    value = np.atleast_1d(values)[tuple(first)]
    text = f"index {index} = {value}" if str(index) != str(value) else f"index {value}"
    found = f"{text} in '{node}'{iterator_text(axes, first, np.shape(at), ' at ')}"
    return error_at(index.at, found, f"an element of {dim}")


def iterator_text(axes: Axes, at: Sequence[int], lengths: Sequence[int], word: str) -> str:
    """Write the values of iterators after a word; empty if none has several elements."""
    found = [
        f"{name.rstrip(HIDDEN_SUFFIX)} = {s.elements[i]}"
        for (name, s), i, n in zip(axes.items(), at, lengths, strict=False)
        if n > 1
    ]
    return f"{word}{', '.join(found)}" if found else ""


# ---- arrays that an expression reads, with all names checked


def reads(scope: Scope, e: x.Expression, axes: Axes) -> Iterator[Read]:
    """Check all names in an expression and yield every place where an array is read."""
    match e:
        case x.Name(name):
            found = scope.arrays.get(name)
            if found is not None:
                yield Read(found, e, axes, find_positions(scope, e, found, axes))
            elif not (name in axes or name in CONSTANTS) or e.indices:
                raise _unknown_error(scope, e, axes)
        case x.Reduction():
            yield from reads(scope, e.body, add_iterators(scope, axes, e.iterators))
        case x.Application() | x.Arithmetic():
            if isinstance(e, x.Application):
                _check_arguments(scope, e)
            yield from (r for part in x.children(e) for r in reads(scope, part, axes))
        case x.Whole():
            raise error_at(e.at, "':'", "an expression")


def _unknown_error(scope: Scope, e: x.Name, axes: Axes) -> InputError:
    """Make the error for a name that is unknown or of the wrong kind."""
    if e.name in axes:
        return error_at(e.at, f"'{e}', an index of the iterator {e.name}", "an array")
    if e.name in scope.sets:
        return error_at(e.at, f"the set '{e.name}' in a formula", "a number or an array")
    if e.name in FUNCTIONS or e.name in scope.functions:
        return error_at(e.at, f"the function '{e.name}' without arguments", f"{e.name}(...)")
    known = [*scope.arrays, *axes, *CONSTANTS]
    if e.name == "e":
        return error_at(e.at, "unknown name 'e'", "exp(...) for powers of e")
    return error_at(e.at, f"unknown name '{e.name}'", nearest(e.name, known))


def _check_arguments(scope: Scope, e: x.Application) -> None:
    """Raise an error for an unknown function or a wrong number of arguments."""
    if e.function in scope.functions:
        min_count = max_count = len(scope.functions[e.function].arguments)
    elif e.function in FUNCTIONS:
        min_count, max_count = FUNCTIONS[e.function]
    else:
        meant = {"ln": "log", "lg": "log10"}.get(e.function, e.function)
        suggestion = nearest(meant, [*scope.functions, *FUNCTIONS, *REDUCTIONS])
        if e.function in scope.arrays:
            suggestion = f"{e.function}[...] for an element, or an operator before the parenthesis"
        raise error_at(e.at, f"unknown function '{e.function}'", suggestion)
    if not min_count <= len(e.arguments) <= max_count:
        wanted = f"{min_count}" if min_count == max_count else f"at least {min_count}"
        raise error_at(e.at, f"{len(e.arguments)} arguments in '{e}'", wanted)


# ---- declarations of a mapping


def scope_of(m: d.Mapping, shapes: Mapping[str, tuple[int, int]] | None = None) -> Scope:
    """Build the scope of a mapping and check its names.

    Parameters
    ----------
    m : Mapping
        From a document.
    shapes : mapping of str to (int, int), optional
        Rows and columns of its tables, if these have been read.

    Returns
    -------
    Scope

    Raises
    ------
    InputError
        With the place in the document: a name that is declared twice, unknown or of the wrong
        kind, an empty set, an index outside its set.
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
        _check_new(scope, inner.name, inner.at)
        if isinstance(inner, d.NetworkDefinition):
            scope.callees[inner.name] = _network(inner)
        else:
            scope.callees[inner.name] = scope_of(inner)
    _declare_statements(scope, m.statements, {})
    for function in scope.functions.values():
        _check_function(scope, function)
    return scope


def _network(network: d.NetworkDefinition) -> CalledNetwork:
    """Build a network and the arrays of its inputs, weights and outputs."""
    from beamfit.greybox import tree  # JAX from here on
    from beamfit.language.network_xml import network_of, weight_leaves

    mlp = network_of(network)
    values = tuple(tree.read(mlp, weight_leaves(mlp)).tolist())
    has_values = any(part.values is not None for part in network.parts)
    count = IndexSet("", np.arange(len(values)))
    ports = {name: Array(name, "input", (), network.at) for name in mlp.inputs}
    ports["weights"] = Array(
        "weights", "input", (count,), network.at, values if has_values else None
    )
    return CalledNetwork(mlp, ports, {n: Array(n, "output", (), network.at) for n in mlp.outputs})


def _check_new(scope: Scope, name: str, at: Place) -> None:
    """Raise an error for a name that is already declared."""
    for kind in (scope.sets, scope.arrays, scope.functions, scope.callees):
        if name in kind:
            raise error_at(at, f"'{name}' declared twice", "each name once in a mapping")


def _declare_numbers(scope: Scope, m: d.Mapping) -> None:
    """Declare scalar parameters, which ranges of sets may use."""
    for one in m.parameters:
        if not one.dimensions:
            if one.values is None or len(one.values) != 1:
                raise error_at(one.at, f"parameter '{one.name}' without a value", "a number")
            _declare(scope, one, "parameter")


def _declare(scope: Scope, one: d.Declared | d.Real, role: str) -> None:
    """Declare an array with its dimensions and values."""
    _check_new(scope, one.name, one.at)
    dims = tuple(_dimension(scope, dim, one) for dim in one.dimensions)
    values = one.values if isinstance(one, d.Declared) else None
    array = Array(one.name, role, dims, one.at, values)
    check_size([*array.shape], one.at)
    if role == "parameter" and values is None:
        raise error_at(one.at, f"parameter '{one.name}' without values", f"{array.size} numbers")
    if values is not None and len(values) != array.size:
        found = f"{len(values)} values for {array.text}"
        raise error_at(one.at, found, f"{array.size}")
    scope.arrays[one.name] = array


def _dimension(scope: Scope, dim: str | int, one: d.Declared | d.Real) -> IndexSet:
    if isinstance(dim, int):
        check_size([dim], one.at, MAX_ELEMENTS)
        return IndexSet("", np.arange(dim))
    if dim not in scope.sets:
        raise error_at(one.at, f"no set '{dim}' for '{one.name}'", nearest(dim, list(scope.sets)))
    return scope.sets[dim]


def _declare_sets(scope: Scope, m: d.Mapping) -> None:
    for statement in _flatten(m.statements):
        if isinstance(statement, d.IndexedSet):
            _check_new(scope, statement.name, statement.at)
            scope.sets[statement.name] = set_of(scope, statement.elements, statement.name)


def _flatten(statements: tuple[d.Statement, ...]) -> Iterator[d.Statement]:
    for statement in statements:
        if isinstance(statement, d.Block):
            yield from _flatten(statement.statements)
        else:
            yield statement


def _declare_tables(scope: Scope, m: d.Mapping, shapes: Mapping[str, tuple[int, int]]) -> None:
    """Declare tables; rows and columns are counted from 1."""
    for table in m.tables:
        _check_new(scope, table.name, table.at)
        shape = shapes.get(table.name, (table.rows, table.columns))
        if None in shape:
            found = f"table '{table.name}' of unknown size"
            raise error_at(table.at, found, "its file, or its rows and columns")
        check_size([*shape], table.at)
        dims = tuple(
            IndexSet(f"{kind} of {table.name}", np.arange(1, n + 1))
            for kind, n in zip(("rows", "columns"), shape, strict=True)
        )
        scope.arrays[table.name] = Array(table.name, "table", dims, table.at)


def _declare_statements(
    scope: Scope, statements: tuple[d.Statement, ...], axes: dict[str, IndexSet]
) -> None:
    """Declare local variables and functions, then number the steps; blocks are expanded."""
    for s in _flatten(statements) if not axes else ():
        if isinstance(s, d.Real):
            _declare(scope, s, "real")
        elif isinstance(s, d.Function):
            _check_new(scope, s.name, s.at)
            if s.name in FUNCTIONS or s.name in REDUCTIONS:
                raise error_at(s.at, f"a function '{s.name}'", "a name that is not built in")
            scope.functions[s.name] = s
    for s in statements:
        if isinstance(s, d.Block):
            _declare_statements(scope, s.statements, add_iterators(scope, axes, s.each))
        elif isinstance(s, d.Real) and s.value is not None:
            assignment = d.Assignment(x.Name(s.name, at=s.at), s.value, at=s.at)
            scope.steps.append(MappingStep(len(scope.steps), {}, assignment))
        elif isinstance(s, d.Assignment | d.Call):
            inner = add_iterators(scope, axes, s.each)
            scope.steps.append(MappingStep(len(scope.steps), inner, s))


# ---- functions


def _check_function(scope: Scope, f: d.Function) -> None:
    """Check the names in a function's body, and that it does not call itself."""
    twice = [a for a in f.arguments if f.arguments.count(a) > 1]
    if twice:
        raise error_at(f.at, f"argument '{twice[0]}' twice", "each once")
    _count_operations(scope, f, ())
    constants = {n: a for n, a in scope.arrays.items() if scope.constant(n) is not None}
    arguments = {name: Array(name, "argument", (), f.at) for name in f.arguments}
    inside = Scope(f.name, scope.sets, constants | arguments, scope.functions)
    for _ in reads(inside, f.body, {}):
        pass


def _count_operations(
    scope: Scope, f: d.Function, stack: tuple[str, ...], counted: dict | None = None
) -> int:
    """Count the operations in one use of a function, nested functions included."""
    counted = {} if counted is None else counted
    if f.name in stack:
        loop = " -> ".join([*stack[stack.index(f.name) :], f.name])
        raise error_at(f.at, f"a function that needs itself: {loop}", "functions that end")
    if f.name not in counted:
        total, todo = 0, [f.body]
        while todo:
            e = todo.pop()
            todo += x.children(e)
            total += 1
            if isinstance(e, x.Application) and e.function in scope.functions:
                total += _count_operations(
                    scope, scope.functions[e.function], (*stack, f.name), counted
                )
        if total > MAX_OPERATIONS:
            raise error_at(f.at, f"a function '{f.name}' of more than {MAX_OPERATIONS} operations",
                           "smaller functions")  # fmt: skip
        counted[f.name] = total
    return counted[f.name]


# ---- the problem


def check_problem(document: d.Document, given: Iterable[str] = ()) -> None:
    """Raise an error for unknown names, contradictory bounds and inputs without a value."""
    p, m = document.problem, document.mapping
    groups = (p.variables, m.inputs, "input"), ((*p.goals, *p.limits), m.outputs, "output")
    for group, declared, kind in groups:
        known = [one.name for one in declared]
        for one in group:
            if one.model not in known:
                found = f"no {kind} '{one.model}' in the mapping"
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
    """Raise an error for contradictory bounds, repeated variables and wrong random ranges."""
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


def values_of(scope: Scope, given: Mapping[str, Sequence[float]]) -> dict[str, np.ndarray]:
    """Make arrays of inputs from one number each, or one for each element in C order.

    Raises
    ------
    InputError
        If a name is not an input of the mapping, or the count is wrong.
    """
    found = {}
    for name, numbers in given.items():
        if name not in scope.inputs:
            expected = f"an input of the document: {nearest(name, list(scope.inputs))}"
            raise InputError(f"--set {name}=...", expected)
        a = scope.inputs[name]
        if len(numbers) not in (1, a.size):
            expected = f"one, or {a.size} for {a.text}"
            raise InputError(f"{len(numbers)} numbers in --set {name}=...", expected)
        found[name] = np.broadcast_to(np.asarray(numbers, float), (a.size,)).reshape(a.shape)
    return found
