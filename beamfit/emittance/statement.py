"""A scan seen through its line, and a scenario: the value that states it as a problem."""

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
from beamfit.emittance.model import UNIT, Asked, predict_sizes
from beamfit.emittance.results import Parameter, PlaneFit, Points
from beamfit.emittance.scan import QuadScan, check_names
from beamfit.emittance.shots import of_settings
from beamfit.emittance.transport import (
    Rows,
    check_gradients,
    damping_of,
    look_through,
    names_of,
    padded,
    rows_line,
    scan_rows,
    scanned_line,
)
from beamfit.emittance.verdict import named
from beamfit.greybox.problem import Constraint, Free, Prior, Problem, Record
from beamfit.noise.model import Noise
from beamfit.noise.sizes import ShotMeans, evened, means_of
from beamfit.optics.beamline import Beamline
from beamfit.optics.calibration import SETTING_UNITS

if TYPE_CHECKING:
    from beamfit.greybox.fit import Fit

# The residual: the report's ``error_linear`` or ``error_nonlinear``.
METHODS = ("size_squared", "size")
# Whose size errors are taken at.
WEIGHTS = ("model", "measured")
# A share of the size from which on the scatter of shots is the beam's more than the screen's.
UNSTEADY = 0.1
# Scans that are looked at in one call at most, in powers of two (the last one fills them up), as
# far as rows times the longest of their arrays have room.
LANES, ROOM = 256, 1 << 20


class PlaneSolution(NamedTuple):
    """One plane seen through a line: its sizes, their posterior, and the points as fitted.

    Attributes
    ----------
    sizes : PlaneSizes
        What was measured.
    posterior : PlanePosterior
        What it says of the beam.
    points : Points
        Point by point, with the errors found.
    shot_words : str
        Shots that show no beam, in a sentence.
    """

    sizes: PlaneSizes
    posterior: PlanePosterior
    points: Points
    shot_words: str = ""


class PreparedScan(NamedTuple):
    """A scan through its line, with the fit of known transport of each plane to start from.

    Attributes
    ----------
    scan, line : QuadScan, Beamline
        As given.
    scanned : Beamline
        The line with the calibrations of the scan's columns.
    planes : tuple of str
        Those that are asked for.
    method : str
        "size_squared" or "size".
    weights : str
        "model" or "measured": whose size the errors are taken at.
    rows : Rows
        The scan's rows through that line, padded; what no row changes is multiplied out.
    noise : Noise
        Priors of the noise of sizes.
    look : ndarray
        R11, R12 and known size² of both planes, shape (3, 2, rows), with every magnet as the
        lattice has it.
    solutions : dict of str to PlaneSolution
        Plane to its fit; of every plane that was measured.
    kept, any_energy : tuple of str and bool
        Elements that may change besides the scanned magnets, and whether the energy may.
    """

    scan: QuadScan
    line: Beamline
    scanned: Beamline
    planes: tuple[str, ...]
    method: str
    weights: str
    rows: Rows
    noise: Noise
    look: np.ndarray
    solutions: dict[str, PlaneSolution]
    kept: tuple[str, ...] = ()
    any_energy: bool = False

    def of_plane(self, plane: str, settings: Mapping[str, Any] | None = None) -> Rows:
        """The rows of one plane, with other settings if any are given."""
        return replace(self.rows, plane=plane, settings=settings or self.rows.settings)

    def keeping(self, names: Iterable[str], any_energy: bool = False) -> PreparedScan:
        """The same with rows in which further elements, or the energy, may change."""
        kept, free = (*self.kept, *names), self.any_energy or any_energy
        rows = scan_rows(self.scan, self.scanned, self.rows.squared, kept, free)
        return self._replace(rows=rows, kept=kept, any_energy=free)

    def measured(self, plane: str) -> np.ndarray:
        """Indices of the rows in which a plane was measured."""
        return np.flatnonzero(~np.isnan(self.scan.size[plane]))

    def rows_at(
        self, line: Beamline, plane: str, place: str, settings: Mapping[str, Any], energy: Any
    ) -> Rows:
        """Rows of one plane's sizes on a screen of a line, which nobody need have measured.

        Settings and energies (MeV) are as of `Rows`. What the scan itself says of energy spread and
        resolution, in the middle of its rows (of the resolution those on that screen), goes before
        the line.
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
        """Mean total energy of the rows, MeV: that of the beam that is asked for."""
        return float(self.rows.energy[: len(self.scan)].mean())


@dataclass(frozen=True)
class Scenario:
    """A choice of unknowns besides the beam, as a value that everybody asks and nobody compares.

    Parameters
    ----------
    name : str
        As users call it.
    state : callable
        ``state(seen, told)``: the problem, starting from first principles.
    parameters : callable
        ``parameters(seen, told, fit)``: the numbers fitted besides the beam.
    null_directions : callable
        ``null_directions(seen, parameters, identified)``: what the data leave open, in words.
    remedy : callable
        ``remedy(seen, told)``: what would determine the emittance, in words.
    aside : str
        What an undetermined parameter means for the emittance, in words.
    closed : bool
        Whether the fit is linear in σ, and done in closed form.
    network : bool
        Whether a network is trained, from many starts, which an anchor may tie.
    whole_map : bool
        Whether the map is the line's, so that the beam is known at every place and any setting.
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
    aside: str = ""
    closed: bool = False
    network: bool = False
    whole_map: bool = True


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
    """The scenario of a name, from its module.

    Examples
    --------
    >>> scenario_of("transport-network").whole_map
    False
    """
    return import_module(f"beamfit.emittance.{SCENARIOS[name].module}").SCENARIO


