"""A scenario: the value that states a scan as a problem, with its null spaces."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from beamfit.emittance.assumptions import SCENARIOS, Assumptions
from beamfit.emittance.comparison import PlanePosterior, PlaneSizes
from beamfit.emittance.model import UNIT, Asked, predict_sizes
from beamfit.emittance.results import Parameter, Points
from beamfit.emittance.scan import QuadScan
from beamfit.emittance.transport import Look, Rows, padded, scan_rows
from beamfit.greybox.problem import Constraint, Free, Prior, Problem, Record
from beamfit.noise.model import Noise
from beamfit.optics.beamline import Beamline

if TYPE_CHECKING:
    from beamfit.greybox.fit import Fit


class Work(NamedTuple):
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


class Seen(NamedTuple):
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
    look : Look
        The same, with every magnet as the lattice has it; NumPy arrays.
    works : dict of str to Work
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
    look: Look
    works: dict[str, Work]
    kept: tuple[str, ...] = ()
    any_energy: bool = False

    def of_plane(self, plane: str, settings: Mapping[str, Any] | None = None) -> Rows:
        """The rows of one plane, with other settings if any are given."""
        return replace(self.rows, plane=plane, settings=settings or self.rows.settings)

    def keeping(self, names: Iterable[str], any_energy: bool = False) -> Seen:
        """The same with rows in which further elements, or the energy, may change."""
        kept, free = (*self.kept, *names), self.any_energy or any_energy
        rows = scan_rows(self.scan, self.scanned, self.rows.squared, kept, free)
        return self._replace(rows=rows, kept=kept, any_energy=free)

    def measured(self, plane: str) -> np.ndarray:
        """Indices of the rows in which a plane was measured."""
        return np.flatnonzero(~np.isnan(self.scan.size[plane]))

    def known_at(self, line: Beamline, place: str) -> tuple[float, float, float]:
        """Energy spread, resolution (m) and energy (MeV) of a further row on a screen of a line.

        What the scan itself says, in the middle of its rows (of the resolution those on that
        screen), goes before the line.
        """
        scan = self.scan
        spread = line.energy_spread if scan.energy_spread is None else np.median(scan.energy_spread)
        screens = scan.screen or self.rows.places[-1:] * len(scan)
        resolution = getattr(line[place], "resolution", 0.0)
        if scan.resolution is not None and place in screens:
            resolution = np.median(scan.resolution[np.array(screens) == place])
        return float(spread), float(resolution), self.energy

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
    state: Callable[[Seen, Assumptions], Problem]
    parameters: Callable[[Seen, Assumptions, Fit], Iterator[Parameter]] = lambda *_: iter(())
    null_directions: Callable[[Seen, tuple[Parameter, ...], bool], tuple[str, ...]] = lambda *_: ()
    remedy: Callable[[Seen, Assumptions], str] = lambda *_: ""
    aside: str = ""
    closed: bool = False
    network: bool = False
    whole_map: bool = True


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


def asked_of(seen: Seen, plane: str, whole_map: bool = True, line: Beamline | None = None) -> Asked:
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


def size_record(seen: Seen, plane: str, rows: Any) -> Record:
    """The measured sizes of a plane, in µm² or µm, with the errors that the posterior found.

    Rows without a size have weight 0, and so has padding.
    """
    points, at = seen.works[plane].points, seen.measured(plane)
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
    problem: Problem, seen: Seen, planes: Iterable[str], whole_map: bool
) -> tuple[Asked, ...]:
    """Places of the planes' numbers, through the lines that a problem has."""
    records = size_records(problem)
    lines = {plane: records[plane].data.line if whole_map else None for plane in planes}
    return tuple(asked_of(seen, plane, whole_map, line) for plane, line in lines.items())


def beam_numbers(seen: Seen) -> dict[str, dict[str, float]]:
    """Cholesky factors to start from: the known-transport fit, kept off zero emittance."""
    return {plane: factor_of(seen.works[plane].posterior.best, 0.0025) for plane in seen.planes}


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
    seen: Seen,
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
