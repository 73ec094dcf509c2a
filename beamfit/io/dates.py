"""Dates as control rooms write them."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from datetime import UTC, datetime
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

# Besides ISO 8601; days before months where both are numbers.
FORMS = ("%d-%b-%Y %H:%M:%S", "%d.%m.%Y %H:%M:%S", "%Y/%m/%d %H:%M:%S")
FRACTION = re.compile(r"[.,](\d+)$")
ZONE = re.compile(r"^(.*\d) ?([A-Z][A-Za-z_]+(?:/[A-Za-z_]+)*)$")


def unix_time(text: str, *, fold: int = 0) -> float:
    """Seconds since 1970 of a date: UTC unless an offset or the name of a zone stands behind it.

    Parameters
    ----------
    text : str
        ISO 8601, 01-Mar-2024 12:00:00.5, 01.03.2024 12:00:00 or 2024/03/01 12:00:00.
    fold : int, optional
        1 for the second of two moments that a zone calls by one time in autumn.

    Raises
    ------
    ValueError
        If it is no date of these forms; 03/01/2024 is two.

    Examples
    --------
    >>> unix_time("1970-01-01T01:00:00+01:00"), unix_time("01.01.1970 01:00:00.5 Europe/Berlin")
    (0.0, 0.5)
    """
    whole, zone = text.strip(), UTC
    if (match := ZONE.match(whole)) is not None:
        whole = match[1].strip()
        try:
            zone = ZoneInfo(match[2])
        except (ZoneInfoNotFoundError, ValueError, OSError):
            raise ValueError(f"zone {match[2]}") from None
    moment = _moment(whole)
    return (moment if moment.tzinfo else moment.replace(tzinfo=zone, fold=fold)).timestamp()


def dates_in_order() -> Callable[[str], float]:
    """Make a `unix_time` for dates in order, which tell the second of two equal hours in autumn.

    Examples
    --------
    >>> read = dates_in_order()
    >>> hours = [f"2024-10-27 {h}:30:00 Europe/Berlin" for h in ("01", "02", "02", "03")]
    >>> [(read(hour) - 1729985400) / 3600 for hour in hours]
    [0.0, 1.0, 2.0, 3.0]
    """
    latest = -math.inf

    def read(text: str) -> float:
        nonlocal latest
        moment = unix_time(text)
        if moment <= latest < (second := unix_time(text, fold=1)):
            moment = second
        latest = max(latest, moment)
        return moment

    return read


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
