"""Headers as people write them: units in brackets or in a row, capitals, a title above."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import lru_cache

from beamfit.emittance.scan import SETTINGS
from beamfit.errors import InputError

UNITS: dict[str, dict[str, float]] = {
    # quantity: unit at the end of a name -> factor to SI (a stored current: to mA)
    "length": {"um": 1e-6, "mm": 1e-3, "m": 1.0, "µm": 1e-6, "μm": 1e-6, "nm": 1e-9, "cm": 1e-2},
    "length or duration": {"mm": 1e-3, "m": 1.0, "ps": 299792458e-12},
    "time": {"s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "current": {"mA": 1.0, "A": 1e3, "uA": 1e-3, "µA": 1e-3, "μA": 1e-3, "nA": 1e-6},
    "voltage": {"kV": 1e3, "V": 1.0, "MV": 1e6},
    "pressure": {"Pa": 1.0, "mbar": 100.0, "Torr": 101325 / 760},
    "energy in MeV": {"MeV": 1.0},
}
UNITS["length or share"] = UNITS["length"] | {"%": 0.01}
# Units at the end of a header, as the columns' names have them.
KNOWN = {*SETTINGS, "µs", *(unit for units in UNITS.values() for unit in units)}
ENDS = tuple(f"_{unit}" for unit in KNOWN)
# Other ways to write one, those before others that they end with; in capitals or small letters no
# other unit is meant by these.
ALSO = {"T m^-1": "T_per_m", "T.m-1": "T_per_m", "tesla/m": "T_per_m", "1/m**2": "k1", "m-1": "k1l"}
ALSO |= {"ampere": "A", "amperes": "A", "T/m": "T_per_m", "1/m^2": "k1", "1/m2": "k1"}
ALSO |= {"1/m²": "k1", "m^-2": "k1", "m-2": "k1"}
ALSO |= {"m⁻²": "k1", "1/m": "k1l", "m^-1": "k1l", "mm rms": "mm", "um rms": "um", "micron": "um"}
ALSO |= {"microns": "um", "sec": "s", "hours": "h", "Amp": "A", "Amps": "A", "amp": "A"}
ALSO |= {"percent": "%"}
ALSO |= {u: "um" for u in ("UM", "Um")} | {u: "mm" for u in ("MM", "Mm")} | {"M": "m"}
ALSO |= {"KG": "kG", "kg": "kG", "T_PER_M": "T_per_m", "K1": "k1", "K1L": "k1l", "MEV": "MeV"}
ALSO |= {"mev": "MeV", "ma": "mA", "pa": "Pa", "PA": "Pa", "torr": "Torr", "TORR": "Torr"}
# A number and what stands behind it.
NUMBER = re.compile(r"([-+]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][-+]?\d+)?)\s*([^\W\d_].*|[%\[(].*)")
# Thousands with something between them that can be nothing else, and an exponent of Fortran.
GROUPED = re.compile(r"[-+]?\d{1,3}(?:(?:,\d{3})+\.\d*|(?:['’\xa0\u202f]\d{3})+(?:\.\d*)?)")
BETWEEN = dict.fromkeys(map(ord, ",'’\xa0\u202f"))
FORTRAN = re.compile(r"([\d.])[dD]([-+]?\d+)$")
# A name, and its unit in brackets or behind a stroke between blanks.
BRACKETS = re.compile(r"(.*?)[\s_]*(?:\[(.*?)\]|\((.*?)\)|\s/\s+(\S+))\s*")
APART = re.compile(r"([^/,]+?)(?:/|, ?| in )([^/,\s]+)")  # I/A, "I, A", I in A
# Lines that are looked through for the header below a title.
HEAD = 50
# How a line begins that is a comment: of Python, MATLAB, C, SDDS.
MARKS = ("#", "%", "//", "!")
# Of a TFS file.
TFS = ("@", "*", "$")


def known_unit(text: str) -> str | None:
    """A unit as the names of columns have it; None if the text is none."""
    text = text.strip().strip("[]()").strip()
    return text if text in KNOWN else ALSO.get(text)


def plain_unit(text: str) -> str:
    """A unit, or a name that ends with one, with u for either letter µ."""
    return re.sub("[µμ]", "u", text)


def named(name: str, unit: str) -> str:
    """The name of a column with its unit behind it, without blanks."""
    return re.sub(r"\s+", "_", f"{name}_{unit}")


def unit_behind(cell: str) -> str | None:
    """The unit behind the number of a cell, as the names of columns have it.

    Examples
    --------
    >>> unit_behind("627 µm"), unit_behind("1.5A"), unit_behind("1e-3"), unit_behind("OTR2")
    ('um', 'A', None, None)
    """
    found = None if cell[-1:].isdigit() else NUMBER.fullmatch(cell)
    return known_unit(plain_unit(found[2])) if found else None


@lru_cache(maxsize=4096)  # a year's files have the headers of the first
def spelled(header: str) -> str:
    """A header as ``name_unit``; as it stands where it has no unit.

    Examples
    --------
    >>> [spelled(h) for h in ("Q525 [T/m]", "size x (µm)", "Time / h", "SIZE_X_MM", "Q5 T m^-1")]
    ['Q525_T_per_m', 'size_x_µm', 'Time_h', 'SIZE_X_mm', 'Q5_T_per_m']
    >>> [spelled(h) for h in ("I/A", "size x, um", "size x in um", "Q1_T/m", "sr/dcct/A")]
    ['I_A', 'size_x_um', 'size_x_um', 'Q1_T_per_m', 'sr/dcct/A']
    """
    if (found := BRACKETS.fullmatch(header)) and found[1]:
        name, unit = found[1], next(part for part in found.groups()[1:] if part is not None)
        if (known := known_unit(unit)) is not None:
            return named(name.strip().removesuffix(f"_{known}"), known)
    if header.endswith(ENDS):
        return header
    for unit, known in ALSO.items():
        if re.search(rf"[\s_]{re.escape(unit)}$", header):
            return named(header[: -len(unit) - 1], known)
    if (found := APART.fullmatch(header)) and (known := known_unit(found[2])):
        return named(found[1], known)
    words = header.split()
    return "_".join(words) if len(words) > 1 and words[-1] in KNOWN else header


def unit_at_end(name: str) -> str | None:
    """The unit that a name as `spelled` ends with; None if it has none."""
    return max((u for u in KNOWN if name.endswith(f"_{u}")), key=len, default=None)


def is_header(cells: Sequence[str]) -> bool:
    """Tell a header from other rows: two or more names with units, and no number among them."""
    values = any(is_number(cell) or unit_behind(cell) for cell in cells)
    return not values and sum(map(_has_unit, cells)) > 1


def _has_unit(header: str) -> bool:
    return unit_at_end(spelled(header)) is not None


def units_below(cells: Sequence[str]) -> list[str | None] | None:
    """The units of a row of nothing else; None if it is no such row.

    Examples
    --------
    >>> units_below(["A", "[um]", ""]), units_below(["A", "5"])
    (['A', 'um', None], None)
    """
    units = [known_unit(cell) for cell in cells]
    plain = all(
        u is not None or cell in ("", "-", "1") for u, cell in zip(units, cells, strict=True)
    )
    return units if plain and any(units) else None


def with_units(names: Sequence[str], cells: Sequence[str]) -> list[str] | None:
    """Names with the units of a row of units below them; None if the row is none.

    Raises
    ------
    InputError
        If a name has another unit already.

    Examples
    --------
    >>> with_units(["Q2", "size_x", "shot"], ["A", "[um]", ""])
    ['Q2_A', 'size_x_um', 'shot']
    """
    if (units := units_below(cells)) is None:
        return None
    found = []
    for name, unit in zip(names, units, strict=True):
        own = unit_at_end(spelled(name))
        if own and unit and plain_unit(own) != plain_unit(unit):
            expected = "one unit, in the header or below it"
            raise InputError(f"'{unit}' below a header in {own}", expected, column=name)
        found.append(name if own or unit is None else named(name, unit))
    return found


def separator_of(header: str) -> str:
    """Separator of the columns below a header."""
    return next((s for s in ",;\t" if s in header), " ")


def _words(text: str) -> list[str]:
    separator = separator_of(text)
    return [word.strip(' "') for word in text.split(None if separator == " " else separator)]


def header_at(lines: Sequence[str]) -> int:
    """Which of some lines is the header: the first with two units, if only words stand above it.

    Where none has units it is the first line, or the first that rows of as many cells follow.

    Examples
    --------
    >>> header_at(["Scan", "by me, at noon", "Q2_A,size_x_um", "1,2"])
    2
    >>> header_at(["time,current", "1,2", "Q2_A,size_x_um"])
    0
    """
    first: int | None = None
    for i, text in enumerate(lines):
        if _is_aside(text):
            continue
        cells = _words(text)
        if is_header(cells):
            return i
        if first is None:
            first = i
        elif (
            any(map(is_number, cells))
            and is_value(cells[0])
            and len(cells) == len(_words(lines[first]))
        ):
            break
    if first is None or _has_rows(lines, first):
        return first or 0
    return next((i for i in range(first, len(lines)) if _has_rows(lines, i)), first)


def _is_aside(text: str) -> bool:
    """Tell a line that is blank, a comment, or of the head of a TFS file."""
    return not text.strip(",;\t ") or text.lstrip().startswith(MARKS + TFS)


def is_value(cell: str) -> bool:
    """Tell a cell that may be a number or a date."""
    return cell.lstrip("+-.")[:1].isdigit()


def _has_rows(lines: Sequence[str], i: int) -> bool:
    """Tell a line of words that rows of as many cells follow, below its units perhaps."""
    cells = _words(lines[i])
    rows = [_words(text) for text in lines[i + 1 :] if not _is_aside(text)][:3]
    if rows and units_below(rows[0]):
        del rows[0]
    alike = rows and all(len(row) == len(cells) and is_value(row[0]) for row in rows[:2])
    words = not _is_aside(lines[i]) and not any(map(is_value, cells))
    return bool(alike) and len(cells) > 1 and words


def uncommented(lines: Sequence[str]) -> list[str]:
    """Some lines, with the header that a mark of comments hides above the first values.

    Examples
    --------
    >>> uncommented(["# noon", "# time_s,beam_current_mA", "0,1"])
    ['# noon', 'time_s,beam_current_mA', '0,1']
    """
    found = list(lines)
    rows = (i for i, t in enumerate(found) if t.strip(" ,;\t") and not t.lstrip().startswith(MARKS))
    first = next(rows, 0)
    above = found[first - 1].strip() if first else ""
    if above.startswith(MARKS):
        said = bare(above)
        cells, words = _words(found[first]), _words(said)
        values = len(words) == len(cells) and all(map(is_value, cells))
        # Words between blanks may be a sentence.
        named = any(map(_has_unit, words)) or separator_of(said) != " "
        if values and named and not any(map(is_value, words)):
            found[first - 1] = said
    return found


def bare(comment: str) -> str:
    """A comment without its mark."""
    return comment.strip().lstrip("".join(MARKS) + " ").rstrip()


def number(cell: object) -> float:
    """The number of a cell, also as Fortran and spreadsheets write it where that means one thing.

    Raises
    ------
    ValueError
        If it is none: 5,125 could be 5125.

    Examples
    --------
    >>> [number(cell) for cell in ("5.125D-04", "−5", "5,125.0", "5'125")]
    [0.0005125, -5.0, 5125.0, 5125.0]
    """
    if isinstance(cell, str) and "_" in cell:  # which Python takes for nothing between digits
        raise ValueError("an underscore")
    try:
        return float(cell)
    except ValueError:
        text = cell.replace("−", "-")
        text = text.translate(BETWEEN) if GROUPED.fullmatch(text) else text
        return float(FORTRAN.sub(r"\1e\2", text))


def is_number(text: object) -> bool:
    """Tell a cell that is a number."""
    try:
        number(text)
    except ValueError:
        return False
    return True
