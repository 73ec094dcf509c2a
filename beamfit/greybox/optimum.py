"""The kind of point a search ended on, by what it rests on: residuals, multipliers, proofs.

A problem is proved convex, so that its optimum is the only one, by the rules of composition of
convex functions, followed through the program of cost and constraints (M. Grant, S. Boyd & Y. Ye,
in Global Optimization, L. Liberti & N. Maculan eds., Springer 2006, 155), or because a cost is
quadratic and its Hessian, which is then the same everywhere, has no negative eigenvalue. A point
that no rule covers is the best of its starts.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy import sparse

from beamfit.greybox import assess, curvature, problem
from beamfit.greybox.assess import SearchState
from beamfit.greybox.conflict import Conflict, dependence
from beamfit.greybox.covariance import (
    MOST_SHARE,
    FactoredSpread,
    Group,
    Rows,
    Spread,
    groups_of,
    spread_of,
    triangle,
)
from beamfit.greybox.fit import Attempt, FittedConstraint, FittedVariable
from beamfit.greybox.problem import Problem
from beamfit.greybox.sparsity import followed, moves
from beamfit.status import Status
from beamfit.verdict import Finding

# A search is settled if a further step lowers chi-square by less: a tenth of a standard error.
SETTLED = 0.01
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
    def dropped(self) -> int:
        """Starts at which something was not finite."""
        return sum(bool(np.isnan(attempt.cost)) for attempt in self.attempts)

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
    """Input of the verdict's rules; `chi2` and `dof` count residuals with errors only.

    `unseen` (n, k) are the directions that residuals do not see.
    """

    problem: Problem
    state: SearchState
    search: Search
    settled: bool
    variables: tuple[FittedVariable, ...]
    constraints: tuple[FittedConstraint, ...]
    blind: np.ndarray
    unseen: np.ndarray
    chi2: float
    dof: float


def known(p: Problem, s: SearchState) -> Known:
    """Tell what the residuals know, along the limits that hold.

    For the degrees of freedom a number at an active bound is held; its error and that of what
    hangs on it are those of a number that the bound only limits. Weights that nobody asks for
    stay on their bounds.
    """
    held, on = assess.holding(p, s, 1e-9)
    equations = s.at.jacobian[on]
    ends = np.cumsum([record.measured.size for record in p.records], dtype=int)
    parts = zip([0, *ends], [*ends, None], strict=True)
    blocks = [triangle(s.at.residual_jacobian[first:last]) for first, last in parts]
    nowhere = np.full(len(held), np.inf)
    seen = spread_of(_stacked(blocks), -nowhere, nowhere, held, None, equations)
    groups = groups_of(p.records, np.split(s.at.residual, ends)[:-1], blocks[:-1], seen)
    still = (np.isin(s.bounds.states(s.found.bounds), EDGES) & p.nuisance) | ~p.moving

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


def listed(names: Iterable[str]) -> str:
    """A few names for a sentence."""
    names = list(names)
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")


# Linear operations on elements.
SUMS = {
    "reduce_sum",
    "cumsum",
    "convert_element_type",
    "copy",
    "add",
    "add_any",
    "reduce_precision",
}
# Operations that are linear where an operand that says which or where to is known.
PLACES = {"select_n": 0, "scatter": 1, "scatter-add": 1}
# Functions of one affine or convex argument that are convex and do not fall, likewise for concave.
RISING_CONVEX, RISING_CONCAVE = {"exp", "exp2", "expm1"}, {"log", "log1p", "sqrt"}
# Negative eigenvalues of a Hessian below this share of the largest are rounding.
ROUNDING = 1e-12


class _Unknown(Exception):
    """No rule covers an operation."""


class Curvature(NamedTuple):
    """Curvature and degree of every element of an array as a function of the numbers.

    `sign` is 0 if it is affine, 1 convex, -1 concave, None if it is not known; `degree` is that of
    a polynomial, infinite if it is none.
    """

    sign: int | None
    degree: float


def convex(p: Problem) -> bool:
    """True if the problem is proved convex: a convex cost within a convex set."""
    cost = _curve(p, problem.cost)
    if cost is None or not (_upward(cost) or (cost.degree <= 2 and _positive(p))):
        return False
    if not p.constraints:
        return True
    limits = _curve(p, problem.constraints)
    if limits is None:
        return False
    below, above = np.isfinite(p.constraint_lower).any(), np.isfinite(p.constraint_upper).any()
    return bool(
        limits.sign == 0
        or limits.degree <= 1
        or (limits.sign == 1 and not below)
        or (limits.sign == -1 and not above)
    )


def _upward(curve: Curvature) -> bool:
    return curve.sign in (0, 1)


def _positive(p: Problem) -> bool:
    """True if the Hessian of a quadratic cost has no negative eigenvalue."""
    h = np.asarray(p.compiled(_hessian)(p.start))
    if not np.all(np.isfinite(h)):
        return False
    values = np.linalg.eigvalsh(h)
    return bool(values[0] >= -ROUNDING * len(h) * max(values[-1], 0.0))


def _hessian(core, theta):
    return jax.hessian(problem.cost, 1)(core, theta)


def _curve(p: Problem, function) -> Curvature | None:
    """Curvature of a function of (core, theta) in theta; None if it is not known."""
    program, given = p.program(function)
    try:
        (found,) = followed(program, [*given, Curvature(0, 1.0)], _rule, Curvature)
    except _Unknown:
        return None
    return found if isinstance(found, Curvature) else Curvature(0, 0.0)


def _rule(step, operands: list[Any]) -> list[Curvature]:
    found = _of_step(step, operands)
    if found.sign is None and not np.isfinite(found.degree):
        raise _Unknown
    return [found] * len(step.outvars)


def _of_step(step, operands: list[Any]) -> Curvature:
    name = step.primitive.name
    numbers = [v for v in operands if isinstance(v, Curvature)]
    first, degree = numbers[0], max(v.degree for v in numbers)
    if name in SUMS or moves(step, operands, Curvature):
        return Curvature(_common([v.sign for v in numbers]), degree)
    place = PLACES.get(name)
    if place is not None and not isinstance(operands[place], Curvature):
        return Curvature(_common([v.sign for v in numbers]), degree)
    if name == "neg":
        return Curvature(_times(first.sign, -1), degree)
    if name == "sub":
        signs = [v.sign if i == 0 else _times(v.sign, -1)
                 for i, v in enumerate(operands) if isinstance(v, Curvature)]  # fmt: skip
        return Curvature(_common(signs), degree)
    if name in ("mul", "dot_general") or (name == "div" and not isinstance(operands[1], Curvature)):
        return _product(step, operands, numbers)
    if name in ("square", "integer_pow"):
        power = 2 if name == "square" else step.params["y"]
        return _power(first, power)
    return Curvature(_composed(name, numbers), np.inf)


def _product(step, operands: list[Any], numbers: list[Curvature]) -> Curvature:
    if len(numbers) == 2:
        same = step.invars[0] is step.invars[1]
        return Curvature(
            1 if same and numbers[0].sign == 0 else None, sum(v.degree for v in numbers)
        )
    factor = np.asarray(next(v for v in operands if not isinstance(v, Curvature)))
    sign = 1 if np.all(factor >= 0) else -1 if np.all(factor <= 0) else None
    known = numbers[0].sign
    return Curvature(0 if known == 0 else _times(known, sign), numbers[0].degree)


def _power(v: Curvature, power: int) -> Curvature:
    if power < 0:
        return Curvature(None, np.inf)
    if power <= 1:
        return Curvature(v.sign if power else 0, v.degree * power)
    return Curvature(1 if v.sign == 0 and power % 2 == 0 else None, v.degree * power)


def _composed(name: str, numbers: list[Curvature]) -> int | None:
    signs = {v.sign for v in numbers}
    if name in RISING_CONVEX | {"max", "reduce_max"} and signs <= {0, 1}:
        return 1
    if name in RISING_CONCAVE | {"min", "reduce_min"} and signs <= {0, -1}:
        return -1
    if name in ("abs", "cosh") and signs == {0}:
        return 1
    return None


def _common(signs: list[int | None]) -> int | None:
    """Sign of a sum's curvature: the one of all its terms that are not affine, else None."""
    bent = {sign for sign in signs if sign != 0}
    return 0 if not bent else bent.pop() if len(bent) == 1 else None


