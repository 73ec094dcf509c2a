"""Posterior over the longest lag of a response, from zero to infinity.

A run of 100 s does not tell a lag of 1e7 s from an integrator with the same K/tau. Linear errors
say nothing of it, since the output bends with the lag: the evidence is taken at many lags.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.special import ndtri, stdtrit

from beamfit.dynamics.alternatives import CORRELATION_TIMES, WHITE, by_each, over_noises
from beamfit.dynamics.response import ARX, FIRST_ORDER
from beamfit.dynamics.search import LONGEST, Begun, difference, linear_columns, noises_of, shape_of
from beamfit.noise.correlated import roots_by_each
from beamfit.statistics import POOR_FIT

# Range of time constants, in intervals and in runs, beyond which nothing tells them from zero and
# from infinity.
RANGE = (1e-3, 1e3)
# Lags that are looked at together, and rounds of them; other lags beside each, and rounds of those.
LAGS, CLOSER, OTHERS, ROUNDS = 24, 4, 8, 3
# Quantile at the upper end of a one-sided 95 %.
SINGLE_END = 0.95
# Errors of a delay, and standard deviation of one anywhere in a row, within which the output is
# linear in it beside every lag.
DELAYED, ROW = 3.0, 12**-0.5
# Draws of the posterior, at as many quantiles of it.
DRAWS = 2000


class LagPosterior(NamedTuple):
    """Posterior over the longest lag, flat beforehand in its logarithm.

    Attributes
    ----------
    lag, log : array, shape (g,)
        Logarithms of lags, that grow, and of the evidence of each.
    mean, error : array, shape (g, q)
        Gains and, last, the offset with each.
    dof : int
        Degrees of freedom.
    best : float
        The logarithm at the lags of the fit, or more.
    """

    lag: np.ndarray
    log: np.ndarray
    mean: np.ndarray
    error: np.ndarray
    dof: int
    best: float = 0.0

    def quantiles(self, at: np.ndarray) -> np.ndarray:
        """Logarithms of the lags below which the truth lies with these probabilities."""
        density = np.exp(self.log - self.log.max())
        below = np.cumsum((density[1:] + density[:-1]) * np.diff(self.lag))
        return np.interp(at * below[-1], np.append(0.0, below), self.lag)

    def drawn(self, gains: Sequence[str]) -> dict[str, np.ndarray]:
        """Draws of the lag, s, of gains, of these over it, and of the offset, by name."""
        at = (np.arange(DRAWS) + 0.5) / DRAWS
        lag, away = self.quantiles(at), stdtrit(self.dof, at)
        away = np.random.default_rng(0).permutation(away)
        near = np.searchsorted(0.5 * (self.lag[1:] + self.lag[:-1]), lag)
        numbers = self.mean[near] + away[:, None] * self.error[near]
        found = {"tau": np.exp(lag), **dict(zip([*gains, "offset"], numbers.T, strict=False))}
        return found | {f"{name}/tau": found[name] / np.exp(self.lag[near]) for name in gains}

    def limits(self, late: float) -> tuple[float, float]:
        """Ends of a one-sided 95 %, s; 0 and infinity unless the evidence there is so much lower
        that they are refuted: where they are as little as likely, an error says nothing.

        `late` is the standard deviation of the delay, s: one that is shorter is a longer lag.
        """
        rise = self.dof * np.log1p(stdtrit(self.dof, 1.0 - 0.5 * POOR_FIT) ** 2 / self.dof)
        zero, endless = 2.0 * (self.best - self.log[[0, -1]]) <= rise
        low, high = np.exp(self.quantiles(np.array([1.0 - SINGLE_END, SINGLE_END]))).tolist()
        high = float(np.hypot(high, ndtri(SINGLE_END) * late))
        return 0.0 if zero else low, np.inf if endless else high


def lag_posterior(begun: Begun, offset: bool) -> LagPosterior:
    """Look at lags from zero to infinity, of a first order in each further round where the
    posterior of those before lies.

    A higher order has its other lag at its best. All that is linear, a part of a sample in the
    delay and the noise are integrated out; of each run `LONGEST` readings count.
    """
    seen, ends = begun.seen, np.multiply(RANGE, (begun.seen.apart, begun.seen.span))
    ends, own = np.log(ends), shape_of(seen, begun.settled.fit.model)
    first = seen.runs[0].physics is FIRST_ORDER
    asked = np.linspace(*ends, LAGS)
    if first:
        asked[1:] = np.sort(np.append(asked[2:], np.clip(np.log(own), *ends)))
    found = LagPosterior(asked, *_at(begun, offset, asked, ends[0]))
    for _ in range(CLOSER if first else 0):
        asked = found.quantiles((np.arange(LAGS) + 0.5) / LAGS)
        more = asked, *_at(begun, offset, asked, ends[0])[:3]
        both = [np.concatenate(pair) for pair in zip(found[:4], more, strict=True)]
        order = np.unique(both[0], return_index=True)[1]
        found = LagPosterior(*(each[order] for each in both), found.dof)
    at_fit = found.log if first else _weighed(begun, offset, own[None])[0]
    return found._replace(best=max(found.log.max(), at_fit.max()))


def _at(
    begun: Begun, offset: bool, lag: np.ndarray, least: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Log evidence, numbers and their errors at logarithms of lags, and degrees of freedom."""
    physics = begun.seen.runs[0].physics
    if physics is FIRST_ORDER:
        return _weighed(begun, offset, np.exp(lag)[:, None])
    low, high, every = np.full(len(lag), least), lag, np.arange(len(lag))
    for _ in range(ROUNDS):
        other = np.linspace(low, high, OTHERS)
        time = np.exp(0.5 * (lag + other))
        shapes = np.stack([time, np.cosh(0.5 * (lag - other))], axis=-1).reshape(-1, 2)
        shapes = difference(shapes, begun.seen.apart) if physics is ARX else shapes
        *each, dof = _weighed(begun, offset, shapes)
        each = [one.reshape(OTHERS, len(lag), *one.shape[1:]) for one in each]
        best = each[0].argmax(axis=0)
        low = other[np.maximum(best - 1, 0), every]
        high = other[np.minimum(best + 1, OTHERS - 1), every]
    log, mean, error = (one[best, every] for one in each)
    return log, mean, error, dof


