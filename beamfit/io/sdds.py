"""The columns of an ASCII SDDS file, by its header.

The format: M. Borland, "A Self-Describing File Protocol for Simulation Integration and Shared
Postprocessors", PAC 1995, and the SDDS manual of the APS (ops.aps.anl.gov/manuals/SDDStoolkit),
"Structure of the SDDS Header" and "Structure of SDDS ASCII Data Pages".
"""

from __future__ import annotations

import re
from itertools import islice, takewhile
from os import PathLike

from beamfit.errors import InputError
from beamfit.io.files import LONGEST_LINE, Numbered

SIGNATURE = "SDDS"
COMMAND = re.compile(r"\s*&(\w+)\b((?:\"(?:\\.|[^\"\\])*\"|[^\"])*?)&end", re.DOTALL)
FIELD = re.compile(r"(\w+)\s*=\s*(?:\"((?:\\.|[^\"\\])*)\"|([^,\s]+))")
# What ends an exponent or an index in a unit, and what begins one: 1/m$a2$n.
SHIFTS = {"$a": "^", "$b": "", "$n": "", "$e": ""}
# Lines that a header may have.
LONGEST = 5000
TABLE = "columns, a row a line; sdds2spreadsheet writes such a table"


def sdds_head(
    path: str | PathLike[str], lines: Numbered, comments: list[str]
) -> tuple[list[str], int, str, Numbered]:
    """Read the header of an SDDS file, up to the rows of its page.

    Parameters
    ----------
    path : str or path
        The file.
    lines : iterator of int and str
        Its lines and their numbers.
    comments : list of str
        Parameters, with their values, are added.

    Returns
    -------
    tuple
        Names of the columns, their units in brackets; the line where the header ends; a blank,
        which separates the cells; the rows.

    Raises
    ------
    InputError
        If the file is binary, has arrays, rows of several lines or a second page, or is cut off.

    Examples
    --------
    >>> head = ["SDDS1", "&column name=t, units=s, type=double &end", "&data mode=ascii &end", "1"]
    >>> names, *_, rows = sdds_head("a.sdds", enumerate([*head, "0.5"], 1), [])
    >>> names, list(rows)
    (['t [s]'], [(5, '0.5')])
    """
    columns, parameters, data, line = [], [], None, 0
    text = ""
    for line, one in islice(lines, LONGEST):
        text += "" if one.startswith(("!", SIGNATURE)) else one + "\n"
        while data is None and "&end" in one and (found := COMMAND.match(text)):
            text = text[found.end() :]
            fields = {name: quoted or plain for name, quoted, plain in FIELD.findall(found[2])}
            match found[1]:
                case "column":
                    columns.append(fields)
                case "parameter":
                    parameters.append(fields)
                case "data":
                    data = fields
                case "array" | "include":
                    raise InputError(f"an SDDS file with &{found[1]}", TABLE, path, line)
        if data is not None or len(text) > LONGEST_LINE:
            break
    _check(path, line, data, columns)
    rows = _values(path, lines, parameters, data, comments)
    return [_named(column) for column in columns], line, " ", rows


def _check(path: str | PathLike[str], line: int, data: dict | None, columns: list[dict]) -> None:
    if data is None or not all("name" in column for column in columns):
        raise InputError("an SDDS header without &data", TABLE, path, line)
    if data.get("mode") != "ascii":
        expected = f"an ASCII one: sddsconvert -ascii {path} NEW.sdds"
        raise InputError("a binary SDDS file", expected, path, line)
    if data.get("lines_per_row", "1") != "1" or not columns:
        raise InputError("an SDDS file without a row a line", TABLE, path, line)


def _named(column: dict[str, str]) -> str:
    """A name with its unit; a name may have it already."""
    unit = column.get("units", "")
    for mark, meant in SHIFTS.items():
        unit = unit.replace(mark, meant)
    return f"{column['name']} [{unit}]" if unit else column["name"]


def _values(
    path: str | PathLike[str], lines: Numbered, parameters: list[dict], data: dict, comments: list
) -> Numbered:
    """The rows of the first page, which must be the only one."""
    for _ in islice(lines, _count(data.get("additional_header_lines", "0")) or 0):
        pass
    told = ((line, text) for line, text in lines if not text.startswith("!"))
    for one in parameters:
        value = one["fixed_value"] if "fixed_value" in one else next(told, (0, ""))[1].strip()
        comments.append(f"{one.get('name', '')}: {value} {one.get('units', '')}".strip())
    if data.get("no_row_counts", "0") != "0":
        return _page(path, told)
    line, text = next(told, (None, ""))
    if (count := _count(text)) is None:
        raise InputError(f"'{text}'", "how many rows the page has", path, line)
    return _page(path, told, count)


def _count(text: str) -> int | None:
    return int(text) if re.fullmatch(r"\s*[0-9]{1,9}\s*", text) else None


def _page(path: str | PathLike[str], told: Numbered, most: int | None = None) -> Numbered:
    """The rows of the first page: so many, or up to a blank line."""
    count = 0
    for one in takewhile(_has_words, told) if most is None else islice(told, most):
        count += 1
        yield one
    if count < (most or 0):
        raise InputError(f"{count} rows", f"{most}, as the page says; is it cut off?", path)
    if (more := next(filter(_has_words, told), None)) is not None:
        expected = "one; sddscombine -merge makes one of all"
        raise InputError("a second page", expected, path, more[0])


def _has_words(numbered: tuple[int, str]) -> bool:
    return bool(numbered[1].strip())
