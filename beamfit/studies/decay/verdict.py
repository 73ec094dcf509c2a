"""What a least-squares solution is worth: separability, and the rules that say why."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np

from beamfit.lifetime.decay import HOUR
from beamfit.shown import shown
from beamfit.statistics import POOR_FIT, chi2_probability
from beamfit.status import Status
from beamfit.studies.decay.model import Solution
from beamfit.studies.decay.record import DecayRecord
from beamfit.table import json_of
from beamfit.verdict import Finding, judge

__all__ = ["Evidence", "Separability", "finding_of"]

# The share of a in the loss lies between 0 and 1: known to 0.2, the record tells pure Touschek
# from pure gas at five standard deviations; known worse, a and b are one number.
SEPARABLE = 0.2
# A loss rate less than three errors from zero leaves the lifetime without an upper limit.
DETERMINED = 1 / 3
# A change between neighbouring residuals of so many times their usual one is a step, not noise.
STEP = 12.0
# How many errors below zero an unphysical a or b, or a rising current, is believed.
BELIEVED = 5.0


@shown
@dataclass(frozen=True)
class Separability:
    """Whether the record tells a from b.

    Parameters
    ----------
    separable : bool
        Whether the share of a in the loss is known to better than 0.2.
    share, share_error : float or None
        Share of a in the loss at the mean current (0: all gas-like, 1: all Touschek-like), and
        its standard deviation.
    correlation : float or None
        Correlation of a and b; near -1 on every record, also where both are well determined.
    residual_correlation : float or None
        Correlation of neighbouring residuals.
    error_inflation : float
        By how much correlated residuals make the true errors larger than those stated.
    """

    separable: bool
    share: float | None
    share_error: float | None
    correlation: float | None
    residual_correlation: float | None
    error_inflation: float

    def to_json(self) -> dict[str, Any]:
        """Return the fields as JSON's types."""
        return json_of(vars(self))


@dataclass(frozen=True, eq=False)
class Evidence:
    """What the rules look at: a record, its solution, and the size of its noise.

    `raw` and `scale` make errors of the solution's: as they were given, or as the residuals show.
    """

    record: DecayRecord
    solution: Solution
    residuals: np.ndarray
    chi2: float
    dof: int
    raw: float
    scale: float

    @classmethod
    def of(cls, record: DecayRecord, solution: Solution) -> Evidence:
        """Without errors the weights were 1/mA, and the residuals say what the noise is."""
        rows, squares = len(record), float(solution.sum_squares)
        dof = rows - 3
        inferred = record.error is None
        raw = math.sqrt(squares / dof) if inferred else 1.0
        chi2 = float(dof) if inferred else squares
        residuals = np.asarray(solution.residuals[:rows])
        return cls(record, solution, residuals, chi2, dof, raw, raw * max(1.0, (chi2 / dof) ** 0.5))

    def scaled(self, name: str) -> tuple[float, float]:
        """A physical value and its error."""
        values, errors = self.solution.values, self.solution.errors
        return float(getattr(values, name)), float(getattr(errors, name)) * self.scale

    @cached_property
    def separability(self) -> Separability:
        """Of a and b."""
        neighbours = _neighbours(self.residuals)
        # Variance of a mean of residuals that decorrelate exponentially.
        together = max(neighbours, 0.0)
        inflation = math.sqrt((1 + together) / (1 - min(together, 0.999)))
        share, error = self.scaled("share")
        error *= inflation
        finite = math.isfinite(share) and math.isfinite(error)
        correlation = float(self.solution.correlation)
        return Separability(
            separable=finite and error < SEPARABLE,
            share=share if finite else None,
            share_error=error if finite else None,
            correlation=correlation if math.isfinite(correlation) else None,
            residual_correlation=neighbours,
            error_inflation=inflation,
        )

    @cached_property
    def step(self) -> str | None:
        """The sentence for a step or spike in the record, whether or not its errors are known."""
        record, change = self.record, np.diff(self.residuals)
        usual = 1.4826 * float(np.median(np.abs(change)))
        floor = max(record.resolution or 0.0, 1e-12 * float(record.current.max()))
        largest = int(np.argmax(np.abs(change)))
        if abs(change[largest]) <= STEP * max(usual, floor):
            return None
        # Residuals are model minus reading, so a refill lowers them.
        return (
            f"The record has a step of {-change[largest]:+.4g} mA at "
            f"{record.time[largest + 1]:.6g} s: cut it with split_record and fit the pieces"
        )


