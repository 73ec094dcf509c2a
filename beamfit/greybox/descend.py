"""Bounded least squares from many starts at once: the one method of the package.

Levenberg-Marquardt with Moré's column scaling (Moré 1978, Numerical Analysis, LNM 630, 105) and
Nielsen's damping (IMM-REP-1999-05). A step solves the damped linear problem by QR, not by normal
equations, and pins the numbers that would leave their bounds, so iterates end exactly on them;
scipy's bounded methods stay strictly inside, which blurs the verdict "at its bound". Written for
`jax.vmap`: twenty starts take the time of a few. It proposes points; whether one is an optimum is
for `beamfit.greybox.assess` to say.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.greybox.covariance import FEW, RIDGE, Factor, Rows, in_units, lengths, with_diagonal
from beamfit.greybox.problem import Problem, sloped, with_slope
from beamfit.greybox.problem import residual as problem_residual

# Damping of the first step; the Jacobian's columns have unit length.
DAMPING = 1e-3
# A search rests at a step below this share of the numbers, both in units of the Jacobian's columns.
TOLERANCE = 1e-13
# Smallest factor on the damping in one step.
EASED = 1e-4
# Damping beyond which no step, however short, lowers the cost.
STUCK = 1e30
# A promised decrease below this share of the sum of squares is rounding.
ROUNDING = 1e-16
# The same for many numbers, whose last steps cost most and move them by 1e-7 of an error.
FINISHED = 1e-14
# Rounds in which a step pins numbers to bounds; the rest is clipped.
PINNED = 3
# Factor on the damping of many numbers, times the relative miss of a step's promised decrease.
TRUSTED = 10.0
# Steps between two looks at the clock under a time limit.
SEGMENT = 50
# Starts searched in one compiled call, if their Jacobians have at most this many entries.
WIDTH, LARGE = 4, 2**15


class Found(NamedTuple):
    """End of one start: numbers, half the sum of squares, steps, and if it came to rest."""

    theta: Array
    cost: Array
    steps: Array
    rested: Array


class Walk(NamedTuple):
    """A search under way: where it is, the point it tries next, and what that promises.

    `stuck` tells that no step from here lowers the cost; `steps` is -1 before the start is seen.
    """

    theta: Array
    residual: Array
    jacobian: Array
    scale: Array
    damping: Array
    growth: Array
    steps: Array
    rested: Array
    stuck: Array
    trial: Array
    promised: Array

    @property
    def memory(self) -> tuple[Array, Array, Array, Array]:
        """State that the next segment of a search begins with."""
        return self.damping, self.growth, self.scale, self.steps

    @property
    def found(self) -> Found:
        """The end of the search."""
        return Found(self.theta, 0.5 * self.residual @ self.residual, self.steps, self.rested)


def walk(
    residual: Callable[[Array], Array],
    start: Array,
    lower: Array,
    upper: Array,
    iterations: Any,
    tolerance: float = TOLERANCE,
    memory: tuple[Any, Any, Any, Any] = (DAMPING, 2.0, 0.0, 0),
    moves: Any = True,
) -> Walk:
    """Search until it rests, is stuck or has taken so many steps, refused ones too.

    `memory` has damping, growth, column lengths and steps of an earlier walk to go on from. A walk
    that does not move only looks at its start.
    """
    theta = jnp.clip(start, lower, upper)
    shape = jax.eval_shape(residual, theta)
    damping, growth, scale, steps = (jnp.asarray(v) for v in memory)
    first = Walk(
        theta, jnp.full(shape.shape, jnp.inf), jnp.zeros((*shape.shape, theta.size)),
        jnp.broadcast_to(scale, theta.shape).astype(float), damping.astype(float),
        growth.astype(float), jnp.asarray(-1), jnp.asarray(False), jnp.asarray(False), theta,
        jnp.asarray(0.0),
    )  # fmt: skip
    more = jnp.maximum(iterations - steps, 0)

    def go_on(s: Walk) -> Array:
        return ~s.rested & ~s.stuck & (s.steps < more)

    advance = partial(_advance, residual, lower, upper, tolerance, moves)
    last = jax.lax.while_loop(go_on, advance, first)
    return last._replace(steps=last.steps + steps)


def descend_one(
    residual: Callable[[Array], Array],
    start: Array,
    lower: Array,
    upper: Array,
    iterations: int = 300,
    tolerance: float = TOLERANCE,
) -> Found:
    """Minimise half the sum of squares within bounds; a pure function, to be vectorised.

    Parameters
    ----------
    residual : callable
        ``residual(theta)``, shape (m,), in JAX.
    start : array, shape (n,)
        Where to start; the residual is finite there.
    lower, upper : array, shape (n,)
        Bounds; equal ends hold a number fixed.
    iterations : int
        Most steps, refused ones too.
    tolerance : float
        On the length of a step relative to theta, both in units of the Jacobian's columns.

    Returns
    -------
    Found

    Examples
    --------
    >>> import beamfit.greybox
    >>> fit = jax.vmap(lambda y: descend_one(lambda t: t - y, jnp.zeros(1), -jnp.ones(1),
    ...                                      jnp.ones(1)).theta)
    >>> fit(jnp.array([0.5, 3.0])).ravel().round(9).tolist()
    [0.5, 1.0]
    """
    lower, upper = jnp.asarray(lower, float), jnp.asarray(upper, float)
    return walk(residual, jnp.asarray(start, float), lower, upper, iterations, tolerance).found


@partial(jax.jit, static_argnames=("residual", "iterations", "tolerance"))
def descend_all(
    residual: Callable[[Any, Array], Array],
    data: Any,
    starts: Array,
    lower: Array,
    upper: Array,
    iterations: int = 300,
    tolerance: float = TOLERANCE,
) -> Found:
    """`descend_one` from every start.

    Parameters
    ----------
    residual : callable
        ``residual(data, theta)``, shape (m,), in JAX; defined at the top of a module, so that it
        is compiled once.
    data : pytree
        What it needs; the same for all starts.
    starts : array, shape (k, n)
        Where to start.
    lower, upper, iterations, tolerance
        As for `descend_one`.

    Returns
    -------
    Found
        Arrays with the leading axis of ``starts``.

    Examples
    --------
    >>> import beamfit.greybox
    >>> def miss(target, t):
    ...     return t**2 - target
    >>> starts, low, high = jnp.array([[1.0], [5.0]]), jnp.array([0.0]), jnp.array([9.0])
    >>> found = descend_all(miss, 4.0, starts, low, high)
    >>> found.theta.round(6).ravel().tolist()
    [2.0, 2.0]
    """

    def one(start: Array) -> Found:
        return descend_one(partial(residual, data), start, lower, upper, iterations, tolerance)

    return jax.vmap(one)(jnp.asarray(starts, float))


def _advance(residual, lower: Array, upper: Array, tolerance: float, moves, s: Walk) -> Walk:
    """Look at the point tried, take or refuse it, and find the next one."""
    first = s.steps < 0
    r, j = with_slope(residual, s.trial)
    finite = jnp.all(jnp.isfinite(r)) & jnp.all(jnp.isfinite(j))
    gained = 0.5 * (s.residual - r) @ (s.residual + r)
    ratio = jnp.where(finite & (s.promised > 0), gained / s.promised, -1.0)
    good = first | (ratio > 1e-4)
    eased = s.damping * jnp.maximum(1 / 3, 1 - (2 * jnp.minimum(ratio, 1.0) - 1) ** 3)
    kept = partial(jnp.where, good)
    theta, r, j = kept(s.trial, s.theta), kept(r, s.residual), kept(j, s.jacobian)
    scale = jnp.maximum(s.scale, jnp.linalg.norm(j, axis=0))
    damping = jnp.where(first, s.damping, kept(eased, s.damping * s.growth))
    at = (theta, r, j, scale, damping, lower, upper)
    trial = _next(*at) if moves is True else jax.lax.cond(moves, _next, lambda *at: at[0], *at)
    change = trial - theta
    promised = -(r @ (j @ change)) - 0.5 * jnp.sum((j @ change) ** 2)
    small = jnp.linalg.norm(scale * change) <= tolerance * jnp.linalg.norm(scale * theta)
    # The decrease that a refused step promised is below rounding.
    nothing = ~good & (s.promised >= 0) & (s.promised <= ROUNDING * (r @ r))
    return Walk(
        theta, r, j, scale, damping, kept(jnp.where(first, s.growth, 2.0), 2.0 * s.growth),
        s.steps + 1, small | nothing, (damping > STUCK) | (first & ~finite), trial, promised,
    )  # fmt: skip


def _easing(ratio: float) -> float:
    """Factor on the damping after a step that gained this share of its promised decrease.

    Nielsen's rule, and faster where a step gains what it promised: then steps become undamped and
    converge as fast as Gauss-Newton's. Few numbers keep to Nielsen's rule: in the flat valleys of
    networks every second step would be refused.
    """
    nielsen = max(1 / 3, 1 - (2 * min(ratio, 1.0) - 1) ** 3)
    return min(nielsen, max(TRUSTED * abs(1 - ratio), EASED))


def _next(theta, residual, jacobian, scale, damping, lower, upper) -> Array:
    """Solve the damped linear problem inside the bounds, pinning what would leave.

    In units of the columns' lengths; (R, q) of the QR of (J, r) stand for (J, r).
    """
    n = theta.size
    unit = jnp.where(scale > 0, scale, 1.0)
    low, high = (lower - theta) * unit, (upper - theta) * unit
    rows = jnp.column_stack([jacobian / unit, residual])
    if rows.shape[0] > n + 1:
        rows = jnp.linalg.qr(rows, mode="r")
    triangle, reduced = rows[:, :n], rows[:, n]
    g = triangle.T @ reduced
    pinned = ((low >= 0) & (g > 0)) | ((high <= 0) & (g < 0)) | (lower >= upper)

    def unfinished(state):
        pinned, _, before, rounds = state
        return (rounds == 0) | ((rounds < PINNED) & jnp.any(pinned != before))

    def pin(state):
        # A pinned number stands alone in its row; the others are solved beside it.
        pinned, held, _, rounds = state
        at = jnp.where(pinned, held, 0.0)
        loose = jnp.where(pinned, 0.0, triangle)
        left = jnp.vstack([loose, jnp.diag(jnp.where(pinned, 1.0, jnp.sqrt(damping)))])
        right = jnp.concatenate([-reduced - triangle @ at, at])
        r = jnp.linalg.qr(jnp.column_stack([left, right]), mode="r")
        tried = jax.scipy.linalg.solve_triangular(r[:n, :n], r[:n, n])
        clipped = jnp.clip(tried, low, high)
        return pinned | (clipped != tried), clipped, pinned, rounds + 1

    begin = (pinned, jnp.zeros_like(g), pinned, jnp.asarray(0))
    held = jax.lax.while_loop(unfinished, pin, begin)[1]
    inside = jnp.clip(theta + held / unit, lower, upper)
    # Exactly on a bound, or the number is not known to be there.
    found = jnp.where(held <= low, lower, jnp.where(held >= high, upper, inside))
    return jnp.where(jnp.all(jnp.isfinite(held)), found, theta)


class Lanes:
    """Searches of a problem side by side, or points looked at: a few in a compiled call.

    The call has one width however many searches there are, so that they share its code; one that
    is polished alone does not wait for all.
    """

    def __init__(self, p: Problem, points: np.ndarray):
        self.p, self.call = p, p.compiled(_walks)
        k, n = points.shape
        self.width = WIDTH if n * p.size <= LARGE else 1
        nothing, no = np.zeros(k), np.zeros(k, bool)
        self.at = Walk(
            np.array(points), np.full((k, p.residual_count), np.inf),
            np.zeros((k, p.residual_count, n)), np.zeros((k, n)), nothing + DAMPING, nothing + 2.0,
            np.zeros(k, int), no, no.copy(), np.array(points), nothing,
        )  # fmt: skip

    @property
    def done(self) -> np.ndarray:
        """True for each start that has come to rest or cannot move."""
        return self.at.rested | self.at.stuck

    def go(self, lanes: np.ndarray, limit: int, until: float | None) -> None:
        """Move some searches on to a number of steps, or until a moment on the clock."""
        reached = limit if until is None else 0
        while True:
            reached = min(max(reached, int(np.min(self.at.steps[lanes])) + SEGMENT), limit)
            moving = lanes[~self.done[lanes]]
            for some in np.split(moving, range(self.width, len(moving), self.width)):
                self._move(some, reached)
            unfinished = ~self.done[lanes] & (self.at.steps[lanes] < limit)
            if not unfinished.any() or (until is not None and time.perf_counter() >= until):
                return

    def _move(self, some: np.ndarray, limit: int) -> None:
        begin = jax.tree.map(lambda part: part[some], (self.at.theta, self.at.memory))
        for own, part in zip(self.at, self._called(limit, *begin), strict=True):
            own[some] = part

    def _called(self, limit: int, theta: np.ndarray, memory: tuple[np.ndarray, ...]) -> Walk:
        """The call for no more searches than its width, filled up with the first of them."""
        k, fill = len(theta), self.width - len(theta)
        every = theta, memory, np.full(k, limit)
        filled = jax.tree.map(lambda v: np.concatenate([v, np.repeat(v[:1], fill, axis=0)]), every)
        found = self.call(*filled, self.p.lower, self.p.upper)
        return Walk(*(np.asarray(part)[:k] for part in found))

    @property
    def cost(self) -> np.ndarray:
        """Half the sum of squares of each; infinite where something is not finite."""
        cost = 0.5 * np.sum(self.at.residual**2, axis=1)
        return np.where(np.isfinite(cost), cost, np.inf)

    def look(self, points: np.ndarray) -> np.ndarray:
        """Cost at points, without moving."""
        parts = np.split(points, range(self.width, len(points), self.width))
        fresh = (Lanes(self.p, part).at for part in parts)
        found = [self._called(0, at.theta, at.memory).residual for at in fresh]
        return np.concatenate([0.5 * np.sum(residual**2, axis=1) for residual in found])

    def move(self, lane: int, point: np.ndarray) -> None:
        """Begin one search anew."""
        self.at.theta[lane], self.at.scale[lane] = point, 0.0
        self.at.damping[lane], self.at.growth[lane] = DAMPING, 2.0
        self.at.rested[lane] = self.at.stuck[lane] = False


class ManyLanes(Lanes):
    """The same for many free numbers, one search after the other outside JAX.

    Steps solve normal equations, sparse where the problem is, and are corrected by the residual
    that they leave (corrected seminormal equations: Å. Björck, Linear Algebra Appl. 88/89 (1987)
    31).
    """

    def __init__(self, p: Problem, points: np.ndarray):
        self.p, self.width = p, 1
        k, n = points.shape
        nothing, no = np.zeros(k), np.zeros(k, bool)
        self.at = Walk(
            np.array(points), np.full((k, p.residual_count), np.inf), np.empty(k, object),
            np.zeros((k, n)), nothing + DAMPING, nothing + 2.0, np.zeros(k, int), no, no.copy(),
            np.array(points), nothing,
        )  # fmt: skip

    def look(self, points: np.ndarray) -> np.ndarray:
        """Cost at points, without moving."""
        look = self.p.compiled(problem_residual)
        found = (np.asarray(look(point)) for point in points)
        return np.array([0.5 * residual @ residual for residual in found])

    def slopes(self, theta: np.ndarray) -> tuple[np.ndarray, Rows]:
        """Residuals and their Jacobian, in as few sweeps as its pattern allows."""
        pattern = self.p.pattern
        if pattern is not None:
            r, swept = map(np.asarray, self.p.compiled(_swept)(theta, pattern.seeds))
            found = pattern.matrix(swept)
            if pattern.holds(found, swept):
                return r, found
        r, found = self.p.compiled(sloped)(theta)
        return np.asarray(r), np.asarray(found)

    def _move(self, some: np.ndarray, limit: int) -> None:
        for lane in some:
            memory = tuple(part[lane] for part in self.at.memory)
            walked = self._walk(self.at.theta[lane], memory, limit)
            for own, part in zip(self.at, walked, strict=True):
                own[lane] = part

    def _walk(self, theta: np.ndarray, memory: tuple[Any, ...], limit: int) -> Walk:
        """`walk`, looking at one point tried after the other."""
        p, (damping, growth, scale, steps), rested = self.p, memory, False
        theta = np.clip(theta, p.lower, p.upper)
        r, j = self.slopes(theta)
        while not (stuck := damping > STUCK or not np.isfinite(r.sum() + j.sum())):
            scale = np.maximum(scale, lengths(j))
            try:
                trial = _next_of_many(theta, r, j, scale, damping, p.lower, p.upper)
            except np.linalg.LinAlgError:
                damping, growth, steps = max(damping, RIDGE) * growth, 2.0 * growth, steps + 1
                continue
            change = trial - theta
            moved = j @ change
            promised = -(r @ moved) - 0.5 * moved @ moved
            rested = np.linalg.norm(scale * change) <= TOLERANCE * np.linalg.norm(scale * theta)
            if rested or steps >= limit:
                break
            new, slope = self.slopes(trial)
            steps += 1
            ratio = 0.5 * (r - new) @ (r + new) / promised if promised > 0 else -1.0
            # A step that promises next to nothing cannot be judged: it is taken, as the last.
            rested = bool(0 <= promised <= FINISHED * (r @ r)) and np.isfinite(slope.sum())
            if rested:
                theta, r, j = trial, new, slope
                break
            if ratio > 1e-4 and np.isfinite(slope.sum()):
                theta, r, j = trial, new, slope
                damping, growth = damping * _easing(ratio), 2.0
            else:
                damping, growth = damping * growth, 2.0 * growth
        return Walk(theta, r, j, scale, damping, growth, steps, rested, stuck, theta, 0.0)


def _next_of_many(theta, residual, jacobian, scale, damping, lower, upper) -> np.ndarray:
    """`_next`, by normal equations of the numbers that are not pinned."""
    unit = np.where(scale > 0, scale, 1.0)
    low, high = (lower - theta) * unit, (upper - theta) * unit
    rows = in_units(jacobian, unit)
    normal, g = rows.T @ rows, rows.T @ residual
    pinned = ((low >= 0) & (g > 0)) | ((high <= 0) & (g < 0)) | (lower >= upper)
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
    inside = np.clip(theta + held / unit, lower, upper)
    return np.where(held <= low, lower, np.where(held >= high, upper, inside))


def lanes_of(p: Problem, points: np.ndarray) -> Lanes:
    """Searches from points, by the method for as many free numbers as there are."""
    return (Lanes if len(p.start) <= FEW else ManyLanes)(p, points)


def _swept(core, theta, seeds):
    """Residuals, and the products of their Jacobian with some directions."""
    r, along = jax.linearize(partial(problem_residual, core), theta)
    return r, jax.vmap(along)(seeds)


def _walks(core, starts, memory, limit, lower, upper) -> Walk:
    """Searches from starts, each with its own memory and limit of steps."""
    residual, moves = partial(problem_residual, core), jnp.any(limit > 0)

    def one(theta, memory, limit):
        return walk(residual, theta, lower, upper, limit, memory=memory, moves=moves)

    return jax.vmap(one)(starts, memory, limit)
