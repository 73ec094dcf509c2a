"""Design of the next measurement: Fisher information of further settings, screens and energies.

Every candidate is one more measured size (of each plane that was measured), with the relative error
the scan has. Its row of the Jacobian updates the covariance of all free numbers of the scenario, so
the advice holds for calibrations and networks as well as for the beam alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from beamfit.answer import answer
from beamfit.emittance.calibration import NumberKind, numbers_of_magnets
from beamfit.emittance.fit import EmittanceFit
from beamfit.emittance.model import emittance_parts, predict_sizes, sigma_of, spoken
from beamfit.emittance.next_point import (
    BeamSpread,
    Further,
    Predict,
    beam_information,
    beam_sizes,
    candidate_settings,
    elements_at,
    on_screen,
    relative_error,
    simulated,
    spread_of,
)
from beamfit.emittance.results import in_words
from beamfit.emittance.statement import size_records, varied_magnets
from beamfit.emittance.transport import NetworkRows, Rows, rows_at, setting_units
from beamfit.errors import InputError, nearest
from beamfit.greybox import assess
from beamfit.greybox.covariance import MOST_SHARE
from beamfit.greybox.design import Information, greedy
from beamfit.greybox.fit import value_and_slope
from beamfit.optics.beamline import Beamline
from beamfit.optics.elements import Drift, Screen
from beamfit.statistics import USEFUL
from beamfit.status import Status
from beamfit.table import Table, json_of

# The error of ln ε whose 95 % interval spans the factor within which an emittance is of use.
NARROW = float(np.log(USEFUL)) / 3.92
# Other energies to consider where none is named: what a linac can usually do.
USUAL_ENERGIES = (0.8, 1.25)
CRITERIA = ("emittance", "D")
# A further point that sharpens the emittance by less than this is not worth its shift time.
LEAST_GAIN = 0.01
PERHAPS = "In brackets: for the beam as it is best known, which the data do not determine."
TIE = " Tie the network to first principles (--anchor first-principles=2%)."


class Candidate(NamedTuple):
    """A further measurement: settings of the magnets, screen, and energy in MeV."""

    settings: dict[str, float]
    screen: str
    energy: float
    words: str


# Which planes are determined, by what is known and by what is measured further.
Judge = Callable[[Information, Sequence[Candidate]], dict[str, bool]]


def by_plane(fit: EmittanceFit, known: Information) -> dict[str, float]:
    """Relative error of each plane's emittance."""
    error = map(float, known.relative_error)
    return dict(zip((p.plane for p in fit.planes), error, strict=True))


def determined_by(fit: EmittanceFit, known: Information) -> dict[str, bool]:
    """Tell of each plane if its emittance rests on data and priors, within a factor of use."""
    clear = (known.relative_error <= NARROW) & (known.share < MOST_SHARE)
    return dict(zip((p.plane for p in fit.planes), map(bool, clear), strict=True))


def judge_of(fit: EmittanceFit) -> Judge:
    """Give the function that tells which planes further measurements would determine.

    Of known transport they are simulated, and compared with the rivals as a scan is; in a scenario
    linear theory says.
    """
    if fit.solved is not None:
        return lambda known, _: determined_by(fit, known)
    seen, now = fit.seen, {p.plane: p.identifiability.determined for p in fit.planes}

    def judge(_: Information, further: Sequence[Candidate]) -> dict[str, bool]:
        if not further or all(now.values()):
            return now
        rows = []
        for c in further:
            table = {name: np.array([v]) for name, v in c.settings.items()}
            rows.append(elements_at(seen, seen.scanned, table, c.screen, np.array([c.energy])))
        every = np.concatenate(rows, axis=-1)
        own = {plane: every["xy".index(plane)] for plane in now}
        return {plane: sure or simulated(seen, plane, *own[plane]) for plane, sure in now.items()}

    return judge


def planes_of(fit: EmittanceFit) -> list[str]:
    """The planes that were fitted."""
    return [p.plane for p in fit.planes]


