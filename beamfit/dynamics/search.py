"""Search for a response: starts, the fit in rounds, and the noise of its residuals.

At given time constants the output is linear in gains, offset and first states. Linear least squares
over a grid of time constants therefore finds the right basin, also where noise ruins equation
errors. All numbers are then fitted in rounds, each with the noise that the residuals of the round
before show. The noise has a part that wanders with a correlation time and a white part; one lag
does not separate them, so both are estimated together, and errors average over what stays open.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.arrays import Array, array_module
from beamfit.dynamics.model import (
    DrivenRun,
    PreparedOutput,
    pad_readings,
    predict_readings,
    predicted,
    weight_priors,
)
from beamfit.dynamics.paths import (
    DIRECT_PATH,
    Path,
    Paths,
    inputs_by_path,
    prepare_output,
    prepare_readings,
)
from beamfit.dynamics.record import Run
from beamfit.dynamics.response import ARX, FIRST_ORDER, SECOND_ORDER, Physics
from beamfit.errors import Status
from beamfit.greybox.fit import Fit
from beamfit.greybox.problem import Free, Prior, Problem, Record
from beamfit.greybox.solve import solve
from beamfit.noise.correlated import TIMES, Memory, noises, range_of, whitened_by_each
from beamfit.noise.memory import BESIDE, CorrelatedNoise, filtered, innovations, remembers

# Grid of starts: number of time constants, as close as a damping of 0.2 resolves them, and dampings
# of a second order.
GRID_LAGS = 32
GRID_DAMPINGS = (0.2, 0.6, 1.0, 2.0)
# Gain in log likelihood that a longer delay needs over a shorter one: chosen.
MIN_DELAY_GAIN = 5.0
# Paths that are searched together: one program is compiled for all batches.
PATHS_PER_BATCH = 16
TINY = np.finfo(float).tiny
# Highest degree of the polynomial drift of an output in a run; it has one turning point less.
MAX_DRIFT_DEGREE = 8


def drift_polynomials(through: Array) -> Array:
    """Chebyshev polynomials of degree 1 to MAX_DRIFT_DEGREE, less their means over the run.

    `through` are times in lengths of the run. Shape (readings, degrees).
    """
    xp, degree = array_module(through), np.arange(1, MAX_DRIFT_DEGREE + 1)
    angle = xp.arccos(xp.clip(2.0 * through - 1.0, -1.0, 1.0))
    mean = np.where(degree % 2, 0.0, 1.0 / (1.0 - np.maximum(degree, 2) ** 2))
    return xp.cos(angle[:, None] * degree) - mean


def drift_columns(through: Array, i: int, runs: int) -> Array:
    """Drift columns of all runs at the readings of run i, zero for the other runs.

    Shape (readings, MAX_DRIFT_DEGREE, runs).
    """
    xp = array_module(through)
    return xp.pad(drift_polynomials(through)[..., None], ((0, 0), (0, 0), (i, runs - 1 - i)))


def drift_bic(triangles: np.ndarray, runs: int, count: int, floor: float = TINY) -> np.ndarray:
    """Bayesian information criterion with a drift of degree 0, 1, … in each of the runs.

    `triangles` are triangular factors of the model's own columns, drifts by degree, and the `count`
    readings. The noise level is at its best, its sum of squares at least `floor`.
    """
    own = triangles.shape[-1] - 1 - runs * MAX_DRIFT_DEGREE
    used = own + runs * np.arange(MAX_DRIFT_DEGREE + 1)
    squares = np.stack([np.sum(triangles[..., k:, -1] ** 2, axis=-1) for k in used], axis=-1)
    return count * np.log(np.maximum(squares, floor)) + np.log(count) * used


def orthonormal_basis(columns: np.ndarray, size: np.ndarray | None = None) -> np.ndarray:
    """Orthonormal basis of columns; directions below 1e-6 of the columns' sizes are dropped.

    `size` are the norms that columns are compared with; their own if None.
    """
    size = np.linalg.norm(columns, axis=0) if size is None else size
    found, values, _ = np.linalg.svd(columns / np.where(size > 0, size, 1.0), full_matrices=False)
    return found[:, values > 1e-6]


def best_drift_degree(own: np.ndarray, waves: np.ndarray, target: np.ndarray) -> int:
    """Choose the degree of drifts by the information criterion, given a model's own columns.

    `waves` are the drift columns by degree, those of all runs together, `target` the data; all are
    whitened.
    """
    columns = np.column_stack([orthonormal_basis(own), waves, target])
    missing = max(0, columns.shape[1] - len(columns))
    triangle = np.linalg.qr(np.pad(columns, ((0, missing), (0, 0))), mode="r")
    return int(drift_bic(triangle, waves.shape[1] // MAX_DRIFT_DEGREE, len(target)).argmin())


# Readings of each run and output that a start, or correlated noise, is estimated from at most.
MAX_NOISE_READINGS = 5000


def busiest_part(run: Run, output: str) -> Run:
    """Part of `MAX_NOISE_READINGS` readings of a long run in which its inputs change most."""
    read = np.flatnonzero(np.isfinite(run.outputs[output]))
    if read.size <= MAX_NOISE_READINGS:
        return run
    changes = (np.abs(np.diff(u, prepend=u[0])) / max(np.ptp(u), TINY) for u in run.inputs.values())
    moved = np.cumsum(sum(changes))[read]
    first = np.argmax(moved[MAX_NOISE_READINGS - 1 :] - moved[: 1 - MAX_NOISE_READINGS])
    rows = slice(read[first], read[first + MAX_NOISE_READINGS - 1] + 1)
    inputs = {name: u[rows] for name, u in run.inputs.items()}
    return replace(
        run, time=run.time[rows], inputs=inputs, outputs={output: run.outputs[output][rows]}
    )


class Start(NamedTuple):
    """A path, a start model, and its information criterion with the best drift."""

    path: Path
    model: dict[str, Any]
    cost: float


class ResponseSearch(NamedTuple):
    """Settings of a search: output, physics, paths, and True if the output at rest is free."""

    output: str
    physics: Physics
    paths: Paths
    offset: bool

    def starts(self, runs: tuple[Run, ...], physics: Physics, paths: Sequence[Path]) -> list[Start]:
        """Give the best start of a physics for each path, `PATHS_PER_BATCH` paths at once."""
        size, found = PATHS_PER_BATCH if len(paths) > 2 else len(paths), []
        for k in range(0, len(paths), size):
            some = [*paths[k : k + size]]
            more = some[:1] * (size - len(some))
            found += self._starts(runs, physics, [*some, *more])[: len(some)]
        return found

    def _starts(
        self, runs: tuple[Run, ...], physics: Physics, paths: Sequence[Path]
    ) -> list[Start]:
        """Search a grid of time constants and dampings, then a finer one about its best point.

        The grid reaches to the length of the longest run, whatever part of it is searched.
        """
        duration = max(float(np.ptp(run.time)) for run in runs)
        runs = tuple(busiest_part(run, self.output) for run in runs)
        prepared = prepare_output(runs, self.output, physics, paths[0])
        every = np.arange(len(paths))
        first = max(self.paths.delays[0], 0.0)
        readings = prepare_readings(runs, self.output, physics, self.paths.rows_per_sample, first)
        drives = readings.drives
        measured = tuple(map(pad_readings, drives, readings.measured))
        inputs, fraction = inputs_by_path(runs, readings, self.paths.rows_per_sample, paths)
        axes = [np.log(np.geomspace(0.1 * prepared.interval, duration, GRID_LAGS))]
        axes += [np.log(GRID_DAMPINGS)] if physics is not FIRST_ORDER else []
        spacing = np.array([axis[1] - axis[0] for axis in axes])
        count = sum(map(len, prepared.measured))
        floor = count * prepared.floor**2
        fine = np.array([*product(*(np.linspace(-1.0, 1.0, len(axis)) for axis in axes))])
        grid = np.tile([*product(*axes)], (len(paths), 1, 1))

        def factorise(logarithms):
            shapes = np.exp(logarithms)
            if physics is ARX:
                shapes = difference_coefficients(shapes, prepared.interval)
            delayed = [u[..., 0] for u in inputs], fraction
            factors = _triangular_factors(drives, measured, delayed, shapes, self.offset)
            triangles = np.asarray(factors)
            costs = drift_bic(triangles, len(prepared.runs), count, floor)
            return costs.min(axis=2).argmin(axis=1), shapes, triangles, costs

        coarse = grid[every, factorise(grid)[0]]
        index, shapes, triangles, costs = factorise(coarse[:, None] + spacing * fine)
        best = paths, shapes[every, index], triangles[every, index], costs[every, index]
        return [
            Start(path, self._model(physics, prepared, *each, cost), float(cost.min()))
            for path, *each, cost in zip(*best, strict=True)
        ]

    def _model(
        self,
        physics: Physics,
        prepared: PreparedOutput,
        shape: np.ndarray,
        triangle: np.ndarray,
        costs: np.ndarray,
    ) -> dict[str, Any]:
        """Solve for gains, first states and offset of a shape, and build the model."""
        runs = len(prepared.runs)
        own = triangle.shape[1] - 1 - MAX_DRIFT_DEGREE * runs
        design = triangle[:, : own + runs * int(costs.argmin())]
        size = np.linalg.norm(design, axis=0)
        size = np.where(size > 0, size, 1.0)
        found = (np.linalg.lstsq(design / size, triangle[:, -1], rcond=1e-10)[0] / size)[:own]
        k = own - self.offset - runs * physics.free_states
        gains, first = np.split(found[: own - self.offset], [k])
        raw = physics.raw(np.append(shape, gains))
        level = float(found[-1]) if self.offset else 0.0
        return {"map": raw, "start": first.reshape(runs, -1), "offset": level, "late": 0.0}

    def start(self, runs: tuple[Run, ...]) -> Start:
        """Give the best start, under white noise: the shortest whole delay, unless a longer one is
        better by `MIN_DELAY_GAIN`, or a fraction of a sample about it if that is more probable.

        The delay of a difference equation is that of a second order: its own gains of two samples
        would let a shorter delay pass.
        """
        physics = SECOND_ORDER if self.physics is ARX and not self.paths.given else self.physics

        def cost(start: Start) -> float:
            return start.cost - 2.0 * self.paths.log_prior(start.path)

        tried = self.starts(runs, physics, self.paths.whole_delays())
        limit = min(map(cost, tried)) + 2.0 * MIN_DELAY_GAIN
        shortest = min(abs(each.path.delay) for each in tried if cost(each) <= limit)
        found = min((each for each in tried if abs(each.path.delay) == shortest), key=cost)
        if fractions := self.paths.fractional_delays(found.path.delay):
            found = min([found, *self.starts(runs, physics, fractions)], key=cost)
        if physics is self.physics:
            return found
        return self.starts(runs, self.physics, [found.path])[0]

    def identify(self, runs: tuple[Run, ...]) -> RunsFit:
        """Identify the response with constant parameters."""
        start = self.start(runs)
        return self.identify_path(runs, start.path, start.model)

    def identify_path(self, runs: tuple[Run, ...], path: Path, model: dict[str, Any]) -> RunsFit:
        """Identify the response with constant parameters for one path, starting from a model."""
        prepared = prepare_output(runs, self.output, self.physics, path)
        case = response_case(prepared, path, self.offset)
        return fit_case(case, [model | {"late": 0.0}])

    def is_first_order(self, runs: tuple[Run, ...], found: RunsFit) -> bool:
        """True if a first order is no worse than a higher one by the information criterion."""
        if self.physics is FIRST_ORDER:
            return False
        lower = found.prepared._replace(runs=with_physics(found.prepared, FIRST_ORDER))
        (start,) = self.starts(runs, FIRST_ORDER, [found.path])
        fit = fit_case(response_case(lower, found.path, self.offset), [start.model])
        return fit.cost <= found.cost


def difference_coefficients(shapes: np.ndarray, interval: float) -> np.ndarray:
    """Give a1 and a2 of the difference equation of a sampled second order, from (T, zeta)."""
    time, zeta = np.moveaxis(shapes, -1, 0).astype(complex)
    root = np.sqrt(zeta**2 - 1.0)
    one, other = (np.exp(-interval / time * (zeta + sign * root)) for sign in (1, -1))
    return np.stack([-(one + other), one * other], axis=-1).real


def shape_parameters(prepared: PreparedOutput, model: Any) -> np.ndarray:
    """Time constants, damping or a1 and a2 of a model with constant parameters, gains left out."""
    physics, m = prepared.runs[0].physics, len(prepared.inputs)
    count = len(physics.units(m)) - m * (2 if physics is ARX else 1)
    return np.asarray(physics.physical(model["map"]))[:count]


@jax.jit
def unit_outputs(run: DrivenRun, shapes: jax.Array) -> jax.Array:
    """Outputs for unit gains and unit first states, shape (shapes, columns, readings).

    `shapes` are rows of `shape_parameters`.
    """
    m, k = len(run.physics.units(run.u.shape[1])) - shapes.shape[1], run.physics.free_states

    def one(shape, gains, first):
        return run.constant_response(jnp.concatenate([shape, gains]), first, run.delay_fraction)

    gains = jnp.concatenate([jnp.eye(m), jnp.zeros((k, m))])
    firsts = jnp.concatenate([jnp.zeros((m, k)), jnp.eye(k)])
    each = jax.vmap(one, in_axes=(None, 0, 0))
    return jax.vmap(each, in_axes=(0, None, None))(shapes, gains, firsts)


@partial(jax.jit, static_argnums=(1, 3))
def linear_columns(runs: Sequence[DrivenRun], i: int, shapes: jax.Array, offset: bool) -> jax.Array:
    """Outputs of run i by shape for unit gains, first states of each run, and offset."""
    columns = jnp.swapaxes(unit_outputs(runs[i], shapes), 1, 2)
    k = runs[i].physics.free_states
    others = (0, 0), (0, 0), (i * k, (len(runs) - 1 - i) * k)
    level = jnp.ones((*columns.shape[:2], int(offset)))
    return jnp.concatenate([columns[..., :-k], jnp.pad(columns[..., -k:], others), level], axis=2)


@partial(jax.jit, static_argnums=4)
def _triangular_factors(
    runs: tuple[DrivenRun, ...], measured: Any, inputs: Any, shapes: Any, offset: bool
):
    """Triangular factors of unit outputs, drifts and readings, for each path and each of its
    shapes.

    Columns are those of `linear_columns`, drifts of each run by degree, and the readings.
    """
    shared = []
    for i, (run, y) in enumerate(zip(runs, measured, strict=True)):
        waves = drift_columns(run.time / run.time[run.count - 1], i, len(runs))
        shared.append(jnp.concatenate([waves.reshape(len(y), -1), y[:, None]], axis=1))
    read = jnp.concatenate([jnp.arange(len(run.index)) < run.count for run in runs])[:, None]
    basis, corner = jnp.linalg.qr(jnp.where(read, jnp.concatenate(shared), 0.0))

    def one(path):
        (inputs, fraction), shapes = path
        delayed = [
            replace(run, u=u, delay_fraction=fraction) for run, u in zip(runs, inputs, strict=True)
        ]
        parts = [linear_columns(delayed, i, shapes, offset) for i in range(len(runs))]
        own = jnp.where(read, jnp.concatenate(parts, axis=1), 0.0)
        # Only what the shared columns do not span needs a factor of all readings.
        inside = basis.T @ own
        outside = jnp.linalg.qr(own - basis @ inside, mode="r")
        rest = jnp.zeros((*outside.shape[:2], corner.shape[1]))
        repeated = jnp.broadcast_to(corner, (len(own), *corner.shape))
        top = jnp.concatenate([inside, repeated], axis=2)
        rows = jnp.concatenate([top, jnp.concatenate([outside, rest], axis=2)], axis=1)
        return jnp.linalg.qr(rows, mode="r")

    return jax.lax.map(one, (inputs, shapes))


def with_physics(prepared: PreparedOutput, physics: Physics) -> tuple[DrivenRun, ...]:
    """Replace the physics of the runs."""
    return tuple(replace(run, physics=physics) for run in prepared.runs)


def noise_grid(
    time: Sequence[np.ndarray], count: int = TIMES, ratios: Sequence[float] = BESIDE
) -> list[CorrelatedNoise]:
    """Noises of `count` correlation times between the shortest and the longest that the times
    resolve.

    Each has the `ratios` of white variance to the variance that the wandering part gains in a
    sample.
    """
    interval = min(float(np.median(np.diff(t))) for t in time)
    ends = np.array([range_of(t) for t in time])
    return noises((ends[:, 0].min(), ends[:, 1].max()), interval, count, ratios)


def noise_posterior(
    rows: Sequence[np.ndarray],
    time: Sequence[np.ndarray],
    prior_rows: np.ndarray,
    noise: CorrelatedNoise | None = None,
) -> tuple[Memory, CorrelatedNoise, float]:
    """Posterior over the noise, given residuals of all runs, its best point, and its level.

    `rows` hold the slopes and, last, the residuals of each run in units of their errors;
    `prior_rows` the same of the priors. `noise` fixes the noise up to its level, which is in units
    of the errors.
    """
    grid = noise_grid(time) if noise is None else [noise]
    memory = whitened_by_each(grid, list(zip(rows, time, strict=True)), prior_rows).memory()
    best = int(np.argmax(memory.weight))
    return memory, grid[best], float(np.sqrt(memory.squares[best] / memory.dof))


# Rms error by the clock's jitter over the error at rest. Half of the prior is on no jitter, the
# other half spread over the other ratios.
JITTER_RATIOS = np.append(0.0, np.geomspace(0.2, 50.0, 24))
# Longest jitter in samples: with more, readings would change their order.
MAX_JITTER = 0.5
# Cost in -2 ln L of each ratio above 0, by that prior.
JITTER_PENALTY = 2.0 * float(np.log(len(JITTER_RATIOS) - 1))


class ReadingErrors(NamedTuple):
    """Standard deviation of each reading of an output in a run, and the jitter of its clock, s.

    A reading taken at an uncertain time is off by the slope of the output times the jitter: the
    error is sqrt(at_rest² + (jitter slope)²).
    """

    each: np.ndarray
    jitter: float = 0.0


def jitter_scales(fitted: np.ndarray, time: np.ndarray) -> tuple[np.ndarray, float]:
    """Errors of readings over those at rest, one row for each of `JITTER_RATIOS`, and the rms
    slope.

    A single row of ones if the model does not move.
    """
    slope = np.diff(fitted) / np.diff(time)
    moves = np.sqrt(0.5 * (np.append(slope, 0.0) ** 2 + np.append(0.0, slope) ** 2))
    rms_slope = float(np.sqrt(np.mean(moves**2)))
    if not (np.isfinite(rms_slope) and rms_slope > 0):
        return np.ones((1, len(time))), 0.0
    return np.hypot(1.0, np.outer(JITTER_RATIOS, moves / rms_slope)), rms_slope


def reading_errors(
    residuals: np.ndarray,
    fitted: np.ndarray,
    time: np.ndarray,
    floor: float,
    memory: CorrelatedNoise | None,
) -> ReadingErrors:
    """Estimate the errors of readings from their residuals, not below `floor`."""
    scale, rms_slope = jitter_scales(fitted, time)
    if not rms_slope:
        return ReadingErrors(np.full(len(residuals), max(float(residuals.std()), floor)))
    white = whiten((residuals / scale).T, time, memory)[0]
    size = np.maximum(np.sqrt(np.mean(white**2, axis=0)), floor)
    cost = 2.0 * (len(residuals) * np.log(size) + np.log(scale).sum(axis=1))
    cost[1:] += JITTER_PENALTY
    jitter = JITTER_RATIOS * size / rms_slope
    cost[jitter > MAX_JITTER * np.median(np.diff(time))] = np.inf
    best = int(cost.argmin())
    each = np.maximum(scale[best] * float(np.std(residuals / scale[best])), floor)
    return ReadingErrors(each, float(jitter[best]))


def whiten(
    rows: np.ndarray, time: np.ndarray, memory: CorrelatedNoise | None
) -> tuple[np.ndarray, float]:
    """Whiten rows, unless the noise has no memory; also give the sum of log errors."""
    return (rows, 0.0) if memory is None else innovations(rows, time, memory)


# Solver steps of a round, after which the noise is estimated anew.
STEPS_PER_ROUND = 25
# Largest number of rounds with white noise, and of further rounds with correlated noise.
MAX_ROUNDS = 80
MAX_CORRELATED_ROUNDS = 3
# Rounds end when -2 ln L falls by less than MIN_GAIN plus MIN_GAIN_PER_READING for each reading.
MIN_GAIN = 0.05
MIN_GAIN_PER_READING = 1e-4

# Parts of a model that each run has for itself.
RUN_PARTS = ("start", "nodes", "drift")

# Errors of the readings, by run and output.
Noises = tuple[tuple[ReadingErrors, ...], ...]


class Case(NamedTuple):
    """Inputs of a fit: prepared outputs, runs, free numbers, priors, and the path of the inputs.

    A course is a run as its model sees it: `model.DrivenRun` or `state_fit.Course`. `degree` is the
    highest free degree of drifts, in models that have them.
    """

    prepared: tuple[PreparedOutput, ...]
    courses: tuple[Any, ...]
    free: tuple[Free, ...]
    priors: tuple[Prior, ...]
    path: Path = DIRECT_PATH
    degree: int = 0

    def for_runs(self, runs: Sequence[Run]) -> Case:
        """Prepare other runs for the same model and path."""
        prepared = tuple(prepare_output(runs, s.output, s.runs[0].physics, self.path)
                         for s in self.prepared)  # fmt: skip
        courses = tuple(self.courses[0].like(prepared, i) for i in range(len(runs)))
        return self._replace(prepared=prepared, courses=courses)

    @property
    def initial_noise(self) -> Noises:
        """Errors of the readings before the first fit: a tenth of each output's scatter."""
        return tuple(tuple(ReadingErrors(np.full(len(s.measured[i]), 0.1 * s.output_scale))
                           for s in self.prepared) for i in range(len(self.courses)))  # fmt: skip

    def measured(self, i: int) -> np.ndarray:
        """Readings of a run, one output after the other."""
        return np.concatenate([s.measured[i] for s in self.prepared])

    def split(self, i: int, rows: np.ndarray) -> list[np.ndarray]:
        """Split rows of the readings of a run by output."""
        return np.split(rows, np.cumsum([len(s.measured[i]) for s in self.prepared])[:-1])

    def residuals(self, model: Any) -> tuple[tuple[np.ndarray, ...], ...]:
        """Residuals of a model, by run and output."""
        return tuple(
            tuple(self.split(i, self.measured(i) - predict_readings(model, course)))
            for i, course in enumerate(self.courses)
        )

    def errors(self, residuals: Any, memory: CorrelatedNoise | None) -> Noises:
        """Estimate the errors of the readings from residuals."""
        return tuple(
            tuple(reading_errors(r, s.measured[i] - r, s.time[i], s.floor, memory)
                  for r, s in zip(row, self.prepared, strict=True))
            for i, row in enumerate(residuals)
        )  # fmt: skip

    def residual_rows(
        self, residuals: Any, noise: Noises
    ) -> list[tuple[np.ndarray, np.ndarray, np.ndarray, float]]:
        """List residuals, errors, times and the floor of the errors, for each run and output."""
        return [
            (r, n.each, s.time[i], s.floor)
            for i, row in enumerate(residuals)
            for r, n, s in zip(row, noise[i], self.prepared, strict=True)
        ]

    def drifts(self, model: Any) -> tuple[tuple[np.ndarray, ...], ...]:
        """Drifts of a model at the readings, by run and output."""
        if "drift" not in model:
            return tuple(tuple(np.zeros(len(s.measured[i])) for s in self.prepared)
                         for i in range(len(self.courses)))  # fmt: skip
        return tuple(
            tuple(self.split(i, np.asarray(course.drift(model))[: course.count]))
            for i, course in enumerate(self.courses)
        )

    def with_best_drift(self, model: Any) -> Any:
        """Set the drifts of a model by least squares on its residuals."""
        without = model | {"drift": np.zeros_like(model["drift"])}
        for i, row in enumerate(self.residuals(without)):
            columns = self.split(i, np.asarray(self.courses[i].waves)[: self.courses[i].count])
            for k, (residuals, waves) in enumerate(zip(row, columns, strict=True)):
                level = np.column_stack([waves[:, k, : self.degree], np.ones(len(residuals))])
                without["drift"][i, k, : self.degree] = np.linalg.lstsq(level, residuals)[0][:-1]
        return without

    def normalised_squares(self, residuals: Any) -> float:
        """Sum of squared residuals, in units of each output's scatter."""
        return sum(float(np.sum((r / s.output_scale) ** 2))
                   for row in residuals
                   for r, s in zip(row, self.prepared, strict=True))  # fmt: skip

    def predict_held_out(self, found: RunsFit) -> tuple[np.ndarray, ...]:
        """Residuals of a held-out run, by output; only its start and drift are fitted."""
        sizes = np.sqrt(np.mean(found.rms**2, axis=0))
        noise = tuple(ReadingErrors(np.full(len(s.measured[0]), size))
                      for s, size in zip(self.prepared, sizes, strict=True))  # fmt: skip
        model = dict(found.fit.model)
        model |= {name: np.mean(model[name], axis=0)[None] for name in RUN_PARTS if name in model}
        case = self._replace(free=(Free("start", nuisance=True),), priors=())
        return case.residuals(solve(case.problem(model, (noise,))).model)[0]

    def problem(
        self, model: Any, noise: Noises, memory: CorrelatedNoise | None = None, gap: Any = ()
    ) -> Problem:
        """State the fit as a problem.

        `noise` is a first estimate that the residuals correct, `memory` the correlated noise if
        any, `gap` the allowed distance of segment ends, shape (states,).
        """
        records = []
        cuts = model["nodes"].shape[1] if len(gap) else 0
        for i, course in enumerate(self.courses):
            y, data, predict = self.measured(i), course, predicted
            error = np.concatenate([each.each for each in noise[i]])
            pairs = zip(noise[i], self.prepared, strict=True)
            exact = all(_is_exact(n, s.floor) for n, s in pairs)
            if memory is not None:
                y = innovations(y / error, np.asarray(course.time)[: len(y)], memory)[0]
                data = course, jnp.asarray(pad_readings(course, error, 1.0)), jnp.asarray(memory)
                error, predict = np.ones_like(y), _innovations_of
            values = (y,), (error, 1.0), (np.ones_like(y),)
            rows = [pad_readings(course, *each) for each in values]
            if cuts:
                gaps, predict = cuts * len(gap), _predict_with_gaps
                gap_rows = np.zeros(gaps), np.tile(gap, cuts), np.ones(gaps)
                rows = [np.concatenate(pair) for pair in zip(rows, gap_rows, strict=True)]
            worth = np.inf if exact else 1.0
            records.append(Record(f"run {i + 1}", predict, data, *rows, worth))
        free = [*self.free, *([Free("nodes", nuisance=True)] if cuts else [])]
        if "drift" in model:
            is_free = np.arange(MAX_DRIFT_DEGREE) < self.degree
            end = np.where(is_free, np.inf, np.zeros_like(model["drift"]))
            free.append(Free("drift", -end, end, nuisance=True))
        return Problem(model, free, records, self.priors)

    def search(
        self, model: Any, noise: Noises, memory: CorrelatedNoise | None = None, gap: Any = ()
    ) -> RunsFit:
        """Fit once and estimate the noise of the residuals.

        The fitted fraction of a sample in the delay restarts at 0.
        """
        model = model | {"late": 0.0} if "late" in model else model
        fit = solve(self.problem(model, noise, memory, gap), iterations=STEPS_PER_ROUND)
        residuals = self.residuals(fit.model)
        converged = fit.status not in (Status.not_finite, Status.not_converged)
        errors = self.errors(residuals, memory)
        found = RunsFit(self, fit, residuals, errors, memory, None, np.inf, converged)
        cost = bic_of(found, memory)
        return found._replace(cost=cost if np.isfinite(cost) else np.inf)


