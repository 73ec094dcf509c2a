"""State spaces: physics beside a network alone, memory, and jax-sysid. python benchmarks/states.py

SIMULATED two tanks in a row, the upper one of which overflows into the lower (1024 samples of 4 s,
noise of 0.02): Torricelli's law with unknown coefficients and a network for what is unknown, beside
a network state space of as many nodes, on a run that was held back. Then 30 000 samples of a linear
system: time and the most memory; and the same by jax-sysid (L-BFGS as its page has it) where the
python of its own environment is named: python benchmarks/states.py /tmp/venv-sysid/bin/python.

python benchmarks/states.py eqs [first seed, seeds]: report eqs 1 and 2 on plants of two states, an
input and a known parameter rho, linear or bent, identified anew with several noises: how many
coefficients of A and B about the rest lie within one error of the truth, and within 1.96.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
import time

import jax.numpy as jnp
import numpy as np
from scipy.signal import cont2discrete, dlsim

from beamfit.dynamics.linear import identify_states
from beamfit.dynamics.record import Run
from beamfit.dynamics.state_fit import fit_states
from beamfit.dynamics.states import StateSpace
from beamfit.greybox.problem import Free, Prior

SYSID = """
import time, numpy as np, jax
jax.config.update("jax_enable_x64", True)
from jax_sysid.models import LinearModel
d = np.load({path!r}); u, y = d["u"], d["y"]
u, y = (u - u.mean(0)) / u.std(0), (y - y.mean(0)) / y.std(0)
began = time.perf_counter()
model = LinearModel(3, 2, 2, feedthrough=False)
model.loss(rho_x0=1e-8, rho_th=1e-10)
model.optimization(adam_epochs=0, lbfgs_epochs=1000, iprint=-1)
model.fit(y, u)
yhat, _ = model.predict(model.x0, u)
print(f"jax-sysid: {{time.perf_counter() - began:.1f}} s, rms residual over scatter",
      np.sqrt(np.mean((y - yhat) ** 2, 0)).round(5))
"""


def flow(x, u, p):
    """Torricelli's law, and what a network adds to it."""
    out = p["k"] * jnp.sqrt(jnp.maximum(x, 1e-3))
    known = jnp.stack([p["pump"] * u[0] - out[0], out[0] - out[1]])
    net = p["net"]
    inside = net["inside"] @ jnp.concatenate([x / 10.0, u / 5.0]) + net["bias"]
    return known + 0.1 * net["out"] @ jnp.tanh(inside)


TANKS = StateSpace(flow, lambda x, u, p: x[1:], parts=2)


def tanks(samples: int, seed: int) -> Run:
    """Levels up to 10; half of what the upper tank spills falls into the lower one."""
    random, f = np.random.default_rng(seed), np.arange(1, 60)
    wave = np.cos(2 * np.pi * np.outer(np.arange(samples), f) / samples
                  + random.uniform(0, 2 * np.pi, 59)).sum(1)  # fmt: skip
    u, h, level, step = 3.0 + np.clip(wave / 3.2, -2.5, 4.0), [4.0, 5.0], [], 4.0 / 20
    for now in u:
        level.append(h[1])
        for _ in range(20):
            out = 0.055 * np.sqrt(h[0]), 0.05 * np.sqrt(h[1])
            upper = h[0] + step * (0.04 * now - out[0])
            spilt = 0.5 * max(upper - 10.0, 0.0)
            h = [min(upper, 10.0), min(h[1] + step * (out[0] - out[1]) + spilt, 10.0)]
    noisy = np.array(level) + 0.02 * random.normal(size=samples)
    return Run(4.0 * np.arange(samples), {"pump": u}, {"level": noisy}, name=f"tanks {seed}")


def physics_and_network(run: Run, held: Run, hidden: int = 5, seed: int = 0):
    """Fit Torricelli's law and a network."""
    random = np.random.default_rng(seed)
    net = {"inside": random.normal(0, 0.6, (hidden, 3)), "bias": random.normal(0, 1, hidden),
           "out": random.normal(0, 0.05, (2, hidden))}  # fmt: skip
    begin = {"k": np.full(2, 0.08), "pump": 0.06, "net": net}
    free = [Free("p.k"), Free("p.pump"), Free("p.net", nuisance=True)]
    return fit_states(run, TANKS, begin, [3.0, 5.0], free=free, priors=[Prior("p.net", 0.0, 1.0)],
                      held=[held])  # fmt: skip


def compare(samples: int = 1024) -> tuple[float, float]:
    """Rms of the held-back run by physics and network, and by the network alone."""
    run, held, found = tanks(samples, 1), tanks(samples, 2), []
    for name, fit in (
        ("physics and network", lambda: physics_and_network(run, held)),
        ("network alone", lambda: identify_states(run, 2, "network", starts=1, held=[held])),
    ):
        began = time.process_time()
        answer = fit()
        ahead = answer.held["level"][0]
        print(f"{name}: fit rms {answer.noise[0, 0]:.4f}, held back {ahead.rms:.4f} "
              f"({ahead.free_run_percent:.2f} %), {answer.status}, "
              f"{time.process_time() - began:.0f} s of processor", flush=True)  # fmt: skip
        found.append(ahead.rms)
    return found[0], found[1]


