"""Bounded least squares from many starts at once: the one method of the package.

Levenberg-Marquardt with Moré's column scaling (Moré 1978, Numerical Analysis, LNM 630, 105) and
Nielsen's damping (IMM-REP-1999-05). A step solves the damped linear problem by QR, not by normal
equations, and pins the numbers that would leave their bounds, so iterates end exactly on them;
scipy's bounded methods stay strictly inside, which blurs the verdict "at its bound". All starts
take their steps together: only residuals and slopes are compiled, the steps are batched NumPy. A
point's triangle of (J, r) serves every damping tried there, by LAPACK's QR of two triangles. Where
residuals bend along a step, a second one follows their curve, as the end of the first tells it
(M. K. Transtrum & J. P. Sethna, arXiv:1201.5885, without a further derivative).

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
from scipy.linalg import lapack

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
# Damping falls to these shares after a step along which residuals were straight (D. W. Marquardt,
# J. SIAM 11 (1963) 431), and after one along which they bent but which kept its promise (Nielsen).
STRAIGHT, CURVED = 1 / 10, 1 / 3
# Damping beyond which no step, however short, lowers the cost; below the least it is rounding.
STUCK, LEAST = 1e30, 1e-30
# A promised decrease below this share of the sum of squares is rounding.
ROUNDING = 1e-16
# A step that promises less than this share, and is hardly damped, is the last: it moves the numbers
# by 1e-7 of their errors, and what it brings cannot be told from rounding.
FINISHED = 1e-14
# A step that lowers the cost by less than this share of its promise is followed along the curve of
# the residuals, if that should bring this share of what was missed within this part of its length.
BENT, MISSED, NEAR = 0.75, 0.5, 0.375
# Rounds in which a step pins numbers to bounds; the rest is clipped.
PINNED = 3
# Columns that LAPACK's QR of two triangles takes at once: of 3 to 400 numbers the quickest.
BLOCK = 8
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


class Tried(NamedTuple):
    """Ends of steps: points, residuals and Jacobians there, decrease of the cost over promised.

    `finite` tells of each end if all is.
    """

    theta: np.ndarray
    residual: np.ndarray
    jacobian: np.ndarray
    ratio: np.ndarray
    finite: np.ndarray


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
        self.above = np.tri(self.lower.size + 1).T
        self.theta = np.clip(np.asarray(points, float), lower, upper)
        k = len(self.theta)
        self.residual, self.jacobian = slopes(np.arange(k), self.theta)
        self.right, self.rows = self._reduced(self.residual, self.jacobian)
        self.scale = np.zeros_like(self.theta)
        self.damping, self.growth = np.full(k, DAMPING), np.full(k, 2.0)
        self.steps, self.rested = np.zeros(k, int), np.zeros(k, bool)
        self.stuck = ~_finite(self.residual, self.jacobian)

    @property
    def done(self) -> np.ndarray:
        """True for each start that has come to rest or cannot move."""
        return self.rested | self.stuck

    def _squares(self, lanes: np.ndarray) -> np.ndarray:
        rows = self.residual[lanes]
        return _dot(rows, rows)

    @property
    def cost(self) -> np.ndarray:
        """Half the sum of squares of each; infinite where something is not finite."""
        cost = 0.5 * _dot(self.residual, self.residual)
        return np.where(np.isfinite(cost), cost, np.inf)

    def go(self, lanes: np.ndarray, limit: int, until: float | None = None) -> None:
        """Move some searches on to a number of steps, or until a moment on the clock."""
        with np.errstate(all="ignore"):
            while until is None or time.perf_counter() < until:
                moving = lanes[~self.done[lanes] & (self.steps[lanes] < limit)]
                if not len(moving):
                    return
                self._advance(moving)

    def _reduced(self, residuals: np.ndarray, jacobians: np.ndarray):
        """Right sides and rows with the same squares: of few numbers the triangles of (J, r)."""
        if self.many:
            rows = np.empty(len(residuals), object)
            rows[:] = [NormalEquations(one) for one in jacobians]
            return residuals, rows
        k, m, n = jacobians.shape
        wide = np.concatenate([jacobians, residuals[..., None]], axis=2)
        rows = np.empty((k, min(m, n + 1), n + 1))
        for lane, one in enumerate(wide):
            rows[lane] = lapack.dgeqrf(one)[0][: n + 1]
        rows *= self.above[:m]
        return rows[..., n], rows[..., :n]

    def _advance(self, lanes: np.ndarray) -> None:
        """Try a step of each, take or refuse it."""
        rows = self.rows[lanes]
        self.scale[lanes] = scale = np.maximum(self.scale[lanes], _lengths(rows))
        points = self._proposed(lanes, self.right[lanes], rows)
        theta = self.theta[lanes]
        step = points - theta
        moved = _times(rows, step)
        promised = -_dot(moved, self.right[lanes] + 0.5 * moved)
        small = _length(scale * step) <= self.tolerance * _length(scale * theta)
        self.rested[lanes] = small
        if small.any():
            lanes, points, promised = lanes[~small], points[~small], promised[~small]
        if not len(lanes):
            return
        tried = self._tried(lanes, points, promised)
        bent, points = self._bent(lanes, tried, promised)
        if len(bent):
            second = self._tried(lanes[bent], points, promised[bent])
            better = second.ratio > tried.ratio[bent]
            for first, other in zip(tried, second, strict=True):
                first[bent[better]] = other[better]
        self._take(lanes, tried, promised)

    def _proposed(self, lanes: np.ndarray, right: np.ndarray, rows: np.ndarray) -> np.ndarray:
        step = _next_of_many if self.many else _next
        at = (self.scale[lanes], self.damping[lanes], self.lower, self.upper)
        return step(self.theta[lanes], right, rows, *at)

    def _tried(self, lanes: np.ndarray, points: np.ndarray, promised: np.ndarray) -> Tried:
        old = self.residual[lanes]
        new, slope = self.slopes(lanes, points)
        self.steps[lanes] += 1
        ratio = 0.5 * _dot(old - new, old + new) / promised
        finite = _finite(new, slope)
        ratio = np.where(finite & (promised > 0), ratio, -np.inf)
        return Tried(points, new, slope, ratio, finite)

    def _bent(self, lanes: np.ndarray, tried: Tried, promised: np.ndarray):
        """Find the searches whose residuals bend along their step, and the steps that follow.

        What the residuals at the end of a step have beyond its straight line is added to those that
        the step was solved for: a little further step along their curve, where it is expected to
        bring most of what the straight one missed.
        """
        poor = (tried.ratio < BENT) & np.isfinite(tried.ratio)
        at = np.flatnonzero(poor & (promised > FINISHED * self._squares(lanes)))
        if not len(at):
            return at, tried.theta[at]
        jacobian, new, ends = self.jacobian[lanes[at]], tried.residual[at], tried.theta[at]
        change = ends - self.theta[lanes[at]]
        right = new - _times(jacobian, change)
        curved = (right, self.rows[lanes[at]]) if self.many else self._reduced(right, jacobian)
        points = self._proposed(lanes[at], *curved)
        more, scale = points - ends, self.scale[lanes[at]]
        left = new + _times(jacobian, more)
        gain = 0.5 * _dot(new - left, new + left)
        worth = gain > MISSED * (1.0 - tried.ratio[at]) * promised[at]
        worth &= _length(scale * more) <= NEAR * _length(scale * change)
        return at[worth], points[worth]

    def _take(self, lanes: np.ndarray, tried: Tried, promised: np.ndarray) -> None:
        """Take the steps that lower the cost; damp less after those, more after the others.

        Damping is for residuals that bend: it falls with the share of their change that did.
        """
        squares, ratio, plain = self._squares(lanes), tried.ratio, promised >= 0
        last = tried.finite & (self.damping[lanes] <= DAMPING) & plain
        last &= promised <= FINISHED * squares
        good = (ratio > 1e-4) | last
        taken, refused = lanes[good], lanes[~good]
        line = _times(self.jacobian[taken], tried.theta[good] - self.theta[taken])
        bend = _length(tried.residual[good] - self.residual[taken] - line) / _length(line)
        self.theta[taken], self.residual[taken] = tried.theta[good], tried.residual[good]
        self.jacobian[taken] = tried.jacobian[good]
        reduced = self._reduced(tried.residual[good], tried.jacobian[good])
        self.right[taken], self.rows[taken] = reduced
        ratio = ratio[good].clip(-1.0, 1.0)
        self.damping[taken] *= np.maximum(np.clip(bend, STRAIGHT, CURVED), 1 - (2 * ratio - 1) ** 3)
        self.growth[taken] = 2.0
        self.damping[refused] *= self.growth[refused]
        self.growth[refused] *= 2.0
        self.rested[lanes] = last | (~good & plain & (promised <= ROUNDING * squares))
        self.stuck[lanes] = self.damping[lanes] > STUCK

    def move(self, lane: int, point: np.ndarray) -> None:
        """Begin one search anew."""
        at = np.array([lane])
        self.theta[at] = point
        self.residual[at], self.jacobian[at] = self.slopes(at, self.theta[at])
        self.right[at], self.rows[at] = self._reduced(self.residual[at], self.jacobian[at])
        self.scale[lane], self.damping[lane], self.growth[lane] = 0.0, DAMPING, 2.0
        self.rested[lane] = self.stuck[lane] = False


def _dot(rows: np.ndarray, others: np.ndarray) -> np.ndarray:
    return np.einsum("km,km->k", rows, others)


def _length(rows: np.ndarray) -> np.ndarray:
    return np.sqrt(_dot(rows, rows))


def _lengths(jacobians: np.ndarray) -> np.ndarray:
    """Lengths of the columns of each; of many numbers they are an array of normal equations."""
    if jacobians.dtype == object:
        return np.stack([one.lengths for one in jacobians])
    return np.sqrt(np.einsum("kmn,kmn->kn", jacobians, jacobians))


def _times(jacobians: np.ndarray, steps: np.ndarray) -> np.ndarray:
    if jacobians.dtype == object:
        return np.stack([one @ step for one, step in zip(jacobians, steps, strict=True)])
    return np.einsum("kmn,kn->km", jacobians, steps)


def _finite(residuals: np.ndarray, jacobians: np.ndarray) -> np.ndarray:
    """True for each start where all is finite."""
    many = jacobians.dtype == object
    sums = np.array([one.sum() for one in jacobians]) if many else jacobians.sum(axis=(1, 2))
    return np.isfinite(residuals.sum(axis=1) + sums)


def _pinned(g: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """True for each number on a bound towards which the cost falls, and for fixed ones."""
    return ((low >= 0) & (g > 0)) | ((high <= 0) & (g < 0)) | (low >= high)


def _placed(theta, held, unit, low, high, lower, upper) -> np.ndarray:
    """The next point: exactly on a bound, or the number is not known to be there."""
    inside = (theta + held / unit).clip(lower, upper)
    return np.where(held <= low, lower, np.where(held >= high, upper, inside))


def _next(theta, right, rows, scale, damping, lower, upper) -> np.ndarray:
    """Solve the damped linear problems inside the bounds, pinning what would leave.

    In units of the columns' lengths.
    """
    unit = np.where(scale > 0, scale, 1.0)
    low, high = (lower - theta) * unit, (upper - theta) * unit
    rows = rows / unit[:, None]
    pinned = _pinned(np.einsum("kmn,km->kn", rows, right), low, high)
    held, root = np.zeros_like(theta), np.sqrt(np.maximum(damping, LEAST))[:, None]
    for _ in range(PINNED):
        # A pinned number stands alone in its row; the others are solved beside it.
        at = np.where(pinned, held, 0.0)
        loose = np.where(pinned[:, None], 0.0, rows)
        tried = _damped(loose, -right - _times(rows, at), np.where(pinned, 1.0, root), at)
        held = tried.clip(low, high)
        left = held != tried
        if not (left & ~pinned).any():
            break
        pinned |= left
    found = _placed(theta, held, unit, low, high, lower, upper)
    return np.where(np.isfinite(held).all(axis=1, keepdims=True), found, theta)


def _damped(rows: np.ndarray, right: np.ndarray, alone: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Least squares x of rows x = right, of at most n + 1 rows, and of alone x = at, one by one."""
    k, n = at.shape
    # Transposed, as LAPACK has them.
    upper, below = np.zeros((k, n + 1, n + 1)), np.zeros((k, n + 1, n))
    upper[:, :n, : rows.shape[1]], upper[:, n, : rows.shape[1]] = rows.swapaxes(1, 2), right
    below.reshape(k, -1)[:, : n * n : n + 1], below[:, n] = alone, at
    found, block = np.empty((k, n)), min(BLOCK, n)
    for r, other, x in zip(upper, below, found, strict=True):
        lapack.dtpqrt(n, block, r.T, other.T, overwrite_a=1, overwrite_b=1)
        x[:] = lapack.dtrtrs(r[:n, :n], r[n, :n], lower=1, trans=1)[0]
    return found


