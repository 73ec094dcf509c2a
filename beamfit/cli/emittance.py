"""`beamfit emittance`: a scan and a lattice in, a judged emittance out."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

import beamfit
from beamfit.cli.options import Sampling, command_line, options
from beamfit.io.line import build_line, lattice_of
from beamfit.io.measurement import read_quad_scan
from beamfit.io.result import results_text
from beamfit.studies.scan.assumptions import Assumptions

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
@options("scan ignore skip-bad maybe-lattice use energy particle")
@click.option(
    "--plane",
    type=click.Choice(["x", "y", "both"]),
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
@options("scenario prior bounds anchor")
@click.option(
    "--hysteresis",
    is_flag=True,
    help="Focusing network: branches of k1 for rising and falling currents, by the order of rows.",
)
@click.option("--hidden", default=5, show_default=True, help="Networks: hidden nodes.")
@click.option("--starts", default=20, show_default=True, help="Networks: starts of the training.")
@options("sample store seed report json")
def emittance(
    scan: str,
    ignore: tuple[str, ...],
    skip_bad: bool,
    lattice: str | None,
    use: str | None,
    energy: float | None,
    particle: str | None,
    plane: str | None,
    method: str,
    robust: bool,
    scenario: str,
    sample: bool,
    store: str | None,
    report: str | None,
    as_json: bool,
    **told: Any,
) -> None:
    """Fit the emittance to a quadrupole scan and say whether to believe it.

    SCAN is a CSV or HDF5 file with columns such as Q2_A (or Q2_kG, Q2_T_per_m, Q2_k1), size_x_um
    (or sigma_x_mm, fwhm_x_um, ...), size_x_error_um, size_y_um, and optionally energy_MeV,
    screen, shot.
    """
    sampling = Sampling(sample, store, told["seed"])
    sampling.check()
    Assumptions(**told).check_scenario(scenario)
    measured = read_quad_scan(scan, ignore=ignore, skip_bad=skip_bad)
    described = lattice_of(measured, lattice, use=use, energy=energy, particle=particle)
    planes = {None: measured.planes, "both": ("x", "y")}.get(plane, (plane,))
    for each in planes:
        measured.rows(each)  # says so if it was not measured

    fit = beamfit.fit_emittance(  # JAX from here on
        measured,
        build_line(described),
        planes=planes,
        method=method.replace("-", "_"),
        robust=robust,
        scenario=scenario,
        **told,
    )
    inputs = {scan: measured.sha256} | ({} if lattice is None else {lattice: described.sha256})
    posterior = fit.sample(**sampling.arguments(inputs, quiet=as_json)) if sample else None
    if report is not None:
        beamfit.write_report(report, fit, posterior, command=command_line(), inputs=inputs)
    if as_json:
        further = {} if posterior is None else {"posterior": posterior}
        click.echo(results_text(_results(fit), inputs, command_line(), **further))
    else:
        _show(fit, posterior, report)


def _results(fit: EmittanceFit) -> list[dict[str, Any]]:
    """What a fit says, and what small errors of the line and parts of the scan would change."""
    if not fit.statement.closed:
        return fit.to_json()

    from beamfit.studies.scan.sensitivity import range_sensitivity, systematics

    return [
        entry | {"systematics": systematics(fit, p.plane), "range": range_sensitivity(p)}
        for p, entry in zip(fit.planes, fit.to_json(), strict=True)
    ]


def _show(fit: EmittanceFit, posterior: Posterior | None, report: str | None) -> None:
    """Show tables, the verdict and what the budget is."""
    from beamfit.cli.show import Terminal
    from beamfit.studies.scan.results import parameter_rows, result_rows
    from beamfit.studies.scan.sensitivity import budget_rows, range_rows
    from beamfit.table import Table, labelled

    terminal, names = Terminal(), [p.plane for p in fit.planes]
    title = f"{fit.scan.name} on {fit.line.name}"
    statuses = [p.status for p in fit.planes]
    terminal.table(labelled(title, names, result_rows(fit.planes)), statuses)
    for p in fit.planes:
        terminal.verdict(p.plane, p.status, p.message)
    terminal.line()
    if fit.statement.closed:
        for head, rows in (
            ("Change of the normalised emittance if", budget_rows(fit)),
            ("Normalised emittance (shift in std. errors)", range_rows(fit)),
        ):
            cells = [[label, *found] for label, found in rows]
            terminal.table(Table("", [head, *names], cells), wrap=False)
            terminal.line()
    elif fit.parameters:
        cells = [[name, *found] for name, found in parameter_rows(fit.parameters)]
        terminal.table(Table("", ["Fitted too", "value", "bounds", "prior", "state"], cells))
    for words in fit.null_directions:
        terminal.line(f"Left open: {words}.")
    if fit.statement.network:
        terminal.line(f"Anchor: {fit.anchor}.", style="dim")
    if not fit.statement.closed:
        terminal.line()
    errors = fit.scan.error_source if fit.scan.error else "inferred from the residuals"
    terminal.line(f"Errors of the sizes: {errors}.", style="dim")
    for note in fit.notes:
        terminal.line(note)
    if posterior is not None:
        terminal.posterior("Posterior", posterior)
    terminal.report(report)
