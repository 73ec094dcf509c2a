"""The Gaussian process of a density against integrals, differences and conditional moments."""

import numpy as np
import pytest
from scipy.integrate import dblquad

from beamfit.density import tomography
from beamfit.density.charge import charge_parts
from beamfit.density.profiles import MeanProfile
from beamfit.density.tomography import GRID, PEAK, POINT, _Posterior, bins_of

ANGLES = np.radians([0.0, 40.0, 80.0, 120.0])
ROWS = np.column_stack([np.cos(ANGLES), np.sin(ANGLES)])
PRIOR = np.array([*tomography.PRIORS, (np.log(0.05), 0.7)])


def profiles_of(shape, count=60, window=5.0):
    x = np.linspace(-window, window, count)
    return [MeanProfile(i, x, shape(i, x), 1.0, 1) for i in range(len(ANGLES))]


def bins(shape=lambda i, x: np.exp(-0.5 * x**2), **told):
    given = profiles_of(shape, **told)
    return bins_of(given, ROWS, np.eye(2), np.zeros(4), np.zeros(4))


def posterior(seen, stretch=None, core=(0.9, 1.9)):
    stretch = np.zeros(4) if stretch is None else stretch
    kernels = tomography._kernels(seen, [core])[0]
    return _Posterior.build(seen, tomography._gaussian(), stretch, kernels, PRIOR)


def test_the_reference_has_unit_rms_and_its_projection_is_a_normal_density():
    seen, reference = bins(), tomography._gaussian()
    assert reference.sum() == pytest.approx(1.0, abs=1e-6)
    moments = GRID.T @ (GRID * reference[:, None]) + POINT**2 * np.eye(2)
    assert moments == pytest.approx(np.eye(2), abs=1e-6)
    width = seen.position[1] - seen.position[0]
    spread = 1.0 + width**2 / 16.0  # of two readings taken together, half a width apart
    expected = PEAK / np.sqrt(spread) * np.exp(-0.5 * seen.position**2 / spread)
    assert seen.projection @ reference == pytest.approx(expected, abs=2e-4)


def test_a_kernel_of_two_bins_is_the_integral_of_the_covariance_over_their_lines():
    length, envelope = 0.9, 1.3
    seen = bins()
    kernel = tomography._kernel(seen, length, envelope)
    one, other = (int(np.argmin(abs(seen.position - at) + (seen.profile != k)))
                  for k, at in ((0, 0.4), (2, -0.5)))  # fmt: skip
    points = [(seen.position[i], seen.direction[seen.profile[i]]) for i in (one, other)]

    def covariance(t, u):
        where = [
            s * d + w * np.array([-d[1], d[0]]) for (s, d), w in zip(points, (t, u), strict=True)
        ]
        squares = sum(w @ w for w in where) / envelope**2
        apart = np.sum((where[0] - where[1]) ** 2) / length**2
        return np.exp(-0.5 * (squares + apart)) / (2.0 * np.pi) ** 2

    expected = dblquad(covariance, -7, 7, -7, 7, epsabs=1e-8)[0]
    # Points and bins have a width, the lines of the integral have none.
    assert kernel.bin_covariance[one, other] == pytest.approx(expected, rel=0.1)
    weight = tomography._envelope(envelope)
    apart = np.sum((GRID[:, None] - GRID) ** 2, axis=-1) / length**2
    whole = (
        (seen.projection[one] * weight) @ np.exp(-0.5 * apart) @ (seen.projection[other] * weight)
    )
    assert kernel.bin_covariance[one, other] == pytest.approx(whole, rel=1e-10)


def test_slopes_of_the_evidence_are_its_differences():
    random = np.random.default_rng(1)
    found = posterior(bins(lambda i, x: np.exp(-0.5 * x**2) + 0.01 * random.normal(size=x.size)))
    numbers = PRIOR[:, 0] + 0.3
    for k in range(5):
        step = 1e-4 * np.eye(5)[k]
        change = found._loss(numbers + step)[0] - found._loss(numbers - step)[0]
        assert found._loss(numbers)[1][k] == pytest.approx(change / 2e-4, rel=1e-4, abs=1e-4)


def test_slopes_by_a_stretch_are_differences_of_the_projection():
    seen, step = bins(), 1e-4
    found = posterior(seen)
    reference = tomography._gaussian()

    def stretched(e):
        given = profiles_of(lambda i, x: np.exp(-0.5 * x**2))
        there = bins_of(given, ROWS, np.eye(2), np.full(4, e), np.zeros(4))
        # The same bins, seen where another stretch puts them: their density per size grows.
        return there.projection @ reference / (1.0 + e)

    change = (stretched(step) - stretched(-step)) / (2.0 * step)
    # The columns leave out that bins are narrower in sizes that grow: so much of the peak.
    assert found.stretching.sum(axis=1) == pytest.approx(change, abs=2e-2 * PEAK)


def test_draws_have_mean_and_covariance_of_the_conditional():
    random = np.random.default_rng(2)
    found = posterior(bins(lambda i, x: np.exp(-0.5 * x**2) + 0.02 * random.normal(size=x.size)))
    numbers = PRIOR[:, 0]
    densities, _ = found._draws_at(numbers, 4000, random)
    inner = np.exp(-0.5 * np.sum(GRID**2, axis=1) / 0.5**2)
    values = densities @ inner
    square = np.exp(2.0 * numbers)
    cross = sum(s * k.bin_grid @ inner for s, k in zip(square, found.kernels, strict=False))
    own = 0.0
    for s, k in zip(square, found.kernels, strict=False):
        weight, n = tomography._envelope(k.envelope), len(tomography.AXIS)
        along = tomography._correlation(k.length)
        part = (weight * inner).reshape(n, n)
        own += s * np.sum(part * (along @ part @ along))
    variance = own - cross @ np.linalg.solve(found.covariance(numbers), cross)
    assert values.mean() == pytest.approx(found.mean(numbers)[0] @ inner, abs=4 * values.std() / 63)
    assert values.std() == pytest.approx(np.sqrt(variance), rel=0.06)


def test_a_share_of_a_gaussian_has_the_emittance_of_the_truncated_normal():
    shares = (0.5, 0.68, 0.9, 0.95, 1.0)
    found = charge_parts(tomography._gaussian()[None], shares)
    u = -np.log(1.0 - np.array(shares[:4]))
    expected = 1.0 - u * np.exp(-u) / (1.0 - np.exp(-u))
    assert found.emittance[0] == pytest.approx([*expected, 1.0], rel=2e-3)
    assert found.halo[0] == pytest.approx(np.exp(-4.5), rel=0.05)
    assert found.core[0] == pytest.approx(1.0 - np.exp(-0.5), rel=0.02)
