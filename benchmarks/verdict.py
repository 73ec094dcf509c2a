"""How often the verdict is wrong: noise called an emittance, truth called undetermined.

Prints the table of docs/verdict.md. `python benchmarks/verdict.py [draws]`, 400 by default.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

import beamfit
from beamfit.optics.beam import BeamMatrix

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
# Start-of-line beams (normalised emittance 1 um) and scans ever further from the waist.
RANGES = {
    "both sides": (-4.5, -1.0),
    "mostly one side": (-5.0, -2.6),
    "one side": (-8.0, -4.2),
}


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


def truth_table(draws: int) -> None:
    """For true scans: share that is answered, and the worst answer in its own errors."""
    beam = BeamMatrix.from_twiss(1e-6 / 264.1865, 5.5, 5.3)  # matched as in the real scan
    print(
        f"\n{'true scans of 8 points':24s}{'size error':>12s}{'answered':>12s}{'worst pull':>12s}"
    )
    for name, (low, high) in RANGES.items():
        settings = np.linspace(low, high, 8)
        true = np.array([float(beam.transport(OTR2.matrix({"Q525": q}).x).l11) for q in settings])
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
