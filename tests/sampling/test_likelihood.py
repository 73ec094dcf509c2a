"""Likelihoods against posteriors known in closed form."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, stats

from beamfit.errors import InputError
from beamfit.sampling.convergence import autocorrelation_times, split_rhat
from beamfit.sampling.ensemble import draw
from beamfit.sampling.likelihood import NoiseGroup, log_likelihood, outlier_density
from beamfit.sampling.target import PosteriorLaw, SamplingTarget
from tests.sampling.targets import itself, none_derived


def residual(data, theta):
    return ((theta[0] - data["y"]) / data["error"],)


def flat(data, theta):
    return jnp.zeros(())


def level(y, error, group, noise=1.0):
    law = PosteriorLaw(residual, flat, none_derived, itself)
    spread = noise**2 * error**2 / len(y)
    return SamplingTarget(
        law,
        {"y": np.asarray(y), "error": np.asarray(error)},
        ("level",),
        ("mm",),
        [-np.inf],
        [np.inf],
        [float(np.median(y))],
        [[spread]],
        groups=(group,),
        noise=(noise,),
    )


def test_noise_inferred_is_students_distribution():
    """A mean with unknown noise, flat in the mean and in ln s: Student's t (1908)."""
    y = np.array([1.0, 1.4, 0.8, 1.1, 1.3, 0.7])
    scale = y.std(ddof=1) / np.sqrt(6)
    found = draw(
        level(y, 0.1, NoiseGroup("", "inferred"), y.std(ddof=1) / 0.1), seed=1, target_ess=8000
    )
    exact = stats.t(5, loc=y.mean(), scale=scale)
    draws = found.thinned(2000)[:, 0]
    assert stats.kstest(draws, exact.cdf).pvalue > 1e-3
    assert found.values("level").std() == pytest.approx(exact.std(), rel=0.05)
    # The noise itself: (n - 1) s²/σ² is chi-square.
    chi = 5 * y.var(ddof=1) / (0.1 * found.values("error_factor")[::20]) ** 2
    assert stats.kstest(chi, stats.chi2(5).cdf).pvalue > 1e-3


def test_noise_known_is_normal():
    y = np.array([1.0, 1.4, 0.8, 1.1])
    found = draw(level(y, 0.1, NoiseGroup()), seed=1, target_ess=8000)
    assert found.values("level").mean() == pytest.approx(y.mean(), abs=0.003)
    assert found.values("level").std() == pytest.approx(0.05, rel=0.04)


def test_outliers_are_left_alone():
    """Twenty good points and two wild ones: mean and fraction by quadrature."""
    y = np.concatenate([1.0 + 0.1 * np.random.default_rng(3).normal(size=20), [9.0, 30.0]])
    found = draw(level(y, 0.1, NoiseGroup("", "known", True)), seed=1, target_ess=8000)

    fraction = np.linspace(0.0, 0.5, 401)[1:-1]
    level_at = np.linspace(0.85, 1.15, 301)
    r = (level_at[:, None, None] - y) / 0.1
    wild = np.asarray(outlier_density(jnp.asarray(r)))
    mixed = (1 - fraction[:, None]) * stats.norm.pdf(r) + fraction[:, None] * wild
    weight = np.exp(np.sum(np.log(mixed), axis=-1) + 60)
    weight /= weight.sum()
    assert found.values("level").mean() == pytest.approx(weight.sum(1) @ level_at, abs=0.002)
    expected = weight.sum(0) @ fraction
    assert found.values("outlier_fraction").mean() == pytest.approx(expected, rel=0.03)


def test_the_outlier_density_is_a_mean_over_widths():
    for r in (0.0, 1e-4, 0.5, 7.0, 3e4):
        mean = integrate.quad(
            lambda w, r=r: stats.norm.pdf(r, scale=np.exp(w)), np.log(3), np.log(1e5), limit=400
        )[0] / np.log(1e5 / 3)
        assert float(outlier_density(jnp.asarray(r))) == pytest.approx(mean, rel=1e-6)


def test_groups_have_noises_of_their_own():
    groups = (NoiseGroup("x", "inferred"), NoiseGroup("y", "known"))
    assert [number.name for group in groups for number in group.parameters()] == ["x.log_noise"]
    parts = (jnp.array([2.0, 4.0]), jnp.array([3.0]))
    value = log_likelihood(parts, (True, True), groups, jnp.array([np.log(2.0)]))
    assert float(value) == pytest.approx(-0.5 * (1 + 4) - 2 * np.log(2) - 4.5)


def test_rows_that_only_fill_a_vector_count_nowhere():
    """With the noise inferred and outliers: the same density with three rows more."""
    group, extra = NoiseGroup("", "inferred", True), jnp.array([0.3, 0.2])
    own = jnp.array([0.5, -1.0, 7.0])
    padded = jnp.concatenate([own, jnp.array([0.0, 9.0, jnp.nan])])
    counts = jnp.arange(6) < 3
    bare = log_likelihood([own], [True], [group], extra)
    assert float(log_likelihood([padded], [counts], [group], extra)) == pytest.approx(float(bare))


def test_noise_of_another_name():
    with pytest.raises(InputError, match="known or inferred"):
        level([1.0, 2.0], 0.1, NoiseGroup("", "guessed"))


def test_autocorrelation_of_a_known_process():
    """x' = ρ x + noise has the time (1 + ρ)/(1 - ρ)."""
    random, rho = np.random.default_rng(1), 0.8
    chain = np.zeros((4000, 32, 1))
    chain[0] = random.normal(size=(32, 1))
    for i in range(1, len(chain)):
        chain[i] = rho * chain[i - 1] + np.sqrt(1 - rho**2) * random.normal(size=(32, 1))
    assert autocorrelation_times(chain)[0] == pytest.approx(9.0, rel=0.05)
    assert split_rhat(chain)[0] < 1.01
    drifting = chain + np.linspace(0, 2, 4000)[:, None, None]
    assert split_rhat(drifting)[0] > 1.1
    stuck = chain.copy()
    stuck[:, 3] = 0.5
    assert np.isinf(autocorrelation_times(stuck)[0])
