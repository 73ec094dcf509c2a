"""Compiled mappings: outputs as JAX functions of inputs, and their derivatives."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.answer import MAX_ROWS_SHOWN, Table, answer
from beamfit.compile_cache import SELDOM
from beamfit.errors import InputError, nearest
from beamfit.greybox.maps import Formula
from beamfit.language import document as d
from beamfit.language import expression as x
from beamfit.language.evaluate import Context, assign, check_rank, evaluate
from beamfit.language.expression import error_at
from beamfit.language.plan import Order, StepGroup, check_mapping
from beamfit.language.scope import MappingStep, Scope, add_iterators, reads, values_of
from beamfit.language.steps import Arrays, defaults, run_call, scan_recurrence


@dataclass(frozen=True, eq=False)
class Program:
    """A mapping that can be computed.

    Tables and parameters are arguments of the compiled code (`constants`), so that programs with
    the same order are equal, whatever their tables contain, and share the code.
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
        """Transposed tables, and parameters with dimensions."""
        # Transposed, so that each column is contiguous: formulas read one column after the other.
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
            Inputs by name; those with values in the document may be omitted.
        names : iterable of str
            Names to compute.
        constants : dict, optional
            Replaces `constants`, as a traced argument of compiled code.

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
        """Compute formulas of the mapping's names, with an axis for each iterator."""
        pairs = [(e, add_iterators(self.scope, {}, each)) for e, each in formulas]
        names = {read.array.name for e, axes in pairs for read in reads(self.scope, e, axes)}
        arrays = self._arrays(inputs, names & set(self.order.owners), constants)
        found = []
        for e, axes in pairs:
            value = evaluate(e, Context(self.scope, arrays, axes))
            lengths = [len(one) for one in axes.values()]
            own = value.array.shape[len(axes) :]
            found.append(jnp.broadcast_to(value.array, (*lengths, *own)))
        return found

    def begin(self, inputs: Mapping[str, jax.Array], constants: Arrays | None = None) -> Arrays:
        """Return all arrays before the first step: given values, and zeros for computed ones."""
        given = defaults(self.scope) | {n: jnp.asarray(v, float) for n, v in inputs.items()}
        constants = self.constants if constants is None else constants
        arrays = {n: jnp.asarray(v) for n, v in constants.items()} | given
        arrays |= {n: arrays[n].T for n in self.tables}
        return arrays | {n: jnp.zeros(self.scope.arrays[n].shape) for n in self.order.owners}

    def _arrays(self, inputs, names: Iterable[str], constants: Arrays | None) -> Arrays:
        """Return all arrays after computing those on which some names depend."""
        arrays = self.begin(inputs, constants)
        for group in self.order.needed(names):
            arrays |= run_group(self.order, group, arrays)
        return arrays

    def as_map(self, outputs: Iterable[str] | None = None) -> Formula:
        """Make a map from elements of inputs to elements of outputs, with sensitivities and gains.

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

        names = ([a.element(i) for a in group for i in range(a.size)] for group in (inputs, chosen))
        return Formula(*names, function)


def compile_mapping(mapping: d.Mapping, tables: Mapping[str, np.ndarray] | None = None) -> Program:
    """Compile a mapping: check names, indices and order, then trace all formulas once.

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
        With its place in the document, for any error in it.
    """
    tables = tables or {}
    missing = [t for t in mapping.tables if t.name not in tables]
    if missing:
        raise error_at(missing[0].at, f"no data for table '{missing[0].name}'",
                       f"--data {missing[0].name}=FILE")  # fmt: skip
    program = Program(check_mapping(mapping, {n: np.shape(t) for n, t in tables.items()}), tables)
    _check_shapes(program)
    return program


@lru_cache(maxsize=64)
def _check_shapes(program: Program) -> None:
    """Trace all formulas, which finds errors in their shapes."""
    shapes = {n: jax.ShapeDtypeStruct(a.shape, float) for n, a in program.scope.inputs.items()}
    jax.eval_shape(lambda given: program(given, list(program.order.owners)), shapes)


# ---- running


def run_group(order: Order, group: StepGroup, arrays: Arrays) -> Arrays:
    """Compute the steps of a group, and return the arrays they change."""
    if group.plan is not None:
        return scan_recurrence(order.scope, group.plan, arrays, partial(_run_step, order))
    (step,) = group.steps
    return _run_step(order, step, Context(order.scope, arrays, step.axes))


def _run_step(order: Order, step: MappingStep, s: Context) -> Arrays:
    """Compute a step, and return the arrays it changes."""
    if isinstance(step.statement, d.Call):
        return run_call(step.statement, s, lambda label: Program(order.inner[label], {}))
    target, e = step.statement.target, step.statement.value
    array, old = s.scope.arrays[target.name], s.arrays[target.name]
    value = evaluate(e, s)
    check_rank(s.scope, target, array, value, e)
    return {target.name: assign(old, s.scope, array, target, s.axes, value, e)}


GAIN = re.compile(r"\s*d(\w+)\s*/\s*d(\w+)\s*")


@answer
@dataclass(frozen=True, eq=False)
class Computed:
    """Outputs of a mapping without an objective, and requested gains.

    Parameters
    ----------
    name : str
        Name of the mapping.
    scope : Scope
        Its names and indices.
    outputs, gains : mapping of str to array
        Values by output; derivatives by names such as ``dy/dx``, with the axes of the output
        before those of the input.
    """

    name: str
    scope: Scope
    outputs: Mapping[str, np.ndarray]
    gains: Mapping[str, np.ndarray]

    def tables(self) -> list[Table]:
        """List the elements of outputs and gains, up to the largest number of rows."""
        arrays = [(self.scope.outputs[n], v) for n, v in self.outputs.items()]
        rows = [[a.element(i), f"{v:.8g}"] for a, values in arrays for i, v in _numbered(values)]
        return [limit_rows(["output", "value"], rows), *gain_tables(self.scope, self.gains)]

    def to_json(self) -> dict[str, Any]:
        """Return the result of the JSON contract."""
        return {"name": self.name, "outputs": self.outputs, "gains": self.gains}


def _numbered(values: np.ndarray) -> Iterable[tuple[int, float]]:
    return enumerate(np.ravel(values).tolist())


def limit_rows(header: Sequence[str], rows: list[list[str]]) -> Table:
    """Make a table with at most `MAX_ROWS_SHOWN` rows."""
    more, rest = len(rows) - MAX_ROWS_SHOWN, [""] * (len(header) - 1)
    rows = rows[:MAX_ROWS_SHOWN] + [[f"... and {more} more", *rest]] * (more > 0)
    return Table("", header, rows, numeric=True)


def gain_tables(scope: Scope, gains: Mapping[str, np.ndarray]) -> list[Table]:
    """Make a table of all elements of derivatives; none without derivatives."""
    rows = []
    for name, values in gains.items():
        output, by = gain_parts(name)
        y, x = scope.outputs[output], scope.inputs[by]
        for i, v in _numbered(values):
            at = divmod(i, x.size)
            rows.append([f"d{y.element(at[0])}/d{x.element(at[1])}", f"{v:.8g}"])
    return [limit_rows(["gain", "value"], rows)] if rows else []


def gain_parts(gain: str) -> tuple[str, str]:
    """Split a derivative written ``dy/dx`` into output and input.

    Raises
    ------
    InputError
        If it has another form.

    Examples
    --------
    >>> gain_parts("dobj/dx1")
    ('obj', 'x1')
    """
    found = GAIN.fullmatch(gain)
    if not found:
        raise InputError(f"--derivative '{gain}'", "dOUTPUT/dINPUT, such as dy/dx")
    return found[1], found[2]


@partial(jax.jit, static_argnums=(0, 1), compiler_options=SELDOM)
def _outputs(program: Program, names: tuple[str, ...], given, constants) -> list[jax.Array]:
    found = program(given, names, constants)
    return [found[name] for name in names]


@partial(jax.jit, static_argnums=(0, 1, 2), compiler_options=SELDOM)
def _gain(program: Program, output: str, by: str, given, constants) -> jax.Array:
    def function(at):
        return program(given | {by: at}, [output], constants)[output]

    return jax.jacfwd(function)(given[by])


def outputs_at(program: Program, given: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Compute all outputs at values of the inputs, compiled once for each document."""
    names = tuple(program.scope.outputs)
    found = _outputs(program, names, dict(given), program.constants)
    return dict(zip(names, map(np.asarray, found), strict=True))