class RunsFit(NamedTuple):
    """A fit of runs with the noise of its own residuals.

    `residuals` and `noise` are by run and output. `memory` is the correlated noise used in the fit,
    if any; `errors` averages errors over the uncertainty of the noise. `cost` is the Bayesian
    information criterion, `converged` True if a further round gains nothing.
    """

    case: Case
    fit: Fit
    residuals: tuple[tuple[np.ndarray, ...], ...]
    noise: Noises
    memory: CorrelatedNoise | None
    errors: Memory | None
    cost: float
    converged: bool

    @property
    def path(self) -> Path:
        """Path of the inputs."""
        return self.case.path

    @property
    def prepared(self) -> PreparedOutput:
        """Prepared runs of the first output, which is the only one of a response."""
        return self.case.prepared[0]

    @property
    def delay(self) -> float:
        """Delay in samples, with the fitted fraction if there is one."""
        late = float(self.fit.model["late"]) if self.prepared.fraction_limits else 0.0
        rows = self.prepared.delay + late
        return round(rows / self.prepared.rows_per_sample, 9)  # exactly 0 at a limit of 0

    def covers(self, path: Path) -> bool:
        """True if the fit has this path, or fits a fraction of a sample that covers its delay."""
        prepared = self.prepared
        low, high = (prepared.delay + end for end in prepared.fraction_limits or (0.0, 0.0))
        inside = low <= path.delay * prepared.rows_per_sample <= high
        return path.law is None and path.way == self.path.way and inside

    def refit(self, runs: Sequence[Run]) -> RunsFit:
        """Fit the same model to other runs, for one round."""
        case = self.case.for_runs(runs)
        return case.search(self.fit.model, case.initial_noise)

    def slopes(self) -> list[np.ndarray]:
        """Derivatives of each run's outputs by the free numbers; 0 for numbers at a bound."""
        free = self.fit.problem.moving
        return [
            free * np.asarray(self.fit.derive(predicted, course).slope)[: course.count]
            for course in self.case.courses
        ]

    def linear_rows(self, max_readings: int | None = None) -> list[tuple[np.ndarray, ...]]:
        """List slopes and, last, residuals of each run and output in units of the errors, with
        times.

        At most `max_readings` readings of each count.
        """
        own = [part for i, s in enumerate(self.slopes()) for part in self.case.split(i, s)]
        rows = self.case.residual_rows(self.residuals, self.noise)
        found = []
        for slope, (residuals, error, time, _) in zip(own, rows, strict=True):
            columns = np.column_stack([slope, -residuals]) / error[:, None]
            found.append((columns[:max_readings], time[:max_readings]))
        return found

    def estimate_noise(
        self, noise: CorrelatedNoise | None = None, max_readings: int | None = None
    ) -> tuple[Memory, CorrelatedNoise, float]:
        """Estimate the correlated noise from at most `max_readings` of each run and output."""
        rows, time = zip(*self.linear_rows(max_readings), strict=True)
        priors = (np.ravel(prior.residual(self.fit.model)) for prior in self.case.priors)
        prior = np.concatenate([np.zeros(0), *priors])
        prior_rows = np.column_stack([self.fit.dense_jacobian[self.fit.problem.size :], prior])
        return noise_posterior(rows, time, prior_rows, noise)

    def drift_degree(self) -> int:
        """Choose the degree of the drifts, which are all free in the fit.

        Correlated noise counts as such: a random wander is no drift.
        """
        memory = None
        if self.is_correlated():
            memory = self.estimate_noise(max_readings=MAX_NOISE_READINGS)[1]
        white = [whiten(*each, memory)[0] for each in self.linear_rows()]
        rows = np.concatenate(white)
        drift = np.array([name.startswith("drift[") for name in self.fit.problem.names])
        own, waves = rows[:, :-1][:, ~drift], rows[:, :-1][:, drift]
        without = waves @ self.fit.theta[drift] - rows[:, -1]  # readings less the response
        waves = np.moveaxis(waves.reshape(len(rows), -1, MAX_DRIFT_DEGREE), 2, 1)
        return best_drift_degree(own, waves.reshape(len(rows), -1), without)

    def is_exact(self) -> bool:
        """True if the model explains all outputs up to rounding."""
        return all(_is_exact(n, s.floor) for row in self.noise
                   for n, s in zip(row, self.case.prepared, strict=True))  # fmt: skip

    def is_correlated(self) -> bool:
        """True if the residuals of any output are correlated and exceed rounding."""
        used = effective_parameters(self.fit)
        rows = self.case.residual_rows(self.residuals, self.noise)
        return any(remembers(r / error, used) and r.std() > floor for r, error, _, floor in rows)

    @property
    def rms(self) -> np.ndarray:
        """Rms residual, by run and output."""
        return np.array([[float(np.sqrt(np.mean(r**2))) for r in row] for row in self.residuals])


