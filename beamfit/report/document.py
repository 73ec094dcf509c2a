"""Parts common to all report pages, and their HTML form."""

from __future__ import annotations

import base64
import io
import math
import platform
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import ContextDecorator
from datetime import UTC, datetime
from importlib.metadata import version
from textwrap import fill
from typing import Any, NamedTuple

import jinja2
import numpy as np
from markupsafe import Markup, escape
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
from matplotlib.figure import Figure, FigureBase

import beamfit
from beamfit.answer import Table
from beamfit.errors import Status, plain

STYLE = {
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titleweight": "bold",
    "axes.titlesize": 11,
    "axes.titlelocation": "left",
    "figure.dpi": 110,
    "axes.formatter.useoffset": False,  # no offsets such as "+1e1" on an axis
    "text.parse_math": False,  # a $ in a name is not mathematics
}


def own_style() -> ContextDecorator:
    """Draw in a `with` block, or a function, in the style of the report, whatever a user's
    matplotlibrc says.

    Text set by TeX would need TeX, and take a % in a label for a comment.
    """
    return style.context(["default", STYLE])


# Colours of the page, also of the planes x and y.
BLUE, RED = "#1f5fa8", "#b5421f"
# Number of points above which a curve is rasterised, to keep the page small.
RASTER_POINTS = 500
# Largest number of curves, bars or profiles in a picture; the tables have all.
MAX_DRAWN = 12


# A day in files and their names: 2021-02-18, optionally with a time, or 22 June 2020.
DAY = re.compile(
    r"(?<!\d)((?:19|20)\d\d-\d\d-\d\d)(?:[-T _](\d\d)[:-]?(\d\d)[:-]?(\d\d))?(?!\d)"
    r"|(?<!\d)(\d{1,2} (?:January|February|March|April|May|June|July|August|September|October"
    r"|November|December) (?:19|20)\d\d)(?!\d)"
)


class Verdict(NamedTuple):
    """Status of a result with its headline and its sentence."""

    status: Status
    headline: str
    message: str

    @classmethod
    def of(cls, result: Any) -> Verdict:
        """Take status, headline and message from a result."""
        return cls(result.status, result.headline, result.message)


class Picture(NamedTuple):
    """Picture of a report: alternative text, height in inches, and a function that draws it.

    ``source`` gives file, date, line and quality of the fit, in small letters above the picture,
    so that it can be used alone in a logbook. ``width`` is its width in inches as a single file.
    """

    alt: str
    height: float
    draw: Callable[[FigureBase], None]
    source: str = ""
    width: float = 6.4

    def on(self, figure: FigureBase) -> None:
        """Draw the picture and its source on a figure."""
        self.draw(figure)
        if self.source:
            words = fill(self.source, round(14.5 * self.width))
            figure.suptitle(words, fontsize=8, color="0.35", x=0.01, ha="left")


class ReportPage(NamedTuple):
    """Content of a report: verdicts, the quoted numbers with the leading pictures, all else.

    The first table has the quoted numbers; the others are folded on a screen. ``leading`` is the
    number of pictures next to the first table.

    ``links`` are names and addresses of further pages. `with_provenance` adds the files and their
    SHA-256 in ``inputs``, and the ``remarks`` on them, to the ``provenance``.
    """

    title: str
    subtitle: str
    verdicts: list[Verdict]
    tables: list[Table]
    pictures: list[Picture]
    pictures_title: str
    notes: tuple[str, ...] = ()
    inputs: Mapping[str, str | None] | None = None
    remarks: Sequence[tuple[str, str]] = ()
    provenance: Sequence[tuple[str, str]] = ()
    links: Sequence[tuple[str, str]] = ()
    leading: int = 1


def with_provenance(
    page: ReportPage, command: str | None = None, inputs: Mapping[str, str | None] | None = None
) -> ReportPage:
    """Add the time of writing and the provenance to a page; `inputs` replace those of the page."""
    packages = ", ".join(f"{n} {version(n)}" for n in ("jax", "numpy", "scipy", "matplotlib"))
    digests = inputs or page.inputs or {}
    made = [
        *((f"sha256 of {name}", digest or "-") for name, digest in digests.items()),
        *page.remarks,
        ("made by", f"beamfit {beamfit.__version__} on Python {platform.python_version()}"),
        ("with", packages),
        ("command", command or "from Python"),
    ]
    now = "written " + datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    return page._replace(subtitle="; ".join(filter(None, (page.subtitle, now))), provenance=made)


def dates_in(words: str) -> list[datetime]:
    """Find the valid dates in a text, with the time if there is one.

    Examples
    --------
    >>> [f"{day:%Y-%m-%d %H:%M}" for day in dates_in("OTR2-2021-02-18-124043.mat, 5 May 2020")]
    ['2021-02-18 12:40', '2020-05-05 00:00']
    """
    found = []
    for iso, *clock, said in DAY.findall(words):
        form, text = ("%Y-%m-%d", iso) if iso else ("%d %B %Y", said)
        if any(clock):
            form, text = f"{form} %H%M%S", f"{text} {''.join(clock)}"
        try:
            found.append(datetime.strptime(text, form))
        except ValueError:
            continue
    return found


