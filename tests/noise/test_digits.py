"""Errors of rounding beside readings that are rounded."""

import numpy as np
import pytest

from beamfit.noise.digits import digit_of, rounding_variance


@pytest.mark.parametrize("noise", [0.0, 0.1, 0.2, 0.35])
def test_the_mean_error_of_rounded_readings_is_that_of_many(noise):
    random, values = np.random.default_rng(1), np.linspace(0.0, 1.0, 200, endpoint=False)
    read = np.round(values[:, None] + noise * random.normal(size=(200, 4000)))
    found = np.mean((read.mean(axis=1) - values) ** 2)
    assert rounding_variance(2.0, 2.0 * noise) == pytest.approx(4 * rounding_variance(1.0, noise))
    assert found == pytest.approx(rounding_variance(1.0, noise), rel=0.05, abs=1e-4)


def test_a_digit_is_the_step_of_readings_that_repeat():
    random = np.random.default_rng(2)
    level = np.cumsum(random.normal(size=300))
    assert digit_of(np.round(level / 0.25) * 0.25) == 0.25
    assert digit_of(level) is None
    assert digit_of(np.ones(9)) is None


def test_a_digit_divides_all_steps():
    assert digit_of(np.array([1.0, 1.3, 1.5, 1.8])) == pytest.approx(0.1)
    assert digit_of(np.arange(1.0, 2.0, 0.1)) is None  # a line
