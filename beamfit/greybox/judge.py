"""Verdict on the end of a search: the gravest rule that applies, and what the data determine.

The verdict rests on residuals, multipliers, curvature and proofs of convexity, not on a solver's
message. Unless a problem is proved convex, its answer is the best of several starts. Numbers that
can move together without changing any prediction, for any data, are reported as a freedom of the
model.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import checkify
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from beamfit import errors
from beamfit.errors import Finding, Status
from beamfit.greybox import assess, problem
from beamfit.greybox.assess import TEST_DISTANCE, TEST_POINTS, SearchState
from beamfit.greybox.convex import convex
from beamfit.greybox.covariance import (
    MOST_SHARE,
    FactoredSpread,
    Group,
    Spread,
    groups_of,
    spread_of,
    triangle,
)
from beamfit.greybox.diagnosis import Conflict, dependence, listed
from beamfit.greybox.equations import Implicit
from beamfit.greybox.fit import Attempt, Fit, FittedConstraint, FittedVariable
from beamfit.greybox.problem import Problem, flattened, residual_and_jacobian
from beamfit.greybox.sparse import Rows
from beamfit.statistics import POOR_FIT, chi2_probability

# A search has settled if a further step would lower chi-square by less than this: the step is then
# shorter than a tenth of a standard error.
SETTLED_DECREASE = 0.01
# A row of the Jacobian vanishes along a direction if less than this share of its terms remains.
VANISHING_ROW = 1e-7
# Numbers are tied if the cosine between their rows in a basis of the directions exceeds this.
TIED_SHARE = 1e-3
# A cost below this, in units of its scale, counts as unbounded.
UNBOUNDED_COST = -1e15
# A number runs away beyond this many of its scales. At a pole, the change of the cost when a number
# changes by its scale exceeds the cost by this factor.
RUNAWAY = 1e6
# Relative difference in cost up to which two starts ended on the same optimum.
COST_TOLERANCE = 1e-4
BOUND_STATES = ("lower", "upper")


class Search(NamedTuple):
    """Record of a search.

    `attempts` has an entry for each start, `moved` is the number of starts moved onto their bounds.
    `seconds` is the time limit and `cut` is true if it ended the search. `exact` is true if second
    derivatives were available. `conflict` names the constraints that exclude a feasible point.
    """

    attempts: tuple[Attempt, ...]
    moved: int = 0
    seconds: float | None = None
    cut: bool = False
    exact: bool = True
    conflict: Conflict | None = None

    @property
    def starts(self) -> str:
        """Number of starts, for a message."""
        return f"{len(self.attempts)} start{'s' if len(self.attempts) != 1 else ''}"


class ResidualInformation(NamedTuple):
    """Information in the residuals at a point.

    `groups` has the noise of each record. `spread` and `spread_raw` have the errors of the numbers
    with scaled and with given errors of the data. The columns of `undetermined` are directions that
    the data do not determine, `rank` is the number of those they do. `held` marks numbers held by a
    bound, `open_numbers` those that stay undetermined even if the bounds are the true values.
    """

    groups: tuple[Group, ...]
    spread: Spread | FactoredSpread
    spread_raw: Spread | FactoredSpread
    undetermined: np.ndarray
    rank: int
    open_numbers: np.ndarray
    held: np.ndarray


class FitEvidence(NamedTuple):
    """Input of the verdict's rules."""

    problem: Problem
    state: SearchState
    search: Search
    information: ResidualInformation
    settled: bool
    variables: tuple[FittedVariable, ...]
    constraints: tuple[FittedConstraint, ...]

    @property
    def kkt_text(self) -> str:
        """The KKT residual, for a message."""
        return f"(KKT residual {self.state.kkt.worst:.1e})"

    @property
    def optima(self) -> tuple[int, list[tuple[float, int]]]:
        """Number of starts that found the answer; cost of each other optimum and its starts."""
        tolerance = COST_TOLERANCE * max(self.state.scale.cost, abs(self.state.at.cost))
        ends = [a.cost for a in self.search.attempts if a.kkt.worst <= self.problem.tolerance]
        agreed = sum(abs(cost - self.state.at.cost) <= tolerance for cost in ends)
        others: list[tuple[float, int]] = []
        for cost in (c for c in sorted(ends) if c - self.state.at.cost > tolerance):
            if others and cost - others[-1][0] <= tolerance:
                others[-1] = (others[-1][0], others[-1][1] + 1)
            else:
                others.append((cost, 1))
        return agreed, others