def _weighed(
    begun: Begun, offset: bool, shapes: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """The same by lags, or poles, as of `unit_outputs`."""
    seen, found, slopes = begun.seen, begun.settled, begun.settled.slopes(begun.case)
    late = np.array([v.name == "late" for v in found.fit.variables])
    late &= np.any(np.concatenate(slopes), axis=0) & (found.errors is not None)
    runs = [replace(run, part=run.part + found.fit.model["late"]) for run in seen.runs]
    rows = []
    for i, (y, slope) in enumerate(zip(seen.measured, slopes, strict=True)):
        own = np.column_stack([slope[:, late], y])[:LONGEST]
        columns = np.asarray(linear_columns(runs, i, jnp.asarray(shapes), offset))[:, : len(own)]
        own = np.broadcast_to(own, (len(shapes), *own.shape))
        each = found.noise[i][0].each[:LONGEST, None]
        rows.append(np.concatenate([columns, own], axis=2) / each)
    prior = np.zeros((0, rows[0].shape[2]))
    if late.any():
        prior = np.eye(rows[0].shape[2])[-2:-1]
        prior /= np.minimum(DELAYED * found.errors.moments(np.eye(len(late))[late]).error, ROW)
    rows.append(np.broadcast_to(prior, (len(shapes), *prior.shape)))
    basis, own = np.linalg.qr(np.concatenate(rows, axis=1))
    whole = np.broadcast_to(np.eye(own.shape[1]), own.shape).copy()  # in columns of the basis
    whole[..., -1] = own[..., -1]
    times, grid = [t[:LONGEST] for t in seen.time], noises_of(seen.time, CORRELATION_TIMES, WHITE)
    *parts, known = np.split(basis, np.cumsum(list(map(len, times))), axis=1)
    triangles, volume = [np.tile(known @ whole, (len(grid), 1, 1, 1))], 0.0
    for part, time in zip(parts, times, strict=True):
        root, each = roots_by_each(grid, np.swapaxes(part, 0, 1), np.diff(time))
        triangles, volume = [*triangles, root @ whole], volume + each
    white = by_each(grid, np.concatenate(triangles, axis=2), volume, basis.shape[1])
    log, step, spread, dof = over_noises(white, len(grid))
    inverse = np.linalg.pinv(own[:, :-1, :-1])
    chosen = [*range(len(seen.inputs)), *([own.shape[1] - 2 - late.sum()] if offset else [])]
    inverse = inverse[:, chosen]
    variance = np.einsum("gqa,gab,gqb->gq", inverse, spread, inverse)
    return log, -np.einsum("gqa,ga->gq", inverse, step), np.sqrt(variance), dof
