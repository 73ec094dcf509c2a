"""Posterior of a decay whose law and noise are not certain: a(I), b(t) and noise averaged over.

With x the current over its mean and s the time over the span, the loss rate is
share R x^(1 + g) + (1 - share) R (1 + h (s - 1/2)) with the share of a from 0 to 1. The exponent g
and the drift h have priors, the first current, R and the share are flat. The law has a closed form
with one integral, taken to rounding on Chebyshev nodes; readings see the nodes through one matrix,
so that whitened products of its columns are all that the readings say.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.polynomial.chebyshev import chebint, chebvander
from scipy.special import gammaln, log_ndtr, logsumexp

from beamfit.lifetime.decay_law import closed_form
from beamfit.lifetime.expansion import Physical
from beamfit.lifetime.record import DecayRecord
from beamfit.noise.memory import Products
from beamfit.quantity import HOUR, Quantity

# Standard deviations of the exponent below and above zero. Bunches lengthen with the current, in
# the potential well by x³ - x ∝ I (`beamfit.lifetime.bunch`), so that a goes as I^0 to I^-1/3; that
# they shorten, or the vacuum follows the current, is seldom. A twentieth of the prior is flat.
BELOW, ABOVE, ODD = 0.3, 0.2, 0.05
LEAST, MOST = -0.9, 2.0
# Standard deviation of the change of b in one record: pressures of stored beams are read to 10 %.
DRIFT = 0.1
# Nodes of the integral: exact to rounding up to four lifetimes in a record.
NODES = 14
# Exponents looked at, in ever narrower ranges, and steps of the search with each.
EXPONENTS, RANGES, STEPS = 33, 5, 6
# Readings beyond which neighbours are averaged: the curve is smooth between them.
ENOUGH = 1024
# Draws at first and again where they are worth too few, the degrees of freedom of what they come
# from, and how many independent ones an answer needs.
DRAWS, TAIL, WORTH = (6000, 60000), 8.0, 200.0
# Width of the share in what draws come from, which its bounds cut off otherwise.
AROUND = 0.6
# Where the record's bend would not depend on the share its coordinate takes this slope instead.
FLAT = 0.2
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

UNITS = {
    "a": "1/(mA s)",
    "b": "1/s",
    "i0": "mA",
    "lifetime_start": "h",
    "lifetime_end": "h",
    "lifetime_mean": "h",
}
ANGLE = -np.cos(np.pi * np.arange(NODES) / (NODES - 1))
NODE = (1 + ANGLE) / 2
FROM_NODES = np.linalg.inv(chebvander(ANGLE, NODES - 1))
INTEGRAL = chebvander(ANGLE, NODES) @ chebint(FROM_NODES, lbnd=-1) / 2


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


class Numbers(NamedTuple):
    """First current over the mean, loss in the span at the mean current, share of a, exponent,
    drift, and by how much the share changes with the third of the search's numbers.
    """

    level: np.ndarray
    rate: np.ndarray
    share: np.ndarray
    power: np.ndarray
    drift: np.ndarray
    unit: np.ndarray

    @classmethod
    def of(cls, found: np.ndarray) -> Numbers:
        """From columns of ln level, ln rate, bend, exponent, drift.

        The bend, share (1 + g) - (1 - share) h / R, is how the loss rate falls with the current,
        which the record shows: with it the posterior is nearly normal.
        """
        level, rate = np.exp(np.clip(found[:2], -30.0, 8.0))
        power, drift = found[3], found[4]
        unit = np.maximum(1 + power + drift / rate, FLAT)
        return cls(level, rate, (found[2] + drift / rate) / unit, power, drift, 1 / unit)

    def currents(self, gas: np.ndarray) -> np.ndarray:
        """Currents at the nodes over the mean, one column a set; `gas` is ∫ P dt over the mean."""
        parts = self.share * self.rate, (1 - self.share) * self.rate
        return node_currents(self.level, *parts, self.power, self.drift, gas)


def node_currents(level, quadratic, linear, power, drift, gas, xp=np):
    """Currents at the nodes over the mean, (14, m), as of `closed_form` with W = ∫ exp(-c B) ds."""
    c = 1 + power
    course = gas[:, None] + drift * (NODE**2 - NODE)[:, None] / 2
    lost = linear * course
    whole = INTEGRAL @ xp.exp(xp.clip(-c * lost, -700, 700))
    # Where a loss that is no beam's would have ended the record the law has no value.
    inside = c * quadratic * level**c
    least = (1e-3 - 1) / xp.where(inside == 0, 1.0, inside)
    whole = xp.where(inside * whole < 1e-3 - 1, least, whole)
    return closed_form(level, quadratic, power, lost, whole, xp)


def log_prior(power, xp=np):
    """Log density of exponents, and of its flat part alone."""
    width = xp.where(power < 0, BELOW, ABOVE)
    usual = xp.exp(-0.5 * (power / width) ** 2) / (np.sqrt(np.pi / 2) * (BELOW + ABOVE))
    odd = ODD / (MOST - LEAST)
    return xp.log((1 - ODD) * usual + odd), np.log(odd)


@dataclass(frozen=True)
class SeenDecay:
    """A record as products of the columns that its readings see the nodes through.

    Parameters
    ----------
    products : Products
        Of what is left of the readings at `start`, and of the columns of the nodes.
    start : array, shape (5, 1)
        Numbers of a law near the most probable one.
    origin : array, shape (14, 1)
        Its currents at the nodes.
    gas : array, shape (14,)
        Integral of the pressure over its mean at the nodes, over the span.
    ends : tuple of float
        Pressure over its mean at the first and the last reading.
    drifts : bool
        Whether b may drift.
    share : tuple of float
        Between which the share of a lies.
    """

    products: Products
    start: np.ndarray
    origin: np.ndarray
    gas: np.ndarray
    ends: tuple[float, float]
    drifts: bool
    share: tuple[float, float] = (0.0, 1.0)

    @classmethod
    def of(cls, record: DecayRecord, values: Physical) -> SeenDecay:
        """Whiten the readings of a record about the law with constant a and b."""
        span, mean = record.span, float(record.current.mean())
        rate = max(float(values.rate_mean) * span, 1e-9)
        share = float(np.clip(values.share, -0.2, 1.2))
        start = np.array([[np.log(values.i0 / mean)], [np.log(rate)], [share], [0.0], [0.0]])
        gas, bumps, ends = NODE, 0.0, (1.0, 1.0)
        time, current, error = record.time, record.current, record.error
        if record.gauge is not None:
            s = record.time / span
            smooth = np.linalg.lstsq(chebvander(2 * s - 1, 9), record.gauge / span, rcond=None)[0]
            gas = chebvander(ANGLE, 9) @ smooth
            bumps = record.gauge / span - chebvander(2 * s - 1, 9) @ smooth
            slope = np.diff(record.gauge) / np.diff(record.time)
            ends = float(slope[0]), float(slope[-1])
            current = current * np.exp((1 - share) * rate * bumps)
        stated = error is not None
        if len(record) > ENOUGH:  # readings whose errors nobody states have all the same
            alike = error if stated else np.full(len(record), mean)
            time, current, error = DecayRecord(time, current, alike).blocks(ENOUGH)
        origin = Numbers.of(start).currents(gas)
        sees = chebvander(2 * time / span - 1, NODES - 1) @ FROM_NODES
        rows = np.column_stack([current / mean - sees @ origin[:, 0], sees])
        rows = rows if error is None else rows * (mean / error)[:, None]
        products = Products.of(rows, time, stated)
        return cls(products, start, origin, gas, ends, record.gauge is None)

    @property
    def middle(self) -> float:
        """When the current is its mean, over the span: the drift has gone so far by then."""
        return float(np.interp(-1.0, -self.origin[:, 0], NODE))

    def of_noises(self, kept: np.ndarray) -> SeenDecay:
        """The same with some of the noises."""
        return replace(self, products=self.products.some(kept))

    def left(self, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Sums of squares (k, m) by noise and set of numbers, and products with node columns."""
        away = Numbers.of(numbers).currents(self.gas) - self.origin
        matrix, along = self.products.matrix[:, 1:, 1:], self.products.matrix[:, 0, 1:]
        pulled = matrix @ away
        first = self.products.matrix[:, 0, 0][:, None]
        squares = first - 2 * along @ away + np.sum(away * pulled, axis=1)
        return np.maximum(squares, 1e-30), along[:, :, None] - pulled


