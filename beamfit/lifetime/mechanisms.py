"""Loss mechanisms of a ring, Touschek scattering and gas, and the coefficients a and b."""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.special import i0e
from scipy import constants

from beamfit.answer import shown
from beamfit.errors import InputError
from beamfit.lifetime.ring import (
    ELECTRON_RADIUS,
    Gas,
    Operation,
    Optics,
    Ring,
    acceptance_by_sign,
    population,
    quantum_loss,
    required_voltage,
    stored_bunch,
    vertical_acceptance,
)


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


def _plane_optics(ring: Ring, optics: Optics) -> tuple[Array, ...]:
    """Emittance, beta, alpha, dispersion and its slope at one point, each an array (x, y)."""
    emittance = jnp.stack([ring.emittance_x, ring.emittance_y])
    return emittance, *jnp.reshape(jnp.stack(optics[1:]), (4, 2))


def _width_coefficients(ring: Ring, optics: Optics) -> tuple[Array, Array]:
    """B1 and B1² - B2² of Piwinski's equations 33 and 34, at one point of the ring."""
    emittance, beta, alpha, dispersion, slope = _plane_optics(ring, optics)
    tilt, size2 = alpha * dispersion + beta * slope, emittance * beta
    spread2 = 1 / (ring.energy_spread**-2 + jnp.sum((dispersion**2 + tilt**2) / size2))
    x, y = beta / emittance * (1 - tilt**2 * spread2 / size2)
    coupled = spread2 * tilt[0] * tilt[1] / (emittance[0] * emittance[1])
    scale = ring.relativistic_gamma**2 - 1
    # B1² - B2² as a product: in a flat beam the difference of the squares loses all digits.
    return (x + y) / (2 * scale), (x * y - coupled**2) / scale**2


def piwinski_shape(floor: Array, b1: Array, gap: Array, nodes: int = 64) -> Array:
    """Piwinski's F(tau_m, B1, B2), the momentum-transfer integral at one point of the ring.

    Parameters
    ----------
    floor : float
        tau_m = beta² delta² with the momentum acceptance delta.
    b1 : float
        B1.
    gap : float
        B1² - B2², positive.
    nodes : int, optional
        Number of Gauss-Legendre nodes in ln kappa; the relative error is 1e-5 with 32 and 2e-9
        with 64.

    Returns
    -------
    float
        2 sqrt(pi (B1² - B2²)) times the integral over kappa from arctan(sqrt(tau_m)) to pi/2.

    Notes
    -----
    A. Piwinski, DESY 98-179 (1998), equation 42, without the factor ln 2 that some codes have.

    Examples
    --------
    >>> f"{piwinski_shape(9e-4, 10.0, 19.0) * 9e-4:.3f}"
    '6.938'
    """
    roots, weights = np.polynomial.legendre.leggauss(nodes)
    lower, upper = jnp.log(jnp.arctan(jnp.sqrt(floor))), jnp.log(jnp.pi / 2)
    log_kappa = lower + (upper - lower) * (roots + 1) / 2
    t = jnp.tan(jnp.exp(log_kappa)) ** 2
    # In a round beam B2 = 0: the square root has no derivative there, but the integral, even in
    # B2, has derivative zero.
    squared = jnp.maximum(b1**2 - gap, (1e-8 * b1) ** 2)
    b2 = jnp.sqrt(squared)
    decay = jnp.exp(-gap / (b1 + b2) * t) * i0e(b2 * t)
    integrand = _spectrum(log_kappa, floor) * decay * jnp.exp(log_kappa)
    integral = (upper - lower) / 2 * jnp.sum(weights * integrand)
    # For acceptances far beyond the momenta of the bunch only rounding errors are left.
    return 2 * jnp.sqrt(jnp.pi * gap) * jnp.maximum(integral, 0.0)


