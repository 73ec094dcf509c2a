"""Numbers of a MAD-X file: variables, now or later, and expressions as MAD-X evaluates them."""

from __future__ import annotations

import math
import operator
import re
from collections import deque
from collections.abc import Callable, Iterator


def words(text: str) -> tuple[str, ...]:
    """Make a list of words.

    Examples
    --------
    >>> words("sin cos")
    ('sin', 'cos')
    """
    return tuple(text.split())


NAME = r"[A-Za-z_][\w.$]*"
TOKEN = re.compile(
    rf"\s*(?:((?:\d+\.?\d*|\.\d+)(?:[eEdD][-+]?\d+)?)|({NAME})(?:->({NAME}))?|([-+*/^(),]))"
)
COMPARISON = re.compile(r"(<=|>=|<>|==|<|>)")
COMPARED = {
    "<=": operator.le,
    ">=": operator.ge,
    "<>": operator.ne,
    "==": operator.eq,
    "<": operator.lt,
    ">": operator.gt,
}
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


class NoExpression(ValueError):
    """A text that MAD-X does not read as an expression, whatever its names stand for."""


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
        self._check(text)
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
        try:
            tokens = deque(_tokens(text))
            value = self._sum(tokens)
            if tokens:
                raise NoExpression("something after it")
        except NoExpression as error:
            raise NoExpression(f"'{_short(text)}' ({error})") from None
        except (ArithmeticError, RecursionError) as error:
            raise ValueError(f"'{_short(text)}' without a value ({error})") from None
        if not math.isfinite(value):
            raise ValueError(f"'{_short(text)}' without a finite value")
        return value

    def _check(self, text: str) -> None:
        """Refuse what is no expression; every name is 1 for once."""
        dry = Values(lambda name, key: 1.0)
        dry._variable = lambda name: 1.0
        try:
            dry.of(text)
        except NoExpression:
            raise
        except ValueError:
            return

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

    def _sum(self, tokens: deque[tuple], level: int = 0) -> float:
        """Left to right at each level, powers too; a sign stands only in front of a sum."""
        if level == len(OPERATORS):
            return self._atom(tokens)
        sign = tokens.popleft()[1] if level == 0 and tokens and tokens[0] in SIGNS else "+"
        value = self._sum(tokens, level + 1)
        value = -value if sign == "-" else value
        while tokens and tokens[0][0] == "op" and tokens[0][1] in OPERATORS[level]:
            operation = OPERATORS[level][tokens.popleft()[1]]
            value = operation(value, self._sum(tokens, level + 1))
        return value

    def _atom(self, tokens: deque[tuple]) -> float:
        if not tokens:
            raise NoExpression("it ends early")
        kind, *said = tokens.popleft()
        if kind == "number":
            return said[0]
        if kind == "attribute":
            return self._attribute(*said)
        if kind == "name" and not (tokens and tokens[0] == OPENED):
            return self._variable(said[0])
        if kind == "name":
            tokens.popleft()
            if said[0] not in FUNCTIONS:
                raise ValueError(f"the function '{said[0]}'")
        elif said[0] != "(":
            raise NoExpression(f"'{said[0]}' where a number belongs")
        value = self._sum(tokens)
        if not tokens or tokens.popleft() != ("op", ")"):
            raise NoExpression("'(' without ')'")
        return FUNCTIONS[said[0]](value) if kind == "name" else value


def _power(base: float, exponent: float) -> float:
    value = base**exponent
    if isinstance(value, complex):
        raise ArithmeticError("a root of a negative number")
    return value


OPENED, SIGNS = ("op", "("), (("op", "-"), ("op", "+"))
# From those that bind last.
OPERATORS = (
    {"+": operator.add, "-": operator.sub},
    {"*": operator.mul, "/": operator.truediv},
    {"^": _power},
)


def compared(values: Values, text: str) -> bool:
    """Evaluate the condition of an IF: comparisons joined by && and ||.

    Examples
    --------
    >>> compared(Values(lambda name, key: 0.0), "(1 < 2 && 3 <> 3)")
    False
    """
    text = text.strip()
    if not (text.startswith("(") and text.endswith(")")):
        raise ValueError(f"'{_short(text)}' without parentheses around it")
    return any(
        all(_holds(values, part) for part in either.split("&&"))
        for either in text[1:-1].split("||")
    )


def _holds(values: Values, text: str) -> bool:
    parts = COMPARISON.split(text)
    if len(parts) != 3:
        raise ValueError(f"'{_short(text)}', which is no comparison")
    return COMPARED[parts[1]](values.of(parts[0]), values.of(parts[2]))


def _tokens(text: str) -> Iterator[tuple]:
    at, text = 0, text.rstrip()
    if not text:
        raise NoExpression("nothing")
    while at < len(text):
        found = TOKEN.match(text, at)
        if found is None:
            raise NoExpression(f"'{text[at:].strip()[:1]}' in it")
        number, name, key, sign = found.groups()
        if number:
            yield "number", float(number.lower().replace("d", "e"))
        elif key:
            yield "attribute", name.lower(), key.lower()
        else:
            yield ("name", name.lower()) if name else ("op", sign)
        at = found.end()


def _short(text: str) -> str:
    text = " ".join(text.split())
    return text if len(text) <= 40 else text[:37] + "..."