class Peaks(NamedTuple):
    """Normal approximations by noise (k) and exponent (m): centre, scaled triangle of the inverse
    covariance, log of the integral; and numbers (5, m) about which the last step was taken.
    """

    centre: np.ndarray
    precision: np.ndarray
    log: np.ndarray
    numbers: np.ndarray


def _slopes(seen: SeenDecay, numbers: np.ndarray, free: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Slopes of the currents at the nodes, (14, p, m), and of the share, (p, m)."""
    move = STEP * np.eye(5)[:, None, free, None] * np.array([1.0, -1.0])[:, None, None]
    both = Numbers.of((numbers[:, None, None] + move).reshape(5, -1))
    shape = (2, len(free), -1)
    more, less = np.moveaxis(both.currents(seen.gas).reshape(NODES, *shape), 1, 0)
    share = both.share.reshape(shape)
    return (more - less) / (2 * STEP), (share[0] - share[1]) / (2 * STEP)


def _triangle(matrix: np.ndarray) -> np.ndarray:
    """Lower triangles L of many small matrices L Lᵀ, numbers of the matrix first: (p, p, ...)."""
    lower = np.zeros_like(matrix)
    for j in range(len(matrix)):
        left = matrix[j:, j] - np.sum(lower[j:, :j] * lower[j, :j], axis=1)
        lower[j:, j] = left / np.sqrt(np.maximum(left[0], LEAST_LEFT * matrix[j, j]))
    return lower


def _forward(lower: np.ndarray, right: np.ndarray) -> np.ndarray:
    """L⁻¹ of columns, (p, ...)."""
    found = np.empty(lower.shape[1:])
    for j in range(len(lower)):
        found[j] = (right[j] - np.sum(lower[j, :j] * found[:j], axis=0)) / lower[j, j]
    return found


def _solved(lower: np.ndarray, right: np.ndarray) -> np.ndarray:
    """(L Lᵀ)⁻¹ of columns, (p, ...)."""
    found = _forward(lower, right)
    for j in reversed(range(len(lower))):
        found[j] = (found[j] - np.sum(lower[j + 1 :, j] * found[j + 1 :], axis=0)) / lower[j, j]
    return found


def _log_within(bounds: tuple[float, float], middle: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """Logarithm of the part of normal distributions between two bounds."""
    low, high = ((bound - middle) / np.maximum(sd, 1e-300) for bound in bounds)
    above = low > 0  # both ends on one side: the tail that is not near 1
    low, high = np.where(above, -high, low), np.where(above, -low, high)
    upper, lower = log_ndtr(high), log_ndtr(low)
    return upper + np.log1p(-np.exp(np.minimum(lower - upper, -1e-12)))


def _expanded(seen: SeenDecay, numbers: np.ndarray, free: list[int]) -> Peaks:
    """Expand the posterior about numbers (5, m) for every noise."""
    slopes, of_share = _slopes(seen, numbers, free)
    squares, pulled = seen.left(numbers)
    gradient = np.einsum("npm,knm->pkm", slopes, pulled)
    turned = seen.products.matrix[:, 1:, 1:] @ slopes.reshape(NODES, -1)
    normal = np.einsum("npm,knqm->pqkm", slopes, turned.reshape(-1, *slopes.shape))
    width, middle = np.array([np.inf, np.inf, AROUND, np.inf, DRIFT])[free], np.zeros(len(free))
    middle[2] = 0.5
    width, middle = width[:, None], middle[:, None]
    known = np.diag(1 / width[:, 0] ** 2)[..., None, None]
    pull = ((middle - numbers[free]) / width**2)[:, None]
    after = squares
    for _ in range(2):
        unit = seen.products.variance(after, len(free))
        precision = normal / unit + known
        lower = _triangle(precision)
        step = _solved(lower, gradient / unit + pull)
        after = squares - 2 * np.sum(step * gradient, axis=0)
        after = np.maximum(after + np.einsum("pkm,pqkm,qkm->km", step, normal, step), 1e-30)
    centre = numbers[free][:, None] + step
    log = seen.products.log_prior[:, None] + seen.products.log_size(after)
    log = log - np.sum(np.log(np.einsum("ppkm->pkm", lower)), axis=0)
    log = log - 0.5 * np.sum(((centre - middle[:, None]) / width[:, None]) ** 2, axis=0)
    share = Numbers.of(numbers).share + np.einsum("pm,pkm->km", of_share, step)
    spread = np.sum(_forward(lower, of_share[:, None]) ** 2, axis=0)
    log = log + _log_within(seen.share, share, np.sqrt(spread))
    log = log + log_prior(numbers[3])[0]
    return Peaks(np.moveaxis(centre, 0, 2), np.moveaxis(precision, (0, 1), (2, 3)), log, numbers)


def _searched(seen: SeenDecay, numbers: np.ndarray, free: list[int]) -> tuple[SeenDecay, Peaks]:
    """The most probable of the free numbers at each exponent, by Gauss and Newton.

    Noises that have no part where the most probable exponent rests are left out from there on.
    """
    for _ in range(STEPS):
        found = _expanded(seen, numbers, free)
        whole = logsumexp(found.log, axis=0)
        weight = np.exp(found.log - whole)
        step = np.einsum("km,kmp->pm", weight, found.centre) - numbers[free]
        numbers = numbers.copy()
        numbers[free] += np.clip(step, -0.5, 0.5)
        numbers[4] = np.clip(numbers[4], -5 * DRIFT, 5 * DRIFT)
        named = Numbers.of(numbers)
        numbers[2] += (np.clip(named.share, -1.0, 2.0) - named.share) / named.unit
        spread = 1 / np.sqrt(np.einsum("km,kmpp->pm", weight, found.precision))
        rests = np.all(np.abs(step) < 0.03 * spread + 1e-9, axis=0)
        if rests.all():
            break
        if rests[np.argmax(whole)]:
            seen = seen.of_noises(found.log.max(axis=1) > found.log.max() - 2 * FAR)
    return seen, _expanded(seen, numbers, free)


def _by_exponent(seen: SeenDecay, free: list[int]) -> tuple[SeenDecay, Peaks]:
    """Expansions at exponents and by noises that hold the posterior, in ever narrower ranges."""
    low, high, numbers = LEAST, MOST, np.tile(seen.start, (1, EXPONENTS))
    for _ in range(RANGES):
        power = np.linspace(low, high, EXPONENTS)
        numbers = np.vstack([numbers[:3], power, numbers[4]])
        seen, found = _searched(seen, numbers, free)
        whole = logsumexp(found.log, axis=0)
        if not np.isfinite(whole).all():
            return seen, found  # a beam that died: no law of this kind has finite slopes
        seen = seen.of_noises(found.log.max(axis=1) > found.log.max() - FAR)
        held = np.flatnonzero(whole > whole.max() - FAR)
        ends = max(held[0] - 1, 0), min(held[-1] + 1, EXPONENTS - 1)
        if ends[1] - ends[0] > 0.6 * EXPONENTS:
            break
        low, high = power[ends[0]], power[ends[1]]
        at = np.linspace(low, high, EXPONENTS)
        numbers = np.array([np.interp(at, power, row) for row in found.numbers])
    return seen, _expanded(seen, found.numbers, free)


class Draws(NamedTuple):
    """Numbers with their weights, their log evidence, and how many draws they are worth."""

    numbers: Numbers
    weight: np.ndarray
    log: float
    worth: float


def peaks_of(seen: SeenDecay, free: list[int]) -> tuple[SeenDecay, Peaks]:
    """Approximate the posterior of some of the numbers by normal distributions."""
    if 3 in free:
        return _by_exponent(seen, free[:3] + free[4:])
    return _searched(seen, seen.start, free)


def drawn(seen: SeenDecay, free: list[int]) -> Draws:
    """Draw the free numbers from their posterior; more of them where they are worth too few."""
    seen, peaks = peaks_of(seen, free)
    found = weighed(seen, peaks, DRAWS[0])
    return found if found.worth >= WORTH else weighed(seen, peaks, DRAWS[1])


def weighed(seen: SeenDecay, peaks: Peaks, draws: int, seed: int = 0) -> Draws:
    """Draw from normal approximations, Student's tails, each draw weighed by the posterior."""
    if not np.isfinite(peaks.log).all():
        return Draws(Numbers.of(peaks.numbers), np.zeros(peaks.numbers.shape[1]), -np.inf, 0.0)
    rng, free = np.random.default_rng(seed), [0, 1, 2, 4][: peaks.centre.shape[2]]
    odds = np.exp(peaks.log - peaks.log.max()).ravel()
    ends = np.cumsum(odds) / odds.sum()
    which = np.minimum(np.searchsorted(ends, (np.arange(draws) + 0.5) / draws), odds.size - 1)
    kind, at = np.unravel_index(which, peaks.log.shape)
    size, count = np.sqrt(TAIL / rng.chisquare(TAIL, draws)), len(free)
    normal = rng.normal(size=(draws, count)) * size[:, None]
    root = np.linalg.cholesky(np.linalg.inv(peaks.precision))[kind, at]
    numbers = peaks.numbers[:, at]
    numbers[free] = (peaks.centre[kind, at] + np.einsum("dpq,dq->dp", root, normal)).T
    given = gammaln((TAIL + count) / 2) - gammaln(TAIL / 2) - 0.5 * count * np.log(np.pi * TAIL)
    given = given - np.log(np.einsum("dpp->dp", root)).sum(1)
    given = given - 0.5 * (TAIL + count) * np.log1p(np.sum(normal**2, 1) / TAIL)
    named = Numbers.of(numbers)
    away = named.currents(seen.gas) - seen.origin
    products = seen.products
    beside = np.vstack([-np.ones(draws), away])
    squares = np.empty(draws)
    # Draws of one noise follow each other: one product of matrices.
    ends = np.searchsorted(kind, np.arange(len(products.matrix) + 1))
    for matrix, first, last in zip(products.matrix, ends[:-1], ends[1:], strict=True):
        some = beside[:, first:last]
        squares[first:last] = np.sum(some * (matrix @ some), axis=0)
    log = products.log_prior[kind] + products.log_size(np.maximum(squares, 1e-30))
    log = log + np.log(named.level * named.rate * named.unit) + log_prior(named.power)[0]
    if 4 in free:
        log = log - 0.5 * (named.drift / DRIFT) ** 2 - np.log(DRIFT * np.sqrt(2 * np.pi))
    inside = (named.share >= seen.share[0]) & (named.share <= seen.share[1])
    log = log - np.log(seen.share[1] - seen.share[0])
    log = np.where(inside, log - given - np.log(odds[which] / odds.sum()), -np.inf)
    if not inside.any():
        return Draws(named, np.zeros(draws), -np.inf, 0.0)
    weight = np.exp(log - logsumexp(log))
    spacing = float(np.diff(peaks.numbers[3])[0]) if peaks.log.shape[1] > 1 else 1.0
    whole = float(logsumexp(log)) - np.log(draws) + np.log(spacing)
    return Draws(named, weight, whole, float(1 / np.sum(weight**2)))


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
    values: np.ndarray, weight: np.ndarray, unit: str, bounds: tuple[bool, bool] = (False, False)
) -> Quantity:
    """Median, half of the central 68 % and the 95 % of weighted draws; where a bound below or above
    is not excluded the interval reaches to it.
    """
    ends = {(False, False): (0.025, 0.975), (True, False): (0.0, 0.95)}
    ends |= {(False, True): (0.05, 0.999), (True, True): (0.0, 0.999)}
    at = np.array([0.5, 0.1587, 0.8413, *ends[bounds]])
    middle, less, more, low, high = map(float, quantiles(values, weight, at))
    interval = 0.0 if bounds[0] else low, high
    return Quantity(middle, (more - less) / 2, unit, None, interval)


