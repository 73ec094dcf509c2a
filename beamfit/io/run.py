"""Records of runs: time, inputs u_… and outputs y_… in the columns of a file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
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
    named = [(name, f"u_{standard_header(name)}") for name in inputs]
    named += [(name, f"y_{standard_header(name)}") for name in outputs]
    layout = layout_of(columns) + Layout(tuple(named), tuple(name for name, _ in named))
    sheet = read_columns(path, EXAMPLE, layout, ignore, skip_bad)
    columns = columns_of(sheet, {TIME: "time"}, lambda header: _other(header, sheet, bool(named)))
    columns = {key: column for key, column in columns.items() if not key.startswith(ASIDE)}
    if TIME not in columns and step is None:
        raise sheet.header_error("no column of time", "time_s, or --step SECONDS")
    for kind, word in (("u", "input"), ("y", "output")):
        if not any(key.startswith(f"{kind}_") for key in columns):
            raise sheet.header_error(f"no {word}", f"a column {kind}_…, or --{word} COLUMN")
    sheet = sheet.drop_bad_rows(lambda rows: _values(rows, columns))
    values = _values(sheet, columns)
    u, y = ({k[2:]: v for k, v in values.items() if k.startswith(f"{kind}_")} for kind in "uy")
    if (time := values.get(TIME)) is None:
        if not step > 0:
            raise InputError(f"--step {step}", "seconds between the rows, above 0")
        time = float(step) * np.arange(len(sheet))
    late = np.flatnonzero(~(np.diff(time) > 0))
    if late.size:
        row = int(late[0]) + 1
        found = f"time {time[row]:.10g} s after {time[row - 1]:.10g} s"
        whole = replace(sheet, row_hint="")
        raise whole.error(found, "times that increase", row, columns[TIME].header)
    said = {
        "provenance": sheet.comments,
        "notes": (*ignored_note(sheet, columns), *sheet_notes(sheet)),
        "sha256": sheet.sha256,
    }
    return Run(time, u, y, name=name_of(sheet.path), path=str(sheet.path), **said)


def _other(header: str, sheet: Sheet, named: bool) -> Column | None:
    """An input or an output; where some are named, no others are read."""
    if header.lower() == TIME:
        return Column(header, TIME, DATE)
    if (
        header[:2] in ("u_", "y_")
        and len(header) > 2
        and (header in sheet.file_headers or not named)
    ):
        return Column(header, header)
    return Column(header, f"{ASIDE} {header}") if header.startswith("note_") else None


def _values(sheet: Sheet, columns: Mapping[str, Column]) -> dict[str, np.ndarray]:
    return {key: sheet.values(c, blank=key.startswith("y_")) for key, c in columns.items()}
