"""Rows of a scan through a line: from settings to R11, R12 and the known size².

Numbers that only a wrong unit explains raise an error; improbable ones give a warning.
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
from beamfit.optics.beamline import Beamline, LineIdentity, reduced_line, transfer_rows
from beamfit.optics.calibration import SETTING_UNITS, CurrentTable, plain_meaning
from beamfit.optics.elements import Element, Marker, Quadrupole, Screen, ThinLens
from beamfit.particles import ELECTRON_MASS, beta_gamma, rigidity
from beamfit.quantity import display_unit

# Gradients in T/m above which only plasma lenses are known, and above which no lens is.
STRONG_GRADIENT, IMPOSSIBLE_GRADIENT = 500.0, 1e4
# Range of normalised emittances in m of most beams, from the best electron guns to positrons from a
# target. Sizes in mm labelled µm give 1e-12; an energy in GeV labelled MeV gives 1e-2 and more.
USUAL_EMITTANCES = (1e-9, 1e-2)
# Relative deviation of a prior from the line's value above which a warning is given.
MAX_PRIOR_DEVIATION = 0.2


def lattice_names(line: Beamline) -> tuple[dict[str, str], list[str], str | None, float]:
    """Calibration units by magnet, places that may be a screen, the default screen, rest energy.

    Examples
    --------
    >>> lattice_names(Beamline((Screen("S"),), energy=100.0))
    ({}, ['S'], 'S', 0.51099895069)
    """
    units = {n: line[n].calibration.unit for n in line.magnets}
    places = [e.name for e in line.elements if isinstance(e, Marker)]
    return units, places, line.screens[-1] if line.screens else None, line.mass


def scanned_line(scan: QuadScan, line: Beamline) -> Beamline:
    """Convert the setting of each scanned magnet to the unit of its column, at the same strength.

    If the rows are of one slice of the beam, magnets are held at the line's energy.

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
        # Rounding may make the mean of equal numbers differ in its last digit.
        energy = float(energies[0] if len(energies) == 1 else np.mean(scan.energy))
    return _with_units(LineIdentity(line), tuple(scan.units.items()), energy)


@lru_cache(maxsize=64)
def _with_units(
    same: LineIdentity, units: tuple[tuple[str, str], ...], energy: float | None
) -> Beamline:
    """The line with settings in other units, and held for a beam of another energy if given."""
    line = same.line
    for member, unit in [(m, unit) for name, unit in units for m in line.members(name)]:
        magnet = line[member]
        if unit != magnet.calibration.unit:
            meaning = plain_meaning(unit, line.mass)
            strength = magnet.calibration.k1l(magnet.setting, magnet.length, line.energy)
            # All these calibrations are proportional to the setting.
            setting = float(strength / meaning.k1l(1.0, magnet.length, line.energy))
            line = line.with_element(replace(magnet, calibration=meaning, setting=setting))
    return line if energy is None else line.held(energy)


