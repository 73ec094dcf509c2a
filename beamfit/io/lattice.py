"""Lattice files: versioned TOML, checked line by line before any optics is built.

The keys of an element and the element they make stand here together.
"""

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

# A line has no more elements: what claims more is a mistake, or wants to fill the memory.
MAX_ELEMENTS = 50_000
FORMAT = "beamfit-lattice-1"
# Settings a magnet may be given, one of them; the key says the unit.
STRENGTHS = {
    "current_A": "A",
    "integrated_gradient_kG": "kG",
    "gradient_T_per_m": "T_per_m",
    "k1_per_m2": "k1",
    "k1l_per_m": "k1l",
}
LINE, POLYNOMIAL = {"slope", "intercept"}, {"gradient_polynomial_T_per_m"}
TABLE_KEYS = ("gradient_table", "gradient_table_file")
CALIBRATIONS = (LINE, POLYNOMIAL, *({key} for key in TABLE_KEYS))
POWERS = "at least two numbers c0, c1, ... in T/m, T/(m A), ..."
NAME, OPTIONAL = Key(kind=TEXT), Key(default=None)
LENGTH = Key(low=0.0, said="a positive number")
EDGE = Key(default=0.0, low=-90.0, high=90.0, said="an angle below 90 degrees")
SUPPLY = {"supply": Key(kind=TEXT, default=None)}
ELEMENTS: dict[str, dict[str, Key]] = {
    "drift": {"name": Key(kind=TEXT, default=None), "length_m": LENGTH},
    "quadrupole": {
        "name": NAME,
        "length_m": LENGTH,
        **dict.fromkeys(("current_A", "integrated_gradient_kG"), OPTIONAL),
        **dict.fromkeys(("gradient_T_per_m", "k1_per_m2"), OPTIONAL),
        **dict.fromkeys(("slope", "intercept"), OPTIONAL),
        "gradient_polynomial_T_per_m": Key(kind=LIST, default=None, said=POWERS, each=NUMBER),
        "signed_intercept": Key(kind=FLAG, default=False),
        "gradient_table": Key(kind=LIST, default=None),
        "gradient_table_file": Key(kind=TEXT, default=None),
        **SUPPLY,
    },
    "thin_lens": {
        "name": NAME,
        **SUPPLY,
        "integrated_gradient_kG": OPTIONAL,
        "k1l_per_m": OPTIONAL,
    },
    "sector_dipole": {
        "name": NAME,
        "radius_m": Key(low=0.0, said="a positive number; a negative angle bends the other way"),
        "angle_deg": Key(low=-360.0, high=360.0, said="an angle below 360 degrees"),
        "bend_plane": Key(kind=TEXT, among=("x", "y")),
        "entrance_edge_deg": EDGE,
        "exit_edge_deg": EDGE,
        "energy_offset": Key(
            default=0.0, low=-0.5, high=0.5, said="a relative offset between ± 0.5; is it in %?"
        ),
        "k1_per_m2": OPTIONAL,
    },
    "marker": {"name": NAME},
    "screen": {
        "name": NAME,
        "resolution_um": Key(
            default=0.0, low=0.0, high=2e4, said="zero or more micrometres, below 20 mm"
        ),
    },
}
TOP = {
    **dict.fromkeys(ENERGY_KEYS, OPTIONAL),
    "element": Key(kind=LIST),
    "name": Key("name", kind=TEXT, default=""),
    "source": Key(kind=TEXT, default=""),
    "particle": Key("particle", kind=TEXT, default="electron", among=tuple(REST_ENERGY)),
    "energy_spread": Key(
        "energy_spread",
        default=0.0,
        low=0.0,
        high=0.2,
        said="a relative spread between 0 and 0.2; is it in %?",
    ),
    "design": Key(kind=TABLE, default=None),
}
TWISS = Key(kind=TABLE, default=None)
# Keys and units by which a magnet of some type is set.
SETTINGS_OF = {
    kind: {k: unit for k, unit in STRENGTHS.items() if k in ELEMENTS[kind]}
    for kind in ("quadrupole", "thin_lens")
}


