"""The report of the slices of a beam: emittance against slice, then each slice's scan."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np
from matplotlib.figure import FigureBase

from beamfit.emittance.results import result_rows
from beamfit.emittance.scan import PROJECTED
from beamfit.emittance.slices import SliceFits
from beamfit.report.document import MOST_DRAWN, Picture, ReportPage, Verdict
from beamfit.report.emittance import (
    ERRORS,
    about_input,
    about_scan,
    identifiability_rows,
    point_rows,
)
from beamfit.report.scan_pictures import COLOUR, scan_picture, source_of, words_of
from beamfit.table import Table, labelled
from beamfit.verdict import Status

FIXED = (
    "Each slice is fitted by its own rows and has a beam matrix of its own; magnets stay as they "
    "are for the line's energy."
)


def slices_page(fits: SliceFits) -> ReportPage:
    """Lay out the fits of the slices of a beam.

    Parameters
    ----------
    fits : SliceFits
        From `fit_slices`.

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
        for name, fit, p in found[:MOST_DRAWN]
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
    """Verdict of each slice, those that say the same together."""
    for (plane, status, message), same in fits.alike().items():
        answers = list(same.values())
        words = words_of(answers[0])
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

    Slices whose emittance the data do not determine are left out.

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
