"""Records with noise of their own, padding, and quantities asked of a fit: against closed forms."""

import jax.numpy as jnp
import numpy as np
import pytest

from beamfit.arrays import padded_length
from beamfit.errors import InputError
from beamfit.greybox import fit as fits
from beamfit.greybox.posterior import target_of
from beamfit.greybox.problem import Free, Prior, Problem, Record
from beamfit.greybox.solve import solve

X = np.linspace(-1.0, 1.0, 21)


def line(model, x):
    return model["slope"] * x + model["offset"]


def other(model, x):
    return model["other"] * x


def product(model, data):
    return data * model["slope"] * model["offset"]


def noisy(seed, scale, x=X):
    return 2.0 * x + 0.5 + scale * np.random.default_rng(seed).normal(size=len(x))


def two_records():
    model = {"slope": 1.0, "offset": 0.0, "other": 1.0}
    given = Record("given", line, X, noisy(1, 0.3), 0.1)
    silent = Record("silent", other, X[:9], 3 * X[:9] + noisy(2, 0.02, 0 * X[:9]) - 0.5)
    return Problem(model, [Free("")], [given, silent])


def test_each_record_has_noise_of_its_own():
    fit = solve(two_records())
    given, silent = fit.groups
    assert (given.name, given.count, given.errors_given) == ("given", 21, True)
    assert (given.dof, silent.dof) == (19.0, 8.0)
    assert silent.rows == slice(21, 30)
    one = np.stack([X, np.ones(21)], 1)
    measured = np.asarray(fit.problem.records[0].measured)
    rest = measured - one @ np.linalg.lstsq(one, measured, rcond=None)[0]
    assert given.chi2 == pytest.approx(rest @ rest / 0.01)
    assert given.scale == pytest.approx(np.sqrt(given.chi2 / 19))
    assert given.scale > 1.5
    # Neither record's scatter touches the errors of the other's numbers.
    covariance = np.linalg.inv(one.T @ one) * 0.01
    assert fit["slope"].error_raw == pytest.approx(np.sqrt(covariance[0, 0]))
    assert fit["slope"].error == pytest.approx(given.scale * np.sqrt(covariance[0, 0]))
    expected = silent.scale / np.linalg.norm(X[:9])
    assert fit["other"].error == pytest.approx(expected)
    assert fit["other"].error_raw == pytest.approx(expected)
    assert fit.status == "poor_fit"  # the silent record cannot hide what the other says
    assert fit.group("silent") is silent
    with pytest.raises(InputError, match="did you mean silent"):
        fit.group("silnt")


def test_a_prior_is_a_row_that_no_scatter_enlarges():
    """Closed form: the information of the record at its scale plus 1/sd²."""
    record = Record("r", other, X, 3 * X + noisy(4, 0.5, 0 * X) - 0.5, 0.1)
    free, prior = [Free("other", 0.0, 10.0)], [Prior("other", 3.0, 0.05)]
    fit = solve(Problem({"other": 1.0}, free, [record], prior))
    group = fit.group("r")
    information = (X @ X) / 0.01
    # The hat matrix of a record beside a prior has the trace of its share of the information.
    assert group.dof == pytest.approx(21 - information / (information + 1 / 0.05**2), abs=1e-8)
    expected = 1 / np.sqrt(information / group.scale**2 + 1 / 0.05**2)
    assert fit["other"].error == pytest.approx(expected, rel=1e-9)
    assert fit["other"].error_raw == pytest.approx(1 / np.sqrt(information + 400), rel=1e-9)


@pytest.mark.parametrize("error", [0.1, None], ids=["errors", "no errors"])
def test_padding_counts_nowhere(error):
    x, y = X[:11], noisy(3, 0.1, X[:11])
    n = padded_length(len(x))
    fill = np.zeros(n - len(x))
    weight = np.concatenate([np.ones(len(x)), fill])
    padded = Record("r", line, np.append(x, fill), np.append(y, fill + 99.0), error, weight)
    model, free = {"slope": 0.0, "offset": 0.0}, [Free("")]
    plain = solve(Problem(model, free, [Record("r", line, x, y, error)]))
    fit = solve(Problem(model, free, [padded]))
    np.testing.assert_allclose(fit.theta, plain.theta, rtol=1e-12)
    np.testing.assert_allclose(fit.covariance, plain.covariance, rtol=1e-9)
    assert (fit.dof, fit.chi2) == (9, pytest.approx(plain.chi2))
    assert fit.group("r")[3:6] == pytest.approx(plain.group("r")[3:6])
    assert fit.status == plain.status
    told = {"noise": "inferred", "outliers": True}
    targets = [target_of(f.problem, f.optimum, **told) for f in (fit, plain)]
    points = targets[0].mode + 0.01 * np.random.default_rng(1).normal(size=(5, 4))
    values = [target.log_probability(points) for target in targets]
    np.testing.assert_allclose(values[0], values[1], rtol=1e-9)


def test_a_derived_number_of_any_shape_has_error_share_and_slope():
    fit = solve(two_records())
    weights = np.array([[1.0, 2.0], [3.0, 4.0]])
    found = fit.derive(product, weights)
    slope, offset = fit["slope"].value, fit["offset"].value
    assert found.slope.shape == (2, 2, 3)
    np.testing.assert_allclose(found.value, weights * slope * offset)
    gradient = np.zeros(3)
    gradient[fit.problem.names.index("slope")] = offset
    gradient[fit.problem.names.index("offset")] = slope
    one = np.sqrt(gradient @ fit.covariance @ gradient)
    np.testing.assert_allclose(found.error, weights * one, rtol=1e-9)
    np.testing.assert_allclose(found.error_raw, found.error / fit.group("given").scale, rtol=1e-9)
    np.testing.assert_array_equal(found.share, 0.0)


def test_what_bounds_carry_has_no_error():
    record = Record("r", line, X, noisy(1, 0.1), 0.1)
    model = {"slope": 1.0, "offset": 0.0, "loose": 0.5}
    fit = solve(Problem(model, [Free("slope"), Free("offset"), Free("loose", 0, 1)], [record]))
    found = fit.derive(lambda m, _: jnp.stack([m["loose"], m["slope"]]))
    np.testing.assert_allclose(found.share, [1.0, 0.0], atol=1e-9)
    assert np.isnan(found.error[0])
    assert np.isfinite(found.error[1])


def test_a_function_is_compiled_once_for_each_structure():
    fits._with_slope.clear_cache()
    for seed in (1, 2, 3):
        record = Record("r", line, X, noisy(seed, 0.1), 0.1)
        fit = solve(Problem({"slope": 1.0, "offset": 0.0}, [Free("")], [record]))
        fit.derive(product, 1.0)
    assert fits._with_slope._cache_size() == 1


def test_without_errors_and_freedom_nothing_is_said_of_errors():
    record = Record("r", line, X[:2], noisy(1, 0.1)[:2])
    fit = solve(Problem({"slope": 1.0, "offset": 0.0}, [Free("")], [record]))
    assert np.isnan(fit["slope"].error)
    assert np.isnan(fit.derive(product, 1.0).error)
    assert np.isnan(fit.groups[0].scale)
