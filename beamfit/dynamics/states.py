"""State spaces x' = f(x, u, p) or x+ = f(x, u, p), y = g(x, u, p), with held inputs.

f and g are functions of one sample; the code that uses them scans and vectorises them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import expm, solve_triangular

from beamfit.compile_cache import prepare_jax

prepare_jax()
# Samples that `linear_outputs` computes by one matrix product: chosen, for speed.
BLOCK = 16


class StateSpace(NamedTuple):
    """A process described by its state, with any numbers of inputs, states and outputs.

    Attributes
    ----------
    flow : callable
        ``flow(x, u, p)``, shapes (n,), (m,) and any tree: the state's rate of change, or the next
        state. A parameter that depends on the operating point is a map (a formula, a network) that
        `flow` calls; if p itself is a map it is called with u first.
    output : callable
        ``output(x, u, p)``, shape (k,).
    discrete : bool
        True if `flow` gives the next state; samples must then be equally spaced.
    affine : bool
        True if `flow` is affine in x: steps are then exact (matrix exponential).
    parts : int
        Fourth-order Runge-Kutta steps from one sample to the next.

    Notes
    -----
    E. Hairer, S. Nørsett, G. Wanner, Solving ODEs I (1993), table II.1.2 (Runge-Kutta);
    C. Van Loan, IEEE Trans. Automatic Control 23 (1978) 395, for the affine case.

    Examples
    --------
    >>> tank = StateSpace(lambda x, u, p: u - p["k"] * jnp.sqrt(x), lambda x, u, p: x)
    >>> y, last = tank.run({"k": 0.5}, jnp.ones((50, 1)), jnp.full(50, 1.0), jnp.array([1.0]))
    >>> round(float(y[0, 0]), 3), round(float(last[0]), 3)
    (1.0, 3.995)
    """

    flow: Callable[[jax.Array, jax.Array, Any], jax.Array]
    output: Callable[[jax.Array, jax.Array, Any], jax.Array]
    discrete: bool = False
    affine: bool = False
    parts: int = 1

    def after(self, p: Any, x: jax.Array, u: jax.Array, dt: jax.Array) -> jax.Array:
        """Give the state after dt under the input u, shape (n,)."""
        now = p(u) if callable(p) else p

        def rate(x):
            return jnp.asarray(self.flow(x, u, now), float)

        if self.discrete:
            return rate(x)
        if self.affine:
            shift, matrix = rate(jnp.zeros_like(x)), jax.jacfwd(rate)(jnp.zeros_like(x))
            both = jnp.zeros((len(x) + 1,) * 2).at[:-1].set(jnp.column_stack([matrix, shift]))
            return (expm(both * dt) @ jnp.append(x, 1.0))[:-1]
        h = dt / self.parts

        def part(_, x):
            a = rate(x)
            b = rate(x + 0.5 * h * a)
            c = rate(x + 0.5 * h * b)
            return x + h / 6.0 * (a + 2.0 * b + 2.0 * c + rate(x + h * c))

        # A single step needs no loop inside the scan.
        return part(0, x) if self.parts == 1 else jax.lax.fori_loop(0, self.parts, part, x)

    def run(
        self, p: Any, u: jax.Array, dt: jax.Array, x0: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Run free from an initial state (output error).

        Parameters
        ----------
        p : tree
            Parameters.
        u : array, shape (samples, m)
            Inputs, each from its sample to the next.
        dt : array, shape (samples,)
            Time to the next sample, s.
        x0 : array, shape (n,)
            State at the first sample.

        Returns
        -------
        tuple of jax.Array
            Outputs at the samples, shape (samples, k), and the state after the last one, (n,).
        """
        if self.affine:
            last, x = affine_course(lambda x, *now: self.after(p, x, *now), x0, u, dt)
        else:
            last, x = jax.lax.scan(lambda x, now: (self.after(p, x, *now), x), x0, (u, dt))
        return jax.vmap(self.read, (None, 0, 0))(p, x, u), last

    def read(self, p: Any, x: jax.Array, u: jax.Array) -> jax.Array:
        """Give the outputs at one sample, shape (k,)."""
        return jnp.atleast_1d(self.output(x, u, p(u) if callable(p) else p))


