"""Receding-horizon control with identified responses, and a loop of it with a simulated process.

At every step the readings correct the state, the inputs of a horizon are planned within limits,
and the first of them is given out. All of it is one function, compiled once. `controller` makes it
from fits, with its horizon, margins of limits, and observer; `simulate_loop` judges it.
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
from beamfit.dynamics.fit import ResponseFit
from beamfit.dynamics.model import parameters_at, predicted
from beamfit.dynamics.response import ARX, PHYSICS, Physics, run_from
from beamfit.errors import Finding, InputError, Status, judge, nearest
from beamfit.greybox.programs import Quadratic, minimum

# Penalty on an output beyond its limit, per unit of its scatter: larger than any multiplier of a
# limit that can be kept, so that such a limit is kept exactly.
PENALTY = 1e4
# Linearisations of a response with varying parameters, and shares of a step that are tried.
ROUNDS, SHARES = 3, (1.0, 0.5, 0.25, 0.0)


class Response(NamedTuple):
    """An output as the controller knows it.

    `of` is its map or raw numbers, `delay` in steps, whole or not, `size` its scatter,
    `correction` the share of a surprise that is taken for a disturbance, `margin` what its limits
    are held off by.
    """

    name: str
    physics: Physics
    of: Any
    offset: float
    delay: float
    size: float
    correction: float
    margin: float


class ControlLimits(NamedTuple):
    """Limits of inputs (lowest, highest, change in a step) and outputs; infinite if none."""

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
        Inputs given out, the last last.
    level : array, shape (outputs,)
        Disturbance of each output, estimated.
    plan : array, shape (horizon, m)
        Inputs of the last plan from then on.
    """

    x: tuple[jax.Array, ...]
    past: jax.Array
    level: jax.Array
    plan: jax.Array


class Said(NamedTuple):
    """The plan behind an input.

    Attributes
    ----------
    inputs, outputs : array
        Shapes (horizon, m), (horizon, outputs): what is planned, and what comes of it.
    beyond : array, shape (outputs,)
        By how much the plan passes a limit less its margin: 0 unless it cannot be kept.
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
        Their names.
    responses : tuple of Response
        One an output.
    step : float
        Time from one input to the next, s.
    sizes : array, shape (m,)
        Scatter of the inputs.
    limits : ControlLimits
        Those of inputs and of their changes are never broken. Those of outputs are, where they
        cannot be kept, and `Said.beyond` tells.
    horizon : int
        Steps of a plan.
    smooth : float
        Cost of squared input changes, in units of the inputs' scatter, against squared errors in
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
            Held so far.

        Raises
        ------
        InputError
            If an input lies outside its limits: no next one could keep them and its rate.
        """
        u = np.asarray(inputs, float)
        for i, name in enumerate(self.inputs):
            if not self.limits.low[i] <= u[i] <= self.limits.high[i]:
                expected = f"{self.limits.low[i]:g} to {self.limits.high[i]:g}, its limits"
                raise InputError(f"{name} at {u[i]:g} to begin with", expected)
        return start(self, jnp.asarray(u))

    def __call__(
        self, state: ControllerState, reading: Any, target: Any
    ) -> tuple[ControllerState, jax.Array, Said]:
        """Take a reading and give the next input.

        Parameters
        ----------
        state : ControllerState
            Of `begin`, or of the step before.
        reading, target : array, shape (outputs,)
            What is read now, NaN where nothing is, and what is wanted from now on.

        Returns
        -------
        (ControllerState, array of shape (m,), Said)
            What to hand to the next step, the input to hold until then, and the plan behind it.
        """
        return self._compiled(state, jnp.asarray(reading, float), jnp.asarray(target, float))

    @cached_property
    def _compiled(self) -> Any:
        return jax.jit(partial(advance, self))

    @property
    def linear(self) -> bool:
        """True if no parameter changes: a plan is then the best at once."""
        return not any(callable(r.of) for r in self.responses)

    @property
    def held(self) -> tuple[np.ndarray, np.ndarray]:
        """Limits of the outputs less their margins."""
        margin = np.array([r.margin for r in self.responses])
        return self.limits.below + margin, self.limits.above - margin

    def output(self, name: str) -> int:
        """The place of an output; other names are refused."""
        return _place([r.name for r in self.responses], name, "no output")


# ---- the process


