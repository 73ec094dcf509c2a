"""What a command about a scan is given: the scan, its lattice, other ways of taking the sizes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import NamedTuple

from beamfit.errors import InputError
from beamfit.io.emittance_gui import EmittanceGuiFile, is_emittance_gui, read_emittance_gui
from beamfit.io.lattice import LatticeFile
from beamfit.io.line import lattice_of
from beamfit.io.measurement import read_quad_scan
from beamfit.studies.scan.scans import QuadScan


class Inputs(NamedTuple):
    """A scan and its lattice, checked to fit together.

    Attributes
    ----------
    scan : QuadScan
        The scan.
    lattice : LatticeFile
        Its lattice; of rows with matrices of their own the place where these begin.
    digests : dict of str to str
        Input files and their SHA-256.
    gui : EmittanceGuiFile or None
        The file of emittance_gui, where the scan is one.
    """

    scan: QuadScan
    lattice: LatticeFile
    digests: Mapping[str, str | None]
    gui: EmittanceGuiFile | None = None


def read_inputs(
    scan: str,
    lattice: str | None = None,
    *,
    use: str | None = None,
    energy: float | None = None,
    particle: str | None = None,
    first: str | None = None,
    last: str | None = None,
    screen: str | None = None,
    ignore: Iterable[str] = (),
    skip_bad: bool = False,
    size_method: str | None = None,
) -> Inputs:
    """Read a scan of any kind, and its lattice.

    Parameters
    ----------
    scan : str
        CSV, HDF5, or a file of emittance_gui (``.mat``).
    lattice, use, energy, particle, first, last, screen
        As for `beamfit.io.line.lattice_of`. A file of emittance_gui has its own matrices, which a
        lattice replaces.
    ignore, skip_bad
        As for `beamfit.read_quad_scan`.
    size_method : str, optional
        Which sizes of a file of emittance_gui; RMS if None.

    Returns
    -------
    Inputs

    Raises
    ------
    InputError
        If a file cannot be used, the two do not fit together, or an option does not apply.
    """
    part = {"use": use, "energy": energy, "particle": particle}
    part |= {"first": first, "last": last, "screen": screen}
    if not is_emittance_gui(scan):
        if size_method is not None:
            expected = "none: only a .mat file of emittance_gui has several"
            raise InputError(f"--size-method {size_method}", expected, path=scan)
        measured = read_quad_scan(scan, ignore=ignore, skip_bad=skip_bad)
        described = lattice_of(measured, lattice, **part)
        return Inputs(measured, described, _digests(scan, measured, lattice, described))
    if skip_bad or tuple(ignore):
        expected = "none: failed settings are left out as the file marks them"
        raise InputError("--ignore or --skip-bad for a MATLAB file", expected, path=scan)
    gui = read_emittance_gui(scan)
    measured = gui.scan(size_method)
    if lattice is None:
        if told := next((name for name, value in part.items() if value is not None), None):
            said = {"first": "from", "last": "to"}.get(told, told)
            raise InputError(f"--{said} for a MATLAB file", "none: the file says it", path=scan)
        return Inputs(measured, gui.lattice, {scan: measured.sha256}, gui)
    note = "The lattice's matrices are used, and not those of the file."
    measured = replace(measured, transfer=None, energy=None, notes=(*measured.notes, note))
    described = lattice_of(measured, lattice, **part)
    return Inputs(measured, described, _digests(scan, measured, lattice, described))


def _digests(
    scan: str, measured: QuadScan, lattice: str | None, described: LatticeFile
) -> dict[str, str | None]:
    return {scan: measured.sha256} | ({} if lattice is None else {lattice: described.sha256})
