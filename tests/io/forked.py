"""The process that reads a file with a library, as a fork: the same bounds for a fiftieth."""

import faulthandler
import os
import pickle
import select
import signal
import subprocess
import time
import warnings
from types import SimpleNamespace

import pytest

from beamfit.io import isolated

ENDED: dict[str, int] = {}


def forked(command: list[str], *, input: bytes, timeout: float, **_: object):
    """Stand in the place of `subprocess.run`."""
    ours, theirs = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # JAX has threads; the fork has nothing to do with them
        child = os.fork()
    if child == 0:
        status = 1
        faulthandler.disable()
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        try:
            with open(theirs, "wb") as stream:
                isolated.run_limited(*pickle.loads(input), stream)
            status = 0
        finally:
            os._exit(status)
    os.close(theirs)
    parts, until = [], time.monotonic() + timeout
    with open(ours, "rb", buffering=0) as stream:
        while select.select([stream], [], [], max(0.0, until - time.monotonic()))[0]:
            if not (part := stream.read(1 << 20)):
                break
            parts.append(part)
        else:
            os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    ended = signal.Signals(os.WTERMSIG(status)).name if os.WIFSIGNALED(status) else None
    if ended is not None:
        late = ended in ("SIGKILL", "SIGXCPU")
        said = "library never ended" if late else "library crashed"
        ENDED[said] = ENDED.get(said, 0) + 1
    if status:
        raise subprocess.CalledProcessError(os.waitstatus_to_exitcode(status), command)
    return subprocess.CompletedProcess(command, 0, b"".join(parts))


SUBPROCESS = SimpleNamespace(**vars(subprocess) | {"run": forked})


@pytest.fixture(scope="module", autouse=True)
def in_forks():
    """Read by libraries in forks of this process, in the modules that import this."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(isolated, "subprocess", SUBPROCESS)
        yield
