"""Named columns: their meaning, as headers or a person say it, and the place of every value."""

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
    NUMBERS,
    dates_in_order,
    is_number,
    number,
    numbers_of,
)
from beamfit.io.toml import LIST, TABLE, TEXT, Key, read_toml
from beamfit.particles import LIGHT

UNITS: dict[str, dict[str, float]] = {
    # quantity: unit at the end of a name -> factor to SI (a stored current: to mA)
    "length": {"um": 1e-6, "mm": 1e-3, "m": 1.0, "nm": 1e-9, "cm": 1e-2},
    "length or duration": {"mm": 1e-3, "m": 1.0, "ps": LIGHT / 1e12},
    "time": {"s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "current": {"mA": 1.0, "A": 1e3, "uA": 1e-3, "nA": 1e-6},
    "voltage": {"kV": 1e3, "V": 1.0, "MV": 1e6},
    "pressure": {"Pa": 1.0, "mbar": 100.0, "Torr": 101325 / 760},
    "energy in MeV": {"MeV": 1.0},
}
UNITS["length or share"] = UNITS["length"] | {"%": 0.01}
# Units at the end of a header, as the columns' names have them.
KNOWN = {*SETTINGS, *(unit for units in UNITS.values() for unit in units)}
ENDS = tuple(f"_{unit}" for unit in KNOWN)
# Other ways to write one; in capitals or small letters no other unit is meant by these.
ALSO = {
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
        "mA": ("ma",),
        "Pa": ("pa", "PA"),
        "Torr": ("torr", "TORR"),
        "%": ("percent",),
    }.items()
    for word in words
}
# A number and what stands behind it.
NUMBER = re.compile(r"([-+]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][-+]?\d+)?)\s*([^\W\d_].*|[%\[(].*)")
# What stands between a name and its unit: size x (µm), Q [T/m], I/A, "I, A", I in A, Time / h.
BETWEEN = re.compile(r"\s+in\s+|[\s_]*[\[(]|\s+/\s+|/|,\s?|[\s_]+")


def known_unit(text: str) -> str | None:
    """A unit as the names of columns have it, with u for either letter µ; None if it is none."""
    text = re.sub("[µμ]", "u", text.strip().strip("[]()").strip())
    return text if text in KNOWN else ALSO.get(text)


def named(name: str, unit: str) -> str:
    """The name of a column with its unit behind it, without blanks."""
    return re.sub(r"\s+", "_", f"{name}_{unit}")


@lru_cache(maxsize=4096)  # a year's files have the headers of the first
def spelled(header: str) -> str:
    """A header as ``name_unit``; as it stands where it has no unit.

    Examples
    --------
    >>> [spelled(h) for h in ("Q525 [T/m]", "size x (µm)", "Time / h", "SIZE_X_MM", "Q5 T m^-1")]
    ['Q525_T_per_m', 'size_x_um', 'Time_h', 'SIZE_X_mm', 'Q5_T_per_m']
    >>> [spelled(h) for h in ("I/A", "size x, um", "size x in um", "Q1_T/m", "sr/dcct/A")]
    ['I_A', 'size_x_um', 'size_x_um', 'Q1_T_per_m', 'sr/dcct/A']
    """
    if header.endswith(ENDS):
        return header
    for found in BETWEEN.finditer(header):
        name, unit = header[: found.start()].strip(), known_unit(header[found.end() :])
        # Within a path such as sr/dcct/A or a unit such as [G/cm].
        within = found[0] in "/," and re.search(r"[/,]|[\[(][^\])]*$", name)
        if name and unit and not within:
            return named(name.removesuffix(f"_{unit}"), unit)
    return header


def unit_at_end(name: str) -> str | None:
    """The unit that a name as `spelled` ends with; None if it has none."""
    return max((u for u in KNOWN if name.endswith(f"_{u}")), key=len, default=None)


