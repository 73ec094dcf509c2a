"""The loss mechanisms of a ring, and the a and b of the decay that they, or scaled ones, make."""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.answer import shown
from beamfit.errors import InputError
from beamfit.lifetime.gas import bremsstrahlung_loss, elastic_loss
from beamfit.lifetime.ring import Operation, Ring, quantum_loss, unstored
from beamfit.lifetime.touschek import touschek_loss


class Mechanism(NamedTuple):
    """A mechanism of beam loss.

    Attributes
    ----------
    name, label : str
        For results, and for people.
    term : callable
        ``term(ring, operation, current)``: the part of a, 1/(mA s), of what is quadratic in the
        current alone; the part of b, 1/s, of what is linear alone; the rate for each pascal,
        1/(s Pa), of what goes with the pressure P0 + P1 I and is therefore both.
    quadratic, linear : bool
        Whether the loss -dI/dt has a part that goes with I², and one that goes with I.
    vary : str
        What to vary to tell it from others, where its size is fitted; empty where it is not.
    """

    name: str
    label: str
    term: Callable[[Ring, Operation, Array], Array]
    quadratic: bool
    linear: bool
    vary: str


BUNCH, SCRAPER = "the RF voltage or the number of bunches", "the scraper at constant pressure"
MECHANISMS = (
    Mechanism("touschek", "Touschek", touschek_loss, True, False, BUNCH),
    Mechanism("bremsstrahlung", "bremsstrahlung", bremsstrahlung_loss, True, True, SCRAPER),
    Mechanism("elastic", "elastic gas", elastic_loss, True, True, SCRAPER),
    Mechanism("quantum", "quantum", quantum_loss, False, True, ""),
)
QUADRATIC = tuple(m for m in MECHANISMS if m.quadratic)
LINEAR = tuple(m for m in MECHANISMS if m.linear)
# Every mechanism whose size is fitted, and P1/P0: what each is called, and what to vary for it.
SCALES = {m.name: m.vary for m in MECHANISMS if m.vary} | {
    "desorption": "the current at constant settings"
}


@shown
class Losses(
    namedtuple("_Parts", [f"a_{m.name}" for m in QUADRATIC] + [f"b_{m.name}" for m in LINEAR])
):
    """Loss coefficients of dI/dt = -a I² - b I, mechanism by mechanism.

    Attributes
    ----------
    a_touschek, a_bremsstrahlung, a_elastic : float
        Parts of a, 1/(mA s); the gas parts come from the pressure that the beam itself desorbs.
    b_bremsstrahlung, b_elastic, b_quantum : float
        Parts of b, 1/s.
    """

    __slots__ = ()

    @property
    def a(self) -> Array:
        """All that grows with the square of the current, 1/(mA s)."""
        return sum(self[: len(QUADRATIC)])

    @property
    def b(self) -> Array:
        """All that is proportional to the current, 1/s."""
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
def _terms(ring: Ring, operation: Operation, current: Array) -> tuple[Array, ...]:
    return tuple(m.term(ring, operation, current) for m in MECHANISMS)


def terms_of(ring: Ring, operation: Operation, current: float | Array) -> tuple[Array, ...]:
    """The term of each mechanism; `InputError` where the RF voltage is known to store no beam."""
    given = operation.rf_voltage, ring.energy_loss, ring.energy
    known = not any(isinstance(value, jax.core.Tracer) for value in given)
    if known and (expected := unstored(operation, *given[1:])) is not None:
        found = f"RF voltage {float(np.min(given[0])) / 1e3:.6g} kV"
        raise InputError(found, expected, column="rf_voltage_kV")
    return _terms(ring, operation, jnp.asarray(current, float))


def added(parts: tuple[Array, ...], base: Array, slope: Array) -> Losses:
    """Coefficients at a base pressure, Pa, and its rise with current, Pa/mA."""
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
        Beam current, mA. It matters only through bunch lengthening: without it the coefficients
        do not depend on it.

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
    parts = terms_of(ring, operation, current)
    return added(parts, operation.pressure_base, operation.pressure_slope)


class LossTerms(NamedTuple):
    """Loss terms from first principles at one setting, before scaling.

    Attributes
    ----------
    parts : tuple of float
        The term of each of `MECHANISMS`.
    base, slope : float
        Pressure without beam, Pa, and its rise with current, Pa/mA.
    current : float
        Mean current, mA.
    voltages : array, shape (k,), or None
        True over stated RF voltage where the parts, then of shape (k,), were computed: evenly
        spaced. None where the voltage is taken as stated.
    """

    parts: tuple[Array, ...]
    base: Array
    slope: Array
    current: Array
    voltages: Array | None = None

    def at_voltage(self, scale: Array) -> tuple[Array, ...]:
        """The parts at a true over stated RF voltage, linear in between."""
        spacing = self.voltages[..., 1:2] - self.voltages[..., :1]
        share = jnp.maximum(1 - jnp.abs(scale - self.voltages) / spacing, 0.0)
        return tuple(jnp.sum(part * share, axis=-1) for part in self.parts)


def loss_terms(
    ring: Ring, operation: Operation, current: Array, voltages: Array | None = None
) -> LossTerms:
    """Compute the terms of one setting.

    Parameters
    ----------
    ring : Ring
        The ring.
    operation : Operation
        Settings and vacuum.
    current : float
        Mean current, mA.
    voltages : array, shape (k,), optional
        As of `LossTerms`, where the RF voltage has a scale of its own.

    Returns
    -------
    LossTerms
        Differentiable in every argument.

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

    def parts_at(voltage: Array) -> tuple[Array, ...]:
        return terms_of(ring, operation._replace(rf_voltage=voltage), current)

    if voltages is None:
        parts = parts_at(operation.rf_voltage)
    else:
        parts = jax.lax.map(parts_at, operation.rf_voltage * jnp.asarray(voltages, float))
    return LossTerms(
        parts,
        base=jnp.asarray(operation.pressure_base, float),
        slope=jnp.asarray(operation.pressure_slope, float),
        current=jnp.asarray(current, float),
        voltages=None if voltages is None else jnp.asarray(voltages, float),
    )


def scaled_losses(
    scales: Array, terms: LossTerms, pressure_factor: Array = 1.0
) -> tuple[Array, Array]:
    """Coefficients a and b with each mechanism scaled.

    Parameters
    ----------
    scales : array, shape (4,) or (5,)
        A factor for each of `SCALES`: on Touschek, bremsstrahlung, elastic scattering, and on
        P1/P0 (desorption); 1 is the ring file. What is not fitted keeps its size. A fifth is the
        true over the stated RF voltage, for terms with `voltages`.
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


def scaled_parts(scales: Array, terms: LossTerms, pressure_factor: Array = 1.0) -> Losses:
    """The parts that `scaled_losses` adds up."""
    *sizes, desorption = jnp.asarray(scales, float)[: len(SCALES)]
    parts = terms.parts if terms.voltages is None else terms.at_voltage(scales[len(SCALES)])
    factors = iter(sizes)
    parts = tuple(
        term * next(factors) if m.vary else term for m, term in zip(MECHANISMS, parts, strict=True)
    )
    base, slope = terms.base, desorption * terms.slope
    made, read = (base + rise * terms.current for rise in (slope, terms.slope))
    factor = pressure_factor * read / jnp.where(made > 0, made, 1.0)
    return added(parts, factor * base, factor * slope)
