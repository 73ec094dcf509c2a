"""`sample` of every kind of fit: problems, scans, decays."""

from __future__ import annotations

import sys
import types
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import beamfit
from beamfit.emittance.posterior import beam_target, expected_sizes
from beamfit.errors import InputError, Status
from beamfit.greybox.posterior import Statement, target_of
from beamfit.greybox.problem import Constraint, Free, Prior, Problem, Record
from beamfit.greybox.solve import solve
from beamfit.lifetime.decay_law import current
from beamfit.lifetime.fit import fit_decay
from beamfit.lifetime.posterior import expected_current
from beamfit.lifetime.record import DecayRecord
from beamfit.sampling.priors import Normal, Uniform

X = np.linspace(0.0, 1.0, 12)
Y = 1.0 + 2.0 * X + 0.1 * np.random.default_rng(1).normal(size=12)


def line(model, x):
    return model["slope"] * x + model["offset"]


def only_the_sum(model, x):
    return (model["slope"] + model["offset"]) * x


def the_sum(model, data):
    return model["slope"] + model["offset"]


def linear(free=None, predict=line, error=0.1, **more):
    free = free or [Free("slope"), Free("offset")]
    record = Record("scan", predict, X, Y, error=error)
    return Problem({"slope": 1.0, "offset": 0.0}, free, [record], **more)


def test_a_linear_problem_has_the_fits_own_normal_posterior():
    fit = solve(linear())
    found = fit.sample(seed=1, noise="known", target_ess=20_000)
    sd = np.sqrt(np.diag(fit.covariance_raw))
    np.testing.assert_allclose(found.draws.mean(0), fit.theta, atol=0.03 * sd.min())
    np.testing.assert_allclose(found.draws.std(0), sd, rtol=0.03)
    expected = fit.covariance_raw[0, 1] / sd[0] / sd[1]
    assert found.correlations().values[0, 1] == pytest.approx(expected, abs=0.02)
    derived = found.derive(lambda model: model["slope"] + model["offset"])
    assert derived.std() == pytest.approx(float(fit.derive(the_sum).error_raw), rel=0.05)


def test_a_constraint_is_kept_and_cuts_the_normal_distribution():
    """slope + offset <= limit: its posterior is a normal distribution cut there."""
    free = solve(linear())
    limit = float(free.theta.sum()) - 0.05
    fit = solve(linear(constraints=[Constraint("sum", the_sum, upper=limit)]))
    found = fit.sample(seed=1, noise="known", target_ess=8000)
    total = found.values("slope") + found.values("offset")
    assert total.max() <= limit
    sd = float(np.sqrt(free.covariance_raw.sum()))
    exact = stats.truncnorm(-np.inf, (limit - free.theta.sum()) / sd, free.theta.sum(), sd)
    assert total.mean() == pytest.approx(exact.mean(), abs=0.05 * exact.std())
    assert total.std() == pytest.approx(exact.std(), rel=0.05)


def test_an_equation_cannot_be_sampled():
    fit = solve(linear(constraints=[Constraint("sum", the_sum, lower=3.0, upper=3.0)]))
    with pytest.raises(InputError, match="the equation 'sum'"):
        fit.sample()


def test_a_direction_that_nothing_holds_is_named():
    found = solve(linear(predict=only_the_sum)).sample()
    assert found.status is Status.unidentified
    assert "do not determine slope, offset" in found.message
    assert found.chain.size == 0


def test_a_direction_that_bounds_hold_is_sampled_and_named():
    free = [Free("slope", -5, 5), Free("offset", -5, 5)]
    found = solve(linear(free, only_the_sum)).sample(seed=1, noise="known")
    assert found.status is Status.unidentified
    assert found.held == ("slope", "offset")
    assert "the prior's or the bounds', not the data's" in found.message
    total = found.values("slope") + found.values("offset")
    assert total.std() < 0.06  # what the data do see


