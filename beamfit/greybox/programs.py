"""Solvers for fits with constraints: Uno first, scipy where it fails.

They only propose points. Whether a point is an optimum is decided in `kkt`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy import optimize

__all__ = ["SOLVERS", "Program", "Proposal", "Stage"]


class Program(NamedTuple):
    """A constrained minimisation in plain NumPy functions of x, well scaled.

    `values(x)` gives cost and constraints, `slopes(x)` the cost's gradient and the constraints'
    Jacobian, `hessian(x, sigma, y)` the Hessian of sigma * cost - y @ constraints.
    """

    values: Callable[[np.ndarray], tuple[float, np.ndarray]]
    slopes: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    hessian: Callable[[np.ndarray, float, np.ndarray], np.ndarray]
    lower: np.ndarray
    upper: np.ndarray
    c_lower: np.ndarray
    c_upper: np.ndarray


class Proposal(NamedTuple):
    """Where a solver ended, after how many iterations, and what it said."""

    x: np.ndarray
    iterations: int
    said: str


def _uno(preset: str) -> Callable[[Program, np.ndarray, int], Proposal]:
    """A solver by Uno with one of its presets."""

    def solve(program: Program, x: np.ndarray, iterations: int) -> Proposal:
        import unopy

        solver = unopy.UnoSolver()
        solver.set_preset(preset)
        solver.set_option("logger", "SILENT")
        solver.set_option("max_iterations", iterations)
        solver.set_option("primal_tolerance", 1e-9)
        solver.set_option("dual_tolerance", 1e-8)
        solver.set_option("time_limit", 120.0)
        found = solver.optimize(_uno_model(unopy, program, x))
        # Uno reports an infeasible problem as an optimisation status of success.
        said = f"{found.solution_status.name}, {found.optimization_status.name}"
        return Proposal(np.array(found.primal_solution), int(found.number_iterations), said)

    return solve


def _uno_model(unopy, program: Program, x: np.ndarray):
    """State the program to Uno with dense derivatives."""
    n, m = len(x), len(program.c_lower)
    model = unopy.Model(
        unopy.PROBLEM_NONLINEAR,
        n,
        program.lower.tolist(),
        program.upper.tolist(),
        unopy.ZERO_BASED_INDEXING,
    )

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
    rows, columns = (i.ravel().tolist() for i in np.indices((m, n)))
    model.set_constraints(
        m,
        constraints,
        program.c_lower.tolist(),
        program.c_upper.tolist(),
        m * n,
        rows,
        columns,
        jacobian,
    )
    model.set_lagrangian_hessian(
        len(low[0]), unopy.LOWER_TRIANGLE, low[0].tolist(), low[1].tolist(), hessian
    )
    model.set_lagrangian_sign_convention(unopy.MULTIPLIER_NEGATIVE)
    model.set_initial_primal_iterate(x.tolist())
    return model


def _slsqp(program: Program, x: np.ndarray, iterations: int) -> Proposal:
    """Solve by scipy's sequential quadratic programming."""
    sides = [(1.0, program.c_lower), (-1.0, program.c_upper)]
    equal = program.c_lower == program.c_upper
    rules = [
        {
            "type": "ineq",
            "fun": lambda at, s=s, e=e, k=k: s * (program.values(at)[1] - e)[k],
            "jac": lambda at, s=s, k=k: s * program.slopes(at)[1][k],
        }
        for s, e in sides
        if (k := np.isfinite(e) & ~equal).any()
    ]
    if equal.any():
        rules.append(
            {
                "type": "eq",
                "fun": lambda at: (program.values(at)[1] - program.c_lower)[equal],
                "jac": lambda at: program.slopes(at)[1][equal],
            }
        )
    found = optimize.minimize(
        lambda at: program.values(at)[0],
        x,
        jac=lambda at: program.slopes(at)[0],
        bounds=optimize.Bounds(program.lower, program.upper),
        constraints=rules,
        method="SLSQP",
        options={"maxiter": iterations, "ftol": 1e-15},
    )
    return Proposal(found.x, int(found.nit), found.message)


class Stage(NamedTuple):
    """A solver, the Hessian it wants (gauss_newton, exact or none), and its steps in one go."""

    name: str
    hessian: str
    steps: int
    solve: Callable[[Program, np.ndarray, int], Proposal]


SOLVERS: tuple[Stage, ...] = (
    Stage("Uno filtersqp with Gauss-Newton", "gauss_newton", 3000, _uno("filtersqp")),
    Stage("Uno filtersqp", "exact", 300, _uno("filtersqp")),
    Stage("Uno ipopt", "exact", 1000, _uno("ipopt")),
    Stage("scipy SLSQP", "none", 300, _slsqp),
)
"""In the order of trying."""
