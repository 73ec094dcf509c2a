"""Control charts: a quantity through a batch, in the order of its files, with control limits."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from beamfit.answer import Table, labelled, plain_name
from beamfit.batch.columns import COLUMNS, quantity_columns
from beamfit.batch.run import Batch
from beamfit.emittance.model import QUANTITIES
from beamfit.errors import InputError, nearest
from beamfit.lifetime.evidence import UNITS
from beamfit.quantity import display_unit
from beamfit.statistics import baseline, control_limits

# Control limits wider than this many standard deviations of all points are not used: they come from
# fewer than five points, where Student's quantile is large.
MAX_LIMIT = 6.0
# Quantities of each kind of fit, and the default one.
CHARTED = {"emittance": (QUANTITIES, "normalized_emittance"), "lifetime": (UNITS, "lifetime_mean")}


class ControlChart(NamedTuple):
    """Control chart of a quantity through a batch.

    Attributes
    ----------
    name, unit : str
        Quantity and its unit.
    of : str
        Plane, with the slice if there are any; empty for lifetimes.
    files : list of str
        File of each point.
    at : ndarray
        Shape (n,): position of that file in the batch, from 1.
    value, error : ndarray
        Shape (n,).
    centre, limit : float
        Centre line, and distance of the control limits from it.
    """

    name: str
    unit: str
    of: str
    files: list[str]
    at: np.ndarray
    value: np.ndarray
    error: np.ndarray
    centre: float
    limit: float

    @property
    def beyond(self) -> np.ndarray:
        """True for each point beyond the limits and beyond 3 of its own errors from the centre."""
        return np.abs(self.value - self.centre) > np.maximum(self.limit, 3.0 * self.error)

    @property
    def label(self) -> str:
        """Name of the quantity and its plane."""
        return f"{plain_name(self.name)} {self.of}".strip()

    @property
    def reach(self) -> float:
        """Distance of the control limits from the centre; infinite if too few points give them."""
        return self.limit if self.limit < MAX_LIMIT * np.std(self.value) else math.inf

    def shown(self, value: float) -> str:
        """Format a value in the display unit of the centre line."""
        factor, unit = display_unit(abs(self.centre), self.unit)
        return f"{value / factor:#.4g} {unit}".strip()


def summary_of(courses: Sequence[ControlChart]) -> Table:
    """Table of the distribution of each quantity over the files."""
    rows = [("answers", [f"{len(c.value)}" for c in courses])]
    for label, number in (("median", np.median), ("lowest", np.min), ("highest", np.max)):
        rows.append((label, [c.shown(float(number(c.value))) for c in courses]))
    spread = [c.shown(float(np.std(c.value))) if len(c.value) > 1 else None for c in courses]
    rows.append(("standard deviation", spread))
    rows.append(("median error", [c.shown(float(np.median(c.error))) for c in courses]))
    beyond = [f"{c.beyond.sum()}" if math.isfinite(c.reach) else "no limits" for c in courses]
    rows.append(("beyond the limits", beyond))
    return labelled("Result", [c.label for c in courses], rows)


def chart_quantity(kind: str, name: str | None = None) -> tuple[str, str]:
    """Check a quantity of a kind of fit, and return it with its unit.

    Raises
    ------
    InputError
        If there is no such quantity.

    Examples
    --------
    >>> chart_quantity("lifetime")
    ('lifetime_mean', 'h')
    """
    quantities, default = CHARTED[kind]
    name = name or default
    if name not in quantities:
        raise InputError(f"--quantity {name}", nearest(name, list(quantities)))
    return name, quantities[name]


def courses_of(batch: Batch, name: str | None = None) -> list[ControlChart]:
    """Make the control charts of a quantity from all answers that determine it.

    Parameters
    ----------
    batch : Batch
        The batch; points are in the order of its files.
    name : str, optional
        Default: the normalised emittance or the mean lifetime.

    Returns
    -------
    list of ControlChart
        One for each plane and slice; limits are `control_limits` of the first 20 points, or of
        half of them.

    Raises
    ------
    InputError
        As `chart_quantity`.
    """
    name, unit = chart_quantity(batch.ledger.job.kind, name)
    points: dict[str, list[tuple[str, int, float, float]]] = {}
    for at, (plane, file, value, error) in _points(batch, quantity_columns(name, unit)):
        points.setdefault(plane, []).append((file, at, value, error))
    found = []
    for plane, plane_points in sorted(points.items()):
        files, *numbers = zip(*plane_points, strict=True)
        at, value, error = map(np.array, numbers)
        limits = control_limits(value[: baseline(len(value))])
        found.append(ControlChart(name, unit, plane, list(files), at, value, error, *limits))
    return found


def _points(
    batch: Batch, columns: tuple[str, ...]
) -> Iterator[tuple[int, tuple[str, str, float, float]]]:
    """Points of all planes: position of the file; plane, file, value and error."""
    names = COLUMNS[batch.ledger.job.kind]
    value, error = (names.index(column) for column in columns[:2])
    words = [names.index(name) for name in ("slice", "plane") if name in names]
    positions = {file: i for i, file in enumerate(batch.files, start=1)}
    for row in csv.reader(raw.decode() for raw in batch.ledger.rows(batch.files)):
        if row[value] and row[error]:
            plane = " ".join(row[i] for i in words if row[i])
            yield positions[row[0]], (plane, row[0], float(row[value]), float(row[error]))
