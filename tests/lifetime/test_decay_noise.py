"""Errors of a lifetime where the readings' errors have a memory. All records are simulated."""

import json
import re
from functools import partial

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import t

from beamfit.lifetime.evidence import Evidence
from beamfit.lifetime.expansion import Pieces, fit_law
from beamfit.lifetime.fit import fit_decay, fit_decays
from beamfit.lifetime.record import DecayRecord
from beamfit.lifetime.study import study_record
from beamfit.lifetime.tables import separability_rows
from tests.lifetime.conftest import values_of
from tests.simulations import simulations, widened

constant_fit = partial(fit_decay, law="constant")
constant_fits = partial(fit_decays, law="constant")
HOUR, SPAN = 3600.0, 8 * 3600.0
I0, A, B = 500.0, 4e-8, 2e-6


def law(time):
    return I0 * np.exp(-B * time) / (1 + A / B * I0 * -np.expm1(-B * time))


def autoregressive(rng, count, correlation):
    fresh = np.sqrt(1 - correlation**2) * rng.normal(size=count + int(20 / (1 - correlation)))
    return lfilter([1.0], [1.0, -correlation], fresh)[-count:]


def record(correlation, count=200, noise=0.02, seed=0, stated=None):
    time = np.linspace(0, SPAN, count)
    off = noise * autoregressive(np.random.default_rng(seed), count, correlation)
    return DecayRecord(time, law(time) + off, None if stated is None else np.full(count, stated))


@simulations(16, 60)
@pytest.mark.parametrize("correlation", [0.6, 0.95])
def test_correlated_noise_is_covered(correlation, count):
    fits = constant_fits([record(correlation, seed=seed) for seed in range(count)])
    assert all(fit.status == "converged" for fit in fits)
    beam = law(np.linspace(0, SPAN, 200))
    true = {"a": A, "b": B, "lifetime_mean": 1 / (A * beam.mean() + B) / HOUR}
    for name, value in true.items():
        found = [getattr(fit, name) for fit in fits]
        pulls = np.array([abs(q.value - value) / q.error for q in found])
        # Without the memory 15 to 68 % lie within two errors; 60 records know a share to 3 %.
        assert np.mean(pulls < 1.96) > 0.95 - widened(0.07, 60, count)
        assert np.mean(pulls < 1) < 0.68 + widened(0.2, 60, count)


def few_shots(rng, time):
    """Means of two or three readings, and their errors."""
    shots = law(time)[:, None] + 0.3 * rng.normal(size=(time.size, rng.integers(2, 4)))
    error = shots.std(axis=1, ddof=1) / np.sqrt(shots.shape[1])
    return shots.mean(axis=1), np.maximum(error, 1e-9)


def counted(rng, time):
    """Some thousand counts, and their roots."""
    unit = I0 / 10 ** rng.uniform(3, 4)
    counts = rng.poisson(law(time) / unit)
    return counts * unit, np.sqrt(counts) * unit


@simulations(12, 100)
@pytest.mark.parametrize("read", [few_shots, counted])
def test_errors_that_go_with_the_noise_of_their_reading_are_shared(read, count):
    """As weights they took the answer: half of the lifetimes held."""
    pulls, time = [], np.linspace(0, 10 * SPAN, 150)
    for seed in range(count):
        current, error = read(np.random.default_rng(seed), time)
        fit = fit_decay(DecayRecord(time, current, error))
        assert "differ by chance" in fit.readings.notes[0]
        true = 1 / (A * fit.mean_current + B) / HOUR
        pulls.append(abs(fit.lifetime_mean.value - true) / fit.lifetime_mean.error)
    assert np.mean(np.array(pulls) < 1.96) > 0.95 - widened(0.07, 100, count)
    assert max(pulls) < 4


def test_errors_that_differ_for_a_reason_stay():
    time, rng = np.linspace(0, SPAN, 60), np.random.default_rng(1)
    error = np.where(np.arange(60) % 2, 0.02, 0.2)
    own = DecayRecord(time, law(time) + error * rng.normal(size=60), error)
    assert np.array_equal(fit_decay(own).readings.error, error)


def test_independent_noise_gives_plain_least_squares():
    for seed in range(5):
        plain = record(0.0, seed=seed)
        fit, found = constant_fit(plain), fit_law(Pieces.of(plain))
        assert fit.a.value == found.values.a
        rows, slope = found.rows[:, :3], found.slopes[1, :3]
        size = (found.residuals @ found.residuals / 197) ** 0.5
        spread = size * np.sqrt(slope @ np.linalg.inv(rows.T @ rows) @ slope)
        # Half of the central 68 % of Student's distribution.
        assert fit.a.error_raw == pytest.approx(spread, rel=1e-6)
        assert fit.a.error == pytest.approx(spread * t.ppf(0.841344746, 197), rel=1e-6)
        assert fit.correlation_time is None
        assert fit.identifiability.error_inflation == 1


def test_the_correlation_time_is_that_of_the_noise_however_it_is_sampled():
    rng = np.random.default_rng(5)
    time = np.sort(rng.uniform(0, SPAN, 2000))
    kept = np.exp(-np.diff(time) / 300.0)
    noise = rng.normal(size=2000)
    for k in range(1, 2000):
        noise[k] = kept[k - 1] * noise[k - 1] + np.sqrt(1 - kept[k - 1] ** 2) * noise[k]
    fit = fit_decay(DecayRecord(time, law(time) + 0.02 * noise))
    assert fit.correlation_time == pytest.approx(300.0, rel=0.4)
    assert abs(fit.a.value - A) < 3 * fit.a.error


