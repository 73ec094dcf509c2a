"""Each move leaves the posterior as it is: draws that begin exact stay exact.

Walkers are put at independent draws from a known posterior and moved many times by one kind of
move. Their distribution must not change; a wrong acceptance ratio shows as a drift.
"""

from __future__ import annotations

import emcee
import numpy as np
import pytest
from scipy import stats

from beamfit.sampling.moves import Widening, fit_proposal, mix_moves, proposal_about
from tests.sampling.targets import PEAKS, banana, bimodal, exact_draws, half_normal, target

WALKERS, STEPS = 2000, 30
PLAIN = Widening(np.zeros(2), np.array([-1, -1]))
BLOCK = (np.array([0, 1]),)


def moved(density, moves, seed):
    start = exact_draws(density, WALKERS, seed)
    stated = target(density)
    sampler = emcee.EnsembleSampler(WALKERS, 2, stated.log_probability, moves=moves, vectorize=True)
    state = emcee.State(start, random_state=np.random.RandomState(seed).get_state())
    return sampler.run_mcmc(state, STEPS).coords, float(sampler.acceptance_fraction.mean())


@pytest.mark.parametrize("density", [banana, half_normal, bimodal])
@pytest.mark.parametrize("which", range(4))
def test_exact_draws_stay_exact(density, which):
    proposal = fit_proposal(exact_draws(density, 4000, 9), proposal_about(np.eye(2), PLAIN, BLOCK))
    move = mix_moves(proposal, 0.9)[which][0]
    found, accepted = moved(density, [(move, 1.0)], seed=20 + which)
    assert accepted > 0.05
    exact = exact_draws(density, 200_000, 77)
    for i in range(2):
        assert stats.ks_2samp(found[:, i], exact[:, i]).pvalue > 1e-3


def test_a_wrong_ratio_would_be_seen():
    """The same check on a leap that forgets its own density."""
    proposal = fit_proposal(
        exact_draws(half_normal, 4000, 9), proposal_about(np.eye(2), PLAIN, BLOCK)
    )

    def forgetful(coords, random):
        return proposal.draw(random, len(coords)), np.zeros(len(coords))

    found, _ = moved(half_normal, [(emcee.moves.MHMove(forgetful), 1.0)], seed=20)
    exact = exact_draws(half_normal, 200_000, 77)
    assert stats.ks_2samp(found[:, 0], exact[:, 0]).pvalue < 1e-6


def test_the_density_of_a_proposal_is_that_of_its_draws():
    """By importance: the mean of f/q over draws from q is the integral of f, widening included."""
    widening = Widening(np.array([1.0, 2.0, 0.5]), np.array([2, 2, -1]))
    covariance = np.array([[1.0, 0.3, 0.0], [0.3, 0.5, 0.0], [0.0, 0.0, 0.09]])
    proposal = proposal_about(covariance, widening, (np.array([0, 1]), np.array([2])), 6.0)
    points = proposal.draw(np.random.RandomState(4), 400_000)
    known = stats.multivariate_normal([1.3, 1.8, 0.4], np.diag([0.5, 0.3, 0.02]))
    weight = np.exp(known.logpdf(points) - proposal.log_density(points))
    error = weight.std() / np.sqrt(len(weight))
    assert error < 0.01
    assert abs(weight.mean() - 1.0) < 4 * error


def test_widening_is_undone():
    widening = Widening(np.array([1.0, 2.0, 0.5]), np.array([2, 2, -1]))
    points = np.random.default_rng(1).normal(size=(20, 3))
    np.testing.assert_allclose(widening.from_scaled(widening.to_scaled(points)), points, rtol=1e-12)


def test_numbers_of_very_different_size_are_fitted():
    scale = np.array([1e2, 1e-8, 1e-7])
    draws = np.random.default_rng(1).normal(size=(5000, 3)) * scale
    plain = Widening(np.zeros(3), np.full(3, -1))
    found = fit_proposal(draws, proposal_about(np.diag(scale**2), plain, (np.arange(3),))).parts[0]
    width = np.sqrt(np.diag(found.root @ found.root.T) * found.degrees / (found.degrees - 2))
    np.testing.assert_allclose(width, scale, rtol=0.05)


def test_both_peaks_are_visited():
    first, second, _, weight = PEAKS
    found, _ = moved(bimodal, mix_moves(proposal_about(9 * np.eye(2), PLAIN, BLOCK), 0.5), 3)
    share = np.mean(found[:, 0] < 0.5 * (first + second))
    assert abs(share - weight) < 5 * np.sqrt(weight * (1 - weight) / WALKERS)
