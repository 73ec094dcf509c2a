"""Quadrupole scans from files: what their columns mean, the scan they make, and tables of knobs."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import replace
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from beamfit.emittance.scan import KNOB, POSSIBLE, USUAL, Profile, QuadScan, middle
from beamfit.emittance.shots import group_shots
from beamfit.errors import InputError, located, nearest, short
from beamfit.io.cells import is_number, number
from beamfit.io.columns import (
    SETTINGS,
    UNITS,
    Column,
    Columns,
    Sheet,
    columns_of,
    examples,
    ignored,
    known_unit,
    left_out,
    number_and_unit,
    spelled,
)
from beamfit.io.emittance_gui import is_emittance_gui, read_emittance_gui
from beamfit.io.files import name_of, text_lines
from beamfit.io.shots import IMAGE, of_images, of_profiles
from beamfit.io.table import read_columns
from beamfit.particles import ENERGY_KEYS
from beamfit.tuning.knobs import EmittanceTable

if TYPE_CHECKING:
    from pandas import DataFrame

# How the energy of a row may be given, without its unit, and what that is.
ENERGIES = {key.removesuffix("_MeV"): kind for key, kind in ENERGY_KEYS.items()}
QUANTITIES = {
    **dict.fromkeys(("size_x", "size_y"), "length"),
    **dict.fromkeys(("size_x_error", "size_y_error"), "length or share"),
    "resolution": "length",
    **dict.fromkeys(ENERGIES, "energy in MeV"),
    "energy_spread": "",
    "shot": "",
    "shots": "",
    "screen": "",
    "slice": "",
}
# How the keys of settings begin; what a scan cannot do without, and its keys.
SETTING = "setting "
SIZE = "a beam size column, such as size_x_um"
SEEN = "a magnet setting column, such as Q2_A, Q2_kG or Q2_k1, or a column screen"
NEEDED = {SIZE: "size_[xy]", SEEN: rf"{SETTING}.*|screen|r11_[xy]"}
CARRIED = re.compile(
    r"note_.*|comments?|charge[ _]?[\[(]?[np]C[\])]?|index|n[or]\.?|point|row|seq"
    r"|(date|(date[ _]?|elapsed[ _]?)?time([ _]?stamp)?|t)(_(h|m?s|min))?",
    re.IGNORECASE,
)
# Words for a width, and how many of it are one rms: a Gaussian's FWHM is sqrt(8 ln 2) rms.
FWHM = 1.0 / math.sqrt(8.0 * math.log(2.0))
WIDTHS = {"size": 1.0, "sigma": 1.0, "sig": 1.0, "s": 1.0, "rms": 1.0, "fwhm": FWHM}
ERRORS = {"error", "err", "std", "sd", "d", "delta", "uncertainty", "unc"}
PERCENT = "%"
PLANES = {"x": "x", "horizontal": "x", "hor": "x", "h": "x"}
PLANES |= {"y": "y", "vertical": "y", "vert": "y", "ver": "y", "v": "y"}
# Words that change nothing.
IDLE = {"beam", "spot", "fit", "gauss", "gaussian"}
# Several sigma as one width: 4sigma, D4Sigma (ISO 11146), 2 rms.
SEVERAL = re.compile(r"(?:^|(?<=_))d?([2-6])_?(?=(?:sigma|sig|rms)(?:_|$))", re.IGNORECASE)
# What control systems and people put around the name of a magnet; its unit says what it is set to.
ATTRIBUTE = re.compile(
    r"[ _:./](bact|bdes|bctrl|bcon|iact|ides|current|gradient|k1l?|kl|gl|bdl)$"
    r"|[ _:./](setpoint|readback|set|rbv?)$|^current[ _]",
    re.IGNORECASE,
)
# An error that is a deviation of shots by its name.
DEVIATION = re.compile(r"(?:^|[_\W])(std|sd|stdev)(?:[_\W]|$)", re.IGNORECASE)
SHOTS = {"n_shots": "shots", "nshots": "shots"}
# Elements of the matrix from where the beam is asked for to the row's screen, m and 1.
ELEMENT = re.compile(r"r(1[126])(?:_([xy]))?(?:_m)?|r(3[346])(?:_m)?", re.IGNORECASE)
OF_Y = {"33": "11", "34": "12", "36": "16"}
# What a coupled beam has besides two sizes.
COUPLED = re.compile(
    r"(?:(?:cov|corr?|sigma|sig|size|rms|rho|s)[ _]?)?[<(\[]?(?:xy|x_y)[>)\]]?"
    r"(?:_(?:err|error|std))?(?:[ _\[(].*)?|(?:tilt|theta|beam_tilt|tilt_angle)(?:[ _\[(].*)?",
    re.IGNORECASE,
)
# A plane and a width written as one word, as in xrms and sigmax.
ONE_WORD = re.compile(
    r"(x|y|hor|ver)(size|sigma|sig|rms|fwhm)|(size|sigma|sig|s|rms|fwhm)(x|y|hor|ver)"
)


def scan_columns(
    sheet: Sheet, knobs: Mapping[str, Column] = MappingProxyType({})
) -> dict[str, Column]:
    """Understand every header of a scan.

    Parameters
    ----------
    sheet : Sheet
        The file.
    knobs : mapping of str to Column, optional
        Settings that are no magnets of a line, as they are returned.

    Returns
    -------
    dict of str to Column
        By quantity: ``size_x``, ``size_x_error``, ..., ``setting Q2``, one of `ENERGIES`, and
        those of `QUANTITIES`.

    Raises
    ------
    InputError
        If a header is unknown or a quantity stands twice, a needed one is missing, there are no
        rows, or an error belongs to another width than the size.

    Examples
    --------
    >>> sheet = Sheet("a.csv", ("Q_T_per_m", "fwhm_x_mm"), [["1"], ["2.3548"]], [2], 1, ())
    >>> columns = scan_columns(sheet)
    >>> list(columns), round(2.3548 * columns["size_x"].factor, 7)
    (['setting Q', 'size_x'], 0.001)
    """
    current = any(spelled(name).lower().startswith("beam_current") for name in sheet.names)
    if current and not any(map(is_size, sheet.names)):
        expected = "a quadrupole scan; `beamfit lifetime` reads it"
        raise sheet.header_error("a record of beam current", expected)
    taken = {column.header for column in knobs.values()}
    rest = [name for name in sheet.names if name not in taken]
    if "plane" in map(str.lower, rest) and not sheet.arranged:
        expected = "a column for each plane, size_x_um and size_y_um, and a row for each setting"
        raise sheet.header_error("rows of two planes", expected)
    columns = dict(knobs) | columns_of(
        sheet.only(rest) if knobs else sheet, QUANTITIES, lambda header: _other(header, sheet)
    )
    for needed, keys in NEEDED.items():
        if not any(re.fullmatch(keys, key) for key in columns):
            raise sheet.header_error("columns " + ", ".join(sheet.names), needed)
    for plane in "xy":
        _check_error(sheet, columns, plane)
        _check_elements(sheet, columns, plane)
    given = [columns[e].header for e in ENERGIES if e in columns]
    if len(given) > 1:
        raise sheet.header_error("columns " + " and ".join(given), "one of them", given[1])
    if not len(sheet):
        raise sheet.header_error("a header and no rows", "at least three settings")
    return columns


def is_known(name: str, sheet: Sheet) -> bool:
    """Tell a header that means something in a scan from others."""
    try:
        return bool(
            columns_of(sheet.only([name]), QUANTITIES, lambda header: _other(header, sheet))
        )
    except InputError:
        return False


def _check_error(sheet: Sheet, columns: Mapping[str, Column], plane: str) -> None:
    """Check that an error column has its size column, and is of the same width."""
    size, error = columns.get(f"size_{plane}"), columns.get(f"size_{plane}_error")
    if error is None:
        return
    if size is None:
        found = f"{error.header} without sizes in {plane}"
        raise sheet.header_error(found, f"a column size_{plane}_um", error.header)
    if error.unit != PERCENT and not math.isclose(rms_of(size), rms_of(error)):
        word = "a FWHM" if FWHM in (rms_of(size), rms_of(error)) else "several sigma"
        found = f"an error beside '{size.header}' of which only one is {word}"
        raise sheet.header_error(found, "sizes and errors of one width", error.header)


def _check_elements(sheet: Sheet, columns: Mapping[str, Column], plane: str) -> None:
    """Check that a measured plane has both its matrix elements where the file has any."""
    given = [key for key in columns if re.match(r"r1[126]_", key)]
    for element in (f"r11_{plane}", f"r12_{plane}"):
        if given and f"size_{plane}" in columns and element not in columns:
            found = f"{columns[given[0]].header} and no {element}"
            raise sheet.header_error(found, f"r11 and r12 of every plane that has sizes, {element}")


def _other(header: str, sheet: Sheet) -> Column:
    """A size under another name, a magnet's setting, or a column that is carried along unread."""
    if CARRIED.fullmatch(header):
        return Column(header, header)
    if header.lower() in SHOTS:
        return Column(header, SHOTS[header.lower()])
    if (column := _size(header)) is not None:
        return column
    if (named := ELEMENT.fullmatch(header)) is not None:
        of_x, plane, of_y = named.groups()
        return Column(header, f"r{OF_Y[of_y]}_y" if of_y else f"r{of_x}_{plane or 'x'}")
    if COUPLED.fullmatch(header) is not None:
        found = "the correlation of x and y, or a tilt: coupled beams are not fitted"
        raise sheet.header_error(found, "two planes, which are fitted alone", header)
    unit = next((u for u in SETTINGS if header.endswith(f"_{u}")), "")
    name = header.removesuffix(f"_{unit}") if unit else ""
    while (bare := ATTRIBUTE.sub("", name)) != name:
        name = bare
    if name and not re.match(r"(size|sigma|rms|fwhm)_[xy](_|$)", name):
        return Column(header, f"{SETTING}{name}", unit)
    known = nearest(header, examples(QUANTITIES))
    expected = f"a magnet with _A, _kG, _T_per_m or _k1 at the end, {known}"
    raise sheet.header_error(_not_understood(header), expected, header)


