"""Read quadrupole scans and tuning tables: header meanings, checked values, the `QuadScan`."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import partial
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
    example_headers,
    ignored_note,
    known_unit,
    number_and_unit,
    sheet_notes,
    standard_header,
)
from beamfit.io.emittance_gui import is_emittance_gui, read_emittance_gui
from beamfit.io.files import name_of, text_lines
from beamfit.io.shots import IMAGE, profiles_from_images, sizes_from_profiles
from beamfit.io.table import read_columns
from beamfit.particles import ENERGY_KEYS
from beamfit.tuning.knobs import EmittanceTable

if TYPE_CHECKING:
    from pandas import DataFrame

# Energy columns without their unit, and the kind of energy: total, kinetic or momentum.
ENERGIES = {key.removesuffix("_MeV"): kind for key, kind in ENERGY_KEYS.items()}
# Columns of a scan without their unit, and the kind of unit (a key of `UNITS`).
QUANTITIES = {
    **dict.fromkeys(("size_x", "size_y"), "length"),
    **dict.fromkeys(("size_x_error", "size_y_error"), "length or share"),
    "resolution": "length",
    **dict.fromkeys(ENERGIES, "energy"),
    "energy_spread": "",
    "shot": "",
    "shots": "",
    "screen": "",
    "slice": "",
}
# Prefix of the keys of magnet settings.
SETTING = "setting "
# Columns that a scan needs: name for the message, pattern of the keys, one of which must be there.
SIZE_COLUMN = "a beam size column, such as size_x_um"
SETTING_COLUMN = "a magnet setting column, such as Q2_A, Q2_kG or Q2_k1, or a column screen"
REQUIRED_COLUMNS = {SIZE_COLUMN: "size_[xy]", SETTING_COLUMN: "setting .*|screen|r11_[xy]"}
# Headers of columns that are accepted but not used: notes, charge, row numbers, times.
UNUSED_HEADER = re.compile(
    r"note_.*|comments?|charge[ _]?[\[(]?[np]C[\])]?|index|n[or]\.?|point|row|seq"
    r"|(date|(date[ _]?|elapsed[ _]?)?time([ _]?stamp)?|t)(_(h|m?s|min))?",
    re.IGNORECASE,
)
# rms size of a Gaussian of unit FWHM, 1 / sqrt(8 ln 2).
FWHM = 1.0 / math.sqrt(8.0 * math.log(2.0))
# Words of a size header: the kind of width with its rms factor, an error, a plane, and fillers.
WIDTH_WORDS = {"size": 1.0, "sigma": 1.0, "sig": 1.0, "s": 1.0, "rms": 1.0, "fwhm": FWHM}
ERROR_WORDS = {"error", "err", "std", "sd", "d", "delta", "uncertainty", "unc"}
PERCENT = "%"
PLANE_WORDS = {"x": "x", "horizontal": "x", "hor": "x", "h": "x"}
PLANE_WORDS |= {"y": "y", "vertical": "y", "vert": "y", "ver": "y", "v": "y"}
FILLER_WORDS = {"beam", "spot", "fit", "gauss", "gaussian"}
SIZE_WORDS = {*WIDTH_WORDS, *ERROR_WORDS, *PLANE_WORDS, *FILLER_WORDS}
# A width of several sigma: 4sigma, D4Sigma (ISO 11146), 2 rms.
MULTIPLE_SIGMA = re.compile(r"(?:^|(?<=_))d?([2-6])_?(?=(?:sigma|sig|rms)(?:_|$))", re.IGNORECASE)
# Affixes that control systems add to a magnet's name: QUAD:525:BACT, Q5 current, Q5_rbv.
DEVICE_ATTRIBUTE = re.compile(
    r"[ _:./](bact|bdes|bctrl|bcon|iact|ides|current|gradient|k1l?|kl|gl|bdl)$"
    r"|[ _:./](setpoint|readback|set|rbv?)$|^current[ _]",
    re.IGNORECASE,
)
# Words in an error's header that mean the standard deviation of the shots.
SCATTER_WORD = re.compile(r"(?:^|[_\W])(std|sd|stdev)(?:[_\W]|$)", re.IGNORECASE)
# Columns of transfer matrix elements, from the reference point to the row's screen: R11, R12 in m,
# R16 in m; for y also as R33, R34, R36.
MATRIX_HEADER = re.compile(r"r(1[126])(?:_([xy]))?(?:_m)?|r(3[346])(?:_m)?", re.IGNORECASE)
Y_ELEMENTS = {"33": "11", "34": "12", "36": "16"}
# Headers of x-y correlations and tilt angles: coupled beams are not fitted.
COUPLING_HEADER = re.compile(
    r"(?:(?:cov|corr?|sigma|sig|size|rms|rho|s)[ _]?)?[<(\[]?(?:xy|x_y)[>)\]]?"
    r"(?:_(?:err|error|std))?(?:[ _\[(].*)?|(?:tilt|theta|beam_tilt|tilt_angle)(?:[ _\[(].*)?",
    re.IGNORECASE,
)
# Plane and width in one word: xrms, sigmax.
JOINED_WORD = re.compile(
    r"(x|y|hor|ver)(size|sigma|sig|rms|fwhm)|(size|sigma|sig|s|rms|fwhm)(x|y|hor|ver)"
)


def scan_columns(
    sheet: Sheet, knobs: Mapping[str, Column] = MappingProxyType({})
) -> dict[str, Column]:
    """Map every header of a scan to a quantity and unit.

    Parameters
    ----------
    sheet : Sheet
        The file.
    knobs : mapping of str to Column, optional
        Columns of settings that are not magnets of the line, by their key in the result.

    Returns
    -------
    dict of str to Column
        Column of each quantity: ``setting Q2``, ``r11_x``, and the keys of `QUANTITIES`.

    Raises
    ------
    InputError
        If a header is unknown, a quantity has two columns, a required one is missing, there are
        no rows, or an error is of another kind of width than its size (rms against FWHM).

    Examples
    --------
    >>> sheet = Sheet("a.csv", ("Q_T_per_m", "fwhm_x_mm"), [["1"], ["2.3548"]], [2], 1, ())
    >>> columns = scan_columns(sheet)
    >>> list(columns), round(2.3548 * columns["size_x"].factor, 7)
    (['setting Q', 'size_x'], 0.001)
    """
    current = any(standard_header(name).lower().startswith("beam_current") for name in sheet.names)
    if current and not any(map(is_size, sheet.names)):
        expected = "a quadrupole scan; `beamfit lifetime` reads it"
        raise sheet.header_error("a record of beam current", expected)
    knob_headers = {column.header for column in knobs.values()}
    others = [name for name in sheet.names if name not in knob_headers]
    if "plane" in map(str.lower, others) and not sheet.has_layout:
        expected = "a column for each plane, size_x_um and size_y_um, and a row for each setting"
        raise sheet.header_error("rows of two planes", expected)
    read = columns_of(sheet.select(others), QUANTITIES, partial(_scan_column, sheet=sheet))
    columns = dict(knobs) | read
    for needed, keys in REQUIRED_COLUMNS.items():
        if not any(re.fullmatch(keys, key) for key in columns):
            raise sheet.header_error("columns " + ", ".join(sheet.names), needed)
    for plane in "xy":
        _check_error(sheet, columns, plane)
        _check_elements(sheet, columns, plane)
    energies = [columns[e].header for e in ENERGIES if e in columns]
    if len(energies) > 1:
        raise sheet.header_error("columns " + " and ".join(energies), "one of them", energies[1])
    if not len(sheet):
        raise sheet.header_error("a header and no rows", "at least three settings")
    return columns


def is_scan_header(name: str, sheet: Sheet) -> bool:
    """True if a header is one of a scan."""
    try:
        return bool(
            columns_of(sheet.select([name]), QUANTITIES, partial(_scan_column, sheet=sheet))
        )
    except InputError:
        return False


def _check_error(sheet: Sheet, columns: Mapping[str, Column], plane: str) -> None:
    """Check that an error column has a size column of the same kind of width."""
    size, error = columns.get(f"size_{plane}"), columns.get(f"size_{plane}_error")
    if error is None:
        return
    if size is None:
        found = f"{error.header} without sizes in {plane}"
        raise sheet.header_error(found, f"a column size_{plane}_um", error.header)
    if error.unit != PERCENT and not math.isclose(rms_factor(size), rms_factor(error)):
        word = "a FWHM" if FWHM in (rms_factor(size), rms_factor(error)) else "several sigma"
        found = f"an error beside '{size.header}' of which only one is {word}"
        raise sheet.header_error(found, "sizes and errors of one width", error.header)


def _check_elements(sheet: Sheet, columns: Mapping[str, Column], plane: str) -> None:
    """Check that each measured plane has R11 and R12 if the file has matrix elements."""
    given = [key for key in columns if re.match(r"r1[126]_", key)]
    for element in (f"r11_{plane}", f"r12_{plane}"):
        if given and f"size_{plane}" in columns and element not in columns:
            found = f"{columns[given[0]].header} and no {element}"
            raise sheet.header_error(found, f"r11 and r12 of every plane that has sizes, {element}")


def _scan_column(header: str, sheet: Sheet) -> Column:
    """Column of a header outside `QUANTITIES`: size, matrix element, magnet setting, or unused."""
    if UNUSED_HEADER.fullmatch(header):
        return Column(header, header)
    if header.lower() in ("n_shots", "nshots"):
        return Column(header, "shots")
    if (column := _size_column(header)) is not None:
        return column
    if (named := MATRIX_HEADER.fullmatch(header)) is not None:
        of_x, plane, of_y = named.groups()
        return Column(header, f"r{Y_ELEMENTS[of_y]}_y" if of_y else f"r{of_x}_{plane or 'x'}")
    if COUPLING_HEADER.fullmatch(header) is not None:
        found = "the correlation of x and y, or a tilt: coupled beams are not fitted"
        raise sheet.header_error(found, "two planes, which are fitted alone", header)
    unit = next((u for u in SETTINGS if header.endswith(f"_{u}")), "")
    name = header.removesuffix(f"_{unit}") if unit else ""
    while (stripped := DEVICE_ATTRIBUTE.sub("", name)) != name:
        name = stripped
    if name and not re.match(r"(size|sigma|rms|fwhm)_[xy](_|$)", name):
        return Column(header, f"{SETTING}{name}", unit)
    nearest_names = nearest(header, example_headers(QUANTITIES))
    expected = f"a magnet with _A, _kG, _T_per_m or _k1 at the end, {nearest_names}"
    raise sheet.header_error(_unknown_reason(header), expected, header)


def likely_scan_name(header: str, cell: object = "") -> str | None:
    """Guess the scan column that a header without a unit means; None without a guess.

    The unit is that of the cell if it has one, otherwise um or kG.

    Examples
    --------
    >>> [likely_scan_name(header) for header in ("xrms", "QUAD:525:BACT", "foo")]
    ['size_x_um', 'QUAD_525_kG', None]
    >>> likely_scan_name("xrms", "0.11 mm"), likely_scan_name("Q5 current", "1.5 A")
    ('size_x_mm', 'Q5_A')
    >>> likely_scan_name("err_x"), likely_scan_name("err x [mm]"), likely_scan_name("x")
    ('size_x_error_um', 'size_x_error_mm', None)
    """
    _, cell_unit = number_and_unit(str(cell)) or ("", None)
    size = _size_column(f"{header}_um") or _bare_error_column(f"{header}_um")
    if size is not None:
        return f"{size.key}_{cell_unit if cell_unit in UNITS['length'] else 'um'}"
    if (error := _bare_error_column(standard_header(header))) is not None:
        return f"{error.key}_{error.unit}"
    stripped, unit = DEVICE_ATTRIBUTE.sub("", header), cell_unit or "kG"
    if stripped == header or unit not in SETTINGS:
        return None
    return f"{re.sub(r'[^A-Za-z0-9.]+', '_', stripped)}_{unit}"


def _unknown_reason(header: str) -> str:
    """Explain why a header is not understood."""
    bracket = re.search(r"[\[(]([^\[\]()]*)[\])]\s*$", header)
    before, _, last = header.rpartition("_")
    if is_size(re.sub(r"[ _.#-]*[0-9]+$", "", header)) and header[-1].isdecimal():
        return "a size with a number behind it: shots stand in rows, each with its setting"
    if (error := _bare_error_column(header)) is not None:
        return f"an error without what it is of; {error.key}_{error.unit} is that of a size"
    if _size_column(f"{header}_um") is not None:
        return "a size without a unit"
    if header.lower().startswith("beam_current"):
        return "a beam current, on which no size depends"
    if bracket is not None:
        return f"unknown unit '{bracket[1]}'"
    if before and last in UNITS["length or share"]:
        return f"'{before}', which is no size of a plane that is known"
    return f"unknown unit '{last}'" if before else "a name without a unit"


def is_size(header: str) -> bool:
    """True if a header names a beam size or its error, with or without a unit."""
    name = standard_header(header)
    return any(_size_column(header) is not None for header in (name, f"{name}_um"))


def _size_column(header: str) -> Column | None:
    """Column of a beam size or its error; None if the header is neither.

    The header has a kind of width, a plane and a unit, in either order: ``sigma_x_mm``,
    ``x_rms_um``, ``rms_x_err_mm``, ``fwhm_y_um_std``, ``sigma_x_err_%``, ``D4Sigma_x_mm``.
    """
    # Of a control system's name only the last part names the size, the others the screen.
    channel = re.split("[:/]", header)[-1].replace("σ", "sigma").replace("Δ", "d_")
    multiple = MULTIPLE_SIGMA.search(channel)
    words = MULTIPLE_SIGMA.sub("", channel).split("_")
    units = UNITS["length or share"]
    unit_index = next((i for i in (-1, -2) if len(words) > 1 and words[i] in units), None)
    if unit_index is None:
        return None
    unit = words.pop(unit_index)
    parts = []
    for word in filter(None, map(str.lower, words)):
        joined = JOINED_WORD.fullmatch(word)
        parts += [part for part in joined.groups() if part] if joined else [word]
    kinds = (PLANE_WORDS, WIDTH_WORDS, ERROR_WORDS)
    planes, widths, errors = ([w for w in parts if w in kind] for kind in kinds)
    # "rms_size" and "size_fwhm" are one width in two words; "sigma_size" may be an error.
    one_width = len(widths) == 1 or sorted(widths) in (["rms", "size"], ["fwhm", "size"])
    if not (SIZE_WORDS.issuperset(parts) and one_width and len(planes) == 1 and len(errors) <= 1):
        return None
    if unit == PERCENT and not errors:
        return None
    factor = FWHM if "fwhm" in widths else 1.0 / int(multiple[1]) if multiple else 1.0
    key = f"size_{PLANE_WORDS[planes[0]]}" + ("_error" if errors else "")
    return Column(header, key, unit, units[unit] * (factor if unit != PERCENT else 1.0))


def _bare_error_column(header: str) -> Column | None:
    """Column of an error whose header omits the word for a size: ``err_x_um``."""
    error = _size_column(f"size_{header}")
    return error if error is not None and error.key.endswith("_error") else None


def rms_factor(column: Column) -> float:
    """Ratio of the rms size to the width in a column: 1 for rms, 0.42 for FWHM."""
    return column.factor / UNITS["length"][column.unit]


def is_scatter(columns: Mapping[str, Column], plane: str) -> bool:
    """True if an error column is the standard deviation of the shots, not that of their mean.

    Examples
    --------
    >>> of = {"shots": Column("n", "shots"), "size_x_error": Column("x_rms_std_um", "", "um")}
    >>> is_scatter(of, "x"), is_scatter(of, "y")
    (True, False)
    """
    error = columns.get(f"size_{plane}_error")
    return "shots" in columns and error is not None and bool(SCATTER_WORD.search(error.header))


def column_notes(columns: Mapping[str, Column]) -> list[str]:
    """Notes on sizes converted from another width and on errors divided by sqrt(shots)."""
    headers_by_divisor: dict[float, list[str]] = {}
    for column in (columns[key] for key in ("size_x", "size_y") if key in columns):
        headers_by_divisor.setdefault(round(1 / rms_factor(column), 4), []).append(column.header)
    return [
        f"Sizes are FWHM/2.3548 of {' and '.join(headers)}, which is their rms for a Gaussian "
        "profile only."
        if divisor == round(1 / FWHM, 4)
        else f"Sizes are a share of 1/{divisor:g} of {' and '.join(headers)}."
        for divisor, headers in headers_by_divisor.items()
        if divisor != 1.0
    ] + [
        f"'{columns[f'size_{p}_error'].header}' beside '{columns['shots'].header}' is taken for "
        "the deviation of the shots: the errors are it over the root of their number."
        for p in "xy"
        if is_scatter(columns, p)
    ]


# Words in a comment that suggest a width other than the rms, or pixels.
FULL_WIDTH = r"fwhm|full[ -]widths?"
OTHER_WIDTH = re.compile(
    rf"{FULL_WIDTH}|\b[2-6][ -]?(sigma|σ|rms)|\b1/e|pixel|\bpx\b", re.IGNORECASE
)
# A comment that states the width or unit of all sizes: "all sizes are given in mm", "FWHM beam
# widths"; its subject, and the words between the subject and the statement.
SUBJECT = r"(?:^|[.;,:])(?:\s|\b(?:all|beam|both|rms|spot|the|transverse)\b)*\b(?:sizes?|widths?)\b"
LINK = r"(?:[\s:=()\[\]]|\b(?:all|and|are|as|given|in|is|measured|rms|the|units?|x|y)\b)*"
SIZE_STATEMENT = re.compile(
    rf"{SUBJECT}{LINK}(?:(?P<full>(?:{FULL_WIDTH})\b)"
    r"|(?P<several>[2-6])[ -]?(?:sigma|σ|rms)"
    r"|(?P<rms>rms|1[ -]?sigma)\b|(?P<unit>pixels?|px|mm|microns?|[uµμn]m|cm)\b)"
    rf"|^\W*(?P<full_first>(?:{FULL_WIDTH}))(?: beam| spot)? (?:sizes?|widths?)\W*$",
    re.IGNORECASE,
)
# A list of units, such as "units: A, mm", which may be of other columns than the sizes.
UNIT_LIST = re.compile(r"\bunits?\b.*?\b(mm|microns?|[uµμ]m|cm)\b", re.IGNORECASE)
# Words that make the meaning of a comment uncertain: negation, conversion, conditions.
AMBIGUOUS_COMMENT = re.compile(
    r"\b(not|no|never|from|convert\w*|divided|before|was|were|once|if|or)\b|[/*]|\?", re.IGNORECASE
)


def comment_notes(sheet: Sheet, columns: Mapping[str, Column]) -> list[str]:
    """Notes on comments that may contradict the width or unit in the headers of sizes.

    Parameters
    ----------
    sheet : Sheet
        The file.
    columns : mapping of str to Column
        Its columns, as `scan_columns` returns them.

    Returns
    -------
    list of str
        At most one question for the user.

    Raises
    ------
    InputError
        If a comment states a width or unit that no size header has: one of the two is wrong, by
        2.4 or by 1000.

    Examples
    --------
    >>> sheet = Sheet("a.csv", ("size_x_um",), [["9"]], [3], 2, ("gauss fit, FWHM 4 px",))
    >>> size = Column("size_x_um", "size_x", "um", 1e-6)
    >>> comment_notes(sheet, {"size_x": size})[0][:47]
    "A comment says 'gauss fit, FWHM 4 px', and the "
    """
    sizes = [columns[key] for key in ("size_x", "size_y") if key in columns]
    for text in sheet.comments:
        if not AMBIGUOUS_COMMENT.search(text) and (statement := SIZE_STATEMENT.search(text)):
            _check_statement(sheet, sizes, text, statement)
    for text in sheet.comments:
        listed = UNIT_LIST.search(text)
        factor = _length_factor(listed[1]) if listed else None
        if listed and all(factor != UNITS["length"][column.unit] for column in sizes):
            return [
                f"A comment says '{short(text, 80)}', and the sizes are taken in {sizes[0].unit}, "
                f"as the header {sizes[0].header} says: is that so?"
            ]
    comment = next((text for text in sheet.comments if OTHER_WIDTH.search(text)), None)
    if comment is None or any(rms_factor(column) != 1.0 for column in sizes):
        return []
    headers = " and ".join(column.header for column in sizes)
    return [
        f"A comment says '{short(comment, 80)}', and the sizes are taken for rms: if they are not, "
        f"say so in the header of {headers}, such as fwhm_x_{sizes[0].unit}."
    ]


def _length_factor(unit: str) -> float | None:
    return UNITS["length"].get(known_unit(unit) or "")


def _check_statement(
    sheet: Sheet, sizes: list[Column], text: str, statement: re.Match[str]
) -> None:
    """Raise if no size column has the width or unit that a comment states."""
    unit, multiple = statement["unit"], statement["several"]
    if unit:
        name = known_unit(unit)
        agreeing = [c for c in sizes if _length_factor(unit) == UNITS["length"][c.unit]]
        remedy = f"rename the column {sizes[0].key}_{name}" if name else "give lengths, in um"
    else:
        factor = 1.0 if statement["rms"] else 1 / int(multiple) if multiple else FWHM
        agreeing = [c for c in sizes if math.isclose(rms_factor(c), factor)]
        word = "size" if statement["rms"] else f"{multiple}sigma" if multiple else "fwhm"
        remedy = f"rename the column {word}_{sizes[0].key[-1]}_{sizes[0].unit}"
    if agreeing:
        return
    lines = enumerate([] if sheet.lines is None else text_lines(sheet.path), start=1)
    line = next((number for number, text_line in lines if text in text_line), None)
    found = f"the comment '{short(text, 80)}'"
    expected = f"one that agrees with the header: {remedy} if the comment is right, "
    expected += "else delete the comment"
    raise InputError(found, expected, sheet.path, line, sizes[0].header)


# Largest number of rows: a longer file is a log, and is refused before it fills the memory.
MAX_ROWS = 100_000
# A size is refused as a slip of the decimal point or unit if it differs from the median of its
# column by more than this factor and lies outside the usual range of sizes (`USUAL`). Chosen:
# far above any real scan, below the 1000 between mm and um.
OUTLIER_FACTOR = 100.0
# Relative error of a size below which its unit is questioned: no beam size was ever measured
# better, and errors in mm read as um are smaller by 1e-3.
MIN_ERROR_RATIO = 1e-4
# Ranges of other quantities: low (excluded), high (included), and words for the message.
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
        emittance_gui (``.mat``), whose RMS sizes are read (see
        `beamfit.io.emittance_gui.read_emittance_gui`).
    columns : str, path, mapping or Layout, optional
        Meaning of columns whose headers do not say it: ``{"xrms": "size_x_um"}``, or any layout
        of `beamfit.io.columns.layout_of`. Other columns with unknown names are then ignored.
    ignore : iterable of str
        Columns to leave unread; * and ? are wildcards.
    skip_bad : bool
        Leave out rows that cannot be used; ``notes`` counts and names them.

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
    sheet = read_columns(path, "Q2_A,size_x_um", columns, ignore, skip_bad, MAX_ROWS)
    return scan_of_sheet(sheet)


def scan_of_sheet(sheet: Sheet, knobs: Mapping[str, Column] = MappingProxyType({})) -> QuadScan:
    """Make the scan of a sheet; columns of knobs are settings in addition to the magnets."""
    profiles: tuple[Profile, ...] = ()
    if IMAGE in sheet.names:
        sheet = profiles_from_images(replace(sheet, row_hint=""))
    if {"counts_x", "counts_y"} & set(sheet.names):
        sheet, profiles = sizes_from_profiles(replace(sheet, row_hint=""))
    columns = scan_columns(sheet, knobs)
    sheet = _blank_dark_shots(sheet, columns) if "shot" in columns else sheet
    if sheet.skip_bad:
        sheet = sheet.drop_bad_rows(lambda rows: _scan_values(rows, columns))
        typical = _median_sizes(_scan_values(sheet, columns))
        sheet = sheet.drop_bad_rows(
            lambda rows: _check_outlying_sizes(rows, columns, _scan_values(rows, columns), typical)
        )
    values = _scan_values(sheet, columns)
    size_notes = _check_sizes(sheet, columns, values)
    notes = [*column_notes(columns), *comment_notes(sheet, columns), *size_notes]
    notes += [*ignored_note(sheet, columns), *sheet_notes(sheet)]
    with located(sheet.path):
        scan = _make_scan(sheet, columns, values, notes=tuple(notes), profiles=profiles)
        return group_shots(scan, marked="shot" in columns)


def _blank_dark_shots(sheet: Sheet, columns: Mapping[str, Column]) -> Sheet:
    """Blank sizes of 0, which programs write for shots without beam."""
    cells, count = dict(zip(sheet.names, sheet.cells, strict=True)), 0
    for plane in (plane_name for plane_name in "xy" if f"size_{plane_name}" in columns):
        sizes = cells[columns[f"size_{plane}"].header]
        dark = [is_number(cell) and number(cell) == 0.0 for cell in sizes]
        count += sum(dark)
        for key in {f"size_{plane}", f"size_{plane}_error"} & set(columns):
            header = columns[key].header
            cells[header] = ["" if d else cell for d, cell in zip(dark, cells[header], strict=True)]
    verb = "shows no beam and is" if count == 1 else "show no beam and are"
    note = f"{count} shot{'s' * (count > 1)} of size 0 {verb} left out."
    notes = (*sheet.notes, note) if count else sheet.notes
    return replace(sheet, cells=list(cells.values()), notes=notes)


def _make_scan(
    sheet: Sheet,
    columns: Mapping[str, Column],
    values: Mapping[str, np.ndarray],
    **extra: Any,
) -> QuadScan:
    """Build the scan, one row for each line of the file."""
    magnets = {k.removeprefix(SETTING): c for k, c in columns.items() if k.startswith(SETTING)}
    energies = [(values[key], kind) for key, kind in ENERGIES.items() if key in values]
    energy, kind = energies[0] if energies else (None, "total")
    headers = {key: sheet.file_headers.get(c.header, c.header) for key, c in columns.items()}
    words = [key for key in ("screen", "slice") if key in columns]
    texts = {key: tuple(map(str, sheet[columns[key].header])) for key in words}
    planes = [p for p in "xy" if f"size_{p}" in values]
    error = {p: values[f"size_{p}_error"] for p in planes if f"size_{p}_error" in values}
    zeros = np.zeros(len(sheet))
    matrices = {
        p: np.stack([values.get(f"{r}_{p}", zeros) for r in ("r11", "r12", "r16")], axis=-1)
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
        **texts,
        transfer=matrices or None,
        error_source="the file" if error else "none given",
        name=Path(name_of(sheet.path)).stem,
        path=sheet.path,
        sha256=sheet.sha256,
        provenance=sheet.comments,
        columns={name: headers[c.key] for name, c in magnets.items()}
        | headers
        | {header: header for header in headers.values()},
        **extra,
    )


def _scan_values(sheet: Sheet, columns: Mapping[str, Column]) -> dict[str, np.ndarray]:
    """Checked numbers of a scan in SI, by quantity; raises at the first row that cannot be used."""
    sizes = [key for p in "xy" for key in (f"size_{p}", f"size_{p}_error") if key in columns]
    others = [key for key in columns if key in RANGES or key.startswith((SETTING, "r1"))]
    values = {key: _read_quantity(sheet, columns[key], key in sizes) for key in sizes + others}
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
        # A blank size with an error was not measured; NaN with an error contradicts itself.
        unmeasured = np.isnan(values[size]) & ~np.isnan(values[error])
        for row in [int(row) for row in np.flatnonzero(unmeasured)]:
            if (cell := sheet[columns[size].header][row]) != "":
                expected = "a finite number, or no error beside it"
                raise sheet.error(f"'{cell}'", expected, row, columns[size].header)
    if "screen" in columns and "" in (names := list(sheet[columns["screen"].header])):
        expected = "the name of a screen of the lattice"
        raise sheet.error("an empty cell", expected, names.index(""), columns["screen"].header)
    return values


def _read_quantity(sheet: Sheet, column: Column, is_length: bool) -> np.ndarray:
    """A column in SI within the range of its quantity; blank lengths are NaN."""
    values = sheet.values(column, blank=is_length)
    text = f"a positive {'error' if column.key.endswith('error') else 'beam size'} in {column.unit}"
    default_range = (0.0, np.inf, text) if is_length else (-np.inf, np.inf, "")
    low, high, expected = RANGES.get(column.key, default_range)
    if (wrong := (values <= low) | (values > high)).any():
        if column.key.endswith("error") and not np.any(values > 0):
            expected += f"; --ignore '{column.header}' leaves them unread: the noise is inferred"
            raise sheet.header_error("no error above zero", expected, column.header)
        sheet.refuse(column.header, wrong, expected)
    return values


def _median_sizes(values: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Median size of each plane that has sizes, m."""
    sizes = {p: values[f"size_{p}"] for p in "xy" if f"size_{p}" in values}
    return {p: middle(v) for p, v in sizes.items() if not np.isnan(v).all()}


