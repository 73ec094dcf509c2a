"""Particles a lattice may carry: plain numbers, for files and optics alike."""

from typing import Any

REST_ENERGY = {"electron": 0.51099895069, "positron": 0.51099895069, "proton": 938.27208943}
REST_ENERGY |= {"antiproton": REST_ENERGY["proton"], "H-": 939.294073, "deuteron": 1875.612945}
"""MeV, CODATA 2022 (NIST), all of one charge; H- is a proton and two electrons, less 14.35 eV."""
ENERGY_KEYS = {"energy_MeV": "total", "kinetic_energy_MeV": "kinetic", "momentum_MeV": "momentum"}
"""Energy of a beam as files give it; a momentum is p c."""
# MeV, above the energy of every machine: a larger number is in another unit.
_HIGHEST = 1e7


def expected_energy(energy: float, particle: str) -> str | None:
    """Say which total energies in MeV a particle can have, or None if this is one of them.

    Examples
    --------
    >>> expected_energy(0.135, "electron").partition(" and ")[0]
    "a total energy between the electron's rest energy of 0.510999 MeV"
    """
    rest = REST_ENERGY[particle]
    if rest < energy <= _HIGHEST:
        return None
    return (
        f"a total energy between the {particle}'s rest energy of {rest:.6g} MeV and 10 TeV; "
        "is it in GeV or eV, or a kinetic energy (kinetic_energy_MeV)?"
    )


def total_energy(number: Any, kind: str, rest: float) -> Any:
    """Total energy in MeV, E = T + m or E² = (pc)² + m², from what a file says.

    Parameters
    ----------
    number : float or array
        MeV.
    kind : {"total", "kinetic", "momentum"}
        What it is.
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
