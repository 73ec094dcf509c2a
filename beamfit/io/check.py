"""Summary of a file as beamfit reads it, for a person to see before anything is fitted."""

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
from beamfit.io.columns import Columns, Layout, layout_of, proposal
from beamfit.io.decay_record import is_current, known, likely_record_name, read_lifetime_input
from beamfit.io.emittance_gui import is_emittance_gui, read_emittance_gui
from beamfit.io.files import digest
from beamfit.io.lattice import CALIBRATIONS, STRENGTHS, LatticeFile
from beamfit.io.line import FOREIGN, build_line, read_lattice
from beamfit.io.ring import read_operation, read_ring
from beamfit.io.run import read_run
from beamfit.io.scan import is_known, is_size, likely_scan_name, read_quad_scan
from beamfit.io.table import read_columns
from beamfit.io.toml import read_toml
from beamfit.language.document import Document
from beamfit.lifetime.record import DecayRecord, LifetimeTable
from beamfit.quantity import display_unit


@dataclass(frozen=True)
class Understood:
    """Summary of a file: its kind and what it holds.

    Attributes
    ----------
    path : str
        The file.
    kind : str
        ``scan``, ``lattice``, ``record``, ``ring``, ``run`` or ``formulation``.
    sha256 : str
        Its digest.
    facts : tuple of Fact
        What it says.
    notes : tuple of str
        What was done to its numbers, and what is odd about them.
    content : QuadScan, LatticeFile, DecayRecord, Ring, Run or Document
        What was read.
    """

    path: str
    kind: str
    sha256: str
    facts: tuple[Fact, ...]
    notes: tuple[str, ...]
    content: Any

    def table(self) -> Table:
        """The facts to be shown."""
        return Table(f"{self.path}: a {self.kind}", [], [[f.label, f.words] for f in self.facts])

    def to_json(self) -> dict[str, Any]:
        """Give one entry of ``results`` of ``beamfit check --json``."""
        contents = {fact.label.replace(" ", "_"): fact.value for fact in self.facts}
        said = {"file": self.path, "kind": self.kind, "sha256": self.sha256}
        return said | {"contents": contents, "notes": list(self.notes)}


def understand(
    path: str | PathLike[str],
    *,
    columns: Columns = None,
    ignore: Sequence[str] = (),
    skip_bad: bool = False,
    use: str | None = None,
    energy: float | None = None,
) -> Understood:
    """Read a file of any kind that beamfit takes, and say what it holds.

    Parameters
    ----------
    path : str or path
        A scan, a lattice, a record of beam current, a ring, a run of a process, or a formulation.
    columns, ignore, skip_bad
        Of a scan, a record or a run, as for `read_quad_scan`.
    use, energy
        Of a MAD-X or elegant file, as for `load_lattice`.

    Returns
    -------
    Understood
        Its kind and its contents.

    Raises
    ------
    InputError
        As the reader of that kind of file.

    Examples
    --------
    >>> found = understand("measurements/aps_1999_decay.csv")
    >>> found.kind, found.facts[0].words
    ('record', '27 over 8.81 h')
    """
    layout = layout_of(columns)
    kind = _kind(path, layout)
    reading = {"columns": layout or None, "ignore": ignore, "skip_bad": skip_bad}
    reading = reading if kind in ("scan", "record", "run") else {}
    if Path(path).suffix.lower() in FOREIGN:
        reading = {"use": use, "energy": energy}
    read, told = {
        "scan": (read_quad_scan, of_scan),
        "lattice": (read_lattice, of_lattice),
        "record": (read_lifetime_input, of_record),
        "run": (read_run, of_run),
        "ring": (read_ring, of_ring),
        "formulation": (_formulation, of_formulation),
    }[kind]
    content = read(path, **reading)
    facts, notes = list(told(content)), tuple(getattr(content, "notes", ()))
    if kind == "ring" and "operation" in read_toml(path, "a ring").table:
        facts += of_operation(read_operation(path))
    if kind == "scan":
        from beamfit.emittance.transport import size_warnings

        notes += tuple(size_warnings(content))
        if is_emittance_gui(path):
            methods = list(read_emittance_gui(path).scans)
            facts.append(Fact("size methods", ", ".join(methods), methods))
    return Understood(str(path), kind, digest(path), tuple(facts), notes, content)


