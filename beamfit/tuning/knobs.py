"""Knobs of a machine with their limits, and the goal of tuning; plain NumPy."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from os import PathLike
from typing import Any, NamedTuple

import numpy as np

from beamfit.emittance.scan import KNOB, QuadScan, first_unusable
from beamfit.errors import InputError, nearest

# Goals: the geometric mean of the planes' emittances, or one of them.
GOALS = ("emittance", "emittance_x", "emittance_y")


@dataclass(frozen=True, eq=False)
class EmittanceTable:
    """Finished emittances at settings of knobs, from whole scans or a direct measurement.

    Parameters
    ----------
    settings : mapping of str to array
        Settings by knob, each of shape (n,).
    emittance : mapping of str to array
        Emittances in m by plane ("x", "y"); NaN where a row has none.
    error : mapping of str to array, optional
        Standard errors in m by plane; the fit estimates those of a plane left out.
    normalized : bool
        True for normalised emittances.
    name, path, sha256, provenance, notes, columns
        The same as in a `beamfit.QuadScan`.

    Raises
    ------
    InputError
        If emittances or errors are not positive, or lengths differ.

    Examples
    --------
    >>> table = EmittanceTable({"SOL": [190.0, 200.0]}, {"x": [8e-7, 7e-7]})
    >>> table.planes, len(table)
    (('x',), 2)
    """

    settings: Mapping[str, np.ndarray]
    emittance: Mapping[str, np.ndarray]
    error: Mapping[str, np.ndarray] = field(default_factory=dict)
    normalized: bool = True
    name: str = "table"
    path: str | PathLike[str] | None = None
    sha256: str | None = None
    provenance: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    columns: Mapping[str, str] = field(default_factory=dict)

    error_source = "given"

    def __post_init__(self) -> None:
        for key in ("settings", "emittance", "error"):
            arrays = {k: np.asarray(v, float) for k, v in getattr(self, key).items()}
            object.__setattr__(self, key, arrays)
            for name, values in arrays.items():
                if values.shape != (len(self),):
                    expected = f"{len(self)} numbers, one a row"
                    raise self.unusable(f"shape {values.shape} of {name}", expected, name)
                if key != "settings" and (wrong := first_unusable(values, blank=True)):
                    raise self.unusable(wrong[1], f"a positive {key}", f"{key} {name}")

    def __len__(self) -> int:
        return len(next(iter(self.settings.values())))

    @property
    def planes(self) -> tuple[str, ...]:
        """Measured planes."""
        return tuple(p for p in "xy" if p in self.emittance)

    @property
    def units(self) -> dict[str, str]:
        """Unit of each knob."""
        return dict.fromkeys(self.settings, KNOB)

    def columns_at(self, rows: Sequence[int]) -> dict[str, Any]:
        """Select some rows: arguments of `EmittanceTable` by name."""
        keys, at = ("settings", "emittance", "error"), list(rows)
        return {key: {n: v[at] for n, v in getattr(self, key).items()} for key in keys}

    unusable = QuadScan.unusable


class Knobs(NamedTuple):
    """Knobs that are tuned, with their limits and units.

    ``names`` and ``units`` are tuples of str, ``low`` and ``high`` have shape (knobs,).
    """

    names: tuple[str, ...]
    low: np.ndarray
    high: np.ndarray
    units: tuple[str, ...]

    def half_ranges(self, settings: Mapping[str, np.ndarray]) -> np.ndarray:
        """Scale settings by name to numbers from -1 to 1 between the limits, shape (n, knobs)."""
        values = np.stack([np.asarray(settings[n], float) for n in self.names], axis=-1)
        return (2.0 * values - self.low - self.high) / (self.high - self.low)

    def settings(self, x: np.ndarray) -> np.ndarray:
        """Convert numbers from -1 to 1 to settings, shape (n, knobs)."""
        return 0.5 * (self.low + self.high + x * (self.high - self.low))


def knobs_of(scan: QuadScan | EmittanceTable, limits: Mapping[str, tuple[float, float]]) -> Knobs:
    """Check the knobs of a scan and their limits.

    Raises
    ------
    InputError
        If there is none, the scan has no such column, limits are in the wrong order, or no row
        lies between them.

    Examples
    --------
    >>> scan = QuadScan({"Q": [0.0, 1.0, 2.0], "phase": [0.0, 5.0, 9.0]},
    ...                 {"Q": "A", "phase": "knob"}, {"x": [2e-4, 1e-4, 3e-4]})
    >>> knobs_of(scan, {"phase": (0.0, 10.0)}).half_ranges(scan.settings).ravel().tolist()
    [-1.0, 0.0, 0.8]
    """
    if not limits:
        raise scan.unusable("no knob", "NAME=LOW:HIGH such as SOL=180:220")
    for name, (low, high) in limits.items():
        if name not in scan.settings:
            raise scan.unusable(f"no knob '{name}'", nearest(name, list(scan.settings)))
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            raise InputError(f"limits {low:g}:{high:g} of {name}", "two numbers, the lower first")
        inside = (scan.settings[name] >= low) & (scan.settings[name] <= high)
        if not inside.any():
            own = f"{scan.settings[name].min():g} to {scan.settings[name].max():g}"
            found = f"limits {low:g}:{high:g} of {name}, which was set from {own}"
            raise scan.unusable(found, "limits within which the table has rows", name)
    low, high = np.array(list(limits.values()), float).T
    return Knobs(tuple(limits), low, high, tuple(scan.units[n] for n in limits))


def planes_of(scan: QuadScan | EmittanceTable, goal: str) -> tuple[str, ...]:
    """Planes of a goal."""
    if goal not in GOALS:
        raise InputError(f"goal '{goal}'", nearest(str(goal), list(GOALS)))
    if goal == GOALS[0]:
        return scan.planes
    if goal[-1] not in scan.planes:
        raise scan.unusable(f"nothing measured in plane {goal[-1]}", f"goal {GOALS[0]}")
    return (goal[-1],)
