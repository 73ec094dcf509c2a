"""Noise of decays about first principles: scatter from fill to fill, and one odd decay.

Each decay has its own errors and that of its pressure reading. Orbit, coupling, fill pattern and
gas also change from fill to fill, so a and b scatter by unknown relative amounts. The answer
averages over these amounts and over the possibility that one decay is odd. Other departures from
first principles are compared with the same noise.
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

# Prior probability that fills repeat exactly: one ring in five. Otherwise a, b or both scatter,
# equally probable.
P_REPEATING = 0.2
# Grid of relative scatters, equally probable: from what no ring does better to what would not be
# one ring any more.
SCATTERS = np.geomspace(1e-3, 0.3, 13)
# Prior odds that a given decay is odd, as by a burst of gas or a wrong setting, and the additional
# relative scatter of such a decay.
ODDS_OF_ODD, ODD_SCATTER = 0.02, 0.3
# Prior probabilities of other departures from first principles: the RF voltage differs from its
# reading, or a and b depart smoothly with the settings.
MODEL_PRIORS = {"rf_voltage": 0.1, "settings": 0.05}
# Their standard deviations: relative, of the voltage (cavity probes are calibrated so well), and of
# a and b over half the range of a setting.
MODEL_SIZES = {"rf_voltage": 0.02, "settings": 0.1}
# Smallest half range of a setting, in MV or of a logarithm, over which a smooth departure is
# considered: a setting that hardly moves determines none.
MIN_HALF_RANGE = 0.05
# Noises are left out below this probability relative to the most probable.
MIN_WEIGHT = 1e-3
# Added to the diagonal of normal equations with columns of unit length: rounding.
ROUNDING = 1e-14


@dataclass(frozen=True, eq=False)
class FillNoise:
    """Mixture of k possible noises of n decays, with the posterior of p scales under each.

    Parameters
    ----------
    models : tuple of str
        Names of the departures from first principles that are compared.
    weight, prior : array, shape (k,)
        Posterior probability, and logarithm of the prior probability.
    model : array, shape (k,)
        Model of each noise: 0 for first principles, then the index in `models` plus 1.
    scatter : array, shape (k, 2)
        Standard deviation of ln a and ln b from fill to fill.
    odd : array, shape (k,)
        Index of the odd decay, -1 for none.
    columns : tuple of array, shape (n, 2, m)
        Changes of ln a and ln b by the m parameters of each model, which are standard normal.
    shift : array, shape (k, p)
        Mean of the scales, from the point of linearisation.
    covariance_root : array, shape (k, p, r)
        Square root of the covariance of the scales.
    """

    models: tuple[str, ...]
    weight: np.ndarray
    prior: np.ndarray
    model: np.ndarray
    scatter: np.ndarray
    odd: np.ndarray
    columns: tuple[np.ndarray, ...]
    shift: np.ndarray
    covariance_root: np.ndarray

    @property
    def most_probable(self) -> int:
        """Index of the most probable noise."""
        return int(np.argmax(self.weight))

    @cached_property
    def probabilities(self) -> np.ndarray:
        """Probability of each model, shape (models,)."""
        return np.bincount(self.model, self.weight, len(self.columns))

    @property
    def model_name(self) -> str | None:
        """Most probable model; None for first principles."""
        return (None, *self.models)[int(np.argmax(self.probabilities))]

    @cached_property
    def centre(self) -> np.ndarray:
        """Mean shift of the scales under the most probable model, averaged over its noises."""
        weight = self.weight * (self.model == np.argmax(self.probabilities))
        return weight @ self.shift / weight.sum()

    def sizes(self, k: int, count: int) -> np.ndarray:
        """Scatter of ln a and ln b of each decay under noise k, shape (count, 2)."""
        found = np.tile(self.scatter[k], (count, 1))
        if self.odd[k] >= 0:
            found[self.odd[k]] = np.hypot(found[self.odd[k]], ODD_SCATTER)
        return found

    def spread(self, about: Spread) -> Spread:
        """Spread of the scales over all noises; open directions are those of `about`."""
        root = np.sqrt(self.weight)[:, None, None]
        deviation = (self.shift - self.centre)[:, :, None]
        half = np.concatenate([root * self.covariance_root, root * deviation], axis=2)
        return about._replace(half=np.hstack(list(half)))

    def quantity(self, about: float, number: int, raw: float) -> Quantity:
        """Scale `number` with half of its central 68 % as error and its central 95 %.

        `about` is its value at the point of linearisation, `raw` its error without scatter.
        """
        middle = about + self.shift[:, number]
        error = np.linalg.norm(self.covariance_root[:, number], axis=1)
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


def log_likelihood(residuals: Array, loss_slopes: Array, sizes: Array, columns: Array) -> Array:
    """Log likelihood of whitened residuals with scatter of a and b, up to a constant.

    Parameters
    ----------
    residuals : array, shape (n, 2)
        Residuals in standard errors.
    loss_slopes : array, shape (n, 2, 2)
        Slopes of the residuals by ln a and ln b.
    sizes : array, shape (n, 2)
        Scatter of ln a and ln b.
    columns : array, shape (n, 2, m)
        Slopes of the residuals by further parameters, which are standard normal.

    Notes
    -----
    The 2 × 2 covariance C = 1 + s² l lᵀ + t² m mᵀ of a decay has the determinant
    D = 1 + s² l² + t² m² + s² t² (l × m)², and D uᵀ C⁻¹ v = u·v + s² (l × u)(l × v) +
    t² (m × u)(m × v). Nothing cancels, however small the errors are.
    """
    rows = jnp.concatenate([columns, residuals[..., None]], axis=-1)
    factor, volume = _inverse_factors(loss_slopes, jnp.square(sizes))
    parts = jnp.stack([rows[:, 0], rows[:, 1], *_cross_products(loss_slopes, rows)])
    products = jnp.einsum("cn,cni,cnj->ij", factor, parts, parts)
    # Eliminate the further parameters one by one: LAPACK is slow on many small matrices.
    for k in range(columns.shape[-1]):
        pivot = 1 + products[k, k]
        products = products - jnp.outer(products[k], products[k]) / pivot
        volume = volume + jnp.log(pivot)
    return -0.5 * (volume + products[-1, -1])


def _cross_products(slopes: Array, rows: Array) -> list[Array]:
    """Cross products of both columns of `slopes`, (n, 2, 2), with rows, (n, 2, q)."""
    return [slopes[:, 0, k, None] * rows[:, 1] - slopes[:, 1, k, None] * rows[:, 0] for k in (0, 1)]


def _inverse_factors(slopes: Array, squares: Array) -> tuple[Array, Array]:
    """Factors of the four products in uᵀ C⁻¹ v, (4, ..., n), and the log determinant of C.

    `squares` are the variances s², t² of ln a and ln b; see `log_likelihood`.
    """
    length = (slopes**2).sum(axis=-2)
    cross = slopes[:, 0, 0] * slopes[:, 1, 1] - slopes[:, 0, 1] * slopes[:, 1, 0]
    a, b = squares[..., 0], squares[..., 1]
    determinant = 1 + a * length[:, 0] + b * length[:, 1] + a * b * cross**2
    xp = jnp if isinstance(determinant, Array) else np
    inverse = 1 / determinant
    return xp.stack([inverse, inverse, a * inverse, b * inverse]), xp.log(determinant).sum(axis=-1)


class LinearDecays(NamedTuple):
    """Residuals of decays and priors, linear in the scales.

    Attributes
    ----------
    residuals : array, shape (n, 2)
        Model minus measurement in standard errors, of the decay and of its pressure reading.
    slopes : array, shape (n, 2, p)
        Slopes of these by the scales.
    loss_slopes : array, shape (n, 2, 2)
        Slopes of these by ln a and ln b.
    prior_residuals, prior_slopes : array, shape (q,) and (q, p)
        Residuals of the priors, and their slopes by the scales.
    """

    residuals: np.ndarray
    slopes: np.ndarray
    loss_slopes: np.ndarray
    prior_residuals: np.ndarray
    prior_slopes: np.ndarray


def weigh_noises(
    linear: LinearDecays, models: Mapping[str, np.ndarray], room: np.ndarray
) -> FillNoise:
    """Weigh noises and models by their evidence, with the scales integrated out.

    Parameters
    ----------
    linear : LinearDecays
        Linearised decays.
    models : mapping of str to array, shape (n, 2, m)
        Changes of ln a and ln b by the parameters of each model of `MODEL_PRIORS`.
    room : array, shape (2, p)
        Lower and upper limit of the shift of each scale.
    """
    jacobian = np.vstack([linear.slopes.reshape(-1, room.shape[1]), linear.prior_slopes])
    # Directions of the scales that the data determine, in units of their error without scatter.
    basis, *_ = directions(jacobian)
    to_basis = (jacobian @ basis).T @ jacobian
    scatters = np.array([0.0, *SCATTERS])
    single_prior = (1 - P_REPEATING) / 3 / np.where(scatters > 0, SCATTERS.size, 1.0)
    scatter_prior = np.outer(single_prior, single_prior / single_prior[0])
    scatter_prior[0, 0] = P_REPEATING
    scatter_prior = np.log(scatter_prior)
    count = len(linear.residuals)
    odds = np.log(np.append(1.0, np.full(count, ODDS_OF_ODD)) / (1 + ODDS_OF_ODD * count))
    columns = (np.zeros((count, 2, 0)), *models.values())
    model_prior = np.array([MODEL_PRIORS[name] for name in models])
    log_model_prior = np.log([1 - model_prior.sum(), *model_prior])
    candidates = []
    for number, changes in enumerate(columns):
        for i, a in enumerate(scatters):
            scatter = np.column_stack([np.full(scatters.size, a), scatters])
            log, systems = _evidence(linear, basis, changes, scatter)
            prior = log_model_prior[number] + scatter_prior[i][:, None] + odds
            candidates.append((log + prior, prior, number, scatter, systems))
    best = max(float(candidate[0].max()) for candidate in candidates)
    kept = []
    for log, prior, number, scatter, systems in candidates:
        for j, k in np.argwhere(log > best + np.log(MIN_WEIGHT)):
            kept.append((log[j, k], prior[j, k], number, scatter[j], k - 1, systems[j, k]))
    log, prior, number, scatter, odd, systems = zip(*kept, strict=True)
    solved = [_solve_scales(system, basis, to_basis, room) for system in systems]
    shift, roots = map(np.array, zip(*solved, strict=True))
    return FillNoise(
        models=tuple(models),
        weight=np.exp(np.array(log) - logsumexp(log)),
        prior=np.array(prior),
        model=np.array(number),
        scatter=np.array(scatter),
        odd=np.array(odd),
        columns=columns,
        shift=shift,
        covariance_root=roots,
    )


def _evidence(
    linear: LinearDecays, basis: np.ndarray, changes: np.ndarray, scatter: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Log evidence, (g, n + 1), of g scatters, with no decay odd or each in turn.

    Also returns the normal equations: determined directions of the scales, parameters of the
    model, and last the residuals.
    """
    slopes, residuals = linear.loss_slopes, linear.residuals[..., None]
    rows = np.concatenate([linear.slopes @ basis, slopes @ changes, residuals], axis=2)
    parts = np.stack([rows[:, 0], rows[:, 1], *_cross_products(slopes, rows)])
    products = np.einsum("cni,cnj->cnij", parts, parts)
    variance = np.square(scatter)[:, None, :]
    factor, volume = _inverse_factors(slopes, variance)
    odd, _ = _inverse_factors(slopes, variance + ODD_SCATTER**2)
    # Change of the log determinant of each decay if it is odd.
    log_det_change = np.log(factor[0]) - np.log(odd[0])
    no_slopes = np.zeros((len(linear.prior_residuals), changes.shape[2]))
    prior_rows = np.hstack(
        [linear.prior_slopes @ basis, no_slopes, linear.prior_residuals[:, None]]
    )
    free = basis.shape[1]
    unit_priors = np.append(np.zeros(free), np.ones(changes.shape[2] + 1))
    regular = np.moveaxis(factor, 0, -1), np.moveaxis(products, 0, 1)
    regular = np.tensordot(*regular, ([1, 2], [0, 1]))
    regular = regular + prior_rows.T @ prior_rows + np.diag(unit_priors)
    odd_difference = np.einsum("cgn,cnij->gnij", odd - factor, products)
    systems = np.concatenate([regular[:, None], regular[:, None] + odd_difference], axis=1)
    scale = np.sqrt(np.diagonal(systems, axis1=-2, axis2=-1))
    scaled = systems / (scale[..., :, None] * scale[..., None, :])
    root = np.linalg.cholesky(scaled + ROUNDING * np.eye(scaled.shape[-1]))
    diagonal = np.diagonal(root, axis1=-2, axis2=-1) * scale
    log = -0.5 * volume[:, None] - np.log(diagonal[..., :-1]).sum(-1) - 0.5 * diagonal[..., -1] ** 2
    log[:, 1:] -= 0.5 * log_det_change
    return log, systems


def _solve_scales(
    products: np.ndarray, basis: np.ndarray, to_basis: np.ndarray, room: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Shift of the scales, within their limits, and square root of their covariance."""
    free, scale = basis.shape[1], np.sqrt(np.diag(products))
    scaled = products / np.outer(scale, scale) + ROUNDING * np.eye(len(scale))
    inverse = np.linalg.inv(scaled[:-1, :-1]) / np.outer(scale[:-1], scale[:-1])
    solution = -inverse @ products[:-1, -1]
    root = np.linalg.cholesky(inverse[:free, :free])
    shift = basis @ solution[:free]
    if np.any((shift < room[0]) | (shift > room[1])):
        rows = np.linalg.solve(root, to_basis)
        shift = lsq_linear(rows, rows @ shift, room, method="bvls").x
    return shift, basis @ root
