"""Storage ring, its settings, and the bunch in its RF bucket: plain values, pytrees for JAX."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy import constants

from beamfit.answer import shown
from beamfit.compile_cache import prepare_jax
from beamfit.particles import REST_ENERGY

prepare_jax()

# Largest relative momentum acceptance: an electron cannot lose more than its momentum.
MAX_ACCEPTANCE = 0.99
# Classical electron radius, m.
ELECTRON_RADIUS = constants.physical_constants["classical electron radius"][0]

# Molecules of residual-gas spectra of electron rings: number of atoms by atomic number.
MOLECULES = {
    "H2": {1: 2},
    "He": {2: 1},
    "CH4": {6: 1, 1: 4},
    "H2O": {8: 1, 1: 2},
    "Ne": {10: 1},
    "N2": {7: 2},
    "CO": {6: 1, 8: 1},
    "O2": {8: 2},
    "Ar": {18: 1},
    "CO2": {6: 1, 8: 2},
}


@shown
class Optics(NamedTuple):
    """Optical functions at points along the ring, each with its share of the circumference.

    A single point with ring averages is valid, as are thousands of slices.

    Attributes
    ----------
    weight : array, shape (n,)
        Share of the circumference; the weights sum to 1.
    beta_x, beta_y : array, shape (n,)
        Twiss beta, m.
    alpha_x, alpha_y : array, shape (n,)
        Twiss alpha.
    dispersion_x, dispersion_y : array, shape (n,)
        Dispersion, m.
    slope_x, slope_y : array, shape (n,)
        Derivative of the dispersion along the ring.
    """

    weight: jax.Array
    beta_x: jax.Array
    beta_y: jax.Array
    alpha_x: jax.Array
    alpha_y: jax.Array
    dispersion_x: jax.Array
    dispersion_y: jax.Array
    slope_x: jax.Array
    slope_y: jax.Array

    def average(self, values: jax.Array) -> jax.Array:
        """Average of a quantity over the ring, from its value at each point."""
        return jnp.sum(self.weight * values)


@shown
class Ring(NamedTuple):
    """Parameters of a storage ring that determine its beam losses.

    Attributes
    ----------
    energy : float
        Beam energy, eV.
    circumference : float
        Circumference, m.
    harmonic : float
        Harmonic number.
    momentum_compaction : float
        Momentum compaction factor.
    energy_loss : float
        Energy radiated in one turn, eV.
    energy_spread : float
        Relative rms energy spread.
    emittance_x, emittance_y : float
        Emittances, m rad.
    momentum_acceptance : float or array, shape (n,) or (2, n)
        Relative momentum acceptance of the lattice without RF, for positive and negative
        deviations if they differ; infinite if only the RF limits it.
    acceptance_y : float
        Vertical acceptance of the chamber, m rad; infinite if only the scraper limits it.
    scraper_beta_y : float
        Vertical Twiss beta at the scraper, m.
    damping_time_y, damping_time_z : float
        Amplitude damping times of the vertical plane and of energy, s; infinite to leave the
        quantum lifetime out.
    impedance : float
        Longitudinal broad-band impedance abs(Z/n), ohm; 0 for a bunch that does not lengthen.
    optics : Optics
        Optical functions along the ring.
    acceptance_x : float
        Horizontal acceptance, m rad; infinite to leave horizontal gas losses out.

    Notes
    -----
    Emittances and energy spread are those of the stored beam: intrabeam scattering is not computed.
    """

    energy: jax.Array
    circumference: jax.Array
    harmonic: jax.Array
    momentum_compaction: jax.Array
    energy_loss: jax.Array
    energy_spread: jax.Array
    emittance_x: jax.Array
    emittance_y: jax.Array
    momentum_acceptance: jax.Array
    acceptance_y: jax.Array
    scraper_beta_y: jax.Array
    damping_time_y: jax.Array
    damping_time_z: jax.Array
    impedance: jax.Array
    optics: Optics
    acceptance_x: jax.Array = np.inf

    @property
    def relativistic_gamma(self) -> jax.Array:
        """Energy over rest energy."""
        return self.energy / (1e6 * REST_ENERGY["electron"])


@shown
class Gas(NamedTuple):
    """Composition of the residual gas by element.

    Attributes
    ----------
    charge : array, shape (k,)
        Atomic number.
    atoms : array, shape (k,)
        Number of atoms of the element per molecule of the mixture.
    """

    charge: jax.Array
    atoms: jax.Array


@shown
class HarmonicCavity(NamedTuple):
    """Cavity at a harmonic of the main RF.

    Attributes
    ----------
    number : float
        Frequency over that of the main RF.
    voltage : float
        Peak voltage, V.
    phase : float
        Phase at the bunch, rad: the bunch gains voltage sin(phase). 0 is the zero crossing that
        lengthens the bunch, pi the one that shortens it. In a cavity without generator the bunch
        loses energy: the sine is negative.
    """

    number: jax.Array
    voltage: jax.Array
    phase: jax.Array


@shown
class MeasuredLength(NamedTuple):
    """Measured bunch length, which is used as it is.

    Attributes
    ----------
    current : array, shape (k,)
        Bunch currents, mA, rising.
    length : array, shape (k,)
        Rms length at each, m; linear in between and constant below.
    exponent : float
        Exponent of the growth with current above the last of them.
    voltage : float
        RF voltage of the measurement, V; at other voltages the length scales as that at zero
        current.
    """

    current: jax.Array
    length: jax.Array
    exponent: jax.Array
    voltage: jax.Array


@shown
class Operation(NamedTuple):
    """Settings of an operator, and the vacuum.

    Attributes
    ----------
    rf_voltage : float
        Sum of the peak RF voltages, V.
    scraper_y : float
        Distance from the beam to the nearer vertical scraper jaw, m; infinite if there is none.
    bunches : float
        Number of equal bunches, or of equal bunches with the same Touschek loss.
    pressure_base : float
        Pressure without beam, Pa.
    pressure_slope : float
        Rise of the pressure with beam current, Pa/mA.
    temperature : float
        Temperature of the gas, K.
    gas : Gas
        Composition of the residual gas.
    fill : array, shape (k,)
        Charge of each bunch in units of one of `bunches` equal bunches; their charge-weighted mean
        is 1.
    bunch_length : MeasuredLength or None
        Measured length; None to compute it.
    harmonic_cavity : HarmonicCavity or None
        Second RF system.
    stretch : float
        Factor by which a second RF system lengthens the bunch, where only that is known.
    """

    rf_voltage: jax.Array
    scraper_y: jax.Array
    bunches: jax.Array
    pressure_base: jax.Array
    pressure_slope: jax.Array
    temperature: jax.Array
    gas: Gas
    fill: jax.Array = np.ones(1)
    bunch_length: MeasuredLength | None = None
    harmonic_cavity: HarmonicCavity | None = None
    stretch: jax.Array = 1.0


def required_voltage(operation: Operation, energy_loss: float, energy: float) -> str | None:
    """Requirement on the RF voltage, in words, if it stores no beam; None if it does.

    The main RF must give the energy loss per turn, less the gain in a harmonic cavity. Energy loss
    and energy are in eV.
    """
    cavity, voltage = operation.harmonic_cavity, np.asarray(operation.rf_voltage)
    gain = 0.0 if cavity is None else cavity.voltage * np.sin(cavity.phase)
    if (voltage <= energy_loss - gain).any():
        lost = f"{float(energy_loss - gain) / 1e3:.6g} kV a turn"
        return f"more than the loss of {lost}, or no beam is stored"
    if (voltage > energy).any():
        return f"less than the beam's energy, {float(energy) / 1e6:.6g} MeV; check the unit"
    return None


def gas_mixture(**fractions: float) -> Gas:
    """Residual gas from partial pressures of molecules.

    Parameters
    ----------
    **fractions : float
        Partial pressures of H2, He, CH4, H2O, Ne, N2, CO, O2, Ar, CO2 in any common unit.

    Returns
    -------
    Gas
        Elements, with the number of their atoms per molecule of the mixture.

    Raises
    ------
    ValueError
        If a molecule is unknown, a fraction is negative, or all are zero.

    Examples
    --------
    >>> gas = gas_mixture(H2=3, CO=1)
    >>> gas.charge.tolist(), gas.atoms.tolist()
    ([1.0, 6.0, 8.0], [1.5, 0.25, 0.25])
    """
    unknown = set(fractions) - set(MOLECULES)
    if unknown:
        raise ValueError(f"unknown gas {sorted(unknown)[0]}; known are {', '.join(MOLECULES)}")
    total = sum(fractions.values())
    if min(fractions.values(), default=0.0) < 0 or not total > 0:
        raise ValueError("partial pressures must not be negative and not all zero")
    atoms: dict[int, float] = {}
    for molecule, fraction in fractions.items():
        for charge, number in MOLECULES[molecule].items():
            atoms[charge] = atoms.get(charge, 0.0) + number * fraction / total
    charges = sorted(atoms)
    return Gas(np.array(charges, float), np.array([atoms[charge] for charge in charges]))


class Bunch(NamedTuple):
    """Bunch in an RF bucket.

    Attributes
    ----------
    length : float
        Rms length, m.
    acceptance : float or array, shape (n,) or (2, n)
        Relative momentum acceptance of bucket and lattice together, for positive and negative
        deviations if they differ.
    """

    length: jax.Array
    acceptance: jax.Array


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
    # Both upper bounds lie above the root, from where Newton's method converges monotonically.
    # They are not differentiated: the cube root has an infinite slope at zero.
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
    # Limited against overflow, as without an aperture; the loss is zero in floating point.
    xi = jnp.minimum(acceptance / (2 * emittance), 700.0)
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
        (sum I)² / sum I²: between one and the number of filled buckets. This is the meaning of
        `bunches` in a ring, a record or an operating point.

    Notes
    -----
    The Touschek loss of a bunch goes with the square of its current (report equation 42), so the
    ring loses in proportion to sum I², and M equal bunches to (sum I)²/M. Exact as long as the
    bunches do not lengthen with their current.

    Examples
    --------
    One camshaft bunch of 20 mA and 240 bunches of 2 mA lose as much as 184 equal bunches.

    >>> print(f"{equal_bunches([2.0] * 240 + [20.0]):.1f}")
    183.8
    """
    currents = jnp.asarray(bunch_currents, float)
    return jnp.sum(currents) ** 2 / jnp.sum(currents**2)


