"""Verdicts on an objective without data: which kind of optimum, or why there is none."""

import jax.numpy as jnp
import numpy as np
import pytest

from beamfit.greybox.problem import Constraint, Free, Objective, Problem, Record
from beamfit.greybox.solve import solve


def minimise(function, start, *bounds, rules=(), **options):
    p = Problem(
        jnp.asarray(start, float),
        [Free("", *bounds)],
        objectives=[Objective("f", lambda x, _: function(x))],
        constraints=[Constraint(name, lambda x, _, g=g: g(x), None, *ends)
                     for name, g, *ends in rules],
    )  # fmt: skip
    return solve(p, **options)


def test_a_convex_problem_is_optimal_from_one_start():
    """min (x-1)^2 + (y-2)^2 with x + y <= 2: at (0.5, 1.5), multiplier of d(cost)/d(limit) -1."""
    rule = ("sum", lambda x: x[0] + x[1], -np.inf, 2.0)
    fit = minimise(lambda x: (x[0] - 1) ** 2 + (x[1] - 2) ** 2, [0.0, 0.0], rules=[rule])
    assert fit.status == "optimal", fit
    np.testing.assert_allclose(fit.theta, [0.5, 1.5], atol=1e-6)
    assert fit["sum"].multiplier == pytest.approx(-1.0, abs=1e-5)


def double_well(x):
    return (x[0] ** 2 - 1) ** 2 + 0.3 * x[0]


def test_one_start_cannot_tell_of_others():
    fit = minimise(double_well, [0.9], -2.0, 2.0)
    assert fit.status == "local_optimum"
    assert "more starts search further" in fit.message
    assert fit.theta[0] > 0


def test_other_optima_are_told_with_their_costs():
    fit = minimise(double_well, [0.9], -2.0, 2.0, starts=12, seed=3)
    assert fit.status == "local_optimum"
    roots = np.roots([4, 0, -4, 0.3]).real
    higher = f"{double_well([max(roots)]):.6g}"
    assert f"others at {higher} (" in fit.message
    assert fit.theta[0] == pytest.approx(min(roots), abs=1e-6)


def test_starts_that_agree_prove_nothing():
    fit = minimise(lambda x: (1 - x[0]) ** 2 + 9 * (x[1] - x[0] ** 2) ** 2, [-1.2, 1.0], starts=8)
    assert fit.status == "local_optimum"
    assert "the best of 8 starts, of which 8 ended on it" in fit.message
    assert "not proved to be the lowest" in fit.message


def caster(start):
    """CSFI1: the most tonnes an hour of a steel caster (F. Vasko & K. Stott, SIAM Review 37, 82).

    A maximum of 49.0752 all along a curve of thickness, width and speed.
    """
    area = 117.3708920187793427

    def equations(x, _):
        thick, wide, length, tonnes, speed = x
        return jnp.array([area * tonnes / (wide * thick) - speed, thick**2 * speed / 48 - length])

    rules = [
        Constraint("flow", equations, None, 0.0, 0.0),
        Constraint("aspect", lambda x, _: x[1] / x[0], None, -np.inf, 2.0),
        Constraint("section", lambda x, _: x[0] * x[1], None, 200.0, 250.0),
    ]
    lower, upper = np.array([7.0, 0, 0, 0, 0]), np.array([np.inf, np.inf, 60.0, np.inf, np.inf])
    free = [Free("", lower, upper)]
    goal = [Objective("tonnes", lambda x, _: -x[3])]
    return Problem(np.full(5, start), free, constraints=rules, objectives=goal)


@pytest.mark.parametrize("start", [0.5, 1.0, 5.0, 20.0, 50.0])
def test_a_ridge_along_curved_constraints_is_no_saddle(start):
    fit = solve(caster(start))
    assert fit.status == "local_optimum", fit
    assert fit.cost == pytest.approx(-49.0752, abs=1e-5)


