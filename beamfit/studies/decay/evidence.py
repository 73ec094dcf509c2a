"""What a solution of the decay law is worth: values and errors with the noise that is there."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from beamfit.greybox.memory import Memory, Whitened, remembered
from beamfit.lifetime.decay import HOUR
from beamfit.noise.correlated import remembers
from beamfit.noise.memory import CLOSE, Products
from beamfit.quantity import Quantity
from beamfit.shown import shown
from beamfit.statistics import reach_of
from beamfit.status import Status
from beamfit.studies.decay.departures import (
    Change,
    ConstantA,
    LifetimeLaw,
    by_independent_noise,
    change_of_rate,
    constant_a,
    lifetime_law,
)
from beamfit.studies.decay.law import Expansion, Physical, Shape
from beamfit.studies.decay.marginal import FreeLaw, Law, free_law
from beamfit.studies.decay.model import Solution, expanded
from beamfit.studies.decay.outgassing import Outgassing, outgassing_of
from beamfit.studies.decay.record import DecayRecord

UNITS = {
    "a": "1/(mA s)",
    "b": "1/s",
    "i0": "mA",
    "lifetime_start": "h",
    "lifetime_end": "h",
    "lifetime_mean": "h",
}
ENDS = ("start", "end", "mean")
# The share of a in the loss lies between 0 and 1: known to 0.2, the record tells pure Touschek
# from pure gas at five standard deviations; known worse, a and b are one number.
SEPARABLE = 0.2
# A loss rate less than three errors from zero leaves the lifetime without an upper limit.
DETERMINED = 1 / 3
# How many errors below zero an unphysical a or b, or a rising current, is believed.
BELIEVED = 5.0
NUMBERS = 3
# Standard deviations that hold 95 % of a normal distribution.
NORMAL = 1.96
# A drift under white noise counts from so many standard errors on: it enlarges errors much.
SLOW = 3.0
# Of so few readings the noise tells nothing of its memory.
FEWEST = 12
# An exponent as of no bunch length refutes the free law, too, if that is likelier than not.
LIKELIER = 0.5


@shown
@dataclass(frozen=True)
class Separability:
    """Whether the record tells a from b.

    Parameters
    ----------
    separable : bool
        Whether the share of a in the loss is known to better than 0.2.
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


