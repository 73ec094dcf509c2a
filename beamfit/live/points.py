"""The points of a scan: the fit to them, the setting to measure next, and the file they make."""

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
from beamfit.emittance.advice import adviser_of
from beamfit.emittance.design import best_steps
from beamfit.emittance.fit import EmittanceFit, fit_emittance
from beamfit.emittance.scan import KNOB, QuadScan
from beamfit.errors import InputError, plain
from beamfit.greybox.problem import padded_length
from beamfit.io.headers import SETTINGS
from beamfit.io.machine import Magnet, ScanMachine
from beamfit.optics.beamline import Beamline
from beamfit.statistics import POOR_FIT, chi2_probability
from beamfit.status import Status

# Where a scan begins, in parts of the range of its first magnet.
BEGIN = (0.1, 0.37, 0.63, 0.9)
# Points that each further magnet is moved for at least: a beam has three numbers, so that each
# magnet by itself tells all of it. Where they disagree the line is wrong.
FEW = 3
# Settings of each of two magnets among which `wrong_line` looks for the best.
LEVELS = 7
# Points before which a goal is not taken for reached: three numbers meet five sizes too easily.
FEWEST = 6


class MeasuredPoint(NamedTuple):
    """A setting as it was read back, the shots of each plane, m, and when, Unix time."""

    settings: dict[str, float]
    shots: dict[str, np.ndarray]
    time: float


class Next(NamedTuple):
    """A setting to measure, and why it is chosen."""

    settings: dict[str, float]
    why: str


def standard_errors(shots: Sequence[np.ndarray]) -> list[float]:
    """Standard errors of the means of some shots; none where a setting has no scatter.

    Examples
    --------
    >>> standard_errors([np.array([1.0, 3.0]), np.array([2.0, 2.0])])
    []
    """
    found = [float(s.std(ddof=1) / np.sqrt(s.size)) if s.size > 1 else 0.0 for s in shots]
    return found if min(found) > 0 else []


def scan_of(points: Sequence[MeasuredPoint], machine: ScanMachine) -> QuadScan:
    """The points as a scan, with the shots themselves where they scatter.

    Parameters
    ----------
    points : sequence of MeasuredPoint
        At three different settings at least.
    machine : ScanMachine
        Whose magnets they are of.

    Returns
    -------
    QuadScan

    Raises
    ------
    InputError
        If they are no scan yet.
    """
    settings = {m.name: np.array([p.settings[m.name] for p in points]) for m in machine.magnets}
    shots = {plane: [p.shots[plane] for p in points] for plane in points[0].shots}
    size = {plane: np.array([s.mean() for s in each]) for plane, each in shots.items()}
    found = {plane: standard_errors(each) for plane, each in shots.items()}
    error = {plane: np.array(each) for plane, each in found.items() if each}
    count = np.array([min(map(len, p.shots.values())) for p in points])
    single = {plane: _padded(shots[plane]) for plane in error}
    units = {m.name: m.unit if m.unit in SETTINGS else KNOB for m in machine.magnets}
    return QuadScan(
        settings, units, size, error, shots=count if error else None, name=machine.name,
        shot_size=single, screen=(machine.screen.name,) * len(points),
        error_source="the scatter of the shots",
    )  # fmt: skip


def _padded(shots: Sequence[np.ndarray]) -> np.ndarray:
    """Shots of all settings in one table, NaN where there are fewer."""
    table = np.full((len(shots), max(map(len, shots))), np.nan)
    for row, own in zip(table, shots, strict=True):
        row[: len(own)] = own
    return table


def fit_of(
    points: Sequence[MeasuredPoint], machine: ScanMachine, line: Beamline
) -> EmittanceFit | None:
    """The fit to the points, None as long as they are no scan."""
    try:
        return fit_emittance(scan_of(points, machine), line)
    except InputError:
        return None


def warmed(machine: ScanMachine, line: Beamline) -> None:
    """Have everything compiled that a scan needs, so that no magnet waits for it."""
    magnet = machine.magnets[0]
    middle = {m.name: 0.5 * (m.low + m.high) for m in machine.magnets}
    rng = np.random.default_rng(0)
    planes = machine.screen.sizes or machine.screen.profiles
    # One number of points of each length that records are padded to.
    for count in {padded_length(n): n for n in range(FEWEST - 1, machine.points + 1)}.values():
        points = [
            MeasuredPoint(
                middle | {magnet.name: value},
                {p: 1e-4 * (1 + 0.02 * rng.standard_normal(3)) for p in planes},
                0.0,
            )
            for value in np.linspace(magnet.low, magnet.high, count)
        ]
        fit = fit_of(points, machine, line)
        next_setting(points, fit, (), machine, middle)
        if fit is not None and machine.magnets[1:]:
            for plane in planes:
                fit.predict({name: np.full(LEVELS**2, v) for name, v in middle.items()}, plane)


