"""How a decay may depart from constant a and b: an exponent of the current, a change in time."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.special import stdtr

from beamfit.greybox.memory import Memory, memory_of
from beamfit.noise.correlated import remembers, whitened_of_both
from beamfit.quantity import Quantity
from beamfit.shown import shown
from beamfit.status import Status
from beamfit.studies.decay.law import (
    Expansion,
    Physical,
    constant_shape,
    lifetime_of,
    power_rates,
)
from beamfit.studies.decay.model import Solution, expanded, padded, solve_decay
from beamfit.studies.decay.record import DecayRecord
from beamfit.table import json_of

REJECTED = 1e-3
# Below this share of the current differences are those of the arithmetic, not of the beam.
EXACT = 1e-12
# An exponent known worse than this tells no bunch that lengthens from one that does not.
TELLING = 1 / 3
# A departure of so many errors is found with 90 % at a false alarm rate of `REJECTED`.
FOUND = 4.57
# Readings from which a search with an exponent learns all that it can.
ENOUGH = 1024
# Times looked at for a change of the loss rate, how often about the best of them, and how much more
# of chi² it must explain than an exponent, and of -2 ln L than noise with a memory does: it has a
# number more, chosen among many.
TIMES, FINER, BETTER = 40, 3, 15.0
# A change that leaves less of the squares is no noise that looks like one; two of them must leave
# far less, since slow noise looks like two more often.
REST, REST_OF_TWO = 0.1, 1e-3
# Two changes within so many readings are a step.
STEP = 3.0
# Currents at which a lifetime is offered, if the loss rate there is so many errors above zero.
CURRENTS, CLEAR = 5, 3.0


@shown
@dataclass(frozen=True)
class ConstantA:
    """Whether one record contradicts a constant a.

    Parameters
    ----------
    status : Status
        `converged` if a constant a describes the record, `poor_fit` if it is rejected,
        `unidentified` if the record cannot tell.
    message : str
        The verdict in a sentence.
    exponent : Quantity
        s in a(I) proportional to I^s: 0 for constant a, -1/3 for a strongly lengthening bunch,
        above 0 where the loss rate falls otherwise, as in a vacuum that recovers; NaN if the
        record cannot tell.
    p_value : float
        Probability of a worse contradiction if a is constant; NaN if the record cannot tell.
    """

    status: Status
    message: str
    exponent: Quantity
    p_value: float

    def widened(self, error: float) -> ConstantA:
        """The verdict with a further, independent error of the exponent."""
        exponent = self.exponent
        if not math.isfinite(exponent.value):
            return self
        whole = math.hypot(exponent.error, error)
        chance = math.erfc(abs(exponent.value) / whole / math.sqrt(2))
        return constant_a(exponent.value, whole, exponent.error_raw, chance)

    def __str__(self) -> str:
        return f"{self.status}. {self.message}"


def by_independent_noise(record: DecayRecord, solution: Solution) -> ConstantA:
    """Judge the exponent estimated beside I0, a and b, whose error is for noise of size 1."""
    exponent, error = float(solution.values.exponent), float(solution.errors.exponent)
    over, dof = 1.0 if record.error is None else record.error, max(len(record) - 4, 1)
    left = float(solution.sum_squares) - float(solution.fall)
    if left <= 0.0:  # what a straight line from here promises is more than there is
        left = float(power_law(record).sum_squares)
    unit = max(left / dof, float(np.mean((EXACT * record.current / over) ** 2)))
    whole = error * math.sqrt(unit if record.error is None else max(unit, 1.0))
    chance = 2 * stdtr(dof, -abs(exponent) / whole)
    return constant_a(exponent, whole, error * math.sqrt(unit), chance)


def constant_a(exponent: float, error: float, raw: float, chance: float) -> ConstantA:
    """Judge an exponent by its error and the chance of so large a one where a is constant."""
    if not error < TELLING:
        message = "The record cannot tell a constant a from one that depends on the current"
        unknown = Quantity(math.nan, None, "1")
        return ConstantA(Status.unidentified, f"{message}: record longer.", unknown, math.nan)
    found, chance = Quantity(float(exponent), float(error), "1", float(raw)), float(chance)
    if chance >= REJECTED:
        message = (
            f"A constant a describes the record (p = {chance:.2g}, exponent {found}; one of "
            f"{FOUND * error:.2g} would be seen)."
        )
        return ConstantA(Status.converged, message, found, chance)
    cause = (
        "so b of the constant-a fit is not a gas loss; fit with the shape of a"
        if exponent < 0
        else "which no bunch length does: look for a vacuum that changes, as after a fill"
    )
    message = (
        f"A constant a is rejected (p = {max(chance, 1e-300):.2g}): a goes as "
        f"I^{found.value:.3f}, {cause}."
    )
    return ConstantA(Status.poor_fit, message, found, chance)


def averaged(record: DecayRecord) -> DecayRecord:
    """A long record as the means of neighbouring readings: the curve is smooth between them."""
    if len(record) <= ENOUGH:
        return record
    return DecayRecord(*record.blocks(ENOUGH), record.name, monitor=record.monitor)


def power_law(record: DecayRecord) -> Solution:
    """The law with a free exponent: a going as I^s."""
    return solve_decay(*padded(record), free=np.ones(4), shape=constant_shape)


@shown
@dataclass(frozen=True)
class LifetimeLaw:
    """The lifetime as a function of the current, where constant a and b do not describe it.

    Parameters
    ----------
    current : tuple of float
        Currents, mA, from the last to the first of the record.
    lifetime : tuple of Quantity
        Lifetime at each, h, of a law with a going as a power of the current.
    exponent : Quantity
        The power.
    """

    current: tuple[float, ...]
    lifetime: tuple[Quantity, ...]
    exponent: Quantity

    @classmethod
    def of(
        cls, current: np.ndarray, rates: np.ndarray, errors: np.ndarray, exponent: Quantity
    ) -> LifetimeLaw:
        """The law of loss rates, 1/s, and their errors at some currents."""
        lifetimes = (lifetime_of(*pair, CLEAR) for pair in zip(rates, errors, strict=True))
        return cls(tuple(map(float, current)), tuple(lifetimes), exponent)

    def __str__(self) -> str:
        pairs = zip(self.current, self.lifetime, strict=True)
        return ", ".join(f"{lifetime} at {current:.4g} mA" for current, lifetime in pairs)


def lifetime_law(record: DecayRecord, correlated: bool) -> LifetimeLaw | None:
    """Lifetimes of the law with a free exponent; None where the search does not come to rest."""
    record = averaged(record)
    found = power_law(record)
    if not found.converged:
        return None
    values, mean, span = found.values, float(record.current.mean()), record.span
    x = np.geomspace(record.current.min(), record.current.max(), CURRENTS) / mean
    numbers = values.rate_mean * span, values.a * mean * span, values.exponent
    rates, slopes = power_rates(numbers, span, x)
    # By the four numbers of the search, of which I0 moves no rate; the exponent stands last.
    slopes = np.vstack([np.pad(slopes, ((0, 0), (1, 0))), np.eye(4)[3]])
    about = expanded(record, values, constant_shape, values.exponent)
    errors = quantity_errors(slopes, about, record, correlated)
    for change in record.monitor_changes:
        errors = np.hypot(errors, slopes @ np.linalg.lstsq(about.rows, change, rcond=None)[0])
    exponent = Quantity(float(values.exponent), float(errors[-1]), "1")
    return LifetimeLaw.of(x * mean, rates, errors[:-1], exponent)


def quantity_errors(
    slopes: np.ndarray, about: Expansion, record: DecayRecord, correlated: bool
) -> np.ndarray:
    """Errors of quantities by their slopes, with the noise that the residuals show."""
    given = float(record.error is not None)
    if correlated:
        return memory_of(about.rows, about.residuals, record.time).moments(slopes, given).error
    factor = np.linalg.qr(about.rows, mode="r")
    spread = np.linalg.norm(np.linalg.solve(factor.T, slopes.T), axis=0)
    dof = len(record) - about.rows.shape[1]
    size = math.sqrt(float(about.residuals @ about.residuals) / dof)
    return spread * max(size, given)


@shown
class Change(NamedTuple):
    """A change of the loss rate in a record.

    Attributes
    ----------
    time : float
        When, s from the first reading.
    before, after : Quantity
        Lifetime at that moment's current before and after it, h.
    left : array, shape (n,)
        Residuals of the law with the change, over their errors.
    then : Change or None
        A second one, as where a scraper was moved in and out again.
    """

    time: float
    before: Quantity
    after: Quantity
    left: np.ndarray
    then: Change | None = None

    def is_the_cause(self, residuals: np.ndarray, alike: float = math.inf) -> bool:
        """Whether it leaves hardly anything of correlated residuals, or independent noise that is
        by far likelier than noise with a memory, of which `alike` is -2 ln L.
        """
        count, few = (1, REST) if self.then is None else (2, REST_OF_TWO)
        rest, size = float(self.left @ self.left), self.left.size
        if rest < few * float(residuals @ residuals):
            return True
        likelier = size * math.log(rest / size) < alike - count * BETTER
        return likelier and not remembers(self.left, 3 + 2 * count)

    def to_json(self) -> dict[str, Any]:
        """Return the time and the two lifetimes as JSON's types, and of a second change too."""
        told = {"time": self.time, "before": self.before, "after": self.after}
        return json_of(told if self.then is None else told | {"then": self.then})

    def __str__(self) -> str:
        again = "" if self.then is None else f", and {str(self.then).partition('changed ')[2]}"
        return (
            f"the loss rate changed near t = {self.time:.4g} s, where the lifetime went from "
            f"{self.before} to {self.after}{again}"
        )


