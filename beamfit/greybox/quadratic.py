"""Small dense quadratic programs inside JAX: limits of a plan, solved again at every step."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_factor, cho_solve

# Most steps; mean complementarity and residuals that end them; share of the step to a limit.
STEPS, CLOSE, SHARE = 40, 1e-9, 0.99


class Quadratic(NamedTuple):
    """Find the least z'Hz/2 + g'z + cost's with G z <= h + s, s >= 0.

    Shapes (n, n), (n,), (rows, n), (rows,), (rows,). A row of infinite cost is hard; another is
    kept wherever its multiplier is below its cost. H must be positive.
    """

    matrix: jax.Array
    slope: jax.Array
    rows: jax.Array
    limits: jax.Array
    cost: jax.Array


class _Point(NamedTuple):
    """Variables, room left in each row, its multiplier, and by how much it is passed."""

    z: jax.Array
    room: jax.Array
    force: jax.Array
    passed: jax.Array


def minimum(problem: Quadratic, start: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Solve a quadratic program by a primal-dual interior point.

    Parameters
    ----------
    problem : Quadratic
        Well scaled; it must have a point that keeps the hard rows.
    start : array, shape (n,)
        Any point.

    Returns
    -------
    (array, shape (n,); array, shape (rows,))
        The minimum and the multipliers of the rows.

    Notes
    -----
    Predictor and corrector of S. Mehrotra, SIAM J. Optim. 2 (1992) 575; for quadratic programs
    J. Nocedal and S. Wright, Numerical Optimization (2006), algorithm 16.4. The multiplier of a
    soft row and that of its s add to its cost, so both are eliminated. At most 40 steps, each with
    one factorisation; it can be mapped and compiled.

    Examples
    --------
    >>> one, inf = jnp.array, jnp.inf
    >>> box = Quadratic(jnp.eye(2), one([-3.0, 0.5]), jnp.eye(2), one([1.0, 2.0]), one([inf, inf]))
    >>> z, force = minimum(box, jnp.zeros(2))
    >>> z.round(6).tolist(), force.round(6).tolist()
    ([1.0, -0.5], [2.0, 0.0])
    >>> minimum(box._replace(cost=one([0.5, 0.5])), z)[0].round(6).tolist()
    [2.5, -0.5]
    """
    if problem.rows.shape[0] == 0:
        return jnp.linalg.solve(problem.matrix, -problem.slope), problem.limits
    soft, half = jnp.isfinite(problem.cost), 0.5 * problem.cost
    room = jnp.maximum(problem.limits - problem.rows @ start, 1.0)
    first = _Point(start, room, jnp.minimum(1.0, half), 1.0 * soft)
    # Multipliers of the size that the problem's have (Nocedal and Wright, section 16.6).
    step = _towards(problem, first)(room * first.force, 0.0 * room)
    room, force, passed = (
        jnp.maximum(jnp.abs(v + d), 1.0) for v, d in zip(first[1:], step[1:], strict=True)
    )
    begin = _Point(start, room, jnp.minimum(force, half), soft * passed)
    end, _, _ = jax.lax.while_loop(
        lambda now: (now[1] > CLOSE) & (now[2] < STEPS),
        lambda now: _next(problem, now[0], now[2]),
        (begin, jnp.asarray(jnp.inf), jnp.asarray(0)),
    )
    return end.z, end.force


def _residuals(problem: Quadratic, now: _Point) -> tuple[jax.Array, jax.Array]:
    dual = problem.matrix @ now.z + problem.slope + problem.rows.T @ now.force
    return dual, problem.rows @ now.z + now.room - now.passed - problem.limits


def _other(problem: Quadratic, now: _Point) -> jax.Array:
    """Multipliers of the s of soft rows; 1 of hard ones, which have none."""
    return jnp.where(jnp.isfinite(problem.cost), problem.cost - now.force, 1.0)


def _towards(problem: Quadratic, now: _Point) -> Callable[[jax.Array, jax.Array], _Point]:
    """Steps on which room * force and passed * other fall by so much, the residuals to nothing."""
    rows, other, (dual, primal) = problem.rows, _other(problem, now), _residuals(problem, now)
    weight = 1.0 / (now.room / now.force + now.passed / other)
    factor = cho_factor(problem.matrix + rows.T @ (rows * weight[:, None]))

    def step(inner, outer):
        lack = primal - inner / now.force + outer / other
        dz = -cho_solve(factor, dual + rows.T @ (weight * lack))
        d_force = weight * (rows @ dz + lack)
        d_passed = (now.passed * d_force - outer) / other
        return _Point(dz, (-inner - now.room * d_force) / now.force, d_force, d_passed)

    return step


def _next(problem: Quadratic, now: _Point, steps: jax.Array) -> tuple[_Point, jax.Array, jax.Array]:
    """Predict, correct, and say how far the point is from the minimum."""
    soft, towards = jnp.isfinite(problem.cost), _towards(problem, now)
    inner, outer = now.room * now.force, now.passed * _other(problem, now)
    far = towards(inner, outer)
    reach = _reach(problem, now, far)
    gap, after = _gap(problem, now), _gap(problem, _along(now, far, reach))
    centre = gap * (after / gap) ** 3
    corrected = soft * (outer - far.passed * far.force - centre)
    way = towards(inner + far.room * far.force - centre, corrected)
    new = _along(now, way, SHARE * _reach(problem, now, way))
    dual, primal = _residuals(problem, new)
    dual = jnp.max(jnp.abs(dual)) / (1.0 + jnp.max(jnp.abs(problem.slope)))
    left = jnp.maximum(jnp.maximum(dual, jnp.max(jnp.abs(primal))), _gap(problem, new))
    good = jnp.isfinite(left)
    kept = (jnp.where(good, a, b) for a, b in zip(new, now, strict=True))
    # A point that is not finite ends the search: rounding leaves nothing to gain.
    return _Point(*kept), jnp.where(good, left, 0.0), steps + 1


def _along(now: _Point, way: _Point, reach: jax.Array) -> _Point:
    return _Point(*(v + reach * d for v, d in zip(now, way, strict=True)))


def _gap(problem: Quadratic, now: _Point) -> jax.Array:
    """Mean of multipliers times what they guard."""
    count = now.room.size + jnp.sum(jnp.isfinite(problem.cost))
    return (now.room @ now.force + now.passed @ _other(problem, now)) / count


def _reach(problem: Quadratic, now: _Point, way: _Point) -> jax.Array:
    """Longest step, at most 1, that keeps all slacks and multipliers positive."""
    soft = jnp.isfinite(problem.cost)
    values = jnp.concatenate([now.room, now.force, now.passed, _other(problem, now)])
    changes = jnp.concatenate([way.room, way.force, way.passed, -1.0 * soft * way.force])
    return jnp.min(jnp.where(changes < 0, -values / changes, 1.0), initial=1.0)
