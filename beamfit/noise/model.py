"""Noise models of beam sizes: priors, each with its reason."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from beamfit.errors import InputError

LN_2PI = math.log(2.0 * math.pi)


class Lognormal(NamedTuple):
    """Lognormal distribution of a positive number, or of many as arrays of one shape.

    ``middle`` is its median, ``spread`` the standard deviation of its natural logarithm.
    """

    middle: Any
    spread: Any

    def log_density(self, log: np.ndarray) -> np.ndarray:
        """Log density in ln of the number, at values of that ln."""
        pull = (log - np.log(self.middle)) / self.spread
        return -0.5 * pull**2 - np.log(self.spread) - 0.5 * LN_2PI

    def log_probability_above(self, least: float) -> np.ndarray:
        """Log probability that the number exceeds ``least``.

        Examples
        --------
        >>> print(Lognormal(1.0, 0.5).log_probability_above(1.0).round(6))
        -0.693147
        """
        if not least > 0.0:
            return 0.0 * np.log(self.middle)
        from scipy.special import log_ndtr  # loads scipy, which reading a scan does not need

        return log_ndtr((np.log(self.middle) - math.log(least)) / self.spread)

    def and_also(self, other: Lognormal) -> tuple[Lognormal, np.ndarray]:
        """Multiply by another distribution of the same number.

        Returns
        -------
        Lognormal
            The product of both densities, normalised.
        ndarray
            Log of the integral of the product over ln of the number.

        Examples
        --------
        >>> both, log = Lognormal(1.0, 1.0).and_also(Lognormal(4.0, 1.0))
        >>> print(both.middle.round(6), (both.spread**2).round(6))
        2.0 0.5
        """
        spread = np.hypot(self.spread, other.spread)
        share = (self.spread / spread) ** 2
        middle = np.log(self.middle) * (1.0 - share) + np.log(other.middle) * share
        both = Lognormal(np.exp(middle), self.spread * other.spread / spread)
        return both, Lognormal(self.middle, spread).log_density(np.log(other.middle))


# Probability of a bad reading among three: too few to show one.
UNTESTABLE_PROBABILITY = 1e-12
# Priors of `Noise`, whose docstring has the reasons.
FACTOR, UNSTATED, SCATTER = Lognormal(1.5, 0.8), Lognormal(0.1, 0.6), Lognormal(0.05, 0.7)


class StatedErrors(NamedTuple):
    """Probability that stated errors are right, and the factor above 1 if they are too small."""

    right: np.ndarray
    factor: Lognormal


@dataclass(frozen=True)
class Noise:
    """Priors on the noise of measured beam sizes; every answer is averaged over them.

    Parameters
    ----------
    right : float
        Probability that stated errors are right, before their size is known. Most are; a third to
        a half of the real scans with stated errors scatter more (docs/verdict.md).
    factor : Lognormal
        Factor, above 1, by which wrong stated errors are too small: real errors are often half of
        the truth. It is equally probable that they lack the ``scatter`` instead.
    unstated : Lognormal
        Noise without stated errors, as a share of the size: the jitter of a shot in addition to the
        4 to 5 % scatter of settings, from 3 % for good wires to 30 % for bad screens.
    share : float
        Probability that such noise is a share of the size, rather than the same in µm at every
        setting. A few points do not determine which.
    even : float
        Probability that settings scatter no more than their shots show.
    slow : float
        Probability that the noise is correlated from row to row, as for a beam that drifts within
        its feedbacks: one scan in ten.
    scatter : Lognormal
        Scatter of settings beyond their shots, or beyond wrong stated errors, as a share of the
        size: 4 to 5 % in LCLS scans with 1 % errors of the shots (docs/verdict.md). Right errors
        include it, so errors far below it are rarely right.
    bad : float
        Probability that a reading is bad: a missed shot, a wrong cell.
    width : float
        Width of the Cauchy distribution of bad readings over that of good ones: a slip of the
        decimal point is any number of errors off.
    bad_shot : float
        Probability that a single shot does not show the beam.
    source : str
        Origin of these numbers.

    Raises
    ------
    InputError
        If a probability is not between 0 and 1, or a number that must be positive is not.

    Examples
    --------
    >>> Noise().right, Noise(bad=0.1).bad
    (0.6, 0.1)
    """

    right: float = 0.6
    factor: Lognormal = FACTOR
    unstated: Lognormal = UNSTATED
    share: float = 0.5
    even: float = 0.05
    slow: float = 0.1
    scatter: Lognormal = SCATTER
    bad: float = 0.03
    width: float = 12.0
    bad_shot: float = 0.02
    source: str = "beamfit's own, from published scans (docs/verdict.md)"

    def __post_init__(self) -> None:
        for name in ("right", "share", "even", "slow", "bad", "bad_shot"):
            if not 0.0 < getattr(self, name) < 1.0:
                found = f"noise prior {name} = {getattr(self, name):g}"
                raise InputError(found, "a probability between 0 and 1")
        for name in ("factor", "unstated", "scatter"):
            given = getattr(self, name)
            try:
                values = Lognormal(*map(float, given))
                positive = all(math.isfinite(v) and v > 0 for v in values)
            except (TypeError, ValueError):
                positive = False
            if not positive:
                raise InputError(f"noise prior {name} = {given}", "two positive numbers")
            object.__setattr__(self, name, values)
        if not self.width > 1:
            raise InputError(f"noise prior width = {self.width:g}", "a width above 1")

    def stated(self, share: np.ndarray) -> StatedErrors:
        """Posterior of stated errors, given their typical size.

        Parameters
        ----------
        share : ndarray
            Typical stated errors of planes, as shares of the size.

        Notes
        -----
        Bayes' theorem. Right errors have the prior distribution of ``scatter``; wrong ones are that
        divided by a factor above 1. Either gives a density for errors of the stated size.

        Examples
        --------
        >>> Noise().stated(np.array([0.003, 0.02, 0.1])).right.round(2).tolist()
        [0.01, 0.45, 0.83]
        """
        total = Lognormal(self.scatter.middle / share, np.full_like(share, self.scatter.spread))
        factor, log_agreement = self.factor.and_also(total)
        log_above = factor.log_probability_above(1.0) - self.factor.log_probability_above(1.0)
        log_small = math.log1p(-self.right) + log_agreement + log_above
        right = math.log(self.right) + total.log_density(0.0)
        return StatedErrors(np.exp(right - np.logaddexp(right, log_small)), factor)

    def of_points(self, count: int) -> Noise:
        """Exclude bad readings among three, which are too few to show one.

        Examples
        --------
        >>> Noise().of_points(4).bad, Noise().of_points(3).bad < 1e-9
        (0.03, True)
        """
        return self if count > 3 else replace(self, bad=UNTESTABLE_PROBABILITY)


# Probability of a bad reading under the option --robust.
ROBUST = 0.1
