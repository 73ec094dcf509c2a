"""Quoted numbers of an identified response, and its verdict by rules in order of severity."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.answer import Table, cell, json_of
from beamfit.dynamics.alternatives import FURTHER, GROWTH, HIGHER, Alternatives
from beamfit.dynamics.bad_readings import BadReadings
from beamfit.dynamics.checks import Checks, HeldOutRun
from beamfit.dynamics.input_laws import STATIC
from beamfit.dynamics.limits import LagPosterior
from beamfit.dynamics.model import PreparedOutput, curve_values
from beamfit.dynamics.response import ARX, FIRST_ORDER, SECOND_ORDER, Physics, mean_step
from beamfit.dynamics.search import MAX_NOISE_READINGS, RunsFit
from beamfit.errors import Finding, Status
from beamfit.greybox.fit import Derived, Fit
from beamfit.greybox.judge import gauges, together
from beamfit.noise.correlated import Memory
from beamfit.quantity import Quantity
from beamfit.statistics import POOR_FIT, quantity_of_draws

# Points of a curve. A point is visited if this many samples lie within this share of its range.
# Chosen.
CURVE_POINTS = 41
MIN_VISITS = 5
VISIT_DISTANCE = 0.05
TIME, GAIN, PURE = "s", "output/input", "1"


class Curve(NamedTuple):
    """A parameter against one input, the others at their means.

    Attributes
    ----------
    parameter, input : str
        Names of the parameter and of the input.
    unit : str
        Unit of the parameter.
    at, value, error : ndarray
        Values of the input, the parameter and its error, shape (points,); errors are NaN where the
        data do not determine the value.
    visited : ndarray of bool
        True where the runs have samples.
    """

    parameter: str
    input: str
    unit: str
    at: np.ndarray
    value: np.ndarray
    error: np.ndarray
    visited: np.ndarray

    def open(self) -> Curve:
        """Remove the errors of a curve that is not determined."""
        return self._replace(error=np.full_like(self.error, np.nan))

    def quantity(self, i: int) -> Quantity:
        """Give the value at point i, without an error where the runs have no samples."""
        determined = self.visited[i] and np.isfinite(self.error[i])
        return Quantity(
            float(self.value[i]), float(self.error[i]) if determined else None, self.unit
        )

    def table(self) -> Table:
        """Tabulate nine points."""
        rows = [
            [f"{self.at[i]:.4g}", cell(self.quantity(i)), "" if self.visited[i] else "not visited"]
            for i in np.linspace(0, len(self.at) - 1, 9).round().astype(int)
        ]
        return Table(f"{self.parameter} by {self.input}", [self.input, self.parameter, ""], rows)

    def to_json(self) -> dict[str, Any]:
        """Give the arrays, without errors where the runs have no samples."""
        return json_of(self._asdict() | {"error": np.where(self.visited, self.error, np.nan)})


def _units(physics: Physics, m: int) -> list[str]:
    return [TIME if time else GAIN if gain else PURE for time, gain in physics.units(m)]


def _quoted_values(model: Any, data: tuple[Any, float]) -> jax.Array:
    """Constant parameters, derived ratios, gains or lags, offset, and delay in seconds."""
    run, delay = data
    p = curve_values(model, (run, run.u[:1]))[0]
    parts = [p]
    if run.physics is FIRST_ORDER:
        parts.append(p[1:] / p[0])
    if run.physics is ARX:  # gains at rest, y = K u
        m = run.u.shape[1]
        parts.append((p[2 : 2 + m] + p[2 + m :]) / (1.0 + p[0] + p[1]))
    if run.physics is SECOND_ORDER:  # both lags of eq 8, where they are real
        root = jnp.sqrt(jnp.maximum(p[1] ** 2 - 1.0, 1e-12))
        parts.append(p[0] * (p[1] + jnp.stack([root, -root])))
    seconds = (delay + model["late"]) * mean_step(run.dt)
    return jnp.concatenate([*parts, jnp.stack([jnp.asarray(model["offset"]), seconds])])


def response_quantities(
    runs_fit: RunsFit,
    alternatives: Alternatives | None,
    delay_error: float,
    lags: LagPosterior,
    digits: np.ndarray,
    input_errors: Sequence[float],
) -> dict[str, Quantity]:
    """Constant parameters with errors, and the offset and the delay if they are free.

    For a first order whose readings all count in `lags`, the lag, gains and offset have its errors.
    `delay_error` is the error of the delay from the alternatives, s; `digits` the covariance of the
    free numbers by the digits of the output; `input_errors` the relative error of each input's gain
    from the errors of its levels.
    """
    prepared, fit, noise = runs_fit.prepared, runs_fit.fit, runs_fit.errors
    physics, m = prepared.runs[0].physics, len(prepared.inputs)
    found = derive_quantities(fit, noise, _quoted_values, (prepared.runs[0], prepared.delay))
    gains = FIRST_ORDER.parameters(prepared.inputs)[1:]
    units = dict(zip(physics.parameters(prepared.inputs), _units(physics, m), strict=True))
    units |= {
        FIRST_ORDER: {f"{name}/tau": f"{GAIN}/s" for name in gains},
        SECOND_ORDER: {"tau1": TIME, "tau2": TIME},
        ARX: dict.fromkeys(gains, GAIN),
    }[physics] | {"offset": "output", "delay": TIME}
    all_count = max(map(len, prepared.measured)) <= MAX_NOISE_READINGS
    drawn = lags.draws(gains) if physics is FIRST_ORDER and all_count else {}
    values, error = dict(zip(units, found.value, strict=True)), found.error
    drawn = {name: quantity_of_draws(draws, "", values[name]) for name, draws in drawn.items()}
    alone = [drawn[n].error if n in drawn else e for n, e in zip(units, error, strict=True)]
    error = np.where(np.isfinite(error), alone, np.nan)
    if alternatives is not None:
        error = np.append(alternatives.error(found.slope[:-1], error[:-1]), delay_error)
    shares = np.zeros(len(units))
    # Numbers in units of a gain belong to the inputs in turn.
    gain_indices = np.flatnonzero([GAIN in unit for unit in units.values()])
    shares[gain_indices] = np.resize(input_errors, len(gain_indices))
    found = widen_errors(found._replace(error=error), digits, shares)
    quantities = {name: quantity_at(found, i, unit) for i, (name, unit) in enumerate(units.items())}
    quantities |= {name: replace(quantities[name], interval_95=_widen_interval(q, quantities[name]))
             for name, q in drawn.items() if q.error and quantities[name].determined}  # fmt: skip
    free = {v.name for v in fit.variables}
    dropped = {name for name, leaf in (("offset", "offset"), ("delay", "late")) if leaf not in free}
    dropped |= {"tau1", "tau2"} if values.get("zeta", 2.0) <= 1.0 else set()  # not two real lags
    return {name: q for name, q in quantities.items() if name not in dropped}


def _widen_interval(drawn: Quantity, found: Quantity) -> tuple[float, float]:
    """Widen an interval by the ratio of two errors; that of a time constant in its logarithm."""
    ratio, ends, value = found.error / drawn.error, np.array(drawn.interval_95), drawn.value
    ends = value * (ends / value) ** ratio if found.unit == TIME else value + ratio * (ends - value)
    return float(ends[0]), float(ends[1])


def derive_quantities(fit: Fit, errors: Memory | None, function: Callable, data: Any) -> Derived:
    """Derive numbers from a fit, with errors averaged over the uncertainty of the noise."""
    found = fit.derive(function, data)
    if errors is None:
        return found
    slopes = found.slope.reshape(-1, found.slope.shape[-1])
    averaged = errors.moments(slopes).error.reshape(found.value.shape)
    return found._replace(error=np.where(np.isfinite(found.error), averaged, np.nan))


def widen_errors(found: Derived, digits: np.ndarray, input_errors: Any = 0.0) -> Derived:
    """Add the errors by the digits of outputs and by the errors of inputs.

    `digits` is the covariance of the free numbers by digits, `input_errors` the relative error of
    each number by the errors of its input.
    """
    by_digits = np.einsum("...p,pr,...r->...", found.slope, digits, found.slope)
    variance = found.error**2 + by_digits + (input_errors * found.value) ** 2
    return found._replace(error=np.sqrt(variance))


def quantity_at(found: Derived, i: Any, unit: str) -> Quantity:
    """Give number i as a quantity, without an error where the data do not determine it."""
    value, error, raw = (float(e[i]) for e in (found.value, found.error, found.error_raw))
    if not np.isfinite(error):
        return Quantity(value, None, unit)
    return Quantity(value, error, unit, raw)


def open_undetermined(
    quantities: Mapping[str, Quantity],
    curves: Sequence[Curve],
    prepared: PreparedOutput,
    checks: Checks,
    limits: tuple[float, float] = (np.nan, np.nan),
) -> tuple[dict[str, Quantity], tuple[Curve, ...]]:
    """Remove the errors of quantities and curves that the runs do not determine.

    These are all if the inputs explain no more than chance, gains of inputs that move together,
    lags that the runs do not distinguish from 0 or infinity, and what grows with such a lag.
    `limits` are the one-sided 95 % limits of the longest lag, 0 or infinite where it may be.
    """
    no_response = checks.nothing_probability >= POOR_FIT
    physics, inputs = prepared.runs[0].physics, prepared.inputs
    powers = zip(physics.parameters(inputs), physics.units(len(inputs)), strict=True)
    gains = [name for name, (_, gain) in powers if gain]
    inseparable = {n for k, n in enumerate(gains) if inputs[k % len(inputs)] in checks.together}
    zero, infinite = limits[0] == 0.0, np.isinf(limits[1])

    def is_open(name: str, q: Quantity) -> bool:
        # The gain of an infinite lag is infinite.
        grows = name.startswith(("tau", "T", "zeta", "K", "offset")) and not name.endswith("/tau")
        vanishes = zero and name.startswith(("tau", "T", "zeta"))
        vanishes |= name != "delay" and q.unit == TIME and q.determined and q.interval_95[0] <= 0.0
        # A higher order that is a first one determines only its gains and its longer lag.
        lower_order = checks.first_order and not name.startswith(("K", "offset", "tau1", "delay"))
        # A number at the end of its range has no slope there.
        at_end = name != "delay" and q.error == 0
        flags = no_response, infinite and grows, vanishes, lower_order, at_end, name in inseparable
        return any(flags)

    kept = {n: q.open() if is_open(n, q) else q for n, q in quantities.items()
             if infinite or not n.endswith("/tau")}  # fmt: skip
    kept |= {n: replace(kept[n], interval_95=limits) for n in ("tau", "tau1")
              if n in kept and zero != infinite and not no_response}  # fmt: skip
    removed = (no_response or c.parameter in inseparable for c in curves)
    return kept, tuple(c.open() if b else c for c, b in zip(curves, removed, strict=True))


# Verdicts of a model that the runs refute or that was not found: no error covers what is wrong.
WRONG_MODEL = (Status.poor_fit, Status.not_converged, Status.not_finite)


def remove_errors_if_wrong(
    status: Status, quantities: Mapping[str, Quantity], curves: Sequence[Curve] = ()
) -> tuple[dict[str, Quantity], tuple[Curve, ...]]:
    """Remove all errors if the verdict is `WRONG_MODEL`."""
    if status not in WRONG_MODEL:
        return dict(quantities), tuple(curves)
    return {name: q.open() for name, q in quantities.items()}, tuple(c.open() for c in curves)


MAX_DELAY_REMARK = "The delay is the longest that was tried: say a longer one by --delay."


def add_remarks(message: str, at_longest: bool, left_out: Sequence[BadReadings]) -> str:
    """Add to a message that the delay is the longest tried, and which readings are left out."""
    excluded = (f"Left out: {each}." for each in left_out)
    return " ".join([message, *([MAX_DELAY_REMARK] if at_longest else []), *excluded])


def limit_words(q: Quantity) -> str:
    """Give the limit of a quantity without an error in words; empty if it has none."""
    if q.error is not None or q.interval_95 is None:
        return ""
    low, high = q.interval_95
    return f"above {low:.3g} {q.unit}" if np.isinf(high) else f"below {high:.3g} {q.unit}"


def curves_of(fit: Fit, errors: Memory | None, prepared: PreparedOutput) -> tuple[Curve, ...]:
    """Curves of every parameter against every input, with the other inputs at their means."""
    physics, m = prepared.runs[0].physics, len(prepared.inputs)
    points, found = prepared.points, []
    for j, name in enumerate(prepared.inputs):
        low, high = points[:, j].min(), points[:, j].max()
        grid = np.tile(prepared.mean_u, (CURVE_POINTS, 1))
        grid[:, j] = at = np.linspace(low, high, CURVE_POINTS)
        distance = np.abs(points[:, j][None, :] - at[:, None])
        visited = np.sum(distance <= VISIT_DISTANCE * (high - low), axis=1) >= MIN_VISITS
        numbers = derive_quantities(
            fit, errors, curve_values, (prepared.runs[0], jnp.asarray(grid))
        )
        names = physics.parameters(prepared.inputs)
        found += [
            Curve(names[i], name, unit, at, numbers.value[:, i], numbers.error[:, i], visited)
            for i, unit in enumerate(_units(physics, m))
        ]
    return tuple(found)


# A curve counts as determined if this share of its visited points has an error.
MIN_DETERMINED_SHARE = 0.5
# A held-out run counts as predicted if its residual is at most this many times that of the fit.
MAX_HELD_OUT_RATIO = 2.0


class ResponseEvidence(NamedTuple):
    """Input of the rules.

    `lead` is the number of samples by which the output moves before its inputs, 0 if the delay was
    given.
    """

    fit: Fit
    converged: bool
    checks: Checks
    quantities: Mapping[str, Quantity]
    curves: tuple[Curve, ...]
    held: tuple[HeldOutRun, ...]
    map: str
    rms: float
    lead: float = 0.0


def judge_outputs(found: Mapping[str, ResponseEvidence]) -> tuple[Status, str]:
    """Judge several outputs of one model by the first rule that any of them breaks."""
    for rule in RULES:
        findings = {name: f for name, e in found.items() if (f := rule(e)) is not None}
        texts = {f.message: [n for n in findings if findings[n].message == f.message]
                 for f in findings.values()}  # fmt: skip
        if findings:
            each = (text if len(names) == len(found) else f"{', '.join(names)}: {text}"
                    for text, names in texts.items())  # fmt: skip
            return next(iter(findings.values())).status, " ".join(each)
    raise AssertionError("the last rule always finds something")


def search_failed(e: Any) -> Finding | None:
    """Find that the search did not converge."""
    if e.converged and e.fit.groups:
        return None
    lost = e.fit.status is Status.not_finite
    return Finding(Status.not_finite if lost else Status.not_converged, e.fit.message)


WANDERS = "The noise wanders about as slowly as the output responds."
REPEAT = "Repeat the steps, up and down, so that a drift does not look like a response."


def _no_response(e: ResponseEvidence) -> Finding | None:
    if e.checks.nothing_probability < POOR_FIT:
        return None
    cause = "The inputs explain no more of the output than chance would."
    if e.checks.white_probability < POOR_FIT:
        return Finding(Status.unidentified, f"{cause} {WANDERS}", REPEAT)
    remedy = (
        "Move the inputs further, record longer, try a longer delay (--delay), or look for what "
        "else drives the output."
    )
    return Finding(Status.unidentified, cause, remedy)


def _inseparable(e: ResponseEvidence) -> Finding | None:
    if not e.checks.together:
        return None
    inputs = ", ".join(e.checks.together)
    cause = f"Inputs {inputs} move together: only their joint effect is determined."
    return Finding(Status.unidentified, cause, "Move one at a time, or leave one out.")


def _lower_order(e: ResponseEvidence) -> Finding | None:
    if not e.checks.first_order:
        return None
    cause = "A first order explains the runs as well: "
    if "a1" in e.quantities:
        gains = [q for name, q in e.quantities.items() if name.startswith("K")]
        gain = "; K is." if all(q.determined for q in gains) else "."
        cause += f"a pole and a zero cancel, so that a1, a2, b1 and b2 are not determined{gain}"
    else:
        cause += "the shorter lag is compatible with 0, so that T and zeta are not determined."
    return Finding(Status.unidentified, cause, "Use --model first-order.")


def _undetermined(e: ResponseEvidence) -> Finding | None:
    left = {n: q.unit for n, q in e.quantities.items() if q.error is None}
    left |= {
        f"{c.parameter}({c.input})": c.unit
        for c in e.curves
        if np.mean(np.isfinite(c.error) & c.visited) < MIN_DETERMINED_SHARE
    }
    if not left:
        return None
    if e.fit.undetermined.shape[1]:  # a freedom of the model, that no run would end
        tied = gauges(e.fit.problem, e.fit.theta, e.fit.undetermined)
        if tied := [g for g in tied if {n.removeprefix("p.") for n in g.names} & set(left)]:
            return together(tied)
    if e.curves and all(np.isfinite(c.error[c.visited]).all() for c in e.curves):
        cause = f"The runs determine {', '.join(left)} only at the few values that inputs had."
        return Finding(Status.unidentified, cause, "Step the inputs to values in between.")
    cause = f"The runs do not determine {', '.join(left)}."
    remedy = "Move the inputs over more of their range."
    limits = {n: words for n, q in e.quantities.items() if (words := limit_words(q))}
    cause += "".join(f" {n} is {words} (95 %)." for n, words in limits.items())
    if TIME in left.values():
        remedy = "Sample faster around steps, and wait until the output settles."
        if limits and all("above" in words for words in limits.values()):
            remedy = "Record longer, until the output settles, or repeat the steps."
        if e.checks.white_probability < POOR_FIT:
            cause, remedy = f"{cause} {WANDERS}", REPEAT
    return Finding(Status.unidentified, cause, remedy)


def _output_leads(e: ResponseEvidence) -> Finding | None:
    if not e.lead:
        return None
    cause = (
        f"The output moves {e.lead:.3g} samples before its inputs: their clocks differ by so "
        "much, or the inputs were set from the output (feedback)."
    )
    remedy = f"If it is the clock, say so (--delay {-e.lead:.3g}): the answer then stands."
    return Finding(Status.poor_fit, cause, remedy)


def _feedback(e: ResponseEvidence) -> Finding | None:
    c = e.checks
    if c.feedback_probability >= POOR_FIT:
        return None
    chance = _p_value(c.feedback_probability)
    if c.band_limited:
        cause = (
            f"Inputs of the same moment and later explain {100 * c.feedback_share:.0f} % of the "
            f"residuals ({chance}), and {', '.join(c.band_limited)} has no "
            "high frequencies: it moves between samples, where the model holds each value until "
            "the next."
        )
        return Finding(Status.poor_fit, cause, "Sample faster, or hold inputs between samples.")
    cause = (
        f"Inputs of the same moment and later go with {100 * c.feedback_share:.0f} % of the noise "
        f"({chance}): they were set from the output (feedback). What noise "
        "made the inputs do is then taken for a response, gains lean to the inverse of the "
        "controller's, and no error contains it."
    )
    remedy = "Open the loop, or move inputs or set points by far more than the noise does."
    return Finding(Status.poor_fit, cause, remedy)


# Smallest probability that a message states.
MIN_P_VALUE = 1e-16


def _p_value(p: float) -> str:
    return f"p < {MIN_P_VALUE:.0e}" if p < MIN_P_VALUE else f"p = {p:.1g}"


def _departs(e: ResponseEvidence) -> Finding | None:
    c = e.checks
    if c.law is None or c.no_law_probability >= POOR_FIT:
        return None
    follows = "has" if c.law_kind in (FURTHER, GROWTH, HIGHER) else "follows"
    cause = f"The output {follows} {c.law} ({_p_value(c.no_law_probability)} without)"
    if c.law_kind == GROWTH:
        remedy = "Cut the record into shorter ones, or give what it changes with as an input."
        cause += " along the record."
    elif c.law_kind == FURTHER:
        cause += ": the model lacks a part of the response."
        remedy = f"Try {_fuller_model(e)}."
    elif c.law_kind == HIGHER:
        cause += ": the model lacks a part of the response."
        remedy = "Use a higher order: --model second-order."
    elif c.law_kind in STATIC:
        cause += ": the gain then changes with the input."
        remedy = "Stay where the gain is the same, or let it change: --map network."
    elif c.law_kind == "rate limit":
        cause += ": it takes its time for a step, the longer the larger."
        remedy = "Record what it really does, or move in smaller steps."
    else:
        cause += ": what moves up and down then differs."
        remedy = "Go to each value from the same side, or move by much more than the width."
    cause += f" The free run explains {c.free_run_percent:.1f} % of the output."
    return Finding(Status.poor_fit, cause, remedy)


def _lacks_response(e: ResponseEvidence) -> Finding | None:
    c = e.checks
    if c.input_probability >= POOR_FIT:
        return None
    cause = (
        f"Past inputs, or parameters that change with them, explain {100 * c.input_share:.0f} % of "
        f"the residuals ({_p_value(c.input_probability)}): the model lacks a part of the response. "
        f"The free run explains {c.free_run_percent:.1f} % of the output."
    )
    return Finding(Status.poor_fit, cause, f"Try {_fuller_model(e)}.")


def _fuller_model(e: ResponseEvidence) -> str:
    """Suggest a fuller model."""
    more = "parameters that change with the operating point (--map network), or "
    return f"{'' if e.map == 'network' else more}a higher order"


def _fails_held_out(e: ResponseEvidence) -> Finding | None:
    bad = [h for h in e.held if h.rms > MAX_HELD_OUT_RATIO * e.rms]
    if not bad:
        return None
    cause = (
        f"Run {bad[0].name}, held back, is predicted with a residual of {bad[0].rms:.3g} rms, "
        f"where the fit has {e.rms:.3g}."
    )
    remedy = "Use runs that cover the model's range, or fewer hidden nodes."
    return Finding(Status.poor_fit, cause, remedy)


def _remarks(c: Checks) -> str:
    """Sentences on noise, input motion, jitter, drift and possible laws that the errors contain."""
    smooth, ramping, standing = map(", ".join, c.way)
    law = c.law[:1].upper() + c.law[1:] if c.law is not None else ""
    likelier = f"likelier than none (P = {1.0 - c.no_law_probability:.2f})"
    sentences = {
        "The noise has a memory, which the errors contain.": c.white_probability < POOR_FIT,
        f"Without high frequencies, {smooth} is taken to move between samples.": smooth,
        f"Between samples {ramping} is taken to move in straight lines.": ramping,
        f"Readings of {standing} scatter about levels; the output follows the levels.": standing,
        f"Times of readings are uncertain by {c.jitter:.2g} s: errors contain it.": c.jitter,
        f"The output drifts as well (degree {c.drift} in time): errors contain it.": c.drift,
        f"{law} is {likelier}: errors contain it.": law,
    }
    return "".join(f" {sentence}" for sentence, holds in sentences.items() if holds)


def _converged(e: ResponseEvidence) -> Finding:
    cause = f"The free run explains {e.checks.free_run_percent:.2f} % of the output."
    cause += _remarks(e.checks)
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


RULES = (
    search_failed,
    _no_response,
    _inseparable,
    _output_leads,
    _departs,
    _feedback,
    _lower_order,
    _lacks_response,
    _undetermined,
    _fails_held_out,
    _converged,
)
