"""The fit of a scenario, in which more than the beam is unknown, and the answer of each plane."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.compile_cache import SELDOM
from beamfit.emittance.answer import SIGMA, BestFit, plane_answer, units_of
from beamfit.emittance.assumptions import Anchor, Assumptions
from beamfit.emittance.model import (
    QUANTITIES,
    Asked,
    asked_numbers,
    asked_places,
    size_squared,
    spoken,
)
from beamfit.emittance.results import Parameter, PlaneFit
from beamfit.emittance.statement import (
    PreparedScan,
    Scanned,
    Scenario,
    asked_in,
    size_record,
    size_records,
    with_posteriors,
)
from beamfit.emittance.systematics import effect_words
from beamfit.errors import Finding, Status
from beamfit.greybox.fit import Derived, Fit
from beamfit.greybox.problem import Problem
from beamfit.greybox.solve import solve
from beamfit.statistics import Directions, scaled_directions

# Ends of a search that are no answer.
NO_ANSWER = (Status.not_finite, Status.infeasible, Status.not_converged)
NO_ANSWER += (Status.contradictory_bounds,)
# How often errors are taken anew at most, and what change of them no longer matters.
ROUNDS, SAME = 3, 1e-2


def _numbers(model: Mapping[str, Any], asked: tuple[Asked, ...]) -> Array:
    """`QUANTITIES` of each plane."""
    return jnp.stack([asked_numbers(model, each) for each in asked])


@partial(jax.jit, compiler_options=SELDOM)
def _elements(model: Mapping[str, Any], rows: tuple[Any, ...]) -> Array:
    """R11, R12 and known size² of each plane's rows."""
    return jnp.stack([jnp.stack(each.elements(model)) for each in rows])


def settled_fit(
    seen: PreparedScan, scenario: Scenario, told: Assumptions
) -> tuple[Fit, PreparedScan]:
    """Solve, and again with errors taken at the fitted sizes, until these change no more.

    Where the line was wrong, so were the sizes that known transport weighed by, the noise it saw in
    its residuals, and the points it doubted. What is seen in the end is the posterior through the
    line as found.
    """
    fit = _solved(scenario.state(_as_stated(seen), told), scenario, told)
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


def _as_stated(seen: PreparedScan) -> PreparedScan:
    """The scan with the errors that were stated, where they were.

    What a line misses as it is, a scenario is to explain: it is no noise yet.
    """
    solutions = {}
    for plane, work in seen.solutions.items():
        error = work.points.error if work.sizes.error is None else work.sizes.error
        solutions[plane] = work._replace(points=work.points._replace(error=error))
    return seen._replace(solutions=solutions)


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


def _through(seen: PreparedScan, fit: Fit) -> PreparedScan:
    """See the scan through the line as a fit found it: each plane fitted in closed form."""
    records = size_records(fit.problem)
    elements = np.asarray(_elements(fit.model, tuple(records[p].data for p in seen.planes)))
    look = seen.look.copy()
    look[:, ["xy".index(plane) for plane in seen.planes]] = np.swapaxes(elements, 0, 1)
    return with_posteriors([seen._replace(look=look)])[0]


def judged_scenario(of: Scanned) -> tuple[PlaneFit, ...]:
    """Answer for each plane of a scenario's fit.

    The posterior is that of the beam through the line as found, spread by what the other unknowns
    leave open.
    """
    fit, seen = of.solved, of.seen
    asked = asked_in(fit.problem, seen, seen.planes, of.statement.whole_map)
    derived = fit.derive(_numbers, asked)
    beams = []
    for i, plane in enumerate(seen.planes):
        own = Derived(*(part[i] for part in derived))
        work = seen.solutions[plane]
        p = work.points
        squared = size_squared(own.value[SIGMA], p.r11, p.r12, p.known)
        p = p.with_model(np.sqrt(np.maximum(squared, 0.0)), seen.rows.squared)
        now = seen._replace(solutions=seen.solutions | {plane: work._replace(points=p)})
        places = map(np.asarray, asked_places(fit.model, asked[i]))
        beams.append(plane_answer(now, of.line, plane, tuple(places), _best_fit(of, plane, own)))
    return tuple(beams)


