"""Evaluation of expressions with JAX, for all elements of index sets at once.

A value is an array with one axis for each active iterator, of length 1 if the value does not depend
on it, followed by the dimensions of the value. Operations broadcast; a sum reduces its axes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import reduce
from operator import add, mul, sub, truediv
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.language import expression as x
from beamfit.language.expression import error_at
from beamfit.language.scope import (
    HIDDEN_SUFFIX,
    Array,
    Axes,
    Scope,
    add_iterators,
    check_size,
    find_positions,
    index_values,
    whole_dimensions,
)


class Value(NamedTuple):
    """An array with axes of iterators, then `rank` dimensions of the value."""

    array: jax.Array
    rank: int = 0


@dataclass(frozen=True)
class Context:
    """Context in which an expression is evaluated.

    `computed` has values of nodes that are computed already, by identity. `watch` is called with
    each further value.
    """

    scope: Scope
    arrays: Mapping[str, jax.Array]
    axes: Axes
    bound: Mapping[str, Value] = field(default_factory=dict)
    computed: Mapping[int, Value] = field(default_factory=dict)
    watch: Callable[[x.Expression, Value, Axes], None] | None = None


# Built-in functions that `jax.numpy` does not have under their names.
SPECIAL_FUNCTIONS = {"erf": jax.scipy.special.erf, "sigmoid": jax.nn.sigmoid}
MATRIX: dict[str, tuple[int, int, Callable]] = {
    # ranks of the argument and of the result, and the function
    "transpose": (2, 2, lambda m: jnp.swapaxes(m, -1, -2)),
    "inverse": (2, 2, jnp.linalg.inv),
    "det": (2, 0, jnp.linalg.det),
    "trace": (2, 0, lambda m: jnp.trace(m, axis1=-2, axis2=-1)),
    "norm": (1, 0, lambda v: jnp.sqrt(jnp.sum(v * v, axis=-1))),
}
OPERATORS = {"+": add, "-": sub, "*": mul, "/": truediv, "^": pow}


def evaluate(e: x.Expression, s: Context) -> Value:
    """Compute an expression for all combinations of the active iterators."""
    found = s.computed.get(id(e))
    if found is not None:
        return add_axes(found, len(s.axes))
    match e:
        case x.Literal():
            found = Value(jnp.full((1,) * len(s.axes), e.value))
        case x.Name():
            found = _read_name(e, s)
        case x.Arithmetic(_, (one,)):
            inner = evaluate(one, s)
            found = Value(-inner.array, inner.rank)
        case x.Arithmetic("^", (base, x.Literal() as power)):
            found = _power(evaluate(base, s), power.value)
        case x.Arithmetic(symbol, parts):
            found = _operate(e, symbol, [evaluate(part, s) for part in parts])
        case x.Application():
            found = _apply(e, s)
        case x.Reduction():
            found = _reduce(e, s)
    if s.watch is not None:
        s.watch(e, found, s.axes)
    return found


def add_axes(v: Value, axes: int) -> Value:
    """Add axes of length 1 for inner iterators to a value."""
    outer = v.array.ndim - v.rank
    shape = v.array.shape
    return Value(v.array.reshape(*shape[:outer], *[1] * (axes - outer), *shape[outer:]), v.rank)


def _power(v: Value, power: float) -> Value:
    # An integer power has derivatives everywhere and needs no logarithm.
    whole = power == int(power) and abs(power) <= 64
    return Value(v.array ** (int(power) if whole else power), v.rank)


def _match_ranks(values: list[Value], e: x.Expression) -> tuple[list[jax.Array], int]:
    """Give values the same rank: numbers are broadcast over the dimensions of the others."""
    rank = max(v.rank for v in values)
    for v in values:
        if v.rank not in (0, rank):
            found = " and ".join(str(v.rank) for v in values)
            raise error_at(e.at, f"'{e}' of {found} dimensions", "as many in each part")
    arrays = [v.array.reshape(*v.array.shape, *[1] * (rank - v.rank)) for v in values]
    shapes = {v.array.shape[v.array.ndim - rank :] for v in values if v.rank == rank}
    if len(shapes) > 1:
        found = " and ".join(" x ".join(map(str, shape)) for shape in sorted(shapes))
        raise error_at(e.at, f"'{e}' of sizes {found}", "parts of one size")
    return arrays, rank


def _operate(e: x.Expression, symbol: str, parts: list[Value]) -> Value:
    if symbol == "@":
        return _multiply(e, *parts)
    (a, b), rank = _match_ranks(parts, e)
    return Value(OPERATORS[symbol](a, b), rank)


def _multiply(e: x.Expression, a: Value, b: Value) -> Value:
    """Multiply matrices and vectors."""
    if not (1 <= a.rank <= 2 and 1 <= b.rank <= 2):
        raise error_at(e.at, f"'{e}' of {a.rank} and {b.rank} dimensions", "vectors or matrices")
    inner = a.array.shape[-1], b.array.shape[-1 if b.rank == 1 else -2]
    if inner[0] != inner[1]:
        raise error_at(e.at, f"'{e}' of inner lengths {inner[0]} and {inner[1]}", "equal ones")
    shapes = a.array.shape[-a.rank : -1], b.array.shape[b.array.ndim - b.rank :][1:]
    check_size([*shapes[0], *shapes[1]], e.at)
    left = a.array if a.rank == 2 else a.array[..., None, :]
    right = b.array if b.rank == 2 else b.array[..., :, None]
    found = left @ right
    found = found if b.rank == 2 else found[..., 0]
    if a.rank == 1:
        found = found[..., 0, :] if b.rank == 2 else found[..., 0]
    return Value(found, a.rank + b.rank - 2)


def _apply(e: x.Application, s: Context) -> Value:
    """Compute a function of its arguments: declared in the mapping, of matrices, or elementwise."""
    values = [evaluate(argument, s) for argument in e.arguments]
    function = s.scope.functions.get(e.function)
    if function is not None:
        # The body knows only its arguments: the caller's iterators keep their axes, under hidden
        # names.
        hidden = {f"{name}{HIDDEN_SUFFIX}": one for name, one in s.axes.items()}
        bound = dict(zip(function.arguments, values, strict=True))
        return evaluate(function.body, replace(s, axes=hidden, bound=bound))
    name = e.function
    if name in MATRIX:
        return _matrix(e, *MATRIX[name], values[0])
    if name == "dot":
        return _multiply(e, *values)
    if name in ("sum", "min", "max") and len(values) == 1:
        own = tuple(range(-values[0].rank, 0))
        return Value(getattr(jnp, name)(values[0].array, axis=own))
    if name == "pow":
        return _operate(e, "^", values)
    arrays, rank = _match_ranks(values, e)
    if name in ("min", "max"):
        return Value(reduce(jnp.minimum if name == "min" else jnp.maximum, arrays), rank)
    elementwise = SPECIAL_FUNCTIONS.get(name) or getattr(jnp, name)
    return Value(elementwise(*arrays), rank)


def _matrix(e: x.Application, wanted: int, given: int, function: Callable, v: Value) -> Value:
    """Compute a function of a matrix or vector, after a check of its dimensions."""
    if v.rank != wanted:
        kind = "a matrix" if wanted == 2 else "a vector"
        raise error_at(e.arguments[0].at, f"'{e.arguments[0]}' of {v.rank} dimensions", kind)
    square = v.array.shape[-2:]
    if e.function in ("inverse", "det", "trace") and square[0] != square[1]:
        found = f"'{e.arguments[0]}' of {square[0]} x {square[1]}"
        raise error_at(e.arguments[0].at, found, "a square matrix")
    return Value(function(v.array), given)


def _reduce(e: x.Reduction, s: Context) -> Value:
    """Compute a sum, product, minimum, maximum or mean over iterators."""
    axes = add_iterators(s.scope, s.axes, e.iterators)
    body = evaluate(e.body, replace(s, axes=axes))
    over = tuple(range(len(s.axes), len(axes)))
    # A body that does not depend on an iterator has one element along it, which counts for all.
    lengths = [len(one) for one in list(axes.values())[len(s.axes) :]]
    repeats = np.prod([n for n, i in zip(lengths, over, strict=True) if body.array.shape[i] == 1])
    found = getattr(jnp, e.kind)(body.array, axis=over)
    if repeats != 1 and e.kind in ("sum", "prod"):
        found = found * repeats if e.kind == "sum" else found ** int(repeats)
    return Value(found, body.rank)


# ---- elements of arrays


def _read_name(e: x.Name, s: Context) -> Value:
    """Compute a name: an argument, a constant, an iterator, or elements of an array."""
    if e.name in s.bound:
        if e.indices:
            raise error_at(e.at, f"'{e}', an index of an argument", "the argument as a whole")
        return add_axes(s.bound[e.name], len(s.axes))
    array = s.scope.arrays.get(e.name)
    if array is None or (array.role == "parameter" and not array.dims):
        value = s.scope.constant(e.name)
        if value is None:
            return Value(jnp.asarray(index_values(s.scope, e, s.axes), float))
        return Value(jnp.full((1,) * len(s.axes), value))
    indices = find_positions(s.scope, e, array, s.axes)
    rank = sum(isinstance(i, x.Whole) for i in e.indices) if e.indices else len(array.dims)
    return Value(take_elements(s.arrays[e.name], indices, len(s.axes) + rank), rank)


class _Slices(NamedTuple):
    """Indices as slices of each dimension, and the result's axis of each dimension that remains."""

    slices: tuple[int | slice, ...]
    axes: list[int]


