"""The sampler against posteriors known exactly, and what it says of those it cannot sample."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from beamfit.errors import InputError, Status
from beamfit.sampling.ensemble import draw, first_walkers
from beamfit.sampling.priors import HalfNormal, LogNormal, Normal, Uniform
from tests.sampling.targets import (
    BANANA,
    PEAKS,
    banana,
    bimodal,
    gaussian,
    half_normal,
    target,
)


def near(posterior, name, mean, sd):
    """Mean and sd within four standard errors of the draws' own."""
    i = posterior.names.index(name)
    values, effective = posterior.values(name), posterior.diagnostics.effective[i]
    error = sd / np.sqrt(effective)
    assert abs(values.mean() - mean) < 4 * error
    excess = float(np.mean((values - mean) ** 4)) / sd**4
    assert abs(values.std() / sd - 1) < 4 * 0.5 * np.sqrt((excess - 1) / effective)


def test_banana():
    found = draw(target(banana), seed=1, target_ess=1500)
    assert found.status is Status.converged
    mean, sd, about = BANANA
    near(found, "x", mean, sd)
    # y = x² + noise: mean m² + s², variance 4 m² s² + 2 s⁴ + about².
    near(found, "y", mean**2 + sd**2, np.sqrt(4 * mean**2 * sd**2 + 2 * sd**4 + about**2))


def test_half_normal_against_a_bound():
    found = draw(target(half_normal, lower=np.array([0.0, -np.inf])), seed=2, target_ess=8000)
    near(found, "x", np.sqrt(2 / np.pi), np.sqrt(1 - 2 / np.pi))
    near(found, "y", 0.0, 1.0)
    assert found.values("x").min() >= 0
    assert stats.kstest(found.thinned(1000)[:, 0], stats.halfnorm.cdf).pvalue > 1e-3


def test_two_peaks():
    first, second, sd, weight = PEAKS
    found = draw(target(bimodal), seed=3, target_ess=8000)
    mean = weight * first + (1 - weight) * second
    spread = np.sqrt(sd**2 + weight * (1 - weight) * (second - first) ** 2)
    near(found, "x", mean, spread)
    near(found, "y", 0.0, 1.0)


def test_correlated_numbers_of_very_different_size():
    scale = np.array([1e2, 1e-8, 1e-6])
    root = np.array([[1.0, 0, 0], [0.9999, 0.0142, 0], [-0.5, 0.5, 0.7]]) * scale[:, None]
    covariance = root @ root.T
    inner = covariance / scale / scale[:, None]
    data = {
        "mean": np.array([5e2, 3e-8, 0.0]),
        "precision": np.linalg.inv(inner) / scale / scale[:, None],
    }
    stated = target(gaussian, n=3, data=data, mode=data["mean"], covariance=covariance)
    found = draw(stated, seed=4, target_ess=8000)
    assert found.diagnostics.autocorrelation.max() < 3
    for name, mean, sd in zip("xyz", data["mean"], np.sqrt(np.diag(covariance)), strict=True):
        near(found, name, mean, sd)
    expected = covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1])
    assert found.correlations(("x", "y")).values[0, 1] == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize(
    ("prior", "known"),
    [
        (Normal(0.5, 0.7), stats.norm(0.5, 0.7)),
        (LogNormal(1.5, 0.4), stats.lognorm(0.4, scale=1.5)),
        (Uniform(-0.5, 2.0), stats.uniform(-0.5, 2.5)),
        (HalfNormal(0.8), stats.halfnorm(scale=0.8)),
        (stats.gamma(3.0, scale=0.5), stats.gamma(3.0, scale=0.5)),
        (stats.t(4, loc=1.0), stats.t(4, loc=1.0)),
    ],
)
def test_priors_multiply_the_likelihood(prior, known):
    """One number with a normal likelihood: moments by quadrature."""
    at = np.array([0.0, 1.0, 2.5])
    np.testing.assert_allclose(prior.logpdf(at), known.logpdf(at), rtol=1e-12)
    np.testing.assert_allclose([prior.mean(), prior.std()], [known.mean(), known.std()])
    data = {"mean": np.array([1.0]), "precision": np.array([[1.0]])}
    found = draw(target(gaussian, n=1, data=data, priors={"x": prior}), seed=5, target_ess=8000)
    grid = np.linspace(-12.0, 12.0, 200_001)
    weight = np.exp(known.logpdf(grid) - 0.5 * (grid - 1.0) ** 2)
    weight /= weight.sum()
    mean = weight @ grid
    near(found, "x", mean, np.sqrt(weight @ (grid - mean) ** 2))


