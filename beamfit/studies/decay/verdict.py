"""What a least-squares solution is worth: errors, status, and the sentence that says why."""

from __future__ import annotations

import math

import numpy as np

from beamfit.errors import InputError
from beamfit.quantity import Quantity, Status
from beamfit.statistics import chi2_probability
from beamfit.studies.decay.model import Physical, Solution
from beamfit.studies.decay.record import DecayRecord
from beamfit.studies.decay.result import DecayFit, Separability

__all__ = ["judge", "judge_constant"]

HOUR = 3600.0
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


def _quantity(
    value: float, error: float, raw: float, scale: float, unit: str, known: bool
) -> Quantity:
    value, error = float(value), float(error)
    if not math.isfinite(value):
        return Quantity(math.nan, None, unit)
    if not known or not math.isfinite(error):
        return Quantity(value, None, unit)
    return Quantity(value, error * scale, unit, error * raw)


def _lifetime(rate: float, error: float, raw: float, scale: float, known: bool) -> Quantity:
    """Lifetime in hours from a loss rate; no error where the rate is not clear of zero."""
    if not rate > 0:
        return Quantity(math.nan, None, "h")
    known = known and error * scale < DETERMINED * rate
    return _quantity(1 / rate / HOUR, error / rate**2 / HOUR, raw, scale, "h", known)


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


def _separability(
    values: Physical, errors: Physical, scale: float, correlation: float, residuals: np.ndarray
) -> Separability:
    neighbours = _neighbours(residuals)
    # Variance of a mean of residuals that decorrelate exponentially.
    inflation = math.sqrt((1 + max(neighbours, 0.0)) / (1 - min(max(neighbours, 0.0), 0.999)))
    share, error = float(values.share), float(errors.share) * scale * inflation
    finite = math.isfinite(share) and math.isfinite(error)
    return Separability(
        separable=finite and error < SEPARABLE,
        share=share if finite else None,
        share_error=error if finite else None,
        correlation=correlation if math.isfinite(correlation) else None,
        residual_correlation=neighbours,
        error_inflation=inflation,
    )


def _unidentified(solution: Solution, scale: float, verdict: Separability) -> str:
    """Say what is missing, and how long a record would bring it."""
    rate, error = float(solution.values.rate_mean), float(solution.errors.rate_mean) * scale
    if error > DETERMINED * abs(rate):
        limit = 1 / max(rate + 1.645 * error, 1e-300) / HOUR
        return (
            f"The decay is within its noise: the lifetime is above {limit:.3g} h at 95 %; record "
            "longer or with less noise"
        )
    if verdict.share_error is None:
        return "a and b are not separable on this record: record longer"
    # The bend of the decay grows with the square of the span.
    longer = (verdict.share_error / SEPARABLE) ** 0.5
    return (
        f"a and b are not separable on this record (correlation {verdict.correlation:.6f}; share "
        f"of a in the loss {verdict.share:.2g} ± {verdict.share_error:.2g}); the lifetime at the "
        f"mean current is: record {max(longer, 1.1):.2g} times longer, or at several currents"
    )


def _negative(values: Physical, errors: Physical, scale: float, inflation: float) -> str | None:
    """The sentence for a coefficient that is negative beyond its error."""
    causes = {
        "b": "no gas does that, so a is not constant: see constant_a_test, or give the shape of a",
        "a": "the loss rate rises as the current falls: look for a changing vacuum or setting",
    }
    for name, cause in causes.items():
        value, error = float(getattr(values, name)), float(getattr(errors, name)) * scale
        if value < -BELIEVED * error * inflation and value < 0:
            return f"{name} is negative by {-value / (error * inflation):.1f} errors; {cause}"
    return None


def _quantised(record: DecayRecord, scale: float) -> list[str]:
    step, noise = record.resolution, scale
    if record.error is not None:
        noise *= float(np.min(record.error))
    if step is None or step <= 2 * noise:
        return []
    return [f"The readings are quantised in steps of {step:.3g} mA"]


