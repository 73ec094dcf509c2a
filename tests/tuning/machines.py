"""SIMULATED machines whose minimum is known: smooth maps drawn anew, seen through a thin lens."""

from typing import NamedTuple

import numpy as np
from scipy.stats.qmc import Sobol

from beamfit.emittance.scan import KNOB, QuadScan
from beamfit.optics.beamline import Beamline
from beamfit.optics.elements import Drift, Screen, ThinLens

EMITTANCE, BETA, DRIFT = 5e-9, 4.0, 2.0
LINE = Beamline((ThinLens("Q"), Drift("D", DRIFT), Screen("S")), energy=135.0)
SCATTER, SHOT = 0.04, 0.01


class Machine(NamedTuple):
    """ε = ε0 (1 + |(x - place)/width|²)^½ or constant; ln β and α are linear in the knobs x."""

    place: np.ndarray
    width: np.ndarray
    slopes: np.ndarray

    def numbers(self, x):
        """Emittance, beta, alpha in one plane at settings, shape (n, knobs)."""
        far = (((x - self.place) / self.width) ** 2).sum(-1)
        beta = BETA * np.exp(x @ self.slopes[0])
        return EMITTANCE * np.sqrt(1.0 + far), beta, x @ self.slopes[1]


def machine_of(rng, knobs, flat=False):
    width = rng.uniform(0.4, 1.5, knobs)
    return Machine(
        rng.uniform(-0.7, 0.7, knobs),
        np.full(knobs, np.inf) if flat else width,
        0.5 * rng.normal(size=(2, knobs)),
    )


def size_of(machine, x, strength):
    """Sizes by Twiss parameters through a thin lens and a drift, m."""
    emittance, beta, alpha = machine.numbers(x)
    r11, r12 = 1.0 - DRIFT * strength, DRIFT
    square = r11**2 * beta - 2.0 * r11 * r12 * alpha + r12**2 * (1.0 + alpha**2) / beta
    return np.sqrt(emittance * square)


def scan_of(machine, rng, count, scatter=SCATTER, shot=SHOT):
    """Rows at settings that fill the box: each setting scatters, its shots are stated."""
    knobs = len(machine.place)
    at = 2.0 * Sobol(knobs + 1, rng=rng).random_base2(int(np.log2(count))) - 1.0
    x, strength = at[:, :-1], 0.5 + 1.0 * at[:, -1]
    noise = np.hypot(scatter, shot) * rng.normal(size=count)
    size = size_of(machine, x, strength) * np.exp(noise)
    names = [f"K{i}" for i in range(knobs)]
    settings = {"Q": strength} | dict(zip(names, x.T, strict=True))
    units = {"Q": "k1l"} | dict.fromkeys(names, KNOB)
    return QuadScan(settings, units, {"x": size}, {"x": shot * size}, shots=10)


def limits_of(machine):
    return {f"K{i}": (-1.0, 1.0) for i in range(len(machine.place))}
