"""Variables of MATLAB files of version 5 to 7.

SciPy reads them too, but a damaged file can crash it (a segmentation fault in one of some hundred
files with a few bytes changed), and a small one can make it fill the memory.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from typing import NamedTuple

import numpy as np

from beamfit.errors import InputError
from beamfit.io.files import read_bytes

# The format: MATLAB, MAT-File Format (The MathWorks), chapter 1.
HEADER = 128
COMPRESSED, MATRIX = 15, 14
CELL, STRUCT, CHAR, NUMBERS, COMPLEX = 1, 2, 4, range(6, 16), 0x800
# Data types: how numbers and texts are stored.
STORED = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    9: "f8",
    12: "i8",
    13: "u8",
}
TEXTS = {1: "utf-8", 2: "utf-8", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}
# Bytes of a file, of what it holds unpacked, arrays in it, and how deep they may lie.
LARGEST, UNPACKED, MOST_ARRAYS, DEEPEST = 256_000_000, 512_000_000, 500_000, 20
SAVE = (
    "a MATLAB file of version 5 to 7: save(name, 'data', '-v7'), or columns as CSV, by writetable"
)


class _Damaged(Exception):
    """What a file claims that cannot be."""


class _Element(NamedTuple):
    """A data element: its type, where its content begins and ends, and where the next one does."""

    kind: int
    start: int
    end: int
    after: int


def read_variable(path: str | PathLike[str], name: str) -> np.ndarray:
    """Read one variable of a MATLAB file.

    Parameters
    ----------
    path : str or path
        A file of version 5 to 7, compressed or not, of either byte order.
    name : str
        The variable.

    Returns
    -------
    ndarray
        A struct is an array with fields, a cell an array of objects, a text an array of its lines.

    Raises
    ------
    InputError
        If it is no such file, is damaged, lacks the variable, or is larger than any scan.

    Examples
    --------
    >>> import pathlib, scipy.io, tempfile
    >>> file = pathlib.Path(tempfile.mkdtemp()) / "a.mat"
    >>> scipy.io.savemat(file, {"data": {"energy": 0.135}})
    >>> float(read_variable(file, "data")["energy"][0, 0][0, 0])
    0.135
    """
    with _whole(path):
        for reader, element in _variables(path):
            if reader.name(element) == name.encode():
                return reader.value(element)
    expected = f"a struct '{name}' of emittance_gui, or vectors Q2_A, size_x_um, one a column"
    raise InputError(f"no variable '{name}'", expected, path)


def read_vectors(path: str | PathLike[str], without: str = "") -> dict[str, np.ndarray]:
    """Read the variables of a MATLAB file that are vectors of numbers, of two or more each.

    Parameters
    ----------
    path : str or path
        As of `read_variable`.
    without : str
        A variable beside which there are none.

    Returns
    -------
    dict of str to ndarray
        By name; empty if there is the other variable.

    Raises
    ------
    InputError
        As `read_variable`.
    """
    found = {}
    with _whole(path):
        for reader, element in _variables(path):
            name = reader.name(element)
            if name and name == without.encode():
                return {}
            if reader.kind(element) in NUMBERS:
                value = reader.value(element)
                if value.size == max(value.shape, default=0) > 1:
                    found[name.decode("ascii", "replace")] = value.ravel().astype(float)
    return found


@contextmanager
def _whole(path: str | PathLike[str]) -> Iterator[None]:
    """Refuse a file that claims what cannot be."""
    try:
        yield
    except (_Damaged, struct.error, zlib.error, ValueError, OverflowError, MemoryError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"a damaged MATLAB file ({error})"[:120], SAVE, path) from None


def _check_version(content: bytes, path: str | PathLike[str]) -> None:
    if b"\x89HDF\r\n\x1a\n" in (content[:8], content[512:520]):
        raise InputError("a MATLAB file of version 7.3", SAVE, path)
    if len(content) < HEADER + 8 or content[126:128] not in (b"IM", b"MI"):
        raise InputError("no MATLAB file of version 5 to 7", SAVE, path)


def _variables(path: str | PathLike[str]) -> Iterator[tuple[_Reader, _Element]]:
    """The variables of a file, one after the other, and what reads each."""
    content = read_bytes(path, LARGEST, SAVE)
    _check_version(content, path)
    order = "<" if content[126:128] == b"IM" else ">"
    start, left = HEADER, UNPACKED
    while start + 8 <= len(content):
        element, buffer = _element(content, start, len(content), order), content
        start = element.after
        if element.kind == COMPRESSED:
            start = element.end  # which is not padded
            buffer = _unpacked(content[element.start : element.end], left)
            left -= len(buffer)
            element = _element(buffer, 0, len(buffer), order)
        if element.kind == MATRIX:
            yield _Reader(buffer, order), element


def _unpacked(packed: bytes, most: int) -> bytes:
    """Unpack no more than can be a scan: a few kilobytes may claim to be gigabytes."""
    stream = zlib.decompressobj()
    found = stream.decompress(packed, most)
    if stream.unconsumed_tail:
        raise _Damaged(f"more than {UNPACKED // 1_000_000} MB when unpacked")
    if not stream.eof:
        raise _Damaged("cut off")
    return found


def _element(buffer: bytes, start: int, end: int, order: str) -> _Element:
    """The data element at a place, which must end before another."""
    if start + 8 > end:
        raise _Damaged("cut off")
    kind, size = struct.unpack_from(order + "II", buffer, start)
    if kind >> 16:  # up to four bytes, within the tag
        kind, size, first, after = kind & 0xFFFF, kind >> 16, start + 4, start + 8
    else:
        first, after = start + 8, start + 8 + size + (-size) % 8
    if first + size > end or (kind >> 16 and size > 4):
        raise _Damaged("an element that is larger than what holds it")
    return _Element(kind, first, first + size, min(after, end))


class _Reader:
    """Values out of unpacked bytes; what they claim is held against what is there."""

    def __init__(self, buffer: bytes, order: str) -> None:
        self.buffer, self.order, self.seen = buffer, order, 0

    def parts(self, matrix: _Element) -> Iterator[_Element]:
        start = matrix.start
        while start < matrix.end:
            part = _element(self.buffer, start, matrix.end, self.order)
            yield part
            start = part.after

    def integers(self, part: _Element) -> tuple[int, ...]:
        count = (part.end - part.start) // 4
        return struct.unpack_from(f"{self.order}{count}i", self.buffer, part.start)

    def name(self, matrix: _Element) -> bytes:
        parts = self.parts(matrix)
        name = next((part for i, part in enumerate(parts) if i == 2), None)
        if name is None:
            raise _Damaged("an array without a name")
        return self.buffer[name.start : name.end]

    def kind(self, matrix: _Element) -> int | None:
        """The class of an array; None of an empty one, and of complex numbers."""
        flags = next(map(self.integers, self.parts(matrix)), ())
        return None if not flags or flags[0] & COMPLEX else flags[0] & 0xFF

    def value(self, matrix: _Element, depth: int = 0) -> np.ndarray:
        """The array of an element."""
        self.seen += 1
        if self.seen > MOST_ARRAYS or depth > DEEPEST:
            raise _Damaged("more arrays in one another than a scan has")
        if matrix.start == matrix.end:  # how MATLAB writes an empty one
            return np.zeros((0, 0))
        flags, dimensions, _, *rest = [*self.parts(matrix), *[None] * 3]
        rest = [part for part in rest if part is not None]
        if flags is None or dimensions is None or not self.integers(flags):
            raise _Damaged("an array without flags and dimensions")
        flag, shape = self.integers(flags)[0], self.integers(dimensions)
        if not 2 <= len(shape) <= 8 or min(shape) < 0:
            raise _Damaged(f"an array of shape {shape[:4]}")
        kind = flag & 0xFF
        if kind == CELL:
            return self.cells(rest, shape, depth)
        if kind == STRUCT:
            return self.records(rest, shape, depth)
        if kind == CHAR:
            return self.texts(rest, shape)
        if kind in NUMBERS and not flag & COMPLEX:
            return self.numbers(rest, shape)
        raise _Damaged(f"an array of a class ({kind}) that no scan has")

    def cells(self, rest: list[_Element], shape: tuple[int, ...], depth: int) -> np.ndarray:
        if math.prod(shape) != len(rest) or any(part.kind != MATRIX for part in rest):
            raise _Damaged("a cell or struct shorter than it claims")
        found = np.empty(len(rest), object)
        for i, part in enumerate(rest):
            found[i] = self.value(part, depth + 1)
        return found.reshape(shape, order="F")

    def records(self, rest: list[_Element], shape: tuple[int, ...], depth: int) -> np.ndarray:
        if len(rest) < 2 or len(length := self.integers(rest[0])) != 1 or not 0 < length[0] <= 64:
            raise _Damaged("a struct without names of its fields")
        text = self.buffer[rest[1].start : rest[1].end]
        starts = range(0, len(text), length[0])
        names = [text[i : i + length[0]].split(b"\0")[0].decode("ascii", "replace") for i in starts]
        if not names or len(text) % length[0]:
            raise _Damaged("a struct without names of its fields")
        every = self.cells(rest[2:], (len(names), *shape), depth)
        found = np.empty(shape, [(name, object) for name in names])
        for name, values in zip(names, every, strict=True):
            found[name] = values
        return found

    def texts(self, rest: list[_Element], shape: tuple[int, ...]) -> np.ndarray:
        """The lines of a text, which stands column by column."""
        coding = TEXTS.get(rest[0].kind) if rest else None
        if coding is None:
            raise _Damaged("a text without letters")
        ending = "" if coding == "utf-8" else {"<": "-le", ">": "-be"}[self.order]
        letters = self.buffer[rest[0].start : rest[0].end].decode(coding + ending, "replace")
        if len(letters) < math.prod(shape):
            raise _Damaged("a text shorter than it claims")
        rows = shape[0]
        return np.array([letters[i : math.prod(shape) : rows].strip() for i in range(rows)], str)

    def numbers(self, rest: list[_Element], shape: tuple[int, ...]) -> np.ndarray:
        stored = STORED.get(rest[0].kind) if rest else None
        if stored is None:
            raise _Damaged("an array without numbers")
        part = self.buffer[rest[0].start : rest[0].end]
        found = np.frombuffer(part, self.order + stored)
        if len(found) != math.prod(shape):
            raise _Damaged("an array shorter than it claims")
        return found.reshape(shape, order="F")
