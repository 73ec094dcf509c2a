"""Verdict on the end of a search: the gravest rule that applies, and what the data determine.

Residuals, multipliers, curvature and proofs speak, and no solver. A problem that is not proved
convex has the best of its starts for an answer. Numbers that move together without a change of any
prediction, whatever the data, are told as a freedom of the model.
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
from beamfit.greybox.problem import Problem, flattened, sloped
from beamfit.greybox.sparse import Rows
from beamfit.statistics import POOR_FIT, chi2_probability

# A search is settled if a further step lowers chi-square by less: a tenth of a standard error.
SETTLED = 0.01
# A row is constant along a direction if it changes by less than this share of its terms.
STILL = 1e-7
# Numbers are tied if their part of the open directions exceeds this share of the largest.
TIED = 1e-3
# A cost below this, in units of its size, counts as unbounded.
ENDLESS = -1e15
# A number beyond this many of its sizes runs away; at a pole the cost's slope per size of a number
# exceeds the cost by this factor.
AWAY = 1e6
# Relative difference in cost up to which two starts ended on the same optimum.
ALIKE = 1e-4
EDGES = ("lower", "upper")


class Search(NamedTuple):
    """Record of a search: its starts, those moved onto bounds, the time limit if it cut.

    `exact` tells whether second derivatives could be asked for, `conflict` what kept the search
    from a feasible point.
    """

    attempts: tuple[Attempt, ...]
    moved: int = 0
    seconds: float | None = None
    cut: bool = False
    exact: bool = True
    conflict: Conflict | None = None

    @property
    def words(self) -> str:
        """Number of starts, in words."""
        return f"{len(self.attempts)} start{'s' if len(self.attempts) != 1 else ''}"


class Known(NamedTuple):
    """Information of a point's residuals: noise groups, spreads, undetermined directions, rank.

    `blind` tells which numbers would be open even if what is at a bound truly were there.
    """

    groups: tuple[Group, ...]
    spread: Spread | FactoredSpread
    raw: Spread | FactoredSpread
    unseen: np.ndarray
    rank: int
    blind: np.ndarray
    held: np.ndarray


class FitEvidence(NamedTuple):
    """Input of the verdict's rules."""

    problem: Problem
    state: SearchState
    search: Search
    known: Known
    settled: bool
    variables: tuple[FittedVariable, ...]
    constraints: tuple[FittedConstraint, ...]

    @property
    def residue(self) -> str:
        """The KKT residual in words."""
        return f"(KKT residual {self.state.kkt.worst:.1e})"

    @property
    def optima(self) -> tuple[int, list[tuple[float, int]]]:
        """Number of starts on the answer; costs of other optima, and the number on each."""
        least = ALIKE * max(self.state.scale.cost, abs(self.state.at.cost))
        ends = [a.cost for a in self.search.attempts if a.kkt.worst <= self.problem.tolerance]
        agreed = sum(abs(cost - self.state.at.cost) <= least for cost in ends)
        seen: list[tuple[float, int]] = []
        for cost in (c for c in sorted(ends) if c - self.state.at.cost > least):
            if seen and cost - seen[-1][0] <= least:
                seen[-1] = (seen[-1][0], seen[-1][1] + 1)
            else:
                seen.append((cost, 1))
        return agreed, seen


