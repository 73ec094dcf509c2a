"""The same loop by beamfit and by do-mpc (CasADi, IPOPT): python benchmarks/control.py [steps]

SIMULATED processes without noise: a second order with an input that has limits and a rate and an
output below its upper limit, and a first order whose lag and gain change with the input by a
network. Model, horizon, cost, limits and target are the same; each controls its own plant. Told are
the cost of the closed loop, by how much limits are passed, and the median time of a step.

    pip install do-mpc casadi

Before that 1000 loops of an identified valve, constant and with a network, whose gains and time
constants are up to 20 % off, with noise and disturbances.
"""

from __future__ import annotations

import sys
import time
import warnings

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

from beamfit.dynamics.control import Controller, ControlLimits, Response, closed_loop, controller
from beamfit.dynamics.fit import identify
from beamfit.dynamics.record import Run
from beamfit.dynamics.response import FIRST_ORDER, SECOND_ORDER, simulate

STEP, HORIZON, SMOOTH, RATE, ABOVE, FIRST = 0.5, 20, 0.1, 0.2, 2.3, 0.4
BINDING = 1.8
HIDDEN = np.array([[1.3, -0.9, 0.7], [-0.6, 1.1, -0.4]])  # slopes and shifts of three nodes
OUTWARD = np.array([[0.5, -0.3, 0.4], [0.3, -0.4, 0.2]])  # to log tau and K
SHIFT = np.array([0.7, 1.3])
SECOND = np.array([2.0, 0.4, 1.5])


def network(u, tanh=jnp.tanh):
    """Raw numbers, log tau and K, of the input."""
    return OUTWARD @ tanh(HIDDEN[0] * u[0] + HIDDEN[1]) + SHIFT


def above(case: str) -> float:
    """The limit of the output: where it binds below the highest target."""
    return BINDING if "binds" in case else ABOVE


