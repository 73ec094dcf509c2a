"""Decay records and shifts as tables on a terminal."""

from __future__ import annotations

from collections.abc import Iterator

from rich.table import Table
from rich.text import Text

from beamfit.cli.terminal import plain_table, status_table, verdict_text
from beamfit.quantity import Status
from beamfit.studies.decay.shift import Shift
from beamfit.studies.decay.study import RecordStudy
from beamfit.studies.decay.tables import (
    FEW,
    alike,
    check_rows,
    decay_rows,
    network_rows,
    overview,
    separability_rows,
    shift_rows,
)
from beamfit.studies.decay.tables import budget_rows as loss_rows

__all__ = ["decay_tables", "shift_lines"]


def decay_tables(study: RecordStudy) -> Iterator[Table | Text]:
    """Lay out a record: what was cut away, and every decay with its verdict and budget."""
    yield Text(str(study.record), style="bold")
    if study.events:
        said = "; ".join(str(event) for event in study.events[:8])
        left = len(study.events) - 8
        yield Text(f"Cut at or left out: {said}" + (f"; {left} more" if left > 0 else ""))
    if len(study.decays) > FEW:
        yield from _many(study)
        return
    for decay in study.decays:
        name, status = decay.fit.record, decay.fit.status
        rows = decay_rows([decay]) + separability_rows([decay])[:2] + check_rows([decay])
        yield status_table("", [name], [status], rows)
        yield verdict_text(name, status, decay.fit.message)
        if decay.checks is not None and decay.checks.constant_a.status is Status.poor_fit:
            yield verdict_text("constant a", Status.poor_fit, decay.checks.constant_a.message)
        if losses := loss_rows([decay]):
            yield status_table("\nLosses from first principles", [name], [status], losses)
        yield Text("")


def _many(study: RecordStudy) -> Iterator[Table | Text]:
    """One row a decay; the name of the record is above."""
    for title, header, rows in overview(study.decays):
        table = plain_table(f"\n{title}")
        for label in header:
            table.add_column(label, no_wrap=label != header[-1])
        for name, *cells in rows:
            table.add_row(name.removeprefix(study.record.name), *cells)
        yield table
    for status, names, message in alike(study.decays):
        yield verdict_text(names, status, message)
    yield Text("")


def shift_lines(shift: Shift) -> Iterator[Table | Text]:
    """Lay out a study of many decays and its verdicts."""
    fit = shift.fit
    names = ["1 decay" if len(fit.names) == 1 else f"{len(fit.names)} decays"]
    yield status_table("First principles fitted to", names, [fit.status], shift_rows(shift))
    yield verdict_text("all decays", fit.status, fit.message)
    yield verdict_text("operating point", Status.converged, shift.best.message)
    if shift.anomaly is not None:
        yield verdict_text("second half", shift.anomaly.status, shift.anomaly.message)
    if shift.network is not None:
        fit = shift.network.fit
        yield status_table("A network of the losses", names, [fit.status], network_rows(shift))
        yield verdict_text("network", fit.status, fit.message)
