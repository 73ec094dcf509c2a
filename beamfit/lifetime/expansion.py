"""The law about its best numbers: one search for a single decay, many cycles and further losses.

Each piece has a current of its own, which every step eliminates. Units of the search are the
longest piece and the mean current. Loss and quadratic part are nearly uncorrelated, unlike a and b:
the first is well determined by any record, the second only by a long one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.integrate import cumulative_simpson

from beamfit.compile_cache import SELDOM
from beamfit.greybox.memory import Memory, Whitened, usual_noises, whitened_by_each
from beamfit.greybox.problem import padded_length
from beamfit.lifetime.decay_law import Moments, beam_current, cumulative
from beamfit.lifetime.record import DecayRecord, Monitor
from beamfit.noise.correlated import CorrelatedNoise, Levels, remembers
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
# Powers and times of a further loss that are looked at.
POWERS, TIMES = (-0.95, 3.0), (1e-3, 10.0)
# A drift under white noise counts from so many standard errors on: it enlarges errors much. Fewer
# readings tell nothing of the memory of their noise.
SLOW, FEWEST = 3.0, 12
# Noises of so small a part of the largest probability move no digit.
NO_WEIGHT = 1e-12
# Records solved in one call; fewer are filled up, so that one number is compiled.
TOGETHER = 16

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


def lifetime_of(rate: float, error: float, clear: float | None = None) -> Quantity:
    """Lifetime, h, of a loss rate, 1/s; unknown of one not so many of its errors above zero."""
    if clear is not None and not rate > clear * error:
        return Quantity(math.nan, None, "h")
    return Quantity(float(1 / rate / HOUR), float(error / rate**2 / HOUR), "h")


class Pieces(NamedTuple):
    """Readings of all pieces in a row.

    Attributes
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
    """

    time: np.ndarray
    since: np.ndarray
    current: np.ndarray
    error: np.ndarray | None
    first: np.ndarray
    gauge: np.ndarray | None = None
    monitor: Monitor | None = None

    @classmethod
    def of(cls, record: DecayRecord) -> Pieces:
        """A single decay."""
        time, first = record.time, np.zeros(1, int)
        return cls(time, time, record.current, record.error, first, record.gauge, record.monitor)

    @property
    def lengths(self) -> np.ndarray:
        """Readings of each piece."""
        return np.diff(self.first, append=self.time.size)

    @property
    def units(self) -> tuple[float, float]:
        """The longest piece, s, and the mean current, mA."""
        return float(self.since.max()), float(self.current.mean())

    @property
    def over(self) -> np.ndarray | float:
        """Divisor of the residuals, mA."""
        return 1.0 if self.error is None else self.error

    @property
    def monitor_changes(self) -> list[np.ndarray]:
        """Changes of the readings by a stated instability of the monitor, mA."""
        since = self.time - self.time[0]
        return [] if self.monitor is None else list(self.monitor.changes(since).values())

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

    def scaled(self) -> _Rows:
        """Readings in units of the search, padded to one of a few lengths by some of no weight."""
        (span, mean), size, many = self.units, self.time.size, self.first.size > 1
        extra = (0, padded_size(size) - size)
        weight = np.broadcast_to(mean / np.asarray(self.over), (size,))
        columns = [self.since / span, self.current / mean]
        columns += [] if self.gauge is None else [self.gauge / span]
        time, current, *gas = (np.pad(column, extra, mode="edge") for column in columns)
        piece, pressure = None, np.ones(2)
        if many:
            piece = np.pad(np.repeat(np.arange(self.first.size), self.lengths), extra, mode="edge")
        if self.gauge is not None:
            pressure = (np.diff(self.gauge) / np.diff(self.time))[[0, -1]]
        ends = np.array([current.max(), current.min()])
        return _Rows(time, current, np.pad(weight, extra), gas[0] if gas else None, piece, ends,
                     pressure, mean)  # fmt: skip


class _Rows(NamedTuple):
    """As `Pieces`, scaled: `piece` is the place of each reading's, None of a single one; highest
    and lowest current, the pressure over its mean at both ends, the mean current, mA, and by how
    much the loss rate of each reading's piece departs from the mean.
    """

    time: Array
    current: Array
    weight: Array
    gas: Array | None
    piece: Array | None
    ends: Array
    pressure: Array
    mean: Array
    departure: Array | None = None

    def shape_of(self, shape: Shape | None) -> Shape | None:
        """A shape of the current over its mean."""
        return None if shape is None else lambda x: shape(x * self.mean)

    @property
    def count(self) -> int:
        """Pieces at most: of three readings or more each."""
        return 1 if self.piece is None else self.time.size // 2

    @property
    def starts(self) -> Array | None:
        """First reading of the piece of each; None of a single piece."""
        if self.piece is None:
            return None
        return jnp.searchsorted(self.piece, self.piece, side="left")

    def sums(self, values: Array) -> Array:
        """Sum the values of each piece."""
        if self.piece is None:
            return jnp.sum(values, axis=0, keepdims=True)
        return jax.ops.segment_sum(values, self.piece, self.count, indices_are_sorted=True)

    def each(self, values: Array) -> Array:
        """Values of the pieces for each reading."""
        return values[jnp.zeros(self.time.size, int) if self.piece is None else self.piece]

    def without_levels(self, own: Array, columns: Array) -> tuple[Array, Array]:
        """Columns without what the levels explain, and what they are worth of each level."""
        worth = self.sums(own[:, None] * columns) / jnp.maximum(self.sums(own**2), 1e-300)[:, None]
        return columns - own[:, None] * self.each(worth), worth


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


class _State(NamedTuple):
    """A search: numbers and levels, the law about them, half the squares, and the next step."""

    numbers: Array
    level: Array
    residual: Array
    slopes: Array
    values: Array
    by: Array
    cost: Array
    step: Array
    down: Array
    share: Array
    rested: Array
    count: Array


def padded_size(rows: int) -> int:
    """A few lengths from 64: each is compiled once, for a second or two."""
    return padded_length(max(rows, 64))


def _about(numbers: Array, level: Array, rows: _Rows, kind: str | None, shape: Shape | None):
    """Residuals over errors and physical values, and their slopes by all columns."""
    at, shape = Moments(rows.time, rows.gas, rows.starts), rows.shape_of(shape)

    def answer(step: Array) -> tuple[Array, Array]:
        now = numbers + step[1:]
        begin = level[0] if rows.piece is None else rows.each(level)
        own = now if rows.departure is None else (now[0] + rows.departure, *now[1:])
        model = beam_current(begin + step[0], own, at, kind, shape)
        ends = rows.ends
        if rows.piece is None:
            ends = jnp.stack([begin + step[0], model[-1]])
        return rows.weight * (model - rows.current), _physical(ends, now, rows.pressure, shape)

    zero = jnp.zeros(numbers.size + 1)
    (residual, values), (slopes, by) = jax.vmap(
        lambda way: jax.jvp(answer, (zero,), (way,)), out_axes=(None, 0)
    )(jnp.eye(zero.size))
    return residual, slopes.T, values, by.T


def _physical(ends: Array, numbers: Array, pressure: Array, shape: Shape | None) -> Array:
    loss, quadratic, power = numbers[:3]
    x = jnp.maximum(ends, 1e-12)
    rates = quadratic * x ** (1 + power) * (1.0 if shape is None else shape(x) / shape(1.0))
    rates = rates + (loss - quadratic) * pressure
    return jnp.stack([ends[0], quadratic, loss - quadratic, *rates, loss, quadratic / loss, power])


def _least_squares(rows: Array, known: Array) -> Array:
    """Step of the numbers from columns, the last of them residuals, and rows of priors, by QR."""
    size = jnp.linalg.norm(rows[:, :-1], axis=0) + 1e-300
    unit = jnp.append(1 / size, 1.0)
    ridge = 1e-15 * jnp.eye(size.size, size.size + 1)
    factor = jnp.linalg.qr(jnp.concatenate([rows * unit, known * unit, ridge]), mode="r")
    return -jax.scipy.linalg.solve_triangular(factor[:-1, :-1], factor[:-1, -1]) / size


def _start(rows: _Rows) -> tuple[Array, Array, Array, Array]:
    """Loss and quadratic part, levels, noise in units of the weights, width of the prior.

    Integrated once, the law is linear: x(t) = level - loss ∫x dt - quadratic ∫x (x - 1) dt. The
    integrals average the noise, so the start is good for a decay of any length.
    """
    x, weight, inside = rows.current, rows.weight, jnp.diff(rows.time)

    def integral(values: Array) -> Array:
        parts = jnp.append(0.0, inside * (values[1:] + values[:-1]) / 2)
        whole = cumulative(parts)
        return whole if rows.piece is None else whole - whole[rows.starts]

    columns = jnp.stack([-integral(x), -integral(x * (x - 1)), x], axis=1)
    left, worth = rows.without_levels(weight, weight[:, None] * columns)
    loss, bend, y = left.T
    pieces = 1 if rows.piece is None else rows.piece[-1] + 1
    count = jnp.maximum(jnp.sum(weight > 0) - pieces - 2, 1)
    size = jnp.linalg.norm(loss) + 1e-300
    straight = (loss @ y) / size**2
    noise = jnp.linalg.norm(y - straight * loss) / jnp.sqrt(count)
    width = PRIOR_WIDTH * (jnp.abs(straight) + 3 * noise / size) + 1e-300
    both = _least_squares(
        jnp.stack([loss, bend, -y], axis=1), jnp.array([[0.0, noise / width, 0.0]])
    )
    less = jnp.linalg.norm(y - left[:, :2] @ both) / jnp.sqrt(count)
    least = 1e-15 * jnp.linalg.norm(weight * x) / jnp.sqrt(count)
    level = worth[:, 2] - worth[:, :2] @ both
    return both, level, jnp.maximum(jnp.minimum(noise, less), least), width


class _Question(NamedTuple):
    """Columns whose numbers are free, the kind of further losses, and the shape of a."""

    free: tuple[int, ...]
    kind: str | None
    shape: Shape | None

    def mask(self, size: int) -> Array:
        """Free ones of so many numbers."""
        return jnp.isin(jnp.arange(1, size + 1), jnp.array(self.free))

    def within(self, numbers: Array, before: Array) -> Array:
        """Free numbers within their bounds, and the others as before."""
        more = numbers.size // 2 - 1
        low = jnp.array([-jnp.inf, -jnp.inf, POWERS[0]] + [-jnp.inf, TIMES[0]] * more)
        high = jnp.array([jnp.inf, jnp.inf, POWERS[1]] + [jnp.inf, TIMES[1]] * more)
        return jnp.where(self.mask(numbers.size), jnp.clip(numbers, low, high), before)


def _first(rows: _Rows, begin: Array, both: Array, level: Array, question: _Question) -> _State:
    """Begin at the numbers given, or a step from a plain decay's, at those from integrals.

    A start taken from noise can lie where the law has no value: the step is halved then. Nothing is
    known of the law yet, since the search alone holds it, which takes a second to compile.
    """
    mask, given = question.mask(begin.size), jnp.isfinite(begin[0])
    plain = mask * jnp.zeros(begin.size).at[:2].set(jnp.array([0.1, 0.05]))
    own = mask * jnp.zeros(begin.size).at[:2].set(both)
    start, at = jnp.where(given, begin, plain), jnp.where(given, level, 1.0)
    law = jax.eval_shape(partial(_about, kind=question.kind, shape=question.shape), own, at, rows)
    unknown = (jnp.full(part.shape, jnp.nan) for part in law)
    step = jnp.where(given, 0.0, own - plain)
    return _State(start, at, *unknown, jnp.inf, step, at - level, 1.0, False, 0)


def _tried(numbers: Array, level: Array, rows: _Rows, prior: Array, question: _Question):
    """The law about numbers, and the sum of squares, infinite where the law has no value."""
    found = _about(numbers, level, rows, question.kind, question.shape)
    residual, slopes = found[:2]
    known = prior * numbers[jnp.array(question.free) - 1]
    cost = residual @ residual + jnp.sum(known**2)
    fine = jnp.isfinite(slopes).all() & jnp.isfinite(cost)
    return *found, jnp.where(fine, cost, jnp.inf)


def _advanced(s: _State, rows: _Rows, prior: Array, noise: Array, question: _Question) -> _State:
    """Take the step, or half of it where it did not help, and find the next."""
    places = jnp.array(question.free)
    tried = question.within(s.numbers + s.share * s.step, s.numbers), s.level - s.share * s.down
    tried += _tried(*tried, rows, prior, question)
    better = jnp.isfinite(tried[-1]) & (tried[-1] <= s.cost * (1 + 1e-15))
    numbers, level, residual, slopes, values, by, cost = (
        jnp.where(better, new, old) for new, old in zip(tried, s[:7], strict=True)
    )
    columns = jnp.column_stack([slopes[:, places], residual])
    left, worth = rows.without_levels(slopes[:, LEVEL], columns)
    known = jnp.column_stack([jnp.diag(prior), prior * numbers[places - 1]])
    step = _least_squares(left, known)
    down = worth[:, :-1] @ step + worth[:, -1]
    promised = jnp.linalg.norm(left[:, :-1] @ step)
    rounding = 1e-14 * jnp.linalg.norm(slopes[:, LEVEL])
    share = jnp.where(better, 1.0, s.share / 2)
    # Where no step however short is better, what it promised must be below the noise.
    small = s.rested | (better & (promised <= NEAR * noise + rounding))
    stuck = ~better & (s.share <= 0.5**HALVED)
    return _State(
        numbers, level, residual, slopes, values, by, cost,
        jnp.where(better, jnp.zeros_like(numbers).at[places - 1].set(step), s.step),
        jnp.where(better, down, s.down), share, small | stuck, s.count + 1,
    )  # fmt: skip


def _search(rows: _Rows, begin: Array, widths: Array, free, kind=None, shape=None):
    """Gauss and Newton from numbers, NaN where the start is to be found; and what they leave.

    `widths` are those of normal priors about zero.
    """
    question = _Question(free, kind, shape)
    both, level, noise, width = _start(rows)
    weak = noise / width * (shape is None)
    prior = noise / widths + jnp.where(jnp.array(free) == QUADRATIC, weak, 0.0)
    last = jax.lax.while_loop(
        lambda s: ~s.rested & (s.count < STEPS),
        lambda s: _advanced(s, rows, prior, noise, question),
        jax.tree.map(jnp.asarray, _first(rows, begin, both, level, question)),
    )
    return *last[:6], last.rested, weak


# The plain law is searched again and again; what alternatives ask for runs a few times.
QUESTION = ("free", "kind", "shape")
_searched = jax.jit(_search, static_argnames=QUESTION)
_searched_seldom = jax.jit(_search, static_argnames=QUESTION, compiler_options=SELDOM)


@partial(jax.jit, static_argnames=("kind", "shape"))
def _looked(rows: _Rows, numbers: Array, level: Array, kind: str | None, shape):
    return _about(numbers, level, rows, kind, shape)


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

    @classmethod
    def of(cls, pieces: Pieces, found: Sequence[np.ndarray]) -> Expansion:
        """From what a search gives, in units of the readings."""
        (span, mean), size = pieces.units, pieces.time.size
        numbers, level, residual, rows, values, by, *rest = map(np.asarray, found)
        unit = np.array([mean, 1 / mean / span, *[1 / span] * 4, 1.0, 1.0])
        prior, rested = (float(rest[1]), bool(rest[0])) if rest else (0.0, True)
        fine = rested and bool(np.isfinite(values).all())
        level = level[: pieces.first.size]
        values, by = values * unit, by * unit[:, None]
        if level.size > 1:
            values[0], by[0] = mean * level.mean(), 0.0
        return cls(pieces, numbers, level, residual[:size], rows[:size], Physical(*values), by,
                   prior, fine)  # fmt: skip

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
        memory the noise may have otherwise. Noises of no weight are left out.
        """
        if not independent:
            found = self._whitened(columns).memory()
            kept = found.weight > NO_WEIGHT * found.weight.max()
            return Memory(*(part[kept] for part in found[:-1]), found.dof)
        known = np.append(np.equal(columns, QUADRATIC), self.numbers[QUADRATIC - 1])
        rows = np.vstack([self.triangle[:, [*columns, -1]], self.prior * known])
        count = self.residuals.size - (0 if self.levels is None else self.level.size)
        triangle = np.linalg.qr(rows, mode="r")[None]
        return Whitened(
            CorrelatedNoise(np.zeros(1), np.zeros(1)), triangle, np.zeros(1), count
        ).memory()

    def _whitened(self, columns: Sequence[int]) -> Whitened:
        """Slopes by some columns and residuals, whitened by each noise; the cycles of a part, in
        which a departure is one of the loss, by themselves.
        """
        time, own = self.pieces.time, self.parts or Parts(np.zeros(1, int), np.zeros((1, 0)), None)
        plain = [column for column in columns if column < self.rows.shape[1] - own.shares.shape[1]]
        rows = np.column_stack([self.rows[:, plain], self.residuals])
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
        more = triangle[..., :1] * np.repeat(own.shares, count, axis=0)
        parts = (triangle[..., : len(PLAIN)], more, triangle[..., len(PLAIN) :])
        return found._replace(triangle=np.concatenate(parts, axis=2))

    def moved(self, change: np.ndarray) -> Physical:
        """Shift the values by a change of the readings, over their errors, by least squares;
        an exponent beside the other numbers.
        """
        change = self.beside(np.reshape(change, (-1, 1)))[:, 0]
        plain, power = self.columns(), self.columns(POWER)
        step = np.linalg.lstsq(self.left[:, plain], change, rcond=None)[0]
        beside = np.linalg.lstsq(self.left[:, power], change, rcond=None)[0]
        return Physical(*(self.slopes[:, plain] @ step))._replace(exponent=beside[-1])


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
    begin = np.full(3, np.nan) if start is None else np.asarray(start, float)
    known = np.array([(widths or {}).get(column, np.inf) for column in free])
    search = _searched if free == PLAIN else _searched_seldom
    return Expansion.of(pieces, search(pieces.scaled(), begin, known, tuple(free), kind, shape))


