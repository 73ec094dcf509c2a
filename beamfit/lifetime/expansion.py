"""Expansion of the decay law about its fitted parameters, for single decays, many cycles and
further losses.

Each piece (a decay or a cycle) has a starting current of its own, which every step of the search
eliminates. Units of the search are the longest piece and the mean current. The parameters are the
loss at the mean current and its quadratic part: these are nearly uncorrelated, unlike a and b. Any
record determines the first well, only a long one the second.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jax import Array

from beamfit.lifetime.decay_law import MIN_CURRENT, Moments, beam_current
from beamfit.lifetime.record import DecayRecord, Monitor
from beamfit.noise.correlated import Memory, Whitened, usual_noises, whitened_by_each
from beamfit.noise.memory import CorrelatedNoise, Levels, remembers
from beamfit.quantity import HOUR, Quantity

# Columns of the slopes: starting current of the piece, loss at the mean current and its quadratic
# part, power of a, a further loss and its time.
LEVEL, LOSS, QUADRATIC, POWER, FURTHER, WHEN = range(6)
PLAIN = (LOSS, QUADRATIC)
# Width of the weak prior on the quadratic part, in units of the whole loss (plus three errors).
# Physics allows 0 to 1: a width of 30 moves no value that the record determines (4e-5 of it where a
# and b are just separable), and keeps the search finite for records too short for their noise.
PRIOR_WIDTH = 30.0
# A search has converged if the next step would move the curve by less than this share of the noise:
# the one after it would be below rounding.
STEP_TOLERANCE = 1e-4
# Largest numbers of steps and of halvings of a step.
MAX_ITERATIONS, MAX_HALVINGS = 100, 30
# Loss and quadratic part of a mild decay, for which the law always has a value.
PLAIN_DECAY = np.array([0.1, 0.05])
# Ranges of the power of a and of the time of a further loss.
POWER_RANGE, TIME_RANGE = (-0.95, 3.0), (1e-3, 10.0)
# A drift under white noise counts only from this many standard errors on, since it enlarges errors
# much.
DRIFT_THRESHOLD = 3.0
# Smallest number of readings for which the memory of the noise is estimated.
MIN_MEMORY_READINGS = 12
# Largest relative error of a determined loss rate: three errors above zero. A less certain one
# leaves the lifetime without an upper limit.
MAX_RELATIVE_ERROR = 1 / 3
# Readings at the edges of cycles may be shifted, as within a refill or next to one: standard
# deviations of the shift common to all cycles, over the noise, and their prior probabilities.
SHIFTS = ((0.01, 0.5), *((width, 0.1) for width in (0.1, 0.3, 1.0, 3.0, 10.0)))
# Shortest cycle, in readings, with such a shift: the inner readings still determine a rate.
MIN_SHIFTED_READINGS = 5
# Steps of numerical differentiation. Imaginary steps lose no digits; a given shape of a takes real
# numbers.
IMAGINARY_STEP, REAL_STEP = 1e-30, 1e-5

Shape = Callable[[Array], Array]


class Physical(NamedTuple):
    """Values of a law, in s and mA.

    Attributes
    ----------
    i0 : float
        Current at the first reading; for many pieces the mean of their first currents.
    a, b : float
        Coefficients of the law, 1/(mA s) and 1/s.
    rate_start, rate_end, rate_mean : float
        Loss rates at the first and the last reading (for many pieces at the highest and the lowest
        current) and at the mean current.
    share : float
        Share of a in the loss at the mean current.
    exponent : float
        Power by which a departs from its shape.
    """

    i0: Array
    a: Array
    b: Array
    rate_start: Array
    rate_end: Array
    rate_mean: Array
    share: Array
    exponent: Array


def lifetime_of(rate: float, error: float, clear: bool = False) -> Quantity:
    """Lifetime, h, of a loss rate, 1/s; undetermined if `clear` is asked and the rate is not."""
    if clear and not error < MAX_RELATIVE_ERROR * rate:
        return Quantity(math.nan, None, "h")
    return Quantity(float(1 / rate / HOUR), float(error / rate**2 / HOUR), "h")


@dataclass(frozen=True, eq=False)
class Pieces:
    """Readings of one decay or of many cycles, in a row.

    Parameters
    ----------
    time, since : array, shape (n,)
        Times, and times since the first reading of the piece, s.
    current, error : array, shape (n,)
        mA; `error` may be None.
    first : array of int, shape (k,)
        Index of the first reading of each piece.
    gauge : array, shape (n,), or None
        Integral of the pressure, as `DecayRecord.gauge`, for a single piece.
    monitor : Monitor or None
        Stated stability of the monitor.
    mean : float or None
        Mean current, mA, if it is not that of the readings.
    """

    time: np.ndarray
    since: np.ndarray
    current: np.ndarray
    error: np.ndarray | None
    first: np.ndarray
    gauge: np.ndarray | None = None
    monitor: Monitor | None = None
    mean: float | None = None

    @classmethod
    def of(cls, record: DecayRecord) -> Pieces:
        """Build the pieces of a single decay."""
        time, current, first = record.time, record.current, np.zeros(1, int)
        more = record.gauge, record.monitor, record.mean
        return cls(time, time, current, record.error, first, *more)

    @cached_property
    def lengths(self) -> np.ndarray:
        """Number of readings in each piece."""
        return np.diff(self.first, append=self.time.size)

    @cached_property
    def index_in_piece(self) -> np.ndarray:
        """Index of each reading within its piece."""
        return np.arange(self.time.size) - np.repeat(self.first, self.lengths)

    @cached_property
    def units(self) -> tuple[float, float]:
        """Units of the search: the longest piece, s, and the mean current, mA."""
        mean = float(self.current.mean()) if self.mean is None else self.mean
        return float(self.since.max()), mean

    @cached_property
    def relative_current(self) -> np.ndarray:
        """Currents over their mean."""
        return self.current / self.units[1]

    @cached_property
    def weight(self) -> np.ndarray:
        """Weight of a residual in units of the mean current."""
        return np.broadcast_to(self.units[1] / np.asarray(self.divisor), self.time.shape)

    @cached_property
    def at(self) -> Moments:
        """Times in units of the longest piece."""
        gas = None if self.gauge is None else self.gauge / self.units[0]
        return Moments(self.since / self.units[0], gas)

    @property
    def pressure(self) -> np.ndarray:
        """Pressure over its mean at the first and last reading."""
        if self.gauge is None:
            return np.ones(2)
        return (np.diff(self.gauge) / np.diff(self.time))[[0, -1]]

    def per_reading(self, values: np.ndarray) -> np.ndarray:
        """Repeat values of the pieces for each reading."""
        return np.repeat(values, self.lengths) if values.size > 1 else values[0]

    def project(self, own: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Least-squares multiples of a column that explain values, piece by piece."""
        squares = np.maximum(np.add.reduceat(own**2, self.first), 1e-300)
        return np.add.reduceat(own * values, self.first) / squares

    @property
    def divisor(self) -> np.ndarray | float:
        """Divisor of the residuals: the errors, mA, or 1 mA without errors."""
        return 1.0 if self.error is None else self.error

    @property
    def monitor_changes(self) -> list[np.ndarray]:
        """Changes of the readings by the stated instability of the monitor, over their errors."""
        since = self.time - self.time[0]
        changes = {} if self.monitor is None else self.monitor.changes(since)
        return [change / self.divisor for change in changes.values()]

    def select(self, kept: np.ndarray, fewest: int) -> Pieces:
        """Keep some of the readings; leave out pieces that keep fewer than `fewest`."""
        count = np.add.reduceat(kept.astype(int), self.first)
        kept = kept & np.repeat(count >= fewest, self.lengths)
        count = count[count >= fewest]
        first = np.cumsum(count) - count
        time = self.time[kept]
        since = time - np.repeat(time[first], count)
        error = None if self.error is None else self.error[kept]
        return Pieces(time, since, self.current[kept], error, first, None, self.monitor)


