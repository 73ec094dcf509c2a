"""A document: a mapping of statements, what is to be optimised with it, and by which solver."""

from __future__ import annotations

import math
from dataclasses import dataclass

from beamfit.language.expression import Elements, Expression, Iterator, Name, Placed

# ---- statements


@dataclass(frozen=True)
class IndexedSet(Placed):
    """``set K = |1:14|;``"""

    name: str
    elements: Elements


@dataclass(frozen=True)
class Real(Placed):
    """``real A[K];``, with a value if one follows: a dimension is a set or a size."""

    name: str
    dimensions: tuple[str | int, ...] = ()
    value: Expression | None = None


@dataclass(frozen=True)
class Function(Placed):
    """``function square(x) = x^2;``"""

    name: str
    arguments: tuple[str, ...]
    body: Expression


@dataclass(frozen=True)
class Assignment(Placed):
    """``y[k] = 2*x[k] foreach k in K;``

    In a call: an input and its value, or a variable and an output.
    """

    target: Name
    value: Expression
    each: tuple[Iterator, ...] = ()


@dataclass(frozen=True)
class Call(Placed):
    """``Transfer(I = I_2[k] :: A[k] = A_T) foreach k in K;``"""

    mapping: str
    inputs: tuple[Assignment, ...]
    outputs: tuple[Assignment, ...]
    each: tuple[Iterator, ...] = ()


@dataclass(frozen=True)
class Block(Placed):
    """``foreach k in K { ... }``"""

    each: tuple[Iterator, ...]
    statements: tuple[Statement, ...]


Statement = IndexedSet | Real | Function | Assignment | Call | Block


# ---- a mapping


@dataclass(frozen=True)
class Declared(Placed):
    """An input, an output or a parameter: name, dimensions, and values in C order if given."""

    name: str
    dimensions: tuple[str | int, ...] = ()
    values: tuple[float, ...] | None = None


@dataclass(frozen=True)
class DataTable(Placed):
    """A table of numbers in a file, with the rows and columns it should have."""

    name: str
    file: str
    rows: int | None = None
    columns: int | None = None


@dataclass(frozen=True)
class NetworkElement(Placed):
    """A layer, connection, input, output or gain of a network, as the report writes it."""

    kind: str
    attributes: tuple[tuple[str, str], ...]
    values: tuple[float, ...] | None = None


@dataclass(frozen=True)
class NetworkDefinition(Placed):
    """A multi-layer perceptron (report 3.1.3)."""

    name: str
    parts: tuple[NetworkElement, ...]


@dataclass(frozen=True)
class Mapping(Placed):
    """Inputs to outputs by expressions; other mappings and networks inside are called by name."""

    name: str = ""
    tables: tuple[DataTable, ...] = ()
    mappings: tuple[Mapping | NetworkDefinition, ...] = ()
    inputs: tuple[Declared, ...] = ()
    outputs: tuple[Declared, ...] = ()
    parameters: tuple[Declared, ...] = ()
    statements: tuple[Statement, ...] = ()


# ---- the problem


@dataclass(frozen=True)
class FreeInput(Placed):
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


@dataclass(frozen=True)
class Limit(Placed):
    """An output that is limited."""

    label: str
    model: str
    lower: float = -math.inf
    upper: float = math.inf


@dataclass(frozen=True)
class Goal(Placed):
    """An output that counts in the objective, times its weight."""

    label: str
    model: str
    weight: float = 1.0


@dataclass(frozen=True)
class ProblemStatement:
    """The problem of a document: goals, variables, limits."""

    goals: tuple[Goal, ...]
    variables: tuple[FreeInput, ...] = ()
    limits: tuple[Limit, ...] = ()
    maximize: bool = False


@dataclass(frozen=True)
class Solver(Placed):
    """The solver asked for and its parameters, as they were written."""

    name: str
    settings: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Document:
    """A formulation; a mapping alone has no problem."""

    mapping: Mapping
    problem: ProblemStatement | None = None
    solver: Solver | None = None
