"""A scan of knobs through its line: the sizes of each plane, prepared for a map."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from beamfit.arrays import padded_length
from beamfit.emittance.beam_draws import Coordinates, coordinates
from beamfit.emittance.comparison import AMPLITUDES, LN_SIZE_SPREAD
from beamfit.emittance.scan import QuadScan
from beamfit.emittance.statement import (
    PreparedScan,
    assemble,
    plane_sizes,
    single_beam,
    with_elements,
)
from beamfit.noise.model import LN_2PI, Noise
from beamfit.noise.sizes import kinds_of
from beamfit.optics.beamline import Beamline
from beamfit.tuning.knob_map import KnobReadings
from beamfit.tuning.knobs import EmittanceTable, Knobs

# Start beam where no constant one fits: ln of its emittance, ln of beta, and alpha in the
# coordinates.
DEFAULT_BEAM = np.array([-1.0, 0.0, 0.0])
# Nodes over ln of the scale of the noise, in standard deviations of its prior.
NOISE_NODES = np.linspace(-2.5, 2.5, 11)


def prepare_without_knobs(
    scan: QuadScan, line: Beamline | None, knobs: Knobs, noise: Noise | None
) -> PreparedScan:
    """Prepare the scan with its line, leaving out the knobs, which are no magnets of it."""
    scan, line = single_beam(scan.without_settings(knobs.names), line)
    return with_elements([assemble(scan, line, noise=noise)])[0]


class PlaneReadings(NamedTuple):
    """Readings of a plane, a start beam, and their units.

    Attributes
    ----------
    readings : KnobReadings
        Padded readings.
    start : ndarray
        Numbers of the start beam, shape (3,).
    emittance : float
        Unit of the emittance whose logarithm the map gives, m.
    rows : ndarray
        Rows of the table in which the plane was measured.
    coordinates : Coordinates or None
        Coordinates of the beam; None for emittances.
    """

    readings: KnobReadings
    start: np.ndarray
    emittance: float
    rows: np.ndarray
    coordinates: Coordinates | None = None


def plane_readings(
    seen: PreparedScan, plane: str, knobs: Knobs, settings: Mapping[str, np.ndarray], room: int = 0
) -> PlaneReadings:
    """Prepare the sizes of a plane at the settings of the knobs, with the noise of scans.

    Notes
    -----
    Sizes with errors from shots scatter beyond them by a share of the size. Stated errors are lower
    limits. Sizes without errors have an unknown relative error.
    """
    sizes, _ = plane_sizes(seen, plane)
    c = coordinates(sizes.r11, sizes.r12, sizes.size, sizes.known)
    if not c.separable:
        raise seen.scan.unusable(
            f"sizes in {plane} that no magnet or screen tells apart",
            "rows at three or more settings of a quadrupole",
            f"size_{plane}",
        )
    noise = _relative_noise(sizes.size, sizes.error, sizes.of_shots, seen.noise)
    rows = np.asarray(seen.measured(plane))
    x, w = knobs.half_ranges(settings)[rows], np.column_stack([c.w, np.zeros(len(rows))])
    readings = _pad(x, w, c.known, np.log(c.size), noise, seen.noise, room)
    emittance = float(abs(np.linalg.det(c.back)) * c.unit**2)
    return PlaneReadings(readings, _constant_beam(c), emittance, rows, c)


def emittance_readings(
    table: EmittanceTable, plane: str, knobs: Knobs, noise: Noise, room: int = 0
) -> PlaneReadings:
    """Prepare the emittances of a plane, whose roots stand for sizes.

    Stated errors are lower limits.

    Examples
    --------
    >>> from beamfit.tuning.knobs import knobs_of
    >>> table = EmittanceTable({"SOL": [0.0, 1.0]}, {"x": [4e-7, 9e-7]}, {"x": [4e-8, 9e-8]})
    >>> found = emittance_readings(table, "x", knobs_of(table, {"SOL": (0.0, 1.0)}), Noise())
    >>> float(np.diff(found.readings.y[:2])[0].round(3)), round(1e7 * found.emittance, 3)
    (0.405, 6.0)
    """
    rows = np.flatnonzero(~np.isnan(table.emittance[plane]))
    value, error = table.emittance[plane][rows], table.error.get(plane)
    floor, unit, prior = _relative_noise(
        value, error if error is None else error[rows], False, noise
    )
    log, w = 0.5 * np.log(value), np.tile([0.0, 0.0, 1.0], (len(rows), 1))
    x, halved = knobs.half_ranges(table.settings)[rows], (0.5 * floor, 0.5 * unit, prior)
    readings = _pad(x, w, np.zeros(len(rows)), log - log.mean(), halved, noise, room)
    return PlaneReadings(readings, np.zeros(3), math.exp(2.0 * log.mean()), rows)


def _pad(
    x: np.ndarray,
    w: np.ndarray,
    known: np.ndarray,
    y: np.ndarray,
    errors: tuple[np.ndarray, np.ndarray, np.ndarray],
    noise: Noise,
    room: int,
) -> KnobReadings:
    """Pad readings, with floor, unit and prior of their errors, to a common length."""
    n, bad = len(x), noise.of_points(len(x)).bad

    def padded(values: np.ndarray, fill: float = 0.0) -> np.ndarray:
        padding = [(0, padded_length(max(n, room)) - n)] + [(0, 0)] * (values.ndim - 1)
        return np.pad(values, padding, constant_values=fill)

    return KnobReadings(
        padded(x), padded(w), padded(known, 1.0), padded(y), padded(errors[0], 1.0),
        padded(errors[1]), padded(np.ones(n)), errors[2], np.float64(bad / (1.0 - bad)),
        np.float64(noise.width),
    )  # fmt: skip


def _relative_noise(
    size: np.ndarray, error: np.ndarray | None, of_shots: bool, noise: Noise
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Relative floor and unit of the errors, and the prior of ln of the scale of the unit."""
    kind = kinds_of(noise, size, error, of_shots)[0]
    share = 1.0 if kind.power else size
    prior = noise.factor if kind.least else kind.prior
    floor, unit, middle = kind.floor / share, kind.unit / share, prior.middle
    if kind.least:
        # Stated errors are a floor; the scatter in addition makes them larger by the factor.
        floor, middle = np.hypot(floor, kind.least * unit), math.sqrt(middle**2 - kind.least**2)
    return floor, unit, np.array([math.log(middle), prior.spread])


