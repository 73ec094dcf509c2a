"""Sequences and lines of MAD-X, MAD-8 and elegant files as the elements of a beamfit lattice.

What a first-order, uncoupled line of one energy cannot hold is refused, never dropped.
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
from beamfit.io.dialects import DIALECTS, ELEGANT, MADX, coded
from beamfit.io.files import digest, read_text
from beamfit.io.lattice import MOST, LatticeFile
from beamfit.io.madx import NO_MATTER, Attribute, Definition, Interpreter, word_of
from beamfit.io.madx_values import parsed, words
from beamfit.particles import LIGHT, REST_ENERGY, expected_energy

# Gaps and overlaps in m that MAD-X takes for none.
TINY = 1e-6
# Half lengths from an element's reference point to its centre.
TO_CENTRE = {"entry": 0.5, "centre": 0.0, "center": 0.0, "exit": -0.5}
SCREENS = words("monitor hmonitor vmonitor imonitor blmonitor slmonitor instrument profile wire")
SPACES = words(
    "drift kicker hkicker vkicker tkicker sextupole octupole collimator ecollimator rcollimator "
    "solenoid rfcavity twcavity hacdipole vacdipole elseparator placeholder"
)
MEANT = words(
    "l k0 k1 angle tilt knl ksl k1s k0s ktap hgap fint fintx ks ksi volt ex ey ex_l ey_l "
    "kill_ent_fringe kill_exi_fringe dx dy ds h knll charge cnll bet sigx sigy xma yma"
)
# Particles that MAD-X knows by name, and those whose charge is -1.
BY_NAME = words("positron electron proton antiproton")
NEGATIVE = dict.fromkeys(words("electron antiproton H-"), -1.0)
# Relative: masses that differ by less are one particle's.
SAME_MASS = 2e-4
# Parameters that bend, focus, couple or accelerate in a way beamfit does not model, of any element
# and of some that are nothing without.
UNMODELLED = words(
    "ks ksi b k1s k0s ktap fse etilt t0 t1 bore use_bn volt ex ey kill_ent_fringe kill_exi_fringe"
)
NOTHING_AT_ZERO = {
    **dict.fromkeys(words("srotation xrotation yrotation"), ("angle",)),
    "translation": ("dx", "dy", "ds"),
    "dipedge": ("h",),
    "nllens": ("knll",),
    "beambeam": ("charge",),
}
EDGES = ("edge1_effects", "edge2_effects")
# What each class of element is to a line.
KINDS = dict.fromkeys(SCREENS, "screen") | dict.fromkeys((*SPACES, *NOTHING_AT_ZERO), "space")
KINDS |= {"marker": "marker", "quadrupole": "quadrupole", "multipole": "thin"}
KINDS |= {"sbend": "dipole", "rbend": "dipole", "nothing": "nothing"}


def read_sequence(
    path: str | PathLike[str], *, use: str | None = None, energy: float | None = None
) -> LatticeFile:
    """Read a line or sequence of a MAD-X, MAD-8 or elegant file.

    Parameters
    ----------
    path : str or path
        The file: ``.madx``, ``.seq``; ``.mad8``, ``.mad``; ``.lte``.
    use : str, optional
        Name of the LINE or SEQUENCE; not needed where the file has only one, or a USE.
    energy : float, optional
        Total energy in MeV; overrides the file's BEAM. An elegant file has none.

    Returns
    -------
    LatticeFile
        The line as it is after the last statement. The setting of a quadrupole is its k1 in 1/m².

    Raises
    ------
    InputError
        If a statement cannot be carried out, or the line holds what beamfit does not model.

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
    chosen = _chosen(program, path, use)
    particle, total = _beam(program, path, chosen.name.lower(), energy)
    try:
        elements = numbered(_Line(program, chosen).tables())
    except RecursionError:
        found = f"'{chosen.name}', lists within lists or places FROM one another without end"
        raise chosen.error(found, "a line that a machine has") from None
    if not elements:
        raise chosen.error(f"'{chosen.name}' without elements", "a line with magnets and a screen")
    return LatticeFile(path, digest(path), chosen.name, total, particle, tuple(elements))


