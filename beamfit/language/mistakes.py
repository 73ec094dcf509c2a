"""Error messages for mistakes in the text of a document: place, wrong word, remedy."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from difflib import get_close_matches
from typing import Any

from lark import Token
from lark.exceptions import UnexpectedCharacters, UnexpectedToken

from beamfit.errors import InputError
from beamfit.language.expression import FUNCTIONS, Place, error_at

# Largest number of nested brackets.
MAX_OPEN = 60
# Largest number of letters of a wrong word in a message.
MAX_LETTERS = 30
# Comments and quoted texts, or an opening bracket, a closing one, a comment that does not end.
BRACKET = re.compile(
    r"#[^\n]*|//[^\n]*|/\*.*?\*/|\"(?:\\.|[^\"\\\n])*\"|([(\[{])|([)\]}])|(/\*)", re.DOTALL
)
# Superscript digits.
POWERS = "²³¹⁰⁴-⁹"
CONDITIONS = "no conditions; abs, sign, min(a, b) and max(a, b) are there"
# Patterns of signs of other languages, mathematics and units, with the remedy in this language.
SIGNS = {
    r"(?<=\d),(?=\d)": "a point before decimals",
    r"\*\*": "'^' for powers",
    rf"[{POWERS}]+": "'^' and a number for powers",
    r"[½¼¾]": "a number such as 0.5",
    r"==|:=|<-|[-+*/]=": "'=' between a name and its value",
    r"!=|≠|<>": "'<=', '>=' or '='",
    r"=>|≥": "'>='",
    r"=<|≤": "'<='",
    r"(?<![-=])[<>](?!=)": "'<=' or '>=' of a limit; formulas have no conditions",
    r"\.\.": "':' between the ends of a set",
    r"[×·]": "'*' for products",
    r"[÷\\]": "'/' for quotients",
    r"[−–—]": "'-'",
    r"±|\+/?-(?=\s*[\d.])": "a value, or in [LOW, HIGH] for bounds",
    "∞|infinity": "inf",
    "√": "sqrt(...)",
    "[∑∏]": "sum(k in K | ...) or prod(k in K | ...)",
    "∈": "in",
    "∀": "foreach",
    "[°‰]": "a number without a unit",
    "%": "a number without a unit, or '#' before a comment",
    r"\.(?=[*/^])": "'*', '/' or '^': they work element by element",
    r"\.(?=[^\W\d])": "a name without a point, such as exp",
    "[?!&]|\\|\\|": CONDITIONS,
    "'": "a name without an apostrophe, or transpose(...)",
    "[“”„‘’]": 'straight quotes, "..."',
}
# Words of other languages, and the keyword of this one.
WORDS = {
    "for": "foreach", "while": "foreach", "loop": "foreach", "subject": "constraint",
    "st": "constraint", "limit": "constraint", "var": "variable", "param": "parameter",
    "const": "parameter", "def": "function", "min": "minimize", "max": "maximize",
    "objective": "minimize", "let": "real", "double": "real", "float": "real", "int": "real",
    "import": "table", "data": "table", "model": "mapping", "range": "set",
}  # fmt: skip
KEYWORDS = """minimize maximize variable constraint solver mapping table network input output
parameter set real function foreach forall layer connection gain in random seed weight""".split()  # noqa: SIM905
CLOSING = {"(": ")", "[": "]", "{": "}"}
TOKEN_TEXT = {
    "NAME": "a name", "NUMBER": "a number", "SIGNED": "a number", "STRING": "a text in quotes",
    "ADD": "an operator", "MULTIPLY": "an operator", "POWER": "an operator", "SEMICOLON": "';'",
    "COLON": "':'", "COMMA": "','", "LPAR": "'('", "RPAR": "')'", "LSQB": "'['", "RSQB": "']'",
    "LBRACE": "'{'", "RBRACE": "'}'", "EQUAL": "'='", "BAR": "'|'", "COMPARE": "<=, >=",
    "__ANON_0": "'->'", "__ANON_1": "'::'", "PART": "layer, connection, input, output or gain",
    "$END": "the end", "_IN": "in",
}  # fmt: skip


def check_brackets(text: str) -> None:
    """Raise an error for brackets that do not match or are nested too deep."""
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
        if len(opened) > MAX_OPEN:
            found = f"more than {MAX_OPEN} brackets within each other"
            raise error_at(_at(text, match.start()), found, "fewer")
    if opened:
        at, last = _at(text, opened[-1].start()), opened[-1][0]
        raise error_at(at, f"'{last}' that is not closed", f"'{CLOSING[last]}' behind it")


def _at(text: str, position: int) -> Place:
    return Place(1, 1).after(text[:position])


def explain(error: UnexpectedCharacters | UnexpectedToken, text: str) -> InputError:
    """Make the error for a text that does not parse: place, wrong word and what is expected."""
    at, position = Place(error.line, error.column), error.pos_in_stream or 0
    if error_found := _foreign_sign(text, position) or _foreign_sum(text, position):
        return error_found
    if isinstance(error, UnexpectedCharacters):
        # The parser allows all tokens of any such place: reduce them to the useful ones.
        names = {TOKEN_TEXT.get(name) for name in error.allowed or ()}
        expected = _choices(error.allowed or ())
        if "an operator" in names:
            ends = "a number, a name, '(' or a function"
            expected = ends if "a number" in names else "an operator, or the end of the formula"
        return error_at(at, f"{text[position]!r}", expected)
    word, accepted = str(error.token), set(error.accepts or error.expected)
    before = error.token_history[-1] if error.token_history else None
    if hint := _misspelling(before, error.token, accepted):
        return hint
    ended = error.token.type == "$END" or (before is not None and before.line < error.token.line)
    if "SEMICOLON" in accepted and ended:
        end = _at(text, len(text.rstrip()))
        end = end if before is None else Place(before.end_line, before.end_column)
        where = "" if before is None else f" behind '{shorten(before)}'"
        return error_at(end, f"no ';'{where}", "';' at the end of a statement")
    if error.token.type == "$END":
        at = Place(before.end_line, before.end_column) if before is not None else at
        return error_at(at, "the end of the text", _choices(accepted))
    error_found = (
        _foreign_habit(before, error.token, accepted, text) if before is not None else None
    )
    return error_found or error_at(at, f"'{shorten(word)}'", _choices(accepted))


def _foreign_sign(text: str, position: int) -> InputError | None:
    """Make the error for a sign of another language at a position or the one before, or None."""
    for start in (position, max(position - 1, 0)):
        for sign, wanted in SIGNS.items():
            if found := re.compile(sign).match(text, start):
                return error_at(_at(text, start), f"'{found[0]}'", wanted)
    return None


def _foreign_sum(text: str, position: int) -> InputError | None:
    """Make the error for a sum written as in another language, or None."""
    before = text[:position]
    named = r"\b(sum|prod|min|max|mean)\s*\(\s*\w+\s+in\s+\w+\s*"
    comma = re.search(named + r"(?:(,)\s*\w*\s*[^\w\s|;][^|;]*|(:))$", text[: position + 1])
    if comma:
        wanted = f"'|' behind the set: {comma[1]}(k in K | ...)"
        sign = 2 if comma[2] else 3
        return error_at(_at(text, comma.start(sign)), f"'{comma[sign]}'", wanted)
    opened = before.rfind(";") + 1
    if re.match(r"for\b", text[position:]) and re.search(
        r"\b(sum|prod|mean)\s*\(", before[opened:]
    ):
        return error_at(_at(text, position), "'for'", "the iterator first: sum(k in K | ...)")
    return None


STARTING = {"LPAR", "EQUAL", "LSQB"}
OPERATORS = ("ADD", "MULTIPLY", "POWER")
NUMBER_ONLY = "a number; a formula needs a statement of its own, NAME = FORMULA;"
# Habits of other languages. Each has a condition on the token before, the token, and the accepted
# kinds of token; the text of what is expected; True if the wrong token is the one before.
HABITS: tuple[tuple[Callable[[Token, Token, set[str]], Any], str, bool], ...] = (
    (lambda b, t, a: b in ("if", "not"), CONDITIONS, True),
    (lambda b, t, a: t in ("and", "or", "then", "else"), CONDITIONS, False),
    (lambda b, t, a: b.type == "SIGNED" and t.type in OPERATORS, NUMBER_ONLY, False),
    (lambda b, t, a: "SIGNED" in a and t.type == "NAME", NUMBER_ONLY, False),
    (lambda b, t, a: b in ("constraint", "minimize", "maximize") and t.type == "COLON",
     "a name right behind it", False),
    (lambda b, t, a: b in ("constraint", "minimize", "maximize")
     or (t == "(" and {"WEIGHT", "COMPARE"} & a),
     "the name of an output, set by a statement NAME = FORMULA;", False),
    (lambda b, t, a: "WEIGHT" in a and (t == "," or t.type in OPERATORS),
     "';', and a statement of its own for each goal", False),
    (lambda b, t, a: "COMPARE" in a and t.type in OPERATORS,
     "the name of an output, set by a statement NAME = FORMULA;", False),
    (lambda b, t, a: t.type == "COMPARE" and b.type == "SIGNED",
     "';', or in [LOW, HIGH] for two bounds", False),
    (lambda b, t, a: t == "|" and "NUMBER" in a,
     "a value; an absolute one is abs(...), a set is declared by set K = |...|;", False),
    (lambda b, t, a: a == STARTING and t.type == "COLON", "a name right behind it", False),
    (lambda b, t, a: a == STARTING and t.type in ("NAME", "STRING"),
     "a keyword that begins a statement, or NAME = FORMULA;", True),
    (lambda b, t, a: a == STARTING and t.type == "COMPARE",
     "NAME = FORMULA; a limit is constraint NAME <= VALUE;", False),
    (lambda b, t, a: a == STARTING and t.type in OPERATORS,
     "NAME = FORMULA; with a name alone on the left", False),
    (lambda b, t, a: a <= STARTING and "EQUAL" in a,
     "'=' as in NAME = FORMULA; a function is declared by function f(x) = ...;", False),
    (lambda b, t, a: b == "(" and t.type in ("NUMBER", "SIGNED"),
     "'[' before an index; (...) calls a mapping", False),
    (lambda b, t, a: b in FUNCTIONS and t.type in ("NAME", "NUMBER", "SIGNED"),
     "brackets around its argument", True),
    (lambda b, t, a: t == "(" and "MULTIPLY" in a and b.type in ("NUMBER", "SIGNED"),
     "an operator before '('; a power of a function is written sin(x)^2", False),
    (lambda b, t, a: "MULTIPLY" in a and t.type in ("NAME", "NUMBER", "SIGNED"),
     "an operator between them, such as *, or ';'", False),
    (lambda b, t, a: (b.type in ("SIGNED", "NUMBER") or b == "]") and t.type == "NAME",
     "';', or in [LOW, HIGH] of a variable; numbers have no units", False),
    (lambda b, t, a: b == "," and t.type in ("SIGNED", "NUMBER"),
     "several values as [1, 2, 3]", False),
    (lambda b, t, a: a == {"LSQB"}, "'[' as in [LOW, HIGH]", False),
    (lambda b, t, a: "BAR" in a and a <= {"BAR", "NAME"},
     "'|' around a set: |FIRST:LAST| or |A, B, C|", False),
    (lambda b, t, a: "LSQB" in a and t in ("(", "{") and b.type == "NAME",
     "'[' around indices and sizes", False),
    (lambda b, t, a: t in ("[", "{") and "LPAR" in a, "(...) around a part of a formula", False),
)  # fmt: skip


def _foreign_habit(before: Token, token: Token, accepted: set[str], text: str) -> InputError | None:
    """Make the error for a habit of other languages (formulas as limits, |x|, units), or None."""
    for is_one, wanted, earlier in HABITS:
        if is_one(before, token, accepted):
            wrong = before if earlier else token
            pair = " between them" in wanted
            found = f"'{shorten(wrong)}'" + (f" behind '{shorten(before)}'" if pair else "")
            return error_at(Place(wrong.line, wrong.column), found, wanted)
    return None


def _misspelling(before: Token | None, token: Token, accepted: set[str]) -> InputError | None:
    """Make the error for a misspelt keyword: the unexpected word or the one before it, or None."""
    words = {name.lower().lstrip("_") for name in accepted} & set(KEYWORDS)
    close = _closest_keyword(token, words)
    if token.type == "NAME" and close:
        return error_at(Place(token.line, token.column), f"'{shorten(token)}'",
                        f"{_choices(accepted)} (did you mean {close}?)")  # fmt: skip
    if before is None or before.type != "NAME" or str(before) in KEYWORDS:
        return None
    at = Place(before.line, before.column)
    if token.type == "_IN" or (token.type == "NAME" and "_IN" in accepted):
        return None
    close = _closest_keyword(before, KEYWORDS)
    if token.type in ("NAME", "STRING") and close:
        return error_at(at, f"'{shorten(before)}'", f"a statement (did you mean {close}?)")
    return None


def _closest_keyword(word: str, keywords: Iterable[str]) -> str | None:
    """Find the keyword meant by a misspelt word or one of another language, or None."""
    word = str(word).lower()
    if WORDS.get(word) in keywords:
        return WORDS[word]
    close = get_close_matches(word, sorted(keywords), n=1, cutoff=0.6) if len(word) > 1 else []
    return close[0] if close else None


def _choices(accepted: Any) -> str:
    """Describe the accepted tokens."""
    texts = {TOKEN_TEXT.get(name, name.lower()) for name in accepted}
    if {"real", "set", "a name"} <= texts:
        return "a statement"
    return " or ".join(filter(None, [", ".join(sorted(texts)[:-1]), *sorted(texts)[-1:]]))


def shorten(word: str) -> str:
    """Shorten a long word for a message."""
    return word if len(word) <= MAX_LETTERS else word[:MAX_LETTERS] + "..."
