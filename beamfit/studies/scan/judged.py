"""From a solved statement to a judged result of each plane; here of the closed form."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from beamfit.optics.beamline import Beamline
from beamfit.quantity import Quantity
from beamfit.statistics import scaled_directions
from beamfit.status import Status
from beamfit.studies.scan.known import next_measurement
from beamfit.studies.scan.model import QUANTITIES, coefficients
from beamfit.studies.scan.results import Identifiability, PlaneFit, Points, ScreenTwiss
from beamfit.studies.scan.statement import Seen
from beamfit.studies.scan.transport import own_settings, own_units
from beamfit.studies.scan.verdict import BEAM_RULES, LOST, cause_of, judge, phase_coverage
from beamfit.verdict import Finding

__all__ = ["SIGMA", "Answer", "beside", "judged_beam", "plane_fit", "units_of"]

SIGMA = slice(4, 7)
# What the three numbers of size² alone tell: σ, and the size at the screen.
LINEAR = np.isin(list(QUANTITIES), ("sigma11", "sigma12", "sigma22", "screen_size"))


class Answer(NamedTuple):
    """One plane, solved and judged: numbers in the order of `QUANTITIES`, NaN without an error."""

    finding: Finding
    determined: bool
    value: np.ndarray
    error: np.ndarray
    raw: np.ndarray
    covariance: np.ndarray
    chi2: float
    dof: int
    scale: float
    noise: str
    distance: float
    points: Points
    jacobian: np.ndarray
    units: np.ndarray
    names: list[str]
    advice: str | None = None


def plane_fit(seen: Seen, line: Beamline, plane: str, a: Answer) -> PlaneFit:
    """The result of a plane: errors only for what the data determine."""
    numbers = [
        Quantity(float(v), float(e), unit, float(r))
        if math.isfinite(e)
        else Quantity(float(v), None, unit)
        for v, e, r, unit in zip(a.value, a.error, a.raw, QUANTITIES.values(), strict=True)
    ]
    emittance, normalized, beta, alpha, s11, s12, s22, *screen, mismatch = numbers
    place, p, e = seen.rows.places[-1], a.points, seen.works[plane].evidence
    found = scaled_directions(a.jacobian, a.units, a.names)
    left = found.undetermined
    if not a.determined and "emittance" not in left:
        left = (*left, "emittance")
    return PlaneFit(
        plane=plane,
        status=a.finding.status,
        message=a.finding.message,
        emittance=emittance,
        normalized_emittance=normalized,
        beta=beta,
        alpha=alpha,
        sigma=(s11, s12, s22),
        screen=ScreenTwiss(place, own_settings(line, place), own_units(line, place), *screen),
        mismatch=None if getattr(seen.line.design, plane, None) is None else mismatch,
        chi2=a.chi2 if e.noise_known else None,
        dof=a.dof,
        rms_residual=Quantity(float(np.sqrt(np.mean((p.size - p.model) ** 2))), None, "m"),
        covariance=a.covariance,
        error_scale=a.scale,
        noise="given" if e.noise_known else a.noise,
        method=seen.method,
        identifiability=Identifiability(
            determined=a.determined,
            singular_values=tuple(float(v) for v in found.singular_values),
            condition=found.condition if math.isfinite(found.condition) else None,
            waist_bracketed=e.bracketed,
            phase_coverage=phase_coverage(p.r11, p.r12, float(a.value[2]), float(a.value[3])),
            zero_distance=a.distance,
            undetermined=left,
            next_measurement=a.advice,
        ),
        points=p,
    )


def beside(seen: Seen) -> dict[str, bool]:
    """Of each plane, whether another one is determined by itself and may vouch for it."""
    clear = {plane: cause_of(w.evidence) is None for plane, w in seen.works.items()}
    return {plane: any(c for p, c in clear.items() if p != plane) for plane in clear}


def judged_beam(seen: Seen) -> tuple[PlaneFit, ...]:
    """Judge each plane of the closed form: nothing but the beam is unknown."""
    vouching = beside(seen)
    return tuple(
        plane_fit(seen, seen.line, plane, _beam_answer(seen, plane, vouching[plane]))
        for plane in seen.planes
    )


def _beam_answer(seen: Seen, plane: str, neighbour: bool) -> Answer:
    w = seen.works[plane]
    evidence, p = w.evidence._replace(neighbour=neighbour), w.points
    finding, advice = judge(evidence, BEAM_RULES), None
    determined = finding.status is not Status.unidentified
    if not determined:
        advice = next_measurement(seen, plane)
        finding = judge(evidence._replace(advice=advice), BEAM_RULES)
    finding = finding._replace(remedy=finding.remedy + _outlier_words(p))
    e = evidence
    # The three numbers of size² can be known although the emittance is not.
    linear = determined or (e.full_rank and e.positive and e.misfit <= LOST and e.dof > 0)
    shown = np.isfinite(w.error) & np.where(LINEAR, linear, determined)
    value = w.value if e.positive else np.where(np.arange(len(w.value)) < 2, 0.0, w.value)
    raw = np.where(shown, w.error, np.nan)
    sigma = w.fit.sigma
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 2.0 * p.size * p.error * w.scale
        jacobian = np.stack(coefficients(p.r11, p.r12), -1) / scale[:, None]
    return Answer(
        finding=finding,
        determined=determined,
        value=value,
        error=raw * w.scale,
        raw=raw,
        covariance=w.covariance if linear else np.full((3, 3), np.nan),
        chi2=e.chi2,
        dof=e.dof,
        scale=w.scale,
        noise="inferred from the residuals",
        distance=e.distance,
        points=p,
        jacobian=jacobian,
        units=np.array(units_of(sigma)),
        names=list(QUANTITIES)[SIGMA],
        advice=advice,
    )


def units_of(sigma: np.ndarray) -> list[float]:
    """A change of σ11, σ12 and σ22 by 100 %."""
    return [float(sigma[0]), math.sqrt(max(float(sigma[0] * sigma[2]), 0.0)), float(sigma[2])]


def _outlier_words(p: Points) -> str:
    """Name the points the robust fit doubts."""
    probability = p.outlier_probability
    doubted = [] if probability is None else np.flatnonzero(probability > 0.5)
    if not len(doubted):
        return ""
    places = [
        ", ".join(f"{n} = {v[i]:.4g} {p.units[n]}" for n, v in p.settings.items()) for i in doubted
    ]
    return (
        f" {len(doubted)} of {len(probability)} points more likely outliers than not: "
        + "; ".join(places)
        + "."
    )