def residual_information(p: Problem, s: SearchState) -> ResidualInformation:
    """Compute the information in the residuals along the active limits.

    For the degrees of freedom a number at an active bound is held. For its error, and for errors
    that depend on it, it is free within its bounds. Nuisance numbers stay on their bounds.
    """
    held, active = assess.active_set(p, s, 1e-9)
    equations = s.at.jacobian[active]
    ends = np.cumsum([record.measured.size for record in p.records], dtype=int)
    parts = zip([0, *ends], [*ends, None], strict=True)
    blocks = [triangle(s.at.residual_jacobian[first:last]) for first, last in parts]
    unbounded = np.full(len(held), np.inf)
    from_residuals = spread_of(_stacked(blocks), -unbounded, unbounded, held, None, equations)
    groups = groups_of(p.records, np.split(s.at.residual, ends)[:-1], blocks, from_residuals)
    fixed = (np.isin(s.bounds.states, BOUND_STATES) & p.nuisance) | ~p.moving
    limited = np.isfinite(p.upper - p.lower) & p.moving & ~p.with_prior
    same_spread = np.array_equal(fixed, held) and not limited.any()

    def spread(factors, fixed):
        if same_spread and len({*factors, *[1.0] * bool(p.priors)}) <= 1:
            return from_residuals.times(factors[0] if factors else 1.0)
        parts = [block / f for block, f in zip(blocks, [*factors, 1.0], strict=True)]
        return spread_of(_stacked(parts), p.lower, p.upper, fixed, p.with_prior, equations)

    factors = [group.factor for group in groups]
    spread_scaled = spread(factors, fixed)
    raw_factors = [1.0 if group.errors_given else group.factor for group in groups]
    spread_raw = spread_scaled if raw_factors == factors else spread(raw_factors, fixed)
    given_bounds = spread_scaled if np.array_equal(fixed, held) else spread(factors, held)
    open_numbers = (given_bounds.shares >= MOST_SHARE) & ~held
    length = np.linalg.norm(from_residuals.open, axis=0)
    undetermined = from_residuals.open / np.where(length > 0, length, 1.0)
    return ResidualInformation(
        groups, spread_scaled, spread_raw, undetermined, from_residuals.rank, open_numbers, held
    )


def _stacked(blocks: list[Rows]) -> Rows:
    if any(map(sparse.issparse, blocks)):
        return sparse.csr_array(sparse.vstack(blocks))
    return np.vstack(blocks)


def has_settled(p: Problem, s: SearchState) -> bool:
    """True if the search ended at an optimum within the accuracy of the data.

    A further Gauss-Newton step would lower chi-square by less than `SETTLED_DECREASE`; the noise is
    inferred from the residuals where no errors were given. Networks have flat valleys in which no
    strict optimum is ever reached.
    """
    if p.objectives or not s.at.finite or not s.feasible:
        return False
    found = residual_information(p, s)
    weight = np.ones(len(s.at.residual))
    for group in found.groups:
        weight[group.rows] = 1.0 if group.errors_given else group.factor**-2
    gradient = s.at.residual_jacobian.T @ (weight * s.at.residual)
    outward = np.where(s.bounds.reached[0], gradient > 0, s.bounds.reached[1] & (gradient < 0))
    gradient = np.where(outward | found.held, 0.0, gradient)
    return bool(found.spread_raw.size(gradient) ** 2 < SETTLED_DECREASE)


# ---- the answer


