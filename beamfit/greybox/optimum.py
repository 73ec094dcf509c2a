"""The verdict on a problem with an objective and no data: what kind of point is it?"""

from __future__ import annotations

import numpy as np

from beamfit.greybox import assess, curvature
from beamfit.greybox.conflict import dependence
from beamfit.greybox.evidence import FitEvidence, listed
from beamfit.greybox.proof import convex
from beamfit.status import Status
from beamfit.verdict import Finding

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