class Weighed:
    """What is quoted of a decay, or of many cycles: values with errors, and what refutes them.

    Attributes
    ----------
    values, errors, raw, reach : Physical
        What is quoted; its standard deviations; those for errors as stated and independent; and
        how far 95 % reach.
    constant_a : ConstantA
        Whether the readings contradict a constant a.
    time : array, shape (n,)
        Of the readings, s.
    correlation : float
        Of a and b.
    inflation : float
        By how much the memory of the noise enlarges errors.
    correlation_time : float or None
        Of the part of the errors that has one, s; None where they are independent.
    white : float
        The share of their variance that has none.
    """

    values: Physical
    errors: Physical
    raw: Physical
    reach: Physical
    constant_a: ConstantA
    time: np.ndarray
    correlation: float
    inflation: float
    correlation_time: float | None
    white: float
    change: Change | None = None
    outgassing: Outgassing | None = None
    free: FreeLaw | None = None

    def told(self, name: str) -> tuple[float, ...]:
        """A value, its error, that for errors as stated, and how far 95 % reach."""
        parts = (self.values, self.errors, self.raw, self.reach)
        return tuple(float(getattr(part, name)) for part in parts)

    def scaled(self, name: str) -> tuple[float, float]:
        """A value and its error."""
        return self.told(name)[:2]

    def sure(self, name: str) -> tuple[float, float]:
        """A value, and the error of a normal number that reaches as far: few residuals count."""
        value, *_, reach = self.told(name)
        return value, reach / NORMAL

    def quantity(self, name: str, known: bool) -> Quantity:
        """I0, a or b; without an error where it is not determined."""
        value, error, raw, reach = self.told(name)
        if not (known and math.isfinite(value) and math.isfinite(error)):
            return Quantity(value, None, UNITS[name])
        return Quantity.reaching(value, error, UNITS[name], raw, reach)

    def lifetime(self, name: str, known: bool) -> Quantity:
        """Lifetime in hours from a loss rate; no error where the rate is not clear of zero."""
        rate, error, raw, reach = self.told(name)
        if not rate > 0:
            return Quantity(math.nan, None, "h")
        if not (known and self.is_clear(name)):
            return Quantity(1 / rate / HOUR, None, "h")
        interval = tuple(1 / max(rate + sign * reach, 1e-300) / HOUR for sign in (1, -1))
        error, raw = (part / rate**2 / HOUR for part in (error, raw))
        return Quantity(1 / rate / HOUR, error, "h", raw, interval)

    def is_clear(self, name: str) -> bool:
        """Whether a value is clear of zero."""
        value, error = self.sure(name)
        return error < DETERMINED * value

    def widely(self, name: str, exact: Quantity) -> Quantity:
        """A quantity where the law is free; here it is not."""
        return exact

    @cached_property
    def separability(self) -> Separability:
        """Of a and b."""
        share, error = self.scaled("share")
        finite = math.isfinite(share) and math.isfinite(error)
        length, usual = self.correlation_time, float(np.median(np.diff(self.time)))
        told = length is None or self.is_clear("rate_mean")
        alike = 0.0 if length is None else (1.0 - self.white) * math.exp(-usual / length)
        return Separability(
            separable=finite and self.sure("share")[1] < SEPARABLE,
            share=share if finite else None,
            share_error=error if finite else None,
            correlation=self.correlation if math.isfinite(self.correlation) else None,
            residual_correlation=alike,
            error_inflation=self.inflation if told else None,
        )

    def widened(self, about: Expansion, changes: Sequence[np.ndarray]) -> Self:
        """With what moves all readings together, over their errors, as a part of the errors."""
        if not len(changes):
            return self
        moved = np.linalg.norm([about.moved(change) for change in changes], axis=0)
        return replace(
            self, errors=Physical(*np.hypot(self.errors, moved)),
            reach=Physical(*np.hypot(self.reach, NORMAL * moved)),
            constant_a=self.constant_a.widened(moved[-1]),
        )  # fmt: skip

    def quoted(self, known: bool = True) -> dict[str, Any]:
        """What a `DecayFit` has of this, by its names."""
        apart = known and self.separability.separable
        same = ("chi2", "dof", "noise_inferred", "constant_a", "correlation_time", "lifetimes")
        exact = {"i0": self.quantity("i0", known)}
        exact |= {name: self.quantity(name, apart) for name in "ab"}
        exact |= {f"lifetime_{at}": self.lifetime(f"rate_{at}", known) for at in ENDS}
        found = {name: self.widely(name, quantity) for name, quantity in exact.items()}
        found |= {"exact": exact, "free_law": self.free}
        found |= {name: getattr(self, name) for name in (*same, "inflation")}
        return found | {"identifiability": self.separability}


