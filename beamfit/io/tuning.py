"""Tables of a machine that is tuned: sizes or finished emittances, and where its knobs stood."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from beamfit.emittance.scan import KNOB, QuadScan
from beamfit.errors import InputError, nearest
from beamfit.io.columns import SETTINGS, Column, Sheet, columns_of, left_out, spelled
from beamfit.io.files import name_of
from beamfit.io.layout import Columns
from beamfit.io.scan import MOST_ROWS, scan_of_sheet
from beamfit.io.table import read_columns
from beamfit.tuning.knobs import EmittanceTable

if TYPE_CHECKING:
    from pandas import DataFrame

EMITTANCE = re.compile(r"(normalized_)?emittance_[xy]")


def read_tuning_scan(
    path: str | PathLike[str] | DataFrame,
    knobs: Iterable[str],
    *,
    columns: Columns = None,
    ignore: Iterable[str] = (),
    skip_bad: bool = False,
) -> QuadScan | EmittanceTable:
    """Read a table of beam sizes with columns of quadrupoles and of knobs, or of emittances.

    Parameters
    ----------
    path : str, path or pandas.DataFrame
        As for `beamfit.read_quad_scan`.
    knobs : iterable of str
        Knobs by the header of their column, with its unit or without: "SOL_A", "SOL",
        "gun_phase_deg".
    columns, ignore, skip_bad
        As for `beamfit.read_quad_scan`; other columns of unknown names are ignored.

    Returns
    -------
    QuadScan or EmittanceTable
        The latter if there are columns such as emittance_x_um or normalized_emittance_x_um, with
        emittance_x_error_um beside. Knobs stand among the settings under the names given; of a
        scan in the unit "knob" where theirs is none of a magnet, and repeated shots of a row are
        averaged.

    Raises
    ------
    InputError
        If the file cannot be used or has no column of a knob, naming file, line and column.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> file = pathlib.Path(tempfile.mkdtemp()) / "tune.csv"
    >>> _ = file.write_text("Q2_A,phase_deg,size_x_um\\n0,5,200\\n1,6,120\\n2,5,180\\n")
    >>> scan = read_tuning_scan(file, ["phase_deg"])
    >>> scan.settings["phase_deg"].tolist(), scan.units["phase_deg"]
    ([5.0, 6.0, 5.0], 'knob')
    """
    sheet = read_columns(path, "Q2_A,knob,size_x_um", columns, ignore, skip_bad, MOST_ROWS)
    names = {knob: _header(knob, sheet) for knob in dict.fromkeys(knobs)}
    called = {knob: sheet.called.get(name, name) for knob, name in names.items()}
    if any(EMITTANCE.match(name) for name in sheet.names):
        return _emittances(sheet, names, called)
    units = {knob: _unit(knob, header) for knob, header in called.items()}
    knobs = {f"setting {k}": Column(n, f"setting {k}", units[k]) for k, n in names.items()}
    scan = scan_of_sheet(replace(sheet, arranged=True), skip_bad, knobs)
    return replace(scan, columns=scan.columns | called)


def _emittances(sheet: Sheet, names: Mapping[str, str], called: dict[str, str]) -> EmittanceTable:
    """Finished emittances at settings of knobs; other columns are ignored."""
    known = [n for n in sheet.names if EMITTANCE.match(n)]
    kinds = {n.startswith("normalized_") for n in known}
    if len(kinds) > 1:
        expected = "columns of one of them"
        raise sheet.header_error("emittances, and normalized emittances", expected, known[-1])
    word = "normalized_emittance_" if kinds.pop() else "emittance_"
    quantities = {f"{word}{end}": "length" for end in ("x", "y", "x_error", "y_error")}
    found = columns_of(sheet.only(known), quantities)
    values = {k.removeprefix(word): sheet.values(c, blank=True) for k, c in found.items()}
    for column, each in zip(found.values(), values.values(), strict=True):
        sheet.refuse(column.header, each <= 0.0, "a positive number")
    return EmittanceTable(
        settings={knob: sheet.numbers(name) for knob, name in names.items()},
        emittance={p: v for p, v in values.items() if p in "xy"},
        error={k[0]: v for k, v in values.items() if k not in "xy"},
        normalized=word.startswith("normalized_"),
        name=Path(name_of(sheet.path)).stem,
        path=sheet.path,
        sha256=sheet.sha256,
        provenance=sheet.comments,
        notes=left_out(sheet),
        columns=called | {k.replace(word, "emittance "): c.header for k, c in found.items()},
    )


def _header(knob: str, sheet: Sheet) -> str:
    """The header of a knob: its name, or its name with a unit."""
    if knob in sheet.names:
        return knob
    found = [name for name in sheet.names if spelled(name).rpartition("_")[0] == knob]
    if not found:
        expected = nearest(knob, list(sheet.names))
        raise sheet.header_error(f"no column of the knob '{knob}'", expected)
    if len(found) > 1:
        expected = "its header as it stands: " + " or ".join(found)
        raise InputError(f"a knob '{knob}' of several columns", expected)
    return found[0]


def _unit(knob: str, header: str) -> str:
    """The unit of a knob, where its name leaves it out and it is one of a magnet."""
    unit = spelled(header).removeprefix(f"{knob}_")
    return unit if unit in SETTINGS else KNOB