def conclude(p: Problem, s: SearchState, search: Search, seconds: float) -> Fit:
    """Make the `Fit` from the best point of a search, `seconds` being the time taken."""
    failure = _inner_failure(p, s.theta)
    if failure or not s.at.finite:
        lost = Finding(
            Status.not_finite,
            "the cost or a derivative is not finite at the end of the search;",
            "bound the free numbers away from there, or use a parametrisation that stays defined.",
        )
        if failure:
            remedy = (
                "start it nearer to its root, or bound the free numbers to where a root exists."
            )
            lost = Finding(Status.not_converged, f"{failure} at the end of the search;", remedy)
        return refuse(p, lost, seconds, s.theta, search.attempts)
    found = residual_information(p, s)
    variables, constraints = _variables(p, s, found), _constraints(p, s)
    chi2 = float(s.at.residual @ s.at.residual)
    priors = len(s.at.residual) - p.size
    dof = sum(group.count for group in found.groups) + priors - found.rank
    ratio = chi2 / dof if dof > 0 else np.nan
    test_errors = p.errors_known or not p.records
    scale = (np.sqrt(max(1.0, ratio)) if dof > 0 else 1.0) if test_errors else np.sqrt(ratio)
    at_rest = not s.optimal and has_settled(p, s)
    evidence = FitEvidence(p, s, search, found, at_rest, variables, constraints)
    finding = errors.judge(evidence, RULES if p.has_data else RULES_WITHOUT_DATA)
    message = " ".join([finding.message, *_remarks(evidence)])
    return Fit(
        p, s.theta, finding.status, message, float(s.at.cost), chi2, dof, found.groups, s.kkt,
        variables, constraints, found.spread, found.spread_raw, s.at.residual_jacobian,
        found.undetermined, float(scale), search.attempts, seconds, finding.about,
    )  # fmt: skip


def _inner_failure(p: Problem, theta: np.ndarray) -> str | None:
    """Describe the implicit map that does not converge at the answer; None if all do."""
    parts = jax.tree.leaves(p.core, is_leaf=lambda part: isinstance(part, Implicit))
    if not any(isinstance(part, Implicit) for part in parts):
        return None
    check = checkify.checkify(jax.jit(problem.values), errors=checkify.user_checks)
    message = check(p.core, jnp.asarray(theta, float))[0].get()
    return None if message is None else message.removesuffix(" (`check` failed)")


def _variables(
    p: Problem, s: SearchState, found: ResidualInformation
) -> tuple[FittedVariable, ...]:
    """Make the table of the free numbers; an undetermined number has no error."""
    undetermined = (found.spread.shares >= MOST_SHARE) | found.held
    undetermined |= any(group.unknown for group in found.groups)
    errors = (
        np.where(undetermined, np.nan, part.errors) for part in (found.spread, found.spread_raw)
    )
    columns = (s.theta, *errors, p.lower, p.upper, s.bounds.states, s.bounds.multiplier)
    return _table(FittedVariable, p.names, *columns)


def _constraints(p: Problem, s: SearchState) -> tuple[FittedConstraint, ...]:
    columns = (*s.limits[:3], s.limits.states, s.limits.multiplier)
    return _table(FittedConstraint, p.constraint_names, *columns)


def _table(kind: type, names: tuple[str, ...], *columns: np.ndarray) -> tuple:
    return tuple(map(kind, names, *(column.tolist() for column in columns)))


def refuse(p: Problem, found: Finding, seconds: float, theta=None, attempts=()) -> Fit:
    """Make a fit without an answer: the point where it stopped, and no number determined."""
    theta = p.start if theta is None else theta
    n, nan = len(theta), np.nan
    lost = Spread(np.full((n, n), nan), np.eye(n), np.ones(n), np.zeros(n))
    none, free = np.full(n, nan), np.full(n, "free")
    variables = _table(FittedVariable, p.names, theta, none, none, p.lower, p.upper, free, none)
    none = np.full(len(p.constraint_names), nan)
    ends, free = (p.constraint_lower, p.constraint_upper), np.full(len(none), "free")
    constraints = _table(FittedConstraint, p.constraint_names, none, *ends, free, none)
    return Fit(
        p, theta, found.status, found.message, nan, nan, 0, (), assess.INFINITE_KKT, variables,
        constraints, lost, lost, np.zeros((p.size, n)), np.eye(n), nan, attempts, seconds,
    )  # fmt: skip


