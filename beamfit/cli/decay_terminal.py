"""Decay records and shifts as tables on a terminal."""

from __future__ import annotations

from collections.abc import Iterator

from rich.table import Table
from rich.text import Text

from beamfit.cli.terminal import status_table, verdict_text
from beamfit.inference.quantity import Status
from beamfit.studies.decay_tables import budget_rows as loss_rows
from beamfit.studies.decay_tables import check_rows, decay_rows, separability_rows, shift_rows
from beamfit.studies.decays import RecordStudy
from beamfit.studies.shift import Shift

__all__ = ["decay_tables", "shift_lines"]

# Decays beside one another in one table.
ABREAST = 2


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
        rows = decay_rows(decays) + separability_rows(decays)[:2] + check_rows(decays)
        yield status_table("", names, statuses, rows)
        for d in decays:
            yield verdict_text(d.fit.record, d.fit.status, d.fit.message)
            if d.checks is not None and d.checks.constant_a.status is Status.poor_fit:
                yield verdict_text("constant a", Status.poor_fit, d.checks.constant_a.message)
        losses = loss_rows(decays)
        if losses:
            yield status_table("\nLosses from first principles", names, statuses, losses)
        yield Text("")


def shift_lines(shift: Shift) -> Iterator[Table | Text]:
    """Lay out a study of many decays and its verdicts."""
    fit = shift.fit
    names = [f"{len(fit.names)} decays"]
    yield status_table("First principles fitted to", names, [fit.status], shift_rows(shift))
    yield verdict_text("all decays", fit.status, fit.message)
    yield verdict_text("operating point", Status.converged, shift.best.message)
    if shift.anomaly is not None:
        yield verdict_text("second half", shift.anomaly.status, shift.anomaly.message)