def _chosen(program: Interpreter, path: str | PathLike[str], use: str | None) -> Definition:
    names = [line.name for line in program.lines.values()]
    if not names:
        expected = f"a valid {program.dialect.name} file with one of them"
        raise InputError("no LINE and no SEQUENCE", expected, path)
    wanted = use or program.used
    if wanted is None and len(names) > 1:
        found, expected = (
            f"{len(names)} lines or sequences",
            f"--use NAME with {nearest('', names)}",
        )
        raise InputError(found, expected, path)
    wanted = (names[0] if wanted is None else wanted).strip("\"'").lower()
    if (key := coded(wanted)) not in program.lines:
        raise InputError(f"no line or sequence '{wanted}'", nearest(wanted, names), path)
    return program.lines[key]


class _Placed(NamedTuple):
    """An element, or the end, of a sequence: start and length in m, and what places it there."""

    own: Definition | None
    start: float
    length: float
    place: tuple[str | PathLike[str], int]


class _Line:
    """The elements of one line or sequence, in order."""

    def __init__(self, program: Interpreter, line: Definition) -> None:
        self.program, self.line, self.made = program, line, 0

    def tables(self) -> Iterator[dict[str, Any]]:
        """The table of each element of the line, with drifts where nothing stands."""
        if self.line.kind == "line":
            for name, reflected in self._members(self.line):
                turned = reflected and self.program.dialect is not MADX  # which does not
                yield from self._whole(self.program.elements[name], turned)
            return
        end, number = 0.0, count()
        last = _Placed(None, self._length(self.line), 0.0, (self.line.path, self.line.line))
        for one in [*self._placed(self.line, 0.0), last]:
            gap = one.start - end
            if gap < -TINY:
                what = f"'{one.own.name}' overlapping" if one.own else "elements beyond the end"
                expected = "elements in the order of their places that do not overlap"
                raise InputError(f"{what} by {-gap:g} m", expected, *one.place)
            if gap > TINY:
                yield {"type": "drift", "name": f"drift_{next(number)}", "length_m": gap}
            if one.own is not None:
                yield from self._whole(one.own)
                end = one.start + one.length

    def _number(self, own: Definition, key: str) -> float:
        return _single(self.program, own.parameters[key]) if key in own.parameters else 0.0

    def _length(self, own: Definition) -> float:
        """Length along the beam; MAD-X has that of an RBEND straight, unless RBARC is off."""
        length = self._number(own, "l")
        if own.kind == "sequence" and length <= 0.0:
            raise own.error(f"sequence '{own.name}' of length {length:g} m", "L above zero")
        if own.kind == "multipole" and self.program.dialect is not ELEGANT:
            return 0.0
        if length < 0.0 or (own.kind == "marker" and length):
            raise own.error(f"'{own.name}' of length {length:g} m", "a length that MAD-X takes")
        half = 0.5 * self._number(own, "angle") if own.kind == "rbend" else 0.0
        return length * half / math.sin(half) if half and self.program.rbarc else length

    def _placed(self, sequence: Definition, start: float) -> Iterator[_Placed]:
        """Elements of a sequence that begins at a place."""
        for i, (name, place) in enumerate(sequence.placed):
            self._count(sequence)
            own = self._part(sequence, name)
            first = start + self._centre(sequence, i) - 0.5 * self._length(own)
            if own.kind == "sequence":
                yield from self._placed(own, first)
            else:
                at = place["at"]
                yield _Placed(own, first, self._length(own), (at.path, at.line))

    def _part(self, sequence: Definition, name: str) -> Definition:
        own = self.program.elements.get(name) or self.program.lines[name]
        if own.kind == "line":
            found = f"line '{own.name}' within a sequence"
            raise sequence.error(found, "elements and sequences")
        return own

    def _centre(self, sequence: Definition, i: int) -> float:
        """Place of the centre of one part of a sequence, from the sequence's start."""
        name, place = sequence.placed[i]
        own = self._part(sequence, name)
        if "at" not in place:
            raise sequence.error(f"'{own.name}' without a place", "AT = ...")
        at = _single(self.program, place["at"])
        if "from" in place:
            other = word_of(place["from"]).lower()
            names = [n for n, _ in sequence.placed]
            if other not in names:
                raise sequence.error(f"'{own.name}' FROM '{other}'", nearest(other, names))
            at += self._centre(sequence, names.index(other))
        if own.kind == "sequence" and "refpos" in own.parameters:
            return at + 0.5 * self._length(own) - self._reference(own)
        refer = word_of(sequence.parameters.get("refer"), "centre").lower()
        if refer not in TO_CENTRE:
            raise sequence.error(f"REFER = {refer}", "ENTRY, CENTRE or EXIT")
        return at + TO_CENTRE[refer] * self._length(own)

    def _reference(self, own: Definition) -> float:
        """Place in a sequence of the element that its REFPOS names."""
        name, names = word_of(own.parameters["refpos"]).lower(), [n for n, _ in own.placed]
        if name not in names:
            raise own.error(f"REFPOS = '{name}'", nearest(name, names))
        return self._centre(own, names.index(name))

    def _members(self, line: Definition) -> list[tuple[str, bool]]:
        """Names of the elements of a LINE, in order, and whether each is reflected."""
        try:
            tree = parsed(line.members, "list")
        except ValueError as error:
            raise line.error(f"a list {error}", "NAME: LINE = (A, 2*B, -C, (D, E));") from None
        return self._list(line, tree)

    def _list(self, line: Definition, tree: Tree) -> list[tuple[str, bool]]:
        """Names in a list, as of `_members`."""
        every: list[tuple[str, bool]] = []
        for *said, own in (member.children for member in tree.children):
            number = next((int(word[:9]) for word in said if word.isdigit()), 1)
            if number < 1:
                raise line.error(f"{number} times an element", "one or more")
            found = self._list if isinstance(own, Tree) else self._member
            one = found(line, own)
            self._count(line, number * len(one))
            if "-" in said:
                one = [(name, not reflected) for name, reflected in one[::-1]]
            every += one * number
        return every

    def _member(self, line: Definition, label: str) -> list[tuple[str, bool]]:
        name = label.lower()
        if name in self.program.elements:
            return [(name, False)]
        known = self.program.lines
        if name not in known or known[name].kind != "line":
            names = [d.name for d in (*self.program.elements.values(), *known.values())]
            what = "a sequence" if name in known else "which nothing defines"
            raise line.error(f"'{name}' in a LINE, {what}", nearest(name, names))
        return self._members(known[name])

    def _count(self, own: Definition, number: int = 1) -> None:
        self.made += number
        if self.made > MOST:
            raise own.error(f"more than {MOST} elements", "a line that a machine has")

    def _whole(self, own: Definition, turned: bool = False) -> list[dict[str, Any]]:
        """The table of an element, with the halves of one that is a screen around its centre."""
        kind, length = KINDS.get(own.kind), self._length(own) if own.kind in KINDS else 0.0
        if kind is None:
            raise own.error(
                f"element '{own.name}' of type '{own.type}', which cannot be read",
                "drifts, quadrupoles, dipoles, monitors and markers; cut the line around it",
            )
        if kind == "nothing":
            return []
        table = _Element(self.program, own, kind, length).table(turned)
        if kind != "screen" or not length:
            return [table]
        half = {"type": "drift", "name": own.name, "length_m": 0.5 * length}
        return [half, table, half.copy()]


