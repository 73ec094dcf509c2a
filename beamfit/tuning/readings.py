"""A scan of knobs seen through its line: the sizes of each plane, ready for a map."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from beamfit.emittance.beam_draws import Coordinates, coordinates
from beamfit.emittance.comparison import PlaneSizes
from beamfit.emittance.known import one_by_one, plane_sizes, prepared, unfitted
from beamfit.emittance.scan import QuadScan
from beamfit.emittance.statement import Seen
from beamfit.emittance.transport import look_through
from beamfit.errors import InputError, nearest
from beamfit.greybox.problem import padded_length
from beamfit.noise.model import Noise
from beamfit.noise.sizes import kinds_of
from beamfit.optics.beamline import Beamline
from beamfit.tuning.posterior import Readings

# Ends of an axis that no knob has: a range is at least this share of its larger end.
NARROW = 1e-9
# A beam to begin with where no constant one fits: ln of its emittance in the coordinates.
BEGIN = np.array([-1.0, 0.0, 0.0])


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
        raise scan.unusable("no knob", "KNOB=LOW:HIGH such as SOL=180:220")
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


def seen_without(scan: QuadScan, line: Beamline | None, knobs: Knobs, noise: Noise | None) -> Seen:
    """The scan through its line; the knobs are no magnets of it."""
    left = {n: v for n, v in scan.settings.items() if n not in knobs.names}
    units = {n: scan.units[n] for n in left}
    scan, line = prepared(replace(scan, settings=left, units=units), line)
    seen = unfitted(scan, line, noise=noise)
    return seen._replace(look=one_by_one(look_through, [(seen.rows,)])[0])


class PlaneReadings(NamedTuple):
    """Readings of a plane, the coordinates they are in, and a beam to begin with, shape (3,)."""

    readings: Readings
    coordinates: Coordinates
    start: np.ndarray

    @property
    def emittance(self) -> float:
        """The emittance of which a map has the logarithm, m."""
        return float(abs(np.linalg.det(self.coordinates.back)) * self.coordinates.unit**2)


def plane_readings(
    seen: Seen, plane: str, knobs: Knobs, settings: Mapping[str, np.ndarray]
) -> PlaneReadings:
    """The sizes of a plane at the settings of the knobs, with the noise of scans.

    Notes
    -----
    Sizes with the errors of means of shots scatter beyond them by a share of the size, those with
    stated errors have errors at least as large, those without have a share of the size.
    """
    sizes, _ = plane_sizes(seen, plane)
    c = coordinates(sizes.r11, sizes.r12, sizes.size, sizes.known)
    if not c.seen:
        raise seen.scan.unusable(
            f"sizes in {plane} that no magnet or screen tells apart",
            "rows at three or more settings of a quadrupole",
            f"size_{plane}",
        )
    floor, unit, noise = _relative_noise(sizes, seen.noise)
    x = knobs.half_ranges(settings)[seen.measured(plane)]
    n = len(x)

    def filled(values: np.ndarray, fill: float = 0.0) -> np.ndarray:
        more = [(0, padded_length(n) - n)] + [(0, 0)] * (values.ndim - 1)
        return np.pad(values, more, constant_values=fill)

    bad = seen.noise.of_points(n).bad
    readings = Readings(
        filled(x), filled(c.w), filled(c.known, 1.0), filled(np.log(c.size)), filled(floor, 1.0),
        filled(unit), filled(np.ones(n)), noise, np.float64(bad / (1.0 - bad)),
        np.float64(seen.noise.width),
    )  # fmt: skip
    return PlaneReadings(readings, c, _constant_beam(c))


def _relative_noise(sizes: PlaneSizes, noise: Noise) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Relative floor and unit of the errors, and the prior of ln of the scale of the unit."""
    floor = sizes.error if sizes.of_shots else None
    kind = kinds_of(noise, sizes.size, None if sizes.of_shots else sizes.error, floor)[0]
    share = 1.0 if kind.power else sizes.size
    floor, unit, middle = kind.floor / share, kind.unit / share, kind.prior.middle
    if kind.least:
        # Stated errors are a floor; with the scatter beside them they are larger by the factor.
        floor, middle = np.hypot(floor, kind.least * unit), math.sqrt(middle**2 - kind.least**2)
    return floor, unit, np.array([math.log(middle), kind.prior.spread])


def _constant_beam(c: Coordinates) -> np.ndarray:
    """Numbers of the beam that fits all sizes best if the knobs change nothing."""
    rows = np.stack([c.w[:, 0] ** 2, 2.0 * c.w[:, 0] * c.w[:, 1], c.w[:, 1] ** 2], -1)
    weight = c.size[:, None] ** -2
    s11, s12, s22 = np.linalg.lstsq(rows * weight, (c.size**2 - c.known) * weight[:, 0])[0]
    square = s11 * s22 - s12**2
    if not (s11 > 0.0 and square > 0.0):
        return BEGIN
    emittance = math.sqrt(square)
    return np.array([math.log(emittance), math.log(s11 / emittance), -s12 / emittance])


def planes_of(scan: QuadScan, goal: str, goals: Sequence[str]) -> tuple[str, ...]:
    """Planes that a goal speaks of."""
    if goal not in goals:
        raise InputError(f"goal '{goal}'", nearest(str(goal), list(goals)))
    if goal == goals[0]:
        return scan.planes
    scan.rows(goal[-1])  # says so if it was not measured
    return (goal[-1],)
