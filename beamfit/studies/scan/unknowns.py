"""The judgement of a scenario's fit, in which more than the beam is unknown, and its rules."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.compile_cache import SELDOM
from beamfit.greybox.covariance import Group
from beamfit.greybox.fit import Derived, Fit
from beamfit.greybox.problem import Problem
from beamfit.greybox.solve import solve
from beamfit.optics.beamline import Beamline
from beamfit.statistics import POOR_FIT, few_words, scaled_directions
from beamfit.status import Status
from beamfit.studies.scan.assumptions import Anchor, Assumptions
from beamfit.studies.scan.judged import SIGMA, Answer, plane_fit, units_of
from beamfit.studies.scan.known import in_closed_form, pulls
from beamfit.studies.scan.model import (
    QUANTITIES,
    Asked,
    asked_numbers,
    size_squared,
    spoken,
)
from beamfit.studies.scan.results import Parameter, PlaneFit, Points
from beamfit.studies.scan.statement import Scenario, Seen, asked_in, size_record, size_records
from beamfit.studies.scan.systematics import effects_of
from beamfit.studies.scan.transport import Look
from beamfit.studies.scan.verdict import CLEAR, cause_of
from beamfit.verdict import Finding, judge


class Unknowns(NamedTuple):
    """What tells whether sizes determine a beam when more than the beam is unknown.

    Attributes
    ----------
    scenario, tied : str
        Its name, and what ties it to first principles, in words.
    cause : str or None
        What keeps sizes from determining a beam even if the line were as found (`cause_of`).
    ending : Finding or None
        How the search ended, where that was no answer.
    on_data : bool
        Whether the error of the emittance rests on data and priors, not on bounds.
    distance : float
        Standard errors between det σ and zero.
    group : Group
        The noise of the plane's own sizes.
    probability : float or None
        Of their χ².
    rests_on : float
        Degrees of freedom of the errors as scaled.
    edges, remedy, remark : str
        Numbers that end on bounds; what is needed; what else is open or rests on priors.
    """

    scenario: str
    tied: str
    cause: str | None
    ending: Finding | None
    on_data: bool
    distance: float
    group: Group
    probability: float | None
    rests_on: float
    edges: str
    remedy: str
    remark: str

    @property
    def clear(self) -> bool:
        """Whether the emittance is known and clearly not zero."""
        return self.on_data and self.distance >= CLEAR


def _refuted_by_sizes(u: Unknowns) -> Finding | None:
    """Priors and anchors can make a covariance finite where the sizes are noise or too few."""
    if not u.clear or u.ending is not None or u.cause is None:
        return None
    said = f"Not determined in scenario {u.scenario}: {u.cause}."
    return Finding(Status.unidentified, said)


def _no_answer(u: Unknowns) -> Finding | None:
    """What the data do not determine has no optimum to settle in: that comes first."""
    if u.ending is None or (not u.clear and u.ending.status is Status.not_converged):
        return None
    return u.ending


def _left_open(u: Unknowns) -> Finding | None:
    if u.clear and u.ending is None:
        return None
    why = (
        f"zero emittance lies only {u.distance:.1f} standard errors away"
        if u.on_data
        else "its value is decided by bounds and starting point, not by the data"
    )
    said = f"Not determined in scenario {u.scenario}{u.tied}: {why}{u.edges}."
    return Finding(Status.unidentified, said, f"Needed: {u.remedy}." if u.remedy else "")


def _determined(u: Unknowns) -> Finding:
    said = (
        f"Determined in scenario {u.scenario}{u.tied}: zero emittance is {u.distance:.0f} standard "
        f"errors away{few_words(u.rests_on)}.{u.remark}"
    )
    if u.probability is None or u.probability >= POOR_FIT:
        return Finding(Status.converged, said)
    ratio = u.group.chi2 / u.group.dof
    poor = f"Poor fit: chi2/dof = {ratio:.2g}; the sizes' errors are scaled by"
    return Finding(Status.poor_fit, f"{poor} {math.sqrt(ratio):.1f}. {said}")


# Of sizes when more than the beam is unknown.
SCENARIO_RULES = (_refuted_by_sizes, _no_answer, _left_open, _determined)


# Ends of a search that are no answer.
NO_ANSWER = (Status.not_finite, Status.infeasible, Status.not_converged)
NO_ANSWER += (Status.contradictory_bounds,)
# How often errors are taken anew at most, and what change of them no longer matters.
ROUNDS, SAME = 3, 1e-2
# The noise of a record whose fit was refused.
NOTHING = Group("", slice(0), True, math.nan, 0, 0.0, math.nan)


def _numbers(model: Mapping[str, Any], asked: tuple[Asked, ...]) -> Array:
    """`QUANTITIES` of each plane."""
    return jnp.stack([asked_numbers(model, each) for each in asked])


@partial(jax.jit, compiler_options=SELDOM)
def _elements(model: Mapping[str, Any], rows: tuple[Any, ...]) -> Array:
    """R11, R12 and known size² of each plane's rows."""
    return jnp.stack([jnp.stack(each.elements(model)) for each in rows])


