"""Scans prepared for a fit, and scenarios: the choice of free parameters besides the beam."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import jax
import numpy as np

from beamfit.compile_cache import SELDOM
from beamfit.emittance.assumptions import SCENARIOS, Assumptions
from beamfit.emittance.comparison import PlanePosterior, PlaneSizes, compare
from beamfit.emittance.model import UNIT, AnswerPlaces, predict_sizes
from beamfit.emittance.results import Parameter, PlaneFit, Points
from beamfit.emittance.scan import QuadScan, check_names
from beamfit.emittance.shots import group_shots
from beamfit.emittance.transport import (
    Rows,
    check_gradients,
    damping_of,
    lattice_names,
    pad_rows,
    row_elements,
    rows_line,
    scan_rows,
    scanned_line,
)
from beamfit.emittance.verdict import name_places
from beamfit.greybox.problem import Constraint, Free, Prior, Problem, Record
from beamfit.noise.model import Noise
from beamfit.noise.sizes import ShotMeans, pooled_variance, shot_means
from beamfit.optics.beamline import Beamline
from beamfit.optics.calibration import SETTING_UNITS

if TYPE_CHECKING:
    from beamfit.greybox.fit import Fit

# Residual that a fit minimises: the report's ``error_linear`` or ``error_nonlinear``.
METHODS = ("size_squared", "size")
# Size at which the error of size² is taken.
WEIGHTS = ("model", "measured")
# Above this scatter of shots, as a share of the size, the beam itself changes from shot to shot.
UNSTEADY_SCATTER = 0.1
# Largest number of scans in one compiled call, a power of two, and limit on the numbers in it.
MAX_LANES, MAX_CALL_NUMBERS = 256, 1 << 20


class PlaneSolution(NamedTuple):
    """Fit of one plane through a line, in closed form.

    Attributes
    ----------
    sizes : PlaneSizes
        Measured sizes.
    posterior : PlanePosterior
        Posterior of the beam.
    points : Points
        Fitted points, with the errors found.
    shot_words : str
        Sentence on shots that show no beam.
    """

    sizes: PlaneSizes
    posterior: PlanePosterior
    points: Points
    shot_words: str = ""


class PreparedScan(NamedTuple):
    """A scan through its line, with the closed-form fit of each plane to start from.

    Attributes
    ----------
    scan, line : QuadScan, Beamline
        As given.
    scanned : Beamline
        The line with the calibrations of the scan's columns.
    planes : tuple of str
        Planes to fit.
    method : str
        "size_squared" or "size".
    weights : str
        "model" or "measured": size at which the errors are taken.
    rows : Rows
        The scan's rows through that line, padded; elements that do not vary are combined.
    noise : Noise
        Priors of the noise of sizes.
    elements : ndarray
        R11, R12 and known size² of both planes, shape (3, 2, rows), through the line as given.
    solutions : dict of str to PlaneSolution
        Fit of each plane.
    variable, variable_energy : tuple of str and bool
        Elements that may vary besides the scanned magnets, and whether the energy may.
    """

    scan: QuadScan
    line: Beamline
    scanned: Beamline
    planes: tuple[str, ...]
    method: str
    weights: str
    rows: Rows
    noise: Noise
    elements: np.ndarray
    solutions: dict[str, PlaneSolution]
    variable: tuple[str, ...] = ()
    variable_energy: bool = False

    def of_plane(self, plane: str, settings: Mapping[str, Any] | None = None) -> Rows:
        """The rows of one plane, with other settings if any are given."""
        return replace(self.rows, plane=plane, settings=settings or self.rows.settings)

    def with_variable(self, names: Iterable[str], variable_energy: bool = False) -> PreparedScan:
        """Return a copy whose rows allow further elements, or the energy, to vary."""
        variable, vary_energy = (*self.variable, *names), self.variable_energy or variable_energy
        rows = scan_rows(self.scan, self.scanned, self.rows.squared, variable, vary_energy)
        return self._replace(rows=rows, variable=variable, variable_energy=vary_energy)

    def measured(self, plane: str) -> np.ndarray:
        """Indices of the rows in which a plane was measured."""
        return np.flatnonzero(~np.isnan(self.scan.size[plane]))

    def rows_at(
        self, line: Beamline, plane: str, place: str, settings: Mapping[str, Any], energy: Any
    ) -> Rows:
        """Rows of one plane's sizes on any screen of a line, at any settings.

        Settings and energies (MeV) are as in `Rows`. Energy spread and resolution are medians over
        the scan's rows (for the resolution, those on that screen), or else the line's.
        """
        scan = self.scan
        spread = line.energy_spread if scan.energy_spread is None else np.median(scan.energy_spread)
        screens = scan.screen or self.rows.places[-1:] * len(scan)
        resolution = getattr(line[place], "resolution", 0.0)
        if scan.resolution is not None and place in screens:
            resolution = np.median(scan.resolution[np.array(screens) == place])
        one, damping = np.ones(len(energy)), damping_of(energy, self.energy, float(line.mass))
        known = np.zeros(len(one), int), float(spread) * one, float(resolution) * one, damping
        return Rows(plane, (place,), False, line, settings, energy, *known)

    @property
    def energy(self) -> float:
        """Mean total energy of the rows, MeV, to which the answer refers."""
        return float(self.rows.energy[: len(self.scan)].mean())


@dataclass(frozen=True)
class Scenario:
    """A choice of free parameters besides the beam.

    Parameters
    ----------
    name : str
        Name of the option.
    state : callable
        ``state(prepared, assumptions)``: the problem, starting from the given line.
    parameters : callable
        ``parameters(prepared, assumptions, fit)``: fitted parameters besides the beam.
    null_directions : callable
        ``null_directions(prepared, parameters, identified)``: undetermined directions, in words.
    remedy : callable
        ``remedy(prepared, assumptions)``: measurements that are needed for the emittance, in words.
    consequence : str
        Consequence of an undetermined parameter for the emittance, in words.
    closed : bool
        Whether the fit is linear in σ, and solved in closed form.
    network : bool
        Whether a network is trained, from many starts; an anchor may tie it to the line.
    whole_map : bool
        Whether the map is the line's, so that the beam is known at all places and settings.
    """

    name: str
    state: Callable[[PreparedScan, Assumptions], Problem]
    parameters: Callable[[PreparedScan, Assumptions, Fit], Iterator[Parameter]] = lambda *_: iter(
        ()
    )
    null_directions: Callable[[PreparedScan, tuple[Parameter, ...], bool], tuple[str, ...]] = (
        lambda *_: ()
    )
    remedy: Callable[[PreparedScan, Assumptions], str] = lambda *_: ""
    consequence: str = ""
    closed: bool = False
    network: bool = False
    whole_map: bool = True

    def __reduce__(self) -> tuple[Callable[[str], Scenario], tuple[str]]:
        """Pickle the name: there is one scenario of each."""
        return scenario_of, (self.name,)


class Scanned(Protocol):
    """A fitted scan, of any scenario."""

    planes: tuple[PlaneFit, ...]
    line: Beamline
    statement: Scenario
    told: Assumptions
    seen: PreparedScan
    parameters: tuple[Parameter, ...]
    solved: Fit | None


def scenario_of(name: str) -> Scenario:
    """Load a scenario by its name.

    Examples
    --------
    >>> scenario_of("transport-network").whole_map
    False
    """
    return import_module(f"beamfit.emittance.{SCENARIOS[name].module}").SCENARIO


def varied_magnets(scan: QuadScan) -> tuple[str, ...]:
    """Magnets whose setting changes during a scan; none if rows have matrices of their own."""
    if scan.transfer:
        return ()
    return tuple(n for n, v in scan.settings.items() if np.ptp(v) > 0)


def answer_places(
    prepared: PreparedScan, plane: str, whole_map: bool = True, line: Beamline | None = None
) -> AnswerPlaces:
    """Places that a plane's answer refers to, through the rows' line if none is given."""
    design = prepared.scanned.design
    twiss = getattr(design, plane, None)
    return AnswerPlaces(
        plane,
        prepared.rows.places[-1] if whole_map else None,
        design.at if twiss else None,
        line or prepared.rows.line,
        np.asarray(prepared.energy),
        np.array(twiss or (np.nan, np.nan), float),
    )


def size_record(prepared: PreparedScan, plane: str, rows: Any) -> Record:
    """Record of a plane's measured sizes, in µm² or µm, with the errors of the posterior.

    Rows without a size, and padding, have weight 0.
    """
    points, at = prepared.solutions[plane].points, prepared.measured(plane)
    columns = 1e6 * np.stack([points.size, points.error, points.weighed])
    weight = np.zeros(len(pad_rows(prepared.scan.size[plane])))
    padded_columns = np.repeat(columns[:, :1], len(weight), axis=1)
    weight[at], padded_columns[:, at] = 1.0, columns
    size, error, weighed = padded_columns
    if rows.squared:
        size, error = size**2, 2.0 * weighed * error
    return Record(f"size {plane}", predict_sizes, rows, size, error, weight)


def size_records(problem: Problem) -> dict[str, Record]:
    """Records of measured sizes in a problem, by plane."""
    return {r.data.plane: r for r in problem.records if r.predict is predict_sizes}


def problem_places(
    problem: Problem, prepared: PreparedScan, planes: Iterable[str], whole_map: bool
) -> tuple[AnswerPlaces, ...]:
    """Places that the planes' answers refer to, through the lines of a problem."""
    records = size_records(problem)
    lines = {plane: records[plane].data.line if whole_map else None for plane in planes}
    return tuple(answer_places(prepared, plane, whole_map, line) for plane, line in lines.items())


