"""Tables of decays and their loss budgets, for terminal and report."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence

from beamfit.answer import MAX_ROWS_SHOWN, Row, Table, cell
from beamfit.lifetime.fit import DecayFit
from beamfit.lifetime.mechanisms import LINEAR, QUADRATIC, Mechanism
from beamfit.lifetime.pieces import Event
from beamfit.lifetime.study import Budget, Decay, RecordStudy
from beamfit.quantity import HOUR, Quantity, Status

# Largest number of decays of which all numbers are shown; of more only the main ones, in one row
# for each decay. Chosen: the columns of a terminal.
MAX_FULL_DECAYS = 4
# Percent of the loss below which a mechanism is called negligible.
NEGLIGIBLE = 1e-6
# Labels and values of one decay.
Cells = Mapping[str, object]


def _side_by_side(
    decays: Sequence[Decay], cells_of: Callable[[Decay], Cells], quoted: bool = False
) -> list[Row]:
    """Rows with one cell per decay, for all labels that occur."""
    found = [cells_of(decay) for decay in decays]
    labels = dict.fromkeys(label for cells in found for label in cells)
    return [Row(label, [cells.get(label) for cells in found], quoted) for label in labels]


def decay_rows(decays: Sequence[Decay]) -> list[Row]:
    """Rows of all numbers of the fits, with one cell per decay."""
    return [
        *_side_by_side(decays, _head),
        *_side_by_side(decays, _numbers, quoted=True),
        *_side_by_side(decays, _residuals),
    ]


def _head(decay: Decay) -> Cells:
    readings = f"{len(decay.segment)} over {_span(decay.segment.span)}"
    return {"status": decay.fit.status, "readings": readings}


def _span(seconds: float) -> str:
    if seconds >= HOUR:
        return f"{seconds / HOUR:.3g} h"
    return f"{seconds / 60:.3g} min" if seconds >= 60 else f"{seconds:.3g} s"


def _numbers(decay: Decay) -> Cells:
    fit = decay.fit
    if fit.first is None:
        first, last = "start", "end"
        begin = {"current at the start": fit.i0}
    else:
        first, last = "highest current", "lowest current"
        begin = {"cycles": f"{fit.first.size} at {fit.mean_current:.5g} mA"}
    numbers = {
        f"lifetime at the {first}": fit.lifetime_start,
        "lifetime at the mean current": fit.lifetime_mean,
        f"lifetime at the {last}": fit.lifetime_end,
        "a": fit.a,
        "b": fit.b,
        "95 % interval of a": fit.a.interval_words,
        "95 % interval of b": fit.b.interval_words,
    }
    refuted = fit.constant_a is not None and fit.constant_a.status is Status.poor_fit
    if fit.first is None and fit.free_law is not None and not refuted:
        numbers |= {f"{name} if a and b are constant": fit.if_constant(name) for name in "ab"}
    chi2 = f"{fit.chi2:.4g}/{fit.dof} = {_reduced_chi2(fit)}"
    if fit.noise_inferred:
        chi2 = f"not testable ({fit.dof} dof)"
    return begin | numbers | {"chi2/dof": chi2}


def _reduced_chi2(fit: DecayFit) -> str:
    return "not testable" if fit.noise_inferred else f"{fit.chi2 / fit.dof:.3g}"


def _residuals(decay: Decay) -> Cells:
    errors = "inferred from the residuals" if decay.fit.noise_inferred else "as given"
    return {"rms residual": f"{decay.fit.rms_residual:.3g} mA", "errors": errors}


def course_tables(decays: Sequence[Decay]) -> list[Table]:
    """Tables of the lifetime by part, for records whose loss rate changes."""
    header = ["from, h", "to, h", "lifetime at the mean current"]
    return [
        Table(f"Course of the lifetime in {decay.fit.record}", header, [
            [f"{part.start / HOUR:.4g}", f"{part.end / HOUR:.4g}", cell(part.lifetime)]
            for part in decay.fit.course
        ])
        for decay in decays if decay.fit.course
    ]  # fmt: skip


def separability_rows(decays: Sequence[Decay]) -> list[Row]:
    """Rows on the separability of a and b, with one cell per decay."""
    return _side_by_side(decays, _separability)


def _separability(decay: Decay) -> Cells:
    found = decay.fit.identifiability
    share = None if found.share is None else Quantity(found.share, found.share_error, "1")
    return {
        "a and b": "separable" if found.separable else "not separable",
        "share of a in the loss": share,
        "correlation of a and b": _number(found.correlation, ".6f"),
        "neighbouring residuals": _number(found.residual_correlation, ".2f"),
        "errors enlarged for that": _number(found.error_inflation, ".1f", " times"),
    }


def _number(value: float | None, form: str, unit: str = "") -> str:
    return "-" if value is None else f"{value:{form}}{unit}"


def check_rows(decays: Sequence[Decay]) -> list[Row]:
    """Rows of simpler analyses and of the test of a constant a, with one cell per decay."""
    return _side_by_side(decays, _checks)


def _checks(decay: Decay) -> Cells:
    fit, gas = decay.fit, decay.fit.outgassing
    cells = {
        "single exponential": _one_lifetime(decay, "single_exponential"),
        "line through ln I": _one_lifetime(decay, "log_linear"),
        "constant a": _constant_a(fit),
        "lifetime by current": fit.lifetimes and str(fit.lifetimes),
    }
    if gas is not None:
        cells |= {
            "gas loss relaxes within": gas.time_constant,
            "lifetime at first": gas.before,
            "without that gas": gas.after,
            "a beside it": gas.a,
            "b in the end": gas.b,
        }
    return {label: value for label, value in cells.items() if value is not None}


def _one_lifetime(decay: Decay, name: str) -> str | None:
    found = decay.checks.get(name)
    if found is None:
        return None
    known = math.isfinite(found.bias_start)
    bias = f"{100 * found.bias_start:+.2g} % at start, " if known else ""
    return f"{found.lifetime} ({bias}{found.rms_residual:.3g} mA rms)"


def _constant_a(fit: DecayFit) -> str | None:
    found = fit.constant_a
    if found is None:
        return None
    said = {Status.converged: "not contradicted", Status.poor_fit: "rejected"}
    chance = f" (p = {found.p_value:.2g})"
    return said[found.status] + chance if found.status in said else "not testable with this record"


def systematic_table(decay: Decay, title: str) -> Table:
    """Table of systematic errors: shifts of a, b and the lifetime at the mean current by cause."""
    fit = decay.fit
    values = fit.a.value, fit.b.value, fit.lifetime_mean.value
    rows = [
        [cause, *(_percent(*pair) for pair in zip(by, values, strict=True))]
        for cause, *by in decay.systematics
    ]
    return Table(title, ["if the", "a", "b", "lifetime at the mean"], rows)


def _percent(moved: float, value: float) -> str:
    if value == 0:  # no relative shift, as of an a at its limit
        return "-"
    share = moved / value
    return f"{100 * share:+.0f} %" if abs(share) > 1 - 1e-9 else f"{100 * share:+.2g} %"


def budget_rows(decays: Sequence[Decay]) -> list[Row]:
    """Rows of computed and measured losses, with one cell per decay; empty without a ring."""
    return _side_by_side(decays, _budget) if _have_budgets(decays) else []


def _have_budgets(decays: Sequence[Decay]) -> bool:
    return all(decay.budget is not None for decay in decays) and len(decays) > 0


def _settings(budget: Budget) -> dict[str, object]:
    voltage, scraper, bunches = map(float, budget.operation[:3])
    return {
        "RF voltage": f"{voltage / 1e3:.6g} kV",
        "scraper": f"{scraper * 1e3:.4g} mm",
        "bunches": f"{bunches:.6g}",
    }


def _budget(decay: Decay) -> Cells:
    budget, fit = decay.budget, decay.fit
    x, y = (f"{1e9 * value:.4g}" for value in budget.emittances)
    pressure = f"{budget.pressure:.3g} Pa"
    if budget.filed_pressure is not None:
        pressure += f", as the gauge reads; {budget.filed_pressure:.3g} Pa by the ring file"
    losses = budget.losses
    return {
        **_settings(budget),
        "emittances, as given: no intrabeam scattering": f"{x} and {y} nm",
        "rms bunch length": f"{1e3 * budget.bunch_length:.4g} mm",
        "pressure at the mean current": pressure,
        **{f"a, {m.label}": _part(budget, "a", m) for m in QUADRATIC},
        "a, sum": f"{losses.a:.4g} 1/(mA s)",
        "a, measured": fit.a,
        **{f"b, {m.label}": _part(budget, "b", m) for m in LINEAR},
        "b, sum": f"{losses.b:.4g} 1/s",
        "b, measured": fit.b,
        "lifetime at the mean, computed": f"{budget.lifetime:.4g} h",
        "lifetime at the mean, measured": fit.lifetime_mean,
    }


def _part(budget: Budget, kind: str, mechanism: Mechanism) -> str:
    """Part of a mechanism in a or b, with its share of the loss at the mean current."""
    value = float(getattr(budget.losses, f"{kind}_{mechanism.name}"))
    rate, unit = (value * budget.current, "1/(mA s)") if kind == "a" else (value, "1/s")
    share = 100 * rate * HOUR * budget.lifetime
    if share < NEGLIGIBLE:
        return "negligible"
    return f"{value:.4g} {unit} ({share:.3g} % of the loss)"


def overview(decays: Sequence[Decay]) -> list[Table]:
    """Tables of the main numbers of many decays, one row each.

    Parameters
    ----------
    decays : sequence of Decay
        More than `MAX_FULL_DECAYS` decays.

    Returns
    -------
    list of Table
    """
    main = {"Result": _result, "a and b": _a_and_b}
    main |= {"Losses from first principles": _computed} if _have_budgets(decays) else {}
    tables, names = [], short_names(decays)
    for title, cells_of in main.items():
        found = [cells_of(decay) for decay in decays]
        rows = [
            [names[decay.fit.record], *map(cell, cells.values())]
            for decay, cells in zip(decays, found, strict=True)
        ]
        tables.append(Table(title, ["decay", *found[0]], rows))
    return tables


def _result(decay: Decay) -> Cells:
    fit = decay.fit
    numbers = {"current at the start": fit.i0, "lifetime at the mean current": fit.lifetime_mean}
    return {"status": fit.status} | numbers


def _a_and_b(decay: Decay) -> Cells:
    fit = decay.fit
    return {"a": fit.a, "b": fit.b, "chi2/dof": _reduced_chi2(fit)}


def _computed(decay: Decay) -> Cells:
    computed = {"computed": f"{decay.budget.lifetime:.4g} h"}
    return _settings(decay.budget) | computed | {"measured": decay.fit.lifetime_mean}


def short_names(decays: Sequence[Decay]) -> dict[str, str]:
    """Short names of decays in a table: their number if all are of one record."""
    names = [decay.fit.record for decay in decays]
    records = {name.rpartition("#")[0] for name in names}
    whole = len(records) > 1 or "" in records
    return {name: name if whole else "#" + name.rpartition("#")[2] for name in names}


def distinct_verdicts(decays: Sequence[Decay]) -> list[tuple[Status, str, str]]:
    """Status, decays and message of each different verdict.

    Verdicts `converged` that differ only in numbers are one, with the numbers of the first decay.
    """
    found: dict[tuple[Status, str], list[DecayFit]] = {}
    for decay in decays:
        fit = decay.fit
        is_converged = fit.status is Status.converged
        words = re.sub(r"\d[\d.e+-]*", "#", fit.message) if is_converged else fit.message
        found.setdefault((fit.status, words), []).append(fit)
    verdicts, names = [], short_names(decays)
    for (status, _), fits in found.items():
        who, message = names[fits[0].record], fits[0].message
        if len(fits) > 1:
            who = f"{len(fits)} decays, {who} to {names[fits[-1].record]}"
        if len({fit.message for fit in fits}) > 1:
            message = f"{message.rstrip('.')} (numbers are the first's)."
        verdicts.append((status, who, message))
    return verdicts


def event_summary(events: Sequence[Event]) -> str:
    """Sentence on the events: number and size of each kind."""
    parts = []
    for kind in dict.fromkeys(event.kind for event in events):
        changes = [event.change for event in events if event.kind == kind]
        low, high = min(changes), max(changes)
        size = f"{low:+.3g} mA" if len(changes) == 1 else f"{low:+.3g} to {high:+.3g} mA"
        parts.append(f"{kind} {len(changes)} times" + f" ({size})" * any(changes))
    return "; ".join(parts)


def event_rows(study: RecordStudy) -> list[list[str]]:
    """Rows of events: kind, time, duration and change; the last row counts those not shown."""
    rows = [
        [kind, f"{time:.0f} s", f"{lasts:.0f} s", f"{change:+.4g} mA" if change else ""]
        for kind, time, lasts, change in study.events[:MAX_ROWS_SHOWN]
    ]
    hidden = len(study.events) - len(rows)
    return rows + ([[f"{hidden} more", "", "", ""]] if hidden else [])