def rows_line(scan: QuadScan) -> Beamline:
    """Line for rows of electrons that have matrices of their own: it ends where these begin.

    All screens are at the start. Raises `InputError` for rows without matrices or an energy.

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
    """Rows of a scan through a line: the data that predict their sizes for a model.

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
    energy, screen_index, spread, resolution : Array
        MeV, index into places, relative momentum spread and point-spread rms in m, shape (n,).
    damping : Array
        sqrt(βγ/βγ_row), shape (n,): size of the beam in the row over that at the scan's mean
        energy, for one normalised emittance.
    transfer : Array or None
        Shape (2, n, 3): R11, R12 and R16 of both planes if the rows have matrices of their own.
    """

    plane: str
    places: tuple[str, ...]
    squared: bool
    line: Beamline
    settings: Any
    energy: Any
    screen_index: Any
    spread: Any
    resolution: Any
    damping: Any
    transfer: Any = None

    def elements(self, model: Mapping[str, Any]) -> tuple[Array, Array, Array]:
        """Damped R11 and R12, and known size² (m²), of each row, shape (n,), for a model."""
        systematics = model.get("systematics", {})
        r = self.both_planes(
            line_with(model, self.line), self.energy * systematics.get("energy", 1.0)
        )
        return self.screen_elements(r["xy".index(self.plane)], systematics)

    def both_planes(self, line: Beamline, energy: Array) -> Array:
        """R11, R12 and R16 of both planes through a line, shape (2, n, 3), unless given."""
        if self.transfer is not None:
            return self.transfer
        planes = transfer_rows(line, self.settings, energy, self.places).planes
        return jnp.moveaxis(planes[jnp.arange(len(self.energy)), :, self.screen_index, 0], 1, 0)

    def screen_elements(
        self, r: Array, systematics: Mapping[str, Any] = MappingProxyType({})
    ) -> tuple[Array, Array, Array]:
        """R11, R12 and known size² from R11, R12 and R16, shape (n, 3), and free systematics."""
        slopes = systematics.get("dispersion", 0.0), systematics.get("dispersion_slope", 0.0)
        dispersion = r[:, 2] + r[:, 0] * slopes[0] + r[:, 1] * slopes[1]
        known = (dispersion * self.spread) ** 2 + systematics.get(
            "resolution", self.resolution
        ) ** 2
        return apply_screen(systematics, self.damping * r[:, 0], self.damping * r[:, 1], known)


def apply_screen(
    systematics: Mapping[str, Any], r11: Array, r12: Array, known: Array
) -> tuple[Array, Array, Array]:
    """Apply scale and wire diameter (m) of the screen; the rms of a round wire is d/4."""
    scale, wire = systematics.get("size_scale", 1.0), systematics.get("wire", 0.0)
    return scale * r11, scale * r12, scale**2 * (known + (wire / 4.0) ** 2)


@tree.node("plane", "squared")
class NetworkRows:
    """Rows of a scan whose R11 and R12 are outputs of a network of the settings.

    ``inputs`` has shape (n, inputs). ``columns``, shape (n, 2), selects the outputs that are R11
    and R12 at each row's screen. ``known`` (n,) is the size² not due to the beam, m², and
    ``damping`` is that of `Rows`.
    """

    plane: str
    squared: bool
    inputs: Any
    columns: Any
    known: Any
    damping: Any

    def outputs(self, model: Mapping[str, Any]) -> Array:
        """Outputs of the model's network selected by ``columns``, of its shape."""
        outputs = jax.vmap(model["map"].values)(self.inputs)
        return jnp.take_along_axis(outputs, self.columns, axis=1)

    def elements(self, model: Mapping[str, Any]) -> tuple[Array, Array, Array]:
        """R11, R12 and known size² (m²) of each row, shape (n,) each."""
        outputs = self.outputs(model)  # A and B first, then C and D if the network has them
        r11, r12 = self.damping * outputs[:, 0], self.damping * outputs[:, 1]
        return apply_screen(model.get("systematics", {}), r11, r12, self.known)