def affine_course(
    after: Callable[..., jax.Array], x0: jax.Array, *rows: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Run steps that are affine in the state; return the last state and the state before each step.

    ``after(x, *row)`` is one step. All that does not depend on the state is computed for all
    samples at once; the scan, forward and backward, is a product with a small matrix.
    """

    def moved(*row):
        def both(x):
            new = after(x, *row)
            return new, new

        return jax.jacfwd(both, has_aux=True)(jnp.zeros_like(x0))

    def step(x, now):
        matrix, shift = now
        return jnp.sum(matrix * x, axis=1) + shift, x

    return jax.lax.scan(step, x0, jax.vmap(moved)(*rows))


class Matrices(NamedTuple):
    """x+ = a x + b u, y = c x + d u + offset."""

    a: jax.Array
    b: jax.Array
    c: jax.Array
    d: jax.Array
    offset: jax.Array


def contraction(z: jax.Array, around: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Give matrices a, b of a stable linear system from n m numbers, near a reference system.

    Parameters
    ----------
    z : array, shape (n, m)
        Any numbers; zero at the reference system.
    around : array, shape (n + m, n + m)
        Orthogonal; its first n rows are [a b] of that system, with a aᵀ + b bᵀ = 1.

    Returns
    -------
    tuple of jax.Array
        Shapes (n, n) and (n, m); a aᵀ + b bᵀ = 1, so that no pole is outside the unit circle.

    Notes
    -----
    Every stable system that its inputs reach can be written with such a and b, up to rotations of
    the state, which this chart leaves out: with c and d it has as many numbers as the system has
    (T. Ribarits, M. Deistler, B. Hanzon, Automatica 41 (2005) 531; input normal form).

    Examples
    --------
    >>> a, b = contraction(jnp.array([[0.3]]), jnp.array([[0.8, 0.6], [-0.6, 0.8]]))
    >>> round(float(a[0, 0] ** 2 + b[0, 0] ** 2), 12)
    1.0
    """
    n = len(z)
    free = jnp.column_stack([jnp.eye(n), z]) @ around
    lower = jnp.linalg.cholesky(jnp.eye(n) + z @ z.T)
    both = solve_triangular(lower, free, lower=True)
    return both[:, :n], both[:, n:]


def linear_outputs(system: Matrices, u: jax.Array, x0: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Run a linear system, `BLOCK` samples at a time.

    Parameters
    ----------
    system : Matrices
        Its matrices.
    u : array, shape (samples, m)
        Inputs.
    x0 : array, shape (n,)
        State at the first sample.

    Returns
    -------
    tuple of jax.Array
        Outputs, shape (samples, k), and the state after the last sample, padding included.

    Notes
    -----
    Within a block outputs are products with the Markov parameters d, c b, c a b, … (T. Kailath,
    Linear Systems (1980), section 2.3), and the scan goes from block to block.

    Examples
    --------
    >>> lag = Matrices(*(jnp.array([[v]]) for v in (0.5, 1.0, 1.0, 0.0)), jnp.zeros(1))
    >>> linear_outputs(lag, jnp.ones((4, 1)), jnp.zeros(1))[0].ravel().tolist()
    [0.0, 1.0, 1.5, 1.75]
    """
    a, b, c, d, offset = system
    count, (n, m), length = len(u), b.shape, min(BLOCK, max(len(u), 1))
    blocks = jnp.pad(u, ((0, -count % length), (0, 0))).reshape(-1, length * m)
    block_matrix, powers = jax.lax.scan(lambda q, _: (q @ a, q), jnp.eye(n), length=length)
    from_input = powers @ b  # a^i b
    lag = jnp.arange(length)[:, None] - jnp.arange(length)
    markov = jnp.where(
        (lag > 0)[..., None, None], (c @ from_input)[jnp.maximum(lag - 1, 0)],
        jnp.where((lag == 0)[..., None, None], d, 0.0),
    )  # fmt: skip
    pushed = blocks @ jnp.moveaxis(from_input[::-1], 1, 2).reshape(length * m, n)
    last, x = jax.lax.scan(lambda x, new: (block_matrix @ x + new, x), x0, pushed)
    forced = blocks @ markov.transpose(1, 3, 0, 2).reshape(length * m, -1)
    free = x @ (c @ powers).transpose(2, 0, 1).reshape(n, -1)
    y = (forced + free).reshape(-1, len(c))[:count] + offset
    return y, last
