"""A mapping computed: outputs at given inputs, and their derivatives by them."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.answer import answer
from beamfit.compile_cache import SELDOM
from beamfit.errors import InputError, nearest
from beamfit.language import document as d
from beamfit.language.calls import defaults
from beamfit.language.compiled import Program, compile_mapping
from beamfit.language.expression import error_at
from beamfit.language.scope import Scope
from beamfit.table import MOST_ROWS, Table

GAIN = re.compile(r"\s*d(\w+)\s*/\s*d(\w+)\s*")


@answer
@dataclass(frozen=True, eq=False)
class Computed:
    """Outputs of a mapping without an objective, and the gains that were asked for.

    Parameters
    ----------
    name : str
        Of the mapping.
    scope : Scope
        Its names and indices.
    outputs, gains : mapping of str to array
        Values by output; derivatives by their names, such as ``dy/dx``, the axes of the output
        before those of the input.
    """

    name: str
    scope: Scope
    outputs: Mapping[str, np.ndarray]
    gains: Mapping[str, np.ndarray]

    def tables(self) -> list[Table]:
        """Every element of outputs and gains, as far as a terminal shows them."""
        arrays = [(self.scope.outputs[n], v) for n, v in self.outputs.items()]
        rows = [[a.element(i), f"{v:.8g}"] for a, values in arrays for i, v in _each(values)]
        return [limited("output", rows), *gain_tables(self.scope, self.gains)]

    def to_json(self) -> dict[str, Any]:
        """The result of the JSON contract."""
        return {"name": self.name, "outputs": self.outputs, "gains": self.gains}


def _each(values: np.ndarray) -> Iterable[tuple[int, float]]:
    return enumerate(np.ravel(values).tolist())


def limited(name: str, rows: list[list[str]]) -> Table:
    """A table of names and values with no more rows than a terminal shows."""
    more = len(rows) - MOST_ROWS
    rows = rows[:MOST_ROWS] + [[f"... and {more} more", ""]] * (more > 0)
    return Table("", [name, "value"], rows, numeric=True)


def gain_tables(scope: Scope, gains: Mapping[str, np.ndarray]) -> list[Table]:
    """Every element of derivatives in a table, none if none were asked for."""
    rows = []
    for name, values in gains.items():
        output, by = parts_of(name)
        y, x = scope.outputs[output], scope.inputs[by]
        for i, v in _each(values):
            at = divmod(i, x.size)
            rows.append([f"d{y.element(at[0])}/d{x.element(at[1])}", f"{v:.8g}"])
    return [limited("gain", rows)] if rows else []


def parts_of(gain: str) -> tuple[str, str]:
    """Output and input of a derivative written ``dy/dx``.

    Raises
    ------
    InputError
        If it is not written so.

    Examples
    --------
    >>> parts_of("dobj/dx1")
    ('obj', 'x1')
    """
    found = GAIN.fullmatch(gain)
    if not found:
        raise InputError(f"--derivative '{gain}'", "dOUTPUT/dINPUT, such as dy/dx")
    return found[1], found[2]


def values_of(scope: Scope, given: Mapping[str, Sequence[float]]) -> dict[str, np.ndarray]:
    """Arrays of inputs from one number each, or as many as it has elements, in C order.

    Raises
    ------
    InputError
        If a name is no input of the mapping, or the count is another one.
    """
    found = {}
    for name, numbers in given.items():
        if name not in scope.inputs:
            expected = f"an input of the document: {nearest(name, list(scope.inputs))}"
            raise InputError(f"--set {name}=...", expected)
        a = scope.inputs[name]
        if len(numbers) not in (1, a.size):
            expected = f"one, or {a.size} for {a.said}"
            raise InputError(f"{len(numbers)} numbers in --set {name}=...", expected)
        found[name] = np.broadcast_to(np.asarray(numbers, float), (a.size,)).reshape(a.shape)
    return found


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
    """All outputs at values of the inputs, compiled once for each document."""
    names = tuple(program.scope.outputs)
    found = _outputs(program, names, dict(given), _constants(program))
    return dict(zip(names, map(np.asarray, found), strict=True))


def gains_at(
    program: Program, given: Mapping[str, Any], gains: Iterable[str]
) -> dict[str, np.ndarray]:
    """Derivatives of outputs by inputs, written ``dy/dx``.

    Raises
    ------
    InputError
        If one is not written so, or asks for what the mapping has not.
    """
    found, scope = {}, program.scope
    given = defaults(scope) | {n: jnp.asarray(v, float) for n, v in given.items()}
    for gain in gains:
        output, by = parts_of(gain)
        for name, face, what in ((output, scope.outputs, "output"), (by, scope.inputs, "input")):
            if name not in face:
                expected = f"an {what} of the document: {nearest(name, list(face))}"
                raise InputError(f"'{name}' in --derivative {gain}", expected)
        key = f"d{output}/d{by}"
        found[key] = np.asarray(_gain(program, output, by, given, _constants(program)))
    return found


def _constants(program: Program) -> dict[str, jax.Array]:
    return {n: jnp.asarray(v) for n, v in program.constants.items()}


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
        Its mapping is computed.
    tables : mapping of str to array, optional
        Its data tables by name.
    values : mapping of str to sequence of float, optional
        Values of inputs in the place of the document's: one number, or all in C order.
    gains : iterable of str, optional
        Derivatives to compute, written ``dy/dx``.

    Returns
    -------
    Computed

    Raises
    ------
    InputError
        With its place in the document, whatever is wrong with it; also if an input has no value.

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
            raise error_at(a.at, f"input '{a.said}' without a value", expected)
    outputs = outputs_at(program, given)
    gains = gains_at(program, given, gains)
    return Computed(document.mapping.name, program.scope, outputs, gains)
