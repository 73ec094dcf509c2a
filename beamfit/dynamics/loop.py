"""A loop of a controller and a simulated process, and what is to be said of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.signal import lfilter

from beamfit.answer import answer
from beamfit.dynamics.control import Controller, advance, moved, settled, start
from beamfit.dynamics.fit import ResponseFit
from beamfit.errors import InputError, nearest
from beamfit.status import Status
from beamfit.table import Table, json_of
from beamfit.verdict import Finding, judge

# Band of a settled step, as a share of it (or the noise if larger); last share of the steps whose
# mean is the remaining offset.
SETTLED, LAST = 0.02, 0.2
# Horizons simulated after the last change; distance, in units of the input, that touches a limit.
HORIZONS, TOUCHED = 4, 1e-6
# Excess, as a share of the output's scatter, from which a plan uses the safety margin.
SOFT = 1e-4


class Trace(NamedTuple):
    """A loop step by step.

    Attributes
    ----------
    outputs, readings : array, shape (steps, outputs)
        As they are, and as they are read.
    inputs : array, shape (steps, m)
        Given out at each step.
    beyond : array, shape (steps, outputs)
        By how much each plan passes a limit less its margin.
    """

    outputs: Any
    readings: Any
    inputs: Any
    beyond: Any


def closed_loop(
    control: Controller, inputs: Any, targets: Any, noise: Any, load: Any, factors: Any = None
) -> Trace:
    """Run a controller on its own model, perturbed; a pure function that can be mapped.

    Parameters
    ----------
    control : Controller
        What controls.
    inputs : array, shape (m,)
        Where the process rests at first.
    targets, noise, load : array, shape (steps, outputs)
        What is wanted, errors of the readings, disturbances of the outputs.
    factors : sequence of array, optional
        By what the process's parameters differ from the model's, one array an output.

    Returns
    -------
    Trace
    """
    responses, step = control.responses, control.step
    factors = factors or [1.0] * len(responses)
    inputs = jnp.asarray(inputs, float)
    x = tuple(settled(r, inputs, step, f) for r, f in zip(responses, factors, strict=True))

    def read(x, shift):
        return jnp.stack([r.offset + s[0] for r, s in zip(responses, x, strict=True)]) + shift

    def on(carry, now):
        x, state = carry
        target, error, shift = now
        past, y = state.past, read(x, shift)
        state, u, said = advance(control, state, y + error, target)
        x = tuple(moved(r, s, past, u, step, f)
                  for r, s, f in zip(responses, x, factors, strict=True))  # fmt: skip
        return (x, state), Trace(y, y + error, u, said.beyond)

    state = start(control, inputs, read(x, load[0]) + noise[0])
    series = tuple(jnp.asarray(v) for v in (targets, noise, load))
    return jax.lax.scan(on, (x, state), series)[1]


class StepResponse(NamedTuple):
    """A step of a target or of a disturbance, and how the loop takes it.

    `disturbed` is by how much, or 0; `settling` None where it does not settle before the next
    one; `overshoot` a share of the target's step; `left` the mean error at the end.
    """

    output: str
    time: float
    before: float
    after: float
    disturbed: float
    settling: float | None
    overshoot: float | None
    left: float

    def row(self) -> list[str]:
        """Cells of a table."""
        took = "not settled" if self.settling is None else f"{self.settling:.4g} s"
        how = f"{self.before:.4g} to {self.after:.4g}"
        how = f"disturbed by {self.disturbed:.4g}" if self.disturbed else how
        over = "" if self.overshoot is None else f"{100 * self.overshoot:.1f} %"
        return [self.output, f"{self.time:.4g} s", how, took, over]


@answer
@dataclass(frozen=True, eq=False)
class Loop:
    """A simulated loop.

    Attributes
    ----------
    status : Status
        How it went; ``message`` says why and what to do.
    control : Controller
        What controlled.
    fits : tuple of ResponseFit
        Of the process.
    time : array, shape (steps,)
        From the start, s.
    targets : array, shape (steps, outputs)
        What was wanted.
    trace : Trace
        What came of it.
    changes : tuple of StepResponse
        The steps of targets and disturbances.
    """

    status: Status
    message: str
    control: Controller
    fits: tuple[ResponseFit, ...]
    time: np.ndarray
    targets: np.ndarray
    trace: Trace
    changes: tuple[StepResponse, ...]

    @property
    def headline(self) -> str:
        """Outputs, inputs and status in a line."""
        outputs = ", ".join(r.name for r in self.control.responses)
        return f"{outputs} by {', '.join(self.control.inputs)}: {self.status}"

    def tables(self) -> tuple[Table, ...]:
        """All numbers, to be shown."""
        head = ["output", "at", "change", "settles in", "overshoot"]
        rows = [change.row() for change in self.changes]
        return Table("Changes", head, rows), Table("Limits", *self._limits())

    def _limits(self) -> tuple[list[str], list[list[str]]]:
        c, rows = self.control, []
        for i, name in enumerate(c.inputs):
            ends = touched(self)[:, i]
            said = _range(c.limits.low[i], c.limits.high[i])
            seen = np.concatenate([run.inputs[name] for run in self.fits[0].runs])
            if c.limits.low[i] < seen.min() or c.limits.high[i] > seen.max():
                said += f" (the runs: {_range(seen.min(), seen.max())})"
            rows.append([name, said, f"at it in {ends.sum()} of {len(ends)} steps"])
            if np.isfinite(c.limits.rate[i]):
                rate, moves = c.limits.rate[i], np.abs(np.diff(self.trace.inputs[:, i]))
                fast = int((moves > rate - TOUCHED * c.sizes[i]).sum())
                said = f"{rate / c.step:.4g} a second"
                rows.append([name, said, f"at it in {fast} of {len(ends)} steps"])
        for i, r in enumerate(c.responses):
            low, high = c.limits.below[i], c.limits.above[i]
            if np.isfinite([low, high]).any():
                soft = int((self.trace.beyond[:, i] > SOFT * r.size).sum())
                said = f"{_range(low, high)}, held off by {r.margin:.2g}"
                rows.append([r.name, said, f"soft in {soft} of {len(self.time)} steps"])
        return ["", "limit", "used"], rows

    def to_json(self) -> dict[str, Any]:
        """Give one entry of ``results`` in the JSON contract."""
        c = self.control
        return json_of(
            {"status": self.status, "message": self.message, "inputs": c.inputs}
            | {"outputs": [r.name for r in c.responses], "step_s": c.step, "horizon": c.horizon}
            | {"smooth": c.smooth, "limits": c.limits, "margins": [r.margin for r in c.responses]}
            | {"changes": self.changes, "time_s": self.time, "targets": self.targets}
            | {"loop": self.trace, "models": [fit.headline for fit in self.fits]}
        )


def _range(low: float, high: float) -> str:
    if np.isfinite([low, high]).all():
        return f"{low:.4g} to {high:.4g}"
    return f"at most {high:.4g}" if np.isfinite(high) else f"at least {low:.4g}"


def touched(loop: Loop) -> np.ndarray:
    """True for each input at one of its limits, shape (steps, m)."""
    c, u = loop.control, loop.trace.inputs
    near = TOUCHED * c.sizes
    return (u <= c.limits.low + near) | (u >= c.limits.high - near)


def simulate_loop(
    fits: ResponseFit | Sequence[ResponseFit],
    control: Controller,
    targets: Sequence[tuple[str, float, float]],
    *,
    disturbances: Sequence[tuple[str, float, float]] = (),
    duration: float | None = None,
    seed: int = 1,
) -> Loop:
    """Simulate a loop on the fitted process, with the noise that its residuals have.

    Parameters
    ----------
    fits : ResponseFit or sequence of ResponseFit
        What the controller was made of; the process begins at rest under the mean inputs of the
        runs, brought within their limits.
    control : Controller
        Of `controller`.
    targets, disturbances : sequence of (str, float, float)
        Output, value and time, s: what is wanted from then on, and what is added from then on.
    duration : float, optional
        Time simulated, s; four horizons after the last change if None.
    seed : int
        Of the noise.

    Returns
    -------
    Loop

    Raises
    ------
    InputError
        If an output is unknown, a target lies outside its limits, or a time outside the loop.
    """
    fits = (fits,) if isinstance(fits, ResponseFit) else tuple(fits)
    last = max([at for _, _, at in (*targets, *disturbances)], default=0.0)
    usual = last + HORIZONS * control.horizon * control.step
    long = usual if duration is None else duration
    if not control.step < long < np.inf:
        raise InputError(f"a loop of {long:g} s", f"more than a step, {control.step:g} s")
    time = control.step * np.arange(int(np.ceil(long / control.step)))
    begin = np.clip(fits[0].seen.mean_u, control.limits.low, control.limits.high)
    rest = [r.offset + float(settled(r, jnp.asarray(begin), control.step)[0])
            for r in control.responses]  # fmt: skip
    wanted = _series(control, time, targets, np.array(rest), add=False)
    load = _series(control, time, disturbances, np.zeros(len(rest)), add=True)
    noise = np.stack([_noise(fit, time, seed + i) for i, fit in enumerate(fits)], axis=1)
    run = jax.jit(partial(closed_loop, control))
    trace = Trace(*map(np.asarray, run(begin, wanted, noise, load)))
    loop = Loop(Status.converged, "", control, fits, time, wanted, trace, ())
    loop = replace(loop, changes=tuple(_changes(loop, load)))
    found = judge(loop, RULES)
    return replace(loop, status=found.status, message=found.message)


def _series(
    control: Controller,
    time: np.ndarray,
    steps: Sequence[tuple[str, float, float]],
    at_first: np.ndarray,
    add: bool,
) -> np.ndarray:
    """Values that step, shape (steps, outputs)."""
    names = [r.name for r in control.responses]
    found = np.tile(at_first, (len(time), 1))
    for name, value, at in sorted(steps, key=lambda each: each[2]):
        if name not in names:
            raise InputError(f"no output '{name}'", nearest(name, names))
        if not 0 <= at < time[-1]:
            raise InputError(f"{name} at {at:g} s", f"a time within the loop, 0 to {time[-1]:g} s")
        i = names.index(name)
        if not np.isfinite(value):
            raise InputError(f"{value:g} for {name}", "a finite number")
        low, high = control.limits.below[i], control.limits.above[i]
        if not add and not low <= value <= high:
            raise InputError(f"{name} wanted at {value:g}", f"{_range(low, high)}, its limits")
        after = time >= at - 1e-9
        found[after, i] = found[after, i] * add + value
    return found


def _noise(fit: ResponseFit, time: np.ndarray, seed: int) -> np.ndarray:
    """Errors as the residuals have them, with their correlation time."""
    size = float(np.sqrt(np.mean(np.square(fit.noise))))
    new = np.random.default_rng(seed).normal(size=len(time))
    if fit.memory is None:
        return size * new
    # From 0 on: a part that wanders far in long times has not yet done so.
    kept = float(np.exp(-(time[1] - time[0]) / fit.memory.time))
    wander = lfilter([np.sqrt(1.0 - kept**2)], [1.0, -kept], new)
    white = np.random.default_rng([seed, 1]).normal(size=len(time))
    return size * (np.sqrt(1.0 - fit.memory.white) * wander + np.sqrt(fit.memory.white) * white)


def _changes(loop: Loop, load: np.ndarray) -> list[StepResponse]:
    """Response of the loop to each step of a target or disturbance, until the next one."""
    time, wanted, trace = loop.time, loop.targets, loop.trace
    # A change of one output is felt by the others: all are followed until the next one of any.
    steps = np.diff(np.hstack([wanted, load]), axis=0, prepend=np.nan)
    every = np.flatnonzero((steps != 0).any(axis=1))
    found = []
    for i, fit in enumerate(loop.fits):
        aim = np.diff(wanted[:, i], prepend=trace.outputs[0, i])
        push = np.diff(load[:, i], prepend=0.0)
        begins = np.flatnonzero((aim != 0) | (push != 0))
        for k in begins:
            end = min(every[every > k], default=len(time))
            error = trace.outputs[k:end, i] - wanted[k, i]
            step = float(aim[k])
            near = max(SETTLED * abs(step or push[k]), float(np.mean(fit.noise)))
            off = np.flatnonzero(np.abs(error) > near)
            after = int(off[-1]) + 1 if off.size else 0
            settling = None if after >= len(error) else after * loop.control.step
            over = max(0.0, float((error * np.sign(step)).max()) / abs(step)) if step else None
            left = float(error[-max(1, int(LAST * len(error))) :].mean())
            end_at, load_step = float(wanted[k, i]), float(push[k])
            found.append(StepResponse(fit.output, float(time[k]), end_at - step, end_at, load_step,
                                      settling, over, left))  # fmt: skip
    return [c for c in found if c.disturbed or abs(c.after - c.before) > 1e-9 * abs(c.after)]


# ---- the verdict


def _unknown(loop: Loop) -> Finding | None:
    bad = [fit for fit in loop.fits if fit.status not in (Status.converged, Status.poor_fit)]
    if not bad:
        return None
    return Finding(bad[0].status, f"The model of {bad[0].output} is no base: {bad[0].message}")


def _passed(loop: Loop) -> Finding | None:
    for i, r in enumerate(loop.control.responses):
        low, high = loop.control.limits.below[i], loop.control.limits.above[i]
        y = loop.trace.outputs[:, i]
        over = np.maximum(y - high, low - y)
        if over.max() <= SOFT * r.size:
            continue
        cause = f"{r.name} passes its limit by up to {over.max():.3g}"
        cause += f" in {int((over > 0).sum())} of {len(y)} steps."
        return Finding(
            Status.infeasible, cause, "Keep the target further off it, or let inputs move faster."
        )
    return None


def _short(loop: Loop) -> Finding | None:
    for change in loop.changes:
        if change.settling is not None:
            continue
        i = [r.name for r in loop.control.responses].index(change.output)
        low, high = (ends[i] for ends in loop.control.held)
        off = f"{change.output} stays {abs(change.left):.3g} off {change.after:.4g}"
        if not low <= change.after <= high:
            margin = loop.control.responses[i].margin
            cause = f"{off}: its limit has a safety margin of {margin:.3g} for noise and model."
            return Finding(Status.at_limit, cause, "Wish for less, or identify with less noise.")
        ends = touched(loop)[-max(1, int(LAST * len(loop.time))) :].mean(axis=0) > 0.5
        if ends.any():
            names = [n for n, end in zip(loop.control.inputs, ends, strict=True) if end]
            cause = f"{off}: {', '.join(names)} at its limit."
            return Finding(Status.at_limit, cause, "Wish for less, or widen the limit.")
        cause = f"{change.output} has not settled at {change.after:.4g}."
        return Finding(Status.not_converged, cause, "Give it longer, or a longer horizon.")
    return None


def _kept(loop: Loop) -> Finding | None:
    poor = [fit.output for fit in loop.fits if fit.status is Status.poor_fit]
    soft = [r.name for i, r in enumerate(loop.control.responses)
            if (loop.trace.beyond[:, i] > SOFT * r.size).any()]  # fmt: skip
    words = "The loop settles and keeps all limits."
    if soft:
        words += f" {', '.join(soft)} came within the safety margin of a limit."
    if not poor:
        return Finding(Status.converged, words)
    words += f" But the model of {', '.join(poor)} does not explain its runs."
    return Finding(Status.poor_fit, words, "See beamfit identify; a network, say.")


RULES = (_unknown, _passed, _short, _kept)
