"""Solve a problem: let solvers propose points, keep the best, test whether it is an optimum."""

from __future__ import annotations

import time
from collections.abc import Iterable
from functools import partial

import numpy as np

from beamfit.errors import Finding, InputError, Status
from beamfit.greybox import assess
from beamfit.greybox.assess import SearchState
from beamfit.greybox.descend import Descent, costs, descent_of
from beamfit.greybox.diagnosis import contradictory, find_conflict, not_finite
from beamfit.greybox.fit import Attempt, Fit
from beamfit.greybox.judge import Search, conclude, cost_outgrew_scale, has_settled, refuse
from beamfit.greybox.problem import Problem
from beamfit.greybox.programs import INTERIOR_POINT, SOLVERS, NonlinearProgram, SearchLimit

METHOD, SQUARES = "Levenberg-Marquardt", "levenberg-marquardt"
# Number of steps from each of many starts, before the best ends are refined.
FIRST_STEPS = 300
# Largest number of ends that are refined, beginning with the lowest cost.
MAX_REFINED = 4
# Steps after which a refined search is tested for progress.
TEST_INTERVAL = 100
# It stops if its cost fell by less than this share in that interval and it has settled.
NEGLIGIBLE_GAIN = 1e-7
# Largest number of times that a search leaves a saddle.
MAX_ESCAPES = 3


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

    Least squares with bounds alone are solved by `beamfit.greybox.descend`, from all starts at
    once. Problems with constraints or further objectives are solved by Uno's sequential quadratic
    programming, first with the Gauss-Newton Hessian (networks fitted to few data have flat valleys
    in which the exact one is slow), then with the exact Hessian, then by scipy if Uno finds no
    optimum. Least squares with fewer residuals than free numbers begin with Uno's interior-point
    method. KKT residuals and a second-order test of this package, in scales of the problem, decide
    if a point is an optimum. From a saddle the search moves away and continues. The best feasible
    point is the answer, whatever its status.

    Parameters
    ----------
    p : Problem
        The problem to solve.
    starts : int
        Number of starts: the model's own values first, then random ones.
    seed : int
        Seed of the random starts.
    iterations : int
        Largest number of iterations of a solver from one start.
    hessian : str
        ``"exact"``, or ``"gauss_newton"`` to use first derivatives only, for models without second
        ones (foreign code).
    seconds : float, optional
        Time limit for all starts and stages together, compilation included. It is tested between
        steps, so that a compilation is not interrupted.
    solver : {"levenberg-marquardt", "filtersqp", "ipopt", "slsqp"}, optional
        The only solver to use. By default all that suit the problem are tried in turn. The first is
        for least squares within bounds.
    began : float, optional
        Value of `time.perf_counter` from which `seconds` count; the time of the call by default.

    Returns
    -------
    Fit
        A search that fails raises nothing: `Fit.status` states it.

    Raises
    ------
    InputError
        If an option is not understood, or foreign code lacks a derivative that is needed.

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
    _check_options(hessian, seconds, solver, squares)
    contradictions = contradictory(p)
    if contradictions:
        spent = time.perf_counter() - began
        return refuse(p, Finding(Status.contradictory_bounds, contradictions[0].message), spent)
    drawn = _draw_starts(p, starts, seed)
    points = np.clip(drawn, p.lower, p.upper)
    moved = int(np.sum(np.any(points != drawn, axis=1)))
    until = None if seconds is None else began + seconds
    budget = SearchLimit(iterations, until, solver, p.tolerance)
    if not squares or solver not in (None, SQUARES):
        found, attempts = _search_constrained(p, points, budget, hessian)
    else:
        found, attempts = _search_squares(p, points, budget)
    spent = time.perf_counter() - began
    if not found:
        message = "the cost or a constraint is not finite at any start;"
        remedy = "start elsewhere, or use a parametrisation that is defined there."
        lost = Finding(Status.not_finite, message, remedy)
        if starts == 1 and (traced := not_finite(p, points[0])):
            lost = Finding(Status.not_finite, traced[0].message)
        return refuse(p, lost, spent, None, attempts)
    best, conflict = found[_best(p, found)], None
    if not best.feasible and p.constraints and best.at.finite and budget.seconds_left > 0:
        conflict = find_conflict(p, best, starting_points(p, 6, seed))
        if conflict.feasible:
            further, again = _search_constrained(p, conflict.theta[None], budget, hessian)
            found, attempts = found + further, attempts + again
            best = found[_best(p, found)]
    exact = hessian == "exact"
    done = Search(attempts, moved, seconds, budget.seconds_left <= 0, exact, conflict)
    return conclude(p, best, done, time.perf_counter() - began)


