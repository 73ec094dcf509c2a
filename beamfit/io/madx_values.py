"""Numbers of a MAD-X file: variables, now or later, and expressions as MAD-X evaluates them."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from functools import lru_cache
from typing import Any

from lark import Lark, Token, Tree
from lark.exceptions import UnexpectedCharacters, UnexpectedInput

from beamfit.errors import short


def words(text: str) -> tuple[str, ...]:
    """Make a list of words.

    Examples
    --------
    >>> words("sin cos")
    ('sin', 'cos')
    """
    return tuple(text.split())


NAME = r"[A-Za-z_][\w.$]*"
# The constants of MAD-X 5.09: GeV, m, s, as it has them.
CONSTANTS = {
    "pi": math.pi,
    "twopi": 2 * math.pi,
    "degrad": 180 / math.pi,
    "raddeg": math.pi / 180,
    "e": math.e,
    "emass": 0.51099895e-3,
    "pmass": 0.93827208816,
    "nmass": 0.93956542052,
    "umass": 0.93149410242,
    "mumass": 0.1056583755,
    "clight": 299792458.0,
    "qelect": 1.602176634e-19,
    "hbar": 6.582119569e-25,
    "erad": 2.8179403262e-15,
    "prad": 1.5346982671888944e-18,
    "amu0": 1.2566370614359173e-06,
    "version": 50902.0,
}
FUNCTIONS: dict[str, Callable[[float], float]] = {
    name: getattr(math, name)
    for name in words("sqrt log log10 exp sin cos tan asin acos atan sinh cosh tanh erf erfc")
}
FUNCTIONS |= {
    "abs": abs,
    "sinc": lambda x: math.sin(x) / x if x else 1.0,
    "floor": lambda x: float(math.floor(x)),
    "ceil": lambda x: float(math.ceil(x)),
    "round": lambda x: float(round(x)),
    "frac": lambda x: math.fmod(x, 1.0),
}


def _power(base: float, exponent: float) -> float:
    value = base**exponent
    if isinstance(value, complex):
        raise ArithmeticError("a root of a negative number")
    return value


OPERATORS: dict[str, Callable[[float, float], Any]] = {
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": operator.truediv,
    "^": _power,
    "<=": operator.le,
    ">=": operator.ge,
    "<>": operator.ne,
    "==": operator.eq,
    "<": operator.lt,
    ">": operator.gt,
}
# Expressions, conditions of IF and lists of LINE. Powers too are taken from left to right, and a
# sign stands only in front of a sum.
GRAMMAR = rf"""
condition: "(" both ("||" both)* ")"
both: comparison ("&&" comparison)*
comparison: sum COMPARED sum
list: "(" member ("," member)* ")"
member: SIGN? (COUNT "*")? (NAME | list)
?sum: SIGN? product (SIGN product)*
?product: power (TIMES power)*
?power: atom (POWER atom)*
?atom: NUMBER -> number
    | NAME -> variable
    | NAME "->" NAME -> attribute
    | NAME "(" sum ("," sum)* ")" -> call
    | "(" sum ")"
