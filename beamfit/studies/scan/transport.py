"""A scan seen through a line: from settings to the numbers a fit of sizes needs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from beamfit.optics.beamline import Beamline
from beamfit.optics.calibration import (
    SETTING_UNITS,
    FocusingStrength,
    IntegratedGradient,
    IntegratedStrength,
)
from beamfit.optics.elements import Marker, Screen, ThinLens, TransferMatrix
from beamfit.optics.sections import Series
from beamfit.studies.scan.scans import QuadScan

__all__ = [
    "PlaneInput",
    "ScanRows",
    "names_of",
    "own_settings",
    "own_units",
    "plane_input",
    "scan_rows",
    "scanned_line",
    "seen_line",
    "transfer_rows",
]


# Elements, times rows, whose matrices are held at once where each row has its own energy.
MOST_AT_ONCE = 100_000


class ScanRows(NamedTuple):
    """The rows of a scan as the line sees them, and one more: the line's own settings.

    Attributes
    ----------
    settings : dict of str to ndarray
        Magnet name to setting, shape (n + 1,), in the scan's units.
    energy : ndarray
        Total energy in MeV, shape (n + 1,).
    places : tuple of str
        Screens of the scan in the order of the line, then the element of the design Twiss.
    which : ndarray
        Index into ``places``, shape (n + 1,); the last row's is the last screen of the line.
    """

    settings: dict[str, np.ndarray]
    energy: np.ndarray
    places: tuple[str, ...]
    which: np.ndarray


class PlaneInput(NamedTuple):
    """One plane of a scan, carried to its screens; arrays of shape (n,).

    Attributes
    ----------
    settings : dict of str to ndarray
        Magnet name to setting.
    units : dict of str to str
        Magnet name to the unit of its settings.
    energy : ndarray
        Total energy, MeV.
    screen : tuple of str
        Where each size was measured.
    size : ndarray
        Rms size, m.
    error : ndarray or None
        Standard error, m.
    r11, r12, r16 : ndarray
        Transfer-matrix elements from the start (R12, R16 in m).
    energy_spread : ndarray
        Relative momentum spread.
    known : ndarray
        Size² in m² due to dispersion and resolution.
    last_screen : str
        The scan's last screen along the line.
    to_screen, to_design : ndarray
        Shape (3, 3): start to the last screen and to the design's place, magnets as the
        lattice sets them.
    """

    settings: dict[str, np.ndarray]
    units: dict[str, str]
    energy: np.ndarray
    screen: tuple[str, ...]
    size: np.ndarray
    error: np.ndarray | None
    r11: np.ndarray
    r12: np.ndarray
    r16: np.ndarray
    energy_spread: np.ndarray
    known: np.ndarray
    last_screen: str
    to_screen: np.ndarray
    to_design: np.ndarray


def names_of(line: Beamline) -> tuple[dict[str, str], list[str], str | None, float]:
    """Calibration units by magnet, places a screen may be, the default screen, rest energy.

    Examples
    --------
    >>> names_of(Beamline((Screen("S"),), energy=100.0))
    ({}, ['S'], 'S', 0.51099895069)
    """
    units = {n: line[n].calibration.unit for n in line.magnets}
    places = [e.name for e in line.elements if isinstance(e, Screen | Marker)]
    return units, places, line.screens[-1] if line.screens else None, line.mass


def scanned_line(scan: QuadScan, line: Beamline) -> Beamline:
    """Give each scanned magnet the meaning its column's unit has, at the same strength.

    Examples
    --------
    >>> from beamfit.optics.elements import Quadrupole
    >>> line = Beamline((Quadrupole("Q", 0.1, setting=3.0), Screen("S")), energy=100.0)
    >>> scan = QuadScan({"Q": [0.0, 1.0, 2.0]}, {"Q": "kG"}, {"x": [2e-4, 1e-4, 3e-4]})
    >>> magnet = scanned_line(scan, line)["Q"]
    >>> magnet.calibration.unit, round(float(magnet.k1(energy=100.0)), 9)
    ('kG', 3.0)
    """
    meanings = {
        "kG": IntegratedGradient(mass=line.mass),
        "k1": FocusingStrength(),
        "k1l": IntegratedStrength(),
    }
    for name, unit in scan.units.items():
        magnet = line[name]
        if isinstance(magnet, ThinLens) and unit == "k1":
            raise scan.unusable(
                f"k1 for '{name}', which has no length",
                f"a column {name}_k1l (inverse focal length, 1/m) or {name}_kG",
                name,
            )
        if unit != magnet.calibration.unit:
            meaning = meanings[unit]
            strength = magnet.calibration.k1l(magnet.setting, magnet.length, line.energy)
            # Every other meaning is proportional to its setting.
            setting = float(strength / meaning.k1l(1.0, magnet.length, line.energy))
            line = line.with_element(replace(magnet, calibration=meaning, setting=setting))
    return line


def scan_rows(scan: QuadScan, scanned: Beamline) -> ScanRows:
    """Collect the rows of a scan for `transfer_rows`."""
    n = len(scan)
    named = scan.screen or (scanned.screens[-1],) * n
    order = [e.name for e in scanned.elements]
    screens = tuple(sorted(set(named), key=order.index))
    design = (scanned.design.at,) if scanned.design else ()
    own = float(scanned.energy)
    return ScanRows(
        settings={k: np.append(v, float(scanned[k].setting)) for k, v in scan.settings.items()},
        energy=np.append(np.full(n, own) if scan.energy is None else scan.energy, own),
        places=tuple(dict.fromkeys((*screens, *design))),
        which=np.array([screens.index(s) for s in named] + [len(screens) - 1]),
    )


def transfer_rows(
    line: Beamline, settings: Mapping[str, Array], energy: Array, places: tuple[str, ...]
) -> TransferMatrix:
    """Transfer matrices from the start to several places, for many settings.

    Parameters
    ----------
    line : Beamline
        The line, with the calibrations of the scan's columns. What no setting moves is
        multiplied out first; a line that is traced is taken as it is (see `seen_line`).
    settings : mapping of str to Array
        Magnet name to settings, shape (n,).
    energy : Array
        MeV, shape (n,), or one number.
    places : tuple of str
        Element names.

    Returns
    -------
    TransferMatrix
        ``planes`` of shape (n, 2, places, 3, 3).
    """
    if not any(isinstance(v, jax.core.Tracer) for v in jax.tree.leaves(line)):
        line = seen_line(line, settings, energy, places)
    return _rows(line, dict(settings), energy, places)


def seen_line(
    line: Beamline, settings: Iterable[str], energy: ArrayLike, places: Iterable[str]
) -> Beamline:
    """A line as rows of these settings and energies see it: all else multiplied out."""
    own = () if isinstance(energy, jax.core.Tracer) else np.unique(energy)
    return line.condensed((*settings, *places), own[0] if len(own) == 1 else None)


@partial(jax.jit, static_argnames="places")
def _rows(
    line: Beamline, settings: dict[str, Array], energy: Array, places: tuple[str, ...]
) -> TransferMatrix:
    def one(row: tuple[dict[str, Array], Array]) -> Array:
        setting, at = row
        found = line.matrices(places, setting, energy if at is None else at)
        return jnp.stack([jnp.asarray(found[p].planes) for p in places], axis=-3)

    rows = (settings, None if jnp.ndim(energy) == 0 else energy)
    long = max((e.order.size for e in line.elements if isinstance(e, Series)), default=0)
    if jnp.size(energy) * long <= MOST_AT_ONCE:
        return TransferMatrix(jax.vmap(one)(rows))
    by_turns = jax.lax.map(jax.checkpoint(one), rows, batch_size=max(1, MOST_AT_ONCE // long))
    return TransferMatrix(by_turns)


def plane_input(
    scan: QuadScan, scanned: Beamline, rows: ScanRows, matrices: TransferMatrix, plane: str
) -> PlaneInput:
    """Select what the fit of one plane needs from the matrices of a scan's rows."""
    measured = scan.rows(plane)
    keep = np.flatnonzero(~np.isnan(scan.size[plane]))
    every = np.asarray(matrices.planes)[:, "xy".index(plane)]
    r = every[keep, rows.which[keep]]
    spread = measured.energy_spread
    if spread is None:
        spread = np.full(len(keep), float(scanned.energy_spread))
    resolution = measured.resolution
    screen = tuple(rows.places[i] for i in rows.which[keep])
    if resolution is None:
        own = {s: float(getattr(scanned[s], "resolution", 0.0)) for s in set(screen)}
        resolution = np.array([own[s] for s in screen])
    design = rows.places.index(scanned.design.at) if scanned.design else 0
    return PlaneInput(
        settings=measured.settings,
        units={name: SETTING_UNITS[scan.units[name]] for name in measured.settings},
        energy=rows.energy[keep],
        screen=screen,
        size=measured.size,
        error=measured.error,
        r11=r[:, 0, 0],
        r12=r[:, 0, 1],
        r16=r[:, 0, 2],
        energy_spread=spread,
        known=(r[:, 0, 2] * spread) ** 2 + resolution**2,
        last_screen=rows.places[rows.which[-1]],
        to_screen=every[-1, rows.which[-1]],
        to_design=every[-1, design],
    )


def own_settings(line: Beamline, screen: str) -> dict[str, float]:
    """The lattice's own setting of every magnet up to a screen."""
    return {name: float(line[name].setting) for name in line.upto(screen).magnets}


def own_units(line: Beamline, screen: str) -> dict[str, str]:
    """The units of `own_settings`."""
    return {n: SETTING_UNITS[line[n].calibration.unit] for n in line.upto(screen).magnets}
