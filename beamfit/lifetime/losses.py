"""From a ring and its settings to the parameters a and b of the decay, mechanism by mechanism."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from scipy import constants

from beamfit.errors import InputError
from beamfit.lifetime.bunch import (
    bunch_length,
    lengthening,
    quantum_rate,
    rf_acceptance,
    synchrotron_tune,
)
from beamfit.lifetime.gas import (
    bremsstrahlung_cross_section,
    elastic_cross_section,
    gas_rate_coefficient,
    vertical_acceptance,
)
from beamfit.lifetime.ring import Operation, Ring
from beamfit.lifetime.touschek import piwinski_rate

__all__ = [
    "Bunch",
    "Losses",
    "bunch_in_bucket",
    "loss_coefficients",
    "population",
    "touschek_shape",
]


class Losses(NamedTuple):
    """Loss coefficients of dI/dt = -a I² - b I, mechanism by mechanism.

    Attributes
    ----------
    a_touschek, a_bremsstrahlung, a_elastic : float
        Parts of a, 1/(mA s); the gas parts come from the pressure that the beam itself desorbs.
    b_bremsstrahlung, b_elastic, b_quantum : float
        Parts of b, 1/s.
    """

    a_touschek: jax.Array
    a_bremsstrahlung: jax.Array
    a_elastic: jax.Array
    b_bremsstrahlung: jax.Array
    b_elastic: jax.Array
    b_quantum: jax.Array

    @property
    def a(self) -> Array:
        """All that grows with the square of the current, 1/(mA s)."""
        return self.a_touschek + self.a_bremsstrahlung + self.a_elastic

    @property
    def b(self) -> Array:
        """All that is proportional to the current, 1/s."""
        return self.b_bremsstrahlung + self.b_elastic + self.b_quantum


class Bunch(NamedTuple):
    """The bunch that a bucket holds.

    Attributes
    ----------
    length : float
        Rms length, m.
    acceptance : float or array, shape (n,)
        Momentum acceptance of bucket and lattice together, relative.
    """

    length: jax.Array
    acceptance: jax.Array


def population(ring: Ring, bunch_current: Array) -> Array:
    """Electrons in a bunch of the given current, mA.

    Parameters
    ----------
    ring : Ring
        The ring.
    bunch_current : float
        Current of one bunch, mA.

    Returns
    -------
    float
        I_b C/(e c).

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> print(f"{population(SimpleNamespace(circumference=234.144), 500 / 280):.3e}")
    8.705e+09
    """
    return bunch_current * 1e-3 * ring.circumference / (constants.e * constants.c)


def bunch_in_bucket(ring: Ring, voltage: Array, bunch_current: Array) -> Bunch:
    """Length and momentum acceptance of a bunch at an RF voltage and bunch current.

    Parameters
    ----------
    ring : Ring
        The ring.
    voltage : float
        RF voltage, V.
    bunch_current : float
        Current of one bunch, mA; it lengthens the bunch if the ring has an impedance.

    Returns
    -------
    Bunch
        Length and acceptance min(delta_RF, delta_lattice).

    Examples
    --------
    >>> from beamfit.io.ring import read_ring
    >>> bunch = bunch_in_bucket(read_ring("lattices/spear3_2003.toml"), 3.2e6, 0.0)
    >>> print(f"{1e3 * bunch.length:.3f} mm, {100 * bunch.acceptance:.1f} %")
    4.972 mm, 3.0 %
    """
    bucket = (voltage, ring.energy, ring.energy_loss, ring.momentum_compaction, ring.harmonic)
    tune = synchrotron_tune(*bucket)
    natural = bunch_length(tune, ring.circumference, ring.momentum_compaction, ring.energy_spread)
    slope = jnp.sqrt(voltage**2 - ring.energy_loss**2)
    phase_spread = ring.momentum_compaction * ring.energy_spread / tune
    strength = jnp.sqrt(jnp.pi) / 2 * bunch_current * 1e-3 * ring.impedance
    ratio = lengthening(strength / (ring.harmonic * slope * phase_spread**3))
    return Bunch(natural * ratio, jnp.minimum(rf_acceptance(*bucket), ring.momentum_acceptance))


@jax.jit
def _coefficients(ring: Ring, operation: Operation, current: Array) -> Losses:
    bunch_current = current / operation.bunches
    bunch = bunch_in_bucket(ring, operation.rf_voltage, bunch_current)
    # The rate is proportional to the population, so one milliampere in the ring gives a itself.
    single = population(ring, 1 / operation.bunches)
    touschek = piwinski_rate(ring, single, bunch.length, bunch.acceptance)

    chamber = vertical_acceptance(ring.acceptance_y, operation.scraper_y, ring.scraper_beta_y)
    mean_beta = ring.optics.average(ring.optics.beta_y)
    charge = operation.gas.charge
    deflected = elastic_cross_section(charge, ring.relativistic_gamma, mean_beta, chamber)
    elastic = gas_rate_coefficient(deflected, operation.gas, operation.temperature)

    points = jnp.broadcast_to(bunch.acceptance, ring.optics.weight.shape)
    radiated = jax.vmap(lambda point: bremsstrahlung_cross_section(charge, point))(points)
    slowed = ring.optics.weight @ radiated
    radiative = gas_rate_coefficient(slowed, operation.gas, operation.temperature)

    energy_limit = ring.optics.average(points) ** 2
    quantum = quantum_rate(chamber, ring.emittance_y, ring.damping_time_y) + quantum_rate(
        energy_limit, ring.energy_spread**2, ring.damping_time_z
    )
    rise, base = operation.pressure_slope, operation.pressure_base
    return Losses(
        a_touschek=touschek,
        a_bremsstrahlung=rise * radiative,
        a_elastic=rise * elastic,
        b_bremsstrahlung=base * radiative,
        b_elastic=base * elastic,
        b_quantum=quantum,
    )


def loss_coefficients(ring: Ring, operation: Operation, current: float | Array) -> Losses:
    """Loss coefficients of a ring at its settings, from first principles.

    Parameters
    ----------
    ring : Ring
        The ring.
    operation : Operation
        Settings and vacuum.
    current : float
        Beam current, mA. It matters only through bunch lengthening: without an impedance the
        coefficients do not depend on it.

    Returns
    -------
    Losses
        a_T, a_B, a_C, b_B, b_C and the quantum loss. Differentiable in every argument.

    Raises
    ------
    InputError
        If the RF voltage does not exceed the energy loss per turn: no beam is stored. Under a
        JAX transformation, where the value is not known, the result is NaN instead.

    Notes
    -----
    With P = P0 + P1 I the gas gives b = K P0 and a = K P1 (report section 3.4.2).

    Examples
    --------
    >>> from beamfit.io.ring import read_operation, read_ring
    >>> ring = read_ring("lattices/spear3_2003.toml")
    >>> losses = loss_coefficients(ring, read_operation("lattices/spear3_2003.toml"), 500.0)
    >>> print(f"Touschek alone: {1 / (losses.a_touschek * 500 * 3600):.1f} h")
    Touschek alone: 30.4 h
    """
    voltage, loss = operation.rf_voltage, ring.energy_loss
    known = not isinstance(voltage, jax.core.Tracer) and not isinstance(loss, jax.core.Tracer)
    if known and bool(jnp.any(jnp.asarray(voltage) <= loss)):
        raise InputError(
            f"RF voltage {float(jnp.min(voltage)) / 1e3:.6g} kV",
            f"more than the loss of {float(loss) / 1e3:.6g} kV a turn, or no beam is stored",
            column="rf_voltage_kV",
        )
    return _coefficients(ring, operation, jnp.asarray(current, float))


def touschek_shape(ring: Ring, operation: Operation) -> Callable[[Array], Array]:
    """How the Touschek part of a depends on the beam current through bunch lengthening.

    Parameters
    ----------
    ring : Ring
        The ring, with its impedance.
    operation : Operation
        RF voltage and number of bunches.

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
        bunch_current = current / operation.bunches
        natural = bunch_in_bucket(ring, operation.rf_voltage, 0.0).length
        return natural / bunch_in_bucket(ring, operation.rf_voltage, bunch_current).length

    return shape
