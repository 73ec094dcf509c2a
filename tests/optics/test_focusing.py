"""The focusing functions against their equation of motion, mpmath-free limits and derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from beamfit.optics.focusing import focusing

STRENGTHS = [-40.0, -4.0, -0.3, 0.0, 0.3, 4.0, 40.0]


@pytest.mark.parametrize("k", STRENGTHS)
def test_solves_the_equation_of_motion(k):
    length = 0.7

    def motion(_, state):
        c, dc, s, ds, d, dd = state
        return [dc, -k * c, ds, -k * s, dd, 1.0 - k * d]

    track = solve_ivp(motion, (0.0, length), [1, 0, 0, 1, 0, 0], rtol=1e-12, atol=1e-14)
    c, _, s, _, d, _ = track.y[:, -1]
    np.testing.assert_allclose(focusing(k, length), [c, s, d], rtol=2e-10)


def test_first_derivative_at_zero_strength_is_the_series_coefficient():
    """At k = 0 with L = 2: dC/dk = -L²/2, dS/dk = -L³/6, dD/dk = -L⁴/24."""
    slopes = jax.jacfwd(lambda k: jnp.stack(focusing(k, 2.0)))(0.0)
    np.testing.assert_allclose(slopes, [-2.0, -8.0 / 6.0, -16.0 / 24.0], rtol=1e-14)


@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.parametrize("edge", [-0.5, 0.5])
def test_series_and_closed_form_meet_with_their_derivatives(edge, order):
    """The switch at |k L²| = 0.5 must not show, in the value or in any derivative used."""

    def both(k):
        return jnp.stack(focusing(k, 1.0))

    derivative = both
    for _ in range(order):
        derivative = jax.jacfwd(derivative)
    derivative = jax.jit(derivative)
    inside, outside = derivative(edge * (1 - 1e-12)), derivative(edge * (1 + 1e-12))
    np.testing.assert_allclose(inside, outside, rtol=1e-9)


def test_gradient_is_finite_over_the_whole_range_of_strengths():
    strengths = jnp.linspace(-500.0, 500.0, 2001)
    slopes = jax.jit(jax.vmap(jax.jacfwd(lambda k: jnp.stack(focusing(k, 1.5)))))(strengths)
    assert bool(jnp.all(jnp.isfinite(slopes)))
