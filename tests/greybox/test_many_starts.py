"""The vectorised search against the one that judges, on the report's appendices (SIMULATED)."""

import jax.numpy as jnp
import numpy as np
import pytest
from appendices import appendix_a, appendix_c, simulated_scan

from beamfit.greybox import problem
from beamfit.greybox.descend import descend_all
from beamfit.greybox.solve import solve, starting_points


@pytest.mark.parametrize("make", [appendix_a, appendix_c], ids=["A", "C"])
def test_it_ends_where_the_careful_search_ends(make):
    p = make(simulated_scan(1))
    points = jnp.asarray(np.array(starting_points(p, 12, 3)))
    found = descend_all(problem.residual, p.core, points, p.lower, p.upper)
    best = solve(p, starts=12, seed=3)
    cost = np.asarray(found.cost)
    assert np.sum(np.abs(cost - best.cost) < 1e-6 * best.cost) >= 10
    assert np.min(cost) >= best.cost * (1 - 1e-9)
    theta = np.asarray(found.theta)
    assert np.all((theta >= p.lower) & (theta <= p.upper))


def quadratic(data, theta):
    matrix, right = data
    return matrix @ theta - right


def test_a_bound_is_met_exactly_and_a_fixed_number_stays():
    """Against the normal equations of the loose numbers."""
    random = np.random.default_rng(2)
    matrix, right = random.normal(size=(8, 3)), random.normal(size=8)
    free = np.linalg.lstsq(matrix, right, rcond=None)[0]
    lower = np.array([free[0] + 0.5, -9.0, 0.25])
    upper = np.array([free[0] + 2.0, 9.0, 0.25])
    start = np.array([[lower[0] + 1.0, 3.0, 0.25]])
    found = descend_all(quadratic, (matrix, right), start, lower, upper)
    rest = right - matrix[:, 0] * lower[0] - matrix[:, 2] * 0.25
    expected = (matrix[:, 1] @ rest) / (matrix[:, 1] @ matrix[:, 1])
    np.testing.assert_allclose(found.theta[0], [lower[0], expected, 0.25], atol=1e-8)
    assert bool(found.rested[0])


def test_fewer_residuals_than_numbers_are_met_in_a_few_steps():
    """Of a linear problem: a step that is no least-squares step would take many, or rest short."""
    random = np.random.default_rng(4)
    data = random.normal(size=(3, 7)), random.normal(size=3)
    wide = np.full(7, np.inf)
    found = descend_all(quadratic, data, random.normal(size=(5, 7)), -wide, wide)
    assert np.max(found.cost) < 1e-20
    assert np.max(found.steps) < 15
    assert np.all(found.rested)
