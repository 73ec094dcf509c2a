"""Read decay records and lifetime tables, also from control-system archives."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
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
from beamfit.io.scan import ERROR_WORDS, PERCENT, is_size
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

EXAMPLE_HEADER = "time_s,beam_current_mA"
# Columns of a lifetime table without their unit, and the kind of unit.
LIFETIME_QUANTITIES = {
    "tau": "time",
    "tau_error": "time or share",
    "lifetime": "time",
    "lifetime_error": "time or share",
    "beam_current": "current",
}
INCREASING_TIMES = "times that increase"
# A time above this many seconds is Unix time (1973 or later), not time since the start of a record.
UNIX_TIME = 1e8
# Latest plausible Unix time, s (in 2049): later times have another origin.
MAX_UNIX_TIME = 2.5e9
# Times above this many seconds (after the year 5000) are in ms or smaller units.
MILLISECOND_TIME = 1e11
# Julian days of the years 1858 to 3501, in s.
JULIAN_RANGE = (2.4e6 * DAY, 3e6 * DAY)
# Columns of a decay record without their unit, and the kind of unit.
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
# Names in `DecayRecord` of columns that are named otherwise.
RECORD_NAMES = {"beam_current": "current", "beam_current_error": "error"}
RECORD_KEYS = {"time", "nanos", "current", "error", *Conditions._fields}
# Headers of columns of dates.
DATE_HEADERS = {
    "time", "timestamp", "time_stamp", "datetime", "date_time", "date/time", "data_time", "date",
}  # fmt: skip
# Time zone at the end of such a header.
UTC_SUFFIX = re.compile(r"[ _]?[\[(]?(utc|gmt)[\])]?$")
TIME_OF_DAY = re.compile(r"\d{1,2}:\d{2}(:\d{2}([.,]\d*)?)?( ?[AaPp][Mm])?")
# Names of times with a unit, besides time: epoch_s.
TIME_NAMES = {"t", "timestamp", "time_stamp", "epoch", "elapsed", "elapsed_time", "unix_time"}
# Columns of an archive: Unix seconds, nanoseconds, and attributes of values that are not used.
SECOND_HEADERS = {"secs", "seconds", "epochseconds", "epoch"}
NANOSECOND_HEADERS = {"nanos", "nanoseconds"}
UNUSED_HEADERS = {"severity", "status", "val", "value", "index", "no", "no.", "nr", "row"}
# Words that mark a header with a unit of current as the beam current: "current" only alone or with
# words for the ring (it may be a magnet's or a pump's), a monitor's name with any other words, and
# neither together with `OTHER_WORDS`.
MONITOR_WORDS = {"ibeam", "dcct", "pct", "bct", "stored"}
CURRENT_WORDS = MONITOR_WORDS | {"current", "i"}
RING_WORDS = {"sr", "ring", "ler", "her", "total", "average", "mean", "beam", "storage"}
OTHER_WORDS = {"error", "err", "std", "sd", "sigma", "rms", "set", "setpoint", "target", "nominal"}
OTHER_WORDS |= {"bunch", "injected", "log"}
# A lifetime column of a decay record, which is not used.
LIFETIME_HEADER = re.compile(r"(.*[\W_])?(life_?time|tau)([\W_].*)?", re.IGNORECASE)


def read_lifetime_input(
    path: str | PathLike[str] | DataFrame,
    *,
    columns: Columns = None,
    ignore: Iterable[str] = (),
    skip_bad: bool = False,
    offset: str | None = None,
) -> DecayRecord | LifetimeTable:
    """Read a decay record or a lifetime table, whichever the header is of."""
    sheet = read_columns(path, EXAMPLE_HEADER, columns, ignore, skip_bad)
    headers = [standard_header(name).lower() for name in sheet.names]
    has_lifetimes = any(header.startswith(("tau_", "lifetime_")) for header in headers)
    has_times = any((c := record_column(sheet, name)) and c.key == "time" for name in sheet.names)
    if has_lifetimes and not has_times:
        return _lifetime_table(sheet)
    return _make_record(sheet, offset)


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
        A frame, CSV or HDF5 with `tau_h` (or `lifetime_h`; also _min, _s) and `beam_current_mA`
        (or another header of a current, as in a decay record); optionally `tau_error_h` or
        `tau_error_%`.
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
    return _lifetime_table(read_columns(path, EXAMPLE_HEADER, columns, ignore, skip_bad))


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
        Meaning of columns whose headers do not say it: ``{"PV 12": "beam_current_mA"}``, or any
        layout of `beamfit.io.columns.layout_of`. Other columns with unknown names are then ignored.
    ignore : iterable of str, optional
        Columns to leave unread; * and ? are wildcards.
    skip_bad : bool, optional
        Leave out rows that cannot be used: no number, a negative current, a time that is repeated
        or goes back. `notes` counts and names them.
    offset : str, optional
        Reading of the monitor without beam, to be subtracted: a current such as ``0.12mA``, or
        ``zero-beam`` to take it from the readings without beam; its error is then part of
        `monitor`. Readings without beam are left out. The default is ``zero-beam`` if the monitor
        reads below zero without beam.

    Returns
    -------
    DecayRecord
        In s and mA, conditions in SI; `notes` names ignored columns.

    Raises
    ------
    InputError
        With file, line and column, if a column is unknown, doubled or missing, a cell is not a
        number, times do not increase, or a current is negative.

    Examples
    --------
    >>> print(read_decay_record("measurements/aps_1999_decay.csv"))
    aps_1999_decay.csv: 27 readings over 8.81 h, 101.999 to 81.464 mA
    """
    return _make_record(read_columns(path, EXAMPLE_HEADER, columns, ignore, skip_bad), offset)


