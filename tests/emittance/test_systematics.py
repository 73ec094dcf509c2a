"""Errors of screen, beam and line as part of the error: against the budget, and on simulations."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom

import beamfit
from beamfit.emittance.systematics import systematics
from beamfit.errors import InputError
from beamfit.io.priors import read_systematics
from beamfit.optics.calibration import scaled
from beamfit.optics.elements import Drift, Screen
from beamfit.quantity import Status
from tests.emittance.conftest import TABLE_2, design, scan_of
from tests.simulations import simulations

KNOWN = {
    "size_scale": (None, 0.02),
    "energy": (None, 0.01),
    "Q2.gradient": (None, 0.01),
    "D1.length": (None, 0.01),
}


@pytest.fixture(scope="module")
def scan(gtf, gtf_sizes):
    currents, _, sizes = gtf_sizes
    return scan_of("Q2", "A", currents, sizes, 0.01, seed=4)


@pytest.fixture(scope="module")
def fit(gtf, scan):
    return beamfit.fit_emittance(scan, gtf, priors=KNOWN)


def test_the_error_is_that_of_the_budget_in_quadrature(gtf, scan, fit):
    """One standard deviation of each moves the emittance by what the budget says of it."""
    plain = beamfit.fit_emittance(scan, gtf)
    budget = {c.cause: c.normalized_emittance for c in systematics(plain, "x")}
    parts = {
        "size_scale": 2 * budget["screen scale +1 %"],
        "energy": budget["energy +1 %"],
        "Q2.gradient": budget["Q2 slope +1 %"],
        "D1.length": budget["drift D1 +1 cm"],
        "statistics": plain.x.normalized_emittance.relative,
    }
    total = math.sqrt(sum(v**2 for v in parts.values()))
    got = fit.x.normalized_emittance
    assert got.relative == pytest.approx(total, rel=0.03)
    assert got.value == pytest.approx(plain.x.normalized_emittance.value, rel=1e-3)
    assert "the largest systematic is size_scale with 4 %" in fit.x.message
    assert fit.x.status is Status.converged
    assert [p.name for p in fit.parameters] == list(KNOWN)


def test_nothing_known_of_a_resolution_is_part_of_the_error(gtf, scan):
    """A resolution of 10 ± 3 µm: subtracted, and its own error in that of the emittance."""
    blurred = gtf.with_element(Screen("SCREEN", resolution=1e-5))
    value = beamfit.fit_emittance(scan, blurred).x.normalized_emittance
    fit = beamfit.fit_emittance(scan, gtf, priors={"resolution": (1e-5, 3e-6)}).x
    assert fit.normalized_emittance.value == pytest.approx(value.value, rel=1e-3)
    assert fit.normalized_emittance.error > value.error


def test_a_round_wire_adds_a_quarter_of_its_diameter(gtf, gtf_sizes):
    """A uniform disc of diameter d, seen from the side, has an rms of d/4."""
    x = np.linspace(-1, 1, 200_001)
    weight = np.sqrt(1 - x**2)
    assert math.sqrt(weight @ x**2 / weight.sum()) == pytest.approx(0.5, rel=1e-4)  # d = 2
    currents, _, sizes = gtf_sizes
    thick = np.sqrt(sizes**2 + (4e-5 / 4) ** 2)
    scan = scan_of("Q2", "A", currents, thick)
    fit = beamfit.fit_emittance(scan, gtf, priors={"wire": (4e-5, 1e-6)}).x
    truth = math.sqrt(TABLE_2[0] * TABLE_2[2] - TABLE_2[1] ** 2)
    assert fit.emittance.value == pytest.approx(truth, rel=1e-3)


def test_dispersion_of_the_incoming_beam(gtf, gtf_sizes):
    """η = 5 cm at a spread of 0.2 % at the start, carried through the line."""
    currents, _, sizes = gtf_sizes
    r11 = np.array([float(gtf.matrix({"Q2": c}).x[0, 0]) for c in currents])
    wide = np.sqrt(sizes**2 + (r11 * 0.05 * 2e-3) ** 2)
    line = replace(gtf, energy_spread=2e-3)
    scan = scan_of("Q2", "A", currents, wide)
    truth = math.sqrt(TABLE_2[0] * TABLE_2[2] - TABLE_2[1] ** 2)
    wrong = beamfit.fit_emittance(scan, line).x.emittance
    right = beamfit.fit_emittance(scan, line, priors={"dispersion": (0.05, 1e-3)}).x.emittance
    assert right.value == pytest.approx(truth, rel=2e-3)
    assert abs(wrong.value - truth) > 5 * wrong.error
    with pytest.raises(InputError, match="momentum spread"):
        beamfit.fit_emittance(scan, gtf, priors={"dispersion": (0.05, 1e-3)})


@simulations(24, 500)
def test_total_errors_cover(gtf, count):
    """Line, energy and screen wrong by what is known of them: the truth is in interval_95."""
    currents, random = np.linspace(0.0, 3.9, 14), np.random.default_rng(3)
    truth = math.sqrt(TABLE_2[0] * TABLE_2[2] - TABLE_2[1] ** 2)
    inside = one = 0
    for _ in range(count):
        shift = {name: sd * random.normal() for name, (_, sd) in KNOWN.items()}
        magnet = gtf["Q2"]
        own = scaled(magnet.calibration, 1 + shift["Q2.gradient"])
        line = gtf.with_element(replace(magnet, calibration=own))
        line = line.with_element(Drift("D1", gtf["D1"].length + shift["D1.length"]))
        line = replace(line, energy=gtf.energy * (1 + shift["energy"]))
        sizes = np.sqrt(design(line, {"Q2": currents}) @ TABLE_2) * (1 + shift["size_scale"])
        size = sizes * (1 + 0.01 * random.normal(size=14))
        scan = beamfit.QuadScan({"Q2": currents}, {"Q2": "A"}, {"x": size}, {"x": 0.01 * sizes})
        q = beamfit.fit_emittance(scan, gtf, priors=KNOWN).x.emittance
        inside += q.interval_95[0] < truth < q.interval_95[1]
        one += abs(q.value - truth) < q.error
    low, high = binom.ppf([0.001, 0.999], count, 0.95)
    assert low <= inside <= high
    low, high = binom.ppf([0.001, 0.999], count, 0.683)
    assert low <= one <= high


def test_the_posterior_has_them_too(fit):
    found = fit.sample(seed=1, target_ess=600)
    assert "size_scale" in found.names
    q, linear = found["x.normalized_emittance"], fit.x.normalized_emittance
    assert q.error == pytest.approx(linear.error, rel=0.1)
    assert abs(q.value - linear.value) < 0.3 * linear.error


def test_a_calibration_and_a_screen_together(gtf, scan):
    priors = {"Q2.slope": (167.23, 1.67), "size_scale": (None, 0.02)}
    both = beamfit.fit_emittance(scan, gtf, scenario="calibration", priors=priors).x
    alone = beamfit.fit_emittance(
        scan, gtf, scenario="calibration", priors={"Q2.slope": (167.23, 1.67)}
    ).x
    expected = math.hypot(alone.emittance.relative, 0.04)
    assert both.emittance.relative == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("size_scale = -1", "a standard deviation, or a list"),
        ("size_skale = 0.1", "did you mean size_scale"),
        ('size_scale = "x"', "a number or a list"),
        ("[gradient]\nQ2 = [1]", "a standard deviation, or a list"),
        ("gradient = 1", "a table"),
        ("# nothing", "says nothing"),
        ('format = "beamfit-lattice-1"\nenergy = 0.1', "beamfit-systematics-1"),
    ],
)
def test_a_file_that_cannot_be_used_is_refused_in_words(tmp_path, text, words):
    path = tmp_path / "known.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=words):
        read_systematics(path)


@pytest.mark.parametrize(
    ("priors", "options", "words"),
    [
        ({"Q9.gradient": (None, 0.1)}, {}, "Q2"),
        ({"D9.length": (None, 0.1)}, {}, "D1"),
        ({"wire": (None, 1e-6)}, {}, "diameter"),
        ({"energy": (None, 0.1)}, {"scenario": "transport-network"}, "size_scale"),
        ({"size_scale": (1.0, 0.0)}, {}, "positive deviation"),
    ],
)
def test_priors_that_do_not_fit_are_refused(gtf, scan, priors, options, words):
    with pytest.raises(InputError, match=words):
        beamfit.fit_emittance(scan, gtf, priors=priors, **options)
