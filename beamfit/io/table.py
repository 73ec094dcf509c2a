"""Sheets of named columns from text, JSON, HDF5, MATLAB and SDDS files, and data frames."""

from __future__ import annotations

import csv
import itertools
import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from beamfit.errors import InputError, expect
from beamfit.io.cells import check_length, is_number, numeric_rows, with_points
from beamfit.io.columns import (
    UNITS,
    Columns,
    Sheet,
    apply_layout,
    has_unit,
    headers_with_units,
    is_header,
    layout_of,
    unit_row,
)
from beamfit.io.files import Numbered, digest, first_bytes, laid_out, read_json, text_lines
from beamfit.io.isolated import library_columns, matlab_variables

if TYPE_CHECKING:
    from pandas import DataFrame

# Rows of a file, and cells of one that is not all plain numbers: each is a text, 200 bytes.
MOST_ROWS, MOST_WORDS = 12_000_000, 4_000_000
HDF5 = {".h5", ".hdf5"}
MATLAB = ".mat"
BINARY = {*HDF5, MATLAB}
SKIP = "; --skip-bad leaves such rows out"
# How Excel says which separator a file has.
SEPARATOR_LINE = re.compile(r"\s*\"?sep=.\"?\s*$", re.IGNORECASE)
# In the names of a file without a header: cells that are not read.
REST = "*"
TFS_LINES = ("@", "$")
# A file of the EPICS Archiver Appliance without a header begins so, and has these columns.
ARCHIVER = re.compile(r"\d{9,11}(,[^,]+){4}\s*")
ARCHIVED = ["secs", "val", "severity", "status", "nanos"]
JSON = "another JSON file"
EXPECTED = (
    'columns of equal lengths, {"name": [...]}, one object a row, [{"name": ...}], or one channel '
    'of the EPICS Archiver Appliance, [{"meta": …, "data": [{"secs": …}]}]'
)
WORD = re.compile(r'"[^"]*"|\S+')
# Lines that are looked through for the header below a title.
HEAD = 50
# How a line begins that is a comment: of Python, MATLAB, C, SDDS.
MARKS = ("#", "%", "//", "!")
# Of a TFS file.
TFS = ("@", "*", "$")


def read_columns(
    path: str | PathLike[str] | DataFrame,
    example: str,
    columns: Columns = None,
    ignore: Iterable[str] = (),
    skip_bad: bool = False,
    most: int = MOST_ROWS,
) -> Sheet:
    """Read the columns of a file under the names that a person says.

    Parameters
    ----------
    path, example, most
        As for `read_sheet`.
    columns : str, path, mapping or Layout, optional
        As `beamfit.io.columns.layout_of` reads it.
    ignore : iterable of str
        Columns to leave unread; * and ? stand for any letters.
    skip_bad : bool
        Leave out rows that have not as many cells as the header.

    Raises
    ------
    InputError
        As `read_sheet`, and of what is said of columns.
    """
    layout = layout_of(columns)
    sheet = read_sheet(path, example, most, skip_bad=skip_bad, names=layout.header or None)
    sheet = replace(sheet, row_hint="" if skip_bad else SKIP, skip_bad=skip_bad)
    return apply_layout(sheet.drop(ignore), layout)


