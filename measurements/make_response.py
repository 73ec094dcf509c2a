"""Make measurements/valve_level_simulated.csv: a SIMULATED first-order process whose lag and gain
change with its input (report eqs 5-7), read late by one second with noise of 10 % of its scatter.

    python measurements/make_response.py
"""

from pathlib import Path

import jax.numpy as jnp
import numpy as np

from beamfit.dynamics.response import FIRST_ORDER, simulate
from beamfit.writing import write_atomically

SAMPLES, APART, DELAY = 800, 0.5, 2


def main() -> None:
    """Write the file."""
    random = np.random.default_rng(1)
    u = np.repeat(random.uniform(0.1, 2.9, SAMPLES // 8), 8)
    late = np.concatenate([np.repeat(u[:1], DELAY), u])[:SAMPLES]
    p = np.stack([5 * np.tanh(late) + 0.5, 5 * np.tanh(late / 4) + 5], axis=1)
    steps = jnp.full(SAMPLES, APART)
    y = simulate(FIRST_ORDER, jnp.asarray(p), jnp.asarray(late)[:, None], steps, jnp.zeros(1))
    y = np.asarray(y) + 0.1 * float(y.std()) * random.normal(size=SAMPLES)
    lines = [
        "# SIMULATED, not measured: tau y' + y = K u with tau = 5 tanh(u) + 0.5 s, "
        "K = 5 tanh(u/4) + 5",
        "# read 2 samples late, noise 10 % of the output's scatter; made by make_response.py",
        "time_s,u_valve,y_level",
        *(f"{APART * k:.1f},{a:.5f},{b:.5f}" for k, (a, b) in enumerate(zip(u, y, strict=True))),
    ]
    place = Path(__file__).with_name("valve_level_simulated.csv")
    write_atomically(place, ("\n".join(lines) + "\n").encode())


if __name__ == "__main__":
    main()
