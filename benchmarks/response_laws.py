"""Are gains behind a law of the input sure and wrong? python benchmarks/response_laws.py [records]

SIMULATED records (300 samples of 0.5 s, K = 2) of a first order behind a play, a hysteresis, a
stop, a dead zone or a shift by the direction of motion, and without any, of seven kinds of input,
noise of 0.003 to 0.3 of the scatter, white or wandering, drawn at random. Printed: verdicts, and
how many `converged` gains and time constants are more than 3 errors off.
"""

from __future__ import annotations

import sys
from collections import Counter

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.signal import lfilter

from beamfit.dynamics.fit import identify
from beamfit.dynamics.record import Run

COUNT, APART, GAIN = 300, 0.5, 2.0


def triangle(at: np.ndarray) -> np.ndarray:
    """From 0 to 3 and back in 60 samples."""
    return 1.5 + 3.0 / np.pi * np.arcsin(np.sin(2 * np.pi * at / 60))


def walk(rng: np.random.Generator) -> np.ndarray:
    """A random walk in steps of four samples, from 0 to 3."""
    found = np.cumsum(rng.normal(size=COUNT // 4 + 1))
    return np.repeat(3.0 * (found - found.min()) / np.ptp(found), 4)[:COUNT]


AT = np.arange(COUNT)
INPUTS = {
    "steps of 8": lambda rng: np.repeat(rng.uniform(0, 3, COUNT // 8 + 1), 8)[:COUNT],
    "steps of 20": lambda rng: np.repeat(rng.uniform(0, 3, COUNT // 20), 20),
    "two values": lambda rng: np.repeat(rng.integers(0, 2, COUNT // 6) * 3.0, 6),
    "triangle": lambda rng: triangle(AT + rng.uniform(0, 60)),
    "stairs": lambda rng: np.repeat(
        np.abs((np.arange(COUNT // 10) + rng.integers(12)) % 12 - 6) / 2, 10
    ),
    "two sines": lambda rng: 1.5 + 0.8 * np.sin(AT / 7.5) + 0.6 * np.sin(AT / 3 + 1),
    "walk": walk,
}


def play(u: np.ndarray, half: float) -> np.ndarray:
    """Follow when the clearance is used up."""
    at, found = u[0], []
    for now in u:
        at = min(max(at, now - half), now + half)
        found.append(at)
    return np.array(found)


def stop(u: np.ndarray, half: float) -> np.ndarray:
    """Go all the way once the distance is larger."""
    at, found = u[0], []
    for now in u:
        at = now if abs(now - at) > half else at
        found.append(at)
    return np.array(found)


def directed(u: np.ndarray, half: float) -> np.ndarray:
    """A shift by the direction of the last move."""
    sign = np.sign(np.diff(u, prepend=u[0]))
    last = np.maximum.accumulate(np.where(sign != 0, AT, 0))
    return u - half * sign[last]


LAWS = {
    "none": lambda u, half: u,
    "play": play,
    "hysteresis": lambda u, half: np.mean([play(u, h) for h in np.linspace(0, 2 * half, 6)], 0),
    "stop": stop,
    "dead zone": lambda u, half: u - np.clip(u - 1.5, -half, half),
    "direction": directed,
}


def run_of(law: str, seed: int) -> tuple[Run, float, float]:
    """A record behind a law, its gain between the values visited, and its time constant."""
    rng = np.random.default_rng([seed, 13, list(LAWS).index(law)])
    kind, half = rng.choice(list(INPUTS)), 10 ** rng.uniform(-1.8, -0.1)
    u, tau = INPUTS[kind](rng), rng.choice([0.3, 1.5, 3.0, 8.0])
    moves, kept = LAWS[law](u, half), np.exp(-APART / tau)
    y = lfilter([0.0, GAIN * (1 - kept)], [1.0, -kept], moves - moves[0]) + GAIN * moves[0]
    noise, fresh = rng.choice([0.003, 0.01, 0.03, 0.1, 0.3]), rng.normal(size=COUNT)
    if rng.random() < 0.5:
        fresh = lfilter([np.sqrt(1 - 0.81)], [1.0, -0.9], fresh)
    gain = GAIN * (np.ptp(moves[COUNT // 3 :]) / np.ptp(u) if kind == "two values" else 1.0)
    return Run(APART * AT, {"u": u}, {"y": y + noise * y.std() * fresh}), gain, float(tau)


def main() -> None:
    """Print a row for each law."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 30
    table = Table("law", "verdicts", "K > 3 errors off", "tau > 3 errors off", "largest pulls")
    for law in LAWS:
        pulls, said = [], Counter()
        for seed in range(count):
            run, *truth = run_of(law, seed)
            fit = identify(run)
            said[str(fit.status)] += 1
            if fit.status.value == "converged":
                each = zip((fit.quantities[n] for n in ("K", "tau")), truth, strict=True)
                pulls.append([abs(q.value - true) / q.error for q, true in each])
        wrong, most = np.sum(np.array(pulls) > 3, axis=0), np.max(pulls, axis=0)
        table.add_row(
            law, str(dict(said)), *map(str, wrong), " and ".join(f"{m:.1f}" for m in most)
        )
    Console(width=160).print(table)


if __name__ == "__main__":
    main()