def _check_outlying_sizes(
    sheet: Sheet,
    columns: Mapping[str, Column],
    values: Mapping[str, np.ndarray],
    medians: Mapping[str, float],
) -> None:
    """Refuse sizes that differ from the median by `OUTLIER_FACTOR` and are unusual for beams."""
    for plane, median in medians.items():
        column, size = columns[f"size_{plane}"], values[f"size_{plane}"]
        upper = max(USUAL[1], OUTLIER_FACTOR * median)
        lower = min(USUAL[0], median / OUTLIER_FACTOR)
        if (outlying := (size > upper) | (size < lower)).any():
            typical = f"{median / column.factor:.3g}"
            found = f"{{:g}} {column.unit}, where the others are around {typical}"
            written = size / column.factor
            sheet.refuse(column.header, outlying, "sizes in one unit", found, written)


def _check_sizes(
    sheet: Sheet, columns: Mapping[str, Column], values: Mapping[str, np.ndarray]
) -> list[str]:
    """Check that sizes and errors are plausible in their units; return notes on tiny errors."""
    medians, notes = _median_sizes(values), []
    for plane in (p for p in "xy" if f"size_{p}" in columns):
        column, error = columns[f"size_{plane}"], columns.get(f"size_{plane}_error")
        if plane not in medians:
            expected = f"sizes in {column.unit}"
            raise sheet.header_error("no number at all", expected, column.header)
        if not POSSIBLE[0] <= medians[plane] <= POSSIBLE[1]:
            raise _implausible(sheet, column, medians[plane] / column.factor)
        if error is None:
            continue
        with np.errstate(over="ignore"):
            ratio = middle(values[f"size_{plane}_error"] / values[f"size_{plane}"])
        if not 1e-6 < ratio < 1.0:
            found = f"errors that are {ratio:g} of the sizes"
            raise sheet.header_error(found, "errors in the unit of the header", error.header)
        if ratio < MIN_ERROR_RATIO:
            statement = f"Errors in {plane} are {ratio:.1g} of the sizes"
            notes.append(f"{statement}: are both in the units of their headers?")
    _check_outlying_sizes(sheet, columns, values, medians)
    return notes


