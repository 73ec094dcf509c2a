"""The verdict on an identified response, by rules in order of gravity."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from beamfit.dynamics.checks import Checks, HeldOutRun
from beamfit.dynamics.curve import TIME, Curve
from beamfit.greybox.fit import Fit
from beamfit.quantity import Quantity
from beamfit.statistics import POOR_FIT
from beamfit.status import Status
from beamfit.verdict import Finding

# Share of a visited curve that must have an error for it to be determined.
HALF = 0.5
# Largest residual of a held-out run, in units of the fit's, at which it counts as predicted.
WORSE = 2.0


class ResponseEvidence(NamedTuple):
    """Input of the rules."""

    fit: Fit
    rests: bool
    checks: Checks
    quantities: Mapping[str, Quantity]
    curves: tuple[Curve, ...]
    held: tuple[HeldOutRun, ...]
    map: str
    rms: float


def judged(found: Mapping[str, ResponseEvidence]) -> tuple[Status, str]:
    """Status and sentences of several outputs of one model: the gravest rule that any breaks."""
    for rule in RULES:
        said = {name: f for name, e in found.items() if (f := rule(e)) is not None}
        texts = {f.message: [n for n in said if said[n].message == f.message]
                 for f in said.values()}  # fmt: skip
        if said:
            each = (text if len(names) == len(found) else f"{', '.join(names)}: {text}"
                    for text, names in texts.items())  # fmt: skip
            return next(iter(said.values())).status, " ".join(each)
    raise AssertionError("the last rule always finds something")


def rms_of(fit: Fit) -> float:
    """The noise of all runs, as the fit weighs them."""
    found = [float(group.scale * np.mean(np.asarray(record.error)))
             for group, record in zip(fit.groups, fit.problem.records, strict=True)]  # fmt: skip
    return float(np.sqrt(np.mean(np.square(found))))


def _lost(e: ResponseEvidence) -> Finding | None:
    if e.rests:
        return None
    lost = e.fit.status is Status.not_finite
    return Finding(Status.not_finite if lost else Status.not_converged, e.fit.message)


def _nothing(e: ResponseEvidence) -> Finding | None:
    if e.checks.nothing_probability < POOR_FIT:
        return None
    cause = "The inputs explain no more of the output than chance would."
    remedy = (
        "Move the inputs further, record longer, try a longer delay (--delay), or look for what "
        "else drives the output."
    )
    return Finding(Status.unidentified, cause, remedy)


def _joint(e: ResponseEvidence) -> Finding | None:
    if not e.checks.together:
        return None
    inputs = ", ".join(e.checks.together)
    cause = f"Inputs {inputs} move together: only their joint effect is determined."
    return Finding(Status.unidentified, cause, "Move one at a time, or leave one out.")


def _lower(e: ResponseEvidence) -> Finding | None:
    if not e.checks.first_order:
        return None
    cause = "A first order explains the runs as well: "
    if "a1" in e.quantities:
        cause += "a pole and a zero cancel, so that a1, a2, b1 and b2 are not determined; K is."
    else:
        cause += "the shorter lag is compatible with 0, so that T and zeta are not determined."
    return Finding(Status.unidentified, cause, "Use --model first-order.")


def _open(e: ResponseEvidence) -> Finding | None:
    left = {n: q.unit for n, q in e.quantities.items() if q.error is None}
    left |= {
        f"{c.parameter}({c.input})": c.unit
        for c in e.curves
        if np.mean(np.isfinite(c.error) & c.visited) < HALF
    }
    if not left:
        return None
    cause = f"The runs do not determine {', '.join(left)}."
    remedy = "Move the inputs over more of their range."
    if TIME in left.values():
        remedy = "Sample faster around steps, and wait until the output settles."
        if e.checks.white_probability < POOR_FIT:
            cause += " The noise wanders about as slowly as the output responds."
            remedy = "Repeat the steps, up and down, so that a drift does not look like a response."
    return Finding(Status.unidentified, cause, remedy)


def _fed_back(e: ResponseEvidence) -> Finding | None:
    c = e.checks
    if c.feedback_probability >= POOR_FIT:
        return None
    if c.band_limited:
        cause = (
            f"Inputs of the same moment and later explain {100 * c.feedback_share:.0f} % of the "
            f"residuals (p = {c.feedback_probability:.1g}), and {', '.join(c.band_limited)} has no "
            "high frequencies: it moves between samples, where the model holds each value until "
            "the next."
        )
        return Finding(Status.poor_fit, cause, "Sample faster, or hold inputs between samples.")
    cause = (
        f"Inputs of the same moment and later go with {100 * c.feedback_share:.0f} % of the noise "
        f"(p = {c.feedback_probability:.1g}): they were set from the output (feedback). What noise "
        "made the inputs do is then taken for a response, gains lean to the inverse of the "
        "controller's, and no error contains it."
    )
    remedy = "Open the loop, or move inputs or set points by far more than the noise does."
    return Finding(Status.poor_fit, cause, remedy)


def _refuted(e: ResponseEvidence) -> Finding | None:
    c = e.checks
    if c.input_probability >= POOR_FIT:
        return None
    cause = (
        f"Past inputs, or parameters that change with them, explain {100 * c.input_share:.0f} % of "
        f"the residuals (p = {c.input_probability:.1g}): the model lacks a part of the response. "
        f"The free run explains {c.free_run_percent:.1f} % of the output."
    )
    if c.law is not None:
        cause += f" Most of it is {c.law}; what moves up and down then differs."
        remedy = "Go to each value from the same side, or move by much more than the width."
        return Finding(Status.poor_fit, cause, remedy)
    more = "parameters that change with the operating point (--map network), or a higher order"
    more = "a higher order" if e.map == "network" else more
    return Finding(Status.poor_fit, cause, f"Try {more}.")


def _worse(e: ResponseEvidence) -> Finding | None:
    bad = [h for h in e.held if h.rms > WORSE * e.rms]
    if not bad:
        return None
    cause = (
        f"Run {bad[0].name}, held back, is predicted with a residual of {bad[0].rms:.3g} rms, "
        f"where the fit has {e.rms:.3g}."
    )
    remedy = "Use runs that cover the model's range, or fewer hidden nodes."
    return Finding(Status.poor_fit, cause, remedy)


def _good(e: ResponseEvidence) -> Finding:
    cause = f"The free run explains {e.checks.free_run_percent:.2f} % of the output."
    if e.checks.white_probability < POOR_FIT:
        cause += " The noise has a memory, which the errors contain."
    gains = [q for name, q in e.quantities.items() if name.startswith("K")]
    if gains and all(q.error is not None and abs(q.value) < 2 * q.error for q in gains):
        cause += " All gains are compatible with 0: only the return of the output to rest is seen."
    gain = e.checks.against_constant
    if gain is not None and gain < 0:
        cause += " Constant parameters fit as well (BIC): the operating point is not needed."
    never = {c.input for c in e.curves if not c.visited.all()}
    if never:
        cause += f" Parts of the range of {', '.join(sorted(never))} were not visited."
    return Finding(Status.converged, cause)


RULES = (_lost, _nothing, _joint, _fed_back, _lower, _open, _refuted, _worse, _good)
