"""Read sheets of columns from text, JSON, HDF5, MATLAB and SDDS files, and data frames."""

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
from beamfit.io.cells import check_length, convert_decimal_commas, is_number, numeric_rows
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
from beamfit.io.files import (
    NumberedLines,
    digest,
    first_bytes,
    read_json,
    structure_errors,
    text_lines,
)
from beamfit.io.isolated import library_columns, matlab_variables

if TYPE_CHECKING:
    from pandas import DataFrame

# Largest number of rows, and of cells kept as texts (200 bytes each) if a file is not all numbers.
MAX_ROWS, MAX_TEXTS = 12_000_000, 4_000_000
HDF5 = {".h5", ".hdf5"}
MATLAB = ".mat"
BINARY = {*HDF5, MATLAB}
SKIP_HINT = "; --skip-bad leaves such rows out"
# Line with which Excel declares the separator.
SEPARATOR_LINE = re.compile(r"\s*\"?sep=.\"?\s*$", re.IGNORECASE)
# Stands for further, unread cells in the column names given for a file without a header.
FURTHER_CELLS = "*"
TFS_LINES = ("@", "$")
# First row of a file of the EPICS Archiver Appliance without a header, and its columns.
ARCHIVER_ROW = re.compile(r"\d{9,11}(,[^,]+){4}\s*")
ARCHIVER_COLUMNS = ["secs", "val", "severity", "status", "nanos"]
OTHER_JSON = "another JSON file"
EXPECTED = (
    'columns of equal lengths, {"name": [...]}, one object a row, [{"name": ...}], or one channel '
    'of the EPICS Archiver Appliance, [{"meta": …, "data": [{"secs": …}]}]'
)
BLANK_SEPARATED = re.compile(r'"[^"]*"|\S+')
# The header is searched for in this many lines.
MAX_HEADER_LINES = 50
# Marks of comment lines: Python, MATLAB, C, SDDS.
COMMENT_MARKS = ("#", "%", "//", "!")
# Marks of header lines in a TFS file.
TFS_MARKS = ("@", "*", "$")


def read_columns(
    path: str | PathLike[str] | DataFrame,
    example: str,
    columns: Columns = None,
    ignore: Iterable[str] = (),
    skip_bad: bool = False,
    max_rows: int = MAX_ROWS,
) -> Sheet:
    """Read the columns of a file, and apply a layout.

    Parameters
    ----------
    path, example, max_rows
        As for `read_sheet`.
    columns : str, path, mapping or Layout, optional
        Layout; see `beamfit.io.columns.layout_of`.
    ignore : iterable of str
        Columns to leave unread; * and ? are wildcards.
    skip_bad : bool
        Leave out rows with another number of cells than the header.

    Raises
    ------
    InputError
        As `read_sheet` and `apply_layout`.
    """
    layout = layout_of(columns)
    sheet = read_sheet(path, example, max_rows, skip_bad=skip_bad, names=layout.header or None)
    sheet = replace(sheet, row_hint="" if skip_bad else SKIP_HINT, skip_bad=skip_bad)
    return apply_layout(sheet.drop(ignore), layout)


