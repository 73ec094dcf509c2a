"""The fast way through a large table of numbers: all of it is good, or the slow way says what is
wrong.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from os import PathLike

import numpy as np

from beamfit.errors import InputError
from beamfit.io.files import remember

# Bytes from which a file is worth it, and how many are read at a time.
LARGE, BLOCK = 1_000_000, 1 << 23
# What numbers and what stands between them are written with.
USUAL = np.zeros(256, bool)
USUAL[list(b"0123456789+-.eE,;\t \r\n")] = True


def numeric_rows(
    path: str | PathLike[str], first: int, separator: str, columns: int, most: int
) -> np.ndarray | None:
    """Read the rows of a large file that holds nothing but finite numbers from a line on.

    Parameters
    ----------
    path : str or path
        A text file.
    first : int
        Line of the first row.
    separator : str
        Between cells; a blank stands for any number of blanks.
    columns : int
        Cells of a row.
    most : int
        Most rows there may be.

    Returns
    -------
    array, shape (columns, n), or None
        The values. None if the file is small, or a line is anything but so many finite numbers:
        whoever reads line by line says which.

    Raises
    ------
    InputError
        If there are more rows.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> file = pathlib.Path(tempfile.mkdtemp()) / "a.csv"
    >>> _ = file.write_text("s,mA\\n" + "1.0,2.0\\n" * 200_000)
    >>> numeric_rows(file, 2, ",", 2, 10**6).shape
    (2, 200000)
    """
    if os.path.getsize(path) < LARGE:
        return None
    seen, parts, count = hashlib.sha256(), [], 0
    with open(path, "rb") as stream:
        for _ in range(first - 1):
            seen.update(stream.readline())
        for block in _blocks(stream):
            seen.update(block)
            rows = _rows(block, None if separator == " " else separator, columns)
            if rows is None:
                return None
            parts.append(rows)
            count += rows.shape[1]
            check_length(count, most, path, first + most)
    remember(path, seen)
    return np.concatenate(parts, axis=1)


def check_length(rows: int, most: int, path: str | PathLike[str], line: int | None = None) -> None:
    """Refuse more rows than can be meant."""
    if rows > most:
        expected = "fewer: average what is repeated, or cut the file"
        raise InputError(f"more than {most} rows", expected, path=path, line=line)


def _blocks(stream) -> Iterator[bytes]:
    """Whole lines, some megabytes at a time."""
    left = b""
    while block := stream.read(BLOCK):
        whole, end, left = (left + block).rpartition(b"\n")
        if end:
            yield whole + end
    if left:
        yield left


def _rows(block: bytes, separator: str | None, columns: int) -> np.ndarray | None:
    usual = USUAL[np.frombuffer(block, np.uint8)].all()
    if not usual or block.count(b"\r") != block.count(b"\r\n"):
        return None
    lines = block.decode("ascii").removesuffix("\n").replace("\r", "").split("\n")
    try:
        found = np.loadtxt(lines, delimiter=separator, comments=None, ndmin=2)
    except ValueError:
        return None
    if found.shape != (len(lines), columns) or not np.isfinite(found).all():
        return None
    return found.T.copy()
