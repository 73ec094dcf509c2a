"""Receding-horizon control with identified responses, and a simulated loop of it.

At every step the readings correct the state, the inputs of a horizon are planned within limits, and
the first of them is applied. The whole step is one compiled function. `controller` builds it from
fits, with its horizon, margins of limits and observer; `simulate_loop` judges it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.signal import lfilter

from beamfit.answer import Table, answer, json_of
from beamfit.dynamics.control_checks import (
    check_limits,
    check_rates,
    check_steps,
    check_targets,
    range_text,
)
from beamfit.dynamics.fit import ResponseFit
from beamfit.dynamics.model import parameters_at, predicted
from beamfit.dynamics.response import ARX, PHYSICS, Physics, run_from
from beamfit.errors import Finding, InputError, Status, judge, nearest
from beamfit.greybox.programs import Quadratic, minimum

# Penalty on an output beyond its limit, in units of its scatter: larger than any multiplier of a
# limit that can be kept, so that such a limit is kept exactly.
LIMIT_PENALTY = 1e4
# Linearisations of a response with varying parameters at each step, and step lengths that are
# tried. Chosen.
LINEARISATIONS = 3
STEP_SHARES = (1.0, 0.5, 0.25, 0.0)


class Response(NamedTuple):
    """An output as the controller knows it.

    `map` is its parameter map or raw numbers, `delay` is in steps, whole or not, `size` its
    scatter, `correction` the share of a prediction error that is added to the disturbance, `margin`
    the distance kept from its limits.
    """

    name: str
    physics: Physics
    map: Any
    offset: float
    delay: float
    size: float
    correction: float
    margin: float


class ControlLimits(NamedTuple):
    """Limits of inputs (lowest, highest, change per step) and of outputs; infinite for none."""

    low: np.ndarray
    high: np.ndarray
    rate: np.ndarray
    below: np.ndarray
    above: np.ndarray


class ControllerState(NamedTuple):
    """State of a controller between two steps.

    Attributes
    ----------
    x : tuple of array
        State of each response at the next reading.
    past : array, shape (longest delay or 1, m)
        Applied inputs, the most recent last.
    level : array, shape (outputs,)
        Estimated disturbance of each output.
    plan : array, shape (horizon, m)
        Inputs of the last plan from the next step on.
    """

    x: tuple[jax.Array, ...]
    past: jax.Array
    level: jax.Array
    plan: jax.Array


class ControlPlan(NamedTuple):
    """The plan behind an input.

    Attributes
    ----------
    inputs, outputs : array
        Planned inputs and predicted outputs, shapes (horizon, m), (horizon, outputs).
    beyond : array, shape (outputs,)
        Excess of the plan over a limit less its margin: 0 unless the limit cannot be kept.
    """

    inputs: jax.Array
    outputs: jax.Array
    beyond: jax.Array


@dataclass(frozen=True, eq=False)
class Controller:
    """A pure function from state, reading and target to the next input.

    Attributes
    ----------
    inputs : tuple of str
        Names of the inputs.
    responses : tuple of Response
        One response for each output.
    step : float
        Time from one input to the next, s.
    sizes : array, shape (m,)
        Scatter of the inputs.
    limits : ControlLimits
        Limits of inputs and of their changes are always kept. Those of outputs are broken where
        they cannot be kept, as `ControlPlan.beyond` shows.
    horizon : int
        Steps of a plan.
    smooth : float
        Weight of squared input changes, in units of the inputs' scatter, against squared errors in
        units of the outputs' scatter.
    """

    inputs: tuple[str, ...]
    responses: tuple[Response, ...]
    step: float
    sizes: np.ndarray
    limits: ControlLimits
    horizon: int
    smooth: float = 0.1

    def begin(self, inputs: Any) -> ControllerState:
        """Give the state of a process at rest.

        Parameters
        ----------
        inputs : array, shape (m,)
            Inputs held so far.

        Raises
        ------
        InputError
            If an input lies outside its limits: the next one could not keep limits and rate.
        """
        u = np.asarray(inputs, float)
        for i, name in enumerate(self.inputs):
            if not self.limits.low[i] <= u[i] <= self.limits.high[i]:
                expected = f"{self.limits.low[i]:g} to {self.limits.high[i]:g}, its limits"
                raise InputError(f"{name} at {u[i]:g} to begin with", expected)
        return start(self, jnp.asarray(u))

    def __call__(
        self, state: ControllerState, reading: Any, target: Any
    ) -> tuple[ControllerState, jax.Array, ControlPlan]:
        """Take a reading and give the next input.

        Parameters
        ----------
        state : ControllerState
            State from `begin` or the previous step.
        reading, target : array, shape (outputs,)
            Present readings, NaN where there is none, and wanted values from now on.

        Returns
        -------
        (ControllerState, array of shape (m,), ControlPlan)
            State for the next step, the input to hold until then, and the plan behind it.
        """
        return self._compiled(state, jnp.asarray(reading, float), jnp.asarray(target, float))

    @cached_property
    def _compiled(self) -> Any:
        return jax.jit(partial(advance, self))

    @property
    def linear(self) -> bool:
        """True if no parameter varies: one quadratic program then gives the best plan."""
        return not any(callable(r.map) for r in self.responses)

    @property
    def output_limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Limits of the outputs less their margins."""
        margin = np.array([r.margin for r in self.responses])
        return self.limits.below + margin, self.limits.above - margin

    def output(self, name: str) -> int:
        """Index of an output; unknown names are refused."""
        return _index([r.name for r in self.responses], name, "no output")


