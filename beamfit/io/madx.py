"""Interpreter of MAD-X files, and of others translated to MAD-X.

A statement that changes an element, a line or the beam is executed as in MAD-X, or refused with its
line. The rules are those of MAD-X 5.09, found by experiment where its manual is silent
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
from beamfit.io.dialects import ELEGANT, MADX, Dialect, blank_comment, decode_name
from beamfit.io.files import read_text
from beamfit.io.madx_values import NAME, Values, abbreviate, words

# Largest number of CALLs, against files that call one another.
MAX_CALLS = 50
COMMENT = re.compile(r"\"[^\"]*\"|'[^'\n]*'|![^\n]*|//[^\n]*|/\*.*?(?:\*/|\Z)", re.DOTALL)
DELIMITER = re.compile(r"\"[^\"]*\"|'[^'\n]*'|[;{}]")
# Heads of statements that end with a block in braces, not with a semicolon.
BLOCK_HEAD = re.compile(r"(if|elseif|else|while)\b|[\w.$]+\s*(\([^)]*\))?\s*:\s*macro\b", re.I)
ASSIGNMENT = re.compile(
    rf"(?:((?:real|int)\s+const|const|real|int)\s+)?({NAME})\s*(:?=)\s*(.+)", re.I | re.DOTALL
)
ELEMENT_ASSIGNMENT = re.compile(rf"({NAME})->({NAME})\s*:?=\s*(.+)", re.I | re.DOTALL)
LABELLED = re.compile(
    rf"[\"']?({NAME})[\"']?\s*(\([^)]*\))?\s*:\s*({NAME})\s*(.*)", re.I | re.DOTALL
)
COMMAND = re.compile(rf"[\"']?({NAME})[\"']?\s*(.*)", re.I | re.DOTALL)
PARAMETER = re.compile(rf"([-+]?)\s*({NAME})\s*(?:(:?=)\s*(.*))?", re.I | re.DOTALL)
# Commands that do not change elements, lines or the beam.
IGNORED_COMMANDS = words(
    "assign aperture coguess correct create csave dumpsequ dynap emit endtrack eoption "
    "eprint esave fill getorbit help ibs observe plot print printf putorbit readmytable "
    "readtable run save savebeta select set setplot show sodd start survey sxfwrite system "
    "tabstring title touschek track twiss usekick usemonitor value write "
)
# Parameters without effect on the transfer matrix of a line without bends in thin elements.
IGNORED_PARAMETERS = words(
    "at from type apertype aperture aper_offset aper_tol aper_vx aper_vy slot_id assembly_id "
    "mech_sep v_pos magnet model method nst exact kmax kmin calib polarity lrad comments kick "
    "hkick vkick k2 k2s k3 k3s h1 h2 thick fringe bend_fringe freq lag harmon n_bessel shunt "
    "tfill betrf pg sinkick sinpeak sintune sinphase file_td ramp1 ramp2 ramp3 ramp4 e1 e2"
)
# Classes that are not elements.
IGNORED_CLASSES = ("beta0", "macro")
# Options without effect on the transfer matrix of a line without thin dipoles.
IGNORED_OPTIONS = words(
    "echo echomacro info warn debug verify trace tell thin_foc thin_cf bborbit twiss_print "
    "no_fatal_stop "
)
END_COMMANDS = ("stop", "exit", "quit")


class Attribute(NamedTuple):
    """Parameter: its text, and its value or the error of evaluating it unless that is deferred."""

    text: str
    later: bool
    value: Any
    path: str | PathLike[str]
    line: int


@dataclass
class Definition:
    """Element, line or sequence: class, parameters, and place of its definition.

    ``type`` is the class as written in the file, ``members`` the list of a LINE, ``placements`` the
    names in a sequence, each with its AT and FROM.
    """

    name: str
    kind: str
    path: str | PathLike[str]
    line: int
    parameters: dict[str, Attribute] = field(default_factory=dict)
    members: str = ""
    placements: list[tuple[str, dict[str, Attribute]]] = field(default_factory=list)
    type: str = ""

    def error(self, found: str, expected: str) -> InputError:
        """Make an error at the definition."""
        return InputError(found, expected, self.path, self.line)


class MadxStatement(NamedTuple):
    """Statement, its block if it has one, and where it begins."""

    text: str
    block: str | None
    path: str | PathLike[str]
    line: int

    def error(self, found: str = "", expected: str = "") -> InputError:
        """Make an error at the statement."""
        expected = expected or "a file without it: run it in MAD-X, and SAVE the sequence"
        found = found or f"'{abbreviate(self.text)}', which beamfit does not carry out"
        return InputError(found, expected, self.path, self.line)

    @contextmanager
    def read(self, expected: str) -> Iterator[None]:
        """Turn a ValueError of an expression into an error at the statement."""
        try:
            yield
        except ValueError as error:
            raise self.error(str(error), expected) from None


def statements(text: str, path: str | PathLike[str], line: int = 1) -> Iterator[MadxStatement]:
    """Split a file into statements, without comments.

    Examples
    --------
    >>> [s.text for s in statements("a = 1; ! one; two\\nif (a > 0) {b = 2;}", "a.madx")]
    ['a = 1', 'if (a > 0)']
    """
    text = COMMENT.sub(blank_comment, text)
    begin, depth, block_start = 0, 0, None
    ends = [found.start() for found in re.finditer("\n", text)]

    def make_statement(end: int, block: str | None = None) -> MadxStatement:
        piece = text[begin:end]
        at = line + bisect(ends, begin + len(piece) - len(piece.lstrip()))
        return MadxStatement(piece.strip(), block, path, at)

    for found in DELIMITER.finditer(text):
        delimiter, place = found[0], found.start()
        depth += (delimiter == "{") - (delimiter == "}")
        if depth < 0:
            raise make_statement(place).error("'}' without '{'", "braces that match")
        if delimiter == "{" and depth == 1 and BLOCK_HEAD.match(text[begin:place].strip()):
            block_start = place
        elif delimiter == "}" and depth == 0 and block_start is not None:
            yield make_statement(block_start, text[block_start + 1 : place])
            begin, block_start = found.end(), None
        elif delimiter == ";" and depth == 0:
            if text[begin:place].strip():
                yield make_statement(place)
            begin = found.end()
    if text[begin:].strip():
        rest = make_statement(len(text))
        found = f"'{rest.text[:40]}' without an end"
        raise rest.error(found, "';' at the end of a statement, and quotes and braces that match")


def split_parameters(text: str) -> list[str]:
    """Split a list at commas outside brackets and quotes.

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
    """Executes statements; holds variables, elements, lines, sequences and beams."""

    def __init__(self, dialect: Dialect = MADX) -> None:
        self.dialect, self.values = dialect, Values(self._attribute)
        self.elements: dict[str, Definition] = {}
        self.lines: dict[str, Definition] = {}
        self.beams: dict[str, dict[str, Attribute]] = {"": {}}
        self.rbarc, self.used_line = True, None
        self._open_sequence: Definition | None = None
        self._branch_taken: bool | None = None  # in the last IF; None if no ELSE may follow
        self._call_count, self._ended = 0, False
        self._main_file: str | PathLike[str] | None = None

    def run(
        self, text: str, path: str | PathLike[str], line: int = 1, *, block: bool = False
    ) -> None:
        """Execute the statements of a file or of a block."""
        self._main_file = path if self._main_file is None else self._main_file
        for statement in statements(self.dialect.translate(text), path, line):
            if self._ended:
                return
            taken, self._branch_taken = self._branch_taken, None
            word = re.match(r"\w*", statement.text)[0].lower()
            if statement.block is not None:
                self._execute_block(statement, word, taken)
            elif word == "return":
                if block:
                    raise statement.error()
                if path != self._main_file or self.dialect is not MADX:  # MAD-X ignores it there
                    return
            else:
                self._execute(statement)

    def finish(self, path: str | PathLike[str]) -> None:
        """Raise if a sequence has no ENDSEQUENCE."""
        if self._open_sequence is not None:
            raise self._open_sequence.error(
                f"sequence '{self._open_sequence.name}' without an end", "ENDSEQUENCE"
            )

    def number(self, parameter: Attribute) -> float:
        """Evaluate a parameter with the present variables.

        Raises
        ------
        InputError
            If it has no value.
        """
        value = parameter.value
        if parameter.later:
            value = self._evaluate(parameter.text)
        if isinstance(value, Exception):
            raise InputError(str(value), "a number", parameter.path, parameter.line)
        return value

    def _evaluate(self, text: str) -> float | tuple[float, ...] | ValueError:
        """Number, or numbers in braces; an error is returned, not raised."""
        try:
            if text.startswith("{") and text.endswith("}"):
                return tuple(self.values.evaluate(part) for part in split_parameters(text[1:-1]))
            return self.values.evaluate(text)
        except ValueError as error:
            return error

    def _parameter(self, statement: MadxStatement, later: bool, text: str) -> Attribute:
        value = None if later else self._evaluate(text)
        return Attribute(text, later, value, statement.path, statement.line)

    def _parameters(self, statement: MadxStatement, text: str) -> dict[str, Attribute]:
        """Parse the parameters after the first comma of a statement."""
        found: dict[str, Attribute] = {}
        text = text.strip()
        if not text:
            return found
        if not text.startswith(","):
            raise statement.error(f"'{text[:20]}' where a comma belongs", "NAME: CLASS, L = ...;")
        for part in split_parameters(text[1:]):
            if (match := PARAMETER.fullmatch(part)) is None:
                raise statement.error(f"'{part[:40]}'", "NAME = value")
            sign, name, equals, value = match.groups()
            if value is None:
                value = "0" if sign == "-" else "1"
            elif sign:
                raise statement.error(f"'{part[:40]}'", "NAME = value")
            attribute = self._parameter(statement, equals == ":=", value.strip())
            found[name.lower()] = attribute if equals else attribute._replace(text="")
        return found

    def _attribute(self, name: str, key: str) -> float:
        """Value of ``name->key`` in an expression."""
        if name not in self.elements:
            raise ValueError(f"'{name}->{key}' of no element")
        parameter = self.elements[name].parameters.get(key)
        return 0.0 if parameter is None else float(self.number(parameter))

    def _execute_block(self, statement: MadxStatement, word: str, taken: bool | None) -> None:
        """Execute the block of an IF; a WHILE is refused."""
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
            self._branch_taken = None if word == "else" else taken
        elif word == "while":
            raise statement.error()

    def _execute(self, statement: MadxStatement) -> None:
        """Execute a statement without a block."""
        text = statement.text
        if found := ASSIGNMENT.fullmatch(text):
            kind, name, equals, value = found.groups(default="")
            with statement.read("an expression that MAD-X reads"):
                self.values.assign(kind.lower(), name.lower(), equals == ":=", value.strip())
        elif found := ELEMENT_ASSIGNMENT.fullmatch(text):
            # Evaluated immediately, even after :=, as in MAD-X.
            given = self._parameter(statement, False, found[3].strip())
            self.number(given)
            self._set_parameters(statement, found[1].lower(), {found[2].lower(): given})
        elif found := LABELLED.fullmatch(text):
            self._define(statement, *found.groups())
        elif found := COMMAND.fullmatch(text):
            self._command(statement, found[1].lower(), found[2])
        else:
            raise statement.error()

    def _set_parameters(
        self, statement: MadxStatement, name: str, given: Mapping[str, Attribute]
    ) -> None:
        """Change parameters of an element; elements derived from it keep theirs, as in MAD-X."""
        if name not in self.elements or {"at", "from"} & given.keys():
            raise statement.error()
        self.elements[name].parameters |= given
        self.values.invalidate()

    def _define(
        self, statement: MadxStatement, label: str, arguments: str, kind: str, rest: str
    ) -> None:
        """Execute LABEL: CLASS, ...: define an element, line or sequence."""
        name, word = label.lower(), kind.lower()
        kind = word if word in self.elements else self.dialect.classes.get(word, word)
        shown = decode_name(label) if self.dialect is ELEGANT else label
        new = Definition(shown, kind, statement.path, statement.line, type=word.upper())
        if kind in IGNORED_CLASSES:
            return
        if arguments:
            raise statement.error()
        if kind == "line" and self._open_sequence is None:
            new.members = re.sub(r"^\s*:?=\s*", "", rest)
            self.elements.pop(name, None)
            self.lines[name] = new
        elif kind == "sequence" and self._open_sequence is None:
            new.parameters = self._parameters(statement, rest)
            self.elements.pop(name, None)
            self.lines[name] = self._open_sequence = new
        elif kind in self.lines:
            raise statement.error()
        else:
            self._define_element(name, new, self._parameters(statement, rest))

    def _define_element(self, name: str, new: Definition, given: dict[str, Attribute]) -> None:
        """Add an element, derived from its class, and place it if a sequence is open."""
        place = {key: given.pop(key) for key in ("at", "from") if key in given}
        parent = self.elements.get(new.kind)
        if parent is not None:
            new.kind, new.type = parent.kind, parent.type
            new.parameters = dict(parent.parameters)
        new.parameters |= given
        previous = self.elements.get(name) or self.lines.get(name)
        new.name = previous.name if previous else new.name
        self.lines.pop(name, None)
        self.elements[name] = new
        self.values.invalidate()
        if self._open_sequence is not None:
            self._open_sequence.placements.append((name, place))

    def _command(self, statement: MadxStatement, name: str, rest: str) -> None:
        """Execute a command, by its method if it has one."""
        if self._open_sequence is not None:
            self._execute_in_sequence(statement, name, rest)
        elif name in IGNORED_COMMANDS or name.startswith("ptc_"):
            return
        elif name in END_COMMANDS:
            self._ended = True
        elif name in self.elements:
            self._set_parameters(statement, name, self._parameters(statement, rest))
        elif method := getattr(self, f"_{name}_command", None):
            method(statement, self._parameters(statement, rest))
        else:
            raise statement.error()

    def _execute_in_sequence(self, statement: MadxStatement, name: str, rest: str) -> None:
        """Execute a statement between SEQUENCE and ENDSEQUENCE."""
        if name == "endsequence":
            self._open_sequence = None
            return
        given = self._parameters(statement, rest)
        if name not in self.elements and name not in self.lines:
            names = [d.name for d in (*self.elements.values(), *self.lines.values())]
            raise statement.error(
                f"'{name}', which nothing defines before it", nearest(name, names)
            )
        if other_keys := [key for key in given if key not in IGNORED_PARAMETERS]:
            found = f"'{other_keys[0]}' where an element is placed, which MAD-X passes over"
            raise statement.error(found, "AT and FROM; give it where the element is defined")
        self._open_sequence.placements.append((name, given))

    def _use_command(self, statement: MadxStatement, given: Mapping[str, Attribute]) -> None:
        """USE: select the line."""
        for key in given:
            if key not in ("sequence", "period"):
                raise statement.error(
                    f"USE with {key.upper()}", "the whole line, and --from and --to"
                )
        self.used_line = next((word_of(p).lower() for p in given.values()), self.used_line)

    def _call_command(self, statement: MadxStatement, given: Mapping[str, Attribute]) -> None:
        """CALL: execute another file."""
        if "file" not in given or self._call_count >= MAX_CALLS:
            found = f"more than {MAX_CALLS} files called" if "file" in given else ""
            raise statement.error(found, "CALL, FILE = ..., of files that do not call one another")
        path = Path(statement.path).resolve().parent / word_of(given["file"])
        self._call_count += 1
        try:
            text = read_text(path)
        except InputError as error:
            raise statement.error(f"{path}: {error.found}", error.expected) from None
        self.run(text, path)

    def _option_command(self, statement: MadxStatement, given: Mapping[str, Attribute]) -> None:
        """OPTION: only RBARC has an effect."""
        for key, parameter in given.items():
            on = word_of(parameter).lower() not in ("false", "no", "0") and parameter.value != 0.0
            if key in ("rbarc", "reset"):
                self.rbarc = on or key == "reset"
            elif key not in IGNORED_OPTIONS:
                raise statement.error(
                    f"option '{key}', which beamfit does not know", "RBARC or none"
                )

    def _beam_command(self, statement: MadxStatement, given: dict[str, Attribute]) -> None:
        """BEAM: set the parameters of a beam."""
        sequence = word_of(given.pop("sequence", None)).lower()
        if "bv" in given and self.number(given["bv"]) != 1.0:
            raise statement.error("a beam with BV = -1, which runs the other way", "BV = 1")
        beam = self.beams.setdefault(sequence, {})
        values = {k: self._parameter(statement, False, p.text) for k, p in given.items() if p.text}
        if BEAM_ENERGIES & values.keys():  # the last BEAM with an energy counts
            for key in BEAM_ENERGIES & beam.keys():
                del beam[key]
        beam |= values

    def _resbeam_command(self, statement: MadxStatement, given: Mapping[str, Attribute]) -> None:
        """RESBEAM: reset a beam."""
        self.beams[word_of(given.get("sequence")).lower()] = {}


# Parameters of BEAM that determine the energy.
BEAM_ENERGIES = {"energy", "pc", "gamma", "beta", "brho"}


def word_of(parameter: Attribute | None, default: str = "") -> str:
    """Text of a parameter without quotes; the default if it is missing."""
    return default if parameter is None else parameter.text.strip().strip("\"'").strip()