def _spreads(fit: EmittanceFit) -> dict[str, BeamSpread]:
    """Draws of each plane that was fitted."""
    return {plane: spread_of(fit.seen, plane) for plane in planes_of(fit)}


def information_of(fit: EmittanceFit) -> Information:
    """Gather the information of a fit: of known transport from the draws, else by linear theory.

    Parameters
    ----------
    fit : EmittanceFit
        The fit.

    Returns
    -------
    Information
    """
    if fit.solved is None:
        quoted = [p.emittance.error and p.emittance.relative for p in fit.planes]
        return beam_information(list(_spreads(fit).values()), [q or np.nan for q in quoted])
    p, theta = fit.problem, linearised_at(fit)
    held = p.lower == p.upper
    if _determined(fit):
        edge = np.array([v.state in ("lower", "upper") for v in fit.fit.variables])
        held = held | (edge & p.nuisance)
    return Information(
        assess.slopes(p, theta).residual_jacobian,
        *value_and_slope(p, _emittances, theta),
        ~p.nuisance & ~held,
        p.lower,
        p.upper,
        held,
        np.isin(np.array(p.names), [prior.name for prior in p.priors]),
    )


def linearised_at(fit: EmittanceFit) -> np.ndarray:
    """Numbers to take derivatives at: the answer, or first principles where there is none.

    Numbers that the data do not determine end anywhere; what a measurement would tell is then
    asked of the line and the beam one started from.
    """
    if _determined(fit):
        return fit.fit.theta
    return np.clip(fit.stated.start, fit.stated.lower, fit.stated.upper)


def _determined(fit: EmittanceFit) -> bool:
    return all(plane.identifiability.determined for plane in fit.planes)


def _emittances(model, data):
    return jnp.stack([emittance_parts(sigma_of(beam))[0] for beam in model["beam"].values()])


def candidate_rows(
    fit: EmittanceFit,
    limits: Mapping[str, tuple[float, float]] | None,
    energies: tuple[float, ...],
) -> tuple[list[Candidate], np.ndarray]:
    """List single further measurements with their rows of the Jacobian.

    Parameters
    ----------
    fit : EmittanceFit
        What is measured already.
    limits : mapping of str to (float, float), or None
        Magnets that may be set, each in turn over 41 settings, the others at their median.
    energies : tuple of float
        Further energies, MeV.

    Returns
    -------
    list of Candidate and ndarray
        At every screen of the line, and every energy; rows of shape (candidates, planes, n).

    Raises
    ------
    InputError
        If limits name no magnet of the line, or are reversed.
    """
    seen, screens, found, rows = fit.seen, _screens(fit), [], []
    predict = _predicted(fit)
    for _, table in candidate_settings(fit.scan.settings, _checked(fit, limits)):
        rows_of_table = zip(*table.values(), strict=True)
        points = [dict(zip(table, map(float, row), strict=True)) for row in rows_of_table]
        for screen, energy in product(screens, (seen.energy, *energies)):
            further = predict(seen.scanned, table, screen, np.full(len(points), energy))
            usable = np.ones(len(points), bool)
            if limits is None and (there := on_screen(seen, planes_of(fit), further.size)).any():
                usable = there
            rows += list(further.rows.swapaxes(0, 1)[usable])
            where = f" on {screen}" if len(screens) > 1 else ""
            where += f" at {energy:g} MeV" if energy != seen.energy else ""
            for i in np.flatnonzero(usable):
                words = _in_words(fit, points[i]) + where
                found.append(Candidate(points[i], screen, float(energy), words))
    return found, np.array(rows)


def _checked(fit: EmittanceFit, limits):
    """Limits of magnets that can be set, refused if they cannot be used, or if none can be told."""
    if fit.scan.transfer:
        found = "advice on rows with matrices of their own"
        raise fit.scan.unusable(found, "a lattice in which other settings can be tried")
    if not limits and not varied_magnets(fit.scan):
        found = "advice on a scan that moved no magnet"
        raise fit.scan.unusable(found, "limits of a magnet, such as --vary Q1=LOW:HIGH")
    for name, (low, high) in (limits or {}).items():
        if name not in fit.seen.scanned.magnets:
            raise InputError(
                f"limits of '{name}'", nearest(name, list(fit.seen.scanned.magnets)) + ", a magnet"
            )
        if not (np.isfinite(low) and np.isfinite(high) and low < high):
            raise InputError(f"limits {low:g}:{high:g} of {name}", "finite limits, lower first")
        if not fit.statement.whole_map and name not in varied_magnets(fit.scan):
            raise InputError(f"limits of '{name}', which was not scanned", "a scanned magnet")
    return limits


