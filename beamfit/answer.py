"""Output forms of every result: text, tables, JSON, data frame, picture and notebook cell."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from enum import Enum
from html import escape
from importlib import import_module
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from beamfit.errors import InputError, Status, nearest, plain
from beamfit.quantity import Quantity

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

# Largest number of rows shown of a long table; JSON has all.
MAX_ROWS_SHOWN = 40


class Table(NamedTuple):
    """Rows of cells under a heading; an empty header leaves the head row out.

    `numeric` right-aligns all columns except the first; `marked` are the indices of the rows that
    people quote.

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
        """Give the table of the marked rows alone, for the first screen.

        Examples
        --------
        >>> rows = [Row("beta", [1.2], quoted=True), Row("alpha", [None], quoted=True)]
        >>> [*labelled("", ["x"], [("status", ["fine"]), *rows]).quoted().rows]
        [['beta', '1.2']]
        """
        return self._replace(rows=[self.rows[i] for i in self.marked], marked=())


class Row(NamedTuple):
    """A label and its values, one per result; `quoted` rows appear on the first screen."""

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
    """Make a table of labelled rows with one column per result.

    Parameters
    ----------
    title : str
        Heading.
    names : sequence of str
        Names of the results, the column headers.
    rows : sequence of Row or (str, sequence)
        Label and values: numbers with errors, statuses, words. A quoted row without a determined
        value is not marked.
    note : str
        A sentence between heading and table.
    numeric : bool
        Right-align the cells.

    Returns
    -------
    Table
    """
    rows = [Row(*row) for row in rows]
    cells = [[row.label, *map(cell, row.values)] for row in rows]
    marked = tuple(
        i for i, row in enumerate(rows) if row.quoted and any(map(_has_value, row.values))
    )
    return Table(title, ["", *names] if any(names) else [], cells, note, numeric, marked)


def determined(rows: Sequence[Row]) -> list[Row]:
    """Leave out rows without a determined value.

    Examples
    --------
    >>> open_one, known = Quantity(1.0, None, "m"), Quantity(2.0, 0.1, "m")
    >>> [row.label for row in determined([Row("beta", [open_one]), Row("size", [known])])]
    ['size']
    """
    return [row for row in rows if any(map(_has_value, row.values))]


def _has_value(value: object) -> bool:
    return value.determined if isinstance(value, Quantity) else value is not None


def cell(value: object) -> str:
    """Write a value as the text of a table cell.

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
    """Format a table for a terminal, with aligned columns."""
    rows = [list(row) for row in (*([table.header] if table.header else []), *table.rows)]
    columns = max((len(row) for row in rows), default=0)
    rows = [row + [""] * (columns - len(row)) for row in rows]
    widths = [max(len(row[i]) for row in rows) for i in range(columns)]
    lines = [line for line in (table.title, table.note) if line]
    for row in rows:
        aligned = [
            c.rjust(w) if table.numeric and i else c.ljust(w)
            for i, (c, w) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append("  ".join(aligned).rstrip())
    return plain("\n".join(lines))


def html_of(table: Table) -> str:
    """Format a table as HTML for a notebook."""
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
    """Convert a result to dictionaries, lists and numbers for JSON; non-finite numbers become null.

    A ``to_json`` method takes precedence; other dataclasses and named tuples give their fields.

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


C = TypeVar("C", bound=type)
# Limits of one-line representations: characters of a nested text, entries of a collection, numbers
# of an array, characters of the line. Chosen to fit two lines of a terminal.
MAX_TEXT = 60
MAX_ENTRIES = 6
MAX_NUMBERS = 4
LINE_WIDTH = 150


def shown(cls: C) -> C:
    """Give a class a one-line ``repr`` and a notebook representation as tables.

    They use its property ``headline`` and its method ``tables``, or else its fields, with arrays
    shown by shape and range.

    Examples
    --------
    >>> from typing import NamedTuple
    >>> @shown
    ... class Readings(NamedTuple):
    ...     name: str
    ...     current: list
    >>> Readings("fill", [3.0, 1.0, 2.0])
    <Readings name=fill, current=(3, 1, 2)>
    """
    cls.__repr__ = _repr_line
    if not hasattr(cls, "_repr_html_"):
        cls._repr_html_ = _repr_tables
    return cls


