"""Runs commands of beamfit one after the other: JAX is imported and compiled once for all.

A line of JSON {"arguments": [...], "file_size": bytes or null} in, a line {"status": ...} out.
Between commands signals are ignored, as if nobody were there.
"""

from __future__ import annotations

import contextlib
import io
import json
import resource
import signal
import sys

from beamfit import cli
from beamfit.errors import InputError

for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
    signal.signal(number, signal.SIG_IGN)

_, HARD = resource.getrlimit(resource.RLIMIT_FSIZE)


def answer(arguments: list[str], file_size: int | None) -> dict[str, object]:
    """What a command said and with what status it ended; no file may grow beyond a size."""
    said = io.StringIO()
    resource.setrlimit(resource.RLIMIT_FSIZE, (file_size or HARD, HARD))
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            status = cli.cli.main(arguments, prog_name="beamfit", standalone_mode=False) or 0
    except InputError as error:
        status = 2
        said.write(f"beamfit: {error}")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (HARD, HARD))
    return {"status": status, "said": said.getvalue()}


for line in sys.stdin:
    print(json.dumps(answer(**json.loads(line))), flush=True)
