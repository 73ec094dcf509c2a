"""The tuning fit: from a scan of knobs and a line to the setting of the lowest emittance."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.special import expit

from beamfit.answer import Table, answer, cell, json_of
from beamfit.emittance.comparison import BEAM, CONSTANT, MODELS, RANDOM
from beamfit.emittance.results import in_words
from beamfit.emittance.scan import KNOB, QuadScan
from beamfit.emittance.statement import PreparedScan, varied_magnets
from beamfit.emittance.transport import setting_units
from beamfit.emittance.verdict import REMEDIES, SURE
from beamfit.errors import Finding, InputError, Judged, Status, expect, judge
from beamfit.noise.model import Noise
from beamfit.optics.beamline import Beamline
from beamfit.optics.calibration import SETTING_UNITS
from beamfit.particles import beta_gamma
from beamfit.quantity import Quantity, percent
from beamfit.statistics import CENTRAL, WIDE, quantity_of_draws
from beamfit.tuning.knob_map import map_posterior, mix_draws, numbers_at
from beamfit.tuning.knobs import GOALS, EmittanceTable, Knobs, knobs_of, planes_of
from beamfit.tuning.minimum import (
    Emittances,
    Minima,
    NextRow,
    PlaneMap,
    emittances_of,
    minima_of,
    next_row,
    values_at,
)
from beamfit.tuning.readings import (
    emittance_readings,
    log_no_beam,
    plane_readings,
    prepare_without_knobs,
)

# Number of draws of the map: the ends of a 95 % interval are then known to a tenth of its
# half-width.
DRAWS = 256
# Largest probability of a constant emittance for it to be excluded, and of missing the goal for a
# setting to be accepted.
MAX_DOUBT = 0.05
# Prior odds that the sizes are not of a beam, as for scans.
NO_BEAM = (MODELS[RANDOM] + MODELS[CONSTANT]) / MODELS[BEAM]
# A minimum within this many half ranges of a limit is at the limit.
LIMIT_TOLERANCE = 1e-6


class TuningBand(NamedTuple):
    """Values along settings with their central 68 and 95 % intervals, arrays of shape (m,)."""

    value: np.ndarray
    low: np.ndarray
    high: np.ndarray
    low_95: np.ndarray
    high_95: np.ndarray

    @classmethod
    def from_draws(cls, draws: np.ndarray) -> TuningBand:
        """Take quantiles over draws, shape (d, m)."""
        return cls(np.median(draws, 0), *np.quantile(draws, (*CENTRAL, *WIDE), axis=0))


def fit_tuning(
    scan: QuadScan | EmittanceTable,
    line: Beamline | None,
    knobs: Mapping[str, tuple[float, float]],
    *,
    goal: str = "emittance",
    within: float = 0.05,
    noise: Noise | None = None,
    draws: int = DRAWS,
    seed: int = 1,
    room: int = 0,
) -> TuningFit:
    """Find the setting of a machine's knobs with the lowest emittance, with its error.

    Parameters
    ----------
    scan : QuadScan, EmittanceTable or path
        Sizes at settings of quadrupoles and knobs, in any order; a whole scan at each setting of
        the knobs is not needed. A knob is one of its ``settings``, in the unit "knob" if it is no
        magnet. Or finished emittances at settings of the knobs.
    line : Beamline, path or None
        Beamline from the point of the emittance to the screens; None for rows with matrices, and
        for finished emittances.
    knobs : mapping of str to (float, float)
        Limits of each knob, by name.
    goal : {"emittance", "emittance_x", "emittance_y"}
        Emittance to be minimised; "emittance" is the geometric mean of the measured planes.
    within : float
        Relative distance from the minimum that is good enough, for the stop rule.
    noise : Noise, optional
        Priors of the noise of sizes; `beamfit.Noise()` if None.
    draws, seed : int
        Number of draws of the map, and seed of their random numbers.
    room : int
        Expected number of rows of a growing table: one compiled program then serves all lengths.

    Returns
    -------
    TuningFit
        Place and value of the minimum with intervals; `print` it.

    Raises
    ------
    InputError
        If knobs, limits, line or goal do not fit the scan.

    Notes
    -----
    ε², ln β and α of each plane are Gaussian processes of the knobs; a size follows from the
    transport of that beam through the line (report eq. 37). The answer is averaged over lengths,
    amplitudes and noise; see docs/tuning.md.

    Examples
    --------
    >>> import beamfit
    >>> knobs = {"SOL": (190, 210), "phase_deg": (-12, 12)}
    >>> scan = beamfit.read_tuning_scan("measurements/gun_tuning_simulated.csv", knobs)
    >>> fit = beamfit.fit_tuning(scan, beamfit.load_lattice("lattices/gun_tuning.toml"), knobs)
    >>> fit.headline[:43]
    'converged: normalised emittance 0.755 ± 0.0'
    """
    expect(scan, QuadScan | EmittanceTable, "beamfit.read_tuning_scan(path, knobs)")
    expect(knobs, Mapping, '{"SOL": (180.0, 220.0)}')
    if not (within > 0.0 and draws > 1):
        raise InputError(f"{draws} draws, within {within:g}", "2 or more, and a positive share")
    planes, tuned, noise = planes_of(scan, goal), knobs_of(scan, knobs), noise or Noise()
    seen, log_none = None, [-math.inf] * len(planes)
    if isinstance(scan, EmittanceTable):
        if line is not None:
            raise scan.unusable("a line beside finished emittances", "none: they need no optics")
        readings = [emittance_readings(scan, plane, tuned, noise, room) for plane in planes]
    else:
        seen = prepare_without_knobs(scan, line, tuned, noise)
        readings = [plane_readings(seen, plane, tuned, scan.settings, room) for plane in planes]
        log_none = [log_no_beam(r.readings) + math.log(NO_BEAM) for r in readings]
    count, posteriors = len(tuned.names), []
    for i, r in enumerate(readings):
        arguments = r.readings, r.start, 2 * seed + i
        posteriors.append(map_posterior(*arguments, knobs=count, draws=draws))
    evidence = np.array([p.log_evidence for p in posteriors])
    of_a_beam = expit(np.logaddexp.reduce(evidence, axis=1) - math.log(2.0) - log_none).prod()
    flat = float(expit(np.diff(evidence.sum(axis=0))[0]))
    constant = np.random.default_rng(seed).permutation(draws) < round(flat * draws)
    mixed = [mix_draws(p, constant) for p in posteriors]
    maps = dict(zip(planes, map(PlaneMap, readings, mixed), strict=True))
    found = emittances_of(mixed)
    minima = jax.tree.map(np.asarray, minima_of(found, count))
    arguments = scan, seen, tuned, goal, within, noise, maps
    return TuningFit(*arguments, found, minima, flat, float(of_a_beam))


@answer
@dataclass(frozen=True, eq=False)
class TuningFit(Judged):
    """A map of the emittance over the knobs of a machine, and its minimum.

    Attributes
    ----------
    scan : QuadScan or EmittanceTable
        The table, with the knobs among its settings.
    seen : PreparedScan or None
        The prepared scan without the knobs; None for finished emittances.
    knobs : Knobs
        Names, limits and units.
    goal : str
        Emittance that is minimised.
    within : float
        Relative distance from the minimum that is good enough.
    noise : Noise
        Priors of the noise.
    maps : dict of str to PlaneMap
        Readings and map by plane.
    draws : Emittances
        Draws of ln of the goal.
    minima : Minima
        Lowest values of the draws and their places, in half ranges.
    flat : float
        Probability that no knob changes the emittance, with even prior odds.
    of_a_beam : float
        Probability that the sizes are those of a beam through this line.

    Examples
    --------
    >>> import beamfit
    >>> knobs = {"SOL": (190, 210), "phase_deg": (-12, 12)}
    >>> scan = beamfit.read_tuning_scan("measurements/gun_tuning_simulated.csv", knobs)
    >>> fit = beamfit.fit_tuning(scan, beamfit.load_lattice("lattices/gun_tuning.toml"), knobs)
    >>> fit.status.value, round(fit.place["SOL"].value)
    ('converged', 198)
    """

    scan: QuadScan | EmittanceTable
    seen: PreparedScan | None
    knobs: Knobs
    goal: str
    within: float
    noise: Noise
    maps: dict[str, PlaneMap]
    draws: Emittances
    minima: Minima
    flat: float
    of_a_beam: float

    @cached_property
    def place(self) -> dict[str, Quantity]:
        """Setting of each knob at which the emittance is lowest, with errors.

        A place has no error if the emittance may be constant, or the minimum anywhere between the
        limits.
        """
        places = self.knobs.settings(self.minima.place)
        best = self.knobs.settings(self.minima.best)
        ends = np.abs(np.quantile(self.minima.place, WIDE, axis=0)).min(axis=0)
        found = {}
        for i, (name, unit) in enumerate(self.units.items()):
            q = self._open_without_beam(quantity_of_draws(places[:, i], unit or "1", best[i]))
            determined = self.flat <= MAX_DOUBT and ends[i] < 1.0 - LIMIT_TOLERANCE
            found[name] = q if determined else q.open()
        return found

    def _open_without_beam(self, q: Quantity) -> Quantity:
        """Remove the error of a quantity if the sizes may be of no beam."""
        return q if self.of_a_beam > SURE else q.open()

    @property
    def settings(self) -> dict[str, float]:
        """Best setting of the knobs."""
        return {name: q.value for name, q in self.place.items()}

    @cached_property
    def minimum(self) -> Quantity:
        """Lowest normalised emittance between the limits, m."""
        return self._open_without_beam(
            quantity_of_draws(self.unit * np.exp(self.minima.value), "m")
        )

    @cached_property
    def _at_best(self) -> np.ndarray:
        """Value of every draw at the best setting, shape (d,)."""
        return np.asarray(values_at(self.draws, self.minima.best[None]))[:, 0]

    @cached_property
    def emittance(self) -> Quantity:
        """Normalised emittance at the best setting, m."""
        return self._open_without_beam(quantity_of_draws(self.unit * np.exp(self._at_best), "m"))

    @cached_property
    def excess(self) -> np.ndarray:
        """Emittance at the best setting over the minimum, less one, for every draw, shape (d,)."""
        return np.expm1(np.maximum(self._at_best - self.minima.value, 0.0))

    @property
    def boost(self) -> float:
        """Emittances of the answer over those of the maps: γβ, or 1 for finished emittances."""
        return beta_gamma(self.seen.energy, self.seen.line.mass) if self.seen else 1.0

    @property
    def unit(self) -> float:
        """Unit of the emittance whose logarithm the draws give, m."""
        own = np.prod([m.readings.emittance for m in self.maps.values()]) ** (1 / len(self.maps))
        return float(own * self.boost)

    @property
    def kind(self) -> str:
        """Kind of emittance: "normalized_emittance", or the "emittance" of a table."""
        normalized = self.seen is not None or self.scan.normalized
        return "normalized_emittance" if normalized else "emittance"

    @cached_property
    def edge(self) -> dict[str, float]:
        """Probability that the minimum is at a limit of each knob."""
        on = (np.abs(self.minima.place) >= 1.0 - LIMIT_TOLERANCE).mean(axis=0)
        return dict(zip(self.knobs.names, map(float, on), strict=True))

    @property
    def done(self) -> bool:
        """The best setting is within the goal of the minimum with 95 % probability."""
        close = float((self.excess > self.within).mean()) <= MAX_DOUBT
        return self.of_a_beam > SURE and self.flat <= MAX_DOUBT and close

    @cached_property
    def finding(self) -> Finding:
        """Status with its sentences."""
        return judge(self, RULES)

    @property
    def headline(self) -> str:
        """The best setting and the emittance there in one line."""
        best = in_words(self.settings, self.units)
        return f"{cell(self.status)}: {self._goal} {self.emittance} at {best}"

    @property
    def _goal(self) -> str:
        word = self.kind.replace("ized_", "ised ")
        if self.goal != GOALS[0]:
            return f"{word} {self.goal[-1]}"
        return f"mean {word}" if len(self.maps) > 1 else word

    @property
    def units(self) -> dict[str, str]:
        """Units of the knobs as written in messages; "" where the name contains it."""
        names = {**SETTING_UNITS, KNOB: ""}
        return {n: names[u] for n, u in zip(self.knobs.names, self.knobs.units, strict=True)}

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on the file, bad readings, and rows beyond the limits."""
        outside = (np.abs(self.knobs.half_ranges(self.scan.settings)) > 1.0).any(axis=1).sum()
        sentences = (
            [f"{outside} of {len(self.scan)} rows are beyond the limits."] if outside else []
        )
        for plane, m in self.maps.items():
            bad = np.flatnonzero(np.asarray(m.posterior.bad) > 0.5)
            rows = ", ".join(str(m.readings.rows[i] + 1) for i in bad)
            sentences += [f"Bad readings in {plane}: rows {rows}."] if rows else []
        return (*self.scan.notes, *sentences)

    def beam(self, settings: Mapping[str, Any]) -> dict[str, dict[str, TuningBand]]:
        """Predict the beam at settings of the knobs, with its band.

        Parameters
        ----------
        settings : mapping of str to float or array
            Settings of every knob, shape (m,) or one number for all.

        Returns
        -------
        dict of str to dict of str to TuningBand
            ``normalized_emittance`` (m), ``beta`` (m) and ``alpha`` at the start of the line by
            plane, and the minimised emittance under "goal". A table of emittances has `kind` alone.
        """
        x = self._half_ranges(settings)
        goal = self.unit * np.exp(np.asarray(values_at(self.draws, x)))
        found = {"goal": {self.kind: TuningBand.from_draws(goal)}}
        for plane, m in self.maps.items():
            numbers = np.asarray(numbers_at(m.posterior, x))
            emittance = m.readings.emittance * np.exp(numbers[..., 0])
            found[plane] = {self.kind: TuningBand.from_draws(self.boost * emittance)}
            if m.readings.coordinates is not None:
                sigma = m.readings.coordinates.sigma(_even_coordinates(numbers))
                found[plane]["beta"] = TuningBand.from_draws(sigma[..., 0] / emittance)
                found[plane]["alpha"] = TuningBand.from_draws(-sigma[..., 1] / emittance)
        return found

    @cached_property
    def next(self) -> NextRow | None:
        """Row with the most information about the minimum; None if no quadrupole was moved."""
        return next_row(self) if self.seen is None or varied_magnets(self.seen.scan) else None

    @property
    def next_words(self) -> str:
        """The next row in a sentence."""
        if self.next is None:
            return ""
        units = self.units
        if self.seen:
            units = units | setting_units(self.seen.scanned, self.seen.scan.settings)
        words = in_words(self.next.settings, units, 5)
        return f"Measure next at {words}: this row tells most about the minimum."

    def _half_ranges(self, settings: Mapping[str, Any]) -> np.ndarray:
        missing = [name for name in self.knobs.names if name not in settings]
        if missing:
            raise InputError(f"no setting of {missing[0]}", ", ".join(self.knobs.names))
        values = np.broadcast_arrays(*(np.atleast_1d(settings[n]) for n in self.knobs.names))
        return self.knobs.half_ranges(dict(zip(self.knobs.names, values, strict=True)))

    def to_json(self) -> dict[str, Any]:
        """Give the entry of ``results`` of the JSON contract."""
        found = {
            "status": self.status,
            "message": " ".join([self.message, *self.notes]),
            "goal": self.goal,
            "settings": self.place,
            "units": self.units,
            self.kind: self.emittance,
            "minimum": self.minimum,
            "excess_95": float(np.quantile(self.excess, 1.0 - MAX_DOUBT)),
            "within": self.within,
            "done": self.done,
            "at_limit": self.edge,
            "flat": self.flat,
            "of_a_beam": self.of_a_beam,
            "rows": len(self.scan),
            "next": self.next,
        }
        return json_of(found)

    def tables(self) -> tuple[Table, ...]:
        """Tables of the best setting, the emittance there, and their intervals."""
        rows = [
            [name, cell(q), cell(q.interval_words), percent(self.edge[name])]
            for name, q in self.place.items()
        ]
        lowest = {f"{self._goal} there": self.emittance, "lowest between the limits": self.minimum}
        rows += [[name, cell(q), cell(q.interval_words), ""] for name, q in lowest.items()]
        head = ["", "value", "95 % interval", "at a limit"]
        return (Table(f"Best setting, from {len(self.scan)} rows", head, rows),)


