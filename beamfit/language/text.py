"""Text form of documents: how it is written, and what is wrong with one, in words.

`parse_document` reads what `format_document` writes back to the same document.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from itertools import groupby
from textwrap import indent, wrap
from typing import Any

from lark import Token
from lark.exceptions import UnexpectedCharacters, UnexpectedInput, UnexpectedToken

from beamfit.errors import InputError
from beamfit.language import document as d
from beamfit.language.expression import Place, error_at, iterators_text

# Letters in a line of a written document.
WIDTH = 96
NAME = re.compile(r"[^\W\d]\w*")
NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?")
# Most open brackets, and most letters of a wrong word in a message.
MOST_OPEN, LONGEST = 60, 30
BRACKET = re.compile(
    r"#[^\n]*|//[^\n]*|/\*.*?\*/|\"(?:\\.|[^\"\\\n])*\"|([(\[{])|([)\]}])|(/\*)", re.DOTALL
)
# Signs of other languages, and this one's.
SIGNS = {
    r"(?<=\d),(?=\d)": "a point before decimals",
    r"\*\*": "'^' for powers",
    r"==|:=|<-|[-+*/]=": "'=' between a name and its value",
    r"=>|≥": "'>='",
    r"=<|≤": "'<='",
    r"\.\.": "':' between the ends of a set",
    r"[×·]": "'*' for products",
    r"[÷\\]": "'/' for quotients",
}
# Words of other languages, and what this one begins so.
WORDS = {
    "for": "foreach", "while": "foreach", "loop": "foreach", "subject": "constraint",
    "st": "constraint", "limit": "constraint", "var": "variable", "param": "parameter",
    "const": "parameter", "def": "function", "min": "minimize", "max": "maximize",
    "objective": "minimize", "let": "real", "double": "real", "float": "real", "int": "real",
    "import": "table", "data": "table", "model": "mapping", "range": "set",
}  # fmt: skip
STARTS = """minimize maximize variable constraint solver mapping table network input output
parameter set real function foreach forall layer connection gain in random seed weight"""
KEYWORDS = STARTS.split()
CLOSING = {"(": ")", "[": "]", "{": "}"}
SAID = {
    "NAME": "a name", "NUMBER": "a number", "SIGNED": "a number", "STRING": "a text in quotes",
    "ADD": "an operator", "MULTIPLY": "an operator", "POWER": "an operator", "SEMICOLON": "';'",
    "COLON": "':'", "COMMA": "','", "LPAR": "'('", "RPAR": "')'", "LSQB": "'['", "RSQB": "']'",
    "LBRACE": "'{'", "RBRACE": "'}'", "EQUAL": "'='", "BAR": "'|'", "COMPARE": "<=, >=",
    "__ANON_0": "'->'", "__ANON_1": "'::'", "PART": "layer, connection, input, output or gain",
    "$END": "the end", "_IN": "in",
}  # fmt: skip


def format_document(document: d.Document) -> str:
    """Write a document as text.

    Parameters
    ----------
    document : Document
        What to write.

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
    """Write statements as they stand in ``<expressions>``."""
    return "\n".join(_statements(statements))


def number_text(value: float) -> str:
    """Write a number so that it reads back the same, whole ones without a point."""
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
    lines = [_table(t) for t in m.tables]
    for inner in m.mappings:
        mapping = isinstance(inner, d.Mapping)
        body = _members(inner) if mapping else [_part(p) for p in inner.parts]
        kind = "mapping" if mapping else "network"
        lines += [f"{kind} {inner.name} {{", *(indent(line, "  ") for line in body), "}"]
    groups = (("input", m.inputs), ("output", m.outputs), ("parameter", m.parameters))
    for word, names in groups:
        lines += _listed(word, [_declared(n) for n in names])
    return lines + _statements(m.statements)


def _listed(word: str, names: list[str]) -> list[str]:
    """Several declarations on a line, and as many lines as they need."""
    if not names:
        return []
    # Blanks within one declaration must not be broken.
    joined = ", ".join(name.replace(" ", "\0") for name in names) + ";"
    lines = wrap(joined, WIDTH, initial_indent=f"{word} ", subsequent_indent="  ",
                 break_long_words=False, break_on_hyphens=False)  # fmt: skip
    return [line.replace("\0", " ") for line in lines]