def _formulation(path: str | PathLike[str]) -> Document:
    from beamfit.io.formulation import read_formulation  # scipy

    return read_formulation(path)


def proposed_layout(path: str | PathLike[str], columns: Columns = None) -> str | None:
    """Write a layout for the columns of a table that nobody knows; None where there are none."""
    layout = layout_of(columns)
    kind = _kind(path, layout)
    if kind not in ("scan", "record") or is_emittance_gui(path):
        return None
    likely = [likely_scan_name, likely_record_name]
    likely = likely if kind == "scan" else likely[::-1]
    sheet = read_columns(path, "", layout, skip_bad=True)
    unknown = {
        name: (likely[0](name, cell) or likely[1](name, cell), cell)
        for name, cells in zip(sheet.names, sheet.cells, strict=True)
        if not (is_known(name, sheet) or known(sheet, name))
        for cell in [next(iter(cells), "")]
    }
    return proposal(unknown) if unknown else None


def with_lattice(scan: Understood, lattice: Understood) -> Understood:
    """Add to a scan whether a lattice has what it names, and what its settings mean there."""
    label = f"on {Path(lattice.path).name}"
    try:
        lattice.content.check_scan(scan.content)
    except InputError as error:
        said = str(replace(error, path=None))
        return replace(scan, facts=(*scan.facts, Fact(label, said, {"fits": False, "why": said})))
    # JAX from here on
    from beamfit.emittance.transport import scanned_line, unit_warnings

    line = build_line(lattice.content)
    own = scan.content.of_particle(line.mass)
    asked = unit_warnings(own, scanned_line(own, line))
    notes = (*scan.notes, *(note for note in asked if note not in scan.notes))
    fact = Fact(label, "has all its magnets and screens", {"fits": True})
    return replace(scan, facts=(*scan.facts, fact), notes=notes)


def _kind(path: str | PathLike[str], layout: Layout) -> str:
    """Tell the kind of a file by its name and its head."""
    suffix = Path(path).suffix.lower()
    if suffix in FOREIGN:
        return "lattice"
    if suffix == ".toml":
        tables = read_toml(path, "a lattice or a ring").table
        return "ring" if "ring" in tables and "element" not in tables else "lattice"
    if suffix in (".bf", ".xml"):
        return "formulation"
    if is_emittance_gui(path):
        return "scan"
    names = read_columns(path, "Q2_A,size_x_um", layout, skip_bad=True).names
    head = ",".join(names)
    if re.search(r"\bbeta_x_m\b|\bBETX\b", head):
        found = "the optics of a ring"
        raise InputError(found, "the ring file (TOML) that names it under [optics] twiss", path)
    if {"u_", "y_"} <= {name[:2] for name in names}:
        return "run"
    archived = {"secs", "nanos"} <= set(names)
    current = any(map(is_current, names)) and not any(map(is_size, names))
    return "record" if archived or current else "scan"


SAID = {"A": "A", "kG": "kG integrated gradient", "T_per_m": "T/m", "k1": "1/m² (k1)"}
SAID |= {"k1l": "1/m (k1l)"}
INFERRED = "none: the noise is inferred from the residuals"
# Magnets of a lattice that are told one by one.
MOST_MAGNETS = 20


class Fact(NamedTuple):
    """One thing understood: what it is, in words, and as numbers for JSON."""

    label: str
    words: str
    value: Any


def _range(label: str, values: np.ndarray, unit: str = "", after: str = "", **more: Any) -> Fact:
    """From the smallest to the largest, lengths in a unit of their size, and what is said more."""
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    factor, said = display_unit(max(abs(low), abs(high)), unit or "1")
    words = f"{low / factor:.6g}" if low == high else f"{low / factor:.4g} to {high / factor:.4g}"
    value = {"low": low, "high": high, "unit": unit or "1"} | more
    return Fact(label, f"{words} {SAID.get(said, said)}".strip() + after, value)


def _ranges(columns: Iterable[tuple[str, np.ndarray | None, str]]) -> list[Fact]:
    """From the smallest to the largest of each column that there is."""
    return [
        _range(name.replace("_", " "), values, unit)
        for name, values, unit in columns
        if values is not None
    ]