def change_of_rate(
    record: DecayRecord, about: Expansion, values: Physical, memory: Memory | None
) -> Change | None:
    """Look for a change of the loss rate, or two, that explains more than an exponent does.

    Every time is tried by linear least squares about the fit, and every pair of times if no single
    one leaves independent noise; None unless a change is improbable by chance at all times tried,
    and better than an exponent by `BETTER` of chi².
    """
    over = np.reshape(1.0 if record.error is None else record.error, (-1, 1))
    model = record.current + about.residuals * over[:, 0]
    interval = np.diff(record.time)

    def whiten(rows: np.ndarray) -> np.ndarray:
        return rows if memory is None else whitened_of_both(rows, interval, memory.noise)[0]

    rows = whiten(np.column_stack([about.rows, about.residuals]))
    basis = np.linalg.qr(rows[:, :3])[0]
    least = 1e-300 if record.error is None else 1.0

    def beside_the_law(columns: np.ndarray) -> np.ndarray:
        return columns - basis @ (basis.T @ columns)

    def kinks(times: np.ndarray) -> np.ndarray:
        return whiten(_kinks(record, model, float(values.b), times) / over)

    power, residual = beside_the_law(rows[:, 3:]).T
    by_power = _falls(power[:, None], residual)[0]

    def found(count: int) -> Change | None:
        dof = len(record) - 3 - count
        if dof < 1:
            return None
        at, fall = _best(lambda times: beside_the_law(kinks(times)), residual, record.span, count)
        unit = max((residual @ residual - fall) / dof, least)
        chance = TIMES**count * 2 * stdtr(dof, -math.sqrt(fall / unit))
        if chance > REJECTED or fall - by_power < count * BETTER * unit:
            return None
        columns = np.column_stack([rows[:, :3], kinks(at)])
        return _change(record, columns, rows[:, 4], values, at, math.sqrt(unit))

    one = found(1)
    if memory is not None or (one is not None and one.is_the_cause(about.residuals)):
        return one
    two = found(2)
    if two is None or not two.is_the_cause(about.residuals):
        return one
    # A refill, or a loss at once, is a step and no change of the loss rate.
    lasts = two.then.time - two.time > STEP * float(np.median(np.diff(record.time)))
    return two if lasts and two.after.value > 0 else one


