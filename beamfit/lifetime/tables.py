"""Decays and their loss budgets as rows of text: the one list that terminal and report show."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from typing import NamedTuple

from beamfit.answer import Row, Table, cell
from beamfit.lifetime.fit import DecayFit
from beamfit.lifetime.mechanisms import LINEAR, QUADRATIC, Mechanism
from beamfit.lifetime.pieces import Event
from beamfit.lifetime.study import Decay, RecordStudy
from beamfit.quantity import HOUR, Quantity, Status


class DecayRow(NamedTuple):
    """A label, what stands beside it for a decay, and whether people quote it."""

    label: str
    value: Callable[[Decay], object]
    quoted: bool = False


MOST_EVENTS = 100
# How many decays have every number shown; of more only the main ones, a row each.
FEW = 4
# Percent of the loss below which a mechanism's digits say nothing.
NEGLIGIBLE = 1e-6


def _laid_out(decays: Sequence[Decay], rows: Sequence[DecayRow]) -> list[Row]:
    return [Row(row.label, [row.value(each) for each in decays], row.quoted) for row in rows]


def _span(seconds: float) -> str:
    if seconds >= 3600:
        return f"{seconds / 3600:.3g} h"
    return f"{seconds / 60:.3g} min" if seconds >= 60 else f"{seconds:.3g} s"


def _chi2(decay: Decay) -> str:
    fit = decay.fit
    if fit.noise_inferred:
        return f"not testable ({fit.dof} dof)"
    return f"{fit.chi2:.4g}/{fit.dof} = {fit.chi2 / fit.dof:.3g}"


def _reduced_chi2(decay: Decay) -> str:
    fit = decay.fit
    return "not testable" if fit.noise_inferred else f"{fit.chi2 / fit.dof:.3g}"


def _noise(decay: Decay) -> str:
    return "inferred from the residuals" if decay.fit.noise_inferred else "as given"


STATUS = DecayRow("status", lambda d: d.fit.status)
READINGS = DecayRow("readings", lambda d: f"{len(d.segment)} over {_span(d.segment.span)}")
START = DecayRow("current at the start", lambda d: d.fit.i0, quoted=True)
MEAN = DecayRow("lifetime at the mean current", lambda d: d.fit.lifetime_mean, quoted=True)
A, B = (DecayRow(name, lambda d, name=name: getattr(d.fit, name), quoted=True) for name in "ab")
INTERVALS = tuple(
    DecayRow(
        f"95 % interval of {row.label}", lambda d, row=row: row.value(d).interval_words, quoted=True
    )
    for row in (A, B)
)
QUALITY: tuple[DecayRow, ...] = (
    DecayRow("chi2/dof", _chi2, quoted=True),
    DecayRow("rms residual", lambda d: f"{d.fit.rms_residual:.3g} mA"),
    DecayRow("errors", _noise),
)
RESULT: tuple[DecayRow, ...] = (
    STATUS,
    READINGS,
    START,
    DecayRow("lifetime at the start", lambda d: d.fit.lifetime_start, quoted=True),
    MEAN,
    DecayRow("lifetime at the end", lambda d: d.fit.lifetime_end, quoted=True),
    A,
    B,
    *INTERVALS,
)
EXACT: tuple[DecayRow, ...] = (
    DecayRow("a if a and b are constant", lambda d: d.fit.if_constant("a"), quoted=True),
    DecayRow("b if a and b are constant", lambda d: d.fit.if_constant("b"), quoted=True),
)
CYCLES: tuple[DecayRow, ...] = (
    STATUS,
    DecayRow("cycles", lambda d: f"{d.fit.first.size} at {d.fit.mean_current:.5g} mA", quoted=True),
    READINGS,
    MEAN,
    DecayRow("lifetime at the highest current", lambda d: d.fit.lifetime_start, quoted=True),
    DecayRow("lifetime at the lowest current", lambda d: d.fit.lifetime_end, quoted=True),
    A,
    B,
    *INTERVALS,
)


def _rows_of(decays: Sequence[Decay]) -> tuple[DecayRow, ...]:
    if all(decay.fit.first is not None for decay in decays):
        return *CYCLES, *QUALITY
    free = any(decay.fit.free_law for decay in decays)
    return *RESULT, *EXACT * free, *QUALITY


def decay_rows(decays: Sequence[Decay]) -> list[Row]:
    """Label and one cell per decay, for every number a fit has."""
    return _laid_out(decays, _rows_of(decays))


def course_tables(decays: Sequence[Decay]) -> list[Table]:
    """Lifetimes by part, of each record whose loss rate is not the same all along."""
    header = ["from, h", "to, h", "lifetime at the mean current"]
    return [
        Table(f"Course of the lifetime in {decay.fit.record}", header, [
            [f"{part.start / HOUR:.4g}", f"{part.end / HOUR:.4g}", cell(part.lifetime)]
            for part in decay.fit.course
        ])
        for decay in decays if decay.fit.course
    ]  # fmt: skip


def _number(value: float | None, form: str, unit: str = "") -> str:
    return "-" if value is None else f"{value:{form}}{unit}"


def _share(decay: Decay) -> Quantity | None:
    found = decay.fit.identifiability
    return None if found.share is None else Quantity(found.share, found.share_error, "1")


APART: tuple[DecayRow, ...] = (
    DecayRow(
        "a and b", lambda d: "separable" if d.fit.identifiability.separable else "not separable"
    ),
    DecayRow("share of a in the loss", _share),
    DecayRow("correlation of a and b", lambda d: _number(d.fit.identifiability.correlation, ".6f")),
    DecayRow(
        "neighbouring residuals",
        lambda d: _number(d.fit.identifiability.residual_correlation, ".2f"),
    ),
    DecayRow(
        "errors enlarged for that",
        lambda d: _number(d.fit.identifiability.error_inflation, ".1f", " times"),
    ),
)


def separability_rows(decays: Sequence[Decay]) -> list[Row]:
    """Label and one cell per decay for what the record tells of a and b apart."""
    return _laid_out(decays, APART)


def _one_lifetime(decay: Decay, name: str) -> str | None:
    found = getattr(decay.checks, name, None)
    if found is None:
        return None
    known = math.isfinite(found.bias_start)
    bias = f"{100 * found.bias_start:+.2g} % at start, " if known else ""
    return f"{found.lifetime} ({bias}{found.rms_residual:.3g} mA rms)"


def _constant_a(decay: Decay) -> str | None:
    found = decay.fit.constant_a
    if found is None:
        return None
    said = {Status.converged: "not contradicted", Status.poor_fit: "rejected"}
    chance = f" (p = {found.p_value:.2g})"
    return said[found.status] + chance if found.status in said else "not testable with this record"


CHECKS: tuple[DecayRow, ...] = (
    DecayRow("single exponential", lambda d: _one_lifetime(d, "single_exponential")),
    DecayRow("line through ln I", lambda d: _one_lifetime(d, "log_linear")),
    DecayRow("constant a", _constant_a),
)
LIFETIMES: tuple[DecayRow, ...] = (
    DecayRow("lifetime by current", lambda d: d.fit.lifetimes and str(d.fit.lifetimes)),
)
OUTGASSING: tuple[DecayRow, ...] = (
    DecayRow("gas loss relaxes within", lambda d: d.fit.outgassing.time_constant),
    DecayRow("lifetime at first", lambda d: d.fit.outgassing.before),
    DecayRow("without that gas", lambda d: d.fit.outgassing.after),
    DecayRow("a beside it", lambda d: d.fit.outgassing.a),
    DecayRow("b in the end", lambda d: d.fit.outgassing.b),
)
SYSTEMATIC = ["if the", "a", "b", "lifetime at the mean"]


def check_rows(decays: Sequence[Decay]) -> list[Row]:
    """Label and one cell per decay for what simpler analyses say, and whether a is constant."""
    rows = CHECKS if any(decay.checks for decay in decays) else CHECKS[-1:]
    rows += LIFETIMES if any(decay.fit.lifetimes for decay in decays) else ()
    rows += OUTGASSING if all(decay.fit.outgassing for decay in decays) else ()
    return _laid_out(decays, rows)


def systematic_rows(decay: Decay) -> list[list[str]]:
    """A cause in each row, and by how much it moves a, b and the lifetime at the mean current."""
    fit = decay.fit
    values = fit.a.value, fit.b.value, fit.lifetime_mean.value
    return [
        [cause, *(_percent(moved / value) for moved, value in zip(by, values, strict=True))]
        for cause, *by in decay.systematics
    ]


def _percent(share: float) -> str:
    return f"{100 * share:+.0f} %" if abs(share) > 1 - 1e-9 else f"{100 * share:+.2g} %"


def _part(kind: str, mechanism: Mechanism) -> DecayRow:
    """A mechanism's part of a or b, with its share of the loss at the mean current."""
    name, unit = f"{kind}_{mechanism.name}", {"a": "1/(mA s)", "b": "1/s"}[kind]

    def shown(decay: Decay) -> str:
        budget = decay.budget
        value = float(getattr(budget.losses, name))
        rate = value * {"a": budget.current, "b": 1.0}[kind]
        share = 100 * rate * 3600 * budget.lifetime
        if share < NEGLIGIBLE:
            return "negligible"
        return f"{value:.4g} {unit} ({share:.3g} % of the loss)"

    return DecayRow(f"{kind}, {mechanism.label}", shown)