def _transverse_area(ring: Ring, optics: Optics) -> Array:
    """Transverse area of the bunch sqrt(sigma_x² sigma_y² - sigma_delta⁴ D_x² D_y²), m²."""
    emittance, beta, _, dispersion, _ = _plane_optics(ring, optics)
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
        The ring; its `momentum_acceptance` is not used.
    population : float
        Electrons in the bunch.
    length : float
        Rms bunch length, m.
    acceptance : float or array, shape (n,) or (2, n)
        Relative momentum acceptance, at each point of the optics if it is an array, and for
        positive and negative deviations if it has two rows.
    nodes : int, optional
        Number of quadrature nodes.

    Returns
    -------
    float
        1/tau_T, the relative loss rate at this population. One of two scattered electrons gains
        momentum and one loses it, so the rate is the mean over both signs of the deviation.

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
        return piwinski_shape(floor, b1, gap, nodes) / _transverse_area(ring, optics)

    density = jax.vmap(local)(ring.optics, acceptance)
    scale = ELECTRON_RADIUS**2 * constants.c * population / (8 * jnp.pi * lorentz**2 * length)
    return scale * ring.optics.average(density)


def touschek_loss(ring: Ring, operation: Operation, current: Array) -> Array:
    """Touschek part of a, 1/(mA s)."""
    bunch = stored_bunch(ring, operation, current)
    # The rate goes with the population: at one milliampere in the ring it equals a.
    single = population(ring, 1 / operation.bunches)
    return piwinski_rate(ring, single, bunch.length, bunch.acceptance)