def population(ring: Ring, bunch_current: Array) -> Array:
    """Number of electrons in a bunch.

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


def bunch_in_bucket(
    ring: Ring, voltage: Array, bunch_current: Array, stretch: Array = 1.0
) -> Bunch:
    """Length and momentum acceptance of a bunch at an RF voltage and bunch current.

    Parameters
    ----------
    ring : Ring
        The ring.
    voltage : float
        RF voltage, V.
    bunch_current : float
        Current of one bunch, mA; it lengthens the bunch if the ring has an impedance.
    stretch : float, optional
        Factor by which a second RF system lengthens the bunch. The effect of the impedance is that
        in a linear bucket of this length, which is weaker by the same factor.

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
    ratio = lengthening(strength / (ring.harmonic * slope * phase_spread**3 * stretch))
    length = natural * stretch * ratio
    return Bunch(length, limit_acceptance(ring, rf_acceptance(*bucket)))


def limit_acceptance(ring: Ring, height: Array) -> Array:
    """Momentum acceptance of a bucket of this height and of the lattice together."""
    return jnp.minimum(jnp.minimum(height, MAX_ACCEPTANCE), ring.momentum_acceptance)


@jax.jit
def stored_bunch(ring: Ring, operation: Operation, current: Array) -> Bunch:
    """Bunch that represents all bunches of a beam.

    Its length is that of equal bunches with the same Touschek loss, which goes with charge squared
    over length. The current, mA, may be an array.
    """
    voltage, charge = operation.rf_voltage, jnp.asarray(operation.fill, float)
    bunch_current = jnp.asarray(current, float)[..., None] * charge / operation.bunches
    natural = bunch_in_bucket(ring, voltage, 0.0)
    acceptance, stretch = natural.acceptance, operation.stretch
    if operation.harmonic_cavity is not None:
        length, height = length_and_height(ring, voltage, operation.harmonic_cavity)
        acceptance = limit_acceptance(ring, height)
        stretch = length / natural.length
    if (measured := operation.bunch_length) is None:
        lengths = bunch_in_bucket(ring, voltage, bunch_current, stretch).length
    else:
        natural_then = bunch_in_bucket(ring, measured.voltage, 0.0).length
        growth = jnp.maximum(bunch_current / measured.current[-1], 1.0) ** measured.exponent
        lengths = jnp.interp(bunch_current, measured.current, measured.length) * growth
        lengths = lengths * natural.length / natural_then
    weight = charge**2 / jnp.sum(charge)
    return Bunch(1 / jnp.sum(weight / lengths, axis=-1), acceptance)


