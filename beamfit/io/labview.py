"""The columns of a LabVIEW measurement file, by its header.

The format: National Instruments, "Specification for the LabVIEW Measurement File (.lvm)",
ni.com/tutorial/4139: tags and their values between separators, a line a tag; one block for the
file, one for the channels, each up to ***End_of_Header***; the names of the columns; the rows.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from os import PathLike

from beamfit.errors import InputError
from beamfit.io.files import Numbered
from beamfit.io.headers import known_unit

SIGNATURE = "LabVIEW Measurement"
END = "***End_of_Header***"
# Lines that both blocks may have.
LONGEST = 500


def labview_head(
    path: str | PathLike[str], lines: Numbered, comments: list[str]
) -> tuple[list[str], int, str, Numbered]:
    """Read the header of a LabVIEW measurement file.

    Parameters
    ----------
    path : str or path
        The file.
    lines : iterator of int and str
        Its lines and their numbers.
    comments : list of str
        Tags and their values are added.

    Returns
    -------
    tuple
        Names of the columns, their units in brackets; their line; the separator; the rows.

    Raises
    ------
    InputError
        If the header does not end, or the rows have no X value, or one for each channel.

    Examples
    --------
    >>> head = ["LabVIEW Measurement", "X_Columns\\tOne", END, "Y_Unit_Label\\tmA", END]
    >>> rows = [*head, "X_Value\\tDCCT\\tComment", "0\\t1.5"]
    >>> labview_head("a.lvm", enumerate(rows, 1), [])[0]
    ['X_Value', 'DCCT [mA]']
    """
    tags: dict[str, list[str]] = {}
    separator, blocks = "\t", 0
    for line, text in itertools.islice(lines, LONGEST):
        first, *rest = (cell.strip() for cell in text.split(separator))
        separator = "," if first == "Separator,Comma" else separator
        blocks += first.startswith(END)
        if blocks == 2 and first and not first.startswith(END):
            return _names([first, *rest], tags, path, line), line, separator, lines
        tags.setdefault(first, rest)
        comments += [f"{first}: {' '.join(filter(None, rest))}"] * bool(first and any(rest))
    expected = f"two lines {END}, the names of the columns, and rows"
    raise InputError("a LabVIEW header that does not end", expected, path)


def _names(
    names: list[str], tags: Mapping[str, list[str]], path: str | PathLike[str], line: int
) -> list[str]:
    """The names of the columns; a label that is no unit, as LabVIEW's own Volts, says nothing."""
    if (columns := tags.get("X_Columns", ["One"])[:1]) != ["One"]:
        expected = 'X value columns "One column only", as LabVIEW calls it where it writes the file'
        raise InputError(f"X_Columns {columns}", expected, path, line)
    while names[-1] in ("", "Comment"):
        names.pop()
    units = {i: known_unit(label) for i, label in enumerate(tags.get("Y_Unit_Label", ()), 1)}
    if tags.get("X_Dimension", [""])[0] == "Time":
        names[0], units[0] = "time", "s"
    return [f"{name} [{units[i]}]" if units.get(i) else name for i, name in enumerate(names)]
