"""`beamfit lifetime`: records in, judged lifetimes and loss budgets out."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from beamfit.cli.document import check_report_name, command_line, json_text
from beamfit.cli.sampling import Sampling, print_posterior, sampling_options
from beamfit.errors import InputError
from beamfit.io.decay_record import read_decay_record
from beamfit.io.files import digest

if TYPE_CHECKING:
    from beamfit.sampling.posterior import Posterior
    from beamfit.studies.decay.shift import Shift
    from beamfit.studies.decay.study import RecordStudy

__all__ = ["lifetime"]

EXAMPLE = """\b
Examples:
  beamfit lifetime measurements/aps_1999_decay.csv
  beamfit lifetime measurements/aps_1999_decay.csv --sample --report aps.html
  beamfit lifetime fill1.csv fill2.h5 --ring lattices/spear3_2003.toml
  beamfit lifetime fill1.csv --ring ring.toml --report fill1.html --json
  beamfit lifetime measurements/spear3_shift_simulated.csv --ring lattices/spear3_2003.toml --study
  beamfit lifetime shift.csv --ring ring.toml --study --network correction
"""


@click.command(epilog=EXAMPLE)
@click.argument("record", nargs=-1, required=True, type=click.Path())
@click.option(
    "--ring",
    type=click.Path(),
    metavar="FILE.toml",
    default=None,
    help="Ring, for the loss budget from first principles beside the measured a and b.",
)
@click.option(
    "--report",
    type=click.Path(),
    metavar="FILE.html|FILE.pdf",
    default=None,
    help="Write a report page.",
)
@click.option(
    "--study",
    is_flag=True,
    help="Fit the ring's loss mechanisms to all decays together: scales, loss budget with credible "
    "intervals, best operating point, next decay, anomaly. Needs --ring.",
)
@click.option(
    "--network",
    type=click.Choice(["alone", "correction"]),
    default=None,
    help="With --study: also fit a and b by a network that falls with bunches and scraper and "
    "rises with pressure; alone, or as a factor on the fitted first principles.",
)
@sampling_options
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object and nothing else.")
def lifetime(
    record: tuple[str, ...],
    ring: str | None,
    report: str | None,
    study: bool,
    network: str | None,
    sample: bool,
    store: str | None,
    seed: int,
    as_json: bool,
) -> None:
    """Fit the lifetime to decay records and say what they cannot tell.

    RECORD is a CSV or HDF5 file with columns such as time_s (or ISO time), beam_current_mA,
    beam_current_error_mA, and optionally rf_voltage_kV, scraper_y_mm, pressure_Pa, bunches.
    It is cut into decays at refills, losses and changes of setting. Each decay gives I0, a, b of
    dI/dt = -a I² - b I, the lifetime at its start, mean current and end, and a verdict.
    """
    check_report_name(report)
    sampling = Sampling(sample, store, seed)
    sampling.check()
    if study and ring is None:
        raise InputError("--study without a ring", "--ring FILE.toml")
    if network is not None and not study:
        raise InputError("--network without a study", "--study --ring FILE.toml")
    inputs = {path: digest(path) for path in record}
    if len(inputs) < len(record):
        twice = next(path for path in record if record.count(path) > 1)
        raise InputError("a record given twice", "each record once", path=twice)
    records = [read_decay_record(path) for path in record]
    machine = None
    if ring is not None:
        from beamfit.io.ring import read_operation, read_ring

        inputs[ring] = digest(ring)
        described, operation = read_ring(ring), read_operation(ring)

        from beamfit.studies.decay.loss_budget import Machine  # JAX from here on

        machine = Machine(described, operation)

    from beamfit.studies.decay.study import study_record

    studies = tuple(study_record(each, machine) for each in records)
    shift = None
    if study:
        from beamfit.studies.decay.network import Network
        from beamfit.studies.decay.shift import study_shift

        decays = [decay for each in studies for decay in each.decays]
        shift = study_shift(decays, machine, network=network and Network(network))
    command = command_line()
    posteriors = None
    if sampling.wanted:
        options = sampling.options(command, inputs, progress=not as_json)
        posteriors = _sampled(studies, options)
    if report is not None:
        from beamfit.report.page import write_report

        write_report(report, studies, posteriors, command=command, inputs=inputs, shift=shift)
    if as_json:
        results = [decay.to_json() for study in studies for decay in study.decays]
        if posteriors is not None:
            pairs = zip(results, posteriors, strict=True)
            results = [result | {"posterior": p.to_json()} for result, p in pairs]
        further = {} if shift is None else {"study": shift.to_json()}
        click.echo(json_text(command, inputs, results, further))
    else:
        _print(studies, shift, report, posteriors or [])


def _sampled(studies: tuple[RecordStudy, ...], options: dict[str, Any]) -> list[Posterior]:
    """One posterior a decay; a store holds one."""
    fits = [decay.fit for study in studies for decay in study.decays]
    if options["store"] is not None and len(fits) > 1:
        found = f"--store for {len(fits)} decays"
        raise InputError(found, "a record of one decay, or no --store")
    return [fit.sample(**options) for fit in fits]


def _print(
    studies: tuple[RecordStudy, ...],
    shift: Shift | None,
    report: str | None,
    posteriors: list[Posterior],
) -> None:
    from rich.console import Console

    from beamfit.cli.decay_terminal import decay_tables, shift_lines

    console = Console(highlight=False, markup=False)
    for study in studies:
        for shown in decay_tables(study):
            console.print(shown)
    names = [decay.fit.record for study in studies for decay in study.decays]
    for name, posterior in zip(names, posteriors, strict=False):
        print_posterior(console, f"Posterior of {name}", posterior)
    if shift is not None:
        for line in shift_lines(shift):
            console.print(line)
    if report is not None:
        console.print(f"Report written to {report}", style="bold")
