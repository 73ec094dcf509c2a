"""`beamfit emittance`: a scan and a lattice in, a judged emittance out."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from beamfit.cli.assumptions import anchor_of, bounds_of, priors_of
from beamfit.cli.document import check_report_name, command_line, json_text
from beamfit.cli.sampling import Sampling, print_posterior, sampling_options
from beamfit.io.lattice import LatticeFile
from beamfit.io.line import build_line, read_lattice
from beamfit.io.measurement import read_quad_scan
from beamfit.studies.scan.assumptions import SCENARIOS, Assumptions
from beamfit.studies.scan.scans import QuadScan, check_names

if TYPE_CHECKING:
    from beamfit.sampling.posterior import Posterior
    from beamfit.studies.scan.fit import EmittanceFit

__all__ = ["emittance"]

EXAMPLE = """\b
Examples:
  beamfit emittance measurements/lcls_otr2.csv --lattice lattices/lcls_otr2.toml
  beamfit emittance scan.csv --lattice line.toml --plane x --report scan.pdf
  beamfit emittance scan.csv --lattice line.madx --use LINE --json
  beamfit emittance scan.csv --lattice line.toml --sample --store scan.h5 --report scan.html
  beamfit emittance measurements/gtf_simulated.csv --lattice lattices/gtf.toml \\
    --scenario calibration --prior Q2.slope=167.23+-3.3446
