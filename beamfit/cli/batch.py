"""`beamfit batch`: answer for many files, with one row per answer."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

import beamfit
from beamfit.answer import Table
from beamfit.batch.request import check_request, find_files
from beamfit.cli.options import Command, Output, command_line, option, options
from beamfit.errors import InputError
from beamfit.writing import check_place

if TYPE_CHECKING:
    from beamfit.batch.run import Batch
    from beamfit.cli.show import Terminal

EXAMPLE = """\b
Examples:
  beamfit batch scans/ --kind emittance --lattice line.toml --out year.parquet --report year.html
  beamfit batch fills/ --kind lifetime --out fills.csv --workers 2
  beamfit batch scans/ --kind emittance --lattice line.toml --out year.h5 --scheduler tcp://host:8786
"""
# Largest number of refusals printed on the terminal; the table has all.
MAX_REFUSALS = 10


@click.command(cls=Command, epilog=EXAMPLE)
@click.argument("path", nargs=-1, required=True)
@option(
    "--kind",
    "Content of the files: quadrupole scans, or records of beam current.",
    choices=["emittance", "lifetime"],
    required=True,
)
@option(
    "--out FILE.parquet|FILE.h5|FILE.csv",
    "The table of answers. An interrupted run continues from FILE.parts.",
    required=True,
)
@option("--workers", "Processes on this machine (Dask).", type=click.IntRange(1))
@option("--scheduler tcp://HOST:PORT", "A Dask scheduler to join.")
@option("--quantity NAME", "Quantity of the report, such as beta or lifetime_mean.")
@option(
    "--learn-noise FILE.toml",
    "Learn the noise of these scans, with its error, and write it for --noise.",
    name="learned",
)
@options("columns ignore skip-bad noise weights maybe-lattice use from to screen energy particle")
@options("report json")
def batch(
    path: tuple[str, ...],
    kind: str,
    out: str,
    workers: int | None,
    scheduler: str | None,
    quantity: str | None,
    learned: str | None,
    noise: str | None,
    weights: str,
    lattice: str | None,
    output: Output,
    **input_options: Any,
) -> None:
    """Fit many scans or records, each on its own, and write one row per answer.

    PATH is a file, or a folder of files. An unusable file gives a row with status "unusable" and
    the reason, and stops nothing. Answers in FILE.parts for the same file, lattice, options and
    version are kept.
    """
    part = {n: input_options[n] for n in ("use", "energy", "particle", "first", "last", "screen")}
    reading = {n: input_options[n] for n in ("columns", "ignore", "skip_bad")}
    _check_kind(kind, {"lattice": lattice, "noise": noise, "learn-noise": learned} | part)
    check_request(Path(out), workers, scheduler)
    find_files(path, kind)

    # JAX from here on
    from beamfit.batch.course import chart_quantity, courses_of, summary_of

    chart_quantity(kind, quantity)  # raises before hours of work if there is no such quantity
    if learned is not None:
        check_place(learned)
    job = beamfit.Job(kind, lattice, part, reading, weights, noise=noise)
    with _progress(shown=not output.as_json) as progress:
        found = beamfit.run_batch(
            path, out, job, workers=workers, scheduler=scheduler, progress=progress
        )
    if learned is not None:
        from beamfit.io.priors import write_noise

        write_noise(learned, job.learned_noise(found.files))
    # The table is read again only if its summary is shown.
    courses = [] if output.as_json and output.report is None else courses_of(found, quantity)
    if output.report is not None:
        from beamfit.report.batch import write_batch_report

        write_batch_report(output.report, found, courses, command_line())
    inputs = {} if lattice is None else {lattice: job.lattice_sha256}
    results = {"table": out, "files": len(found.files), "new": found.new}
    results |= {"statuses": found.statuses, "unusable": found.refused}
    summary = summary_of(courses) if courses else None
    output.answer([results], inputs, lambda t: _show(t, found, out, summary))


def _check_kind(kind: str, of_scans: dict[str, Any]) -> None:
    for name, value in of_scans.items():
        if value is not None and kind != "emittance":
            said = {"first": "from", "last": "to"}.get(name, name)
            raise InputError(f"--{said} with --kind {kind}", "none: it is of the other kind")


@contextmanager
def _progress(shown: bool) -> Iterator[Callable[[int, int], None]]:
    """Show finished files and the remaining time on one line of a terminal."""
    from rich.console import Console
    from rich.progress import MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    screen = Console(stderr=True)
    columns = MofNCompleteColumn(" of "), TextColumn("files, left"), TimeRemainingColumn()
    with Progress(*columns, console=screen, disable=not (shown and screen.is_terminal)) as bar:
        task = bar.add_task("files", total=None)
        yield lambda done, of: bar.update(task, completed=done, total=of)


def _show(terminal: Terminal, found: Batch, out: str, summary: Table | None) -> None:
    before = len(found.files) - found.new
    kept = f", {before} of them before" if before else ""
    terminal.line(f"{len(found.files)} files answered{kept}: {out}", style="bold")
    rows = [[name.replace("_", " "), str(n)] for name, n in found.statuses.items()]
    terminal.table(Table("", ["status", "answers"], rows, numeric=True))
    if summary is not None:
        terminal.line()
        terminal.table(summary._replace(title=""))
    for reason in list(found.refused.values())[:MAX_REFUSALS]:
        terminal.line(reason)
    if (more := len(found.refused) - MAX_REFUSALS) > 0:
        terminal.line(f"{more} more files without an answer are in the table.")
