"""Appendices A, B and C on SIMULATED scans: beamfit against CasADi + IPOPT, same starts, same run.

    python benchmarks/greybox.py [starts [starts with certified gains]]

Every end point, IPOPT's too, is judged by the same KKT residual (beamfit.greybox.assess). Times are
of one solve from one start, after a first one that compiles (beamfit) or builds (CasADi); the cost
of that first one is in a column of its own.
"""

import sys
import time
from pathlib import Path

import casadi
import jax
import numpy as np
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "greybox"))

import appendices as gtf

from beamfit.greybox import assess, solve

SCAN = gtf.simulated_scan(1)
OPTIONS = {"ipopt.print_level": 0, "print_time": 0, "ipopt.tol": 1e-9, "ipopt.max_iter": 3000}
OPTIONS |= {"ipopt.sb": "yes", "error_on_fail": False}


def squares(s, a, b):
    error = 2 * SCAN[0] * SCAN[1]
    return (1e4 * (a**2 * s[0] + 2 * a * b * s[1] + b**2 * s[2]) - SCAN[0] ** 2) / error


def casadi_a():
    s = casadi.SX.sym("s", 3)
    return s, squares([s[0], s[1], s[2]], casadi.DM(gtf.A_T), casadi.DM(gtf.B_T)), []


def casadi_b():
    """Unknowns in beamfit's order: s11, s12, s22, weights of both connections, biases of both."""
    t = casadi.SX.sym("t", 25)
    w1, b1, b2 = t[3:8], t[18:23], t[23:25]
    w2 = casadi.reshape(t[8:18], 2, 5)
    ab, limits = [], []
    for c in gtf.CURRENTS:
        h = casadi.tanh(b1 + w1 * c)
        ab.append(b2 + w2 @ h)
        limits.append(w2 @ ((1 - h**2) * w1))
    ab, limits = casadi.horzcat(*ab), casadi.horzcat(*limits)
    residual = squares([t[0], t[1], t[2]], ab[0, :].T, ab[1, :].T)
    return t, residual, [casadi.vec(limits.T)]


def casadi_c():
    t = casadi.SX.sym("t", 7)
    names = ["l11", "l21", "l22", "slope_q4", "int_q4", "slope_q3", "int_q3"]
    model = {name: t[i] for i, name in enumerate(names)}
    a, b = gtf.transport(model, casadi.DM(gtf.CURRENTS), casadi)
    size = 100 * casadi.sqrt((a * model["l11"] + b * model["l21"]) ** 2 + (b * model["l22"]) ** 2)
    return t, (size - SCAN[0]) / SCAN[1], []


def ipopt(build, p):
    """IPOPT on the same problem: a function of the start."""
    began = time.perf_counter()
    t, residual, limits = build()
    nlp = {"x": t, "f": 0.5 * casadi.sumsqr(residual)}
    if limits:
        nlp["g"] = limits[0]
    solver = casadi.nlpsol("ipopt", "ipopt", nlp, OPTIONS)
    built = time.perf_counter() - began

    def run(start):
        found = solver(
            x0=start, lbx=p.lower, ubx=p.upper, lbg=p.constraint_lower, ubg=p.constraint_upper
        )
        multipliers = -np.array(found["lam_g"]).ravel()
        return np.array(found["x"]).ravel(), solver.stats()["iter_count"], multipliers

    return run, built


def ours(p):
    def run(start):
        state, attempt = solve.search(p, start)
        return state.theta, attempt.iterations, state.limits.multiplier

    return run, 0.0


def highest_gain_excess(p, theta):
    """By how much dense sampling finds Appendix B's gains above their limits; below 0 is none."""
    gains = SAMPLED(p.model_at(theta)["map"], np.linspace(0.0, 3.9, 20001)[:, None])
    return float((np.asarray(gains)[..., 0].max(axis=0) - list(gtf.LIMITS.values())).max())


SAMPLED = jax.jit(lambda net, x: jax.vmap(jax.jacfwd(net.values))(x))


def compare(name, p, build, starts):
    table = Table(title=f"Appendix {name}: SIMULATED scan, {starts} random starts")
    for column in ("solver", "KKT", "best cost", "median cost", "iterations", "median ms"):
        table.add_column(column)
    for column in ("ratio", "first s", "gain excess"):
        table.add_column(column)
    points = solve.starting_points(p, starts + 1, seed=7)[1:]
    tools = {"beamfit": ours(p)} | ({"CasADi+IPOPT": ipopt(build, p)} if build else {})
    base = None
    for tool, (run, built) in tools.items():
        began = time.perf_counter()
        run(points[0])
        first = time.perf_counter() - began + built
        times, good, costs, steps, excess = [], 0, [], [], []
        for point in points:
            began = time.perf_counter()
            theta, iterations, _ = run(point)
            times.append(1e3 * (time.perf_counter() - began))
            theta = np.clip(theta, p.lower, p.upper)
            state = assess.state(p, theta, assess.scale_of(p, point, assess.slopes(p, point)))
            good += state.kkt.worst <= 1e-6
            costs.append(float(state.at.cost))
            steps.append(iterations)
            excess += [highest_gain_excess(p, theta)] if p.constraints else []
        base = base or np.median(times)
        table.add_row(
            tool,
            f"{good}/{starts}",
            f"{min(costs):.4g}",
            f"{np.median(costs):.4g}",
            f"{np.median(steps):.0f}",
            f"{np.median(times):.2f}",
            f"{np.median(times) / base:.2f}",
            f"{first:.2f}",
            f"{max(excess):.2g}" if excess else "",
        )
    Console(width=110).print(table)


def main(starts=20, certified=20):
    compare("A", gtf.appendix_a(SCAN), casadi_a, starts)
    compare("C", gtf.appendix_c(SCAN), casadi_c, starts)
    points = gtf.appendix_b(SCAN, gtf.point_constraints())
    compare("B, 28 gains at points", points, casadi_b, starts)
    if certified:
        cells = gtf.appendix_b(SCAN, gtf.certified_constraints())
        compare("B, gains certified on 32 cells", cells, None, certified)


if __name__ == "__main__":
    main(*(int(word) for word in sys.argv[1:]))