@dataclass(frozen=True)
class LatticeFile:
    """A checked lattice, as plain tables: no JAX needed to know what is in it.

    Attributes
    ----------
    elements : tuple of dict
        The element tables of the file, in order.
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
        """Magnet or supply to the unit of its setting."""
        return {
            e.get("supply", e["name"]): unit
            for e in self.elements
            for key, unit in SETTINGS_OF.get(e["type"], {}).items()
            if key in e
        }

    @property
    def rest_energy(self) -> float:
        """Rest energy of the particle, MeV."""
        return REST_ENERGY[self.particle]

    @property
    def places(self) -> list[str]:
        """Names at which a size may have been measured: screens and markers."""
        return [e["name"] for e in self.elements if e["type"] in ("screen", "marker")]

    @property
    def default_screen(self) -> str | None:
        """The last screen, used where a scan names none."""
        screens = [e["name"] for e in self.elements if e["type"] == "screen"]
        return screens[-1] if screens else None

    def check_scan(self, scan: QuadScan) -> None:
        """Refuse a scan that names what the lattice does not have, as `names.check_names`."""
        check_names(scan, self.calibrations, self.places, self.default_screen, self.rest_energy)

    def check_magnets(self, limits: Iterable[str]) -> None:
        """Refuse limits of a magnet that the lattice does not have.

        Raises
        ------
        InputError
            Naming the file and the nearest magnet.
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
            Naming the first.
        """
        for energy in energies:
            if expected := expected_energy(energy, self.particle):
                raise InputError(f"--energies {energy:g} MeV", expected)


def read_toml_lattice(path: str | PathLike[str]) -> LatticeFile:
    """Read and check a TOML lattice without building it.

    Raises
    ------
    InputError
        If it cannot be used, naming the line of the key.
    """
    top = read_toml(path, "a lattice", FORMAT)
    said = top.values(TOP)
    energy = _energy(top, said["particle"])
    if len(top.table["element"]) > MAX_ELEMENTS:
        raise top.error(
            f"more than {MAX_ELEMENTS} elements", "a line that a machine has", "element"
        )
    sections = top.sections("element")
    elements = tuple(_element(section, i) for i, section in enumerate(sections, 1))
    _check_names(elements, sections)
    for element, section in zip(elements, sections, strict=True):
        _check_slice(element, section, energy, REST_ENERGY[said["particle"]])
    return LatticeFile(
        path=path,
        sha256=top.sha256,
        energy=energy,
        elements=elements,
        design=_design(top, [e["name"] for e in elements]),
        **said | {"name": said["name"] or Path(name_of(path)).stem},
    )


def _energy(top: Section, particle: str) -> float:
    """Total energy in MeV, from the one of its three keys that is there."""
    key = top.one_of(ENERGY_KEYS)
    number, kind = float(top.table[key]), ENERGY_KEYS[key]
    total = total_energy(number, kind, REST_ENERGY[particle])
    expected = expected_energy(total, particle)
    if expected is None and kind != "total" and not number > 0.0:
        expected = f"a {kind} energy above zero" if kind == "kinetic" else "a momentum above zero"
    if expected:
        raise top.error(f"{number:g} MeV", expected, key)
    return total


def _element(section: Section, number: int) -> Mapping[str, Any]:
    """Check one element table and return it with a name."""
    kind = section.table.get("type")
    if not isinstance(kind, str) or kind not in ELEMENTS:
        word = f"element {number} of " + (f"type {kind!r}"[:80] if kind else "no type")
        raise section.error(word, nearest(str(kind), list(ELEMENTS)), "type")
    section.values(ELEMENTS[kind] | {"type": NAME})
    if kind in SETTINGS_OF:
        *_, last = SETTINGS_OF[kind]
        hint = f"; {last} = 0 where every row of a scan sets it"
        _check_strength(section, section.one_of(SETTINGS_OF[kind], hint))
    if section.table.get("angle_deg") == 0:
        raise section.error("a dipole that does not bend", "a drift", "angle_deg")
    table = {"name": f"{kind}{number}"} | section.table
    if given := set(TABLE_KEYS) & set(table):
        table["gradient_table"] = gradient_table(section, given.pop(), table["length_m"])
    return table


def _check_strength(section: Section, setting: str) -> None:
    """Require exactly one calibration where there is a current, none elsewhere."""
    given = set().union(*CALIBRATIONS) & set(section.table)
    name, current = section.table["name"], setting == "current_A"
    if "signed_intercept" in section.table and not given >= POLYNOMIAL:
        expected = "gradient_polynomial_T_per_m beside it, whose first number it signs"
        raise section.error(f"{name} with signed_intercept", expected, "signed_intercept")
    if given and not current:
        found = f"{name} with {setting} and a current calibration"
        raise section.error(found, "current_A = ... for its setting, or no calibration", setting)
    if current and given not in CALIBRATIONS:
        found = f"{name} set by current_A without one calibration"
        expected = "both slope and intercept, gradient_polynomial_T_per_m, or one gradient table"
        raise section.error(found, expected, setting)
    for key in given & POLYNOMIAL:
        if len(numbers := section.table[key]) < 2:
            raise section.error(f"{numbers!r}"[:80], POWERS, key)


def _check_names(elements: tuple[Mapping[str, Any], ...], sections: list[Section]) -> None:
    """Check names, and that magnets on one supply, which no element is called, are set alike."""
    seen: dict[str, int] = {}
    for number, (element, section) in enumerate(zip(elements, sections, strict=True), 1):
        if (first := seen.setdefault(element["name"], number)) < number:
            expected = f"another name: element {first} has it"
            raise section.error(f"the name '{element['name']}' used again", expected, "name")
    settings: dict[str, dict[str, float]] = {}
    for element, section in zip(elements, sections, strict=True):
        if (supply := element.get("supply")) is None:
            continue
        if supply in seen:
            raise section.error(f"supply '{supply}'", "another name: an element has it", "supply")
        own = {key: element[key] for key in STRENGTHS if key in element}
        if (first := settings.setdefault(supply, own)) != own:
            found, expected = (
                ", ".join(f"{key} = {v:g}" for key, v in said.items()) for said in (own, first)
            )
            raise section.error(f"{found} on supply '{supply}'", f"{expected}, as above", "supply")


def _check_slice(element: Mapping[str, Any], section: Section, energy: float, rest: float) -> None:
    """Refuse a slice of less than the rest energy, and one whose circle misses the exit face."""
    offset = element.get("energy_offset", 0.0)
    if element["type"] != "sector_dipole" or offset == 0.0:
        return
    sliced = energy * (1.0 + offset)
    found = f"energy_offset {offset:g}, a slice of {sliced:g} MeV"
    if sliced <= rest:
        expected = f"more than the rest energy of {rest:.6g} MeV; offsets are of total energies"
        raise section.error(found, expected, "energy_offset")
    ratio = ((sliced**2 - rest**2) / (energy**2 - rest**2)) ** 0.5
    leaving = math.radians(element.get("exit_edge_deg", 0.0))
    face = math.sin(math.radians(element["angle_deg"]) - leaving)
    if abs((math.sin(leaving) + face) / ratio - face) >= 1.0:  # as optics.hard_edge_slice
        expected = "a slice that leaves through the exit face"
        raise section.error(found, expected, "energy_offset")


def _design(top: Section, names: list[str]) -> Mapping[str, Any] | None:
    """Check the design Twiss, if there is one."""
    if "design" not in top.table:
        return None
    section = top.section("design")
    section.values({"at": NAME, "x": TWISS, "y": TWISS})
    if section.table["at"] not in names:
        found = f"design Twiss at '{section.table['at']}'"
        raise section.error(found, nearest(section.table["at"], names), "at")
    for plane in set(section.table) - {"at"}:
        twiss = section.table[plane]
        numbers = set(twiss) == {"beta_m", "alpha"} and all(map(is_number, twiss.values()))
        if not numbers or not twiss["beta_m"] > 0:
            expected = f"{plane} = {{ beta_m = ..., alpha = ... }}, beta_m > 0"
            raise section.error(f"design {plane} = {twiss!r}"[:80], expected, plane)
    return section.table


def element_of(table: Mapping[str, Any], mass: float) -> Element:
    """Build the element a checked table describes, for particles of a rest energy in MeV.

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
    """The setting of a magnet and what it means."""
    from beamfit.optics import calibration

    key = next(key for key in STRENGTHS if key in table)
    setting = float(table[key])
    if (meaning := calibration.plain_meaning(STRENGTHS[key], mass)) is not None:
        return setting, meaning
    if "slope" in table:
        slope, intercept = float(table["slope"]), float(table["intercept"])
        return setting, calibration.SlopeIntercept(slope, intercept)
    if "gradient_table" in table:
        currents, gradients = zip(*table["gradient_table"], strict=True)
        return setting, calibration.CurrentTable(currents, gradients, mass=mass)
    numbers = tuple(map(float, table["gradient_polynomial_T_per_m"]))
    signed = table.get("signed_intercept", False)
    return setting, calibration.CurrentPolynomial(numbers, signed_intercept=signed, mass=mass)


