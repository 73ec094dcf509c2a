"""Trend of the normalised lifetime over weeks: control limits, and alarms on changes of a and b."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from beamfit.answer import Table, answer, cell, json_of
from beamfit.errors import Finding, InputError, Judged
from beamfit.lifetime.alarm import WANDER, Alarm, Reference, alarms_of, time_label
from beamfit.lifetime.alternatives import constant_a
from beamfit.lifetime.fit import DecayFit, bare
from beamfit.lifetime.mechanisms import Losses, loss_coefficients
from beamfit.lifetime.scales import add_errors, loss_part_slopes, summarise
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

# Relative error, chosen, of the ratio a/b by first principles, which is used where readings do not
# separate a and b.
RATIO_ERROR = 0.3
# Lowest noise of a reading, relative to the current: no monitor is better.
MIN_RELATIVE_NOISE = 1e-7
# Largest number of points into which records of top-up are divided: chosen, one each half hour
# of a day.
MAX_TREND_POINTS = 48
# Largest number of readings that are watched, chosen for speed; of more only every second, third,
# ... one.
MAX_WATCHED_READINGS = 50_000


class CoursePoint(NamedTuple):
    """One decay of a trend.

    Attributes
    ----------
    record : str
        Name of the decay.
    time : float
        Time of its first reading: Unix time, or s from the start of the record.
    current : float
        Mean current, mA.
    lifetime : Quantity
        Lifetime at the mean current, h.
    normalised : Quantity
        Current times lifetime, mA h; at the reference current and settings if a ring is given.
    a, b : Quantity or None
        Ratios to the usual a and b; None where the decay does not determine or refutes them.
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
    """Trend of the lifetime over many decays in order of time.

    Parameters
    ----------
    points : tuple of CoursePoint
        Decays whose lifetime is determined.
    current : float
        Reference current, mA.
    scaled : bool
        Whether lifetimes are scaled by the ring to the reference current and its usual settings.
    centre, limit : float
        Centre line and half width of the control limits of the normalised lifetime, mA h.
    drift : Quantity
        Relative change of the normalised lifetime in a week.
    reference : Reference or None
        Usual a and b; None where the first decays do not determine them.
    alarms : tuple of Alarm
        Alarms of the readings after the first decays.
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
        """Verdict: `poor_fit` if an alarm was raised or a lifetime lies beyond the limits.

        `unidentified` with too few lifetimes for control limits, else `converged`.
        """
        count, centre = len(self.points), self.centre
        lifetimes = f"{count} lifetime" + "s" * (count > 1)
        text = f"{lifetimes}; current times lifetime is usually {centre:.4g} mA h"
        if not math.isfinite(self.limit):
            missing = f"{MIN_BASELINE + 1} or more decays are needed to say what is usual."
            return Finding(Status.unidentified, f"{text}; {missing}")
        beyond = sum(point.beyond != 0 for point in self.points)
        text = f"{text} ± {percent(self.limit / centre)}, {beyond} beyond that."
        drift = self.drift
        if drift.error is not None and _is_significant(abs(drift.value) / drift.error, count - 2):
            text += f" It changes by {relative_change(drift)} a week."
        if self.reference is None:
            text += " Readings are not watched: the first decays tell no usual a and b above zero."
        if self.alarms:
            first = "Alarm" if len(self.alarms) == 1 else f"{len(self.alarms)} alarms, the first"
            text += f" {first}: {self.alarms[0].text(self.dated)}."
        return Finding(Status.poor_fit if beyond or self.alarms else Status.converged, text)

    @property
    def headline(self) -> str:
        """Verdict in a line."""
        return f"{cell(self.status)}: {self.message}"

    def tables(self) -> tuple[Table, ...]:
        """Tables of all lifetimes and of all alarms."""
        header = ["decay", "from", "I, mA", "τ, h", "I τ, mA h", "a, %", "b, %", ""]
        records = {point.record.partition("#")[0] for point in self.points}
        shared = records.pop() if len(records) == 1 else ""
        rows = [
            [
                point.record.removeprefix(shared) or shared,
                _without_year(time_label(point.time, self.dated)),
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
            rows = [
                [time_label(alarm.time, self.dated), alarm.text(self.dated)]
                for alarm in self.alarms
            ]
            tables.append(Table("Alarms", ["raised", "what"], rows))
        return tuple(tables)

    def to_json(self) -> dict[str, Any]:
        """Points, control limits, reference and alarms as JSON's types."""
        reference = self.reference and {
            "a": bare(self.reference.a, "1/(mA s)"),
            "b": bare(self.reference.b, "1/s"),
            "exponent": bare(self.reference.power, "1"),
        }
        named = ("status", "message", "points", "drift", "alarms")
        rest = {
            "current": bare(self.current, "mA"),
            "scaled_by_ring": self.scaled,
            "centre": bare(self.centre, "mA h"),
            "limit": bare(self.limit, "mA h"),
            "reference": reference,
        }
        return json_of({name: getattr(self, name) for name in named} | rest)


