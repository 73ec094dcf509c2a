"""The verdict on a problem with an objective and no data: what kind of point is it?"""

from __future__ import annotations

import numpy as np

from beamfit.greybox import assess, curvature
from beamfit.greybox.conflict import dependence
from beamfit.greybox.evidence import Evidence, listed
from beamfit.greybox.problem import Problem
from beamfit.status import Status
from beamfit.verdict import Finding

# Below this the cost counts as without end, in its own size.
ENDLESS = -1e15
# A number runs away beyond this many of its sizes; a pole is where the cost's slope in a number's
# size is that much larger than the cost.
AWAY = 1e6
# From this many starts that agree on one optimum it is taken for the only one: the number of optima
# expected then is below 1.5 (C. G. E. Boender & A. H. G. Rinnooy Kan, Mathematical Programming 37
# (1987) 59: w (N - 1)/(N - w - 2) for w seen from N starts).
AGREED = 7
# Costs of one optimum differ by less than this share, starts ending more or less near to it.
ALIKE = 1e-4
# Points at which a cost is looked at for being convex, and how far off in the sizes of numbers.
LOOKS, REACHES = 24, (0.1, 1.0, 10.0)


def crossed(e: Evidence) -> Finding | None:
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


def endless(e: Evidence) -> Finding | None:
    """Say that the cost has no least value."""
    cost, far = float(e.state.at.cost), _far(e.state)
    if not e.problem.objectives or cost >= ENDLESS * e.state.scale.cost or outgrown(e.state):
        return None
    along = f" as {listed(np.array(e.problem.names)[far])} grows" if far.any() else ""
    remedy = "bound the free numbers, or check the sign of the objective."
    cause = f"the cost falls without end{along} (down to {cost:.3g});"
    about = tuple(np.array(e.problem.names)[far].tolist())
    return Finding(Status.unbounded, cause, remedy, about)


def outgrown(s: assess.State) -> bool:
    """Whether the start's cost was so tiny that its size is no measure of the end's."""
    cost, scale = s.at.cost, s.scale
    pole = np.any(np.abs(s.at.gradient) * scale.unit > AWAY * abs(cost))
    return bool(cost < ENDLESS * scale.cost and np.isfinite(cost) and not (pole or _far(s).any()))


def _far(s: assess.State) -> np.ndarray:
    return np.abs(s.theta) > AWAY * s.scale.unit


def degenerate(e: Evidence) -> Finding | None:
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


def _gap(e: Evidence) -> str:
    """How far the point is from an optimum of first order, where it is none."""
    worst = e.state.kkt.worst
    return f" (KKT residual {worst:.1e})" if not e.state.optimal else ""


def saddle(e: Evidence) -> Finding | None:
    """Say that the cost falls on both sides of a stationary point."""
    bend = e.state.bend
    if not e.state.optimal or bend is None or bend.direction is None:
        return None
    part = np.abs(bend.direction / e.state.scale.unit)
    along = np.array(e.problem.names)[part > 0.3 * np.max(part)]
    cause = f"a saddle: the cost bends down along {listed(along)}, and the search did not get away;"
    return Finding(Status.saddle, cause, "start elsewhere, or give more starts.")


def restless(e: Evidence) -> Finding | None:
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


def others(e: Evidence) -> list[tuple[float, int]]:
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


def local(e: Evidence) -> Finding | None:
    """Say that there are other optima, or that nobody looked for them."""
    seen, worst = others(e), f"(KKT residual {e.state.kkt.worst:.1e})"
    if seen:
        costs = [f"{cost:.6g} ({count})" for cost, count in seen]
        return Finding(
            Status.local_optimum,
            f"the lowest of {1 + len(seen)} local optima reached from {e.search.words}, at a cost "
            f"of {e.state.at.cost:.6g} {worst}; others at {listed(costs)}.",
        )
    if _agreed(e) >= AGREED or (e.search.exact and _convex(e.problem, e.state)):
        return None
    return Finding(
        Status.local_optimum,
        f"an optimum of its neighbourhood was reached from {e.search.words} {worst};",
        f"whether another is lower only more starts tell ({AGREED} or more).",
    )


def optimal(e: Evidence) -> Finding:
    """Say what makes it the optimum."""
    agreed, words = _agreed(e), e.search.words
    why = f"{agreed} of {words} ended on it" if agreed >= AGREED else "the problem is convex there"
    cause = f"the optimum was reached: {why} (KKT residual {e.state.kkt.worst:.1e})."
    return Finding(Status.optimal, cause)


def _agreed(e: Evidence) -> int:
    """How many starts ended on the answer."""
    least = ALIKE * max(e.state.scale.cost, abs(e.state.at.cost))
    ends = (a for a in e.search.attempts if a.kkt.worst <= e.problem.tolerance)
    return sum(abs(a.cost - e.state.at.cost) <= least for a in ends)


def _convex(p: Problem, s: assess.State) -> bool:
    """Whether constraints are linear and the cost bends up, at points all over the bounds."""
    random, unit = np.random.default_rng(0), s.scale.unit
    ends = np.isfinite(p.lower) & np.isfinite(p.upper)
    low, width = np.where(ends, p.lower, 0.0), np.where(ends, p.upper - p.lower, 0.0)
    points = [s.theta]
    for i in range(LOOKS):
        around = s.theta + REACHES[i % len(REACHES)] * unit * random.normal(size=len(unit))
        inside = np.where(ends & (i % 2 == 0), low + random.uniform(size=len(unit)) * width, around)
        points.append(np.clip(inside, p.lower, p.upper))
    for point in points:
        at = assess.slopes(p, point)
        change = (at.jacobian - s.at.jacobian) * unit / s.limits.size[:, None]
        if not _above(s, s.theta, s.at, point, at) or not _above(s, point, at, s.theta, s.at):
            return False
        h = p.compiled(curvature.lagrangian_hessian)(point, 1.0, np.zeros(len(s.limits.size)))
        h = np.asarray(h) * np.outer(unit, unit)
        if not (np.all(np.abs(change) <= 1e-9) and np.all(np.isfinite(h))):
            return False
        bends = np.linalg.eigvalsh(h)
        if bends[0] < -1e-9 * max(bends[-1], 0.0) - 1e-12 * s.scale.cost:
            return False
    return True


def _above(
    s: assess.State, here: np.ndarray, at: assess.Slopes, there: np.ndarray, then: assess.Slopes
) -> bool:
    """Whether the cost there is not below the tangent here: kinks and jumps have no curvature."""
    rise = at.gradient @ (there - here)
    rounding = 1e-9 * (abs(at.cost) + abs(then.cost) + abs(rise)) + 1e-12 * s.scale.cost
    return bool(then.cost - at.cost - rise >= -rounding)