def settled_fit(seen: Seen, scenario: Scenario, told: Assumptions) -> tuple[Fit, Seen]:
    """Solve, and again with errors taken at the fitted sizes, until these change no more.

    Where the line was wrong, so were the sizes that known transport weighed by, the noise it saw in
    its residuals, and the points it doubted. What is seen in the end is closed forms through the
    line as found.
    """
    fit = _solved(scenario.state(seen, told), scenario, told)
    found = _through(seen, fit)
    for _ in range(ROUNDS):
        old = size_records(fit.problem)
        new = {r.name: size_record(found, plane, r.data) for plane, r in old.items()}
        if all(np.allclose(new[r.name].error, r.error, rtol=SAME) for r in old.values()):
            break
        records = tuple(new.get(r.name, r) for r in fit.problem.records)
        again = solve(replace(fit.problem, model=fit.model, records=records))
        # The search is the first one; the few steps from its end are told with it.
        said = fit.message if again.status is fit.status else again.message
        fit = replace(again, attempts=(*fit.attempts, *again.attempts), message=said)
        found = _through(seen, fit)
    return fit, found


def _solved(problem: Problem, scenario: Scenario, told: Assumptions) -> Fit:
    """Solve, a network from many starts, and so whatever one start may have led astray.

    A beam of no emittance is a stationary point of every fit in its Cholesky factor, so a start
    near it (the known-transport fit with a wrong calibration, say) may never leave it.
    """
    fit = solve(problem, told.starts if scenario.network else 1, told.seed)
    flat = any(fit[f"beam.{plane}.l22"].state == "lower" for plane in problem.model["beam"])
    lost = fit.status is not Status.converged and fit.chi2 > 2.0 * max(fit.dof, 1)
    if (flat or lost) and not scenario.network:
        fit = solve(problem, told.starts, told.seed)
    return fit


def _through(seen: Seen, fit: Fit) -> Seen:
    """See the scan through the line as a fit found it: each plane fitted in closed form."""
    records = size_records(fit.problem)
    elements = np.asarray(_elements(fit.model, tuple(records[p].data for p in seen.planes)))
    look = np.array(seen.look[:3])
    look[:, ["xy".index(plane) for plane in seen.planes]] = np.swapaxes(elements, 0, 1)
    noises = {plane: seen.noises[plane] for plane in seen.planes}
    look = Look(*look, *seen.look[3:])
    [again] = in_closed_form([seen._replace(look=look, noises=noises)])
    return seen._replace(works=seen.works | again.works)


def judged_scenario(
    fit: Fit,
    seen: Seen,
    line: Beamline,
    scenario: Scenario,
    told: Assumptions,
    parameters: tuple[Parameter, ...],
) -> tuple[PlaneFit, ...]:
    """Judge each plane of a scenario's fit.

    Priors and anchors can make a covariance finite where the sizes are noise or too few to judge.
    So each plane must be determined by the rules of known transport too, with the line as the
    scenario found it.
    """
    records = size_records(fit.problem)
    derived = fit.derive(_numbers, asked_in(fit.problem, seen, seen.planes, scenario.whole_map))
    jacobian, beams = _loose_jacobian(fit), []
    for i, plane in enumerate(seen.planes):
        own = Derived(*(part[i] for part in derived))
        group = next((g for g in fit.groups if g.name == records[plane].name), NOTHING)
        unknowns = _unknowns(seen, plane, scenario, told, fit, parameters, own, group)
        points = _points_at(seen, plane, own.value[SIGMA])
        answer = _scenario_answer(fit, own, unknowns, points, jacobian)
        if told.systematics:
            answer = answer._replace(holds="statistics, systematics")
        beams.append(plane_fit(seen, line, plane, answer))
    return tuple(beams)


def _points_at(seen: Seen, plane: str, sigma: np.ndarray) -> Points:
    """The points of the closed form, with this fit's model."""
    p = seen.works[plane].points
    p = p._replace(model=np.sqrt(np.maximum(size_squared(sigma, p.r11, p.r12, p.known), 0.0)))
    return p._replace(pull=pulls(p, seen.rows.squared))


