"""Bounded least squares from many starts at once: the one method of the package.

Levenberg-Marquardt with Moré's column scaling (Moré 1978, Numerical Analysis, LNM 630, 105) and
Nielsen's damping (IMM-REP-1999-05). A step solves the damped linear problem by QR, not by normal
equations, and pins the numbers that would leave their bounds, so iterates end exactly on them;
scipy's bounded methods stay strictly inside, which blurs the verdict "at its bound". All starts
take their steps together: only residuals and slopes are compiled, the steps are batched NumPy.

Of many free numbers steps solve normal equations, sparse where the problem is, and are corrected by
the residual that they leave (corrected seminormal equations: Å. Björck, Linear Algebra Appl. 88/89
(1987) 31). It proposes points; whether one is an optimum is for `beamfit.greybox.assess` to say.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import Array

from beamfit.greybox.covariance import FEW
from beamfit.greybox.problem import Problem, residual, sloped, with_slope
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

# Damping of the first step; the Jacobian's columns have unit length.
DAMPING = 1e-3
# A search rests at a step below this share of the numbers, both in units of the Jacobian's columns.
TOLERANCE = 1e-13
# Damping beyond which no step, however short, lowers the cost; below the least it is rounding.
STUCK, LEAST = 1e30, 1e-30
# A promised decrease below this share of the sum of squares is rounding.
ROUNDING = 1e-16
# The same for many numbers, whose last steps cost most and move them by 1e-7 of an error.
FINISHED = 1e-14
# Rounds in which a step pins numbers to bounds; the rest is clipped.
PINNED = 3
# Starts looked at in one compiled call, if their Jacobians have at most this many entries.
WIDTH, LARGE = 4, 2**15

# Residuals (k, m) and their Jacobians (k, m, n), or k sparse ones, at points (k, n) of some starts.
Slopes = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


class Found(NamedTuple):
    """Ends of searches: numbers, half the sums of squares, steps, and if they came to rest."""

    theta: np.ndarray
    cost: np.ndarray
    steps: np.ndarray
    rested: np.ndarray


class Descent:
    """Searches side by side; arrays with one row for each start.

    `stuck` tells that no step from there lowers the cost; `steps` counts refused ones too.

    Parameters
    ----------
    slopes : callable
        ``slopes(lanes, points)``: residuals and Jacobians at a point of each of some starts.
    points : array, shape (k, n)
        Where to start.
    lower, upper : array, shape (n,)
        Bounds; equal ends hold a number fixed.
    tolerance : float
        On the length of a step relative to the numbers, both in units of the Jacobian's columns.
    many : bool
        Whether steps are those of many free numbers.
    """

    def __init__(self, slopes: Slopes, points, lower, upper, tolerance=TOLERANCE, many=False):
        self.slopes, self.lower, self.upper = slopes, np.asarray(lower), np.asarray(upper)
        self.tolerance, self.many = tolerance, many
        self.theta = np.clip(np.asarray(points, float), lower, upper)
        k = len(self.theta)
        self.residual, self.jacobian = slopes(np.arange(k), self.theta)
        self.scale = np.zeros_like(self.theta)
        self.damping, self.growth = np.full(k, DAMPING), np.full(k, 2.0)
        self.steps, self.rested = np.zeros(k, int), np.zeros(k, bool)
        self.stuck = ~_finite(self.residual, self.jacobian)

    @property
    def done(self) -> np.ndarray:
        """True for each start that has come to rest or cannot move."""
        return self.rested | self.stuck

    @property
    def cost(self) -> np.ndarray:
        """Half the sum of squares of each; infinite where something is not finite."""
        cost = 0.5 * np.sum(self.residual**2, axis=1)
        return np.where(np.isfinite(cost), cost, np.inf)

    @property
    def found(self) -> Found:
        """The ends."""
        return Found(self.theta, self.cost, self.steps, self.rested)

    def go(self, lanes: np.ndarray, limit: int, until: float | None = None) -> None:
        """Move some searches on to a number of steps, or until a moment on the clock."""
        while until is None or time.perf_counter() < until:
            moving = lanes[~self.done[lanes] & (self.steps[lanes] < limit)]
            if not len(moving):
                return
            self._advance(moving)

    def _advance(self, lanes: np.ndarray) -> None:
        """Try a step of each, take or refuse it."""
        r, j = self.residual[lanes], self.jacobian[lanes]
        self.scale[lanes] = scale = np.maximum(self.scale[lanes], _lengths(j))
        theta, damping = self.theta[lanes], self.damping[lanes]
        step = _next_of_many if self.many else _next
        trial = step(theta, r, j, scale, damping, self.lower, self.upper)
        change = trial - theta
        moved = _times(j, change)
        promised = -np.sum(moved * (r + 0.5 * moved), axis=1)
        small = _length(scale * change) <= self.tolerance * _length(scale * theta)
        self.rested[lanes] = small
        go = ~small
        lanes, r, promised = lanes[go], r[go], promised[go]
        if not len(lanes):
            return
        new, slope = self.slopes(lanes, trial[go])
        self.steps[lanes] += 1
        finite = _finite(new, slope)
        with np.errstate(all="ignore"):
            ratio = 0.5 * np.sum((r - new) * (r + new), axis=1) / promised
        ratio = np.where(finite & (promised > 0), ratio, -1.0)
        squares = np.sum(r * r, axis=1)
        # A step that promises next to nothing cannot be judged: of many numbers it is the last.
        last = finite & (promised >= 0) & (promised <= FINISHED * squares) & self.many
        good = (ratio > 1e-4) | last
        nothing = ~good & (promised >= 0) & (promised <= ROUNDING * squares)
        taken, refused = lanes[good], lanes[~good]
        self.theta[taken], self.residual[taken] = trial[go][good], new[good]
        self.jacobian[taken] = slope[good]
        self.damping[taken] *= np.maximum(1 / 3, 1 - (2 * np.minimum(ratio[good], 1.0) - 1) ** 3)
        self.growth[taken] = 2.0
        self.damping[refused] *= self.growth[refused]
        self.growth[refused] *= 2.0
        self.rested[lanes] = last | nothing
        self.stuck[lanes] = self.damping[lanes] > STUCK

    def move(self, lane: int, point: np.ndarray) -> None:
        """Begin one search anew."""
        at = np.array([lane])
        self.theta[at] = point
        self.residual[at], self.jacobian[at] = self.slopes(at, self.theta[at])
        self.scale[lane], self.damping[lane], self.growth[lane] = 0.0, DAMPING, 2.0
        self.rested[lane] = self.stuck[lane] = False


def _length(rows: np.ndarray) -> np.ndarray:
    return np.linalg.norm(rows, axis=-1)


def _lengths(jacobians: np.ndarray) -> np.ndarray:
    """Lengths of the columns of each; of many numbers they are an array of matrices."""
    if jacobians.dtype == object:
        return np.stack([lengths(one) for one in jacobians])
    return np.linalg.norm(jacobians, axis=1)


def _times(jacobians: np.ndarray, steps: np.ndarray) -> np.ndarray:
    if jacobians.dtype == object:
        return np.stack([one @ step for one, step in zip(jacobians, steps, strict=True)])
    return np.einsum("kmn,kn->km", jacobians, steps)


def _finite(residuals: np.ndarray, jacobians: np.ndarray) -> np.ndarray:
    """True for each start where all is finite."""
    sums = np.array([one.sum() for one in jacobians], float)
    return np.isfinite(residuals.sum(axis=1) + sums)


def _pinned(g: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """True for each number on a bound towards which the cost falls, and for fixed ones."""
    return ((low >= 0) & (g > 0)) | ((high <= 0) & (g < 0)) | (low >= high)


def _placed(theta, held, unit, low, high, lower, upper) -> np.ndarray:
    """The next point: exactly on a bound, or the number is not known to be there."""
    inside = np.clip(theta + held / unit, lower, upper)
    return np.where(held <= low, lower, np.where(held >= high, upper, inside))


def _next(theta, residual, jacobian, scale, damping, lower, upper) -> np.ndarray:
    """Solve the damped linear problems inside the bounds, pinning what would leave.

    In units of the columns' lengths; (R, q) of the QR of (J, r) stand for (J, r).
    """
    n = theta.shape[1]
    unit = np.where(scale > 0, scale, 1.0)
    low, high = (lower - theta) * unit, (upper - theta) * unit
    rows = np.concatenate([jacobian / unit[:, None], residual[..., None]], axis=2)
    if rows.shape[1] > n + 1:
        rows = np.linalg.qr(rows, mode="r")
    triangle, reduced = rows[..., :n], rows[..., n]
    pinned = _pinned(np.einsum("kmn,km->kn", triangle, reduced), low, high)
    held, root = np.zeros_like(theta), np.sqrt(np.maximum(damping, LEAST))[:, None]
    for _ in range(PINNED):
        # A pinned number stands alone in its row; the others are solved beside it.
        at = np.where(pinned, held, 0.0)
        loose = np.where(pinned[:, None], 0.0, triangle)
        alone = np.where(pinned, 1.0, root)[..., None] * np.eye(n)
        right = np.concatenate([-reduced - np.einsum("kmn,kn->km", triangle, at), at], axis=1)
        left = np.concatenate([loose, alone], axis=1)
        r = np.linalg.qr(np.concatenate([left, right[..., None]], axis=2), mode="r")
        tried = np.linalg.solve(r[:, :n, :n], r[:, :n, n:])[..., 0]
        held = np.clip(tried, low, high)
        more = pinned | (held != tried)
        if np.array_equal(more, pinned):
            break
        pinned = more
    found = _placed(theta, held, unit, low, high, lower, upper)
    return np.where(np.isfinite(held).all(axis=1, keepdims=True), found, theta)


def _next_of_many(theta, residual, jacobian, scale, damping, lower, upper) -> np.ndarray:
    """`_next` of each start, by normal equations of the numbers that are not pinned."""
    found = np.full_like(theta, np.nan)
    for lane, at in enumerate(zip(theta, residual, jacobian, scale, damping, strict=True)):
        try:
            found[lane] = _seminormal(*at, lower, upper)
        except np.linalg.LinAlgError:  # refused, and damped more
            continue
    return found


def _seminormal(theta, residual, jacobian, scale, damping, lower, upper) -> np.ndarray:
    unit = np.where(scale > 0, scale, 1.0)
    low, high = (lower - theta) * unit, (upper - theta) * unit
    rows = in_units(jacobian, unit)
    normal = rows.T @ rows
    pinned = _pinned(rows.T @ residual, low, high)
    held, more = np.zeros(len(theta)), max(damping, RIDGE)
    for _ in range(PINNED):
        loose, held = np.flatnonzero(~pinned), np.where(pinned, held, 0.0)
        part = normal if len(loose) == len(theta) else normal[loose][:, loose]
        factor = Factor(with_diagonal(part, more))
        for _ in range(2):  # the second corrects the rounding of the first
            left = rows.T @ (residual + rows @ held) + damping * held
            held[loose] -= factor.solve(left[loose])
        clipped = np.clip(held, low, high)
        more_pinned = pinned | (clipped != held)
        held, done, pinned = clipped, np.array_equal(pinned, more_pinned), more_pinned
        if done:
            break
    return _placed(theta, held, unit, low, high, lower, upper)


def descent_of(p: Problem, points: np.ndarray) -> Descent:
    """Searches of a problem, by the method for as many free numbers as it has."""
    many = len(p.start) > FEW
    slopes = _slopes_of_many(p) if many else _slopes_of_few(p)
    return Descent(slopes, points, p.lower, p.upper, many=many)


def costs(p: Problem, d: Descent, points: np.ndarray) -> np.ndarray:
    """Half the sum of squares at points; of few numbers by the call that is compiled already."""
    look = p.compiled(residual)
    found = map(look, points) if d.many else d.slopes(np.zeros(len(points), int), points)[0]
    return np.array([0.5 * float(r @ r) for r in map(np.asarray, found)])


def _slopes_of_few(p: Problem) -> Slopes:
    """A few points in each compiled call, whose width is one however many starts there are."""
    width = WIDTH if len(p.start) * p.size <= LARGE else 1
    call = p.compiled(_sloped_each)

    def slopes(_: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        fill = np.repeat(points[:1], -len(points) % width, axis=0)
        parts = np.split(np.concatenate([points, fill]), (len(points) + len(fill)) // width)
        found = zip(*(map(np.asarray, call(part)) for part in parts), strict=True)
        r, j = (np.concatenate(every)[: len(points)] for every in found)
        return r, j

    return slopes


def _sloped_each(core, thetas):
    return jax.vmap(partial(sloped, core))(thetas)


def _slopes_of_many(p: Problem) -> Slopes:
    """One point after the other, in as few sweeps as the pattern of the Jacobian allows."""
    shape = p.residual_count, len(p.start)
    sweep, whole = p.compiled(_swept), p.compiled(sloped)
    pattern: Pattern | None = None
    sparse = True

    def one(theta: np.ndarray) -> tuple[np.ndarray, Rows]:
        nonlocal pattern, sparse
        there = partial(sweep, theta)
        # A place that was zero at all points before is found by looking once more.
        for again in (False, True):
            if sparse and (again or pattern is None):
                pattern = pattern_at(there, shape, pattern)
                sparse = pattern is not None
            if sparse:
                r, found = pattern.jacobian(there)
                if found is not None:
                    return r, found
        r, found = whole(theta)
        return np.asarray(r), np.asarray(found)

    def slopes(_: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rows, matrices = zip(*map(one, points), strict=True)
        found = np.empty(len(points), object)
        found[:] = matrices
        return np.stack(rows), found

    return slopes


def _swept(core, theta, directions):
    """Residuals, and the products of their Jacobian with some directions."""
    r, along = jax.linearize(partial(residual, core), theta)
    return r, jax.vmap(along)(directions)


@partial(jax.jit, static_argnums=(0, 3))
def _sloped_all(residual, data, points, own: bool):
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
    tolerance: float = TOLERANCE,
    own: bool = False,
) -> Found:
    """Minimise half the sum of squares within bounds, from every start.

    Parameters
    ----------
    residual : callable
        ``residual(data, theta)``, shape (m,), in JAX; defined at the top of a module, so that it
        is compiled once.
    data : pytree
        What it needs.
    starts : array, shape (k, n)
        Where to start; the residual is finite there.
    lower, upper : array, shape (n,)
        Bounds; equal ends hold a number fixed.
    iterations : int
        Most steps, refused ones too.
    tolerance : float
        On the length of a step relative to theta, both in units of the Jacobian's columns.
    own : bool
        Whether every start has data of its own, along the first axis of each leaf.

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
        r, j = map(np.asarray, _sloped_all(residual, data, every, own))
        return r[lanes], j[lanes]

    search = Descent(slopes, every, np.asarray(lower), np.asarray(upper), tolerance)
    search.go(np.arange(len(every)), iterations)
    return search.found