def _without_year(label: str) -> str:
    return label.partition("-")[2] or label


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
        Records with their decays; several records must all have dates. Top-up is divided into
        parts.
    machine : Machine, optional
        Ring by which lifetimes are scaled to its usual settings and to the reference current, the
        median of all decays. Without it current times lifetime stays as measured, which is
        constant only if all loss goes with the square of the current.

    Returns
    -------
    Trend
        Trend with control limits from the first decays, 20 or half of them, and with the alarms
        of `beamfit.lifetime.alarm` on all later readings.

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
    The limits are those of an individuals chart (D. C. Montgomery, Introduction to Statistical
    Quality Control, 7th ed., section 6.4): 3 standard deviations. The standard deviation is the
    mean moving range over 1.128, which a slow drift does not widen, and the factor 3 is replaced by
    Student's quantile, since there are few points.
    """
    if len(studies) > 1 and any(study.record.start is None for study in studies):
        name = next(study.record.name for study in studies if study.record.start is None)
        raise InputError("times without a date", "dated records, to put them in order", path=name)
    dated = all(study.record.start is not None for study in studies)
    studies = sorted(studies, key=lambda study: study.record.start or 0.0)
    dated_decays = [
        ((study.record.start or 0.0) + decay.offset, decay)
        for study in studies
        for each in study.decays or study.pooled
        for decay in each.parts(max(MAX_TREND_POINTS // len(studies), 1), machine)
        if decay.fit.lifetime_mean.error is not None
    ]
    if not dated_decays:
        expected = "one decay at least whose lifetime is determined"
        raise InputError("no lifetime", expected, path=studies[0].record.name)
    times, decays = zip(*dated_decays, strict=True)
    current, ring = float(np.median([decay.fit.mean_current for decay in decays])), None
    a = b = np.ones(len(decays))
    if machine is not None:
        ring = loss_coefficients(*machine, current)
        losses = [decay.budget.losses for decay in decays]
        a, b = np.array(
            [
                (losses_of_decay.a / ring.a, losses_of_decay.b / ring.b)
                for losses_of_decay in losses
            ],
            float,
        ).T
    first = baseline(len(decays))
    watched = len(decays) > first
    reference = reference_of(decays[:first], a[:first], b[:first]) if watched else None
    values = [normalised_lifetime(decay, ring, current) for decay in decays]
    centre, limit = control_limits(np.array([value.value for value in values[:first]]))
    points = tuple(
        _point(*of_decay, reference, (centre, limit))
        for of_decay in zip(decays, times, a, b, values, strict=True)
    )
    drift = _drift(np.array(times), values, centre)
    alarms = (
        ()
        if reference is None
        else _alarms(studies, reference, times[first:], a[first:], b[first:])
    )
    scaled = machine is not None
    return Trend(points, current, scaled, centre, limit, drift, reference, alarms, dated)


def normalised_lifetime(decay: Decay, ring: Losses | None, current: float) -> Quantity:
    """Current times lifetime, mA h: scaled to a ring's losses at a current, or as measured."""
    found, by = decay.fit.lifetime_mean, decay.fit.mean_current
    if ring is not None:
        rate = float(ring.a * current + ring.b)
        by = current / (decay.budget.lifetime * HOUR * rate)
    return Quantity(by * found.value, by * found.error, "mA h")