def _screens(fit: EmittanceFit) -> tuple[str, ...]:
    """Screens to measure at: all of the line, downstream of a scanned magnet."""
    measured = fit.seen.rows.places
    if not fit.statement.whole_map:  # another screen has another network
        return measured
    names, magnets = _along(fit)
    later = [s for s in fit.seen.scanned.screens if names.index(s) > min(magnets)]
    return tuple(dict.fromkeys((*measured, *later)))


def _along(fit: EmittanceFit) -> tuple[list[str], list[int]]:
    """Names along the line, and where in them the scanned magnets stand."""
    line = fit.seen.scanned
    names = [e.name for e in line.elements]
    magnets = [m for name in varied_magnets(fit.scan) for m in line.members(name)]
    return names, [names.index(m) for m in magnets] or [-1]


def _in_words(fit: EmittanceFit, settings: Mapping[str, float]) -> str:
    """Settings with the units of the scan."""
    return in_words(settings, setting_units(fit.seen.scanned, settings))


def _predicted(fit: EmittanceFit) -> Predict:
    """Give the prediction of further sizes: by the draws of the beams, or by derivatives."""
    if fit.solved is None:
        return beam_sizes(fit.seen, _spreads(fit))
    problem, theta = fit.problem, linearised_at(fit)

    def predict(line, table, screen, energy) -> Further:
        sizes, rows = [], []
        for plane in planes_of(fit):
            if fit.statement.whole_map:
                data = _line_rows(fit, line, plane, table, screen, energy)
            else:
                data = _network_rows(fit, plane, table, screen)
            size, slope = value_and_slope(problem, predict_sizes, theta, data)
            rows.append(slope / (relative_error(fit.seen, plane) * size)[:, None])
            sizes.append(1e-6 * size)
        return Further(np.array(sizes), np.array(rows))

    return predict


def _line_rows(fit, line, plane, table, screen, energy) -> Rows:
    count = len(energy)
    measured = size_records(fit.problem)[plane].data
    shapes = {n: np.ndim(v) for n, v in measured.settings.items()}
    # Where a magnet has branches, a further point is measured on the rising one.
    settings = {
        n: jnp.stack([v, jnp.ones(count)], -1) if shapes.get(n) == 2 else jnp.asarray(v)
        for n, v in table.items()
    }
    known = fit.seen.known_at(line, screen)
    return rows_at(line, plane, screen, settings, np.asarray(energy), *known)


def _network_rows(fit, plane, table, screen) -> NetworkRows:
    measured, seen = size_records(fit.problem)[plane].data, fit.seen
    place = seen.rows.places.index(screen)
    which = next(i for i in seen.measured(plane) if seen.rows.which[i] == place)
    count = len(next(iter(table.values())))
    names = fit.fit.model["map"].inputs
    inputs = [table.get(n, np.full(count, fit.seen.energy)) for n in names]
    return NetworkRows(
        plane,
        False,
        jnp.asarray(np.stack(inputs, -1)),
        jnp.tile(measured.columns[which], (count, 1)),
        jnp.full(count, float(np.median(np.asarray(measured.known)))),
        jnp.ones(count),
    )


