"""The report of an emittance fit: its tables and pictures."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from itertools import islice
from typing import Any

from beamfit.emittance.fit import EmittanceFit
from beamfit.emittance.results import PlaneFit, degrees, parameter_rows, result_rows
from beamfit.emittance.scan import QuadScan
from beamfit.emittance.sensitivity import budget_rows, range_rows
from beamfit.emittance.size_methods import SizeMethods
from beamfit.report.document import MOST_DRAWN, Picture, ReportPage, Verdict, from_head
from beamfit.report.scan_pictures import (
    ABREAST,
    ALONE,
    PROFILES_ABREAST,
    draw_profiles,
    ellipse_picture,
    has_ellipses,
    scan_picture,
    source_of,
    words_of,
)
from beamfit.table import Table, cell, labelled

ERRORS = (
    "Errors are half of the central 68 % of the posterior, the noise averaged over. "
    "“Not determined” means the data put no error on the value; it is not to be quoted."
)
METHODS = (
    "“Measured weights” is emittance_gui's own method, computed here. The error over all methods "
    "has the spread of the methods in it, as a systematic."
)
# Most rows in a table of points.
MOST_ROWS = 500


def emittance_page(fit: EmittanceFit, methods: tuple[SizeMethods, ...] = ()) -> ReportPage:
    """Lay out an emittance fit.

    Parameters
    ----------
    fit : EmittanceFit
        The fit.
    methods : tuple of SizeMethods
        What other ways of taking the sizes say.

    Returns
    -------
    ReportPage
    """
    scan, line = fit.scan, fit.line
    names = [p.plane for p in fit.planes]
    tables = [
        labelled("Result", names, result_rows(fit.planes)).quoted(),
        labelled("All numbers", names, result_rows(fit.planes), ERRORS),
        labelled("What the data determine", names, identifiability_rows(fit.planes)),
        *(_budgets(fit, names) if fit.statement.closed else _fitted_too(fit)),
        *(Table(f"Points, {p.plane} plane", *point_rows(p), numeric=True) for p in fit.planes),
    ]
    tables += [way.table()._replace(note=METHODS) for way in methods]
    energy = f"{float(line.energy):g} MeV"
    if not fit.statement.closed:
        energy += f", scenario {fit.scenario}"
    return ReportPage(
        title=f"Emittance of {scan.name}",
        subtitle=f"{len(scan)} settings on line {line.name}, {energy}",
        verdicts=[Verdict(p.status, f"{p.plane}: {words_of(p)}", p.message) for p in fit.planes],
        tables=tables + about_input(fit.notes),
        pictures=_pictures(fit),
        pictures_title="Phase space" if not fit.scan.profiles else "Profiles and phase space",
        leading=len(fit.planes),
        **about_scan(scan),
    )


def about_input(notes: Sequence[str]) -> list[Table]:
    """Table of notes about the input: oddities, and changes made to its numbers."""
    return [Table("About the input", [], [[note] for note in notes])] if notes else []


def about_scan(scan: QuadScan) -> dict[str, Any]:
    """The inputs of a page on a scan, remarks on them, and what the head of the file says."""
    source = scan.error_source if scan.error else "none in the file; inferred"
    return {
        "inputs": {str(scan.path): scan.sha256} if scan.path else {},
        "remarks": [("errors of the sizes", source)],
        "notes": from_head(scan.provenance),
    }


def _budgets(fit: EmittanceFit, names: list[str]) -> list[Table]:
    """Tables of the emittance with another line and with fewer points."""
    changed = "Relative change of the normalised emittance, from exact derivatives."
    shifted = "Normalised emittance, and its shift in standard errors of the full fit."
    title, other = "If the line were a little different", "If some points were left out"
    return [
        labelled(title, names, budget_rows(fit), changed, numeric=True),
        labelled(other, names, range_rows(fit), shifted),
    ]


def _fitted_too(fit: EmittanceFit) -> list[Table]:
    """Tables of parameters fitted besides the beam, and of undetermined combinations."""
    header, parts = ["parameter", "value", "bounds", "prior", "state"], []
    if rows := parameter_rows(fit.parameters):
        # What ties a network to the lattice; a calibration has priors instead.
        anchor = f"Anchor: {fit.anchor}." if fit.statement.network else ""
        parts.append(Table(f"Scenario {fit.scenario}", header, rows, anchor))
    if fit.null_directions:
        listed = [[words + "."] for words in fit.null_directions]
        parts.append(Table("Not determined by the data", [], listed))
    return parts


def _pictures(fit: EmittanceFit) -> list[Picture]:
    width = ALONE if len(fit.planes) == 1 else ABREAST
    listed = [scan_picture(fit, p.plane, width) for p in fit.planes]
    for p in fit.planes:
        first = {f.row: f for f in reversed(fit.scan.profiles) if f.plane == p.plane}
        if shown := [first[row] for row in sorted(first)][:MOST_DRAWN]:
            height = 0.6 + 1.3 * math.ceil(len(shown) / PROFILES_ABREAST)
            draw = partial(draw_profiles, profiles=shown, fit=fit)
            words, source = f"profiles of the {p.plane} plane", source_of(fit)
            listed.append(Picture(words, height, draw, source))
    if any(has_ellipses(p) for p in fit.planes):
        listed.append(ellipse_picture(fit))
    return listed


def identifiability_rows(
    planes: tuple[PlaneFit, ...],
) -> list[tuple[str, list[str]]]:
    """Label and one cell per plane for what the data determine."""
    rows: list[tuple[str, Callable[[PlaneFit], object]]] = [
        ("emittance", lambda p: "determined" if p.identifiability.determined else "not determined"),
        ("not determined", lambda p: ", ".join(p.identifiability.undetermined) or "nothing"),
        (
            "singular values",
            lambda p: ", ".join(f"{v:.3g}" for v in p.identifiability.singular_values),
        ),
        ("condition", lambda p: _condition(p.identifiability.condition)),
        ("probability of a beam", lambda p: f"{p.identifiability.probability['beam']:.4f}"),
        ("waist bracketed", lambda p: p.identifiability.waist_bracketed),
        ("phase advance covered", lambda p: degrees(p.identifiability.phase_coverage)),
    ]
    return [(label, [cell(value(p)) for p in planes]) for label, value in rows]


def _condition(value: float | None) -> str:
    return "infinite" if value is None else f"{value:.3g}"


def point_rows(plane: PlaneFit) -> tuple[list[str], list[list[str]]]:
    """Header and rows of the point-by-point table of one plane.

    Parameters
    ----------
    plane : PlaneFit
        The plane.

    Returns
    -------
    tuple
        Column names, and one list of cells a point.
    """
    p = plane.points
    columns = {"screen": p.screen} if len(set(p.screen)) > 1 else {}
    columns |= {f"{n} {p.units[n]}": map("{:.5g}".format, v) for n, v in p.settings.items()}
    for name, size in (("size", p.size), ("error", p.error), ("fit", p.model)):
        columns[f"{name} µm"] = map("{:.2f}".format, 1e6 * size)
    columns["pull"] = map("{:+.2f}".format, p.pull)
    if (p.outlier_probability > 0.05).any():
        columns["P(bad)"] = map("{:.2f}".format, p.outlier_probability)
    rows = [list(row) for row in islice(zip(*columns.values(), strict=True), MOST_ROWS)]
    left = len(p.size) - len(rows)
    if left > 0:
        rows.append([f"{left} more"] + [""] * (len(columns) - 1))
    return list(columns), rows
