import numpy as np
import pytest
from scipy.linalg import cholesky, solve_triangular, toeplitz
from scipy.signal import lfilter
from scipy.stats import multivariate_normal

from beamfit.noise.correlated import reach_of_probability, usual_noises, whitened_by_each
from beamfit.noise.memory import (
    POWERS,
    CorrelatedNoise,
    Levels,
    is_correlated,
    log_volume,
    products_by_each,
    whitened,
)
from tests.simulations import simulations, widened


@pytest.fixture
def uneven():
    return np.cumsum(np.random.default_rng(3).exponential(1.0, 40))


def correlation(time, length):
    return np.exp(-np.abs(time[:, None] - time) / length)


@pytest.mark.parametrize("length", [0.05, 3.0, 1e4])
def test_whitening_is_the_inverse_of_the_dense_cholesky_factor(uneven, length):
    rows = np.random.default_rng(4).normal(size=(40, 3))
    dense = cholesky(correlation(uneven, length), lower=True)
    ours = whitened(rows, np.diff(uneven) / length)
    np.testing.assert_allclose(ours, solve_triangular(dense, rows, lower=True), rtol=1e-7)


def test_the_density_is_scipys(uneven):
    row, apart = np.random.default_rng(5).normal(size=40), np.diff(uneven) / 2.0
    ours = log_volume(apart) - 0.5 * np.sum(whitened(row, apart) ** 2)
    theirs = multivariate_normal(cov=correlation(uneven, 2.0)).logpdf(row)
    assert ours - 20 * np.log(2 * np.pi) == pytest.approx(theirs, rel=1e-9)


@pytest.mark.parametrize(
    "noise",
    [
        CorrelatedNoise(2.0),
        CorrelatedNoise(2.0, 0.3),
        CorrelatedNoise(1e4, 0.9),
        CorrelatedNoise(0.05, 1.0),
    ],
)
def test_both_parts_of_the_noise_have_scipys_density(uneven, noise):
    row = np.random.default_rng(5).normal(size=40)
    for time in (uneven, np.arange(40.0)):
        (square,), (volume,) = products_by_each([noise], row[:, None], np.diff(time))
        theirs = multivariate_normal(cov=both(time, noise)).logpdf(row)
        ours = volume - 0.5 * square.item() - 20 * np.log(2 * np.pi)
        assert ours == pytest.approx(theirs, rel=1e-7)


def both(time, noise):
    return (1 - noise.white) * correlation(time, noise.time) + noise.white * np.eye(len(time))


def averaged(slopes, residuals, time):
    rows = np.column_stack([slopes, residuals])
    return whitened_by_each(usual_noises(time), [(rows, time)]).memory()


def test_each_noise_is_generalised_least_squares_by_dense_matrices(uneven):
    rng = np.random.default_rng(6)
    slopes = np.column_stack([np.ones(40), uneven])
    residuals = rng.normal(size=40)
    found = averaged(slopes, residuals, uneven)
    for k in (0, 17, 40, 63, 99):
        weight = np.linalg.inv(both(uneven, CorrelatedNoise(found.time[k], found.white[k])))
        information = slopes.T @ weight @ slopes
        step = -np.linalg.solve(information, slopes.T @ weight @ residuals)
        np.testing.assert_allclose(found.step[k], step, rtol=1e-4)
        covariance = found.half[k] @ found.half[k].T
        np.testing.assert_allclose(covariance, np.linalg.inv(information), rtol=1e-4)


@simulations(20, 60)
def test_a_slow_drift_under_white_noise_is_in_the_errors(count):
    """With a memory alone, a third of such intervals of 95 % held the truth."""
    rng, time = np.random.default_rng(9), np.linspace(0.0, 1.0, 300)
    slopes = np.column_stack([np.ones(300), time, time**2])
    held = []
    for _ in range(count):
        drift = lfilter([np.sqrt(1 - 0.98**2)], [1, -0.98], rng.normal(size=1300))[1000:]
        said = averaged(slopes, drift + rng.normal(size=300), time).moments(np.eye(3))
        held.append(np.abs(said.shift) < said.reach)
    assert (np.mean(held, axis=0) > 0.95 - widened(0.1, 60, count)).all()


def test_independent_errors_seldom_count_as_correlated():
    rng = np.random.default_rng(7)
    seen = [is_correlated(rng.normal(size=200), 0) for _ in range(400)]
    assert 0.005 < np.mean(seen) < 0.05


