"""Known transport: the fit in closed form, from which every scenario starts and which judges it."""

from __future__ import annotations

import math

import numpy as np

from beamfit.greybox.problem import Problem
from beamfit.optics.beamline import Beamline
from beamfit.optics.calibration import SETTING_UNITS
from beamfit.studies.scan.assumptions import Assumptions
from beamfit.studies.scan.model import coefficients, size_squared
from beamfit.studies.scan.next_point import (
    best_candidate,
    best_symmetric,
    candidate_settings,
    plausible_sigma,
)
from beamfit.studies.scan.results import Points
from beamfit.studies.scan.robust import fit_robust
from beamfit.studies.scan.scans import QuadScan, check_names
from beamfit.studies.scan.sigma import ClosedForm, SigmaFit, SizeData, closed_form
from beamfit.studies.scan.statement import (
    Scenario,
    Seen,
    Work,
    asked_of,
    beam_free,
    beam_numbers,
    size_record,
)
from beamfit.studies.scan.transport import (
    Look,
    look_through,
    names_of,
    scan_rows,
    scanned_line,
    transfer_rows,
)
from beamfit.studies.scan.verdict import LOST, Evidence, waist_bracketed

__all__ = ["SCENARIO", "next_measurement", "pulls", "see", "works_of"]


def see(
    scan: QuadScan,
    line: Beamline,
    planes: tuple[str, ...] | None = None,
    method: str = "size_squared",
    robust: bool = False,
) -> Seen:
    """Look at a scan through its line, and fit it with the line as it is.

    Parameters
    ----------
    scan, line, planes, method, robust
        As for `beamfit.fit_emittance`.

    Returns
    -------
    Seen

    Raises
    ------
    InputError
        If the line lacks a magnet or screen of the scan, or a plane was not measured.
    """
    check_names(scan, *names_of(line))
    asked = planes or scan.planes
    for plane in asked:
        scan.rows(plane)  # says so if it was not measured
    scanned = scanned_line(scan, line)
    rows = scan_rows(scan, scanned, method == "size_squared")
    look = Look(*(np.asarray(part) for part in look_through(rows)))
    seen = Seen(scan, line, asked, method, robust, scanned, rows, look, {})
    # A plane that is not asked for still testifies to the settings and the optics.
    return seen._replace(works=works_of(seen, look, (*asked, *scan.planes)))


def works_of(seen: Seen, look: Look, planes: tuple[str, ...]) -> dict[str, Work]:
    """Fit planes in closed form, given what is seen of them.

    Where the file has no errors, every size is taken to have the same relative error, the
    one that makes χ² equal to its degrees of freedom.
    """
    planes = tuple(dict.fromkeys(planes))
    drawn = {plane: _points(seen, look, plane) for plane in planes}
    found = _closed(seen, look, drawn)
    return {p: _work(seen, p, *drawn[p], found, i) for i, p in enumerate(planes)}


def _points(seen: Seen, look: Look, plane: str) -> tuple[Points, int]:
    """The points of a plane before the fit, and how many a robust fit gives up."""
    scan, at, i = seen.scan, seen.measured(plane), "xy".index(plane)
    size, given = scan.size[plane][at], scan.error.get(plane)
    r11, r12, known = (part[i, at] for part in look[:3])
    error, probability, lost = size if given is None else given[at], None, 0
    if seen.robust:
        doubt = fit_robust(r11, r12, size, error, known, given is not None)
        probability, error = doubt.outlier_probability, doubt.error
        lost = int(np.sum(probability > 0.5))
    points = Points(
        settings={name: v[at] for name, v in scan.settings.items()},
        units={name: SETTING_UNITS[scan.units[name]] for name in scan.settings},
        screen=tuple(seen.rows.places[j] for j in seen.rows.which[at]),
        size=size,
        error=error,
        model=size,
        pull=np.zeros(len(size)),
        outlier_probability=probability,
        r11=r11,
        r12=r12,
        known=known,
    )
    return points, lost


def _closed(seen: Seen, look: Look, drawn: dict[str, tuple[Points, int]]) -> ClosedForm:
    """Both planes in one call; where one was measured, it stands for both."""
    planes = [*drawn, *drawn][:2]
    length = len(seen.rows.energy)
    size, error = np.full((2, length), 1e-4), np.full((2, length), np.inf)
    for i, plane in enumerate(planes):
        points, at = drawn[plane][0], seen.measured(plane)
        size[i, at], error[i, at] = points.size, points.error
    which = ["xy".index(plane) for plane in planes]
    asked = [asked_of(seen, plane) for plane in planes]
    r11, r12, known, to_screen, to_design = (part[which] for part in look)
    found = closed_form(
        SizeData(r11, r12, known, size, error),
        np.array([a.factor for a in asked]),
        to_screen,
        to_design,
        np.array([a.design for a in asked]),
        seen.method,
    )
    return ClosedForm(type(found.fit)(*map(np.asarray, found.fit)), *map(np.asarray, found[1:]))


