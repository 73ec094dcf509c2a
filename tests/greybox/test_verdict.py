"""What `solve` says of an end: the same in every unit, and of second order."""

import subprocess
import sys
import time

import jax.numpy as jnp
import numpy as np
import pytest
from appendices import SIGMA, transport
from scipy.optimize import minimize_scalar

from beamfit.errors import InputError
from beamfit.greybox.problem import Constraint, Free, Objective, Problem, Record
from beamfit.greybox.solve import solve

X = np.linspace(-1.0, 1.0, 21)
CALIBRATION = {"slope_q4": 167.23, "int_q4": 43.17, "int_q3": 49.0}


def minimise(function, start, *bounds, constraints=(), starts=1, **options):
    p = Problem(
        jnp.asarray(start, float),
        [Free("", *bounds)],
        objectives=[Objective("f", lambda x, _: function(x))],
        constraints=constraints,
    )
    return solve(p, starts, **options)


def square_at_screen(current):
    """Squared size at the GTF screen, 1e-8 m²."""
    a, b = transport(CALIBRATION, current)
    return a**2 * SIGMA[0] + 2 * a * b * SIGMA[1] + b**2 * SIGMA[2]


@pytest.mark.parametrize("unit", [1e-8, 1.0, 1e4], ids=["m²", "1e-8 m²", "µm²"])
def test_the_smallest_size_at_the_gtf_screen_is_the_same_in_every_unit(unit):
    fit = minimise(lambda x: unit * square_at_screen(x[0]), [1.0], 0.0, 4.0)
    exact = minimize_scalar(lambda c: float(square_at_screen(c)), (1.0, 2.0, 3.0), tol=1e-12)
    assert fit.status == "local_optimum", fit
    assert fit.theta[0] == pytest.approx(exact.x, abs=1e-5)


@pytest.mark.parametrize("factor", [1e-9, 1.0, 1e9])
@pytest.mark.parametrize("length", [1e-6, 1.0])
def test_rosenbrock_in_any_unit_is_followed_to_its_end(factor, length):
    def rosenbrock(x):
        return factor * (
            (1 - x[0] / length) ** 2 + 100 * ((x[1] - x[0] ** 2 / length) / length) ** 2
        )

    fit = minimise(rosenbrock, [-1.2 * length, length])
    assert fit.status == "local_optimum", fit
    np.testing.assert_allclose(fit.theta, [length, length], rtol=1e-6)


def test_rosenbrock_at_its_start_is_no_optimum():
    fit = minimise(lambda x: 1e-9 * ((1 - x[0]) ** 2 + 100 * (x[1] - x[0] ** 2) ** 2), [-1.2, 1.0],
                   iterations=1)  # fmt: skip
    assert fit.status == "not_converged"


@pytest.mark.parametrize("unit", [1.0, 1e6], ids=["m", "µm"])
def test_numbers_well_inside_small_bounds_are_free(unit):
    """Three numbers of 1e-8 m inside ±1e-7 m."""
    true = np.array([1e-8, 2e-8, -1e-8]) * unit
    record = Record("r", lambda m, _: m / unit * 1e7, None, true / unit * 1e7, 0.01)
    fit = solve(Problem(jnp.zeros(3), [Free("", -1e-7 * unit, 1e-7 * unit)], [record]))
    assert fit.status == "converged", fit
    np.testing.assert_allclose(fit.theta, true, rtol=1e-6)
    assert all(v.state == "free" for v in fit.variables)


@pytest.mark.parametrize("unit", [1.0, 1e6], ids=["m", "µm"])
def test_a_limit_out_of_reach_is_infeasible_in_every_unit(unit):
    rule = Constraint("size", lambda x, _: x[0] ** 2, None, lower=(2e-3 * unit) ** 2)
    fit = minimise(
        lambda x: x[0] ** 2, [1e-4 * unit], -1e-3 * unit, 1e-3 * unit, constraints=[rule]
    )
    assert fit.status == "infeasible", fit
    assert abs(fit.theta[0]) == pytest.approx(1e-3 * unit)  # as near as it gets