RIDGES = {
    "product": lambda x: (x[0] * x[1] - 1) ** 2,
    "bell": lambda x: -jnp.exp(-((x[0] * x[1] - 1) ** 2)),
    "circle": lambda x: (x[0] ** 2 + x[1] ** 2 - 1) ** 2,
    "wave": lambda x: jnp.sin(x[0] - x[1]),
    "quartic": lambda x: (x[0] - x[1]) ** 4,
    "ratio": lambda x: (x[0] / x[1] - 2) ** 2,
    "logarithm": lambda x: jnp.log1p((x[0] + 2 * x[1]) ** 2),
    "parabola": lambda x: jnp.cosh(x[0] - x[1] ** 2),
    "one does nothing": lambda x: x[0] ** 4,
}


@pytest.mark.parametrize("start", [(0.7, 0.4), (0.1, 3.0)])
@pytest.mark.parametrize("name", RIDGES)
def test_a_flat_direction_is_no_saddle(name, start):
    fit = minimise(RIDGES[name], list(start))
    assert fit.status in ("local_optimum", "optimal"), fit


@pytest.mark.parametrize("start", [(0.5, 0.2, 4.0), (-1.5, 0.3, 2.0)])
def test_a_ridge_of_a_curved_limit_is_no_saddle(start):
    """The least z above a valley that is a circle: 0 all along it."""
    rule = ("above", lambda x: x[2] - (x[0] ** 2 + x[1] ** 2 - 1) ** 2, 0.0)
    fit = minimise(lambda x: x[2], list(start), rules=[rule])
    assert fit.status in ("local_optimum", "degenerate"), fit


def test_rounding_at_zero_breaks_no_limit():
    """All that the limit holds ends at zero: half of such starts were called infeasible."""
    rule = ("above", lambda x: x[2] - (x[0] ** 2 + x[1] ** 2 - 1) ** 2, 0.0)
    for k in range(8):
        start = np.array([-1.5, 0.3, 2.0]) * (1 + 1e-15 * k)
        fit = minimise(lambda x: x[2], list(start), rules=[rule])
        assert fit.status in ("local_optimum", "degenerate"), fit
    assert fit.cost == pytest.approx(0.0, abs=1e-6)


def test_a_saddle_along_a_curved_constraint_is_left():
    """On a circle x + 0.3 x^2 is stationary at both ends of it, and least at one."""
    rule = ("circle", lambda x: x[0] ** 2 + x[1] ** 2, 1.0, 1.0)
    fit = minimise(lambda x: x[0] + 0.3 * x[1] ** 2, [1.0, 0.0], rules=[rule])
    assert fit.theta == pytest.approx([-1.0, 0.0], abs=1e-5)


def test_constraints_that_conflict_are_named_and_no_others():
    """Of four, `low` and `high` conflict within x <= 1; `far` and `idle` do not matter."""
    rules = [
        ("low", lambda x: x[0] + x[1], 3.0, np.inf),
        ("high", lambda x: x[1], -np.inf, 1.5),
        ("far", lambda x: x[0] - x[1], -50.0, 50.0),
        ("idle", lambda x: x[1], -9.0, np.inf),
    ]
    fit = minimise(lambda x: x[0] ** 2, [0.0, 0.0], [-5.0, -9.0], [1.0, 9.0], rules=rules)
    assert fit.status == "infeasible"
    assert "'low', 'high' cannot hold together within [0] <= 1" in fit.message.replace(
        fit.problem.names[0], "[0]"
    )
    assert "far" not in fit.message
    assert "idle" not in fit.message


def test_one_constraint_that_cannot_hold_is_named_alone():
    fit = minimise(lambda x: x[0], [0.5], rules=[("square", lambda x: x[0] ** 2, -np.inf, -1.0)])
    assert fit.status == "infeasible"
    assert "'square' cannot hold;" in fit.message


def test_a_feasible_point_that_the_solvers_missed_is_found_by_relaxing():
    """From x = 0 sin(x) = 0 has no slope to follow that helps x^2 >= 30."""
    rules = [("wave", lambda x: jnp.sin(x[0]), 0.0, 0.0), ("out", lambda x: x[0] ** 2, 30.0)]
    fit = minimise(lambda x: (x[0] - 1) ** 2, [0.0], -20.0, 20.0, rules=rules)
    assert fit.status in ("local_optimum", "degenerate"), fit
    assert abs(np.sin(fit.theta[0])) < 1e-5


