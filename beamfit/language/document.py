"""A document: a mapping of statements, what is to be optimised with it, and by which solver."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from beamfit.language.expression import PLACE, Elements, Expression, Iterator, Name, Place

# ---- statements


@dataclass(frozen=True)
class IndexedSet:
    """``set K = |1:14|;``"""

    name: str
    elements: Elements
    at: Place = field(**PLACE)


@dataclass(frozen=True)
class Real:
    """``real A[K];``, with a value if one follows: a dimension is a set or a size."""

    name: str
    dimensions: tuple[str | int, ...] = ()
    value: Expression | None = None
    at: Place = field(**PLACE)


@dataclass(frozen=True)
class Function:
    """``function square(x) = x^2;``"""

    name: str
    arguments: tuple[str, ...]
    body: Expression
    at: Place = field(**PLACE)


@dataclass(frozen=True)
class Assignment:
    """``y[k] = 2*x[k] foreach k in K;``

    In a call: an input and its value, or a variable and an output.
    """

    target: Name
    value: Expression
    each: tuple[Iterator, ...] = ()
    at: Place = field(**PLACE)


@dataclass(frozen=True)
class Call:
    """``Transfer(I = I_2[k] :: A[k] = A_T) foreach k in K;``"""

    mapping: str
    inputs: tuple[Assignment, ...]
    outputs: tuple[Assignment, ...]
    each: tuple[Iterator, ...] = ()
    at: Place = field(**PLACE)


@dataclass(frozen=True)
class Block:
    """``foreach k in K { ... }``"""

    each: tuple[Iterator, ...]
    statements: tuple[Statement, ...]
    at: Place = field(**PLACE)


Statement = IndexedSet | Real | Function | Assignment | Call | Block


# ---- a mapping


@dataclass(frozen=True)
class Declared:
    """An input, an output or a parameter: name, dimensions, and values in C order if given."""

    name: str
    dimensions: tuple[str | int, ...] = ()
    values: tuple[float, ...] | None = None
    at: Place = field(**PLACE)


@dataclass(frozen=True)
class DataTable:
    """A table of numbers in a file, with the rows and columns it should have."""

    name: str
    file: str
    rows: int | None = None
    columns: int | None = None
    at: Place = field(**PLACE)


@dataclass(frozen=True)
class NetworkElement:
    """A layer, connection, input, output or gain of a network, as the report writes it."""

    kind: str
    attributes: tuple[tuple[str, str], ...]
    values: tuple[float, ...] | None = None
    at: Place = field(**PLACE)


@dataclass(frozen=True)
class NetworkDefinition:
    """A multi-layer perceptron (report 3.1.3)."""

    name: str
    parts: tuple[NetworkElement, ...]
    at: Place = field(**PLACE)


@dataclass(frozen=True)
class Mapping:
    """Inputs to outputs by expressions; other mappings and networks inside are called by name."""

    name: str = ""
    tables: tuple[DataTable, ...] = ()
    mappings: tuple[Mapping | NetworkDefinition, ...] = ()
    inputs: tuple[Declared, ...] = ()
    outputs: tuple[Declared, ...] = ()
    parameters: tuple[Declared, ...] = ()
    statements: tuple[Statement, ...] = ()
    at: Place = field(**PLACE)


# ---- the problem


@dataclass(frozen=True)
class FreeInput:
    """An input that is free: bounds, and where searches start.

    `random` is the range of a start drawn with `seed`; without it the start is `value`.
    """

    label: str
    model: str
    lower: float = -math.inf
    upper: float = math.inf
    value: float | None = None
    random: tuple[float, float] | None = None
    seed: int = 0
    at: Place = field(**PLACE)


@dataclass(frozen=True)
class Limit:
    """An output that is limited."""

    label: str
    model: str
    lower: float = -math.inf
    upper: float = math.inf
    at: Place = field(**PLACE)


@dataclass(frozen=True)
class Goal:
    """An output that counts in the objective, times its weight."""

    label: str
    model: str
    weight: float = 1.0
    at: Place = field(**PLACE)


@dataclass(frozen=True)
class ProblemStatement:
    """The problem of a document: goals, variables, limits."""

    goals: tuple[Goal, ...]
    variables: tuple[FreeInput, ...] = ()
    limits: tuple[Limit, ...] = ()
    maximize: bool = False


@dataclass(frozen=True)
class Solver:
    """The solver asked for and its parameters, as they were written."""

    name: str
    settings: tuple[tuple[str, str], ...] = ()
    at: Place = field(**PLACE)


@dataclass(frozen=True)
class Document:
    """A formulation; a mapping alone has no problem."""

    mapping: Mapping
    problem: ProblemStatement | None = None
    solver: Solver | None = None
