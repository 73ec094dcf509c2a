"""Aims of a scan: what is fitted to its points, the setting to measure next, and when to stop."""

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
from beamfit.live.points import MeasuredPoint, clipped, limits_within, scan_of
from beamfit.optics.beamline import Beamline
from beamfit.optics.elements import Drift
from beamfit.statistics import POOR_FIT, chi2_probability
from beamfit.tuning.fit import TuningFit, fit_tuning
from beamfit.tuning.minimum import next_row, settings_within

# Where a scan begins, in parts of the range of its first magnet.
BEGIN = (0.1, 0.37, 0.63, 0.9)
# Points that each further magnet is moved for at least: a beam has three numbers, so that each
# magnet by itself tells all of it. Where they disagree the line is wrong.
FEW = 3
# Points before which a goal is not taken for reached: three numbers meet five sizes too easily.
FEWEST = 6
# Settings of each of two magnets among which that is searched where a wrong line shows most.
LEVELS = 7
# Lengths over that of the file: what a distance is typed wrong by, or a magnet left out, is seldom
# less, and a smaller share hardly moves the emittance.
STRETCHED = (4 / 3, 2 / 3)
# χ² by which a line meets the sizes worse and is out: three standard deviations.
OUT = 9.0
# Points beyond the goal that a scan takes to see a wrong line: one for each and one more.
MOST = 3
# Rows for each knob that fill the limits before a fit chooses: a beam has three numbers.
ROWS = 4
# A power of two above the rows that begin a tuning of six knobs.
POWER = 6


class Next(NamedTuple):
    """A setting to measure, and why it is chosen."""

    settings: dict[str, float]
    why: str


class Aim(Protocol):
    """The purpose of a live scan: what it fits, measures next and stops at."""

    def fit(self, points: Sequence[MeasuredPoint]) -> Any:
        """Fit the points; None as long as they are too few."""

    def next(
        self, points: Sequence[MeasuredPoint], fit: Any, barred: Sequence[Mapping[str, float]],
        before: Mapping[str, float],
    ) -> Next | str:  # fmt: skip
        """Choose the next setting, or say why there should be none.

        Parameters
        ----------
        points : sequence of MeasuredPoint
            What is measured.
        fit : EmittanceFit, TuningFit or None
            To the points.
        barred : sequence of mapping
            Settings at which nothing could be measured; nothing beyond them is chosen.
        before : mapping of str to float
            Settings before the scan.
        """

    def doubt(self, points: Sequence[MeasuredPoint], fit: Any) -> str:
        """Why the line may be wrong, in words; "" where the sizes follow it."""

    def warm(self) -> None:
        """Have everything compiled that the scan needs, so that no magnet waits for it."""


def aim_of(machine: ScanMachine, line: Beamline) -> Aim:
    """The aim of a machine: with knobs the lowest emittance, else the emittance itself."""
    return (TuningAim if machine.knobs else EmittanceAim)(machine, line)