def _is_exact(noise: ReadingErrors, floor: float) -> bool:
    return bool(noise.each.max() <= 1.001 * floor)


def effective_parameters(fit: Fit) -> int:
    """Effective number of parameters: readings less degrees of freedom, at least 1."""
    return max(round(sum(group.count - group.dof for group in fit.groups)), 1)


def bic_of(
    found: RunsFit, noise: CorrelatedNoise | None, lengths: Sequence[int] | None = None
) -> float:
    """Bayesian information criterion of a fit under a given noise.

    All readings count, or only the last `lengths` of each run and output.
    """
    rows = found.case.residual_rows(found.residuals, found.noise)
    if lengths is not None:
        rows = [(*(each[-n:] for each in row[:3]), row[3])
                for row, n in zip(rows, lengths, strict=True)]  # fmt: skip
    cost = effective_parameters(found.fit) * np.log(sum(len(residuals) for residuals, *_ in rows))
    return float(cost + sum(_deviance(*row, noise) for row in rows))


def _deviance(
    residuals: np.ndarray,
    error: np.ndarray,
    time: np.ndarray,
    floor: float,
    memory: CorrelatedNoise | None,
) -> float:
    """Give -2 ln L of residuals with the best noise level; only ratios of errors count."""
    scale = error / error.min()
    white, volume = whiten(residuals / scale, time, memory)
    level = max(float(np.std(white)), floor)
    return 2.0 * (len(residuals) * np.log(level) + float(np.log(scale).sum()) + volume)


