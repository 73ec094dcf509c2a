"""What the posterior of a decay expects of the current."""

from __future__ import annotations

import numpy as np
from jax import Array

from beamfit.lifetime.decay import current
from beamfit.sampling.posterior import Posterior
from beamfit.sampling.predictive import Expected, expected
from beamfit.studies.decay.posterior import DecayNumbers

__all__ = ["expected_current"]


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

    return expected(posterior, posterior.derive(currents), error, "")