def varied_magnets(scan: QuadScan) -> tuple[str, ...]:
    """Magnets whose setting changes during a scan; of rows with matrices of their own none."""
    if scan.transfer:
        return ()
    return tuple(n for n, v in scan.settings.items() if np.ptp(v) > 0)


def asked_of(
    seen: PreparedScan, plane: str, whole_map: bool = True, line: Beamline | None = None
) -> Asked:
    """Places of a plane's numbers through a line: the rows' own, if none is given."""
    design = seen.scanned.design
    twiss = getattr(design, plane, None)
    return Asked(
        plane,
        seen.rows.places[-1] if whole_map else None,
        design.at if twiss else None,
        line or seen.rows.line,
        np.asarray(seen.energy),
        np.array(twiss or (np.nan, np.nan), float),
    )


def size_record(seen: PreparedScan, plane: str, rows: Any) -> Record:
    """The measured sizes of a plane, in µm² or µm, with the errors that the posterior found.

    Rows without a size have weight 0, and so has padding.
    """
    points, at = seen.solutions[plane].points, seen.measured(plane)
    columns = 1e6 * np.stack([points.size, points.error, points.weighed])
    weight = np.zeros(len(padded(seen.scan.size[plane])))
    every = np.repeat(columns[:, :1], len(weight), axis=1)
    weight[at], every[:, at] = 1.0, columns
    size, error, weighed = every
    if rows.squared:
        size, error = size**2, 2.0 * weighed * error
    return Record(f"size {plane}", predict_sizes, rows, size, error, weight)


def size_records(problem: Problem) -> dict[str, Record]:
    """Those of a problem's records that have the sizes of a plane, by its name."""
    return {r.data.plane: r for r in problem.records if r.predict is predict_sizes}


def asked_in(
    problem: Problem, seen: PreparedScan, planes: Iterable[str], whole_map: bool
) -> tuple[Asked, ...]:
    """Places of the planes' numbers, through the lines that a problem has."""
    records = size_records(problem)
    lines = {plane: records[plane].data.line if whole_map else None for plane in planes}
    return tuple(asked_of(seen, plane, whole_map, line) for plane, line in lines.items())


def beam_numbers(seen: PreparedScan) -> dict[str, dict[str, float]]:
    """Cholesky factors to start from: the known-transport fit, kept off zero emittance."""
    return {plane: factor_of(seen.solutions[plane].posterior.best, 0.0025) for plane in seen.planes}


def factor_of(sigma: Sequence[float], least: float) -> dict[str, float]:
    """The numbers of a beam from its σ in SI, with no less than this share of σ22 off the line."""
    s11, s12, s22 = (float(v) / UNIT**2 for v in sigma)
    l11 = math.sqrt(max(s11, 1e-6))
    l21 = s12 / l11
    return {"l11": l11, "l21": l21, "l22": math.sqrt(max(s22 - l21**2, least * max(s22, 1e-6)))}


