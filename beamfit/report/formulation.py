"""Report of a solved formulation: verdict, tables, and outputs against their index."""

from __future__ import annotations

from functools import partial
from math import ceil

import numpy as np
from matplotlib.figure import FigureBase

from beamfit.answer import Table
from beamfit.language.compiled import Computed
from beamfit.language.solution import ProblemSolution
from beamfit.language.text import format_document
from beamfit.report.document import BLUE, MAX_DRAWN, Picture, ReportPage, Verdict


def formulation_page(found: ProblemSolution) -> ReportPage:
    """Make the page of a solution.

    Parameters
    ----------
    found : ProblemSolution
        Result of `beamfit.language.solution.solve_document`.

    Returns
    -------
    ReportPage
    """
    p = found.fit.problem
    titles = ["Variables", *["Constraints"] * bool(found.fit.constraints)]
    titles += ["Outputs"] * bool(found.outputs) + ["Gains"] * bool(found.gains)
    tables = [t._replace(title=name) for name, t in zip(titles, found.tables(), strict=True)]
    if found.notes:
        tables.append(Table("About the document", [], [[note] for note in found.notes]))
    text = format_document(found.made.document).replace("  ", "\xa0\xa0").splitlines()
    tables.append(Table("The document", [], [[line] for line in text if line]))
    drawn = list(_drawn(found))
    pictures = []
    if drawn:
        height = 0.6 + 1.7 * ceil(len(drawn) / 2)
        draw = partial(draw_outputs, found=found)
        pictures = [Picture("outputs by index", height, draw, f"{found.headline}, {found.solver}")]
    goals = "maximised" if found.made.factor < 0 else "minimised"
    called = found.made.document.mapping.name
    sizes = {"variable": len(p.names), "limit": len(p.constraint_names)}
    counts = ", ".join(f"{n} {what}" + "s" * (n != 1) for what, n in sizes.items())
    return ReportPage(
        title=f"Formulation {called}" if called else f"Formulation of {found.name}",
        subtitle=f"{counts}, {goals}",
        verdicts=[
            Verdict(found.status, found.headline, found.message[:1].upper() + found.message[1:])
        ],
        tables=tables,
        pictures=pictures,
        pictures_title="Outputs",
        remarks=[("solver", found.solver)],
    )


def computed_page(found: Computed) -> ReportPage:
    """Make the page of an evaluated mapping."""
    titles = ["Outputs"] + ["Gains"] * bool(found.gains)
    tables = [t._replace(title=name) for name, t in zip(titles, found.tables(), strict=True)]
    counts = f"{len(found.outputs)} outputs"
    return ReportPage(
        title=f"Mapping {found.name}".strip(),
        subtitle=counts,
        verdicts=[],
        tables=tables,
        pictures=[],
        pictures_title="",
    )


def _drawn(found: ProblemSolution):
    """Return the outputs with one dimension: name, elements of the set, values."""
    arrays = found.made.program.scope.outputs
    lines = [(n, arrays[n].dims[0], v) for n, v in found.outputs.items() if v.ndim == 1]
    return lines[:MAX_DRAWN]


def draw_outputs(figure: FigureBase, found: ProblemSolution) -> None:
    """Draw every output with one dimension, each in its own axes.

    Parameters
    ----------
    figure : Figure or SubFigure
        The figure to draw on.
    found : ProblemSolution
        The solution.
    """
    drawn = _drawn(found)
    columns = min(2, len(drawn))
    grid = figure.subplots(ceil(len(drawn) / columns), columns, squeeze=False)
    for axes in grid.flat[len(drawn) :]:
        axes.set_visible(False)
    for axes, (name, over, values) in zip(grid.flat, drawn, strict=False):
        few = values.size <= 60
        axes.plot(over.elements, values, "o-" if few else "-", ms=3, lw=1.0, color=BLUE)
        axes.set(title=name, xlabel=over.name or "index", ylabel="document's unit")
        axes.locator_params(axis="x", integer=True)
        if not np.any(np.isfinite(values)):
            axes.text(0.5, 0.5, "not finite", transform=axes.transAxes, ha="center")
