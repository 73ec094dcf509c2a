"""Expressions as data, evaluated many at once, and JAX functions as expressions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.errors import InputError


class Node(NamedTuple):
    """An operation by name on its arguments; a constant's or variable's `value` is its own."""

    head: str
    arguments: tuple[Node, ...] = ()
    value: Any = None


def constant(value: float) -> Node:
    """A number."""
    return Node("constant", (), float(value))


def variable(index: int) -> Node:
    """An element of the vector of variables."""
    return Node("variable", (), int(index))


FUNCTIONS: dict[str, Callable] = {
    "plus": jnp.add, "minus": jnp.subtract, "times": jnp.multiply, "divide": jnp.divide,
    "rem": jnp.fmod, "power": jnp.power, "less": lambda a, b: jnp.maximum(a - b, 0.0),
    "floor": jnp.floor, "ceil": jnp.ceil, "abs": jnp.abs, "negative": jnp.negative,
    "or": jnp.logical_or, "and": jnp.logical_and, "<": jnp.less, "<=": jnp.less_equal,
    "=": jnp.equal, ">=": jnp.greater_equal, ">": jnp.greater, "!=": jnp.not_equal,
    "not": jnp.logical_not, "if": lambda c, a, b: jnp.where(c, a, b), "tanh": jnp.tanh,
    "tan": jnp.tan, "sqrt": jnp.sqrt, "sinh": jnp.sinh, "sin": jnp.sin, "log10": jnp.log10,
    "log": jnp.log, "exp": jnp.exp, "cosh": jnp.cosh, "cos": jnp.cos, "atanh": jnp.arctanh,
    "atan2": jnp.arctan2, "atan": jnp.arctan, "asinh": jnp.arcsinh, "asin": jnp.arcsin,
    "acosh": jnp.arccosh, "acos": jnp.arccos, "round": jnp.round, "trunc": jnp.trunc,
}  # fmt: skip
"""Operations of a fixed number of arguments; `sum`, `min` and `max` take any."""

MANY = {
    "sum": jax.ops.segment_sum,
    "min": jax.ops.segment_min,
    "max": jax.ops.segment_max,
}


def plan(nodes: Sequence[Node], known: Callable[[int], int] = int) -> Callable:
    """Order the computation of expressions so that alike ones are computed together.

    Parameters
    ----------
    nodes : sequence of Node
        The expressions.
    known : callable
        Place of a variable in the vector that is passed.

    Returns
    -------
    callable
        ``f(x)``, shape (n,) to (expressions,), in JAX.

    Examples
    --------
    >>> import beamfit.greybox
    >>> x = [variable(i) for i in range(2)]
    >>> f = plan([Node("times", (x[0], x[1])), Node("sum", (*x, Node("sin", (constant(0),))))])
    >>> f(jnp.array([2.0, 3.0])).tolist()
    [6.0, 5.0]
    """
    groups: dict[Any, list[int]] = {}
    for place, node in enumerate(nodes):
        groups.setdefault(_kind(node), []).append(place)
    steps = [_step(key, [nodes[i] for i in places], known) for key, places in groups.items()]
    order = np.argsort(np.concatenate([*groups.values(), []]).astype(int), kind="stable")

    def computed(x):
        parts = [step(x) for step in steps]
        return jnp.concatenate(parts)[order] if len(parts) > 1 else parts[0]

    return computed if steps else lambda x: jnp.zeros(0)


def _kind(node: Node) -> Any:
    """What nodes must share to be computed together; whole powers are as exact as products."""
    if node.head == "power" and node.arguments[1].head == "constant":
        power = node.arguments[1].value
        return ("power", int(power) if power.is_integer() and abs(power) < 64 else power)
    return node.head


def _step(kind: Any, nodes: list[Node], known: Callable[[int], int]) -> Callable:
    if kind == "constant":
        values = np.array([node.value for node in nodes])
        return lambda x: jnp.asarray(values)
    if kind == "variable":
        places = np.array([known(node.value) for node in nodes])
        return lambda x: x[places]
    if isinstance(kind, tuple):
        base = plan([node.arguments[0] for node in nodes], known)
        return lambda x: base(x) ** kind[1]
    if kind in MANY:
        inner = plan([part for node in nodes for part in node.arguments], known)
        owner = np.repeat(np.arange(len(nodes)), [len(node.arguments) for node in nodes])
        return lambda x: MANY[kind](inner(x), owner, len(nodes))
    function, count = FUNCTIONS[kind], len(nodes[0].arguments)
    columns = [plan([node.arguments[i] for node in nodes], known) for i in range(count)]
    return lambda x: 1.0 * function(*(column(x) for column in columns))


SAME = {
    "add": "plus", "add_any": "plus", "sub": "minus", "mul": "times", "div": "divide",
    "neg": "negative", "pow": "power", "max": "max", "min": "min", "rem": "rem", "lt": "<",
    "le": "<=", "eq": "=", "ge": ">=", "gt": ">", "ne": "!=", "and": "and", "or": "or",
    "not": "not", "atan2": "atan2",
} | {name: name for name in (
    "exp", "log", "sin", "cos", "tan", "tanh", "sinh", "cosh", "asin", "acos", "atan", "asinh",
    "acosh", "atanh", "sqrt", "abs", "floor", "ceil",
)}  # fmt: skip
MADE: dict[str, Callable[[Table, dict, list[int]], int]] = {
    "integer_pow": lambda t, p, a: t.node("power", a[0], t.constant(p["y"])),
    "square": lambda t, p, a: t.node("power", a[0], t.constant(2.0)),
    "rsqrt": lambda t, p, a: t.node("power", a[0], t.constant(-0.5)),
    "log1p": lambda t, p, a: t.node("log", t.node("plus", t.constant(1.0), a[0])),
    "expm1": lambda t, p, a: t.node("minus", t.node("exp", a[0]), t.constant(1.0)),
    "logistic": lambda t, p, a: t.node(
        "divide",
        t.constant(1.0),
        t.node("plus", t.constant(1.0), t.node("exp", t.node("negative", a[0]))),
    ),
    "select_n": lambda t, p, a: t.node("if", a[0], a[2], a[1]),
    "clamp": lambda t, p, a: t.node("max", a[0], t.node("min", a[1], a[2])),
    "convert_element_type": lambda t, p, a: a[0],
    "stop_gradient": lambda t, p, a: a[0],
    "copy": lambda t, p, a: a[0],
}
# What only moves elements, and which of its arguments are moved (all where none is named).
MOVED = dict.fromkeys(
    ("reshape", "transpose", "broadcast_in_dim", "squeeze", "expand_dims", "slice", "rev", "split",
     "dynamic_slice", "gather", "copy_p"), (0,)
) | {"concatenate": (), "pad": (), "scatter": (0, 2), "dynamic_update_slice": (0, 1)}  # fmt: skip
REDUCED = {"reduce_sum": "sum", "reduce_max": "max", "reduce_min": "min"}
INSIDE = ("jaxpr", "call_jaxpr", "fun_jaxpr")


class Places(NamedTuple):
    """An array of places in the table."""

    at: np.ndarray


class Table:
    """Nodes ``(head, places of arguments, value)``, arguments before what is made of them."""

    def __init__(self):
        self.nodes: list[tuple[str, tuple[int, ...], Any]] = []
        self.known: dict[tuple, int] = {}

    def put(self, *node: Any) -> int:
        """The place of a node, made where it is new."""
        if node not in self.known:
            self.known[node] = len(self.nodes)
            self.nodes.append(node)
        return self.known[node]

    def constant(self, value: Any) -> int:
        """A number."""
        return self.put("constant", (), float(value))

    def node(self, head: str, *arguments: int) -> int:
        """An operation; what adds nothing or multiplies by 1 or 0 is left out."""
        values = [self.nodes[a][2] if self.nodes[a][0] == "constant" else None for a in arguments]
        if head == "times" and 0.0 in values:
            return self.constant(0.0)
        for unit in {"plus": (0.0,), "times": (1.0,)}.get(head, ()):
            if unit in values:
                return arguments[1 - values.index(unit)]
        return self.put(head, tuple(arguments), None)

    def many(self, head: str, arguments: Sequence[int]) -> int:
        """A sum, maximum or minimum of any number."""
        some = [a for a in arguments if head != "sum" or self.nodes[a] != ("constant", (), 0.0)]
        if len(some) > 1:
            return self.put(head, tuple(some), None)
        return some[0] if some else self.constant(0.0)


def traced(function: Callable, n: int, table: Table) -> np.ndarray:
    """Places of a function's values in a table, variables being ``("variable", (), i)``.

    Parameters
    ----------
    function : callable
        ``f(x)``, shape (n,) to any, in JAX.
    n : int
        How many variables.
    table : Table
        Takes the nodes.

    Raises
    ------
    InputError
        If an operation has no counterpart: loops, foreign code, sorting.
    """
    closed = jax.make_jaxpr(function)(np.zeros(n))
    variables = Places(np.array([table.put("variable", (), i) for i in range(n)]))
    (found,) = _walk(table, closed.jaxpr, closed.consts, [variables])
    return _places(table, found).at


def _places(table: Table, value: Any) -> Places:
    if isinstance(value, Places):
        return value
    value = np.asarray(value)
    at = [table.constant(v) for v in value.ravel()]
    return Places(np.array(at, int).reshape(value.shape))


def _walk(table: Table, jaxpr: Any, consts: Sequence[Any], arguments: Sequence[Any]) -> list[Any]:
    known = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *arguments], strict=True))

    def value(atom):
        return atom.val if hasattr(atom, "val") else known[atom]

    for step in jaxpr.eqns:
        given = [value(atom) for atom in step.invars]
        found = _done(table, step, given)
        known.update(zip(step.outvars, found, strict=True))
    return [value(atom) for atom in jaxpr.outvars]


def _done(table: Table, step: Any, given: list[Any]) -> list[Any]:
    """What one operation gives."""
    name, params = step.primitive.name, step.params
    inside = next((params[key] for key in INSIDE if key in params), None)
    if inside is not None and name not in ("while", "scan", "cond"):
        closed = hasattr(inside, "jaxpr")
        return _walk(table, inside.jaxpr if closed else inside, inside.consts if closed else (),
                     given)  # fmt: skip
    if not any(isinstance(part, Places) for part in given):
        found = step.primitive.bind(*given, **params)
        return list(found) if step.primitive.multiple_results else [found]
    if name == "select_n" and not isinstance(given[0], Places) and len(given) == 3:
        cases = [_places(table, part).at for part in given[1:]]
        return [Places(np.where(np.asarray(given[0]), cases[1], cases[0]))]
    if name in MOVED:
        every = MOVED[name] or range(len(given))
        parts = [_places(table, v).at if i in every else v for i, v in enumerate(given)]
        if any(isinstance(part, Places) for part in parts):
            raise _refused(f"{name} at places that depend on the numbers")
        found = step.primitive.bind(*map(np.asarray, parts), **params)
        found = found if step.primitive.multiple_results else [found]
        return [Places(np.asarray(part)) for part in found]
    if name in REDUCED:
        return [_along(table, REDUCED[name], given[0].at, params["axes"])]
    if name == "dot_general":
        return [_product(table, *given, params["dimension_numbers"])]
    if name not in SAME and name not in MADE:
        raise _refused(f"the operation '{name}'")
    at = np.broadcast_arrays(*(_places(table, part).at for part in given))
    make = MADE.get(name, lambda t, p, a: t.node(SAME[name], *a))
    flat = [make(table, params, list(some)) for some in zip(*(a.ravel().tolist() for a in at),
                                                            strict=True)]  # fmt: skip
    return [Places(np.array(flat, int).reshape(at[0].shape))]


def _along(table: Table, head: str, at: np.ndarray, axes: Sequence[int]) -> Places:
    kept = [i for i in range(at.ndim) if i not in axes]
    rows = np.transpose(at, (*kept, *axes)).reshape((*(at.shape[i] for i in kept), -1))
    flat = [table.many(head, row) for row in rows.reshape(-1, rows.shape[-1]).tolist()]
    return Places(np.array(flat, int).reshape(rows.shape[:-1]))


def _product(table: Table, left: Any, right: Any, numbers: Any) -> Places:
    """A product of matrices: batch axes first, then those of the left, then of the right."""
    (of_left, of_right), (batch_left, batch_right) = numbers
    a, b = _places(table, left).at, _places(table, right).at
    a = np.moveaxis(a, [*batch_left, *of_left], [*range(len(batch_left)),
                    *range(-len(of_left), 0)])  # fmt: skip
    b = np.moveaxis(b, [*batch_right, *of_right], [*range(len(batch_right)),
                    *range(-len(of_right), 0)])  # fmt: skip
    batch, inner = a.shape[: len(batch_left)], a.shape[a.ndim - len(of_left) :]
    rows, columns = (part.shape[len(batch) : part.ndim - len(inner)] for part in (a, b))
    count = [int(np.prod(part)) for part in (batch, rows, columns, inner)]
    a, b = a.reshape(count[0], count[1], count[3]), b.reshape(count[0], count[2], count[3])
    flat = [
        table.many("sum", [table.node("times", *pair) for pair in zip(u, v, strict=True)])
        for some, others in zip(a.tolist(), b.tolist(), strict=True)
        for u in some
        for v in others
    ]
    return Places(np.array(flat, int).reshape((*batch, *rows, *columns)))


def _refused(what: str) -> InputError:
    return InputError(what, "operations on numbers that expressions can say; no loops, no sorting")
