"""Cells of tables: parse numbers and dates; fast reading of large numeric files."""

from __future__ import annotations

import hashlib
import itertools
import math
import os
import re
from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta, timezone
from os import PathLike
from typing import Any
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import numpy as np

from beamfit.errors import InputError
from beamfit.io.files import remember_digest

# Texts that programs write for a missing number.
BLANK = {"", "nan", "-nan", "na", "n/a", "n.a.", "#n/a", "<na>", "null", "none", "-", "--", "---"}
BLANK |= {"nan(ind)", "-nan(ind)", "1.#qnan", "-1.#ind", "1.#ind", "#num!", "#value!"}
# Numbers with unambiguous thousands separators, the separators, and an exponent of Fortran.
GROUPED = re.compile(r"[-+]?\d{1,3}(?:(?:,\d{3})+\.\d*|(?:['’\xa0\u202f]\d{3})+(?:\.\d*)?)")
GROUP_SEPARATORS = dict.fromkeys(map(ord, ",'’\xa0\u202f"))
FORTRAN_EXPONENT = re.compile(r"([\d.])[dD]([-+]?\d+)$")


def number(cell: object) -> float:
    """Convert a cell to a number, also in unambiguous notations of Fortran and spreadsheets.

    Raises
    ------
    ValueError
        If it is no number or ambiguous: 5,125 could be 5125.

    Examples
    --------
    >>> [number(cell) for cell in ("5.125D-04", "−5", "5,125.0", "5'125")]
    [0.0005125, -5.0, 5125.0, 5125.0]
    """
    if isinstance(cell, str) and "_" in cell:  # Python ignores it between digits
        raise ValueError("an underscore")
    try:
        return float(cell)
    except ValueError:
        text = cell.replace("−", "-")
        text = text.translate(GROUP_SEPARATORS) if GROUPED.fullmatch(text) else text
        return float(FORTRAN_EXPONENT.sub(r"\1e\2", text))


def is_number(text: object) -> bool:
    """True if a cell is a number."""
    try:
        number(text)
    except ValueError:
        return False
    return True


def numbers_of(
    cells: Sequence[object], read: Callable[[Any], float] = number, blank: bool = False
) -> tuple[np.ndarray, int | None]:
    """Convert cells to numbers; return also the row of the first that is no finite number.

    Examples
    --------
    >>> numbers_of(["1", "-", "2"], blank=True)[0].tolist(), numbers_of(["1", "-", "2"])[1]
    ([1.0, nan, 2.0], 1)
    """
    values = np.full(len(cells), np.nan)
    for row, cell in enumerate(cells):
        if blank and isinstance(cell, str) and cell.lower() in BLANK:
            continue
        try:
            values[row] = read(cell)
        except (ValueError, TypeError, OverflowError):
            return values, row
        if not math.isfinite(values[row]):
            return values, row
    return values, None


# Seconds of a day.
DAY = 86400.0
# Orders of numeric dates.
DAY_FIRST, MONTH_FIRST = "day-month-year", "month-day-year"
# Formats of dates in addition to ISO 8601, day before month.
DATE_FORMATS = (
    "%Y-%m-%d",
    "%d-%b-%Y",
    "%d.%m.%Y",
    "%Y/%m/%d",
    "%d-%b-%y",
    "%d.%m.%y",
    "%d %b %Y",
    "%b %d, %Y",
    "%a %d %b %Y",
)
TIME_FORMATS = tuple(f"{day} {clock}" for day in DATE_FORMATS for clock in ("%H:%M:%S", "%H:%M"))
TIME_FORMATS += ("%a %b %d %H:%M:%S %Y",)
# Numeric date; its order is unambiguous only if one of the two numbers exceeds 12.
NUMERIC_DATE = re.compile(r"(\d{1,2})([/-])(\d{1,2})\2(\d{4})\b")
AM_PM = re.compile(r"(.*\d) ?([AP])\.?M\.?", re.IGNORECASE)
# Offset in h of zone abbreviations that zone databases lack; ambiguous ones are not supported.
ZONE_OFFSETS = {"CEST": 2, "EEST": 3, "EDT": -4, "PDT": -7, "PST": -8, "JST": 9, "KST": 9}
TIME_OF_DAY = re.compile(r"(\d{1,2}):(\d{2})(?::(\d{2}(?:[.,]\d*)?))?")
# Ambiguous first time: hours and minutes after midnight, or minutes and seconds from a start.
HOUR_OR_MINUTE = re.compile(r"0?0:\d{2}")
FRACTION = re.compile(r"[.,](\d+)$")
ZONE_SUFFIX = re.compile(r"^(.*\d) ?([A-Z][A-Za-z_]+(?:/[A-Za-z_]+)*)$")


