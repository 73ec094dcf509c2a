"""Noise of decays beside first principles: they scatter from fill to fill, one may be odd.

What a decay says has its own errors and that of its pressure reading. Orbit, coupling, fill pattern
and gas change from fill to fill besides: a and b scatter by shares that nobody knows. Their sizes
are averaged over, one decay may follow nothing, and models that depart from first principles
otherwise are compared with the same noise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.optimize import brentq, lsq_linear
from scipy.special import logsumexp, ndtr

from beamfit.greybox.covariance import Spread, directions
from beamfit.quantity import Quantity
from beamfit.statistics import CENTRAL, WIDE

# One ring in five repeats its fills; of others a, b or both scatter, as often, flat in the
# logarithm from what no ring does better to what would no more be one ring; sizes looked at.
EVEN, SIZES = 0.2, np.geomspace(1e-3, 0.3, 13)
# A decay is odd, such as by a burst of gas or a wrong setting, as often, and then by as much.
ODD, FAR = 0.02, 0.3
# Departures from first principles, as often: the RF voltage is not what is read, or a and b depart
# smoothly with the settings. By a share of the voltage, and of a and b over half a range.
RIVALS = {"rf_voltage": 0.1, "settings": 0.05}
BY = {"rf_voltage": 0.02, "settings": 0.1}
# An input that hardly moves tells nothing: half a range, of MV or logarithms.
SHORTEST = 0.05
# Noises less likely than the likeliest by this factor are left out.
LEAST = 1e-3
# Rounding of normal equations with columns of unit length.
ROUNDING = 1e-14


@dataclass(frozen=True, eq=False)
class FillNoise:
    """Noises that decays may have, with their weight, and the scales that each leads to.

    Parameters
    ----------
    models : tuple of str
        Names of the departures from first principles that are compared.
    weight, prior : array, shape (k,)
        Probability, and logarithm of that before the decays.
    model : array, shape (k,)
        Index of the model: 0 for first principles, then `models`.
    scatter : array, shape (k, 2)
        Standard deviation of ln a and ln b from fill to fill.
    odd : array, shape (k,)
        The odd decay, -1 if none is.
    columns : tuple of array, shape (n, 2, m)
        Changes of ln a and ln b by the numbers of each model, which are normal of width 1.
    shift : array, shape (k, p)
        Of the scales from those about which all is linear.
    half : array, shape (k, p, r)
        Root of their covariance.
    """

    models: tuple[str, ...]
    weight: np.ndarray
    prior: np.ndarray
    model: np.ndarray
    scatter: np.ndarray
    odd: np.ndarray
    columns: tuple[np.ndarray, ...]
    shift: np.ndarray
    half: np.ndarray

    @property
    def likeliest(self) -> int:
        """Index of the likeliest noise."""
        return int(np.argmax(self.weight))

    @cached_property
    def probabilities(self) -> np.ndarray:
        """Probability of each model, shape (models,)."""
        return np.bincount(self.model, self.weight, len(self.columns))

    @property
    def model_name(self) -> str | None:
        """The likeliest model; None for first principles."""
        return (None, *self.models)[int(np.argmax(self.probabilities))]

    @cached_property
    def centre(self) -> np.ndarray:
        """Shift of the scales by the likeliest model, its noise averaged over."""
        weight = self.weight * (self.model == np.argmax(self.probabilities))
        return weight @ self.shift / weight.sum()

    def sizes(self, k: int, count: int) -> np.ndarray:
        """Scatter of ln a and ln b of each decay by one of the noises, shape (count, 2)."""
        found = np.tile(self.scatter[k], (count, 1))
        if self.odd[k] >= 0:
            found[self.odd[k]] = np.hypot(found[self.odd[k]], FAR)
        return found

    def spread(self, about: Spread) -> Spread:
        """The spread of the scales over all noises, open where that of their own errors is."""
        root = np.sqrt(self.weight)[:, None, None]
        apart = (self.shift - self.centre)[:, :, None]
        half = np.concatenate([root * self.half, root * apart], axis=2)
        return about._replace(half=np.hstack(list(half)))

    def quantity(self, about: float, number: int, raw: float) -> Quantity:
        """A scale: half of the central 68 % and the central 95 % of all noises."""
        middle = about + self.shift[:, number]
        error = np.linalg.norm(self.half[:, number], axis=1)
        ends = quantiles(self.weight, middle, error, (*CENTRAL, *WIDE))
        value = max(about + float(self.centre[number]), 0.0)
        return Quantity(value, (ends[1] - ends[0]) / 2, "1", raw, (ends[2], ends[3]))


def quantiles(
    weight: np.ndarray, middle: np.ndarray, error: np.ndarray, at: Sequence[float]
) -> list[float]:
    """Quantiles of a mixture of normal distributions.

    Examples
    --------
    >>> one = np.ones(1)
    >>> [round(each, 2) for each in quantiles(one, 5 * one, 2 * one, (0.025, 0.5))]
    [1.08, 5.0]
    """
    if not np.any(error > 0):
        return [float(weight @ middle)] * len(at)
    middle, error, weight = middle[weight > 0], error[weight > 0], weight[weight > 0]
    low, high = (middle - 9 * error).min(), (middle + 9 * error).max()
    safe = np.maximum(error, 1e-12 * (high - low))

    def below(x: float, share: float) -> float:
        return float(weight @ ndtr((x - middle) / safe)) - share

    return [float(brentq(below, low, high, (share,), xtol=1e-9 * (high - low))) for share in at]


def log_likelihood(off: Array, change: Array, sizes: Array, columns: Array) -> Array:
    """Log likelihood of residuals in units of their errors beside a scatter, without constants.

    Parameters
    ----------
    off : array, shape (n, 2)
        Residuals of unit errors.
    change : array, shape (n, 2, 2)
        Their slopes by ln a and ln b.
    sizes : array, shape (n, 2)
        Scatter of ln a and ln b.
    columns : array, shape (n, 2, m)
        Slopes of the residuals by further numbers, which are normal of width 1.

    Notes
    -----
    Of two numbers the covariance C = 1 + s² l lᵀ + t² m mᵀ has the determinant
    1 + s² l² + t² m² + s² t² (l × m)², and uᵀ C⁻¹ v times that is u·v + s² (l × u)(l × v) +
    t² (m × u)(m × v): nothing cancels, however small errors are.
    """
    rows = jnp.concatenate([columns, off[..., None]], axis=-1)
    factor, volume = _inverse(change, jnp.square(sizes))
    parts = jnp.stack([rows[:, 0], rows[:, 1], *_crossed(change, rows)])
    rest = jnp.einsum("cn,cni,cnj->ij", factor, parts, parts)
    # Elimination of the further numbers, one after the other; LAPACK is slow on many so small.
    for k in range(columns.shape[-1]):
        pivot = 1 + rest[k, k]
        rest = rest - jnp.outer(rest[k], rest[k]) / pivot
        volume = volume + jnp.log(pivot)
    return -0.5 * (volume + rest[-1, -1])


def _crossed(change: Array, rows: Array) -> list[Array]:
    """Cross products of both columns of (n, 2, 2) with rows (n, 2, q)."""
    return [change[:, 0, k, None] * rows[:, 1] - change[:, 1, k, None] * rows[:, 0] for k in (0, 1)]


def _inverse(change: Array, squares: Array) -> tuple[Array, Array]:
    """Factors of the four products of `log_likelihood`, (4, ..., n), and the log determinant."""
    length = (change**2).sum(axis=-2)
    cross = change[:, 0, 0] * change[:, 1, 1] - change[:, 0, 1] * change[:, 1, 0]
    a, b = squares[..., 0], squares[..., 1]
    determinant = 1 + a * length[:, 0] + b * length[:, 1] + a * b * cross**2
    xp = jnp if isinstance(determinant, Array) else np
    one = 1 / determinant
    return xp.stack([one, one, a * one, b * one]), xp.log(determinant).sum(axis=-1)


class LinearDecays(NamedTuple):
    """Decays linear in the scales.

    Attributes
    ----------
    off : array, shape (n, 2)
        Model minus measurement by their own errors and those of the pressure.
    rows : array, shape (n, 2, p)
        Slopes by the scales.
    change : array, shape (n, 2, 2)
        Slopes by ln a and ln b.
    prior_off, prior_rows : array, shape (q,) and (q, p)
        Those of the priors.
    """

    off: np.ndarray
    rows: np.ndarray
    change: np.ndarray
    prior_off: np.ndarray
    prior_rows: np.ndarray


def compared(linear: LinearDecays, models: Mapping[str, np.ndarray], room: np.ndarray) -> FillNoise:
    """Weigh noises and models by their evidence, the scales integrated out.

    Parameters
    ----------
    linear : LinearDecays
        The decays.
    models : mapping of str to array, shape (n, 2, m)
        Changes of ln a and ln b by the numbers of each model of `RIVALS`.
    room : array, shape (2, p)
        How far the scales may move down and up.
    """
    whole = np.vstack([linear.rows.reshape(-1, room.shape[1]), linear.prior_rows])
    # Directions of the scales that decays see, in units of their error without scatter.
    half, *_ = directions(whole)
    seen = (whole @ half).T @ whole
    shares = np.array([0.0, *SIZES])
    each = (1 - EVEN) / 3 / np.where(shares > 0, SIZES.size, 1.0)
    usual = np.outer(each, each / each[0])
    usual[0, 0] = EVEN
    usual = np.log(usual)
    count = len(linear.off)
    odds = np.log(np.append(1.0, np.full(count, ODD)) / (1 + ODD * count))
    columns = (np.zeros((count, 2, 0)), *models.values())
    beside = np.array([RIVALS[name] for name in models])
    before = np.log([1 - beside.sum(), *beside])
    found = []
    for number, more in enumerate(columns):
        for i, a in enumerate(shares):
            scatter = np.column_stack([np.full(shares.size, a), shares])
            log, systems = _evidence(linear, half, more, scatter)
            prior = before[number] + usual[i][:, None] + odds
            found.append((log + prior, prior, number, scatter, systems))
    best = max(float(each[0].max()) for each in found)
    kept = []
    for log, prior, number, scatter, systems in found:
        for j, k in np.argwhere(log > best + np.log(LEAST)):
            kept.append((log[j, k], prior[j, k], number, scatter[j], k - 1, systems[j, k]))
    log, prior, number, scatter, odd, systems = zip(*kept, strict=True)
    solved = [_scales(system, half, seen, room) for system in systems]
    shift, halves = map(np.array, zip(*solved, strict=True))
    return FillNoise(
        models=tuple(models),
        weight=np.exp(np.array(log) - logsumexp(log)),
        prior=np.array(prior),
        model=np.array(number),
        scatter=np.array(scatter),
        odd=np.array(odd),
        columns=columns,
        shift=shift,
        half=halves,
    )


def _evidence(
    linear: LinearDecays, half: np.ndarray, more: np.ndarray, scatter: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Log evidence (g, n + 1) of scatters, no decay being odd or each, and their normal equations
    for what is seen of the scales, further numbers and, last, residuals.
    """
    rows = np.concatenate([linear.rows @ half, linear.change @ more, linear.off[..., None]], axis=2)
    parts = np.stack([rows[:, 0], rows[:, 1], *_crossed(linear.change, rows)])
    products = np.einsum("cni,cnj->cnij", parts, parts)
    factor, volume = _inverse(linear.change, np.square(scatter)[:, None, :])
    strange = np.square(scatter)[:, None, :] + FAR**2
    odd, _ = _inverse(linear.change, strange)
    # The determinant of each decay: usual and odd.
    change = np.log(factor[0]) - np.log(odd[0])
    known = np.hstack([linear.prior_rows @ half, np.zeros((len(linear.prior_off), more.shape[2])),
                       linear.prior_off[:, None]])  # fmt: skip
    free = half.shape[1]
    own = np.append(np.zeros(free), np.ones(more.shape[2] + 1))
    whole = np.tensordot(np.moveaxis(factor, 0, -1), np.moveaxis(products, 0, 1), ([1, 2], [0, 1]))
    whole = whole + known.T @ known + np.diag(own)
    each = np.einsum("cgn,cnij->gnij", odd - factor, products)
    systems = np.concatenate([whole[:, None], whole[:, None] + each], axis=1)
    size = np.sqrt(np.diagonal(systems, axis1=-2, axis2=-1))
    scaled = systems / (size[..., :, None] * size[..., None, :])
    root = np.linalg.cholesky(scaled + ROUNDING * np.eye(scaled.shape[-1]))
    diagonal = np.diagonal(root, axis1=-2, axis2=-1) * size
    log = -0.5 * volume[:, None] - np.log(diagonal[..., :-1]).sum(-1) - 0.5 * diagonal[..., -1] ** 2
    log[:, 1:] -= 0.5 * change
    return log, systems


def _scales(
    products: np.ndarray, half: np.ndarray, seen: np.ndarray, room: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Shift of the scales and root of their covariance, by normal equations."""
    free, size = half.shape[1], np.sqrt(np.diag(products))
    scaled = products / np.outer(size, size) + ROUNDING * np.eye(len(size))
    inverse = np.linalg.inv(scaled[:-1, :-1]) / np.outer(size[:-1], size[:-1])
    found = -inverse @ products[:-1, -1]
    own = np.linalg.cholesky(inverse[:free, :free])
    shift = half @ found[:free]
    if np.any((shift < room[0]) | (shift > room[1])):
        rows = np.linalg.solve(own, seen)
        shift = lsq_linear(rows, rows @ shift, room, method="bvls").x
    return shift, half @ own
