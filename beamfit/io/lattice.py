"""Lattice files: versioned TOML, checked line by line before any optics is built."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

from beamfit.errors import InputError, nearest
from beamfit.io.files import digest, read_text
from beamfit.io.lattice_keys import ELEMENTS, FORMAT, NUMBER, STRENGTHS, TEXT, TOP, amiss
from beamfit.particles import REST_ENERGY

__all__ = ["LatticeFile", "read_toml_lattice"]


@dataclass(frozen=True)
class LatticeFile:
    """A checked lattice, as plain tables: no JAX needed to know what is in it.

    Attributes
    ----------
    elements : tuple of dict
        The element tables of the file, in order.
    calibrations : dict of str to str
        Magnet name to the unit of its setting.
    """

    path: str | PathLike[str]
    sha256: str
    name: str
    energy: float
    particle: str
    energy_spread: float
    elements: tuple[Mapping[str, Any], ...]
    calibrations: Mapping[str, str]
    design: Mapping[str, Any] | None = None
    source: str = ""

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


def read_toml_lattice(path: str | PathLike[str]) -> LatticeFile:
    """Read and check a TOML lattice without building it.

    Raises
    ------
    InputError
        If it cannot be used, naming the line of the key.
    """
    return _Reader(path).lattice()


class _Reader:
    """One lattice file being checked; knows where in the text each key stands."""

    def __init__(self, path: str | PathLike[str]) -> None:
        self.path = path
        self.text = read_text(path)
        self.heads = [
            n
            for n, t in enumerate(self.text.splitlines(), 1)
            if re.match(r"\s*\[\[\s*element\s*\]\]", t)
        ]
        try:
            self.document = tomllib.loads(self.text)
        except (ValueError, RecursionError) as error:  # integers too long, nesting too deep
            if re.search(r"^[^#=\n]*\bsize_[xy]_", self.text, re.MULTILINE):
                raise InputError(
                    "a scan where the lattice should be",
                    "the scan first and the lattice after --lattice; are they swapped?",
                    path=path,
                ) from None
            line = re.search(r"at line (\d+)", str(error))
            what = re.sub(r"\s*\(at .*\)", "", str(error))
            raise InputError(
                f"TOML that does not parse ({what})",
                "valid TOML",
                path=path,
                line=int(line[1]) if line else len(self.text.splitlines()),
            ) from None

    def error(
        self,
        found: str,
        expected: str,
        key: str | None = None,
        element: int | None = None,
        table: str | None = None,
    ) -> InputError:
        """Make the error that names the line on which the key (or its table) stands."""
        line = self._line(key, element, table)
        return InputError(found, expected, path=self.path, line=line, column=key)

    def _line(self, key: str | None, element: int | None, table: str | None = None) -> int:
        lines = self.text.splitlines()
        start = 0 if element is None or element >= len(self.heads) else self.heads[element] - 1
        if table is not None:
            head = re.compile(rf"\s*\[?\s*{table}\b")
            start = next((n for n, t in enumerate(lines) if head.match(t)), 0)
        if key is not None:
            # An element ends at the next table; the top level is searched to its first table.
            for n in range(start, len(lines)):
                if n > start and lines[n].lstrip().startswith("["):
                    break
                if re.match(rf"\s*['\"]?{re.escape(key)}['\"]?\s*=", lines[n]):
                    return n + 1
        return start + 1

    def lattice(self) -> LatticeFile:
        document = self.document
        found = document.get("format")
        if found != FORMAT:
            raise self.error(f"format {found!r}", f'format = "{FORMAT}"', "format")
        self.check_keys(document, *TOP, element=None)
        energy, particle = document["energy_MeV"], document.get("particle", "electron")
        if particle not in REST_ENERGY:
            raise self.error(f"particle '{particle}'", "electron, positron or proton", "particle")
        rest = REST_ENERGY[particle]
        if not rest < energy <= 1e7:
            raise self.error(
                f"{energy:g} MeV",
                f"a total energy between {rest:.6g} MeV and 10 TeV; is it in GeV or eV?",
                "energy_MeV",
            )
        if not document["element"]:
            raise self.error(
                "no elements", "tables [[element]] in the order of the beam", "element"
            )
        elements = [self.element(e, i) for i, e in enumerate(document["element"])]
        self.check_unique(elements)
        return LatticeFile(
            path=self.path,
            sha256=digest(self.path),
            name=document.get("name", Path(self.path).stem),
            energy=float(energy),
            particle=particle,
            energy_spread=float(document.get("energy_spread", 0.0)),
            elements=tuple(elements),
            calibrations={
                e["name"]: unit
                for e in elements
                for key, unit in STRENGTHS.items()
                if key in e and e["type"] in ("quadrupole", "thin_lens")
            },
            design=self.design(elements),
            source=document.get("source", ""),
        )

    def element(self, table: object, index: int) -> Mapping[str, Any]:
        """Check one element table and return it with a name."""
        if not isinstance(table, dict):
            raise self.error(f"element {table!r}", "a table [[element]]", "element")
        kind = table.get("type")
        if not isinstance(kind, str) or kind not in ELEMENTS:
            word = f"type {kind!r}" if kind is not None else "no type"
            raise self.error(
                f"element {index + 1} of {word}",
                nearest(str(kind), list(ELEMENTS)),
                "type",
                index,
            )
        required, optional = ELEMENTS[kind]
        self.check_keys(table, required | {"type": TEXT}, optional, index)
        if kind in ("quadrupole", "thin_lens"):
            self.check_strength(table, index)
        if kind == "sector_dipole" and table["bend_plane"] not in ("x", "y"):
            raise self.error(f"bend_plane '{table['bend_plane']}'", "x or y", "bend_plane", index)
        if kind == "sector_dipole" and table["angle_deg"] == 0:
            raise self.error("a dipole that does not bend", "a drift", "angle_deg", index)
        return {"name": f"{kind}{index + 1}"} | table

    def check_keys(
        self, table: Mapping, required: Mapping, optional: Mapping, element: int | None
    ) -> None:
        """Every required key, no unknown key, the right type, finite numbers."""
        where = "at the top level" if element is None else f"in element {element + 1}"
        for key in required:
            if key not in table:
                raise self.error(f"no '{key}' {where}", f"a line {key} = ...", None, element)
        kinds = {**required, **optional}
        for key, value in table.items():
            if key not in kinds:
                raise self.error(f"unknown key '{key}'", nearest(key, list(kinds)), key, element)
            expected = amiss(key, value, kinds[key])
            if expected:
                raise self.error(f"{value!r}"[:80], expected, key, element)

    def check_strength(self, table: Mapping, index: int) -> None:
        """One setting, and with a current exactly one calibration."""
        given = [k for k in STRENGTHS if k in table]
        if len(given) != 1:
            allowed = [k for k in STRENGTHS if k in ELEMENTS[table["type"]][1]]
            raise self.error(
                f"{table['name']} with " + (" and ".join(given) or "no setting"),
                "one of " + ", ".join(allowed),
                given[1] if len(given) > 1 else None,
                index,
            )
        line = {"slope", "intercept"} & set(table)
        polynomial = "gradient_polynomial_T_per_m" in table
        if "signed_intercept" in table and not polynomial:
            raise self.error(
                f"{table['name']} with signed_intercept",
                "gradient_polynomial_T_per_m beside it, whose first number it signs",
                "signed_intercept",
                index,
            )
        if given[0] != "current_A":
            if line or polynomial:
                raise self.error(
                    f"{table['name']} with {given[0]} and a current calibration",
                    "current_A = ... for its setting, or no calibration",
                    given[0],
                    index,
                )
            return
        if (len(line) == 2) == polynomial or len(line) == 1:
            raise self.error(
                f"{table['name']} set by current_A without one calibration",
                "both slope and intercept, or gradient_polynomial_T_per_m",
                "current_A",
                index,
            )
        numbers = table.get("gradient_polynomial_T_per_m", [0.0, 1.0])
        good = all(amiss("", c, NUMBER) is None for c in numbers)
        if len(numbers) < 2 or not good:
            raise self.error(
                f"{numbers!r}",
                "at least two numbers c0, c1, ... in T/m, T/(m A), ...",
                "gradient_polynomial_T_per_m",
                index,
            )

    def check_unique(self, elements: list[Mapping[str, Any]]) -> None:
        seen: dict[str, int] = {}
        for index, element in enumerate(elements):
            if element["name"] in seen:
                raise self.error(
                    f"the name '{element['name']}' used again",
                    f"another name: element {seen[element['name']] + 1} has it",
                    "name",
                    index,
                )
            seen[element["name"]] = index

    def design(self, elements: list[Mapping[str, Any]]) -> Mapping[str, Any] | None:
        """Check the design Twiss, if there is one."""
        table = self.document.get("design")
        if table is None:
            return None
        names = [e["name"] for e in elements]
        at = table.get("at")
        if at not in names:
            raise self.error(
                f"design Twiss at {at!r}", nearest(str(at), names), "at", table="design"
            )
        for plane in [k for k in table if k != "at"]:
            twiss = table[plane]
            good = plane in ("x", "y") and isinstance(twiss, dict)
            good = good and set(twiss) == {"beta_m", "alpha"}
            good = good and not any(amiss(k, v, NUMBER) for k, v in twiss.items())
            if not good or not twiss["beta_m"] > 0:
                raise self.error(
                    f"design {plane} = {twiss!r}",
                    "x = { beta_m = ..., alpha = ... }, beta_m > 0",
                    plane,
                    table="design",
                )
        return table
