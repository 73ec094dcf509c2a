"""Live scans of two magnets whose lattice file is wrong, or right: in how many is it said?

    python benchmarks/scan_line.py [SCANS]

SIMULATED: beams and noise of benchmarks/scan.py, a line of two quadrupoles; a drift is a third
longer or shorter than the file says. Written to docs/live_measured.md.
"""

from __future__ import annotations

import asyncio
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from scan import LINE, MACHINE, Beam, Simulated, a_beam, pulls

from beamfit.io.line import build_line
from beamfit.io.machine import ScanMachine, read_scan_machine
from beamfit.live.devices import Connected
from beamfit.live.scan import scan

GOAL, FIRST, SECOND = 0.05, 1.0, 2.2
CASES = {
    "right": (FIRST, SECOND),
    "drift behind the magnets a third off": (FIRST, 4 / 3 * SECOND),
    "drift between them a third longer": (4 / 3 * FIRST, SECOND),
    "drift between them a third shorter": (2 / 3 * FIRST, SECOND),
}


class Two(Simulated):
    """Two magnets of one line, seen as one by one: each has the place where both stand."""

    def __init__(self, name: str, at: dict[str, float], beam: Beam, rng: np.random.Generator):
        super().__init__(beam, rng)
        self.name, self.at = name, at

    async def put(self, value: float) -> None:
        self.at[self.name] = value

    async def get(self) -> float:
        return self.at[self.name]

    async def settled(self, value: float) -> float:
        return self.at[self.name]

    @property
    def settings(self) -> Mapping[str, float]:
        return self.at


def machine_of(folder: Path, first: float, second: float) -> ScanMachine:
    """The machine file of a line with two quadrupoles and their drifts, m."""
    magnet = LINE[LINE.index("[[element]]") : LINE.index('[[element]]\ntype = "drift"')]
    drift = '[[element]]\ntype = "drift"\nlength_m = {}\n'
    head, screen = LINE[: LINE.index("[[element]]")], LINE[LINE.rindex("[[element]]") :]
    second_magnet = magnet.replace('"Q"', '"R"')
    parts = [head, magnet, drift.format(first), second_magnet, drift.format(second), screen]
    (folder / "line.toml").write_text("".join(parts))
    one = MACHINE[MACHINE.index("[[magnet]]") : MACHINE.index("[screen]")]
    other = one.replace('"Q', '"R')
    (folder / "machine.toml").write_text(MACHINE.replace("[screen]", f"{other}[screen]"))
    return replace(read_scan_machine(folder / "machine.toml"), goal=GOAL)


def scanned(machine: ScanMachine, line, true, seed: int) -> tuple[bool, bool]:
    """Whether a scan doubts its line, and whether it is silent and beyond six errors."""
    beam, at = a_beam(np.random.default_rng(seed), true), {"Q": -2.0, "R": 1.0}
    magnets = {name: Two(name, at, beam, np.random.default_rng(seed)) for name in at}
    with tempfile.TemporaryDirectory() as folder:
        found = asyncio.run(
            scan(Connected(magnets, *[magnets["Q"]] * 2, machine), line, Path(folder) / "journal")
        )
    said = bool(found.doubt)
    said |= any(p.status != "converged" or p.emittance.error is None for p in found.fit.planes)
    return said, not said and max(map(abs, pulls(found.fit, beam))) > 6


def main(count: int) -> None:
    folder = Path(tempfile.mkdtemp())
    told = machine_of(folder, FIRST, SECOND)
    line = build_line(told.lattice)
    print("| line | said | silent and beyond 6 errors |\n|---|---|---|")
    for name, drifts in CASES.items():
        true = build_line(machine_of(folder, *drifts).lattice)
        rows = [scanned(told, line, true, seed) for seed in range(count)]
        print(f"| {name} | {sum(s for s, _ in rows)} of {count} | {sum(w for _, w in rows)} |")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100)
