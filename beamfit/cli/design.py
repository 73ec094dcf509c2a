"""`beamfit design`: a scan and a lattice in, the measurements to make next out."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from beamfit.cli.assumptions import anchor_of, bounds_of, check_magnets, limits_of, priors_of
from beamfit.cli.document import command_line, json_text
from beamfit.errors import InputError
from beamfit.io.line import build_line, read_lattice
from beamfit.io.measurement import read_quad_scan
from beamfit.studies.scan.assumptions import SCENARIOS, Assumptions
from beamfit.studies.scan.scans import check_names
from beamfit.table import text_of

if TYPE_CHECKING:
    from beamfit.io.lattice import LatticeFile
    from beamfit.studies.scan.design import Advice

__all__ = ["design"]

# MeV, as for the energy of a lattice.
HIGHEST = 1e7

EXAMPLE = """\b
Examples:
  beamfit design scan.csv --lattice line.toml --vary Q2=0:5 --goal 0.8%
  beamfit design measurements/gtf_simulated.csv --lattice lattices/gtf.toml --scenario calibration
"""


@click.command(epilog=EXAMPLE)
@click.argument("scan", type=click.Path())
@click.option("--lattice", required=True, type=click.Path(), metavar="FILE", help="Lattice.")
@click.option(
    "--scenario",
    type=click.Choice(SCENARIOS),
    default="known",
    show_default=True,
    help="What is unknown besides the beam.",
)
@click.option("--prior", multiple=True, metavar="NAME=MEAN+-SD", help="As for beamfit emittance.")
@click.option("--bounds", multiple=True, metavar="NAME=LOW:HIGH", help="As for beamfit emittance.")
@click.option("--anchor", multiple=True, metavar="ANCHOR", help="As for beamfit emittance.")
@click.option(
    "--vary",
    multiple=True,
    metavar="MAGNET=LOW:HIGH",
    help="Machine limits of a magnet; by default the scanned ones, half their range beyond.",
)
@click.option(
    "--energies", metavar="MEV,MEV", default="", help="Further energies the beam can be had at."
)
@click.option(
    "--criterion",
    type=click.Choice(["emittance", "D"]),
    default="emittance",
    show_default=True,
    help="Make small the error of the emittance, or the volume of the error ellipsoid.",
)
@click.option("--goal", metavar="PERCENT", default=None, help="Emittance error to stop at.")
@click.option("--count", type=int, default=5, show_default=True, help="Most measurements.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object and nothing else.")
def design(
    scan: str,
    lattice: str,
    scenario: str,
    prior: tuple[str, ...],
    bounds: tuple[str, ...],
    anchor: tuple[str, ...],
    vary: tuple[str, ...],
    energies: str,
    criterion: str,
    goal: str | None,
    count: int,
    as_json: bool,
) -> None:
    """Say which settings to measure next, given what is measured, and when to stop.

    For a scenario that the data do not identify it says which kind of measurement would.
    """
    told = Assumptions(priors_of(prior), bounds_of(bounds), anchor_of(anchor))
    told.check_scenario(scenario)
    limits = limits_of(vary) if vary else None
    aim, others = _percent(goal), _energies(energies)
    measured, described = read_quad_scan(scan), read_lattice(lattice)
    check_names(
        measured,
        described.calibrations,
        described.places,
        described.default_screen,
        described.rest_energy,
    )
    check_magnets(limits or {}, described)
    _check_energies(others, described)

    from beamfit.studies.scan.design import plan_measurements  # JAX from here on
    from beamfit.studies.scan.emittance import fit_emittance

    fit = fit_emittance(measured, build_line(described), scenario=scenario, **vars(told))
    advice = plan_measurements(
        fit, limits=limits, criterion=criterion, goal=aim, count=count, energies=others
    )
    if as_json:
        inputs = {str(scan): measured.sha256, str(lattice): described.sha256}
        click.echo(json_text(command_line(), inputs, [advice.to_json()]))
    else:
        _print(advice, f"{fit.scan.name} on {fit.line.name}")


def _percent(text: str | None) -> float | None:
    if text is None:
        return None
    try:
        value = float(text.rstrip("% ")) / 100.0
    except ValueError:
        value = 0.0
    if not 0.0 < value < 1.0:
        raise InputError(f"--goal '{text}'", "a relative error in per cent, such as 1%")
    return value


def _energies(text: str) -> tuple[float, ...]:
    try:
        found = tuple(float(part) for part in text.split(",") if part.strip())
    except ValueError:
        raise InputError(f"--energies '{text}'", "numbers in MeV, such as 25,35") from None
    return found


def _check_energies(energies: tuple[float, ...], lattice: LatticeFile) -> None:
    for energy in energies:
        if not lattice.rest_energy < energy <= HIGHEST:
            raise InputError(
                f"--energies {energy:g} MeV",
                f"total energies between the {lattice.particle}'s rest energy of "
                f"{lattice.rest_energy:.6g} MeV and 10 TeV; is it in GeV or eV?",
            )


def _print(advice: Advice, title: str) -> None:
    from rich.console import Console

    from beamfit.cli.terminal import verdict_text

    console = Console(highlight=False, markup=False)
    console.print(f"{title}, scenario {advice.scenario}: error of the emittance", style="bold")
    click.echo("\n\n".join(map(text_of, advice.tables())))
    console.print(verdict_text("design", advice.status, advice.message))
