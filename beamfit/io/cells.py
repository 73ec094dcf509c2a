"""Cells of tables: numbers and dates as people write them, and a fast way through many."""

from __future__ import annotations

import hashlib
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
from beamfit.io.files import remember

# What programs write where there is no number.
BLANK = {"", "nan", "-nan", "na", "n/a", "n.a.", "#n/a", "<na>", "null", "none", "-", "--", "---"}
BLANK |= {"nan(ind)", "-nan(ind)", "1.#qnan", "-1.#ind", "1.#ind", "#num!", "#value!"}
# Thousands with something between them that can be nothing else, and an exponent of Fortran.
GROUPED = re.compile(r"[-+]?\d{1,3}(?:(?:,\d{3})+\.\d*|(?:['’\xa0\u202f]\d{3})+(?:\.\d*)?)")
BETWEEN = dict.fromkeys(map(ord, ",'’\xa0\u202f"))
FORTRAN = re.compile(r"([\d.])[dD]([-+]?\d+)$")


def number(cell: object) -> float:
    """The number of a cell, also as Fortran and spreadsheets write it where that means one thing.

    Raises
    ------
    ValueError
        If it is none: 5,125 could be 5125.

    Examples
    --------
    >>> [number(cell) for cell in ("5.125D-04", "−5", "5,125.0", "5'125")]
    [0.0005125, -5.0, 5125.0, 5125.0]
    """
    if isinstance(cell, str) and "_" in cell:  # which Python takes for nothing between digits
        raise ValueError("an underscore")
    try:
        return float(cell)
    except ValueError:
        text = cell.replace("−", "-")
        text = text.translate(BETWEEN) if GROUPED.fullmatch(text) else text
        return float(FORTRAN.sub(r"\1e\2", text))


def is_number(text: object) -> bool:
    """Tell a cell that is a number."""
    try:
        number(text)
    except ValueError:
        return False
    return True


