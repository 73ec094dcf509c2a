"""Derivatives of maps and constraints on them (report 3.1, eqs 38-39).

Forward sensitivities, adjoints and gains of order 1 to 3; constraints on gains at points, or
certified everywhere in a box.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.errors import InputError
from beamfit.greybox import tree
from beamfit.greybox.bounds import cells, over_cells
from beamfit.greybox.maps import Map, positions
from beamfit.greybox.problem import Constraint


def _restricted(m: Map, x: jax.Array, variables: tuple[str, ...]):
    """Make the map a function of chosen inputs and leaves; return it and their present values."""
    at = positions([v for v in variables if v in m.inputs], m.inputs, "input")
    found = [leaf for v in variables if v not in m.inputs for leaf in tree.find_leaves(m, v)]
    start = jnp.concatenate([x[jnp.array(at, int)], tree.read(m, found)])

    def function(v):
        point = x.at[jnp.array(at, int)].set(v[: len(at)])
        return tree.replace(m, found, v[len(at) :])(point)

    return function, start


def sensitivities(m: Map, x: jax.Array, variables: Sequence[str] | None = None) -> jax.Array:
    """Compute derivatives of all outputs by chosen variables, one forward sweep per variable.

    Parameters
    ----------
    m : Map
        The map.
    x : array, shape (inputs,)
        The point.
    variables : sequence of str, optional
        Names of inputs, or paths of the map's own numbers; an array's elements follow in C order.
        Inputs come first. Default: all inputs.

    Returns
    -------
    jax.Array, shape (outputs, variables)

    Raises
    ------
    InputError
        If a variable is neither an input nor a path in the map.

    Examples
    --------
    >>> from beamfit.greybox.maps import Affine
    >>> m = Affine(["u", "v"], ["y"], [[2.0, 3.0]])
    >>> sensitivities(m, jnp.array([5.0, 7.0]), ["v", "matrix"]).tolist()
    [[3.0, 5.0, 7.0]]
    """
    return _sweep_jacobian(
        jax.jacfwd, m, x, m.outputs, m.inputs if variables is None else variables
    )


def _sweep_jacobian(
    sweep, m: Map, x, functions: Sequence[str], variables: Sequence[str]
) -> jax.Array:
    rows = tuple(positions(functions, m.outputs, "output"))
    return _jacobian(sweep, rows, tuple(variables), m, jnp.asarray(x, float))


@partial(jax.jit, static_argnums=(0, 1, 2))
def _jacobian(sweep, rows: tuple[int, ...], variables: tuple[str, ...], m: Map, x: jax.Array):
    """Compute the Jacobian by forward or backward sweeps, compiled once per structure of map."""
    function, start = _restricted(m, x, variables)
    return sweep(lambda v: function(v)[jnp.array(rows)])(start)


def adjoints(
    m: Map,
    x: jax.Array,
    functions: Sequence[str] | None = None,
    variables: Sequence[str] | None = None,
) -> jax.Array:
    """Compute derivatives of chosen outputs by the variables, one backward sweep per output.

    Parameters
    ----------
    m : Map
        The map.
    x : array, shape (inputs,)
        The point.
    functions : sequence of str, optional
        Names of outputs. Default: all.
    variables : sequence of str, optional
        As in `sensitivities`.

    Returns
    -------
    jax.Array, shape (functions, variables)

    Raises
    ------
    InputError
        If a name is not known.

    Examples
    --------
    >>> from beamfit.greybox.maps import Affine
    >>> m = Affine(["u"], ["y", "z"], [[2.0], [3.0]])
    >>> adjoints(m, jnp.array([5.0]), ["z"]).tolist()
    [[3.0]]
    """
    chosen = m.inputs if variables is None else variables
    return _sweep_jacobian(jax.jacrev, m, x, m.outputs if functions is None else functions, chosen)


def gain(m: Map, x: jax.Array, output: str, by: Sequence[str]) -> jax.Array:
    """Compute the gain dⁿy/du1...dun at a point, by nested forward derivatives (report 3.1.3).

    Parameters
    ----------
    m : Map
        Any map, not only a network.
    x : array, shape (inputs,)
        The point.
    output : str
        The output y.
    by : sequence of str
        The inputs u1...un; their number is the order.

    Returns
    -------
    jax.Array, scalar

    Raises
    ------
    InputError
        If a name is not known.

    Examples
    --------
    >>> from beamfit.greybox.maps import Formula
    >>> cube = Formula(["u"], ["y"], lambda _, x: x**3)
    >>> float(gain(cube, jnp.array([2.0]), "y", ["u", "u"]))
    12.0
    """
    (row,) = positions([output], m.outputs, "output")
    unit = jnp.eye(len(m.inputs))

    def derivative(function, i):
        return lambda point: jax.jvp(function, (point,), (unit[i],))[1]

    function = lambda point: m(point)[row]  # noqa: E731
    for i in positions(by, m.inputs, "input"):
        function = derivative(function, i)
    return function(jnp.asarray(x, float))


def part(model: Any, path: str) -> Any:
    """Return the part of a model at a path.

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
    """Function of a constraint at points; equal ones share their compiled code."""

    path: str
    output: str
    by: tuple[str, ...]

    def __call__(self, model: Any, points: jax.Array) -> jax.Array:
        m = part(model, self.path)
        return jax.vmap(lambda x: gain(m, x, self.output, self.by))(points)


@dataclass(frozen=True)
class _CertifiedGain:
    """Function of a certified constraint: one end of the gain's enclosure in every cell."""

    path: str
    output: str
    by: str
    end: str

    def __call__(self, model: Any, corners: tuple[jax.Array, jax.Array]) -> jax.Array:
        net = part(model, self.path)
        bound = over_cells(net, *corners)
        row = positions([self.output], [port.name for port in net.output_ports], "output")[0]
        column = positions([self.by], net.inputs, "input")[0]
        return getattr(bound, self.end)[:, row, column]


def gain_at(
    path: str, output: str, by: Sequence[str], points, lower: float = -np.inf, upper: float = np.inf
) -> Constraint:
    """Constrain a gain of order 1 to 3 at points; between the points it is not limited.

    Parameters
    ----------
    path : str
        Path of the map in the model.
    output : str
        Output of the gain.
    by : sequence of str
        Inputs of the gain.
    points : array, shape (points, inputs)
        Points at which the limits hold.
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
    gains, name = _GainAt(path, output, tuple(by)), f"d{output}/d{'d'.join(by)}"
    return Constraint(name, gains, jnp.asarray(points, float), lower, upper)


@lru_cache(maxsize=64)
def _corners(low: tuple[float, ...], high: tuple[float, ...], number: int):
    """Make the corners of cells, cached so that all limits over a box share the enclosures."""
    return tuple(map(jnp.asarray, cells(low, high, number)))


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
        Path of the network in the model.
    output, by : str
        Output and input of the gain.
    box : (lower corner, upper corner)
        The box, each of shape (inputs,).
    number : int
        Cells along each input. More cells cost time and tighten the enclosure.
    lower, upper : float
        Limits of the gain.

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
    corners = _corners(*(tuple(map(float, corner)) for corner in box), number)
    found = []
    for end, word, low, high in (("upper", "max", -np.inf, upper), ("lower", "min", lower, np.inf)):
        if np.isfinite(low) or np.isfinite(high):
            bound = _CertifiedGain(path, output, by, end)
            found.append(Constraint(f"{word} d{output}/d{by}", bound, corners, low, high))
    if not found:
        raise InputError(f"no limit on d{output}/d{by}", "lower, upper or both")
    return found
