"""The course of a quantity through a batch, in the order of its files, with control limits."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from beamfit.answer import Table, labelled, plain_name
from beamfit.batch.columns import COLUMNS, named
from beamfit.batch.run import Batch
from beamfit.emittance.model import QUANTITIES
from beamfit.errors import InputError, nearest
from beamfit.lifetime.evidence import UNITS
from beamfit.quantity import display_unit
from beamfit.statistics import baseline, control_limits

# Standard deviations of all points; limits that are wider rest on fewer than five points, whose
# Student's quantile they show.
WIDEST = 6.0
# Quantities of each kind, and the default one.
FOLLOWED = {"emittance": (QUANTITIES, "normalized_emittance"), "lifetime": (UNITS, "lifetime_mean")}


class ControlChart(NamedTuple):
    """A quantity through a batch.

    Attributes
    ----------
    name, unit : str
        Which, and its SI unit.
    of : str
        The plane, and the slice if there are any; empty for lifetimes.
    files : list of str
        The file of each point.
    at : ndarray
        Shape (n,): the place of that file in the batch, from 1.
    value, error : ndarray
        Shape (n,).
    centre, limit : float
        The usual value, and how far from it the control limits are.
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
        """The quantity and its plane, as people read them."""
        return f"{plain_name(self.name)} {self.of}".strip()

    @property
    def reach(self) -> float:
        """Reach of the control limits; infinite where too few points make them to say
        anything.
        """
        return self.limit if self.limit < WIDEST * np.std(self.value) else math.inf

    def shown(self, value: float) -> str:
        """Write a value of it in the unit in which its usual value is read."""
        factor, unit = display_unit(abs(self.centre), self.unit)
        return f"{value / factor:#.4g} {unit}".strip()


def summary_of(courses: Sequence[ControlChart]) -> Table:
    """The spread of each quantity through the files."""
    rows = [("answers", [f"{len(c.value)}" for c in courses])]
    for label, number in (("median", np.median), ("lowest", np.min), ("highest", np.max)):
        rows.append((label, [c.shown(float(number(c.value))) for c in courses]))
    spread = [c.shown(float(np.std(c.value))) if len(c.value) > 1 else None for c in courses]
    rows.append(("standard deviation", spread))
    rows.append(("median error", [c.shown(float(np.median(c.error))) for c in courses]))
    beyond = [f"{c.beyond.sum()}" if math.isfinite(c.reach) else "no limits" for c in courses]
    rows.append(("beyond the limits", beyond))
    return labelled("Result", [c.label for c in courses], rows)


def followed(kind: str, name: str | None = None) -> tuple[str, str]:
    """A quantity of a kind and its unit; by default the first choice of the kind.

    Raises
    ------
    InputError
        If there is no such quantity.

    Examples
    --------
    >>> followed("lifetime")
    ('lifetime_mean', 'h')
    """
    known, usual = FOLLOWED[kind]
    name = name or usual
    if name not in known:
        raise InputError(f"--quantity {name}", nearest(name, list(known)))
    return name, known[name]


def courses_of(batch: Batch, name: str | None = None) -> list[ControlChart]:
    """Follow a quantity wherever the data determine it.

    Parameters
    ----------
    batch : Batch
        Files in the order in which they are followed.
    name : str, optional
        Default: the normalised emittance or the mean lifetime.

    Returns
    -------
    list of ControlChart
        One a plane and slice; limits are `control_limits` of the first 20 points, or of half of
        them.

    Raises
    ------
    InputError
        As `followed`.
    """
    name, unit = followed(batch.ledger.job.kind, name)
    points: dict[str, list[tuple[str, int, float, float]]] = {}
    for at, (of, file, value, error) in _points(batch, named(name, unit)):
        points.setdefault(of, []).append((file, at, value, error))
    found = []
    for of, own in sorted(points.items()):
        files, *numbers = zip(*own, strict=True)
        at, value, error = map(np.array, numbers)
        limits = control_limits(value[: baseline(len(value))])
        found.append(ControlChart(name, unit, of, list(files), at, value, error, *limits))
    return found


def _points(
    batch: Batch, columns: tuple[str, ...]
) -> Iterator[tuple[int, tuple[str, str, float, float]]]:
    own = COLUMNS[batch.ledger.job.kind]
    value, error = (own.index(column) for column in columns[:2])
    words = [own.index(name) for name in ("slice", "plane") if name in own]
    place = {file: i for i, file in enumerate(batch.files, start=1)}
    for row in csv.reader(raw.decode() for raw in batch.ledger.rows(batch.files)):
        if row[value] and row[error]:
            of = " ".join(row[i] for i in words if row[i])
            yield place[row[0]], (of, row[0], float(row[value]), float(row[error]))
