"""Summary of a file as beamfit reads it, to be checked before anything is fitted."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from beamfit.answer import Table
from beamfit.dynamics.record import Run
from beamfit.emittance.scan import QuadScan
from beamfit.errors import InputError
from beamfit.io.columns import Columns, Layout, Sheet, layout_of, layout_text
from beamfit.io.decay_record import (
    is_current,
    likely_record_name,
    read_lifetime_input,
    record_column,
)
from beamfit.io.emittance_gui import is_emittance_gui, read_emittance_gui
from beamfit.io.files import digest
from beamfit.io.lattice import CALIBRATIONS, STRENGTHS, LatticeFile
from beamfit.io.line import PROGRAM_SUFFIXES, build_line, read_lattice
from beamfit.io.ring import read_operation, read_ring
from beamfit.io.run import read_run
from beamfit.io.scan import is_scan_header, is_size, likely_scan_name, read_quad_scan
from beamfit.io.table import read_columns
from beamfit.io.toml import read_toml
from beamfit.language.document import Document
from beamfit.lifetime.record import DecayRecord, LifetimeTable
from beamfit.quantity import display_unit


@dataclass(frozen=True)
class FileSummary:
    """Summary of a file: its kind and what it holds.

    Attributes
    ----------
    path : str
        The file.
    kind : str
        ``scan``, ``lattice``, ``record``, ``ring``, ``run`` or ``formulation``.
    sha256 : str
        Digest of the file.
    facts : tuple of Fact
        Contents.
    notes : tuple of str
        Changes made to its numbers, and questions about them.
    content : QuadScan, LatticeFile, DecayRecord, Ring, Run or Document
        The object read from the file.
    """

    path: str
    kind: str
    sha256: str
    facts: tuple[Fact, ...]
    notes: tuple[str, ...]
    content: Any

    def table(self) -> Table:
        """Table of the facts."""
        return Table(f"{self.path}: a {self.kind}", [], [[f.label, f.words] for f in self.facts])

    def to_json(self) -> dict[str, Any]:
        """Return the entry of ``results`` of ``beamfit check --json``."""
        contents = {fact.label.replace(" ", "_"): fact.value for fact in self.facts}
        entry = {"file": self.path, "kind": self.kind, "sha256": self.sha256}
        return entry | {"contents": contents, "notes": list(self.notes)}


def file_summary(
    path: str | PathLike[str],
    *,
    columns: Columns = None,
    ignore: Sequence[str] = (),
    skip_bad: bool = False,
    use: str | None = None,
    energy: float | None = None,
) -> FileSummary:
    """Read a file of any kind that beamfit knows, and summarise it.

    Parameters
    ----------
    path : str or path
        A scan, a lattice, a record of beam current, a ring, a run of a process, or a formulation.
    columns, ignore, skip_bad
        For a scan, a record or a run, as for `read_quad_scan`.
    use, energy
        For a MAD-X or elegant file, as for `load_lattice`.

    Returns
    -------
    Understood
        Kind and contents.

    Raises
    ------
    InputError
        As the reader of that kind of file.

    Examples
    --------
    >>> found = file_summary("measurements/aps_1999_decay.csv")
    >>> found.kind, found.facts[0].words
    ('record', '27 over 8.81 h')
    """
    layout = layout_of(columns)
    kind = _file_kind(path, layout)
    reading = {"columns": layout or None, "ignore": ignore, "skip_bad": skip_bad}
    reading = reading if kind in ("scan", "record", "run") else {}
    if Path(path).suffix.lower() in PROGRAM_SUFFIXES:
        reading = {"use": use, "energy": energy}
    read, facts_of = {
        "scan": (read_quad_scan, scan_facts),
        "lattice": (read_lattice, lattice_facts),
        "record": (read_lifetime_input, record_facts),
        "run": (read_run, run_facts),
        "ring": (read_ring, ring_facts),
        "formulation": (_read_formulation, formulation_facts),
    }[kind]
    content = read(path, **reading)
    facts, notes = list(facts_of(content)), tuple(getattr(content, "notes", ()))
    if kind == "ring" and "operation" in read_toml(path, "a ring").table:
        facts += operation_facts(read_operation(path))
    if kind == "scan":
        from beamfit.emittance.transport import size_warnings

        notes += tuple(size_warnings(content))
        if is_emittance_gui(path):
            methods = list(read_emittance_gui(path).scans)
            facts.append(Fact("size methods", ", ".join(methods), methods))
    return FileSummary(str(path), kind, digest(path), tuple(facts), notes, content)


def _read_formulation(path: str | PathLike[str]) -> Document:
    from beamfit.io.formulation import read_formulation  # scipy

    return read_formulation(path)


def proposed_layout(path: str | PathLike[str], columns: Columns = None) -> str | None:
    """Write a layout for the unknown columns of a table; None if there are none."""
    layout = layout_of(columns)
    kind = _file_kind(path, layout)
    if kind not in ("scan", "record", "run") or is_emittance_gui(path):
        return None
    guesses = [likely_scan_name, likely_record_name]
    guesses = guesses if kind == "scan" else guesses[::-1]
    sheet = read_columns(path, "", layout, skip_bad=True)
    unknown = {}
    for name in _unknown_headers(sheet):
        cell = next(iter(sheet[name]), "")
        if kind != "run":
            unknown[name] = guesses[0](name, cell) or guesses[1](name, cell), cell
        elif name[:2] not in RUN_PREFIXES:
            unknown[name] = None, f"{cell}: u_{name} if an input, y_{name} if an output"
    return layout_text(unknown) if unknown else None


def _unknown_headers(sheet: Sheet) -> list[str]:
    """Headers of a table that belong neither to a scan nor to a record."""
    return [n for n in sheet.names if not (is_scan_header(n, sheet) or record_column(sheet, n))]


def _is_unnamed_run(sheet: Sheet) -> bool:
    """True for a column of time and two or more others that resemble none of a scan or record."""
    unknown = _unknown_headers(sheet)
    known = [record_column(sheet, name) for name in sheet.names if name not in unknown]
    if [column and column.key for column in known] != ["time"] or len(unknown) < 2:
        return False
    cells = [(name, next(iter(sheet[name]), "")) for name in unknown]
    return not any(likely_scan_name(*each) or likely_record_name(*each) for each in cells)


def with_lattice(scan: FileSummary, lattice: FileSummary) -> FileSummary:
    """Add to the summary of a scan whether a lattice has its magnets and screens."""
    label = f"{LATTICE_LABEL}{Path(lattice.path).name}"
    try:
        lattice.content.check_scan(scan.content)
    except InputError as error:
        reason = str(replace(error, path=None))
        fact = Fact(label, reason, {"fits": False, "why": reason})
        return replace(scan, facts=(*scan.facts, fact))
    # JAX from here on
    from beamfit.emittance.transport import scanned_line, unit_warnings

    line = build_line(lattice.content)
    of_particle = scan.content.of_particle(line.mass)
    warnings = unit_warnings(of_particle, scanned_line(of_particle, line))
    notes = (*scan.notes, *(note for note in warnings if note not in scan.notes))
    fact = Fact(label, "has all its magnets and screens", {"fits": True})
    return replace(scan, facts=(*scan.facts, fact), notes=notes)


def misfit(scan: FileSummary) -> str | None:
    """Reason why a scan fits none of its lattices; None if it fits one, or has none."""
    found = [fact.value for fact in scan.facts if fact.label.startswith(LATTICE_LABEL)]
    reasons = [value["why"] for value in found if not value["fits"]]
    return f"{scan.path}: {reasons[0]}" if reasons and len(reasons) == len(found) else None


def _file_kind(path: str | PathLike[str], layout: Layout) -> str:
    """Determine the kind of a file from its name and header."""
    suffix = Path(path).suffix.lower()
    if suffix in PROGRAM_SUFFIXES:
        return "lattice"
    if suffix == ".toml":
        tables = read_toml(path, "a lattice or a ring").table
        return "ring" if "ring" in tables and "element" not in tables else "lattice"
    if suffix in (".bf", ".xml"):
        return "formulation"
    if is_emittance_gui(path):
        return "scan"
    sheet = read_columns(path, "Q2_A,size_x_um", layout, skip_bad=True)
    names = sheet.names
    head = ",".join(names)
    if re.search(r"\bbeta_x_m\b|\bBETX\b", head):
        found = "the optics of a ring"
        raise InputError(found, "the ring file (TOML) that names it under [optics] twiss", path)
    if {name[:2] for name in names} >= RUN_PREFIXES or _is_unnamed_run(sheet):
        return "run"
    is_archive = {"secs", "nanos"} <= set(names)
    has_current = any(map(is_current, names)) and not any(map(is_size, names))
    return "record" if is_archive or has_current else "scan"


# Beginning of the label of a fact that compares a scan with a lattice.
LATTICE_LABEL = "on "
# Prefixes of inputs and outputs of a run.
RUN_PREFIXES = {"u_", "y_"}
# Units as they are shown.
UNIT_TEXT = {"A": "A", "kG": "kG integrated gradient", "T_per_m": "T/m", "k1": "1/m² (k1)"}
UNIT_TEXT |= {"k1l": "1/m (k1l)"}
NO_ERRORS_TEXT = "none: the noise is inferred from the residuals"
# Magnets of a lattice that are listed; more are counted.
MAX_MAGNETS = 20


class Fact(NamedTuple):
    """One item of a summary: label, text, and value for JSON."""

    label: str
    words: str
    value: Any


def _range_fact(
    label: str, values: np.ndarray, unit: str = "", after: str = "", **more: Any
) -> Fact:
    """Range of values, lengths in a suitable unit; `more` is added to the value."""
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    factor, shown_unit = display_unit(max(abs(low), abs(high)), unit or "1")
    words = f"{low / factor:.6g}" if low == high else f"{low / factor:.4g} to {high / factor:.4g}"
    value = {"low": low, "high": high, "unit": unit or "1"} | more
    return Fact(label, f"{words} {UNIT_TEXT.get(shown_unit, shown_unit)}".strip() + after, value)


def _range_facts(columns: Iterable[tuple[str, np.ndarray | None, str]]) -> list[Fact]:
    """Range of each column that is not None."""
    return [
        _range_fact(name.replace("_", " "), values, unit)
        for name, values, unit in columns
        if values is not None
    ]


def _count_fact(label: str, rows: Mapping[str, int], form: str = "{0} ({1} rows)") -> Fact:
    """Number of rows of each name."""
    return Fact(label, ", ".join(form.format(name, n) for name, n in rows.items()), dict(rows))


def scan_facts(scan: QuadScan) -> Iterator[Fact]:
    """Rows, planes, magnets, sizes, energies of a scan."""
    yield Fact("rows", str(len(scan)), len(scan))
    yield _count_fact("planes", {p: int(np.isfinite(scan.size[p]).sum()) for p in scan.planes})
    for name, values in scan.settings.items():
        distinct = len(np.unique(values))
        after = f", {distinct} setting" + "s" * (distinct > 1)
        yield _range_fact(f"magnet {name}", values, scan.units[name], after, settings=distinct)
    for plane in scan.planes:
        column, sizes = scan.columns.get(key := f"size_{plane}", key), scan.size[plane]
        yield _range_fact(f"size {plane}", sizes, "m", f", column {column}", column=column)
        words, value = NO_ERRORS_TEXT, None
        if plane in scan.error:
            share = float(np.nanmedian(scan.error[plane] / sizes))
            words = f"{100 * share:.2g} % of the size in the middle, from {scan.error_source}"
            value = {"median_relative": share, "source": scan.error_source}
        yield Fact(f"errors {plane}", words, value)
    if scan.transfer is not None:
        yield Fact("matrices", "R11 and R12 of each row: no lattice is needed", True)
    if (kind := scan.energy_kind) and scan.energy is not None:
        after = ", momentum p c" if kind == "momentum" else f", {kind} energy"
        yield _range_fact("energy", scan.energy, "MeV", after, kind=kind)
    for label, names in (("screens", scan.screen), ("slices", scan.slice)):
        yield from [] if names is None else [_count_fact(label, Counter(names))]
    other_columns = ("resolution", "m"), ("energy_spread", ""), ("shots", "")
    yield from _range_facts((name, getattr(scan, name), unit) for name, unit in other_columns)


def lattice_facts(file: LatticeFile) -> Iterator[Fact]:
    """Energy, elements, magnets and screens of a lattice."""
    energy = {"value": file.energy, "unit": "MeV", "particle": file.particle}
    plural = "" if file.particle.endswith("-") else "s"
    length = sum(map(_length, file.elements))
    yield Fact("name", file.name, file.name)
    yield Fact("energy", f"{file.energy:.6g} MeV total, {file.particle}{plural}", energy)
    kinds = _count_fact("elements", Counter(e["type"] for e in file.elements), "{1} {0}")
    yield kinds._replace(words=kinds.words.replace("_", " "))
    yield Fact("length", f"{length:.6g} m", length)
    units = [(e, file.calibrations.get(e.get("supply", e["name"]))) for e in file.elements]
    magnets = [(e, unit) for e, unit in units if unit is not None]
    yield from (_magnet_fact(e, unit) for e, unit in magnets[:MAX_MAGNETS])
    if (more := len(magnets) - MAX_MAGNETS) > 0:
        yield Fact("further magnets", f"{more}, set as these", more)
    screens = [e["name"] for e in file.elements if e["type"] == "screen"]
    yield Fact("screens", ", ".join(screens) or "none: sizes need one", screens)
    if file.energy_spread:
        yield Fact("energy spread", f"{file.energy_spread:.3g}", file.energy_spread)
    if file.design is not None:
        yield Fact("design Twiss", f"at {file.design['at']}", dict(file.design))


def _magnet_fact(element: Mapping[str, Any], unit: str) -> Fact:
    """Default setting of a magnet, and its calibration."""
    key = next(key for key, key_unit in STRENGTHS.items() if key_unit == unit and key in element)
    words = f"{element[key]:g} {UNIT_TEXT[unit]}"
    if "length_m" in element:
        words += f", {element['length_m']:g} m long"
    calibration_keys = [k for keys in CALIBRATIONS for k in sorted(keys) if k in element]
    if calibration_keys:
        words += ", " + " and ".join(f"{k} {_short_text(element[k])}" for k in calibration_keys)
    words += f", on supply {element['supply']}" if "supply" in element else ""
    return Fact(f"magnet {element['name']}", words, {"setting": element[key], "unit": unit})


def _short_text(value: Any) -> str:
    """Text of a calibration: its numbers, or the number of points of a table."""
    if isinstance(value, list | tuple):
        is_short = len(value) <= 4 and not any(isinstance(v, list | tuple) for v in value)
        return ", ".join(f"{v:g}" for v in value) if is_short else f"of {len(value)} points"
    return f"{value:g}" if isinstance(value, int | float) else str(value)


def _length(element: Mapping[str, Any]) -> float:
    """Length of an element along the beam, m."""
    if element["type"] == "sector_dipole":
        return abs(element["radius_m"] * np.radians(element["angle_deg"]))
    return float(element.get("length_m", 0.0))


def record_facts(record: DecayRecord | LifetimeTable) -> Iterator[Fact]:
    """Readings, currents, conditions and decays of a record; or rows of a lifetime table."""
    if isinstance(record, LifetimeTable):
        errors = "none: the scatter of the points" if record.error is None else "given"
        yield Fact("lifetimes", str(len(record)), len(record))
        yield _range_fact("lifetime", record.lifetime, "h")
        yield _range_fact("beam current", record.current, "mA")
        yield Fact("errors", errors, record.error is not None)
        return
    from beamfit.lifetime.pieces import split_record  # scipy, for records alone

    hours = record.span / 3600
    value = {"count": len(record), "span_h": hours}
    yield Fact("readings", f"{len(record)} over {hours:.3g} h", value)
    yield _range_fact("beam current", record.current, "mA")
    without = Fact("errors", NO_ERRORS_TEXT, None)
    yield without if record.error is None else _range_fact("errors", record.error, "mA")
    if record.start is not None:
        began = datetime.fromtimestamp(record.start, UTC).isoformat(timespec="seconds")
        yield Fact("began", began, began)
    conditions, units = record.conditions._asdict(), ("V", "m", "Pa", "", "m")
    yield from _range_facts(zip(conditions, conditions.values(), units, strict=True))
    split = split_record(record)
    kinds, count = Counter(event.kind for event in split.events), len(split.segments)
    cut = _count_fact("", kinds, "{1} × {0}").words or "nothing cut away"
    yield Fact("decays", f"{count} ({cut})", {"count": count, "events": dict(kinds)})


def _number_facts(*numbers: tuple[str, float, str]) -> list[Fact]:
    """One fact for each (label, number, unit)."""
    return [
        Fact(label, f"{value:.6g} {unit}".strip(), {"value": float(value), "unit": unit or "1"})
        for label, value, unit in numbers
    ]


def ring_facts(ring: Any) -> list[Fact]:
    """Energy, size and beam of a ring."""
    return _number_facts(
        ("energy", ring.energy / 1e9, "GeV"),
        ("circumference", ring.circumference, "m"),
        ("energy loss a turn", ring.energy_loss / 1e3, "keV"),
        ("emittance x", 1e9 * ring.emittance_x, "nm"),
        ("emittance y", 1e9 * ring.emittance_y, "nm"),
        ("points of the optics", len(ring.optics.weight), ""),
    )


def operation_facts(operation: Any) -> list[Fact]:
    """Operating conditions of a ring."""
    return _number_facts(
        ("RF voltage", operation.rf_voltage / 1e3, "kV"),
        ("bunches", operation.bunches, ""),
        ("pressure without beam", operation.pressure_base, "Pa"),
    )


def run_facts(run: Run) -> Iterator[Fact]:
    """Rows, time step, and range of each input and output."""
    span = float(run.time[-1] - run.time[0])
    step = "at unequal distances" if run.step is None else f"every {run.step:.4g} s"
    value = {"count": len(run), "span_s": span, "step_s": run.step}
    yield Fact("rows", f"{len(run)} over {span:.4g} s, {step}", value)
    for name, values in run.inputs.items():
        yield _range_fact(f"input {name}", values)
    for name, values in run.outputs.items():
        missing = int(np.isnan(values).sum())
        after = f", {missing} not read" if missing else ""
        yield _range_fact(f"output {name}", values, after=after, missing=missing)


def formulation_facts(document: Document) -> Iterator[Fact]:
    """Variables, constraints, objectives, inputs and outputs of a formulation."""
    mapping, problem = document.mapping, document.problem
    lists: dict[str, Any] = {"inputs": mapping.inputs, "outputs": mapping.outputs}
    if problem is not None:
        lists |= {"variables": problem.variables, "constraints": problem.limits}
        lists |= {"objectives": problem.goals}
    for label, items in lists.items():
        names = [item.name if label in ("inputs", "outputs") else item.label for item in items]
        yield Fact(label, ", ".join(names) or "none", names)
