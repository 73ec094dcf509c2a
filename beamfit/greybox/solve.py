"""Solve a problem: propose points, keep the best, judge it ourselves."""

from __future__ import annotations

import time

import jax
import numpy as np
from rich.console import Console
from rich.progress import track

from beamfit.errors import InputError
from beamfit.greybox import assess, problem
from beamfit.greybox.fit import Attempt, Fit, Status
from beamfit.greybox.gauss_newton import descend
from beamfit.greybox.kkt import TOLERANCE
from beamfit.greybox.problem import Problem
from beamfit.greybox.programs import SOLVERS, Program

__all__ = ["search", "solve", "starting_points"]


def solve(
    p: Problem,
    starts: int = 1,
    seed: int = 0,
    iterations: int = 3000,
    hessian: str = "exact",
    progress: bool = False,
) -> Fit:
    """Minimise the cost of a problem within its bounds and constraints.

    Least squares with bounds alone go to trust-region Gauss-Newton. Problems with constraints go to
    Uno's sequential quadratic programming, with the Gauss-Newton Hessian first (networks fitted to
    few data have flat valleys in which the exact one crawls), then with the exact Hessian, then to
    scipy where Uno ends without an optimum. Whether a point is an optimum is decided by our own KKT
    residual. Of several starts the cheapest optimum is the answer.

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
    if hessian not in ("exact", "gauss_newton"):
        raise InputError(f"hessian '{hessian}'", "one of exact, gauss_newton")
    if starts < 1 or iterations < 1:
        raise InputError(f"{starts} starts of {iterations} iterations", "at least one of each")
    wrong = [n for n, a, b in zip(p.names, p.lower, p.upper, strict=True) if not a <= b]
    wrong += [
        n
        for n, a, b in zip(p.constraint_names, p.constraint_lower, p.constraint_upper, strict=True)
        if not a <= b
    ]
    if wrong:
        said = f"the lower bound of {wrong[0]} lies above its upper bound; correct the bounds."
        return assess.refused(p, Status.contradictory_bounds, said, time.perf_counter() - began)
    points = starting_points(p, starts, seed)
    bar = track(
        points, "fitting", console=Console(stderr=True), transient=True, disable=not progress
    )
    found = [
        search(p, point, iterations, hessian)
        for point in bar
        if np.isfinite(float(p.cost(point))) and np.all(np.isfinite(p.constraint_values(point)))
    ]
    seconds = time.perf_counter() - began
    if not found:
        place = "the start" if starts == 1 else "any start"
        said = (
            f"the cost or a constraint is not finite at {place}; "
            "start elsewhere, or use a parametrisation that is defined there."
        )
        return assess.refused(p, Status.not_finite, said, seconds)
    best, _ = min(found, key=lambda pair: _rank(pair[0]))
    return assess.conclude(p, best, tuple(attempt for _, attempt in found), seconds)


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
    return [np.clip(point, p.lower, p.upper) for point in points]


def _rank(s: assess.State) -> tuple:
    """Order of preference: optima by cost, then feasible points, then the least infeasible."""
    good = s.kkt.worst <= TOLERANCE
    feasible = s.kkt.feasibility <= TOLERANCE
    return (not good, not feasible, s.at.cost if feasible else s.kkt.feasibility)


def search(
    p: Problem, start: np.ndarray, iterations: int = 3000, hessian: str = "exact"
) -> tuple[assess.State, Attempt]:
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
    moving = np.flatnonzero(p.lower < p.upper)
    if p.constraints or p.objectives:
        return _program(p, start, moving, iterations, hessian)

    def full(x):
        theta = start.copy()
        theta[moving] = x
        return theta

    both = p.compiled(_linearised)

    def linearise(x):
        r, j = both(full(x))
        return np.asarray(r), np.asarray(j)[:, moving]

    end = descend(
        linearise,
        start[moving],
        p.lower[moving],
        p.upper[moving],
        iterations,
    )
    s = assess.state(p, full(end.x))
    said = "came to rest" if end.rested else "ran out of iterations"
    return s, Attempt("Gauss-Newton", s.theta, float(s.at.cost), s.kkt, end.iterations, said)


def _linearised(core, theta):
    return problem.residual(core, theta), jax.jacfwd(problem.residual, 1)(core, theta)


def _values(core, theta):
    return problem.cost(core, theta), problem.constraints(core, theta)


def _first(core, theta):
    return jax.grad(problem.cost, 1)(core, theta), assess.constraint_slopes(core, theta)


def _exact(core, theta, sigma, y):
    """Hessian of the Lagrangian sigma * cost - y @ constraints."""

    def lagrangian(t):
        return sigma * problem.cost(core, t) - y @ problem.constraints(core, t)

    return jax.hessian(lagrangian)(theta)


def _squares(core, theta, sigma, y):
    """Gauss-Newton's part of it."""
    j = jax.jacfwd(problem.residual, 1)(core, theta)
    return sigma * j.T @ j


