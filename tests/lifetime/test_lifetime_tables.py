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
    """Twenty lifetimes of some 15 minutes with errors of 5 s, as in two published tables."""
    current = np.linspace(0.3, 2.5, 20)
    law = lambda i: 900 / 3600 * i**slope  # noqa: E731
    fit = fit_lifetimes(table(noise=5 / 3600, current=current, law=law))
    assert fit.status in ("poor_fit", "infeasible")
    true = law(np.array(fit.lifetimes.current))
    pulls = [(q.value - t) / q.error for q, t in zip(fit.lifetimes.lifetime, true, strict=True)]
    assert np.abs(pulls).max() < 4


@simulations(20, 60)
def test_errors_cover(count):
    fits = [fit_lifetimes(table(seed)) for seed in range(count)]
    # A constant a is rejected in one of a thousand such tables.
    assert sum(fit.status == "converged" for fit in fits) >= count - 2
    for name, true in (("a", A / 3600), ("b", B / 3600)):
        off = [abs(getattr(f, name).value - true) / getattr(f, name).error for f in fits]
        assert abs(np.mean(np.array(off) < 1) - 0.675) < widened(0.175, 60, count)
        assert np.mean(np.array(off) < 1.96) > 0.95 - widened(0.07, 60, count)


def test_intervals_are_students_where_the_scatter_tells_the_noise():
    """Six points without errors: four degrees of freedom, and t reaches 2.78 errors."""
    current = np.linspace(100, 500, 6)
    for stated, reach in ((False, stdtrit(4, 0.975)), (True, 1.96)):
        fit = fit_lifetimes(table(stated=stated, current=current))
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
