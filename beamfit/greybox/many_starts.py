"""Bounded least squares from many starts at once, as one compiled and vectorised call.

The same method as `beamfit.greybox.gauss_newton` (Levenberg-Marquardt, Moré's column scaling,
Nielsen's damping, steps that end exactly on bounds), written for `jax.vmap`: small networks are
fitted from twenty starts in the time of a few. It proposes points; whether one is an optimum is
for `beamfit.greybox.solve` to say, which starts from the best of them.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

__all__ = ["Found", "descend_all", "descend_one"]

# A point is at rest when no loose number changes the cost by more than this, per unit of residual.
_LEVEL = 1e-9


class Found(NamedTuple):
    """Where each start ended: numbers, half the sum of squares, steps, and whether it rested."""

    theta: Array
    cost: Array
    steps: Array
    rested: Array


class _State(NamedTuple):
    theta: Array
    residual: Array
    jacobian: Array
    scale: Array
    damping: Array
    growth: Array
    steps: Array
    rested: Array


@partial(jax.jit, static_argnames=("residual", "iterations"))
def descend_all(
    residual: Callable[..., Array],
    data: object,
    starts: Array,
    lower: Array,
    upper: Array,
    iterations: int = 300,
    tolerance: float = 1e-10,
) -> Found:
    """Minimise half the sum of squares within bounds from every start.

    Parameters
    ----------
    residual : callable
        ``residual(data, theta)``, shape (m,), in JAX; defined at the top of a module, so that it
        is compiled once.
    data : pytree
        What it needs; the same for all starts.
    starts : array, shape (k, n)
        Where to start, within the bounds and where the residual is finite.
    lower, upper : array, shape (n,)
        Bounds; equal ends hold a number fixed.
    iterations : int
        Most steps, refused ones too.
    tolerance : float
        On the length of a step relative to theta, both in units of the Jacobian's columns.

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

    return jax.vmap(one)(starts)


def descend_one(
    residual: Callable[[Array], Array],
    start: Array,
    lower: Array,
    upper: Array,
    iterations: int = 300,
    tolerance: float = 1e-10,
) -> Found:
    """Minimise from one start; a pure JAX function, to be vectorised over anything.

    Parameters
    ----------
    residual : callable
        ``residual(theta)``, shape (m,).
    start, lower, upper, iterations, tolerance
        As for `descend_all`.

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
    jacobian = jax.jacfwd(residual)

    def step(s: _State) -> _State:
        slope = s.jacobian.T @ s.residual
        change = _step(s, slope, lower, upper)
        new = jnp.clip(s.theta + change, lower, upper)
        change = new - s.theta
        r = residual(new)
        gained = 0.5 * (s.residual - r) @ (s.residual + r)
        promised = -(slope @ change) - 0.5 * jnp.sum((s.jacobian @ change) ** 2)
        small = jnp.linalg.norm(s.scale * change) <= tolerance * jnp.linalg.norm(s.scale * s.theta)
        blocked = ((s.theta <= lower) & (slope > 0)) | ((s.theta >= upper) & (slope < 0))
        unit = jnp.where(s.scale > 0, s.scale, 1.0)
        level = jnp.max(jnp.where(blocked, 0.0, jnp.abs(slope / unit)))
        nothing = level <= _LEVEL * jnp.maximum(jnp.linalg.norm(s.residual), 1.0)
        ratio = jnp.where((promised > 0) & jnp.isfinite(gained), gained / promised, -1.0)
        good = ratio > 1e-4
        j = jacobian(jnp.where(good, new, s.theta))
        eased = s.damping * jnp.maximum(1 / 3, 1 - (2 * jnp.minimum(ratio, 1.0) - 1) ** 3)
        return _State(
            theta=jnp.where(good, new, s.theta),
            residual=jnp.where(good, r, s.residual),
            jacobian=j,
            scale=jnp.maximum(s.scale, jnp.linalg.norm(j, axis=0)),
            damping=jnp.where(good, eased, s.damping * s.growth),
            growth=jnp.where(good, 2.0, 2.0 * s.growth),
            steps=s.steps + 1,
            rested=small | nothing | (s.damping > 1e30),
        )

    start = jnp.clip(start, lower, upper)
    j = jacobian(start)
    first = _State(
        theta=start,
        residual=residual(start),
        jacobian=j,
        scale=jnp.linalg.norm(j, axis=0),
        damping=jnp.asarray(1e-3),
        growth=jnp.asarray(2.0),
        steps=jnp.asarray(0),
        rested=jnp.asarray(False),
    )
    s = jax.lax.while_loop(lambda s: ~s.rested & (s.steps < iterations), step, first)
    return Found(s.theta, 0.5 * s.residual @ s.residual, s.steps, s.rested)


def _step(s: _State, slope: Array, lower: Array, upper: Array) -> Array:
    """Solve the damped linear problem, pinning numbers that would leave their bounds.

    Two rounds of pinning: what the second round pushes out is clipped by the caller, and the
    gain is judged on the step as taken.
    """
    unit = jnp.where(s.scale > 0, s.scale, 1.0)
    low, high = (lower - s.theta) * unit, (upper - s.theta) * unit
    j, g = s.jacobian / unit, slope / unit
    pinned = ((low >= 0) & (g > 0)) | ((high <= 0) & (g < 0)) | (lower >= upper)
    held = jnp.zeros_like(g)
    normal = j.T @ j + s.damping * jnp.eye(len(g))
    for _ in range(2):
        right = jnp.where(pinned, held, -g - normal @ jnp.where(pinned, held, 0.0))
        mask = pinned[:, None] | pinned[None, :]
        matrix = jnp.where(mask, jnp.eye(len(g)), normal)
        tried = jnp.where(pinned, held, jax.scipy.linalg.cho_solve((_factor(matrix), True), right))
        clipped = jnp.clip(tried, low, high)
        pinned, held = pinned | (clipped != tried), clipped
    return jnp.where(jnp.all(jnp.isfinite(held)), held, 0.0) / unit


def _factor(matrix: Array) -> Array:
    return jnp.linalg.cholesky(matrix)
