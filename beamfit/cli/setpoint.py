"""`beamfit setpoint`: a beam, a lattice and a wish in, the best magnet settings out."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import click

from beamfit.cli.assumptions import check_magnets, limits_of
from beamfit.cli.document import command_line, json_text
from beamfit.errors import InputError
from beamfit.io.line import build_line, read_lattice
from beamfit.io.result import FittedBeam, read_fitted_beams
from beamfit.quantity import Quantity

if TYPE_CHECKING:
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
# Energies that differ by less than this share are one: a magnet's setting is known no better.
SAME_ENERGY = 1e-3
CALIBRATED = (
    "The beam was fitted together with the calibration, and only the beam's covariance is in the "
    "file: the two are correlated, and without that the errors here are too large, on the GTF line "
    "1.2 to 4.6 times."
)
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
    wishes = [_wish(text, plane) for text in target]
    described = read_lattice(lattice, use=use, energy=energy)
    check_magnets(limits, described)
    beams = (
        read_fitted_beams(fitted, described.rest_energy)
        if sigma is None
        else {plane: _given(sigma)}
    )
    used = {p: beams[p] for p in dict.fromkeys(p for _, p, _ in wishes) if p in beams}
    own = _energy(used, fitted, energy)

    from beamfit.studies.scan.setpoint import Beam, Target, find_setpoint  # JAX from here on

    line = build_line(described)
    if own is not None:
        line = replace(line, energy=own)
    for beam in beams.values():
        line = _recalibrated(line, beam.calibration)
    wanted = [Target(kind, p, value or _design(line, p)) for kind, p, value in wishes]
    place = screen
    if place is None and line.design and all(v is None for _, _, v in wishes):
        place = line.design.at
    found = find_setpoint(
        line,
        {p: Beam(b.sigma, b.covariance) for p, b in beams.items()},
        limits,
        wanted,
        screen=place,
    )
    inputs = {str(lattice): described.sha256}
    if fitted is not None:
        from beamfit.io.files import digest

        inputs[fitted] = digest(fitted)
    doubted = {p: beam.doubt for p, beam in used.items() if beam.doubt is not None}
    notes = _notes(found, used, described.energy)
    if as_json:
        message = " ".join([found.message, *notes, *_warnings(doubted)])
        entry = found.to_json() | {"message": message, "beam_undetermined": list(doubted)}
        click.echo(json_text(command_line(), inputs, [entry]))
    else:
        _print(found, line.name, notes, _warnings(doubted))


def _check_one(sigma: str | None, fitted: str | None) -> None:
    if (sigma is None) == (fitted is None):
        said = "neither --sigma nor --fit" if sigma is None else "both --sigma and --fit"
        raise InputError(said, "one of them: the beam at the start of the line")


def _given(sigma: str) -> FittedBeam:
    """Read --sigma."""
    import numpy as np

    try:
        numbers = [float(part) for part in sigma.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 3:
        raise InputError(f"--sigma '{sigma}'", "three numbers S11,S12,S22 in m², m rad, rad²")
    return FittedBeam(np.array(numbers))


def _wish(text: str, plane: str) -> tuple[str, str, object]:
    """Kind, plane and value of a target; None for the lattice's own design."""
    name, _, rest = text.partition("=")
    kind, _, own = name.strip().partition("_")
    if kind not in (*UNITS, "match") or own not in ("", "x", "y"):
        raise InputError(f"--target '{text}'", WISH)
    own = own or plane
    if kind == "match":
        if not rest:
            return kind, own, None
        try:
            beta, alpha = (float(part) for part in rest.split(":"))
        except ValueError:
            raise InputError(f"--target '{text}'", WISH) from None
        return kind, own, (beta, alpha)
    # The Greek letter mu and the micro sign look alike.
    parts = re.fullmatch(r"\s*([-+0-9.eE]+)\s*([a-zµ]+)\s*", rest.replace("\u03bc", "\u00b5"))
    try:
        return kind, own, float(parts[1]) * UNITS[kind][parts[2]]
    except (TypeError, ValueError, KeyError):
        raise InputError(
            f"--target '{text}'", f"a number with a unit: {', '.join(UNITS[kind])}"
        ) from None


