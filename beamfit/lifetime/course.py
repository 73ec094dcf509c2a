"""Lifetime over weeks: normalised, with control limits, and watched for changes of a and b."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from beamfit.answer import Table, answer, cell, json_of
from beamfit.errors import Finding, InputError, Judged
from beamfit.lifetime.alarm import WANDER, Alarm, Reference, alarms_of, when
from beamfit.lifetime.alternatives import constant_a
from beamfit.lifetime.fit import DecayFit, bare
from beamfit.lifetime.mechanisms import Losses, loss_coefficients
from beamfit.lifetime.scales import by_losses, summarise, widened
from beamfit.lifetime.study import Decay, Machine, RecordStudy
from beamfit.quantity import HOUR, Quantity, Status, percent, relative_change
from beamfit.statistics import (
    MIN_BASELINE,
    THREE_SIGMA,
    baseline,
    control_limits,
    one_sided_probability,
    reach_of,
)

# Where readings do not tell a from b, the ring's own shares of them are trusted to this.
SHARES = 0.3
# No monitor is better than this share of the current.
BEST_MONITOR = 1e-7
# Points of a course that records of top-up are divided into.
MOST_PARTS = 48
# More readings are watched every second, third, ... one.
MOST = 50_000


class CoursePoint(NamedTuple):
    """One decay.

    Attributes
    ----------
    record : str
        Name of the decay.
    time : float
        Of its first reading: Unix time, or s from the start of the record.
    current : float
        Mean current, mA.
    lifetime : Quantity
        At the mean current, h.
    normalised : Quantity
        Current times lifetime, at the reference current and settings where a ring is given, mA h.
    a, b : Quantity or None
        Over the usual ones, of 1; None where the decay does not determine or refutes them.
    beyond : int
        +1 above the control limits, -1 below, 0 within.
    """

    record: str
    time: float
    current: float
    lifetime: Quantity
    normalised: Quantity
    a: Quantity | None
    b: Quantity | None
    beyond: int


@answer
@dataclass(frozen=True, eq=False)
class Trend(Judged):
    """Many decays in order of time.

    Parameters
    ----------
    points : tuple of CoursePoint
        The decays whose lifetime is determined.
    current : float
        Reference current, mA.
    scaled : bool
        Whether lifetimes are scaled by the ring to the reference current and its usual settings.
    centre, limit : float
        Usual normalised lifetime, mA h, and how far from it the control limits are.
    drift : Quantity
        Relative change of the normalised lifetime in a week.
    reference : Reference or None
        Usual a and b; None where the first decays do not give them.
    alarms : tuple of Alarm
        Of the readings after the first decays.
    dated : bool
        Whether times are Unix times.
    """

    points: tuple[CoursePoint, ...]
    current: float
    scaled: bool
    centre: float
    limit: float
    drift: Quantity
    reference: Reference | None
    alarms: tuple[Alarm, ...]
    dated: bool

    @cached_property
    def finding(self) -> Finding:
        """`converged` if all is usual, `poor_fit` if an alarm was raised or a lifetime lies
        beyond the limits, `unidentified` if there are too few lifetimes to say what is usual.
        """
        count, centre = len(self.points), self.centre
        many = f"{count} lifetime" + "s" * (count > 1)
        usual = f"{many}; current times lifetime is usually {centre:.4g} mA h"
        if not math.isfinite(self.limit):
            more = f"{MIN_BASELINE + 1} or more decays are needed to say what is usual."
            return Finding(Status.unidentified, f"{usual}; {more}")
        beyond = sum(point.beyond != 0 for point in self.points)
        said = f"{usual} ± {percent(self.limit / centre)}, {beyond} beyond that."
        drift = self.drift
        if drift.error is not None and _is_sure(abs(drift.value) / drift.error, count - 2):
            said += f" It changes by {relative_change(drift)} a week."
        if self.reference is None:
            said += " Readings are not watched: the first decays tell no usual a and b above zero."
        if self.alarms:
            first = "Alarm" if len(self.alarms) == 1 else f"{len(self.alarms)} alarms, the first"
            said += f" {first}: {self.alarms[0].said(self.dated)}."
        return Finding(Status.poor_fit if beyond or self.alarms else Status.converged, said)

    @property
    def headline(self) -> str:
        """The verdict in a line."""
        return f"{cell(self.status)}: {self.message}"

    def tables(self) -> tuple[Table, ...]:
        """Every lifetime, and every alarm."""
        header = ["decay", "from", "I, mA", "τ, h", "I τ, mA h", "a, %", "b, %", ""]
        records = {point.record.partition("#")[0] for point in self.points}
        shared = records.pop() if len(records) == 1 else ""
        rows = [
            [
                point.record.removeprefix(shared) or shared,
                when(point.time, self.dated).partition("-")[2] or when(point.time, self.dated),
                f"{point.current:.4g}", f"{point.lifetime.value:.4g}",
                f"{point.normalised.value:.5g}", _percent(point.a), _percent(point.b),
                {1: "above", 0: "", -1: "below"}[point.beyond],
            ]
            for point in self.points
        ]  # fmt: skip
        by = f"by the ring to {self.current:.4g} mA" if self.scaled else "as measured"
        note = f"I τ is current times lifetime, {by}; a and b are over the usual ones."
        tables = [Table("Course of the lifetime", header, rows, note, numeric=True)]
        if self.alarms:
            rows = [[when(alarm.time, self.dated), alarm.said(self.dated)] for alarm in self.alarms]
            tables.append(Table("Alarms", ["raised", "what"], rows))
        return tuple(tables)

    def to_json(self) -> dict[str, Any]:
        """Return the points, what is usual, and the alarms as JSON's types."""
        usual = self.reference
        known = usual and {"a": bare(usual.a, "1/(mA s)"), "b": bare(usual.b, "1/s"),
                           "exponent": bare(usual.power, "1")}  # fmt: skip
        named = ("status", "message", "points", "drift", "alarms")
        rest = {
            "current": bare(self.current, "mA"),
            "scaled_by_ring": self.scaled,
            "centre": bare(self.centre, "mA h"),
            "limit": bare(self.limit, "mA h"),
            "reference": known,
        }
        return json_of({name: getattr(self, name) for name in named} | rest)