def _next_of_many(theta, residual, rows, scale, damping, lower, upper) -> np.ndarray:
    """`_next` of each start, by normal equations of the numbers that are not pinned."""
    found = np.full_like(theta, np.nan)
    for lane, at in enumerate(zip(theta, residual, rows, scale, damping, strict=True)):
        try:
            found[lane] = _seminormal(*at, lower, upper)
        except np.linalg.LinAlgError:  # refused, and damped more
            continue
    return found


def _seminormal(theta, residual, normal, scale, damping, lower, upper) -> np.ndarray:
    unit = np.where(scale > 0, scale, 1.0)
    low, high = (lower - theta) * unit, (upper - theta) * unit
    rows = normal.in_units(unit)
    pinned = _pinned(rows.T @ residual, low, high)
    held, more = np.zeros(len(theta)), max(damping, RIDGE)
    for _ in range(PINNED):
        loose, held = ~pinned, np.where(pinned, held, 0.0)
        factor = normal.factor(more, loose)
        for _ in range(2):  # the second corrects the rounding of the first
            left = rows.T @ (residual + rows @ held) + damping * held
            held[loose] -= factor.solve(left[loose])
        clipped = np.clip(held, low, high)
        more_pinned = pinned | (clipped != held)
        held, done, pinned = clipped, np.array_equal(pinned, more_pinned), more_pinned
        if done:
            break
    return _placed(theta, held, unit, low, high, lower, upper)


