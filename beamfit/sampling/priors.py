"""What is known of a number before the data: four distributions, or any frozen one of scipy."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol, runtime_checkable

import numpy as np

from beamfit.errors import InputError, nearest

__all__ = ["Distribution", "HalfNormal", "LogNormal", "Normal", "Uniform", "checked", "in_words"]


@runtime_checkable
class Distribution(Protocol):
    """What a prior needs: frozen distributions of scipy.stats have it."""

    def logpdf(self, x: np.ndarray) -> np.ndarray:
        """Log density; -inf outside the support."""

    def std(self) -> float:
        """Standard deviation; may be infinite."""

    def mean(self) -> float:
        """Mean."""

    def support(self) -> tuple[float, float]:
        """Ends of the support."""


class _OfScipy:
    """A prior with the names of its field, computed by the distribution of scipy it names."""

    # How scipy calls the distribution, and its arguments.
    _call: tuple[str, dict[str, float]]

    @cached_property
    def _frozen(self) -> Any:
        from scipy import stats  # half a second that only sampling should cost

        name, arguments = self._call
        return getattr(stats, name)(**arguments)

    def logpdf(self, x: np.ndarray) -> np.ndarray:
        """Log density at x; -inf outside the support."""
        return self._frozen.logpdf(x)

    def mean(self) -> float:
        """Mean."""
        return float(self._frozen.mean())

    def std(self) -> float:
        """Standard deviation."""
        return float(self._frozen.std())

    def support(self) -> tuple[float, float]:
        """Ends of the support."""
        low, high = self._frozen.support()
        return float(low), float(high)


def _positive(value: float, what: str) -> None:
    if not (value > 0 and math.isfinite(value)):
        raise InputError(f"{what} {value}", "a positive number")


@dataclass(frozen=True)
class Normal(_OfScipy):
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

    centre: float
    sd: float

    def __post_init__(self) -> None:
        _positive(self.sd, "a standard deviation of")
        if not math.isfinite(self.centre):
            raise InputError(f"a centre of {self.centre}", "a finite number")

    @property
    def _call(self) -> tuple[str, dict[str, float]]:
        return "norm", {"loc": self.centre, "scale": self.sd}


@dataclass(frozen=True)
class LogNormal(_OfScipy):
    """A normal prior on the logarithm: for a number known up to a factor.

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

    median: float
    log_sd: float

    def __post_init__(self) -> None:
        _positive(self.median, "a median of")
        _positive(self.log_sd, "a logarithmic standard deviation of")

    @property
    def _call(self) -> tuple[str, dict[str, float]]:
        return "lognorm", {"s": self.log_sd, "scale": self.median}


@dataclass(frozen=True)
class Uniform(_OfScipy):
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
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low < self.high):
            raise InputError(f"a uniform prior from {self.low} to {self.high}", "two ends in order")

    @property
    def _call(self) -> tuple[str, dict[str, float]]:
        return "uniform", {"loc": self.low, "scale": self.high - self.low}


@dataclass(frozen=True)
class HalfNormal(_OfScipy):
    """The positive half of a normal prior about zero: small rather than large, never negative.

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

    scale: float

    def __post_init__(self) -> None:
        _positive(self.scale, "a scale of")

    @property
    def _call(self) -> tuple[str, dict[str, float]]:
        return "halfnorm", {"scale": self.scale}


def checked(
    priors: Mapping[str, Distribution] | None, names: Sequence[str]
) -> dict[str, Distribution]:
    """Check priors against the names of a problem.

    Parameters
    ----------
    priors : mapping of str to distribution, or None
        One a number, independent of each other.
    names : sequence of str
        The numbers there are.

    Returns
    -------
    dict of str to distribution

    Raises
    ------
    InputError
        If a name is not among them, or a prior is no continuous frozen distribution.

    Examples
    --------
    >>> checked({"a": Normal(0.0, 1.0)}, ["a", "b"])
    {'a': Normal(centre=0.0, sd=1.0)}
    """
    for name, prior in (priors or {}).items():
        if name not in names:
            raise InputError(f"a prior on '{name}'", nearest(name, list(names)))
        # scipy.stats.norm has the methods too; norm(0, 1) is frozen and carries its `dist`.
        unfrozen = isinstance(prior, type) or hasattr(prior, "freeze")
        if unfrozen or not isinstance(prior, Distribution):
            expected = "Normal, LogNormal, Uniform, HalfNormal or a frozen scipy.stats distribution"
            raise InputError(f"a prior of type {type(prior).__name__} on '{name}'", expected)
    return dict(priors or {})


def in_words(prior: Distribution) -> str:
    """Write a prior with its parameters, the same for equal ones.

    Examples
    --------
    >>> in_words(HalfNormal(2.0))
    'HalfNormal(scale=2.0)'
    """
    frozen = getattr(prior, "dist", None)
    if frozen is None:
        return repr(prior)
    parts = [repr(float(v)) for v in prior.args]
    parts += [f"{key}={float(v)!r}" for key, v in sorted(prior.kwds.items())]
    return f"{frozen.name}({', '.join(parts)})"
