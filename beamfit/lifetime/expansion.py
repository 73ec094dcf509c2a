"""The law about its best numbers: one search for a single decay, many cycles and further losses.

Each piece has a current of its own, which every step eliminates. Units of the search are the
longest piece and the mean current. Loss and quadratic part are nearly uncorrelated, unlike a and b:
the first is well determined by any record, the second only by a long one.
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

from beamfit.lifetime.decay_law import LEAST, Moments, beam_current
from beamfit.lifetime.record import DecayRecord, Monitor
from beamfit.noise.correlated import Memory, Whitened, usual_noises, whitened_by_each
from beamfit.noise.memory import CorrelatedNoise, Levels, remembers
from beamfit.quantity import HOUR, Quantity

# Columns of the slopes: the current of the piece, loss at the mean current and its quadratic part,
# power of a, a further loss and its time.
LEVEL, LOSS, QUADRATIC, POWER, FURTHER, WHEN = range(6)
PLAIN = (LOSS, QUADRATIC)
# Width of a prior on the quadratic part, in units of the whole loss (whose own error counts in).
# Physics allows 0 to 1, so 30 moves no value that the record determines (by 4e-5 of it where the
# verdict turns, nothing beyond); it keeps records too short for their noise from running away.
PRIOR_WIDTH = 30.0
# A search rests where a step moves the curve by less than this share of the noise: the next would
# be below rounding. It ends after so many steps, and a step is halved so often.
NEAR, STEPS, HALVED = 1e-4, 100, 30
# Loss and quadratic part of a decay that has a value wherever a search begins.
PLAIN_DECAY = np.array([0.1, 0.05])
# Powers and times of a further loss that are looked at.
POWERS, TIMES = (-0.95, 3.0), (1e-3, 10.0)
# A drift under white noise counts from so many standard errors on: it enlarges errors much. Fewer
# readings tell nothing of the memory of their noise.
SLOW, FEWEST = 3.0, 12
# A loss rate less than three errors from zero leaves the lifetime without an upper limit.
DETERMINED = 1 / 3
# Readings at the edges of cycles may lie within refills, or beside them: standard deviations of
# what these have in common, over the noise, and their prior probabilities.
SHIFTS = ((0.01, 0.5), *((width, 0.1) for width in (0.1, 0.3, 1.0, 3.0, 10.0)))
# Readings of a cycle whose inner ones tell a rate.
LONG = 5
# Steps by which slopes are taken: imaginary ones lose no digit, but a shape takes real numbers.
IMAGINARY, REAL = 1e-30, 1e-5

Shape = Callable[[Array], Array]


class Physical(NamedTuple):
    """Values of a law, in s and mA: loss rates at the first and last reading, of many pieces at the
    highest and lowest current, and at the mean current; the share of a in the loss there, and the
    power by which a departs from its shape.
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
    """Lifetime, h, of a loss rate, 1/s; unknown where one that is not clear of zero tells none."""
    if clear and not error < DETERMINED * rate:
        return Quantity(math.nan, None, "h")
    return Quantity(float(1 / rate / HOUR), float(error / rate**2 / HOUR), "h")


