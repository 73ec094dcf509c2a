"""Tables of a machine that is tuned: a scan whose rows also say where its knobs stood."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from os import PathLike
from typing import TYPE_CHECKING

from beamfit.emittance.scan import KNOB, QuadScan
from beamfit.errors import InputError, nearest
from beamfit.io.columns import Columns, Layout, layout_of
from beamfit.io.headers import SETTINGS, spelled
from beamfit.io.scan import MOST_ROWS, read_quad_scan
from beamfit.io.table import read_columns

if TYPE_CHECKING:
    from pandas import DataFrame

# What a knob's column is called while the table is read: a setting of any unit.
PLAIN = "tuning_knob_{}"


def read_tuning_scan(
    path: str | PathLike[str] | DataFrame,
    knobs: Iterable[str],
    *,
    columns: Columns = None,
    ignore: Iterable[str] = (),
    skip_bad: bool = False,
) -> QuadScan:
    """Read a table of beam sizes with columns of quadrupoles and of knobs.

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
    QuadScan
        Knobs stand among its settings under the names given, in the unit "knob" where theirs is
        none of a magnet. Repeated shots of a row are averaged.

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
    ignore, names = tuple(ignore), {}
    headers = read_columns(path, "Q2_A,knob,size_x_um", columns, ignore, skip_bad, MOST_ROWS)
    for knob in dict.fromkeys(knobs):
        header = _header(knob, headers.names)
        if header is None:
            raise headers.header_error(f"no column of the knob '{knob}'", nearest(
                knob, list(headers.names)))  # fmt: skip
        names[knob] = headers.called.get(header, header)
    plain = {knob: PLAIN.format(i) for i, knob in enumerate(names)}
    own = Layout(tuple((names[knob], f"{plain[knob]}_A") for knob in names))
    scan = read_quad_scan(path, columns=layout_of(columns) + own, ignore=ignore, skip_bad=skip_bad)
    back = {name: knob for knob, name in plain.items()}
    units = {knob: _unit(knob, names[knob]) for knob in names}
    return replace(
        scan,
        settings={back.get(n, n): v for n, v in scan.settings.items()},
        units={back.get(n, n): units.get(back.get(n, n), u) for n, u in scan.units.items()},
        columns=scan.columns | {knob: names[knob] for knob in names},
    )


def _header(knob: str, names: Sequence[str]) -> str | None:
    """The header of a knob: its name, or its name with a unit; None if there is none."""
    if knob in names:
        return knob
    found = [name for name in names if spelled(name).rpartition("_")[0] == knob]
    if len(found) > 1:
        expected = "its header as it stands: " + " or ".join(found)
        raise InputError(f"a knob '{knob}' of several columns", expected)
    return found[0] if found else None


def _unit(knob: str, header: str) -> str:
    """The unit of a knob, where its name leaves it out and it is one of a magnet."""
    unit = spelled(header).removeprefix(f"{knob}_")
    return unit if unit in SETTINGS else KNOB
