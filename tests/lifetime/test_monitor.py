"""A monitor's stated stability is part of the errors, of the posterior and of a study."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from beamfit.errors import InputError
from beamfit.io.decay_record import monitor_of
from beamfit.lifetime.fit import fit_cycles, fit_decay, fit_decays
from beamfit.lifetime.record import DecayRecord, Monitor
from beamfit.lifetime.scales import summarise
from beamfit.lifetime.study import study_record
from beamfit.lifetime.systematics import systematics
from beamfit.quantity import HOUR, Status
from tests.simulations import simulations, widened

I0, A, B = 300.0, 2e-8, 2e-6
constant_fit = partial(fit_decay, law="constant")
constant_fits = partial(fit_decays, law="constant")
TIME = np.linspace(0.0, 4 * HOUR, 64)
STATED = Monitor(drift=0.02, offset=0.2)


def read(seed, time=TIME, **options):
    """A decay read by a monitor that drifts and is off as stated."""
    random = np.random.default_rng(seed)
    beam = I0 * np.exp(-B * time) / (1 + A / B * I0 * -np.expm1(-B * time))
    drift, offset = np.array(STATED) * random.normal(size=2)
    noise = 2e-3 * random.normal(size=time.size)
    seen = beam + drift * time / HOUR + offset + noise
    return DecayRecord(time, seen, np.full(time.size, 2e-3), **options)


@simulations(60, 300)
def test_errors_with_a_stated_stability_cover_the_truth(count):
    """Over 300 fills, each with a drift and an offset of its own; without it next to none do."""
    truth = {"a": A, "b": B, "lifetime_start": 1 / (A * I0 + B) / HOUR}
    fits = constant_fits([read(seed, monitor=STATED) for seed in range(count)])
    for name, value in truth.items():
        found = [getattr(fit, name) for fit in fits]
        off = np.array([abs(q.value - value) / q.error for q in found])
        assert abs(np.mean(off < 1) - 0.68) < widened(0.08, 300, count), name
        assert abs(np.mean(off < 1.96) - 0.95) < widened(0.03, 300, count), name
        above, below = np.mean(
            [[q.interval_95[0] > value, q.interval_95[1] < value] for q in found], 0
        )
        assert abs(above - 0.025) < widened(0.02, 300, count), name
        assert abs(below - 0.025) < widened(0.02, 300, count), name
    blind = np.array([abs(fit.b.value - B) / fit.b.error_raw for fit in fits])
    assert np.mean(blind < 1.96) < 0.5


def test_the_free_law_follows_an_offset_its_own_way():
    """By constant a and b an offset hardly moves the lifetime at the start of such a fill: it was
    quoted to a sixth of what the free law makes of it.
    """
    time = np.linspace(0.0, 28 * HOUR, 200)
    half = 0.5 / (10 * HOUR)
    beam = 200 * np.exp(-half * time) / (2 - np.exp(-half * time))
    noise = 0.08 * np.random.default_rng(1).normal(size=time.size)
    fit = fit_decay(DecayRecord(time, beam - 2.0 + noise, monitor=Monitor(offset=1.0)))
    ends = zip((fit.lifetime_start, fit.lifetime_end), beam[[0, -1]], strict=True)
    for found, current in ends:
        true = 1 / (half * (1 + current / 200)) / HOUR
        assert abs(found.value - true) < 3 * found.error


def test_a_drift_is_no_departure_from_the_law():
    """A drift looks like a power of the current: within a stated one it refutes nothing."""
    time = np.linspace(0.0, 12 * HOUR, 128)
    beam = I0 * np.exp(-B * time) / (1 + A / B * I0 * -np.expm1(-B * time))
    seen = beam + 0.02 * time / HOUR + 1e-4 * np.random.default_rng(1).normal(size=time.size)
    record = DecayRecord(time, seen, np.full(time.size, 1e-4))
    assert fit_decay(record).constant_a.status is Status.poor_fit
    found = fit_decay(record, monitor=Monitor(drift=0.02))
    assert found.constant_a.status is not Status.poor_fit
    assert abs(found.a.value - A) < 3 * found.a.error


def test_the_sentence_and_the_table_say_what_is_stated():
    record = replace(read(1), error=None)
    assert "stability is not stated" in fit_decay(record).message
    fit = constant_fit(record, monitor=STATED)
    assert "not stated" not in fit.message
    assert "drifts by 20 µA/h and is off by 200 µA (one standard deviation)" in fit.message
    causes = {row.cause: row for row in systematics(fit)}
    drift = causes["monitor drifts by 20 µA/h (in the errors)"]
    offset = causes["monitor reads 200 µA too much (in the errors)"]
    scale = fit.a.error_raw
    assert fit.a.error == pytest.approx(np.sqrt(drift.a**2 + offset.a**2 + scale**2), rel=1e-6)


def test_the_posterior_knows_the_monitor():
    fit = constant_fit(read(2), monitor=Monitor(drift=0.02))
    found = fit.sample(seed=1, target_ess=400)
    assert found.values("b").std() == pytest.approx(fit.b.error, rel=0.2)
    assert abs(found.values("b").mean() - fit.b.value) < 0.3 * fit.b.error


def test_a_study_weighs_decays_with_the_monitor():
    """Against the errors of a and b that the decay fit quotes."""
    [decay] = study_record(read(3, monitor=STATED), law="constant").decays
    root = np.asarray(summarise((decay,)).root[0])
    covariance = np.linalg.inv(root.T @ root)
    mean, fit = decay.fit.mean_current, decay.fit
    assert np.sqrt(covariance[0, 0]) / mean == pytest.approx(fit.a.error, rel=0.01)
    slope = np.array([-1.0, 1.0])
    assert np.sqrt(slope @ covariance @ slope) == pytest.approx(fit.b.error, rel=0.01)


@simulations(12, 40)
def test_cycles_together_contain_the_monitor(count):
    """One drift through a day of top-up, whose cycles are refilled to the same current."""
    time = np.arange(0.0, 600.0, 30.0)
    drift, noise = 0.5 / HOUR, 1e-4
    off, blind = [], []
    for seed in range(count):
        random = np.random.default_rng(seed)
        rate = drift * random.normal()
        cycles = [
            DecayRecord(
                time + 600.0 * k,
                200 * np.exp(-time / 36000) + rate * (time + 600 * k)
                + noise * random.normal(size=time.size),
                start=600.0 * k, monitor=Monitor(drift=0.5),
            )
            for k in range(12)
        ]  # fmt: skip
        found = fit_cycles(cycles).lifetime_mean
        off.append(abs(found.value - 10) / found.error)
        blind.append(abs(found.value - 10) / found.error_raw)
    assert abs(np.mean(np.array(off) < 1) - 0.675) < widened(0.175, 40, count)
    assert np.mean(np.array(off) < 1.96) > 0.95 - widened(0.1, 40, count)
    assert np.mean(np.array(blind) < 1.96) < 0.5


@pytest.mark.parametrize(
    ("drift", "offset", "found"),
    [
        ("10uA/h", None, (0.01, 0.0)),
        ("0.24 mA/d", "50 µA", (0.01, 0.05)),
        (None, "1e-6A", (0.0, 1e-3)),
    ],
)
def test_stabilities_as_people_write_them(drift, offset, found):
    assert monitor_of(drift, offset) == pytest.approx(found)


@pytest.mark.parametrize("text", ["10uA", "10/h", "-1uA/h", "1V/h", "nanuA/h"])
def test_what_is_no_stability(text):
    with pytest.raises(InputError, match="10uA/h"):
        monitor_of(text, None)
    with pytest.raises(InputError, match="zero or more"):
        DecayRecord([0, 1], [2, 1], monitor=Monitor(drift=-1.0))
