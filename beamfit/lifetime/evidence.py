"""Evidence of a fitted law: values and errors of one decay or many cycles, with their noise."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.special import stdtr

from beamfit.answer import json_of, shown
from beamfit.errors import Status
from beamfit.lifetime.alternatives import (
    ConstantA,
    LifetimeLaw,
    Outgassing,
    Rival,
    constant_a,
    lifetime_law,
    rival_of,
)
from beamfit.lifetime.cycles import unresolved
from beamfit.lifetime.expansion import (
    DETERMINED,
    LOSS,
    POWER,
    Expansion,
    Physical,
    Pieces,
    further_columns,
    lifetime_of,
    solved,
)
from beamfit.lifetime.free_law import (
    ENDS,
    EXPONENT_SD_BELOW,
    OUTGASSING_PACES,
    PACES_PER_OCTAVE,
    UNITS,
    FreeLaw,
    Law,
    free_law,
    from_nodes,
    settling_shapes,
)
from beamfit.lifetime.pieces import MAX_SPIKE, MIN_STEP_DIGITS
from beamfit.lifetime.record import DecayRecord
from beamfit.noise.correlated import AveragedMoments, Memory
from beamfit.noise.memory import CLOSE, Products
from beamfit.quantity import HOUR, Quantity
from beamfit.statistics import POOR_FIT

# The share of a in the loss lies between 0 and 1: known to 0.2, the record tells pure Touschek
# from pure gas at five standard deviations; known worse, a and b are one number.
SEPARABLE = 0.2
# How many errors below zero an unphysical a or b, or a rising current, is believed.
BELIEVED = 5.0
# A share of a so many errors outside 0 to 1 is of no longer record.
OUTSIDE = 3.0
# Probability of refills faster than the record is read from which cycles tell no lifetime.
UNSURE = 0.05
# Refills of so many standard deviations of the means beside them are none of them missed.
SEEN = 6.0
# Standard deviations that hold 95 % of a normal distribution.
NORMAL = 1.96
# Below this share of the current differences are those of the arithmetic, not of the beam.
EXACT = 1e-12


@shown
@dataclass(frozen=True)
class Separability:
    """Separability of a and b in one record.

    Parameters
    ----------
    separable : bool
        Whether the share of a in the loss is known to better than 0.2 by constant a and b, and may
        not as well be all as none by the free law.
    share, share_error : float or None
        Share of a in the loss at the mean current (0: all gas-like, 1: all Touschek-like), and
        its standard deviation.
    correlation : float or None
        Correlation of a and b; near -1 on every record, also where both are well determined.
    residual_correlation : float or None
        Correlation of the errors of neighbouring readings; zero where none is seen.
    error_inflation : float or None
        By how much that makes the errors, which contain it, larger than independent readings
        would; None where the lifetime is not determined.
    """

    separable: bool
    share: float | None
    share_error: float | None
    correlation: float | None
    residual_correlation: float | None
    error_inflation: float | None


class RatePart(NamedTuple):
    """A part of a record of many cycles, with a loss rate of its own.

    Attributes
    ----------
    start, end : float
        Since the first reading, s.
    lifetime : Quantity
        At the mean current of the record, h.
    """

    start: float
    end: float
    lifetime: Quantity

    def to_json(self) -> dict[str, Any]:
        """Return the ends with their unit, and the lifetime, as JSON's types."""
        ends = {name: {"value": getattr(self, name), "error": None, "unit": "s"}
                for name in ("start", "end")}  # fmt: skip
        return json_of(ends | {"lifetime": self.lifetime})