def gains_at(
    program: Program, given: Mapping[str, Any], gains: Iterable[str]
) -> dict[str, np.ndarray]:
    """Compute derivatives of outputs by inputs, written ``dy/dx``.

    Raises
    ------
    InputError
        If one has another form, or a name that the mapping does not have.
    """
    found, scope = {}, program.scope
    for gain in gains:
        output, by = gain_parts(gain)
        for name, face, kind in ((output, scope.outputs, "output"), (by, scope.inputs, "input")):
            if name not in face:
                expected = f"an {kind} of the document: {nearest(name, list(face))}"
                raise InputError(f"'{name}' in --derivative {gain}", expected)
        key = f"d{output}/d{by}"
        at = defaults(scope) | dict(given)
        found[key] = np.asarray(_gain(program, output, by, at, program.constants))
    return found


def compute_document(
    document: d.Document,
    tables: Mapping[str, np.ndarray] | None = None,
    values: Mapping[str, Sequence[float]] | None = None,
    gains: Iterable[str] = (),
) -> Computed:
    """Compute a mapping that has no objective.

    Parameters
    ----------
    document : Document
        The document of the mapping.
    tables : mapping of str to array, optional
        Its data tables by name.
    values : mapping of str to sequence of float, optional
        Values of inputs that replace the document's: one number, or all in C order.
    gains : iterable of str, optional
        Derivatives to compute, written ``dy/dx``.

    Returns
    -------
    Computed

    Raises
    ------
    InputError
        With its place in the document, for any error in it, or an input without a value.

    Examples
    --------
    >>> from beamfit.language.parse import parse_document
    >>> document = parse_document("input x[2]; output y; y = x[0]*x[1];")
    >>> found = compute_document(document, values={"x": [2, 3]}, gains=["dy/dx"])
    >>> found.outputs["y"].tolist(), found.gains["dy/dx"].tolist()
    (6.0, [3.0, 2.0])
    """
    program = compile_mapping(document.mapping, tables)
    given = values_of(program.scope, values or {})
    for a in program.scope.inputs.values():
        if a.values is None and a.name not in given:
            several = f", or {a.size} numbers with commas" * (a.size > 1)
            expected = f"--set {a.name}=NUMBER{several}"
            raise error_at(a.at, f"input '{a.text}' without a value", expected)
    outputs = outputs_at(program, given)
    gains = gains_at(program, given, gains)
    return Computed(document.mapping.name, program.scope, outputs, gains)
