"""The report of an emittance fit."""

from __future__ import annotations

from collections.abc import Mapping

from beamfit.quantity import Status
from beamfit.report.document import Page, Picture, Table, Verdict, by_name, provenance, written
from beamfit.report.figures import pictures
from beamfit.studies.scan.fit import EmittanceFit
from beamfit.studies.scan.results import (
    PlaneFit,
    identifiability_rows,
    parameter_rows,
    point_rows,
    result_rows,
)
from beamfit.studies.scan.sensitivity import budget_rows, range_rows

__all__ = ["emittance_page"]

ERRORS = (
    "Errors are one standard deviation, scaled by sqrt(χ²/dof) where that exceeds 1. "
    "“Not determined” means the data put no error on the value; it is not to be quoted."
)


def emittance_page(
    fit: EmittanceFit, command: str | None, inputs: Mapping[str, str | None] | None
) -> Page:
    """Lay out an emittance fit.

    Parameters
    ----------
    fit : EmittanceFit
        The fit.
    command : str or None
        The command that made it.
    inputs : mapping of str to str, or None
        Input files and their SHA-256; the scan's own if None.

    Returns
    -------
    Page
    """
    scan, line = fit.scan, fit.line
    if inputs is None:
        inputs = {str(scan.path): scan.sha256} if scan.path else {}
    names = [p.plane for p in fit.planes]
    source = scan.error_source if scan.error else "none in the file; inferred"
    tables = [
        by_name("Result", names, result_rows(fit.planes), ERRORS),
        by_name("What the data determine", names, identifiability_rows(fit.planes)),
        *(_budgets(fit, names) if fit.statement.closed else _fitted_too(fit)),
        *(Table(f"Points, {p.plane} plane", *point_rows(p), numeric=True) for p in fit.planes),
    ]
    energy = f"{float(line.energy):g} MeV"
    if not fit.statement.closed:
        energy += f", scenario {fit.scenario}"
    return Page(
        title=f"Emittance of {scan.name}",
        subtitle=f"{len(scan)} settings on line {line.name}, {energy}; {written()}",
        verdicts=[_verdict(p) for p in fit.planes],
        tables=tables,
        pictures=[Picture(*each) for each in pictures(fit)],
        pictures_title="Scan and fit",
        provenance=provenance(inputs, [("errors of the sizes", source)], command),
        notes=scan.provenance,
    )


def _budgets(fit: EmittanceFit, names: list[str]) -> list[Table]:
    """What the emittance would be with another line or fewer points."""
    return [
        by_name(
            "If the line were a little different",
            names,
            budget_rows(fit),
            "Relative change of the normalised emittance, from exact derivatives.",
            numeric=True,
        ),
        by_name(
            "If some points were left out",
            names,
            range_rows(fit),
            "Normalised emittance, and its shift in standard errors of the full fit.",
        ),
    ]


def _fitted_too(fit: EmittanceFit) -> list[Table]:
    """What a scenario fitted besides the beam, and what the data leave open."""
    rows = [[name, *cells] for name, cells in parameter_rows(fit.parameters)]
    header = ["fitted too", "value", "bounds", "prior", "state"]
    parts = [Table(f"Scenario {fit.scenario}", header, rows, _anchor(fit))]
    if not rows:
        parts = []
    if fit.null_directions:
        listed = [[words + "."] for words in fit.null_directions]
        parts.append(Table("Left open by the data", [], listed))
    return parts


def _verdict(p: PlaneFit) -> Verdict:
    determined = p.status is not Status.unidentified
    value = f"normalised emittance {p.normalized_emittance}"
    headline = value if determined else "emittance not determined"
    return Verdict(p.status.value, f"{p.plane}: {headline}", p.message)


def _anchor(fit: EmittanceFit) -> str:
    """What ties a network to the lattice; a calibration has priors instead."""
    return f"Anchor: {fit.anchor}." if fit.statement.network else ""
