"""Files that hold a beam current: tables, and what the EPICS Archiver Appliance writes."""

from __future__ import annotations

import re
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from beamfit.errors import InputError
from beamfit.io.files import digest, laid_out, read_json, text_lines
from beamfit.io.json_table import json_sheet
from beamfit.io.sheet import UNITS, Sheet
from beamfit.io.table import is_binary, read_sheet

if TYPE_CHECKING:
    from pandas import DataFrame

ARCHIVE = ("secs", "val", "severity", "status", "nanos")


def archive_sheet(
    path: str | PathLike[str] | DataFrame, skip_bad: bool, names: Sequence[str] | None = None
) -> Sheet:
    """The columns of a file, an archive's by their own names, or by those of a file without."""
    example = "time_s,beam_current_mA"
    if names is not None:
        return read_sheet(path, example, ragged=skip_bad, names=names)
    if not isinstance(path, (str, PathLike)):
        return read_sheet(path, example)
    if Path(path).suffix.lower() == ".json":
        return _archive_json(path)
    lines = () if is_binary(path) else text_lines(path)
    head = next((text for text in lines if text.strip()), "")
    if re.fullmatch(r"\d{9,11}(,[^,]+){4}\s*", head):
        return read_sheet(path, ",".join(ARCHIVE), ragged=skip_bad, names=ARCHIVE)
    return read_sheet(path, example, ragged=skip_bad)


def _is_archive(channels: object) -> bool:
    """Whether a JSON file holds channels with their data, and not columns."""
    lists = isinstance(channels, list)
    return lists and all(not isinstance(c, dict) or {"meta", "data"} & set(c) for c in channels)


def _archive_json(path: str | PathLike[str]) -> Sheet:
    """Of the EPICS Archiver Appliance: one channel with its data."""
    expected = 'one channel of the EPICS Archiver Appliance: [{"meta": …, "data": [{"secs": …}]}]'
    channels = read_json(path, "another JSON file", expected)
    if not _is_archive(channels):
        return json_sheet(path, channels)
    with laid_out(path, "another JSON file", expected):
        if len(channels) != 1:
            expected = "one, of the beam current: a file for each"
            raise InputError(f"{len(channels)} channels", expected)
        meta, data = channels[0].get("meta", {}), channels[0]["data"]
        rows = [[str(one["secs"]), str(one["nanos"]), str(one["val"])] for one in data]
    if not rows:
        raise InputError("no readings", "two or more", path=path)
    unit = meta.get("EGU", "") if isinstance(meta, dict) else ""
    called = f"val_{unit}" if unit in UNITS["current"] else "val"
    said = tuple(f"{key}: {value}" for key, value in meta.items()) if meta else ()
    cells = list(zip(*rows, strict=True))
    return Sheet(path, ("secs", "nanos", called), cells, None, None, said, digest(path))
