"""Where the search for a response begins: the best of many time constants, the rest linear.

For given time constants the output is linear in gains, offset and first states. A grid of time
constants with linear least squares finds the basin also where noise ruins equation errors.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

from beamfit.dynamics.model import Driven, PreparedOutput, driven
from beamfit.dynamics.record import Run
from beamfit.dynamics.response import ARX, FIRST_ORDER, SECOND_ORDER, Physics, simulate

# Longest delay that is tried, in samples, and as a share of the run.
LATEST, SHARE = 24, 0.1
# Gain in log likelihood that a longer delay needs over a shorter one; fractions of a sample
# that are tried besides.
BETTER, PARTS = 5.0, (-0.75, -0.5, -0.25, 0.25, 0.5, 0.75)
# Time constants of the grid, and dampings of a second order.
TIMES, DAMPINGS = 16, (0.2, 0.6, 1.0, 2.0)
# Share of a second lag's transient after one sample below which the lag is ignored.
FORGOTTEN = 1e-4


class Start(NamedTuple):
    """Raw numbers, first states (runs, free states), offset, and the sum of squares."""

    raw: np.ndarray
    first: np.ndarray
    offset: float
    squares: float

    @property
    def model(self) -> dict[str, Any]:
        """The model that a search begins with."""
        raw = jnp.asarray(self.raw)
        return {"map": raw, "start": self.first, "offset": self.offset, "late": 0.0}


def best_start(seen: PreparedOutput, offset: bool) -> Start:
    """The best of the grid."""
    physics = seen.runs[0].physics
    if physics is ARX:
        return _as_difference(
            seen, best_start(seen._replace(runs=driven_by(seen, SECOND_ORDER)), offset)
        )
    apart = min(float(np.median(np.diff(t))) for t in seen.time)
    span = max(float(t[-1] - t[0]) for t in seen.time)
    times = np.geomspace(0.3 * apart, span, TIMES)
    shapes = np.array([[t] for t in times] if physics is FIRST_ORDER
                      else [[t, z] for t in times for z in DAMPINGS])  # fmt: skip
    columns = [np.asarray(unit_outputs(run, shapes)) for run in seen.runs]
    found = [_fitted(seen, s, [c[i] for c in columns], offset) for i, s in enumerate(shapes)]
    best = min(range(len(shapes)), key=lambda i: found[i].squares)

    def at(logarithms: np.ndarray) -> Start:
        shape = np.exp(np.clip(logarithms, *np.log([1e-3 * apart, 1e3 * span])))
        there = [np.asarray(unit_outputs(run, shape[None]))[0] for run in seen.runs]
        return _fitted(seen, shape, there, offset)

    # To a hundredth of a time constant: delays are compared by what remains.
    begin = np.log(shapes[best])
    simplex = begin + 0.3 * np.vstack([np.zeros(len(begin)), np.eye(len(begin))])
    options = {"initial_simplex": simplex, "xatol": 0.01, "fatol": 0.0, "maxiter": 40}
    end = minimize(lambda x: at(x).squares, begin, method="Nelder-Mead", options=options)
    return min(at(end.x), found[best], key=lambda each: each.squares)


@jax.jit
def unit_outputs(run: Driven, shapes: jax.Array) -> jax.Array:
    """Outputs for unit gains and unit first states, shape (shapes, columns, readings)."""
    m, k = run.u.shape[1], run.physics.free_states

    def one(shape, gains, first):
        p = jnp.broadcast_to(jnp.concatenate([shape, gains]), (len(run.u), len(shape) + m))
        return simulate(run.physics, p, run.u, run.dt, first)[run.index]

    gains = jnp.concatenate([jnp.eye(m), jnp.zeros((k, m))])
    firsts = jnp.concatenate([jnp.zeros((m, k)), jnp.eye(k)])
    each = jax.vmap(one, in_axes=(None, 0, 0))
    return jax.vmap(each, in_axes=(0, None, None))(shapes, gains, firsts)


def _fitted(
    seen: PreparedOutput, shape: np.ndarray, columns: list[np.ndarray], offset: bool
) -> Start:
    m, k, runs = len(seen.inputs), seen.runs[0].physics.free_states, len(columns)
    parts = []
    for i, column in enumerate(columns):
        first = np.zeros((column.shape[1], runs * k))
        first[:, i * k : (i + 1) * k] = column[m:].T
        parts.append(np.hstack([column[:m].T, first, np.ones((len(first), 1))]))
    design, y = np.vstack(parts), np.concatenate(seen.measured)
    if not offset:
        design = design[:, :-1]
    size = np.linalg.norm(design, axis=0)
    size = np.where(size > 0, size, 1.0)
    found = np.linalg.lstsq(design / size, y, rcond=1e-10)[0] / size
    rest = float(np.sum((design @ found - y) ** 2))
    raw = np.concatenate([np.log(shape), found[:m]])
    first = found[m : m + runs * k].reshape(runs, k)
    return Start(raw, first, float(found[-1]) if offset else 0.0, rest)


def driven_by(seen: PreparedOutput, physics: Physics) -> tuple[Driven, ...]:
    """The runs with another physics."""
    return tuple(replace(run, physics=physics) for run in seen.runs)


def _as_difference(seen: PreparedOutput, found: Start) -> Start:
    """The difference equation whose samples are those of a second order (eqs 13-16)."""
    m = len(seen.inputs)
    dt = float(np.median(np.asarray(seen.runs[0].dt)[: len(seen.time[0]) - 1]))
    p = np.asarray(SECOND_ORDER.physical(jnp.asarray(found.raw), m))
    advance = partial(SECOND_ORDER.advance, jnp.asarray(p), dt=dt)
    rest = np.column_stack([advance(jnp.asarray(e), jnp.zeros(m)) for e in np.eye(2)])
    a1, a2 = -np.trace(rest), np.linalg.det(rest)
    once = np.stack([np.asarray(advance(jnp.zeros(2), jnp.asarray(e))) for e in np.eye(m)])
    twice = np.stack([np.asarray(advance(jnp.asarray(s), jnp.asarray(e)))
                      for s, e in zip(once, np.eye(m), strict=True)])  # fmt: skip
    b1 = once[:, 0]
    b2 = twice[:, 0] + a1 * b1 - b1
    raw = ARX.raw(jnp.asarray(np.concatenate([[a1, a2], b1, b2])), m)
    # The sample before the first, by running the state backwards; a lag far below a sample has
    # forgotten it.
    back = np.linalg.inv(rest) if a2 > FORGOTTEN else np.eye(2)
    states = np.stack([
        [s[0], (back @ (s - np.stack(once, axis=1) @ np.asarray(r.u[0])))[0]]
        for s, r in zip(found.first, seen.runs, strict=True)
    ])  # fmt: skip
    return Start(np.asarray(raw), states, found.offset, found.squares)


def seen_of(runs: tuple[Run, ...], output: str, physics: Physics, delay: float) -> PreparedOutput:
    """The runs as the model sees them."""
    drives = tuple(driven(run, i, output, physics, delay) for i, run in enumerate(runs))
    read = [np.isfinite(run.outputs[output]) for run in runs]
    measured = tuple(run.outputs[output][k] for run, k in zip(runs, read, strict=True))
    time = tuple(run.time[k] for run, k in zip(runs, read, strict=True))
    u = np.concatenate([np.stack(list(run.inputs.values()), axis=1) for run in runs])
    spread = float(np.concatenate(measured).std()) or 1.0
    return PreparedOutput(
        tuple(runs[0].inputs), output, drives, measured, time, u.mean(0), u.std(0), spread
    )


def start_of(
    runs: tuple[Run, ...], output: str, physics: Physics, delay: float | None, offset: bool
) -> tuple[Start, PreparedOutput, float]:
    """The best start, and the delay: the shortest of those that fit about as well as any.

    A part of a sample must do as much better: only an input that moves within a sample tells it.
    """

    def at(late: float) -> tuple[Start, PreparedOutput, float]:
        seen = seen_of(runs, output, physics, late)
        return best_start(seen, offset), seen, late

    if delay is not None:
        return at(delay)
    found = [at(late) for late in range(latest(runs) + 1)]
    count = sum(map(len, found[0][1].measured))
    worth = np.exp(2.0 * BETTER / count)
    near = worth * min(start.squares for start, _, _ in found)
    whole = next(each for each in found if each[0].squares <= near)
    if physics.even:
        return whole
    parts = [whole[2] + part for part in PARTS if 0 < whole[2] + part < max(latest(runs), 1)]
    best = min((at(part) for part in parts), key=lambda each: each[0].squares)
    return best if worth * best[0].squares < whole[0].squares else whole


def latest(runs: tuple[Run, ...]) -> int:
    """The longest delay that is tried."""
    return min(LATEST, int(SHARE * min(map(len, runs))))
