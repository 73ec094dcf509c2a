"""The law of a decay that is not certain: departures from constant a and b with their priors, the
currents they make, and their posterior, averaged over the noise.

With x the current over its mean and s the time over the span, the loss rate is
share R x^(1 + g) + (1 - share) R (1 + h f(s)) with the share of a from 0 to 1. The gas changes by h
of itself: in a straight line, f = s - 1/2, or as what is pumped away after a fill, f = 1/k -
exp(-k s)/(1 - exp(-k)), where a is then constant. The exponent g, the change h and the pace k have
priors, the first current, the loss rate and the share of a are flat. Beside g and h the whole loss
or the monitor may wander; beside these or constant a and b the monitor may settle after a fill. The
law has a closed form with one integral, taken to rounding on Chebyshev nodes, which readings see
through one matrix: whitened products of its columns are all that they say.
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

# Standard deviations of the exponent below and above zero. Bunches lengthen with the current, in
# the potential well by x³ - x ∝ I (`beamfit.lifetime.ring`), so that a goes as I^0 to I^-1/3; that
# they shorten, or the vacuum follows the current, is seldom. A twentieth of the prior is flat.
BELOW, ABOVE, ODD = 0.3, 0.2, 0.05
LEAST, MOST = -0.9, 2.0
# Standard deviation of the change of b in one record: pressures of stored beams are read to 10 %.
DRIFT = 0.1
# Prior probabilities of these and of gas that is pumped away after a fill. The time that takes is
# flat in its logarithm from a thousandth of the span to all of it, its loss at first from a
# thousandth of the mean loss to ten times that.
SMOOTH, OUTGASSING, TIMES, SIZES = 0.6, 0.08, (1e-3, 1.0), (1e-3, 10.0)
# Prior probability that the loss rate wanders, as a pressure does, by a random walk: by which
# shares of the loss it has gone at the end, each as likely. That the monitor does is as likely.
WANDERS, WALKS = 0.14, (0.003, 0.015, 0.07, 0.3)
# How far a monitor is off, as a share of the current: between two calibrations of that of MIT-Bates
# its zero moved by 0.1 to 0.2 % (T. Botto, BlastTalk 2712).
MONITOR = 1e-3
# A monitor that settles after a fill is as likely as gas that is pumped away: spans over the time
# that takes, each as likely, and the standard deviation of its logarithm that each stands for.
DOUBLING = 4  # in so many steps: between them shapes are straight in it to the noise of a monitor
SETTLING = 2.0 ** np.arange(1, 6 + 1 / DOUBLING, 1 / DOUBLING)
BETWEEN = math.log(2.0) / DOUBLING / math.sqrt(12.0)
# Spans over the time of gas that is pumped away: shorter times are seen by themselves.
PACES = (1.0, 20.0)
# Where the record's bend does not depend on the share its coordinate has this slope.
FLAT = 1e-3
# Nodes of the integral: exact to rounding up to four lifetimes in a record.
NODES = 18

ANGLE = -np.cos(np.pi * np.arange(NODES) / (NODES - 1))
NODE = (1 + ANGLE) / 2
FROM_NODES = np.linalg.inv(chebvander(ANGLE, NODES - 1))
INTEGRAL = chebvander(ANGLE, NODES) @ chebint(FROM_NODES, lbnd=-1) / 2


# A random walk about its mean at the nodes: a half of its covariance, min(s, t) less the means over
# s, over t and over both.
_PART = NODE - NODE**2 / 2
_COVARIANCE = np.minimum.outer(NODE, NODE) - np.add.outer(_PART, _PART) + 1 / 3
HALF_WALK = np.linalg.cholesky(_COVARIANCE + 1e-12 * np.eye(NODES))


def from_nodes(s: np.ndarray) -> np.ndarray:
    """Matrix that takes values at the nodes to those at times over the span, shape (n, 18).

    Examples
    --------
    >>> (from_nodes(np.array([0.25])) @ NODE**2).round(9).tolist()
    [0.0625]
    """
    return chebvander(2 * s - 1, NODES - 1) @ FROM_NODES


def smooth_curves(count: int) -> np.ndarray:
    """Smooth curves of so many numbers at most at the nodes, (18, m).

    Examples
    --------
    >>> smooth_curves(2).round(1)[[0, -1]].tolist()
    [[1.0, -1.0], [1.0, 1.0]]
    """
    return chebvander(ANGLE, NODES - 1)[:, :count]


def _turned(matrices: np.ndarray) -> np.ndarray:
    return np.swapaxes(matrices, 1, 2)


@dataclass(frozen=True, eq=False)
class Disturbance:
    """A loss rate or a monitor that goes by itself beside the law.

    Parameters
    ----------
    shapes : array, shape (w, 18, r)
        At the nodes, as shares of the loss rate or of the current, by r normal numbers.
    chance : array, shape (w,)
        Prior probability of each.
    of_loss : bool
        Whether it is the loss rate that goes.
    """

    shapes: np.ndarray
    chance: np.ndarray
    of_loss: bool = False

    def shown(self, rate: float) -> np.ndarray:
        """Give the share of the current by which the monitor shows it."""
        return -rate * (INTEGRAL @ self.shapes) if self.of_loss else self.shapes


def settling() -> np.ndarray:
    """Shapes exp(-k s) of a monitor that settles, for each pace k, and beside each its slope by the
    logarithm of the pace.
    """
    gone = np.multiply.outer(SETTLING, NODE)
    return np.exp(-gone)[..., None] * np.stack([np.ones_like(gone), BETWEEN * gone], axis=-1)


_SHAPES = np.multiply.outer(WALKS, HALF_WALK)
LOSS_WANDERS = Disturbance(_SHAPES, np.full(len(WALKS), WANDERS / len(WALKS)), True)
_EACH = np.full(len(SETTLING), OUTGASSING / len(SETTLING))
MONITOR_SETTLES = Disturbance(MONITOR * settling(), _EACH)


def monitor_wanders(rate: float) -> Disturbance:
    """A monitor that shows what it would of a loss rate that wanders, but for its ends, which
    differ as any two of its readings do: as likely where it is no farther off than monitors are,
    and by Cauchy's distribution beyond.
    """
    shapes = LOSS_WANDERS.shown(rate)
    shapes = shapes - np.einsum("s,wsr->wr", INTEGRAL[-1], shapes)[:, None]
    size = np.sqrt(np.einsum("s,wsr->w", INTEGRAL[-1], shapes**2))[:, None, None]
    ends = math.sqrt(2.0) * size * (NODE - 0.5)[:, None]
    chance = LOSS_WANDERS.chance / (1 + (size.ravel() / MONITOR) ** 2)
    return Disturbance(np.concatenate([shapes, ends], axis=2), chance)


def disturbances(rate: float) -> tuple[Disturbance, ...]:
    """All of them, at a loss in the span."""
    return LOSS_WANDERS, monitor_wanders(rate), MONITOR_SETTLES


class Law(StrEnum):
    """Knowledge of the law of a decay.

    Attributes
    ----------
    free
        The exponent of a and a drift of b are free, with priors.
    constant
        a and b are constant, or their dependence is given.
    """

    free = "free"
    constant = "constant"


# Rows of the search's numbers: ln level, ln rate, bend, exponent, change of b, its pace.
BEND, POWER, CHANGE, PACE = range(2, 6)
CONSTANT = (0, 1, BEND)


def gas_change(s, pace):
    """Change of the gas at a time over the span, of 1 from the first to the last reading and 0 in
    the mean: a straight line at a pace of 0.

    Examples
    --------
    >>> gas_change(0.0, 0.0).item(), (gas_change(1.0, 3.0) - gas_change(0.0, 3.0)).round(9).item()
    (-0.5, 1.0)
    """
    xp = array_module(s, pace)
    k = xp.where(pace > 0, pace, 1.0)
    return xp.where(pace > 0, 1 / k + xp.exp(-k * s) / xp.expm1(-k), s - 0.5)


def gas_changed(pace):
    """Integral of that up to the nodes, one column a pace."""
    xp = array_module(pace)
    s, k = NODE[:, None], xp.where(pace > 0, pace, 1.0)
    return xp.where(pace > 0, (s - xp.expm1(-k * s) / xp.expm1(-k)) / k, (s**2 - s) / 2)


class Numbers(NamedTuple):
    """First current over the mean, loss in the span at the mean current, share of a, exponent,
    change of the gas over that loss and its pace, and by how much the share changes with the bend.
    """

    level: np.ndarray
    rate: np.ndarray
    share: np.ndarray
    power: np.ndarray
    gas: np.ndarray
    pace: np.ndarray
    unit: np.ndarray

    @classmethod
    def of(cls, found: np.ndarray) -> Numbers:
        """From columns of ln level, ln rate, bend, exponent, change, pace.

        A straight change of the gas is one of b, that of gas which is pumped away one of the whole
        loss. The bend, share (1 + g) - (1 - share) h / R, is how the loss rate falls with the
        current, which the record shows: with it the posterior is nearly normal.
        """
        level, rate = np.exp(np.clip(found[:2], -30.0, 8.0))
        power, change, pace = found[POWER:]
        unit = np.where(pace > 0, 1.0, 1 + power + change / rate)
        unit = np.where(np.abs(unit) < FLAT, FLAT, unit)
        share = (found[BEND] + change / rate) / unit
        gas = np.where(pace > 0, change, (1 - share) * change)
        return cls(level, rate, share, power, gas, pace, 1 / unit)

    @property
    def drift(self) -> np.ndarray:
        """Change of b over b."""
        return self.gas / (1 - self.share)

    def currents(self, gas: np.ndarray) -> np.ndarray:
        """Currents at the nodes over the mean, one column a set; `gas` is ∫ P dt over the mean."""
        changed = gas_changed(self.pace if np.any(self.pace) else np.zeros(1))
        quadratic = self.share * self.rate
        lost = (self.rate - quadratic) * gas[:, None] + self.rate * self.gas * changed
        return node_currents(self.level, quadratic, self.power, lost)


def node_currents(level, quadratic, power, lost):
    """Currents at the nodes over the mean, (18, m), as of `closed_form` with W = ∫ exp(-c B) ds,
    where B is what is lost to gas up to each node.
    """
    xp = array_module(level, quadratic, power, lost)
    c, lost = 1 + power, xp.clip(lost, -200, 200)  # a factor that no beam has, and no overflow
    left = 1 + c * quadratic * level**c * (INTEGRAL @ xp.exp(-c * lost))
    # Where a loss that is no beam's would have ended the record the law has no value.
    return level * xp.exp(-lost) * xp.maximum(left, 1e-3) ** (-1 / c)


def log_prior(power):
    """Log density of exponents, and of its flat part alone."""
    xp = array_module(power)
    width = xp.where(power < 0, BELOW, ABOVE)
    usual = xp.exp(-0.5 * (power / width) ** 2) / (np.sqrt(np.pi / 2) * (BELOW + ABOVE))
    odd = ODD / (MOST - LEAST)
    return xp.log((1 - ODD) * usual + odd), np.log(odd)


def log_straight(change):
    """Log density of straight changes of the gas."""
    return -0.5 * (change / DRIFT) ** 2 - math.log(DRIFT * math.sqrt(2 * math.pi))


def log_pumped(share, gas, pace):
    """Log density of gas that is pumped away, and of its pace, with the odds of there being any."""
    xp = array_module(share, gas, pace)
    size = gas / xp.expm1(-pace)  # of its loss at first
    inside = (size > SIZES[0]) & (size < SIZES[1]) & (-gas < pace * (1 - share))  # some is left
    width = math.log(SIZES[1] / SIZES[0]) * math.log(TIMES[1] / TIMES[0])
    density = math.log(OUTGASSING / SMOOTH / width) - xp.log(xp.where(inside, -gas, 1.0) * pace)
    return xp.where(inside, density, -np.inf)


# A disturbance is looked at beside noises that are not less likely than the likeliest by more than
# this; fewer readings tell no noise beside a curve as free as the law.
BESIDE, FEWEST = 3.0, 10
# No monitor reads a current to less of itself: transformers of direct current to 1e-6. What leaves
# less was computed, and nothing disturbs it.
QUIET = 1e-7
# Width of the change of gas that is pumped away in what draws come from.
PUMPED = 0.5
# Exponents, or paces, looked at, in ever narrower ranges, and steps of the search with each: it
# rests where a step is below this part of a standard deviation, which draws do not miss.
PLACES, RANGES, STEPS, RESTS = 33, 5, 6, 0.2
# Readings beyond which neighbours are averaged: the curve is smooth between them.
ENOUGH = 1024
# Draws of each law at first, how many independent ones all together are to be worth, and most of
# them; the scale of the logistic distribution that they have in standard deviations.
FEW, WORTH, MANY, TAIL = 512, 2500.0, 60000, 0.6
# Standard deviations of the share beside a bound in which draws tell the density there.
NEAR = 0.25
# Shares of a of losses that are no beam's, and the prior odds of one.
NO_BEAM, UNPHYSICAL = (-2.0, 3.0), 0.05
# What rounding leaves of a direction that the readings do not determine.
LEAST_LEFT = 1e-15
# Step of the differences that give slopes.
STEP = 1e-5
# What lies farther below the largest log probability adds nothing.
FAR = 9.0

# A law is taken for the record's where it is likelier than not.
LIKELIER = 0.5
# What goes by itself beside a and b: gas that is pumped away, a loss rate or a monitor that
# wanders, a monitor that settles after a fill.
BESIDES = ("pumped", "wanders", "settles")

ENDS = ("start", "end", "mean")
UNITS = {
    "a": "1/(mA s)",
    "b": "1/s",
    "i0": "mA",
    "lifetime_start": "h",
    "lifetime_end": "h",
    "lifetime_mean": "h",
}


class Disturbed(NamedTuple):
    """A disturbance by noise: its mean at the nodes from what the readings leave, (k, 18, 19), and
    a half of its covariance over the noise, (k, 18, r).
    """

    mean: np.ndarray
    half: np.ndarray
    kind: Disturbance


@dataclass(frozen=True)
class SeenDecay:
    """A record as products of the columns that its readings see the nodes through.

    Parameters
    ----------
    products : Products
        Of what is left of the readings at `start`, and of the columns of the nodes.
    start : array, shape (6, 1)
        Numbers of a law near the most probable one.
    origin : array, shape (18, 1)
        Its currents at the nodes.
    gas : array, shape (18,)
        Integral of the pressure over its mean at the nodes, over the span.
    ends : tuple of float
        Pressure over its mean at the first and the last reading.
    drifts : bool
        Whether b may drift.
    share : tuple of float
        Between which the share of a lies.
    disturbed : Disturbed or None
        What the readings say of a disturbance; None where there is none.
    """

    products: Products
    start: np.ndarray
    origin: np.ndarray
    gas: np.ndarray
    ends: tuple[float, float]
    drifts: bool
    share: tuple[float, float] = (0.0, 1.0)
    disturbed: Disturbed | None = None

    @classmethod
    def of(cls, record: DecayRecord, values: Physical) -> SeenDecay:
        """Whiten the readings of a record about the law with constant a and b."""
        span, mean = record.span, record.mean_current
        rate = max(float(values.rate_mean) * span, 1e-9)
        share = float(np.clip(values.share, -0.2, 1.2))
        start = np.array([[np.log(values.i0 / mean), np.log(rate), share, 0.0, 0.0, 0.0]]).T
        gas, ends = NODE, tuple(Pieces.of(record).pressure.tolist())
        time, current, error = record.time, record.current, record.error
        if record.gauge is not None:
            s = record.time / span
            smooth = np.linalg.lstsq(chebvander(2 * s - 1, 9), record.gauge / span, rcond=None)[0]
            gas = chebvander(ANGLE, 9) @ smooth
            bumps = record.gauge / span - chebvander(2 * s - 1, 9) @ smooth
            current = current * np.exp((1 - share) * rate * bumps)
        origin = Numbers.of(start).currents(gas)
        sees = from_nodes(time / span)
        rows = np.column_stack([current / mean - sees @ origin[:, 0], sees])
        rows = rows if error is None else rows * (mean / error)[:, None]
        if (size := -(-len(record) // ENOUGH)) > 1:  # of rows: a mean across a gap is on no curve
            first = np.arange(0, len(record) // size * size, size)
            whole = slice(first[-1] + size)
            time, rows = (np.add.reduceat(v[whole], first) / size for v in (time, rows))
            rows = rows if error is None else rows * size**0.5
        products = Products.of(rows, time, error is not None)
        return cls(products, start, origin, gas, ends, record.gauge is None).without_hopeless()

    @property
    def smooth(self) -> int:
        """Numbers of a smooth curve, of few readings half as many as these."""
        return min(NODES, self.products.count // 2)

    @cached_property
    def likely(self) -> tuple[np.ndarray, np.ndarray]:
        """Squares that the likeliest smooth curve leaves in each noise, and its log likelihood."""
        curve = block_diag(1.0, smooth_curves(self.smooth))
        least = np.maximum(self.products.combined(curve).left(), 1e-30)
        return least, self.products.log_prior + self.products.log_size(least)

    @property
    def noise(self) -> float:
        """Size of the noise beside the likeliest smooth curve, in the unit of the columns."""
        least, best = self.likely
        return float(np.sqrt(self.products.variance(least[np.argmax(best)], self.smooth)))

    def without_hopeless(self) -> SeenDecay:
        """Leave out noises in which no smooth curve is as likely as this one in another."""
        _, best = self.likely
        return self.of_noises(best > self.products.log_likelihood().max() - 2 * FAR)

    def of_noises(self, kept: np.ndarray) -> SeenDecay:
        """The same with some of the noises."""
        own = self.disturbed
        own = own and own._replace(mean=own.mean[kept], half=own.half[kept])
        return replace(self, products=self.products.some(kept), disturbed=own)

    def beside(self, kind: Disturbance) -> SeenDecay:
        """The same with a disturbance, averaged over, beside the likeliest noises."""
        least, best = self.likely
        near = best > best.max() - BESIDE
        some, unit = self.of_noises(near), np.sqrt(self.products.variance(least[near], self.smooth))
        count, _, numbers = kind.shapes.shape
        size, shown = (
            (shapes[:, None] / unit[:, None, None]).reshape(-1, NODES, numbers)
            for shapes in (kind.shapes, kind.shown(np.exp(self.start[1, 0])))
        )
        columns = self.origin * shown
        matrix = np.tile(some.products.matrix, (count, 1, 1))
        rounding = (NODES + 1) * LEAST_LEFT * np.einsum("kpp->kp", matrix)
        known = rounding[..., None] * np.eye(NODES + 1)
        root = _turned(np.linalg.cholesky(matrix + known))
        seen = root[:, :, 1:] @ columns
        # What readings say beside it: square roots lose no digit where there is little noise.
        lower = np.linalg.cholesky(np.eye(NODES + 1) + seen @ _turned(seen))
        left = np.linalg.solve(lower, root)
        half = np.linalg.inv(np.linalg.cholesky(np.eye(numbers) + _turned(seen) @ seen))
        volume = np.sum(np.log(np.einsum("kpp->kp", lower)), axis=1)
        log = np.repeat(np.log(kind.chance / SMOOTH), len(some.products.kinds)) - volume
        products = some.products._replace(
            kinds=some.products.kinds * count,
            log_prior=np.tile(some.products.log_prior, count) + log,
            matrix=_turned(left) @ left,
        )
        mean = -size @ _turned(np.linalg.solve(lower, seen)) @ left
        found = Disturbed(mean, size @ _turned(half), kind)
        return replace(self, products=products, disturbed=found)

    def away(self, currents: np.ndarray) -> np.ndarray:
        """Currents at the nodes, (18, d), as multiples of the columns that they leave."""
        return np.vstack([-np.ones(currents.shape[1]), currents - self.origin])

    def along(self, away: np.ndarray, kind: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Products of the columns with what currents leave, in the noises of these places, in
        order, and its squares.
        """
        along = np.empty_like(away)
        for matrix, part in zip(self.products.matrix, self._parts(kind), strict=True):
            along[:, part] = matrix @ away[:, part]
        return along, np.maximum(np.sum(away * along, axis=0), 1e-30)

    def _parts(self, kind: np.ndarray) -> list[slice]:
        """Draws of each noise: of one noise they are one product of matrices."""
        ends = np.searchsorted(kind, np.arange(len(self.products.matrix) + 1))
        return [slice(*part) for part in pairwise(ends)]

    def gone(
        self, currents: np.ndarray, kind: np.ndarray, squares: np.ndarray, seed: int
    ) -> np.ndarray:
        """Draw the disturbance at the nodes, (18, d), by even points, beside these currents and the
        squares that they leave.
        """
        found, (mean, half, _) = np.empty_like(currents), self.disturbed
        away, normal = self.away(currents), ndtri(_even(kind.size, half.shape[2], seed))
        noise = np.sqrt(self.products.variance(squares, 0))
        for middle, more, part in zip(mean, half, self._parts(kind), strict=True):
            found[:, part] = middle @ away[:, part] + more @ (normal[:, part] * noise[part])
        return found


