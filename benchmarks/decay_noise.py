"""Do the errors of a lifetime hold where the noise has a memory? python benchmarks/decay_noise.py

SIMULATED decays of 8 h with noise that is autoregressive of first order. Printed: percent of
truths within 1 and within 1.96 quoted errors, and within the 95 % interval, for a, b and three
lifetimes, of the records that give an answer; with --white there is white noise as large beside
it, as of a monitor that drifts and is read with noise. With --top-up the same for the lifetime at
the mean current of ten hours of top-up at 500 mA and 10.01 h, in cycles of three minutes, from the
record.
"""

from __future__ import annotations

import argparse

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.signal import lfilter

from beamfit.lifetime.fit import DecayFit, fit_decays
from beamfit.lifetime.record import DecayRecord
from beamfit.lifetime.study import study_record

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
    count: int, correlation: float, trials: int, white: float = 0.0, seed: int = 0
) -> list[DecayRecord]:
    """Records that differ in their noise alone, 20 µA and so many times that of white noise."""
    rng = np.random.default_rng([seed, count, int(1000 * correlation)])
    time, noise = np.linspace(0, SPAN, count), 0.02
    off = [autoregressive(rng, count, correlation) for _ in range(trials)]
    off = [part + white * rng.normal(size=count) for part in off] if white else off
    return [DecayRecord(time, law(time) + noise * part) for part in off]


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


def top_up(
    readings: int, correlation: float, noise: float, seed: int, white: float = 0.0
) -> tuple[float, bool, float]:
    """Pull of the pooled lifetime, whether its interval holds the truth, and its relative error."""
    rng = np.random.default_rng([seed, readings, int(1000 * correlation)])
    a, cycle, cycles = 3.3e-8, 180.0, 200
    b = 1 / (10.01 * HOUR) - a * I0
    time = np.arange(cycles * readings) * cycle / readings
    number = (time // cycle).astype(int)
    since, start = time - cycle * number, I0 * (1 + 5e-4 * rng.normal(size=cycles))[number]
    beam = start * np.exp(-b * since) / (1 + a / b * start * -np.expm1(-b * since))
    beam = beam + noise * autoregressive(rng, time.size, correlation)
    beam = beam + white * noise * rng.normal(size=time.size) if white else beam
    fit = study_record(DecayRecord(time, beam)).pooled[0].fit
    found, true = fit.lifetime_mean, 1 / (a * fit.mean_current + b) / HOUR
    inside = found.interval_95[0] <= true <= found.interval_95[1]
    return (found.value - true) / found.error, inside, found.relative


def of_top_up(trials: int, white: float) -> Table:
    table = Table("readings a cycle", "correlation", "noise", "within 1 / 1.96 / interval", "error")
    for readings in (6, 18, 180):
        for correlation in (0.9, 0.97, 0.99) if white else (0.0, 0.6, 0.95):
            for noise in (0.001, 0.05):
                found = [top_up(readings, correlation, noise, k, white) for k in range(trials)]
                pulls, inside, error = map(np.array, zip(*found, strict=True))
                shares = [np.mean(abs(pulls) < 1), np.mean(abs(pulls) < 1.96), inside.mean()]
                cells = " / ".join(f"{100 * share:.0f}" for share in shares)
                row = str(readings), f"{correlation:g}", f"{1e3 * noise:g} µA", cells
                table.add_row(*row, f"{100 * np.median(error):.2g} %")
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=300)
    parser.add_argument("--counts", type=int, nargs="+", default=[100, 1000, 10_000])
    parser.add_argument("--white", action="store_true")
    parser.add_argument("--top-up", action="store_true")
    asked = parser.parse_args()
    if asked.top_up:
        Console(width=140).print(of_top_up(asked.trials, float(asked.white)))
        return
    table = Table("readings", "correlation", "answered", *NAMES)
    for count in asked.counts:
        time = np.linspace(0, SPAN, count)
        for correlation in (0.0, 0.1, 0.3, 0.6, 0.9, 0.95, 0.97):
            given = simulated(count, correlation, asked.trials, float(asked.white))
            fits = list(fit_decays(given))
            answered = np.mean([fit.status == "converged" for fit in fits])
            shares = 100 * cover(fits, time)
            cells = [f"{one:.0f} / {two:.0f} / {three:.0f}" for one, two, three in shares.T]
            table.add_row(str(count), f"{correlation:g}", f"{100 * answered:.0f} %", *cells)
    Console(width=140).print(table)


if __name__ == "__main__":
    main()
