"""Make measurements/profiles_simulated.csv: profiles of a SIMULATED beam at LCLS OTR2.

x has a core of 80 % and a halo 2.5 times as wide; y is Gaussian. The line is that of
lattices/lcls_otr2.toml, written out in numpy alone. Settings scatter by 3 %; three shots each, with
noise and a background. The normalised rms emittances are 1.125 and 0.5 µm.

Run from the top of the repository: python measurements/make_profiles.py
"""

from pathlib import Path

import numpy as np

# Normalised emittance of the core, m; β (m) and α at the screen with the quadrupole as designed.
CORE, BOOST, BETA, ALPHA, DESIGN = 0.5e-6, 264.19, {"x": 1.3, "y": 1.4}, 0.0, -2.983
SHARE, WIDE = {"x": 0.8, "y": 1.0}, 2.5
SETTINGS, SHOTS, BIN, SEED = np.linspace(-4.4, -1.6, 6), 3, 20.0, 7
LENGTH, DRIFT, RIGIDITY = 0.108, 2.2094, 0.450287  # m, m, T m


def matrix(integrated: float, plane: str) -> np.ndarray:
    """Thick quadrupole and drift; a positive integrated gradient (kG) focuses x."""
    k1 = 0.1 * integrated / RIGIDITY / LENGTH * (1.0 if plane == "x" else -1.0)
    k = np.sqrt(abs(k1))
    c, s = (np.cos, np.sin) if k1 > 0 else (np.cosh, np.sinh)
    at = k * LENGTH
    quadrupole = np.array([[c(at), s(at) / k], [-np.sign(k1) * k * s(at), c(at)]])
    return np.array([[1.0, DRIFT], [0.0, 1.0]]) @ quadrupole


def main() -> None:
    """Write the table."""
    random = np.random.default_rng(SEED)
    lines = ["# SIMULATED by measurements/make_profiles.py: x has a halo, y is Gaussian"]
    lines += ["Q525_kG,shot,position_um,counts_x,counts_y"]
    position = np.arange(-800.0, 800.1, BIN)
    for setting in SETTINGS:
        size = {}
        for plane, beta in BETA.items():
            at_screen = CORE / BOOST * np.diag([beta, 1.0 / beta])  # α is zero
            way = matrix(setting, plane) @ np.linalg.inv(matrix(DESIGN, plane))
            rms = 1e6 * np.sqrt((way @ at_screen @ way.T)[0, 0])
            size[plane] = rms * (1.0 + 0.03 * random.normal())
        for shot in range(1, SHOTS + 1):
            counts = []
            for plane, rms in size.items():
                x, share = (position - random.normal(0.0, 15.0)) / rms, SHARE[plane]
                seen = share * np.exp(-0.5 * x**2)
                seen = seen + (1.0 - share) / WIDE * np.exp(-0.5 * (x / WIDE) ** 2)
                counts.append(3e5 / rms * seen + 60.0 + 30.0 * random.normal(size=len(x)))
            for at, of_x, of_y in zip(position, *counts, strict=True):
                lines.append(f"{setting:.2f},{shot},{at:.0f},{of_x:.0f},{of_y:.0f}")
    Path("measurements/profiles_simulated.csv").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