def _best(
    columns_at: Callable[[np.ndarray], np.ndarray], residual: np.ndarray, span: float, count: int
) -> tuple[np.ndarray, float]:
    """The time of a change, or the two of a pair, that take most off the sum of squares."""
    windows = [np.linspace(0.05, 0.95, TIMES) * span] * count
    for _ in range(FINER):
        columns = [columns_at(times) for times in windows]
        falls = _falls(columns[0], residual) if count == 1 else _pairs(*columns, residual)
        best = np.unravel_index(np.argmax(falls), falls.shape)
        at = np.array([times[k] for times, k in zip(windows, best, strict=True)])
        steps = [times[1] - times[0] for times in windows]
        windows = [np.linspace(t - d, t + d, TIMES) for t, d in zip(at, steps, strict=True)]
    return np.sort(at), float(np.max(falls))


def _pairs(first: np.ndarray, second: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """What each column of the one and each of the other take together off the sum of squares."""
    first, second = (part / np.linalg.norm(part, axis=0) for part in (first, second))
    a, b, along = (first.T @ residual)[:, None], second.T @ residual, first.T @ second
    apart = 1 - along**2
    falls = (a**2 + b**2 - 2 * along * a * b) / np.where(apart > 1e-9, apart, np.inf)
    return np.where(apart > 1e-9, falls, 0.0)


def _falls(columns: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """What each column by itself takes off the sum of squares."""
    squares = np.sum(columns**2, axis=0)
    return (columns.T @ residual) ** 2 / np.where(squares > 0, squares, np.inf)


def _kinks(record: DecayRecord, model: np.ndarray, b: float, times: np.ndarray) -> np.ndarray:
    """Change of the current for a loss rate that is larger by 1/s from each time on.

    As in `bent_current`: -I² exp(bt) ∫ exp(-bt)/I dt from there.
    """
    time = record.time
    whole = record.integral(np.exp(-b * time) / model)
    since = np.maximum(whole[:, None] - np.interp(times, time, whole), 0.0)
    return -((model**2 * np.exp(b * time))[:, None]) * since


def _change(
    record: DecayRecord,
    columns: np.ndarray,
    residual: np.ndarray,
    values: Physical,
    at: np.ndarray,
    size: float,
) -> Change:
    """The lifetimes before and after each time, from the law with changes there."""
    mean, span = float(record.current.mean()), record.span
    half = np.linalg.inv(np.linalg.qr(columns, mode="r")) * size
    step = -np.linalg.lstsq(columns, residual, rcond=None)[0]
    left, told = residual + columns @ step, None
    for k in reversed(range(at.size)):
        x = float(np.interp(at[k], record.time, record.current)) / mean
        here = float(values.rate_mean) + float(values.a) * mean * (x - 1)
        slopes = np.tile([0, 1 / span, (x - 1) / span] + [0.0] * at.size, (2, 1))
        slopes[0, 3 : 3 + k] = slopes[1, 3 : 4 + k] = 1.0
        rates, errors = here + slopes @ step, np.linalg.norm(slopes @ half, axis=1)
        told = Change(float(at[k]), *map(lifetime_of, rates, errors), left, told)
    return told
