"""A problem in AMPL's text form, for IPOPT and every other solver that reads it."""

from __future__ import annotations

from collections.abc import Iterator
from os import PathLike
from pathlib import Path

import numpy as np

from beamfit.errors import InputError
from beamfit.greybox import problem
from beamfit.greybox.expression_graph import Table, traced
from beamfit.greybox.problem import Problem
from beamfit.io.nl import OPCODES
from beamfit.writing import write_atomically

CODES = {name: code for code, name in reversed(OPCODES.items())}
MANY = ("sum", "min", "max")
# Expressions deeper than this are cut into definitions.
DEEP = 100


def write_nl(p: Problem, path: str | PathLike[str]) -> None:
    """Write a problem in AMPL's text form, names to ``.col`` and ``.row`` files beside it.

    The objective is the problem's cost: half of chi-square, priors included, plus objectives. What
    several expressions share is defined once.

    Parameters
    ----------
    p : Problem
        Functions must be made of operations that expressions can say.
    path : str or path
        The ``.nl`` file.

    Raises
    ------
    InputError
        Naming the operation that .nl cannot say (loops, foreign code), or if a number is not
        finite.

    Examples
    --------
    >>> import tempfile
    >>> from beamfit.greybox.problem import Free, Objective
    >>> from beamfit.io.nl import read_nl
    >>> cube = Objective("f", lambda m, _: m["a"] ** 3)
    >>> p = Problem({"a": 2.0}, [Free("a", 0, 9)], objectives=[cube])
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_nl(p, folder + "/cube.nl")
    ...     again = read_nl(folder + "/cube.nl")
    >>> again.names, float(again.cost(again.start))
    (('a',), 8.0)
    """
    table, n = Table(), len(p.names)
    (goal,) = traced(lambda x: problem.cost(p.core, x)[None], n, table).tolist()
    rows = (
        traced(lambda x: problem.constraints(p.core, x), n, table).tolist() if p.constraints else []
    )
    text = "\n".join(_lines(p, table, goal, rows)) + "\n"
    path = Path(path)
    write_atomically(path, text.encode())
    for ending, names in ((".col", p.names), (".row", (*p.constraint_names, "cost"))):
        write_atomically(path.with_suffix(ending), "".join(f"{v}\n" for v in names).encode())


def _lines(p: Problem, table: Table, goal: int, rows: list[int]) -> Iterator[str]:
    n, m = len(p.names), len(rows)
    defined = _defined(table, [goal, *rows])
    name = {place: f"v{n + i}" for i, place in enumerate(defined)}
    on = _dependence(table)
    uses = [[i for i in range(n) if on[row] >> i & 1] for row in rows]
    of_goal = [i for i in range(n) if on[goal] >> i & 1]
    low, high = p.constraint_lower, p.constraint_upper
    equal = low == high
    ranges = np.isfinite(low) & np.isfinite(high) & ~equal
    yield "g3 1 1 0\t# problem beamfit"
    yield f" {n} {m} 1 {ranges.sum()} {equal.sum()}"
    yield f" {m} 1"
    yield " 0 0"
    yield f" {n} {n} {n}"
    yield " 0 0 0 1"
    yield " 0 0 0 0 0"
    yield f" {sum(map(len, uses))} {len(of_goal)}"
    yield f" {max(map(len, (*p.constraint_names, 'cost')))} {max(map(len, p.names))}"
    yield f" {len(defined)} 0 0 0 0"
    for i, place in enumerate(defined):
        yield f"V{n + i} 0 0"
        yield from _expression(table, place, name)
    for i, row in enumerate(rows):
        yield f"C{i}"
        yield from _said(table, row, name)
    yield "O0 0"
    yield from _said(table, goal, name)
    yield f"x{n}"
    yield from (f"{i} {_number(v)}" for i, v in enumerate(p.start))
    if m:
        yield "r"
        yield from map(_bound, low, high)
    yield "b"
    yield from map(_bound, p.lower, p.upper)
    yield f"k{n - 1}"
    counts = np.cumsum([sum(i in some for some in map(set, uses)) for i in range(n)])
    yield from (str(count) for count in counts[: n - 1])
    for kind, i, some in [("J", i, some) for i, some in enumerate(uses)] + [("G", 0, of_goal)]:
        if some:
            yield f"{kind}{i} {len(some)}"
            yield from (f"{j} 0" for j in some)


def _defined(table: Table, roots: list[int]) -> list[int]:
    """Operations that are defined apart: those used more than once, and where nesting is deep."""
    count, depth = np.zeros(len(table.nodes), int), np.zeros(len(table.nodes), int)
    reached = set(roots)
    for place in range(len(table.nodes) - 1, -1, -1):
        if place in reached:
            arguments = table.nodes[place][1]
            np.add.at(count, list(arguments), 1)
            reached.update(arguments)
    defined = []
    for place in sorted(reached):
        arguments = table.nodes[place][1]
        if arguments:
            depth[place] = 1 + max(depth[a] for a in arguments)
            if count[place] > 1 or depth[place] > DEEP:
                defined.append(place)
                depth[place] = 0
    return defined


def _dependence(table: Table) -> list[int]:
    """On which variables each node hangs, as bits."""
    on: list[int] = []
    for head, arguments, value in table.nodes:
        bits = 1 << value if head == "variable" else 0
        for a in arguments:
            bits |= on[a]
        on.append(bits)
    return on


def _said(table: Table, place: int, name: dict[int, str]) -> Iterator[str]:
    """A node by its definition where it has one, else as it is."""
    if place in name:
        yield name[place]
    else:
        yield from _expression(table, place, name)


def _expression(table: Table, place: int, name: dict[int, str]) -> Iterator[str]:
    head, arguments, value = table.nodes[place]
    if head == "constant":
        yield f"n{_number(value)}"
    elif head == "variable":
        yield f"v{value}"
    else:
        # Of two arguments a sum is an addition; o54 takes three or more.
        plain = head == "sum" and len(arguments) == 2
        yield "o0" if plain else f"o{CODES[head]}"
        if head in MANY and not plain:
            yield str(len(arguments))
        for a in arguments:
            yield from _said(table, a, name)


def _number(value: float) -> str:
    if not np.isfinite(value):
        raise InputError(f"the number {value}", "finite numbers; nothing else can be written")
    return repr(float(value))


def _bound(low: float, high: float) -> str:
    if low == high:
        return f"4 {_number(low)}"
    ends = [_number(v) for v in (low, high) if np.isfinite(v)]
    kind = int(not np.isfinite(low)) + 2 * int(not np.isfinite(high))  # 3: neither end
    return " ".join([str(kind), *ends])
