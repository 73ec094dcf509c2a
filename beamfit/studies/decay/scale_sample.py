"""Sampling the scales of first principles, and the loss budget with credible intervals."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.greybox.posterior import Optimum, Statement, target_of
from beamfit.greybox.problem import Free, Prior, Problem, Record
from beamfit.lifetime.losses import MECHANISMS, SCALES
from beamfit.lifetime.ring import Operation
from beamfit.lifetime.scaled import Terms, loss_terms, scaled_losses, scaled_parts
from beamfit.sampling.posterior import Posterior
from beamfit.sampling.summary import Interval
from beamfit.studies.decay.scales import ScaleFit, pulls, whitener
from beamfit.studies.decay.summary import Summaries
from beamfit.verdict import Finding

__all__ = ["Interval", "budget_intervals", "sample_scales"]

LARGEST = 1e3
# How far walkers begin from scales that the decays do not tell.
WIDTH = 0.3
HOUR = 3600.0

# First principles, the decays, the relative error of pressure readings, the factor on errors.
Study = tuple[Terms, Summaries, Array, Array]


def _whitened(scales: Mapping[str, Array], study: Study) -> tuple[Array, Array]:
    terms, measured, pressure_error, _ = study
    vector = jnp.stack([scales[name] for name in SCALES])
    weight = whitener(vector, terms, measured, pressure_error)
    return weight, pulls(vector, terms, measured, weight)


def _pulls(scales: Mapping[str, Array], study: Study) -> Array:
    """Model minus measurement in standard errors, which move with the scales."""
    return _whitened(scales, study)[1] / study[3]


def _log_volume(scales: Mapping[str, Array], study: Study) -> Array:
    """det(W)/det(R): the normalisation, which changes with the scales as the errors do."""
    volume = jnp.abs(jnp.linalg.det(_whitened(scales, study)[0]))
    known = jnp.abs(jnp.linalg.det(study[1].root)) > 0
    return jnp.sum(jnp.where(known, jnp.log(jnp.where(known, volume, 1.0)), 0.0))


def sample_scales(fit: ScaleFit, seed: int = 0, **options: Any) -> Posterior:
    """Draw scales from their posterior.

    Parameters
    ----------
    fit : ScaleFit
        Where to start, and the data.
    seed : int, optional
        Of the random numbers.
    **options
        As of `beamfit.sampling.ensemble.draw`.

    Returns
    -------
    Posterior
        Of Touschek, bremsstrahlung, elastic, desorption, with the priors of the fit, otherwise
        flat from 0 to 1000. The pressure errors are integrated out as in the fit.
    """
    from beamfit.sampling.ensemble import draw

    names = tuple(SCALES)
    study = (fit.terms, fit.measured, fit.pressure_error, fit.error_scale)
    told = zip(names, fit.prior_mean, fit.prior_error, strict=True)
    problem = Problem(
        dict(zip(names, fit.vector, strict=True)),
        [Free(name, 0.0, LARGEST) for name in names],
        [Record("decays", _pulls, study, np.zeros_like(fit.measured.parts), 1.0)],
        [Prior(name, mean, error) for name, mean, error in told if np.isfinite(error)],
    )
    stated = Statement(
        data=study,
        log_volume=_log_volume,
        units=dict.fromkeys(names, "1"),
        width=dict.fromkeys(names, WIDTH),
        priors_own=[name for name in names if getattr(fit, name).error is None],
    )
    optimum = Optimum(fit.vector, Finding(fit.status, fit.message), [1.0], [True])
    return draw(target_of(problem, optimum, stated), seed=seed, **options)


def losses_of(draws: Array, terms: Terms) -> tuple[Array, Array]:
    """Coefficients a and b of many draws at one setting, each of shape (n,)."""
    return jax.vmap(scaled_losses, (0, None))(jnp.asarray(draws), terms)


def budget_intervals(
    fit: ScaleFit,
    sample: Posterior,
    operation: Operation,
    current: float,
    probability: float = 0.68,
) -> tuple[Interval, ...]:
    """The loss budget at a setting, with credible intervals.

    Parameters
    ----------
    fit : ScaleFit
        The fit.
    sample : Posterior
        Its draws.
    operation : Operation
        Settings and vacuum.
    current : float
        Beam current, mA.
    probability : float, optional
        Of the intervals.

    Returns
    -------
    tuple of Interval
        Loss rates 1/h by mechanism, a, b, and the lifetime h.
    """
    terms = loss_terms(fit.machine.ring, operation, current)
    draws = np.asarray(sample.draws)
    losses = jax.vmap(scaled_parts, (0, None))(jnp.asarray(draws), terms)
    a, b = np.asarray(losses.a), np.asarray(losses.b)
    rates = losses.rates(current)
    rows = {
        **{m.name: (HOUR * np.asarray(rates[m.name]), "1/h") for m in MECHANISMS if m.vary},
        "a": (a, "1/(mA s)"),
        "b": (b, "1/s"),
        "lifetime": (1 / (a * current + b) / HOUR, "h"),
    }
    ends = [50, 50 - 50 * probability, 50 + 50 * probability]
    return tuple(
        Interval(name, *np.percentile(values, ends), unit, _separable(fit, name))
        for name, (values, unit) in rows.items()
    )


def _separable(fit: ScaleFit, name: str) -> bool:
    quantity = getattr(fit, name, None)
    return quantity is None or quantity.error is not None