def settled(response: Response, u: jax.Array, step: float, factor: Any = 1.0) -> jax.Array:
    """The state at rest under an input: x = A x + b of a step that is affine in x."""
    p = parameters_at(response.physics, response.of, u[None])[0] * factor
    like = response.physics.begin(jnp.zeros(response.physics.free_states), u)

    def after(x):
        return response.physics.advance(p, x, u, step)

    zero = jnp.zeros_like(like)
    return jnp.linalg.solve(jnp.eye(len(like)) - jax.jacfwd(after)(zero), after(zero))


def start(control: Controller, u: jax.Array, reading: Any = None) -> ControllerState:
    """The state at rest under u."""
    latest = max(1, *(math.ceil(r.delay) for r in control.responses))
    x = tuple(settled(r, u, control.step) for r in control.responses)
    level = jnp.zeros(len(x))
    if reading is not None:
        level = jnp.asarray(reading, float) - _now(control, x)
    m = len(control.inputs)
    held = jnp.broadcast_to(u, (latest, m)), jnp.broadcast_to(u, (control.horizon, m))
    return ControllerState(x, held[0], level, held[1])


def late(response: Response, past: jax.Array, plan: jax.Array) -> jax.Array:
    """The inputs as the response feels them, shape (plan, m).

    In a step within which the input changes, its mean.
    """
    steps = math.ceil(response.delay)
    newer, first = steps - response.delay, len(past) - steps
    given = jnp.concatenate([past, plan])
    felt = given[first : first + len(plan)]
    return felt if not newer else felt + newer * jnp.diff(given, axis=0)[first : first + len(plan)]


def moved(
    response: Response, x: jax.Array, past: jax.Array, u: jax.Array, step: float, factor: Any = 1.0
) -> jax.Array:
    """The state a step later, under the input u given out now."""
    felt = late(response, past, u[None])
    p = parameters_at(response.physics, response.of, felt)[0] * factor
    return response.physics.advance(p, x, felt[0], step)


def _now(control: Controller, x: Sequence[jax.Array]) -> jax.Array:
    pairs = zip(control.responses, x, strict=True)
    return jnp.stack([r.offset + state[0] for r, state in pairs])


def outputs(control: Controller, state: ControllerState, plan: jax.Array) -> jax.Array:
    """Predicted outputs of a plan, shape (horizon, outputs), the first a step from now."""
    found = []
    for i, (r, x) in enumerate(zip(control.responses, state.x, strict=True)):
        felt = late(r, state.past, plan)
        felt = jnp.concatenate([felt, felt[-1:]])  # of the last sample only the output counts
        p = parameters_at(r.physics, r.of, felt)
        dt = jnp.full(len(felt), control.step)
        found.append(r.offset + state.level[i] + run_from(r.physics, p, felt, dt, x)[1:])
    return jnp.stack(found, axis=1)


# ---- the plan


def advance(
    control: Controller, state: ControllerState, reading: jax.Array, target: jax.Array
) -> tuple[ControllerState, jax.Array, Said]:
    """Correct the disturbances by the reading, plan, and go on by a step."""
    surprise = reading - _now(control, state.x) - state.level
    share = jnp.array([r.correction for r in control.responses])
    level = state.level + jnp.where(jnp.isfinite(surprise), share * surprise, 0.0)
    state = state._replace(level=level)
    plan = state.plan
    for _ in range(1 if control.linear else ROUNDS):
        plan = _better(control, state, target, plan)
    # By construction, whatever the plan is worth: within the rate of the last input, within limits.
    last, limits = state.past[-1], control.limits
    u = jnp.clip(jnp.clip(plan[0], last - limits.rate, last + limits.rate), limits.low, limits.high)
    plan = plan.at[0].set(u)
    ahead = outputs(control, state, plan)
    said = Said(plan, ahead, jnp.max(_excess(control, ahead), axis=0))
    x = tuple(moved(r, x, state.past, u, control.step)
              for r, x in zip(control.responses, state.x, strict=True))  # fmt: skip
    past = jnp.concatenate([state.past[1:], u[None]])
    shifted = jnp.concatenate([plan[1:], plan[-1:]])
    return ControllerState(x, past, level, shifted), u, said


def _excess(control: Controller, ahead: jax.Array) -> jax.Array:
    """Excess of outputs over their limits less the margins."""
    below, above = control.held
    return jnp.maximum(jnp.maximum(below - ahead, ahead - above), 0.0)


