"""The SPEAR3 2003 design lattice for pyAT, and the Twiss table in lattices/ made from it.

Magnet lengths, strengths and angles are those of the design deck sp3v81f, published with the
Accelerator Toolbox (github atcollab/at, machine_data/sp3v81f.m). Only the linear optics is kept:
sextupoles, correctors and monitors are drifts here, neighbouring drifts are joined. The two
matching cells of a half ring differ by 0.24 micrometre in one drift; the first one's is used.

    python benchmarks/spear3_lattice.py     writes lattices/spear3_2003_twiss.csv
"""

from __future__ import annotations

from pathlib import Path

import at
import numpy as np

CIRCUMFERENCE, HARMONIC = 234.1440122400003, 372
TABLE = Path(__file__).parents[1] / "lattices" / "spear3_2003_twiss.csv"

# name: (length m, k1 1/m², bending angle rad; edges are half the angle, as for a rectangular bend)
MAGNETS = {
    "QF": (0.3533895, 1.768672904054, 0.0),
    "QD": (0.1634591, -1.542474230359, 0.0),
    "QFC": (0.5123803, 1.748640831069, 0.0),
    "BEND": (1.5048, -0.31537858, 0.18479957),
    "QDX": (0.3533895, -1.386467245226, 0.0),
    "QFX": (0.6105311, 1.573196278394, 0.0),
    "QDY": (0.3533895, -0.460640930646, 0.0),
    "QFY": (0.5123803, 1.481493709831, 0.0),
    "QDZ": (0.3533895, -0.878223937747, 0.0),
    "QFZ": (0.3533895, 1.427902006984, 0.0),
    "BDM": (1.14329, -0.31537858, 0.138599675894),
}
# A number is a drift in metre. The half cell ends at the centre quadrupole, which is not split.
HALF_CELL = (1.52997525, "QF", 0.3815757, "QD", 0.21690312, "BEND", 1.43941452, "QFC")
CELL = HALF_CELL + HALF_CELL[-2::-1]
MATCHING = (3.80330525, "QDX", 0.3830397, "QFX", 0.2630397, "QDY", 0.21584572, "BDM")
MATCHING += (1.99771860, "QFY", 1.99772032, "BDM", 0.46584572, "QDZ", 0.3966105, "QFZ", 3.26987665)
HALF_RING = MATCHING + 7 * CELL + MATCHING[::-1]


def element(item: str | float, pieces: int) -> list:
    """One drift or magnet in equal pieces, edges on the outer faces only."""
    if not isinstance(item, str):
        return [at.Drift("D", item / pieces)] * pieces
    length, k1, angle = MAGNETS[item]
    if not angle:
        return [at.Quadrupole(item, length / pieces, k1)] * pieces
    edges = np.zeros((pieces, 2))
    edges[0, 0] = edges[-1, 1] = angle / 2
    return [
        at.Dipole(item, length / pieces, angle / pieces, k1, EntranceAngle=e1, ExitAngle=e2)
        for e1, e2 in edges
    ]


def build(step: float = 0.085, voltage: float = 3.2e6) -> at.Lattice:
    """The whole ring, no piece longer than `step`; even numbers, so that a centre is a boundary."""
    items = 2 * HALF_RING
    lengths = [MAGNETS[item][0] if isinstance(item, str) else item for item in items]
    pieces = [
        piece
        for item, length in zip(items, lengths, strict=True)
        for piece in element(item, 2 * int(np.ceil(length / step / 2)))
    ]
    cavity = at.RFCavity("RF", 0.0, voltage, HARMONIC * 299792458 / CIRCUMFERENCE, HARMONIC, 3e9)
    return at.Lattice([cavity, *pieces], name="SPEAR3", energy=3e9)


def write_table(path: Path = TABLE) -> None:
    """Write the optics of a quarter of the ring; the others are its mirror images."""
    ring = build()
    s = ring.get_s_pos(range(len(ring) + 1))
    quarter = np.flatnonzero(s <= CIRCUMFERENCE / 4 + 1e-6)[1:]
    _, _, optics = ring.disable_6d(copy=True).get_optics(refpts=quarter)
    columns = [optics.s_pos, *optics.beta.T, *optics.alpha.T, *optics.dispersion[:, :2].T]
    header = (
        "# SPEAR3 2003 design (sp3v81f, github atcollab/at): optics of one quarter of the ring,\n"
        f"# simulated with pyAT {at.__version__} by benchmarks/spear3_lattice.py\n"
        "s_m,beta_x_m,beta_y_m,alpha_x,alpha_y,dispersion_x_m,dispersion_slope_x"
    )
    np.savetxt(path, np.transpose(columns), "%.8g", ",", header=header, comments="")


if __name__ == "__main__":
    write_table()