def _constant_beam(c: Coordinates) -> np.ndarray:
    """Numbers of the beam that fits all sizes best if the knobs change nothing."""
    rows = np.stack([c.w[:, 0] ** 2, 2.0 * c.w[:, 0] * c.w[:, 1], c.w[:, 1] ** 2], -1)
    weight = c.size[:, None] ** -2
    s11, s12, s22 = np.linalg.lstsq(rows * weight, (c.size**2 - c.known) * weight[:, 0])[0]
    square = s11 * s22 - s12**2
    if not (s11 > 0.0 and square > 0.0):
        return DEFAULT_BEAM
    emittance = math.sqrt(square)
    return np.array([math.log(emittance), math.log(s11 / emittance), -s12 / emittance])


def log_no_beam(data: KnobReadings) -> float:
    """Log evidence of sizes that are not of a beam: constant or random at the settings.

    Notes
    -----
    ln of a size is a level, with or without random steps of one size about it, as in scans
    (docs/verdict_constants.md); the evidence is averaged over steps and noise.

    Examples
    --------
    >>> one, none = np.ones(2), np.zeros(2)
    >>> data = KnobReadings(none, none, none, none, none, one, one, np.log([1e-3, 2.0]), 0.0, 1.0)
    >>> log_no_beam(data) > 0.0  # of two equal sizes, a density
    True
    """
    here = data.present > 0
    y, floor, unit = data.y[here], data.floor[here], data.unit[here]
    scale = np.exp(data.noise[0] + data.noise[1] * NOISE_NODES)[:, None]
    noise = floor**2 + (scale * unit) ** 2
    variance = np.append(0.0, AMPLITUDES)[:, None, None] ** 2 + noise
    weight, own = (1.0 / variance).sum(-1) + LN_SIZE_SPREAD**-2, (y / variance).sum(-1)
    log = -0.5 * ((y**2 / variance + np.log(variance) + LN_2PI).sum(-1) - own**2 / weight)
    log -= 0.5 * np.log(weight * LN_SIZE_SPREAD**2)
    prior = -0.5 * NOISE_NODES**2
    prior -= np.logaddexp.reduce(prior) + math.log(len(variance))
    return float(np.logaddexp.reduce((log + prior).ravel()))