def read_sheet(
    path: str | PathLike[str] | DataFrame,
    example: str,
    most: int = MOST_ROWS,
    *,
    skip_bad: bool | None = None,
    names: Sequence[str] | None = None,
) -> Sheet:
    """Read the columns of a CSV, TFS, SDDS, HDF5 or MATLAB file.

    Parameters
    ----------
    path : str, path or pandas.DataFrame
        A frame with such columns, or the file; HDF5 if its name ends in .h5 or .hdf5, with one
        dataset a column; MATLAB if it ends in .mat, with one vector a column. Columns of text are
        separated by commas, semicolons, tabs or blanks: the header tells.
    example : str
        A header such as the file should have, for messages.
    most : int
        Most rows there may be.
    skip_bad : bool, optional
        Whether rows that have not as many cells as the header are left out, and named in ``bad``;
        None where nobody can ask for it.
    names : sequence of str, optional
        The header of a file that has none; "*" at its end stands for further cells, unread.

    Returns
    -------
    Sheet
        With stripped cells. Lines that begin with # are its comments, but for a header above
        numbers that have none; separators at the end of lines are dropped.

    Raises
    ------
    InputError
        If the file cannot be read, is something else, has no header, or a row has not as many
        cells as the header.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> file = pathlib.Path(tempfile.mkdtemp()) / "a.csv"
    >>> _ = file.write_text("# noon\\ns_m;beta_x_m\\n0;1.5\\n\\n1;2.5\\n")
    >>> sheet = read_sheet(file, "s_m,beta_x_m")
    >>> sheet.numbers("beta_x_m").tolist(), sheet.lines, sheet.comments
    ([1.5, 2.5], [3, 5], ('noon',))
    """
    if hasattr(path, "itertuples"):
        return _of_frame(path, most)
    expect(path, str | PathLike, "'scan.csv', or a pandas frame")
    suffix = Path(path).suffix.lower()
    if suffix in BINARY or first_bytes(path, 4) == b"SDDS":
        return _binary(path, most)
    if suffix == ".json":
        return _of_json(path, most)
    return _read_text(path, example, most, skip_bad, names)


