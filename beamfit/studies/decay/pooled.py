"""Many short cycles, as of top-up: one a and one b, and what they are worth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import fdtrc

from beamfit.errors import InputError
from beamfit.greybox.memory import Memory, Whitened, remembered
from beamfit.lifetime.decay import HOUR
from beamfit.noise.correlated import is_correlated
from beamfit.quantity import Quantity, Status
from beamfit.studies.decay.cycles import unresolved
from beamfit.studies.decay.departures import (
    CURRENTS,
    REJECTED,
    ConstantA,
    LifetimeLaw,
    constant_a,
)
from beamfit.studies.decay.evidence import NORMAL, SEPARABLE, Weighed
from beamfit.studies.decay.fit import DecayFit
from beamfit.studies.decay.law import Expansion, Physical, lifetime_of, power_rates
from beamfit.studies.decay.marginal import BELOW, Law
from beamfit.studies.decay.monitor import Monitor
from beamfit.studies.decay.pool import (
    FEWEST_CYCLES,
    FEWEST_READINGS,
    MOST,
    Pool,
    averaged,
    cleaned,
    solved,
)
from beamfit.studies.decay.record import DecayRecord
from beamfit.studies.decay.segments import noise_of
from beamfit.studies.decay.verdict import finding_of_cycles

# Parts of the record whose loss rates are compared, and points of a picture.
PARTS, POINTS = 8, 60
# Refills of so many standard deviations of the means beside them are none of them missed.
SEEN = 6.0
# Scatter, over the length squared, of the parabola t² beside its line, halved: the bend of a decay.
BEND = 1 / 12 / math.sqrt(5)
# Noise with a memory is taken for so many times what neighbouring readings scatter by.
OWN = 3.0
# Probability of refills faster than the record is read from which cycles tell no lifetime.
UNSURE = 0.05


def _slopes(pool: Pool) -> tuple[Physical, np.ndarray]:
    """Physical values at the highest, lowest and mean current, and slopes by the three numbers."""
    loss, quadratic, exponent = pool.theta
    unit, mean = pool.unit, pool.mean
    ends = np.array([pool.cycles.current.max(), pool.cycles.current.min()]) / mean
    rates, by = power_rates(pool.theta, unit, ends)
    values = Physical(
        i0=mean * float(np.mean(pool.level)), a=quadratic / mean / unit,
        b=(loss - quadratic) / unit, rate_start=rates[0], rate_end=rates[1], rate_mean=loss / unit,
        share=quadratic / loss, exponent=exponent,
    )  # fmt: skip
    slopes = np.array([
        [0, 0, 0], [0, 1 / mean / unit, 0], [1 / unit, -1 / unit, 0], *by, [1 / unit, 0, 0],
        [-quadratic / loss**2, 1 / loss, 0], [0, 0, 1],
    ])  # fmt: skip
    return values, slopes


def _whitened(pool: Pool, known: float | None) -> Whitened:
    return remembered(pool.rows, pool.residuals, pool.cycles.time, pool.levels, known)


@dataclass(frozen=True, eq=False)
class PooledEvidence(Weighed):
    """What the rules look at: a fit to cycles, and the memory of its noise, the exponent `held` or
    free in the `power` law, and 0 where it is `known` to be none; the rest is as of `Evidence`.
    """

    pool: Pool
    held: Memory
    power: Memory
    known: float | None
    values: Physical
    errors: Physical
    raw: Physical
    reach: Physical
    constant_a: ConstantA
    law: Law = Law.constant

    @classmethod
    def of(cls, pool: Pool, law: Law = Law.constant) -> PooledEvidence:
        """Weigh a fit, with the noise's memory where it has one."""
        given, parameters = float(pool.cycles.error is not None), pool.level.size + 2
        known = None if is_correlated(pool.left[:, 3], parameters) else 0.0
        seen = _whitened(pool, known)
        held = seen.memory(2)
        plain = held if known == 0.0 else _whitened(pool, 0.0).memory(2)
        values, slopes = _slopes(pool)
        moved = held.moments(slopes[:, :2], given)
        raw = np.linalg.norm(slopes[:, :2] @ plain.half[0], axis=1)
        raw = raw if given else raw * math.sqrt(plain.squares[0] / plain.dof)
        moved_values = Physical(*(np.array(values) + moved.shift))
        found = cls(
            pool, held, seen.memory(), known, moved_values, Physical(*moved.error), Physical(*raw),
            Physical(*moved.reach), constant_a(math.nan, math.inf, math.inf, math.nan), law,
        )  # fmt: skip
        return replace(found, constant_a=found.tested()) if found.separability.separable else found

    @cached_property
    def bending(self) -> Physical | None:
        """How far an exponent of a within its prior moves the values, beside what the cycles tell
        of it; None where the law is known, or a and b are one number.

        The exponent is normal, `BELOW` wide to either side, and its error beside the other numbers
        is combined with that.
        """
        if self.law is Law.constant or not self.separability.separable:
            return None
        seen = self.power.moments(np.eye(3)[2:], float(not self.noise_inferred)).error[0]
        size = 1 / math.hypot(1 / BELOW, 1 / seen)
        rows = self.pool.left[:, :3]
        step = np.linalg.lstsq(rows[:, :2], -size * rows[:, 2], rcond=None)[0]
        return Physical(*np.abs(_slopes(self.pool)[1] @ np.append(step, size)))

    def widely(self, name: str, exact: Quantity) -> Quantity:
        """A quantity with an exponent of a that the cycles leave open."""
        if self.bending is None or exact.error is None or self.refuted:
            return exact
        moved = float(getattr(self.bending, name.replace("lifetime", "rate")))
        moved *= HOUR * exact.value**2 if name.startswith("lifetime") else 1.0
        reaches = (np.hypot(exact.value - exact.interval_95[0], NORMAL * moved),
                   np.hypot(exact.interval_95[1] - exact.value, NORMAL * moved))  # fmt: skip
        interval = exact.value - float(reaches[0]), exact.value + float(reaches[1])
        error = math.hypot(exact.error, moved)
        return Quantity(exact.value, error, exact.unit, exact.error_raw, interval)

    def tested(self) -> ConstantA:
        """Whether a constant a is refuted, by an exponent beside the other numbers."""
        moved = self.power.moments(np.eye(3)[2:], float(not self.noise_inferred))
        error = float(moved.error[0])
        return constant_a(float(moved.shift[0]), error, error, moved.chance[0])

    def with_monitor(self, monitor: Monitor) -> PooledEvidence:
        """With a stated stability in the errors, and in the test of a constant a."""
        pool, scale = self.pool, self.pool.weight / self.pool.mean
        changes = monitor.changes(self.time - self.time[0]).values()
        rows = pool.beside(np.column_stack([pool.rows, *(scale * change for change in changes)]))
        about = Expansion(pool.left[:, 3], rows[:, :3], _slopes(pool)[1])
        return self.widened(about, rows[:, 3:].T)

    @property
    def cycles(self) -> int:
        """How many."""
        return self.pool.level.size

    @property
    def currents(self) -> tuple[float, float]:
        """Lowest and highest, mA."""
        return float(self.pool.cycles.current.min()), float(self.pool.cycles.current.max())

    @property
    def dof(self) -> int:
        """Readings less numbers."""
        return self.held.dof

    @property
    def chi2(self) -> float:
        """In units of the errors, whitened; equal to `dof` where there are none."""
        if self.noise_inferred:
            return float(self.dof)
        return float(self.held.squares[self.held.likely])

    @property
    def noise_inferred(self) -> bool:
        """Whether the residuals tell the noise."""
        return self.pool.cycles.error is None

    @property
    def noise(self) -> float:
        """What the readings scatter by, mA, or over their errors."""
        return self.pool.mean * math.sqrt(self.held.squares[self.held.likely] / self.dof)

    @property
    def white(self) -> float:
        """No part of the noise of cycles is white beside one with a memory."""
        return 0.0

    @property
    def correlation_time(self) -> float | None:
        """Of the errors, s; None where they are independent."""
        return None if self.known == 0 else float(self.held.time[self.held.likely])

    @property
    def time(self) -> np.ndarray:
        """Of the readings, s."""
        return self.pool.cycles.time

    @property
    def correlation(self) -> float:
        """Of a and b."""
        a, b = _slopes(self.pool)[1][1:3, :2] @ self.held.half[self.held.likely]
        return float(a @ b / np.linalg.norm(a) / np.linalg.norm(b))

    @property
    def inflation(self) -> float:
        """By how much the memory of the noise enlarges errors."""
        return max(1.0, self.errors.rate_mean / self.raw.rate_mean)

    @cached_property
    def parts(self) -> tuple[float, list[Quantity]]:
        """The chance that the loss rate is one in all parts of the record, and their lifetimes."""
        pool = self.pool
        count = min(PARTS, pool.level.size)
        part = np.repeat(np.arange(pool.level.size) * count // pool.level.size, pool.cycles.lengths)
        apart = None
        if self.correlation_time is not None:
            apart = np.diff(pool.cycles.time) / self.correlation_time
        own = pool.rows[:, :1] * (part[:, None] == np.arange(count))
        every = pool.beside(np.column_stack([own, pool.rows[:, 1], pool.residuals]), apart)
        columns, residual = every[:, :-1], every[:, -1]
        step, rest, *_ = np.linalg.lstsq(columns, -residual, rcond=None)
        dof = self.dof - count + 1
        unit = float(rest[0]) / dof
        unit = unit if pool.cycles.error is None else max(unit, 1.0)
        fall = float(self.held.squares[self.held.likely]) - float(rest[0])
        chance = float(fdtrc(count - 1, dof, max(fall, 0.0) / (count - 1) / unit))
        spread = np.linalg.norm(np.linalg.pinv(columns), axis=1) * math.sqrt(unit)
        rates = (pool.theta[0] + step[:count]) / pool.unit
        pairs = zip(rates, spread[:count] / pool.unit, strict=True)
        return chance, [lifetime_of(rate, error) for rate, error in pairs if rate > 0]

    @property
    def changed(self) -> bool:
        """Whether the loss rate is not the same all along the record."""
        return self.parts[0] < REJECTED

    @property
    def refuted(self) -> bool:
        """Whether the cycles contradict one constant a and b."""
        return self.changed or self.constant_a.status is Status.poor_fit

    @cached_property
    def lifetimes(self) -> LifetimeLaw | None:
        """The lifetime by current, where the currents are wide enough apart to tell."""
        if not self.separability.separable:
            return None
        refuted = self.constant_a.status is Status.poor_fit
        pool, numbers = (solved(self.pool.cycles, 3), 3) if refuted else (self.pool, 2)
        x = np.geomspace(*self.currents, CURRENTS) / pool.mean
        rates, slopes = power_rates(pool.theta, pool.unit, x)
        slopes = np.vstack([slopes, np.eye(3)[2]])[:, :numbers]
        memory = _whitened(pool, self.known).memory() if refuted else self.held
        errors = memory.moments(slopes, float(not self.noise_inferred)).error
        exponent = Quantity(float(pool.theta[2]), float(errors[-1]) if refuted else None, "1")
        return LifetimeLaw.of(x * pool.mean, rates, errors[:-1], exponent)


def stands_alone(cycle: DecayRecord, fit: DecayFit) -> bool:
    """Whether a cycle by itself would tell a from b, by the bend of its decay and the noise that
    all cycles show; where one law does not hold for all, that of its neighbouring readings.
    """
    noise = fit.rms_residual * fit.inflation
    if fit.status is Status.poor_fit:
        noise = min(noise, OWN * noise_of(cycle.time, cycle.current))
    loss = cycle.span / HOUR / fit.lifetime_mean.value
    bend = float(cycle.current.mean()) * loss**2 * BEND / 2 * math.sqrt(len(cycle))
    return noise * math.sqrt(max(len(cycle) / MOST, 1.0)) < SEPARABLE * bend


def seen_through(fit: DecayFit, usual: float, interval: float) -> DecayFit:
    """A fit to cycles that were found, without errors where refills may have been missed: then the
    beam seems to live longer than it does. `usual` is how many readings
    a cycle has, one each `interval`.

    The refill that holds the current gives back what a cycle loses. It is told from the noise by
    the means of half a cycle before and after.
    """
    lifetime = fit.lifetime_mean.value * HOUR
    if lifetime > 0 and unresolved(usual, interval, lifetime) > UNSURE:
        cause = (
            "The beam is held by refills that the record may not resolve: of those that were found "
            f"the next comes after {usual:.3g} readings, but faster ones look the same when read "
            f"every {interval:.3g} s. Record more readings from refill to refill. "
        )
        return _opened(fit, cause)
    record, memory = fit.readings, fit.identifiability.residual_correlation
    half = max(len(record) / fit.first.size / 2, 1.0)
    mean = (1 + memory) / (1 - memory) / half if memory else 1 / half
    least = SEEN * fit.rms_residual * math.sqrt(2 * min(mean, 1.0))
    lasts = 2 * half * float(np.median(np.diff(record.time)))
    lifetime = fit.lifetime_mean.value
    lost = fit.mean_current * lasts / (lifetime * HOUR)
    if lost >= least or not lifetime > 0:  # that of a current that rises is nan
        return fit
    cause = (
        f"A cycle of the {fit.first.size} that were found loses {lost:.2g} mA, and refills below "
        f"{least:.2g} mA can be missed in this noise: the beam then seems to live longer than it "
        f"does. Average readings, or give the times of the refills by cutting the record there. "
    )
    return _opened(fit, cause)


def _opened(fit: DecayFit, cause: str) -> DecayFit:
    bare = {name: quantity.open() for name, quantity in fit.quantities.items()}
    return replace(fit, status=Status.unidentified, message=cause + fit.message, exact=bare, **bare)


def cycle_lifetimes(fit: DecayFit) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time, s, lifetime and its error, h, of up to 60 parts of a pooled fit; for a picture.

    The slope of the residuals of its cycles is what the loss rate of a part departs by.
    """
    record, first = fit.readings, fit.first
    lengths = np.diff(first, append=len(record))
    columns = np.column_stack([record.time, fit.residuals])
    mean = np.add.reduceat(columns, first) / lengths[:, None]
    since, residual = (columns - np.repeat(mean, lengths, axis=0)).T
    part = first[np.linspace(0, first.size, min(first.size, POINTS), endpoint=False).astype(int)]
    count = np.diff(part, append=len(record))
    at, level = (np.add.reduceat(v, part) / count for v in (record.time, record.current))
    squares = np.add.reduceat(since**2, part)
    rate = np.add.reduceat(since * residual, part) / squares / level
    rate += fit.a.value * level + fit.b.value
    error = fit.rms_residual / np.sqrt(squares) / level
    seen = rate > 0
    return at[seen], 1 / rate[seen] / HOUR, (error / rate**2)[seen] / HOUR


def fit_cycles(
    cycles: Sequence[DecayRecord], name: str = "cycles", law: Law | str = Law.free
) -> DecayFit:
    """Fit one a and one b to many cycles, as of top-up, each with an own current at its start.

    Parameters
    ----------
    cycles : sequence of DecayRecord
        Three or more, of three readings or more, in order of time; as of `find_cycles`. Their
        `start`, where all have it, says how far apart they lie.
    name : str, optional
        What to call them together.
    law : {"free", "constant"}
        Whether a may go as a power of the current, which errors of a and b then contain.

    Returns
    -------
    DecayFit
        Of all cycles: `lifetime_start` and `lifetime_end` are at the highest and the lowest
        current, `i0` is the mean of the cycles' own, without an error, and `lifetimes` has the
        lifetime by current where the currents are wide enough apart. Where a and b are not
        separable the lifetime at the mean current is the answer.

    Raises
    ------
    InputError
        If there are fewer than three cycles, one has fewer than three readings, or they are not in
        order of time.

    Notes
    -----
    Least squares; the currents at the starts are eliminated, so that time and memory grow with the
    readings alone. Noise with a memory goes on from cycle to cycle (`beamfit.noise.correlated`).
    Readings, cycles and heads of cycles that lie far off are left out and counted.

    Examples
    --------
    >>> t = np.arange(0.0, 180.0, 10.0)
    >>> noise = 1e-3 * np.random.default_rng(1).normal(size=(50, 18))
    >>> cycles = [DecayRecord(t, 500 * np.exp(-t / 36000) + row) for row in noise]
    >>> print(fit_cycles(cycles).lifetime_mean)
    9.99999 ± 0.00046 h
    """
    if len(cycles) < FEWEST_CYCLES:
        raise InputError(f"{len(cycles)} cycles", f"{FEWEST_CYCLES} or more", path=name)
    for cycle in cycles:
        if len(cycle) < FEWEST_READINGS:
            found, expected = f"{len(cycle)} readings", f"{FEWEST_READINGS} or more in a cycle"
            raise InputError(found, expected, path=cycle.name)
    return fit_pieces(cycles, name, Law(law))


def fit_pieces(cycles: Sequence[DecayRecord], name: str, law: Law = Law.constant) -> DecayFit:
    """As `fit_cycles`, also of two, such as before and after a refill or a gap."""
    gathered = averaged(cycles)
    if np.any(np.diff(gathered.time) <= 0):
        raise InputError("a cycle before the end of the one before", "an order in time", path=name)
    pool, left_out = cleaned(gathered)
    evidence, monitor = PooledEvidence.of(pool, law), cycles[0].monitor
    if monitor is not None:
        evidence = evidence.with_monitor(monitor)
    finding = finding_of_cycles(evidence, monitor, left_out)
    weight, (time, _, current, error, first) = pool.weight, pool.cycles
    return DecayFit(
        record=name,
        status=finding.status,
        message=finding.message,
        **evidence.quoted() | {"i0": evidence.quantity("i0", False)},
        mean_current=pool.mean,
        rms_residual=pool.mean * float(np.sqrt(np.mean((pool.left[:, 3] / weight) ** 2))),
        residuals=pool.mean * pool.residuals / weight,
        readings=DecayRecord(time, current, error, name, float(time[0])),
        first=first,
    )
