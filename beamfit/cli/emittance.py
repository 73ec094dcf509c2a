"""`beamfit emittance`: fit an emittance, with a verdict, to a scan and a lattice."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import click

import beamfit
from beamfit.answer import Table, determined, labelled
from beamfit.cli.options import Command, Output, Sampling, option, options
from beamfit.emittance.assumptions import Assumptions
from beamfit.errors import InputError
from beamfit.io.line import build_line, read_inputs
from beamfit.io.priors import read_noise, read_systematics
from beamfit.quantity import percent

if TYPE_CHECKING:
    from beamfit.cli.show import Terminal
    from beamfit.emittance.fit import EmittanceFit
    from beamfit.emittance.size_methods import SizeMethods
    from beamfit.emittance.slices import SliceFits
    from beamfit.io.emittance_gui import EmittanceGuiFile
    from beamfit.optics.beamline import Beamline
    from beamfit.sampling.posterior import Posterior

# Options passed to `read_inputs` with the scan.
INPUT_OPTIONS = ["lattice", "use", "first", "last", "screen", "energy", "particle"]
INPUT_OPTIONS += ["columns", "ignore", "skip_bad", "size_method"]
EXAMPLE = """\b
Examples:
  beamfit emittance measurements/lcls_otr2.csv --lattice lattices/lcls_otr2.toml
  beamfit emittance scan.csv --lattice line.toml --plane x --report scan.pdf
  beamfit emittance scan.csv --lattice line.madx --use LINE --json
  beamfit emittance Emittance-scan-OTRS_IN20_571.mat --report scan.html
  beamfit emittance measurements/gtf_slices_simulated.csv --lattice lattices/gtf.toml
  beamfit emittance scan.csv --lattice line.toml --sample --store scan.h5 --report scan.html
  beamfit emittance measurements/gtf_simulated.csv --lattice lattices/gtf.toml \\
    --scenario calibration --prior Q2.slope=167.23+-3.3446
  beamfit emittance scan.csv --lattice line.toml --prior size_scale=1+-2% --prior energy=1+-0.5%
