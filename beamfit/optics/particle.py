"""Momentum and rigidity of a particle of given total energy."""

from __future__ import annotations

from typing import Any

from beamfit.particles import REST_ENERGY

# MeV
ELECTRON_MASS = REST_ENERGY["electron"]
PROTON_MASS = REST_ENERGY["proton"]
# Speed of light in the unit MeV/(T m) that turns p c into B rho: exact by definition.
_LIGHT = 299.792458


def beta_gamma(energy: Any, mass: float = ELECTRON_MASS) -> Any:
    """Momentum over rest mass, p/(m c) = βγ, which turns geometric emittance into normalised.

    Parameters
    ----------
    energy : float or array
        Total energy in MeV.
    mass : float
        Rest energy in MeV.

    Returns
    -------
    float or array
        βγ, of the shape of ``energy``.

    Examples
    --------
    >>> round(beta_gamma(135.0), 4)
    264.1865
    """
    return ((energy - mass) * (energy + mass)) ** 0.5 / mass


def rigidity(energy: Any, mass: float = ELECTRON_MASS) -> Any:
    """Magnetic rigidity Bρ = p/e in T m, for a particle of unit charge.

    Parameters
    ----------
    energy : float or array
        Total energy in MeV.
    mass : float
        Rest energy in MeV.

    Returns
    -------
    float or array
        Bρ in T m.

    Examples
    --------
    >>> round(rigidity(135.0), 6)
    0.450308
    """
    return beta_gamma(energy, mass) * mass / _LIGHT
