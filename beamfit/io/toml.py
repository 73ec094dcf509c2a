"""TOML files checked against a schema of keys: type, unit and range of each value."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from os import PathLike
from typing import Any, NamedTuple

from beamfit.errors import InputError, nearest
from beamfit.io.files import digest, read_text

# Texts that are refused before parsing: a dotted key of many parts takes tomllib minutes; integers
# of 250 hexadecimal digits are beyond floats, and Python does not print longer ones in decimal.
UNREADABLE = {
    re.compile(r"(?:[\w\"'-]+[ \t]*\.[ \t]*){20}"): "a key of more than 20 parts",
    re.compile(r"\b0[xob][0-9A-Fa-f_]{250,}"): "an integer of {} digits",
}
# A message lists up to this many choices; of more it gives the nearest.
MAX_LISTED = 3
REQUIRED: Any = object()
TEXT, LIST, FLAG, TABLE = str, list, bool, dict
NUMBER, WHOLE, NUMBERS = (int, float), (float, int), (int, float, list)
# How each kind of value is called in a message.
KINDS = {
    NUMBER: "a number",
    WHOLE: "a whole number",
    TEXT: "text in quotes",
    LIST: "a list",
    FLAG: "true or false",
    TABLE: "a table",
    NUMBERS: "a number or a list of numbers",
}


class Key(NamedTuple):
    """Type, unit and range of the value of a key.

    Attributes
    ----------
    field : str
        Name of the value in the result; "" if the key is only checked.
    factor : float
        SI value of one unit.
    default : object
        Value in SI if the key is missing; `REQUIRED` if it must be there.
    low, high : float
        Open interval of numbers.
    expected : str
        The range in words, for messages.
    kind : type
        Type of the value.
    among : sequence of str
        Allowed texts.
    each : type
        Type of the items of a list.
    """

    field: str = ""
    factor: float = 1.0
    default: Any = REQUIRED
    low: float = -math.inf
    high: float = math.inf
    expected: str = ""
    kind: Any = NUMBER
    among: Sequence[str] = ()
    each: Any = object

    def correction(self, value: object) -> str | None:
        """Expected content if a value is wrong; None if it is right.

        Examples
        --------
        >>> Key(low=0.0, expected="a positive number").correction(-1.0)
        'a positive number'
        """
        kind_text = KINDS[self.kind]
        if not isinstance(value, self.kind) or (isinstance(value, bool) and self.kind is not FLAG):
            return kind_text
        if self.kind is TEXT:
            allowed = not self.among or value in self.among
            return None if allowed and value.strip() else self._choices(value)
        if self.kind is LIST and not all(map(self._fits, value)):
            return self.expected
        if self.kind not in (WHOLE, NUMBER, NUMBERS) or value == self.default:
            return None
        numbers = value if isinstance(value, list) else [value]
        whole = self.kind is not WHOLE or value % 1 == 0
        if not (numbers and whole and all(map(is_number, numbers))):
            return kind_text
        return None if all(self.low < number < self.high for number in numbers) else self.expected

    def _choices(self, value: str) -> str:
        choices = " or ".join(self.among) or "a name"
        return nearest(value, list(self.among)) if len(self.among) > MAX_LISTED else choices

    def _fits(self, value: object) -> bool:
        return is_number(value) if self.each is NUMBER else isinstance(value, self.each)

    def in_si(self, value: Any) -> Any:
        """Convert a number or list of numbers to SI; other values stay."""
        if self.kind is NUMBERS and isinstance(value, list):
            return [number * self.factor for number in value]
        if self.kind is WHOLE:
            return int(value)
        return value * self.factor if self.kind in (NUMBER, NUMBERS) else value


def key_field(name: str, default: Any = REQUIRED, **options: Any) -> Any:
    """Field of a dataclass, read from the key `name` of a table; see `Section.read`."""
    field_default = {} if default is REQUIRED else {"default": default}
    return field(**field_default, metadata={name: Key(default=default, **options)})


def is_number(value: object) -> bool:
    """True if a value is a finite number (integers beyond the range of float are not)."""
    return isinstance(value, NUMBER) and not isinstance(value, bool) and abs(value) < 1e300


@dataclass(frozen=True)
class Section:
    """Table of a file, with its place in the text.

    Attributes
    ----------
    path : str or path
        The file.
    lines : tuple of str
        Its text.
    table : mapping
        Keys and values.
    start : int
        Line at which the table begins, counted from 0.
    words : str
        That place in words, for messages.
    prefix : str
        Prefix of the names of its sub-tables.
    sha256 : str
        SHA-256 of the file.
    """

    path: str | PathLike[str]
    lines: tuple[str, ...]
    table: Mapping[str, Any]
    start: int = 0
    words: str = "at the top level"
    prefix: str = ""
    sha256: str = ""

    def error(self, found: str, expected: str, key: str | None = None) -> InputError:
        """Make an error at the line of a key, or of the table."""
        line = self.start + 1 if key is None else self._find_line(key) + 1
        return InputError(found, expected, path=self.path, line=line, column=key)

    def _find_line(self, key: str) -> int:
        """Find the line of `key =` in this table, or of a sub-table of that name."""
        value = re.compile(rf"\s*['\"]?{re.escape(key)}['\"]?\s*[=.]")
        head = re.compile(rf"\s*\[\[?\s*{re.escape(self.prefix + key)}\s*\]")
        inside = True
        for n in range(self.start, len(self.lines)):
            inside = inside and (n == self.start or not self.lines[n].lstrip().startswith("["))
            if (inside and value.match(self.lines[n])) or head.match(self.lines[n]):
                return n
        return self.start

    def section(self, name: str) -> Section:
        """Sub-table of this table; empty if it is missing.

        Raises
        ------
        InputError
            If its name has a value that is no table.
        """
        table = self.table.get(name, {})
        if not isinstance(table, dict):
            raise self.error(f"{name} = {table!r}"[:80], f"a table [{name}]", name)
        start = self._find_line(name)
        return Section(self.path, self.lines, table, start, f"in [{name}]", f"{name}.")

    def sections(self, name: str) -> list[Section]:
        """Tables of a list of tables [[name]].

        Raises
        ------
        InputError
            If the list is empty, or an item is no table.
        """
        head = re.compile(rf"\s*\[\[\s*{re.escape(name)}\s*\]\]")
        heads = [n for n, text in enumerate(self.lines) if head.match(text)]
        tables = self.table[name]
        for table in tables or [None]:
            if not isinstance(table, dict):
                found = f"{name} {table!r}"[:80] if tables else f"no {name}s"
                raise self.error(found, f"tables [[{name}]] in their order", name)
        starts = heads + [0] * (len(tables) - len(heads))
        return [
            Section(self.path, self.lines, table, start, f"in {name} {number}", f"{name}.")
            for number, (table, start) in enumerate(zip(tables, starts, strict=False), 1)
        ]

    def values(self, keys: Mapping[str, Key]) -> dict[str, Any]:
        """Check all keys, and return their values in SI by field.

        Raises
        ------
        InputError
            If a key is missing or unknown, or its value has the wrong type or range.
        """
        for name, value in self.table.items():
            if name not in keys:
                raise self.error("an unknown key", nearest(name, list(keys)), name)
            if expected := keys[name].correction(value):
                raise self.error(f"{value!r}"[:80], expected, name)
        for name, key in keys.items():
            if name not in self.table and key.default is REQUIRED:
                raise self.error(f"the key is missing {self.words}", KINDS[key.kind], name)
        return {
            key.field: key.default if name not in self.table else key.in_si(self.table[name])
            for name, key in keys.items()
            if key.field
        }

    def read(self, kind: type[Any]) -> Any:
        """Make a dataclass whose fields are made by `key_field`; checked as by `values`.

        Examples
        --------
        >>> @dataclass
        ... class Shot:
        ...     wait: float = key_field("wait_s", low=0.0, expected="a time above zero")
        >>> Section("a.toml", (), {"wait_s": 2.5}).read(Shot)
        Shot(wait=2.5)
        """
        keys = [
            (name, key._replace(field=f.name))
            for f in fields(kind)
            for name, key in f.metadata.items()
        ]
        return kind(**self.values(dict(keys)))

    def one_of(self, names: Iterable[str], hint: str = "") -> str:
        """The one key of several that is present; a hint is for the message if there is none.

        Raises
        ------
        InputError
            If none or more than one is present.
        """
        names = list(names)
        given = [name for name in names if name in self.table]
        if len(given) != 1:
            none = "neither" if len(names) == 2 else "none"
            found = f"{'both' if given else none} of {' and '.join(given or names)}"
            expected = "one of " + ", ".join(names) + hint * (not given)
            raise self.error(f"{found} {self.words}", expected, (given or names)[-1])
        return given[0]


def read_toml(
    path: str | PathLike[str], what: str, form: str = "", *, needed: bool = True
) -> Section:
    """Read a TOML file.

    Parameters
    ----------
    path : str or path
        The file.
    what : str
        Kind of file for messages, such as "a lattice".
    form : str, optional
        Required value of the key ``format``.
    needed : bool
        False if the key ``format`` may be missing.

    Returns
    -------
    Section
        The top level, without the key ``format``.

    Raises
    ------
    InputError
        If the file cannot be read or parsed (with the line), or has another format.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> file = pathlib.Path(tempfile.mkdtemp()) / "a.toml"
    >>> _ = file.write_text("length_mm = 2.0\\n")
    >>> read_toml(file, "a lattice").values({"length_mm": Key("length", 1e-3)})
    {'length': 0.002}
    """
    text = read_text(path)
    lines = tuple(text.splitlines())
    try:
        for pattern, description in UNREADABLE.items():
            if found := pattern.search(text):
                line = text.count("\n", 0, found.start()) + 1
                raise ValueError(f"{description.format(len(found[0]) - 2)} (at line {line})")
        table = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # integers too long, nesting too deep
        if re.search(r"^[^#=\n]*\bsize_[xy]_", text, re.MULTILINE):
            expected = "the scan first and the lattice after --lattice; are they swapped?"
            raise InputError(f"a scan where {what} should be", expected, path) from None
        position = re.search(r"at line (\d+)", str(error))
        line = int(position[1]) if position else len(lines)
        found = "TOML that does not parse ({})".format(re.sub(r"\s*\(at .*\)", "", str(error)))
        raise InputError(found, f"{what} file in TOML", path, line) from None
    top = Section(path, lines, table, sha256=digest(path))
    if form and (found := table.pop("format", None if needed else form)) != form:
        raise top.error(f"format {found!r}"[:80], f'format = "{form}"', "format")
    return top