def _times(sign: int | None, factor: int | None) -> int | None:
    return 0 if sign == 0 else None if sign is None or factor is None else sign * factor


# A cost below this, in units of its size, counts as unbounded.
ENDLESS = -1e15
# A number beyond this many of its sizes runs away; at a pole the cost's slope per size of a number
# exceeds the cost by this factor.
AWAY = 1e6
# Relative difference in cost up to which two starts ended on the same optimum.
ALIKE = 1e-4


def crossed(e: FitEvidence) -> Finding | None:
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
        place += f" {listed(map(repr, conflict.constraints))} cannot hold"
        place += "" if one and not conflict.bounds else " together" if not one else ""
        place += f" within {listed(conflict.bounds)}" if conflict.bounds else ""
        place += ";" if one and not conflict.bounds else ", without any one of them it can;"
        remedy = f"relax {'it' if one else 'one of them'}, free more numbers, or start elsewhere."
    cause = f"no point within all constraints was found from {e.search.words}:{place}"
    return Finding(Status.infeasible, cause, remedy, about)


def endless(e: FitEvidence) -> Finding | None:
    """Say that the cost has no least value."""
    cost, far = float(e.state.at.cost), _far(e.state)
    if not e.problem.objectives or cost >= ENDLESS * e.state.scale.cost or outgrown(e.state):
        return None
    along = f" as {listed(np.array(e.problem.names)[far])} grows" if far.any() else ""
    remedy = "bound the free numbers, or check the sign of the objective."
    cause = f"the cost falls without end{along} (down to {cost:.3g});"
    about = tuple(np.array(e.problem.names)[far].tolist())
    return Finding(Status.unbounded, cause, remedy, about)