def _even_coordinates(numbers: jax.Array) -> np.ndarray:
    """Give T, T p_1, T p_2 of the scan's coordinates from ln ε, ln β, α; shape (..., 3)."""
    log_emittance, log_beta, alpha = np.moveaxis(np.asarray(numbers), -1, 0)
    emittance, beta = np.exp(log_emittance), np.exp(log_beta)
    s11, s22 = emittance * beta, emittance * (1.0 + alpha**2) / beta
    return np.stack([s11 + s22, s11 - s22, -2.0 * emittance * alpha], -1)


def _no_beam(fit: TuningFit) -> Finding | None:
    """Find that the sizes may be of no beam."""
    if fit.of_a_beam > SURE:
        return None
    cause = f"The sizes are of no beam through this line ({percent(1.0 - fit.of_a_beam)})."
    return Finding(Status.unidentified, cause, REMEDIES[RANDOM])


def _flat(fit: TuningFit) -> Finding | None:
    """Find that the emittance may be constant."""
    if fit.flat <= MAX_DOUBT:
        return None
    cause = f"The emittance is compatible with one value at all settings ({percent(fit.flat)})."
    return Finding(Status.unidentified, cause, "Measure more rows, or widen the limits.")


def _at_limit(fit: TuningFit) -> Finding | None:
    """Find that the minimum is more probably at a limit than inside."""
    at = {name: p for name, p in fit.edge.items() if p > 0.5}
    if not at:
        return None
    where = ", ".join(f"{name} ({percent(p)})" for name, p in at.items())
    cause = f"No minimum inside: it is at a limit of {where}. {_excess_words(fit)}"
    return Finding(Status.at_limit, cause, "Widen these limits if the machine allows it.")


def _excess_words(fit: TuningFit) -> str:
    worst = float(np.quantile(fit.excess, 1.0 - MAX_DOUBT))
    end = "Stop: that is the goal." if fit.done else "Measure more rows."
    return (
        f"The best setting is within {percent(worst)} of the minimum with 95 % probability; the "
        f"goal is {percent(fit.within)}. {end}"
    )


def _found(fit: TuningFit) -> Finding:
    return Finding(Status.converged, f"A minimum is found. {_excess_words(fit)}")


# In order of severity.
RULES = (_no_beam, _flat, _at_limit, _found)
