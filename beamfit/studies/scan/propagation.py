"""From σ and its covariance to what people quote, by exact gradients."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from beamfit.studies.scan.sigma import emittance_parts

__all__ = ["Derived", "derive"]


class Derived(NamedTuple):
    """Derived values and their raw errors.

    Attributes
    ----------
    start, start_error : Array
        Shape (3,): ε (m), β (m), α at the start.
    screen, screen_error : Array
        Shape (3,): β (m), α, rms size (m) at the screen.
    mismatch, mismatch_error : Array
        BMAG to the design.
    """

    start: Array
    start_error: Array
    screen: Array
    screen_error: Array
    mismatch: Array
    mismatch_error: Array


@jax.jit
def derive(
    sigma: Array, covariance: Array, to_screen: Array, to_design: Array, design: Array
) -> Derived:
    """Propagate a beam matrix and its covariance.

    Parameters
    ----------
    sigma, covariance : Array
        Shapes (3,) and (3, 3), of σ11, σ12, σ22 at the start.
    to_screen, to_design : Array
        Shape (3, 3), transfer matrices of the plane.
    design : Array
        Shape (2,), design β (m) and α.

    Returns
    -------
    Derived
        Linear error propagation: variance ∇f C ∇f of each f.

    Examples
    --------
    >>> found = derive(jnp.array([4.0, 0.0, 9.0]), 1e-4 * jnp.eye(3), jnp.eye(3), jnp.eye(3),
    ...                jnp.array([1.0, 0.0]))
    >>> found.start.tolist()
    [6.0, 0.6666666666666666, -0.0]
    """

    a, b, c, d = (jnp.stack([to_screen[i, j], to_design[i, j]]) for i in (0, 1) for j in (0, 1))
    # σ → R σ Rᵀ (report eq. 36), linear in (σ11, σ12, σ22), for both places.
    carry = jnp.stack(
        [
            jnp.stack([a**2, 2 * a * b, b**2]),
            jnp.stack([a * c, a * d + b * c, b * d]),
            jnp.stack([c**2, 2 * c * d, d**2]),
        ]
    )
    beta_d, alpha_d = design
    gamma_d = (1.0 + alpha_d**2) / beta_d

    def values(s: Array) -> Array:
        start = emittance_parts(s)
        (s11, d11), (s12, d12), (_, d22) = jnp.einsum("ijp,j->ip", carry, s)
        emittance = start[0]
        mismatch = 0.5 * (gamma_d * d11 + 2.0 * alpha_d * d12 + beta_d * d22) / emittance
        rest = jnp.stack([s11 / emittance, -s12 / emittance, jnp.sqrt(s11), mismatch])
        return jnp.concatenate([start, rest])

    found, gradient = values(sigma), jax.jacfwd(values)(sigma)
    error = jnp.sqrt(jnp.sum((gradient @ covariance) * gradient, axis=1))
    return Derived(found[:3], error[:3], found[3:6], error[3:6], found[6], error[6])
