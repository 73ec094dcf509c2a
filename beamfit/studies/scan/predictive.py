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
        beam = beams[plane]
        first = r11 * beam.l11 + r12 * beam.l21
        return jnp.sqrt(first**2 + (r12 * beam.l22) ** 2 + known)

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
    squared = fit[plane].method == "size_squared"

    def sizes(model: Any) -> Array:
        found = record.predict(model, record.data)
        return 1e-6 * (jnp.sqrt(found) if squared else found)

    return expected(posterior, posterior.derive(sizes), fit[plane].points.error, "")
