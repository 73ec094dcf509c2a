"""Steps other than assignments: calls of mappings and networks, and recurrences.

Inputs and outputs of calls are connected by name. Calls are computed for all points at once, with
gains. A recurrence is one `lax.scan` over its time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.greybox import tree
from beamfit.language import document as d
from beamfit.language import expression as x
from beamfit.language.evaluate import (
    Context,
    Value,
    add_axes,
    assign,
    check_rank,
    evaluate,
    take_elements,
)
from beamfit.language.network_xml import weight_leaves
from beamfit.language.plan import LaggedRead, RecurrencePlan, callee_of, gains_of, sources
from beamfit.language.scope import (
    Array,
    Axes,
    CalledNetwork,
    IndexSet,
    MappingStep,
    Scope,
    add_iterators,
    find_positions,
)

Arrays = dict[str, jax.Array]
ONE = IndexSet("", np.arange(1))


def run_call(statement: d.Call, s: Context, inner: Callable[[str], Callable]) -> Arrays:
    """Compute the arrays that a call changes; `inner` returns the function of an inner mapping."""
    callee = callee_of(s.scope, statement)
    given, count = call_inputs(statement, callee, s), len(s.axes)
    names = [gains_of(w, callee, statement.mapping) for w in statement.outputs]
    run = (
        partial(_run_network, callee)
        if isinstance(callee, CalledNetwork)
        else inner(statement.mapping)
    )
    function = _call_function(s, callee, run, names)
    # Compute all points at once, along each iterator on which an input depends.
    lead = [max((a.shape[k] for a in given.values()), default=1) for k in range(count)]
    varying = [k for k, n in enumerate(lead) if n > 1]
    for k in reversed(varying):
        function = jax.vmap(
            function, ({n: 0 if a.shape[k] > 1 else None for n, a in given.items()},)
        )
    found = function({n: a.reshape([m for m in a.shape[:count] if m > 1] + [*a.shape[count:]])
                      for n, a in given.items()})  # fmt: skip
    changed: Arrays = {}
    for wire, value, (output, _) in zip(statement.outputs, found, names, strict=True):
        own = value.shape[len(varying) :]
        whole = Value(value.reshape(*lead, *own), len(own))
        axes, target = add_iterators(s.scope, s.axes, wire.each), wire.target
        part = _take_output(s, whole, output, callee, axes, count)
        array = s.scope.arrays[target.name]
        check_rank(s.scope, target, array, part, wire.value)
        old = changed.get(target.name, s.arrays[target.name])
        changed[target.name] = assign(old, s.scope, array, target, axes, part, wire.value)
    return changed


def call_inputs(statement: d.Call, callee: Scope | CalledNetwork, s: Context) -> Arrays:
    """Compute the inputs of a call: one axis for each iterator, then the input's dimensions."""
    given = {}
    for name, array in callee.inputs.items():
        wires = [w for w in statement.inputs if w.target.name == name]
        if wires:
            given[name] = _connect_input(s, array, wires)
    return given


def _connect_input(s: Context, array: Array, wires: list[d.Assignment]) -> jax.Array:
    """Compute one input: one axis for each iterator of the call, then the input's dimensions."""
    count = len(s.axes)
    found = jnp.zeros((*[1] * count, *array.shape))
    if array.values is not None:
        found = found + jnp.asarray(array.values, float).reshape(array.shape)
    for wire in wires:
        value = evaluate(wire.value, replace(s, axes=add_iterators(s.scope, s.axes, wire.each)))
        check_rank(s.scope, wire.target, array, value, wire.value)
        own = add_iterators(s.scope, {}, wire.each)

        def put(old, v, wire=wire, own=own, rank=value.rank):
            return assign(old, s.scope, array, wire.target, own, Value(v, rank), wire.value)

        for _ in range(count):
            put = jax.vmap(put)
        lead = np.broadcast_shapes(found.shape[:count], value.array.shape[:count])
        pair = (jnp.broadcast_to(a, (*lead, *a.shape[count:])) for a in (found, value.array))
        found = put(*pair)
    return found


