"""A tuning at a running machine: the fit of its knobs, and the row to measure next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from beamfit.errors import InputError
from beamfit.greybox.problem import padded_length
from beamfit.io.machine import ScanMachine
from beamfit.live.points import MeasuredPoint, Next, clipped, limits_within, scan_of
from beamfit.optics.beamline import Beamline
from beamfit.tuning.fit import TuningFit, fit_tuning
from beamfit.tuning.minimum import settings_within
from beamfit.tuning.next_row import next_row

# Rows for each knob that fill the limits before a fit chooses: a beam has three numbers.
BEGIN = 4
# A power of two above the rows that begin a tuning of six knobs.
POWER = 6


def tuning_of(
    points: Sequence[MeasuredPoint], machine: ScanMachine, line: Beamline
) -> TuningFit | None:
    """The tuning fit to the points, None as long as they are no table of one."""
    limits = {m.name: m.span for m in machine.magnets if m.name in machine.knobs}
    if len(points) < BEGIN * len(limits):
        return None
    try:
        return fit_tuning(scan_of(points, machine), line, limits, within=machine.goal)
    except InputError:
        return None


def next_knobs(
    points: Sequence[MeasuredPoint],
    fit: TuningFit | None,
    barred: Sequence[Mapping[str, float]],
    machine: ScanMachine,
    before: Mapping[str, float],
) -> Next | str:
    """Choose the next row of a tuning, or say why there should be none.

    Parameters
    ----------
    points, barred, machine, before
        As for `beamfit.live.points.next_setting`.
    fit : TuningFit or None
        To the points.

    Returns
    -------
    Next or str
        Rows that fill the limits, four for each knob; then the row that tells most of the minimum.
    """
    if fit is not None and fit.done:
        return f"the best setting is within {100 * machine.goal:.3g} % of the minimum"
    if len(points) >= machine.points:
        return f"all {machine.points} points are measured"
    limits = {m.name: limits_within(m.name, *m.span, barred, before) for m in machine.magnets}
    if fit is not None:
        quadrupoles = {n: ends for n, ends in limits.items() if n not in machine.knobs}
        row = next_row(fit, quadrupoles).settings
        return Next(clipped(dict(before) | row, limits), "where it tells most of the minimum")
    at = settings_within(len(limits), POWER)[(len(points) + len(barred)) % 2**POWER]
    low, high = np.array(list(limits.values())).T
    values = 0.5 * (low + high + at * (high - low))
    row = dict(zip(limits, map(float, values), strict=True))
    return Next(clipped(row, limits), "rows that fill the limits")


def warmed_tuning(machine: ScanMachine, line: Beamline) -> None:
    """Have everything compiled that a tuning needs, so that no magnet waits for it."""
    rng, low, high = np.random.default_rng(0), *np.array([m.span for m in machine.magnets]).T
    names = [m.name for m in machine.magnets]
    before = dict(zip(names, map(float, 0.5 * (low + high)), strict=True))
    planes = machine.screen.sizes or machine.screen.profiles
    least = BEGIN * len(machine.knobs)
    # One number of points of each length that rows are padded to.
    for count in {padded_length(n): n for n in range(least, machine.points + 1)}.values():
        at = low + rng.random((count, len(names))) * (high - low)
        points = [
            MeasuredPoint(
                dict(zip(names, map(float, row), strict=True)),
                {p: 1e-4 * (1 + 0.3 * rng.random() + 0.02 * rng.random(3)) for p in planes},
                0.0,
            )
            for row in at
        ]
        next_knobs(points[:-1], tuning_of(points, machine, line), (), machine, before)
