"""Maps defined by equations: f(x, y) = 0 with a solver inside, and the Taylor difference equation.

The difference equation (report eqs 2-4) is the default parametric model where the physics is
unknown. The next output is a polynomial in the deviations of past outputs and inputs from an
operating point. Its coefficients are the parameters p, which another map gives as functions of the
inputs.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations_with_replacement, product
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import checkify

from beamfit.errors import InputError
from beamfit.greybox import tree


class Root(NamedTuple):
    """Result of the inner Newton solver at one point.

    ``defect`` is ``max |f(x, y)|``; ``converged`` is 1 where it is within the tolerance, else 0.
    """

    y: jax.Array
    defect: jax.Array
    iterations: jax.Array
    converged: jax.Array


@tree.node("inputs", "outputs", "equation", "tolerance", "iterations")
class Implicit:
    """The map y(x) defined by equation(parameters, x, y) = 0.

    It is solved by damped Newton steps from `start`. The derivatives of y follow from the implicit
    function theorem, dy/dx = -(df/dy)^-1 df/dx, at any order, forward or backward. Where Newton's
    method does not converge, the map returns the last finite iterate; `root` reports this, and a
    fit that ends at such a point has the status ``not_converged``.

    Parameters
    ----------
    inputs, outputs : sequence of str
        Names of x and y.
    equation : callable
        ``equation(parameters, x, y)``, shape (outputs,), in JAX.
    start : array, shape (outputs,)
        Start of Newton's method.
    parameters : pytree, optional
        Numbers in the equation; any of them can be free in a fit.
    tolerance : float
        Largest ``max |equation|`` that counts as converged.
    iterations : int
        Largest number of Newton steps.

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
        """Compute the outputs at one point."""
        found = self.root(x)
        # Only has an effect under `checkify`, by which a fit names the failure.
        checkify.debug_check(
            found.converged > 0.5,
            f"the equation of {', '.join(self.outputs)} was left with max |f| = {{defect}} "
            f"after {self.iterations} Newton steps",
            defect=found.defect,
        )
        return found.y

    def root(self, x: jax.Array) -> Root:
        """Solve at one point and report convergence.

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
        """Take damped Newton steps, halved until the defect falls (a scan, as checkify needs)."""
        halvings = 0.5 ** jnp.arange(8)

        def norm(y):
            return jnp.max(jnp.abs(f(y)))

        def step(state, _):
            y, used = state
            direction = jnp.linalg.solve(jax.jacfwd(f)(y), -f(y))
            tries = jax.vmap(lambda t: norm(y + t * direction))(halvings)
            falls = tries < norm(y)
            moved = y + halvings[jnp.argmax(falls)] * direction
            move = jnp.any(falls) & (norm(y) > 0.01 * self.tolerance)
            return (jnp.where(move, moved, y), used + move), None

        (y, used), _ = jax.lax.scan(step, (start, jnp.zeros(())), length=self.iterations)
        return y, used


@tree.node("process_inputs", "process_outputs", "y_past", "u_past", "degree")
class TaylorDifference:
    """The map y_k = init + sum A_i y_(k-i) + sum B_i u_(k-i) (+ all products), eqs 2 and 4.

    All y and u are deviations from the operating point. Its inputs are the coefficients followed by
    the past (``y[k-1]``, ..., ``u[k]``, ``u[k-1]``, ...). It can thus be the second map of a
    `Series` whose first map gives the coefficients.

    Parameters
    ----------
    process_inputs, process_outputs : tuple of str
        Names of u and y.
    y_past : int
        Number of past outputs, i = 1 ... y_past.
    u_past : int
        Number of past inputs in addition to the present one, i = 0 ... u_past.
    degree : int
        1 for eq 4; 2 adds all products of two deviations (the second-order terms of eq 2).

    Raises
    ------
    InputError
        If a number is out of range.

    Examples
    --------
    >>> lag = TaylorDifference(("u",), ("y",), y_past=1, u_past=0)
    >>> lag.coefficients
    ('y:init', 'y:y[k-1]', 'y:u[k]')
    >>> lag.simulate(jnp.array([0.0, 0.5, 1.0]), jnp.ones((3, 1)), jnp.zeros((1, 1)))[:, 0].tolist()
    [1.0, 1.5, 1.75]
    """

    process_inputs: tuple[str, ...]
    process_outputs: tuple[str, ...]
    y_past: int = 1
    u_past: int = 0
    degree: int = 1

    def __post_init__(self):
        object.__setattr__(self, "process_inputs", tuple(self.process_inputs))
        object.__setattr__(self, "process_outputs", tuple(self.process_outputs))
        if self.y_past < 0 or self.u_past < 0 or self.degree not in (1, 2):
            raise InputError(
                f"y_past {self.y_past}, u_past {self.u_past}, degree {self.degree}",
                "numbers of past samples from 0 and degree 1 or 2",
            )

    @property
    def past(self) -> tuple[str, ...]:
        """Names of the deviations on which the next output depends."""
        steps = ["k", *(f"k-{i}" for i in range(1, 1 + max(self.y_past, self.u_past)))]
        outputs = product(steps[1 : 1 + self.y_past], self.process_outputs)
        inputs = product(steps[: 1 + self.u_past], self.process_inputs)
        return tuple(f"{name}[{step}]" for step, name in (*outputs, *inputs))

    @property
    def terms(self) -> tuple[tuple[int, ...], ...]:
        """Monomials as tuples of positions in `past`; the empty tuple is the constant."""
        every = range(len(self.past))
        return tuple(
            term for n in range(self.degree + 1) for term in combinations_with_replacement(every, n)
        )

    @property
    def coefficients(self) -> tuple[str, ...]:
        """Names of the parameters p, output by output."""
        words = ["*".join(self.past[i] for i in term) or "init" for term in self.terms]
        return tuple(f"{y}:{word}" for y, word in product(self.process_outputs, words))

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the coefficients, then of the past."""
        return self.coefficients + self.past

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs."""
        return self.process_outputs

    def __call__(self, x: jax.Array) -> jax.Array:
        """Compute the next outputs from one vector of coefficients and past."""
        return self.step(x[: len(self.coefficients)], x[len(self.coefficients) :])

    def step(self, p: jax.Array, past: jax.Array) -> jax.Array:
        """Compute the next outputs from coefficients and past deviations.

        Parameters
        ----------
        p : array, shape (coefficients,)
            The parameters.
        past : array, shape (past,)
            The deviations in the order of `past`.

        Returns
        -------
        jax.Array, shape (process outputs,)
        """
        monomials = jnp.stack([jnp.prod(past[np.array(t, int)]) for t in self.terms])
        return jnp.reshape(p, (len(self.process_outputs), -1)) @ monomials

    def simulate(self, p: jax.Array, u: jax.Array, y0: jax.Array) -> jax.Array:
        """Simulate the equation with its own past outputs (output error).

        Parameters
        ----------
        p : array, shape (coefficients,) or (samples, coefficients)
            Constant parameters, or those of each sample.
        u : array, shape (samples, process inputs)
            Input deviations; the input before the first sample equals the first value.
        y0 : array, shape (y_past, process outputs)
            Output deviations before the first sample, the latest first.

        Returns
        -------
        jax.Array, shape (samples, process outputs)
        """
        u = jnp.asarray(u, float)
        before = jnp.broadcast_to(u[0], (1 + self.u_past, u.shape[1]))

        def advance(state, now):
            ys, us = state
            coefficients, present = now
            us = jnp.concatenate([present[None], us])[: 1 + self.u_past]
            new = self.step(coefficients, jnp.concatenate([ys.ravel(), us.ravel()]))
            return (jnp.concatenate([new[None], ys])[: self.y_past], us), new

        p = jnp.broadcast_to(p, (len(u), len(self.coefficients)))
        return jax.lax.scan(advance, (jnp.asarray(y0, float), before), (p, u))[1]
