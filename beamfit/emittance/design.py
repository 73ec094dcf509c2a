"""Plan of the next measurements: the best in turn, and which kind would identify a scenario."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from beamfit.answer import Table, answer, json_of
from beamfit.emittance.advice import (
    Adviser,
    Candidate,
    adviser_of,
    determined_by,
    settings_in_words,
)
from beamfit.emittance.calibration import NumberKind, numbers_of_magnets
from beamfit.emittance.fit import EmittanceFit
from beamfit.emittance.model import spoken
from beamfit.emittance.statement import PreparedScan, varied_magnets
from beamfit.emittance.targets import check_limits
from beamfit.errors import InputError, Status, expect
from beamfit.greybox.design import Information, greedy
from beamfit.optics.beamline import Beamline
from beamfit.optics.elements import Drift, Screen

# Other energies to consider where none is named: what a linac can usually do.
USUAL_ENERGIES = (0.8, 1.25)
CRITERIA = ("emittance", "D")
# A further point that sharpens the emittance by less than this is not worth its shift time.
LEAST_GAIN = 0.01
PERHAPS = "In brackets: for the beam as it is best known, which the data do not determine."
TIE = " Tie the network to first principles (--anchor first-principles=2%)."


def _check_settable(fit: EmittanceFit, limits: Mapping[str, tuple[float, float]]) -> None:
    """Refuse a scan for which no settings can be told, and magnets that cannot be set."""
    scan, varied = fit.seen.scan, varied_magnets(fit.seen.scan)
    if scan.transfer:
        found = "advice on rows with matrices of their own"
        raise scan.unusable(found, "a lattice in which other settings can be tried")
    if not limits and not varied:
        found = "advice on a scan that moved no magnet"
        raise scan.unusable(found, "limits of a magnet, such as --vary Q1=LOW:HIGH")
    check_limits(fit.seen.scanned, limits)
    for name in () if fit.statement.whole_map else limits:
        if name not in varied:
            raise InputError(f"limits of '{name}', which was not scanned", "a scanned magnet")


def _screens(fit: EmittanceFit) -> tuple[str, ...]:
    """Screens to measure at: all of the line, downstream of a scanned magnet."""
    measured = fit.seen.rows.places
    if not fit.statement.whole_map:  # another screen has another network
        return measured
    names, magnets = _along(fit.seen)
    later = [s for s in fit.seen.scanned.screens if names.index(s) > min(magnets)]
    return tuple(dict.fromkeys((*measured, *later)))


def _along(seen: PreparedScan) -> tuple[list[str], list[int]]:
    """Names along the line, and where in them the scanned magnets stand."""
    names = [e.name for e in seen.scanned.elements]
    magnets = [m for name in varied_magnets(seen.scan) for m in seen.scanned.members(name)]
    return names, [names.index(m) for m in magnets] or [-1]


def further_options(
    fit: EmittanceFit, adviser: Adviser, energies: tuple[float, ...]
) -> Iterator[Prospect]:
    """Kinds of measurement that might identify a scenario.

    A single size at every other screen, the same scan at it; the same scan at other energies;
    where the line has no second screen, at screens one could put into its drifts; and a 2 %
    measurement of each slope, as from a field map of the magnet.

    Parameters
    ----------
    fit : EmittanceFit
        What is measured already.
    adviser : Adviser
        Of it.
    energies : tuple of float
        Energies to consider, MeV; 20 % below and 25 % above if empty.

    Yields
    ------
    Prospect
    """

    def prospect(words: str, rows: np.ndarray) -> Prospect:
        after = adviser.information.with_rows(rows.reshape(-1, rows.shape[-1]))
        known = adviser.errors(after), determined_by(fit.seen, after)
        return Prospect(words, *known, float(after.share.max()))

    seen, base = fit.seen, adviser.information
    table = {n: np.asarray(v) for n, v in seen.scan.settings.items()}
    count = len(seen.scan)
    energy = np.full(count, seen.energy) if seen.scan.energy is None else seen.scan.energy
    if fit.statement.whole_map:
        for line, screen, words in _other_screens(fit):
            rows = adviser.predict(line, table, screen, energy).rows
            best = min(range(count), key=lambda i: _worst(base.with_rows(rows[:, i])))
            at = settings_in_words(seen, {n: float(v[best]) for n, v in table.items()})
            yield prospect(f"one size on {words} ({at})", rows[:, best])
            yield prospect(f"the same scan on {words}", rows)
        screen = (seen.scan.screen or seen.rows.places)[-1]
        for each in energies or tuple(seen.energy * f for f in USUAL_ENERGIES):
            rows = adviser.predict(seen.scanned, table, screen, np.full(count, each)).rows
            yield prospect(f"the same scan at {each:.4g} MeV", rows)
    slopes = {
        name: abs(number.value)
        for name, number in numbers_of_magnets(seen.scanned).items()
        if number.kind is NumberKind.slope
    }
    for i, path in enumerate(fit.solved.problem.names if fit.solved else ()):
        if (name := spoken(path)) in slopes:
            row = np.zeros(len(base.lower))
            row[i] = 1.0 / (0.02 * slopes[name])
            yield prospect(f"a prior of 2 % on {name}", row)


def _worst(after: Information) -> float:
    """Relative error that counts bounds as nothing: large while they decide."""
    return float(after.relative_error.max() / max(1.0 - after.share.max(), 1e-6))


def _other_screens(fit: EmittanceFit) -> list[tuple[Beamline, str, str]]:
    """Screens that were not used, or else places for one in the drifts after the magnets."""
    line = fit.seen.scanned
    unused = [s for s in _screens(fit) if s not in fit.seen.rows.places]
    if unused:
        return [(line, s, f"screen {s}") for s in unused]
    _, magnets = _along(fit.seen)
    found = []
    for i, element in enumerate(line.elements):
        if i > max(magnets) and isinstance(element, Drift) and element.length > 0.3:
            half = replace(element, length=0.5 * element.length)
            elements = (*line.elements[:i], half, Screen("NEW"), half, *line.elements[i + 1 :])
            words = f"a new screen in the middle of {element.name}"
            found.append((replace(line, elements=elements), "NEW", words))
    return found


class Prospect(NamedTuple):
    """A measurement, single or of some kind, and what it would make of the emittance.

    ``candidate`` is that of a single one.
    """

    words: str
    relative_error: dict[str, float]
    determined: dict[str, bool]
    share_on_bounds: float = 0.0
    candidate: Candidate | None = None

    @property
    def identified(self) -> bool:
        """True if every plane is determined then."""
        return all(self.determined.values())

    def to_json(self) -> dict[str, Any]:
        """Give an entry of ``next`` or ``options`` in the JSON contract."""
        found = {"relative_error": self.relative_error, "determined": self.determined}
        found |= {"identified": self.identified}
        if self.candidate is not None:
            return self.candidate._asdict() | found
        return found | {"words": self.words, "share_on_bounds": self.share_on_bounds}


@answer
@dataclass(frozen=True)
class Advice:
    """Advice on the next measurements, and when to stop.

    Attributes
    ----------
    scenario, criterion : str
        For which unknowns, and what is made small.
    determined : dict of str to bool
        Whether the data so far determine the emittance of each plane.
    now : dict of str to float
        Relative emittance error of each plane so far; what bounds decide is not counted.
    steps : tuple of Prospect
        The best further measurement, then the best after that, ...
    stop : str
        Why the list ends there.
    options : tuple of Prospect
        For a scenario that is not identified: which kind of measurement would identify it.
    tie : str
        What else could, in words.
    """

    scenario: str
    criterion: str
    determined: dict[str, bool]
    now: dict[str, float]
    steps: tuple[Prospect, ...]
    stop: str
    options: tuple[Prospect, ...]
    tie: str = ""

    @property
    def identified(self) -> bool:
        """True if the data so far determine the emittance of every plane."""
        return all(self.determined.values())

    @property
    def headline(self) -> str:
        """The advice in a line."""
        return self.message

    @property
    def message(self) -> str:
        """The advice in two sentences."""
        known = [plane for plane, sure in self.determined.items() if sure]
        left = [plane for plane in self.determined if plane not in known]
        first = f"The data determine the emittance in {known[0]}, not in {left[0]}." if (
            known and left
        ) else f"The data {'do not ' * bool(left)}determine the emittance."  # fmt: skip
        good = [o for o in self.options if o.identified]
        if not self.identified and any(step.identified for step in self.steps):
            return f"{first} Measure next at {self.steps[0].words}, then ask again."
        if not self.identified and good:
            best = min(good, key=lambda o: max(o.relative_error.values()))
            return f"{first} It would be determined with {best.words}."
        if not self.identified:
            return f"{first} None of the measurements considered would change that.{self.tie}"
        if not self.steps:
            return f"{first} {self.stop}"
        return f"{first} Measure next at {self.steps[0].words}. {self.stop}"

    @property
    def status(self) -> Status:
        """``converged`` where the data determine the emittance, ``unidentified`` where not."""
        return Status.converged if self.identified else Status.unidentified

    def to_json(self) -> dict[str, Any]:
        """Give the entry of ``results`` of the JSON contract."""
        found = {
            "scenario": self.scenario,
            "criterion": self.criterion,
            "status": self.status,
            "message": self.message,
            "relative_error": self.now,
            "next": self.steps,
            "determined": self.determined,
            "stop": self.stop,
            "options": self.options,
        }
        return json_of(found)

    def tables(self) -> tuple[Table, ...]:
        """Lay out the errors after each measurement, and what would identify an open scenario."""
        rows = [["what is measured", *_cells(self.now, self.determined)]]
        if self.steps and not self.steps[-1].identified:
            words = f"{len(self.steps)} more points of the scan, at the best settings"
            last = self.steps[-1]
            rows.append([words, *_cells(last.relative_error, last.determined)])
        else:
            for number, step in enumerate(self.steps, 1):
                cells = _cells(step.relative_error, step.determined, self.determined)
                rows.append([f"{number}. {step.words}", *cells])
        note = "" if self.identified or not self.steps else PERHAPS
        steps = Table("", ["after", *self.now], rows, note, numeric=True)
        header = ["What would identify it", *(f"error {plane}" for plane in self.now), "identified"]
        rows = [
            [o.words, *_cells(o.relative_error, o.determined), "yes" if o.identified else "no"]
            for o in self.options
        ]
        helps = any(o.identified for o in self.options)
        return (steps, Table("", header, rows)) if helps else (steps,)


def _cells(
    error: Mapping[str, float], known: Mapping[str, bool], sure: Mapping[str, bool] | None = None
) -> list[str]:
    """Errors of each plane; in brackets where only a further measurement would make it known."""
    cells = {}
    for plane, e in error.items():
        said = "{:.2f} %" if sure is None or sure[plane] else "({:.0f} %)"
        cells[plane] = said.format(100 * e) if known[plane] else "not determined"
    return list(cells.values())


def plan_measurements(
    fit: EmittanceFit,
    *,
    limits: Mapping[str, tuple[float, float]] | None = None,
    criterion: str = "emittance",
    goal: float | None = None,
    count: int = 5,
    energies: tuple[float, ...] = (),
) -> Advice:
    """Choose further measurements one after the other, each the best given those before it.

    Parameters
    ----------
    fit : EmittanceFit
        What is measured already, in any scenario.
    limits : mapping of str to (float, float), optional
        Machine limits of the magnets that may be set; the scanned magnets over and by half their
        range beyond what was scanned if None.
    criterion : {"emittance", "D"}
        Make the emittance's error small, or the volume of the error ellipsoid of everything that
        is asked for (the determinant of its covariance).
    goal : float, optional
        Relative emittance error at which to stop.
    count : int
        Most measurements.
    energies : tuple of float, optional
        Further total energies, MeV, the beam could be measured at.

    Returns
    -------
    Advice

    Raises
    ------
    InputError
        If limits name no magnet of the line, or an option is unknown.

    Notes
    -----
    One more row g (derivatives of the size by the free numbers, over its error) turns the
    covariance C into C - C gᵀ g C/(1 + g C gᵀ). The choice is greedy; D-optimality of a set is
    at least (1 - 1/e) of the best set's gain (submodularity of the log-determinant).

    Examples
    --------
    >>> import numpy as np
    >>> from beamfit.optics.beamline import Beamline
    >>> from beamfit.optics.elements import Drift, Quadrupole, Screen
    >>> from beamfit.emittance.fit import fit_emittance
    >>> from beamfit.emittance.scan import QuadScan
    >>> line = Beamline((Quadrupole("Q", 0.1), Drift("D", 2.0), Screen("S")), 135.0)
    >>> sizes = np.array([3.4e-4, 1.9e-4, 0.9e-4, 1.9e-4, 3.4e-4])
    >>> scan = QuadScan({"Q": [-1.0, 1.5, 4.0, 6.5, 9.0]}, {"Q": "k1"}, {"x": sizes},
    ...                 {"x": 0.02 * sizes})
    >>> advice = plan_measurements(fit_emittance(scan, line), count=2)
    >>> len(advice.steps), advice.steps[1].relative_error["x"] < advice.now["x"]
    (2, True)
    """
    expect(fit, EmittanceFit, "beamfit.fit_emittance(scan, line)")
    if criterion not in CRITERIA:
        raise InputError(f"criterion '{criterion}'", "emittance or D")
    if count < 1:
        raise InputError(f"a count of {count}", "at least one measurement")
    if goal is not None and not goal > 0:
        raise InputError(f"a goal of {goal}", "a relative error above 0")
    _check_energies(energies, float(fit.seen.line.mass))
    adviser = adviser_of(fit)
    steps, stop = best_steps(fit, adviser, limits, criterion, goal, count, energies)
    # What is known so far is what the posterior of the fit says.
    now = {p.plane: p.identifiability.determined for p in fit.planes}
    options = () if all(now.values()) else tuple(further_options(fit, adviser, energies))
    errors, tie = adviser.errors(adviser.information), TIE if fit.statement.network else ""
    return Advice(fit.statement.name, criterion, now, errors, steps, stop, options, tie)


def best_steps(
    fit: EmittanceFit,
    adviser: Adviser,
    limits: Mapping[str, tuple[float, float]] | None,
    criterion: str = "emittance",
    goal: float | None = None,
    count: int = 1,
    energies: tuple[float, ...] = (),
) -> tuple[tuple[Prospect, ...], str]:
    """The best measurement, the best after that, and why the list ends."""
    _check_settable(fit, limits or {})
    candidates, rows = adviser.candidates(limits, _screens(fit), energies)
    aim = "" if goal is None else f"goal of {100 * goal:.3g} %"
    now, steps = adviser.information, []
    sure = adviser.determined(now, ())

    def sharp() -> bool:
        return goal is not None and all(sure.values()) and now.relative_error.max() <= goal

    for choice in greedy(now, rows, criterion == "D"):
        if len(steps) == count:
            break
        if sharp():
            return tuple(steps), f"Stop: the {aim} is reached."
        if all(sure.values()) and criterion == "emittance" and choice.gain < LEAST_GAIN:
            return tuple(steps), (
                "Stop: the best further point sharpens the emittance by "
                f"{100 * max(choice.gain, 0):.1g} %; repeat the scan instead, or improve the size "
                "measurement."
            )
        now, candidate = choice.known, candidates[choice.index]
        sure = adviser.determined(now, [*(s.candidate for s in steps), candidate])
        steps.append(Prospect(candidate.words, adviser.errors(now), sure, candidate=candidate))
    if sharp():
        return tuple(steps), f"Stop after these: the {aim} is reached."
    if goal is not None and all(sure.values()):
        return tuple(steps), f"The {aim} needs more than these {count}."
    return tuple(steps), f"Listed are the best {count}."


def _check_energies(energies: tuple[float, ...], rest: float) -> None:
    for energy in energies:
        if not rest < energy <= 1e7:
            expected = f"a total energy between {rest:.6g} MeV and 10 TeV"
            raise InputError(f"an energy of {energy:g} MeV", expected)