def _program(p: Problem, start: np.ndarray, moving: np.ndarray, iterations: int, hessian: str):
    """Search with the solvers for constraints, until one ends on an optimum."""
    first = np.asarray(p.compiled(_first)(start)[0])
    # Numbers far from 1 are measured in their own size; a steep cost is flattened, as IPOPT does.
    span = p.upper - p.lower
    size = np.maximum(np.abs(start), np.where(np.isfinite(span), 0.1 * span, 0.0))
    unit = np.where((size > 1e2) | ((size < 1e-2) & (size > 0)), size, 1.0)
    flat = min(1.0, 100.0 / max(np.max(np.abs(first * unit)), 1e-300))
    # Squares say nothing of further objectives; foreign code may have first derivatives only.
    usable = {"none", hessian} if p.objectives else {"none", "gauss_newton", hessian}
    best, tried, steps, said = None, [], 0, ""
    for stage in (stage for stage in SOLVERS if stage.hessian in usable):
        second = _squares if stage.hessian == "gauss_newton" else _exact
        program = _scaled(p, start, moving, unit, flat, second)
        near = best is not None and best.kkt.feasibility <= TOLERANCE
        begin = best.theta if near else start
        end = stage.solve(program, (begin / unit)[moving], min(stage.steps, iterations))
        theta = start.copy()
        theta[moving] = np.clip(end.x * unit[moving], p.lower[moving], p.upper[moving])
        s = assess.state(p, theta)
        tried, steps, said = [*tried, stage.name], steps + end.iterations, end.said
        if best is None or _rank(s) < _rank(best):
            best = s
        if best.kkt.worst <= TOLERANCE:
            break
    return best, Attempt(", ".join(tried), best.theta, float(best.at.cost), best.kkt, steps, said)


def _scaled(p: Problem, start, moving, unit, flat, second) -> Program:
    """The problem for a solver: moving numbers in their units, cost flattened, last point kept."""
    scale = unit[moving]
    kept: dict = {}
    at = {function: p.compiled(function) for function in (_values, _first, second)}

    def remember(function, x):
        key = (function, x.tobytes())
        if key not in kept:
            if len(kept) > 8:
                kept.clear()
            theta = start.copy()
            theta[moving] = x * scale
            kept[key] = [np.asarray(part) for part in at[function](theta)]
        return kept[key]

    def values(x):
        cost, c = remember(_values, x)
        return flat * float(cost), c

    def slopes(x):
        gradient, jacobian = remember(_first, x)
        return flat * gradient[moving] * scale, jacobian[:, moving] * scale

    def hessian(x, sigma, y):
        theta = start.copy()
        theta[moving] = x * scale
        h = np.asarray(at[second](theta, sigma * flat, y))
        return h[np.ix_(moving, moving)] * np.outer(scale, scale)

    return Program(
        values,
        slopes,
        hessian,
        p.lower[moving] / scale,
        p.upper[moving] / scale,
        p.constraint_lower,
        p.constraint_upper,
    )