def beam_numbers(prepared: PreparedScan) -> dict[str, dict[str, float]]:
    """Cholesky factors to start from: the closed-form fit, kept away from zero emittance."""
    return {
        plane: cholesky_numbers(prepared.solutions[plane].posterior.best, 0.0025)
        for plane in prepared.planes
    }


def cholesky_numbers(sigma: Sequence[float], min_share: float) -> dict[str, float]:
    """Cholesky factor of σ (SI) in units of 1e-4, with l22² at least a share of σ22."""
    s11, s12, s22 = (float(v) / UNIT**2 for v in sigma)
    l11 = math.sqrt(max(s11, 1e-6))
    l21 = s12 / l11
    return {"l11": l11, "l21": l21, "l22": math.sqrt(max(s22 - l21**2, min_share * max(s22, 1e-6)))}


def beam_free(beams: Mapping[str, Mapping[str, float]]) -> list[Free]:
    """Free parameters of the beams; l11 and l22 are positive."""
    free = []
    for plane, numbers in beams.items():
        angle = float(np.hypot(numbers["l21"], numbers["l22"]))
        start_range = {
            "l11": (0.5 * numbers["l11"], 1.5 * numbers["l11"]),
            "l21": (-angle, angle),
            "l22": (0.1 * angle, angle),
        }
        for name in numbers:
            low = -np.inf if name == "l21" else 1e-6
            free.append(Free(f"beam.{plane}.{name}", low, np.inf, start_range[name]))
    return free


