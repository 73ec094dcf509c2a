"""Results as tables on a terminal."""

from __future__ import annotations

from rich.table import Table
from rich.text import Text

from beamfit.inference.quantity import Status
from beamfit.studies.results import EmittanceFit, PlaneFit
from beamfit.studies.sensitivity import range_sensitivity, systematics
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
    for label, cells in result_rows(fit):
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
    table = _table(
        "\nIf the line were a little different, the normalised emittance would change by"
    )
    table.add_column("")
    columns = {p.plane: systematics(fit, p.plane) for p in fit.planes}
    causes = list(dict.fromkeys(c.cause for changes in columns.values() for c in changes))
    for plane in columns:
        table.add_column(plane)
    for cause in causes:
        found = [{c.cause: c for c in changes}.get(cause) for changes in columns.values()]
        cells = ["-" if c is None else f"{100 * c.normalized_emittance:+.2f} %" for c in found]
        table.add_row(cause, *cells)
    return table


def range_table(fit: EmittanceFit) -> Table:
    """Lay out the normalised emittance without some of the points."""
    table = _table("\nNormalised emittance from fewer points (shift in standard errors)")
    table.add_column("")
    for p in fit.planes:
        table.add_column(p.plane)
    columns = [{r.left_out: r for r in range_sensitivity(p)} for p in fit.planes]
    for name in dict.fromkeys(n for rows in columns for n in rows):
        cells = []
        for rows in columns:
            row = rows.get(name)
            bad = row is None or row.normalized_emittance != row.normalized_emittance
            shift = "" if bad or row.shift != row.shift else f" ({row.shift:+.1f})"
            cells.append("-" if bad else f"{row.normalized_emittance * 1e6:.3f} µm{shift}")
        table.add_row(name, *cells)
    return table
