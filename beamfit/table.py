"""A table and an object of JSON: the two forms in which every result is shown."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from enum import Enum
from html import escape
from typing import Any, NamedTuple

from beamfit.errors import plain
from beamfit.quantity import Quantity
from beamfit.verdict import Status

# Rows shown of a long table; JSON has all.
MOST_ROWS = 40


class Table(NamedTuple):
    """Rows of cells under a heading; an empty header leaves the head row out.

    `numeric` sets all cells but the first column's flush right; `marked` are the numbers of the
    rows that people quote.

    Examples
    --------
    >>> print(text_of(Table("", ["", "x"], [["beta", "1.2 m"]])))
          x
    beta  1.2 m
    """

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""
    numeric: bool = False
    marked: tuple[int, ...] = ()

    def quoted(self) -> Table:
        """Table of the rows that people quote, for a first screen.

        Examples
        --------
        >>> rows = [Row("beta", [1.2], quoted=True), Row("alpha", [None], quoted=True)]
        >>> [*labelled("", ["x"], [("status", ["fine"]), *rows]).quoted().rows]
        [['beta', '1.2']]
        """
        return self._replace(rows=[self.rows[i] for i in self.marked], marked=())


class Row(NamedTuple):
    """A label and its values, one a result; `quoted` rows stand on the first screen."""

    label: str
    values: Sequence[object]
    quoted: bool = False


def labelled(
    title: str,
    names: Sequence[str],
    rows: Sequence[Row | tuple[str, Sequence[object]]],
    note: str = "",
    numeric: bool = False,
) -> Table:
    """Make a table of labelled rows with one column a result.

    Parameters
    ----------
    title : str
        Heading.
    names : sequence of str
        One a result.
    rows : sequence of Row or (str, sequence)
        Label and values: numbers with errors, statuses, words. A quoted row of which no value is
        determined is not marked.
    note : str
        A sentence between heading and table.
    numeric : bool
        Whether cells are set flush right.

    Returns
    -------
    Table
    """
    rows = [Row(*row) for row in rows]
    cells = [[row.label, *map(cell, row.values)] for row in rows]
    marked = tuple(i for i, row in enumerate(rows) if row.quoted and any(map(_known, row.values)))
    return Table(title, ["", *names] if any(names) else [], cells, note, numeric, marked)


def determined(rows: Sequence[Row]) -> list[Row]:
    """Leave out rows of which no value is determined.

    Examples
    --------
    >>> open_one, known = Quantity(1.0, None, "m"), Quantity(2.0, 0.1, "m")
    >>> [row.label for row in determined([Row("beta", [open_one]), Row("size", [known])])]
    ['size']
    """
    return [row for row in rows if any(map(_known, row.values))]


def _known(value: object) -> bool:
    return value.determined if isinstance(value, Quantity) else value is not None


def cell(value: object) -> str:
    """Write a value for a person to read.

    Examples
    --------
    >>> [cell(v) for v in (None, True, 0.25, Status.poor_fit, Quantity(1e-16, None, "m^2"))]
    ['-', 'yes', '0.25', 'poor fit', '1e-16 m² (not determined)']
    """
    match value:
        case None:
            return "-"
        case bool():
            return "yes" if value else "no"
        case Status():
            return value.value.replace("_", " ")
        case float():
            return f"{value:.4g}" if math.isfinite(value) else "-"
        case Quantity():
            return str(value).replace("^2", "²")
        case _:
            return str(value)


def text_of(table: Table) -> str:
    """Lay a table out for a terminal, columns aligned."""
    rows = [list(row) for row in (*([table.header] if table.header else []), *table.rows)]
    columns = max((len(row) for row in rows), default=0)
    rows = [row + [""] * (columns - len(row)) for row in rows]
    widths = [max(len(row[i]) for row in rows) for i in range(columns)]
    lines = [line for line in (table.title, table.note) if line]
    for row in rows:
        turned = [
            c.rjust(w) if table.numeric and i else c.ljust(w)
            for i, (c, w) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append("  ".join(turned).rstrip())
    return plain("\n".join(lines))


def html_of(table: Table) -> str:
    """Lay a table out for a notebook."""
    side = "right" if table.numeric else "left"

    def row_of(cells: Sequence[str], kind: str) -> str:
        first = f"<th style='text-align:left'>{escape(cells[0])}</th>" if cells else ""
        rest = (f"<{kind} style='text-align:{side}'>{escape(c)}</{kind}>" for c in cells[1:])
        return f"<tr>{first}{''.join(rest)}</tr>"

    title = f"<p><b>{escape(table.title)}</b></p>" if table.title else ""
    note = f"<p>{escape(table.note)}</p>" if table.note else ""
    head = f"<thead>{row_of(table.header, 'th')}</thead>" if table.header else ""
    body = "".join(row_of(row, "td") for row in table.rows)
    return f"{title}{note}<table>{head}<tbody>{body}</tbody></table>"


def json_of(value: Any) -> Any:
    """Turn a result into what JSON holds; numbers that are not finite are null.

    A value with a ``to_json`` method says itself what it gives; other dataclasses and named
    tuples give their fields.

    Examples
    --------
    >>> import numpy as np
    >>> json_of({"status": Status.converged, "size": np.array([1.0, np.nan])})
    {'status': 'converged', 'size': [1.0, None]}
    """
    if hasattr(value, "to_json"):
        return json_of(value.to_json())
    if hasattr(value, "_asdict"):
        return json_of(value._asdict())
    if dataclasses.is_dataclass(value):
        return {f.name: json_of(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(k): json_of(v) for k, v in value.items()}
    if isinstance(value, Enum):
        return value.value
    if hasattr(value, "tolist"):  # an array of NumPy or JAX
        return json_of(value.tolist())
    if isinstance(value, list | tuple):
        return [json_of(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def plain_name(name: str) -> str:
    """Write a name as words.

    Examples
    --------
    >>> plain_name("x.normalized_emittance")
    'x normalised emittance'
    """
    return name.replace(".", " ").replace("_", " ").replace("normalized", "normalised")
