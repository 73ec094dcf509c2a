"""Solve a problem: propose points, keep the best, judge it ourselves."""

from __future__ import annotations

import time
from collections.abc import Iterable
from functools import partial

import numpy as np

from beamfit.errors import Finding, InputError, Status
from beamfit.greybox import assess
from beamfit.greybox.assess import SearchState
from beamfit.greybox.descend import Descent, costs, descent_of
from beamfit.greybox.diagnosis import contradictory, not_finite, relaxed
from beamfit.greybox.fit import Attempt, Fit
from beamfit.greybox.judge import Search, conclude, cost_outgrew_scale, has_settled, refuse
from beamfit.greybox.problem import Problem
from beamfit.greybox.programs import INSIDE, SOLVERS, NonlinearProgram, SearchLimit

METHOD, SQUARES = "Levenberg-Marquardt", "levenberg-marquardt"
# Steps from each of many starts, and number of cheapest ends that are polished.
STEPS, POLISHED = 300, 4
# A search stops if its cost falls by less than this share in this many steps.
NOTHING, STRETCH = 1e-7, 100
# Most moves of a search off a saddle.
MOVES = 3


def solve(
    p: Problem,
    starts: int = 1,
    seed: int = 0,
    iterations: int = 3000,
    hessian: str = "exact",
    seconds: float | None = None,
    solver: str | None = None,
    began: float | None = None,
) -> Fit:
    """Minimise the cost of a problem within its bounds and constraints.

    Least squares with bounds alone go to `beamfit.greybox.descend`, from all starts at once.
    Problems with constraints or further objectives go to Uno's sequential quadratic programming,
    with the Gauss-Newton Hessian first (networks fitted to few data have flat valleys in which the
    exact one crawls), then with the exact Hessian, then to scipy where Uno ends without an optimum.
    Squares of fewer residuals than free numbers begin with its interior point.
    Whether a point is an optimum is decided by our own KKT residual and second-order test, in the
    problem's own sizes; where the cost bends down, the search moves off and goes on. The best
    feasible point is the answer, whatever its status.

    Parameters
    ----------
    p : Problem
        What to fit.
    starts : int
        Number of starts: the model's own values first, then random ones.
    seed : int
        Of the random starts.
    iterations : int
        Most iterations of a solver from one start.
    hessian : str
        ``"exact"``, or ``"gauss_newton"`` to keep to first derivatives, for models that bring no
        second ones (foreign code).
    seconds : float, optional
        For all starts and stages together, compilation included: looked at between them, so that
        what is being compiled is finished first.
    solver : {"levenberg-marquardt", "filtersqp", "ipopt", "slsqp"}, optional
        The one to use, in the place of all that suit the problem in turn. The first is for least
        squares within bounds.
    began : float, optional
        Moment of `time.perf_counter` from which `seconds` count; that of the call by default.

    Returns
    -------
    Fit
        Never raises for a search that fails: `Fit.status` says so.

    Raises
    ------
    InputError
        If an option is not understood, or foreign code lacks a derivative it was asked for.

    Examples
    --------
    >>> from beamfit.greybox.problem import Free, Record
    >>> def line(model, x):
    ...     return model["slope"] * x
    >>> data = Record("scan", line, np.arange(4.0), [0.0, 2.1, 3.9, 6.0], error=0.1)
    >>> fit = solve(Problem({"slope": 1.0}, [Free("slope", 0, 10)], [data]))
    >>> fit.status, round(fit["slope"].value, 4), round(fit["slope"].error, 4)
    (<Status.converged: 'converged'>, 1.9929, 0.0267)
    """
    began = time.perf_counter() if began is None else began
    squares = not (p.constraints or p.objectives)
    if starts < 1 or iterations < 1:
        raise InputError(f"{starts} starts of {iterations} iterations", "at least one of each")
    _check(hessian, seconds, solver, squares)
    wrong = contradictory(p)
    if wrong:
        spent = time.perf_counter() - began
        return refuse(p, Finding(Status.contradictory_bounds, wrong[0].message), spent)
    drawn = _drawn(p, starts, seed)
    points = np.clip(drawn, p.lower, p.upper)
    moved = int(np.sum(np.any(points != drawn, axis=1)))
    until = None if seconds is None else began + seconds
    budget = SearchLimit(iterations, until, solver, p.tolerance)
    if not squares or solver not in (None, SQUARES):
        found, attempts = _one_by_one(p, points, budget, hessian)
    else:
        found, attempts = _together(p, points, budget)
    spent = time.perf_counter() - began
    if not found:
        said = "the cost or a constraint is not finite at any start;"
        remedy = "start elsewhere, or use a parametrisation that is defined there."
        lost = Finding(Status.not_finite, said, remedy)
        if starts == 1 and (traced := not_finite(p, points[0])):
            lost = Finding(Status.not_finite, traced[0].message)
        return refuse(p, lost, spent, None, attempts)
    best, conflict = found[_best(p, found)], None
    if not best.feasible and p.constraints and best.at.finite and budget.left > 0:
        conflict = relaxed(p, best, starting_points(p, 6, seed))
        if conflict.feasible:
            more, again = _one_by_one(p, conflict.theta[None], budget, hessian)
            found, attempts = found + more, attempts + again
            best = found[_best(p, found)]
    exact = hessian == "exact"
    done = Search(attempts, moved, seconds, budget.left <= 0, exact, conflict)
    return conclude(p, best, done, time.perf_counter() - began)


