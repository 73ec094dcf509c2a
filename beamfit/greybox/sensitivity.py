"""Derivatives of maps: forward sensitivities, adjoints, and gains of order 1 to 3 (report 3.1)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp

from beamfit.greybox import tree
from beamfit.greybox.maps import Map, positions

__all__ = ["adjoints", "gain", "sensitivities"]


def _restricted(m: Map, x: jax.Array, variables: tuple[str, ...]):
    """The map as a function of chosen inputs and leaves: the function and where it stands."""
    at = positions([v for v in variables if v in m.inputs], m.inputs, "input")
    found = [leaf for v in variables if v not in m.inputs for leaf in tree.find_leaves(m, v)]
    start = jnp.concatenate([x[jnp.array(at, int)], tree.read(m, found)])

    def function(v):
        point = x.at[jnp.array(at, int)].set(v[: len(at)])
        return tree.replace(m, found, v[len(at) :])(point)

    return function, start


def sensitivities(m: Map, x: jax.Array, variables: Sequence[str] | None = None) -> jax.Array:
    """Derivatives of every output by chosen variables, one forward sweep for each variable.

    Parameters
    ----------
    m : Map
        The map.
    x : array, shape (inputs,)
        The point.
    variables : sequence of str, optional
        Names of inputs, or paths of the map's own numbers; an array's elements follow in C order.
        Inputs come first. All inputs if not given.

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
    chosen = m.inputs if variables is None else tuple(variables)
    return _forward(m, jnp.asarray(x, float), chosen)


@partial(jax.jit, static_argnums=2)
def _forward(m: Map, x: jax.Array, variables: tuple[str, ...]) -> jax.Array:
    """Forward sweeps, compiled once for each structure of map."""
    function, start = _restricted(m, x, variables)
    return jax.jacfwd(function)(start)


def adjoints(
    m: Map,
    x: jax.Array,
    functions: Sequence[str] | None = None,
    variables: Sequence[str] | None = None,
) -> jax.Array:
    """Derivatives of chosen outputs by the variables, one backward sweep for each output.

    Parameters
    ----------
    m : Map
        The map.
    x : array, shape (inputs,)
        The point.
    functions : sequence of str, optional
        Names of outputs; all if not given.
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
    rows = positions(m.outputs if functions is None else functions, m.outputs, "output")
    chosen = m.inputs if variables is None else tuple(variables)
    return _backward(m, jnp.asarray(x, float), tuple(rows), chosen)


@partial(jax.jit, static_argnums=(2, 3))
def _backward(m: Map, x: jax.Array, rows: tuple[int, ...], variables: tuple[str, ...]):
    """Backward sweeps, compiled once for each structure of map."""
    function, start = _restricted(m, x, variables)
    _, pull = jax.vjp(function, start)
    return jax.vmap(lambda w: pull(w)[0])(jnp.eye(len(m.outputs))[jnp.array(rows)])


def gain(m: Map, x: jax.Array, output: str, by: Sequence[str]) -> jax.Array:
    """The gain dⁿy/du1...dun at one point, by nested forward derivatives (report 3.1.3).

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
