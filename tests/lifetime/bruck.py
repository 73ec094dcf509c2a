"""Bruck's Touschek rate for a flat, slow bunch: the limit that Piwinski's must reach.

H. Bruck, Accelerateurs circulaires de particules (1966), chapter 30. It is no part of the package:
at SPEAR3 it is 14 to 17 % optimistic.
"""

import numpy as np
from scipy import constants

ELECTRON_RADIUS = constants.physical_constants["classical electron radius"][0]


def bruck_shape(xi, nodes=64):
    """D(xi) as one integral: sqrt(xi) ∫₁^∞ (w - 1 - ln(w)/2)/w² exp(-xi w) dw."""
    roots, weights = np.polynomial.legendre.leggauss(nodes)
    upper = np.log1p(45 / np.atleast_1d(xi))[:, None]
    log_w = upper * (roots + 1) / 2
    w = np.exp(log_w)
    integrand = (1 - (1 + log_w / 2) / w) * np.exp(-np.atleast_1d(xi)[:, None] * w)
    return np.sqrt(xi) * upper[:, 0] / 2 * (integrand @ weights)


def bruck_rate(ring, population, length, acceptance):
    """1/tau_T, 1/s; xi = (delta/(gamma sigma_x'))² with the rms angle of a thin slice."""
    at = ring.optics
    lorentz = ring.relativistic_gamma
    tilt = at.alpha_x * at.dispersion_x + at.beta_x * at.slope_x
    spread_x = ring.energy_spread * at.dispersion_x
    spread_y = ring.energy_spread * at.dispersion_y
    size2_x = ring.emittance_x * at.beta_x + spread_x**2
    size2_y = ring.emittance_y * at.beta_y + spread_y**2
    volume = np.sqrt(size2_x * size2_y - (spread_x * spread_y) ** 2)
    angle2 = ring.emittance_x / at.beta_x * (1 + (ring.energy_spread * tilt) ** 2 / size2_x)
    xi = (acceptance / lorentz) ** 2 / angle2
    density = at.average(bruck_shape(np.asarray(xi)) / (volume * acceptance**3))
    scale = ELECTRON_RADIUS**2 * constants.c * population / (8 * np.pi * lorentz**2 * length)
    return scale * density
