"""Decay records: what the columns of a file mean."""

from __future__ import annotations

from datetime import UTC, datetime
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from beamfit.io.table import Column, Sheet, columns_of, read_sheet
from beamfit.studies.decay.record import Conditions, DecayRecord, first_fault

if TYPE_CHECKING:
    from pandas import DataFrame

__all__ = ["read_decay_record"]

QUANTITIES = {
    "time": "time",
    "beam_current": "current",
    "beam_current_error": "current",
    "rf_voltage": "voltage",
    "scraper_y": "length",
    "pressure": "pressure",
    "bunches": "",
}
# What a record calls them.
CALLED = {"beam_current": "current", "beam_current_error": "error"}
ISO = "ISO 8601"
# Seconds beyond this many are counted from 1970, not from the start of a record (1973 or later).
UNIX = 1e8


def read_decay_record(path: str | PathLike[str] | DataFrame) -> DecayRecord:
    """Read beam current against time.

    Parameters
    ----------
    path : str, path or pandas.DataFrame
        A frame, CSV, or HDF5 if it ends in .h5 or .hdf5 with one dataset for each column. Columns:
        `time_s` (from any origin, or Unix time) or `time` (ISO 8601, UTC if no zone is given);
        `beam_current_mA` (or `_A`, `_uA`); optionally `beam_current_error_mA`, `rf_voltage_kV`,
        `scraper_y_mm`, `pressure_Pa`, `bunches`. Lines that begin with `#` and
        HDF5 attributes are kept as comments.

    Returns
    -------
    DecayRecord
        In s and mA, conditions in SI.

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
    sheet = read_sheet(path, "time_s,beam_current_mA")
    found = columns_of(sheet, QUANTITIES, _iso_time)
    columns = {CALLED.get(key, key): column for key, column in found.items()}
    for quantity, example in (("time", "time_s"), ("current", "beam_current_mA")):
        if quantity not in columns:
            raise sheet.header_error(f"no column of {quantity}", f"'{example}' in the header")
    values = {key: _values(sheet, column) for key, column in columns.items()}
    time, current, error = (values.pop(key, None) for key in ("time", "current", "error"))
    conditions = Conditions(**values)
    if len(time) < 2:
        raise sheet.error(f"{len(time)} readings", "two or more")
    if (fault := first_fault(time, current, error, conditions)) is not None:
        column = columns[fault.quantity].header
        raise sheet.error(fault.found, fault.expected, fault.row, column)
    absolute = columns["time"].unit == ISO or time[0] > UNIX
    return DecayRecord(
        time=time,
        current=current,
        error=error,
        name=Path(sheet.path).name,
        start=float(time[0]) if absolute else None,
        conditions=conditions,
        comments=sheet.comments,
    )


def _iso_time(header: str) -> Column | None:
    return Column(header, "time", ISO) if header == "time" else None


def _values(sheet: Sheet, column: Column) -> np.ndarray:
    if column.unit == ISO:
        return sheet.numbers(column.header, read=_seconds, expected="an ISO 8601 time")
    return sheet.numbers(column.header) * column.factor


def _seconds(cell: str) -> float:
    """Unix time of an ISO 8601 text; without a zone it is taken as UTC."""
    moment = datetime.fromisoformat(cell)
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