def _table(t: d.DataTable) -> str:
    size = "" if t.rows is None else f" [{t.rows}, {t.columns}]"
    return f"table {t.name} = {json.dumps(t.file, ensure_ascii=False)}{size};"


def _dims(dimensions: Sequence[str | int]) -> str:
    return f"[{', '.join(map(str, dimensions))}]" if dimensions else ""


def _values(values: Sequence[float]) -> str:
    return f"[{', '.join(map(number_text, values))}]"


def _declared(n: d.Declared) -> str:
    value = ""
    if n.values is not None:
        single = not n.dimensions and len(n.values) == 1
        value = " = " + (number_text(n.values[0]) if single else _values(n.values))
    return f"{n.name}{_dims(n.dimensions)}{value}"


def _part(p: d.NetworkElement) -> str:
    heads = 2 if p.kind == "connection" else 1
    name = " -> ".join(value for _, value in p.attributes[:heads])
    rest = ", ".join(f"{k} = {_word(v)}" for k, v in p.attributes[heads:])
    values = "" if p.values is None else f" = {_values(p.values)}"
    return f"{p.kind} {name}{f' ({rest})' if rest else ''}{values};"


def _each(each: Sequence) -> str:
    return f" foreach {iterators_text(tuple(each))}" if each else ""


def _wires(wires: Sequence[d.Assignment]) -> str:
    return "; ".join(f"{w.target} = {w.value}{_each(w.each)}" for w in wires)


def _statements(statements: Sequence[d.Statement]) -> list[str]:
    lines: list[str] = []
    for kind, group in groupby(statements, type):
        if kind is d.Real:
            lines += _listed("real", [
                f"{r.name}{_dims(r.dimensions)}{'' if r.value is None else f' = {r.value}'}"
                for r in group
            ])  # fmt: skip
        else:
            lines += [line for one in group for line in _statement(one)]
    return lines


def _statement(s: d.Statement) -> list[str]:
    match s:
        case d.IndexedSet():
            return [f"set {s.name} = {s.elements};"]
        case d.Function():
            return [f"function {s.name}({', '.join(s.arguments)}) = {s.body};"]
        case d.Assignment():
            return [f"{s.target} = {s.value}{_each(s.each)};"]
        case d.Call():
            inner = f"{_wires(s.inputs)} :: {_wires(s.outputs)}".strip()
            return [f"{s.mapping}({inner}){_each(s.each)};"]
        case d.Block():
            body = [indent(line, "  ") for line in _statements(s.statements)]
            return [_each(s.each).strip() + " {", *body, "}"]
    raise TypeError(s)


# ---- what is wrong with a text


def check_brackets(text: str) -> None:
    """Refuse brackets that a parser could not follow, and name the one that is not closed."""
    opened = []
    for match in BRACKET.finditer(text):
        if match[1]:
            opened.append(match)
        elif match[2] and opened and CLOSING[opened[-1][0]] == match[0]:
            opened.pop()
        elif match[2]:
            wanted = "no such bracket"
            if opened:
                line, last = _at(text, opened[-1].start()).line, opened[-1][0]
                wanted = f"'{CLOSING[last]}' for the '{last}' in line {line}"
            raise error_at(_at(text, match.start()), f"'{match[0]}'", wanted)
        elif match[3]:
            at = _at(text, match.start())
            raise error_at(at, "'/*', a comment that does not end", "'*/' behind it")
        if len(opened) > MOST_OPEN:
            found = f"more than {MOST_OPEN} brackets within each other"
            raise error_at(_at(text, match.start()), found, "fewer")
    if opened:
        at, last = _at(text, opened[-1].start()), opened[-1][0]
        raise error_at(at, f"'{last}' that is not closed", f"'{CLOSING[last]}' behind it")


def _at(text: str, position: int) -> Place:
    before = text[:position]
    return Place(before.count("\n") + 1, position - before.rfind("\n"))


