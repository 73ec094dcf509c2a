"""First principles with free scales: the losses of many decays in one small set of numbers."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from beamfit.lifetime.losses import MECHANISMS, Losses, added, terms_of
from beamfit.lifetime.ring import Operation, Ring

__all__ = ["Terms", "loss_terms", "scaled_losses", "scaled_parts"]


class Terms(NamedTuple):
    """What first principles say at one setting, before scaling.

    Attributes
    ----------
    parts : tuple of float
        The term of each of `MECHANISMS`.
    pressure : float
        Pressure at the mean current, Pa.
    rise : float
        P1/P0, the rise of the pressure with current over the base pressure, 1/mA.
    current : float
        Mean current, mA.
    """

    parts: tuple[Array, ...]
    pressure: Array
    rise: Array
    current: Array


def loss_terms(ring: Ring, operation: Operation, current: Array) -> Terms:
    """Compute the terms of one setting.

    Parameters
    ----------
    ring : Ring
        The ring.
    operation : Operation
        Settings and vacuum.
    current : float
        Mean current, mA.

    Returns
    -------
    Terms
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
    >>> print(f"{terms.pressure:.1e} Pa, P1/P0 = {terms.rise:.3f} /mA")
    1.0e-07 Pa, P1/P0 = 0.008 /mA
    """
    base, slope = operation.pressure_base, operation.pressure_slope
    return Terms(
        terms_of(ring, operation, current),
        pressure=jnp.asarray(base + slope * current, float),
        rise=jnp.asarray(slope / base, float),
        current=jnp.asarray(current, float),
    )


def scaled_losses(scales: Array, terms: Terms, pressure_factor: Array = 1.0) -> tuple[Array, Array]:
    """Coefficients a and b with each mechanism scaled.

    Parameters
    ----------
    scales : array, shape (4,)
        A factor for each of `SCALES`: on Touschek, bremsstrahlung, elastic scattering, and on
        P1/P0 (desorption); 1 is the ring file. What is not fitted keeps its size.
    terms : Terms
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


def scaled_parts(scales: Array, terms: Terms, pressure_factor: Array = 1.0) -> Losses:
    """The parts that `scaled_losses` adds up."""
    *sizes, desorption = jnp.asarray(scales, float)
    factors = iter(sizes)
    parts = tuple(
        term * next(factors) if m.vary else term
        for m, term in zip(MECHANISMS, terms.parts, strict=True)
    )
    rise = desorption * terms.rise
    base = terms.pressure * pressure_factor / (1 + rise * terms.current)
    return added(parts, base, base * rise)
