"""Constraints on gains: at points, or certified everywhere in a box (report 3.1.3, eqs 38-39)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.errors import InputError
from beamfit.greybox.bounds import cells, gain_bounds
from beamfit.greybox.maps import positions
from beamfit.greybox.sensitivity import gain
from beamfit.greybox.terms import Constraint

__all__ = ["certified_gain", "gain_at", "part"]


def part(model: Any, path: str) -> Any:
    """Walk to a part of the model.

    Parameters
    ----------
    model : pytree
        The model.
    path : str
        Attribute names, keys and positions joined by dots; ``""`` is the model itself.

    Returns
    -------
    Any

    Raises
    ------
    InputError
        If the path leads nowhere.

    Examples
    --------
    >>> part({"map": (1, 2)}, "map.1")
    2
    """
    for step in path.split(".") if path else ():
        try:
            if isinstance(model, dict):
                model = model[step]
            elif isinstance(model, list | tuple) and step.isdigit():
                model = model[int(step)]
            else:
                model = getattr(model, step)
        except (KeyError, IndexError, AttributeError):
            raise InputError(f"no '{step}' on the path '{path}'", "a part of the model") from None
    return model


@dataclass(frozen=True)
class _GainAt:
    """The function of a point constraint; equal ones share their compiled code."""

    path: str
    output: str
    by: tuple[str, ...]

    def __call__(self, model: Any, points: jax.Array) -> jax.Array:
        m = part(model, self.path)
        return jax.vmap(lambda x: gain(m, x, self.output, self.by))(points)


@dataclass(frozen=True)
class _CertifiedGain:
    """The function of a certified constraint: one end of the enclosure in every cell."""

    path: str
    output: str
    by: str
    end: str

    def __call__(self, model: Any, corners: tuple[jax.Array, jax.Array]) -> jax.Array:
        net = part(model, self.path)
        bound = jax.vmap(lambda a, b: gain_bounds(net, a, b))(*corners)
        row = positions([self.output], [port.name for port in net.output_ports], "output")[0]
        column = positions([self.by], net.inputs, "input")[0]
        return getattr(bound, self.end)[:, row, column]


def gain_at(
    path: str,
    output: str,
    by: Sequence[str],
    points,
    lower: float = -np.inf,
    upper: float = np.inf,
) -> Constraint:
    """Constrain a gain of order 1 to 3 at points; between them it stays free.

    Parameters
    ----------
    path : str
        Where the map is in the model.
    output : str
        Output of the gain.
    by : sequence of str
        Inputs of the gain.
    points : array, shape (points, inputs)
        Where it must hold.
    lower, upper : float
        Limits.

    Returns
    -------
    Constraint
        With one element for each point.

    Examples
    --------
    >>> falls = gain_at("map", "A", ["c"], [[0.0], [0.3]], upper=0.0)
    >>> falls.name
    'dA/dc'
    """
    return Constraint(
        f"d{output}/d{'d'.join(by)}",
        _GainAt(path, output, tuple(by)),
        jnp.asarray(points, float),
        lower,
        upper,
    )


def certified_gain(
    path: str,
    output: str,
    by: str,
    box: tuple[Sequence[float], Sequence[float]],
    number: int = 32,
    lower: float = -np.inf,
    upper: float = np.inf,
) -> list[Constraint]:
    """Constrain a network's first-order gain everywhere in a box, by its enclosure in each cell.

    Parameters
    ----------
    path : str
        Where the network is in the model.
    output, by : str
        Output and input of the gain.
    box : (lower corner, upper corner)
        The box, each of shape (inputs,).
    number : int
        Cells along each input. More cells cost time and give away less.
    lower, upper : float
        Limits the gain must keep to.

    Returns
    -------
    list of Constraint
        One for each finite limit, with one element for each cell.

    Raises
    ------
    InputError
        If the box is not finite, or no limit is.

    Examples
    --------
    >>> [c.name for c in certified_gain("map", "A", "c", ([0.0], [3.9]), upper=0.0)]
    ['max dA/dc']
    """
    corners = tuple(jnp.asarray(c) for c in cells(*box, number))
    wanted = [("upper", "max", -np.inf, upper), ("lower", "min", lower, np.inf)]
    found = [
        Constraint(
            f"{word} d{output}/d{by}", _CertifiedGain(path, output, by, end), corners, low, high
        )
        for end, word, low, high in wanted
        if np.isfinite(low) or np.isfinite(high)
    ]
    if not found:
        raise InputError(f"no limit on d{output}/d{by}", "lower, upper or both")
    return found