def number_and_unit(cell: str) -> tuple[str, str] | None:
    """A number, and the unit behind it as the names of columns have it; None if it has none.

    Examples
    --------
    >>> [number_and_unit(cell) for cell in ("627 µm", "1.5A", "1e-3", "OTR2")]
    [('627', 'um'), ('1.5', 'A'), None, None]
    """
    found = None if cell[-1:].isdigit() else NUMBER.fullmatch(cell)
    unit = known_unit(found[2]) if found else None
    return (found[1], unit) if unit else None


def is_header(cells: Sequence[str]) -> bool:
    """Tell a header from other rows: two or more names with units, and no number among them."""
    if sum(map(has_unit, cells)) < 2:
        return False
    return not any(map(is_number, cells)) and not any(map(number_and_unit, cells))


def has_unit(header: str) -> bool:
    """Tell a header that says its unit."""
    return unit_at_end(spelled(header)) is not None


def units_below(cells: Sequence[str]) -> list[str | None] | None:
    """The units of a row of nothing else; None if it is no such row.

    Examples
    --------
    >>> units_below(["A", "[um]", ""]), units_below(["A", "5"])
    (['A', 'um', None], None)
    """
    units = [known_unit(cell) for cell in cells]
    plain = all(u or cell in ("", "-", "1") for u, cell in zip(units, cells, strict=True))
    return units if plain and any(units) else None


def with_units(
    names: Sequence[str], cells: Sequence[str], path: str | PathLike[str], line: int
) -> list[str] | None:
    """Names with the units of a row of units below them; None if the row is none.

    Raises
    ------
    InputError
        If a name has another unit already.

    Examples
    --------
    >>> with_units(["Q2", "size_x", "shot"], ["A", "[um]", ""], "a.csv", 2)
    ['Q2_A', 'size_x_um', 'shot']
    """
    if (units := units_below(cells)) is None:
        return None
    found = []
    for name, unit in zip(names, units, strict=True):
        own = unit_at_end(spelled(name))
        if own and unit and own != unit:
            expected = "one unit, in the header or below it"
            raise InputError(f"'{unit}' below a header in {own}", expected, path, line, name)
        found.append(name if own or unit is None else named(name, unit))
    return found


# The unit of a column of dates.
DATE = "a date"
# Most rows left out, or columns ignored, that a note names one by one.
MOST_NAMED, MOST_ASIDE = 5, 8


