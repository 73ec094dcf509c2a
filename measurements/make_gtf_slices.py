"""Make gtf_slices_simulated.csv, gtf_phase_simulated.csv: SIMULATED scans after report figure 15.

The Gun Test Facility measured energy spectra and sizes behind its spectrometer, against linac
phase and quadrupole current; none of it was published. Here a chirped beam of five slices goes
through the line of lattices/gtf.toml, which is written out below from report eqs 20-28 with the
corrections of docs/emittance.md, in numpy alone: the spectrometer stays at its setting for
30.5 MeV, and every slice takes its own way through it.

gtf_slices_simulated.csv: sizes across the bend of each slice, told apart by energy, and of the
whole beam, for 14 currents of the quadrupole. gtf_phase_simulated.csv: sizes along the bend, where
the energy is seen, for 13 linac phases.

Run from the top of the repository: python measurements/make_gtf_slices.py
"""

from pathlib import Path

import numpy as np

MASS, E_PROJ = 0.51099895069, 30.5  # MeV
CURRENTS = np.linspace(0.0, 3.9, 14)  # A
ERROR, SEED = 0.02, 15
# Slices from tail to head: charge, energy (MeV), normalised emittance (m), beta (m), alpha.
# Around the Twiss parameters of the PUNDA report, Table 2, first row.
SLICES = {
    str(n + 3): (
        float(np.exp(-0.5 * n**2)),
        E_PROJ * (1.0 + 0.004 * n),
        (0.50 + 0.06 * n**2) * 1e-6,
        2.317 * (1.0 + 0.05 * n),
        -1.372 + 0.10 * n,
    )
    for n in (-2, -1, 0, 1, 2)
}
# The longitudinal beam: rms of c t (m) and of dp/p, their correlation; a linac of 2856 MHz that
# gives 25 MeV on its crest, and the betatron size that the spectrometer adds (m).
LENGTH, SPREAD, CORRELATION = 3.0e-4, 1.2e-3, -0.5
WAVE_NUMBER, GAIN, BETATRON = 2.0 * np.pi * 2.856e9 / 299792458.0, 25.0, 1.0e-4
PHASES = np.linspace(-18.0, 18.0, 13)  # degrees from the crest

BEND, RADIUS, EDGES = np.pi / 3.0, 0.4, np.radians([2.53, 13.49])
DRIFT_TO_SCREEN = 0.4191


def drift(length: float) -> np.ndarray:
    """Report eqs 21 and 23."""
    return np.array([[1.0, length], [0.0, 1.0]])


def quadrupole(k1: float) -> np.ndarray:
    """Report eqs 20 (k1 < 0) and 22 (k1 > 0), with the appendix's length."""
    length, k = 0.07677, np.sqrt(abs(k1))
    c, s = (np.cos, np.sin) if k1 > 0 else (np.cosh, np.sinh)
    return np.array(
        [[c(k * length), s(k * length) / k], [-np.sign(k1) * k * s(k * length), c(k * length)]]
    )


def spectrometer(energy: float) -> np.ndarray:
    """Report eqs 24-28 corrected: across the bend, about the orbit of a slice of an energy."""
    ratio = np.sqrt((energy**2 - MASS**2) / (E_PROJ**2 - MASS**2))
    face = BEND - EDGES[1]
    bend = face + np.arcsin((np.sin(EDGES[1]) + np.sin(face)) / ratio - np.sin(face))
    entrance, leaving = (
        np.array([[1.0, 0.0], [-np.tan(edge) / (RADIUS * ratio), 1.0]])
        for edge in (EDGES[0], EDGES[1] + bend - BEND)
    )
    return leaving @ drift(RADIUS * ratio * bend) @ entrance


def transport(current: float, energy: float) -> np.ndarray:
    """Linac exit to screen, x and x'."""
    parts = [quadrupole(-49.0 / energy), drift(0.11023)]
    parts += [quadrupole((167.23 * current + 43.17) / energy), drift(1.834615)]
    parts += [spectrometer(energy), drift(DRIFT_TO_SCREEN)]
    total = np.eye(2)
    for part in parts:
        total = part @ total
    return total


