"""The best beam of no emittance: how far the data are from allowing one."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

__all__ = ["zero_emittance"]

# Directions tried at once, and how often the search zooms in on the best one.
_DIRECTIONS, _ZOOMS = 48, 5
# Rows that all look the same way leave one direction to nothing but rounding.
_RANK = 1e-10


def zero_emittance(r11: Array, r12: Array, target: Array, scale: Array) -> tuple[Array, Array]:
    """Find the beam of zero emittance that fits best.

    Such a beam is a line in phase space, σ = v vᵀ: a direction and a length. For a direction
    the length is linear least squares, and the direction is searched over the half circle,
    in coordinates in which the scan looks at it evenly.

    Parameters
    ----------
    r11, r12 : Array
        Shape (n,).
    target : Array
        Shape (n,): measured size² less what is known, over its error.
    scale : Array
        Shape (n,): one over the error of size².

    Returns
    -------
    tuple of Array
        σ of shape (3,), and its χ².
    """
    used = jnp.where(scale > 0.0, 1.0, 0.0)
    g11 = jnp.sum(used * r11**2)
    g12 = jnp.sum(used * r11 * r12)
    g22 = jnp.sum(used * r12**2)
    # Coordinates in which the rows look in all directions evenly.
    rest = jnp.sqrt(jnp.maximum(g22 - g12**2 / g11, _RANK * g22))
    along, across = r11 / jnp.sqrt(g11), (r12 - r11 * g12 / g11) / rest

    # Of a direction θ the row is linear in (1, cos 2θ, sin 2θ): sums over rows are done once.
    parts = 0.5 * jnp.stack([along**2 + across**2, along**2 - across**2, 2.0 * along * across])
    parts = parts * scale
    projection, gram = parts @ target, parts @ parts.T

    def length_and_gain(angle: Array) -> tuple[Array, Array]:
        basis = jnp.stack([jnp.ones_like(angle), jnp.cos(2.0 * angle), jnp.sin(2.0 * angle)])
        norm = jnp.sum((gram @ basis) * basis, axis=0)
        overlap = jnp.maximum(projection @ basis, 0.0)
        length = overlap / jnp.where(norm > 0.0, norm, 1.0)
        return length, length * overlap

    steps = (jnp.arange(_DIRECTIONS) + 0.5) / _DIRECTIONS - 0.5

    def zoom(_: int, state: tuple[Array, Array]) -> tuple[Array, Array]:
        angle, width = state
        tried = angle + width * steps
        return tried[jnp.argmax(length_and_gain(tried)[1])], 2.0 * width / _DIRECTIONS

    angle, _ = jax.lax.fori_loop(0, _ZOOMS, zoom, (jnp.asarray(0.0), jnp.asarray(jnp.pi)))
    length, gain = length_and_gain(angle)
    chi2 = jnp.sum(target**2) - gain
    w = jnp.sin(angle) / rest
    v1, v2 = jnp.cos(angle) / jnp.sqrt(g11) - w * g12 / g11, w
    return length * jnp.stack([v1**2, v1 * v2, v2**2]), chi2