def test_an_objective_without_a_least_value_is_unbounded():
    fit = minimise(lambda x: x[0] + x[1] ** 2, [1.0, 1.0])
    assert fit.status == "unbounded"
    assert fit.problem.names[0] in fit.message


def test_a_cost_that_is_tiny_where_it_starts_is_not_without_end():
    """The start lies so far out in a bell curve that its cost says nothing of the least one."""
    fit = minimise(lambda x: -jnp.exp(-((x[0] - 8) ** 2)), [0.5], -10.0, 10.0)
    assert fit.status == "local_optimum", fit
    np.testing.assert_allclose(fit.theta, [8.0], atol=1e-6)


def test_kinks_bend_nothing_and_are_not_convex():
    fit = minimise(lambda x: -jnp.abs(x[0]) - 0.1 * x[0], [-0.5], -1.0, 1.0)
    assert fit.status == "local_optimum", fit  # 0.2 above the optimum at the other bound
    best = minimise(lambda x: jnp.maximum(x[0] ** 2, (x[0] - 2) ** 2), [2.0], -5.0, 5.0)
    assert best.status == "optimal", best


def test_a_violation_squared_has_no_constraint_qualification():
    """As Appendix B is printed: sum(max(g + eps, 0)^2) <= 0."""
    rule = ("gains", lambda x: jnp.sum(jnp.maximum(x - 1.0, 0.0) ** 2), -np.inf, 0.0)
    fit = minimise(lambda x: jnp.sum((x - 2.0) ** 2), [0.0, 0.5], rules=[rule])
    assert fit.status == "degenerate", fit
    assert "'gains' has no slope where it holds" in fit.message
    assert "g <= 0 in the place of" in fit.message
    better = ("gains", lambda x: x, -np.inf, 1.0)
    fit = minimise(lambda x: jnp.sum((x - 2.0) ** 2), [0.0, 0.5], rules=[better])
    assert fit.status == "optimal"


def test_hock_schittkowski_13_has_no_multipliers():
    """(1 - x)^3 >= y >= 0 meets in a cusp at the best point (problem 13)."""
    rule = ("cusp", lambda x: (1 - x[0]) ** 3 - x[1], 0.0)
    fit = minimise(lambda x: (x[0] - 2) ** 2 + x[1] ** 2, [-2.0, -2.0], 0.0, rules=[rule])
    assert fit.status == "degenerate", fit
    assert "no multipliers" in fit.message
    assert fit.theta[0] == pytest.approx(1.0, abs=5e-3)


def test_a_constraint_said_twice_has_no_unique_multiplier():
    rules = [("one", lambda x: x[0] + x[1], 1.0), ("two", lambda x: 2 * x[0] + 2 * x[1], 2.0)]
    fit = minimise(lambda x: x[0] ** 2 + x[1] ** 2, [3.0, 0.0], rules=rules)
    assert fit.status == "degenerate", fit
    assert "'one', 'two'" in fit.message
    np.testing.assert_allclose(fit.theta, [0.5, 0.5], atol=1e-6)


def test_a_saddle_that_is_not_left_is_called_one():
    """The minima beside it are nearer than the search looks."""
    fit = minimise(lambda x: x[1] ** 2 - x[0] ** 2 + 1e8 * x[0] ** 4, [0.0, 1.0])
    assert fit.status == "saddle", fit
    assert f"bends down along {fit.problem.names[0]}" in fit.message


def test_a_fit_to_data_keeps_its_statuses():
    record = Record("r", lambda x, _: x, None, np.ones(2), 0.1)
    fit = solve(Problem(jnp.zeros(2), [Free("", -5, 5)], [record],
                        objectives=[Objective("f", lambda x, _: x[0] ** 2)]), starts=8)  # fmt: skip
    assert fit.status == "converged"
