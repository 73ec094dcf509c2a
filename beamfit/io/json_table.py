"""Columns of a JSON file, as scripts and pandas write them."""

from __future__ import annotations

from os import PathLike
from typing import Any

from beamfit.errors import InputError
from beamfit.io.files import digest, read_json
from beamfit.io.sheet import Sheet

EXPECTED = 'columns of equal lengths, {"name": [...]}, or one object a row, [{"name": ...}]'


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
    elif isinstance(content, dict):
        columns = {n: list(c.values()) if isinstance(c, dict) else c for n, c in content.items()}
    else:
        columns = {}
    whole = all(isinstance(column, list) for column in columns.values())
    if not columns or not whole or len({len(column) for column in columns.values()}) > 1:
        raise InputError("another JSON file", EXPECTED, path=path)
    cells = [["" if v is None else str(v).strip() for v in column] for column in columns.values()]
    return Sheet(path, tuple(columns), cells, None, None, (), digest(path))
