"""Twiss tables along a ring: this package's CSV, and the TFS that MAD-X writes."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from beamfit.errors import InputError, nearest
from beamfit.io.files import text_lines

if TYPE_CHECKING:
    from beamfit.lifetime.ring import Optics

__all__ = ["read_twiss"]

# column of a CSV file, and of a TFS file; the vertical dispersion may be missing
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


def _rows(path: Path) -> tuple[dict[str, int], list[tuple[int, list[str]]], bool]:
    """Column positions, numbered rows, and whether the file is TFS."""
    numbered = [(i, line.strip()) for i, line in enumerate(text_lines(path), 1) if line.strip()]
    if any(line.startswith("*") for _, line in numbered):
        header = next(line.split()[1:] for _, line in numbered if line.startswith("*"))
        rows = [(i, line.split()) for i, line in numbered if line[0] not in "@*$#"]
        return {name.upper(): k for k, name in enumerate(header)}, rows, True
    numbered = [(i, line) for i, line in numbered if not line.startswith("#")]
    if not numbered:
        raise InputError("an empty file", "a header and rows", path=path)
    cells = [(i, next(csv.reader([line]))) for i, line in numbered]
    header = [name.strip() for name in cells[0][1]]
    return {name: k for k, name in enumerate(header)}, cells[1:], False


def _column(name: str, position: int, rows: list[tuple[int, list[str]]], path: Path) -> np.ndarray:
    values = np.empty(len(rows))
    for row, (line, cells) in enumerate(rows):
        try:
            values[row] = float(cells[position])
        except (IndexError, ValueError):
            found = repr(cells[position]) if position < len(cells) else "no cell"
            raise InputError(found, "a number", path=path, line=line, column=name) from None
    return values


def _weights(s: np.ndarray, circumference: float, rows: list, path: Path) -> np.ndarray:
    """Share of the ring for each point (trapezoid); the table covers the ring or a part 1/k."""
    if s.size < 2 or np.any(np.diff(s) < 0):
        line = rows[int(np.argmin(np.diff(s))) + 1][0] if s.size > 1 else None
        raise InputError("s falls", "positions that rise", path=path, line=line, column="s_m")
    span = s[-1] - s[0]
    parts = circumference / span if span > 0 else 0.0
    if abs(parts - max(1, round(parts))) > 1e-3 * parts:
        raise InputError(
            f"a table over {span:.6g} m",
            f"the circumference of {circumference:.6g} m or a whole fraction of it",
            path=path,
            column="s_m",
        )
    steps = np.diff(s)
    weight = (np.r_[steps, 0.0] + np.r_[0.0, steps]) / 2
    return weight / span


def read_twiss(path: str | Path, circumference: float) -> Optics:
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
    path = Path(path)
    header, rows, is_tfs = _rows(path)
    columns: dict[str, np.ndarray] = {}
    for name, tfs_name in COLUMNS.items():
        sought = tfs_name if is_tfs else name
        if sought in header:
            columns[name] = _column(sought, header[sought], rows, path)
        elif name in MAY_BE_MISSING:
            columns[name] = np.zeros(len(rows))
        else:
            known = nearest(sought, list(header))
            raise InputError(f"no column '{sought}', but {known}", f"'{sought}'", path=path)
        values = columns[name]
        usable = np.isfinite(values) & ((values > 0) | (not name.startswith("beta")))
        if (bad := np.flatnonzero(~usable)).size:
            line = rows[bad[0]][0]
            raise InputError(
                f"{values[bad[0]]}", "a usable value", path=path, line=line, column=sought
            )
    from beamfit.lifetime.ring import Optics  # JAX from here on: the table is in order

    weight = _weights(columns.pop("s_m"), circumference, rows, path)
    return Optics(weight, *columns.values())
