"""Quoted numbers of an identified response, and its verdict by rules in order of gravity.

Constants have errors, curves bands.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.answer import Table, cell, json_of
from beamfit.dynamics.alternatives import FURTHER, GROWTH, Alternatives
from beamfit.dynamics.bad_readings import BadReadings
from beamfit.dynamics.checks import Checks, HeldOutRun
from beamfit.dynamics.input_laws import STATIC
from beamfit.dynamics.limits import LagPosterior
from beamfit.dynamics.model import PreparedOutput, curves
from beamfit.dynamics.response import ARX, FIRST_ORDER, SECOND_ORDER, Physics, mean_step
from beamfit.dynamics.search import LONGEST, Begun
from beamfit.errors import Finding, Status
from beamfit.greybox.fit import Derived, Fit
from beamfit.greybox.judge import gauges, together
from beamfit.noise.correlated import Memory
from beamfit.quantity import Quantity
from beamfit.statistics import POOR_FIT, quantity_of_draws

# Points of a curve; samples within a share of its range that make a point visited.
POINTS, VISITS, NEAR = 41, 5, 0.05
TIME, GAIN, PURE = "s", "output/input", "1"


class Curve(NamedTuple):
    """A parameter against one input, the others at their means.

    Attributes
    ----------
    parameter, input : str
        What, against what.
    unit : str
        Of the parameter.
    at, value, error : ndarray
        Shape (points,); errors are NaN where the data do not determine the value.
    visited : ndarray of bool
        Whether the runs were there.
    """

    parameter: str
    input: str
    unit: str
    at: np.ndarray
    value: np.ndarray
    error: np.ndarray
    visited: np.ndarray

    def open(self) -> Curve:
        """The same of which nothing is known: without errors."""
        return self._replace(error=np.full_like(self.error, np.nan))

    def quantity(self, i: int) -> Quantity:
        """The value at one point, without an error where the runs never were."""
        known = self.visited[i] and np.isfinite(self.error[i])
        return Quantity(float(self.value[i]), float(self.error[i]) if known else None, self.unit)

    def table(self) -> Table:
        """A few points, to be shown."""
        rows = [
            [f"{self.at[i]:.4g}", cell(self.quantity(i)), "" if self.visited[i] else "not visited"]
            for i in np.linspace(0, len(self.at) - 1, 9).round().astype(int)
        ]
        return Table(f"{self.parameter} by {self.input}", [self.input, self.parameter, ""], rows)

    def to_json(self) -> dict[str, Any]:
        """Arrays; no error where the runs never were."""
        return json_of(self._asdict() | {"error": np.where(self.visited, self.error, np.nan)})


def _units(physics: Physics, m: int) -> list[str]:
    return [TIME if time else GAIN if gain else PURE for time, gain in physics.units(m)]


def _quoted(model: Any, of: tuple[Any, float]) -> jax.Array:
    """Constant parameters, with the ratios, gains or lags that they stand for; offset; delay, s."""
    seen, delay = of
    p = curves(model, (seen, seen.u[:1]))[0]
    parts = [p]
    if seen.physics is FIRST_ORDER:
        parts.append(p[1:] / p[0])
    if seen.physics is ARX:  # settled, y = K u
        m = seen.u.shape[1]
        parts.append((p[2 : 2 + m] + p[2 + m :]) / (1.0 + p[0] + p[1]))
    if seen.physics is SECOND_ORDER:  # both lags of eq 8 where there are two
        root = jnp.sqrt(jnp.maximum(p[1] ** 2 - 1.0, 1e-12))
        parts.append(p[0] * (p[1] + jnp.stack([root, -root])))
    late = (delay + model["late"]) * mean_step(seen.dt)
    return jnp.concatenate([*parts, jnp.stack([jnp.asarray(model["offset"]), late])])


def quantities_of(
    begun: Begun,
    others: Alternatives | None,
    late: float,
    lags: LagPosterior,
    digits: np.ndarray,
    unsure: Sequence[float],
) -> dict[str, Quantity]:
    """Constant parameters with errors, and the offset and the delay if they are free.

    Of a first order the lag, gains and offset have the errors of `lags` where all readings count
    in them. `late` is the standard deviation of the delay by others, s, `digits` the covariance of
    the numbers by the digits of the output, `unsure` has the share by which each input's own errors
    make its gain unsure.
    """
    seen, physics, m = begun.seen, begun.seen.runs[0].physics, len(begun.seen.inputs)
    found = derived(begun.settled.fit, begun.settled.errors, _quoted, (seen.runs[0], seen.delay))
    gains = FIRST_ORDER.parameters(seen.inputs)[1:]
    units = dict(zip(physics.parameters(seen.inputs), _units(physics, m), strict=True))
    units |= {
        FIRST_ORDER: {f"{name}/tau": f"{GAIN}/s" for name in gains},
        SECOND_ORDER: {"tau1": TIME, "tau2": TIME},
        ARX: dict.fromkeys(gains, GAIN),
    }[physics] | {"offset": "output", "delay": TIME}
    whole = max(map(len, seen.measured)) <= LONGEST
    drawn = lags.drawn(gains) if physics is FIRST_ORDER and whole else {}
    values, error = dict(zip(units, found.value, strict=True)), found.error
    drawn = {name: quantity_of_draws(draws, "", values[name]) for name, draws in drawn.items()}
    alone = np.array(
        [drawn[n].error if n in drawn else e for n, e in zip(units, error, strict=True)]
    )
    error = np.where(np.isfinite(error), alone, np.nan)
    if others is not None:
        error = np.append(others.error(found.slope[:-1], error[:-1]), late)
    shares = np.zeros(len(units))
    of_inputs = np.flatnonzero([GAIN in unit for unit in units.values()])  # of all in turn
    shares[of_inputs] = np.resize(unsure, len(of_inputs))
    found = widened(found._replace(error=error), digits, shares)
    said = {name: quantity(found, i, unit) for i, (name, unit) in enumerate(units.items())}
    said |= {name: replace(said[name], interval_95=_wider(q, said[name]))
             for name, q in drawn.items() if q.error and said[name].determined}  # fmt: skip
    free = {v.name for v in begun.settled.fit.variables}
    left = {name for name, leaf in (("offset", "offset"), ("delay", "late")) if leaf not in free}
    left |= {"tau1", "tau2"} if values.get("zeta", 2.0) <= 1.0 else set()  # not two real lags
    return {name: q for name, q in said.items() if name not in left}


def _wider(drawn: Quantity, found: Quantity) -> tuple[float, float]:
    """The interval of a quantity as much wider as its error is, of a lag in its logarithm."""
    more, ends, value = found.error / drawn.error, np.array(drawn.interval_95), drawn.value
    ends = value * (ends / value) ** more if found.unit == TIME else value + more * (ends - value)
    return float(ends[0]), float(ends[1])


def derived(fit: Fit, errors: Memory | None, function: Callable, data: Any) -> Derived:
    """Numbers of a fit, with errors averaged over what is open of the noise."""
    found = fit.derive(function, data)
    if errors is None:
        return found
    slopes = found.slope.reshape(-1, found.slope.shape[-1])
    averaged = errors.moments(slopes).error.reshape(found.value.shape)
    return found._replace(error=np.where(np.isfinite(found.error), averaged, np.nan))


def widened(found: Derived, digits: np.ndarray, unsure: Any = 0.0) -> Derived:
    """Numbers whose errors contain the digits of outputs and the errors of inputs.

    `digits` is the covariance of the free numbers by digits, `unsure` the share of each number by
    which its input's own errors make it unsure.
    """
    more = np.einsum("...p,pr,...r->...", found.slope, digits, found.slope)
    return found._replace(error=np.sqrt(found.error**2 + more + (unsure * found.value) ** 2))


def quantity(found: Derived, i: Any, unit: str) -> Quantity:
    """A quantity; it has no error where the data do not determine it."""
    error, raw = (float(e[i]) for e in (found.error, found.error_raw))
    known = np.isfinite(error)
    return Quantity(float(found.value[i]), error if known else None, unit, raw if known else None)


def told(
    quantities: Mapping[str, Quantity],
    curves: Sequence[Curve],
    seen: PreparedOutput,
    checks: Checks,
    limits: tuple[float, float] = (np.nan, np.nan),
) -> tuple[dict[str, Quantity], tuple[Curve, ...]]:
    """Quantities and curves with errors only where the runs determine them.

    No errors: of anything where the inputs explain no more than chance, of the gains of inputs that
    move together, of lags that runs do not tell from 0 or infinity, and of what grows with them.
    `limits` are those of the longest lag by a one-sided 95 %, 0 or infinity where it is possible.
    """
    nothing = checks.nothing_probability >= POOR_FIT
    physics, inputs = seen.runs[0].physics, seen.inputs
    powers = zip(physics.parameters(inputs), physics.units(len(inputs)), strict=True)
    gains = [name for name, (_, gain) in powers if gain]
    joint = {n for k, n in enumerate(gains) if inputs[k % len(inputs)] in checks.together}
    zero, endless = limits[0] == 0.0, np.isinf(limits[1])

    def is_open(name: str, q: Quantity) -> bool:
        # The gain that goes with an infinite lag is infinite.
        grows = name.startswith(("tau", "T", "zeta", "K", "offset")) and not name.endswith("/tau")
        none = zero and name.startswith(("tau", "T", "zeta"))
        none |= name != "delay" and q.unit == TIME and q.determined and q.interval_95[0] <= 0.0
        # A higher order that is a first one determines only its gains and its longer lag.
        more = checks.first_order and not name.startswith(("K", "offset", "tau1", "delay"))
        # A number that ran to the end of its range has no slope there.
        ended = name != "delay" and q.error == 0
        return nothing or (endless and grows) or none or more or ended or name in joint

    known = {n: q.open() if is_open(n, q) else q for n, q in quantities.items()
             if endless or not n.endswith("/tau")}  # fmt: skip
    known |= {n: replace(known[n], interval_95=limits) for n in ("tau", "tau1")
              if n in known and zero != endless and not nothing}  # fmt: skip
    blank = (nothing or c.parameter in joint for c in curves)
    return known, tuple(c.open() if b else c for c, b in zip(curves, blank, strict=True))


# A model that the runs do not follow, or that was not found: no error contains what is wrong.
WRONG = (Status.poor_fit, Status.not_converged, Status.not_finite)


def quoted(
    status: Status, quantities: Mapping[str, Quantity], curves: Sequence[Curve] = ()
) -> tuple[dict[str, Quantity], tuple[Curve, ...]]:
    """Quantities and curves as they are quoted: without errors where the verdict is `WRONG`."""
    if status not in WRONG:
        return dict(quantities), tuple(curves)
    return {name: q.open() for name, q in quantities.items()}, tuple(c.open() for c in curves)


LATEST = "The delay is the longest that was tried: say a longer one by --delay."


def remarked(message: str, longest: bool, left_out: Sequence[BadReadings]) -> str:
    """A message that tells if the delay is the longest one, and the readings that are left out."""
    left = (f"Left out: {each}." for each in left_out)
    return " ".join([message, *([LATEST] if longest else []), *left])


def limit_words(q: Quantity) -> str:
    """The limit of a quantity without an error; nothing if it has none."""
    if q.error is not None or q.interval_95 is None:
        return ""
    low, high = q.interval_95
    return f"above {low:.3g} {q.unit}" if np.isinf(high) else f"below {high:.3g} {q.unit}"


def curves_of(fit: Fit, errors: Memory | None, seen: PreparedOutput) -> tuple[Curve, ...]:
    """Every parameter against every input."""
    physics, m = seen.runs[0].physics, len(seen.inputs)
    points, made = seen.points, []
    for j, name in enumerate(seen.inputs):
        low, high = points[:, j].min(), points[:, j].max()
        grid = np.tile(seen.mean_u, (POINTS, 1))
        grid[:, j] = at = np.linspace(low, high, POINTS)
        apart = np.abs(points[:, j][None, :] - at[:, None])
        visited = np.sum(apart <= NEAR * (high - low), axis=1) >= VISITS
        found = derived(fit, errors, curves, (seen.runs[0], jnp.asarray(grid)))
        names = physics.parameters(seen.inputs)
        made += [
            Curve(names[i], name, unit, at, found.value[:, i], found.error[:, i], visited)
            for i, unit in enumerate(_units(physics, m))
        ]
    return tuple(made)


# Share of a visited curve that must have an error for it to be determined.
HALF = 0.5
# Largest residual of a held-out run, in units of the fit's, at which it counts as predicted.
WORSE = 2.0


class ResponseEvidence(NamedTuple):
    """Input of the rules; `early` is by how many samples the output moves before its inputs, if
    that was found and not given.
    """

    fit: Fit
    rests: bool
    checks: Checks
    quantities: Mapping[str, Quantity]
    curves: tuple[Curve, ...]
    held: tuple[HeldOutRun, ...]
    map: str
    rms: float
    early: float = 0.0


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


def search_failed(e: Any) -> Finding | None:
    """Find that the search of some evidence did not end."""
    if e.rests and e.fit.groups:
        return None
    lost = e.fit.status is Status.not_finite
    return Finding(Status.not_finite if lost else Status.not_converged, e.fit.message)


WANDERS = "The noise wanders about as slowly as the output responds."
REPEAT = "Repeat the steps, up and down, so that a drift does not look like a response."


def _nothing(e: ResponseEvidence) -> Finding | None:
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
        gains = [q for name, q in e.quantities.items() if name.startswith("K")]
        gain = "; K is." if all(q.determined for q in gains) else "."
        cause += f"a pole and a zero cancel, so that a1, a2, b1 and b2 are not determined{gain}"
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


def _ahead(e: ResponseEvidence) -> Finding | None:
    if not e.early:
        return None
    cause = (
        f"The output moves {e.early:.3g} samples before its inputs: their clocks differ by so "
        "much, or the inputs were set from the output (feedback)."
    )
    remedy = f"If it is the clock, say so (--delay {-e.early:.3g}): the answer then stands."
    return Finding(Status.poor_fit, cause, remedy)


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


def _lawful(e: ResponseEvidence) -> Finding | None:
    c = e.checks
    if c.law is None or 1.0 - c.law_probability >= POOR_FIT:
        return None
    follows = "has" if c.law_kind in (FURTHER, GROWTH) else "follows"
    cause = f"The output {follows} {c.law} (p = {max(1.0 - c.law_probability, 0.0):.1g} without)"
    if c.law_kind == GROWTH:
        remedy = "Cut the record into shorter ones, or give what it changes with as an input."
        cause += " along the record."
    elif c.law_kind == FURTHER:
        cause += ": the model lacks a part of the response."
        remedy = f"Try {_more(e)}."
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


def _refuted(e: ResponseEvidence) -> Finding | None:
    c = e.checks
    if c.input_probability >= POOR_FIT:
        return None
    cause = (
        f"Past inputs, or parameters that change with them, explain {100 * c.input_share:.0f} % of "
        f"the residuals (p = {c.input_probability:.1g}): the model lacks a part of the response. "
        f"The free run explains {c.free_run_percent:.1f} % of the output."
    )
    return Finding(Status.poor_fit, cause, f"Try {_more(e)}.")


def _more(e: ResponseEvidence) -> str:
    """A fuller model."""
    more = "parameters that change with the operating point (--map network), or "
    return f"{'' if e.map == 'network' else more}a higher order"


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


def _beside(c: Checks) -> str:
    """Sentences on what stands beside the response and what its errors contain."""
    smooth, ramping, standing = map(", ".join, c.way)
    law = c.law[:1].upper() + c.law[1:] if c.law is not None else ""
    said = {
        "The noise has a memory, which the errors contain.": c.white_probability < POOR_FIT,
        f"Without high frequencies, {smooth} is taken to move between samples.": smooth,
        f"Between samples {ramping} is taken to move in straight lines.": ramping,
        f"Readings of {standing} scatter about levels; the output follows the levels.": standing,
        f"Times of readings are uncertain by {c.jitter:.2g} s: errors contain it.": c.jitter,
        f"The output drifts as well (degree {c.drift} in time): errors contain it.": c.drift,
        f"{law} is likelier than none (P = {c.law_probability:.2f}): errors contain it.": law,
    }
    return "".join(f" {sentence}" for sentence, holds in said.items() if holds)


def _good(e: ResponseEvidence) -> Finding:
    cause = f"The free run explains {e.checks.free_run_percent:.2f} % of the output."
    cause += _beside(e.checks)
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
    _nothing,
    _joint,
    _ahead,
    _lawful,
    _fed_back,
    _lower,
    _refuted,
    _open,
    _worse,
    _good,
)