class Column(NamedTuple):
    """Meaning of a header: the quantity, its unit, and the factor to SI."""

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
    notes : tuple of str
        What was done to the cells.
    called : mapping of str to str
        Name to the header of the file, where a layout says what a column is.
    order : str
        Of dates whose day and month are numbers, where a layout says it.
    arranged : bool
        Whether there is a layout: unknown columns are then ignored.
    skip : str
        What may be done about a row with something wrong in it, for messages.
    skip_bad : bool or None
        Whether such rows are left out; None where nobody can say so, nor --columns and --ignore.
    """

    path: str | PathLike[str]
    names: tuple[str, ...]
    cells: Sequence[Sequence[Any]]
    lines: Sequence[int] | None
    header: int | None
    comments: tuple[str, ...]
    sha256: str = ""
    bad: tuple[InputError, ...] = ()
    notes: tuple[str, ...] = ()
    called: Mapping[str, str] = field(default_factory=dict)
    order: str = ""
    arranged: bool = False
    skip: str = ""
    skip_bad: bool | None = None

    def __len__(self) -> int:
        return len(self.cells[0])

    def __getitem__(self, name: str) -> Sequence[Any]:
        return self.cells[self.names.index(name)]

    def error(self, found: str, expected: str, row: int, column: str | None = None) -> InputError:
        """Make the error that names the file, the row, and the column if it is one alone."""
        line, column = None, self.called.get(column, column)
        if self.lines is None:
            found = f"reading {row + 1}: {found}"
        else:
            line = self.lines[row]
        return InputError(found, expected + self.skip, path=self.path, line=line, column=column)

    def header_error(self, found: str, expected: str, column: str | None = None) -> InputError:
        """Make the error that names the header, and the column if it is one alone."""
        if column in self.called:
            expected = f"{expected}; --columns says that it is {column}"
            column = self.called[column]
        return InputError(found, expected, path=self.path, line=self.header, column=column)

    def refuse(
        self,
        column: str,
        wrong: np.ndarray,
        expected: str,
        found: str = "'{}'",
        values: Sequence[Any] | None = None,
    ) -> None:
        """Raise the error of the first row that is wrong, if one is.

        Parameters
        ----------
        column : str
            Header of the column at fault.
        wrong : array of bool
            Row by row.
        expected : str
            What should stand there.
        found : str
            How to say what stands there, with {} in the place of the value.
        values : sequence, optional
            One a row; default: the cells.
        """
        if wrong.any():
            row = int(np.argmax(wrong))
            said = (self[column] if values is None else values)[row]
            raise self.error(found.format(said), expected, row, column)

    def no_column(self, name: str) -> InputError:
        """Make the error of a column that is not there."""
        return self.header_error(f"no column '{name}'", nearest(name, list(self.names)))

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
                raise self.no_column(pattern)
            left = [name for name in left if not fnmatchcase(name, pattern)]
        if not left:
            raise self.header_error("no column that is not ignored", "a column to read")
        return self.only(left)

    def only(self, names: Sequence[str]) -> Sheet:
        """Some of the columns."""
        return replace(self, names=tuple(names), cells=[self[name] for name in names])

    def named(self) -> Sheet:
        """Leave out columns without a name, such as the index that pandas writes."""
        left = [name for name in self.names if name and not name.startswith("Unnamed:")]
        if len(left) in (0, len(self.names)):
            return self
        return replace(self.only(left), notes=(*self.notes, "A column without a name was ignored."))

    def rows(self, keep: Sequence[int]) -> Sheet:
        """Some of the rows."""
        lines = None if self.lines is None else [self.lines[row] for row in keep]
        cells = [c[keep] if isinstance(c, np.ndarray) else [c[r] for r in keep] for c in self.cells]
        return replace(self, cells=cells, lines=lines)

    def without_rows(self, keep: Sequence[int], bad: Iterable[InputError]) -> Sheet:
        """Some of the rows, and what is wrong with the others."""
        errors = sorted((*self.bad, *bad), key=lambda error: error.line or 0)
        return replace(self.rows(keep), bad=tuple(errors))

    def good(self, check: Callable[[Sheet], object]) -> Sheet:
        """Leave out the rows that a check of each row refuses, where a person asks for that.

        What it said of them is kept.

        Raises
        ------
        InputError
            If no row is left: the first that was wrong.
        """
        if not self.skip_bad:
            return self
        keep: list[int] = []
        bad: list[InputError] = []
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
        if bad and not keep:
            raise bad[0]
        return self.without_rows(keep, bad)

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
            Whether a cell may be blank, or say NaN in a text; it is NaN then.
        unit : str
            What may stand behind a number.
        read : callable
            From a cell to a number, or ValueError.
        expected : str
            What the cell should have been, for the message.

        Raises
        ------
        InputError
            Naming line and column of the first cell that is no number.
        """
        cells = self[name]
        if isinstance(cells, np.ndarray) and read is number and np.isfinite(cells).all():
            return cells.astype(float)
        values, row = numbers_of(cells, read, blank)
        if row is not None and unit and number_and_unit(str(cells[row])):
            apart = ((cell, number_and_unit(str(cell))) for cell in cells)
            cells = [own[0] if own and own[1] == unit else cell for cell, own in apart]
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
        """A column of finite numbers in SI, or of dates in s since 1970; as `numbers`."""
        cells = self[column.header]
        if column.unit == DATE:
            read, expected = dates_in_order(self.order), _expected_date(cells, column.header)
            return self.numbers(column.header, read=read, expected=expected)
        return self.numbers(column.header, blank=blank, unit=column.unit) * column.factor


