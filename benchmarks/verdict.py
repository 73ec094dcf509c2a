"""How often the verdict is wrong: noise called an emittance, truth called undetermined.

Prints the table of docs/verdict.md. `python benchmarks/verdict.py [draws]`, 400 by default.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

import beamfit
from beamfit.optics.beam import BeamMatrix
from beamfit.optics.elements import Drift, Quadrupole, Screen

LATTICES = Path(__file__).resolve().parents[1] / "lattices"
GTF, OTR2 = (beamfit.load_lattice(LATTICES / f"{n}.toml") for n in ("gtf", "lcls_otr2"))
SCANS = {
    "GTF, 14 currents": (GTF, "Q2", "A", np.linspace(0.0, 3.9, 14)),
    "OTR2, 9 gradients": (OTR2, "Q525", "kG", np.linspace(-6.0, 0.0, 9)),
    "OTR2, the real 5": (OTR2, "Q525", "kG", np.array([-4.219, -3.153, -2.64, -2.124, -1.026])),
}
NOISE = {
    "uniform 50-200 um": lambda rng, n: rng.uniform(50, 200, n),
    "100 um +- 30 %": lambda rng, n: np.abs(100 + 30 * rng.normal(size=n)) + 5,
    "100 um +- 10 %": lambda rng, n: 100 + 10 * rng.normal(size=n),
    "100 um +- 2 %": lambda rng, n: 100 + 2 * rng.normal(size=n),
}
# Scans of a beam of 1 um (normalised), ever further from the waist.
RANGES = {
    "both sides": (-4.5, -1.0),
    "mostly one side": (-5.0, -2.6),
    "one side": (-8.0, -4.2),
}
BEAM = BeamMatrix.from_twiss(1e-6 / 264.1865, 5.5, 5.3)  # matched as in the real scan
COUNTS = (3, 4, 5, 6, 8, 12, 30)
# What a file says of errors that are a share r of the size.
STATED = {
    "given": lambda r: r,
    "none": lambda r: None,
    "half of the truth": lambda r: 0.5 * r,
    "twice the truth": lambda r: 2.0 * r,
}
WIRES = (0.0, 1.0, 2.0, 3.0)  # m, about 45 degrees apart


def called(fit) -> bool:
    """Whether the emittance was given an error."""
    return fit.emittance.error is not None


def noise_table(draws: int) -> None:
    """Share of noise scans, with and without quoted errors, that came out as an answer."""
    print(f"{'noise called an emittance':24s}" + "".join(f"{k:>20s}" for k in NOISE))
    for name, (line, magnet, unit, settings) in SCANS.items():
        cells = []
        for make in NOISE.values():
            rng, wrong = np.random.default_rng(1), 0
            for i in range(draws):
                size = 1e-6 * make(rng, len(settings))
                error = {"x": 0.02 * size} if i % 2 else {}
                scan = beamfit.QuadScan({magnet: settings}, {magnet: unit}, {"x": size}, error)
                wrong += called(beamfit.fit_emittance(scan, line).x)
            cells.append(f"{100 * wrong / draws:.2f} %")
        print(f"{name:24s}" + "".join(f"{c:>20s}" for c in cells), flush=True)


def true_sizes(line, settings, plane="x"):
    """Sizes of BEAM in m."""
    return np.array(
        [float(BEAM.transport(getattr(line.matrix({"Q525": q}), plane)).l11) for q in settings]
    )


def wires():
    """Four wires in a drift around a waist, and the sizes there."""
    parts = [Quadrupole("Q", 0.1)]
    for i, gap in enumerate(np.diff([0.0, *WIRES]), start=1):
        parts += [Drift(f"D{i}", max(gap, 1e-6)), Screen(f"W{i}")]
    line = beamfit.Beamline(tuple(parts), 135.0)
    emittance, beta = 1e-6 / 264.1865, 1.5
    places = np.array(WIRES) + 0.1
    sizes = np.sqrt(emittance * (beta + (places - places.mean()) ** 2 / beta))
    return line, sizes


def scan_of(settings, true, relative, stated, rng):
    """One simulated scan of OTR2."""
    size = true * (1 + relative * rng.normal(size=len(true)))
    error = {} if stated is None else {"x": stated * size}
    return beamfit.QuadScan({"Q525": settings}, {"Q525": "kG"}, {"x": size}, error)


def wire_scan(line, true, relative, rng):
    """One simulated measurement with four wires, errors given."""
    size = true * (1 + relative * rng.normal(size=4))
    names = tuple(f"W{i}" for i in (1, 2, 3, 4))
    return beamfit.QuadScan(
        {"Q": np.zeros(4)}, {"Q": "k1"}, {"x": size}, {"x": relative * size}, screen=names
    )


def row(words, fits, truth=1e-6):
    """Answered, covered by interval_95, beyond 4 errors of the answers given, and their bias."""
    given = [f.normalized_emittance for f in fits if called(f)]
    share = len(given) / len(fits)
    limits = [f.normalized_emittance.interval_95 for f in fits if not called(f)]
    limits = [interval[1] for interval in limits if interval is not None]
    below = f"{100 * np.mean([truth < limit for limit in limits]):5.0f} %" if limits else "    -  "
    poor = np.mean([f.status.value == "poor_fit" for f in fits])
    if not given:
        print(
            f"{words:44s}{100 * share:7.1f} %" + 3 * f"{'-':>9s}" + f"{100 * poor:7.1f} %  {below}"
        )
        return
    inside = np.mean([q.interval_95[0] <= truth <= q.interval_95[1] for q in given])
    wild = np.mean([abs(q.value - truth) > 4 * q.error for q in given])
    bias = np.mean([q.value for q in given]) / truth - 1
    print(
        f"{words:44s}{100 * share:7.1f} %{100 * inside:7.1f} %{100 * wild:7.2f} %"
        f"{100 * bias:+7.1f} %{100 * poor:7.1f} %  {below}",
        flush=True,
    )


def answers_table(draws: int, relatives=(0.02, 0.05, 0.1)) -> None:
    """Of true scans: share answered, and how the answers given cover."""
    head = ("answered", "covered", "> 4 err", "bias", "poor", "limit holds")
    print(f"\n{'true scans':44s}" + "".join(f"{h:>9s}" for h in head))
    for said, stated in STATED.items():
        for n in COUNTS:
            settings = np.linspace(-4.5, -1.0, n)
            true = true_sizes(OTR2, settings)
            for r in relatives:
                rng = np.random.default_rng(n)
                scans = [scan_of(settings, true, r, stated(r), rng) for _ in range(draws)]
                fits = [beamfit.fit_emittance(scan, OTR2).x for scan in scans]
                row(f"{n} points, noise {100 * r:g} %, errors {said}", fits)
    line, true = wires()
    for r in relatives:
        rng = np.random.default_rng(4)
        scans = [wire_scan(line, true, r, rng) for _ in range(draws)]
        row(f"4 wires, noise {100 * r:g} %", [beamfit.fit_emittance(s, line).x for s in scans])


def truth_table(draws: int) -> None:
    """For true scans: share that is answered, and the worst answer in its own errors."""
    print(
        f"\n{'true scans of 8 points':24s}{'size error':>12s}{'answered':>12s}{'worst pull':>12s}"
    )
    for name, (low, high) in RANGES.items():
        settings = np.linspace(low, high, 8)
        true = true_sizes(OTR2, settings)
        for relative in (0.01, 0.05):
            rng, pulls = np.random.default_rng(2), []
            for _ in range(draws):
                size = true * (1 + relative * rng.normal(size=8))
                scan = beamfit.QuadScan(
                    {"Q525": settings}, {"Q525": "kG"}, {"x": size}, {"x": relative * true}
                )
                fit = beamfit.fit_emittance(scan, OTR2).x
                if called(fit):
                    e = fit.normalized_emittance
                    pulls.append(abs(e.value - 1e-6) / e.error)
            worst = f"{max(pulls):.1f}" if pulls else "-"
            share = f"{100 * len(pulls) / draws:.1f} %"
            print(f"{name:24s}{f'{100 * relative:g} %':>12s}{share:>12s}{worst:>12s}", flush=True)


if __name__ == "__main__":
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 400
    noise_table(count)
    truth_table(count)
    answers_table(count)
