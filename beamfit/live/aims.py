"""Aims of a live scan: the fit to its points, the next setting, and the end."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise, product
from typing import Any, NamedTuple, Protocol

import numpy as np

from beamfit.arrays import padded_length
from beamfit.emittance.advice import adviser_of
from beamfit.emittance.design import best_steps
from beamfit.emittance.fit import EmittanceFit, fit_emittance
from beamfit.errors import InputError, Status
from beamfit.io.machine import Magnet, ScanMachine
from beamfit.live.points import MeasuredPoint, clip_settings, limits_within, scan_of
from beamfit.optics.beamline import Beamline
from beamfit.optics.elements import Drift
from beamfit.statistics import POOR_FIT, chi2_probability
from beamfit.tuning.fit import TuningFit, fit_tuning
from beamfit.tuning.minimum import next_row, settings_within

# First settings of a scan, as fractions of the range of its first magnet.
FIRST_FRACTIONS = (0.1, 0.37, 0.63, 0.9)
# Smallest number of points for which each further magnet is moved. A beam has three parameters, so
# each magnet alone determines all of it; if magnets disagree, the line is wrong.
MIN_POINTS_PER_MAGNET = 3
# Smallest number of points at which a goal can be reached: three parameters fit five sizes too
# easily.
MIN_POINTS = 6
# Settings of each of two magnets on the grid searched for the largest effect of a wrong line.
GRID_LEVELS = 7
# Lengths of a wrong drift relative to the file. Mistyped distances and missing magnets rarely cause
# less, and a smaller change hardly affects the emittance.
WRONG_LENGTHS = (4 / 3, 2 / 3)
# Increase of χ² that excludes a line: three standard deviations.
MAX_CHI2_INCREASE = 9.0
# Largest number of points beyond the goal that test wrong lines: one for each and one more.
MAX_CHECKS = 3
# Rows per knob spread over the limits before the fit chooses; a beam has three parameters.
ROWS_PER_KNOB = 4
# Exponent of a power of two above the number of initial rows of a tuning of six knobs.
POWER = 6


class Next(NamedTuple):
    """Setting to measure, and the reason for it."""

    settings: dict[str, float]
    why: str


class Aim(Protocol):
    """Purpose of a live scan: its fit, its next setting and its end."""

    def fit(self, points: Sequence[MeasuredPoint]) -> Any:
        """Fit the points; return None if there are too few."""

    def next(
        self, points: Sequence[MeasuredPoint], fit: Any, barred: Sequence[Mapping[str, float]],
        before: Mapping[str, float],
    ) -> Next | str:  # fmt: skip
        """Choose the next setting, or return the reason to stop.

        Parameters
        ----------
        points : sequence of MeasuredPoint
            Points measured so far.
        fit : EmittanceFit, TuningFit or None
            Fit to the points.
        barred : sequence of mapping
            Settings at which nothing could be measured; settings beyond them are not chosen.
        before : mapping of str to float
            Settings before the scan.
        """

    def doubt(self, points: Sequence[MeasuredPoint], fit: Any) -> str:
        """Return why the line may be wrong, or "" if the sizes follow it."""

    def warm(self) -> None:
        """Compile everything that the scan needs, so that no magnet waits for it."""


def aim_of(machine: ScanMachine, line: Beamline) -> Aim:
    """Return the aim for a machine: the lowest emittance if it has knobs, else the emittance."""
    return (TuningAim if machine.knobs else EmittanceAim)(machine, line)


def rehearsal_points(machine: ScanMachine, least: int) -> Iterator[list[MeasuredPoint]]:
    """Yield random points, one set for each padded array length of the scan."""
    rng, low, high = np.random.default_rng(0), *np.array([m.span for m in machine.magnets]).T
    for count in {padded_length(n): n for n in range(least, machine.points + 1)}.values():
        rows = low + rng.random((count, len(low))) * (high - low)
        yield [
            MeasuredPoint(
                dict(zip([m.name for m in machine.magnets], map(float, row), strict=True)),
                {
                    plane: 1e-4 * (1 + 0.3 * rng.random() + 0.02 * rng.random(3))
                    for plane in machine.screen.sizes or machine.screen.profiles
                },
                0.0,
            )
            for row in rows
        ]


def _middle(machine: ScanMachine) -> dict[str, float]:
    return {m.name: 0.5 * (m.span[0] + m.span[1]) for m in machine.magnets}


@dataclass
class EmittanceAim:
    """Measure the emittance to a relative error, and test the line of the file.

    ``checks`` counts the points that were measured beyond the goal to test wrong lines.
    """

    machine: ScanMachine
    line: Beamline
    checks: int = 0

    def fit(self, points: Sequence[MeasuredPoint]) -> EmittanceFit | None:
        """As `Aim.fit`."""
        return fit_of(points, self.machine, self.line)

    def next(
        self, points: Sequence[MeasuredPoint], fit: EmittanceFit | None,
        barred: Sequence[Mapping[str, float]], before: Mapping[str, float],
    ) -> Next | str:  # fmt: skip
        """As `Aim.next`: stop at the goal, with every magnet moved and wrong lines tested.

        The first settings cover the range of the first magnet; the following ones are the most
        informative ones of `beamfit.emittance.design`. Magnets that fewer than three points moved
        come first, because only they can show a wrong line. Without a fit, the middle of the
        largest gap is chosen.
        """
        machine, full = self.machine, len(points) >= self.machine.points
        if not sharp(fit, points, machine.goal) or self.barely_moved(points):
            every = f"all {machine.points} points are measured"
            return every if full else self._next(points, fit, barred, before)
        if not full and self.checks < MAX_CHECKS and (one := self.line_test(points, fit, before)):
            self.checks += 1
            return one
        return f"the goal of {100 * machine.goal:.3g} % is reached"

    def _next(
        self, points: Sequence[MeasuredPoint], fit: EmittanceFit | None,
        barred: Sequence[Mapping[str, float]], before: Mapping[str, float],
    ) -> Next | str:  # fmt: skip
        machine = self.machine
        limits = {m.name: limits_within(m.name, *m.span, barred, before) for m in machine.magnets}
        first = machine.magnets[0]
        low, high = limits[first.name]

        def chosen(settings: Mapping[str, float], why: str) -> Next:
            return Next(clip_settings(dict(before) | dict(settings), limits), why)

        begin = first_settings(machine)[len(points) + len(barred) :]
        if begin and low <= begin[0] <= high:
            return chosen({first.name: begin[0]}, "first settings")
        if fit is not None:
            new = {name: limits[name] for name in self.barely_moved(points)}
            aim = "D" if new else "emittance"  # a new magnet is moved whatever it gains
            steps, stop = best_steps(fit, adviser_of(fit), new or limits, aim)
            if steps:
                return chosen(steps[0].candidate.settings, "most informative")
            if len(points) >= MIN_POINTS:
                return stop.removeprefix("Stop: ").rstrip(".")
        gaps = np.sort([low, high, *(p.settings[first.name] for p in points)])
        place = int(np.argmax(np.diff(gaps)))
        middle = 0.5 * float(gaps[place] + gaps[place + 1])
        return chosen({first.name: middle}, "the largest gap")

    def barely_moved(self, points: Sequence[MeasuredPoint]) -> list[str]:
        """Return the magnets that fewer than three points have moved."""

        def moved(magnet: Magnet) -> int:
            settings = [p.settings[magnet.name] for p in points]
            typical = float(np.median(settings))
            return sum(abs(value - typical) > 2 * magnet.tolerance for value in settings)

        return [m.name for m in self.machine.magnets[1:] if moved(m) < MIN_POINTS_PER_MAGNET]

    @cached_property
    def wrong_lines(self) -> list[WrongLine]:
        """Lines with the drifts between two scanned magnets a third longer or shorter."""
        line = self.line
        supplies, names = dict(line.supplies), [e.name for e in line.elements]
        placed = sorted(
            (names.index(supplies.get(m.name, (m.name,))[0]), m.name) for m in self.machine.magnets
        )
        found = []
        for (first, one), (last, other) in pairwise(placed):
            between = [
                isinstance(e, Drift) and first < i < last for i, e in enumerate(line.elements)
            ]
            for factor in WRONG_LENGTHS if any(between) else ():
                elements = tuple(
                    replace(e, length=factor * e.length) if longer else e
                    for e, longer in zip(line.elements, between, strict=True)
                )
                words = f"the drift from {one} to {other} times {factor:.3g}"
                found.append(WrongLine(words, replace(line, elements=elements), (one, other)))
        return found

    def line_test(
        self, points: Sequence[MeasuredPoint], fit: EmittanceFit, before: Mapping[str, float]
    ) -> Next | None:
        """Choose the setting at which a wrong line differs most from the right one.

        None if no wrong line fits the sizes equally well and would show at some setting.
        """
        machine, best, most = self.machine, None, MAX_CHI2_INCREASE
        shots = [s for p in points for s in p.shots.values() if s.size > 1]
        share = np.median([s.std(ddof=1) / s.mean() / s.size**0.5 for s in shots]) if shots else 0.0
        for wrong in self.wrong_lines if share > 0.0 else ():
            other = fit_of(points, machine, wrong.line)
            if other is None or misfit(other) > misfit(fit) + MAX_CHI2_INCREASE:
                continue
            limits = {m.name: m.span for m in machine.magnets if m.name in wrong.magnets}
            levels = (np.linspace(*ends, GRID_LEVELS) for ends in limits.values())
            grid = np.array([*product(*levels)]).T
            settings = dict(before) | dict(zip(limits, grid, strict=True))
            effects = (_size_differences(fit, other, p.plane, settings, points) for p in fit.planes)
            effect = sum(effects)
            if (gain := effect.max() / share**2) > most:
                at = dict(zip(limits, grid[:, effect.argmax()].tolist(), strict=True))
                best, most = Next(dict(before) | at, f"where {wrong.words} would show"), gain
        return best

    def doubt(self, points: Sequence[MeasuredPoint], fit: EmittanceFit | None) -> str:
        """As `Aim.doubt`: the sizes deviate from the line, or another line fits clearly better."""
        said = doubt(fit, points)
        for wrong in self.wrong_lines if self.checks and not said else ():
            other = fit_of(points, self.machine, wrong.line)
            if other is not None and misfit(other) + MAX_CHI2_INCREASE < misfit(fit):
                better = f"χ² {misfit(other):.0f} in the place of {misfit(fit):.0f}"
                return f"The sizes follow a line with {wrong.words} better ({better}): is it right?"
        return said

    def warm(self) -> None:
        """As `Aim.warm`."""
        middle = _middle(self.machine)
        for points in rehearsal_points(self.machine, MIN_POINTS - 1):
            fit = self.fit(points)
            self._next(points, fit, (), middle)
            for plane in fit.planes if fit is not None and self.wrong_lines else ():
                many = {name: np.full(GRID_LEVELS**2, value) for name, value in middle.items()}
                fit.predict(many, plane.plane)


class WrongLine(NamedTuple):
    """Line with one changed distance: its description, and the magnets at the ends."""

    words: str
    line: Beamline
    magnets: tuple[str, str]


def fit_of(
    points: Sequence[MeasuredPoint], machine: ScanMachine, line: Beamline
) -> EmittanceFit | None:
    """Fit the points; return None if they are not a scan yet."""
    try:
        return fit_emittance(scan_of(points, machine), line)
    except InputError:
        return None


def first_settings(machine: ScanMachine) -> tuple[float, ...]:
    """Return the first settings: of the machine file, or over the range of the first magnet."""
    low, high = machine.magnets[0].span
    return machine.first or tuple(low + p * (high - low) for p in FIRST_FRACTIONS)


def sharp(fit: EmittanceFit | None, points: Sequence[MeasuredPoint], goal: float) -> bool:
    """Return True if all emittances are `converged` with a relative error below the goal.

    Parameters
    ----------
    fit : EmittanceFit or None
        Fit to the points.
    points : sequence of MeasuredPoint
        Fewer than six are never enough.
    goal : float
        Relative error.
    """
    if fit is None or len(points) < MIN_POINTS:
        return False
    return all(
        p.status is Status.converged
        and p.emittance.error is not None
        and p.emittance.error <= goal * p.emittance.value
        for p in fit.planes
    )


def doubt(fit: EmittanceFit | None, points: Sequence[MeasuredPoint]) -> str:
    """Describe sizes that deviate from the line by far more than their shots scatter; else "".

    The errors of the fit include such deviations as a scatter of settings, which real magnets have.
    A wrong line looks the same, and no error covers it. The scatter is that of all shots relative
    to their size, because a fit may treat one of every three shots as bad and underestimate the
    scatter of the others.
    """
    planes = [p for p in (fit.planes if fit else ()) if p.chi2 is not None]
    off = within = 0.0
    dof, freedom = sum(p.dof for p in planes), 0
    for plane in planes:
        for point, model in zip(points, plane.points.model, strict=True):
            shots = point.shots[plane.plane] / model
            off += shots.size * (shots.mean() - 1.0) ** 2
            within += shots.size * shots.var()
            freedom += shots.size - 1
    chi2 = off * freedom / within if within > 0.0 else 0.0
    chance = chi2_probability(chi2, dof, max(freedom, 1))
    if chance is None or chance >= POOR_FIT:
        return ""
    found = f"χ² {chi2:.0f} with {dof} degrees of freedom"
    return f"The sizes miss this line by more than their shots scatter ({found}): is it right?"


def misfit(fit: EmittanceFit) -> float:
    """Return the χ² of all planes from the scatter of the shots."""
    return sum(p.chi2 for p in fit.planes if p.chi2 is not None)


def _size_differences(
    fit: EmittanceFit, other: EmittanceFit, plane: str, settings: Mapping,
    points: Sequence[MeasuredPoint],
) -> np.ndarray:  # fmt: skip
    """Return squared differences of ln(predicted size); 0 far outside the measured sizes."""
    one, two = (each.predict(settings, plane).size for each in (fit, other))
    sizes = [p.shots[plane].mean() for p in points]
    measurable = (0.5 * min(sizes) < one) & (one < 2.0 * max(sizes))
    return np.where(measurable, np.log(one / two) ** 2, 0.0)


@dataclass
class TuningAim:
    """Find the knob setting of the lowest emittance, to a required distance from the minimum."""

    machine: ScanMachine
    line: Beamline

    def fit(self, points: Sequence[MeasuredPoint]) -> TuningFit | None:
        """As `Aim.fit`."""
        machine = self.machine
        limits = {m.name: m.span for m in machine.magnets if m.name in machine.knobs}
        if len(points) < ROWS_PER_KNOB * len(limits):
            return None
        try:
            return fit_tuning(
                scan_of(points, machine), self.line, limits,
                within=machine.goal, room=machine.points,
            )  # fmt: skip
        except InputError:
            return None

    def next(
        self, points: Sequence[MeasuredPoint], fit: TuningFit | None,
        barred: Sequence[Mapping[str, float]], before: Mapping[str, float],
    ) -> Next | str:  # fmt: skip
        """As `Aim.next`: four rows per knob over the limits, then the most informative ones."""
        machine = self.machine
        if fit is not None and fit.done:
            return f"the best setting is within {100 * machine.goal:.3g} % of the minimum"
        if len(points) >= machine.points:
            return f"all {machine.points} points are measured"
        limits = {m.name: limits_within(m.name, *m.span, barred, before) for m in machine.magnets}
        if fit is not None:
            quadrupoles = {n: ends for n, ends in limits.items() if n not in machine.knobs}
            row = next_row(fit, quadrupoles).settings
            settings = clip_settings(dict(before) | row, limits)
            return Next(settings, "most informative about the minimum")
        at = settings_within(len(limits), POWER)[(len(points) + len(barred)) % 2**POWER]
        low, high = np.array(list(limits.values())).T
        values = 0.5 * (low + high + at * (high - low))
        row = dict(zip(limits, map(float, values), strict=True))
        return Next(clip_settings(row, limits), "rows spread over the limits")

    def doubt(self, points: Sequence[MeasuredPoint], fit: TuningFit | None) -> str:
        """As `Aim.doubt`: always "", since a tuning fit itself reports sizes of no beam."""
        return ""

    def warm(self) -> None:
        """As `Aim.warm`."""
        for points in rehearsal_points(self.machine, self.machine.points):  # one length
            self.next(points[:-1], self.fit(points), (), _middle(self.machine))