def _emittances(decay: Decay) -> str:
    x, y = (f"{1e9 * value:.4g}" for value in decay.budget.emittances)
    return f"{x} and {y} nm"


def _pressure(decay: Decay) -> str:
    budget = decay.budget
    filed = budget.filed_pressure
    return f"{budget.pressure:.3g} Pa" + (
        "" if filed is None else f", as the gauge reads; {filed:.3g} Pa by the ring file"
    )


SETTINGS: tuple[DecayRow, ...] = (
    DecayRow("RF voltage", lambda d: f"{float(d.budget.operation.rf_voltage) / 1e3:.6g} kV"),
    DecayRow("scraper", lambda d: f"{float(d.budget.operation.scraper_y) * 1e3:.4g} mm"),
    DecayRow("bunches", lambda d: f"{float(d.budget.operation.bunches):.6g}"),
)
BUDGET: tuple[DecayRow, ...] = (
    *SETTINGS,
    DecayRow("emittances, as given: no intrabeam scattering", _emittances),
    DecayRow("rms bunch length", lambda d: f"{1e3 * d.budget.bunch_length:.4g} mm"),
    DecayRow("pressure at the mean current", _pressure),
    *(_part("a", mechanism) for mechanism in QUADRATIC),
    DecayRow("a, sum", lambda d: f"{d.budget.losses.a:.4g} 1/(mA s)"),
    DecayRow("a, measured", lambda d: d.fit.a),
    *(_part("b", mechanism) for mechanism in LINEAR),
    DecayRow("b, sum", lambda d: f"{d.budget.losses.b:.4g} 1/s"),
    DecayRow("b, measured", lambda d: d.fit.b),
    DecayRow("lifetime at the mean, computed", lambda d: f"{d.budget.lifetime:.4g} h"),
    DecayRow("lifetime at the mean, measured", lambda d: d.fit.lifetime_mean),
)
# Of many decays only the main numbers are shown, a row each.
MAIN: dict[str, tuple[DecayRow, ...]] = {
    "Result": (STATUS, START, MEAN),
    "a and b": (A, B, DecayRow("chi2/dof", _reduced_chi2)),
}
LOSSES: tuple[DecayRow, ...] = (
    *SETTINGS,
    DecayRow("computed", lambda d: f"{d.budget.lifetime:.4g} h"),
    DecayRow("measured", MEAN.value),
)


