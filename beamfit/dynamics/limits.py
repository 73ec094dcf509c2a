"""Posterior over the longest lag of a response, from zero to infinity.

A run of 100 s does not distinguish a lag of 1e7 s from an integrator with the same K/tau. Linear
errors do not show that, since the output is nonlinear in the lag: the evidence is computed on a
grid of lags.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri, stdtrit

from beamfit.dynamics.alternatives import (
    CORRELATION_TIMES,
    WHITE_RATIOS,
    average_over_noises,
    repeat_for_noises,
)
from beamfit.dynamics.response import ARX, FIRST_ORDER
from beamfit.dynamics.search import (
    MAX_NOISE_READINGS,
    RunsFit,
    difference_coefficients,
    linear_columns,
    noise_grid,
    shape_parameters,
)
from beamfit.noise.correlated import roots_by_each
from beamfit.statistics import POOR_FIT

# Range of time constants, from shares of an interval to multiples of a run: beyond it no data
# distinguish them from zero and from infinity.
LAG_RANGE = (1e-3, 1e3)
# Lags of the grid, and rounds that add as many where the posterior lies. Chosen.
GRID_LAGS = 24
REFINEMENTS = 4
# Candidates for the shorter lag of a second order, and rounds that narrow them. Chosen.
SECOND_LAGS = 8
SECOND_LAG_ROUNDS = 3
# Probability of a one-sided limit.
ONE_SIDED = 0.95
# At every lag the output is linear in the delay within this many errors of it, and within the
# standard deviation of a flat distribution over one row.
DELAY_RANGE = 3.0
ROW_DEVIATION = 12**-0.5
# Draws of the posterior, at evenly spaced quantiles.
POSTERIOR_DRAWS = 2000


class LagPosterior(NamedTuple):
    """Posterior over the longest lag, with a flat prior in its logarithm.

    Attributes
    ----------
    lag, log : array, shape (g,)
        Increasing logarithms of lags, and the log evidence of each.
    mean, error : array, shape (g, q)
        Gains and, last, the offset with each lag.
    dof : int
        Degrees of freedom.
    best : float
        Highest log evidence, that of the fit included.
    """

    lag: np.ndarray
    log: np.ndarray
    mean: np.ndarray
    error: np.ndarray
    dof: int
    best: float = 0.0

    def quantiles(self, at: np.ndarray) -> np.ndarray:
        """Give the logarithms of the lags at quantiles."""
        density = np.exp(self.log - self.log.max())
        below = np.cumsum((density[1:] + density[:-1]) * np.diff(self.lag))
        return np.interp(at * below[-1], np.append(0.0, below), self.lag)

    def draws(self, gains: Sequence[str]) -> dict[str, np.ndarray]:
        """Draw the lag, s, the gains, their ratios to the lag, and the offset, by name."""
        probability = (np.arange(POSTERIOR_DRAWS) + 0.5) / POSTERIOR_DRAWS
        lag, deviation = self.quantiles(probability), stdtrit(self.dof, probability)
        deviation = np.random.default_rng(0).permutation(deviation)
        nearest = np.searchsorted(0.5 * (self.lag[1:] + self.lag[:-1]), lag)
        numbers = self.mean[nearest] + deviation[:, None] * self.error[nearest]
        draws = {"tau": np.exp(lag), **dict(zip([*gains, "offset"], numbers.T, strict=False))}
        return draws | {f"{name}/tau": draws[name] / np.exp(self.lag[nearest]) for name in gains}

    def limits(self, delay_error: float) -> tuple[float, float]:
        """Give the one-sided 95 % limits of the lag, s; 0 and infinity where these are not refuted.

        They are refuted by an evidence far below the best one: where they are merely less probable,
        an error would say nothing. `delay_error` is that of the delay, s, since a shorter delay
        looks like a longer lag.
        """
        rise = self.dof * np.log1p(stdtrit(self.dof, 1.0 - 0.5 * POOR_FIT) ** 2 / self.dof)
        zero, infinite = 2.0 * (self.best - self.log[[0, -1]]) <= rise
        low, high = np.exp(self.quantiles(np.array([1.0 - ONE_SIDED, ONE_SIDED]))).tolist()
        high = float(np.hypot(high, ndtri(ONE_SIDED) * delay_error))
        return 0.0 if zero else low, np.inf if infinite else high


def lag_posterior(runs_fit: RunsFit, offset: bool) -> LagPosterior:
    """Compute the posterior over the longest lag.

    Further rounds add lags of a first order where the posterior lies. A higher order has its other
    lag at its best value. Linear numbers, the fraction of a sample in the delay, and the noise are
    integrated out. `MAX_NOISE_READINGS` readings of each run count.
    """
    prepared = runs_fit.prepared
    lag_limits = np.log(np.multiply(LAG_RANGE, (prepared.interval, prepared.duration)))
    fitted = shape_parameters(prepared, runs_fit.fit.model)
    first_order = prepared.runs[0].physics is FIRST_ORDER
    grid = np.linspace(*lag_limits, GRID_LAGS)
    if first_order:
        grid[1:] = np.sort(np.append(grid[2:], np.clip(np.log(fitted), *lag_limits)))
    found = LagPosterior(grid, *_evidence_at(runs_fit, offset, grid, lag_limits[0]))
    for _ in range(REFINEMENTS if first_order else 0):
        grid = found.quantiles((np.arange(GRID_LAGS) + 0.5) / GRID_LAGS)
        added = grid, *_evidence_at(runs_fit, offset, grid, lag_limits[0])[:3]
        joined = [np.concatenate(pair) for pair in zip(found[:4], added, strict=True)]
        order = np.unique(joined[0], return_index=True)[1]
        found = LagPosterior(*(each[order] for each in joined), found.dof)
    at_fit = found.log if first_order else _weigh_shapes(runs_fit, offset, fitted[None])[0]
    return found._replace(best=max(found.log.max(), at_fit.max()))


def _evidence_at(
    runs_fit: RunsFit, offset: bool, lag: np.ndarray, shortest: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Give log evidence, gains, their errors and the degrees of freedom at logarithms of lags."""
    physics = runs_fit.prepared.runs[0].physics
    if physics is FIRST_ORDER:
        return _weigh_shapes(runs_fit, offset, np.exp(lag)[:, None])
    low, high, every = np.full(len(lag), shortest), lag, np.arange(len(lag))
    for _ in range(SECOND_LAG_ROUNDS):
        other = np.linspace(low, high, SECOND_LAGS)
        time = np.exp(0.5 * (lag + other))
        shapes = np.stack([time, np.cosh(0.5 * (lag - other))], axis=-1).reshape(-1, 2)
        if physics is ARX:
            shapes = difference_coefficients(shapes, runs_fit.prepared.interval)
        *each, dof = _weigh_shapes(runs_fit, offset, shapes)
        each = [one.reshape(SECOND_LAGS, len(lag), *one.shape[1:]) for one in each]
        best = each[0].argmax(axis=0)
        low = other[np.maximum(best - 1, 0), every]
        high = other[np.minimum(best + 1, SECOND_LAGS - 1), every]
    log, mean, error = (one[best, every] for one in each)
    return log, mean, error, dof