def test_a_prior_makes_an_open_direction_proper():
    fit = solve(linear(predict=only_the_sum))
    priors = {"offset": Normal(1.0, 0.01), "slope": Uniform(-10.0, 10.0)}
    found = fit.sample(seed=1, noise="known", priors=priors)
    assert found.chain.size
    assert found.values("offset").std() == pytest.approx(0.01, rel=0.05)
    with pytest.raises(InputError, match="did you mean offset"):
        fit.sample(priors={"ofset": Normal(0.0, 1.0)})
    with pytest.raises(InputError, match="a prior of type float"):
        fit.sample(priors={"offset": 1.0})


def test_the_problems_own_priors_count_once():
    fit = solve(linear(priors=[Prior("slope", 2.0, 0.001)]))
    found = fit.sample(seed=1, noise="known", target_ess=8000)
    assert found.values("slope").std() == pytest.approx(0.001, rel=0.05)
    # A common noise factor is the records' and does not widen the prior.
    inferred = fit.sample(seed=1, noise="inferred", target_ess=8000)
    assert inferred.values("slope").std() == pytest.approx(0.001, rel=0.05)


def test_fixed_numbers_do_not_move():
    fit = solve(linear([Free("slope"), Free("offset", 1.0, 1.0)]))
    names = fit.sample(seed=1, target_ess=200).names
    assert names[0] == "slope"
    assert "offset" not in names


def test_without_errors_the_noise_is_inferred():
    found = solve(linear(error=None)).sample(seed=1)
    assert "error_factor" in found.shown
    assert found["error_factor"].value == pytest.approx(0.065, rel=0.3)


def exponential(model, x):
    return np.ones(12) * jnp.exp(model["log"])


def to_level(model):
    return {"log": jnp.exp(model["log"])}


def to_log(model):
    return {"log": jnp.log(model["log"])}


def test_a_change_of_variables_is_flat_in_what_is_sampled():
    """A level fitted by its logarithm and sampled as itself: a normal distribution, cut at zero."""
    record = Record("scan", exponential, X, Y, error=0.1)
    fit = solve(Problem({"log": 0.5}, [Free("log")], [record]))
    stated = Statement(quoted=to_level, own=to_log, renamed={"log": "level"}, lower={"level": 0.0})
    target = target_of(fit.problem, fit.optimum, stated, noise="known")
    assert target.names == ("level",)
    assert target.mode[0] == pytest.approx(Y.mean())
    assert target.covariance[0, 0] == pytest.approx(0.01 / 12 * fit.group("scan").scale ** 2)
    at = Y.mean() + np.array([0.0, 0.05, -0.1])
    value = target.log_probability(at[:, None])
    exact = stats.norm(Y.mean(), 0.1 / np.sqrt(12)).logpdf(at)
    np.testing.assert_allclose(value - value[0], exact - exact[0], rtol=1e-9)
    assert target.log_probability(np.array([[-1.0]]))[0] == -np.inf


def test_records_have_noises_of_their_own_and_anchors_none():
    one = Record("one", line, X, Y, error=0.1)
    two = Record("two", line, X, 1.01 * Y, error=0.01)
    fit = solve(Problem({"slope": 1.0, "offset": 0.0}, [Free("slope"), Free("offset")], [one, two]))
    groups = target_of(fit.problem, fit.optimum, noise="inferred").groups
    assert [group.prefix for group in groups] == ["one.", "two."]
    stated = Statement(labels={"one": "x"}, trusted=["two"])
    groups = target_of(fit.problem, fit.optimum, stated, noise="inferred", outliers=True).groups
    stated = [("x", "inferred", True), ("two", "known", False)]
    assert [(group.label, group.noise, group.outliers) for group in groups] == stated