def read_sheet(
    path: str | PathLike[str] | DataFrame,
    example: str,
    max_rows: int = MAX_ROWS,
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
        separated by commas, semicolons, tabs or blanks, as the header is.
    example : str
        Example of a header, for messages.
    max_rows : int
        Largest number of rows.
    skip_bad : bool, optional
        True to leave out rows with another number of cells than the header; their errors are in
        ``bad_rows``. None if there is no such option.
    names : sequence of str, optional
        Header of a file without one; "*" at its end stands for further, unread cells.

    Returns
    -------
    Sheet
        With stripped cells. Lines that begin with # are comments, except a header directly above
        the first row. Separators at the end of lines are dropped.

    Raises
    ------
    InputError
        If the file cannot be read, is of another kind, has no header, or a row has another number
        of cells than the header.

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
        return _read_frame(path, max_rows)
    expect(path, str | PathLike, "'scan.csv', or a pandas frame")
    suffix = Path(path).suffix.lower()
    if suffix in BINARY or first_bytes(path, 4) == b"SDDS":
        return _read_binary(path, max_rows)
    if suffix == ".json":
        return _read_json_columns(path, max_rows)
    return _read_text(path, example, max_rows, skip_bad, names)


def _read_text(
    path: str | PathLike[str],
    example: str,
    max_rows: int,
    skip_bad: bool | None,
    names: Sequence[str] | None,
) -> Sheet:
    """Read a text file line by line, or quickly from the first row on if all is numeric."""
    comments, rows, lines, errors, columns, notes = [], [], [], [], None, ()
    names, header, separator, numbered = _read_header(path, example, comments, names)
    names, has_further = [name for name in names if name != FURTHER_CELLS], FURTHER_CELLS in names
    file_header, max_count = list(names), min(max_rows, MAX_TEXTS // max(1, len(names)))
    for line, text in numbered:
        if text.lstrip().startswith(COMMENT_MARKS + TFS_LINES * (separator == " ")):
            comments.append(comment_text(text))
        elif text.strip().strip(",;\t "):
            cells, error = _read_row(text, separator, path, line, len(names), has_further)
            units = None if rows or error else headers_with_units(names, cells, path, line)
            names = units or names
            if units or (rows and _is_header_again(cells, file_header, path, line)):
                continue
            fast = not (rows or errors or "time" in names)  # a column `time` has dates
            columns = numeric_rows(path, line, separator, len(names), max_rows) if fast else None
            if columns is not None:
                lines = range(line, line + columns.shape[1])
                break
            (errors if error else rows).append(error or cells)
            lines += [] if error else [line]
            if len(rows) + len(errors) > max_count:
                check_length(len(rows) + len(errors), max_count, path, line)
            if errors and not skip_bad:
                break
    if errors and not (skip_bad and rows):
        raise replace(errors[0], expected=errors[0].expected + SKIP_HINT * (skip_bad is False))
    if columns is None:
        rows, notes = convert_decimal_commas(rows, separator)
        columns = zip(*rows, strict=True) if rows else [()] * len(names)
    provenance = (tuple(comments), digest(path), tuple(errors), notes)
    return Sheet(path, tuple(names), list(columns), lines, header, *provenance).drop_unnamed()


def _read_header(
    path: str | PathLike[str],
    example: str,
    comments: list[str],
    names: Sequence[str] | None = None,
) -> tuple[Sequence[str], int | None, str, NumberedLines]:
    """Names of the columns, their line, the separator, and the numbered lines below."""
    rest = text_lines(path)
    head = list(itertools.islice(rest, MAX_HEADER_LINES))
    first = next((text for text in head if text.strip()), "")
    if names is None and ARCHIVER_ROW.fullmatch(first):
        names = ARCHIVER_COLUMNS
    if names is not None:
        return names, None, separator_of(first), enumerate(itertools.chain(head, rest), start=1)
    head = uncomment_header(head)
    title, numbered = header_index(head), enumerate(itertools.chain(head, rest), start=1)
    for line, text in numbered:
        if text.lstrip().startswith(COMMENT_MARKS + TFS_LINES):
            comments.append(comment_text(text))
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


def _read_frame(frame: DataFrame, max_rows: int) -> Sheet:
    """Sheet of a pandas data frame; its name is in ``attrs``."""
    name = str(frame.attrs.get("name", "frame"))
    if not all(isinstance(column, str) for column in frame.columns):
        raise InputError("columns without names", "names such as Q2_A and size_x_um", path=name)
    check_length(len(frame), max_rows, name)
    blank = frame.isna()
    cells = [
        ["" if missing else v for v, missing in zip(values, blank[column], strict=True)]
        for column, values in frame.items()
    ]
    if not cells:
        raise InputError("a frame without columns", "a column for each quantity", path=name)
    return Sheet(name, tuple(frame.columns), cells, None, None, ())


def _without_blanks(cells: list[str], min_count: int) -> list[str]:
    """Drop blank cells at the end of a row, but keep a number of cells."""
    n_blank = len(list(itertools.takewhile(lambda cell: cell == "", reversed(cells))))
    return cells[: max(len(cells) - n_blank, min_count)]


def _read_row(
    text: str,
    separator: str,
    path: str | PathLike[str],
    line: int,
    count: int,
    has_further: bool = False,
) -> tuple[list[str], InputError | None]:
    """Cells of a row, and an error if their number is wrong; further cells may be unread."""
    try:
        cells = _without_blanks(_split(text, separator, path, line), count)
        cells = cells[:count] if has_further else cells
    except InputError as error:
        return [], error
    if len(cells) == count:
        return cells, None
    expected = f"{count}, as in the header"
    expected += "; what stands above it begins with #" if count == 1 else ""
    separators = {",": "commas", ";": "semicolons", "\t": "tabs", " ": "blanks"}[separator]
    expected += f", with {separators} between them" if len(cells) == 1 < count else ""
    return cells, InputError(f"{len(cells)} cells", expected, path=path, line=line)


def _is_header_again(
    cells: list[str], header: list[str], path: str | PathLike[str], line: int
) -> bool:
    """True for a repeated header, as in concatenated files; another header is refused."""
    if not cells or is_value(cells[0]) or not (cells == header or is_header(cells)):
        return False
    if cells != header:
        expected = "one table a file: columns beside one another, or a file for each"
        raise InputError(f"a second header, {', '.join(cells)}", expected, path, line)
    return True


def _split(text: str, separator: str, path: str | PathLike[str], line: int) -> list[str]:
    """Split a line into cells."""
    if separator == " ":
        cells, unclosed = BLANK_SEPARATED.findall(text), text.count('"') % 2
        cells = [word.strip('"') for word in cells]
    else:
        reader = csv.reader([text, ""], delimiter=separator, skipinitialspace=separator != "\t")
        cells, unclosed = next(reader), reader.line_num > 1
    if unclosed:
        expected = "each row on one line, and quotation marks in pairs"
        raise InputError("a quotation mark that does not end in its line", expected, path, line)
    return [cell.strip() for cell in cells]


def _check_header(names: list[str], example: str, path: str | PathLike[str], line: int) -> None:
    """Refuse a header that is a lattice file, a row of numbers or a transposed table."""
    if names[0].startswith("format") and "beamfit-" in names[-1]:
        expected = "the scan first and the lattice after --lattice; are they swapped?"
        raise InputError("a lattice where the table should be", expected, path, line)
    if all(map(is_number, names)):
        expected = f"a header line such as {example}"
        raise InputError("numbers where the header should be", expected, path=path, line=line)
    if len(names) > 3 and all(map(is_number, names[1:])):
        expected = f"columns below a header such as {example}, a row for each setting"
        raise InputError("a table on its side", expected, path=path, line=line)


def _read_binary(path: str | PathLike[str], max_rows: int) -> Sheet:
    """Sheet of an HDF5, MATLAB or SDDS file."""
    suffix, comments = Path(path).suffix.lower(), ()
    if suffix == MATLAB:
        columns = matlab_variables(path)
    else:
        library = "HDF5" if suffix in HDF5 else "SDDS"
        columns, comments = library_columns(path, library, max_rows, min(max_rows, MAX_TEXTS))
    if not columns:
        expected = "one dataset a column, at the top of the file"
        raise InputError("no datasets", expected, path=path)
    lengths = sorted(map(len, columns.values()))
    common_length = max(lengths, key=lengths.count)
    example = next(name for name, column in columns.items() if len(column) == common_length)
    for name, column in columns.items():
        if len(column) != common_length:
            expected = f"{common_length}, as in '{example}': datasets of equal lengths"
            raise InputError(f"{len(column)} readings", expected, path=path, column=name)
    return Sheet(path, tuple(columns), list(columns.values()), None, None, comments, digest(path))


def _read_json_columns(path: str | PathLike[str], max_rows: int) -> Sheet:
    """Sheet of a JSON file: object of columns (as pandas writes), list of rows, or channel."""
    content, comments = read_json(path, OTHER_JSON, EXPECTED), ()
    with structure_errors(path, OTHER_JSON, EXPECTED):
        if isinstance(content, dict):
            columns = _plane_columns(content) or {
                n: list(c.values()) if isinstance(c, dict) else c for n, c in content.items()
            }
        elif content and all({"meta", "data"} & set(row) for row in content):
            columns, comments = _channel_columns(content)
        else:
            names = dict.fromkeys(name for row in content for name in row)
            columns = {name: [row.get(name) for row in content] for name in names}
        if {type(column) for column in columns.values()} != {list}:
            raise ValueError
        cells = [["" if v is None else str(v).strip() for v in c] for c in columns.values()]
        if len({*map(len, cells)}) > 1:
            raise ValueError
    check_length(len(cells[0]), max_rows, path)
    return Sheet(path, tuple(columns), cells, None, None, comments, digest(path))


def _channel_columns(content: list[Any]) -> tuple[dict[str, list[Any]], tuple[str, ...]]:
    """Columns and attributes of a channel of the EPICS Archiver Appliance."""
    if len(content) != 1:
        expected = "one, of the beam current: a file for each"
        raise InputError(f"{len(content)} channels", expected)
    meta, data = content[0].get("meta") or {}, content[0]["data"]
    if not data:
        raise InputError("no readings", "two or more")
    columns = {key: [reading[key] for reading in data] for key in ("secs", "nanos", "val")}
    if (unit := meta.get("EGU")) in UNITS["current"]:
        columns[f"val_{unit}"] = columns.pop("val")
    return columns, tuple(f"{key}: {value}" for key, value in meta.items())


def _plane_columns(content: dict[str, Any]) -> dict[str, list[Any]] | None:
    """Columns of a scan with separate settings for each plane; None for another file.

    Scans saved by PyEmittance (pyemittance_data_….json), lcls-tools and slac-measurements
    (QuadScanEmittanceResult), sizes in m. The files do not give the unit of the setting, which the
    user must: --columns 'quadvals=Q525_kG'.
    """
    by_letter = {"quadvalsx", "beamsizesx"} <= set(content)
    if not by_letter and not {"quadrupole_pv_values", "rms_beamsizes"} <= set(content):
        return None
    names = ("quadvals", "beamsizes", "beamsizeserr")
    names = names if by_letter else ("quadrupole_pv_values", "rms_beamsizes")
    columns: dict[str, list[Any]] = {names[0]: []}
    for i, plane in enumerate("xy"):
        settings, *values = (
            content.get(f"{name}{plane}") if by_letter else _plane_part(content[name], i)
            for name in names
        )
        start = len(columns[names[0]])
        columns[names[0]] += settings or []
        for kind, numbers in zip(("", "_error"), values, strict=False):
            if numbers:
                columns[f"size_{plane}{kind}_m"] = [None] * start + list(numbers)
    length = len(columns[names[0]])
    return {n: values + [None] * (length - len(values)) for n, values in columns.items()}


def _plane_part(values: Any, i: int) -> Any:
    """Values of the i-th plane, in a list or in an object with keys '0' and '1'."""
    return values.get(str(i)) if isinstance(values, dict) else values[i]


def separator_of(header: str) -> str:
    """Separator of a header line."""
    return next((s for s in ",;\t" if s in header), " ")


def _split_words(text: str) -> list[str]:
    """Split a line at its separator, without quotes."""
    separator = separator_of(text)
    return [word.strip(' "') for word in text.split(None if separator == " " else separator)]


def header_index(lines: Sequence[str]) -> int:
    """Index of the header: the first line with two units, if only words are above it.

    Without units, it is the first line followed by rows of as many cells, or the first line.

    Examples
    --------
    >>> header_index(["Scan", "by me, at noon", "Q2_A,size_x_um", "1,2"])
    2
    >>> header_index(["time,current", "1,2", "Q2_A,size_x_um"])
    0
    """
    rows = [(i, _split_words(text)) for i, text in enumerate(lines) if not _is_comment(text)]
    for i, cells in rows:
        if is_header(cells):
            return i
        is_below = i > rows[0][0] and len(cells) == len(rows[0][1])
        if is_below and is_value(cells[0]) and any(map(is_number, cells)):
            break
    for k, (i, cells) in enumerate(rows, start=1):
        if _has_rows(cells, [row for _, row in rows[k:]]):
            return i
    return rows[0][0] if rows else 0


def _is_comment(text: str, marks: tuple[str, ...] = COMMENT_MARKS + TFS_MARKS) -> bool:
    """True if a line is blank, a comment, or in the header of a TFS file."""
    return not text.strip(",;\t ") or text.lstrip().startswith(marks)


def is_value(cell: str) -> bool:
    """True if a cell may be a number or a date."""
    return cell.lstrip("+-.")[:1].isdigit()


def _has_rows(cells: Sequence[str], below: list[list[str]]) -> bool:
    """True if rows of as many cells, or a row of units and such rows, follow a line of words."""
    below = below[1:] if below and unit_row(below[0]) else below
    same_width = all(len(row) == len(cells) and is_value(row[0]) for row in below[:2])
    return bool(below) and same_width and len(cells) > 1 and not any(map(is_value, cells))


def uncomment_header(lines: Sequence[str]) -> list[str]:
    """Remove the comment mark of a header directly above the first row.

    Examples
    --------
    >>> uncomment_header(["# noon", "# time_s,beam_current_mA", "0,1"])
    ['# noon', 'time_s,beam_current_mA', '0,1']
    """
    found = list(lines)
    first = next((i for i, text in enumerate(found) if not _is_comment(text, COMMENT_MARKS)), 0)
    line_above = found[first - 1].strip() if first else ""
    if line_above.startswith(COMMENT_MARKS):
        comment = comment_text(line_above)
        cells, words = _split_words(found[first]), _split_words(comment)
        is_row = len(words) == len(cells) and all(map(is_value, cells))
        # Words separated by blanks may be a sentence.
        is_header_like = any(map(has_unit, words)) or separator_of(comment) != " "
        if is_row and is_header_like and not any(map(is_value, words)):
            found[first - 1] = comment
    return found


def comment_text(comment: str) -> str:
    """Text of a comment line without its mark."""
    return comment.strip().lstrip("".join(COMMENT_MARKS) + " ").rstrip()