def beam_problem(
    prepared: PreparedScan,
    rows: Mapping[str, Any] | None = None,
    model: Mapping[str, Any] = MappingProxyType({}),
    free: Iterable[Free] = (),
    records: Iterable[Record] = (),
    priors: Iterable[Prior] = (),
    constraints: Iterable[Constraint] = (),
) -> Problem:
    """Problem of the beams and the measured sizes by plane, with the parts of a scenario."""
    beams, rows = beam_numbers(prepared), rows or {p: prepared.of_plane(p) for p in prepared.planes}
    sizes = [size_record(prepared, plane, plane_rows) for plane, plane_rows in rows.items()]
    free, records = [*beam_free(beams), *free], [*sizes, *records]
    return Problem({"beam": beams, **model}, free, records, [*priors], [*constraints])


def prepare(
    scan: QuadScan,
    line: Beamline,
    planes: tuple[str, ...] | None = None,
    method: str = METHODS[0],
    noise: Noise | None = None,
    weights: str = WEIGHTS[0],
) -> PreparedScan:
    """Assemble a scan with its line, and fit each plane in closed form.

    Parameters
    ----------
    scan, line, planes, method, noise, weights
        As for `beamfit.fit_emittance`.

    Returns
    -------
    PreparedScan

    Raises
    ------
    InputError
        If the line lacks a magnet or screen of the scan, or a plane was not measured.
    """
    return with_posteriors(with_elements([assemble(scan, line, planes, method, noise, weights)]))[0]


