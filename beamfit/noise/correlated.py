"""Posterior over correlated noise models, and quantities averaged over it.

The correlation is unknown: each noise of a grid whitens the rows once. The whitened residuals give
the probability of the noise, and the rows the parameters under it.
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

# Singular values above this share of the largest determine their direction: 1e6 rounding errors.
CUT = 1e-10
# Relative ridge of Gram matrices, of the size of rounding errors: columns may be zero.
ROUNDING_RIDGE = 1e-15
# Grid of correlation times: shortest in median intervals, longest in records, and their number.
MIN_TIME, MAX_TIME, TIMES = 0.3, 5.0, 20
# Probability within one standard deviation of a normal distribution, and below one above the mean.
CENTRAL, UPPER = 0.682689492, 0.841344746
# Largest number of steps to a distance of given probability; relative size of the last step.
MAX_STEPS, STEP_TOLERANCE = 50, 1e-8


class AveragedMoments(NamedTuple):
    """Quantities that are linear in the parameters, averaged over noises.

    ``shift`` is the change from the linearisation point, ``error`` half of the central 68 %,
    ``reach`` half of the central 95 %, and ``chance`` the probability of a larger change if the
    true one is zero.
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
        Correlation times, and white shares of the variance.
    step : array, shape (g, p)
        Generalised least-squares step of the parameters for each noise.
    half : array, shape (g, p, p)
        Square root of the covariance: half @ half.T, for errors of variance 1.
    squares : array, shape (g,)
        Residual sum of squares of the whitened rows after the step.
    dof : int
        Number of values minus number of parameters.
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
        """Index of the median correlation time, with its most probable white share."""
        order = np.argsort(self.time, kind="stable")
        median = self.time[order[np.searchsorted(np.cumsum(self.weight[order]), 0.5)]]
        return int(np.argmax(np.where(self.time == median, self.weight, -1.0)))

    @property
    def noise(self) -> CorrelatedNoise:
        """Noise with the median correlation time, and its most probable white share."""
        return CorrelatedNoise(float(self.time[self.likely]), float(self.white[self.likely]))

    def of_last(self, numbers: int) -> Memory:
        """Restrict to the last parameters, marginalised over the others."""
        return self._replace(step=self.step[:, -numbers:], half=self.half[:, -numbers:])

    @property
    def mean_step(self) -> np.ndarray:
        """Step, averaged over noises."""
        return self.weight @ self.step

    def moments(self, slopes: np.ndarray, least: float = 0.0) -> AveragedMoments:
        """Average quantities with derivatives ``slopes``, shape (q, p), over noises.

        `least` is the lower limit of the noise level: 1 if errors are given and rows are in their
        unit. With given errors and a single noise the distribution is normal.
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
                shift, stdtrit(dof, UPPER) * spread, stdtrit(dof, 0.975) * spread, chance
            )

        def within(reach: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            """Probability within a distance of the mean, and its derivative."""
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
    """Distance within which a probability lies; `scale` is that of one standard error if normal.

    Newton steps; the bracket is halved where a step leaves it or is longer than half the last one.
    """
    low, high, distance = np.zeros_like(scale), 100.0 * scale, ndtri((1 + probability) / 2) * scale
    last = high
    for _ in range(MAX_STEPS):
        probability_within, slope = within(distance)
        below = probability_within < probability
        low, high = np.where(below, distance, low), np.where(below, high, distance)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            step = (probability - probability_within) / slope
            usable = (
                (distance + step >= low) & (distance + step <= high) & (2 * np.abs(step) <= last)
            )
        step = np.where(
            usable | (np.abs(step) <= STEP_TOLERANCE * distance),
            step,
            0.5 * (low + high) - distance,
        )
        distance, last = distance + step, np.abs(step)
        if np.all(last <= STEP_TOLERANCE * distance):
            break
    return distance


class Whitened(NamedTuple):
    """Derivatives and, in the last column, residuals, whitened by each noise of a grid.

    Attributes
    ----------
    noise : CorrelatedNoise of array, shape (g,)
        The grid.
    triangle : array, shape (g, m, p + 1)
        Triangular factors with the Gram matrix of the whitened rows.
    volume : array, shape (g,)
        Log determinants of the whitening.
    count : int
        Number of values minus number of eliminated levels.
    """

    noise: CorrelatedNoise
    triangle: np.ndarray
    volume: np.ndarray
    count: int

    def least(self, numbers: int | None = None) -> float:
        """-2 ln L of the most probable noise, up to a constant."""
        squares = self.memory(numbers).squares
        return float(np.min(self.count * np.log(squares / self.count) - 2.0 * self.volume))

    def with_widths(self, widths: Sequence[tuple[float, float]], numbers: int) -> Whitened:
        """Add normal priors about zero on the first ``numbers`` parameters.

        Each of the widths, with its probability, is combined with each noise.
        """
        width, chance = np.array(widths).T
        prior_rows = np.eye(numbers, self.triangle.shape[2]) / width[:, None, None]
        logs = np.log(chance) - numbers * np.log(width)
        triangles = np.repeat(self.triangle, len(widths), axis=0)
        prior_rows = np.tile(prior_rows, (len(self.triangle), 1, 1))
        return Whitened(
            CorrelatedNoise(*np.repeat(self.noise, len(widths), axis=1)),
            np.concatenate([triangles, prior_rows], axis=1),
            (self.volume[:, None] + logs).ravel(), self.count + numbers,
        )  # fmt: skip

    def evidence(self) -> float:
        """-2 ln of the evidence, up to a constant.

        It is integrated over parameters and noises, with flat priors of the parameters, of the
        logarithm of the noise level and over the grid.
        """
        return -2.0 * float(logsumexp(self._solve(None)[3]))

    def memory(self, numbers: int | None = None) -> Memory:
        """Posterior over noise models with the first ``numbers`` parameters free, the others fixed.

        Directions below the share `CUT` of the largest singular value stay where they are.

        Notes
        -----
        Generalised least squares for each noise. Its probability is the density of the residuals
        integrated over the parameters (flat) and over the noise level (flat in its logarithm): the
        restricted likelihood of D. A. Harville, Biometrika 61 (1974) 383, which is free of the bias
        of fitted parameters. Noises with and without a white part have equal prior probability.

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
        """Posterior as `memory`, and the log probability of the values for each noise."""
        half, components, squares, logs = self._solve(numbers)
        weight = np.exp(logs - logs.max())
        step = -(half @ components)[..., 0]
        fitted = half.any(axis=1).sum(axis=1).max()  # fixed parameters are not counted
        dof, flicker = self.count - int(fitted), np.isnan(self.noise.time)
        # 1/f noise has no correlation time: it is represented by the most probable correlated one.
        most_similar = int(np.argmax(np.where(flicker, -np.inf, logs)))
        time, white = (np.where(flicker, values[most_similar], values) for values in self.noise)
        return Memory(weight / weight.sum(), time, white, step, half, squares, dof), logs

    def _solve(self, numbers: int | None) -> tuple[np.ndarray, ...]:
        """Solve for each noise: square root of the covariance, components of the residuals,
        residual sum of squares, and log probability.
        """
        slopes, residuals = self.triangle[..., :-1][..., :numbers], self.triangle[..., -1:]
        length = np.linalg.norm(slopes, axis=1)
        unit = 1.0 / np.where(length > 0, length, 1.0)
        basis, singular, vectors = np.linalg.svd(slopes * unit[:, None], full_matrices=False)
        determined = singular > CUT * singular[:, :1]
        inverse = np.where(determined, 1.0 / np.where(determined, singular, 1.0), 0.0)
        half = unit[..., None] * np.swapaxes(vectors, 1, 2) * inverse[:, None]
        components = np.where(determined[..., None], np.swapaxes(basis, 1, 2) @ residuals, 0.0)
        squares = np.maximum(np.sum((residuals - basis @ components) ** 2, axis=(1, 2)), 1e-300)
        logs = self.volume + np.sum(
            np.log(unit) + np.log(np.where(determined, inverse, 1.0)), axis=1
        )
        logs -= 0.5 * (self.count - determined.sum(axis=1)) * np.log(squares)
        without_white = self.noise.white == 0
        if (
            without_white.any() and not without_white.all()
        ):  # equal prior probability with and without white part
            with_white = np.sum(self.noise.white > 0)
            logs += np.where(without_white, np.log(with_white / without_white.sum()), 0.0)
        return half, components, squares, logs


