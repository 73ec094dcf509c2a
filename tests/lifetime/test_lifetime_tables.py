"""Tables of lifetimes against current. All are simulated."""

import json

import numpy as np
import pytest
from scipy.optimize import curve_fit
from scipy.special import stdtrit

from beamfit.lifetime.lifetime_table import fit_lifetimes
from beamfit.lifetime.record import LifetimeTable
from tests.simulations import simulations, widened

A, B = 1e-4, 0.01  # 1/(mA h), 1/h
CURRENT = np.linspace(100, 500, 20)


def table(seed=1, noise=0.1, stated=True, current=CURRENT, law=None):
    lifetime = 1 / (A * current + B) if law is None else law(current)
    measured = lifetime + noise * np.random.default_rng(seed).normal(size=current.size)
    return LifetimeTable(current, measured, np.full(current.size, noise) if stated else None)


def test_against_scipy():
    readings = table()
    fit = fit_lifetimes(readings)
    best, covariance = curve_fit(
        lambda i, a, b: 1 / (a * i + b), CURRENT, readings.lifetime, [A, B], readings.error, True
    )
    assert fit.status == "converged"
    found = np.array([fit.a.value, fit.b.value]) * 3600
    raw = np.array([fit.a.error_raw, fit.b.error_raw]) * 3600
    np.testing.assert_allclose(found, best, rtol=1e-5)
    np.testing.assert_allclose(raw, np.sqrt(np.diag(covariance)), rtol=1e-3)
    chi2 = np.sum(((1 / (best[0] * CURRENT + best[1]) - readings.lifetime) / 0.1) ** 2)
    assert fit.chi2 == pytest.approx(chi2, rel=1e-6)
    assert fit.dof == 18


@pytest.mark.parametrize("slope", [-0.39, -0.27])
def test_the_laws_of_the_iota_tables_are_rejected(slope):
    """Twenty lifetimes of some 15 minutes with errors of 5 s, as in two published tables. They are
    those of an a that goes as I^(-1 - slope) alone, which the free law finds.
    """
    current = np.linspace(0.3, 2.5, 20)
    law = lambda i: 900 / 3600 * i**slope  # noqa: E731
    readings = table(noise=5 / 3600, current=current, law=law)
    assert fit_lifetimes(readings, law="constant").status in ("poor_fit", "infeasible")
    fit = fit_lifetimes(readings)
    assert fit.constant_a.status == "poor_fit"
    assert f"a goes as I^({fit.free_law.exponent})" in fit.message
    assert abs(fit.free_law.exponent.value - (-1 - slope)) < 4 * fit.free_law.exponent.error
    assert fit.b.interval_95[0] <= 0 < fit.b.interval_95[1]
    true = law(np.array(fit.lifetimes.current))
    pulls = [(q.value - t) / q.error for q, t in zip(fit.lifetimes.lifetime, true, strict=True)]
    assert np.abs(pulls).max() < 4


@simulations(20, 60)
def test_errors_of_the_constant_law_cover(count):
    fits = [fit_lifetimes(table(seed), law="constant") for seed in range(count)]
    # A constant a is rejected in one of a thousand such tables.
    assert sum(fit.status == "converged" for fit in fits) >= count - 2
    for name, true in (("a", A / 3600), ("b", B / 3600)):
        off = [abs(getattr(f, name).value - true) / getattr(f, name).error for f in fits]
        assert abs(np.mean(np.array(off) < 1) - 0.675) < widened(0.175, 60, count)
        assert np.mean(np.array(off) < 1.96) > 0.95 - widened(0.07, 60, count)


def departing(rng, stated):
    """A table whose exponent and change of b are drawn from their priors, and its true numbers."""
    count, high = int(rng.integers(6, 25)), rng.uniform(100.0, 500.0)
    current = np.linspace(high / rng.uniform(2.0, 10.0), high, count)
    mean, span = current.mean(), np.ptp(current)
    power, share, rate = rng.uniform(-0.4, 0.2), rng.uniform(0.05, 0.95), 1 / rng.uniform(2, 50)
    gas = (1 - share) * (1 + 0.1 * rng.normal() * (current - mean) / span)
    lifetime = 1 / (rate * (share * (current / mean) ** (1 + power) + gas))
    error = lifetime * 10 ** rng.uniform(-2.7, -1.3)
    measured = lifetime + error * rng.normal(size=count)
    true = {"a": rate * share / mean / 3600, "b": rate * (1 - share) / 3600}
    true |= {"lifetime_start": lifetime[-1], "lifetime_end": lifetime[0]}
    return LifetimeTable(current, measured, error if stated else None), true