def _status(
    record: DecayRecord,
    solution: Solution,
    chi2: float,
    dof: int,
    scale: float,
    verdict: Separability,
) -> tuple[Status, str]:
    """Status and message, the gravest first."""
    if not bool(solution.converged):
        return (
            Status.not_finite,
            "The search found no finite minimum: look at the record for steps.",
        )
    remarks = []
    if record.error is None:
        noise = f"{scale:.3g} mA rms is inferred from the residuals"
        remarks.append(f"The record gives no errors; {noise}")
    if verdict.error_inflation > 1:
        remarks.append(
            f"Neighbouring residuals are correlated ({verdict.residual_correlation:.2f}), so the "
            f"true errors are about {verdict.error_inflation:.1f} times those given, or more"
        )
    remarks += _quantised(record, scale)
    step = _step(record, solution.residuals[: len(record)])
    if not verdict.separable:
        status, cause = Status.unidentified, _unidentified(solution, scale, verdict)
        remarks += [step] if step else []
    elif step:
        status, cause = Status.poor_fit, step
    elif negative := _negative(solution.values, solution.errors, scale, verdict.error_inflation):
        status, cause = Status.infeasible, negative
    elif chi2_probability(chi2, dof) < POOR_FIT:
        status = Status.poor_fit
        cause = (
            f"chi²/dof is {chi2 / dof:.3g}, improbable for this law and the stated errors, which "
            "are enlarged to match: look for steps with split_record, or test constant_a_test"
        )
    else:
        status, cause = Status.converged, "a and b are determined"
    return status, ". ".join([cause, *remarks]) + "."


def judge_constant(record: DecayRecord) -> DecayFit:
    """The result for readings that are all equal: no decay is seen, and no noise either."""
    level = float(record.current[0])
    unknown = {
        name: Quantity(math.nan, None, unit) for name, unit in (("a", "1/(mA s)"), ("b", "1/s"))
    }
    lifetimes = ("lifetime_start", "lifetime_end", "lifetime_mean")
    unknown |= {name: Quantity(math.nan, None, "h") for name in lifetimes}
    message = (
        f"All {len(record)} readings are {level:.6g} mA, so neither decay nor noise is seen: "
        "record longer, or read the monitor with more digits."
    )
    return DecayFit(
        record=record.name,
        status=Status.unidentified,
        message=message,
        i0=Quantity(level, None, "mA"),
        **unknown,
        mean_current=level,
        chi2=0.0,
        dof=len(record) - 1,
        rms_residual=0.0,
        noise_inferred=record.error is None,
        residuals=np.zeros(len(record)),
        identifiability=Separability(False, None, None, None, None, 1.0),
        readings=record,
    )


def judge(record: DecayRecord, solution: Solution) -> DecayFit:
    """Turn a solution into quantities, a status and its sentence."""
    rows = len(record)
    residuals = np.asarray(solution.residuals[:rows])
    dof = rows - 3
    squares = float(solution.sum_squares)
    inferred = record.error is None
    # Without errors the weights were 1/mA: the residuals say what one standard deviation is.
    raw = math.sqrt(squares / dof) if inferred else 1.0
    chi2 = float(dof) if inferred else squares
    scale = raw * max(1.0, math.sqrt(chi2 / dof))
    values, errors = solution.values, solution.errors

    mean_error = float(errors.rate_mean) * scale
    if float(values.rate_mean) < -BELIEVED * mean_error:
        first, last = record.current[0], record.current[-1]
        expected = "a decay; cut out refills with split_record"
        found = f"a current that rises, {first:.6g} to {last:.6g} mA"
        raise InputError(found, expected, path=record.name, column="current")

    separability = _separability(values, errors, scale, float(solution.correlation), residuals)
    known = bool(solution.converged)
    a, b = (
        _quantity(getattr(values, name), getattr(errors, name), raw, scale, unit, known=determined)
        for name, unit in (("a", "1/(mA s)"), ("b", "1/s"))
        for determined in (known and separability.separable,)
    )
    status, message = _status(record, solution, chi2, dof, scale, separability)
    return DecayFit(
        record=record.name,
        status=status,
        message=message,
        i0=_quantity(values.i0, errors.i0, raw, scale, "mA", known),
        a=a,
        b=b,
        lifetime_start=_lifetime(values.rate_start, errors.rate_start, raw, scale, known),
        lifetime_end=_lifetime(values.rate_end, errors.rate_end, raw, scale, known),
        lifetime_mean=_lifetime(values.rate_mean, errors.rate_mean, raw, scale, known),
        mean_current=float(record.current.mean()),
        chi2=chi2,
        dof=dof,
        rms_residual=float(np.sqrt(np.mean(residuals**2))),
        noise_inferred=inferred,
        residuals=residuals,
        identifiability=separability,
        readings=record,
    )
