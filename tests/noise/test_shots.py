"""Means of shots, of which some may show no beam."""

import numpy as np
import pytest

from beamfit.noise.model import Noise
from beamfit.noise.sizes import pooled_variance, shot_means


def shots_of(n=9, m=5, relative=0.02, seed=0):
    rng = np.random.default_rng(seed)
    true = np.linspace(0.6, 2.0, n)
    return true, true[:, None] * (1 + relative * rng.normal(size=(n, m)))


def test_good_shots_have_their_means_and_standard_errors():
    """Of 40 shots each the scatter is known to a few percent; a share of the size at each."""
    true, shots = shots_of(m=40)
    found = shot_means(shots, Noise())
    np.testing.assert_allclose(found.size, shots.mean(1), rtol=3e-3)
    np.testing.assert_allclose(found.error, 0.02 * true / np.sqrt(40), rtol=0.2)
    assert (found.bad > 0.5).sum() <= 2


@pytest.mark.parametrize("value", [0.0, 3.9, 1e-3])
def test_a_shot_that_shows_no_beam_is_found_and_left_out(value):
    _, shots = shots_of()
    spoilt = shots.copy()
    spoilt[4, 1] = value
    found, clean = shot_means(spoilt, Noise()), shot_means(shots, Noise())
    assert found.bad[4, 1] > 0.99
    others = np.delete(found.bad.ravel(), 4 * 5 + 1)
    assert others.max() < 0.9
    assert found.size[4] == pytest.approx(np.delete(shots[4], 1).mean(), rel=0.01)
    np.testing.assert_allclose(np.delete(found.size, 4), np.delete(clean.size, 4), rtol=2e-3)


def test_two_shots_that_differ_are_both_doubted_and_widen_the_error():
    """One of two is bad, and nothing says which: the mean is as uncertain as they differ."""
    _, shots = shots_of(m=2)
    spoilt = shots.copy()
    spoilt[3, 0] *= 1.5
    found = shot_means(spoilt, Noise())
    assert found.error[3] > 0.3 * abs(spoilt[3, 0] - spoilt[3, 1])


def test_shots_that_are_missing_count_nowhere():
    _, shots = shots_of()
    short = shots.copy()
    short[2, 3:] = np.nan
    found = shot_means(short, Noise())
    assert np.isnan(found.bad[2, 3:]).all()
    assert found.size[2] == pytest.approx(shots[2, :3].mean(), rel=0.01)
    assert found.error[2] > 1.15 * found.error[1] * found.size[2] / found.size[1]


def test_too_few_repeats_say_nothing():
    _, shots = shots_of(n=2, m=2)
    assert shot_means(shots, Noise()) is None
    assert shot_means(np.repeat(np.arange(1.0, 5.0)[:, None], 3, axis=1), Noise()) is None


def test_scatter_is_evened_out_towards_that_of_all_settings():
    """Twenty degrees of freedom of all stand beside a setting's own four."""
    freedom, size = np.full(5, 4.0), np.ones(5)
    square = np.array([4.0, 4.0, 4.0, 4.0, 16.0])
    pooled = square.sum() / freedom.sum()
    np.testing.assert_allclose(
        pooled_variance(square, freedom, size), (20 * pooled + square) / 24.0
    )


@pytest.mark.parametrize("power", [0, 1])
def test_plain_shots_are_good_ones(power):
    """SIMULATED normal shots, a share of the size or the same at each: none is surely bad."""
    rng, lost = np.random.default_rng(7), 0
    for _ in range(400):
        n, m = rng.integers(4, 16), rng.integers(3, 11)
        size = np.hypot(rng.uniform(0.05, 0.6), np.linspace(-2, 2, n) - rng.uniform(-1, 1))
        scatter = 10 ** rng.uniform(-3, -0.7) * np.median(size) ** (1 - power)
        shots = size[:, None] + scatter * (size**power)[:, None] * rng.normal(size=(n, m))
        lost += bool((shot_means(np.abs(shots)).bad > 0.99).any())
    assert lost <= 2


def test_two_of_three_shots_without_beam_leave_the_third():
    found = shot_means(np.array([[1.0, 1.02, 0.98], [2.0, 0.0, 0.0], [3.0, 2.94, 3.06]]))
    assert found.size[1] == pytest.approx(2.0, rel=0.01)
    assert found.bad[1, 1:].min() > 0.99
