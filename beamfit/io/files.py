"""Reading files safely, and digests of what was read."""

from __future__ import annotations

import codecs
import hashlib
import io
import json
import os
import select
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from os import PathLike
from pathlib import Path
from typing import Any, BinaryIO

from beamfit.errors import InputError, plain

# A text line of a scan or a lattice is short; a longer one is another kind of file.
LONGEST_LINE = 100_000
MATLAB = "a MATLAB file", "a text table; writetable(table(time_s, beam_current_mA), 'a.csv')"
# How files begin that are given for text, what they are, and what to do.
SIGNATURES = {
    b"\x89HDF": ("an HDF5 file", "a text file; an HDF5 scan is named .h5"),
    b"PK\x03\x04": ("a spreadsheet or an archive", "a text file; save it as CSV (UTF-8)"),
    b"\xd0\xcf\x11\xe0": ("a spreadsheet", "a text file; save it as CSV (UTF-8)"),
    b"MATLAB 5.0 MAT-file": MATLAB,
    b"MATLAB 7.3 MAT-file": MATLAB,
    b"LabVIEW Measurement": ("a LabVIEW file", "a text table: export it as CSV"),
    b"\x1f\x8b": ("a compressed file", "a text file; unpack it first"),
}
# How text of two bytes a letter begins, such as Excel's "Unicode text".
UTF16 = codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE
# ° ± ² ³ µ in the code pages of Windows, and what needs none.
MARKS, ASCII = "°±²³µ".encode("latin-1"), bytes(range(128))
# Bytes of a lattice of 50 000 elements, and of what is kept in memory at all.
LARGEST_TEXT, LARGEST = 4_000_000, 256_000_000
# Seconds after which a pipe that gives nothing is given up.
SILENCE = 30.0
# What values of other kinds than a document has may raise.
UNLIKE = (ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError)
# SHA-256 of what was last read whole, by path: a file may change after that.
_READ: dict[str, str] = {}
# Digests that are kept: those of a large batch, at 200 bytes each.
MOST_KEPT = 10_000
# Lines of a file, each with its number.
Numbered = Iterator[tuple[int, str]]


@lru_cache(maxsize=8)
def _piped(path: str, inode: int) -> bytes:
    """Content of a pipe: it can be read once, and is looked at several times."""
    parts, size = [], 0
    with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "rb", buffering=0) as stream:
        while select.select([stream], [], [], SILENCE)[0]:
            if not (part := stream.read(1 << 20)):
                return b"".join(parts)
            parts.append(part)
            size += len(part)
            if size > LARGEST:
                found = f"more than {LARGEST // 1_000_000} MB from a pipe"
                raise InputError(found, "a file, for so much", path=path)
    expected = "a program that writes into it, or a file"
    raise InputError(f"a pipe that gives nothing for {SILENCE:.0f} s", expected, path=path)


def _opened(path: str | PathLike[str]) -> BinaryIO:
    """A file or a pipe, open to be read; what else has a name may never end, or never begin."""
    try:
        about = os.stat(path)
        if stat.S_ISFIFO(about.st_mode):
            return io.BytesIO(_piped(os.fspath(path), about.st_ino))
        if not stat.S_ISREG(about.st_mode) and not stat.S_ISDIR(about.st_mode):
            raise InputError("a device or a socket", "a file or a pipe", path=path)
        return open(path, "rb")
    except FileNotFoundError:
        raise InputError("no such file", "a readable file", path=path) from None
    except IsADirectoryError:
        raise InputError("a directory", "a file", path=path) from None
    except InputError:
        raise
    except (OSError, ValueError) as error:  # a name with a zero byte is a ValueError
        cause = getattr(error, "strerror", None) or error
        raise InputError(f"a file that cannot be read ({cause})", "a readable file", path) from None


def text_lines(path: str | PathLike[str]) -> Iterator[str]:
    """Read a text file line by line in bounded memory; `digest` needs no second reading then.

    Parameters
    ----------
    path : str or path
        The file. Lines end with a line feed, a carriage return, or both.

    Yields
    ------
    str
        A line, without its end.

    Raises
    ------
    InputError
        If the file cannot be opened, is empty, is binary, is neither UTF-8 (µ and ° of Windows and
        comments apart) nor UTF-16 with its mark, or has a line longer than any text table has.
    """
    number = 0
    with _opened(path) as stream:
        hashed = _Hashed(stream)
        wide = _start(stream, path).startswith(UTF16)
        form = ("utf-16", "replace") if wide else ("utf-8-sig", "surrogateescape")
        text = io.TextIOWrapper(io.BufferedReader(hashed), *form)
        while line := text.readline(LONGEST_LINE + 1):
            number += 1
            if "\0" in line:
                raise InputError("a binary file", "a text file", path=path, line=number)
            if len(line) > LONGEST_LINE:
                found = f"a line of more than {LONGEST_LINE} characters"
                raise InputError(found, "a text table", path, number)
            yield _decoded(line, path, number).rstrip("\n")
    if number == 0:
        raise InputError("an empty file", "a file with content", path=path)
    remember(path, hashed.seen)