def _budgets_known(decays: Sequence[Decay]) -> bool:
    return all(decay.budget is not None for decay in decays) and len(decays) > 0


def budget_rows(decays: Sequence[Decay]) -> list[Row]:
    """Label and one cell per decay: first principles beside the measured; empty without a ring."""
    return _laid_out(decays, BUDGET) if _budgets_known(decays) else []


def overview(decays: Sequence[Decay]) -> list[tuple[str, list[str], list[list[str]]]]:
    """The main numbers of many decays, one row each.

    Parameters
    ----------
    decays : sequence of Decay
        More than `FEW`.

    Returns
    -------
    list of (str, list of str, list of list of str)
        Title, header and rows of each table.
    """
    known = {"Losses from first principles": LOSSES} if _budgets_known(decays) else {}
    tables, names = [], numbered(decays)
    for title, wanted in (MAIN | known).items():
        rows = [[names[d.fit.record], *(cell(row.value(d)) for row in wanted)] for d in decays]
        tables.append((title, ["decay", *(row.label for row in wanted)], rows))
    return tables


def numbered(decays: Sequence[Decay]) -> dict[str, str]:
    """Name of each decay in a table: its number alone where all are of one record."""
    names = [decay.fit.record for decay in decays]
    records = {name.rpartition("#")[0] for name in names}
    whole = len(records) > 1 or "" in records
    return {name: name if whole else "#" + name.rpartition("#")[2] for name in names}


def alike(decays: Sequence[Decay]) -> list[tuple[Status, str, str]]:
    """Status, decays and message for each different verdict on many decays; where all is well and
    only numbers differ, those of the first.
    """
    found: dict[tuple[Status, str], list[DecayFit]] = {}
    for decay in decays:
        fit = decay.fit
        well = fit.status is Status.converged
        words = re.sub(r"\d[\d.e+-]*", "#", fit.message) if well else fit.message
        found.setdefault((fit.status, words), []).append(fit)
    told, names = [], numbered(decays)
    for (status, _), fits in found.items():
        who, said = names[fits[0].record], fits[0].message
        if len(fits) > 1:
            who = f"{len(fits)} decays, {who} to {names[fits[-1].record]}"
        if len({fit.message for fit in fits}) > 1:
            said = f"{said.rstrip('.')} (numbers are the first's)."
        told.append((status, who, said))
    return told


def counted(events: Sequence[Event]) -> str:
    """Events of each kind, how many and how large."""
    said = []
    for kind in dict.fromkeys(event.kind for event in events):
        changes = [event.change for event in events if event.kind == kind]
        low, high = min(changes), max(changes)
        size = f"{low:+.3g} mA" if len(changes) == 1 else f"{low:+.3g} to {high:+.3g} mA"
        said.append(f"{kind} {len(changes)} times ({size})")
    return "; ".join(said)


def event_rows(study: RecordStudy) -> list[list[str]]:
    """Kind, time, duration and change of what was cut away; a long list is cut, and says so."""
    rows = [
        [event.kind, f"{event.time:.0f} s", f"{event.duration:.0f} s", f"{event.change:+.4g} mA"]
        for event in study.events[:MOST_EVENTS]
    ]
    left = len(study.events) - len(rows)
    return rows + ([[f"{left} more", "", "", ""]] if left else [])
