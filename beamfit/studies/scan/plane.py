"""One plane of a scan: the fit, its noise, and the evidence a verdict rests on."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from beamfit.optics.beamline import Beamline
from beamfit.studies.scan.next_point import (
    best_candidate,
    best_symmetric,
    candidate_settings,
    plausible_sigma,
)
from beamfit.studies.scan.propagation import Derived, derive
from beamfit.studies.scan.results import Points
from beamfit.studies.scan.robust import fit_robust
from beamfit.studies.scan.sigma import SigmaFit, fit_sizes
from beamfit.studies.scan.transport import PlaneInput, transfer_rows
from beamfit.studies.scan.verdict import LOST, Evidence, waist_bracketed

__all__ = ["PlaneWork", "next_measurement", "work_on"]


class PlaneWork(NamedTuple):
    """One plane on its way from numbers to a judged result.

    Attributes
    ----------
    given : PlaneInput
        What was measured.
    points : Points
        Point by point, with the errors as used.
    fit : SigmaFit
        As fitted; its covariance is replaced by ``covariance`` where noise was inferred.
    derived : Derived
        Twiss and mismatch, raw errors for the noise as used.
    covariance : ndarray
        Shape (3, 3), not χ²-scaled.
    scale : float
        sqrt(χ²/dof) where that exceeds 1.
    evidence : Evidence
        For the verdict.
    """

    plane: str
    method: str
    given: PlaneInput
    points: Points
    fit: SigmaFit
    derived: Derived
    covariance: np.ndarray
    scale: float
    evidence: Evidence


def work_on(
    plane: str,
    given: PlaneInput,
    design: tuple[float, float] | None,
    method: str = "size_squared",
    robust: bool = False,
) -> PlaneWork:
    """Do the arithmetic of one plane.

    Where the file has no errors, every size is taken to have the same relative error, the
    one that makes χ² equal to its degrees of freedom.
    """
    known_noise = given.error is not None
    error = given.error if known_noise else given.size
    probability, lost = None, 0
    if robust:
        found = fit_robust(given.r11, given.r12, given.size, error, given.known, known_noise)
        fit, probability, error = found.fit, found.outlier_probability, found.error
        lost = int(np.sum(probability > 0.5))
    else:
        fit = fit_sizes(given.r11, given.r12, given.size, error, given.known, method=method)
    fit = SigmaFit(*(np.asarray(v) for v in fit))
    dof = max(len(given.size) - lost - 3, 0)
    unit = 1.0
    if not known_noise:
        unit = math.sqrt(float(fit.chi2) / dof) if dof > 0 else math.nan
    chi2 = float(fit.chi2) if known_noise else float(dof)
    scale = math.sqrt(max(1.0, chi2 / dof)) if dof > 0 else 1.0
    r11, r12 = given.r11, given.r12
    model = fit.sigma @ np.stack([r11**2, 2.0 * r11 * r12, r12**2]) + given.known
    points = Points(
        settings=given.settings,
        units=given.units,
        screen=given.screen,
        size=given.size,
        error=error * unit,
        model=np.sqrt(np.maximum(model, 0.0)),
        pull=_pull(given.size, np.sqrt(np.maximum(model, 0.0)), error * unit, method),
        outlier_probability=probability,
        r11=r11,
        r12=r12,
        known=given.known,
    )
    covariance = fit.covariance * unit**2
    derived = derive(
        fit.sigma, covariance, given.to_screen, given.to_design, np.array(design or (1.0, 0.0))
    )
    return PlaneWork(
        plane=plane,
        method=method,
        given=given,
        points=points,
        fit=fit,
        derived=Derived(*(np.asarray(v) for v in derived)),
        covariance=covariance,
        scale=scale,
        evidence=_evidence(fit, points, chi2, dof, known_noise, scale * unit),
    )


def _pull(size: np.ndarray, model: np.ndarray, error: np.ndarray, method: str) -> np.ndarray:
    """Residual of the quantity that was fitted, over its error."""
    if method == "size":
        return (size - model) / error
    return (size**2 - model**2) / (2.0 * size * error)


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


def next_measurement(work: PlaneWork, scanned: Beamline) -> str | None:
    """Say which further setting would help most, if one can be named."""
    e, p = work.evidence, work.points
    nothing_to_build_on = e.misfit > LOST or e.swamped or not e.full_rank
    if nothing_to_build_on or not np.isfinite(work.covariance).all():
        return None
    covariance = work.covariance * work.scale**2
    start = work.fit.sigma if e.positive else best_symmetric(p)
    sigma = plausible_sigma(start, covariance)
    if sigma is None:
        return None
    rows = []
    for name, table in candidate_settings(work.given.settings):
        energy = np.full(len(table[name]), work.given.energy.mean())
        matrices = transfer_rows(scanned, table, energy, places=(work.given.last_screen,))
        r = np.asarray(matrices.planes)[:, "xy".index(work.plane), 0]
        a, b = r[:, 0, 0], r[:, 0, 1]
        rows.append((name, table[name], np.stack([a**2, 2 * a * b, b**2], -1)))
    relative = max(float(np.median(p.error / p.size)) * work.scale, 1e-3)
    found = best_candidate(sigma, covariance, relative, rows)
    if found is None:
        return None
    values = work.given.settings[found.magnet]
    inside = values.min() <= found.setting <= values.max()
    held = [
        f"{n} = {np.median(v):.3g} {p.units[n]}" for n, v in p.settings.items() if n != found.magnet
    ]
    others = f", with {', '.join(held)} at {work.given.last_screen}" if held else ""
    return (
        f"Measure next near {found.magnet} = {found.setting:.3g} {p.units[found.magnet]}, "
        f"{'inside' if inside else 'beyond'} the scanned range{others}: of single points it would "
        "sharpen the emittance most; then judge again."
    )