def _check_options(hessian: str, seconds: float | None, solver: str | None, squares: bool) -> None:
    if hessian not in ("exact", "gauss_newton"):
        raise InputError(f"hessian '{hessian}'", "one of exact, gauss_newton")
    if seconds is not None and not seconds > 0:
        raise InputError(f"{seconds} seconds", "a time above 0, or none")
    solvers = [SQUARES] * squares + list(dict.fromkeys(stage.preset for stage in SOLVERS))
    if solver is not None and solver not in solvers:
        raise InputError(f"solver '{solver}' for this problem", f"one of {', '.join(solvers)}")


def starting_points(p: Problem, number: int, seed: int) -> list[np.ndarray]:
    """Draw starts: the model's values moved inside the bounds, then random ones.

    Parameters
    ----------
    p : Problem
        The problem.
    number : int
        Number of starts.
    seed : int
        Seed of the random generator.

    Returns
    -------
    list of array, shape (n,)
    """
    return list(np.clip(_draw_starts(p, number, seed), p.lower, p.upper))


def _draw_starts(p: Problem, number: int, seed: int) -> np.ndarray:
    """Draw starts within their ranges, else within finite bounds, else about the model's values."""
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


def _is_optimum(s: SearchState) -> bool:
    """True if a point meets the first- and second-order conditions of an optimum."""
    test = s.curvature
    if test is not None and (test.direction is not None or test.newton > assess.MAX_NEWTON_STEP):
        return False
    return s.optimal


def _best(p: Problem, found: list[SearchState]) -> int:
    """Return the index of the feasible point with the lowest cost, or of the least infeasible one.

    An optimum is preferred among points of equal cost: within one standard deviation, or within the
    problem's tolerance times the scale of the cost at the first start. The cost that a point saves
    by a small violation of its limits is added again; their multipliers determine it.
    """

    def rank(s: SearchState) -> tuple:
        feasible = s.feasible
        saved = np.abs(s.limits.multiplier) @ (s.limits.violation * s.limits.scale)
        return (not feasible, s.at.cost + saved if feasible else s.kkt.feasibility)

    order = sorted(range(len(found)), key=lambda i: rank(found[i]))
    first = found[order[0]]
    if not first.feasible:
        return order[0]
    # The scale at the first start, which is the problem's: far away all costs may be tiny.
    tolerance = p.tolerance * found[0].scale.cost if p.objectives else 0.5 * p.least_residual**2
    equal = [i for i in order if rank(found[i]) <= (False, rank(first)[1] + tolerance)]
    return next((i for i in equal if _is_acceptable(p, found[i])), order[0])


def _is_acceptable(p: Problem, s: SearchState) -> bool:
    """True if a search may end at a point: an optimum, or settled within the data's accuracy."""
    return _is_optimum(s) or (not p.constraints and has_settled(p, s))


def search(
    p: Problem, start: np.ndarray, iterations: int = 3000, hessian: str = "exact"
) -> tuple[SearchState, Attempt]:
    """Search from one start.

    Parameters
    ----------
    p, iterations, hessian
        As for `solve`.
    start : array, shape (n,)
        Starting point; cost and constraints are finite there.

    Returns
    -------
    tuple of SearchState and Attempt
        The end point with its KKT residuals, and the record of the search.
    """
    start, budget = np.asarray(start, float), SearchLimit(iterations, None, None, p.tolerance)
    if p.constraints or p.objectives:
        return _search_from(p, start, assess.slopes(p, start), budget, hessian)
    found, attempts = _search_squares(p, start[None], budget)
    return found[0], attempts[0]


# ---- least squares within bounds: all starts at once