def likely_scan_name(header: str, cell: object = "") -> str | None:
    """The name that a header without a unit may mean, in the unit of a cell or a usual one.

    Examples
    --------
    >>> [likely_scan_name(header) for header in ("xrms", "QUAD:525:BACT", "foo")]
    ['size_x_um', 'QUAD_525_kG', None]
    >>> likely_scan_name("xrms", "0.11 mm"), likely_scan_name("Q5 current", "1.5 A")
    ('size_x_mm', 'Q5_A')
    >>> likely_scan_name("err_x"), likely_scan_name("err x [mm]"), likely_scan_name("x")
    ('size_x_error_um', 'size_x_error_mm', None)
    """
    _, own = number_and_unit(str(cell)) or ("", None)
    size = _size(f"{header}_um") or _error_alone(f"{header}_um")
    if size is not None:
        return f"{size.key}_{own if own in UNITS['length'] else 'um'}"
    if (error := _error_alone(spelled(header))) is not None:
        return f"{error.key}_{error.unit}"
    bare, unit = ATTRIBUTE.sub("", header), own or "kG"
    if bare == header or unit not in SETTINGS:
        return None
    return f"{re.sub(r'[^A-Za-z0-9.]+', '_', bare)}_{unit}"


def _not_understood(header: str) -> str:
    """Reason why a header is unknown."""
    bracket = re.search(r"[\[(]([^\[\]()]*)[\])]\s*$", header)
    before, _, last = header.rpartition("_")
    if is_size(re.sub(r"[ _.#-]*[0-9]+$", "", header)) and header[-1].isdecimal():
        return "a size with a number behind it: shots stand in rows, each with its setting"
    if (error := _error_alone(header)) is not None:
        return f"an error without what it is of; {error.key}_{error.unit} is that of a size"
    if _size(f"{header}_um") is not None:
        return "a size without a unit"
    if header.lower().startswith("beam_current"):
        return "a beam current, on which no size depends"
    if bracket is not None:
        return f"unknown unit '{bracket[1]}'"
    if before and last in UNITS["length or share"]:
        return f"'{before}', which is no size of a plane that is known"
    return f"unknown unit '{last}'" if before else "a name without a unit"


