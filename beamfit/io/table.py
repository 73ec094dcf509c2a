"""Named columns from CSV, TFS and HDF5 files, with the place of every value.

A reader of scans, records or optics says which quantities its columns may hold; what can be wrong
with a table as such is found and named here.
"""

from __future__ import annotations

import csv
import hashlib
import itertools
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from beamfit.errors import InputError, nearest
from beamfit.io.files import text_lines
from beamfit.io.hdf5 import hdf5_columns
from beamfit.io.headers import (
    HEAD,
    header_at,
    is_number,
    separator_of,
    spelled,
    uncommented,
    with_units,
)
from beamfit.io.numeric import check_length, numeric_rows

if TYPE_CHECKING:
    from pandas import DataFrame

UNITS: dict[str, dict[str, float]] = {
    # quantity: unit at the end of a name -> factor to SI (a stored current: to mA)
    "length": {"um": 1e-6, "mm": 1e-3, "m": 1.0, "µm": 1e-6, "μm": 1e-6},
    "length or duration": {"mm": 1e-3, "m": 1.0, "ps": 299792458e-12},
    "time": {"s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0, "ms": 1e-3},
    "current": {"mA": 1.0, "A": 1e3, "uA": 1e-3, "µA": 1e-3, "μA": 1e-3},
    "voltage": {"kV": 1e3, "V": 1.0, "MV": 1e6},
    "pressure": {"Pa": 1.0, "mbar": 100.0, "Torr": 101325 / 760},
    "energy in MeV": {"MeV": 1.0},
}
# Rows left out that a note names one by one.
MOST_NAMED = 5
# Rows of a file, and cells of one that is not all plain numbers: each is a text, 200 bytes.
MOST_ROWS, MOST_WORDS = 12_000_000, 4_000_000
HDF5 = {".h5", ".hdf5"}
# How Excel says which separator a file has.
SEPARATOR_LINE = re.compile(r"\s*\"?sep=.\"?\s*$", re.IGNORECASE)
TFS_LINES = ("@", "$")
WORD = re.compile(r'"[^"]*"|\S+')


class Column(NamedTuple):
    """What a header means: the quantity, the unit it is in, and the factor to SI."""

    header: str
    key: str
    unit: str = ""
    factor: float = 1.0


@dataclass(frozen=True)
class Sheet:
    """The cells of a file, one sequence a column, and where each row stands.

    Attributes
    ----------
    path : str or path
        The file.
    names : tuple of str
        Headers, in the order of the file.
    cells : sequence of sequences
        Texts (or numbers, of HDF5) of each column.
    lines : sequence of int or None
        Line of each row; None for HDF5, whose rows are counted.
    header : int or None
        Line of the header.
    comments : tuple of str
        Comment lines, TFS descriptors, or attributes of an HDF5 file.
    sha256 : str
        Digest of the file.
    bad : tuple of InputError
        What is wrong with rows that were left out on request.
    """

    path: str | PathLike[str]
    names: tuple[str, ...]
    cells: Sequence[Sequence[Any]]
    lines: Sequence[int] | None
    header: int | None
    comments: tuple[str, ...]
    sha256: str = ""
    bad: tuple[InputError, ...] = ()

    def __len__(self) -> int:
        return len(self.cells[0])

    def __getitem__(self, name: str) -> Sequence[Any]:
        return self.cells[self.names.index(name)]

    def error(
        self, found: str, expected: str, row: int | None = None, column: str | None = None
    ) -> InputError:
        """Make the error that names the file, and the row and column if there are any."""
        if row is not None and self.lines is None:
            return self.error(f"reading {row + 1}: {found}", expected, None, column)
        line = None if row is None else self.lines[row]
        return InputError(found, expected, path=self.path, line=line, column=column)

    def header_error(self, found: str, expected: str, column: str | None = None) -> InputError:
        """Make the error that names the header, and the column if it is one alone."""
        return InputError(found, expected, path=self.path, line=self.header, column=column)

    def without(self, patterns: Iterable[str]) -> Sheet:
        """Leave out columns by name, in which * and ? stand for any letters.

        Raises
        ------
        InputError
            If no column has such a name, or none is left.
        """
        left = list(self.names)
        for pattern in patterns:
            if not any(fnmatchcase(name, pattern) for name in self.names):
                raise self.header_error(
                    f"no column '{pattern}'", nearest(pattern, list(self.names))
                )
            left = [name for name in left if not fnmatchcase(name, pattern)]
        if not left:
            raise self.header_error("no column that is not ignored", "a column to read")
        cells = [self[name] for name in left]
        return replace(self, names=tuple(left), cells=cells)

    def rows(self, keep: Sequence[int]) -> Sheet:
        """Some of the rows."""
        lines = None if self.lines is None else [self.lines[row] for row in keep]
        cells = [c[keep] if isinstance(c, np.ndarray) else [c[r] for r in keep] for c in self.cells]
        return replace(self, cells=cells, lines=lines)

    def good(self, check: Callable[[Sheet], object]) -> Sheet:
        """Leave out the rows that a check of each row refuses, and keep what it said of them.

        Raises
        ------
        InputError
            If no row is left: the first that was wrong.
        """
        keep: list[int] = []
        bad = list(self.bad)
        waiting = [range(len(self))]
        while waiting:
            rows = waiting.pop()
            try:
                check(self.rows(rows))
                keep += rows
            except InputError as error:
                if len(rows) == 1:
                    found = re.sub(r"^reading 1:", f"reading {rows[0] + 1}:", error.found)
                    bad.append(replace(error, found=found))
                else:
                    half = len(rows) // 2
                    waiting += [rows[half:], rows[:half]]
        if not keep:
            _raise_first(bad)
        bad.sort(key=lambda error: error.line or 0)
        return replace(self.rows(keep), bad=tuple(bad))

    def numbers(
        self,
        name: str,
        *,
        blank: bool = False,
        read: Callable[[Any], float] = float,
        expected: str = "a number",
    ) -> np.ndarray:
        """Read a column of finite numbers.

        Parameters
        ----------
        name : str
            Its header.
        blank : bool
            Whether a cell may be blank; it is NaN then.
        read : callable
            From a cell to a number, or ValueError.
        expected : str
            What the cell should have been, for the message.

        Raises
        ------
        InputError
            Naming line and column of the first cell that is no number.
        """
        if isinstance(self[name], np.ndarray) and read is float and np.isfinite(self[name]).all():
            return self[name].astype(float)
        values = np.empty(len(self))
        for row, cell in enumerate(self[name]):
            try:
                values[row] = np.nan if blank and cell == "" else read(cell)
            except (ValueError, TypeError, OverflowError):
                comma = " with a decimal point" if "," in str(cell) else ""
                found = "an empty cell" if cell == "" else f"'{cell}'"
                raise self.error(found, expected + comma, row, name) from None
            if cell != "" and not np.isfinite(values[row]):
                raise self.error(f"'{cell}'", "a finite number", row, name)
        return values


def columns_of(
    sheet: Sheet,
    quantities: Mapping[str, str],
    other: Callable[[str], Column | None] = lambda header: None,
) -> dict[str, Column]:
    """Understand every header of a sheet.

    Parameters
    ----------
    sheet : Sheet
        The file.
    quantities : mapping of str to str
        Name of a column without its unit to the kind of unit it has, a key of `UNITS`; "" for a
        pure number or a word.
    other : callable
        Understands further headers; gives None for those that nobody knows.

    Returns
    -------
    dict of str to Column
        By quantity.

    Raises
    ------
    InputError
        If a header or its unit is unknown, or a quantity stands twice.

    Examples
    --------
    >>> sheet = Sheet("a.csv", ("size_x_mm",), [["0.1"]], [2], 1, ())
    >>> columns_of(sheet, {"size_x": "length"})["size_x"].factor
    0.001
    """
    found: dict[str, Column] = {}
    for header in sheet.names:
        said = spelled(header)
        try:
            column = _known(said, quantities, sheet) or other(said)
        except InputError as error:
            raise replace(error, column=header) from None
        column = column and column._replace(header=header)
        if column is None:
            usual = [f"{q}_{next(iter(UNITS[k]))}" if k else q for q, k in quantities.items()]
            raise sheet.header_error("an unknown column", nearest(header, usual), header)
        if column.key in found:
            twice = f"{column.key} also in column '{found[column.key].header}'"
            expected = "one column for it, in one unit, and none twice"
            raise sheet.header_error(twice, expected, header)
        found[column.key] = column
    return found


def _known(header: str, quantities: Mapping[str, str], sheet: Sheet) -> Column | None:
    """The column of a header NAME or NAME_UNIT."""
    for whole in (header, header.lower()):
        if quantities.get(whole) == "":
            return Column(header, whole)
    name, _, unit = header.rpartition("_")
    if not (kind := quantities.get(name := name.lower())):
        return None
    units = UNITS[kind]
    if unit not in units:
        listed = ", ".join(u for u in units if u.isascii())
        expected = f"one of {listed} at the end, such as {name}_{next(iter(units))}"
        raise sheet.header_error(f"unknown unit '{unit}'", expected, header)
    return Column(header, name, unit, units[unit])


def read_sheet(
    path: str | PathLike[str] | DataFrame,
    example: str,
    most: int = MOST_ROWS,
    *,
    ragged: bool = False,
    names: Sequence[str] | None = None,
) -> Sheet:
    """Read the columns of a CSV, TFS or HDF5 file.

    Parameters
    ----------
    path : str, path or pandas.DataFrame
        A frame with such columns, or the file; HDF5 if its name ends in .h5 or .hdf5, with one
        dataset a column. Columns of text are separated by commas, semicolons, tabs or blanks: the
        header tells.
    example : str
        A header such as the file should have, for messages.
    most : int
        Most rows there may be.
    ragged : bool
        Whether rows that have not as many cells as the header are left out, and named in ``bad``.
    names : sequence of str, optional
        The header of a file that has none and is separated by commas.

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
    if Path(path).suffix.lower() in HDF5:
        return _read_hdf5(path, most)
    return _read_text(path, example, most, ragged, names)


def _read_text(
    path: str | PathLike[str],
    example: str,
    most: int,
    ragged: bool,
    names: Sequence[str] | None,
) -> Sheet:
    header, separator = None, "" if names is None else ","
    comments, rows, lines, bad, seen = [], [], [], [], hashlib.sha256()
    source = text_lines(path, seen)
    head = list(itertools.islice(source, HEAD))
    head = uncommented(head) if names is None else head
    title = header_at(head) if names is None else 0
    for line, text in enumerate(itertools.chain(head, source), start=1):
        start = text.strip()[:1]
        if start == "#" or (start in TFS_LINES and (names is None or separator == " ")):
            comments.append(text.strip().lstrip("# ").rstrip())
        elif names is None and start == "*":  # of a TFS file
            separator, header = " ", line
            names = list(map(str.upper, _split(text, " ", path, line)[1:]))
        elif not text.strip().strip(",;\t ") or (names is None and SEPARATOR_LINE.match(text)):
            continue
        elif names is None and line <= title:
            comments.append(text.strip(",;\t "))
        elif names is None:
            separator = separator_of(text)
            names, header = _cells(path, text, line), line
            _check_header(names, example, path, line)
        else:
            cells, wrong = _row(text, separator, path, line, len(names))
            whole = len(cells) == len(names)
            if whole and not rows and (units := with_units(names, cells)):
                names = units
                continue
            fresh = not rows and not bad
            if fresh and (good := _good(path, line, separator, names, most, comments, header)):
                return good
            (rows if whole else bad).append(cells if whole else wrong)
            lines += [line] * whole
            least = min(most, MOST_WORDS // max(1, len(names)))
            check_length(len(rows) + len(bad), least, path, line)
            _raise_first(() if ragged else bad)
    if names is None:
        raise InputError("no header and no rows", f"a header line such as {example}", path=path)
    _raise_first(() if rows else bad)
    cells = list(zip(*rows, strict=True)) if rows else [()] * len(names)
    said = (tuple(comments), seen.hexdigest(), tuple(bad))
    return Sheet(path, tuple(names), cells, lines, header, *said)


def _good(
    path: str | PathLike[str],
    line: int,
    separator: str,
    names: Sequence[str],
    most: int,
    comments: Sequence[str],
    header: int | None,
) -> Sheet | None:
    """The rest of a large file of good numbers; a column `time` has dates."""
    found = None if "time" in names else numeric_rows(path, line, separator, len(names), most)
    if found is None:
        return None
    lines = range(line, line + found[0].shape[1])
    return Sheet(path, tuple(names), list(found[0]), lines, header, tuple(comments), found[1])


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


def left_out(sheet: Sheet) -> tuple[str, ...]:
    """Count and name the rows that were left out, as a note."""
    if not sheet.bad:
        return ()
    named = [
        (f"line {e.line}, " if e.line else "")
        + (f"column '{e.column}', " if e.column else "")
        + e.found
        for e in sheet.bad[:MOST_NAMED]
    ]
    more = len(sheet.bad) - len(named)
    named += [f"{more} more"] if more else []
    were = "was" if len(sheet.bad) == 1 else "were"
    total = len(sheet) + len(sheet.bad)
    return (f"{len(sheet.bad)} of {total} rows {were} left out: {'; '.join(named)}.",)


def _raise_first(errors: Sequence[InputError]) -> None:
    for error in errors:
        raise error


def _without_blanks(cells: list[str], least: int) -> list[str]:
    """Drop the blank cells that separators at the end of a line make, beyond some cells."""
    more = len(list(itertools.takewhile(lambda cell: cell == "", reversed(cells))))
    return cells[: max(len(cells) - more, least)]


def header_of(path: str | PathLike[str]) -> list[str]:
    """The header of a file of text, as `read_sheet` finds it; none of an empty one."""
    head = uncommented(list(itertools.islice(text_lines(path), HEAD)))
    at = header_at(head)
    return [spelled(name) for name in _cells(path, head[at], at + 1)]


def _cells(path: str | PathLike[str], text: str, line: int = 1) -> list[str]:
    """The cells of a line by its own separator."""
    return _without_blanks(_split(text, separator_of(text), path, line), 0)


def _row(
    text: str, separator: str, path: str | PathLike[str], line: int, count: int
) -> tuple[list[str], InputError]:
    """The cells of a row, and what is wrong with it if they are not so many."""
    try:
        cells = _without_blanks(_split(text, separator, path, line), count)
    except InputError as error:
        return [], error
    expected = f"{count}, as in the header"
    return cells, InputError(f"{len(cells)} cells", expected, path=path, line=line)


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


def _read_hdf5(path: str | PathLike[str], most: int) -> Sheet:
    columns, comments, sha256 = hdf5_columns(path, most, min(most, MOST_WORDS))
    if not columns:
        raise InputError("no datasets", "one dataset a column", path=path)
    lengths = sorted(map(len, columns.values()))
    usual = max(lengths, key=lengths.count)
    like = next(name for name, column in columns.items() if len(column) == usual)
    for name, column in columns.items():
        if len(column) != usual:
            expected = f"{usual}, as in '{like}': datasets of equal lengths"
            raise InputError(f"{len(column)} readings", expected, path=path, column=name)
    return Sheet(path, tuple(columns), list(columns.values()), None, None, comments, sha256)
