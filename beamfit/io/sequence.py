"""Sequences and lines of MAD-X, MAD-8 and elegant files as the elements of a beamfit lattice."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import count
from os import PathLike
from pathlib import Path
from typing import NamedTuple

from beamfit.errors import InputError, nearest
from beamfit.io.dialects import DIALECTS, ELEGANT, MADX, coded
from beamfit.io.files import digest, read_text
from beamfit.io.lattice import MOST, LatticeFile
from beamfit.io.madx import NO_MATTER, Attribute, Definition, Interpreter, word_of
from beamfit.io.madx_values import NAME, words
from beamfit.io.sequence_elements import NOTHING_AT_ZERO, Element, element_tables
from beamfit.particles import REST_ENERGY, expected_energy

# Gaps and overlaps in m that MAD-X takes for none.
TINY = 1e-6
# Half lengths from an element's reference point to its centre.
TO_CENTRE = {"entry": 0.5, "centre": 0.0, "center": 0.0, "exit": -0.5}
SCREENS = words("monitor hmonitor vmonitor imonitor blmonitor slmonitor instrument profile wire")
SPACES = words(
    "drift kicker hkicker vkicker tkicker sextupole octupole collimator ecollimator rcollimator "
    "solenoid rfcavity elseparator placeholder"
)
MEANT = words(
    "l k0 k1 angle tilt knl ksl k1s k0s ktap hgap fint fintx ks ksi volt ex ey ex_l ey_l "
    "kill_ent_fringe kill_exi_fringe dx dy ds h knll charge cnll bet sigx sigy xma yma"
)
MEMBER = re.compile(rf"\s*([-+]?)\s*(?:(\d+)\s*\*)?\s*(?:({NAME})|(\())", re.I)
# GeV; the charges of those that MAD-X knows by name.
KNOWN = {"positron": 1.0, "electron": -1.0, "proton": 1.0, "antiproton": -1.0}
# Relative: masses that differ by less are one particle's.
SAME_MASS = 2e-4


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
    elements = element_tables(_Expansion(program, chosen).elements())
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


class _Expansion:
    """The elements of one line, in order."""

    def __init__(self, program: Interpreter, line: Definition) -> None:
        self.program, self.line, self.made = program, line, 0
        self.elegant = program.dialect is ELEGANT
        self.meant = {*MEANT, *program.dialect.meant}

    def elements(self) -> Iterator[Element]:
        """Each element of the line, with drifts where nothing stands."""
        if self.line.kind == "line":
            for name, reflected in self._members(self.line, ()):
                for one in self._whole(self.program.elements[name]):
                    turned = reflected and self.program.dialect is not MADX  # which does not
                    yield replace(one, edges=one.edges[::-1]) if turned else one
            return
        end, number = 0.0, count()
        last = _Placed(None, self._length(self.line), 0.0, (self.line.path, self.line.line))
        for one in [*self._placed(self.line, 0.0, ()), last]:
            gap = one.start - end
            if gap < -TINY:
                what = f"'{one.own.name}' overlapping" if one.own else "elements beyond the end"
                expected = "elements in the order of their places that do not overlap"
                raise InputError(f"{what} by {-gap:g} m", expected, *one.place)
            if gap > TINY:
                yield Element(f"drift_{next(number)}", "DRIFT", "space", gap)
            if one.own is not None:
                yield from self._whole(one.own)
                end = one.start + one.length

    def _number(self, own: Definition, key: str, usual: float = 0.0) -> float:
        parameter = own.parameters.get(key)
        return usual if parameter is None else _single(self.program, parameter)

    def _length(self, own: Definition) -> float:
        """Length along the beam; MAD-X has that of an RBEND straight, unless RBARC is off."""
        length = self._number(own, "l")
        if own.kind == "sequence" and length <= 0.0:
            raise own.error(f"sequence '{own.name}' of length {length:g} m", "L above zero")
        if own.kind == "multipole" and not self.elegant:
            return 0.0
        if length < 0.0 or (own.kind == "marker" and length):
            raise own.error(f"'{own.name}' of length {length:g} m", "a length that MAD-X takes")
        half = 0.5 * self._number(own, "angle") if own.kind == "rbend" else 0.0
        return length * half / math.sin(half) if half and self.program.rbarc else length

    def _placed(
        self, sequence: Definition, start: float, within: tuple[str, ...]
    ) -> Iterator[_Placed]:
        """Elements of a sequence that begins at a place."""
        if sequence.name in within:
            raise sequence.error(f"'{sequence.name}', which holds itself", "a sequence of others")
        for i, (name, _) in enumerate(sequence.placed):
            self._count(sequence)
            own = self._part(sequence, name)
            first = start + self._start(sequence, i)
            if own.kind == "sequence":
                yield from self._placed(own, first, (*within, sequence.name))
            else:
                at = sequence.placed[i][1]["at"]
                yield _Placed(own, first, self._length(own), (at.path, at.line))

    def _part(self, sequence: Definition, name: str) -> Definition:
        own = self.program.elements.get(name) or self.program.lines[name]
        if own.kind == "line":
            found = f"line '{own.name}' within a sequence"
            raise sequence.error(found, "elements and sequences")
        return own

    def _start(self, sequence: Definition, i: int) -> float:
        own = self._part(sequence, sequence.placed[i][0])
        return self._centre(sequence, i, ()) - 0.5 * self._length(own)

    def _centre(self, sequence: Definition, i: int, behind: tuple[int, ...]) -> float:
        """Place of the centre of one part of a sequence, from the sequence's start."""
        name, place = sequence.placed[i]
        own = self._part(sequence, name)
        if i in behind or len(behind) > 100:
            raise sequence.error(f"'{own.name}', placed FROM itself", "FROM another element")
        if "at" not in place:
            raise sequence.error(f"'{own.name}' without a place", "AT = ...")
        at = _single(self.program, place["at"])
        if "from" in place:
            other = word_of(place["from"]).lower()
            names = [n for n, _ in sequence.placed]
            if other not in names:
                raise sequence.error(f"'{own.name}' FROM '{other}'", nearest(other, names))
            at += self._centre(sequence, names.index(other), (*behind, i))
        if own.kind == "sequence" and "refpos" in own.parameters:
            return at + 0.5 * self._length(own) - self._reference(own)
        refer = (
            word_of(sequence.parameters["refer"]) if "refer" in sequence.parameters else "centre"
        )
        if refer.lower() not in TO_CENTRE:
            raise sequence.error(f"REFER = {refer}", "ENTRY, CENTRE or EXIT")
        return at + TO_CENTRE[refer.lower()] * self._length(own)

    def _reference(self, own: Definition) -> float:
        """Place in a sequence of the element that its REFPOS names."""
        name, names = word_of(own.parameters["refpos"]).lower(), [n for n, _ in own.placed]
        if name not in names:
            raise own.error(f"REFPOS = '{name}'", nearest(name, names))
        return self._centre(own, names.index(name), ())

    def _members(self, line: Definition, within: tuple[str, ...]) -> list[tuple[str, bool]]:
        """Names of the elements of a LINE, in order, and whether each is reflected."""
        if line.name in within:
            raise line.error(f"'{line.name}', which holds itself", "a line of others")
        text = line.members.strip()
        if not text.startswith("("):
            raise line.error(f"'{text[:40]}' where a list belongs", "NAME: LINE = (A, B, ...);")
        found, end = self._list(line, text, 1, (*within, line.name))
        if text[end:].strip():
            raise line.error(f"'{text[end:][:40]}' after a list", "NAME: LINE = (A, B, ...);")
        return found

    def _list(
        self, line: Definition, text: str, at: int, within: tuple[str, ...]
    ) -> tuple[list[tuple[str, bool]], int]:
        """Names in a list in parentheses, as of `_members`, and where it ends."""
        every: list[tuple[str, bool]] = []
        while True:
            found = MEMBER.match(text, at)
            if found is None:
                said = text[at:].strip()[:30]
                raise line.error(f"'{said}' in a LINE", "names, lists, N*name and -name")
            sign, times, name, _ = found.groups()
            if name:
                one, at = self._member(line, name.lower(), within), found.end()
            else:
                one, at = self._list(line, text, found.end(), within)
            number = 1 if times is None else int(times)
            if number < 1:
                raise line.error(f"{number} times an element", "one or more")
            self._count(line, number * len(one))
            if sign == "-":
                one = [(own, not reflected) for own, reflected in one[::-1]]
            every += one * number
            mark = re.compile(r"\s*([,)])").match(text, at)
            if mark is None:
                raise line.error(f"'{text[at:].strip()[:30]}' in a LINE", "',' or ')'")
            at = mark.end()
            if mark[1] == ")":
                return every, at

    def _member(
        self, line: Definition, name: str, within: tuple[str, ...]
    ) -> list[tuple[str, bool]]:
        if name in self.program.elements:
            return [(name, False)]
        known = self.program.lines
        if name not in known or known[name].kind != "line":
            names = [d.name for d in (*self.program.elements.values(), *known.values())]
            what = "a sequence" if name in known else "which nothing defines"
            raise line.error(f"'{name}' in a LINE, {what}", nearest(name, names))
        return self._members(known[name], within)

    def _count(self, own: Definition, number: int = 1) -> None:
        self.made += number
        if self.made > MOST:
            raise own.error(f"more than {MOST} elements", "a line that a machine has")

    def _whole(self, own: Definition) -> list[Element]:
        """An element, and the halves before and behind the centre of one that is a screen."""
        kind = KINDS.get(own.kind)
        if kind is None:
            raise own.error(
                f"element '{own.name}' of type '{own.type}', which cannot be read",
                "drifts, quadrupoles, dipoles, monitors and markers; cut the line around it",
            )
        if kind == "nothing":
            return []
        odd = [k for k in own.parameters if k not in self.meant and k not in NO_MATTER]
        if odd and not self.elegant:  # which has many that change no matrix
            found = f"'{odd[0]}' of element '{own.name}', which MAD-X or beamfit does not know"
            raise own.error(found, nearest(odd[0], ["l", "k1", "angle", "e1", "e2", "tilt", "knl"]))
        if "tilt" in own.parameters and not own.parameters["tilt"].text:
            raise own.error("'tilt' without a value", "tilt = ...")
        length = self._length(own)
        if kind == "screen" and length:
            half = Element(own.name, "DRIFT", "space", 0.5 * length)
            return [half, Element(own.name, own.type, kind, 0.0), half]
        return [self._magnet(own, "space" if kind == "thin" and length else kind, length)]

    def _magnet(self, own: Definition, kind: str, length: float) -> Element:
        said = {
            key: self.program.number(parameter)
            for key, parameter in own.parameters.items()
            if key in self.meant or (key in ("e1", "e2") and kind == "dipole")
        }
        if required := [k for k in ("angle", "l") if kind == "dipole" and k not in said]:
            raise own.error(f"'{own.name}' without '{required[0]}'", f"{required[0].upper()} = ...")
        normal = skew = (0.0, 0.0)
        if kind == "thin" and self.elegant:
            normal = tuple(said.get("knl", 0.0) * (said.get("order", 1) == n) for n in range(2))
        elif kind == "thin":
            lists = {"knl": [said.get(f"k{n}l", 0.0) for n in range(2)]} | said
            normal, skew = ((*_several(lists.get(k, ())), 0.0, 0.0)[:2] for k in ("knl", "ksl"))
        elif kind in ("quadrupole", "dipole") or self.elegant:
            normal, skew = (0.0, float(said.get("k1", 0.0))), (0.0, float(said.get("k1s", 0.0)))
        angle = float(said.get("angle", 0.0)) if kind == "dipole" else 0.0
        edge = 0.5 * angle if own.kind == "rbend" else 0.0
        edges = tuple(float(said.get(k, 0.0)) + edge for k in ("e1", "e2"))
        if kind == "thin" and said.get("angle", 0.0) != 0.0:
            raise own.error(f"'{own.name}' with a bend in a thin element", "ANGLE = 0")
        place = (own.path, own.line)
        return Element(
            own.name, own.type, kind, length, normal, skew, angle, edges, said, place, self.elegant
        )


