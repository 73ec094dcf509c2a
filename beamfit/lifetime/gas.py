"""Losses on the residual gas: elastic scattering and bremsstrahlung."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array
from scipy import constants

from beamfit.lifetime.ring import (
    ELECTRON_RADIUS,
    Gas,
    Operation,
    Ring,
    stored_bunch,
    up_and_down,
    vertical_acceptance,
)


def elastic_cross_section(
    charge: Array,
    lorentz: Array,
    beta_y: Array,
    acceptance_y: Array,
    beta_x: Array = 0.0,
    acceptance_x: Array = jnp.inf,
) -> Array:
    """Cross section for an elastic deflection out of the transverse acceptance, m² an atom.

    Parameters
    ----------
    charge : float or array
        Atomic number.
    lorentz : float
        Energy over rest energy.
    beta_y, acceptance_y : float or array
        Twiss beta where the atom is, m, and acceptance, m rad, of the vertical plane.
    beta_x, acceptance_x : float or array, optional
        Those of the horizontal plane; it has no limit by default.

    Returns
    -------
    float or array
        4 r_e² Z²/gamma² (x phi + y (pi/2 - phi) + sqrt(x y)) with x = beta_x/A_x, y = beta_y/A_y
        and tan² phi = x/y. Of one plane alone: 2 pi r_e² Z²/gamma² beta/A.

    Notes
    -----
    Rutherford scattering at small angles: A. Wrulich, CERN 94-01 (1994), p. 409, for one plane.
    An electron is lost if it leaves either acceptance: the larger of x cos² and y sin² of the
    azimuth, integrated over it. The sum of both planes counts twice what leaves both: 22 %
    too much for equal planes, less for others. Screening by the electrons is negligible at these
    angles.

    Examples
    --------
    >>> print(f"{elastic_cross_section(7, 5870.85, 8.7845, 9e-7):.4e}")
    6.9233e-28
    """
    x, y = beta_x / acceptance_x, beta_y / acceptance_y
    turn = jnp.arctan2(_root(x), _root(y))
    azimuths = x * turn + y * (jnp.pi / 2 - turn) + _root(x) * _root(y)
    return 4 * (ELECTRON_RADIUS * charge / lorentz) ** 2 * azimuths


def _root(ratio: Array) -> Array:
    """Square root with a zero derivative at zero, where a plane has no limit."""
    limited = jnp.asarray(ratio) > 0
    return jnp.where(limited, jnp.sqrt(jnp.where(limited, ratio, 1.0)), 0.0)


def bremsstrahlung_cross_section(charge: Array, acceptance: Array) -> Array:
    """Cross section for losing more than the momentum acceptance to a photon, m² an atom.

    Parameters
    ----------
    charge : float or array
        Atomic number.
    acceptance : float
        Momentum acceptance, relative.

    Returns
    -------
    float or array
        Integral of the complete-screening cross section, atomic electrons included.

    Notes
    -----
    Y.-S. Tsai, Rev. Mod. Phys. 46 (1974) 815, eq. 3.83 as in the Particle Data Group's review
    "Passage of particles through matter" (radiation logarithms, Coulomb correction f), integrated
    over the photon energy from delta to 1. The nuclei-only form found in older lifetime codes is
    2.2 times too small for hydrogen.

    Examples
    --------
    >>> print(f"{bremsstrahlung_cross_section(7, 0.03):.4e}")
    2.4132e-28
    """
    charge = jnp.asarray(charge, float)
    light = [charge == number for number in (1, 2, 3, 4)]
    nucleus = jnp.select(light, [5.31, 4.79, 4.74, 4.71], jnp.log(184.15 * charge ** (-1 / 3)))
    electron = jnp.select(light, [6.144, 5.621, 5.805, 5.924], jnp.log(1194 * charge ** (-2 / 3)))
    coupling2 = (constants.alpha * charge) ** 2
    coulomb = coupling2 * (
        1 / (1 + coupling2)
        + 0.20206
        - 0.0369 * coupling2
        + 0.0083 * coupling2**2
        - 0.002 * coupling2**3
    )
    log = jnp.log(1 / acceptance)
    full = 4 / 3 * log - 5 / 6 + 4 * acceptance / 3 - acceptance**2 / 2
    rest = (charge**2 + charge) / 9 * (log - 1 + acceptance)
    logarithms = charge**2 * (nucleus - coulomb) + charge * electron
    return 4 * constants.alpha * ELECTRON_RADIUS**2 * (logarithms * full + rest)


def gas_rate_coefficient(cross_section: Array, gas: Gas, temperature: Array) -> Array:
    """Loss rate for each pascal of residual gas, 1/(s Pa).

    Parameters
    ----------
    cross_section : array, shape (k,)
        Cross section of each element, m² an atom.
    gas : Gas
        Elements and their atoms for each molecule.
    temperature : float
        Gas temperature, K.

    Returns
    -------
    float
        c sum(atoms sigma)/(k_B T): with P = P0 + P1 I the loss rate is b = P0 and a = P1 times
        this number.

    Examples
    --------
    >>> from beamfit.lifetime.ring import gas_mixture
    >>> nitrogen = gas_mixture(N2=1)
    >>> rate = 1e-7 * gas_rate_coefficient(6.923249e-28, nitrogen, 300.0)
    >>> print(f"{1 / rate / 3600:.2f} h")
    27.72 h
    """
    return constants.c * jnp.sum(gas.atoms * cross_section) / (constants.k * temperature)


def elastic_loss(ring: Ring, operation: Operation, current: Array) -> Array:
    """Loss rate by elastic scattering for each pascal, 1/(s Pa)."""
    aperture = vertical_acceptance(ring.acceptance_y, operation.scraper_y, ring.scraper_beta_y)
    optics, charge = ring.optics, operation.gas.charge[:, None]
    both = (optics.beta_y, aperture, optics.beta_x, ring.acceptance_x)
    section = elastic_cross_section(charge, ring.relativistic_gamma, *both) @ optics.weight
    return gas_rate_coefficient(section, operation.gas, operation.temperature)


def bremsstrahlung_loss(ring: Ring, operation: Operation, current: Array) -> Array:
    """Loss rate by bremsstrahlung for each pascal, averaged over the ring, 1/(s Pa)."""
    # A photon takes energy: the acceptance downward counts.
    _, points = up_and_down(ring, stored_bunch(ring, operation, current).acceptance)
    charge = operation.gas.charge
    sections = jax.vmap(lambda point: bremsstrahlung_cross_section(charge, point))(points)
    section = ring.optics.weight @ sections
    return gas_rate_coefficient(section, operation.gas, operation.temperature)