def sharp(fit: EmittanceFit | None, points: Sequence[MeasuredPoint], goal: float) -> bool:
    """Tell fits whose every emittance is trusted and known to a relative error.

    Parameters
    ----------
    fit : EmittanceFit or None
        To the points.
    points : sequence of MeasuredPoint
        Fewer than six are never enough.
    goal : float
        Relative error.
    """
    if fit is None or len(points) < FEWEST:
        return False
    return all(
        p.status is Status.converged
        and p.emittance.error is not None
        and p.emittance.error <= goal * p.emittance.value
        for p in fit.planes
    )


def doubt(fit: EmittanceFit | None, points: Sequence[MeasuredPoint]) -> str:
    """Sizes that miss the line by far more than their shots scatter, in words; "" if none do.

    The errors of the fit hold it as a scatter of the settings, which real magnets have; a line that
    is wrong shows in the same way, and there no error holds.
    """
    planes = [p for p in (fit.planes if fit else ()) if p.chi2 is not None]
    chi2, dof = sum(p.chi2 for p in planes), sum(p.dof for p in planes)
    freedom = sum(point.shots[p.plane].size - 1 for p in planes for point in points)
    chance = chi2_probability(chi2, dof, max(freedom, 1))
    if chance is None or chance >= POOR_FIT:
        return ""
    found = f"χ² {chi2:.0f} with {dof} degrees of freedom"
    return f"The sizes miss this line by more than their shots scatter ({found}): is it right?"


def first_settings(machine: ScanMachine) -> tuple[float, ...]:
    """First settings of a scan: as the machine file says, or over the range of its first magnet."""
    low, high = machine.magnets[0].span
    return machine.first or tuple(low + p * (high - low) for p in BEGIN)


def next_setting(
    points: Sequence[MeasuredPoint],
    fit: EmittanceFit | None,
    barred: Sequence[Mapping[str, float]],
    machine: ScanMachine,
    before: Mapping[str, float],
) -> Next | str:
    """Choose the next setting, or say why there should be none.

    Parameters
    ----------
    points : sequence of MeasuredPoint
        What is measured.
    fit : EmittanceFit or None
        To the points.
    barred : sequence of mapping
        Settings at which nothing could be measured; nothing beyond them is chosen.
    machine : ScanMachine
        Limits, and settings to begin with.
    before : mapping of str to float
        Settings before the scan.

    Returns
    -------
    Next or str
        First settings over the range of the first magnet; then those that tell most, by
        `beamfit.emittance.design`: of magnets that fewer than three points moved where there are
        some, since a wrong line shows there alone. The middle of the largest gap where nothing can
        be fitted.
    """
    limits = {m.name: limits_within(m.name, *m.span, barred, before) for m in machine.magnets}
    first = machine.magnets[0]
    low, high = limits[first.name]
    begin = first_settings(machine)[len(points) + len(barred) :]
    if begin and low <= begin[0] <= high:
        return Next(clipped(dict(before) | {first.name: begin[0]}, limits), "first settings")
    if fit is not None:
        new = {name: limits[name] for name in fresh(points, machine)}
        aim = "D" if new else "emittance"  # of a new magnet whatever it gains
        steps, stop = best_steps(fit, adviser_of(fit), new or limits, aim)
        if steps:
            wanted = steps[0].candidate.settings
            return Next(clipped(dict(before) | wanted, limits), "where it tells most")
        if len(points) >= FEWEST:
            return stop.removeprefix("Stop: ").rstrip(".")
    gaps = np.sort([low, high, *(p.settings[first.name] for p in points)])
    place = int(np.argmax(np.diff(gaps)))
    middle = 0.5 * float(gaps[place] + gaps[place + 1])
    return Next(clipped(dict(before) | {first.name: middle}, limits), "the largest gap")


def fresh(points: Sequence[MeasuredPoint], machine: ScanMachine) -> list[str]:
    """Magnets that fewer than three points have moved.

    Parameters
    ----------
    points : sequence of MeasuredPoint
        What is measured, at least one.
    machine : ScanMachine
        Whose magnets they are of.
    """

    def moved(magnet: Magnet) -> int:
        settings = [p.settings[magnet.name] for p in points]
        usual = float(np.median(settings))
        return sum(abs(value - usual) > 2 * magnet.tolerance for value in settings)

    return [m.name for m in machine.magnets[1:] if moved(m) < FEW]


def limits_within(
    name: str, low: float, high: float, barred: Sequence[Mapping[str, float]],
    before: Mapping[str, float],
) -> tuple[float, float]:  # fmt: skip
    """Limits drawn in, half way from a barred setting to where the magnet was."""
    for settings in barred:
        middle = 0.5 * (settings[name] + before[name])
        if settings[name] > before[name]:
            high = min(high, middle)
        elif settings[name] < before[name]:
            low = max(low, middle)
    return low, high


def clipped(
    settings: Mapping[str, float], limits: Mapping[str, tuple[float, float]]
) -> dict[str, float]:
    """Settings within the limits, of as many digits as a person would type."""
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
    """Comments of the file on how it was measured."""
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
