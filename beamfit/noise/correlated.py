"""Posterior over noise models with a memory, and quantities averaged over it.

The memory is not known either: each noise that is looked at whitens the rows once, and what is left
of them says how likely it is and what the numbers are with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import logsumexp, ndtri, stdtr, stdtrit

from beamfit.arrays import padded_length
from beamfit.noise.memory import (
    BESIDE,
    CORRELATED,
    FLICKER,
    POWERS,
    WALK,
    CorrelatedNoise,
    Levels,
    levelled_products,
    noises,
    products_by_each,
    without_flicker,
)
from beamfit.statistics import log_student

# A direction is determined if its singular value exceeds this share of the largest: 1e6 roundings.
CUT = 1e-10
# What rounding leaves of products of rows that are nothing.
ROUNDING = 1e-15
# Grid of correlation times: from this share of the median interval to this many records, and count.
SHORTEST, LONGEST, TIMES = 0.3, 5.0, 20
# Central 68 %, one standard deviation to either side of a normal distribution, and its upper end.
CENTRAL, HALF = 0.682689492, 0.841344746
# Most steps to a distance of given probability, and the last step's share of its size.
ROUNDS, ENOUGH = 50, 1e-8


class AveragedMoments(NamedTuple):
    """Quantities that are linear in the numbers: how far each moves from where the rows were
    taken, its error (68 % lie within), the reach within which 95 % lie, and the chance of a
    larger distance from zero movement if that is the truth.
    """

    shift: np.ndarray
    error: np.ndarray
    reach: np.ndarray
    chance: np.ndarray


class Memory(NamedTuple):
    """Posterior over noise models, given Jacobian and residuals.

    Attributes
    ----------
    weight : array, shape (g,)
        Probability of each noise.
    time, white : array, shape (g,)
        The correlation times, and the shares of variance without memory.
    step : array, shape (g, p)
        Generalised least-squares step of the numbers at each.
    half : array, shape (g, p, p)
        half @ half.T is the covariance of the numbers for errors of size 1.
    squares : array, shape (g,)
        Sum of squares of the whitened residuals after the step.
    dof : int
        Values less numbers.
    """

    weight: np.ndarray
    time: np.ndarray
    white: np.ndarray
    step: np.ndarray
    half: np.ndarray
    squares: np.ndarray
    dof: int

    @property
    def likely(self) -> int:
        """Index of the median correlation time, and of the share that is likeliest with it."""
        order = np.argsort(self.time, kind="stable")
        median = self.time[order[np.searchsorted(np.cumsum(self.weight[order]), 0.5)]]
        return int(np.argmax(np.where(self.time == median, self.weight, -1.0)))

    @property
    def noise(self) -> CorrelatedNoise:
        """That."""
        return CorrelatedNoise(float(self.time[self.likely]), float(self.white[self.likely]))

    def of_last(self, numbers: int) -> Memory:
        """The same of the last numbers, whatever the others are."""
        return self._replace(step=self.step[:, -numbers:], half=self.half[:, -numbers:])

    @property
    def mean_step(self) -> np.ndarray:
        """The step, averaged over noises."""
        return self.weight @ self.step

    def moments(self, slopes: np.ndarray, least: float = 0.0) -> AveragedMoments:
        """Quantities by their slopes, shape (q, p), averaged over noises.

        `least` is the least size of the errors: 1 where they were given and rows are in their
        unit. Of a single noise errors that were given are normal.
        """
        centre = self.step @ slopes.T
        size = np.maximum(np.sqrt(self.squares / self.dof), least)
        spread = np.linalg.norm(np.einsum("qp,gpr->gqr", slopes, self.half), axis=2)
        spread = np.maximum(spread * size[:, None], 1e-300)
        shift = self.weight @ centre
        if self.weight.size == 1:
            [spread], dof = spread, np.inf if least else self.dof
            chance = 2 * stdtr(self.dof, -np.abs(shift) / spread)
            return AveragedMoments(
                shift, stdtrit(dof, HALF) * spread, stdtrit(dof, 0.975) * spread, chance
            )

        def within(reach: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            above, below = ((shift + sign * reach - centre) / spread for sign in (1, -1))
            slope = np.exp(log_student(above, self.dof)) + np.exp(log_student(below, self.dof))
            return self.weight @ (stdtr(self.dof, above) - stdtr(self.dof, below)), (
                self.weight @ (slope / spread)
            )

        reaches = [reach_of_probability(within, np.max(np.abs(centre - shift) + spread, 0), p)
                   for p in (CENTRAL, 0.95)]  # fmt: skip
        chance = self.weight @ (2 * stdtr(self.dof, -np.abs(centre) / spread))
        return AveragedMoments(shift, *reaches, chance)


def reach_of_probability(within, scale: np.ndarray, probability: float) -> np.ndarray:
    """Distance within which this probability lies; `scale` is what a normal error would be.

    By Newton steps, and halves of the bracket where one leaves it or is no shorter by half.
    """
    low, high, at = np.zeros_like(scale), 100.0 * scale, ndtri((1 + probability) / 2) * scale
    last = high
    for _ in range(ROUNDS):
        found, slope = within(at)
        less = found < probability
        low, high = np.where(less, at, low), np.where(less, high, at)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            step = (probability - found) / slope
            usable = (at + step >= low) & (at + step <= high) & (2 * np.abs(step) <= last)
        step = np.where(usable | (np.abs(step) <= ENOUGH * at), step, 0.5 * (low + high) - at)
        at, last = at + step, np.abs(step)
        if np.all(last <= ENOUGH * at):
            break
    return at


class Whitened(NamedTuple):
    """Slopes and, last, residuals, whitened by each noise that is looked at.

    Attributes
    ----------
    noise : CorrelatedNoise of array, shape (g,)
        What is looked at.
    triangle : array, shape (g, m, p + 1)
        With the same sums of squares and products as the whitened rows.
    volume : array, shape (g,)
        Logarithm of the normalisation of the noise's density.
    count : int
        Values, less what was eliminated.
    """

    noise: CorrelatedNoise
    triangle: np.ndarray
    volume: np.ndarray
    count: int

    def least(self, numbers: int | None = None) -> float:
        """-2 ln L by the likeliest noise, up to a constant."""
        squares = self.memory(numbers).squares
        return float(np.min(self.count * np.log(squares / self.count) - 2.0 * self.volume))

    def with_widths(self, widths: Sequence[tuple[float, float]], numbers: int) -> Whitened:
        """With normal priors about zero on the first `numbers`: each of some widths, over the
        noise, with a probability.
        """
        width, chance = np.array(widths).T
        known = np.eye(numbers, self.triangle.shape[2]) / width[:, None, None]
        logs = np.log(chance) - numbers * np.log(width)
        every = np.repeat(self.triangle, len(widths), axis=0)
        known = np.tile(known, (len(self.triangle), 1, 1))
        return Whitened(
            CorrelatedNoise(*np.repeat(self.noise, len(widths), axis=1)),
            np.concatenate([every, known], axis=1),
            (self.volume[:, None] + logs).ravel(), self.count + numbers,
        )  # fmt: skip

    def evidence(self) -> float:
        """-2 ln of the probability of the values, numbers and noise integrated out: up to a
        constant, flat in the numbers, in the logarithm of the errors' size and over the noises.
        """
        return -2.0 * float(logsumexp(self._solved(None)[3]))

    def memory(self, numbers: int | None = None) -> Memory:
        """Posterior over noise models with the first `numbers` free and the others held.

        Directions that the rows do not see, by a share of `CUT`, are left where they are.

        Notes
        -----
        By each noise generalised least squares; its probability is the density of the residuals
        integrated over the numbers (flat) and over the size of the errors (flat in its logarithm):
        the restricted likelihood of D. A. Harville, Biometrika 61 (1974) 383, which the fitted
        numbers do not bias, at even odds that a part of the noise is white where that is looked at.

        Examples
        --------
        >>> noise = np.random.default_rng(3).normal(size=300)
        >>> walk, time = np.zeros(300), np.arange(300.0)
        >>> for k in range(1, 300):
        ...     walk[k] = 0.8 * walk[k - 1] + 0.6 * noise[k]
        >>> rows = np.column_stack([np.ones(300), walk - 5.0])
        >>> found = whitened_by_each(usual_noises(time), [(rows, time)]).memory()
        >>> print(f"{found.mean_step[0]:.1f}, {np.exp(-1 / found.time[found.likely]):.1f}")
        4.9, 0.8
        """
        return self.weighed(numbers)[0]

    def weighed(self, numbers: int | None = None) -> tuple[Memory, np.ndarray]:
        """The same and, by each noise, the logarithm of the probability of the values."""
        half, along, squares, logs = self._solved(numbers)
        weight = np.exp(logs - logs.max())
        step = -(half @ along)[..., 0]
        seen = half.any(axis=1).sum(axis=1).max()  # numbers that are held are not fitted
        dof, flicker = self.count - int(seen), np.isnan(self.noise.time)
        # 1/f noise has no time: it is named by the one that is most like it.
        like = int(np.argmax(np.where(flicker, -np.inf, logs)))
        time, white = (np.where(flicker, own[like], own) for own in self.noise)
        return Memory(weight / weight.sum(), time, white, step, half, squares, dof), logs

    def _solved(self, numbers: int | None) -> tuple[np.ndarray, ...]:
        """Root of the covariance, components of the residuals, what is left of their squares, and
        the logarithm of each noise's probability.
        """
        slopes, rest = self.triangle[..., :-1][..., :numbers], self.triangle[..., -1:]
        length = np.linalg.norm(slopes, axis=1)
        unit = 1.0 / np.where(length > 0, length, 1.0)
        left, sizes, turned = np.linalg.svd(slopes * unit[:, None], full_matrices=False)
        seen = sizes > CUT * sizes[:, :1]
        inverse = np.where(seen, 1.0 / np.where(seen, sizes, 1.0), 0.0)
        half = unit[..., None] * np.swapaxes(turned, 1, 2) * inverse[:, None]
        along = np.where(seen[..., None], np.swapaxes(left, 1, 2) @ rest, 0.0)
        squares = np.maximum(np.sum((rest - left @ along) ** 2, axis=(1, 2)), 1e-300)
        logs = self.volume + np.sum(np.log(unit) + np.log(np.where(seen, inverse, 1.0)), axis=1)
        logs -= 0.5 * (self.count - seen.sum(axis=1)) * np.log(squares)
        alone = self.noise.white == 0
        if alone.any() and not alone.all():  # even odds for a white part
            beside = np.sum(self.noise.white > 0)
            logs += np.where(alone, np.log(beside / alone.sum()), 0.0)
        return half, along, squares, logs


def whitened_by_each(
    grid: Sequence[CorrelatedNoise],
    runs: Sequence[tuple[np.ndarray, np.ndarray]],
    known: np.ndarray | None = None,
    levels: Sequence[Levels] = (),
) -> Whitened:
    """Whiten runs, each of rows and times, by each noise; all of them have the same.

    `known` are rows of priors, in units of the noise; `levels`, of each run, are eliminated, and
    noise may be 1/f beside the grid's then.
    """
    noise = CorrelatedNoise(*np.array(grid).T)
    if levels:
        parts = [_levelled(grid, *run, own) for run, own in zip(runs, levels, strict=True)]
    else:
        parts = [_triangles(grid, rows, np.diff(time)) for rows, time in runs]
    triangles, volume = [triangle for triangle, _ in parts], sum(volume for _, volume in parts)
    if levels:  # those with a part that is white have half of what is correlated
        odds = FLICKER / len(POWERS) / (CORRELATED + WALK)
        volume[len(grid) :] += np.log(2.0 * odds * np.sum(noise.white > 0.0))
        noise = CorrelatedNoise(*np.pad(noise, ((0, 0), (0, len(POWERS))), constant_values=np.nan))
    count = sum(len(rows) for rows, _ in runs) - sum(own.first.size for own in levels)
    if known is not None:
        triangles, count = [*triangles, np.tile(known, (noise.time.size, 1, 1))], count + len(known)
    return Whitened(noise, np.concatenate(triangles, axis=1), volume, count)


def _triangles(
    grid: Sequence[CorrelatedNoise], rows: np.ndarray, interval: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Triangular factors of one run's whitened rows, and log volumes, for each noise."""
    rows, triangle = np.linalg.qr(rows)
    roots, volumes = roots_by_each(grid, rows, interval)
    return roots @ triangle, volumes


