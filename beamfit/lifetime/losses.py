"""The loss mechanisms of a ring, and the parameters a and b of the decay that they add up to."""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from beamfit.errors import InputError
from beamfit.lifetime.bunch import quantum_loss
from beamfit.lifetime.gas import bremsstrahlung_loss, elastic_loss
from beamfit.lifetime.ring import Operation, Ring
from beamfit.lifetime.touschek import touschek_loss
from beamfit.shown import shown

__all__ = [
    "LINEAR",
    "MECHANISMS",
    "QUADRATIC",
    "SCALES",
    "Losses",
    "Mechanism",
    "added",
    "loss_coefficients",
    "terms_of",
]


class Mechanism(NamedTuple):
    """One way to lose beam.

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
        for m, part in zip(QUADRATIC, self, strict=False):
            found[m.name] += part * current
        for m, part in zip(LINEAR, self[len(QUADRATIC) :], strict=True):
            found[m.name] += part
        return found


@jax.jit
def _terms(ring: Ring, operation: Operation, current: Array) -> tuple[Array, ...]:
    return tuple(m.term(ring, operation, current) for m in MECHANISMS)


def terms_of(ring: Ring, operation: Operation, current: float | Array) -> tuple[Array, ...]:
    """The term of each mechanism; `InputError` where the RF voltage is known to store no beam."""
    voltage, loss = operation.rf_voltage, ring.energy_loss
    known = not isinstance(voltage, jax.core.Tracer) and not isinstance(loss, jax.core.Tracer)
    if known and bool(jnp.any(jnp.asarray(voltage) <= loss)):
        raise InputError(
            f"RF voltage {float(jnp.min(voltage)) / 1e3:.6g} kV",
            f"more than the loss of {float(loss) / 1e3:.6g} kV a turn, or no beam is stored",
            column="rf_voltage_kV",
        )
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
    parts = terms_of(ring, operation, current)
    return added(parts, operation.pressure_base, operation.pressure_slope)
