"""Time constants that runs do not tell from infinity, or from zero.

A run of 100 s does not tell a lag of 1e7 s from an integrator with the same K/tau. Linear errors
say nothing of it, since the output bends with the lag: the evidence is compared at the limits.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.stats import t as student

from beamfit.dynamics.alternatives import CORRELATION_TIMES, WHITE
from beamfit.dynamics.model import PreparedOutput
from beamfit.dynamics.response import ARX, FIRST_ORDER
from beamfit.dynamics.search import (
    LONGEST,
    Settled,
    difference,
    linear_columns,
    noises_of,
    shape_of,
)
from beamfit.noise.correlated import Whitened, whitened_by_each
from beamfit.statistics import POOR_FIT

# Range of time constants, in intervals and in runs, beyond which nothing tells them from zero and
# from infinity.
RANGE = (1e-3, 1e3)
# Other lags that are tried beside one that is given, and rounds of them, each about the best.
OTHERS, ROUNDS = 8, 3
# Quantile at the upper end of a one-sided 95 %.
SINGLE_END = 0.95


class LagLimits(NamedTuple):
    """Limits that the longest lag is compatible with.

    Attributes
    ----------
    above : float or None
        The lag is larger than this, s (95 %), and nothing tells it from infinity.
    below : float or None
        It is smaller than this, s (95 %), and nothing tells it from zero.
    """

    above: float | None
    below: float | None

    @property
    def interval(self) -> tuple[float, float] | None:
        """The one-sided 95 %; None where both limits, or none, are possible."""
        if (self.above is None) == (self.below is None):
            return None
        return (0.0, self.below) if self.above is None else (self.above, np.inf)


class _Lags(NamedTuple):
    """Evidence by the longest lag: the other lag at its best, all that is linear integrated out."""

    seen: PreparedOutput
    found: Settled
    offset: bool

    @property
    def own(self) -> np.ndarray:
        """Lags, or poles, that the fit found, as of `unit_outputs`."""
        return shape_of(self.seen, self.found.fit.model)

    def whitened(self, shape: np.ndarray) -> Whitened:
        """A basis of what gains, first states and offset do, and the readings, by each noise."""
        model, parts = self.found.fit.model, []
        runs = [replace(run, part=run.part + model["late"]) for run in self.seen.runs]
        for i, y in enumerate(self.seen.measured):
            columns = linear_columns(runs, i, jnp.asarray(shape[None]), self.offset)[0]
            part = np.column_stack([np.asarray(columns)[: len(y)], y])
            parts.append((part / self.found.noise[i][0].each[:, None])[:LONGEST])
        time = [each[:LONGEST] for each in self.seen.time]
        both = np.concatenate(parts)
        both[:, :-1] = np.linalg.qr(both[:, :-1])[0]
        rows = np.split(both, np.cumsum([len(each) for each in time])[:-1])
        grid = noises_of(self.seen.time, CORRELATION_TIMES, WHITE)
        return whitened_by_each(grid, list(zip(rows, time, strict=True)))

    def evidence(self, lag: float, other: float) -> float:
        """-2 ln of the evidence of two lags; a first order has the one."""
        physics, time = self.seen.runs[0].physics, np.sqrt(lag * other)
        shape = np.array([time, 0.5 * (lag + other) / time])
        if physics is FIRST_ORDER:
            shape = np.array([lag])
        elif physics is ARX:
            (shape,) = difference(shape[None], self.seen.apart)
        return self.whitened(shape).evidence()

    def least(self, lag: float) -> float:
        """The same of the longest lag, the other one at its best."""
        if self.seen.runs[0].physics is FIRST_ORDER:
            return self.evidence(lag, lag)
        ends = np.log([RANGE[0] * self.seen.apart, lag])
        for _ in range(ROUNDS):
            tried = np.linspace(*ends, OTHERS)
            told = [self.evidence(lag, other) for other in np.exp(tried)]
            around = tried[np.argmin(told)] + np.array([-1, 1]) * (tried[1] - tried[0])
            ends = np.clip(around, *ends)
        return float(min(told))

    def rise(self, end: float) -> float:
        """Rise of -2 ln of the evidence up to a quantile, by Student's distribution."""
        white = self.whitened(self.own)
        dof = max(white.count - white.triangle.shape[2] + 1 - len(self.own), 1)
        return dof * float(np.log1p(student.ppf(end, dof) ** 2 / dof))


def lag_limits(seen: PreparedOutput, found: Settled, offset: bool) -> LagLimits:
    """Compare the longest lag of constant parameters with zero and infinity.

    The gain that goes with a lag far beyond the runs is as large, K/tau being the same, and of a
    lag far below a sample nothing is left. A limit is possible unless its evidence, the noise and
    all that is linear integrated out, is so much lower than the best that it is refuted: where a
    limit is as little as likely, the error of a lag says nothing.
    """
    lags = _Lags(seen, found, offset)
    least = lags.whitened(lags.own).evidence()
    ends = np.multiply(RANGE, (seen.apart, seen.span))

    def reached(limit: float, other: float) -> float | None:
        if lags.least(limit) - least > lags.rise(1.0 - 0.5 * POOR_FIT):
            return None
        near, far, most = np.log(limit), np.log(other), lags.rise(SINGLE_END)
        for _ in range(8):
            middle = 0.5 * (near + far)
            inside = lags.least(np.exp(middle)) - least < most
            near, far = (middle, far) if inside else (near, middle)
        return float(np.exp(0.5 * (near + far)))

    return LagLimits(reached(ends[1], ends[0]), reached(ends[0], ends[1]))
