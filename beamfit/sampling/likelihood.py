"""Likelihoods of residuals: errors known, noise inferred, outliers among the points."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from beamfit.errors import InputError

LOG_NOISE, FRACTION = "log_noise", "outlier_fraction"
# Range of an outlier's own error, in units of the stated one; the prior is flat in its logarithm.
NARROWEST, WIDEST = 3.0, 1e5
# Half-range of the logarithm of the noise about the fit's value.
NOISE_REACH = 10.0
WORDS = {
    "known": "as stated",
    "inferred": "inferred from the residuals",
    "averaged": "averaged over",
}


class Own(NamedTuple):
    """A number of the likelihood's own: where it may lie, begins, and how far it spreads."""

    name: str
    lower: float
    upper: float
    start: float
    spread: float


class NoiseGroup(NamedTuple):
    """Noise model of one group of points.

    Attributes
    ----------
    label : str
        Of the group, before the names of its numbers; empty where there is one group only.
    noise : str
        ``known``: the errors are right. ``inferred``: they are right up to a common factor, whose
        logarithm is free with a flat prior. ``averaged``: the law's own prior has their likelihood,
        averaged over the noise, and the residuals count nowhere.
    outliers : bool
        Whether an unknown fraction of the points, flat from 0 to 1/2, are outliers.
    freedom : float
        Degrees of freedom that stated errors are worth where the noise is inferred: a scaled
        inverse χ² prior about 1 on the square of the factor.
    """

    label: str = ""
    noise: str = "known"
    outliers: bool = False
    freedom: float = 0.0

    @property
    def prefix(self) -> str:
        """Prefix of the names of its numbers."""
        return f"{self.label}." if self.label else ""

    @property
    def inferred(self) -> bool:
        """True if the factor on its errors is free."""
        return self.noise == "inferred"

    def own(self, factor: float = 1.0) -> tuple[Own, ...]:
        """The numbers it adds to those of the model, where the errors seem so much too small.

        Raises
        ------
        InputError
            If the noise is neither known nor inferred.
        """
        if self.noise not in ("known", "inferred", "averaged"):
            raise InputError(f"noise '{self.noise}'", "known or inferred")
        at = math.log(max(factor, 1e-300))
        noise = Own(self.prefix + LOG_NOISE, at - NOISE_REACH, at + NOISE_REACH, at, 0.1)
        fraction = Own(self.prefix + FRACTION, 0.0, 0.5, 0.1, 0.07)
        return (noise,) * self.inferred + (fraction,) * self.outliers


def noise_words(groups: Sequence[NoiseGroup]) -> str:
    """Say of each group of points what is taken of its errors.

    Examples
    --------
    >>> noise_words((NoiseGroup("x", "inferred"), NoiseGroup("y")))
    'x inferred from the residuals; y as stated'
    """
    said = [WORDS[group.noise] + (", with outliers" if group.outliers else "") for group in groups]
    if len(set(said)) == 1:
        return said[0]
    return "; ".join(f"{g.label} {words}" for g, words in zip(groups, said, strict=True))


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


def _of_group(residual: Array, counts: Array, group: NoiseGroup, extra: list[Array]) -> Array:
    if group.noise == "averaged":
        return jnp.zeros(())
    log_scale = extra.pop(0) if group.inferred else 0.0
    scaled = residual * jnp.exp(-log_scale)
    each = -0.5 * scaled**2
    inside = True
    if group.outliers:
        fraction = extra.pop(0)
        inside = (fraction >= 0) & (fraction <= 0.5)
        safe = jnp.where(inside, fraction, 0.25)
        good = each - 0.5 * math.log(2 * math.pi) + jnp.log1p(-safe)
        tiny = jnp.finfo(float).tiny
        wild = jnp.log(jnp.maximum(safe, tiny)) + jnp.log(outlier_density(scaled) + tiny)
        each = jnp.logaddexp(good, wild)
    before = -group.freedom * (log_scale + 0.5 * jnp.exp(-2.0 * log_scale))
    value = before + jnp.sum(jnp.where(counts, each - log_scale, 0.0))
    return jnp.where(inside, value, -jnp.inf)


def log_likelihood(
    residuals: Sequence[Array], counts: Sequence[Array], groups: Sequence[NoiseGroup], extra: Array
) -> Array:
    """Log likelihood of residuals, up to a constant.

    Parameters
    ----------
    residuals : sequence of array
        One vector a group, in units of the stated errors.
    counts : sequence of bool or array of bool
        Which of them count; the others fill a vector up to its length.
    groups : sequence of NoiseGroup
        How they scatter.
    extra : array, shape (k,)
        The groups' own numbers, in order.

    Returns
    -------
    float
        -r²/2 summed; with a noise factor s also -n ln s. With outliers each point is good with
        probability 1 - f, else drawn from `outlier_density` in units of s: the mixture of
        D. W. Hogg, J. Bovy and D. Lang, arXiv:1008.4686 (2010), section 3.

    Examples
    --------
    >>> print(log_likelihood([jnp.array([1.0, 2.0])], [True], [NoiseGroup()], jnp.zeros(0)))
    -2.5
    """
    own = list(extra)
    parts = zip(residuals, counts, groups, strict=True)
    return sum((_of_group(*part, own) for part in parts), jnp.zeros(()))
