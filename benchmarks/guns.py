"""SIMULATED photocathode guns of 2, 4 and 6 knobs, by published formulas; no machine's data.

Normalised emittances add in squares (D. H. Dowell, Sources of emittance in RF photocathode
injectors, arXiv:1610.01242 (2016)):

- intrinsic, σ (MTE/mc²)^½: D. H. Dowell and J. F. Schmerge, Phys. Rev. ST Accel. Beams 12, 074201
  (2009);
- of the RF, α k³ σ² σz² (½ + cos² φ/(k σz)²)^½, and of space charge, (π/4) I/(I_A α k sin φ)/
  (3 A + 5): K.-J. Kim, Nucl. Instrum. Methods A 275, 201 (1989); the latter times
  (r² + ((B - B_c)/w)²)^½, since the solenoid turns slices back (B. E. Carlsten, ibid. 285, 313
  (1989)): a smooth stand-in for published curves, with r and w of this file;
- chromatic and spherical aberration of the solenoid, γ σs² K |sin KL + KL cos KL| δ and C σs⁴, the
  first with σs times the offset of the beam in it (Dowell 2016);
- quadrupole fields of the solenoid, in proportion to γ σs²/f, which a normal and a skew corrector
  cancel (D. H. Dowell, F. Zhou and J. Schmerge, Phys. Rev. Accel. Beams 21, 010101 (2018)).
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.stats.qmc import Sobol

from beamfit.emittance.scan import KNOB, QuadScan
from beamfit.optics.beamline import Beamline
from beamfit.optics.elements import Drift, Screen, ThinLens
from beamfit.tuning.fit import TuningFit, fit_tuning
from beamfit.tuning.minimum import next_row

MC2, ALFVEN = 0.51099895, 17045.0  # MeV, A
WAVE = 2 * np.pi * 2.856e9 / 299792458.0  # 1/m: an S-band gun
CHARGE, SPOT, MTE = 250e-12, 0.5e-3, 0.5e-6  # C, m rms, MeV
ENERGY, GRADIENT = 6.0, 115.0  # MeV after the gun, MV/m
SOLENOID, DRIFT = 0.19, 0.5  # m: its length, from it to the scan's start
SIZE, SPREAD = 0.8e-3, 5e-3  # m in the solenoid; energy spread of a bunch of 0.9 mm
COMPENSATED, WIDTH = 0.15, 14.0  # share of the space charge left at best; A
SHOTS, SHOT, SCATTER = 10, 0.01, 0.04
# Knobs: usual setting, and limits. Solenoid in A, phase in degrees from crest, correctors in units
# of the solenoid's own quadrupole, bunch length and offset in the solenoid in mm.
LIMITS = {
    "SOL": (190.0, 210.0),
    "phase_deg": (-12.0, 12.0),
    "CQ": (-2.0, 2.0),
    "SQ": (-2.0, 2.0),
    "length_mm": (0.5, 1.5),
    "offset_mm": (-1.0, 1.0),
}
USUAL = {"SOL": 200.0, "phase_deg": 0.0, "CQ": 0.0, "SQ": 0.0, "length_mm": 0.9, "offset_mm": 0.0}
LINE = Beamline((ThinLens("Q"), Drift("D", 2.0), Screen("S")), energy=135.0, name="gun line")
QUADRUPOLE = (-1.0, 1.0)  # 1/m


class Gun(NamedTuple):
    """Imperfections that differ from gun to gun, in the units of the knobs that mend them."""

    names: tuple[str, ...]
    compensation: float
    crest: float
    quadrupole: tuple[float, float]
    offset: float


def gun_of(knobs: int, seed: int) -> Gun:
    rng = np.random.default_rng([knobs, seed])
    solenoid, crest = rng.uniform(196.0, 204.0), rng.uniform(-4.0, 4.0)
    fields, offset = tuple(rng.uniform(-1.0, 1.0, 2)), rng.uniform(-0.5, 0.5)
    return Gun(tuple(LIMITS)[:knobs], solenoid, crest, fields, offset)


def parts(gun: Gun, at: Mapping[str, float]) -> tuple[float, float, float]:
    """Normalised emittance at the start of the scan (m), and β (m) and α there."""
    k = USUAL | dict(at)
    length, phase = 1e-3 * k["length_mm"], np.radians(90.0 + k["phase_deg"] - gun.crest)
    alpha = GRADIENT / (2 * MC2 * WAVE)
    intrinsic = SPOT * np.sqrt(MTE / MC2)
    phased = np.sqrt(0.5 + (np.cos(phase) / (WAVE * length)) ** 2)
    rf = alpha * WAVE**3 * SPOT**2 * length**2 * phased
    current = CHARGE * 299792458.0 / (np.sqrt(2 * np.pi) * length)
    charge = np.pi / 4 * current / ALFVEN / (alpha * WAVE * np.sin(phase))
    charge /= 3 * SPOT / length + 5
    charge *= np.hypot(COMPENSATED, (k["SOL"] - gun.compensation) / WIDTH)
    gamma, strength = ENERGY / MC2, 5.3 * k["SOL"] / 200.0  # K in 1/m: the Larmor wave number
    turn, focus = strength * SOLENOID, strength * np.sin(strength * SOLENOID)
    bent = gamma * strength * abs(np.sin(turn) + turn * np.cos(turn))
    aside = 1e-3 * (k["offset_mm"] - gun.offset)
    chromatic = bent * SIZE * np.hypot(SIZE, aside) * SPREAD * (length / 0.9e-3) ** 2
    spherical = 0.02e6 * SIZE**4
    fields = np.hypot(gun.quadrupole[0] + k["CQ"], gun.quadrupole[1] + k["SQ"])
    coupled = 0.009 * gamma * SIZE**2 * focus * fields
    emittance = np.sqrt(np.sum(np.square([intrinsic, rf, charge, chromatic, spherical, coupled])))
    return float(emittance), *_after(float(emittance), focus)


def _after(normalized: float, focus: float) -> tuple[float, float]:
    """β and α at the scan's start: a parallel beam of 4 m at the solenoid, a lens and a drift."""
    first = 4.0 * 0.7e-6 / normalized
    slope = -0.12 * focus
    place = 1.0 + slope * DRIFT
    beta = first * place**2 + DRIFT**2 / first
    return float(beta), float(-(first * place * slope + DRIFT / first))


