"""Quadrupole scans from CSV and HDF5 files (the column contract of docs/files.md)."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path

import numpy as np

from beamfit.errors import InputError, nearest
from beamfit.io.averaging import average_shots
from beamfit.io.files import digest, text_lines
from beamfit.studies.scans import QuadScan, first_unusable

__all__ = ["read_quad_scan"]

# More rows than any scan: such a file is a log, and is refused before it fills the memory.
MOST_ROWS = 100_000
LENGTHS = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "μm": 1e-6}
SETTINGS = ("A", "kG", "k1", "k1l")
CARRIED = re.compile(r"note_.*|time|timestamp|charge_[np]C")
SIZE = re.compile(r"(size_[xy](?:_error)?|resolution)_([^_]*)")
# Rms sizes on a screen; outside this a header's unit is wrong.
PLAUSIBLE = (1e-7, 2e-2)


@dataclass(frozen=True)
class Column:
    """What a header means: the quantity, the unit it is in, and the factor to SI."""

    header: str
    key: str
    unit: str = ""
    factor: float = 1.0


@dataclass
class Table:
    """The cells of a file before they are a scan: one list a column, and where each row was."""

    path: str | PathLike[str]
    columns: list[Column]
    cells: list[list[str]] = field(default_factory=list)
    lines: list[int] = field(default_factory=list)
    provenance: list[str] = field(default_factory=list)

    def error(self, found: str, expected: str, row: int | None, column: Column) -> InputError:
        """Make the error that names file, line and column."""
        line = None if row is None else self.lines[row]
        return InputError(found, expected, path=self.path, line=line, column=column.header)


def read_quad_scan(path: str | PathLike[str]) -> QuadScan:
    """Read a quadrupole scan.

    Parameters
    ----------
    path : str or path
        A CSV file whose header carries the units, or an HDF5 file (``.h5``, ``.hdf5``) with
        one dataset a column under the same names.

    Returns
    -------
    QuadScan
        Sizes in m. Repeated shots of a setting are averaged; their scatter becomes the error.

    Raises
    ------
    InputError
        If the file cannot be used, naming file, line and column.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> file = pathlib.Path(tempfile.mkdtemp()) / "scan.csv"
    >>> _ = file.write_text("Q2_A,size_x_um\\n0,200\\n1,120\\n2,180\\n")
    >>> read_quad_scan(file).rows("x").size.round(9).tolist()
    [0.0002, 0.00012, 0.00018]
    """
    is_hdf5 = Path(path).suffix.lower() in {".h5", ".hdf5"}
    table = _read_hdf5(path) if is_hdf5 else _read_csv(path)
    return _scan_of(table)


def _read_csv(path: str | PathLike[str]) -> Table:
    provenance: list[str] = []
    numbered = enumerate(text_lines(path), start=1)
    header = next(_rows(numbered, provenance), None)
    if header is None:
        raise InputError("no header and no rows", "a header line such as Q2_A,size_x_um", path=path)
    line, names = header
    table = Table(path, [_column(name, path, line) for name in names], provenance=provenance)
    _check_header(table, line)
    for line, cells in _rows(numbered, provenance):
        if len(cells) != len(names):
            raise InputError(
                f"{len(cells)} cells", f"{len(names)}, as in the header", path=path, line=line
            )
        if len(table.cells) == MOST_ROWS:
            raise InputError(
                f"more than {MOST_ROWS} rows",
                "a scan of settings; average the shots or cut the file",
                path=path,
                line=line,
            )
        table.cells.append(cells)
        table.lines.append(line)
    if not table.cells:
        raise InputError("a header and no rows", "at least three settings", path=path)
    return table


def _rows(
    numbered: Iterator[tuple[int, str]], provenance: list[str]
) -> Iterator[tuple[int, list[str]]]:
    """Yield cells with their line number; comments go to the provenance, blanks are skipped."""
    for number, line in numbered:
        text = line.strip()
        if text.startswith("#"):
            provenance.append(text.lstrip("# ").rstrip())
        elif text.strip(",;\t "):
            yield number, [cell.strip() for cell in next(csv.reader([line]))]


def _read_hdf5(path: str | PathLike[str]) -> Table:
    import h5py

    digest(path)  # says what is wrong with the path itself
    try:
        with h5py.File(path, "r") as store:
            names = [n for n in store if isinstance(store[n], h5py.Dataset)]
            if names and max(store[n].size for n in names) > MOST_ROWS:
                raise InputError(f"more than {MOST_ROWS} rows", "a scan of settings", path=path)
            data = [
                np.atleast_1d(store[n].asstr()[()] if store[n].dtype.kind in "OS" else store[n][()])
                for n in names
            ]
            provenance = [f"{key}: {value}" for key, value in store.attrs.items()]
    except OSError:
        raise InputError("a file that is not HDF5", "an HDF5 file", path=path) from None
    lengths = {n: len(d) for n, d in zip(names, data, strict=True)}
    if len(set(lengths.values())) > 1:
        raise InputError(f"datasets of lengths {lengths}", "one length for all", path=path)
    table = Table(path, [_column(n, path, None) for n in names], provenance=provenance)
    _check_header(table, None)
    table.cells = [[_text(v) for v in row] for row in zip(*data, strict=True)]
    table.lines = list(range(1, len(table.cells) + 1))
    return table


def _text(value: object) -> str:
    return value if isinstance(value, str) else repr(float(value))


def _column(header: str, path: str | PathLike[str], line: int | None) -> Column:
    """Understand one header, or say what it should have been."""
    if header in ("shot", "screen", "energy_MeV", "energy_spread") or CARRIED.fullmatch(header):
        return Column(header, header)
    if size := SIZE.fullmatch(header):
        key, unit = size.groups()
        if unit in LENGTHS:
            return Column(header, key, unit, LENGTHS[unit])
        known = "one of m, mm, um at the end, such as " + f"{key}_um"
        raise InputError(f"unknown unit '{unit}'", known, path=path, line=line, column=header)
    name, _, unit = header.rpartition("_")
    if name and unit in SETTINGS and not header.startswith("size_"):
        return Column(header, f"setting {name}", unit)
    raise InputError(
        f"unknown unit '{unit}'" if name else "a name without a unit",
        "a magnet with _A, _kG or _k1 at the end, "
        + nearest(
            header,
            [
                "size_x_um",
                "size_x_error_um",
                "size_y_um",
                "size_y_error_um",
                "resolution_um",
                "energy_MeV",
                "energy_spread",
                "shot",
                "screen",
            ],
        )
        + "; begin a name with note_ to carry a column along unread",
        path=path,
        line=line,
        column=header,
    )


def _check_header(table: Table, line: int | None) -> None:
    keys = [c.key for c in table.columns]
    twice = [c for c in table.columns if keys.count(c.key) > 1]
    if twice:
        raise InputError(
            "a column twice",
            "each quantity once",
            path=table.path,
            line=line,
            column=twice[0].header,
        )
    sizes = [k for k in keys if k in ("size_x", "size_y")]
    if not sizes or not any(k.startswith("setting ") for k in keys):
        missing = (
            "a beam size column, such as size_x_um"
            if not sizes
            else ("a magnet setting column, such as Q2_A, Q2_kG or Q2_k1")
        )
        found = "columns " + ", ".join(c.header for c in table.columns)
        raise InputError(found, missing, path=table.path, line=line)
    for plane in "xy":
        if f"size_{plane}_error" in keys and f"size_{plane}" not in keys:
            raise InputError(
                f"size_{plane}_error without size_{plane}",
                f"a column size_{plane}_um",
                path=table.path,
                line=line,
            )


def _scan_of(table: Table) -> QuadScan:
    """Turn checked cells into a scan in SI."""
    numbers = {
        c.key: _numbers(table, i, c)
        for i, c in enumerate(table.columns)
        if c.key not in ("screen", "shot") and not CARRIED.fullmatch(c.key)
    }
    by_key = {c.key: i for i, c in enumerate(table.columns)}
    for plane in "xy":
        _check_sizes(table, numbers, plane, by_key)
    _check_energy(table, numbers, by_key)
    settings = {k.removeprefix("setting "): k for k in numbers if k.startswith("setting ")}
    planes = [p for p in "xy" if f"size_{p}" in numbers]
    try:
        scan = QuadScan(
            settings={name: numbers[key] for name, key in settings.items()},
            units={n: table.columns[by_key[k]].unit for n, k in settings.items()},
            size={p: numbers[f"size_{p}"] for p in planes},
            error={p: numbers[f"size_{p}_error"] for p in planes if f"size_{p}_error" in numbers},
            energy=numbers.get("energy_MeV"),
            screen=tuple(r[by_key["screen"]] for r in table.cells) if "screen" in by_key else None,
            resolution=numbers.get("resolution"),
            energy_spread=numbers.get("energy_spread"),
            error_source="the file",
            name=Path(table.path).stem,
            path=table.path,
            sha256=digest(table.path),
            provenance=tuple(table.provenance),
            columns={n: table.columns[by_key[k]].header for n, k in settings.items()}
            | {c.key: c.header for c in table.columns},
        )
    except InputError as error:
        raise replace(error, path=table.path) from None
    return average_shots(scan, marked="shot" in by_key)


def _numbers(table: Table, index: int, column: Column) -> np.ndarray:
    """Read one column; a blank size or error is NaN, anything else must be a number."""
    may_be_blank = column.key.startswith("size_")
    values = np.empty(len(table.cells))
    for row, cells in enumerate(table.cells):
        cell = cells[index]
        try:
            values[row] = np.nan if may_be_blank and cell == "" else float(cell) * column.factor
        except ValueError:
            found = f"'{cell}'" if cell else "an empty cell"
            raise table.error(found, "a number", row, column) from None
        if cell and not np.isfinite(values[row]):
            raise table.error(f"'{cell}'", "a finite number", row, column)
    return values


def _check_sizes(table: Table, numbers: dict, plane: str, by_key: dict) -> None:
    for key, what in ((f"size_{plane}", "beam size"), (f"size_{plane}_error", "error")):
        if key in numbers:
            wrong = first_unusable(numbers[key], blank=True)
            if wrong:
                column = table.columns[by_key[key]]
                cell = table.cells[wrong[0]][by_key[key]]
                raise table.error(
                    f"'{cell}'", f"a positive {what} in {column.unit}", wrong[0], column
                )
    if f"size_{plane}" not in numbers:
        return
    size, column = numbers[f"size_{plane}"], table.columns[by_key[f"size_{plane}"]]
    if np.isnan(size).all():
        raise table.error("no number at all", f"sizes in {column.unit}", None, column)
    _check_plausible(table, size, column)
    if f"size_{plane}_error" in numbers:
        _check_errors(table, size, numbers[f"size_{plane}_error"], by_key, plane)


def _check_plausible(table: Table, size: np.ndarray, column: Column) -> None:
    """Recognise a header whose unit cannot be meant: sizes of metres or of atoms."""
    middle = float(np.nanmedian(size))
    if PLAUSIBLE[0] <= middle and float(np.nanmax(size)) <= PLAUSIBLE[1]:
        return
    written = middle / column.factor
    likely = min(("um", "mm", "m"), key=lambda u: abs(np.log(written * LENGTHS[u] / 2e-4)))
    raise table.error(
        f"sizes around {written:g} {column.unit}, implausible for a beam",
        f"sizes between 0.1 um and 20 mm; if these are {likely}, "
        f"rename the column {column.key}_{likely}",
        None,
        column,
    )


def _check_errors(
    table: Table, size: np.ndarray, error: np.ndarray, by_key: dict, plane: str
) -> None:
    column = table.columns[by_key[f"size_{plane}_error"]]
    missing = np.isnan(error) & ~np.isnan(size)
    if missing.any():
        row = int(np.argmax(missing))
        raise table.error("an empty cell", "an error for each size, or none at all", row, column)
    ratio = float(np.nanmedian(error / size))
    if not 1e-6 < ratio < 1.0:
        raise table.error(
            f"errors that are {ratio:g} of the sizes",
            "errors in the unit of the header",
            None,
            column,
        )


def _check_energy(table: Table, numbers: dict, by_key: dict) -> None:
    if "energy_MeV" not in numbers:
        return
    column, energy = table.columns[by_key["energy_MeV"]], numbers["energy_MeV"]
    wrong = (energy <= 0.511) | (energy > 1e7)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise table.error(
            f"{energy[row]:g} MeV",
            "a total energy between 0.511 MeV and 10 TeV; is it in GeV or eV?",
            row,
            column,
        )
