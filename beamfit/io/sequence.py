"""Read lines and sequences of MAD-X, MAD-8 and elegant files as beamfit lattices.

A feature that a first-order, uncoupled line of one energy cannot represent is refused, not ignored.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator
from itertools import count
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

from lark import Tree

from beamfit.errors import InputError, nearest
from beamfit.io.dialects import DIALECTS, ELEGANT, MADX, encode_name
from beamfit.io.files import digest, read_text
from beamfit.io.lattice import MAX_ELEMENTS, LatticeFile
from beamfit.io.madx import IGNORED_PARAMETERS, Attribute, Definition, Interpreter, word_of
from beamfit.io.madx_values import parse, words
from beamfit.particles import LIGHT, REST_ENERGY, expected_energy

# Gaps and overlaps up to this length in m are ignored, as in MAD-X.
MAX_OVERLAP = 1e-6
# Distance from an element's reference point (REFER) to its centre, in lengths.
TO_CENTRE = {"entry": 0.5, "centre": 0.0, "center": 0.0, "exit": -0.5}
# Classes that become screens, and drifts.
SCREEN_CLASSES = words(
    "monitor hmonitor vmonitor imonitor blmonitor slmonitor instrument profile wire"
)
DRIFT_CLASSES = words(
    "drift kicker hkicker vkicker tkicker sextupole octupole collimator ecollimator rcollimator "
    "solenoid rfcavity twcavity hacdipole vacdipole elseparator placeholder"
)
# Parameters that are evaluated: modelled, or refused unless zero.
UNDERSTOOD_PARAMETERS = words(
    "l k0 k1 angle tilt knl ksl k1s k0s ktap hgap fint fintx ks ksi volt ex ey ex_l ey_l "
    "kill_ent_fringe kill_exi_fringe dx dy ds h knll charge cnll bet sigx sigy xma yma"
)
# Particles that MAD-X knows by name, and the particles of negative charge.
MADX_PARTICLES = words("positron electron proton antiproton")
NEGATIVE_CHARGES = dict.fromkeys(words("electron antiproton H-"), -1.0)
# Relative difference of masses of the same particle.
MASS_TOLERANCE = 2e-4
# Parameters that bend, focus, couple or accelerate in a way beamfit does not model; and classes
# that have no effect while the parameters listed are zero.
UNMODELLED = words(
    "ks ksi b k1s k0s ktap fse etilt t0 t1 bore use_bn volt ex ey kill_ent_fringe kill_exi_fringe"
)
IDENTITY_AT_ZERO = {
    **dict.fromkeys(words("srotation xrotation yrotation"), ("angle",)),
    "translation": ("dx", "dy", "ds"),
    "dipedge": ("h",),
    "nllens": ("knll",),
    "beambeam": ("charge",),
}
# elegant's switches of the edges of a bend.
EDGE_SWITCHES = ("edge1_effects", "edge2_effects")
# Kind of element of each class.
ELEMENT_KINDS = dict.fromkeys(SCREEN_CLASSES, "screen") | dict.fromkeys(DRIFT_CLASSES, "space")
ELEMENT_KINDS |= dict.fromkeys(IDENTITY_AT_ZERO, "space")
ELEMENT_KINDS |= {"marker": "marker", "quadrupole": "quadrupole", "multipole": "thin"}
ELEMENT_KINDS |= {"sbend": "dipole", "rbend": "dipole", "nothing": "nothing"}


def read_sequence(
    path: str | PathLike[str], *, use: str | None = None, energy: float | None = None
) -> LatticeFile:
    """Read a line or sequence of a MAD-X, MAD-8 or elegant file.

    Parameters
    ----------
    path : str or path
        The file: ``.madx``, ``.seq``; ``.mad8``, ``.mad``; ``.lte``.
    use : str, optional
        Name of the LINE or SEQUENCE; not needed if the file has only one, or a USE.
    energy : float, optional
        Total energy in MeV; overrides the file's BEAM. An elegant file has no energy.

    Returns
    -------
    LatticeFile
        The line after the last statement. The setting of a quadrupole is its k1 in 1/m².

    Raises
    ------
    InputError
        If a statement cannot be executed, or the line has a feature that beamfit does not model.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> file = pathlib.Path(tempfile.mkdtemp()) / "line.madx"
    >>> _ = file.write_text("beam, particle=electron, energy=0.1; q: quadrupole, l=0.1, k1=1;"
    ...                     "s: monitor; lc: line=(q, s); q->k1 = 2;")
    >>> read_sequence(file).elements[0]["k1_per_m2"]
    2.0
    """
    if (suffix := Path(path).suffix.lower()) == ".ele":
        expected = "the lattice file (.lte) that its &run_setup names"
        raise InputError("an elegant command file", expected, path=path)
    program = Interpreter(DIALECTS[suffix])
    program.run(read_text(path), path)
    program.finish(path)
    line = _select_line(program, path, use)
    particle, total = _beam(program, path, line.name.lower(), energy)
    try:
        elements = number_repeated(_Line(program, line).tables())
    except RecursionError:
        found = f"'{line.name}', lists within lists or places FROM one another without end"
        raise line.error(found, "a line that a machine has") from None
    if not elements:
        raise line.error(f"'{line.name}' without elements", "a line with magnets and a screen")
    return LatticeFile(path, digest(path), line.name, total, particle, tuple(elements))


def _select_line(program: Interpreter, path: str | PathLike[str], use: str | None) -> Definition:
    """The line or sequence that ``use`` or a USE names, or the only one."""
    names = [line.name for line in program.lines.values()]
    if not names:
        expected = f"a valid {program.dialect.name} file with one of them"
        raise InputError("no LINE and no SEQUENCE", expected, path)
    wanted = use or program.used_line
    if wanted is None and len(names) > 1:
        found = f"{len(names)} lines or sequences"
        raise InputError(found, f"--use NAME with {nearest('', names)}", path)
    wanted = (names[0] if wanted is None else wanted).strip("\"'").lower()
    if (key := encode_name(wanted)) not in program.lines:
        raise InputError(f"no line or sequence '{wanted}'", nearest(wanted, names), path)
    return program.lines[key]


class _Position(NamedTuple):
    """Element (or end) of a sequence: its start and length in m, and the line that places it."""

    element: Definition | None
    start: float
    length: float
    source: tuple[str | PathLike[str], int]


class _Line:
    """Expansion of a line or sequence to its elements, in order."""

    def __init__(self, program: Interpreter, line: Definition) -> None:
        self.program, self.line, self.element_count = program, line, 0

    def tables(self) -> Iterator[dict[str, Any]]:
        """Tables of the elements, with drifts in the gaps."""
        if self.line.kind == "line":
            for name, reflected in self._members(self.line):
                reflect = reflected and self.program.dialect is not MADX  # MAD-X does not reflect
                yield from self._element_tables(self.program.elements[name], reflect)
            return
        end, number = 0.0, count()
        last = _Position(None, self._length(self.line), 0.0, (self.line.path, self.line.line))
        for position in [*self._positions(self.line, 0.0), last]:
            gap = position.start - end
            if gap < -MAX_OVERLAP:
                what = "elements beyond the end"
                if position.element is not None:
                    what = f"'{position.element.name}' overlapping"
                expected = "elements in the order of their places that do not overlap"
                raise InputError(f"{what} by {-gap:g} m", expected, *position.source)
            if gap > MAX_OVERLAP:
                yield {"type": "drift", "name": f"drift_{next(number)}", "length_m": gap}
            if position.element is not None:
                yield from self._element_tables(position.element)
                end = position.start + position.length

    def _number(self, element: Definition, key: str) -> float:
        parameter = element.parameters.get(key)
        return 0.0 if parameter is None else _single_number(self.program, parameter)

    def _length(self, element: Definition) -> float:
        """Length along the beam; MAD-X gives the chord of an RBEND, unless RBARC is off."""
        length = self._number(element, "l")
        if element.kind == "sequence" and length <= 0.0:
            raise element.error(f"sequence '{element.name}' of length {length:g} m", "L above zero")
        if element.kind == "multipole" and self.program.dialect is not ELEGANT:
            return 0.0
        if length < 0.0 or (element.kind == "marker" and length):
            found = f"'{element.name}' of length {length:g} m"
            raise element.error(found, "a length that MAD-X takes")
        half = 0.5 * self._number(element, "angle") if element.kind == "rbend" else 0.0
        return length * half / math.sin(half) if half and self.program.rbarc else length

    def _positions(self, sequence: Definition, start: float) -> Iterator[_Position]:
        """Positions of the elements of a sequence that starts at `start`."""
        for i, (name, place) in enumerate(sequence.placements):
            self._count(sequence)
            element = self._element_of(sequence, name)
            first = start + self._centre(sequence, i) - 0.5 * self._length(element)
            if element.kind == "sequence":
                yield from self._positions(element, first)
            else:
                at = place["at"]
                yield _Position(element, first, self._length(element), (at.path, at.line))

    def _element_of(self, sequence: Definition, name: str) -> Definition:
        """Element or sequence of a name; a LINE within a sequence is refused."""
        element = self.program.elements.get(name) or self.program.lines[name]
        if element.kind == "line":
            found = f"line '{element.name}' within a sequence"
            raise sequence.error(found, "elements and sequences")
        return element

    def _centre(self, sequence: Definition, i: int) -> float:
        """Centre of the i-th element or sequence in a sequence, from its start, m."""
        name, place = sequence.placements[i]
        element = self._element_of(sequence, name)
        if "at" not in place:
            raise sequence.error(f"'{element.name}' without a place", "AT = ...")
        at = _single_number(self.program, place["at"])
        if "from" in place:
            other = word_of(place["from"]).lower()
            names = [n for n, _ in sequence.placements]
            if other not in names:
                raise sequence.error(f"'{element.name}' FROM '{other}'", nearest(other, names))
            at += self._centre(sequence, names.index(other))
        if element.kind == "sequence" and "refpos" in element.parameters:
            return at + 0.5 * self._length(element) - self._reference_position(element)
        refer = word_of(sequence.parameters.get("refer"), "centre").lower()
        if refer not in TO_CENTRE:
            raise sequence.error(f"REFER = {refer}", "ENTRY, CENTRE or EXIT")
        return at + TO_CENTRE[refer] * self._length(element)

    def _reference_position(self, element: Definition) -> float:
        """Centre of the element that REFPOS of a sequence names, from the sequence's start, m."""
        name = word_of(element.parameters["refpos"]).lower()
        names = [n for n, _ in element.placements]
        if name not in names:
            raise element.error(f"REFPOS = '{name}'", nearest(name, names))
        return self._centre(element, names.index(name))

    def _members(self, line: Definition) -> list[tuple[str, bool]]:
        """Names of the elements of a LINE, in order, each with True if it is reflected."""
        try:
            tree = parse(line.members, "list")
        except ValueError as error:
            raise line.error(f"a list {error}", "NAME: LINE = (A, 2*B, -C, (D, E));") from None
        return self._list_members(line, tree)

    def _list_members(self, line: Definition, tree: Tree) -> list[tuple[str, bool]]:
        """Names in a parsed list; see `_members`."""
        members: list[tuple[str, bool]] = []
        for *prefixes, element in (member.children for member in tree.children):
            number = next((int(word[:9]) for word in prefixes if word.isdigit()), 1)
            if number < 1:
                raise line.error(f"{number} times an element", "one or more")
            expand = self._list_members if isinstance(element, Tree) else self._named_members
            part = expand(line, element)
            self._count(line, number * len(part))
            if "-" in prefixes:
                part = [(name, not reflected) for name, reflected in part[::-1]]
            members += part * number
        return members

    def _named_members(self, line: Definition, label: str) -> list[tuple[str, bool]]:
        """Element of a name, or the members of a LINE of that name."""
        name = label.lower()
        if name in self.program.elements:
            return [(name, False)]
        lines = self.program.lines
        if name not in lines or lines[name].kind != "line":
            names = [d.name for d in (*self.program.elements.values(), *lines.values())]
            what = "a sequence" if name in lines else "which nothing defines"
            raise line.error(f"'{name}' in a LINE, {what}", nearest(name, names))
        return self._members(lines[name])

    def _count(self, element: Definition, number: int = 1) -> None:
        """Count elements, against lines that multiply without end."""
        self.element_count += number
        if self.element_count > MAX_ELEMENTS:
            raise element.error(f"more than {MAX_ELEMENTS} elements", "a line that a machine has")

    def _element_tables(self, element: Definition, reflect: bool = False) -> list[dict[str, Any]]:
        """Table of an element; a screen with a length is put between two drifts."""
        if (kind := ELEMENT_KINDS.get(element.kind)) is None:
            raise element.error(
                f"element '{element.name}' of type '{element.type}', which cannot be read",
                "drifts, quadrupoles, dipoles, monitors and markers; cut the line around it",
            )
        length = self._length(element)
        if kind == "nothing":
            return []
        table = _Element(self.program, element, kind, length).table(reflect)
        if kind != "screen" or not length:
            return [table]
        half = {"type": "drift", "name": element.name, "length_m": 0.5 * length}
        return [half, table, half.copy()]