def emittance_at(gun: Gun, at: Mapping[str, float]) -> float:
    return parts(gun, at)[0]


def minimum_of(gun: Gun) -> tuple[dict[str, float], float]:
    """The true minimum between the limits: from 30 starts."""
    low, high = np.array([LIMITS[n] for n in gun.names]).T

    def cost(u: np.ndarray) -> float:
        return 1e6 * emittance_at(gun, dict(zip(gun.names, low + u * (high - low), strict=True)))

    starts = Sobol(len(gun.names), rng=0).random(32)
    box = [(0.0, 1.0)] * len(gun.names)
    best = min((minimize(cost, u, bounds=box) for u in starts), key=lambda r: r.fun)
    place = dict(zip(gun.names, map(float, low + best.x * (high - low)), strict=True))
    return place, 1e-6 * float(best.fun)


def size_at(gun: Gun, at: Mapping[str, float], strength: float) -> float:
    """The size behind the quadrupole, m, without noise."""
    normalized, beta, alpha = parts(gun, at)
    emittance = normalized / (LINE.energy / MC2)
    r11, r12 = 1.0 - 2.0 * strength, 2.0
    square = r11**2 * beta - 2 * r11 * r12 * alpha + r12**2 * (1 + alpha**2) / beta
    return float(np.sqrt(emittance * square))


class Table(NamedTuple):
    """Rows of settings of knobs and Q, with means of shots and their errors, m."""

    rows: list[dict[str, float]]
    size: np.ndarray
    error: np.ndarray

    def __add__(self, other: "Table") -> "Table":
        ends = zip(self[1:], other[1:], strict=True)
        return Table(self.rows + other.rows, *map(np.concatenate, ends))

    def scan(self, gun: Gun) -> QuadScan:
        units = {"Q": "k1l"} | dict.fromkeys(gun.names, KNOB)
        settings = {name: np.array([r[name] for r in self.rows]) for name in units}
        return QuadScan(settings, units, {"x": self.size}, {"x": self.error}, shots=SHOTS)


def measured(gun: Gun, rows: list[dict[str, float]], rng: np.random.Generator) -> Table:
    """Measure rows. Settings scatter by 4 %, shots by 1 %."""
    true = np.array([size_at(gun, r, r["Q"]) for r in rows])
    seen = true * np.exp(SCATTER * rng.normal(size=len(rows)))
    shots = seen[:, None] * (1.0 + SHOT * rng.normal(size=(len(rows), SHOTS)))
    return Table(rows, shots.mean(1), shots.std(1, ddof=1) / np.sqrt(SHOTS))


def spread_rows(gun: Gun, count: int, seed: int) -> list[dict[str, float]]:
    """Rows that fill the limits evenly, to begin with."""
    names = (*gun.names, "Q")
    low, high = np.array([(LIMITS | {"Q": QUADRUPOLE})[n] for n in names]).T
    at = low + Sobol(len(names), rng=seed).random(count) * (high - low)
    return [dict(zip(names, map(float, row), strict=True)) for row in at]


def tuned(gun: Gun, seed: int, first: int, most: int, within: float = 0.05) -> Iterator[TuningFit]:
    """Fits after every row: the first ones fill the limits, then each is the one advised."""
    rng = np.random.default_rng(seed)
    limits = {name: LIMITS[name] for name in gun.names}
    table = measured(gun, spread_rows(gun, first, seed), rng)
    while True:
        fit = fit_tuning(table.scan(gun), LINE, limits, within=within, seed=seed)
        yield fit
        if len(table.rows) >= most:
            return
        table += measured(gun, [next_row(fit, {"Q": QUADRUPOLE}).settings], rng)


def write_example(path: Path, gun: Gun, seed: int = 1) -> None:
    """Write the table of `measurements`, up to where the fit says to stop."""
    for fit in tuned(gun, seed, 8, 60):
        if fit.done:
            break
    scan = fit.scan
    lines = ["# SIMULATED: benchmarks/guns.py, 2 knobs, seed 0. Means of 10 shots."]
    lines += ["Q_k1l,SOL_A,phase_deg,size_x_um,size_x_error_um,shots"]
    rows = zip(*scan.settings.values(), scan.size["x"], scan.error["x"], strict=True)
    lines += [
        f"{q:.4f},{a:.3f},{p:.3f},{1e6 * size:.2f},{1e6 * error:.3f},{SHOTS}"
        for q, a, p, size, error in rows
    ]
    path.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    ROOT = Path(__file__).resolve().parents[1]
    write_example(ROOT / "measurements" / "gun_tuning_simulated.csv", gun_of(2, 0))
