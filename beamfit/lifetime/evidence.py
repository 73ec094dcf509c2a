"""Values and errors of one decay or many cycles, with the noise and the other explanations of the
readings.
"""

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
    BestAlternative,
    ConstantA,
    LifetimeLaw,
    Outgassing,
    best_alternative,
    constant_a,
    lifetime_law,
)
from beamfit.lifetime.cycles import unresolved
from beamfit.lifetime.expansion import (
    LOSS,
    MAX_RELATIVE_ERROR,
    POWER,
    Expansion,
    Physical,
    Pieces,
    fit_law,
    further_columns,
    lifetime_of,
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

# a and b are separable if the error of the share of a, which lies between 0 and 1, is below this:
# pure Touschek and pure gas losses are then five standard errors apart.
SEPARABLE = 0.2
# A negative a or b, or a rising current, is believed only beyond this many standard errors.
BELIEVED = 5.0
# A share of a beyond this many standard errors outside 0 to 1 is physically impossible: a longer
# record would not change that.
OUTSIDE = 3.0
# Largest probability of refills faster than the sampling for which cycles determine a lifetime.
MAX_ALIASING = 0.05
# Refills larger than this many standard errors (of the means before and after) are all found.
FOUND_REFILL = 6.0
# Half-width of the 95 % interval of a normal distribution, in standard deviations.
NORMAL = 1.96
# Relative rounding error of the arithmetic: smaller residuals are not of the beam.
EXACT = 1e-12


@shown
@dataclass(frozen=True)
class Separability:
    """Separability of a and b in one record.

    Parameters
    ----------
    separable : bool
        True if the error of the share of a in the loss is below 0.2 with constant a and b, and the
        free law excludes shares of 0 and 1.
    share, share_error : float or None
        Share of a in the loss at the mean current (0: all gas-like, 1: all Touschek-like), and its
        standard deviation.
    correlation : float or None
        Correlation of a and b; near -1 on every record, also where both are well determined.
    residual_correlation : float or None
        Correlation of the errors of neighbouring readings; zero where none is seen.
    error_inflation : float or None
        Factor by which this correlation enlarges the errors (they contain it); None where the
        lifetime is not determined.
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
        Begin and end, s from the first reading.
    lifetime : Quantity
        Lifetime at the mean current of the record, h.
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
    """A fitted law with its noise, and the other explanations of the readings.

    Parameters
    ----------
    expansion : Expansion
        The law with constant a and b, or with a given dependence of a.
    law : Law
        Assumption on the law: an exponent of a and a drift of b are free, or constant.
    shaped : bool
        True if the dependence of a was given.
    record : DecayRecord or None
        The readings of a single decay.
    usual : tuple of float or None
        Readings of a usual cycle, and the time between them, s, if the cycles were found in a
        record.
    """

    expansion: Expansion
    law: Law = Law.constant
    shaped: bool = False
    record: DecayRecord | None = None
    usual_cycle: tuple[float, float] | None = None

    @property
    def cycles(self) -> int:
        """Number of pieces."""
        return self.expansion.level.size

    @property
    def time(self) -> np.ndarray:
        """Times of the readings, s."""
        return self.expansion.pieces.time

    @property
    def noise_inferred(self) -> bool:
        """True if the noise is taken from the residuals."""
        return self.expansion.pieces.error is None

    @cached_property
    def changed(self) -> bool:
        """True if an alternative, not noise, correlates the residuals of a decay."""
        return self.cycles == 1 and self.expansion.has_memory and self.alternative is not None

    @cached_property
    def independent(self) -> bool:
        """True if errors of neighbouring readings are taken as independent; never for many cycles,
        whose noise is averaged over its memory.
        """
        return self.cycles == 1 and (not self.expansion.has_memory or self.changed)

    @property
    def has_memory(self) -> bool:
        """True if the residuals are correlated by noise."""
        return self.expansion.has_memory and not self.independent

    def _memory(self, independent: bool, *more: int) -> Memory:
        return self.expansion.memory(self.expansion.columns(*more), independent)

    @cached_property
    def memory(self) -> Memory:
        """Posterior over noises, with constant a and b."""
        return self._memory(self.independent)

    @cached_property
    def white_memory(self) -> Memory:
        """Posterior over noises, with constant a and b and independent errors."""
        return self.memory if self.independent else self._memory(True)

    @property
    def _white_noise(self) -> float:
        """Noise level for independent errors: a factor on stated errors, or in mA."""
        return math.sqrt(self.white_memory.squares[0] / self.white_memory.dof)

    @cached_property
    def power_memory(self) -> Memory:
        """Posterior over noises, with a power of the current in a."""
        memory = self._memory(self.independent, POWER)
        # Differences of an exact curve are those of the arithmetic.
        floor = np.sum((EXACT * self.expansion.pieces.current / self.expansion.pieces.divisor) ** 2)
        return memory._replace(squares=np.maximum(memory.squares, floor))

    @cached_property
    def exponent(self) -> AveragedMoments:
        """Power of the current in a, fitted together with the other parameters."""
        place = np.eye(self.expansion.rows.shape[1])[[POWER]][:, self.expansion.columns(POWER)]
        return self.power_memory.moments(place, self.expansion.min_factor)

    @cached_property
    def moments(self) -> AveragedMoments:
        """Shifts of the values by the memory of the noise, with their errors and 95 % reaches."""
        slopes = self.expansion.slopes[:, self.expansion.columns()]
        found = self.memory.moments(slopes, self.expansion.min_factor)
        if not self.independent:
            return found
        # The values are those of the search, which has the weak prior.
        return found._replace(shift=np.zeros_like(found.shift))

    @cached_property
    def monitor_shifts(self) -> np.ndarray:
        """Shifts of the values by the stated instability of the monitor."""
        shifts = [self.expansion.value_shifts(change) for change in self.monitor_changes]
        return np.linalg.norm(shifts, axis=0) if shifts else np.zeros(len(Physical._fields))

    @property
    def monitor_changes(self) -> list[np.ndarray]:
        """Stated instabilities of the monitor, over the errors of readings."""
        return self.expansion.pieces.monitor_changes if self.expansion.converged else []

    @cached_property
    def values(self) -> Physical:
        """Values of the law with constant a and b."""
        return Physical(*(np.array(self.expansion.values) + self.moments.shift))

    @cached_property
    def part_shifts(self) -> np.ndarray:
        """Errors of the values because a change of the loss rate may lie anywhere in a cycle."""
        expansion = self.expansion
        if expansion.parts is None:
            return np.zeros(len(Physical._fields))
        first, lengths = expansion.pieces.first, expansion.pieces.lengths
        share = lengths[np.isin(first, expansion.parts.first[1:])] / lengths.sum()
        # Standard deviation of a uniform distribution.
        shift = np.linalg.norm(np.diff(expansion.parts.departure) * share) / math.sqrt(12)
        return np.abs(expansion.slopes[:, LOSS]) * shift

    @cached_property
    def errors(self) -> Physical:
        """Errors of the values: half of the central 68 %."""
        return Physical(
            *np.hypot(np.hypot(self.moments.error, self.monitor_shifts), self.part_shifts)
        )

    @cached_property
    def reach(self) -> Physical:
        """Half-widths of the 95 % intervals of the values."""
        more = NORMAL * np.hypot(self.monitor_shifts, self.part_shifts)
        return Physical(*np.hypot(self.moments.reach, more))

    @cached_property
    def raw(self) -> Physical:
        """Standard deviations by independent errors, as stated."""
        slopes = self.expansion.slopes[:, self.expansion.columns()]
        size = 1.0 if self.expansion.min_factor else self._white_noise
        return Physical(*(size * np.linalg.norm(slopes @ self.white_memory.half[0], axis=1)))

    @cached_property
    def constant_a(self) -> ConstantA:
        """Test of a constant a, by an exponent fitted together with the other parameters."""
        if self.cycles > 1 and not self.separability.separable:
            return constant_a(math.nan, math.inf, math.inf, math.nan)
        found, error = self.exponent, float(self.exponent.error[0])
        test = constant_a(float(found.shift[0]), error, error, float(found.chance[0]))
        return test.widened(float(self.monitor_shifts[-1])) if self.monitor_changes else test

    @property
    def dof(self) -> int:
        """Degrees of freedom: readings less parameters."""
        return self.memory.dof

    @cached_property
    def residuals(self) -> np.ndarray:
        """Model less reading, mA, for the law whose values are quoted."""
        if self.quotes_free_law:
            return self.free.curve(self.time) - self.expansion.pieces.current
        residuals = self.expansion.residuals
        if self.cycles == 1 and not self.independent:
            rows = self.expansion.rows[:, self.expansion.columns()]
            residuals = residuals + rows @ self.memory.mean_step
        return residuals * self.expansion.pieces.divisor

    @property
    def rms(self) -> float:
        """Root mean square of the residuals, mA, with a starting current for each cycle."""
        if self.cycles > 1:
            residuals = self.expansion.reduced[:, -1] * self.expansion.pieces.divisor
        else:
            residuals = self.residuals
        return float(np.sqrt(np.mean(residuals**2)))

    @cached_property
    def squares(self) -> float:
        """Sum of squares of the whitened residuals over their errors.

        With white noise and a slow drift they are not whitened: the range of a drift says nothing
        of the errors.
        """
        likely = self.memory.likely
        if self.quotes_free_law or self.memory.white[likely]:
            return float(np.sum((self.residuals / self.expansion.pieces.divisor) ** 2))
        return float(self.memory.squares[likely])

    @property
    def chi2(self) -> float:
        """Sum of squares of the residuals over their errors; equal to `dof` if no errors are
        stated.
        """
        return float(self.dof) if self.noise_inferred else self.squares

    @property
    def noise(self) -> float:
        """Factor on stated errors (at least 1), or the noise level in mA."""
        return max(math.sqrt(self.squares / self.dof), self.expansion.min_factor)

    @property
    def correlation(self) -> float:
        """Correlation of a and b."""
        a, b = self.expansion.slopes[1:3, self.expansion.columns()] @ self.white_memory.half[0]
        return float(a @ b / np.linalg.norm(a) / np.linalg.norm(b))

    @property
    def correlation_time(self) -> float | None:
        """Correlation time of the noise, s; None where errors are independent."""
        return self.memory.noise.time if self.has_memory else None

    @property
    def white(self) -> float:
        """Share of the variance of the noise that is uncorrelated."""
        return self.memory.noise.white if self.has_memory else 0.0

    @property
    def inflation(self) -> float:
        """Factor by which the memory of the noise enlarges errors."""
        if not self.has_memory:
            return 1.0
        # The share of a means nothing if the loss rate is not clear of zero.
        names = ("rate_mean", "share")[: 1 + (self.cycles == 1 and self.is_clear("rate_mean"))]
        # Without stated errors the raw errors have the noise level already.
        size = max(self._white_noise, 1.0) if self.expansion.min_factor else 1.0
        return max(1.0, *(getattr(self.errors, n) / getattr(self.raw, n) / size for n in names))

    def normal_equivalent(self, name: str) -> tuple[float, float]:
        """A value, and the standard deviation of a normal distribution with the same 95 % reach.

        It exceeds the error if few degrees of freedom determine the noise.
        """
        return float(getattr(self.values, name)), float(getattr(self.reach, name)) / NORMAL

    def value_and_error(self, name: str) -> tuple[float, float]:
        """A value and its error."""
        return float(getattr(self.values, name)), float(getattr(self.errors, name))

    def is_clear(self, name: str) -> bool:
        """True if a value is clear of zero."""
        value, error = self.normal_equivalent(name)
        return error < MAX_RELATIVE_ERROR * value

    def _parts(self, name: str) -> tuple[float, ...]:
        fields = (self.values, self.errors, self.raw, self.reach)
        return tuple(float(getattr(part, name)) for part in fields)

    def quantity(self, name: str, determined: bool) -> Quantity:
        """I0, a or b; without an error unless it is `determined`."""
        value, error, raw, reach = self._parts(name)
        if not (determined and math.isfinite(value) and math.isfinite(error)):
            return Quantity(value, None, UNITS[name])
        return Quantity.reaching(value, error, UNITS[name], raw, reach)

    def lifetime(self, name: str, determined: bool) -> Quantity:
        """Lifetime, h, from a loss rate; without an error unless it is `determined` and the rate
        clear of zero.
        """
        rate, error, raw, reach = self._parts(name)
        if not rate > 0:
            return Quantity(math.nan, None, "h")
        if not (determined and self.is_clear(name)):
            return Quantity(1 / rate / HOUR, None, "h")
        interval = tuple(1 / max(rate + sign * reach, 1e-300) / HOUR for sign in (1, -1))
        error, raw = (part / rate**2 / HOUR for part in (error, raw))
        return Quantity(1 / rate / HOUR, error, "h", raw, interval)

    @cached_property
    def is_separable(self) -> bool:
        """True if the law with constant a and b separates the two."""
        share, error = self.value_and_error("share")
        finite = math.isfinite(share) and math.isfinite(error)
        return finite and self.normal_equivalent("share")[1] < SEPARABLE

    @cached_property
    def separability(self) -> Separability:
        """Separability of a and b, by the law that leaves their share less certain.

        Through its bounds alone the free law may have the smaller error.
        """
        share, error = self.value_and_error("share")
        finite = math.isfinite(share) and math.isfinite(error)
        if finite and self.free is not None and self.free.share.error > error:
            share, error = self.free.share.value, self.free.share.error
        correlation, interval = 0.0, float(np.median(np.diff(self.time)))
        if self.correlation_time is not None:
            correlation = (1.0 - self.white) * math.exp(-interval / self.correlation_time)
        determined = self.correlation_time is None or self.is_clear("rate_mean")
        return Separability(
            separable=self.is_separable and (self.free is None or self.free.determines_share),
            share=share if finite else None,
            share_error=error if finite else None,
            correlation=self.correlation if math.isfinite(self.correlation) else None,
            residual_correlation=correlation,
            error_inflation=self.inflation if determined else None,
        )

    @property
    def outside(self) -> float:
        """Errors by which the share of a in the loss lies outside 0 to 1; nan if unknown."""
        share, error = self.normal_equivalent("share")
        return max(-share, share - 1.0) / error if error > 0 else math.nan

    @property
    def bends_impossibly(self) -> bool:
        """True if cycles bend as no loss does, and the monitor is not stated to drift."""
        return self.cycles > 1 and not self.monitor_changes and self.outside > OUTSIDE

    @cached_property
    def may_be_aliased(self) -> bool:
        """True if refills faster than the sampling may look like those that were found."""
        rate = float(self.values.rate_mean)
        if self.usual_cycle is None or not rate > 0:
            return False
        return unresolved(*self.usual_cycle, 1 / rate) > MAX_ALIASING

    @cached_property
    def hidden_refill(self) -> tuple[float, float] | None:
        """Loss in a cycle, and the smallest refill that the noise does not hide, mA, if the loss is
        smaller.

        Only for cycles that were found in the readings. A refill that holds the current gives back
        the loss of a cycle. It is found if the means of half a cycle before and after it differ
        enough.
        """
        rate = float(self.values.rate_mean)
        if self.usual_cycle is None or not rate > 0:
            return None
        memory = self.separability.residual_correlation
        half_cycle = max(self.time.size / self.cycles / 2, 1.0)
        mean_variance = (1 + memory) / (1 - memory) / half_cycle
        smallest = FOUND_REFILL * self.rms * math.sqrt(2 * min(mean_variance, 1.0))
        cycle_time = 2 * half_cycle * float(np.median(np.diff(self.time)))
        loss = self.expansion.pieces.units[1] * rate * cycle_time
        return None if loss >= smallest else (loss, smallest)

    @property
    def determines_lifetime(self) -> bool:
        """True if cycles bend like a decay, and no refill may have been missed."""
        return not self.bends_impossibly and not self.may_be_aliased and self.hidden_refill is None

    @property
    def refuted(self) -> bool:
        """True if the readings contradict constant a and b, or show values that no beam has."""
        if self.changed or self.constant_a.status is Status.poor_fit:
            return True
        if self.has_odd_end and self.alternative is not None:
            return True
        return self.cycles == 1 and any(
            value < -BELIEVED * error for value, error in map(self.normal_equivalent, "ab")
        )

    @cached_property
    def has_odd_end(self) -> bool:
        """True if a reading at an end of a decay lies off the law with a power of the current,
        fitted to the others, by more than chance.

        Such a reading alone determines the current there, and hides in the residuals.
        """
        if self.cycles > 1 or not self.expansion.converged:
            return False
        columns = np.linalg.qr(self.expansion.reduced[:, self.expansion.columns(POWER)])[0]
        residuals, dof = self.expansion.reduced[:, -1], len(columns) - columns.shape[1] - 1
        if dof < 1:
            return False
        residuals = residuals - columns @ (columns.T @ residuals)
        deleted = residuals**2 / np.maximum(1.0 - np.sum(columns**2, axis=1), EXACT)
        ratio = dof * deleted / np.maximum(residuals @ residuals - deleted, 1e-300)
        ends = np.sqrt(np.append(ratio[:MAX_SPIKE], ratio[-MAX_SPIKE:]))
        return bool(2 * MAX_SPIKE * 2 * stdtr(dof, -ends.max()) < POOR_FIT)

    @cached_property
    def alternative(self) -> BestAlternative | None:
        """Alternative that explains a single decay better than any smooth law."""
        if self.cycles > 1 or self.shaped or not self.expansion.converged or self.within_digits:
            return None
        return best_alternative(self.expansion)

    @property
    def within_digits(self) -> bool:
        """True if no residual exceeds half of the smallest step that the digits show.

        Rounding alone may then explain all residuals.
        """
        digit = None if self.record is None else self.record.resolution
        largest = np.max(np.abs(self.expansion.current_residuals))
        return digit is not None and bool(largest <= MIN_STEP_DIGITS / 2 * digit)

    @property
    def explained(self) -> BestAlternative | None:
        """Alternative that explains a refuted law better than a power of the current."""
        return self.alternative if self.refuted else None

    @cached_property
    def free(self) -> FreeLaw | None:
        """Posterior of the free law.

        None if the law is given, if an alternative that the free law does not contain explains the
        record better, or if the decay is within its noise.
        """
        return free_law(self.record, self.values) if self._law_is_free else None

    @cached_property
    def _law_is_free(self) -> bool:
        """True if the free law is the one to be fitted."""
        if self.law is Law.constant or self.shaped or self.cycles > 1:
            return False
        return self.is_clear("rate_mean") and (self.explained is None or self.has_slow_gas)

    @property
    def unphysical(self) -> bool:
        """True if a loss with a negative a or b is more probable than the free law."""
        return self._law_is_free and self.free is None

    @property
    def quotes_free_law(self) -> bool:
        """True if varying a and b are more probable than constant ones: their values are quoted
        then.
        """
        return self.free is not None and self.free.is_preferred

    @property
    def has_slow_gas(self) -> bool:
        """True if gas explains a refuted law, and lasts long enough for the free law to describe
        it.
        """
        if self.outgassing is None:
            return False
        return self.record.span <= OUTGASSING_PACES[1] * self.outgassing.time_constant.value * HOUR

    @property
    def outgassing(self) -> Outgassing | None:
        """Gas that explains a refuted law."""
        found = self.explained and self.explained.explanation
        return found if isinstance(found, Outgassing) else None

    @property
    def addition(self) -> str | None:
        """Name of the probable variation in addition to the law, as of `FreeLaw`."""
        return self.free and self.free.addition

    @cached_property
    def exponent_shifts(self) -> Physical | None:
        """Shifts of the values of many cycles by an exponent of a, within its prior and its error.

        None if the law is given, or a and b are not separable. The prior is normal, of width
        `EXPONENT_SD_BELOW` to either side.
        """
        if self.law is Law.constant or self.cycles == 1 or not self.separability.separable:
            return None
        columns, error = self.expansion.columns(POWER), self.exponent.error[0]
        posterior_sd = 1 / math.hypot(1 / EXPONENT_SD_BELOW, 1 / error)
        rows, plain = self.expansion.reduced[:, columns], self.expansion.columns()
        step = np.linalg.lstsq(rows[:, : len(plain)], -posterior_sd * rows[:, -1], rcond=None)[0]
        return Physical(*np.abs(self.expansion.slopes[:, columns] @ np.append(step, posterior_sd)))

    @cached_property
    def free_monitor_shifts(self) -> dict[str, float]:
        """Shifts of the quantities of the free law by a stated instability of the monitor.

        They differ from those with constant a and b, because the free law follows a drift.
        """
        quantities, shifts, record = self.free.quantities, [], self.record
        for change in self.monitor_changes:
            current = record.current + change * self.expansion.pieces.divisor
            shifted = replace(record, current=current, mean=record.mean_current)
            found = free_law(shifted, fit_law(Pieces.of(shifted)).values) or self.free
            shifts.append([found.quantities[n].value - q.value for n, q in quantities.items()])
        total = np.linalg.norm(shifts, axis=0) if shifts else np.zeros(len(quantities))
        return dict(zip(quantities, total.tolist(), strict=True))

    def with_free_law(self, name: str, exact: Quantity) -> Quantity:
        """Include the exponent and the drift of b, which the readings leave open, in a quantity.

        The value is that of constant a and b if these are more probable, else the median. A
        quantity that is not determined keeps its interval.
        """
        if not math.isfinite(exact.value):
            return exact
        if self.exponent_shifts is not None and exact.error is not None and not self.refuted:
            value, error, interval = exact.value, exact.error, exact.interval_95
            rate = name.replace("lifetime", "rate")
            unit = HOUR * value**2 if rate != name else 1.0
            shift = unit * float(getattr(self.exponent_shifts, rate))
        elif self.free is not None:
            found, shift = self.free.quantities[name], self.free_monitor_shifts[name]
            error, interval = found.error, found.interval_95
            value = found.value if self.quotes_free_law else exact.value
            value = float(np.clip(value, *interval))
        else:
            return exact
        low, high = (float(np.hypot(value - end, NORMAL * shift)) for end in interval)
        determined = exact.error is not None and (
            name not in ("a", "b") or self.separability.separable
        )
        error = math.hypot(error, shift) if determined else None
        return Quantity(value, error, exact.unit, exact.error_raw, (value - low, value + high))

    def fit_fields(self, determined: bool = True) -> dict[str, Any]:
        """Fields of a `DecayFit`, by name."""
        # A refuted law has no errors, except a and b if the law was given; I0 and lifetimes are
        # those of the alternative that explains the readings. The mean lifetime of many cycles
        # holds without a law.
        copied = ("chi2", "dof", "noise_inferred", "constant_a", "correlation_time", "lifetimes",
                  "inflation", "residuals", "course")  # fmt: skip
        refuted = self.refuted and self.free is None
        is_single, errors_known = self.cycles == 1, not (refuted and self.law is Law.free)
        exact = {"i0": self.quantity("i0", determined and is_single and not refuted)}
        separable = determined and self.is_separable and errors_known
        exact |= {name: self.quantity(name, separable) for name in "ab"}
        rates_determined = determined and not (refuted and is_single)
        exact |= {f"lifetime_{at}": self.lifetime(f"rate_{at}", rates_determined) for at in ENDS}
        found = {name: self.with_free_law(name, quantity) for name, quantity in exact.items()}
        found |= self.explained.quantities if refuted and self.explained is not None else {}
        found |= {"exact": exact, "free_law": self.free, "shaped": self.shaped}
        found |= {name: getattr(self, name) for name in copied}
        found["alternative"] = self.explained and self.explained.explanation
        return found | {"identifiability": self.separability}

    @cached_property
    def stated_odds(self) -> float:
        """Log odds that the stated errors are right, averaged over the memory of the noise."""
        columns = np.column_stack([self.expansion.residuals, self.expansion.rows[:, : POWER + 1]])
        if self.addition == "pumped":
            gas = further_columns(self.expansion, "relaxing", 1 / np.array(OUTGASSING_PACES))
            columns = np.column_stack([columns, gas])
        if self.addition == "settles":
            model = self.record.current / self.expansion.pieces.divisor + self.expansion.residuals
            settles = np.hstack([*settling_shapes()[::PACES_PER_OCTAVE]])
            shapes = from_nodes(self.record.time / self.record.span) @ settles
            columns = np.column_stack([columns, model[:, None] * shapes])
        products = Products.of(columns, self.time, stated=True, times=CLOSE)
        return products.stated_odds(products.left(), columns.shape[1] - 1)

    @cached_property
    def course(self) -> tuple[RatePart, ...]:
        """Lifetimes of the parts of many cycles with different loss rates.

        They have no errors if the mean lifetime has none.
        """
        parts, (span, _) = self.expansion.parts, self.expansion.pieces.units
        if parts is None:
            return ()
        slopes = np.hstack([np.tile([1.0, 0.0], (parts.first.size, 1)), parts.shares]) / span
        found = self.memory.moments(slopes, self.expansion.min_factor)
        shift = 0.0 if self.independent else found.shift
        rates = (self.expansion.numbers[LOSS - 1] + parts.departure) / span + shift
        since = self.time - self.time[0]
        ends = np.append(since[parts.first[1:]], since[-1])
        lifetimes = (lifetime_of(*pair, clear=True) for pair in
                     zip(rates, found.error, strict=True))  # fmt: skip
        if not self.determines_lifetime:
            lifetimes = (one.open() for one in lifetimes)
        return tuple(map(RatePart, since[parts.first].tolist(), ends.tolist(), lifetimes))

    @cached_property
    def lifetimes(self) -> LifetimeLaw | None:
        """Lifetime by current: for a decay if a constant a is refuted and the current is the cause,
        for many cycles if their currents differ enough.
        """
        refuted = self.constant_a.status is Status.poor_fit
        if self.cycles > 1:
            # The fit of a power has no parts.
            offered = self.separability.separable and not (refuted and self.course)
        else:
            plain = not self.shaped and self.expansion.pieces.gauge is None
            offered = plain and refuted and self.outgassing is None and self.addition is None
        return lifetime_law(self.expansion, self.independent, refuted) if offered else None

    def drift_of_one_error(self, name: str) -> float:
        """Linear drift of the monitor over the record, mA, that shifts a value by its error."""
        drift = self.time / self.time[-1] / self.expansion.pieces.divisor
        shifts = self.expansion.value_shifts(drift)
        shift = abs(float(getattr(shifts, name)))
        return float(getattr(self.errors, name)) / shift if shift > 0 else math.inf
