"""An answer with its intervals, and its score; the same for every tool."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import t

DEFINITION = """\
A tool **answers** if it gives a finite value with a finite error, without a warning and without a
status or flag against the answer. A tool without errors answers, but has no coverage. Intervals of
68 and 95 % are those of the tool; a standard deviation inferred from few residuals is multiplied by
Student's factor.

An answer is **wrong** if it is more than 3 errors from the truth; the error is the length of the 95
% interval towards the truth, divided by 1.96. Without an error, an answer more than 10 % off is
wrong. If there is no emittance to find, one more than 3 errors from zero is wrong.

Brackets give binomial limits of 95 %. Bias is the median of value / truth - 1; the error is the
median
of half of the 68 % interval, divided by the truth."""
FAR, SHARE = 3.0, 0.1


class Answer(NamedTuple):
    """A value with half of its 68 % interval and its 95 % interval; None where none is given."""

    value: float
    error: float | None = None
    interval_95: tuple[float, float] | None = None

    def holds(self, truth: float) -> bool:
        """Whether the truth lies in the 95 % interval."""
        return self.interval_95[0] <= truth <= self.interval_95[1]

    def wrong(self, truth: float) -> bool:
        """Whether the truth is more than 3 errors off."""
        if self.interval_95 is None:
            return abs(self.value - truth) > SHARE * truth
        reach = abs(self.interval_95[int(truth > self.value)] - self.value)
        return abs(self.value - truth) > FAR * reach / 1.96

    @property
    def given(self) -> bool:
        """Whether value and error are finite numbers."""
        return math.isfinite(self.value) and (self.error is None or math.isfinite(self.error))


def of_sigma(value: float, sigma: float, freedom: float = math.inf) -> Answer:
    """An answer with one standard deviation, by so many residuals to spare where they tell it."""
    if not freedom > 0 or not math.isfinite(sigma):
        return Answer(value, math.nan)
    inner, outer = (float(t.ppf(p, freedom)) for p in (0.841345, 0.975))
    reach = outer * float(sigma)
    return Answer(float(value), inner * float(sigma), (float(value) - reach, float(value) + reach))


def of_draws(draws: np.ndarray) -> Answer:
    """Median and central intervals of a sample."""
    low, left, middle, right, high = np.percentile(draws, [2.5, 16, 50, 84, 97.5])
    return Answer(float(middle), float(right - left) / 2, (float(low), float(high)))


def of_quantity(quantity: Any, scale: float = 1.0) -> Answer:
    """A quantity of beamfit."""
    low, high = quantity.interval_95
    return Answer(scale * quantity.value, scale * quantity.error, (scale * low, scale * high))


def ask(tool: Callable[[Any], dict[str, Answer]], case: Any) -> dict[str, Answer]:
    """What a tool stands for: nothing if it raises or warns."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            found = tool(case)
    except (Exception, Warning):
        return {}
    return {name: answer for name, answer in found.items() if answer.given}


def score(truths: list[float], answers: list[Answer | None]) -> dict[str, Any]:
    """Counts of a tool on the draws of a family; a truth of zero is that nothing is there."""
    said = [(a, truth) for a, truth in zip(answers, truths, strict=True) if a is not None]
    sure = [(a, truth) for a, truth in said if a.error is not None and truth > 0]
    real = [(a.value / truth - 1, truth) for a, truth in said if truth > 0]
    return {
        "draws": len(truths),
        "answered": len(said),
        "sure": len(sure),
        "in_68": sum(abs(a.value - truth) <= a.error for a, truth in sure),
        "in_95": sum(a.holds(truth) for a, truth in sure),
        "wrong": sum(a.wrong(truth) for a, truth in said),
        "bias": float(np.median([off for off, _ in real])) if real else None,
        "error": float(np.median([a.error / truth for a, truth in sure])) if sure else None,
    }