def _as_slices(indices: list[np.ndarray]) -> _Slices | None:
    """Convert indices to slices if each varies evenly along an axis of its own, else None."""
    slices: list[int | slice] = []
    axes: list[int] = []
    for index in indices:
        along = [k for k, n in enumerate(index.shape) if n > 1]
        if len(along) > 1 or (along and along[0] in axes):
            return None
        values = index.ravel()
        if not along:
            slices.append(int(values[0]))
            continue
        step = int(values[1] - values[0])
        if step < 1 or np.any(np.diff(values) != step):
            return None
        slices.append(slice(int(values[0]), int(values[-1]) + 1, step))
        axes.append(along[0])
    return _Slices(tuple(slices), axes)


def take_elements(array: jax.Array, indices: list[np.ndarray], rank: int) -> jax.Array:
    """Take elements of an array by an index for each dimension, all of the same rank."""
    if not indices:
        return jnp.reshape(array, (1,) * rank)
    view = _as_slices(indices)
    if view is None:
        return array[tuple(indices)]
    found = array[view.slices]
    found = jnp.transpose(found, np.argsort(view.axes))
    shape = [1] * rank
    for k, n in zip(sorted(view.axes), found.shape, strict=True):
        shape[k] = n
    return found.reshape(shape)


def _set_elements(
    array: jax.Array, indices: list[np.ndarray], value: jax.Array, lengths: list[int]
):
    """Set elements of an array by an index for each dimension, as in `take_elements`.

    `value` has the axes of the indices, with `lengths`, or length 1 where it is constant.
    """
    if not indices:
        return jnp.reshape(value, ())
    view = _as_slices(indices)
    if view is None:
        return array.at[tuple(indices)].set(jnp.broadcast_to(value, lengths))
    # Axes along which no index varies have one element.
    shape = [n if k in view.axes else 1 for k, n in enumerate(lengths)]
    value = jnp.broadcast_to(value, shape).reshape([shape[k] for k in sorted(view.axes)])
    value = jnp.transpose(value, np.argsort(np.argsort(view.axes)))
    if value.shape == array.shape:
        return value
    return array.at[view.slices].set(value)


