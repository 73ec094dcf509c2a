"""Translation of a document to a `beamfit.greybox.problem.Problem`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.greybox import problem as core
from beamfit.language import document as d
from beamfit.language import expression as x
from beamfit.language.compiled import Program, compile_mapping
from beamfit.language.expression import error_at
from beamfit.language.scope import check_problem, values_of


class Square(NamedTuple):
    """Terms of a sum of squares: weight times body squared, for all values of the iterators."""

    weight: float
    body: x.Expression
    each: tuple[x.Iterator, ...] = ()


def squares_of(m: d.Mapping, name: str, weight: float = 1.0) -> list[Square] | None:
    """Split an output that is a sum of squares into its terms; None for any other output."""
    set_by = {s.target.name: s.value for s in m.statements
              if isinstance(s, d.Assignment) and not s.each and not s.target.indices}  # fmt: skip

    def terms(e: x.Expression, factor: float, visited: tuple[str, ...]) -> list[Square] | None:
        match e:
            case x.Name(n, ()) if n in set_by and n not in visited:
                return terms(set_by[n], factor, (*visited, n))
            case x.Arithmetic("^", (body, x.Literal() as two)) if two.value == 2.0 and factor > 0:
                return [Square(factor, body)]
            case x.Arithmetic("+", (left, right)):
                both = terms(left, factor, visited), terms(right, factor, visited)
                return None if None in both else both[0] + both[1]
            case x.Arithmetic("*", (x.Literal() as n, inner)):
                return terms(inner, factor * n.value, visited)
            case x.Arithmetic("/", (inner, x.Literal() as n)) if n.value != 0:
                return terms(inner, factor / n.value, visited)
            case x.Reduction("sum", each, inner):
                found = terms(inner, factor, visited)
                return found and [s._replace(each=(*each, *s.each)) for s in found]
        return None

    return terms(x.Name(name), weight, ())


@dataclass(frozen=True, eq=False)
class Formulation:
    """A document with its problem.

    `program` computes the mapping. `squares` is true if the whole objective is a sum of squares,
    which is then a record of residuals. The objective is `factor` times the cost of the problem.
    `notes` has remarks on the translation.
    """

    document: d.Document
    program: Program
    problem: core.Problem
    squares: bool
    factor: float
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Residuals:
    """Function of (model, constants) to the residuals of a sum of squares, as one vector."""

    program: Program
    squares: tuple[Square, ...]

    def __call__(self, model: Any, constants: Any) -> jax.Array:
        formulas = [(square.body, square.each) for square in self.squares]
        found = self.program.formulas(model, formulas, constants)
        # The cost of a problem is half the sum of squares.
        roots = [math.sqrt(square.weight) for square in self.squares]
        return jnp.concatenate([root * jnp.ravel(v) for root, v in zip(roots, found, strict=True)])


@dataclass(frozen=True)
class _Output:
    """Function of (model, constants) to one array of a program."""

    program: Program
    name: str

    def __call__(self, model: Any, constants: Any) -> jax.Array:
        return self.program(model, [self.name], constants)[self.name]


def formulate(
    document: d.Document,
    tables: Mapping[str, np.ndarray] | None = None,
    values: Mapping[str, Sequence[float]] | None = None,
    tolerance: float = core.TOLERANCE,
) -> Formulation:
    """Translate a document to a problem.

    An objective that is a sum of squares over a set becomes a record of residuals without errors.
    It is solved by least squares, and the noise is inferred from the residuals.

    Parameters
    ----------
    document : Document
        A document with a problem.
    tables : mapping of str to array, optional
        Its data tables by name, shape (rows, columns).
    values : mapping of str to sequence of float, optional
        Values of inputs that replace the document's: one number, or all in C order. For a variable
        it is the start of the search.
    tolerance : float
        Tolerance of the problem.

    Returns
    -------
    Formulation

    Raises
    ------
    InputError
        With its place in the document, for any error in it.

    Examples
    --------
    >>> from beamfit.greybox.solve import solve
    >>> from beamfit.language.parse import parse_document
    >>> text = "minimize y; variable x; input x; output y; y = sum(k in |2:4| | (x - k)^2);"
    >>> made = formulate(parse_document(text))
    >>> made.squares, round(solve(made.problem)["x"].value, 6)
    (True, 3.0)
    """
    p = document.problem
    if p is None or not p.goals:
        at = p.variables[0].at if p and p.variables else document.mapping.at
        raise error_at(at, "a document without an objective", "minimize NAME; or maximize NAME;")
    values = values or {}
    check_problem(document, values)
    document = _with_given_starts(document, values)
    weights = {goal.model: goal.weight * (-1 if p.maximize else 1) for goal in p.goals}
    parts = {name: squares_of(document.mapping, name, weight) for name, weight in weights.items()}
    # Single squares are penalties, not data: errors inferred from them would have no meaning.
    squares = all(parts.values()) and any(s.each for part in parts.values() for s in part)
    program = compile_mapping(document.mapping, tables)
    free, model, notes = _free_numbers(document, program)
    model |= values_of(program.scope, values)
    constants = program.constants
    records, objectives = [], []
    for name, weight in weights.items():
        if squares:
            predict = _Residuals(program, tuple(parts[name]))
            length = core.shape_of(predict, model, constants)
            records.append(core.Record(name, predict, constants, np.zeros(length)))
        else:
            objectives.append(core.Objective(name, _Output(program, name), constants, weight))
    limits = []
    for c in p.limits:
        names, limited = _names(c, program.scope.outputs[c.model]), _Output(program, c.model)
        limits.append(core.Constraint(c.label, limited, constants, c.lower, c.upper, names))
    problem = core.Problem(model, free, records, (), limits, objectives, tolerance)
    sign = -1.0 if p.maximize else 1.0
    notes += tuple(_warn_degenerate(document))
    return Formulation(document, program, problem, squares, 2.0 if squares else sign, notes)


def _with_given_starts(document: d.Document, values: Mapping[str, Sequence[float]]) -> d.Document:
    """Replace the starts of variables by given values."""
    if values.keys().isdisjoint(v.model for v in document.problem.variables):
        return document
    variables = tuple(
        replace(v, random=None, value=values[v.model][0]) if v.model in values else v
        for v in document.problem.variables
    )
    return replace(document, problem=replace(document.problem, variables=variables))


# ---- variables


def _names(declared: d.FreeInput | d.Limit, array: Any) -> tuple[str, ...]:
    """Name each element of a variable or limited output, with the document's indices."""
    elements = (array.element(i).removeprefix(declared.model) for i in range(array.size))
    return tuple(declared.label + element for element in elements)


