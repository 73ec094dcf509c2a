"""Ranges of inputs under which outputs keep their limits, whatever the inputs do within them.

A first order stays between the values it settles at, whatever its time constant is; a second order
of constant damping passes them by its overshoot. What it settles at is enclosed by certified gains.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.dynamics.fit import ResponseFit
from beamfit.dynamics.limits import cells_of
from beamfit.dynamics.response import FIRST_ORDER, PHYSICS, SECOND_ORDER
from beamfit.errors import InputError, nearest
from beamfit.greybox.activations import Range
from beamfit.greybox.bounds import value_bounds
from beamfit.greybox.mlp import MLP

# Bisections for an end of a range: to 1e-9 of it.
HALVINGS = 30


def certain_range(
    fits: Sequence[ResponseFit],
    hard: Mapping[str, tuple[float, float]],
    box: tuple[np.ndarray, np.ndarray],
    ends: Mapping[str, tuple[float, float]],
) -> tuple[np.ndarray, np.ndarray]:
    """The range of the inputs, narrowed around their means in the runs, or from an end.

    `hard` says by what share gains may be off, and how large a disturbance may be; `ends` what each
    output has to stay within.
    """
    known = {fit.output: fit for fit in fits}
    for name, (share, load) in hard.items():
        if name not in known or not np.isfinite(ends[name]).any():
            expected = f"{nearest(name, list(known))}, with limits"
            raise InputError(f"hard limits of '{name}'", expected)
        if not (0 <= share < 1 and load >= 0):
            said = f"gains off by {share:g} and disturbances of {load:g}"
            raise InputError(said, "a share below 1, and none below 0")

    def keeps(low: np.ndarray, high: np.ndarray) -> bool:
        reach = {name: _reach(known[name], share, low, high) for name, (share, _) in hard.items()}
        return all(ends[n][0] + hard[n][1] <= a and b <= ends[n][1] - hard[n][1]
                   for n, (a, b) in reach.items())  # fmt: skip

    begins = (np.clip(fits[0].seen.mean_u, *box), *box)
    middle = next((u for u in begins if keeps(u, u)), None)
    if middle is None:
        raise InputError(f"hard limits of {', '.join(hard)}", "ones that some inputs keep")
    found = [middle.copy(), middle.copy()]
    for i in range(len(middle)):
        for side in (0, 1):
            inner, outer = middle[i], box[side][i]
            for k in range(HALVINGS):
                found[side][i] = outer if k == 0 else 0.5 * (inner + outer)
                if keeps(*found):
                    inner = found[side][i]
                else:
                    outer = found[side][i]
            found[side][i] = inner
    return found[0], found[1]


@jax.jit
def _enclosed(net: MLP, lower: jax.Array, upper: jax.Array) -> Range:
    return jax.vmap(lambda a, b: value_bounds(net, a, b))(lower, upper)


def _reach(
    fit: ResponseFit, share: float, low: np.ndarray, high: np.ndarray
) -> tuple[float, float]:
    """Least and most of an output under inputs of a range, at rest to begin with."""
    physics, of = PHYSICS[fit.model], fit.fit.model["map"]
    m, overshoot = len(low), 1.0
    if not (physics is FIRST_ORDER or (physics is SECOND_ORDER and not callable(of))):
        expected = "a first order, or a second one with constant parameters"
        raise InputError(f"hard limits of {fit.output} by {fit.model}", expected)
    lower, upper = cells_of(low, high)
    if callable(of):
        bound = _enclosed(of, jnp.asarray(lower), jnp.asarray(upper))
        gains = np.stack([np.asarray(end)[:, -m:] for end in bound])
    else:
        p = np.asarray(physics.physical(of, m))
        gains = np.broadcast_to(p[-m:], (2, len(lower), m))
        if physics is SECOND_ORDER and p[1] < 1:
            # The integral of |impulse response| over the gain: every input within +-1 is within it.
            overshoot = 1.0 / np.tanh(0.5 * np.pi * p[1] / np.sqrt(1.0 - p[1] ** 2))
    off = np.stack([gains * (1.0 - share), gains * (1.0 + share)])
    each = np.stack([off * u for u in (lower, upper)]).reshape(-1, len(lower), m)
    least, most = each.min(axis=0).sum(axis=1).min(), each.max(axis=0).sum(axis=1).max()
    middle, half = 0.5 * (least + most), 0.5 * (most - least) * overshoot
    level = float(fit.fit.model["offset"])
    return level + middle - half, level + middle + half