def _predict_with_gaps(model: Any, course: Any) -> jax.Array:
    return jnp.concatenate(course.shoot(model))


def _innovations_of(model: Any, data: tuple[Any, jax.Array, jax.Array]) -> jax.Array:
    """Innovations of a run: outputs less predictions from earlier readings, over errors."""
    course, error, memory = data
    return filtered(predicted(model, course) / error, course.time, CorrelatedNoise(*memory))


def repeat_search(
    found: Any, search: Callable[[Any], Any], min_gain: float, max_rounds: int
) -> tuple[Any, bool]:
    """Search from the last result until the gain is small; also give True if it became so."""
    for _ in range(max_rounds):
        if not np.isfinite(found.cost):
            break
        before, found = found, search(found)
        if abs(before.cost - found.cost) < min_gain:
            return found, True
    return found, False


def fit_in_rounds(case: Case, models: Sequence[Any], max_rounds: int = MAX_ROUNDS) -> RunsFit:
    """Search one round from each start, then from the best result until nothing is gained."""
    tried = (case.search(model, case.initial_noise) for model in models)
    found = min(tried, key=lambda each: each.cost)
    count = sum(len(residuals) for row in found.residuals for residuals in row)
    min_gain = MIN_GAIN + MIN_GAIN_PER_READING * count
    found, converged = repeat_search(
        found, lambda f: case.search(f.fit.model, f.noise), min_gain, max_rounds
    )
    return found._replace(converged=converged or found.converged)