def brief(value: Any) -> str:
    """Describe a value of any size in a few words.

    Examples
    --------
    >>> import numpy as np
    >>> brief(np.arange(20.0)), brief({"Q1": 0.5}), brief(Quantity(1e-6, 1e-8, "m"))
    ('20 values from 0 to 19', '{Q1: 0.5}', '1.000 ± 0.010 µm')
    """
    match value:
        case None | bool() | Quantity():
            return cell(value)
        case float():
            return f"{value:.6g}"
        case Enum():
            return str(value.value)
        case str():
            words = " ".join(value.split())
            return words if len(words) <= MAX_TEXT else words[: MAX_TEXT - 4] + " ..."
        case Mapping():
            return f"{{{_listed([f'{name}: {brief(one)}' for name, one in value.items()])}}}"
        case tuple() | list() if not hasattr(value, "_fields"):
            return f"({_listed([brief(one) for one in value])})"
    if hasattr(value, "dtype"):
        return _array_words(value)
    if (headline := getattr(value, "headline", None)) is not None:
        return brief(headline)
    if not _is_record(value):
        return cell(value)
    name, words = type(value).__name__, ", ".join(words for _, words in _field_words(value))
    return f"{name}({words})" if len(words) <= MAX_TEXT else name


def _listed(words: list[str]) -> str:
    if len(words) > MAX_ENTRIES:
        return f"{len(words)} of {words[0]}, ..."
    return ", ".join(words)


def _array_words(values: Any) -> str:
    """Describe an array by its numbers or its shape and range; a traced array has no numbers."""
    import numpy as np

    try:
        numbers = np.asarray(values)
    except TypeError:
        return "traced"
    if numbers.ndim == 0:
        return f"{numbers:.6g}" if numbers.dtype.kind == "f" else str(numbers)
    if numbers.size <= MAX_NUMBERS and numbers.ndim == 1:
        return f"({', '.join(map(brief, numbers.tolist()))})"
    shape = " x ".join(map(str, numbers.shape))
    if numbers.dtype.kind not in "fiu" or not np.isfinite(numbers).any():
        return f"{shape} values"
    known = numbers[np.isfinite(numbers)]
    return f"{shape} values from {known.min():.4g} to {known.max():.4g}"


def _is_record(value: Any) -> bool:
    return dataclasses.is_dataclass(value) or hasattr(value, "_fields")


def _field_words(value: Any) -> list[list[str]]:
    if hasattr(value, "_fields"):
        return [[name, brief(one)] for name, one in value._asdict().items()]
    return [[f.name, brief(getattr(value, f.name))] for f in dataclasses.fields(value)]


def _repr_line(value: Any) -> str:
    words = getattr(value, "headline", None)
    words = ", ".join("=".join(field) for field in _field_words(value)) if words is None else words
    words = " ".join(words.split())
    words = words if len(words) <= LINE_WIDTH else words[: LINE_WIDTH - 4] + " ..."
    return f"<{type(value).__name__} {words}>"


def _repr_tables(value: Any) -> str:
    if not hasattr(value, "tables"):
        return html_of(Table(type(value).__name__, [], _field_words(value)))
    said = getattr(value, "message", "")
    return "".join(map(html_of, value.tables())) + (f"<p>{escape(said)}</p>" if said else "")


# Keys of a JSON object that can name it within a list, in order of preference.
ENTRY_NAMES = ("name", "plane", "output", "record")


def answer(cls: C) -> C:
    """Add the output methods of `METHODS` to a result; methods of the class itself are kept.

    A result has a ``headline``, a ``status``, a ``message`` and ``tables()``; ``to_json()`` gives
    the fields of the JSON contract. From these follow ``repr``, the notebook cell, ``print``,
    ``to_dict``, ``to_frame``, ``plot``, and quantities by name.

    Examples
    --------
    >>> from dataclasses import dataclass
    >>> @answer
    ... @dataclass
    ... class Length:
    ...     rod: Quantity
    ...     headline, message = "a rod", "It was measured once."
    >>> found = Length(Quantity(2.0, 0.1, "m"))
    >>> found, list(found), found["rod"], found.to_dict()["rod"]["error"]
    (<Length a rod>, ['rod'], <Quantity 2.00 ± 0.10 m>, 0.1)
    >>> print(found)
    a rod. It was measured once.
    """
    for name, form in METHODS.items():
        if name not in vars(cls):
            setattr(cls, name, form)
    return shown(cls)


def quantities_of(result: Any) -> dict[str, Quantity]:
    """Find every quantity of a result, by its name in the result or its path in the JSON.

    Examples
    --------
    >>> quantities_of({"screen": {"beta": Quantity(1.2, 0.1, "m")}})
    {'screen.beta': <Quantity 1.20 ± 0.10 m>}
    """
    own = getattr(result, "quantities", None)
    return dict(own) if isinstance(own, Mapping) else dict(_find_quantities(json_of(result), ()))