def is_size(header: str) -> bool:
    """Tell a header that names a beam size or its error, with its unit or without."""
    said = spelled(header)
    return any(_size(one) is not None for one in (said, f"{said}_um"))


def _size(header: str) -> Column | None:
    """The column of a size or its error: a width, a plane, a unit, in any sensible order.

    ``sigma_x_mm``, ``x_rms_um``, ``rms_x_err_mm``, ``fwhm_y_um_std``, ``sigma_x_err_%``,
    ``D4Sigma_x_mm``; None if it is no size.
    """
    # A control system names the screen, its channel the size.
    plain = re.split("[:/]", header)[-1].replace("σ", "sigma").replace("Δ", "d_")
    several = SEVERAL.search(plain)
    words = SEVERAL.sub("", plain).split("_")
    units = UNITS["length or share"]
    place = next((i for i in (-1, -2) if len(words) > 1 and words[i] in units), None)
    if place is None:
        return None
    unit = words.pop(place)
    said = []
    for word in filter(None, map(str.lower, words)):
        both = ONE_WORD.fullmatch(word)
        said += [part for part in both.groups() if part] if both else [word]
    planes, widths, errors = ([w for w in said if w in of] for of in (PLANES, WIDTHS, ERRORS))
    known = len(planes) + len(widths) + len(errors) == len(said) - sum(map(said.count, IDLE))
    # "rms_size", "size_fwhm" are one width said in full; a sigma of a size may be its error.
    one = len(widths) == 1 or sorted(widths) in (["rms", "size"], ["fwhm", "size"])
    if not (known and one and len(planes) == 1 and len(errors) <= 1):
        return None
    if unit == PERCENT and not errors:
        return None
    rms = FWHM if "fwhm" in widths else 1.0 / int(several[1]) if several else 1.0
    key = f"size_{PLANES[planes[0]]}" + ("_error" if errors else "")
    return Column(header, key, unit, units[unit] * (rms if unit != PERCENT else 1.0))