def pad_rows(values: Any) -> np.ndarray:
    """Repeat the last row up to the length of `padded_length`.

    Examples
    --------
    >>> pad_rows([1.0, 2.0]).tolist()
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
    """Rows of a scan, padded, for the x plane.

    Parameters
    ----------
    scan : QuadScan
        The scan.
    scanned : Beamline
        From `scanned_line`.
    squared : bool
        As for `Rows`.
    keep : iterable of str
        Elements that may vary besides the magnets of the scan.
    variable_energy : bool
        Whether the energy may vary.

    Returns
    -------
    Rows
        Places in the order of the line. Elements that do not vary are combined.
    """
    n, transfer = len(scan), scan.transfer
    screens = scan.screen or (scanned.screens[-1],) * n
    order = {e.name: i for i, e in enumerate(scanned.elements)}
    # Rows with matrices of their own: the beam matrix is where these begin, the last place.
    used = {*screens, scanned.screens[-1]} if transfer else set(screens)
    places = tuple(sorted(used, key=order.__getitem__))
    resolution = [float(getattr(scanned[s], "resolution", 0.0)) for s in places]
    screen_index = np.array([places.index(s) for s in screens])

    def column(values: Any, default: float) -> np.ndarray:
        return pad_rows(np.full(n, float(default)) if values is None else values)

    energy = column(scan.energy, scanned.energy)
    targets = (*places, scanned.design.at) if scanned.design else places
    # Combined elements hold one energy if all rows have it.
    energies = np.append(energy, (1.0 + variable_energy) * scanned.energy)
    settings = {} if transfer else scan.settings
    return Rows(
        "x",
        places,
        squared,
        reduced_line(scanned, (*settings, *keep), energies, targets),
        {name: pad_rows(v) for name, v in settings.items()},
        energy,
        pad_rows(screen_index),
        column(scan.energy_spread, scanned.energy_spread),
        pad_rows(
            np.array(resolution)[screen_index] if scan.resolution is None else scan.resolution
        ),
        damping_of(energy, float(energy[:n].mean()), float(scanned.mass)),
        # A plane that was not measured has no rows; its matrices do not matter.
        np.stack([pad_rows(transfer.get(p, next(iter(transfer.values())))) for p in "xy"])
        if transfer
        else None,
    )


def damping_of(energy: np.ndarray, mean: float, mass: float) -> np.ndarray:
    """Square root of the geometric emittance over that at the mean energy."""
    return np.sqrt(beta_gamma(mean, mass) / beta_gamma(energy, mass))


def row_elements(rows: Rows) -> Array:
    """Compute the transfer-matrix elements of the rows of a scan, in both planes at once.

    Returns
    -------
    Array, shape (3, 2, rows)
        R11, R12 (m) and the size² not due to the beam (m²), of x and y.
    """
    planes = [jnp.stack(rows.screen_elements(r)) for r in rows.both_planes(rows.line, rows.energy)]
    return jnp.stack(planes, axis=1)


def setting_units(line: Beamline, magnets: Iterable[str]) -> dict[str, str]:
    """Units of the settings of magnets, in words."""
    return {n: SETTING_UNITS[line[n].calibration.unit] for n in magnets}


def scanned_magnets(scan: QuadScan, scanned: Beamline) -> Iterator[tuple[str, np.ndarray, Element]]:
    """Name and settings of each scanned magnet; for a supply, of each of its magnets."""
    for name, settings in () if scan.transfer else scan.settings.items():
        for member in scanned.members(name):
            yield name, settings, scanned[member]


def gradients(scan: QuadScan, scanned: Beamline) -> dict[str, float]:
    """Largest gradient in T/m of each scanned quadrupole with a length."""
    energy = float(scanned.energy) if scan.energy is None else scan.energy
    found = {}
    for name, settings, magnet in scanned_magnets(scan, scanned):
        if isinstance(magnet, Quadrupole):
            k1 = np.asarray(magnet.k1(settings, energy))
            largest = float(np.abs(k1 * rigidity(energy, scanned.mass)).max())
            found[name] = max(found.get(name, 0.0), largest)
    return found


def check_gradients(scan: QuadScan, scanned: Beamline) -> None:
    """Raise an error for settings that no magnet can have.

    Parameters
    ----------
    scan : QuadScan
        With total energies.
    scanned : Beamline
        The line, with the calibrations of the scan's columns.

    Raises
    ------
    InputError
        The magnet and its gradient.
    """
    for name, gradient in gradients(scan, scanned).items():
        if gradient > IMPOSSIBLE_GRADIENT:
            largest = float(np.abs(scan.settings[name]).max())
            raise scan.unusable(
                f"settings of '{name}' up to {largest:g}, which are {gradient:.3g} T/m",
                f"a gradient below {IMPOSSIBLE_GRADIENT:g} T/m: is the unit of the settings, the "
                "length or calibration of the magnet, or the energy another one?",
                name,
            )


def unit_warnings(scan: QuadScan, scanned: Beamline) -> tuple[str, ...]:
    """Warnings on sizes, settings and energies that are possible but probably in a wrong unit.

    Parameters
    ----------
    scan, scanned
        As for `check_gradients`.

    Returns
    -------
    tuple of str
        Sentences; the numbers are used as they are.
    """
    checks = _energy_warnings, _gradient_warnings, _table_warnings
    return (
        *size_warnings(scan),
        *(sentence for check in checks for sentence in check(scan, scanned)),
    )


def size_warnings(scan: QuadScan) -> Iterator[str]:
    """Warnings on unusual sizes."""
    for plane, size in scan.size.items():
        usual = middle(size)
        if not USUAL[0] <= usual <= USUAL[1]:
            unusual = "large" if usual > USUAL[1] else "small"
            factor, unit = display_unit(usual, "m")
            yield (
                f"Sizes in {plane} around {usual / factor:.3g} {unit} are taken as they stand, but "
                f"are unusually {unusual}: is that the unit they are in?"
            )


def _energy_warnings(scan: QuadScan, scanned: Beamline) -> Iterator[str]:
    """Warning on rows whose energy differs from the line's by a factor of two or more."""
    if scan.energy is None:
        return
    row_energy, line_energy = middle(scan.energy), float(scanned.energy)
    if not 0.5 < row_energy / line_energy < 2.0:
        yield (
            f"The rows have energies around {row_energy:.4g} MeV, the line one of "
            f"{line_energy:.4g} MeV: are both in MeV?"
        )