KINDS = {name: "screen" for name in SCREENS} | {
    name: "space" for name in (*SPACES, *NOTHING_AT_ZERO)
}
KINDS |= {"marker": "marker", "quadrupole": "quadrupole", "multipole": "thin"}
KINDS |= {"sbend": "dipole", "rbend": "dipole", "nothing": "nothing"}


def _several(value: float | Sequence[float]) -> Sequence[float]:
    return value if isinstance(value, tuple | list) else (value,)


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
        value, rest = _of_beam(program, beam[key]), 1e-3 * REST_ENERGY[particle]
        if key == "beta" and not 0.0 < value < 1.0:
            raise InputError(f"BEAM with BETA = {value:g}", "one between 0 and 1", path)
        momentum = value if key == "pc" else 0.299792458 * value
        total = 1e3 * {
            "energy": value,
            "gamma": value * rest,
            "beta": rest / math.sqrt(1.0 - value**2) if key == "beta" else 0.0,
        }.get(key, math.hypot(momentum, rest))
    if expected := expected_energy(total, particle):
        found = f"an energy of {total:g} MeV"
        raise InputError(found, f"{expected}; BEAM is in GeV, --energy in MeV", path)
    return particle, float(total)


def _of_beam(program: Interpreter, parameter: Attribute) -> float:
    try:
        return _single(program, parameter)
    except InputError as error:
        found = f"a BEAM that cannot be read ({error.found})"
        raise InputError(found, "a number", parameter.path, parameter.line) from None