def _percent(ratio: Quantity | None) -> str:
    if ratio is None:
        return "-"
    error = f" ± {100 * ratio.error:.2f}" if 100 * ratio.error >= 0.005 else ""
    return f"{100 * ratio.value:.2f}{error}"


def trend_of(studies: Sequence[RecordStudy], machine: Machine | None = None) -> Trend:
    """Follow the lifetime through many decays.

    Parameters
    ----------
    studies : sequence of RecordStudy
        Records, each with its decays; of several, all with dates. Top-up is divided into parts.
    machine : Machine, optional
        The ring, which scales lifetimes to its usual settings and the reference current, the
        median of all. Otherwise current times lifetime is taken as it is, which is constant where
        all loss goes with the square of the current.

    Returns
    -------
    Trend
        With control limits from the first decays, 20 or half of them, and with the alarms of
        `beamfit.lifetime.alarm` on all readings after those.

    Raises
    ------
    InputError
        If several records are not all dated.

    Examples
    --------
    >>> import beamfit
    >>> trend_of([beamfit.study("measurements/aps_1999_decay.csv")]).status.value
    'unidentified'

    Notes
    -----
    Limits are those of an individuals chart (D. C. Montgomery, Introduction to Statistical Quality
    Control, 7th ed., section 6.4): 3 standard deviations, these from the mean moving range over
    1.128, which a slow drift does not widen; Student's quantile, since they come from few points.
    """
    if len(studies) > 1 and any(study.record.start is None for study in studies):
        name = next(study.record.name for study in studies if study.record.start is None)
        raise InputError("times without a date", "dated records, to put them in order", path=name)
    dated = all(study.record.start is not None for study in studies)
    studies = sorted(studies, key=lambda study: study.record.start or 0.0)
    placed = [
        ((study.record.start or 0.0) + decay.offset, decay)
        for study in studies
        for each in study.decays or study.pooled
        for decay in each.parts(max(MOST_PARTS // len(studies), 1), machine)
        if decay.fit.lifetime_mean.error is not None
    ]
    if not placed:
        expected = "one decay at least whose lifetime is determined"
        raise InputError("no lifetime", expected, path=studies[0].record.name)
    times, decays = zip(*placed, strict=True)
    current, ring = float(np.median([decay.fit.mean_current for decay in decays])), None
    a = b = np.ones(len(decays))
    if machine is not None:
        ring = loss_coefficients(*machine, current)
        losses = [decay.budget.losses for decay in decays]
        a, b = np.array([(own.a / ring.a, own.b / ring.b) for own in losses], float).T
    first = baseline(len(decays))
    watched = len(decays) > first
    usual = reference_of(decays[:first], a[:first], b[:first]) if watched else None
    values = [normalised(decay, ring, current) for decay in decays]
    centre, limit = control_limits(np.array([value.value for value in values[:first]]))
    points = tuple(
        _point(*of_decay, usual, (centre, limit))
        for of_decay in zip(decays, times, a, b, values, strict=True)
    )
    drift = _drift(np.array(times), values, centre)
    alarms = () if usual is None else _alarms(studies, usual, times[first:], a[first:], b[first:])
    scaled = machine is not None
    return Trend(points, current, scaled, centre, limit, drift, usual, alarms, dated)


def normalised(decay: Decay, ring: Losses | None, current: float) -> Quantity:
    """Current times lifetime, mA h: by a ring's usual losses at a current, or as measured."""
    found, by = decay.fit.lifetime_mean, decay.fit.mean_current
    if ring is not None:
        rate = float(ring.a * current + ring.b)
        by = current / (decay.budget.lifetime * HOUR * rate)
    return Quantity(by * found.value, by * found.error, "mA h")


def _point(
    decay: Decay, time: float, a: float, b: float, value: Quantity, usual: Reference | None, limits
) -> CoursePoint:
    centre, limit = limits
    off = value.value - centre
    beyond = int(np.sign(off)) if abs(off) > max(limit, 3 * value.error) else 0
    fit = decay.fit
    relative: list[Quantity | None] = [None, None]
    law = fit.free_law
    same = usual is not None and not usual.power and fit.status is not Status.poor_fit
    if same and (law is None or law.beside is None):
        relative = [
            None if q.error is None else Quantity(q.value / by, q.error / by, "1")
            for q, by in ((fit.if_constant("a"), usual.a * a), (fit.if_constant("b"), usual.b * b))
        ]
    return CoursePoint(
        fit.record, time, fit.mean_current, fit.lifetime_mean, value, *relative, beyond
    )


def _drift(time: np.ndarray, values: Sequence[Quantity], centre: float) -> Quantity:
    """Relative slope by least squares, its error from the residuals."""
    if len(values) < MIN_BASELINE + 1 or np.ptp(time) < 24 * HOUR:
        return Quantity(math.nan, None, "1")
    level = np.array([value.value for value in values]) / centre
    weeks = (time - time.mean()) / (7 * 24 * HOUR)
    [slope, _], covariance = np.polyfit(weeks, level, 1, cov=True)
    error = float(np.sqrt(covariance[0, 0]))
    return Quantity.reaching(float(slope), error, "1", None, reach_of(level.size - 2) * error)


def reference_of(
    decays: Sequence[Decay], a: np.ndarray, b: np.ndarray, ring: Losses | None = None
) -> Reference | None:
    """Usual a and b of some decays, with their noise; None where they do not give both above zero,
    or the loss rate falls with the current as no bunch length makes it.

    Where several together reject a constant a it goes as the power of the current that they show.

    Least squares on what each decay says of a I and a I + b; with a ring its ratio of a to b is
    known, to `SHARES`. How far the decays scatter beyond that is how far a and b are expected to
    differ from decay to decay, and the errors of each contain it.
    """
    power = power_of([decay.fit for decay in decays])
    # One decay alone does not tell an exponent from a monitor or a vacuum that wanders.
    if power > 0 or (power and len(decays) == 1):
        return None
    current, parts, root = map(np.asarray, summarise(decays, power))
    if not root.any():  # many cycles say nothing of an exponent
        return None
    usual = float(np.median(current))
    rows, known = by_losses(a * current * (current / usual) ** power, b), np.zeros(2)
    if ring is not None:
        by = parts[0, 1] / float(ring.a * current[0] + ring.b)
        known = np.array([1 / float(ring.a), -1 / float(ring.b)]) / by / SHARES
    found, _ = _common(rows, parts, root, known)
    quadratic = np.clip(parts[:, 0], 0.0, parts[:, 1])
    own = by_losses(quadratic, parts[:, 1] - quadratic)
    off, share = parts[:, 1] - (rows @ found)[:, 1], np.sum(own[:, 1] ** 2, axis=1).mean()
    # One more decay, as of an ordinary day, for few of them.
    wander = math.sqrt((float(off @ off) / share + WANDER**2) / max(off.size - 1, 1))
    found, relative = _common(rows, parts, np.asarray(widened(root, wander * own)), known)
    if not (np.isfinite(found).all() and found.min() > 0):
        return None
    covariance = np.linalg.pinv(relative.T @ relative, hermitian=True) + WANDER**2 * np.eye(2)
    noise, time, interval, white = np.median([_noise(decay.fit, power) for decay in decays], axis=0)
    return Reference(*map(float, found), noise, time, interval, covariance, max(white, 0.0),
                     wander, power, usual)  # fmt: skip


def _common(
    rows: np.ndarray, parts: np.ndarray, root: np.ndarray, known: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """a and b of all decays by least squares, and slopes of what is known, over its errors, by
    relative changes of them; `known` is a further combination that is zero within 1.
    """
    weighted = np.vstack([(root @ rows).reshape(-1, 2), known])
    seen = np.append(np.einsum("nij,nj->ni", root, parts), 0.0)
    size = np.linalg.norm(weighted, axis=0)
    found = np.linalg.lstsq(weighted / size, seen, rcond=None)[0] / size
    return found, weighted * found


def power_of(fits: Sequence[DecayFit]) -> float:
    """The power of the current as which a goes where decays together reject a constant one, by the
    mean of their exponents; where these scatter more than their errors, by their scatter. 0 else.
    """
    found = [fit.constant_a.exponent for fit in fits if fit.constant_a is not None]
    told = [(float(q.value), float(q.error)) for q in found if q.error]
    if not told:
        return 0.0
    value, error = np.array(told).T
    mean, whole = np.average(value, weights=error**-2), np.sum(error**-2) ** -0.5
    squares = float(np.sum(((value - mean) / error) ** 2))
    whole *= math.sqrt(max(squares / max(value.size - 1, 1), 1.0))
    chance = 2 * one_sided_probability(abs(mean) / whole, math.inf)
    refuted = constant_a(mean, whole, whole, chance).status is Status.poor_fit
    return float(mean) if refuted else 0.0


def _noise(fit: DecayFit, power: float) -> tuple[float, float, float, float]:
    """Noise of a reading, mA, its correlation time, the interval of readings, s, and the share of
    the variance without memory, where a goes as a power of the current.

    The size is that of changes from reading to reading: how far noise with a long memory gets the
    residuals of one decay do not tell.
    """
    interval, time = float(np.median(np.diff(fit.readings.time))), fit.correlation_time or 0.0
    alike, rest = fit.identifiability.residual_correlation or 0.0, fit.residuals
    if power and fit.first is None:
        about = fit.with_power(power)
        rest, found = about.off, about.memory(about.columns(), False)
        time = found.noise.time if about.wanders else 0.0
        alike = (1 - found.noise.white) * math.exp(-interval / time) if time else 0.0
    white = 1 - alike * math.exp(interval / time) if alike else 0.0
    size = math.sqrt(float(np.mean(np.diff(rest) ** 2)) / (2 * (1 - alike)))
    return max(size, BEST_MONITOR * fit.mean_current), time if alike else 0.0, interval, white


def _alarms(
    studies: Sequence[RecordStudy],
    usual: Reference,
    times: Sequence[float],
    a: np.ndarray,
    b: np.ndarray,
) -> tuple[Alarm, ...]:
    """Watch all readings from the first of some decays on; a and b are the ring's at each."""
    rows = [
        np.stack([(study.record.start or 0.0) + study.record.time, study.record.current], axis=-1)
        for study in studies
    ]
    rows = np.concatenate(rows)
    rows = rows[rows[:, 0] >= times[0]]
    rows = rows[:: math.ceil(len(rows) / MOST)]
    place = np.searchsorted(times, rows[:, 0], side="right") - 1
    return alarms_of(usual, *rows.T, a[place], b[place])


def _is_sure(errors: float, dof: int) -> bool:
    """Tell if a change is as rare by chance as a point beyond the control limits."""
    return one_sided_probability(errors, dof) < 1 - THREE_SIGMA
