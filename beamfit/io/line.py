"""Beam lines from files of any kind: read and check first, build (which loads JAX) after."""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from beamfit.errors import InputError
from beamfit.io.lattice import LatticeFile, read_toml_lattice

if TYPE_CHECKING:
    from beamfit.optics.beamline import Beamline
    from beamfit.optics.calibration import Calibration
    from beamfit.optics.elements import Element

__all__ = ["build_line", "load_lattice", "read_lattice"]

FOREIGN = {".madx", ".seq", ".mad8", ".mad", ".lte", ".ele", ".elegant"}


def load_lattice(
    path: str | PathLike[str], *, use: str | None = None, energy: float | None = None
) -> Beamline:
    """Read a beam line from a file.

    Parameters
    ----------
    path : str or path
        A TOML lattice (docs/files.md), or a MAD-X (``.madx``, ``.seq``), MAD-8 (``.mad8``)
        or elegant (``.lte``) file.
    use : str, optional
        Which line or sequence of a MAD-X or elegant file.
    energy : float, optional
        Total energy in MeV of an elegant file, which carries none; overrides a MAD-X beam.

    Returns
    -------
    Beamline
        The line.

    Raises
    ------
    InputError
        If the file cannot be used, naming file, line and key.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> file = pathlib.Path(tempfile.mkdtemp()) / "line.toml"
    >>> _ = file.write_text('''format = "beamfit-lattice-1"
    ... energy_MeV = 135.0
    ... [[element]]
    ... type = "quadrupole"
    ... name = "Q"
    ... length_m = 0.108
    ... integrated_gradient_kG = -3.0
    ... [[element]]
    ... type = "screen"
    ... name = "OTR"
    ... ''')
    >>> load_lattice(file).magnets
    ('Q',)
    """
    file = read_lattice(path, use=use, energy=energy)
    return build_line(file)


def read_lattice(
    path: str | PathLike[str], *, use: str | None = None, energy: float | None = None
) -> LatticeFile:
    """Read and check a lattice file of any kind without building it; see `load_lattice`."""
    if Path(path).suffix.lower() in FOREIGN:
        from beamfit.io.sequence import read_sequence

        return read_sequence(path, use=use, energy=energy)
    for option, value, instead in (("use", use, "one line"), ("energy", energy, "energy_MeV")):
        if value is not None:
            raise InputError(
                f"--{option} for a TOML lattice", f"none: the file has {instead}", path=path
            )
    return read_toml_lattice(path)


def build_line(file: LatticeFile) -> Beamline:
    """Build the line a checked lattice file describes.

    Examples
    --------
    >>> lattice = LatticeFile("a.toml", "", "a", 135.0, "electron", 0.0,
    ...                       ({"type": "drift", "name": "D", "length_m": 2.0},), {})
    >>> build_line(lattice).length
    2.0
    """
    from beamfit.optics.beamline import Beamline, Design

    mass, design = file.rest_energy, None
    if file.design is not None:
        twiss = {p: (t["beta_m"], t["alpha"]) for p, t in file.design.items() if p != "at"}
        design = Design(at=file.design["at"], **twiss)
    return Beamline(
        tuple(_element(table, mass) for table in file.elements),
        energy=file.energy,
        name=file.name,
        mass=mass,
        energy_spread=file.energy_spread,
        design=design,
    )


def _element(table: Mapping[str, Any], mass: float) -> Element:
    from beamfit.optics import elements

    name = table["name"]
    match table["type"]:
        case "drift":
            return elements.Drift(name, float(table["length_m"]))
        case "marker":
            return elements.Marker(name)
        case "screen":
            return elements.Screen(name, 1e-6 * table.get("resolution_um", 0.0))
        case "sector_dipole":
            edges = [np.radians(table.get(f"{end}_edge_deg", 0.0)) for end in ("entrance", "exit")]
            return elements.SectorDipole(
                name,
                float(np.copysign(table["radius_m"], table["angle_deg"])),
                float(np.radians(table["angle_deg"])),
                *map(float, edges),
                table["bend_plane"],
                float(table.get("energy_offset", 0.0)),
                float(table.get("k1_per_m2", 0.0)),
            )
        case "thin_lens":
            return elements.ThinLens(name, *_strength(table, mass))
        case _:
            length = float(table["length_m"])
            return elements.Quadrupole(name, length, *_strength(table, mass))


def _strength(table: Mapping[str, Any], mass: float) -> tuple[float, Calibration]:
    """The setting of a magnet and what it means."""
    from beamfit.optics import calibration

    if "integrated_gradient_kG" in table:
        return float(table["integrated_gradient_kG"]), calibration.IntegratedGradient(mass=mass)
    if "k1_per_m2" in table:
        return float(table["k1_per_m2"]), calibration.FocusingStrength()
    if "k1l_per_m" in table:
        return float(table["k1l_per_m"]), calibration.IntegratedStrength()
    current = float(table["current_A"])
    if "slope" in table:
        line = calibration.SlopeIntercept(float(table["slope"]), float(table["intercept"]))
        return current, line
    polynomial = calibration.CurrentPolynomial(
        tuple(float(c) for c in table["gradient_polynomial_T_per_m"]),
        signed_intercept=table.get("signed_intercept", False),
        mass=mass,
    )
    return current, polynomial