def _implausible(sheet: Sheet, column: Column, written: float) -> InputError:
    """Error for implausible sizes; proposes the unit in which they would be plausible."""
    lengths = UNITS["length"]
    likely = min(("um", "mm", "m"), key=lambda u: abs(np.log(written * lengths[u] / 2e-4)))
    found = f"sizes around {written:g} {column.unit}, implausible for a beam"
    expected = f"sizes between {1e9 * POSSIBLE[0]:g} nm and {1e3 * POSSIBLE[1]:g} mm; if these are "
    expected += f"{likely}, rename the column {column.key}_{likely}"
    return sheet.header_error(found, expected, column.header)


EMITTANCE_HEADER = re.compile(r"(normalized_)?emittance_[xy]")


def read_tuning_scan(
    path: str | PathLike[str] | DataFrame,
    knobs: Iterable[str],
    *,
    columns: Columns = None,
    ignore: Iterable[str] = (),
    skip_bad: bool = False,
) -> QuadScan | EmittanceTable:
    """Read a tuning table: knobs, and beam sizes with quadrupole settings or emittances.

    Parameters
    ----------
    path : str, path or pandas.DataFrame
        As for `beamfit.read_quad_scan`.
    knobs : iterable of str
        Headers of the knobs' columns, with or without the unit: "SOL_A", "SOL", "gun_phase_deg".
    columns, ignore, skip_bad
        As for `beamfit.read_quad_scan`; other columns with unknown names are ignored.

    Returns
    -------
    QuadScan or EmittanceTable
        An `EmittanceTable` if there are columns such as emittance_x_um (and emittance_x_error_um)
        or normalized_emittance_x_um; otherwise a scan. Knobs are among the settings under the
        names given; in a scan their unit is "knob" unless it is one of a magnet. Repeated shots
        of a row are averaged.

    Raises
    ------
    InputError
        If the file cannot be used or a knob has no column, naming file, line and column.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> file = pathlib.Path(tempfile.mkdtemp()) / "tune.csv"
    >>> _ = file.write_text("Q2_A,phase_deg,size_x_um\\n0,5,200\\n1,6,120\\n2,5,180\\n")
    >>> scan = read_tuning_scan(file, ["phase_deg"])
    >>> scan.settings["phase_deg"].tolist(), scan.units["phase_deg"]
    ([5.0, 6.0, 5.0], 'knob')
    """
    sheet = read_columns(path, "Q2_A,knob,size_x_um", columns, ignore, skip_bad, MAX_ROWS)
    knob_names = {knob: _knob_header(knob, sheet) for knob in dict.fromkeys(knobs)}
    file_headers = {knob: sheet.file_headers.get(name, name) for knob, name in knob_names.items()}
    if any(EMITTANCE_HEADER.match(name) for name in sheet.names):
        return _emittance_table(replace(sheet, row_hint=""), knob_names, file_headers)
    units = {knob: _knob_unit(knob, header) for knob, header in file_headers.items()}
    knobs = {f"setting {k}": Column(n, f"setting {k}", units[k]) for k, n in knob_names.items()}
    scan = scan_of_sheet(replace(sheet, has_layout=True), knobs)
    return replace(scan, columns=scan.columns | file_headers)


