"""Make gtf_simulated.csv: a SIMULATED scan of the Gun Test Facility line.

The report's 14 measured points were never published. These stand in for them: the sizes that
the known transport gives for the beam matrix of the report's Table 2, first row, at the 14
currents, each with a normal error of 2 % drawn with seed 11. Run from the top of the
repository: python measurements/make_gtf_simulated.py
"""

from pathlib import Path

import numpy as np

import beamfit

SIGMA = np.array([2.62035, 1.55237, 1.40828]) * 1e-8  # m², m rad, rad²: Table 2, row 1
CURRENTS = np.linspace(0.0, 3.9, 14)
RELATIVE, SEED = 0.02, 11
HEADER = f"""\
# SIMULATED, not measured: quadrupole scan of the SLAC Gun Test Facility line (lattices/gtf.toml)
# sizes from the beam matrix of the PUNDA report, Table 2, first row
# sigma11, sigma12, sigma22 = 2.62035, 1.55237, 1.40828 in 1e-8 m2, m rad, rad2
# each size times a normal error of {100 * RELATIVE:g} %, numpy default_rng seed {SEED}
# made by measurements/make_gtf_simulated.py
Q2_A,size_x_um,size_x_error_um
"""


def main() -> None:
    """Write the file beside this script."""
    here = Path(__file__).resolve().parent
    line = beamfit.load_lattice(here.parent / "lattices" / "gtf.toml")
    noise = np.random.default_rng(SEED).normal(size=len(CURRENTS))
    rows = []
    for current, deviation in zip(CURRENTS, noise, strict=True):
        r11, r12 = np.asarray(line.matrix({"Q2": current}).x)[0, :2]
        true = 1e6 * np.sqrt(SIGMA @ [r11**2, 2 * r11 * r12, r12**2])
        measured = true * (1.0 + RELATIVE * deviation)
        rows.append(f"{current:.1f},{measured:.3f},{RELATIVE * true:.3f}")
    (here / "gtf_simulated.csv").write_text(HEADER + "\n".join(rows) + "\n")


if __name__ == "__main__":
    main()