def unix_time(text: str, *, fold: int = 0, order: str = "") -> float:
    """Convert a date to seconds since 1970; UTC unless it ends with an offset or zone.

    Parameters
    ----------
    text : str
        ISO 8601, 01-Mar-2024 12:00:00.5, 01.03.2024 12:00:00, 2024/03/01 12:00, 13/03/2024
        12:00:00, 03/13/2024 12:00:00 PM, Fri Mar 1 12:00:00 2024.
    fold : int, optional
        1 for the second occurrence of a local time that is repeated in autumn.
    order : {"", "day-month-year", "month-day-year"}
        Order of ambiguous numeric dates.

    Raises
    ------
    ValueError
        If the text is no such date, or ambiguous, such as 03/01/2024.

    Examples
    --------
    >>> unix_time("1970-01-01T01:00:00+01:00"), unix_time("01.01.1970 01:00:00.5 Europe/Berlin")
    (0.0, 0.5)
    """
    date_text, zone, shift = text.strip(), UTC, timedelta()
    if (match := AM_PM.fullmatch(date_text)) is not None:
        date_text, hours = match[1], int(re.search(r"(\d+):", match[1])[1])
        shift = timedelta(hours=12 * ((match[2] in "Pp") - (hours == 12)))
    elif (match := ZONE_SUFFIX.match(date_text)) is not None and match[2] in ZONE_OFFSETS:
        date_text, zone = match[1].strip(), timezone(timedelta(hours=ZONE_OFFSETS[match[2]]))
    elif match is not None:
        date_text = match[1].strip()
        try:
            zone = ZoneInfo(match[2])
        except (ZoneInfoNotFoundError, ValueError, OSError):
            raise ValueError(f"zone {match[2]}") from None
    iso_text = NUMERIC_DATE.sub(lambda found: _iso_date(found, order), date_text, count=1)
    moment = _parse_datetime(iso_text) + shift
    return (moment if moment.tzinfo else moment.replace(tzinfo=zone, fold=fold)).timestamp()


