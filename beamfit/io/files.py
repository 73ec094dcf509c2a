"""Read files safely, and keep the digests of what was read."""

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

# Longest line of a text file, in characters: a longer one is of another kind of file.
MAX_LINE = 100_000
MATLAB_TEXT = "a MATLAB file", "a text table; writetable(table(time_s, beam_current_mA), 'a.csv')"
# First bytes of files that are not text -> what they are, and the remedy.
SIGNATURES = {
    b"\x89HDF": ("an HDF5 file", "a text file; an HDF5 scan is named .h5"),
    b"PK\x03\x04": ("a spreadsheet or an archive", "a text file; save it as CSV (UTF-8)"),
    b"\xd0\xcf\x11\xe0": ("a spreadsheet", "a text file; save it as CSV (UTF-8)"),
    b"MATLAB 5.0 MAT-file": MATLAB_TEXT,
    b"MATLAB 7.3 MAT-file": MATLAB_TEXT,
    b"LabVIEW Measurement": ("a LabVIEW file", "a text table: export it as CSV"),
    b"\x1f\x8b": ("a compressed file", "a text file; unpack it first"),
}
# Byte order marks of UTF-16, such as Excel's "Unicode text".
UTF16 = codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE
# Bytes of ° ± ² ³ µ in the code pages of Windows, and those of ASCII.
CP1252_SYMBOLS, ASCII = "°±²³µ".encode("latin-1"), bytes(range(128))
# Largest text file that is read whole (a lattice of 50 000 elements), and largest file, in bytes.
MAX_TEXT_BYTES, MAX_BYTES = 4_000_000, 256_000_000
# A pipe without data is given up after this many seconds.
MAX_SILENCE = 30.0
# Exceptions raised by values of unexpected types or structure.
UNLIKE = (ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError)
# SHA-256 of the content last read, by path: the file may change afterwards.
_DIGESTS: dict[str, str] = {}
# Largest number of digests kept: enough for a large batch, at 200 bytes each.
MAX_DIGESTS = 10_000
# Pairs of line number and line.
NumberedLines = Iterator[tuple[int, str]]


@lru_cache(maxsize=8)
def _read_pipe(path: str, inode: int) -> bytes:
    """Content of a pipe, cached: it can be read only once, but is needed several times."""
    parts, size = [], 0
    with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "rb", buffering=0) as stream:
        while select.select([stream], [], [], MAX_SILENCE)[0]:
            if not (part := stream.read(1 << 20)):
                return b"".join(parts)
            parts.append(part)
            size += len(part)
            if size > MAX_BYTES:
                found = f"more than {MAX_BYTES // 1_000_000} MB from a pipe"
                raise InputError(found, "a file, for so much", path=path)
    expected = "a program that writes into it, or a file"
    raise InputError(f"a pipe that gives nothing for {MAX_SILENCE:.0f} s", expected, path=path)


def _open_binary(path: str | PathLike[str]) -> BinaryIO:
    """Open a file or pipe; devices and sockets, which may never end, are refused."""
    try:
        status = os.stat(path)
        if stat.S_ISFIFO(status.st_mode):
            return io.BytesIO(_read_pipe(os.fspath(path), status.st_ino))
        if not stat.S_ISREG(status.st_mode) and not stat.S_ISDIR(status.st_mode):
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
    """Read a text file line by line in bounded memory, and record its digest.

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
        If the file cannot be opened, is empty or binary, is neither UTF-8 nor UTF-16 with a byte
        order mark, or has a very long line. Comments, and µ, ° and the like, may be in cp1252.
    """
    number = 0
    with _open_binary(path) as stream:
        hashing = _HashingStream(stream)
        is_utf16 = _check_signature(stream, path).startswith(UTF16)
        encoding = ("utf-16", "replace") if is_utf16 else ("utf-8-sig", "surrogateescape")
        text = io.TextIOWrapper(io.BufferedReader(hashing), *encoding)
        while line := text.readline(MAX_LINE + 1):
            number += 1
            if "\0" in line:
                raise InputError("a binary file", "a text file", path=path, line=number)
            if len(line) > MAX_LINE:
                found = f"a line of more than {MAX_LINE} characters"
                raise InputError(found, "a text table", path, number)
            yield _decode_line(line, path, number).rstrip("\n")
    if number == 0:
        raise InputError("an empty file", "a file with content", path=path)
    remember_digest(path, hashing.sha256)