@pytest.mark.parametrize("stated", [True, False])
@simulations(40, 200)
def test_intervals_hold_where_a_and_b_depart_within_their_priors(stated, count):
    rng, off, held = np.random.default_rng(3), [], []
    for _ in range(count):
        readings, true = departing(rng, stated)
        fit = fit_lifetimes(readings)
        for name, value in true.items():
            if (found := getattr(fit, name)).error is not None:
                off.append(abs(found.value - value) / found.error)
                held.append(found.interval_95[0] <= value <= found.interval_95[1])
    assert len(held) > 3 * count
    assert np.mean(held) > 0.95 - widened(0.05, 200, count)
    assert np.mean(np.array(off) < 4) > 0.97


def test_the_posterior_equals_draws_from_the_prior():
    """Importance sampling with the likelihood written out, its noise level integrated over."""
    rng, draws = np.random.default_rng(1), 400_000
    current = np.linspace(60.0, 300.0, 8)
    x, known = current / current.mean(), 8.0
    lifetime = 10 / (0.5 * x**0.8 + 0.5)
    error = 0.02 * lifetime
    measured = lifetime + error * rng.normal(size=8)
    fit = fit_lifetimes(LifetimeTable(current, measured, error))
    side = np.where(rng.random(draws) < 0.6, -0.3, 0.2)
    power = side * np.abs(rng.normal(size=draws))
    flat = rng.random(draws) < 0.05
    power[flat] = rng.uniform(-0.9, 2.0, flat.sum())
    share, change = rng.random(draws), 0.1 * rng.normal(size=draws)
    gas = (1 - share)[:, None] * (1 + change[:, None] * (x - 1) / np.ptp(x))
    shape = 1 / (share[:, None] * x ** (1 + power[:, None]) + gas)
    factor = 10 * (1 + 0.05 * rng.normal(size=draws))
    squares = np.sum(((measured - factor[:, None] * shape) / error) ** 2, axis=1)
    log = -0.5 * (8 + known) * np.log(known + squares) - np.log(factor)
    log += 0.5 * ((factor / 10 - 1) / 0.05) ** 2
    weight = np.where(np.abs(power - 0.55) < 1.45, np.exp(log - log.max()), 0.0)
    assert weight.sum() ** 2 / np.sum(weight**2) > 2000
    for found, values in (
        (fit.free_law.share, share),
        (fit.free_law.exponent, power),
        (fit.free_law.quantities["b"].to("1/h"), (1 - share) / factor),
        (fit.free_law.quantities["lifetime_end"], factor * shape[:, 0]),
    ):
        order = np.argsort(values)
        below = np.cumsum(weight[order]) / weight.sum()
        low, middle, high = np.interp([0.16, 0.5, 0.84], below, values[order])
        assert found.error == pytest.approx((high - low) / 2, rel=0.06)
        assert abs(found.value - middle) < 0.06 * found.error


def test_errors_of_equal_shares_are_recognised():
    """Without stated errors, those that grow with the lifetime are: the highest current is best."""
    rng, current = np.random.default_rng(4), np.linspace(50.0, 500.0, 30)
    lifetime = 30 / (0.9 * current / current.mean() + 0.1)
    measured = lifetime * (1 + 0.02 * rng.normal(size=30))
    stated, given = (
        fit_lifetimes(LifetimeTable(current, measured, error)) for error in (0.02 * lifetime, None)
    )
    assert given.lifetime_start.error == pytest.approx(stated.lifetime_start.error, rel=0.3)
    assert given.lifetime_end.error == pytest.approx(stated.lifetime_end.error, rel=0.3)


