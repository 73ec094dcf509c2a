"""Calls of mappings and networks: wired by name, computed for all points at once, with gains."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.language import document as d
from beamfit.language import expression as x
from beamfit.language.evaluate import Setting, Value, check_rank, evaluate, picked, stored
from beamfit.language.network_xml import with_weights
from beamfit.language.plan import callee_of, gains_of
from beamfit.language.scope import Array, Axes, IndexSet, Net, Scope, located, widened

Arrays = dict[str, jax.Array]


def called(statement: d.Call, s: Setting, inner: Callable[[str], Callable]) -> Arrays:
    """The arrays that a call changes; `inner` gives a mapping inside by name as it is computed."""
    callee = callee_of(s.scope, statement)
    axes = s.axes
    given = given_to(statement, callee, s)
    names = [gains_of(w, callee, statement.mapping) for w in statement.outputs]
    lengths = [len(one) for one in axes.values()]
    batched = {n: a.shape[: len(axes)] != (1,) * len(axes) for n, a in given.items()}
    flat = {n: _points(a, lengths, batched[n]) for n, a in given.items()}
    run = partial(_network, callee) if isinstance(callee, Net) else inner(statement.mapping)
    function = _function(s, callee, run, names)
    many = any(batched.values())
    if many:
        function = jax.vmap(function, in_axes=({n: 0 if b else None for n, b in batched.items()},))
    found = function(flat)
    made: Arrays = {}
    for wire, value, (output, _) in zip(statement.outputs, found, names, strict=True):
        own = value.shape[1:] if many else value.shape
        head = lengths if many else [1] * len(axes)
        whole = Value(value.reshape(*head, *own), len(own))
        own_axes, to = widened(s.scope, axes, wire.each), wire.target
        part = _output(s, whole, output, callee, own_axes, len(axes))
        check_rank(s.scope, to, s.scope.arrays[to.name], part, wire.value)
        array, old = s.scope.arrays[to.name], made.get(to.name, s.arrays[to.name])
        made[to.name] = stored(old, s.scope, array, to, own_axes, part, wire.value)
    return made


def given_to(statement: d.Call, callee: Scope | Net, s: Setting) -> Arrays:
    """Inputs of a call: one axis for each of its iterators, then the dimensions of the input."""
    given = {}
    for name, array in callee.inputs.items():
        wires = [w for w in statement.inputs if w.target.name == name]
        if wires:
            given[name] = _wired(s, array, wires)
    return given


def _wired(s: Setting, array: Array, wires: list[d.Assignment]) -> jax.Array:
    """An input of what is called: one axis for each iterator of the call, then its dimensions."""
    count = len(s.axes)
    found = None
    for wire in wires:
        inner = widened(s.scope, s.axes, wire.each)
        value = evaluate(wire.value, Setting(s.scope, s.arrays, inner, s.bound, s.known, s.watch))
        check_rank(s.scope, wire.target, array, value, wire.value)
        if found is None:
            found = jnp.zeros((*[1] * count, *array.shape))
            if array.values is not None:
                found = found + jnp.asarray(array.values, float).reshape(array.shape)
        head = value.array.shape[:count]
        shape = tuple(max(a, b) for a, b in zip(head, found.shape, strict=False))
        found = jnp.broadcast_to(found, (*shape, *array.shape))
        # Iterators of the call lead, as further dimensions that are taken whole.
        lead = {f"{i}'": IndexSet("", np.arange(n)) for i, n in enumerate(shape)}
        own = widened(s.scope, {}, wire.each)
        outer = Array(array.name, "input", (*lead.values(), *array.dims), array.at)
        rest = wire.target.indices or (x.Whole(),) * len(array.dims)
        leading = tuple(x.Name(n) for n in lead)
        target = x.Name(array.name, (*leading, *rest), wire.target.at)
        found = stored(found, s.scope, outer, target, {**lead, **own}, value, wire.value)
    return found


def _points(a: jax.Array, lengths: list[int], batched: bool) -> jax.Array:
    """An input with the iterators of the call as one axis, or without them."""
    own = a.shape[len(lengths) :]
    if not batched:
        return a.reshape(own)
    return jnp.broadcast_to(a, (*lengths, *own)).reshape(-1, *own)


def _output(s: Setting, v: Value, output: x.Name, callee, axes: Axes, count: int) -> Value:
    """The elements of an output that a wire takes."""
    array = callee.outputs[output.name]
    if v.rank == 0 or not output.indices:
        more = len(axes) - count
        shape = v.array.shape
        return Value(v.array.reshape(*shape[:count], *[1] * more, *shape[count:]), v.rank)
    indices = located(s.scope, output, array, axes)
    whole = sum(isinstance(i, x.Whole) for i in output.indices)
    lead = []
    for k, n in enumerate(v.array.shape[:count]):
        shape = [1] * (len(axes) + whole)
        shape[k] = n
        lead.append(np.arange(n).reshape(shape))
    return Value(picked(v.array, [*lead, *indices], len(axes) + whole), whole)


def _function(s: Setting, callee: Scope | Net, run: Callable, wanted) -> Callable:
    """The called mapping as a function of its inputs; it returns outputs and gains in order."""
    names = sorted({output.name for output, _ in wanted})

    def outputs(given: Arrays) -> Arrays:
        return run(given, names)

    def function(given: Arrays) -> tuple[jax.Array, ...]:
        plain = outputs(given) if any(not by for _, by in wanted) else {}
        full = defaults(callee) | given
        return tuple(
            _gain(s, callee, outputs, full, output, by) if by else plain[output.name]
            for output, by in wanted
        )

    return function


def defaults(callee: Scope | Net) -> Arrays:
    """Inputs that the document gives values to."""
    given = {n: a for n, a in callee.inputs.items() if a.values is not None}
    return {n: jnp.asarray(a.values, float).reshape(a.shape) for n, a in given.items()}


def _network(callee: Net, given: Arrays, names: list[str]) -> Arrays:
    net = callee.mlp
    if "weights" in given:
        net = with_weights(net, given["weights"])
    found = net(jnp.stack([given[name] for name in net.inputs]))
    every = dict(zip(net.outputs, found, strict=True))
    return {name: every[name] for name in names}


def _gain(s: Setting, callee, outputs, given: Arrays, output: x.Name, by: tuple[x.Name, ...]):
    """A gain of an output by inputs, one after the other, by forward derivatives."""

    def derivative(function, e: x.Name):
        array = callee.inputs[e.name]
        at = tuple(int(i.ravel()[0]) for i in located(s.scope, e, array, s.axes))

        def slope(values):
            zero = jax.tree.map(jnp.zeros_like, values)
            zero[e.name] = zero[e.name].at[at].set(1.0)
            return jax.jvp(function, (values,), (zero,))[1]

        return slope

    function = lambda values: outputs(values)[output.name]  # noqa: E731
    for e in by:
        function = derivative(function, e)
    return function(given)