def _counted(label: str, rows: Mapping[str, int], form: str = "{0} ({1} rows)") -> Fact:
    """Count of each."""
    return Fact(label, ", ".join(form.format(name, n) for name, n in rows.items()), dict(rows))


def of_scan(scan: QuadScan) -> Iterator[Fact]:
    """Rows, planes, magnets, sizes, energies of a scan."""
    yield Fact("rows", str(len(scan)), len(scan))
    yield _counted("planes", {p: int(np.isfinite(scan.size[p]).sum()) for p in scan.planes})
    for name, values in scan.settings.items():
        distinct = len(np.unique(values))
        after = f", {distinct} setting" + "s" * (distinct > 1)
        yield _range(f"magnet {name}", values, scan.units[name], after, settings=distinct)
    for plane in scan.planes:
        column, sizes = scan.columns.get(key := f"size_{plane}", key), scan.size[plane]
        yield _range(f"size {plane}", sizes, "m", f", column {column}", column=column)
        words, value = INFERRED, None
        if plane in scan.error:
            share = float(np.nanmedian(scan.error[plane] / sizes))
            words = f"{100 * share:.2g} % of the size in the middle, from {scan.error_source}"
            value = {"median_relative": share, "source": scan.error_source}
        yield Fact(f"errors {plane}", words, value)
    if scan.transfer is not None:
        yield Fact("matrices", "R11 and R12 of each row: no lattice is needed", True)
    if (kind := scan.energy_kind) and scan.energy is not None:
        after = ", momentum p c" if kind == "momentum" else f", {kind} energy"
        yield _range("energy", scan.energy, "MeV", after, kind=kind)
    for label, names in (("screens", scan.screen), ("slices", scan.slice)):
        yield from [] if names is None else [_counted(label, Counter(names))]
    further = ("resolution", "m"), ("energy_spread", ""), ("shots", "")
    yield from _ranges((name, getattr(scan, name), unit) for name, unit in further)


def of_lattice(file: LatticeFile) -> Iterator[Fact]:
    """Energy, elements, magnets and screens of a lattice."""
    energy = {"value": file.energy, "unit": "MeV", "particle": file.particle}
    plural = "" if file.particle.endswith("-") else "s"
    length = sum(map(_length, file.elements))
    yield Fact("name", file.name, file.name)
    yield Fact("energy", f"{file.energy:.6g} MeV total, {file.particle}{plural}", energy)
    kinds = _counted("elements", Counter(e["type"] for e in file.elements), "{1} {0}")
    yield kinds._replace(words=kinds.words.replace("_", " "))
    yield Fact("length", f"{length:.6g} m", length)
    units = [(e, file.calibrations.get(e.get("supply", e["name"]))) for e in file.elements]
    magnets = [(e, unit) for e, unit in units if unit is not None]
    yield from (_magnet(e, unit) for e, unit in magnets[:MOST_MAGNETS])
    if (more := len(magnets) - MOST_MAGNETS) > 0:
        yield Fact("further magnets", f"{more}, set as these", more)
    screens = [e["name"] for e in file.elements if e["type"] == "screen"]
    yield Fact("screens", ", ".join(screens) or "none: sizes need one", screens)
    if file.energy_spread:
        yield Fact("energy spread", f"{file.energy_spread:.3g}", file.energy_spread)
    if file.design is not None:
        yield Fact("design Twiss", f"at {file.design['at']}", dict(file.design))


def _magnet(element: Mapping[str, Any], unit: str) -> Fact:
    """Setting of a magnet where no scan says it, and its calibration."""
    key = next(key for key, its in STRENGTHS.items() if its == unit and key in element)
    words = f"{element[key]:g} {SAID[unit]}"
    if "length_m" in element:
        words += f", {element['length_m']:g} m long"
    how = [k for keys in CALIBRATIONS for k in sorted(keys) if k in element]
    if how:
        words += ", " + " and ".join(f"{k} {_short(element[k])}" for k in how)
    words += f", on supply {element['supply']}" if "supply" in element else ""
    return Fact(f"magnet {element['name']}", words, {"setting": element[key], "unit": unit})


def _short(value: Any) -> str:
    """A calibration number, numbers, or how many of a table."""
    if isinstance(value, list | tuple):
        few = len(value) <= 4 and not any(isinstance(v, list | tuple) for v in value)
        return ", ".join(f"{v:g}" for v in value) if few else f"of {len(value)} points"
    return f"{value:g}" if isinstance(value, int | float) else str(value)