"""


@click.command(cls=Command, epilog=EXAMPLE)
@options(
    "scan columns ignore skip-bad size-method maybe-lattice use from to screen energy particle"
)
@option("--plane", "Plane to fit; default: all measured planes.", choices=["x", "y", "both"])
@option(
    "--method",
    "Fitted quantity: size² (linear) or size.",
    choices=["size-squared", "size"],
    default="size-squared",
)
@option("--robust", "Expect more bad readings: one in ten, instead of 3 %.", is_flag=True)
@options("noise weights scenario prior bounds gain anchor")
@option(
    "--systematics FILE",
    "TOML file with uncertainties of screen, energy, drifts, magnets; they enter the error.",
    name="known",
)
@option(
    "--hysteresis",
    "Focusing network: branches of k1 for rising and falling currents, by the order of rows.",
    is_flag=True,
)
@options("hidden")
@option("--starts", "Networks: number of starts of the training.", default=20)
@options("sample store seed report full json")
def emittance(
    scan: str,
    plane: str | None,
    method: str,
    robust: bool,
    noise: str | None,
    weights: str,
    scenario: str,
    known: str | None,
    sample: bool,
    store: str | None,
    output: Output,
    **fit_options: Any,
) -> None:
    """Fit the emittance to a quadrupole scan and say whether to believe it.

    SCAN is a CSV or HDF5 file with columns such as Q2_A (or Q2_kG, Q2_T_per_m, Q2_k1), size_x_um
    (or sigma_x_mm, fwhm_x_um, ...), size_x_error_um, size_y_um, and optionally energy_MeV,
    screen, shot, slice; or a .mat file of SLAC's emittance_gui.

    Rows that have their own r11_x, r12_x, ... need no lattice, and so do files of emittance_gui.
    """
    sampling = Sampling(sample, store, fit_options["seed"])
    sampling.check()
    input_options = {name: fit_options.pop(name) for name in INPUT_OPTIONS}
    if known is not None:
        fit_options["priors"] = read_systematics(known) | fit_options["priors"]
    Assumptions(**fit_options).check_scenario(scenario)
    own = None if noise is None else read_noise(noise)
    read = read_inputs(scan, **input_options)
    measured, described, gui = read
    planes = {None: measured.planes, "both": ("x", "y")}.get(plane, (plane,))
    for each in planes:
        measured.rows(each)  # raises if the plane was not measured

    if sample and len(measured.slices) > 1:
        found = f"--sample for {len(measured.slices)} slices"
        raise InputError(found, "the rows of one slice, or no --sample", path=measured.path)

    line = build_line(described)  # JAX from here on
    fit_options |= {"planes": planes, "method": method.replace("-", "_"), "robust": robust}
    fit_options |= {"weights": weights, "scenario": scenario, "noise": own}
    inputs = read.digests
    if len(measured.slices) > 1:
        from beamfit.emittance.slices import fit_slices

        fits = fit_slices(measured, line, **fit_options)
        output.write(fits, inputs)
        results = (entry for fit in fits for entry in results_of(fit))
        output.answer(results, inputs, lambda terminal: _show_slices(terminal, fits))
        return
    fit = beamfit.fit_emittance(measured, line, **fit_options)
    methods = () if gui is None else compare_methods(gui, line, planes)
    (posterior,) = sampling.sample_all([fit], inputs, quiet=output.as_json)
    output.write(fit, inputs, posterior=posterior, methods=methods)
    output.answer(
        results_of(fit, methods),
        inputs,
        lambda terminal: show(terminal, fit, posterior, methods),
        posterior=posterior,
    )


def _show_slices(terminal: Terminal, fits: SliceFits) -> None:
    """Show the verdicts and one row per slice."""
    terminal.line(f"{fits.scan.name} on {fits.fits[0].line.name}", style="bold")
    for (plane, status, message), names in fits.alike().items():
        which = f"slice{'s' * (len(names) > 1)} {', '.join(names)}"
        terminal.verdict(f"{plane}, {which}", status, message)
    for note in fits.notes:
        terminal.line(note)
    terminal.line()
    left = () if terminal.full else ("status", "chi2/dof")
    terminal.tables(_without(table, left) for table in fits.tables())
    _about_the_input(terminal, fits, ())
    terminal.rest("columns")


def _without(table: Table, names: tuple[str, ...]) -> Table:
    """Remove the columns with these headers."""
    kept = [i for i, name in enumerate(table.header) if name not in names]
    rows = [[row[i] for i in kept] for row in table.rows]
    return table._replace(header=[table.header[i] for i in kept], rows=rows)


def compare_methods(
    gui: EmittanceGuiFile, line: Beamline, planes: tuple[str, ...]
) -> tuple[SizeMethods, ...]:
    """Compare the size methods of an emittance_gui file in the given planes."""
    from beamfit.emittance.size_methods import compare_size_methods

    found = compare_size_methods(gui.scans, line, gui.stored, gui.means)
    return tuple(m for m in found if m.plane in planes)


def results_of(
    fit: EmittanceFit, methods: tuple[SizeMethods, ...] = ()
) -> Iterator[dict[str, Any]]:
    """Make the JSON entry of each plane: fit, systematics and sensitivity to the fit range."""
    from beamfit.emittance.systematics import range_sensitivity, systematics

    ways = {m.plane: {"size_methods": m} for m in methods}
    for p, entry in zip(fit.planes, fit.to_json(), strict=True):
        if fit.statement.closed:
            entry |= {"systematics": systematics(fit, p.plane), "range": range_sensitivity(p)}
            entry |= ways.get(p.plane, {})
        yield entry


def show(
    terminal: Terminal,
    fit: EmittanceFit,
    posterior: Posterior | None = None,
    methods: tuple[SizeMethods, ...] = (),
) -> None:
    """Show the verdicts, then the quoted numbers or all tables."""
    terminal.line(f"{fit.scan.name} on {fit.line.name}", style="bold")
    for p in fit.planes:
        terminal.answer(p.headline, p.status, p.message)
    for note in fit.notes:
        terminal.line(note)
    terminal.line()
    if terminal.full:
        _show_fully(terminal, fit, methods)
    else:
        _show_briefly(terminal, fit)
    if posterior is not None:
        terminal.posterior("Posterior", posterior)


def _show_fully(terminal: Terminal, fit: EmittanceFit, methods: tuple[SizeMethods, ...]) -> None:
    """Show all numbers, the systematics budget and the refits with fewer points."""
    from beamfit.emittance.results import result_rows
    from beamfit.emittance.systematics import budget_rows, range_rows

    names, statuses = [p.plane for p in fit.planes], [p.status for p in fit.planes]
    terminal.table(labelled("", names, determined(result_rows(fit.planes))), statuses)
    terminal.line()
    if fit.statement.closed:
        for head, rows in (
            ("Change of the normalised emittance if", budget_rows(fit)),
            ("Normalised emittance (shift in std. errors)", range_rows(fit)),
        ):
            if cells := [[label, *found] for label, found in rows]:
                terminal.table(Table("", [head, *names], cells))
                terminal.line()
    elif fit.parameters:
        terminal.table(fit.tables()[1])
    for words in fit.null_directions:
        terminal.line(f"Not determined: {words}.")
    if fit.statement.network:
        terminal.line(f"Anchor: {fit.anchor}.", style="dim")
    if not fit.statement.closed:
        terminal.line()
    _about_the_input(terminal, fit, methods)


def _show_briefly(terminal: Terminal, fit: EmittanceFit) -> None:
    """Show the quoted numbers, the largest systematic of each plane, and a hint to `--full`."""
    from beamfit.emittance.results import result_rows
    from beamfit.emittance.systematics import systematics

    table = labelled("", [p.plane for p in fit.planes], result_rows(fit.planes)).quoted()
    if table.rows:
        terminal.table(table)
    largest: dict[str, list[str]] = {}
    for p in fit.planes if fit.statement.closed else ():
        for change in systematics(fit, p.plane)[:1]:
            said = f"{p.plane} {percent(change.normalized_emittance, sign='+')}"
            largest.setdefault(change.cause, []).append(said)
    if largest:
        said = "; ".join(f"{cause}: {', '.join(parts)}" for cause, parts in largest.items())
        terminal.line(f"Largest systematic, not in the error: {said}.")
    for words in fit.null_directions:
        terminal.line(f"Not determined: {words}.")
    terminal.rest()


def _about_the_input(
    terminal: Terminal, fit: EmittanceFit | SliceFits, methods: tuple[SizeMethods, ...]
) -> None:
    """Show the comparison of size methods, and the source of the errors."""
    terminal.tables(way.table() for way in methods)
    errors = fit.scan.error_source if fit.scan.error else "inferred from the residuals"
    terminal.line(f"Errors of the sizes: {errors}.", style="dim")