def test_a_saddle_is_left():
    fit = minimise(lambda x: x[1] ** 2 - x[0] ** 2 + x[0] ** 4 / 4, [0.0, 1.0], -2.0, 2.0)
    assert fit.status == "local_optimum"
    assert fit.cost == pytest.approx(-1.0)


def test_a_maximum_is_left():
    fit = minimise(lambda x: jnp.cos(x[0]), [0.0], -4.0, 4.0)
    assert fit.status == "local_optimum"
    assert abs(fit.theta[0]) == pytest.approx(np.pi, abs=1e-6)


@pytest.mark.parametrize("start", [0.0, 19.0])
def test_a_tail_that_falls_for_ever_is_no_optimum(start):
    fit = minimise(lambda x: jnp.exp(-x[0]), [start])
    assert fit.status == "not_converged"
    assert "next step" in fit.message


@pytest.mark.parametrize("lower", [-3.0, 0.0], ids=["inside", "at a bound"])
def test_squares_leave_a_saddle_too(lower):
    record = Record("r", lambda x, _: x**2 - 1.0, None, np.zeros(1), 1.0)
    fit = solve(Problem(jnp.zeros(1), [Free("", lower, 3.0)], [record]))
    assert abs(fit.theta[0]) == pytest.approx(1.0)


def test_hock_schittkowski_24_ends_at_its_optimum_from_all_of_20_starts():
    """f* = -1 at (3, sqrt 3) (Hock & Schittkowski 1981, problem 24); IPOPT does it from all 20."""
    root = np.sqrt(3.0)
    rules = [
        Constraint("a", lambda x, _: x[0] / root - x[1], None, lower=0.0),
        Constraint("b", lambda x, _: x[0] + root * x[1], None, 0.0, 6.0),
    ]
    fit = minimise(
        lambda x: ((x[0] - 3) ** 2 - 9) * x[1] ** 3 / (27 * root),
        [1.0, 0.5], 0.0, 10.0, constraints=rules, starts=20, seed=1,
    )  # fmt: skip
    assert fit.status == "local_optimum"
    assert "of which 20 ended on it" in fit.message
    np.testing.assert_allclose([a.cost for a in fit.attempts], -1.0, atol=1e-5)
    np.testing.assert_allclose(fit.theta, [3.0, root], rtol=1e-6)


def test_an_objective_without_data_is_never_unidentified():
    fit = minimise(lambda x: x[0] ** 2, [1.0, 1.0])  # the second number does nothing
    assert fit.status == "optimal"


def test_a_search_in_a_flat_valley_has_settled():
    """What is left to gain in chi-square is below 0.01."""

    def valley(m, _):
        return jnp.stack([0.03 * (1 - m[0]), 10 * (m[1] - m[0] ** 2)])

    def fit(slope):
        record = Record("r", lambda m, d: valley(m, d) * jnp.array([slope, 1.0]), None, [0, 0], 1.0)
        return solve(Problem(jnp.array([-1.2, 1.44]), [Free("")], [record]), iterations=3)

    flat, steep = fit(1.0), fit(100.0)
    assert flat.kkt.worst > 1e-6
    assert flat.status == "converged"
    assert "has settled" in flat.message
    assert steep.status == "not_converged"


def test_starts_that_were_dropped_or_moved_are_said():
    record = Record("r", lambda m, x: jnp.sqrt(m["k"]) * x, X, 2 * X, 0.1)
    p = Problem({"k": 1.0}, [Free("k", start=(-1.0, 3.0))], [record])
    fit = solve(p, starts=20, seed=2)
    lost = sum(np.isnan(attempt.cost) for attempt in fit.attempts)
    assert 0 < lost < 20
    assert f"{lost} of 20 starts dropped: cost not finite there." in fit.message
    assert fit.theta[0] == pytest.approx(4.0)
    fit = solve(Problem({"k": -1.0}, [Free("k", 0.5, 9.0)], [record]))
    assert "1 of 1 starts moved onto their bounds." in fit.message