class _HashingStream(io.RawIOBase):
    """Stream that computes the digest of what is read from it."""

    def __init__(self, stream: BinaryIO) -> None:
        self.stream, self.sha256 = stream, hashlib.sha256()

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: memoryview) -> int:
        count = self.stream.readinto(buffer)
        self.sha256.update(buffer[:count])
        return count


def _check_signature(stream: BinaryIO, path: str | PathLike[str]) -> bytes:
    """Return the first bytes of a stream; refuse files that are not text."""
    start = stream.read(max(map(len, SIGNATURES)))
    stream.seek(0)
    for signature, (found, expected) in SIGNATURES.items():
        if start.startswith(signature):
            raise InputError(found, expected, path=path, line=1)
    return start


def _decode_line(line: str, path: str | PathLike[str], number: int) -> str:
    """Decode a line in which surrogates stand for bytes that are not UTF-8."""
    try:
        line.encode()
        return line
    except UnicodeEncodeError:
        raw = line.encode(errors="surrogateescape")
    # Windows writes µ, ° and the like in one byte; a comment may have any such letter.
    if raw.lstrip().startswith(b"#") or not raw.translate(None, CP1252_SYMBOLS + ASCII):
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
        if size > MAX_TEXT_BYTES:
            found = f"more than {MAX_TEXT_BYTES // 1_000_000} MB of text"
            raise InputError(found, "a lattice file", path)
    return "\n".join(lines) + "\n"


def read_bytes(path: str | PathLike[str], expected: str, max_bytes: int = MAX_BYTES) -> bytes:
    """Read a whole file of up to ``max_bytes`` bytes.

    Raises
    ------
    InputError
        If the file cannot be read, is empty, or is larger; ``expected`` is for this message.
    """
    with _open_binary(path) as stream:
        content = stream.read(max_bytes + 1)
    if not content:
        raise InputError("an empty file", "a file with content", path=path)
    if len(content) > max_bytes:
        raise InputError(f"more than {max_bytes // 1_000_000} MB", expected, path=path)
    remember_digest(path, hashlib.sha256(content))
    return content


def first_bytes(path: str | PathLike[str], count: int) -> bytes:
    """Read the first bytes of a file."""
    with _open_binary(path) as stream:
        return stream.read(count)


def read_json(path: str | PathLike[str], found: str, expected: str) -> Any:
    """Read a JSON file.

    Raises
    ------
    InputError
        If the file cannot be read; with ``found`` and ``expected`` if it cannot be parsed or is
        nested too deeply. An integer of hundreds of digits becomes infinite.
    """
    content = read_bytes(path, expected)
    with structure_errors(path, found, expected):
        return json.loads(content, parse_int=lambda t: int(t) if len(t) < 300 else float(t))


@contextmanager
def structure_errors(
    path: str | PathLike[str], found: str, expected: str, *, with_cause: bool = False
) -> Iterator[None]:
    """Turn exceptions due to an unexpected structure of a document into an `InputError`.

    Parameters
    ----------
    path : str or path
        Its file, which is set in every `InputError` of the block.
    found, expected : str
        Message in place of another exception.
    with_cause : bool
        True to add the name of that exception to ``found``.
    """
    try:
        yield
    except InputError as error:
        error.path = path  # the value may name the file it came from originally
        raise
    except UNLIKE as error:
        cause = f" ({type(error).__name__})" if with_cause else ""
        raise InputError(found + cause, expected, path) from None


def remember_digest(path: str | PathLike[str], sha256: Any) -> None:
    """Record the digest of what was read from a file."""
    _DIGESTS[os.path.abspath(path)] = sha256.hexdigest()
    if len(_DIGESTS) > MAX_DIGESTS:
        del _DIGESTS[next(iter(_DIGESTS))]


def name_of(path: str | PathLike[str]) -> str:
    """Printable name of a file; names need not be UTF-8."""
    return plain(Path(path).name)


def digest(path: str | PathLike[str]) -> str:
    """SHA-256 (hexadecimal) of what was last read from a file, or else of its present content."""
    return _DIGESTS.get(os.path.abspath(path)) or digest_now(path)


def digest_now(path: str | PathLike[str]) -> str:
    """SHA-256 (hexadecimal) of the present content of a file."""
    with _open_binary(path) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
