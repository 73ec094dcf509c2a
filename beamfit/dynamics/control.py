"""Receding-horizon control with identified responses: state, reading, target -> next input.

At every step the readings correct the state, the inputs of a horizon are planned within limits,
and the first of them is given out. All of it is one function, compiled once. `controller` makes it
from fits, with its horizon, margins of limits, and observer.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.dynamics.fit import ResponseFit
from beamfit.dynamics.model import parameters_at, predicted
from beamfit.dynamics.response import ARX, PHYSICS, Physics, run_from
from beamfit.errors import InputError, nearest
from beamfit.greybox.quadratic import Quadratic, minimum

# Penalty on an output beyond its limit, per unit of its scatter: larger than any multiplier of a
# limit that can be kept, so that such a limit is kept exactly.
PENALTY = 1e4
# Linearisations of a response with varying parameters, and shares of a step that are tried.
ROUNDS, SHARES = 3, (1.0, 0.5, 0.25, 0.0)


class Response(NamedTuple):
    """An output as the controller knows it.

    `of` is its map or raw numbers, `delay` in steps, `size` its scatter, `correction` the share of
    a surprise that is taken for a disturbance, `margin` what its limits are held off by.
    """

    name: str
    physics: Physics
    of: Any
    offset: float
    delay: int
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

    def begin(self, inputs: Any, reading: Any = None) -> ControllerState:
        """Give the state of a process at rest.

        Parameters
        ----------
        inputs : array, shape (m,)
            Held so far.
        reading : array, shape (outputs,), optional
            What is read; what the model says if None.

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
        return start(self, jnp.asarray(u), reading)

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

    @cached_property
    def slope(self) -> np.ndarray | None:
        """Outputs by inputs of the horizon where that is a constant, else None."""
        if any(callable(r.of) for r in self.responses):
            return None
        with jax.ensure_compile_time_eval():  # also where a step is being compiled
            state = start(self, jnp.zeros(len(self.sizes)))
            return np.asarray(jax.jacfwd(lambda plan: outputs(self, state, plan))(self.rest))

    @property
    def held(self) -> tuple[np.ndarray, np.ndarray]:
        """Limits of the outputs less their margins."""
        margin = np.array([r.margin for r in self.responses])
        return self.limits.below + margin, self.limits.above - margin

    @property
    def rest(self) -> np.ndarray:
        """A plan of nothing."""
        return np.zeros((self.horizon, len(self.inputs)))


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
    latest = max(1, *(r.delay for r in control.responses))
    x = tuple(settled(r, u, control.step) for r in control.responses)
    level = jnp.zeros(len(x))
    if reading is not None:
        level = jnp.asarray(reading, float) - _now(control, x)
    m = len(control.inputs)
    held = jnp.broadcast_to(u, (latest, m)), jnp.broadcast_to(u, (control.horizon, m))
    return ControllerState(x, held[0], level, held[1])


def late(response: Response, past: jax.Array, plan: jax.Array) -> jax.Array:
    """The inputs as the response feels them, shape (plan, m)."""
    first = len(past) - response.delay
    return jnp.concatenate([past, plan])[first : first + len(plan)]


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
    for _ in range(ROUNDS if control.slope is None else 1):
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
    slope = control.slope
    if slope is not None:
        return _planned(control, state, target, plan, jnp.asarray(slope))
    slope = jax.jacfwd(lambda each: outputs(control, state, each))(plan)
    way = _planned(control, state, target, plan, slope) - plan
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
    size, n = np.array([r.size for r in control.responses]), control.rest.size
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
        horizon += max(r.delay for r in responses)
    if not (horizon > max(r.delay for r in responses) and smooth > 0):
        said = f"a horizon of {horizon} steps with smooth {smooth:g}"
        raise InputError(said, "a horizon longer than the delay, and smooth above 0")
    values = np.concatenate([np.stack(list(run.inputs.values()), axis=1) for run in fits[0].runs])
    usual = {n: (v.min(), v.max()) for n, v in zip(names, values.T, strict=True)}
    low, high = _ranges(names, inputs or {}, usual)
    below, above = _ranges([fit.output for fit in fits], outputs or {}, {})
    rate = step * np.array([_rates(names, rates or {}).get(name, np.inf) for name in names])
    limits = ControlLimits(low, high, rate, below, above)
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
    model = fit.fit.model
    return Response(
        fit.output,
        PHYSICS[fit.model],
        model["map"],
        float(model["offset"]),
        int(np.ceil(fit.delay / every)),
        fit.seen.size_y,
        ahead / (ahead + 1.0),
        MARGIN * float(np.hypot(noise, band)),
    )


def _ranges(
    names: Sequence[str],
    said: Mapping[str, tuple[float, float]],
    usual: Mapping[str, tuple[float, float]],
) -> tuple[np.ndarray, np.ndarray]:
    for name, (low, high) in said.items():
        if name not in names:
            raise InputError(f"a limit of '{name}'", nearest(name, list(names)))
        if not low < high:
            raise InputError(f"limits {low:g} to {high:g} of {name}", "the lower one first")
    every = {name: (-np.inf, np.inf) for name in names} | dict(usual) | dict(said)
    both = np.array([every[name] for name in names])
    return both[:, 0], both[:, 1]


def _rates(names: Sequence[str], said: Mapping[str, float]) -> Mapping[str, float]:
    for name, rate in said.items():
        if name not in names:
            raise InputError(f"a rate of '{name}'", nearest(name, list(names)))
        if not rate > 0:
            raise InputError(f"rate {rate:g} of {name}", "above 0, in units a second")
    return said