def numbers_of(
    cells: Sequence[object], read: Callable[[Any], float] = number, blank: bool = False
) -> tuple[np.ndarray, int | None]:
    """Read cells up to the first that is no finite number, and say which that is.

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


# Seconds.
DAY = 86400.0
# Orders of dates in which day and month are numbers.
DAY_FIRST, MONTH_FIRST = "day-month-year", "month-day-year"
# Besides ISO 8601; days before months where both are numbers.
DAYS = (
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
FORMS = tuple(f"{day} {clock}" for day in DAYS for clock in ("%H:%M:%S", "%H:%M"))
FORMS += ("%a %b %d %H:%M:%S %Y",)
# A day and a month as numbers tell which is which where one of them is beyond 12.
NUMBERS = re.compile(r"(\d{1,2})([/-])(\d{1,2})\2(\d{4})\b")
NOON = re.compile(r"(.*\d) ?([AP])\.?M\.?", re.IGNORECASE)
# Zones by the letters that clocks show and no list of zones has; those that mean two are left out.
LETTERS = {"CEST": 2, "EEST": 3, "EDT": -4, "PDT": -7, "PST": -8, "JST": 9, "KST": 9}
CLOCK = re.compile(r"(\d{1,2}):(\d{2})(?::(\d{2}(?:[.,]\d*)?))?")
# What may be hours and minutes of a night, or minutes and seconds from a start.
HOUR_OR_MINUTE = re.compile(r"0?0:\d{2}")
FRACTION = re.compile(r"[.,](\d+)$")
ZONE = re.compile(r"^(.*\d) ?([A-Z][A-Za-z_]+(?:/[A-Za-z_]+)*)$")


def unix_time(text: str, *, fold: int = 0, order: str = "") -> float:
    """Seconds since 1970 of a date: UTC unless an offset or the name of a zone stands behind it.

    Parameters
    ----------
    text : str
        ISO 8601, 01-Mar-2024 12:00:00.5, 01.03.2024 12:00:00, 2024/03/01 12:00, 13/03/2024
        12:00:00, 03/13/2024 12:00:00 PM, Fri Mar 1 12:00:00 2024.
    fold : int, optional
        1 for the second of two moments that a zone calls by one time in autumn.
    order : {"", "day-month-year", "month-day-year"}
        Of a date of numbers that may be read both ways.

    Raises
    ------
    ValueError
        If it is no date of these forms; 03/01/2024 is two.

    Examples
    --------
    >>> unix_time("1970-01-01T01:00:00+01:00"), unix_time("01.01.1970 01:00:00.5 Europe/Berlin")
    (0.0, 0.5)
    """
    whole, zone, later = text.strip(), UTC, timedelta()
    if (match := NOON.fullmatch(whole)) is not None:
        whole, hours = match[1], int(re.search(r"(\d+):", match[1])[1])
        later = timedelta(hours=12 * ((match[2] in "Pp") - (hours == 12)))
    elif (match := ZONE.match(whole)) is not None and match[2] in LETTERS:
        whole, zone = match[1].strip(), timezone(timedelta(hours=LETTERS[match[2]]))
    elif match is not None:
        whole = match[1].strip()
        try:
            zone = ZoneInfo(match[2])
        except (ZoneInfoNotFoundError, ValueError, OSError):
            raise ValueError(f"zone {match[2]}") from None
    moment = _moment(NUMBERS.sub(lambda found: _in_order(found, order), whole, count=1)) + later
    return (moment if moment.tzinfo else moment.replace(tzinfo=zone, fold=fold)).timestamp()


def dates_in_order(order: str = "") -> Callable[[str], float]:
    """Make a `unix_time` for dates in order, which tell the second of two equal hours in autumn.

    Examples
    --------
    >>> read = dates_in_order()
    >>> hours = [f"2024-10-27 {h}:30:00 Europe/Berlin" for h in ("01", "02", "02", "03")]
    >>> [(read(hour) - 1729985400) / 3600 for hour in hours]
    [0.0, 1.0, 2.0, 3.0]

    Times of day without a date go on past midnight.

    >>> read = dates_in_order()
    >>> [read(clock) / 3600 for clock in ("22:00", "23:00:00", "01:00:00.0")]
    [22.0, 23.0, 25.0]
    """
    latest = -math.inf

    def read(text: str) -> float:
        nonlocal latest
        if (clock := CLOCK.fullmatch(str(text).strip())) is not None:
            if latest == -math.inf and HOUR_OR_MINUTE.fullmatch(clock[0]):
                raise ValueError("hours and minutes, or minutes and seconds")
            moment = _time_of_day(*clock.groups(default="0"))
            moment += DAY * (max(latest - moment, 0.0) // DAY)
            moment += DAY if moment < latest - DAY / 2 else 0.0
        elif (moment := unix_time(text, order=order)) <= latest:
            second = unix_time(text, fold=1, order=order)
            moment = second if latest < second else moment
        latest = max(latest, moment)
        return moment

    return read


def _time_of_day(hours: str, minutes: str, seconds: str) -> float:
    found = int(hours), int(minutes), float(seconds.replace(",", "."))
    if found[0] > 23 or found[1] > 59 or found[2] >= 61:
        raise ValueError("no time of day")
    return 3600.0 * found[0] + 60.0 * found[1] + found[2]


def _in_order(found: re.Match[str], order: str) -> str:
    """A date of numbers as ISO 8601 has it; ValueError where day and month could be exchanged."""
    first, _, second, year = found.groups()
    day_first = order == DAY_FIRST if order else int(first) > 12
    day, month = (first, second) if day_first else (second, first)
    if int(day) <= 12 and not order:
        raise ValueError(f"{found[0]} may be two days")
    return f"{year}-{int(month):02d}-{int(day):02d}"


def _moment(text: str) -> datetime:
    try:
        return datetime.fromisoformat(text)
    except ValueError:
        fraction = FRACTION.search(text)
        whole = text[: fraction.start()] if fraction else text
        part = round(1e6 * float(f"0.{fraction[1]}")) if fraction else 0
        for form in FORMS:
            try:
                moment = datetime.strptime(whole, form)
            except ValueError:
                continue
            return moment.replace(microsecond=min(part, 999_999))
        raise


# Bytes from which a file is worth it, and how many are read at a time.
LARGE, BLOCK = 1_000_000, 1 << 23
# What numbers and what stands between them are written with.
USUAL = b"0123456789+-.eE,;\t \r\n"


def numeric_rows(
    path: str | PathLike[str], first: int, separator: str, columns: int, most: int
) -> np.ndarray | None:
    """Read the rows of a large file that holds nothing but finite numbers from a line on.

    Parameters
    ----------
    path : str or path
        A text file.
    first : int
        Line of the first row.
    separator : str
        Between cells; a blank stands for any number of blanks.
    columns : int
        Cells of a row.
    most : int
        Most rows there may be.

    Returns
    -------
    array, shape (columns, n), or None
        The values. None if the file is small, or a line is anything but so many finite numbers:
        whoever reads line by line says which.

    Raises
    ------
    InputError
        If there are more rows.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> file = pathlib.Path(tempfile.mkdtemp()) / "a.csv"
    >>> _ = file.write_text("s,mA\\n" + "1.0,2.0\\n" * 200_000)
    >>> numeric_rows(file, 2, ",", 2, 10**6).shape
    (2, 200000)
    """
    if os.path.getsize(path) < LARGE:
        return None
    seen, parts, count = hashlib.sha256(), [], 0
    with open(path, "rb") as stream:
        for _ in range(first - 1):
            seen.update(stream.readline())
        while lines := stream.readlines(BLOCK):
            block = b"".join(lines)
            seen.update(block)
            if block.translate(None, USUAL) or block.count(b"\r") != block.count(b"\r\n"):
                return None
            text = block.decode("ascii").splitlines()
            between = None if separator == " " else separator
            try:
                rows = np.loadtxt(text, delimiter=between, comments=None, ndmin=2)
            except ValueError:
                return None
            if rows.shape != (len(lines), columns) or not np.isfinite(rows).all():
                return None
            parts.append(rows.T)
            count += len(lines)
            check_length(count, most, path, first + most)
    remember(path, seen)
    return np.concatenate(parts, axis=1)


def check_length(
    rows: int,
    most: int,
    path: str | PathLike[str] | None = None,
    line: int | None = None,
    column: str | None = None,
) -> None:
    """Refuse more rows than can be meant."""
    if rows > most:
        expected = "fewer: average what is repeated, or cut the file"
        raise InputError(f"more than {most} rows", expected, path, line, column)


COMMA = re.compile(r"[-+]?(\d+|\d{1,3}(?:[.'’\xa0\u202f]\d{3})+),\d+([eEdD][-+]?\d+)?")
POINTS = str.maketrans({",": "."} | dict.fromkeys(".'’\xa0\u202f"))
# What could also be thousands; a spreadsheet puts semicolons between cells only where the comma is
# the decimal one, but tabs everywhere.
THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2},\d{3}")
# With fewer such cells one of them may be a slip.
FEWEST = 3


def with_points(
    rows: Sequence[Sequence[str]], separator: str
) -> tuple[Sequence[Sequence[str]], tuple[str, ...]]:
    """Put points in the place of decimal commas, where all numbers of a table have those.

    Parameters
    ----------
    rows : sequence of sequences of str
        The cells.
    separator : str
        What stands between them: semicolons or tabs, or commas are never decimal ones.

    Returns
    -------
    tuple
        The rows, and a note that says so if they were changed. They are not where a number has a
        point, or where every comma could be one of thousands.

    Examples
    --------
    >>> with_points([["0,5", "1"], ["1,5", "2"], ["2,5", "3"]], ";")[0]
    [['0.5', '1'], ['1.5', '2'], ['2.5', '3']]
    """
    if separator not in (";", "\t") or not any("," in c for row in rows[:FEWEST] for c in row):
        return rows, ()
    commas = [cell for row in rows for cell in row if COMMA.fullmatch(cell)]
    points = any("." in cell and is_number(cell) for row in rows for cell in row)
    unclear = separator == "\t" and all(map(THOUSANDS.fullmatch, commas))
    if len(commas) < FEWEST or points or unclear:
        return rows, ()
    changed = [[c.translate(POINTS) if COMMA.fullmatch(c) else c for c in row] for row in rows]
    return changed, (
        f"Numbers have a decimal comma: '{commas[0]}' is {commas[0].translate(POINTS)}.",
    )
