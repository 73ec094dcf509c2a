"""MAD-X files, and others in its words: their statements, carried out as MAD-X does.

A statement that changes an element, a line or the beam is carried out or refused with its line.
The rules are those of MAD-X 5.09, found by experiment where its manual is silent
(tests/io/test_madx.py holds 300 generated files against it).
"""

from __future__ import annotations

import re
from bisect import bisect
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

from beamfit.errors import InputError, nearest
from beamfit.io.dialects import ELEGANT, MADX, Dialect, blanked, decoded
from beamfit.io.files import read_text
from beamfit.io.madx_values import NAME, Values, shown, words

# Files that call one another.
MOST_CALLS = 50
COMMENT = re.compile(r"\"[^\"]*\"|'[^'\n]*'|![^\n]*|//[^\n]*|/\*.*?(?:\*/|\Z)", re.DOTALL)
PART = re.compile(r"\"[^\"]*\"|'[^'\n]*'|[;{}]")
# Heads of statements that end with their block, and not with a semicolon.
BLOCK = re.compile(r"(if|elseif|else|while)\b|[\w.$]+\s*(\([^)]*\))?\s*:\s*macro\b", re.I)
ASSIGNMENT = re.compile(
    rf"(?:((?:real|int)\s+const|const|real|int)\s+)?({NAME})\s*(:?=)\s*(.+)", re.I | re.DOTALL
)
ARROW = re.compile(rf"({NAME})->({NAME})\s*:?=\s*(.+)", re.I | re.DOTALL)
LABEL = re.compile(rf"[\"']?({NAME})[\"']?\s*(\([^)]*\))?\s*:\s*({NAME})\s*(.*)", re.I | re.DOTALL)
COMMAND = re.compile(rf"[\"']?({NAME})[\"']?\s*(.*)", re.I | re.DOTALL)
PARAMETER = re.compile(rf"([-+]?)\s*({NAME})\s*(?:(:?=)\s*(.*))?", re.I | re.DOTALL)
# Commands that leave elements, lines and beam as they are.
HARMLESS = words(
    "assign aperture coguess correct create csave dumpsequ dynap emit endtrack eoption "
    "eprint esave fill getorbit help ibs observe plot print printf putorbit readmytable "
    "readtable run save savebeta select set setplot show sodd start survey sxfwrite system "
    "tabstring title touschek track twiss usekick usemonitor value write "
)
# Parameters that change no matrix of a line without bends in thin elements.
NO_MATTER = words(
    "at from type apertype aperture aper_offset aper_tol aper_vx aper_vy slot_id assembly_id "
    "mech_sep v_pos magnet model method nst exact kmax kmin calib polarity lrad comments kick "
    "hkick vkick k2 k2s k3 k3s h1 h2 thick fringe bend_fringe freq lag harmon n_bessel shunt "
    "tfill betrf pg sinkick sinpeak sintune sinphase file_td ramp1 ramp2 ramp3 ramp4 e1 e2"
)
# Definitions of what is no element.
HARMLESS_CLASSES = ("beta0", "macro")
# Options that change no matrix of a line without thin dipoles.
HARMLESS_OPTIONS = words(
    "echo echomacro info warn debug verify trace tell thin_foc thin_cf bborbit twiss_print "
    "no_fatal_stop "
)
ENDS = ("stop", "exit", "quit")


class Attribute(NamedTuple):
    """The value of a parameter, or why it has none; an expression where it is evaluated later."""

    text: str
    later: bool
    value: Any
    path: str | PathLike[str]
    line: int


@dataclass
class Definition:
    """An element, line or sequence: its class, its parameters, and where it is defined.

    ``type`` is the class as the file has it.
    """

    name: str
    kind: str
    path: str | PathLike[str]
    line: int
    parameters: dict[str, Attribute] = field(default_factory=dict)
    members: str = ""
    placed: list[tuple[str, dict[str, Attribute]]] = field(default_factory=list)
    type: str = ""

    def error(self, found: str, expected: str) -> InputError:
        """Make the error that names the place of the definition."""
        return InputError(found, expected, self.path, self.line)


