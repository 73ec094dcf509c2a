"""Points of a scan that chooses its settings, beside those of a uniform one for the same error.

    python benchmarks/scan.py [BEAMS]

SIMULATED: random beams in a line of a quadrupole and a drift, sizes of 5 shots with 3 % of noise;
both scans over the same limits. Written to docs/live_measured.md.
"""

from __future__ import annotations

import asyncio
import sys
import tempfile
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np

import beamfit
from beamfit.io.line import build_line
from beamfit.io.machine import ScanMachine, read_scan_machine
from beamfit.live.aims import MIN_POINTS, fit_of, sharp
from beamfit.live.devices import Connected, Left, Shots
from beamfit.live.points import MeasuredPoint
from beamfit.live.scan import scan

NOISE, SHOTS, MOST = 0.03, 5, 60
GOALS = (0.05, 0.03, 0.02)
LINE = """format = "beamfit-lattice-1"
energy_MeV = 135.0
[[element]]
type = "quadrupole"
name = "Q"
length_m = 0.108
gradient_T_per_m = 0.0
[[element]]
type = "drift"
length_m = 2.2
[[element]]
type = "screen"
name = "OTR"
"""
MACHINE = """format = "beamfit-machine-1"
lattice = "line.toml"
[[magnet]]
name = "Q"
set = "Q:SET"
read = "Q:READ"
unit = "T/m"
low = -8.0
high = 8.0
tolerance = 0.01
settle_s = 0.0
[screen]
x = "X"
y = "Y"
"""


class Beam(NamedTuple):
    """A beam at the start of the line: by plane emittance m, beta m, alpha."""

    planes: Mapping[str, tuple[float, float, float]]
    line: beamfit.Beamline

    def sizes(self, settings: Mapping[str, float]) -> dict[str, float]:
        matrix = self.line.matrix(settings)
        found = {}
        for plane, (emittance, beta, alpha) in self.planes.items():
            r11, r12 = (float(v) for v in np.asarray(getattr(matrix, plane))[0, :2])
            gamma = (1 + alpha**2) / beta
            squared = r11**2 * beta - 2 * r11 * r12 * alpha + r12**2 * gamma
            found[plane] = float(np.sqrt(emittance * squared))
        return found


class Simulated:
    """Magnet, screen and guard in one."""

    def __init__(self, beam: Beam, rng: np.random.Generator) -> None:
        self.beam, self.rng, self.setting = beam, rng, 0.0

    @property
    def settings(self) -> Mapping[str, float]:
        return {"Q": self.setting}

    async def put(self, value: float) -> None:
        self.setting = value

    async def get(self) -> float:
        return self.setting

    async def settled(self, value: float) -> float:
        return self.setting

    async def shots(self) -> Shots:
        sizes = self.beam.sizes(self.settings)
        noise = {p: 1 + NOISE * self.rng.standard_normal(SHOTS) for p in sizes}
        return Shots({p: s * noise[p] for p, s in sizes.items()}, 0.0)

    async def amiss(self) -> str:
        return ""

    @asynccontextmanager
    async def followed(self, value: float | None = None) -> AsyncIterator[Left]:
        async def left(time: float) -> str:
            return ""

        yield left


def a_beam(rng: np.random.Generator, line: beamfit.Beamline) -> Beam:
    """A beam whose waists lie within the limits, as of a scan that was thought about."""
    planes = {}
    for plane in ("x", "y"):
        emittance = 10 ** rng.uniform(-9.0, -8.0)
        planes[plane] = (emittance, rng.uniform(3.0, 12.0), rng.uniform(-2.0, 1.0))
    return Beam(planes, line)


def pulls(fit: beamfit.EmittanceFit, beam: Beam) -> list[float]:
    """By how many of its errors each emittance is off."""
    return [(p.emittance.value - beam.planes[p.plane][0]) / p.emittance.error for p in fit.planes]


def chosen(
    machine: ScanMachine, beam: Beam, seed: int, goal: float
) -> tuple[int, bool, list[float]]:
    """Points of a scan that chooses, whether it reached the goal, and how far off it is."""
    device = Simulated(beam, np.random.default_rng(seed))
    wanted = machine.__class__(**{**vars(machine), "goal": goal, "points": MOST})
    at = Connected({"Q": device}, device, device, wanted)
    with tempfile.TemporaryDirectory() as folder:
        found = asyncio.run(scan(at, beam.line, Path(folder) / "a.journal"))
    if found.problem:
        raise found.problem
    reached = sharp(found.fit, found.points, goal)
    return len(found.points), reached, pulls(found.fit, beam) if reached else []


def uniform(machine: ScanMachine, beam: Beam, seed: int, goal: float) -> int:
    """The fewest equally spaced settings whose scan reaches the goal."""
    magnet = machine.magnets[0]
    for count in range(MIN_POINTS, 10 * MOST):
        device, points = Simulated(beam, np.random.default_rng(seed + count)), []
        for setting in np.linspace(magnet.low, magnet.high, count):
            device.setting = float(setting)
            points.append(MeasuredPoint({"Q": device.setting}, *asyncio.run(device.shots())))
        if sharp(fit_of(points, machine, beam.line), points, goal):
            return count
    return 10 * MOST


def main(beams: int) -> None:
    folder = Path(tempfile.mkdtemp())
    (folder / "line.toml").write_text(LINE)
    (folder / "machine.toml").write_text(MACHINE)
    machine = read_scan_machine(folder / "machine.toml")
    line = build_line(machine.lattice)
    rng = np.random.default_rng(16)
    drawn = [a_beam(rng, line) for _ in range(beams)]
    for goal in GOALS:
        pairs, missed, off = [], 0, []
        for seed, beam in enumerate(drawn):
            points, reached, far = chosen(machine, beam, seed, goal)
            missed += not reached
            off += far
            if reached:
                pairs.append((points, uniform(machine, beam, 1000 * seed, goal)))
        ours, theirs = np.array(pairs).T
        ratio, far = ours / theirs, np.abs(off)
        print(
            f"goal {100 * goal:.0f} %: chosen {np.median(ours):.0f} points, uniform "
            f"{np.median(theirs):.0f} (medians of {len(pairs)} beams); ratio "
            f"{np.median(ratio):.2f}, 10 to 90 % of beams {np.quantile(ratio, 0.1):.2f} to "
            f"{np.quantile(ratio, 0.9):.2f}; all points {ours.sum() / theirs.sum():.2f}; "
            f"not reached within {MOST} or stopped before: {missed}; truth within one error "
            f"{np.mean(far < 1):.2f}, two {np.mean(far < 2):.2f}, beyond three "
            f"{np.mean(far > 3):.3f}", flush=True,
        )  # fmt: skip


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 40)
