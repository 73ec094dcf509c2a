"""Do a response's errors hold where noise has a memory? python benchmarks/response_noise.py

SIMULATED runs of a first order (K = 2, tau = 3 s, 300 samples of 0.5 s, valve steps every 8), by
the kind of noise, 0.1 of the output's scatter but for the drifts. Printed: percent of truths within
1 and 1.96 quoted errors, of the runs that give the error, and how many do.
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

COUNT, APART, TRUTH = 300, 0.5, {"K": 2.0, "tau": 3.0}


def autoregressive(share: float, fresh: np.ndarray) -> np.ndarray:
    """Noise of size 1 from the first sample on."""
    fresh = np.append(fresh[:1], np.sqrt(1 - share**2) * fresh[1:])
    return lfilter([1.0], [1.0, -share], fresh)


KINDS = {
    "white": lambda rng, n: rng.normal(size=n),
    "autoregressive, 0.6": lambda rng, n: autoregressive(0.6, rng.normal(size=n)),
    "autoregressive, 0.95": lambda rng, n: autoregressive(0.95, rng.normal(size=n)),
    "random walk and white": lambda rng, n: (
        rng.normal(size=n) + 0.3 * np.cumsum(rng.normal(size=n))
    ),
    "slow sine and white": lambda rng, n: (
        rng.normal(size=n)
        + 3 * np.sin(2 * np.pi * (np.arange(n) / n * rng.uniform(0.5, 2) + rng.uniform()))
    ),
}


def run_of(kind: str, seed: int) -> Run:
    """A run with noise of a kind."""
    rng = np.random.default_rng([seed, 7])
    valve = np.repeat(rng.uniform(0.1, 2.9, COUNT // 8 + 1), 8)[:COUNT]
    kept = np.exp(-APART / TRUTH["tau"])
    level = lfilter([0.0, TRUTH["K"] * (1 - kept)], [1.0, -kept], valve)
    level = level + 0.1 * level.std() * KINDS[kind](rng, COUNT)
    return Run(APART * np.arange(COUNT), {"valve": valve}, {"level": level})


def main() -> None:
    """Print the table."""
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    table = Table(
        "noise",
        *(f"{name}: 1 / 1.96 (given)" for name in TRUTH),
        "median error",
        "status",
    )
    for kind in KINDS:
        fits = [identify(run_of(kind, seed), delay=0) for seed in range(seeds)]
        cells = []
        for name, true in TRUTH.items():
            found = [q for fit in fits if (q := fit.quantities[name]).error is not None]
            off = np.array([abs(q.value - true) / q.error for q in found])
            shares = (np.mean(off < 1), np.mean(off < 1.96))
            cells.append(" / ".join(f"{100 * s:.0f}" for s in shares) + f" ({len(found)})")
        errors = [np.median([q.error for f in fits if (q := f.quantities[n]).error]) for n in TRUTH]
        said = Counter(str(fit.status) for fit in fits)
        table.add_row(kind, *cells, ", ".join(f"{e:.2g}" for e in errors), str(dict(said)))
    Console(width=160).print(table)


if __name__ == "__main__":
    main()