def _weigh_shapes(
    runs_fit: RunsFit, offset: bool, shapes: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Give the same as `_evidence_at` for shapes as of `unit_outputs`."""
    prepared, slopes = runs_fit.prepared, runs_fit.slopes()
    is_delay = np.array([v.name == "late" for v in runs_fit.fit.variables])
    is_delay &= np.any(np.concatenate(slopes), axis=0) & (runs_fit.errors is not None)
    late = runs_fit.fit.model["late"]
    runs = [replace(run.up_to(MAX_NOISE_READINGS), delay_fraction=run.delay_fraction + late)
            for run in prepared.runs]  # fmt: skip
    rows = []
    for i, (y, slope) in enumerate(zip(prepared.measured, slopes, strict=True)):
        own = np.column_stack([slope[:, is_delay], y])[:MAX_NOISE_READINGS]
        columns = np.asarray(linear_columns(runs, i, shapes, offset))[:, : len(own)]
        own = np.broadcast_to(own, (len(shapes), *own.shape))
        each = runs_fit.noise[i][0].each[:MAX_NOISE_READINGS, None]
        rows.append(np.concatenate([columns, own], axis=2) / each)
    prior = np.zeros((0, rows[0].shape[2]))
    if is_delay.any():
        prior = np.eye(rows[0].shape[2])[-2:-1]
        prior /= np.minimum(
            DELAY_RANGE * runs_fit.errors.moments(np.eye(len(is_delay))[is_delay]).error,
            ROW_DEVIATION,
        )
    rows.append(np.broadcast_to(prior, (len(shapes), *prior.shape)))
    basis, own = np.linalg.qr(np.concatenate(rows, axis=1))
    # Columns of the rows from columns of the basis.
    from_basis = np.broadcast_to(np.eye(own.shape[1]), own.shape).copy()
    from_basis[..., -1] = own[..., -1]
    times = [t[:MAX_NOISE_READINGS] for t in prepared.time]
    grid = noise_grid(prepared.time, CORRELATION_TIMES, WHITE_RATIOS)
    *parts, prior_part = np.split(basis, np.cumsum(list(map(len, times))), axis=1)
    triangles, volume = [np.tile(prior_part @ from_basis, (len(grid), 1, 1, 1))], 0.0
    for part, time in zip(parts, times, strict=True):
        root, each = roots_by_each(grid, np.swapaxes(part, 0, 1), np.diff(time))
        triangles, volume = [*triangles, root @ from_basis], volume + each
    white = repeat_for_noises(grid, np.concatenate(triangles, axis=2), volume, basis.shape[1])
    log, step, spread, dof = average_over_noises(white, len(grid))
    inverse = np.linalg.pinv(own[:, :-1, :-1])
    wanted = [
        *range(len(prepared.inputs)),
        *([own.shape[1] - 2 - is_delay.sum()] if offset else []),
    ]
    inverse = inverse[:, wanted]
    variance = np.einsum("gqa,gab,gqb->gq", inverse, spread, inverse)
    return log, -np.einsum("gqa,ga->gq", inverse, step), np.sqrt(variance), dof