def _expected_date(cells: Sequence[Any], header: str) -> str:
    """Say what a column of dates should have, by its first cell."""
    first = str(next(iter(cells), ""))
    if NUMBERS.match(first):
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
    unknown: list[InputError] = []
    for header in sorted(sheet.names, key=lambda name: name not in sheet.called):
        aside = sheet.arranged and header not in sheet.called
        said = spelled(header)
        try:
            if (column := _known(said, quantities, sheet) or other(said)) is None:
                known = nearest(header, examples(quantities))
                raise sheet.header_error("an unknown column", known, header)
        except InputError as error:
            own = sheet.called.get(header, header)
            unknown += [] if aside else [replace(error, column=own)]
            continue
        if column.key not in found:
            found[column.key] = column._replace(header=header)
        elif not aside:
            raise _twice(sheet, column.key, found[column.key].header, header)
    if unknown:
        raise unknown[0] if sheet.skip_bad is None else _not_understood(unknown)
    return found


def examples(quantities: Mapping[str, str]) -> list[str]:
    """A header of each quantity of `columns_of`, with the first of its units."""
    return [f"{q}_{next(iter(UNITS[kind]))}" if kind else q for q, kind in quantities.items()]


def _twice(sheet: Sheet, key: str, first: str, header: str) -> InputError:
    """Error of a quantity in two columns."""
    if header == first:
        expected = "a row for each shot, or names that differ"
        return sheet.header_error(f"{key} twice or more under one name", expected, header)
    expected = "one column for it, in one unit, and none twice"
    expected += f"; --ignore '{header}' leaves this one unread" * (sheet.skip_bad is not None)
    named = sheet.called.get(first, first)
    return sheet.header_error(f"{key} also in column '{named}'", expected, header)


def _not_understood(unknown: Sequence[InputError]) -> InputError:
    """Error of columns that nobody knows, all of which are named, and what may be said of them."""
    first, names = unknown[0], [f"--ignore '{error.column}'" for error in unknown]
    said = f"--columns '{first.column}=NAME' says what it is"
    expected = f"{first.expected}; {said}, --ignore leaves it unread"
    if len(unknown) > 1:
        expected = f"names with units, such as size_x_um or time_s; {said} (`beamfit check` "
        expected += f"proposes a layout), or to leave them unread: {' '.join(names)}"
    return replace(first, expected=expected)


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
        whole = header.lower() in quantities  # such as size_x_error
        named, found = (header, "no unit") if whole else (name, f"unknown unit '{unit}'")
        expected = f"one of {', '.join(units)} at the end, such as {named}_{next(iter(units))}"
        raise sheet.header_error(found, expected, header)
    return Column(header, name, unit, units[unit])


def ignored(sheet: Sheet, columns: Mapping[str, Column]) -> tuple[str, ...]:
    """Name the columns that a layout and beamfit do not know, and that were not read, as a note."""
    used = {column.header for column in columns.values()}
    aside = [name for name in sheet.names if name not in used] if sheet.arranged else []
    more = [f"{len(aside) - MOST_ASIDE} more"] if len(aside) > MOST_ASIDE else []
    return (f"Ignored: {', '.join(aside[:MOST_ASIDE] + more)}.",) if aside else ()


def left_out(sheet: Sheet) -> tuple[str, ...]:
    """Say what was done to the cells, and count and name the rows that were left out, as notes."""
    if not sheet.bad:
        return sheet.notes
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
    return (*sheet.notes, f"{len(sheet.bad)} of {total} rows {were} left out: {'; '.join(named)}.")


