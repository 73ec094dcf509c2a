"""Headers as people write them: units in brackets or in a row, capitals, a title above."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import lru_cache

# Units at the end of a header, as the columns' names have them.
KNOWN = ("um", "mm", "m", "µm", "μm", "s", "min", "h", "d", "ms", "mA", "A", "uA", "µA", "μA")
KNOWN += ("kV", "V", "MV", "Pa", "mbar", "Torr", "MeV", "kG", "T_per_m", "k1", "k1l")
ENDS = tuple(f"_{unit}" for unit in KNOWN)
# Other ways to write one; in capitals or small letters no other unit is meant by these.
ALSO = {"T/m": "T_per_m", "1/m^2": "k1", "1/m2": "k1", "1/m²": "k1", "m^-2": "k1", "m-2": "k1"}
ALSO |= {"m⁻²": "k1", "1/m": "k1l", "m^-1": "k1l", "mm rms": "mm", "um rms": "um", "micron": "um"}
ALSO |= {"microns": "um", "sec": "s", "hours": "h", "Amp": "A", "Amps": "A", "amp": "A"}
ALSO |= {u: "um" for u in ("UM", "Um")} | {u: "mm" for u in ("MM", "Mm")} | {"M": "m"}
ALSO |= {"KG": "kG", "kg": "kG", "T_PER_M": "T_per_m", "K1": "k1", "K1L": "k1l", "MEV": "MeV"}
ALSO |= {"mev": "MeV", "ma": "mA", "pa": "Pa", "PA": "Pa", "torr": "Torr", "TORR": "Torr"}
# A name, and its unit in brackets or behind a stroke between blanks.
BRACKETS = re.compile(r"(.*?)[\s_]*(?:\[(.*?)\]|\((.*?)\)|\s/\s+(\S+))\s*")
# Lines that are looked through for the header below a title.
HEAD = 50


def _unit(text: str) -> str | None:
    """A unit as the names of columns have it; None if the text is none."""
    text = text.strip().strip("[]()").strip()
    return text if text in KNOWN else ALSO.get(text)


@lru_cache(maxsize=4096)  # a year's files have the headers of the first
def spelled(header: str) -> str:
    """A header as ``name_unit``; as it stands where it has no unit.

    Examples
    --------
    >>> [spelled(h) for h in ("Q525 [T/m]", "size x (µm)", "Time / h", "SIZE_X_MM", "screen")]
    ['Q525_T_per_m', 'size_x_µm', 'Time_h', 'SIZE_X_mm', 'screen']
    """
    if (found := BRACKETS.fullmatch(header)) and found[1]:
        name, unit = found[1], next(part for part in found.groups()[1:] if part is not None)
        if (known := _unit(unit)) is not None:
            return re.sub(r"\s+", "_", f"{name.strip()}_{known}")
    if header.endswith(ENDS):
        return header
    for unit, known in ALSO.items():
        if re.search(rf"[\s_]{re.escape(unit)}$", header):
            return re.sub(r"\s+", "_", header[: -len(unit) - 1]) + f"_{known}"
    words = header.split()
    return "_".join(words) if len(words) > 1 and words[-1] in KNOWN else header


def _has_unit(header: str) -> bool:
    return spelled(header).endswith(ENDS)


def with_units(names: Sequence[str], cells: Sequence[str]) -> list[str] | None:
    """Names with the units of a row of units below them; None if the row is none.

    Examples
    --------
    >>> with_units(["Q2", "size_x", "shot"], ["A", "[um]", ""])
    ['Q2_A', 'size_x_um', 'shot']
    """
    units = [_unit(cell) for cell in cells]
    plain = all(
        u is not None or cell in ("", "-", "1") for u, cell in zip(units, cells, strict=True)
    )
    if not plain or not any(units):
        return None
    return [
        name if u is None or _has_unit(name) else f"{name}_{u}"
        for name, u in zip(names, units, strict=True)
    ]


def separator_of(header: str) -> str:
    """What separates the columns of a file with this header."""
    return next((s for s in ",;\t" if s in header), " ")


def _words(text: str) -> list[str]:
    separator = separator_of(text)
    return [word.strip(' "') for word in text.split(None if separator == " " else separator)]


def header_at(lines: Sequence[str]) -> int:
    """Which of some lines is the header: the first with two units, if only words stand above it.

    Examples
    --------
    >>> header_at(["Scan", "by me, at noon", "Q2_A,size_x_um", "1,2"])
    2
    >>> header_at(["time,current", "1,2", "Q2_A,size_x_um"])
    0
    """
    first: int | None = None
    for i, text in enumerate(lines):
        if not text.strip(",;\t ") or text.lstrip()[:1] in ("#", "@", "*", "$"):
            continue
        cells = _words(text)
        numbers = any(map(is_number, cells))
        if not numbers and sum(map(_has_unit, cells)) > 1:
            return i
        if first is None:
            first = i
        elif numbers and len(cells) == len(_words(lines[first])):
            break
    return 0 if first is None else first


def uncommented(lines: Sequence[str]) -> list[str]:
    """Some lines, with the header that a # hides above the first numbers, as numpy.savetxt does.

    Examples
    --------
    >>> uncommented(["# noon", "# time_s,beam_current_mA", "0,1"])
    ['# noon', 'time_s,beam_current_mA', '0,1']
    """
    found = list(lines)
    first = next((i for i, text in enumerate(found) if text.strip(" ,;\t")[:1] not in ("", "#")), 0)
    above = found[first - 1].strip() if first else ""
    if above.startswith("#"):
        cells, words = _words(found[first]), _words(above.lstrip("# "))
        numbers = len(words) == len(cells) and all(map(is_number, cells))
        if numbers and any(map(_has_unit, words)) and not any(map(is_number, words)):
            found[first - 1] = above.lstrip("# ")
    return found


def is_number(text: object) -> bool:
    """Whether a cell is a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True
