"""Expressions as data, evaluated for many of one kind at once.

A node is ``(head, arguments)``. Nodes whose heads are alike are computed together whatever
expression they stand in, so that a sum of 100 000 terms of one form is a few array operations.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np


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
