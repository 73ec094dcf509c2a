"""One plane of a scan: the fit, its noise, and the evidence a verdict rests on."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import numpy as np

from beamfit.optics.beamline import Beamline
from beamfit.studies.next_point import (
    best_candidate,
    best_symmetric,
    candidate_settings,
    plausible_sigma,
)
from beamfit.studies.results import Points
from beamfit.studies.robust import fit_robust
from beamfit.studies.sigma import SigmaFit
from beamfit.studies.transport import Derived, PlaneInput, plane_numbers, transfer_rows
from beamfit.studies.verdict import LOST, Evidence, waist_bracketed

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
    scanned: Beamline,
    line: Beamline,
    method: str = "size_squared",
    robust: bool = False,
) -> PlaneWork:
    """Do the arithmetic of one plane.

    Where the file has no errors, every size is taken to have the same relative error, the
    one that makes χ² equal to its degrees of freedom.
    """
    known_noise = given.error is not None
    error = given.error if known_noise else given.size
    numbers = _numbers(given, scanned, line, plane, error, method)
    probability = None
    if robust:
        found = fit_robust(numbers.r11, numbers.r12, given.size, error, numbers.known)
        probability, error = found.outlier_probability, found.error
        numbers = _numbers(given, scanned, line, plane, error, method)
        numbers = numbers._replace(fit=numbers.fit._replace(converged=found.fit.converged))
    fit, dof = numbers.fit, len(given.size) - 3
    unit = 1.0
    if not known_noise:
        unit = math.sqrt(float(fit.chi2) / dof) if dof > 0 else math.nan
    chi2 = float(fit.chi2) if known_noise else float(dof)
    scale = math.sqrt(max(1.0, chi2 / dof)) if dof > 0 else 1.0
    points = Points(
        settings=given.settings,
        screen=tuple(given.screens[i] for i in given.which),
        size=given.size,
        error=error * unit,
        model=numbers.model,
        pull=_pull(given.size, numbers.model, error * unit, method),
        outlier_probability=probability,
        r11=numbers.r11,
        r12=numbers.r12,
        known=numbers.known,
    )
    errors = {
        k: getattr(numbers.derived, k) * unit
        for k in ("start_error", "screen_error", "mismatch_error")
    }
    return PlaneWork(
        plane=plane,
        method=method,
        given=given,
        points=points,
        fit=fit,
        derived=numbers.derived._replace(**errors),
        covariance=fit.covariance * unit**2,
        scale=scale,
        evidence=_evidence(fit, points, chi2, dof, known_noise, scale * unit),
    )


def _numbers(given, scanned, line, plane, error, method):
    """Call the compiled function and bring its arrays to numpy."""
    numbers = plane_numbers(
        scanned,
        line,
        given.settings,
        given.energy,
        given.which,
        given.size,
        error,
        given.energy_spread,
        given.resolution,
        plane=plane,
        screens=given.screens,
        method=method,
    )
    return jax.tree.map(np.asarray, numbers)


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
    weight = 1.0 if points.outlier_probability is None else 1.0 - points.outlier_probability
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
    )


def next_measurement(work: PlaneWork, scanned: Beamline) -> str | None:
    """Say which further setting would help most, if one can be named."""
    e, p = work.evidence, work.points
    nothing_to_build_on = e.misfit > LOST and e.chi2 > e.dof
    if not e.full_rank or not np.isfinite(work.covariance).all() or nothing_to_build_on:
        return None
    covariance = work.covariance * work.scale**2
    start = work.fit.sigma if e.positive else best_symmetric(p)
    sigma = plausible_sigma(start, covariance)
    if sigma is None:
        return None
    rows = []
    for name, table in candidate_settings(work.given.settings):
        n = len(table[name])
        energy, which = np.full(n, work.given.energy.mean()), np.full(n, work.given.which[0])
        r = np.asarray(transfer_rows(scanned, table, energy, which, work.plane, work.given.screens))
        a, b = r[:, 0, 0], r[:, 0, 1]
        rows.append((name, table[name], np.stack([a**2, 2 * a * b, b**2], -1)))
    relative = max(float(np.median(p.error / p.size)) * work.scale, 1e-3)
    found = best_candidate(sigma, covariance, relative, rows)
    if found is None:
        return None
    values = work.given.settings[found.magnet]
    inside = values.min() <= found.setting <= values.max()
    return (
        f"Measure next near {found.magnet} = {found.setting:.3g}, "
        f"{'inside' if inside else 'beyond'} the scanned range: with a size to "
        f"{100 * relative:.2g} % there the emittance error would be about "
        f"{100 * found.relative_error:.0f} %."
    )