def _unknowns(
    seen: Seen,
    plane: str,
    scenario: Scenario,
    told: Assumptions,
    fit: Fit,
    parameters: tuple[Parameter, ...],
    own: Derived,
    group: Group,
) -> Unknowns:
    noise, tied = seen.noises[plane], told.anchor.words
    error = float(fit.spread.error(np.nan_to_num(own.slope[0])))
    held = _held(fit) is not None
    distance = float(own.value[0]) / (2.0 * error) if error > 0 and not held else 0.0
    edges = "".join(
        f"; {p.name} ends at its {p.state} bound {p.value.value:.6g} "
        f"(d(chi2/2)/d(bound) = {p.multiplier:.2g})"
        for p in parameters
        if p.status is Status.at_limit
    )
    effects = effects_of(fit, told, float(own.value[1]), np.nan_to_num(own.slope[1]))
    rests_on = noise.rests_on(group.chi2, group.dof)
    return Unknowns(
        scenario=scenario.name,
        tied=f" with {tied}" if told.anchor != Anchor() else "",
        cause=cause_of(seen.works[plane].evidence),
        ending=_ending(scenario, told, fit),
        on_data=bool(np.isfinite(own.error[0])),
        distance=distance if math.isfinite(distance) else 0.0,
        group=group,
        probability=noise.probability(group.chi2, group.dof),
        rests_on=rests_on * (effects.beyond_statistics**2 if effects else 1.0),
        edges=edges,
        remedy=scenario.remedy(seen, told),
        remark=_remark(scenario, parameters) + (effects.words if effects else ""),
    )


def _remark(scenario: Scenario, parameters: tuple[Parameter, ...]) -> str:
    """What is open besides the beam, and what it rests on."""
    left = ", ".join(p.name for p in parameters if p.status is not Status.converged)
    priors = ", ".join(p.name for p in parameters if p.prior is not None)
    said = ""
    if left:
        said += f" {left} not determined: what depends on it has no error{scenario.aside}."
    if not parameters and not scenario.network:
        said += " Nothing is free besides the beam, so this is the fit with known transport."
    if priors:
        said += f" Rests on the prior of {priors}."
    return said


def _ending(scenario: Scenario, told: Assumptions, fit: Fit) -> Finding | None:
    """How the search ended, where that was at no optimum."""
    if fit.status is Status.not_converged and scenario.network:
        said = (
            f"The search from {told.starts} starts came to no rest (chi2 = {fit.chi2:.4g}); give "
            "more starts, another seed, or fewer hidden nodes."
        )
        return Finding(fit.status, said)
    if fit.status not in NO_ANSWER:
        return _held(fit)
    return Finding(fit.status, fit.message[0].upper() + fit.message[1:])


def _held(fit: Fit) -> Finding | None:
    """Whether a box or a limit that was given holds the answer: it then decides, not the data.

    A constraint that is active counts as exact in the covariance, and a beam in a corner of its box
    as known to the last digit.
    """
    active = [c.name.split("[")[0] for c in fit.constraints if c.state != "free"]
    if not active:
        return None
    named = ", ".join(dict.fromkeys(active))
    return Finding(
        Status.unidentified,
        f"The answer is held by limits that were given ({named}): they decide it, not the data.",
        "Justify or widen them, or tie the network to first principles.",
    )


def _scenario_answer(
    fit: Fit, own: Derived, u: Unknowns, points: Points, jacobian: np.ndarray
) -> Answer:
    p, theta, group = fit.problem, fit.theta, u.group
    determined = u.clear and u.ending is None and u.cause is None
    error = np.where(determined, own.error, np.nan)
    sigma, slopes = own.value[SIGMA], np.nan_to_num(own.slope[SIGMA])
    loose = ~p.nuisance & (p.lower < p.upper)
    further = [i for i in np.flatnonzero(loose) if not p.names[i].startswith("beam.")]
    asked = np.vstack([slopes, np.eye(len(theta))[further]])
    units = np.array([*units_of(sigma), *(abs(theta[i]) or 1.0 for i in further)])
    names = [*list(QUANTITIES)[SIGMA], *(spoken(p.names[i]) for i in further)]
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
        scale=group.scale if group.scale > 0 and _held(fit) is None else 1.0,
        rests_on=u.rests_on,
        limits=(None, None),
        distance=u.distance,
        points=points,
        directions=scaled_directions(_marginal(jacobian, asked, units), np.ones(len(units)), names),
    )


def _loose_jacobian(fit: Fit) -> np.ndarray:
    """Residuals by free numbers, errors as scaled, without weights that bounds hold."""
    p = fit.problem
    rows = fit.jacobian.copy()
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
