"""Steps of the responses against matrix exponentials, the report's equations and limits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import lfilter

from beamfit.dynamics.fit import identify
from beamfit.dynamics.record import Run
from beamfit.dynamics.response import ARX, FIRST_ORDER, PHYSICS, SECOND_ORDER, simulate

simulate = jax.jit(simulate, static_argnums=0)  # a program a shape, not one an operation


def held(matrix, drive, x, u, dt):
    """The state of x' = A x + B u after dt, by the exponential of both together (Van Loan)."""
    n = len(matrix)
    both = np.zeros((n + 1, n + 1))
    both[:n, :n], both[:n, n] = matrix * dt, drive * dt * u
    return expm(both)[:n] @ np.append(x, 1.0)


@pytest.mark.parametrize("time", [1e-3, 0.7, 40.0])
@pytest.mark.parametrize("zeta", [0.0, 0.3, 1.0 - 1e-9, 1.0, 1.0 + 1e-5, 4.0])
def test_a_second_order_moves_as_its_matrix_exponential_does(time, zeta):
    x, u, dt = np.array([0.4, -0.2]), 1.7, 0.37
    matrix = np.array([[0.0, 1.0], [-1 / time**2, -2 * zeta / time]])
    expected = held(matrix, np.array([0.0, 2.5 / time**2]), x, u, dt)
    found = SECOND_ORDER.advance(jnp.array([time, zeta, 2.5]), jnp.array(x), jnp.array([u]), dt)
    scale = np.array([1.0, max(1.0, 1 / time)])
    np.testing.assert_allclose(found / scale, expected / scale, rtol=1e-9, atol=1e-9)


def test_slopes_are_finite_where_both_lags_are_equal():
    def after(p):
        return SECOND_ORDER.advance(p, jnp.array([0.4, -0.2]), jnp.array([1.7]), 0.37)

    p = jnp.array([1.3, 1.0, 2.0])
    step = 1e-5 * jnp.array([0.0, 1.0, 0.0])
    expected = (after(p + step) - after(p - step)) / 2e-5
    np.testing.assert_allclose(jax.jit(jax.jacfwd(after))(p)[:, 1], expected, rtol=1e-6)


def test_a_first_order_moves_as_its_exponential_does():
    expected = held(np.array([[-1 / 3.0]]), np.array([2.0 / 3.0]), [0.4], 1.7, 0.5)
    found = FIRST_ORDER.advance(jnp.array([3.0, 2.0]), jnp.array([0.4]), jnp.array([1.7]), 0.5)
    np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.parametrize(("tau1", "tau2"), [(5.5, 0.4), (2.0, 2.0 + 1e-4)])
def test_the_difference_equation_of_the_report_has_the_samples_of_a_second_order(tau1, tau2):
    """Eqs 13-16, which are 0/0 at equal lags, against the step that is not."""
    gain, dt, n = 1.5, 0.5, 40
    e1, e2 = np.exp(-dt / tau1), np.exp(-dt / tau2)
    share1, share2 = gain * tau1 / (tau1 - tau2), -gain * tau2 / (tau1 - tau2)
    p = [-(e1 + e2), e1 * e2, share1 * (1 - e1) + share2 * (1 - e2)]
    p.append(-(share1 * e2 * (1 - e1) + share2 * e1 * (1 - e2)))
    u = np.random.default_rng(0).normal(size=(n, 1))
    natural = np.sqrt(tau1 * tau2)
    second = [natural, (tau1 + tau2) / (2 * natural), gain]

    def run(physics, numbers, free):
        every = jnp.tile(jnp.array(numbers), (n, 1))
        return simulate(physics, every, jnp.array(u), jnp.full(n, dt), jnp.array(free))

    smooth = run(SECOND_ORDER, second, [0.0, 0.0])
    filtered = lfilter([0.0, *p[2:]], [1.0, *p[:2]], u[:, 0])
    np.testing.assert_allclose(smooth, filtered, rtol=1e-7, atol=1e-8)
    # Before the first sample its input is taken to have been as it is.
    moved = run(ARX, p, [0.0, 0.0])
    extra = lfilter([1.0], [1.0, *p[:2]], np.eye(1, n, 1)[0] * p[3] * u[0])
    np.testing.assert_allclose(moved, filtered + extra, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("physics", PHYSICS.values(), ids=list(PHYSICS))
def test_raw_numbers_of_any_size_are_stable_and_come_back(physics):
    count = len(physics.parameters(("a", "b")))
    for q in np.random.default_rng(1).normal(0, 1.5, (20, count)):
        p = physics.physical(jnp.array(q))
        np.testing.assert_allclose(physics.raw(p), q, rtol=1e-6)
        x = physics.begin(jnp.ones(physics.free_states), jnp.zeros(2))
        y = simulate(physics, jnp.tile(p, (4000, 1)), jnp.zeros((4000, 2)), jnp.ones(4000), x[
            : physics.free_states])  # fmt: skip
        assert jnp.max(jnp.abs(y[-1])) < max(1.0, float(jnp.max(jnp.abs(y[:50]))))


def test_samples_at_unequal_distances_are_those_of_the_same_process():
    """The output at 0, 1, 2, ... is the same whether or not it is looked at in between."""
    p, free = jnp.array([1.4, 0.3, 2.0]), jnp.array([0.5, -0.1])
    u = jnp.repeat(jnp.array([[1.0], [0.0], [2.0], [-1.0]]), 2, axis=0)
    dt = jnp.tile(jnp.array([0.3, 0.7]), 4)
    fine = simulate(SECOND_ORDER, jnp.tile(p, (8, 1)), u, dt, free)
    coarse = simulate(SECOND_ORDER, jnp.tile(p, (4, 1)), u[::2], jnp.ones(4), free)
    np.testing.assert_allclose(fine[::2], coarse, rtol=1e-12)


def test_a_number_that_ran_to_the_end_of_its_range_is_not_known():
    """The damping of 20 readings ended at 0.000 ± 0.000, and was converged; simulated."""
    u = [99.4, 101.0, 100.45, 99.87, 98.73, 99.67, 100.35, 100.8, 100.21, 99.79]
    u += [100.37, 100.11, 101.41, 100.79, 98.97, 100.45, 100.23, 99.37, 99.27, 101.83]
    y = [215.15, 215.15, 215.14, 215.15, 215.15, 215.38, 215.77, 216.04, 216.01, 215.87]
    y += [215.89, 216.11, 216.37, 216.47, 216.55, 216.62, 216.85, 217.17, 217.16, 217.03]
    fit = identify(Run(0.1 * np.arange(20), {"u": np.array(u)}, {"y": np.array(y)}), "second-order")
    assert fit.status == "unidentified"
    assert fit.quantities["zeta"].error is None
    assert "no more of the output than chance" in fit.message
