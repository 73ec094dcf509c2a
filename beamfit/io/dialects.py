"""MAD-8 and elegant files as statements of MAD-X, each on its line."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import NamedTuple

from beamfit.io.madx_values import NAME, words

# Comments, and the quotes in which there is none.
COMMENT = re.compile(r"\"[^\"\n]*\"|'[^'\n]*'|![^\n]*")
# Of MAD-8: a block of comments, and the text below TITLE.
PROSE = re.compile(
    r"^[ \t]*(?:comment\b.*?^[ \t]*endcomment\b|title[ \t]*\n)[^\n]*", re.I | re.M | re.DOTALL
)
USE = re.compile(rf"^([ \t]*use[ \t]*,[ \t]*)({NAME})[ \t]*$", re.I | re.M)
CALL = re.compile(r"^([ \t]*call[ \t]*,[ \t]*)filename\b", re.I | re.M)
SET = re.compile(rf"^[ \t]*set[ \t]*,[ \t]*({NAME})[ \t]*,", re.I | re.M)
# Of elegant: a number that is stored, a file that is read in its place, and quoted text.
STORED = re.compile(rf"^[ \t]*%(.*?)[ \t]sto[ \t]+({NAME})[ \t]*$", re.M)
INCLUDE = re.compile(r"^[ \t]*#include:[ \t]*\"?([^\"\n]*?)\"?[ \t]*$", re.I | re.M)
QUOTED = re.compile(r"(=[ \t]*)?\"([^\"\n]*)\"")
WORD = re.compile(rf"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eEdD][-+]?\d+)?|{NAME}")
# Operators of elegant's calculator, as expressions of MAD-X.
BINARY = {"+": "+", "-": "-", "*": "*", "/": "/", "pow": "^"}
UNARY = {name: f"{name}({{}})" for name in words("sqrt sin cos tan asin acos atan exp abs")}
UNARY |= {"ln": "log({})", "log": "log10({})", "sqr": "({})^2", "rec": "1/({})", "chs": "0-({})"}
UNARY |= {"dsin": "sin(({})*raddeg)", "dcos": "cos(({})*raddeg)", "dtan": "tan(({})*raddeg)"}
# Classes of elegant by what they are in MAD-X; the last are no elements.
LIKE = {
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
# MAD-8's words may be cut to four letters.
WHOLE = words(
    "drift marker quadrupole sextupole octupole multipole sbend rbend kicker hkicker vkicker "
    "rfcavity monitor hmonitor vmonitor imonitor blmonitor slmonitor instrument profile wire "
    "solenoid elseparator ecollimator rcollimator srotation yrotation beambeam"
)


class Dialect(NamedTuple):
    """A program's way to write lines.

    Attributes
    ----------
    name : str
        Of the program.
    translate : callable
        From the text of a file to statements of MAD-X on the same lines.
    classes : mapping of str to str
        Class of an element to that of MAD-X, where they differ.
    meant : tuple of str
        Parameters that MAD-X does not have.
    particle : str
        The particle where the file names none.
    """

    name: str
    translate: Callable[[str], str] = str
    classes: Mapping[str, str] = {}
    meant: tuple[str, ...] = ()
    particle: str = "positron"


def blanked(found: re.Match[str]) -> str:
    """Blanks in the place of a comment; a quoted text as it is."""
    return found[0] if found[0][0] in "\"'" else re.sub(r"[^\n]", " ", found[0])


def _ended(text: str) -> str:
    """Each line as a statement, but for those that & continues."""
    lines = [line.rstrip() for line in COMMENT.sub(blanked, text).split("\n")]
    return "\n".join(line[:-1] if line.endswith("&") else f"{line};" for line in lines)


def from_mad8(text: str) -> str:
    """Write statements of MAD-8 as MAD-X has them; all its expressions are evaluated late.

    Examples
    --------
    >>> from_mad8("Q: QUAD, L=0.1, &\\n  K1=R[K1]")
    'Q: QUAD, L:=0.1,\\n  K1:=R->K1;'
    """
    text = CALL.sub(r"\1file", SET.sub(r"\1 =", PROSE.sub(blanked, text)))
    text = re.sub(rf"({NAME})\[({NAME})\]", r"\1->\2", USE.sub(r"\1period=\2", text))
    return re.sub(r"[ \t]*(?<!:)=", ":=", _ended(text).replace(", \n", ",\n"))


def from_elegant(text: str) -> str:
    """Write statements of elegant as MAD-X has them, the calculator's as expressions.

    Examples
    --------
    >>> from_elegant('% 2 3 * sto kq\\n"Q-1": KQUAD, L=0.1, K1="kq 1 +"')
    'kq = (2*3);\\nQ$2d$1: KQUAD, L=0.1, K1=(kq+1);'
    """
    text = INCLUDE.sub(r"call, file=\1", COMMENT.sub(blanked, text))
    text = STORED.sub(lambda found: f"{found[2]} = {infix(found[1]) or '%'}", text)
    return _ended(USE.sub(r"\1period=\2", QUOTED.sub(_unquoted, text)))


def _unquoted(found: re.Match[str]) -> str:
    """A name, or a value that the calculator understands; other text as it is."""
    if not found[1]:
        return coded(found[2])
    said = infix(found[2])
    return found[0] if said is None else found[1] + said


def coded(name: str) -> str:
    """A name in letters that MAD-X has in names.

    Examples
    --------
    >>> coded("BPM:1"), decoded(coded("BPM:1"))
    ('BPM$3a$1', 'BPM:1')
    """
    return re.sub(r"[^\w.$]", lambda found: f"${ord(found[0]):x}$", name)


def decoded(name: str) -> str:
    """The name that `coded` wrote so."""
    return re.sub(r"\$([0-9a-f]+)\$", lambda found: chr(int(found[1], 16)), name)


def infix(text: str) -> str | None:
    """Write what elegant's calculator is told as an expression; None where it is none.

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
        elif WORD.fullmatch(word):
            stack.append(f"({word})" if word[0] in "+-" else word)
        else:
            return None
    return stack[0] if len(stack) == 1 else None


MADX = Dialect("MAD-X")
MAD8 = Dialect(
    "MAD-8",
    from_mad8,
    {word[:n]: word for word in WHOLE for n in range(4, len(word))},
    (*(f"k{n}l" for n in range(10)), *(f"t{n}" for n in range(10))),
)
ELEGANT = Dialect(
    "elegant",
    from_elegant,
    {word: kind for kind, names in LIKE.items() for word in words(names)},
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
