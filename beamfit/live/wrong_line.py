"""Settings at which a drift of a wrong length between two magnets would show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise, product
from typing import NamedTuple

import numpy as np

from beamfit.emittance.fit import EmittanceFit
from beamfit.io.machine import ScanMachine
from beamfit.live.points import LEVELS, MeasuredPoint, Next, fit_of
from beamfit.optics.beamline import Beamline
from beamfit.optics.elements import Drift

# Lengths over that of the file: what a distance is typed wrong by, or a magnet left out, is seldom
# less, and a smaller share hardly moves the emittance.
STRETCHED = (4 / 3, 2 / 3)
# χ² by which a line meets the sizes worse and is out: three standard deviations.
OUT = 9.0
# Points beyond the goal that a scan takes for this: one for each stretched line and one more.
MOST = 3


class WrongLine(NamedTuple):
    """A line with one distance that is not the file's, in words, and the magnets at its ends."""

    words: str
    line: Beamline
    magnets: tuple[str, str]


def wrong_lines(line: Beamline, machine: ScanMachine) -> list[WrongLine]:
    """The line with the drifts between two scanned magnets a third longer or shorter."""
    supplies, names = dict(line.supplies), [e.name for e in line.elements]
    placed = sorted(
        (names.index(supplies.get(m.name, (m.name,))[0]), m.name) for m in machine.magnets
    )
    found = []
    for (first, one), (last, other) in pairwise(placed):
        for factor in STRETCHED if any(_is_drift(e) for e in line.elements[first:last]) else ():
            elements = tuple(
                replace(e, length=factor * e.length) if first < i < last and _is_drift(e) else e
                for i, e in enumerate(line.elements)
            )
            words = f"the drift from {one} to {other} times {factor:.3g}"
            found.append(WrongLine(words, replace(line, elements=elements), (one, other)))
    return found


def _is_drift(element: object) -> bool:
    return isinstance(element, Drift)


def telling_setting(
    points: Sequence[MeasuredPoint], fit: EmittanceFit, machine: ScanMachine,
    lines: Sequence[WrongLine], before: Mapping[str, float],
) -> Next | None:  # fmt: skip
    """Choose the setting at which some wrong line parts most from the right one.

    Parameters
    ----------
    points : sequence of MeasuredPoint
        What is measured.
    fit : EmittanceFit
        To the points, by the line of the file.
    machine : ScanMachine
        Limits.
    lines : sequence of WrongLine
        From `wrong_lines`.
    before : mapping of str to float
        Settings before the scan, of magnets that stay.

    Returns
    -------
    Next or None
        None where no line is left that meets the sizes as well and would show anywhere.
    """
    shots = [s for p in points for s in p.shots.values() if s.size > 1]
    share = np.median([s.std(ddof=1) / s.mean() / s.size**0.5 for s in shots]) if shots else 0.0
    best, most = None, OUT
    for wrong in lines if share > 0.0 else ():
        other = fit_of(points, machine, wrong.line)
        if other is None or misfit(other) > misfit(fit) + OUT:
            continue
        limits = [m.span for m in machine.magnets if m.name in wrong.magnets]
        grid = np.array([*product(*(np.linspace(*ends, LEVELS) for ends in limits))]).T
        names = [m.name for m in machine.magnets if m.name in wrong.magnets]
        settings = dict(before) | dict(zip(names, grid, strict=True))
        apart = sum(_apart(fit, other, p.plane, settings, points) for p in fit.planes)
        if (gain := apart.max() / share**2) > most:
            at = dict(zip(names, grid[:, apart.argmax()].tolist(), strict=True))
            best, most = Next(dict(before) | at, f"where {wrong.words} would show"), gain
    return best


def _apart(
    fit: EmittanceFit,
    other: EmittanceFit,
    plane: str,
    settings: Mapping,
    points: Sequence[MeasuredPoint],
) -> np.ndarray:
    """Squared difference of the logarithms of predicted sizes; 0 beyond the sizes measured."""
    one, two = (each.predict(settings, plane).size for each in (fit, other))
    sizes = [p.shots[plane].mean() for p in points]
    seen = (0.5 * min(sizes) < one) & (one < 2.0 * max(sizes))
    return np.where(seen, np.log(one / two) ** 2, 0.0)


def misfit(fit: EmittanceFit) -> float:
    """χ² of all planes by the scatter of the shots."""
    return sum(p.chi2 for p in fit.planes if p.chi2 is not None)


def suspect(
    points: Sequence[MeasuredPoint],
    fit: EmittanceFit,
    machine: ScanMachine,
    lines: Sequence[WrongLine],
) -> str:
    """Name a wrong line that meets the sizes clearly better than the file's; "" if none does."""
    for wrong in lines:
        other = fit_of(points, machine, wrong.line)
        if other is not None and misfit(other) + OUT < misfit(fit):
            said = f"χ² {misfit(other):.0f} in the place of {misfit(fit):.0f}"
            return f"The sizes follow a line with {wrong.words} better ({said}): is it right?"
    return ""
