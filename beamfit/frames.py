"""pandas data frames out of results; pandas is loaded when one is asked for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from beamfit.errors import InputError
from beamfit.quantity import Quantity

if TYPE_CHECKING:
    from pandas import DataFrame


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


def quantity_frame(rows: Mapping[tuple[str, str], Quantity], names: tuple[str, str]) -> DataFrame:
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
