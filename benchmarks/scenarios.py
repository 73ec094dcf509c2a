"""Training the transport network from 20 starts, on a SIMULATED scan of 14 points.

    python benchmarks/scenarios.py [starts]

beamfit (all starts vectorised, then a polish and a verdict) beside CasADi + IPOPT on the same
problem: the same residuals, bounds and starts, IPOPT from one start after the other. Warm: after a
first run that compiles (beamfit) or builds (CasADi), whose time is in a column of its own. The
columns "χ² best" and "χ² median" are over the starts.
"""

import sys
import time
from pathlib import Path

import casadi
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

import beamfit
from beamfit.emittance.assumptions import Anchor, Assumptions
from beamfit.emittance.model import predict_sizes
from beamfit.emittance.statement import prepare
from beamfit.emittance.transport_network import SCENARIO
from beamfit.greybox import problem as greybox
from beamfit.greybox.descend import descend_all
from beamfit.greybox.solve import solve, starting_points

ROOT = Path(__file__).parents[1]
OPTIONS = {"ipopt.print_level": 0, "print_time": 0, "ipopt.tol": 1e-9, "ipopt.max_iter": 3000}
OPTIONS |= {"ipopt.sb": "yes", "error_on_fail": False}


def symbolic(problem):
    """The residuals in CasADi, from the problem's own arrays."""
    names = [name.rsplit("[", 1)[0] for name in problem.names]
    t = casadi.SX.sym("t", len(names))

    def part(path):
        return [t[i] for i, name in enumerate(names) if name == path]

    net = problem.model["map"]
    first, last = part("map.weights.layer0->layer1"), part("map.weights.layer1->layer2")
    b1, b2 = part("map.biases.layer1"), part("map.biases.layer2")
    (l11,), (l21,), (l22,) = (part(f"beam.x.{k}") for k in ("l11", "l21", "l22"))
    port, outputs = net.input_ports[0], net.output_ports

    def elements(current):
        nodes = [casadi.tanh(b + w * (current - port.bias) / port.scale)
                 for w, b in zip(first, b1, strict=True)]  # fmt: skip
        return [
            p.bias + p.scale * (b2[k] + sum(n * last[2 * i + k] for i, n in enumerate(nodes)))
            for k, p in enumerate(outputs)
        ]

    found = []
    for record in problem.records:
        measured, error = np.asarray(record.measured), np.asarray(record.error)
        weight = np.broadcast_to(record.weight, measured.shape)  # 0 for padding
        for i, current in enumerate(np.asarray(record.data.inputs)[:, 0]):
            a, b = elements(float(current))
            if record.predict is predict_sizes:
                size2 = 1e4 * ((a * l11 + b * l21) ** 2 + (b * l22) ** 2)
                found.append(weight[i] * (size2 - measured[i]) / error[i])
            else:
                scale = 1 + part("anchor.x")[0]  # one for all: what the drawings may be off by
                miss = [(v / scale - measured[i, k]) / error[i, k] for k, v in enumerate((a, b))]
                found += [weight[i, k] * m for k, m in enumerate(miss)]
    found += [(part(prior.name)[0] - prior.mean) / prior.sd for prior in problem.priors]
    return t, casadi.vertcat(*found)


def ipopt(problem):
    began = time.perf_counter()
    t, residual = symbolic(problem)
    solver = casadi.nlpsol("s", "ipopt", {"x": t, "f": 0.5 * casadi.sumsqr(residual)}, OPTIONS)

    def run(starts):
        return [
            2.0 * float(solver(x0=s, lbx=problem.lower, ubx=problem.upper)["f"]) for s in starts
        ]

    return run, time.perf_counter() - began, casadi.Function("r", [t], [residual])


def ours(problem):
    def run(starts):
        lower, upper = jnp.asarray(problem.lower), jnp.asarray(problem.upper)
        points = jnp.asarray(np.array(starts))
        found = descend_all(greybox.residual, problem.core, points, lower, upper)
        return 2.0 * np.asarray(found.cost)

    return run


def timed(function, repeats=5):
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        value = function()
        times.append(time.perf_counter() - began)
    return value, float(np.median(times))


def compare(name, problem, count, table):
    starts = starting_points(problem, count, 0)
    run, built, check = ipopt(problem)
    same = np.abs(np.array(check(starts[1])).ravel() - np.asarray(problem.residual(starts[1])))
    assert same.max() < 1e-6 * (1 + np.abs(np.asarray(problem.residual(starts[1]))).max())
    search = ours(problem)
    began = time.perf_counter()
    search(starts)
    solve(problem, count)
    first = time.perf_counter() - began
    costs, searched = timed(lambda: search(starts))
    fit, whole = timed(lambda: solve(problem, count))
    theirs, peer = timed(lambda: run(starts), 1)
    rows = [
        ("beamfit: search", costs, searched, first),
        ("beamfit: search, polish, verdict", [2.0 * fit.cost], whole, first),
        ("CasADi+IPOPT: search", theirs, peer, built),
    ]
    for tool, chi2, seconds, cold in rows:
        table.add_row(name, tool, f"{min(chi2):.3f}", f"{np.median(chi2):.3f}", f"{seconds:.3f}",
                      f"{seconds / peer:.2f}", f"{cold:.1f}")  # fmt: skip


def main(count=20):
    scan = beamfit.read_quad_scan(ROOT / "measurements/gtf_simulated.csv")
    line = beamfit.load_lattice(ROOT / "lattices/gtf.toml")
    seen = prepare(scan, line)
    table = Table(title=f"Transport network, SIMULATED scan of 14 points, {count} starts")
    for column in ("problem", "tool", "χ² best", "χ² median", "s warm", "ratio", "s first"):
        table.add_column(column)
    for name, anchor in (("no anchor", Anchor()), ("anchor 2 %", Anchor(deviation=0.02))):
        problem = SCENARIO.state(seen, Assumptions(anchor=anchor))
        compare(name, problem, count, table)
    Console(width=110).print(table)


if __name__ == "__main__":
    main(*(int(word) for word in sys.argv[1:]))
