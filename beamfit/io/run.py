"""Records of runs: time, inputs u_… and outputs y_… in the columns of a file."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from os import PathLike
from typing import TYPE_CHECKING

import numpy as np

from beamfit.dynamics.record import Run
from beamfit.errors import InputError
from beamfit.io.columns import (
    DATE,
    Column,
    Columns,
    Sheet,
    columns_of,
    ignored,
    left_out,
)
from beamfit.io.files import name_of
from beamfit.io.table import read_columns

if TYPE_CHECKING:
    from pandas import DataFrame

ASIDE, TIME = "aside", "time"
EXAMPLE = "time_s,u_valve,y_level"


def read_run(
    path: str | PathLike[str] | DataFrame,
    *,
    columns: Columns = None,
    inputs: Iterable[str] = (),
    outputs: Iterable[str] = (),
    step: float | None = None,
    ignore: Iterable[str] = (),
    skip_bad: bool = False,
) -> Run:
    """Read a run of a process.

    Parameters
    ----------
    path : str, path or pandas.DataFrame
        A frame, CSV or HDF5 with ``time_s`` (_min, _h, _ms; or ``time`` with dates), inputs ``u_…``
        and outputs ``y_…``. A blank output was not read.
    columns : str, path, mapping or Layout, optional
        What columns are: ``{"valve position": "u_valve"}``, or as `beamfit.io.columns.layout_of`
        reads it. Other columns of unknown names are ignored.
    inputs, outputs : iterable of str
        Columns of other names that are inputs or outputs; the others are then ignored.
    step : float, optional
        Distance of the rows in s, of a file without a time.
    ignore : iterable of str
        Columns to leave unread; * and ? stand for any letters.
    skip_bad : bool
        Leave out rows with something wrong in them; ``notes`` counts and names them.

    Returns
    -------
    Run

    Raises
    ------
    InputError
        With file, line and column, if a column is missing or unknown, a cell is not a number, or
        times do not increase.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> file = pathlib.Path(tempfile.mkdtemp()) / "run.csv"
    >>> rows = "".join(f"{k},{int(k > 2)},{k / 9}\\n" for k in range(10))
    >>> _ = file.write_text("time_s,u_valve,y_level\\n" + rows)
    >>> print(read_run(file))
    run.csv: 10 rows over 9 s, inputs valve, outputs level
    """
    sheet = read_columns(path, EXAMPLE, columns, ignore, skip_bad)
    named = {"u": tuple(inputs), "y": tuple(outputs)}
    columns = _columns(sheet, named)
    if TIME not in columns and step is None:
        raise sheet.header_error("no column of time", "time_s, or --step SECONDS")
    kinds = {kind: {k[2:]: c for k, c in columns.items() if k.startswith(f"{kind}_")}
             for kind in "uy"}  # fmt: skip
    for kind, word in (("u", "input"), ("y", "output")):
        if not kinds[kind]:
            raise sheet.header_error(f"no {word}", f"a column {kind}_…, or --{word} COLUMN")
    sheet = sheet.good(lambda rows: _values(rows, columns, kinds))
    time, u, y = _values(sheet, columns, kinds)
    if time is None:
        if not step > 0:
            raise InputError(f"--step {step}", "seconds between the rows, above 0")
        time = float(step) * np.arange(len(sheet))
    late = np.flatnonzero(~(np.diff(time) > 0))
    if late.size:
        row = int(late[0]) + 1
        found = f"time {time[row]:.10g} s after {time[row - 1]:.10g} s"
        whole = replace(sheet, skip="")
        raise whole.error(found, "times that increase", row, columns[TIME].header)
    name, aside = name_of(sheet.path), ignored(sheet, columns)
    said = {
        "provenance": sheet.comments,
        "notes": (*aside, *left_out(sheet)),
        "sha256": sheet.sha256,
    }
    return Run(time, u, y, name=name, path=str(sheet.path), **said)


def _columns(sheet: Sheet, named: dict[str, tuple[str, ...]]) -> dict[str, Column]:
    """Every column that is read, under ``time``, ``u_…`` or ``y_…``."""
    found = {}
    for kind, names in named.items():
        for name in names:
            if name not in sheet.names:
                raise sheet.no_column(name)
            found[name] = Column(name, f"{kind}_{name}")
    any_named = bool(found)

    def other(header: str) -> Column | None:
        if header.lower() == TIME:
            return Column(header, TIME, DATE)
        if header[:2] in ("u_", "y_") and len(header) > 2 and not any_named:
            return Column(header, header)
        aside = any_named or header.startswith("note_")
        return Column(header, f"{ASIDE} {header}") if aside else None

    left = [n for n in sheet.names if n not in found]
    known = columns_of(sheet.only(left), {TIME: "time"}, other)
    return {k: c for k, c in known.items() if not k.startswith(ASIDE)} | {
        c.key: c for c in found.values()
    }


def _values(
    sheet: Sheet, columns: dict[str, Column], kinds: dict[str, dict[str, Column]]
) -> tuple[np.ndarray | None, dict[str, np.ndarray], dict[str, np.ndarray]]:
    time = sheet.values(columns[TIME]) if TIME in columns else None
    u = {name: sheet.values(c) for name, c in kinds["u"].items()}
    y = {name: sheet.values(c, blank=True) for name, c in kinds["y"].items()}
    return time, u, y
