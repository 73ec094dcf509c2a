"""Columns of an HDF5 file of unknown origin, read in a process of its own.

The HDF5 library may crash, never end or fill the memory over a file with a few changed bits. This
file is run as a script there: it imports nothing of beamfit.
"""

from __future__ import annotations

import io
import json
import os
import resource
import subprocess
import sys
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

LARGEST = 256_000_000
# Seconds and bytes of memory that reading may take.
PATIENCE, ROOM = 10, 1_000_000_000
# Bytes for which a busy machine may have another second.
MUCH = 10_000_000
# Filters that are part of every HDF5 library: deflate, shuffle, fletcher32, and h5py's own lzf.
FILTERS = {1, 2, 3, 32000}
LONGEST_COMMENT = 1000
DAMAGED = "a file that is not HDF5, or is damaged", "an HDF5 file; text is .csv"
ELSEWHERE = "datasets that hold their numbers in this file"


class _Refused(Exception):
    """Found, expected and column, as of an InputError."""


def hdf5_columns(
    path: str | PathLike[str], rows: int, texts: int
) -> tuple[dict[str, Sequence[Any]], tuple[str, ...]]:
    """Read the datasets at the top of an HDF5 file.

    Parameters
    ----------
    path : str or path
        The file.
    rows, texts : int
        Most values of a dataset, and of one of texts.

    Returns
    -------
    dict of str to array or list of str, tuple of str
        Values by name, and attributes of the file.

    Raises
    ------
    InputError
        If the file is damaged or too large, or a dataset is no column, has its numbers in another
        file or is packed by a filter that HDF5 does not bring.
    """
    from beamfit.errors import InputError, plain
    from beamfit.io.files import read_bytes

    content = read_bytes(path, LARGEST, "an HDF5 file of readings; fewer of them")
    command = [sys.executable, "-P", __file__, str(rows), str(texts)]
    # No filter from a folder of plugins; the package's own h5py, wherever that is.
    own = {"HDF5_PLUGIN_PRELOAD": "::", "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    own |= {"OPENBLAS_NUM_THREADS": "1"}
    try:
        done = subprocess.run(
            command,
            input=content,
            capture_output=True,
            env=os.environ | own,
            timeout=PATIENCE + len(content) / MUCH,
            start_new_session=True,
            check=True,
        )
        header, _, numbers = done.stdout.partition(b"\n")
        told = json.loads(header)
    except subprocess.TimeoutExpired:
        found = f"a file that HDF5 does not read within {PATIENCE} s"
        raise InputError(found, DAMAGED[1], path) from None
    except (subprocess.CalledProcessError, ValueError):
        raise InputError(*DAMAGED, path) from None
    if "refused" in told:
        found, expected, column = told["refused"]
        raise InputError(found, expected, path=path, column=column)
    columns: dict[str, Any] = {}
    start = 0
    for name, count, words, unit in told["columns"]:
        if words is None:
            words = np.frombuffer(numbers, float, count, start)
            start += words.nbytes
        columns[_with_unit(plain(name), unit, path)] = words
    return columns, tuple(told["comments"])


def _with_unit(name: str, unit: str, path: str | PathLike[str]) -> str:
    """A dataset's name with the unit of its attribute, which may not say another."""
    from beamfit.errors import InputError
    from beamfit.io.headers import known_unit, named, plain_unit, spelled, unit_at_end

    if unit.strip() in ("", "1", "none", "dimensionless"):
        return name
    own, known = unit_at_end(spelled(name)), known_unit(unit)
    if own is None:
        return named(name, known or unit)
    if known is None or plain_unit(known) != plain_unit(own):
        expected = f"one unit, {own} or the attribute's"
        raise InputError(f"the attribute units = '{unit}'", expected, path, column=name)
    return name


def _told(content: bytes, rows: int, texts: int) -> tuple[dict[str, Any], list[np.ndarray]]:
    """What the process says: a header, and the numbers of the columns that are no texts."""
    import h5py

    try:
        with h5py.File(io.BytesIO(content), "r") as store:
            place = _place(store)
            columns = {name: _column(place, name, rows, texts) for name in _names(place)}
            units = {name: _unit(place[name], name) for name in columns}
            said = [f"{key}: {value}"[:LONGEST_COMMENT] for key, value in store.attrs.items()]
    except _Refused as error:
        return {"refused": error.args}, []
    except Exception:  # whatever the library makes of changed bits
        return {"refused": (*DAMAGED, None)}, []
    words = {n: c if isinstance(c, list) else None for n, c in columns.items()}
    header = [(name, len(column), words[name], units[name]) for name, column in columns.items()]
    numbers = [column for column in columns.values() if not isinstance(column, list)]
    return {"columns": header, "comments": said}, numbers


def _place(store: Any) -> Any:
    """Where the datasets are: at the top, or in its only group."""
    import h5py

    only = next(iter(store)) if len(store) == 1 else None
    if only is None or not isinstance(store.get(only, getlink=True), h5py.HardLink):
        return store
    return store[only] if store.get(only, getclass=True) is h5py.Group else store


def _names(store: Any) -> list[str]:
    """The datasets at the top; a link may lead anywhere."""
    import h5py

    names = []
    for name in store:
        if not isinstance(store.get(name, getlink=True), h5py.HardLink):
            raise _Refused("a link", ELSEWHERE, name)
        if store.get(name, getclass=True) is h5py.Dataset:
            names.append(name)
    return names


def _column(store: Any, name: str, rows: int, texts: int) -> list[str] | np.ndarray:
    """The values of a dataset: what it claims to be is looked at before it is read."""
    import h5py

    data = store[name]
    plan = data.id.get_create_plist()
    filters = {plan.get_filter(i)[0] for i in range(plan.get_nfilters())}
    is_text = h5py.check_string_dtype(data.dtype) is not None
    if data.is_virtual or plan.get_external_count():
        raise _Refused("numbers in another file", ELSEWHERE, name)
    if not filters <= FILTERS:
        said = "gzip, lzf, shuffle, fletcher32 or none"
        raise _Refused(f"a filter of number {min(filters - FILTERS)}", said, name)
    if data.shape is None or data.size != max(data.shape, default=1):
        raise _Refused(f"a dataset of shape {data.shape}", "a one-dimensional dataset", name)
    if not is_text and data.dtype.kind not in "iuf":
        raise _Refused(f"values of type {data.dtype}", "numbers or text", name)
    if data.size > (most := texts if is_text else rows):
        expected = "fewer: average what is repeated, or cut the file"
        raise _Refused(f"more than {most} rows", expected, name)
    if not is_text:
        return np.ravel(data[()]).astype(float)
    try:
        return [str(value) for value in np.ravel(data.asstr("utf-8")[()])]
    except UnicodeDecodeError:
        raise _Refused("bytes that are not text", "UTF-8 text", name) from None


def _unit(data: Any, name: str) -> str:
    """The unit that the attributes of a dataset say; numbers that wait for a factor are refused."""
    said = {str(key).lower(): value for key, value in data.attrs.items()}
    for key, usual in (("scale_factor", 1.0), ("add_offset", 0.0)):
        if key in said and not np.all(np.asarray(said[key]) == usual):
            raise _Refused(f"the attribute {key} = {said[key]}", "numbers that contain it", name)
    unit = next((said[key] for key in ("units", "unit", "egu") if key in said), "")
    return str(unit.decode("utf-8", "replace") if isinstance(unit, bytes) else unit)[:40]


def answer(content: bytes, rows: int, texts: int, stream: BinaryIO) -> None:
    """Say what a file holds, within bounds that end this process."""
    pages = Path("/proc/self/statm")
    used = int(pages.read_text().split()[0]) * resource.getpagesize() if pages.exists() else 0
    resource.setrlimit(resource.RLIMIT_AS, (used + ROOM, used + ROOM))
    resource.setrlimit(resource.RLIMIT_CPU, (PATIENCE, PATIENCE))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    header, numbers = _told(content, rows, texts)
    stream.write(json.dumps(header).encode() + b"\n")
    for column in numbers:
        stream.write(np.ascontiguousarray(column).data)
    stream.flush()


if __name__ == "__main__":
    answer(sys.stdin.buffer.read(), *map(int, sys.argv[1:]), sys.stdout.buffer)
