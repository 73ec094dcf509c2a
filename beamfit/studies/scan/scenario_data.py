"""From a scan, seen through its line, to the records and the beam numbers of a scenario."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from beamfit.greybox.problem import Free, Record
from beamfit.optics.beamline import Beamline
from beamfit.studies.scan.plane import PlaneWork, work_on
from beamfit.studies.scan.scans import QuadScan, check_names
from beamfit.studies.scan.scenario_model import UNIT, Rows, predict_sizes
from beamfit.studies.scan.transport import (
    names_of,
    plane_input,
    scan_rows,
    scanned_line,
    transfer_rows,
)

__all__ = [
    "Seen",
    "beam_free",
    "beam_numbers",
    "branch_of",
    "plane_rows",
    "see",
    "size_record",
    "varied_magnets",
]


class Seen(NamedTuple):
    """A scan through its line, with the fit of known transport of each plane to start from."""

    scan: QuadScan
    line: Beamline
    scanned: Beamline
    works: dict[str, PlaneWork]
    squared: bool

    @property
    def planes(self) -> tuple[str, ...]:
        """The planes to fit."""
        return tuple(self.works)


def see(scan: QuadScan, line: Beamline, planes: tuple[str, ...] | None, method: str) -> Seen:
    """Fit the scan with known transport, which every scenario starts from.

    Parameters
    ----------
    scan, line, planes, method
        As for `beamfit.fit_emittance`.

    Returns
    -------
    Seen

    Raises
    ------
    InputError
        If the line lacks a magnet or screen of the scan.
    """
    check_names(scan, *names_of(line))
    scanned = scanned_line(scan, line)
    rows = scan_rows(scan, scanned)
    matrices = transfer_rows(scanned, rows.settings, rows.energy, places=rows.places)
    works = {
        plane: work_on(
            plane,
            plane_input(scan, scanned, rows, matrices, plane),
            getattr(line.design, plane, None),
            method,
        )
        for plane in planes or scan.planes
    }
    return Seen(scan, line, scanned, works, method == "size_squared")


def varied_magnets(seen: Seen) -> tuple[str, ...]:
    """Magnets whose setting changes during the scan."""
    return tuple(n for n, v in seen.scan.settings.items() if np.ptp(v) > 0)


def branch_of(settings: np.ndarray) -> np.ndarray:
    """Branch of each setting in the order of measuring: +1 reached rising, -1 falling.

    A setting that repeats the one before keeps its branch; the first takes the next one's, as a
    magnet is brought to the start of a ramp from beyond it.

    Examples
    --------
    >>> branch_of(np.array([0.0, 1.0, 2.0, 2.0, 1.0, 0.0])).tolist()
    [1.0, 1.0, 1.0, 1.0, -1.0, -1.0]
    """
    steps = np.sign(np.diff(settings))
    found = np.concatenate([[0.0], steps])
    for i in range(1, len(found)):
        found[i] = found[i] or found[i - 1]
    first = next((f for f in found if f != 0.0), 1.0)
    return np.where(found == 0.0, first, found)


def plane_rows(seen: Seen, plane: str, branches: Mapping[str, np.ndarray] | None = None) -> Rows:
    """Collect what predicts one plane's sizes; ``branches`` joins a branch to a magnet's settings.

    Parameters
    ----------
    seen : Seen
        The scan.
    plane : str
        "x" or "y".
    branches : mapping of str to ndarray, optional
        Magnet name to the branch of every row of the scan, shape (len(scan),).

    Returns
    -------
    Rows
    """
    given = seen.works[plane].given
    keep = np.flatnonzero(~np.isnan(seen.scan.size[plane]))
    settings = {name: np.asarray(v, float) for name, v in given.settings.items()}
    for name, branch in (branches or {}).items():
        settings[name] = np.stack([settings[name], branch[keep]], -1)
    places = tuple(dict.fromkeys(given.screen))
    seen_spread = (given.r16 * given.energy_spread) ** 2
    return Rows(
        plane,
        places,
        seen.squared,
        seen.scanned,
        {name: jnp.asarray(v) for name, v in settings.items()},
        jnp.asarray(given.energy),
        jnp.asarray([places.index(s) for s in given.screen]),
        jnp.asarray(given.energy_spread),
        jnp.asarray(np.sqrt(np.maximum(given.known - seen_spread, 0.0))),
    )


def size_record(seen: Seen, plane: str, data: object, predict=predict_sizes) -> Record:
    """The measured sizes of a plane, in µm² or µm, with the errors the known-transport fit used."""
    points = seen.works[plane].points
    # Three points without errors tell no noise; the verdict refuses them whatever stands here.
    error = np.where(np.isfinite(points.error), points.error, 0.05 * points.size)
    size, error = 1e6 * points.size, 1e6 * error
    if seen.squared:
        return Record(f"size {plane}", predict, data, size**2, 2.0 * size * error)
    return Record(f"size {plane}", predict, data, size, error)


def beam_numbers(seen: Seen) -> dict[str, dict[str, float]]:
    """Cholesky factors to start from: the known-transport fit, kept off zero emittance."""
    found = {}
    for plane, work in seen.works.items():
        s11, s12, s22 = (float(v) / UNIT**2 for v in work.fit.sigma)
        l11 = np.sqrt(max(s11, 1e-6))
        l21 = s12 / l11
        l22 = np.sqrt(max(s22 - l21**2, 0.0025 * max(s22, 1e-6)))
        found[plane] = {"l11": l11, "l21": l21, "l22": l22}
    return found


def beam_free(beams: Mapping[str, Mapping[str, float]]) -> list[Free]:
    """The beam's numbers as free ones: l11 and l22 positive."""
    free = []
    for plane, numbers in beams.items():
        angle = float(np.hypot(numbers["l21"], numbers["l22"]))
        reach = {
            "l11": (0.5 * numbers["l11"], 1.5 * numbers["l11"]),
            "l21": (-angle, angle),
            "l22": (0.1 * angle, angle),
        }
        for name in numbers:
            low = -np.inf if name == "l21" else 1e-6
            free.append(Free(f"beam.{plane}.{name}", low, np.inf, reach[name]))
    return free