@dataclass(frozen=True, eq=False)
class Evidence(Weighed):
    """What the rules look at: a record, what was found, and the size and memory of its noise.

    The rest is as of `Weighed`.

    Parameters
    ----------
    record : DecayRecord
        The readings.
    solution : Solution
        By plain least squares.
    residuals : array, shape (n,)
        Model less reading, mA.
    chi2 : float
        Sum of squares in units of the errors, whitened; equal to `dof` where there are none.
    dof : int
        Readings less numbers.
    noise : float
        What multiplies errors that were given (at least 1), or the noise in mA.
    memory : Memory or None
        What the record tells of the correlation time, where the errors are correlated.
    changed : bool
        Whether one change of the loss rate is what correlates the residuals.
    """

    record: DecayRecord
    solution: Solution
    shape: Shape | None
    values: Physical
    errors: Physical
    raw: Physical
    reach: Physical
    residuals: np.ndarray
    chi2: float
    dof: int
    noise: float
    memory: Memory | None
    constant_a: ConstantA
    changed: bool
    law: Law = Law.constant

    @classmethod
    def of(
        cls, record: DecayRecord, solution: Solution, shape: Shape | None = None,
        law: Law = Law.constant,
    ) -> Evidence:  # fmt: skip
        """Weigh a solution; without errors the weights were 1/mA, and residuals are the noise.
        What is stated of the monitor's stability is part of the errors.
        """
        found = replace(cls._by_noise(record, solution, shape), law=law)
        changes = record.monitor_changes
        return found.widened(found.about, changes) if changes and solution.converged else found

    @classmethod
    def _by_noise(cls, record: DecayRecord, solution: Solution, shape: Shape | None) -> Evidence:
        residuals = np.asarray(solution.residuals[: len(record)])
        over = residuals if record.error is None else residuals / record.error
        if bool(solution.converged) and len(record) >= FEWEST and remembers(over, NUMBERS, SLOW):
            found = expanded(record, solution.values, shape)
            if remembers(found.left, NUMBERS + 1, SLOW):
                seen = remembered(found.rows, found.residuals, record.time)
                change = change_of_rate(record, found, solution.values, None)
                if change and change.is_the_cause(found.residuals, seen.least(NUMBERS)):
                    return cls._independent(record, solution, shape, changed=True)
                return cls._with_memory(record, solution, shape, found, seen)
        return cls._independent(record, solution, shape)

    @classmethod
    def _independent(
        cls, record: DecayRecord, solution: Solution, shape: Shape | None, changed: bool = False
    ) -> Evidence:
        given, dof = record.error is not None, len(record) - NUMBERS
        squares = float(solution.sum_squares)
        chi2, raw = (squares, 1.0) if given else (float(dof), math.sqrt(squares / dof))
        noise = raw * max(1.0, math.sqrt(chi2 / dof))
        errors = _times(solution.errors, noise)
        return cls(
            record, solution, shape, _times(solution.values, 1.0), errors,
            _times(solution.errors, raw), _times(errors, reach_of(math.inf if given else dof)),
            np.asarray(solution.residuals[: len(record)]), chi2, dof, noise, None,
            by_independent_noise(record, solution), changed,
        )  # fmt: skip

    @classmethod
    def _with_memory(
        cls, record: DecayRecord, solution: Solution, shape: Shape | None, found: Expansion,
        seen: Whitened,
    ) -> Evidence:  # fmt: skip
        """Generalised least squares about the solution, the exponent free and held."""
        given = float(record.error is not None)
        power, held = seen.memory().moments(found.slopes, given), seen.memory(NUMBERS)
        moved = held.moments(found.slopes[:, :NUMBERS], given)
        after = found.residuals + found.rows[:, :NUMBERS] @ held.mean_step
        # How far a drift gets in the end says nothing of the errors that were stated.
        squares = float(after @ after) if held.noise.white else held.squares[held.likely]
        size = math.sqrt(squares / held.dof)
        raw = 1.0 if given else math.sqrt(float(solution.sum_squares) / held.dof)
        raw_exponent = float(solution.errors.exponent) * raw
        test = constant_a(power.shift[-1], power.error[-1], raw_exponent, power.chance[-1])
        return cls(
            record, solution, shape,
            Physical(*(np.array(solution.values) + moved.shift)),
            Physical(*moved.error), _times(solution.errors, raw), Physical(*moved.reach),
            after * (record.error if given else 1.0),
            squares if given else float(held.dof), held.dof,
            max(1.0, size) if given else size, held, test, False,
        )  # fmt: skip

    @property
    def noise_inferred(self) -> bool:
        """Whether the residuals tell the noise."""
        return self.record.error is None

    @property
    def time(self) -> np.ndarray:
        """Of the readings, s."""
        return self.record.time

    @property
    def correlation(self) -> float:
        """Of a and b."""
        return float(self.solution.correlation)

    @property
    def inflation(self) -> float:
        """By how much the memory of the noise enlarges errors."""
        if self.memory is None:
            return 1.0
        plain = math.sqrt(float(self.solution.sum_squares) / self.dof)
        plain = plain if self.noise_inferred else max(plain, 1.0)
        # Of a loss rate that is not clear of zero the share of a says nothing.
        names = ("rate_mean", "share")[: 1 + self.is_clear("rate_mean")]
        enlarged, before = self.errors, self.solution.errors
        return max(getattr(enlarged, n) / getattr(before, n) for n in names) / plain

    @property
    def correlation_time(self) -> float | None:
        """Of the part of the errors that has one, s; None where they are independent."""
        return None if self.memory is None else self.memory.noise.time

    @property
    def white(self) -> float:
        """The share of their variance that has none."""
        return 0.0 if self.memory is None else self.memory.noise.white

    @property
    def refuted(self) -> bool:
        """Whether the record contradicts constant a and b, or shows values that no beam has."""
        if self.changed or self.constant_a.status is Status.poor_fit:
            return True
        return any(value < -BELIEVED * error for value, error in map(self.sure, "ab"))

    @cached_property
    def about(self) -> Expansion:
        """The law about the solution."""
        return expanded(self.record, self.solution.values, self.shape)

    @cached_property
    def free(self) -> FreeLaw | None:
        """What the record tells where its law is free; None where the law is known, something
        else than the law explains the record better, or the decay is within its noise.
        """
        known = self.law is Law.constant or self.shape is not None
        if known or not self.is_clear("rate_mean") or self.explained:
            return None
        found = free_law(self.record, self.values)
        return None if found is None or found.odd > LIKELIER else found

    @property
    def explained(self) -> bool:
        """Whether a change in time explains a refuted law better than a power of the current."""
        return self.refuted and (self.outgassing is not None or self.change is not None)

    @cached_property
    def stated_odds(self) -> float:
        """Log odds that the stated errors are right, whatever memory the noise has."""
        columns = np.column_stack([self.about.residuals, self.about.rows])
        products = Products.of(columns, self.record.time, stated=True, times=CLOSE)
        rest, rows = products.matrix[:, :1, 1:], products.matrix[:, 1:, 1:]
        step = np.linalg.solve(rows, np.swapaxes(rest, 1, 2))
        squares = products.matrix[:, 0, 0] - (rest @ step)[:, 0, 0]
        return products.stated_odds(np.maximum(squares, 0.0), rows.shape[1])

    def widely(self, name: str, exact: Quantity) -> Quantity:
        """A quantity with the exponent and the drift of b that the record leaves open.

        The value is that of constant a and b where they are likelier, else the median. What is not
        determined keeps its interval.
        """
        if self.free is None or not math.isfinite(exact.value):
            return exact
        span = self.free.spans[name]
        value = exact.value if self.free.constant > LIKELIER else span.median
        value = float(np.clip(value, *span.interval))
        moved = 0.0
        if self.record.monitor_changes:
            at = name.replace("lifetime", "rate")
            by = [float(getattr(self.about.moved(c), at)) for c in self.record.monitor_changes]
            moved = math.hypot(*by) * (HOUR * value**2 if at != name else 1.0)
        error, interval = span.beside(value, moved)
        error = None if exact.error is None else error
        return Quantity(value, error, exact.unit, exact.error_raw, interval)

    @cached_property
    def lifetimes(self) -> LifetimeLaw | None:
        """The lifetime by current, where a constant a is refuted and it is the current's doing."""
        plain = self.shape is None and self.record.gauge is None
        if not plain or self.constant_a.status is not Status.poor_fit or self.outgassing:
            return None
        return lifetime_law(self.record, self.memory is not None)

    @cached_property
    def change(self) -> Change | None:
        """A change of the loss rate in the record that explains it better than an exponent."""
        return change_of_rate(self.record, self.about, self.solution.values, self.memory)

    @cached_property
    def outgassing(self) -> Outgassing | None:
        """A gas loss that relaxes, where that explains a refuted law better than all else."""
        if not self.refuted or self.shape is not None or self.record.gauge is not None:
            return None
        return outgassing_of(self.record, self.solution.values, self.change)

    def drift_of_one_error(self, name: str) -> float:
        """Straight drift of the monitor over the record, mA, that moves a value by its error."""
        moved = abs(float(getattr(self.solution.drift, name)))
        return float(getattr(self.errors, name)) / moved if moved > 0 else math.inf


def _times(numbers: Physical, factor: float) -> Physical:
    return Physical(*(float(number) * factor for number in numbers))
