"""What is to be sampled: residuals and a prior in JAX, where the optimum is, what is open."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from beamfit.compile_cache import prepare_jax
from beamfit.sampling.likelihood import FRACTION, LOG_NOISE, Likelihood, log_likelihood
from beamfit.sampling.moves import Widening
from beamfit.sampling.priors import Distribution, in_words

# Not in the package: priors and the place of a store are looked at before JAX is loaded.
prepare_jax()

__all__ = ["Derived", "Law", "Target", "covariance_of"]

# The noise is sought within a factor e^10 of where the fit saw it.
NOISE_REACH = 10.0


class Law(NamedTuple):
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


class Derived(NamedTuple):
    """Numbers computed from the sampled ones.

    Attributes
    ----------
    names, units : tuple of str
        One an element of what ``Law.derive`` gives.
    """

    names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()


@partial(jax.jit, static_argnames=("law", "likelihood"))
def _log_densities(data: Any, thetas: Array, law: Law, likelihood: Likelihood) -> Array:
    count = thetas.shape[1] - len(likelihood.names)

    def one(theta: Array) -> Array:
        own, extra = theta[:count], theta[count:]
        prior = law.log_prior(data, own)
        value = prior + log_likelihood(law.residual(data, own), likelihood, extra)
        return jnp.where(jnp.isfinite(value), value, -jnp.inf)

    return jax.vmap(one)(thetas)


@partial(jax.jit, static_argnames=("law",))
def _jacobian(data: Any, theta: Array, law: Law) -> Array:
    return jax.jacfwd(lambda moved: jnp.concatenate(law.residual(data, moved)))(theta)


@partial(jax.jit, static_argnames=("function",))
def _each(data: Any, thetas: Array, function: Callable[[Any, Array], Any]) -> Any:
    return jax.vmap(function, (None, 0))(data, thetas)


@dataclass(frozen=True, eq=False)
class Target:
    """A posterior to draw from.

    Parameters
    ----------
    law : Law
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
    likelihood : Likelihood
        Errors known or not, outliers or not.
    noise : tuple of float
        Factor on the stated errors that the fit's residuals show, one a group.
    noise_unit : str
        Unit of a stated error of 1; "1" where errors were stated.
    priors : mapping of str to distribution
        In addition to the law's own.
    derived : Derived
        Names and units of the derived numbers.
    observed : mapping of str to array
        The data, for the store, and to tell one problem from another.
    priors_own : tuple of str
        Numbers, derived ones too, that the prior or the bounds decide and not the data.
    open_directions : str
        In words, what neither data nor priors nor bounds hold; if not empty, nothing is sampled.
    verdict : (str, str)
        Status and sentence of the fit.
    hidden : tuple of str
        Numbers nobody asks for.
    remark : str
        A further sentence on what was left out.
    stated : mapping of str to str
        Priors that are part of the law, in words.
    group_of : tuple of int
        Which group's noise widens each of the law's numbers; the first if empty.

    Examples
    --------
    >>> def residual(data, theta):
    ...     return ((theta[0] - data) / 0.1,)
    >>> def flat(data, theta):
    ...     return 0.0
    >>> law = Law(residual, flat, lambda data, theta: theta[:0], lambda data, theta: theta)
    >>> target = Target(law, np.array([1.0, 1.2]), ("level",), ("mm",), [-np.inf], [np.inf],
    ...                 [1.1], [[0.005]])
    >>> target.log_probability(np.array([[1.1], [1.2]])).round(3).tolist()
    [-1.0, -2.0]
    """

    law: Law
    data: Any
    names: tuple[str, ...]
    units: tuple[str, ...]
    lower: np.ndarray
    upper: np.ndarray
    mode: np.ndarray
    covariance: np.ndarray
    likelihood: Likelihood = field(default_factory=Likelihood)
    noise: tuple[float, ...] = (1.0,)
    noise_unit: str = "1"
    priors: Mapping[str, Distribution] = field(default_factory=dict)
    derived: Derived = field(default_factory=Derived)
    observed: Mapping[str, np.ndarray] = field(default_factory=dict)
    priors_own: tuple[str, ...] = ()
    open_directions: str = ""
    verdict: tuple[str, str] = ("converged", "")
    hidden: tuple[str, ...] = ()
    remark: str = ""
    stated: Mapping[str, str] = field(default_factory=dict)
    group_of: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        self.likelihood.check()
        extra = self.likelihood.names
        # Where each of the likelihood's own numbers may lie, begins, and how far it spreads.
        rows = np.zeros((0, 4))
        for group, noise in zip(self.likelihood.groups, self.noise, strict=True):
            at = math.log(max(noise, 1e-300))
            own = {
                LOG_NOISE: (at - NOISE_REACH, at + NOISE_REACH, at, 0.1),
                FRACTION: (0.0, 0.5, 0.1, 0.07),
            }
            short = (name.removeprefix(group.prefix) for name in group.names)
            rows = np.concatenate([rows, np.array([own[name] for name in short]).reshape(-1, 4)])
        low, high, middle, spread = rows.T
        ends = {
            "lower": np.concatenate([np.asarray(self.lower, float), low]),
            "upper": np.concatenate([np.asarray(self.upper, float), high]),
        }
        mode = np.array(self.mode, float)
        for i, name in enumerate((*self.names, *extra)):
            if name in self.priors:
                first, last = self.priors[name].support()
                ends["lower"][i] = max(ends["lower"][i], first)
                ends["upper"][i] = min(ends["upper"][i], last)
                # A prior may leave out where the fit ended: begin well inside it.
                if i < len(mode) and not first < mode[i] < last:
                    prior_mean = float(self.priors[name].mean())
                    mode[i] = prior_mean if first < prior_mean < last else 0.5 * (first + last)
        n = len(self.names)
        covariance = np.zeros((n + len(extra),) * 2)
        covariance[:n, :n] = self.covariance
        covariance[n:, n:] = np.diag(spread**2)
        fields = ends | {
            "names": (*self.names, *extra),
            "units": (*self.units, *("1" for _ in extra)),
            "mode": np.concatenate([mode, middle]),
            "covariance": covariance,
            "data": jax.tree.map(jnp.asarray, self.data),
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
        value = np.array(_log_densities(self.data, thetas, self.law, self.likelihood))
        value[~((thetas >= self.lower) & (thetas <= self.upper)).all(axis=1)] = -np.inf
        for name, prior in self.priors.items():
            inside = np.isfinite(value)
            at = thetas[inside, self.names.index(name)]
            value[inside] += prior.logpdf(at)
        return np.where(np.isnan(value), -np.inf, value)

    def each(self, function: Callable[[Any, Array], Any], thetas: np.ndarray) -> Any:
        """Evaluate ``function(data, theta)`` at many points, compiled."""
        return jax.tree.map(np.asarray, _each(self.data, self.own(thetas), function))

    def own(self, thetas: np.ndarray) -> np.ndarray:
        """The law's own numbers, without the likelihood's."""
        return thetas[..., : thetas.shape[-1] - len(self.likelihood.names)]

    @cached_property
    def widening(self) -> Widening:
        """How the noise, where it is inferred, widens the law's numbers."""
        places = [
            self.names.index(group.prefix + LOG_NOISE) if group.noise == "inferred" else -1
            for group in self.likelihood.groups
        ]
        count = len(self.names) - len(self.likelihood.names)
        group_of = self.group_of or (0,) * count
        source = np.full(len(self.names), -1)
        source[:count] = [places[group] for group in group_of]
        return Widening(self.mode, source)

    @cached_property
    def blocks(self) -> tuple[np.ndarray, ...]:
        """Numbers that belong together: those of each group, and each of the likelihood's own."""
        count = len(self.names) - len(self.likelihood.names)
        group_of = np.array(self.group_of or (0,) * count)
        blocks = [np.flatnonzero(group_of == group) for group in np.unique(group_of)]
        own = [np.array([place]) for place in range(count, len(self.names))]
        return (*blocks, *own)

    @cached_property
    def derived_names(self) -> tuple[str, ...]:
        """Names of the derived numbers, the noise included where it is inferred."""
        return self.derived.names + tuple(self._noises)

    @cached_property
    def derived_units(self) -> tuple[str, ...]:
        """Their units."""
        return self.derived.units + (self.noise_unit,) * len(self._noises)

    @cached_property
    def _noises(self) -> dict[str, int]:
        """Place of each noise factor's logarithm among the sampled numbers."""
        word = "error_factor" if self.noise_unit == "1" else "noise"
        return {
            f"{group.prefix}{word}": self.names.index(group.prefix + LOG_NOISE)
            for group in self.likelihood.groups
            if group.noise == "inferred"
        }

    def derive(self, thetas: np.ndarray) -> np.ndarray:
        """The derived numbers at many points, shape (m, k)."""
        parts = [np.zeros((len(thetas), 0))]
        if self.derived.names:
            parts.append(self.each(self.law.derive, thetas))
        parts.append(np.exp(thetas[:, list(self._noises.values())]))
        return np.concatenate(parts, axis=1)

    @cached_property
    def digest(self) -> str:
        """Tells one problem from another: data, names, bounds, priors, likelihood."""
        found = hashlib.sha256()
        for name, values in sorted(self.observed.items()):
            found.update(name.encode() + _digits(values))
        # Bounds of the noise follow the fit and are not compared.
        for values in (*jax.tree.leaves(self.data), self.own(self.lower), self.own(self.upper)):
            found.update(_digits(values))
        words = [repr(self.names), repr(self.likelihood), self.law.residual.__qualname__]
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


def covariance_of(law: Law, data: Any, mode: np.ndarray, width: np.ndarray) -> np.ndarray:
    """Covariance of a linearised fit, held by weak normal priors where the data say little.

    Parameters
    ----------
    law : Law
        Of which the residuals.
    data : pytree
        Its data.
    mode : array, shape (n,)
        Where.
    width : array, shape (n,)
        Width of the prior on each number; infinite for none.

    Returns
    -------
    array, shape (n, n)
        (JᵀJ + 1/width²)⁻¹, computed with columns of unit length.
    """
    jacobian = np.asarray(_jacobian(data, jnp.asarray(mode), law))
    rows = np.concatenate([jacobian, np.diag(1.0 / np.asarray(width, float))])
    scale = np.linalg.norm(rows, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    # A direction that nothing holds is left as wide as the number itself.
    inverse = np.linalg.pinv(rows / scale, rcond=1e-12)
    return inverse @ inverse.T / scale / scale[:, None]
