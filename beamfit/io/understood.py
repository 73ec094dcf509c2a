"""What a file says, as beamfit reads it: for a person to see before anything is fitted."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any

from beamfit.errors import InputError
from beamfit.io import facts
from beamfit.io.archive import archive_sheet
from beamfit.io.columns import Columns, Layout, arranged, layout_of, proposal
from beamfit.io.decay_record import read_lifetime_input
from beamfit.io.emittance_gui import is_emittance_gui, read_emittance_gui
from beamfit.io.facts import Fact
from beamfit.io.files import digest
from beamfit.io.line import FOREIGN, build_line, read_lattice
from beamfit.io.measurement import read_quad_scan
from beamfit.io.record_columns import is_current, known
from beamfit.io.record_columns import likely_name as record_name
from beamfit.io.ring import read_ring
from beamfit.io.run import read_run
from beamfit.io.scan_columns import is_known, is_size
from beamfit.io.scan_columns import likely_name as scan_name
from beamfit.io.table import header_of, is_binary
from beamfit.io.toml import read_toml
from beamfit.studies.scan.scans import QuadScan
from beamfit.table import Table


@dataclass(frozen=True)
class Understood:
    """What a file was understood to say.

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
    kind, notes = _kind(path, layout), ()
    reading = {"columns": layout or None, "ignore": ignore, "skip_bad": skip_bad}
    if kind == "scan":
        gui = read_emittance_gui(path) if is_emittance_gui(path) else None
        content = read_quad_scan(path, **reading) if gui is None else gui.scan()
        told, notes = facts.of_scan(content), (*content.notes, *_questions(content))
        if gui is not None:
            told.append(Fact("size methods", ", ".join(gui.scans), list(gui.scans)))
    elif kind == "lattice":
        foreign = Path(path).suffix.lower() in FOREIGN
        content = read_lattice(path, use=use, energy=energy) if foreign else read_lattice(path)
        told = facts.of_lattice(content)
    elif kind == "record":
        content = read_lifetime_input(path, **reading)
        told, notes = facts.of_record(content), content.notes
    elif kind == "run":
        content = read_run(path, **reading)
        told, notes = facts.of_run(content), content.notes
    elif kind == "formulation":
        from beamfit.io.formulation import read_formulation  # scipy

        content = read_formulation(path)
        told = facts.of_formulation(content)
    else:
        content = read_ring(path)
        told = facts.of_ring(path, content)
    return Understood(str(path), kind, digest(path), tuple(told), notes, content)


def proposed_layout(path: str | PathLike[str], columns: Columns = None) -> str | None:
    """Write a layout for the columns of a table that nobody knows; None where there are none."""
    layout = layout_of(columns)
    if _kind(path, layout) not in ("scan", "record") or is_emittance_gui(path):
        return None
    sheet = arranged(archive_sheet(path, True, layout.header or None), layout)
    unknown = {
        name: (scan_name(name) or record_name(name, cell), cell)
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
    from beamfit.studies.scan.questions import questions  # JAX from here on
    from beamfit.studies.scan.transport import scanned_line

    line = build_line(lattice.content)
    own = scan.content.of_particle(line.mass)
    asked = questions(own, scanned_line(own, line))
    notes = (*scan.notes, *(note for note in asked if note not in scan.notes))
    fact = Fact(label, "has all its magnets and screens", {"fits": True})
    return replace(scan, facts=(*scan.facts, fact), notes=notes)


def _kind(path: str | PathLike[str], layout: Layout) -> str:
    """What a file is, by its name and its head."""
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
    tabled = suffix == ".json" or is_binary(path)
    names = archive_sheet(path, False).names if tabled else layout.header or header_of(path)
    called = layout.called(names, path)
    names = [called.get(name, name) for name in names]
    head = ",".join(names)
    if re.search(r"\bbeta_x_m\b|\bBETX\b", head):
        found = "the optics of a ring"
        raise InputError(found, "the ring file (TOML) that names it under [optics] twiss", path)
    if {"u_", "y_"} <= {name[:2] for name in names}:
        return "run"
    archived = {"secs", "nanos"} <= set(names)
    current = any(map(is_current, names)) and not any(map(is_size, names))
    return "record" if archived or current else "scan"


def _questions(scan: QuadScan) -> tuple[str, ...]:
    from beamfit.studies.scan.questions import of_sizes

    return tuple(of_sizes(scan))