def beam_free(beams: Mapping[str, Mapping[str, float]]) -> list[Free]:
    """The beam's numbers as free ones: l11 and l22 positive."""
    free = []
    for plane, numbers in beams.items():
        angle = float(np.hypot(numbers["l21"], numbers["l22"]))
        reach = {
            "l11": (0.5 * numbers["l11"], 1.5 * numbers["l11"]),
            "l21": (-angle, angle),
            "l22": (0.1 * angle, angle),
        }
        for name in numbers:
            low = -np.inf if name == "l21" else 1e-6
            free.append(Free(f"beam.{plane}.{name}", low, np.inf, reach[name]))
    return free


def beam_problem(
    seen: PreparedScan,
    rows: Mapping[str, Any] | None = None,
    model: Mapping[str, Any] = MappingProxyType({}),
    free: Iterable[Free] = (),
    records: Iterable[Record] = (),
    priors: Iterable[Prior] = (),
    constraints: Iterable[Constraint] = (),
) -> Problem:
    """The beams and the sizes of their rows, by plane, with what else a scenario has."""
    beams, rows = beam_numbers(seen), rows or {p: seen.of_plane(p) for p in seen.planes}
    sizes = [size_record(seen, plane, own) for plane, own in rows.items()]
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
    """Look at a scan through its line, and at what its sizes say of a beam.

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
    return with_posteriors(looked_through([unfitted(scan, line, planes, method, noise, weights)]))[
        0
    ]


def of_one_beam(
    scan: QuadScan, line: Beamline | None, scenario: str = "known"
) -> tuple[QuadScan, Beamline]:
    """A scan of one beam with total energies, one row a setting, and its line.

    Raises
    ------
    InputError
        If it is of several slices, or its matrices are both given and unknown.
    """
    if len(scan.slices) > 1:
        found = f"a scan of {len(scan.slices)} slices of the beam"
        raise scan.unusable(found, "rows of one, as scan.of_slice(name) gives")
    line = rows_line(scan) if line is None else line
    own = "rows with matrices of their own"
    if scan.transfer and (line.magnets or float(line.length) > 0.0):
        raise scan.unusable(f"{own} and a line", "one of the two")
    if scan.transfer and scenario != "known":
        expected = "scenario known, or settings and a lattice"
        raise scan.unusable(f"scenario {scenario} for {own}", expected)
    return of_settings(scan.of_particle(line.mass)), line


def unfitted(
    scan: QuadScan,
    line: Beamline,
    planes: tuple[str, ...] | None = None,
    method: str = METHODS[0],
    noise: Noise | None = None,
    weights: str = WEIGHTS[0],
) -> PreparedScan:
    """The scan and its line as `prepare` has them, without the look and the posterior."""
    check_names(scan, *names_of(line))
    asked = planes or scan.planes
    for plane in asked:
        scan.rows(plane)  # says so if it was not measured
    scanned = scanned_line(scan, line)
    check_gradients(scan, scanned)
    rows = scan_rows(scan, scanned, method == METHODS[0])
    return PreparedScan(
        scan, line, scanned, asked, method, weights, rows, noise or Noise(), None, {}
    )


def looked_through(begun: Sequence[PreparedScan]) -> list[PreparedScan]:
    """Look at scans through their lines; those whose rows have one shape are one call."""
    found, alike = list(begun), {}
    for i, seen in enumerate(begun):
        leaves, kind = jax.tree.flatten(seen.rows)
        alike.setdefault((kind, *map(np.shape, leaves)), []).append((i, leaves))
    for (kind, *shapes), members in alike.items():
        room = max(ROOM // max(map(np.prod, shapes)) ** 2, 1)
        lanes = min(int(room), LANES, 1 << (len(members) - 1).bit_length())
        for start in range(0, len(members), lanes):
            own = members[start : start + lanes]
            columns = zip(
                *(leaves for _, leaves in own + own[-1:] * (lanes - len(own))), strict=True
            )
            looks = np.asarray(_looks([np.stack(c) for c in columns], kind))
            for lane, (i, _) in enumerate(own):
                found[i] = begun[i]._replace(look=looks[lane])
    return found


@partial(jax.jit, static_argnums=1, compiler_options=SELDOM)
def _looks(columns: list, kind: Any) -> Any:
    return jax.vmap(lambda leaves: look_through(jax.tree.unflatten(kind, leaves)))(columns)


def with_posteriors(begun: Sequence[PreparedScan]) -> list[PreparedScan]:
    """The same scans with the posterior of every plane; all with one noise and one method."""
    if not begun:
        return []
    own = [{plane: plane_sizes(seen, plane) for plane in seen.planes} for seen in begun]
    sizes = [each for planes in own for each, _ in planes.values()]
    found = iter(compare(sizes, begun[0].noise, begun[0].method, begun[0].weights))
    every = []
    for seen, planes in zip(begun, own, strict=True):
        solutions = {
            plane: _work(seen, plane, each, next(found), shots)
            for plane, (each, shots) in planes.items()
        }
        every.append(seen._replace(solutions=solutions))
    return every


def plane_sizes(seen: PreparedScan, plane: str) -> tuple[PlaneSizes, ShotMeans | None]:
    """The sizes of a plane with their errors, and what its shots say."""
    scan, at, i = seen.scan, seen.measured(plane), "xy".index(plane)
    r11, r12, known = seen.look[:, i, at]
    size, error, shots = scan.size[plane][at], scan.error.get(plane), None
    if plane in scan.shot_size and (shots := means_of(scan.shot_size[plane][at], seen.noise)):
        size, error = shots.size, shots.error
    elif error is not None:
        error = error[at]
        freedom = np.zeros(1) if scan.shots is None else np.asarray(scan.shots, float)[at] - 1.0
        if freedom.sum() > 0:
            square = error**2 * (freedom + 1.0) * freedom
            error = np.sqrt(evened(square, freedom, size) / (freedom + 1.0))
    counted = scan.shots is not None and bool((np.asarray(scan.shots) > 1).any())
    of_shots = shots is not None or (error is not None and counted)
    screens = {seen.rows.places[j] for j in seen.rows.which[at]}
    moved = any(np.ptp(v[at]) > 0 for v in scan.settings.values()) or len(screens) < 3
    return PlaneSizes(r11, r12, known, size, error, of_shots, moved), shots


def _work(
    seen: PreparedScan, plane: str, sizes: PlaneSizes, post: PlanePosterior, shots: ShotMeans | None
) -> PlaneSolution:
    scan, at, follows = seen.scan, seen.measured(plane), seen.weights == WEIGHTS[0]
    points = Points(
        settings={name: v[at] for name, v in scan.settings.items()},
        units={name: SETTING_UNITS[scan.units[name]] for name in scan.settings},
        screen=tuple(seen.rows.places[j] for j in seen.rows.which[at]),
        size=sizes.size,
        error=post.error,
        weighed=post.model if follows else sizes.size,
        relative=post.relative if follows else 0.0,
        model=post.model,
        pull=np.zeros(len(at)),
        outlier_probability=post.bad,
        r11=sizes.r11,
        r12=sizes.r12,
        known=sizes.known,
    )
    points = points.with_model(post.model, seen.rows.squared)
    return PlaneSolution(sizes, post, points, _shot_words(points, shots))


def _shot_words(p: Points, shots: ShotMeans | None) -> str:
    """Count and name the shots that surely show no beam."""
    if shots is None:
        return ""
    lost, said = np.argwhere(np.nan_to_num(shots.bad) > 0.99), []
    if len(lost):
        count, are = int((~np.isnan(shots.bad)).sum()), "are" if len(lost) > 1 else "is"
        places = named([f"shot {j + 1} at {p.where(i)}" for i, j in lost])
        said.append(f"{len(lost)} of {count} shots {are} left out, no beam there: {places}.")
    if shots.scatter > UNSTEADY:
        said.append(
            f"Shots of one setting scatter by {100 * shots.scatter:.2g} %: the beam changes from "
            "shot to shot, and this is that of the mean sizes."
        )
    return " ".join(said)


# Nothing but the beam is unknown; as a problem for those who want more than the posterior.
SCENARIO = Scenario("known", lambda seen, _told: beam_problem(seen), closed=True)
