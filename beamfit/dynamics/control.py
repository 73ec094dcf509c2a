"""A controller of identified responses: its horizon, limits with margins, and observer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.dynamics.fit import ResponseFit
from beamfit.dynamics.model import parameters_at, predicted
from beamfit.dynamics.receding import Controller, ControlLimits, Response
from beamfit.dynamics.response import ARX, PHYSICS
from beamfit.errors import InputError, nearest

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