def _free_numbers(
    document: d.Document, program: Program
) -> tuple[list, dict[str, np.ndarray], tuple]:
    """Collect the free numbers, the model with their starts, and remarks."""
    arrays = program.scope.inputs
    model = {n: np.reshape(np.asarray(a.values, float), a.shape) for n, a in arrays.items()
             if a.values is not None}  # fmt: skip
    free, notes = [], []
    _, used = program.order.closure([g.model for g in document.problem.goals]
                                    + [c.model for c in document.problem.limits])  # fmt: skip
    for v in document.problem.variables:
        shape = arrays[v.model].shape
        model[v.model] = next(_starts(v, shape, model.get(v.model)))
        names = _names(v, arrays[v.model])
        notes += _warn_outside(v, arrays[v.model].values)
        free.append(core.Free(v.model, v.lower, v.upper, v.random, labels=names))
        if v.model not in used:
            notes.append(f"At {v.at}: nothing asked for hangs on the variable '{v.label}', "
                         "which stays where it starts.")  # fmt: skip
    return free, model, tuple(notes)


def _warn_outside(v: d.FreeInput, given: Sequence[float] | None) -> list[str]:
    """Warn of a variable whose start lies outside its bounds."""
    starts = v.random or ((v.value,) if v.value is not None else given or (v.lower, v.upper))
    bad = next((x for x in starts if not v.lower <= x <= v.upper), None)
    if bad is None:
        return []
    low, high = v.random or (bad, bad)
    text = f"random starts in [{low:g}, {high:g}]" if v.random else f"start {bad:g}"
    return [
        f"At {v.at}: '{v.label}' has the {text} outside its bounds [{v.lower:g}, {v.upper:g}]; the "
        "search begins on the bound. State a start within them, or widen them."
    ]


def _starts(v: d.FreeInput, shape, given) -> Iterator[np.ndarray]:
    """Yield starts: drawn with the seed, else the value, else the middle of the bounds."""
    random = np.random.default_rng(v.seed)
    while v.random is not None:
        yield np.clip(random.uniform(*v.random, size=shape), v.lower, v.upper)
    value = v.value
    if value is None and given is not None:
        value = given
    if value is None:
        ends = [end for end in (v.lower, v.upper) if math.isfinite(end)]
        value = sum(ends) / len(ends) if ends else 0.0
    while True:
        yield np.clip(np.broadcast_to(np.asarray(value, float), shape), v.lower, v.upper)


def starts_of(made: Formulation) -> Iterator[dict[str, np.ndarray]]:
    """Yield the model at the first start, then at further draws with its seeds, without end."""
    arrays, model = made.program.scope.inputs, dict(made.problem.core.model)
    draws = {}
    for v in made.document.problem.variables:
        a = arrays[v.model]
        given = None if a.values is None else np.reshape(a.values, a.shape)
        draws[v.model] = _starts(v, a.shape, given)
    while True:
        yield model | {name: next(draw) for name, draw in draws.items()}


def _warn_degenerate(document: d.Document) -> Iterator[str]:
    """Warn of sums of squares limited to zero: their gradient vanishes where the limit holds."""
    for c in document.problem.limits:
        squares = squares_of(document.mapping, c.model)
        if squares is not None and c.upper == 0.0:
            yield (
                f"At {c.at}: '{c.label}' is a sum of squares limited to 0. Where it holds "
                "its gradient is zero (no constraint qualification): it has no multiplier and a "
                f"search crawls. Limit what is squared, {squares[0].body}, element by element."
            )
