"""The focusing functions: one solution of u'' + k u = h, smooth through k = 0.

Every element of the package is a combination of these three functions, so a limit that holds
here (a quadrupole at zero strength is a drift) holds for all of them.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

__all__ = ["Focusing", "focusing"]

# Terms of the series in k L²; below |k L²| = 1 the first one left out is under 1e-19.
_TERMS = 10


class Focusing(NamedTuple):
    """The functions C, S and D of a length L of constant focusing k.

    Attributes
    ----------
    cosine : Array
        C(L), the solution of u'' + k u = 0 with u = 1, u' = 0 at the start.
    sine : Array
        S(L) in m, the solution with u = 0, u' = 1 at the start.
    dispersion : Array
        D(L) in m², the solution of u'' + k u = 1 from rest, (1 - C)/k.
    """

    cosine: Array
    sine: Array
    dispersion: Array


def focusing(k: ArrayLike, length: ArrayLike) -> Focusing:
    """Solve the linear equation of motion over a length of constant focusing.

    Parameters
    ----------
    k : float or Array
        Focusing strength, 1/m². Positive focuses, negative defocuses, zero is a drift; value
        and all derivatives are continuous there.
    length : float or Array
        Length in m.

    Returns
    -------
    Focusing
        C, S, D with the broadcast shape of the arguments.

    Notes
    -----
    C = cos √k L, S = sin(√k L)/√k, and cosh, sinh for k < 0: eqs 20 and 22 of the report
    (its k is √k here). D = (1 - C)/k solves u'' + k u = 1 from rest, by substitution. Near
    k = 0 all three are summed as a series in k L².

    Examples
    --------
    >>> [float(f) for f in focusing(0.0, 2.0)]
    [1.0, 2.0, 2.0]
    """
    k, length = jnp.asarray(k, float), jnp.asarray(length, float)
    x = k * length**2
    near = jnp.abs(x) < 1.0
    c_near, s_near, d_near = _series(jnp.where(near, x, 0.0))
    c_far, s_far, d_far = _closed_form(jnp.where(near, 1.0, x))
    return Focusing(
        cosine=jnp.where(near, c_near, c_far),
        sine=length * jnp.where(near, s_near, s_far),
        dispersion=length**2 * jnp.where(near, d_near, d_far),
    )


def _series(x: Array) -> tuple[Array, Array, Array]:
    """Sum cos √x, sin √x/√x and (1 - cos √x)/x as power series in x."""
    c, s, d = jnp.ones_like(x), jnp.ones_like(x), jnp.ones_like(x)
    for n in range(_TERMS, 0, -1):  # Horner's scheme from the smallest term up
        c = 1.0 - x * c / ((2 * n - 1) * (2 * n))
        s = 1.0 - x * s / ((2 * n) * (2 * n + 1))
        d = 1.0 - x * d / ((2 * n + 1) * (2 * n + 2))
    return c, s, d / 2.0


def _closed_form(x: Array) -> tuple[Array, Array, Array]:
    """Evaluate the same three functions away from x = 0."""
    root = jnp.sqrt(jnp.abs(x))
    hyperbolic = jnp.where(x < 0.0, root, 0.0)  # cosh of a large focusing phase would overflow
    c = jnp.where(x > 0.0, jnp.cos(root), jnp.cosh(hyperbolic))
    s = jnp.where(x > 0.0, jnp.sin(root), jnp.sinh(hyperbolic)) / root
    return c, s, (1.0 - c) / x
