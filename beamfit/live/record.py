"""The points of a scan as an ordinary scan file, with where they come from."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from io import StringIO
from itertools import zip_longest

import beamfit
from beamfit.errors import plain
from beamfit.io.machine import ScanMachine
from beamfit.live.next_setting import Point


def scan_text(points: Sequence[Point], machine: ScanMachine, before: Mapping[str, float]) -> str:
    """Write the points as CSV that `beamfit.read_quad_scan` reads.

    Parameters
    ----------
    points : sequence of Point
        At least one.
    machine : ScanMachine
        Whose magnets and screen they are of.
    before : mapping of str to float
        Settings before the scan.

    Returns
    -------
    str
        A row a shot: sizes in um, settings those read back. A shot that lies off makes no mean.
    """
    planes = list(points[0].shots)
    names = [f"{m.name}_{m.unit}" for m in machine.magnets] + [f"size_{p}_um" for p in planes]
    rows = [[*names, "shot", "screen", "time"]]
    for point in points:
        settings = [point.settings[m.name] for m in machine.magnets]
        last = [machine.screen.name, _written(point.time)]
        sizes = zip_longest(*(1e6 * point.shots[plane] for plane in planes), fillvalue=math.nan)
        for number, shot in enumerate(sizes, 1):
            rows.append([*(f"{value:.9g}" for value in (*settings, *shot)), str(number), *last])
    table = StringIO()
    csv.writer(table, lineterminator="\n").writerows(rows)
    head = (plain(" ".join(line.split())) for line in _head(machine, before))
    return "\n".join([*head, table.getvalue()])


def _head(machine: ScanMachine, before: Mapping[str, float]) -> list[str]:
    """What a reader of the file wants to know of how it was measured, as comments."""
    screen = machine.screen
    variables = ", ".join((screen.sizes or screen.profiles).values())
    measured = "sizes" if screen.sizes else "Gaussian fits to projections"
    return [
        f"# {machine.name}: scan by beamfit {beamfit.__version__}, {_written(None)}",
        f"# machine file {machine.path}, sha256 {machine.sha256}",
        f"# lattice {machine.lattice.path}, sha256 {machine.lattice.sha256}",
        *(
            f"# {m.name}: set by {m.set}, read back by {m.read}; before the scan "
            f"{before[m.name]:.9g} {m.unit}"
            for m in machine.magnets
        ),
        f"# screen {screen.name}: {measured} from {variables}, {screen.shots} shots a setting",
    ]


def _written(time: float | None) -> str:
    at = datetime.now(UTC) if time is None else datetime.fromtimestamp(time, UTC)
    return at.isoformat(timespec="milliseconds" if time else "seconds")
