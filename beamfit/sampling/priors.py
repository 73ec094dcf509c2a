"""Prior distributions of numbers: four classes, or any frozen distribution of scipy."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np

from beamfit.errors import InputError, nearest


@runtime_checkable
class Distribution(Protocol):
    """Methods of a prior distribution; frozen distributions of scipy.stats have them."""

    def logpdf(self, x: np.ndarray) -> np.ndarray:
        """Compute the log density; -inf outside the support."""

    def std(self) -> float:
        """Return the standard deviation; it may be infinite."""

    def mean(self) -> float:
        """Return the mean."""

    def support(self) -> tuple[float, float]:
        """Return the ends of the support."""


@dataclass(frozen=True)
class _ScipyPrior:
    """Base class of priors that are distributions of scipy.stats with other parameter names."""

    # Names of fields that must be above zero.
    _positive: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            least = 0.0 if field.name in self._positive else -math.inf
            if not (math.isfinite(value) and value > least):
                kind = "a positive number" if least == 0 else "a finite number"
                words = field.name.replace("_", " ")
                raise InputError(f"{type(self).__name__} with {words} {value}", kind)

    def _distribution(self, stats: Any) -> Any:
        """Return the frozen distribution of scipy.stats."""
        raise NotImplementedError

    @cached_property
    def _frozen(self) -> Any:
        from scipy import stats  # takes half a second, needed only here

        return self._distribution(stats)

    def logpdf(self, x: np.ndarray) -> np.ndarray:
        """Compute the log density at x; -inf outside the support."""
        return self._frozen.logpdf(x)

    def mean(self) -> float:
        """Return the mean."""
        return float(self._frozen.mean())

    def std(self) -> float:
        """Return the standard deviation."""
        return float(self._frozen.std())

    def support(self) -> tuple[float, float]:
        """Return the ends of the support."""
        low, high = self._frozen.support()
        return float(low), float(high)


@dataclass(frozen=True)
class Normal(_ScipyPrior):
    """A normal prior.

    Parameters
    ----------
    centre, sd : float
        Mean and standard deviation.

    Raises
    ------
    InputError
        If `sd` is not positive.

    Examples
    --------
    >>> round(float(Normal(1.0, 0.5).logpdf(np.array(1.0))), 6)
    -0.225791
    """

    _positive = ("sd",)
    centre: float
    sd: float

    def _distribution(self, stats: Any) -> Any:
        return stats.norm(self.centre, self.sd)


@dataclass(frozen=True)
class LogNormal(_ScipyPrior):
    """A normal prior on the logarithm, for a number that is known up to a factor.

    Parameters
    ----------
    median : float
        Positive.
    log_sd : float
        Standard deviation of ln x: 0.1 means 10 %.

    Raises
    ------
    InputError
        If one of them is not positive.

    Examples
    --------
    >>> prior = LogNormal(2.0, 0.1)
    >>> float(prior.logpdf(np.array(-1.0))), round(prior.mean(), 4)
    (-inf, 2.01)
    """

    _positive = ("median", "log_sd")
    median: float
    log_sd: float

    def _distribution(self, stats: Any) -> Any:
        return stats.lognorm(self.log_sd, scale=self.median)


@dataclass(frozen=True)
class Uniform(_ScipyPrior):
    """A flat prior between two ends.

    Parameters
    ----------
    low, high : float
        Ends.

    Raises
    ------
    InputError
        If they are not finite, or not in order.

    Examples
    --------
    >>> Uniform(0.0, 4.0).logpdf(np.array([1.0, 5.0])).round(4).tolist()
    [-1.3863, -inf]
    """

    low: float
    high: float

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.low < self.high:
            raise InputError(f"a uniform prior from {self.low} to {self.high}", "two ends in order")

    def _distribution(self, stats: Any) -> Any:
        return stats.uniform(self.low, self.high - self.low)


@dataclass(frozen=True)
class HalfNormal(_ScipyPrior):
    """The positive half of a normal prior about zero, for a number that is small and not negative.

    Parameters
    ----------
    scale : float
        Standard deviation of the whole normal distribution.

    Raises
    ------
    InputError
        If it is not positive.

    Examples
    --------
    >>> round(HalfNormal(1.0).mean(), 4), float(HalfNormal(1.0).logpdf(np.array(-0.1)))
    (0.7979, -inf)
    """

    _positive = ("scale",)
    scale: float

    def _distribution(self, stats: Any) -> Any:
        return stats.halfnorm(scale=self.scale)


def checked(
    priors: Mapping[str, Distribution] | None, names: Sequence[str]
) -> dict[str, Distribution]:
    """Check priors against the names of a problem.

    Parameters
    ----------
    priors : mapping of str to distribution, or None
        Independent priors by the names of numbers.
    names : sequence of str
        Names of all numbers.

    Returns
    -------
    dict of str to distribution

    Raises
    ------
    InputError
        If a name is unknown, or a prior is not a continuous frozen distribution.

    Examples
    --------
    >>> checked({"a": Normal(0.0, 1.0)}, ["a", "b"])
    {'a': Normal(centre=0.0, sd=1.0)}
    """
    for name, prior in (priors or {}).items():
        if name not in names:
            raise InputError(f"a prior on '{name}'", nearest(name, list(names)))
        # scipy.stats.norm, which is not frozen, has the same methods; norm(0, 1) is frozen.
        unfrozen = isinstance(prior, type) or hasattr(prior, "freeze")
        if unfrozen or not isinstance(prior, Distribution):
            expected = "Normal, LogNormal, Uniform, HalfNormal or a frozen scipy.stats distribution"
            raise InputError(f"a prior of type {type(prior).__name__} on '{name}'", expected)
    return dict(priors or {})


def describe_prior(prior: Distribution) -> str:
    """Write a prior with its parameters; equal priors give equal texts.

    Examples
    --------
    >>> describe_prior(HalfNormal(2.0))
    'HalfNormal(scale=2.0)'
    """
    frozen = getattr(prior, "dist", None)
    if frozen is None:
        return repr(prior)
    parts = [repr(float(v)) for v in prior.args]
    parts += [f"{key}={float(v)!r}" for key, v in sorted(prior.kwds.items())]
    return f"{frozen.name}({', '.join(parts)})"
