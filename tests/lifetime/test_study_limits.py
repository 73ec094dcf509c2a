"""What a study of decays does not know, a calibration it may have to find, and what it predicts."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq

from beamfit.errors import InputError
from beamfit.lifetime.decay_law import current
from beamfit.lifetime.loss_network import fit_loss_network
from beamfit.lifetime.mechanisms import loss_coefficients, loss_terms, scaled_losses
from beamfit.lifetime.record import Conditions, DecayRecord
from beamfit.lifetime.ring import rf_acceptance
from beamfit.lifetime.ring_study import (
    Limits,
    best_operating_point,
    predict_held_back,
    study_shift,
)
from beamfit.lifetime.scales import fit_scales
from beamfit.lifetime.study import operation_during, study_record
from beamfit.lifetime.tables import budget_rows
from beamfit.quantity import HOUR, Status
from tests.lifetime.conftest import values_of
from tests.lifetime.test_lifetime_study import simulated


def test_what_only_the_limits_of_the_scales_decide_is_not_determined(machine):
    """Three minutes tell the lifetime, and nothing of a and b: truth is b = 1.2e-6 /s."""
    losses = loss_coefficients(machine.ring, machine.operation, 500.0)
    time = np.arange(0.0, 181.0, 1.0)
    noise = 1e-3 * np.random.default_rng(1).normal(size=time.size)
    record = DecayRecord(time, np.array(current(time, 500.0, losses.a, losses.b)) + noise)
    shift = study_shift(study_record(record).decays, machine)
    assert shift.fit.status is Status.unidentified
    found = {row.name: row for row in shift.budget}
    assert not found["a"].separable
    assert not found["b"].separable
    assert np.isnan([found["b"].median, found["b"].lower, found["b"].upper]).all()
    said = json.loads(json.dumps(shift.to_json()))
    assert [row["median"] for row in said["budget"] if row["name"] in "ab"] == [None, None]
    assert "a, b at 499.3 mA" in said["not_determined"]
    assert "not determined" in dict(shift.tables()[0].rows)["b at 499.3 mA"]
    truth = 1 / float(losses.a * 500 + losses.b) / HOUR
    assert found["lifetime"].separable
    assert found["lifetime"].lower < truth < found["lifetime"].upper


TRUE, PRIOR = 1.012, (1.0, 0.01)


@pytest.fixture(scope="module")
def read_low(machine):
    """Twelve decays at a voltage above its reading, at several voltages, scrapers and currents."""
    random = np.random.default_rng(3)
    time, made = np.arange(0.0, 7200.0, 60.0), []
    for k in range(12):
        stated = machine.operation._replace(
            rf_voltage=(1.6e6, 2.2e6, 2.8e6)[k % 3], scraper_y=(6e-3, 3e-3)[k % 2]
        )
        i0 = (500.0, 200.0)[k // 6]
        true = stated._replace(rf_voltage=TRUE * stated.rf_voltage)
        losses = loss_coefficients(machine.ring, true, i0)
        beam = np.array(current(time, i0, losses.a, losses.b))
        pressure = stated.pressure_base + stated.pressure_slope * beam
        said = Conditions(*(np.full(time.size, v) for v in stated[:2]), pressure=pressure)
        noise = 1e-3 * random.normal(size=time.size)
        error = np.full(time.size, 1e-3)
        made += study_record(DecayRecord(time, beam + noise, error, conditions=said)).decays
    return made


@pytest.fixture(scope="module")
def free(machine, read_low):
    """Scales of these, with the voltage's."""
    return fit_scales(read_low, machine, priors={"rf_voltage": PRIOR})


def test_the_calibration_of_the_rf_voltage_is_found_and_told(machine, read_low, free):
    plain = fit_scales(read_low, machine)
    assert plain.status is Status.poor_fit
    # No scatter: the voltage is named, and the scales are those of the true one.
    assert "RF voltage is +1" in plain.message
    assert plain.scatter["a"].interval_95[1] < 0.003
    assert abs(plain.touschek.value - 1) < 3 * plain.touschek.error
    assert free.status is Status.converged
    assert abs(free.rf_voltage.value - TRUE) < 3 * free.rf_voltage.error
    assert free.rf_voltage.error < 0.002
    assert abs(free.touschek.value - 1) < 3 * free.touschek.error
    at = free.terms_at(machine.operation._replace(rf_voltage=2e6), 300.0)
    found = scaled_losses(free.vector, at)[0]
    there = machine.operation._replace(rf_voltage=TRUE * 2e6)
    truth = loss_coefficients(machine.ring, there, 300.0)
    assert float(found) == pytest.approx(float(truth.a), rel=2e-3)
    draws = free.sample(seed=1, target_ess=300).draws
    assert draws[:, 4].mean() == pytest.approx(free.rf_voltage.value, abs=free.rf_voltage.error)


