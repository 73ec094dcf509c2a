"""Solvers for fits with constraints: Uno first, scipy where it fails.

They only propose points. Whether a point is an optimum is decided in `assess`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from beamfit.greybox import assess, problem
from beamfit.greybox.problem import Problem


class SearchLimit(NamedTuple):
    """Limit of a search: iterations from one start, and a time on the clock or None.

    `solver` is the one asked for, if any, `tolerance` that of the problem.
    """

    iterations: int
    until: float | None
    solver: str | None = None
    tolerance: float = problem.TOLERANCE

    @property
    def left(self) -> float:
        """Seconds left."""
        return np.inf if self.until is None else self.until - time.perf_counter()


def _tame(size: np.ndarray) -> np.ndarray:
    """Sizes near 1 are left alone: solvers' own steps and tolerances are made for those."""
    return np.where((size > 1e2) | (size < 1e-2), size, 1.0)


class NonlinearProgram:
    """A problem for a solver in functions of x: moving numbers, cost and limits in their sizes.

    Parameters
    ----------
    p : Problem
        The problem.
    start : array, shape (n,)
        Holds the numbers that do not move.
    at : Slopes
        At the start.
    scale : Scale
        Of the problem.
    hessian : str
        ``gauss_newton`` or anything else for the exact one.
    """

    def __init__(
        self, p: Problem, start: np.ndarray, at: assess.Slopes, scale: assess.Scale, hessian: str
    ):
        self.problem, self.start, self.gauss_newton = p, start, hessian == "gauss_newton"
        self.moving = np.flatnonzero(p.moving)
        self.unit, self.limit = _tame(scale.unit)[self.moving], _tame(scale.limit)
        steepest = max(np.max(np.abs(at.gradient * scale.unit)), 1e-300)
        # Squares are counted in their errors; a steep cost is flattened, as IPOPT does.
        self.flat = 1.0 / scale.cost if p.objectives else min(1.0, 100.0 / steepest)
        self.lower, self.upper = (self.point(end) for end in (p.lower, p.upper))
        self.c_lower, self.c_upper = (
            p.constraint_lower / self.limit,
            p.constraint_upper / self.limit,
        )
        # A solver asks for cost and limits of one point after the other: the last are remembered.
        self._parts = lru_cache(maxsize=8)(self._computed)

    def point(self, theta: np.ndarray) -> np.ndarray:
        """X of the problem's own numbers."""
        return theta[self.moving] / self.unit

    def numbers(self, x: np.ndarray) -> np.ndarray:
        """The problem's own numbers."""
        theta = self.start.copy()
        theta[self.moving] = x * self.unit
        return theta

    def _computed(self, function: Callable, x: bytes) -> list[np.ndarray]:
        theta = self.numbers(np.frombuffer(x))
        return [np.asarray(part) for part in self.problem.compiled(function)(theta)]

    def values(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        """Cost and constraints."""
        cost, c = self._parts(problem.values, x.tobytes())
        return self.flat * float(cost), c / self.limit

    def slopes(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gradient of the cost and Jacobian of the constraints."""
        s = assess.Slopes(*self._parts(assess.first_order, x.tobytes()))
        jacobian = s.jacobian[:, self.moving] * self.unit / self.limit[:, None]
        return self.flat * s.gradient[self.moving] * self.unit, jacobian

    def hessian(self, x: np.ndarray, sigma: float, y: np.ndarray) -> np.ndarray:
        """Hessian of sigma * cost - y @ constraints."""
        if self.gauss_newton:
            rows = self._parts(assess.first_order, x.tobytes())[1][:, self.moving] * self.unit
            return sigma * self.flat * rows.T @ rows
        exact = self.problem.compiled(assess.lagrangian_hessian)
        h = np.asarray(exact(self.numbers(x), sigma * self.flat, y / self.limit))
        return h[np.ix_(self.moving, self.moving)] * np.outer(self.unit, self.unit)


class SolverEnd(NamedTuple):
    """End of a solver's search: point, number of iterations, the solver's own message."""

    x: np.ndarray
    iterations: int
    said: str


def _uno(preset: str, **more: float) -> Callable[[NonlinearProgram, np.ndarray, int], SolverEnd]:
    """A solver by Uno with one of its presets, and options of its own."""

    def solve(program, x: np.ndarray, iterations: int, budget: SearchLimit) -> SolverEnd:
        import unopy

        solver = unopy.UnoSolver()
        solver.set_preset(preset)
        solver.set_option("logger", "SILENT")
        solver.set_option("max_iterations", iterations)
        solver.set_option("primal_tolerance", min(1e-9, 1e-3 * budget.tolerance))
        solver.set_option("dual_tolerance", min(1e-8, 1e-2 * budget.tolerance))
        solver.set_option("time_limit", float(min(120.0, max(budget.left, 0.01))))
        for name, value in more.items():
            solver.set_option(name, value)
        found = solver.optimize(_uno_model(unopy, program, x))
        # Uno reports an infeasible problem as an optimisation status of success.
        said = f"{found.solution_status.name}, {found.optimization_status.name}"
        return SolverEnd(np.array(found.primal_solution), int(found.number_iterations), said)

    return solve


def _uno_model(unopy, program: NonlinearProgram, x: np.ndarray):
    """State the program to Uno with dense derivatives."""
    n, m = len(x), len(program.c_lower)
    ends = program.lower.tolist(), program.upper.tolist()
    model = unopy.Model(unopy.PROBLEM_NONLINEAR, n, *ends, unopy.ZERO_BASED_INDEXING)

    def gradient(at, out):
        out[:] = program.slopes(np.array(at))[0]

    def constraints(at, out):
        out[:] = program.values(np.array(at))[1]

    def jacobian(at, out):
        out[:] = program.slopes(np.array(at))[1].ravel()

    low = np.tril_indices(n)

    def hessian(at, sigma, y, out):
        out[:] = program.hessian(np.array(at), sigma, np.array(y))[low]

    model.set_objective(unopy.MINIMIZE, lambda at: float(program.values(np.array(at))[0]), gradient)
    places = [i.ravel().tolist() for i in np.indices((m, n))]
    ends = program.c_lower.tolist(), program.c_upper.tolist()
    model.set_constraints(m, constraints, *ends, m * n, *places, jacobian)
    places = [i.tolist() for i in low]
    model.set_lagrangian_hessian(len(low[0]), unopy.LOWER_TRIANGLE, *places, hessian)
    model.set_lagrangian_sign_convention(unopy.MULTIPLIER_NEGATIVE)
    model.set_initial_primal_iterate(x.tolist())
    return model


def _slsqp(program, x: np.ndarray, iterations: int, budget: SearchLimit) -> SolverEnd:
    """Solve by scipy's sequential quadratic programming."""
    from scipy import optimize

    ends = program.c_lower, program.c_upper
    equal = ends[0] == ends[1]
    limits = [
        optimize.NonlinearConstraint(
            lambda at, k=k: program.values(at)[1][k],
            *(end[k] for end in ends),
            jac=lambda at, k=k: program.slopes(at)[1][k],
        )
        for k in (equal, ~equal & np.isfinite(ends).any(axis=0))
        if k.any()
    ]
    last = [x]

    def in_time(at):
        if budget.left <= 0:
            raise TimeoutError
        last[0] = at.copy()

    try:
        found = optimize.minimize(
            lambda at: program.values(at)[0],
            x,
            jac=lambda at: program.slopes(at)[0],
            bounds=optimize.Bounds(program.lower, program.upper),
            constraints=limits,
            method="SLSQP",
            callback=in_time,
            options={"maxiter": iterations, "ftol": 1e-15},
        )
    except TimeoutError:
        return SolverEnd(last[0], 0, "time is up")
    return SolverEnd(found.x, int(found.nit), found.message)


class Stage(NamedTuple):
    """A solver, the name it is asked for by, the Hessian it wants, and its steps in one go.

    The Hessian is gauss_newton, exact or none.
    """

    name: str
    preset: str
    hessian: str
    steps: int
    solve: Callable[[NonlinearProgram, np.ndarray, int, SearchLimit], SolverEnd]


# Squares of fewer residuals than numbers vanish in many places, and a method of active sets ends in
# a corner of the limits before it finds one: a barrier, at first as strong as one standard
# deviation of the residuals, keeps it away from these.
INSIDE = Stage("Uno ipopt", "ipopt", "exact", 250, _uno("ipopt", barrier_initial_parameter=1.0))
_SHARP = Stage("Uno filtersqp", "filtersqp", "exact", 300, _uno("filtersqp"))
# Solvers in the order they are tried.
SOLVERS: tuple[Stage, ...] = (
    Stage("Uno filtersqp with Gauss-Newton", "filtersqp", "gauss_newton", 3000, _uno("filtersqp")),
    _SHARP,
    Stage("Uno ipopt", "ipopt", "exact", 1000, _uno("ipopt")),
    _SHARP,
    Stage("scipy SLSQP", "slsqp", "none", 300, _slsqp),
)
"""In the order of trying; what an interior point leaves short of its limits is sharpened."""