def dates_in_order(order: str = "") -> Callable[[str], float]:
    """Make a reader of increasing dates, which resolves the repeated hour in autumn.

    Examples
    --------
    >>> read = dates_in_order()
    >>> hours = [f"2024-10-27 {h}:30:00 Europe/Berlin" for h in ("01", "02", "02", "03")]
    >>> [(read(hour) - 1729985400) / 3600 for hour in hours]
    [0.0, 1.0, 2.0, 3.0]

    Times of day without a date continue past midnight.

    >>> read = dates_in_order()
    >>> [read(clock) / 3600 for clock in ("22:00", "23:00:00", "01:00:00.0")]
    [22.0, 23.0, 25.0]
    """
    latest = -math.inf

    def read(text: str) -> float:
        nonlocal latest
        if (clock := TIME_OF_DAY.fullmatch(str(text).strip())) is not None:
            if latest == -math.inf and HOUR_OR_MINUTE.fullmatch(clock[0]):
                raise ValueError("hours and minutes, or minutes and seconds")
            time = _time_of_day(*clock.groups(default="0"))
            time += DAY * (max(latest - time, 0.0) // DAY)
            time += DAY if time < latest - DAY / 2 else 0.0
        elif (time := unix_time(text, order=order)) <= latest:
            later = unix_time(text, fold=1, order=order)
            time = later if latest < later else time
        latest = max(latest, time)
        return time

    return read


def _time_of_day(hours: str, minutes: str, seconds: str) -> float:
    """Seconds since midnight; ValueError if it is no time of day."""
    fields = int(hours), int(minutes), float(seconds.replace(",", "."))
    if fields[0] > 23 or fields[1] > 59 or fields[2] >= 61:
        raise ValueError("no time of day")
    return 3600.0 * fields[0] + 60.0 * fields[1] + fields[2]


def _iso_date(found: re.Match[str], order: str) -> str:
    """Convert a numeric date to ISO 8601; ValueError if day and month are ambiguous."""
    first, _, second, year = found.groups()
    day_first = order == DAY_FIRST if order else int(first) > 12
    day, month = (first, second) if day_first else (second, first)
    if int(day) <= 12 and not order:
        raise ValueError(f"{found[0]} may be two days")
    return f"{year}-{int(month):02d}-{int(day):02d}"


def _parse_datetime(text: str) -> datetime:
    """Parse a date and time, in ISO 8601 or one of `TIME_FORMATS`."""
    try:
        return datetime.fromisoformat(text)
    except ValueError:
        fraction = FRACTION.search(text)
        without_fraction = text[: fraction.start()] if fraction else text
        microsecond = round(1e6 * float(f"0.{fraction[1]}")) if fraction else 0
        for pattern in TIME_FORMATS:
            try:
                moment = datetime.strptime(without_fraction, pattern)
            except ValueError:
                continue
            return moment.replace(microsecond=min(microsecond, 999_999))
        raise


# Smallest size of a file for the fast reader, and size of its blocks, in bytes.
MIN_FAST_BYTES, BLOCK_BYTES = 1_000_000, 1 << 23
# Bytes of numbers and separators.
NUMERIC_BYTES = b"0123456789+-.eE,;\t \r\n"


def numeric_rows(
    path: str | PathLike[str], first: int, separator: str, columns: int, max_rows: int
) -> np.ndarray | None:
    """Read the rows of a large file quickly if they hold only finite numbers.

    Parameters
    ----------
    path : str or path
        A text file.
    first : int
        Line of the first row.
    separator : str
        Separator of cells; a blank stands for any number of blanks.
    columns : int
        Number of columns.
    max_rows : int
        Largest number of rows.

    Returns
    -------
    array, shape (columns, n), or None
        The values. None if the file is small or has any other row: it is then read line by line,
        which finds the error.

    Raises
    ------
    InputError
        If there are more than ``max_rows``.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> file = pathlib.Path(tempfile.mkdtemp()) / "a.csv"
    >>> _ = file.write_text("s,mA\\n" + "1.0,2.0\\n" * 200_000)
    >>> numeric_rows(file, 2, ",", 2, 10**6).shape
    (2, 200000)
    """
    if os.path.getsize(path) < MIN_FAST_BYTES:
        return None
    sha256, parts, count = hashlib.sha256(), [], 0
    with open(path, "rb") as stream:
        for _ in range(first - 1):
            sha256.update(stream.readline())
        while lines := stream.readlines(BLOCK_BYTES):
            block = b"".join(lines)
            sha256.update(block)
            if block.translate(None, NUMERIC_BYTES) or block.count(b"\r") != block.count(b"\r\n"):
                return None
            text = block.decode("ascii").splitlines()
            delimiter = None if separator == " " else separator
            try:
                rows = np.loadtxt(text, delimiter=delimiter, comments=None, ndmin=2)
            except ValueError:
                return None
            if rows.shape != (len(lines), columns) or not np.isfinite(rows).all():
                return None
            parts.append(rows.T)
            count += len(lines)
            check_length(count, max_rows, path, first + max_rows)
    remember_digest(path, sha256)
    return np.concatenate(parts, axis=1)


def check_length(
    rows: int,
    max_rows: int,
    path: str | PathLike[str] | None = None,
    line: int | None = None,
    column: str | None = None,
) -> None:
    """Raise if there are too many rows."""
    if rows > max_rows:
        expected = "fewer: average what is repeated, or cut the file"
        raise InputError(f"more than {max_rows} rows", expected, path, line, column)


# Number with a decimal comma, also with thousands separators; its translation.
WITH_COMMA = re.compile(r"[-+]?(\d+|\d{1,3}(?:[.'’\xa0\u202f]\d{3})+),\d+([eEdD][-+]?\d+)?")
TO_POINT = str.maketrans({",": "."} | dict.fromkeys(".'’\xa0\u202f"))
# Number whose comma may separate thousands. Between semicolons it is decimal: spreadsheets use them
# only with decimal commas, but tabs always.
THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2},\d{3}")
# Smallest number of cells with decimal commas: fewer may be slips.
MIN_COMMAS = 3


def convert_decimal_commas(
    rows: Sequence[Sequence[str]], separator: str
) -> tuple[Sequence[Sequence[str]], tuple[str, ...]]:
    """Convert decimal commas to points, if all numbers of a table have commas.

    Parameters
    ----------
    rows : sequence of sequences of str
        The cells.
    separator : str
        Separator of cells. Commas can be decimal only between semicolons or tabs.

    Returns
    -------
    tuple
        The rows, and a note if they were converted. They are not if a number has a point, or if
        every comma may separate thousands.

    Examples
    --------
    >>> convert_decimal_commas([["0,5", "1"], ["1,5", "2"], ["2,5", "3"]], ";")[0]
    [['0.5', '1'], ['1.5', '2'], ['2.5', '3']]
    """
    first_cells = itertools.chain.from_iterable(rows[:MIN_COMMAS])
    if separator not in (";", "\t") or not any("," in c for c in first_cells):
        return rows, ()
    commas = [c for row in rows for c in row if WITH_COMMA.fullmatch(c)]
    has_points = any("." in c and is_number(c) for row in rows for c in row)
    ambiguous = separator == "\t" and all(map(THOUSANDS.fullmatch, commas))
    if len(commas) < MIN_COMMAS or has_points or ambiguous:
        return rows, ()
    converted = [
        [c.translate(TO_POINT) if WITH_COMMA.fullmatch(c) else c for c in row] for row in rows
    ]
    return converted, (
        f"Numbers have a decimal comma: '{commas[0]}' is {commas[0].translate(TO_POINT)}.",
    )
