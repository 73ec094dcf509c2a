"""Readings of many cycles, and one law fitted to them with an own current for every cycle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.lifetime.decay import current_by_rate
from beamfit.noise.correlated import Levels, whitened
from beamfit.studies.decay.model import PRIOR_WIDTH, padded_size
from beamfit.studies.decay.record import DecayRecord

FEWEST_CYCLES, FEWEST_READINGS = 3, 3
# Readings beyond which neighbours are averaged, in blocks within a cycle.
MOST = 16384
# Loss in a step of Runge and Kutta, and the most steps in a cycle.
LOSS_A_STEP, MOST_STEPS = 0.05, 64
# Robust standard deviations off which a reading or a cycle is left out; at most this share of them.
OUTLIER, SHARE = 7.0, 0.2
# Errors of the mean by which readings at the edges of cycles lie off the law where they are of an
# injection: what stays below moves the lifetime by no more than its error.
EDGE, WITHIN = 2.5, "they lie within injections"
# Readings from the edge inwards that tell whether the edge lies off.
NEXT = 9
SEARCH = 30


class Cycles(NamedTuple):
    """Readings of all cycles in a row.

    Times and times since the first reading of the cycle, s; currents and their errors, mA; and
    where each cycle begins.
    """

    time: np.ndarray
    since: np.ndarray
    current: np.ndarray
    error: np.ndarray | None
    first: np.ndarray

    @property
    def lengths(self) -> np.ndarray:
        """Readings of each cycle."""
        return np.diff(self.first, append=self.time.size)

    def kept(self, keep: np.ndarray) -> Cycles:
        """Some of the readings; cycles with fewer than three of them are left out."""
        count = np.add.reduceat(keep.astype(int), self.first)
        keep = keep & np.repeat(count >= FEWEST_READINGS, self.lengths)
        count = count[count >= FEWEST_READINGS]
        first = np.cumsum(count) - count
        time = self.time[keep]
        since = time - np.repeat(time[first], count)
        error = None if self.error is None else self.error[keep]
        return Cycles(time, since, self.current[keep], error, first)


def averaged(cycles: Sequence[DecayRecord]) -> Cycles:
    """All readings, in time; of very many the means of neighbours within a cycle."""
    total = sum(map(len, cycles))
    fewer = max(1.0, total / MOST)
    begin, place, parts = 0.0, 0, []
    known = all(cycle.start is not None for cycle in cycles)
    for cycle in cycles:
        begin = cycle.start if known else begin
        blocks = min(len(cycle), max(FEWEST_READINGS, round(len(cycle) / fewer)))
        time, current, error = cycle.blocks(blocks)
        parts.append((begin + time, time - time[0], current, error, place))
        place += blocks
        begin += 2 * cycle.span  # nobody said when: as if a cycle were missing in between
    time, since, current, errors, first = zip(*parts, strict=True)
    given = all(error is not None for error in errors)
    return Cycles(
        *map(np.concatenate, (time, since, current)),
        np.concatenate(errors) if given else None, np.array(first),
    )  # fmt: skip


@partial(jax.jit, static_argnames="steps")
def _law(theta: Array, level: Array, since: Array, steps: int) -> tuple[Array, Array]:
    """Currents over the mean, and their slopes by the level of the cycle and the three numbers:
    loss in the unit of time at the mean current, its quadratic part, and the exponent.
    """

    def answer(step: Array) -> Array:
        loss, quadratic, exponent = theta + step[1:]

        def one(begin: Array, time: Array) -> Array:
            def rate(beam: Array) -> Array:
                return quadratic * beam ** (1 + exponent) + loss - quadratic

            return current_by_rate(jnp.stack([0.0, time]), begin + step[0], rate, steps)[1]

        return jax.vmap(one)(level, since)

    zero = jnp.zeros(4)
    model, slopes = jax.vmap(lambda way: jax.jvp(answer, (zero,), (way,)), out_axes=(None, 0))(
        jnp.eye(4)
    )
    return model, slopes.T


@dataclass(frozen=True, eq=False)
class Pool:
    """A law fitted to cycles: the numbers of the search, the level of each cycle over the mean
    current, residuals over their errors and slopes of these; the unit of time, s; `weight` is the
    mean current over errors.
    """

    cycles: Cycles
    weight: np.ndarray | float
    theta: np.ndarray
    level: np.ndarray
    residuals: np.ndarray
    rows: np.ndarray
    levels: Levels
    mean: float
    unit: float

    def beside(self, columns: np.ndarray, apart: np.ndarray | None = None) -> np.ndarray:
        """Columns without what the levels explain, whitened."""
        apart = np.full(self.cycles.time.size - 1, np.inf) if apart is None else apart
        return self.levels.left(whitened(columns, apart, np), apart)[0]

    @cached_property
    def left(self) -> np.ndarray:
        """Slopes of the three numbers and residuals, without what the levels explain."""
        return self.beside(np.column_stack([self.rows, self.residuals]))


def _expanded(cycles: Cycles, theta: np.ndarray, level: np.ndarray, unit: float) -> Pool:
    mean, size = float(cycles.current.mean()), cycles.time.size
    loss = abs(theta[0]) * float(cycles.since.max()) / unit
    steps = int(min(2 ** math.ceil(math.log2(max(loss / LOSS_A_STEP, 1.0))), MOST_STEPS))
    extra = (0, padded_size(size) - size)
    of_each = np.pad(np.repeat(level, cycles.lengths), extra, mode="edge")
    model, slopes = _law(theta, of_each, np.pad(cycles.since, extra) / unit, steps)
    model, slopes = np.asarray(model)[:size], np.asarray(slopes)[:size]
    weight = 1.0 if cycles.error is None else mean / cycles.error
    slopes = slopes * np.reshape(weight, (-1, 1))
    residuals = weight * (model - cycles.current / mean)
    levels = Levels(cycles.first, slopes[:, 0])
    return Pool(cycles, weight, theta, level, residuals, slopes[:, 1:], levels, mean, unit)


def solved(cycles: Cycles, numbers: int = 2) -> Pool:
    """By Gauss and Newton, the levels eliminated; a weak prior on the quadratic part as of one
    decay. With three numbers the exponent is free.
    """
    mean, unit = float(cycles.current.mean()), float(cycles.since.max())
    level = cycles.current[cycles.first] / mean
    slope = Levels(cycles.first, np.ones(cycles.time.size))
    apart = np.full(cycles.time.size - 1, np.inf)
    line, _ = slope.left(np.column_stack([cycles.since / unit, cycles.current / mean]), apart)
    theta = np.array([-(line[:, 0] @ line[:, 1]) / (line[:, 0] @ line[:, 0]), 0.0, 0.0])
    for _ in range(SEARCH):
        pool = _expanded(cycles, theta, level, unit)
        left, dof = pool.left, max(cycles.time.size - level.size - 2, 1)
        noise = math.sqrt(left[:, 3] @ left[:, 3] / dof)
        size = np.linalg.norm(left[:, 0])
        width = PRIOR_WIDTH * (abs(theta[0]) + 3 * noise / size) + 1e-300
        prior = np.eye(numbers)[1] * noise / width
        columns = np.vstack([left[:, :numbers], prior])
        target = np.append(left[:, 3], prior[1] * theta[1])
        step = np.zeros(3)
        step[:numbers] = np.linalg.lstsq(columns, -target, rcond=1e-14)[0]
        own, after = pool.levels.slope, pool.residuals + pool.rows @ step
        first = cycles.first
        moved = np.add.reduceat(own * after, first) / np.add.reduceat(own**2, first)
        theta, level = theta + step, level - moved
        theta[2] = np.clip(theta[2], -3.0, 3.0)
        if np.linalg.norm(columns @ step[:numbers]) <= 1e-6 * noise + 1e-14 * np.linalg.norm(own):
            break
    return _expanded(cycles, theta, level, unit)


def _per_cycle(pool: Pool) -> tuple[np.ndarray, np.ndarray]:
    """By how much the loss of each cycle departs, and its error for noise of size 1."""
    first, slope, residual = pool.cycles.first, pool.left[:, 0], pool.left[:, 3]
    squares = np.add.reduceat(slope**2, first)
    return -np.add.reduceat(slope * residual, first) / squares, 1 / np.sqrt(squares)


def _far(values: np.ndarray) -> np.ndarray:
    """Which values lie off the others, unless these are too many to be outliers."""
    off = np.abs(values - np.median(values))
    spread = 1.4826 * np.median(off)
    far = off > OUTLIER * spread
    return far if spread > 0 and far.mean() <= SHARE else np.zeros(values.size, bool)


def _edges(pool: Pool) -> np.ndarray:
    """How far the first and the last readings of all cycles lie above the law, beside those next to
    them, in errors: fresh beam decays faster, and a reading within an injection lies below.
    """
    first, lengths = pool.cycles.first, pool.cycles.lengths
    long = lengths > NEXT
    ends = np.array([first[long], (first + lengths - 1)[long]])
    if ends.shape[1] < FEWEST_CYCLES:
        return np.zeros(2)
    off = -pool.left[:, 3]
    scatter = max(1.4826 * float(np.median(np.abs(off))), 1e-300)
    inward = np.array([[1], [-1]])[..., None] * np.arange(1, NEXT)
    beside = off[ends] - off[ends[..., None] + inward].mean(axis=2)
    beside = np.clip(beside / scatter, -OUTLIER, OUTLIER)
    return beside.mean(axis=1) * math.sqrt(ends.shape[1] / (1 + 1 / (NEXT - 1)))


def _trimmed(pool: Pool) -> tuple[Pool, list[str]]:
    """The fit without readings at the edges of cycles that are not of the decay."""
    cut, high = np.zeros(2, int), 0
    most = int(np.median(pool.cycles.lengths)) // 3
    while cut.max() < most and np.any(far := np.abs(edges := _edges(pool)) > EDGE):
        high += int(edges[0] > EDGE)
        keep = np.ones(pool.cycles.time.size, bool)
        first, lengths = pool.cycles.first, pool.cycles.lengths
        long = lengths > NEXT
        for side, ends in enumerate((first, first + lengths - 1)):
            keep[ends[long]] &= not far[side]
        pool, cut = solved(pool.cycles.kept(keep)), cut + far
    said = []
    for side, why in enumerate(
        ("fresh beam decays faster" if 2 * high >= cut[0] else WITHIN, WITHIN)
    ):
        if cut[side]:
            which = f"{('first', 'last')[side]} {cut[side]}"
            of_each = (
                "reading of each cycle was" if cut[side] == 1 else "readings of each cycle were"
            )
            said.append(f"the {which} {of_each} left out: {why}")
    return pool, said


def cleaned(cycles: Cycles) -> tuple[Pool, tuple[str, ...]]:
    """The fit without readings, edges of cycles and cycles that are not of the decay."""
    said, pool = [], solved(cycles)
    departure, error = _per_cycle(pool)
    cut = np.repeat(_far(departure / error), pool.cycles.lengths)
    if cut.any():
        before = pool.cycles.first.size
        pool = solved(pool.cycles.kept(~cut))
        left = before - pool.cycles.first.size
        were = "cycle was" if left == 1 else "cycles were"
        said.append(f"{left} {were} left out, whose loss rate lies far off the others'")
    pool, edges = _trimmed(pool)
    said = edges + said
    if (lone := _far(pool.left[:, 3])).any():
        said.append(f"{int(lone.sum())} readings were left out as outliers")
        pool = solved(pool.cycles.kept(~lone))
    return pool, tuple(said)
