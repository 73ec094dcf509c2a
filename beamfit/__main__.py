"""The command `beamfit`, also as `python -m beamfit`: handlers installed before other imports."""

import os
import signal
import sys
from contextlib import suppress
from typing import Any

SHOW_CURSOR = b"\x1b[?25h"
# Threads of NumPy's and SciPy's linear algebra, read when these are imported: one, unless the user
# sets them, as for `beamfit.compile_cache.usual_arithmetic`.
THREADS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS")


def _exit_on_signal(number: int, frame: Any) -> None:
    """Exit at once, since foreign code could swallow or print an exception."""
    writing = sys.modules.get("beamfit.writing")
    for path in tuple(getattr(writing, "UNFINISHED", ())):
        with suppress(OSError):
            os.unlink(path)
    screen = 2
    with suppress(AttributeError, OSError, ValueError):  # in live commands it is not descriptor 2
        screen = sys.stderr.fileno()
    with suppress(OSError):
        os.write(screen, (SHOW_CURSOR if os.isatty(screen) else b"") + b"beamfit: interrupted\n")
    os._exit(128 + number)


def main() -> None:
    """Run the command line; Ctrl-C at any moment ends it with one line."""
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, _exit_on_signal)
    for descriptor in range(3):  # a later file must not get the number of a closed standard stream
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    for name in THREADS:
        os.environ.setdefault(name, "1")
    from beamfit.cli import main

    main()


if __name__ == "__main__":
    main()
