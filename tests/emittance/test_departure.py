"""A smooth departure from a beam's sizes, as of a screen that lifts the small ones."""

import numpy as np
import pytest
from scipy.special import logsumexp

from beamfit.emittance.beam_draws import coordinates
from beamfit.emittance.comparison import (
    DEPARTURE_AMPLITUDES,
    DEPARTURE_LENGTH,
    PlaneSizes,
    compare,
    departure_odds,
)
from beamfit.emittance.verdict import SURE
from beamfit.noise.model import Noise
from beamfit.noise.sizes import kinds_of, prior_scales
from tests.noise.reference import log_of_one_bad
from tests.simulations import simulations


def dense_odds(off, slopes, model, far, deviation, log_weight):
    """Log odds of a smooth departure by covariances written out, the beam's three numbers with a
    prior so wide that it is flat; ``deviation`` is that of every point at each scale of the noise.
    """

    def log_of(amplitude):
        bend = (1 + far / DEPARTURE_LENGTH) * np.exp(-far / DEPARTURE_LENGTH)
        wide = amplitude**2 * bend * np.outer(model, model) + 1e4 * slopes @ slopes.T
        each = [np.diag(sd**2) + wide for sd in deviation]
        both = zip(each, deviation, strict=True)
        return logsumexp([log_of_one_bad(off, c, sd, Noise()) for c, sd in both] + log_weight)

    both = [log_of(amplitude) for amplitude in DEPARTURE_AMPLITUDES]
    return logsumexp(both) - np.log(len(both)) - log_of(0.0)


def test_odds_are_those_of_dense_covariances():
    rng = np.random.default_rng(2)
    u = np.column_stack([np.linspace(-2.0, 2.0, 9), np.ones(9)])
    size = np.sqrt(1.0 + 2.0 * u[:, 0] ** 2) * (1 + 0.03 * rng.normal(size=9))
    c = coordinates(u[None, :, 0], u[None, :, 1], size[None], np.zeros((1, 9)))
    kind = kinds_of(Noise(), c.size, 0.02 * c.size)[0]
    x = np.linalg.lstsq(c.rows[0], c.size[0] ** 2, rcond=None)[0]
    model = np.sqrt(c.rows[0] @ x)
    slopes = c.rows[0] / (2 * model)[:, None]
    scales = prior_scales(kind, (1,))
    rank = np.argsort(np.argsort(c.w[0, :, 0] / c.w[0, :, 1]))
    far = np.abs(np.subtract.outer(rank, rank)) / 9
    deviation = scales.scale[0][:, None] * kind.unit[0] * model
    expected = dense_odds(c.size[0] - model, slopes, model, far, deviation, scales.log_weight[0])
    assert np.isclose(departure_odds(x[None], u[None], c, kind, Noise())[0], expected, atol=1e-3)


def probability(size, share, seed):
    """Of a beam, with errors that are right, of 20 settings that see the waist from both sides."""
    noisy = size * (1 + share * np.random.default_rng(seed).normal(size=size.size))
    ones = np.ones(size.size)
    plane = PlaneSizes(SETTINGS, ones, 0.0 * ones, 1e-4 * noisy, 1e-4 * share * noisy, False, True)
    return compare([plane], Noise())[0].probability["beam"]


SETTINGS = np.sqrt(0.1) * np.tan(np.linspace(-1.35, 1.35, 20))
WAIST = np.sqrt(0.1 + SETTINGS**2)


@simulations(8, 100)
def test_lifted_small_sizes_are_no_beam(count):
    """A screen that shows no size below 1.7 times the waist."""
    lifted = np.maximum(WAIST, 1.7 * WAIST.min())
    assert max(probability(lifted, 0.02, seed) for seed in range(count)) < SURE


@simulations(8, 100)
@pytest.mark.parametrize("slip", [10.0, 0.1])
def test_a_slip_buys_lifted_sizes_no_answer(slip, count):
    """Rivals have bad readings as a beam has: a curve with one is still a curve."""
    lifted = np.maximum(WAIST, 1.7 * WAIST.min())
    lifted[0] *= slip
    assert np.median([probability(lifted, 0.02, seed) for seed in range(count)]) < SURE


@simulations(8, 100)
def test_sizes_of_a_beam_do_not_depart(count):
    """Whether the noise would hide a departure or show it."""
    for share in (0.02, 0.1):
        found = [probability(WAIST, share, seed) for seed in range(count)]
        assert np.mean(np.array(found) > 0.99) >= 0.95