@pytest.mark.parametrize("kind", ["squares", "objective"])
def test_a_limit_of_time_is_said_and_the_best_point_kept(kind):
    record = Record("r", lambda m, x: m["k"] * x, X, 2 * X, 0.1)
    more = {"objectives": [Objective("f", lambda m, _: m["k"] ** 2)]} if kind == "objective" else {}
    p = Problem({"k": 9.0}, [Free("k")], [record], **more)
    fit = solve(p, starts=5, seconds=1e-9)
    assert "The limit of 1e-09 s cut the search." in fit.message
    assert fit.cost <= p.cost(np.array([9.0]))
    assert "cut the search" not in solve(p, seconds=1e3).message
    late = solve(p, starts=5, seconds=1e3, began=time.perf_counter() - 2e3)
    assert "The limit of 1000 s cut the search." in late.message
    with pytest.raises(InputError, match="a time above 0"):
        solve(p, seconds=0.0)


def test_the_best_feasible_point_is_given_with_a_status_that_says_what_it_is():
    """A magnet whose limit forbids the target: the nearest point, at its limit."""
    record = Record("target", lambda m, _: m["I"][None] ** 2, None, [9.0], 1e-3)
    fit = solve(Problem({"I": 0.5}, [Free("I", 0.0, 2.0)], [record]), starts=8, seed=1)
    assert fit.theta[0] == 2.0
    assert fit.status != "converged"
    one = solve(Problem({"I": 0.5}, [Free("I", 0.0, 20.0)], [record]), iterations=1)
    assert one.cost < float(one.problem.cost(np.array([0.5])))
    assert one.status == "not_converged"


MANY = """
import resource, sys
import jax.numpy as jnp, numpy as np
from beamfit.greybox.problem import Free, Problem, Record
from beamfit.greybox.solve import solve

def curve(m, x):
    return m[0] * jnp.exp(-m[1] * x) + m[2] + m[3] * x + m[4] * x**2

def fit(n):
    x = np.linspace(0, 1, n)
    y = 2 * np.exp(-3 * x) + 1 + 0.5 * x - 0.2 * x**2
    y += 0.1 * np.random.default_rng(0).normal(size=n)
    start = jnp.array([1.0, 1.0, 0, 0, 0])
    return solve(Problem(start, [Free("")], [Record("r", curve, x, y, 0.1)]))

fit(100)
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
found = fit(100_000)
print(found.status, (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024)
"""


def test_a_hundred_thousand_residuals_take_little_memory():
    run = subprocess.run([sys.executable, "-c", MANY], capture_output=True, text=True, check=True)
    status, megabytes = run.stdout.split()
    assert status == "converged"
    assert float(megabytes) < 200


def test_a_formula_that_loses_its_figures_at_a_bound_does_not_end_there():
    """b/(1 - exp(-b t)) is rounding at b = 1e-18: chi2 there was 4000 times that of the optimum."""
    t, truth = 1000.0 * jnp.arange(21), np.array([100.0, 1e-7, 2e-5])

    def decay(p, t):
        return p[0] * p[2] * jnp.exp(-p[2] * t) / (p[2] + p[1] * p[0] * (1 - jnp.exp(-p[2] * t)))

    y = decay(truth, t) + 0.02 * np.random.default_rng(1).normal(size=21)
    free = [Free("", np.zeros(3), np.array([500.0, 1.0, 1.0]))]
    fit = solve(Problem(jnp.array([100.0, 1e-6, 1e-6]), free, [Record("decay", decay, t, y)]))
    assert fit.status == "converged", fit.message
    np.testing.assert_allclose(fit.theta, truth, rtol=0.02)
