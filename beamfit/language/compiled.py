"""A mapping as a JAX function of its inputs: steps in order, calls over all points at once."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.errors import nearest
from beamfit.greybox.maps import Formula
from beamfit.language import document as d
from beamfit.language import expression as x
from beamfit.language.evaluate import Setting, Value, evaluate, picked, placed
from beamfit.language.expression import error_at
from beamfit.language.network import with_weights
from beamfit.language.order import Group, Order, checked
from beamfit.language.recurrence import scanned
from beamfit.language.scope import (
    Array,
    Axes,
    IndexSet,
    Net,
    Scope,
    Step,
    located,
    reads,
    whole_of,
    widened,
)
from beamfit.language.steps import calls, gains_of

__all__ = ["Program", "compile_mapping"]

Arrays = dict[str, jax.Array]


@dataclass(frozen=True, eq=False)
class Program:
    """A mapping that can be computed.

    `constants` are tables and parameters; they are arguments, so that code does not hang on them.
    """

    order: Order
    tables: Mapping[str, np.ndarray]

    @property
    def scope(self) -> Scope:
        """Its names."""
        return self.order.scope

    @cached_property
    def constants(self) -> Arrays:
        """Tables, and parameters with dimensions."""
        found = {name: np.asarray(table, float) for name, table in self.tables.items()}
        for a in self.scope.arrays.values():
            if a.role == "parameter" and a.dims:
                found[a.name] = np.asarray(a.values, float).reshape(a.shape)
        return found

    def __call__(
        self, inputs: Mapping[str, jax.Array], names: Iterable[str], constants: Arrays | None = None
    ) -> Arrays:
        """Compute outputs or local variables.

        Parameters
        ----------
        inputs : mapping of str to array
            By name; those that the document gives values to may be left out.
        names : iterable of str
            What to compute.
        constants : dict, optional
            `constants`, as an argument of compiled code.

        Returns
        -------
        dict of str to array

        Examples
        --------
        >>> from beamfit.language.parse import parse_document
        >>> text = "set K = |1:3|; input a; output y[K]; y[k] = a*k foreach k in K;"
        >>> compile_mapping(parse_document(text).mapping)({"a": 2.0}, ["y"])["y"].tolist()
        [2.0, 4.0, 6.0]
        """
        names = list(names)
        arrays = self._arrays(inputs, names, constants)
        return {name: arrays[name] for name in names}

    def formulas(
        self,
        inputs: Mapping[str, jax.Array],
        formulas: Iterable[tuple[x.Expression, tuple[x.Iterator, ...]]],
        constants: Arrays | None = None,
    ) -> list[jax.Array]:
        """Compute formulas in the names of the mapping, with an axis for each iterator."""
        pairs = [(e, widened(self.scope, {}, each)) for e, each in formulas]
        names = {read.array.name for e, axes in pairs for read in reads(self.scope, e, axes)}
        arrays = self._arrays(inputs, names & set(self.order.owners), constants)
        found = []
        for e, axes in pairs:
            value = evaluate(e, Setting(self.scope, arrays, axes))
            lengths = [len(one) for one in axes.values()]
            own = value.array.shape[len(axes) :]
            found.append(jnp.broadcast_to(value.array, (*lengths, *own)))
        return found

    def _arrays(self, inputs, names: Iterable[str], constants: Arrays | None) -> Arrays:
        """All arrays, of which those that some names hang on are computed."""
        given = _defaults(self.scope) | {n: jnp.asarray(v, float) for n, v in inputs.items()}
        constants = self.constants if constants is None else constants
        arrays = {n: jnp.asarray(v) for n, v in constants.items()} | given
        for name in self.order.owners:
            arrays[name] = jnp.zeros(self.scope.arrays[name].shape)
        wanted, _ = self.order.closure(names)
        for group in self.order.groups:
            if not wanted.isdisjoint(step.number for step in group.steps):
                arrays |= _carry_out(self.order, group, arrays)
        return arrays

    def as_map(self, outputs: Iterable[str] | None = None) -> Formula:
        """Elements of the inputs to elements of outputs, as a map with sensitivities and gains.

        Examples
        --------
        >>> from beamfit.greybox.gains import gain
        >>> from beamfit.language.parse import parse_document
        >>> m = compile_mapping(parse_document("input x; output y; y = x^3;").mapping).as_map()
        >>> float(gain(m, jnp.array([2.0]), "y", ["x", "x"]))
        12.0
        """
        inputs = list(self.scope.inputs.values())
        chosen = [self.scope.outputs[n] for n in outputs or self.scope.outputs]
        ends = np.cumsum([a.size for a in inputs])[:-1]

        def function(_, v):
            parts = jnp.split(v, ends)
            given = {a.name: p.reshape(a.shape) for a, p in zip(inputs, parts, strict=True)}
            found = self(given, [a.name for a in chosen])
            return jnp.concatenate([jnp.ravel(found[a.name]) for a in chosen])

        faces = ([a.element(i) for a in group for i in range(a.size)] for group in (inputs, chosen))
        return Formula(*faces, function)


def compile_mapping(mapping: d.Mapping, tables: Mapping[str, np.ndarray] | None = None) -> Program:
    """Compile a mapping: check names, indices and order, then trace every formula once.

    Parameters
    ----------
    mapping : Mapping
        From a document.
    tables : mapping of str to array, optional
        Its data tables by name, shape (rows, columns).

    Returns
    -------
    Program

    Raises
    ------
    InputError
        With its place in the document, whatever is wrong with it.
    """
    tables = tables or {}
    missing = [t for t in mapping.tables if t.name not in tables]
    if missing:
        raise error_at(missing[0].at, f"no data for table '{missing[0].name}'",
                       f"--data {missing[0].name}=FILE")  # fmt: skip
    program = Program(checked(mapping, {n: np.shape(t) for n, t in tables.items()}), tables)
    shapes = {n: jax.ShapeDtypeStruct(a.shape, float) for n, a in program.scope.inputs.items()}
    jax.eval_shape(lambda given: program(given, list(program.order.owners)), shapes)
    return program


# ---- running


def _carry_out(order: Order, group: Group, arrays: Arrays, watch=None) -> Arrays:
    """Compute the steps of a group, and give the arrays they change."""
    if group.plan is not None:
        return scanned(order.scope, group.plan, arrays, partial(_assigned, order))
    (step,) = group.steps
    return _assigned(order, step, Setting(order.scope, arrays, step.axes, watch=watch))


def _assigned(order: Order, step: Step, s: Setting) -> Arrays:
    """The arrays that a step changes."""
    if isinstance(step.what, d.Call):
        return _called(order, step, s)
    target = step.what.target
    value = evaluate(step.what.value, s)
    return {target.name: _set(s, target, s.axes, value, step.what.value)}


def _set(s: Setting, target: x.Name, axes: Axes, value: Value, e: x.Expression) -> jax.Array:
    """An array of the mapping with a value set where the target says."""
    array = s.scope.arrays[target.name]
    old = s.arrays[target.name]
    return _into(s.scope, old, array, target, axes, value, e)


def _into(scope, old, array: Array, target: x.Name, axes: Axes, value: Value, e) -> jax.Array:
    indices = located(scope, target, array, axes)
    whole = whole_of(target, array)
    if value.rank not in (0, len(whole)):
        said = f"'{e}' of {value.rank} dimensions"
        number = f"a number, such as an element, for '{target}'"
        wanted = f"{len(whole)} as in '{target}'" if whole else number
        raise error_at(e.at, said, wanted)
    lengths = [*map(len, axes.values()), *map(len, whole)]
    if value.rank and value.array.shape[-value.rank :] != tuple(map(len, whole)):
        size = " x ".join(map(str, value.array.shape[-value.rank :]))
        raise error_at(e.at, f"'{e}' of {size}", f"the size of {array.said}")
    filled = value.array.reshape(*value.array.shape, *[1] * (len(whole) - value.rank))
    return placed(old, indices, filled, lengths)


# ---- calls


def _called(order: Order, step: Step, s: Setting) -> Arrays:
    """Call a mapping for all combinations of iterators at once."""
    call = calls(s.scope, step.what)
    axes = s.axes
    given = {}
    for name, array in call.callee.inputs.items():
        wires = [w for w in call.statement.inputs if w.target.name == name]
        if wires:
            given[name] = _wired(s, array, wires)
    names = [gains_of(w, call.callee, call.statement.mapping) for w in call.statement.outputs]
    lengths = [len(one) for one in axes.values()]
    batched = {n: a.shape[: len(axes)] != (1,) * len(axes) for n, a in given.items()}
    flat = {n: _points(a, lengths, batched[n]) for n, a in given.items()}
    function = _function(order, s, call.statement.mapping, call.callee, names)
    if any(batched.values()):
        function = jax.vmap(function, in_axes=({n: 0 if b else None for n, b in batched.items()},))
    found = function(flat)
    made: Arrays = {}
    for wire, value in zip(call.statement.outputs, found, strict=True):
        own = value.shape[1:] if any(batched.values()) else value.shape
        head = lengths if any(batched.values()) else [1] * len(axes)
        whole = Value(value.reshape(*head, *own), len(own))
        inner = widened(s.scope, axes, wire.each)
        output = gains_of(wire, call.callee, call.statement.mapping)[0]
        picked_ = _output(s, whole, output, call.callee, inner, len(axes))
        arrays = {**s.arrays, **made}
        name = wire.target.name
        made[name] = _into(
            s.scope, arrays[name], s.scope.arrays[name], wire.target, inner, picked_, wire.value
        )
    return made


def _wired(s: Setting, array: Array, wires: list[d.Wire]) -> jax.Array:
    """An input of what is called: one axis for each iterator of the call, then its dimensions."""
    count = len(s.axes)
    found = None
    for wire in wires:
        inner = widened(s.scope, s.axes, wire.each)
        value = evaluate(wire.value, Setting(s.scope, s.arrays, inner, s.bound, s.known, s.watch))
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
        found = _into(s.scope, found, outer, target, {**lead, **own}, value, wire.value)
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


def _function(order: Order, s: Setting, label: str, callee, wanted) -> Callable:
    """What is called as a function of its inputs, giving outputs and gains in order."""
    names = sorted({output.name for output, _ in wanted})

    def outputs(given: Arrays) -> Arrays:
        if isinstance(callee, Net):
            return _network(callee, given)
        return Program(order.inner[label], {})(given, names)

    def function(given: Arrays) -> tuple[jax.Array, ...]:
        plain = outputs(given) if any(not by for _, by in wanted) else {}
        full = _defaults(callee) | given
        return tuple(
            _gain(s, callee, outputs, full, output, by) if by else plain[output.name]
            for output, by in wanted
        )

    return function


def _defaults(callee: Scope | Net) -> Arrays:
    given = {n: a for n, a in callee.inputs.items() if a.values is not None}
    return {n: jnp.asarray(a.values, float).reshape(a.shape) for n, a in given.items()}


def _network(callee: Net, given: Arrays) -> Arrays:
    net = callee.mlp
    if "weights" in given:
        net = with_weights(net, given["weights"])
    found = net(jnp.stack([given[name] for name in net.inputs]))
    return dict(zip(net.outputs, found, strict=True))


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
        if e.name not in given:
            raise error_at(e.at, f"no input '{e.name}'", nearest(e.name, list(given)))
        function = derivative(function, e)
    return function(given)
