"""A report: one self-contained HTML page, or the same as PDF."""

from __future__ import annotations

import base64
import io
import platform
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from importlib.metadata import version
from os import PathLike
from pathlib import Path
from typing import Any

import jinja2
from matplotlib import rc_context
from matplotlib.figure import Figure, FigureBase

import beamfit
from beamfit.errors import InputError
from beamfit.inference.quantity import Status
from beamfit.io.files import write_atomically
from beamfit.report.figures import STYLE, pictures
from beamfit.report.pdf import pdf_of
from beamfit.studies.fit import EmittanceFit
from beamfit.studies.results import PlaneFit
from beamfit.studies.sensitivity import budget_rows, range_rows
from beamfit.studies.tables import identifiability_rows, point_rows, result_rows

__all__ = ["write_report"]


def write_report(
    path: str | PathLike[str],
    fit: EmittanceFit,
    *,
    command: str | None = None,
    inputs: Mapping[str, str | None] | None = None,
) -> None:
    """Write a report page of a fit.

    Parameters
    ----------
    path : str or path
        Ends in ``.html`` (self-contained) or ``.pdf``. An existing file is replaced whole.
    fit : EmittanceFit
        The fit.
    command : str, optional
        The command that made it.
    inputs : mapping of str to str, optional
        Input files and their SHA-256; the scan's own if None.

    Raises
    ------
    InputError
        If the suffix is another one or the place cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> from beamfit.optics.elements import Drift, Quadrupole, Screen
    >>> line = beamfit.Beamline((Quadrupole("Q", 0.1), Drift("D", 2.0), Screen("S")), 135.0)
    >>> sizes = [3.4e-4, 1.9e-4, 0.9e-4, 1.9e-4, 3.4e-4]
    >>> scan = beamfit.QuadScan({"Q": [-1.0, 1.5, 4.0, 6.5, 9.0]}, {"Q": "k1"}, {"x": sizes})
    >>> page = Path(tempfile.mkdtemp()) / "scan.html"
    >>> write_report(page, beamfit.fit_emittance(scan, line))
    >>> page.read_text().startswith("<!DOCTYPE html>")
    True
    """
    suffix = Path(path).suffix.lower()
    if suffix not in (".html", ".pdf"):
        raise InputError(f"report '{path}'", "a name ending in .html or .pdf", path=path)
    content = _content(fit, command, inputs)
    with rc_context(STYLE):
        if suffix == ".html":
            page = _html(content, pictures(fit)).encode()
        else:
            page = pdf_of(content, pictures(fit))
    write_atomically(path, page)


def _content(
    fit: EmittanceFit, command: str | None, inputs: Mapping[str, str | None] | None
) -> dict[str, Any]:
    """Everything on the page except the pictures."""
    scan, line = fit.scan, fit.line
    if inputs is None:
        inputs = {str(scan.path): scan.sha256} if scan.path else {}
    packages = ", ".join(f"{n} {version(n)}" for n in ("jax", "numpy", "scipy", "matplotlib"))
    provenance = [(f"sha256 of {name}", digest or "-") for name, digest in inputs.items()]
    provenance += [
        ("errors of the sizes", scan.error_source if scan.error else "none in the file; inferred"),
        ("made by", f"beamfit {beamfit.__version__} on Python {platform.python_version()}"),
        ("with", packages),
        ("command", command or "from Python"),
    ]
    when = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    energy = f"{float(line.energy):g} MeV"
    return {
        "title": f"Emittance of {scan.name}",
        "subtitle": f"{len(scan)} settings on line {line.name}, {energy}; written {when}",
        "planes": [_plane(p) for p in fit.planes],
        "results": result_rows(fit.planes),
        "budget": budget_rows(fit),
        "ranges": range_rows(fit),
        "identifiability": identifiability_rows(fit.planes),
        "provenance": provenance,
        "notes": scan.provenance,
    }


def _plane(p: PlaneFit) -> dict[str, Any]:
    header, rows = point_rows(p)
    determined = p.status is not Status.unidentified
    return {
        "plane": p.plane,
        "status": p.status.value,
        "headline": f"normalised emittance {p.normalized_emittance}"
        if determined
        else "emittance not determined",
        "message": p.message,
        "point_header": header,
        "point_rows": rows,
    }


def _html(content: Mapping[str, Any], drawings: list) -> str:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("beamfit.report", ""),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
    )
    shown = [{"alt": alt, "data": _svg(height, draw)} for alt, height, draw in drawings]
    return environment.get_template("page.html.j2").render(**content, pictures=shown)


def _svg(height: float, draw: Callable[[FigureBase], None]) -> str:
    figure, buffer = Figure(figsize=(6.4, height), layout="constrained"), io.BytesIO()
    draw(figure)
    figure.savefig(buffer, format="svg")
    return base64.b64encode(buffer.getvalue()).decode()