def solved_together(records: Sequence[DecayRecord]) -> list[Expansion]:
    """`solved` for the plain law of many decays, those of similar length in one call."""
    pieces = [Pieces.of(record) for record in records]
    groups: dict[tuple[int, bool], list[int]] = {}
    for k, one in enumerate(pieces):
        groups.setdefault((padded_size(one.time.size), one.gauge is None), []).append(k)
    found: list[Expansion] = [None] * len(pieces)
    for members in groups.values():
        for first in range(0, len(members), TOGETHER):
            chosen = members[first : first + TOGETHER]
            rows = [pieces[k].scaled() for k in chosen]
            rows += rows[:1] * (TOGETHER - len(chosen))
            answers = _all_searched(jax.tree.map(lambda *parts: np.stack(parts), *rows))
            answers = [np.asarray(part) for part in answers]
            for row, k in enumerate(chosen):
                found[k] = Expansion.of(pieces[k], [part[row] for part in answers])
    return found


@jax.jit
def _all_searched(rows: _Rows):
    nothing = jnp.full(3, jnp.nan), jnp.full(len(PLAIN), jnp.inf)
    return jax.vmap(lambda one: _searched(one, *nothing, PLAIN))(rows)


def expanded(
    pieces: Pieces,
    values: Physical,
    shape: Shape | None = None,
    kind: str | None = None,
    further: Sequence[float] = (),
) -> Expansion:
    """Expand the law of a single decay about values, for what no search does.

    `further` are losses and their times in units of the search.
    """
    span, mean = pieces.units
    loss, quadratic = float(values.rate_mean) * span, float(values.a) * mean * span
    numbers = np.array([loss, quadratic, float(np.nan_to_num(values.exponent)), *further])
    level = np.array([float(values.i0) / mean])
    found = _looked(pieces.scaled(), numbers, level, kind, shape)
    return Expansion.of(pieces, (numbers, level, *found))