def day_of(name: str, comments: Sequence[str]) -> str:
    """Return the day in the name of a file, or in its comments, if there is exactly one."""
    days = {f"{date:%Y-%m-%d}" for date in dates_in(name)}
    days = days or {f"{date:%Y-%m-%d}" for line in comments for date in dates_in(line)}
    return days.pop() if len(days) == 1 else ""


def quality(chi2: float | None, dof: int) -> str:
    """Write the χ² of a fit for the source line of a picture."""
    return "χ² not testable" if chi2 is None or not dof else f"χ²/dof {chi2:.3g}/{dof}"


def comment_notes(lines: Sequence[str]) -> tuple[str, ...]:
    """Make notes of a page from the comment lines at the head of a file."""
    return ("From the head of the file:", *lines) if lines else ()


def control_chart(
    axes: Axes,
    points: tuple[np.ndarray, np.ndarray, np.ndarray | None],
    beyond: np.ndarray,
    limits: tuple[float, float],
    names: tuple[str, str],
    **style: Any,
) -> None:
    """Draw points (at, value, error) within and beyond control limits (centre, reach).

    `names` are the labels of the two kinds of points; limits with an infinite reach are not drawn.
    """
    for chosen, colour, name in zip((~beyond, beyond), (BLUE, RED), names, strict=True):
        if chosen.any():
            shown = [None if part is None else part[chosen] for part in points]
            axes.errorbar(*shown, fmt="o", color=colour, label=name, **style)
    centre, reach = limits
    axes.axhline(centre, color="0.6", lw=0.8)
    if math.isfinite(reach):
        ends = centre - reach, centre + reach
        axes.axhspan(*ends, color="0.92", zorder=0, label="control limits")


def contour_levels(density: np.ndarray, shares: Sequence[float]) -> list[float]:
    """Return the density levels above which the given shares lie, the largest share first.

    Examples
    --------
    >>> contour_levels(np.array([[4.0, 3.0], [2.0, 1.0]]), (0.4, 0.9))
    [2.0, 4.0]
    """
    ordered = np.sort(density.ravel())[::-1]
    held = np.cumsum(ordered) / ordered.sum()
    return sorted({float(ordered[np.searchsorted(held, share)]) for share in shares})


def date_axis(axes: Axes) -> None:
    """Label the horizontal axis with dates."""
    locator = AutoDateLocator()
    axes.xaxis.set_major_locator(locator)
    axes.xaxis.set_major_formatter(ConciseDateFormatter(locator))


def legend_below(figure: FigureBase, axes: Axes, columns: int) -> None:
    """Put the legend of some axes below their figure, in `columns` columns."""
    shown = axes.get_legend_handles_labels()
    figure.legend(*shown, frameon=False, loc="outside lower center", ncols=columns)


# Text without line breaks: a value with error and unit, or a short word with a hyphen.
UNBREAKABLE = re.compile(
    r"\(?[-+]?\d\S* ± \d\S*(?: (?=[^\s\d(])\S+)?|(?<!\S)(?=\S{1,24}(?!\S))\S*-\S*"
)


def unbroken(text: str) -> Markup:
    """Mark numbers with errors and units, and words with a hyphen, against line breaks."""
    return Markup(UNBREAKABLE.sub(r"<span>\g<0></span>", str(escape(text))))


def html_of(page: ReportPage) -> bytes:
    """Make the HTML form of a report, with embedded pictures.

    Parameters
    ----------
    page : ReportPage
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
    environment.filters["unbroken"] = unbroken
    pictures = [
        {"alt": p.alt, "data": base64.b64encode(image_of(p, "svg", transparent=True)).decode()}
        for p in page.pictures
    ]
    content = page._asdict() | {"pictures": pictures}
    return plain(environment.get_template("page.html.j2").render(**content)).encode()


class ShownFigure(Figure):
    """Matplotlib Figure that a notebook shows without an import of pyplot."""

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        with own_style():
            self.savefig(buffer, format="png", dpi=STYLE["figure.dpi"])
        return buffer.getvalue()


def figure_of(picture: Picture) -> Figure:
    """Draw a picture as a figure."""
    figure = ShownFigure(figsize=(picture.width, picture.height), layout="constrained")
    picture.on(figure)
    return figure


def image_of(picture: Picture, kind: str, transparent: bool = False) -> bytes:
    """Render a picture as the bytes of a png or svg file."""
    buffer = io.BytesIO()
    dpi = 200 if kind == "png" else "figure"
    figure_of(picture).savefig(buffer, format=kind, dpi=dpi, transparent=transparent)
    return buffer.getvalue()
