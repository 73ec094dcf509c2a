import json
from collections import Counter
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import t

from beamfit.errors import InputError
from beamfit.io.decay_record import read_decay_record
from beamfit.lifetime import alternatives
from beamfit.lifetime.decay_law import current_by_rate
from beamfit.lifetime.expansion import Pieces, fit_law
from beamfit.lifetime.fit import DecayFit, fit_decay, fit_decays
from beamfit.lifetime.record import DecayRecord
from beamfit.lifetime.systematics import (
    constant_a_test,
    log_linear,
    moving_lifetime,
    single_exponential,
)
from beamfit.quantity import Status
from tests.simulations import simulations, widened

constant_fit = partial(fit_decay, law="constant")
constant_fits = partial(fit_decays, law="constant")
APS = Path("../shared/data/aps_decay/aps_1999-02-11_9h_decay.csv")
CONTRACT = (
    "record, status, message, a, b, i0, lifetime_start, lifetime_end, lifetime_mean, "
    "chi2, dof, identifiability"
)

HOUR = 3600.0


def law(time, i0, a, b):
    return i0 * np.exp(-b * time) / (1 + a / b * i0 * -np.expm1(-b * time))


def simulated(span, noise=1e-3, i0=500.0, a=4e-8, b=2e-6, rows=500, seed=1, stated=None):
    time = np.linspace(0, span, rows)
    measured = law(time, i0, a, b) + noise * np.random.default_rng(seed).normal(size=rows)
    error = np.full(rows, stated) if stated else None
    return DecayRecord(time, measured, error, name="simulated")


@pytest.mark.skipif(not APS.exists(), reason="the APS record is beside the checkout only")
def test_the_aps_decay():
    time, measured = np.loadtxt(APS, delimiter=",", skiprows=1).T
    record = DecayRecord(time, measured)
    fit = constant_fit(record)
    assert fit.status == "converged"
    # By plain least squares 6.996e-8 and 7.17e-7; block bootstrap gives a an error of 1.2e-9.
    plain = fit_law(Pieces.of(record)).values
    assert plain.a == pytest.approx(6.996e-8, abs=5e-12)
    assert plain.b == pytest.approx(7.17e-7, abs=5e-10)
    assert fit.a.value == pytest.approx(6.996e-8, abs=1e-10)
    assert 1.0e-9 < fit.a.error < 1.6e-9
    assert fit.a.error_raw == pytest.approx(0.030e-8, abs=5e-12)
    assert abs(fit.b.value - 7.17e-7) < 0.1 * fit.b.error
    assert fit.b.error == pytest.approx(1.2e-7, rel=0.25)
    assert fit.rms_residual == pytest.approx(0.016, abs=5e-4)
    assert fit.lifetime_start.value == pytest.approx(35.4, abs=0.05)
    assert fit.lifetime_end.value == pytest.approx(43.5, abs=0.05)
    assert single_exponential(record).rms_residual > 10 * fit.rms_residual
    # Single readings scatter by 0.004 mA only: the residual is slow, and the fit says so.
    assert fit.identifiability.residual_correlation > 0.8
    assert "which the errors contain" in fit.message


def test_the_aps_decay_as_measured_and_thinned():
    fit = fit_decay(read_decay_record("measurements/aps_1999_decay.csv"))
    assert fit.status == "converged"
    assert abs(fit.a.value - 6.996e-8) < 2 * fit.a.error
    assert abs(fit.b.value - 7.17e-7) < 2 * fit.b.error


def test_the_result_as_json():
    fit = fit_decay(simulated(8 * HOUR))
    document = json.loads(json.dumps(fit.to_json(), allow_nan=False))
    assert set(CONTRACT.split(", ")) <= set(document)
    assert document["a"] == {
        "value": fit.a.value,
        "error": fit.a.error,
        "error_raw": fit.a.error_raw,
        "unit": "1/(mA s)",
        "interval_95": list(fit.a.interval_95),
    }
    assert document["lifetime_mean"]["unit"] == "h"


def test_a_short_record_says_that_a_and_b_are_one_number():
    fit = fit_decay(simulated(60, stated=1e-3))
    assert fit.status == "unidentified"
    assert "not separable" in fit.message
    assert "times longer" in fit.message
    assert fit.a.error is None
    assert fit.b.error is None
    assert fit.b.error_raw is None
    assert not fit.identifiability.separable
    assert fit.identifiability.correlation < -0.9999
    true = 1 / (4e-8 * fit.mean_current + 2e-6) / HOUR
    assert abs(fit.lifetime_mean.value - true) < 4 * fit.lifetime_mean.error
    assert fit.lifetime_mean.error < 0.001 * true


