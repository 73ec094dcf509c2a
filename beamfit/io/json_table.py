"""Columns of a JSON file, as scripts and pandas write them."""

from __future__ import annotations

from os import PathLike
from typing import Any

from beamfit.errors import InputError
from beamfit.io.files import digest, laid_out, read_json
from beamfit.io.sheet import Sheet

EXPECTED = 'columns of equal lengths, {"name": [...]}, or one object a row, [{"name": ...}]'


# Scans as PyEmittance saves them (pyemittance_data_….json), and lcls-tools and slac-measurements
# (QuadScanEmittanceResult): each plane's own settings and sizes in m. The setting's unit is the
# magnet's own, and only a person knows it: --columns 'quadvals=Q525_kG'.
BY_LETTER = {"setting": "quadvals{}", "size": "beamsizes{}", "error": "beamsizeserr{}"}
BY_ORDER = {"setting": "quadrupole_pv_values", "size": "rms_beamsizes"}


def _planes(content: dict[str, Any]) -> dict[str, list[Any]] | None:
    """Columns of a scan whose planes were measured at settings of their own; None if it is none."""
    if {BY_LETTER["setting"].format("x"), BY_LETTER["size"].format("x")} <= set(content):
        parts = [{k: content.get(n.format(p)) for k, n in BY_LETTER.items()} for p in "xy"]
    elif set(BY_ORDER.values()) <= set(content):
        parts = [{k: _part(content[n], i) for k, n in BY_ORDER.items()} for i in range(2)]
    else:
        return None
    name = (BY_LETTER if "beamsizesx" in content else BY_ORDER)["setting"].format("")
    columns: dict[str, list[Any]] = {name: []}
    for plane, part in zip("xy", parts, strict=True):
        settings = part.pop("setting") or []
        start = len(columns[name])
        columns[name] += settings
        for kind, values in part.items():
            if values:
                column = f"size_{plane}_m" if kind == "size" else f"size_{plane}_error_m"
                columns[column] = [None] * start + list(values)
    length = len(columns[name])
    return {n: values + [None] * (length - len(values)) for n, values in columns.items()}


def _scan_of(path: str | PathLike[str], content: dict[str, Any]) -> dict[str, list[Any]] | None:
    with laid_out(path, "another JSON file", EXPECTED):
        return _planes(content)


def _part(values: Any, i: int) -> Any:
    """One plane's part of a list, or of an object by number."""
    return values.get(str(i)) if isinstance(values, dict) else values[i]


def json_sheet(path: str | PathLike[str], content: Any = None) -> Sheet:
    """The columns of a JSON file.

    Parameters
    ----------
    path : str or path
        The file: an object of lists, or of objects by row as pandas has it, or a list of rows.
    content : optional
        What it says, if that was read.

    Returns
    -------
    Sheet
        With a text a cell; null is a blank one.

    Raises
    ------
    InputError
        If it is anything else.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> file = pathlib.Path(tempfile.mkdtemp()) / "a.json"
    >>> _ = file.write_text('{"time_s": [0, 60], "beam_current_mA": [200.5, null]}')
    >>> json_sheet(file)["beam_current_mA"]
    ['200.5', '']
    """
    content = read_json(path, "another JSON file", EXPECTED) if content is None else content
    if isinstance(content, list) and all(isinstance(row, dict) for row in content):
        names = dict.fromkeys(name for row in content for name in row)
        columns = {name: [row.get(name) for row in content] for name in names}
    elif isinstance(content, dict) and (columns := _scan_of(path, content)) is not None:
        pass
    elif isinstance(content, dict):
        columns = {n: list(c.values()) if isinstance(c, dict) else c for n, c in content.items()}
    else:
        columns = {}
    whole = all(isinstance(column, list) for column in columns.values())
    if not columns or not whole or len({len(column) for column in columns.values()}) > 1:
        raise InputError("another JSON file", EXPECTED, path=path)
    cells = [["" if v is None else str(v).strip() for v in column] for column in columns.values()]
    return Sheet(path, tuple(columns), cells, None, None, (), digest(path))