def long(python: str | None, samples: int = 30_000) -> None:
    """Time and memory of a long record, here and by jax-sysid."""
    random = np.random.default_rng(0)
    a = np.array([[-0.05, 1.0, 0.0], [-1.0, -0.05, 0.0], [0.0, 0.0, -0.01]])
    b, c = random.normal(size=(3, 2)), random.normal(size=(2, 3))
    system = cont2discrete((a, b, c, np.zeros((2, 2))), 0.2)
    u = np.stack(
        [np.repeat(random.normal(size=samples // e + 1), e)[:samples] for e in (20, 50)], 1
    )
    y = dlsim(system, u)[1]
    y += 0.1 * y.std(0) * random.normal(size=y.shape)
    began = time.perf_counter()
    fit = identify_states(Run(0.2 * np.arange(samples), {"a": u[:, 0], "b": u[:, 1]},
                              {"l": y[:, 0], "m": y[:, 1]}), 3)  # fmt: skip
    took, most = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    rest = (fit.noise[0] / y.std(0)).round(5)
    print(f"{samples} samples, order 3: {took:.1f} s, {most / 1024:.0f} MB, {fit.status}, "
          f"rms residual over scatter {rest}", flush=True)  # fmt: skip
    if python is None:
        print("jax-sysid: not looked at; name the python of an environment that has it")
        return
    with tempfile.NamedTemporaryFile(suffix=".npz") as file:
        np.savez(file, u=u, y=y)
        file.flush()
        subprocess.run([python, "-c", SYSID.format(path=file.name)], check=True)


A, B = np.array([[0.85, 0.1], [-0.15, 0.75]]), np.array([[0.4, 0.1], [0.1, -0.3]])


def nodes(x, u):
    """What three nodes of tanh add to x+ = A x + B u."""
    three = np.tanh(np.array([1.2 * x[0] - 0.8 * u[1] + 0.3, 0.7 * x[0] + 0.9 * x[1] - 0.2,
                              x[1] + 0.5 * u[0]]))  # fmt: skip
    return 0.15 * np.array([three[0], three[1] - three[2]])


def products(x, u):
    """What products add: no few nodes are these."""
    return 0.08 * np.array([x[0] * u[1], np.tanh(x[0]) * x[1]])


PLANTS = {
    "linear": ("constant", lambda x, u: np.zeros(2)),
    "with three nodes": ("network", nodes),
    "with products": ("network", products),
}


def slopes(after, u, step=1e-6):
    """A and B about the rest, by differences."""
    x = np.zeros(2)
    for _ in range(2000):
        x = after(x, u)
    moves = step * np.eye(2)
    return [np.stack([(after(*up) - after(*down)) / (2 * step) for up, down in pairs], axis=1)
            for pairs in ([((x + d, u), (x - d, u)) for d in moves],
                          [((x, u + d), (x, u - d)) for d in moves])]  # fmt: skip


def coefficients(plant: str, first: int = 0, noises: int = 12, samples: int = 300) -> None:
    """Pulls of A and B where the states are the outputs."""
    form, more = PLANTS[plant]
    pulls = []

    def after(x, u):
        return A @ x + B @ u + more(x, u)

    for seed in range(first, first + noises):
        random, x, y = np.random.default_rng(seed), np.zeros(2), []
        u = np.repeat(random.normal(size=(samples // 8 + 1, 2)), 8, axis=0)[:samples]
        for now in u:
            y.append(x)
            x = after(x, now)
        y = np.array(y) + 0.05 * random.normal(size=(samples, 2))
        run = Run(np.arange(1.0 * samples), dict(zip(("u", "rho"), u.T, strict=True)),
                  dict(zip("xz", y.T, strict=True)))  # fmt: skip
        found = identify_states(run, 2, form).to_json()["matrices"]["outputs_as_states"]
        for name, true in zip("AB", slopes(after, u.mean(0)), strict=True):
            off = np.array(found[name]) - true
            pulls.append(np.abs(off / np.array(found[f"{name}_error"], float)))
    pulls = np.concatenate([p.ravel() for p in pulls])
    print(f"{plant}: of {len(pulls)} coefficients {np.mean(pulls < 1):.0%} within one error, "
          f"{np.mean(pulls < 1.96):.0%} within 1.96", flush=True)  # fmt: skip


if __name__ == "__main__":
    if sys.argv[1:2] == ["eqs"]:
        for plant in PLANTS:
            coefficients(plant, *map(int, sys.argv[2:]))
        sys.exit()
    long(sys.argv[1] if len(sys.argv) > 1 else None)
    compare()