FORMAT = "beamfit-layout-1"
# Layouts that come with the package, by name.
SHIPPED = Path(__file__).with_name("layouts")
ORDERS = (DAY_FIRST, MONTH_FIRST)
NAMES = "a list of names in quotes"
EXAMPLE = "'xrms=size_x_um, QUAD:BACT=Q525_kG', or a layout (.toml)"
KEYS = {
    "columns": Key("columns", kind=TABLE, default={}),
    "ignore": Key("ignore", kind=LIST, default=[], said=NAMES, each=str),
    "dates": Key("dates", kind=TEXT, default="", among=ORDERS),
    "header": Key("header", kind=LIST, default=[], said=NAMES, each=str),
}


@dataclass(frozen=True)
class Layout:
    """The meaning of a file's columns: believed as it stands, and nothing is guessed against it.

    Attributes
    ----------
    names : tuple of (str, str)
        Header of the file, or a pattern with * and ?, and the name that beamfit has for it, with
        its unit: ``("xrms", "size_x_um")``.
    needed : tuple of str
        Headers that must be there: those said for one file; a laboratory's layout may have more.
    ignore : tuple of str
        Columns to leave unread, where they are there.
    dates : str
        "day-month-year" or "month-day-year", for dates that may be read both ways.
    header : tuple of str
        Names of the columns of a file that has no header; "*" for further cells.
    """

    names: tuple[tuple[str, str], ...] = ()
    needed: tuple[str, ...] = ()
    ignore: tuple[str, ...] = ()
    dates: str = ""
    header: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        return self != Layout()

    def __add__(self, other: Layout) -> Layout:
        """Both; where they disagree, what the other says."""
        names = dict(self.names) | dict(other.names)
        return Layout(
            tuple(names.items()),
            self.needed + other.needed,
            self.ignore + other.ignore,
            other.dates or self.dates,
            other.header or self.header,
        )

    def called(self, sheet: Sheet) -> dict[str, str]:
        """The name of each of a sheet's headers for which the layout has one.

        Raises
        ------
        InputError
            If a header that was said is missing, or two would have one name.

        Examples
        --------
        >>> sheet = Sheet("a.csv", ("Q5:BACT", "xrms"), [["1"], ["9"]], [2], 1, ())
        >>> layout_of("xrms=size_x_um, Q5:BACT=Q5_kG").called(sheet)
        {'xrms': 'size_x_um', 'Q5:BACT': 'Q5_kG'}
        """
        found: dict[str, str] = {}
        for said, name in self.names:
            matching = [h for h in sheet.names if said in _spellings(h)]
            matching = matching or [h for h in sheet.names if fnmatchcase(h, said)]
            if not matching and said in self.needed:
                raise sheet.no_column(said)
            if len(matching) > 1 or (matching and name in found.values()):
                expected = "one column for each name"
                both = " and ".join(matching or [said])
                raise sheet.header_error(f"{both} for {name}", expected, said)
            found |= dict.fromkeys(matching, name)
        return found


Columns = str | PathLike[str] | Mapping[str, str] | Layout | None
"""Layout of columns as a reader takes it; see `layout_of`."""


def _spellings(header: str) -> set[str]:
    """A header as it stands, and without the unit that stands below or beside it."""
    said = spelled(header)
    unit = unit_at_end(said)
    return {header, said, said.removesuffix(f"_{unit}") if unit else header}


def layout_of(columns: str | PathLike[str] | Mapping[str, str] | Layout | None) -> Layout:
    """Read what is said of columns.

    Parameters
    ----------
    columns : str, path, mapping or Layout
        ``"xrms=size_x_um, QUAD:BACT=Q525_kG"``, with quotes around an item that holds a comma; a
        layout file (``.toml``) or the name of one that comes with beamfit; ``day-month-year``; or
        several of these, separated by commas. A mapping of header to name says the same.

    Raises
    ------
    InputError
        If a layout cannot be read, or there is none of that name.

    Examples
    --------
    >>> layout_of({"xrms": "size_x_um"}) == layout_of("xrms = size_x_um")
    True
    """
    if columns is None or isinstance(columns, Layout):
        return columns or Layout()
    if isinstance(columns, Mapping):
        items = tuple((str(said), str(name)) for said, name in columns.items())
        return Layout(items, tuple(said for said, _ in items))
    if isinstance(columns, PathLike):
        return _read(columns)
    found = Layout()
    for item in filter(
        None, map(str.strip, next(csv.reader([columns], skipinitialspace=True), []))
    ):
        found += _item(item)
    return found