def test_losses_between_voltages_are_those_of_the_ring(machine):
    nodes = 1 + 0.01 * np.arange(-3, 4)
    terms = loss_terms(machine.ring, machine.operation._replace(rf_voltage=2e6), 300.0, nodes)
    for scale, accuracy in ((1.0, 1e-12), (0.98, 1e-12), (1.0234, 2e-4)):
        there = machine.operation._replace(rf_voltage=2e6 * scale)
        expected = scaled_losses(np.ones(4), loss_terms(machine.ring, there, 300.0))
        found = scaled_losses(np.append(np.ones(4), scale), terms)
        np.testing.assert_allclose(found, expected, rtol=accuracy)


def test_a_voltage_that_no_decay_tells_is_its_priors(machine):
    """At 3.2 MV the lattice limits, and only the bunch length depends on the voltage."""
    still = [d for d in simulated(machine, 4) if d.segment.conditions.rf_voltage[0] == 3.2e6]
    found = fit_scales(still, machine, priors={"rf_voltage": (1.0, 0.003)})
    assert found.rf_voltage.error is None
    assert "its prior does" in found.message
    with pytest.raises(InputError, match="every decay is still stored"):
        fit_scales(still, machine, priors={"rf_voltage": (1.0, 0.3)})


def test_decays_held_back_lie_in_the_band_of_the_others(machine, decays):
    found = predict_held_back(fit_scales(decays, machine))
    assert len(found) == len(decays)
    pulls = np.abs([one.pull for one in found])
    assert 15 <= np.sum(pulls < 1) <= 26
    assert np.sum(pulls < 1.96) >= 26
    for k in (3, 20):
        others = fit_scales([*decays[:k], *decays[k + 1 :]], machine)
        there = operation_during(decays[k].segment, machine), decays[k].fit.mean_current
        a, b = scaled_losses(others.vector, others.terms_at(*there))
        hours = 1 / float(a * there[1] + b) / HOUR
        assert found[k].predicted.value == pytest.approx(hours, rel=2e-3)
        assert found[k].measured.value == pytest.approx(decays[k].fit.lifetime_mean.value)


def test_a_gauge_that_contradicts_the_ring_file_is_used_and_said(machine):
    operation, found = machine.operation, {}
    time = np.linspace(0.0, 4 * HOUR, 40)
    beam = 500.0 * np.exp(-time / (20 * HOUR)) + 1e-3 * np.cos(9 * np.arange(40))
    filed = float(operation.pressure_base + beam.mean() * operation.pressure_slope)
    for factor in (1.05, 5.0):
        read = Conditions(pressure=np.full(40, factor * filed))
        [decay] = study_record(DecayRecord(time, beam, conditions=read), machine).decays
        rows = values_of(budget_rows([decay]))
        found[factor] = decay.budget, rows["pressure at the mean current"][0]
    (close, plain), (far, named) = found.values()
    assert close.filed_pressure is None
    assert "ring file" not in plain
    assert far.pressure == pytest.approx(5.0 * filed, rel=1e-6)
    assert far.filed_pressure == pytest.approx(filed, rel=1e-6)
    assert "by the ring file" in named
    assert far.lifetime < 0.6 * close.lifetime


def test_a_correction_begins_at_the_voltage_that_was_found(read_low, free):
    """The network of decays that follow first principles is zero: it had to mend 1 % of voltage."""
    network = fit_loss_network(read_low, free, starts=1)
    points = np.linspace(*np.transpose([*network.certificate.box.values()]), 9)
    added = np.array([network.fit.model["map"].values(point)[0] for point in points])
    assert np.abs(added).max() < 4e-3  # of ln a; it was up to 2.8 %


def test_a_study_with_a_voltage_of_its_own_is_whole(machine, read_low):
    shift = study_shift(read_low, machine, priors={"rf_voltage": PRIOR})
    assert shift.fit.rf_voltage.error < 0.002
    [table] = shift.tables()
    assert "rf_voltage, true over read" in dict(table.rows)
    at = machine.operation._replace(rf_voltage=TRUE * shift.best.rf_voltage.value)
    losses = loss_coefficients(machine.ring, at, shift.current)
    truth = 1 / float(losses.a * shift.current + losses.b) / HOUR
    assert abs(shift.best.lifetime.value - truth) < 3 * shift.best.lifetime.error


def test_the_best_voltage_is_a_reading_and_as_uncertain_as_its_scale(machine, free):
    """Bucket and lattice meet at a true voltage; what is read there is 1.2 % less."""
    ring = machine.ring._replace(momentum_acceptance=0.025)
    narrow = replace(free, machine=machine._replace(ring=ring))
    sample = free.sample(seed=1, target_ess=300)
    best = best_operating_point(
        narrow, sample, Limits((1.5e6, 3.2e6), (2e-3, 6e-3), (70, 280)), 500
    )
    bucket = (ring.energy, ring.energy_loss, ring.momentum_compaction, ring.harmonic)
    meets = brentq(lambda v: float(rf_acceptance(v, *bucket)) - 0.025, 1.5e6, 3.2e6)
    assert abs(best.rf_voltage.value - meets / TRUE) < 3 * best.rf_voltage.error
    assert 0.8 < best.rf_voltage.relative / free.rf_voltage.error < 2.0