def acceptance_by_sign(ring: Ring, acceptance: Array) -> Array:
    """Momentum acceptance at every point for positive and negative deviations, shape (2, n)."""
    return jnp.broadcast_to(acceptance, (2, ring.optics.weight.size))


def vertical_acceptance(chamber: Array, scraper: Array, scraper_beta_y: Array) -> Array:
    """Vertical acceptance left by chamber and scraper, m rad.

    Parameters
    ----------
    chamber : float
        Acceptance of the chamber, m rad.
    scraper : float
        Distance from the beam to the scraper jaw, m.
    scraper_beta_y : float
        Twiss beta at the scraper, m.

    Returns
    -------
    float
        min(chamber, scraper²/beta).

    Examples
    --------
    >>> print(f"{vertical_acceptance(4e-6, 3e-3, 10.0):.1e}")
    9.0e-07
    """
    return jnp.minimum(chamber, scraper**2 / scraper_beta_y)


def quantum_loss(ring: Ring, operation: Operation, current: Array) -> Array:
    """Loss rate from quantum fluctuations in the vertical plane and in energy, 1/s."""
    aperture = vertical_acceptance(ring.acceptance_y, operation.scraper_y, ring.scraper_beta_y)
    sides = acceptance_by_sign(ring, stored_bunch(ring, operation, current).acceptance)
    energy = ring.optics.average(jnp.min(sides, axis=0)) ** 2
    return quantum_rate(aperture, ring.emittance_y, ring.damping_time_y) + quantum_rate(
        energy, ring.energy_spread**2, ring.damping_time_z
    )


