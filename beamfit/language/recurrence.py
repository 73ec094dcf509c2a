"""Statements with earlier values of themselves, compiled to one `lax.scan` over their time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.language import document as d
from beamfit.language import expression as x
from beamfit.language.evaluate import Setting, Value, evaluate, picked
from beamfit.language.plan import Lagged, RecurrencePlan, sources
from beamfit.language.scope import Array, Axes, IndexSet, MappingStep, Scope, widened

ONE = IndexSet("", np.arange(1))
Arrays = dict[str, jax.Array]


def scanned(scope: Scope, plan: RecurrencePlan, arrays: Arrays, assigned) -> Arrays:
    """Compute the arrays that the steps of a plan advance.

    Parameters
    ----------
    scope : Scope
        The names of the mapping.
    plan : RecurrencePlan
        The steps, and how far back each reads.
    arrays : dict of str to array
        Everything that is known before, first values of what advances included.
    assigned : callable
        ``assigned(step, setting)`` gives the arrays that a step changes.

    Returns
    -------
    dict of str to array
    """
    fixed, moving = _apart(scope, plan, arrays)
    small = _without_time(scope, plan)
    full = {n: jnp.moveaxis(arrays[n], w.dim, 0) for n, w in plan.written.items()}
    ends = {n: w.start + plan.length for n, w in plan.written.items()}
    begin = {n: full[n][w.start : ends[n]] for n, w in plan.written.items()}
    past = {n: _history(full[n], w.start, plan.depth) for n, w in plan.written.items()}

    def advance(history: Arrays, at):
        fresh, outside = at
        for step in plan.steps:
            k = list(step.axes).index(plan.time[step.number])
            known = fixed | {
                i: Value(jnp.expand_dims(v, moving[i][0]), moving[i][1]) for i, v in outside.items()
            }
            for i, lagged in plan.reads.items():
                known[i] = _looked_up(lagged, fresh, history)
            axes = {n: ONE if i == k else s for i, (n, s) in enumerate(step.axes.items())}
            setting = Setting(small, arrays | fresh, axes, known=known)
            fresh = fresh | assigned(_timeless(step, plan), setting)
        if plan.depth:
            history = {n: jnp.concatenate([fresh[n][None], h[:-1]]) for n, h in history.items()}
        return history, fresh

    values = {i: v for i, (_, _, v) in moving.items()}
    _, found = jax.lax.scan(advance, past, (begin, values))
    return {
        n: jnp.moveaxis(full[n].at[w.start : ends[n]].set(found[n]), 0, w.dim)
        for n, w in plan.written.items()
    }


def _apart(scope: Scope, plan: RecurrencePlan, arrays: Arrays):
    """Values of all that does not hang on what advances: fixed ones, and those that run with time.

    The latter are the axis of time, the rank, and the array with time in front.
    """
    fixed: dict[int, Value] = {}
    moving: dict[int, tuple[int, int, jax.Array]] = {}
    for step in plan.steps:
        k = list(step.axes).index(plan.time[step.number])
        for e, axes in sources(scope, step):
            for part, inner in _independent(scope, e, axes, plan):
                value = evaluate(part, Setting(scope, arrays, inner))
                if value.array.shape[k] > 1:
                    moving[id(part)] = k, value.rank, jnp.moveaxis(value.array, k, 0)
                else:
                    fixed[id(part)] = value
    return fixed, moving


def _independent(
    scope: Scope, e: x.Expression, axes: Axes, plan: RecurrencePlan
) -> Iterator[tuple[x.Expression, Axes]]:
    """The largest parts of an expression that read nothing that advances."""
    if id(e) in plan.reads or isinstance(e, x.Literal):
        return
    if not _advancing(e, plan):
        yield e, axes
    elif isinstance(e, x.Reduction):
        yield from _independent(scope, e.body, widened(scope, axes, e.iterators), plan)
    else:
        for part in x.children(e):
            yield from _independent(scope, part, axes, plan)


def _advancing(e: x.Expression, plan: RecurrencePlan) -> bool:
    return id(e) in plan.reads or any(_advancing(part, plan) for part in x.children(e))


def _history(full: jax.Array, start: int, depth: int) -> jax.Array:
    """Values before the start, last one first; zeros, which nobody reads, before all."""
    before = full[max(start - depth, 0) : start][::-1]
    return jnp.pad(before, [(0, depth - len(before)), *[(0, 0)] * (full.ndim - 1)])


def _looked_up(lagged: Lagged, fresh: Arrays, history: Arrays) -> Value:
    stack = jnp.concatenate([fresh[lagged.name][None], history[lagged.name]])
    rank = lagged.lag.ndim
    return Value(picked(stack, [lagged.lag, *lagged.rest], rank), lagged.whole)


def _without_time(scope: Scope, plan: RecurrencePlan) -> Scope:
    """The names as they are at one time."""
    small: dict[str, Array] = {}
    for name, w in plan.written.items():
        array = scope.arrays[name]
        small[name] = array._replace(dims=array.dims[: w.dim] + array.dims[w.dim + 1 :])
    return replace(scope, arrays=scope.arrays | small)


def _timeless(step: MappingStep, plan: RecurrencePlan) -> MappingStep:
    """A step whose targets have no index of time."""

    def target(node: x.Name) -> x.Name:
        at = plan.written[node.name].dim
        return replace(node, indices=node.indices[:at] + node.indices[at + 1 :])

    what = step.what
    if isinstance(what, d.Assignment):
        return step._replace(what=replace(what, target=target(what.target)))
    outputs = tuple(replace(w, target=target(w.target)) for w in what.outputs)
    return step._replace(what=replace(what, outputs=outputs))
