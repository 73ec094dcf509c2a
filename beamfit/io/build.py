"""From a checked lattice file to a beam line."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from beamfit.io.lattice import LatticeFile
from beamfit.optics.beamline import Beamline, Design
from beamfit.optics.calibration import (
    Calibration,
    CurrentPolynomial,
    FocusingStrength,
    IntegratedGradient,
    IntegratedStrength,
    SlopeIntercept,
)
from beamfit.optics.elements import (
    Drift,
    Element,
    Marker,
    Quadrupole,
    Screen,
    SectorDipole,
    ThinLens,
)

__all__ = ["beamline_of"]


def beamline_of(file: LatticeFile) -> Beamline:
    """Build the beam line a lattice file describes.

    Examples
    --------
    >>> lattice = LatticeFile("a.toml", "", "a", 135.0, "electron", 0.0,
    ...                       ({"type": "drift", "name": "D", "length_m": 2.0},), {})
    >>> beamline_of(lattice).length
    2.0
    """
    mass = file.rest_energy
    design = None
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
    name, kind = table["name"], table["type"]
    if kind == "drift":
        return Drift(name, float(table["length_m"]))
    if kind == "marker":
        return Marker(name)
    if kind == "screen":
        return Screen(name, 1e-6 * table.get("resolution_um", 0.0))
    if kind == "sector_dipole":
        return SectorDipole(
            name,
            float(np.copysign(table["radius_m"], table["angle_deg"])),
            float(np.radians(table["angle_deg"])),
            float(np.radians(table.get("entrance_edge_deg", 0.0))),
            float(np.radians(table.get("exit_edge_deg", 0.0))),
            table["bend_plane"],
            float(table.get("energy_offset", 0.0)),
            float(table.get("k1_per_m2", 0.0)),
        )
    setting, calibration = _strength(table, mass)
    if kind == "thin_lens":
        return ThinLens(name, setting, calibration)
    return Quadrupole(name, float(table["length_m"]), setting, calibration)


def _strength(table: Mapping[str, Any], mass: float) -> tuple[float, Calibration]:
    """The setting of a magnet and what it means."""
    if "integrated_gradient_kG" in table:
        return float(table["integrated_gradient_kG"]), IntegratedGradient(mass=mass)
    if "k1_per_m2" in table:
        return float(table["k1_per_m2"]), FocusingStrength()
    if "k1l_per_m" in table:
        return float(table["k1l_per_m"]), IntegratedStrength()
    if "slope" in table:
        line = SlopeIntercept(float(table["slope"]), float(table["intercept"]))
        return float(table["current_A"]), line
    polynomial = CurrentPolynomial(
        tuple(float(c) for c in table["gradient_polynomial_T_per_m"]),
        signed_intercept=table.get("signed_intercept", False),
        mass=mass,
    )
    return float(table["current_A"]), polynomial