def test_a_number_that_is_known_keeps_its_error_when_the_level_is_lost():
    """A random walk: its level is unknown after the first reading, its slope is not."""
    walk = np.cumsum(np.random.default_rng(8).normal(size=500))
    time = np.arange(500.0)
    found = averaged(np.column_stack([np.ones(500), time - 250]), walk - 0.3 * time, time)
    slope = found.moments(np.array([[0.0, 1.0]]))
    # The mean of 499 independent steps.
    assert slope.error[0] == pytest.approx(1 / np.sqrt(499), rel=0.5)
    assert slope.reach[0] > 1.7 * slope.error[0]


def test_numbers_that_are_held_change_no_noise():
    """Their columns are nothing."""
    time, random = np.arange(80.0), np.random.default_rng(2)
    rows = np.column_stack([np.sin(time / 9), time / 80, random.normal(size=80)])
    grid = usual_noises(time)
    own, held = (
        whitened_by_each(grid, [(columns, time)]).memory()
        for columns in (rows, np.insert(rows, [0, 1, 1], 0.0, axis=1))
    )
    np.testing.assert_allclose(held.weight, own.weight, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(held.step[:, [1, 4]], own.step, rtol=1e-6)
    assert held.dof == own.dof == 78


def test_the_evidence_is_the_integral_over_numbers_and_the_size_of_the_noise():
    """One number, white noise: by a sum over a grid, of two sets of readings."""
    rng, x = np.random.default_rng(0), np.linspace(0.5, 1.5, 9)
    number, size = (
        np.linspace(-3, 5, 801)[:, None, None],
        np.geomspace(0.05, 20, 600)[None, :, None],
    )
    found = []
    for y in (x + 0.3 * rng.normal(size=9), 2 * x + rng.normal(size=9)):
        density = np.exp(-0.5 * np.sum(((y - number * x) / size) ** 2, axis=2)) / size[..., 0] ** 9
        rows = [(np.column_stack([x, -y]), np.arange(9.0))]
        white = whitened_by_each([CorrelatedNoise(1e-9)], rows)
        found.append([white.evidence(), -2 * np.log(np.sum(density))])
    (one, by_sum), (other, by_sum_too) = found
    assert other - one == pytest.approx(by_sum_too - by_sum, rel=1e-6)


@pytest.mark.parametrize("power", POWERS)
def test_levels_in_flicker_noise_are_those_of_dense_matrices(power):
    """Blocks of 11 and 70 readings, each in fractional noise (J. Hosking, Biometrika 68 (1981)
    165, eq. 2.2) of its own; densities integrated over flat levels, beside those of white noise.
    """
    random, blocks = np.random.default_rng(5), (slice(0, 11), slice(11, 81))
    slope, rows = random.uniform(0.5, 2.0, 81), random.normal(size=(81, 3))
    products, volume = 0.0, np.zeros(2)
    for part in blocks:
        own, lag, some = slope[part], np.arange(1, part.stop - part.start), rows[part]
        weights = np.cumprod(np.append(1.0, (lag - 1 - power / 2) / lag))
        differences = np.tril(toeplitz(weights))
        inverse = differences.T @ differences
        along = inverse @ own
        products += some.T @ (inverse - np.outer(along, along) / (own @ along)) @ some
        volume += np.log(own[0]) - 0.5 * np.log([own @ own, own @ along])
    noises = [CorrelatedNoise(1e-3, 0.0), CorrelatedNoise(1.0, 0.5)]  # the first is white
    run, levels = (rows, np.arange(81.0)), Levels(np.array([0, 11]), slope)
    found = whitened_by_each(noises, [run], levels=[levels])
    k = len(noises) + POWERS.index(power)
    triangle = found.triangle[k]
    np.testing.assert_allclose(triangle.T @ triangle, products, rtol=1e-9, atol=1e-9)
    # .15 for three powers beside .35 for correlation times, half of that with a white part: of one.
    odds = np.log(2 * 0.15 / 0.35 / 3)
    assert found.volume[k] - found.volume[0] == pytest.approx(volume[1] - volume[0] + odds)


def test_a_reach_at_which_probability_jumps_warns_of_nothing():
    def within(reach):
        return np.where(reach < 3.0, 0.5, 1.0), np.full(reach.shape, 3.75e-309)

    assert reach_of_probability(within, np.ones(1), 0.95) == pytest.approx(3.0, rel=1e-3)
