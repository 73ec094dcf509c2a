"""Twiss tables along a ring: this package's columns, and those of the TFS that MAD-X writes."""

from __future__ import annotations

from os import PathLike
from typing import TYPE_CHECKING

import numpy as np

from beamfit.errors import nearest
from beamfit.io.table import Sheet, read_sheet

if TYPE_CHECKING:
    from beamfit.lifetime.ring import Optics

__all__ = ["read_twiss"]

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
POSITIVE = {"beta_x_m", "beta_y_m"}


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
    sheet = read_sheet(path, "s_m,beta_x_m,beta_y_m")
    columns = {name: _column(sheet, name) for name in COLUMNS}
    from beamfit.lifetime.ring import Optics  # JAX from here on: the table is in order

    weight = _weights(sheet, columns.pop("s_m"), circumference)
    return Optics(weight, *columns.values())


def _column(sheet: Sheet, name: str) -> np.ndarray:
    """A column under its own name or that of a TFS file."""
    header = next((h for h in (name, COLUMNS[name]) if h in sheet.names), None)
    if header is None:
        if name in MAY_BE_MISSING:
            return np.zeros(len(sheet))
        known = nearest(name, list(sheet.names))
        raise sheet.header_error(f"no column '{name}', but {known}", f"'{name}'")
    values = sheet.numbers(header)
    if name in POSITIVE and (values <= 0).any():
        row = int(np.argmax(values <= 0))
        raise sheet.error(f"{values[row]:g}", "a positive beta function", row, header)
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