def test_known_transport_is_a_calibration_that_is_known():
    """The same density of σ, whichever scenario states it."""
    scan = beamfit.read_quad_scan("measurements/gtf_simulated.csv")
    line = beamfit.load_lattice("lattices/gtf.toml")
    known = beam_target(beamfit.fit_emittance(scan, line))
    magnet = line["Q2"].calibration
    values = {f"Q2.{name}": float(getattr(magnet, name)) for name in ("slope", "intercept")}
    priors = {name: (value, 1e-6 * abs(value)) for name, value in values.items()}
    told = beamfit.fit_emittance(scan, line, scenario="calibration", priors=priors)
    free = beam_target(told)
    assert set(free.names) == {*known.names, *values}
    spread = np.sqrt(np.diag(known.covariance))
    draws = known.mode + spread * np.random.default_rng(1).normal(size=(6, 3))
    at = np.empty((6, len(free.names)))
    for i, name in enumerate(free.names):
        at[:, i] = values[name] if name in values else draws[:, known.names.index(name)]
    one, other = known.log_probability(draws), free.log_probability(at)
    assert np.isfinite(one).sum() >= 3
    np.testing.assert_array_equal(np.isfinite(one), np.isfinite(other))
    inside = np.isfinite(one)
    np.testing.assert_allclose(np.diff(one[inside]), np.diff(other[inside]), rtol=1e-6)


@pytest.fixture(scope="module")
def otr2():
    scan = beamfit.read_quad_scan("measurements/lcls_otr2.csv")
    return beamfit.fit_emittance(scan, beamfit.load_lattice("lattices/lcls_otr2.toml"))


@pytest.fixture(scope="module")
def beam(otr2):
    return otr2.sample(seed=1)


def test_a_real_scan(otr2, beam):
    """One posterior: medians, errors and 95 % are those that the fit quotes."""
    assert beam.status is Status.converged
    for plane in "xy":
        fit = otr2[plane].normalized_emittance
        found = beam.interval(f"{plane}.normalized_emittance")
        assert found.median == pytest.approx(fit.value, abs=0.4 * fit.error)
        half, (low, high) = 0.5 * (found.upper - found.lower), fit.interval_95
        ends = beam.quantiles(f"{plane}.normalized_emittance", (0.025, 0.975))
        if "to which the interval reaches" in otr2[plane].message:
            # The one point that y rests on: the fit says so, and quotes more than the draws show.
            assert fit.error > half
            assert low <= ends[0] + 0.2 * half
            assert high >= ends[1] - 0.2 * half
        else:
            assert half == pytest.approx(fit.error, rel=0.12)
            np.testing.assert_allclose(ends, (low, high), atol=0.3 * fit.error)
    sigma = beam.draws
    assert (sigma[:, 0] * sigma[:, 2] > sigma[:, 1] ** 2).all()
    emittance = np.sqrt(sigma[:, 0] * sigma[:, 2] - sigma[:, 1] ** 2)
    np.testing.assert_allclose(beam.values("x.emittance"), emittance, rtol=1e-9)
    sizes = beam.derive(lambda beams: beams["y"].l11)
    assert sizes.mean() == pytest.approx(np.sqrt(otr2.y.sigma[0].value), rel=0.02)


def test_sure_errors_give_the_errors_as_stated():
    """Priors that leave stated errors no doubt: the width is that of linear theory."""
    scan = beamfit.read_quad_scan("measurements/gtf_simulated.csv")
    line = beamfit.load_lattice("lattices/gtf.toml")
    fit = beamfit.fit_emittance(scan, line, noise=beamfit.Noise(right=1 - 1e-9, bad=1e-12))
    found = fit.sample(("x",), seed=1, target_ess=8000)
    assert found.status is Status.converged
    raw = fit.x.normalized_emittance.error_raw
    assert fit.x.normalized_emittance.error == pytest.approx(raw, rel=0.05)
    assert found["x.normalized_emittance"].error == pytest.approx(raw, rel=0.05)
    assert found.names == ("x.sigma11", "x.sigma12", "x.sigma22")


