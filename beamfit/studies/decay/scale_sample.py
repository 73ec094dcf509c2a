"""Sampling the scales of first principles, and the loss budget with credible intervals."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.lifetime.losses import MECHANISMS, SCALES
from beamfit.lifetime.ring import Operation
from beamfit.lifetime.scaled import Terms, loss_terms, scaled_losses, scaled_parts
from beamfit.sampling.posterior import Interval, Posterior
from beamfit.sampling.target import Law, Target
from beamfit.studies.decay.scales import ScaleFit, pulls, whitener
from beamfit.studies.decay.summary import Summaries

__all__ = ["Interval", "budget_intervals", "sample_scales"]

LARGEST = 1e3
HOUR = 3600.0


class Study(NamedTuple):
    """What the decays say of the scales.

    Attributes
    ----------
    terms, measured : Terms, Summaries
        First principles, and the decays.
    pressure_error : Array
        Relative error of the pressure readings.
    mean, error : Array
        Shape (4,), priors; an infinite error for none.
    unit : Array
        Factor on the errors of the decays.
    """

    terms: Terms
    measured: Summaries
    pressure_error: Array
    mean: Array
    error: Array
    unit: Array


def _no_residual(data: Study, scales: Array) -> tuple[Array, ...]:
    """The weights move with the scales, so that the density is written as a whole below."""
    return (jnp.zeros(0),)


def _log_density(data: Study, scales: Array) -> Array:
    weight = whitener(scales, data.terms, data.measured, data.pressure_error)
    off = pulls(scales, data.terms, data.measured, weight)
    # det(W)/det(R) is the normalisation that changes with the scales.
    volume = jnp.abs(jnp.linalg.det(weight))
    known = jnp.abs(jnp.linalg.det(data.measured.root)) > 0
    volume = jnp.sum(jnp.where(known, jnp.log(jnp.where(known, volume, 1.0)), 0.0))
    prior = jnp.sum(((scales - data.mean) / data.error) ** 2)
    return volume - 0.5 * jnp.sum(off**2) / data.unit**2 - 0.5 * prior


def _itself(data: Study, scales: Array) -> Array:
    return scales


def _nothing(data: Study, scales: Array) -> Array:
    return scales[:0]


LAW = Law(_no_residual, _log_density, _nothing, _itself)


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

    spread = np.sqrt(np.diag(fit.covariance)) * fit.error_scale
    wide = ~np.isfinite(spread) | (spread > 0.3)
    covariance = np.where(np.isfinite(fit.covariance), fit.covariance, 0.0) * fit.error_scale**2
    covariance[wide] = covariance[:, wide] = 0.0
    covariance[wide, wide] = 0.3**2
    unknown = tuple(name for name in SCALES if getattr(fit, name).error is None)
    target = Target(
        law=LAW,
        data=Study(
            fit.terms,
            fit.measured,
            fit.pressure_error,
            fit.prior_mean,
            fit.prior_error,
            fit.error_scale,
        ),
        names=tuple(SCALES),
        units=("1",) * 4,
        lower=np.zeros(4),
        upper=np.full(4, LARGEST),
        mode=fit.vector,
        covariance=covariance,
        observed={
            "mean current mA": np.asarray(fit.measured.current),
            "loss rates 1/s": np.asarray(fit.measured.parts),
            "decays": np.array(fit.names),
        },
        priors_own=unknown,
        verdict=(fit.status.value, fit.message),
    )
    return draw(target, seed=seed, **options)


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
