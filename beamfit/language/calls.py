"""Calls of mappings and networks: wired by name, computed for all points at once, with gains."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.greybox import tree
from beamfit.language import document as d
from beamfit.language import expression as x
from beamfit.language.evaluate import Setting, Value, check_rank, evaluate, lifted, picked, stored
from beamfit.language.network_xml import weight_leaves
from beamfit.language.plan import callee_of, gains_of
from beamfit.language.scope import Array, Axes, Net, Scope, located, widened

Arrays = dict[str, jax.Array]


def called(statement: d.Call, s: Setting, inner: Callable[[str], Callable]) -> Arrays:
    """The arrays that a call changes; `inner` gives a mapping inside by name as it is computed."""
    callee = callee_of(s.scope, statement)
    given, count = given_to(statement, callee, s), len(s.axes)
    names = [gains_of(w, callee, statement.mapping) for w in statement.outputs]
    run = partial(_network, callee) if isinstance(callee, Net) else inner(statement.mapping)
    function = _function(s, callee, run, names)
    # All points at once: along each iterator that an input changes with.
    lead = [max((a.shape[k] for a in given.values()), default=1) for k in range(count)]
    many = [k for k, n in enumerate(lead) if n > 1]
    for k in reversed(many):
        function = jax.vmap(
            function, ({n: 0 if a.shape[k] > 1 else None for n, a in given.items()},)
        )
    found = function({n: a.reshape([m for m in a.shape[:count] if m > 1] + [*a.shape[count:]])
                      for n, a in given.items()})  # fmt: skip
    made: Arrays = {}
    for wire, value, (output, _) in zip(statement.outputs, found, names, strict=True):
        own = value.shape[len(many) :]
        whole = Value(value.reshape(*lead, *own), len(own))
        axes, to = widened(s.scope, s.axes, wire.each), wire.target
        part = _output(s, whole, output, callee, axes, count)
        array = s.scope.arrays[to.name]
        check_rank(s.scope, to, array, part, wire.value)
        old = made.get(to.name, s.arrays[to.name])
        made[to.name] = stored(old, s.scope, array, to, axes, part, wire.value)
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
    found = jnp.zeros((*[1] * count, *array.shape))
    if array.values is not None:
        found = found + jnp.asarray(array.values, float).reshape(array.shape)
    for wire in wires:
        value = evaluate(wire.value, replace(s, axes=widened(s.scope, s.axes, wire.each)))
        check_rank(s.scope, wire.target, array, value, wire.value)
        own = widened(s.scope, {}, wire.each)

        def put(old, v, wire=wire, own=own, rank=value.rank):
            return stored(old, s.scope, array, wire.target, own, Value(v, rank), wire.value)

        for _ in range(count):
            put = jax.vmap(put)
        lead = np.broadcast_shapes(found.shape[:count], value.array.shape[:count])
        pair = (jnp.broadcast_to(a, (*lead, *a.shape[count:])) for a in (found, value.array))
        found = put(*pair)
    return found


def _output(s: Setting, v: Value, output: x.Name, callee, axes: Axes, count: int) -> Value:
    """The elements of an output that a wire takes."""
    array = callee.outputs[output.name]
    if v.rank == 0 or not output.indices:
        return lifted(v, len(axes))
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
    return {n: jnp.asarray(np.reshape(a.values, a.shape), float) for n, a in given.items()}


def _network(callee: Net, given: Arrays, names: list[str]) -> Arrays:
    net = callee.mlp
    if "weights" in given:
        net = tree.replace(net, weight_leaves(net), given["weights"])
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
