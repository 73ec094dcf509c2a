"""Noise with a memory: a part that wanders with a correlation time, and a part without memory.

One lag tells neither: white noise on top of a drift has neighbours that hardly resemble each other,
and a drift all the same. Both parts are estimated together, and averaged over what stays open.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.greybox.correlated import Memory, Noise, innovations, noises, range_of
from beamfit.greybox.covariance import CUT

# Correlation times looked at, and variances of the part without memory, in those that the part
# that wanders gets anew from one sample to the next.
TIMES, WHITE = 16, (0.0, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 1000.0)
# Numbers that one sweep through the readings holds, of as many noises as that makes.
AT_ONCE = 2**20


@jax.jit
def _triangles(rows: jax.Array, time: jax.Array, grid: Noise) -> tuple[jax.Array, jax.Array]:
    def of(noise):
        white, volume = innovations(rows, time, noise)
        return jnp.linalg.qr(white, mode="r"), volume

    return jax.lax.map(of, grid, batch_size=max(1, AT_ONCE // rows.size))


def noise_of(
    rows: Sequence[np.ndarray],
    time: Sequence[np.ndarray],
    known: np.ndarray,
    noise: Noise | None = None,
) -> tuple[Memory, Noise, float]:
    """The noise by what residuals say of it, all runs together, and its size in units of theirs.

    `rows` hold the slopes of each run's residuals and, last, the residuals, in units of their
    noise; `known` those of the priors; `noise` is it if it is known. As
    `beamfit.greybox.correlated.memory_of`: restricted likelihood, flat in the logarithms of the
    time and of the ratio of the two variances.
    """
    apart = min(float(np.median(np.diff(t))) for t in time)
    ends = np.array([range_of(t) for t in time])
    grid = noises((ends[:, 0].min(), ends[:, 1].max()), apart, TIMES, WHITE)
    grid = grid if noise is None else [noise]
    count, p = sum(map(len, rows)), rows[0].shape[1] - 1
    stacked = Noise(*(np.array(part) for part in zip(*grid, strict=True)))
    white = [_triangles(r, t, stacked) for r, t in zip(rows, time, strict=True)]
    triangles = [*(r for r, _ in white), np.tile(known, (len(grid), 1, 1))]
    found = [_at(whole, count + len(known)) for whole in np.concatenate(triangles, axis=1)]
    logs, step, half, squares = (np.array(part) for part in zip(*found, strict=True))
    logs -= sum(np.asarray(volume) for _, volume in white)
    weight = np.exp(logs - logs.max())
    weight, dof = weight / weight.sum(), count + len(known) - p
    memory = Memory(weight, *stacked, step, half, squares, dof)
    best = int(np.argmax(weight))
    return memory, grid[best], float(np.sqrt(squares[best] / memory.dof))


def _at(whole: np.ndarray, count: int) -> tuple[float, np.ndarray, np.ndarray, float]:
    """Log probability but for the noise's volume, step, half and squares for one noise."""
    slopes, rest = whole[:, :-1], whole[:, -1]
    length = np.linalg.norm(slopes, axis=0)
    unit = 1.0 / np.where(length > 0, length, 1.0)
    left, sizes, turned = np.linalg.svd(slopes * unit, full_matrices=False)
    seen = sizes > CUT * sizes.max(initial=0.0)
    half = unit[:, None] * np.where(seen, turned.T / np.where(seen, sizes, 1.0), 0.0)
    along = np.where(seen, left.T @ rest, 0.0)
    squares = max(float(rest @ rest - along @ along), 1e-300)
    log = -np.sum(np.log((sizes / unit)[seen]))
    return log - 0.5 * (count - seen.sum()) * np.log(squares), -half @ along, half, squares
