"""Target of a sampler: residuals and a prior in JAX, the optimum, open directions."""

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
from beamfit.sampling.priors import Distribution, in_words

# Not in the package: priors and the place of a store are looked at before JAX is loaded.
prepare_jax()

GOOD = Finding(Status.converged, "")


class PosteriorLaw(NamedTuple):
    """The functions of a problem, at the top of modules so that they are compiled once.

    Attributes
    ----------
    residual : callable
        ``residual(data, theta)``: a tuple of vectors, one for each group of points, in units of
        the stated errors.
    log_prior : callable
        ``log_prior(data, theta)``: -inf outside what is allowed, never NaN.
    derive : callable
        ``derive(data, theta)``, shape (derived numbers,).
    build : callable
        ``build(data, theta)``: the study's own object, for functions of the user's.
    """

    residual: Callable[[Any, Array], tuple[Array, ...]]
    log_prior: Callable[[Any, Array], Array]
    derive: Callable[[Any, Array], Array]
    build: Callable[[Any, Array], Any]


@partial(jax.jit, static_argnames=("law", "groups"))
def _log_densities(
    data: Any, counts: Any, thetas: Array, law: PosteriorLaw, groups: tuple[NoiseGroup, ...]
) -> Array:
    count = thetas.shape[1] - sum(len(group.own()) for group in groups)

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
def _each(data: Any, thetas: Array, function: Callable[[Any, Array], Any]) -> Any:
    return jax.vmap(function, (None, 0))(data, thetas)


@dataclass(frozen=True, eq=False)
class SamplingTarget:
    """A posterior to draw from.

    Parameters
    ----------
    law : PosteriorLaw
        Residuals, prior, derived numbers.
    data : pytree
        What the law needs.
    names, units : tuple of str
        Of the law's numbers.
    lower, upper : array, shape (n,)
        Bounds.
    mode : array, shape (n,)
        Where a fit found the optimum.
    covariance : array, shape (n, n)
        Of the fit: the spread of the first walkers and the shape of the first proposals.
    groups : tuple of NoiseGroup
        How the points scatter, one for each of the law's vectors of residuals.
    noise : tuple of float
        Factor on the stated errors that the fit's residuals show, one a group.
    counts : tuple of array of bool
        Which residuals of each group count; all if empty.
    priors : mapping of str to distribution
        In addition to the law's own.
    derived : mapping of str to str
        Names and units of what ``PosteriorLaw.derive`` gives.
    observed : mapping of str to array
        The data, for the store, and to tell one problem from another.
    priors_own : tuple of str
        Numbers, derived ones too, that the prior or the bounds decide and not the data.
    open_directions : str
        In words, what neither data nor priors nor bounds hold; if not empty, nothing is sampled.
    verdict : Finding
        On the fit.
    hidden : tuple of str
        Numbers nobody asks for.
    remark : str
        A further sentence on what was left out.
    stated : mapping of str to str
        Priors that are part of the law, in words.
    group_of : tuple of int
        Which group's noise widens each of the law's numbers; the first if empty.
    block_of : tuple of int
        Which of the law's numbers are proposed together; all if empty.
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
    verdict: Finding = GOOD
    hidden: tuple[str, ...] = ()
    remark: str = ""
    stated: Mapping[str, str] = field(default_factory=dict)
    group_of: tuple[int, ...] = ()
    block_of: tuple[int, ...] = ()
    reaching: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        pairs = zip(self.groups, self.noise, strict=True)
        own = [number for group, factor in pairs for number in group.own(factor)]
        low, high, start, spread = np.array([number[1:] for number in own]).reshape(-1, 4).T
        names = (*self.names, *(number.name for number in own))
        lower, upper, mode = (
            np.concatenate([np.asarray(part, float), more])
            for part, more in ((self.lower, low), (self.upper, high), (self.mode, start))
        )
        for name, prior in self.priors.items():
            i, (first, last) = names.index(name), prior.support()
            lower[i], upper[i] = max(lower[i], first), min(upper[i], last)
            # A prior may leave out where the fit ended: begin well inside it.
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
        """Log of the posterior density up to a constant, at many points.

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
        return jax.tree.map(np.asarray, _each(self.data, own, function))

    @cached_property
    def widening(self) -> Widening:
        """Widening of the law's numbers by each inferred noise."""
        noises = [group.prefix + LOG_NOISE for group in self.groups]
        places = np.array([self.names.index(n) if n in self.names else -1 for n in noises])
        source = np.full(len(self.names), -1)
        source[: self._count] = places[list(self.group_of or (0,) * self._count)]
        return Widening(self.mode, source)

    @cached_property
    def blocks(self) -> tuple[np.ndarray, ...]:
        """Numbers that are proposed together; each of the likelihood's own is by itself."""
        block_of = np.array(self.block_of or (0,) * self._count, int)
        blocks = [np.flatnonzero(block_of == block) for block in np.unique(block_of)]
        return (*blocks, *(np.array([i]) for i in range(self._count, len(self.names))))

    @cached_property
    def derived_names(self) -> tuple[str, ...]:
        """Names of the derived numbers, the noise included where it is inferred."""
        return (*self.derived, *(g.prefix + "error_factor" for g in self.groups if g.inferred))

    @cached_property
    def derived_units(self) -> tuple[str, ...]:
        """Units of the derived numbers."""
        return (*self.derived.values(), *("1" for g in self.groups if g.inferred))

    def derive(self, thetas: np.ndarray) -> np.ndarray:
        """The derived numbers at many points, shape (m, k)."""
        parts = [self.each(self.law.derive, thetas)] if self.derived else []
        noises = [self.names.index(g.prefix + LOG_NOISE) for g in self.groups if g.inferred]
        return np.concatenate([*parts, np.exp(thetas[:, noises])], axis=1)

    @cached_property
    def digest(self) -> str:
        """Tells one problem from another: data, names, bounds, priors, groups."""
        found = hashlib.sha256()
        for name, values in sorted(self.observed.items()):
            found.update(name.encode() + _digits(values))
        # Bounds of the noise follow the fit and are not compared.
        ends = self.lower[: self._count], self.upper[: self._count]
        for values in (*jax.tree.leaves(self.data), *ends):
            found.update(_digits(values))
        words = [repr(self.names), *(repr(tuple(group)) for group in self.groups)]
        words += [f"{name}~{in_words(prior)}" for name, prior in sorted(self.priors.items())]
        found.update("|".join(words).encode())
        return found.hexdigest()


def _digits(values: Any) -> bytes:
    """Shape and values, numbers to nine digits: the last ones depend on how code was compiled."""
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
    """Derivatives of a law's vectors of residuals by its numbers, each of shape (rows, n)."""
    return [np.asarray(part) for part in _jacobian(data, jnp.asarray(theta), law)]


def covariance_of(
    slopes: Sequence[np.ndarray], noise: Sequence[float], width: np.ndarray
) -> np.ndarray:
    """Covariance of a linearised fit, held by weak normal priors where the data say little.

    Parameters
    ----------
    slopes : sequence of array
        From `slopes_of`.
    noise : sequence of float
        Factor on the stated errors of each.
    width : array, shape (n,)
        Width of the prior on each number; infinite for none.

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
    # A direction that nothing holds is left as wide as the number itself.
    inverse = np.linalg.pinv(rows / scale, rcond=1e-12)
    return inverse @ inverse.T / scale / scale[:, None]