class _Element:
    """An element of a file, which gives its table unless it does what beamfit does not model."""

    def __init__(self, program: Interpreter, own: Definition, kind: str, length: float) -> None:
        self.own, self.kind, self.length = own, kind, length
        self.elegant = program.dialect is ELEGANT
        meant = {*MEANT, *program.dialect.meant}
        odd = [k for k in own.parameters if k not in meant and k not in NO_MATTER]
        if odd and not self.elegant:  # which has many that change no matrix
            found = f"'{odd[0]}' of element '{own.name}', which MAD-X or beamfit does not know"
            raise own.error(found, nearest(odd[0], ["l", "k1", "angle", "e1", "e2", "tilt", "knl"]))
        if "tilt" in own.parameters and not own.parameters["tilt"].text:
            raise own.error("'tilt' without a value", "tilt = ...")
        meant |= {"e1", "e2"} if kind == "dipole" else set()
        self.said = {k: program.number(p) for k, p in own.parameters.items() if k in meant}

    def table(self, turned: bool) -> dict[str, Any]:
        """The table of a TOML lattice; of a turned dipole the faces change places."""
        named = {"name": self.own.name}
        if self.kind in ("screen", "marker"):
            return {"type": self.kind} | named
        self._check_unmodelled()
        if self.kind == "thin" and not self.length:
            return named | self._lens()
        if self.kind in ("quadrupole", "dipole"):
            self._check_length()
            return named | (
                self._quadrupole() if self.kind == "quadrupole" else self._dipole(turned)
            )
        if self.elegant and self._number("k1"):
            raise self._refuse("with a dipole or quadrupole component of its own")
        return named | self._drift()

    def _refuse(self, what: str, expected: str = "") -> InputError:
        found = f"element '{self.own.name}' of type '{self.own.type}' {what}"
        expected = expected or "a line without it: cut the line after it, or set it to zero"
        return self.own.error(f"{found}, which beamfit does not model", expected)

    def _number(self, key: str) -> float:
        """A parameter as the file has it; 0 where it has none."""
        if isinstance(value := self.said.get(key, 0.0), tuple):
            raise self._refuse(f"with several numbers as {key.upper()}", "one number")
        return float(value)

    def _several(self, key: str) -> tuple[float, float]:
        """The dipole and the quadrupole component of a list."""
        value = self.said.get(key, ())
        return (*(value if isinstance(value, tuple) else (value,)), 0.0, 0.0)[:2]

    def _check_unmodelled(self) -> None:
        for key in (*UNMODELLED, *NOTHING_AT_ZERO.get(self.own.type.lower(), ())):
            if self._number(key) != 0.0:
                raise self._refuse(f"with {key.upper()} = {self._number(key):g}")
        for key in EDGES:
            if key in self.said and self._number(key) == 0.0:
                raise self._refuse(f"with an edge switched off ({key.upper()} = 0)")
        thin = self.kind == "thin" and not self.length
        for key in () if thin else ("knl", "ksl"):
            if any(self._several(key)):
                raise self._refuse(f"with multipole components of its own ({key.upper()})")

    def _check_length(self) -> None:
        if self.kind == "dipole" and (gone := [k for k in ("angle", "l") if k not in self.said]):
            found = f"'{self.own.name}' without '{gone[0]}'"
            raise self.own.error(found, f"{gone[0].upper()} = ...")
        if self.length <= 0.0:
            raise self._refuse(f"of length {self.length:g} m", "a length above zero")

    def _drift(self) -> dict[str, Any]:
        """A length without focusing: drifts, collimators, correctors, sextupoles, ..."""
        return {"type": "drift", "length_m": self.length} if self.length else {"type": "marker"}

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

    def _upright(self, gradient: float) -> float:
        """A gradient; that of an element turned by 90° is the other one."""
        return (-gradient if self._quarter_turns() % 2 else gradient) + 0.0

    def _quadrupole(self) -> dict[str, Any]:
        k1 = self._upright(self._number("k1"))
        return {"type": "quadrupole", "length_m": self.length, "k1_per_m2": k1}

    def _lens(self) -> dict[str, Any]:
        if self.elegant:
            at = self.said.get("order", 1)
            normal = tuple(self._number("knl") * (at == n) for n in range(2))
        elif "knl" in self.said:
            normal = self._several("knl")
        else:
            normal = self._number("k0l"), self._number("k1l")
        if self._number("angle"):
            raise self.own.error(f"'{self.own.name}' with a bend in a thin element", "ANGLE = 0")
        if normal[0] or any(self._several("ksl")):
            raise self._refuse("with a dipole or skew component of its own")
        if not normal[1]:
            return {"type": "marker"}
        return {"type": "thin_lens", "k1l_per_m": self._upright(normal[1])}

    def _dipole(self, turned: bool) -> dict[str, Any]:
        angle, turns = self._number("angle"), self._quarter_turns()
        self._check_dipole(angle)
        edge = 0.5 * angle if self.own.kind == "rbend" else 0.0
        edges = [self._number(key) + edge for key in ("e1", "e2")]
        k1 = self._upright(self._number("k1"))
        if angle == 0.0:
            return self._quadrupole() if k1 else self._drift()
        if turns in (2, 3):  # bends the other way; the edges are counted with the bend
            angle, edges = -angle, [-edge for edge in edges]
        entrance, leaving = map(math.degrees, edges[::-1] if turned else edges)
        return {
            "type": "sector_dipole",
            "radius_m": self.length / abs(angle),
            "angle_deg": math.degrees(angle),
            "entrance_edge_deg": entrance,
            "exit_edge_deg": leaving,
            "bend_plane": "y" if turns % 2 else "x",
            "k1_per_m2": k1,
        }

    def _check_dipole(self, angle: float) -> None:
        if self.elegant and "RB" in self.own.type:
            raise self._refuse(
                "(rectangular, whose length programs read differently)",
                "CSBEND or SBEN with the arc length and E1 = E2 = ANGLE/2",
            )
        k0 = self._number("k0")
        if k0 and abs(k0 * self.length - angle) > 1e-9:
            raise self._refuse(f"with a field (K0 = {k0:g}) that is not ANGLE/L")
        # elegant takes FINT = 0.5 where the file has none, MAD takes 0.
        integrals = [self._number(k) for k in ("fint", "fintx", "fint1", "fint2")]
        integrals.append(0.5 if self.elegant and "fint" not in self.said else 0.0)
        if (self._number("hgap") or self._number("hgapx")) and any(integrals):
            raise self._refuse(
                "with a fringe field (HGAP and FINT)",
                "HGAP = 0, or a TOML lattice with effective edge angles",
            )


