"""Writer of the text form of documents.

`parse_document` reads the text of `format_document` as the same document.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Sequence
from itertools import groupby
from textwrap import indent, wrap

from beamfit.language import document as d
from beamfit.language.expression import iterators_text

# Superscripts and fractions count as letters in Python's regular expressions, but not in names.
NAME = re.compile(r"[^\W\d²³¹⁰⁴-⁹½¼¾][^\W²³¹⁰⁴-⁹½¼¾]*")
NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?")


def format_document(document: d.Document) -> str:
    """Write a document as text.

    Parameters
    ----------
    document : Document
        The document to write.

    Returns
    -------
    str

    Examples
    --------
    >>> from beamfit.language.parse import parse_document
    >>> short = "minimize y; variable x = .5 in [0, inf]; input x; output y; y = (x-1)^2;"
    >>> print(format_document(parse_document(short)))
    minimize y;
    variable x = 0.5 in [0, inf];
    <BLANKLINE>
    input x;
    output y;
    y = (x - 1)^2;
    <BLANKLINE>
    """
    parts = [*_problem(document.problem), *_solver(document.solver)]
    if document.mapping.name:
        parts.append(f"mapping {document.mapping.name};")
    return "\n".join([*parts, *([""] if parts else []), *_members(document.mapping), ""])


def format_statements(statements: Sequence[d.Statement]) -> str:
    """Write statements as the text of ``<expressions>``."""
    return "\n".join(_statements(statements))


def number_text(value: float) -> str:
    """Write a number that reads back the same; whole numbers have no decimal point."""
    value = float(value)
    signed = value == 0 and math.copysign(1.0, value) < 0
    whole = value.is_integer() and abs(value) < 1e15 and not signed
    return str(int(value)) if whole else repr(value)


def _name(text: str) -> str:
    return text if NAME.fullmatch(text) else json.dumps(text, ensure_ascii=False)


def _word(text: str) -> str:
    return text if NUMBER.fullmatch(text) else _name(text)


def _pair(low: float, high: float) -> str:
    return f"[{number_text(low)}, {number_text(high)}]"


def _problem(p: d.ProblemStatement | None) -> Iterable[str]:
    """Yield the lines of goals, variables and constraints."""
    if p is None:
        return
    for goal in p.goals:
        weight = "" if goal.weight == 1.0 else f" weight {number_text(goal.weight)}"
        yield f"{'maximize' if p.maximize else 'minimize'} {_label(goal)}{weight};"
    for v in p.variables:
        words = [f"variable {_label(v)}"]
        words += [f"= {number_text(v.value)}"] if v.value is not None else []
        bounded = (v.lower, v.upper) != (-math.inf, math.inf)
        words += [f"in {_pair(v.lower, v.upper)}"] if bounded else []
        words += [f"random {_pair(*v.random)}"] if v.random is not None else []
        words += [f"seed {v.seed}"] if v.seed else []
        yield " ".join(words) + ";"
    for limit in p.limits:
        low, high = limit.lower, limit.upper
        ends = [
            (low == high, "=", low),
            (low == -math.inf, "<=", high),
            (high == math.inf, ">=", low),
        ]
        short = next((f"{sign} {number_text(end)}" for holds, sign, end in ends
                      if holds and math.isfinite(end)), f"in {_pair(low, high)}")  # fmt: skip
        yield f"constraint {_label(limit)} {short};"


def _label(named: d.Goal | d.FreeInput | d.Limit) -> str:
    return _name(named.label) + ("" if named.model == named.label else f": {named.model}")


def _solver(s: d.Solver | None) -> Iterable[str]:
    if s is None:
        return
    settings = [f"  {_word(k)} = {_word(v)};" for k, v in s.settings]
    name = _name(s.name)
    yield "\n".join([f"solver {name} {{", *settings, "}"]) if settings else f"solver {name};"


def _members(m: d.Mapping) -> list[str]:
    """List the lines of tables, inner mappings, declarations and statements."""
    lines = [_table(t) for t in m.tables]
    for inner in m.mappings:
        mapping = isinstance(inner, d.Mapping)
        body = _members(inner) if mapping else [_network_part(p) for p in inner.parts]
        kind = "mapping" if mapping else "network"
        lines += [f"{kind} {inner.name} {{", *(indent(line, "  ") for line in body), "}"]
    groups = (("input", m.inputs), ("output", m.outputs), ("parameter", m.parameters))
    for word, names in groups:
        lines += _wrap_declarations(word, [_declared(n) for n in names])
    return lines + _statements(m.statements)


def _wrap_declarations(word: str, names: list[str]) -> list[str]:
    """Write declarations, several on a line, in as many lines as needed."""
    if not names:
        return []
    # Lines must not be broken within one declaration.
    joined = ", ".join(name.replace(" ", "\0") for name in names) + ";"
    lines = wrap(joined, 96, initial_indent=f"{word} ", subsequent_indent="  ",
                 break_long_words=False, break_on_hyphens=False)  # fmt: skip
    return [line.replace("\0", " ") for line in lines]


def _table(t: d.DataTable) -> str:
    size = "" if t.rows is None else f" [{t.rows}, {t.columns}]"
    return f"table {t.name} = {json.dumps(t.file, ensure_ascii=False)}{size};"


def _dims(dimensions: Sequence[str | int]) -> str:
    return f"[{', '.join(map(str, dimensions))}]" if dimensions else ""


def values_text(values: Sequence[float]) -> str:
    """Write the values of an array."""
    return f"[{', '.join(map(number_text, values))}]"


def _declared(n: d.Declared) -> str:
    value = ""
    if n.values is not None:
        single = not n.dimensions and len(n.values) == 1
        value = " = " + (number_text(n.values[0]) if single else values_text(n.values))
    return f"{n.name}{_dims(n.dimensions)}{value}"


def _network_part(p: d.NetworkElement) -> str:
    heads = 2 if p.kind == "connection" else 1
    name = " -> ".join(value for _, value in p.attributes[:heads])
    rest = ", ".join(f"{k} = {_word(v)}" for k, v in p.attributes[heads:])
    values = "" if p.values is None else f" = {values_text(p.values)}"
    return f"{p.kind} {name}{f' ({rest})' if rest else ''}{values};"


def _iterators(each: Sequence) -> str:
    return f" foreach {iterators_text(tuple(each))}" if each else ""


def _connections(wires: Sequence[d.Assignment]) -> str:
    return "; ".join(f"{w.target} = {w.value}{_iterators(w.each)}" for w in wires)


def _statements(statements: Sequence[d.Statement]) -> list[str]:
    """List the lines of statements; local variables are joined on a line."""
    lines: list[str] = []
    for kind, group in groupby(statements, type):
        if kind is d.Real:
            lines += _wrap_declarations("real", [
                f"{r.name}{_dims(r.dimensions)}{'' if r.value is None else f' = {r.value}'}"
                for r in group
            ])  # fmt: skip
        else:
            lines += [line for one in group for line in _statement(one)]
    return lines


def _statement(s: d.Statement) -> list[str]:
    """List the lines of one statement."""
    match s:
        case d.IndexedSet():
            return [f"set {s.name} = {s.elements};"]
        case d.Function():
            return [f"function {s.name}({', '.join(s.arguments)}) = {s.body};"]
        case d.Assignment():
            return [f"{s.target} = {s.value}{_iterators(s.each)};"]
        case d.Call():
            inner = f"{_connections(s.inputs)} :: {_connections(s.outputs)}".strip()
            return [f"{s.mapping}({inner}){_iterators(s.each)};"]
        case d.Block():
            body = [indent(line, "  ") for line in _statements(s.statements)]
            return [_iterators(s.each).strip() + " {", *body, "}"]
