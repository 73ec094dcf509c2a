"""Particles a lattice may carry: plain numbers, for files and optics alike."""

__all__ = ["REST_ENERGY", "expected_energy"]

REST_ENERGY = {"electron": 0.51099895069, "positron": 0.51099895069, "proton": 938.27208943}
"""MeV, CODATA 2022 (NIST)."""
# MeV, beyond every machine: such a number is in another unit.
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
        "is it in GeV or eV?"
    )
