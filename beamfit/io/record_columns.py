"""Columns of a record of beam current, also of an archive's and of a logger's."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace

from beamfit.errors import InputError
from beamfit.io.cells import DAY_FIRST, dates_in_order
from beamfit.io.columns import DATE, UNITS, Column, Sheet, columns_of
from beamfit.io.headers import is_number, spelled, unit_at_end
from beamfit.lifetime.record import Conditions

QUANTITIES = {
    "time": "time",
    "beam_current": "current",
    "beam_current_error": "current",
    "rf_voltage": "voltage",
    "scraper_y": "length",
    "pressure": "pressure",
    "bunches": "",
    "bunch_length": "length or duration",
}
# What a record calls them.
CALLED = {"beam_current": "current", "beam_current_error": "error"}
USED = {"time", "nanos", "current", "error", *Conditions._fields}
# What a column of dates is called, and those of a day and of the time of that day.
MOMENTS = {"time", "timestamp", "time_stamp", "datetime", "date_time", "data_time", "date"}
DAYS, CLOCKS = {"date", "day"}, {"time"}
# Behind its name: the zone that is meant where none stands.
UTC = re.compile(r"[ _]?[\[(]?(utc|gmt)[\])]?$")
CLOCK = re.compile(r"\d{1,2}:\d{2}(:\d{2}([.,]\d*)?)?( ?[AaPp][Mm])?")
# What a time with a unit is called besides time.
CLOCKED = {"t", "timestamp", "time_stamp", "epoch", "elapsed", "elapsed_time", "unix_time"}
# An archive's own columns: seconds since 1970 and nanoseconds, and what it says of each value.
SECONDS = {"secs": "s", "seconds": "s", "epochseconds": "s", "epoch": "s"}
NANOS = {"nanos", "nanoseconds"}
ASIDE = {"severity", "status", "val", "value", "index", "no", "no.", "nr", "row"}
# Words in a name with a unit of current that make it the beam's; in A, as magnets have, fewer do
# beside other words.
MONITORS = {"ibeam", "dcct", "pct", "bct", "stored"}
CURRENTS = MONITORS | {"current", "i"}
RINGS = {"sr", "ring", "ler", "her", "total", "average", "mean", "beam", "storage"}
OTHERS = {"error", "err", "std", "sd", "sigma", "rms", "set", "setpoint", "target", "nominal"}
OTHERS |= {"bunch", "injected", "log"}
# A lifetime beside the current, as archives have it, is not read.
LIFETIME = re.compile(r"(.*[\W_])?(life_?time|tau)([\W_].*)?", re.IGNORECASE)


def record_columns(sheet: Sheet) -> dict[str, Column]:
    """Every column of a record by what it is.

    Parameters
    ----------
    sheet : Sheet
        The file.

    Returns
    -------
    dict of str to Column
        By quantity: ``time``, ``current``, ``error``, conditions.

    Raises
    ------
    InputError
        If a header is unknown or a quantity stands twice.

    Examples
    --------
    >>> sheet = Sheet("a.csv", ("Time", "DCCT [mA]"), [["12:00"], ["1"]], [2], 1, ())
    >>> {key: column.unit for key, column in record_columns(sheet).items()}
    {'time': 'a date', 'current': 'mA'}
    """
    try:
        found = columns_of(sheet, QUANTITIES, _other(sheet))
    except InputError as error:
        more = f"; --columns '{error.column}=NAME' says what it is, --ignore leaves it unread"
        raise replace(error, expected=error.expected + more) from None
    called = {CALLED.get(key, key): column for key, column in found.items()}
    return {key: column for key, column in called.items() if key in USED}


def known(sheet: Sheet, name: str) -> Column | None:
    """Meaning of a header by itself; None if it has none."""
    try:
        found = columns_of(sheet.only([name]), QUANTITIES, _other(sheet))
        return next(iter(found.values()), None)
    except InputError:
        return None


def is_current(header: str) -> bool:
    """Tell a header that names a beam's current.

    Examples
    --------
    >>> [is_current(name) for name in ("beam_current_mA", "I (A)", "Q2 current (A)", "SR:I")]
    [True, True, False, False]
    """
    said = spelled(header)
    return said.lower().startswith("beam_current") or _current(said) is not None


def likely_record_name(header: str, cell: object) -> str | None:
    """The name that a header may mean, by a word in it or by a first cell that is a date.

    Examples
    --------
    >>> likely_record_name("When", "2024-03-01 12:00:00"), likely_record_name("Current", "200.1")
    ('time', 'beam_current_mA')
    """
    try:
        dates_in_order(DAY_FIRST)(str(cell))
    except ValueError:
        words = set(re.findall(r"[a-z]+", header.lower()))
        return "beam_current_mA" if words & (CURRENTS | {"beam"}) and not words & OTHERS else None
    return "time"


def dated(sheet: Sheet) -> Sheet:
    """One column of dates where days and times of day stand in two.

    Examples
    --------
    >>> cells = [["2024-03-01"], ["12:00:05"], ["1"]]
    >>> dated(Sheet("a.csv", ("Date", "Time", "I_mA"), cells, [2], 1, ()))["Time"]
    ['2024-03-01 12:00:05']
    """
    said = {name.lower(): name for name in sheet.names}
    day, clock = (next((said[n] for n in of if n in said), None) for of in (DAYS, CLOCKS))
    if day is None or clock is None or not all(CLOCK.fullmatch(str(c)) for c in sheet[clock]):
        return sheet
    both = [f"{d} {c}" for d, c in zip(sheet[day], sheet[clock], strict=True)]
    names = tuple("Time" if name == clock else name for name in sheet.names if name != day)
    cells = [both if name == clock else sheet[name] for name in sheet.names if name != day]
    return replace(sheet, names=names, cells=cells)


def taken_for_current(columns: Mapping[str, Column]) -> tuple[str, ...]:
    """Say which column was taken for the beam current, where its name leaves a choice."""
    header = columns["current"].header
    plain = spelled(header).lower().startswith(("beam_current", "val"))
    return () if plain else (f"Column '{header}' is taken for the beam current.",)


def _other(sheet: Sheet):
    """Understand headers of archives, and looser ones of a current where none has its own."""
    strict = any(spelled(name).lower().startswith("beam_current_") for name in sheet.names)
    first = {UTC.sub("", name.lower()): next(iter(sheet[name]), "") for name in sheet.names}
    # A number without a unit is no date, and is not to be taken for seconds.
    moments = {"time"} | {name for name in MOMENTS & set(first) if not is_number(first[name])}

    def understood(header: str) -> Column | None:
        word, unit = header.lower(), header.removeprefix("val_")
        if UTC.sub("", word) in moments:
            return Column(header, "time", DATE)
        if word in SECONDS:
            return Column(header, "time", "s")
        if word in NANOS:
            return Column(header, "nanos", "ns", UNITS["time"]["ns"])
        name, _, ending = header.rpartition("_")
        if name.lower() in CLOCKED and ending in UNITS["time"]:
            return Column(header, "time", ending, UNITS["time"][ending])
        if unit != header and unit in UNITS["current"]:
            return Column(header, "current", unit, UNITS["current"][unit])
        if word in ASIDE or LIFETIME.fullmatch(header):
            return Column(header, header)
        return None if strict else _current(header)

    return understood


def _current(header: str) -> Column | None:
    """A beam current by a word in its name and its unit."""
    name, _, unit = header.rpartition("_")
    words = set(re.findall(r"[a-z]+", name.lower()))
    # A monitor's name says it; a mere current may be a pump's, a bunch's or a magnet's.
    wanted = MONITORS if words - CURRENTS - RINGS else CURRENTS | {"beam"}
    other = words & OTHERS or unit_at_end(name) in UNITS["current"]
    if unit not in UNITS["current"] or not words & wanted or other:
        return None
    return Column(header, "beam_current", unit, UNITS["current"][unit])
