"""What a posterior expects of the measurements, and of new ones like them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from beamfit.sampling.posterior import Posterior

__all__ = ["Expected", "expected"]


class Expected(NamedTuple):
    """What is expected at each point; arrays of shape (n,) or (2, n).

    Attributes
    ----------
    median : array, shape (n,)
        Of the model.
    model : array, shape (2, n)
        Ends of the 68 % interval of the model: how well the curve is known.
    reading : array, shape (2, n)
        Ends of the 95 % interval of a further reading, its noise included: where points should lie.
    """

    median: np.ndarray
    model: np.ndarray
    reading: np.ndarray


def _noise_factor(posterior: Posterior, prefix: str, number: int) -> np.ndarray:
    """Factor on the stated errors, one a draw."""
    name = f"{prefix}log_noise"
    if name not in posterior.names:
        return np.ones(number)
    return np.exp(posterior.thinned()[:, posterior.names.index(name)])


def expected(posterior: Posterior, draws: np.ndarray, error: np.ndarray, prefix: str) -> Expected:
    """Summarise what each draw expects at each point.

    Parameters
    ----------
    posterior : Posterior
        From which they come.
    draws : array, shape (m, n)
        The model at each point, one draw a row.
    error : array, shape (n,)
        Stated errors.
    prefix : str
        Of the name of the noise that belongs to these points, such as ``x.``.

    Returns
    -------
    Expected
    """
    noise = _noise_factor(posterior, prefix, len(draws))
    normal = np.random.default_rng(posterior.seed).standard_normal(draws.shape)
    readings = draws + noise[:, None] * error * normal
    low, median, high = np.quantile(draws, (0.16, 0.5, 0.84), axis=0)
    return Expected(median, np.stack([low, high]), np.quantile(readings, (0.025, 0.975), axis=0))