def rehearsed(machine: ScanMachine, least: int) -> Iterator[list[MeasuredPoint]]:
    """Points at random, one number of them of each length that arrays are padded to."""
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
    """The emittance to a relative error, and to see whether the line is the file's.

    ``checks`` counts the points that were measured beyond the goal to see a wrong line.
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
        """As `Aim.next`: the goal, with every magnet moved, and nothing that shows the line wrong.

        First settings over the range of the first magnet; then those that tell most, by
        `beamfit.emittance.design`: of magnets that fewer than three points moved where there are
        some, since a wrong line shows there alone. The middle of the largest gap where nothing can
        be fitted.
        """
        machine, full = self.machine, len(points) >= self.machine.points
        if not sharp(fit, points, machine.goal) or self.fresh(points):
            every = f"all {machine.points} points are measured"
            return every if full else self._next(points, fit, barred, before)
        if not full and self.checks < MOST and (one := self.telling(points, fit, before)):
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
            return Next(clipped(dict(before) | dict(settings), limits), why)

        begin = first_settings(machine)[len(points) + len(barred) :]
        if begin and low <= begin[0] <= high:
            return chosen({first.name: begin[0]}, "first settings")
        if fit is not None:
            new = {name: limits[name] for name in self.fresh(points)}
            aim = "D" if new else "emittance"  # of a new magnet whatever it gains
            steps, stop = best_steps(fit, adviser_of(fit), new or limits, aim)
            if steps:
                return chosen(steps[0].candidate.settings, "where it tells most")
            if len(points) >= FEWEST:
                return stop.removeprefix("Stop: ").rstrip(".")
        gaps = np.sort([low, high, *(p.settings[first.name] for p in points)])
        place = int(np.argmax(np.diff(gaps)))
        middle = 0.5 * float(gaps[place] + gaps[place + 1])
        return chosen({first.name: middle}, "the largest gap")

    def fresh(self, points: Sequence[MeasuredPoint]) -> list[str]:
        """Magnets that fewer than three points have moved."""

        def moved(magnet: Magnet) -> int:
            settings = [p.settings[magnet.name] for p in points]
            usual = float(np.median(settings))
            return sum(abs(value - usual) > 2 * magnet.tolerance for value in settings)

        return [m.name for m in self.machine.magnets[1:] if moved(m) < FEW]

    @cached_property
    def wrong(self) -> list[WrongLine]:
        """The line with the drifts between two scanned magnets a third longer or shorter."""
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
            for factor in STRETCHED if any(between) else ():
                elements = tuple(
                    replace(e, length=factor * e.length) if longer else e
                    for e, longer in zip(line.elements, between, strict=True)
                )
                words = f"the drift from {one} to {other} times {factor:.3g}"
                found.append(WrongLine(words, replace(line, elements=elements), (one, other)))
        return found

    def telling(
        self, points: Sequence[MeasuredPoint], fit: EmittanceFit, before: Mapping[str, float]
    ) -> Next | None:
        """Choose the setting at which some wrong line parts most from the right one.

        None where no line is left that meets the sizes as well and would show anywhere.
        """
        machine, best, most = self.machine, None, OUT
        shots = [s for p in points for s in p.shots.values() if s.size > 1]
        share = np.median([s.std(ddof=1) / s.mean() / s.size**0.5 for s in shots]) if shots else 0.0
        for wrong in self.wrong if share > 0.0 else ():
            other = fit_of(points, machine, wrong.line)
            if other is None or misfit(other) > misfit(fit) + OUT:
                continue
            limits = {m.name: m.span for m in machine.magnets if m.name in wrong.magnets}
            grid = np.array([*product(*(np.linspace(*ends, LEVELS) for ends in limits.values()))]).T
            settings = dict(before) | dict(zip(limits, grid, strict=True))
            apart = sum(_apart(fit, other, p.plane, settings, points) for p in fit.planes)
            if (gain := apart.max() / share**2) > most:
                at = dict(zip(limits, grid[:, apart.argmax()].tolist(), strict=True))
                best, most = Next(dict(before) | at, f"where {wrong.words} would show"), gain
        return best

    def doubt(self, points: Sequence[MeasuredPoint], fit: EmittanceFit | None) -> str:
        """As `Aim.doubt`: sizes that miss the line, or follow another one clearly better."""
        said = doubt(fit, points)
        for wrong in self.wrong if self.checks and not said else ():
            other = fit_of(points, self.machine, wrong.line)
            if other is not None and misfit(other) + OUT < misfit(fit):
                better = f"χ² {misfit(other):.0f} in the place of {misfit(fit):.0f}"
                return f"The sizes follow a line with {wrong.words} better ({better}): is it right?"
        return said

    def warm(self) -> None:
        """As `Aim.warm`."""
        middle = _middle(self.machine)
        for points in rehearsed(self.machine, FEWEST - 1):
            fit = self.fit(points)
            self._next(points, fit, (), middle)
            for plane in fit.planes if fit is not None and self.wrong else ():
                many = {name: np.full(LEVELS**2, value) for name, value in middle.items()}
                fit.predict(many, plane.plane)


class WrongLine(NamedTuple):
    """A line with one distance that is not the file's, in words, and the magnets at its ends."""

    words: str
    line: Beamline
    magnets: tuple[str, str]


def fit_of(
    points: Sequence[MeasuredPoint], machine: ScanMachine, line: Beamline
) -> EmittanceFit | None:
    """The fit to the points, None as long as they are no scan."""
    try:
        return fit_emittance(scan_of(points, machine), line)
    except InputError:
        return None


def first_settings(machine: ScanMachine) -> tuple[float, ...]:
    """First settings of a scan: as the machine file says, or over the range of its first magnet."""
    low, high = machine.magnets[0].span
    return machine.first or tuple(low + p * (high - low) for p in BEGIN)


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
    is wrong shows in the same way, and there no error holds. The scatter is that of all shots as a
    share of their size: a fit may take one of every three shots for a bad one, and find the others
    sharper than they are.
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
    """χ² of all planes by the scatter of the shots."""
    return sum(p.chi2 for p in fit.planes if p.chi2 is not None)


def _apart(
    fit: EmittanceFit, other: EmittanceFit, plane: str, settings: Mapping,
    points: Sequence[MeasuredPoint],
) -> np.ndarray:  # fmt: skip
    """Squared difference of the logarithms of predicted sizes; 0 beyond the sizes measured."""
    one, two = (each.predict(settings, plane).size for each in (fit, other))
    sizes = [p.shots[plane].mean() for p in points]
    seen = (0.5 * min(sizes) < one) & (one < 2.0 * max(sizes))
    return np.where(seen, np.log(one / two) ** 2, 0.0)


@dataclass
class TuningAim:
    """The setting of the knobs with the lowest emittance, as near to the minimum as is wanted."""

    machine: ScanMachine
    line: Beamline

    def fit(self, points: Sequence[MeasuredPoint]) -> TuningFit | None:
        """As `Aim.fit`."""
        machine = self.machine
        limits = {m.name: m.span for m in machine.magnets if m.name in machine.knobs}
        if len(points) < ROWS * len(limits):
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
        """As `Aim.next`: rows that fill the limits, four for each knob; then those that tell most
        of the minimum.
        """
        machine = self.machine
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

    def doubt(self, points: Sequence[MeasuredPoint], fit: TuningFit | None) -> str:
        """As `Aim.doubt`: a tuning fit says itself where the sizes are of no beam."""
        return ""

    def warm(self) -> None:
        """As `Aim.warm`."""
        for points in rehearsed(self.machine, self.machine.points):  # of one length, as its fits
            self.next(points[:-1], self.fit(points), (), _middle(self.machine))