class _Element:
    """Element of a file, converted to the table of a TOML lattice or refused."""

    def __init__(self, program: Interpreter, element: Definition, kind: str, length: float) -> None:
        self.definition, self.kind, self.length = element, kind, length
        self.elegant = program.dialect is ELEGANT
        understood = {*UNDERSTOOD_PARAMETERS, *program.dialect.parameters}
        accepted = understood.union(IGNORED_PARAMETERS)
        unknown = [key for key in element.parameters if key not in accepted]
        if unknown and not self.elegant:  # elegant has many without effect on the matrix
            found = f"'{unknown[0]}' of element '{element.name}', which MAD-X or beamfit does not "
            found += "know"
            raise element.error(
                found, nearest(unknown[0], ["l", "k1", "angle", "e1", "e2", "tilt", "knl"])
            )
        if "tilt" in element.parameters and not element.parameters["tilt"].text:
            raise element.error("'tilt' without a value", "tilt = ...")
        understood |= {"e1", "e2"} if kind == "dipole" else set()
        given = element.parameters
        self.values = {k: program.number(p) for k, p in given.items() if k in understood}

    def table(self, reflect: bool) -> dict[str, Any]:
        """Table of a TOML lattice; reflection exchanges the pole faces of a dipole."""
        common = {"name": self.definition.name}
        if self.kind in ("screen", "marker"):
            return {"type": self.kind} | common
        self._check_unmodelled()
        if self.kind == "thin" and not self.length:
            return common | self._thin_lens()
        if self.kind in ("quadrupole", "dipole"):
            self._check_length()
            return common | (
                self._quadrupole() if self.kind == "quadrupole" else self._dipole(reflect)
            )
        if self.elegant and self._number("k1"):
            raise self._unmodelled("with a dipole or quadrupole component of its own")
        return common | self._drift()

    def _unmodelled(self, what: str, expected: str = "") -> InputError:
        """Make the error of a feature that beamfit does not model."""
        found = f"element '{self.definition.name}' of type '{self.definition.type}' {what}"
        expected = expected or "a line without it: cut the line after it, or set it to zero"
        return self.definition.error(f"{found}, which beamfit does not model", expected)

    def _number(self, key: str) -> float:
        """Value of a parameter; 0 if the file does not give it."""
        if isinstance(value := self.values.get(key, 0.0), tuple):
            raise self._unmodelled(f"with several numbers as {key.upper()}", "one number")
        return float(value)

    def _multipole(self, key: str) -> tuple[float, float]:
        """Dipole and quadrupole component of a list of multipoles."""
        value = self.values.get(key, ())
        return (*(value if isinstance(value, tuple) else (value,)), 0.0, 0.0)[:2]

    def _check_unmodelled(self) -> None:
        """Refuse parameters that are not modelled, unless they are zero."""
        for key in (*UNMODELLED, *IDENTITY_AT_ZERO.get(self.definition.type.lower(), ())):
            if self._number(key) != 0.0:
                raise self._unmodelled(f"with {key.upper()} = {self._number(key):g}")
        for key in EDGE_SWITCHES:
            if key in self.values and self._number(key) == 0.0:
                raise self._unmodelled(f"with an edge switched off ({key.upper()} = 0)")
        thin = self.kind == "thin" and not self.length
        for key in () if thin else ("knl", "ksl"):
            if any(self._multipole(key)):
                raise self._unmodelled(f"with multipole components of its own ({key.upper()})")

    def _check_length(self) -> None:
        """Refuse a quadrupole or dipole without a positive length, or a dipole without angle."""
        missing = [key for key in ("angle", "l") if key not in self.values]
        if self.kind == "dipole" and missing:
            found = f"'{self.definition.name}' without '{missing[0]}'"
            raise self.definition.error(found, f"{missing[0].upper()} = ...")
        if self.length <= 0.0:
            raise self._unmodelled(f"of length {self.length:g} m", "a length above zero")

    def _drift(self) -> dict[str, Any]:
        """Table of a drift, collimator, corrector, sextupole, ...: a length without focusing."""
        return {"type": "drift", "length_m": self.length} if self.length else {"type": "marker"}

    def _quarter_turns(self) -> int:
        """Tilt of the element in units of 90°."""
        turns = self._number("tilt") / (math.pi / 2)
        # To four digits, as files write pi/2 as 1.5708.
        if abs(turns - round(turns)) > 1e-4:
            raise self._unmodelled(
                f"tilted by {math.degrees(self._number('tilt')):g} degrees",
                "upright elements, or bends tilted by a multiple of 90 degrees",
            )
        return round(turns) % 4

    def _upright(self, gradient: float) -> float:
        """Gradient with its sign reversed for a tilt by 90°."""
        return (-gradient if self._quarter_turns() % 2 else gradient) + 0.0

    def _quadrupole(self) -> dict[str, Any]:
        k1 = self._upright(self._number("k1"))
        return {"type": "quadrupole", "length_m": self.length, "k1_per_m2": k1}

    def _thin_lens(self) -> dict[str, Any]:
        """Table of a thin multipole: a thin lens, or a marker without a quadrupole component."""
        if self.elegant:
            order = self.values.get("order", 1)
            normal = tuple(self._number("knl") * (order == n) for n in range(2))
        elif "knl" in self.values:
            normal = self._multipole("knl")
        else:
            normal = self._number("k0l"), self._number("k1l")
        if self._number("angle"):
            found = f"'{self.definition.name}' with a bend in a thin element"
            raise self.definition.error(found, "ANGLE = 0")
        if normal[0] or any(self._multipole("ksl")):
            raise self._unmodelled("with a dipole or skew component of its own")
        if not normal[1]:
            return {"type": "marker"}
        return {"type": "thin_lens", "k1l_per_m": self._upright(normal[1])}

    def _dipole(self, reflect: bool) -> dict[str, Any]:
        """Table of a dipole; one without angle is a quadrupole or drift."""
        angle, turns = self._number("angle"), self._quarter_turns()
        self._check_dipole(angle)
        edge = 0.5 * angle if self.definition.kind == "rbend" else 0.0
        edges = [self._number(key) + edge for key in ("e1", "e2")]
        k1 = self._upright(self._number("k1"))
        if angle == 0.0:
            return self._quadrupole() if k1 else self._drift()
        if turns in (2, 3):  # bends the other way; edge angles are relative to the bend
            angle, edges = -angle, [-edge for edge in edges]
        entrance, exit_edge = map(math.degrees, edges[::-1] if reflect else edges)
        return {
            "type": "sector_dipole",
            "radius_m": self.length / abs(angle),
            "angle_deg": math.degrees(angle),
            "entrance_edge_deg": entrance,
            "exit_edge_deg": exit_edge,
            "bend_plane": "y" if turns % 2 else "x",
            "k1_per_m2": k1,
        }

    def _check_dipole(self, angle: float) -> None:
        """Refuse dipoles that are not hard-edge sector or rectangular bends."""
        if self.elegant and "RB" in self.definition.type:
            raise self._unmodelled(
                "(rectangular, whose length programs read differently)",
                "CSBEND or SBEN with the arc length and E1 = E2 = ANGLE/2",
            )
        k0 = self._number("k0")
        if k0 and abs(k0 * self.length - angle) > 1e-9:
            raise self._unmodelled(f"with a field (K0 = {k0:g}) that is not ANGLE/L")
        # The default of FINT is 0.5 in elegant, 0 in MAD.
        integrals = [self._number(k) for k in ("fint", "fintx", "fint1", "fint2")]
        integrals.append(0.5 if self.elegant and "fint" not in self.values else 0.0)
        if (self._number("hgap") or self._number("hgapx")) and any(integrals):
            raise self._unmodelled(
                "with a fringe field (HGAP and FINT)",
                "HGAP = 0, or a TOML lattice with effective edge angles",
            )


