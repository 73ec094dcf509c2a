"""Tables of a scan that only a page shows: what the data determine, and the points one by one."""

from __future__ import annotations

from collections.abc import Callable
from itertools import islice

from beamfit.emittance.results import PlaneFit, degrees
from beamfit.table import cell

# Most rows in a table of points.
MOST_ROWS = 500


def identifiability_rows(
    planes: tuple[PlaneFit, ...],
) -> list[tuple[str, list[str]]]:
    """Label and one cell per plane for what the data determine."""
    rows: list[tuple[str, Callable[[PlaneFit], object]]] = [
        ("emittance", lambda p: "determined" if p.identifiability.determined else "not determined"),
        ("not determined", lambda p: ", ".join(p.identifiability.undetermined) or "nothing"),
        (
            "singular values",
            lambda p: ", ".join(f"{v:.3g}" for v in p.identifiability.singular_values),
        ),
        ("condition", lambda p: _condition(p.identifiability.condition)),
        ("probability of a beam", lambda p: f"{p.identifiability.probability['beam']:.4f}"),
        ("waist bracketed", lambda p: p.identifiability.waist_bracketed),
        ("phase advance covered", lambda p: degrees(p.identifiability.phase_coverage)),
    ]
    return [(label, [cell(value(p)) for p in planes]) for label, value in rows]


def _condition(value: float | None) -> str:
    return "infinite" if value is None else f"{value:.3g}"


def point_rows(plane: PlaneFit) -> tuple[list[str], list[list[str]]]:
    """Header and rows of the point-by-point table of one plane.

    Parameters
    ----------
    plane : PlaneFit
        The plane.

    Returns
    -------
    tuple
        Column names, and one list of cells a point.
    """
    p = plane.points
    columns = {"screen": p.screen} if len(set(p.screen)) > 1 else {}
    columns |= {f"{n} {p.units[n]}": map("{:.5g}".format, v) for n, v in p.settings.items()}
    for name, size in (("size", p.size), ("error", p.error), ("fit", p.model)):
        columns[f"{name} µm"] = map("{:.2f}".format, 1e6 * size)
    columns["pull"] = map("{:+.2f}".format, p.pull)
    if (p.outlier_probability > 0.05).any():
        columns["P(bad)"] = map("{:.2f}".format, p.outlier_probability)
    rows = [list(row) for row in islice(zip(*columns.values(), strict=True), MOST_ROWS)]
    left = len(p.size) - len(rows)
    if left > 0:
        rows.append([f"{left} more"] + [""] * (len(columns) - 1))
    return list(columns), rows