class Peaks(NamedTuple):
    """Normal approximations by noise (k) and place (m): centre (p, k, m), lower triangle of the
    inverse covariance (p, p, k, m), log of the integral; and numbers (6, m) about which the last
    step was taken.
    """

    centre: np.ndarray
    lower: np.ndarray
    log: np.ndarray
    numbers: np.ndarray


def _seen_slopes(
    seen: SeenDecay, numbers: np.ndarray, free: list[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Slopes by the free numbers and, last, values at numbers (6, m): of what the products have
    columns of, (15, p + 1, m), and of the share of a, (p + 1, m).
    """
    moved = STEP * np.append(np.eye(6)[:, free], np.zeros((6, 1)), axis=1)
    every = Numbers.of((numbers[:, None] + moved[..., None]).reshape(6, -1))
    rows = np.empty((NODES + 1, len(free) + 1, numbers.shape[1]))
    rows[0], share = -1.0, every.share.reshape(rows.shape[1:])
    rows[1:] = (every.currents(seen.gas) - seen.origin).reshape(NODES, *rows.shape[1:])
    for one in (rows, share[None]):
        one[:, :-1] = (one[:, :-1] - one[:, -1:]) / STEP
    return rows, share


def _triangle(matrix: np.ndarray) -> np.ndarray:
    """Lower triangles L of many small matrices L Lᵀ, numbers of the matrix first: (p, p, ...)."""
    lower, left = np.zeros_like(matrix), matrix.copy()
    for j in range(len(matrix)):
        lower[j, j] = np.sqrt(np.maximum(left[j, j], LEAST_LEFT * matrix[j, j] + 1e-300))
        below = lower[j + 1 :, j]
        below[:] = left[j + 1 :, j] / lower[j, j]
        left[j + 1 :, j + 1 :] -= below[:, None] * below
    return lower


def _forward(lower: np.ndarray, right: np.ndarray) -> np.ndarray:
    """L⁻¹ of columns, (p, ...)."""
    found = np.broadcast_to(right, lower.shape[1:]).copy()
    for j in range(len(lower)):
        found[j] /= lower[j, j]
        found[j + 1 :] -= lower[j + 1 :, j] * found[j]
    return found


def _backward(lower: np.ndarray, right: np.ndarray) -> np.ndarray:
    """L⁻ᵀ of columns, (p, ...)."""
    found = np.broadcast_to(right, lower.shape[1:]).copy()
    for j in reversed(range(len(lower))):
        found[j] /= lower[j, j]
        found[:j] -= lower[j, :j] * found[j]
    return found


def _spread(lower: np.ndarray, slopes: np.ndarray) -> np.ndarray:
    """Standard deviations of something with these slopes, (p, k or 1, m)."""
    return np.sqrt(np.sum(_forward(lower, slopes) ** 2, axis=0))


def _log_within(bounds: tuple[float, float], middle: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """Logarithm of the part of normal distributions between two bounds."""
    low, high = ((bound - middle) / np.maximum(sd, 1e-300) for bound in bounds)
    above = low > 0  # both ends on one side: the tail that is not near 1
    low, high = np.where(above, -high, low), np.where(above, -low, high)
    upper, lower = log_ndtr(high), log_ndtr(low)
    return upper + np.log1p(-np.exp(np.minimum(lower - upper, -1e-12)))


def _expanded(seen: SeenDecay, numbers: np.ndarray, free: list[int]) -> Peaks:
    """Expand the posterior about numbers (6, m) for every noise."""
    rows, share = _seen_slopes(seen, numbers, free)
    products = seen.products.between(rows)
    normal, gradient, squares = products[:-1, :-1], -products[:-1, -1], products[-1, -1]
    change = np.where(numbers[PACE, 0] > 0, PUMPED, DRIFT)
    width = np.where(np.equal(free, CHANGE), change, np.inf)[:, None]
    known = np.diag(1 / width[:, 0] ** 2)[..., None, None]
    pull = (-numbers[free] / width**2)[:, None]
    after = np.maximum(squares, 1e-30)
    for _ in range(2):
        unit = seen.products.variance(after, len(free))
        lower = _triangle(normal / unit + known)
        step = _backward(lower, _forward(lower, gradient / unit + pull))
        after = squares - 2 * np.sum(step * gradient, axis=0)
        after = np.maximum(after + np.einsum("pkm,pqkm,qkm->km", step, normal, step), 1e-30)
    centre = numbers[free][:, None] + step
    log = seen.products.log_prior[:, None] + seen.products.log_size(after)
    log = log - np.sum(np.log(np.einsum("ppkm->pkm", lower)), axis=0)
    log = log - 0.5 * np.sum((centre / width[:, None]) ** 2, axis=0)
    by_share = share[:-1, None]
    moved = share[-1] + np.sum(by_share * step, axis=0)
    log = log + _log_within(seen.share, moved, _spread(lower, by_share))
    log = log + np.log(np.abs(by_share[2]))  # the share is flat, not the bend
    log = log + log_prior(numbers[POWER])[0] - np.log(np.maximum(numbers[PACE], 1.0))
    if np.any(numbers[PACE]):  # gas that is pumped away gets less
        own = np.broadcast_to(np.eye(len(free))[-1][:, None, None], by_share.shape)
        log = log + _log_within((-np.inf, 0.0), centre[-1], _spread(lower, own))
    return Peaks(centre, lower, log, numbers)


def _searched(seen: SeenDecay, numbers: np.ndarray, free: list[int]) -> Peaks:
    """The most probable of the free numbers at each place, by Gauss and Newton: normal
    approximations about where the last step began.
    """
    for _ in range(STEPS):
        found = _expanded(seen, numbers, free)
        whole = np.logaddexp.reduce(found.log)
        weight, before = np.exp(found.log - whole), numbers[free]
        numbers = numbers.copy()
        numbers[free] += np.clip(np.sum(weight * found.centre, axis=1) - before, -0.5, 0.5)
        pumped = numbers[PACE] > 0
        ends = np.where(pumped, -SIZES[1], -5 * DRIFT), np.where(pumped, 0.0, 5 * DRIFT)
        numbers[CHANGE] = np.clip(numbers[CHANGE], *ends)
        named = Numbers.of(numbers)
        numbers[BEND] += (np.clip(named.share, -1.0, 2.0) - named.share) / named.unit
        spread = 1 / np.sqrt(np.sum(weight * np.sum(found.lower**2, axis=1), axis=1))
        moved = np.max(np.abs(numbers[free] - before) / (spread + 1e-9), axis=0)
        likely = np.exp(whole - whole.max())
        if likely @ moved < RESTS * likely.sum():
            break
    return found


def _along(seen: SeenDecay, row: int, low: float, high: float, free: list[int]) -> Peaks:
    """Expansions at places of one number, in ever narrower ranges that hold the posterior.

    No noise is left out before the last range: between places far apart something smooth is left
    over, and looks like noise with a memory.
    """
    place, numbers = np.linspace(low, high, PLACES), np.tile(seen.start, (1, PLACES))
    for _ in range(RANGES):
        numbers[row] = place
        found = _searched(seen, numbers, free)
        whole = np.logaddexp.reduce(found.log)
        if not np.isfinite(whole).all():
            break  # a beam that died: no law of this kind has finite slopes
        held = np.flatnonzero(whole > whole.max() - FAR)
        ends = [max(held[0] - 1, 0), min(held[-1] + 1, PLACES - 1)]
        if ends[1] - ends[0] > 0.6 * PLACES:
            break
        before, place = place, np.linspace(*place[ends], PLACES)
        numbers = np.array([np.interp(place, before, one) for one in found.numbers])
    return found


class Draws(NamedTuple):
    """Numbers with walks of the loss rate, currents and what the monitor shows of them at the
    nodes, (18, d), their weights, their log evidence, and how many draws they are worth.
    """

    numbers: Numbers
    walk: np.ndarray
    currents: np.ndarray
    shown: np.ndarray
    weight: np.ndarray
    log: float
    worth: float


@lru_cache(maxsize=16)
def _even(draws: int, count: int, seed: int) -> np.ndarray:
    """Points that fill a cube evenly, (p, d): their means err less than those of random ones.

    Steps are powers of the root of x^(p + 1) = x + 1, from a place at random (M. Roberts, The
    unreasonable effectiveness of quasirandom sequences, 2018).
    """
    root = np.roots([1.0, *[0.0] * (count - 1), -1.0, -1.0]).real.max()
    steps = root ** -np.arange(1.0, count + 1)
    start = np.random.default_rng(seed).random((count, 1))
    return (start + steps[:, None] * np.arange(draws)) % 1


def _between(even: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Even points as draws by the logistic distribution between bounds, and their log density."""
    above = low > 0  # both ends on one side: the tail that is not near 1
    start, end = log_expit(np.where(above, [-high, -low], [low, high]) / TAIL)
    below = np.logaddexp(start + np.log1p(-even), end + np.log(even))
    rest, part = np.log1p(-np.exp(below)), end + np.log(-np.expm1(start - end))
    return np.where(above, -TAIL, TAIL) * (below - rest), below + rest - part - math.log(TAIL)


def _rows(free: Sequence[int]) -> tuple[list[int], list[int]]:
    """Rows of numbers that are nearly normal, in the order that they are eliminated in, and of
    those at places.
    """
    return [r for r in (0, 1, BEND, CHANGE) if r in free], [r for r in (POWER, PACE) if r in free]


class DrawnLaw(NamedTuple):
    """A law that is drawn from: the record with the noises that are left, its peaks, rows of the
    numbers that are free, and at each place slopes by ln level and ln rate, the share being the
    same, (19, 2, m), and lower triangles of their products by noise, (2, 2, k, m).
    """

    seen: SeenDecay
    peaks: Peaks
    free: tuple[int, ...]
    slopes: np.ndarray
    beam: np.ndarray

    @classmethod
    def of(cls, seen: SeenDecay, free: Sequence[int]) -> DrawnLaw:
        """Approximate the posterior of some of the numbers by normal distributions; an exponent and
        a pace at places.
        """
        normal, _ = _rows(free)
        if PACE in free:
            found = _along(seen, PACE, *PACES, normal)
        elif POWER in free:
            found = _along(seen, POWER, LEAST, MOST, normal)
        else:
            found = _searched(seen, seen.start, normal)
        kept = found.log.max(axis=1) > found.log.max() - FAR
        if kept.any():  # finite
            found = Peaks(*(part[..., kept, :] for part in found[:3]), found.numbers)
            seen = seen.of_noises(kept)
        slopes, share = _seen_slopes(seen, found.numbers, normal)
        slopes = slopes[:, :2] - slopes[:, [2]] * share[:2] / share[2]
        return cls(seen, found, tuple(free), slopes, _triangle(seen.products.between(slopes)))

    @property
    def disturbance(self) -> Disturbance | None:
        """The disturbance beside the law, if there is any."""
        return self.seen.disturbed and self.seen.disturbed.kind

    @property
    def beside(self) -> str | None:
        """Name, of `BESIDES`, of what goes beside a and b."""
        if PACE in self.free:
            return "pumped"
        kind = self.disturbance
        return kind and ("settles" if kind is MONITOR_SETTLES else "wanders")

    def _log_prior(self, numbers: Numbers) -> np.ndarray:
        free, (low, high) = self.free, self.seen.share
        inside = (numbers.share >= low) & (numbers.share <= high)
        log = np.where(inside, -math.log(high - low), -np.inf)
        if PACE in self.free:
            return log + log_pumped(numbers.share, numbers.gas, numbers.pace)
        log = log + log_prior(numbers.power)[0] if POWER in free else log
        return log + log_straight(numbers.drift) if CHANGE in free else log

    def _proposed(self, draws: int, seed: int) -> tuple[np.ndarray, Numbers, np.ndarray]:
        """Noises, in order, numbers and their log density of draws from the normal approximations,
        with wider tails.
        """
        peaks, (rows, places) = self.peaks, _rows(self.free)
        odds = np.exp(peaks.log - peaks.log.max()).ravel()
        ends = np.cumsum(odds) / odds.sum()
        which = np.minimum(np.searchsorted(ends, (np.arange(draws) + 0.5) / draws), odds.size - 1)
        kind, at = np.unravel_index(which, peaks.log.shape)
        even = _even(draws, len(rows), seed)
        near, log = self._with_share(kind, at, even[2:])
        numbers, more = self._with_beam(kind, at, near, even[:2])
        spacing = math.prod(np.diff(peaks.numbers[row])[0] for row in places)
        return kind, numbers, log + more + np.log(odds[which] / odds.sum() / spacing)

    def _with_share(
        self, kind: np.ndarray, at: np.ndarray, even: np.ndarray
    ) -> tuple[Numbers, np.ndarray]:
        """Draw changes of the gas and shares of a between their bounds."""
        peaks, free = self.peaks, self.free
        lower, centre = peaks.lower[..., kind, at], peaks.centre[:, kind, at]
        rows, numbers, own = _rows(free)[0], peaks.numbers[:, at], np.zeros_like(centre)
        log, far = np.zeros(kind.size), np.full(kind.size, np.inf)
        if CHANGE in free:
            most = -centre[-1] * lower[-1, -1] if PACE in free else far  # gas gets less
            own[-1], log = _between(even[-1], -far, most)
            log = log + np.log(lower[-1, -1])
        numbers[rows] = centre + _backward(lower, own)
        middle = Numbers.of(numbers)
        bounds = [lower[2, 2] * (s - middle.share) / middle.unit for s in self.seen.share]
        own[2], more = _between(even[0], np.minimum(*bounds), np.maximum(*bounds))
        share = middle.share + middle.unit * own[2] / lower[2, 2]
        numbers[rows] = centre + _backward(lower, own)
        gas = middle.gas if PACE in free else (1 - share) * numbers[CHANGE]
        found = Numbers.of(numbers)._replace(share=share, gas=gas)
        return found, log + more + np.log(lower[2, 2] / np.abs(middle.unit))

    def _with_beam(
        self, kind: np.ndarray, at: np.ndarray, near: Numbers, even: np.ndarray
    ) -> tuple[Numbers, np.ndarray]:
        """Draw levels and rates about the best ones beside the other numbers, found anew."""
        seen, lower = self.seen, self.beam[..., kind, at]
        along, squares = seen.along(seen.away(near.currents(seen.gas)), kind)
        pull = _forward(lower, -np.einsum("prd,pd->rd", self.slopes[..., at], along))
        left = np.maximum(squares - np.sum(pull**2, axis=0), 1e-30)
        noise, far = np.sqrt(seen.products.variance(left, 2)), np.full(kind.size, np.inf)
        own, log = _between(even, -far, far)
        step = _backward(lower, pull + noise * own)
        level, rate = np.exp(np.clip(np.log([near.level, near.rate]) + step, -30.0, 8.0))
        log = np.sum(log, axis=0) + np.log(lower[0, 0] * lower[1, 1] / noise**2)
        return near._replace(level=level, rate=rate), log

    def weighed(self, draws: int, seed: int = 0) -> Draws:
        """Draw from the normal approximations, each draw weighed by the posterior."""
        seen, peaks = self[:2]
        if not np.isfinite(peaks.log).all():
            numbers, none = Numbers.of(peaks.numbers), np.zeros(peaks.log.shape[1])
            currents = numbers.currents(seen.gas)
            walk = np.zeros_like(currents)
            return Draws(numbers, walk, currents, currents, none, -np.inf, 0.0)
        kind, numbers, given = self._proposed(draws, seed)
        currents = numbers.currents(seen.gas)
        _, squares = seen.along(seen.away(currents), kind)
        log = seen.products.log_prior[kind] + seen.products.log_size(squares)
        log = log + np.log(numbers.level * numbers.rate) + self._log_prior(numbers) - given
        whole = float(logsumexp(log))
        weight = np.exp(log - max(whole, -1e300))
        worth = float(weight.sum() / max(np.sum(weight**2), 1e-300))
        walk, shown = np.zeros_like(currents), currents
        if seen.disturbed is not None:
            gone = seen.gone(currents, kind, squares, seed + 1)
            if seen.disturbed.kind.of_loss:
                walk = gone
                shown = currents = currents * np.exp(-numbers.rate * (INTEGRAL @ walk))
            else:
                shown = currents * (1 + gone)
        return Draws(numbers, walk, currents, shown, weight, whole - math.log(draws), worth)


def drawn(laws: Sequence[DrawnLaw]) -> list[Draws]:
    """Draws of several laws: a few, and then as few more as tell the end of an interval, whichever
    law it is of.
    """
    found, count = [law.weighed(FEW) for law in laws], np.full(len(laws), FEW)
    while True:
        log, worth = np.array([(one.log, max(one.worth, 1.0)) for one in found]).T
        part = np.exp(log - max(log.max(), -1e300))
        errors = np.sqrt(part / max(part.sum(), 1e-300) * count / worth)  # of one draw of each
        needed = np.minimum(WORTH * errors * errors.sum(), MANY)
        short = np.flatnonzero(count < 0.8 * needed)
        if not short.size:
            return found
        for k in short:
            count[k] = needed[k]
            found[k] = laws[k].weighed(count[k])


def mixed(laws: Sequence[Draws]) -> Draws:
    """Draws of several laws, each with its probability; one that has none may have no numbers."""
    laws = [law for law in laws if np.isfinite(law.log)] or laws[:1]
    whole = float(logsumexp([law.log for law in laws]))
    if not np.isfinite(whole):
        return laws[0]
    weight = np.concatenate([law.weight * math.exp(law.log - whole) for law in laws])
    numbers = Numbers(*map(np.concatenate, zip(*(law.numbers for law in laws), strict=True)))
    walk, currents, shown = (np.hstack([law[row] for law in laws]) for row in (1, 2, 3))
    return Draws(numbers, walk, currents, shown, weight, whole, float(1 / np.sum(weight**2)))


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


def quantity_of(
    values: np.ndarray, weight: np.ndarray, unit: str, ends: tuple[float, float] = WIDE
) -> Quantity:
    """Median, half of the central 68 % and, between probabilities, 95 % of weighted draws."""
    found = quantiles(values, weight, np.array([0.5, *CENTRAL, *ends]))
    middle, less, more, *interval = map(float, found)
    return Quantity(middle, (more - less) / 2, unit, None, tuple(interval))


def ends_of(none: bool, all_: bool) -> tuple[float, float]:
    """Probabilities at the ends of the 95 % interval of a share of which none or all is not
    excluded; the end at that bound is the bound.
    """
    least, most = WIDE
    return least * (1 + all_), most - least * none


def _share_of(
    values: np.ndarray, weight: np.ndarray, unit: str, none: bool, all_: bool, whole: np.ndarray
) -> Quantity:
    """A loss that is a share of a whole; the interval reaches to a bound that is not excluded: from
    0 to the limit of 95 %, or up to the whole.
    """
    found = quantity_of(values, weight, unit, ends_of(none, all_))
    low, high = found.interval_95
    high = quantiles(whole, weight, np.array([WIDE[1]]))[0] if all_ else high
    return replace(found, interval_95=(0.0 if none else low, float(high)))


@dataclass(frozen=True)
class FreeLaw:
    """Posterior of a record whose law and noise are not certain.

    Parameters
    ----------
    quantities : mapping of str to Quantity
        I0, a, b and the lifetimes at the start, the end and the mean current.
    share : Quantity
        Share of a in the loss at the mean current.
    exponent : Quantity
        g in a(I) proportional to I^g, with its prior.
    drift : Quantity or None
        Change of b over the record as a share of it, with its prior; None where a gauge tells it.
    constant : float
        Probability of constant a and b, at even odds with the free law.
    odd : float
        Probability that the exponent is none of a bunch's length.
    pumped : float
        Probability of gas that is pumped away after a fill, in the place of exponent and drift.
    wanders : float
        Probability that the loss rate or the monitor wanders besides.
    settles : float
        Probability of a monitor that settles after a fill.
    nodes : array, shape (18,)
        What the monitor shows at the nodes in the mean, mA.
    span : float
        Length of the record, s.
    """

    quantities: Mapping[str, Quantity]
    share: Quantity
    exponent: Quantity
    drift: Quantity | None
    constant: float
    odd: float
    pumped: float
    wanders: float
    settles: float
    nodes: np.ndarray
    span: float

    @property
    def likelier(self) -> bool:
        """True if departures of a and b are likelier than none: their values are quoted then."""
        return self.constant <= LIKELIER

    @property
    def tells_share(self) -> bool:
        """True unless the loss may as well be all of a as none of it, or bends as no known law."""
        return not self.is_odd and any(self.quantities[name].interval_95[0] > 0 for name in "ab")

    @property
    def is_odd(self) -> bool:
        """True if the exponent is likely none of a bunch's length."""
        return self.odd > LIKELIER

    @property
    def beside(self) -> str | None:
        """Name, of `BESIDES`, of what is likely to go beside the a and b that are quoted."""
        likely = (name for name in BESIDES if getattr(self, name) > LIKELIER)
        return next(likely, None) if self.likelier else None

    def curve(self, time: np.ndarray) -> np.ndarray:
        """Mean of the monitor's readings at times in s, mA."""
        return from_nodes(time / self.span) @ self.nodes

    def to_json(self) -> dict[str, object]:
        """Return the exponent, the drift and the probabilities of the laws."""
        told = {"exponent": self.exponent, "drift": self.drift}
        told |= {"probability_of_constant_a_and_b": self.constant}
        told |= {"probability_of_outgassing": self.pumped}
        told |= {"probability_of_wandering": self.wanders}
        return told | {"probability_of_settling": self.settles}


def at_bounds(share: np.ndarray, weight: np.ndarray) -> tuple[bool, bool]:
    """Tell if shares of 0 and of 1 are not excluded at 95 %: by the density of draws beside them
    in that of a normal distribution, two standard deviations off.
    """
    near = NEAR * math.sqrt(weight @ (share - weight @ share) ** 2)
    least = NEAR * math.exp(-(1.96**2) / 2) / math.sqrt(2 * math.pi)
    return bool(weight @ (share < near) > least), bool(weight @ (share > 1 - near) > least)


def free_law(record: DecayRecord, values: Physical) -> FreeLaw | None:
    """Average a decay over exponents of a, drifts of b and noises.

    Parameters
    ----------
    record : DecayRecord
        One decay.
    values : Physical
        Of the law with constant a and b.

    Returns
    -------
    FreeLaw or None
        None where no such law fits the record: its draws are worth too few, or a loss with a
        negative a or b is likelier.

    Notes
    -----
    For each exponent on a grid and each noise of `beamfit.noise.memory` a normal approximation of
    the other numbers, whose draws are weighed by the posterior itself (importance sampling), with
    the size of the noise integrated over.

    Examples
    --------
    >>> from beamfit.lifetime.expansion import Pieces, solved
    >>> t = np.linspace(0, 36000, 100)
    >>> noise = 1e-2 * np.random.default_rng(1).normal(size=100)
    >>> record = DecayRecord(t, 100.0 / (1.0 + 100.0 * 1e-7 * t) + noise)
    >>> found = free_law(record, solved(Pieces.of(record)).values)
    >>> low, high = found.quantities["a"].interval_95
    >>> low < 1e-7 <= high
    True
    """
    seen = SeenDecay.of(record, values)
    proposed = proposals(seen)
    laws = list(zip(proposed, drawn(proposed), strict=True))
    draws = mixed([own for _, own in laws])
    freed = mixed([own for law, own in laws if POWER in law.free])
    # Few draws are enough: constant a and b in their place would be too sure.
    if not (np.isfinite(freed.log) and draws.worth >= MIN_EFFECTIVE_DRAWS):
        return None
    plain = DrawnLaw.of(seen, CONSTANT).weighed(FEW)
    if not 0 <= values.share <= 1:
        rival = DrawnLaw.of(replace(seen, share=NO_BEAM), CONSTANT).weighed(FEW)
        if rival.log + np.log(UNPHYSICAL) > draws.log:
            return None
    usual, odd = log_prior(freed.numbers.power)
    odd = math.exp(freed.log - draws.log) * float(freed.weight @ np.exp(odd - usual))
    exponent, drift = quantity_of(freed.numbers.power, freed.weight, "1"), None
    if seen.drifts:
        drift = quantity_of(freed.numbers.drift, freed.weight, "1")
    constant = float(expit(plain.log - draws.log))
    chances = [(law.beside, math.exp(own.log - draws.log)) for law, own in laws]
    pumped, wanders, settles = (
        sum((chance for beside, chance in chances if beside == name), 0.0) for name in BESIDES
    )
    nodes = record.mean_current * draws.shown @ draws.weight
    share = quantity_of(draws.numbers.share, draws.weight, "1")
    found = _quantities(record, seen, draws)
    return FreeLaw(found, share, exponent, drift, constant, odd, pumped, wanders, settles, nodes,
                   record.span)  # fmt: skip


def proposals(seen: SeenDecay) -> list[DrawnLaw]:
    """The free law, gas that is pumped away, and the free law beside disturbances, or constant a
    and b where the monitor settles; where a gauge tells the gas only the monitor is disturbed.
    """
    free = [*CONSTANT, POWER, CHANGE] if seen.drifts else [*CONSTANT, POWER]
    laws = [DrawnLaw.of(seen, free)]
    laws += [DrawnLaw.of(seen, [*CONSTANT, CHANGE, PACE])] if seen.drifts else []
    if seen.products.count < FEWEST or seen.noise < QUIET:
        return laws
    every = disturbances(float(np.exp(seen.start[1, 0])))
    beside = [seen.beside(kind) for kind in every if seen.drifts or not kind.of_loss]
    laws += [DrawnLaw.of(own, free) for own in beside]
    return [*laws, DrawnLaw.of(beside[-1], CONSTANT)]  # a monitor that settles


def rates_of(a, b, power, changed, x, seen: SeenDecay):
    """Loss rates at the first and last reading and at the mean current; in the unit of b, and of a
    at the mean current. At the first reading, at the mean current and at the last one x are the
    currents of the law, as of `of_law`, and `changed` is by how much the loss to gas has changed.
    """
    first, middle, last = (
        a * at ** (1 + power) + b * pressure + more
        for at, pressure, more in zip(x, (seen.ends[0], 1.0, seen.ends[1]), changed, strict=True)
    )
    return first, last, middle


def of_law(x, lost):
    """Currents of the law at the first reading, at the mean current and at the last one, where x
    are those at the nodes and `lost` is the part of the loss, by a walk until then, that is not in
    the law: the loss to a goes with what the law alone leaves.
    """
    return x[0], np.e ** lost[1], x[-1] * np.e ** lost[2]


def middle_of(currents: np.ndarray, weight: np.ndarray) -> float:
    """When the current is its mean, over the span, by the mean of draws at the nodes."""
    time, nodes = np.linspace(0.0, 1.0, 1001), currents @ weight
    return float(np.interp(-1.0, -(from_nodes(time) @ nodes), time))


def _quantities(record: DecayRecord, seen: SeenDecay, draws: Draws) -> dict[str, Quantity]:
    """Quantities that are quoted, from draws."""
    found, currents, weight = draws.numbers, draws.currents, draws.weight
    span, mean = record.span, record.mean_current
    whole = found.rate / mean / span, found.rate / span
    a, b = found.share * whole[0], (1 - found.share) * whole[1]
    moments = (0.0, middle_of(currents, weight), 1.0)
    at = from_nodes(np.array(moments))
    changed = [
        whole[1] * (found.gas * gas_change(s, found.pace) + walked)
        for s, walked in zip(moments, at @ draws.walk, strict=True)
    ]
    law = of_law(currents, found.rate * (at @ INTEGRAL @ draws.walk))
    rates = rates_of(a * mean, b, found.power, changed, law, seen)
    quoted = {"i0": found.level * mean}
    quoted |= {f"lifetime_{at}": 1 / rate / HOUR for at, rate in zip(ENDS, rates, strict=True)}
    bounds = at_bounds(found.share, weight)
    own = {"a": (a, *bounds, whole[0]), "b": (b, *bounds[::-1], whole[1])}
    told = {name: quantity_of(values, weight, UNITS[name]) for name, values in quoted.items()}
    told |= {n: _share_of(v, weight, UNITS[n], *more) for n, (v, *more) in own.items()}
    return {name: told[name] for name in UNITS}