def _energy(
    beams: Mapping[str, FittedBeam], fitted: str | None, asked: float | None
) -> float | None:
    """Energy the beams were measured at, MeV; None where they do not say.

    A beam matrix in geometric units holds at its own energy only.
    """
    found = {f"plane {p}": b.energy for p, b in beams.items() if b.energy is not None}
    given = found if asked is None else found | {"--energy": asked}
    if found and max(given.values()) - min(given.values()) > SAME_ENERGY * min(given.values()):
        listed = ", ".join(f"{e:g} MeV ({name})" for name, e in given.items())
        raise InputError(f"energies {listed}", "one energy for beam and line", path=fitted)
    return next(iter(found.values()), None)


def _notes(found: Setpoint, beams: Mapping[str, FittedBeam], lattice: float) -> list[str]:
    """What to know of the answer, one sentence each."""
    said = []
    if abs(found.energy - lattice) > SAME_ENERGY * lattice:
        said.append(
            f"At {found.energy:g} MeV, the energy of the scan; the lattice has {lattice:g} MeV."
        )
    if any(beam.calibration and beam.covariance is not None for beam in beams.values()):
        said.append(CALIBRATED)
    if all(beam.covariance is None and beam.doubt is None for beam in beams.values()):
        said.append("No errors: the beam was given without its own (--fit brings them).")
    return said


def _warnings(doubted: Mapping[str, str]) -> list[str]:
    return [
        f"The fit does not determine the beam of plane {plane}: {why.rstrip('.')}. The settings "
        "are for its numbers as they stand."
        for plane, why in doubted.items()
    ]


def _design(line, plane: str) -> tuple[float, float]:
    twiss = getattr(line.design, plane, None)
    if twiss is None:
        raise InputError(
            f"--target match in plane {plane} of a lattice without design Twiss",
            "match=BETA_M:ALPHA, or a table [design] in the lattice",
        )
    return twiss


def _recalibrated(line, numbers: dict[str, float]):
    """Put fitted calibration numbers into the line, so that the beam meets its own magnets."""
    if not numbers:
        return line
    from beamfit.studies.scan.calibration import with_numbers

    return with_numbers(line, numbers)


def _print(found: Setpoint, line: str, notes: list[str], warnings: list[str]) -> None:
    from rich.console import Console

    from beamfit.cli.terminal import plain_table, verdict_text

    console = Console(highlight=False, markup=False)
    table = plain_table(f"Best settings of {line} for the beam at {found.screen}")
    for name in ("", "setting", "± from the beam"):
        table.add_column(name)
    for name, value in found.best.settings.items():
        unit, error = found.units[name], found.setting_error[name]
        table.add_row(name, f"{value:.6g} {unit}", "-" if error is None else f"{error:.2g} {unit}")
    table.add_row("objective", f"{found.best.objective:.6g}", "")
    for p in found.predicted:
        for key in ("size", "divergence", "beta", "alpha"):
            table.add_row(f"{key} {p.plane}", _shown(key, getattr(p, key)), "")
    console.print(table)
    if len(found.others):
        console.print("\nOther minima", style="bold")
        for m in found.others[:5]:
            at = ", ".join(f"{n} = {v:.5g} {found.units[n]}" for n, v in m.settings.items())
            console.print(f"  {at}: objective {m.objective:.6g}")
    console.print(verdict_text("set point", found.status, found.message))
    for note in notes:
        console.print(note)
    for warning in warnings:
        console.print(warning, style="bold red")


def _shown(key: str, q) -> str:
    """A predicted number; one without an error is a prediction all the same."""
    factor, unit = {"size": (1e6, " µm"), "divergence": (1e6, " µrad"), "beta": (1.0, " m")}.get(
        key, (1.0, "")
    )
    if q.error is None:
        return f"{factor * q.value:.5g}{unit}"
    return f"{Quantity(factor * q.value, factor * q.error, '1')}{unit}"
