"""What a least-squares solution is worth: separability, and the rules that say why."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from beamfit.lifetime.decay import HOUR
from beamfit.statistics import chi2_probability
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
POOR_FIT = 1e-3
# A change between neighbouring residuals of so many times their usual one is a step, not noise.
STEP = 12.0
# How many errors below zero an unphysical a or b, or a rising current, is believed.
BELIEVED = 5.0


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


class Evidence(NamedTuple):
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
        value, error = (
            getattr(part, name) for part in (self.solution.values, self.solution.errors)
        )
        return float(value), float(error) * self.scale

    @property
    def separability(self) -> Separability:
        """Of a and b."""
        neighbours = _neighbours(self.residuals)
        # Variance of a mean of residuals that decorrelate exponentially.
        together = min(max(neighbours, 0.0), 0.999)
        inflation = math.sqrt((1 + max(neighbours, 0.0)) / (1 - together))
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


class Judged(NamedTuple):
    """Evidence, with what has been made of it for several rules."""

    evidence: Evidence
    separability: Separability
    step: str | None


def _neighbours(residuals: np.ndarray) -> float:
    """Correlation of neighbouring residuals, zero unless four standard errors from it."""
    squares = float(residuals @ residuals)
    if squares == 0:
        return 0.0
    correlation = float(residuals[1:] @ residuals[:-1]) / squares
    return correlation if abs(correlation) > 4 / math.sqrt(residuals.size) else 0.0


def _step(record: DecayRecord, residuals: np.ndarray) -> str | None:
    """The sentence for a step or spike in the record, whether or not its errors are known."""
    change = np.diff(residuals)
    usual = 1.4826 * float(np.median(np.abs(change)))
    floor = max(record.resolution or 0.0, 1e-12 * float(record.current.max()))
    largest = int(np.argmax(np.abs(change)))
    if abs(change[largest]) <= STEP * max(usual, floor):
        return None
    # Residuals are model minus reading, so a refill lowers them.
    return (
        f"The record has a step of {-change[largest]:+.4g} mA at {record.time[largest + 1]:.6g} s: "
        "cut it with split_record and fit the pieces"
    )


def _lost(j: Judged) -> Finding | None:
    if bool(j.evidence.solution.converged):
        return None
    cause = "The search found no finite minimum: look at the record for steps."
    return Finding(Status.not_finite, cause)


def _within_noise(j: Judged) -> Finding | None:
    rate, error = j.evidence.scaled("rate_mean")
    if j.separability.separable or error <= DETERMINED * abs(rate):
        return None
    limit = 1 / max(rate + 1.645 * error, 1e-300) / HOUR
    return Finding(
        Status.unidentified,
        f"The decay is within its noise: the lifetime is above {limit:.3g} h at 95 %; record "
        "longer or with less noise",
    )


def _inseparable(j: Judged) -> Finding | None:
    found = j.separability
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


def _stepped(j: Judged) -> Finding | None:
    return Finding(Status.poor_fit, j.step) if j.step else None


def _negative(name: str, cause: str, j: Judged) -> Finding | None:
    value, error = j.evidence.scaled(name)
    error *= j.separability.error_inflation
    if not (value < -BELIEVED * error and value < 0):
        return None
    return Finding(Status.infeasible, f"{name} is negative by {-value / error:.1f} errors; {cause}")


def _negative_b(j: Judged) -> Finding | None:
    cause = "no gas does that, so a is not constant: see constant_a_test, or give the shape of a"
    return _negative("b", cause, j)


def _negative_a(j: Judged) -> Finding | None:
    cause = "the loss rate rises as the current falls: look for a changing vacuum or setting"
    return _negative("a", cause, j)


def _improbable(j: Judged) -> Finding | None:
    chi2, dof = j.evidence.chi2, j.evidence.dof
    if chi2_probability(chi2, dof) >= POOR_FIT:
        return None
    return Finding(
        Status.poor_fit,
        f"chi²/dof is {chi2 / dof:.3g}, improbable for this law and the stated errors, which "
        "are enlarged to match: look for steps with split_record, or test constant_a_test",
    )


def _determined(j: Judged) -> Finding:
    return Finding(Status.converged, "a and b are determined")


RULES = (
    _lost,
    _within_noise,
    _inseparable,
    _stepped,
    _negative_b,
    _negative_a,
    _improbable,
    _determined,
)


def _noise_inferred(j: Judged) -> str | None:
    if j.evidence.record.error is not None:
        return None
    noise = f"{j.evidence.scale:.3g} mA rms is inferred from the residuals"
    return f"The record gives no errors; {noise}"


def _correlated(j: Judged) -> str | None:
    found = j.separability
    if found.error_inflation <= 1:
        return None
    return (
        f"Neighbouring residuals are correlated ({found.residual_correlation:.2f}), so the "
        f"true errors are about {found.error_inflation:.1f} times those given, or more"
    )


def _quantised(j: Judged) -> str | None:
    step, noise = j.evidence.record.resolution, j.evidence.scale
    if j.evidence.record.error is not None:
        noise *= float(np.min(j.evidence.record.error))
    if step is None or step <= 2 * noise:
        return None
    return f"The readings are quantised in steps of {step:.3g} mA"


def _step_besides(j: Judged) -> str | None:
    return None if j.separability.separable else j.step


REMARKS = (_noise_inferred, _correlated, _quantised, _step_besides)


def finding_of(evidence: Evidence, separability: Separability) -> Finding:
    """Status and sentences: the gravest finding, then what is remarkable besides."""
    judged = Judged(evidence, separability, _step(evidence.record, evidence.residuals))
    found = judge(judged, RULES)
    if found.status is Status.not_finite:
        return found
    remarks = [said for remark in REMARKS if (said := remark(judged))]
    return Finding(found.status, ". ".join([found.cause, *remarks]) + ".")