# ---- the process


def state_at_rest(response: Response, u: jax.Array, step: float, factor: Any = 1.0) -> jax.Array:
    """Solve for the state at rest under an input, x = A x + b for one step."""
    p = parameters_at(response.physics, response.map, u[None])[0] * factor
    template = response.physics.begin(jnp.zeros(response.physics.free_states), u)

    def after(x):
        return response.physics.advance(p, x, u, step)

    zero = jnp.zeros_like(template)
    return jnp.linalg.solve(jnp.eye(len(template)) - jax.jacfwd(after)(zero), after(zero))


def start(control: Controller, u: jax.Array, reading: Any = None) -> ControllerState:
    """State at rest under u, with the disturbance that a reading shows."""
    memory = max(1, *(math.ceil(r.delay) for r in control.responses))
    x = tuple(state_at_rest(r, u, control.step) for r in control.responses)
    level = jnp.zeros(len(x))
    if reading is not None:
        level = jnp.asarray(reading, float) - _present_outputs(control, x)
    m = len(control.inputs)
    past, plan = jnp.broadcast_to(u, (memory, m)), jnp.broadcast_to(u, (control.horizon, m))
    return ControllerState(x, past, level, plan)


def delayed_inputs(response: Response, past: jax.Array, plan: jax.Array) -> jax.Array:
    """Inputs as they reach the response, shape (plan, m).

    A step in which the input changes has the mean input.
    """
    steps = math.ceil(response.delay)
    fraction, first = steps - response.delay, len(past) - steps
    inputs = jnp.concatenate([past, plan])
    delayed = inputs[first : first + len(plan)]
    if not fraction:
        return delayed
    return delayed + fraction * jnp.diff(inputs, axis=0)[first : first + len(plan)]


def advance_state(
    response: Response, x: jax.Array, past: jax.Array, u: jax.Array, step: float, factor: Any = 1.0
) -> jax.Array:
    """Give the state one step later, with the input u applied now."""
    delayed = delayed_inputs(response, past, u[None])
    p = parameters_at(response.physics, response.map, delayed)[0] * factor
    return response.physics.advance(p, x, delayed[0], step)


def _present_outputs(control: Controller, x: Sequence[jax.Array]) -> jax.Array:
    pairs = zip(control.responses, x, strict=True)
    return jnp.stack([r.offset + state[0] for r, state in pairs])


def outputs(control: Controller, state: ControllerState, plan: jax.Array) -> jax.Array:
    """Predict the outputs of a plan, shape (horizon, outputs), the first one step from now."""
    found = []
    for i, (r, x) in enumerate(zip(control.responses, state.x, strict=True)):
        delayed = delayed_inputs(r, state.past, plan)
        delayed = jnp.concatenate([delayed, delayed[-1:]])  # the last sample only gives an output
        p = parameters_at(r.physics, r.map, delayed)
        dt = jnp.full(len(delayed), control.step)
        found.append(r.offset + state.level[i] + run_from(r.physics, p, delayed, dt, x)[1:])
    return jnp.stack(found, axis=1)


# ---- the plan


