"""Make spear3_shift_simulated.csv: a SIMULATED 48 h machine-development shift at SPEAR3.

No such record was published. First principles on lattices/spear3_2003.toml give the decays, with
the true scales below, which a study has to find again. 30 fills of 1.6 h each run through RF
voltage, scraper, bunches and current. The pressure reading carries an error of 5 % a fill, the
current monitor 2 µA, both drawn with seed 27. Run from the top of the repository:
python measurements/make_spear3_shift.py
"""

from pathlib import Path

import numpy as np

from beamfit.io.ring import read_operation, read_ring
from beamfit.lifetime.decay_law import current
from beamfit.lifetime.mechanisms import loss_terms, scaled_losses

SCALES = np.array([1.12, 1.30, 0.85, 1.0])  # Touschek, bremsstrahlung, elastic
DESORPTION = 1.25  # on the pressure rise with current, in the pressure itself
NOISE, PRESSURE_ERROR, SEED = 2e-3, 0.05, 27  # mA, relative
FILL, STEP = 5760.0, 60.0  # s
VOLTAGES = (3200.0, 2800.0, 2400.0, 2000.0, 1600.0)  # kV
SCRAPERS = (6.0, 4.0, 3.0, 2.5, 2.0)  # mm
BUNCHES = (280, 140, 70)
CURRENTS = (500.0, 300.0, 100.0)  # mA
HEADER = """\
# SIMULATED, not measured: a 48 h machine-development shift at SPEAR3 (lattices/spear3_2003.toml)
# true scales on first principles: Touschek 1.12, bremsstrahlung 1.30, elastic 0.85, desorption 1.25
# noise 2 uA; pressure reading off by 5 % a fill; numpy default_rng seed 27
# made by measurements/make_spear3_shift.py
time_s,beam_current_mA,beam_current_error_mA,rf_voltage_kV,scraper_y_mm,pressure_Pa,bunches
"""


def settings(number: int) -> tuple[float, float, int, float]:
    """RF voltage, scraper, bunches and current of a fill: one is varied at a time, then all."""
    scan, k = divmod(number, 5)
    return (
        VOLTAGES[k] if scan in (0, 3, 5) else 3200.0,
        SCRAPERS[k] if scan in (1, 3) else (SCRAPERS[-1 - k] if scan == 5 else 6.0),
        BUNCHES[k % 3] if scan in (2, 4, 5) else 280,
        CURRENTS[(k + (k > 2)) % 3] if scan in (2, 3, 4) else 500.0,
    )


def main() -> None:
    """Write the file beside this script."""
    here = Path(__file__).resolve().parent
    path = here.parent / "lattices" / "spear3_2003.toml"
    ring, usual = read_ring(path), read_operation(path)
    usual = usual._replace(pressure_slope=DESORPTION * usual.pressure_slope)
    random = np.random.default_rng(SEED)
    time = np.arange(0.0, FILL, STEP)
    rows = []
    for number in range(30):
        voltage, scraper, bunches, start = settings(number)
        operation = usual._replace(
            rf_voltage=1e3 * voltage, scraper_y=1e-3 * scraper, bunches=float(bunches)
        )
        a, b = scaled_losses(SCALES, loss_terms(ring, operation, start))
        beam = np.array(current(time, start, float(a), float(b)))
        pressure = usual.pressure_base + usual.pressure_slope * beam
        reading = pressure * np.exp(PRESSURE_ERROR * random.normal())
        measured = beam + NOISE * random.normal(size=time.size)
        for t, i, p in zip(number * FILL + time, measured, reading, strict=True):
            rows.append(f"{t:.0f},{i:.4f},{NOISE:g},{voltage:g},{scraper:g},{p:.4g},{bunches}")
    (here / "spear3_shift_simulated.csv").write_text(HEADER + "\n".join(rows) + "\n")


if __name__ == "__main__":
    main()
