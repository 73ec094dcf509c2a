"""White, correlated and 1/f noise held against dense covariance matrices and drawn noise."""

import numpy as np
import pytest
from scipy.linalg import toeplitz

from beamfit.noise.memory import Products, kinds_of, without_flicker


def covariance(kind, time):
    if not kind.time:
        return np.eye(time.size)
    apart = np.abs(time[:, None] - time) / kind.time
    return (1 - kind.white) * np.exp(-apart) + kind.white * np.eye(time.size)


@pytest.mark.parametrize("uneven", [0.0, 1.0])
def test_products_are_those_of_the_dense_covariance(uneven):
    random = np.random.default_rng(1)
    time = np.cumsum(1.0 + uneven * random.uniform(-0.5, 1.0, 60))
    columns = random.normal(size=(60, 3))
    found = Products.of(columns, time, stated=False)
    assert np.exp(found.log_prior[0]) == pytest.approx(0.5)
    for k, kind in enumerate(found.kinds):
        if kind.power:
            continue
        dense = covariance(kind, time)
        np.testing.assert_allclose(
            found.matrix[k], columns.T @ np.linalg.solve(dense, columns), rtol=1e-7, atol=1e-7
        )
        volume = found.log_prior[k] - np.log(kind.chance)
        assert volume == pytest.approx(-0.5 * np.linalg.slogdet(dense)[1], rel=1e-7, abs=1e-9)


@pytest.mark.parametrize("power", [0.4, 0.7])
def test_flicker_noise_is_whitened(power):
    """Against the autocovariance of fractional noise, Hosking (1981), theorem 1."""
    d, count = power / 2, 40
    rho = np.cumprod(np.append(1.0, (np.arange(1, count) - 1 + d) / (np.arange(1, count) - d)))
    rows = without_flicker(np.eye(count), power)
    white = rows @ toeplitz(rho) @ rows.T
    off = white - np.diag(np.diag(white))
    # A record begins somewhere: its first readings know no readings before them.
    assert np.abs(off[10:, 10:]).max() < 0.05 * white.diagonal()[10:].min()
    np.testing.assert_allclose(white.diagonal()[10:], white[-1, -1], rtol=0.05)


def test_a_noise_with_a_memory_is_found():
    random, kept = np.random.default_rng(3), 0.95
    noise = np.zeros(400)
    for k in range(1, 400):
        noise[k] = kept * noise[k - 1] + np.sqrt(1 - kept**2) * random.normal()
    found = Products.of(noise[:, None], np.arange(400.0), stated=False)
    best = found.kinds[int(np.argmax(found.log_likelihood()))]
    assert best.time == pytest.approx(-1 / np.log(kept), rel=1.5)
    assert best.white <= 0.5


@pytest.mark.parametrize(("size", "right"), [(1.0, True), (2.0, False), (0.5, False)])
@pytest.mark.parametrize("kept", [0.0, 0.9])
def test_stated_errors_are_held_against_the_noise_that_there_is(size, right, kept):
    found = []
    for seed in range(20):
        random, noise = np.random.default_rng(seed), np.zeros(400)
        for k in range(1, 400):
            noise[k] = kept * noise[k - 1] + np.sqrt(1 - kept**2) * random.normal()
        products = Products.of(size * noise[:, None], np.arange(400.0), stated=True)
        found.append(products.stated_odds(products.matrix[:, 0, 0], 0) > np.log(1e-3))
    # Errors too large by two are those of a slower memory: nothing refutes them then.
    assert sum(found) >= 19 if right else sum(found) <= 1 or (kept > 0 and size < 1)


def test_priors_add_up():
    assert sum(kind.chance for kind in kinds_of(np.arange(50.0))) == pytest.approx(1.0)
