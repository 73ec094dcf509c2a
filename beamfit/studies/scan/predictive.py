"""What the posterior of a scan expects of the sizes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.optics.beam import BeamMatrix
from beamfit.sampling.posterior import Posterior
from beamfit.sampling.predictive import Expected, expected
from beamfit.studies.scan.fit import EmittanceFit
from beamfit.studies.scan.model import size_squared

__all__ = ["expected_scenario_sizes", "expected_sizes"]


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
        sigma = beams[plane].sigma
        return jnp.sqrt(size_squared((sigma[0, 0], sigma[0, 1], sigma[1, 1]), r11, r12, known))

    return expected(posterior, posterior.derive(sizes), error, f"{plane}.")


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
    at = fit.seen.measured(plane)

    def sizes(model: Any) -> Array:
        found = record.predict(model, record.data)[at]
        return 1e-6 * (jnp.sqrt(found) if record.data.squared else found)

    return expected(posterior, posterior.derive(sizes), fit[plane].points.error, "")
