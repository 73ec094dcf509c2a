"""Plan of the next measurements, and kinds of measurement that would identify a scenario."""

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
    determined_planes,
    settings_in_words,
)
from beamfit.emittance.calibration import NumberKind, numbers_of_magnets
from beamfit.emittance.fit import EmittanceFit
from beamfit.emittance.model import user_name
from beamfit.emittance.statement import PreparedScan, varied_magnets
from beamfit.emittance.targets import check_limits
from beamfit.errors import InputError, Status, expect
from beamfit.greybox.design import Information, greedy
from beamfit.optics.beamline import Beamline
from beamfit.optics.elements import Drift, Screen

# Other energies to consider where none is given, as shares of the scan's: what a linac usually has.
USUAL_ENERGIES = (0.8, 1.25)
CRITERIA = ("emittance", "D")
# A further point that reduces the error of the emittance by less is not worth its beam time.
MIN_GAIN = 0.01
UNDETERMINED_NOTE = (
    "In brackets: for the beam as it is best known, which the data do not determine."
)
ANCHOR_ADVICE = " Tie the network to first principles (--anchor first-principles=2%)."


def _check_settable(fit: EmittanceFit, limits: Mapping[str, tuple[float, float]]) -> None:
    """Raise an error for scans that cannot be planned for, and for magnets that cannot be set."""
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
    """Screens for further sizes: all of the line downstream of a scanned magnet."""
    measured = fit.seen.rows.places
    if not fit.statement.whole_map:  # another screen has another network
        return measured
    names, magnets = _magnet_positions(fit.seen)
    later = [s for s in fit.seen.scanned.screens if names.index(s) > min(magnets)]
    return tuple(dict.fromkeys((*measured, *later)))


def _magnet_positions(prepared: PreparedScan) -> tuple[list[str], list[int]]:
    """Names of the elements along the line, and the indices of the scanned magnets."""
    names = [e.name for e in prepared.scanned.elements]
    magnets = [m for name in varied_magnets(prepared.scan) for m in prepared.scanned.members(name)]
    return names, [names.index(m) for m in magnets] or [-1]


def further_options(
    fit: EmittanceFit, adviser: Adviser, energies: tuple[float, ...]
) -> Iterator[Prospect]:
    """List kinds of measurement that may identify a scenario.

    These are a single size or the scan at every other screen, or at a new screen in a drift if the
    line has no other; the scan at other energies; and a 2 % measurement of each calibration slope,
    as from a field map of the magnet.

    Parameters
    ----------
    fit : EmittanceFit
        The measurements so far.
    adviser : Adviser
        The fit's adviser.
    energies : tuple of float
        Energies to consider, MeV; 20 % below and 25 % above the scan's if empty.

    Yields
    ------
    ------
    Prospect
    """

    def prospect(words: str, rows: np.ndarray) -> Prospect:
        after = adviser.information.with_rows(rows.reshape(-1, rows.shape[-1]))
        result = adviser.errors(after), determined_planes(fit.seen, after)
        return Prospect(words, *result, float(after.share.max()))

    prepared, information = fit.seen, adviser.information
    table = {n: np.asarray(v) for n, v in prepared.scan.settings.items()}
    count = len(prepared.scan)
    energy = (
        np.full(count, prepared.energy) if prepared.scan.energy is None else prepared.scan.energy
    )
    if fit.statement.whole_map:
        for line, screen, words in _other_screens(fit):
            rows = adviser.predict(line, table, screen, energy).rows
            best = min(
                range(count), key=lambda i: _largest_error(information.with_rows(rows[:, i]))
            )
            at = settings_in_words(prepared, {n: float(v[best]) for n, v in table.items()})
            yield prospect(f"one size on {words} ({at})", rows[:, best])
            yield prospect(f"the same scan on {words}", rows)
        screen = (prepared.scan.screen or prepared.rows.places)[-1]
        for other in energies or tuple(prepared.energy * f for f in USUAL_ENERGIES):
            rows = adviser.predict(prepared.scanned, table, screen, np.full(count, other)).rows
            yield prospect(f"the same scan at {other:.4g} MeV", rows)
    slopes = {
        name: abs(number.value)
        for name, number in numbers_of_magnets(prepared.scanned).items()
        if number.kind is NumberKind.slope
    }
    for i, path in enumerate(fit.solved.problem.names if fit.solved else ()):
        if (name := user_name(path)) in slopes:
            row = np.zeros(len(information.lower))
            row[i] = 1.0 / (0.02 * slopes[name])
            yield prospect(f"a prior of 2 % on {name}", row)


def _largest_error(after: Information) -> float:
    """Largest relative error, increased where bounds rather than data decide."""
    return float(after.relative_error.max() / max(1.0 - after.share.max(), 1e-6))


def _other_screens(fit: EmittanceFit) -> list[tuple[Beamline, str, str]]:
    """Unused screens, or else new ones in the drifts after the magnets."""
    line = fit.seen.scanned
    unused = [s for s in _screens(fit) if s not in fit.seen.rows.places]
    if unused:
        return [(line, s, f"screen {s}") for s in unused]
    _, magnets = _magnet_positions(fit.seen)
    found = []
    for i, element in enumerate(line.elements):
        if i > max(magnets) and isinstance(element, Drift) and element.length > 0.3:
            half = replace(element, length=0.5 * element.length)
            elements = (
                *line.elements[:i],
                half,
                Screen("NEW"),
                half,
                *line.elements[i + 1 :],
            )
            words = f"a new screen in the middle of {element.name}"
            found.append((replace(line, elements=elements), "NEW", words))
    return found


