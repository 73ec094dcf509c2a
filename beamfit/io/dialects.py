"""Translate MAD-8 and elegant files to statements of MAD-X, line by line."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import NamedTuple

from beamfit.io.madx_values import NAME, words

# Comments; also quoted texts, in which no comment begins.
COMMENT = re.compile(r"\"[^\"\n]*\"|'[^'\n]*'|![^\n]*")
# MAD-8: a block of comments, and the text below TITLE.
MAD8_PROSE = re.compile(
    r"^[ \t]*(?:comment\b.*?^[ \t]*endcomment\b|title[ \t]*\n)[^\n]*", re.I | re.M | re.DOTALL
)
USE = re.compile(rf"^([ \t]*use[ \t]*,[ \t]*)({NAME})[ \t]*$", re.I | re.M)
CALL = re.compile(r"^([ \t]*call[ \t]*,[ \t]*)filename\b", re.I | re.M)
SET = re.compile(rf"^[ \t]*set[ \t]*,[ \t]*({NAME})[ \t]*,", re.I | re.M)
# elegant: a number stored by the calculator, an included file, and quoted text.
ELEGANT_STORE = re.compile(rf"^[ \t]*%(.*?)[ \t]sto[ \t]+({NAME})[ \t]*$", re.M)
INCLUDE = re.compile(r"^[ \t]*#include:[ \t]*\"?([^\"\n]*?)\"?[ \t]*$", re.I | re.M)
QUOTED = re.compile(r"(=[ \t]*)?\"([^\"\n]*)\"")
OPERAND = re.compile(rf"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eEdD][-+]?\d+)?|{NAME}")
# Operators of elegant's calculator (reverse Polish), as expressions of MAD-X.
BINARY = {"+": "+", "-": "-", "*": "*", "/": "/", "pow": "^"}
UNARY = {name: f"{name}({{}})" for name in words("sqrt sin cos tan asin acos atan exp abs")}
UNARY |= {"ln": "log({})", "log": "log10({})", "sqr": "({})^2", "rec": "1/({})", "chs": "0-({})"}
UNARY |= {"dsin": "sin(({})*raddeg)", "dcos": "cos(({})*raddeg)", "dtan": "tan(({})*raddeg)"}
# Class of MAD-X -> classes of elegant; those of "nothing" are no elements.
ELEGANT_CLASSES = {
    "drift": "drif edrift csrdrif csrdrift lscdrift ecol rcol scraper",
    "marker": "mark watch",
    "quadrupole": "quad kquad",
    "sextupole": "sext ksext kquse",
    "octupole": "octu koct",
    "multipole": "mult",
    "sbend": "sben csben csbend csrcsben csrcsbend",
    "rbend": "rben crben crbend",
    "kicker": "hkick vkick",
    "rfcavity": "rfca rfcw",
    "monitor": "moni hmon vmon",
    "solenoid": "sole",
    "nothing": "maxamp charge recirc malign sreffects pfilter energy scatter wake",
}
# Classes of MAD-8, which may be abbreviated to four letters.
MAD8_CLASSES = words(
    "drift marker quadrupole sextupole octupole multipole sbend rbend kicker hkicker vkicker "
    "rfcavity monitor hmonitor vmonitor imonitor blmonitor slmonitor instrument profile wire "
    "solenoid elseparator ecollimator rcollimator srotation yrotation beambeam"
)


class Dialect(NamedTuple):
    """Input language of a program.

    Attributes
    ----------
    name : str
        Name of the program.
    translate : callable
        Translates the text of a file to statements of MAD-X on the same lines.
    classes : mapping of str to str
        Class of MAD-X by the program's class, where they differ.
    parameters : tuple of str
        Parameters of elements in addition to those of MAD-X.
    particle : str
        Default particle.
    """

    name: str
    translate: Callable[[str], str] = str
    classes: Mapping[str, str] = {}
    parameters: tuple[str, ...] = ()
    particle: str = "positron"


def blank_comment(found: re.Match[str]) -> str:
    """Replace a comment by blanks; keep a quoted text."""
    return found[0] if found[0][0] in "\"'" else re.sub(r"[^\n]", " ", found[0])


def _terminate_lines(text: str) -> str:
    """End each line with a semicolon, except those continued by &."""
    lines = [line.rstrip() for line in COMMENT.sub(blank_comment, text).split("\n")]
    return "\n".join(line[:-1] if line.endswith("&") else f"{line};" for line in lines)


def from_mad8(text: str) -> str:
    """Translate MAD-8 to MAD-X; all expressions are deferred.

    Examples
    --------
    >>> from_mad8("Q: QUAD, L=0.1, &\\n  K1=R[K1]")
    'Q: QUAD, L:=0.1,\\n  K1:=R->K1;'
    """
    text = CALL.sub(r"\1file", SET.sub(r"\1 =", MAD8_PROSE.sub(blank_comment, text)))
    text = re.sub(rf"({NAME})\[({NAME})\]", r"\1->\2", USE.sub(r"\1period=\2", text))
    return re.sub(r"[ \t]*(?<!:)=", ":=", _terminate_lines(text).replace(", \n", ",\n"))


def from_elegant(text: str) -> str:
    """Translate elegant to MAD-X, including expressions of the calculator.

    Examples
    --------
    >>> from_elegant('% 2 3 * sto kq\\n"Q-1": KQUAD, L=0.1, K1="kq 1 +"')
    'kq = (2*3);\\nQ$2d$1: KQUAD, L=0.1, K1=(kq+1);'
    """
    text = INCLUDE.sub(r"call, file=\1", COMMENT.sub(blank_comment, text))
    text = ELEGANT_STORE.sub(lambda found: f"{found[2]} = {infix(found[1]) or '%'}", text)
    return _terminate_lines(USE.sub(r"\1period=\2", QUOTED.sub(_unquote, text)))


def _unquote(found: re.Match[str]) -> str:
    """Translate a quoted name or calculator expression; keep any other text."""
    if not found[1]:
        return encode_name(found[2])
    expression = infix(found[2])
    return found[0] if expression is None else found[1] + expression


def encode_name(name: str) -> str:
    """Encode characters that MAD-X does not allow in names.

    Examples
    --------
    >>> encode_name("BPM:1"), decode_name(encode_name("BPM:1"))
    ('BPM$3a$1', 'BPM:1')
    """
    return re.sub(r"[^\w.$]", lambda found: f"${ord(found[0]):x}$", name)


def decode_name(name: str) -> str:
    """Invert `encode_name`."""
    return re.sub(r"\$([0-9a-f]+)\$", lambda found: chr(int(found[1], 16)), name)


def infix(text: str) -> str | None:
    """Convert reverse Polish notation of elegant's calculator to an expression; None if invalid.

    Examples
    --------
    >>> infix("kq 2 * 1 -"), infix("%s.w1"), infix("-1 sqr")
    ('((kq*2)-1)', None, '(((-1))^2)')
    """
    stack: list[str] = []
    for word in text.split():
        if word in BINARY and len(stack) > 1:
            last = stack.pop()
            stack.append(f"({stack.pop()}{BINARY[word]}{last})")
        elif word in UNARY and stack:
            stack.append(f"({UNARY[word].format(stack.pop())})")
        elif word == "swap" and len(stack) > 1:
            stack[-2:] = stack[:-3:-1]
        elif OPERAND.fullmatch(word):
            stack.append(f"({word})" if word[0] in "+-" else word)
        else:
            return None
    return stack[0] if len(stack) == 1 else None


MADX = Dialect("MAD-X")
MAD8 = Dialect(
    "MAD-8",
    from_mad8,
    {word[:n]: word for word in MAD8_CLASSES for n in range(4, len(word))},
    (*(f"k{n}l" for n in range(10)), *(f"t{n}" for n in range(10))),
)
ELEGANT = Dialect(
    "elegant",
    from_elegant,
    {word: kind for kind, names in ELEGANT_CLASSES.items() for word in words(names)},
    words("b fse etilt bore use_bn edge1_effects edge2_effects order hgapx fint1 fint2"),
    "electron",
)
DIALECTS = {
    ".madx": MADX,
    ".seq": MADX,
    ".mad8": MAD8,
    ".mad": MAD8,
    ".lte": ELEGANT,
    ".elegant": ELEGANT,
}