def _particle(beam: dict[str, Attribute], program: Interpreter, path: str | PathLike[str]) -> str:
    """The particle of a BEAM by its name, which goes before, or by its mass and charge.

    MAD-X passes over a mass and a charge beside a name that it knows; one that contradicts is
    refused here.
    """
    named = word_of(beam["particle"]).lower() if "particle" in beam else None
    mass = _of_beam(program, beam["mass"]) if "mass" in beam else None
    charge = _of_beam(program, beam["charge"]) if "charge" in beam else None
    if named is None and mass is None:
        named = program.dialect.particle
    known = [*KNOWN] if named in KNOWN else [*REST_ENERGY]
    names = [named] if named in KNOWN else known
    fits = []
    for name in names:
        own = KNOWN.get(name, -1.0 if name == "H-" else 1.0)
        same = mass is None or abs(1e3 * mass / REST_ENERGY[name] - 1.0) < SAME_MASS
        if same and (
            (charge is None and named in KNOWN) or own == (1.0 if charge is None else charge)
        ):
            fits.append(name)
    if not fits or (named not in KNOWN and mass is None):
        found = f"particle '{named}'" if named else "a particle"
        found += "" if mass is None else f" of mass {mass:g} GeV"
        found += "" if charge is None else f" and charge {charge:g}"
        expected = f"{nearest(str(named), known)}, by a name that MAD-X knows or by mass and charge"
        raise InputError(found, expected, path)
    return fits[0]