def beam(energy: float, emittance: float, beta: float, alpha: float) -> np.ndarray:
    """The beam matrix of a normalised emittance and Twiss parameters."""
    geometric = emittance * MASS / np.sqrt(energy**2 - MASS**2)
    return geometric * np.array([[beta, -alpha], [-alpha, (1.0 + alpha**2) / beta]])


def size_squared(current: float, name: str) -> float:
    """Of a slice at the screen, m²."""
    _, energy, *numbers = SLICES[name]
    r = transport(current, energy)
    return (r @ beam(energy, *numbers) @ r.T)[0, 0]


def projected_beam() -> np.ndarray:
    """The beam matrix of all slices together, on one axis."""
    charge = sum(of[0] for of in SLICES.values())
    return sum(of[0] * beam(*of[1:]) for of in SLICES.values()) / charge


def slice_rows() -> list[str]:
    """One line a slice and current, then the whole beam; each size with a normal error."""
    random, charge = np.random.default_rng(SEED), sum(of[0] for of in SLICES.values())
    rows = []
    for name in (*SLICES, "projected"):
        for current in CURRENTS:
            if name in SLICES:
                energy, squared = SLICES[name][1], size_squared(current, name)
            else:
                energy = E_PROJ
                squared = sum(of[0] * size_squared(current, n) for n, of in SLICES.items()) / charge
            true = 1e6 * np.sqrt(squared)
            measured = true * (1.0 + ERROR * random.normal())
            rows.append(f"{name},{energy:.4f},{current:.1f},{measured:.3f},{ERROR * true:.3f}")
    return rows


def phase_rows() -> list[str]:
    """Sizes along the bend: dp/p at the screen is chirp · c t + dp/p, seen through dispersion."""
    random = np.random.default_rng(SEED + 1)
    # Dispersion of the bend with its exit edge, carried to the screen (K. L. Brown, SLAC-75).
    angle = np.sin(BEND) + (1.0 - np.cos(BEND)) * np.tan(EDGES[1])
    dispersion = RADIUS * (1.0 - np.cos(BEND)) + DRIFT_TO_SCREEN * angle
    rows = []
    for phase in PHASES:
        chirp = -GAIN / E_PROJ * WAVE_NUMBER * np.sin(np.radians(phase))
        r = dispersion * np.array([chirp, 1.0])
        squared = r @ longitudinal_beam() @ r + BETATRON**2
        true = 1e6 * np.sqrt(squared)
        measured = true * (1.0 + ERROR * random.normal())
        numbers = f"{r[0]:.8f},{r[1]:.8f},{measured:.3f},{ERROR * true:.3f}"
        rows.append(f"{phase:g},{numbers},{1e6 * BETATRON:g}")
    return rows


def longitudinal_beam() -> np.ndarray:
    """Of c t (m) and dp/p at the linac exit, on the crest."""
    mixed = CORRELATION * LENGTH * SPREAD
    return np.array([[LENGTH**2, mixed], [mixed, SPREAD**2]])


SLICE_HEADER = f"""\
# SIMULATED, not measured: five slices of a chirped beam on the SLAC Gun Test Facility line
# (lattices/gtf.toml; report figure 15), and the whole beam; slices 1 to 5 from tail to head
# each size times a normal error of {100 * ERROR:g} %, numpy default_rng seed {SEED}
# made by measurements/make_gtf_slices.py, which has the truth
slice,energy_MeV,Q2_A,size_x_um,size_x_error_um
"""
PHASE_HEADER = f"""\
# SIMULATED, not measured: longitudinal phase scan behind the spectrometer (report figure 15)
# r11_y, r12_y carry c t (m) and dp/p at the linac exit to the screen, for one linac phase each
# each size times a normal error of {100 * ERROR:g} %, numpy default_rng seed {SEED + 1}
# made by measurements/make_gtf_slices.py, which has the truth
note_phase_deg,r11_y,r12_y,size_y_um,size_y_error_um,resolution_um
"""


def main() -> None:
    """Write the files beside this script."""
    here = Path(__file__).resolve().parent
    (here / "gtf_slices_simulated.csv").write_text(SLICE_HEADER + "\n".join(slice_rows()) + "\n")
    (here / "gtf_phase_simulated.csv").write_text(PHASE_HEADER + "\n".join(phase_rows()) + "\n")


if __name__ == "__main__":
    main()