def test_a_scan_that_determines_nothing_is_not_sampled():
    line = beamfit.Beamline(
        (beamfit.Quadrupole("Q", 0.1), beamfit.Drift("D", 2.0), beamfit.Screen("S")), 135.0
    )
    k1 = np.full(6, 3.0) + 1e-9 * np.arange(6)
    noise = 1 + 0.3 * np.random.default_rng(1).normal(size=6)  # the box is no thin sheet
    scan = beamfit.QuadScan({"Q": k1}, {"Q": "k1"}, {"x": 1e-4 * noise}, {"x": np.full(6, 3e-5)})
    fit = beamfit.fit_emittance(scan, line)
    found = fit.sample()
    assert found.status is Status.unidentified
    assert "does not determine sigma11, sigma12 and sigma22" in found.message
    assert all(q["interval_68"] is None for q in found.to_json()["quantities"])
    box = {
        "x.sigma11": Uniform(0.5e-8, 4e-8),
        "x.sigma12": Uniform(-2e-8, 3e-8),
        "x.sigma22": Uniform(0.3e-8, 2e-8),
    }
    boxed = fit.sample(priors=box, seed=1, target_ess=100)
    assert boxed.chain.size
    assert boxed.status is Status.unidentified
    assert "x.emittance" in boxed.held


def test_expected_sizes_hold_the_points(otr2, beam):
    p = otr2.y.points
    found = expected_sizes(beam, "y")
    low, high = found.reading
    assert ((p.size > low) & (p.size < high)).all()
    assert (found.model[0] > low).all()
    np.testing.assert_allclose(found.median, p.model, rtol=0.02)
    np.testing.assert_array_equal(expected_sizes(beam, "y").median, found.median)


def decay(a, b, span, number=200, sd=0.01, seed=3):
    t = np.linspace(0.0, span, number)
    noise = sd * np.random.default_rng(seed).normal(size=number)
    return DecayRecord(t, np.array(current(t, 500.0, a, b)) + noise, np.full(number, sd))


def test_a_decay_at_the_bound_of_b():
    """Pure Touschek: b's posterior is a normal distribution cut at zero."""
    fit = fit_decay(decay(2e-8, 0.0, 2 * 3600.0), law="constant")
    found = fit.sample(seed=1, target_ess=8000)
    b = found.values("b")
    assert b.min() >= 0
    exact = stats.truncnorm(-fit.b.value / fit.b.error_raw, np.inf, fit.b.value, fit.b.error_raw)
    assert b.mean() == pytest.approx(exact.mean(), rel=0.05)
    assert b.std() == pytest.approx(exact.std(), rel=0.06)


def test_a_and_b_not_separable_are_the_bounds_and_the_lifetime_is_not():
    fit = fit_decay(decay(2e-8, 1e-6, 120.0), law="constant")
    found = fit.sample(seed=1, target_ess=8000)
    assert found.status is Status.unidentified
    assert set(found.held) == {"a", "b"}
    lifetime = found["lifetime_mean"]
    assert lifetime.error == pytest.approx(fit.lifetime_mean.error_raw, rel=0.08)
    rows = {q["name"]: q for q in found.to_json()["quantities"]}
    assert rows["a"]["interval_95"] is None
    assert rows["a"]["error"] is None
    assert rows["lifetime_mean"]["interval_95"] is not None


@pytest.mark.parametrize("law", ["free", "constant"])
def test_the_real_decay(law):
    """One posterior: medians, errors and intervals are those that the fit quotes."""
    record = beamfit.read_decay_record("measurements/aps_1999_decay.csv")
    fit = fit_decay(record, law=law)
    found = fit.sample(seed=1)
    assert found.status is Status.converged
    assert ("exponent" in found.names) == (law == "free")
    for name in ("a", "lifetime_mean", "lifetime_start"):
        quantity = getattr(fit, name)
        assert found[name].error == pytest.approx(quantity.error, rel=0.1)
        ends = found[name].interval_95  # of a with one end where b may be zero
        np.testing.assert_allclose(ends, quantity.interval_95, atol=0.3 * quantity.error)
        if law == "constant":
            assert found[name].value == pytest.approx(quantity.value, abs=0.15 * quantity.error)
    expected = expected_current(found, fit)
    low, high = expected.reading
    inside = np.mean((fit.readings.current > low) & (fit.readings.current < high))
    assert inside > 0.85