def explained(error: UnexpectedInput, text: str) -> InputError:
    """Say where the text stops making sense, what stands there, and what could."""
    at, odd_at = Place(error.line, error.column), error.pos_in_stream or 0
    if known := _sign(text, odd_at):
        return known
    if isinstance(error, UnexpectedCharacters):
        expected = _choices(error.allowed or ())
        odd = text[error.pos_in_stream]
        return error_at(at, f"{odd!r}", expected)
    if not isinstance(error, UnexpectedToken):
        return error_at(at, "text that ends too early", "the rest of a statement")
    word, accepted = str(error.token), set(error.accepts or error.expected)
    before = error.token_history[-1] if error.token_history else None
    if hint := _misspelt(before, error.token, accepted):
        return hint
    ended = before is not None and (error.token.type == "$END" or before.line < error.token.line)
    if "SEMICOLON" in accepted and ended:
        behind = Place(before.end_line, before.end_column)
        return error_at(behind, f"no ';' behind '{short(before)}'", "';' at the end of a statement")
    if error.token.type == "$END":
        at = Place(before.end_line, before.end_column) if before is not None else at
        return error_at(at, "the end of the text", _choices(accepted))
    known = _habit(before, error.token, accepted, text) if before is not None else None
    return known or error_at(at, f"'{short(word)}'", _choices(accepted))


def _sign(text: str, odd_at: int) -> InputError | None:
    """Error for a sign of another language at a place or from the letter before it; or None."""
    for start in (odd_at, max(odd_at - 1, 0)):
        for sign, wanted in SIGNS.items():
            if found := re.compile(sign).match(text, start):
                return error_at(_at(text, start), f"'{found[0]}'", wanted)
    return None


def _habit(before: Token, token: Token, accepted: set[str], text: str) -> InputError | None:
    """Error for a habit of other languages: formulas as limits, |x|, products; or None."""
    here, found = Place(token.line, token.column), f"'{short(token)}'"
    if before in ("constraint", "minimize", "maximize") or (
        token == "(" and {"WEIGHT", "COMPARE"} & accepted
    ):
        return error_at(here, found, "the name of an output, set by a statement NAME = FORMULA;")
    if token == "," and "WEIGHT" in accepted:
        return error_at(here, found, "';', and a statement of its own for each goal")
    if token.type == "COMPARE" and before.type == "SIGNED":
        return error_at(here, found, "';', or in [LOW, HIGH] for two bounds")
    if token == "|" and "NUMBER" in accepted:
        return error_at(here, found, "a value; an absolute one is abs(...), |...| is a set")
    if before == "(" and token.type in ("NUMBER", "SIGNED"):
        return error_at(here, found, "'[' before an index; (...) calls a mapping")
    if "MULTIPLY" in accepted and token.type in ("NAME", "NUMBER"):
        found = f"'{short(token)}' behind '{short(before)}'"
        return error_at(here, found, "an operator between them, such as *, or ';'")
    return None


def _misspelt(before: Token | None, token: Token, accepted: set[str]) -> InputError | None:
    """A word that is nearly a keyword: the one that surprises, or the one before it."""
    words = {name.lower().lstrip("_") for name in accepted} & set(KEYWORDS)
    close = _near(token, words)
    if token.type == "NAME" and close:
        return error_at(Place(token.line, token.column), f"'{short(token)}'",
                        f"{_choices(accepted)} (did you mean {close}?)")  # fmt: skip
    if before is None or before.type != "NAME" or str(before) in KEYWORDS:
        return None
    at = Place(before.line, before.column)
    if token.type == "_IN" or (token.type == "NAME" and "_IN" in accepted):
        return None
    close = _near(before, KEYWORDS)
    if token.type in ("NAME", "STRING") and close:
        return error_at(at, f"'{short(before)}'", f"a statement (did you mean {close}?)")
    return None


def _near(word: str, keywords: Iterable[str]) -> str | None:
    """The keyword that another language's word or a mistyped one stands for, if there is one."""
    word = str(word).lower()
    if WORDS.get(word) in keywords:
        return WORDS[word]
    close = get_close_matches(word, sorted(keywords), n=1, cutoff=0.6) if len(word) > 1 else []
    return close[0] if close else None


def _choices(accepted: Any) -> str:
    """Accepted tokens in words."""
    said = {SAID.get(name, name.lower()) for name in accepted}
    if {"real", "set", "a name"} <= said:
        return "a statement"
    return " or ".join(filter(None, [", ".join(sorted(said)[:-1]), *sorted(said)[-1:]]))


def short(word: str) -> str:
    """A word as a message shows it."""
    return word if len(word) <= LONGEST else word[:LONGEST] + "..."
