"""What to measure next: Fisher information of further settings, screens and energies.

Every candidate is one more measured size (of each plane that was measured), with the relative error
the scan has. Its row of the Jacobian updates the covariance of all free numbers of the scenario, so
the advice holds for calibrations and networks as well as for the beam alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from beamfit.answer import answer
from beamfit.emittance.candidates import (
    Candidate,
    by_plane,
    candidate_rows,
    determined_by,
    further_options,
    information_of,
    judge_of,
)
from beamfit.emittance.fit import EmittanceFit
from beamfit.errors import InputError
from beamfit.greybox.design import Information, greedy
from beamfit.status import Status
from beamfit.table import Table, json_of

CRITERIA = ("emittance", "D")
# A further point that sharpens the emittance by less than this is not worth its shift time.
LEAST_GAIN = 0.01
PERHAPS = "In brackets: for the beam as it is best known, which the data do not determine."
TIE = " Tie the network to first principles (--anchor first-principles=2%)."


class Step(NamedTuple):
    """One further measurement, and the relative emittance error of each plane after it."""

    candidate: Candidate
    relative_error: dict[str, float]
    determined: dict[str, bool]

    @property
    def identified(self) -> bool:
        """Whether every plane is determined then."""
        return all(self.determined.values())


class Option(NamedTuple):
    """A change of the experiment, and what it would make of the emittance."""

    words: str
    relative_error: dict[str, float]
    share_on_bounds: float
    determined: dict[str, bool]

    @property
    def identified(self) -> bool:
        """Whether every plane is determined then."""
        return all(self.determined.values())


@answer
@dataclass(frozen=True)
class Advice:
    """What to measure next, and when to stop.

    Attributes
    ----------
    scenario, criterion : str
        For which unknowns, and what is made small.
    determined : dict of str to bool
        Whether the data so far determine the emittance of each plane.
    now : dict of str to float
        Relative emittance error of each plane so far; what bounds decide is not counted.
    steps : tuple of Step
        The best further measurement, then the best after that, ...
    stop : str
        Why the list ends there.
    options : tuple of Option
        For a scenario that is not identified: which kind of measurement would identify it.
    tie : str
        What else could, in words.
    """

    scenario: str
    criterion: str
    determined: dict[str, bool]
    now: dict[str, float]
    steps: tuple[Step, ...]
    stop: str
    options: tuple[Option, ...]
    tie: str = ""

    @property
    def identified(self) -> bool:
        """Whether the data so far determine the emittance of every plane."""
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
            return f"{first} Measure next at {self.steps[0].candidate.words}, then ask again."
        if not self.identified and good:
            best = min(good, key=lambda o: max(o.relative_error.values()))
            return f"{first} It would be determined with {best.words}."
        if not self.identified:
            return f"{first} None of the measurements considered would change that.{self.tie}"
        if not self.steps:
            return f"{first} {self.stop}"
        return f"{first} Measure next at {self.steps[0].candidate.words}. {self.stop}"

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
            "next": [s.candidate._asdict() | {"relative_error": s.relative_error,
                     "determined": s.determined, "identified": s.identified} for s in self.steps],
            "determined": self.determined,
            "stop": self.stop,
            "options": [o._asdict() | {"identified": o.identified} for o in self.options],
        }  # fmt: skip
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
                rows.append([f"{number}. {step.candidate.words}", *cells])
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
    if criterion not in CRITERIA:
        raise InputError(f"criterion '{criterion}'", "emittance or D")
    if count < 1 or (goal is not None and not goal > 0):
        raise InputError(f"{count} points to a goal of {goal}", "at least one, and a positive goal")
    _check_energies(energies, float(fit.line.mass))
    base = information_of(fit)
    steps, stop = best_steps(fit, base, limits, criterion, goal, count, energies)
    # What is known so far is what the posterior of the fit says.
    now = {p.plane: p.identifiability.determined for p in fit.planes}
    options = () if all(now.values()) else tuple(_options(fit, base, energies))
    return Advice(
        fit.scenario,
        criterion,
        now,
        by_plane(fit, base),
        steps,
        stop,
        options,
        TIE if fit.statement.network else "",
    )


def best_steps(
    fit: EmittanceFit,
    base: Information,
    limits: Mapping[str, tuple[float, float]] | None,
    criterion: str = "emittance",
    goal: float | None = None,
    count: int = 1,
    energies: tuple[float, ...] = (),
) -> tuple[tuple[Step, ...], str]:
    """The best measurement, the best after that, and why the list ends."""
    candidates, rows = candidate_rows(fit, limits, energies)
    aim = "" if goal is None else f"goal of {100 * goal:.3g} %"
    judge, now, steps = judge_of(fit), base, []
    sure = judge(base, ())

    def sharp() -> bool:
        return goal is not None and all(sure.values()) and now.relative_error.max() <= goal

    for choice in greedy(base, rows, criterion == "D"):
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
        sure = judge(now, [*(s.candidate for s in steps), candidate])
        steps.append(Step(candidate, by_plane(fit, now), sure))
    if sharp():
        return tuple(steps), f"Stop after these: the {aim} is reached."
    if goal is not None and all(sure.values()):
        return tuple(steps), f"The {aim} needs more than these {count}."
    return tuple(steps), f"Listed are the best {count}."


def _options(fit: EmittanceFit, base: Information, energies: tuple[float, ...]) -> Iterator[Option]:
    """What each kind of further measurement would make of the emittance."""
    for words, rows in further_options(fit, base, energies):
        after = base.with_rows(rows)
        found = float(after.share.max()), determined_by(fit, after)
        yield Option(words, by_plane(fit, after), *found)


def _check_energies(energies: tuple[float, ...], rest: float) -> None:
    for energy in energies:
        if not rest < energy <= 1e7:
            expected = f"a total energy between {rest:.6g} MeV and 10 TeV"
            raise InputError(f"an energy of {energy:g} MeV", expected)
