"""RF acceptance, synchrotron tune and bunch length: what the RF voltage does to the bunch."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

__all__ = [
    "bunch_length",
    "equal_bunches",
    "lengthening",
    "quantum_rate",
    "rf_acceptance",
    "synchrotron_tune",
]


def rf_acceptance(
    voltage: Array, energy: Array, energy_loss: Array, compaction: Array, harmonic: Array
) -> Array:
    """Half height of the RF bucket in relative momentum.

    Parameters
    ----------
    voltage, energy, energy_loss : float
        Peak RF voltage V, beam energy and energy loss per turn U0, all in eV (or V).
    compaction : float
        Momentum compaction factor.
    harmonic : float
        Harmonic number.

    Returns
    -------
    float
        Acceptance; NaN where the voltage does not exceed the loss: no beam is stored there.

    Notes
    -----
    delta² = 2 U0/(pi alpha_c h E0) (sqrt(q² - 1) - arccos(1/q)), q = V/U0: M. Sands, SLAC-121
    (1970), section 3.4.

    Examples
    --------
    >>> f"{rf_acceptance(3.2e6, 3e9, 877974.1, 1.187169e-3, 372):.5f}"
    '0.03055'
    """
    overvoltage = voltage / energy_loss
    bucket = jnp.sqrt(overvoltage**2 - 1) - jnp.arccos(1 / overvoltage)
    return jnp.sqrt(2 * energy_loss / (jnp.pi * compaction * harmonic * energy) * bucket)


def synchrotron_tune(
    voltage: Array, energy: Array, energy_loss: Array, compaction: Array, harmonic: Array
) -> Array:
    """Synchrotron oscillations per turn at small amplitude.

    Parameters
    ----------
    voltage, energy, energy_loss, compaction, harmonic : float
        As for `rf_acceptance`.

    Returns
    -------
    float
        Synchrotron tune; NaN where no beam is stored.

    Notes
    -----
    nu² = alpha_c h sqrt(V² - U0²)/(2 pi E0): M. Sands, SLAC-121 (1970), section 3.3.

    Examples
    --------
    >>> f"{synchrotron_tune(3.2e6, 3e9, 877974.1, 1.187169e-3, 372):.5f}"
    '0.00849'
    """
    slope = jnp.sqrt(voltage**2 - energy_loss**2)
    return jnp.sqrt(compaction * harmonic * slope / (2 * jnp.pi * energy))


def bunch_length(
    tune: Array, circumference: Array, compaction: Array, energy_spread: Array
) -> Array:
    """Rms bunch length at zero current, m.

    Parameters
    ----------
    tune : float
        Synchrotron tune.
    circumference : float
        Circumference, m.
    compaction : float
        Momentum compaction factor.
    energy_spread : float
        Relative rms energy spread.

    Returns
    -------
    float
        sigma_z0 = alpha_c C sigma_delta/(2 pi nu_s), m: M. Sands, SLAC-121 (1970), section 5.5.

    Examples
    --------
    >>> f"{bunch_length(8.490926e-3, 234.144, 1.187169e-3, 9.542469e-4):.6f}"
    '0.004972'
    """
    return compaction * circumference * energy_spread / (2 * jnp.pi * tune)


def lengthening(strength: Array) -> Array:
    """Bunch length over its zero-current value, by potential-well distortion.

    Parameters
    ----------
    strength : float
        Right-hand side of x³ - x = strength, not negative: (sqrt(pi)/2) I_b abs(Z/n) /
        (h sqrt(V² - U0²) (alpha_c sigma_delta/nu_s)³) with the bunch current I_b in A.

    Returns
    -------
    float
        The root x >= 1. The derivative is exact everywhere, also at zero.

    Notes
    -----
    Zotter's cubic for a purely inductive impedance, as pyAT and pyaccel solve it: B. Zotter,
    CERN SPS/81-14 (1981).

    Examples
    --------
    >>> [round(float(lengthening(s)), 6) for s in (0.0, 6.0)]
    [1.0, 2.0]
    """
    # Both bounds lie above the root, from where Newton's method falls to it without overshoot.
    # Cut off from differentiation, or the cube root's infinite slope at zero would enter.
    fixed = jax.lax.stop_gradient(strength)
    ratio = jnp.minimum(1 + fixed / 2, 1 + jnp.cbrt(fixed))
    for _ in range(8):
        ratio = ratio - (ratio**3 - ratio - strength) / (3 * ratio**2 - 1)
    return ratio


def quantum_rate(acceptance: Array, emittance: Array, damping_time: Array) -> Array:
    """Loss rate from quantum fluctuations against an acceptance in one plane, 1/s.

    Parameters
    ----------
    acceptance : float
        Transverse acceptance, m rad (for the energy plane the square of the relative acceptance).
    emittance : float
        Emittance, m rad (for the energy plane the square of the energy spread).
    damping_time : float
        Amplitude damping time of the plane, s.

    Returns
    -------
    float
        1/tau_q = 2 xi exp(-xi)/tau_d with xi = A/(2 emittance): M. Sands, SLAC-121 (1970),
        section 5.8.

    Examples
    --------
    >>> f"{1 / quantum_rate(30.0, 1.0, 5e-3):.0f}"
    '545'
    """
    xi = acceptance / (2 * emittance)
    return 2 * xi * jnp.exp(-xi) / damping_time


def equal_bunches(bunch_currents: Array) -> Array:
    """Number of equal bunches with the Touschek loss of a fill pattern.

    Parameters
    ----------
    bunch_currents : array, shape (buckets,)
        Current of each bucket in any unit; empty ones are zero.

    Returns
    -------
    float
        (sum I)² / sum I²: between one and the number of filled buckets. It is what `bunches` of a
        ring, a record or an operating point stands for.

    Notes
    -----
    A bunch loses in proportion to the square of its current (report equation 42), so the ring
    loses (sum I²) / (sum I) of its current where equal bunches would lose I / M. Exact as long as
    the bunches do not lengthen with their current.

    Examples
    --------
    One camshaft bunch of 20 mA beside 240 bunches of 2 mA counts as much as 184 equal ones.

    >>> print(f"{equal_bunches([2.0] * 240 + [20.0]):.1f}")
    183.8
    """
    currents = jnp.asarray(bunch_currents, float)
    return jnp.sum(currents) ** 2 / jnp.sum(currents**2)