def test_a_random_walk_is_an_answer_too():
    walk = np.cumsum(np.random.default_rng(6).normal(size=400)) * 0.01
    time = np.linspace(0, SPAN, 400)
    fit = fit_decay(DecayRecord(time, law(time) + walk))
    assert np.isfinite([fit.a.error, fit.b.error, fit.i0.error]).all()
    assert abs(fit.lifetime_mean.value - 1 / (A * fit.mean_current + B) / HOUR) < (
        3 * fit.lifetime_mean.error
    )
    assert fit.identifiability.residual_correlation > 0.9


def test_the_message_says_so_and_json_carries_it():
    fit = fit_decay(record(0.9, seed=3))
    assert "which the errors contain" in fit.message
    assert fit.a.error > 2 * fit.a.error_raw
    document = json.loads(json.dumps(fit.to_json(), allow_nan=False))
    assert document["correlation_time"] == {
        "value": fit.correlation_time, "error": None, "unit": "s",
    }  # fmt: skip
    low, high = document["a"]["interval_95"]
    assert (high - low) / 2 >= 1.9 * fit.a.error


def test_how_much_the_memory_enlarges_is_only_said_of_what_is_determined():
    """Of a record without a decay it was the ratio of two shares of nothing: 5471 times."""
    time, noise = np.linspace(0, SPAN, 200), autoregressive(np.random.default_rng(0), 200, 0.6)
    flat = DecayRecord(time, I0 + 0.02 * noise)
    fit = fit_decay(flat)
    assert fit.identifiability.error_inflation is None
    assert "times those of independent" not in fit.message
    assert "which the errors contain." in fit.message
    rows = values_of(separability_rows(study_record(flat).decays))
    assert rows["errors enlarged for that"] == ["-"]
    # What a study weighs the record by: a mean of such readings is twice as uncertain.
    assert fit.inflation == pytest.approx(np.sqrt(1.6 / 0.4), rel=0.15)
    found = fit_decay(record(0.6, seed=1))
    assert found.identifiability.error_inflation == found.inflation > 1.5


def test_stated_errors_are_the_least():
    fit = fit_decay(record(0.9, seed=4, stated=0.1))
    assert fit.status == "converged"
    assert fit.chi2 / fit.dof < 0.2
    assert fit.a.error > 2 * fit.a.error_raw


def test_a_drift_that_moves_a_value_by_its_error_does_so():
    plain = record(0.0, seed=7)
    fit = constant_fit(plain)
    assert "stability is not stated" in fit.message
    evidence = Evidence(fit_law(Pieces.of(plain)), record=plain)
    drift = evidence.drift_of_one_error("b")
    assert f"{drift:.2g} mA" in fit.message
    drifted = DecayRecord(plain.time, plain.current + drift * plain.time / SPAN)
    moved = abs(constant_fit(drifted).b.value - fit.b.value)
    assert moved == pytest.approx(fit.b.error, rel=0.02)


def test_the_sampler_has_the_same_noise():
    fit = constant_fit(record(0.8, seed=9))
    posterior = fit.sample(seed=1)
    low, middle, high = np.percentile(posterior.values("a"), [15.9, 50, 84.1])
    assert (high - low) / 2 == pytest.approx(fit.a.error, rel=0.2)
    assert middle == pytest.approx(fit.a.value, abs=0.3 * fit.a.error)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_drift_under_white_noise_is_sampled_to_the_end(seed):
    """I0 spreads with the drift, which spreads with its memory."""
    time, rng = np.linspace(0, SPAN, 200), np.random.default_rng(seed)
    off = 0.02 * (autoregressive(rng, 200, 0.97) + rng.normal(size=200))
    fit = fit_decay(DecayRecord(time, law(time) + off))
    posterior = fit.sample(seed=1)
    assert posterior.status == "converged"
    assert max(posterior.diagnostics.autocorrelation) < 8


@simulations(8, 40)
def test_a_drift_under_white_noise_is_seldom_a_change_of_the_loss_rate(count):
    """White noise about a change must be far likelier than a drift: 8 of 40 were taken for one."""
    time, rng = np.linspace(0, SPAN, 200), np.random.default_rng(0)
    off = [autoregressive(rng, 200, 0.97) + rng.normal(size=200) for _ in range(count)]
    fits = fit_decays([DecayRecord(time, law(time) + 0.02 * part) for part in off])
    assert sum(fit.change is not None for fit in fits) <= count / 20
    halfway = time > SPAN / 2
    real = np.where(halfway, law(time) * np.exp(-6e-8 * (time - SPAN / 2)), law(time))
    found = [DecayRecord(time, real + 0.02 * rng.normal(size=200)) for _ in range(count // 4)]
    assert sum(fit.change is not None for fit in fit_decays(found)) >= 0.9 * (count // 4)


@simulations(5, 20)
def test_no_record_of_noise_says_more_than_that_its_loss_rate_is_zero(count):
    """Error of a slope: noise sqrt(12/n)/T. Rates below zero by chance made 1e5 h and more."""
    rng, rows, span = np.random.default_rng(3), 200, 2.0
    records = [
        DecayRecord(np.linspace(0, span, rows), 500 + 0.02 * rng.normal(size=rows))
        for _ in range(count)
    ]
    limit = span * 500 / (1.645 * 0.02 * np.sqrt(12 / rows)) / HOUR
    said = [re.search(r"above ([\d.e+]+) h at 95 %", f.message) for f in fit_decays(records)]
    assert len(said) == count
    assert max(float(found[1]) for found in said) < 1.3 * limit