# ---- rules for every problem


def _infeasible(e: FitEvidence) -> Finding | None:
    """Rule: the constraints do not hold at the best point."""
    if e.state.feasible:
        return None
    place, about = " bounds: outside;", ()
    if e.constraints:
        worst = e.constraints[int(np.argmax(e.state.limits.violation))]
        place = (
            f" '{worst.name}' ends at {worst.value:.4g}, outside"
            f" [{worst.lower:.4g}, {worst.upper:.4g}];"
        )
        about = (worst.name,)
    remedy = "relax it, free more numbers, or start elsewhere."
    conflict = e.search.conflict
    if conflict is not None and not conflict.feasible:
        one, about = len(conflict.constraints) == 1, conflict.about
        alone = one and not conflict.bounds
        place += f" {listed(map(repr, conflict.constraints))} cannot hold"
        place += "" if one else " together"
        place += f" within {listed(conflict.bounds)}" if conflict.bounds else ""
        place += ";" if alone else ", without any one of them it can;"
        remedy = f"relax {'it' if one else 'one of them'}, free more numbers, or start elsewhere."
    cause = f"no point within all constraints was found from {e.search.starts}:{place}"
    return Finding(Status.infeasible, cause, remedy, about)


def _unbounded(e: FitEvidence) -> Finding | None:
    """Rule: the cost has no minimum."""
    cost, runaway = float(e.state.at.cost), _runaway_numbers(e.state)
    if (
        not e.problem.objectives
        or cost >= UNBOUNDED_COST * e.state.scale.cost
        or cost_outgrew_scale(e.state)
    ):
        return None
    about = tuple(np.array(e.problem.names)[runaway].tolist())
    along = f" as {listed(about)} grows" if about else ""
    remedy = "bound the free numbers, or check the sign of the objective."
    cause = f"the cost falls without end{along} (down to {cost:.3g});"
    return Finding(Status.unbounded, cause, remedy, about)


def cost_outgrew_scale(s: SearchState) -> bool:
    """True if the cost at the start is too small to serve as the scale of the final cost."""
    cost, scale = s.at.cost, s.scale
    pole = np.any(np.abs(s.at.gradient) * scale.unit > RUNAWAY * abs(cost))
    return bool(
        cost < UNBOUNDED_COST * scale.cost
        and np.isfinite(cost)
        and not (pole or _runaway_numbers(s).any())
    )


def _runaway_numbers(s: SearchState) -> np.ndarray:
    return np.abs(s.theta) > RUNAWAY * s.scale.unit


def _not_converged(e: FitEvidence) -> Finding | None:
    """Rule: the search ended before it reached an optimum."""
    curvature, steps = e.state.curvature, sum(a.iterations for a in e.search.attempts)
    reason = None
    if not e.state.optimal and not e.settled:
        reason = e.kkt_text.strip("()")
    elif curvature is not None and curvature.direction is not None:
        reason = "the cost still bends down there"
    elif curvature is not None and curvature.newton > assess.MAX_NEWTON_STEP:
        reason = f"the next step is {curvature.newton:.1e} of the numbers' sizes"
    if reason is None:
        return None
    cause = f"no optimum was reached from {e.search.starts} ({reason} after {steps} iterations);"
    remedy = "give more starts or iterations, or a better start."
    return Finding(Status.not_converged, cause, remedy)


# ---- rules for fits to data


def _unidentified(e: FitEvidence) -> Finding | None:
    """Rule: the data do not determine all numbers that are not nuisance numbers."""
    names = tuple(
        np.array(e.problem.names)[e.information.open_numbers & ~e.problem.nuisance].tolist()
    )
    if not names:
        return None
    found = gauges(e.problem, e.state.theta, e.information.undetermined)
    tied = [g for g in found if set(names) & set(g.names)]
    if tied:
        return together(tied)
    cause = f"the data do not determine {listed(names)};"
    remedy = "add data of another kind, a prior, or fix it."
    return Finding(Status.unidentified, cause, remedy, names)