class Parts(NamedTuple):
    """Parts of many cycles, each with a loss rate of its own.

    Attributes
    ----------
    first : array of int, shape (p,)
        Index of the first reading of each part.
    shares : array, shape (p, p - 1)
        Matrix from the departures of the first p - 1 parts to those of all parts.
    departure : array, shape (p,)
        Departure of each loss from the mean, in units of the search.
    """

    first: np.ndarray
    shares: np.ndarray
    departure: np.ndarray


@lru_cache(maxsize=16)  # a new function would be compiled again
def _of_relative_current(shape: Shape, mean: float) -> Shape:
    """Convert a shape of the current in mA to one of the current over its mean."""
    return lambda x: shape(x * mean)


def least_squares_step(rows: np.ndarray, prior_rows: np.ndarray) -> np.ndarray:
    """Least-squares step of the parameters, given columns, the last of them the residuals, and
    prior rows.

    Examples
    --------
    >>> rows = np.array([[1.0, -1.0], [1.0, -3.0]])
    >>> least_squares_step(rows, np.zeros((0, 2))).round(9).tolist()
    [2.0]
    """
    scale = np.linalg.norm(rows[:, :-1], axis=0) + 1e-300
    scaled = np.vstack([rows, prior_rows]) / np.append(scale, 1.0)
    scaled = np.vstack([scaled, 1e-15 * np.eye(scale.size, scale.size + 1)])
    factor = np.linalg.qr(scaled, mode="r")
    return -np.linalg.solve(factor[:-1, :-1], factor[:-1, -1]) / scale


