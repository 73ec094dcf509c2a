"""A scan of knobs seen through its line: the sizes of each plane, ready for a map."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from beamfit.emittance.beam_draws import Coordinates, coordinates
from beamfit.emittance.comparison import LEVEL, STEPS, PlaneSizes
from beamfit.emittance.known import one_by_one, plane_sizes, prepared, unfitted
from beamfit.emittance.scan import QuadScan
from beamfit.emittance.statement import Seen
from beamfit.emittance.transport import look_through
from beamfit.greybox.problem import padded_length
from beamfit.noise.model import LN_2PI, Noise
from beamfit.noise.sizes import kinds_of
from beamfit.optics.beamline import Beamline
from beamfit.tuning.knobs import Knobs
from beamfit.tuning.posterior import KnobReadings

# A beam to begin with where no constant one fits: ln of its emittance in the coordinates.
BEGIN = np.array([-1.0, 0.0, 0.0])
# Nodes over ln of the scale of the noise, in standard deviations of its prior.
NODES = np.linspace(-2.5, 2.5, 11)


def seen_without(scan: QuadScan, line: Beamline | None, knobs: Knobs, noise: Noise | None) -> Seen:
    """The scan through its line; the knobs are no magnets of it."""
    scan, line = prepared(scan.without_settings(knobs.names), line)
    seen = unfitted(scan, line, noise=noise)
    return seen._replace(look=one_by_one(look_through, [(seen.rows,)])[0])


class PlaneReadings(NamedTuple):
    """Readings of a plane, the coordinates they are in, and a beam to begin with, shape (3,)."""

    readings: KnobReadings
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
    readings = KnobReadings(
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


def log_no_beam(data: KnobReadings) -> float:
    """Log evidence of sizes that are of no beam: the same at all settings, or at random.

    Notes
    -----
    ln of a size is a level with steps of one size about it, as of scans (docs/verdict_constants.md)
    or none; steps and noise are averaged over.

    Examples
    --------
    >>> one, none = np.ones(2), np.zeros(2)
    >>> data = KnobReadings(none, none, none, none, none, one, one, np.log([1e-3, 2.0]), 0.0, 1.0)
    >>> log_no_beam(data) < 0.0
    True
    """
    here = data.there > 0
    y, floor, unit = data.y[here], data.floor[here], data.unit[here]
    scale = np.exp(data.noise[0] + data.noise[1] * NODES)[:, None]
    noise = floor**2 + (scale * unit) ** 2
    variance = np.append(0.0, STEPS)[:, None, None] ** 2 + noise
    weight, own = (1.0 / variance).sum(-1) + LEVEL**-2, (y / variance).sum(-1)
    log = -0.5 * ((y**2 / variance + np.log(variance) + LN_2PI).sum(-1) - own**2 / weight)
    log -= 0.5 * np.log(weight * LEVEL**2)
    prior = -0.5 * NODES**2
    prior -= np.logaddexp.reduce(prior) + math.log(len(variance))
    return float(np.logaddexp.reduce((log + prior).ravel()))
