"""Solve a problem: propose points, keep the best, judge it ourselves."""

from __future__ import annotations

import time
from collections.abc import Iterable
from functools import partial

import jax
import numpy as np
from rich.console import Console
from rich.progress import track

from beamfit.errors import InputError
from beamfit.greybox import assess, problem
from beamfit.greybox.assess import TOLERANCE, State
from beamfit.greybox.descend import DAMPING, walk
from beamfit.greybox.fit import Attempt, Fit
from beamfit.greybox.problem import Problem
from beamfit.greybox.programs import SOLVERS, Budget, scaled
from beamfit.greybox.verdict import Search, conclude, refused, settled
from beamfit.status import Status

__all__ = ["search", "solve", "starting_points"]


# Steps from many starts; what is left is for the polish of the cheapest ends.
STEPS, POLISHED = 300, 4
# With a limit of time the clock is looked at after so many steps.
SEGMENT = 50
# Searches side by side at least, so that the points beside an end are looked at in one call.
LANES = 4
# Bytes that Jacobians of starts searched together may take.
MEMORY = 2**24
# How often a search moves off where the cost bends down.
MOVES = 3


def solve(
    p: Problem,
    starts: int = 1,
    seed: int = 0,
    iterations: int = 3000,
    hessian: str = "exact",
    progress: bool = False,
    seconds: float | None = None,
) -> Fit:
    """Minimise the cost of a problem within its bounds and constraints.

    Least squares with bounds alone go to `beamfit.greybox.descend`, from all starts at once.
    Problems with constraints or further objectives go to Uno's sequential quadratic programming,
    with the Gauss-Newton Hessian first (networks fitted to few data have flat valleys in which the
    exact one crawls), then with the exact Hessian, then to scipy where Uno ends without an optimum.
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
    progress : bool
        Show a progress bar over the starts on standard error.
    seconds : float, optional
        For all starts and stages together, looked at between them and compilation apart.

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
    began = time.perf_counter()
    _check(starts, iterations, hessian, seconds)
    wrong = [n for n, a, b in zip(p.names, p.lower, p.upper, strict=True) if not a <= b]
    wrong += [
        n
        for n, a, b in zip(p.constraint_names, p.constraint_lower, p.constraint_upper, strict=True)
        if not a <= b
    ]
    if wrong:
        said = f"the lower bound of {wrong[0]} lies above its upper bound; correct the bounds."
        return refused(p, Status.contradictory_bounds, said, time.perf_counter() - began)
    drawn = _drawn(p, starts, seed)
    points = np.clip(drawn, p.lower, p.upper)
    moved = int(np.sum(np.any(points != drawn, axis=1)))
    budget = Budget(iterations, None if seconds is None else began + seconds)
    if p.constraints or p.objectives:
        found, attempts = _one_by_one(p, _bar(points, progress), budget, hessian)
    else:
        found, attempts = _together(p, points, budget, progress)
    spent = time.perf_counter() - began
    if not found:
        place = "the start" if starts == 1 else "any start"
        said = (
            f"the cost or a constraint is not finite at {place}; "
            "start elsewhere, or use a parametrisation that is defined there."
        )
        return refused(p, Status.not_finite, said, spent, None, attempts)
    best = found[_best(p, found)]
    return conclude(p, best, Search(attempts, moved, seconds, budget.left <= 0), spent)


def _check(starts: int, iterations: int, hessian: str, seconds: float | None) -> None:
    if hessian not in ("exact", "gauss_newton"):
        raise InputError(f"hessian '{hessian}'", "one of exact, gauss_newton")
    if starts < 1 or iterations < 1:
        raise InputError(f"{starts} starts of {iterations} iterations", "at least one of each")
    if seconds is not None and not seconds > 0:
        raise InputError(f"{seconds} seconds", "a time above 0, or none")


def _bar(points: np.ndarray, progress: bool) -> Iterable:
    if not progress:
        return points
    return track(points, "fitting", console=Console(stderr=True), transient=True)


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


def _good(s: State) -> bool:
    """Whether a point is an optimum, to second order."""
    bent = s.bend is not None and (s.bend.direction is not None or s.bend.newton > assess.STEP)
    return s.kkt.worst <= TOLERANCE and not bent


def _best(p: Problem, found: list[State]) -> int:
    """The cheapest feasible point, or the least infeasible; of equally cheap ones an optimum.

    Equally cheap are those within one standard deviation, or 1e-6 of the cost's scale.
    """

    def rank(s: State) -> tuple:
        feasible = s.kkt.feasibility <= TOLERANCE
        return (not feasible, s.at.cost if feasible else s.kkt.feasibility)

    order = sorted(range(len(found)), key=lambda i: rank(found[i]))
    first = found[order[0]]
    if first.kkt.feasibility > TOLERANCE:
        return order[0]
    near = TOLERANCE * first.scale.cost if p.objectives else 0.5 * p.least_residual**2
    alike = [i for i in order if rank(found[i]) <= (False, first.at.cost + near)]
    return next((i for i in alike if _rests(p, found[i])), order[0])


def _rests(p: Problem, s: State) -> bool:
    return _good(s) or (not p.constraints and settled(p, s))


def search(
    p: Problem, start: np.ndarray, iterations: int = 3000, hessian: str = "exact"
) -> tuple[State, Attempt]:
    """Search from one start.

    Parameters
    ----------
    p, iterations, hessian
        As for `solve`.
    start : array, shape (n,)
        Where to start; cost and constraints are finite there.

    Returns
    -------
    tuple of State and Attempt
        The end point, judged, and the account of it.
    """
    start, budget = np.asarray(start, float), Budget(iterations, None)
    if p.constraints or p.objectives:
        return _program(p, start, assess.slopes(p, start), budget, hessian)
    found, attempts = _together(p, start[None], budget, False)
    return found[0], attempts[0]


# ---- least squares within bounds: all starts at once


class _Lanes:
    """Searches side by side: one compiled call moves them on, or looks at points."""

    def __init__(self, p: Problem, points: np.ndarray):
        self.p, self.call = p, p.compiled(_walks)
        k, n = points.shape
        self.theta, self.limit = np.array(points), np.zeros(k, int)
        self.damping, self.growth = np.full(k, DAMPING), np.full(k, 2.0)
        self.size, self.steps = np.zeros((k, n)), np.zeros(k, int)
        self.done, self.rested = np.zeros(k, bool), np.zeros(k, bool)

    def go(self, lanes: np.ndarray, limit: int, budget: Budget) -> None:
        """Move some searches on to a number of steps, or until time is up."""
        self.limit[:] = 0
        reached = limit if budget.until is None else 0
        while True:
            reached = min(max(reached, int(np.min(self.steps[lanes])) + SEGMENT), limit)
            self.limit[lanes] = np.where(self.done[lanes], 0, reached)
            self._call()
            unfinished = ~self.done[lanes] & (self.steps[lanes] < limit)
            if not unfinished.any() or budget.left <= 0:
                return

    def _call(self) -> None:
        args = (self.theta, self.damping, self.growth, self.size, self.steps, self.limit)
        s = [np.asarray(part) for part in self.call(*args, self.p.lower, self.p.upper)]
        self.theta, self.residual, self.jacobian, self.size, self.damping, self.growth, *s = s
        self.steps, rested, stuck = s
        self.rested |= rested
        self.done |= rested | stuck

    @property
    def cost(self) -> np.ndarray:
        """Half the sum of squares of each; infinite where something is not finite."""
        cost = 0.5 * np.sum(self.residual**2, axis=1)
        return np.where(np.isfinite(cost), cost, np.inf)

    def look(self, points: np.ndarray) -> np.ndarray:
        """Cost at points, without moving."""
        k, found = len(self.theta), []
        for part in np.split(points, range(k, len(points), k)):
            filled = np.concatenate([part, np.repeat(part[:1], k - len(part), axis=0)])
            none = np.zeros(k, int)
            args = (filled, self.damping, self.growth, self.size, none, none)
            r = np.asarray(self.call(*args, self.p.lower, self.p.upper)[1])
            found.append(0.5 * np.sum(r**2, axis=1)[: len(part)])
        return np.concatenate(found)

    def move(self, lane: int, point: np.ndarray) -> None:
        """Begin one search anew."""
        self.theta, self.size = self.theta.copy(), self.size.copy()
        self.damping, self.growth = self.damping.copy(), self.growth.copy()
        self.theta[lane], self.size[lane] = point, 0.0
        self.damping[lane], self.growth[lane] = DAMPING, 2.0
        self.done[lane] = self.rested[lane] = False

    def state(self, lane: int, scale: assess.Scale | None = None) -> State:
        """One search's end, judged."""
        at = assess.of_squares(self.residual[lane], self.jacobian[lane])
        scale = assess.scale_of(self.p, self.theta[lane], at) if scale is None else scale
        return assess.state(self.p, self.theta[lane].copy(), scale, at)


