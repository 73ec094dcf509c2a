"""Likelihoods of residuals: errors known, noise inferred, outliers among the points."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from beamfit.errors import InputError

__all__ = ["FRACTION", "LOG_NOISE", "Group", "Likelihood", "log_likelihood", "outlier_density"]

LOG_NOISE, FRACTION = "log_noise", "outlier_fraction"
# An outlier's own error is unknown: anything from so many to so many of the stated ones.
NARROWEST, WIDEST = 3.0, 1e5


class Group(NamedTuple):
    """How the points of one group scatter.

    Attributes
    ----------
    label : str
        Of the group, before the names of its numbers; empty where there is one group only.
    noise : str
        ``known``: the errors are right. ``inferred``: they are right up to a common factor, whose
        logarithm is free with a flat prior.
    outliers : bool
        Whether an unknown fraction of the points, flat from 0 to 1/2, are outliers.
    """

    label: str = ""
    noise: str = "known"
    outliers: bool = False

    @property
    def prefix(self) -> str:
        """Before the names of its numbers."""
        return f"{self.label}." if self.label else ""

    @property
    def names(self) -> tuple[str, ...]:
        """The numbers it adds to those of the model."""
        added = (LOG_NOISE,) * (self.noise == "inferred") + (FRACTION,) * self.outliers
        return tuple(self.prefix + name for name in added)


class Likelihood(NamedTuple):
    """How the points scatter, group by group.

    Attributes
    ----------
    groups : tuple of Group
        In the order of the residuals.
    """

    groups: tuple[Group, ...] = (Group(),)

    @property
    def names(self) -> tuple[str, ...]:
        """The numbers it adds to those of the model."""
        return tuple(name for group in self.groups for name in group.names)

    def check(self) -> None:
        """Refuse a noise that is neither known nor inferred.

        Raises
        ------
        InputError
        """
        for group in self.groups:
            if group.noise not in ("known", "inferred"):
                raise InputError(f"noise '{group.noise}'", "known or inferred")


def outlier_density(residual: Array) -> Array:
    """Density of an outlier's residual in units of the stated errors.

    Parameters
    ----------
    residual : array
        Of any shape.

    Returns
    -------
    array
        A normal distribution of unknown width w, averaged over ln w from ln 3 to ln 1e5:
        [Φ(r/3) - Φ(r/1e5)]/(r ln(1e5/3)), where Φ is the normal distribution function. It falls
        as 1/r, so that a wild point pulls at nothing.

    Examples
    --------
    >>> grid = jnp.concatenate([-jnp.geomspace(1e6, 1e-6, 20001), jnp.geomspace(1e-6, 1e6, 20001)])
    >>> round(float(jnp.trapezoid(outlier_density(grid), grid)), 4)  # a density
    1.0
    """
    r = jnp.abs(residual)
    near = r < 1e-3
    safe = jnp.where(near, 1.0, r)
    far = jax.scipy.special.erfc(safe / WIDEST / math.sqrt(2.0))
    between = 0.5 * (far - jax.scipy.special.erfc(safe / NARROWEST / math.sqrt(2.0))) / safe
    limit = (1 / NARROWEST - 1 / WIDEST) / math.sqrt(2 * math.pi)
    return jnp.where(near, limit, between) / math.log(WIDEST / NARROWEST)


def _of_group(residual: Array, group: Group, extra: list[Array]) -> Array:
    log_scale = extra.pop(0) if group.noise == "inferred" else 0.0
    scaled = residual * jnp.exp(-log_scale)
    normal = -0.5 * scaled**2
    if not group.outliers:
        return jnp.sum(normal) - residual.size * log_scale
    fraction = extra.pop(0)
    inside = (fraction >= 0) & (fraction <= 0.5)
    safe = jnp.where(inside, fraction, 0.25)
    good = normal - 0.5 * math.log(2 * math.pi) + jnp.log1p(-safe)
    tiny = jnp.finfo(float).tiny
    wild = jnp.log(jnp.maximum(safe, tiny)) + jnp.log(outlier_density(scaled) + tiny)
    value = jnp.sum(jnp.logaddexp(good, wild)) - residual.size * log_scale
    return jnp.where(inside, value, -jnp.inf)


def log_likelihood(residuals: tuple[Array, ...], likelihood: Likelihood, extra: Array) -> Array:
    """Log likelihood of residuals, up to a constant.

    Parameters
    ----------
    residuals : tuple of array
        One vector a group, in units of the stated errors.
    likelihood : Likelihood
        Which.
    extra : array, shape (len(likelihood.names),)
        Its own numbers.

    Returns
    -------
    float
        -r²/2 summed; with a noise factor s also -n ln s. With outliers each point is good with
        probability 1 - f, else drawn from `outlier_density` in units of s: the mixture of
        D. W. Hogg, J. Bovy and D. Lang, arXiv:1008.4686 (2010), section 3.

    Examples
    --------
    >>> print(log_likelihood((jnp.array([1.0, 2.0]),), Likelihood(), jnp.zeros(0)))
    -2.5
    """
    own = list(extra)
    pairs = zip(residuals, likelihood.groups, strict=True)
    return sum((_of_group(residual, group, own) for residual, group in pairs), jnp.zeros(()))
