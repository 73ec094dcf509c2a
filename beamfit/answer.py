"""Answers: a result in every form that is asked for, from its quantities, tables and JSON."""

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


C = TypeVar("C", bound=type)
# Letters of a text inside another value, and entries of a collection, that are displayed.
LONGEST, MOST = 60, 6
# Numbers of an array that are displayed, and letters of a line.
FEW, WIDTH = 4, 150


def shown(cls: C) -> C:
    """Have a class show itself in one line, and in a notebook as tables.

    A property ``headline`` is its one line, a method ``tables`` its tables; without them it is
    its fields, arrays by their shape and range.

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
    cls.__repr__ = _line
    if not hasattr(cls, "_repr_html_"):
        cls._repr_html_ = _html
    return cls


def brief(value: Any) -> str:
    """Say in a few words what a value is, whatever its size.

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
            return words if len(words) <= LONGEST else words[: LONGEST - 4] + " ..."
        case Mapping():
            return f"{{{_few([f'{name}: {brief(one)}' for name, one in value.items()])}}}"
        case tuple() | list() if not hasattr(value, "_fields"):
            return f"({_few([brief(one) for one in value])})"
    if hasattr(value, "shape"):
        return _array(value)
    if (headline := getattr(value, "headline", None)) is not None:
        return brief(headline)
    if not _is_record(value):
        return cell(value)
    name, words = type(value).__name__, ", ".join(words for _, words in _fields(value))
    return f"{name}({words})" if len(words) <= LONGEST else name


def _few(words: list[str]) -> str:
    if len(words) > MOST:
        return f"{len(words)} of {words[0]}, ..."
    return ", ".join(words)


def _array(values: Any) -> str:
    """The number, or the shape and range; what JAX only traces has no numbers yet."""
    import numpy as np

    try:
        numbers = np.asarray(values)
    except TypeError:
        return "traced"
    if numbers.ndim == 0:
        return f"{numbers:.6g}" if numbers.dtype.kind == "f" else str(numbers)
    if numbers.size <= FEW and numbers.ndim == 1:
        return f"({', '.join(map(brief, numbers.tolist()))})"
    shape = " x ".join(map(str, numbers.shape))
    if numbers.dtype.kind not in "fiu" or not np.isfinite(numbers).any():
        return f"{shape} values"
    known = numbers[np.isfinite(numbers)]
    return f"{shape} values from {known.min():.4g} to {known.max():.4g}"


def _is_record(value: Any) -> bool:
    return dataclasses.is_dataclass(value) or hasattr(value, "_fields")


def _fields(value: Any) -> list[list[str]]:
    if hasattr(value, "_fields"):
        return [[name, brief(one)] for name, one in value._asdict().items()]
    return [[f.name, brief(getattr(value, f.name))] for f in dataclasses.fields(value)]


def _line(value: Any) -> str:
    words = getattr(value, "headline", None)
    words = ", ".join("=".join(field) for field in _fields(value)) if words is None else words
    words = " ".join(words.split())
    words = words if len(words) <= WIDTH else words[: WIDTH - 4] + " ..."
    return f"<{type(value).__name__} {words}>"


def _html(value: Any) -> str:
    if not hasattr(value, "tables"):
        return html_of(Table(type(value).__name__, [], _fields(value)))
    said = getattr(value, "message", "")
    return "".join(map(html_of, value.tables())) + (f"<p>{escape(said)}</p>" if said else "")


# Words that name an entry of a list in JSON, where it has one of them.
NAMES = ("name", "plane", "output", "record")


