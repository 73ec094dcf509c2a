"""A document as a problem to be solved: what is free, limited, and least squares."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.errors import nearest
from beamfit.greybox import problem as core
from beamfit.language import document as d
from beamfit.language import expression as x
from beamfit.language.compiled import Program, compile_mapping
from beamfit.language.expression import error_at

__all__ = ["Formulation", "Square", "formulate", "squares_of"]


class Square(NamedTuple):
    """A term of a sum of squares: weight times (body for all iterators) squared."""

    weight: float
    body: x.Expression
    each: tuple[x.Iterator, ...] = ()


@dataclass(frozen=True, eq=False)
class Formulation:
    """A document with its problem.

    `squares` says whether the whole objective is a sum of squares, which is then a record of
    residuals: the objective is `factor` times the cost of the problem. `program` computes the
    mapping; `notes` tell what was made of the document.
    """

    document: d.Document
    program: Program
    problem: core.Problem
    squares: bool
    factor: float
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Residuals:
    """The square roots of the terms of a sum of squares, as one vector."""

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
    """A function of (model, constants) that gives one array of a program."""

    program: Program
    name: str

    def __call__(self, model: Any, constants: Any) -> jax.Array:
        return self.program(model, [self.name], constants)[self.name]


def formulate(document: d.Document, tables: Mapping[str, np.ndarray] | None = None) -> Formulation:
    """State the problem of a document.

    An objective that is a sum of squares becomes a record of residuals without errors, so that
    least squares are used and the noise is inferred from them; anything else an objective.

    Parameters
    ----------
    document : Document
        With a problem.
    tables : mapping of str to array, optional
        Its data tables by name, shape (rows, columns).

    Returns
    -------
    Formulation

    Raises
    ------
    InputError
        With its place in the document, whatever is wrong with it.

    Examples
    --------
    >>> from beamfit.greybox.solve import solve
    >>> from beamfit.language.parse import parse_document
    >>> text = "minimize y; variable x in [0, 9]; input x; output y; y = (x - 2)^2 + (x - 4)^2;"
    >>> made = formulate(parse_document(text))
    >>> made.squares, round(solve(made.problem)["x"].value, 6)
    (True, 3.0)
    """
    p = document.problem
    if p is None or not p.goals:
        at = p.variables[0].at if p and p.variables else document.mapping.at
        raise error_at(at, "a document without an objective", "minimize NAME; or maximize NAME;")
    check_problem(document)
    weights = {goal.model: goal.weight * (-1 if p.maximize else 1) for goal in p.goals}
    parts = {name: squares_of(document.mapping, name, weight) for name, weight in weights.items()}
    least = all(part is not None for part in parts.values())
    program = compile_mapping(document.mapping, tables)
    free, model, notes = _free(document, program)
    constants = {n: jnp.asarray(v) for n, v in program.constants.items()}
    records, objectives = [], []
    for name, weight in weights.items():
        if least:
            predict = _Residuals(program, tuple(parts[name]))
            length = jax.eval_shape(predict, model, constants).shape
            records.append(core.Record(name, predict, constants, np.zeros(length)))
        else:
            objectives.append(core.Objective(name, _Output(program, name), constants, weight))
    limits = [
        core.Constraint(c.label, _Output(program, c.model), constants, c.lower, c.upper)
        for c in p.limits
    ]
    problem = core.Problem(model, free, records, (), limits, objectives)
    sign = -1.0 if p.maximize else 1.0
    notes += tuple(_unqualified(document))
    return Formulation(document, program, problem, least, 2.0 if least else sign, notes)


# ---- variables


def check_problem(document: d.Document) -> None:
    """Refuse names that the mapping has not, bounds that contradict, and inputs without a value."""
    p, m = document.problem, document.mapping
    faces = (p.variables, m.inputs, "input"), ((*p.goals, *p.limits), m.outputs, "output")
    for group, face, what in faces:
        known = [one.name for one in face]
        for one in group:
            if one.model not in known:
                found = f"no {what} '{one.model}' in the mapping"
                raise error_at(one.at, found, nearest(one.model, known))
    _check_variables(p)
    names = [v.model for v in p.variables]
    for one in m.inputs:
        if one.values is None and one.name not in names:
            expected = f"variable {one.name};, or input {one.name} = VALUE;"
            raise error_at(one.at, f"input '{one.name}' without a value", expected)


def _check_variables(p: d.Problem) -> None:
    for one in (*p.variables, *p.limits):
        if not one.lower <= one.upper:
            found = f"bounds of '{one.label}' from {one.lower:g} up to {one.upper:g}"
            raise error_at(one.at, found, "a lower bound that is not above the upper one")
    names = [v.model for v in p.variables]
    for v in p.variables:
        if names.count(v.model) > 1:
            raise error_at(v.at, f"variable '{v.model}' twice", "each variable once")
        low, high = v.random or (0.0, 0.0)
        if not (low <= high and math.isfinite(high - low)):
            found = f"a random start of '{v.label}' in [{low:g}, {high:g}]"
            raise error_at(v.at, found, "a finite range, the lower end first")


def _free(document: d.Document, program: Program) -> tuple[list, dict[str, np.ndarray], tuple]:
    """Free numbers, the model they start from, and what there is to say about them."""
    arrays = program.scope.inputs
    model = {n: np.reshape(np.asarray(a.values, float), a.shape) for n, a in arrays.items()
             if a.values is not None}  # fmt: skip
    free, notes = [], []
    _, used = program.order.closure([g.model for g in document.problem.goals]
                                    + [c.model for c in document.problem.limits])  # fmt: skip
    for v in document.problem.variables:
        shape = arrays[v.model].shape
        model[v.model] = first_start(v, shape, model.get(v.model))
        free.append(core.Free(v.model, v.lower, v.upper, v.random))
        if v.model not in used:
            notes.append(f"line {v.at.line}: nothing asked for hangs on the variable '{v.label}', "
                         "which stays where it starts.")  # fmt: skip
    return free, model, tuple(notes)


def first_start(v: d.Variable, shape: tuple[int, ...], given: np.ndarray | None) -> np.ndarray:
    """Where a search starts: drawn with the seed, or the value, or the middle of the bounds."""
    return next(_starts(v, shape, given))


def _starts(v: d.Variable, shape, given) -> Iterator[np.ndarray]:
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
    """The model at the first start, then at further draws of the same seeds, without end."""
    arrays, model = made.program.scope.inputs, dict(made.problem.core.model)
    draws = {}
    for v in made.document.problem.variables:
        a = arrays[v.model]
        given = None if a.values is None else np.reshape(a.values, a.shape)
        draws[v.model] = _starts(v, a.shape, given)
    while True:
        yield model | {name: next(draw) for name, draw in draws.items()}


def at_start(made: Formulation, model: dict[str, np.ndarray]) -> Formulation:
    """The same problem, begun from another model."""
    return replace(made, problem=replace(made.problem, model=model))


# ---- sums of squares


def squares_of(m: d.Mapping, name: str, weight: float = 1.0) -> list[Square] | None:
    """The terms of an output that is a sum of squares, None for any other."""
    set_by = {s.target.name: s.value for s in m.statements
              if isinstance(s, d.Assignment) and not s.each and not s.target.indices}  # fmt: skip

    def terms(e: x.Expression, factor: float, seen: tuple[str, ...]) -> list[Square] | None:
        match e:
            case x.Name(n, ()) if n in set_by and n not in seen:
                return terms(set_by[n], factor, (*seen, n))
            case x.Operation("^", (body, x.Number() as two)) if two.value == 2.0 and factor > 0:
                return [Square(factor, body)]
            case x.Operation("+", (left, right)):
                both = terms(left, factor, seen), terms(right, factor, seen)
                return None if None in both else both[0] + both[1]
            case x.Operation("*", (x.Number() as n, inner)):
                return terms(inner, factor * n.value, seen)
            case x.Operation("/", (inner, x.Number() as n)) if n.value != 0:
                return terms(inner, factor / n.value, seen)
            case x.Reduction("sum", each, inner):
                found = terms(inner, factor, seen)
                return found and [s._replace(each=(*each, *s.each)) for s in found]
        return None

    return terms(x.Name(name), weight, ())


def _unqualified(document: d.Document) -> Iterator[str]:
    """Limits on sums of squares that only zero meets: where they hold, they have no gradient."""
    for c in document.problem.limits:
        squares = squares_of(document.mapping, c.model)
        if squares is not None and c.upper == 0.0:
            yield (
                f"line {c.at.line}: '{c.label}' is a sum of squares limited to 0. Where it holds "
                "its gradient is zero (no constraint qualification): it has no multiplier and a "
                f"search crawls. Limit what is squared, {squares[0].body}, element by element."
            )
