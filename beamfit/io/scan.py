"""Quadrupole scans: what the columns of a file mean, and the numbers in them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from beamfit.emittance.scan import POSSIBLE, USUAL, Profile, QuadScan, middle, row_keys
from beamfit.errors import InputError, located
from beamfit.io.columns import (
    UNITS,
    Column,
    Sheet,
    left_aside,
    left_out,
)
from beamfit.io.emittance_gui import is_emittance_gui, read_emittance_gui
from beamfit.io.files import name_of
from beamfit.io.layout import Columns
from beamfit.io.scan_columns import (
    ENERGIES,
    PERCENT,
    SETTING,
    column_notes,
    comment_notes,
    is_scatter,
    scan_columns,
)
from beamfit.io.shots import IMAGE, average_shots, of_images, of_profiles
from beamfit.io.table import read_columns

if TYPE_CHECKING:
    from pandas import DataFrame

# More rows than any scan: such a file is a log, and is refused before it fills the memory.
MOST_ROWS = 100_000
# A size this many times the usual one of its column, and larger than most beams, has slipped.
SLIPPED = 100.0
# Relative: nobody has measured a beam's size better, while mm and µm are 1e-3 apart.
SMALLEST = 1e-4
# Of the matrix of a plane, where rows have their own.
ELEMENTS = ("r11", "r12", "r16")
# Further quantities: from (open), to, and how to say it.
RANGES = {
    "energy": (0.511, 1e7, "a total energy between 0.511 MeV and 10 TeV; is it in GeV or eV?"),
    "kinetic_energy": (0.0, 1e7, "a kinetic energy between 0 and 10 TeV; is it in GeV or eV?"),
    "momentum": (0.0, 1e7, "a momentum (p c) between 0 and 10 TeV; is it in GeV or eV?"),
    "resolution": (-1e-300, USUAL[1], "a resolution between 0 and 20 mm"),
    "energy_spread": (-1e-300, 0.2, "a relative spread between 0 and 0.2; is it in %?"),
    "shots": (0.5, 1e9, "how many shots the row is the mean of, and its errors are taken from"),
}


def read_quad_scan(
    path: str | PathLike[str] | DataFrame,
    *,
    columns: Columns = None,
    ignore: Iterable[str] = (),
    skip_bad: bool = False,
) -> QuadScan:
    """Read a quadrupole scan.

    Parameters
    ----------
    path : str, path or pandas.DataFrame
        A CSV file whose header carries the units, a frame with such columns, or an HDF5 file
        (``.h5``, ``.hdf5``) with one dataset a column under the same names; or a file of
        emittance_gui (``.mat``), of which these are the RMS sizes (see
        `beamfit.io.emittance_gui.read_emittance_gui`).
    columns : str, path, mapping or Layout, optional
        What columns are whose headers do not say it: ``{"xrms": "size_x_um"}``, or as
        `beamfit.io.layout.layout_of` reads it. Other columns of unknown names are ignored.
    ignore : iterable of str
        Columns to leave unread; * and ? stand for any letters.
    skip_bad : bool
        Leave out rows with something wrong in them; ``notes`` counts and names them.

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
    >>> _ = file.write_text("Q2_A,size_x_um\\n0,200\\n1,120\\n2,180\\n3,lost\\n")
    >>> scan = read_quad_scan(file, skip_bad=True)
    >>> scan.rows("x").size.round(9).tolist()
    [0.0002, 0.00012, 0.00018]
    >>> scan.notes
    ("1 of 4 rows was left out: line 5, column 'size_x_um', 'lost'.",)
    """
    if str(path).lower().endswith(".mat") and is_emittance_gui(path):
        if columns is not None:
            raise InputError("--columns for a file of emittance_gui", "none: it says them", path)
        return read_emittance_gui(path).scan()
    sheet = read_columns(path, "Q2_A,size_x_um", columns, ignore, skip_bad, MOST_ROWS)
    return scan_of_sheet(sheet, skip_bad)


def scan_of_sheet(
    sheet: Sheet, skip_bad: bool = False, knobs: Mapping[str, Column] | None = None
) -> QuadScan:
    """Understand the columns of a sheet as a scan; knobs of the machine are settings, too."""
    profiles: tuple[Profile, ...] = ()
    if IMAGE in sheet.names:
        sheet = of_images(sheet)
    if {"counts_x", "counts_y"} & set(sheet.names):
        sheet, profiles = of_profiles(sheet)
    columns = scan_columns(sheet, knobs or {})
    if skip_bad:
        sheet = sheet.good(lambda rows: _values(rows, columns))
        usual = _usual(_values(sheet, columns))
        sheet = sheet.good(
            lambda rows: _check_slipped(rows, columns, _values(rows, columns), usual)
        )
    try:
        values = _values(sheet, columns)
        odd = _check_sizes(sheet, columns, values)
    except InputError as error:
        skip = error.line is not None and not skip_bad and "--ignore" not in error.expected
        more = "; --skip-bad leaves such rows out" if skip else ""
        raise replace(error, expected=error.expected + more) from None
    notes = [*column_notes(columns), *comment_notes(sheet, columns), *odd]
    notes += [*left_aside(sheet, columns), *left_out(sheet)]
    with located(sheet.path):
        scan = _scan(sheet, columns, values, notes=tuple(notes), profiles=profiles)
    rows = row_keys(scan)
    return average_shots(scan, marked="shot" in columns) if len(set(rows)) < len(rows) else scan


def _scan(
    sheet: Sheet, columns: Mapping[str, Column], values: Mapping[str, np.ndarray], **further: Any
) -> QuadScan:
    """The scan of these numbers, one row a line of the file."""
    magnets = {k.removeprefix(SETTING): c for k, c in columns.items() if k.startswith(SETTING)}
    energies = [(values[key], kind) for key, kind in ENERGIES.items() if key in values]
    energy, kind = energies[0] if energies else (None, "total")
    headers = {key: sheet.called.get(c.header, c.header) for key, c in columns.items()}
    words = {
        key: tuple(map(str, sheet[columns[key].header]))
        for key in ("screen", "slice")
        if key in columns
    }
    planes = [p for p in "xy" if f"size_{p}" in values]
    error = {p: values[f"size_{p}_error"] for p in planes if f"size_{p}_error" in values}
    own = {
        p: np.stack([values.get(f"{name}_{p}", np.zeros(len(sheet))) for name in ELEMENTS], axis=-1)
        for p in planes
        if f"r11_{p}" in values
    }
    return QuadScan(
        settings={name: values[c.key] for name, c in magnets.items()},
        units={name: c.unit for name, c in magnets.items()},
        size={p: values[f"size_{p}"] for p in planes},
        error=error,
        energy=energy,
        energy_kind=kind,
        **{key: values.get(key) for key in ("resolution", "energy_spread", "shots")},
        **words,
        transfer=own or None,
        error_source="the file" if error else "none given",
        name=Path(name_of(sheet.path)).stem,
        path=sheet.path,
        sha256=sheet.sha256,
        provenance=sheet.comments,
        columns={name: headers[c.key] for name, c in magnets.items()}
        | headers
        | {header: header for header in headers.values()},
        **further,
    )


def _values(sheet: Sheet, columns: Mapping[str, Column]) -> dict[str, np.ndarray]:
    """The numbers of a scan in SI by quantity; what is wrong with a row by itself is refused."""
    sizes = [key for p in "xy" for key in (f"size_{p}", f"size_{p}_error") if key in columns]
    others = [key for key in columns if key in RANGES or key.startswith((SETTING, "r1"))]
    values = {key: _checked(sheet, columns[key], key in sizes) for key in sizes + others}
    for plane in "xy":
        size, error = f"size_{plane}", f"size_{plane}_error"
        if error not in columns:
            continue
        if columns[error].unit == PERCENT:
            values[error] = values[error] * values[size]
        if is_scatter(columns, plane):
            values[error] = values[error] / np.sqrt(values["shots"])
        if (missing := np.isnan(values[error]) & ~np.isnan(values[size])).any():
            expected = "an error for each size, or none at all"
            sheet.refuse(columns[error].header, missing, expected, "an empty cell")
        # It was measured, or it was not: a size that says NaN has no error.
        absent = np.isnan(values[size]) & ~np.isnan(values[error])
        for row in [int(row) for row in np.flatnonzero(absent)]:
            if (cell := sheet[columns[size].header][row]) != "":
                expected = "a finite number, or no error beside it"
                raise sheet.error(f"'{cell}'", expected, row, columns[size].header)
    if "screen" in columns and "" in (names := list(sheet[columns["screen"].header])):
        expected = "the name of a screen of the lattice"
        raise sheet.error("an empty cell", expected, names.index(""), columns["screen"].header)
    return values


def _checked(sheet: Sheet, column: Column, length: bool) -> np.ndarray:
    """A quantity within what it can be; lengths in m, NaN where the cell is blank."""
    values = sheet.values(column, blank=length)
    what = f"a positive {'error' if column.key.endswith('error') else 'beam size'} in {column.unit}"
    usual = (0.0, np.inf, what) if length else (-np.inf, np.inf, "")
    low, high, expected = RANGES.get(column.key, usual)
    if (wrong := (values <= low) | (values > high)).any():
        if column.key.endswith("error") and not np.any(values > 0):
            expected += f"; --ignore '{column.header}' leaves them unread: the noise is inferred"
        sheet.refuse(column.header, wrong, expected)
    return values


def _usual(values: Mapping[str, np.ndarray]) -> dict[str, float]:
    """The median size of each plane that has one, m."""
    sizes = {p: values[f"size_{p}"] for p in "xy" if f"size_{p}" in values}
    return {p: middle(v) for p, v in sizes.items() if not np.isnan(v).all()}


def _check_slipped(
    sheet: Sheet,
    columns: Mapping[str, Column],
    values: Mapping[str, np.ndarray],
    usual: Mapping[str, float],
) -> None:
    """Refuse a size that is far larger than the others of its column and than most beams."""
    for plane, usually in usual.items():
        column, size = columns[f"size_{plane}"], values[f"size_{plane}"]
        if (slipped := np.nan_to_num(size) > max(USUAL[1], SLIPPED * usually)).any():
            around = f"{usually / column.factor:.3g}"
            found = f"{{:g}} {column.unit}, where the others are around {around}"
            written = size / column.factor
            sheet.refuse(column.header, slipped, "sizes in one unit", found, written)


def _check_sizes(
    sheet: Sheet, columns: Mapping[str, Column], values: Mapping[str, np.ndarray]
) -> list[str]:
    """Check that sizes and errors are in a unit that can be meant; ask about tiny errors."""
    usual, notes = _usual(values), []
    for plane in (p for p in "xy" if f"size_{p}" in columns):
        column, error = columns[f"size_{plane}"], columns.get(f"size_{plane}_error")
        if plane not in usual:
            expected = f"sizes in {column.unit}"
            raise sheet.error("no number at all", expected, None, column.header)
        if not POSSIBLE[0] <= usual[plane] <= POSSIBLE[1]:
            raise _implausible(sheet, column, usual[plane] / column.factor)
        if error is None:
            continue
        with np.errstate(over="ignore"):
            ratio = middle(values[f"size_{plane}_error"] / values[f"size_{plane}"])
        if not 1e-6 < ratio < 1.0:
            found = f"errors that are {ratio:g} of the sizes"
            raise sheet.error(found, "errors in the unit of the header", None, error.header)
        if ratio < SMALLEST:
            said = f"Errors in {plane} are {ratio:.1g} of the sizes"
            notes.append(f"{said}: are both in the units of their headers?")
    _check_slipped(sheet, columns, values, usual)
    return notes


def _implausible(sheet: Sheet, column: Column, written: float) -> InputError:
    """Ask for the unit in which numbers around this one would be a beam's sizes."""
    lengths = UNITS["length"]
    likely = min(("um", "mm", "m"), key=lambda u: abs(np.log(written * lengths[u] / 2e-4)))
    found = f"sizes around {written:g} {column.unit}, implausible for a beam"
    expected = f"sizes between {1e9 * POSSIBLE[0]:g} nm and {1e3 * POSSIBLE[1]:g} mm; if these are "
    expected += f"{likely}, rename the column {column.key}_{likely}"
    return sheet.error(found, expected, None, column.header)