def _make_record(sheet: Sheet, offset: str | None) -> DecayRecord:
    """Make a decay record from the columns of a sheet."""
    if any(map(is_size, sheet.names)) and not sheet.has_layout:
        expected = "a record of beam current; `beamfit emittance` reads scans"
        raise sheet.header_error("a column of beam sizes", expected)
    sheet = join_date_and_time(sheet)
    columns = record_columns(sheet)
    for quantity, example in (("time", "time_s"), ("current", "beam_current_mA")):
        if quantity not in columns:
            option = f"'{example}' in the header, or --columns 'HEADER={example}'"
            found = f"no column of {quantity} among {', '.join(sheet.names)}"
            raise sheet.header_error(found, option)
    notes = current_column_note(columns) + _lifetime_column_note(sheet, columns["time"])
    sheet = sheet.drop_bad_rows(lambda rows: [rows.values(column) for column in columns.values()])
    if sheet.skip_bad and offset is None:
        sheet, negative_notes = _drop_negative(sheet, columns["current"])
        notes += negative_notes
    time = _row_times(sheet, columns)
    if time.size > 2 and time[0] > time[-1] and np.all(np.diff(time) <= 0):
        notes += ("The rows stand newest first, and were read in order of time.",)
        sheet, time = sheet.take(list(range(len(sheet)))[::-1]), time[::-1]
    if sheet.skip_bad:
        sheet, time = _drop_backward(sheet, columns, time)
    values = {k: sheet.values(c) for k, c in columns.items() if k not in ("time", "nanos")}
    if len(time) < 2:
        raise InputError(f"{len(time)} readings", "two or more", sheet.path)
    _check_time_origin(sheet, columns["time"], time)
    baseline = offset_of(offset, values["current"], sheet.path)
    rows = np.flatnonzero(baseline.beam)
    time, values = time[rows], {key: column[rows] for key, column in values.items()}
    current, error = values.pop("current") - baseline.value, values.pop("error", None)
    conditions = Conditions(**values)
    if (fault := first_fault(time, current, error, conditions)) is not None:
        raise _fault_error(sheet, columns, fault, rows, np.median(current) < 0, baseline.value)
    absolute = time[0] > UNIX_TIME or (columns["time"].unit == DATE and time[0] > DAY)
    return DecayRecord(
        time=time,
        current=current,
        error=error,
        name=name_of(sheet.path),
        start=float(time[0]) if absolute else None,
        conditions=conditions,
        comments=sheet.comments,
        notes=notes + sheet_notes(sheet) + ignored_note(sheet, columns) + baseline.notes,
        monitor=Monitor(offset=baseline.error) if baseline.error else None,
    )


def _row_times(sheet: Sheet, columns: Mapping[str, Column]) -> np.ndarray:
    """Times of the rows, s."""
    time = sheet.values(columns["time"])
    return time + sheet.values(columns["nanos"]) if "nanos" in columns else time


def _time_error(sheet: Sheet, columns: Mapping[str, Column], row: int, last: object) -> InputError:
    """Error of a row whose time is not later than that of an earlier row."""
    column = columns["time"]
    found, expected = f"time {sheet[column.header][row]} after {last}", INCREASING_TIMES
    if column.unit == DATE:
        expected += "; local times that go back in autumn need their zone, such as Europe/Berlin"
    return sheet.error(found, expected, row, column.header)


