"""How well, and how fast, are changing parameters identified? python benchmarks/response.py [seeds]

SIMULATED runs of the report's second order (eqs 17-19: u between 0.1 and 2.9, samples of 0.5 s),
with noise of 0, 0.1 and 3.0 times the output's scatter and by the number of samples: the rms error
of a1 (eq 13) over the visited range, beside that of constant parameters, the pulls of the curves
and their cover. Then the time of a value and gradient of 2000 samples beside a scan by hand.
"""

from __future__ import annotations

import sys
import timeit

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

from beamfit.dynamics.fit import identify
from beamfit.dynamics.record import Run
from beamfit.dynamics.response import SECOND_ORDER, simulate

APART = 0.5


def truth(u):
    """T, zeta and K of eqs 17-19."""
    tau1, tau2 = 5 * np.tanh(u) + 0.5, -8 * np.tanh(u**2 - 2 * u) + 8.5
    time = np.sqrt(tau1 * tau2)
    return np.stack([time, (tau1 + tau2) / (2 * time), 5 * np.tanh(u / 4)], axis=-1)


def first_coefficient(p):
    """a1 of eq 13, of T and zeta."""
    root = np.sqrt((p[..., 1] ** 2 - 1).astype(complex))
    lags = [np.exp(-APART / p[..., 0] * (p[..., 1] + sign * root)) for sign in (1, -1)]
    return -np.sum(lags, axis=0).real


def run_of(samples: int, noise: float, seed: int) -> Run:
    random = np.random.default_rng(seed)
    u = np.repeat(random.uniform(0.1, 2.9, samples // 8 + 1), 8)[:samples]
    steps = jnp.full(samples, APART)
    y = simulate(SECOND_ORDER, jnp.asarray(truth(u)), jnp.asarray(u)[:, None], steps, jnp.zeros(2))
    y = np.asarray(y)
    y = y + noise * y.std() * random.normal(size=samples)
    return Run(APART * np.arange(samples), {"u": u}, {"y": y})


def study(samples: int, noise: float, seed: int) -> list[float]:
    """Rms errors of a1 by the network and by constants, rms pull and cover of the curves."""
    fit = identify(run_of(samples, noise, seed), "second-order", "network", delay=0, offset=False)
    plain = identify(run_of(samples, noise, seed), "second-order", delay=0, offset=False)
    at = fit.curves[0].at
    seen = fit.curves[0].visited
    found, true = np.stack([c.value for c in fit.curves], axis=-1), truth(at)
    error = np.stack([c.error for c in fit.curves], axis=-1)
    constant = np.array([plain.quantities[n].value for n in ("T", "zeta")])
    a1 = first_coefficient(true)

    def rms(values):
        return float(np.sqrt(np.nanmean(values[seen] ** 2)))

    pull = (found - true) / error
    return [
        rms(first_coefficient(found) - a1),
        rms(first_coefficient(constant) - a1),
        rms(pull),
        100 * float(np.nanmean(np.abs(pull[seen]) < 1)),
        100 * rms(found / true - 1) if noise == 0 else np.nan,
        fit.fit.seconds,
    ]


def by_hand(p, u, y0):
    """The same process as two lags in a row would be written without this package."""

    def step(state, now):
        (time, zeta, gain), drive = now
        rate = jnp.sqrt(jnp.maximum(zeta**2 - 1, 1e-12))
        fast, slow = -(zeta + rate) / time, -(zeta - rate) / time
        d, v = state[0] - gain * drive, state[1]
        one = (v - slow * d) / (fast - slow)
        two = d - one
        e1, e2 = jnp.exp(fast * APART), jnp.exp(slow * APART)
        moved = jnp.stack([one * e1 + two * e2 + gain * drive, fast * one * e1 + slow * two * e2])
        return moved, state[0]

    return jax.lax.scan(step, y0, (p, u))[1]


def speed(console: Console) -> None:
    u = np.random.default_rng(0).uniform(0.1, 0.9, (2000, 1))  # tau1 differs from tau2 throughout
    p, u, steps, rest = (
        jnp.asarray(truth(u[:, 0])),
        jnp.asarray(u),
        jnp.full(2000, APART),
        jnp.zeros(2),
    )
    ours = jax.jit(jax.value_and_grad(
        lambda q: jnp.sum(simulate(SECOND_ORDER, q, u, steps, rest) ** 2)))  # fmt: skip
    hand = jax.jit(jax.value_and_grad(lambda q: jnp.sum(by_hand(q, u[:, 0], rest) ** 2)))
    np.testing.assert_allclose(ours(p)[0], hand(p)[0], rtol=1e-9)
    took = [
        min(timeit.repeat(lambda f=f: jax.block_until_ready(f(p)), number=10, repeat=9)) * 100
        for f in (ours, hand)
    ]
    console.print(f"value and gradient of 2000 samples: {took[0]:.2f} ms, a scan by hand "
                  f"{took[1]:.2f} ms, ratio {took[0] / took[1]:.2f}")  # fmt: skip


def main() -> None:
    console, seeds = Console(), int(sys.argv[1]) if len(sys.argv) > 1 else 3
    speed(console)
    head = [
        "noise",
        "samples",
        "rms a1",
        "constant",
        "rms pull",
        "within 1 error, %",
        "off, %",
        "s",
    ]
    table = Table(*head, title=f"medians of {seeds} seeds")
    for noise, samples in [(0.0, 800), (0.1, 200), (0.1, 800), (3.0, 800), (3.0, 8000)]:
        found = np.median([study(samples, noise, seed) for seed in range(seeds)], axis=0)
        table.add_row(f"{noise}", f"{samples}", *(f"{v:.3g}" for v in found))
    console.print(table)


if __name__ == "__main__":
    main()
