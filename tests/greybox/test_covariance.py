"""Bounds as information: exact where data decide, and a Monte Carlo of an open number."""

import numpy as np
import pytest

from beamfit.greybox.covariance import directions, spread_of, triangle


def test_far_bounds_leave_the_covariance_of_the_data():
    jacobian = np.random.default_rng(1).normal(size=(9, 3))
    found = spread_of(jacobian, np.full(3, -1e6), np.full(3, 1e6))
    np.testing.assert_allclose(found.covariance, np.linalg.inv(jacobian.T @ jacobian), rtol=1e-8)
    assert np.all(found.share(np.eye(3)) < 1e-10)


def test_without_bounds_an_open_direction_has_no_useful_error():
    found = spread_of(np.array([[1.0, 1.0]]), np.full(2, -np.inf), np.full(2, np.inf))
    along, across = found.error(np.array([[1.0, 1.0], [1.0, -1.0]]))
    assert along < 1.001
    assert across > 1e5


def test_an_open_number_is_as_uncertain_as_an_end_of_its_range():
    """Truth anywhere in 0 to 6, answer on an end: mean square distance 36/3."""
    truth = np.random.default_rng(2).uniform(0.0, 6.0, 200_000)
    found = spread_of(np.zeros((1, 1)), np.zeros(1), np.full(1, 6.0))
    np.testing.assert_allclose(found.error(np.eye(1)), np.sqrt(np.mean(truth**2)), rtol=5e-3)
    np.testing.assert_allclose(found.share(np.eye(1)), 1.0)


def test_held_numbers_do_not_move_and_a_prior_takes_the_place_of_bounds():
    jacobian = np.array([[2.0, 1.0], [0.0, 1.0]])
    held = spread_of(jacobian, np.zeros(2), np.ones(2), held=np.array([False, True]))
    assert held.covariance[1].tolist() == [0.0, 0.0]
    prior = spread_of(jacobian, np.zeros(2), np.ones(2), with_prior=np.array([True, True]))
    np.testing.assert_allclose(prior.covariance, np.linalg.inv(jacobian.T @ jacobian), rtol=1e-10)


def test_rows_that_outnumber_columns_are_reduced_first_and_give_the_same():
    rows = np.random.default_rng(3).normal(size=(500, 4)) * [1.0, 1e6, 1e-6, 1.0]
    whole = directions(rows)[0]
    np.testing.assert_allclose(whole @ whole.T, np.linalg.inv(rows.T @ rows), rtol=1e-9)
    assert triangle(rows).shape == (4, 4)


def test_what_is_open_has_no_error_and_rests_on_nothing():
    rows = np.array([[1.0, 1.0, 0.0], [0.0, 0.0, 2.0]])
    found = spread_of(rows, np.full(3, -np.inf), np.full(3, np.inf))
    asked = np.array([[1.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    np.testing.assert_allclose(found.error(asked), [1.0, 0.5, np.inf])
    np.testing.assert_allclose(found.share(asked), [0.0, 0.0, 1.0])
    assert found.seen[2, 2] == 0.25


def test_directions_keep_to_equations_of_any_size():
    rows, rule = np.eye(3), np.array([[1e-9, -1e-9, 0.0]])
    half, unseen, _ = directions(rows, rule)
    assert half.shape == (3, 2)
    assert unseen.shape == (3, 0)
    np.testing.assert_allclose(half[0], half[1])


@pytest.mark.parametrize("n", [3, 230])
def test_rows_divided_by_a_factor_have_the_spread_times_it(n):
    rows = np.random.default_rng(n).normal(size=(2 * n, n))
    free = np.full(n, np.inf)
    direct = spread_of(rows / 1.7, -free, free)
    scaled = spread_of(rows, -free, free).times(1.7)
    expected = 1.7**2 * np.linalg.inv(rows.T @ rows)
    for found in (direct, scaled):
        np.testing.assert_allclose(found.covariance, expected, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(found.errors, np.sqrt(np.diag(expected)), rtol=1e-9)
        assert found.trace(rows) == pytest.approx(1.7**2 * n)