def further_options(
    fit: EmittanceFit, base: Information, energies: tuple[float, ...]
) -> Iterator[tuple[str, np.ndarray]]:
    """Kinds of measurement that might identify a scenario, each with its rows.

    A single size at every other screen, the same scan at it; the same scan at other energies;
    and, where the line has no second screen, at screens one could put into its drifts.

    Parameters
    ----------
    fit : EmittanceFit
        What is measured already.
    base : Information
        Its information.
    energies : tuple of float
        Energies to consider, MeV; 20 % below and 25 % above if empty.

    Yields
    ------
    tuple of str and ndarray
        Words, and rows of shape (m, n).
    """
    table = {n: np.asarray(v) for n, v in fit.scan.settings.items()}
    own = fit.seen.energy
    energy = np.full(len(fit.scan), own) if fit.scan.energy is None else fit.scan.energy
    if fit.statement.whole_map:
        predict = _predicted(fit)
        for line, screen, words in _other_screens(fit):
            rows = predict(line, table, screen, energy).rows
            best = min(range(rows.shape[1]), key=lambda i: _worst(base.with_rows(rows[:, i])))
            at = _in_words(fit, {n: float(v[best]) for n, v in table.items()})
            yield f"one size on {words} ({at})", rows[:, best]
            yield f"the same scan on {words}", rows.reshape(-1, rows.shape[-1])
        for factor in energies or tuple(own * f for f in USUAL_ENERGIES):
            screen = (fit.scan.screen or fit.seen.rows.places)[-1]
            rows = predict(fit.seen.scanned, table, screen, np.full(len(fit.scan), factor)).rows
            yield f"the same scan at {factor:.4g} MeV", rows.reshape(-1, rows.shape[-1])
    yield from _priors(fit)


def _worst(after: Information) -> float:
    """Relative error that counts bounds as nothing: large while they decide."""
    return float(after.relative_error.max() / max(1.0 - after.share.max(), 1e-6))


def _other_screens(fit: EmittanceFit) -> list[tuple[Beamline, str, str]]:
    """Screens that were not used, or else places for one in the drifts after the magnets."""
    line = fit.seen.scanned
    unused = [s for s in _screens(fit) if s not in fit.seen.rows.places]
    if unused:
        return [(line, s, f"screen {s}") for s in unused]
    _, magnets = _along(fit)
    found = []
    for i, element in enumerate(line.elements):
        if i > max(magnets) and isinstance(element, Drift) and element.length > 0.3:
            half = replace(element, length=0.5 * element.length)
            elements = (*line.elements[:i], half, Screen("NEW"), half, *line.elements[i + 1 :])
            words = f"a new screen in the middle of {element.name}"
            found.append((replace(line, elements=elements), "NEW", words))
    return found


def _priors(fit: EmittanceFit) -> Iterator[tuple[str, np.ndarray]]:
    """A 2 % measurement of each slope, as from a field map of the magnet."""
    slopes = {
        f"magnets.{name}": number.value
        for name, number in numbers_of_magnets(fit.seen.scanned).items()
        if number.kind is NumberKind.slope
    }
    for i, name in enumerate(fit.problem.names):
        if name in slopes:
            row = np.zeros((1, len(fit.problem.names)))
            row[0, i] = 1.0 / (0.02 * abs(slopes[name]))
            yield f"a prior of 2 % on {spoken(name)}", row


class Step(NamedTuple):
    """One further measurement, and the relative emittance error of each plane after it."""

    candidate: Candidate
    relative_error: dict[str, float]
    determined: dict[str, bool]

    @property
    def identified(self) -> bool:
        """True if every plane is determined then."""
        return all(self.determined.values())


class Option(NamedTuple):
    """A change of the experiment, and what it would make of the emittance."""

    words: str
    relative_error: dict[str, float]
    share_on_bounds: float
    determined: dict[str, bool]

    @property
    def identified(self) -> bool:
        """True if every plane is determined then."""
        return all(self.determined.values())


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
    """The emittance after each kind of further measurement."""
    for words, rows in further_options(fit, base, energies):
        after = base.with_rows(rows)
        found = float(after.share.max()), determined_by(fit, after)
        yield Option(words, by_plane(fit, after), *found)


def _check_energies(energies: tuple[float, ...], rest: float) -> None:
    for energy in energies:
        if not rest < energy <= 1e7:
            expected = f"a total energy between {rest:.6g} MeV and 10 TeV"
            raise InputError(f"an energy of {energy:g} MeV", expected)
