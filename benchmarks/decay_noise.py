"""Do the errors of a lifetime hold where the noise has a memory? python benchmarks/decay_noise.py

SIMULATED decays of 8 h with noise that is autoregressive of first order. Printed: percent of
truths within 1 and within 1.96 quoted errors, and within the 95 % interval, for a, b and three
lifetimes, of the records that give an answer.
"""

from __future__ import annotations

import argparse

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.signal import lfilter

from beamfit.studies.decay.fit import DecayFit, fit_decays
from beamfit.studies.decay.record import DecayRecord

HOUR, SPAN = 3600.0, 8 * 3600.0
I0, A, B = 500.0, 4e-8, 2e-6
NAMES = ("a", "b", "lifetime_start", "lifetime_mean", "lifetime_end")


def law(time: np.ndarray) -> np.ndarray:
    """Report equation 44 in plain numpy."""
    return I0 * np.exp(-B * time) / (1 + A / B * I0 * -np.expm1(-B * time))


def autoregressive(rng: np.random.Generator, count: int, correlation: float) -> np.ndarray:
    """Noise of size 1, from before the record on."""
    before = int(20 / (1 - correlation))
    fresh = np.sqrt(1 - correlation**2) * rng.normal(size=count + before)
    return lfilter([1.0], [1.0, -correlation], fresh)[-count:]


def truths(time: np.ndarray) -> np.ndarray:
    """Of `NAMES`."""
    beam = law(time)
    levels = np.array([beam[0], beam.mean(), beam[-1]])
    return np.array([A, B, *(1 / (A * levels + B) / HOUR)])


def simulated(
    count: int, correlation: float, trials: int, noise: float = 0.02, seed: int = 0
) -> list[DecayRecord]:
    """Records that differ in their noise alone."""
    rng = np.random.default_rng([seed, count, int(1000 * correlation)])
    time = np.linspace(0, SPAN, count)
    return [
        DecayRecord(time, law(time) + noise * autoregressive(rng, count, correlation))
        for _ in range(trials)
    ]


def cover(fits: list[DecayFit], time: np.ndarray) -> np.ndarray:
    """Shares within 1 and 1.96 errors and within the interval, shape (3, names)."""
    told = [fit for fit in fits if fit.status == "converged"]
    found = []
    for name, true in zip(NAMES, truths(time), strict=True):
        quantities = [getattr(fit, name) for fit in told]
        off = np.array([abs(q.value - true) / q.error for q in quantities])
        inside = [q.interval_95[0] <= true <= q.interval_95[1] for q in quantities]
        found.append([np.mean(off < 1), np.mean(off < 1.96), np.mean(inside)])
    return np.array(found).T


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=300)
    parser.add_argument("--counts", type=int, nargs="+", default=[100, 1000, 10_000])
    asked = parser.parse_args()
    table = Table("readings", "correlation", "answered", *NAMES)
    for count in asked.counts:
        time = np.linspace(0, SPAN, count)
        for correlation in (0.0, 0.1, 0.3, 0.6, 0.9, 0.95, 0.97):
            fits = list(fit_decays(simulated(count, correlation, asked.trials)))
            answered = np.mean([fit.status == "converged" for fit in fits])
            shares = 100 * cover(fits, time)
            cells = [f"{one:.0f} / {two:.0f} / {three:.0f}" for one, two, three in shares.T]
            table.add_row(str(count), f"{correlation:g}", f"{100 * answered:.0f} %", *cells)
    Console(width=140).print(table)


if __name__ == "__main__":
    main()
