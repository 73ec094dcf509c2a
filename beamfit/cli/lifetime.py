"""`beamfit lifetime`: lifetimes with verdicts, and loss budgets, from records of current."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import click

import beamfit
from beamfit.cli.options import Command, Output, Sampling, option, options
from beamfit.commands import machine_of
from beamfit.errors import InputError
from beamfit.io.decay_record import monitor_of, read_lifetime_input
from beamfit.io.files import digest
from beamfit.lifetime.record import LifetimeTable

if TYPE_CHECKING:
    from beamfit.cli.show import Terminal
    from beamfit.lifetime.course import Trend
    from beamfit.lifetime.lifetime_table import LifetimeFit
    from beamfit.lifetime.ring_study import Shift
    from beamfit.lifetime.study import RecordStudy
    from beamfit.sampling.posterior import Posterior

# Decays, and kinds of verdict on many decays, listed without --full.
MAX_DECAYS_BRIEF = 3
MAX_VERDICTS_BRIEF = 2
EXAMPLE = """\b
Examples:
  beamfit lifetime measurements/aps_1999_decay.csv
  beamfit lifetime measurements/aps_1999_decay.csv --law constant
  beamfit lifetime measurements/aps_1999_decay.csv --monitor-drift 5uA/h
  beamfit lifetime measurements/aps_1999_decay.csv --sample --report aps.html
  beamfit lifetime fill1.csv fill2.h5 --ring lattices/spear3_2003.toml
  beamfit lifetime fill1.csv --ring ring.toml --report fill1.html --json
  beamfit lifetime measurements/spear3_shift_simulated.csv --ring lattices/spear3_2003.toml --study
  beamfit lifetime shift.csv --ring ring.toml --study --prior rf_voltage=1+-1%
  beamfit lifetime shift.csv --ring ring.toml --study --network
  beamfit lifetime week*.csv --trend --report weeks.html
  beamfit lifetime export.csv --columns 'SR:DCCT:CURRENT=beam_current_mA' --skip-bad
