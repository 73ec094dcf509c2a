"""Expressions as data: what a formula says, where it stands, and how it is printed back."""

from __future__ import annotations

from collections.abc import Iterator as Walk
from dataclasses import dataclass, field
from typing import NamedTuple

from beamfit.errors import InputError

# Most levels of a formula, which is walked by recursion; people write ten.
MOST_LEVELS = 120
REDUCTIONS = ("sum", "prod", "min", "max", "mean")
ONE = """sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh exp log log10 sqrt abs sign erf
sigmoid transpose inverse det trace norm sum"""
FUNCTIONS: dict[str, tuple[int, int]] = {name: (1, 1) for name in ONE.split()}
FUNCTIONS |= {"atan2": (2, 2), "pow": (2, 2), "dot": (2, 2), "min": (1, 99), "max": (1, 99)}
"""Built-in functions: least and most number of arguments."""


class Place(NamedTuple):
    """Line and column, counted from 1."""

    line: int | None = None
    column: int | None = None

    def __str__(self) -> str:
        return f"line {self.line}, column {self.column}"

    def behind(self, text: str) -> Place:
        """The place behind a text that begins here."""
        more = text.count("\n")
        column = len(text) - text.rfind("\n") if more else self.column + len(text)
        return Place(self.line + more, column)


NOWHERE = Place()


@dataclass(frozen=True)
class Placed:
    """A part of a document: it stands somewhere, which does not make it another thing."""

    at: Place = field(default=NOWHERE, compare=False, repr=False, kw_only=True)


def error_at(at: Place, found: str, expected: str) -> InputError:
    """An error with its place in the document; who opened the file adds its name."""
    return InputError(found, expected, line=at.line, column=at.column)


class Expression(Placed):
    """A formula or a part of one."""

    def __str__(self) -> str:
        return text_of(self)


@dataclass(frozen=True)
class Literal(Expression):
    """A number, kept as it was written."""

    text: str

    @property
    def value(self) -> float:
        """The number."""
        return float(self.text)


@dataclass(frozen=True)
class Whole(Expression):
    """All elements along a dimension, written ``:`` in the place of an index."""


@dataclass(frozen=True)
class Name(Expression):
    """A number, an array, or an element ``A[k, 9]`` of one; an iterator by its name."""

    name: str
    indices: tuple[Expression, ...] = ()


@dataclass(frozen=True)
class Arithmetic(Expression):
    """``+ - * / @ ^`` of two parts, or a sign of one."""

    symbol: str
    parts: tuple[Expression, ...]


@dataclass(frozen=True)
class Application(Expression):
    """A function of arguments by position."""

    function: str
    arguments: tuple[Expression, ...]


@dataclass(frozen=True)
class Elements(Expression):
    """Elements of a set: start, stop and maybe step of a range, or one by one."""

    parts: tuple[Expression, ...]
    ranged: bool = True


@dataclass(frozen=True)
class Iterator(Expression):
    """A name that runs over a set."""

    name: str
    over: str | Elements


@dataclass(frozen=True)
class Reduction(Expression):
    """``sum(k in K | body)``, and prod, min, max, mean."""

    kind: str
    iterators: tuple[Iterator, ...]
    body: Expression


def children(e: Expression) -> tuple[Expression, ...]:
    """The parts of an expression."""
    values = (getattr(e, name) for name in e.__match_args__)
    each = (v if isinstance(v, tuple) else (v,) for v in values)
    return tuple(part for parts in each for part in parts if isinstance(part, Expression))


def check_depth(e: Expression) -> Expression:
    """Refuse an expression too deep to walk by recursion."""
    level: Walk | list = [e]
    for _ in range(MOST_LEVELS):
        level = [part for one in level for part in children(one)]
        if not level:
            return e
    expected = f"at most {MOST_LEVELS}; split it with local variables, or write sum(k in K | ...)"
    raise error_at(e.at, f"an expression of more than {MOST_LEVELS} levels", expected)


LEVELS = {"+": 1, "-": 1, "*": 2, "/": 2, "@": 2, "^": 4}
# Binding strength of a sign and of an atom, between those of the operators.
SIGN, ATOM = 3, 5


def _level(e: Expression) -> int:
    if not isinstance(e, Arithmetic):
        return ATOM
    return SIGN if len(e.parts) == 1 else LEVELS[e.symbol]


def _inside(e: Expression, least: int) -> str:
    """The text of a part, in parentheses where it binds less than so much."""
    return text_of(e) if _level(e) >= least else f"({text_of(e)})"


def text_of(e: Expression) -> str:
    """Print an expression, with the parentheses it needs."""
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
    if len(e.parts) == 1:
        return e.symbol + _inside(e.parts[0], SIGN)
    left, right = e.parts
    if e.symbol == "^":
        return f"{_inside(left, ATOM)}^{_inside(right, SIGN)}"
    own = LEVELS[e.symbol]
    space = " " if own == 1 else ""
    return f"{_inside(left, own)}{space}{e.symbol}{space}{_inside(right, own + 1)}"


def iterators_text(iterators: tuple[Iterator, ...]) -> str:
    """Print iterators as they stand after foreach."""
    return ", ".join(map(text_of, iterators))
