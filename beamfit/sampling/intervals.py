"""Summaries of draws: intervals, correlations, bands, and their tables."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from beamfit.quantity import Quantity, display_unit
from beamfit.shown import shown
from beamfit.table import MOST_ROWS, Table, plain_name

HEADER = ("", "median", "68 % interval", "95 % interval")


class Interval(NamedTuple):
    """A number's median and central credible interval.

    Attributes
    ----------
    name : str
        What it is.
    median, lower, upper : float
        In `unit`.
    unit : str
        Unit.
    separable : bool
        Whether the data decide it; if not, the interval is the prior's or the bounds' and is not
        to be quoted.
    """

    name: str
    median: float
    lower: float
    upper: float
    unit: str
    separable: bool = True

    def __str__(self) -> str:
        if not math.isfinite(self.median):
            return f"{self.name}: not determined"
        said = f"{self.name}: {self.median:.4g} ({self.lower:.4g} to {self.upper:.4g}) {self.unit}"
        return said if self.separable else f"{said}, not separable"


class Summary(NamedTuple):
    """A number with its quantiles at 2.5, 16, 50, 84 and 97.5 %.

    `doubt` says in a word or two why no interval may be quoted; empty where one may.
    """

    name: str
    quantity: Quantity
    quantiles: np.ndarray
    doubt: str = ""

    def to_json(self) -> dict[str, Any]:
        """Give one of ``quantities`` of the JSON contract; intervals are null where in doubt."""
        low, one, middle, other, high = map(float, self.quantiles)
        return {
            "name": self.name,
            "value": self.quantity.value,
            "error": self.quantity.error,
            "median": middle,
            "interval_68": None if self.doubt else [one, other],
            "interval_95": None if self.doubt else [low, high],
            "unit": self.quantity.unit,
        }

    def row(self) -> list[str]:
        """Label, median and intervals, with the digits that their width allows."""
        label = plain_name(self.name)
        if not np.isfinite(self.quantiles).all():
            return [label, "not determined", "-", "-"]
        (low, one, middle, other, high), unit = in_unit(self.quantiles, self.quantity.unit)
        label = f"{label}, {unit}" if unit else label
        if self.doubt:
            return [label, "not determined", self.doubt, self.doubt]
        width = 0.5 * (other - one)
        places = 4 if width <= 0 else min(max(1 - math.floor(math.log10(width)), 0), 12)
        one, other, low, high = (f"{v:.{places}f}" for v in (one, other, low, high))
        return [label, f"{middle:.{places}f}", f"{one} to {other}", f"{low} to {high}"]


def interval_table(rows: Sequence[Summary], title: str = "", note: str = "") -> Table:
    """Table with a row for each number: median and intervals."""
    cells = [row.row() for row in rows[:MOST_ROWS]]
    left = len(rows) - MOST_ROWS
    return Table(title, HEADER, [*cells, *([[f"and {left} more"]] if left > 0 else [])], note)


@shown
class Correlations(NamedTuple):
    """Correlation coefficients of numbers, one row and column a name."""

    names: tuple[str, ...]
    values: np.ndarray

    @property
    def headline(self) -> str:
        """Names of the quantities, in a line."""
        return f"of {', '.join(self.names)}"

    def tables(self) -> tuple[Table, ...]:
        """The coefficients, to be shown."""
        rows = [
            [plain_name(name), *(f"{value:.3f}" for value in row)]
            for name, row in zip(self.names, self.values, strict=True)
        ]
        header = ["", *map(plain_name, self.names)]
        return (Table("Correlation coefficients", header, rows, numeric=True),)


class Band(NamedTuple):
    """Median and ends of a credible interval, point by point."""

    lower: np.ndarray
    median: np.ndarray
    upper: np.ndarray


class Expected(NamedTuple):
    """Posterior prediction of measurements; arrays of shape (n,) or (2, n).

    Attributes
    ----------
    median : array, shape (n,)
        Of the model.
    model : array, shape (2, n)
        Ends of the 68 % interval of the model: how well the curve is known.
    reading : array, shape (2, n)
        Ends of the 95 % interval of a further reading, its noise included: where points should lie.
    """

    median: np.ndarray
    model: np.ndarray
    reading: np.ndarray


def in_unit(values: np.ndarray, unit: str) -> tuple[np.ndarray, str]:
    """Values in a unit in which they are easily read, and that unit.

    Examples
    --------
    >>> in_unit(np.array([7e-7]), "m")[1], in_unit(np.array([7e-8]), "1/s")[1]
    ('µm', '1e-8 1/s')
    """
    size = float(np.quantile(np.abs(values), 0.98))
    factor, shown = display_unit(size, unit)
    if unit != "m" and size > 0 and not 1e-3 <= size < 1e5:
        power = math.floor(math.log10(size))
        factor, shown = 10.0**power, f"1e{power} {shown}".strip()
    return values / factor, shown.replace("^2", "²")
