"""Target of the sampler: residuals and prior in JAX, optimum and covariance of the fit."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.linalg import block_diag

from beamfit.compile_cache import prepare_jax
from beamfit.errors import Finding, Status
from beamfit.sampling.likelihood import LOG_NOISE, NoiseGroup, log_likelihood
from beamfit.sampling.moves import Widening
from beamfit.sampling.priors import Distribution, describe_prior

# Called here and not in `beamfit.sampling`, so that priors and the place of a store can be checked
# before JAX is loaded.
prepare_jax()

NO_FINDING = Finding(Status.converged, "")


class PosteriorLaw(NamedTuple):
    """Functions of a posterior; defined at the top of modules, so that they are compiled once.

    Attributes
    ----------
    residual : callable
        ``residual(data, theta)``: a tuple of vectors, one for each group of points, in units of
        the given errors.
    log_prior : callable
        ``log_prior(data, theta)``: -inf outside bounds and constraints, never NaN.
    derive : callable
        ``derive(data, theta)``, shape (derived numbers,).
    build : callable
        ``build(data, theta)``: the study's object that a user's functions take.
    """

    residual: Callable[[Any, Array], tuple[Array, ...]]
    log_prior: Callable[[Any, Array], Array]
    derive: Callable[[Any, Array], Array]
    build: Callable[[Any, Array], Any]


@partial(jax.jit, static_argnames=("law", "groups"))
def _log_densities(
    data: Any, counts: Any, thetas: Array, law: PosteriorLaw, groups: tuple[NoiseGroup, ...]
) -> Array:
    """Compute log prior plus log likelihood at points, shape (m, n), without further priors."""
    count = thetas.shape[1] - sum(len(group.parameters()) for group in groups)

    def one(theta: Array) -> Array:
        own, extra = theta[:count], theta[count:]
        likelihood = log_likelihood(law.residual(data, own), counts, groups, extra)
        value = law.log_prior(data, own) + likelihood
        return jnp.where(jnp.isfinite(value), value, -jnp.inf)

    return jax.vmap(one)(thetas)


@partial(jax.jit, static_argnames=("law",))
def _jacobian(data: Any, theta: Array, law: PosteriorLaw) -> list[Array]:
    return jax.jacfwd(lambda moved: list(law.residual(data, moved)))(theta)


@partial(jax.jit, static_argnames=("function",))
def _map_points(data: Any, thetas: Array, function: Callable[[Any, Array], Any]) -> Any:
    return jax.vmap(function, (None, 0))(data, thetas)


@dataclass(frozen=True, eq=False)
class SamplingTarget:
    """A posterior to sample.

    Parameters
    ----------
    law : PosteriorLaw
        Residuals, prior, derived numbers.
    data : pytree
        First argument of the law's functions.
    names, units : tuple of str
        Names and units of the law's numbers.
    lower, upper : array, shape (n,)
        Bounds.
    mode : array, shape (n,)
        Optimum of the fit.
    covariance : array, shape (n, n)
        Covariance of the fit: the spread of the first walkers and the shape of the first proposals.
    groups : tuple of NoiseGroup
        Noise models, one for each of the law's vectors of residuals.
    noise : tuple of float
        Factor on the given errors of each group, from the fit's residuals.
    counts : tuple of array of bool
        True for the residuals of each group that count; all if empty.
    priors : mapping of str to distribution
        Priors in addition to the law's.
    derived : mapping of str to str
        Names and units of the results of ``PosteriorLaw.derive``.
    observed : mapping of str to array
        The data, for the store and the digest of the problem.
    priors_own : tuple of str
        Numbers, derived ones included, that the prior or the bounds determine and not the data.
    open_directions : str
        Sentence on numbers that neither data, priors nor bounds limit; if there is one, nothing is
        sampled.
    verdict : Finding
        Verdict on the fit.
    hidden : tuple of str
        Nuisance numbers, which are not shown.
    remark : str
        A further sentence for the result.
    stated : mapping of str to str
        Descriptions of the priors that are part of the law.
    group_of : tuple of int
        Group whose noise widens the posterior of each of the law's numbers; the first if empty.
    block_of : tuple of int
        Block of each of the law's numbers; a block is proposed together. One block if empty.
    reaching : mapping of str to (float, float)
        Probabilities at the ends of the 95 % interval of numbers whose bounds are not excluded; a
        probability of 0 stands for the lower bound.

    Examples
    --------
    >>> def residual(data, theta):
    ...     return ((theta[0] - data) / 0.1,)
    >>> def flat(data, theta):
    ...     return 0.0
    >>> law = PosteriorLaw(residual, flat, lambda data, theta: theta[:0], lambda data, theta: theta)
    >>> target = SamplingTarget(law, np.array([1.0, 1.2]), ("level",), ("mm",), [-np.inf], [np.inf],
    ...                 [1.1], [[0.005]])
    >>> target.log_probability(np.array([[1.1], [1.2]])).round(3).tolist()
    [-1.0, -2.0]
    """

    law: PosteriorLaw
    data: Any
    names: tuple[str, ...]
    units: tuple[str, ...]
    lower: np.ndarray
    upper: np.ndarray
    mode: np.ndarray
    covariance: np.ndarray
    groups: tuple[NoiseGroup, ...] = (NoiseGroup(),)
    noise: tuple[float, ...] = (1.0,)
    counts: tuple[np.ndarray, ...] = ()
    priors: Mapping[str, Distribution] = field(default_factory=dict)
    derived: Mapping[str, str] = field(default_factory=dict)
    observed: Mapping[str, np.ndarray] = field(default_factory=dict)
    priors_own: tuple[str, ...] = ()
    open_directions: str = ""
    verdict: Finding = NO_FINDING
    hidden: tuple[str, ...] = ()
    remark: str = ""
    stated: Mapping[str, str] = field(default_factory=dict)
    group_of: tuple[int, ...] = ()
    block_of: tuple[int, ...] = ()
    reaching: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        pairs = zip(self.groups, self.noise, strict=True)
        own = [number for group, factor in pairs for number in group.parameters(factor)]
        low, high, start, spread = np.array([number[1:] for number in own]).reshape(-1, 4).T
        names = (*self.names, *(number.name for number in own))
        lower, upper, mode = (
            np.concatenate([np.asarray(part, float), more])
            for part, more in ((self.lower, low), (self.upper, high), (self.mode, start))
        )
        for name, prior in self.priors.items():
            i, (first, last) = names.index(name), prior.support()
            lower[i], upper[i] = max(lower[i], first), min(upper[i], last)
            # If a prior excludes the optimum of the fit, start well inside its support.
            if not first < mode[i] < last:
                mean = float(prior.mean())
                mode[i] = mean if first < mean < last else 0.5 * (first + last)
        fields = {
            "names": names,
            "units": (*self.units, *("1" for _ in own)),
            "lower": lower,
            "upper": upper,
            "mode": mode,
            "covariance": block_diag(np.asarray(self.covariance), np.diag(spread**2)),
            "counts": self.counts or (True,) * len(self.groups),
            "data": jax.tree.map(jnp.asarray, self.data),
            "_count": len(self.names),
        }
        for key, value in fields.items():
            object.__setattr__(self, key, value)

    def log_probability(self, thetas: np.ndarray) -> np.ndarray:
        """Compute the log of the posterior density, up to a constant, at many points.

        Parameters
        ----------
        thetas : array, shape (m, n)
            One point a row.

        Returns
        -------
        array, shape (m,)
            -inf outside bounds and constraints; never NaN.
        """
        value = np.array(_log_densities(self.data, self.counts, thetas, self.law, self.groups))
        value[~((thetas >= self.lower) & (thetas <= self.upper)).all(axis=1)] = -np.inf
        for name, prior in self.priors.items():
            inside = np.isfinite(value)
            value[inside] += prior.logpdf(thetas[inside, self.names.index(name)])
        return np.where(np.isnan(value), -np.inf, value)

    def each(self, function: Callable[[Any, Array], Any], thetas: np.ndarray) -> Any:
        """Evaluate ``function(data, theta)`` at many points, compiled."""
        own = thetas[..., : self._count]
        return jax.tree.map(np.asarray, _map_points(self.data, own, function))

    @cached_property
    def widening(self) -> Widening:
        """Widening of the law's numbers with the inferred noise."""
        noises = [group.prefix + LOG_NOISE for group in self.groups]
        places = np.array([self.names.index(n) if n in self.names else -1 for n in noises])
        noise_index = np.full(len(self.names), -1)
        noise_index[: self._count] = places[list(self.group_of or (0,) * self._count)]
        return Widening(self.mode, noise_index)

    @cached_property
    def blocks(self) -> tuple[np.ndarray, ...]:
        """Blocks of numbers that are proposed together; each noise parameter is a block."""
        block_of = np.array(self.block_of or (0,) * self._count, int)
        blocks = [np.flatnonzero(block_of == block) for block in np.unique(block_of)]
        return (*blocks, *(np.array([i]) for i in range(self._count, len(self.names))))

    @cached_property
    def derived_names(self) -> tuple[str, ...]:
        """Names of the derived numbers, factors on the errors included."""
        return (*self.derived, *(g.prefix + "error_factor" for g in self.groups if g.inferred))

    @cached_property
    def derived_units(self) -> tuple[str, ...]:
        """Units of the derived numbers."""
        return (*self.derived.values(), *("1" for g in self.groups if g.inferred))

    def derive(self, thetas: np.ndarray) -> np.ndarray:
        """Compute the derived numbers at many points, shape (m, k)."""
        parts = [self.each(self.law.derive, thetas)] if self.derived else []
        noises = [self.names.index(g.prefix + LOG_NOISE) for g in self.groups if g.inferred]
        return np.concatenate([*parts, np.exp(thetas[:, noises])], axis=1)

    @cached_property
    def digest(self) -> str:
        """Digest of data, names, bounds, priors and groups, equal for equal problems."""
        digest = hashlib.sha256()
        for name, values in sorted(self.observed.items()):
            digest.update(name.encode() + _rounded_bytes(values))
        # Bounds of the noise depend on the fit and are left out.
        ends = self.lower[: self._count], self.upper[: self._count]
        for values in (*jax.tree.leaves(self.data), *ends):
            digest.update(_rounded_bytes(values))
        descriptions = [repr(self.names), *(repr(tuple(group)) for group in self.groups)]
        descriptions += [
            f"{name}~{describe_prior(prior)}" for name, prior in sorted(self.priors.items())
        ]
        digest.update("|".join(descriptions).encode())
        return digest.hexdigest()


