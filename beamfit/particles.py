"""Rest energies of the particles a lattice may carry: plain numbers, for files and optics alike."""

__all__ = ["REST_ENERGY"]

REST_ENERGY = {"electron": 0.51099895069, "positron": 0.51099895069, "proton": 938.27208943}
"""MeV, CODATA 2022 (NIST)."""
