"""From a solved statement to a judged result of each plane, whatever the scenario."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.greybox import assess, tree
from beamfit.greybox.covariance import Group
from beamfit.greybox.fit import Derived, Fit
from beamfit.optics.beamline import Beamline
from beamfit.quantity import Quantity
from beamfit.statistics import scaled_directions
from beamfit.status import Status
from beamfit.studies.scan.assumptions import Anchor, Assumptions
from beamfit.studies.scan.known import next_measurement, pulls, works_of
from beamfit.studies.scan.model import (
    QUANTITIES,
    Asked,
    asked_numbers,
    coefficients,
    predict_sizes,
    size_squared,
    spoken,
)
from beamfit.studies.scan.results import (
    Identifiability,
    Parameter,
    PlaneFit,
    Points,
    ScreenTwiss,
)
from beamfit.studies.scan.statement import Scenario, Seen, asked_of
from beamfit.studies.scan.transport import Look, own_settings, own_units
from beamfit.studies.scan.verdict import (
    BEAM_RULES,
    LOST,
    SCENARIO_RULES,
    Evidence,
    Unknowns,
    cause_of,
    judge,
    phase_coverage,
)
from beamfit.verdict import Finding

__all__ = ["judged_beam", "judged_scenario"]

SIGMA = slice(4, 7)
# What the three numbers of size² alone tell: σ, and the size at the screen.
LINEAR = np.isin(list(QUANTITIES), ("sigma11", "sigma12", "sigma22", "screen_size"))
# Ends of a search that are no answer.
NO_ANSWER = (
    Status.not_finite,
    Status.infeasible,
    Status.not_converged,
    Status.contradictory_bounds,
)
# The noise of a record whose fit was refused.
NOTHING = Group("", slice(0), True, math.nan, 0, 0.0, math.nan)


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


def _plane_fit(seen: Seen, line: Beamline, plane: str, a: Answer) -> PlaneFit:
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


def _beside(seen: Seen) -> dict[str, bool]:
    """Of each plane, whether another one is determined by itself and may vouch for it."""
    clear = {plane: cause_of(w.evidence) is None for plane, w in seen.works.items()}
    return {plane: any(c for p, c in clear.items() if p != plane) for plane in clear}


def judged_beam(seen: Seen) -> tuple[PlaneFit, ...]:
    """Judge each plane of the closed form: nothing but the beam is unknown."""
    beside = _beside(seen)
    return tuple(
        _plane_fit(seen, seen.line, plane, _beam_answer(seen, plane, beside[plane]))
        for plane in seen.planes
    )


def _beam_answer(seen: Seen, plane: str, beside: bool) -> Answer:
    w = seen.works[plane]
    evidence, p = w.evidence._replace(neighbour=beside), w.points
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
        units=np.array(_units(sigma)),
        names=list(QUANTITIES)[SIGMA],
        advice=advice,
    )


def _units(sigma: np.ndarray) -> list[float]:
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


def _numbers(model: Mapping[str, Any], asked: tuple[Asked, ...]) -> Array:
    """`QUANTITIES` of each plane."""
    return jnp.stack([asked_numbers(model, each) for each in asked])


@jax.jit
def _elements(model: Mapping[str, Any], rows: tuple[Any, ...]) -> Array:
    """R11, R12 and known size² of each plane's rows."""
    return jnp.stack([jnp.stack(each.elements(model)) for each in rows])


def judged_scenario(
    seen: Seen,
    line: Beamline,
    scenario: Scenario,
    told: Assumptions,
    fit: Fit,
    parameters: tuple[Parameter, ...],
) -> tuple[PlaneFit, ...]:
    """Judge each plane of a scenario's fit.

    Priors and anchors can make a covariance finite where the sizes are noise or too few to judge.
    So each plane is fitted once more in closed form with the line as the scenario found it, and
    must be determined by the rules of known transport too.
    """
    records = {r.data.plane: r for r in fit.problem.records if r.predict is predict_sizes}
    rows = tuple(records[plane].data for plane in seen.planes)
    whole = scenario.whole_map
    asked = tuple(asked_of(seen, r.plane, whole, r.line if whole else None) for r in rows)
    derived = fit.derive(_numbers, asked)
    elements = np.asarray(_elements(fit.model, rows))
    look, beams = list(seen.look), {}
    for plane, found in zip(seen.planes, elements, strict=True):
        for i in range(3):
            look[i] = look[i].copy()
            look[i]["xy".index(plane)] = found[i]
    again = seen._replace(works=works_of(seen, Look(*look), seen.planes))
    beside, jacobian = _beside(again), _loose_jacobian(fit)
    for i, plane in enumerate(seen.planes):
        own = Derived(*(part[i] for part in derived))
        evidence = again.works[plane].evidence._replace(neighbour=beside[plane])
        points = _points_at(seen, plane, own.value[SIGMA], *elements[i])
        group = next((g for g in fit.groups if g.name == records[plane].name), NOTHING)
        unknowns = _unknowns(seen, scenario, told, fit, parameters, own, group, evidence)
        beams[plane] = _scenario_answer(fit, own, group, unknowns, points, jacobian)
    return tuple(_plane_fit(seen, line, plane, a) for plane, a in beams.items())


