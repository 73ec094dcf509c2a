"""PDF form of a report: the tables and pictures on A4 pages, drawn by matplotlib."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.textpath import text_to_path

from beamfit.answer import Table
from beamfit.errors import plain
from beamfit.report.document import Picture, ReportPage

WIDTH, HEIGHT, MARGIN = 8.27, 11.69, 0.75  # A4, inches
# Height of a line of text, inches.
LINE = 0.185
# Gap between columns of a table, inches.
GAP = 0.22
# Font size of tables, and the smallest one for wide tables, points.
FONT_SIZE = 8.5
MIN_FONT_SIZE = 6.0
# Smallest factor by which a picture shrinks to fit on a page.
MIN_SHRINK = 0.7
COLOUR = {"green": "#2c7a3f", "yellow": "#c98a00", "red": "#b3261e"}


class _Pages:
    """A4 pages, filled with text, tables and pictures from top to bottom."""

    def __init__(self) -> None:
        self.pages: list[Figure] = []
        self.new_page()

    def new_page(self) -> None:
        page = Figure(figsize=(WIDTH, HEIGHT), layout="constrained")
        page.get_layout_engine().set(w_pad=0.04, h_pad=0.04)
        self.pages.append(page)
        self.y = HEIGHT - MARGIN

    def numbers(self, title: str) -> None:
        """Write title and page number at the foot of every page."""
        short = wrap_text(title, WIDTH - 2 * MARGIN - 1.0, 8)[0]
        style = {"y": 0.5 * MARGIN / HEIGHT, "fontsize": 8, "color": "0.35"}
        for number, page in enumerate(self.pages, 1):
            page.text(MARGIN / WIDTH, s=short, **style)
            page.text(
                1 - MARGIN / WIDTH, s=f"page {number} of {len(self.pages)}", ha="right", **style
            )

    def room(self, lines: float) -> None:
        """Begin a new page unless `lines` lines still fit."""
        if self.y - lines * LINE < MARGIN:
            self.new_page()

    def text(
        self, words: str, *, x: float = 0.0, below: float = 0.0, size: float = 9.5, **style: Any
    ) -> None:
        """Write one line at the present height, or `below` inches lower, without moving down."""
        place = (MARGIN + x) / WIDTH, (self.y - below) / HEIGHT
        self.pages[-1].text(*place, words, fontsize=size, va="top", **style)

    def paragraph(
        self, words: str, size: float = 9.5, weight: str = "normal", step: float = 1.0, **style: Any
    ) -> None:
        """Write wrap_text text with a line height of `step` lines."""
        for line in wrap_text(words, WIDTH - 2 * MARGIN, size, weight):
            self.room(step)
            self.text(line, size=size, weight=weight, **style)
            self.y -= step * LINE

    def heading(self, words: str) -> None:
        self.room(7)
        self.y -= LINE
        self.text(words, size=12, weight="bold")
        self.y -= 1.5 * LINE

    def table(self, table: Table) -> None:
        """Write a table; cells too wide for their column are wrap_text."""
        lines = [*([table.header] if table.header else []), *table.rows]
        widths, size = _columns(lines)
        for number, cells in enumerate(lines):
            head = bool(table.header) and number == 0
            weight = "bold" if head else "normal"
            written = [wrap_text(c, w, size, weight) for c, w in zip(cells, widths, strict=False)]
            height = max(map(len, written))
            if self.y - height * LINE < MARGIN:
                self.new_page()
                if table.header and not head:  # repeat the header
                    self._row([[c] for c in table.header], widths, size, table.numeric, True)
            self._row(written, widths, size, table.numeric, head)
        self.y -= 0.3 * LINE

    def _row(
        self, cells: list[list[str]], widths: np.ndarray, size: float, numeric: bool, head: bool
    ) -> None:
        style = {"size": size, "weight": "bold" if head else "normal"}
        starts = np.concatenate([[0.0], np.cumsum(widths + GAP)])
        for i, lines in enumerate(cells):
            right = numeric and i > 0
            x, side = (starts[i] + widths[i], "right") if right else (starts[i], "left")
            for k, words in enumerate(lines):
                self.text(words, x=x, below=k * LINE, ha=side, **style)
        self.y -= LINE * max(map(len, cells))

    def picture(self, picture: Picture) -> None:
        """Draw a picture, slightly smaller if it then fits on the page, otherwise on a new one."""
        left = self.y - MARGIN
        if left < MIN_SHRINK * picture.height:
            self.new_page()
            left = self.y - MARGIN
        height = min(picture.height, left)
        page = self.pages[-1]
        above, below = HEIGHT - self.y, self.y - height
        ratios = {"height_ratios": (above, height, below)}
        ratios |= {"width_ratios": (0.6 * MARGIN, WIDTH - 1.5 * MARGIN, 0.9 * MARGIN)}
        place = page.add_gridspec(3, 3, hspace=0, wspace=0, **ratios)[1, 1]
        picture.on(page.add_subfigure(place))
        self.y -= height + 0.6 * LINE


def width_of(words: str, size: float, weight: str = "normal") -> float:
    """Return the width of a line of text in inches."""
    font = FontProperties(size=size, weight=weight)
    return text_to_path.get_text_width_height_descent(words, font, ismath=False)[0] / 72


def wrap_text(words: str, room: float, size: float, weight: str = "normal") -> list[str]:
    """Break a text into lines of at most `room` inches, also within long words."""
    lines = [""]
    # ASCII blanks only: a non-breaking blank is part of an indentation.
    for word in re.split(r"\s+", plain(words), flags=re.ASCII):
        longer = f"{lines[-1]} {word}" if lines[-1] else word
        if width_of(longer, size, weight) <= room:
            lines[-1] = longer
            continue
        lines += [""] * bool(lines[-1])
        for letter in word:
            if lines[-1] and width_of(lines[-1] + letter, size, weight) > room:
                lines.append("")
            lines[-1] += letter
    return lines


def _columns(lines: Sequence[Sequence[str]]) -> tuple[np.ndarray, float]:
    """Return column widths in inches and the font size with which a table fits the page.

    Wide tables get a smaller font, down to a limit; then the widest columns are narrowed.
    """
    count = max(map(len, lines))
    natural = np.zeros(count)
    for number, cells in enumerate(lines):
        weight = "bold" if number == 0 else "normal"
        for i, cell in enumerate(cells):
            natural[i] = max(natural[i], width_of(cell, FONT_SIZE, weight))
    room = WIDTH - 2 * MARGIN - (count - 1) * GAP
    size = min(FONT_SIZE, max(MIN_FONT_SIZE, FONT_SIZE * room / max(natural.sum(), 1e-9)))
    widths = (natural + 0.01) * size / FONT_SIZE
    while widths.sum() > room * 1.001:
        order = np.sort(widths)[::-1]
        widest = widths >= order[0] - 1e-9
        others = widths[~widest]
        share = (room - others.sum()) / widest.sum()
        widths[widest] = max(share, float(others.max(initial=0.0)))
        if share <= 0:
            return np.full(count, room / count), size
    return widths, size


def pages_of(page: ReportPage) -> list[Figure]:
    """Arrange a report on pages: verdicts, the first table, the pictures, everything else."""
    pages = _Pages()
    pages.paragraph(page.title, size=16, weight="bold", step=1.6)
    pages.y -= 0.4 * LINE
    pages.paragraph(page.subtitle, color="0.35")
    for verdict in page.verdicts:
        pages.y -= 0.5 * LINE
        pages.room(4)
        colour = COLOUR[verdict.status.colour]
        pages.paragraph(verdict.headline, size=11.5, weight="bold", color=colour, step=1.4)
        pages.paragraph(verdict.message)
    for number, table in enumerate(page.tables):
        pages.heading(table.title)
        if table.note:
            pages.paragraph(table.note, color="0.35")
            pages.y -= 0.4 * LINE
        if table.rows:
            pages.table(table)
        if number == 0:
            for picture in page.pictures:
                pages.picture(picture)
    pages.heading("Provenance")
    for label, value in page.provenance:
        pages.paragraph(f"{label}: {value}", size=8.5)
    for note in page.notes:
        pages.paragraph(note, size=8.5, color="0.35")
    pages.numbers(page.title)
    return pages.pages


def pdf_of(page: ReportPage) -> bytes:
    """Make the PDF of a report.

    Parameters
    ----------
    page : ReportPage
        The report.

    Returns
    -------
    bytes
        The file.
    """
    buffer = io.BytesIO()
    with PdfPages(buffer) as document:
        for each in pages_of(page):
            document.savefig(each)
    return buffer.getvalue()
