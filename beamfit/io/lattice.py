"""TOML lattice files: checked before the optics is built, then built element by element."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from beamfit.emittance.scan import QuadScan, check_names
from beamfit.errors import InputError, nearest
from beamfit.io.columns import Sheet, columns_of
from beamfit.io.files import name_of
from beamfit.io.table import read_sheet
from beamfit.io.toml import FLAG, LIST, NUMBER, TABLE, TEXT, Key, Section, is_number, read_toml
from beamfit.particles import ENERGY_KEYS, REST_ENERGY, expected_energy, total_energy

if TYPE_CHECKING:
    from beamfit.optics.calibration import Calibration
    from beamfit.optics.elements import Element

# Largest number of elements: a file with more is a mistake, and is refused before it fills the
# memory.
MAX_ELEMENTS = 50_000
FORMAT = "beamfit-lattice-1"
# Keys of a magnet's setting (one of them), and their units.
STRENGTHS = {
    "current_A": "A",
    "integrated_gradient_kG": "kG",
    "gradient_T_per_m": "T_per_m",
    "k1_per_m2": "k1",
    "k1l_per_m": "k1l",
}
# Keys of the calibrations of a current, one of which is needed.
LINEAR_CALIBRATION, POLYNOMIAL_CALIBRATION = {"slope", "intercept"}, {"gradient_polynomial_T_per_m"}
TABLE_KEYS = ("gradient_table", "gradient_table_file")
CALIBRATIONS = (LINEAR_CALIBRATION, POLYNOMIAL_CALIBRATION, *({key} for key in TABLE_KEYS))
COEFFICIENTS = "at least two numbers c0, c1, ... in T/m, T/(m A), ..."
NAME_KEY, OPTIONAL_KEY = Key(kind=TEXT), Key(default=None)
LENGTH_KEY = Key(low=0.0, expected="a positive number")
EDGE_KEY = Key(default=0.0, low=-90.0, high=90.0, expected="an angle below 90 degrees")
SUPPLY_KEY = {"supply": Key(kind=TEXT, default=None)}
ELEMENTS: dict[str, dict[str, Key]] = {
    "drift": {"name": Key(kind=TEXT, default=None), "length_m": LENGTH_KEY},
    "quadrupole": {
        "name": NAME_KEY,
        "length_m": LENGTH_KEY,
        **dict.fromkeys(("current_A", "integrated_gradient_kG"), OPTIONAL_KEY),
        **dict.fromkeys(("gradient_T_per_m", "k1_per_m2"), OPTIONAL_KEY),
        **dict.fromkeys(("slope", "intercept"), OPTIONAL_KEY),
        "gradient_polynomial_T_per_m": Key(
            kind=LIST, default=None, expected=COEFFICIENTS, each=NUMBER
        ),
        "signed_intercept": Key(kind=FLAG, default=False),
        "gradient_table": Key(kind=LIST, default=None),
        "gradient_table_file": Key(kind=TEXT, default=None),
        **SUPPLY_KEY,
    },
    "thin_lens": {
        "name": NAME_KEY,
        **SUPPLY_KEY,
        "integrated_gradient_kG": OPTIONAL_KEY,
        "k1l_per_m": OPTIONAL_KEY,
    },
    "sector_dipole": {
        "name": NAME_KEY,
        "radius_m": Key(
            low=0.0, expected="a positive number; a negative angle bends the other way"
        ),
        "angle_deg": Key(low=-360.0, high=360.0, expected="an angle below 360 degrees"),
        "bend_plane": Key(kind=TEXT, among=("x", "y")),
        "entrance_edge_deg": EDGE_KEY,
        "exit_edge_deg": EDGE_KEY,
        "energy_offset": Key(
            default=0.0, low=-0.5, high=0.5, expected="a relative offset between ± 0.5; is it in %?"
        ),
        "k1_per_m2": OPTIONAL_KEY,
    },
    "marker": {"name": NAME_KEY},
    "screen": {
        "name": NAME_KEY,
        "resolution_um": Key(
            default=0.0, low=0.0, high=2e4, expected="zero or more micrometres, below 20 mm"
        ),
    },
}
TOP_KEYS = {
    **dict.fromkeys(ENERGY_KEYS, OPTIONAL_KEY),
    "element": Key(kind=LIST),
    "name": Key("name", kind=TEXT, default=""),
    "source": Key(kind=TEXT, default=""),
    "particle": Key("particle", kind=TEXT, default="electron", among=tuple(REST_ENERGY)),
    "energy_spread": Key(
        "energy_spread",
        default=0.0,
        low=0.0,
        high=0.2,
        expected="a relative spread between 0 and 0.2; is it in %?",
    ),
    "design": Key(kind=TABLE, default=None),
}
TWISS_KEY = Key(kind=TABLE, default=None)
# Keys of settings, with their units, for each type of magnet.
SETTING_KEYS = {
    kind: {k: unit for k, unit in STRENGTHS.items() if k in ELEMENTS[kind]}
    for kind in ("quadrupole", "thin_lens")
}


@dataclass(frozen=True)
class LatticeFile:
    """Checked lattice as plain tables, without JAX.

    Attributes
    ----------
    elements : tuple of dict
        Tables of the elements, in order.
    """

    path: str | PathLike[str]
    sha256: str
    name: str
    energy: float
    particle: str
    elements: tuple[Mapping[str, Any], ...]
    energy_spread: float = 0.0
    design: Mapping[str, Any] | None = None

    @cached_property
    def calibrations(self) -> dict[str, str]:
        """Unit of the setting of each magnet or supply."""
        return {
            e.get("supply", e["name"]): unit
            for e in self.elements
            for key, unit in SETTING_KEYS.get(e["type"], {}).items()
            if key in e
        }

    @property
    def rest_energy(self) -> float:
        """Rest energy of the particle, MeV."""
        return REST_ENERGY[self.particle]

    @property
    def places(self) -> list[str]:
        """Names of screens and markers, at which sizes may be measured."""
        return [e["name"] for e in self.elements if e["type"] in ("screen", "marker")]

    @property
    def default_screen(self) -> str | None:
        """Last screen, used if a scan names none."""
        screens = [e["name"] for e in self.elements if e["type"] == "screen"]
        return screens[-1] if screens else None

    def check_scan(self, scan: QuadScan) -> None:
        """Refuse a scan with magnets or screens that the lattice lacks; see `check_names`."""
        check_names(scan, self.calibrations, self.places, self.default_screen, self.rest_energy)

    @property
    def magnets(self) -> list[str]:
        """Names of the magnets and supplies that can be set, as of a `Beamline`."""
        return list(self.calibrations)

    def check_magnets(self, limits: Iterable[str]) -> None:
        """Refuse limits of a magnet that the lattice lacks.

        Raises
        ------
        InputError
            Naming the file and the nearest magnets.
        """
        for name in limits:
            if name not in self.calibrations:
                known = nearest(name, list(self.calibrations))
                raise InputError(f"--vary {name}: no magnet '{name}'", known, path=self.path)

    def check_energies(self, energies: Iterable[float]) -> None:
        """Refuse energies in MeV that the particle cannot have.

        Raises
        ------
        InputError
            At the first such energy.
        """
        for energy in energies:
            if expected := expected_energy(energy, self.particle):
                raise InputError(f"--energies {energy:g} MeV", expected)


def read_toml_lattice(path: str | PathLike[str]) -> LatticeFile:
    """Read and check a TOML lattice without building it.

    Raises
    ------
    InputError
        If the file cannot be used, naming the line of the key.
    """
    top = read_toml(path, "a lattice", FORMAT)
    values = top.values(TOP_KEYS)
    energy = _total_energy(top, values["particle"])
    if len(top.table["element"]) > MAX_ELEMENTS:
        found = f"more than {MAX_ELEMENTS} elements"
        raise top.error(found, "a line that a machine has", "element")
    sections = top.sections("element")
    elements = tuple(_read_element(section, i) for i, section in enumerate(sections, 1))
    _check_names(elements, sections)
    for element, section in zip(elements, sections, strict=True):
        _check_slice(element, section, energy, REST_ENERGY[values["particle"]])
    return LatticeFile(
        path=path,
        sha256=top.sha256,
        energy=energy,
        elements=elements,
        design=_design_twiss(top, [e["name"] for e in elements]),
        **values | {"name": values["name"] or Path(name_of(path)).stem},
    )


def _total_energy(top: Section, particle: str) -> float:
    """Total energy in MeV, from whichever of the three keys is present."""
    key = top.one_of(ENERGY_KEYS)
    number, kind = float(top.table[key]), ENERGY_KEYS[key]
    total = total_energy(number, kind, REST_ENERGY[particle])
    expected = expected_energy(total, particle)
    if expected is None and kind != "total" and not number > 0.0:
        expected = f"a {kind} energy above zero" if kind == "kinetic" else "a momentum above zero"
    if expected:
        raise top.error(f"{number:g} MeV", expected, key)
    return total


def _read_element(section: Section, number: int) -> Mapping[str, Any]:
    """Check the table of an element, and return it with a name and its gradient table."""
    kind = section.table.get("type")
    if not isinstance(kind, str) or kind not in ELEMENTS:
        found = f"element {number} of " + (f"type {kind!r}"[:80] if kind else "no type")
        raise section.error(found, nearest(str(kind), list(ELEMENTS)), "type")
    section.values(ELEMENTS[kind] | {"type": NAME_KEY})
    if kind in SETTING_KEYS:
        *_, last = SETTING_KEYS[kind]
        hint = f"; {last} = 0 where every row of a scan sets it"
        _check_strength(section, section.one_of(SETTING_KEYS[kind], hint))
    if section.table.get("angle_deg") == 0:
        raise section.error("a dipole that does not bend", "a drift", "angle_deg")
    table = {"name": f"{kind}{number}"} | section.table
    if tables := set(TABLE_KEYS) & set(table):
        table["gradient_table"] = gradient_table(section, tables.pop(), table["length_m"])
    return table


def _check_strength(section: Section, setting: str) -> None:
    """Require exactly one calibration if the setting is a current, otherwise none."""
    given = set().union(*CALIBRATIONS) & set(section.table)
    name, current = section.table["name"], setting == "current_A"
    if "signed_intercept" in section.table and not given >= POLYNOMIAL_CALIBRATION:
        expected = "gradient_polynomial_T_per_m beside it, whose first number it signs"
        raise section.error(f"{name} with signed_intercept", expected, "signed_intercept")
    if given and not current:
        found = f"{name} with {setting} and a current calibration"
        raise section.error(found, "current_A = ... for its setting, or no calibration", setting)
    if current and given not in CALIBRATIONS:
        found = f"{name} set by current_A without one calibration"
        expected = "both slope and intercept, gradient_polynomial_T_per_m, or one gradient table"
        raise section.error(found, expected, setting)
    for key in given & POLYNOMIAL_CALIBRATION:
        if len(numbers := section.table[key]) < 2:
            raise section.error(f"{numbers!r}"[:80], COEFFICIENTS, key)


def _check_names(elements: tuple[Mapping[str, Any], ...], sections: list[Section]) -> None:
    """Check that names are unique and that magnets on one supply have equal settings."""
    first_use: dict[str, int] = {}
    for number, (element, section) in enumerate(zip(elements, sections, strict=True), 1):
        if (first := first_use.setdefault(element["name"], number)) < number:
            expected = f"another name: element {first} has it"
            raise section.error(f"the name '{element['name']}' used again", expected, "name")
    settings: dict[str, dict[str, float]] = {}
    for element, section in zip(elements, sections, strict=True):
        if (supply := element.get("supply")) is None:
            continue
        if supply in first_use:
            raise section.error(f"supply '{supply}'", "another name: an element has it", "supply")
        own = {key: element[key] for key in STRENGTHS if key in element}
        if (first := settings.setdefault(supply, own)) != own:
            found, expected = (
                ", ".join(f"{key} = {v:g}" for key, v in each.items()) for each in (own, first)
            )
            raise section.error(f"{found} on supply '{supply}'", f"{expected}, as above", "supply")


def _check_slice(element: Mapping[str, Any], section: Section, energy: float, rest: float) -> None:
    """Refuse a slice below the rest energy, and one whose orbit misses the exit face."""
    offset = element.get("energy_offset", 0.0)
    if element["type"] != "sector_dipole" or offset == 0.0:
        return
    slice_energy = energy * (1.0 + offset)
    found = f"energy_offset {offset:g}, a slice of {slice_energy:g} MeV"
    if slice_energy <= rest:
        expected = f"more than the rest energy of {rest:.6g} MeV; offsets are of total energies"
        raise section.error(found, expected, "energy_offset")
    ratio = ((slice_energy**2 - rest**2) / (energy**2 - rest**2)) ** 0.5
    exit_edge = math.radians(element.get("exit_edge_deg", 0.0))
    face = math.sin(math.radians(element["angle_deg"]) - exit_edge)
    if abs((math.sin(exit_edge) + face) / ratio - face) >= 1.0:  # as optics.hard_edge_slice
        expected = "a slice that leaves through the exit face"
        raise section.error(found, expected, "energy_offset")


def _design_twiss(top: Section, names: list[str]) -> Mapping[str, Any] | None:
    """Check the design Twiss parameters; None if there are none."""
    if "design" not in top.table:
        return None
    section = top.section("design")
    section.values({"at": NAME_KEY, "x": TWISS_KEY, "y": TWISS_KEY})
    if section.table["at"] not in names:
        found = f"design Twiss at '{section.table['at']}'"
        raise section.error(found, nearest(section.table["at"], names), "at")
    for plane in set(section.table) - {"at"}:
        twiss = section.table[plane]
        is_valid = set(twiss) == {"beta_m", "alpha"} and all(map(is_number, twiss.values()))
        if not is_valid or not twiss["beta_m"] > 0:
            expected = f"{plane} = {{ beta_m = ..., alpha = ... }}, beta_m > 0"
            raise section.error(f"design {plane} = {twiss!r}"[:80], expected, plane)
    return section.table


def element_of(table: Mapping[str, Any], mass: float) -> Element:
    """Build the element of a checked table, for particles of rest energy `mass` in MeV.

    Examples
    --------
    >>> element_of({"type": "screen", "name": "S", "resolution_um": 5.0}, mass=0.511).resolution
    4.9999999999999996e-06
    """
    from beamfit.optics import elements

    name, length = table["name"], float(table.get("length_m", 0.0))
    match table["type"]:
        case "drift":
            return elements.Drift(name, length)
        case "marker":
            return elements.Marker(name)
        case "screen":
            return elements.Screen(name, 1e-6 * table.get("resolution_um", 0.0))
        case "thin_lens":
            return elements.ThinLens(name, *_strength(table, mass))
        case "quadrupole":
            return elements.Quadrupole(name, length, *_strength(table, mass))
    keys = ("angle_deg", "entrance_edge_deg", "exit_edge_deg")
    angle, *edges = (float(np.radians(table.get(key, 0.0))) for key in keys)
    return elements.SectorDipole(
        name,
        float(np.copysign(table["radius_m"], angle)),
        angle,
        *edges,
        table["bend_plane"],
        float(table.get("energy_offset", 0.0)),
        float(table.get("k1_per_m2", 0.0)),
        mass=mass,
    )


def _strength(table: Mapping[str, Any], mass: float) -> tuple[float, Calibration]:
    """Setting of a magnet, and its calibration."""
    from beamfit.optics import calibration

    key = next(key for key in STRENGTHS if key in table)
    setting = float(table[key])
    if (unit_calibration := calibration.plain_meaning(STRENGTHS[key], mass)) is not None:
        return setting, unit_calibration
    if "slope" in table:
        slope, intercept = float(table["slope"]), float(table["intercept"])
        return setting, calibration.SlopeIntercept(slope, intercept)
    if "gradient_table" in table:
        currents, gradients = zip(*table["gradient_table"], strict=True)
        return setting, calibration.CurrentTable(currents, gradients, mass=mass)
    coefficients = tuple(map(float, table["gradient_polynomial_T_per_m"]))
    signed = table.get("signed_intercept", False)
    return setting, calibration.CurrentPolynomial(coefficients, signed_intercept=signed, mass=mass)


TABLE_EXAMPLE = "current_A,gradient_T_per_m"
# Columns of the gradient -> factor to T/m, as a function of the magnet's length in m.
GRADIENT_FACTORS = {
    "gradient_T_per_m": lambda length: 1.0,
    "integrated_gradient_T": lambda length: 1.0 / length,
    "integrated_gradient_kG": lambda length: 0.1 / length,
}


def gradient_table(section: Section, key: str, length: float) -> list[tuple[float, float]]:
    """Read a gradient table of a quadrupole: currents in A and gradients in T/m.

    Parameters
    ----------
    section : Section
        Table of the quadrupole.
    key : {"gradient_table", "gradient_table_file"}
        Pairs [A, T/m] in the lattice, or the path of a CSV file relative to the lattice's folder.
    length : float
        Length of the magnet, m.

    Returns
    -------
    list of (float, float)
        Points in order of current.

    Raises
    ------
    InputError
        If there are fewer than two points, a current is repeated, or a value is no number.
    """
    value = section.table[key]
    if key == "gradient_table":
        for pair in value:
            if not (isinstance(pair, list) and len(pair) == 2 and all(map(is_number, pair))):
                raise section.error(f"{pair!r}"[:80], "pairs [current in A, gradient in T/m]", key)
        points = [(float(current), float(gradient)) for current, gradient in value]
    else:
        points = _read_points(read_sheet(Path(section.path).parent / value, TABLE_EXAMPLE), length)
    currents = sorted(current for current, _ in points)
    repeated = next((a for a, b in pairwise(currents) if a == b), None)
    if len(points) < 2 or repeated is not None:
        found = f"{repeated:g} A twice" if repeated is not None else f"{len(points)} points"
        expected = "two or more points of different currents, one of each"
        raise section.error(f"a gradient table with {found}", expected, key)
    return sorted(points)


def _read_points(sheet: Sheet, length: float) -> list[tuple[float, float]]:
    """Points of a gradient table file."""
    columns = columns_of(sheet, dict.fromkeys(("current_A", *GRADIENT_FACTORS), ""))
    given = [name for name in GRADIENT_FACTORS if name in columns]
    if "current_A" not in columns or len(given) != 1:
        found = "columns " + ", ".join(sheet.names)
        expected = "current_A and one of " + ", ".join(GRADIENT_FACTORS)
        raise sheet.header_error(found, expected)
    factor = GRADIENT_FACTORS[given[0]](length)
    gradients = factor * sheet.numbers(given[0])
    return list(zip(sheet.numbers("current_A").tolist(), gradients.tolist(), strict=True))
