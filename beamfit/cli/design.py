"""`beamfit design`: the measurements to make next, from a scan and a lattice."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

import beamfit
from beamfit.answer import text_of
from beamfit.cli.option_text import energies_of
from beamfit.cli.options import Command, Output, option, options
from beamfit.emittance.assumptions import Assumptions
from beamfit.emittance.targets import check_limits
from beamfit.io.line import build_line, read_inputs
from beamfit.io.priors import read_noise

if TYPE_CHECKING:
    from beamfit.cli.show import Terminal
    from beamfit.emittance.design import Advice

# Options passed to `read_inputs` with the scan.
INPUT_OPTIONS = [
    "lattice",
    "use",
    "first",
    "last",
    "screen",
    "energy",
    "columns",
    "ignore",
    "skip_bad",
]
EXAMPLE = """\b
Examples:
  beamfit design scan.csv --lattice line.toml --vary Q2=0:5 --goal 0.8%
  beamfit design measurements/gtf_simulated.csv --lattice lattices/gtf.toml --scenario calibration
"""


@click.command(cls=Command, epilog=EXAMPLE)
@options(
    "scan columns ignore skip-bad lattice use from to screen energy noise scenario prior bounds "
    "gain anchor vary"
)
@option("--energies MEV,MEV", "Other possible energies of the beam.", default="")
@option(
    "--criterion",
    "Minimise the error of the emittance, or the volume of the error ellipsoid.",
    choices=["emittance", "D"],
    default="emittance",
)
@options("goal")
@option("--count", "Largest number of measurements.", default=5)
@options("json")
def design(
    scan: str,
    noise: str | None,
    scenario: str,
    limits: dict[str, tuple[float, float]],
    energies: str,
    criterion: str,
    goal: float | None,
    count: int,
    output: Output,
    **fit_options: Any,
) -> None:
    """Propose the settings to measure next, given the present data, and when to stop.

    Magnets move between the limits of --vary, or up to half the scanned range beyond it. For a
    scenario that the data do not identify it names the kind of measurement that would.
    """
    others = energies_of(energies)
    input_options = {name: fit_options.pop(name) for name in INPUT_OPTIONS}
    Assumptions(**fit_options).check_scenario(scenario)
    fit_options["noise"] = None if noise is None else read_noise(noise)
    read = read_inputs(scan, **input_options)
    measured, described, _ = read
    described.check_magnets(limits)
    check_limits(described, limits)
    described.check_energies(others)

    # JAX from here on
    fit = beamfit.fit_emittance(measured, build_line(described), scenario=scenario, **fit_options)
    design_options = {"criterion": criterion, "goal": goal, "count": count, "energies": others}
    advice = beamfit.design(fit, limits=limits or None, **design_options)
    title = f"{fit.scan.name} on {fit.line.name}"
    output.answer([advice], read.digests, lambda terminal: _show(terminal, advice, title))


def _show(terminal: Terminal, advice: Advice, title: str) -> None:
    terminal.line(f"{title}, scenario {advice.scenario}: error of the emittance", style="bold")
    terminal.verdict("design", advice.status, advice.message)
    terminal.line()
    click.echo("\n\n".join(map(text_of, advice.tables())))