def test_bounds_of_a_box_are_named_as_such():
    """y is seen by nothing but its box: its interval is the box's."""

    def flat_in_y(data, theta):
        return -0.5 * theta[0] ** 2

    found = draw(target(flat_in_y, lower=[-9, 0], upper=[9, 4]), seed=1, target_ess=2000)
    assert found.status is Status.unidentified
    assert found.held == ("y",)
    assert "y is the prior's or the bounds', not the data's" in found.message
    assert found.to_json()["quantities"][1]["interval_68"] is None
    assert found.to_json()["quantities"][0]["interval_68"] is not None
    assert found["y"].error is None
    assert not found.interval("y").separable
    assert "the prior's" in str(found)


def test_an_open_direction_is_named_and_not_sampled():
    found = draw(target(half_normal, open_directions="nothing holds x - y"), seed=1)
    assert found.status is Status.unidentified
    assert found.message == "Not sampled: nothing holds x - y."
    assert found.chain.size == 0
    assert all(q["interval_68"] is None for q in found.to_json()["quantities"])
    assert "not determined" in str(found)


def test_nothing_feasible_is_a_status():
    def nowhere(data, theta):
        return -jnp.inf

    assert draw(target(nowhere), seed=1).status is Status.infeasible


def test_walkers_start_inside_and_spread():
    def thin_wedge(data, theta):
        inside = (theta[0] >= 0) & (theta[1] >= theta[0]) & (theta[1] <= 1.02 * theta[0])
        return jnp.where(inside, -0.5 * jnp.sum(theta**2), -jnp.inf)

    stated = target(thin_wedge, mode=np.array([1.0, 1.01]))
    start = first_walkers(stated, 64, np.random.RandomState(1))
    assert np.isfinite(stated.log_probability(start)).all()
    assert np.linalg.matrix_rank(start - start.mean(axis=0)) == 2
    assert np.ptp(start[:, 0]) > 0.5


def test_budget_ends_and_is_named():
    found = draw(target(half_normal), seed=1, target_ess=1e6, budget=2000)
    assert found.status is Status.not_converged
    assert "budget of 2000 steps ended before 1000000 effective draws" in found.message
    short = draw(target(half_normal), seed=1, budget=100)
    assert short.status is Status.not_converged
    assert "did not settle" in short.message


def test_the_same_seed_gives_the_same_chain():
    one, two = (draw(target(half_normal), seed=7, target_ess=500) for _ in range(2))
    np.testing.assert_array_equal(one.chain, two.chain)
    other = draw(target(half_normal), seed=8, target_ess=500)
    assert not np.array_equal(one.chain, other.chain)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"walkers": 3}, "3 walkers for 2 numbers"),
        ({"walkers": 7}, "7 walkers"),
        ({"target_ess": 0}, "a target of 0"),
        ({"budget": 10}, "a budget of 10 steps"),
    ],
)
def test_options_that_make_no_sense(options, said):
    with pytest.raises(InputError, match=said):
        draw(target(half_normal), **options)


def test_a_posterior_is_frozen_and_prints():
    found = draw(target(half_normal), seed=1, target_ess=500)
    with pytest.raises(ValueError, match="read-only"):
        found.chain[0, 0, 0] = 1.0
    with pytest.raises(AttributeError):
        found.seed = 2
    assert found.status.value in str(found)
    assert "<table>" in found._repr_html_()
    with pytest.raises(InputError, match="did you mean x"):
        found.values("X")
    np.testing.assert_allclose(
        found.quantiles("x", (0.5,))[0], np.median(found.draws[:, 0]), rtol=1e-12
    )
    squares = found.derive(lambda theta: theta[0] ** 2, number=100)
    np.testing.assert_allclose(squares, found.thinned(100)[:, 0] ** 2)
    band = found.band(lambda theta: jnp.stack([theta[0], 2 * theta[0]]))
    assert band.lower[1] == pytest.approx(2 * band.lower[0])


def test_progress_goes_to_standard_error(capfd, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")  # as on a terminal
    monkeypatch.setenv("COLUMNS", "200")
    draw(target(half_normal), seed=1, target_ess=500, progress=True)
    out, err = capfd.readouterr()
    assert out == ""
    assert "% accepted" in err
    assert "effective draws" in err
