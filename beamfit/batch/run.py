"""Run a batch: fit many files, here or on a Dask cluster, and write the table of answers."""

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
from beamfit.batch.ledger import Ledger
from beamfit.batch.request import check_request, find_files
from beamfit.errors import InputError
from beamfit.writing import alone

if TYPE_CHECKING:
    from distributed import Client

# Files per task: submitting a task takes milliseconds, about as long as fitting a file.
FILES_PER_TASK = 256
# Timeout for the scheduler and for results, s.
TIMEOUT = 10.0


class Batch(NamedTuple):
    """Result of a batch.

    Attributes
    ----------
    files : tuple of str
        All files, in the order of the table.
    new : int
        Number of files fitted in this run; the others were answered before.
    statuses : dict of str to int
        Number of answers with each status.
    refused : dict of str to str
        Reason for each file without an answer.
    ledger : Ledger
        The rows.
    """

    files: tuple[str, ...]
    new: int
    statuses: dict[str, int]
    refused: dict[str, str]
    ledger: Ledger


def run_batch(
    paths: Sequence[str],
    out: str,
    job: Job,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> Batch:
    """Fit many files, and write a table of the answers.

    Parameters
    ----------
    paths : sequence of str
        Files and folders.
    out : str
        The table: ``.csv``, ``.h5`` or ``.parquet``. Answers are kept in ``OUT.parts``, from which
        a run that was stopped, or one with new files, continues.
    job : Job
        The fit of each file.
    workers : int, optional
        Processes of a Dask cluster on this machine; None answers in this process.
    scheduler : str, optional
        Address of a Dask scheduler, such as "tcp://host:8786", whose workers see the files.
    progress : callable
        Called with the number of answered files and the number of all files.

    Returns
    -------
    Batch

    Raises
    ------
    InputError
        If there are no files, the table cannot be written, another run is writing it, or a package
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
    check_request(target, workers, scheduler)
    files = tuple(f for f in find_files(paths, job.kind) if Path(f) != target)
    with alone(target):
        ledger = Ledger(target, job)
        pending = [file for file in files if not ledger.has_answer(file)]
        progress(len(files) - len(pending), len(files))
        tasks = [pending[i : i + FILES_PER_TASK] for i in range(0, len(pending), FILES_PER_TASK)]
        done = len(files) - len(pending)
        for task, text in _answers(job, tasks, workers, scheduler):
            ledger.add_part(text)
            done += len(task)
            progress(done, len(files))
        ledger.write(files)
    places = [ledger.places[file] for file in files]
    statuses = Counter(status for place in places for status in place.statuses)
    refused = {f: p.reason for f, p in zip(files, places, strict=True) if p.reason}
    return Batch(files, len(pending), dict(statuses.most_common()), refused, ledger)


def _answers(
    job: Job, tasks: Sequence[list[str]], workers: int | None, scheduler: str | None
) -> Iterator[tuple[list[str], str]]:
    """Fit tasks, in this process or on a cluster; yield each with its rows when it is completed."""
    if not tasks or (workers is None and scheduler is None):
        yield from ((task, job.answer(task)) for task in tasks)
        return
    import dask
    from distributed import Client, LocalCluster

    # One task per worker: a task queued at a worker counts as lost, too, when the worker dies.
    dask_config = {
        "distributed.scheduler.worker-saturation": 1.0,
        "distributed.worker.profile.enabled": False,  # it samples each worker 100 times per second
        "distributed.admin.tick.interval": "1s",
        "distributed.admin.system-monitor.interval": "10s",
        "distributed.worker.memory.monitor-interval": "5s",
    }
    cluster_options = {"threads_per_worker": 1, "dashboard_address": None, "processes": True}
    cluster_options["silence_logs"] = logging.CRITICAL  # a worker that dies is reported by its file
    with ExitStack() as stack:
        stack.enter_context(dask.config.set(dask_config))
        cluster = scheduler
        if workers is not None:
            cluster = stack.enter_context(LocalCluster(n_workers=workers, **cluster_options))
        try:
            client = stack.enter_context(Client(cluster, timeout=TIMEOUT))
        except OSError:
            raise InputError(f"no scheduler at {scheduler}", "tcp://HOST:PORT of one") from None
        try:
            yield from _distribute(client, job, iter(tasks), workers)
        except CancelledError:
            expected = "one that stays; the same command goes on from here"
            raise InputError("a scheduler that went away", expected) from None


def _distribute(
    client: Client, job: Job, tasks: Iterator[list[str]], workers: int | None
) -> Iterator[tuple[list[str], str]]:
    """Submit tasks, some in advance, and yield the results as they are completed.

    A task that killed several workers is split in two, down to single files; these are tried once
    more at the end, with nothing else running.
    """
    from distributed import KilledWorker, wait

    running: dict[Any, list[str]] = {}
    suspects: list[list[str]] = []
    timeouts = 0

    def hand_out(new_tasks: Iterable[list[str]]) -> bool:
        running.update((client.submit(job.answer, task, pure=False), task) for task in new_tasks)
        return bool(running)

    # Three tasks for each worker, so that none waits for the scheduler.
    hand_out(islice(tasks, 3 * max(len(client.ncores()), 1)))
    while running or hand_out([suspects.pop()] if suspects else []):
        try:
            future = next(iter(wait(list(running), TIMEOUT, "FIRST_COMPLETED").done))
            text = future.result(TIMEOUT)
        except TimeoutError:  # also if the result was lost with its worker
            timeouts = timeouts + 1 if workers and len(client.ncores()) < workers else 0
            if timeouts == 3:  # a worker that dies at its start is not restarted
                client.cluster.scale(len(client.cluster.workers) + 1)
                timeouts = 0
            continue
        except KilledWorker:
            task = running.pop(future)
            half = len(task) // 2
            if half or running:
                hand_out([task[:half], task[half:]] if half else [])
                suspects += [] if half else [task]
                continue
            text = job.refused(task[0], "ended the process that read it")
        else:
            task = running.pop(future)
        yield task, text
        hand_out(islice(tasks, 1))