def known(p: Problem, s: SearchState) -> Known:
    """Tell what the residuals know, along the limits that hold.

    For the degrees of freedom a number at an active bound is held; its error and that of what
    hangs on it are those of a number that the bound only limits. Weights that nobody asks for
    stay on their bounds.
    """
    held, on = assess.active_set(p, s, 1e-9)
    equations = s.at.jacobian[on]
    ends = np.cumsum([record.measured.size for record in p.records], dtype=int)
    parts = zip([0, *ends], [*ends, None], strict=True)
    blocks = [triangle(s.at.residual_jacobian[first:last]) for first, last in parts]
    nowhere = np.full(len(held), np.inf)
    seen = spread_of(_stacked(blocks), -nowhere, nowhere, held, None, equations)
    groups = groups_of(p.records, np.split(s.at.residual, ends)[:-1], blocks, seen)
    still = (np.isin(s.bounds.states, EDGES) & p.nuisance) | ~p.moving
    limited = np.isfinite(p.upper - p.lower) & p.moving & ~p.with_prior
    alike = np.array_equal(still, held) and not limited.any()

    def spread(factors, still):
        if alike and len({*factors, *[1.0] * bool(p.priors)}) <= 1:
            return seen.times(factors[0] if factors else 1.0)
        parts = [block / f for block, f in zip(blocks, [*factors, 1.0], strict=True)]
        return spread_of(_stacked(parts), p.lower, p.upper, still, p.with_prior, equations)

    factors = [group.factor for group in groups]
    scaled = spread(factors, still)
    plain = [1.0 if group.errors_given else group.factor for group in groups]
    raw = scaled if plain == factors else spread(plain, still)
    given_bounds = scaled if np.array_equal(still, held) else spread(factors, held)
    blind = (given_bounds.shares >= MOST_SHARE) & ~held
    unseen = seen.open / np.where((n := np.linalg.norm(seen.open, axis=0)) > 0, n, 1.0)
    return Known(groups, scaled, raw, unseen, seen.rank, blind, held)


def _stacked(blocks: list[Rows]) -> Rows:
    if any(map(sparse.issparse, blocks)):
        return sparse.csr_array(sparse.vstack(blocks))
    return np.vstack(blocks)


def settled(p: Problem, s: SearchState) -> bool:
    """True if the search ended at an optimum as far as the data can tell.

    The decrease of chi-square that a further Gauss-Newton step promises, noise being what the
    scatter says where no errors were given, is below `SETTLED`. Networks have flat valleys in which
    a strict optimum is never reached and nothing changes any more.
    """
    if p.objectives or not s.at.finite or not s.feasible:
        return False
    found = known(p, s)
    weight = np.ones(len(s.at.residual))
    for group in found.groups:
        weight[group.rows] = 1.0 if group.errors_given else group.factor**-2
    pull = s.at.residual_jacobian.T @ (weight * s.at.residual)
    outward = np.where(s.bounds.reached[0], pull > 0, s.bounds.reached[1] & (pull < 0))
    pull = np.where(outward | found.held, 0.0, pull)
    return bool(found.raw.size(pull) ** 2 < SETTLED)


# ---- the answer


def conclude(p: Problem, s: SearchState, search: Search, seconds: float) -> Fit:
    """Judge the best point of a search, `seconds` being the time taken."""
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
        return refused(p, lost, seconds, s.theta, search.attempts)
    found = known(p, s)
    variables, constraints = _variables(p, s, found), _constraints(p, s)
    chi2 = float(s.at.residual @ s.at.residual)
    priors = len(s.at.residual) - p.size
    dof = sum(group.count for group in found.groups) + priors - found.rank
    ratio = chi2 / dof if dof > 0 else np.nan
    judged = p.errors_known or not p.records
    scale = (np.sqrt(max(1.0, ratio)) if dof > 0 else 1.0) if judged else np.sqrt(ratio)
    rest = not s.optimal and settled(p, s)
    evidence = FitEvidence(p, s, search, found, rest, variables, constraints)
    finding = errors.judge(evidence, RULES if p.has_data else WITHOUT_DATA)
    message = " ".join([finding.message, *_remarks(evidence)])
    return Fit(
        p, s.theta, finding.status, message, float(s.at.cost), chi2, dof, found.groups, s.kkt,
        variables, constraints, found.spread, found.raw, s.at.residual_jacobian, found.unseen,
        float(scale), search.attempts, seconds, finding.about,
    )  # fmt: skip


