"""A document with many points: parsing, compiling, value and gradient, memory.

Appendix A of the report with its 14 points replaced by SIMULATED ones, beside the same model
written by hand with JAX over the same arrays: `python benchmarks/language.py 100000`.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import beamfit.greybox  # noqa: F401 - double precision
from beamfit.language.parse import parse_document
from beamfit.language.problem import formulate

ROOT = Path(__file__).resolve().parents[1]
REPEATS = 30


def least(function, *arguments):
    """The least of some durations in seconds, the first call left out."""
    jax.block_until_ready(function(*arguments))
    best = np.inf
    for _ in range(REPEATS):
        began = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        best = min(best, time.perf_counter() - began)
    return best


def table_of(points):
    """SIMULATED: columns as in formulations/fitdata_simulated.csv."""
    rng = np.random.default_rng(1)
    data = np.zeros((points, 23))
    data[:, 8], data[:, 9] = rng.normal(size=points), 2 + rng.normal(size=points)
    size = 100 * np.sqrt(
        np.abs(2.6 * data[:, 8] ** 2 + 3 * data[:, 8] * data[:, 9] + 2 * data[:, 9] ** 2)
    )
    data[:, 14], data[:, 15] = size * (1 + 0.02 * rng.normal(size=points)), 0.02 * size
    return data


def by_hand(theta, a, b, size, error):
    """The same objective as a vectorised JAX function."""
    s11, s12, s22 = theta / 1e8
    found = 1e6 * jnp.sqrt(a**2 * s11 + 2 * a * b * s12 + b**2 * s22)
    return jnp.sum(((found**2 - size**2) / (2 * size * error)) ** 2)


def main(points):
    """Print what it takes."""
    text = (ROOT / "formulations/appendix_a.bf").read_text()
    text = text.replace("|1:14|", f"|1:{points}|").replace("[14, 23]", f"[{points}, 23]")
    data = table_of(points)
    theta = np.array([2.6, 1.5, 1.4])
    began = time.perf_counter()
    made = formulate(parse_document(text), {"d": data})
    parsed = time.perf_counter() - began
    program = made.program
    constants = {n: jnp.asarray(v) for n, v in program.constants.items()}

    def mapping(t, constants):
        given = dict(zip(("s11", "s12", "s22"), t, strict=True))
        return program(given, ["obj"], constants)["obj"]

    began = time.perf_counter()
    ours = jax.jit(jax.value_and_grad(mapping))
    jax.block_until_ready(ours(theta, constants))
    compiled = time.perf_counter() - began
    columns = [jnp.asarray(data[:, k]) for k in (8, 9, 14, 15)]
    hand = jax.jit(jax.value_and_grad(by_hand))
    seconds, reference = least(ours, theta, constants), least(hand, theta, *columns)
    worst = max(
        float(np.max(np.abs(np.asarray(x) / np.asarray(y) - 1)))
        for x, y in zip(ours(theta, constants), hand(theta, *columns), strict=True)
    )
    peak = int(Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0]) / 1024
    print(f"{points} points: parsed and checked {parsed:.2f} s, compiled {compiled:.2f} s")
    print(f"value and gradient {1e3 * seconds:.2f} ms, by hand {1e3 * reference:.2f} ms "
          f"({seconds / reference:.2f} times), apart by {worst:.1e}")  # fmt: skip
    print(f"memory at most {peak:.0f} MB")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100_000)
