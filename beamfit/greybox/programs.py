"""Solvers for fits with constraints, and a solver of small quadratic programs in JAX.

Uno is tried first, then scipy. Solvers only propose points; `assess` decides which of them are
optima. The quadratic programs are the control steps of `beamfit.dynamics` within their limits,
solved anew at every step.
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
    """Limits of a search: iterations from one start, and the time at which it must end, or None.

    `solver` is the only solver to use, if given; `tolerance` is the tolerance of the problem.
    """

    iterations: int
    until: float | None
    solver: str | None = None
    tolerance: float = problem.TOLERANCE

    @property
    def seconds_left(self) -> float:
        """Seconds left."""
        return np.inf if self.until is None else self.until - time.perf_counter()


def _rounded_scale(size: np.ndarray) -> np.ndarray:
    """Replace scales between 0.01 and 100 by 1, for which the solvers' tolerances are made."""
    return np.where((size > 1e2) | (size < 1e-2), size, 1.0)


class NonlinearProgram:
    """A problem as functions of x, the free numbers in their scales, for a solver.

    Cost and constraints are scaled as well.

    Parameters
    ----------
    p : Problem
        The problem.
    start : array, shape (n,)
        Values of the numbers; those that are fixed stay.
    at : Slopes
        Values and derivatives at the start.
    scale : Scale
        Scales of the problem.
    hessian : str
        ``gauss_newton``; the exact Hessian is used for any other value.
    """

    def __init__(
        self, p: Problem, start: np.ndarray, at: assess.Slopes, scale: assess.Scale, hessian: str
    ):
        self.problem, self.start, self.gauss_newton = p, start, hessian == "gauss_newton"
        self.moving = np.flatnonzero(p.moving)
        self.unit, self.limit = _rounded_scale(scale.unit)[self.moving], _rounded_scale(scale.limit)
        steepest = max(np.max(np.abs(at.gradient * scale.unit)), 1e-300)
        # Sums of squares keep their unit of one standard error, but a steep cost is scaled down, as
        # IPOPT does.
        self.cost_scale = 1.0 / scale.cost if p.objectives else min(1.0, 100.0 / steepest)
        self.lower, self.upper = (self.point(end) for end in (p.lower, p.upper))
        self.c_lower, self.c_upper = (
            p.constraint_lower / self.limit,
            p.constraint_upper / self.limit,
        )
        # Solvers evaluate cost and constraints of a point in separate calls: keep the last results.
        self._cached = lru_cache(maxsize=8)(self._evaluate)

    def point(self, theta: np.ndarray) -> np.ndarray:
        """Convert the problem's numbers to x."""
        return theta[self.moving] / self.unit

    def numbers(self, x: np.ndarray) -> np.ndarray:
        """Convert x to the problem's numbers."""
        theta = self.start.copy()
        theta[self.moving] = x * self.unit
        return theta

    def _evaluate(self, function: Callable, x: bytes) -> list[np.ndarray]:
        theta = self.numbers(np.frombuffer(x))
        return [np.asarray(part) for part in self.problem.compiled(function)(theta)]

    def values(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        """Compute cost and constraints."""
        cost, c = self._cached(problem.values, x.tobytes())
        return self.cost_scale * float(cost), c / self.limit

    def slopes(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute the gradient of the cost and the Jacobian of the constraints."""
        s = assess.Slopes(*self._cached(assess.first_order, x.tobytes()))
        jacobian = s.jacobian[:, self.moving] * self.unit / self.limit[:, None]
        return self.cost_scale * s.gradient[self.moving] * self.unit, jacobian

    def hessian(self, x: np.ndarray, sigma: float, y: np.ndarray) -> np.ndarray:
        """Compute the Hessian of sigma * cost - y @ constraints."""
        if self.gauss_newton:
            rows = self._cached(assess.first_order, x.tobytes())[1][:, self.moving] * self.unit
            return sigma * self.cost_scale * rows.T @ rows
        exact = self.problem.compiled(assess.lagrangian_hessian)
        h = np.asarray(exact(self.numbers(x), sigma * self.cost_scale, y / self.limit))
        return h[np.ix_(self.moving, self.moving)] * np.outer(self.unit, self.unit)


class SolverEnd(NamedTuple):
    """End of a solver's search: point, number of iterations, message of the solver."""

    x: np.ndarray
    iterations: int
    message: str


def _uno(preset: str, **more: float) -> Callable[[NonlinearProgram, np.ndarray, int], SolverEnd]:
    """Make a solver that runs Uno with a preset and further options."""

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
        solver.set_option("time_limit", float(min(120.0, max(budget.seconds_left, 0.01))))
        for name, value in more.items():
            solver.set_option(name, value)
        found = solver.optimize(_uno_model(unopy, program, x))
        # Uno reports an infeasible problem as an optimisation status of success.
        message = f"{found.solution_status.name}, {found.optimization_status.name}"
        return SolverEnd(np.array(found.primal_solution), int(found.number_iterations), message)

    return solve


def _uno_model(unopy, program: NonlinearProgram, x: np.ndarray):
    """Make the Uno model of a program, with dense derivatives."""
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

    def check_time(at):
        if budget.seconds_left <= 0:
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
            callback=check_time,
            options={"maxiter": iterations, "ftol": 1e-15},
        )
    except TimeoutError:
        return SolverEnd(last[0], 0, "time is up")
    return SolverEnd(found.x, int(found.nit), found.message)


class Stage(NamedTuple):
    """A solver: name, the preset users select it by, kind of Hessian, iterations, function.

    `hessian` is ``gauss_newton``, ``exact`` or ``none``.
    """

    name: str
    preset: str
    hessian: str
    steps: int
    solve: Callable[[NonlinearProgram, np.ndarray, int, SearchLimit], SolverEnd]


# First stage for least squares with fewer residuals than numbers. Their sum vanishes at many
# points, and an active-set method ends in a corner of the limits before it finds one. This is
# prevented by the barrier of an interior-point method, at first as strong as one standard error.
INTERIOR_POINT = Stage(
    "Uno ipopt", "ipopt", "exact", 250, _uno("ipopt", barrier_initial_parameter=1.0)
)
_REFINEMENT = Stage("Uno filtersqp", "filtersqp", "exact", 300, _uno("filtersqp"))
# Solvers in the order of trying. The second run of filtersqp refines the result of ipopt, which
# stops short of the limits.
SOLVERS: tuple[Stage, ...] = (
    Stage("Uno filtersqp with Gauss-Newton", "filtersqp", "gauss_newton", 3000, _uno("filtersqp")),
    _REFINEMENT,
    Stage("Uno ipopt", "ipopt", "exact", 1000, _uno("ipopt")),
    _REFINEMENT,
    Stage("scipy SLSQP", "slsqp", "none", 300, _slsqp),
)


# ---- quadratic programs

# Largest number of interior-point steps.
MAX_STEPS = 40
# The steps end when mean complementarity and residuals are below this.
CONVERGED = 1e-9
# Share of the distance to the nearest limit that a step may go.
STEP_SHARE = 0.99


class Quadratic(NamedTuple):
    """Minimise z'Hz/2 + g'z + cost's subject to G z <= h + s, s >= 0.

    The fields H, g, G, h and cost have shapes (n, n), (n,), (rows, n), (rows,) and (rows,). A row
    of infinite cost is a hard limit, the others are soft: s is zero as long as the multiplier is
    below the cost. H must be positive definite.
    """

    matrix: jax.Array
    slope: jax.Array
    rows: jax.Array
    limits: jax.Array
    cost: jax.Array


class _Point(NamedTuple):
    """Variables z, slack of each row, its multiplier, and its violation s."""

    z: jax.Array
    slack: jax.Array
    multiplier: jax.Array
    violation: jax.Array


def minimum(program: Quadratic, start: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Solve a quadratic program by a primal-dual interior point.

    Parameters
    ----------
    program : Quadratic
        Well scaled, and feasible for the hard rows.
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
    soft row and that of its s add up to its cost, so both are eliminated. There are at most 40
    steps, each with one factorisation. The function can be used under `jax.vmap` and `jax.jit`.

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
    slack = jnp.maximum(program.limits - program.rows @ start, 1.0)
    first = _Point(start, slack, jnp.minimum(1.0, half), 1.0 * soft)
    # Start with multipliers of the size of the problem's (Nocedal and Wright, section 16.6).
    step = _newton_step(program, first)(slack * first.multiplier, 0.0 * slack)
    slack, multiplier, violation = (
        jnp.maximum(jnp.abs(v + d), 1.0) for v, d in zip(first[1:], step[1:], strict=True)
    )
    initial = _Point(start, slack, jnp.minimum(multiplier, half), soft * violation)
    end, _, _ = jax.lax.while_loop(
        lambda now: (now[1] > CONVERGED) & (now[2] < MAX_STEPS),
        lambda now: _iterate(program, now[0], now[2]),
        (initial, jnp.asarray(jnp.inf), jnp.asarray(0)),
    )
    return end.z, end.multiplier


def _residuals(program: Quadratic, point: _Point) -> tuple[jax.Array, jax.Array]:
    dual = program.matrix @ point.z + program.slope + program.rows.T @ point.multiplier
    return dual, program.rows @ point.z + point.slack - point.violation - program.limits


def _soft_multiplier(program: Quadratic, point: _Point) -> jax.Array:
    """Compute the multipliers of s >= 0 for soft rows; 1 for hard rows, which have none."""
    return jnp.where(jnp.isfinite(program.cost), program.cost - point.multiplier, 1.0)


def _newton_step(program: Quadratic, point: _Point) -> Callable[[jax.Array, jax.Array], _Point]:
    """Make the Newton step as a function of the decreases of the complementarities.

    These are `inner` for slack * multiplier and `outer` for violation * soft; residuals go to 0.
    """
    rows, soft = program.rows, _soft_multiplier(program, point)
    dual, primal = _residuals(program, point)
    weight = 1.0 / (point.slack / point.multiplier + point.violation / soft)
    factor = cho_factor(program.matrix + rows.T @ (rows * weight[:, None]))

    def step(inner, outer):
        lack = primal - inner / point.multiplier + outer / soft
        dz = -cho_solve(factor, dual + rows.T @ (weight * lack))
        d_multiplier = weight * (rows @ dz + lack)
        d_violation = (point.violation * d_multiplier - outer) / soft
        return _Point(
            dz, (-inner - point.slack * d_multiplier) / point.multiplier, d_multiplier, d_violation
        )

    return step


def _iterate(
    program: Quadratic, point: _Point, steps: jax.Array
) -> tuple[_Point, jax.Array, jax.Array]:
    """Take a predictor and corrector step; also return the remaining error and the step count."""
    is_soft, step = jnp.isfinite(program.cost), _newton_step(program, point)
    inner, outer = (
        point.slack * point.multiplier,
        point.violation * _soft_multiplier(program, point),
    )
    predictor = step(inner, outer)
    length = _max_step(program, point, predictor)
    gap = _complementarity(program, point)
    after = _complementarity(program, _move(point, predictor, length))
    centre = gap * (after / gap) ** 3
    corrected = is_soft * (outer - predictor.violation * predictor.multiplier - centre)
    corrector = step(inner + predictor.slack * predictor.multiplier - centre, corrected)
    new = _move(point, corrector, STEP_SHARE * _max_step(program, point, corrector))
    dual, primal = _residuals(program, new)
    dual = jnp.max(jnp.abs(dual)) / (1.0 + jnp.max(jnp.abs(program.slope)))
    error = jnp.maximum(jnp.maximum(dual, jnp.max(jnp.abs(primal))), _complementarity(program, new))
    good = jnp.isfinite(error)
    kept = (jnp.where(good, a, b) for a, b in zip(new, point, strict=True))
    # A point that is not finite ends the search: no further accuracy can be reached.
    return _Point(*kept), jnp.where(good, error, 0.0), steps + 1


def _move(point: _Point, step: _Point, length: jax.Array) -> _Point:
    return _Point(*(v + length * d for v, d in zip(point, step, strict=True)))


def _complementarity(program: Quadratic, point: _Point) -> jax.Array:
    """Compute the mean complementarity: multipliers times their slacks."""
    count = point.slack.size + jnp.sum(jnp.isfinite(program.cost))
    return (
        point.slack @ point.multiplier + point.violation @ _soft_multiplier(program, point)
    ) / count


def _max_step(program: Quadratic, point: _Point, step: _Point) -> jax.Array:
    """Compute the longest step, at most 1, that keeps all slacks and multipliers positive."""
    is_soft = jnp.isfinite(program.cost)
    values = jnp.concatenate(
        [point.slack, point.multiplier, point.violation, _soft_multiplier(program, point)]
    )
    changes = jnp.concatenate(
        [step.slack, step.multiplier, step.violation, -1.0 * is_soft * step.multiplier]
    )
    return jnp.min(jnp.where(changes < 0, -values / changes, 1.0), initial=1.0)