def touschek_shape(ring: Ring, operation: Operation) -> Callable[[Array], Array]:
    """Relative Touschek part of a as a function of beam current, through bunch lengthening.

    Parameters
    ----------
    ring : Ring
        The ring, with its impedance.
    operation : Operation
        RF voltage, bunches, and what determines their length.

    Returns
    -------
    callable
        Function of the current, mA: a_T relative to that at zero current. For the `shape` of
        `fit_decay`.

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


def elastic_cross_section(
    charge: Array,
    lorentz: Array,
    beta_y: Array,
    acceptance_y: Array,
    beta_x: Array = 0.0,
    acceptance_x: Array = jnp.inf,
) -> Array:
    """Cross section for an elastic deflection out of the transverse acceptance, m² per atom.

    Parameters
    ----------
    charge : float or array
        Atomic number.
    lorentz : float
        Energy over rest energy.
    beta_y, acceptance_y : float or array
        Vertical Twiss beta at the atom, m, and acceptance, m rad.
    beta_x, acceptance_x : float or array, optional
        Horizontal beta and acceptance; default: no limit.

    Returns
    -------
    float or array
        4 r_e² Z²/gamma² (x phi + y (pi/2 - phi) + sqrt(x y)) with x = beta_x/A_x, y = beta_y/A_y
        and tan² phi = x/y. For a single plane this is 2 pi r_e² Z²/gamma² beta/A.

    Notes
    -----
    Rutherford scattering at small angles: A. Wrulich, CERN 94-01 (1994), p. 409, for one plane.
    An electron is lost if it leaves either acceptance: the larger of x cos² and y sin² is
    integrated over the azimuth. The sum of both planes would count deflections that exceed both
    twice, 22 % too much for equal planes. Screening by the electrons is negligible at these angles.

    Examples
    --------
    >>> print(f"{elastic_cross_section(7, 5870.85, 8.7845, 9e-7):.4e}")
    6.9233e-28
    """
    x, y = beta_x / acceptance_x, beta_y / acceptance_y
    turn = jnp.arctan2(_square_root(x), _square_root(y))
    azimuths = x * turn + y * (jnp.pi / 2 - turn) + _square_root(x) * _square_root(y)
    return 4 * (ELECTRON_RADIUS * charge / lorentz) ** 2 * azimuths


def _square_root(ratio: Array) -> Array:
    """Square root with a zero derivative at zero, where a plane has no limit."""
    limited = jnp.asarray(ratio) > 0
    return jnp.where(limited, jnp.sqrt(jnp.where(limited, ratio, 1.0)), 0.0)


def bremsstrahlung_cross_section(charge: Array, acceptance: Array) -> Array:
    """Cross section for losing more than the momentum acceptance to a photon, m² per atom.

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
    """Loss rate per pressure of residual gas, 1/(s Pa).

    Parameters
    ----------
    cross_section : array, shape (k,)
        Cross section of each element, m² per atom.
    gas : Gas
        Elements, with their atoms per molecule.
    temperature : float
        Gas temperature, K.

    Returns
    -------
    float
        K = c sum(atoms sigma)/(k_B T): with P = P0 + P1 I it gives b = K P0 and a = K P1.

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
    """Loss rate of elastic scattering per pressure, averaged over the ring, 1/(s Pa)."""
    aperture = vertical_acceptance(ring.acceptance_y, operation.scraper_y, ring.scraper_beta_y)
    optics, charge = ring.optics, operation.gas.charge[:, None]
    both = (optics.beta_y, aperture, optics.beta_x, ring.acceptance_x)
    section = elastic_cross_section(charge, ring.relativistic_gamma, *both) @ optics.weight
    return gas_rate_coefficient(section, operation.gas, operation.temperature)


def bremsstrahlung_loss(ring: Ring, operation: Operation, current: Array) -> Array:
    """Loss rate of bremsstrahlung per pressure, averaged over the ring, 1/(s Pa)."""
    # A photon takes energy: the acceptance for negative deviations counts.
    _, points = acceptance_by_sign(ring, stored_bunch(ring, operation, current).acceptance)
    charge = operation.gas.charge
    sections = jax.vmap(lambda point: bremsstrahlung_cross_section(charge, point))(points)
    section = ring.optics.weight @ sections
    return gas_rate_coefficient(section, operation.gas, operation.temperature)


class Mechanism(NamedTuple):
    """Mechanism of beam loss.

    Attributes
    ----------
    name, label : str
        Name in results, and label in tables.
    term : callable
        ``term(ring, operation, current)``. For a loss that goes with I² only it is the part of a,
        1/(mA s); for one that goes with I only the part of b, 1/s. A gas loss goes with the
        pressure P0 + P1 I and has both parts: its term is the rate per pressure, 1/(s Pa).
    quadratic, linear : bool
        Whether the loss -dI/dt has a part that goes with I², and one that goes with I.
    vary : str
        Setting to vary to separate it from the others if its size is fitted; else empty.
    """

    name: str
    label: str
    term: Callable[[Ring, Operation, Array], Array]
    quadratic: bool
    linear: bool
    vary: str


# Advice on what to vary.
BUNCH, SCRAPER = "the RF voltage or the number of bunches", "the scraper at constant pressure"
MECHANISMS = (
    Mechanism("touschek", "Touschek", touschek_loss, True, False, BUNCH),
    Mechanism("bremsstrahlung", "bremsstrahlung", bremsstrahlung_loss, True, True, SCRAPER),
    Mechanism("elastic", "elastic gas", elastic_loss, True, True, SCRAPER),
    Mechanism("quantum", "quantum", quantum_loss, False, True, ""),
)
QUADRATIC = tuple(m for m in MECHANISMS if m.quadratic)
LINEAR = tuple(m for m in MECHANISMS if m.linear)
# Names of the fitted scales, one for each mechanism that can be varied and one for P1/P0, with what
# to vary to determine each.
SCALES = {m.name: m.vary for m in MECHANISMS if m.vary} | {
    "desorption": "the current at constant settings"
}


@shown
class Losses(
    namedtuple("_Parts", [f"a_{m.name}" for m in QUADRATIC] + [f"b_{m.name}" for m in LINEAR])
):
    """Loss coefficients of dI/dt = -a I² - b I by mechanism.

    Attributes
    ----------
    a_touschek, a_bremsstrahlung, a_elastic : float
        Parts of a, 1/(mA s); the gas parts come from the pressure rise by beam-induced desorption.
    b_bremsstrahlung, b_elastic, b_quantum : float
        Parts of b, 1/s.
    """

    __slots__ = ()

    @property
    def a(self) -> Array:
        """Sum of the parts of a, 1/(mA s)."""
        return sum(self[: len(QUADRATIC)])

    @property
    def b(self) -> Array:
        """Sum of the parts of b, 1/s."""
        return sum(self[len(QUADRATIC) :])

    @property
    def units(self) -> tuple[str, ...]:
        """Unit of each part."""
        return ("1/(mA s)",) * len(QUADRATIC) + ("1/s",) * len(LINEAR)

    def rates(self, current: float) -> dict[str, Array]:
        """Loss rate of each mechanism at a current in mA, 1/s."""
        found = {m.name: 0.0 for m in MECHANISMS}
        powers = (current,) * len(QUADRATIC) + (1.0,) * len(LINEAR)
        for m, part, power in zip((*QUADRATIC, *LINEAR), self, powers, strict=True):
            found[m.name] += part * power
        return found


@jax.jit
def _compute_terms(ring: Ring, operation: Operation, current: Array) -> tuple[Array, ...]:
    return tuple(m.term(ring, operation, current) for m in MECHANISMS)


def mechanism_terms(ring: Ring, operation: Operation, current: float | Array) -> tuple[Array, ...]:
    """Term of each mechanism; `InputError` if the RF voltage stores no beam."""
    rf = operation.rf_voltage, ring.energy_loss, ring.energy
    concrete = not any(isinstance(value, jax.core.Tracer) for value in rf)
    if concrete and (expected := required_voltage(operation, *rf[1:])) is not None:
        found = f"RF voltage {float(np.min(rf[0])) / 1e3:.6g} kV"
        raise InputError(found, expected, column="rf_voltage_kV")
    return _compute_terms(ring, operation, jnp.asarray(current, float))


def losses_from_terms(parts: tuple[Array, ...], base: Array, slope: Array) -> Losses:
    """Loss coefficients from terms, base pressure, Pa, and its rise with current, Pa/mA."""
    terms = list(zip(MECHANISMS, parts, strict=True))
    return Losses(
        *(term * slope if m.linear else term for m, term in terms if m.quadratic),
        *(term * base if m.quadratic else term for m, term in terms if m.linear),
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
        Beam current, mA. The coefficients depend on it only through bunch lengthening.

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
    parts = mechanism_terms(ring, operation, current)
    return losses_from_terms(parts, operation.pressure_base, operation.pressure_slope)


class LossTerms(NamedTuple):
    """Loss terms from first principles at one setting, before scaling.

    Attributes
    ----------
    parts : tuple of float
        Term of each of `MECHANISMS`.
    base, slope : float
        Pressure without beam, Pa, and its rise with current, Pa/mA.
    current : float
        Mean current, mA.
    voltages : array, shape (k,), or None
        Ratios of true to stated RF voltage, equidistant, at which the parts were computed; these
        then have shape (k,). None if the voltage is taken as stated.
    """

    parts: tuple[Array, ...]
    base: Array
    slope: Array
    current: Array
    voltages: Array | None = None

    def at_voltage(self, scale: Array) -> tuple[Array, ...]:
        """Parts at a ratio of true to stated RF voltage, by linear interpolation."""
        spacing = self.voltages[..., 1:2] - self.voltages[..., :1]
        share = jnp.maximum(1 - jnp.abs(scale - self.voltages) / spacing, 0.0)
        return tuple(jnp.sum(part * share, axis=-1) for part in self.parts)


def loss_terms(
    ring: Ring, operation: Operation, current: Array, voltages: Array | None = None
) -> LossTerms:
    """Compute the loss terms of one setting.

    Parameters
    ----------
    ring : Ring
        The ring.
    operation : Operation
        Settings and vacuum.
    current : float
        Mean current, mA.
    voltages : array, shape (k,), optional
        As in `LossTerms`, if the scale of the RF voltage is fitted.

    Returns
    -------
    LossTerms
        Terms, differentiable in every argument.

    Raises
    ------
    InputError
        As for `loss_coefficients`.

    Examples
    --------
    >>> from beamfit.io.ring import read_operation, read_ring
    >>> path = "lattices/spear3_2003.toml"
    >>> terms = loss_terms(read_ring(path), read_operation(path), 500.0)
    >>> print(f"{terms.base:.1e} Pa, P1/P0 = {terms.slope / terms.base:.3f} /mA")
    2.0e-08 Pa, P1/P0 = 0.008 /mA
    """
    if voltages is None:
        parts = mechanism_terms(ring, operation, current)
    else:
        true = operation.rf_voltage * jnp.asarray(voltages, float)
        parts = terms_at_voltages(ring, operation, current, true).parts
    return LossTerms(
        parts,
        base=jnp.asarray(operation.pressure_base, float),
        slope=jnp.asarray(operation.pressure_slope, float),
        current=jnp.asarray(current, float),
        voltages=None if voltages is None else jnp.asarray(voltages, float),
    )


@jax.jit
def terms_at_voltages(
    ring: Ring, operation: Operation, current: Array, voltages: Array
) -> LossTerms:
    """Compute the terms at several RF voltages, V; each part has shape (k,)."""

    def one(voltage: Array) -> LossTerms:
        return loss_terms(ring, operation._replace(rf_voltage=voltage), current)

    return jax.lax.map(one, voltages)


@jax.jit
def scaled_losses(
    scales: Array, terms: LossTerms, pressure_factor: Array = 1.0
) -> tuple[Array, Array]:
    """Coefficients a and b with each mechanism scaled.

    Parameters
    ----------
    scales : array, shape (4,) or (5,)
        Factor for each of `SCALES`: Touschek, bremsstrahlung, elastic scattering, and P1/P0
        (desorption); 1 is the ring file. Other mechanisms are not scaled. For terms with
        `voltages` a fifth is the ratio of true to stated RF voltage.
    terms : LossTerms
        First principles at one setting.
    pressure_factor : float, optional
        True pressure over the pressure reading.

    Returns
    -------
    tuple of float
        a, 1/(mA s), and b, 1/s.

    Notes
    -----
    Report section 3.4.2 with P = P0 + P1 I: a = s_T a_T + (s_B K_B + s_C K_C) P1 and
    b = (s_B K_B + s_C K_C) P0 + b_Q. The pressure at the mean current is kept, so a scale on
    P1/P0 moves gas losses between a and b: P0 = P/(1 + s P1/P0 I).

    Examples
    --------
    >>> from beamfit.io.ring import read_operation, read_ring
    >>> path = "lattices/spear3_2003.toml"
    >>> terms = loss_terms(read_ring(path), read_operation(path), 500.0)
    >>> a, b = scaled_losses(jnp.ones(4), terms)
    >>> print(f"{1 / (a * 500 + b) / 3600:.2f} h")
    18.37 h
    """
    losses = scaled_parts(scales, terms, pressure_factor)
    return losses.a, losses.b


@jax.jit
def scaled_parts(scales: Array, terms: LossTerms, pressure_factor: Array = 1.0) -> Losses:
    """Loss coefficients by mechanism, scaled as in `scaled_losses`."""
    *factors, desorption = jnp.asarray(scales, float)[: len(SCALES)]
    parts = terms.parts if terms.voltages is None else terms.at_voltage(scales[len(SCALES)])
    remaining = iter(factors)
    pairs = zip(MECHANISMS, parts, strict=True)
    parts = tuple(term * next(remaining) if m.vary else term for m, term in pairs)
    base, slope = terms.base, desorption * terms.slope
    scaled_pressure, pressure = (base + rise * terms.current for rise in (slope, terms.slope))
    factor = pressure_factor * pressure / jnp.where(scaled_pressure > 0, scaled_pressure, 1.0)
    return losses_from_terms(parts, factor * base, factor * slope)