def test_the_length_it_asks_for_is_enough():
    short = fit_decay(simulated(60, stated=1e-3))
    longer = float(short.message.split("record ")[-1].split(" times")[0])
    assert "separate them if they are constant" in short.message
    records = [simulated(60 * longer * 1.1, seed=seed, stated=1e-3) for seed in range(10)]
    fits = fit_decays(records, law="constant")
    assert sum(fit.identifiability.separable for fit in fits) >= 8


@simulations(16, 64)
def test_a_record_shorter_than_its_noise_allows(count):
    fits = fit_decays([simulated(60, noise=5.0, seed=k, stated=5.0) for k in range(count)])
    lost = [fit for fit in fits if "within its noise" in fit.message]
    assert len(lost) > 0.78 * count
    assert {fit.status for fit in lost} == {"unidentified"}
    assert {fit.lifetime_mean.error for fit in lost} == {None}
    limits = [float(fit.message.split("above ")[1].split(" h")[0]) for fit in lost]
    true = 1 / (4e-8 * 500 + 2e-6) / HOUR
    assert np.mean(np.array(limits) < true) > 0.85  # stated to hold in 95 of 100


def test_errors_in_the_file_are_tested_by_chi2_and_enlarged():
    honest = constant_fit(simulated(8 * HOUR, stated=1e-3))
    assert honest.status == "converged"
    assert honest.a.error == pytest.approx(honest.a.error_raw * max(1, (honest.chi2 / 497) ** 0.5))
    bold = constant_fit(simulated(8 * HOUR, stated=1e-4))
    assert bold.status == "poor_fit"
    assert bold.chi2 / bold.dof == pytest.approx(100, rel=0.2)
    assert bold.a.error == pytest.approx(bold.a.error_raw * (bold.chi2 / bold.dof) ** 0.5)
    assert bold.a.error == pytest.approx(honest.a.error, rel=0.2)


def test_errors_missing_from_the_file_are_inferred_and_said_so():
    fit = constant_fit(simulated(8 * HOUR))
    assert fit.noise_inferred
    assert "inferred from the residuals" in fit.message
    assert fit.chi2 == fit.dof
    # Half of the central 68 % of Student's distribution.
    assert fit.a.error == pytest.approx(fit.a.error_raw * t.ppf(0.841344746, fit.dof), rel=1e-9)
    stated = constant_fit(simulated(8 * HOUR, stated=1e-3))
    assert fit.a.error == pytest.approx(stated.a.error_raw, rel=0.1)


@simulations(64, 256)
def test_the_stated_errors_cover_the_truth(count):
    records = [simulated(4 * HOUR, noise=0.02, seed=seed) for seed in range(count)]
    fits = constant_fits(records)
    beams = law(np.array([0, 4 * HOUR]), 500.0, 4e-8, 2e-6)
    mean = np.mean(law(records[0].time, 500.0, 4e-8, 2e-6))
    true = {"a": 4e-8, "b": 2e-6, "i0": 500.0} | {
        f"lifetime_{where}": 1 / (4e-8 * beam + 2e-6) / HOUR
        for where, beam in zip(("start", "end", "mean"), (*beams, mean), strict=True)
    }
    for name, value in true.items():
        found = [getattr(fit, name) for fit in fits]
        pulls = [(quantity.value - value) / quantity.error for quantity in found]
        # 256 records know the width of the pulls to 4 %, their mean to 6 %.
        assert np.std(pulls) == pytest.approx(1, abs=widened(0.15, 256, count))
        assert abs(np.mean(pulls)) < widened(0.25, 256, count)


def test_many_at_once_equal_one_by_one():
    records = [simulated(HOUR * k, rows=300 + 30 * k, seed=k) for k in (1, 2, 3, 4, 5)]
    records.append(DecayRecord(np.arange(9.0), np.full(9, 5.0)))
    for record, fit in zip(records, fit_decays(records), strict=True):
        alone = fit_decay(record)
        assert fit.status == alone.status
        assert fit.i0.value == pytest.approx(alone.i0.value, rel=1e-9)


def test_a_constant_record_is_no_decay():
    fit = fit_decay(DecayRecord(np.arange(20.0), np.full(20, 100.0)))
    assert fit.status == "unidentified"
    assert "All 20 readings are 100 mA" in fit.message
    assert np.isnan(fit.lifetime_mean.value)
    assert fit.to_json()["a"]["value"] is None


def test_quantised_readings_are_noted():
    time = np.linspace(0, 8 * HOUR, 1000)
    record = DecayRecord(time, np.round(law(time, 200.0, 4e-8, 2e-6)))
    fit = fit_decay(record)
    assert "quantised in steps of 1 mA" in fit.message
    assert abs(fit.lifetime_mean.value / (1 / (4e-8 * fit.mean_current + 2e-6) / HOUR) - 1) < 0.01


