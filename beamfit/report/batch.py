"""Page of a batch: the outcome of its files, and a quantity against time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from itertools import islice
from os import PathLike
from pathlib import Path
from urllib.parse import quote

import numpy as np
from matplotlib.figure import FigureBase

from beamfit.answer import MAX_ROWS_SHOWN, Table, plain_name
from beamfit.batch.course import ControlChart, summary_of
from beamfit.batch.run import Batch
from beamfit.errors import Status
from beamfit.quantity import Quantity, display_unit
from beamfit.report.document import (
    RASTER_POINTS,
    Picture,
    ReportPage,
    Verdict,
    control_chart,
    date_axis,
    dates_in,
    legend_below,
)
from beamfit.report.page import write_page, write_report
from beamfit.statistics import THREE_SIGMA

NOTHING = Verdict(
    Status.unidentified,
    "No course to follow",
    "No file gives an answer of this quantity: the reasons are below.",
)
RULE = (
    "Control limits are those of an individuals chart: the mean of the first 20 points (half of "
    "them if there are fewer) ± 3 standard deviations from their mean moving range, Student's "
    "quantile; a point is beyond if it is also 3 of its own errors from the mean."
)


# Number of points per point that noise alone puts beyond the limits: 370.
POINTS_PER_FALSE_ALARM = 1 / (2 * (1 - THREE_SIGMA))


def write_batch_report(
    path: str | PathLike[str],
    batch: Batch,
    courses: Sequence[ControlChart],
    command: str | None = None,
) -> None:
    """Write the page of a batch, and single reports of the points beyond the limits.

    Parameters
    ----------
    path : str or path
        As for `write_report`. At most 40 single reports are written to a folder next to it, named
        after it.
    batch : Batch
        The batch.
    courses : sequence of ControlChart
        Results of `beamfit.batch.course.courses_of`.
    command : str, optional
        The command that made it.

    Raises
    ------
    InputError
        If a file cannot be written.
    """
    target = Path(path)
    beyond = dict.fromkeys(
        file for c in courses for file, off in zip(c.files, c.beyond, strict=True) if off
    )
    folder = target.with_name(f"{target.stem}_reports")
    links = []
    for i, file in enumerate(islice(beyond, MAX_ROWS_SHOWN), start=1):
        folder.mkdir(exist_ok=True)
        single = folder / f"{i:02d}_{Path(file).stem}.html"
        write_report(single, batch.ledger.job.fit(file))
        links.append((file, quote(f"{folder.name}/{single.name}")))
    write_page(target, _page(batch, courses, links), command)


def _page(
    batch: Batch, courses: Sequence[ControlChart], links: list[tuple[str, str]]
) -> ReportPage:
    job = batch.ledger.job
    answers = [[name.replace("_", " "), f"{n}"] for name, n in batch.statuses.items()]
    tables = [summary_of(courses)] if courses else []
    tables.append(Table("Answers", ["status", "answers"], answers, numeric=True))
    for c in courses:
        rows = [
            [file, str(Quantity(value, error, c.unit))]
            for file, value, error, off in zip(c.files, c.value, c.error, c.beyond, strict=True)
            if off
        ]
        title = f"Beyond the control limits: {c.label}"
        tables += _first(Table(title, ["file", plain_name(c.name)], rows))
    rows = [[reason] for reason in batch.refused.values()]
    tables += _first(Table("Without an answer", ["file and reason"], rows))
    pictures = [
        Picture(f"course of {c.label}", 3.0, partial(draw_course, course=c), _source(c, job.kind))
        for c in courses
    ]
    return ReportPage(
        title=f"{job.kind.capitalize()} of {len(batch.files)} files",
        subtitle=", ".join(f"{n} {name.replace('_', ' ')}" for name, n in batch.statuses.items()),
        verdicts=[_verdict(c) for c in courses] or [NOTHING],
        tables=tables,
        pictures=pictures,
        pictures_title="Further courses",
        leading=2,
        notes=(RULE,),
        inputs={} if job.lattice is None else {job.lattice: job.lattice_sha256},
        remarks=[("table", str(batch.ledger.out)), ("options", job.key[1])],
        links=links,
    )


def _first(table: Table) -> list[Table]:
    """Return the first rows of a table, if it has any; the file of answers has all."""
    count = len(table.rows)
    note = f"the first {MAX_ROWS_SHOWN} of {count}; all are in the table of answers"
    shown = table._replace(
        rows=table.rows[:MAX_ROWS_SHOWN], note=note if count > MAX_ROWS_SHOWN else ""
    )
    return [shown] if count else []


def _source(c: ControlChart, kind: str) -> str:
    first, last = (Path(c.files[i]).name for i in (0, -1))
    return (
        f"{kind} of {first}"
        if first == last
        else f"{kind} of {len(c.value)} files, {first} to {last}"
    )


def _verdict(c: ControlChart) -> Verdict:
    beyond, points, middle = int(c.beyond.sum()), len(c.value), float(np.median(c.value))
    status = Status.poor_fit if beyond else Status.converged
    factor, unit = display_unit(abs(c.centre), c.unit)
    if not math.isfinite(c.reach):
        few = f"{points} point{'s are' if points > 1 else ' is'} too few for control limits."
        return Verdict(Status.converged, f"{c.label}: median {c.shown(middle)}", few)
    usual = f"{c.centre / factor:#.4g} ± {c.limit / factor:.2g} {unit}".strip()
    message = f"{beyond} of {points} points lie beyond the control limits"
    message += f"; noise alone passes them in one point of {POINTS_PER_FALSE_ALARM:.0f}."
    return Verdict(status, f"{c.label}: usually {usual}", message)


def draw_course(figure: FigureBase, course: ControlChart) -> None:
    """Draw a quantity against the time in the file names, with control limits.

    Without a time in each name it is drawn against the number of the file.

    Parameters
    ----------
    figure : Figure or SubFigure
        The figure to draw on.
    course : ControlChart
        The quantity through the batch.
    """
    axes, many = figure.subplots(), len(course.value) > RASTER_POINTS
    factor, unit = display_unit(abs(course.centre), course.unit)
    days = [dates_in(Path(file).name) for file in course.files]
    dated = all(days)
    at = np.array([d[0] for d in days], "datetime64[s]") if dated else course.at
    points = at, course.value / factor, None if many else course.error / factor
    limits = course.centre / factor, course.reach / factor
    style = {"ms": 1.5 if many else 3.5, "lw": 0.8, "rasterized": many}
    control_chart(axes, points, course.beyond, limits, ("within", "beyond"), **style)
    axes.set(title=course.label, xlabel="time in the file's name" if dated else "file, number")
    axes.set_ylabel(f"{plain_name(course.name)}, {unit}")
    if dated:
        date_axis(axes)
    else:
        axes.xaxis.get_major_locator().set_params(integer=True)
    legend_below(figure, axes, 3)
