"""Atomic writing of files, so that a reader sees the old or the complete new one, and locks."""

from __future__ import annotations

import fcntl
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from os import PathLike
from pathlib import Path
from typing import BinaryIO

from beamfit.errors import InputError

# Temporary files to remove if the process is interrupted.
UNFINISHED: set[str] = set()
NEW_FILE = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW


def check_place(path: str | PathLike[str]) -> None:
    """Check before a calculation that a file can be written.

    Raises
    ------
    InputError
        If the path is that of a folder, a device or a pipe, or its folder does not exist or may
        not be written to.
    """
    target, folder = Path(path), Path(path).parent
    if target.is_dir():
        raise InputError("a folder", "the name of a file", path=path)
    if target.exists() and not target.is_file():
        raise InputError("a device or a pipe", "the name of a file", path=path)
    if not folder.is_dir():
        raise InputError(f"no folder '{folder}'", "a folder that exists", path=path)
    if not os.access(folder, os.W_OK):
        raise InputError(f"folder '{folder}' that may not be written to", "another", path=path)


def write_atomically(path: str | PathLike[str], content: bytes, partial: str | None = None) -> None:
    """Write a file so that a reader sees the old or the complete new one, never a part.

    Parameters
    ----------
    path : str or path
        Target. A symbolic link there is replaced and not followed.
    content : bytes
        New content.
    partial : str, optional
        Name of the temporary file in the same folder; only for callers that hold the `alone` lock.
        All attempts use one name, so that remains of a killed process are overwritten.

    Raises
    ------
    InputError
        If the target cannot be written.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> target = pathlib.Path(tempfile.mkdtemp()) / "note.txt"
    >>> write_atomically(target, b"whole")
    >>> target.read_bytes()
    b'whole'
    """
    with replacing(path, partial) as stream:
        stream.write(content)


@contextmanager
def replacing(path: str | PathLike[str], partial: str | None = None) -> Iterator[BinaryIO]:
    """Open a stream that replaces a file once it is completely written; see `write_atomically`."""
    check_place(path)
    target = Path(path)
    temporary = None
    try:
        if partial is None:
            handle, temporary = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name[:99]}.")
        else:
            temporary_path = target.with_name(partial)
            temporary_path.unlink(missing_ok=True)
            handle, temporary = os.open(temporary_path, NEW_FILE, 0o600), str(temporary_path)
        UNFINISHED.add(temporary)
        with os.fdopen(handle, "w+b") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(temporary, 0o666 & ~umask)
        os.replace(temporary, target)
    except BaseException as error:
        if temporary is not None:
            with suppress(OSError):
                os.unlink(temporary)
        if not isinstance(error, OSError):
            raise
        found = f"a place that cannot be written ({error.strerror})"
        raise InputError(found, "a writable path", path) from None
    finally:
        UNFINISHED.discard(temporary or "")


@contextmanager
def alone(path: str | PathLike[str]) -> Iterator[None]:
    """Lock a file against other runs; the lock ends with the process, however that ends.

    Raises
    ------
    InputError
        If another run has the lock, or it cannot be created next to the file.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> store = pathlib.Path(tempfile.mkdtemp()) / "a.h5"
    >>> with alone(store):
    ...     [file.name for file in store.parent.iterdir()]
    ['.a.h5.lock']
    """
    check_place(path)
    lock = Path(path).with_name(f".{Path(path).name}.lock")
    try:
        handle = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    except OSError as error:
        raise InputError(
            f"no place for '{lock.name}' ({error.strerror})", "a writable path", path
        ) from None
    try:
        _lock(handle, lock, path)
        UNFINISHED.add(str(lock))
        try:
            yield
        finally:
            lock.unlink(missing_ok=True)
            UNFINISHED.discard(str(lock))
    finally:
        os.close(handle)


def _lock(handle: int, lock: Path, path: str | PathLike[str]) -> None:
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        # A lock file that the previous run has just removed does not protect.
        taken = os.stat(lock).st_ino == os.fstat(handle).st_ino
    except (BlockingIOError, FileNotFoundError):
        taken = False
    except OSError:  # a file system without locks: continue unlocked
        taken = True
    if not taken:
        expected = "another name, or wait until that run has ended"
        raise InputError("a file that another run is writing", expected, path)
