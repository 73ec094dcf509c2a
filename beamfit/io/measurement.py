"""Quadrupole scans: what the columns of a file mean, and shots that become points."""

from __future__ import annotations

import re
from dataclasses import replace
from os import PathLike
from pathlib import Path

import numpy as np

from beamfit.errors import InputError, nearest
from beamfit.io.table import UNITS, Column, Sheet, columns_of, read_sheet
from beamfit.studies.scan.scans import QuadScan, first_unusable, row_keys

__all__ = ["average_shots", "read_quad_scan"]

QUANTITIES = {
    "size_x": "length",
    "size_x_error": "length",
    "size_y": "length",
    "size_y_error": "length",
    "resolution": "length",
    "energy": "energy in MeV",
    "energy_spread": "",
    "shot": "",
    "screen": "",
}
SETTINGS = ("A", "kG", "k1", "k1l")
CARRIED = re.compile(r"note_.*|time|timestamp|charge_[np]C")
# More rows than any scan: such a file is a log, and is refused before it fills the memory.
MOST_ROWS = 100_000
# Rms sizes on a screen; outside this a header's unit is wrong.
PLAUSIBLE = (1e-7, 2e-2)
# Further quantities: from (open), to, and how to say it.
RANGES = {
    "energy": (0.511, 1e7, "a total energy between 0.511 MeV and 10 TeV; is it in GeV or eV?"),
    "resolution": (-1e-300, PLAUSIBLE[1], "a resolution between 0 and 20 mm"),
    "energy_spread": (-1e-300, 0.2, "a relative spread between 0 and 0.2; is it in %?"),
}
# Below this many shots a setting's own scatter is too uncertain to weight it by.
ENOUGH_SHOTS = 5
# With fewer repeats in all (two or three accidental ones) the scatter says nothing.
ENOUGH_DEGREES = 3


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
    sheet = read_sheet(path, "Q2_A,size_x_um", MOST_ROWS)
    columns = columns_of(sheet, QUANTITIES, lambda header: _setting(header, sheet))
    _check_columns(sheet, columns)
    settings = {c.key.removeprefix("setting "): c for c in columns.values() if c.unit in SETTINGS}
    planes = [p for p in "xy" if f"size_{p}" in columns]
    size = {p: _sizes(sheet, columns[f"size_{p}"]) for p in planes}
    error = {
        p: _errors(sheet, columns[f"size_{p}_error"], size[p])
        for p in planes
        if f"size_{p}_error" in columns
    }
    further = {key: _within(sheet, columns[key]) for key in RANGES if key in columns}
    try:
        scan = QuadScan(
            settings={name: sheet.numbers(c.header) for name, c in settings.items()},
            units={name: c.unit for name, c in settings.items()},
            size=size,
            error=error,
            **further,
            screen=_screens(sheet, columns.get("screen")),
            error_source="the file",
            name=Path(path).stem,
            path=path,
            sha256=sheet.sha256,
            provenance=sheet.comments,
            columns={name: c.header for name, c in settings.items()}
            | {key: c.header for key, c in columns.items()}
            | {c.header: c.header for c in columns.values()},
        )
    except InputError as error:
        raise replace(error, path=path) from None
    return average_shots(scan, marked="shot" in columns)


def _setting(header: str, sheet: Sheet) -> Column:
    """A magnet's setting, or a column that is carried along unread."""
    if CARRIED.fullmatch(header):
        return Column(header, header)
    name, _, unit = header.rpartition("_")
    if name and unit in SETTINGS and not header.startswith("size_"):
        return Column(header, f"setting {name}", unit)
    usual = ["size_x_um", "size_x_error_um", "size_y_um", "size_y_error_um", "resolution_um"]
    usual += ["energy_MeV", "energy_spread", "shot", "screen"]
    raise sheet.header_error(
        f"unknown unit '{unit}'" if name else "a name without a unit",
        "a magnet with _A, _kG or _k1 at the end, "
        + nearest(header, usual)
        + "; begin a name with note_ to carry a column along unread",
        header,
    )


def _check_columns(sheet: Sheet, columns: dict[str, Column]) -> None:
    """Check that the columns make a scan, and that there are rows."""
    if not {"size_x", "size_y"} & set(columns):
        missing = "a beam size column, such as size_x_um"
    elif not any(c.unit in SETTINGS for c in columns.values()):
        missing = "a magnet setting column, such as Q2_A, Q2_kG or Q2_k1"
    else:
        missing = ""
    if missing:
        raise sheet.header_error("columns " + ", ".join(sheet.names), missing)
    for plane in "xy":
        if f"size_{plane}_error" in columns and f"size_{plane}" not in columns:
            found = f"size_{plane}_error without size_{plane}"
            raise sheet.header_error(found, f"a column size_{plane}_um")
    if not len(sheet):
        raise sheet.error("a header and no rows", "at least three settings")


def _positive(sheet: Sheet, column: Column, what: str) -> np.ndarray:
    """Lengths in m; NaN where the cell is blank."""
    values = sheet.numbers(column.header, blank=True) * column.factor
    if wrong := first_unusable(values, blank=True):
        cell = sheet[column.header][wrong[0]]
        expected = f"a positive {what} in {column.unit}"
        raise sheet.error(f"'{cell}'", expected, wrong[0], column.header)
    return values