def _take_output(s: Context, v: Value, output: x.Name, callee, axes: Axes, count: int) -> Value:
    """Take the elements of an output that a wire names."""
    array = callee.outputs[output.name]
    if v.rank == 0 or not output.indices:
        return add_axes(v, len(axes))
    indices = find_positions(s.scope, output, array, axes)
    whole = sum(isinstance(i, x.Whole) for i in output.indices)
    lead = []
    for k, n in enumerate(v.array.shape[:count]):
        shape = [1] * (len(axes) + whole)
        shape[k] = n
        lead.append(np.arange(n).reshape(shape))
    return Value(take_elements(v.array, [*lead, *indices], len(axes) + whole), whole)


def _call_function(s: Context, callee: Scope | CalledNetwork, run: Callable, wanted) -> Callable:
    """Make the called mapping a function of its inputs that returns outputs and gains in order."""
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


def defaults(callee: Scope | CalledNetwork) -> Arrays:
    """Return the inputs that have values in the document."""
    given = {n: a for n, a in callee.inputs.items() if a.values is not None}
    return {n: jnp.asarray(np.reshape(a.values, a.shape), float) for n, a in given.items()}


def _run_network(callee: CalledNetwork, given: Arrays, names: list[str]) -> Arrays:
    net = callee.mlp
    if "weights" in given:
        net = tree.replace(net, weight_leaves(net), given["weights"])
    found = net(jnp.stack([given[name] for name in net.inputs]))
    every = dict(zip(net.outputs, found, strict=True))
    return {name: every[name] for name in names}


def _gain(s: Context, callee, outputs, given: Arrays, output: x.Name, by: tuple[x.Name, ...]):
    """Compute the derivative of an output by one input after the other, in forward mode."""

    def derivative(function, e: x.Name):
        array = callee.inputs[e.name]
        at = tuple(int(i.ravel()[0]) for i in find_positions(s.scope, e, array, s.axes))

        def slope(values):
            zero = jax.tree.map(jnp.zeros_like, values)
            zero[e.name] = zero[e.name].at[at].set(1.0)
            return jax.jvp(function, (values,), (zero,))[1]

        return slope

    function = lambda values: outputs(values)[output.name]  # noqa: E731
    for e in by:
        function = derivative(function, e)
    return function(given)


# ---- recurrences


def scan_recurrence(scope: Scope, plan: RecurrencePlan, arrays: Arrays, run_step) -> Arrays:
    """Compute the arrays of a recurrence.

    Parameters
    ----------
    scope : Scope
        Names of the mapping.
    plan : RecurrencePlan
        Steps of the recurrence and their lagged reads.
    arrays : dict of str to array
        All arrays computed so far, including first values of the recurrence.
    run_step : callable
        ``run_step(step, context)`` returns the arrays that a step changes.

    Returns
    -------
    dict of str to array
    """
    fixed, moving = _precompute(scope, plan, arrays)
    small = _scope_without_time(scope, plan)
    full = {n: jnp.moveaxis(arrays[n], w.dim, 0) for n, w in plan.time_axes.items()}
    ends = {n: w.start + plan.length for n, w in plan.time_axes.items()}
    begin = {n: full[n][w.start : ends[n]] for n, w in plan.time_axes.items()}
    past = {n: _history(full[n], w.start, plan.depth) for n, w in plan.time_axes.items()}

    def advance(history: Arrays, at):
        fresh, outside = at
        for step in plan.steps:
            k = list(step.axes).index(plan.time_iterators[step.number])
            computed = fixed | {
                i: Value(jnp.expand_dims(v, moving[i][0]), moving[i][1]) for i, v in outside.items()
            }
            for i, lagged in plan.reads.items():
                computed[i] = _lagged_value(lagged, fresh, history)
            axes = {n: ONE if i == k else s for i, (n, s) in enumerate(step.axes.items())}
            context = Context(small, arrays | fresh, axes, computed=computed)
            fresh = fresh | run_step(_step_without_time(step, plan), context)
        if plan.depth:
            history = {n: jnp.concatenate([fresh[n][None], h[:-1]]) for n, h in history.items()}
        return history, fresh

    values = {i: v for i, (_, _, v) in moving.items()}
    _, found = jax.lax.scan(advance, past, (begin, values))
    return {
        n: jnp.moveaxis(full[n].at[w.start : ends[n]].set(found[n]), 0, w.dim)
        for n, w in plan.time_axes.items()
    }


