"""Bounded least squares from many starts at once; used by every fit of the package.

The method is Levenberg-Marquardt with Moré's column scaling (Moré 1978, Numerical Analysis, LNM
630, 105) and Nielsen's damping (IMM-REP-1999-05). A step solves the damped linear problem by QR and
pins the numbers that would leave their bounds, so that iterates end exactly on a bound; scipy's
bounded methods stay strictly inside, which blurs the verdict "at its bound". All starts take their
steps together: residuals and Jacobians are compiled, the steps are batched NumPy. The triangular
factor of (J, r) at a point serves every damping tried there, by LAPACK's QR of two triangles. Where
the residuals are curved along a step, a second step corrects for this curvature, estimated from the
end of the first (M. K. Transtrum & J. P. Sethna, arXiv:1201.5885, without a further derivative).

For many free numbers a step solves normal equations, sparse where the problem is, with one
refinement (corrected seminormal equations: Å. Björck, Linear Algebra Appl. 88/89 (1987) 31).
This module only proposes points; `beamfit.greybox.assess` decides which of them are optima.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import Array
from scipy.linalg import lapack

from beamfit.greybox.covariance import MAX_DENSE
from beamfit.greybox.problem import Problem, residual, residual_and_jacobian, with_slope
from beamfit.greybox.sparse import (
    RIDGE,
    Factor,
    Pattern,
    Rows,
    in_units,
    lengths,
    pattern_at,
    with_diagonal,
)

# Damping of the first step, relative to the Jacobian's columns scaled to unit length.
FIRST_DAMPING = 1e-3
# A search has come to rest at a step below this share of the numbers, both weighted with the
# lengths of the Jacobian's columns.
STEP_TOLERANCE = 1e-13
# Factor on the damping after an accepted step: from the first after a step along which the
# residuals were linear (D. W. Marquardt, J. SIAM 11 (1963) 431) to the second after one along which
# they were curved and the cost fell as predicted (Nielsen).
MIN_DAMPING_FACTOR, MAX_DAMPING_FACTOR = 1 / 10, 1 / 3
# A damping below the first is rounding; above the second no step, however short, lowers the cost.
MIN_DAMPING, MAX_DAMPING = 1e-30, 1e30
# A predicted decrease below this share of the sum of squares is rounding.
DECREASE_ROUNDING = 1e-16
# A hardly damped step with a predicted decrease below this share of the sum of squares is the last:
# it moves the numbers by 1e-7 of their errors, and its effect is hardly more than rounding.
LAST_DECREASE = 1e-14
# A step is corrected for the curvature of the residuals if the actual decrease is less than this
# share of the predicted one,
MAX_CORRECTED_RATIO = 0.75
# if the correction should regain this share of the difference,
MIN_REGAINED = 0.5
# and if its length is at most this share of the step's (Transtrum and Sethna's condition).
MAX_CORRECTION = 0.375
# Rounds in which a step pins numbers to their bounds; afterwards it is clipped.
MAX_PINNING_ROUNDS = 3
# Block size for LAPACK's QR of two triangles: the fastest for 3 to 400 numbers.
QR_BLOCK = 8
# Points evaluated in one compiled call, if a Jacobian has at most this many entries; else one.
POINTS_PER_CALL, MAX_BATCHED_ENTRIES = 4, 2**15

# Function of the indices of some starts and a point of each, (k, n), that returns residuals (k, m)
# and their Jacobians: an array (k, m, n), or k sparse matrices.
Slopes = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


class Found(NamedTuple):
    """Ends of searches: numbers, half the sums of squares, steps taken, true if at rest."""

    theta: np.ndarray
    cost: np.ndarray
    steps: np.ndarray
    rested: np.ndarray


class TrialSteps(NamedTuple):
    """Ends of trial steps.

    `ratio` is the actual decrease of the cost over the predicted one, `finite` is true where
    residuals and Jacobian are finite.
    """

    theta: np.ndarray
    residual: np.ndarray
    jacobian: np.ndarray
    ratio: np.ndarray
    finite: np.ndarray


class Descent:
    """Searches from several starts, advanced together; arrays have one row for each start.

    `stuck` is true where no step lowers the cost. `steps` counts rejected steps as well.

    Parameters
    ----------
    slopes : callable
        ``slopes(lanes, points)``: residuals and Jacobians at a point of each of some starts.
    points : array, shape (k, n)
        Starting points.
    lower, upper : array, shape (n,)
        Bounds; equal ends hold a number fixed.
    tolerance : float
        Length of a step, relative to the numbers, at which a search rests; both are weighted with
        the lengths of the Jacobian's columns.
    large : bool
        True to solve normal equations instead of QR, for many free numbers.
    """

    def __init__(self, slopes: Slopes, points, lower, upper, tolerance=STEP_TOLERANCE, large=False):
        self.slopes, self.lower, self.upper = slopes, np.asarray(lower), np.asarray(upper)
        self.tolerance, self.large = tolerance, large
        self.upper_triangle = np.tri(self.lower.size + 1).T
        self.theta = np.clip(np.asarray(points, float), lower, upper)
        k = len(self.theta)
        self.residual, self.jacobian = slopes(np.arange(k), self.theta)
        self.right, self.rows = self._reduce(self.residual, self.jacobian)
        self.scale = np.zeros_like(self.theta)
        self.damping, self.growth = np.full(k, FIRST_DAMPING), np.full(k, 2.0)
        self.steps, self.rested = np.zeros(k, int), np.zeros(k, bool)
        self.stuck = ~_finite(self.residual, self.jacobian)

    @property
    def done(self) -> np.ndarray:
        """True for each search that is at rest or stuck."""
        return self.rested | self.stuck

    def _squares(self, lanes: np.ndarray) -> np.ndarray:
        rows = self.residual[lanes]
        return _dot(rows, rows)

    @property
    def cost(self) -> np.ndarray:
        """Half the sum of squares of each search; infinite where a residual is not finite."""
        cost = 0.5 * _dot(self.residual, self.residual)
        return np.where(np.isfinite(cost), cost, np.inf)

    def run(self, lanes: np.ndarray, limit: int, until: float | None = None) -> None:
        """Advance some searches up to a number of steps or a time of `time.perf_counter`."""
        with np.errstate(all="ignore"):
            while until is None or time.perf_counter() < until:
                moving = lanes[~self.done[lanes] & (self.steps[lanes] < limit)]
                if not len(moving):
                    return
                self._advance(moving)

    def _reduce(self, residuals: np.ndarray, jacobians: np.ndarray):
        """Reduce (J, r) to a triangle with the same normal equations, or set these up if many."""
        if self.large:
            rows = np.empty(len(residuals), object)
            rows[:] = [NormalEquations(one) for one in jacobians]
            return residuals, rows
        k, m, n = jacobians.shape
        wide = np.concatenate([jacobians, residuals[..., None]], axis=2)
        rows = np.empty((k, min(m, n + 1), n + 1))
        for lane, one in enumerate(wide):
            rows[lane] = lapack.dgeqrf(one)[0][: n + 1]
        rows *= self.upper_triangle[:m]
        return rows[..., n], rows[..., :n]

    def _advance(self, lanes: np.ndarray) -> None:
        """Try a step of each search; accept or reject it."""
        rows = self.rows[lanes]
        self.scale[lanes] = scale = np.maximum(self.scale[lanes], _lengths(rows))
        points = self._propose(lanes, self.right[lanes], rows)
        theta = self.theta[lanes]
        step = points - theta
        moved = _times(rows, step)
        predicted = -_dot(moved, self.right[lanes] + 0.5 * moved)
        small = _length(scale * step) <= self.tolerance * _length(scale * theta)
        self.rested[lanes] = small
        if small.any():
            lanes, points, predicted = lanes[~small], points[~small], predicted[~small]
        if not len(lanes):
            return
        tried = self._try_steps(lanes, points, predicted)
        curved, points = self._corrections(lanes, tried, predicted)
        if len(curved):
            second = self._try_steps(lanes[curved], points, predicted[curved])
            better = second.ratio > tried.ratio[curved]
            for first, other in zip(tried, second, strict=True):
                first[curved[better]] = other[better]
        self._accept(lanes, tried, predicted)

    def _propose(self, lanes: np.ndarray, right: np.ndarray, rows: np.ndarray) -> np.ndarray:
        step = _step_large if self.large else _step_dense
        at = (self.scale[lanes], self.damping[lanes], self.lower, self.upper)
        return step(self.theta[lanes], right, rows, *at)

    def _try_steps(
        self, lanes: np.ndarray, points: np.ndarray, predicted: np.ndarray
    ) -> TrialSteps:
        """Evaluate the ends of steps, and compare the decrease of the cost with the prediction."""
        old = self.residual[lanes]
        new, slope = self.slopes(lanes, points)
        self.steps[lanes] += 1
        ratio = 0.5 * _dot(old - new, old + new) / predicted
        finite = _finite(new, slope)
        ratio = np.where(finite & (predicted > 0), ratio, -np.inf)
        return TrialSteps(points, new, slope, ratio, finite)

    def _corrections(self, lanes: np.ndarray, tried: TrialSteps, predicted: np.ndarray):
        """Find the steps along which residuals are curved, and correct them for the curvature.

        The difference between the residuals at the end of a step and their linear prediction is
        added to the right side of the step's equations. Returns the indices of the searches for
        which the correction is expected to help, and their corrected points.
        """
        poor = (tried.ratio < MAX_CORRECTED_RATIO) & np.isfinite(tried.ratio)
        at = np.flatnonzero(poor & (predicted > LAST_DECREASE * self._squares(lanes)))
        if not len(at):
            return at, tried.theta[at]
        jacobian, new, ends = self.jacobian[lanes[at]], tried.residual[at], tried.theta[at]
        step = ends - self.theta[lanes[at]]
        right = new - _times(jacobian, step)
        curved = (right, self.rows[lanes[at]]) if self.large else self._reduce(right, jacobian)
        points = self._propose(lanes[at], *curved)
        correction, scale = points - ends, self.scale[lanes[at]]
        remaining = new + _times(jacobian, correction)
        gain = 0.5 * _dot(new - remaining, new + remaining)
        promising = gain > MIN_REGAINED * (1.0 - tried.ratio[at]) * predicted[at]
        promising &= _length(scale * correction) <= MAX_CORRECTION * _length(scale * step)
        return at[promising], points[promising]

    def _accept(self, lanes: np.ndarray, tried: TrialSteps, predicted: np.ndarray) -> None:
        """Accept the steps that lower the cost; damp less after those, more after the others.

        The less the residuals were curved along an accepted step, the more the damping is reduced.
        """
        squares, ratio, defined = self._squares(lanes), tried.ratio, predicted >= 0
        last = tried.finite & (self.damping[lanes] <= FIRST_DAMPING) & defined
        last &= predicted <= LAST_DECREASE * squares
        good = (ratio > 1e-4) | last
        taken, rejected = lanes[good], lanes[~good]
        line = _times(self.jacobian[taken], tried.theta[good] - self.theta[taken])
        curvature = _length(tried.residual[good] - self.residual[taken] - line) / _length(line)
        self.theta[taken], self.residual[taken] = tried.theta[good], tried.residual[good]
        self.jacobian[taken] = tried.jacobian[good]
        reduced = self._reduce(tried.residual[good], tried.jacobian[good])
        self.right[taken], self.rows[taken] = reduced
        ratio = ratio[good].clip(-1.0, 1.0)
        factor = np.clip(curvature, MIN_DAMPING_FACTOR, MAX_DAMPING_FACTOR)
        self.damping[taken] *= np.maximum(factor, 1 - (2 * ratio - 1) ** 3)
        self.growth[taken] = 2.0
        self.damping[rejected] *= self.growth[rejected]
        self.growth[rejected] *= 2.0
        self.rested[lanes] = last | (~good & defined & (predicted <= DECREASE_ROUNDING * squares))
        self.stuck[lanes] = self.damping[lanes] > MAX_DAMPING

    def restart(self, lane: int, point: np.ndarray) -> None:
        """Restart one search at a point."""
        at = np.array([lane])
        self.theta[at] = point
        self.residual[at], self.jacobian[at] = self.slopes(at, self.theta[at])
        self.right[at], self.rows[at] = self._reduce(self.residual[at], self.jacobian[at])
        self.scale[lane], self.damping[lane], self.growth[lane] = 0.0, FIRST_DAMPING, 2.0
        self.rested[lane] = self.stuck[lane] = False


def _dot(rows: np.ndarray, others: np.ndarray) -> np.ndarray:
    return np.einsum("km,km->k", rows, others)


def _length(rows: np.ndarray) -> np.ndarray:
    return np.sqrt(_dot(rows, rows))


def _lengths(jacobians: np.ndarray) -> np.ndarray:
    """Column lengths of each Jacobian; an array of objects holds normal equations."""
    if jacobians.dtype == object:
        return np.stack([one.lengths for one in jacobians])
    return np.sqrt(np.einsum("kmn,kmn->kn", jacobians, jacobians))


def _times(jacobians: np.ndarray, steps: np.ndarray) -> np.ndarray:
    if jacobians.dtype == object:
        return np.stack([one @ step for one, step in zip(jacobians, steps, strict=True)])
    return np.einsum("kmn,kn->km", jacobians, steps)


def _finite(residuals: np.ndarray, jacobians: np.ndarray) -> np.ndarray:
    """True for each search with finite residuals and Jacobian."""
    large = jacobians.dtype == object
    sums = np.array([one.sum() for one in jacobians]) if large else jacobians.sum(axis=(1, 2))
    return np.isfinite(residuals.sum(axis=1) + sums)


def _find_pinned(g: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """True for each number that is fixed, or at a bound beyond which the cost would fall."""
    return ((low >= 0) & (g > 0)) | ((high <= 0) & (g < 0)) | (low >= high)


def _place(theta, step, unit, low, high, lower, upper) -> np.ndarray:
    """Add a step to a point; numbers that reach a bound take exactly its value."""
    inside = (theta + step / unit).clip(lower, upper)
    return np.where(step <= low, lower, np.where(step >= high, upper, inside))


def _step_dense(theta, right, rows, scale, damping, lower, upper) -> np.ndarray:
    """Solve the damped linear problems, with numbers that would leave their bounds pinned.

    Columns are scaled to unit length.
    """
    unit = np.where(scale > 0, scale, 1.0)
    low, high = (lower - theta) * unit, (upper - theta) * unit
    rows = rows / unit[:, None]
    pinned = _find_pinned(np.einsum("kmn,km->kn", rows, right), low, high)
    step, root = np.zeros_like(theta), np.sqrt(np.maximum(damping, MIN_DAMPING))[:, None]
    for _ in range(MAX_PINNING_ROUNDS):
        # The row of a pinned number sets its value; the other rows have no part of it.
        at = np.where(pinned, step, 0.0)
        free = np.where(pinned[:, None], 0.0, rows)
        tried = _solve_damped(free, -right - _times(rows, at), np.where(pinned, 1.0, root), at)
        step = tried.clip(low, high)
        clipped = step != tried
        if not (clipped & ~pinned).any():
            break
        pinned |= clipped
    found = _place(theta, step, unit, low, high, lower, upper)
    return np.where(np.isfinite(step).all(axis=1, keepdims=True), found, theta)


def _solve_damped(
    rows: np.ndarray, right: np.ndarray, alone: np.ndarray, at: np.ndarray
) -> np.ndarray:
    """Solve rows x = right, of at most n + 1 rows, with alone * x = at, in least squares."""
    k, n = at.shape
    # Transposed: LAPACK's matrices are stored by columns.
    upper, below = np.zeros((k, n + 1, n + 1)), np.zeros((k, n + 1, n))
    upper[:, :n, : rows.shape[1]], upper[:, n, : rows.shape[1]] = rows.swapaxes(1, 2), right
    below.reshape(k, -1)[:, : n * n : n + 1], below[:, n] = alone, at
    found, block = np.empty((k, n)), min(QR_BLOCK, n)
    for r, other, x in zip(upper, below, found, strict=True):
        lapack.dtpqrt(n, block, r.T, other.T, overwrite_a=1, overwrite_b=1)
        x[:] = lapack.dtrtrs(r[:n, :n], r[n, :n], lower=1, trans=1)[0]
    return found


def _step_large(theta, residual, rows, scale, damping, lower, upper) -> np.ndarray:
    """Do the same as `_step_dense` by normal equations, one search after the other."""
    found = np.full_like(theta, np.nan)
    for lane, at in enumerate(zip(theta, residual, rows, scale, damping, strict=True)):
        try:
            found[lane] = _step_seminormal(*at, lower, upper)
        except np.linalg.LinAlgError:  # the step is rejected and the damping increased
            continue
    return found


def _step_seminormal(theta, residual, normal, scale, damping, lower, upper) -> np.ndarray:
    """Solve the damped normal equations of one search, with numbers pinned at their bounds."""
    unit = np.where(scale > 0, scale, 1.0)
    low, high = (lower - theta) * unit, (upper - theta) * unit
    rows = normal.in_units(unit)
    pinned = _find_pinned(rows.T @ residual, low, high)
    step, ridge = np.zeros(len(theta)), max(damping, RIDGE)
    for _ in range(MAX_PINNING_ROUNDS):
        free, step = ~pinned, np.where(pinned, step, 0.0)
        factor = normal.factor(ridge, free)
        for _ in range(2):  # the second pass corrects the rounding of the first
            gradient = rows.T @ (residual + rows @ step) + damping * step
            step[free] -= factor.solve(gradient[free])
        clipped = np.clip(step, low, high)
        now_pinned = pinned | (clipped != step)
        step, done, pinned = clipped, np.array_equal(pinned, now_pinned), now_pinned
        if done:
            break
    return _place(theta, step, unit, low, high, lower, upper)


class NormalEquations:
    """Normal equations of a Jacobian with scaled columns; the last factorization is kept."""

    def __init__(self, jacobian: Rows):
        self.jacobian, self.lengths = jacobian, lengths(jacobian)
        self.rows: Rows | None = None
        self.kept: tuple[float, np.ndarray, Factor] | None = None

    def __matmul__(self, step: np.ndarray) -> np.ndarray:
        return self.jacobian @ step

    def in_units(self, unit: np.ndarray) -> Rows:
        """The Jacobian with scaled columns; the scales of the first call stay."""
        if self.rows is None:
            self.rows = in_units(self.jacobian, unit)
            self.matrix = self.rows.T @ self.rows
        return self.rows

    def factor(self, damping: float, free: np.ndarray) -> Factor:
        """Factorize the damped equations of the numbers that are not pinned."""
        if self.kept is None or self.kept[0] != damping or not np.array_equal(self.kept[1], free):
            part = self.matrix if free.all() else self.matrix[free][:, free]
            self.kept = damping, free, Factor(with_diagonal(part, damping))
        return self.kept[2]


def descent_of(p: Problem, points: np.ndarray) -> Descent:
    """Start the searches of a problem, dense or by normal equations as its size suggests."""
    large = len(p.start) > MAX_DENSE
    few = dense_slopes(p)
    slopes = _sparse_slopes(p) if large else lambda _, points: few(points)
    return Descent(slopes, points, p.lower, p.upper, large=large)


def costs(p: Problem, d: Descent, points: np.ndarray) -> np.ndarray:
    """Half the sum of squares at points; a small problem uses its compiled Jacobian."""
    evaluate = p.compiled(residual)
    found = map(evaluate, points) if d.large else d.slopes(np.zeros(len(points), int), points)[0]
    with np.errstate(over="ignore"):  # of a model with huge values
        return np.array([0.5 * float(r @ r) for r in map(np.asarray, found)])


def dense_slopes(p: Problem) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Make a function of points to residuals and Jacobians, a few points in each compiled call."""
    width = POINTS_PER_CALL if len(p.start) * p.size <= MAX_BATCHED_ENTRIES else 1
    call = p.compiled(_slopes_of_batch)

    def slopes(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        firsts = range(0, len(points), width)
        # All calls have the same number of points: the last is padded with its last point.
        found = [call(points.take(range(i, i + width), 0, mode="clip")) for i in firsts]
        r, j = (np.concatenate(every)[: len(points)] for every in zip(*found, strict=True))
        return r, j

    return slopes


def _slopes_of_batch(core, thetas):
    return jax.vmap(partial(residual_and_jacobian, core))(thetas)


def _sparse_slopes(p: Problem) -> Slopes:
    """Make the same function for many numbers: one point after the other, sparse if possible."""
    shape = p.residual_count, len(p.start)
    sweep, dense = p.compiled(_products), p.compiled(residual_and_jacobian)
    pattern: Pattern | None = None
    sparse = True

    def one(theta: np.ndarray) -> tuple[np.ndarray, Rows]:
        nonlocal pattern, sparse
        sweep_here = partial(sweep, theta)
        # If an entry is nonzero for the first time, the sparsity pattern is determined again.
        for again in (False, True):
            if sparse and (again or pattern is None):
                pattern = pattern_at(sweep_here, shape, pattern)
                sparse = pattern is not None
            if sparse:
                r, found = pattern.jacobian(sweep_here)
                if found is not None:
                    return r, found
        r, found = dense(theta)
        return np.asarray(r), np.asarray(found)

    def slopes(_: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rows, matrices = zip(*map(one, points), strict=True)
        found = np.empty(len(points), object)
        found[:] = matrices
        return np.stack(rows), found

    return slopes


def _products(core, theta, directions):
    """Compute residuals, and the products of their Jacobian with some directions."""
    r, along = jax.linearize(partial(residual, core), theta)
    return r, jax.vmap(along)(directions)


@partial(jax.jit, static_argnums=(0, 3))
def _slopes_at_starts(residual, data, points, own: bool):
    def one(data, theta):
        return with_slope(partial(residual, data), theta)

    return jax.vmap(one, (0 if own else None, 0))(data, points)


def descend_all(
    residual: Callable[[Any, Array], Array],
    data: Any,
    starts: Array,
    lower: Array,
    upper: Array,
    iterations: int = 300,
    tolerance: float = STEP_TOLERANCE,
    own: bool = False,
) -> Found:
    """Minimise half the sum of squares within bounds, from every start.

    Parameters
    ----------
    residual : callable
        ``residual(data, theta)``, shape (m,), in JAX; defined at the top of a module, so that it
        is compiled once.
    data : pytree
        First argument of ``residual``.
    starts : array, shape (k, n)
        Starting points; the residual is finite there.
    lower, upper : array, shape (n,)
        Bounds; equal ends hold a number fixed.
    iterations : int
        Largest number of steps, rejected ones included.
    tolerance : float
        Length of a step, relative to theta, at which a search rests; both are weighted with the
        lengths of the Jacobian's columns.
    own : bool
        True if every start has data of its own, along the first axis of each leaf.

    Returns
    -------
    Found
        Arrays with the leading axis of ``starts``.

    Examples
    --------
    >>> import beamfit.greybox
    >>> def miss(target, t):
    ...     return t**2 - target
    >>> found = descend_all(miss, 4.0, np.array([[1.0], [5.0]]), np.array([0.0]), np.array([9.0]))
    >>> found.theta.round(6).ravel().tolist()
    [2.0, 2.0]
    """
    every = np.array(starts, float)

    def slopes(lanes: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        every[lanes] = points
        r, j = map(np.asarray, _slopes_at_starts(residual, data, every, own))
        return r[lanes], j[lanes]

    search = Descent(slopes, every, np.asarray(lower), np.asarray(upper), tolerance)
    search.run(np.arange(len(every)), iterations)
    return Found(search.theta, search.cost, search.steps, search.rested)
