"""Points of a live scan, limits of its settings, and its file."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from io import StringIO
from itertools import zip_longest
from typing import NamedTuple

import numpy as np

import beamfit
from beamfit.emittance.scan import KNOB, QuadScan
from beamfit.errors import plain
from beamfit.io.columns import SETTINGS
from beamfit.io.machine import ScanMachine


class MeasuredPoint(NamedTuple):
    """Measured point: settings as read back, shots of each plane in m, and the Unix time."""

    settings: dict[str, float]
    shots: dict[str, np.ndarray]
    time: float


def standard_errors(shots: Sequence[np.ndarray]) -> list[float]:
    """Standard errors of the means of shots; an empty list if a setting has no scatter.

    Examples
    --------
    >>> standard_errors([np.array([1.0, 3.0]), np.array([2.0, 2.0])])
    []
    """
    found = [float(s.std(ddof=1) / np.sqrt(s.size)) if s.size > 1 else 0.0 for s in shots]
    return found if min(found) > 0 else []


def scan_of(points: Sequence[MeasuredPoint], machine: ScanMachine) -> QuadScan:
    """Make a scan from the points, with individual shots if they scatter.

    Parameters
    ----------
    points : sequence of MeasuredPoint
        At least three different settings.
    machine : ScanMachine
        The scanned machine.

    Returns
    -------
    QuadScan

    Raises
    ------
    InputError
        If the points are not sufficient for a scan.
    """
    settings = {m.name: np.array([p.settings[m.name] for p in points]) for m in machine.magnets}
    shots = {plane: [p.shots[plane] for p in points] for plane in points[0].shots}
    size = {plane: np.array([s.mean() for s in each]) for plane, each in shots.items()}
    found = {plane: standard_errors(each) for plane, each in shots.items()}
    error = {plane: np.array(each) for plane, each in found.items() if each}
    count = np.array([min(map(len, p.shots.values())) for p in points])
    single = {plane: _shot_table(shots[plane]) for plane in error}
    units = {m.name: m.unit if m.unit in SETTINGS else KNOB for m in machine.magnets}
    return QuadScan(
        settings, units, size, error, shots=count if error else None, name=machine.name,
        shot_size=single, screen=(machine.screen.name,) * len(points),
        error_source="the scatter of the shots",
    )  # fmt: skip


def _shot_table(shots: Sequence[np.ndarray]) -> np.ndarray:
    """Make one table of the shots of all settings, padded with NaN."""
    table = np.full((len(shots), max(map(len, shots))), np.nan)
    for row, own in zip(table, shots, strict=True):
        row[: len(own)] = own
    return table


def limits_within(
    name: str, low: float, high: float, barred: Sequence[Mapping[str, float]],
    before: Mapping[str, float],
) -> tuple[float, float]:  # fmt: skip
    """Narrow the limits to half way between each barred setting and the initial setting."""
    for settings in barred:
        middle = 0.5 * (settings[name] + before[name])
        if settings[name] > before[name]:
            high = min(high, middle)
        elif settings[name] < before[name]:
            low = max(low, middle)
    return low, high


def clip_settings(
    settings: Mapping[str, float], limits: Mapping[str, tuple[float, float]]
) -> dict[str, float]:
    """Restrict settings to the limits, and round them to six digits."""
    return {name: float(np.clip(float(f"{settings[name]:.6g}"), *limits[name])) for name in limits}


def scan_text(
    points: Sequence[MeasuredPoint], machine: ScanMachine, before: Mapping[str, float]
) -> str:
    """Write the points as CSV that `beamfit.read_quad_scan` reads.

    Parameters
    ----------
    points : sequence of MeasuredPoint
        At least one.
    machine : ScanMachine
        The scanned machine.
    before : mapping of str to float
        Settings before the scan.

    Returns
    -------
    str
        One row per shot with sizes in um and settings as read back.
    """
    planes = list(points[0].shots)
    names = [f"{m.name}_{m.unit}" for m in machine.magnets] + [f"size_{p}_um" for p in planes]
    rows = [[*names, "shot", "screen", "time"]]
    for point in points:
        settings = [point.settings[m.name] for m in machine.magnets]
        last = [machine.screen.name, _time_text(point.time)]
        sizes = zip_longest(*(1e6 * point.shots[plane] for plane in planes), fillvalue=math.nan)
        for number, shot in enumerate(sizes, 1):
            rows.append([*(f"{value:.9g}" for value in (*settings, *shot)), str(number), *last])
    table = StringIO()
    csv.writer(table, lineterminator="\n").writerows(rows)
    head = (plain(" ".join(line.split())) for line in _comments(machine, before))
    return "\n".join([*head, table.getvalue()])


def _comments(machine: ScanMachine, before: Mapping[str, float]) -> list[str]:
    """Return the comments of the file about the measurement."""
    screen = machine.screen
    variables = ", ".join((screen.sizes or screen.profiles).values())
    measured = "sizes" if screen.sizes else "Gaussian fits to projections"
    return [
        f"# {machine.name}: scan by beamfit {beamfit.__version__}, {_time_text(None)}",
        f"# machine file {machine.path}, sha256 {machine.sha256}",
        f"# lattice {machine.lattice.path}, sha256 {machine.lattice.sha256}",
        *(
            f"# {m.name}: set by {m.set}, read back by {m.read}; before the scan "
            f"{before[m.name]:.9g} {m.unit}"
            for m in machine.magnets
        ),
        f"# screen {screen.name}: {measured} from {variables}, {screen.shots} shots a setting",
    ]


def _time_text(time: float | None) -> str:
    at = datetime.now(UTC) if time is None else datetime.fromtimestamp(time, UTC)
    return at.isoformat(timespec="milliseconds" if time else "seconds")