def _precompute(scope: Scope, plan: RecurrencePlan, arrays: Arrays):
    """Compute all parts that do not depend on the recurrence, constant or changing with time.

    The latter are returned as the axis of time, the rank, and the array with time in front.
    """
    fixed: dict[int, Value] = {}
    moving: dict[int, tuple[int, int, jax.Array]] = {}
    for step in plan.steps:
        k = list(step.axes).index(plan.time_iterators[step.number])
        for e, axes in sources(scope, step):
            for part, inner in _independent_parts(scope, e, axes, plan):
                value = evaluate(part, Context(scope, arrays, inner))
                if value.array.shape[k] > 1:
                    moving[id(part)] = k, value.rank, jnp.moveaxis(value.array, k, 0)
                else:
                    fixed[id(part)] = value
    return fixed, moving


def _independent_parts(
    scope: Scope, e: x.Expression, axes: Axes, plan: RecurrencePlan
) -> Iterator[tuple[x.Expression, Axes]]:
    """Yield the largest parts of an expression that do not depend on the recurrence."""
    if id(e) in plan.reads or isinstance(e, x.Literal):
        return
    if not _is_recurrent(e, plan):
        yield e, axes
    elif isinstance(e, x.Reduction):
        yield from _independent_parts(scope, e.body, add_iterators(scope, axes, e.iterators), plan)
    else:
        for part in x.children(e):
            yield from _independent_parts(scope, part, axes, plan)


def _is_recurrent(e: x.Expression, plan: RecurrencePlan) -> bool:
    return id(e) in plan.reads or any(_is_recurrent(part, plan) for part in x.children(e))


def _history(full: jax.Array, start: int, depth: int) -> jax.Array:
    """Return the values before the start, the last first; missing ones are zero and never read."""
    before = full[max(start - depth, 0) : start][::-1]
    return jnp.pad(before, [(0, depth - len(before)), *[(0, 0)] * (full.ndim - 1)])


def _lagged_value(lagged: LaggedRead, fresh: Arrays, history: Arrays) -> Value:
    stack = jnp.concatenate([fresh[lagged.name][None], history[lagged.name]])
    rank = lagged.lag.ndim
    return Value(take_elements(stack, [lagged.lag, *lagged.other_indices], rank), lagged.whole)


def _scope_without_time(scope: Scope, plan: RecurrencePlan) -> Scope:
    """Make the scope at one time: arrays of the recurrence lose their time dimension."""
    small: dict[str, Array] = {}
    for name, w in plan.time_axes.items():
        array = scope.arrays[name]
        small[name] = array._replace(dims=array.dims[: w.dim] + array.dims[w.dim + 1 :])
    return replace(scope, arrays=scope.arrays | small)


def _step_without_time(step: MappingStep, plan: RecurrencePlan) -> MappingStep:
    """Remove the time index from the targets of a step."""

    def target(node: x.Name) -> x.Name:
        at = plan.time_axes[node.name].dim
        return replace(node, indices=node.indices[:at] + node.indices[at + 1 :])

    statement = step.statement
    if isinstance(statement, d.Assignment):
        return step._replace(statement=replace(statement, target=target(statement.target)))
    outputs = tuple(replace(w, target=target(w.target)) for w in statement.outputs)
    return step._replace(statement=replace(statement, outputs=outputs))
