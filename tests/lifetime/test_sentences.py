"""What a result says of a record: the cause that is there, and a remedy that can work."""

import numpy as np
import pytest

from beamfit.lifetime.fit import fit_cycles, fit_decay
from beamfit.lifetime.record import DecayRecord
from beamfit.lifetime.study import study_record
from beamfit.quantity import HOUR, Status


def decay(count=400, noise=0.01, seed=1):
    """Times of 5 h and the readings of a decay of 10 h."""
    time = np.linspace(0.0, 5 * HOUR, count)
    return time, 100 * np.exp(-time / 36000) + noise * np.random.default_rng(seed).normal(
        size=count
    )


def test_one_far_reading_is_no_step_to_cut_at():
    time, current = decay()
    current[200] += 0.3
    fit = fit_decay(DecayRecord(time, current))
    assert fit.status is Status.poor_fit
    assert "leave it out" in fit.message
    assert "split_record" not in fit.message


@pytest.mark.parametrize("seed", [6, 9, 24])
def test_a_and_b_without_errors_are_not_called_determined(seed):
    """SIMULATED: few readings whose first lies high, which current lost after it explains."""
    random = np.random.default_rng(seed)
    time = np.linspace(0.0, 15 * HOUR, int(random.integers(12, 36)))
    beam = 300 / (1 + 4e-8 * 300 * -np.expm1(-6e-6 * time) / 6e-6) * np.exp(-6e-6 * time)
    noise = 0.03 * random.normal(size=time.size)
    first = 0.3 * np.exp(-time / time[-1] * random.uniform(20, 60))
    fit = fit_decay(DecayRecord(time, beam + noise + first))
    assert (fit.a.error is None) == (fit.status is not Status.converged)
    assert "are determined" not in fit.message


def test_a_drift_is_not_called_an_exponent_that_is_zero():
    time, _ = decay()
    noise = 3e-4 * np.random.default_rng(2).normal(size=time.size)
    mean = (time - 0.06 * time * (1 - time / time[-1])) / 36000
    message = fit_decay(DecayRecord(time, 100 * np.exp(-mean) + noise)).message
    assert "Constant a and b are rejected" in message
    assert "b drifts by" in message


def test_the_lifetime_is_no_answer_where_refills_are_not_resolved():
    """Readings each 60 s, refills each 180 s."""
    time = np.arange(0.0, 86400.0, 60.0)
    current = 300 * np.exp(-(time % 180.0) / 28800)
    noise = 0.003 * np.random.default_rng(3).normal(size=time.size)
    [found] = study_record(DecayRecord(time, current + noise)).pooled
    assert found.fit.lifetime_mean.error is None
    assert "refills that the record may not resolve" in found.fit.message
    assert "is the answer" not in found.fit.message


def test_cycles_that_bend_as_no_loss_does_have_no_lifetime():
    """A monitor that lags: what is left of the step after each refill bends the cycles."""
    time = np.arange(0.0, 180.0)
    noise = 0.003 * np.random.default_rng(4).normal(size=(40, time.size))
    lag = -0.0015 * np.exp(-time / 30)
    cycles = [
        DecayRecord(time, 400 * np.exp(-time / 36000) + lag + row, start=180.0 * k)
        for k, row in enumerate(noise)
    ]
    fit = fit_cycles(cycles)
    assert fit.status is Status.unidentified
    assert "bends within the cycles" in fit.message
    assert all(quantity.error is None for quantity in fit.quantities.values())
    assert "is the answer" not in fit.message


def test_zeros_are_no_beam():
    message = fit_decay(DecayRecord(np.arange(50.0), np.zeros(50))).message
    assert "no beam" in message
    assert "longer" not in message


@pytest.mark.parametrize("lost", [False, True])
def test_an_hour_that_the_clock_skips_is_taken_out_and_one_of_beam_is_not(lost):
    time, current = np.arange(0.0, 5 * HOUR, 60.0), np.empty(300)
    later = np.where(time > 7000.0, time + HOUR, time)
    current = 100 * np.exp(-(later if lost else time) / 36000)
    current += 0.005 * np.random.default_rng(5).normal(size=time.size)
    study = study_record(DecayRecord(later, current))
    [found] = study.decays
    lifetime = found.fit.lifetime_mean
    assert abs(lifetime.value - 10) < 4 * lifetime.error
    assert any("skips an hour" in note for note in study.record.notes) is not lost
    assert study.record.span == pytest.approx(later[-1] if lost else time[-1])


def test_an_hour_of_top_up_that_is_missing_is_no_clock():
    """Refills hold the current over an hour that was not recorded."""
    time = np.arange(0.0, 6 * HOUR, 10.0)
    later = np.where(time >= 9000.0, time + HOUR, time)
    noise = 0.01 * np.random.default_rng(0).normal(size=time.size)
    record = DecayRecord(later, 500 * np.exp(-(time % 180) / 36000) + noise)
    assert study_record(record).record.notes == ()
