"""Sampling the scales of first principles, and the loss budget with credible intervals."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.lifetime.ring import Operation
from beamfit.lifetime.scaled import Terms, loss_terms, scaled_losses
from beamfit.studies.lifetime import ScaleFit, pulls, whitener

__all__ = ["Interval", "ScaleSample", "budget_intervals", "sample_scales"]

WALKERS = 32
LARGEST = 1e3
HOUR = 3600.0


class ScaleSample(NamedTuple):
    """Draws from the posterior of the scales.

    Attributes
    ----------
    draws : array, shape (n, 4)
        Touschek, bremsstrahlung, elastic, desorption.
    autocorrelation : float
        Steps between independent draws, the longest of the four; the chain is as long as 50 of
        them, or the intervals are rough.
    steps : int
        Length of the chain kept, in steps.
    """

    draws: np.ndarray
    autocorrelation: float
    steps: int


class Interval(NamedTuple):
    """A number's median and the ends of its central credible interval.

    Attributes
    ----------
    name : str
        What it is.
    median, lower, upper : float
        In `unit`.
    unit : str
        Unit.
    separable : bool
        Whether the data separate it; if not, the interval is the bounds' and not to be quoted.
    """

    name: str
    median: float
    lower: float
    upper: float
    unit: str
    separable: bool = True

    def __str__(self) -> str:
        said = f"{self.name}: {self.median:.4g} ({self.lower:.4g} to {self.upper:.4g}) {self.unit}"
        return said if self.separable else f"{said}, not separable"


@jax.jit
def _log_posterior(scales: Array, fit_parts: tuple) -> Array:
    terms, measured, pressure_error, mean, error, unit = fit_parts
    weight = whitener(scales, terms, measured, pressure_error)
    off = pulls(scales, terms, measured, weight)
    # det(W)/det(R) is the normalisation that changes with the scales.
    volume = jnp.abs(jnp.linalg.det(weight))
    known = jnp.abs(jnp.linalg.det(measured.root)) > 0
    volume = jnp.sum(jnp.where(known, jnp.log(jnp.where(known, volume, 1.0)), 0.0))
    prior = jnp.sum(((scales - mean) / error) ** 2)
    value = volume - 0.5 * jnp.sum(off**2) / unit**2 - 0.5 * prior
    inside = jnp.all((scales >= 0) & (scales <= LARGEST))
    return jnp.where(inside & jnp.isfinite(value), value, -jnp.inf)


_log_posteriors = jax.jit(jax.vmap(_log_posterior, (0, None)))


def sample_scales(fit: ScaleFit, steps: int = 1500, seed: int = 0) -> ScaleSample:
    """Draw scales from their posterior.

    Parameters
    ----------
    fit : ScaleFit
        Where to start, and the data.
    steps : int, optional
        Steps of each of 32 walkers, of which the first third is left out.
    seed : int, optional
        Of the random numbers.

    Returns
    -------
    ScaleSample
        With the priors of the fit, otherwise flat from 0 to 1000.

    Notes
    -----
    Affine-invariant ensemble (Goodman and Weare 2010) by emcee. The pressure errors are
    integrated out as in the fit.
    """
    parts = (
        fit.terms,
        fit.measured,
        fit.pressure_error,
        fit.prior_mean,
        fit.prior_error,
        fit.error_scale,
    )
    random = np.random.default_rng(seed)
    spread = np.sqrt(np.diag(fit.covariance)) * fit.error_scale
    spread = np.where(np.isfinite(spread), np.minimum(spread, 0.3), 0.3)
    start = np.abs(fit.vector + spread * random.normal(size=(WALKERS, 4)))
    import emcee  # here, because it costs every other command half a second

    sampler = emcee.EnsembleSampler(
        WALKERS, 4, lambda x: np.asarray(_log_posteriors(x, parts)), vectorize=True
    )
    sampler.random_state = np.random.RandomState(seed).get_state()
    sampler.run_mcmc(start, steps)
    burnt = steps // 3
    time = sampler.get_autocorr_time(discard=burnt, quiet=True, tol=0)
    return ScaleSample(
        sampler.get_chain(discard=burnt, flat=True), float(np.max(time)), steps - burnt
    )


def losses_of(draws: Array, terms: Terms) -> tuple[Array, Array]:
    """Coefficients a and b of many draws at one setting, each of shape (n,)."""
    return jax.vmap(scaled_losses, (0, None))(jnp.asarray(draws), terms)


def budget_intervals(
    fit: ScaleFit,
    sample: ScaleSample,
    operation: Operation,
    current: float,
    probability: float = 0.68,
) -> tuple[Interval, ...]:
    """The loss budget at a setting, with credible intervals.

    Parameters
    ----------
    fit : ScaleFit
        The fit.
    sample : ScaleSample
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
    a, b = (np.asarray(part) for part in losses_of(draws, terms))
    pressure = float(terms.pressure)
    touschek = draws[:, 0] * float(terms.touschek) * current
    rows = {
        "touschek": (HOUR * touschek, "1/h"),
        "bremsstrahlung": (HOUR * draws[:, 1] * float(terms.bremsstrahlung) * pressure, "1/h"),
        "elastic": (HOUR * draws[:, 2] * float(terms.elastic) * pressure, "1/h"),
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
