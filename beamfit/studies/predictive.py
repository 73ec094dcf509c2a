"""What a posterior expects of the measurements, and of new ones like them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.lifetime.decay import current
from beamfit.optics.beam import BeamMatrix
from beamfit.sampling.posterior import Posterior
from beamfit.studies.decay_posterior import DecayNumbers
from beamfit.studies.fit import EmittanceFit

__all__ = ["Expected", "expected_current", "expected_scenario_sizes", "expected_sizes"]


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


def _expected(posterior: Posterior, draws: np.ndarray, error: np.ndarray, prefix: str) -> Expected:
    noise = _noise_factor(posterior, prefix, len(draws))
    normal = np.random.default_rng(posterior.seed).standard_normal(draws.shape)
    readings = draws + noise[:, None] * error * normal
    low, median, high = np.quantile(draws, (0.16, 0.5, 0.84), axis=0)
    return Expected(median, np.stack([low, high]), np.quantile(readings, (0.025, 0.975), axis=0))


def expected_sizes(
    posterior: Posterior,
    plane: str,
    r11: np.ndarray,
    r12: np.ndarray,
    known: np.ndarray,
    error: np.ndarray,
) -> Expected:
    """Sizes that the posterior of a scan expects.

    Parameters
    ----------
    posterior : Posterior
        Of `EmittanceFit.sample`.
    plane : str
        "x" or "y".
    r11, r12, known : array, shape (n,)
        Transfer-matrix elements to the points (R12 in m), and size² not due to the beam, m².
    error : array, shape (n,)
        Stated errors, m.

    Returns
    -------
    Expected
        In m.
    """

    def sizes(beams: Mapping[str, BeamMatrix]) -> Array:
        beam = beams[plane]
        first = r11 * beam.l11 + r12 * beam.l21
        return jnp.sqrt(first**2 + (r12 * beam.l22) ** 2 + known)

    return _expected(posterior, posterior.derive(sizes), error, f"{plane}.")


def expected_scenario_sizes(posterior: Posterior, fit: EmittanceFit, plane: str) -> Expected:
    """Sizes that the posterior of a scenario expects.

    Parameters
    ----------
    posterior : Posterior
        Of `EmittanceFit.sample`.
    fit : EmittanceFit
        Of a scenario.
    plane : str
        "x" or "y".

    Returns
    -------
    Expected
        In m.
    """
    record = next(r for r in fit.problem.records if r.name == f"size {plane}")
    squared = fit[plane].method == "size_squared"

    def sizes(model: Any) -> Array:
        found = record.predict(model, record.data)
        return 1e-6 * (jnp.sqrt(found) if squared else found)

    return _expected(posterior, posterior.derive(sizes), fit[plane].points.error, "")


def expected_current(posterior: Posterior, time: np.ndarray, error: np.ndarray) -> Expected:
    """Currents that the posterior of a decay expects.

    Parameters
    ----------
    posterior : Posterior
        Of `DecayFit.sample`.
    time, error : array, shape (n,)
        Times from the first reading, s; stated errors, mA (1 where none were).

    Returns
    -------
    Expected
        In mA.
    """

    def currents(draw: DecayNumbers) -> Array:
        return current(time, draw.i0, draw.a, draw.b)

    return _expected(posterior, posterior.derive(currents), error, "")
