"""Whether a lattice has what a scan names. Plain Python, before JAX is loaded."""

from __future__ import annotations

from collections.abc import Mapping

from beamfit.emittance.scan import QuadScan
from beamfit.errors import nearest


def check_names(
    scan: QuadScan,
    calibrations: Mapping[str, str],
    places: list[str],
    default: str | None,
    rest_energy: float = 0.0,
) -> None:
    """Check that a lattice has what a scan names, before anything is computed.

    Parameters
    ----------
    scan : QuadScan
        The scan.
    calibrations : mapping of str to str
        Magnet name to the unit of its calibration in the lattice.
    places : list of str
        Names a screen may have.
    default : str or None
        The screen used where the scan names none.
    rest_energy : float
        Of the lattice's particle, MeV.

    Raises
    ------
    InputError
        If a magnet or screen is missing (the nearest is offered), or a current is given for
        a magnet whose lattice entry has no current calibration.

    Examples
    --------
    >>> scan = QuadScan({"Q": [0.0, 1.0, 2.0]}, {"Q": "A"}, {"x": [2e-4, 1e-4, 3e-4]})
    >>> check_names(scan, {"Q": "A"}, ["OTR"], "OTR")
    """
    for name, unit in () if scan.transfer else scan.units.items():
        if name not in calibrations:
            expected = f"{nearest(name, list(calibrations))} before the unit _{unit}; --ignore "
            expected += "leaves the column unread"
            raise scan.unusable(f"no magnet '{name}' in the lattice", expected, name)
        if unit == "A" and calibrations[name] != "A":
            raise scan.unusable(
                f"currents for '{name}', which the lattice gives no current calibration",
                f"slope and intercept for {name} in the lattice, or a column {name}_kG",
                name,
            )
    scan = scan.of_particle(rest_energy)
    if scan.energy is not None and scan.energy.min() <= rest_energy:
        raise scan.unusable(
            f"{scan.energy.min():g} MeV",
            f"total energies above the particle's rest energy of {rest_energy:g} MeV",
            "energy_MeV",
        )
    for screen in sorted(set(scan.screen or ())):
        if screen not in places:
            raise scan.unusable(
                f"no screen '{screen}' in the lattice", nearest(screen, places), "screen"
            )
    if scan.screen is None and default is None:
        raise scan.unusable(
            "a lattice without a screen", 'an element of type "screen" where sizes were measured'
        )