def _neighbours(residuals: np.ndarray) -> float:
    """Correlation of neighbouring residuals, zero unless four standard errors from it."""
    squares = float(residuals @ residuals)
    if squares == 0:
        return 0.0
    correlation = float(residuals[1:] @ residuals[:-1]) / squares
    return correlation if abs(correlation) > 4 / math.sqrt(residuals.size) else 0.0


def _lost(e: Evidence) -> Finding | None:
    if bool(e.solution.converged):
        return None
    cause = "The search found no finite minimum: look at the record for steps."
    return Finding(Status.not_finite, cause)


def _within_noise(e: Evidence) -> Finding | None:
    rate, error = e.scaled("rate_mean")
    if e.separability.separable or error <= DETERMINED * abs(rate):
        return None
    limit = 1 / max(rate + 1.645 * error, 1e-300) / HOUR
    return Finding(
        Status.unidentified,
        f"The decay is within its noise: the lifetime is above {limit:.3g} h at 95 %; record "
        "longer or with less noise",
    )


def _inseparable(e: Evidence) -> Finding | None:
    found = e.separability
    if found.separable:
        return None
    if found.share_error is None:
        cause = "a and b are not separable on this record: record longer"
        return Finding(Status.unidentified, cause)
    # The bend of the decay grows with the square of the span.
    longer = (found.share_error / SEPARABLE) ** 0.5
    return Finding(
        Status.unidentified,
        f"a and b are not separable on this record (correlation {found.correlation:.6f}; share "
        f"of a in the loss {found.share:.2g} ± {found.share_error:.2g}); the lifetime at the "
        f"mean current is: record {max(longer, 1.1):.2g} times longer, or at several currents",
    )


def _stepped(e: Evidence) -> Finding | None:
    return Finding(Status.poor_fit, e.step) if e.step else None


def _negative(name: str, cause: str, e: Evidence) -> Finding | None:
    value, error = e.scaled(name)
    error *= e.separability.error_inflation
    if not (value < -BELIEVED * error and value < 0):
        return None
    return Finding(Status.infeasible, f"{name} is negative by {-value / error:.1f} errors; {cause}")


NOT_GAS = "no gas does that, so a is not constant: see constant_a_test, or give the shape of a"
RISING = "the loss rate rises as the current falls: look for a changing vacuum or setting"


def _improbable(e: Evidence) -> Finding | None:
    chi2, dof = e.chi2, e.dof
    if chi2_probability(chi2, dof) >= POOR_FIT:
        return None
    return Finding(
        Status.poor_fit,
        f"chi²/dof is {chi2 / dof:.3g}, improbable for this law and the stated errors, which "
        "are enlarged to match: look for steps with split_record, or test constant_a_test",
    )


def _determined(e: Evidence) -> Finding:
    return Finding(Status.converged, "a and b are determined")


RULES = (
    _lost,
    _within_noise,
    _inseparable,
    _stepped,
    partial(_negative, "b", NOT_GAS),
    partial(_negative, "a", RISING),
    _improbable,
    _determined,
)


def _noise_inferred(e: Evidence) -> str | None:
    if e.record.error is not None:
        return None
    noise = f"{e.scale:.3g} mA rms is inferred from the residuals"
    return f"The record gives no errors; {noise}"


def _correlated(e: Evidence) -> str | None:
    found = e.separability
    if found.error_inflation <= 1:
        return None
    return (
        f"Neighbouring residuals are correlated ({found.residual_correlation:.2f}), so the "
        f"true errors are about {found.error_inflation:.1f} times those given, or more"
    )


def _quantised(e: Evidence) -> str | None:
    step, noise = e.record.resolution, e.scale
    if e.record.error is not None:
        noise *= float(np.min(e.record.error))
    if step is None or step <= 2 * noise:
        return None
    return f"The readings are quantised in steps of {step:.3g} mA"


def _step_besides(e: Evidence) -> str | None:
    return None if e.separability.separable else e.step


REMARKS = (_noise_inferred, _correlated, _quantised, _step_besides)


def finding_of(evidence: Evidence) -> Finding:
    """Status and sentences: the gravest finding, then what is remarkable besides."""
    found = judge(evidence, RULES)
    if found.status is Status.not_finite:
        return found
    remarks = [said for remark in REMARKS if (said := remark(evidence))]
    return Finding(found.status, ". ".join([found.cause, *remarks]) + ".")
