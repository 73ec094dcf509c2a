"""Noise with a memory: a part that wanders with a correlation time, and a part without memory.

One lag tells neither: white noise on top of a drift has neighbours that hardly resemble each other,
and a drift all the same. Both parts are estimated together, and averaged over what stays open.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from beamfit.greybox.memory import Memory, noises, range_of, whitened_by_each
from beamfit.noise.correlated import Noise

# Correlation times looked at, and variances of the part without memory, in those that the part
# that wanders gets anew from one sample to the next.
TIMES, WHITE = 16, (0.0, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 1000.0)


def noise_of(
    rows: Sequence[np.ndarray],
    time: Sequence[np.ndarray],
    known: np.ndarray,
    noise: Noise | None = None,
) -> tuple[Memory, Noise, float]:
    """The noise by what residuals say of it, all runs together, and its size in units of theirs.

    `rows` hold the slopes of each run's residuals and, last, the residuals, in units of their
    noise; `known` those of the priors; `noise` is it if it is known.
    """
    apart = min(float(np.median(np.diff(t))) for t in time)
    ends = np.array([range_of(t) for t in time])
    grid = noises((ends[:, 0].min(), ends[:, 1].max()), apart, TIMES, WHITE)
    grid = grid if noise is None else [noise]
    memory = whitened_by_each(grid, list(zip(rows, time, strict=True)), known).memory()
    best = int(np.argmax(memory.weight))
    return memory, grid[best], float(np.sqrt(memory.squares[best] / memory.dof))