"""


@click.command(epilog=EXAMPLE)
@click.argument("scan", type=click.Path())
@click.option(
    "--lattice",
    required=True,
    type=click.Path(),
    metavar="FILE",
    help="Lattice: TOML, MAD-X (.madx, .seq), MAD-8 (.mad8) or elegant (.lte).",
)
@click.option(
    "--plane",
    type=click.Choice(["x", "y", "both"]),
    default=None,
    help="Which plane to fit; all that were measured by default.",
)
@click.option(
    "--method",
    type=click.Choice(["size-squared", "size"]),
    default="size-squared",
    show_default=True,
    help="What the fit compares: size² (linear) or size.",
)
@click.option("--robust", is_flag=True, help="Give each point a probability of being an outlier.")
@click.option(
    "--scenario",
    type=click.Choice(SCENARIOS),
    default="known",
    show_default=True,
    help="What is unknown besides the beam: nothing, R11 and R12, the magnets' calibration, or k1 "
    "as a function of the current.",
)
@click.option(
    "--prior",
    multiple=True,
    metavar="NAME=MEAN+-SD",
    help="Calibration: what is known of a number, such as Q2.slope=167.23+-3.3446 (or ±).",
)
@click.option(
    "--bounds",
    multiple=True,
    metavar="NAME=LOW:HIGH",
    help="Calibration: bounds of a number; ± 12 % of the slope unless given.",
)
@click.option(
    "--anchor",
    multiple=True,
    metavar="ANCHOR",
    help="Networks: what ties them to the lattice: first-principles=2%, a setting such as Q2=0, "
    "or determinant.",
)
@click.option(
    "--hysteresis",
    is_flag=True,
    help="Focusing network: branches of k1 for rising and falling currents, by the order of rows.",
)
@click.option("--hidden", type=int, default=5, show_default=True, help="Networks: hidden nodes.")
@click.option(
    "--starts", type=int, default=20, show_default=True, help="Networks: starts of the training."
)
@click.option(
    "--report",
    type=click.Path(),
    metavar="FILE.html|FILE.pdf",
    default=None,
    help="Write a report page.",
)
@sampling_options
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object and nothing else.")
@click.option(
    "--use", metavar="NAME", default=None, help="Line or sequence of a MAD-X or elegant file."
)
@click.option(
    "--energy",
    type=float,
    metavar="MEV",
    default=None,
    help="Total energy, instead of the lattice's own; elegant files have none.",
)
def emittance(
    scan: str,
    lattice: str,
    plane: str | None,
    method: str,
    robust: bool,
    scenario: str,
    prior: tuple[str, ...],
    bounds: tuple[str, ...],
    anchor: tuple[str, ...],
    hysteresis: bool,
    hidden: int,
    starts: int,
    report: str | None,
    as_json: bool,
    use: str | None,
    energy: float | None,
    sample: bool,
    store: str | None,
    seed: int,
) -> None:
    """Fit the emittance to a quadrupole scan and say whether to believe it.

    SCAN is a CSV or HDF5 file with columns such as Q2_A (or Q2_kG, Q2_k1), size_x_um,
    size_x_error_um, size_y_um, and optionally energy_MeV, screen, shot.
    """
    check_report_name(report)
    sampling = Sampling(sample, store, seed)
    sampling.check()
    told = Assumptions(
        priors_of(prior), bounds_of(bounds), anchor_of(anchor), hysteresis, hidden, starts, seed
    )
    told.check_scenario(scenario)
    measured = read_quad_scan(scan)
    described = read_lattice(lattice, use=use, energy=energy)
    check_names(
        measured,
        described.calibrations,
        described.places,
        described.default_screen,
        described.rest_energy,
    )
    planes = _planes(plane, measured)

    from beamfit.studies.scan.fit import fit_emittance  # JAX from here on

    fit = fit_emittance(
        measured,
        build_line(described),
        planes=planes,
        method=method.replace("-", "_"),
        robust=robust,
        scenario=scenario,
        **vars(told),
    )
    inputs = {str(scan): measured.sha256, str(lattice): described.sha256}
    command = command_line()
    posterior = None
    if sampling.wanted:
        posterior = fit.sample(**sampling.options(command, inputs, progress=not as_json))
    if report is not None:
        from beamfit.report.page import write_report

        write_report(report, fit, posterior, command=command, inputs=inputs)
    if as_json:
        further = {} if posterior is None else {"posterior": posterior.to_json()}
        click.echo(json_text(command, inputs, _results(fit), further))
    else:
        _print(fit, described, report, posterior)


def _planes(plane: str | None, scan: QuadScan) -> tuple[str, ...]:
    if plane in (None, "both"):
        if plane == "both" and scan.planes != ("x", "y"):
            missing = next(p for p in "xy" if p not in scan.planes)
            raise scan.unusable(f"no sizes in plane {missing}", f"a column size_{missing}_um")
        return scan.planes
    scan.rows(plane)  # says so if it was not measured
    return (plane,)


def _results(fit: EmittanceFit) -> list[dict[str, Any]]:
    if not fit.statement.closed:
        return fit.to_json()

    from beamfit.studies.scan.sensitivity import range_sensitivity, systematics

    return [
        entry
        | {
            "systematics": [c._asdict() for c in systematics(fit, p.plane)],
            "range": [r._asdict() for r in range_sensitivity(p)],
        }
        for p, entry in zip(fit.planes, fit.to_json(), strict=True)
    ]


def _print(
    fit: EmittanceFit, lattice: LatticeFile, report: str | None, posterior: Posterior | None
) -> None:
    """Show tables, the verdict and what the budget is."""
    from rich.console import Console

    from beamfit.cli.terminal import (
        budget_table,
        range_table,
        result_table,
        scenario_lines,
        verdict_lines,
    )

    # Names are shown as they are: a bracket in one is not a style.
    console = Console(highlight=False, markup=False)
    console.print(result_table(fit))
    for p in fit.planes:
        console.print(verdict_lines(p))
    if fit.statement.closed:
        for table in (budget_table(fit), range_table(fit)):
            console.print()
            console.print(table)
    else:
        console.print()
        for shown in scenario_lines(fit):
            console.print(shown)
    console.print()
    errors = fit.scan.error_source if fit.scan.error else "inferred from the residuals"
    console.print(f"Errors of the sizes: {errors}.", style="dim")
    if posterior is not None:
        print_posterior(console, "Posterior", posterior)
    if report is not None:
        console.print(f"Report written to {report}", style="bold")
