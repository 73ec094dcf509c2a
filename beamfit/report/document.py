"""What a report page consists of, whatever it reports, and its HTML form."""

from __future__ import annotations

import base64
import io
import platform
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from importlib.metadata import version
from typing import NamedTuple

import jinja2
from matplotlib.figure import Figure, FigureBase

import beamfit

__all__ = ["Page", "Picture", "Table", "Verdict", "by_name", "html_of", "provenance", "written"]


class Verdict(NamedTuple):
    """A status with its headline and its sentence."""

    status: str
    headline: str
    message: str


class Table(NamedTuple):
    """A table under a heading; an empty header leaves the head row out.

    `numeric` sets all cells but the first column's flush right.
    """

    title: str
    header: list[str]
    rows: list[list[str]]
    note: str = ""
    numeric: bool = False


class Picture(NamedTuple):
    """What a picture shows, its height in inches, and how to draw it into a figure."""

    alt: str
    height: float
    draw: Callable[[FigureBase], None]


class Page(NamedTuple):
    """A report: verdicts first, then tables with the pictures after the first one."""

    title: str
    subtitle: str
    verdicts: list[Verdict]
    tables: list[Table]
    pictures: list[Picture]
    pictures_title: str
    provenance: list[tuple[str, str]]
    notes: tuple[str, ...]


def by_name(
    title: str,
    names: list[str],
    rows: list[tuple[str, list[str]]],
    note: str = "",
    numeric: bool = False,
) -> Table:
    """Make a table of labelled rows with one column a result.

    Parameters
    ----------
    title : str
        Heading.
    names : list of str
        One a result.
    rows : list of (str, list of str)
        Label and cells.
    note : str, optional
        A sentence between heading and table.
    numeric : bool, optional
        Whether cells are set flush right.

    Returns
    -------
    Table
    """
    return Table(title, ["", *names], [[label, *cells] for label, cells in rows], note, numeric)


def provenance(
    inputs: Mapping[str, str | None], remarks: list[tuple[str, str]], command: str | None
) -> list[tuple[str, str]]:
    """List where a report comes from: input digests, remarks, versions, command."""
    packages = ", ".join(f"{n} {version(n)}" for n in ("jax", "numpy", "scipy", "matplotlib"))
    return [
        *((f"sha256 of {name}", digest or "-") for name, digest in inputs.items()),
        *remarks,
        ("made by", f"beamfit {beamfit.__version__} on Python {platform.python_version()}"),
        ("with", packages),
        ("command", command or "from Python"),
    ]


def written() -> str:
    """When this is, for a subtitle."""
    return "written " + datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")


def html_of(page: Page) -> bytes:
    """Make the HTML form of a report, pictures inside.

    Parameters
    ----------
    page : Page
        The report.

    Returns
    -------
    bytes
        The file.
    """
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("beamfit.report", ""),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
    )
    pictures = [{"alt": p.alt, "data": _svg(p)} for p in page.pictures]
    content = page._asdict() | {"pictures": pictures}
    return environment.get_template("page.html.j2").render(**content).encode()


def _svg(picture: Picture) -> str:
    figure, buffer = Figure(figsize=(6.4, picture.height), layout="constrained"), io.BytesIO()
    picture.draw(figure)
    figure.savefig(buffer, format="svg")
    return base64.b64encode(buffer.getvalue()).decode()
