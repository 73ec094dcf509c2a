"""Display of a value: one line at a prompt, a table in a notebook."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from enum import Enum
from html import escape
from typing import Any, TypeVar

from beamfit.quantity import Quantity
from beamfit.table import Table, cell, html_of

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
