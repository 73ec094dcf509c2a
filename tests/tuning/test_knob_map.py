"""The map of the knobs against independent references: kernels, Gaussian formulas, differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import differential_evolution
from scipy.stats import kstest, multivariate_normal, norm, uniform

from beamfit.emittance.comparison import AMPLITUDES
from beamfit.tuning import knob_map as of
from beamfit.tuning.knob_map import (
    MEAN_SPREAD,
    design,
    features,
    log_emittance,
    log_size,
    orders_of,
)
from beamfit.tuning.minimum import _draw_value, emittances_of, minima_of, values_at
from beamfit.tuning.readings import log_no_beam

RNG = np.random.default_rng(3)
COUNT, KNOBS = 24, 2
X = RNG.uniform(-1, 1, (COUNT, KNOBS))
W = np.column_stack([RNG.normal(size=(COUNT, 2)), np.zeros(COUNT)])
NUMBERS = np.stack([-1.0 + 0.5 * (X**2).sum(1), 0.5 * X[:, 0], 0.3 * X[:, 1]], -1)


def size_by_matrix(numbers, w):
    emittance, beta, alpha = np.exp(numbers[0]), np.exp(numbers[1]), numbers[2]
    sigma = emittance * np.array([[beta, -alpha], [-alpha, (1 + alpha**2) / beta]])
    return np.sqrt(w[:2] @ sigma @ w[:2])


@pytest.fixture(scope="module")
def data():
    size = np.array([size_by_matrix(n, w) for n, w in zip(NUMBERS, W, strict=True)])
    y = np.log(size) + 0.04 * RNG.normal(size=COUNT)
    floor, one = np.full(COUNT, 0.01), np.ones(COUNT)
    noise = np.array([np.log(0.05), 0.7])
    return of.KnobReadings(
        X, W, 0.0 * one, y, floor, one, one, noise, np.float64(0.03), np.float64(12)
    )


@pytest.fixture(scope="module")
def found(data):
    return varying(data)


def varying(data):
    both = of.map_posterior(data, np.array([-1.0, 0.0, 0.0]), 1, KNOBS, 256)
    return of.mix_draws(both, np.zeros(256, bool))


def kernel(a, b, length):
    return np.exp(-0.5 * (((a[:, None] - b[None]) / length) ** 2).sum(-1))


@pytest.mark.parametrize("knobs", [1, 2, 4, 6])
def test_features_make_the_gaussian_kernel(knobs):
    x, length = np.random.default_rng(knobs).uniform(-1, 1, (30, knobs)), 1.5
    at_each = jax.vmap(lambda at: features(at, jnp.full(knobs, length), orders_of(knobs)))
    rows = jax.jit(at_each)(x)
    assert np.allclose(rows @ rows.T, kernel(x, x, length), atol=0.03)


def test_a_size_is_that_of_the_beam_matrix():
    for numbers, w in zip(NUMBERS, W, strict=True):
        assert np.exp(log_size(numbers, w, 0.0)) == pytest.approx(size_by_matrix(numbers, w))


def test_squares_of_emittances_add():
    """Two contributions in quadrature are one change of the square; below zero it stays above."""
    change = np.array([0.5, 2.0, 8.0])
    found = np.exp(log_emittance(0.4, change))
    assert np.allclose(found, np.exp(0.4) * np.sqrt(1.0 + change), rtol=0.01)
    below = np.asarray(log_emittance(0.0, np.linspace(-20.0, 0.0, 50)))
    assert np.all(np.isfinite(below))
    assert np.all(np.diff(below) > 0)


def linear(data):
    numbers = np.insert(NUMBERS, 1, 0.3, axis=1)  # the emittance's square 1.3 times its level
    return of._linearise(data, jnp.asarray(numbers), jnp.ones(COUNT), jnp.ones(()))


def scales_at():
    return np.log([1.6, 2.0, 0.5, 0.7, 0.6, 0.05])


def covariance_by_kernel(eta, slope):
    length, amplitude, noise = np.exp(eta[:2]), np.exp(eta[2:5]), np.exp(eta[5])
    same = kernel(X, X, length)
    level, *own = slope.T
    parts = [amplitude[i] ** 2 * same * np.outer(s, s) for i, s in enumerate(own)]
    parts += [MEAN_SPREAD**2 * np.outer(s, s) for s in (level, *own[1:])]
    return sum(parts) + (0.01**2 + noise**2) * np.eye(COUNT)


def test_the_evidence_is_that_of_a_gaussian_process(data):
    by, eta = linear(data), scales_at()
    mean, spread = map(np.asarray, of.prior_of(data))
    covariance = covariance_by_kernel(eta, np.asarray(by.slope))
    expected = multivariate_normal.logpdf(by.target, np.zeros(COUNT), covariance)
    expected += norm.logpdf(eta, mean, spread).sum()
    evidence = jax.jit(lambda eta: of._log_evidence(eta, by, orders_of(2)))
    assert float(evidence(eta)) == pytest.approx(expected, abs=0.02)


def test_slope_and_curvature_of_the_evidence_are_its_differences(data):
    by, eta, orders, h = linear(data), scales_at(), orders_of(2), 1e-5
    slope, curvature = map(np.asarray, jax.jit(lambda e: of._scoring(e, by, orders))(eta))
    value = jax.jit(lambda e: of._log_evidence(e, by, orders))
    for i, step in enumerate(h * np.eye(len(eta))):
        assert (value(eta + step) - value(eta - step)) / (2 * h) == pytest.approx(
            slope[i], rel=1e-4
        )
    # Expected curvature: the mean over readings drawn from the scales' own distribution.
    covariance = np.asarray(of._covariance(eta, by, orders))
    drawn = np.random.default_rng(0).multivariate_normal(np.zeros(COUNT), covariance, 4000)
    mean, spread = map(np.asarray, of.prior_of(data))
    scores = jax.vmap(lambda off: of._scoring(eta, by._replace(target=off), orders)[0])
    each = jax.jit(scores)(drawn)
    each = np.asarray(each) + (eta - mean) / spread**2
    assert np.allclose(each.T @ each / 4000 + np.diag(spread**-2), curvature, rtol=0.15, atol=0.4)


def test_draws_have_the_mean_and_spread_of_gaussian_regression(data):
    """Rasmussen and Williams, eq. 2.25 and 2.26, the readings linear about the best map."""
    orders, eta, one = orders_of(2), scales_at(), jnp.ones(())
    state = of._MapState(jnp.zeros(3 * (1 + len(orders))), jnp.asarray(eta), jnp.ones(COUNT))
    for _ in range(4):
        state = state._replace(v=of._fit_coefficients(data, state, one, orders))
    scales = of.scales_of(jnp.asarray(eta), one)
    rows = np.asarray(of._row_designs(data, scales, orders))
    by = of._linearise(data, rows @ state.v, jnp.ones(COUNT), one)
    a = np.einsum("ij,ijk->ik", by.slope, rows)
    gain = a.T @ np.linalg.inv(np.asarray(of._covariance(eta, by, orders)))
    at = np.asarray(design(jnp.array([0.2, -0.4]), scales, orders))
    mean, covariance = at @ gain @ by.target, at @ (np.eye(a.shape[1]) - gain @ a) @ at.T
    keys = jax.random.split(jax.random.key(2), 4000)
    draw = jax.vmap(lambda key: of._draw(key, data, state, one, orders))
    drawn = np.asarray(jax.jit(draw)(keys)) @ at.T
    assert np.allclose(drawn.mean(0), mean, atol=0.02)
    assert np.allclose(np.cov(drawn.T), covariance, rtol=0.15, atol=0.005)


def test_padding_changes_nothing(data, found):
    pad = [np.pad(v, [(0, 8)] + [(0, 0)] * (v.ndim - 1)) for v in data[:7]]
    known, floor = (np.pad(v, (0, 8), constant_values=1.0) for v in (data.known, data.floor))
    longer = of.KnobReadings(*pad, *data[7:])._replace(known=known, floor=floor)
    other = varying(longer)
    assert float(other.log_evidence) == pytest.approx(float(found.log_evidence), abs=1e-4)
    assert np.allclose(other.model[:COUNT], found.model, atol=1e-4)


def test_a_bad_reading_is_found_and_moves_little(data, found):
    y = data.y.copy()
    y[5] += 1.5
    moved = varying(data._replace(y=y))
    assert moved.bad[5] > 0.95
    assert np.delete(np.asarray(moved.bad), 5).max() < 0.5
    assert np.abs(np.delete(np.asarray(moved.model - found.model), 5)).max() < 0.1


def test_the_search_finds_the_lowest_point_of_each_draw(found):
    draws, orders = emittances_of([found]), orders_of(KNOBS)
    minima = minima_of(draws, KNOBS)
    for i in range(6):
        one = jax.tree.map(lambda v, i=i: v[i], draws)
        value = jax.jit(lambda x, one=one: _draw_value(x, one, orders))
        best = differential_evolution(value, [(-1, 1)] * KNOBS, rng=1, tol=1e-10)
        assert float(minima.value[i]) == pytest.approx(best.fun, abs=1e-5)


def test_scales_have_an_amplitude_of_no_emittance_where_nothing_varies():
    eta = jnp.log(jnp.array([1.0, 2.0, 3.0, 4.0]))
    found = of.scales_of(jnp.append(jnp.zeros(2), eta), jnp.zeros(()))
    assert np.allclose(np.concatenate(list(map(np.ravel, found))), [1, 1, 0, 2, 3, 4])


def test_draws_of_a_map_that_no_knob_changes_stand_where_they_are_wanted(data):
    both = of.map_posterior(data, np.array([-1.0, 0.0, 0.0]), 1, KNOBS, 256)
    still = np.arange(256) % 4 == 0
    found = emittances_of([of.mix_draws(both, still)])
    values = np.asarray(values_at(found, X))
    assert np.all(np.ptp(values[still], axis=1) < 1e-12)
    assert np.all(np.ptp(values[~still], axis=1) > 1e-3)
    place = np.asarray(minima_of(found, KNOBS).place)[still]
    assert kstest(place.ravel(), uniform(-1, 2).cdf).pvalue > 1e-3
    level = minima_of(emittances_of([of.mix_draws(both, np.ones(256, bool))]), KNOBS)
    assert np.isfinite(np.asarray(level.best)).all()


def test_the_evidence_of_no_beam_is_the_integral_of_its_likelihood(data):
    """By summing over levels, steps and noise: a level of ln size with independent errors."""
    nodes, levels = np.linspace(-2.5, 2.5, 11), np.linspace(-8.0, 8.0, 4001)
    scales = np.exp(data.noise[0] + data.noise[1] * nodes)
    weights = np.exp(-0.5 * nodes**2) / np.exp(-0.5 * nodes**2).sum()
    whole = 0.0
    for step in [0.0, *AMPLITUDES]:
        for scale, weight in zip(scales, weights, strict=True):
            deviation = np.sqrt(step**2 + data.floor**2 + scale**2)
            log = norm.logpdf(data.y, levels[:, None], deviation).sum(-1)
            whole += weight * np.exp(log + norm.logpdf(levels)).sum() * (levels[1] - levels[0]) / 7
    assert log_no_beam(data) == pytest.approx(np.log(whole), abs=1e-6)