def _inner_failure(p: Problem, theta: np.ndarray) -> str | None:
    """Failure of an implicit map in the model to converge at the answer, or None."""
    parts = jax.tree.leaves(p.core, is_leaf=lambda part: isinstance(part, Implicit))
    if not any(isinstance(part, Implicit) for part in parts):
        return None
    look = checkify.checkify(jax.jit(problem.values), errors=checkify.user_checks)
    said = look(p.core, jnp.asarray(theta, float))[0].get()
    return None if said is None else said.removesuffix(" (`check` failed)")


def _variables(p: Problem, s: SearchState, found: Known) -> tuple[FittedVariable, ...]:
    nothing = (found.spread.shares >= MOST_SHARE) | found.held
    nothing |= any(group.unknown for group in found.groups)
    errors = (np.where(nothing, np.nan, part.errors) for part in (found.spread, found.raw))
    columns = (s.theta, *errors, p.lower, p.upper, s.bounds.states, s.bounds.multiplier)
    return _rows(FittedVariable, p.names, *columns)


def _constraints(p: Problem, s: SearchState) -> tuple[FittedConstraint, ...]:
    columns = (*s.limits[:3], s.limits.states, s.limits.multiplier)
    return _rows(FittedConstraint, p.constraint_names, *columns)


def _rows(kind: type, names: tuple[str, ...], *columns: np.ndarray) -> tuple:
    return tuple(map(kind, names, *(column.tolist() for column in columns)))


def refused(p: Problem, found: Finding, seconds: float, theta=None, attempts=()) -> Fit:
    """A fit without an answer: where it stopped, and nothing determined."""
    theta = p.start if theta is None else theta
    n, nan = len(theta), np.nan
    lost = Spread(np.full((n, n), nan), np.eye(n), np.ones(n), np.zeros(n))
    none, free = np.full(n, nan), np.full(n, "free")
    variables = _rows(FittedVariable, p.names, theta, none, none, p.lower, p.upper, free, none)
    none = np.full(len(p.constraint_names), nan)
    ends, free = (p.constraint_lower, p.constraint_upper), np.full(len(none), "free")
    constraints = _rows(FittedConstraint, p.constraint_names, none, *ends, free, none)
    return Fit(
        p, theta, found.status, found.message, nan, nan, 0, (), assess.INFINITE_KKT, variables,
        constraints, lost, lost, np.zeros((p.size, n)), np.eye(n), nan, attempts, seconds,
    )  # fmt: skip


# ---- rules of every problem


def _crossed(e: FitEvidence) -> Finding | None:
    """Say which limits cannot be kept together."""
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
    cause = f"no point within all constraints was found from {e.search.words}:{place}"
    return Finding(Status.infeasible, cause, remedy, about)


def _endless(e: FitEvidence) -> Finding | None:
    """Say that the cost has no least value."""
    cost, far = float(e.state.at.cost), _far(e.state)
    if not e.problem.objectives or cost >= ENDLESS * e.state.scale.cost or outgrown(e.state):
        return None
    about = tuple(np.array(e.problem.names)[far].tolist())
    along = f" as {listed(about)} grows" if about else ""
    remedy = "bound the free numbers, or check the sign of the objective."
    cause = f"the cost falls without end{along} (down to {cost:.3g});"
    return Finding(Status.unbounded, cause, remedy, about)


def outgrown(s: SearchState) -> bool:
    """True if the start's cost is too small to serve as the scale of the final cost."""
    cost, scale = s.at.cost, s.scale
    pole = np.any(np.abs(s.at.gradient) * scale.unit > AWAY * abs(cost))
    return bool(cost < ENDLESS * scale.cost and np.isfinite(cost) and not (pole or _far(s).any()))


def _far(s: SearchState) -> np.ndarray:
    return np.abs(s.theta) > AWAY * s.scale.unit