def _work(seen: Seen, plane: str, points: Points, lost: int, found: ClosedForm, i: int) -> Work:
    fit = type(found.fit)(*(part[i] for part in found.fit))
    noise_known = plane in seen.scan.error
    dof = max(len(points.size) - lost - 3, 0)
    unit = 1.0
    if not noise_known:
        unit = math.sqrt(float(fit.chi2) / dof) if dof > 0 else math.nan
    chi2 = float(fit.chi2) if noise_known else float(dof)
    scale = math.sqrt(max(1.0, chi2 / dof)) if dof > 0 else 1.0
    squared = size_squared(fit.sigma, points.r11, points.r12, points.known)
    model, error = np.sqrt(np.maximum(squared, 0.0)), points.error * unit
    pull = pulls(points.size, model, error, seen.rows.squared)
    points = points._replace(error=error, model=model, pull=pull)
    return Work(
        points=points,
        fit=fit,
        value=found.value[i],
        error=found.error[i] * unit,
        covariance=fit.covariance * unit**2,
        scale=scale,
        evidence=_evidence(fit, points, chi2, dof, noise_known, scale * unit),
    )


def pulls(size: np.ndarray, model: np.ndarray, error: np.ndarray, squared: bool) -> np.ndarray:
    """Residual of the quantity that was fitted, over its error."""
    return (size**2 - model**2) / (2.0 * size * error) if squared else (size - model) / error


def _evidence(
    fit: SigmaFit, points: Points, chi2: float, dof: int, noise_known: bool, unit: float
) -> Evidence:
    """Gather what the verdict rests on; ``unit`` is the factor on the fit's own errors."""
    with np.errstate(invalid="ignore", divide="ignore"):
        determinant = float(fit.determinant / fit.determinant_error / unit)
        zero = math.sqrt(max(float(fit.chi2_zero - fit.chi2), 0.0)) / unit if unit else math.inf
    doubt = points.outlier_probability
    weight = 1.0 if doubt is None else 1.0 - doubt
    relative = (points.model - points.size) / points.size
    return Evidence(
        full_rank=bool(fit.full_rank),
        positive=bool(fit.positive),
        converged=bool(fit.converged),
        chi2=chi2,
        dof=dof,
        noise_known=noise_known,
        determinant_distance=0.0 if math.isnan(determinant) else determinant,
        zero_distance=0.0 if math.isnan(zero) else zero,
        misfit=float(np.sqrt(np.sum(weight * relative**2) / max(dof, 1))),
        bracketed=waist_bracketed(
            points.settings, points.screen, points.size, np.nan_to_num(points.error)
        ),
        smallest_at_end=_smallest_at_end(points),
        swamped=bool((points.known > points.size**2).any()),
        outliers=0.0 if doubt is None else float(np.mean(doubt > 0.5)),
        robust=doubt is not None,
    )


def _smallest_at_end(points: Points) -> bool:
    """Whether one magnet was scanned and its first or last setting gave the smallest size."""
    varied = [v for v in points.settings.values() if np.ptp(v) > 0]
    if len(varied) != 1 or len(set(points.screen)) > 1:
        return False
    return bool(varied[0][np.argmin(points.size)] in (varied[0].min(), varied[0].max()))


def next_measurement(seen: Seen, plane: str) -> str | None:
    """Say which further setting would help most, if one can be named."""
    work = seen.works[plane]
    e, p = work.evidence, work.points
    nothing_to_build_on = e.misfit > LOST or e.swamped or not e.full_rank
    if nothing_to_build_on or not np.isfinite(work.covariance).all():
        return None
    covariance = work.covariance * work.scale**2
    start = work.fit.sigma if e.positive else best_symmetric(p)
    sigma = plausible_sigma(start, covariance)
    if sigma is None:
        return None
    rows, screen = [], seen.rows.places[-1]
    for name, table in candidate_settings(p.settings):
        energy = np.full(len(table[name]), seen.energy(plane))
        matrices = transfer_rows(seen.scanned, table, energy, places=(screen,))
        r = np.asarray(matrices.planes)[:, "xy".index(plane), 0]
        rows.append((name, table[name], np.stack(coefficients(r[:, 0, 0], r[:, 0, 1]), -1)))
    relative = max(float(np.median(p.error / p.size)) * work.scale, 1e-3)
    found = best_candidate(sigma, covariance, relative, rows)
    if found is None:
        return None
    values = p.settings[found.magnet]
    inside = values.min() <= found.setting <= values.max()
    held = [
        f"{n} = {np.median(v):.3g} {p.units[n]}" for n, v in p.settings.items() if n != found.magnet
    ]
    others = f", with {', '.join(held)} at {screen}" if held else ""
    return (
        f"Measure next near {found.magnet} = {found.setting:.3g} {p.units[found.magnet]}, "
        f"{'inside' if inside else 'beyond'} the scanned range{others}: of single points it would "
        "sharpen the emittance most; then judge again."
    )


def _state(seen: Seen, told: Assumptions) -> Problem:
    """The closed form as a problem, starting from its answer, for those who want more than that."""
    beams = beam_numbers(seen)
    records = [size_record(seen, plane, seen.of_plane(plane)) for plane in seen.planes]
    return Problem({"beam": beams}, beam_free(beams), records)


SCENARIO = Scenario("known", _state, closed=True)
