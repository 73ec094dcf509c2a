"""Dates as control rooms write them."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from datetime import UTC, datetime, timedelta, timezone
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

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