def test_a_rising_record_is_refused_with_a_remedy():
    time = np.linspace(0, 600, 400)
    with pytest.raises(InputError, match=r"rises, 80 to 102 mA.*split_record"):
        fit_decay(DecayRecord(time, np.linspace(80, 102, 400)))


def test_too_few_readings():
    with pytest.raises(InputError, match="4 readings; expected 5 or more"):
        fit_decay(DecayRecord(np.arange(4.0), [4.0, 3.0, 2.0, 1.0]))


def test_a_gap_does_no_harm():
    record = simulated(8 * HOUR, noise=0.01)
    gapped = record.select((record.time < 2 * HOUR) | (record.time > 6 * HOUR))
    fit = fit_decay(gapped)
    assert fit.status == "converged"
    assert abs(fit.a.value - 4e-8) < 4 * fit.a.error


def lengthening_record():
    time = np.linspace(0, 10 * HOUR, 500)
    exact = current_by_rate(time, 500.0, lambda i: 4e-8 * (i / 500) ** -0.25 * i + 2e-7)
    noise = 2e-3 * np.random.default_rng(2).normal(size=500)
    return DecayRecord(time, np.asarray(exact) + noise, np.full(500, 2e-3))


def test_a_varying_a_is_found_and_its_false_gas_term_undone():
    record = lengthening_record()
    plain = fit_decay(record, law="constant")
    assert plain.status == "poor_fit"
    assert plain.b.value > 2e-7 + 20 * plain.b.error
    free = fit_decay(record)
    assert free.status == "converged"
    assert free.b.interval_95[0] < 2e-7 < free.b.interval_95[1]
    assert abs(free.free_law.exponent.value + 0.25) < 2 * free.free_law.exponent.error
    verdict = constant_a_test(record)
    assert verdict.status == "poor_fit"
    assert abs(verdict.exponent.value + 0.25) < 4 * verdict.exponent.error
    shaped = fit_decay(record, shape=lambda i: i**-0.25)
    assert shaped.status == "converged"
    assert abs(shaped.b.value - 2e-7) < 4 * shaped.b.error
    true = 4e-8 * (record.current.mean() / 500) ** -0.25
    assert abs(shaped.a.value - true) < 4 * shaped.a.error


def test_a_constant_a_is_not_rejected():
    verdicts = [constant_a_test(simulated(10 * HOUR, noise=2e-3, seed=k)) for k in range(8)]
    assert all(verdict.status == "converged" for verdict in verdicts)
    assert np.std([verdict.p_value for verdict in verdicts]) > 0.1


def test_a_short_record_cannot_test_for_constant_a():
    verdict = constant_a_test(simulated(600, noise=0.05))
    assert verdict.status == "unidentified"
    assert verdict.exponent.error is None


# Bias of the control room's straight line, from an independent analysis of the same decay: half
# gas, half Touschek, ten hours at the start.
@pytest.mark.parametrize(("span", "bias"), [(600, 0.00554), (3600, 0.0328), (28800, 0.2376)])
def test_the_bias_of_simpler_laws_is_stated(span, bias):
    record = simulated(span, a=2 / 3 / 36000 / 500, b=1 / 3 / 36000, rows=1000)
    line = log_linear(record)
    assert line.bias_start == pytest.approx(bias, rel=0.02)
    exponential = single_exponential(record)
    assert exponential.lifetime.value == pytest.approx(10 * (1 + exponential.bias_start), rel=1e-4)
    assert 0 < exponential.bias_start <= line.bias_start * 1.001


def test_no_logarithm_of_zero():
    with pytest.raises(InputError, match="a current of zero"):
        log_linear(DecayRecord(np.arange(6.0), [5, 4, 3, 2, 1, 0.0]))


def test_the_moving_lifetime_follows_the_law():
    record = simulated(8 * HOUR, noise=0.02, rows=2000)
    trace = moving_lifetime(record, 1200.0)
    true = 1 / (4e-8 * trace.current + 2e-6) / HOUR
    pulls = (trace.lifetime - true) / trace.error
    assert np.std(pulls) == pytest.approx(1, abs=0.4)
    assert abs(np.mean(pulls)) < 0.5
    with pytest.raises(InputError, match="a window of 20 s"):
        moving_lifetime(record, 20.0)


