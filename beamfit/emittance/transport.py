"""A scan seen through a line: from settings to R11, R12 and what is known of each size."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import lru_cache
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.emittance.model import line_of
from beamfit.emittance.scan import QuadScan
from beamfit.greybox import tree
from beamfit.greybox.problem import padded_length
from beamfit.optics.beamline import Beamline
from beamfit.optics.calibration import SETTING_UNITS, plain_meaning
from beamfit.optics.elements import Marker, Screen, ThinLens
from beamfit.optics.particle import ELECTRON_MASS, beta_gamma
from beamfit.optics.rows import Same, seen_line, transfer_rows


def names_of(line: Beamline) -> tuple[dict[str, str], list[str], str | None, float]:
    """Calibration units by magnet, places a screen may be, the default screen, rest energy.

    Examples
    --------
    >>> names_of(Beamline((Screen("S"),), energy=100.0))
    ({}, ['S'], 'S', 0.51099895069)
    """
    units = {n: line[n].calibration.unit for n in line.magnets}
    places = [e.name for e in line.elements if isinstance(e, Marker)]
    return units, places, line.screens[-1] if line.screens else None, line.mass


def scanned_line(scan: QuadScan, line: Beamline) -> Beamline:
    """Give each scanned magnet the meaning its column's unit has, at the same strength.

    Where the rows are of one slice of the beam, magnets stay as they are for the line's energy.

    Examples
    --------
    >>> from beamfit.optics.elements import Quadrupole
    >>> line = Beamline((Quadrupole("Q", 0.1, setting=3.0), Screen("S")), energy=100.0)
    >>> scan = QuadScan({"Q": [0.0, 1.0, 2.0]}, {"Q": "kG"}, {"x": [2e-4, 1e-4, 3e-4]})
    >>> magnet = scanned_line(scan, line)["Q"]
    >>> magnet.calibration.unit, round(float(magnet.k1(energy=100.0)), 9)
    ('kG', 3.0)
    """
    if scan.transfer:
        return line
    for name, unit in scan.units.items():
        lens = any(isinstance(line[m], ThinLens) for m in line.members(name))
        if lens and unit in ("k1", "T_per_m"):
            raise scan.unusable(
                f"{SETTING_UNITS[unit]} for '{name}', which has no length",
                f"a column {name}_k1l (inverse focal length, 1/m) or {name}_kG",
                name,
            )
    energy = None
    if scan.slice is not None:
        energies = np.unique(line.energy if scan.energy is None else scan.energy)
        # The mean of equal numbers may be another one in its last digit.
        energy = float(energies[0] if len(energies) == 1 else np.mean(scan.energy))
    return _as_scanned(Same(line), tuple(scan.units.items()), energy)


@lru_cache(maxsize=64)
def _as_scanned(same: Same, units: tuple[tuple[str, str], ...], energy: float | None) -> Beamline:
    """The line with other units of its settings, and held for another beam if one is told."""
    line = same.line
    for member, unit in [(m, unit) for name, unit in units for m in line.members(name)]:
        magnet = line[member]
        if unit != magnet.calibration.unit:
            meaning = plain_meaning(unit, line.mass)
            strength = magnet.calibration.k1l(magnet.setting, magnet.length, line.energy)
            # Every other meaning is proportional to its setting.
            setting = float(strength / meaning.k1l(1.0, magnet.length, line.energy))
            line = line.with_element(replace(magnet, calibration=meaning, setting=setting))
    return line if energy is None else line.held(energy)


def rows_line(scan: QuadScan) -> Beamline:
    """The line of rows of electrons that have matrices of their own: where these begin, no more.

    The rows' screens and the start stand in one place. Rows without matrices or without an energy
    are an `InputError`.

    Examples
    --------
    >>> rows = [[1.0, 0.0], [1.0, 1.0], [1.0, 2.0]]
    >>> sizes = {"x": [1e-4, 2e-4, 3e-4]}
    >>> rows_line(QuadScan({}, {}, sizes, energy=[100.0] * 3, transfer={"x": rows})).screens
    ('start',)
    """
    if scan.transfer is None:
        expected = "a lattice, or columns r11_x, r12_x, ... of every row"
        raise scan.unusable("a scan without a line", expected)
    if scan.energy is None:
        expected = "a column energy_MeV, --energy, or a line of that energy"
        raise scan.unusable("no beam energy", expected)
    names = [name for name in dict.fromkeys(scan.screen or ()) if name != "start"]
    energy = float(np.mean(scan.of_particle(ELECTRON_MASS).energy))
    return Beamline(tuple(Screen(n) for n in (*names, "start")), energy, "rows", ELECTRON_MASS)


@tree.node("plane", "places", "squared")
class Rows:
    """Rows of a scan seen through a line: what predicts their sizes besides the model.

    Parameters
    ----------
    plane : str
        "x" or "y".
    places : tuple of str
        Screens.
    squared : bool
        Whether size² in µm² is compared (the report's ``error_linear``), or size in µm.
    line : Beamline
        The line, with the calibrations of the scan's columns.
    settings : dict of str to Array
        Magnet name to settings, shape (n,), or (n, 2) with the branch.
    energy, which, spread, resolution : Array
        MeV, index into places, relative momentum spread and point-spread rms in m, shape (n,).
    damping : Array
        sqrt(βγ/βγ_row), shape (n,): the beam that is asked for, at the scan's mean energy, has this
        times the size at another one, since the normalised emittance is what stays.
    given : Array or None
        Shape (2, n, 3): R11, R12 and R16 of both planes where the rows have them from elsewhere.
    """

    plane: str
    places: tuple[str, ...]
    squared: bool
    line: Beamline
    settings: Any
    energy: Any
    which: Any
    spread: Any
    resolution: Any
    damping: Any
    given: Any = None

    def elements(self, model: Mapping[str, Any]) -> tuple[Array, Array, Array]:
        """R11, R12, damped, and known size² (m²) of every row, shape (n,), by the model's line."""
        found = model.get("systematics", {})
        r = self.both(line_of(model, self.line), self.energy * found.get("energy", 1.0))
        return self.known(r["xy".index(self.plane)], found)

    def both(self, line: Beamline, energy: Array) -> Array:
        """R11, R12 and R16 of both planes, shape (2, n, 3), by a line, unless they are given."""
        if self.given is not None:
            return self.given
        planes = transfer_rows(line, self.settings, energy, self.places).planes
        return jnp.moveaxis(planes[jnp.arange(len(self.energy)), :, self.which, 0], 1, 0)

    def known(
        self, r: Array, found: Mapping[str, Any] = MappingProxyType({})
    ) -> tuple[Array, Array, Array]:
        """R11, R12 and known size² from R11, R12 and R16, shape (n, 3), and what was found free.

        Of a round wire of diameter d the rms is d/4, that of a uniform disc seen from the side.
        """
        own = found.get("dispersion", 0.0), found.get("dispersion_slope", 0.0)
        dispersion = r[:, 2] + r[:, 0] * own[0] + r[:, 1] * own[1]
        known = (dispersion * self.spread) ** 2 + found.get("resolution", self.resolution) ** 2
        return through_screen(found, self.damping * r[:, 0], self.damping * r[:, 1], known)


def through_screen(
    found: Mapping[str, Any], r11: Array, r12: Array, known: Array
) -> tuple[Array, Array, Array]:
    """R11, R12 and known size² as a screen or wire of some scale and thickness shows them."""
    scale, wire = found.get("size_scale", 1.0), found.get("wire", 0.0)
    return scale * r11, scale * r12, scale**2 * (known + (wire / 4.0) ** 2)


@tree.node("plane", "squared")
class NetworkRows:
    """Rows of a scan whose R11 and R12 are outputs of a network of the settings.

    ``inputs`` has shape (n, inputs) and ``columns`` (n, 2), the outputs that are R11 and R12 at
    each row's screen; ``known`` (n,) is the size² that is not due to the beam, m², ``damping`` that
    of `Rows`.
    """

    plane: str
    squared: bool
    inputs: Any
    columns: Any
    known: Any
    damping: Any

    def outputs(self, model: Mapping[str, Any]) -> Array:
        """The outputs of the model's network that ``columns`` names, of its shape."""
        every = jax.vmap(model["map"].values)(self.inputs)
        return jnp.take_along_axis(every, self.columns, axis=1)

    def elements(self, model: Mapping[str, Any]) -> tuple[Array, Array, Array]:
        """R11, R12 and known size² (m²) of every row, shape (n,) each."""
        found = self.outputs(model)  # A and B first, then C and D if the network has them
        r11, r12 = self.damping * found[:, 0], self.damping * found[:, 1]
        return through_screen(model.get("systematics", {}), r11, r12, self.known)


def padded(values: Any) -> np.ndarray:
    """Repeat the last row until there are as many as `padded_length` says.

    Examples
    --------
    >>> padded([1.0, 2.0]).tolist()
    [1.0, 2.0, 2.0, 2.0, 2.0, 2.0, 2.0, 2.0]
    """
    values = np.asarray(values)
    more = padded_length(len(values)) - len(values)
    return np.concatenate([values, np.repeat(values[-1:], more, axis=0)])


def scan_rows(
    scan: QuadScan,
    scanned: Beamline,
    squared: bool = True,
    keep: Iterable[str] = (),
    any_energy: bool = False,
) -> Rows:
    """The rows of a scan, of the x plane, padded.

    Parameters
    ----------
    scan : QuadScan
        The scan.
    scanned : Beamline
        From `scanned_line`.
    squared : bool
        As for `Rows`.
    keep : iterable of str
        Elements that may change besides the magnets of the scan.
    any_energy : bool
        Whether the energy may.

    Returns
    -------
    Rows
        Places in the order of the line. All of the line that nothing changes is multiplied out.
    """
    n, own = len(scan), scan.transfer
    named = scan.screen or (scanned.screens[-1],) * n
    order = {e.name: i for i, e in enumerate(scanned.elements)}
    # Rows with matrices of their own: the beam is asked for where those begin, the last place.
    seen = {*named, scanned.screens[-1]} if own else set(named)
    places = tuple(sorted(seen, key=order.__getitem__))
    resolution = [float(getattr(scanned[s], "resolution", 0.0)) for s in places]
    which = np.array([places.index(s) for s in named])

    def column(values: Any, default: float) -> np.ndarray:
        return padded(np.full(n, float(default)) if values is None else values)

    energy = column(scan.energy, scanned.energy)
    ends = (*places, scanned.design.at) if scanned.design else places
    # What is multiplied out holds for one energy, if there is but one.
    every = np.append(energy, (1.0 + any_energy) * scanned.energy)
    settings = {} if own else scan.settings
    return Rows(
        "x",
        places,
        squared,
        seen_line(scanned, (*settings, *keep), every, ends),
        {name: padded(v) for name, v in settings.items()},
        energy,
        padded(which),
        column(scan.energy_spread, scanned.energy_spread),
        padded(np.array(resolution)[which] if scan.resolution is None else scan.resolution),
        damping_of(energy, float(energy[:n].mean()), float(scanned.mass)),
        # A plane that was not measured has no rows, whatever stands there.
        np.stack([padded(own.get(p, next(iter(own.values())))) for p in "xy"]) if own else None,
    )


def rows_at(
    line: Beamline,
    plane: str,
    place: str,
    settings: Mapping[str, Any],
    energy: np.ndarray,
    spread: float,
    resolution: float,
    mean: float,
) -> Rows:
    """Rows of one plane's sizes at one place, which nobody need have measured.

    Parameters
    ----------
    line : Beamline
        As the rows see it.
    plane, place : str
        Which size, and where.
    settings : mapping of str to array
        As of `Rows`, shape (n,) or (n, 2).
    energy : ndarray
        MeV, shape (n,).
    spread, resolution : float
        Momentum spread, and point-spread rms in m.
    mean : float
        The energy of the beam that is asked for, MeV.
    """
    one, places = np.ones(len(energy)), np.zeros(len(energy), int)
    known = float(spread) * one, float(resolution) * one
    damping = damping_of(energy, mean, float(line.mass))
    return Rows(plane, (place,), False, line, settings, energy, places, *known, damping)


def damping_of(energy: np.ndarray, mean: float, mass: float) -> np.ndarray:
    """Square root of the ratio of a geometric emittance to that at the mean energy."""
    return np.sqrt(beta_gamma(mean, mass) / beta_gamma(energy, mass))


class Look(NamedTuple):
    """Both planes of a scan's rows through a line, each of shape (2, rows).

    Attributes
    ----------
    r11, r12, known : Array
        Transfer-matrix elements to the screens (R12 in m), size² not due to the beam, m².
    """

    r11: Array
    r12: Array
    known: Array


def look_through(rows: Rows) -> Look:
    """Carry the rows of a scan to their screens, in both planes and one pass."""
    seen = [rows.known(r) for r in rows.both(rows.line, rows.energy)]
    return Look(*(jnp.stack(part) for part in zip(*seen, strict=True)))


def setting_units(line: Beamline, magnets: Iterable[str]) -> dict[str, str]:
    """The units of the settings of magnets, as they are written for people."""
    return {n: SETTING_UNITS[line[n].calibration.unit] for n in magnets}