def _sizes(sheet: Sheet, column: Column) -> np.ndarray:
    """Sizes in m, in a unit that can be meant: no beam is metres wide, or as small as atoms."""
    size = _positive(sheet, column, "beam size")
    if np.isnan(size).all():
        expected = f"sizes in {column.unit}"
        raise sheet.error("no number at all", expected, None, column.header)
    middle, row = float(np.nanmedian(size)), int(np.nanargmax(size))
    if not PLAUSIBLE[0] <= middle <= PLAUSIBLE[1]:
        written, lengths = middle / column.factor, UNITS["length"]
        likely = min(("um", "mm", "m"), key=lambda u: abs(np.log(written * lengths[u] / 2e-4)))
        found = f"sizes around {written:g} {column.unit}, implausible for a beam"
        expected = f"sizes between 0.1 um and 20 mm; if these are {likely}, rename the column "
        raise sheet.error(found, f"{expected}{column.key}_{likely}", None, column.header)
    if size[row] > PLAUSIBLE[1]:
        found = f"{size[row] / column.factor:g} {column.unit}, implausible for a beam"
        expected = "sizes below 20 mm; is this row in another unit?"
        raise sheet.error(found, expected, row, column.header)
    return size


def _errors(sheet: Sheet, column: Column, size: np.ndarray) -> np.ndarray:
    """Errors in m, one for each size and smaller than it."""
    error = _positive(sheet, column, "error")
    missing = np.isnan(error) & ~np.isnan(size)
    if missing.any():
        expected, row = "an error for each size, or none at all", int(np.argmax(missing))
        raise sheet.error("an empty cell", expected, row, column.header)
    with np.errstate(over="ignore"):
        ratio = float(np.nanmedian(error / size))
    if not 1e-6 < ratio < 1.0:
        found = f"errors that are {ratio:g} of the sizes"
        raise sheet.error(found, "errors in the unit of the header", None, column.header)
    return error


def _within(sheet: Sheet, column: Column) -> np.ndarray:
    """A further quantity, within what it can be."""
    low, high, expected = RANGES[column.key]
    values = sheet.numbers(column.header) * column.factor
    wrong = (values <= low) | (values > high)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise sheet.error(f"'{sheet[column.header][row]}'", expected, row, column.header)
    return values


def _screens(sheet: Sheet, column: Column | None) -> tuple[str, ...] | None:
    if column is None:
        return None
    names = tuple(str(name) for name in sheet[column.header])
    if "" in names:
        expected = "the name of a screen of the lattice"
        raise sheet.error("an empty cell", expected, names.index(""), column.header)
    return names


def average_shots(scan: QuadScan, *, marked: bool) -> QuadScan:
    """Average the rows that repeat a setting, an energy and a screen.

    Parameters
    ----------
    scan : QuadScan
        One row a shot.
    marked : bool
        Whether the file says its rows are shots. If not, rows that carry errors of their own
        stay as they are: each is a measurement by itself.

    Returns
    -------
    QuadScan
        One row a setting. The error is the standard error of the mean, s/√n with n - 1 in s;
        where a setting has fewer than five shots, s is the relative scatter pooled over all
        settings, because two or three shots can agree by chance. With fewer than three
        repeats in all the errors of the file stand, or there are none and the fit infers them.

    Examples
    --------
    >>> shots = QuadScan({"Q": [0, 0, 1, 1, 2, 2.0]}, {"Q": "A"},
    ...                  {"x": [1.0e-4, 1.2e-4, 2.0e-4, 2.2e-4, 3.0e-4, 3.2e-4]})
    >>> average_shots(shots, marked=True).size["x"].round(6).tolist()
    [0.00011, 0.00021, 0.00031]
    """
    rows: dict[tuple, int] = {}
    keys = row_keys(scan.settings, scan.energy, scan.screen)
    group = np.array([rows.setdefault(key, len(rows)) for key in keys])
    if len(rows) == len(group) or (scan.error and not marked):
        return scan if scan.error else replace(scan, error_source="none given")
    size, scatter, given = {}, {}, {}
    for plane, values in scan.size.items():
        size[plane], error = _shot_means(values, group)
        if error is not None:
            scatter[plane] = error
        elif plane in scan.error:  # too few repeats: what the file says of its shots is kept
            shots, mean_square = _means(scan.error[plane] ** 2, group)
            given[plane] = np.sqrt(mean_square / shots)
    first = np.unique(group, return_index=True)[1]
    said = "the scatter of the shots (standard error of the mean)" if scatter else "the file"
    return replace(
        scan,
        settings={n: v[first] for n, v in scan.settings.items()},
        size=size,
        error=scatter | given,
        **{
            name: None if (values := getattr(scan, name)) is None else values[first]
            for name in ("energy", "resolution", "energy_spread")
        },
        screen=None if scan.screen is None else tuple(scan.screen[i] for i in first),
        shots=np.bincount(group),
        error_source=said if scatter or given else "none given",
    )


def _means(values: np.ndarray, group: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How many numbers each group has, and their mean; NaN, a shot not measured, is none."""
    measured = ~np.isnan(values)
    number = np.bincount(group, measured)
    with np.errstate(invalid="ignore"):
        return number, np.bincount(group, np.where(measured, values, 0.0)) / number


def _shot_means(size: np.ndarray, group: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Mean of the shots of each setting, m, and its standard error.

    The error is None where too few repeat or all agree.
    """
    number, mean = _means(size, group)
    square = number * _means((size - mean[group]) ** 2, group)[1]
    degrees = np.maximum(number - 1, 0).sum()
    pooled = np.sqrt(np.nansum(square / mean**2) / max(degrees, 1))
    if degrees < ENOUGH_DEGREES or pooled == 0.0:
        return mean, None
    own = np.sqrt(square / np.maximum(number - 1, 1))
    deviation = np.where((number >= ENOUGH_SHOTS) & (own > 0), own, pooled * mean)
    return mean, deviation / np.sqrt(np.where(number > 0, number, np.nan))
