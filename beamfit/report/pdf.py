"""The report as PDF: the same tables and pictures on A4 pages, drawn by matplotlib."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Callable, Mapping
from typing import Any

from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure, FigureBase

__all__ = ["pdf_of"]

WIDTH, HEIGHT, MARGIN = 8.27, 11.69, 0.75  # A4, inches
LINE = 0.185
COLOUR = {"converged": "#2c7a3f", "poor_fit": "#c98a00"}


class _Pages:
    """Text and tables flowing down A4 pages."""

    def __init__(self) -> None:
        self.pages: list[Figure] = []
        self.new_page()

    def new_page(self) -> None:
        self.pages.append(Figure(figsize=(WIDTH, HEIGHT)))
        self.y = HEIGHT - MARGIN

    def room(self, lines: float) -> None:
        """Begin a new page unless this many lines still fit."""
        if self.y - lines * LINE < MARGIN:
            self.new_page()

    def text(self, words: str, *, x: float = 0.0, size: float = 9.5, **style: Any) -> None:
        """Write one line at the present height without moving down."""
        self.pages[-1].text(
            (MARGIN + x) / WIDTH, self.y / HEIGHT, words, fontsize=size, va="top", **style
        )

    def paragraph(self, words: str, columns: int = 98, **style: Any) -> None:
        """Write wrapped text."""
        for line in textwrap.wrap(words, columns) or [""]:
            self.room(1)
            self.text(line, **style)
            self.y -= LINE

    def heading(self, words: str) -> None:
        self.room(4)
        self.y -= LINE
        self.text(words, size=12, weight="bold")
        self.y -= 1.5 * LINE

    def table(self, header: list[str], rows: list[list[str]]) -> None:
        """Write a table whose columns are as wide as their longest cell."""
        lines = ([header] if header else []) + rows
        widths = [max(len(line[i]) for line in lines) for i in range(len(lines[0]))]
        for number, cells in enumerate(lines):
            self.room(1)
            x = 0.0
            for cell, width in zip(cells, widths, strict=True):
                bold = "bold" if header and number == 0 else "normal"
                self.text(cell, x=x, size=8.5, weight=bold)
                x += 0.078 * width + 0.28
            self.y -= LINE
        self.y -= 0.3 * LINE


def _picture_page(drawings: list[tuple[str, float, Callable[[FigureBase], None]]]) -> Figure:
    """Put the pictures below one another on one page."""
    page = Figure(figsize=(WIDTH, HEIGHT), layout="constrained")
    page.get_layout_engine().set(rect=(0.06, 0.05, 0.88, 0.9), hspace=0.06)
    heights = [height for _, height, _ in drawings]
    empty = max(HEIGHT - 2 * MARGIN - sum(heights), 0.01)
    parts = page.subfigures(len(drawings) + 1, 1, height_ratios=[*heights, empty])
    for part, (_, _, draw) in zip(parts, drawings, strict=False):
        draw(part)
    return page


def pdf_of(
    content: Mapping[str, Any],
    drawings: list[tuple[str, float, Callable[[FigureBase], None]]],
) -> bytes:
    """Make the PDF of a report.

    Parameters
    ----------
    content : mapping
        The report's tables, as the HTML template takes them.
    drawings : list of (str, float, callable)
        The pictures, as `beamfit.report.figures.pictures` lists them.

    Returns
    -------
    bytes
        The file.
    """
    pages = _Pages()
    pages.text(content["title"], size=16, weight="bold")
    pages.y -= 2 * LINE
    pages.paragraph(content["subtitle"], color="0.35")
    planes = content["planes"]
    for p in planes:
        pages.y -= 0.5 * LINE
        pages.room(4)
        colour = COLOUR.get(p["status"], "#b3261e")
        pages.text(f"{p['plane']}: {p['headline']}", size=11.5, weight="bold", color=colour)
        pages.y -= 1.4 * LINE
        pages.paragraph(p["message"])
    names = [p["plane"] for p in planes]
    for title, key in (
        ("Result", "results"),
        ("What the data determine", "identifiability"),
        ("If the line were a little different: change of the normalised emittance", "budget"),
        ("If some points were left out: normalised emittance (shift)", "ranges"),
    ):
        pages.heading(title)
        rows = [[label, *cells] for label, cells in content[key]]
        if rows:
            pages.table(["", *names], rows)
    for p in planes:
        pages.heading(f"Points, {p['plane']} plane")
        pages.table(p["point_header"], p["point_rows"])
    pages.heading("Provenance")
    for label, value in content["provenance"]:
        pages.paragraph(f"{label}: {value}", size=8.5)
    for note in content["notes"]:
        pages.paragraph(note, size=8.5, color="0.35")
    buffer = io.BytesIO()
    with PdfPages(buffer) as document:
        for page in [pages.pages[0], _picture_page(drawings), *pages.pages[1:]]:
            document.savefig(page)
    return buffer.getvalue()
