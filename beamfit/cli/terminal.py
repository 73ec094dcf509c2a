"""Results as tables on a terminal."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from rich.table import Table
from rich.text import Text

from beamfit.inference.quantity import Status
from beamfit.studies.decay_tables import budget_rows as loss_rows
from beamfit.studies.decay_tables import decay_rows, separability_rows, shift_rows
from beamfit.studies.decays import RecordStudy
from beamfit.studies.fit import EmittanceFit
from beamfit.studies.results import PlaneFit
from beamfit.studies.sensitivity import budget_rows, range_rows
from beamfit.studies.shift import Shift
from beamfit.studies.tables import result_rows

__all__ = [
    "budget_table",
    "decay_tables",
    "range_table",
    "result_table",
    "shift_lines",
    "verdict_lines",
]

COLOUR = {Status.converged: "green", Status.poor_fit: "yellow"}
# Decays beside one another in one table.
ABREAST = 2


def _table(title: str) -> Table:
    return Table(
        title=title,
        title_justify="left",
        title_style="bold",
        box=None,
        pad_edge=False,
        header_style="bold",
    )


def _result_table(
    title: str, names: Sequence[str], statuses: Sequence[Status], rows: list[tuple[str, list[str]]]
) -> Table:
    """One column a result, the status in its colour."""
    table = _table(title)
    table.add_column("")
    for name in names:
        table.add_column(name, no_wrap=len(names) < 3)
    for label, cells in rows:
        shown = [
            Text(c, style=f"bold {COLOUR.get(s, 'red')}") if label == "status" else Text(c)
            for c, s in zip(cells, statuses, strict=True)
        ]
        table.add_row(label, *shown)
    return table


def result_table(fit: EmittanceFit) -> Table:
    """Lay out every number, one column a plane."""
    title = f"{fit.scan.name} on {fit.line.name}"
    planes = fit.planes
    return _result_table(
        title, [p.plane for p in planes], [p.status for p in planes], result_rows(planes)
    )


def decay_tables(study: RecordStudy) -> Iterator[Table | Text]:
    """Lay out a record: what was cut away, and every decay with its verdict and budget."""
    yield Text(str(study.record), style="bold")
    if study.events:
        said = "; ".join(str(event) for event in study.events[:8])
        left = len(study.events) - 8
        yield Text(f"Cut at or left out: {said}" + (f"; {left} more" if left > 0 else ""))
    for first in range(0, len(study.decays), ABREAST):
        decays = study.decays[first : first + ABREAST]
        names = [d.fit.record for d in decays]
        statuses = [d.fit.status for d in decays]
        rows = decay_rows(decays) + separability_rows(decays)[:2]
        yield _result_table("", names, statuses, rows)
        for d in decays:
            yield _verdict(d.fit.record, d.fit.status, d.fit.message)
        losses = loss_rows(decays)
        if losses:
            yield _result_table("\nLosses from first principles", names, statuses, losses)
        yield Text("")


def shift_lines(shift: Shift) -> Iterator[Table | Text]:
    """Lay out a study of many decays and its verdicts."""
    fit = shift.fit
    names = [f"{len(fit.names)} decays"]
    yield _result_table("First principles fitted to", names, [fit.status], shift_rows(shift))
    yield _verdict("all decays", fit.status, fit.message)
    yield _verdict("operating point", Status.converged, shift.best.message)
    if shift.anomaly is not None:
        yield _verdict("second half", shift.anomaly.status, shift.anomaly.message)


def _verdict(name: str, status: Status, message: str) -> Text:
    text = Text(f"\n{name}: ", style=f"bold {COLOUR.get(status, 'red')}")
    return text.append(message, style="default not bold")


def verdict_lines(plane: PlaneFit) -> Text:
    """Say the verdict of one plane in its colour."""
    return _verdict(plane.plane, plane.status, plane.message)


def budget_table(fit: EmittanceFit) -> Table:
    """Lay out what small errors of the line would do to the normalised emittance."""
    return _by_plane(fit, "\nChange of the normalised emittance if", budget_rows(fit))


def range_table(fit: EmittanceFit) -> Table:
    """Lay out the normalised emittance without some of the points."""
    return _by_plane(fit, "\nNormalised emittance (shift in std. errors)", range_rows(fit))


def _by_plane(fit: EmittanceFit, title: str, rows: list[tuple[str, list[str]]]) -> Table:
    table = _table("")
    table.add_column(title.strip(), no_wrap=True)
    for p in fit.planes:
        table.add_column(p.plane, no_wrap=True)
    for label, cells in rows:
        table.add_row(label, *cells)
    return table
