"""Answers: a result's quantities, status and message, in every form that is asked for."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any, TypeVar

from beamfit.errors import InputError, nearest
from beamfit.quantity import Quantity
from beamfit.shown import shown
from beamfit.table import json_of, text_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

C = TypeVar("C", bound=type)
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


def _text(self: Any) -> str:
    """Write the verdict, what is odd, and every table."""
    headline, message = getattr(self, "headline", None), getattr(self, "message", "")
    if headline is None:
        return repr(self)
    said = headline if message in ("", headline) else f"{headline}. {message}"
    tables = self.tables() if hasattr(self, "tables") else ()
    remarks = [*getattr(self, "notes", ()), *dict(getattr(self, "doubts", {})).values()]
    return "\n\n".join(["\n".join([said, *remarks]), *map(text_of, tables)])


def _plot(self: Any, **options: Any) -> Figure:
    """Draw it, as the first picture of its report: a matplotlib Figure."""
    return import_module("beamfit.figures").picture(self, **options)


FORMS = {
    "__getitem__": _item,
    "__iter__": _names,
    "__str__": _text,
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
