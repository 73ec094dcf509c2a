"""TOML files checked against a schema: which keys a table may have, of what kind, in what range."""

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

# A key whose parts between dots take tomllib minutes; a whole number that no other program reads,
# and whose decimal digits Python does not write.
ENDLESS = {
    re.compile(r"(?:[\w\"'-]+[ \t]*\.[ \t]*){20}"): "a key of more than 20 parts",
    re.compile(r"\b0[xob][0-9A-Fa-f_]{250,}"): "an integer of {} digits",
}
# Words of which all are named, and not the nearest.
MOST_LISTED = 3
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
    """Kind, unit and range of the value of a key.

    Attributes
    ----------
    field : str
        Name of the value it gives; "" for what is only checked.
    factor : float
        SI value of one unit.
    default : object
        Value where the key is missing, in SI; `REQUIRED` if it must be there.
    low, high : float
        Numbers lie between the two and are neither.
    said : str
        That range in words.
    kind : type
        Of the value.
    among : sequence of str
        Words of which a text is one.
    each : type
        Of the values of a list.
    """

    field: str = ""
    factor: float = 1.0
    default: Any = REQUIRED
    low: float = -math.inf
    high: float = math.inf
    said: str = ""
    kind: Any = NUMBER
    among: Sequence[str] = ()
    each: Any = object

    def amiss(self, value: object) -> str | None:
        """Say what should stand there instead of a value, or None if the value is good.

        Examples
        --------
        >>> Key(low=0.0, said="a positive number").amiss(-1.0)
        'a positive number'
        """
        usual = KINDS[self.kind]
        if not isinstance(value, self.kind) or (isinstance(value, bool) and self.kind is not FLAG):
            return usual
        if self.kind is TEXT:
            known = not self.among or value in self.among
            return None if known and value.strip() else self._words(value)
        if self.kind is LIST and not all(map(self._fits, value)):
            return self.said
        if self.kind not in (WHOLE, NUMBER, NUMBERS) or value == self.default:
            return None
        numbers = value if isinstance(value, list) else [value]
        whole = self.kind is not WHOLE or value % 1 == 0
        if not (numbers and whole and all(map(is_number, numbers))):
            return usual
        return None if all(self.low < number < self.high for number in numbers) else self.said

    def _words(self, value: str) -> str:
        few = " or ".join(self.among) or "a name"
        return nearest(value, list(self.among)) if len(self.among) > MOST_LISTED else few

    def _fits(self, value: object) -> bool:
        return is_number(value) if self.each is NUMBER else isinstance(value, self.each)

    def in_si(self, value: Any) -> Any:
        """A good value in SI; what is neither number nor list of numbers as it is."""
        if self.kind is NUMBERS and isinstance(value, list):
            return [number * self.factor for number in value]
        if self.kind is WHOLE:
            return int(value)
        return value * self.factor if self.kind in (NUMBER, NUMBERS) else value


def keyed(name: str, default: Any = REQUIRED, **how: Any) -> Any:
    """A field of a dataclass with the key of a table that gives it; see `Section.read`."""
    given = {} if default is REQUIRED else {"default": default}
    return field(**given, metadata={name: Key(default=default, **how)})


def is_number(value: object) -> bool:
    """Tell a value that is a finite number (an integer of 400 digits is none)."""
    return isinstance(value, NUMBER) and not isinstance(value, bool) and abs(value) < 1e300


@dataclass(frozen=True)
class Section:
    """A table of a file, and where in the text it begins.

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
        Where that is, for messages.
    prefix : str
        What stands before the names of its own tables.
    sha256 : str
        Digest of the file.
    """

    path: str | PathLike[str]
    lines: tuple[str, ...]
    table: Mapping[str, Any]
    start: int = 0
    words: str = "at the top level"
    prefix: str = ""
    sha256: str = ""

    def error(self, found: str, expected: str, key: str | None = None) -> InputError:
        """Make the error that names the line on which the key (or the table) stands."""
        line = self.start + 1 if key is None else self._line(key) + 1
        return InputError(found, expected, path=self.path, line=line, column=key)

    def _line(self, key: str) -> int:
        """Find the line of `key =` before the next table, or of a table of that name."""
        value = re.compile(rf"\s*['\"]?{re.escape(key)}['\"]?\s*[=.]")
        head = re.compile(rf"\s*\[\[?\s*{re.escape(self.prefix + key)}\s*\]")
        inside = True
        for n in range(self.start, len(self.lines)):
            inside = inside and (n == self.start or not self.lines[n].lstrip().startswith("["))
            if (inside and value.match(self.lines[n])) or head.match(self.lines[n]):
                return n
        return self.start

    def section(self, name: str) -> Section:
        """A table of this one, empty where there is none.

        Raises
        ------
        InputError
            If something else stands under its name.
        """
        table = self.table.get(name, {})
        if not isinstance(table, dict):
            raise self.error(f"{name} = {table!r}"[:80], f"a table [{name}]", name)
        start = self._line(name)
        return Section(self.path, self.lines, table, start, f"in [{name}]", f"{name}.")

    def sections(self, name: str) -> list[Section]:
        """The tables of a list of tables [[name]].

        Raises
        ------
        InputError
            If there is none, or one of them is no table.
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
        """Check every key, and give the values in SI by field.

        Raises
        ------
        InputError
            If a key is missing, unknown, of another kind or out of its range.
        """
        for name, value in self.table.items():
            if name not in keys:
                raise self.error("an unknown key", nearest(name, list(keys)), name)
            if expected := keys[name].amiss(value):
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
        """Make a dataclass whose fields are `keyed`; checked as by `values`.

        Examples
        --------
        >>> @dataclass
        ... class Shot:
        ...     wait: float = keyed("wait_s", low=0.0, said="a time above zero")
        >>> Section("a.toml", (), {"wait_s": 2.5}).read(Shot)
        Shot(wait=2.5)
        """
        own = [
            (name, k._replace(field=f.name)) for f in fields(kind) for name, k in f.metadata.items()
        ]
        return kind(**self.values(dict(own)))

    def one_of(self, names: Iterable[str], hint: str = "") -> str:
        """The one of some keys that is given; a hint says what may stand for none.

        Raises
        ------
        InputError
            If there is none, or more than one.
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
        What it should be, such as "a lattice".
    form : str, optional
        What its key ``format`` says.
    needed : bool
        Whether it has to say that.

    Returns
    -------
    Section
        Its top level, without the format.

    Raises
    ------
    InputError
        If it cannot be read or does not parse, with the line, or has another format.

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
        for endless, said in ENDLESS.items():
            if found := endless.search(text):
                line = text.count("\n", 0, found.start()) + 1
                raise ValueError(f"{said.format(len(found[0]) - 2)} (at line {line})")
        table = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # integers too long, nesting too deep
        if re.search(r"^[^#=\n]*\bsize_[xy]_", text, re.MULTILINE):
            expected = "the scan first and the lattice after --lattice; are they swapped?"
            raise InputError(f"a scan where {what} should be", expected, path) from None
        told = re.search(r"at line (\d+)", str(error))
        line = int(told[1]) if told else len(lines)
        found = "TOML that does not parse ({})".format(re.sub(r"\s*\(at .*\)", "", str(error)))
        raise InputError(found, f"{what} file in TOML", path, line) from None
    top = Section(path, lines, table, sha256=digest(path))
    if form and (found := table.pop("format", None if needed else form)) != form:
        raise top.error(f"format {found!r}"[:80], f'format = "{form}"', "format")
    return top
