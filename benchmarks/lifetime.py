"""Lifetime against its peers, side by side: python benchmarks/lifetime.py [--whole | --large]

Touschek lifetime against pyAT on the SPEAR3 2003 ring (on every 40th slice, the time scaled to the
ring; --whole runs pyAT on all, for minutes), the (I0, a, b) fit against
scipy.optimize.curve_fit, and a thousand random records.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import at
import h5py
import jax
import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.optimize import curve_fit

from beamfit.io.ring import ring_from_pyat
from beamfit.lifetime.expansion import Pieces, fit_law
from beamfit.lifetime.fit import fit_decay, fit_decays
from beamfit.lifetime.mechanisms import piwinski_rate
from beamfit.lifetime.record import DecayRecord
from beamfit.lifetime.ring import population

sys.path.insert(0, str(Path(__file__).parent))
import spear3_lattice

HOUR = 3600.0


def seconds(function: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Median and smallest time of a warm call."""
    function()
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        function()
        times.append(time.perf_counter() - begin)
    return float(np.median(times)), min(times)


def law(t, i0, a, b):
    """Report equation 44 in plain numpy, a in 1e-8/(mA s) and b in 1e-6/s for curve_fit."""
    a, b = a * 1e-8, b * 1e-6
    return i0 * np.exp(-b * t) / (1 + a / b * i0 * -np.expm1(-b * t))


def touschek(table: Table, every: int) -> None:
    lattice = spear3_lattice.build(0.09)
    ring = ring_from_pyat(lattice, coupling=0.002)
    electrons, length = population(ring, 500 / 280), 4.971812e-3
    ours, least = seconds(
        lambda: piwinski_rate(ring, electrons, length, 0.03).block_until_ready(), 30
    )
    flat = lattice.disable_6d(copy=True)
    points = np.flatnonzero([element.Length > 0 for element in flat])[::every]
    momenta = np.tile([0.03, -0.03], (points.size, 1))
    beam = {"emitx": ring.emittance_x, "sigs": length, "sigp": ring.energy_spread}
    begin = time.perf_counter()
    peer, _, _ = at.get_lifetime(
        flat, ring.emittance_y, 0.5 / 280, momap=momenta, refpts=points, interpolate=False, **beam
    )
    theirs = (time.perf_counter() - begin) * every
    # The same points and weights for the comparison of values.
    weight = np.zeros(ring.optics.weight.size)
    weight[::every] = ring.optics.weight[::every]
    thinned = ring._replace(optics=ring.optics._replace(weight=weight / weight.sum()))
    value = 1 / float(piwinski_rate(thinned, electrons, length, 0.03))
    table.add_row(
        f"Touschek, {ring.optics.weight.size} slices",
        f"{1e3 * ours:.1f} ms (least {1e3 * least:.1f})",
        f"{theirs:.1f} s" + (" (scaled)" if every > 1 else ""),
        f"{theirs / ours:.0f}",
        f"{value / HOUR:.4f} h, relative difference {value / peer - 1:.1e}",
    )


def fit(table: Table) -> None:
    t = np.linspace(0, 8 * HOUR, 1000)
    noise = 1e-3 * np.random.default_rng(1).normal(size=1000)
    measured = law(t, 500.0, 2.0, 1.0) + noise
    record = DecayRecord(t, measured, np.full(1000, 1e-3))
    ours, least = seconds(lambda: fit_law(Pieces.of(record)), 300)
    whole, whole_least = seconds(lambda: fit_decay(record), 300)
    peer, _ = seconds(lambda: curve_fit(law, t, measured, [490, 5, 5], record.error, True), 20)
    best, _ = curve_fit(law, t, measured, [490, 5, 5], record.error, True)
    found = fit_decay(record, law="constant").a
    off = abs(found.value * 1e8 - best[1]) / (found.error * 1e8)
    for name, median, smallest in (
        ("1000-point solve", ours, least),
        ("1000-point fit with verdict", whole, whole_least),
    ):
        table.add_row(
            name,
            f"{1e3 * median:.2f} ms (least {1e3 * smallest:.2f})",
            f"{1e3 * peer:.2f} ms",
            f"{peer / median:.1f}",
            f"a differs by {off:.3f} errors",
        )