def _error_alone(header: str) -> Column | None:
    """The error of a size whose header says the plane and not that it is a size's: ``err_x_um``."""
    error = _size(f"size_{header}")
    return error if error is not None and error.key.endswith("_error") else None


def rms_of(column: Column) -> float:
    """Factor from a column's width to rms sizes."""
    return column.factor / UNITS["length"][column.unit]


def is_scatter(columns: Mapping[str, Column], plane: str) -> bool:
    """Tell an error that is the deviation of the shots from that of their mean.

    Examples
    --------
    >>> of = {"shots": Column("n", "shots"), "size_x_error": Column("x_rms_std_um", "", "um")}
    >>> is_scatter(of, "x"), is_scatter(of, "y")
    (True, False)
    """
    error = columns.get(f"size_{plane}_error")
    return "shots" in columns and error is not None and bool(DEVIATION.search(error.header))


def column_notes(columns: Mapping[str, Column]) -> list[str]:
    """Say which sizes were made of others, in sentences."""
    made: dict[float, list[str]] = {}
    for column in (columns[key] for key in ("size_x", "size_y") if key in columns):
        made.setdefault(round(1 / rms_of(column), 4), []).append(column.header)
    return [
        f"Sizes are FWHM/2.3548 of {' and '.join(headers)}, which is their rms for a Gaussian "
        "profile only."
        if share == round(1 / FWHM, 4)
        else f"Sizes are a share of 1/{share:g} of {' and '.join(headers)}."
        for share, headers in made.items()
        if share != 1.0
    ] + [
        f"'{columns[f'size_{p}_error'].header}' beside '{columns['shots'].header}' is taken for "
        "the deviation of the shots: the errors are it over the root of their number."
        for p in "xy"
        if is_scatter(columns, p)
    ]


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
    line = next((number for number, one in lines if text in one), None)
    raise InputError(
        f"the comment '{short(text, 80)}'",
        f"one that agrees with the header: {mend} if the comment is right, else delete the comment",
        sheet.path,
        line,
        sizes[0].header,
    )


