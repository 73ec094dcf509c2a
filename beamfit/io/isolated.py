"""Files that a library parses, read in a process of its own.

HDF5, SciPy's reader of MATLAB files and SDDS may crash, never end or fill the memory over a file
with a few changed bits. That is one line of error here.
"""

from __future__ import annotations

import os
import pickle
import resource
import signal
import subprocess
import sys
from collections.abc import Callable
from os import PathLike
from pathlib import Path
from typing import Any, BinaryIO

from beamfit.errors import InputError

# Bytes of a file; seconds and bytes of memory that reading it may take.
LARGEST, PATIENCE, ROOM = 256_000_000, 10, 1_000_000_000
# Bytes for which a busy machine may have another second.
MUCH = 10_000_000
CHILD = "from beamfit.io.isolated import answer; answer(0, 1)"
# What a process ended by says that its time was over.
OVER = (-signal.SIGXCPU, -signal.SIGKILL)


def isolated(
    library: str, path: str | PathLike[str], expected: str, read: Callable[..., Any], *given: Any
) -> Any:
    """Call a function that reads a file, in a process with bounds of time and memory.

    Parameters
    ----------
    library : str
        What reads it there, for messages.
    path : str or path
        The file, for messages.
    expected : str
        What it should be.
    read : callable
        A function of a module.
    *given
        Its arguments, such as the content of the file.

    Returns
    -------
    object
        What it gives.

    Raises
    ------
    InputError
        What it raises, with the file; and if the process crashes or comes to its bounds.

    Examples
    --------
    >>> isolated("Python", "a.txt", "a number", float, "2.5")
    2.5
    """
    asked = pickle.dumps((read, given))
    # No filter from a folder of plugins; the package's own libraries, wherever they are.
    own = {"HDF5_PLUGIN_PRELOAD": "::", "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-c", CHILD],
            input=asked,
            capture_output=True,
            env=os.environ | own | {"OPENBLAS_NUM_THREADS": "1"},
            timeout=PATIENCE + len(asked) / MUCH,
            start_new_session=True,
            check=True,
        )
        # The process has this user's rights anyway: what it says may be unpickled.
        found, refused = pickle.loads(done.stdout)
    except (subprocess.TimeoutExpired, subprocess.CalledProcessError) as error:
        late = getattr(error, "returncode", OVER[0]) in OVER
        damaged = f"a file that is not {library}, or is damaged"
        slow = f"a file that {library} does not read within {PATIENCE} s"
        raise InputError(slow if late else damaged, expected, path) from None
    except (pickle.UnpicklingError, EOFError, ValueError, TypeError, IndexError):
        raise InputError(
            f"a damaged file, of which {library} makes nothing", expected, path
        ) from None
    if refused is not None:
        found, expected, place, line, column = refused
        raise InputError(found, expected, place or path, line, column)
    return found


def answer(stdin: int, stdout: int) -> None:
    """Do in this process what `isolated` asks for, and end it."""
    with open(stdin, "rb") as stream:
        read, given = pickle.load(stream)
    with os.fdopen(os.dup(stdout), "wb") as said:
        os.dup2(2, stdout)  # a library may print
        answered(read, given, said)


def answered(read: Callable[..., Any], given: tuple[Any, ...], said: BinaryIO) -> None:
    """Call a function within the bounds, and write what it gives or refuses."""
    pages = Path("/proc/self/statm")
    used = int(pages.read_text().split()[0]) * resource.getpagesize() if pages.exists() else 0
    resource.setrlimit(resource.RLIMIT_AS, (used + ROOM, used + ROOM))
    resource.setrlimit(resource.RLIMIT_CPU, (PATIENCE, PATIENCE))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        found = read(*given), None
    except InputError as error:
        found = None, (error.found, error.expected, error.path, error.line, error.column)
    except MemoryError:
        refused = f"a file that takes more than {ROOM // 1_000_000} MB to read"
        found = None, (refused, "a smaller one", None, None, None)
    pickle.dump(found, said, protocol=pickle.HIGHEST_PROTOCOL)
