"""Decay records from CSV and HDF5 files."""

from __future__ import annotations

import csv
from datetime import UTC, datetime
from pathlib import Path

import h5py
import numpy as np

from beamfit.errors import InputError, nearest
from beamfit.io.columns import check_separator
from beamfit.io.files import text_lines
from beamfit.studies.decay.record import Conditions, DecayRecord, first_fault

__all__ = ["read_decay_record"]

# column: (quantity, SI value, or mA, of one unit)
COLUMNS = {
    "time": ("time", 1.0),
    "time_s": ("time", 1.0),
    "beam_current_mA": ("current", 1.0),
    "beam_current_A": ("current", 1e3),
    "beam_current_error_mA": ("error", 1.0),
    "beam_current_error_A": ("error", 1e3),
    "rf_voltage_kV": ("rf_voltage", 1e3),
    "scraper_y_mm": ("scraper_y", 1e-3),
    "pressure_Pa": ("pressure", 1.0),
    "bunches": ("bunches", 1.0),
}
# Seconds beyond this many are counted from 1970, not from the start of a record (1973 or later).
UNIX = 1e8


def _seconds(cell: str) -> float:
    """Unix time of an ISO 8601 text; without a zone it is taken as UTC."""
    moment = datetime.fromisoformat(cell)
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


def _choose(names: list[str], path: Path, line: int | None) -> dict[str, str]:
    """Which column holds which quantity; no unknown, doubled or missing one."""
    check_separator(names, "time", path, line)
    chosen: dict[str, str] = {}
    for name in names:
        if name not in COLUMNS:
            known = nearest(name, list(COLUMNS))
            raise InputError("an unknown column", known, path=path, line=line, column=name)
        quantity = COLUMNS[name][0]
        if quantity in chosen:
            found = f"{quantity} also in column '{chosen[quantity]}'"
            expected = "one column for it, in one unit"
            raise InputError(found, expected, path=path, line=line, column=name)
        chosen[quantity] = name
    for quantity, example in (("time", "time_s"), ("current", "beam_current_mA")):
        if quantity not in chosen:
            found = f"no column of {quantity}"
            raise InputError(found, f"'{example}' in the header", path=path, line=line)
    return chosen


def _record(
    columns: dict[str, np.ndarray],
    chosen: dict[str, str],
    path: Path,
    lines: list[int] | None,
    comments: tuple[str, ...],
) -> DecayRecord:
    """Convert units, check, and say in the file's terms what is wrong."""
    scaled = {key: columns[name] * COLUMNS[name][1] for key, name in chosen.items()}
    time, current, error = (scaled.pop(key, None) for key in ("time", "current", "error"))
    conditions = Conditions(**scaled)
    rows = len(time)
    if rows < 2:
        raise InputError(f"{rows} readings", "two or more", path=path)
    fault = first_fault(time, current, error, conditions)
    if fault is not None:
        line = None if lines is None else lines[fault.row]
        found = fault.found if lines is not None else f"reading {fault.row + 1}: {fault.found}"
        column = chosen[fault.quantity]
        raise InputError(found, fault.expected, path=path, line=line, column=column)
    absolute = chosen["time"] == "time" or time[0] > UNIX
    return DecayRecord(
        time=time,
        current=current,
        error=error,
        name=path.name,
        start=float(time[0]) if absolute else None,
        conditions=conditions,
        comments=comments,
    )


def _number(cell: str, name: str) -> float:
    return _seconds(cell) if name == "time" else float(cell)


def _read_csv(path: Path) -> DecayRecord:
    text = list(text_lines(path))
    comments = tuple(line.lstrip("# ").rstrip() for line in text if line.startswith("#"))
    numbered = [(i, line) for i, line in enumerate(text, 1) if line.strip() and line[0] != "#"]
    if not numbered:
        raise InputError("no header", "'time_s,beam_current_mA' and readings", path=path)
    names = [name.strip() for name in next(csv.reader([numbered[0][1]]))]
    chosen = _choose(names, path, numbered[0][0])
    values = np.empty((len(numbered) - 1, len(names)))
    for row, (line, cells) in enumerate(
        zip((i for i, _ in numbered[1:]), csv.reader(raw for _, raw in numbered[1:]), strict=True)
    ):
        if len(cells) != len(names):
            found = f"{len(cells)} cells"
            raise InputError(found, f"{len(names)}, as in the header", path=path, line=line)
        for place, (cell, name) in enumerate(zip(cells, names, strict=True)):
            try:
                values[row, place] = _number(cell.strip(), name)
            except ValueError:
                expected = "an ISO 8601 time" if name == "time" else "a number"
                found = repr(cell.strip()) if cell.strip() else "an empty cell"
                raise InputError(found, expected, path=path, line=line, column=name) from None
    columns = dict(zip(names, values.T, strict=True))
    return _record(columns, chosen, path, [i for i, _ in numbered[1:]], comments)


def _dataset(name: str, data: np.ndarray, path: Path) -> np.ndarray:
    """One column of an HDF5 file as numbers."""
    if data.ndim != 1:
        raise InputError(f"shape {data.shape}", "one dimension", path=path, column=name)
    try:
        if name == "time":
            cells = [cell.decode() if isinstance(cell, bytes) else str(cell) for cell in data]
            return np.array([_seconds(cell) for cell in cells])
        return data.astype(float)
    except ValueError as error:
        raise InputError(
            str(error), "numbers, or ISO 8601 times", path=path, column=name
        ) from error


def _read_hdf5(path: Path) -> DecayRecord:
    try:
        with h5py.File(path) as file:
            data = {name: file[name][()] for name in file if isinstance(file[name], h5py.Dataset)}
            comments = tuple(f"{key} = {value}" for key, value in file.attrs.items())
    except OSError as error:
        raise InputError(str(error), "an HDF5 file", path=path) from error
    chosen = _choose(list(data), path, None)
    columns = {name: _dataset(name, np.asarray(values), path) for name, values in data.items()}
    rows = columns[chosen["time"]].size
    for name, values in columns.items():
        if values.size != rows:
            found = f"{values.size} readings"
            raise InputError(found, f"{rows}, as in '{chosen['time']}'", path=path, column=name)
    return _record(columns, chosen, path, None, comments)


def read_decay_record(path: str | Path) -> DecayRecord:
    """Read beam current against time.

    Parameters
    ----------
    path : str or path
        CSV, or HDF5 if it ends in .h5 or .hdf5 with one dataset for each column. Columns:
        `time_s` (from any origin, or Unix time) or `time` (ISO 8601, UTC if no zone is given);
        `beam_current_mA` or `beam_current_A`; optionally `beam_current_error_mA` (or `_A`),
        `rf_voltage_kV`, `scraper_y_mm`, `pressure_Pa`, `bunches`. Lines that begin with `#` and
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
    path = Path(path)
    return _read_hdf5(path) if path.suffix.lower() in (".h5", ".hdf5") else _read_csv(path)
