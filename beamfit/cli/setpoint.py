"""`beamfit setpoint`: a beam, a lattice and a wish in, the best magnet settings out."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

import click
import numpy as np

from beamfit.cli.assumptions import check_magnets, limits_of
from beamfit.cli.document import command_line, json_text
from beamfit.errors import InputError
from beamfit.io.files import digest
from beamfit.io.line import build_line, read_lattice
from beamfit.io.result import read_fitted_beams
from beamfit.studies.scan.wishes import Beam, Target, common_energy
from beamfit.table import text_of

if TYPE_CHECKING:
    from beamfit.io.lattice import LatticeFile
    from beamfit.studies.scan.setpoint import Setpoint

__all__ = ["setpoint"]

EXAMPLE = """\b
Examples:
  beamfit setpoint --lattice lattices/gtf.toml \\
    --sigma 2.6367971e-8,1.5738242e-8,1.4354411e-8 \\
    --vary Q2=0:10 --target size=200um --target divergence=140urad
  beamfit emittance scan.csv --lattice line.toml --json > fit.json
  beamfit setpoint --lattice line.toml --fit fit.json --vary Q1=-5:0 --vary Q2=0:5 --target match
"""
UNITS = {
    "size": {"nm": 1e-9, "um": 1e-6, "µm": 1e-6, "mm": 1e-3, "m": 1.0},
    "divergence": {"nrad": 1e-9, "urad": 1e-6, "µrad": 1e-6, "mrad": 1e-3, "rad": 1.0},
}
WISH = "size=200um, divergence=140urad (with _x or _y), match, or match=BETA_M:ALPHA"


@click.command(epilog=EXAMPLE)
@click.option(
    "--lattice",
    required=True,
    type=click.Path(),
    metavar="FILE",
    help="Lattice, from where the beam is known to the screen.",
)
@click.option(
    "--sigma",
    metavar="S11,S12,S22",
    default=None,
    help="Beam matrix of the plane at the start, in m², m rad, rad².",
)
@click.option(
    "--fit",
    "fitted",
    type=click.Path(),
    metavar="RESULT.json",
    default=None,
    help="Output of beamfit emittance --json: the beam with its errors, at the scan's energy.",
)
@click.option(
    "--vary",
    multiple=True,
    metavar="MAGNET=LOW:HIGH",
    help="A magnet and its limits, in the unit of its calibration.",
)
@click.option(
    "--target",
    multiple=True,
    metavar="WISH",
    help="size=200um, divergence=140urad, match (to the lattice's design Twiss) or "
    "match=BETA_M:ALPHA; size_y and so on for a plane by name.",
)
@click.option(
    "--plane",
    type=click.Choice(["x", "y"]),
    default="x",
    show_default=True,
    help="Plane of --sigma and of targets that name none.",
)
@click.option("--screen", metavar="NAME", default=None, help="Where; the last screen by default.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object and nothing else.")
@click.option(
    "--use", metavar="NAME", default=None, help="Line or sequence of a MAD-X or elegant file."
)
@click.option("--energy", type=float, metavar="MEV", default=None, help="Total energy.")
def setpoint(
    lattice: str,
    sigma: str | None,
    fitted: str | None,
    vary: tuple[str, ...],
    target: tuple[str, ...],
    plane: str,
    screen: str | None,
    as_json: bool,
    use: str | None,
    energy: float | None,
) -> None:
    """Find the magnet settings that bring the beam nearest to a wanted size and divergence.

    The search is global within the limits: local minima are listed, not mistaken for the answer.
    """
    _check_one(sigma, fitted)
    limits = limits_of(vary)
    targets = [_wish(text, plane) for text in target]
    described = read_lattice(lattice, use=use, energy=energy)
    check_magnets(limits, described)
    beams = _given(sigma, plane) if fitted is None else _fitted(fitted, described, targets, energy)

    from beamfit.studies.scan.setpoint import find_setpoint  # JAX from here on

    found = find_setpoint(build_line(described), beams, limits, targets, screen=screen)
    inputs = {str(lattice): described.sha256} | ({} if fitted is None else {fitted: digest(fitted)})
    if as_json:
        click.echo(json_text(command_line(), inputs, [found.to_json()]))
    else:
        _print(found)


def _check_one(sigma: str | None, fitted: str | None) -> None:
    if (sigma is None) == (fitted is None):
        said = "neither --sigma nor --fit" if sigma is None else "both --sigma and --fit"
        raise InputError(said, "one of them: the beam at the start of the line")


def _given(sigma: str | None, plane: str) -> dict[str, Beam]:
    """Read --sigma."""
    try:
        numbers = [float(part) for part in (sigma or "").split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 3:
        raise InputError(f"--sigma '{sigma}'", "three numbers S11,S12,S22 in m², m rad, rad²")
    return {plane: Beam(np.array(numbers))}


def _fitted(
    path: str, lattice: LatticeFile, targets: Sequence[Target], energy: float | None
) -> dict[str, Beam]:
    """Read --fit, and refuse before JAX is loaded what was measured at another energy."""
    beams = read_fitted_beams(path, lattice.rest_energy)
    asked_for = {t.plane for t in targets}
    try:
        common_energy({p: beam for p, beam in beams.items() if p in asked_for}, energy)
    except InputError as error:
        error.path = path
        raise
    return beams


def _wish(text: str, plane: str) -> Target:
    """Kind, plane and value of a target; None for the lattice's own design."""
    name, _, rest = text.partition("=")
    kind, _, own = name.strip().partition("_")
    if kind not in (*UNITS, "match") or own not in ("", "x", "y"):
        raise InputError(f"--target '{text}'", WISH)
    own = own or plane
    if kind == "match":
        if not rest:
            return Target(kind, own)
        try:
            beta, alpha = (float(part) for part in rest.split(":"))
        except ValueError:
            raise InputError(f"--target '{text}'", WISH) from None
        return Target(kind, own, (beta, alpha))
    # The Greek letter mu and the micro sign look alike.
    parts = re.fullmatch(r"\s*([-+0-9.eE]+)\s*([a-zµ]+)\s*", rest.replace("\u03bc", "\u00b5"))
    try:
        return Target(kind, own, float(parts[1]) * UNITS[kind][parts[2]])
    except (TypeError, ValueError, KeyError):
        raise InputError(
            f"--target '{text}'", f"a number with a unit: {', '.join(UNITS[kind])}"
        ) from None


def _print(found: Setpoint) -> None:
    from rich.console import Console

    from beamfit.cli.terminal import verdict_text

    console = Console(highlight=False, markup=False)
    click.echo("\n\n".join(map(text_of, found.tables())))
    console.print(verdict_text("set point", found.status, found.message))
    for note in found.notes:
        console.print(note)
    for warning in found.doubts.values():
        console.print(warning, style="bold red")