def _fault_error(
    sheet: Sheet,
    columns: Mapping[str, Column],
    fault: Fault,
    rows: np.ndarray,
    negative: bool,
    offset: float,
) -> InputError:
    """Error of a fault of a record, at its row of the file."""
    column, row = columns[fault.quantity], int(rows[fault.row])
    if column.unit == DATE and fault.row:
        return _time_error(sheet, columns, row, sheet[column.header][int(rows[fault.row - 1])])
    expected = fault.expected
    sheet = sheet if fault.quantity == "time" else replace(sheet, row_hint="")
    if fault.quantity == "current" and negative:
        expected = "the other sign: most readings are negative"
        if offset > 0:
            expected = f"--offset below the readings: {offset:g} mA leaves most of them negative"
    return sheet.error(fault.found, expected, row, column.header)


def _drop_negative(sheet: Sheet, column: Column) -> tuple[Sheet, tuple[str, ...]]:
    """Drop negative readings; if there are many, note that the monitor has an offset."""
    values = sheet.values(column)
    negative = np.flatnonzero(values < 0)
    found = "a negative current, {:.6g} mA"
    errors = [
        sheet.error(found.format(values[k]), "zero or more", int(k), column.header)
        for k in negative
    ]
    if negative.size == values.size:
        raise errors[0]
    sheet = sheet.keep_rows(np.flatnonzero(values >= 0).tolist(), errors)
    if negative.size < MIN_DARK:
        return sheet, ()
    return sheet, (
        f"{negative.size} readings are below zero, {np.median(values[negative]):.3g} mA in the "
        "middle: what the monitor reads without beam is in the others too, and of noise about zero "
        "half is left. Take it off with --offset zero-beam instead.",
    )


def _drop_backward(
    sheet: Sheet, columns: Mapping[str, Column], time: np.ndarray
) -> tuple[Sheet, np.ndarray]:
    """Drop rows whose time is repeated or goes back."""
    latest_before = np.concatenate([[-np.inf], np.maximum.accumulate(time)[:-1]])
    keep = np.flatnonzero(time > latest_before)
    cells = sheet[columns["time"].header]
    last = keep[np.searchsorted(keep, np.arange(time.size)) - 1]
    backward = np.flatnonzero(time <= latest_before)
    errors = [_time_error(sheet, columns, int(k), cells[last[k]]) for k in backward]
    return sheet.keep_rows(keep.tolist(), errors), time[keep]


def _check_time_origin(sheet: Sheet, column: Column, time: np.ndarray) -> None:
    """Raise if times are of another origin or unit than supposed: after the year 2050."""
    if (latest := np.max(time)) <= MAX_UNIX_TIME:
        return
    written = latest / column.factor
    found = f"{written:.10g} {column.unit} since 1970, after the year 2050"
    expected = "a date, or time from the start of the record: LabVIEW counts seconds from 1904, "
    expected += "Excel days from 1899, MATLAB days from the year 0, Julian days from 4713 BC, "
    expected += "modified ones from 1858"
    julian = column.unit == "d" and JULIAN_RANGE[0] < np.min(time) and latest < JULIAN_RANGE[1]
    if latest >= MILLISECOND_TIME and not julian:
        found = f"{latest:.6g} s, after the year 5000"
        finer = (u for u in ("ms", "us") if UNITS["time"][u] * written < MILLISECOND_TIME)
        header = sheet.file_headers.get(column.header, column.header)
        expected = f"the unit of the time: --columns '{header}=time_{next(finer, 'ns')}'"
    raise replace(sheet, row_hint="").error(found, expected, int(np.argmax(time)), column.header)


def _lifetime_table(sheet: Sheet) -> LifetimeTable:
    """Make a lifetime table from the columns of a sheet."""
    columns = columns_of(sheet, LIFETIME_QUANTITIES, _table_reader(sheet))
    kinds = [kind for kind in ("tau", "lifetime") if kind in columns]
    if len(kinds) != 1 or "beam_current" not in columns:
        raise sheet.header_error(
            f"columns {', '.join(sheet.names)}", "lifetime and current: tau_h, beam_current_mA"
        )
    wanted = {"current": columns["beam_current"], "lifetime": columns[kinds[0]]}
    if (error := columns.get(f"{kinds[0]}_error")) is not None:
        wanted["error"] = error
    sheet = sheet.drop_bad_rows(
        lambda rows: [_positive_values(rows, column) for column in wanted.values()]
    )
    values = {key: _positive_values(sheet, column) for key, column in wanted.items()}
    if error is not None and error.unit == PERCENT:
        values["error"] = values["error"] * values["lifetime"]
    hours = {key: values[key] / 3600 for key in ("lifetime", "error") if key in values}
    notes = current_column_note(wanted) + sheet_notes(sheet)
    provenance = {"comments": sheet.comments, "notes": notes}
    return LifetimeTable(values["current"], **hours, name=name_of(sheet.path), **provenance)