def _walks(core, starts, damping, growth, size, steps, limit, lower, upper):
    """Searches from starts, each with its own memory and limit of steps."""
    residual = partial(problem.residual, core)

    def one(theta, damping, growth, size, steps, limit):
        memory = (damping, growth, size, steps)
        s = walk(residual, theta, lower, upper, limit, memory=memory)
        parts = (s.theta, s.residual, s.jacobian, s.scale, s.damping, s.growth)
        return (*parts, s.steps, s.rested, s.stuck)

    return jax.vmap(one)(starts, damping, growth, size, steps, limit)


def _together(
    p: Problem, points: np.ndarray, budget: Budget, progress: bool
) -> tuple[list[State], tuple[Attempt, ...]]:
    """Search from all starts, in parts that fit the memory, and polish the cheapest ends."""
    part = max(1, MEMORY // (8 * (p.size + 1) * len(p.names)))
    found: list[State] = []
    attempts: list[Attempt] = []
    for some in _bar(np.split(points, range(part, len(points), part)), progress):
        states, accounts = _lanes(p, some, budget)
        found, attempts = found + states, attempts + accounts
    return found, tuple(attempts)


def _lanes(p: Problem, points: np.ndarray, budget: Budget) -> tuple[list[State], list[Attempt]]:
    k = len(points)
    spare = 0 if points.shape[1] * p.size > MEMORY / 64 else max(0, LANES - k)
    lanes = _Lanes(p, np.concatenate([points, np.repeat(points[:1], spare, axis=0)]))
    first = budget.iterations if k == 1 else min(STEPS, budget.iterations)
    lanes.go(np.arange(k), first, budget)
    cost = lanes.cost[:k]
    found: list[State] = []
    for lane in np.argsort(cost, kind="stable")[:POLISHED]:
        if not np.isfinite(cost[lane]):
            break
        if not lanes.done[lane]:
            lanes.go(lane[None], budget.iterations, budget)
        found.append(_moved_off(p, lanes, int(lane), budget))
        if _rests(p, found[-1]):
            break
    return found, [_account(lanes, lane) for lane in range(k)]


def _account(lanes: _Lanes, lane: int) -> Attempt:
    theta, name = lanes.theta[lane].copy(), "Levenberg-Marquardt"
    if not np.isfinite(lanes.cost[lane]):
        lost = assess.KKT(np.inf, np.inf, np.inf)
        return Attempt(name, theta, np.nan, lost, int(lanes.steps[lane]), "cost not finite")
    said = "came to rest" if lanes.rested[lane] else "ran out of iterations"
    s = lanes.state(lane)
    return Attempt(name, theta, float(s.at.cost), s.kkt, int(lanes.steps[lane]), said)


def _moved_off(p: Problem, lanes: _Lanes, lane: int, budget: Budget) -> State:
    """Judge one end; where the cost bends down there, move off and go on."""
    for _ in range(MOVES):
        s = lanes.state(lane)
        if not s.at.finite:
            return s
        point = assess.lower_beside(p, s, lanes.look)
        if point is None or budget.left <= 0:
            break
        lanes.move(lane, point)
        lanes.go(np.array([lane]), int(lanes.steps[lane]) + budget.iterations, budget)
    return lanes.state(lane)


# ---- constraints and further objectives: one start after the other


def _one_by_one(
    p: Problem, points: Iterable[np.ndarray], budget: Budget, hessian: str
) -> tuple[list[State], tuple[Attempt, ...]]:
    found, attempts = [], []
    for point in points:
        if found and budget.left <= 0:
            break
        at = assess.slopes(p, point)
        if not (np.isfinite(at.cost) and np.all(np.isfinite(at.constraints))):
            lost = assess.KKT(np.inf, np.inf, np.inf)
            attempts.append(Attempt("none", point, np.nan, lost, 0, "cost not finite"))
            continue
        s, attempt = _program(p, point, at, budget, hessian)
        found.append(s)
        attempts.append(attempt)
    return found, tuple(attempts)


def _program(
    p: Problem, start: np.ndarray, at: assess.Slopes, budget: Budget, hessian: str
) -> tuple[State, Attempt]:
    """Search with the solvers for constraints, until one ends on an optimum."""
    moving = np.flatnonzero(p.lower < p.upper)
    scale = assess.scale_of(p, start, at)
    # Squares say nothing of further objectives; foreign code may have first derivatives only.
    usable = {"none", hessian} if p.objectives else {"none", "gauss_newton", hessian}
    exact = hessian == "exact"
    best, tried, steps, said = None, [], 0, ""
    for stage in (stage for stage in SOLVERS if stage.hessian in usable):
        program = scaled(p, start, moving, at, scale, stage.hessian)
        near = best is not None and best.kkt.feasibility <= TOLERANCE
        begin = best.theta if near else start
        for _ in range(1 + MOVES):
            end = stage.solve(
                program, (begin / scale.unit)[moving], min(stage.steps, budget.iterations), budget
            )
            theta = start.copy()
            theta[moving] = end.x * scale.unit[moving]
            theta = np.clip(theta, p.lower, p.upper)
            s = assess.state(p, theta, scale)
            steps, said = steps + end.iterations, end.said
            point = None
            if s.kkt.worst <= TOLERANCE:
                s, point = assess.second_order(p, s, exact, program.lagrangian(s.found.constraints))
            if best is None or _best(p, [best, s]) == 1:
                best = s
            if point is None or budget.left <= 0:
                break
            begin = point
        tried.append(stage.name)
        if _good(best) or budget.left <= 0:
            break
    return best, Attempt(", ".join(tried), best.theta, float(best.at.cost), best.kkt, steps, said)