@dataclass(frozen=True)
class FreeLaw:
    """Posterior of a record whose law and noise are not certain.

    Parameters
    ----------
    quantities : mapping of str to Quantity
        I0, a, b and the lifetimes at the start, the end and the mean current.
    exponent : Quantity
        g in a(I) proportional to I^g, with its prior.
    drift : Quantity or None
        Change of b over the record as a share of it, with its prior; None where a gauge tells it.
    constant : float
        Probability of constant a and b, at even odds with the free law.
    odd : float
        Probability that the exponent is none of a bunch's length.
    """

    quantities: Mapping[str, Quantity]
    exponent: Quantity
    drift: Quantity | None
    constant: float
    odd: float

    def to_json(self) -> dict[str, object]:
        """Return the exponent, the drift and the probability of constant a and b."""
        told = {"exponent": self.exponent, "drift": self.drift}
        return told | {"probability_of_constant_a_and_b": self.constant}


def _at_bounds(share: np.ndarray, weight: np.ndarray) -> tuple[bool, bool]:
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
    draws = drawn(seen, [0, 1, 2, 3, 4] if seen.drifts else [0, 1, 2, 3])
    if draws.worth < WORTH / 4:
        return None
    plain = drawn(seen, [0, 1, 2])
    if not 0 <= values.share <= 1:
        rival = drawn(replace(seen, share=NO_BEAM), [0, 1, 2])
        if rival.log + np.log(UNPHYSICAL) > draws.log:
            return None
    usual, odd = log_prior(draws.numbers.power)
    bounds = _at_bounds(draws.numbers.share, draws.weight)
    ends = {"a": bounds, "b": bounds[::-1]}
    found = {
        name: quantity_of(values, draws.weight, UNITS[name], ends.get(name, (False, False)))
        for name, values in _quoted(record, seen, draws.numbers).items()
    }
    power, drift = (quantity_of(values, draws.weight, "1") for values in draws.numbers[3:5])
    return FreeLaw(
        found, power, drift if seen.drifts else None,
        float(1 / (1 + np.exp(draws.log - plain.log))), float(draws.weight @ np.exp(odd - usual)),
    )  # fmt: skip


def rates_of(a, b, power, drift, x, seen: SeenDecay):
    """Loss rates at the first and last reading and at the mean current, where x are the currents at
    the nodes; in the unit of b, and of a at the mean current.
    """
    first, last = (
        a * x[k] ** (1 + power) + b * pressure * (1 + drift * (NODE[k] - 0.5))
        for k, pressure in zip((0, -1), seen.ends, strict=True)
    )
    return first, last, a + b * (1 + drift * (seen.middle - 0.5))


def _quoted(record: DecayRecord, seen: SeenDecay, found: Numbers) -> dict[str, np.ndarray]:
    """Quoted quantities, by draw."""
    span, mean = record.span, float(record.current.mean())
    a, b = found.share * found.rate, (1 - found.share) * found.rate
    rates = rates_of(a, b, found.power, found.drift, found.currents(seen.gas), seen)
    quoted = {"i0": found.level * mean, "a": a / mean / span, "b": b / span}
    ends = zip(("start", "end", "mean"), rates, strict=True)
    return quoted | {f"lifetime_{at}": span / rate / HOUR for at, rate in ends}
