"""Maps given as an equation f(x, y) = 0: the solver inside, derivatives by the implicit theorem."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.experimental import checkify

from beamfit.greybox import tree

__all__ = ["Implicit", "Root"]


class Root(NamedTuple):
    """What the inner solver found at one point.

    ``defect`` is max |f(x, y)|; ``converged`` is 1 where it is within the tolerance, else 0.
    """

    y: jax.Array
    defect: jax.Array
    iterations: jax.Array
    converged: jax.Array


@tree.node("inputs", "outputs", "equation", "tolerance", "iterations")
class Implicit:
    """The map y(x) defined by equation(parameters, x, y) = 0.

    Damped Newton steps from `start`; the derivatives of y are those of the implicit function
    theorem, dy/dx = -(df/dy)^-1 df/dx, at any order, forward or backward. Where Newton does not
    converge, the map gives its last finite iterate; `root` says so, and a fit that ends on such a
    point has the status ``not_converged``.

    Parameters
    ----------
    inputs, outputs : sequence of str
        Names of x and y.
    equation : callable
        ``equation(parameters, x, y)``, shape (outputs,), in JAX.
    start : array, shape (outputs,)
        Where Newton starts.
    parameters : pytree, optional
        The numbers the equation holds; any of them can be free in a fit.
    tolerance : float
        On max |equation|.
    iterations : int
        Most Newton steps.

    Examples
    --------
    >>> root = Implicit(("x",), ("y",), lambda _, x, y: y**3 - x, start=jnp.ones(1))
    >>> float(root(jnp.array([8.0]))[0])
    2.0
    >>> int(root.root(jnp.array([8.0])).converged)
    1
    """

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    equation: Callable[[Any, jax.Array, jax.Array], jax.Array]
    start: jax.Array
    parameters: Any = None
    tolerance: float = 1e-10
    iterations: int = 40

    def __post_init__(self):
        object.__setattr__(self, "inputs", tuple(self.inputs))
        object.__setattr__(self, "outputs", tuple(self.outputs))
        object.__setattr__(self, "start", jnp.asarray(self.start, float))

    def __call__(self, x: jax.Array) -> jax.Array:
        """Outputs at one point."""
        found = self.root(x)
        # Only seen by a caller who looks (checkify), so that a fit can name the failure.
        checkify.debug_check(
            found.converged > 0.5,
            f"the equation of {', '.join(self.outputs)} was left with max |f| = {{defect}} "
            f"after {self.iterations} Newton steps",
            defect=found.defect,
        )
        return found.y

    def root(self, x: jax.Array) -> Root:
        """Solve at one point and tell how it went.

        Parameters
        ----------
        x : array, shape (inputs,)
            The point.

        Returns
        -------
        Root
        """

        def f(y):
            return self.equation(self.parameters, x, y)

        def tangent_solve(linear, right):
            return jnp.linalg.solve(jax.jacfwd(linear)(jnp.zeros_like(right)), right)

        y, steps = jax.lax.custom_root(
            f, jnp.asarray(self.start, float), self._newton, tangent_solve, has_aux=True
        )
        defect = jnp.max(jnp.abs(f(y)))
        converged = jnp.where(defect <= self.tolerance, 1.0, 0.0)
        return Root(y, defect, steps, jax.lax.stop_gradient(converged))

    def _newton(self, f, start):
        """Damped Newton: halve the step until the defect falls (a scan: checkify enters it)."""
        halvings = 0.5 ** jnp.arange(8)

        def norm(y):
            return jnp.max(jnp.abs(f(y)))

        def step(state, _):
            y, used = state
            direction = jnp.linalg.solve(jax.jacfwd(f)(y), -f(y))
            tries = jax.vmap(lambda t: norm(y + t * direction))(halvings)
            falls = tries < norm(y)
            moved = y + halvings[jnp.argmax(falls)] * direction
            go = jnp.any(falls) & (norm(y) > 0.01 * self.tolerance)
            return (jnp.where(go, moved, y), used + go), None

        (y, used), _ = jax.lax.scan(step, (start, jnp.zeros(())), length=self.iterations)
        return y, used