def fit_correlated_noise(white: RunsFit, max_ratio: float = np.inf) -> RunsFit:
    """Fit again with correlated noise where the residuals of a white-noise fit are correlated.

    The new fit is dropped if its sum of squares is larger by more than `max_ratio`. Errors average
    over the uncertainty of the noise also where residuals look white: a drift may be hidden in the
    numbers.
    """
    if white.is_exact():
        return white
    if not white.is_correlated():
        return white._replace(errors=white.estimate_noise(max_readings=MAX_NOISE_READINGS)[0])
    case = white.case

    def search(found: RunsFit) -> RunsFit:
        _, memory, level = found.estimate_noise(max_readings=MAX_NOISE_READINGS)
        noise = tuple(tuple(n._replace(each=level * n.each) for n in row) for row in found.noise)
        return case.search(found.fit.model, noise, memory)

    found = repeat_search(white, search, MIN_GAIN, MAX_CORRELATED_ROUNDS)[0]
    squares, before = (case.normalised_squares(each.residuals) for each in (found, white))
    if squares > max_ratio * before:
        # The search took a part of the response for noise that wanders.
        found = white
    errors = found.estimate_noise(max_readings=MAX_NOISE_READINGS)[0]
    longest = max(len(r) for row in found.residuals for r in row)
    if found is not white and longest > MAX_NOISE_READINGS:
        errors = found.estimate_noise(found.memory)[0]
    return found._replace(converged=white.converged, errors=errors)


def response_case(
    prepared: PreparedOutput, path: Path, offset: bool, network: bool = False
) -> Case:
    """Build the case of one output, with constant raw numbers or a network of them."""
    free = [Free("start", nuisance=True), Free("map", nuisance=network)]
    free += [Free("offset")] if offset else []
    free += [Free("late", *prepared.fraction_limits)] if prepared.fraction_limits else []
    priors = weight_priors("map") if network else ()
    return Case((prepared,), prepared.runs, tuple(free), priors, path)


def fit_case(case: Case, models: Sequence[Any]) -> RunsFit:
    """Fit from several starts, then with correlated noise where residuals are correlated.

    The noise is estimated anew in every round, as it sets the weight of a network's priors.
    """
    return fit_correlated_noise(fit_in_rounds(case, models))