def _point(
    decay: Decay,
    time: float,
    a: float,
    b: float,
    value: Quantity,
    reference: Reference | None,
    limits,
) -> CoursePoint:
    centre, limit = limits
    deviation = value.value - centre
    beyond = int(np.sign(deviation)) if abs(deviation) > max(limit, 3 * value.error) else 0
    fit = decay.fit
    relative: list[Quantity | None] = [None, None]
    law = fit.free_law
    comparable = reference is not None and not reference.power and fit.status is not Status.poor_fit
    if comparable and (law is None or law.addition is None):
        relative = [
            None if q.error is None else Quantity(q.value / expected, q.error / expected, "1")
            for q, expected in (
                (fit.if_constant("a"), reference.a * a),
                (fit.if_constant("b"), reference.b * b),
            )
        ]
    return CoursePoint(
        fit.record, time, fit.mean_current, fit.lifetime_mean, value, *relative, beyond
    )


def _drift(time: np.ndarray, values: Sequence[Quantity], centre: float) -> Quantity:
    """Relative slope by least squares, with an error from the residuals, per week."""
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
    """Reference loss and noise from some decays.

    Parameters
    ----------
    decays : sequence of Decay
        The decays.
    a, b : array, shape (n,)
        Expected a and b of each decay over those of the reference.
    ring : Losses, optional
        Losses of the ring, whose ratio of a to b is used with the relative error `RATIO_ERROR`.

    Returns
    -------
    Reference or None
        None where a and b are not both determined above zero, or where a rises with the current,
        which no bunch length explains.

    Notes
    -----
    Least squares on a I and a I + b of each decay. Where several decays together reject a constant
    a, it goes as the power of the current that they show. Scatter of the decays beyond their errors
    is taken as the variation of a and b from decay to decay, and is added to their errors.
    """
    power = power_of([decay.fit for decay in decays])
    # In a single decay an exponent is not separable from a monitor or a vacuum that wanders.
    if power > 0 or (power and len(decays) == 1):
        return None
    current, parts, root = map(np.asarray, summarise(decays, power))
    if not root.any():  # cycles fitted together have no exponent
        return None
    typical_current = float(np.median(current))
    rows = loss_part_slopes(a * current * (current / typical_current) ** power, b)
    ring_row = np.zeros(2)
    if ring is not None:
        parts_scale = parts[0, 1] / float(ring.a * current[0] + ring.b)
        ring_row = np.array([1 / float(ring.a), -1 / float(ring.b)]) / parts_scale / RATIO_ERROR
    coefficients, _ = _fit_loss(rows, parts, root, ring_row)
    quadratic = np.clip(parts[:, 0], 0.0, parts[:, 1])
    slopes = loss_part_slopes(quadratic, parts[:, 1] - quadratic)
    residual = parts[:, 1] - (rows @ coefficients)[:, 1]
    share = np.sum(slopes[:, 1] ** 2, axis=1).mean()
    # One more decay, off by an ordinary day's wander, regularises the variance of few decays.
    wander = float(residual @ residual) / share + WANDER**2
    wander = math.sqrt(wander / max(residual.size - 1, 1))
    root = add_errors(root, wander * slopes)
    coefficients, jacobian = _fit_loss(rows, parts, root, ring_row)
    if not (np.isfinite(coefficients).all() and coefficients.min() > 0):
        return None
    covariance = np.linalg.pinv(jacobian.T @ jacobian, hermitian=True) + WANDER**2 * np.eye(2)
    noise, time, interval, white = np.median([_noise(decay.fit, power) for decay in decays], axis=0)
    return Reference(*map(float, coefficients), noise, time, interval, covariance, max(white, 0.0),
                     wander, power, typical_current)  # fmt: skip