def single_beam(
    scan: QuadScan, line: Beamline | None, scenario: str = "known"
) -> tuple[QuadScan, Beamline]:
    """Reduce a scan to one beam with total energies and one row per setting, and find its line.

    Raises
    ------
    InputError
        If the scan has several slices, or matrices together with a line or another scenario.
    """
    if len(scan.slices) > 1:
        found = f"a scan of {len(scan.slices)} slices of the beam"
        raise scan.unusable(found, "rows of one, as scan.of_slice(name) gives")
    line = rows_line(scan) if line is None else line
    given = "rows with matrices of their own"
    if scan.transfer and (line.magnets or float(line.length) > 0.0):
        raise scan.unusable(f"{given} and a line", "one of the two")
    if scan.transfer and scenario != "known":
        expected = "scenario known, or settings and a lattice"
        raise scan.unusable(f"scenario {scenario} for {given}", expected)
    return group_shots(scan.of_particle(line.mass)), line


def assemble(
    scan: QuadScan,
    line: Beamline,
    planes: tuple[str, ...] | None = None,
    method: str = METHODS[0],
    noise: Noise | None = None,
    weights: str = WEIGHTS[0],
) -> PreparedScan:
    """Assemble a scan and its line, without transfer-matrix elements and posteriors."""
    check_names(scan, *lattice_names(line))
    chosen = planes or scan.planes
    for plane in chosen:
        scan.rows(plane)  # raises an error if the plane was not measured
    scanned = scanned_line(scan, line)
    check_gradients(scan, scanned)
    rows = scan_rows(scan, scanned, method == METHODS[0])
    return PreparedScan(
        scan, line, scanned, chosen, method, weights, rows, noise or Noise(), None, {}
    )