EXAMPLE = "current_A,gradient_T_per_m"
# Columns of the gradient, and what makes them T/m in a magnet of some length in m.
GRADIENTS = {
    "gradient_T_per_m": lambda length: 1.0,
    "integrated_gradient_T": lambda length: 1.0 / length,
    "integrated_gradient_kG": lambda length: 0.1 / length,
}


def gradient_table(section: Section, key: str, length: float) -> list[tuple[float, float]]:
    """Read the current in A and the gradient in T/m of a quadrupole, by rising current.

    Parameters
    ----------
    section : Section
        The quadrupole's table of the lattice.
    key : {"gradient_table", "gradient_table_file"}
        Pairs [A, T/m] in the lattice, or the name of a CSV file, from the lattice's folder.
    length : float
        Of the magnet, m.

    Returns
    -------
    list of (float, float)

    Raises
    ------
    InputError
        If there are fewer than two points, a current stands twice, or something is no number.
    """
    said = section.table[key]
    if key == "gradient_table":
        for pair in said:
            if not (isinstance(pair, list) and len(pair) == 2 and all(map(is_number, pair))):
                raise section.error(f"{pair!r}"[:80], "pairs [current in A, gradient in T/m]", key)
        points = [(float(current), float(gradient)) for current, gradient in said]
    else:
        points = _points(read_sheet(Path(section.path).parent / said, EXAMPLE), length)
    currents = sorted(current for current, _ in points)
    twice = next((a for a, b in pairwise(currents) if a == b), None)
    if len(points) < 2 or twice is not None:
        found = f"{twice:g} A twice" if twice is not None else f"{len(points)} points"
        expected = "two or more points of different currents, one of each"
        raise section.error(f"a gradient table with {found}", expected, key)
    return sorted(points)


def _points(sheet: Sheet, length: float) -> list[tuple[float, float]]:
    """The points of a file."""
    columns = columns_of(sheet, dict.fromkeys(("current_A", *GRADIENTS), ""))
    given = [name for name in GRADIENTS if name in columns]
    if "current_A" not in columns or len(given) != 1:
        found = "columns " + ", ".join(sheet.names)
        expected = "current_A and one of " + ", ".join(GRADIENTS)
        raise sheet.header_error(found, expected)
    factor = GRADIENTS[given[0]](length)
    gradients = factor * sheet.numbers(given[0])
    return list(zip(sheet.numbers("current_A").tolist(), gradients.tolist(), strict=True))