def _best_fit(of: Scanned, plane: str, own: Derived) -> BestFit:
    """Further unknowns of the fit, as they enter the posterior of the beam."""
    fit, told, scenario, jacobian = of.solved, of.told, of.statement, _loose_jacobian(of.solved)
    record = size_records(fit.problem)[plane].name
    on_data = bool(np.isfinite(own.error[0])) and _held(fit) is None
    effects = effect_words(fit, told, float(own.value[1]), np.nan_to_num(own.slope[1]))
    edges = "".join(
        f"; {p.name} ends at its {p.state} bound {p.value.value:.6g} "
        f"(d(chi2/2)/d(bound) = {p.multiplier:.2g})"
        for p in of.parameters
        if p.status is Status.at_limit
    )
    opened = "its value is decided by bounds and starting point, not by the data" + edges
    slopes = np.nan_to_num(own.slope[SIGMA])
    return BestFit(
        value=own.value,
        spread=_further_spread(fit, plane, own, jacobian),
        covariance=slopes @ fit.covariance @ slopes.T,
        directions=_directions(fit, own.value[SIGMA], slopes, jacobian),
        dof=next((g.dof for g in fit.groups if g.name == record), 0.0),
        ending=_ending(scenario, told, fit),
        opened="" if on_data else opened,
        remedy=scenario.remedy(of.seen, told),
        remark=(_remark(scenario, of.parameters) + effects).strip(),
        scenario=scenario.name + (f" with {told.anchor.words}" if told.anchor != Anchor() else ""),
        holds="statistics, systematics" if told.systematics else "statistics only",
    )


def _further_spread(fit: Fit, plane: str, own: Derived, jacobian: np.ndarray) -> np.ndarray:
    """Standard deviation that the other unknowns add to each number of a plane, shape (11,).

    The variance of all free numbers together less that of the beam's own with the others held.
    """
    at = [i for i, name in enumerate(fit.problem.names) if name.startswith(f"beam.{plane}.")]
    alone = np.linalg.pinv(jacobian[:, at])
    held = np.sum((np.nan_to_num(own.slope)[:, at] @ alone) ** 2, axis=1)
    whole = np.nan_to_num(own.error, nan=np.inf) ** 2
    return np.sqrt(np.maximum(whole - held, 0.0))


def _remark(scenario: Scenario, parameters: tuple[Parameter, ...]) -> str:
    """Say what is open besides the beam, and what it rests on."""
    left = ", ".join(p.name for p in parameters if p.status is not Status.converged)
    priors = ", ".join(p.name for p in parameters if p.prior is not None)
    said = ""
    if left:
        said += f" {left} not determined{scenario.aside}."
    if not parameters and not scenario.network:
        said += " Nothing is free besides the beam, so this is the fit with known transport."
    if priors:
        said += f" Rests on the prior of {priors}."
    return said


def _ending(scenario: Scenario, told: Assumptions, fit: Fit) -> Finding | None:
    """Finding on a search that ended at no optimum."""
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
    """Finding on an answer held by a box or limit that was given: it decides, not the data.

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


def _directions(
    fit: Fit, sigma: np.ndarray, slopes: np.ndarray, jacobian: np.ndarray
) -> Directions:
    """Directions of σ and of the other numbers asked for that the data leave open."""
    p, theta = fit.problem, fit.theta
    loose = ~p.nuisance & (p.lower < p.upper)
    further = [i for i in np.flatnonzero(loose) if not p.names[i].startswith("beam.")]
    asked = np.vstack([slopes, np.eye(len(theta))[further]])
    units = np.array([*units_of(sigma), *(abs(theta[i]) or 1.0 for i in further)])
    names = [*list(QUANTITIES)[SIGMA], *(spoken(p.names[i]) for i in further)]
    return scaled_directions(_marginal(jacobian, asked, units), np.ones(len(units)), names)


def _loose_jacobian(fit: Fit) -> np.ndarray:
    """Residuals by free numbers, errors as scaled, without weights that bounds hold."""
    p = fit.problem
    rows = fit.dense_jacobian
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