def _find_quantities(value: Any, path: tuple[str, ...]) -> Iterator[tuple[str, Quantity]]:
    match value:
        case {"value": int() | float() as number, "error": error, "unit": str() as unit}:
            ends = value.get("interval_95")
            ends = None if ends is None else (ends[0], ends[1])
            yield ".".join(path), Quantity(number, error, unit, value.get("error_raw"), ends)
        case dict():
            for name, one in value.items():
                yield from _find_quantities(one, path if name == "value" else (*path, name))
        case list() if value and isinstance(value[0], dict):
            for i, one in enumerate(value):
                name = next((one[n] for n in ENTRY_NAMES if isinstance(one.get(n), str)), str(i))
                yield from _find_quantities(one, (*path, name))


def _to_dict(self: Any) -> Any:
    """Give the content of ``--json`` as dictionaries, lists and numbers."""
    return json_of(self)


def _to_frame(self: Any) -> DataFrame:
    """Give a pandas data frame with one row per quantity, or the first table if there is none.

    The columns are value, error, error_raw, low_95, high_95 and unit.

    Raises
    ------
    InputError
        If pandas is not installed.
    """
    if found := quantities_of(self):
        return quantity_frame({(name,): q for name, q in found.items()}, ("quantity",))
    table = next(iter(self.tables()))
    columns = list(zip(*table.rows, strict=True))
    names = table.header or [str(i) for i in range(len(columns))]
    return frame_of(dict(zip(names, columns, strict=True)))


def _getitem(self: Any, name: str) -> Quantity:
    """Return a quantity by its name."""
    found = quantities_of(self)
    if name not in found:
        raise InputError(f"no quantity '{name}'", nearest(str(name), list(found)))
    return found[name]


def _iter_names(self: Any) -> Iterator[str]:
    """Iterate over the names of the quantities."""
    return iter(quantities_of(self))


def _lines_and_tables(self: Any) -> tuple[list[str], Sequence[Table]]:
    """Return the lines of verdict and notes, and all tables."""
    headline, message = self.headline, getattr(self, "message", "")
    begin = f"{headline}.\n" if "\n" in message else f"{headline}. "
    said = headline if message in ("", headline) else begin + message
    remarks = [*getattr(self, "notes", ()), *dict(getattr(self, "doubts", {})).values()]
    return [*said.split("\n"), *remarks], self.tables() if hasattr(self, "tables") else ()


def _str(self: Any) -> str:
    """Format the verdict, the notes and all tables as text."""
    if not hasattr(self, "headline"):
        return repr(self)
    lines, tables = _lines_and_tables(self)
    return "\n\n".join(["\n".join(lines), *map(text_of, tables)])


def _repr_html(self: Any) -> str:
    """Format the verdict, the notes and all tables for a notebook."""
    if not hasattr(self, "headline"):
        return _repr_tables(self)
    lines, tables = _lines_and_tables(self)
    return "".join(f"<p>{escape(line)}</p>" for line in lines) + "".join(map(html_of, tables))


def _first_picture(self: Any, **options: Any) -> Figure:
    """Draw the first picture of the report as a matplotlib Figure."""
    return import_module("beamfit.figures").picture(self, **options)


METHODS = {
    "__getitem__": _getitem,
    "__iter__": _iter_names,
    "__str__": _str,
    "_repr_html_": _repr_html,
    "plot": _first_picture,
    "to_dict": _to_dict,
    "to_frame": _to_frame,
}


def frame_of(columns: Mapping[str, Sequence[Any]], index: Sequence[str] = ()) -> DataFrame:
    """Make a data frame from columns, some of which form its index.

    Raises
    ------
    InputError
        If pandas is not installed.
    """
    try:
        import pandas
    except ImportError:
        expected = "the package pandas; install it with: pip install 'beamfit[pandas]'"
        raise InputError("no pandas", expected) from None
    frame = pandas.DataFrame(dict(columns))
    return frame.set_index(list(index)) if index else frame


def quantity_frame(rows: Mapping[tuple[str, ...], Quantity], names: Sequence[str]) -> DataFrame:
    """Make a data frame of quantities with value, errors, ends of the 95 % interval, and unit."""
    keys, found = list(rows), list(rows.values())
    ends = [q.interval_95 or (None, None) for q in found]
    columns = {name: [key[i] for key in keys] for i, name in enumerate(names)}
    columns |= {name: [getattr(q, name) for q in found] for name in ("value", "error", "error_raw")}
    columns |= {"low_95": [low for low, _ in ends], "high_95": [high for _, high in ends]}
    numbers = ("value", "error", "error_raw", "low_95", "high_95")
    nan = float("nan")
    columns |= {n: [nan if v is None else float(v) for v in columns[n]] for n in numbers}
    return frame_of(columns | {"unit": [q.unit for q in found]}, names)
