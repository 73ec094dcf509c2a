"""Posteriors for other programs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from beamfit.errors import InputError

if TYPE_CHECKING:
    from beamfit.sampling.posterior import Posterior

__all__ = ["arviz_of"]


def arviz_of(posterior: Posterior) -> Any:
    """Convert a posterior to ArviZ: walkers as chains, derived numbers beside the sampled ones.

    Parameters
    ----------
    posterior : Posterior
        The posterior.

    Returns
    -------
    arviz.InferenceData
        Groups posterior, sample_stats and observed_data (an xarray.DataTree from ArviZ 1.0 on).

    Raises
    ------
    InputError
        If arviz is not installed.
    """
    try:
        import arviz
    except ImportError:
        expected = "the package arviz; install it with: pip install arviz"
        raise InputError("no ArviZ", expected) from None
    steps, walkers, _ = posterior.chain.shape

    def by_chain(values: np.ndarray) -> np.ndarray:
        return values.reshape(steps, walkers).T

    names = (*posterior.names, *posterior.target.derived_names)
    groups = {
        "posterior": {name: by_chain(posterior.values(name)) for name in names},
        "sample_stats": {"lp": posterior.log_prob.T},
        "observed_data": {
            name: np.asarray(values)
            for name, values in posterior.target.observed.items()
            if np.asarray(values).dtype.kind == "f"
        },
    }
    if int(arviz.__version__.split(".")[0]) >= 1:
        return arviz.from_dict(groups)
    return arviz.from_dict(**groups)
