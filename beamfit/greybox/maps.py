"""Named mappings y = f(x) with values, forward sensitivities and adjoints (report 3.1.1).

A map takes one point, a vector of named inputs, to a vector of named outputs. For many points use
``jax.vmap(m)(points)``. Maps are JAX trees, so their own numbers (weights, calibration
constants) can be free in a fit and are differentiated by JAX like the inputs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.errors import InputError, nearest
from beamfit.greybox import tree


class Map(Protocol):
    """A map: named inputs and outputs, and a function of one point."""

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs."""

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs."""

    def __call__(self, x: jax.Array) -> jax.Array:
        """Compute the outputs at one point, shape (len(inputs),) to (len(outputs),)."""


def positions(chosen: Sequence[str], names: Sequence[str], kind: str = "name") -> list[int]:
    """Find the positions of chosen names in a list of names.

    Parameters
    ----------
    chosen : sequence of str
        Names to find.
    names : sequence of str
        All names.
    kind : str
        Kind of thing that they name, for the error message.

    Returns
    -------
    list of int

    Raises
    ------
    InputError
        If a name is not in the list.

    Examples
    --------
    >>> positions(["b"], ["a", "b"])
    [1]
    """
    for name in chosen:
        if name not in names:
            raise InputError(f"no {kind} '{name}'", nearest(name, list(names)))
    return [list(names).index(name) for name in chosen]


def _check_names(m: Map) -> None:
    """Convert the names of a map to tuples and check that each occurs once."""
    for side in ("inputs", "outputs"):
        names = tuple(getattr(m, side))
        if len(set(names)) < len(names):
            raise InputError(f"{side} {', '.join(names)}", "each name once")
        object.__setattr__(m, side, names)


@tree.node("inputs", "outputs")
class Affine:
    """The map y = matrix x + offset.

    Parameters
    ----------
    inputs, outputs : sequence of str
        Names.
    matrix : array, shape (outputs, inputs)
        The gains.
    offset : array, shape (outputs,), optional
        The value at x = 0.

    Raises
    ------
    InputError
        If the shapes do not fit the names.

    Examples
    --------
    >>> calibration = Affine(["current"], ["gradient"], [[2.0]], [0.5])
    >>> calibration(jnp.array([3.0])).tolist()
    [6.5]
    """

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    matrix: jax.Array
    offset: jax.Array | None = None

    def __post_init__(self):
        shape = (len(self.outputs), len(self.inputs))
        offset = jnp.zeros(shape[0]) if self.offset is None else jnp.asarray(self.offset, float)
        matrix = jnp.asarray(self.matrix, float)
        if matrix.shape != shape or offset.shape != shape[:1]:
            raise InputError(
                f"a matrix of shape {matrix.shape} and an offset of shape {offset.shape}",
                f"shapes {shape} and {shape[:1]}, one row for each output",
            )
        _check_names(self)
        object.__setattr__(self, "matrix", matrix)
        object.__setattr__(self, "offset", offset)

    def __call__(self, x: jax.Array) -> jax.Array:
        """Compute the outputs at one point."""
        return self.matrix @ x + self.offset


@tree.node("inputs", "outputs", "function")
class Formula:
    """A map written as a JAX function of its parameters and the point.

    Parameters
    ----------
    inputs, outputs : sequence of str
        Names.
    function : callable
        ``function(parameters, x) -> y`` with x of shape (inputs,) and y of shape (outputs,).
    parameters : pytree
        The numbers the formula holds; any of them can be free in a fit.

    Examples
    --------
    >>> ohm = Formula(["current"], ["voltage"], lambda p, x: p["resistance"] * x,
    ...               {"resistance": 2.0})
    >>> ohm(jnp.array([3.0])).tolist()
    [6.0]
    """

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    function: Callable[[Any, jax.Array], jax.Array]
    parameters: Any = None

    def __post_init__(self):
        _check_names(self)

    def __call__(self, x: jax.Array) -> jax.Array:
        """Compute the outputs at one point."""
        return self.function(self.parameters, x)


@tree.node()
class Series:
    """One map after another (report fig 2b): u -> p, then (p, x) -> y.

    An input of the second map is an output of the first if one has that name, else an input of the
    whole. The inputs of the whole are those of the first map, followed by the remaining ones of the
    second.

    Parameters
    ----------
    first, second : Map
        The maps, in the order of computation.

    Examples
    --------
    >>> first = Affine(["u"], ["p"], [[2.0]])
    >>> second = Formula(["p", "x"], ["y"], lambda _, v: v[:1] * v[1:])
    >>> model = Series(first, second)
    >>> model.inputs, model(jnp.array([3.0, 5.0])).tolist()
    (('u', 'x'), [30.0])
    """

    first: Map
    second: Map

    @property
    def inputs(self) -> tuple[str, ...]:
        """Inputs of the first map, then those of the second that come from outside."""
        provided = {*self.first.inputs, *self.first.outputs}
        return self.first.inputs + tuple(n for n in self.second.inputs if n not in provided)

    @property
    def outputs(self) -> tuple[str, ...]:
        """Outputs of the second map."""
        return self.second.outputs

    def __call__(self, x: jax.Array) -> jax.Array:
        """Compute the outputs at one point."""
        middle = self.first(x[: len(self.first.inputs)])
        every = jnp.concatenate([middle, x])
        names = self.first.outputs + self.inputs
        return self.second(every[jnp.array(positions(self.second.inputs, names))])


@tree.node()
class Parallel:
    """The sum of maps with the same outputs (report fig 2a): physics plus a correction.

    Parameters
    ----------
    parts : sequence of Map
        Their outputs have the same names in the same order; inputs are shared by name.

    Raises
    ------
    InputError
        If there is no part, or the outputs differ.

    Examples
    --------
    >>> physics = Affine(["u"], ["y"], [[2.0]])
    >>> correction = Affine(["t"], ["y"], [[0.1]])
    >>> Parallel([physics, correction])(jnp.array([1.0, 10.0])).tolist()
    [3.0]
    """

    parts: tuple[Map, ...]

    def __post_init__(self):
        object.__setattr__(self, "parts", tuple(self.parts))
        if len({part.outputs for part in self.parts}) != 1:
            found = " and ".join(str(part.outputs) for part in self.parts) or "no maps"
            raise InputError(found, "maps with the same outputs in the same order")

    @property
    def inputs(self) -> tuple[str, ...]:
        """Inputs of the parts, each once, in order of first appearance."""
        return tuple(dict.fromkeys(name for part in self.parts for name in part.inputs))

    @property
    def outputs(self) -> tuple[str, ...]:
        """Outputs of the parts."""
        return self.parts[0].outputs

    def __call__(self, x: jax.Array) -> jax.Array:
        """Compute the outputs at one point."""
        names = self.inputs
        values = [part(x[jnp.array(positions(part.inputs, names))]) for part in self.parts]
        return jnp.sum(jnp.stack(values), axis=0)


@tree.node("inputs", "outputs", "function", "jacobian", "hessian")
class Foreign:
    """A map computed by code outside JAX, which supplies its own derivatives.

    Parameters
    ----------
    inputs, outputs : sequence of str
        Names.
    function : callable
        ``function(x) -> y`` on NumPy arrays of shapes (inputs,) and (outputs,).
    jacobian : callable
        ``jacobian(x)``, shape (outputs, inputs).
    hessian : callable, optional
        ``hessian(x)``, shape (outputs, inputs, inputs). Without it second derivatives raise
        `InputError`; a fit then needs ``hessian="gauss_newton"``.

    Examples
    --------
    >>> square = Foreign(["x"], ["y"], lambda x: x**2, lambda x: np.diag(2 * x))
    >>> jax.grad(lambda x: square(x)[0])(jnp.array([3.0])).tolist()
    [6.0]
    """

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    function: Callable[[np.ndarray], np.ndarray]
    jacobian: Callable[[np.ndarray], np.ndarray]
    hessian: Callable[[np.ndarray], np.ndarray] | None = None

    def __post_init__(self):
        _check_names(self)

    def __call__(self, x: jax.Array) -> jax.Array:
        """Compute the outputs at one point."""
        return _foreign(self, 0, jnp.asarray(x, float))

    def derivative(self, order: int) -> Callable[[np.ndarray], np.ndarray]:
        """Return the user's function for the derivative of an order, 0 for the value."""
        codes = (self.function, self.jacobian, self.hessian)
        if order >= len(codes) or codes[order] is None:
            raise InputError(
                f"a derivative of order {order} asked of the foreign map "
                f"{', '.join(self.inputs)} -> {', '.join(self.outputs)}",
                "lower orders only: give hessian=, or solve with hessian='gauss_newton'",
            )
        return codes[order]


def _call_user(m: Foreign, order: int, x: jax.Array) -> jax.Array:
    """Call the user's function for one derivative order from JAX."""
    shape = (len(m.outputs),) + (len(m.inputs),) * order
    code = m.derivative(order)

    def host(point):
        return np.asarray(code(np.asarray(point)), float).reshape(shape)

    spec = jax.ShapeDtypeStruct(shape, jnp.float64)
    return jax.pure_callback(host, spec, x, vmap_method="sequential")


_foreign = jax.custom_jvp(_call_user, nondiff_argnums=(0, 1))


@_foreign.defjvp
def _foreign_jvp(m, order, primals, tangents):
    """Multiply the next derivative, also supplied by the user, by the direction."""
    (x,), (direction,) = primals, tangents
    return _foreign(m, order, x), _foreign(m, order + 1, x) @ direction
