"""Draws of a beam tell its posterior: enough of them have weight, however small the noise is."""

import numpy as np
import pytest

import beamfit
from beamfit.optics.beamline import Beamline
from beamfit.optics.elements import Drift, Quadrupole, Screen

LINE = Beamline(
    (Drift("D0", 0.5), Quadrupole("Q1", 0.15), Drift("D1", 1.0), Screen("S1")), energy=50.0
)


def simulated(noise, gradients, seed, sigma):
    """A SIMULATED scan of LINE by sizes with a share of noise, errors not stated."""
    r = np.array([np.asarray(LINE.matrix({"Q1": g}).x)[0, :2] for g in gradients])
    size = np.sqrt(np.einsum("ni,ij,nj->n", r, sigma, r))
    size = size * (1 + noise * np.random.default_rng(seed).normal(size=size.size))
    return beamfit.QuadScan({"Q1": gradients}, {"Q1": "k1"}, {"x": size})


def posterior(*told):
    scan = simulated(*told)
    fit = beamfit.fit_emittance(scan, LINE)
    return fit, fit.seen.solutions["x"].posterior


@pytest.mark.parametrize("noise", [1e-6, 1e-4, 1e-3, 1e-2])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_draws_are_worth_a_hundred_whatever_the_noise(noise, seed):
    """They were ten times too wide beside noise that is far below the usual: worth 4 or 5."""
    sigma = 1e-8 * np.array([[4.0, -1.0], [-1.0, 1.0]])
    _, found = posterior(noise, np.linspace(0.2, 2.2, 11), seed, sigma)
    assert found.effective_draws > 100


@pytest.mark.parametrize("points", [4, 5])
@pytest.mark.parametrize("noise", [1e-5, 1e-3])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_peak_of_right_errors_is_drawn_beside_wide_ones(points, noise, seed):
    """One width was for both: draws were worth 2 to 66, errors up to thousands of times off."""
    sigma = 1e-8 * np.array([[4.0, -1.0], [-1.0, 1.0]])
    gradients = np.linspace(0.2, 8.0, points)
    each = simulated(0.0, gradients, seed, sigma).size["x"][:, None]
    shots = each * (1 + noise * np.random.default_rng(seed).normal(size=(points, 5)))
    sizes, single = {"x": shots.mean(1)}, {"x": shots}
    scan = beamfit.QuadScan({"Q1": gradients}, {"Q1": "k1"}, sizes, shot_size=single)
    fit = beamfit.fit_emittance(scan, LINE)
    assert fit.seen.solutions["x"].posterior.effective_draws > 100
    truth, found = np.sqrt(np.linalg.det(sigma)), fit.x.emittance
    assert found.error < 5 * noise * found.value
    assert found.interval_95[0] < truth < found.interval_95[1]


def test_what_fits_as_no_beam_is_drawn_about_the_nearest_one():
    """A scan of a few degrees far from the waist does not tell an emittance; three draws did."""
    beta, alpha, emittance = 3.0, 1.0, 6e-7
    gamma = (1 + alpha**2) / beta
    sigma = emittance * np.array([[beta, -alpha], [-alpha, gamma]])
    for seed in range(4):
        fit, _ = posterior(6e-4, np.linspace(-0.15, 0.3, 15), seed, sigma)
        low, high = fit.x.emittance.interval_95
        assert low < emittance < high
        assert fit.x.status.value == "unidentified"