def roots_by_each(
    grid: Sequence[CorrelatedNoise], rows: np.ndarray, interval: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Triangular roots of `products_by_each` of columns at right angles, of which products lose no
    digit; columns may be nothing.
    """
    products, volumes = products_by_each(grid, rows, interval)
    return _roots(products), volumes


def _roots(products: np.ndarray) -> np.ndarray:
    least = ROUNDING * np.trace(products, axis1=-2, axis2=-1)[..., None, None]
    roots = np.linalg.cholesky(products + least * np.eye(products.shape[-1]))
    return np.swapaxes(roots, -1, -2)


def _levelled(
    grid: Sequence[CorrelatedNoise], rows: np.ndarray, time: np.ndarray, levels: Levels
) -> tuple[np.ndarray, np.ndarray]:
    """Triangular factors as of `_triangles` without levels, the rows padded to a few lengths; by
    1/f noises, too.
    """
    extra = (0, padded_length(max(time.size, 64)) - time.size)
    rows, triangle = np.linalg.qr(np.pad(levels.left(rows), (extra, (0, 0))))
    flicker = [_by_flicker(rows[: time.size], levels, power) for power in POWERS]
    begins = np.isin(np.arange(len(rows)), levels.first)
    time, slope = (np.pad(each, extra, mode="edge") for each in (time, levels.slope))
    noises = CorrelatedNoise(*np.array(grid).T)
    products, volumes = map(np.asarray, levelled_products(noises, rows, time, begins, slope))
    more, further = map(np.array, zip(*flicker, strict=True))
    roots = _roots(np.concatenate([products, more]))
    return roots @ triangle, np.concatenate([volumes, further])


def _by_flicker(rows: np.ndarray, levels: Levels, power: float) -> tuple[np.ndarray, float]:
    """Products and log volume as of `levelled_products` in noise of the spectrum 1/f^power, of each
    block by itself: what is slower its level takes.
    """
    columns, found, volume = np.column_stack([levels.slope, rows]), 0.0, 0.0
    lengths = np.diff(levels.first, append=len(rows))
    padded = np.array([padded_length(n) for n in lengths.tolist()])
    for size in np.unique(padded):
        first, count = levels.first[padded == size], lengths[padded == size]
        place = np.arange(size)[:, None]
        there = (place < count)[..., None]
        blocks = np.where(there, columns[np.minimum(first + place, len(rows) - 1)], 0.0)
        white = without_flicker(blocks.reshape(size, -1), power).reshape(blocks.shape)
        own, rest = np.split(np.where(there, white, 0.0), [1], axis=2)
        squares = np.sum(own**2, axis=0)
        rest = (rest - own * (np.sum(own * rest, axis=0) / squares)).reshape(-1, rows.shape[1])
        found = found + rest.T @ rest
        # The first reading of a block says what its level is, as there.
        volume += float(np.sum(np.log(np.abs(levels.slope[first])) - 0.5 * np.log(squares[:, 0])))
    return found, volume


def range_of(time: np.ndarray) -> tuple[float, float]:
    """Correlation times that readings at these times can tell from none and from a random walk."""
    usual = float(np.median(np.diff(time)))
    return SHORTEST * usual, LONGEST * float(time[-1] - time[0])


def usual_noises(time: np.ndarray) -> list[CorrelatedNoise]:
    """Noises that readings at these times may have.

    From 0.3 usual intervals to five times the record, flat in the logarithm. A part of the noise
    may be white: a monitor that drifts, read by a noisy converter, would pass for a short memory
    otherwise, and its errors come out several times too small; the ratio of both is averaged over,
    too. Near the upper end the errors are a random walk: nothing tells its level, but slope and
    bend the rows do tell.
    """
    return noises(range_of(time), float(np.median(np.diff(time))), TIMES, BESIDE)
