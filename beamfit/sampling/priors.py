"""What is known of a number before the data: four distributions, or any frozen one of scipy."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

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


def _positive(value: float, what: str) -> None:
    if not (value > 0 and math.isfinite(value)):
        raise InputError(f"{what} {value}", "a positive number")


@dataclass(frozen=True)
class Normal:
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

    def logpdf(self, x: np.ndarray) -> np.ndarray:
        """Log density at x."""
        return -0.5 * ((x - self.centre) / self.sd) ** 2 - math.log(self.sd * math.sqrt(2 * np.pi))

    def mean(self) -> float:
        """The centre."""
        return self.centre

    def std(self) -> float:
        """The standard deviation."""
        return self.sd

    def support(self) -> tuple[float, float]:
        """Everything."""
        return -math.inf, math.inf


@dataclass(frozen=True)
class LogNormal:
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

    def logpdf(self, x: np.ndarray) -> np.ndarray:
        """Log density at x."""
        inside = np.asarray(x) > 0
        log = np.log(np.where(inside, x, 1.0))
        off = (log - math.log(self.median)) / self.log_sd
        value = -0.5 * off**2 - log - math.log(self.log_sd * math.sqrt(2 * np.pi))
        return np.where(inside, value, -np.inf)

    def mean(self) -> float:
        """Mean."""
        return self.median * math.exp(0.5 * self.log_sd**2)

    def std(self) -> float:
        """Standard deviation."""
        return self.mean() * math.sqrt(math.expm1(self.log_sd**2))

    def support(self) -> tuple[float, float]:
        """Positive numbers."""
        return 0.0, math.inf


@dataclass(frozen=True)
class Uniform:
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

    def logpdf(self, x: np.ndarray) -> np.ndarray:
        """Log density at x."""
        inside = (np.asarray(x) >= self.low) & (np.asarray(x) <= self.high)
        return np.where(inside, -math.log(self.high - self.low), -np.inf)

    def mean(self) -> float:
        """The middle."""
        return 0.5 * (self.low + self.high)

    def std(self) -> float:
        """The width over sqrt(12)."""
        return (self.high - self.low) / math.sqrt(12.0)

    def support(self) -> tuple[float, float]:
        """The two ends."""
        return self.low, self.high


@dataclass(frozen=True)
class HalfNormal:
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

    def logpdf(self, x: np.ndarray) -> np.ndarray:
        """Log density at x."""
        value = -0.5 * (np.asarray(x) / self.scale) ** 2
        value = value + 0.5 * math.log(2 / np.pi) - math.log(self.scale)
        return np.where(np.asarray(x) >= 0, value, -np.inf)

    def mean(self) -> float:
        """Mean."""
        return self.scale * math.sqrt(2 / np.pi)

    def std(self) -> float:
        """Standard deviation."""
        return self.scale * math.sqrt(1 - 2 / np.pi)

    def support(self) -> tuple[float, float]:
        """Zero and above."""
        return 0.0, math.inf


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