def emittance_warnings(planes: Iterable[Any]) -> Iterator[str]:
    """Warnings on planes whose emittance is determined but unusual."""
    for plane in planes:
        found = plane.normalized_emittance
        usual = USUAL_EMITTANCES[0] <= found.value <= USUAL_EMITTANCES[1]
        if found.error is not None and found.value > 0.0 and not usual:
            yield (
                f"A normalised emittance of {found.value:.2g} m in {plane.plane} is "
                f"{'less' if found.value < USUAL_EMITTANCES[0] else 'more'} than most accelerators "
                "have: are sizes, settings and energy in their units?"
            )


def prior_warnings(
    priors: Mapping[str, tuple[float | None, float]], scanned: Beamline
) -> Iterator[str]:
    """Warnings on priors of elements whose mean is far from the line's value."""
    for name, (mean, _) in priors.items():
        element, _, attribute = name.rpartition(".")
        if mean is None or not element or element not in {e.name for e in scanned.elements}:
            continue
        part = scanned[element]
        line_value = getattr(part, "length", None) if attribute == "length" else None
        line_value = getattr(getattr(part, "calibration", None), attribute, line_value)
        if line_value is None or attribute == "gradient" or not float(line_value):
            continue
        if abs(mean / float(line_value) - 1.0) > MAX_PRIOR_DEVIATION:
            yield (
                f"The prior {name} = {mean:g} is more than 20 % from the line's "
                f"{float(line_value):g}: is it in the line's unit?"
            )


def _gradient_warnings(scan: QuadScan, scanned: Beamline) -> Iterator[str]:
    """Warnings on unusually strong gradients."""
    for name, gradient in gradients(scan, scanned).items():
        if gradient > STRONG_GRADIENT:
            yield (
                f"Settings of {name} are taken as they stand, but mean gradients up to "
                f"{gradient:.3g} T/m: are its unit, length and calibration right?"
            )


def _table_warnings(scan: QuadScan, scanned: Beamline) -> Iterator[str]:
    """Warnings on currents outside the measured range of a magnet."""
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
