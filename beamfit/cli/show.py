"""Results on a terminal: tables with coloured statuses, verdicts, posteriors. Loaded with rich."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.segment import Segment
from rich.table import Table as RichTable
from rich.text import Text

from beamfit.answer import Table
from beamfit.errors import plain
from beamfit.quantity import Status
from beamfit.report import PAGES, kind_of
from beamfit.sampling.posterior import Posterior


def _style(status: Status) -> str:
    return f"bold {status.colour}"


def laid_out(table: Table, statuses: Sequence[Status] = ()) -> RichTable:
    """A table as rich has it."""
    rich = RichTable(
        title=table.title,
        title_justify="left",
        title_style="bold",
        box=None,
        pad_edge=False,
        header_style="bold",
    )
    # Nothing is cut short: what is too wide goes on in the next line, labels before numbers.
    for i, name in enumerate(table.header):
        side = "right" if table.numeric and i else "left"
        rich.add_column(name, overflow="fold", justify=side)
    for number, (label, *cells) in enumerate(table.rows):
        styles = [_style(s) for s in statuses] if number == 0 and statuses else [""] * len(cells)
        shown = [Text(c, style=s) for c, s in zip(cells, styles, strict=True)]
        rich.add_row(label, *shown)
    return rich


class _Console(Console):
    """Obeys nothing that a file says; where the reader has seen enough, the command says so."""

    def render(self, *arguments: Any, **options: Any) -> Iterator[Segment]:
        for each in super().render(*arguments, **options):
            yield each if each.control else each._replace(text=plain(each.text))

    def on_broken_pipe(self) -> None:
        raise BrokenPipeError


class Terminal:
    """The screen a command answers on: all of the answer, or its first screen."""

    def __init__(self, full: bool = True) -> None:
        self.full = full
        # Names are shown as they are: a bracket in one is not a style.
        self.console = _Console(highlight=False, markup=False)

    def line(self, text: str = "", style: str = "") -> None:
        """Say a line."""
        self.console.print(text, style=style or None)

    def table(self, table: Table, statuses: Sequence[Status] = ()) -> None:
        """Lay out a table; its first row has a colour where it is the results' statuses."""
        self.console.print(laid_out(table, statuses))

    def verdict(self, name: str, status: Status, message: str) -> None:
        """Say a verdict in its colour."""
        text = Text(f"\n{name}: ", style=_style(status))
        self.console.print(text.append(message, style="default not bold"))

    def answer(self, headline: str, status: Status, message: str) -> None:
        """Say what was found, in the colour of its status, and how far to believe it."""
        text = Text(f"\n{headline}. ", style=_style(status))
        self.console.print(text.append(message, style="default not bold"))

    def result(self, found: Any) -> None:
        """Say a result: its verdict, what is odd about its input, and every table."""
        self.answer(found.headline, found.status, found.message)
        for note in found.notes:
            self.line(note)
        for table in found.tables():
            self.line()
            self.table(table)

    def posterior(self, title: str, posterior: Posterior) -> None:
        """Show intervals, verdict and diagnostics."""
        self.table(posterior.table()._replace(title=f"\n{title}"))
        self.verdict("posterior", posterior.status, posterior.message)

    def tables(self, tables: Iterable[Table]) -> None:
        """Lay out tables, a blank line behind each."""
        for table in tables:
            self.table(table)
            self.line()

    def rest(self, columns: str = "tables") -> None:
        """Say how to see what the first screen leaves out, where it is one."""
        if not self.full:
            page = "A page with pictures: --report FILE.html."
            self.line(f"All {columns}: --full. {page}", style="dim")

    def report(self, path: str | None) -> None:
        """Say where the report is, if there is one."""
        if path is not None:
            several = f"Pictures written: {Path(path).stem}*{Path(path).suffix}"
            page = f"Report written to {path}"
            self.line(page if kind_of(path) in PAGES else several, style="bold")
