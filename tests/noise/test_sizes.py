"""The likelihood of sizes against one written out, reading by reading and scale by scale."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import lognorm, norm

from beamfit.compile_cache import SELDOM
from beamfit.errors import InputError
from beamfit.noise.model import Lognormal, Noise
from beamfit.noise.sizes import kinds_of, log_average, log_likelihood, narrow_scales, prior_scales
from tests.noise import reference as ref

CASES = {"four": (4, Noise()), "seven": (7, Noise()), "twelve": (12, Noise()),
         "robust": (9, Noise(bad=0.1)), "none bad": (9, Noise(bad=1e-9))}  # fmt: skip


def data(n, kind, noise, seed=0):
    """Sizes, ten models near them, and what is known of the errors."""
    rng = np.random.default_rng(seed)
    size = rng.uniform(0.5, 2.0, n)
    model = size * (1 + 0.05 * rng.normal(size=(10, n)))
    model[:, 0] *= 1.3  # a bad reading
    error = 0.05 * size if kind == "share" else 0.03 + 0.04 * rng.uniform(size=n)
    return size, model, error


def found_and_expected(kind, size, model, error, noise):
    if kind == "none":
        kinds, log = kinds_of(noise, size, None), ref.log_unstated(size, model, noise)
    elif kind == "shots":
        kinds = kinds_of(noise, size, error, of_shots=True)
        log = ref.log_of_shots(size, model, error, noise)
    elif kind == "share":
        kinds, log = kinds_of(noise, size, error), ref.log_share(size, model, error / size, noise)
    else:
        kinds, log = kinds_of(noise, size, error), ref.log_stated(size, model, error, noise)
    parts = []
    for each in kinds:
        scales = prior_scales(each, ())
        for _ in range(2):
            own = log_likelihood(size - model, model, each, scales.scale, noise)
            scales = narrow_scales(each, scales, own.max(0) + scales.log_weight)
        own = log_likelihood(size - model, model, each, scales.scale, noise)
        parts.append(log_average(own, scales.log_weight) + each.log_weight)
    return np.logaddexp.reduce(parts), log


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("kind", ["stated", "share", "shots", "none"])
def test_it_is_the_average_over_scale_and_bad_readings(kind, case):
    """Twelve nodes where the likelihood counts do for a fine grid over all of the prior."""
    n, noise = CASES[case]
    size, model, error = data(n, kind, noise)
    found, expected = found_and_expected(kind, size, model, error, noise)
    np.testing.assert_allclose(found, expected, atol=0.03)


def test_the_written_out_one_is_an_integral():
    """The reference itself, by adaptive quadrature over factor and scatter; no reading is bad."""
    noise, off, error = (
        Noise(bad=1e-12, slow=1e-12),
        np.array([0.02, -0.05, 0.01]),
        np.array([0.02, 0.02, 0.03]),
    )
    prior = lognorm(noise.factor.spread, scale=noise.factor.middle)
    scatter = lognorm(noise.scatter.spread, scale=noise.scatter.middle)
    share = np.median(error / (1.0 + off))

    def stated(s):
        """How often errors are stated that lack the factor s, as a density of it."""
        return share * s * scatter.pdf(share * s) * prior.pdf(s) / prior.sf(1.0)

    seldom = quad(stated, 1.0, 10.0)[0] + quad(stated, 10.0, 300.0)[0]
    right = noise.right * share * scatter.pdf(share)
    right /= right + (1.0 - noise.right) * seldom

    def density(s):
        return np.prod(norm.pdf(off, 0.0, s * error)) * stated(s) / seldom

    def beyond(s):
        return np.prod(norm.pdf(off, 0.0, np.hypot(error, s * (1.0 + off)))) * scatter.pdf(s)

    wrong = quad(density, 1.0, 10.0)[0] + quad(density, 10.0, 300.0)[0]
    wrong = 0.5 * (wrong + quad(beyond, 0.0, 0.3)[0] + quad(beyond, 0.3, 9.0)[0])
    expected = right * np.prod(norm.pdf(off, 0.0, error)) + (1 - right) * wrong
    found = ref.log_stated(1.0 + off, np.ones((1, 3)), error, noise)
    assert found[0] == pytest.approx(np.log(expected), abs=0.01)


@pytest.mark.parametrize("options", [SELDOM, None])
@pytest.mark.parametrize("n", [5, 12, 18])
def test_compiled_it_is_the_same(n, options):
    """The second largest of doubts was found by comparing numbers that XLA computes twice."""
    noise = Noise()
    size, model, error = data(n, "stated", noise)
    kind = kinds_of(noise, size, error)[0]
    scale = prior_scales(kind, ()).scale
    many = np.repeat(model, 30, axis=0) * (
        1 + 0.01 * np.random.default_rng(1).normal(size=(300, n))
    )

    def one(row):
        return log_likelihood(size[None] - row[None], row[None], kind, scale, noise)[0]

    jax.config.update("jax_enable_x64", True)
    found = jax.jit(jax.vmap(one), compiler_options=options)(jnp.asarray(many))
    expected = log_likelihood(size - many, many, kind, scale, noise)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


def test_errors_of_one_share_are_the_models_own():
    size = np.array([1.0, 2.0, 3.0])
    assert kinds_of(Noise(), size, 0.05 * size)[0].power == 1
    assert kinds_of(Noise(), size, np.full(3, 0.05))[0].power == 0
    assert [k.power for k in kinds_of(Noise(), size, None)] == [1, 0, 1]
    shots, slow = kinds_of(Noise(), size, np.full(3, 0.05), of_shots=True)
    assert (shots.power, shots.special, shots.special_probability) == (0, 0.0, Noise().even)
    assert not shots.slow
    assert slow.slow


def test_stated_errors_are_never_too_large():
    """Sizes that scatter less than stated say that errors are right, and no more."""
    size = np.linspace(1.0, 2.0, 12)
    model = np.repeat((size * (1 + 1e-4))[None], 2, axis=0)
    kind = kinds_of(Noise(), size, 0.05 * np.ones(12))[0]
    scales = prior_scales(kind, ())
    assert scales.scale.min() == 1.0
    log = log_likelihood(size - model, model, kind, scales.scale, Noise())[0] + scales.log_weight
    assert np.argmax(log) == 0


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"right": 1.0}, "right = 1; expected a probability between 0 and 1"),
        ({"bad_shot": 0.0}, "bad_shot = 0; expected a probability"),
        ({"factor": (0.0, 1.0)}, "factor = .*two positive numbers"),
        ({"scatter": (0.05, float("nan"))}, "two positive numbers"),
        ({"width": 1.0}, "a width above 1"),
    ],
)
def test_priors_that_cannot_be_are_refused(wrong, words):
    with pytest.raises(InputError, match=words):
        Noise(**wrong)


def test_a_prior_is_a_density():
    """Of ln of the number, and what lies above a value, by quadrature."""
    prior = Lognormal(1.5, 0.8)
    total, _ = quad(lambda x: float(np.exp(prior.log_density(np.asarray(x)))), -8.0, 8.0)
    assert total == pytest.approx(1.0, abs=1e-9)
    above, _ = quad(lambda x: float(np.exp(prior.log_density(np.asarray(x)))), np.log(1.2), 8.0)
    assert np.exp(prior.log_probability_above(1.2)) == pytest.approx(above, abs=1e-9)
    assert replace(Noise(), factor=(2, 0.5)).factor == Lognormal(2.0, 0.5)