# More rows than any scan: such a file is a log, and is refused before it fills the memory.
MOST_ROWS = 100_000
# A size this many times the usual one of its column, or less than it by this factor, and larger or
# smaller than most beams, has slipped.
SLIPPED = 100.0
# Relative: nobody has measured a beam's size better, while mm and µm are 1e-3 apart.
SMALLEST = 1e-4
# Of the matrix of a plane, where rows have their own.
ELEMENTS = ("r11", "r12", "r16")
# Further quantities: from (open), to, and how to say it.
RANGES = {
    "energy": (0.511, 1e7, "a total energy between 0.511 MeV and 10 TeV; is it in GeV or eV?"),
    "kinetic_energy": (0.0, 1e7, "a kinetic energy between 0 and 10 TeV; is it in GeV or eV?"),
    "momentum": (0.0, 1e7, "a momentum (p c) between 0 and 10 TeV; is it in GeV or eV?"),
    "resolution": (-1e-300, USUAL[1], "a resolution between 0 and 20 mm"),
    "energy_spread": (-1e-300, 0.2, "a relative spread between 0 and 0.2; is it in %?"),
    "shots": (0.5, 1e9, "how many shots the row is the mean of, and its errors are taken from"),
}


def read_quad_scan(
    path: str | PathLike[str] | DataFrame,
    *,
    columns: Columns = None,
    ignore: Iterable[str] = (),
    skip_bad: bool = False,
) -> QuadScan:
    """Read a quadrupole scan.

    Parameters
    ----------
    path : str, path or pandas.DataFrame
        A CSV file whose header carries the units, a frame with such columns, or an HDF5 file
        (``.h5``, ``.hdf5``) with one dataset a column under the same names; or a file of
        emittance_gui (``.mat``), of which these are the RMS sizes (see
        `beamfit.io.emittance_gui.read_emittance_gui`).
    columns : str, path, mapping or Layout, optional
        What columns are whose headers do not say it: ``{"xrms": "size_x_um"}``, or as
        `beamfit.io.columns.layout_of` reads it. Other columns of unknown names are ignored.
    ignore : iterable of str
        Columns to leave unread; * and ? stand for any letters.
    skip_bad : bool
        Leave out rows with something wrong in them; ``notes`` counts and names them.

    Returns
    -------
    QuadScan
        Sizes in m. Repeated shots of a setting are averaged; their scatter becomes the error.

    Raises
    ------
    InputError
        If the file cannot be used, naming file, line and column.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> file = pathlib.Path(tempfile.mkdtemp()) / "scan.csv"
    >>> _ = file.write_text("Q2_A,size_x_um\\n0,200\\n1,120\\n2,180\\n3,lost\\n")
    >>> scan = read_quad_scan(file, skip_bad=True)
    >>> scan.rows("x").size.round(9).tolist()
    [0.0002, 0.00012, 0.00018]
    >>> scan.notes
    ("1 of 4 rows was left out: line 5, column 'size_x_um', 'lost'.",)
    """
    if str(path).lower().endswith(".mat") and is_emittance_gui(path):
        if columns is not None:
            raise InputError("--columns for a file of emittance_gui", "none: it says them", path)
        return read_emittance_gui(path).scan()
    sheet = read_columns(path, "Q2_A,size_x_um", columns, ignore, skip_bad, MOST_ROWS)
    return scan_of_sheet(sheet)


def scan_of_sheet(sheet: Sheet, knobs: Mapping[str, Column] = MappingProxyType({})) -> QuadScan:
    """Understand the columns of a sheet as a scan; knobs of the machine are settings, too."""
    profiles: tuple[Profile, ...] = ()
    if IMAGE in sheet.names:
        sheet = of_images(replace(sheet, skip=""))
    if {"counts_x", "counts_y"} & set(sheet.names):
        sheet, profiles = of_profiles(replace(sheet, skip=""))
    columns = scan_columns(sheet, knobs)
    sheet = _without_dark(sheet, columns) if "shot" in columns else sheet
    if sheet.skip_bad:
        sheet = sheet.good(lambda rows: _values(rows, columns))
        usual = _usual(_values(sheet, columns))
        sheet = sheet.good(
            lambda rows: _check_slipped(rows, columns, _values(rows, columns), usual)
        )
    values = _values(sheet, columns)
    odd = _check_sizes(sheet, columns, values)
    notes = [*column_notes(columns), *comment_notes(sheet, columns), *odd]
    notes += [*ignored(sheet, columns), *left_out(sheet)]
    with located(sheet.path):
        scan = _scan(sheet, columns, values, notes=tuple(notes), profiles=profiles)
        return group_shots(scan, marked="shot" in columns)


