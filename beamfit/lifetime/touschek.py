"""Touschek scattering: Piwinski's rate."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.special import i0e
from scipy import constants

from beamfit.lifetime.ring import ELECTRON_RADIUS, Operation, Optics, Ring, population, stored_bunch


def _spectrum(log_kappa: Array, floor: Array) -> Array:
    """Piwinski's integrand at t = tan²(kappa), without its exponential and Bessel function."""
    tangent = jnp.tan(jnp.exp(log_kappa))
    t = tangent**2
    ratio = t / floor / (1 + t)
    return (
        (2 * t + 1) ** 2 / t * (ratio - 1)
        + t
        - jnp.sqrt(t * floor * (1 + t))
        - (2 + 1 / (2 * t)) * jnp.log(ratio)
    ) * jnp.sqrt(1 + t)


def _both(ring: Ring, optics: Optics) -> tuple[Array, ...]:
    """Emittance, beta, alpha, dispersion and its slope at one point, (x, y) each."""
    emittance = jnp.stack([ring.emittance_x, ring.emittance_y])
    return emittance, *jnp.reshape(jnp.stack(optics[1:]), (4, 2))


def _width_coefficients(ring: Ring, optics: Optics) -> tuple[Array, Array]:
    """B1 and B1² - B2² of Piwinski's equations 33 and 34, at one point of the ring."""
    emittance, beta, alpha, dispersion, slope = _both(ring, optics)
    tilt, size2 = alpha * dispersion + beta * slope, emittance * beta
    spread2 = 1 / (ring.energy_spread**-2 + jnp.sum((dispersion**2 + tilt**2) / size2))
    x, y = beta / emittance * (1 - tilt**2 * spread2 / size2)
    coupled = spread2 * tilt[0] * tilt[1] / (emittance[0] * emittance[1])
    scale = ring.relativistic_gamma**2 - 1
    # B1² - B2² from the product: the difference of two near-equal squares loses all digits
    # in a flat beam.
    return (x + y) / (2 * scale), (x * y - coupled**2) / scale**2


def piwinski_shape(floor: Array, b1: Array, gap: Array, nodes: int = 64) -> Array:
    """Piwinski's F(tau_m, B1, B2): the momentum-transfer integral at one point of the ring.

    Parameters
    ----------
    floor : float
        tau_m = beta² delta² with the momentum acceptance delta.
    b1 : float
        B1.
    gap : float
        B1² - B2², positive.
    nodes : int, optional
        Gauss-Legendre nodes in ln kappa: 32 give 1e-5, 64 give 2e-9.

    Returns
    -------
    float
        2 sqrt(pi (B1² - B2²)) times the integral over kappa from arctan(sqrt(tau_m)) to pi/2.

    Notes
    -----
    A. Piwinski, DESY 98-179 (1998), equation 42, without the factor ln 2 that some codes put in.

    Examples
    --------
    >>> f"{piwinski_shape(9e-4, 10.0, 19.0) * 9e-4:.3f}"
    '6.938'
    """
    roots, weights = np.polynomial.legendre.leggauss(nodes)
    lower, upper = jnp.log(jnp.arctan(jnp.sqrt(floor))), jnp.log(jnp.pi / 2)
    log_kappa = lower + (upper - lower) * (roots + 1) / 2
    t = jnp.tan(jnp.exp(log_kappa)) ** 2
    # B2 = 0 in a round beam, where the square root has no derivative but the integral,
    # even in B2, has a zero one.
    squared = jnp.maximum(b1**2 - gap, (1e-8 * b1) ** 2)
    b2 = jnp.sqrt(squared)
    decay = jnp.exp(-gap / (b1 + b2) * t) * i0e(b2 * t)
    integrand = _spectrum(log_kappa, floor) * decay * jnp.exp(log_kappa)
    integral = (upper - lower) / 2 * jnp.sum(weights * integrand)
    # Far beyond the bunch's momenta the integrals of both signs cancel to rounding.
    return 2 * jnp.sqrt(jnp.pi * gap) * jnp.maximum(integral, 0.0)