def _table_reader(sheet: Sheet) -> Callable[[str], Column | None]:
    """Make a reader of headers outside `LIFETIME_QUANTITIES`: beam currents, and bare errors."""
    has_current, factors = _names_beam_current(sheet), UNITS["time or share"]
    # Two errors of one lifetime have one key, and are refused.
    is_tau = any(standard_header(name).lower().startswith("tau_") for name in sheet.names)

    def read_header(header: str) -> Column | None:
        name, _, unit = header.rpartition("_")
        if name.lower() in ERROR_WORDS and unit in factors:
            return Column(header, f"{'tau' if is_tau else 'lifetime'}_error", unit, factors[unit])
        return None if has_current else _current_column(header)

    return read_header


def _positive_values(sheet: Sheet, column: Column) -> np.ndarray:
    """Read a column of positive numbers."""
    values = sheet.values(column)
    found, written = f"{{:.6g}} {column.unit}", values / column.factor
    sheet.refuse(column.header, values <= 0, "above zero", found, written)
    return values


ZERO_BEAM = "zero-beam"
# Readings are without beam below this share of the 99 % quantile, if at least MIN_DARK are
# consecutive.
DARK_SHARE, MIN_DARK = 0.02, 5
# Readings without beam must scatter by less than this share of the 99 % quantile, or at least
# MIN_STEADY_SHARE of them must be within the outlier limit.
MAX_DARK_SCATTER, MIN_STEADY_SHARE = 2e-3, 0.9
# Readings without beam beyond this many robust standard deviations are dropped: the beam is being
# dumped.
OUTLIER_SIGMA = 5.0
# The error of the offset comes from the means of this many blocks, which allows for correlated
# noise.
BLOCKS = 10


class Offset(NamedTuple):
    """Offset of a monitor and its error in mA, and a mask of the readings with beam."""

    value: float
    error: float
    beam: np.ndarray
    notes: tuple[str, ...] = ()


def offset_of(
    option: str | None, current: np.ndarray, path: str | PathLike[str] | None = None
) -> Offset:
    """Determine the offset of a monitor.

    Parameters
    ----------
    option : str or None
        ``zero-beam``, or a current such as ``0.12mA`` or ``-30:uA``. None: no offset, and all
        readings are kept; but as ``zero-beam`` if readings without beam are below zero.
    current : array, shape (n,)
        Readings, mA.
    path : str or path, optional
        Their file, for messages.

    Returns
    -------
    Offset
        Readings are without beam below 2 % of the 99 % quantile, five or more in a row.

    Raises
    ------
    InputError
        If the option has another form, or there are no steady readings without beam.

    Examples
    --------
    >>> offset_of("zero-beam", np.r_[np.tile([0.1, 0.3], 10), np.full(50, 500.0)]).notes[0]
    '20 readings without beam give the offset of the monitor, 0.2 ± 0.023 mA, which is taken off.'
    """
    below, with_beam = current < 0, np.ones(current.size, bool)
    if option is None and not below.any():
        return Offset(0.0, 0.0, with_beam)
    full_current = float(np.percentile(current, 99))
    is_low = np.abs(current) < DARK_SHARE * full_current
    edges = np.flatnonzero(np.diff(np.r_[False, is_low, False].astype(int)))
    for first, end in zip(edges[::2], edges[1::2], strict=True):
        with_beam[first:end] = end - first < MIN_DARK
    if option is None and np.any(below & with_beam):
        return Offset(0.0, 0.0, np.ones(current.size, bool))
    if option in (None, ZERO_BEAM):
        value, error, count = _zero_beam_reading(current[~with_beam], full_current, path)
        note = (
            f"{count} readings without beam give the offset of the monitor, {value:.4g} ± "
            f"{error:.2g} mA, which is taken off."
        )
        return Offset(value, error, with_beam, (note,))
    if (value := _current_in_mA(option.replace(":", " ", 1))) is None:
        raise InputError(f"--offset {option}", f"{ZERO_BEAM}, or a current such as 0.12mA")
    return Offset(value, 0.0, with_beam, (f"The monitor's offset of {value:.4g} mA is taken off.",))