def _better(
    control: Controller, state: ControllerState, target: jax.Array, plan: jax.Array
) -> jax.Array:
    """The best plan of the process as it is around a plan."""
    slope = jax.jacfwd(lambda each: outputs(control, state, each))(plan)
    best = _planned(control, state, target, plan, slope)
    if control.linear:
        return best
    way = best - plan
    # Second-order correction (J. Nocedal & S. Wright, Numerical Optimization, 2006, section 18.3):
    # else a full step passes a limit by the square of its length, and only shares of it are taken.
    bent = outputs(control, state, plan + way) - outputs(control, state, plan)
    bent = bent - jnp.tensordot(slope, way, 2)
    corrected = _planned(control, state, target, plan, slope, bent)
    tried = plan + jnp.array(SHARES)[:, None, None] * way
    tried = jnp.concatenate([corrected[None], tried])
    cost = jax.vmap(lambda each: _cost(control, state, target, each))(tried)
    return tried[jnp.argmin(jnp.where(jnp.isfinite(cost), cost, jnp.inf))]


def _cost(
    control: Controller, state: ControllerState, target: jax.Array, plan: jax.Array
) -> jax.Array:
    size = np.array([r.size for r in control.responses])
    ahead = outputs(control, state, plan)
    change = jnp.diff(plan, axis=0, prepend=state.past[-1:]) / control.sizes
    passed = PENALTY * jnp.sum(_excess(control, ahead) / size)
    return jnp.sum(((ahead - target) / size) ** 2) + control.smooth * jnp.sum(change**2) + passed


def _planned(
    control: Controller,
    state: ControllerState,
    target: jax.Array,
    plan: jax.Array,
    slope: jax.Array,
    bent: Any = 0.0,
) -> jax.Array:
    """The best plan of a process that is linear; inputs and outputs in units of their scatter.

    `bent` is added to the outputs that limits are held against.
    """
    size, n = np.array([r.size for r in control.responses]), plan.size
    wide = np.tile(control.sizes, control.horizon)
    matrix = (slope / size[:, None, None] * control.sizes).reshape(-1, n)
    inputs = plan.ravel() / wide
    error = ((outputs(control, state, plan) - target) / size).ravel() - matrix @ inputs
    change = np.eye(n) - np.eye(n, k=-len(control.sizes))
    last = jnp.zeros(n).at[: len(control.sizes)].set(state.past[-1] / control.sizes)
    hessian = 2.0 * (matrix.T @ matrix + control.smooth * change.T @ change)
    gradient = 2.0 * (matrix.T @ error - control.smooth * change.T @ last)
    base = error + jnp.tile(target / size, control.horizon)
    base = base + jnp.ravel((bent + jnp.zeros((control.horizon, len(size)))) / size)
    hard, soft = _input_rows(control, change, last), _output_rows(control, matrix, base)
    rows, room = (jnp.concatenate(each) for each in zip(hard, soft, strict=True))
    cost = np.repeat([np.inf, PENALTY], [len(hard[1]), len(soft[1])])
    z, _ = minimum(Quadratic(hessian, gradient, rows, room, cost), inputs)
    return (z * wide).reshape(plan.shape)


