"""A scan seen through a line: from settings to R11, R12 and what is known of each size.

Numbers that only a wrong unit explains are refused here, and those that hardly anything else does
are asked about.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from functools import lru_cache
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.arrays import padded_length
from beamfit.emittance.model import line_with
from beamfit.emittance.scan import USUAL, QuadScan, middle
from beamfit.greybox import tree
from beamfit.optics.beamline import Beamline, Same, seen_line, transfer_rows
from beamfit.optics.calibration import SETTING_UNITS, CurrentTable, plain_meaning
from beamfit.optics.elements import Element, Marker, Quadrupole, Screen, ThinLens
from beamfit.particles import ELECTRON_MASS, beta_gamma, rigidity
from beamfit.quantity import display_unit

# Gradients in T/m beyond which a magnet is a plasma lens at least, and beyond any lens.
STRONG, IMPOSSIBLE = 500.0, 1e4
# Normalised emittances in m of most beams: electrons from the best guns, positrons from a target.
# Sizes in mm that are called µm give 1e-12; an energy in GeV that is called MeV 1e-2 and more.
LIKELY = (1e-9, 1e-2)
# A prior further than this from what the line says is asked about.
FAR = 0.2


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
        r = self.both(line_with(model, self.line), self.energy * found.get("energy", 1.0))
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
    variable_energy: bool = False,
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
    every = np.append(energy, (1.0 + variable_energy) * scanned.energy)
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


def damping_of(energy: np.ndarray, mean: float, mass: float) -> np.ndarray:
    """Square root of the ratio of a geometric emittance to that at the mean energy."""
    return np.sqrt(beta_gamma(mean, mass) / beta_gamma(energy, mass))


def row_elements(rows: Rows) -> Array:
    """Carry the rows of a scan to their screens, in both planes and one pass.

    Returns
    -------
    Array, shape (3, 2, rows)
        R11, R12 (m) and the size² that is not due to the beam (m²), of x and y.
    """
    seen = [jnp.stack(rows.known(r)) for r in rows.both(rows.line, rows.energy)]
    return jnp.stack(seen, axis=1)


def setting_units(line: Beamline, magnets: Iterable[str]) -> dict[str, str]:
    """The units of the settings of magnets, as they are written for people."""
    return {n: SETTING_UNITS[line[n].calibration.unit] for n in magnets}


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


def unit_warnings(scan: QuadScan, scanned: Beamline) -> tuple[str, ...]:
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
    asked = _of_energies, _of_gradients, _of_tables
    return (*of_sizes(scan), *(said for ask in asked for said in ask(scan, scanned)))


def of_sizes(scan: QuadScan) -> Iterator[str]:
    """Ask about the sizes alone."""
    for plane, size in scan.size.items():
        usual = middle(size)
        if not USUAL[0] <= usual <= USUAL[1]:
            unusual = "large" if usual > USUAL[1] else "small"
            factor, unit = display_unit(usual, "m")
            yield (
                f"Sizes in {plane} around {usual / factor:.3g} {unit} are taken as they stand, but "
                f"are unusually {unusual}: is that the unit they are in?"
            )


def _of_energies(scan: QuadScan, scanned: Beamline) -> Iterator[str]:
    """Ask about rows whose energy is another than the line's by a factor of two."""
    if scan.energy is None:
        return
    given, own = middle(scan.energy), float(scanned.energy)
    if not 0.5 < given / own < 2.0:
        yield (
            f"The rows have energies around {given:.4g} MeV, the line one of {own:.4g} MeV: are "
            "both in MeV?"
        )


def of_emittances(planes: Iterable[Any]) -> Iterator[str]:
    """Ask about planes whose emittance is determined and no usual accelerator's."""
    for plane in planes:
        found = plane.normalized_emittance
        likely = LIKELY[0] <= found.value <= LIKELY[1]
        if found.error is not None and found.value > 0.0 and not likely:
            yield (
                f"A normalised emittance of {found.value:.2g} m in {plane.plane} is "
                f"{'less' if found.value < LIKELY[0] else 'more'} than most accelerators have: are "
                "sizes, settings and energy in their units?"
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