class Prospect(NamedTuple):
    """A further measurement, or a kind of it, and the emittance errors that it would leave.

    ``candidate`` is set for a single measurement.
    """

    words: str
    relative_error: dict[str, float]
    determined: dict[str, bool]
    share_on_bounds: float = 0.0
    candidate: Candidate | None = None

    @property
    def identified(self) -> bool:
        """True if the measurement would determine every plane."""
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
        Scenario of the fit, and quantity to minimise.
    determined : dict of str to bool
        Whether the data so far determine the emittance of each plane.
    now : dict of str to float
        Relative emittance error of each plane so far; bounds are not counted as information.
    steps : tuple of Prospect
        Best further measurement, best one after that, and so on.
    stop : str
        Reason why the list ends.
    options : tuple of Prospect
        For a scenario that is not identified: kinds of measurement that may identify it.
    tie : str
        Other means to identify it, in words.
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
        """``converged`` if the data determine the emittance, otherwise ``unidentified``."""
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
        """Table of the errors after each measurement, and of options to identify a scenario."""
        rows = [["what is measured", *_cells(self.now, self.determined)]]
        if self.steps and not self.steps[-1].identified:
            words = f"{len(self.steps)} more points of the scan, at the best settings"
            last = self.steps[-1]
            rows.append([words, *_cells(last.relative_error, last.determined)])
        else:
            for number, step in enumerate(self.steps, 1):
                cells = _cells(step.relative_error, step.determined, self.determined)
                rows.append([f"{number}. {step.words}", *cells])
        note = "" if self.identified or not self.steps else UNDETERMINED_NOTE
        steps = Table("", ["after", *self.now], rows, note, numeric=True)
        header = ["What would identify it", *(f"error {plane}" for plane in self.now), "identified"]
        rows = [
            [o.words, *_cells(o.relative_error, o.determined), "yes" if o.identified else "no"]
            for o in self.options
        ]
        helps = any(o.identified for o in self.options)
        return (steps, Table("", header, rows)) if helps else (steps,)


def _cells(
    error: Mapping[str, float],
    known: Mapping[str, bool],
    determined: Mapping[str, bool] | None = None,
) -> list[str]:
    """Errors of each plane, in brackets where only a further measurement would determine it."""
    cells = {}
    for plane, e in error.items():
        style = "{:.2f} %" if determined is None or determined[plane] else "({:.0f} %)"
        cells[plane] = style.format(100 * e) if known[plane] else "not determined"
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
    """Choose further measurements one after another, each the best given those before it.

    Parameters
    ----------
    fit : EmittanceFit
        The measurements so far, in any scenario.
    limits : mapping of str to (float, float), optional
        Machine limits of the magnets that may be set; the scanned magnets over their range and half
        of it beyond either end if None.
    criterion : {"emittance", "D"}
        Minimise the error of the emittance, or the volume of the error ellipsoid of all requested
        quantities (the determinant of their covariance).
    goal : float, optional
        Relative emittance error at which to stop.
    count : int
        Largest number of measurements.
    energies : tuple of float, optional
        Further total energies, MeV, at which the beam could be measured.

    Returns
    -------
    Advice

    Raises
    ------
    InputError
        If limits name no magnet of the line, or an option is unknown.

    Notes
    -----
    One more row g (derivatives of the size with respect to the free parameters, over its error)
    changes the covariance C to C - C gᵀ g C/(1 + g C gᵀ). The choice is greedy; its D-optimality
    is at least (1 - 1/e) of the best set's gain (submodularity of the log-determinant).

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
    # The posterior of the fit states what is determined so far.
    now = {p.plane: p.identifiability.determined for p in fit.planes}
    options = () if all(now.values()) else tuple(further_options(fit, adviser, energies))
    errors, tie = (
        adviser.errors(adviser.information),
        ANCHOR_ADVICE if fit.statement.network else "",
    )
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
    """The best measurement, the best after that and so on, and the reason why the list ends."""
    _check_settable(fit, limits or {})
    candidates, rows = adviser.candidates(limits, _screens(fit), energies)
    goal_words = "" if goal is None else f"goal of {100 * goal:.3g} %"
    now, steps = adviser.information, []
    determined = adviser.determined(now, ())

    def goal_reached() -> bool:
        return goal is not None and all(determined.values()) and now.relative_error.max() <= goal

    for choice in greedy(now, rows, criterion == "D"):
        if len(steps) == count:
            break
        if goal_reached():
            return tuple(steps), f"Stop: the {goal_words} is reached."
        if all(determined.values()) and criterion == "emittance" and choice.gain < MIN_GAIN:
            return tuple(steps), (
                "Stop: the best further point sharpens the emittance by "
                f"{100 * max(choice.gain, 0):.1g} %; repeat the scan instead, or improve the size "
                "measurement."
            )
        now, candidate = choice.known, candidates[choice.index]
        determined = adviser.determined(now, [*(s.candidate for s in steps), candidate])
        steps.append(
            Prospect(candidate.words, adviser.errors(now), determined, candidate=candidate)
        )
    if goal_reached():
        return tuple(steps), f"Stop after these: the {goal_words} is reached."
    if goal is not None and all(determined.values()):
        return tuple(steps), f"The {goal_words} needs more than these {count}."
    return tuple(steps), f"Listed are the best {count}."


def _check_energies(energies: tuple[float, ...], rest: float) -> None:
    """Raise an error for total energies (MeV) below the rest energy or above 10 TeV."""
    for energy in energies:
        if not rest < energy <= 1e7:
            expected = f"a total energy between {rest:.6g} MeV and 10 TeV"
            raise InputError(f"an energy of {energy:g} MeV", expected)