def with_elements(assembled: Sequence[PreparedScan]) -> list[PreparedScan]:
    """Add the transfer-matrix elements of scans; one call for scans of the same structure."""
    found, alike = list(assembled), {}
    for i, prepared in enumerate(assembled):
        leaves, structure = jax.tree.flatten(prepared.rows)
        alike.setdefault((structure, *map(np.shape, leaves)), []).append((i, leaves))
    for (structure, *shapes), members in alike.items():
        lanes_in_memory = max(MAX_CALL_NUMBERS // max(map(np.prod, shapes)) ** 2, 1)
        lanes = min(int(lanes_in_memory), MAX_LANES, 1 << (len(members) - 1).bit_length())
        for start in range(0, len(members), lanes):
            batch = members[start : start + lanes]
            columns = zip(
                *(leaves for _, leaves in batch + batch[-1:] * (lanes - len(batch))), strict=True
            )
            elements = np.asarray(_elements([np.stack(c) for c in columns], structure))
            for lane, (i, _) in enumerate(batch):
                found[i] = assembled[i]._replace(elements=elements[lane])
    return found


@partial(jax.jit, static_argnums=1, compiler_options=SELDOM)
def _elements(columns: list, structure: Any) -> Any:
    """Elements of several scans of one structure, for stacked columns of their rows."""
    return jax.vmap(lambda leaves: row_elements(jax.tree.unflatten(structure, leaves)))(columns)


def with_posteriors(assembled: Sequence[PreparedScan]) -> list[PreparedScan]:
    """Add the closed-form fit of every plane; all scans have one noise prior and one method."""
    if not assembled:
        return []
    by_scan = [
        {plane: plane_sizes(prepared, plane) for plane in prepared.planes} for prepared in assembled
    ]
    sizes = [each for planes in by_scan for each, _ in planes.values()]
    found = iter(compare(sizes, assembled[0].noise, assembled[0].method, assembled[0].weights))
    solved = []
    for prepared, planes in zip(assembled, by_scan, strict=True):
        solutions = {
            plane: _plane_solution(prepared, plane, each, next(found), shots)
            for plane, (each, shots) in planes.items()
        }
        solved.append(prepared._replace(solutions=solutions))
    return solved


def plane_sizes(prepared: PreparedScan, plane: str) -> tuple[PlaneSizes, ShotMeans | None]:
    """Sizes of a plane with their errors, and the means of its shots."""
    scan, at, i = prepared.scan, prepared.measured(plane), "xy".index(plane)
    r11, r12, known = prepared.elements[:, i, at]
    size, error, shots = scan.size[plane][at], scan.error.get(plane), None
    if plane in scan.shot_size and (shots := shot_means(scan.shot_size[plane][at], prepared.noise)):
        size, error = shots.size, shots.error
    elif error is not None:
        error = error[at]
        freedom = np.zeros(1) if scan.shots is None else np.asarray(scan.shots, float)[at] - 1.0
        if freedom.sum() > 0:
            square = error**2 * (freedom + 1.0) * freedom
            error = np.sqrt(pooled_variance(square, freedom, size) / (freedom + 1.0))
    counted = scan.shots is not None and bool((np.asarray(scan.shots) > 1).any())
    of_shots = shots is not None or (error is not None and counted)
    screens = {prepared.rows.places[j] for j in prepared.rows.screen_index[at]}
    moved = any(np.ptp(v[at]) > 0 for v in scan.settings.values()) or len(screens) < 3
    return PlaneSizes(r11, r12, known, size, error, of_shots, moved), shots


def _plane_solution(
    prepared: PreparedScan,
    plane: str,
    sizes: PlaneSizes,
    post: PlanePosterior,
    shots: ShotMeans | None,
) -> PlaneSolution:
    """Combine a plane's sizes and posterior into its fitted points."""
    scan, at, by_model = prepared.scan, prepared.measured(plane), prepared.weights == WEIGHTS[0]
    points = Points(
        settings={name: v[at] for name, v in scan.settings.items()},
        units={name: SETTING_UNITS[scan.units[name]] for name in scan.settings},
        screen=tuple(prepared.rows.places[j] for j in prepared.rows.screen_index[at]),
        size=sizes.size,
        error=post.error,
        weighed=post.model if by_model else sizes.size,
        relative=post.relative if by_model else 0.0,
        model=post.model,
        pull=np.zeros(len(at)),
        outlier_probability=post.bad,
        r11=sizes.r11,
        r12=sizes.r12,
        known=sizes.known,
    )
    points = points.with_model(post.model, prepared.rows.squared)
    return PlaneSolution(sizes, post, points, _shot_sentences(points, shots))


def _shot_sentences(p: Points, shots: ShotMeans | None) -> str:
    """Sentences on shots that show no beam, and on their scatter."""
    if shots is None:
        return ""
    bad, sentences = np.argwhere(np.nan_to_num(shots.bad) > 0.99), []
    if len(bad):
        count, are = int((~np.isnan(shots.bad)).sum()), "are" if len(bad) > 1 else "is"
        places = name_places([f"shot {j + 1} at {p.where(i)}" for i, j in bad])
        sentences.append(f"{len(bad)} of {count} shots {are} left out, no beam there: {places}.")
    if shots.scatter > UNSTEADY_SCATTER:
        sentences.append(
            f"Shots of one setting scatter by {100 * shots.scatter:.2g} %: the beam changes from "
            "shot to shot, and this is that of the mean sizes."
        )
    return " ".join(sentences)


# Only the beam is free. The problem is for those who need more than the posterior.
SCENARIO = Scenario("known", lambda prepared, _assumptions: beam_problem(prepared), closed=True)
