"""Particles of a lattice: rest energies, momentum and rigidity."""

from __future__ import annotations

from typing import Any

REST_ENERGY = {"electron": 0.51099895069, "positron": 0.51099895069, "proton": 938.27208943}
REST_ENERGY |= {"antiproton": REST_ENERGY["proton"], "H-": 939.294073, "deuteron": 1875.612945}
"""MeV, CODATA 2022 (NIST), all of one charge; H- is a proton and two electrons, less 14.35 eV."""
ENERGY_KEYS = {"energy_MeV": "total", "kinetic_energy_MeV": "kinetic", "momentum_MeV": "momentum"}
"""Keys for the energy of a beam in files; a momentum is p c."""
# Rest energies in MeV.
ELECTRON_MASS = REST_ENERGY["electron"]
PROTON_MASS = REST_ENERGY["proton"]
# Speed of light in m/s, exact by definition; in MeV/(T m) it turns p c into B rho.
LIGHT = 299792458.0
_LIGHT = LIGHT / 1e6
# Largest total energy in MeV, above that of every machine: a larger number is in another unit.
_MAX_ENERGY = 1e7


def expected_energy(energy: float, particle: str) -> str | None:
    """Return None for a possible total energy in MeV, otherwise a text with the possible range.

    Examples
    --------
    >>> expected_energy(0.135, "electron").partition(" and ")[0]
    "a total energy between the electron's rest energy of 0.510999 MeV"
    """
    rest = REST_ENERGY[particle]
    if rest < energy <= _MAX_ENERGY:
        return None
    return (
        f"a total energy between the {particle}'s rest energy of {rest:.6g} MeV and 10 TeV; "
        "is it in GeV or eV, or a kinetic energy (kinetic_energy_MeV)?"
    )


def total_energy(number: Any, kind: str, rest: float) -> Any:
    """Total energy in MeV, E = T + m or E² = (pc)² + m².

    Parameters
    ----------
    number : float or array
        Total or kinetic energy, or p c, in MeV.
    kind : {"total", "kinetic", "momentum"}
        Meaning of ``number``.
    rest : float
        Rest energy in MeV.

    Returns
    -------
    float or array
        Of the shape of ``number``.

    Examples
    --------
    >>> total_energy(3.0, "kinetic", 4.0), total_energy(3.0, "momentum", 4.0)
    (7.0, 5.0)
    """
    if kind == "momentum":
        return (number**2 + rest**2) ** 0.5
    return number + rest if kind == "kinetic" else number


def beta_gamma(energy: Any, mass: float = ELECTRON_MASS) -> Any:
    """Ratio of momentum to rest mass, p/(m c) = βγ: normalised over geometric emittance.

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
