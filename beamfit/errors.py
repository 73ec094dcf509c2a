"""The exception for unusable input, and verdicts: statuses, findings and rules."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from difflib import get_close_matches
from enum import StrEnum
from os import PathLike
from typing import Any, NamedTuple, TypeVar

# A word of 120 or more characters, for example from a damaged file; only its beginning is shown.
LONG_WORD = re.compile(r"(\S{60})\S{60,}")

# Control characters except tab and line feed, characters that change the writing direction, and
# bytes that are not UTF-8.
UNPRINTABLE = re.compile(
    "[\0-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]"
)
# Longest message in characters: four lines of a terminal.
MAX_MESSAGE = 390
# Longest part of a path, or of a column name, shown in a message.
MAX_PATH = 120


@dataclass(eq=False)
class InputError(ValueError):
    """Unusable input: its place, what was found, and what was expected.

    Only unusable input raises in beamfit; a fit that cannot be trusted is a result with a
    status. The command line prints this error on one line and exits with status 2.

    Parameters
    ----------
    found : str
        What was found.
    expected : str
        What was expected there, and what to do.
    path : str or path, optional
        The file.
    line : int, optional
        Line in the file, counted from 1.
    column : str or int, optional
        Name of the column, or of the key in a TOML file; an integer is the position in the line,
        counted from 1.

    Examples
    --------
    >>> print(InputError("no number in '12,3x'", "a current in ampere", path="scan.csv", line=7))
    scan.csv:7: no number in '12,3x'; expected a current in ampere
    """

    found: str
    expected: str
    path: str | PathLike[str] | None = None
    line: int | None = None
    column: str | int | None = None

    def __str__(self) -> str:
        path = "" if self.path is None else plain(str(self.path))
        place = path if len(path) <= MAX_PATH else "..." + path[-MAX_PATH:]
        place += "" if self.line is None else f":{self.line}"
        named = isinstance(self.column, str)
        place += f":{self.column}" if place and self.column is not None and not named else ""
        place += ": " if place else ""
        said = f"column '{short(self.column, MAX_PATH)}': " if named else ""
        said, found, expected = (_clean(part) for part in (said, self.found, self.expected))
        room = MAX_MESSAGE - len(f"{place}{said} ; expected ")
        found = short(found, max(room // 3, room - len(expected)))
        expected = short(expected, room - len(found))
        return " ".join(f"{place}{said} {found}; expected {expected}".split())


@contextmanager
def located(path: str | PathLike[str] | None, line: int | None = None) -> Iterator[None]:
    """Add a file and a line to an `InputError` raised inside the context without them.

    Examples
    --------
    >>> with located("scan.csv"):
    ...     raise InputError("no rows", "at least three")
    Traceback (most recent call last):
    beamfit.errors.InputError: scan.csv: no rows; expected at least three
    """
    try:
        yield
    except InputError as error:
        error.path = path if error.path is None else error.path
        error.line = line if error.line is None else error.line
        raise


def _clean(text: str) -> str:
    return LONG_WORD.sub(r"\1...", plain(" ".join(text.split())))


def short(text: str, most: int) -> str:
    """Shorten a text by leaving out words in its middle; its end often says what to do.

    Examples
    --------
    >>> short("one of Q1, Q2, Q3, Q4, Q5, Q6 (did you mean Q2?)", 40)
    'one of Q1, Q2, ... (did you mean Q2?)'
    """
    if len(text) <= most:
        return text
    end = min(120, most // 2)
    begin = most - end - 5
    first = text[: begin + 1].rpartition(" ")[0] or text[:begin]
    last = text[-end - 1 :].partition(" ")[2] or text[-end:]
    return f"{first} ... {last}"


def expect(value: object, kind: Any, instead: str) -> None:
    """Raise an `InputError` if a value does not have the expected type.

    Examples
    --------
    >>> expect("scan.csv", dict, "read_quad_scan(path)")
    Traceback (most recent call last):
    beamfit.errors.InputError: a str, 'scan.csv'; expected a dict, such as read_quad_scan(path)
    """
    if not isinstance(value, kind):
        said = f", '{value}'" if isinstance(value, str | PathLike) else ""
        found, expected = (
            _with_article(getattr(k, "__name__", "path")) for k in (type(value), kind)
        )
        raise InputError(found + said, f"{expected}, such as {instead}")


def _with_article(name: str) -> str:
    return f"{'an' if name[0] in 'AEIOaeio' else 'a'} {name}"


def plain(text: str) -> str:
    r"""Write control characters, direction marks and invalid bytes as escapes.

    Examples
    --------
    >>> print(plain("Q1\x1b[2J \udcff"))
    Q1\x1b[2J \xff
    """
    return UNPRINTABLE.sub(_escape, text)


def _escape(found: re.Match[str]) -> str:
    code = ord(found[0])
    code -= 0xDC00 if 0xDC80 <= code <= 0xDCFF else 0  # a byte of a name that is not UTF-8
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}"


def nearest(word: str, known: list[str]) -> str:
    """List the known names and suggest the nearest one, for the end of an error message.

    Parameters
    ----------
    word : str
        The unknown name.
    known : list of str
        The accepted names.

    Returns
    -------
    str
        A sentence part such as ``one of Q1, Q2 (did you mean Q2?)``.

    Examples
    --------
    >>> nearest("q2", ["Q1", "Q2"])
    'one of Q1, Q2 (did you mean Q2?)'
    """
    lowered = {name.lower(): name for name in reversed(known)}
    close = get_close_matches(word.lower(), list(lowered), n=1, cutoff=0.4)
    hint = f" (did you mean {lowered[close[0]]}?)" if close else ""
    listed = ", ".join(known[:20]) + (", ..." if len(known) > 20 else "")
    return f"one of {listed}{hint}" if known else "none, because there are none"


Evidence = TypeVar("Evidence")


class Status(StrEnum):
    """Outcome of a fit or of a search for an optimum, always given with a sentence.

    For a fit to data every status except ``converged`` is a warning. An objective without data is
    never ``converged``, ``unidentified``, ``at_limit`` or ``poor_fit``; instead it is ``optimal``,
    ``local_optimum`` (not proved to be the lowest), ``degenerate`` or ``saddle``, or it has no
    answer, like a fit.

    Examples
    --------
    >>> str(Status.poor_fit)
    'poor_fit'
    """

    converged = "converged"
    poor_fit = "poor_fit"
    unidentified = "unidentified"
    at_limit = "at_limit"
    infeasible = "infeasible"
    not_finite = "not_finite"
    not_converged = "not_converged"
    unbounded = "unbounded"
    contradictory_bounds = "contradictory_bounds"
    optimal = "optimal"
    local_optimum = "local_optimum"
    saddle = "saddle"
    degenerate = "degenerate"

    @property
    def colour(self) -> str:
        """Colour on screen: green; yellow if something is not determined; red: do not use."""
        good = (Status.converged, Status.optimal)
        open_ = (Status.unidentified, Status.at_limit, Status.local_optimum)
        return "green" if self in good else "yellow" if self in open_ else "red"


class Finding(NamedTuple):
    """Finding of a rule: a status, the cause in words, and the remedy.

    `about` lists the names of the parameters or constraints concerned.
    """

    status: Status
    cause: str
    remedy: str = ""
    about: tuple[str, ...] = ()

    @property
    def message(self) -> str:
        """Cause and remedy as one text."""
        return f"{self.cause} {self.remedy}".strip()


class Judged:
    """Base of results with a ``finding``, which gives their status and message."""

    finding: Finding

    @property
    def status(self) -> Status:
        """Status of the finding."""
        return self.finding.status

    @property
    def message(self) -> str:
        """Cause of the status, and what to do."""
        return self.finding.message


Rule = Callable[[Evidence], Finding | None]


def judge(evidence: Evidence, rules: Sequence[Rule[Evidence]]) -> Finding:
    """Return the finding of the first rule that applies; rules are in order of severity.

    Parameters
    ----------
    evidence
        Argument of the rules.
    rules : sequence of callable
        Each takes the evidence and returns a `Finding` or None; the last one always returns one.

    Returns
    -------
    Finding

    Examples
    --------
    >>> def lost(points):
    ...     return Finding(Status.unidentified, "Too few points.") if points < 3 else None
    >>> def fine(points):
    ...     return Finding(Status.converged, "Enough points.")
    >>> judge(2, (lost, fine)).status.value, judge(9, (lost, fine)).status.value
    ('unidentified', 'converged')
    """
    return next(found for rule in rules if (found := rule(evidence)) is not None)
