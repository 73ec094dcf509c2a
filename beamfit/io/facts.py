"""What a file says, fact by fact: in words for a reader, as numbers for JSON."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from datetime import UTC, datetime
from os import PathLike
from typing import Any, NamedTuple

import numpy as np

from beamfit.io.lattice import CALIBRATIONS, STRENGTHS, LatticeFile
from beamfit.io.ring import read_operation
from beamfit.io.toml import read_toml
from beamfit.language.document import Document
from beamfit.quantity import display_unit
from beamfit.studies.decay.record import DecayRecord, LifetimeTable
from beamfit.studies.response.record import Run
from beamfit.studies.scan.scans import QuadScan

SAID = {"A": "A", "kG": "kG integrated gradient", "T_per_m": "T/m", "k1": "1/m² (k1)"}
SAID |= {"k1l": "1/m (k1l)"}
CONDITIONS = {"rf_voltage": "V", "scraper_y": "m", "pressure": "Pa", "bunches": ""}
CONDITIONS |= {"bunch_length": "m"}
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


def _counted(label: str, rows: Mapping[str, int]) -> Fact:
    """How many rows there are of each."""
    return Fact(label, ", ".join(f"{name} ({n} rows)" for name, n in rows.items()), dict(rows))


def of_scan(scan: QuadScan) -> list[Fact]:
    """Rows, planes, magnets, sizes, energies of a scan."""
    facts = [Fact("rows", str(len(scan)), len(scan))]
    facts.append(_counted("planes", {p: int(np.isfinite(scan.size[p]).sum()) for p in scan.planes}))
    for name, values in scan.settings.items():
        distinct = len(np.unique(values))
        after = f", {distinct} setting" + ("s" if distinct > 1 else "")
        facts.append(_range(f"magnet {name}", values, scan.units[name], after, settings=distinct))
    for p in scan.planes:
        facts += _of_plane(scan, p)
    if scan.transfer is not None:
        facts.append(Fact("matrices", "R11 and R12 of each row: no lattice is needed", True))
    if scan.energy is not None:
        kind = scan.energy_kind
        after = ", momentum p c" if kind == "momentum" else f", {kind} energy"
        facts.append(_range("energy", scan.energy, "MeV", after, kind=kind))
    if scan.screen is not None:
        facts.append(_counted("screens", Counter(scan.screen)))
    if scan.slice is not None:
        facts.append(_counted("slices", {name: scan.slice.count(name) for name in scan.slices}))
    further = {"resolution": "m", "energy_spread": "", "shots": ""}
    return facts + _known(scan, further)


def _known(holder: Any, units: Mapping[str, str]) -> list[Fact]:
    """The ranges of those columns that there are."""
    known = {name: getattr(holder, name) for name in units}
    return [
        _range(name.replace("_", " "), values, units[name])
        for name, values in known.items()
        if values is not None
    ]


def _of_plane(scan: QuadScan, plane: str) -> list[Fact]:
    """Range and column of the sizes of one plane, and where their errors are from."""
    key = f"size_{plane}"
    column = scan.columns.get(key, key)
    size = _range(f"size {plane}", scan.size[plane], "m", f", column {column}", column=column)
    if plane not in scan.error:
        return [size, Fact(f"errors {plane}", INFERRED, None)]
    share = float(np.nanmedian(scan.error[plane] / scan.size[plane]))
    words = f"{100 * share:.2g} % of the size in the middle, from {scan.error_source}"
    value = {"median_relative": share, "source": scan.error_source}
    return [size, Fact(f"errors {plane}", words, value)]


def of_lattice(file: LatticeFile) -> list[Fact]:
    """Energy, elements, magnets and screens of a lattice."""
    kinds = Counter(element["type"] for element in file.elements)
    length = sum(map(_length, file.elements))
    listed = ", ".join(f"{n} {kind.replace('_', ' ')}" for kind, n in kinds.items())
    energy = {"value": file.energy, "unit": "MeV", "particle": file.particle}
    plural = "" if file.particle.endswith("-") else "s"
    facts = [
        Fact("name", file.name, file.name),
        Fact("energy", f"{file.energy:.6g} MeV total, {file.particle}{plural}", energy),
        Fact("elements", listed, dict(kinds)),
        Fact("length", f"{length:.6g} m", length),
    ]
    units = [(e, file.calibrations.get(e.get("supply", e["name"]))) for e in file.elements]
    magnets = [(e, unit) for e, unit in units if unit is not None]
    facts += [_magnet(e, unit) for e, unit in magnets[:MOST_MAGNETS]]
    if (more := len(magnets) - MOST_MAGNETS) > 0:
        facts.append(Fact("further magnets", f"{more}, set as these", more))
    screens = [e["name"] for e in file.elements if e["type"] == "screen"]
    words = ", ".join(screens) or "none: sizes need one"
    facts.append(Fact("screens", words, screens))
    if file.energy_spread:
        facts.append(Fact("energy spread", f"{file.energy_spread:.3g}", file.energy_spread))
    if file.design is not None:
        facts.append(Fact("design Twiss", f"at {file.design['at']}", dict(file.design)))
    return facts


def _magnet(element: Any, unit: str) -> Fact:
    """What a magnet is set to where no scan says, and how a current becomes a gradient."""
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


def _length(element: Any) -> float:
    """Length of an element along the beam, m."""
    if element["type"] == "sector_dipole":
        return abs(element["radius_m"] * np.radians(element["angle_deg"]))
    return float(element.get("length_m", 0.0))


def _of_lifetimes(table: LifetimeTable) -> list[Fact]:
    errors = "none: the scatter of the points" if table.error is None else "given"
    return [
        Fact("lifetimes", str(len(table)), len(table)),
        _range("lifetime", table.lifetime, "h"),
        _range("beam current", table.current, "mA"),
        Fact("errors", errors, table.error is not None),
    ]


def of_record(record: DecayRecord | LifetimeTable) -> list[Fact]:
    """Readings, currents and conditions of a record, and the decays in it."""
    if isinstance(record, LifetimeTable):
        return _of_lifetimes(record)
    hours = record.span / 3600
    words = f"{len(record)} over {hours:.3g} h"
    facts = [
        Fact("readings", words, {"count": len(record), "span_h": hours}),
        _range("beam current", record.current, "mA"),
    ]
    if record.error is None:
        facts.append(Fact("errors", INFERRED, None))
    else:
        facts.append(_range("errors", record.error, "mA"))
    if record.start is not None:
        began = datetime.fromtimestamp(record.start, UTC).isoformat(timespec="seconds")
        facts.append(Fact("began", began, began))
    facts += _known(record.conditions, CONDITIONS)
    from beamfit.studies.decay.pieces import split_record  # scipy, for records alone

    split = split_record(record)
    kinds = Counter(event.kind for event in split.events)
    cut = ", ".join(f"{n} × {kind}" for kind, n in kinds.items()) or "nothing cut away"
    count = len(split.segments)
    value = {"count": count, "events": dict(kinds)}
    facts.append(Fact("decays", f"{count} ({cut})", value))
    return facts


def of_ring(path: str | PathLike[str], ring: Any) -> list[Fact]:
    """Energy, size and beam of a ring, and how it runs."""
    said = [
        ("energy", ring.energy / 1e9, "GeV"),
        ("circumference", ring.circumference, "m"),
        ("energy loss a turn", ring.energy_loss / 1e3, "keV"),
        ("emittance x", 1e9 * ring.emittance_x, "nm"),
        ("emittance y", 1e9 * ring.emittance_y, "nm"),
        ("points of the optics", len(ring.optics.weight), ""),
    ]
    if "operation" in read_toml(path, "a ring").table:
        operation = read_operation(path)
        said += [
            ("RF voltage", operation.rf_voltage / 1e3, "kV"),
            ("bunches", operation.bunches, ""),
            ("pressure without beam", operation.pressure_base, "Pa"),
        ]
    return [
        Fact(label, f"{float(v):.6g} {unit}".strip(), {"value": float(v), "unit": unit or "1"})
        for label, v, unit in said
    ]


def of_run(run: Run) -> list[Fact]:
    """Rows, steps, and the range of every input and output."""
    span = float(run.time[-1] - run.time[0])
    step = "at unequal distances" if run.step is None else f"every {run.step:.4g} s"
    value = {"count": len(run), "span_s": span, "step_s": run.step}
    facts = [Fact("rows", f"{len(run)} over {span:.4g} s, {step}", value)]
    for name, values in run.inputs.items():
        facts.append(_range(f"input {name}", values))
    for name, values in run.outputs.items():
        missing = int(np.isnan(values).sum())
        after = f", {missing} not read" if missing else ""
        facts.append(_range(f"output {name}", values, after=after, missing=missing))
    return facts


def of_formulation(document: Document) -> list[Fact]:
    """What is free, limited and best in a formulation, and what goes in and out."""
    said = {
        "inputs": [part.name for part in document.mapping.inputs],
        "outputs": [part.name for part in document.mapping.outputs],
    }
    if (problem := document.problem) is not None:
        said["variables"] = [v.label for v in problem.variables]
        said["constraints"] = [c.label for c in problem.limits]
        said["objectives"] = [goal.label for goal in problem.goals]
    return [Fact(label, ", ".join(names) or "none", names) for label, names in said.items()]
