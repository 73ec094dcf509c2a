"""Least squares of many free numbers: beamfit beside CasADi + IPOPT, same start, same run.

    python benchmarks/size.py [n n …]

SIMULATED: a smooth curve of n numbers, each read once with noise and held smooth by its second
differences; and n numbers of which every reading sees all (dense, n = 400). Times are of a problem
stated anew after one of the same size that compiles, patterns, errors and verdict included; IPOPT
gives neither. Memory is the most that the process has held so far.
"""

import resource
import sys
import time

import casadi
import numpy as np
from rich.console import Console
from rich.table import Table

import beamfit.greybox  # noqa: F401 - double precision
from beamfit.greybox.problem import Free, Prior, Problem, Record
from beamfit.greybox.solve import solve

OPTIONS = {"ipopt.print_level": 0, "print_time": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-9}


def reading(model, _):
    return model["x"] + 0.1 * model["x"] ** 3


def bend(model):
    x = model["x"]
    return x[2:] - 2 * x[1:-1] + x[:-2]


def mixed(model, matrix):
    seen = matrix @ model["x"]
    return seen + 0.1 * seen**3


def curve(n):
    t = np.linspace(0, 6, n)
    measured = np.sin(t) + 0.1 * np.sin(t) ** 3 + 0.05 * np.random.default_rng(1).normal(size=n)
    record = Record("curve", reading, None, measured, 0.05)
    return Problem({"x": np.zeros(n)}, [Free("x")], [record], [Prior("bend", 0.0, 0.01, bend)])


def dense(n):
    rng = np.random.default_rng(2)
    matrix, truth = rng.normal(size=(2 * n, n)) / np.sqrt(n), rng.normal(size=n)
    seen = matrix @ truth
    measured = seen + 0.1 * seen**3 + 0.05 * rng.normal(size=2 * n)
    return Problem({"x": np.zeros(n)}, [Free("x")], [Record("all", mixed, matrix, measured, 0.05)])


def ipopt(p):
    """IPOPT on the same squares: a function of the start."""
    (record,), n = p.records, len(p.start)
    # Scalars where each row sees a few numbers, matrices (a hundredth of the memory) where all.
    x = casadi.SX.sym("x", n) if record.data is None else casadi.MX.sym("x", n)
    seen = x if record.data is None else casadi.mtimes(casadi.DM(np.asarray(record.data)), x)
    rows = [(seen + 0.1 * seen**3 - np.asarray(record.measured)) / 0.05]
    if p.priors:
        rows.append((x[2:] - 2 * x[1:-1] + x[:-2]) / 0.01)
    cost = 0.5 * casadi.sumsqr(casadi.vertcat(*rows))
    solver = casadi.nlpsol("ipopt", "ipopt", {"x": x, "f": cost}, OPTIONS)

    def run(start):
        began = time.perf_counter()
        found = np.array(solver(x0=start)["x"]).ravel()
        return found, time.perf_counter() - began, solver.stats()["iter_count"]

    return run


def main(sizes):
    table = Table(title="Many free numbers (SIMULATED)")
    for column in ("problem", "n", "ms", "steps", "first s", "MB", "IPOPT ms", "steps", "apart"):
        table.add_column(column, justify="right")
    for state, n in [*((curve, n) for n in sizes), (dense, 400)]:
        began = time.perf_counter()
        solve(state(n))
        first = time.perf_counter() - began
        p = state(n)
        began = time.perf_counter()
        fit = solve(p)
        spent = time.perf_counter() - began
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        theirs, seconds, steps = ipopt(p)(p.start)
        apart = np.max(np.abs(theirs - fit.theta) / [v.error for v in fit.variables])
        table.add_row(state.__name__, f"{n}", f"{1e3 * spent:.0f}", f"{fit.iterations}",
                      f"{first:.2f}", f"{memory:.0f}", f"{1e3 * seconds:.0f}", f"{steps}",
                      f"{apart:.0e} errors")  # fmt: skip
    Console(width=110).print(table)


if __name__ == "__main__":
    main([int(word) for word in sys.argv[1:]] or [200, 400, 1000, 2000, 5000, 20000])
