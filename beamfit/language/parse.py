"""Parser of the text form of documents and statements."""

from __future__ import annotations

import json
import math
from collections import defaultdict
from functools import lru_cache
from importlib.resources import files
from typing import Any

from lark import Lark, Token, Transformer
from lark.exceptions import UnexpectedInput

from beamfit.errors import nearest
from beamfit.language import document as d
from beamfit.language import expression as x
from beamfit.language.expression import Place, error_at
from beamfit.language.mistakes import check_brackets, explain, shorten


@lru_cache(maxsize=64)
def parse_document(text: str) -> d.Document:
    """Read a document from its text form.

    Parameters
    ----------
    text : str
        Content of a ``.bf`` file.

    Returns
    -------
    Document

    Raises
    ------
    InputError
        With line and column, if the text is not in the language.

    Examples
    --------
    >>> found = parse_document("minimize y; variable x in [0, 1]; input x; output y; y = x^2;")
    >>> found.problem.variables[0].upper, str(found.mapping.statements[0].value)
    (1.0, 'x^2')
    """
    return _parse(text, "document")


def parse_statements(text: str) -> tuple[d.Statement, ...]:
    """Read the statements of a mapping, the text of ``<expressions>``.

    Raises
    ------
    InputError
        With line and column, if the text is not in the language.

    Examples
    --------
    >>> [type(s).__name__ for s in parse_statements("set K = |1:3|; real A[K];")]
    ['IndexedSet', 'Real']
    """
    return tuple(_parse(text, "statements"))


@lru_cache
def _grammar() -> Lark:
    text = (files("beamfit.language") / "grammar.lark").read_text()
    return Lark(text, parser="lalr", start=["document", "statements"], transformer=_Builder(),
                maybe_placeholders=True)  # fmt: skip


def _parse(text: str, start: str) -> Any:
    check_brackets(text)
    try:
        return _grammar().parse(text, start)
    except UnexpectedInput as error:
        raise explain(error, text) from None


def _place(children: list[Any]) -> Place:
    """Return the place of the first part that has one."""
    first = next(c for c in children if isinstance(c, Token) or getattr(c, "at", None))
    return Place(first.line, first.column) if isinstance(first, Token) else first.at


def _number(token: Token) -> float:
    value = float(token)
    if math.isinf(value) and "inf" not in token:
        raise error_at(
            Place(token.line, token.column), f"'{shorten(token)}'", "a number below 1e308"
        )
    return value


def _whole_number(token: Token | None, least: int = 0) -> int | None:
    if token is None:
        return None
    if not token.isdigit() or not least <= (value := int(token[:12])) < 10**9:
        expected = f"a whole number from {least} to a thousand million"
        raise error_at(Place(token.line, token.column), f"'{shorten(token)}'", expected)
    return value


