"""A mapping as a JAX function of its inputs: steps in order, calls over all points at once."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.greybox.maps import Formula
from beamfit.language import document as d
from beamfit.language import expression as x
from beamfit.language.calls import Arrays, called, defaults
from beamfit.language.evaluate import Setting, check_rank, evaluate, stored
from beamfit.language.expression import error_at
from beamfit.language.order import Order, StepGroup, checked
from beamfit.language.recurrence import scanned
from beamfit.language.scope import MappingStep, Scope, reads, widened


@dataclass(frozen=True, eq=False)
class Program:
    """A mapping that can be computed.

    `constants` are tables, their columns first, and parameters; they are arguments, so that code
    does not hang on them: programs of one order are equal, whatever is in their tables.
    """

    order: Order
    tables: Mapping[str, np.ndarray]

    def __hash__(self) -> int:
        return id(self.order)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Program) and self.order is other.order

    @property
    def scope(self) -> Scope:
        """Names of the mapping."""
        return self.order.scope

    @cached_property
    def constants(self) -> Arrays:
        """Tables, and parameters with dimensions."""
        # Columns are read one by one: each lies in one piece of memory.
        tables = {name: np.asarray(table, float) for name, table in self.tables.items()}
        found = {name: np.ascontiguousarray(table.T) for name, table in tables.items()}
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

    def begin(self, inputs: Mapping[str, jax.Array], constants: Arrays | None = None) -> Arrays:
        """All arrays before the first step: what is given, and zeros where steps set something."""
        given = defaults(self.scope) | {n: jnp.asarray(v, float) for n, v in inputs.items()}
        constants = self.constants if constants is None else constants
        arrays = {n: jnp.asarray(v) for n, v in constants.items()} | given
        arrays |= {n: arrays[n].T for n in self.tables}
        return arrays | {n: jnp.zeros(self.scope.arrays[n].shape) for n in self.order.owners}

    def _arrays(self, inputs, names: Iterable[str], constants: Arrays | None) -> Arrays:
        """All arrays, of which those that some names hang on are computed."""
        arrays = self.begin(inputs, constants)
        for group in self.order.needed(names):
            arrays |= carry_out(self.order, group, arrays)
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
    _traced(program)
    return program


@lru_cache(maxsize=64)
def _traced(program: Program) -> None:
    """Trace every formula, which finds what is wrong with its shapes."""
    shapes = {n: jax.ShapeDtypeStruct(a.shape, float) for n, a in program.scope.inputs.items()}
    jax.eval_shape(lambda given: program(given, list(program.order.owners)), shapes)


# ---- running


def carry_out(order: Order, group: StepGroup, arrays: Arrays, watch=None) -> Arrays:
    """Compute the steps of a group, and give the arrays they change."""
    if group.plan is not None:
        return scanned(order.scope, group.plan, arrays, partial(_assigned, order))
    (step,) = group.steps
    return _assigned(order, step, Setting(order.scope, arrays, step.axes, watch=watch))


def _assigned(order: Order, step: MappingStep, s: Setting) -> Arrays:
    """The arrays that a step changes."""
    if isinstance(step.what, d.Call):
        return called(step.what, s, lambda label: Program(order.inner[label], {}))
    target, e = step.what.target, step.what.value
    array, old = s.scope.arrays[target.name], s.arrays[target.name]
    value = evaluate(e, s)
    check_rank(s.scope, target, array, value, e)
    return {target.name: stored(old, s.scope, array, target, s.axes, value, e)}
