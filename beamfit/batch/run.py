"""A batch: files in, a table of answers out, in this process or on a Dask cluster."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import ExitStack
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from beamfit.batch.job import Job
from beamfit.batch.ledger import WRITERS, Ledger
from beamfit.errors import InputError
from beamfit.writing import alone, check_place

if TYPE_CHECKING:
    from distributed import Client

# Files in a task: handing out a task costs milliseconds, about as much as fitting a file.
TASK = 256
# Seconds to wait for an answer.
PATIENCE = 10.0
SUFFIXES = {
    "emittance": (".csv", ".txt", ".h5", ".hdf5", ".mat", ".tfs"),
    "lifetime": (".csv", ".txt", ".h5", ".hdf5", ".json"),
}
INSTALL = "the extra: pip install 'beamfit[batch]'"


class Batch(NamedTuple):
    """Result of a batch.

    Attributes
    ----------
    files : tuple of str
        All, in the order of the table.
    new : int
        How many were answered now; the others had been before.
    statuses : dict of str to int
        How many answers have each status.
    refused : dict of str to str
        Why a file has none.
    ledger : Ledger
        Where the rows are.
    """

    files: tuple[str, ...]
    new: int
    statuses: dict[str, int]
    refused: dict[str, str]
    ledger: Ledger


def files_of(paths: Iterable[str], kind: str) -> tuple[str, ...]:
    """Files, and those of a kind in folders and their folders, by name; each once.

    Raises
    ------
    InputError
        If there are none. One that is missing beside others is answered as `unusable`.
    """
    found: dict[str, None] = {}
    for path in paths:
        if Path(path).is_dir():
            inside = sorted(p for p in Path(path).rglob("*") if p.suffix.lower() in SUFFIXES[kind])
            found |= dict.fromkeys(str(p) for p in inside if _is_input(p.relative_to(path)))
        else:
            found[path] = None
    if not any(Path(file).exists() for file in found):
        expected = f"files ending in {', '.join(SUFFIXES[kind])}"
        raise InputError("no files", expected, path=next(iter(paths), None))
    return tuple(found)


def _is_input(inside: Path) -> bool:
    """True if a file in a folder is neither hidden nor a part of an earlier batch."""
    return not any(part.startswith(".") or part.endswith(".parts") for part in inside.parts)


def run_batch(
    paths: Sequence[str],
    out: str,
    job: Job,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> Batch:
    """Answer for many files, and write a table of the answers.

    Parameters
    ----------
    paths : sequence of str
        Files, and folders of files.
    out : str
        The table: ``.csv``, ``.h5`` or ``.parquet``. Parts of it are kept in ``OUT.parts`` as they
        are answered: a run that was stopped goes on from there, and so does one with new files.
    job : Job
        What is asked.
    workers : int, optional
        Processes of a Dask cluster on this machine; None answers in this process.
    scheduler : str, optional
        Address of a Dask scheduler, such as "tcp://host:8786", whose workers see the files.
    progress : callable
        Is told how many files are answered, and of how many.

    Returns
    -------
    Batch

    Raises
    ------
    InputError
        If there are no files, the place cannot be written, another run writes there, or a package
        or the scheduler is missing.

    Examples
    --------
    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> for name in ("a.csv", "b.csv"):
    ...     _ = (folder / name).write_text("Q2_A,size_x_um\\n")
    >>> batch = run_batch([str(folder)], str(folder / "out.csv"), Job("emittance"))
    >>> batch.new, batch.statuses
    (2, {'unusable': 2})
    """
    target = Path(out)
    _check(target, workers, scheduler)
    files = tuple(f for f in files_of(paths, job.kind) if Path(f) != target)
    with alone(target):
        ledger = Ledger(target, job)
        left = [file for file in files if not ledger.answered(file)]
        progress(len(files) - len(left), len(files))
        tasks = [left[i : i + TASK] for i in range(0, len(left), TASK)]
        done = len(files) - len(left)
        for task, text in _answers(job, tasks, workers, scheduler):
            ledger.keep(text)
            done += len(task)
            progress(done, len(files))
        ledger.write(files)
    places = [ledger.places[file] for file in files]
    statuses = Counter(status for place in places for status in place.statuses)
    refused = {f: p.reason for f, p in zip(files, places, strict=True) if p.reason}
    return Batch(files, len(left), dict(statuses.most_common()), refused, ledger)


def _check(out: Path, workers: int | None, scheduler: str | None) -> None:
    """Find out before anything is computed whether it can be done."""
    check_place(out)
    if out.suffix.lower() not in WRITERS:
        raise InputError(f"a table '{out}'", f"a name ending in {', '.join(WRITERS)}")
    if workers is not None and scheduler is not None:
        raise InputError("both workers and a scheduler", "one of them")
    try:
        if out.suffix.lower() == ".parquet":
            import pyarrow.parquet  # noqa: F401
        if workers is not None or scheduler is not None:
            import distributed  # noqa: F401
    except ImportError as error:
        raise InputError(f"no package {error.name}", INSTALL) from None


def _answers(
    job: Job, tasks: Sequence[list[str]], workers: int | None, scheduler: str | None
) -> Iterator[tuple[list[str], str]]:
    if not tasks or (workers is None and scheduler is None):
        yield from ((task, job.answer(task)) for task in tasks)
        return
    import dask
    from distributed import Client, LocalCluster

    # A task that waits at a worker is held for its death, too.
    one_each = {
        "distributed.scheduler.worker-saturation": 1.0,
        "distributed.worker.profile.enabled": False,  # 100 looks a second at each worker
        "distributed.admin.tick.interval": "1s",
        "distributed.admin.system-monitor.interval": "10s",
        "distributed.worker.memory.monitor-interval": "5s",
    }
    own = {"threads_per_worker": 1, "dashboard_address": None, "processes": True}
    own["silence_logs"] = logging.CRITICAL  # what a worker died of is told by its file
    with ExitStack() as stack:
        stack.enter_context(dask.config.set(one_each))
        cluster = scheduler
        if workers is not None:
            cluster = stack.enter_context(LocalCluster(n_workers=workers, **own))
        try:
            client = stack.enter_context(Client(cluster, timeout=PATIENCE))
        except OSError:
            raise InputError(f"no scheduler at {scheduler}", "tcp://HOST:PORT of one") from None
        try:
            yield from _spread(client, job, iter(tasks), workers)
        except CancelledError:
            expected = "one that stays; the same command goes on from here"
            raise InputError("a scheduler that went away", expected) from None


def _spread(
    client: Client, job: Job, tasks: Iterator[list[str]], workers: int | None
) -> Iterator[tuple[list[str], str]]:
    """Hand out tasks, some ahead of the workers, and give what comes back as it does.

    A task that several workers died of is cut in two, until a file is alone; such files are tried
    once more with nothing beside them, at the end.
    """
    from distributed import KilledWorker, wait

    given: dict[Any, list[str]] = {}
    suspects: list[list[str]] = []
    waited = 0

    def hand_out(few: Iterable[list[str]]) -> bool:
        given.update((client.submit(job.answer, task, pure=False), task) for task in few)
        return bool(given)

    # Three tasks for each worker, so that none waits for the scheduler.
    hand_out(islice(tasks, 3 * max(len(client.ncores()), 1)))
    while given or hand_out([suspects.pop()] if suspects else []):
        try:
            future = next(iter(wait(list(given), PATIENCE, "FIRST_COMPLETED").done))
            text = future.result(PATIENCE)
        except TimeoutError:  # also where what was found died with its worker
            waited = waited + 1 if workers and len(client.ncores()) < workers else 0
            if waited == 3:  # one that dies as it starts is not started again
                client.cluster.scale(len(client.cluster.workers) + 1)
                waited = 0
            continue
        except KilledWorker:
            task = given.pop(future)
            half = len(task) // 2
            if half or given:
                hand_out([task[:half], task[half:]] if half else [])
                suspects += [] if half else [task]
                continue
            text = job.refused(task[0], "ended the process that read it")
        else:
            task = given.pop(future)
        yield task, text
        hand_out(islice(tasks, 1))
