"""Syntax errors of the language in words."""

from __future__ import annotations

import re
from collections.abc import Iterable
from difflib import get_close_matches
from typing import Any

from lark import Token
from lark.exceptions import UnexpectedCharacters, UnexpectedInput, UnexpectedToken

from beamfit.errors import InputError
from beamfit.language.expression import Place, error_at

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