def _search_squares(
    p: Problem, points: np.ndarray, budget: SearchLimit
) -> tuple[list[SearchState], tuple[Attempt, ...]]:
    """Search from all starts, in groups that fit the memory, and refine the best ends."""
    group_size = max(1, 2**21 // ((p.size + 1) * len(p.names)))  # at most 16 MB of Jacobians
    found: list[SearchState] = []
    attempts: list[Attempt] = []
    for group in np.split(points, range(group_size, len(points), group_size)):
        states, records = _search_group(p, group, budget)
        found, attempts = found + states, attempts + records
    return found, tuple(attempts)


def _search_group(
    p: Problem, points: np.ndarray, budget: SearchLimit
) -> tuple[list[SearchState], list[Attempt]]:
    """Search from starts together; refine the best ends, until one is acceptable."""
    k = len(points)
    searches = descent_of(p, points)
    searches.run(np.arange(k), min(FIRST_STEPS, budget.iterations), budget.until)
    cost = searches.cost
    found: dict[int, SearchState] = {}
    for lane in np.argsort(cost, kind="stable")[:MAX_REFINED].tolist():
        if not np.isfinite(cost[lane]):
            break
        _refine(p, searches, lane, budget.iterations, budget)
        found[lane] = _escape_saddles(p, searches, lane, budget)
        if _is_acceptable(p, found[lane]):
            break
    records = [_attempt_of(p, searches, lane, found.get(lane)) for lane in range(k)]
    return list(found.values()), records


def _refine(p: Problem, searches: Descent, lane: int, limit: int, budget: SearchLimit) -> None:
    """Continue one search until it rests, or has settled in a flat valley without progress."""
    while not searches.done[lane] and searches.steps[lane] < limit and budget.seconds_left > 0:
        before = searches.cost[lane]
        steps = min(limit, int(searches.steps[lane]) + TEST_INTERVAL)
        searches.run(np.array([lane]), steps, budget.until)
        gained = before - searches.cost[lane]
        if gained < NEGLIGIBLE_GAIN * before and has_settled(p, _state_of(p, searches, lane)):
            return


def _attempt_of(p: Problem, searches: Descent, lane: int, s: SearchState | None) -> Attempt:
    theta, steps = searches.theta[lane].copy(), int(searches.steps[lane])
    if not np.isfinite(searches.cost[lane]):
        return Attempt(METHOD, theta, np.nan, assess.INFINITE_KKT, steps, "cost not finite")
    message = "came to rest" if searches.rested[lane] else "ran out of iterations"
    s = _state_of(p, searches, lane) if s is None else s
    return Attempt(METHOD, theta, float(s.at.cost), s.kkt, steps, message)


def _state_of(p: Problem, searches: Descent, lane: int) -> SearchState:
    """Compute the KKT residuals at the present point of one search."""
    theta = searches.theta[lane].copy()
    at = assess.slopes_of_squares(searches.residual[lane].copy(), searches.jacobian[lane])
    return assess.state(p, theta, assess.scale_of(p, theta, at), at)


def _escape_saddles(p: Problem, searches: Descent, lane: int, budget: SearchLimit) -> SearchState:
    """Test the end of one search; leave it and continue as long as it is a saddle."""
    s = _state_of(p, searches, lane)
    for _ in range(MAX_ESCAPES):
        cost_at = partial(costs, p, searches)
        point = assess.find_lower_point(p, s, cost_at) if s.at.finite else None
        if point is None or budget.seconds_left <= 0:
            break
        searches.restart(lane, point)
        _refine(p, searches, lane, int(searches.steps[lane]) + budget.iterations, budget)
        s = _state_of(p, searches, lane)
    return s


# ---- constraints and further objectives: one start after the other


def _search_constrained(
    p: Problem, points: Iterable[np.ndarray], budget: SearchLimit, hessian: str
) -> tuple[list[SearchState], tuple[Attempt, ...]]:
    """Search from one start after the other, until the time is up."""
    found, attempts = [], []
    for point in points:
        if found and budget.seconds_left <= 0:
            break
        at = assess.slopes(p, point)
        if not (np.isfinite(at.cost) and np.all(np.isfinite(at.constraints))):
            lost = assess.INFINITE_KKT
            attempts.append(Attempt("none", point, np.nan, lost, 0, "cost not finite"))
            continue
        s, attempt = _search_from(p, point, at, budget, hessian)
        if p.objectives and cost_outgrew_scale(s):  # again from there, with the scales there
            s, attempt = _search_from(p, s.theta, assess.slopes(p, s.theta), budget, hessian)
        found.append(s)
        attempts.append(attempt)
    return found, tuple(attempts)


def _search_from(
    p: Problem, start: np.ndarray, at: assess.Slopes, budget: SearchLimit, hessian: str
) -> tuple[SearchState, Attempt]:
    """Search with one solver for constraints after the other, until one ends on an optimum."""
    scale = assess.scale_of(p, start, at)
    # Gauss-Newton ignores further objectives; foreign code may lack second derivatives.
    usable = {"none", hessian} if p.objectives else {"none", "gauss_newton", hessian}
    underdetermined = p.residual_count + int(np.sum(p.equations)) < int(np.sum(p.moving))
    order = (INTERIOR_POINT, *SOLVERS) if underdetermined and not p.objectives else SOLVERS
    stages = [s for s in order if s.hessian in usable and budget.solver in (None, s.preset)]
    exact = hessian == "exact"
    best, tried, steps, message = None, [], 0, ""
    for stage in stages:
        program = NonlinearProgram(p, start, at, scale, stage.hessian)
        feasible = best is not None and best.feasible
        current = best.theta if feasible else start
        if not feasible and stage.name in tried:
            continue
        for _ in range(1 + MAX_ESCAPES):
            most = min(stage.steps, budget.iterations)
            end = stage.solve(program, program.point(current), most, budget)
            s = assess.state(p, np.clip(program.numbers(end.x), p.lower, p.upper), scale)
            steps, message = steps + end.iterations, end.message
            point = None
            if s.optimal:
                s, point = assess.second_order(p, s, exact)
            if best is None or _best(p, [best, s]) == 1:
                best = s
            if point is None or budget.seconds_left <= 0:
                break
            current = point
        tried.append(stage.name)
        if _is_optimum(best) or budget.seconds_left <= 0:
            break
    return best, Attempt(
        ", ".join(tried), best.theta, float(best.at.cost), best.kkt, steps, message
    )