@dataclass(frozen=True, eq=False)
class Evidence:
    """A fitted law with the noise that it leaves, and what else may explain the readings.

    Parameters
    ----------
    about : Expansion
        The law with constant a and b, or a given dependence of a.
    law : Law
        Whether an exponent of a and a drift of b are left open.
    shaped : bool
        Whether the dependence of a was given.
    record : DecayRecord or None
        The readings of a single decay.
    usual : tuple of float or None
        Readings of a cycle, and the time between them, s, of cycles that were found in a record.
    """

    about: Expansion
    law: Law = Law.constant
    shaped: bool = False
    record: DecayRecord | None = None
    usual: tuple[float, float] | None = None

    @property
    def cycles(self) -> int:
        """Number of pieces."""
        return self.about.level.size

    @property
    def time(self) -> np.ndarray:
        """Times of the readings, s."""
        return self.about.pieces.time

    @property
    def noise_inferred(self) -> bool:
        """True if the noise is taken from the residuals."""
        return self.about.pieces.error is None

    @cached_property
    def changed(self) -> bool:
        """True if something else than noise correlates the residuals of a decay."""
        return self.cycles == 1 and self.about.wanders and self.rival is not None

    @cached_property
    def independent(self) -> bool:
        """True if errors of neighbouring readings are taken for independent; those of many cycles
        are averaged over what the readings leave open.
        """
        return self.cycles == 1 and (not self.about.wanders or self.changed)

    @property
    def remembers(self) -> bool:
        """True if residuals are seen to have a memory."""
        return self.about.wanders and not self.independent

    def _memory(self, independent: bool, *more: int) -> Memory:
        return self.about.memory(self.about.columns(*more), independent)

    @cached_property
    def memory(self) -> Memory:
        """The noise, a and b being constant."""
        return self._memory(self.independent)

    @cached_property
    def plain(self) -> Memory:
        """The same for independent errors."""
        return self.memory if self.independent else self._memory(True)

    @cached_property
    def power(self) -> Memory:
        """The noise beside a power of the current."""
        memory = self._memory(self.independent, POWER)
        # Differences of an exact curve are those of the arithmetic.
        floor = np.sum((EXACT * self.about.pieces.current / self.about.pieces.over) ** 2)
        return memory._replace(squares=np.maximum(memory.squares, floor))

    @cached_property
    def exponent(self) -> AveragedMoments:
        """The power of the current as which a goes, beside the other numbers."""
        place = np.eye(self.about.rows.shape[1])[[POWER]][:, self.about.columns(POWER)]
        return self.power.moments(place, self.about.given)

    @cached_property
    def moments(self) -> AveragedMoments:
        """Shifts of the values by the noise, their errors and the reach of 95 %."""
        slopes = self.about.slopes[:, self.about.columns()]
        found = self.memory.moments(slopes, self.about.given)
        if not self.independent:
            return found
        # The weak prior stays where the noise is that of the search.
        return found._replace(shift=np.zeros_like(found.shift))

    @cached_property
    def drifted(self) -> np.ndarray:
        """Shifts of the values by the stated instability of the monitor."""
        moved = [self.about.moved(change) for change in self.monitor_changes]
        return np.linalg.norm(moved, axis=0) if moved else np.zeros(len(Physical._fields))

    @property
    def monitor_changes(self) -> list[np.ndarray]:
        """Stated instabilities of the monitor, over the errors of readings."""
        return self.about.pieces.monitor_changes if self.about.rested else []

    @cached_property
    def values(self) -> Physical:
        """Values of the law with constant a and b."""
        return Physical(*(np.array(self.about.values) + self.moments.shift))

    @cached_property
    def displaced(self) -> np.ndarray:
        """Errors of the values by changes of the loss rate somewhere within a cycle."""
        about = self.about
        if about.parts is None:
            return np.zeros(len(Physical._fields))
        first, lengths = about.pieces.first, about.pieces.lengths
        share = lengths[np.isin(first, about.parts.first[1:])] / lengths.sum()
        # Evenly anywhere in it.
        moved = np.linalg.norm(np.diff(about.parts.departure) * share) / math.sqrt(12)
        return np.abs(about.slopes[:, LOSS]) * moved

    @cached_property
    def errors(self) -> Physical:
        """Half of the central 68 %."""
        return Physical(*np.hypot(np.hypot(self.moments.error, self.drifted), self.displaced))

    @cached_property
    def reach(self) -> Physical:
        """Reach of 95 % about the values."""
        more = NORMAL * np.hypot(self.drifted, self.displaced)
        return Physical(*np.hypot(self.moments.reach, more))

    @cached_property
    def raw(self) -> Physical:
        """Standard deviations for errors as stated, and independent."""
        slopes = self.about.slopes[:, self.about.columns()]
        size = 1.0 if self.about.given else math.sqrt(self.plain.squares[0] / self.plain.dof)
        return Physical(*(size * np.linalg.norm(slopes @ self.plain.half[0], axis=1)))

    @cached_property
    def constant_a(self) -> ConstantA:
        """Test of a constant a by an exponent beside the other numbers."""
        if self.cycles > 1 and not self.separability.separable:
            return constant_a(math.nan, math.inf, math.inf, math.nan)
        found, error = self.exponent, float(self.exponent.error[0])
        test = constant_a(float(found.shift[0]), error, error, float(found.chance[0]))
        return test.widened(float(self.drifted[-1])) if self.monitor_changes else test

    @property
    def dof(self) -> int:
        """Readings less numbers."""
        return self.memory.dof

    @cached_property
    def residuals(self) -> np.ndarray:
        """Model less reading, mA; of the law whose values are quoted."""
        if self.freed:
            return self.free.curve(self.time) - self.about.pieces.current
        after = self.about.residuals
        if self.cycles == 1 and not self.independent:
            after = after + self.about.rows[:, self.about.columns()] @ self.memory.mean_step
        return after * self.about.pieces.over

    @property
    def rms(self) -> float:
        """Root mean square of the residuals, mA, beside a current for each cycle."""
        after = (
            self.about.left[:, -1] * self.about.pieces.over if self.cycles > 1 else self.residuals
        )
        return float(np.sqrt(np.mean(after**2)))

    @cached_property
    def squares(self) -> float:
        """Sum of squares of the residuals over their errors, whitened.

        How far a drift under white noise gets in the end says nothing of the errors.
        """
        likely = self.memory.likely
        if self.freed or self.memory.white[likely]:
            return float(np.sum((self.residuals / self.about.pieces.over) ** 2))
        return float(self.memory.squares[likely])

    @property
    def chi2(self) -> float:
        """The same; equal to `dof` where there are no errors."""
        return float(self.dof) if self.noise_inferred else self.squares

    @property
    def noise(self) -> float:
        """Factor on errors that were given (at least 1), or the noise in mA."""
        return max(math.sqrt(self.squares / self.dof), self.about.given)

    @property
    def correlation(self) -> float:
        """Correlation of a and b."""
        a, b = self.about.slopes[1:3, self.about.columns()] @ self.plain.half[0]
        return float(a @ b / np.linalg.norm(a) / np.linalg.norm(b))

    @property
    def correlation_time(self) -> float | None:
        """Correlation time of the noise, s; None where errors are independent."""
        return self.memory.noise.time if self.remembers else None

    @property
    def white(self) -> float:
        """The share of their variance that has none."""
        return self.memory.noise.white if self.remembers else 0.0

    @property
    def inflation(self) -> float:
        """Factor by which the memory of the noise enlarges errors."""
        if not self.remembers:
            return 1.0
        # Of a loss rate that is not clear of zero the share of a says nothing.
        names = ("rate_mean", "share")[: 1 + (self.cycles == 1 and self.is_clear("rate_mean"))]
        size = max(math.sqrt(self.plain.squares[0] / self.plain.dof), self.about.given)
        size = size if self.about.given else 1.0  # raw errors have the size of the noise else
        return max(1.0, *(getattr(self.errors, n) / getattr(self.raw, n) / size for n in names))

    def sure(self, name: str) -> tuple[float, float]:
        """A value, and the error of a normal number that reaches as far: few residuals count."""
        return float(getattr(self.values, name)), float(getattr(self.reach, name)) / NORMAL

    def scaled(self, name: str) -> tuple[float, float]:
        """A value and its error."""
        return float(getattr(self.values, name)), float(getattr(self.errors, name))

    def is_clear(self, name: str) -> bool:
        """Test if a value is clear of zero."""
        value, error = self.sure(name)
        return error < DETERMINED * value

    def _parts(self, name: str) -> tuple[float, ...]:
        every = (self.values, self.errors, self.raw, self.reach)
        return tuple(float(getattr(part, name)) for part in every)

    def quantity(self, name: str, known: bool) -> Quantity:
        """I0, a or b; without an error where it is not determined."""
        value, error, raw, reach = self._parts(name)
        if not (known and math.isfinite(value) and math.isfinite(error)):
            return Quantity(value, None, UNITS[name])
        return Quantity.reaching(value, error, UNITS[name], raw, reach)

    def lifetime(self, name: str, known: bool) -> Quantity:
        """Lifetime in hours from a loss rate; no error where the rate is not clear of zero."""
        rate, error, raw, reach = self._parts(name)
        if not rate > 0:
            return Quantity(math.nan, None, "h")
        if not (known and self.is_clear(name)):
            return Quantity(1 / rate / HOUR, None, "h")
        interval = tuple(1 / max(rate + sign * reach, 1e-300) / HOUR for sign in (1, -1))
        error, raw = (part / rate**2 / HOUR for part in (error, raw))
        return Quantity(1 / rate / HOUR, error, "h", raw, interval)

    @cached_property
    def apart(self) -> bool:
        """True if the law with constant a and b tells them apart."""
        share, error = self.scaled("share")
        return math.isfinite(share) and math.isfinite(error) and self.sure("share")[1] < SEPARABLE

    @cached_property
    def separability(self) -> Separability:
        """Separability of a and b, by the law that knows less of their share: by its bounds alone
        the free one may know more.
        """
        share, error = self.scaled("share")
        finite = math.isfinite(share) and math.isfinite(error)
        if finite and self.free is not None and self.free.share.error > error:
            share, error = self.free.share.value, self.free.share.error
        length, usual = self.correlation_time, float(np.median(np.diff(self.time)))
        told = length is None or self.is_clear("rate_mean")
        alike = 0.0 if length is None else (1.0 - self.white) * math.exp(-usual / length)
        return Separability(
            separable=self.apart and (self.free is None or self.free.tells_share),
            share=share if finite else None,
            share_error=error if finite else None,
            correlation=self.correlation if math.isfinite(self.correlation) else None,
            residual_correlation=alike,
            error_inflation=self.inflation if told else None,
        )

    @property
    def outside(self) -> float:
        """Errors by which the share of a in the loss lies outside 0 to 1; nan if unknown."""
        share, error = self.sure("share")
        return max(-share, share - 1.0) / error if error > 0 else math.nan

    @property
    def bends(self) -> bool:
        """True if cycles bend as no loss does, and the monitor is not stated to drift so."""
        return self.cycles > 1 and not self.monitor_changes and self.outside > OUTSIDE

    @cached_property
    def aliased(self) -> bool:
        """True if refills faster than the record is read may look like those that were found."""
        rate = float(self.values.rate_mean)
        return self.usual is not None and rate > 0 and unresolved(*self.usual, 1 / rate) > UNSURE

    @cached_property
    def hidden(self) -> tuple[float, float] | None:
        """Loss of a cycle and the least refill that the noise does not hide, mA, if that is more,
        of cycles that were found.

        The refill that holds the current gives back what a cycle loses. It is told from the noise
        by the means of half a cycle before and after.
        """
        rate = float(self.values.rate_mean)
        if self.usual is None or not rate > 0:
            return None
        memory = self.separability.residual_correlation
        half = max(self.time.size / self.cycles / 2, 1.0)
        mean = (1 + memory) / (1 - memory) / half
        least = SEEN * self.rms * math.sqrt(2 * min(mean, 1.0))
        lasts = 2 * half * float(np.median(np.diff(self.time)))
        lost = self.about.pieces.units[1] * rate * lasts
        return None if lost >= least else (lost, least)

    @property
    def tells_lifetime(self) -> bool:
        """True if cycles are of a decay, and none of their refills may have been missed."""
        return not self.bends and not self.aliased and self.hidden is None

    @property
    def refuted(self) -> bool:
        """True if the readings contradict constant a and b, or show values that no beam has."""
        if self.changed or self.constant_a.status is Status.poor_fit:
            return True
        if self.ends_oddly and self.rival is not None:
            return True
        return self.cycles == 1 and any(
            value < -BELIEVED * error for value, error in map(self.sure, "ab")
        )

    @cached_property
    def ends_oddly(self) -> bool:
        """True if a reading at an end of a decay lies off what the others say of it, by a power of
        the current and by more than chance: it alone tells the current there.
        """
        if self.cycles > 1 or not self.about.rested:
            return False
        columns = np.linalg.qr(self.about.left[:, self.about.columns(POWER)])[0]
        after, dof = self.about.left[:, -1], len(columns) - columns.shape[1] - 1
        if dof < 1:
            return False
        after = after - columns @ (columns.T @ after)
        own = after**2 / np.maximum(1.0 - np.sum(columns**2, axis=1), EXACT)
        ratio = dof * own / np.maximum(after @ after - own, 1e-300)
        ends = np.sqrt(np.append(ratio[:MAX_SPIKE], ratio[-MAX_SPIKE:]))
        return bool(2 * MAX_SPIKE * 2 * stdtr(dof, -ends.max()) < POOR_FIT)

    @cached_property
    def rival(self) -> Rival | None:
        """Alternative that explains a single decay better than any smooth law."""
        if self.cycles > 1 or self.shaped or not self.about.rested or self.within_digits:
            return None
        return rival_of(self.about)

    @property
    def within_digits(self) -> bool:
        """True if no reading lies farther off the law than half of the least step that digits show:
        rounding to them may be all that departs from it.
        """
        digit = None if self.record is None else self.record.resolution
        off = np.max(np.abs(self.about.off))
        return digit is not None and bool(off <= MIN_STEP_DIGITS / 2 * digit)

    @property
    def explained(self) -> Rival | None:
        """Alternative that explains a refuted law better than a power of the current."""
        return self.rival if self.refuted else None

    @cached_property
    def free(self) -> FreeLaw | None:
        """Posterior of the free law; None where the law is known, an alternative that is no part of
        it explains the record better, or the decay is within its noise.
        """
        known = self.law is Law.constant or self.shaped or self.cycles > 1
        if known or not self.is_clear("rate_mean") or not (self.explained is None or self.by_gas):
            return None
        return free_law(self.record, self.values)

    @property
    def freed(self) -> bool:
        """True if departures of a and b are likelier than none: their values are quoted then."""
        return self.free is not None and self.free.likelier

    @property
    def by_gas(self) -> bool:
        """True if gas explains a refuted law that is not gone before the free law can follow it."""
        if self.outgassing is None:
            return False
        return self.record.span <= OUTGASSING_PACES[1] * self.outgassing.time_constant.value * HOUR

    @property
    def outgassing(self) -> Outgassing | None:
        """Gas that explains a refuted law."""
        found = self.explained and self.explained.found
        return found if isinstance(found, Outgassing) else None

    @property
    def beside(self) -> str | None:
        """Name of what is likely to go by itself beside the law, as of `FreeLaw`."""
        return self.free and self.free.beside

    @cached_property
    def bending(self) -> Physical | None:
        """Shifts of the values by an exponent of a within its prior, beside what cycles tell of
        it; None where the law is known, or a and b are one number.

        The exponent has a normal prior of width `EXPONENT_SD_BELOW` to either side.
        """
        if self.law is Law.constant or self.cycles == 1 or not self.separability.separable:
            return None
        columns, seen = self.about.columns(POWER), self.exponent.error[0]
        size = 1 / math.hypot(1 / EXPONENT_SD_BELOW, 1 / seen)
        rows, plain = self.about.left[:, columns], self.about.columns()
        step = np.linalg.lstsq(rows[:, : len(plain)], -size * rows[:, -1], rcond=None)[0]
        return Physical(*np.abs(self.about.slopes[:, columns] @ np.append(step, size)))

    @cached_property
    def freely_drifted(self) -> dict[str, float]:
        """Shifts of what the free law says by a stated instability of the monitor: it follows that
        otherwise than constant a and b do.
        """
        names, every, record = tuple(self.free.quantities), [], self.record
        for change in self.monitor_changes:
            current = record.current + change * self.about.pieces.over
            read = replace(record, current=current, mean=record.mean_current)
            found = free_law(read, solved(Pieces.of(read)).values) or self.free
            every.append([found.quantities[n].value - self.free.quantities[n].value for n in names])
        moved = np.linalg.norm(every, axis=0) if every else np.zeros(len(names))
        return dict(zip(names, moved.tolist(), strict=True))

    def widely(self, name: str, exact: Quantity) -> Quantity:
        """A quantity with the exponent and the drift of b that the readings leave open.

        The value is that of constant a and b where they are likelier, else the median. What is not
        determined keeps its interval.
        """
        if not math.isfinite(exact.value):
            return exact
        if self.bending is not None and exact.error is not None and not self.refuted:
            value, error, interval = exact.value, exact.error, exact.interval_95
            rate = name.replace("lifetime", "rate")
            unit = HOUR * value**2 if rate != name else 1.0
            moved = unit * float(getattr(self.bending, rate))
        elif self.free is not None:
            found, moved = self.free.quantities[name], self.freely_drifted[name]
            error, interval = found.error, found.interval_95
            value = found.value if self.freed else exact.value
            value = float(np.clip(value, *interval))
        else:
            return exact
        low, high = (float(np.hypot(value - end, NORMAL * moved)) for end in interval)
        known = exact.error is not None and (name not in ("a", "b") or self.separability.separable)
        error = math.hypot(error, moved) if known else None
        return Quantity(value, error, exact.unit, exact.error_raw, (value - low, value + high))

    def quoted(self, known: bool = True) -> dict[str, Any]:
        """Fields of a `DecayFit`, by name."""
        # A law that the readings refute has no errors, but for a and b of one that is stated; I0
        # and lifetimes are those of what explains them. The mean of many cycles is of no law.
        same = ("chi2", "dof", "noise_inferred", "constant_a", "correlation_time", "lifetimes")
        refuted = self.refuted and self.free is None
        one, told = self.cycles == 1, not (refuted and self.law is Law.free)
        exact = {"i0": self.quantity("i0", known and one and not refuted)}
        exact |= {name: self.quantity(name, known and self.apart and told) for name in "ab"}
        sure = known and not (refuted and one)
        exact |= {f"lifetime_{at}": self.lifetime(f"rate_{at}", sure) for at in ENDS}
        found = {name: self.widely(name, quantity) for name, quantity in exact.items()}
        found |= self.explained.quantities if refuted and self.explained is not None else {}
        found |= {"exact": exact, "free_law": self.free, "shaped": self.shaped}
        found |= {name: getattr(self, name) for name in (*same, "inflation", "residuals", "course")}
        found["alternative"] = self.explained and self.explained.found
        return found | {"identifiability": self.separability}

    @cached_property
    def stated_odds(self) -> float:
        """Log odds that the stated errors are right, whatever memory the noise has."""
        columns = np.column_stack([self.about.residuals, self.about.rows[:, : POWER + 1]])
        if self.beside == "pumped":
            gas = further_columns(self.about, "relaxing", 1 / np.array(OUTGASSING_PACES))
            columns = np.column_stack([columns, gas])
        if self.beside == "settles":
            model = self.record.current / self.about.pieces.over + self.about.residuals
            settles = np.hstack([*settling_shapes()[::PACES_PER_OCTAVE]])
            shapes = from_nodes(self.record.time / self.record.span) @ settles
            columns = np.column_stack([columns, model[:, None] * shapes])
        products = Products.of(columns, self.time, stated=True, times=CLOSE)
        return products.stated_odds(products.left(), columns.shape[1] - 1)

    @cached_property
    def course(self) -> tuple[RatePart, ...]:
        """Lifetimes of the parts of many cycles whose loss rate is not the same all along; without
        errors where that of all has none.
        """
        parts, (span, _) = self.about.parts, self.about.pieces.units
        if parts is None:
            return ()
        slopes = np.hstack([np.tile([1.0, 0.0], (parts.first.size, 1)), parts.shares]) / span
        found = self.memory.moments(slopes, self.about.given)
        shift = 0.0 if self.independent else found.shift
        rates = (self.about.numbers[LOSS - 1] + parts.departure) / span + shift
        since = self.time - self.time[0]
        ends = np.append(since[parts.first[1:]], since[-1])
        lifetimes = (lifetime_of(*pair, clear=True) for pair in
                     zip(rates, found.error, strict=True))  # fmt: skip
        if not self.tells_lifetime:
            lifetimes = (one.open() for one in lifetimes)
        return tuple(map(RatePart, since[parts.first].tolist(), ends.tolist(), lifetimes))

    @cached_property
    def lifetimes(self) -> LifetimeLaw | None:
        """The lifetime by current: of a decay where a constant a is refuted and it is the current's
        doing, of many cycles where the currents are wide enough apart.
        """
        refuted = self.constant_a.status is Status.poor_fit
        if self.cycles > 1:
            # The search for a power knows no parts.
            known = self.separability.separable and not (refuted and self.course)
        else:
            plain = not self.shaped and self.about.pieces.gauge is None
            known = plain and refuted and self.outgassing is None and self.beside is None
        return lifetime_law(self.about, self.independent, refuted) if known else None

    def drift_of_one_error(self, name: str) -> float:
        """Straight drift of the monitor over the record, mA, that moves a value by its error."""
        by_one = self.about.moved(self.time / self.time[-1] / self.about.pieces.over)
        moved = abs(float(getattr(by_one, name)))
        return float(getattr(self.errors, name)) / moved if moved > 0 else math.inf