def test_a_prior_on_a_tells_b_from_it():
    fit = fit_decay(decay(2e-8, 1e-6, 600.0), law="constant")
    assert fit.a.error is None
    found = fit.sample(seed=1, priors={"a": Normal(2e-8, 1e-9)}, target_ess=1000)
    assert found.held == ("a",)  # which is the prior's; b follows from the loss rate
    rate = 1 / (3600 * fit.lifetime_mean.value)
    assert found["b"].value == pytest.approx(rate - 2e-8 * fit.mean_current, abs=1e-7)
    assert found["b"].error == pytest.approx(1e-9 * fit.mean_current, rel=0.1)


def test_readings_that_show_nothing():
    found = fit_decay(DecayRecord([0, 60, 120, 180, 240], [100.0] * 5)).sample()
    assert found.status is Status.unidentified
    assert "neither decay nor noise" in found.message


def test_a_shape_of_a_is_not_sampled():
    fit = replace(fit_decay(decay(2e-8, 1e-6, 7200.0)), shaped=True)
    with pytest.raises(InputError, match="a shape of a"):
        fit.sample()


def test_arviz_is_asked_for_by_name(beam, monkeypatch):
    monkeypatch.setitem(sys.modules, "arviz", None)
    with pytest.raises(InputError, match="pip install arviz"):
        beam.to_arviz()


@pytest.mark.parametrize("version", ["0.23.4", "1.2.0"])
def test_arviz_gets_walkers_as_chains(beam, monkeypatch, version):
    """Both forms of its from_dict: groups as arguments, and as one mapping from 1.0 on."""
    given = {}

    def from_dict(*groups, **named):
        given.update(groups[0] if groups else named)
        return len(groups)

    module = types.SimpleNamespace(__version__=version, from_dict=from_dict)
    monkeypatch.setitem(sys.modules, "arviz", module)
    assert beam.to_arviz() == (1 if version[0] == "1" else 0)
    steps, walkers, _ = beam.chain.shape
    assert set(given) == {"posterior", "sample_stats", "observed_data"}
    assert given["posterior"]["x.emittance"].shape == (walkers, steps)
    np.testing.assert_array_equal(given["posterior"]["x.sigma11"], beam.chain[:, :, 0].T)
    assert given["sample_stats"]["lp"].shape == (walkers, steps)


@pytest.mark.parametrize(
    ("course", "status", "lifetime"),
    [
        (
            lambda t: 600 * (1 - np.exp(-t / 2000)) + 45 * (1 - np.cos(t / 900)),
            "unidentified",
            47.57,
        ),
        (lambda t: 3 * np.clip(t - 9000, 0, 6000), "poor_fit", None),
    ],
)
def test_a_decay_that_no_law_follows_is_sampled_all_the_same(course, status, lifetime):
    """SIMULATED: a vacuum that rises and falls, or is worse for a while, leaves no white noise
    likely, and none is drawn.
    """
    time = np.linspace(0.0, 8 * 3600.0, 300)
    left = np.exp(-4.9e-6 * (time + course(time)))
    beam = 100 * left / (1 + 1e-6 * np.cumsum(left) * time[1])
    noise = 0.01 * np.random.default_rng(1).normal(size=time.size)
    fit = beamfit.fit_decay(beamfit.DecayRecord(time, beam + noise))
    assert fit.status == status
    assert fit.sample(seed=1).status == "unidentified"
    if lifetime is not None:  # of the rates at the mean current, h
        low, high = fit.lifetime_mean.interval_95
        assert low <= lifetime <= high