def _poor_fit(e: FitEvidence) -> Finding | None:
    """Rule: residuals of records with errors are larger than these errors allow."""
    # Records without errors cannot test the model.
    without_errors = [group for group in e.information.groups if not group.errors_given]
    r = e.state.at.residual
    count = sum(group.count for group in e.information.groups) + len(r) - e.problem.size
    chi2 = float(r @ r) - sum(g.chi2 for g in without_errors)
    dof = count - e.information.rank - sum(g.dof for g in without_errors)
    chance = chi2_probability(chi2, dof) if dof > 0 else 1.0
    if not e.problem.errors_known or chance >= POOR_FIT:
        return None
    cause = (
        f"chi2 = {chi2:.4g} for {dof:.4g} degrees of freedom happens by chance in {chance:.1e} "
        "of cases;"
    )
    remedy = "the model misses something or the errors are too small."
    return Finding(Status.poor_fit, cause, remedy)


def _at_limit(e: FitEvidence) -> Finding | None:
    """Rule: a number that the data should determine lies at its bound."""
    pairs = zip(e.variables, e.problem.nuisance, strict=True)
    held = [v for v, nuisance in pairs if not nuisance and v.state in BOUND_STATES]
    if not held:
        return None
    cause = f"the best value lies at a bound: {listed(f'{v.name} ({v.state})' for v in held)};"
    return Finding(
        Status.at_limit, cause, "the bound decides it, not the data, so justify or widen it."
    )


def _converged(e: FitEvidence) -> Finding:
    """Rule: no other applies; describe the optimum."""
    start = f"an optimum was reached from {e.search.starts} {e.kkt_text}."
    higher = sum(count for _, count in e.optima[1]) if e.problem.objectives else 0
    if e.settled:
        start = (
            f"the search from {e.search.starts} has settled where nothing that matters to the data "
            f"changes any more {e.kkt_text}."
        )
    elif higher:
        start = (
            f"the best of several local optima was reached from {e.search.starts} {e.kkt_text}; "
            f"{higher} of them ended on others of higher cost."
        )
    return Finding(Status.converged, start)


class Gauge(NamedTuple):
    """Numbers that can move together without changing a prediction.

    `changes` are their relative changes along one such direction. `free` is the number of
    independent directions: as many of the numbers must be fixed.
    """

    names: tuple[str, ...]
    changes: tuple[float, ...]
    free: int


def gauges(p: Problem, theta: np.ndarray, directions: np.ndarray) -> tuple[Gauge, ...]:
    """Find symmetries of the model among the directions that the data do not determine.

    A direction along which residuals do not change at randomly chosen settings either could not be
    determined by further data: it is a symmetry of the model.

    Parameters
    ----------
    p : Problem
        The problem.
    theta : array, shape (n,)
        The point.
    directions : array, shape (n, k)
        Directions along which the residuals do not change there.

    Returns
    -------
    tuple of Gauge
        One for each set of two or more numbers that are tied.

    Examples
    --------
    >>> from beamfit.greybox.problem import Free, Record
    >>> def series(model, x):
    ...     return model["first"] * model["second"] * x
    >>> record = Record("r", series, np.arange(3.0), [0.0, 6.0, 12.0], 0.1)
    >>> p = Problem({"first": 2.0, "second": 3.0}, [Free("first"), Free("second")], [record])
    >>> at = np.array([2.0, 3.0])
    >>> gauges(p, at, np.array([[2.0], [-3.0]]))[0].names
    ('first', 'second')
    """
    freedoms = _model_freedoms(p, theta, directions)
    if not freedoms.shape[1]:
        return ()
    basis = np.linalg.qr(freedoms)[0]
    size = _scales_of(theta)
    part = np.linalg.norm(basis, axis=1)
    moved = np.flatnonzero(part > TIED_SHARE**2)
    tied = (
        np.abs(basis[moved] @ basis[moved].T)
        > TIED_SHARE * np.outer(part[moved], part[moved]) + 1e-12
    )
    group, found = connected_components(tied, directed=False)[1], []
    for label in dict.fromkeys(group.tolist()):
        at = moved[group == label]
        _, sizes, right = np.linalg.svd(basis[at].T)
        free = int(np.sum(sizes > TIED_SHARE * sizes[0]))
        change = right[0] / size[at]
        if len(at) > 1 and free < len(at) and _tied_elsewhere(p, theta, at, free):
            shares = change / np.max(np.abs(change)) * np.sign(change[0])
            names = tuple(p.names[i] for i in at)
            found.append(Gauge(names, tuple(shares.tolist()), free))
    return tuple(found)