def length_and_height(ring: Ring, voltage: Array, cavity: HarmonicCavity) -> tuple[Array, Array]:
    """Rms bunch length and bucket height at zero current in a main and a harmonic RF system.

    Parameters
    ----------
    ring : Ring
        The ring; its `momentum_acceptance` and impedance are not used.
    voltage : float
        Peak voltage of the main RF, V.
    cavity : HarmonicCavity
        Second RF system.

    Returns
    -------
    length, height : float
        Rms length, m, and momentum acceptance of the bucket; NaN where no beam is stored.

    Notes
    -----
    The energy spread is Gaussian, whatever the potential well, so the density along the bunch is
    exp(W/(2 pi h alpha_c sigma_delta² E0)) with W the integral of V1 sin(phi_1 + phi) +
    V_h sin(phi_h + n phi) - U0 over the RF phase phi: J. Haissinski, Nuovo Cimento 18B (1973) 72;
    A. Hofmann and S. Myers, CERN ISR-TH-RF/80-26 (1980). The density has a minimum on either side
    of the bunch; the bucket ends at the higher minimum.

    Examples
    --------
    A third-harmonic cavity without generator, near the flat potential:

    >>> from beamfit.io.ring import read_ring
    >>> from beamfit.lifetime.ring import HarmonicCavity
    >>> ring = read_ring("lattices/spear3_2003.toml")
    >>> length, _ = length_and_height(ring, 3.2e6, HarmonicCavity(3, 1.01e6, -0.11))
    >>> print(f"{1e3 * length:.1f} mm")
    16.7 mm
    """
    # Phases in half widths of the main RF's bucket, a quarter beyond it, fifty times denser at the
    # bunch than on average; `spacing` is the quadrature weight.
    uniform = np.linspace(-1.0, 1.0, 4097)
    phases, spacing = 1.25 * uniform * (0.02 + 0.98 * uniform**2), 0.02 + 3 * 0.98 * uniform**2
    number, loss = cavity.number, ring.energy_loss
    main = jnp.pi - jnp.arcsin((loss - cavity.voltage * jnp.sin(cavity.phase)) / voltage)
    phase = phases * (2 * main - jnp.pi)
    work = (
        voltage * (jnp.cos(main) - jnp.cos(main + phase))
        + cavity.voltage / number * (jnp.cos(cavity.phase) - jnp.cos(cavity.phase + number * phase))
        - loss * phase
    )
    spread = ring.momentum_compaction * ring.energy_spread**2 * ring.energy
    log = work / (2 * jnp.pi * ring.harmonic * spread)
    middle = phases.size // 2
    ends = jnp.argmin(log[:middle]), middle + jnp.argmin(log[middle:])
    in_bucket = (jnp.arange(phases.size) >= ends[0]) & (jnp.arange(phases.size) <= ends[1])
    highest = jnp.max(jnp.where(in_bucket, log, -jnp.inf))
    density = spacing * jnp.where(in_bucket, jnp.exp(jnp.where(in_bucket, log - highest, 0.0)), 0.0)
    mean = jnp.average(phase, weights=density)
    rms = jnp.sqrt(jnp.average((phase - mean) ** 2, weights=density))
    depth = highest - jnp.maximum(log[ends[0]], log[ends[1]])
    length = rms * ring.circumference / (2 * jnp.pi * ring.harmonic)
    return length, ring.energy_spread * jnp.sqrt(2 * depth)
