"""Input that cannot be used, and verdicts: statuses and rules, each with its sentence."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from difflib import get_close_matches
from enum import StrEnum
from os import PathLike
from typing import Any, NamedTuple, TypeVar

# What no person wrote as a word: of a damaged file, say. Its beginning tells enough.
ENDLESS = re.compile(r"(\S{60})\S{60,}")

# Controls but for tab and line feed, letters that turn the direction, bytes that are not UTF-8.
UNSHOWN = re.compile(
    "[\0-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]"
)
# Letters of a message (four lines of a terminal), and of the end of a path shown in it.
LONGEST, LONGEST_PATH = 390, 120


@dataclass(eq=False)
class InputError(ValueError):
    """Input that cannot be used: where it is, what was found, what was expected.

    Only unusable input raises in beamfit; a fit that cannot be trusted is a value with a
    status. The command line prints this on one line and exits with status 2.

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
        The column's name, or the key's in a TOML file; in a text the place in its line, from 1.

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
        place = path if len(path) <= LONGEST_PATH else "..." + path[-LONGEST_PATH:]
        place += "" if self.line is None else f":{self.line}"
        named = isinstance(self.column, str)
        place += f":{self.column}" if place and self.column is not None and not named else ""
        place += ": " if place else ""
        said = f"column '{short(self.column, LONGEST_PATH)}': " if named else ""
        said, found, expected = (_worded(part) for part in (said, self.found, self.expected))
        room = LONGEST - len(f"{place}{said} ; expected ")
        found = short(found, max(room // 3, room - len(expected)))
        expected = short(expected, room - len(found))
        return " ".join(f"{place}{said} {found}; expected {expected}".split())


@contextmanager
def located(path: str | PathLike[str] | None, line: int | None = None) -> Iterator[None]:
    """Name a file, and a line, in what is raised here by code that knows of none.

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


def _worded(text: str) -> str:
    return ENDLESS.sub(r"\1...", plain(" ".join(text.split())))


def short(text: str, most: int) -> str:
    """Leave out the middle of what is too long: an end often says what to do.

    Examples
    --------
    >>> short("one of Q1, Q2, Q3, Q4, Q5, Q6 (did you mean Q2?)", 40)
    'one of Q1, Q2,  ... 6 (did you mean Q2?)'
    """
    end = min(120, most // 2)
    return text if len(text) <= most else f"{text[: most - end - 5]} ... {text[-end:].lstrip()}"


def expect(value: object, kind: Any, instead: str) -> None:
    """Refuse a value of another type where one of beamfit's own is meant.

    Examples
    --------
    >>> expect("scan.csv", dict, "read_quad_scan(path)")
    Traceback (most recent call last):
    beamfit.errors.InputError: a str, 'scan.csv'; expected a dict, such as read_quad_scan(path)
    """
    if not isinstance(value, kind):
        said = f", '{value}'" if isinstance(value, str | PathLike) else ""
        found, expected = (_article(getattr(k, "__name__", "path")) for k in (type(value), kind))
        raise InputError(found + said, f"{expected}, such as {instead}")


def _article(name: str) -> str:
    return f"{'an' if name[0] in 'AEIOaeio' else 'a'} {name}"


def plain(text: str) -> str:
    r"""Write what a terminal would obey or turn round, and bytes that are no text, as escapes.

    Examples
    --------
    >>> print(plain("Q1\x1b[2J \udcff"))
    Q1\x1b[2J \xff
    """
    return UNSHOWN.sub(_escaped, text)


def _escaped(found: re.Match[str]) -> str:
    code = ord(found[0])
    code -= 0xDC00 if 0xDC80 <= code <= 0xDCFF else 0  # a byte of a name that is not UTF-8
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}"


def nearest(word: str, known: list[str]) -> str:
    """Offer the nearest known name, for the end of an error message.

    Parameters
    ----------
    word : str
        The name that was not understood.
    known : list of str
        The names that would have been.

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
    """Outcome of a fit or of a search for an optimum, always with a sentence beside it.

    Of a fit to data anything but ``converged`` is a warning. An objective without data is never
    ``converged``, ``unidentified``, ``at_limit`` or ``poor_fit``: it is ``optimal``,
    ``local_optimum`` (others were seen, or nobody looked), ``degenerate``, ``saddle``, or has no
    answer as a fit may have none.

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
        """Colour on screen: green; yellow where what is told holds but some is open; red else."""
        good = (Status.converged, Status.optimal)
        open_ = (Status.unidentified, Status.at_limit, Status.local_optimum)
        return "green" if self in good else "yellow" if self in open_ else "red"


class Finding(NamedTuple):
    """Finding of a rule: a status, the cause in words, and the remedy.

    `about` names what the finding speaks of.
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
    """A result with a ``finding``: its status, and its message of cause and remedy."""

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
    """Give the finding of the first rule that has one: rules stand in order of gravity.

    Parameters
    ----------
    evidence
        What the rules look at.
    rules : sequence of callable
        Each takes the evidence and gives a `Finding` or None; the last one always finds something.

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
