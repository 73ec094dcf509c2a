"""Variables of a MAD-X file, immediate or deferred, and expressions evaluated as in MAD-X."""

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
    """Split a text into words.

    Examples
    --------
    >>> words("sin cos")
    ('sin', 'cos')
    """
    return tuple(text.split())


NAME = r"[A-Za-z_][\w.$]*"
# Constants of MAD-X 5.09, with its values and units (GeV, m, s).
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
    """Power; ArithmeticError for a complex result."""
    value = base**exponent
    if isinstance(value, complex):
        raise ArithmeticError("a root of a negative number")
    return value


# Binary operators and comparisons.
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
# Grammar of expressions, conditions of IF and lists of LINE. As in MAD-X, powers associate to the
# left, and a sign is allowed only at the start of a sum.
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
def parse(text: str, kind: str = "sum") -> Tree:
    """Parse an expression, the condition of an IF ("condition") or the list of a LINE ("list").

    Raises
    ------
    ValueError
        At a syntax error.

    Examples
    --------
    >>> len(parse("(a, -2*b)", "list").children)
    2
    """
    try:
        return _grammar().parse(text, kind)
    except UnexpectedCharacters as error:
        cause = f"'{error.char}' in it"
    except UnexpectedInput as error:
        token = str(getattr(error, "token", ""))
        cause = f"'{short(token, 20)}' where it cannot stand" if token else "it ends early"
    raise ValueError(f"'{abbreviate(text)}' ({cause})")


class Values:
    """Variables of a file.

    Parameters
    ----------
    attribute : callable
        Value of ``element->parameter`` by the two names.

    Examples
    --------
    >>> values = Values(lambda name, key: 0.0)
    >>> values.assign("", "x", True, "2*y")
    >>> values.assign("", "y", False, "-3^2")
    >>> values.evaluate("x + 1")
    -17.0
    """

    def __init__(self, attribute: Callable[[str, str], float]) -> None:
        self._attribute = attribute
        self._definitions: dict[str, float | str | ValueError] = {}
        self._cache: dict[str, float] = {}
        self._fixed_names: set[str] = set()
        self._pending: list[str] = []

    def invalidate(self) -> None:
        """Discard cached values after a variable or element has changed."""
        self._cache.clear()

    def assign(self, kind: str, name: str, later: bool, text: str) -> None:
        """Define a variable by an expression, evaluated now or (``later``) at each use.

        Raises
        ------
        ValueError
            If the name is a constant of MAD-X, or the text is no expression. An undefined name in
            it raises only when the variable is used.
        """
        if name in CONSTANTS:
            raise ValueError(f"'{name}', a constant of MAD-X that stays as it is")
        if name in self._fixed_names:
            return  # MAD-X ignores it, too
        parse(text)
        value: float | str | ValueError = text
        if not later or "const" in kind:
            try:
                value = self.evaluate(text)
            except ValueError as error:
                value = error
        if "int" in kind and isinstance(value, float):
            value = float(math.trunc(value))
        if "const" in kind:
            self._fixed_names.add(name)
        self._definitions[name] = value
        self.invalidate()

    def evaluate(self, text: str) -> float:
        """Evaluate an expression.

        Raises
        ------
        ValueError
            At a syntax error, an undefined name, or a value that is not finite.
        """
        return self._finite(parse(text), text)

    def holds(self, text: str) -> bool:
        """Evaluate the condition of an IF: comparisons joined by && and ||.

        Raises
        ------
        ValueError
            As `evaluate`.

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
            for both in parse(text, "condition").children
        )

    def _finite(self, tree: Tree, text: str) -> float:
        """Value of a parsed expression; `text` is for messages."""
        try:
            value = self._value(tree)
        except (ArithmeticError, RecursionError) as error:
            raise ValueError(f"'{abbreviate(text)}' without a value ({error})") from None
        if not math.isfinite(value):
            raise ValueError(f"'{abbreviate(text)}' without a finite value")
        return value

    def _value(self, tree: Tree) -> float:
        """Evaluate a parsed expression."""
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
        """Value of a variable or constant, evaluated once until a variable changes."""
        if name in CONSTANTS:
            return CONSTANTS[name]
        if name not in self._cache:
            if name not in self._definitions:
                raise ValueError(f"the undefined '{name}'")
            if name in self._pending:
                raise ValueError(f"'{name}', which is defined by itself")
            definition = self._definitions[name]
            if isinstance(definition, ValueError):
                raise definition
            self._pending.append(name)
            try:
                self._cache[name] = (
                    self.evaluate(definition) if isinstance(definition, str) else definition
                )
            finally:
                self._pending.pop()
        return self._cache[name]


def abbreviate(text: str) -> str:
    """Put a text on one line, without its middle if it is long."""
    return short(" ".join(text.split()), 40)