class MadxStatement(NamedTuple):
    """A statement, its block where it has one, and where it begins."""

    text: str
    block: str | None
    path: str | PathLike[str]
    line: int

    def error(self, found: str = "", expected: str = "") -> InputError:
        """Make the error that names the statement's place."""
        expected = expected or "a file without it: run it in MAD-X, and SAVE the sequence"
        found = found or f"'{shown(self.text)}', which beamfit does not carry out"
        return InputError(found, expected, self.path, self.line)

    @contextmanager
    def read(self, expected: str) -> Iterator[None]:
        """Name the statement's place where an expression in it has no value."""
        try:
            yield
        except ValueError as error:
            raise self.error(str(error), expected) from None


def statements(text: str, path: str | PathLike[str], line: int = 1) -> Iterator[MadxStatement]:
    """Split a file at its semicolons and blocks; comments are left out.

    Examples
    --------
    >>> [s.text for s in statements("a = 1; ! one; two\\nif (a > 0) {b = 2;}", "a.madx")]
    ['a = 1', 'if (a > 0)']
    """
    text = COMMENT.sub(blanked, text)
    begin, depth, opened = 0, 0, None
    ends = [found.start() for found in re.finditer("\n", text)]

    def made(end: int, block: str | None = None) -> MadxStatement:
        said = text[begin:end]
        at = line + bisect(ends, begin + len(said) - len(said.lstrip()))
        return MadxStatement(said.strip(), block, path, at)

    for found in PART.finditer(text):
        mark, place = found[0], found.start()
        depth += (mark == "{") - (mark == "}")
        if depth < 0:
            raise made(place).error("'}' without '{'", "braces that match")
        if mark == "{" and depth == 1 and BLOCK.match(text[begin:place].strip()):
            opened = place
        elif mark == "}" and depth == 0 and opened is not None:
            yield made(opened, text[opened + 1 : place])
            begin, opened = found.end(), None
        elif mark == ";" and depth == 0:
            if text[begin:place].strip():
                yield made(place)
            begin = found.end()
    if text[begin:].strip():
        rest = made(len(text))
        found = f"'{rest.text[:40]}' without an end"
        raise rest.error(found, "';' at the end of a statement, and quotes and braces that match")


def split_parameters(text: str) -> list[str]:
    """Cut a list at the commas that stand in no bracket and no quotes.

    Examples
    --------
    >>> split_parameters('l = 0.1, knl = {0, 1}, type = "a, b"')
    ['l = 0.1', 'knl = {0, 1}', 'type = "a, b"']
    """
    found, depth, begin = [], 0, 0
    for part in re.finditer(r"\"[^\"]*\"|'[^']*'|[(){},]", text):
        if part[0] in "({":
            depth += 1
        elif part[0] in ")}":
            depth -= 1
        elif part[0] == "," and depth == 0:
            found.append(text[begin : part.start()].strip())
            begin = part.end()
    return [*found, text[begin:].strip()]