def answer(cls: C) -> C:
    """Have a result answer in every form; what a class says itself is left as it is.

    A result has a ``headline``, a ``status``, a ``message`` and ``tables()``, and ``to_json()``
    gives what the JSON contract wants of it. From these follow its line at a prompt, its page in
    a notebook, ``print``, ``to_dict``, ``to_frame``, ``plot``, and quantities by their names.

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
    for name, form in FORMS.items():
        if name not in vars(cls):
            setattr(cls, name, form)
    return shown(cls)


def quantities_of(result: Any) -> dict[str, Quantity]:
    """Find every quantity of a result, by the name it has there or by its path in the JSON.

    Examples
    --------
    >>> quantities_of({"screen": {"beta": Quantity(1.2, 0.1, "m")}})
    {'screen.beta': <Quantity 1.20 ± 0.10 m>}
    """
    own = getattr(result, "quantities", None)
    return dict(own) if isinstance(own, Mapping) else dict(_found(json_of(result), ()))


def _found(value: Any, path: tuple[str, ...]) -> Iterator[tuple[str, Quantity]]:
    match value:
        case {"value": int() | float() as number, "error": error, "unit": str() as unit}:
            ends = value.get("interval_95")
            ends = None if ends is None else (ends[0], ends[1])
            yield ".".join(path), Quantity(number, error, unit, value.get("error_raw"), ends)
        case dict():
            for name, one in value.items():
                yield from _found(one, path if name == "value" else (*path, name))
        case list() if value and isinstance(value[0], dict):
            for i, one in enumerate(value):
                name = next((one[n] for n in NAMES if isinstance(one.get(n), str)), str(i))
                yield from _found(one, (*path, name))


def _dict(self: Any) -> Any:
    """Give what ``--json`` prints of it, as Python's dicts, lists and numbers."""
    return json_of(self)


def _frame(self: Any) -> DataFrame:
    """Give a pandas data frame: one row a quantity, or its first table where it has none.

    Columns of quantities are value, error, error_raw, low_95, high_95 and unit.

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


def _item(self: Any, name: str) -> Quantity:
    """Give a quantity by its name."""
    found = quantities_of(self)
    if name not in found:
        raise InputError(f"no quantity '{name}'", nearest(str(name), list(found)))
    return found[name]


def _names(self: Any) -> Iterator[str]:
    """Go through the names of the quantities."""
    return iter(quantities_of(self))


def _spoken(self: Any) -> tuple[list[str], Sequence[Table]]:
    """The verdict and what is odd, line by line, and every table."""
    headline, message = self.headline, getattr(self, "message", "")
    begin = f"{headline}.\n" if "\n" in message else f"{headline}. "
    said = headline if message in ("", headline) else begin + message
    remarks = [*getattr(self, "notes", ()), *dict(getattr(self, "doubts", {})).values()]
    return [*said.split("\n"), *remarks], self.tables() if hasattr(self, "tables") else ()


def _text(self: Any) -> str:
    """Write the verdict, what is odd, and every table."""
    if not hasattr(self, "headline"):
        return repr(self)
    lines, tables = _spoken(self)
    return "\n\n".join(["\n".join(lines), *map(text_of, tables)])


def _page(self: Any) -> str:
    """Lay out the same for a notebook."""
    if not hasattr(self, "headline"):
        return _html(self)
    lines, tables = _spoken(self)
    return "".join(f"<p>{escape(line)}</p>" for line in lines) + "".join(map(html_of, tables))


def _plot(self: Any, **options: Any) -> Figure:
    """Draw it, as the first picture of its report: a matplotlib Figure."""
    return import_module("beamfit.figures").picture(self, **options)


FORMS = {
    "__getitem__": _item,
    "__iter__": _names,
    "__str__": _text,
    "_repr_html_": _page,
    "plot": _plot,
    "to_dict": _dict,
    "to_frame": _frame,
}


def frame_of(columns: Mapping[str, Sequence[Any]], index: Sequence[str] = ()) -> DataFrame:
    """Make a data frame of columns, some of them its index.

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
    """Make a data frame of quantities: value, errors, ends of the 95 % interval, and unit."""
    keys, found = list(rows), list(rows.values())
    ends = [q.interval_95 or (None, None) for q in found]
    columns = {name: [key[i] for key in keys] for i, name in enumerate(names)}
    columns |= {name: [getattr(q, name) for q in found] for name in ("value", "error", "error_raw")}
    columns |= {"low_95": [low for low, _ in ends], "high_95": [high for _, high in ends]}
    numbers = ("value", "error", "error_raw", "low_95", "high_95")
    nan = float("nan")
    columns |= {n: [nan if v is None else float(v) for v in columns[n]] for n in numbers}
    return frame_of(columns | {"unit": [q.unit for q in found]}, names)
