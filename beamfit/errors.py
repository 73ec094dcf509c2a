"""The one exception a user meets: input that cannot be used, and how to mend it."""

from __future__ import annotations

import re
from dataclasses import dataclass
from difflib import get_close_matches
from os import PathLike

__all__ = ["InputError", "nearest"]

# What no person wrote as a word: of a damaged file, say. Its beginning tells enough.
ENDLESS = re.compile(r"(\S{60})\S{60,}")


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
        place = "" if self.path is None else str(self.path)
        place += "" if self.line is None else f":{self.line}"
        named = isinstance(self.column, str)
        place += f":{self.column}" if place and self.column is not None and not named else ""
        place += ": " if place else ""
        said = f"column '{self.column}': " if named else ""
        said = ENDLESS.sub(r"\1...", f"{said}{self.found}; expected {self.expected}")
        return " ".join(f"{place}{said}".split())


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