class _Hashed(io.RawIOBase):
    """A stream whose digest is taken as it is read."""

    def __init__(self, stream: BinaryIO) -> None:
        self.stream, self.seen = stream, hashlib.sha256()

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: memoryview) -> int:
        count = self.stream.readinto(buffer)
        self.seen.update(buffer[:count])
        return count


def _start(stream: BinaryIO, path: str | PathLike[str]) -> bytes:
    """Read how a stream begins, and refuse the beginning of a file that is no text."""
    start = stream.read(max(map(len, SIGNATURES)))
    stream.seek(0)
    for signature, (found, expected) in SIGNATURES.items():
        if start.startswith(signature):
            raise InputError(found, expected, path=path, line=1)
    return start


def _decoded(line: str, path: str | PathLike[str], number: int) -> str:
    """A line in which surrogates stand for bytes that are no UTF-8."""
    try:
        line.encode()
        return line
    except UnicodeEncodeError:
        raw = line.encode(errors="surrogateescape")
    # Windows writes µ, ° and the like in one byte; in a comment any letter may be so.
    if raw.lstrip().startswith(b"#") or not raw.translate(None, MARKS + ASCII):
        return raw.decode("cp1252", errors="replace")
    expected = "UTF-8 text; save it as CSV (UTF-8)"
    raise InputError("bytes that are not text", expected, path, number)


def read_text(path: str | PathLike[str]) -> str:
    """Read a whole text file of modest size, such as a lattice.

    Raises
    ------
    InputError
        As `text_lines`, and if the file is larger than any lattice.
    """
    lines, size = [], 0
    for line in text_lines(path):
        lines.append(line)
        size += len(line) + 1
        if size > LARGEST_TEXT:
            found = f"more than {LARGEST_TEXT // 1_000_000} MB of text"
            raise InputError(found, "a lattice file", path)
    return "\n".join(lines) + "\n"


def read_bytes(path: str | PathLike[str], expected: str, most: int = LARGEST) -> bytes:
    """Read a whole file of up to ``most`` bytes.

    Raises
    ------
    InputError
        If the file cannot be read, is empty, or is larger; ``expected`` says what it should be.
    """
    with _opened(path) as stream:
        content = stream.read(most + 1)
    if not content:
        raise InputError("an empty file", "a file with content", path=path)
    if len(content) > most:
        raise InputError(f"more than {most // 1_000_000} MB", expected, path=path)
    remember(path, hashlib.sha256(content))
    return content


def first_bytes(path: str | PathLike[str], count: int) -> bytes:
    """Read how a file begins."""
    with _opened(path) as stream:
        return stream.read(count)


def read_json(path: str | PathLike[str], found: str, expected: str) -> Any:
    """Read a JSON file.

    Raises
    ------
    InputError
        If it cannot be read; with ``found`` and ``expected`` if it does not parse or lies deeper
        in itself than can be followed. An integer of hundreds of digits is infinite.
    """
    content = read_bytes(path, expected)
    with laid_out(path, found, expected):
        return json.loads(content, parse_int=lambda t: int(t) if len(t) < 300 else float(t))


@contextmanager
def laid_out(
    path: str | PathLike[str], found: str, expected: str, *, named: bool = False
) -> Iterator[None]:
    """Refuse a document whose values are of other kinds than those they are taken for here.

    Parameters
    ----------
    path : str or path
        Its file, which is named in every `InputError` from here.
    found, expected : str
        Of the error in the place of any other.
    named : bool
        Whether ``found`` ends with the name of that other error.
    """
    try:
        yield
    except InputError as error:
        error.path = path  # what a value names is where it was from once
        raise
    except UNLIKE as error:
        cause = f" ({type(error).__name__})" if named else ""
        raise InputError(found + cause, expected, path) from None


def remember(path: str | PathLike[str], seen: Any) -> None:
    """Keep the digest of what was read of a file."""
    _READ[os.path.abspath(path)] = seen.hexdigest()
    if len(_READ) > MOST_KEPT:
        del _READ[next(iter(_READ))]


def name_of(path: str | PathLike[str]) -> str:
    """Name of a file in letters that can be shown: names need not be UTF-8."""
    return plain(Path(path).name)


def digest(path: str | PathLike[str]) -> str:
    """SHA-256, as hexadecimal digits: of what was last read of a file, else of what it holds."""
    return _READ.get(os.path.abspath(path)) or digest_now(path)


def digest_now(path: str | PathLike[str]) -> str:
    """SHA-256 of what a file holds at present."""
    with _opened(path) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