def _check(hessian: str, seconds: float | None, solver: str | None, squares: bool) -> None:
    if hessian not in ("exact", "gauss_newton"):
        raise InputError(f"hessian '{hessian}'", "one of exact, gauss_newton")
    if seconds is not None and not seconds > 0:
        raise InputError(f"{seconds} seconds", "a time above 0, or none")
    known = [SQUARES] * squares + list(dict.fromkeys(stage.preset for stage in SOLVERS))
    if solver is not None and solver not in known:
        raise InputError(f"solver '{solver}' for this problem", f"one of {', '.join(known)}")


def starting_points(p: Problem, number: int, seed: int) -> list[np.ndarray]:
    """Draw starts: the model's own values inside the bounds, then random ones.

    Parameters
    ----------
    p : Problem
        The problem.
    number : int
        How many.
    seed : int
        Of the random generator.

    Returns
    -------
    list of array, shape (n,)
    """
    return list(np.clip(_drawn(p, number, seed), p.lower, p.upper))


def _drawn(p: Problem, number: int, seed: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    width = np.maximum(np.abs(p.start), 1.0)
    boxed = np.isfinite(p.lower) & np.isfinite(p.upper)
    given = np.isfinite(p.start_range[0])
    low = np.where(given, p.start_range[0], np.where(boxed, p.lower, 0.0))
    high = np.where(given, p.start_range[1], np.where(boxed, p.upper, 0.0))
    points = [p.start]
    for _ in range(number - 1):
        within = low + random.uniform(size=len(low)) * (high - low)
        around = p.start + width * random.normal(size=len(low))
        points.append(np.where(given | boxed, within, around))
    return np.array(points)


def _good(s: SearchState) -> bool:
    """True if a point is an optimum to second order."""
    bent = s.curvature is not None and (
        s.curvature.direction is not None or s.curvature.newton > assess.MAX_NEWTON_STEP
    )
    return s.optimal and not bent


def _best(p: Problem, found: list[SearchState]) -> int:
    """The cheapest feasible point, or the least infeasible; of equally cheap ones an optimum.

    Equally cheap are those within one standard deviation, or 1e-6 of the cost's scale
    at the first start. What a point
    saves by lying a little outside its limits is no merit: their multipliers tell how much that is.
    """

    def rank(s: SearchState) -> tuple:
        feasible = s.feasible
        saved = np.abs(s.limits.multiplier) @ (s.limits.violation * s.limits.size)
        return (not feasible, s.at.cost + saved if feasible else s.kkt.feasibility)

    order = sorted(range(len(found)), key=lambda i: rank(found[i]))
    first = found[order[0]]
    if not first.feasible:
        return order[0]
    # The first start is the problem's own; one far out may lie where all costs are tiny.
    near = p.tolerance * found[0].scale.cost if p.objectives else 0.5 * p.least_residual**2
    alike = [i for i in order if rank(found[i]) <= (False, rank(first)[1] + near)]
    return next((i for i in alike if _rests(p, found[i])), order[0])


def _rests(p: Problem, s: SearchState) -> bool:
    return _good(s) or (not p.constraints and has_settled(p, s))


def search(
    p: Problem, start: np.ndarray, iterations: int = 3000, hessian: str = "exact"
) -> tuple[SearchState, Attempt]:
    """Search from one start.

    Parameters
    ----------
    p, iterations, hessian
        As for `solve`.
    start : array, shape (n,)
        Where to start; cost and constraints are finite there.

    Returns
    -------
    tuple of SearchState and Attempt
        The end point, judged, and the account of it.
    """
    start, budget = np.asarray(start, float), SearchLimit(iterations, None, None, p.tolerance)
    if p.constraints or p.objectives:
        return _program(p, start, assess.slopes(p, start), budget, hessian)
    found, attempts = _together(p, start[None], budget)
    return found[0], attempts[0]


# ---- least squares within bounds: all starts at once


def _together(
    p: Problem, points: np.ndarray, budget: SearchLimit
) -> tuple[list[SearchState], tuple[Attempt, ...]]:
    """Search from all starts, in parts that fit the memory, and polish the cheapest ends."""
    part = max(1, 2**21 // ((p.size + 1) * len(p.names)))  # Jacobians of 16 MB
    found: list[SearchState] = []
    attempts: list[Attempt] = []
    for some in np.split(points, range(part, len(points), part)):
        states, accounts = _lanes(p, some, budget)
        found, attempts = found + states, attempts + accounts
    return found, tuple(attempts)


def _lanes(
    p: Problem, points: np.ndarray, budget: SearchLimit
) -> tuple[list[SearchState], list[Attempt]]:
    k = len(points)
    lanes = descent_of(p, points)
    lanes.run(np.arange(k), min(STEPS, budget.iterations), budget.until)
    cost = lanes.cost
    found: dict[int, SearchState] = {}
    for lane in np.argsort(cost, kind="stable")[:POLISHED].tolist():
        if not np.isfinite(cost[lane]):
            break
        _go_on(p, lanes, lane, budget.iterations, budget)
        found[lane] = _moved_off(p, lanes, lane, budget)
        if _rests(p, found[lane]):
            break
    accounts = [_account(p, lanes, lane, found.get(lane)) for lane in range(k)]
    return list(found.values()), accounts


def _go_on(p: Problem, lanes: Descent, lane: int, limit: int, budget: SearchLimit) -> None:
    """Polish one search until it rests, or has settled in a flat valley where it gains nothing."""
    while not lanes.done[lane] and lanes.steps[lane] < limit and budget.left > 0:
        before = lanes.cost[lane]
        lanes.run(np.array([lane]), min(limit, int(lanes.steps[lane]) + STRETCH), budget.until)
        gained = before - lanes.cost[lane]
        if gained < NOTHING * before and has_settled(p, _judged(p, lanes, lane)):
            return


def _account(p: Problem, lanes: Descent, lane: int, s: SearchState | None) -> Attempt:
    theta, steps = lanes.theta[lane].copy(), int(lanes.steps[lane])
    if not np.isfinite(lanes.cost[lane]):
        return Attempt(METHOD, theta, np.nan, assess.INFINITE_KKT, steps, "cost not finite")
    said = "came to rest" if lanes.rested[lane] else "ran out of iterations"
    s = _judged(p, lanes, lane) if s is None else s
    return Attempt(METHOD, theta, float(s.at.cost), s.kkt, steps, said)


def _judged(p: Problem, lanes: Descent, lane: int) -> SearchState:
    """Judged end of one search."""
    theta = lanes.theta[lane].copy()
    at = assess.slopes_of_squares(lanes.residual[lane].copy(), lanes.jacobian[lane])
    return assess.state(p, theta, assess.scale_of(p, theta, at), at)


def _moved_off(p: Problem, lanes: Descent, lane: int, budget: SearchLimit) -> SearchState:
    """Judge one end; where the cost bends down there, move off and go on."""
    s = _judged(p, lanes, lane)
    for _ in range(MOVES):
        look = partial(costs, p, lanes)
        point = assess.find_lower_point(p, s, look) if s.at.finite else None
        if point is None or budget.left <= 0:
            break
        lanes.restart(lane, point)
        _go_on(p, lanes, lane, int(lanes.steps[lane]) + budget.iterations, budget)
        s = _judged(p, lanes, lane)
    return s


# ---- constraints and further objectives: one start after the other


def _one_by_one(
    p: Problem, points: Iterable[np.ndarray], budget: SearchLimit, hessian: str
) -> tuple[list[SearchState], tuple[Attempt, ...]]:
    found, attempts = [], []
    for point in points:
        if found and budget.left <= 0:
            break
        at = assess.slopes(p, point)
        if not (np.isfinite(at.cost) and np.all(np.isfinite(at.constraints))):
            attempts.append(
                Attempt("none", point, np.nan, assess.INFINITE_KKT, 0, "cost not finite")
            )
            continue
        s, attempt = _program(p, point, at, budget, hessian)
        if p.objectives and cost_outgrew_scale(s):  # from there in the sizes it has there
            s, attempt = _program(p, s.theta, assess.slopes(p, s.theta), budget, hessian)
        found.append(s)
        attempts.append(attempt)
    return found, tuple(attempts)


def _program(
    p: Problem, start: np.ndarray, at: assess.Slopes, budget: SearchLimit, hessian: str
) -> tuple[SearchState, Attempt]:
    """Search with the solvers for constraints, until one ends on an optimum."""
    scale = assess.scale_of(p, start, at)
    # Squares say nothing of further objectives; foreign code may have first derivatives only.
    usable = {"none", hessian} if p.objectives else {"none", "gauss_newton", hessian}
    loose = p.residual_count + int(np.sum(p.equations)) < int(np.sum(p.moving))
    order = (INSIDE, *SOLVERS) if loose and not p.objectives else SOLVERS
    stages = [s for s in order if s.hessian in usable and budget.solver in (None, s.preset)]
    exact = hessian == "exact"
    best, tried, steps, said = None, [], 0, ""
    for stage in stages:
        program = NonlinearProgram(p, start, at, scale, stage.hessian)
        near = best is not None and best.feasible
        begin = best.theta if near else start
        if not near and stage.name in tried:
            continue
        for _ in range(1 + MOVES):
            most = min(stage.steps, budget.iterations)
            end = stage.solve(program, program.point(begin), most, budget)
            s = assess.state(p, np.clip(program.numbers(end.x), p.lower, p.upper), scale)
            steps, said = steps + end.iterations, end.said
            point = None
            if s.optimal:
                s, point = assess.second_order(p, s, exact)
            if best is None or _best(p, [best, s]) == 1:
                best = s
            if point is None or budget.left <= 0:
                break
            begin = point
        tried.append(stage.name)
        if _good(best) or budget.left <= 0:
            break
    return best, Attempt(", ".join(tried), best.theta, float(best.at.cost), best.kkt, steps, said)