def _model_freedoms(p: Problem, theta: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Find combinations of directions along which no prediction changes at random settings."""
    random, size = np.random.default_rng(0), _scales_of(theta)
    length = np.linalg.norm(directions / size[:, None], axis=0)
    along = directions[:, length > 0] / length[length > 0]  # numbers that are held do not move
    if not along.shape[1]:
        return along
    rows = np.vstack([_random_rows(p, theta, random) for _ in range(TEST_POINTS)])
    _, sizes, right = np.linalg.svd(triangle(rows / size @ along), full_matrices=True)
    return along @ right[int(np.sum(sizes > VANISHING_ROW)) :].T


def _tied_elsewhere(p: Problem, theta: np.ndarray, at: np.ndarray, free: int) -> bool:
    """True if numbers are tied at smaller values as well, unlike those on a ridge of the cost."""
    random = np.random.default_rng(0)
    for _ in range(TEST_POINTS):
        point = np.clip(theta * random.uniform(size=len(theta)), p.lower, p.upper)
        sizes = np.linalg.svd(_random_rows(p, point, random)[:, at], compute_uv=False)
        if np.sum(sizes > VANISHING_ROW * np.max(sizes, initial=0.0)) > len(at) - free:
            return False
    return True


def _scales_of(theta: np.ndarray) -> np.ndarray:
    return np.where(theta != 0, np.abs(theta), 1.0)


def _random_rows(p: Problem, theta: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Rows of the Jacobian at random settings, of unit length in the scales of the numbers."""
    records = tuple(
        dataclasses.replace(r, data=jax.tree.map(lambda v: _random_settings(v, random), r.data))
        for r in p.core.records
    )
    core = dataclasses.replace(p.core, records=records)
    rows = np.asarray(flattened(core)(residual_and_jacobian)(theta)[1]) * _scales_of(theta)
    rows = rows[np.all(np.isfinite(rows), axis=1)]
    for order in (np.inf, 2):  # the maximum first: squares of huge entries overflow
        terms = np.linalg.norm(rows, order, axis=1, keepdims=True)
        rows = rows / np.where(terms > 0, terms, 1.0)
    return rows


def _random_settings(value: Any, random: np.random.Generator) -> Any:
    """Change settings at random; integers stay."""
    value = np.asarray(value)
    if not np.issubdtype(value.dtype, np.floating) or not value.size:
        return value
    spread = float(np.std(value)) or float(np.max(np.abs(value))) or 1.0
    factor, shift = (TEST_DISTANCE * random.normal(size=value.shape) for _ in range(2))
    return value * (1 + factor) + spread * shift


def together(found: list[Gauge]) -> Finding:
    """Name the numbers that can move together for any data."""
    sentences = []
    for g in found:
        parts = [f"{n} {c:+.3g} %" for n, c in zip(g.names, g.changes, strict=True)]
        along = f" ({', '.join(parts[:4])})" if g.free == 1 else ""
        sentences.append(f"{listed(g.names)} move together{along}")
    cause = (
        f"{'; '.join(sentences)}: no prediction changes, whatever the data, a freedom of the model;"
    )
    count = sum(g.free for g in found)
    few = "one of them" if count == 1 else f"{count} of them"
    names = tuple(name for g in found for name in g.names)
    return Finding(Status.unidentified, cause, f"fix {few}, or give a prior.", names)


# ---- rules for an objective alone


def _degenerate(e: FitEvidence) -> Finding | None:
    """Rule: multipliers are not unique, or there are none."""
    found = dependence(e.problem, e.state, e.state.optimal)
    if found is None:
        return None
    names, gap = listed(map(repr, found.names)), "" if e.state.optimal else f" {e.kkt_text}"
    one = "its gradient vanishes" if len(found.names) == 1 else "their gradients are dependent"
    if found.flat:
        cause = (
            f"{listed(map(repr, found.flat))} has no slope where it holds (no constraint "
            f"qualification), so that it has no multiplier and solvers stop anywhere along it{gap};"
        )
        remedy = (
            "state what it is made of one by one, g <= 0 in the place of "
            "sum(max(g, 0)^2) <= 0 or g^2 <= 0."
        )
    elif e.state.optimal:
        cause = f"an optimum, but where {names} hold {one}, so that multipliers are not unique;"
        remedy = "leave out what the others imply, or read their multipliers together."
    else:
        cause = (
            f"where {names} hold {one} (no constraint qualification), so that the best point has "
            f"no multipliers{gap};"
        )
        remedy = "state them so that their gradients differ."
    return Finding(Status.degenerate, cause, remedy, found.flat or found.names)


def _saddle(e: FitEvidence) -> Finding | None:
    """Rule: the cost falls on both sides of a stationary point."""
    curvature = e.state.curvature
    if not e.state.optimal or curvature is None or curvature.direction is None:
        return None
    part = np.abs(curvature.direction / e.state.scale.unit)
    along = np.array(e.problem.names)[part > 0.3 * np.max(part)]
    cause = f"a saddle: the cost bends down along {listed(along)}, and the search did not get away;"
    return Finding(Status.saddle, cause, "start elsewhere, or give more starts.")


def _optimum(e: FitEvidence) -> Finding:
    """Rule: no other applies; name the optimum proved or local, and other optima found."""
    agreed, others = e.optima
    if others:
        costs = [f"{cost:.6g} ({count})" for cost, count in others]
        return Finding(
            Status.local_optimum,
            f"the lowest of {1 + len(others)} local optima reached from {e.search.starts}, at a "
            f"cost of {e.state.at.cost:.6g} {e.kkt_text}; others at {listed(costs)}.",
        )
    if e.search.exact and convex(e.problem):
        cause = f"the optimum was reached: the problem is convex {e.kkt_text}."
        return Finding(Status.optimal, cause)
    text = f"a local optimum was reached from 1 start {e.kkt_text};"
    if len(e.search.attempts) > 1:
        text = (
            f"a local optimum, the best of {e.search.starts}, of which {agreed} ended on it "
            f"{e.kkt_text};"
        )
    remedy = "it is not proved to be the lowest, and more starts search further."
    return Finding(Status.local_optimum, text, remedy)


RULES = (_infeasible, _unbounded, _not_converged, _unidentified, _poor_fit, _at_limit, _converged)
"""Rules for fits to data; the gravest first."""

RULES_WITHOUT_DATA = (_infeasible, _unbounded, _degenerate, _saddle, _not_converged, _optimum)
"""Rules for an objective alone; the gravest first."""


def _remarks(e: FitEvidence) -> list[str]:
    """Collect remarks on the starts and on the time limit."""
    search, remarks = e.search, []
    count, dropped = len(search.attempts), sum(np.isnan(a.cost) for a in search.attempts)
    if dropped:
        remarks.append(f"{dropped} of {count} starts dropped: cost not finite there.")
    if search.moved:
        remarks.append(f"{search.moved} of {count} starts moved onto their bounds.")
    if search.cut:
        remarks.append(f"The limit of {search.seconds:g} s cut the search.")
    unexplained = e.problem.has_data and not e.state.optimal and not e.settled
    if unexplained and e.state.feasible and (found := _degenerate(e)):
        remarks.append(found.message)
    return remarks
