"""Columns of a file: units in headers, layouts, and numbers with their line for messages."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from functools import lru_cache
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from beamfit.emittance.scan import SETTINGS
from beamfit.errors import InputError, nearest
from beamfit.io.cells import (
    DAY_FIRST,
    HOUR_OR_MINUTE,
    MONTH_FIRST,
    NUMERIC_DATE,
    dates_in_order,
    is_number,
    number,
    numbers_of,
)
from beamfit.io.toml import LIST, TABLE, TEXT, Key, read_toml
from beamfit.particles import LIGHT

# Kind of unit -> unit in a header -> factor to SI (stored current: to mA, energy: to MeV).
UNITS: dict[str, dict[str, float]] = {
    "length": {"um": 1e-6, "mm": 1e-3, "m": 1.0, "nm": 1e-9, "cm": 1e-2},
    "length or duration": {"mm": 1e-3, "m": 1.0, "ps": LIGHT / 1e12},
    "time": {"s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "current": {"mA": 1.0, "A": 1e3, "uA": 1e-3, "nA": 1e-6},
    "voltage": {"kV": 1e3, "V": 1.0, "MV": 1e6},
    "pressure": {"Pa": 1.0, "mbar": 100.0, "Torr": 101325 / 760},
    "energy": {"MeV": 1.0, "GeV": 1e3, "keV": 1e-3, "eV": 1e-6},
}
UNITS |= {f"{kind} or share": UNITS[kind] | {"%": 0.01} for kind in ("length", "time")}
# All units that a header may end with.
UNIT_NAMES = {*SETTINGS, *(unit for units in UNITS.values() for unit in units)}
UNIT_SUFFIXES = tuple(f"_{unit}" for unit in UNIT_NAMES)
# Other spellings of units -> unit. A change of case is listed only where it is unambiguous.
UNIT_SPELLINGS = {
    word: unit
    for unit, words in {
        "T_per_m": ("T m^-1", "T.m-1", "tesla/m", "T/m", "T_PER_M"),
        "k1": ("1/m**2", "1/m^2", "1/m2", "1/m²", "m^-2", "m-2", "m⁻²", "K1"),
        "k1l": ("m-1", "1/m", "m^-1", "K1L"),
        "A": ("ampere", "amperes", "Amp", "Amps", "amp"),
        "kG": ("KG", "kg"),
        "um": ("um rms", "micron", "microns", "UM", "Um"),
        "mm": ("mm rms", "MM", "Mm"),
        "m": ("M",),
        "s": ("sec",),
        "h": ("hours",),
        "MeV": ("MEV", "mev"),
        "GeV": ("GEV", "gev"),
        "mA": ("ma",),
        "Pa": ("pa", "PA"),
        "Torr": ("torr", "TORR"),
        "%": ("percent",),
    }.items()
    for word in words
}
# A cell with a number and the text after it, which may be its unit.
NUMBER_WITH_UNIT = re.compile(
    r"([-+]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][-+]?\d+)?)\s*([^\W\d_].*|[%\[(].*)"
)
# Separators of name and unit: size x (µm), Q [T/m], I/A, "I, A", I in A, Time / h.
UNIT_SEPARATOR = re.compile(r"\s+in\s+|[\s_]*[\[(]|\s+/\s+|/|,\s?|[\s_]+")


def known_unit(text: str) -> str | None:
    """Unit (a member of `UNIT_NAMES`) that a text means, such as um for µm; None if it is none."""
    text = re.sub("[µμ]", "u", text.strip().strip("[]()").strip())
    return text if text in UNIT_NAMES else UNIT_SPELLINGS.get(text)


def name_with_unit(name: str, unit: str) -> str:
    """Join a name and its unit to a header, with underscores for blanks."""
    return re.sub(r"\s+", "_", f"{name}_{unit}")


@lru_cache(maxsize=4096)  # files of a batch share their headers
def standard_header(header: str) -> str:
    """Rewrite a header as ``name_unit``; unchanged if it has no unit.

    Examples
    --------
    >>> headers = "Q525 [T/m]", "size x (µm)", "Time / h", "SIZE_X_MM", "Q5 T m^-1"
    >>> list(map(standard_header, headers))
    ['Q525_T_per_m', 'size_x_um', 'Time_h', 'SIZE_X_mm', 'Q5_T_per_m']
    >>> headers = "I/A", "size x, um", "size x in um", "Q1_T/m", "sr/dcct/A"
    >>> list(map(standard_header, headers))
    ['I_A', 'size_x_um', 'size_x_um', 'Q1_T_per_m', 'sr/dcct/A']
    """
    if header.endswith(UNIT_SUFFIXES):
        return header
    for found in UNIT_SEPARATOR.finditer(header):
        name, unit = header[: found.start()].strip(), known_unit(header[found.end() :])
        # The separator is part of a path such as sr/dcct/A or of a unit such as [G/cm].
        inside = found[0] in "/," and re.search(r"[/,]|[\[(][^\])]*$", name)
        if name and unit and not inside:
            return name_with_unit(name.removesuffix(f"_{unit}"), unit)
    return header


def unit_at_end(name: str) -> str | None:
    """Unit at the end of a header in the form of `standard_header`; None if it has none."""
    return max((u for u in UNIT_NAMES if name.endswith(f"_{u}")), key=len, default=None)


def number_and_unit(cell: str) -> tuple[str, str] | None:
    """Split a cell into number and unit; None if it has no unit.

    Examples
    --------
    >>> [number_and_unit(cell) for cell in ("627 µm", "1.5A", "1e-3", "OTR2")]
    [('627', 'um'), ('1.5', 'A'), None, None]
    """
    found = None if cell[-1:].isdigit() else NUMBER_WITH_UNIT.fullmatch(cell)
    unit = known_unit(found[2]) if found else None
    return (found[1], unit) if unit else None


def is_header(cells: Sequence[str]) -> bool:
    """True if cells are a header: at least two names with units, and no numbers."""
    if sum(map(has_unit, cells)) < 2:
        return False
    return not any(map(is_number, cells)) and not any(map(number_and_unit, cells))


def has_unit(header: str) -> bool:
    """True if a header contains its unit."""
    return unit_at_end(standard_header(header)) is not None


def unit_row(cells: Sequence[str]) -> list[str | None] | None:
    """Units in a row that consists of units; None if the row has anything else.

    Examples
    --------
    >>> unit_row(["A", "[um]", ""]), unit_row(["A", "5"])
    (['A', 'um', None], None)
    """
    units = [known_unit(cell) for cell in cells]
    only_units = all(u or cell in ("", "-", "1") for u, cell in zip(units, cells, strict=True))
    return units if only_units and any(units) else None


def headers_with_units(
    names: Sequence[str], cells: Sequence[str], path: str | PathLike[str], line: int
) -> list[str] | None:
    """Add the units of the row below to the headers; None if that row is not one of units.

    Raises
    ------
    InputError
        If a header has another unit already.

    Examples
    --------
    >>> headers_with_units(["Q2", "size_x", "shot"], ["A", "[um]", ""], "a.csv", 2)
    ['Q2_A', 'size_x_um', 'shot']
    """
    if (units := unit_row(cells)) is None:
        return None
    headers = []
    for name, unit in zip(names, units, strict=True):
        given = unit_at_end(standard_header(name))
        if given and unit and given != unit:
            expected = "one unit, in the header or below it"
            raise InputError(f"'{unit}' below a header in {given}", expected, path, line, name)
        headers.append(name if given or unit is None else name_with_unit(name, unit))
    return headers


# Stands for the unit in a column of dates.
DATE = "a date"
# Omitted rows, and ignored columns, that a note lists; more are counted.
MAX_LISTED_ROWS, MAX_LISTED_COLUMNS = 5, 8


class Column(NamedTuple):
    """Meaning of a header: quantity (``key``), unit, and factor to SI."""

    header: str
    key: str
    unit: str = ""
    factor: float = 1.0


@dataclass(frozen=True)
class Sheet:
    """Cells of a file by column, with the line number of each row.

    Attributes
    ----------
    path : str or path
        The file.
    names : tuple of str
        Headers, in the order of the file.
    cells : sequence of sequences
        Cells of each column: texts, or numbers if the file is binary.
    lines : sequence of int or None
        Line of each row; None for files without lines, such as HDF5.
    header : int or None
        Line of the header.
    comments : tuple of str
        Comment lines, TFS descriptors, or attributes of an HDF5 file.
    sha256 : str
        SHA-256 of the file.
    bad_rows : tuple of InputError
        Errors of the rows that were omitted on request.
    notes : tuple of str
        Changes made to the cells, in sentences.
    file_headers : mapping of str to str
        Header in the file of each column that a layout renamed, by its new name.
    date_order : str
        "day-month-year" or "month-day-year" if a layout says it; otherwise empty.
    has_layout : bool
        True if a layout is given: columns with unknown names are then ignored.
    row_hint : str
        Remedy for a bad row, appended to messages.
    skip_bad : bool or None
        True if bad rows are omitted; None where the options --skip-bad, --columns and --ignore
        do not exist.
    """

    path: str | PathLike[str]
    names: tuple[str, ...]
    cells: Sequence[Sequence[Any]]
    lines: Sequence[int] | None
    header: int | None
    comments: tuple[str, ...]
    sha256: str = ""
    bad_rows: tuple[InputError, ...] = ()
    notes: tuple[str, ...] = ()
    file_headers: Mapping[str, str] = field(default_factory=dict)
    date_order: str = ""
    has_layout: bool = False
    row_hint: str = ""
    skip_bad: bool | None = None

    def __len__(self) -> int:
        return len(self.cells[0])

    def __getitem__(self, name: str) -> Sequence[Any]:
        return self.cells[self.names.index(name)]

    def error(self, found: str, expected: str, row: int, column: str | None = None) -> InputError:
        """Make an error at a row, and a column if given."""
        line, column = None, self.file_headers.get(column, column)
        if self.lines is None:
            found = f"reading {row + 1}: {found}"
        else:
            line = self.lines[row]
        return InputError(found, expected + self.row_hint, path=self.path, line=line, column=column)

    def header_error(self, found: str, expected: str, column: str | None = None) -> InputError:
        """Make an error at the header line, and a column if given."""
        if column in self.file_headers:
            expected = f"{expected}; --columns says that it is {column}"
            column = self.file_headers[column]
        return InputError(found, expected, path=self.path, line=self.header, column=column)

    def refuse(
        self,
        column: str,
        wrong: np.ndarray,
        expected: str,
        found: str = "'{}'",
        values: Sequence[Any] | None = None,
    ) -> None:
        """Raise an error at the first wrong row; do nothing if there is none.

        Parameters
        ----------
        column : str
            Header of the column at fault.
        wrong : array of bool
            True for each wrong row.
        expected : str
            The expected content, for the message.
        found : str
            Format of the content found, with {} for the value.
        values : sequence, optional
            Value of each row for the message; default: the cells.
        """
        if wrong.any():
            row = int(np.argmax(wrong))
            content = (self[column] if values is None else values)[row]
            raise self.error(found.format(content), expected, row, column)

    def missing_column(self, name: str) -> InputError:
        """Make the error of a missing column."""
        return self.header_error(f"no column '{name}'", nearest(name, list(self.names)))

    def drop(self, patterns: Iterable[str]) -> Sheet:
        """Drop columns by name; * and ? are wildcards.

        Raises
        ------
        InputError
            If a name matches no column, or no column is left.
        """
        kept = list(self.names)
        for pattern in patterns:
            if not any(fnmatchcase(name, pattern) for name in self.names):
                raise self.missing_column(pattern)
            kept = [name for name in kept if not fnmatchcase(name, pattern)]
        if not kept:
            raise self.header_error("no column that is not ignored", "a column to read")
        return self.select(kept)

    def select(self, names: Sequence[str]) -> Sheet:
        """Select columns."""
        return replace(self, names=tuple(names), cells=[self[name] for name in names])

    def drop_unnamed(self) -> Sheet:
        """Drop columns without a name, such as the index that pandas writes."""
        kept = [name for name in self.names if name and not name.startswith("Unnamed:")]
        if len(kept) in (0, len(self.names)):
            return self
        notes = (*self.notes, "A column without a name was ignored.")
        return replace(self.select(kept), notes=notes)

    def take(self, keep: Sequence[int]) -> Sheet:
        """Select rows."""
        lines = None if self.lines is None else [self.lines[row] for row in keep]
        cells = [c[keep] if isinstance(c, np.ndarray) else [c[r] for r in keep] for c in self.cells]
        return replace(self, cells=cells, lines=lines)

    def keep_rows(self, keep: Sequence[int], bad: Iterable[InputError]) -> Sheet:
        """Select rows, and record the errors of the others in ``bad_rows``."""
        errors = sorted((*self.bad_rows, *bad), key=lambda error: error.line or 0)
        return replace(self.take(keep), bad_rows=tuple(errors))

    def drop_bad_rows(self, check: Callable[[Sheet], object]) -> Sheet:
        """Omit the rows for which a check raises, if ``skip_bad`` is set.

        The check takes a sheet; bad rows are found by bisection, and their errors are kept.

        Raises
        ------
        InputError
            If no row is left: the error of the first row.
        """
        if not self.skip_bad:
            return self
        keep: list[int] = []
        errors: list[InputError] = []
        pending = [range(len(self))]
        while pending:
            rows = pending.pop()
            try:
                check(self.take(rows))
                keep += rows
            except InputError as error:
                if len(rows) == 1:
                    found = re.sub(r"^reading 1:", f"reading {rows[0] + 1}:", error.found)
                    errors.append(replace(error, found=found))
                else:
                    half = len(rows) // 2
                    pending += [rows[half:], rows[:half]]
        if errors and not keep:
            raise errors[0]
        return self.keep_rows(keep, errors)

    def numbers(
        self,
        name: str,
        *,
        blank: bool = False,
        unit: str = "",
        read: Callable[[Any], float] = number,
        expected: str = "a number",
    ) -> np.ndarray:
        """Read a column of finite numbers.

        Parameters
        ----------
        name : str
            Its header.
        blank : bool
            True if blank cells and NaN are allowed; both give NaN.
        unit : str
            Unit that may follow a number in its cell.
        read : callable
            Converts a cell to a number, or raises ValueError.
        expected : str
            The expected content, for the message.

        Raises
        ------
        InputError
            At the first cell that is no number, naming line and column.
        """
        cells = self[name]
        if isinstance(cells, np.ndarray) and read is number and np.isfinite(cells).all():
            return cells.astype(float)
        values, row = numbers_of(cells, read, blank)
        if row is not None and unit and number_and_unit(str(cells[row])):
            parts = ((cell, number_and_unit(str(cell))) for cell in cells)
            cells = [p[0] if p and p[1] == unit else cell for cell, p in parts]
            values, row = numbers_of(cells, read, blank)
        if row is None:
            return values
        cell = self[name][row]
        if read is number and is_number(cell):
            raise self.error(f"'{cell}'", "a finite number", row, name)
        more = " with a decimal point" if "," in str(cell) else ""
        more = " in the unit of the column" if number_and_unit(str(cell)) else more
        if re.search(r"\d\s*(±|\+/?-)", str(cell)):
            more = ", and its error in a column of its own"
        found = "an empty cell" if cell == "" else f"'{cell}'"
        raise self.error(found, expected + more, row, name)

    def values(self, column: Column, *, blank: bool = False) -> np.ndarray:
        """Read a column in SI, dates as seconds since 1970; see `numbers`."""
        cells = self[column.header]
        if column.unit == DATE:
            read, expected = dates_in_order(self.date_order), _expected_date(cells, column.header)
            return self.numbers(column.header, read=read, expected=expected)
        return self.numbers(column.header, blank=blank, unit=column.unit) * column.factor


def _expected_date(cells: Sequence[Any], header: str) -> str:
    """Expected form of a date, for the message about a column with this first cell."""
    first = str(next(iter(cells), ""))
    if NUMERIC_DATE.match(first):
        expected = "a date whose day and month cannot be exchanged, such as 2024-03-01, "
        return expected + "or --columns day-month-year (or month-day-year)"
    if HOUR_OR_MINUTE.fullmatch(first):
        return "00:00:00: are these hours and minutes, or minutes and seconds?"
    if is_number(first):
        units = ", ".join(f"{header}_{unit}" for unit in ("s", "ms", "d"))
        return f"a date, or the unit of the number in the header: {units}"
    return "an ISO 8601 time, such as 2024-03-01T12:00:00+01:00"


def columns_of(
    sheet: Sheet,
    quantities: Mapping[str, str],
    other: Callable[[str], Column | None] = lambda header: None,
    names: str = "names with units, such as size_x_um or time_s",
) -> dict[str, Column]:
    """Map every header of a sheet to a quantity and unit.

    Parameters
    ----------
    sheet : Sheet
        The file.
    quantities : mapping of str to str
        Kind of unit (a key of `UNITS`) by the column's name without unit; "" for a pure number
        or a word.
    other : callable
        Column of any other header, in the form of `standard_header`; None if it is unknown.
    names : str
        Names expected instead of several unknown ones, for the message.

    Returns
    -------
    dict of str to Column
        Column of each quantity.

    Raises
    ------
    InputError
        If a header or its unit is unknown, or two columns have the same quantity.

    Examples
    --------
    >>> sheet = Sheet("a.csv", ("size_x_mm",), [["0.1"]], [2], 1, ())
    >>> columns_of(sheet, {"size_x": "length"})["size_x"].factor
    0.001
    """
    found: dict[str, Column] = {}
    errors: list[InputError] = []
    for header in sorted(sheet.names, key=lambda name: name not in sheet.file_headers):
        not_in_layout = sheet.has_layout and header not in sheet.file_headers
        standard = standard_header(header)
        try:
            if (column := _quantity_column(standard, quantities, sheet) or other(standard)) is None:
                nearest_names = nearest(header, example_headers(quantities))
                raise sheet.header_error("an unknown column", nearest_names, header)
        except InputError as error:
            file_header = sheet.file_headers.get(header, header)
            errors += [] if not_in_layout else [replace(error, column=file_header)]
            continue
        if column.key not in found:
            found[column.key] = column._replace(header=header)
        elif not not_in_layout:
            raise _duplicate_error(sheet, column.key, found[column.key].header, header)
    if errors:
        raise errors[0] if sheet.skip_bad is None else _unknown_columns_error(errors, names)
    return found


def example_headers(quantities: Mapping[str, str]) -> list[str]:
    """One header for each quantity of `columns_of`, with the first of its units."""
    return [f"{q}_{next(iter(UNITS[kind]))}" if kind else q for q, kind in quantities.items()]


def _duplicate_error(sheet: Sheet, key: str, first: str, header: str) -> InputError:
    """Error of two columns with the same quantity."""
    if header == first:
        expected = "a row for each shot, or names that differ"
        return sheet.header_error(f"{key} twice or more under one name", expected, header)
    expected = "one column for it, in one unit, and none twice"
    expected += f"; --ignore '{header}' leaves this one unread" * (sheet.skip_bad is not None)
    file_header = sheet.file_headers.get(first, first)
    return sheet.header_error(f"{key} also in column '{file_header}'", expected, header)


def _unknown_columns_error(errors: Sequence[InputError], names: str) -> InputError:
    """Error of all unknown columns, with the options that resolve it."""
    first, ignoring = errors[0], [f"--ignore '{error.column}'" for error in errors]
    columns_option = f"--columns '{first.column}=NAME' says what it is"
    expected = f"{first.expected}; {columns_option}, --ignore leaves it unread"
    if len(errors) > 1:
        expected = f"{names}; {columns_option} (`beamfit check` proposes a layout), or to leave "
        expected += f"them unread: {' '.join(ignoring)}"
    return replace(first, expected=expected)


def _quantity_column(header: str, quantities: Mapping[str, str], sheet: Sheet) -> Column | None:
    """Column of a header NAME or NAME_UNIT; None if the name is not among the quantities."""
    for key in (header, header.lower()):
        if quantities.get(key) == "":
            return Column(header, key)
    name, _, unit = header.rpartition("_")
    if not (kind := quantities.get(name := name.lower())):
        return None
    units = UNITS[kind]
    if unit not in units:
        unitless = header.lower() in quantities  # such as size_x_error
        example, found = (header, "no unit") if unitless else (name, f"unknown unit '{unit}'")
        expected = f"one of {', '.join(units)} at the end, such as {example}_{next(iter(units))}"
        raise sheet.header_error(found, expected, header)
    return Column(header, name, unit, units[unit])


def ignored_note(sheet: Sheet, columns: Mapping[str, Column]) -> tuple[str, ...]:
    """Note that lists the columns ignored because a layout is given; empty without one."""
    used = {column.header for column in columns.values()}
    unused = [name for name in sheet.names if name not in used] if sheet.has_layout else []
    more = [f"{len(unused) - MAX_LISTED_COLUMNS} more"] if len(unused) > MAX_LISTED_COLUMNS else []
    return (f"Ignored: {', '.join(unused[:MAX_LISTED_COLUMNS] + more)}.",) if unused else ()


def sheet_notes(sheet: Sheet) -> tuple[str, ...]:
    """Notes on changed cells and omitted rows."""
    if not sheet.bad_rows:
        return sheet.notes
    listed = [
        (f"line {e.line}, " if e.line else "")
        + (f"column '{e.column}', " if e.column else "")
        + e.found
        for e in sheet.bad_rows[:MAX_LISTED_ROWS]
    ]
    more = len(sheet.bad_rows) - len(listed)
    listed += [f"{more} more"] if more else []
    were = "was" if len(sheet.bad_rows) == 1 else "were"
    total = len(sheet) + len(sheet.bad_rows)
    note = f"{len(sheet.bad_rows)} of {total} rows {were} left out: {'; '.join(listed)}."
    return (*sheet.notes, note)


LAYOUT_FORMAT = "beamfit-layout-1"
# Layouts that come with the package.
LAYOUT_FOLDER = Path(__file__).with_name("layouts")
DATE_ORDERS = (DAY_FIRST, MONTH_FIRST)
NAME_LIST = "a list of names in quotes"
ITEM_EXAMPLE = "'xrms=size_x_um, QUAD:BACT=Q525_kG', or a layout (.toml)"
LAYOUT_KEYS = {
    "columns": Key("columns", kind=TABLE, default={}),
    "ignore": Key("ignore", kind=LIST, default=[], expected=NAME_LIST, each=str),
    "dates": Key("dates", kind=TEXT, default="", among=DATE_ORDERS),
    "header": Key("header", kind=LIST, default=[], expected=NAME_LIST, each=str),
}


@dataclass(frozen=True)
class Layout:
    """Meaning of the columns of a file, given by the user; it takes precedence over the headers.

    Attributes
    ----------
    names : tuple of (str, str)
        Header in the file (or a pattern with * and ?), and beamfit's name with unit for it:
        ``("xrms", "size_x_um")``.
    needed : tuple of str
        Headers that the file must have: those given on the command line. Those of a layout file
        may be absent.
    ignore : tuple of str
        Columns to leave unread; they may be absent.
    dates : str
        "day-month-year" or "month-day-year", for ambiguous dates.
    header : tuple of str
        Column names of a file without a header; "*" for further cells.
    """

    names: tuple[tuple[str, str], ...] = ()
    needed: tuple[str, ...] = ()
    ignore: tuple[str, ...] = ()
    dates: str = ""
    header: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        return self != Layout()

    def __add__(self, other: Layout) -> Layout:
        """Combine two layouts; the second takes precedence."""
        names = dict(self.names) | dict(other.names)
        return Layout(
            tuple(names.items()),
            self.needed + other.needed,
            self.ignore + other.ignore,
            other.dates or self.dates,
            other.header or self.header,
        )

    def names_for(self, sheet: Sheet) -> dict[str, str]:
        """Names that the layout gives to headers of a sheet.

        Raises
        ------
        InputError
            If a needed header is missing, or two columns would get the same name.

        Examples
        --------
        >>> sheet = Sheet("a.csv", ("Q5:BACT", "xrms"), [["1"], ["9"]], [2], 1, ())
        >>> layout_of("xrms=size_x_um, Q5:BACT=Q5_kG").names_for(sheet)
        {'xrms': 'size_x_um', 'Q5:BACT': 'Q5_kG'}
        """
        found: dict[str, str] = {}
        for header, name in self.names:
            matching = [h for h in sheet.names if header in _header_forms(h)]
            matching = matching or [h for h in sheet.names if fnmatchcase(h, header)]
            if not matching and header in self.needed:
                raise sheet.missing_column(header)
            if len(matching) > 1 or (matching and name in found.values()):
                expected = "one column for each name"
                both = " and ".join(matching or [header])
                raise sheet.header_error(f"{both} for {name}", expected, header)
            found |= dict.fromkeys(matching, name)
        return found


Columns = str | PathLike[str] | Mapping[str, str] | Layout | None
"""Forms in which a reader takes a layout; see `layout_of`."""


def _header_forms(header: str) -> set[str]:
    """Forms of a header that a layout may name: as it stands, standardised, without its unit."""
    standard = standard_header(header)
    unit = unit_at_end(standard)
    return {header, standard, standard.removesuffix(f"_{unit}") if unit else header}


def layout_of(columns: str | PathLike[str] | Mapping[str, str] | Layout | None) -> Layout:
    """Make a layout from any of the forms that a reader takes.

    Parameters
    ----------
    columns : str, path, mapping or Layout
        ``"xrms=size_x_um, QUAD:BACT=Q525_kG"``, with quotes around an item that holds a comma; a
        layout file (``.toml``) or the name of one that comes with beamfit; ``day-month-year``; or
        several of these, separated by commas. Or a mapping of header to name.

    Raises
    ------
    InputError
        If a layout cannot be read or does not exist.

    Examples
    --------
    >>> layout_of({"xrms": "size_x_um"}) == layout_of("xrms = size_x_um")
    True
    """
    if columns is None or isinstance(columns, Layout):
        return columns or Layout()
    if isinstance(columns, Mapping):
        items = tuple((str(header), str(name)) for header, name in columns.items())
        return Layout(items, tuple(header for header, _ in items))
    if isinstance(columns, PathLike):
        return _read_layout(columns)
    found = Layout()
    for item in filter(
        None, map(str.strip, next(csv.reader([columns], skipinitialspace=True), []))
    ):
        found += _parse_item(item)
    return found


def _parse_item(item: str) -> Layout:
    """Layout of one item: HEADER=NAME, an order of dates, or the name or path of a layout."""
    header, has_name, name = (part.strip() for part in item.rpartition("="))
    if has_name:
        if not header or not name:
            raise InputError(f"--columns '{item}'", f"HEADER=NAME such as {ITEM_EXAMPLE}")
        return Layout(((header, name),), (header,))
    if item in DATE_ORDERS:
        return Layout(dates=item)
    shipped = {path.stem: path for path in LAYOUT_FOLDER.glob("*.toml")}
    if item in shipped:
        return _read_layout(shipped[item])
    if not item.endswith(".toml"):
        known = nearest(item, sorted([*shipped, *DATE_ORDERS]))
        raise InputError(f"--columns {item}", f"HEADER=NAME such as {ITEM_EXAMPLE}; or {known}")
    return _read_layout(item)


def _read_layout(path: str | PathLike[str]) -> Layout:
    """Read a layout file."""
    section = read_toml(path, "a layout", LAYOUT_FORMAT)
    values = section.values(LAYOUT_KEYS)
    for header, name in values["columns"].items():
        if not (isinstance(name, str) and name.strip()):
            expected = 'the name that beamfit has for it, such as "size_x_um"'
            raise section.error(f"'{header}' = {name!r}", expected, "columns")
    names = tuple(values["columns"].items())
    return Layout(names, (), tuple(values["ignore"]), values["dates"], tuple(values["header"]))


def apply_layout(sheet: Sheet, layout: Layout) -> Sheet:
    """Rename the columns of a sheet by a layout, and drop those it ignores.

    Parameters
    ----------
    sheet : Sheet
        The file.
    layout : Layout
        Meaning of the columns.

    Returns
    -------
    Sheet
        With new names; messages still name the columns as the file does.

    Examples
    --------
    >>> sheet = Sheet("a.csv", ("xrms", "n"), [["0.1"], ["7"]], [2], 1, ())
    >>> apply_layout(sheet, layout_of("xrms=size_x_mm")).names
    ('size_x_mm', 'n')
    """
    if not layout:
        return sheet
    present = [p for p in layout.ignore if any(fnmatchcase(name, p) for name in sheet.names)]
    sheet = sheet.drop(present) if present else sheet
    new_names = layout.names_for(sheet)
    # A column that already has one of the new names is dropped: the layout means another one.
    kept = [name for name in sheet.names if name in new_names or name not in new_names.values()]
    sheet = sheet.select(kept)
    names = tuple(new_names.get(name, name) for name in kept)
    file_headers = {name: header for header, name in new_names.items()}
    return replace(
        sheet, names=names, file_headers=file_headers, date_order=layout.dates, has_layout=True
    )


def layout_text(unknown: Mapping[str, tuple[str | None, Any]]) -> str:
    """Write a layout for unknown columns, to be completed by the user.

    Parameters
    ----------
    unknown : mapping of str to (str or None, object)
        Guessed name (or None) and a cell, by header.

    Examples
    --------
    >>> print(layout_text({"xrms": ("size_x_um", 0.1), "n": (None, 7)}))
    format = "beamfit-layout-1"
    ignore = []  # headers to leave unread
    <BLANKLINE>
    [columns]  # "header" = "its name and unit in beamfit": docs/files.md has them
    "xrms" = "size_x_um"  # 0.1: is it that, and in this unit?
    # "n" = ""  # 7
    """
    lines = [f'format = "{LAYOUT_FORMAT}"', "ignore = []  # headers to leave unread", ""]
    lines.append('[columns]  # "header" = "its name and unit in beamfit": docs/files.md has them')
    for header, (guess, cell) in unknown.items():
        quoted = header.replace("\\", "\\\\").replace('"', '\\"')
        remark = f"{cell}: is it that, and in this unit?" if guess else f"{cell}"
        lines.append(f'{"" if guess else "# "}"{quoted}" = "{guess or ""}"  # {remark}')
    return "\n".join(lines)
