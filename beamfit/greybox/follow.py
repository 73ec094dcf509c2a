"""Properties of values handed through the program of a JAX function, operation by operation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

# Operations that move elements, with the first operand that says where to, 0 if none does.
MOVES = dict.fromkeys(
    """broadcast_in_dim concatenate expand_dims pad reshape rev slice split squeeze stack tile
    transpose unstack""".split(),  # noqa: SIM905
    0,
) | {"dynamic_slice": 1, "gather": 1, "dynamic_update_slice": 2}
# Operations up to which a loop of known length is unrolled.
UNROLLED = 5_000

Rule = Callable[[Any, list[Any]], list[Any]]


def followed(program: ClosedJaxpr, arguments: Sequence[Any], rule: Rule, kind: type) -> list[Any]:
    """Follow properties of some arguments of a program to its results.

    Parameters
    ----------
    program : ClosedJaxpr
        From `jax.make_jaxpr`.
    arguments : sequence
        One for each of its inputs: an array, or a property where it is not fixed.
    rule : callable
        ``rule(step, operands)``: the properties of the results of one operation. Operands that do
        not depend on what is not fixed are arrays.
    kind : type
        The class of the properties.

    Returns
    -------
    list
        A property or an array for each result.
    """
    return _walk(program.jaxpr, program.consts, list(arguments), rule, kind)


def moves(step, operands: list[Any], kind: type) -> bool:
    """True if an operation only moves elements, to known positions."""
    first = MOVES.get(step.primitive.name)
    return first is not None and not (first and any(isinstance(v, kind) for v in operands[first:]))


def _walk(program: Jaxpr, constants, arguments: list, rule: Rule, kind: type) -> list[Any]:
    known: dict[Any, Any] = dict(zip(program.constvars, constants, strict=True))
    known |= dict(zip(program.invars, arguments, strict=True))

    def value(atom):
        return atom.val if isinstance(atom, Literal) else known[atom]

    for step in program.eqns:
        operands = [value(atom) for atom in step.invars]
        known |= dict(zip(step.outvars, _results(step, operands, rule, kind), strict=True))
    return [value(atom) for atom in program.outvars]


def _results(step, operands: list[Any], rule: Rule, kind: type) -> list[Any]:
    name, inner = step.primitive.name, _inner(step.params)
    if not any(isinstance(v, kind) for v in operands):
        found = step.primitive.bind(*operands, **step.params)
        return list(found) if step.primitive.multiple_results else [found]
    if inner is not None and name not in ("scan", "while", "cond"):
        return _walk(inner.jaxpr, inner.consts, operands, rule, kind)
    if name == "scan" and step.params["length"] * len(inner.jaxpr.eqns) <= UNROLLED:
        return _unrolled(step, inner, operands, rule, kind)
    return rule(step, operands)


def _inner(params: dict[str, Any]) -> ClosedJaxpr | None:
    """The program that an operation calls with its operands."""
    for name in ("jaxpr", "call_jaxpr", "fun_jaxpr"):
        if isinstance(found := params.get(name), ClosedJaxpr):
            return found
    return None


def _unrolled(step, inner: ClosedJaxpr, operands: list, rule: Rule, kind: type) -> list[Any]:
    """A loop over a known length, its elements taken and put together by their own operations."""
    fixed, kept = step.params["num_consts"], step.params["num_carry"]
    constants, carry, each = operands[:fixed], operands[fixed:][:kept], operands[fixed + kept :]
    takes = [_take(v.aval) for v in step.invars[fixed + kept :]]
    found: list[list[Any]] = []
    times = range(step.params["length"])
    for t in reversed(times) if step.params["reverse"] else times:
        at = jnp.asarray(t)
        now = [_walk(take.jaxpr, take.consts, [v, at], rule, kind)[0]
               for take, v in zip(takes, each, strict=True)]  # fmt: skip
        ends = _walk(inner.jaxpr, inner.consts, [*constants, *carry, *now], rule, kind)
        carry = ends[:kept]
        found.append(ends[kept:])
    if step.params["reverse"]:
        found.reverse()
    parts = zip(zip(*found, strict=True), step.outvars[kept:], strict=True)
    return [*carry, *(_put(list(part), out.aval, rule, kind) for part, out in parts)]


def _take(like) -> ClosedJaxpr:
    """The program of one element of an array at a place."""
    whole = jax.ShapeDtypeStruct(like.shape, like.dtype)
    return jax.make_jaxpr(jax.lax.dynamic_index_in_dim, static_argnums=(2, 3))(whole, 0, 0, False)


def _put(parts: list[Any], like, rule: Rule, kind: type) -> Any:
    """Elements as one array."""
    shape = jax.ShapeDtypeStruct(like.shape[1:], like.dtype)
    program = jax.make_jaxpr(lambda *v: jnp.concatenate([jnp.expand_dims(p, 0) for p in v]))
    program = program(*[shape] * len(parts))
    return _walk(program.jaxpr, program.consts, parts, rule, kind)[0]
