"""Read runs of a process: time, inputs u_… and outputs y_… in the columns of a file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import partial
from os import PathLike
from typing import TYPE_CHECKING

import numpy as np

from beamfit.dynamics.record import Run
from beamfit.errors import InputError
from beamfit.io.columns import (
    DATE,
    Column,
    Columns,
    Layout,
    Sheet,
    columns_of,
    ignored_note,
    layout_of,
    sheet_notes,
    standard_header,
)
from beamfit.io.files import name_of
from beamfit.io.table import read_columns

if TYPE_CHECKING:
    from pandas import DataFrame

UNUSED, TIME = "unused", "time"
EXAMPLE_HEADER = "time_s,u_valve,y_level"
RUN_NAMES = "inputs u_... and outputs y_..., or --input COLUMN and --output COLUMN"


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
        and outputs ``y_…``. A blank output is a missing reading.
    columns : str, path, mapping or Layout, optional
        Meaning of columns: ``{"valve position": "u_valve"}``, or any layout of
        `beamfit.io.columns.layout_of`. Other columns with unknown names are then ignored.
    inputs, outputs : iterable of str
        Headers of inputs or outputs with other names; all other columns are then ignored.
    step : float, optional
        Time between rows in s, for a file without time.
    ignore : iterable of str
        Columns to leave unread; * and ? are wildcards.
    skip_bad : bool
        Leave out rows that cannot be used; ``notes`` counts and names them.

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
    named = [(name, f"u_{standard_header(name)}") for name in inputs]
    named += [(name, f"y_{standard_header(name)}") for name in outputs]
    layout = layout_of(columns) + Layout(tuple(named), tuple(name for name, _ in named))
    sheet = read_columns(path, EXAMPLE_HEADER, layout, ignore, skip_bad)
    read_header = partial(_run_column, sheet=sheet, named=bool(named))
    columns = columns_of(sheet, {TIME: "time"}, read_header, RUN_NAMES)
    columns = {key: column for key, column in columns.items() if not key.startswith(UNUSED)}
    if TIME not in columns and step is None:
        raise sheet.header_error("no column of time", "time_s, or --step SECONDS")
    for kind, word in (("u", "input"), ("y", "output")):
        if not any(key.startswith(f"{kind}_") for key in columns):
            raise sheet.header_error(f"no {word}", f"a column {kind}_…, or --{word} COLUMN")
    sheet = sheet.drop_bad_rows(lambda rows: _run_values(rows, columns))
    values = _run_values(sheet, columns)
    u, y = ({k[2:]: v for k, v in values.items() if k.startswith(f"{kind}_")} for kind in "uy")
    if (time := values.get(TIME)) is None:
        if not step > 0:
            raise InputError(f"--step {step}", "seconds between the rows, above 0")
        time = float(step) * np.arange(len(sheet))
    not_later = np.flatnonzero(~(np.diff(time) > 0))
    if not_later.size:
        row = int(not_later[0]) + 1
        found = f"time {time[row]:.10g} s after {time[row - 1]:.10g} s"
        without_hint = replace(sheet, row_hint="")
        raise without_hint.error(found, "times that increase", row, columns[TIME].header)
    provenance = {
        "provenance": sheet.comments,
        "notes": (*ignored_note(sheet, columns), *sheet_notes(sheet)),
        "sha256": sheet.sha256,
    }
    return Run(time, u, y, name=name_of(sheet.path), path=str(sheet.path), **provenance)


def _run_column(header: str, sheet: Sheet, named: bool) -> Column:
    """Column of time, input or output; if some are named, others are not read."""
    if header.lower() == TIME:
        return Column(header, TIME, DATE)
    is_read = header in sheet.file_headers or not named
    if is_read and len(header) > 2 and header[:2] in ("u_", "y_"):
        return Column(header, header)
    if header.startswith("note_"):
        return Column(header, f"{UNUSED} {header}")
    raise sheet.header_error("neither time, input nor output", RUN_NAMES, header)


def _run_values(sheet: Sheet, columns: Mapping[str, Column]) -> dict[str, np.ndarray]:
    return {key: sheet.values(c, blank=key.startswith("y_")) for key, c in columns.items()}