def number_repeated(elements: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Number markers and screens that occur several times, NAME#1, NAME#2, as elegant does."""
    tables = list(elements)
    totals = Counter(t["name"] for t in tables if t["type"] in ("marker", "screen"))
    counts: Counter[str] = Counter()
    for table in tables:
        name = table["name"]
        if table["type"] == "drift" and name in totals:
            table["name"] = f"{name}.drift"  # half of a monitor with a length
        elif totals[name] > 1:
            counts[name] += 1
            table["name"] = f"{name}#{counts[name]}"
    return tables


def _single_number(program: Interpreter, parameter: Attribute) -> float:
    """Value of a parameter that must be one number."""
    value = program.number(parameter)
    if isinstance(value, tuple):
        raise InputError("several numbers", "one", parameter.path, parameter.line)
    return value


def _beam(
    program: Interpreter, path: str | PathLike[str], name: str, energy: float | None
) -> tuple[str, float]:
    """Particle and total energy in MeV, from the sequence's own BEAM or the general one."""
    beam = program.beams.get(name) or program.beams[""]
    particle = _particle(beam, program, path)
    total = energy
    key = next((k for k in ("energy", "pc", "gamma", "beta", "brho") if k in beam), None)
    if energy is None:
        if key is None:
            expected = "" if program.dialect is ELEGANT else "BEAM, ENERGY = or "
            expected += "--energy in MeV (energy= from Python)"
            raise InputError("no beam energy in the file", expected, path)
        value, rest = _single_number(program, beam[key]), 1e-3 * REST_ENERGY[particle]
        if key == "beta" and not 0.0 < value < 1.0:
            raise InputError(f"BEAM with BETA = {value:g}", "one between 0 and 1", path)
        momentum = value if key == "pc" else LIGHT / 1e9 * value
        total = 1e3 * {
            "energy": value,
            "gamma": value * rest,
            "beta": rest / math.sqrt(1.0 - value**2) if key == "beta" else 0.0,
        }.get(key, math.hypot(momentum, rest))
    if expected := expected_energy(total, particle):
        found = f"an energy of {total:g} MeV"
        raise InputError(found, f"{expected}; BEAM is in GeV, --energy in MeV", path)
    return particle, float(total)


def _particle(beam: dict[str, Attribute], program: Interpreter, path: str | PathLike[str]) -> str:
    """Particle of a BEAM, by its name or else by its mass and charge.

    MAD-X ignores a mass or charge given together with a name that it knows; here a contradiction
    is refused.
    """
    name_given = word_of(beam.get("particle")).lower() or None
    mass, charge = (
        _single_number(program, beam[key]) if key in beam else None for key in ("mass", "charge")
    )
    if name_given is None and mass is None:
        name_given = program.dialect.particle
    named = name_given in MADX_PARTICLES
    for name in [name_given] if named else REST_ENERGY:
        mass_agrees = mass is None or abs(1e3 * mass / REST_ENERGY[name] - 1.0) < MASS_TOLERANCE
        sign = NEGATIVE_CHARGES.get(name, 1.0)
        charge_agrees = (named or sign > 0) if charge is None else sign == charge
        if mass_agrees and charge_agrees and (named or mass is not None):
            return name
    found = f"particle '{name_given}'" if name_given else "a particle"
    found += "" if mass is None else f" of mass {mass:g} GeV"
    found += "" if charge is None else f" and charge {charge:g}"
    near = nearest(str(name_given), list(MADX_PARTICLES if named else REST_ENERGY))
    raise InputError(found, f"{near}, by a name that MAD-X knows or by mass and charge", path)
