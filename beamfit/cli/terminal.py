"""Results as tables on a terminal."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from rich.table import Table
from rich.text import Text

from beamfit.quantity import Status
from beamfit.studies.scan.fit import EmittanceFit
from beamfit.studies.scan.results import PlaneFit, parameter_rows, result_rows
from beamfit.studies.scan.sensitivity import budget_rows, range_rows

__all__ = [
    "budget_table",
    "plain_table",
    "range_table",
    "result_table",
    "scenario_lines",
    "status_table",
    "verdict_lines",
    "verdict_text",
]

COLOUR = {Status.converged: "green", Status.poor_fit: "yellow"}


def plain_table(title: str) -> Table:
    """Make an empty table in the style of all commands."""
    return Table(
        title=title,
        title_justify="left",
        title_style="bold",
        box=None,
        pad_edge=False,
        header_style="bold",
    )


def status_table(
    title: str, names: Sequence[str], statuses: Sequence[Status], rows: list[tuple[str, list[str]]]
) -> Table:
    """One column a result, the status in its colour."""
    table = plain_table(title)
    # A label cut short says nothing; a number may go on in the next line.
    table.add_column("", no_wrap=True)
    for name in names:
        table.add_column(name, overflow="fold")
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
    return status_table(
        title, [p.plane for p in planes], [p.status for p in planes], result_rows(planes)
    )


def verdict_text(name: str, status: Status, message: str) -> Text:
    """Say a verdict in its colour."""
    text = Text(f"\n{name}: ", style=f"bold {COLOUR.get(status, 'red')}")
    return text.append(message, style="default not bold")


def verdict_lines(plane: PlaneFit) -> Text:
    """Say the verdict of one plane in its colour."""
    return verdict_text(plane.plane, plane.status, plane.message)


def scenario_lines(fit: EmittanceFit) -> Iterator[Table | Text]:
    """Lay out what was fitted besides the beam, and what the data leave open."""
    if fit.parameters:
        table = plain_table("")
        for name in ("Fitted too", "value", "bounds", "prior", "state"):
            table.add_column(name)
        for name, cells in parameter_rows(fit.parameters):
            table.add_row(name, *cells)
        yield table
    for words in fit.null_directions:
        yield Text("Left open: ", style="bold").append(words + ".", style="not bold")
    if fit.statement.network:
        yield Text(f"Anchor: {fit.anchor}.", style="dim")


def budget_table(fit: EmittanceFit) -> Table:
    """Lay out what small errors of the line would do to the normalised emittance."""
    return _by_plane(fit, "Change of the normalised emittance if", budget_rows(fit))


def range_table(fit: EmittanceFit) -> Table:
    """Lay out the normalised emittance without some of the points."""
    return _by_plane(fit, "Normalised emittance (shift in std. errors)", range_rows(fit))


def _by_plane(fit: EmittanceFit, title: str, rows: list[tuple[str, list[str]]]) -> Table:
    table = plain_table("")
    table.add_column(title, no_wrap=True)
    for p in fit.planes:
        table.add_column(p.plane, no_wrap=True)
    for label, cells in rows:
        table.add_row(label, *cells)
    return table
