"""Data classes of expressions, with their places in the document, and their text form."""

from __future__ import annotations

from collections.abc import Iterator as Walk
from dataclasses import dataclass, field
from typing import NamedTuple

from beamfit.errors import InputError

# Largest depth of a formula, which is evaluated by recursion; those written by hand have about ten.
MAX_LEVELS = 120
REDUCTIONS = ("sum", "prod", "min", "max", "mean")
UNARY = """sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh exp log log10 sqrt abs sign
erf sigmoid transpose inverse det trace norm sum"""
FUNCTIONS: dict[str, tuple[int, int]] = {name: (1, 1) for name in UNARY.split()}
FUNCTIONS |= {"atan2": (2, 2), "pow": (2, 2), "dot": (2, 2), "min": (1, 99), "max": (1, 99)}
"""Built-in functions with their smallest and largest numbers of arguments."""


class Place(NamedTuple):
    """Place in a document: line and column, counted from 1."""

    line: int | None = None
    column: int | None = None

    def __str__(self) -> str:
        return f"line {self.line}, column {self.column}"

    def after(self, text: str) -> Place:
        """Return the place after a text that begins here."""
        more = text.count("\n")
        column = len(text) - text.rfind("\n") if more else self.column + len(text)
        return Place(self.line + more, column)


NOWHERE = Place()


@dataclass(frozen=True)
class Placed:
    """A part of a document with its place, which does not count in comparisons."""

    at: Place = field(default=NOWHERE, compare=False, repr=False, kw_only=True)


def error_at(at: Place, found: str, expected: str) -> InputError:
    """Make an error with its place in the document; the reader of the file adds its name."""
    return InputError(found, expected, line=at.line, column=at.column)


class Expression(Placed):
    """A formula or a part of one."""

    def __str__(self) -> str:
        return text_of(self)


@dataclass(frozen=True)
class Literal(Expression):
    """A number, with the text as written."""

    text: str

    @property
    def value(self) -> float:
        """Value of the number."""
        return float(self.text)


@dataclass(frozen=True)
class Whole(Expression):
    """All elements along a dimension, written ``:`` instead of an index."""


@dataclass(frozen=True)
class Name(Expression):
    """Name of a number, array, or iterator, or an element ``A[k, 9]`` of an array."""

    name: str
    indices: tuple[Expression, ...] = ()


@dataclass(frozen=True)
class Arithmetic(Expression):
    """Operation ``+ - * / @ ^`` on two parts, or the sign of one."""

    symbol: str
    parts: tuple[Expression, ...]


@dataclass(frozen=True)
class Application(Expression):
    """Application of a function to its arguments."""

    function: str
    arguments: tuple[Expression, ...]


@dataclass(frozen=True)
class Elements(Expression):
    """Elements of a set: start, stop and an optional step of a range, or a list."""

    parts: tuple[Expression, ...]
    ranged: bool = True


@dataclass(frozen=True)
class Iterator(Expression):
    """A name that runs over a set."""

    name: str
    over: str | Elements


@dataclass(frozen=True)
class Reduction(Expression):
    """Reduction ``sum(k in K | body)``, likewise prod, min, max, mean."""

    kind: str
    iterators: tuple[Iterator, ...]
    body: Expression


def children(e: Expression) -> tuple[Expression, ...]:
    """Return the parts of an expression."""
    values = (getattr(e, name) for name in e.__match_args__)
    each = (v if isinstance(v, tuple) else (v,) for v in values)
    return tuple(part for parts in each for part in parts if isinstance(part, Expression))


def check_depth(e: Expression) -> Expression:
    """Raise an error for an expression that is too deep for recursion."""
    level: Walk | list = [e]
    for _ in range(MAX_LEVELS):
        level = [part for one in level for part in children(one)]
        if not level:
            return e
    expected = f"at most {MAX_LEVELS}; split it with local variables, or write sum(k in K | ...)"
    raise error_at(e.at, f"an expression of more than {MAX_LEVELS} levels", expected)


PRECEDENCE = {"+": 1, "-": 1, "*": 2, "/": 2, "@": 2, "^": 4}
# Precedence of a sign and of an atom, on the scale of the operators' in `PRECEDENCE`.
SIGN, ATOM = 3, 5


def _precedence(e: Expression) -> int:
    if not isinstance(e, Arithmetic):
        return ATOM
    return SIGN if len(e.parts) == 1 else PRECEDENCE[e.symbol]


def _part_text(e: Expression, least: int) -> str:
    """Print a part, in parentheses if its precedence is below `least`."""
    return text_of(e) if _precedence(e) >= least else f"({text_of(e)})"


def text_of(e: Expression) -> str:
    """Print an expression with the necessary parentheses."""
    match e:
        case Literal():
            return e.text
        case Whole():
            return ":"
        case Name():
            inner = ", ".join(map(text_of, e.indices))
            return f"{e.name}[{inner}]" if e.indices else e.name
        case Arithmetic():
            return _operation_text(e)
        case Application():
            return f"{e.function}({', '.join(map(text_of, e.arguments))})"
        case Elements():
            return f"|{(':' if e.ranged else ', ').join(map(text_of, e.parts))}|"
        case Iterator():
            return f"{e.name} in {e.over}"
        case Reduction():
            return f"{e.kind}({iterators_text(e.iterators)} | {text_of(e.body)})"


def _operation_text(e: Arithmetic) -> str:
    """Print an operation; ^ binds to the right, the others to the left."""
    if len(e.parts) == 1:
        return e.symbol + _part_text(e.parts[0], SIGN)
    left, right = e.parts
    if e.symbol == "^":
        return f"{_part_text(left, ATOM)}^{_part_text(right, SIGN)}"
    own = PRECEDENCE[e.symbol]
    space = " " if own == 1 else ""
    return f"{_part_text(left, own)}{space}{e.symbol}{space}{_part_text(right, own + 1)}"


def iterators_text(iterators: tuple[Iterator, ...]) -> str:
    """Print iterators as written after foreach."""
    return ", ".join(map(text_of, iterators))
