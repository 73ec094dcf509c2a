"""Scales, budget, operating point, next decay and anomaly on the simulated SPEAR3 shift."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq

import beamfit
from beamfit.errors import InputError
from beamfit.lifetime.decay_law import current
from beamfit.lifetime.mechanisms import SCALES, loss_coefficients, loss_terms, scaled_losses
from beamfit.lifetime.record import Conditions, DecayRecord
from beamfit.lifetime.ring import rf_acceptance
from beamfit.lifetime.ring_study import (
    DecayCandidate,
    Limits,
    best_operating_point,
    budget_intervals,
    find_anomaly,
    next_decays,
)
from beamfit.lifetime.scales import add_errors, fit_scales, summarise
from beamfit.lifetime.study import study_record
from beamfit.quantity import Status
from tests.simulations import simulations

TRUE = np.array([1.12, 1.30, 0.85, 1.25])  # measurements/make_spear3_shift.py


@pytest.fixture(scope="module")
def fit(decays, machine):
    return fit_scales(decays, machine)


@pytest.fixture(scope="module")
def sample(fit):
    return fit.sample(seed=1)


def simulated(machine, number, change=(1.0, 1.0), first=0, seed=5):
    """Decays at 300 to 500 mA, a and b changed by factors from one decay on."""
    random = np.random.default_rng(seed)
    time, made = np.arange(0.0, 5760.0, 60.0), []
    for k in range(number):
        voltage, i0 = (3.2e6, 2.4e6)[k % 2], (500.0, 300.0)[k % 2]
        operation = machine.operation._replace(rf_voltage=voltage)
        # P(I) = P0 + P1 I as in the file, read without error.
        losses = loss_coefficients(machine.ring, operation, i0)
        factor = change if k >= first else (1.0, 1.0)
        beam = np.array(current(time, i0, losses.a * factor[0], losses.b * factor[1]))
        pressure = operation.pressure_base + operation.pressure_slope * beam
        shown = Conditions(rf_voltage=np.full(time.size, voltage), pressure=pressure)
        noise = 2e-3 * random.normal(size=time.size)
        record = DecayRecord(
            time, beam + noise, np.full(time.size, 2e-3), f"fill{k}", conditions=shown
        )
        made += study_record(record, law="constant").decays
    return made


def test_unit_scales_are_first_principles(machine):
    losses = loss_coefficients(machine.ring, machine.operation, 300.0)
    terms = loss_terms(machine.ring, machine.operation, 300.0)
    a, b = scaled_losses(np.ones(4), terms)
    assert float(a) == pytest.approx(float(losses.a), rel=1e-12)
    assert float(b) == pytest.approx(float(losses.b), rel=1e-12)


def test_the_summary_is_the_information_of_the_readings(decays):
    """Against the errors of a and b that the decay fit takes from its own Jacobian."""
    some = decays[:3]
    found = summarise(some)
    for k, decay in enumerate(some):
        root = np.asarray(found.root[k])
        covariance = np.linalg.inv(root.T @ root)
        mean, fit = decay.fit.mean_current, decay.fit
        a, b = fit.if_constant("a"), fit.if_constant("b")
        assert np.sqrt(covariance[0, 0]) / mean == pytest.approx(a.error, rel=0.01)
        slope = np.array([-1.0, 1.0])  # b = (a I + b) - a I
        assert np.sqrt(slope @ covariance @ slope) == pytest.approx(b.error, rel=0.01)


def test_an_error_of_the_model_adds_to_the_covariance():
    random = np.random.default_rng(4)
    root, changes = np.triu(random.normal(size=(2, 2))), random.normal(size=(2, 3))
    found = np.asarray(add_errors(root, changes))
    expected = np.linalg.inv(root.T @ root) + changes @ changes.T
    np.testing.assert_allclose(np.linalg.inv(found.T @ found), expected, rtol=1e-10)
    nothing = np.array([[0.0, 0.0], [0.0, 2.0]])  # a decay that does not tell a
    assert np.isfinite(add_errors(nothing, changes)).all()


def test_the_scales_of_the_shift_are_found(fit):
    assert fit.status is Status.converged
    for name, true in zip(SCALES, TRUE, strict=True):
        found = getattr(fit, name)
        assert abs(found.value - true) < 3 * found.error, name
    assert fit.touschek.error < 0.002
    assert fit.elastic.error < 0.05
    assert 0.5 < fit.chi2 / fit.dof < 1.6


def test_the_errors_of_the_scales_are_those_of_repetition(machine):
    """Ten shifts of eight fills: pulls of the Touschek scale and of desorption have unit width."""
    pulls = []
    for seed in range(10):
        found = fit_scales(simulated(machine, 8, seed=seed), machine, pressure_error=1e-4)
        pair = found.touschek, found.desorption
        pulls.append([(scale.value - 1) / scale.error for scale in pair])
    width = np.sqrt(np.mean(np.square(pulls), axis=0))
    assert ((width > 0.4) & (width < 1.8)).all(), width


def test_without_a_scraper_scan_the_gas_mechanisms_are_not_separable(machine, decays):
    still = [d for d in decays if np.ptp([d.segment.conditions.scraper_y[0], 6e-3]) < 1e-9]
    still = [d for d in still if d.segment.conditions.rf_voltage[0] == 3.2e6]
    fit = fit_scales(still, machine)
    assert fit.status is Status.unidentified
    assert "bremsstrahlung and elastic not separable" in fit.message
    assert "scraper" in fit.message
    assert fit.elastic.error is None
    assert fit.touschek.error is not None
    known = fit_scales(still, machine, priors={"elastic": (0.85, 0.02)})
    assert known.status is Status.converged
    assert abs(known.bremsstrahlung.value - 1.30) < 3 * known.bremsstrahlung.error


def test_one_decay_separates_nothing_of_the_gas(machine, decays):
    fit = fit_scales(decays[:1], machine)
    assert fit.status is Status.unidentified
    assert fit.bremsstrahlung.error is None


def test_bad_requests(machine, decays, fit, sample):
    with pytest.raises(InputError, match="no decay"):
        fit_scales([], machine)
    with pytest.raises(InputError, match="did you mean touschek"):
        fit_scales(decays[:1], machine, priors={"Touscheck": (1, 0.1)})
    with pytest.raises(InputError, match="no beam is stored"):
        best_operating_point(fit, sample, Limits((5e5, 8e5), (2e-3, 6e-3), (70, 280)), 500.0)
    with pytest.raises(InputError, match="no candidate"):
        next_decays(fit, [])


def test_sampling_agrees_with_the_linear_errors(fit, sample):
    assert sample.diagnostics.settled
    error = np.sqrt(np.diag(fit.covariance))
    assert np.abs(sample.draws.mean(0) - fit.vector).max() < 0.25 * error.max()
    assert sample.draws.std(0) == pytest.approx(error, rel=0.2)
    assert sample.draws.min() >= 0


def test_the_budget_holds_the_truth(fit, sample, machine):
    usual = machine.operation._replace(pressure_slope=1.25 * machine.operation.pressure_slope)
    a, b = scaled_losses([*TRUE[:3], 1.0], loss_terms(machine.ring, usual, 500.0))
    read = machine.operation._replace(
        pressure_base=machine.operation.pressure_base * 1.2,
        pressure_slope=machine.operation.pressure_slope * 1.2,
    )  # the same 1.2e-7 Pa at 500 mA, as a gauge shows it
    rows = {r.name: r for r in budget_intervals(fit, sample, read, 500.0, probability=0.997)}
    assert rows["a"].lower < float(a) < rows["a"].upper
    assert rows["b"].lower < float(b) < rows["b"].upper
    total = sum(rows[n].median for n in ("touschek", "bremsstrahlung", "elastic"))
    assert 1 / total == pytest.approx(rows["lifetime"].median, rel=1e-3)


def test_the_best_voltage_is_where_the_bucket_outgrows_the_lattice(fit, sample, machine):
    ring = machine.ring._replace(momentum_acceptance=0.025)
    narrow = replace(fit, machine=machine._replace(ring=ring))
    limits = Limits((1.5e6, 3.2e6), (2e-3, 6e-3), (70, 280))
    best = best_operating_point(narrow, sample, limits, 500.0)
    bucket = (ring.energy, ring.energy_loss, ring.momentum_compaction, ring.harmonic)
    meets = brentq(lambda v: float(rf_acceptance(v, *bucket)) - 0.025, 1.5e6, 3.2e6)
    assert best.rf_voltage.value == pytest.approx(meets, abs=3 * best.rf_voltage.error)
    assert best.lifetime.value > best.usual.value
    # No other corner or voltage does better.
    for voltage, scraper, bunches in itertools.product((2.2e6, 2.9e6), (2e-3, 6e-3), (70, 280)):
        operation = machine.operation._replace(
            rf_voltage=voltage, scraper_y=scraper, bunches=float(bunches)
        )
        a, b = scaled_losses(fit.vector, loss_terms(ring, operation, 500.0))
        assert 1 / float(a * 500 + b) / 3600 < best.lifetime.value


def test_a_voltage_at_its_limit_has_no_error(fit, sample):
    limits = Limits((1.5e6, 2.0e6), (2e-3, 6e-3), (70, 280))
    best = best_operating_point(fit, sample, limits, 500.0)
    assert best.rf_voltage.error is None
    assert best.rf_voltage.value == pytest.approx(2.0e6)
    assert "at its limit" in best.message


def test_the_next_decay_closes_the_gap(machine, decays):
    """Without scraper scan the proposal is to move the scraper, and recording it does help."""
    still = [d for d in decays[:15] if d.segment.conditions.scraper_y[0] > 5.9e-3]
    fit = fit_scales(still, machine, priors={"elastic": (1.0, 0.3)})
    candidates = [
        DecayCandidate(machine.operation._replace(scraper_y=y, rf_voltage=v), 500.0, 5760.0, 2e-3)
        for y in (6e-3, 2e-3)
        for v in (3.2e6, 2.4e6)
    ]
    first = next_decays(fit, candidates)[0]
    assert first.candidate.operation.scraper_y == 2e-3
    assert first.information > 0
    [scraped] = [d for d in decays[5:10] if d.segment.conditions.scraper_y[0] == 2e-3]
    better = fit_scales([*still, scraped], machine, priors={"elastic": (1.0, 0.3)})
    assert better.covariance[2, 2] < 0.5 * fit.covariance[2, 2]
    # The expected error is that of a like decay, within what its other settings change.
    assert better.covariance[2, 2] ** 0.5 == pytest.approx(first.errors[2], rel=0.5)


@pytest.mark.parametrize(
    ("change", "moved"),
    [((1.0, 1.0), ()), ((1.05, 1.0), ("a",)), ((1.0, 1.6), ("b",)), ((1.3, 1.6), ("a", "b"))],
)
def test_an_anomaly_is_named_and_dated(machine, fit, decays, change, moved):
    reference = fit_scales(decays, machine)
    truth = machine._replace(operation=machine.operation)
    at_one = replace(reference, fit=replace(reference.fit, theta=np.ones(4)))
    found = find_anomaly(at_one, simulated(truth, 8, change, 5))
    assert found.moved == moved
    assert found.since == ("fill5" if moved else None)
    for name, factor in zip("ab", change, strict=True):
        if name in moved:
            quantity = getattr(found, name)
            assert quantity.value == pytest.approx(factor - 1, abs=4 * quantity.error)


@simulations(2, 5)
@pytest.mark.parametrize(
    ("a", "b", "span"),
    [
        (1.8992e-5, 1.8964e-4, 3600.0),
        (1.882e-5, 1.905e-4, 3600.0),
        (1.9058e-5, 1.8842e-4, 3600.0),
        (2.4925e-7, 2.437e-6, 36 * 3600.0),
    ],
)
def test_figures_27_to_30(a, b, span, count):
    """The report's simulated cases; it missed the first by 0.40 % in a and 2.0 % in b."""
    time = np.linspace(0, span, 1000)
    beam = np.array(current(time, 100.0, a, b))
    wrong = []
    for seed in range(count):
        noise = 0.02 * np.random.default_rng(seed).normal(size=time.size)
        fit = beamfit.fit_decay(DecayRecord(time, np.maximum(beam + noise, 0)))
        wrong.append([fit.a.value / a - 1, fit.b.value / b - 1])
        assert fit.status is Status.converged
    rms = np.sqrt(np.mean(np.square(wrong), axis=0))
    assert rms[0] < 0.0040
    assert rms[1] < 0.020
