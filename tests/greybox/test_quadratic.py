"""The quadratic program against its optimality conditions and an independent solver."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linprog, minimize

from beamfit.greybox.programs import Quadratic, minimum

solved = jax.jit(minimum)


def program(seed, soft=0):
    """20 numbers in a box and under 12 further rows, the last `soft` of which have a price."""
    random = np.random.default_rng(seed)
    root = random.normal(size=(30, 20))
    rows = np.vstack([np.eye(20), -np.eye(20), random.normal(size=(12, 20))])
    limits = np.concatenate([np.ones(40), random.uniform(0.1, 1.0, 12)])
    cost = np.full(52, np.inf)
    cost[52 - soft :] = 1.0
    return Quadratic(root.T @ root, 50 * random.normal(size=20), rows, limits, cost)


@pytest.mark.parametrize("soft", [0, 12])
def test_no_better_point_exists(soft):
    for seed in range(5):
        qp = program(seed, soft)
        z, force = (np.asarray(v) for v in solved(qp, jnp.zeros(20)))
        over = qp.rows @ z - qp.limits
        hard = np.isinf(qp.cost)
        np.testing.assert_allclose(qp.matrix @ z + qp.slope + qp.rows.T @ force, 0.0, atol=1e-6)
        assert over[hard].max() < 1e-8
        assert force.min() > -1e-9
        assert (force <= qp.cost + 1e-9).all()
        assert np.abs(force * np.minimum(over, 0.0)).max() < 1e-6
        # A row that is passed is paid for in full.
        assert np.abs((qp.cost - force)[~hard] * np.maximum(over, 0.0)[~hard]).max(initial=0) < 1e-6
        assert not soft or over.max() > 1e-3


def test_the_minimum_is_that_of_slsqp():
    qp = program(7)
    kept = {"type": "ineq", "fun": lambda z: qp.limits - qp.rows @ z, "jac": lambda z: -qp.rows}
    found = minimize(lambda z: 0.5 * z @ qp.matrix @ z + qp.slope @ z, np.zeros(20),
                     jac=lambda z: qp.matrix @ z + qp.slope, method="SLSQP", constraints=[kept],
                     options={"ftol": 1e-9, "maxiter": 500})  # fmt: skip
    assert found.success
    np.testing.assert_allclose(solved(qp, jnp.ones(20))[0], found.x, atol=1e-5)


def test_soft_rows_that_nothing_keeps_are_passed_by_the_least_sum():
    """Two rows that contradict each other, as the linear program of their slacks has it."""
    rows = jnp.array([[1.0, 0.0], [-1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.0, -1.0]])
    limits = jnp.array([-1.0, -2.0, -4.0, 1.0, 1.0])
    cost = jnp.array([1e4, 1e4, 1e4, jnp.inf, jnp.inf])
    z, _ = solved(Quadratic(1e-3 * jnp.eye(2), jnp.zeros(2), rows, limits, cost), jnp.zeros(2))
    assert abs(z[1]) <= 1.0
    over = float(np.maximum(rows @ z - limits, 0.0)[:3].sum())
    slack = np.vstack([-np.eye(3), np.zeros((2, 3))])
    least = linprog([0, 0, 1, 1, 1], np.hstack([rows, slack]), limits,
                    bounds=[(None, None)] * 2 + [(0, None)] * 3)  # fmt: skip
    assert over == pytest.approx(least.fun, abs=1e-5)