def check_rank(scope: Scope, target: x.Name, array: Array, value: Value, e: x.Expression) -> None:
    """Raise an error for a value with other dimensions than its target, naming their origin."""
    wanted = len(whole_dimensions(target, array))
    if value.rank in (0, wanted):
        return
    dimensions = f"{value.rank} dimension{'s' * (value.rank != 1)}"
    whole = next((n for n in _names(e) if _is_whole(scope, n)), None)
    if wanted or whole is None:
        expected = f"{wanted or 'no'} dimension{'s' * (wanted != 1)} as in '{target}'"
        raise error_at(e.at, f"'{e}' of {dimensions}", expected)
    array = scope.arrays[whole.name]
    where = "" if whole is e else f" in a formula of {dimensions}"
    expected = f"a number for '{target}', such as an element of {array.text}"
    count = len(whole_dimensions(whole, array))
    found = f"'{whole}' of {count} dimension{'s' * (count != 1)}{where}"
    raise error_at(whole.at, found, expected)


def _names(e: x.Expression) -> Iterator[x.Name]:
    if isinstance(e, x.Name):
        yield e
    elif not isinstance(e, x.Application) or e.function not in MATRIX:
        for part in x.children(e):
            yield from _names(part)


def _is_whole(scope: Scope, node: x.Name) -> bool:
    return node.name in scope.arrays and bool(whole_dimensions(node, scope.arrays[node.name]))


def assign(
    old: jax.Array, scope: Scope, array: Array, target: x.Name, axes: Axes, value: Value, e
) -> jax.Array:
    """Assign the value of expression e to the elements of an array that a target names."""
    indices = find_positions(scope, target, array, axes)
    whole = whole_dimensions(target, array)
    lengths = [*map(len, axes.values()), *map(len, whole)]
    if value.rank and value.array.shape[-value.rank :] != tuple(map(len, whole)):
        size = " x ".join(map(str, value.array.shape[-value.rank :]))
        raise error_at(e.at, f"'{e}' of {size}", f"the size of {array.text}")
    filled = value.array.reshape(*value.array.shape, *[1] * (len(whole) - value.rank))
    return _set_elements(old, indices, filled, lengths)