def _length(element: Mapping[str, Any]) -> float:
    """Length of an element along the beam, m."""
    if element["type"] == "sector_dipole":
        return abs(element["radius_m"] * np.radians(element["angle_deg"]))
    return float(element.get("length_m", 0.0))


def of_record(record: DecayRecord | LifetimeTable) -> Iterator[Fact]:
    """Readings, currents and conditions of a record, and the decays in it."""
    if isinstance(record, LifetimeTable):
        errors = "none: the scatter of the points" if record.error is None else "given"
        yield Fact("lifetimes", str(len(record)), len(record))
        yield _range("lifetime", record.lifetime, "h")
        yield _range("beam current", record.current, "mA")
        yield Fact("errors", errors, record.error is not None)
        return
    from beamfit.lifetime.pieces import split_record  # scipy, for records alone

    hours = record.span / 3600
    value = {"count": len(record), "span_h": hours}
    yield Fact("readings", f"{len(record)} over {hours:.3g} h", value)
    yield _range("beam current", record.current, "mA")
    none = record.error is None
    yield Fact("errors", INFERRED, None) if none else _range("errors", record.error, "mA")
    if record.start is not None:
        began = datetime.fromtimestamp(record.start, UTC).isoformat(timespec="seconds")
        yield Fact("began", began, began)
    conditions, units = record.conditions._asdict(), ("V", "m", "Pa", "", "m")
    yield from _ranges(zip(conditions, conditions.values(), units, strict=True))
    split = split_record(record)
    kinds, count = Counter(event.kind for event in split.events), len(split.segments)
    cut = _counted("", kinds, "{1} × {0}").words or "nothing cut away"
    yield Fact("decays", f"{count} ({cut})", {"count": count, "events": dict(kinds)})


def _numbers(*said: tuple[str, float, str]) -> list[Fact]:
    """One number each, with its unit."""
    return [
        Fact(label, f"{value:.6g} {unit}".strip(), {"value": float(value), "unit": unit or "1"})
        for label, value, unit in said
    ]


def of_ring(ring: Any) -> list[Fact]:
    """Energy, size and beam of a ring."""
    return _numbers(
        ("energy", ring.energy / 1e9, "GeV"),
        ("circumference", ring.circumference, "m"),
        ("energy loss a turn", ring.energy_loss / 1e3, "keV"),
        ("emittance x", 1e9 * ring.emittance_x, "nm"),
        ("emittance y", 1e9 * ring.emittance_y, "nm"),
        ("points of the optics", len(ring.optics.weight), ""),
    )


def of_operation(operation: Any) -> list[Fact]:
    """The way a ring runs."""
    return _numbers(
        ("RF voltage", operation.rf_voltage / 1e3, "kV"),
        ("bunches", operation.bunches, ""),
        ("pressure without beam", operation.pressure_base, "Pa"),
    )


def of_run(run: Run) -> Iterator[Fact]:
    """Rows, steps, and the range of every input and output."""
    span = float(run.time[-1] - run.time[0])
    step = "at unequal distances" if run.step is None else f"every {run.step:.4g} s"
    value = {"count": len(run), "span_s": span, "step_s": run.step}
    yield Fact("rows", f"{len(run)} over {span:.4g} s, {step}", value)
    for name, values in run.inputs.items():
        yield _range(f"input {name}", values)
    for name, values in run.outputs.items():
        missing = int(np.isnan(values).sum())
        after = f", {missing} not read" if missing else ""
        yield _range(f"output {name}", values, after=after, missing=missing)


def of_formulation(document: Document) -> Iterator[Fact]:
    """Variables, constraints, objectives, inputs and outputs of a formulation."""
    mapping, problem = document.mapping, document.problem
    lists: dict[str, Any] = {"inputs": mapping.inputs, "outputs": mapping.outputs}
    if problem is not None:
        lists |= {"variables": problem.variables, "constraints": problem.limits}
        lists |= {"objectives": problem.goals}
    for label, these in lists.items():
        names = [one.name if label in ("inputs", "outputs") else one.label for one in these]
        yield Fact(label, ", ".join(names) or "none", names)