def numbered(elements: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Number markers and screens that occur several times as elegant does, NAME#1, NAME#2."""
    tables = list(elements)
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


def _single(program: Interpreter, parameter: Attribute) -> float:
    value = program.number(parameter)
    if isinstance(value, tuple):
        raise InputError("several numbers", "one", parameter.path, parameter.line)
    return value


def _beam(
    program: Interpreter, path: str | PathLike[str], name: str, energy: float | None
) -> tuple[str, float]:
    """Particle and total energy in MeV, of the sequence's own BEAM or that of all."""
    beam = program.beams.get(name) or program.beams[""]
    particle = _particle(beam, program, path)
    total = energy
    key = next((k for k in ("energy", "pc", "gamma", "beta", "brho") if k in beam), None)
    if energy is None:
        if key is None:
            expected = "" if program.dialect is ELEGANT else "BEAM, ENERGY = or "
            expected += "--energy in MeV (energy= from Python)"
            raise InputError("no beam energy in the file", expected, path)
        value, rest = _single(program, beam[key]), 1e-3 * REST_ENERGY[particle]
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
    """The particle of a BEAM by its name, which goes before, or by its mass and charge.

    MAD-X passes over a mass and a charge beside a name that it knows; one that contradicts is
    refused here.
    """
    named = word_of(beam.get("particle")).lower() or None
    mass, charge = (
        _single(program, beam[key]) if key in beam else None for key in ("mass", "charge")
    )
    if named is None and mass is None:
        named = program.dialect.particle
    byname = named in BY_NAME
    for name in [named] if byname else REST_ENERGY:
        same = mass is None or abs(1e3 * mass / REST_ENERGY[name] - 1.0) < SAME_MASS
        usual = NEGATIVE.get(name, 1.0) if byname else 1.0
        own = NEGATIVE.get(name, 1.0)
        if same and (byname or mass is not None) and own == (usual if charge is None else charge):
            return name
    found = f"particle '{named}'" if named else "a particle"
    found += "" if mass is None else f" of mass {mass:g} GeV"
    found += "" if charge is None else f" and charge {charge:g}"
    near = nearest(str(named), list(BY_NAME if byname else REST_ENERGY))
    raise InputError(found, f"{near}, by a name that MAD-X knows or by mass and charge", path)
