"""Results as tables on a terminal."""

from __future__ import annotations

from rich.table import Table
from rich.text import Text

from beamfit.inference.quantity import Status
from beamfit.studies.fit import EmittanceFit
from beamfit.studies.results import PlaneFit
from beamfit.studies.sensitivity import budget_rows, range_rows
from beamfit.studies.tables import result_rows

__all__ = ["budget_table", "range_table", "result_table", "verdict_lines"]

COLOUR = {Status.converged: "green", Status.poor_fit: "yellow"}


def _table(title: str) -> Table:
    return Table(
        title=title,
        title_justify="left",
        title_style="bold",
        box=None,
        pad_edge=False,
        header_style="bold",
    )


def result_table(fit: EmittanceFit) -> Table:
    """Lay out every number, one column a plane."""
    table = _table(f"{fit.scan.name} on {fit.line.name}")
    table.add_column("")
    for p in fit.planes:
        table.add_column(p.plane, no_wrap=True)
    for label, cells in result_rows(fit.planes):
        shown = [
            Text(c, style=f"bold {COLOUR.get(p.status, 'red')}") if label == "status" else Text(c)
            for c, p in zip(cells, fit.planes, strict=True)
        ]
        table.add_row(label, *shown)
    return table


def verdict_lines(plane: PlaneFit) -> Text:
    """Say the verdict of one plane in its colour."""
    text = Text(f"\n{plane.plane}: ", style=f"bold {COLOUR.get(plane.status, 'red')}")
    return text.append(plane.message, style="default not bold")


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