@dataclass(frozen=True, eq=False)
class Pieces:
    """Readings of all pieces in a row.

    Parameters
    ----------
    time, since : array, shape (n,)
        Times, and times since the first reading of the piece, s.
    current, error : array, shape (n,)
        mA; `error` may be None.
    first : array of int, shape (k,)
        Where each piece begins.
    gauge : array, shape (n,), or None
        As of `DecayRecord`, of a single piece.
    monitor : Monitor or None
        What is stated of its stability.
    mean : float or None
        Mean current, mA, where it is not that of the readings.
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
        """A single decay."""
        time, current, first = record.time, record.current, np.zeros(1, int)
        more = record.gauge, record.monitor, record.mean
        return cls(time, time, current, record.error, first, *more)

    @cached_property
    def lengths(self) -> np.ndarray:
        """Readings of each piece."""
        return np.diff(self.first, append=self.time.size)

    @cached_property
    def place(self) -> np.ndarray:
        """Number of readings of the piece before each."""
        return np.arange(self.time.size) - np.repeat(self.first, self.lengths)

    @cached_property
    def units(self) -> tuple[float, float]:
        """The longest piece, s, and the mean current, mA."""
        mean = float(self.current.mean()) if self.mean is None else self.mean
        return float(self.since.max()), mean

    @cached_property
    def share(self) -> np.ndarray:
        """Currents over their mean."""
        return self.current / self.units[1]

    @cached_property
    def weight(self) -> np.ndarray:
        """Weight of a residual over the mean current."""
        return np.broadcast_to(self.units[1] / np.asarray(self.over), self.time.shape)

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

    def each(self, values: np.ndarray) -> np.ndarray:
        """Values of the pieces for each reading."""
        return np.repeat(values, self.lengths) if values.size > 1 else values[0]

    def worth(self, own: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Multiples of a column that explain most of values, piece by piece."""
        squares = np.maximum(np.add.reduceat(own**2, self.first), 1e-300)
        return np.add.reduceat(own * values, self.first) / squares

    @property
    def over(self) -> np.ndarray | float:
        """Divisor of the residuals, mA."""
        return 1.0 if self.error is None else self.error

    @property
    def monitor_changes(self) -> list[np.ndarray]:
        """Changes of the readings by a stated instability of the monitor, over their errors."""
        since = self.time - self.time[0]
        changes = {} if self.monitor is None else self.monitor.changes(since)
        return [change / self.over for change in changes.values()]

    def kept(self, keep: np.ndarray, fewest: int) -> Pieces:
        """Some of the readings; pieces with fewer than so many of them are left out."""
        count = np.add.reduceat(keep.astype(int), self.first)
        keep = keep & np.repeat(count >= fewest, self.lengths)
        count = count[count >= fewest]
        first = np.cumsum(count) - count
        time = self.time[keep]
        since = time - np.repeat(time[first], count)
        error = None if self.error is None else self.error[keep]
        return Pieces(time, since, self.current[keep], error, first, None, self.monitor)


class Parts(NamedTuple):
    """Parts of many cycles, each with a loss rate of its own.

    Attributes
    ----------
    first : array of int, shape (p,)
        First reading of each.
    shares : array, shape (p, p - 1)
        Departures of the loss rate of all parts by those of the first p - 1.
    departure : array, shape (p,)
        Of the loss from the mean, in units of the search.
    """

    first: np.ndarray
    shares: np.ndarray
    departure: np.ndarray


@lru_cache(maxsize=16)  # one that is made anew would be compiled anew
def _of_share(shape: Shape, mean: float) -> Shape:
    """A shape as one of the current over its mean."""
    return lambda x: shape(x * mean)