COMPARED: "<=" | ">=" | "<>" | "==" | "<" | ">"
SIGN: "+" | "-"
TIMES: "*" | "/"
POWER: "^"
COUNT: /\d+/
NUMBER: /(\d+\.?\d*|\.\d+)([eEdD][-+]?\d+)?/
NAME: /{NAME}/
%ignore /\s+/
"""


@lru_cache
def _grammar() -> Lark:
    return Lark(GRAMMAR, parser="lalr", start=["sum", "condition", "list"])


@lru_cache(maxsize=10_000)
def parsed(text: str, kind: str = "sum") -> Tree:
    """Parse an expression, the condition of an IF ("condition") or the list of a LINE ("list").

    Raises
    ------
    ValueError
        If it is none.

    Examples
    --------
    >>> len(parsed("(a, -2*b)", "list").children)
    2
    """
    try:
        return _grammar().parse(text, kind)
    except UnexpectedCharacters as error:
        cause = f"'{error.char}' in it"
    except UnexpectedInput as error:
        said = str(getattr(error, "token", ""))
        cause = f"'{short(said, 20)}' where it cannot stand" if said else "it ends early"
    raise ValueError(f"'{shown(text)}' ({cause})")


class Values:
    """The variables of a file; ``attribute`` gives the number of an element's parameter.

    Examples
    --------
    >>> values = Values(lambda name, key: 0.0)
    >>> values.assign("", "x", True, "2*y")
    >>> values.assign("", "y", False, "-3^2")
    >>> values.of("x + 1")
    -17.0
    """

    def __init__(self, attribute: Callable[[str, str], float]) -> None:
        self._attribute = attribute
        self._said: dict[str, float | str | ValueError] = {}
        self._known: dict[str, float] = {}
        self._fixed: set[str] = set()
        self._pending: list[str] = []

    def changed(self) -> None:
        """Forget what was computed from variables or elements that changed."""
        self._known.clear()

    def assign(self, kind: str, name: str, later: bool, text: str) -> None:
        """Give a variable a number, or an expression that is evaluated whenever it is asked for.

        Raises
        ------
        ValueError
            If it is a constant, or the text is no expression. A name that nothing defines is told
            when the number is asked for.
        """
        if name in CONSTANTS:
            raise ValueError(f"'{name}', a constant of MAD-X that stays as it is")
        if name in self._fixed:
            return  # as MAD-X does
        parsed(text)
        value: float | str | ValueError = text
        if not later or "const" in kind:
            try:
                value = self.of(text)
            except ValueError as error:
                value = error
        if "int" in kind and isinstance(value, float):
            value = float(math.trunc(value))
        if "const" in kind:
            self._fixed.add(name)
        self._said[name] = value
        self.changed()

    def of(self, text: str) -> float:
        """Evaluate an expression.

        Raises
        ------
        ValueError
            If it is none, names what nothing defines, or has no finite value.
        """
        return self._finite(parsed(text), text)

    def holds(self, text: str) -> bool:
        """Evaluate the condition of an IF: comparisons joined by && and ||.

        Raises
        ------
        ValueError
            As `of`.

        Examples
        --------
        >>> Values(lambda name, key: 0.0).holds("(1 < 2 && 3 <> 3)")
        False
        """
        return any(
            all(
                OPERATORS[sign](self._finite(left, text), self._finite(right, text))
                for left, sign, right in (comparison.children for comparison in both.children)
            )
            for both in parsed(text, "condition").children
        )

    def _finite(self, tree: Tree, text: str) -> float:
        """The value of a part of a text."""
        try:
            value = self._value(tree)
        except (ArithmeticError, RecursionError) as error:
            raise ValueError(f"'{shown(text)}' without a value ({error})") from None
        if not math.isfinite(value):
            raise ValueError(f"'{shown(text)}' without a finite value")
        return value

    def _value(self, tree: Tree) -> float:
        first, *steps = tree.children
        match tree.data:
            case "number":
                return float(first.lower().replace("d", "e"))
            case "variable":
                return self._variable(first.lower())
            case "attribute":
                return self._attribute(first.lower(), steps[0].lower())
            case "call":
                if (name := first.lower()) not in FUNCTIONS or len(steps) > 1:
                    raise ValueError(f"the function '{name}'")
                return FUNCTIONS[name](self._value(steps[0]))
        signed = isinstance(first, Token)
        value, steps = (0.0, tree.children) if signed else (self._value(first), steps)
        for sign, part in zip(steps[::2], steps[1::2], strict=True):
            value = OPERATORS[sign](value, self._value(part))
        return value

    def _variable(self, name: str) -> float:
        if name in CONSTANTS:
            return CONSTANTS[name]
        if name not in self._known:
            if name not in self._said:
                raise ValueError(f"the undefined '{name}'")
            if name in self._pending:
                raise ValueError(f"'{name}', which is defined by itself")
            said = self._said[name]
            if isinstance(said, ValueError):
                raise said
            self._pending.append(name)
            try:
                self._known[name] = self.of(said) if isinstance(said, str) else said
            finally:
                self._pending.pop()
        return self._known[name]


def shown(text: str) -> str:
    """A text on one line, its middle left out where it is long."""
    return short(" ".join(text.split()), 40)
