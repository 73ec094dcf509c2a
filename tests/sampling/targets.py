"""Posteriors whose moments are known exactly, for the tests of the sampler."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from beamfit.sampling.target import PosteriorLaw, SamplingTarget

BANANA = (1.0, 1.0, 0.3)  # mean and sd of x, sd of y about x²
PEAKS = (-3.0, 4.0, 0.6, 0.3)  # two places, their common sd, weight of the first


def nothing(data, theta):
    return (jnp.zeros(0),)


def none_derived(data, theta):
    return theta[:0]


def itself(data, theta):
    return theta


def banana(data, theta):
    """Rosenbrock's valley: x normal, y normal about x²."""
    mean, sd, about = BANANA
    return -0.5 * ((theta[0] - mean) / sd) ** 2 - 0.5 * ((theta[1] - theta[0] ** 2) / about) ** 2


def half_normal(data, theta):
    """A standard normal above zero in the first number, whole in the second."""
    return jnp.where(theta[0] >= 0, -0.5 * (theta[0] ** 2 + theta[1] ** 2), -jnp.inf)


def bimodal(data, theta):
    first, second, sd, weight = PEAKS
    one = jnp.log(weight) - 0.5 * ((theta[0] - first) / sd) ** 2
    other = jnp.log(1 - weight) - 0.5 * ((theta[0] - second) / sd) ** 2
    return jnp.logaddexp(one, other) - 0.5 * theta[1] ** 2


def gaussian(data, theta):
    off = theta - data["mean"]
    return -0.5 * off @ data["precision"] @ off


def target(
    density, n=2, lower=-np.inf, upper=np.inf, mode=None, covariance=None, **more
) -> SamplingTarget:
    data = more.pop("data", {"none": np.zeros(0)})
    return SamplingTarget(
        PosteriorLaw(nothing, density, none_derived, itself),
        data,
        tuple("xyzuvw"[:n]),
        ("1",) * n,
        np.full(n, lower),
        np.full(n, upper),
        np.zeros(n) if mode is None else mode,
        np.eye(n) if covariance is None else covariance,
        **more,
    )


def exact_draws(density, number, seed):
    """Independent draws from each of them, by numpy."""
    random = np.random.default_rng(seed)
    normal = random.standard_normal((number, 2))
    if density is banana:
        mean, sd, about = BANANA
        x = mean + sd * normal[:, 0]
        return np.stack([x, x**2 + about * normal[:, 1]], -1)
    if density is half_normal:
        return np.stack([np.abs(normal[:, 0]), normal[:, 1]], -1)
    first, second, sd, weight = PEAKS
    place = np.where(random.random(number) < weight, first, second)
    return np.stack([place + sd * normal[:, 0], normal[:, 1]], -1)