def expanded_about(about: Expansion, numbers: np.ndarray, departure: np.ndarray) -> Expansion:
    """Expand the law of many pieces about other numbers, with a departure of the loss rate for each
    reading's piece; levels are eliminated.
    """
    rows = about.pieces.scaled()
    departure = np.pad(departure, (0, rows.time.size - departure.size))
    level = np.pad(about.level, (0, rows.count - about.level.size), constant_values=1.0)
    found = _looked(rows._replace(departure=departure), numbers, level, None, None)
    return replace(Expansion.of(about.pieces, (numbers, level, *found)), prior=about.prior)


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
    (span, _), level = about.pieces.units, about.rows[:, [LEVEL]]
    time, model = about.pieces.time / span, about.pieces.current / about.pieces.over
    fading = (model + about.residuals)[:, None] / level
    if kind == "step":
        whole = cumulative_simpson(fading, x=time, axis=0, initial=0.0)
        return -level * np.maximum(whole - np.interp(times, time, whole[:, 0]), 0.0)
    if kind == "sudden":
        return -level * np.interp(times, time, fading[:, 0]) * (time[:, None] > times)
    rates = time[:, None] - 0.5 if kind == "drift" else np.exp(-time[:, None] / times)
    return -level * cumulative_simpson(rates * fading, x=time, axis=0, initial=0.0)
