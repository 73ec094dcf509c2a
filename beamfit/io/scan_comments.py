"""What the comments of a scan say of its sizes, held against the header."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping

from beamfit.errors import InputError, short
from beamfit.io.files import text_lines
from beamfit.io.headers import bare, known_unit
from beamfit.io.scan_columns import FWHM, rms_of
from beamfit.io.sheet import UNITS, Column, Sheet

# What may be a width other than the rms, or no length; what a comment may be asked about.
FULL = r"fwhm|full[ -]widths?"
WIDER = re.compile(rf"{FULL}|\b[2-6][ -]?(sigma|σ|rms)|\b1/e|pixel|\bpx\b", re.IGNORECASE)
# "all sizes are given in mm", "FWHM beam widths": a statement of what every size is.
BEFORE = r"(?:^|[.;,:])(?:\s|\b(?:all|beam|both|rms|spot|the|transverse)\b)*\b(?:sizes?|widths?)\b"
BETWEEN = r"(?:[\s:=()\[\]]|\b(?:all|and|are|as|given|in|is|measured|rms|the|units?|x|y)\b)*"
STATED = re.compile(
    rf"{BEFORE}{BETWEEN}(?:(?P<full>(?:{FULL})\b)|(?P<several>[2-6])[ -]?(?:sigma|σ|rms)"
    r"|(?P<rms>rms|1[ -]?sigma)\b|(?P<unit>pixels?|px|mm|microns?|[uµμn]m|cm)\b)"
    rf"|^\W*(?P<full_first>(?:{FULL}))(?: beam| spot)? (?:sizes?|widths?)\W*$",
    re.IGNORECASE,
)
# "units: A, mm" is no statement of the sizes alone.
LISTED = re.compile(r"\bunits?\b.*?\b(mm|microns?|[uµμ]m|cm)\b", re.IGNORECASE)
# What makes a comment tell of another matter, or of what was done already.
UNSURE = re.compile(
    r"\b(not|no|never|from|convert\w*|divided|before|was|were|once|if|or)\b|[/*]|\?", re.IGNORECASE
)


def comment_notes(sheet: Sheet, columns: Mapping[str, Column]) -> list[str]:
    """Ask about a comment that speaks of another width than the headers of rms sizes.

    Parameters
    ----------
    sheet : Sheet
        The file.
    columns : mapping of str to Column
        What its headers mean, as `scan_columns` understands them.

    Returns
    -------
    list of str
        Sentences.

    Raises
    ------
    InputError
        If a comment says what the sizes are, and the header says something else: either may be
        wrong, by 2.4 or by 1000.

    Examples
    --------
    >>> sheet = Sheet("a.csv", ("size_x_um",), [["9"]], [3], 2, ("gauss fit, FWHM 4 px",))
    >>> size = Column("size_x_um", "size_x", "um", 1e-6)
    >>> comment_notes(sheet, {"size_x": size})[0][:47]
    "A comment says 'gauss fit, FWHM 4 px', and the "
    """
    sizes = [columns[key] for key in ("size_x", "size_y") if key in columns]
    for text in sheet.comments:
        if not UNSURE.search(text) and (stated := STATED.search(text)):
            _check(sheet, sizes, text, stated)
    for text in sheet.comments:
        told = LISTED.search(text)
        if told and all(_factor(told[1]) != UNITS["length"][column.unit] for column in sizes):
            return [
                f"A comment says '{short(text, 80)}', and the sizes are taken in {sizes[0].unit}, "
                f"as the header {sizes[0].header} says: is that so?"
            ]
    said = next((text for text in sheet.comments if WIDER.search(text)), None)
    if said is None or any(rms_of(column) != 1.0 for column in sizes):
        return []
    named = " and ".join(column.header for column in sizes)
    return [
        f"A comment says '{short(said, 80)}', and the sizes are taken for rms: if they are not, "
        f"say so in the header of {named}, such as fwhm_x_{sizes[0].unit}."
    ]


def _factor(unit: str) -> float | None:
    return UNITS["length"].get(known_unit(unit) or "")


def _check(sheet: Sheet, sizes: list[Column], text: str, stated: re.Match[str]) -> None:
    """Refuse a statement that is true of none of the sizes."""
    unit, several = stated["unit"], stated["several"]
    if unit:
        known = known_unit(unit)
        true = [c for c in sizes if _factor(unit) == UNITS["length"][c.unit]]
        mend = f"rename the column {sizes[0].key}_{known}" if known else "give lengths, in um"
    else:
        share = 1.0 if stated["rms"] else 1 / int(several) if several else FWHM
        true = [c for c in sizes if math.isclose(rms_of(c), share)]
        word = "size" if stated["rms"] else f"{several}sigma" if several else "fwhm"
        mend = f"rename the column {word}_{sizes[0].key[-1]}_{sizes[0].unit}"
    if true:
        return
    lines = enumerate([] if sheet.lines is None else text_lines(sheet.path), start=1)
    line = next((number for number, one in lines if text in bare(one)), None)
    raise InputError(
        f"the comment '{short(text, 80)}'",
        f"one that agrees with the header: {mend} if the comment is right, else delete the comment",
        sheet.path,
        line,
        sizes[0].header,
    )