def _item(item: str) -> Layout:
    said, equals, name = (part.strip() for part in item.rpartition("="))
    if equals:
        if not said or not name:
            raise InputError(f"--columns '{item}'", f"HEADER=NAME such as {EXAMPLE}")
        return Layout(((said, name),), (said,))
    if item in ORDERS:
        return Layout(dates=item)
    shipped = {path.stem: path for path in SHIPPED.glob("*.toml")}
    if item in shipped:
        return _read(shipped[item])
    if not item.endswith(".toml"):
        known = nearest(item, sorted([*shipped, *ORDERS]))
        raise InputError(f"--columns {item}", f"HEADER=NAME such as {EXAMPLE}; or {known}")
    return _read(item)


def _read(path: str | PathLike[str]) -> Layout:
    section = read_toml(path, "a layout", FORMAT)
    said = section.values(KEYS)
    for header, name in said["columns"].items():
        if not (isinstance(name, str) and name.strip()):
            expected = 'the name that beamfit has for it, such as "size_x_um"'
            raise section.error(f"'{header}' = {name!r}", expected, "columns")
    names = tuple(said["columns"].items())
    return Layout(names, (), tuple(said["ignore"]), said["dates"], tuple(said["header"]))


def arranged(sheet: Sheet, layout: Layout) -> Sheet:
    """Give the columns of a sheet the names that a layout says.

    Parameters
    ----------
    sheet : Sheet
        The file.
    layout : Layout
        What its columns are; other columns of unknown names are then ignored.

    Returns
    -------
    Sheet
        Its messages name the columns as the file does.

    Examples
    --------
    >>> sheet = Sheet("a.csv", ("xrms", "n"), [["0.1"], ["7"]], [2], 1, ())
    >>> arranged(sheet, layout_of("xrms=size_x_mm")).names
    ('size_x_mm', 'n')
    """
    if not layout:
        return sheet
    present = [p for p in layout.ignore if any(fnmatchcase(name, p) for name in sheet.names)]
    sheet = sheet.without(present) if present else sheet
    called = layout.called(sheet)
    # A column that has such a name already is not the one that was meant.
    kept = [n for n in sheet.names if n in called or n not in called.values()]
    sheet = sheet.only(kept)
    names = tuple(called.get(name, name) for name in kept)
    said = {name: header for header, name in called.items()}
    return replace(sheet, names=names, called=said, order=layout.dates, arranged=True)


def proposal(unknown: Mapping[str, tuple[str | None, Any]]) -> str:
    """Write a layout for columns that nobody knows, for a person to complete.

    Parameters
    ----------
    unknown : mapping of str to (str or None, object)
        Header to the name that it may mean, and a cell.

    Examples
    --------
    >>> print(proposal({"xrms": ("size_x_um", 0.1), "n": (None, 7)}))
    format = "beamfit-layout-1"
    ignore = []  # headers to leave unread
    <BLANKLINE>
    [columns]  # "header" = "its name and unit in beamfit": docs/files.md has them
    "xrms" = "size_x_um"  # 0.1: is it that, and in this unit?
    # "n" = ""  # 7
    """
    lines = [f'format = "{FORMAT}"', "ignore = []  # headers to leave unread", ""]
    lines.append('[columns]  # "header" = "its name and unit in beamfit": docs/files.md has them')
    for header, (guess, cell) in unknown.items():
        quoted = header.replace("\\", "\\\\").replace('"', '\\"')
        asked = f"{cell}: is it that, and in this unit?" if guess else f"{cell}"
        lines.append(f'{"" if guess else "# "}"{quoted}" = "{guess or ""}"  # {asked}')
    return "\n".join(lines)
