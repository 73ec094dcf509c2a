"""What to measure next: Fisher information of further settings, screens and energies.

Every candidate is one more measured size (of each plane that was measured), with the relative error
the scan has. Its row of the Jacobian updates the covariance of all free numbers of the scenario, so
the advice holds for calibrations and networks as well as for the beam alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from beamfit.errors import InputError
from beamfit.studies.scan.candidates import Candidate, candidate_rows, further_options
from beamfit.studies.scan.fit import EmittanceFit
from beamfit.studies.scan.information import Information, information_of

__all__ = ["CRITERIA", "Advice", "Option", "Step", "plan_measurements"]

CRITERIA = ("emittance", "D")
# A further point that sharpens the emittance by less than this is not worth its shift time.
LEAST_GAIN = 0.01


class Step(NamedTuple):
    """One further measurement, and the relative emittance error of each plane after it."""

    candidate: Candidate
    relative_error: dict[str, float]
    identified: bool


class Option(NamedTuple):
    """A change of the experiment, and what it would make of the emittance."""

    words: str
    relative_error: dict[str, float]
    share_on_bounds: float
    identified: bool


@dataclass(frozen=True)
class Advice:
    """What to measure next, and when to stop.

    Attributes
    ----------
    scenario, criterion : str
        For which unknowns, and what is made small.
    identified : bool
        Whether the data so far determine the emittance of every plane.
    now : dict of str to float
        Relative emittance error of each plane so far; what bounds decide is not counted.
    steps : tuple of Step
        The best further measurement, then the best after that, ...
    stop : str
        Why the list ends there.
    options : tuple of Option
        For a scenario that is not identified: which kind of measurement would identify it.
    """

    scenario: str
    criterion: str
    identified: bool
    now: dict[str, float]
    steps: tuple[Step, ...]
    stop: str
    options: tuple[Option, ...]

    @property
    def message(self) -> str:
        """The advice in two sentences."""
        first = "The data determine the emittance." if self.identified else (
            "The data do not determine the emittance."
        )  # fmt: skip
        good = [o for o in self.options if o.identified]
        if not self.identified and good:
            best = min(good, key=lambda o: max(o.relative_error.values()))
            return f"{first} It would be determined with {best.words}."
        if not self.identified:
            tie = " Tie the network to first principles (--anchor first-principles=2%)."
            network = tie if self.scenario.endswith("network") else ""
            return f"{first} None of the measurements considered would change that.{network}"
        if not self.steps:
            return f"{first} {self.stop}"
        return f"{first} Measure next at {self.steps[0].candidate.words}. {self.stop}"

    def to_json(self) -> dict[str, Any]:
        """Give the entry of ``results`` of the JSON contract."""
        return {
            "scenario": self.scenario,
            "criterion": self.criterion,
            "status": "identified" if self.identified else "unidentified",
            "message": self.message,
            "relative_error": self.now,
            "next": [s.candidate._asdict() | {"relative_error": s.relative_error,
                     "identified": s.identified} for s in self.steps],
            "stop": self.stop,
            "options": [o._asdict() for o in self.options],
        }  # fmt: skip


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
    >>> from beamfit.optics.beamline import Beamline
    >>> from beamfit.optics.elements import Drift, Quadrupole, Screen
    >>> from beamfit.studies.scan.fit import fit_emittance
    >>> from beamfit.studies.scan.scans import QuadScan
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
    candidates = candidate_rows(fit, base, limits, energies)
    now, steps = base, []
    stop = f"Listed are the best {count}."
    for _ in range(count):
        if goal is not None and now.identified and max(now.relative_error().values()) <= goal:
            stop = f"Stop: the goal of {100 * goal:.3g} % is reached."
            break
        scores = [now.score(criterion, c.rows) for c in candidates]
        best = int(np.argmin(scores))
        after = now.with_rows(candidates[best].rows)
        gain = 1.0 - scores[best] / now.score(criterion, None)
        if now.identified and criterion == "emittance" and gain < LEAST_GAIN:
            stop = (
                f"Stop: the best further point sharpens the emittance by {100 * max(gain, 0):.1g} "
                "%; repeat the scan instead, or improve the size measurement."
            )
            break
        now = after
        steps.append(Step(candidates[best].candidate, now.relative_error(), now.identified))
    if goal is not None and steps and now.identified:
        if max(now.relative_error().values()) <= goal and not stop.startswith("Stop"):
            stop = f"Stop after these: the goal of {100 * goal:.3g} % is reached."
        elif not stop.startswith("Stop"):
            stop = f"The goal of {100 * goal:.3g} % needs more than these {count}."
    options = () if base.identified else _options(fit, base, energies)
    return Advice(
        fit.scenario, criterion, base.identified, base.relative_error(), tuple(steps), stop, options
    )


def _options(
    fit: EmittanceFit, base: Information, energies: tuple[float, ...]
) -> tuple[Option, ...]:
    """What each kind of further measurement would make of the emittance."""
    found = []
    for words, rows in further_options(fit, base, energies):
        after = base.with_rows(rows)
        share = float(after.share().max())
        found.append(Option(words, after.relative_error(), share, after.identified))
    return tuple(found)


def _check_energies(energies: tuple[float, ...], rest: float) -> None:
    for energy in energies:
        if not rest < energy <= 1e7:
            expected = f"a total energy between {rest:.6g} MeV and 10 TeV"
            raise InputError(f"an energy of {energy:g} MeV", expected)