def _without_dark(sheet: Sheet, columns: Mapping[str, Column]) -> Sheet:
    """Blank the sizes of shots that show no beam, for which programs write 0."""
    cells, count = dict(zip(sheet.names, sheet.cells, strict=True)), 0
    for plane in (p for p in "xy" if f"size_{p}" in columns):
        sizes = cells[columns[f"size_{plane}"].header]
        dark = [is_number(cell) and number(cell) == 0.0 for cell in sizes]
        count += sum(dark)
        for key in {f"size_{plane}", f"size_{plane}_error"} & set(columns):
            header = columns[key].header
            cells[header] = ["" if d else c for d, c in zip(dark, cells[header], strict=True)]
    shown = "shows no beam and is" if count == 1 else "show no beam and are"
    note = f"{count} shot{'s' * (count > 1)} of size 0 {shown} left out."
    notes = (*sheet.notes, note) if count else sheet.notes
    return replace(sheet, cells=list(cells.values()), notes=notes)


def _scan(
    sheet: Sheet, columns: Mapping[str, Column], values: Mapping[str, np.ndarray], **further: Any
) -> QuadScan:
    """The scan of these numbers, one row a line of the file."""
    magnets = {k.removeprefix(SETTING): c for k, c in columns.items() if k.startswith(SETTING)}
    energies = [(values[key], kind) for key, kind in ENERGIES.items() if key in values]
    energy, kind = energies[0] if energies else (None, "total")
    headers = {key: sheet.called.get(c.header, c.header) for key, c in columns.items()}
    words = {
        key: tuple(map(str, sheet[columns[key].header]))
        for key in ("screen", "slice")
        if key in columns
    }
    planes = [p for p in "xy" if f"size_{p}" in values]
    error = {p: values[f"size_{p}_error"] for p in planes if f"size_{p}_error" in values}
    own = {
        p: np.stack([values.get(f"{name}_{p}", np.zeros(len(sheet))) for name in ELEMENTS], axis=-1)
        for p in planes
        if f"r11_{p}" in values
    }
    return QuadScan(
        settings={name: values[c.key] for name, c in magnets.items()},
        units={name: c.unit for name, c in magnets.items()},
        size={p: values[f"size_{p}"] for p in planes},
        error=error,
        energy=energy,
        energy_kind=kind,
        **{key: values.get(key) for key in ("resolution", "energy_spread", "shots")},
        **words,
        transfer=own or None,
        error_source="the file" if error else "none given",
        name=Path(name_of(sheet.path)).stem,
        path=sheet.path,
        sha256=sheet.sha256,
        provenance=sheet.comments,
        columns={name: headers[c.key] for name, c in magnets.items()}
        | headers
        | {header: header for header in headers.values()},
        **further,
    )


def _values(sheet: Sheet, columns: Mapping[str, Column]) -> dict[str, np.ndarray]:
    """The numbers of a scan in SI by quantity; what is wrong with a row by itself is refused."""
    sizes = [key for p in "xy" for key in (f"size_{p}", f"size_{p}_error") if key in columns]
    others = [key for key in columns if key in RANGES or key.startswith((SETTING, "r1"))]
    values = {key: _checked(sheet, columns[key], key in sizes) for key in sizes + others}
    for plane in "xy":
        size, error = f"size_{plane}", f"size_{plane}_error"
        if error not in columns:
            continue
        if columns[error].unit == PERCENT:
            values[error] = values[error] * values[size]
        if is_scatter(columns, plane):
            values[error] = values[error] / np.sqrt(values["shots"])
        if (missing := np.isnan(values[error]) & ~np.isnan(values[size])).any():
            expected = "an error for each size, or none at all"
            sheet.refuse(columns[error].header, missing, expected, "an empty cell")
        # It was measured, or it was not: a size that says NaN has no error.
        absent = np.isnan(values[size]) & ~np.isnan(values[error])
        for row in [int(row) for row in np.flatnonzero(absent)]:
            if (cell := sheet[columns[size].header][row]) != "":
                expected = "a finite number, or no error beside it"
                raise sheet.error(f"'{cell}'", expected, row, columns[size].header)
    if "screen" in columns and "" in (names := list(sheet[columns["screen"].header])):
        expected = "the name of a screen of the lattice"
        raise sheet.error("an empty cell", expected, names.index(""), columns["screen"].header)
    return values


