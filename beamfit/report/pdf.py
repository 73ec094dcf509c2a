"""The report as PDF: the same tables and pictures on A4 pages, drawn by matplotlib."""

from __future__ import annotations

import io
import textwrap
from typing import Any

import numpy as np
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure

from beamfit.report.document import Page, Picture
from beamfit.status import Status
from beamfit.table import Table

__all__ = ["pdf_of"]

WIDTH, HEIGHT, MARGIN = 8.27, 11.69, 0.75  # A4, inches
LINE = 0.185
COLOUR = {Status.converged: "#2c7a3f", Status.poor_fit: "#c98a00"}


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

    def paragraph(self, words: str, columns: int = 98, step: float = 1.0, **style: Any) -> None:
        """Write wrapped text, each line so many usual ones high."""
        for line in textwrap.wrap(words, columns) or [""]:
            self.room(step)
            self.text(line, **style)
            self.y -= step * LINE

    def heading(self, words: str) -> None:
        self.room(7)
        self.y -= LINE
        self.text(words, size=12, weight="bold")
        self.y -= 1.5 * LINE

    def table(self, table: Table) -> None:
        """Write a table, its columns as wide as their longest cells, or less to fit the page."""
        lines = [*([table.header] if table.header else []), *table.rows]
        count = max(map(len, lines))
        longest = [
            max(len(line[i]) if i < len(line) else 0 for line in lines) for i in range(count)
        ]
        widths = 0.078 * np.array(longest) + 0.28
        tight = min(1.0, (WIDTH - 2 * MARGIN) / widths.sum())
        ends = tight * np.cumsum(widths)
        for number, cells in enumerate(lines):
            self.room(1)
            bold = "bold" if table.header and number == 0 else "normal"
            for i, cell in enumerate(cells):
                right = table.numeric and i > 0
                x = ends[i] - 0.28 * tight if right else ends[i] - widths[i] * tight
                side = "right" if right else "left"
                self.text(cell, x=x, size=8.5 * max(tight, 0.6), weight=bold, ha=side)
            self.y -= LINE
        self.y -= 0.3 * LINE


def _picture_pages(pictures: list[Picture]) -> list[Figure]:
    """Put the pictures below one another on as few pages as hold them."""
    room, groups = 0.0, []
    for picture in pictures:
        if picture.height > room:
            groups.append([])
            room = HEIGHT - 2 * MARGIN
        groups[-1].append(picture)
        room -= picture.height
    return [_picture_page(group) for group in groups]


def _picture_page(pictures: list[Picture]) -> Figure:
    page = Figure(figsize=(WIDTH, HEIGHT), layout="constrained")
    page.get_layout_engine().set(rect=(0.06, 0.05, 0.88, 0.9), hspace=0.06)
    heights = [picture.height for picture in pictures]
    empty = max(HEIGHT - 2 * MARGIN - sum(heights), 0.01)
    parts = page.subfigures(len(pictures) + 1, 1, height_ratios=[*heights, empty])
    for part, picture in zip(parts, pictures, strict=False):
        picture.draw(part)
    return page


def pdf_of(page: Page) -> bytes:
    """Make the PDF of a report.

    Parameters
    ----------
    page : Page
        The report.

    Returns
    -------
    bytes
        The file.
    """
    pages = _Pages()
    pages.paragraph(page.title, 52, size=16, weight="bold", step=1.6)
    pages.y -= 0.4 * LINE
    pages.paragraph(page.subtitle, color="0.35")
    for verdict in page.verdicts:
        pages.y -= 0.5 * LINE
        pages.room(4)
        colour = COLOUR.get(verdict.status, "#b3261e")
        pages.paragraph(verdict.headline, 80, size=11.5, weight="bold", color=colour, step=1.4)
        pages.paragraph(verdict.message)
    for table in page.tables:
        pages.heading(table.title)
        if table.note:
            pages.paragraph(table.note, color="0.35")
            pages.y -= 0.4 * LINE
        if table.rows:
            pages.table(table)
    pages.heading("Provenance")
    for label, value in page.provenance:
        pages.paragraph(f"{label}: {value}", size=8.5)
    for note in page.notes:
        pages.paragraph(note, size=8.5, color="0.35")
    buffer = io.BytesIO()
    with PdfPages(buffer) as document:
        for each in [pages.pages[0], *_picture_pages(page.pictures), *pages.pages[1:]]:
            document.savefig(each)
    return buffer.getvalue()
