"""Reports of an emittance fit, and of the slices of a beam."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import islice
from typing import Any

import numpy as np
from matplotlib.figure import FigureBase

from beamfit.answer import Table, cell, labelled
from beamfit.emittance.fit import EmittanceFit
from beamfit.emittance.results import PlaneFit, degrees, result_rows
from beamfit.emittance.scan import PROJECTED, QuadScan
from beamfit.emittance.size_methods import SizeMethods
from beamfit.emittance.slices import SliceFits
from beamfit.emittance.systematics import budget_rows, range_rows
from beamfit.errors import Status
from beamfit.report.document import MAX_DRAWN, Picture, ReportPage, Verdict, comment_notes
from beamfit.report.scan_pictures import (
    COLOUR,
    FULL_WIDTH,
    PAIR_WIDTH,
    PROFILES_PER_ROW,
    draw_profiles,
    ellipse_picture,
    has_ellipses,
    scan_picture,
    source_of,
)

ERRORS = (
    "Errors are half of the central 68 % of the posterior, the noise averaged over. "
    "“Not determined” means the data put no error on the value; it is not to be quoted."
)
METHODS = (
    "“Measured weights” is emittance_gui's own method, computed here. The error over all methods "
    "has the spread of the methods in it, as a systematic."
)
# Largest number of rows in a table of points.
MAX_ROWS_SHOWN = 500


def emittance_page(fit: EmittanceFit, methods: tuple[SizeMethods, ...] = ()) -> ReportPage:
    """Make the page of an emittance fit.

    Parameters
    ----------
    fit : EmittanceFit
        The fit.
    methods : tuple of SizeMethods
        Results with other size methods.

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
        *(_budgets(fit, names) if fit.statement.closed else fit.tables()[1:]),
        *(Table(f"Points, {p.plane} plane", *point_rows(p), numeric=True) for p in fit.planes),
    ]
    tables += [way.table()._replace(note=METHODS) for way in methods]
    energy = f"{float(line.energy):g} MeV"
    if not fit.statement.closed:
        energy += f", scenario {fit.scenario}"
    return ReportPage(
        title=f"Emittance of {scan.name}",
        subtitle=f"{len(scan)} settings on line {line.name}, {energy}",
        verdicts=[Verdict(p.status, f"{p.plane}: {p.words}", p.message) for p in fit.planes],
        tables=tables + about_input(fit.notes),
        pictures=_pictures(fit),
        pictures_title="Phase space" if not fit.scan.profiles else "Profiles and phase space",
        leading=len(fit.planes),
        **about_scan(scan),
    )


def about_input(notes: Sequence[str]) -> list[Table]:
    """Make a table of notes about the input: oddities, and changes made to its numbers."""
    return [Table("About the input", [], [[note] for note in notes])] if notes else []


def about_scan(scan: QuadScan) -> dict[str, Any]:
    """Return the inputs of a page on a scan, remarks on them, and the comments of the file."""
    source = scan.error_source if scan.error else "none in the file; inferred"
    return {
        "inputs": {str(scan.path): scan.sha256} if scan.path else {},
        "remarks": [("errors of the sizes", source)],
        "notes": comment_notes(scan.provenance),
    }


def _budgets(fit: EmittanceFit, names: list[str]) -> list[Table]:
    """Make tables of the emittance with a changed line and with fewer points."""
    changed = "Relative change of the normalised emittance, from exact derivatives."
    shifted = "Normalised emittance, and its shift in standard errors of the full fit."
    title, other = "If the line were a little different", "If some points were left out"
    return [
        labelled(title, names, budget_rows(fit), changed, numeric=True),
        labelled(other, names, range_rows(fit), shifted),
    ]


def _pictures(fit: EmittanceFit) -> list[Picture]:
    width = FULL_WIDTH if len(fit.planes) == 1 else PAIR_WIDTH
    listed = [scan_picture(fit, p.plane, width) for p in fit.planes]
    for p in fit.planes:
        first = {f.row: f for f in reversed(fit.scan.profiles) if f.plane == p.plane}
        if shown := [first[row] for row in sorted(first)][:MAX_DRAWN]:
            height = 0.6 + 1.3 * math.ceil(len(shown) / PROFILES_PER_ROW)
            draw = partial(draw_profiles, profiles=shown, fit=fit)
            words, source = f"profiles of the {p.plane} plane", source_of(fit)
            listed.append(Picture(words, height, draw, source))
    if any(has_ellipses(p) for p in fit.planes):
        listed.append(ellipse_picture(fit))
    return listed