def _read_text(
    path: str | PathLike[str],
    example: str,
    most: int,
    skip_bad: bool | None,
    names: Sequence[str] | None,
) -> Sheet:
    comments, rows, lines, bad, columns, notes = [], [], [], [], None, ()
    names, header, separator, numbered = _head(path, example, comments, names)
    names, rest = [name for name in names if name != REST], REST in names
    title, least = list(names), min(most, MOST_WORDS // max(1, len(names)))
    for line, text in numbered:
        if text.lstrip().startswith(MARKS + TFS_LINES * (separator == " ")):
            comments.append(bare(text))
        elif text.strip().strip(",;\t "):
            cells, wrong = _row(text, separator, path, line, len(names), rest)
            units = None if rows or wrong else headers_with_units(names, cells, path, line)
            names = units or names
            if units or (rows and _is_again(cells, title, path, line)):
                continue
            fresh = not (rows or bad or "time" in names)  # a column `time` has dates
            columns = numeric_rows(path, line, separator, len(names), most) if fresh else None
            if columns is not None:
                lines = range(line, line + columns.shape[1])
                break
            (bad if wrong else rows).append(wrong or cells)
            lines += [] if wrong else [line]
            if len(rows) + len(bad) > least:
                check_length(len(rows) + len(bad), least, path, line)
            if bad and not skip_bad:
                break
    if bad and not (skip_bad and rows):
        raise replace(bad[0], expected=bad[0].expected + SKIP * (skip_bad is False))
    if columns is None:
        rows, notes = with_points(rows, separator)
        columns = zip(*rows, strict=True) if rows else [()] * len(names)
    said = (tuple(comments), digest(path), tuple(bad), notes)
    return Sheet(path, tuple(names), list(columns), lines, header, *said).drop_unnamed()


def _head(
    path: str | PathLike[str],
    example: str,
    comments: list[str],
    names: Sequence[str] | None = None,
) -> tuple[Sequence[str], int | None, str, Numbered]:
    """Names of the columns, their line, what separates them, and the lines below, numbered."""
    whole = text_lines(path)
    head = list(itertools.islice(whole, HEAD))
    first = next((text for text in head if text.strip()), "")
    if names is None and ARCHIVER.fullmatch(first):
        names = ARCHIVED
    if names is not None:
        return names, None, separator_of(first), enumerate(itertools.chain(head, whole), start=1)
    head = uncommented(head)
    title, numbered = header_at(head), enumerate(itertools.chain(head, whole), start=1)
    for line, text in numbered:
        if text.lstrip().startswith(MARKS + TFS_LINES):
            comments.append(bare(text))
        elif text.lstrip().startswith("*"):  # of a TFS file
            names = list(map(str.upper, _split(text, " ", path, line)[1:]))
            return names, line, " ", numbered
        elif not text.strip().strip(",;\t ") or SEPARATOR_LINE.match(text):
            continue
        elif line <= title:
            comments.append(text.strip(",;\t "))
        else:
            separator = separator_of(text)
            names = _without_blanks(_split(text, separator, path, line), 0)
            _check_header(names, example, path, line)
            return names, line, separator, numbered
    raise InputError("no header and no rows", f"a header line such as {example}", path=path)


def _of_frame(frame: DataFrame, most: int) -> Sheet:
    """The columns of a pandas data frame, whose name, if it has one, is in its ``attrs``."""
    name = str(frame.attrs.get("name", "frame"))
    if not all(isinstance(column, str) for column in frame.columns):
        raise InputError("columns without names", "names such as Q2_A and size_x_um", path=name)
    check_length(len(frame), most, name)
    blank = frame.isna()
    cells = [
        ["" if missing else v for v, missing in zip(values, blank[column], strict=True)]
        for column, values in frame.items()
    ]
    if not cells:
        raise InputError("a frame without columns", "a column for each quantity", path=name)
    return Sheet(name, tuple(frame.columns), cells, None, None, ())


def _without_blanks(cells: list[str], least: int) -> list[str]:
    """Drop the blank cells that separators at the end of a line make, beyond some cells."""
    more = len(list(itertools.takewhile(lambda cell: cell == "", reversed(cells))))
    return cells[: max(len(cells) - more, least)]


def _row(
    text: str,
    separator: str,
    path: str | PathLike[str],
    line: int,
    count: int,
    rest: bool = False,
) -> tuple[list[str], InputError | None]:
    """The cells of a row, and what is wrong with it if they are not so many; or the first ones."""
    try:
        cells = _without_blanks(_split(text, separator, path, line), count)
        cells = cells[:count] if rest else cells
    except InputError as error:
        return [], error
    if len(cells) == count:
        return cells, None
    expected = f"{count}, as in the header"
    expected += "; what stands above it begins with #" if count == 1 else ""
    apart = {",": "commas", ";": "semicolons", "\t": "tabs", " ": "blanks"}[separator]
    expected += f", with {apart} between them" if len(cells) == 1 < count else ""
    return cells, InputError(f"{len(cells)} cells", expected, path=path, line=line)


def _is_again(cells: list[str], title: list[str], path: str | PathLike[str], line: int) -> bool:
    """Tell a row that is the header once more, as of files put together; refuse another one."""
    if not cells or is_value(cells[0]) or not (cells == title or is_header(cells)):
        return False
    if cells != title:
        expected = "one table a file: columns beside one another, or a file for each"
        raise InputError(f"a second header, {', '.join(cells)}", expected, path, line)
    return True


def _split(text: str, separator: str, path: str | PathLike[str], line: int) -> list[str]:
    """The cells of one line."""
    if separator == " ":
        cells, open_end = WORD.findall(text), text.count('"') % 2
        cells = [word.strip('"') for word in cells]
    else:
        reader = csv.reader([text, ""], delimiter=separator, skipinitialspace=separator != "\t")
        cells, open_end = next(reader), reader.line_num > 1
    if open_end:
        expected = "each row on one line, and quotation marks in pairs"
        raise InputError("a quotation mark that does not end in its line", expected, path, line)
    return [cell.strip() for cell in cells]


def _check_header(names: list[str], example: str, path: str | PathLike[str], line: int) -> None:
    """Tell what is put in the place of a header."""
    if names[0].startswith("format") and "beamfit-" in names[-1]:
        expected = "the scan first and the lattice after --lattice; are they swapped?"
        raise InputError("a lattice where the table should be", expected, path, line)
    if all(map(is_number, names)):
        expected = f"a header line such as {example}"
        raise InputError("numbers where the header should be", expected, path=path, line=line)
    if len(names) > 3 and all(map(is_number, names[1:])):
        expected = f"columns below a header such as {example}, a row for each setting"
        raise InputError("a table on its side", expected, path=path, line=line)


def _binary(path: str | PathLike[str], most: int) -> Sheet:
    """Datasets of an HDF5 file, vectors of a MATLAB file, columns of an SDDS file."""
    suffix, comments = Path(path).suffix.lower(), ()
    if suffix == MATLAB:
        columns = matlab_variables(path)
    else:
        library = "HDF5" if suffix in HDF5 else "SDDS"
        columns, comments = library_columns(path, library, most, min(most, MOST_WORDS))
    if not columns:
        expected = "one dataset a column, at the top of the file"
        raise InputError("no datasets", expected, path=path)
    lengths = sorted(map(len, columns.values()))
    usual = max(lengths, key=lengths.count)
    like = next(name for name, column in columns.items() if len(column) == usual)
    for name, column in columns.items():
        if len(column) != usual:
            expected = f"{usual}, as in '{like}': datasets of equal lengths"
            raise InputError(f"{len(column)} readings", expected, path=path, column=name)
    return Sheet(path, tuple(columns), list(columns.values()), None, None, comments, digest(path))


def _of_json(path: str | PathLike[str], most: int) -> Sheet:
    """An object of lists (of objects by row as pandas has it), a list of rows, or a channel."""
    content, said = read_json(path, JSON, EXPECTED), ()
    with laid_out(path, JSON, EXPECTED):
        if isinstance(content, dict):
            columns = _planes(content) or {
                n: list(c.values()) if isinstance(c, dict) else c for n, c in content.items()
            }
        elif content and all({"meta", "data"} & set(row) for row in content):
            columns, said = _channel(content)
        else:
            names = dict.fromkeys(name for row in content for name in row)
            columns = {name: [row.get(name) for row in content] for name in names}
        if {type(column) for column in columns.values()} != {list}:
            raise ValueError
        cells = [["" if v is None else str(v).strip() for v in c] for c in columns.values()]
        if len({*map(len, cells)}) > 1:
            raise ValueError
    check_length(len(cells[0]), most, path)
    return Sheet(path, tuple(columns), cells, None, None, said, digest(path))


def _channel(content: list[Any]) -> tuple[dict[str, list[Any]], tuple[str, ...]]:
    """Columns of one channel of the EPICS Archiver Appliance, and what it says of it."""
    if len(content) != 1:
        expected = "one, of the beam current: a file for each"
        raise InputError(f"{len(content)} channels", expected)
    meta, data = content[0].get("meta") or {}, content[0]["data"]
    if not data:
        raise InputError("no readings", "two or more")
    columns = {key: [one[key] for one in data] for key in ("secs", "nanos", "val")}
    if (unit := meta.get("EGU")) in UNITS["current"]:
        columns[f"val_{unit}"] = columns.pop("val")
    return columns, tuple(f"{key}: {value}" for key, value in meta.items())


def _planes(content: dict[str, Any]) -> dict[str, list[Any]] | None:
    """Columns of a scan whose planes were measured at settings of their own; None if it is none.

    Scans as PyEmittance saves them (pyemittance_data_….json), and lcls-tools and slac-measurements
    (QuadScanEmittanceResult), sizes in m. The setting's unit is the magnet's own, and only a person
    knows it: --columns 'quadvals=Q525_kG'.
    """
    by_letter = {"quadvalsx", "beamsizesx"} <= set(content)
    if not by_letter and not {"quadrupole_pv_values", "rms_beamsizes"} <= set(content):
        return None
    names = ("quadvals", "beamsizes", "beamsizeserr")
    names = names if by_letter else ("quadrupole_pv_values", "rms_beamsizes")
    columns: dict[str, list[Any]] = {names[0]: []}
    for i, plane in enumerate("xy"):
        settings, *values = (
            content.get(f"{name}{plane}") if by_letter else _part(content[name], i)
            for name in names
        )
        start = len(columns[names[0]])
        columns[names[0]] += settings or []
        for kind, numbers in zip(("", "_error"), values, strict=False):
            if numbers:
                columns[f"size_{plane}{kind}_m"] = [None] * start + list(numbers)
    length = len(columns[names[0]])
    return {n: values + [None] * (length - len(values)) for n, values in columns.items()}


def _part(values: Any, i: int) -> Any:
    """One plane's part of a list, or of an object by number."""
    return values.get(str(i)) if isinstance(values, dict) else values[i]


def separator_of(header: str) -> str:
    """Separator of the columns below a header."""
    return next((s for s in ",;\t" if s in header), " ")


def _words(text: str) -> list[str]:
    separator = separator_of(text)
    return [word.strip(' "') for word in text.split(None if separator == " " else separator)]


def header_at(lines: Sequence[str]) -> int:
    """Which of some lines is the header: the first with two units, if only words stand above it.

    Where none has units it is the first line, or the first that rows of as many cells follow.

    Examples
    --------
    >>> header_at(["Scan", "by me, at noon", "Q2_A,size_x_um", "1,2"])
    2
    >>> header_at(["time,current", "1,2", "Q2_A,size_x_um"])
    0
    """
    rows = [(i, _words(text)) for i, text in enumerate(lines) if not _is_aside(text)]
    for i, cells in rows:
        if is_header(cells):
            return i
        below = i > rows[0][0] and len(cells) == len(rows[0][1])
        if below and is_value(cells[0]) and any(map(is_number, cells)):
            break
    for k, (i, cells) in enumerate(rows, start=1):
        if _has_rows(cells, [row for _, row in rows[k:]]):
            return i
    return rows[0][0] if rows else 0


def _is_aside(text: str) -> bool:
    """Tell a line that is blank, a comment, or of the head of a TFS file."""
    return not text.strip(",;\t ") or text.lstrip().startswith(MARKS + TFS)


def is_value(cell: str) -> bool:
    """Tell a cell that may be a number or a date."""
    return cell.lstrip("+-.")[:1].isdigit()


def _has_rows(cells: Sequence[str], below: list[list[str]]) -> bool:
    """Tell a line of words that rows of as many cells follow, below its units perhaps."""
    below = below[1:] if below and unit_row(below[0]) else below
    alike = all(len(row) == len(cells) and is_value(row[0]) for row in below[:2])
    return bool(below) and alike and len(cells) > 1 and not any(map(is_value, cells))


def uncommented(lines: Sequence[str]) -> list[str]:
    """Some lines, with the header that a mark of comments hides above the first values.

    Examples
    --------
    >>> uncommented(["# noon", "# time_s,beam_current_mA", "0,1"])
    ['# noon', 'time_s,beam_current_mA', '0,1']
    """
    found = list(lines)
    rows = (i for i, t in enumerate(found) if t.strip(" ,;\t") and not t.lstrip().startswith(MARKS))
    first = next(rows, 0)
    above = found[first - 1].strip() if first else ""
    if above.startswith(MARKS):
        said = bare(above)
        cells, words = _words(found[first]), _words(said)
        values = len(words) == len(cells) and all(map(is_value, cells))
        # Words between blanks may be a sentence.
        named = any(map(has_unit, words)) or separator_of(said) != " "
        if values and named and not any(map(is_value, words)):
            found[first - 1] = said
    return found


def bare(comment: str) -> str:
    """A comment without its mark."""
    return comment.strip().lstrip("".join(MARKS) + " ").rstrip()