def _restless(e: FitEvidence) -> Finding | None:
    """Say that the search ended short of an optimum."""
    curvature, steps = e.state.curvature, sum(a.iterations for a in e.search.attempts)
    why = None
    if not e.state.optimal and not e.settled:
        why = e.residue.strip("()")
    elif curvature is not None and curvature.direction is not None:
        why = "the cost still bends down there"
    elif curvature is not None and curvature.newton > assess.MAX_NEWTON_STEP:
        why = f"the next step is {curvature.newton:.1e} of the numbers' sizes"
    if why is None:
        return None
    cause = f"no optimum was reached from {e.search.words} ({why} after {steps} iterations);"
    remedy = "give more starts or iterations, or a better start."
    return Finding(Status.not_converged, cause, remedy)


# ---- rules of fits to data


def _undetermined(e: FitEvidence) -> Finding | None:
    """Say what the data do not determine, of what is asked for."""
    names = tuple(np.array(e.problem.names)[e.known.blind & ~e.problem.nuisance].tolist())
    if not names:
        return None
    found = gauges(e.problem, e.state.theta, e.known.unseen)
    tied = [g for g in found if set(names) & set(g.names)]
    if tied:
        return together(tied)
    cause = f"the data do not determine {listed(names)};"
    remedy = "add data of another kind, a prior, or fix it."
    return Finding(Status.unidentified, cause, remedy, names)


def _poor(e: FitEvidence) -> Finding | None:
    """Say that residuals with errors are larger than these allow."""
    # Records without errors cannot speak for or against the model.
    silent = [group for group in e.known.groups if not group.errors_given]
    r = e.state.at.residual
    counted = sum(group.count for group in e.known.groups) + len(r) - e.problem.size
    chi2 = float(r @ r) - sum(g.chi2 for g in silent)
    dof = counted - e.known.rank - sum(g.dof for g in silent)
    chance = chi2_probability(chi2, dof) if dof > 0 else 1.0
    if not e.problem.errors_known or chance >= POOR_FIT:
        return None
    cause = (
        f"chi2 = {chi2:.4g} for {dof:.4g} degrees of freedom happens by chance in {chance:.1e} "
        "of cases;"
    )
    remedy = "the model misses something or the errors are too small."
    return Finding(Status.poor_fit, cause, remedy)


def _held(e: FitEvidence) -> Finding | None:
    """Say which numbers a bound decided, where data were to."""
    pairs = zip(e.variables, e.problem.nuisance, strict=True)
    held = [v for v, nuisance in pairs if not nuisance and v.state in EDGES]
    if not held:
        return None
    cause = f"the best value lies at a bound: {listed(f'{v.name} ({v.state})' for v in held)};"
    return Finding(
        Status.at_limit, cause, "the bound decides it, not the data, so justify or widen it."
    )


def _converged(e: FitEvidence) -> Finding:
    """Say that nothing is wrong, and what kind of optimum it is."""
    start = f"an optimum was reached from {e.search.words} {e.residue}."
    higher = sum(count for _, count in e.optima[1]) if e.problem.objectives else 0
    if e.settled:
        start = (
            f"the search from {e.search.words} has settled where nothing that matters to the data "
            f"changes any more {e.residue}."
        )
    elif higher:
        start = (
            f"the best of several local optima was reached from {e.search.words} {e.residue}; "
            f"{higher} of them ended on others of higher cost."
        )
    return Finding(Status.converged, start)


class Gauge(NamedTuple):
    """Names of numbers that move together, and relative changes along one direction they may take.

    `free` tells in how many directions: as many of them must be fixed.
    """

    names: tuple[str, ...]
    changes: tuple[float, ...]
    free: int