def test_intervals_are_students_where_the_scatter_tells_the_noise():
    """Six points without errors: four degrees of freedom, and t reaches 2.78 errors."""
    current = np.linspace(100, 500, 6)
    for stated, reach in ((False, stdtrit(4, 0.975)), (True, 1.96)):
        fit = fit_lifetimes(table(stated=stated, current=current), law="constant")
        assert fit.dof == 4
        for q in (fit.a, fit.b, fit.lifetime_start, fit.lifetime_mean, fit.lifetime_end, fit.share):
            assert q.interval_95[1] - q.value == pytest.approx(reach * q.error, rel=1e-9)


def test_an_outlier_is_left_out_and_named():
    readings = table()
    wrong = readings.lifetime.copy()
    wrong[4] *= 1.3
    fit = fit_lifetimes(LifetimeTable(CURRENT, wrong, readings.error))
    assert fit.outliers == (4,)
    assert "Left out as outliers: point 5" in fit.message
    assert fit.a.value == pytest.approx(fit_lifetimes(readings).a.value, rel=0.01)


@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize("slip", [0.1, 2.0, 10.0])
def test_a_lifetime_in_another_unit_or_digit_is_left_out(slip, stated):
    """The error is that of the right one: the others must not be sacrificed to a precise slip."""
    rng = np.random.default_rng(int(10 * slip))
    for _ in range(5):
        readings, true = departing(rng, True)
        place, lifetime = int(rng.integers(len(readings))), readings.lifetime.copy()
        lifetime[place] *= slip
        error = readings.error if stated else None
        fit = fit_lifetimes(LifetimeTable(readings.current, lifetime, error))
        assert fit.outliers == (place,)
        low, high = fit.lifetime_start.interval_95
        assert low - 0.02 * high < true["lifetime_start"] < 1.02 * high


def test_good_tables_are_not_told_to_measure_again():
    rng = np.random.default_rng(8)
    said = 0
    for count in (4, 5, 6, 8) * 6:
        current = np.linspace(100.0, 400.0, count)
        lifetime = (1 + 0.01 * rng.normal(size=count)) / (1e-4 * current + 0.01)
        said += "measure it again" in fit_lifetimes(LifetimeTable(current, lifetime)).message
    assert said <= 1


def test_errors_stated_at_a_third_are_not_believed():
    """Of 15 points the scatter says so: intervals are those of the right errors."""
    rng, ratios = np.random.default_rng(6), []
    for _ in range(6):
        lifetime = 1 / (A * CURRENT + B)
        measured = lifetime * (1 + 0.01 * rng.normal(size=20))
        small, right = (
            fit_lifetimes(LifetimeTable(CURRENT, measured, share * lifetime))
            for share in (0.01 / 3, 0.01)
        )
        ratios.append(small.lifetime_mean.error / right.lifetime_mean.error)
    assert 0.8 < np.mean(ratios) < 1.25


def test_currents_too_close_do_not_separate():
    fit = fit_lifetimes(table(current=np.linspace(495, 500, 20), noise=0.3))
    assert fit.status == "unidentified"
    assert "wider range of currents" in fit.message
    assert fit.a.error is None
    assert fit.lifetime_mean.error < 0.2


def test_exact_and_equal_lifetimes_refute_nothing():
    """What is left is the arithmetic's, and no law."""
    fit = fit_lifetimes(LifetimeTable([100, 200, 300, 400], [50.0] * 4))
    assert fit.status == "converged"
    assert fit.lifetime_mean.value == pytest.approx(50, rel=1e-9)
    assert 0 < fit.lifetime_mean.error < 1e-9


def test_one_current_alone_says_so_without_nan():
    fit = fit_lifetimes(LifetimeTable([100.0] * 5, [50, 51, 49, 50.5, 50.2]))
    assert fit.status == "unidentified"
    assert "nan" not in fit.message


def test_json_keeps_the_contract():
    document = json.loads(json.dumps(fit_lifetimes(table(stated=False)).to_json(), allow_nan=False))
    wanted = "record status message a b i0 lifetime_start lifetime_end lifetime_mean chi2 dof"
    assert {*wanted.split(), "identifiability"} <= set(document)
    assert document["noise_inferred"]
    assert document["chi2"] == document["dof"]
    assert "The table gives no errors" in document["message"]
