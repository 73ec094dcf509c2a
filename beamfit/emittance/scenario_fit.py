"""Fit of a scenario with unknowns besides the beam, and the answer of each plane."""

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
from beamfit.emittance.answer import BestFit, plane_answer, sigma_units
from beamfit.emittance.assumptions import Anchor, Assumptions
from beamfit.emittance.model import (
    SIGMA,
    SIGMA_SLICE,
    AnswerPlaces,
    model_quantities,
    place_optics,
    size_squared,
    user_name,
)
from beamfit.emittance.results import Parameter, PlaneFit
from beamfit.emittance.statement import (
    PreparedScan,
    Scanned,
    Scenario,
    problem_places,
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

# Statuses of a search that gives no answer.
FAILED = (Status.not_finite, Status.infeasible, Status.not_converged)
FAILED += (Status.contradictory_bounds,)
# Largest number of refits with new errors, and the relative change of errors that ends them.
MAX_ITERATIONS, ERROR_TOLERANCE = 3, 1e-2


def _numbers(model: Mapping[str, Any], places: tuple[AnswerPlaces, ...]) -> Array:
    """`QUANTITIES` of each plane."""
    return jnp.stack([model_quantities(model, each) for each in places])


@partial(jax.jit, compiler_options=SELDOM)
def _elements(model: Mapping[str, Any], rows: tuple[Any, ...]) -> Array:
    """R11, R12 and known size² of each plane's rows."""
    return jnp.stack([jnp.stack(each.elements(model)) for each in rows])


def iterated_fit(
    prepared: PreparedScan, scenario: Scenario, assumptions: Assumptions
) -> tuple[Fit, PreparedScan]:
    """Solve, and refit with errors taken at the fitted sizes until these no longer change.

    The fit with known transport takes its weights, its noise and its bad readings from the given
    line, which may be wrong. The returned scan has the posterior through the fitted line.
    """
    fit = _solve(scenario.state(_with_stated_errors(prepared), assumptions), scenario, assumptions)
    found = _with_fitted_line(prepared, fit)
    for _ in range(MAX_ITERATIONS):
        old = size_records(fit.problem)
        new = {r.name: size_record(found, plane, r.data) for plane, r in old.items()}
        if all(np.allclose(new[r.name].error, r.error, rtol=ERROR_TOLERANCE) for r in old.values()):
            break
        records = tuple(new.get(r.name, r) for r in fit.problem.records)
        refit = solve(replace(fit.problem, model=fit.model, records=records))
        # The attempts of the first search stay on record with the few steps of the refit.
        message = fit.message if refit.status is fit.status else refit.message
        fit = replace(refit, attempts=(*fit.attempts, *refit.attempts), message=message)
        found = _with_fitted_line(prepared, fit)
    return fit, found


def _with_stated_errors(prepared: PreparedScan) -> PreparedScan:
    """The scan with its stated errors, where there are any.

    Misfits of the given line are for the scenario to explain: they are not noise.
    """
    solutions = {}
    for plane, solution in prepared.solutions.items():
        error = solution.points.error if solution.sizes.error is None else solution.sizes.error
        solutions[plane] = solution._replace(points=solution.points._replace(error=error))
    return prepared._replace(solutions=solutions)


def _solve(problem: Problem, scenario: Scenario, assumptions: Assumptions) -> Fit:
    """Solve; from many starts for a network, or if one start ended in a poor fit.

    A zero-emittance beam is a stationary point of every fit in its Cholesky factor. A start near
    it, such as the known-transport fit with a wrong calibration, may never leave it.
    """
    fit = solve(problem, assumptions.starts if scenario.network else 1, assumptions.seed)
    at_zero_emittance = any(
        fit[f"beam.{plane}.l22"].state == "lower" for plane in problem.model["beam"]
    )
    poor = fit.status is not Status.converged and fit.chi2 > 2.0 * max(fit.dof, 1)
    if (at_zero_emittance or poor) and not scenario.network:
        fit = solve(problem, assumptions.starts, assumptions.seed)
    return fit


def _with_fitted_line(prepared: PreparedScan, fit: Fit) -> PreparedScan:
    """The scan with each plane fitted in closed form through the fitted line."""
    records = size_records(fit.problem)
    fitted = np.asarray(_elements(fit.model, tuple(records[p].data for p in prepared.planes)))
    elements = prepared.elements.copy()
    elements[:, ["xy".index(plane) for plane in prepared.planes]] = np.swapaxes(fitted, 0, 1)
    return with_posteriors([prepared._replace(elements=elements)])[0]


def scenario_answers(of: Scanned) -> tuple[PlaneFit, ...]:
    """Answer for each plane of a scenario's fit.

    The posterior is that of the beam through the fitted line, widened by the other unknowns.
    """
    fit, prepared = of.solved, of.seen
    places = problem_places(fit.problem, prepared, prepared.planes, of.statement.whole_map)
    derived = fit.derive(_numbers, places)
    beams = []
    for i, plane in enumerate(prepared.planes):
        plane_derived = Derived(*(part[i] for part in derived))
        solution = prepared.solutions[plane]
        p = solution.points
        squared = size_squared(plane_derived.value[SIGMA_SLICE], p.r11, p.r12, p.known)
        p = p.with_model(np.sqrt(np.maximum(squared, 0.0)), prepared.rows.squared)
        fitted = prepared._replace(
            solutions=prepared.solutions | {plane: solution._replace(points=p)}
        )
        optics = map(np.asarray, place_optics(fit.model, places[i]))
        beams.append(
            plane_answer(fitted, of.line, plane, tuple(optics), _best_fit(of, plane, plane_derived))
        )
    return tuple(beams)


def _best_fit(of: Scanned, plane: str, derived: Derived) -> BestFit:
    """Best fit of a plane, with the contribution of the scenario's other unknowns."""
    fit, assumptions, scenario, jacobian = (
        of.solved,
        of.told,
        of.statement,
        _loose_jacobian(of.solved),
    )
    record = size_records(fit.problem)[plane].name
    decided = bool(np.isfinite(derived.error[0])) and _limit_finding(fit) is None
    effects = effect_words(
        fit, assumptions, float(derived.value[1]), np.nan_to_num(derived.slope[1])
    )
    edges = "".join(
        f"; {p.name} ends at its {p.state} bound {p.value.value:.6g} "
        f"(d(chi2/2)/d(bound) = {p.multiplier:.2g})"
        for p in of.parameters
        if p.status is Status.at_limit
    )
    open_cause = "its value is decided by bounds and starting point, not by the data" + edges
    slopes = np.nan_to_num(derived.slope[SIGMA_SLICE])
    return BestFit(
        value=derived.value,
        spread=_further_spread(fit, plane, derived, jacobian),
        covariance=slopes @ fit.covariance @ slopes.T,
        directions=_directions(fit, derived.value[SIGMA_SLICE], slopes, jacobian),
        dof=next((g.dof for g in fit.groups if g.name == record), 0.0),
        ending=_failure(scenario, assumptions, fit),
        open_cause="" if decided else open_cause,
        remedy=scenario.remedy(of.seen, assumptions),
        remark=(_remark(scenario, of.parameters) + effects).strip(),
        scenario=scenario.name
        + (f" with {assumptions.anchor.words}" if assumptions.anchor != Anchor() else ""),
        holds="statistics, systematics" if assumptions.systematics else "statistics only",
    )


def _further_spread(fit: Fit, plane: str, derived: Derived, jacobian: np.ndarray) -> np.ndarray:
    """Standard deviation that the other unknowns add to each quantity of a plane, shape (11,).

    It is the variance with all parameters free minus that with only the plane's beam free.
    """
    beam_columns = [
        i for i, name in enumerate(fit.problem.names) if name.startswith(f"beam.{plane}.")
    ]
    inverse = np.linalg.pinv(jacobian[:, beam_columns])
    beam_variance = np.sum((np.nan_to_num(derived.slope)[:, beam_columns] @ inverse) ** 2, axis=1)
    total = np.nan_to_num(derived.error, nan=np.inf) ** 2
    return np.sqrt(np.maximum(total - beam_variance, 0.0))


def _remark(scenario: Scenario, parameters: tuple[Parameter, ...]) -> str:
    """State which parameters are open, and which priors the answer rests on."""
    open_names = ", ".join(p.name for p in parameters if p.status is not Status.converged)
    priors = ", ".join(p.name for p in parameters if p.prior is not None)
    text = ""
    if open_names:
        text += f" {open_names} not determined{scenario.consequence}."
    if not parameters and not scenario.network:
        text += " Nothing is free besides the beam, so this is the fit with known transport."
    if priors:
        text += f" Rests on the prior of {priors}."
    return text


def _failure(scenario: Scenario, assumptions: Assumptions, fit: Fit) -> Finding | None:
    """Finding on a search that found no optimum, or on an answer at a given limit."""
    if fit.status is Status.not_converged and scenario.network:
        text = (
            f"The search from {assumptions.starts} starts came to no rest (chi2 = {fit.chi2:.4g}); "
            "give more starts, another seed, or fewer hidden nodes."
        )
        return Finding(fit.status, text)
    if fit.status not in FAILED:
        return _limit_finding(fit)
    return Finding(fit.status, fit.message[0].upper() + fit.message[1:])


def _limit_finding(fit: Fit) -> Finding | None:
    """Finding on an answer at a given box or limit: the limit decides it, not the data.

    The covariance treats an active constraint as exact, so a beam in a corner of its box would have
    no error.
    """
    active = [c.name.split("[")[0] for c in fit.constraints if c.state != "free"]
    if not active:
        return None
    names = ", ".join(dict.fromkeys(active))
    return Finding(
        Status.unidentified,
        f"The answer is held by limits that were given ({names}): they decide it, not the data.",
        "Justify or widen them, or tie the network to first principles.",
    )


def _directions(
    fit: Fit, sigma: np.ndarray, slopes: np.ndarray, jacobian: np.ndarray
) -> Directions:
    """Directions of σ and of the other parameters that the data do not determine."""
    p, theta = fit.problem, fit.theta
    loose = ~p.nuisance & (p.lower < p.upper)
    further = [i for i in np.flatnonzero(loose) if not p.names[i].startswith("beam.")]
    quantities = np.vstack([slopes, np.eye(len(theta))[further]])
    units = np.array([*sigma_units(sigma), *(abs(theta[i]) or 1.0 for i in further)])
    names = [*SIGMA, *(user_name(p.names[i]) for i in further)]
    return scaled_directions(_marginal(jacobian, quantities, units), np.ones(len(units)), names)


def _loose_jacobian(fit: Fit) -> np.ndarray:
    """Jacobian of the residuals with scaled errors; columns of fixed parameters are zero."""
    p = fit.problem
    rows = fit.dense_jacobian
    for group in fit.groups:
        rows[group.rows] /= group.factor
    edge = np.array([v.state in ("lower", "upper") for v in fit.variables])
    rows[:, (edge & p.nuisance) | (p.lower == p.upper)] = 0.0
    return rows


def _marginal(jacobian: np.ndarray, slopes: np.ndarray, units: np.ndarray) -> np.ndarray:
    """Jacobian of given quantities whose Gram matrix is their marginal information.

    The parameter space splits into directions that change the quantities and the rest. Residuals
    that the rest can compensate are projected out (Schur complement).
    """
    unit_slopes = slopes / units[:, None]
    _, sizes, directions = np.linalg.svd(unit_slopes, full_matrices=True)
    rest = jacobian @ directions[len(sizes) :].T
    length = np.linalg.norm(rest, axis=0)
    basis, values, _ = np.linalg.svd(rest / np.where(length > 0, length, 1.0), full_matrices=False)
    basis = basis[:, values > 1e-10 * values.max(initial=0.0)]
    reduced = jacobian @ np.linalg.pinv(unit_slopes)
    return reduced - basis @ (basis.T @ reduced)