def identifiability_rows(planes: tuple[PlaneFit, ...]) -> list[tuple[str, list[str]]]:
    """Return rows, with one cell per plane, on what the data determine."""
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
    """Return header and rows of the table of points of one plane.

    Parameters
    ----------
    plane : PlaneFit
        The plane.

    Returns
    -------
    tuple
        Column names, and one list of cells per point.
    """
    p = plane.points
    columns = {"screen": p.screen} if len(set(p.screen)) > 1 else {}
    columns |= {f"{n} {p.units[n]}": map("{:.5g}".format, v) for n, v in p.settings.items()}
    for name, size in (("size", p.size), ("error", p.error), ("fit", p.model)):
        columns[f"{name} µm"] = map("{:.2f}".format, 1e6 * size)
    columns["pull"] = map("{:+.2f}".format, p.pull)
    if (p.outlier_probability > 0.05).any():
        columns["P(bad)"] = map("{:.2f}".format, p.outlier_probability)
    rows = [list(row) for row in islice(zip(*columns.values(), strict=True), MAX_ROWS_SHOWN)]
    left = len(p.size) - len(rows)
    if left > 0:
        rows.append([f"{left} more"] + [""] * (len(columns) - 1))
    return list(columns), rows


FIXED = (
    "Each slice is fitted by its own rows and has a beam matrix of its own; magnets stay as they "
    "are for the line's energy."
)


def slices_page(fits: SliceFits) -> ReportPage:
    """Make the page of the slices of a beam.

    Parameters
    ----------
    fits : SliceFits
        Result of `fit_slices`.

    Returns
    -------
    ReportPage
    """
    scan, line = fits.scan, fits.fits[0].line
    found = [(f"{fit.scan.slices[0]}, {p.plane}", fit, p) for fit in fits for p in fit.planes]
    names, planes = [name for name, _, _ in found], tuple(p for _, _, p in found)
    tables = [table._replace(note=FIXED) for table in fits.tables()]
    tables += [
        labelled("All numbers", names, result_rows(planes), ERRORS),
        labelled("What the data determine", names, identifiability_rows(planes)),
        *(Table(f"Points of slice {n}", *point_rows(p), numeric=True) for n, _, p in found),
        *about_input(fits.notes),
    ]
    source = source_of(replace(fits.fits[0], scan=scan))
    draw = partial(draw_slices, fits=fits)
    pictures = [Picture("emittance of each slice", 3.1, draw, source)]
    pictures += [
        scan_picture(fit, p.plane)._replace(alt=f"scan of slice {name}")
        for name, fit, p in found[:MAX_DRAWN]
    ]
    return ReportPage(
        title=f"Slice emittances of {scan.name}",
        subtitle=f"{len(scan)} rows of {len(fits)} slices on line {line.name}, "
        f"{float(line.energy):g} MeV",
        verdicts=list(_verdicts(fits)),
        tables=tables,
        pictures=pictures,
        pictures_title="Slices, and the scan and fit of each",
        **about_scan(scan),
    )


def _verdicts(fits: SliceFits) -> Iterator[Verdict]:
    """Yield the verdicts of the slices, with equal ones combined."""
    for (plane, status, message), same in fits.alike().items():
        answers = list(same.values())
        words = answers[0].words
        if len(same) > 1:
            words = "normalised emittance not determined"
            values = [p.normalized_emittance for p in answers]
            if all(q.error is not None for q in values):
                low, high = (f(values, key=lambda q: q.value) for f in (min, max))
                words = f"normalised emittance {low} to {high}"
        noun = "slice" if len(same) == 1 else "slices"
        yield Verdict(status, f"{noun} {', '.join(same)}, {plane}: {words}", message)


def draw_slices(figure: FigureBase, fits: SliceFits) -> None:
    """Draw the normalised emittance of each slice, and the projected one as a band.

    Slices without a determined emittance are left out.

    Parameters
    ----------
    figure : Figure or SubFigure
        The figure to draw on.
    fits : SliceFits
        The fits.
    """
    axes = figure.subplots()
    names = [name for name in fits.slices if name != PROJECTED]
    for plane in fits.planes:
        for fit, p in fits.of_plane(plane):
            name, q = fit.scan.slices[0], p.normalized_emittance
            if p.status is Status.unidentified or q.error is None:
                continue
            value, error = 1e6 * q.value, 1e6 * q.error
            if name == PROJECTED:
                axes.axhline(value, color=COLOUR[plane], lw=1.0, ls="--")
                axes.axhspan(value - error, value + error, color=COLOUR[plane], alpha=0.12, lw=0)
            else:
                at = names.index(name)
                axes.errorbar(at, value, error, fmt="o", ms=5, capsize=3, color=COLOUR[plane])
    axes.set_xticks(np.arange(len(names)), names)
    axes.set(xlabel="slice", ylabel="normalised emittance, µm", ylim=(0.0, None))
    said = ", ".join(f"{plane} {'blue' if plane == 'x' else 'red'}" for plane in fits.planes)
    axes.set_title(f"normalised emittance by slice ({said}; dashed: projected)")