def _volume(ring: Ring, optics: Optics) -> Array:
    """sqrt(sigma_x² sigma_y² - sigma_delta⁴ D_x² D_y²): the bunch's transverse area, m²."""
    emittance, beta, _, dispersion, _ = _both(ring, optics)
    spread = ring.energy_spread * dispersion
    x, y = emittance * beta + spread**2
    return jnp.sqrt(x * y - (spread[0] * spread[1]) ** 2)


@partial(jax.jit, static_argnames="nodes")
def piwinski_rate(
    ring: Ring, population: Array, length: Array, acceptance: Array, nodes: int = 64
) -> Array:
    """Touschek loss rate of one bunch, averaged over the ring, 1/s.

    Parameters
    ----------
    ring : Ring
        The ring; its `momentum_acceptance` is not used here.
    population : float
        Electrons in the bunch.
    length : float
        Rms bunch length, m.
    acceptance : float or array, shape (n,) or (2, n)
        Momentum acceptance, at each point of the ring's optics if it is an array; up and down if
        it is two.
    nodes : int, optional
        Quadrature nodes.

    Returns
    -------
    float
        1/tau_T at this population: the relative loss rate, half of which is due to each of the
        two electrons that scatter, one up and one down: the mean of both sides where they differ.

    Notes
    -----
    A. Piwinski, DESY 98-179 (1998), equations 31 to 42: any beam-size ratio, dispersion in both
    planes, relativistic transverse momenta.

    Examples
    --------
    >>> import numpy as np
    >>> from beamfit.lifetime.ring import Optics, Ring
    >>> point = Optics(*np.array([[1.0], [7], [9], [0], [0], [0.06], [0], [0], [0]]))
    >>> ring = Ring(3e9, 234.144, 372, 1.187e-3, 8.78e5, 9.54e-4, 1.8e-8, 3.6e-11, 0.03,
    ...             1e-5, 10.0, 5.3e-3, 3e-3, 0.0, point)
    >>> f"{1 / piwinski_rate(ring, 8.7e9, 4.97e-3, 0.03) / 3600:.1f} h"
    '35.1 h'
    """
    if jnp.ndim(acceptance) == 2:
        sides = jax.vmap(lambda side: piwinski_rate(ring, population, length, side, nodes))
        return jnp.mean(sides(jnp.asarray(acceptance)))
    lorentz = ring.relativistic_gamma
    acceptance = jnp.broadcast_to(acceptance, ring.optics.weight.shape)

    def local(optics: Optics, acceptance: Array) -> Array:
        b1, gap = _width_coefficients(ring, optics)
        floor = (1 - lorentz**-2) * acceptance**2
        return piwinski_shape(floor, b1, gap, nodes) / _volume(ring, optics)

    density = jax.vmap(local)(ring.optics, acceptance)
    scale = ELECTRON_RADIUS**2 * constants.c * population / (8 * jnp.pi * lorentz**2 * length)
    return scale * ring.optics.average(density)


def touschek_loss(ring: Ring, operation: Operation, current: Array) -> Array:
    """Touschek part of a, 1/(mA s)."""
    bunch = stored_bunch(ring, operation, current)
    # The rate is proportional to the population, so one milliampere in the ring gives a itself.
    single = population(ring, 1 / operation.bunches)
    return piwinski_rate(ring, single, bunch.length, bunch.acceptance)


def touschek_shape(ring: Ring, operation: Operation) -> Callable[[Array], Array]:
    """Relative Touschek part of a as a function of beam current, through bunch lengthening.

    Parameters
    ----------
    ring : Ring
        The ring, with its impedance.
    operation : Operation
        RF voltage, bunches, and what else is known of their length.

    Returns
    -------
    callable
        Current in mA to a_T relative to that at zero current; for `fit_decay`'s `shape`.

    Examples
    --------
    >>> from beamfit.io.ring import read_operation, read_ring
    >>> ring = read_ring("lattices/spear3_2003.toml")._replace(impedance=0.4)
    >>> shape = touschek_shape(ring, read_operation("lattices/spear3_2003.toml"))
    >>> print(f"{shape(500.0):.4f}")
    0.9085
    """

    def shape(current: Array) -> Array:
        natural = stored_bunch(ring, operation, 0.0).length
        return natural / stored_bunch(ring, operation, current).length

    return shape