def random_records(table: Table) -> None:
    rng = np.random.default_rng(7)
    records, starts = [], []
    for k in range(1000):
        lifetime, share = 10 ** rng.uniform(0, 2.3) * HOUR, rng.uniform()
        i0, noise = 10 ** rng.uniform(0, 2.8), 10 ** rng.uniform(-4, -1)
        span = 60.0 if k % 4 == 0 else 10 ** rng.uniform(1.7, np.log10(3 * lifetime))
        t = np.linspace(0, span, 1000)
        exact = law(t, i0, 1e8 * share / lifetime / i0, 1e6 * (1 - share) / lifetime)
        measured = np.abs(exact + noise * rng.normal(size=1000))
        records.append(DecayRecord(t, measured, np.full(1000, noise)))
        starts.append((measured[0], 5e7 / lifetime / i0, 5e5 / lifetime))
    together, _ = seconds(lambda: fit_decays(records), 1)
    statuses = Counter(result.status.value for result in fit_decays(records))
    begin, failed = time.perf_counter(), 0
    for record, start in zip(records, starts, strict=True):
        try:
            with np.errstate(all="ignore"):
                _, covariance = curve_fit(
                    law, record.time, record.current, start, record.error, True
                )
            failed += not np.isfinite(covariance).all()
        except RuntimeError:
            failed += 1
    peer = time.perf_counter() - begin
    table.add_row(
        "1000 random records, 250 of 60 s",
        f"{together:.2f} s together",
        f"{peer:.2f} s",
        f"{peer / together:.1f}",
        f"failed: {statuses['not_finite']}, curve_fit: {failed}; {dict(statuses)}",
    )


def ten_million() -> None:
    """`beamfit lifetime FILE --json` of 10 million readings, of one decay and of top-up at 1 Hz:
    seconds and the most memory.
    """
    rng = np.random.default_rng(1)
    time_s = np.arange(10_000_000) * 0.01
    current = 500 / (1 + time_s / 36000) + 0.02 * rng.normal(size=time_s.size)
    since = np.arange(10_000_000) % 300
    refilled = 500 / (1 + since / 36000) + 0.005 * rng.normal(size=time_s.size)
    call = [sys.executable, "-c", "from beamfit.cli import main; main()", "lifetime"]
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / name for name in ("decay.csv", "decay.h5", "top_up.h5")]
        with paths[0].open("w") as stream:
            stream.write("time_s,beam_current_mA\n")
            for rows in np.array_split(np.column_stack([time_s, current]), 100):
                np.savetxt(stream, rows, fmt="%.2f,%.4f")
        with h5py.File(paths[1], "w") as store:
            store["time_s"], store["beam_current_mA"] = time_s, current
        with h5py.File(paths[2], "w") as store:
            store["time_s"], store["beam_current_mA"] = 100 * time_s, refilled
        for path in paths:
            begin = time.perf_counter()
            subprocess.run([*call, str(path), "--json"], check=True, stdout=subprocess.DEVNULL)
            most = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
            took = time.perf_counter() - begin
            print(f"{path.name}: {took:.1f} s, at most {most:.0f} MB (the largest so far)")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--whole", action="store_true", help="run pyAT on every slice")
    parser.add_argument("--large", action="store_true", help="10 million readings from files")
    asked = parser.parse_args()
    if asked.large:
        ten_million()
        return
    every = 1 if asked.whole else 40
    table = Table(
        "what", "beamfit", "peer", "ratio", "result", title=f"jax {jax.__version__}, warm"
    )
    touschek(table, every)
    fit(table)
    random_records(table)
    Console(width=180).print(table)


if __name__ == "__main__":
    main()