class NormalEquations:
    """Normal equations of a Jacobian, its columns in units that stay; the last factor is kept."""

    def __init__(self, jacobian: Rows):
        self.jacobian, self.lengths = jacobian, lengths(jacobian)
        self.rows: Rows | None = None
        self.kept: tuple[float, np.ndarray, Factor] | None = None

    def __matmul__(self, step: np.ndarray) -> np.ndarray:
        return self.jacobian @ step

    def in_units(self, unit: np.ndarray) -> Rows:
        """The Jacobian with its columns in units, those of the first call."""
        if self.rows is None:
            self.rows = in_units(self.jacobian, unit)
            self.matrix = self.rows.T @ self.rows
        return self.rows

    def factor(self, damping: float, loose: np.ndarray) -> Factor:
        """Factor of the damped equations of the numbers that are loose."""
        if self.kept is None or self.kept[0] != damping or not np.array_equal(self.kept[1], loose):
            part = self.matrix if loose.all() else self.matrix[loose][:, loose]
            self.kept = damping, loose, Factor(with_diagonal(part, damping))
        return self.kept[2]


def descent_of(p: Problem, points: np.ndarray) -> Descent:
    """Searches of a problem, by the method for as many free numbers as it has."""
    many = len(p.start) > FEW
    few = slopes_of_few(p)
    slopes = _slopes_of_many(p) if many else lambda _, points: few(points)
    return Descent(slopes, points, p.lower, p.upper, many=many)


def costs(p: Problem, d: Descent, points: np.ndarray) -> np.ndarray:
    """Half the sum of squares at points; of few numbers by the call that is compiled already."""
    look = p.compiled(residual)
    found = map(look, points) if d.many else d.slopes(np.zeros(len(points), int), points)[0]
    with np.errstate(over="ignore"):  # of a model that went astray
        return np.array([0.5 * float(r @ r) for r in map(np.asarray, found)])


def slopes_of_few(p: Problem) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Residuals and Jacobians, a few points in each compiled call: one width for all counts."""
    width = WIDTH if len(p.start) * p.size <= LARGE else 1
    call = p.compiled(_sloped_each)

    def slopes(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        firsts = range(0, len(points), width)
        # The last part is filled with its last point.
        found = [call(points.take(range(i, i + width), 0, mode="clip")) for i in firsts]
        r, j = (np.concatenate(every)[: len(points)] for every in zip(*found, strict=True))
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
    return Found(search.theta, search.cost, search.steps, search.rested)
