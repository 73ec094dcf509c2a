"""Emittance fits timed beside pyemittance 1.1.4 on the same scans in the same run.

Run with `make bench`, or `python benchmarks/emittance.py` where pyemittance is installed. The
figures are ratios: both programs run on this machine, now. With BEAMFIT_BEFORE=/path/to/another/
checkout, long lines, one more point and the warm fit are also timed there and set in proportion.
"""

from __future__ import annotations

import logging
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

import beamfit

ROOT = Path(__file__).resolve().parents[1]
SCAN, LATTICE = ROOT / "measurements/lcls_otr2.csv", ROOT / "lattices/lcls_otr2.toml"
MANY = 10_000
BEFORE = os.environ.get("BEAMFIT_BEFORE")
LENGTHS = (300, 1000, 5000)
# One process: the command with nothing compiled before; its peak memory in MB goes to stderr.
COLD = """
import resource, sys
from beamfit.cli import main
try:
    main()
finally:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"peak {peak}", file=sys.stderr)
"""
# One process: milliseconds of a fit that is warm, and of the first with one point more.
WARM = """
import sys, time, statistics, beamfit
scan, line = beamfit.read_quad_scan(sys.argv[1]), beamfit.load_lattice(sys.argv[2])
def part(n):
    return beamfit.QuadScan(
        {k: v[:n] for k, v in scan.settings.items()}, dict(scan.units),
        {p: v[:n] for p, v in scan.size.items()}, {p: v[:n] for p, v in scan.error.items()})
def timed(n):
    few, start = part(n), time.perf_counter()
    beamfit.fit_emittance(few, line)
    return 1e3 * (time.perf_counter() - start)
n = len(scan) - 1
timed(n)
print(statistics.median(timed(n) for _ in range(50)), timed(n + 1))
"""


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
    checkouts = [str(ROOT), *([BEFORE] if BEFORE else [])]
    print()
    row("", "here", *(["before", "ratio"] if BEFORE else []))
    beside("warm fit, ms", "and with one more point, ms", found=[warm(c) for c in checkouts])
    with tempfile.TemporaryDirectory() as folder:
        for count in LENGTHS:
            files = long_line(Path(folder), count)
            found = [one_cold(c, *files) for c in checkouts]
            beside(f"{count} elements, cold, s", f"{count} elements, peak MB", found=found)


def beside(*names: str, found: list[tuple[float, ...]]) -> None:
    """Print what was found here and, where there is one, in the checkout from before."""
    for name, *cells in zip(names, *found, strict=True):
        row(name, *cells, *([cells[1] / cells[0]] if len(cells) > 1 else []))


def long_line(folder: Path, count: int) -> tuple[str, str]:
    """Write a line of FODO cells with the LCLS scan's magnet and screen after it, and the scan."""
    cell = [("quadrupole", 0.1, 3.0), ("drift", 0.4, 0.0), ("quadrupole", 0.1, -3.0)]
    cell.append(cell[1])
    text = ['format = "beamfit-lattice-1"', "energy_MeV = 135.0"]
    for i in range(count - 3):
        kind, length, k1 = cell[i % 4]
        text += ["[[element]]", f'type = "{kind}"', f'name = "E{i}"', f"length_m = {length}"]
        text += [f"k1_per_m2 = {k1}"] if k1 else []
    text += ["[[element]]", 'type = "quadrupole"', 'name = "Q525"', "length_m = 0.108"]
    text += ["integrated_gradient_kG = -3.0"]
    text += ["[[element]]", 'type = "drift"', "length_m = 2.2094"]
    text += ["[[element]]", 'type = "screen"', 'name = "OTR2"']
    lattice = folder / f"line{count}.toml"
    lattice.write_text("\n".join(text) + "\n")
    return str(SCAN), str(lattice)


def one_cold(checkout: str, scan: str, lattice: str) -> tuple[float, float]:
    """Seconds and peak memory in MB of a whole command with nothing compiled before."""
    env = os.environ | {"JAX_ENABLE_COMPILATION_CACHE": "false", "PYTHONPATH": checkout}
    command = [sys.executable, "-c", COLD, "emittance", scan, "--lattice", lattice]
    start = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, env=env)
    seconds = time.perf_counter() - start
    return seconds, float(done.stderr.rsplit("peak ", 1)[1])


def warm(checkout: str) -> tuple[float, float]:
    """Milliseconds of a warm fit, and of the first fit of a scan with one more point."""
    command = [sys.executable, "-c", WARM, str(SCAN), str(LATTICE)]
    env = os.environ | {"PYTHONPATH": checkout}
    done = subprocess.run(command, capture_output=True, text=True, env=env, check=True)
    each, more = map(float, done.stdout.split())
    return each, more


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
