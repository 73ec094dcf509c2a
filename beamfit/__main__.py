"""The command `beamfit`, also as `python -m beamfit`: what holds before anything is loaded."""

import os
import signal
import sys
from contextlib import suppress
from typing import Any

SHOW_CURSOR = b"\x1b[?25h"


def _stopped(number: int, frame: Any) -> None:
    """End at once: an exception would be lost, or be told, in code that others wrote."""
    writing = sys.modules.get("beamfit.writing")
    for path in tuple(getattr(writing, "UNFINISHED", ())):
        with suppress(OSError):
            os.unlink(path)
    screen = 2
    with suppress(AttributeError, OSError, ValueError):  # live, it is not where libraries print
        screen = sys.stderr.fileno()
    with suppress(OSError):
        os.write(screen, (SHOW_CURSOR if os.isatty(screen) else b"") + b"beamfit: interrupted\n")
    os._exit(128 + number)


def main() -> None:
    """Run the command line; stopped by Ctrl-C at any moment, it says so in one line."""
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, _stopped)
    for descriptor in range(3):  # a file that takes the place of a closed one would be written to
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    from beamfit.cli import main

    main()


if __name__ == "__main__":
    main()