class _Start(NamedTuple):
    """Start of a search.

    Attributes
    ----------
    both : array, shape (2,)
        Loss and quadratic part.
    level : array, shape (k,)
        Starting currents of the pieces, over the mean.
    noise : float
        Noise level, in units of the weighted residuals.
    width : float
        Width of the prior on the quadratic part.
    """

    both: np.ndarray
    level: np.ndarray
    noise: float
    width: float

    @classmethod
    def of(cls, pieces: Pieces) -> _Start:
        """Estimate the start from integrals, which average the noise: it is good for a decay of any
        length.

        Integrated once, the law is linear: x(t) = level - loss ∫x dt - quadratic ∫x (x - 1) dt.
        """
        x, weight, inside = pieces.relative_current, pieces.weight, np.diff(pieces.at.time)

        def integral(values: np.ndarray) -> np.ndarray:
            cumulative = np.append(0.0, np.cumsum(inside * (values[1:] + values[:-1]) / 2))
            return cumulative - pieces.per_reading(cumulative[pieces.first])

        columns = np.stack([-integral(x), -integral(x * (x - 1)), x], axis=1) * weight[:, None]
        loss, bend, y = Levels(pieces.first, weight).left(columns).T
        root = math.sqrt(max(x.size - pieces.first.size - 2, 1))
        size = np.linalg.norm(loss) + 1e-300
        slope = (loss @ y) / size**2
        noise = np.linalg.norm(y - slope * loss) / root
        width = PRIOR_WIDTH * (abs(slope) + 3 * noise / size) + 1e-300
        prior_row = np.array([[0.0, noise / width, 0.0]])
        both = least_squares_step(np.stack([loss, bend, -y], axis=1), prior_row)
        residual = np.linalg.norm(y - both @ (loss, bend)) / root
        smallest = 1e-15 * np.linalg.norm(weight * x) / root
        level = pieces.project(weight, columns[:, 2] - columns[:, :2] @ both)
        return cls(both, level, max(min(noise, residual), smallest), width)


def _parameter_bounds(count: int) -> np.ndarray:
    """Lower and upper bounds of `count` parameters, shape (2, count)."""
    further = count // 2 - 1
    return np.array(
        [(-np.inf, np.inf)] * 2 + [POWER_RANGE] + [(-np.inf, np.inf), TIME_RANGE] * further
    ).T


