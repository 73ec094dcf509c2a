"""Tables along a ring: its optics (CSV or TFS) and its momentum acceptance."""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from beamfit.errors import nearest
from beamfit.io.sheet import Sheet
from beamfit.io.table import read_sheet

if TYPE_CHECKING:
    from beamfit.lifetime.ring import Optics

# column here, and in a TFS file; the vertical dispersion may be missing
COLUMNS = {
    "s_m": "S",
    "beta_x_m": "BETX",
    "beta_y_m": "BETY",
    "alpha_x": "ALFX",
    "alpha_y": "ALFY",
    "dispersion_x_m": "DX",
    "dispersion_y_m": "DY",
    "dispersion_slope_x": "DPX",
    "dispersion_slope_y": "DPY",
}
MAY_BE_MISSING = {"dispersion_y_m", "dispersion_slope_y"}
SIDES = ("delta_plus", "delta_minus")
# What no ring has, by the first word of a column.
RANGES = {
    "beta": (1e-6, 1e6, "a positive beta function"),
    "alpha": (-1e4, 1e4, "a Twiss alpha"),
    "dispersion": (-1e3, 1e3, "a dispersion of metres"),
}
ANYWHERE = (-1e6, 1e6, "a position in m")


def read_twiss(path: str | PathLike[str], circumference: float) -> Optics:
    """Read the optics along a ring.

    Parameters
    ----------
    path : str or path
        CSV with the columns `s_m, beta_x_m, beta_y_m, alpha_x, alpha_y, dispersion_x_m,
        dispersion_slope_x` (and optionally the vertical dispersion), or MAD-X TFS. The table
        covers the whole ring, or one of its equal (or mirror-symmetric) parts. Points close
        together, inside magnets too: averages are taken by the trapezoidal rule.
    circumference : float
        Circumference of the ring, m.

    Returns
    -------
    Optics
        One point for each row.

    Raises
    ------
    InputError
        With file, line and column, if a column is missing, a cell is not a number, a Twiss beta
        is not positive, or the table does not cover the ring.

    Examples
    --------
    >>> optics = read_twiss("lattices/spear3_2003_twiss.csv", 234.144)
    >>> print(f"mean beta_y {optics.average(optics.beta_y):.3f} m")
    mean beta_y 8.785 m
    """
    return _twiss(path, circumference)[1]


def _twiss(path: str | PathLike[str], circumference: float) -> tuple[np.ndarray, Optics]:
    """Where the points are, m, and the optics there."""
    sheet = read_sheet(path, "s_m,beta_x_m,beta_y_m")
    columns = {name: _column(sheet, name) for name in COLUMNS}
    s = columns.pop("s_m")
    weight = _weights(sheet, s, circumference)
    from beamfit.lifetime.ring import Optics  # JAX from here on: the table is in order

    return s, Optics(weight, *columns.values())


def read_along(
    circumference: float, optics: Mapping[str, float] | Path, apertures: Path | None
) -> tuple[Optics, np.ndarray | None]:
    """Read what a ring file says along the ring.

    Parameters
    ----------
    circumference : float
        Circumference of the ring, m.
    optics : mapping of str to float, or path
        Ring averages by their fields in `Optics`, or a table as of `read_twiss`.
    apertures : path or None
        A table with `s_m, delta_plus, delta_minus`: momentum acceptance of the lattice up and down
        (with either sign), relative, over the same part of the ring as the optics.

    Returns
    -------
    Optics
        At the points of its table, of averages at those of the apertures.
    array, shape (2, n), or None
        Momentum acceptance up and down there, linear between the points of its table.

    Raises
    ------
    InputError
        As `read_twiss`, and if an aperture is no share between 0 and 1.
    """
    if isinstance(optics, Path):
        s, found = _twiss(optics, circumference)
    else:
        from beamfit.lifetime.ring import Optics

        averages = {field: np.array([value]) for field, value in optics.items()}
        s, found = None, Optics(np.ones(1), **averages)
    if apertures is None:
        return found, None
    sheet = read_sheet(apertures, "s_m,delta_plus,delta_minus")
    at, *sides = (_column(sheet, name) for name in ("s_m", *SIDES))
    weight = _weights(sheet, at, circumference)
    if s is None:
        spread = found._make(np.broadcast_to(values, at.shape) for values in found)
        return spread._replace(weight=weight), np.stack(sides)
    if max(abs(at[0] - s[0]), abs(at[-1] - s[-1])) > 1e-3 * circumference:
        ends = f"s from {at[0]:.6g} to {at[-1]:.6g} m"
        expected = f"that of the optics, {s[0]:.6g} to {s[-1]:.6g} m"
        raise sheet.error(ends, expected, None, "s_m")
    return found, np.stack([np.interp(s, at, side) for side in sides])


def _column(sheet: Sheet, name: str) -> np.ndarray:
    """A column under its own name or that of a TFS file."""
    header = next((h for h in (name, COLUMNS.get(name)) if h in sheet.names), None)
    if header is None:
        if name in MAY_BE_MISSING:
            return np.zeros(len(sheet))
        known = nearest(name, list(sheet.names))
        raise sheet.header_error(f"no column '{name}', but {known}", f"'{name}'")
    values = sheet.numbers(header)
    if name in SIDES:
        values = np.abs(values)
        wrong, expected = (values == 0) | (values >= 1), "a share between 0 and 1, 0.03 for 3 %"
    else:
        low, high, expected = RANGES.get(name.split("_")[0], ANYWHERE)
        wrong = ~((low < values) & (values < high))
    sheet.refuse(header, wrong, expected, "{:g}", values)
    return values


def _weights(sheet: Sheet, s: np.ndarray, circumference: float) -> np.ndarray:
    """Share of the ring for each point (trapezoid); the table covers the ring or a part 1/k."""
    steps = np.diff(s)
    if s.size < 2 or np.any(steps < 0):
        row = int(np.argmin(steps)) + 1 if s.size > 1 else None
        raise sheet.error("s falls", "positions that rise", row, "s_m")
    span = s[-1] - s[0]
    parts = circumference / span if span > 0 else 0.0
    if abs(parts - max(1, round(parts))) > 1e-3 * parts:
        found = f"a table over {span:.6g} m"
        expected = f"the circumference of {circumference:.6g} m or a whole fraction of it"
        raise sheet.error(found, expected, None, "s_m")
    weight = (np.r_[steps, 0.0] + np.r_[0.0, steps]) / 2
    return weight / span