def gauges(p: Problem, theta: np.ndarray, unseen: np.ndarray) -> tuple[Gauge, ...]:
    """Find symmetries among directions that the data do not see.

    A direction that residuals do not see at other settings either, made up at random, is none that
    further data could tell: it belongs to the model.

    Parameters
    ----------
    p : Problem
        The problem.
    theta : array, shape (n,)
        The point.
    unseen : array, shape (n, k)
        Directions that its residuals do not see there.

    Returns
    -------
    tuple of Gauge
        One for each set of at least two numbers that are tied.

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
    open_ones = _still(p, theta, unseen)
    if not open_ones.shape[1]:
        return ()
    basis = np.linalg.qr(open_ones)[0]
    size = _size(theta)
    part = np.linalg.norm(basis, axis=1)
    moved = np.flatnonzero(part > TIED**2)
    tied = np.abs(basis[moved] @ basis[moved].T) > TIED * np.outer(part[moved], part[moved]) + 1e-12
    group, found = connected_components(tied, directed=False)[1], []
    for one in dict.fromkeys(group.tolist()):
        at = moved[group == one]
        _, sizes, turned = np.linalg.svd(basis[at].T)
        free = int(np.sum(sizes > TIED * sizes[0]))
        change = turned[0] / size[at]
        if len(at) > 1 and free < len(at) and _everywhere(p, theta, at, free):
            shares = change / np.max(np.abs(change)) * np.sign(change[0])
            names = tuple(p.names[i] for i in at)
            found.append(Gauge(names, tuple(shares.tolist()), free))
    return tuple(found)


def _still(p: Problem, theta: np.ndarray, unseen: np.ndarray) -> np.ndarray:
    """Combinations of directions along which rows change at no made-up settings."""
    random, size = np.random.default_rng(0), _size(theta)
    length = np.linalg.norm(unseen / size[:, None], axis=0)
    along = unseen[:, length > 0] / length[length > 0]  # numbers that are held move nowhere
    if not along.shape[1]:
        return along
    rows = np.vstack([_made_up(p, theta, random) for _ in range(TEST_POINTS)])
    _, sizes, turned = np.linalg.svd(rows / size @ along, full_matrices=True)
    return along @ turned[int(np.sum(sizes > STILL)) :].T


def _everywhere(p: Problem, theta: np.ndarray, at: np.ndarray, free: int) -> bool:
    """True if numbers are tied at smaller values, too: those run along a ridge are not."""
    random = np.random.default_rng(0)
    for _ in range(TEST_POINTS):
        point = np.clip(theta * random.uniform(size=len(theta)), p.lower, p.upper)
        sizes = np.linalg.svd(_made_up(p, point, random)[:, at], compute_uv=False)
        if np.sum(sizes > STILL * np.max(sizes, initial=0.0)) > len(at) - free:
            return False
    return True


def _size(theta: np.ndarray) -> np.ndarray:
    return np.where(theta != 0, np.abs(theta), 1.0)


def _made_up(p: Problem, theta: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Rows at made-up settings, of unit length in the sizes of the numbers."""
    records = tuple(
        dataclasses.replace(r, data=jax.tree.map(lambda v: _moved(v, random), r.data))
        for r in p.core.records
    )
    core = dataclasses.replace(p.core, records=records)
    rows = np.asarray(flattened(core)(sloped)(theta)[1]) * _size(theta)
    rows = rows[np.all(np.isfinite(rows), axis=1)]
    for order in (np.inf, 2):  # the square of what grows without end has no number
        terms = np.linalg.norm(rows, order, axis=1, keepdims=True)
        rows = rows / np.where(terms > 0, terms, 1.0)
    return rows


def _moved(value: Any, random: np.random.Generator) -> Any:
    """Settings that are other ones, whole numbers apart."""
    value = np.asarray(value)
    if not np.issubdtype(value.dtype, np.floating) or not value.size:
        return value
    spread = float(np.std(value)) or float(np.max(np.abs(value))) or 1.0
    factor, shift = (TEST_DISTANCE * random.normal(size=value.shape) for _ in range(2))
    return value * (1 + factor) + spread * shift


