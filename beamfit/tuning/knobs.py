"""Knobs of a machine with their limits, and what is to be low; plain NumPy."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from beamfit.emittance.scan import QuadScan
from beamfit.errors import InputError, nearest

# What is made small: the geometric mean of the planes' emittances, or one of them.
GOALS = ("emittance", "emittance_x", "emittance_y")


class Knobs(NamedTuple):
    """Knobs that are tuned, with their limits and units.

    ``names`` and ``units`` are tuples of str, ``low`` and ``high`` have shape (knobs,).
    """

    names: tuple[str, ...]
    low: np.ndarray
    high: np.ndarray
    units: tuple[str, ...]

    def half_ranges(self, settings: Mapping[str, np.ndarray]) -> np.ndarray:
        """Settings by name as numbers from -1 to 1 between the limits, shape (n, knobs)."""
        values = np.stack([np.asarray(settings[n], float) for n in self.names], axis=-1)
        return (2.0 * values - self.low - self.high) / (self.high - self.low)

    def settings(self, x: np.ndarray) -> np.ndarray:
        """Settings, shape (n, knobs), of numbers from -1 to 1."""
        return 0.5 * (self.low + self.high + x * (self.high - self.low))


def knobs_of(scan: QuadScan, limits: Mapping[str, tuple[float, float]]) -> Knobs:
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


def planes_of(scan: QuadScan, goal: str) -> tuple[str, ...]:
    """Planes that a goal speaks of."""
    if goal not in GOALS:
        raise InputError(f"goal '{goal}'", nearest(str(goal), list(GOALS)))
    if goal == GOALS[0]:
        return scan.planes
    scan.rows(goal[-1])  # says so if it was not measured
    return (goal[-1],)