def whitened_by_each(
    grid: Sequence[CorrelatedNoise],
    runs: Sequence[tuple[np.ndarray, np.ndarray]],
    known: np.ndarray | None = None,
    levels: Sequence[Levels] = (),
) -> Whitened:
    """Whiten several runs, each of rows and times, by each noise, which is the same for all.

    `known` are rows of priors, in units of the noise level. `levels`, one for each run, are
    projected out; 1/f noises are then added to the grid.
    """
    noise = CorrelatedNoise(*np.array(grid).T)
    if levels:
        parts = [
            _triangles_without_levels(grid, *run, run_levels)
            for run, run_levels in zip(runs, levels, strict=True)
        ]
    else:
        parts = [_triangles(grid, rows, np.diff(time)) for rows, time in runs]
    triangles, volume = [triangle for triangle, _ in parts], sum(volume for _, volume in parts)
    if levels:  # noises with a white part have half of the probability of correlated ones
        odds = FLICKER / len(POWERS) / (CORRELATED + WALK)
        volume[len(grid) :] += np.log(2.0 * odds * np.sum(noise.white > 0.0))
        noise = CorrelatedNoise(*np.pad(noise, ((0, 0), (0, len(POWERS))), constant_values=np.nan))
    count = sum(len(rows) for rows, _ in runs) - sum(run_levels.first.size for run_levels in levels)
    if known is not None:
        triangles, count = [*triangles, np.tile(known, (noise.time.size, 1, 1))], count + len(known)
    return Whitened(noise, np.concatenate(triangles, axis=1), volume, count)


