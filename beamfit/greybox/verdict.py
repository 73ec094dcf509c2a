"""From the end of a search to a verdict: what the data determine, the gravest rule that applies."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import checkify

from beamfit import verdict
from beamfit.greybox import assess, curvature, problem
from beamfit.greybox.assess import TOLERANCE, State
from beamfit.greybox.covariance import (
    MOST_SHARE,
    Group,
    Spread,
    directions,
    groups_of,
    spread_of,
    triangle,
)
from beamfit.greybox.equations import Implicit
from beamfit.greybox.fit import Attempt, Fit, Limited, Variable
from beamfit.greybox.problem import Problem
from beamfit.statistics import POOR_FIT, chi2_probability
from beamfit.status import Status
from beamfit.verdict import Finding

__all__ = ["RULES", "Evidence", "Known", "Search", "conclude", "known", "refused", "settled"]

# A further decrease of chi-square below this changes nothing anybody asks for.
SETTLED = 0.01
# Below this the cost counts as without end, in its own size.
ENDLESS = -1e15


class Search(NamedTuple):
    """What was done: every start, how many were moved onto bounds, the limit of time if it cut."""

    attempts: tuple[Attempt, ...]
    moved: int = 0
    seconds: float | None = None
    cut: bool = False

    @property
    def dropped(self) -> int:
        """Starts at which something was not finite."""
        return sum(bool(np.isnan(attempt.cost)) for attempt in self.attempts)

    @property
    def words(self) -> str:
        """How many starts there were."""
        return f"{len(self.attempts)} start{'s' if len(self.attempts) != 1 else ''}"


class Known(NamedTuple):
    """What a point's residuals tell: groups of noise, spreads, directions not seen, rank.

    `blind` tells which numbers would be open even if what is at a bound truly were there.
    """

    groups: tuple[Group, ...]
    spread: Spread
    raw: Spread
    unseen: np.ndarray
    rank: int
    blind: np.ndarray
    held: np.ndarray


class Evidence(NamedTuple):
    """What a verdict rests on; `chi2` and `dof` are of what has errors."""

    problem: Problem
    state: State
    search: Search
    settled: bool
    variables: tuple[Variable, ...]
    constraints: tuple[Limited, ...]
    blind: np.ndarray
    chi2: float
    dof: float


def known(p: Problem, s: State) -> Known:
    """Tell what the residuals know, along the limits that hold.

    For the degrees of freedom a number at an active bound is held; its error and that of what
    hangs on it are those of a number that the bound only limits. Weights that nobody asks for
    stay on their bounds.
    """
    size = assess.gradient_size(p, s.at, s.scale)
    fixed = p.lower == p.upper
    held = fixed | (np.abs(s.found.bounds) > 1e-9 * size)
    equal = p.constraint_lower == p.constraint_upper
    pulls = np.abs(s.found.constraints) * np.linalg.norm(s.at.jacobian / size, axis=1)
    equations = s.at.jacobian[equal | (pulls > 1e-9)]
    ends = np.cumsum([record.measured.size for record in p.records], dtype=int)
    blocks = [triangle(part) for part in np.split(s.at.residual_jacobian, ends)]
    half, unseen, _ = directions(np.vstack(blocks), np.vstack([np.eye(len(held))[held], equations]))
    groups = groups_of(
        [(r.name, r.errors_given, r.prior_noise) for r in p.records],
        np.split(s.at.residual, ends)[:-1],
        [int(record.used.sum()) for record in p.records],
        blocks[:-1],
        half,
    )
    still = (np.isin(s.bounds.states(s.found.bounds), _EDGES) & p.nuisance) | fixed

    def spread(factors, still):
        parts = [block / f for block, f in zip(blocks, [*factors, 1.0], strict=True)]
        return spread_of(np.vstack(parts), p.lower, p.upper, still, p.with_prior, equations)

    factors = [group.factor for group in groups]
    scaled = spread(factors, still)
    plain = [1.0 if group.errors_given else group.factor for group in groups]
    raw = scaled if plain == factors else spread(plain, still)
    given_bounds = scaled if np.array_equal(still, held) else spread(factors, held)
    blind = (given_bounds.share(np.eye(len(held))) >= MOST_SHARE) & ~held
    unseen = unseen / np.where((n := np.linalg.norm(unseen, axis=0)) > 0, n, 1.0)
    return Known(groups, scaled, raw, unseen, half.shape[1], blind, held)


_EDGES = ("lower", "upper")


def settled(p: Problem, s: State) -> bool:
    """Whether the search ended at an optimum as far as the data can tell.

    The decrease of chi-square that a further Gauss-Newton step promises, noise being what the
    scatter says where no errors were given, is below `SETTLED`. Networks have flat valleys in which
    a strict optimum is never reached and nothing changes any more.
    """
    if p.objectives or not s.at.finite or s.kkt.feasibility > TOLERANCE:
        return False
    found = known(p, s)
    weight = np.ones(len(s.at.residual))
    for group in found.groups:
        weight[group.rows] = 1.0 if group.errors_given else group.factor**-2
    pull = s.at.residual_jacobian.T @ (weight * s.at.residual)
    outward = np.where(s.bounds.reached[0], pull > 0, s.bounds.reached[1] & (pull < 0))
    pull = np.where(outward | found.held, 0.0, pull)
    return bool(np.sum((pull @ found.raw.half) ** 2) < SETTLED)


def _inner_failure(p: Problem, theta: np.ndarray) -> str | None:
    """What an implicit map inside the model says of its own convergence at the answer."""
    if not p.has_part(Implicit):
        return None
    look = checkify.checkify(
        jax.jit(lambda core, t: (problem.cost(core, t), problem.constraints(core, t))),
        errors=checkify.user_checks,
    )
    said = look(p.core, jnp.asarray(theta, float))[0].get()
    return None if said is None else said.removesuffix(" (`check` failed)")


def conclude(p: Problem, s: State, search: Search, seconds: float) -> Fit:
    """Judge the best point of a search.

    Parameters
    ----------
    p : Problem
        The problem.
    s : State
        The best point.
    search : Search
        What was done.
    seconds : float
        Time taken.

    Returns
    -------
    Fit
    """
    failure = _inner_failure(p, s.theta)
    if failure or not s.at.finite:
        status, said = Status.not_finite, (
            "the cost or a derivative is not finite at the end of the search; bound the free "
            "numbers away from there, or use a parametrisation that stays defined."
        )  # fmt: skip
        if failure:
            status, said = Status.not_converged, (
                f"{failure} at the end of the search; start it nearer to its root, or bound the "
                "free numbers to where a root exists."
            )  # fmt: skip
        return refused(p, status, said, seconds, s.theta, search.attempts)
    found = known(p, s)
    variables, constraints = _variables(p, s, found), _constraints(p, s)
    chi2 = float(s.at.residual @ s.at.residual)
    priors = len(s.at.residual) - p.size
    dof = sum(group.count for group in found.groups) + priors - found.rank
    ratio = chi2 / dof if dof > 0 else np.nan
    judged = p.errors_known or not p.records
    scale = (np.sqrt(max(1.0, ratio)) if dof > 0 else 1.0) if judged else np.sqrt(ratio)
    # What has no errors cannot speak for or against the model.
    silent = [group for group in found.groups if not group.errors_given]
    spoken = chi2 - sum(g.chi2 for g in silent), dof - sum(g.dof for g in silent)
    rest = s.kkt.worst > TOLERANCE and settled(p, s)
    evidence = Evidence(p, s, search, rest, variables, constraints, found.blind, *spoken)
    finding = verdict.judge(evidence, RULES)
    message = " ".join([finding.message, *_remarks(evidence)])
    return Fit(
        p, s.theta, finding.status, message, float(s.at.cost), chi2, dof, found.groups, s.kkt,
        variables, constraints, found.spread, found.raw, s.at.residual_jacobian, found.unseen,
        float(scale), search.attempts, seconds,
    )  # fmt: skip


def _variables(p: Problem, s: State, found: Known) -> tuple[Variable, ...]:
    one = np.eye(len(s.theta))
    nothing = (found.spread.share(one) >= MOST_SHARE) | found.held
    nothing |= any(group.unknown for group in found.groups)
    errors = (np.where(nothing, np.nan, part.error(one)) for part in (found.spread, found.raw))
    edges = s.bounds.states(s.found.bounds).tolist()
    columns = [part.tolist() for part in (s.theta, *errors, p.lower, p.upper)]
    return tuple(map(Variable, p.names, *columns, edges, s.found.bounds.tolist()))


def _constraints(p: Problem, s: State) -> tuple[Limited, ...]:
    edges = s.limits.states(s.found.constraints).tolist()
    columns = [part.tolist() for part in s.limits[:3]]
    return tuple(map(Limited, p.constraint_names, *columns, edges, s.found.constraints.tolist()))


def refused(
    p: Problem,
    status: Status,
    message: str,
    seconds: float,
    theta: np.ndarray | None = None,
    attempts: tuple[Attempt, ...] = (),
) -> Fit:
    """A fit without an answer: where it stopped, and nothing determined."""
    theta = p.start if theta is None else theta
    n, nan, inf = len(theta), np.nan, np.inf
    lost = Spread(np.full((n, n), nan), np.eye(n), np.ones(n), np.zeros(n))
    variables = tuple(
        Variable(name, float(v), nan, nan, float(a), float(b), "free", nan)
        for name, v, a, b in zip(p.names, theta, p.lower, p.upper, strict=True)
    )
    limits = zip(p.constraint_names, p.constraint_lower, p.constraint_upper, strict=True)
    constraints = tuple(
        Limited(name, nan, float(a), float(b), "free", nan) for name, a, b in limits
    )
    return Fit(
        p, theta, status, message, nan, nan, 0, (), assess.KKT(inf, inf, inf), variables,
        constraints, lost, lost, np.zeros((p.size, n)), np.eye(n), nan, attempts, seconds,
    )  # fmt: skip


def _crossed(e: Evidence) -> Finding | None:
    """Say which limit could not be kept."""
    if e.state.kkt.feasibility <= TOLERANCE:
        return None
    place = " bounds: outside"
    if e.constraints:
        worst = e.constraints[int(np.argmax(e.state.limits.violation))]
        place = (
            f" '{worst.name}' ends at {worst.value:.4g}, outside"
            f" [{worst.lower:.4g}, {worst.upper:.4g}]"
        )
    cause = f"no point within all constraints was found from {e.search.words}:{place};"
    return Finding(Status.infeasible, cause, "relax it, free more numbers, or start elsewhere.")


def _endless(e: Evidence) -> Finding | None:
    """Say that the cost has no least value."""
    cost = float(e.state.at.cost)
    if not e.problem.objectives or cost >= ENDLESS * e.state.scale.cost:
        return None
    remedy = "bound the free numbers, or check the sign of the objective."
    return Finding(Status.unbounded, f"the cost falls without end (down to {cost:.3g});", remedy)


def _restless(e: Evidence) -> Finding | None:
    """Say that the search ended short of an optimum."""
    bend, steps = e.state.bend, sum(a.iterations for a in e.search.attempts)
    why = None
    if e.state.kkt.worst > TOLERANCE and not e.settled:
        why = f"KKT residual {e.state.kkt.worst:.1e}"
    elif bend is not None and bend.direction is not None:
        why = "the cost still bends down there"
    elif bend is not None and bend.newton > curvature.STEP:
        why = f"the next step is {bend.newton:.1e} of the numbers' sizes"
    if why is None:
        return None
    cause = f"no optimum was reached from {e.search.words} ({why} after {steps} iterations);"
    remedy = "give more starts or iterations, or a better start."
    return Finding(Status.not_converged, cause, remedy)


def _undetermined(e: Evidence) -> Finding | None:
    """Say what the data do not determine, of what is asked for."""
    open_ones = e.blind & ~e.problem.nuisance
    if not open_ones.any() or not (e.problem.records or e.problem.priors):
        return None
    cause = f"the data do not determine {_list(np.array(e.problem.names)[open_ones])};"
    return Finding(Status.unidentified, cause, "add data of another kind, a prior, or fix it.")


def _poor(e: Evidence) -> Finding | None:
    """Say that the residuals are larger than the errors allow."""
    chance = chi2_probability(e.chi2, e.dof) if e.dof > 0 else 1.0
    if not e.problem.errors_known or chance >= POOR_FIT:
        return None
    cause = (
        f"chi2 = {e.chi2:.4g} for {e.dof:.4g} degrees of freedom happens by chance in {chance:.1e} "
        "of cases;"
    )
    remedy = "the model misses something or the errors are too small."
    return Finding(Status.poor_fit, cause, remedy)


def _held(e: Evidence) -> Finding | None:
    """Say which numbers a bound decided, where data were to."""
    pairs = zip(e.variables, e.problem.nuisance, strict=True)
    held = [v for v, nuisance in pairs if not nuisance and v.state in _EDGES]
    if not held or not (e.problem.records or e.problem.priors):
        return None
    cause = f"the best value lies at a bound: {_list(f'{v.name} ({v.state})' for v in held)};"
    return Finding(
        Status.at_limit, cause, "the bound decides it, not the data, so justify or widen it."
    )


def _optimal(e: Evidence) -> Finding:
    """Say that nothing is wrong, and what kind of optimum it is."""
    worst = f"(KKT residual {e.state.kkt.worst:.1e})"
    if e.settled:
        cause = (
            f"the search from {e.search.words} has settled where nothing that matters to the data "
            f"changes any more {worst}."
        )
        return Finding(Status.converged, cause)
    higher = 0
    if e.problem.objectives:
        least = TOLERANCE * max(e.state.scale.cost, abs(e.state.at.cost))
        ends = [a for a in e.search.attempts if a.kkt.worst <= TOLERANCE]
        higher = sum(a.cost - e.state.at.cost > least for a in ends)
    if higher:
        cause = (
            f"the best of several local optima was reached from {e.search.words} {worst}; {higher} "
            "of them ended on others of higher cost."
        )
        return Finding(Status.converged, cause)
    return Finding(Status.converged, f"an optimum was reached from {e.search.words} {worst}.")


RULES = (_crossed, _endless, _restless, _undetermined, _poor, _held, _optimal)
"""In order of gravity."""


def _remarks(e: Evidence) -> list[str]:
    """What became of starts, and whether time ran out."""
    search, said = e.search, []
    count = len(search.attempts)
    if search.dropped:
        said.append(f"{search.dropped} of {count} starts dropped: cost not finite there.")
    if search.moved:
        said.append(f"{search.moved} of {count} starts moved onto their bounds.")
    if search.cut:
        said.append(f"The limit of {search.seconds:g} s cut the search.")
    return said


def _list(names: Iterable[str]) -> str:
    """A few names for a sentence."""
    names = list(names)
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