def outgrown(s: assess.SearchState) -> bool:
    """True if the start's cost is too small to serve as the scale of the final cost."""
    cost, scale = s.at.cost, s.scale
    pole = np.any(np.abs(s.at.gradient) * scale.unit > AWAY * abs(cost))
    return bool(cost < ENDLESS * scale.cost and np.isfinite(cost) and not (pole or _far(s).any()))


def _far(s: assess.SearchState) -> np.ndarray:
    return np.abs(s.theta) > AWAY * s.scale.unit


def degenerate(e: FitEvidence) -> Finding | None:
    """Say that multipliers are not unique, or that there are none."""
    s = e.state
    found = dependence(e.problem, s, s.optimal)
    if found is None:
        return None
    names = listed(map(repr, found.names))
    if found.slopeless:
        flat = listed(map(repr, found.slopeless))
        return Finding(
            Status.degenerate,
            f"{flat} has no slope where it holds (no constraint qualification), so that it has no "
            f"multiplier and solvers stop anywhere along it{_gap(e)};",
            "state what it is made of one by one, g <= 0 in the place of "
            "sum(max(g, 0)^2) <= 0 or g^2 <= 0.",
            found.slopeless,
        )
    one = "its gradient vanishes" if len(found.names) == 1 else "their gradients are dependent"
    if s.optimal:
        return Finding(
            Status.degenerate,
            f"an optimum, but where {names} hold {one}, so that multipliers are not unique;",
            "leave out what the others imply, or read their multipliers together.",
            found.names,
        )
    return Finding(
        Status.degenerate,
        f"where {names} hold {one} (no constraint qualification), so that the best point has "
        f"no multipliers{_gap(e)};",
        "state them so that their gradients differ.",
        found.names,
    )


def _gap(e: FitEvidence) -> str:
    """KKT residual in words, or nothing at an optimum of first order."""
    worst = e.state.kkt.worst
    return f" (KKT residual {worst:.1e})" if not e.state.optimal else ""


def saddle(e: FitEvidence) -> Finding | None:
    """Say that the cost falls on both sides of a stationary point."""
    bend = e.state.bend
    if not e.state.optimal or bend is None or bend.direction is None:
        return None
    part = np.abs(bend.direction / e.state.scale.unit)
    along = np.array(e.problem.names)[part > 0.3 * np.max(part)]
    cause = f"a saddle: the cost bends down along {listed(along)}, and the search did not get away;"
    return Finding(Status.saddle, cause, "start elsewhere, or give more starts.")


def restless(e: FitEvidence) -> Finding | None:
    """Say that the search ended short of an optimum."""
    bend, steps = e.state.bend, sum(a.iterations for a in e.search.attempts)
    why = None
    if not e.state.optimal and not e.settled:
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


def others(e: FitEvidence) -> list[tuple[float, int]]:
    """Costs of other optima on which starts ended, and of how many."""
    least = ALIKE * max(e.state.scale.cost, abs(e.state.at.cost))
    ends = sorted(a.cost for a in e.search.attempts if a.kkt.worst <= e.problem.tolerance)
    seen: list[tuple[float, int]] = []
    for cost in (c for c in ends if c - e.state.at.cost > least):
        if seen and cost - seen[-1][0] <= least:
            seen[-1] = (seen[-1][0], seen[-1][1] + 1)
        else:
            seen.append((cost, 1))
    return seen


def local(e: FitEvidence) -> Finding | None:
    """Say that there are other optima, or that nobody looked for them."""
    seen, worst = others(e), f"(KKT residual {e.state.kkt.worst:.1e})"
    if seen:
        costs = [f"{cost:.6g} ({count})" for cost, count in seen]
        return Finding(
            Status.local_optimum,
            f"the lowest of {1 + len(seen)} local optima reached from {e.search.words}, at a cost "
            f"of {e.state.at.cost:.6g} {worst}; others at {listed(costs)}.",
        )
    if e.search.exact and convex(e.problem):
        return None
    starts, agreed = len(e.search.attempts), _agreed(e)
    told = f"a local optimum, the best of {starts} starts, of which {agreed} ended on it {worst};"
    if starts == 1:
        told = f"a local optimum was reached from 1 start {worst};"
    remedy = "it is not proved to be the lowest, and more starts search further."
    return Finding(Status.local_optimum, told, remedy)


def optimal(e: FitEvidence) -> Finding:
    """Say that it is the optimum, and why."""
    worst = e.state.kkt.worst
    cause = f"the optimum was reached: the problem is convex (KKT residual {worst:.1e})."
    return Finding(Status.optimal, cause)


def _agreed(e: FitEvidence) -> int:
    """Number of starts that ended on the answer."""
    least = ALIKE * max(e.state.scale.cost, abs(e.state.at.cost))
    ends = (a for a in e.search.attempts if a.kkt.worst <= e.problem.tolerance)
    return sum(abs(a.cost - e.state.at.cost) <= least for a in ends)
