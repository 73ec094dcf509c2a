"""`beamfit setpoint`: the best magnet settings for a beam, a lattice and targets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import click
import numpy as np

import beamfit
from beamfit.answer import text_of
from beamfit.cli.option_text import target_of
from beamfit.cli.options import Command, Output, option, options
from beamfit.emittance.targets import Beam, Target, check_beam, check_limits, common_energy
from beamfit.errors import InputError, located
from beamfit.io.files import digest
from beamfit.io.line import build_line, read_lattice
from beamfit.io.result import read_fitted_beams

if TYPE_CHECKING:
    from beamfit.cli.show import Terminal
    from beamfit.emittance.setpoint import Setpoint
    from beamfit.io.lattice import LatticeFile

EXAMPLE = """\b
Examples:
  beamfit setpoint --lattice lattices/gtf.toml \\
    --sigma 2.6367971e-8,1.5738242e-8,1.4354411e-8 \\
    --vary Q2=0:10 --target size=200um --target divergence=140urad
  beamfit emittance scan.csv --lattice line.toml --json > fit.json
  beamfit setpoint --lattice line.toml --fit fit.json --vary Q1=-5:0 --vary Q2=0:5 --target match
"""


@click.command(cls=Command, epilog=EXAMPLE)
@options("lattice use from to screen energy")
@option("--sigma S11,S12,S22", "Beam matrix of the plane at the start, in m², m rad, rad².")
@option(
    "--fit RESULT.json",
    "Output of beamfit emittance --json: the beam with its errors, at the scan's energy.",
    name="fitted",
)
@options("vary")
@option(
    "--target TARGET",
    "size=200um, divergence=140urad, match (to the lattice's design Twiss) or "
    "match=BETA_M:ALPHA; size_y and so on for a plane by name.",
    multiple=True,
)
@option(
    "--plane", "Plane of --sigma and of targets without a plane.", choices=["x", "y"], default="x"
)
@options("json")
def setpoint(
    lattice: str,
    sigma: str | None,
    fitted: str | None,
    limits: dict[str, tuple[float, float]],
    target: tuple[str, ...],
    plane: str,
    output: Output,
    **part: Any,
) -> None:
    """Find the magnet settings that bring the beam closest to a wanted size and divergence.

    The search is global within the limits; local minima are listed.
    """
    if (sigma is None) == (fitted is None):
        said = "neither --sigma nor --fit" if sigma is None else "both --sigma and --fit"
        raise InputError(said, "one of them: the beam at the start of the line")
    if not limits:
        raise InputError("no --vary", "NAME=LOW:HIGH such as Q2=0:10")
    targets = [target_of(text, plane) for text in target]
    described = read_lattice(lattice, **part)
    described.check_magnets(limits)
    check_limits(described, limits)
    if fitted is None:
        beams = _beam_of_sigma(sigma, plane)
    else:
        beams = _beams_of_fit(fitted, described, targets, part["energy"])
    _check_given(targets, beams, described)
    line = build_line(described)  # JAX from here on
    found = beamfit.find_setpoint(line, beams, limits, targets, screen=part["screen"])
    inputs = {path: digest(path) for path in (lattice, fitted) if path is not None}
    output.answer([found], inputs, lambda terminal: _show(terminal, found))


def _check_given(
    targets: Sequence[Target], beams: Mapping[str, Beam], lattice: LatticeFile
) -> None:
    """Refuse targets in a plane without a beam, or at a design that the lattice lacks."""
    for target in targets:
        plane = target.plane
        if plane not in beams:
            found = f"a target in plane {plane}, whose beam is not given"
            expected = f"--sigma with --plane {plane}, or --fit of a scan in {plane}"
            raise InputError(found, expected)
        if target.kind == "match" and target.value is None and plane not in (lattice.design or {}):
            found = f"--target match in plane {plane} without design Twiss"
            expected = "match=BETA_M:ALPHA, or a table [design] in the lattice"
            raise InputError(found, expected, lattice.path)


def _beam_of_sigma(sigma: str | None, plane: str) -> dict[str, Beam]:
    """Read --sigma."""
    try:
        numbers = [float(part) for part in (sigma or "").split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 3:
        raise InputError(f"--sigma '{sigma}'", "three numbers S11,S12,S22 in m², m rad, rad²")
    beam = Beam(np.array(numbers))
    check_beam(plane, beam.sigma)
    return {plane: beam}


def _beams_of_fit(
    path: str, lattice: LatticeFile, targets: Sequence[Target], energy: float | None
) -> dict[str, Beam]:
    """Read --fit, and refuse a beam measured at another energy before JAX is loaded."""
    beams = read_fitted_beams(path, lattice.rest_energy, lattice.sha256)
    asked_for = {t.plane for t in targets}
    with located(path):
        common_energy({p: beam for p, beam in beams.items() if p in asked_for}, energy)
    return beams


def _show(terminal: Terminal, found: Setpoint) -> None:
    terminal.verdict("set point", found.status, found.message)
    for note in found.notes:
        terminal.line(note)
    for warning in found.doubts.values():
        terminal.line(warning, style="bold red")
    terminal.line()
    click.echo("\n\n".join(map(text_of, found.tables())))
