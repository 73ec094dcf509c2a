"""Programs: solvers for fits with constraints, and small quadratic programs inside JAX.

Uno comes first, scipy where it fails. They only propose points: whether one is an optimum is
decided in `assess`. Quadratic programs are limits of a plan, solved again at every step.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_factor, cho_solve

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

    def solve(
        program: NonlinearProgram, x: np.ndarray, iterations: int, budget: SearchLimit
    ) -> SolverEnd:
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


def _slsqp(
    program: NonlinearProgram, x: np.ndarray, iterations: int, budget: SearchLimit
) -> SolverEnd:
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


# ---- quadratic programs

# Most steps; mean complementarity and residuals that end them; share of the step to a limit.
STEPS, CLOSE, SHARE = 40, 1e-9, 0.99


class Quadratic(NamedTuple):
    """Find the least z'Hz/2 + g'z + cost's with G z <= h + s, s >= 0.

    Shapes (n, n), (n,), (rows, n), (rows,), (rows,). A row of infinite cost is hard; another is
    kept wherever its multiplier is below its cost. H must be positive.
    """

    matrix: jax.Array
    slope: jax.Array
    rows: jax.Array
    limits: jax.Array
    cost: jax.Array


class _Point(NamedTuple):
    """Variables, room left in each row, its multiplier, and by how much it is passed."""

    z: jax.Array
    room: jax.Array
    force: jax.Array
    passed: jax.Array


def minimum(program: Quadratic, start: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Solve a quadratic program by a primal-dual interior point.

    Parameters
    ----------
    program : Quadratic
        Well scaled; it must have a point that keeps the hard rows.
    start : array, shape (n,)
        Any point.

    Returns
    -------
    (array, shape (n,); array, shape (rows,))
        The minimum and the multipliers of the rows.

    Notes
    -----
    Predictor and corrector of S. Mehrotra, SIAM J. Optim. 2 (1992) 575; for quadratic programs
    J. Nocedal and S. Wright, Numerical Optimization (2006), algorithm 16.4. The multiplier of a
    soft row and that of its s add to its cost, so both are eliminated. At most 40 steps, each with
    one factorisation; it can be mapped and compiled.

    Examples
    --------
    >>> one, inf = jnp.array, jnp.inf
    >>> box = Quadratic(jnp.eye(2), one([-3.0, 0.5]), jnp.eye(2), one([1.0, 2.0]), one([inf, inf]))
    >>> z, force = minimum(box, jnp.zeros(2))
    >>> z.round(6).tolist(), force.round(6).tolist()
    ([1.0, -0.5], [2.0, 0.0])
    >>> minimum(box._replace(cost=one([0.5, 0.5])), z)[0].round(6).tolist()
    [2.5, -0.5]
    """
    if program.rows.shape[0] == 0:
        return jnp.linalg.solve(program.matrix, -program.slope), program.limits
    soft, half = jnp.isfinite(program.cost), 0.5 * program.cost
    room = jnp.maximum(program.limits - program.rows @ start, 1.0)
    first = _Point(start, room, jnp.minimum(1.0, half), 1.0 * soft)
    # Multipliers of the size that the problem's have (Nocedal and Wright, section 16.6).
    step = _towards(program, first)(room * first.force, 0.0 * room)
    room, force, passed = (
        jnp.maximum(jnp.abs(v + d), 1.0) for v, d in zip(first[1:], step[1:], strict=True)
    )
    begin = _Point(start, room, jnp.minimum(force, half), soft * passed)
    end, _, _ = jax.lax.while_loop(
        lambda now: (now[1] > CLOSE) & (now[2] < STEPS),
        lambda now: _next(program, now[0], now[2]),
        (begin, jnp.asarray(jnp.inf), jnp.asarray(0)),
    )
    return end.z, end.force


def _residuals(program: Quadratic, now: _Point) -> tuple[jax.Array, jax.Array]:
    dual = program.matrix @ now.z + program.slope + program.rows.T @ now.force
    return dual, program.rows @ now.z + now.room - now.passed - program.limits


def _other(program: Quadratic, now: _Point) -> jax.Array:
    """Multipliers of the s of soft rows; 1 of hard ones, which have none."""
    return jnp.where(jnp.isfinite(program.cost), program.cost - now.force, 1.0)


def _towards(program: Quadratic, now: _Point) -> Callable[[jax.Array, jax.Array], _Point]:
    """Steps on which room * force and passed * other fall by so much, the residuals to nothing."""
    rows, other, (dual, primal) = program.rows, _other(program, now), _residuals(program, now)
    weight = 1.0 / (now.room / now.force + now.passed / other)
    factor = cho_factor(program.matrix + rows.T @ (rows * weight[:, None]))

    def step(inner, outer):
        lack = primal - inner / now.force + outer / other
        dz = -cho_solve(factor, dual + rows.T @ (weight * lack))
        d_force = weight * (rows @ dz + lack)
        d_passed = (now.passed * d_force - outer) / other
        return _Point(dz, (-inner - now.room * d_force) / now.force, d_force, d_passed)

    return step


def _next(program: Quadratic, now: _Point, steps: jax.Array) -> tuple[_Point, jax.Array, jax.Array]:
    """Predict, correct, and say how far the point is from the minimum."""
    soft, towards = jnp.isfinite(program.cost), _towards(program, now)
    inner, outer = now.room * now.force, now.passed * _other(program, now)
    far = towards(inner, outer)
    reach = _reach(program, now, far)
    gap, after = _gap(program, now), _gap(program, _along(now, far, reach))
    centre = gap * (after / gap) ** 3
    corrected = soft * (outer - far.passed * far.force - centre)
    way = towards(inner + far.room * far.force - centre, corrected)
    new = _along(now, way, SHARE * _reach(program, now, way))
    dual, primal = _residuals(program, new)
    dual = jnp.max(jnp.abs(dual)) / (1.0 + jnp.max(jnp.abs(program.slope)))
    left = jnp.maximum(jnp.maximum(dual, jnp.max(jnp.abs(primal))), _gap(program, new))
    good = jnp.isfinite(left)
    kept = (jnp.where(good, a, b) for a, b in zip(new, now, strict=True))
    # A point that is not finite ends the search: rounding leaves nothing to gain.
    return _Point(*kept), jnp.where(good, left, 0.0), steps + 1


def _along(now: _Point, way: _Point, reach: jax.Array) -> _Point:
    return _Point(*(v + reach * d for v, d in zip(now, way, strict=True)))


def _gap(program: Quadratic, now: _Point) -> jax.Array:
    """Mean of multipliers times what they guard."""
    count = now.room.size + jnp.sum(jnp.isfinite(program.cost))
    return (now.room @ now.force + now.passed @ _other(program, now)) / count


def _reach(program: Quadratic, now: _Point, way: _Point) -> jax.Array:
    """Longest step, at most 1, that keeps all slacks and multipliers positive."""
    soft = jnp.isfinite(program.cost)
    values = jnp.concatenate([now.room, now.force, now.passed, _other(program, now)])
    changes = jnp.concatenate([way.room, way.force, way.passed, -1.0 * soft * way.force])
    return jnp.min(jnp.where(changes < 0, -values / changes, 1.0), initial=1.0)
