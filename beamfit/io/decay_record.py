"""Decay records and tables of lifetimes: what the columns of a file mean, also of an archive's."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import replace
from os import PathLike
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from beamfit.errors import InputError
from beamfit.io.cells import DAY, DAY_FIRST, dates_in_order, is_number, number
from beamfit.io.columns import (
    DATE,
    UNITS,
    Column,
    Columns,
    Sheet,
    columns_of,
    ignored_note,
    number_and_unit,
    sheet_notes,
    standard_header,
    unit_at_end,
)
from beamfit.io.files import name_of
from beamfit.io.scan import is_size
from beamfit.io.table import read_columns
from beamfit.lifetime.record import (
    Conditions,
    DecayRecord,
    Fault,
    LifetimeTable,
    Monitor,
    first_fault,
)

if TYPE_CHECKING:
    from pandas import DataFrame

EXAMPLE = "time_s,beam_current_mA"
# Of a table of lifetimes.
LIFETIMES = {
    "tau": "time",
    "tau_error": "time",
    "lifetime": "time",
    "lifetime_error": "time",
    "beam_current": "current",
}
INCREASE = "times that increase"
# Seconds beyond this many are counted from 1970, not from the start of a record (1973 or later);
# beyond the others after 2050, of another origin, or after the year 5000, and are milliseconds.
UNIX, LATEST, MILLISECONDS = 1e8, 2.5e9, 1e11
# Julian days of the years 1858 to 3501, s.
JULIAN = (2.4e6 * DAY, 3e6 * DAY)
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
MOMENTS = {
    "time", "timestamp", "time_stamp", "datetime", "date_time", "date/time", "data_time", "date",
}  # fmt: skip
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


def read_lifetime_input(
    path: str | PathLike[str] | DataFrame,
    *,
    columns: Columns = None,
    ignore: Iterable[str] = (),
    skip_bad: bool = False,
    offset: str | None = None,
) -> DecayRecord | LifetimeTable:
    """Read what `beamfit lifetime` takes, by its header: as one of the other two readers."""
    sheet = read_columns(path, EXAMPLE, columns, ignore, skip_bad)
    lifetimes = any(
        standard_header(n).lower().startswith(("tau_", "lifetime_")) for n in sheet.names
    )
    moments = any((c := known(sheet, name)) and c.key == "time" for name in sheet.names)
    if lifetimes and not moments:
        return _lifetimes(sheet)
    return _record(sheet, offset)


def read_lifetimes(
    path: str | PathLike[str] | DataFrame,
    *,
    columns: Columns = None,
    ignore: Iterable[str] = (),
    skip_bad: bool = False,
) -> LifetimeTable:
    """Read lifetimes measured at several currents.

    Parameters
    ----------
    path : str, path or pandas.DataFrame
        A frame, CSV or HDF5 with `tau_h` (or `lifetime_h`; also _min, _s) and `beam_current_mA`;
        optionally `tau_error_h`.
    columns, ignore, skip_bad
        As for `read_decay_record`.

    Returns
    -------
    LifetimeTable

    Raises
    ------
    InputError
        With file, line and column, as `read_decay_record`.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> file = pathlib.Path(tempfile.mkdtemp()) / "lifetimes.csv"
    >>> _ = file.write_text("beam_current_mA,tau_h\\n100,50\\n200,33\\n300,25\\n400,20\\n")
    >>> print(read_lifetimes(file))
    lifetimes.csv: 4 lifetimes at 100 to 400 mA
    """
    return _lifetimes(read_columns(path, EXAMPLE, columns, ignore, skip_bad))


def read_decay_record(
    path: str | PathLike[str] | DataFrame,
    *,
    columns: Columns = None,
    ignore: Iterable[str] = (),
    skip_bad: bool = False,
    offset: str | None = None,
) -> DecayRecord:
    """Read beam current against time.

    Parameters
    ----------
    path : str, path or pandas.DataFrame
        A frame, CSV, or HDF5 if it ends in .h5 or .hdf5 with one dataset for each column, or JSON
        or CSV of the EPICS Archiver Appliance. Columns: `time_s` (_min, _h, _d, _ms; from any
        origin, or Unix time), or `time` (dates as `beamfit.io.cells.unix_time` reads them);
        `beam_current_mA` (or `_A`, `_uA`); optionally `beam_current_error_mA`, `rf_voltage_kV`,
        `scraper_y_mm`, `pressure_Pa` (_mbar, _Torr), `bunches`, `bunch_length_mm` (_ps).
        Lines that begin with `#` and HDF5 attributes are kept as comments.
    columns : str, path, mapping or Layout, optional
        What columns are whose headers do not say it: ``{"PV 12": "beam_current_mA"}``, or as
        `beamfit.io.columns.layout_of` reads it. Other columns of unknown names are ignored.
    ignore : iterable of str, optional
        Columns to leave unread; * and ? stand for any letters.
    skip_bad : bool, optional
        Leave out rows with something wrong in them: no number, a negative current, a time that is
        repeated or goes back. `notes` counts and names them.
    offset : str, optional
        What the monitor reads without beam and is taken off: a current such as ``0.12mA``, or
        ``zero-beam``, from readings of no beam; its error is then part of `monitor`. Readings of
        no beam are left out.

    Returns
    -------
    DecayRecord
        In s and mA, conditions in SI; `notes` names ignored columns.

    Raises
    ------
    InputError
        With file, line and column, if a column is unknown, doubled or missing, a cell is not a
        number, times do not increase, a current is negative, or units are mixed.

    Examples
    --------
    >>> print(read_decay_record("measurements/aps_1999_decay.csv"))
    aps_1999_decay.csv: 27 readings over 8.81 h, 101.999 to 81.464 mA
    """
    return _record(read_columns(path, EXAMPLE, columns, ignore, skip_bad), offset)


def _record(sheet: Sheet, offset: str | None) -> DecayRecord:
    if any(map(is_size, sheet.names)) and not sheet.has_layout:
        found, expected = "a column of beam sizes", "a record of beam current; `beamfit emittance`"
        raise sheet.header_error(found, f"{expected} reads scans")
    sheet = dated(sheet)
    columns = record_columns(sheet)
    for quantity, example in (("time", "time_s"), ("current", "beam_current_mA")):
        if quantity not in columns:
            option = f"'{example}' in the header, or --columns 'HEADER={example}'"
            found = f"no column of {quantity} among {', '.join(sheet.names)}"
            raise sheet.header_error(found, option)
    notes = taken_for_current(columns)
    sheet = sheet.drop_bad_rows(lambda rows: [rows.values(column) for column in columns.values()])
    if sheet.skip_bad and offset is None:
        sheet, below = _not_negative(sheet, columns["current"])
        notes += below
    moment = _moments(sheet, columns)
    if moment.size > 2 and moment[0] > moment[-1] and np.all(np.diff(moment) <= 0):
        notes += ("The rows stand newest first, and were read in order of time.",)
        sheet, moment = sheet.take(list(range(len(sheet)))[::-1]), moment[::-1]
    if sheet.skip_bad:
        sheet, moment = _forward(sheet, columns, moment)
    rest = {key: column for key, column in columns.items() if key not in ("time", "nanos")}
    values = {key: sheet.values(column) for key, column in rest.items()}
    if len(moment) < 2:
        raise InputError(f"{len(moment)} readings", "two or more", sheet.path)
    _check_base(sheet, columns["time"], moment)
    found = offset_of(offset, values["current"], sheet.path)
    values["current"] = values["current"] - found.value
    moment, *rest = (column[found.beam] for column in (moment, *values.values()))
    values = dict(zip(values, rest, strict=True))
    beam, error = values.pop("current"), values.pop("error", None)
    conditions = Conditions(**values)
    if (fault := first_fault(moment, beam, error, conditions)) is not None:
        rows = np.flatnonzero(found.beam)
        raise _refused(sheet, columns, fault, rows, np.median(beam) < 0, found.value)
    absolute = moment[0] > UNIX or (columns["time"].unit == DATE and moment[0] > DAY)
    return DecayRecord(
        time=moment,
        current=beam,
        error=error,
        name=name_of(sheet.path),
        start=float(moment[0]) if absolute else None,
        conditions=conditions,
        comments=sheet.comments,
        notes=notes + sheet_notes(sheet) + ignored_note(sheet, columns) + found.notes,
        monitor=Monitor(offset=found.error) if found.error else None,
    )


def _moments(sheet: Sheet, columns: Mapping[str, Column]) -> np.ndarray:
    """Times of the rows, s."""
    moment = sheet.values(columns["time"])
    return moment + sheet.values(columns["nanos"]) if "nanos" in columns else moment


def _goes_back(sheet: Sheet, columns: Mapping[str, Column], row: int, latest: object) -> InputError:
    """Error of a row whose time is not after that of an earlier one."""
    column = columns["time"]
    found, expected = f"time {sheet[column.header][row]} after {latest}", INCREASE
    if column.unit == DATE:
        expected += "; local times that go back in autumn need their zone, such as Europe/Berlin"
    return sheet.error(found, expected, row, column.header)


def _refused(
    sheet: Sheet,
    columns: Mapping[str, Column],
    fault: Fault,
    rows: np.ndarray,
    negative: bool,
    offset: float,
) -> InputError:
    """Error of a record, at its row of the file."""
    column, row = columns[fault.quantity], int(rows[fault.row])
    if column.unit == DATE and fault.row:
        return _goes_back(sheet, columns, row, sheet[column.header][int(rows[fault.row - 1])])
    expected = fault.expected
    sheet = sheet if fault.quantity == "time" else replace(sheet, row_hint="")
    if fault.quantity == "current" and negative:
        expected = "the other sign: most readings are negative"
        if offset > 0:
            expected = f"--offset below the readings: {offset:g} mA leaves most of them negative"
    return sheet.error(fault.found, expected, row, column.header)


def _not_negative(sheet: Sheet, column: Column) -> tuple[Sheet, tuple[str, ...]]:
    """Leave out readings below zero, and say of many that an offset is in the others, too."""
    values = sheet.values(column)
    below = np.flatnonzero(values < 0)
    bad = [
        sheet.error(
            f"a negative current, {values[k]:.6g} mA", "zero or more", int(k), column.header
        )
        for k in below
    ]
    if below.size == values.size:
        raise bad[0]
    sheet = sheet.keep_rows(np.flatnonzero(values >= 0).tolist(), bad)
    if below.size < FEWEST:
        return sheet, ()
    return sheet, (
        f"{below.size} readings are below zero, {np.median(values[below]):.3g} mA in the middle: "
        "what the monitor reads without beam is in the others too, and of noise about zero half is "
        "left. Take it off with --offset zero-beam instead.",
    )


def _forward(
    sheet: Sheet, columns: Mapping[str, Column], moment: np.ndarray
) -> tuple[Sheet, np.ndarray]:
    """Leave out rows whose time is repeated or goes back."""
    late = np.concatenate([[-np.inf], np.maximum.accumulate(moment)[:-1]])
    keep = np.flatnonzero(moment > late)
    cells = sheet[columns["time"].header]
    last = keep[np.searchsorted(keep, np.arange(moment.size)) - 1]
    wrong = np.flatnonzero(moment <= late)
    bad = [_goes_back(sheet, columns, int(k), cells[last[k]]) for k in wrong]
    return sheet.keep_rows(keep.tolist(), bad), moment[keep]


def _check_base(sheet: Sheet, column: Column, moment: np.ndarray) -> None:
    if (latest := np.max(moment)) <= LATEST:
        return
    said = latest / column.factor
    found = f"{said:.10g} {column.unit} since 1970, after the year 2050"
    expected = "a date, or time from the start of the record: LabVIEW counts seconds from 1904, "
    expected += "Excel days from 1899, MATLAB days from the year 0, Julian days from 4713 BC, "
    expected += "modified ones from 1858"
    julian = column.unit == "d" and JULIAN[0] < np.min(moment) and latest < JULIAN[1]
    if latest >= MILLISECONDS and not julian:
        found = f"{latest:.6g} s, after the year 5000"
        finer = (u for u in ("ms", "us") if UNITS["time"][u] * said < MILLISECONDS)
        header = sheet.file_headers.get(column.header, column.header)
        expected = f"the unit of the time: --columns '{header}=time_{next(finer, 'ns')}'"
    raise replace(sheet, row_hint="").error(found, expected, int(np.argmax(moment)), column.header)


def _lifetimes(sheet: Sheet) -> LifetimeTable:
    columns = columns_of(sheet, LIFETIMES)
    kinds = [kind for kind in ("tau", "lifetime") if kind in columns]
    if len(kinds) != 1 or "beam_current" not in columns:
        raise sheet.header_error(
            f"columns {', '.join(sheet.names)}", "lifetime and current: tau_h, beam_current_mA"
        )
    wanted = {"current": columns["beam_current"], "lifetime": columns[kinds[0]]}
    if (error := columns.get(f"{kinds[0]}_error")) is not None:
        wanted["error"] = error
    sheet = sheet.drop_bad_rows(
        lambda rows: [_positive(rows, column) for column in wanted.values()]
    )
    values = {key: _positive(sheet, column) for key, column in wanted.items()}
    hours = {key: values[key] / 3600 for key in ("lifetime", "error") if key in values}
    said = {"comments": sheet.comments, "notes": sheet_notes(sheet)}
    return LifetimeTable(values["current"], **hours, name=name_of(sheet.path), **said)


def _positive(sheet: Sheet, column: Column) -> np.ndarray:
    values = sheet.values(column)
    found, written = f"{{:.6g}} {column.unit}", values / column.factor
    sheet.refuse(column.header, values <= 0, "above zero", found, written)
    return values


ZERO_BEAM = "zero-beam"
# Readings below this share of the largest are of no beam, if so many stand in a row. They scatter
# by less than the other share, or at least so many of them are no outliers.
NO_BEAM, FEWEST, STEADY, MOST = 0.02, 5, 2e-3, 0.9
# Robust standard deviations beyond which one of them does not count, as while the beam is dumped.
OUTLIER = 5.0
# Parts whose means tell the error, whatever the memory of the noise.
PARTS = 10


class Offset(NamedTuple):
    """Reading of a monitor without beam, its error in mA, and which readings are of the beam."""

    value: float
    error: float
    beam: np.ndarray
    notes: tuple[str, ...] = ()


def offset_of(
    said: str | None, current: np.ndarray, path: str | PathLike[str] | None = None
) -> Offset:
    """Find the offset of a monitor.

    Parameters
    ----------
    said : str or None
        ``zero-beam``, or a current such as ``0.12mA`` or ``-30:uA``. None: no offset, and all
        readings are taken.
    current : array, shape (n,)
        Readings, mA.
    path : str or path, optional
        Their file, for messages.

    Returns
    -------
    Offset
        Readings of no beam are those below 2 % of the largest, five or more in a row.

    Raises
    ------
    InputError
        If it is neither, or no readings of no beam are there or they are not steady.

    Examples
    --------
    >>> offset_of("zero-beam", np.r_[np.tile([0.1, 0.3], 10), np.full(50, 500.0)]).notes[0]
    '20 readings without beam give the offset of the monitor, 0.2 ± 0.023 mA, which is taken off.'
    """
    beam = np.ones(current.size, bool)
    if said is None:
        return Offset(0.0, 0.0, beam)
    top = float(np.percentile(current, 99))
    low = np.abs(current) < NO_BEAM * top
    edges = np.flatnonzero(np.diff(np.r_[False, low, False].astype(int)))
    for first, end in zip(edges[::2], edges[1::2], strict=True):
        beam[first:end] = end - first < FEWEST
    if said == ZERO_BEAM:
        value, error, count = _without_beam(current[~beam], top, path)
        note = (
            f"{count} readings without beam give the offset of the monitor, {value:.4g} ± "
            f"{error:.2g} mA, which is taken off."
        )
        return Offset(value, error, beam, (note,))
    if (value := _amount(said.replace(":", " ", 1))) is None:
        raise InputError(f"--offset {said}", f"{ZERO_BEAM}, or a current such as 0.12mA")
    return Offset(value, 0.0, beam, (f"The monitor's offset of {value:.4g} mA is taken off.",))


def _amount(text: str) -> float | None:
    """A current in mA, from a number and its unit; None if it is none."""
    found = number_and_unit(text.strip())
    if found is None or found[1] not in UNITS["current"] or not is_number(found[0]):
        return None
    return number(found[0]) * UNITS["current"][found[1]]


def _without_beam(dark: np.ndarray, top: float, path) -> tuple[float, float, int]:
    """Mean, error and number of readings without beam."""
    expected = "rows before injection or after the dump, or --offset with a current"
    if dark.size < FEWEST:
        raise InputError("no readings without beam", expected, path=path)
    off = np.abs(dark - np.median(dark))
    spread = 1.4826 * float(np.median(off))
    steady = off <= OUTLIER * spread
    if float(dark.std()) > STEADY * top and steady.mean() < MOST:
        found = f"readings near zero that scatter by {dark.std():.3g} mA"
        raise InputError(found, expected, path=path)
    dark = dark[steady]
    means = [part.mean() for part in np.array_split(dark, min(PARTS, dark.size))]
    several = np.std(means, ddof=1) / np.sqrt(len(means))
    error = max(float(several), float(dark.std(ddof=1)) / np.sqrt(dark.size))
    return float(dark.mean()), error, dark.size


def monitor_of(drift: str | None, offset: str | None) -> Monitor | None:
    """Read the stability of a current monitor; None if nothing is said of it.

    Parameters
    ----------
    drift : str or None
        A current for each time, such as ``10uA/h``: units as in a file's columns.
    offset : str or None
        A current, such as ``50uA``.

    Raises
    ------
    InputError
        If one is not of that form.

    Examples
    --------
    >>> print(monitor_of("0.24 mA/d", None))
    drifts by 10 µA/h
    """
    found = _stability("drift", drift, "10uA/h"), _stability("offset", offset, "50uA")
    return Monitor(*found) if any(found) else None


def _stability(name: str, text: str | None, example: str) -> float:
    """A current in mA, or a current for each hour where the example has a time."""
    if text is None:
        return 0.0
    size, slash, per = text.partition("/")
    value, seconds = _amount(size), UNITS["time"].get(per.strip()) if slash else 3600.0
    if value is None or value < 0 or seconds is None or bool(slash) != ("/" in example):
        raise InputError(f"--monitor-{name} {text}", f"a stability such as {example}")
    return value * 3600 / seconds


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
    found = columns_of(sheet, QUANTITIES, _other(sheet))
    called = {CALLED.get(key, key): column for key, column in found.items()}
    return {key: column for key, column in called.items() if key in USED}


def known(sheet: Sheet, name: str) -> Column | None:
    """Meaning of a header by itself; None if it has none."""
    try:
        found = columns_of(sheet.select([name]), QUANTITIES, _other(sheet))
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
    said = standard_header(header)
    return said.lower().startswith("beam_current") or _current(said) is not None


def likely_record_name(header: str, cell: object) -> str | None:
    """The name that a header may mean, by a word in it or by a first cell that is a date.

    Examples
    --------
    >>> likely_record_name("When", "2024-03-01 12:00:00"), likely_record_name("Current", "0.2 A")
    ('time', 'beam_current_A')
    """
    try:
        dates_in_order(DAY_FIRST)(str(cell))
    except ValueError:
        words = set(re.findall(r"[a-z]+", header.lower()))
        _, unit = number_and_unit(str(cell)) or ("", "mA")
        named = words & (CURRENTS | {"beam"}) and not words & OTHERS
        return f"beam_current_{unit}" if named and unit in UNITS["current"] else None
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
    plain = standard_header(header).lower().startswith(("beam_current", "val"))
    return () if plain else (f"Column '{header}' is taken for the beam current.",)


def _other(sheet: Sheet):
    """Understand headers of archives, and looser ones of a current where none has its own."""
    strict = any(standard_header(name).lower().startswith("beam_current_") for name in sheet.names)
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
