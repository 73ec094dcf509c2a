"""Dates as control rooms write them."""

from __future__ import annotations

import re
from datetime import UTC, datetime
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

__all__ = ["unix_time"]

# Besides ISO 8601; days before months where both are numbers.
FORMS = ("%d-%b-%Y %H:%M:%S", "%d.%m.%Y %H:%M:%S", "%Y/%m/%d %H:%M:%S")
FRACTION = re.compile(r"[.,](\d+)$")
ZONE = re.compile(r"^(.*\d) ?([A-Z][A-Za-z_]+(?:/[A-Za-z_]+)*)$")


def unix_time(text: str) -> float:
    """Seconds since 1970 of a date: UTC unless an offset or the name of a zone stands behind it.

    Parameters
    ----------
    text : str
        ISO 8601, 01-Mar-2024 12:00:00.5, 01.03.2024 12:00:00 or 2024/03/01 12:00:00.

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
    return (moment if moment.tzinfo else moment.replace(tzinfo=zone)).timestamp()


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