"""


@click.command(cls=Command, epilog=EXAMPLE)
@click.argument("record", nargs=-1, required=True)
@option(
    "--ring FILE.toml",
    "Ring, for the loss budget from first principles in addition to the measured a and b.",
)
@option(
    "--study",
    "Fit the ring's loss mechanisms to all decays together: scales, loss budget with credible "
    "intervals, best operating point, next decay, anomaly. Needs --ring.",
    is_flag=True,
)
@option(
    "--network",
    "With --study: also fit a network that corrects the fitted first principles, by a factor on a "
    "and on b that falls with bunches and scraper and rises with pressure.",
    is_flag=True,
)
@option(
    "--trend",
    "Follow the lifetime through all decays: current times lifetime with control limits, scaled "
    "with --ring to one current and the settings of the ring file; alarms if a or b change.",
    is_flag=True,
)
@option(
    "--law free|constant",
    "Free: a may vary as a power of the current and b may drift in a record, and errors include "
    "this. With --ring both are constant.",
    choices=["free", "constant"],
    default="free",
)
@option(
    "--offset zero-beam|CURRENT",
    "Reading of the current monitor without beam, to be subtracted: a current such as 0.12mA, or "
    "from readings of the record before injection or after the dump.",
)
@option(
    "--monitor-drift CURRENT/TIME",
    "Drift of the current monitor (one standard deviation), such as 10uA/h; enters the errors.",
)
@option(
    "--monitor-offset CURRENT",
    "Offset of the current monitor (one standard deviation), such as 50uA; enters the errors.",
)
@options("scale-prior columns ignore skip-bad sample store seed report full json")
def lifetime(
    record: tuple[str, ...],
    ring: str | None,
    study: bool,
    network: bool,
    trend: bool,
    law: str,
    monitor_drift: str | None,
    monitor_offset: str | None,
    priors: dict[str, tuple[float, float]] | None,
    sample: bool,
    store: str | None,
    seed: int,
    output: Output,
    **reading: Any,
) -> None:
    """Fit the lifetime to decay records and state what they do not determine.

    RECORD is a CSV or HDF5 file with columns such as time_s (or ISO time), beam_current_mA,
    beam_current_error_mA, and optionally rf_voltage_kV, scraper_y_mm, pressure_Pa, bunches,
    bunch_length_mm; or CSV or JSON of the EPICS Archiver Appliance; or lifetimes by current:
    tau_h, beam_current_mA.
    It is cut into decays at refills, losses and changes of setting. Each decay gives I0, a, b of
    dI/dt = -a I² - b I, the lifetime at its start, mean current and end, and a verdict.
    """
    sampling = Sampling(sample, store, seed)
    sampling.check()
    _check_study_options(study, ring, network, priors)
    monitor = monitor_of(monitor_drift, monitor_offset)
    records = [read_lifetime_input(path, **reading) for path in dict.fromkeys(record)]
    if len(records) < len(record):
        twice = next(path for path in record if record.count(path) > 1)
        raise InputError("a record given twice", "each record once", path=twice)
    machine = None if ring is None else machine_of(ring)
    inputs = {path: digest(path) for path in (*record, ring) if path is not None}

    tables = [each for each in records if isinstance(each, LifetimeTable)]
    with_more = sample or study or trend or ring or monitor
    if tables and (len(tables) < len(records) or with_more):
        expected = "tables of lifetimes by themselves, with no option but --law, --report, --json"
        raise InputError("a table of lifetimes", expected, path=tables[0].name)
    if tables:
        _answer_tables(tables, law, inputs, output)
        return

    if monitor is not None:
        records = [replace(each, monitor=monitor.beside(each.monitor)) for each in records]
    studies = tuple(beamfit.study(each, machine, law) for each in records)  # JAX from here on
    decays = [decay for each in studies for decay in each.answers]
    single = [decay for each in studies for decay in each.decays or each.pooled]
    shift = beamfit.study_shift(single, machine, 0, network, priors) if study else None
    course = beamfit.trend(studies, machine) if trend else None
    drawn = sampling.sample_all([decay.fit for decay in decays], inputs, quiet=output.as_json)
    posteriors = drawn if sample else None
    output.write(studies, inputs, posterior=posteriors, shift=shift, trend=course)
    output.answer(
        (
            decay.to_json() | ({"posterior": posterior} if sample else {})
            for decay, posterior in zip(decays, drawn, strict=True)
        ),
        inputs,
        lambda terminal: _show(terminal, studies, posteriors, shift, course),
        study=shift,
        trend=course,
    )


def _answer_tables(
    tables: list[LifetimeTable], law: str, inputs: dict[str, str], output: Output
) -> None:
    """Fit and show tables of lifetimes."""
    fits = [beamfit.fit_lifetimes(table, law) for table in tables]
    output.write(fits, inputs)
    output.answer(fits, inputs, lambda terminal: _show_lifetimes(terminal, fits))


def _show_lifetimes(terminal: Terminal, fits: list[LifetimeFit]) -> None:
    for fit in fits:
        terminal.line(str(fit.readings), style="bold")
        terminal.answer(fit.headline, fit.status, fit.message)
        terminal.line()
        for table in fit.tables():
            terminal.table(table, [fit.status])
        for note in fit.readings.notes:
            terminal.line(f"Note: {note}")
        terminal.line()


def _check_study_options(study: bool, ring: str | None, network: bool, priors: dict | None) -> None:
    if study and ring is None:
        raise InputError("--study without a ring", "--ring FILE.toml")
    if network and not study:
        raise InputError("--network without a study", "--study --ring FILE.toml")
    if priors and not study:
        raise InputError("--prior without a study", "--study --ring FILE.toml")


def _show(
    terminal: Terminal,
    studies: tuple[RecordStudy, ...],
    posteriors: list[Posterior] | None,
    shift: Shift | None,
    trend: Trend | None,
) -> None:
    """Show every record, and posteriors, study and trend."""
    verdicts = [] if shift is None else shift.verdicts
    verdicts += [] if trend is None else [("trend", trend.status, trend.message)]
    for verdict in verdicts:
        terminal.verdict(*verdict)
    if verdicts:
        terminal.line()
    for each in studies:
        if shift is not None and not terminal.full:
            terminal.line(str(each.record), style="bold")
        else:
            _show_record(terminal, each)
    fits = [decay.fit for study in studies for decay in study.answers]
    for fit, posterior in zip(fits, posteriors or (), strict=False):
        terminal.posterior(f"Posterior of {fit.record}", posterior)
    for table in () if shift is None else shift.tables():
        terminal.table(table if terminal.full else table.quoted())
    for table in () if trend is None else trend.tables():
        terminal.table(table)
    terminal.rest()


def _show_record(terminal: Terminal, study: RecordStudy) -> None:
    """Show a record: its cuts, and every decay with its verdict and budget."""
    from beamfit.answer import determined, labelled
    from beamfit.lifetime import tables

    terminal.line(str(study.record), style="bold")
    for note in study.record.notes:
        terminal.line(f"Note: {note}")
    many = len(study.decays) > tables.MAX_FULL_DECAYS
    if study.pooled or (many and not terminal.full):
        terminal.line(f"Cut at or left out: {tables.event_summary(study.events)}")
    elif study.events:
        said = "; ".join(str(event) for event in study.events[:8])
        left = len(study.events) - 8
        terminal.line(f"Cut at or left out: {said}" + (f"; {left} more" if left > 0 else ""))
    for decay in study.pooled if many else study.answers:
        name, status = decay.fit.record, decay.fit.status
        terminal.answer(decay.fit.headline, status, decay.fit.message)
        terminal.line()
        if not terminal.full:
            terminal.table(labelled("", [name], tables.decay_rows([decay])).quoted())
            continue
        rows = tables.decay_rows([decay]) + tables.separability_rows([decay])[:2]
        rows += tables.check_rows([decay])
        terminal.table(labelled("", [name], determined(rows)), [status])
        if decay.systematics:
            terminal.table(tables.systematic_table(decay, "\nSystematics"))
        if losses := tables.budget_rows([decay]):
            terminal.table(labelled("\nLosses from first principles", [name], losses))
        for course in tables.course_tables([decay]):
            terminal.table(course)
        terminal.line()
    if many:
        _show_many(terminal, study)


def _show_many(terminal: Terminal, study: RecordStudy) -> None:
    """Show each verdict once, then a table with one row per decay."""
    from beamfit.answer import cell
    from beamfit.lifetime import tables

    verdicts = tables.distinct_verdicts(study.decays)
    listed = verdicts if terminal.full else verdicts[:MAX_VERDICTS_BRIEF]
    for status, names, message in listed:
        terminal.verdict(names, status, message)
    if left := verdicts[len(listed) :]:
        others = ", ".join(dict.fromkeys(cell(status) for status, *_ in left))
        terminal.line(f"\n{len(left)} more kinds of verdict ({others}): --full.")
    for table in tables.overview(study.decays)[: None if terminal.full else 1]:
        rows = table.rows
        if not terminal.full and (left := len(rows) - MAX_DECAYS_BRIEF) > 0:
            rows = [*rows[:MAX_DECAYS_BRIEF], [f"{left} more", *[""] * (len(table.header) - 1)]]
        terminal.table(table._replace(title=f"\n{table.title}", rows=rows))
    terminal.line()
