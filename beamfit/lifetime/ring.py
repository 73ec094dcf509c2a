"""A storage ring as its loss mechanisms need it: plain values, pytrees for JAX."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy import constants

from beamfit.answer import shown
from beamfit.compile_cache import prepare_jax
from beamfit.particles import REST_ENERGY

prepare_jax()

# Rest energy of the electron, eV.
ELECTRON_MASS_EV = 1e6 * REST_ENERGY["electron"]
ELECTRON_RADIUS = constants.physical_constants["classical electron radius"][0]

# Atoms in a molecule: the gases of an electron ring's residual-gas spectra.
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
    """Optical functions at points along the ring, and the share of the ring each stands for.

    One point with ring averages is as good a value as thousands of slices.

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
        """Average over the ring of a quantity given at each point."""
        return jnp.sum(self.weight * values)


@shown
class Ring(NamedTuple):
    """A storage ring as the loss mechanisms see it.

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
        Momentum acceptance of the lattice without RF, relative, up and down where they differ;
        infinite if the RF alone limits.
    acceptance_y : float
        Vertical acceptance of the chamber, m rad; infinite if the scraper alone limits.
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
        return self.energy / ELECTRON_MASS_EV


@shown
class Gas(NamedTuple):
    """Atoms of the residual gas, element by element.

    Attributes
    ----------
    charge : array, shape (k,)
        Atomic number.
    atoms : array, shape (k,)
        Atoms of the element for each molecule of the mixture.
    """

    charge: jax.Array
    atoms: jax.Array


@shown
class HarmonicCavity(NamedTuple):
    """A cavity at a harmonic of the main RF.

    Attributes
    ----------
    number : float
        Its frequency over that of the main RF.
    voltage : float
        Peak voltage, V.
    phase : float
        Phase at the bunch, rad: it gains voltage sin(phase). 0 is the crossing that lengthens the
        bunch, pi the one that shortens it; a cavity without generator loses, its sine is negative.
    """

    number: jax.Array
    voltage: jax.Array
    phase: jax.Array


@shown
class MeasuredLength(NamedTuple):
    """A bunch length that is known, and taken as it is.

    Attributes
    ----------
    current : array, shape (k,)
        Bunch currents, mA, rising.
    length : array, shape (k,)
        Rms length at each, m; linear in between and constant below.
    exponent : float
        Power of the current with which it grows above the last of them.
    voltage : float
        RF voltage at which it holds, V; at others it changes as the length at zero current.
    """

    current: jax.Array
    length: jax.Array
    exponent: jax.Array
    voltage: jax.Array


@shown
class Operation(NamedTuple):
    """The settings an operator can change, and the vacuum that results.

    Attributes
    ----------
    rf_voltage : float
        Sum of the peak RF voltages, V.
    scraper_y : float
        Distance from the beam to the nearer vertical scraper jaw, m; infinite if there is none.
    bunches : float
        Number of equally filled bunches, or of those that would lose as much.
    pressure_base : float
        Pressure without beam, Pa.
    pressure_slope : float
        Rise of the pressure with beam current, Pa/mA.
    temperature : float
        Temperature of the gas, K.
    gas : Gas
        Composition of the residual gas.
    fill : array, shape (k,)
        Charge of each bunch over that of one of `bunches` equal ones, so that their mean, weighted
        with the charge, is 1.
    bunch_length : MeasuredLength or None
        The length where it is known; None to compute it.
    harmonic_cavity : HarmonicCavity or None
        A second RF system.
    stretch : float
        By how much such a system lengthens the bunch, where only that is known.
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


def unstored(operation: Operation, energy_loss: float, energy: float) -> str | None:
    """Expected RF voltage, in words, if this one stores no beam of that loss and energy; or None.

    Loss and energy are in eV.

    The main RF gives what a turn loses, less what the beam gains in a harmonic cavity.
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
    """Residual gas from the share of each molecule in the pressure.

    Parameters
    ----------
    **fractions : float
        Partial pressures of H2, He, CH4, H2O, Ne, N2, CO, O2, Ar, CO2 in any common unit.

    Returns
    -------
    Gas
        Elements with their atoms for each molecule of the mixture.

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
    return Gas(jnp.array(charges, float), jnp.array([atoms[charge] for charge in charges]))