def advance(
    control: Controller, state: ControllerState, reading: jax.Array, target: jax.Array
) -> tuple[ControllerState, jax.Array, ControlPlan]:
    """Correct the disturbances by the reading, plan, and advance by one step."""
    innovation = reading - _present_outputs(control, state.x) - state.level
    share = jnp.array([r.correction for r in control.responses])
    level = state.level + jnp.where(jnp.isfinite(innovation), share * innovation, 0.0)
    state = state._replace(level=level)
    plan = state.plan
    for _ in range(1 if control.linear else LINEARISATIONS):
        plan = _improve_plan(control, state, target, plan)
    # Limits and rates hold exactly, whatever the accuracy of the plan.
    last, limits = state.past[-1], control.limits
    u = jnp.clip(jnp.clip(plan[0], last - limits.rate, last + limits.rate), limits.low, limits.high)
    plan = plan.at[0].set(u)
    predicted_outputs = outputs(control, state, plan)
    planned = ControlPlan(
        plan, predicted_outputs, jnp.max(_excess(control, predicted_outputs), axis=0)
    )
    x = tuple(advance_state(r, x, state.past, u, control.step)
              for r, x in zip(control.responses, state.x, strict=True))  # fmt: skip
    past = jnp.concatenate([state.past[1:], u[None]])
    shifted = jnp.concatenate([plan[1:], plan[-1:]])
    return ControllerState(x, past, level, shifted), u, planned


def _excess(control: Controller, predicted_outputs: jax.Array) -> jax.Array:
    """Excess of outputs over their limits less margins."""
    below, above = control.output_limits
    return jnp.maximum(jnp.maximum(below - predicted_outputs, predicted_outputs - above), 0.0)


def _improve_plan(
    control: Controller, state: ControllerState, target: jax.Array, plan: jax.Array
) -> jax.Array:
    """Improve a plan by linearising the process about it."""
    slope = jax.jacfwd(lambda each: outputs(control, state, each))(plan)
    best = _quadratic_plan(control, state, target, plan, slope)
    if control.linear:
        return best
    direction = best - plan
    # Second-order correction (J. Nocedal & S. Wright, Numerical Optimization, 2006, section 18.3):
    # without it a full step passes a limit by the square of its length, and only parts are taken.
    curvature = outputs(control, state, plan + direction) - outputs(control, state, plan)
    curvature = curvature - jnp.tensordot(slope, direction, 2)
    corrected = _quadratic_plan(control, state, target, plan, slope, curvature)
    tried = plan + jnp.array(STEP_SHARES)[:, None, None] * direction
    tried = jnp.concatenate([corrected[None], tried])
    cost = jax.vmap(lambda each: _cost(control, state, target, each))(tried)
    return tried[jnp.argmin(jnp.where(jnp.isfinite(cost), cost, jnp.inf))]


def _cost(
    control: Controller, state: ControllerState, target: jax.Array, plan: jax.Array
) -> jax.Array:
    size = np.array([r.size for r in control.responses])
    predicted_outputs = outputs(control, state, plan)
    change = jnp.diff(plan, axis=0, prepend=state.past[-1:]) / control.sizes
    penalty = LIMIT_PENALTY * jnp.sum(_excess(control, predicted_outputs) / size)
    error = (predicted_outputs - target) / size
    return jnp.sum(error**2) + control.smooth * jnp.sum(change**2) + penalty


def _quadratic_plan(
    control: Controller,
    state: ControllerState,
    target: jax.Array,
    plan: jax.Array,
    slope: jax.Array,
    curvature: Any = 0.0,
) -> jax.Array:
    """Solve for the best plan of the linearised process, inputs and outputs in units of their
    scatter.

    `curvature` is added to the outputs that the limits apply to.
    """
    size, n = np.array([r.size for r in control.responses]), plan.size
    scales = np.tile(control.sizes, control.horizon)
    matrix = (slope / size[:, None, None] * control.sizes).reshape(-1, n)
    inputs = plan.ravel() / scales
    error = ((outputs(control, state, plan) - target) / size).ravel() - matrix @ inputs
    change = np.eye(n) - np.eye(n, k=-len(control.sizes))
    last = jnp.zeros(n).at[: len(control.sizes)].set(state.past[-1] / control.sizes)
    hessian = 2.0 * (matrix.T @ matrix + control.smooth * change.T @ change)
    gradient = 2.0 * (matrix.T @ error - control.smooth * change.T @ last)
    base = error + jnp.tile(target / size, control.horizon)
    base = base + jnp.ravel((curvature + jnp.zeros((control.horizon, len(size)))) / size)
    hard, soft = _input_rows(control, change, last), _output_rows(control, matrix, base)
    rows, bounds = (jnp.concatenate(each) for each in zip(hard, soft, strict=True))
    cost = np.repeat([np.inf, LIMIT_PENALTY], [len(hard[1]), len(soft[1])])
    z, _ = minimum(Quadratic(hessian, gradient, rows, bounds, cost), inputs)
    return (z * scales).reshape(plan.shape)


