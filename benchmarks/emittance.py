"""Emittance fits timed beside pyemittance 1.1.4 on the same scans in the same run.

Run with `make bench`, or `python benchmarks/emittance.py` where pyemittance is installed. The
figures are ratios: both programs run on this machine, now.
"""

from __future__ import annotations

import logging
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

import beamfit

ROOT = Path(__file__).resolve().parents[1]
SCAN, LATTICE = ROOT / "measurements/lcls_otr2.csv", ROOT / "lattices/lcls_otr2.toml"
MANY = 10_000


def median_time(work, repeats: int) -> float:
    """Median seconds of one call, after one that is not counted."""
    work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def peer(kg: np.ndarray, sizes: np.ndarray, errors: np.ndarray):
    """One fit of the x plane by pyemittance, as its EmitCalc does it, for the same line."""
    import pyemittance.optics as optics

    logging.disable(logging.CRITICAL)
    energy, length = 135e6, 0.108
    drift = np.array([[1.0, 2.2094], [0.0, 1.0]])
    strength = optics.kL_from_machine_value(kg, energy, length)

    def fit(size: np.ndarray = sizes, error: np.ndarray = errors) -> dict:
        return optics.estimate_sigma_mat_thick_quad(
            size,
            strength,
            error,
            1.0 / (2.0 * size * error),
            dim="x",
            Lquad=length,
            energy=energy,
            rmats=(drift, drift),
            plot=False,
        )

    return fit


def row(name: str, *cells: float | str) -> None:
    """Print one line of the table."""
    shown = [c if isinstance(c, str) else f"{c:.1f}" for c in cells]
    print(f"{name:44s}" + "".join(f"{c:>14s}" for c in shown))


def main() -> None:
    """Print the table."""
    scan, line = beamfit.read_quad_scan(SCAN), beamfit.load_lattice(LATTICE)
    kg, size, error = scan.settings["Q525"], scan.size["x"], scan.error["x"]
    x_only = beamfit.QuadScan({"Q525": kg}, {"Q525": "kG"}, {"x": size}, {"x": error})
    points = beamfit.fit_emittance(x_only, line).x.points
    noise = np.random.default_rng(0).normal(size=(MANY, len(kg)))
    sizes, errors = size * (1 + 0.01 * noise), np.broadcast_to(error, (MANY, len(kg)))
    theirs = peer(kg, size, error)

    def kernel() -> None:
        beamfit.fit_sizes(points.r11, points.r12, size, error).covariance.block_until_ready()

    def many() -> None:
        beamfit.fit_sizes(points.r11, points.r12, sizes, errors).covariance.block_until_ready()

    def their_many() -> None:
        for one_size, one_error in zip(sizes[:500], errors[:500], strict=True):
            theirs(one_size, one_error)

    one, judged = (
        median_time(kernel, 200),
        median_time(lambda: beamfit.fit_emittance(x_only, line), 100),
    )
    each, their_one = median_time(many, 9) / MANY, median_time(theirs, 200)
    their_each = median_time(their_many, 5) / 500
    check = theirs()["norm_emit_x"] * 1e6
    mine = beamfit.fit_emittance(x_only, line).x.normalized_emittance.value * 1e6
    print(f"same answer: beamfit {mine:.5f} um, pyemittance {check:.5f} um")
    row("", "beamfit", "pyemittance", "ratio")
    row("one fit with covariance, us", 1e6 * one, 1e6 * their_one, their_one / one)
    row("one fit with verdict, Twiss and errors, us", 1e6 * judged, "-", "-")
    row("10 000 scans, us each", 1e6 * each, 1e6 * their_each, their_each / each)
    cold()


def cold() -> None:
    """Time whole commands: help, a bad file, the fit, a script, importing JAX alone."""
    run = [sys.executable, "-c", "from beamfit.cli import main; main()"]
    fit = [*run, "emittance", str(SCAN), "--lattice", str(LATTICE)]
    script = f"""import beamfit
line = beamfit.load_lattice({str(LATTICE)!r})
print(beamfit.fit_emittance(beamfit.read_quad_scan({str(SCAN)!r}), line))"""
    commands = {
        "python -c 'import jax, scipy.optimize'": [
            sys.executable,
            "-c",
            "import jax, scipy.optimize",
        ],
        "beamfit --help": [*run, "--help"],
        "beamfit emittance, missing file": [
            *run,
            "emittance",
            "none.csv",
            "--lattice",
            str(LATTICE),
        ],
        "a script with one fit, compile cache kept": [sys.executable, "-c", script],
        "beamfit emittance, compile cache kept": fit,
        "beamfit emittance, nothing compiled before": fit,
    }
    base = None
    for name, command in commands.items():
        env = dict(os.environ)
        if name.endswith("before"):
            env["JAX_ENABLE_COMPILATION_CACHE"] = "false"

        def call(command=command, env=env):
            return subprocess.run(command, capture_output=True, env=env)

        seconds = median_time(call, 5)
        base = base or seconds
        print(f"{name:44s}{seconds:11.2f} s{seconds / base:12.2f} of the first")


if __name__ == "__main__":
    main()