def _points_at(seen: Seen, plane: str, sigma: np.ndarray, *elements: np.ndarray) -> Points:
    """The points of the known-transport fit, with this fit's model."""
    r11, r12, known = (part[seen.measured(plane)] for part in elements)
    points = seen.works[plane].points
    model = np.sqrt(np.maximum(size_squared(sigma, r11, r12, known), 0.0))
    pull = pulls(points.size, model, points.error, seen.rows.squared)
    return points._replace(model=model, pull=pull, r11=r11, r12=r12, known=known)


def _unknowns(
    seen: Seen,
    scenario: Scenario,
    told: Assumptions,
    fit: Fit,
    parameters: tuple[Parameter, ...],
    own: Derived,
    group: Group,
    evidence: Evidence,
) -> Unknowns:
    tied, error = told.anchor.words, float(fit.spread.error(np.nan_to_num(own.slope[0])))
    distance = float(own.value[0]) / (2.0 * error) if error > 0 else 0.0
    edges = "".join(
        f"; {p.name} ends at its {p.state} bound {p.value.value:.6g} "
        f"(d(chi2/2)/d(bound) = {p.multiplier:.2g})"
        for p in parameters
        if p.status is Status.at_limit
    )
    left = [p.name for p in parameters if p.status is not Status.converged]
    priors = [p.name for p in parameters if p.prior is not None]
    remark = ""
    if left:
        remark = f" {', '.join(left)} not determined: what depends on it has no error"
        remark += f"{scenario.aside}."
    if priors:
        remark += f" Rests on the prior of {', '.join(priors)}."
    return Unknowns(
        scenario=scenario.name,
        tied=f" with {tied}" if told.anchor != Anchor() else "",
        cause=cause_of(evidence),
        ending=_ending(scenario, told, fit),
        on_data=bool(np.isfinite(own.error[0])),
        distance=distance if math.isfinite(distance) else 0.0,
        chi2=group.chi2,
        dof=group.dof,
        noise_known=evidence.noise_known,
        points_dof=evidence.dof,
        edges=edges,
        remedy=scenario.remedy(seen),
        remark=remark,
    )


def _ending(scenario: Scenario, told: Assumptions, fit: Fit) -> Finding | None:
    """How the search ended, where that was at no optimum."""
    if fit.status is Status.not_converged and scenario.network:
        said = (
            f"The search from {told.starts} starts came to no rest (chi2 = {fit.chi2:.4g}); give "
            "more starts, another seed, or fewer hidden nodes."
        )
        return Finding(fit.status, said)
    if fit.status not in NO_ANSWER:
        return None
    return Finding(fit.status, fit.message[0].upper() + fit.message[1:])


def _scenario_answer(
    fit: Fit, own: Derived, group: Group, u: Unknowns, points: Points, jacobian: np.ndarray
) -> Answer:
    p, theta = fit.problem, fit.theta
    determined = u.clear and u.ending is None and u.cause is None
    error = np.where(determined, own.error, np.nan)
    sigma, slopes = own.value[SIGMA], np.nan_to_num(own.slope[SIGMA])
    beam = {leaf.path for leaf in tree.find_leaves(p.core.model, "beam")}
    further = [
        i
        for i, name in enumerate(p.names)
        if name not in beam and not p.nuisance[i] and p.lower[i] < p.upper[i]
    ]
    asked = np.vstack([slopes, np.eye(len(theta))[further]])
    units = np.array([*_units(sigma), *(abs(theta[i]) or 1.0 for i in further)])
    known = np.isfinite(error[SIGMA]).all()
    return Answer(
        finding=judge(u, SCENARIO_RULES),
        determined=determined,
        value=own.value,
        error=error,
        raw=own.error_raw,
        covariance=slopes @ fit.covariance_raw @ slopes.T if known else np.full((3, 3), np.nan),
        chi2=group.chi2,
        dof=round(group.dof),
        scale=group.scale if group.scale > 0 else 1.0,
        noise="inferred from the fit with known transport",
        distance=u.distance,
        points=points,
        jacobian=_marginal(jacobian, asked, units),
        units=np.ones(len(units)),
        names=[*list(QUANTITIES)[SIGMA], *(spoken(p.names[i]) for i in further)],
    )


def _loose_jacobian(fit: Fit) -> np.ndarray:
    """Residuals by free numbers, errors as scaled, without weights that bounds hold."""
    p = fit.problem
    rows = assess.slopes(p, fit.theta).residual_jacobian.copy()
    for group in fit.groups:
        rows[group.rows] /= group.factor
    edge = np.array([v.state in ("lower", "upper") for v in fit.variables])
    rows[:, (edge & p.nuisance) | (p.lower == p.upper)] = 0.0
    return rows


def _marginal(jacobian: np.ndarray, slopes: np.ndarray, units: np.ndarray) -> np.ndarray:
    """A Jacobian of asked numbers whose normal matrix is their marginal information.

    Free numbers move along the asked ones or, by the rest, along what leaves those as they are;
    what the rest can undo in the residuals is taken out (the Schur complement, by projection).
    """
    scaled = slopes / units[:, None]
    _, sizes, turned = np.linalg.svd(scaled, full_matrices=True)
    rest = jacobian @ turned[len(sizes) :].T
    length = np.linalg.norm(rest, axis=0)
    undone, seen, _ = np.linalg.svd(rest / np.where(length > 0, length, 1.0), full_matrices=False)
    undone = undone[:, seen > 1e-10 * seen.max(initial=0.0)]
    along = jacobian @ np.linalg.pinv(scaled)
    return along - undone @ (undone.T @ along)
