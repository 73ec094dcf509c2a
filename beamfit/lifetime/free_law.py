"""Posterior of a decay whose law is uncertain, averaged over departures from constant a and b and
over the noise.

With x the current over its mean and s the time over the span, the loss rate is share R x^(1 + g) +
(1 - share) R (1 + h f(s)), where share, from 0 to 1, is that of a in the mean loss rate R. The gas
loss changes by h: either linearly, f = s - 1/2, or as gas that is pumped away after a fill, f = 1/k
- exp(-k s)/(1 - exp(-k)), with g = 0. The exponent g, the change h and the pace k have priors; the
priors of the first current, the loss rate and the share are flat.

With g and h, the whole loss rate or the monitor may wander in addition; with g and h, or with
constant a and b, the monitor may settle after a fill. The current has a closed form with one
integral, computed on Chebyshev nodes. The readings depend linearly on the currents at the nodes, so
that the whitened Gram matrix of that linear map and the residuals is all that the likelihood needs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.polynomial.chebyshev import chebint, chebvander
from scipy.linalg import block_diag
from scipy.special import expit, log_expit, log_ndtr, logsumexp, ndtri

from beamfit.arrays import array_module
from beamfit.lifetime.expansion import Physical, Pieces
from beamfit.lifetime.record import DecayRecord
from beamfit.noise.memory import Products
from beamfit.quantity import HOUR, Quantity
from beamfit.statistics import CENTRAL, MIN_EFFECTIVE_DRAWS, WIDE

# Prior of the exponent g of a ∝ I^g: standard deviations below and above zero. Bunches lengthen
# with the current (potential well: x³ - x ∝ I, `beamfit.lifetime.ring`), so that g lies between
# 0 and -1/3; bunches that shorten, or a vacuum that follows the current, are rare.
EXPONENT_SD_BELOW, EXPONENT_SD_ABOVE = 0.3, 0.2
# Share of that prior that is flat over the range of exponents.
FLAT_SHARE = 0.05
MIN_EXPONENT, MAX_EXPONENT = -0.9, 2.0
# Standard deviation of the relative change of b over one record: pressures of stored beams are
# read to 10 %.
DRIFT = 0.1
# Prior probability of the smooth laws (exponent and drift of b, no disturbance).
SMOOTH_PRIOR = 0.6
# Prior probability of gas that is pumped away after a fill, ranges of its time constant over the
# span and of its initial loss rate over the mean one; both are flat in the logarithm.
OUTGASSING_PRIOR = 0.08
OUTGASSING_TIMES, OUTGASSING_RATES = (1e-3, 1.0), (1e-3, 10.0)
# Prior probability of a loss rate that wanders as a random walk, as a pressure does; a monitor
# that wanders has the same.
WANDER_PRIOR = 0.14
# Standard deviations of that walk at the end of the record, as shares of the loss rate; equally
# probable.
WALK_SIZES = (0.003, 0.015, 0.07, 0.3)
# Typical instability of a monitor, as a share of the current: between two calibrations of the
# monitor of MIT-Bates its zero moved by 0.1 to 0.2 % (T. Botto, BlastTalk 2712).
MONITOR_INSTABILITY = 1e-3
# Steps per factor of two of the settling paces: between two of them the shapes are linear in the
# logarithm of the pace to within the noise of a monitor.
PACES_PER_OCTAVE = 4
# Paces (span over time constant) of a monitor that settles after a fill; equally probable. In all
# they have the prior probability of gas that is pumped away.
SETTLING_PACES = 2.0 ** np.arange(1, 6 + 1 / PACES_PER_OCTAVE, 1 / PACES_PER_OCTAVE)
# Standard deviation of ln pace within one step of these.
LOG_PACE_SD = math.log(2.0) / PACES_PER_OCTAVE / math.sqrt(12.0)
# Range of paces (span over time constant) of gas that is pumped away; faster outgassing is an
# alternative of its own (`beamfit.lifetime.alternatives`).
OUTGASSING_PACES = (1.0, 20.0)
# Smallest |d bend / d share| in the change of variables; it is zero where 1 + g + h/R = 0.
MIN_SLOPE = 1e-3
# Chebyshev nodes of the integral: exact to rounding for records of up to four lifetimes.
NODES = 18

# Nodes on [-1, 1]; as times over the span, on [0, 1]; matrix from values at the nodes to Chebyshev
# coefficients; matrix from values at the nodes to their integral from 0 to each node.
CHEBYSHEV = -np.cos(np.pi * np.arange(NODES) / (NODES - 1))
NODE = (1 + CHEBYSHEV) / 2
TO_COEFFICIENTS = np.linalg.inv(chebvander(CHEBYSHEV, NODES - 1))
INTEGRAL = chebvander(CHEBYSHEV, NODES) @ chebint(TO_COEFFICIENTS, lbnd=-1) / 2


# Covariance at the nodes of a random walk less its mean over the record: min(s, t) less its means
# over s, over t, and plus that over both; and its Cholesky factor.
_MEAN = NODE - NODE**2 / 2
_COVARIANCE = np.minimum.outer(NODE, NODE) - np.add.outer(_MEAN, _MEAN) + 1 / 3
WALK_FACTOR = np.linalg.cholesky(_COVARIANCE + 1e-12 * np.eye(NODES))


def from_nodes(s: np.ndarray) -> np.ndarray:
    """Matrix from values at the nodes to values at times over the span, shape (n, 18).

    Examples
    --------
    >>> (from_nodes(np.array([0.25])) @ NODE**2).round(9).tolist()
    [0.0625]
    """
    return chebvander(2 * s - 1, NODES - 1) @ TO_COEFFICIENTS


def smooth_curves(count: int) -> np.ndarray:
    """First Chebyshev polynomials at the nodes, at most `count`, shape (18, m).

    Examples
    --------
    >>> smooth_curves(2).round(1)[[0, -1]].tolist()
    [[1.0, -1.0], [1.0, 1.0]]
    """
    return chebvander(CHEBYSHEV, NODES - 1)[:, :count]


def _transposed(matrices: np.ndarray) -> np.ndarray:
    return np.swapaxes(matrices, 1, 2)


@dataclass(frozen=True, eq=False)
class Disturbance:
    """A loss rate or a monitor that varies independently of the law.

    Parameters
    ----------
    shapes : array, shape (w, 18, r)
        Disturbance at the nodes, as a share of the loss rate or of the current, for each of r
        independent standard normal numbers; w sizes or time constants are equally well possible.
    chance : array, shape (w,)
        Prior probability of each.
    of_loss : bool
        True if the loss rate varies, False if the monitor does.
    """

    shapes: np.ndarray
    chance: np.ndarray
    of_loss: bool = False

    def reading_shapes(self, rate: float) -> np.ndarray:
        """Return the relative changes of the readings, at `rate`, the loss in the span."""
        return -rate * (INTEGRAL @ self.shapes) if self.of_loss else self.shapes


def settling_shapes() -> np.ndarray:
    """Shapes exp(-k s) of a monitor that settles at each pace k, each with its derivative by the
    logarithm of the pace times `LOG_PACE_SD`, shape (w, 18, 2).
    """
    decay = np.multiply.outer(SETTLING_PACES, NODE)
    return np.exp(-decay)[..., None] * np.stack([np.ones_like(decay), LOG_PACE_SD * decay], axis=-1)


_SHAPES = np.multiply.outer(WALK_SIZES, WALK_FACTOR)
LOSS_WANDERS = Disturbance(_SHAPES, np.full(len(WALK_SIZES), WANDER_PRIOR / len(WALK_SIZES)), True)
_EACH = np.full(len(SETTLING_PACES), OUTGASSING_PRIOR / len(SETTLING_PACES))
MONITOR_SETTLES = Disturbance(MONITOR_INSTABILITY * settling_shapes(), _EACH)


def monitor_wanders(rate: float) -> Disturbance:
    """Build a monitor that imitates a loss rate that wanders.

    Its shapes are the changes of the readings that a wandering loss rate makes, less their straight
    line; the difference of the two ends is that of two independent readings of the same size. Its
    prior probability is that of a wandering loss rate, times 1/(1 + m²) with m the size over the
    typical instability of a monitor (Cauchy).
    """
    shapes = LOSS_WANDERS.reading_shapes(rate)
    shapes = shapes - np.einsum("s,wsr->wr", INTEGRAL[-1], shapes)[:, None]
    size = np.sqrt(np.einsum("s,wsr->w", INTEGRAL[-1], shapes**2))[:, None, None]
    ends = math.sqrt(2.0) * size * (NODE - 0.5)[:, None]
    chance = LOSS_WANDERS.chance / (1 + (size.ravel() / MONITOR_INSTABILITY) ** 2)
    return Disturbance(np.concatenate([shapes, ends], axis=2), chance)


def disturbances(rate: float) -> tuple[Disturbance, ...]:
    """List all disturbances, at `rate`, the loss in the span."""
    return LOSS_WANDERS, monitor_wanders(rate), MONITOR_SETTLES


class Law(StrEnum):
    """Assumption on the law of a decay.

    Attributes
    ----------
    free
        The exponent of a and the drift of b are free, with priors.
    constant
        a and b are constant, or their dependence is given.
    """

    free = "free"
    constant = "constant"


# Coordinates of the search: rows 0 and 1 are ln level and ln rate, then bend, exponent, change of
# the gas loss, and pace of that change.
BEND, POWER, CHANGE, PACE = range(2, 6)
# Free coordinates of the law with constant a and b.
CONSTANT = (0, 1, BEND)


def gas_change(s, pace):
    """Relative change f(s) of the gas loss at a time over the span: linear at a pace of 0.

    It rises by 1 from the first to the last reading; its mean is 0.

    Examples
    --------
    >>> gas_change(0.0, 0.0).item(), (gas_change(1.0, 3.0) - gas_change(0.0, 3.0)).round(9).item()
    (-0.5, 1.0)
    """
    xp = array_module(s, pace)
    k = xp.where(pace > 0, pace, 1.0)
    return xp.where(pace > 0, 1 / k + xp.exp(-k * s) / xp.expm1(-k), s - 0.5)


def gas_change_integral(pace):
    """Integral of `gas_change` from 0 to each node, one column for each pace."""
    xp = array_module(pace)
    s, k = NODE[:, None], xp.where(pace > 0, pace, 1.0)
    return xp.where(pace > 0, (s - xp.expm1(-k * s) / xp.expm1(-k)) / k, (s**2 - s) / 2)


class LawParameters(NamedTuple):
    """Parameters of the law, one array element for each set.

    Attributes
    ----------
    level
        First current over the mean.
    rate
        Loss in the span at the mean current.
    share
        Share of a in that loss.
    power
        Exponent g of a ∝ I^g.
    gas
        Change of the gas loss over the record, as a share of the whole loss.
    pace
        Pace of that change; 0 for a linear one.
    share_by_bend
        Derivative of the share by the bend.
    """

    level: np.ndarray
    rate: np.ndarray
    share: np.ndarray
    power: np.ndarray
    gas: np.ndarray
    pace: np.ndarray
    share_by_bend: np.ndarray

    @classmethod
    def of(cls, found: np.ndarray) -> LawParameters:
        """Convert coordinates of the search: rows of ln level, ln rate, bend, exponent, change,
        pace.

        The linear change is relative to the gas loss, that of gas which is pumped away to the whole
        loss. The bend, share (1 + g) - (1 - share) h / R, says how the loss rate falls with the
        current. The record determines it directly: in this coordinate the posterior is nearly
        normal.
        """
        level, rate = np.exp(np.clip(found[:2], -30.0, 8.0))
        power, change, pace = found[POWER:]
        bend_by_share = np.where(pace > 0, 1.0, 1 + power + change / rate)
        bend_by_share = np.where(np.abs(bend_by_share) < MIN_SLOPE, MIN_SLOPE, bend_by_share)
        share = (found[BEND] + change / rate) / bend_by_share
        gas = np.where(pace > 0, change, (1 - share) * change)
        return cls(level, rate, share, power, gas, pace, 1 / bend_by_share)

    @property
    def drift(self) -> np.ndarray:
        """Change of b over b."""
        return self.gas / (1 - self.share)

    def currents(self, gas: np.ndarray) -> np.ndarray:
        """Currents at the nodes over the mean, one column for each set.

        `gas` is the integral of the pressure over its mean, shape (18,).
        """
        change_integral = gas_change_integral(self.pace if np.any(self.pace) else np.zeros(1))
        quadratic = self.share * self.rate
        lost = (self.rate - quadratic) * gas[:, None] + self.rate * self.gas * change_integral
        return node_currents(self.level, quadratic, self.power, lost)


def node_currents(level, quadratic, power, lost):
    """Currents at the nodes over the mean, (18, m).

    The closed form of `beamfit.lifetime.decay_law.closed_form` with W = ∫ exp(-c B) ds, where B is
    the logarithmic loss to the gas up to each node.
    """
    xp = array_module(level, quadratic, power, lost)
    c, lost = 1 + power, xp.clip(lost, -200, 200)  # against overflow, far beyond any beam
    base = 1 + c * quadratic * level**c * (INTEGRAL @ xp.exp(-c * lost))
    # An unphysical loss (a < 0) may end the beam within the record: the law has no value there.
    return level * xp.exp(-lost) * xp.maximum(base, 1e-3) ** (-1 / c)


def log_exponent_prior(power):
    """Log density of exponents, and that of its flat part alone."""
    xp = array_module(power)
    width = xp.where(power < 0, EXPONENT_SD_BELOW, EXPONENT_SD_ABOVE)
    scale = np.sqrt(np.pi / 2) * (EXPONENT_SD_BELOW + EXPONENT_SD_ABOVE)
    normal = xp.exp(-0.5 * (power / width) ** 2) / scale
    flat = FLAT_SHARE / (MAX_EXPONENT - MIN_EXPONENT)
    return xp.log((1 - FLAT_SHARE) * normal + flat), np.log(flat)


def log_drift_prior(change):
    """Log density of the relative change of b (linear in time)."""
    return -0.5 * (change / DRIFT) ** 2 - math.log(DRIFT * math.sqrt(2 * math.pi))


def log_outgassing_prior(share, gas, pace):
    """Log prior of gas that is pumped away: density of its change and pace, with the prior odds
    against the smooth laws.
    """
    xp = array_module(share, gas, pace)
    initial = gas / xp.expm1(-pace)  # initial loss rate over the mean one
    in_range = (initial > OUTGASSING_RATES[0]) & (initial < OUTGASSING_RATES[1])
    inside = in_range & (-gas < pace * (1 - share))  # the gas loss stays positive
    width = math.log(OUTGASSING_RATES[1] / OUTGASSING_RATES[0])
    width = width * math.log(OUTGASSING_TIMES[1] / OUTGASSING_TIMES[0])
    odds = OUTGASSING_PRIOR / SMOOTH_PRIOR
    density = math.log(odds / width) - xp.log(xp.where(inside, -gas, 1.0) * pace)
    return xp.where(inside, density, -np.inf)


# A disturbance is combined only with noises whose log likelihood is within this of the best.
LOG_LIKELIHOOD_RANGE = 3.0
# Fewer readings determine no noise level in addition to a curve as free as the law.
MIN_DISTURBED_READINGS = 10
# Smallest relative noise of a measured record: DC current transformers resolve 1e-6. A record with
# less was computed, and has no disturbance.
MIN_NOISE = 1e-7
# Standard deviation of the change of gas that is pumped away in the normal approximation.
OUTGASSING_SD = 0.5
# Grid of exponents or paces: its points, and how often it is refined about the posterior.
GRID_POINTS, MAX_REFINEMENTS = 33, 5
# Gauss-Newton iterations at each grid, and the step in standard deviations at which they stop:
# importance weights correct for so much.
MAX_ITERATIONS, STEP_TOLERANCE = 6, 0.2
# Above this many readings neighbours are averaged: the curve is smooth between them.
MAX_ROWS = 1024
# Importance sampling: draws per law in the first round, effective sample size at which drawing
# stops, and the largest number of draws of a law.
FIRST_DRAWS, ENOUGH_EFFECTIVE, MAX_DRAWS = 512, 2500.0, 60000
# Scale of the logistic proposal, in standard deviations of the normal approximation: heavier tails.
PROPOSAL_SCALE = 0.6
# Width of the strip at a bound of the share in which draws are counted for the density there, in
# standard deviations of the share.
BOUND_STRIP = 0.25
# Range of shares of a of an unphysical law (a < 0 or b < 0), and its prior odds.
UNPHYSICAL_SHARES, UNPHYSICAL_ODDS = (-2.0, 3.0), 0.05
# Relative rounding error of the Gram matrix: smallest pivot of its Cholesky factor.
ROUNDING = 1e-15
# Step of the finite differences that give slopes.
DIFFERENCE_STEP = 1e-5
# Probabilities farther than this below the largest, in the logarithm, are negligible.
NEGLIGIBLE_LOG = 9.0

# Probability from which a law counts as that of the record.
MORE_PROBABLE = 0.5
# Variations in addition to those of a and b: gas that is pumped away, a loss rate or a monitor that
# wanders, a monitor that settles after a fill.
ADDITIONS = ("pumped", "wanders", "settles")

# Places at which a lifetime is quoted, and units of the quoted quantities.
ENDS = ("start", "end", "mean")
UNITS = {
    "a": "1/(mA s)",
    "b": "1/s",
    "i0": "mA",
    "lifetime_start": "h",
    "lifetime_end": "h",
    "lifetime_mean": "h",
}


class DisturbancePosterior(NamedTuple):
    """Posterior of a disturbance at the nodes, given the currents, for each noise.

    Attributes
    ----------
    mean : array, shape (k, 18, 19)
        Matrix from residual coefficients (`ReducedDecay.coefficients`) to the mean.
    factor : array, shape (k, 18, r)
        Square root of the covariance, over the noise level.
    kind : Disturbance
        Its prior.
    """

    mean: np.ndarray
    factor: np.ndarray
    kind: Disturbance


@dataclass(frozen=True)
class ReducedDecay:
    """A record reduced to the whitened Gram matrix of its residuals and its columns.

    Parameters
    ----------
    products : Products
        Gram matrix, for each noise, of 19 columns: the residuals at `start` (reading less model),
        and the readings' dependence on the currents at the nodes.
    start : array, shape (6, 1)
        Coordinates of a law near the most probable one.
    origin : array, shape (18, 1)
        Its currents at the nodes.
    gas : array, shape (18,)
        Integral of the pressure over its mean up to the nodes, over the span.
    ends : tuple of float
        Pressure over its mean at the first and the last reading.
    drifts : bool
        True if b may drift.
    share : tuple of float
        Range of the share of a.
    disturbance : DisturbancePosterior or None
        Disturbance in addition to the law, if any.
    """

    products: Products
    start: np.ndarray
    origin: np.ndarray
    gas: np.ndarray
    ends: tuple[float, float]
    drifts: bool
    share: tuple[float, float] = (0.0, 1.0)
    disturbance: DisturbancePosterior | None = None

    @classmethod
    def of(cls, record: DecayRecord, values: Physical) -> ReducedDecay:
        """Reduce a record, about the law with constant a and b."""
        span, mean = record.span, record.mean_current
        rate = max(float(values.rate_mean) * span, 1e-9)
        share = float(np.clip(values.share, -0.2, 1.2))  # a little beyond 0 to 1
        start = np.array([[np.log(values.i0 / mean), np.log(rate), share, 0.0, 0.0, 0.0]]).T
        gas, ends = NODE, tuple(Pieces.of(record).pressure.tolist())
        time, current, error = record.time, record.current, record.error
        if record.gauge is not None:
            s = record.time / span
            smooth = np.linalg.lstsq(chebvander(2 * s - 1, 9), record.gauge / span, rcond=None)[0]
            gas = chebvander(CHEBYSHEV, 9) @ smooth
            bumps = record.gauge / span - chebvander(2 * s - 1, 9) @ smooth
            current = current * np.exp((1 - share) * rate * bumps)  # as if pressure were smooth
        origin = LawParameters.of(start).currents(gas)
        at_readings = from_nodes(time / span)
        rows = np.column_stack([current / mean - at_readings @ origin[:, 0], at_readings])
        rows = rows if error is None else rows * (mean / error)[:, None]
        # Average rows, not readings: the mean of readings across a gap lies on no curve.
        if (size := -(-len(record) // MAX_ROWS)) > 1:
            first = np.arange(0, len(record) // size * size, size)
            whole = slice(first[-1] + size)
            time, rows = (np.add.reduceat(v[whole], first) / size for v in (time, rows))
            rows = rows if error is None else rows * size**0.5
        products = Products.of(rows, time, error is not None)
        reduced = cls(products, start, origin, gas, ends, record.gauge is None)
        return reduced.without_improbable_noises()

    @property
    def curve_size(self) -> int:
        """Parameters of a smooth curve: at most half as many as readings."""
        return min(NODES, self.products.count // 2)

    @cached_property
    def best_curve(self) -> tuple[np.ndarray, np.ndarray]:
        """Residual sum of squares of the best smooth curve, and its log likelihood, by noise."""
        curve = block_diag(1.0, smooth_curves(self.curve_size))
        squares = np.maximum(self.products.combined(curve).left(), 1e-30)
        return squares, self.products.log_prior + self.products.log_size(squares)

    @property
    def noise_level(self) -> float:
        """Standard deviation of the readings about the best smooth curve, in the columns' unit."""
        squares, log = self.best_curve
        return float(np.sqrt(self.products.variance(squares[np.argmax(log)], self.curve_size)))

    def without_improbable_noises(self) -> ReducedDecay:
        """Leave out noises in which even the best smooth curve is less probable than the law."""
        _, best = self.best_curve
        return self.of_noises(best > self.products.log_likelihood().max() - 2 * NEGLIGIBLE_LOG)

    def of_noises(self, kept: np.ndarray) -> ReducedDecay:
        """Keep some of the noises."""
        own = self.disturbance
        own = own and own._replace(mean=own.mean[kept], factor=own.factor[kept])
        return replace(self, products=self.products.some(kept), disturbance=own)

    def with_disturbance(self, kind: Disturbance) -> ReducedDecay:
        """Add a disturbance, integrated out, to the most probable noises."""
        squares, log_likelihood = self.best_curve
        near = log_likelihood > log_likelihood.max() - LOG_LIKELIHOOD_RANGE
        old = self.of_noises(near).products
        noise = np.sqrt(self.products.variance(squares[near], self.curve_size))
        count, _, numbers = kind.shapes.shape
        shapes, reading_shapes = (
            (each[:, None] / noise[:, None, None]).reshape(-1, NODES, numbers)
            for each in (kind.shapes, kind.reading_shapes(np.exp(self.start[1, 0])))
        )
        columns = self.origin * reading_shapes
        matrix = np.tile(old.matrix, (count, 1, 1))
        rounding = (NODES + 1) * ROUNDING * np.einsum("kpp->kp", matrix)
        ridge = rounding[..., None] * np.eye(NODES + 1)
        root = _transposed(np.linalg.cholesky(matrix + ridge))
        slopes = root[:, :, 1:] @ columns
        # Gram matrix with the disturbance integrated out. Square roots of the matrices lose no
        # digits where the noise is low.
        lower = np.linalg.cholesky(np.eye(NODES + 1) + slopes @ _transposed(slopes))
        new_root = np.linalg.solve(lower, root)
        inverse = np.linalg.inv(np.linalg.cholesky(np.eye(numbers) + _transposed(slopes) @ slopes))
        volume = np.sum(np.log(np.einsum("kpp->kp", lower)), axis=1)
        log = np.repeat(np.log(kind.chance / SMOOTH_PRIOR), len(old.kinds)) - volume
        products = old._replace(
            kinds=old.kinds * count,
            log_prior=np.tile(old.log_prior, count) + log,
            matrix=_transposed(new_root) @ new_root,
        )
        mean = -shapes @ _transposed(np.linalg.solve(lower, slopes)) @ new_root
        posterior = DisturbancePosterior(mean, shapes @ _transposed(inverse), kind)
        return replace(self, products=products, disturbance=posterior)

    def coefficients(self, currents: np.ndarray) -> np.ndarray:
        """Combine the columns to the residuals (model less reading) of currents at the nodes.

        Currents of shape (18, d) make coefficients of shape (19, d).
        """
        return np.vstack([-np.ones(currents.shape[1]), currents - self.origin])

    def squares(self, coefficients: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Gram matrix times coefficients, (19, d), and residual sums of squares, (d,).

        `noise` is the index of the noise of each column, in increasing order.
        """
        gradient = np.empty_like(coefficients)
        for matrix, part in zip(self.products.matrix, self._noise_slices(noise), strict=True):
            gradient[:, part] = matrix @ coefficients[:, part]
        return gradient, np.maximum(np.sum(coefficients * gradient, axis=0), 1e-30)

    def _noise_slices(self, noise: np.ndarray) -> list[slice]:
        """Slice of the draws of each noise, so that each takes one matrix product."""
        ends = np.searchsorted(noise, np.arange(len(self.products.matrix) + 1))
        return [slice(*part) for part in pairwise(ends)]

    def draw_disturbance(
        self, currents: np.ndarray, noise: np.ndarray, squares: np.ndarray, seed: int
    ) -> np.ndarray:
        """Draw the disturbance at the nodes, (18, d), given currents and their residual sums of
        squares, by quasi-random points.
        """
        drawn, (means, factors, _) = np.empty_like(currents), self.disturbance
        normal = ndtri(_quasirandom(noise.size, factors.shape[2], seed))
        coefficients = self.coefficients(currents)
        level = np.sqrt(self.products.variance(squares, 0))
        for mean, factor, part in zip(means, factors, self._noise_slices(noise), strict=True):
            drawn[:, part] = mean @ coefficients[:, part] + factor @ (normal[:, part] * level[part])
        return drawn


class Peaks(NamedTuple):
    """Normal approximations of the posterior, for each noise (k) at each grid point (m).

    Attributes
    ----------
    centre : array, shape (p, k, m)
        Means of the p free coordinates.
    lower : array, shape (p, p, k, m)
        Cholesky factors of the inverse covariances.
    log : array, shape (k, m)
        Logarithms of the integrals.
    numbers : array, shape (6, m)
        Coordinates about which the posterior was expanded.
    """

    centre: np.ndarray
    lower: np.ndarray
    log: np.ndarray
    numbers: np.ndarray


def _slopes(
    reduced: ReducedDecay, numbers: np.ndarray, free: list[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Slopes by the free coordinates and, last, values at coordinates (6, m): of the residual
    coefficients, (19, p + 1, m), and of the share of a, (p + 1, m).
    """
    steps = DIFFERENCE_STEP * np.append(np.eye(6)[:, free], np.zeros((6, 1)), axis=1)
    parameters = LawParameters.of((numbers[:, None] + steps[..., None]).reshape(6, -1))
    rows = np.empty((NODES + 1, len(free) + 1, numbers.shape[1]))
    rows[0], share = -1.0, parameters.share.reshape(rows.shape[1:])
    rows[1:] = (parameters.currents(reduced.gas) - reduced.origin).reshape(NODES, *rows.shape[1:])
    for values in (rows, share[None]):
        values[:, :-1] = (values[:, :-1] - values[:, -1:]) / DIFFERENCE_STEP
    return rows, share


def _cholesky(matrix: np.ndarray) -> np.ndarray:
    """Lower Cholesky factors of many small matrices, matrix indices first: (p, p, ...).

    A pivot is at least rounding error, so that a direction without information stays finite.
    """
    lower, left = np.zeros_like(matrix), matrix.copy()
    for j in range(len(matrix)):
        lower[j, j] = np.sqrt(np.maximum(left[j, j], ROUNDING * matrix[j, j] + 1e-300))
        below = lower[j + 1 :, j]
        below[:] = left[j + 1 :, j] / lower[j, j]
        left[j + 1 :, j + 1 :] -= below[:, None] * below
    return lower


def _solve_lower(lower: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solve L x = right for many L, (p, ...)."""
    found = np.broadcast_to(right, lower.shape[1:]).copy()
    for j in range(len(lower)):
        found[j] /= lower[j, j]
        found[j + 1 :] -= lower[j + 1 :, j] * found[j]
    return found


def _solve_upper(lower: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solve Lᵀ x = right for many L, (p, ...)."""
    found = np.broadcast_to(right, lower.shape[1:]).copy()
    for j in reversed(range(len(lower))):
        found[j] /= lower[j, j]
        found[:j] -= lower[j, :j] * found[j]
    return found


def _standard_deviation(lower: np.ndarray, slopes: np.ndarray) -> np.ndarray:
    """Standard deviation of a quantity with these slopes, (p, k or 1, m)."""
    return np.sqrt(np.sum(_solve_lower(lower, slopes) ** 2, axis=0))


def _log_normal_mass(bounds: tuple[float, float], middle: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """Logarithm of the probability between two bounds under normal distributions."""
    low, high = ((bound - middle) / np.maximum(sd, 1e-300) for bound in bounds)
    above = low > 0  # both ends on one side: the tail that is not near 1
    low, high = np.where(above, -high, low), np.where(above, -low, high)
    upper, lower = log_ndtr(high), log_ndtr(low)
    return upper + np.log1p(-np.exp(np.minimum(lower - upper, -1e-12)))


def _expand(reduced: ReducedDecay, numbers: np.ndarray, free: list[int]) -> Peaks:
    """Approximate the posterior about coordinates (6, m) by normal distributions, by noise."""
    rows, share = _slopes(reduced, numbers, free)
    products = reduced.products.between(rows)
    normal, gradient, squares = products[:-1, :-1], -products[:-1, -1], products[-1, -1]
    change_sd = np.where(numbers[PACE, 0] > 0, OUTGASSING_SD, DRIFT)
    prior_sd = np.where(np.equal(free, CHANGE), change_sd, np.inf)[:, None]
    prior_precision = np.diag(1 / prior_sd[:, 0] ** 2)[..., None, None]
    prior_gradient = (-numbers[free] / prior_sd**2)[:, None]
    squares_left = np.maximum(squares, 1e-30)
    for _ in range(2):
        variance = reduced.products.variance(squares_left, len(free))
        lower = _cholesky(normal / variance + prior_precision)
        step = _solve_upper(lower, _solve_lower(lower, gradient / variance + prior_gradient))
        squares_left = squares - 2 * np.sum(step * gradient, axis=0)
        squares_left = np.maximum(
            squares_left + np.einsum("pkm,pqkm,qkm->km", step, normal, step), 1e-30
        )
    centre = numbers[free][:, None] + step
    log = reduced.products.log_prior[:, None] + reduced.products.log_size(squares_left)
    log = log - np.sum(np.log(np.einsum("ppkm->pkm", lower)), axis=0)
    log = log - 0.5 * np.sum((centre / prior_sd[:, None]) ** 2, axis=0)
    by_share = share[:-1, None]
    new_share = share[-1] + np.sum(by_share * step, axis=0)
    log = log + _log_normal_mass(reduced.share, new_share, _standard_deviation(lower, by_share))
    log = log + np.log(np.abs(by_share[2]))  # the share is flat, not the bend
    log = log + log_exponent_prior(numbers[POWER])[0] - np.log(np.maximum(numbers[PACE], 1.0))
    if np.any(numbers[PACE]):  # gas that is pumped away decreases
        by_change = np.broadcast_to(np.eye(len(free))[-1][:, None, None], by_share.shape)
        log = log + _log_normal_mass(
            (-np.inf, 0.0), centre[-1], _standard_deviation(lower, by_change)
        )
    return Peaks(centre, lower, log, numbers)


def _search(reduced: ReducedDecay, numbers: np.ndarray, free: list[int]) -> Peaks:
    """Find the most probable free coordinates at each grid point by Gauss-Newton iterations, and
    return the normal approximations about the start of the last one.
    """
    for _ in range(MAX_ITERATIONS):
        found = _expand(reduced, numbers, free)
        log_total = np.logaddexp.reduce(found.log)
        weight, before = np.exp(found.log - log_total), numbers[free]
        numbers = numbers.copy()
        numbers[free] += np.clip(np.sum(weight * found.centre, axis=1) - before, -0.5, 0.5)
        pumped = numbers[PACE] > 0
        ends = np.where(pumped, -OUTGASSING_RATES[1], -5 * DRIFT), np.where(pumped, 0.0, 5 * DRIFT)
        numbers[CHANGE] = np.clip(numbers[CHANGE], *ends)
        parameters = LawParameters.of(numbers)
        numbers[BEND] += (
            np.clip(parameters.share, -1.0, 2.0) - parameters.share
        ) / parameters.share_by_bend
        sd = 1 / np.sqrt(np.sum(weight * np.sum(found.lower**2, axis=1), axis=1))
        step = np.max(np.abs(numbers[free] - before) / (sd + 1e-9), axis=0)
        probability = np.exp(log_total - log_total.max())
        if probability @ step < STEP_TOLERANCE * probability.sum():
            break
    return found


def _scan(reduced: ReducedDecay, row: int, low: float, high: float, free: list[int]) -> Peaks:
    """Scan one coordinate over a grid that is refined until it spans the posterior.

    All noises are kept until the last grid: between points of a coarse grid smooth residuals
    remain, which look like correlated noise.
    """
    place, numbers = np.linspace(low, high, GRID_POINTS), np.tile(reduced.start, (1, GRID_POINTS))
    for _ in range(MAX_REFINEMENTS):
        numbers[row] = place
        found = _search(reduced, numbers, free)
        log_total = np.logaddexp.reduce(found.log)
        if not np.isfinite(log_total).all():
            break  # the beam died: no law of this kind has finite slopes
        probable = np.flatnonzero(log_total > log_total.max() - NEGLIGIBLE_LOG)
        ends = [max(probable[0] - 1, 0), min(probable[-1] + 1, GRID_POINTS - 1)]
        if ends[1] - ends[0] > 0.6 * GRID_POINTS:
            break
        before, place = place, np.linspace(*place[ends], GRID_POINTS)
        numbers = np.array([np.interp(place, before, one) for one in found.numbers])
    return found


class Draws(NamedTuple):
    """Weighted draws of a law.

    Attributes
    ----------
    numbers : LawParameters
        Of each of d draws.
    walk : array, shape (18, d)
        Wandering part of the loss rate at the nodes, as a share.
    currents : array, shape (18, d)
        Currents over their mean.
    shown : array, shape (18, d)
        Readings of the monitor over the mean current.
    weight : array, shape (d,)
        Importance weights.
    log : float
        Log evidence.
    effective_size : float
        Effective sample size.
    """

    numbers: LawParameters
    walk: np.ndarray
    currents: np.ndarray
    shown: np.ndarray
    weight: np.ndarray
    log: float
    effective_size: float


@lru_cache(maxsize=16)
def _quasirandom(count: int, dimensions: int, seed: int) -> np.ndarray:
    """Points that fill a cube evenly, (dimensions, count): means over them err less than over
    random points.

    Steps are powers of the root of x^(p + 1) = x + 1, from a random start (M. Roberts, The
    unreasonable effectiveness of quasirandom sequences, 2018).
    """
    root = np.roots([1.0, *[0.0] * (dimensions - 1), -1.0, -1.0]).real.max()
    steps = root ** -np.arange(1.0, dimensions + 1)
    start = np.random.default_rng(seed).random((dimensions, 1))
    return (start + steps[:, None] * np.arange(count)) % 1


def _truncated_logistic(
    points: np.ndarray, low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Turn uniform points into draws of the logistic distribution between bounds, with their log
    density.
    """
    above = low > 0  # both ends on one side: the tail that is not near 1
    log_low, log_high = log_expit(np.where(above, [-high, -low], [low, high]) / PROPOSAL_SCALE)
    log_below = np.logaddexp(log_low + np.log1p(-points), log_high + np.log(points))
    log_above = np.log1p(-np.exp(log_below))
    log_mass = log_high + np.log(-np.expm1(log_low - log_high))
    draws = np.where(above, -PROPOSAL_SCALE, PROPOSAL_SCALE) * (log_below - log_above)
    return draws, log_below + log_above - log_mass - math.log(PROPOSAL_SCALE)


def _split_free(free: Sequence[int]) -> tuple[list[int], list[int]]:
    """Split free coordinates into those approximated as normal, in order of elimination, and those
    on a grid.
    """
    return [r for r in (0, 1, BEND, CHANGE) if r in free], [r for r in (POWER, PACE) if r in free]


class LawProposal(NamedTuple):
    """A law with the proposal distribution of its draws.

    Attributes
    ----------
    reduced : ReducedDecay
        The record, with the noises that are not negligible.
    peaks : Peaks
        Normal approximations.
    free : tuple of int
        Rows of the free coordinates.
    slopes : array, shape (19, 2, m)
        Slopes of the residual coefficients by ln level and ln rate at a fixed share.
    beam_factor : array, shape (2, 2, k, m)
        Cholesky factors of their Gram matrices.
    """

    reduced: ReducedDecay
    peaks: Peaks
    free: tuple[int, ...]
    slopes: np.ndarray
    beam_factor: np.ndarray

    @classmethod
    def of(cls, reduced: ReducedDecay, free: Sequence[int]) -> LawProposal:
        """Approximate the posterior by normal distributions in the free coordinates; exponent and
        pace lie on a grid.
        """
        normal, _ = _split_free(free)
        if PACE in free:
            found = _scan(reduced, PACE, *OUTGASSING_PACES, normal)
        elif POWER in free:
            found = _scan(reduced, POWER, MIN_EXPONENT, MAX_EXPONENT, normal)
        else:
            found = _search(reduced, reduced.start, normal)
        kept = found.log.max(axis=1) > found.log.max() - NEGLIGIBLE_LOG
        if kept.any():  # finite
            found = Peaks(*(part[..., kept, :] for part in found[:3]), found.numbers)
            reduced = reduced.of_noises(kept)
        slopes, share = _slopes(reduced, found.numbers, normal)
        slopes = slopes[:, :2] - slopes[:, [2]] * share[:2] / share[2]
        return cls(reduced, found, tuple(free), slopes, _cholesky(reduced.products.between(slopes)))

    @property
    def disturbance(self) -> Disturbance | None:
        """Disturbance in addition to the law, if any."""
        return self.reduced.disturbance and self.reduced.disturbance.kind

    @property
    def addition(self) -> str | None:
        """Name of the variation in addition to those of a and b, one of `ADDITIONS`."""
        if PACE in self.free:
            return "pumped"
        kind = self.disturbance
        return kind and ("settles" if kind is MONITOR_SETTLES else "wanders")

    def _log_prior(self, numbers: LawParameters) -> np.ndarray:
        free, (low, high) = self.free, self.reduced.share
        inside = (numbers.share >= low) & (numbers.share <= high)
        log = np.where(inside, -math.log(high - low), -np.inf)
        if PACE in self.free:
            return log + log_outgassing_prior(numbers.share, numbers.gas, numbers.pace)
        log = log + log_exponent_prior(numbers.power)[0] if POWER in free else log
        return log + log_drift_prior(numbers.drift) if CHANGE in free else log

    def _propose(self, draws: int, seed: int) -> tuple[np.ndarray, LawParameters, np.ndarray]:
        """Draw from the normal approximations with heavier tails: noise of each draw, in increasing
        order, parameters, log density.
        """
        peaks, (rows, grid_rows) = self.peaks, _split_free(self.free)
        probability = np.exp(peaks.log - peaks.log.max()).ravel()
        ends = np.cumsum(probability) / probability.sum()
        cell = np.minimum(
            np.searchsorted(ends, (np.arange(draws) + 0.5) / draws), probability.size - 1
        )
        noise, at = np.unravel_index(cell, peaks.log.shape)
        points = _quasirandom(draws, len(rows), seed)
        others, log = self._draw_share(noise, at, points[2:])
        numbers, log_beam = self._draw_beam(noise, at, others, points[:2])
        spacing = math.prod(np.diff(peaks.numbers[row])[0] for row in grid_rows)
        return (
            noise,
            numbers,
            log + log_beam + np.log(probability[cell] / probability.sum() / spacing),
        )

    def _draw_share(
        self, noise: np.ndarray, at: np.ndarray, points: np.ndarray
    ) -> tuple[LawParameters, np.ndarray]:
        """Draw the change of the gas loss and the share of a, the latter between its bounds."""
        peaks, free = self.peaks, self.free
        lower, centre = peaks.lower[..., noise, at], peaks.centre[:, noise, at]
        rows, numbers, deviations = (
            _split_free(free)[0],
            peaks.numbers[:, at],
            np.zeros_like(centre),
        )
        log, unbounded = np.zeros(noise.size), np.full(noise.size, np.inf)
        if CHANGE in free:
            upper = -centre[-1] * lower[-1, -1] if PACE in free else unbounded  # gas decreases
            deviations[-1], log = _truncated_logistic(points[-1], -unbounded, upper)
            log = log + np.log(lower[-1, -1])
        numbers[rows] = centre + _solve_upper(lower, deviations)
        best = LawParameters.of(numbers)
        bounds = [lower[2, 2] * (s - best.share) / best.share_by_bend for s in self.reduced.share]
        deviations[2], log_share = _truncated_logistic(
            points[0], np.minimum(*bounds), np.maximum(*bounds)
        )
        share = best.share + best.share_by_bend * deviations[2] / lower[2, 2]
        numbers[rows] = centre + _solve_upper(lower, deviations)
        gas = best.gas if PACE in free else (1 - share) * numbers[CHANGE]
        parameters = LawParameters.of(numbers)._replace(share=share, gas=gas)
        return parameters, log + log_share + np.log(lower[2, 2] / np.abs(best.share_by_bend))

    def _draw_beam(
        self, noise: np.ndarray, at: np.ndarray, others: LawParameters, points: np.ndarray
    ) -> tuple[LawParameters, np.ndarray]:
        """Draw level and rate about their best values given the other parameters."""
        reduced, lower = self.reduced, self.beam_factor[..., noise, at]
        gradient, squares = reduced.squares(
            reduced.coefficients(others.currents(reduced.gas)), noise
        )
        scaled_step = _solve_lower(lower, -np.einsum("prd,pd->rd", self.slopes[..., at], gradient))
        squares_left = np.maximum(squares - np.sum(scaled_step**2, axis=0), 1e-30)
        noise_level, unbounded = (
            np.sqrt(reduced.products.variance(squares_left, 2)),
            np.full(noise.size, np.inf),
        )
        deviations, log = _truncated_logistic(points, -unbounded, unbounded)
        step = _solve_upper(lower, scaled_step + noise_level * deviations)
        level, rate = np.exp(np.clip(np.log([others.level, others.rate]) + step, -30.0, 8.0))
        log = np.sum(log, axis=0) + np.log(lower[0, 0] * lower[1, 1] / noise_level**2)
        return others._replace(level=level, rate=rate), log

    def weighted_draws(self, draws: int, seed: int = 0) -> Draws:
        """Draw from the normal approximations and weight each draw by the posterior."""
        reduced, peaks = self[:2]
        if not np.isfinite(peaks.log).all():
            numbers, none = LawParameters.of(peaks.numbers), np.zeros(peaks.log.shape[1])
            currents = numbers.currents(reduced.gas)
            walk = np.zeros_like(currents)
            return Draws(numbers, walk, currents, currents, none, -np.inf, 0.0)
        noise, numbers, log_proposal = self._propose(draws, seed)
        currents = numbers.currents(reduced.gas)
        _, squares = reduced.squares(reduced.coefficients(currents), noise)
        log = reduced.products.log_prior[noise] + reduced.products.log_size(squares)
        log = log + np.log(numbers.level * numbers.rate) + self._log_prior(numbers) - log_proposal
        log_total = float(logsumexp(log))
        weight = np.exp(log - max(log_total, -1e300))
        effective_size = float(weight.sum() / max(np.sum(weight**2), 1e-300))
        walk, shown = np.zeros_like(currents), currents
        if reduced.disturbance is not None:
            disturbance = reduced.draw_disturbance(currents, noise, squares, seed + 1)
            if reduced.disturbance.kind.of_loss:
                walk = disturbance
                shown = currents = currents * np.exp(-numbers.rate * (INTEGRAL @ walk))
            else:
                shown = currents * (1 + disturbance)
        return Draws(
            numbers, walk, currents, shown, weight, log_total - math.log(draws), effective_size
        )


def draw_all(laws: Sequence[LawProposal]) -> list[Draws]:
    """Draw from several laws until all draws together have the effective sample size that the ends
    of an interval need.

    The next round of a law is in proportion to the standard error that it contributes.
    """
    found = [law.weighted_draws(FIRST_DRAWS) for law in laws]
    count = np.full(len(laws), FIRST_DRAWS)
    while True:
        log, size = np.array([(one.log, max(one.effective_size, 1.0)) for one in found]).T
        part = np.exp(log - max(log.max(), -1e300))
        # Contribution of a single draw of each law to the standard error.
        errors = np.sqrt(part / max(part.sum(), 1e-300) * count / size)
        needed = np.minimum(ENOUGH_EFFECTIVE * errors * errors.sum(), MAX_DRAWS)
        short = np.flatnonzero(count < 0.8 * needed)
        if not short.size:
            return found
        for k in short:
            count[k] = needed[k]
            found[k] = laws[k].weighted_draws(count[k])


def mixture(laws: Sequence[Draws]) -> Draws:
    """Combine the draws of several laws by their evidence; laws without evidence are left out."""
    laws = [law for law in laws if np.isfinite(law.log)] or laws[:1]
    log_total = float(logsumexp([law.log for law in laws]))
    if not np.isfinite(log_total):
        return laws[0]
    weight = np.concatenate([law.weight * math.exp(law.log - log_total) for law in laws])
    numbers = LawParameters(*map(np.concatenate, zip(*(law.numbers for law in laws), strict=True)))
    walk, currents, shown = (np.hstack([law[row] for law in laws]) for row in (1, 2, 3))
    return Draws(numbers, walk, currents, shown, weight, log_total, float(1 / np.sum(weight**2)))


def quantiles(values: np.ndarray, weight: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Quantiles of weighted values.

    Examples
    --------
    >>> quantiles(np.array([3.0, 1.0, 2.0]), np.full(3, 1 / 3), np.array([0.5])).tolist()
    [2.0]
    """
    order = np.argsort(values)
    below = np.cumsum(weight[order]) - weight[order] / 2
    return np.interp(at, below, values[order])


def weighted_quantity(
    values: np.ndarray, weight: np.ndarray, unit: str, ends: tuple[float, float] = WIDE
) -> Quantity:
    """Median, half of the central 68 %, and interval between two probabilities, of draws."""
    found = quantiles(values, weight, np.array([0.5, *CENTRAL, *ends]))
    middle, lower, upper, *interval = map(float, found)
    return Quantity(middle, (upper - lower) / 2, unit, None, tuple(interval))


def interval_probabilities(none: bool, all_: bool) -> tuple[float, float]:
    """Probabilities at the ends of the 95 % interval of a share.

    Where a share of 0 (`none`) or 1 (`all_`) is not excluded the interval ends at that bound, and
    is one-sided.
    """
    low, high = WIDE
    return low * (1 + all_), high - low * none


def partial_loss(
    values: np.ndarray, weight: np.ndarray, unit: str, none: bool, all_: bool, full: np.ndarray
) -> Quantity:
    """Quantity of a loss that is a share of a whole one.

    Where a share of 0 (`none`) is not excluded its interval begins at 0, where one of 1 (`all_`) is
    not, it ends at the upper limit of the whole.
    """
    found = weighted_quantity(values, weight, unit, interval_probabilities(none, all_))
    low, high = found.interval_95
    high = quantiles(full, weight, np.array([WIDE[1]]))[0] if all_ else high
    return replace(found, interval_95=(0.0 if none else low, float(high)))


@dataclass(frozen=True)
class FreeLaw:
    """Posterior of a record whose law and noise are uncertain.

    Parameters
    ----------
    quantities : mapping of str to Quantity
        I0, a, b and the lifetimes at the start, the end and the mean current.
    share : Quantity
        Share of a in the loss at the mean current.
    exponent : Quantity
        Exponent g of a(I) ∝ I^g, with its prior.
    drift : Quantity or None
        Relative change of b over the record, with its prior; None where a gauge gives the pressure.
    constant : float
        Probability of constant a and b, at even odds with the free law.
    odd : float
        Probability of an exponent that no bunch lengthening explains.
    pumped : float
        Probability of gas that is pumped away after a fill, in place of exponent and drift.
    wanders : float
        Probability that the loss rate or the monitor wanders in addition.
    settles : float
        Probability of a monitor that settles after a fill.
    nodes : array, shape (18,), or None
        Mean readings of the monitor at the nodes, mA; None for a table of lifetimes.
    span : float
        Length of the record, s.
    """

    quantities: Mapping[str, Quantity]
    share: Quantity
    exponent: Quantity
    drift: Quantity | None
    constant: float
    odd: float
    pumped: float = 0.0
    wanders: float = 0.0
    settles: float = 0.0
    nodes: np.ndarray | None = None
    span: float = 0.0

    @property
    def is_preferred(self) -> bool:
        """True if varying a and b are more probable than constant ones: their values are quoted
        then.
        """
        return self.constant <= MORE_PROBABLE

    @property
    def determines_share(self) -> bool:
        """True if the record excludes that the loss is all or none due to a, and the exponent is
        one of bunch lengthening.
        """
        return not self.is_odd and any(self.quantities[name].interval_95[0] > 0 for name in "ab")

    @property
    def is_odd(self) -> bool:
        """True if the exponent is more probably none of bunch lengthening."""
        return self.odd > MORE_PROBABLE

    @property
    def addition(self) -> str | None:
        """Name of the probable variation in addition to the quoted a and b, one of `ADDITIONS`."""
        probable = (name for name in ADDITIONS if getattr(self, name) > MORE_PROBABLE)
        return next(probable, None) if self.is_preferred else None

    def curve(self, time: np.ndarray) -> np.ndarray:
        """Mean readings of the monitor at times in s, mA."""
        return from_nodes(time / self.span) @ self.nodes

    def to_json(self) -> dict[str, object]:
        """Return the exponent, the drift and the probabilities of the laws."""
        document = {"exponent": self.exponent, "drift": self.drift}
        document |= {"probability_of_constant_a_and_b": self.constant}
        document |= {"probability_of_outgassing": self.pumped}
        document |= {"probability_of_wandering": self.wanders}
        return document | {"probability_of_settling": self.settles}


def at_bounds(share: np.ndarray, weight: np.ndarray) -> tuple[bool, bool]:
    """Tell if shares of 0 and of 1 are not excluded at 95 %.

    They are not where the density of the draws at the bound exceeds that of a normal distribution
    at 1.96 standard deviations.
    """
    strip = BOUND_STRIP * math.sqrt(weight @ (share - weight @ share) ** 2)
    threshold = BOUND_STRIP * math.exp(-(1.96**2) / 2) / math.sqrt(2 * math.pi)
    return bool(weight @ (share < strip) > threshold), bool(
        weight @ (share > 1 - strip) > threshold
    )


def free_law(record: DecayRecord, values: Physical) -> FreeLaw | None:
    """Average a decay over exponents of a, drifts of b, disturbances and noises.

    Parameters
    ----------
    record : DecayRecord
        One decay.
    values : Physical
        Values of the law with constant a and b.

    Returns
    -------
    FreeLaw or None
        None where no such law fits the record: the effective sample size is too small, or a law
        with a negative a or b is more probable.

    Notes
    -----
    For each exponent on a grid and each noise of `beamfit.noise.memory` the other parameters have a
    normal approximation, whose draws are weighted by the posterior (importance sampling). The noise
    level is integrated over.

    Examples
    --------
    >>> from beamfit.lifetime.expansion import Pieces, fit_law
    >>> t = np.linspace(0, 36000, 100)
    >>> noise = 1e-2 * np.random.default_rng(1).normal(size=100)
    >>> record = DecayRecord(t, 100.0 / (1.0 + 100.0 * 1e-7 * t) + noise)
    >>> found = free_law(record, fit_law(Pieces.of(record)).values)
    >>> low, high = found.quantities["a"].interval_95
    >>> low < 1e-7 <= high
    True
    """
    reduced = ReducedDecay.of(record, values)
    laws_to_draw = proposals(reduced)
    laws = list(zip(laws_to_draw, draw_all(laws_to_draw), strict=True))
    draws = mixture([own for _, own in laws])
    free = mixture([own for law, own in laws if POWER in law.free])
    # A few effective draws suffice: constant a and b instead would have too small errors.
    if not (np.isfinite(free.log) and draws.effective_size >= MIN_EFFECTIVE_DRAWS):
        return None
    constant_law = LawProposal.of(reduced, CONSTANT).weighted_draws(FIRST_DRAWS)
    if not 0 <= values.share <= 1:
        wide = replace(reduced, share=UNPHYSICAL_SHARES)
        unphysical = LawProposal.of(wide, CONSTANT).weighted_draws(FIRST_DRAWS)
        if unphysical.log + np.log(UNPHYSICAL_ODDS) > draws.log:
            return None
    normal, flat = log_exponent_prior(free.numbers.power)
    flat = math.exp(free.log - draws.log) * float(free.weight @ np.exp(flat - normal))
    exponent, drift = weighted_quantity(free.numbers.power, free.weight, "1"), None
    if reduced.drifts:
        drift = weighted_quantity(free.numbers.drift, free.weight, "1")
    constant = float(expit(constant_law.log - draws.log))
    chances = [(law.addition, math.exp(own.log - draws.log)) for law, own in laws]
    pumped, wanders, settles = (
        sum((chance for addition, chance in chances if addition == name), 0.0) for name in ADDITIONS
    )
    nodes = record.mean_current * draws.shown @ draws.weight
    share = weighted_quantity(draws.numbers.share, draws.weight, "1")
    found = _quantities(record, reduced, draws)
    return FreeLaw(found, share, exponent, drift, constant, flat, pumped, wanders, settles, nodes,
                   record.span)  # fmt: skip


def proposals(reduced: ReducedDecay) -> list[LawProposal]:
    """Build the laws: the free law, gas that is pumped away, the free law with each disturbance,
    and constant a and b with a monitor that settles.

    Where a gauge gives the pressure only the monitor is disturbed.
    """
    free = [*CONSTANT, POWER, CHANGE] if reduced.drifts else [*CONSTANT, POWER]
    laws = [LawProposal.of(reduced, free)]
    laws += [LawProposal.of(reduced, [*CONSTANT, CHANGE, PACE])] if reduced.drifts else []
    if reduced.products.count < MIN_DISTURBED_READINGS or reduced.noise_level < MIN_NOISE:
        return laws
    kinds = disturbances(float(np.exp(reduced.start[1, 0])))
    kinds = [kind for kind in kinds if reduced.drifts or not kind.of_loss]
    disturbed = [reduced.with_disturbance(kind) for kind in kinds]
    laws += [LawProposal.of(one, free) for one in disturbed]
    return [*laws, LawProposal.of(disturbed[-1], CONSTANT)]  # a monitor that settles


def loss_rates(a, b, power, changed, x, ends):
    """Loss rates at the first reading, at the last one and at the mean current, in the unit of b.

    `a` is in the same unit, at the mean current. `x` are the currents of the law at the first
    reading, at the mean current and at the last reading (`law_currents`), and `changed` the changes
    of the gas loss there. `ends` are the pressures over their mean at the first and last reading.
    """
    first, middle, last = (
        a * at ** (1 + power) + b * pressure + change
        for at, pressure, change in zip(x, (ends[0], 1.0, ends[1]), changed, strict=True)
    )
    return first, last, middle


def law_currents(x, lost):
    """Currents of the law at the first reading, at the mean current and at the last reading.

    `x` are the currents at the nodes. `lost` is the logarithmic loss to a walk of the loss rate up
    to each of the three times: the loss to a depends on the current that the law alone would leave.
    """
    return x[0], np.e ** lost[1], x[-1] * np.e ** lost[2]


def mean_current_time(currents: np.ndarray, weight: np.ndarray) -> float:
    """Time over the span at which the mean of the draws at the nodes is the mean current."""
    time, nodes = np.linspace(0.0, 1.0, 1001), currents @ weight
    return float(np.interp(-1.0, -(from_nodes(time) @ nodes), time))


def _quantities(record: DecayRecord, reduced: ReducedDecay, draws: Draws) -> dict[str, Quantity]:
    """Compute the quoted quantities from draws."""
    parameters, currents, weight = draws.numbers, draws.currents, draws.weight
    span, mean = record.span, record.mean_current
    full = parameters.rate / mean / span, parameters.rate / span
    a, b = parameters.share * full[0], (1 - parameters.share) * full[1]
    moments = (0.0, mean_current_time(currents, weight), 1.0)
    to_moments = from_nodes(np.array(moments))
    changed = [
        full[1] * (parameters.gas * gas_change(s, parameters.pace) + walk)
        for s, walk in zip(moments, to_moments @ draws.walk, strict=True)
    ]
    law = law_currents(currents, parameters.rate * (to_moments @ INTEGRAL @ draws.walk))
    rates = loss_rates(a * mean, b, parameters.power, changed, law, reduced.ends)
    quoted = {"i0": parameters.level * mean}
    quoted |= {f"lifetime_{at}": 1 / rate / HOUR for at, rate in zip(ENDS, rates, strict=True)}
    bounds = at_bounds(parameters.share, weight)
    losses = {"a": (a, *bounds, full[0]), "b": (b, *bounds[::-1], full[1])}
    quantities = {n: weighted_quantity(v, weight, UNITS[n]) for n, v in quoted.items()}
    quantities |= {n: partial_loss(v, weight, UNITS[n], *more) for n, (v, *more) in losses.items()}
    return {name: quantities[name] for name in UNITS}
