"""What the headers of a scan mean, and the cells beneath them before they are a scan."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from os import PathLike

from beamfit.errors import InputError, nearest

__all__ = [
    "CARRIED",
    "LENGTHS",
    "MOST_ROWS",
    "Column",
    "Table",
    "check_header",
    "check_separator",
    "column_of",
]

# More rows than any scan: such a file is a log, and is refused before it fills the memory.
MOST_ROWS = 100_000
LENGTHS = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "μm": 1e-6}
SETTINGS = ("A", "kG", "k1", "k1l")
CARRIED = re.compile(r"note_.*|time|timestamp|charge_[np]C")
SIZE = re.compile(r"(size_[xy](?:_error)?|resolution)_([^_]*)")


@dataclass(frozen=True)
class Column:
    """What a header means: the quantity, the unit it is in, and the factor to SI."""

    header: str
    key: str
    unit: str = ""
    factor: float = 1.0


@dataclass
class Table:
    """The cells of a file before they are a scan: one list a column, and where each row was."""

    path: str | PathLike[str]
    columns: list[Column]
    cells: list[list[str]] = field(default_factory=list)
    lines: list[int] = field(default_factory=list)
    provenance: list[str] = field(default_factory=list)

    def error(self, found: str, expected: str, row: int | None, column: Column) -> InputError:
        """Make the error that names file, line and column."""
        line = None if row is None else self.lines[row]
        return InputError(found, expected, path=self.path, line=line, column=column.header)


def check_separator(
    names: Sequence[str], sign: str, path: str | PathLike[str], line: int | None
) -> None:
    """Refuse a header whose columns are separated by something else than commas.

    Parameters
    ----------
    names : sequence of str
        Its columns.
    sign : str
        A word by which it is known to be a header of this kind of file.
    path, line
        For the message.

    Raises
    ------
    InputError
        If there is one column, with a separator in its name.
    """
    for character, word in {";": "semicolons", "\t": "tabs", " ": "spaces"}.items():
        if len(names) == 1 and character in names[0] and sign in names[0]:
            raise InputError(
                f"columns separated by {word}",
                "a comma between columns and a decimal point in numbers",
                path=path,
                line=line,
            )


def column_of(header: str, path: str | PathLike[str], line: int | None) -> Column:
    """Understand one header, or say what it should have been."""
    if header in ("shot", "screen", "energy_MeV", "energy_spread") or CARRIED.fullmatch(header):
        return Column(header, header)
    if size := SIZE.fullmatch(header):
        key, unit = size.groups()
        if unit in LENGTHS:
            return Column(header, key, unit, LENGTHS[unit])
        known = "one of m, mm, um at the end, such as " + f"{key}_um"
        raise InputError(f"unknown unit '{unit}'", known, path=path, line=line, column=header)
    name, _, unit = header.rpartition("_")
    if name and unit in SETTINGS and not header.startswith("size_"):
        return Column(header, f"setting {name}", unit)
    raise InputError(
        f"unknown unit '{unit}'" if name else "a name without a unit",
        "a magnet with _A, _kG or _k1 at the end, "
        + nearest(
            header,
            [
                "size_x_um",
                "size_x_error_um",
                "size_y_um",
                "size_y_error_um",
                "resolution_um",
                "energy_MeV",
                "energy_spread",
                "shot",
                "screen",
            ],
        )
        + "; begin a name with note_ to carry a column along unread",
        path=path,
        line=line,
        column=header,
    )


def check_header(table: Table, line: int | None) -> None:
    """Check that the columns make a scan: a setting, a size, nothing twice."""
    keys = [c.key for c in table.columns]
    twice = [c for c in table.columns if keys.count(c.key) > 1]
    if twice:
        raise InputError(
            "a column twice",
            "each quantity once",
            path=table.path,
            line=line,
            column=twice[0].header,
        )
    sizes = [k for k in keys if k in ("size_x", "size_y")]
    if not sizes or not any(k.startswith("setting ") for k in keys):
        missing = (
            "a beam size column, such as size_x_um"
            if not sizes
            else ("a magnet setting column, such as Q2_A, Q2_kG or Q2_k1")
        )
        found = "columns " + ", ".join(c.header for c in table.columns)
        raise InputError(found, missing, path=table.path, line=line)
    for plane in "xy":
        if f"size_{plane}_error" in keys and f"size_{plane}" not in keys:
            raise InputError(
                f"size_{plane}_error without size_{plane}",
                f"a column size_{plane}_um",
                path=table.path,
                line=line,
            )
