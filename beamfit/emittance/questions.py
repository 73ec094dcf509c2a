"""Numbers that only a wrong unit explains, or hardly anything else: refused, or asked about."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from beamfit.emittance.scan import USUAL, QuadScan, middle
from beamfit.optics.beamline import Beamline
from beamfit.optics.calibration import CurrentTable
from beamfit.optics.elements import Element, Quadrupole
from beamfit.optics.particle import rigidity

# Gradients in T/m beyond which a magnet is a plasma lens at least, and beyond any lens.
STRONG, IMPOSSIBLE = 500.0, 1e4
# Normalised emittances in m below those of accelerators: sizes in mm that are called µm give 1e-12.
TINY = 1e-9
# A prior further than this from what the line says is asked about.
FAR = 0.2


def scanned_magnets(scan: QuadScan, scanned: Beamline) -> Iterator[tuple[str, np.ndarray, Element]]:
    """Name and settings of each scanned magnet, and of a supply each magnet on it."""
    for name, settings in () if scan.transfer else scan.settings.items():
        for member in scanned.members(name):
            yield name, settings, scanned[member]


def gradients(scan: QuadScan, scanned: Beamline) -> dict[str, float]:
    """The largest gradient in T/m of each scanned quadrupole that has a length."""
    energy = float(scanned.energy) if scan.energy is None else scan.energy
    found = {}
    for name, settings, magnet in scanned_magnets(scan, scanned):
        if isinstance(magnet, Quadrupole):
            k1 = np.asarray(magnet.k1(settings, energy))
            largest = float(np.abs(k1 * rigidity(energy, scanned.mass)).max())
            found[name] = max(found.get(name, 0.0), largest)
    return found


def check_gradients(scan: QuadScan, scanned: Beamline) -> None:
    """Refuse settings that no magnet can have.

    Parameters
    ----------
    scan : QuadScan
        With total energies.
    scanned : Beamline
        The line, with the calibrations of the scan's columns.

    Raises
    ------
    InputError
        Naming the magnet and its gradient.
    """
    for name, gradient in gradients(scan, scanned).items():
        if gradient > IMPOSSIBLE:
            largest = float(np.abs(scan.settings[name]).max())
            raise scan.unusable(
                f"settings of '{name}' up to {largest:g}, which are {gradient:.3g} T/m",
                f"a gradient below {IMPOSSIBLE:g} T/m: is the unit of the settings, the length or "
                "calibration of the magnet, or the energy another one?",
                name,
            )


def questions(scan: QuadScan, scanned: Beamline) -> tuple[str, ...]:
    """Ask about sizes and settings that are possible, and yet more likely in a wrong unit.

    Parameters
    ----------
    scan, scanned
        As for `check_gradients`.

    Returns
    -------
    tuple of str
        Sentences; nothing was changed because of them.
    """
    return (*of_sizes(scan), *_of_gradients(scan, scanned), *_of_tables(scan, scanned))


def of_sizes(scan: QuadScan) -> Iterator[str]:
    """Ask about the sizes alone."""
    for plane, size in scan.size.items():
        usual = middle(size)
        if not USUAL[0] <= usual <= USUAL[1]:
            unusual = "large" if usual > USUAL[1] else "small"
            yield (
                f"Sizes in {plane} around {1e3 * usual:.3g} mm are taken as they stand, but are "
                f"unusually {unusual}: is that the unit they are in?"
            )


def of_emittances(planes: Iterable[Any]) -> Iterator[str]:
    """Ask about planes whose emittance is determined and smaller than an accelerator's."""
    for plane in planes:
        found = plane.normalized_emittance
        if found.error is not None and 0.0 < found.value < TINY:
            yield (
                f"A normalised emittance of {found.value:.2g} m in {plane.plane} is less "
                "than accelerators have: are sizes, settings and energy in their units?"
            )


def of_priors(priors: Mapping[str, tuple[float | None, float]], scanned: Beamline) -> Iterator[str]:
    """Ask about priors on elements whose mean is far from what the line says."""
    for name, (mean, _) in priors.items():
        element, _, what = name.rpartition(".")
        if mean is None or not element or element not in {e.name for e in scanned.elements}:
            continue
        part = scanned[element]
        own = getattr(part, "length", None) if what == "length" else None
        own = getattr(getattr(part, "calibration", None), what, own)
        if own is None or what == "gradient" or not float(own):
            continue
        if abs(mean / float(own) - 1.0) > FAR:
            yield (
                f"The prior {name} = {mean:g} is more than 20 % from the line's {float(own):g}: is "
                "it in the line's unit?"
            )


def _of_gradients(scan: QuadScan, scanned: Beamline) -> Iterator[str]:
    for name, gradient in gradients(scan, scanned).items():
        if gradient > STRONG:
            yield (
                f"Settings of {name} are taken as they stand, but mean gradients up to "
                f"{gradient:.3g} T/m: are its unit, length and calibration right?"
            )


def _of_tables(scan: QuadScan, scanned: Beamline) -> Iterator[str]:
    """Ask about currents beyond those at which a magnet was measured."""
    for name, settings, magnet in scanned_magnets(scan, scanned):
        table = getattr(magnet, "calibration", None)
        if not isinstance(table, CurrentTable):
            continue
        low, high = table.currents[0], table.currents[-1]
        beyond = int(np.sum((settings < low) | (settings > high)))
        if beyond:
            yield (
                f"{beyond} of {len(settings)} currents of {name} lie beyond the measured "
                f"{low:g} to {high:g} A of {magnet.name}, whose gradient goes on in a straight "
                "line there: are they in A?"
            )