def together(found: list[Gauge]) -> Finding:
    """Say which numbers move together whatever the data."""
    said = []
    for g in found:
        parts = [f"{n} {c:+.3g} %" for n, c in zip(g.names, g.changes, strict=True)]
        along = f" ({', '.join(parts[:4])})" if g.free == 1 else ""
        said.append(f"{listed(g.names)} move together{along}")
    cause = f"{'; '.join(said)}: no prediction changes, whatever the data, a freedom of the model;"
    count = sum(g.free for g in found)
    few = "one of them" if count == 1 else f"{count} of them"
    names = tuple(name for g in found for name in g.names)
    return Finding(Status.unidentified, cause, f"fix {few}, or give a prior.", names)


# ---- rules of an objective alone


def _degenerate(e: FitEvidence) -> Finding | None:
    """Say that multipliers are not unique, or that there are none."""
    found = dependence(e.problem, e.state, e.state.optimal)
    if found is None:
        return None
    names, gap = listed(map(repr, found.names)), "" if e.state.optimal else f" {e.residue}"
    one = "its gradient vanishes" if len(found.names) == 1 else "their gradients are dependent"
    if found.slopeless:
        cause = (
            f"{listed(map(repr, found.slopeless))} has no slope where it holds (no constraint "
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
    return Finding(Status.degenerate, cause, remedy, found.slopeless or found.names)


def _saddle(e: FitEvidence) -> Finding | None:
    """Say that the cost falls on both sides of a stationary point."""
    curvature = e.state.curvature
    if not e.state.optimal or curvature is None or curvature.direction is None:
        return None
    part = np.abs(curvature.direction / e.state.scale.unit)
    along = np.array(e.problem.names)[part > 0.3 * np.max(part)]
    cause = f"a saddle: the cost bends down along {listed(along)}, and the search did not get away;"
    return Finding(Status.saddle, cause, "start elsewhere, or give more starts.")


def _optimum(e: FitEvidence) -> Finding:
    """Say that it is the optimum, or the best of its starts, and what else they found."""
    agreed, others = e.optima
    if others:
        costs = [f"{cost:.6g} ({count})" for cost, count in others]
        return Finding(
            Status.local_optimum,
            f"the lowest of {1 + len(others)} local optima reached from {e.search.words}, at a "
            f"cost of {e.state.at.cost:.6g} {e.residue}; others at {listed(costs)}.",
        )
    if e.search.exact and convex(e.problem):
        said = f"the optimum was reached: the problem is convex {e.residue}."
        return Finding(Status.optimal, said)
    told = f"a local optimum was reached from 1 start {e.residue};"
    if len(e.search.attempts) > 1:
        told = (
            f"a local optimum, the best of {e.search.words}, of which {agreed} ended on it "
            f"{e.residue};"
        )
    remedy = "it is not proved to be the lowest, and more starts search further."
    return Finding(Status.local_optimum, told, remedy)


RULES = (_crossed, _endless, _restless, _undetermined, _poor, _held, _converged)
"""In order of gravity, for fits to data."""

WITHOUT_DATA = (_crossed, _endless, _degenerate, _saddle, _restless, _optimum)
"""The same for an objective alone."""


def _remarks(e: FitEvidence) -> list[str]:
    """Remarks on the starts and on the time limit."""
    search, said = e.search, []
    count, dropped = len(search.attempts), sum(np.isnan(a.cost) for a in search.attempts)
    if dropped:
        said.append(f"{dropped} of {count} starts dropped: cost not finite there.")
    if search.moved:
        said.append(f"{search.moved} of {count} starts moved onto their bounds.")
    if search.cut:
        said.append(f"The limit of {search.seconds:g} s cut the search.")
    lost = e.problem.has_data and not e.state.optimal and not e.settled
    if lost and e.state.feasible and (found := _degenerate(e)):
        said.append(found.message)
    return said
