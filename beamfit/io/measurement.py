"""Quadrupole scans from CSV and HDF5 files (the column contract of docs/files.md)."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import replace
from os import PathLike
from pathlib import Path

import numpy as np

from beamfit.errors import InputError
from beamfit.io.averaging import average_shots
from beamfit.io.columns import (
    CARRIED,
    LENGTHS,
    MOST_ROWS,
    Column,
    Table,
    check_header,
    check_separator,
    column_of,
)
from beamfit.io.files import digest, text_lines
from beamfit.io.hdf5_table import read_hdf5
from beamfit.studies.scan.scans import QuadScan, first_unusable

__all__ = ["read_quad_scan"]

# Rms sizes on a screen; outside this a header's unit is wrong.
PLAUSIBLE = (1e-7, 2e-2)


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
    table = read_hdf5(path) if is_hdf5 else _read_csv(path)
    if not table.cells:
        raise InputError("a header and no rows", "at least three settings", path=path)
    return _scan_of(table)


def _read_csv(path: str | PathLike[str]) -> Table:
    provenance: list[str] = []
    numbered = enumerate(text_lines(path), start=1)
    rows = _rows(numbered, provenance, path)
    header = next(rows, None)
    if header is None:
        raise InputError("no header and no rows", "a header line such as Q2_A,size_x_um", path=path)
    line, names = header
    _check_is_header(names, path, line)
    table = Table(path, [column_of(name, path, line) for name in names], provenance=provenance)
    check_header(table, line)
    for line, cells in rows:
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
    return table


def _check_is_header(names: list[str], path: str | PathLike[str], line: int) -> None:
    """Recognise what is put in the place of a CSV header, and say what to do about it."""
    if names[0].startswith("format") and "beamfit-" in names[0]:
        raise InputError(
            "a lattice where the scan should be",
            "the scan first and the lattice after --lattice; are they swapped?",
            path=path,
            line=line,
        )
    check_separator(names, "size_", path, line)
    if all(_is_number(name) for name in names):
        raise InputError(
            "numbers where the header should be",
            "a header line such as Q2_A,size_x_um",
            path=path,
            line=line,
        )


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _rows(
    numbered: Iterator[tuple[int, str]], provenance: list[str], path: str | PathLike[str]
) -> Iterator[tuple[int, list[str]]]:
    """Yield cells with their line number; comments go to the provenance, blanks are skipped."""
    for number, line in numbered:
        text = line.strip()
        if text.startswith("#"):
            provenance.append(text.lstrip("# ").rstrip())
        elif text.strip(",;\t "):
            try:
                yield number, [cell.strip() for cell in next(csv.reader([line]))]
            except csv.Error:  # a carriage return within the line
                raise InputError(
                    "line ends that are carriage returns",
                    "line feeds: save the file as CSV (UTF-8) again",
                    path=path,
                    line=number,
                ) from None


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
    _check_optional(table, numbers, by_key)
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
            point = " with a decimal point" if "," in cell else ""
            raise table.error(found, f"a number{point}", row, column) from None
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
    middle, row = float(np.nanmedian(size)), int(np.nanargmax(size))
    if PLAUSIBLE[0] <= middle <= PLAUSIBLE[1]:
        if size[row] > PLAUSIBLE[1]:
            raise table.error(
                f"{size[row] / column.factor:g} {column.unit}, implausible for a beam",
                "sizes below 20 mm; is this row in another unit?",
                row,
                column,
            )
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
    with np.errstate(over="ignore"):
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


def _check_optional(table: Table, numbers: dict, by_key: dict) -> None:
    """Check the resolution, the energy spread and the screens, where they are given."""
    for key, most, expected in (
        ("resolution", PLAUSIBLE[1], "a resolution between 0 and 20 mm"),
        ("energy_spread", 0.2, "a relative spread between 0 and 0.2; is it in %?"),
    ):
        if key in numbers:
            wrong = (numbers[key] < 0) | (numbers[key] > most)
            if wrong.any():
                row, index = int(np.argmax(wrong)), by_key[key]
                found = f"'{table.cells[row][index]}'"
                raise table.error(found, expected, row, table.columns[index])
    if "screen" in by_key:
        index = by_key["screen"]
        for row, cells in enumerate(table.cells):
            if not cells[index]:
                expected = "the name of a screen of the lattice"
                raise table.error("an empty cell", expected, row, table.columns[index])