class Interpreter:
    """The state after a file's statements: variables, elements, sequences, lines and beams."""

    def __init__(self, dialect: Dialect = MADX) -> None:
        self.dialect, self.values = dialect, Values(self._attribute)
        self.elements: dict[str, Definition] = {}
        self.lines: dict[str, Definition] = {}
        self.beams: dict[str, dict[str, Attribute]] = {"": {}}
        self.rbarc, self.used = True, None
        self._open: Definition | None = None
        self._taken: bool | None = None  # whether a branch of the last IF was, if one may follow
        self._calls, self._ended = 0, False
        self._main: str | PathLike[str] | None = None

    def run(
        self, text: str, path: str | PathLike[str], line: int = 1, *, block: bool = False
    ) -> None:
        """Carry out the statements of a file, or of a block of one."""
        self._main = path if self._main is None else self._main
        for statement in statements(self.dialect.translate(text), path, line):
            if self._ended:
                return
            taken, self._taken = self._taken, None
            word = re.match(r"\w*", statement.text)[0].lower()
            if statement.block is not None:
                self._block(statement, word, taken)
            elif word == "return":
                if block:
                    raise statement.error()
                if path != self._main or self.dialect is not MADX:  # which passes over it there
                    return
            else:
                self._one(statement)

    def finish(self, path: str | PathLike[str]) -> None:
        """Refuse a sequence that is left open."""
        if self._open is not None:
            raise self._open.error(f"sequence '{self._open.name}' without an end", "ENDSEQUENCE")

    def number(self, parameter: Attribute) -> float:
        """The value of a parameter now.

        Raises
        ------
        InputError
            If it is none, with its place.
        """
        value = parameter.value
        if parameter.later:
            value = self._evaluated(parameter.text)
        if isinstance(value, Exception):
            raise InputError(str(value), "a number", parameter.path, parameter.line)
        return value

    def _evaluated(self, text: str) -> float | tuple[float, ...] | ValueError:
        """A number, or several in braces; what is wrong with it as a value."""
        try:
            if text.startswith("{") and text.endswith("}"):
                return tuple(self.values.of(part) for part in split_parameters(text[1:-1]))
            return self.values.of(text)
        except ValueError as error:
            return error

    def _parameter(self, statement: MadxStatement, later: bool, text: str) -> Attribute:
        value = None if later else self._evaluated(text)
        return Attribute(text, later, value, statement.path, statement.line)

    def _parameters(self, statement: MadxStatement, text: str) -> dict[str, Attribute]:
        found: dict[str, Attribute] = {}
        text = text.strip()
        if not text:
            return found
        if not text.startswith(","):
            raise statement.error(f"'{text[:20]}' where a comma belongs", "NAME: CLASS, L = ...;")
        for part in split_parameters(text[1:]):
            if (one := PARAMETER.fullmatch(part)) is None:
                raise statement.error(f"'{part[:40]}'", "NAME = value")
            sign, name, equals, value = one.groups()
            if value is None:
                value = "0" if sign == "-" else "1"
            elif sign:
                raise statement.error(f"'{part[:40]}'", "NAME = value")
            own = self._parameter(statement, equals == ":=", value.strip())
            found[name.lower()] = own if equals else own._replace(text="")
        return found

    def _attribute(self, name: str, key: str) -> float:
        """The value of ``name->key`` in an expression."""
        if name not in self.elements:
            raise ValueError(f"'{name}->{key}' of no element")
        parameter = self.elements[name].parameters.get(key)
        return 0.0 if parameter is None else float(self.number(parameter))

    def _block(self, statement: MadxStatement, word: str, taken: bool | None) -> None:
        if word in ("if", "elseif", "else"):
            if word == "if":
                taken = False
            elif taken is None:
                raise statement.error(f"{word.upper()} without IF", "IF (...) {...} before it")
            if not taken:
                with statement.read("a comparison of numbers"):
                    taken = word == "else" or self.values.holds(statement.text[len(word) :].strip())
                if taken:
                    self.run(statement.block, statement.path, statement.line, block=True)
            self._taken = None if word == "else" else taken
        elif word == "while":
            raise statement.error()

    def _one(self, statement: MadxStatement) -> None:
        text = statement.text
        if found := ASSIGNMENT.fullmatch(text):
            kind, name, equals, value = found.groups(default="")
            with statement.read("an expression that MAD-X reads"):
                self.values.assign(kind.lower(), name.lower(), equals == ":=", value.strip())
        elif found := ARROW.fullmatch(text):
            # Evaluated at once, as MAD-X does even after :=
            given = self._parameter(statement, False, found[3].strip())
            self.number(given)
            self._set(statement, found[1].lower(), {found[2].lower(): given})
        elif found := LABEL.fullmatch(text):
            self._define(statement, *found.groups())
        elif found := COMMAND.fullmatch(text):
            self._command(statement, found[1].lower(), found[2])
        else:
            raise statement.error()

    def _set(self, statement: MadxStatement, name: str, given: Mapping[str, Attribute]) -> None:
        """Change parameters of an element; as in MAD-X, not of those derived from it."""
        if name not in self.elements or {"at", "from"} & given.keys():
            raise statement.error()
        self.elements[name].parameters |= given
        self.values.changed()

    def _define(
        self, statement: MadxStatement, label: str, arguments: str, kind: str, rest: str
    ) -> None:
        name, said = label.lower(), kind.lower()
        kind = said if said in self.elements else self.dialect.classes.get(said, said)
        shown = decoded(label) if self.dialect is ELEGANT else label
        own = Definition(shown, kind, statement.path, statement.line, type=said.upper())
        if kind in HARMLESS_CLASSES:
            return
        if arguments:
            raise statement.error()
        if kind == "line" and self._open is None:
            own.members = re.sub(r"^\s*:?=\s*", "", rest)
            self.elements.pop(name, None)
            self.lines[name] = own
        elif kind == "sequence" and self._open is None:
            own.parameters = self._parameters(statement, rest)
            self.elements.pop(name, None)
            self.lines[name] = self._open = own
        elif kind in self.lines:
            raise statement.error()
        else:
            self._element(name, own, self._parameters(statement, rest))

    def _element(self, name: str, own: Definition, given: dict[str, Attribute]) -> None:
        place = {key: given.pop(key) for key in ("at", "from") if key in given}
        parent = self.elements.get(own.kind)
        if parent is not None:
            own.kind, own.type = parent.kind, parent.type
            own.parameters = dict(parent.parameters)
        own.parameters |= given
        known = self.elements.get(name) or self.lines.get(name)
        own.name = known.name if known else own.name
        self.lines.pop(name, None)
        self.elements[name] = own
        self.values.changed()
        if self._open is not None:
            self._open.placed.append((name, place))

    def _command(self, statement: MadxStatement, name: str, rest: str) -> None:
        if self._open is not None:
            self._within(statement, name, rest)
        elif name in HARMLESS or name.startswith("ptc_"):
            return
        elif name in ENDS:
            self._ended = True
        elif name in self.elements:
            self._set(statement, name, self._parameters(statement, rest))
        elif own := getattr(self, f"_{name}_command", None):
            own(statement, self._parameters(statement, rest))
        else:
            raise statement.error()

    def _within(self, statement: MadxStatement, name: str, rest: str) -> None:
        """A statement between SEQUENCE and ENDSEQUENCE."""
        if name == "endsequence":
            self._open = None
            return
        given = self._parameters(statement, rest)
        if name not in self.elements and name not in self.lines:
            known = [d.name for d in (*self.elements.values(), *self.lines.values())]
            raise statement.error(
                f"'{name}', which nothing defines before it", nearest(name, known)
            )
        if further := [key for key in given if key not in NO_MATTER]:
            found = f"'{further[0]}' where an element is placed, which MAD-X passes over"
            raise statement.error(found, "AT and FROM; give it where the element is defined")
        self._open.placed.append((name, given))

    def _use_command(self, statement: MadxStatement, given: Mapping[str, Attribute]) -> None:
        for key in given:
            if key not in ("sequence", "period"):
                raise statement.error(
                    f"USE with {key.upper()}", "the whole line, and --from and --to"
                )
        self.used = next((word_of(p).lower() for p in given.values()), self.used)

    def _call_command(self, statement: MadxStatement, given: Mapping[str, Attribute]) -> None:
        if "file" not in given or self._calls >= MOST_CALLS:
            most = f"more than {MOST_CALLS} files called" if "file" in given else ""
            raise statement.error(most, "CALL, FILE = ..., of files that do not call one another")
        path = Path(statement.path).resolve().parent / word_of(given["file"])
        self._calls += 1
        try:
            text = read_text(path)
        except InputError as error:
            raise statement.error(f"{path}: {error.found}", error.expected) from None
        self.run(text, path)

    def _option_command(self, statement: MadxStatement, given: Mapping[str, Attribute]) -> None:
        for key, parameter in given.items():
            on = word_of(parameter).lower() not in ("false", "no", "0") and parameter.value != 0.0
            if key in ("rbarc", "reset"):
                self.rbarc = on or key == "reset"
            elif key not in HARMLESS_OPTIONS:
                raise statement.error(
                    f"option '{key}', which beamfit does not know", "RBARC or none"
                )

    def _beam_command(self, statement: MadxStatement, given: dict[str, Attribute]) -> None:
        sequence = word_of(given.pop("sequence", None)).lower()
        if "bv" in given and self.number(given["bv"]) != 1.0:
            raise statement.error("a beam with BV = -1, which runs the other way", "BV = 1")
        beam = self.beams.setdefault(sequence, {})
        own = {k: self._parameter(statement, False, p.text) for k, p in given.items() if p.text}
        if ENERGIES & own.keys():  # the last command that says the energy does, in this order
            for key in ENERGIES & beam.keys():
                del beam[key]
        beam |= own

    def _resbeam_command(self, statement: MadxStatement, given: Mapping[str, Attribute]) -> None:
        self.beams[word_of(given.get("sequence")).lower()] = {}


ENERGIES = {"energy", "pc", "gamma", "beta", "brho"}


def word_of(parameter: Attribute | None, default: str = "") -> str:
    """The text of a parameter that is a word, without its quotes, if it is there."""
    return default if parameter is None else parameter.text.strip().strip("\"'").strip()
