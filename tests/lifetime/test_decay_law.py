import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from beamfit.lifetime.decay_law import (
    SERIES_BELOW,
    current,
    current_by_rate,
    lifetime,
    mean_exponential,
)

rates = st.floats(0, 1e-3)


@pytest.mark.parametrize("a", [0.0, 2e-8, 1.9e-5])
@pytest.mark.parametrize("b", [0.0, 1e-12, 1e-6, 1.9e-4])
def test_the_closed_form_solves_the_rate_equation(a, b):
    time = np.linspace(0, 36000, 7)
    exact = solve_ivp(
        lambda _, i: -a * i**2 - b * i, (0, 36000), [500.0], t_eval=time, rtol=1e-11, atol=1e-12
    )
    np.testing.assert_allclose(current(time, 500.0, a, b), exact.y[0], rtol=1e-8)


def test_without_gas_it_is_equation_43():
    time = np.linspace(0, 1e5, 50)
    np.testing.assert_allclose(current(time, 300.0, 3e-8, 0.0), 300 / (1 + 300 * 3e-8 * time))


def test_without_touschek_it_is_equation_41():
    time = np.linspace(0, 1e5, 50)
    np.testing.assert_allclose(current(time, 300.0, 0.0, 1e-5), 300 * np.exp(-1e-5 * time))


@settings(deadline=None)  # the first call compiles
@given(a=rates, b=rates, first=st.floats(0, 1e5), second=st.floats(0, 1e5))
def test_a_decay_goes_on_from_where_it_is(a, b, first, second):
    between = current(first, 200.0, a, b)
    whole = float(current(first + second, 200.0, a, b))
    assert float(current(second, between, a, b)) == pytest.approx(whole, rel=1e-9, abs=1e-300)


@pytest.mark.parametrize("order", [0, 1, 2, 3])
def test_all_derivatives_are_smooth_through_zero(order):
    function = mean_exponential
    for _ in range(order):
        function = jax.grad(function)
    function = jax.jit(function)
    # The n-th derivative at zero of the mean of exp(-u) over [0, x] is (-1)^n/(n + 1).
    assert float(function(0.0)) == pytest.approx((-1) ** order / (order + 1), rel=1e-13)
    for seam in (SERIES_BELOW, -SERIES_BELOW):
        below, above = (float(function(seam * (1 + step))) for step in (-1e-9, 1e-9))
        assert below == pytest.approx(above, rel=1e-8)


def test_the_mean_exponential_against_extended_precision():
    x = np.concatenate([-np.logspace(-8, 2, 60), np.logspace(-8, 2, 60)])
    wide = x.astype(np.longdouble)
    np.testing.assert_allclose(mean_exponential(x), (-np.expm1(-wide) / wide).astype(float), 2e-15)


def test_the_lifetime_is_the_logarithmic_slope():
    slope = jax.jit(jax.grad(lambda t: jnp.log(current(t, 500.0, 2e-8, 1e-6))))
    beam = current(7200.0, 500.0, 2e-8, 1e-6)
    assert float(lifetime(beam, 2e-8, 1e-6)) == pytest.approx(-1 / float(slope(7200.0)), rel=1e-12)


def test_a_varying_rate_against_an_adaptive_integrator():
    def rate(beam):
        return 2e-8 * (beam / 500) ** -0.3 * beam + 1e-6

    time = np.array([0.0, 60.0, 4000.0, 20000.0, 36000.0])
    exact = solve_ivp(
        lambda _, i: -rate(i) * i, (0, 36000), [500.0], t_eval=time, rtol=1e-12, atol=1e-12
    )
    np.testing.assert_allclose(current_by_rate(time, 500.0, rate), exact.y[0], rtol=1e-8)


def test_the_integrated_rate_can_be_differentiated():
    def end(b):
        return current_by_rate(np.array([0.0, 3e4]), 500.0, lambda i: 2e-8 * i + b, 64)[-1]

    exact = jax.jit(jax.grad(lambda b: current(3e4, 500.0, 2e-8, b)))(1e-6)
    assert float(jax.jit(jax.grad(end))(1e-6)) == pytest.approx(float(exact), rel=1e-7)
