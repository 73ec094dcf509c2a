"""A fit as rows of text: the one list that terminal, notebook and report all show."""

from __future__ import annotations

from collections.abc import Callable
from html import escape

import numpy as np

from beamfit.quantity import Quantity
from beamfit.studies.scan.results import Parameter, PlaneFit

# A longer table of points is cut, and says so.
MOST_ROWS = 500

__all__ = [
    "as_html",
    "as_text",
    "identifiability_rows",
    "parameter_rows",
    "point_rows",
    "result_rows",
]


def result_rows(planes: tuple[PlaneFit, ...]) -> list[tuple[str, list[str]]]:
    """Label and one cell per plane, for every number a result has.

    Parameters
    ----------
    planes : tuple of PlaneFit
        The planes of a fit.

    Returns
    -------
    list of (str, list of str)
        Rows in the order they are read.
    """
    at = f"at {planes[0].screen.name}"
    there = planes[0].screen
    own = ", ".join(f"{n} = {v:.4g} {there.units[n]}" for n, v in there.settings.items()) or "-"
    rows: list[tuple[str, Callable[[PlaneFit], object]]] = [
        ("status", lambda p: p.status.value.replace("_", " ")),
        ("normalised emittance", lambda p: p.normalized_emittance),
        ("geometric emittance", lambda p: p.emittance),
        ("beta at the start", lambda p: p.beta),
        ("alpha at the start", lambda p: p.alpha),
        ("sigma11", lambda p: p.sigma[0]),
        ("sigma12", lambda p: p.sigma[1]),
        ("sigma22", lambda p: p.sigma[2]),
        (f"beta {at}", lambda p: p.screen.beta),
        (f"alpha {at}", lambda p: p.screen.alpha),
        (f"size {at}", lambda p: p.screen.size),
        (f"{at}, for", lambda p: own),
    ]
    if any(p.mismatch is not None for p in planes):
        rows.append(("mismatch BMAG", lambda p: p.mismatch if p.mismatch else "-"))
    rows += [
        ("chi2/dof", _chi2),
        ("rms residual", lambda p: f"{p.rms_residual.value * 1e6:.3g} µm"),
        ("errors", lambda p: _noise(p)),
        ("waist bracketed", lambda p: _yes(p.identifiability.waist_bracketed)),
        ("phase seen", lambda p: _degrees(p.identifiability.phase_coverage)),
        ("zero emittance at", lambda p: f"{p.identifiability.zero_distance:.1f} sigma"),
    ]
    return [(label, [_cell(cell(p)) for p in planes]) for label, cell in rows]


def _cell(value: object) -> str:
    text = str(value)
    return text.replace("^2", "²") if isinstance(value, Quantity) else text


def _chi2(p: PlaneFit) -> str:
    if p.chi2 is None:
        return f"not testable ({p.dof} dof)"
    return f"{p.chi2:.2f}/{p.dof}" + (f" = {p.chi2 / p.dof:.2f}" if p.dof else "")


def _noise(p: PlaneFit) -> str:
    if p.chi2 is None and not np.isfinite(p.points.error).all():
        return "not known"
    if p.chi2 is None:
        return f"inferred, {100 * float((p.points.error / p.points.size).mean()):.2g} % of size"
    return "as given" if p.error_scale == 1.0 else f"given, scaled by {p.error_scale:.2f}"


def _yes(value: bool | None) -> str:
    return "-" if value is None else ("yes" if value else "no")


def _degrees(value: float | None) -> str:
    return "-" if value is None else f"{value:.0f}° of 180°"


def identifiability_rows(
    planes: tuple[PlaneFit, ...],
) -> list[tuple[str, list[str]]]:
    """Label and one cell per plane for what the data determine."""
    rows: list[tuple[str, Callable[[PlaneFit], str]]] = [
        ("emittance", lambda p: "determined" if p.identifiability.determined else "not determined"),
        ("left open", lambda p: ", ".join(p.identifiability.undetermined) or "nothing"),
        (
            "singular values",
            lambda p: ", ".join(f"{v:.3g}" for v in p.identifiability.singular_values),
        ),
        ("condition", lambda p: _condition(p.identifiability.condition)),
        ("zero emittance at", lambda p: f"{p.identifiability.zero_distance:.1f} standard errors"),
        ("waist bracketed", lambda p: _yes(p.identifiability.waist_bracketed)),
        ("betatron phase seen", lambda p: _degrees(p.identifiability.phase_coverage)),
    ]
    return [(label, [cell(p) for p in planes]) for label, cell in rows]


def parameter_rows(parameters: tuple[Parameter, ...]) -> list[tuple[str, list[str]]]:
    """Name, value, bounds, prior and state of every number fitted besides the beam."""
    rows = []
    for p in parameters:
        bounded = abs(p.lower) < 1e300 or abs(p.upper) < 1e300
        said = f"{p.state} bound, multiplier {p.multiplier:.2g}" if p.state != "free" else "free"
        value = _cell(p.value).replace("(not determined)", "(open)")
        prior = f"{p.prior[0]:.6g} ± {p.prior[1]:.3g}" if p.prior else "-"
        limits = f"{p.lower:.6g} to {p.upper:.6g}" if bounded else "-"
        rows.append((p.name, [value, limits, prior, said]))
    return rows


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
    header = [*(f"{n} {p.units[n]}" for n in p.settings), "size µm", "error µm", "fit µm", "pull"]
    screens = len(set(p.screen)) > 1
    header = (["screen"] if screens else []) + header
    if p.outlier_probability is not None:
        header.append("P(outlier)")
    rows = []
    for i in range(min(len(p.size), MOST_ROWS)):
        cells = [p.screen[i]] if screens else []
        cells += [f"{values[i]:.5g}" for values in p.settings.values()]
        cells += [f"{1e6 * v[i]:.2f}" for v in (p.size, p.error, p.model)]
        cells.append(f"{p.pull[i]:+.2f}")
        if p.outlier_probability is not None:
            cells.append(f"{p.outlier_probability[i]:.2f}")
        rows.append(cells)
    left = len(p.size) - len(rows)
    if left > 0:
        rows.append([f"{left} more"] + [""] * (len(header) - 1))
    return header, rows


def as_text(heading: str, planes: tuple[PlaneFit, ...]) -> str:
    """Lay the result out for a terminal, verdicts below the numbers."""
    rows = result_rows(planes)
    width = max(len(label) for label, _ in rows)
    columns = [max(len(r[1][i]) for r in rows) for i in range(len(planes))]
    head = [p.plane.ljust(w) for p, w in zip(planes, columns, strict=True)]
    lines = [heading, "", " " * (width + 2) + "  ".join(head).rstrip()]
    for label, cells in rows:
        padded = [c.ljust(w) for c, w in zip(cells, columns, strict=True)]
        lines.append(f"{label.ljust(width)}  " + "  ".join(padded).rstrip())
    lines += ["", *(f"{p.plane}: {p.message}" for p in planes)]
    return "\n".join(lines)


def as_html(planes: tuple[PlaneFit, ...]) -> str:
    """Lay the result out for a notebook."""
    head = "".join(f"<th>{p.plane}</th>" for p in planes)
    body = "".join(
        f"<tr><th style='text-align:left'>{escape(label)}</th>"
        + "".join(f"<td style='text-align:left'>{escape(c)}</td>" for c in cells)
        + "</tr>"
        for label, cells in result_rows(planes)
    )
    notes = "".join(f"<p><b>{p.plane}</b>: {escape(p.message)}</p>" for p in planes)
    return f"<table><thead><tr><th></th>{head}</tr></thead><tbody>{body}</tbody></table>{notes}"