def target(k: int, steps: int) -> float:
    """A third each of 2.2, 0.6 and 1.6."""
    return (2.2, 0.6, 1.6)[min(3 * k // steps, 2)]


def ours(case: str) -> Controller:
    """The controller of beamfit."""
    physics, of = FIRST_ORDER, network
    if "second order" in case:
        physics, of = SECOND_ORDER, SECOND_ORDER.raw(jnp.array(SECOND))
    inf, one = np.full(1, np.inf), np.ones(1)
    limits = ControlLimits(0 * one, 2 * one, RATE * one, -inf, above(case) * one)
    responses = (Response("y", physics, of, 0.0, 0, 1.0, 0.2, 0.0),)
    return Controller(("u",), responses, STEP, one, limits, HORIZON, SMOOTH)


def run_ours(case: str, steps: int):
    """Outputs, inputs and times of steps."""
    control = ours(case)
    state = control.begin([FIRST])
    control(state, [0.0], [1.0])  # compiles
    y, u, took = [], [], []
    for k in range(steps):
        y.append(float(state.x[0][0]))  # the plant is the model: its state is the plant's
        begin = time.process_time()
        state, given, _ = control(state, [y[-1]], [target(k, steps)])
        given.block_until_ready()
        took.append(time.process_time() - begin)
        u.append(float(given[0]))
    return np.array(y), np.array(u), took


def peer_model(case: str):
    """The process in do-mpc, the last input a state of it for the sake of the rate."""
    import casadi
    import do_mpc

    model = do_mpc.model.Model("discrete")
    u = model.set_variable("_u", "u")
    last = model.set_variable("_x", "last")
    model.set_variable("_tvp", "target")
    if "second order" not in case:
        x = model.set_variable("_x", "x")
        inner = [casadi.tanh(a * u + b) for a, b in HIDDEN.T]
        raw = [sum(w * n for w, n in zip(row, inner, strict=True)) + s
               for row, s in zip(OUTWARD, SHIFT, strict=True)]  # fmt: skip
        settled = raw[1] * u
        model.set_rhs("x", settled + (x - settled) * casadi.exp(-STEP / casadi.exp(raw[0])))
    else:
        x = model.set_variable("_x", "x", (2, 1))
        p, zero = jnp.array(SECOND), jnp.zeros(1)
        columns = [SECOND_ORDER.advance(p, e, zero, STEP) for e in jnp.eye(2)]
        drive = np.asarray(SECOND_ORDER.advance(p, jnp.zeros(2), jnp.ones(1), STEP))
        model.set_rhs("x", np.column_stack(columns) @ x + drive * u)
    model.set_rhs("last", u + 0 * last)
    model.setup()
    return model


def peer(case: str, steps: int, now: list[int]):
    """The controller of do-mpc."""
    import do_mpc

    model = peer_model(case)
    mpc = do_mpc.controller.MPC(model)
    mpc.settings.n_horizon, mpc.settings.t_step = HORIZON, STEP
    mpc.settings.store_full_solution = False
    mpc.settings.supress_ipopt_output()
    error = (model.x["x"][0] - model.tvp["target"]) ** 2
    mpc.set_objective(mterm=error, lterm=error)
    mpc.set_rterm(u=SMOOTH)
    mpc.bounds["lower", "_u", "u"], mpc.bounds["upper", "_u", "u"] = 0.0, 2.0
    mpc.bounds["upper", "_x", "x"] = [above(case)] + [np.inf] * ("second order" in case)
    moved = model.u["u"] - model.x["last"]
    mpc.set_nl_cons("up", moved, ub=RATE)
    mpc.set_nl_cons("down", -moved, ub=RATE)
    template = mpc.get_tvp_template()

    def wanted(_):
        template["_tvp", :, "target"] = target(now[0], steps)
        return template

    mpc.set_tvp_fun(wanted)
    mpc.setup()
    return mpc


def run_peer(case: str, steps: int):
    """Outputs, inputs and times of steps."""
    now, of = [0], ours(case)
    x = np.asarray(of.begin([FIRST]).x[0])
    mpc = peer(case, steps, now)
    mpc.x0 = np.concatenate([[FIRST], x])
    mpc.u0 = np.array([FIRST])
    mpc.set_initial_guess()
    y, u, took = [], [], []
    r = of.responses[0]
    for k in range(steps):
        now[0] = k
        y.append(float(x[0]))
        last = u[-1] if u else FIRST
        begin = time.process_time()
        given = float(mpc.make_step(np.concatenate([[last], x])[:, None])[0, 0])
        took.append(time.process_time() - begin)
        u.append(given)
        raw = network(jnp.array([given])) if callable(r.of) else r.of
        p = r.physics.physical(raw)
        x = np.asarray(r.physics.advance(p, jnp.asarray(x), jnp.array([given]), STEP))
    return np.array(y), np.array(u), took


def cost(y: np.ndarray, u: np.ndarray) -> float:
    """What both minimise, over the whole loop."""
    wanted = np.array([target(k, len(y)) for k in range(len(y))])
    return float(np.sum((y - wanted) ** 2) + SMOOTH * np.sum(np.diff(u, prepend=FIRST) ** 2))


def perturbed(map: str, loops: int = 1000, steps: int = 60) -> list[str]:
    """How often, and by how much, limits are passed."""
    random = np.random.default_rng(0)
    valve = np.repeat(random.uniform(0.1, 2.9, 50), 8)
    p = np.stack([5 * np.tanh(valve) + 0.5, 5 * np.tanh(valve / 4) + 5], axis=1)
    p = p if map == "network" else np.tile([3.0, 2.0], (400, 1))
    level = np.asarray(simulate(FIRST_ORDER, jnp.asarray(p), jnp.asarray(valve)[:, None],
                                jnp.full(400, 0.5), jnp.zeros(1)))  # fmt: skip
    level = level + 0.03 * level.std() * random.normal(size=400)
    fit = identify(Run(0.5 * np.arange(400), {"valve": valve}, {"level": level}), map=map, delay=0)
    most, load = 1.5 * level.mean(), 0.2 * level.std()
    control = controller(fit, outputs={"level": (-np.inf, most)}, rates={"valve": 0.6})
    shape, limits = (loops, steps, 1), control.limits
    loads = load * random.uniform(-1, 1, (loops, 1, 1)) * (np.arange(steps) > 30)[:, None]
    factors = 1 + random.uniform(-0.2, 0.2, (loops, 2))
    wanted = np.broadcast_to(random.uniform(0.5 * most, most, (loops, 1, 1)), shape)
    # At rest within the limit to begin with, also where the gain is a fifth more.
    first = random.uniform(limits.low, limits.low + 0.4 * (limits.high - limits.low), (loops, 1))
    noise = fit.noise[0] * random.normal(size=shape)

    def one(u, target, noise, load, factor):
        return closed_loop(control, u, target, noise, load, [factor])

    trace = jax.jit(jax.vmap(one))(first, wanted, noise, loads, factors)
    over, u = np.asarray(trace.outputs)[..., 0] - most, np.asarray(trace.inputs)[..., 0]
    moves = np.abs(np.diff(np.concatenate([first, u], axis=1), axis=1)).max()
    past = max(u.max() - limits.high[0], limits.low[0] - u.min(), moves - limits.rate[0], 0.0)
    return [
        map,
        f"{limits.high[0]:.3g}",
        f"{(over.max(axis=1) > 0).sum()}",
        f"{max(over.max(), 0) / most:.1%}",
        f"{past:.1e}",
    ]


def main() -> None:
    """Print the tables."""
    table = Table("map", "valve up to", "loops that pass it", "by", "inputs and rates by")
    for map in ("constant", "network"):
        table.add_row(*perturbed(map))
    Console(width=100).print(table)
    warnings.simplefilter("ignore")
    steps = int(sys.argv[1]) if len(sys.argv) > 1 else 120
    table = Table("process", "by", "cost of the loop", "passed by", "ms a step", "slowest", "ratio")
    bind = ", a limit that binds"
    for case in ("second order", "second order" + bind, "network", "network" + bind):
        found = {"beamfit": run_ours(case, steps), "do-mpc": run_peer(case, steps)}
        base = np.median(found["beamfit"][2])
        for name, (y, u, took) in found.items():
            moves = np.abs(np.diff(u, prepend=FIRST)).max()
            passed = max(y.max() - above(case), u.max() - 2.0, -u.min(), moves - RATE, 0.0)
            table.add_row(case, name, f"{cost(y, u):.6f}", f"{passed:.1e}",
                          f"{1e3 * np.median(took):.2f}", f"{1e3 * max(took):.1f}",
                          f"{np.median(took) / base:.1f}")  # fmt: skip
    Console(width=100).print(table)


if __name__ == "__main__":
    main()
