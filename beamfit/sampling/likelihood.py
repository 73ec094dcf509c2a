"""Likelihoods of residuals with known errors, inferred noise, or outliers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from beamfit.errors import InputError

LOG_NOISE, FRACTION = "log_noise", "outlier_fraction"
# Range of an outlier's standard deviation in units of the given error; the prior is flat in its
# logarithm. Chosen: from clearly wider than the noise to any wild reading.
MIN_OUTLIER_WIDTH, MAX_OUTLIER_WIDTH = 3.0, 1e5
# Half-width of the range of the logarithm of the noise about the fit's value: no limit in practice.
NOISE_REACH = 10.0
NOISE_TEXT = {
    "known": "as stated",
    "inferred": "inferred from the residuals",
    "averaged": "averaged over",
}


class NoiseParameter(NamedTuple):
    """A parameter of the noise: bounds, start, and standard deviation of the first walkers."""

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
        Label of the group in the names of its parameters; empty if there is only one group.
    noise : str
        ``known``: the errors are right. ``inferred``: they are right up to a common factor, whose
        logarithm is free with a flat prior. ``averaged``: the law's prior includes the likelihood,
        averaged over the noise, and the residuals are not used.
    outliers : bool
        True if an unknown fraction of the points are outliers; its prior is flat from 0 to 1/2.
    freedom : float
        Degrees of freedom of the given errors if the noise is inferred: a scaled inverse χ² prior
        about 1 on the square of the factor.
    """

    label: str = ""
    noise: str = "known"
    outliers: bool = False
    freedom: float = 0.0

    @property
    def prefix(self) -> str:
        """Prefix of the names of its parameters."""
        return f"{self.label}." if self.label else ""

    @property
    def inferred(self) -> bool:
        """True if the factor on the errors is free."""
        return self.noise == "inferred"

    def parameters(self, factor: float = 1.0) -> tuple[NoiseParameter, ...]:
        """Return the parameters of the noise; `factor` is the start of the factor on the errors.

        Raises
        ------
        InputError
            If the noise is neither known nor inferred.
        """
        if self.noise not in ("known", "inferred", "averaged"):
            raise InputError(f"noise '{self.noise}'", "known or inferred")
        at = math.log(max(factor, 1e-300))
        noise = NoiseParameter(self.prefix + LOG_NOISE, at - NOISE_REACH, at + NOISE_REACH, at, 0.1)
        fraction = NoiseParameter(self.prefix + FRACTION, 0.0, 0.5, 0.1, 0.07)
        return (noise,) * self.inferred + (fraction,) * self.outliers


def noise_words(groups: Sequence[NoiseGroup]) -> str:
    """Describe the noise model of each group.

    Examples
    --------
    >>> noise_words((NoiseGroup("x", "inferred"), NoiseGroup("y")))
    'x inferred from the residuals; y as stated'
    """
    texts = [
        NOISE_TEXT[group.noise] + (", with outliers" if group.outliers else "") for group in groups
    ]
    if len(set(texts)) == 1:
        return texts[0]
    return "; ".join(f"{g.label} {words}" for g, words in zip(groups, texts, strict=True))


def outlier_density(residual: Array) -> Array:
    """Compute the density of an outlier's residual in units of the given errors.

    Parameters
    ----------
    residual : array
        Residuals, of any shape.

    Returns
    -------
    array
        Density of a normal distribution of unknown width w, averaged over ln w from ln 3 to ln 1e5:
        [Φ(r/3) - Φ(r/1e5)]/(r ln(1e5/3)), where Φ is the normal distribution function. It falls
        as 1/r, so that a wild point has no effect on the fit.

    Examples
    --------
    >>> grid = jnp.concatenate([-jnp.geomspace(1e6, 1e-6, 20001), jnp.geomspace(1e-6, 1e6, 20001)])
    >>> round(float(jnp.trapezoid(outlier_density(grid), grid)), 4)  # a density
    1.0
    """
    r = jnp.abs(residual)
    near = r < 1e-3
    safe = jnp.where(near, 1.0, r)
    far = jax.scipy.special.erfc(safe / MAX_OUTLIER_WIDTH / math.sqrt(2.0))
    between = 0.5 * (far - jax.scipy.special.erfc(safe / MIN_OUTLIER_WIDTH / math.sqrt(2.0))) / safe
    limit = (1 / MIN_OUTLIER_WIDTH - 1 / MAX_OUTLIER_WIDTH) / math.sqrt(2 * math.pi)
    return jnp.where(near, limit, between) / math.log(MAX_OUTLIER_WIDTH / MIN_OUTLIER_WIDTH)


def _group_likelihood(
    residual: Array, counts: Array, group: NoiseGroup, extra: list[Array]
) -> Array:
    """Compute the log likelihood of one group, taking its parameters from the front of `extra`."""
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
    log_prior = -group.freedom * (log_scale + 0.5 * jnp.exp(-2.0 * log_scale))
    value = log_prior + jnp.sum(jnp.where(counts, each - log_scale, 0.0))
    return jnp.where(inside, value, -jnp.inf)


def log_likelihood(
    residuals: Sequence[Array], counts: Sequence[Array], groups: Sequence[NoiseGroup], extra: Array
) -> Array:
    """Compute the log likelihood of residuals, up to a constant.

    Parameters
    ----------
    residuals : sequence of array
        Residuals of each group, in units of the given errors.
    counts : sequence of bool or array of bool
        True for the residuals that count; the others are padding.
    groups : sequence of NoiseGroup
        Noise models.
    extra : array, shape (k,)
        Parameters of the noise of all groups, in order.

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
    parameters = list(extra)
    parts = zip(residuals, counts, groups, strict=True)
    return sum((_group_likelihood(*part, parameters) for part in parts), jnp.zeros(()))