def _input_rows(
    control: Controller, change: np.ndarray, last: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Rows and bounds of the finite limits of inputs and of their changes."""
    low, high, rate = (np.tile(v / control.sizes, control.horizon) for v in control.limits[:3])
    unit, none = np.eye(len(rate)), jnp.zeros(len(rate))
    parts = ((unit, high, none), (-unit, -low, none), (change, rate, last), (-change, rate, -last))
    kept = [(r[np.isfinite(b)], (b + shift)[np.isfinite(b)]) for r, b, shift in parts]
    return tuple(jnp.concatenate(each) for each in zip(*kept, strict=True))


def _output_rows(
    control: Controller, matrix: jax.Array, base: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Rows and bounds of the finite limits of outputs, less margins."""
    count, rows, bounds = len(control.responses), [matrix[:0]], [base[:0]]
    for i, (r, below, above) in enumerate(
        zip(control.responses, *control.output_limits, strict=True)
    ):
        for sign, limit in ((1.0, above), (-1.0, below)):
            if np.isfinite(limit):
                rows.append(sign * matrix[i::count])
                bounds.append(sign * (limit / r.size - base[i::count]))
    return jnp.concatenate(rows), jnp.concatenate(bounds)


# Safety margin of an output's limit, in standard deviations of noise and model together.
MARGIN = 2.0
# Shortest and longest default horizon, in steps; share of a transient that is left at its end.
# Chosen.
MIN_HORIZON = 8
MAX_DEFAULT_HORIZON = 40
TRANSIENT_LEFT = 0.05
# Largest number of steps of a plan, whose matrix then has 8 MB, and of a loop, which then takes a
# minute.
MAX_HORIZON = 1000
MAX_LOOP = 100_000
# Drift of the disturbance per step, as a share of white noise: chosen.
DISTURBANCE_DRIFT = 0.2


def controller(
    fits: ResponseFit | Sequence[ResponseFit],
    *,
    inputs: Mapping[str, tuple[float, float]] | None = None,
    rates: Mapping[str, float] | None = None,
    outputs: Mapping[str, tuple[float, float]] | None = None,
    horizon: int | None = None,
    every: int | None = None,
    smooth: float = 0.1,
) -> Controller:
    """Make a controller of identified responses.

    Parameters
    ----------
    fits : ResponseFit or sequence of ResponseFit
        One an output, of the same runs.
    inputs, outputs : mapping of str to (float, float), optional
        Limits. The default for an input is the range of the runs: outside it the model is unknown.
    rates : mapping of str to float, optional
        Largest change of an input per second.
    horizon : int, optional
        Steps of a plan; until 5 % of a transient is left, 8 to 40 plus the delay, if None.
    every : int, optional
        Samples of the runs per step; enough for the horizon to hold the transient if None.
    smooth : float
        Weight of squared input changes (in units of the inputs' scatter) against squared errors
        (in units of the outputs').

    Returns
    -------
    Controller

    Raises
    ------
    InputError
        If a limit names nothing, is no range, or a number is not positive.

    Notes
    -----
    The inputs of the horizon minimise squared errors and changes within limits (J. Maciejowski,
    Predictive Control with Constraints, 2002, chapters 2 and 3); a response whose parameters
    change is linearised along the last plan, three times a step. The state follows the inputs
    alone, and a disturbance of the output takes up the prediction errors (no steady-state offset):
    the Kalman filter of a level that wanders. Limits of outputs have a margin of two standard
    deviations of the residuals and of the fitted output together.
    """
    fits = (fits,) if isinstance(fits, ResponseFit) else tuple(fits)
    prepared, names = fits[0].seen, fits[0].seen.inputs
    steps = [_transient(fit) for fit in fits]
    arx = any(PHYSICS[fit.model] is ARX for fit in fits)
    if arx and (every or 1) > 1:
        raise InputError(f"a step of {every} samples", "1: a difference equation knows no other")
    every = every or (1 if arx else max(1, int(np.ceil(max(steps) / MAX_DEFAULT_HORIZON))))
    interval = min(float(np.median(np.diff(run.time))) for run in fits[0].runs)
    step = every * interval
    responses = tuple(_response(fit, every, step) for fit in fits)
    if horizon is None:
        horizon = int(np.clip(np.ceil(max(steps) / every), MIN_HORIZON, MAX_DEFAULT_HORIZON))
        horizon += math.ceil(max(r.delay for r in responses))
    if not (max(r.delay for r in responses) < horizon <= MAX_HORIZON and smooth > 0):
        found = f"a horizon of {horizon} steps with smooth {smooth:g}"
        expected = f"one longer than the delay, of at most {MAX_HORIZON} steps, and smooth above 0"
        raise InputError(found, expected)
    values = np.concatenate([np.stack(list(run.inputs.values()), axis=1) for run in fits[0].runs])
    low, high = _ranges(names, inputs or {}, np.stack([values.min(0), values.max(0)]))
    output_names = [fit.output for fit in fits]
    ends = _ranges(
        output_names, outputs or {}, np.outer([-np.inf, np.inf], np.ones(len(output_names)))
    )
    limits = ControlLimits(low, high, step * _rates(names, rates or {}), *ends)
    return Controller(names, responses, step, prepared.input_scale, limits, horizon, smooth)


def _transient(fit: ResponseFit) -> float:
    """Number of samples until 5 % of a transient is left, in the median over operating points."""
    run, physics = fit.seen.runs[0], PHYSICS[fit.model]
    points = run.u[:: max(1, len(run.u) // 50)]
    dt = float(np.median(np.diff(fit.runs[0].time)))
    state = physics.begin(jnp.zeros(physics.free_states), points[0])

    def step(p):
        return jax.jacfwd(lambda x: physics.advance(p, x, 0.0 * points[0], dt))(state)

    p = parameters_at(physics, fit.fit.model["map"], points)
    fall = np.median(np.abs(np.linalg.eigvals(np.asarray(jax.vmap(step)(p)))).max(axis=1))
    return float(np.log(TRANSIENT_LEFT) / np.log(np.clip(fall, 1e-3, 1.0 - 1e-6)))


def _response(fit: ResponseFit, every: int, step: float) -> Response:
    noise = float(np.sqrt(np.mean(np.square(fit.noise))))
    error = np.concatenate([fit.fit.derive(predicted, run).error for run in fit.seen.runs])
    finite = error[np.isfinite(error)]
    band = float(np.sqrt(np.mean(finite**2))) if finite.size else 0.0
    # A level that wanders by DISTURBANCE_DRIFT a step under noise of 1: the filter's gain at rest
    # (R. E. Kalman 1960; scalar Riccati equation P² = q (P + 1), gain P/(P + 1)).
    q = DISTURBANCE_DRIFT**2
    if fit.memory is not None:  # variance that the wandering part gains in a step, over white noise
        wandering = (1.0 - fit.memory.white) * -np.expm1(-2.0 * step / fit.memory.time)
        q = max(q, wandering / max(fit.memory.white, 1e-6))
    variance = 0.5 * (q + np.sqrt(q**2 + 4.0 * q))
    model, delay = fit.fit.model, max(fit.delay / every, 0.0)
    return Response(
        fit.output, PHYSICS[fit.model], model["map"], float(model["offset"]), delay,
        fit.seen.output_scale, variance / (variance + 1.0), MARGIN * float(np.hypot(noise, band)),
    )  # fmt: skip


def _index(names: Sequence[str], name: str, what: str) -> int:
    """Index of a name; unknown names are refused."""
    if name not in names:
        raise InputError(f"{what} '{name}'", nearest(name, list(names)))
    return names.index(name)


def _ranges(
    names: Sequence[str], given: Mapping[str, tuple[float, float]], limits: np.ndarray
) -> np.ndarray:
    """Lower and upper limits, shape (2, names); the defaults where none are given."""
    check_limits(given)
    for name, ends in given.items():
        limits[:, _index(names, name, "a limit of")] = ends
    return limits


def _rates(names: Sequence[str], given: Mapping[str, float]) -> np.ndarray:
    """Largest changes of inputs per second; infinite where none is given."""
    found = np.full(len(names), np.inf)
    check_rates(given)
    for name, rate in given.items():
        found[_index(names, name, "a rate of")] = rate
    return found


# ---- a loop with a simulated process

# Band within which a step counts as settled, as a share of the step (or the noise if larger); final
# share of the steps whose mean error is the remaining offset.
SETTLING_BAND = 0.02
FINAL_SHARE = 0.2
# Number of horizons simulated after the last change.
FINAL_HORIZONS = 4
# An input is at its limit, and an output keeps its own, within this share of the scatter.
LIMIT_TOLERANCE = 1e-4


class Trace(NamedTuple):
    """A loop step by step.

    Attributes
    ----------
    outputs, readings : array, shape (steps, outputs)
        True outputs, and their readings.
    inputs : array, shape (steps, m)
        Inputs applied at each step.
    beyond : array, shape (steps, outputs)
        Excess of each plan over a limit less its margin.
    """

    outputs: Any
    readings: Any
    inputs: Any
    beyond: Any


def closed_loop(
    control: Controller, inputs: Any, targets: Any, noise: Any, load: Any, factors: Any = None
) -> Trace:
    """Run a controller on its own perturbed model; a pure function that can be vectorised.

    Parameters
    ----------
    control : Controller
        The controller.
    inputs : array, shape (m,)
        Inputs under which the process rests at first.
    targets, noise, load : array, shape (steps, outputs)
        Wanted outputs, errors of the readings, disturbances of the outputs.
    factors : sequence of array, optional
        Factors of the process's parameters over the model's, one array for each output.

    Returns
    -------
    Trace
    """
    responses, step = control.responses, control.step
    factors = factors or [1.0] * len(responses)
    inputs = jnp.asarray(inputs, float)
    x = tuple(state_at_rest(r, inputs, step, f) for r, f in zip(responses, factors, strict=True))

    def on(carry, now):
        x, state = carry
        target, error, shift = now
        past, y = state.past, _present_outputs(control, x) + shift
        state, u, planned = advance(control, state, y + error, target)
        x = tuple(advance_state(r, s, past, u, step, f)
                  for r, s, f in zip(responses, x, factors, strict=True))  # fmt: skip
        return (x, state), Trace(y, y + error, u, planned.beyond)

    state = start(control, inputs, _present_outputs(control, x) + load[0] + noise[0])
    series = tuple(jnp.asarray(v) for v in (targets, noise, load))
    return jax.lax.scan(on, (x, state), series)[1]


class StepResponse(NamedTuple):
    """A step of a target or of a disturbance, and the answer of the loop.

    `disturbed` is the size of a disturbance, or 0; `settling` the settling time, None if the next
    step comes first; `overshoot` a share of the target's step, None if that is within the noise;
    `left` the mean error at the end.
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
        """Cells of a table row."""
        settling = "not settled" if self.settling is None else f"{self.settling:.4g} s"
        change = f"{self.before:.4g} to {self.after:.4g}"
        change = f"disturbed by {self.disturbed:.4g}" if self.disturbed else change
        overshoot = "" if self.overshoot is None else f"{100 * self.overshoot:.1f} %"
        return [self.output, f"{self.time:.4g} s", change, settling, overshoot]


@answer
@dataclass(frozen=True, eq=False)
class Loop:
    """A simulated loop.

    Attributes
    ----------
    status : Status
        Verdict; ``message`` says why and what to do.
    control : Controller
        The controller.
    fits : tuple of ResponseFit
        Fits of the process.
    time : array, shape (steps,)
        Time from the start, s.
    targets : array, shape (steps, outputs)
        Wanted outputs.
    trace : Trace
        Simulated steps.
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
        """Outputs, inputs and status in one line."""
        outputs = ", ".join(r.name for r in self.control.responses)
        return f"{outputs} by {', '.join(self.control.inputs)}: {self.status}"

    def tables(self) -> tuple[Table, ...]:
        """Tables of all numbers; none for a model that cannot be used."""
        if _no_model(self):
            return ()
        head = ["output", "at", "change", "settles in", "overshoot"]
        rows = [change.row() for change in self.changes]
        return Table("Changes", head, rows), Table("Limits", *self._limits())

    def _limits(self) -> tuple[list[str], list[list[str]]]:
        c, rows = self.control, []
        for i, name in enumerate(c.inputs):
            ends = at_limits(self)[:, i]
            limit = range_text(c.limits.low[i], c.limits.high[i])
            recorded = np.concatenate([run.inputs[name] for run in self.fits[0].runs])
            if c.limits.low[i] < recorded.min() or c.limits.high[i] > recorded.max():
                limit += f" (the runs: {range_text(recorded.min(), recorded.max())})"
            rows.append([name, limit, f"at it in {ends.sum()} of {len(ends)} steps"])
            if np.isfinite(c.limits.rate[i]):
                limit = f"{c.limits.rate[i] / c.step:.4g} a second"
                fast = at_max_rate(self)[:, i].sum()
                rows.append([name, limit, f"at it in {fast} of {len(ends)} steps"])
        for i, r in enumerate(c.responses):
            low, high = c.limits.below[i], c.limits.above[i]
            if np.isfinite([low, high]).any():
                soft = int((self.trace.beyond[:, i] > LIMIT_TOLERANCE * r.size).sum())
                limit = f"{range_text(low, high)}, held off by {r.margin:.2g}"
                rows.append([r.name, limit, f"soft in {soft} of {len(self.time)} steps"])
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


def at_limits(loop: Loop) -> np.ndarray:
    """True for each input at one of its limits, shape (steps, m)."""
    c, u = loop.control, loop.trace.inputs
    tolerance = LIMIT_TOLERANCE * c.sizes
    return (u <= c.limits.low + tolerance) | (u >= c.limits.high - tolerance)


def at_max_rate(loop: Loop) -> np.ndarray:
    """True for each input that moves at its largest rate, shape (steps - 1, m)."""
    c, rate = loop.control, loop.control.limits.rate
    # Half the rate at least, also for rates within the tolerance.
    fast = np.maximum(rate - LIMIT_TOLERANCE * c.sizes, rate / 2)
    return np.abs(np.diff(loop.trace.inputs, axis=0)) > fast


def simulate_loop(
    fits: ResponseFit | Sequence[ResponseFit],
    control: Controller,
    targets: Sequence[tuple[str, float, float]],
    *,
    disturbances: Sequence[tuple[str, float, float]] = (),
    duration: float | None = None,
    seed: int = 1,
) -> Loop:
    """Simulate a loop on the fitted process, with the noise of its residuals.

    Parameters
    ----------
    fits : ResponseFit or sequence of ResponseFit
        Fits that the controller was made from; the process starts at rest under the mean inputs of
        the runs, clipped to their limits.
    control : Controller
        The result of `controller`.
    targets, disturbances : sequence of (str, float, float)
        Output, value and time, s: wanted or added values from that time on.
    duration : float, optional
        Simulated time, s; until four horizons after the last change if None.
    seed : int
        Seed of the noise.

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
    long = last + FINAL_HORIZONS * control.horizon * control.step if duration is None else duration
    if not control.step < long <= MAX_LOOP * control.step:
        expected = f"more than a step, {control.step:g} s, and at most {MAX_LOOP} steps"
        raise InputError(f"a loop of {long:g} s", expected)
    time = control.step * np.arange(int(np.ceil(long / control.step)))
    begin = np.clip(fits[0].seen.mean_u, control.limits.low, control.limits.high)
    rest = np.asarray(jax.jit(lambda u: _present_outputs(control, start(control, u).x))(begin))
    wanted = _series(control, time, targets, rest, add=False)
    load = _series(control, time, disturbances, np.zeros(len(rest)), add=True)
    names, ends = [r.name for r in control.responses], np.transpose(control.limits[3:])
    check_targets(targets, dict(zip(names, ends, strict=True)))
    noise = np.stack([_noise(fit, time, seed + i) for i, fit in enumerate(fits)], axis=1)
    run = jax.jit(partial(closed_loop, control))
    trace = Trace(*map(np.asarray, run(begin, wanted, noise, load)))
    loop = Loop(Status.converged, "", control, fits, time, wanted, trace, ())
    loop = replace(loop, changes=tuple(_changes(loop, load)))
    found = judge(loop, RULES)
    return replace(loop, status=found.status, message=found.message + _poor_model_remark(loop))


def _series(
    control: Controller,
    time: np.ndarray,
    steps: Sequence[tuple[str, float, float]],
    at_first: np.ndarray,
    add: bool,
) -> np.ndarray:
    """Values that change in steps, shape (steps, outputs)."""
    found = np.tile(at_first, (len(time), 1))
    check_steps(steps, time[-1])
    for name, value, at in sorted(steps, key=lambda each: each[2]):
        i = control.output(name)
        after = time >= at - 1e-9
        found[after, i] = found[after, i] * add + value
    return found


def _noise(fit: ResponseFit, time: np.ndarray, seed: int) -> np.ndarray:
    """Draw reading errors with the correlation of the residuals."""
    size = float(np.sqrt(np.mean(np.square(fit.noise))))
    draws = np.random.default_rng(seed).normal(size=len(time))
    if fit.memory is None:
        return size * draws
    # The wandering part starts at 0.
    retained = float(np.exp(-(time[1] - time[0]) / fit.memory.time))
    wandering = lfilter([np.sqrt(1.0 - retained**2)], [1.0, -retained], draws)
    white = np.random.default_rng([seed, 1]).normal(size=len(time))
    return size * (np.sqrt(1.0 - fit.memory.white) * wandering + np.sqrt(fit.memory.white) * white)


def _changes(loop: Loop, load: np.ndarray) -> list[StepResponse]:
    """Answer of the loop to each step of a target or disturbance, until the next one."""
    time, wanted, trace = loop.time, loop.targets, loop.trace
    # A change of one output acts on the others: each is followed until the next change of any.
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
            noise = float(np.mean(fit.noise))
            band = max(SETTLING_BAND * abs(step or push[k]), noise)
            off = np.flatnonzero(np.abs(error) > band)
            after = int(off[-1]) + 1 if off.size else 0
            settling = None if after >= len(error) else after * loop.control.step
            over = None
            if abs(step) > noise:
                over = max(0.0, float((error * np.sign(step)).max()) / abs(step))
            left = float(error[-max(1, int(FINAL_SHARE * len(error))) :].mean())
            end_at, load_step = float(wanted[k, i]), float(push[k])
            found.append(StepResponse(fit.output, float(time[k]), end_at - step, end_at, load_step,
                                      settling, over, left))  # fmt: skip
    return [c for c in found if c.disturbed or abs(c.after - c.before) > 1e-9 * abs(c.after)]


# ---- the verdict


def _no_model(loop: Loop) -> Finding | None:
    bad = [fit for fit in loop.fits if fit.status not in (Status.converged, Status.poor_fit)]
    if not bad:
        return None
    return Finding(bad[0].status, f"The model of {bad[0].output} is no base: {bad[0].message}")


def _passes_limit(loop: Loop) -> Finding | None:
    for i, r in enumerate(loop.control.responses):
        low, high = loop.control.limits.below[i], loop.control.limits.above[i]
        y = loop.trace.outputs[:, i]
        over = np.maximum(y - high, low - y)
        over = over[np.argmax(over <= 0) :]  # a start outside the limits does not count
        if over.max() <= LIMIT_TOLERANCE * r.size:
            continue
        cause = f"{r.name} passes its limit by up to {over.max():.3g}"
        cause += f" in {int((over > 0).sum())} of {len(over)} steps."
        return Finding(
            Status.infeasible, cause, "Keep the target further off it, or let inputs move faster."
        )
    return None


def _unsettled(loop: Loop) -> Finding | None:
    for change in loop.changes:
        if change.settling is not None:
            continue
        i = loop.control.output(change.output)
        low, high = (ends[i] for ends in loop.control.output_limits)
        off = f"{change.output} stays {abs(change.left):.3g} off {change.after:.4g}"
        if not low <= change.after <= high:
            margin = loop.control.responses[i].margin
            cause = f"{off}: its limit has a safety margin of {margin:.3g} for noise and model."
            return Finding(Status.at_limit, cause, "Wish for less, or identify with less noise.")
        if names := _mostly_true(loop, at_limits(loop)):
            cause = f"{off}: {names} at its limit."
            return Finding(Status.at_limit, cause, "Wish for less, or widen the limit.")
        if names := _mostly_true(loop, at_max_rate(loop)):
            cause = f"{off}: {names} moves at its largest rate."
            remedy = "Give it longer, or let inputs move faster."
            return Finding(Status.not_converged, cause, remedy)
        cause = f"{change.output} has not settled at {change.after:.4g}."
        return Finding(Status.not_converged, cause, "Give it longer, or a longer horizon.")
    return None


def _mostly_true(loop: Loop, at: np.ndarray) -> str:
    """Names of inputs for which a mask is true in most of the last steps."""
    often = at[-max(1, int(FINAL_SHARE * len(at))) :].mean(axis=0) > 0.5
    return ", ".join(n for n, each in zip(loop.control.inputs, often, strict=True) if each)


def _settles(loop: Loop) -> Finding | None:
    soft = [r.name for i, r in enumerate(loop.control.responses)
            if (loop.trace.beyond[:, i] > LIMIT_TOLERANCE * r.size).any()]  # fmt: skip
    first = loop.trace.outputs[0]
    within = (first >= loop.control.limits.below) & (first <= loop.control.limits.above)
    words = "The loop settles and keeps all limits"
    words += "." if within.all() else ", once within them."
    if soft:
        words += f" {', '.join(soft)} came within the safety margin of a limit."
    return Finding(Status.poor_fit if _poor_model_remark(loop) else Status.converged, words)


def _poor_model_remark(loop: Loop) -> str:
    """Sentence on models that their runs refute, for every verdict."""
    poor = [fit.output for fit in loop.fits if fit.status is Status.poor_fit]
    sentence = (
        f" But the model of {', '.join(poor)} does not explain its runs: see beamfit identify."
    )
    return sentence if poor else ""


RULES = (_no_model, _passes_limit, _unsettled, _settles)
