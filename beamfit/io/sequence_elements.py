"""The elements of a MAD or elegant file as the tables of a beamfit lattice.

What a first-order, uncoupled line of one energy cannot hold is refused, never dropped.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from os import PathLike
from typing import Any

from beamfit.errors import InputError

# Parameters that bend, focus, couple or accelerate in a way beamfit does not model.
UNMODELLED = {
    "ks": "a solenoid field",
    "ksi": "a solenoid field",
    "b": "a field given as B",
    "k1s": "a skew gradient",
    "k0s": "a skew bend",
    "ktap": "a tapered field",
    "fse": "a field error",
    "etilt": "a tilt error",
    "t0": "a tilted component",
    "t1": "a tilted component",
    "bore": "a field given by its bore",
    "use_bn": "a field given by B1, B2, ...",
    "volt": "an accelerating voltage",
    "ex": "an electric field",
    "ey": "an electric field",
    "kill_ent_fringe": "an edge switched off",
    "kill_exi_fringe": "an edge switched off",
}
# Elements that are nothing where some parameter is zero.
NOTHING_AT_ZERO = {
    "srotation": ("angle",),
    "xrotation": ("angle",),
    "yrotation": ("angle",),
    "translation": ("dx", "dy", "ds"),
    "dipedge": ("h",),
    "nllens": ("knll",),
    "twcavity": ("volt",),
    "hacdipole": ("volt",),
    "vacdipole": ("volt",),
    "beambeam": ("charge",),
}
EDGES = ("edge1_effects", "edge2_effects")


@dataclass(frozen=True)
class Element:
    """An element of a line as its file has it.

    Attributes
    ----------
    name, type : str
        As in the file, the type in capitals.
    kind : str
        "screen", "marker", "quadrupole", "dipole", "thin" or "space".
    length : float
        m.
    normal, skew : tuple of float
        Dipole and quadrupole component, 1/m and 1/m², integrated in a thin element.
    angle : float
        Of a bend, rad.
    edges : tuple of float
        Its pole faces, rad, from those of a sector.
    said : mapping
        All parameters of the file that mean something.
    place : tuple of path and int, or None
        File and line that define it.
    elegant : bool
        Whether an absent FINT is that of elegant, and an RBEN what it takes for one.
    """

    name: str
    type: str
    kind: str
    length: float
    normal: tuple[float, ...] = (0.0, 0.0)
    skew: tuple[float, ...] = (0.0, 0.0)
    angle: float = 0.0
    edges: tuple[float, ...] = (0.0, 0.0)
    said: Mapping[str, Any] = field(default_factory=dict)
    place: tuple[str | PathLike[str] | None, int | None] = (None, None)
    elegant: bool = False

    def table(self) -> dict[str, Any]:
        """Give the table of a TOML lattice; what beamfit does not model is refused."""
        if self.kind in ("screen", "marker"):
            return {"type": self.kind, "name": self.name}
        self._check_unmodelled()
        own = {"quadrupole": self._quadrupole, "dipole": self._dipole, "thin": self._lens}
        return own.get(self.kind, self._space)()

    def _refuse(self, what: str, expected: str = "") -> InputError:
        return InputError(
            f"element '{self.name}' of type '{self.type}' {what}, which beamfit does not model",
            expected or "a line without it: cut the line after it, or set it to zero",
            *self.place,
        )

    def _number(self, key: str) -> float:
        """A parameter as the file has it; 0 where it has none."""
        if isinstance(value := self.said.get(key, 0.0), tuple):
            raise self._refuse(f"with several numbers as {key.upper()}", "one number")
        return float(value)

    def _check_unmodelled(self) -> None:
        for key, meaning in UNMODELLED.items():
            if self._number(key) != 0.0:
                raise self._refuse(f"with {meaning} ({key.upper()} = {self._number(key):g})")
        for key in NOTHING_AT_ZERO.get(self.type.lower(), ()):
            if self._number(key) != 0.0:
                raise self._refuse(f"with {key.upper()} = {self._number(key):g}")
        for key in EDGES:
            if key in self.said and self._number(key) == 0.0:
                raise self._refuse(f"with an edge switched off ({key.upper()} = 0)")
        if self.kind == "thin":
            return
        for key in ("knl", "ksl"):
            values = self.said.get(key, ())
            values = values if isinstance(values, tuple | list) else (values,)
            if any(float(v) for v in values[:2]):
                raise self._refuse(f"with multipole components of its own ({key.upper()})")

    def _space(self) -> dict[str, Any]:
        """A length without focusing: drifts, collimators, correctors, sextupoles, ..."""
        if any(self.normal) or any(self.skew):
            raise self._refuse("with a dipole or quadrupole component of its own")
        if self.length == 0.0:
            return {"type": "marker", "name": self.name}
        return {"type": "drift", "name": self.name, "length_m": self.length}

    def _quarter_turns(self) -> int:
        """Tilt of the element in units of 90°."""
        turns = self._number("tilt") / (math.pi / 2)
        # Four digits: files write pi/2 as 1.5708.
        if abs(turns - round(turns)) > 1e-4:
            raise self._refuse(
                f"tilted by {math.degrees(self._number('tilt')):g} degrees",
                "upright elements, or bends tilted by a multiple of 90 degrees",
            )
        return round(turns) % 4

    def _quadrupole(self) -> dict[str, Any]:
        self._check_own()
        self._check_length()
        k1 = self._upright() * self.normal[1] + 0.0
        return {"type": "quadrupole", "name": self.name, "length_m": self.length, "k1_per_m2": k1}

    def _check_own(self) -> None:
        if self.normal[0] or any(self.skew):
            raise self._refuse("with a dipole or skew component of its own")

    def _check_length(self) -> None:
        if self.length <= 0.0:
            raise self._refuse(f"of length {self.length:g} m", "a length above zero")

    def _upright(self) -> float:
        """The sign of a gradient: that of an element turned by 90° is the other one."""
        return -1.0 if self._quarter_turns() % 2 else 1.0

    def _dipole(self) -> dict[str, Any]:
        k1, angle, edges = self.normal[1], self.angle, self.edges
        self._check_dipole(angle)
        turns = self._quarter_turns()
        k1 = -k1 if turns % 2 else k1
        if angle == 0.0:
            straight = {"type": "quadrupole", "k1_per_m2": k1} if k1 else {"type": "drift"}
            return {"name": self.name, "length_m": self.length} | straight
        if turns in (2, 3):  # bends the other way; the edges are counted with the bend
            angle, edges = -angle, [-e for e in edges]
        return {
            "type": "sector_dipole",
            "name": self.name,
            "radius_m": self.length / abs(angle),
            "angle_deg": math.degrees(angle),
            "entrance_edge_deg": math.degrees(edges[0]),
            "exit_edge_deg": math.degrees(edges[1]),
            "bend_plane": "y" if turns % 2 else "x",
            "k1_per_m2": k1,
        }

    def _check_dipole(self, angle: float) -> None:
        if any(self.skew):
            raise self._refuse("with a skew component of its own")
        if self.elegant and "RB" in self.type:
            raise self._refuse(
                "(rectangular, whose length programs read differently)",
                "CSBEND or SBEN with the arc length and E1 = E2 = ANGLE/2",
            )
        self._check_length()
        k0 = self._number("k0")
        if k0 and abs(k0 * self.length - angle) > 1e-9:
            raise self._refuse(f"with a field (K0 = {k0:g}) that is not ANGLE/L")
        # elegant takes FINT = 0.5 where the file has none, MAD takes 0.
        usual = 0.5 if self.elegant else 0.0
        integrals = [self._number(k) for k in ("fint", "fintx", "fint1", "fint2")]
        if "fint" not in self.said:
            integrals.append(usual)
        gap = self._number("hgap") or self._number("hgapx")
        if gap and any(integrals):
            raise self._refuse(
                "with a fringe field (HGAP and FINT)",
                "HGAP = 0, or a TOML lattice with effective edge angles",
            )

    def _lens(self) -> dict[str, Any]:
        self._check_own()
        if not self.normal[1]:
            return {"type": "marker", "name": self.name}
        k1l = self._upright() * self.normal[1]
        return {"type": "thin_lens", "name": self.name, "k1l_per_m": k1l}


def element_tables(elements: Iterable[Element]) -> list[dict[str, Any]]:
    """Translate a line.

    Returns
    -------
    list of dict
        Tables with the keys of a TOML lattice. Markers and screens that occur several times
        are numbered as elegant numbers them, NAME#1, NAME#2.

    Raises
    ------
    InputError
        If an element does what beamfit does not model; it names element, type and file.
    """
    tables = [e.table() for e in elements]
    places = Counter(t["name"] for t in tables if t["type"] in ("marker", "screen"))
    seen: Counter[str] = Counter()
    for table in tables:
        name = table["name"]
        if table["type"] == "drift" and name in places:
            table["name"] = f"{name}.drift"  # half of a monitor with a length
        elif places[name] > 1:
            seen[name] += 1
            table["name"] = f"{name}#{seen[name]}"
    return tables
