"""Limits that a response keeps over the range of its runs: of its parameters and their slopes.

Where a network gives the parameters, limits are certified: they hold for an enclosure of the
network over each cell of the range, so that they hold between the readings as well.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.dynamics.model import PreparedOutput
from beamfit.dynamics.response import ARX, Physics
from beamfit.errors import InputError, nearest
from beamfit.greybox.bounds import cells, value_bounds
from beamfit.greybox.gains import certified_gain
from beamfit.greybox.problem import Constraint

# Cells into which a range is split for bounds, in all; fewer each along several inputs.
CELLS = 32


class LimitedParameter(NamedTuple):
    """Bounds of constant raw numbers, and constraints on a network of them."""

    lower: np.ndarray
    upper: np.ndarray
    constraints: tuple[Constraint, ...]


@dataclass(frozen=True)
class _Value:
    """Lower or upper end of an output's enclosure in every cell; equal ones share compiled code."""

    output: int
    end: str

    def __call__(self, model: Any, corners: tuple[jax.Array, jax.Array]) -> jax.Array:
        bound = jax.vmap(lambda a, b: value_bounds(model["map"], a, b))(*corners)
        return getattr(bound, self.end)[:, self.output]


def cells_of(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cells of a range of the inputs, as in `beamfit.greybox.bounds.cells`."""
    return cells(low, high, _each(low))


def _each(low: np.ndarray) -> int:
    return max(2, int(CELLS ** (1.0 / len(low))))


def limited(
    told: Mapping[str, tuple[float, float]], seen: PreparedOutput, physics: Physics, network: bool
) -> LimitedParameter:
    """State limits such as {"K": (1.0, 3.0), "dK/dvalve": (0.0, inf)}.

    Raises
    ------
    InputError
        If one names nothing, is no range, or is of what has no certified limit.
    """
    names, inputs = physics.parameters(seen.inputs), seen.inputs
    slopes = {f"d{name}/d{by}": (name, by) for name in names for by in inputs}
    logs = {n for n, (_, gain) in zip(names, physics.units(len(inputs)), strict=True) if not gain}
    lower, upper = np.full(len(names), -np.inf), np.full(len(names), np.inf)
    box, found = (seen.points.min(axis=0), seen.points.max(axis=0)), []
    for what, (low, high) in told.items():
        if what not in (*names, *slopes):
            raise InputError(f"a limit of '{what}'", nearest(what, [*names, *slopes]))
        name, by = slopes.get(what, (what, None))
        if not low < high or (physics is ARX and name in logs):
            expected = "limits of b1 and b2" if low < high else "the lower one first"
            raise InputError(f"limits {low:g} to {high:g} of {what}", expected)
        if by is None:
            ends = [(np.log(v) if v > 0 else -np.inf) if name in logs else v for v in (low, high)]
            i = names.index(name)
            lower[i], upper[i] = ends
            corners = tuple(jnp.asarray(c) for c in cells_of(*box))
            found += [Constraint(f"least {name}", _Value(i, "lower"), corners, lower=ends[0])]
            found += [Constraint(f"most {name}", _Value(i, "upper"), corners, upper=ends[1])]
        elif not network or (name in logs and {low, high} - {0.0, -np.inf, np.inf}):
            expected = f"a sign of it, d{name}/d{by}=0: or :0" if network else "--map network"
            raise InputError(f"limits {low:g} to {high:g} of {what}", expected)
        else:
            found += certified_gain("map", name, by, box, _each(box[0]), lower=low, upper=high)
    finite = [c for c in found if np.isfinite([c.lower, c.upper]).any()]
    return LimitedParameter(lower, upper, tuple(finite) if network else ())