def _emittance_table(
    sheet: Sheet, knob_names: Mapping[str, str], knob_headers: dict[str, str]
) -> EmittanceTable:
    """Emittances at settings of knobs; other columns are ignored."""
    headers = [n for n in sheet.names if EMITTANCE_HEADER.match(n)]
    is_normalized = {n.startswith("normalized_") for n in headers}
    if len(is_normalized) > 1:
        expected = "columns of one of them"
        raise sheet.header_error("emittances, and normalized emittances", expected, headers[-1])
    prefix = "normalized_emittance_" if is_normalized.pop() else "emittance_"
    quantities = {f"{prefix}{end}": "length" for end in ("x", "y", "x_error", "y_error")}
    found = columns_of(sheet.select(headers), quantities)
    values = {k.removeprefix(prefix): sheet.values(c, blank=True) for k, c in found.items()}
    for column, column_values in zip(found.values(), values.values(), strict=True):
        sheet.refuse(column.header, column_values <= 0.0, "a positive number")
    return EmittanceTable(
        settings={knob: sheet.numbers(name) for knob, name in knob_names.items()},
        emittance={p: v for p, v in values.items() if p in "xy"},
        error={k[0]: v for k, v in values.items() if k not in "xy"},
        normalized=prefix.startswith("normalized_"),
        name=Path(name_of(sheet.path)).stem,
        path=sheet.path,
        sha256=sheet.sha256,
        provenance=sheet.comments,
        notes=sheet_notes(sheet),
        columns=knob_headers
        | {k.replace(prefix, "emittance "): c.header for k, c in found.items()},
    )


def _knob_header(knob: str, sheet: Sheet) -> str:
    """Header of a knob's column: its name, or its name with a unit."""
    if knob in sheet.names:
        return knob
    found = [name for name in sheet.names if standard_header(name).rpartition("_")[0] == knob]
    if not found:
        raise sheet.missing_column(knob)
    if len(found) > 1:
        expected = "its header as it stands: " + " or ".join(found)
        raise sheet.header_error(f"a knob '{knob}' of several columns", expected)
    return found[0]


def _knob_unit(knob: str, header: str) -> str:
    """Unit of a knob: that of its header if it is one of a magnet, otherwise "knob"."""
    unit = standard_header(header).removeprefix(f"{knob}_")
    return unit if unit in SETTINGS else KNOB
