"""The report of decay records."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from beamfit.quantity import Status
from beamfit.report.decay_figures import decay_pictures
from beamfit.report.document import Page, Table, Verdict, by_name, provenance, written
from beamfit.studies.decay.shift import Shift
from beamfit.studies.decay.study import Decay, RecordStudy
from beamfit.studies.decay.tables import (
    FEW,
    alike,
    budget_rows,
    check_rows,
    decay_rows,
    event_rows,
    overview,
    separability_rows,
    shift_rows,
)

__all__ = ["decay_page"]

ERRORS = (
    "dI/dt = -a I² - b I. Errors are one standard deviation, scaled by sqrt(χ²/dof) where that "
    "exceeds 1. “Not determined” means the record puts no error on the value; it is not to be "
    "quoted."
)
CHECKS = (
    "Analyses that take the lifetime as constant, for comparison: their errors do not contain the "
    "bias stated. “Constant a” asks whether a power of the current describes the loss better."
)
BUDGET = (
    "Computed for the ring file and the record's own settings, nothing fitted. The percentages are "
    "shares of the computed loss at the mean current."
)
SHIFT = (
    "Scales multiply the ring file's first principles. Brackets are 68 % credible intervals. The "
    "best point is sought within the range of settings seen."
)
# Decays beside one another in one table.
ABREAST = 2


def decay_page(
    studies: Sequence[RecordStudy],
    command: str | None,
    inputs: Mapping[str, str | None] | None,
    shift: Shift | None = None,
) -> Page:
    """Lay out decay records.

    Parameters
    ----------
    studies : sequence of RecordStudy
        At least one record.
    command : str or None
        The command that made it.
    inputs : mapping of str to str, or None
        Input files and their SHA-256.
    shift : Shift, optional
        The study of all decays together.

    Returns
    -------
    Page
    """
    decays = [decay for study in studies for decay in study.decays]
    tables = [] if shift is None else [by_name("All decays", ["value"], shift_rows(shift), SHIFT)]
    tables += _side_by_side(decays) if len(decays) <= FEW else _one_below_another(decays)
    header = ["what", "at", "for", "change"]
    tables += [
        Table(f"Cut at or left out of {study.record.name}", header, event_rows(study))
        for study in studies
        if study.events
    ]
    names = [study.record.name for study in studies]
    title = names[0] if len(names) == 1 else f"{len(names)} records"
    hours = sum(study.record.span for study in studies) / 3600
    count = f"{len(decays)} decay" + ("s" if len(decays) > 1 else "")
    return Page(
        title=f"Beam lifetime of {title}",
        subtitle=f"{count} in {hours:.3g} h of record; {written()}",
        verdicts=_shift_verdicts(shift) + _verdicts(decays),
        tables=tables,
        pictures=decay_pictures(studies),
        pictures_title="Records and fits",
        provenance=provenance(inputs or {}, [], command),
        notes=tuple(note for study in studies for note in study.record.comments),
    )


def _side_by_side(decays: Sequence[Decay]) -> list[Table]:
    """Every number of a few decays, one column each."""
    groups = [decays[k : k + ABREAST] for k in range(0, len(decays), ABREAST)]
    parts = [
        ("Result", ERRORS, decay_rows),
        ("What the records determine", "", separability_rows),
        ("Simpler analyses, and whether a is constant", CHECKS, check_rows),
        ("Losses from first principles", BUDGET, budget_rows),
    ]
    return [
        by_name(
            title, [decay.fit.record for decay in group], rows, note if group is groups[0] else ""
        )
        for title, note, rows_of in parts
        for group in groups
        if (rows := rows_of(group))
    ]


def _one_below_another(decays: Sequence[Decay]) -> list[Table]:
    """The main numbers of many decays, one row each."""
    return [
        Table(title, header, rows, {"Result": ERRORS}.get(title, ""))
        for title, header, rows in overview(decays)
    ]


def _verdicts(decays: Sequence[Decay]) -> list[Verdict]:
    """One for each decay; of many decays one for each thing said."""
    if len(decays) <= FEW:
        return [_verdict(decay) for decay in decays]
    return [Verdict(status.value, who, message) for status, who, message in alike(decays)]


def _verdict(decay: Decay) -> Verdict:
    fit = decay.fit
    value = f"lifetime {fit.lifetime_mean} at {fit.mean_current:.4g} mA"
    headline = value if fit.lifetime_mean.error is not None else "lifetime not determined"
    message = fit.message
    if decay.checks is not None and decay.checks.constant_a.status is Status.poor_fit:
        message = f"{message} {decay.checks.constant_a.message}"
    return Verdict(fit.status.value, f"{fit.record}: {headline}", message)


def _shift_verdicts(shift: Shift | None) -> list[Verdict]:
    if shift is None:
        return []
    fit, best = shift.fit, shift.best
    said = [
        Verdict(fit.status.value, f"{len(fit.names)} decays together", fit.message),
        Verdict("converged", f"best lifetime {best.lifetime}", best.message),
    ]
    found = shift.anomaly
    if found is not None:
        said.append(Verdict(found.status.value, "second half against the first", found.message))
    return said
