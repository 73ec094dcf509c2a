"""Trust-region Gauss-Newton for least squares within bounds.

Levenberg-Marquardt with Moré's column scaling (Moré 1978, Numerical Analysis, LNM 630, 105) and
Nielsen's damping (IMM-REP-1999-05); a step solves the damped linear problem inside the bounds by
pinning the numbers that would leave, so iterates end exactly on active bounds. scipy's bounded
methods stay strictly inside them, which blurs the verdict "at its bound".
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

__all__ = ["Descent", "descend"]


class Descent(NamedTuple):
    """Where a descent ended, after how many steps, and whether it came to rest."""

    x: np.ndarray
    iterations: int
    rested: bool


def descend(
    linearise: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
    x: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    iterations: int = 1000,
    tolerance: float = 1e-13,
) -> Descent:
    """Minimise half the sum of squares within bounds.

    Parameters
    ----------
    linearise : callable
        ``linearise(x)`` gives the residuals, shape (m,), and their Jacobian, shape (m, n): nearly
        every step is accepted, and two calls cost more than one.
    x : array, shape (n,)
        Start; its residuals are finite.
    lower, upper : array, shape (n,)
        Bounds, lower < upper.
    iterations : int
        Most accepted and refused steps together.
    tolerance : float
        On the length of a step relative to x, both in units of the columns of the Jacobian.

    Returns
    -------
    Descent

    Examples
    --------
    >>> def linearise(x):
    ...     return np.array([x[0] - 3.0, 2.0 * x[1]]), np.diag([1.0, 2.0])
    >>> found = descend(linearise, np.array([0.0, 1.0]), np.array([-1.0, 0.5]), np.full(2, 9.0))
    >>> np.round(found.x, 12).tolist()
    [3.0, 0.5]
    """
    x = np.clip(x, lower, upper)
    (r, j), n = linearise(x), len(x)
    scale, damping, growth, fresh = np.zeros(n), 1e-3, 2.0, True
    for count in range(iterations):
        if fresh:
            if not np.all(np.isfinite(j)):
                return Descent(x, count, False)
            scale = np.maximum(scale, np.linalg.norm(j, axis=0))
            both = np.linalg.qr(np.column_stack([j, r]), mode="r")
            triangle, reduced, slope = both[:n, :n], both[:n, n], j.T @ r
        blocked = ((x <= lower) & (slope > 0)) | ((x >= upper) & (slope < 0))
        weight = np.sqrt(damping) * np.where(scale > 0, scale, 1.0)
        step = _step(triangle, reduced, weight, lower - x, upper - x, blocked)
        new = np.clip(x + step, lower, upper)
        step = new - x
        promised = -(slope @ step) - 0.5 * np.sum((triangle @ step) ** 2)
        if np.linalg.norm(scale * step) <= tolerance * np.linalg.norm(scale * x):
            return Descent(x, count, True)
        r_new, j_new = linearise(new)
        gained = 0.5 * (r - r_new) @ (r + r_new)
        # Pinning can spoil a long step; a short one always promises something.
        ratio = gained / promised if np.isfinite(gained) and promised > 0 else -1.0
        fresh = ratio > 1e-4
        if fresh:
            x, r, j = new, r_new, j_new
            damping *= max(1 / 3, 1 - (2 * min(ratio, 1.0) - 1) ** 3)
            growth = 2.0
        elif promised <= 1e-16 * (r @ r):
            return Descent(x, count, True)  # what is promised is below rounding
        elif damping > 1e30:
            return Descent(x, count, False)  # no step however short lowers the cost
        else:
            damping, growth = damping * growth, 2 * growth
    return Descent(x, iterations, False)


def _step(triangle, reduced, weight, low, high, blocked) -> np.ndarray:
    """Solve the damped linear problem inside low <= step <= high, pinning what would leave."""
    step = np.zeros(len(low))
    pinned = blocked.copy()
    while not pinned.all():
        loose = ~pinned
        left = np.vstack([triangle[:, loose], np.diag(weight[loose])])
        right = np.concatenate(
            [-reduced - triangle[:, pinned] @ step[pinned], np.zeros(loose.sum())]
        )
        step[loose] = np.linalg.lstsq(left, right, rcond=None)[0]
        leaving = loose & ((step < low) | (step > high))
        if not leaving.any():
            break
        step = np.clip(step, low, high)
        pinned |= leaving
    return step
