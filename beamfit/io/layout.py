"""The meaning of a file's columns as a person says it: --columns, and layouts."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from os import PathLike
from pathlib import Path
from typing import Any

from beamfit.errors import InputError, nearest
from beamfit.io.cells import DAY_FIRST, MONTH_FIRST
from beamfit.io.columns import Sheet, spelled, unit_at_end
from beamfit.io.toml import LIST, TABLE, TEXT, Key, read_toml

FORMAT = "beamfit-layout-1"
# Layouts that come with the package, by name.
SHIPPED = Path(__file__).with_name("layouts")
ORDERS = (DAY_FIRST, MONTH_FIRST)
NAMES = "a list of names in quotes"
EXAMPLE = "'xrms=size_x_um, QUAD:BACT=Q525_kG', or a layout (.toml)"
KEYS = {
    "columns": Key("columns", kind=TABLE, default={}),
    "ignore": Key("ignore", kind=LIST, default=[], said=NAMES, each=str),
    "dates": Key("dates", kind=TEXT, default="", among=ORDERS),
    "header": Key("header", kind=LIST, default=[], said=NAMES, each=str),
}


@dataclass(frozen=True)
class Layout:
    """The meaning of a file's columns: believed as it stands, and nothing is guessed against it.

    Attributes
    ----------
    names : tuple of (str, str)
        Header of the file, or a pattern with * and ?, and the name that beamfit has for it, with
        its unit: ``("xrms", "size_x_um")``.
    needed : tuple of str
        Headers that must be there: those said for one file; a laboratory's layout may have more.
    ignore : tuple of str
        Columns to leave unread, where they are there.
    dates : str
        "day-month-year" or "month-day-year", for dates that may be read both ways.
    header : tuple of str
        Names of the columns of a file that has no header; "*" for further cells.
    """

    names: tuple[tuple[str, str], ...] = ()
    needed: tuple[str, ...] = ()
    ignore: tuple[str, ...] = ()
    dates: str = ""
    header: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        return self != Layout()

    def __add__(self, other: Layout) -> Layout:
        """Both; where they disagree, what the other says."""
        names = dict(self.names) | dict(other.names)
        return Layout(
            tuple(names.items()),
            self.needed + other.needed,
            self.ignore + other.ignore,
            other.dates or self.dates,
            other.header or self.header,
        )

    def called(self, headers: Sequence[str], path: str | PathLike[str]) -> dict[str, str]:
        """The name of each of a file's headers for which the layout has one.

        Raises
        ------
        InputError
            If a header that was said is missing, or two would have one name.

        Examples
        --------
        >>> layout_of("xrms=size_x_um, QUAD:BACT=Q525_kG").called(["QUAD:BACT", "xrms"], "a.csv")
        {'xrms': 'size_x_um', 'QUAD:BACT': 'Q525_kG'}
        """
        found: dict[str, str] = {}
        for said, name in self.names:
            matching = [h for h in headers if said in _spellings(h)]
            matching = matching or [h for h in headers if fnmatchcase(h, said)]
            if not matching and said in self.needed:
                raise InputError(f"no column '{said}'", nearest(said, list(headers)), path)
            if len(matching) > 1 or (matching and name in found.values()):
                expected = "one column for each name"
                both = " and ".join(matching or [said])
                raise InputError(f"{both} for {name}", expected, path, column=said)
            found |= dict.fromkeys(matching, name)
        return found


Columns = str | PathLike[str] | Mapping[str, str] | Layout | None
"""Layout of columns as a reader takes it; see `layout_of`."""


def _spellings(header: str) -> set[str]:
    """A header as it stands, and without the unit that stands below or beside it."""
    said = spelled(header)
    unit = unit_at_end(said)
    return {header, said, said.removesuffix(f"_{unit}") if unit else header}


def layout_of(columns: str | PathLike[str] | Mapping[str, str] | Layout | None) -> Layout:
    """Read what is said of columns.

    Parameters
    ----------
    columns : str, path, mapping or Layout
        ``"xrms=size_x_um, QUAD:BACT=Q525_kG"``, with quotes around an item that holds a comma; a
        layout file (``.toml``) or the name of one that comes with beamfit; ``day-month-year``; or
        several of these, separated by commas. A mapping of header to name says the same.

    Raises
    ------
    InputError
        If a layout cannot be read, or there is none of that name.

    Examples
    --------
    >>> layout_of({"xrms": "size_x_um"}) == layout_of("xrms = size_x_um")
    True
    """
    if columns is None or isinstance(columns, Layout):
        return columns or Layout()
    if isinstance(columns, Mapping):
        items = tuple((str(said), str(name)) for said, name in columns.items())
        return Layout(items, tuple(said for said, _ in items))
    if isinstance(columns, PathLike):
        return _read(columns)
    found = Layout()
    for item in filter(
        None, map(str.strip, next(csv.reader([columns], skipinitialspace=True), []))
    ):
        found += _item(item)
    return found


def _item(item: str) -> Layout:
    said, equals, name = (part.strip() for part in item.rpartition("="))
    if equals:
        if not said or not name:
            raise InputError(f"--columns '{item}'", f"HEADER=NAME such as {EXAMPLE}")
        return Layout(((said, name),), (said,))
    if item in ORDERS:
        return Layout(dates=item)
    shipped = {path.stem: path for path in SHIPPED.glob("*.toml")}
    if item in shipped:
        return _read(shipped[item])
    if not item.endswith(".toml"):
        known = nearest(item, sorted([*shipped, *ORDERS]))
        raise InputError(f"--columns {item}", f"HEADER=NAME such as {EXAMPLE}; or {known}")
    return _read(item)


def _read(path: str | PathLike[str]) -> Layout:
    section = read_toml(path, "a layout", FORMAT)
    said = section.values(KEYS)
    for header, name in said["columns"].items():
        if not (isinstance(name, str) and name.strip()):
            expected = 'the name that beamfit has for it, such as "size_x_um"'
            raise section.error(f"'{header}' = {name!r}", expected, "columns")
    names = tuple(said["columns"].items())
    return Layout(names, (), tuple(said["ignore"]), said["dates"], tuple(said["header"]))


def arranged(sheet: Sheet, layout: Layout) -> Sheet:
    """Give the columns of a sheet the names that a layout says.

    Parameters
    ----------
    sheet : Sheet
        The file.
    layout : Layout
        What its columns are; other columns of unknown names are then ignored.

    Returns
    -------
    Sheet
        Its messages name the columns as the file does.

    Examples
    --------
    >>> sheet = Sheet("a.csv", ("xrms", "n"), [["0.1"], ["7"]], [2], 1, ())
    >>> arranged(sheet, layout_of("xrms=size_x_mm")).names
    ('size_x_mm', 'n')
    """
    if not layout:
        return sheet
    present = [p for p in layout.ignore if any(fnmatchcase(name, p) for name in sheet.names)]
    sheet = sheet.without(present) if present else sheet
    called = layout.called(sheet.names, sheet.path)
    # A column that has such a name already is not the one that was meant.
    kept = [n for n in sheet.names if n in called or n not in called.values()]
    sheet = sheet.only(kept)
    names = tuple(called.get(name, name) for name in kept)
    said = {name: header for header, name in called.items()}
    return replace(sheet, names=names, called=said, order=layout.dates, arranged=True)


def proposal(unknown: Mapping[str, tuple[str | None, Any]]) -> str:
    """Write a layout for columns that nobody knows, for a person to complete.

    Parameters
    ----------
    unknown : mapping of str to (str or None, object)
        Header to the name that it may mean, and a cell.

    Examples
    --------
    >>> print(proposal({"xrms": ("size_x_um", 0.1), "n": (None, 7)}))
    format = "beamfit-layout-1"
    ignore = []  # headers to leave unread
    <BLANKLINE>
    [columns]  # "header" = "its name and unit in beamfit": docs/files.md has them
    "xrms" = "size_x_um"  # 0.1: is it that, and in this unit?
    # "n" = ""  # 7
    """
    lines = [f'format = "{FORMAT}"', "ignore = []  # headers to leave unread", ""]
    lines.append('[columns]  # "header" = "its name and unit in beamfit": docs/files.md has them')
    for header, (guess, cell) in unknown.items():
        quoted = header.replace("\\", "\\\\").replace('"', '\\"')
        asked = f"{cell}: is it that, and in this unit?" if guess else f"{cell}"
        lines.append(f'{"" if guess else "# "}"{quoted}" = "{guess or ""}"  # {asked}')
    return "\n".join(lines)