def _triangles(
    grid: Sequence[CorrelatedNoise], rows: np.ndarray, interval: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Triangular factors of one run's whitened rows, and log determinants, for each noise."""
    rows, triangle = np.linalg.qr(rows)
    roots, volumes = roots_by_each(grid, rows, interval)
    return roots @ triangle, volumes


def roots_by_each(
    grid: Sequence[CorrelatedNoise], rows: np.ndarray, interval: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Cholesky factors of `products_by_each` for orthonormal or zero columns.

    Of such columns the Gram matrix loses no digits.
    """
    products, volumes = products_by_each(grid, rows, interval)
    return _roots(products), volumes


def _roots(products: np.ndarray) -> np.ndarray:
    """Upper triangular Cholesky factors of Gram matrices."""
    ridge = ROUNDING_RIDGE * np.trace(products, axis1=-2, axis2=-1)[..., None, None]
    roots = np.linalg.cholesky(products + ridge * np.eye(products.shape[-1]))
    return np.swapaxes(roots, -1, -2)


def _triangles_without_levels(
    grid: Sequence[CorrelatedNoise], rows: np.ndarray, time: np.ndarray, levels: Levels
) -> tuple[np.ndarray, np.ndarray]:
    """Triangular factors as `_triangles`, with levels projected out and 1/f noises added.

    Rows are padded to a few lengths, so that few programs are compiled.
    """
    extra = (0, padded_length(max(time.size, 64)) - time.size)
    rows, triangle = np.linalg.qr(np.pad(levels.left(rows), (extra, (0, 0))))
    flicker = [_flicker_products(rows[: time.size], levels, power) for power in POWERS]
    begins = np.isin(np.arange(len(rows)), levels.first)
    time, slope = (np.pad(values, extra, mode="edge") for values in (time, levels.slope))
    noises = CorrelatedNoise(*np.array(grid).T)
    products, volumes = map(np.asarray, levelled_products(noises, rows, time, begins, slope))
    flicker_products, flicker_volumes = map(np.array, zip(*flicker, strict=True))
    roots = _roots(np.concatenate([products, flicker_products]))
    return roots @ triangle, np.concatenate([volumes, flicker_volumes])


def _flicker_products(rows: np.ndarray, levels: Levels, power: float) -> tuple[np.ndarray, float]:
    """Gram matrix and log determinant as `levelled_products`, for noise of spectrum 1/f^power.

    Blocks are independent: slower noise acts like their levels.
    """
    columns, products, volume = np.column_stack([levels.slope, rows]), 0.0, 0.0
    lengths = np.diff(levels.first, append=len(rows))
    padded = np.array([padded_length(n) for n in lengths.tolist()])
    for size in np.unique(padded):
        first, count = levels.first[padded == size], lengths[padded == size]
        place = np.arange(size)[:, None]
        valid = (place < count)[..., None]
        blocks = np.where(valid, columns[np.minimum(first + place, len(rows) - 1)], 0.0)
        white = without_flicker(blocks.reshape(size, -1), power).reshape(blocks.shape)
        level_columns, rest = np.split(np.where(valid, white, 0.0), [1], axis=2)
        squares = np.sum(level_columns**2, axis=0)
        rest = (rest - level_columns * (np.sum(level_columns * rest, axis=0) / squares)).reshape(
            -1, rows.shape[1]
        )
        products = products + rest.T @ rest
        # The first reading of a block determines its level, as in `levelled_products`.
        volume += float(np.sum(np.log(np.abs(levels.slope[first])) - 0.5 * np.log(squares[:, 0])))
    return products, volume


def range_of(time: np.ndarray) -> tuple[float, float]:
    """Range of correlation times between white noise and a random walk, for given times."""
    interval = float(np.median(np.diff(time)))
    return MIN_TIME * interval, MAX_TIME * float(time[-1] - time[0])


def usual_noises(time: np.ndarray) -> list[CorrelatedNoise]:
    """List noises that readings at these times may have.

    Correlation times are from 0.3 median intervals to five records, equally spaced in the
    logarithm, each with several white shares. Without these, a drifting monitor with a noisy
    converter would be taken for a short memory, and errors would be several times too small. Near
    the upper end the noise is a random walk: its level is unknown, but slope and curvature of the
    rows are determined.
    """
    return noises(range_of(time), float(np.median(np.diff(time))), TIMES, BESIDE)
