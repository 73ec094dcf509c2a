"""Read lattices of any format, build beam lines, and read the inputs of a command."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from itertools import repeat
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from beamfit.emittance.scan import QuadScan
from beamfit.errors import InputError, expect, nearest
from beamfit.io.columns import Columns
from beamfit.io.dialects import DIALECTS
from beamfit.io.emittance_gui import EmittanceGuiFile, is_emittance_gui, read_emittance_gui
from beamfit.io.lattice import LatticeFile, element_of, read_toml_lattice
from beamfit.io.scan import read_quad_scan
from beamfit.particles import REST_ENERGY, expected_energy

if TYPE_CHECKING:
    from beamfit.optics.beamline import Beamline

# Name of the place at which matrices in rows of a scan start.
MATRIX_START = "start"
# Suffixes of files of MAD-X, MAD-8 and elegant.
PROGRAM_SUFFIXES = {".ele", *DIALECTS}


def load_lattice(
    path: str | PathLike[str],
    *,
    use: str | None = None,
    energy: float | None = None,
    first: str | None = None,
    last: str | None = None,
    screen: str | None = None,
) -> Beamline:
    """Read a beam line from a file.

    Parameters
    ----------
    path : str or path
        A TOML lattice (docs/files.md), or a MAD-X (``.madx``, ``.seq``), MAD-8 (``.mad8``)
        or elegant (``.lte``) file.
    use : str, optional
        Line or sequence of a MAD-X or elegant file.
    energy : float, optional
        Total energy in MeV, for an elegant file, which has none; overrides a BEAM of MAD-X.
    first, last, screen
        As for `part_of`.

    Returns
    -------
    Beamline
        The line.

    Raises
    ------
    InputError
        If the file cannot be used, naming file, line and key.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> file = pathlib.Path(tempfile.mkdtemp()) / "line.toml"
    >>> _ = file.write_text('''format = "beamfit-lattice-1"
    ... energy_MeV = 135.0
    ... [[element]]
    ... type = "quadrupole"
    ... name = "Q"
    ... length_m = 0.108
    ... integrated_gradient_kG = -3.0
    ... [[element]]
    ... type = "screen"
    ... name = "OTR"
    ... ''')
    >>> load_lattice(file).magnets
    ('Q',)
    """
    file = read_lattice(path, use=use, energy=energy, first=first, last=last, screen=screen)
    return build_line(file)


def part_of(
    file: LatticeFile, first: str | None = None, last: str | None = None, screen: str | None = None
) -> LatticeFile:
    """Take a part of a lattice, and set the default screen.

    Parameters
    ----------
    file : LatticeFile
        The lattice.
    first, last : str, optional
        First and last element of the part, both included, as in a RANGE of MAD-X.
    screen : str, optional
        Screen or marker at which sizes are measured. Screens after it remain as markers.

    Returns
    -------
    LatticeFile
        Without design Twiss parameters if their place is not in the part.

    Raises
    ------
    InputError
        If there is no such element, or the last is upstream of the first.

    Examples
    --------
    >>> kinds = ("marker", "drift", "screen", "marker")
    >>> elements = tuple({"type": k, "name": n, "length_m": 1.0} for k, n in zip(kinds, "ABCD"))
    >>> whole = LatticeFile("a.toml", "", "a", 135.0, "electron", elements)
    >>> part = part_of(whole, "B", "D", screen="D")
    >>> [e["name"] for e in part.elements], part.default_screen
    (['B', 'C', 'D'], 'D')
    """
    names = [e["name"] for e in file.elements]
    for option, name in (("--from", first), ("--to", last)):
        if name is not None and name not in names:
            raise InputError(f"{option} {name}: no such element", nearest(name, names), file.path)
    if screen is not None and screen not in file.places:
        nearest_places = nearest(screen, file.places) + ", a screen or marker"
        raise InputError(f"--screen {screen}: no such place", nearest_places, file.path)
    start = 0 if first is None else names.index(first)
    end = len(names) if last is None else len(names) - names[::-1].index(last)
    if start >= end:
        expected = "the upstream element after --from"
        raise InputError(f"--to {last}, which stands before --from {first}", expected, file.path)
    elements = file.elements[start:end]
    if screen is not None:
        elements = _move_screen(elements, screen)
    remaining = {e["name"] for e in elements} | {e.get("supply") for e in elements}
    if screen is not None and screen not in remaining:
        raise InputError(f"--screen {screen}, which is cut away", "a place within", file.path)
    design = file.design if file.design and file.design["at"] in remaining else None
    return replace(file, elements=elements, design=design)


def _move_screen(
    elements: tuple[Mapping[str, Any], ...], screen: str
) -> tuple[Mapping[str, Any], ...]:
    """Make a screen or marker the last screen."""
    changed, is_after = [], False
    for e in elements:
        if e["name"] == screen and e["type"] in ("screen", "marker"):
            e, is_after = dict(e) | {"type": "screen"}, True
        elif is_after and e["type"] == "screen":
            e = {"type": "marker", "name": e["name"]}
        changed.append(e)
    return tuple(changed)


def read_lattice(
    path: str | PathLike[str],
    *,
    use: str | None = None,
    energy: float | None = None,
    **part: str | None,
) -> LatticeFile:
    """Read and check a lattice file of any format without building it; see `load_lattice`."""
    expect(path, str | PathLike, "'line.toml'")
    if Path(path).suffix.lower() in PROGRAM_SUFFIXES:
        from beamfit.io.sequence import read_sequence

        return part_of(read_sequence(path, use=use, energy=energy), **part)
    for option, value, source in (("use", use, "one line"), ("energy", energy, "energy_MeV")):
        if value is not None:
            raise InputError(
                f"--{option} for a TOML lattice", f"none: the file has {source}", path=path
            )
    return part_of(read_toml_lattice(path), **part)


def lattice_of(
    scan: QuadScan,
    path: str | LatticeFile | None = None,
    *,
    energy: float | None = None,
    particle: str | None = None,
    **part: str | None,
) -> LatticeFile:
    """Read the lattice of a scan, or make one for rows with their own transfer matrices.

    Parameters
    ----------
    scan : QuadScan
        The scan.
    path : str or LatticeFile, optional
        The lattice or its path; None if the rows have matrices.
    energy, **part
        Options of `load_lattice`; the energy in MeV also applies to rows with matrices.
    particle : str, optional
        Particle of rows with matrices; default: electron.

    Returns
    -------
    LatticeFile
        Checked to have the magnets and screens of the scan.

    Raises
    ------
    InputError
        As `read_lattice` and `LatticeFile.check_scan`; if both or neither of matrices and lattice
        are given, or rows with matrices have no energy.
    """
    if scan.transfer is None:
        if path is None:
            expected = "--lattice FILE, or columns r11_x, r12_x, ... of every row"
            raise scan.unusable("a scan and no lattice", expected)
        if particle is not None:
            raise InputError("--particle with a lattice", "none: the lattice says it", path=path)
        is_read = isinstance(path, LatticeFile)
        file = path if is_read else read_lattice(path, energy=energy, **part)
        file.check_scan(scan)
        return file
    if any(option is not None for option in (path, *part.values())):
        found = "rows with matrices of their own, and a lattice or a part of one"
        raise scan.unusable(found, "no --lattice, --use, --from, --to and --screen")
    return _matrix_lattice(scan, energy, particle or "electron")


def _matrix_lattice(scan: QuadScan, energy: float | None, particle: str) -> LatticeFile:
    """Lattice of rows with their own matrices: their screens, and the start of the matrices."""
    rest_energy = REST_ENERGY[particle]
    energies = scan.of_particle(rest_energy).energy
    if energy is None and energies is None:
        raise scan.unusable("no beam energy", "a column energy_MeV, or --energy in MeV")
    beam_energy = float(energies.mean()) if energy is None else energy
    if expected := expected_energy(beam_energy, particle):
        raise scan.unusable(f"an energy of {beam_energy:g} MeV", expected, "energy")
    names = [name for name in dict.fromkeys(scan.screen or ()) if name != MATRIX_START]
    return LatticeFile(
        path=scan.path or scan.name,
        sha256=scan.sha256 or "",
        name="matrices of the rows",
        energy=beam_energy,
        particle=particle,
        elements=tuple({"type": "screen", "name": name} for name in (*names, MATRIX_START)),
    )


def build_line(file: LatticeFile) -> Beamline:
    """Build the beam line of a checked lattice file.

    Examples
    --------
    >>> lattice = LatticeFile("a.toml", "", "a", 135.0, "electron",
    ...                       ({"type": "drift", "name": "D", "length_m": 2.0},))
    >>> build_line(lattice).length
    2.0
    """
    from beamfit.optics.beamline import Beamline, Design

    mass, design = file.rest_energy, None
    if file.design is not None:
        twiss = {p: (t["beta_m"], t["alpha"]) for p, t in file.design.items() if p != "at"}
        design = Design(at=file.design["at"], **twiss)
    supplies: dict[str, tuple[str, ...]] = {}
    for table in (e for e in file.elements if "supply" in e):
        supplies[table["supply"]] = (*supplies.get(table["supply"], ()), table["name"])
    return Beamline(
        tuple(map(element_of, file.elements, repeat(mass))),
        energy=file.energy,
        name=file.name,
        mass=mass,
        energy_spread=file.energy_spread,
        design=design,
        supplies=tuple(supplies.items()),
    )


class Inputs(NamedTuple):
    """Scan and its lattice, checked against each other.

    Attributes
    ----------
    scan : QuadScan
        The scan.
    lattice : LatticeFile
        Its lattice; see `lattice_of`.
    gui : EmittanceGuiFile or None
        The emittance_gui file, if the scan is from one.
    """

    scan: QuadScan
    lattice: LatticeFile
    gui: EmittanceGuiFile | None = None

    @property
    def digests(self) -> dict[str, str | None]:
        """SHA-256 of the files."""
        return {str(each.path): each.sha256 for each in (self.scan, self.lattice)}


def read_inputs(
    scan: str,
    lattice: str | LatticeFile | None = None,
    *,
    columns: Columns = None,
    ignore: Iterable[str] = (),
    skip_bad: bool = False,
    size_method: str | None = None,
    **part: Any,
) -> Inputs:
    """Read a scan of any format, and its lattice.

    Parameters
    ----------
    scan : str
        CSV, HDF5, or a file of emittance_gui (``.mat``).
    lattice : str or LatticeFile, optional
        As for `lattice_of`. It replaces the matrices in a file of emittance_gui.
    columns, ignore, skip_bad
        As for `beamfit.read_quad_scan`.
    size_method : str, optional
        Size method of a file of emittance_gui; default: RMS.
    **part
        Options of `lattice_of`.

    Returns
    -------
    Inputs

    Raises
    ------
    InputError
        If a file cannot be used, the two do not fit together, or an option does not apply.
    """
    if not is_emittance_gui(scan):
        if size_method is not None:
            expected = "none: only a .mat file of emittance_gui has several"
            raise InputError(f"--size-method {size_method}", expected, path=scan)
        quad_scan = read_quad_scan(scan, columns=columns, ignore=ignore, skip_bad=skip_bad)
        return Inputs(quad_scan, lattice_of(quad_scan, lattice, **part))
    if skip_bad or tuple(ignore) or columns is not None:
        expected = "none: the file says its columns, and marks failed settings"
        raise InputError("--columns, --ignore or --skip-bad for a MATLAB file", expected, path=scan)
    gui = read_emittance_gui(scan)
    quad_scan = gui.scan(size_method)
    if lattice is None:
        if name := next((name for name, value in part.items() if value is not None), None):
            option = {"first": "from", "last": "to"}.get(name, name)
            raise InputError(f"--{option} for a MATLAB file", "none: the file says it", path=scan)
        return Inputs(quad_scan, gui.lattice, gui)
    note = "The lattice's matrices are used, and not those of the file."
    quad_scan = replace(quad_scan, transfer=None, energy=None, notes=(*quad_scan.notes, note))
    return Inputs(quad_scan, lattice_of(quad_scan, lattice, **part))