def _checked(sheet: Sheet, column: Column, length: bool) -> np.ndarray:
    """A quantity within what it can be; lengths in m, NaN where the cell is blank."""
    values = sheet.values(column, blank=length)
    what = f"a positive {'error' if column.key.endswith('error') else 'beam size'} in {column.unit}"
    usual = (0.0, np.inf, what) if length else (-np.inf, np.inf, "")
    low, high, expected = RANGES.get(column.key, usual)
    if (wrong := (values <= low) | (values > high)).any():
        if column.key.endswith("error") and not np.any(values > 0):
            expected += f"; --ignore '{column.header}' leaves them unread: the noise is inferred"
            raise sheet.header_error("no error above zero", expected, column.header)
        sheet.refuse(column.header, wrong, expected)
    return values


def _usual(values: Mapping[str, np.ndarray]) -> dict[str, float]:
    """The median size of each plane that has one, m."""
    sizes = {p: values[f"size_{p}"] for p in "xy" if f"size_{p}" in values}
    return {p: middle(v) for p, v in sizes.items() if not np.isnan(v).all()}


def _check_slipped(
    sheet: Sheet,
    columns: Mapping[str, Column],
    values: Mapping[str, np.ndarray],
    usual: Mapping[str, float],
) -> None:
    """Refuse a size far from the others of its column, and larger or smaller than most beams."""
    for plane, usually in usual.items():
        column, size = columns[f"size_{plane}"], values[f"size_{plane}"]
        most, least = max(USUAL[1], SLIPPED * usually), min(USUAL[0], usually / SLIPPED)
        if (slipped := (size > most) | (size < least)).any():
            around = f"{usually / column.factor:.3g}"
            found = f"{{:g}} {column.unit}, where the others are around {around}"
            written = size / column.factor
            sheet.refuse(column.header, slipped, "sizes in one unit", found, written)


def _check_sizes(
    sheet: Sheet, columns: Mapping[str, Column], values: Mapping[str, np.ndarray]
) -> list[str]:
    """Check that sizes and errors are in a unit that can be meant; ask about tiny errors."""
    usual, notes = _usual(values), []
    for plane in (p for p in "xy" if f"size_{p}" in columns):
        column, error = columns[f"size_{plane}"], columns.get(f"size_{plane}_error")
        if plane not in usual:
            expected = f"sizes in {column.unit}"
            raise sheet.header_error("no number at all", expected, column.header)
        if not POSSIBLE[0] <= usual[plane] <= POSSIBLE[1]:
            raise _implausible(sheet, column, usual[plane] / column.factor)
        if error is None:
            continue
        with np.errstate(over="ignore"):
            ratio = middle(values[f"size_{plane}_error"] / values[f"size_{plane}"])
        if not 1e-6 < ratio < 1.0:
            found = f"errors that are {ratio:g} of the sizes"
            raise sheet.header_error(found, "errors in the unit of the header", error.header)
        if ratio < SMALLEST:
            said = f"Errors in {plane} are {ratio:.1g} of the sizes"
            notes.append(f"{said}: are both in the units of their headers?")
    _check_slipped(sheet, columns, values, usual)
    return notes


def _implausible(sheet: Sheet, column: Column, written: float) -> InputError:
    """Ask for the unit in which numbers around this one would be a beam's sizes."""
    lengths = UNITS["length"]
    likely = min(("um", "mm", "m"), key=lambda u: abs(np.log(written * lengths[u] / 2e-4)))
    found = f"sizes around {written:g} {column.unit}, implausible for a beam"
    expected = f"sizes between {1e9 * POSSIBLE[0]:g} nm and {1e3 * POSSIBLE[1]:g} mm; if these are "
    expected += f"{likely}, rename the column {column.key}_{likely}"
    return sheet.header_error(found, expected, column.header)


EMITTANCE = re.compile(r"(normalized_)?emittance_[xy]")


