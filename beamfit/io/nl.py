"""AMPL's text form of a problem, ``.nl``, as AMPL, Pyomo and JuMP write it (D. M. Gay, Writing .nl
files, Sandia National Laboratories SAND2005-7907P): what its numbers mean, and the reader."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.errors import InputError
from beamfit.greybox.expression_graph import Node, constant, plan, variable
from beamfit.greybox.problem import Constraint, Free, Objective, Problem
from beamfit.io.files import read_text

OPCODES = {
    0: "plus", 1: "minus", 2: "times", 3: "divide", 4: "rem", 5: "power", 6: "less", 11: "min",
    12: "max", 13: "floor", 14: "ceil", 15: "abs", 16: "negative", 20: "or", 21: "and", 22: "<",
    23: "<=", 24: "=", 28: ">=", 29: ">", 30: "!=", 34: "not", 35: "if", 37: "tanh", 38: "tan",
    39: "sqrt", 40: "sinh", 41: "sin", 42: "log10", 43: "log", 44: "exp", 45: "cosh", 46: "cos",
    47: "atanh", 48: "atan2", 49: "atan", 50: "asinh", 51: "asin", 52: "acosh", 53: "acos",
    54: "sum", 57: "round", 58: "trunc", 75: "power", 76: "square", 77: "power",
}  # fmt: skip
ARITY = {name: 1 for name in ("floor", "ceil", "abs", "negative", "not", "square")}
ARITY |= {OPCODES[code]: 1 for code in (*range(37, 48), *range(49, 54))} | {"if": 3}
# The line of counts, after that of variables and constraints, that tells of discrete variables.
DISCRETE = 4
# Expressions nest no deeper; sums, however long, are one level.
DEEPEST = 200


def _is_count(word: str) -> bool:
    return word.isdecimal() and len(word) < 10


class _Lines:
    """The lines of a file one after the other, and the errors of the last."""

    def __init__(self, path: str | PathLike[str]):
        self.path, self.number = path, 0
        self.text = read_text(path).splitlines()

    @property
    def done(self) -> bool:
        return self.number >= len(self.text)

    def peek(self) -> list[str]:
        return [] if self.done else self.text[self.number].split("#")[0].split()

    def next(self, expected: str) -> list[str]:
        if self.done:
            raise self.wrong("the end of the file", expected)
        self.number += 1
        return self.text[self.number - 1].split("#")[0].split()

    def wrong(self, found: str, expected: str) -> InputError:
        return InputError(found, expected, path=self.path, line=self.number)

    def numbers(self, count: int, expected: str) -> list[float]:
        words = self.next(expected)
        try:
            found = [float(word) for word in words]
        except ValueError:
            found = []
        if len(found) < count or np.isnan(found).any():
            raise self.wrong(f"'{' '.join(words)}'", expected)
        return found

    def counts(self, number: int, expected: str) -> list[int]:
        words = self.next(expected)
        if len(words) < number or not all(map(_is_count, words[:number])):
            raise self.wrong(f"'{' '.join(words)}'", expected)
        return [int(word) for word in words[:number]]


class _Stated:
    """What the segments of a file say."""

    def __init__(self, n: int, m: int):
        self.n, self.m = n, m
        self.bodies = [constant(0.0)] * m
        self.objective, self.sense = constant(0.0), 1.0
        self.defined: dict[int, Node] = {}
        self.level: dict[int, int] = {}  # on how many others a definition rests
        self.deepest = 0
        self.linear: list[tuple[int, int, float]] = []  # row, m for the objective; column; value
        self.limits = [np.array([[-np.inf], [np.inf]]) + np.zeros(k) for k in (m, n)]
        self.start = np.zeros(n)


def read_nl(path: str | PathLike[str]) -> Problem:
    """Read a problem in AMPL's text form; names from ``.col`` and ``.row`` files beside it.

    Parameters
    ----------
    path : str or path
        The ``.nl`` file.

    Returns
    -------
    Problem
        Its free numbers in the file's order, all constraints as one, the first objective, which is
        minimised (a maximum's sign is turned). Nothing is evaluated as code, and alike expressions
        are computed together.

    Raises
    ------
    InputError
        With file and line, if it cannot be read, is binary, or has integers, complementarities,
        logical constraints or imported functions.
    """
    lines = _Lines(path)
    said = _header(lines)
    while not lines.done:
        words = lines.next("a segment")
        try:
            if words:
                _segment(lines, said, words)
        except RecursionError:
            raise lines.wrong("sums nested without end", f"at most {DEEPEST}") from None
    return _problem(Path(path), said)


def _header(lines: _Lines) -> _Stated:
    first = lines.next("a header that begins with g")
    if not first or first[0][0] != "g":
        found = "a binary file" if first and first[0][0] == "b" else "no header"
        raise lines.wrong(found, "the text form of .nl, which begins with g (AMPL: write gmodel)")
    n, m, _ = lines.counts(3, "counts of variables, constraints and objectives")
    for i in range(8):
        if any(lines.counts(DISCRETE * (i == DISCRETE), "counts")) and i == DISCRETE:
            raise lines.wrong("integer variables", "continuous ones; relax them")
    if n == 0 or max(n, m) > len(lines.text):
        raise lines.wrong(
            f"{n} variables and {m} constraints", "as many as the file has room for, one at least"
        )
    return _Stated(n, m)


def _segment(lines: _Lines, said: _Stated, words: list[str]) -> None:
    kind, rest = words[0][0], words[0][1:]
    if kind not in SEGMENTS:
        what = {"F": "an imported function", "L": "a logical constraint"}.get(kind)
        known = "segments " + ", ".join(SEGMENTS)
        raise lines.wrong(what or f"'{words[0]}'", f"{known}; restate what this one says")
    read, size = SEGMENTS[kind]
    limit = size(said)
    numbers = [*([] if limit is None else [rest]), *(words[1:2] if kind == "S" else words[1:])]
    if not all(map(_is_count, numbers)) or (limit is not None and int(rest) >= limit):
        expected = f"{kind} and numbers" if limit is None else f"{kind}, a number below {limit}"
        raise lines.wrong(f"'{' '.join(words)}'", expected)
    read(lines, said, kind, [int(word) for word in numbers] + [0])


def _body(lines, said, kind, numbers):
    said.bodies[numbers[0]] = _expression(lines, said)


def _goal(lines, said, kind, numbers):
    body = _expression(lines, said)
    if numbers[0] == 0:
        said.objective, said.sense = body, -1.0 if numbers[1] == 1 else 1.0


def _defined(lines, said, kind, numbers):
    said.deepest = 0
    terms = [_term(lines, said) for _ in range(numbers[1])]
    said.defined[numbers[0]] = Node("sum", (*terms, _expression(lines, said)))
    said.level[numbers[0]] = said.deepest + 1


def _linear(lines, said, kind, numbers):
    for _ in range(numbers[1]):
        column, value = _pair(lines, said.n)
        if value and (kind == "J" or numbers[0] == 0):
            said.linear.append((numbers[0] if kind == "J" else said.m, column, value))


def _ends(lines, said, kind, numbers):
    limits = said.limits[kind == "b"]
    for i in range(limits.shape[1]):
        limits[:, i] = _limits(lines)


def _starts(lines, said, kind, numbers):
    for _ in range(numbers[0]):
        column, value = _pair(lines, said.n)
        said.start[column] = value


def _skipped(lines, said, kind, numbers):
    """Starts of multipliers, suffixes and counts of the Jacobian's columns say nothing here."""
    for _ in range(numbers[1] if kind == "S" else numbers[0]):
        lines.next("a number")


MANY = 10**9
# What reads a segment, and below what its number lies (None where it has none).
SEGMENTS = {
    "C": (_body, lambda said: said.m), "O": (_goal, lambda said: MANY),
    "V": (_defined, lambda said: MANY), "J": (_linear, lambda said: said.m),
    "G": (_linear, lambda said: MANY), "r": (_ends, lambda said: None),
    "b": (_ends, lambda said: None), "x": (_starts, lambda said: MANY),
    "d": (_skipped, lambda said: MANY), "k": (_skipped, lambda said: MANY),
    "S": (_skipped, lambda said: MANY),
}  # fmt: skip


def _pair(lines: _Lines, size: int) -> tuple[int, float]:
    column, value = lines.numbers(2, "a place and a number")[:2]
    if column not in range(size):
        raise lines.wrong(f"variable {column:g}", f"one of 0 to {size - 1}")
    return int(column), value


def _term(lines: _Lines, said: _Stated) -> Node:
    column, value = lines.numbers(2, "a variable and its factor")[:2]
    place = int(column) if np.isfinite(column) else -1
    return Node("times", (constant(value), _known(lines, said, place)))


def _limits(lines: _Lines) -> tuple[float, float]:
    words = lines.numbers(1, "the kind of a bound, 0 to 4, and its ends")
    kind, ends = words[0], words[1:]
    if kind == 5:
        raise lines.wrong("a complementarity", "bounds of kinds 0 to 4")
    if kind not in range(5) or len(ends) < {0: 2, 3: 0}.get(kind, 1):
        raise lines.wrong(f"bound of kind {kind:g}", "kinds 0 to 4 and their ends")
    low = ends[0] if kind in (0, 2, 4) else -np.inf
    return low, ends[kind == 0] if kind in (0, 1, 4) else np.inf


def _known(lines: _Lines, said: _Stated, index: int) -> Node:
    if 0 <= index < said.n:
        return variable(index)
    if index not in said.defined:
        raise lines.wrong(f"v{index}", "a variable, or an expression defined before")
    said.deepest = max(said.deepest, said.level[index])
    return variable(index)


def _expression(lines: _Lines, said: _Stated, depth: int = 0) -> Node:
    """One expression, its operations standing before their arguments."""
    words = lines.next("an expression")
    word = words[0] if words else ""
    kind, rest = word[:1], word[1:]
    if kind in ("n", "s", "l"):
        try:
            return constant(float(rest))
        except ValueError:
            raise lines.wrong(f"'{word}'", "a number") from None
    if kind == "v" and _is_count(rest):
        return _known(lines, said, int(rest))
    if kind != "o" or not _is_count(rest) or int(rest) not in OPCODES:
        what = f"operation '{word}'" if kind in ("o", "f") else f"'{word}'"
        raise lines.wrong(what, "one of o0 to o58 that compute numbers, n or v")
    head = OPCODES[int(rest)]
    if depth > DEEPEST and head not in ("plus", "sum"):
        raise lines.wrong(f"an expression nested {depth} deep", f"at most {DEEPEST}")
    count = ARITY.get(head, 2)
    if head in ("sum", "min", "max"):
        (count,) = lines.counts(1, "how many arguments")
    if head == "plus":
        return _chain(lines, said, depth)
    arguments = tuple(_expression(lines, said, depth + 1) for _ in range(count))
    if head == "square":
        return Node("power", (arguments[0], constant(2.0)))
    return Node(head, arguments)


def _chain(lines: _Lines, said: _Stated, depth: int) -> Node:
    """A sum written as a chain of additions: it may be long, but is one level."""
    parts, missing = [], 2
    while missing:
        missing -= 1
        words = lines.peek()
        if words and words[0] == "o0":
            lines.next("an expression")
            missing += 2
        else:
            parts.append(_expression(lines, said, depth + 1))
    return Node("sum", tuple(parts))


def _names(path: Path, count: int, word: str) -> tuple[str, ...]:
    """Names of a file beside, one a line; those of numbers where there is none."""
    if not path.exists():
        return tuple(f"{word}[{i}]" for i in range(count))
    names = tuple(name.strip() for name in read_text(path).splitlines())
    if len(names) < count or len(set(names[:count])) < count:
        expected = f"{count} different names, one a line; or remove the file"
        raise InputError(f"{len(set(names))} names", expected, path=path)
    return names[:count]


def _problem(path: Path, said: _Stated) -> Problem:
    rows, columns, values = (
        (np.array(part) for part in zip(*said.linear, strict=True))
        if (said.linear)
        else (np.zeros(0, int), np.zeros(0, int), np.zeros(0))
    )
    of_goal = rows == said.m
    place, levels = {i: i for i in range(said.n)}, []
    for level in range(1, 1 + max(said.level.values(), default=0)):
        here = [index for index, found in said.level.items() if found == level]
        levels.append(plan([said.defined[index] for index in here], place.get))
        place |= {index: len(place) + i for i, index in enumerate(here)}
    bodies, goal = plan(said.bodies, place.get), plan([said.objective], place.get)

    def extended(x):
        for level in levels:
            x = jnp.concatenate([x, level(x)])
        return x

    def constraints(x, _):
        linear = values[~of_goal] * x[columns[~of_goal]]
        return bodies(extended(x)) + jax.ops.segment_sum(linear, rows[~of_goal], said.m)

    def objective(x, _):
        return goal(extended(x))[0] + jnp.sum(values[of_goal] * x[columns[of_goal]])

    free = Free(
        "", said.limits[1][0], said.limits[1][1],
        labels=_names(path.with_suffix(".col"), said.n, "x"),
    )  # fmt: skip
    rules = [
        Constraint(
            "c", constraints, None, said.limits[0][0], said.limits[0][1],
            labels=_names(path.with_suffix(".row"), said.m, "c"),
        )
    ] if said.m else []  # fmt: skip
    goals = [Objective(path.stem, objective, None, said.sense)]
    return Problem(said.start, [free], constraints=rules, objectives=goals)