class _Builder(Transformer):
    """Builds the document from the rules of the grammar, one method for each."""

    def STRING(self, token):
        """Return the content of a quoted text, with its place."""
        try:
            return token.update(value=json.loads(token))
        except ValueError:
            at = Place(token.line, token.column)
            raise error_at(
                at, f"{shorten(token)}", 'a text; a backslash is written "\\\\"'
            ) from None

    # expressions

    def number(self, c):
        _number(c[0])
        return x.Literal(str(c[0]), at=_place(c))

    def element(self, c):
        return x.Name(str(c[0]), tuple(part for part in c[1:] if part is not None), at=_place(c))

    def whole(self, c):
        return x.Whole(at=_place(c))

    def operation(self, c):
        return x.Arithmetic(str(c[1]), (c[0], c[2]), at=c[0].at)

    def sign(self, c):
        return c[1] if c[0] == "+" else x.Arithmetic("-", (c[1],), at=_place(c))

    def application(self, c):
        return x.Application(str(c[0]), tuple(p for p in c[1:] if p is not None), at=_place(c))

    def reduction(self, c):
        if c[0] not in x.REDUCTIONS:
            raise error_at(_place(c), f"'{c[0]}'", nearest(c[0], list(x.REDUCTIONS)))
        return x.Reduction(str(c[0]), c[1], c[2], at=_place(c))

    def iterators(self, c):
        return tuple(c)

    def iterator(self, c):
        over = c[1] if isinstance(c[1], x.Elements) else str(c[1])
        return x.Iterator(str(c[0]), over, at=_place(c))

    def elements(self, c, ranged=True):
        parts = tuple(x.check_depth(part) for part in c[1:] if part is not None)
        return x.Elements(parts, ranged, at=_place(c))

    def listed(self, c):
        return self.elements(c, False)

    # statements

    def set(self, c):
        return [d.IndexedSet(str(c[1]), c[2], at=_place(c[1:]))]

    def dimensions(self, c):
        return tuple(_whole_number(t, 1) if t.type == "NUMBER" else str(t) for t in c)

    def real(self, c):
        if c[2] is not None:
            x.check_depth(c[2])
        return d.Real(str(c[0]), c[1] or (), c[2], at=_place(c))

    def reals(self, c):
        return c[1:]

    def function(self, c):
        names = tuple(str(t) for t in c[2:-1])
        return [d.Function(str(c[1]), names, x.check_depth(c[-1]), at=_place(c[1:]))]

    def wire(self, c):
        for part in (c[0], c[1]):
            x.check_depth(part)
        return d.Assignment(c[0], c[1], c[2] or (), at=_place(c))

    def assignment(self, c):
        return [self.wire(c)]

    def wires(self, c):
        return tuple(w for w in c if w is not None)

    def call(self, c):
        return [d.Call(str(c[0]), c[1], c[2], c[3] or (), at=_place(c))]

    def block(self, c):
        return [d.Block(c[0], tuple(s for part in c[1:] for s in part), at=_place(c[0]))]

    def statements(self, c):
        return [s for part in c for s in part]

    # mappings

    def declared(self, c):
        return d.Declared(str(c[0]), c[1] or (), None, at=_place(c))

    def given(self, c):
        values = (_number(c[2]),) if isinstance(c[2], Token) else c[2]
        return d.Declared(str(c[0]), c[1] or (), values, at=_place(c))

    def values(self, c):
        return tuple(_number(t) for t in c if t is not None)

    def table(self, c):
        size = _whole_number(c[3], 1), _whole_number(c[4], 1)
        return "tables", d.DataTable(str(c[1]), str(c[2]), *size, at=_place(c[1:]))

    def attribute(self, c):
        return str(c[0]), str(c[1])

    def word(self, c):
        return str(c[0])

    def part(self, c):
        kind, name, target = c[:3]
        attributes = tuple(a for a in c[3:-1] if a is not None)
        named = (("srcName", str(name)), ("dstName", str(target)))
        head = named if target is not None else (("name", str(name)),)
        return d.NetworkElement(str(kind), (*head, *attributes), c[-1], at=_place(c))

    def network(self, c):
        return "mappings", d.NetworkDefinition(str(c[1]), tuple(c[2:]), at=_place(c[1:]))

    def face(self, c):
        return f"{c[0]}s", c[1:]

    def title(self, c):
        return "titles", str(c[1])

    def mapping(self, c):
        return "mappings", _mapping(str(c[1]), _group(c[2:]), at=_place(c[1:]))

    # the problem

    def label(self, c):
        name = str(c[0])
        return d.Goal(name, name if c[1] is None else str(c[1]), at=_place(c))

    def half(self, c):
        end = _number(c[1])
        return (-math.inf, end) if c[0] == "<=" else (end, math.inf)

    def goal(self, c):
        weight = 1.0 if c[3] is None else _number(c[3])
        return "goals", [(c[0], d.Goal(c[1].label, c[1].model, weight, at=c[1].at))]

    def variable(self, c):
        _, name, value, bounds, _, random, _, seed = c
        value = None if value is None else _number(value)
        low, high = bounds or (-math.inf, math.inf)
        start = value, random, _whole_number(seed) or 0
        return "variables", d.FreeInput(name.label, name.model, low, high, *start, at=name.at)

    def limit(self, c):
        low, high = c[2] if len(c) == 3 else (_number(c[3]), _number(c[3]))
        return "limits", d.Limit(c[1].label, c[1].model, low, high, at=c[1].at)

    def solver(self, c):
        return "solvers", d.Solver(c[1], tuple(s for s in c[2:] if s is not None), at=_place(c))

    def document(self, c):
        found = _group(c)
        words = {word.lower() for word, _ in found["goals"]}
        if len(words) > 1:
            at = found["goals"][1][1].at
            raise error_at(at, "one goal to minimize, one to maximize", "one direction")
        if len(found["solvers"]) > 1:
            raise error_at(found["solvers"][1].at, "a second solver", "one")
        problem = None
        if found["goals"] or found["variables"] or found["limits"]:
            goals = tuple(goal for _, goal in found["goals"])
            free, limits = tuple(found["variables"]), tuple(found["limits"])
            problem = d.ProblemStatement(goals, free, limits, words == {"maximize"})
        mapping = _mapping((found["titles"] or [""])[0], found)
        return d.Document(mapping, problem, (found["solvers"] or [None])[0])


def _group(items: list[Any]) -> dict[str, list[Any]]:
    """Group members by kind, in order; those without a kind are statements."""
    found: dict[str, list[Any]] = defaultdict(list)
    for item in items:
        kind, member = item if isinstance(item, tuple) else ("statements", item)
        found[kind] += member if isinstance(member, list) else [member]
    return found


def _mapping(name: str, found: dict[str, list[Any]], at: Place = x.NOWHERE) -> d.Mapping:
    groups = ("tables", "mappings", "inputs", "outputs", "parameters", "statements")
    return d.Mapping(name, *(tuple(found[kind]) for kind in groups), at=at)