@dataclass(frozen=True, eq=False)
class Expansion:
    """Decay law, expanded to first order about some parameters.

    Parameters
    ----------
    pieces : Pieces
        The readings.
    numbers : array, shape (3 + 2 k,)
        Parameters: loss, quadratic part, power, further losses and their times, in units of the
        search.
    level : array, shape (pieces,)
        Current at the start of each piece, over the mean.
    residuals : array, shape (n,)
        Model less reading, over the errors; in mA without errors.
    rows : array, shape (n, 4 + 2 k)
        Slopes of the residuals by the starting current of the piece and the parameters.
    values : Physical
        Values of the law.
    slopes : array, shape (8, 4 + 2 k)
        Slopes of these values.
    prior : float
        Weight of the prior on the quadratic part.
    converged : bool
        True if the search converged, to finite values.
    parts : Parts or None
        Parts with loss rates of their own, if the cycles have several; the last columns belong to
        them.
    """

    pieces: Pieces
    numbers: np.ndarray
    level: np.ndarray
    residuals: np.ndarray
    rows: np.ndarray
    values: Physical
    slopes: np.ndarray
    prior: float = 0.0
    converged: bool = True
    parts: Parts | None = None

    @property
    def current_residuals(self) -> np.ndarray:
        """Model less reading, mA, shape (n,)."""
        return self.residuals * self.pieces.divisor

    @classmethod
    def of(
        cls, pieces: Pieces, numbers: np.ndarray, level: np.ndarray, kind: str | None = None,
        shape: Shape | None = None, departure: np.ndarray | float = 0.0,
    ) -> Expansion:  # fmt: skip
        """Expand the law about parameters and starting currents.

        `departure` is the departure of the loss from the mean for each reading.
        """
        (span, mean), many = pieces.units, level.size > 1
        shape = shape and _of_relative_current(shape, mean)
        highest = np.array([pieces.relative_current.max(), pieces.relative_current.min()])

        def evaluate(step: np.ndarray) -> np.ndarray:
            loss, quadratic, power, *further = numbers + step[1:]
            begin, parameters = level + step[0], (loss + departure, quadratic, power, *further)
            model = beam_current(pieces.per_reading(begin), parameters, pieces.at, kind, shape)
            x = highest if many else np.array([begin[0], model[-1]])
            rates = quadratic * np.where(x.real > MIN_CURRENT, x, MIN_CURRENT) ** (1 + power)
            rates = rates * (1.0 if shape is None else np.asarray(shape(x) / shape(1.0)))
            b = loss - quadratic
            values = begin.mean(), quadratic, b, *(rates + b * pieces.pressure), loss
            values = *values, quadratic / loss, power
            return np.concatenate([pieces.weight * (model - pieces.relative_current), values])

        directions, count = np.eye(numbers.size + 1), pieces.time.size
        if shape is None:
            found = np.array(
                [evaluate(1j * IMAGINARY_STEP * direction) for direction in directions]
            )
            found, slopes = found[0].real, found.imag.T / IMAGINARY_STEP
        else:
            found = evaluate(0.0 * directions[0])
            steps = REAL_STEP * directions
            slopes = [(evaluate(step) - evaluate(-step)) / (2 * REAL_STEP) for step in steps]
            slopes = np.array(slopes).T
        unit = np.array([mean, 1 / mean / span, *[1 / span] * 4, 1.0, 1.0])
        values, value_slopes = found[count:] * unit, slopes[count:] * unit[:, None]
        value_slopes[0] = 0.0 if many else value_slopes[0]
        finite = np.isfinite(slopes).all() and np.isfinite(found).all()
        return cls(
            pieces, numbers, level, found[:count], slopes[:count], Physical(*values), value_slopes,
            converged=bool(finite),
        )  # fmt: skip

    @classmethod
    def at(cls, record: DecayRecord, i0: float, a: float, b: float) -> Expansion:
        """Expand the law about constant a and b, for the readings of a record."""
        pieces = Pieces.of(record)
        span, mean = pieces.units
        numbers = np.array([(a * mean + b) * span, a * mean * span, 0.0])
        return cls.of(pieces, numbers, np.array([i0 / mean]))

    @cached_property
    def levels(self) -> Levels | None:
        """Starting currents of many pieces, which are eliminated; None for a single piece."""
        return Levels(self.pieces.first, self.rows[:, LEVEL]) if self.level.size > 1 else None

    @property
    def min_factor(self) -> float:
        """Smallest factor on the errors: 1 if errors are stated, else 0."""
        return float(self.pieces.error is not None)

    @cached_property
    def has_memory(self) -> bool:
        """True if the residuals are correlated and no power of the current explains that."""
        many = 0 if self.levels is None else self.level.size
        columns, residuals = self.reduced[:, self.columns(POWER)], self.reduced[:, -1]
        numbers = many + columns.shape[1] - 1
        if (
            not self.converged
            or residuals.size < MIN_MEMORY_READINGS
            or not remembers(residuals, numbers, DRIFT_THRESHOLD)
        ):
            return False
        step = np.linalg.lstsq(columns, residuals, rcond=None)[0]
        return remembers(residuals - columns @ step, numbers + 1, DRIFT_THRESHOLD)

    @cached_property
    def reduced(self) -> np.ndarray:
        """Columns of slopes and, last, residuals, with the starting currents of many pieces
        eliminated.
        """
        return self.without_levels(np.column_stack([self.rows, self.residuals]))

    @cached_property
    def qr_factor(self) -> np.ndarray:
        """Triangular factor of `reduced` (QR): all that independent noise needs."""
        return np.linalg.qr(self.reduced, mode="r")

    def without_levels(self, columns: np.ndarray) -> np.ndarray:
        """Eliminate the starting currents of many pieces from columns."""
        if self.levels is None:
            return columns
        return self.levels.left(columns)

    def columns(self, *more: int) -> list[int]:
        """Indices of the free columns: those of the law with constant a and b, of parts with rates
        of their own, and of `more`.

        The starting currents of many pieces are eliminated and have no column.
        """
        own = 0 if self.parts is None else self.parts.shares.shape[1]
        last = range(self.rows.shape[1] - own, self.rows.shape[1])
        return [LEVEL] * (self.level.size == 1) + [*PLAIN, *last, *more]

    def memory(self, columns: Sequence[int], independent: bool) -> Memory:
        """Posterior over noises, given the slopes by some columns and the residuals.

        With `independent` noise the weak prior of the search is included, for records too short for
        their noise; otherwise the noise is averaged over its memory.
        """
        if not independent:
            is_plain = list(columns) in (self.columns(), self.columns(POWER))
            found = self._whitened_with_power if is_plain else self._whitened(columns)
            return found.memory(self.edge_columns.shape[1] + len(columns)).of_last(len(columns))
        prior_row = np.append(np.equal(columns, QUADRATIC), self.numbers[QUADRATIC - 1])
        rows = np.vstack([self.qr_factor[:, [*columns, -1]], self.prior * prior_row])
        count = self.residuals.size - (0 if self.levels is None else self.level.size)
        triangle = np.linalg.qr(rows, mode="r")[None]
        return Whitened(
            CorrelatedNoise(np.zeros(1), np.zeros(1)), triangle, np.zeros(1), count
        ).memory()

    def propagate(
        self,
        function: Callable[..., np.ndarray],
        columns: Sequence[int],
        independent: bool | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Evaluate ``function(level, *numbers)``, with errors.

        The errors contain the noise, averaged over its memory, and the stated instability of the
        monitor.
        """
        parameters, columns = np.append(self.level[:1], self.numbers), list(columns)
        steps = 1j * IMAGINARY_STEP * np.eye(self.rows.shape[1], parameters.size)
        found = np.array([function(*parameters + step) for step in steps])
        memory = self.memory(columns, not self.has_memory if independent is None else independent)
        slopes = found.imag.T[:, columns] / IMAGINARY_STEP
        error = memory.moments(slopes, self.min_factor).error
        for change in self.pieces.monitor_changes:
            shift = np.linalg.lstsq(
                self.reduced[:, columns], self.without_levels(change[:, None]), rcond=None
            )
            error = np.hypot(error, (slopes @ shift[0])[:, 0])
        return found[0].real, error

    @cached_property
    def _whitened_with_power(self) -> Whitened:
        """Whitened columns of the law with constant a and b and of a power of the current."""
        return self._whitened(self.columns(POWER))

    def _whitened(self, columns: Sequence[int]) -> Whitened:
        """Whiten edge shifts, slopes by some columns, and residuals by each noise.

        Cycles of different parts are whitened separately; a part's departure is one of the loss.
        """
        time, cycle_parts = (
            self.pieces.time,
            self.parts or Parts(np.zeros(1, int), np.zeros((1, 0)), None),
        )
        plain = [
            column
            for column in columns
            if column < self.rows.shape[1] - cycle_parts.shares.shape[1]
        ]
        rows = np.column_stack([self.edge_columns, self.rows[:, plain], self.residuals])
        if self.levels is None:
            return whitened_by_each(usual_noises(time), [(rows, time)])
        first, slope = self.levels
        grid = usual_noises(time)
        part_slices = [slice(*pair) for pair in pairwise([*cycle_parts.first, time.size])]
        blocks = [
            first[(first >= part.start) & (first < part.stop)] - part.start for part in part_slices
        ]
        levels = [
            Levels(*pair)
            for pair in zip(blocks, (slope[part] for part in part_slices), strict=True)
        ]
        found = whitened_by_each(
            grid, [(rows[part], time[part]) for part in part_slices], levels=levels
        )
        triangle, count = found.triangle, found.triangle.shape[1] // len(part_slices)
        edges = self.edge_columns.shape[1]
        part_columns = triangle[..., [edges]] * np.repeat(cycle_parts.shares, count, axis=0)
        parts = np.split(triangle, [edges + len(PLAIN)], axis=2)
        found = found._replace(triangle=np.concatenate([parts[0], part_columns, parts[1]], axis=2))
        return found.with_widths(SHIFTS, edges)

    @cached_property
    def edge_columns(self) -> np.ndarray:
        """Slopes of the residuals by a shift of the first and of the last readings of all cycles,
        which may lie within refills, shape (n, 2); no column for a single decay.
        """
        if self.levels is None:
            return np.zeros((self.residuals.size, 0))
        first, lengths = self.pieces.first, self.pieces.lengths
        long, found = lengths >= MIN_SHIFTED_READINGS, np.zeros((self.residuals.size, 2))
        found[first[long], 0] = found[(first + lengths - 1)[long], 1] = 1.0
        return found

    def value_shifts(self, change: np.ndarray) -> Physical:
        """Shifts of the values by a change of the readings (over their errors), by least squares.

        The exponent is fitted together with the other parameters; the other values have none.
        """
        change = self.without_levels(np.reshape(change, (-1, 1)))[:, 0]
        plain, power = self.columns(), self.columns(POWER)
        step = np.linalg.lstsq(self.reduced[:, plain], change, rcond=None)[0]
        with_power = np.linalg.lstsq(self.reduced[:, power], change, rcond=None)[0]
        return Physical(*(self.slopes[:, plain] @ step))._replace(exponent=with_power[-1])


def _search(
    pieces: Pieces, begin: np.ndarray | None, widths: np.ndarray, free: tuple[int, ...], kind, shape
) -> Expansion:
    """Find the best parameters by Gauss-Newton steps from `begin`, or from an estimated start if
    None.

    `widths` are those of normal priors about zero. A start estimated from noise may lie where the
    law has no value: the search begins at a mild decay, with the start as its first step, which is
    halved if necessary.
    """
    start, indices = _Start.of(pieces), np.array(free) - 1
    prior_weight = start.noise / start.width * (shape is None)
    prior = start.noise / widths + np.where(np.array(free) == QUADRATIC, prior_weight, 0.0)
    numbers, level = np.zeros(3) if begin is None else begin, np.ones(start.level.size)
    step, level_step = np.zeros(numbers.size), level - start.level
    if begin is None:
        plain = np.isin(PLAIN, free)
        numbers[:2], step[:2] = PLAIN_DECAY * plain, (start.both - PLAIN_DECAY) * plain
    bounds = _parameter_bounds(numbers.size)
    cost, fraction, converged, best = np.inf, 1.0, False, None
    for _ in range(MAX_ITERATIONS):
        trial = numbers.copy()
        trial[indices] = np.clip(numbers + fraction * step, *bounds)[indices]
        found = Expansion.of(pieces, trial, level - fraction * level_step, kind, shape)
        new_cost = found.residuals @ found.residuals + np.sum((prior * trial[indices]) ** 2)
        if not (found.converged and new_cost <= cost * (1 + 1e-15)):
            fraction /= 2
            # No step is better, however short: what is left to gain is below rounding.
            if converged := fraction < 0.5**MAX_HALVINGS:
                break
            continue
        numbers, level, cost, fraction, best = trial, found.level, new_cost, 1.0, found
        level_column, columns = found.rows[:, LEVEL], found.rows[:, free]
        rows = np.column_stack([columns, found.residuals])
        reduced = Levels(pieces.first, level_column).left(rows)
        prior_rows = np.column_stack([np.diag(prior), prior * numbers[indices]])
        free_step = least_squares_step(reduced, prior_rows)
        step = np.zeros(numbers.size)
        step[indices] = free_step
        level_step = pieces.project(level_column, found.residuals + columns @ free_step)
        predicted = np.linalg.norm(reduced[:, :-1] @ free_step)
        rounding = 1e-14 * np.linalg.norm(level_column)
        if converged := bool(predicted <= STEP_TOLERANCE * start.noise + rounding):
            break
    best = best or found
    return replace(best, prior=prior_weight, converged=converged and best.converged)


def fit_law(
    pieces: Pieces,
    free: tuple[int, ...] = PLAIN,
    kind: str | None = None,
    shape: Shape | None = None,
    start: np.ndarray | None = None,
    widths: Mapping[int, float] | None = None,
) -> Expansion:
    """Fit the law by least squares.

    Parameters
    ----------
    pieces : Pieces
        One decay, or many.
    free : tuple of int
        Columns whose parameters are fitted; others stay at the start, or at zero.
    kind : str, optional
        Kind of the further losses, as for `beamfit.lifetime.decay_law.course`; they need a start.
    shape : callable, optional
        Dependence of a on the current in mA, up to a factor.
    start : array, optional
        Initial parameters.
    widths : mapping of int to float, optional
        Standard deviations of parameters with a normal prior about zero.

    Returns
    -------
    Expansion

    Notes
    -----
    Gauss-Newton steps by QR, with a weak prior on the quadratic part. The bend that separates a
    from b is of the order (span/lifetime)²/8 of the current, 4e-7 for a minute at ten hours.

    Examples
    --------
    >>> time = np.linspace(0.0, 36000.0, 100)
    >>> beam = 500 * np.exp(-1e-6 * time) / (1 + 2e-2 * 500 * -np.expm1(-1e-6 * time))
    >>> found = fit_law(Pieces.of(DecayRecord(time, beam))).values
    >>> print(f"{found.a:.6e} {found.b:.6e}")
    2.000000e-08 1.000000e-06
    """
    prior_widths = np.array([(widths or {}).get(column, np.inf) for column in free])
    first_parameters = None if start is None else np.array(start, float)
    with np.errstate(all="ignore"):
        return _search(pieces, first_parameters, prior_widths, tuple(free), kind, shape)


def further_columns(expansion: Expansion, kind: str, times: np.ndarray) -> np.ndarray:
    """Slopes of the residuals of a single decay by a further loss at each time, in units of the
    search.

    A loss fades in the course of the decay as a difference of the first current does.

    Examples
    --------
    >>> time = np.linspace(0.0, 1.0, 101)
    >>> found = fit_law(Pieces.of(DecayRecord(time, 100 * np.exp(-0.1 * time))))
    >>> column = further_columns(found, "step", np.array([0.5]))[:, 0]
    >>> print(f"{column[-1] / found.pieces.current[-1]:.3f}")
    -0.500
    """
    from scipy.integrate import cumulative_simpson  # slow to import, and few records need it

    (span, _), level = expansion.pieces.units, expansion.rows[:, [LEVEL]]
    time, model = expansion.pieces.time / span, expansion.pieces.current / expansion.pieces.divisor
    model = (model + expansion.residuals)[:, None]
    fading = np.divide(model, level, out=np.zeros_like(model), where=level > MIN_CURRENT * level[0])
    if kind in ("step", "step of a"):
        share = 1.0 if kind == "step" else model / expansion.pieces.weight[:, None]
        total = cumulative_simpson(share * fading, x=time, axis=0, initial=0.0)
        return -level * np.maximum(total - np.interp(times, time, total[:, 0]), 0.0)
    if kind == "sudden":
        return -level * np.interp(times, time, fading[:, 0]) * (time[:, None] > times)
    rates = time[:, None] - 0.5 if kind == "drift" else np.exp(-time[:, None] / times)
    return -level * cumulative_simpson(rates * fading, x=time, axis=0, initial=0.0)
