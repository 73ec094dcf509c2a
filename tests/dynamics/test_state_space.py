"""State spaces against scipy's integrator, matrix exponential and linear filters."""

import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.signal import dlsim

from beamfit.dynamics.states import Matrices, StateSpace, linear_outputs


def gap(n, rng):
    return rng.uniform(0.05, 0.4, n), rng.uniform(-1.0, 1.0, (n, 2))


def pendulum(x, u, p):
    return jnp.stack([x[1], -jnp.sin(x[0]) * p["w"] - 0.2 * x[1] + p["k"] @ u])


def test_a_run_at_uneven_samples_is_that_of_an_adaptive_integrator():
    dt, u = gap(25, np.random.default_rng(0))
    p, x = {"w": 3.0, "k": jnp.array([1.0, -2.0])}, np.array([0.5, 0.0])
    system = StateSpace(pendulum, lambda x, u, p: jnp.stack([x[0], x[0] * x[1] + u[1]]), parts=8)
    y, last = system.run(p, jnp.asarray(u), jnp.asarray(dt), jnp.asarray(x))
    for k in range(25):
        np.testing.assert_allclose(y[k], [x[0], x[0] * x[1] + u[k, 1]], atol=1e-6)
        x = solve_ivp(lambda t, s, u: np.asarray(pendulum(s, u, p)), (0, dt[k]), x, args=(u[k],),
                      rtol=1e-10, atol=1e-12).y[:, -1]  # fmt: skip
    np.testing.assert_allclose(last, x, atol=1e-6)


def test_an_affine_state_moves_as_its_matrix_exponential_does_with_parameters_of_the_input():
    dt, u = gap(12, np.random.default_rng(1))

    def flow(x, u, p):
        return jnp.stack([x[1], -p[0] * x[0] - p[1] * x[1] + u[0]])

    def of_u(u):
        return jnp.stack([2.0 + u[1], 0.3])

    y, last = StateSpace(flow, lambda x, u, p: p[0] * x[:1], affine=True).run(
        of_u, jnp.asarray(u), jnp.asarray(dt), jnp.array([1.0, 0.0])
    )
    x = np.array([1.0, 0.0])
    for k in range(12):
        np.testing.assert_allclose(y[k, 0], (2.0 + u[k, 1]) * x[0], rtol=1e-9)
        both = np.zeros((3, 3))
        both[:2] = [[0, 1, 0], [-(2.0 + u[k, 1]), -0.3, u[k, 0]]]
        x = (expm(both * dt[k]) @ np.append(x, 1.0))[:2]
    np.testing.assert_allclose(last, x, rtol=1e-9)


def test_blocks_of_a_linear_system_are_scipy_s_filter():
    rng = np.random.default_rng(2)
    a = 0.9 * np.linalg.qr(rng.normal(size=(3, 3)))[0]
    b, c, d = rng.normal(size=(3, 2)), rng.normal(size=(2, 3)), rng.normal(size=(2, 2))
    u, x0 = rng.normal(size=(75, 2)), rng.normal(size=3)
    system = Matrices(*map(jnp.asarray, (a, b, c, d)), jnp.array([1.0, -2.0]))
    y = linear_outputs(system, jnp.asarray(u), jnp.asarray(x0))[0]
    expected = dlsim((a, b, c, d, 1.0), u, x0=x0)[1]
    np.testing.assert_allclose(y, np.add(expected, [1.0, -2.0]), rtol=1e-10, atol=1e-10)
