"""What is true of the simulated injector and ring, for their IOC and those who check answers.

The optics are a thick quadrupole and a drift in numpy, no code of beamfit.
"""

import numpy as np

# Emittance m, beta m, alpha at the entrance of the quadrupole, for x and y.
BEAM = {"x": (2.7e-9, 8.0, -1.1), "y": (2.2e-9, 7.0, -0.7)}
# Quadrupole m, drift m, total energy MeV, limits T/m, noise of a size.
LENGTH, DRIFT, ENERGY, LIMIT, NOISE = 0.108, 2.2094, 135.0, 8.0, 0.02
RIGIDITY = ENERGY / 299.792458
# Of the ring: a 1/(mA s), b 1/s at a pressure of 1e-7 Pa.
A, B = 2.5e-7, 8.0e-6


def size(plane: str, gradient: float) -> float:
    """Rms size, m, behind a thick quadrupole and a drift (H. Wiedemann, Particle Accelerator
    Physics, 4th ed., eq. 7.30 to 7.32).
    """
    k = gradient / RIGIDITY * (1 if plane == "x" else -1)
    root = np.sqrt(complex(k))
    c, s = np.cos(root * LENGTH).real, (np.sin(root * LENGTH) / root).real if k else LENGTH
    c_, s_ = -k * s, c
    r11, r12 = c + DRIFT * c_, s + DRIFT * s_
    emittance, beta, alpha = BEAM[plane]
    gamma = (1 + alpha**2) / beta
    return float(np.sqrt(emittance * (r11**2 * beta - 2 * r11 * r12 * alpha + r12**2 * gamma)))