def _fit_loss(
    rows: np.ndarray, parts: np.ndarray, root: np.ndarray, constraint: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Fit a and b of all decays by least squares; also return the relative Jacobian.

    `rows` are the slopes of the decays' parts by a and b, and `constraint` is a further row, whose
    product with (a, b) is 0 ± 1. The Jacobian is whitened, by relative changes of a and b.
    """
    weighted = np.vstack([(root @ rows).reshape(-1, 2), constraint])
    values = np.append(np.einsum("nij,nj->ni", root, parts), 0.0)
    scale = np.linalg.norm(weighted, axis=0)
    found = np.linalg.lstsq(weighted / scale, values, rcond=None)[0] / scale
    return found, weighted * found


def power_of(fits: Sequence[DecayFit]) -> float:
    """Exponent of a over the decays together; 0 unless they reject a constant a.

    Weighted mean of the exponents, its error enlarged by their scatter where that exceeds the
    errors.
    """
    found = [fit.constant_a.exponent for fit in fits if fit.constant_a is not None]
    pairs = [(float(q.value), float(q.error)) for q in found if q.error]
    if not pairs:
        return 0.0
    value, error = np.array(pairs).T
    mean, mean_error = np.average(value, weights=error**-2), np.sum(error**-2) ** -0.5
    chi2 = float(np.sum(((value - mean) / error) ** 2))
    mean_error *= math.sqrt(max(chi2 / max(value.size - 1, 1), 1.0))
    chance = 2 * one_sided_probability(abs(mean) / mean_error, math.inf)
    refuted = constant_a(mean, mean_error, mean_error, chance).status is Status.poor_fit
    return float(mean) if refuted else 0.0


def _noise(fit: DecayFit, power: float) -> tuple[float, float, float, float]:
    """Noise level of a reading, mA, correlation time, s, interval, s, and white share of variance.

    The noise level comes from changes between neighbouring readings, since the residuals of one
    decay do not determine the variance of noise with a long correlation time.
    """
    interval, time = float(np.median(np.diff(fit.readings.time))), fit.correlation_time or 0.0
    correlation, residuals = fit.identifiability.residual_correlation or 0.0, fit.residuals
    if power and fit.first is None:
        expansion = fit.with_power(power)
        residuals, found = expansion.current_residuals, expansion.memory(expansion.columns(), False)
        time = found.noise.time if expansion.has_memory else 0.0
        correlation = (1 - found.noise.white) * math.exp(-interval / time) if time else 0.0
    white = 1 - correlation * math.exp(interval / time) if correlation else 0.0
    noise = math.sqrt(float(np.mean(np.diff(residuals) ** 2)) / (2 * (1 - correlation)))
    noise = max(noise, MIN_RELATIVE_NOISE * fit.mean_current)
    return noise, time if correlation else 0.0, interval, white


def _alarms(
    studies: Sequence[RecordStudy],
    reference: Reference,
    times: Sequence[float],
    a: np.ndarray,
    b: np.ndarray,
) -> tuple[Alarm, ...]:
    """Watch all readings from the time of the first decay given.

    `a` and `b` are the expected factors of each decay.
    """
    rows = [
        np.stack([(study.record.start or 0.0) + study.record.time, study.record.current], axis=-1)
        for study in studies
    ]
    rows = np.concatenate(rows)
    rows = rows[rows[:, 0] >= times[0]]
    rows = rows[:: math.ceil(len(rows) / MAX_WATCHED_READINGS)]
    place = np.searchsorted(times, rows[:, 0], side="right") - 1
    return alarms_of(reference, *rows.T, a[place], b[place])


def _is_significant(errors: float, dof: int) -> bool:
    """Return True if a change is as improbable by chance as a point beyond the control limits."""
    return one_sided_probability(errors, dof) < 1 - THREE_SIGMA
