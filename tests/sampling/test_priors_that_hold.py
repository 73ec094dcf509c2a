"""Priors that identify what data leave open, or lie beside the optimum, and what is refused."""

import json

import numpy as np
import pytest
import scipy.stats as st

from beamfit.errors import InputError
from beamfit.greybox.problem import Free, Problem, Record
from beamfit.greybox.solve import solve
from beamfit.sampling.priors import Normal, Uniform, checked

Y = 3.0 + 0.1 * np.random.default_rng(1).normal(size=8)


def total(model, x):
    return (model["a"] + model["b"]) * np.ones(8)


def level(model, x):
    return model["a"] * np.ones(8)


def sum_fit():
    record = Record("r", total, None, Y, 0.1)
    return solve(Problem({"a": 1.0, "b": 2.0}, [Free("a"), Free("b")], [record]))


def test_a_prior_on_one_number_of_a_sum_gives_the_other():
    """Exact: b = mean(y) - a, variances added."""
    found = sum_fit().sample(seed=1, priors={"a": Normal(1.0, 0.5)}, target_ess=2000)
    assert "b" not in found.held
    assert found["b"].value == pytest.approx(Y.mean() - 1.0, abs=0.05)
    assert found["b"].error == pytest.approx(np.hypot(0.5, 0.1 / np.sqrt(8)), rel=0.06)


def test_without_it_the_sum_is_not_sampled_and_json_has_no_nan():
    found = sum_fit().sample(seed=1)
    assert found.status == "unidentified"
    assert not found.chain.size
    json.dumps(found.to_json(), allow_nan=False)


@pytest.mark.parametrize(
    "prior", [st.truncnorm(-1, 1, loc=2.2, scale=0.1), Uniform(2.0, 2.2)], ids=["normal", "flat"]
)
def test_a_prior_that_leaves_out_the_optimum(prior):
    """Against quadrature: y asks for 3.04 with an error of 0.35, the prior allows 2 to 2.3."""
    y = np.linspace(2.0, 4.07, 8)
    record = Record("r", level, None, y, 1.0)
    fit = solve(Problem({"a": 1.0}, [Free("a", 0.0, 10.0)], [record]))
    found = fit.sample(seed=1, priors={"a": prior}, target_ess=4000)
    low, high = prior.support()
    x = np.linspace(low + 1e-9, high - 1e-9, 4001)
    weight = np.exp(prior.logpdf(x) - 4.0 * (x - y.mean()) ** 2)
    mean = np.sum(weight * x) / weight.sum()
    sd = np.sqrt(np.sum(weight * (x - mean) ** 2) / weight.sum())
    draws = found.values("a")
    assert np.mean(draws) == pytest.approx(mean, abs=0.06 * sd)
    assert np.std(draws) == pytest.approx(sd, rel=0.05)


def test_what_is_no_prior_is_refused():
    with pytest.raises(InputError, match="frozen"):
        checked({"a": st.norm}, ["a"])
    with pytest.raises(InputError, match="centre"):
        Normal(np.nan, 1.0)
    with pytest.raises(InputError, match="seed -1"):
        sum_fit().sample(seed=-1, priors={"a": Normal(1.0, 0.5)})


def square(model, x):
    return model["x"] ** 2 * np.ones(8)


def test_another_optimum_is_spoken_of():
    record = Record("r", square, None, np.ones(8), 0.1)
    fit = solve(Problem({"x": 1.0}, [Free("x", -3.0, 3.0)], [record]), starts=8, seed=1)
    assert "another optimum" in fit.sample(seed=1, target_ess=500).message