def _current_in_mA(text: str) -> float | None:
    """Current of a text such as ``0.12mA``, in mA; None if it is not one."""
    found = number_and_unit(text.strip())
    if found is None or found[1] not in UNITS["current"] or not is_number(found[0]):
        return None
    return number(found[0]) * UNITS["current"][found[1]]


def _zero_beam_reading(dark: np.ndarray, full_current: float, path) -> tuple[float, float, int]:
    """Mean and standard error of the readings without beam, and their number."""
    expected = "rows before injection or after the dump, or --offset with a current"
    if dark.size < MIN_DARK:
        raise InputError("no readings without beam", expected, path=path)
    deviation = np.abs(dark - np.median(dark))
    sigma = 1.4826 * float(np.median(deviation))
    steady = deviation <= OUTLIER_SIGMA * sigma
    if float(dark.std()) > MAX_DARK_SCATTER * full_current and steady.mean() < MIN_STEADY_SHARE:
        found = f"readings near zero that scatter by {dark.std():.3g} mA"
        raise InputError(found, expected, path=path)
    dark = dark[steady]
    means = [part.mean() for part in np.array_split(dark, min(BLOCKS, dark.size))]
    block_error = np.std(means, ddof=1) / np.sqrt(len(means))
    error = max(float(block_error), float(dark.std(ddof=1)) / np.sqrt(dark.size))
    return float(dark.mean()), error, dark.size


def monitor_of(drift: str | None, offset: str | None) -> Monitor | None:
    """Read the stability of a current monitor; None if neither drift nor offset is given.

    Parameters
    ----------
    drift : str or None
        A current per time, such as ``10uA/h``, in units of columns.
    offset : str or None
        A current, such as ``50uA``.

    Raises
    ------
    InputError
        If one has another form.

    Examples
    --------
    >>> print(monitor_of("0.24 mA/d", None))
    drifts by 10 µA/h
    """
    found = _stability("drift", drift, "10uA/h"), _stability("offset", offset, "50uA")
    return Monitor(*found) if any(found) else None


def _stability(name: str, text: str | None, example: str) -> float:
    """Current in mA, or in mA/h if the example has a time."""
    if text is None:
        return 0.0
    size, slash, per = text.partition("/")
    value, seconds = _current_in_mA(size), UNITS["time"].get(per.strip()) if slash else 3600.0
    if value is None or value < 0 or seconds is None or bool(slash) != ("/" in example):
        raise InputError(f"--monitor-{name} {text}", f"a stability such as {example}")
    return value * 3600 / seconds


def record_columns(sheet: Sheet) -> dict[str, Column]:
    """Map the headers of a record to quantities.

    Parameters
    ----------
    sheet : Sheet
        The file.

    Returns
    -------
    dict of str to Column
        Column of each quantity: ``time``, ``current``, ``error``, conditions.

    Raises
    ------
    InputError
        If a header is unknown, or two columns have the same quantity.

    Examples
    --------
    >>> sheet = Sheet("a.csv", ("Time", "DCCT [mA]"), [["12:00"], ["1"]], [2], 1, ())
    >>> {key: column.unit for key, column in record_columns(sheet).items()}
    {'time': 'a date', 'current': 'mA'}
    """
    found = columns_of(sheet, QUANTITIES, _header_reader(sheet))
    by_quantity = {RECORD_NAMES.get(key, key): column for key, column in found.items()}
    return {key: column for key, column in by_quantity.items() if key in RECORD_KEYS}


def record_column(sheet: Sheet, name: str) -> Column | None:
    """Column of a single header; None if it is unknown."""
    try:
        found = columns_of(sheet.select([name]), QUANTITIES, _header_reader(sheet))
        return next(iter(found.values()), None)
    except InputError:
        return None


def is_current(header: str) -> bool:
    """True if a header names a beam current.

    Examples
    --------
    >>> [is_current(name) for name in ("beam_current_mA", "I (A)", "Q2 current (A)", "SR:I")]
    [True, True, False, False]
    """
    name = standard_header(header)
    return name.lower().startswith("beam_current") or _current_column(name) is not None