def least_squares_step(rows: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Step of the numbers from columns, the last of them residuals, and rows of priors.

    Examples
    --------
    >>> rows = np.array([[1.0, -1.0], [1.0, -3.0]])
    >>> least_squares_step(rows, np.zeros((0, 2))).round(9).tolist()
    [2.0]
    """
    size = np.linalg.norm(rows[:, :-1], axis=0) + 1e-300
    whole = np.vstack([rows, known]) / np.append(size, 1.0)
    whole = np.vstack([whole, 1e-15 * np.eye(size.size, size.size + 1)])
    factor = np.linalg.qr(whole, mode="r")
    return -np.linalg.solve(factor[:-1, :-1], factor[:-1, -1]) / size


class _Start(NamedTuple):
    """Loss and quadratic part, levels, noise in units of the weights, width of the prior."""

    both: np.ndarray
    level: np.ndarray
    noise: float
    width: float

    @classmethod
    def of(cls, pieces: Pieces) -> _Start:
        """From integrals, which average the noise, so that it is good for a decay of any length.

        Integrated once, the law is linear: x(t) = level - loss ∫x dt - quadratic ∫x (x - 1) dt.
        """
        x, weight, inside = pieces.share, pieces.weight, np.diff(pieces.at.time)

        def integral(values: np.ndarray) -> np.ndarray:
            whole = np.append(0.0, np.cumsum(inside * (values[1:] + values[:-1]) / 2))
            return whole - pieces.each(whole[pieces.first])

        columns = np.stack([-integral(x), -integral(x * (x - 1)), x], axis=1) * weight[:, None]
        loss, bend, y = Levels(pieces.first, weight).left(columns).T
        root = math.sqrt(max(x.size - pieces.first.size - 2, 1))
        size = np.linalg.norm(loss) + 1e-300
        straight = (loss @ y) / size**2
        noise = np.linalg.norm(y - straight * loss) / root
        width = PRIOR_WIDTH * (abs(straight) + 3 * noise / size) + 1e-300
        known = np.array([[0.0, noise / width, 0.0]])
        both = least_squares_step(np.stack([loss, bend, -y], axis=1), known)
        less = np.linalg.norm(y - both @ (loss, bend)) / root
        least = 1e-15 * np.linalg.norm(weight * x) / root
        level = pieces.worth(weight, columns[:, 2] - columns[:, :2] @ both)
        return cls(both, level, max(min(noise, less), least), width)


def _ends(count: int) -> np.ndarray:
    """Lowest and highest value of each of so many numbers."""
    more = count // 2 - 1
    return np.array([(-np.inf, np.inf)] * 2 + [POWERS] + [(-np.inf, np.inf), TIMES] * more).T


@dataclass(frozen=True, eq=False)
class Expansion:
    """The law about some numbers.

    Parameters
    ----------
    pieces : Pieces
        The readings.
    numbers : array, shape (3 + 2 k,)
        Loss, quadratic part, power, further losses and their times, in units of the search.
    level : array, shape (pieces,)
        Current at the start of each piece, over the mean.
    residuals : array, shape (n,)
        Model less reading, over errors; in mA where there are none.
    rows : array, shape (n, 4 + 2 k)
        Slopes of the residuals by the level of the piece and the numbers.
    values : Physical
        What the numbers say.
    slopes : array, shape (8, 4 + 2 k)
        Slopes of the values.
    prior : float
        Weight of the prior on the quadratic part.
    rested : bool
        Whether the search came to rest, at finite values.
    parts : Parts or None
        Of many cycles whose loss rate is not the same all along; the last columns are theirs.
    """

    pieces: Pieces
    numbers: np.ndarray
    level: np.ndarray
    residuals: np.ndarray
    rows: np.ndarray
    values: Physical
    slopes: np.ndarray
    prior: float = 0.0
    rested: bool = True
    parts: Parts | None = None

    @property
    def off(self) -> np.ndarray:
        """Model less reading, mA, shape (n,)."""
        return self.residuals * self.pieces.over

    @classmethod
    def of(
        cls, pieces: Pieces, numbers: np.ndarray, level: np.ndarray, kind: str | None = None,
        shape: Shape | None = None, departure: np.ndarray | float = 0.0,
    ) -> Expansion:  # fmt: skip
        """About numbers and levels of the pieces; `departure` is by how much the loss of each
        reading's piece departs from the mean.
        """
        (span, mean), many = pieces.units, level.size > 1
        shape = shape and _of_share(shape, mean)
        highest = np.array([pieces.share.max(), pieces.share.min()])

        def answer(step: np.ndarray) -> np.ndarray:
            loss, quadratic, power, *further = numbers + step[1:]
            begin, own = level + step[0], (loss + departure, quadratic, power, *further)
            model = beam_current(pieces.each(begin), own, pieces.at, kind, shape)
            x = highest if many else np.array([begin[0], model[-1]])
            rates = quadratic * np.where(x.real > LEAST, x, LEAST) ** (1 + power)
            rates = rates * (1.0 if shape is None else np.asarray(shape(x) / shape(1.0)))
            b = loss - quadratic
            values = begin.mean(), quadratic, b, *(rates + b * pieces.pressure), loss
            values = *values, quadratic / loss, power
            return np.concatenate([pieces.weight * (model - pieces.share), values])

        ways, count = np.eye(numbers.size + 1), pieces.time.size
        if shape is None:
            found = np.array([answer(1j * IMAGINARY * way) for way in ways])
            found, slopes = found[0].real, found.imag.T / IMAGINARY
        else:
            found = answer(0.0 * ways[0])
            slopes = [(answer(REAL * way) - answer(-REAL * way)) / (2 * REAL) for way in ways]
            slopes = np.array(slopes).T
        unit = np.array([mean, 1 / mean / span, *[1 / span] * 4, 1.0, 1.0])
        values, by = found[count:] * unit, slopes[count:] * unit[:, None]
        by[0] = 0.0 if many else by[0]
        fine = np.isfinite(slopes).all() and np.isfinite(found).all()
        return cls(pieces, numbers, level, found[:count], slopes[:count], Physical(*values), by,
                   rested=bool(fine))  # fmt: skip

    @classmethod
    def at(cls, record: DecayRecord, i0: float, a: float, b: float) -> Expansion:
        """About constant a and b, at the readings of a record."""
        pieces = Pieces.of(record)
        span, mean = pieces.units
        numbers = np.array([(a * mean + b) * span, a * mean * span, 0.0])
        return cls.of(pieces, numbers, np.array([i0 / mean]))

    @cached_property
    def levels(self) -> Levels | None:
        """The currents of many pieces, which are eliminated; None of a single one."""
        return Levels(self.pieces.first, self.rows[:, LEVEL]) if self.level.size > 1 else None

    @property
    def given(self) -> float:
        """One where errors are stated: the least size of what residuals are divided by."""
        return float(self.pieces.error is not None)

    @cached_property
    def wanders(self) -> bool:
        """True if the noise has a memory that no power of the current explains."""
        many = 0 if self.levels is None else self.level.size
        columns, residuals = self.left[:, self.columns(POWER)], self.left[:, -1]
        numbers = many + columns.shape[1] - 1
        if not self.rested or residuals.size < FEWEST or not remembers(residuals, numbers, SLOW):
            return False
        step = np.linalg.lstsq(columns, residuals, rcond=None)[0]
        return remembers(residuals - columns @ step, numbers + 1, SLOW)

    @cached_property
    def left(self) -> np.ndarray:
        """Slopes and residuals, these last; of many pieces without what their levels explain."""
        columns = np.column_stack([self.rows, self.residuals])
        return columns if self.levels is None else self.beside(columns)

    @cached_property
    def triangle(self) -> np.ndarray:
        """A few rows with the sums of products of `left`: all that independent noise asks of it."""
        return np.linalg.qr(self.left, mode="r")

    def beside(self, columns: np.ndarray) -> np.ndarray:
        """Columns without what the levels of many pieces explain."""
        if self.levels is None:
            return columns
        return self.levels.left(columns)

    def columns(self, *more: int) -> list[int]:
        """Places of the columns of the plain law, of parts with rates of their own, and of more;
        levels of many pieces are eliminated.
        """
        own = 0 if self.parts is None else self.parts.shares.shape[1]
        last = range(self.rows.shape[1] - own, self.rows.shape[1])
        return [LEVEL] * (self.level.size == 1) + [*PLAIN, *last, *more]

    def memory(self, columns: Sequence[int], independent: bool) -> Memory:
        """Posterior over noises, given the slopes by some columns and the residuals.

        Independent noise has the prior beside the residuals, for one too short a record; whatever
        memory the noise may have otherwise.
        """
        if not independent:
            least = list(columns) in (self.columns(), self.columns(POWER))
            found = self._with_power if least else self._whitened(columns)
            return found.memory(self.shifted.shape[1] + len(columns)).of_last(len(columns))
        known = np.append(np.equal(columns, QUADRATIC), self.numbers[QUADRATIC - 1])
        rows = np.vstack([self.triangle[:, [*columns, -1]], self.prior * known])
        count = self.residuals.size - (0 if self.levels is None else self.level.size)
        triangle = np.linalg.qr(rows, mode="r")[None]
        return Whitened(
            CorrelatedNoise(np.zeros(1), np.zeros(1)), triangle, np.zeros(1), count
        ).memory()

    def quoted(
        self,
        function: Callable[..., np.ndarray],
        columns: Sequence[int],
        independent: bool | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Values of ``function(level, *numbers)`` with their errors: the noise averaged over, and
        the stated instability of the monitor.
        """
        at, columns = np.append(self.level[:1], self.numbers), list(columns)
        ways = 1j * IMAGINARY * np.eye(self.rows.shape[1], at.size)
        found = np.array([function(*at + way) for way in ways])
        memory = self.memory(columns, not self.wanders if independent is None else independent)
        slopes = found.imag.T[:, columns] / IMAGINARY
        error = memory.moments(slopes, self.given).error
        for change in self.pieces.monitor_changes:
            moved = np.linalg.lstsq(self.left[:, columns], self.beside(change[:, None]), rcond=None)
            error = np.hypot(error, (slopes @ moved[0])[:, 0])
        return found[0].real, error

    @cached_property
    def _with_power(self) -> Whitened:
        """Whitened columns of the plain law and, last, of a power of the current."""
        return self._whitened(self.columns(POWER))

    def _whitened(self, columns: Sequence[int]) -> Whitened:
        """Slopes by shifts of edges, by some columns and residuals, whitened by each noise; the
        cycles of a part, in which a departure is one of the loss, by themselves.
        """
        time, own = self.pieces.time, self.parts or Parts(np.zeros(1, int), np.zeros((1, 0)), None)
        plain = [column for column in columns if column < self.rows.shape[1] - own.shares.shape[1]]
        rows = np.column_stack([self.shifted, self.rows[:, plain], self.residuals])
        if self.levels is None:
            return whitened_by_each(usual_noises(time), [(rows, time)])
        first, slope = self.levels
        grid = usual_noises(time)
        ends = [slice(*pair) for pair in pairwise([*own.first, time.size])]
        blocks = [first[(first >= part.start) & (first < part.stop)] - part.start for part in ends]
        levels = [
            Levels(*pair) for pair in zip(blocks, (slope[part] for part in ends), strict=True)
        ]
        found = whitened_by_each(grid, [(rows[part], time[part]) for part in ends], levels=levels)
        triangle, count = found.triangle, found.triangle.shape[1] // len(ends)
        begin = self.shifted.shape[1]
        more = triangle[..., [begin]] * np.repeat(own.shares, count, axis=0)
        parts = np.split(triangle, [begin + len(PLAIN)], axis=2)
        found = found._replace(triangle=np.concatenate([parts[0], more, parts[1]], axis=2))
        return found.with_widths(SHIFTS, begin)

    @cached_property
    def shifted(self) -> np.ndarray:
        """Slopes of the residuals by a shift of the first and of the last readings of all cycles,
        which may lie within refills; no column of a single decay.
        """
        if self.levels is None:
            return np.zeros((self.residuals.size, 0))
        first, lengths = self.pieces.first, self.pieces.lengths
        long, found = lengths >= LONG, np.zeros((self.residuals.size, 2))
        found[first[long], 0] = found[(first + lengths - 1)[long], 1] = 1.0
        return found

    def moved(self, change: np.ndarray) -> Physical:
        """Shift the values by a change of the readings, over their errors, by least squares;
        an exponent beside the other numbers.
        """
        change = self.beside(np.reshape(change, (-1, 1)))[:, 0]
        plain, power = self.columns(), self.columns(POWER)
        step = np.linalg.lstsq(self.left[:, plain], change, rcond=None)[0]
        beside = np.linalg.lstsq(self.left[:, power], change, rcond=None)[0]
        return Physical(*(self.slopes[:, plain] @ step))._replace(exponent=beside[-1])


def _search(
    pieces: Pieces, begin: np.ndarray | None, widths: np.ndarray, free: tuple[int, ...], kind, shape
) -> Expansion:
    """Gauss and Newton from numbers, None where the start is to be found.

    `widths` are those of normal priors about zero. A start taken from noise can lie where the law
    has no value: it is the first step from a plain decay, and halved then.
    """
    start, places = _Start.of(pieces), np.array(free) - 1
    weak = start.noise / start.width * (shape is None)
    prior = start.noise / widths + np.where(np.array(free) == QUADRATIC, weak, 0.0)
    numbers, at = np.zeros(3) if begin is None else begin, np.ones(start.level.size)
    step, down = np.zeros(numbers.size), at - start.level
    if begin is None:
        plain = np.isin(PLAIN, free)
        numbers[:2], step[:2] = PLAIN_DECAY * plain, (start.both - PLAIN_DECAY) * plain
    cost, share, rested, best = np.inf, 1.0, False, None
    for _ in range(STEPS):
        tried = numbers.copy()
        tried[places] = np.clip(numbers + share * step, *_ends(numbers.size))[places]
        found = Expansion.of(pieces, tried, at - share * down, kind, shape)
        now = found.residuals @ found.residuals + np.sum((prior * tried[places]) ** 2)
        if not (found.rested and now <= cost * (1 + 1e-15)):
            share /= 2
            # Where no step however short is better, what it promised must be below the noise.
            if rested := share < 0.5**HALVED:
                break
            continue
        numbers, at, cost, share, best = tried, found.level, now, 1.0, found
        own, columns = found.rows[:, LEVEL], found.rows[:, free]
        left = Levels(pieces.first, own).left(np.column_stack([columns, found.residuals]))
        known = np.column_stack([np.diag(prior), prior * numbers[places]])
        moved = least_squares_step(left, known)
        step = np.zeros(numbers.size)
        step[places] = moved
        down = pieces.worth(own, found.residuals + columns @ moved)
        promised = np.linalg.norm(left[:, :-1] @ moved)
        if rested := bool(promised <= NEAR * start.noise + 1e-14 * np.linalg.norm(own)):
            break
    best = best or found
    return replace(best, prior=weak, rested=rested and best.rested)


def solved(
    pieces: Pieces,
    free: tuple[int, ...] = PLAIN,
    kind: str | None = None,
    shape: Shape | None = None,
    start: np.ndarray | None = None,
    widths: Mapping[int, float] | None = None,
) -> Expansion:
    """Find the best numbers.

    Parameters
    ----------
    pieces : Pieces
        One decay, or many.
    free : tuple of int
        Columns whose numbers are fitted; others stay at the start, or at zero.
    kind : str, optional
        Of the further losses, as of `beamfit.lifetime.decay_law.course`; they need a start.
    shape : callable, optional
        Dependence of a on the current in mA, up to a factor.
    start : array, optional
        Numbers to begin at.
    widths : mapping of int to float, optional
        Standard deviations of numbers that are known to be near zero.

    Returns
    -------
    Expansion

    Notes
    -----
    Gauss and Newton by QR, with a weak prior on the quadratic part. The bend that tells a from b is
    of the order (span/lifetime)²/8 of the current, 4e-7 for a minute at ten hours.

    Examples
    --------
    >>> time = np.linspace(0.0, 36000.0, 100)
    >>> beam = 500 * np.exp(-1e-6 * time) / (1 + 2e-2 * 500 * -np.expm1(-1e-6 * time))
    >>> found = solved(Pieces.of(DecayRecord(time, beam))).values
    >>> print(f"{found.a:.6e} {found.b:.6e}")
    2.000000e-08 1.000000e-06
    """
    known = np.array([(widths or {}).get(column, np.inf) for column in free])
    begin = None if start is None else np.array(start, float)
    with np.errstate(all="ignore"):
        return _search(pieces, begin, known, tuple(free), kind, shape)


def further_columns(about: Expansion, kind: str, times: np.ndarray) -> np.ndarray:
    """Slopes of the residuals of a single decay by a further loss of each time, in units of the
    search: what a loss takes fades as a difference of the first current does.

    Examples
    --------
    >>> time = np.linspace(0.0, 1.0, 101)
    >>> found = solved(Pieces.of(DecayRecord(time, 100 * np.exp(-0.1 * time))))
    >>> column = further_columns(found, "step", np.array([0.5]))[:, 0]
    >>> print(f"{column[-1] / found.pieces.current[-1]:.3f}")
    -0.500
    """
    from scipy.integrate import cumulative_simpson  # a tenth of a second that few records need

    (span, _), level = about.pieces.units, about.rows[:, [LEVEL]]
    time, model = about.pieces.time / span, about.pieces.current / about.pieces.over
    model = (model + about.residuals)[:, None]
    fading = np.divide(model, level, out=np.zeros_like(model), where=level > LEAST * level[0])
    if kind in ("step", "step of a"):
        share = 1.0 if kind == "step" else model / about.pieces.weight[:, None]
        whole = cumulative_simpson(share * fading, x=time, axis=0, initial=0.0)
        return -level * np.maximum(whole - np.interp(times, time, whole[:, 0]), 0.0)
    if kind == "sudden":
        return -level * np.interp(times, time, fading[:, 0]) * (time[:, None] > times)
    rates = time[:, None] - 0.5 if kind == "drift" else np.exp(-time[:, None] / times)
    return -level * cumulative_simpson(rates * fading, x=time, axis=0, initial=0.0)