@simulations(40, 1000)
def test_random_records_leave_no_failure(count):
    rng = np.random.default_rng(8)
    records = []
    for k in range(count):
        lifetime, share = 10 ** rng.uniform(0, 2.3) * HOUR, rng.uniform()
        i0, noise = 10 ** rng.uniform(0, 2.8), 10 ** rng.uniform(-4, -1)
        span = 60.0 if k % 4 == 0 else 10 ** rng.uniform(1.7, np.log10(2 * lifetime))
        time = np.linspace(0, span, 300)
        exact = law(time, i0, share / lifetime / i0, (1 - share) / lifetime)
        measured = np.abs(exact + noise * rng.normal(size=300))
        records.append(DecayRecord(time, measured, np.full(300, noise) if k % 2 else None))
    fits = fit_decays(records)
    statuses = Counter(fit.status for fit in fits)
    assert set(statuses) <= {"converged", "unidentified", "poor_fit"}
    # One in a thousand good fits has a chi² this improbable.
    assert statuses["poor_fit"] <= max(1, 3 * count // 1000)
    assert statuses["converged"] > 0.2 * count
    assert all(not fit.lifetime_mean.value <= 0 for fit in fits)


@pytest.mark.parametrize("stated", [None, 1e-3])
def test_a_record_with_a_refill_is_not_passed_off_as_a_decay(stated):
    record = simulated(8 * HOUR, stated=stated)
    refilled = record.current + np.where(record.time > 5 * HOUR, 20.0, 0.0)
    fit = fit_decay(DecayRecord(record.time, refilled, record.error))
    assert fit.status in ("poor_fit", "unidentified")
    assert "a step of +" in fit.message
    assert "split_record" in fit.message
    assert "step" not in fit_decay(record).message


@pytest.mark.parametrize(("a", "b"), [(1e-30, 1 / 36000), (1 / 36000 / 500, 1e-30)])
def test_the_bias_of_the_moving_lifetime_is_as_stated(a, b):
    time = np.linspace(0, 2 * HOUR, 401)
    trace = moving_lifetime(DecayRecord(time, law(time, 500.0, a, b)), 7199.0)
    lifetime = 1 / (a * trace.current[0] + b) / HOUR
    stated = (2 / lifetime) ** 2 / 60
    assert trace.lifetime[0] / lifetime - 1 == pytest.approx(stated, rel=0.1)


@pytest.mark.parametrize(
    ("count", "enough"), [(900, 300), pytest.param(3000, 1024, marks=pytest.mark.calibrate)]
)
def test_averaging_neighbours_costs_the_law_nothing(monkeypatch, count, enough):
    """SIMULATED: readings of a decay with a going as I^-0.2, averaged to a third and not."""
    time = np.linspace(0.0, 12 * 3600.0, count)
    exact = current_by_rate(time, 500.0, lambda i: 4e-8 * (i / 500) ** -0.2 * i)
    noise = 0.02 * np.random.default_rng(4).normal(size=time.size)
    record = DecayRecord(time, np.asarray(exact) + noise)
    monkeypatch.setattr(alternatives, "MAX_ROWS", enough)
    fit = constant_fit(record)
    monkeypatch.setattr(alternatives, "MAX_ROWS", 10_000)
    plain = constant_fit(record)
    averaged, whole = fit.lifetimes.exponent, plain.lifetimes.exponent
    assert averaged.value == pytest.approx(whole.value, abs=whole.error)
    assert averaged.error == pytest.approx(whole.error, rel=0.15)
    assert abs(whole.value + 0.2) < 3 * whole.error
    assert fit.status == plain.status == Status.poor_fit
    true = (
        1 / (4e-8 * (np.array(fit.lifetimes.current) / 500) ** -0.2 * fit.lifetimes.current) / HOUR
    )
    for quantity, value in zip(fit.lifetimes.lifetime, true, strict=True):
        assert abs(quantity.value - value) < 4 * quantity.error
        assert quantity.relative < 1e-3


def few_readings(seed: int, count: int = 5) -> DecayFit:
    """A decay of 10 h over 20 minutes, seen to 1 mA, without errors."""
    time = np.linspace(0.0, 1200.0, count)
    noise = np.random.default_rng(seed).standard_normal(count)
    return fit_decay(DecayRecord(time, 200.0 * np.exp(-time / 36000.0) + noise))


@simulations(15, 60)
def test_few_residuals_do_not_refute_a_law(count):
    """Of 5 noisy readings 7 % had a step, a rejected constant a (p = 1e-10) or a negative a."""
    found = [few_readings(seed).status for seed in range(count)]
    assert found.count(Status.unidentified) >= count - 1


def test_few_residuals_are_said_to_tell_the_noise_badly():
    assert "the 95 % interval is ±4.3 σ" in few_readings(1).message
    assert "degrees of freedom" not in few_readings(1, 20).message
