"""Data classes of a document: mapping with its statements, optimisation problem, solver."""

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
    """``real A[K];`` or ``real a = 2*b;``; a dimension is a set or a size."""

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

    In a call: an input and its value, or a variable and the output it receives.
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
    """An input, an output or a parameter: name, dimensions, and any values in C order."""

    name: str
    dimensions: tuple[str | int, ...] = ()
    values: tuple[float, ...] | None = None


@dataclass(frozen=True)
class DataTable(Placed):
    """A table of numbers in a file, with the expected numbers of rows and columns."""

    name: str
    file: str
    rows: int | None = None
    columns: int | None = None


@dataclass(frozen=True)
class NetworkElement(Placed):
    """A layer, connection, input, output or gain of a network, with the report's attributes."""

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
    """A mapping of inputs to outputs by expressions, with inner mappings and networks."""

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
    """A free input with its bounds and start.

    `random` is the range from which the start is drawn with `seed`; without it the start is
    `value`.
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
    """Limits on an output."""

    label: str
    model: str
    lower: float = -math.inf
    upper: float = math.inf


@dataclass(frozen=True)
class Goal(Placed):
    """A term of the objective: an output times a weight."""

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
    """The requested solver and its parameters, as written."""

    name: str
    settings: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Document:
    """A whole document; a mapping alone has no problem."""

    mapping: Mapping
    problem: ProblemStatement | None = None
    solver: Solver | None = None
