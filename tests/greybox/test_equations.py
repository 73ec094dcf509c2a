"""The Taylor difference equation against a plain loop, and identified back from its own output."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from beamfit.errors import InputError
from beamfit.greybox.equations import TaylorDifference
from beamfit.greybox.problem import Free, Problem, Record
from beamfit.greybox.solve import solve

SECOND = TaylorDifference(("u",), ("y",), y_past=2, u_past=1)
# y_k = 0.1 + 1.2 y_(k-1) - 0.4 y_(k-2) + 0.3 u_k + 0.2 u_(k-1), report eq 4
P = np.array([0.1, 1.2, -0.4, 0.3, 0.2])
U = np.random.default_rng(4).normal(size=60)


def by_loop():
    y, before = [0.7, -0.2], U[0]  # y_(-2), y_(-1)
    for now in U:
        y.append(0.1 + 1.2 * y[-1] - 0.4 * y[-2] + 0.3 * now + 0.2 * before)
        before = now
    return np.array(y[2:])


def test_names_tell_the_order_of_the_coefficients():
    assert SECOND.coefficients == ("y:init", "y:y[k-1]", "y:y[k-2]", "y:u[k]", "y:u[k-1]")


def test_simulation_follows_the_recursion():
    found = SECOND.simulate(P, U[:, None], np.array([[-0.2], [0.7]]))[:, 0]
    np.testing.assert_allclose(found, by_loop(), rtol=0, atol=1e-13)


def test_second_degree_has_every_product_once():
    both = TaylorDifference(("u",), ("y", "z"), y_past=1, u_past=0, degree=2)
    y, z, u = 0.3, -0.5, 0.7
    monomials = np.array([1, y, z, u, y * y, y * z, y * u, z * z, z * u, u * u])
    p = np.random.default_rng(2).normal(size=20)
    expected = p.reshape(2, 10) @ monomials
    np.testing.assert_allclose(both(np.array([*p, y, z, u])), expected, rtol=1e-14)


def test_second_degree_is_the_taylor_series_of_a_process():
    """Eq 2: λ are first derivatives, halves of second ones; what remains is of third order."""

    def process(past):
        return jnp.exp(0.4 * past[0]) * jnp.sin(1.0 + past[1]) - jnp.sin(1.0)

    zero = jnp.zeros(2)
    slope, bend = jax.jit(lambda past: (jax.grad(process)(past), jax.hessian(process)(past)))(zero)
    p = [process(zero), *slope, 0.5 * bend[0, 0], bend[0, 1], 0.5 * bend[1, 1]]
    series = TaylorDifference(("u",), ("y",), y_past=1, u_past=0, degree=2)

    def remainder(step):
        past = step * jnp.array([1.0, -0.7])
        return float(process(past) - series(jnp.array([*p, *past]))[0])

    assert remainder(0.01) / remainder(0.005) == pytest.approx(8.0, rel=0.02)


def simulated(model, data):
    return SECOND.simulate(model["p"], *data)[:, 0]


def test_coefficients_are_identified_by_output_error():
    data = (U[:, None], np.array([[-0.2], [0.7]]))
    record = Record("simulated", simulated, data, by_loop(), 0.01)
    fit = solve(Problem({"p": np.zeros(5)}, [Free("p", -2.0, 2.0)], [record]), starts=3)
    np.testing.assert_allclose(fit.theta, P, atol=1e-7)


def test_numbers_out_of_range_are_refused():
    with pytest.raises(InputError, match="degree 3"):
        TaylorDifference(("u",), ("y",), degree=3)