def read_tuning_scan(
    path: str | PathLike[str] | DataFrame,
    knobs: Iterable[str],
    *,
    columns: Columns = None,
    ignore: Iterable[str] = (),
    skip_bad: bool = False,
) -> QuadScan | EmittanceTable:
    """Read a table of beam sizes with columns of quadrupoles and of knobs, or of emittances.

    Parameters
    ----------
    path : str, path or pandas.DataFrame
        As for `beamfit.read_quad_scan`.
    knobs : iterable of str
        Knobs by the header of their column, with its unit or without: "SOL_A", "SOL",
        "gun_phase_deg".
    columns, ignore, skip_bad
        As for `beamfit.read_quad_scan`; other columns of unknown names are ignored.

    Returns
    -------
    QuadScan or EmittanceTable
        The latter if there are columns such as emittance_x_um or normalized_emittance_x_um, with
        emittance_x_error_um beside. Knobs stand among the settings under the names given; of a
        scan in the unit "knob" where theirs is none of a magnet, and repeated shots of a row are
        averaged.

    Raises
    ------
    InputError
        If the file cannot be used or has no column of a knob, naming file, line and column.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> file = pathlib.Path(tempfile.mkdtemp()) / "tune.csv"
    >>> _ = file.write_text("Q2_A,phase_deg,size_x_um\\n0,5,200\\n1,6,120\\n2,5,180\\n")
    >>> scan = read_tuning_scan(file, ["phase_deg"])
    >>> scan.settings["phase_deg"].tolist(), scan.units["phase_deg"]
    ([5.0, 6.0, 5.0], 'knob')
    """
    sheet = read_columns(path, "Q2_A,knob,size_x_um", columns, ignore, skip_bad, MOST_ROWS)
    names = {knob: _header(knob, sheet) for knob in dict.fromkeys(knobs)}
    called = {knob: sheet.called.get(name, name) for knob, name in names.items()}
    if any(EMITTANCE.match(name) for name in sheet.names):
        return _emittances(replace(sheet, skip=""), names, called)
    units = {knob: _unit(knob, header) for knob, header in called.items()}
    knobs = {f"setting {k}": Column(n, f"setting {k}", units[k]) for k, n in names.items()}
    scan = scan_of_sheet(replace(sheet, arranged=True), knobs)
    return replace(scan, columns=scan.columns | called)


def _emittances(sheet: Sheet, names: Mapping[str, str], called: dict[str, str]) -> EmittanceTable:
    """Finished emittances at settings of knobs; other columns are ignored."""
    known = [n for n in sheet.names if EMITTANCE.match(n)]
    kinds = {n.startswith("normalized_") for n in known}
    if len(kinds) > 1:
        expected = "columns of one of them"
        raise sheet.header_error("emittances, and normalized emittances", expected, known[-1])
    word = "normalized_emittance_" if kinds.pop() else "emittance_"
    quantities = {f"{word}{end}": "length" for end in ("x", "y", "x_error", "y_error")}
    found = columns_of(sheet.only(known), quantities)
    values = {k.removeprefix(word): sheet.values(c, blank=True) for k, c in found.items()}
    for column, each in zip(found.values(), values.values(), strict=True):
        sheet.refuse(column.header, each <= 0.0, "a positive number")
    return EmittanceTable(
        settings={knob: sheet.numbers(name) for knob, name in names.items()},
        emittance={p: v for p, v in values.items() if p in "xy"},
        error={k[0]: v for k, v in values.items() if k not in "xy"},
        normalized=word.startswith("normalized_"),
        name=Path(name_of(sheet.path)).stem,
        path=sheet.path,
        sha256=sheet.sha256,
        provenance=sheet.comments,
        notes=left_out(sheet),
        columns=called | {k.replace(word, "emittance "): c.header for k, c in found.items()},
    )


def _header(knob: str, sheet: Sheet) -> str:
    """The header of a knob: its name, or its name with a unit."""
    if knob in sheet.names:
        return knob
    found = [name for name in sheet.names if spelled(name).rpartition("_")[0] == knob]
    if not found:
        raise sheet.no_column(knob)
    if len(found) > 1:
        expected = "its header as it stands: " + " or ".join(found)
        raise sheet.header_error(f"a knob '{knob}' of several columns", expected)
    return found[0]


def _unit(knob: str, header: str) -> str:
    """The unit of a knob, where its name leaves it out and it is one of a magnet."""
    unit = spelled(header).removeprefix(f"{knob}_")
    return unit if unit in SETTINGS else KNOB