def _input_rows(
    control: Controller, change: np.ndarray, last: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Limits of inputs and of their changes, those that there are."""
    low, high, rate = (np.tile(v / control.sizes, control.horizon) for v in control.limits[:3])
    unit, none = np.eye(len(rate)), jnp.zeros(len(rate))
    parts = ((unit, high, none), (-unit, -low, none), (change, rate, last), (-change, rate, -last))
    kept = [(r[np.isfinite(b)], (b + shift)[np.isfinite(b)]) for r, b, shift in parts]
    return tuple(jnp.concatenate(each) for each in zip(*kept, strict=True))


def _output_rows(
    control: Controller, matrix: jax.Array, base: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Limits of outputs, less margins, those that there are."""
    many, rows, room = len(control.responses), [matrix[:0]], [base[:0]]
    for i, (r, below, above) in enumerate(zip(control.responses, *control.held, strict=True)):
        for sign, limit in ((1.0, above), (-1.0, below)):
            if np.isfinite(limit):
                rows.append(sign * matrix[i::many])
                room.append(sign * (limit / r.size - base[i::many]))
    return jnp.concatenate(rows), jnp.concatenate(room)


# Safety margin of an output's limit, in standard deviations of noise and model together.
MARGIN = 2.0
# Fewest and most steps of a horizon; share of a transient that is left at its end.
FEWEST, MOST, LEFT = 8, 40, 0.05
# Steps of a plan at most, whose matrix has 8 MB then, and of a loop, which takes a minute.
LONGEST, LOOP = 1000, 100_000
# Drift of the disturbance in a step, as a share of white noise.
DRIFT = 0.2


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
        Limits. An input keeps to the range of the runs unless told: beyond it nothing is known.
    rates : mapping of str to float, optional
        Largest change of an input in a second.
    horizon : int, optional
        Steps of a plan; to where 5 % of a transient is left, 8 to 40 and the delay, if None.
    every : int, optional
        Samples of the runs to a step; so many that the horizon holds the transient if None.
    smooth : float
        Cost of squared input changes (in units of the inputs' scatter) against squared errors
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
    change is linearised along the last plan, three times a step. The state runs on the inputs
    alone, and a disturbance of the output takes up what readings say besides (free of offset): the
    Kalman filter of a level that wanders. Limits of outputs are held off by two standard deviations
    of the residuals and of the fitted output together.
    """
    fits = (fits,) if isinstance(fits, ResponseFit) else tuple(fits)
    seen, names = fits[0].seen, fits[0].seen.inputs
    steps = [_transient(fit) for fit in fits]
    arx = any(PHYSICS[fit.model] is ARX for fit in fits)
    if arx and (every or 1) > 1:
        raise InputError(f"a step of {every} samples", "1: a difference equation knows no other")
    every = every or (1 if arx else max(1, int(np.ceil(max(steps) / MOST))))
    apart = min(float(np.median(np.diff(run.time))) for run in fits[0].runs)
    step, responses = every * apart, tuple(_response(fit, every, every * apart) for fit in fits)
    if horizon is None:
        horizon = int(np.clip(np.ceil(max(steps) / every), FEWEST, MOST))
        horizon += math.ceil(max(r.delay for r in responses))
    if not (max(r.delay for r in responses) < horizon <= LONGEST and smooth > 0):
        said = f"a horizon of {horizon} steps with smooth {smooth:g}"
        expected = f"one longer than the delay, of at most {LONGEST} steps, and smooth above 0"
        raise InputError(said, expected)
    values = np.concatenate([np.stack(list(run.inputs.values()), axis=1) for run in fits[0].runs])
    low, high = _ranges(names, inputs or {}, np.stack([values.min(0), values.max(0)]))
    wanted = [fit.output for fit in fits]
    ends = _ranges(wanted, outputs or {}, np.outer([-np.inf, np.inf], np.ones(len(wanted))))
    limits = ControlLimits(low, high, step * _rates(names, rates or {}), *ends)
    return Controller(names, responses, step, seen.wide, limits, horizon, smooth)


def _transient(fit: ResponseFit) -> float:
    """Samples until 5 % of a transient is left, at the usual operating points."""
    run, physics = fit.seen.runs[0], PHYSICS[fit.model]
    points = run.u[:: max(1, len(run.u) // 50)]
    dt = float(np.median(np.diff(fit.runs[0].time)))
    state = physics.begin(jnp.zeros(physics.free_states), points[0])

    def step(p):
        return jax.jacfwd(lambda x: physics.advance(p, x, 0.0 * points[0], dt))(state)

    p = parameters_at(physics, fit.fit.model["map"], points)
    fall = np.median(np.abs(np.linalg.eigvals(np.asarray(jax.vmap(step)(p)))).max(axis=1))
    return float(np.log(LEFT) / np.log(np.clip(fall, 1e-3, 1.0 - 1e-6)))


def _response(fit: ResponseFit, every: int, step: float) -> Response:
    noise = float(np.sqrt(np.mean(np.square(fit.noise))))
    error = np.concatenate([fit.fit.derive(predicted, run).error for run in fit.seen.runs])
    known = error[np.isfinite(error)]
    band = float(np.sqrt(np.mean(known**2))) if known.size else 0.0
    # A level that wanders by `drift` a step under noise of 1: the filter's gain at rest
    # (R. E. Kalman 1960; scalar Riccati equation P² = q (P + 1), gain P/(P + 1)).
    q = DRIFT**2
    if fit.memory is not None:  # of white noise, what the part that wanders gets anew in a step
        wander = (1.0 - fit.memory.white) * -np.expm1(-2.0 * step / fit.memory.time)
        q = max(q, wander / max(fit.memory.white, 1e-6))
    ahead = 0.5 * (q + np.sqrt(q**2 + 4.0 * q))
    model, late = fit.fit.model, max(fit.delay / every, 0.0)
    return Response(
        fit.output, PHYSICS[fit.model], model["map"], float(model["offset"]), late, fit.seen.size_y,
        ahead / (ahead + 1.0), MARGIN * float(np.hypot(noise, band)),
    )  # fmt: skip


def _place(names: Sequence[str], name: str, what: str) -> int:
    """The place of a name; others are refused."""
    if name not in names:
        raise InputError(f"{what} '{name}'", nearest(name, list(names)))
    return names.index(name)


def _ranges(
    names: Sequence[str], said: Mapping[str, tuple[float, float]], usual: np.ndarray
) -> np.ndarray:
    """Lower and upper limits, the usual ones, shape (2, names), where none are said."""
    for name, (low, high) in said.items():
        at = _place(names, name, "a limit of")
        if not low < high:
            raise InputError(f"limits {low:g} to {high:g} of {name}", "the lower one first")
        usual[:, at] = low, high
    return usual


def _rates(names: Sequence[str], said: Mapping[str, float]) -> np.ndarray:
    """Largest changes of inputs in a second; infinite where none is said."""
    found = np.full(len(names), np.inf)
    for name, rate in said.items():
        at = _place(names, name, "a rate of")
        if not rate > 0:
            raise InputError(f"rate {rate:g} of {name}", "above 0, in units a second")
        found[at] = rate
    return found


# ---- a loop with a simulated process

# Band of a settled step, as a share of it (or the noise if larger); last share of the steps whose
# mean is the remaining offset.
SETTLED, LAST = 0.02, 0.2
# Horizons simulated after the last change.
HORIZONS = 4
# Share of the scatter within which an input is at its limit, and an output still keeps its own.
NEAR = 1e-4


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

    def on(carry, now):
        x, state = carry
        target, error, shift = now
        past, y = state.past, _now(control, x) + shift
        state, u, said = advance(control, state, y + error, target)
        x = tuple(moved(r, s, past, u, step, f)
                  for r, s, f in zip(responses, x, factors, strict=True))  # fmt: skip
        return (x, state), Trace(y, y + error, u, said.beyond)

    state = start(control, inputs, _now(control, x) + load[0] + noise[0])
    series = tuple(jnp.asarray(v) for v in (targets, noise, load))
    return jax.lax.scan(on, (x, state), series)[1]


class StepResponse(NamedTuple):
    """A step of a target or of a disturbance, and how the loop takes it.

    `disturbed` is by how much, or 0; `settling` None where it does not settle before the next
    one; `overshoot` a share of the target's step, None where that is within the noise; `left` the
    mean error at the end.
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
        """All numbers, to be shown; none of a model that is no base."""
        if _unknown(self):
            return ()
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
                said = f"{c.limits.rate[i] / c.step:.4g} a second"
                fast = fastest(self)[:, i].sum()
                rows.append([name, said, f"at it in {fast} of {len(ends)} steps"])
        for i, r in enumerate(c.responses):
            low, high = c.limits.below[i], c.limits.above[i]
            if np.isfinite([low, high]).any():
                soft = int((self.trace.beyond[:, i] > NEAR * r.size).sum())
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
    near = NEAR * c.sizes
    return (u <= c.limits.low + near) | (u >= c.limits.high - near)


def fastest(loop: Loop) -> np.ndarray:
    """True for each input that moves at its largest rate, shape (steps - 1, m)."""
    c, rate = loop.control, loop.control.limits.rate
    least = np.maximum(rate - NEAR * c.sizes, rate / 2)  # also where it hardly moves
    return np.abs(np.diff(loop.trace.inputs, axis=0)) > least


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
    long = last + HORIZONS * control.horizon * control.step if duration is None else duration
    if not control.step < long <= LOOP * control.step:
        expected = f"more than a step, {control.step:g} s, and at most {LOOP} steps"
        raise InputError(f"a loop of {long:g} s", expected)
    time = control.step * np.arange(int(np.ceil(long / control.step)))
    begin = np.clip(fits[0].seen.mean_u, control.limits.low, control.limits.high)
    rest = np.asarray(jax.jit(lambda u: _now(control, start(control, u).x))(begin))
    wanted = _series(control, time, targets, rest, add=False)
    load = _series(control, time, disturbances, np.zeros(len(rest)), add=True)
    for name, value, _ in targets:
        low, high = (ends[control.output(name)] for ends in control.limits[3:])
        if not low <= value <= high:
            raise InputError(f"{name} wanted at {value:g}", f"{_range(low, high)}, its limits")
    noise = np.stack([_noise(fit, time, seed + i) for i, fit in enumerate(fits)], axis=1)
    run = jax.jit(partial(closed_loop, control))
    trace = Trace(*map(np.asarray, run(begin, wanted, noise, load)))
    loop = Loop(Status.converged, "", control, fits, time, wanted, trace, ())
    loop = replace(loop, changes=tuple(_changes(loop, load)))
    found = judge(loop, RULES)
    return replace(loop, status=found.status, message=found.message + _poor(loop))


def _series(
    control: Controller,
    time: np.ndarray,
    steps: Sequence[tuple[str, float, float]],
    at_first: np.ndarray,
    add: bool,
) -> np.ndarray:
    """Values that step, shape (steps, outputs)."""
    found = np.tile(at_first, (len(time), 1))
    for name, value, at in sorted(steps, key=lambda each: each[2]):
        i = control.output(name)
        if not 0 <= at < time[-1]:
            raise InputError(f"{name} at {at:g} s", f"a time within the loop, 0 to {time[-1]:g} s")
        if not np.isfinite(value):
            raise InputError(f"{value:g} for {name}", "a finite number")
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
            noise = float(np.mean(fit.noise))
            near = max(SETTLED * abs(step or push[k]), noise)
            off = np.flatnonzero(np.abs(error) > near)
            after = int(off[-1]) + 1 if off.size else 0
            settling = None if after >= len(error) else after * loop.control.step
            over = None
            if abs(step) > noise:
                over = max(0.0, float((error * np.sign(step)).max()) / abs(step))
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
        over = over[np.argmax(over <= 0) :]  # where it rests at first is not the loop's
        if over.max() <= NEAR * r.size:
            continue
        cause = f"{r.name} passes its limit by up to {over.max():.3g}"
        cause += f" in {int((over > 0).sum())} of {len(over)} steps."
        return Finding(
            Status.infeasible, cause, "Keep the target further off it, or let inputs move faster."
        )
    return None


def _short(loop: Loop) -> Finding | None:
    for change in loop.changes:
        if change.settling is not None:
            continue
        i = loop.control.output(change.output)
        low, high = (ends[i] for ends in loop.control.held)
        off = f"{change.output} stays {abs(change.left):.3g} off {change.after:.4g}"
        if not low <= change.after <= high:
            margin = loop.control.responses[i].margin
            cause = f"{off}: its limit has a safety margin of {margin:.3g} for noise and model."
            return Finding(Status.at_limit, cause, "Wish for less, or identify with less noise.")
        if names := _mostly(loop, touched(loop)):
            cause = f"{off}: {names} at its limit."
            return Finding(Status.at_limit, cause, "Wish for less, or widen the limit.")
        if names := _mostly(loop, fastest(loop)):
            cause = f"{off}: {names} moves at its largest rate."
            remedy = "Give it longer, or let inputs move faster."
            return Finding(Status.not_converged, cause, remedy)
        cause = f"{change.output} has not settled at {change.after:.4g}."
        return Finding(Status.not_converged, cause, "Give it longer, or a longer horizon.")
    return None


def _mostly(loop: Loop, at: np.ndarray) -> str:
    """Inputs that are so in most of the last steps."""
    often = at[-max(1, int(LAST * len(at))) :].mean(axis=0) > 0.5
    return ", ".join(n for n, each in zip(loop.control.inputs, often, strict=True) if each)


def _kept(loop: Loop) -> Finding | None:
    soft = [r.name for i, r in enumerate(loop.control.responses)
            if (loop.trace.beyond[:, i] > NEAR * r.size).any()]  # fmt: skip
    first = loop.trace.outputs[0]
    within = (first >= loop.control.limits.below) & (first <= loop.control.limits.above)
    words = "The loop settles and keeps all limits"
    words += "." if within.all() else ", once within them."
    if soft:
        words += f" {', '.join(soft)} came within the safety margin of a limit."
    return Finding(Status.poor_fit if _poor(loop) else Status.converged, words)


def _poor(loop: Loop) -> str:
    """Sentence about models that their runs refute, for every verdict."""
    poor = [fit.output for fit in loop.fits if fit.status is Status.poor_fit]
    said = f" But the model of {', '.join(poor)} does not explain its runs: see beamfit identify."
    return said if poor else ""


RULES = (_unknown, _passed, _short, _kept)
