"""Make gtf_two_screens_simulated.csv: a SIMULATED scan on two screens with a wrong calibration.

The beam is that of gtf_simulated.csv. The true calibration of Q2 is not the lattice's: slope 160.0
and intercept 50.0 instead of 167.23 and 43.17. Screen PRE is invented. Run from the top of the
repository: python measurements/make_gtf_two_screens.py
"""

from pathlib import Path

import numpy as np

import beamfit
from beamfit.emittance.calibration import with_numbers

SIGMA = np.array([2.62035, 1.55237, 1.40828]) * 1e-8  # m², m rad, rad²: Table 2, row 1
TRUE = {"Q2.slope": 160.0, "Q2.intercept": 50.0}
CURRENTS = np.linspace(0.0, 3.9, 14)
RELATIVE, SEED = 0.02, 12
HEADER = f"""\
# SIMULATED, not measured: Q2 scan of the SLAC Gun Test Facility line on two screens
# (lattices/gtf_two_screens.toml; screen PRE is invented)
# sigma11, sigma12, sigma22 = 2.62035, 1.55237, 1.40828 in 1e-8 m2, m rad, rad2
# TRUE calibration of Q2: slope 160.0, intercept 50.0; the lattice says 167.23, 43.17
# each size times a normal error of {100 * RELATIVE:g} %, numpy default_rng seed {SEED}
# made by measurements/make_gtf_two_screens.py
Q2_A,screen,size_x_um,size_x_error_um
"""


def main() -> None:
    """Write the file beside this script."""
    here = Path(__file__).resolve().parent
    line = beamfit.load_lattice(here.parent / "lattices" / "gtf_two_screens.toml")
    line = with_numbers(line, TRUE)
    random, rows = np.random.default_rng(SEED), []
    for screen in ("SCREEN", "PRE"):
        for current in CURRENTS:
            r11, r12 = np.asarray(line.upto(screen).matrix({"Q2": current}).x)[0, :2]
            true = 1e6 * np.sqrt(SIGMA @ [r11**2, 2 * r11 * r12, r12**2])
            measured = true * (1.0 + RELATIVE * random.normal())
            rows.append(f"{current:.1f},{screen},{measured:.3f},{RELATIVE * true:.3f}")
    (here / "gtf_two_screens_simulated.csv").write_text(HEADER + "\n".join(rows) + "\n")


if __name__ == "__main__":
    main()