def _rounded_bytes(values: Any) -> bytes:
    """Encode shape and values, to nine digits: further ones depend on the compiler."""
    values = np.asarray(values)
    if values.dtype.kind not in "fiub":
        return repr(values.tolist()).encode()
    share, power = np.frexp(np.where(np.isfinite(values), values, 0.0).astype(float))
    parts = (
        np.round(share * 2.0**30).astype(np.int64),
        power.astype(np.int64),
        np.isfinite(values),
    )
    return repr(values.shape).encode() + b"".join(part.tobytes() for part in parts)


def slopes_of(law: PosteriorLaw, data: Any, theta: np.ndarray) -> list[np.ndarray]:
    """Compute the Jacobian of each of a law's vectors of residuals, shape (rows, n)."""
    return [np.asarray(part) for part in _jacobian(data, jnp.asarray(theta), law)]


def covariance_of(
    slopes: Sequence[np.ndarray], noise: Sequence[float], width: np.ndarray
) -> np.ndarray:
    """Compute the covariance of a linearised fit with weak normal priors.

    Parameters
    ----------
    slopes : sequence of array
        Result of `slopes_of`.
    noise : sequence of float
        Factor on the given errors of each vector of residuals.
    width : array, shape (n,)
        Standard deviation of the prior on each number; infinite for none.

    Returns
    -------
    array, shape (n, n)
        (JᵀJ + 1/width²)⁻¹, computed with columns of unit length.

    Examples
    --------
    >>> covariance_of([np.array([[2.0], [0.0]])], [1.0], np.array([np.inf])).tolist()
    [[0.25]]
    """
    parts = [part / factor for part, factor in zip(slopes, noise, strict=True)]
    rows = np.concatenate([*parts, np.diag(1.0 / np.asarray(width, float))])
    scale = np.linalg.norm(rows, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    # The pseudo-inverse gives undetermined directions a variance of zero.
    inverse = np.linalg.pinv(rows / scale, rcond=1e-12)
    return inverse @ inverse.T / scale / scale[:, None]