def likely_record_name(header: str, cell: object) -> str | None:
    """Guess the record column that a header means, by its words and a cell; None without a guess.

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
        names_current = words & (CURRENT_WORDS | {"beam"}) and not words & OTHER_WORDS
        return f"beam_current_{unit}" if names_current and unit in UNITS["current"] else None
    return "time"


def join_date_and_time(sheet: Sheet) -> Sheet:
    """Join a column of days and one of times of day to one of dates.

    Examples
    --------
    >>> cells = [["2024-03-01"], ["12:00:05"], ["1"]]
    >>> join_date_and_time(Sheet("a.csv", ("Date", "Time", "I_mA"), cells, [2], 1, ()))["Time"]
    ['2024-03-01 12:00:05']
    """
    headers = {name.lower(): name for name in sheet.names}
    day, clock = headers.get("date", headers.get("day")), headers.get("time")
    if day is None or clock is None or not all(TIME_OF_DAY.fullmatch(str(c)) for c in sheet[clock]):
        return sheet
    joined = [f"{d} {c}" for d, c in zip(sheet[day], sheet[clock], strict=True)]
    names = tuple("Time" if name == clock else name for name in sheet.names if name != day)
    cells = [joined if name == clock else sheet[name] for name in sheet.names if name != day]
    return replace(sheet, names=names, cells=cells)


def current_column_note(columns: Mapping[str, Column]) -> tuple[str, ...]:
    """Note on the column taken for the beam current, if its header is ambiguous."""
    header = columns["current"].header
    unambiguous = standard_header(header).lower().startswith(("beam_current", "val"))
    return () if unambiguous else (f"Column '{header}' is taken for the beam current.",)


def _lifetime_column_note(sheet: Sheet, time: Column) -> tuple[str, ...]:
    """Note on columns of lifetimes in a decay record, which are not used."""
    names = [f"'{name}'" for name in sheet.names if LIFETIME_HEADER.fullmatch(name)]
    if not names:
        return ()
    unused = f"Columns {', '.join(names)} are" if len(names) > 1 else f"Column {names[0]} is"
    return (
        f"{unused} not used: the lifetime comes from the current against time. To fit it as a "
        f"table of lifetimes against current, leave out the time: --ignore '{time.header}'.",
    )


def _header_reader(sheet: Sheet):
    """Make a reader of headers outside `QUANTITIES`: of archives, dates, and beam currents.

    A beam current is guessed only if no header is named beam_current.
    """
    has_current = _names_beam_current(sheet)
    first = {UTC_SUFFIX.sub("", n.lower()): next(iter(sheet[n]), "") for n in sheet.names}
    # A column `time` has dates; one of another such name only if its first cell is no number.
    dates = {name for name in DATE_HEADERS & set(first) if not is_number(first[name])} | {"time"}

    def read_header(header: str) -> Column | None:
        lower, unit = header.lower(), header.removeprefix("val_")
        if UTC_SUFFIX.sub("", lower) in dates:
            return Column(header, "time", DATE)
        if lower in SECOND_HEADERS:
            return Column(header, "time", "s")
        if lower in NANOSECOND_HEADERS:
            return Column(header, "nanos", "ns", UNITS["time"]["ns"])
        name, _, ending = header.rpartition("_")
        if name.lower() in TIME_NAMES and ending in UNITS["time"]:
            return Column(header, "time", ending, UNITS["time"][ending])
        if unit != header and unit in UNITS["current"]:
            return Column(header, "current", unit, UNITS["current"][unit])
        if lower in UNUSED_HEADERS or LIFETIME_HEADER.fullmatch(header):
            return Column(header, header)
        return None if has_current else _current_column(header)

    return read_header


def _names_beam_current(sheet: Sheet) -> bool:
    return any(standard_header(n).lower().startswith("beam_current_") for n in sheet.names)


def _current_column(header: str) -> Column | None:
    """Beam current column of a header with a unit of current; None if the words are not its."""
    name, _, unit = header.rpartition("_")
    words = set(re.findall(r"[a-z]+", name.lower()))
    # Beside unknown words only a monitor's name counts: the current may be a magnet's.
    needed = MONITOR_WORDS if words - CURRENT_WORDS - RING_WORDS else CURRENT_WORDS | {"beam"}
    is_other = words & OTHER_WORDS or unit_at_end(name) in UNITS["current"]
    if unit not in UNITS["current"] or not words & needed or is_other:
        return None
    return Column(header, "beam_current", unit, UNITS["current"][unit])
