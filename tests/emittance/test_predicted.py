"""Sizes at other settings and correlations of a fit, against repeated simulated scans."""

from dataclasses import replace

import numpy as np
import pytest

import beamfit
from beamfit.emittance.design import plan_measurements
from beamfit.errors import InputError
from beamfit.optics.elements import Drift
from tests.simulations import simulations, widened

EMITTANCE, BETA, ALPHA, K1 = 2e-9, 6.0, 0.5, np.linspace(-2.0, 12.0, 9)
OTHER = np.array([-3.0, 1.1, 5.0, 13.0])


@pytest.fixture(scope="module")
def line():
    elements = (
        beamfit.Quadrupole("Q", 0.1),
        Drift("D", 1.0),
        beamfit.Screen("A", 15e-6),
        Drift("E", 1.0),
        beamfit.Screen("B"),
    )
    return beamfit.Beamline(elements, 135.0)


def true_sizes(k1, drift, resolution=0.0):
    """Thick lens and drift written out anew."""
    root = np.sqrt(np.asarray(k1, complex))
    c, s = np.cos(root * 0.1).real, (np.sin(root * 0.1) / root).real
    r11, r12 = c - drift * k1 * s, s + drift * c
    gamma = (1 + ALPHA**2) / BETA
    square = r11**2 * BETA - 2 * r11 * r12 * ALPHA + r12**2 * gamma
    return np.sqrt(EMITTANCE * square + resolution**2)


def scan_of(rng, noise):
    true = true_sizes(K1, 2.0)
    sizes = true * (1 + noise * rng.normal(size=K1.size))
    return beamfit.QuadScan({"Q": K1}, {"Q": "k1"}, {"x": sizes}, {"x": noise * true})


def test_without_noise_the_truth_is_predicted_at_any_screen(line):
    fit = beamfit.fit_emittance(scan_of(np.random.default_rng(1), 1e-9), line)
    np.testing.assert_allclose(fit.predict({"Q": OTHER}).size, true_sizes(OTHER, 2.0), rtol=1e-6)
    at_a = fit.predict({"Q": OTHER}, "x", screen="A")
    np.testing.assert_allclose(at_a.size, true_sizes(OTHER, 1.0, 15e-6), rtol=1e-6)
    assert (at_a.plane, at_a.screen) == ("x", "A")
    one = fit.predict({"Q": 5.0})
    assert one.size.shape == (1,)
    assert one.size[0] == pytest.approx(true_sizes(5.0, 2.0), rel=1e-6)


@simulations(80, 400)
def test_errors_and_correlations_are_those_of_repeated_scans(line, count):
    rng, found, numbers, pulls = np.random.default_rng(4), [], [], []
    for _ in range(count):
        fit = beamfit.fit_emittance(scan_of(rng, 0.01), line)
        predicted = fit.predict({"Q": OTHER})
        pulls.append((predicted.size - true_sizes(OTHER, 2.0)) / predicted.error)
        found.append(predicted.size)
        q = fit.x
        sigma = [each.value for each in q.sigma]
        numbers.append([*sigma, q.emittance.value, q.beta.value, q.alpha.value])
    np.testing.assert_allclose(np.std(pulls, axis=0), 1.0, atol=widened(0.15, 400, count))
    names, values = fit.correlations()
    assert names == ("sigma11", "sigma12", "sigma22", "emittance", "beta", "alpha")
    np.testing.assert_allclose(
        values, np.corrcoef(np.transpose(numbers)), atol=widened(0.12, 400, count)
    )
    np.testing.assert_allclose(np.diagonal(values), 1.0)


def test_a_calibration_widens_the_emittance_and_not_what_settings_give(root):
    """Another slope with another beam gives the same sizes, inside the scan and near it."""
    scan = beamfit.read_quad_scan(root / "measurements/gtf_simulated.csv")
    line = beamfit.load_lattice(root / "lattices/gtf.toml")
    known = beamfit.fit_emittance(scan, line)
    prior = {"Q2.slope": (167.23, 3.3446)}
    open_ = beamfit.fit_emittance(scan, line, scenario="calibration", priors=prior)
    at = {"Q2": np.array([2.0, 6.0])}
    narrow, wide = known.predict(at), open_.predict(at)
    np.testing.assert_allclose(wide.error, narrow.error, rtol=0.1)
    assert open_.x.emittance.error > known.x.emittance.error
    np.testing.assert_allclose(wide.size[0], narrow.size[0], atol=3 * wide.error[0])


def test_what_is_not_determined_has_no_error(line):
    sizes = {"x": true_sizes(K1, 2.0)[:3]}
    same = beamfit.QuadScan({"Q": [1.0, 1.0 + 1e-9, 1.0 + 2e-9]}, {"Q": "k1"}, sizes)
    fit = beamfit.fit_emittance(same, line)
    assert fit.x.status.value == "unidentified"
    assert np.isnan(fit.predict({"Q": 8.0}).error).all()
    assert np.isnan(fit.correlations().values).all()


def test_what_cannot_be_asked_is_said(line, root):
    fit = beamfit.fit_emittance(scan_of(np.random.default_rng(1), 0.01), line)
    with pytest.raises(InputError, match="no magnet 'P'"):
        fit.predict({"P": 1.0})
    with pytest.raises(InputError, match="no fit of plane 'y'"):
        fit.predict({"Q": 1.0}, "y")
    with pytest.raises(InputError, match="no screen 'C'"):
        fit.predict({"Q": 1.0}, screen="C")
    with pytest.raises(InputError, match="one length"):
        fit.predict({"Q": [1.0, 2.0], "R": [1.0, 2.0, 3.0]})
    rows = beamfit.QuadScan(
        {}, {}, {"x": [1e-4, 2e-4, 3e-4]}, energy=[9.0] * 3,
        transfer={"x": np.array([[1.0, 0.0], [1.0, 1.0], [1.0, 3.0]])},
    )  # fmt: skip
    with pytest.raises(InputError, match="the measured rows alone"):
        beamfit.fit_emittance(rows).predict({})


def test_a_scans_own_resolution_and_spread_hold_for_further_rows_on_its_screen(line):
    """In `predict` as in `design`; other screens keep what the line says of them."""
    plain = scan_of(np.random.default_rng(1), 1e-2)
    wide = {"x": np.hypot(plain.size["x"], 40e-6)}
    told = replace(plain, size=wide, resolution=np.full(K1.size, 40e-6))
    of_scan = beamfit.fit_emittance(told, line)
    of_line = beamfit.fit_emittance(
        replace(told, resolution=None), line.with_element(beamfit.Screen("B", 40e-6))
    )
    for screen in ("A", "B"):
        both = [fit.predict({"Q": OTHER}, screen=screen).size for fit in (of_scan, of_line)]
        np.testing.assert_allclose(*both, rtol=1e-9)
    steps = [plan_measurements(fit, count=2).steps for fit in (of_scan, of_line)]
    for one, other in zip(*steps, strict=True):
        assert one.candidate == other.candidate
        assert one.relative_error == pytest.approx(other.relative_error, rel=1e-9)
