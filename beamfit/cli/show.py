"""Results on a terminal: tables with coloured statuses, verdicts, posteriors. Imports rich."""

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


def rich_table(table: Table, statuses: Sequence[Status] = ()) -> RichTable:
    """Convert a table to one of rich; the first row is coloured by the statuses."""
    rich = RichTable(
        title=table.title,
        title_justify="left",
        title_style="bold",
        box=None,
        pad_edge=False,
        header_style="bold",
    )
    # Nothing is truncated: wide cells are folded, labels before numbers.
    for i, name in enumerate(table.header):
        side = "right" if table.numeric and i else "left"
        rich.add_column(name, overflow="fold", justify=side)
    for number, (label, *cells) in enumerate(table.rows):
        styles = [_style(s) for s in statuses] if number == 0 and statuses else [""] * len(cells)
        shown = [Text(c, style=s) for c, s in zip(cells, styles, strict=True)]
        rich.add_row(label, *shown)
    return rich


class _Console(Console):
    """Console that escapes control characters from files, and raises on a closed pipe."""

    def render(self, *arguments: Any, **options: Any) -> Iterator[Segment]:
        for each in super().render(*arguments, **options):
            yield each if each.control else each._replace(text=plain(each.text))

    def on_broken_pipe(self) -> None:
        raise BrokenPipeError


class Terminal:
    """Terminal output of a command: the whole answer, or its first screen."""

    def __init__(self, full: bool = True) -> None:
        self.full = full
        # No markup: a bracket in a name is not a style.
        self.console = _Console(highlight=False, markup=False)

    def line(self, text: str = "", style: str = "") -> None:
        """Print a line."""
        self.console.print(text, style=style or None)

    def table(self, table: Table, statuses: Sequence[Status] = ()) -> None:
        """Print a table, with its first row coloured by the statuses."""
        self.console.print(rich_table(table, statuses))

    def verdict(self, name: str, status: Status, message: str) -> None:
        """Print a verdict in its colour."""
        text = Text(f"\n{name}: ", style=_style(status))
        self.console.print(text.append(message, style="default not bold"))

    def answer(self, headline: str, status: Status, message: str) -> None:
        """Print a headline in the colour of its status, and the message."""
        text = Text(f"\n{headline}. ", style=_style(status))
        self.console.print(text.append(message, style="default not bold"))

    def result(self, found: Any) -> None:
        """Print a result: verdict, notes and all tables."""
        self.answer(found.headline, found.status, found.message)
        for note in found.notes:
            self.line(note)
        for table in found.tables():
            self.line()
            self.table(table)

    def posterior(self, title: str, posterior: Posterior) -> None:
        """Print intervals, verdict and diagnostics of a posterior."""
        self.table(posterior.table()._replace(title=f"\n{title}"))
        self.verdict("posterior", posterior.status, posterior.message)

    def tables(self, tables: Iterable[Table]) -> None:
        """Print tables, each followed by a blank line."""
        for table in tables:
            self.table(table)
            self.line()

    def rest(self, columns: str = "tables") -> None:
        """Print a hint to `--full` and `--report` after a first screen."""
        if not self.full:
            page = "A page with pictures: --report FILE.html."
            self.line(f"All {columns}: --full. {page}", style="dim")

    def report(self, path: str | None) -> None:
        """Print the path of the report, if there is one."""
        if path is not None:
            several = f"Pictures written: {Path(path).stem}*{Path(path).suffix}"
            page = f"Report written to {path}"
            self.line(page if kind_of(path) in PAGES else several, style="bold")
