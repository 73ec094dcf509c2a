"""Make the scan and the decay that `beamfit example` writes: SIMULATED, small, easily answered.

Run from the top of the repository: python measurements/make_example.py
"""

from pathlib import Path

import numpy as np

import beamfit

# Normalised emittance (m), beta (m) and alpha where the line begins.
TRUTH = {"x": (1.0e-6, 8.0, 0.5), "y": (1.2e-6, 6.0, -0.4)}
CURRENTS = np.linspace(-5.0, 5.0, 11)
RELATIVE, SEED, RESOLUTION = 0.02, 3, 10e-6
# mA, 1/(mA s), 1/s; readings (mA rms) over four hours.
I0, A, B, NOISE = 100.0, 4.0e-7, 1.5e-5, 0.01
SCAN = f"""\
# SIMULATED quadrupole scan: rms sizes of the beam on screen OTR1 of lattice.toml.
# Normalised emittances {TRUTH["x"][0] * 1e6:g} (x) and {TRUTH["y"][0] * 1e6:g} µm (y), \
{100 * RELATIVE:g} % noise. The header carries the units.
Q1_A,size_x_um,size_x_error_um,size_y_um,size_y_error_um
"""
DECAY = f"""\
# SIMULATED current: dI/dt = -a I2 - b I, a = {A:g} /(mA s), b = {B:g} /s, {NOISE:g} mA noise.
time_s,beam_current_mA
"""


def scan_text(line: beamfit.Beamline, rng: np.random.Generator) -> str:
    """Sizes in both planes at every current, with their errors."""
    rows = []
    for current in CURRENTS:
        cells = [f"{current:g}"]
        for number, (emittance, beta, alpha) in enumerate(TRUTH.values()):
            r11, r12 = np.asarray(line.matrix({"Q1": current}).planes)[number, 0, :2]
            gamma = (1 + alpha**2) / beta
            spread = r11**2 * beta - 2 * r11 * r12 * alpha + r12**2 * gamma
            geometric = emittance / np.sqrt((line.energy / line.mass) ** 2 - 1)
            size = 1e6 * np.sqrt(geometric * spread + RESOLUTION**2)
            measured = size * (1 + RELATIVE * rng.normal())
            cells += [f"{measured:.1f}", f"{RELATIVE * size:.1f}"]
        rows.append(",".join(cells))
    return SCAN + "\n".join(rows) + "\n"


def decay_text(rng: np.random.Generator) -> str:
    """Currents of one undisturbed decay."""
    time = np.arange(0.0, 4 * 3600 + 1, 600.0)
    fall = np.exp(-B * time)
    current = I0 * fall / (1 + A / B * I0 * (1 - fall)) + NOISE * rng.normal(size=time.size)
    return DECAY + "".join(f"{t:g},{i:.3f}\n" for t, i in zip(time, current, strict=True))


def main() -> None:
    """Write both files beside the lattice."""
    folder = Path(beamfit.__file__).parent / "example"
    rng = np.random.default_rng(SEED)
    line = beamfit.load_lattice(folder / "lattice.toml")
    (folder / "scan.csv").write_text(scan_text(line, rng))
    (folder / "decay.csv").write_text(decay_text(rng))


if __name__ == "__main__":
    main()
