"""Search for a response: the start, the fit in rounds, the noise of its residuals.

For given time constants the output is linear in gains, offset and first states: a grid of them with
linear least squares finds the basin also where noise ruins equation errors. Then all numbers are
fitted in rounds, each with the noise that the residuals of the round before had. That noise is a
part that wanders with a correlation time and a part without memory; one lag tells neither, so both
are estimated together, and errors average over what stays open.
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
    CLOSE,
    Driven,
    PreparedOutput,
    filled,
    output_of,
    predicted,
    weight_priors,
)
from beamfit.dynamics.paths import Path, Paths, handed_on, prepared, undriven
from beamfit.dynamics.record import Run
from beamfit.dynamics.response import ARX, FIRST_ORDER, SECOND_ORDER, Physics
from beamfit.errors import Status
from beamfit.greybox.fit import Fit
from beamfit.greybox.problem import Free, Prior, Problem, Record
from beamfit.greybox.solve import solve
from beamfit.noise.correlated import TIMES, Memory, noises, range_of, whitened_by_each
from beamfit.noise.memory import BESIDE, CorrelatedNoise, filtered, innovations, remembers

# Time constants of the grid, as near as a damping of 0.2 tells them apart, and dampings of a second
# order.
LAGS, DAMPINGS = 32, (0.2, 0.6, 1.0, 2.0)
# Gain in log likelihood that a longer delay needs over a shorter one.
BETTER = 5.0
# Paths that are looked at together: one program is compiled for all.
BATCH = 16
TINY = np.finfo(float).tiny
# Highest degree of a drift of the output in a run: it turns once less.
DRIFT = 8


def drift_waves(through: Array) -> Array:
    """Polynomials of a slow drift, from the line on, at times in lengths of the run.

    Shape (readings, DRIFT): Chebyshev's, cosines of an angle, less their means over the run.
    """
    xp, degree = array_module(through), np.arange(1, DRIFT + 1)
    angle = xp.arccos(xp.clip(2.0 * through - 1.0, -1.0, 1.0))
    mean = np.where(degree % 2, 0.0, 1.0 / (1.0 - np.maximum(degree, 2) ** 2))
    return xp.cos(angle[:, None] * degree) - mean


def drift_columns(through: Array, i: int, runs: int) -> Array:
    """Those of each run at the readings of run i, shape (readings, DRIFT, runs), zero but for i."""
    xp = array_module(through)
    return xp.pad(drift_waves(through)[..., None], ((0, 0), (0, 0), (i, runs - 1 - i)))


def drift_costs(triangles: np.ndarray, runs: int, count: int, least: float = TINY) -> np.ndarray:
    """-2 ln L with a drift of degree 0, 1, … of so many runs, and the cost of its numbers.

    The Bayesian information criterion of `count` readings, with the noise's size at its likeliest;
    `triangles` are factors of a model's own columns, of drifts by degree, and of the readings.
    """
    used = triangles.shape[-1] - 1 - runs * DRIFT + runs * np.arange(DRIFT + 1)
    missed = np.stack([np.sum(triangles[..., k:, -1] ** 2, axis=-1) for k in used], axis=-1)
    return count * np.log(np.maximum(missed, least)) + np.log(count) * used


def spanned(columns: np.ndarray, size: np.ndarray | None = None) -> np.ndarray:
    """Orthonormal columns that span these; those that are nothing beside their size are none."""
    size = np.linalg.norm(columns, axis=0) if size is None else size
    found, values, _ = np.linalg.svd(columns / np.where(size > 0, size, 1.0), full_matrices=False)
    return found[:, values > 1e-6]


class Start(NamedTuple):
    """A path, the model that a search begins with, and -2 ln L with the cost of a drift."""

    path: Path
    model: dict[str, Any]
    cost: float


class ResponseSearch(NamedTuple):
    """Output, physics and paths of a search, and whether the output at rest is a free number."""

    output: str
    physics: Physics
    paths: Paths
    offset: bool

    def starts(self, runs: tuple[Run, ...], physics: Physics, paths: Sequence[Path]) -> list[Start]:
        """The best start of a physics by each path, `BATCH` at once."""
        size, found = BATCH if len(paths) > 2 else len(paths), []
        for k in range(0, len(paths), size):
            some = [*paths[k : k + size]]
            more = some[:1] * (size - len(some))
            found += self._starts(runs, physics, [*some, *more])[: len(some)]
        return found

    def _starts(
        self, runs: tuple[Run, ...], physics: Physics, paths: Sequence[Path]
    ) -> list[Start]:
        """The best of a grid of time constants and dampings, and of a finer one about it."""
        seen, every = prepared(runs, self.output, physics, paths[0]), np.arange(len(paths))
        first = max(self.paths.delays[0], 0.0)
        whole = undriven(runs, self.output, physics, self.paths.parts, first)
        drives, measured = whole.drives, tuple(map(filled, whole.drives, whole.measured))
        inputs, part = handed_on(runs, whole, self.paths.parts, paths)
        axes = [np.log(np.geomspace(0.1 * seen.apart, seen.span, LAGS))]
        axes += [np.log(DAMPINGS)] if physics is not FIRST_ORDER else []
        reach = np.array([axis[1] - axis[0] for axis in axes])
        count = sum(map(len, seen.measured))
        exact = count * (CLOSE * seen.size_y) ** 2
        around = np.array([*product(*(np.linspace(-1.0, 1.0, len(axis)) for axis in axes))])
        grid = np.tile([*product(*axes)], (len(paths), 1, 1))

        def least(logarithms):
            found = np.exp(logarithms)
            found = found if physics is not ARX else difference(found, seen.apart)
            asked = ([u[..., 0] for u in inputs], part), found
            triangles = np.asarray(_triangles(drives, measured, *asked, self.offset))
            costs = drift_costs(triangles, len(seen.runs), count, exact)
            return costs.min(axis=2).argmin(axis=1), found, triangles, costs

        near = grid[every, least(grid)[0]]
        at, shapes, triangles, costs = least(near[:, None] + reach * around)
        best = paths, shapes[every, at], triangles[every, at], costs[every, at]
        return [
            Start(path, self._model(physics, seen, *each, cost), float(cost.min()))
            for path, *each, cost in zip(*best, strict=True)
        ]

    def _model(
        self,
        physics: Physics,
        seen: PreparedOutput,
        shape: np.ndarray,
        triangle: np.ndarray,
        costs: np.ndarray,
    ) -> dict[str, Any]:
        """The model of a shape by its triangular factor and the costs of drifts."""
        runs, own = len(seen.runs), triangle.shape[1] - 1 - DRIFT * len(seen.runs)
        design = triangle[:, : own + runs * int(costs.argmin())]
        size = np.linalg.norm(design, axis=0)
        size = np.where(size > 0, size, 1.0)
        found = (np.linalg.lstsq(design / size, triangle[:, -1], rcond=1e-10)[0] / size)[:own]
        k = own - self.offset - runs * physics.free_states
        gains, first = np.split(found[: own - self.offset], [k])
        raw = physics.raw(jnp.asarray(np.append(shape, gains)), len(seen.inputs))
        level = float(found[-1]) if self.offset else 0.0
        return {"map": raw, "start": first.reshape(runs, -1), "offset": level, "late": 0.0}

    def start(self, runs: tuple[Run, ...]) -> Start:
        """The start of the shortest whole delay about as likely as any, noise being white, or of a
        likelier part of a sample about it.

        The delay of a difference equation is that of a second order: its own gains of two samples
        let a shorter one pass.
        """
        law = SECOND_ORDER if self.physics is ARX and not self.paths.given else self.physics

        def cost(start: Start) -> float:
            return start.cost - 2.0 * self.paths.log_prior(start.path)

        tried = self.starts(runs, law, self.paths.plain())
        near = min(map(cost, tried)) + 2.0 * BETTER
        near = min(abs(each.path.delay) for each in tried if cost(each) <= near)
        found = min((each for each in tried if abs(each.path.delay) == near), key=cost)
        if parts := self.paths.around(found.path.delay):
            found = min([found, *self.starts(runs, law, parts)], key=cost)
        return found if law is self.physics else self.starts(runs, self.physics, [found.path])[0]

    def begun(self, runs: tuple[Run, ...]) -> Begun:
        """Identify with constant parameters."""
        start = self.start(runs)
        return self.along(runs, start.path, start.model)

    def along(self, runs: tuple[Run, ...], path: Path, model: dict[str, Any]) -> Begun:
        """Identify with constant parameters by a path, from a model."""
        case = case_of(prepared(runs, self.output, self.physics, path), self.offset)
        return Begun(case, path, fitted(case, [model | {"late": 0.0}]))

    def is_first_order(self, runs: tuple[Run, ...], found: Begun) -> bool:
        """True if a first order does as well as a higher one by the information criterion."""
        if self.physics is FIRST_ORDER:
            return False
        lower = found.seen._replace(runs=driven_by(found.seen, FIRST_ORDER))
        (start,) = self.starts(runs, FIRST_ORDER, [found.path])
        fit = fitted(case_of(lower, self.offset), [start.model])
        return fit.likelihood <= found.settled.likelihood


def difference(shapes: np.ndarray, apart: float) -> np.ndarray:
    """a1 and a2 of the difference equations that samples of second orders obey."""
    time, zeta = np.moveaxis(shapes, -1, 0).astype(complex)
    root = np.sqrt(zeta**2 - 1.0)
    one, other = (np.exp(-apart / time * (zeta + sign * root)) for sign in (1, -1))
    return np.stack([-(one + other), one * other], axis=-1).real


def shape_of(seen: PreparedOutput, model: Any) -> np.ndarray:
    """Lags, or poles, of a model with constant parameters, as of `unit_outputs`."""
    physics, m = seen.runs[0].physics, len(seen.inputs)
    count = len(physics.units(m)) - m * (2 if physics is ARX else 1)
    return np.asarray(physics.physical(model["map"], m))[:count]


@jax.jit
def unit_outputs(run: Driven, shapes: jax.Array) -> jax.Array:
    """Outputs for unit gains and unit first states, shape (shapes, columns, readings)."""
    m, k = len(run.physics.units(run.u.shape[1])) - shapes.shape[1], run.physics.free_states

    def one(shape, gains, first):
        return run.constant(jnp.concatenate([shape, gains]), first, run.part)

    gains = jnp.concatenate([jnp.eye(m), jnp.zeros((k, m))])
    firsts = jnp.concatenate([jnp.zeros((m, k)), jnp.eye(k)])
    each = jax.vmap(one, in_axes=(None, 0, 0))
    return jax.vmap(each, in_axes=(0, None, None))(shapes, gains, firsts)


def linear_columns(runs: Sequence[Driven], i: int, shapes: jax.Array, offset: bool) -> jax.Array:
    """Outputs of run i for unit gains, unit first states of each run and the offset, by shape."""
    columns = jnp.swapaxes(unit_outputs(runs[i], shapes), 1, 2)
    k = runs[i].physics.free_states
    others = (0, 0), (0, 0), (i * k, (len(runs) - 1 - i) * k)
    level = jnp.ones((*columns.shape[:2], int(offset)))
    return jnp.concatenate([columns[..., :-k], jnp.pad(columns[..., -k:], others), level], axis=2)


@partial(jax.jit, static_argnums=4)
def _triangles(runs: tuple[Driven, ...], measured: Any, inputs: Any, shapes: Any, offset: bool):
    """Triangular factors of outputs of unit gains, first states and offset, of drifts of each run
    by degree, and of the readings: for each path one for each of its shapes.
    """
    rest = []
    for i, (run, y) in enumerate(zip(runs, measured, strict=True)):
        waves = drift_columns(run.time / run.time[run.count - 1], i, len(runs))
        rest.append(jnp.concatenate([waves.reshape(len(y), -1), y[:, None]], axis=1))
    read = jnp.concatenate([jnp.arange(len(run.index)) < run.count for run in runs])[:, None]
    rest = jnp.concatenate(rest)

    def one(asked):
        (inputs, part), shapes = asked
        felt = [replace(run, u=u, part=part) for run, u in zip(runs, inputs, strict=True)]
        parts = [linear_columns(felt, i, shapes, offset) for i in range(len(runs))]
        rows = jnp.concatenate(parts, axis=1)
        every = jnp.broadcast_to(rest, (len(rows), *rest.shape))
        rows = jnp.where(read, jnp.concatenate([rows, every], axis=2), 0.0)
        few = (0, 0), (0, max(0, rows.shape[2] - rows.shape[1])), (0, 0)
        return jnp.linalg.qr(jnp.pad(rows, few), mode="r")

    return jax.lax.map(one, (inputs, shapes))


def driven_by(seen: PreparedOutput, physics: Physics) -> tuple[Driven, ...]:
    """The runs with another physics."""
    return tuple(replace(run, physics=physics) for run in seen.runs)


def noises_of(
    time: Sequence[np.ndarray], count: int = TIMES, ratios: Sequence[float] = BESIDE
) -> list[CorrelatedNoise]:
    """Noises that readings at these times, by run, may have: so many correlation times, and with
    each the ratios of white variance to what the part that wanders gets anew in a sample.
    """
    apart = min(float(np.median(np.diff(t))) for t in time)
    ends = np.array([range_of(t) for t in time])
    return noises((ends[:, 0].min(), ends[:, 1].max()), apart, count, ratios)


def noise_of(
    rows: Sequence[np.ndarray],
    time: Sequence[np.ndarray],
    known: np.ndarray,
    noise: CorrelatedNoise | None = None,
) -> tuple[Memory, CorrelatedNoise, float]:
    """The noise by what residuals say of it, all runs together, and its size in units of theirs.

    `rows` hold the slopes of each run's residuals and, last, the residuals, in units of their
    noise; `known` those of the priors; `noise` is it if it is known.
    """
    grid = noises_of(time) if noise is None else [noise]
    memory = whitened_by_each(grid, list(zip(rows, time, strict=True)), known).memory()
    best = int(np.argmax(memory.weight))
    return memory, grid[best], float(np.sqrt(memory.squares[best] / memory.dof))


# Ratios of the noise by a clock's jitter, rms, to the rest; the prior is as much for none as for
# all of them. Longest jitter: by more than half a sample readings would not be in their order.
RATIOS, LONGEST_JITTER = np.append(0.0, np.geomspace(0.2, 50.0, 24)), 0.5
JITTER_COST = 2.0 * float(np.log(len(RATIOS) - 1))


class ReadingErrors(NamedTuple):
    """Standard deviation of each reading of an output in a run, and the jitter of its clock, s.

    Readings that are taken by an uncertain time earlier or later are off by as much as the output
    moves meanwhile: sqrt(at_rest² + (jitter slope)²).
    """

    each: np.ndarray
    jitter: float = 0.0


def spread_by_jitter(fitted: np.ndarray, time: np.ndarray) -> tuple[np.ndarray, float]:
    """Errors of readings over those at rest, a row for each of `RATIOS`, and the model's usual
    slope; one row of 1 where it does not move.
    """
    slope = np.diff(fitted) / np.diff(time)
    moves = np.sqrt(0.5 * (np.append(slope, 0.0) ** 2 + np.append(0.0, slope) ** 2))
    usual = float(np.sqrt(np.mean(moves**2)))
    if not (np.isfinite(usual) and usual > 0):
        return np.ones((1, len(time))), 0.0
    return np.hypot(1.0, np.outer(RATIOS, moves / usual)), usual


def reading_errors(
    rest: np.ndarray,
    fitted: np.ndarray,
    time: np.ndarray,
    least: float,
    memory: CorrelatedNoise | None,
) -> ReadingErrors:
    """The likeliest errors of readings, by their residuals."""
    scale, usual = spread_by_jitter(fitted, time)
    if not usual:
        return ReadingErrors(np.full(len(rest), max(float(rest.std()), least)))
    white = whitened_rows((rest / scale).T, time, memory)[0]
    size = np.maximum(np.sqrt(np.mean(white**2, axis=0)), least)
    minus = 2.0 * (len(rest) * np.log(size) + np.log(scale).sum(axis=1))
    minus[1:] += JITTER_COST
    jitter = RATIOS * size / usual
    minus[jitter > LONGEST_JITTER * np.median(np.diff(time))] = np.inf
    at = int(minus.argmin())
    each = np.maximum(scale[at] * float(np.std(rest / scale[at])), least)
    return ReadingErrors(each, float(jitter[at]))


def whitened_rows(
    rows: np.ndarray, time: np.ndarray, memory: CorrelatedNoise | None
) -> tuple[np.ndarray, float]:
    """Rows whitened, and the log sum of the errors; as they are without a memory."""
    return (rows, 0.0) if memory is None else innovations(rows, time, memory)


# Steps of a round, after which the noise is estimated again, and most rounds, also with a memory of
# the noise; they end below a gain in -2 ln L of GAINED and of EACH for a reading.
STEPS, ROUNDS, AGAIN, GAINED, EACH = 25, 80, 3, 0.05, 1e-4
# Most readings of each output that estimate correlated noise.
LONGEST = 5000


# Parts of a model that each run has for itself.
OWN = ("start", "nodes", "drift")
# Errors of the readings, by run and output.
Noises = tuple[tuple[ReadingErrors, ...], ...]


class Case(NamedTuple):
    """A fit to be made: prepared outputs, runs, free numbers and priors.

    A course is a run as its model sees it: `model.Driven` or `state_fit.Course`. Of models that
    have drifts of the outputs, those of this `degree` are free.
    """

    seen: tuple[PreparedOutput, ...]
    courses: tuple[Any, ...]
    free: tuple[Free, ...]
    priors: tuple[Prior, ...]
    degree: int = 0

    @property
    def guess(self) -> Noises:
        """Errors of the readings before anything is known of them."""
        return tuple(
            tuple(ReadingErrors(np.full(len(s.measured[i]), 0.1 * s.size_y)) for s in self.seen)
            for i in range(len(self.courses))
        )

    def measured(self, i: int) -> np.ndarray:
        """Readings of a run, one output after the other."""
        return np.concatenate([s.measured[i] for s in self.seen])

    def split(self, i: int, rows: np.ndarray) -> list[np.ndarray]:
        """Rows of the readings of a run, by output."""
        return np.split(rows, np.cumsum([len(s.measured[i]) for s in self.seen])[:-1])

    def rest(self, model: Any) -> tuple[tuple[np.ndarray, ...], ...]:
        """Residuals of a model, by run and output."""
        return tuple(
            tuple(self.split(i, self.measured(i) - output_of(model, course)))
            for i, course in enumerate(self.courses)
        )

    def errors(self, rest: Any, memory: CorrelatedNoise | None) -> Noises:
        """Errors of the readings by their residuals."""
        return tuple(
            tuple(
                reading_errors(r, s.measured[i] - r, s.time[i], CLOSE * s.size_y, memory)
                for r, s in zip(row, self.seen, strict=True)
            )
            for i, row in enumerate(rest)
        )

    def rows(
        self, rest: Any, noise: Noises
    ) -> list[tuple[np.ndarray, np.ndarray, np.ndarray, float]]:
        """Residuals, errors, times and the floor of the errors, for each run and output."""
        return [
            (r, n.each, s.time[i], CLOSE * s.size_y)
            for i, row in enumerate(rest)
            for r, n, s in zip(row, noise[i], self.seen, strict=True)
        ]

    def drifts(self, model: Any) -> tuple[tuple[np.ndarray, ...], ...]:
        """Drifts that a model has, at the readings, by run and output."""
        if "drift" not in model:
            return tuple(tuple(np.zeros(len(s.measured[i])) for s in self.seen)
                         for i in range(len(self.courses)))  # fmt: skip
        return tuple(
            tuple(self.split(i, np.asarray(course.drift(model))[: course.count]))
            for i, course in enumerate(self.courses)
        )

    def beside_drift(self, model: Any) -> Any:
        """The model with the drifts that explain most of its residuals."""
        still = model | {"drift": np.zeros_like(model["drift"])}
        for i, row in enumerate(self.rest(still)):
            columns = self.split(i, np.asarray(self.courses[i].waves)[: self.courses[i].count])
            for k, (rest, waves) in enumerate(zip(row, columns, strict=True)):
                level = np.column_stack([waves[:, k, : self.degree], np.ones(len(rest))])
                still["drift"][i, k, : self.degree] = np.linalg.lstsq(level, rest)[0][:-1]
        return still

    def squares(self, rest: Any) -> float:
        """Sum of squared residuals, in units of each output's scatter."""
        return sum(float(np.sum((r / s.size_y) ** 2))
                   for row in rest for r, s in zip(row, self.seen, strict=True))  # fmt: skip

    def ahead(self, found: Settled) -> tuple[np.ndarray, ...]:
        """Residuals of a run that was held back, by output: only its start and its drift are
        fitted.
        """
        sizes = np.sqrt(np.mean(found.rms**2, axis=0))
        noise = tuple(ReadingErrors(np.full(len(s.measured[0]), size))
                      for s, size in zip(self.seen, sizes, strict=True))  # fmt: skip
        model = dict(found.fit.model)
        model |= {name: np.mean(model[name], axis=0)[None] for name in OWN if name in model}
        case = self._replace(free=(Free("start", nuisance=True),), priors=())
        return case.rest(solve(case.problem(model, (noise,))).model)[0]

    def problem(
        self, model: Any, noise: Noises, memory: CorrelatedNoise | None = None, gap: Any = ()
    ) -> Problem:
        """State it; `gap` is how far ends of segments may lie apart, shape (states,).

        `noise` is a guess that the residuals correct, `memory` how it wanders.
        """
        records = []
        cuts = model["nodes"].shape[1] if len(gap) else 0
        for i, course in enumerate(self.courses):
            y, asked, predict = self.measured(i), course, predicted
            error = np.concatenate([each.each for each in noise[i]])
            exact = all(_exact(n, s.size_y) for n, s in zip(noise[i], self.seen, strict=True))
            if memory is not None:
                y = innovations(y / error, np.asarray(course.time)[: len(y)], memory)[0]
                asked = course, jnp.asarray(filled(course, error, 1.0)), jnp.asarray(memory)
                error, predict = np.ones_like(y), _surprising
            rows = [filled(course, *each) for each in ((y,), (error, 1.0), (np.ones_like(y),))]
            if cuts:
                gaps, predict = cuts * len(gap), _with_gaps
                more = np.zeros(gaps), np.tile(gap, cuts), np.ones(gaps)
                rows = [np.concatenate(pair) for pair in zip(rows, more, strict=True)]
            worth = np.inf if exact else 1.0
            records.append(Record(f"run {i + 1}", predict, asked, *rows, worth))
        free = [*self.free, *([Free("nodes", nuisance=True)] if cuts else [])]
        if "drift" in model:
            end = np.where(np.arange(DRIFT) < self.degree, np.inf, np.zeros_like(model["drift"]))
            free.append(Free("drift", -end, end, nuisance=True))
        return Problem(model, free, records, self.priors)

    def search(
        self, model: Any, noise: Noises, memory: CorrelatedNoise | None = None, gap: Any = ()
    ) -> Settled:
        """Fit with the noise that the residuals of the round before had.

        The part of a sample in a delay begins anew.
        """
        model = model | {"late": 0.0} if "late" in model else model
        fit = solve(self.problem(model, noise, memory, gap), iterations=STEPS)
        rest = self.rest(fit.model)
        rests = fit.status not in (Status.not_finite, Status.not_converged)
        found = Settled(fit, rest, self.errors(rest, memory), memory, None, np.inf, rests)
        minus = information(self, found, memory)
        return found._replace(likelihood=minus if np.isfinite(minus) else np.inf)


class Settled(NamedTuple):
    """A fit whose noise is that of its own residuals.

    `rest` and `noise` by run and output; `memory` of a noise with one and `errors` that average
    over what is open of it; `likelihood` is -2 ln L with the cost of the Bayesian information
    criterion; `rests` whether a further round would gain nothing.
    """

    fit: Fit
    rest: tuple[tuple[np.ndarray, ...], ...]
    noise: Noises
    memory: CorrelatedNoise | None
    errors: Memory | None
    likelihood: float
    rests: bool

    def slopes(self, case: Case) -> list[np.ndarray]:
        """Slopes of each run's outputs by the free numbers; 0 by those that are held."""
        free = self.fit.problem.moving
        return [
            free * np.asarray(self.fit.derive(predicted, course).slope)[: course.count]
            for course in case.courses
        ]

    def linear_rows(self, case: Case, most: int | None = None) -> list[tuple[np.ndarray, ...]]:
        """Slopes and, last, residuals of each run and output in units of the errors, and times, of
        so many readings at most.
        """
        own = [part for i, s in enumerate(self.slopes(case)) for part in case.split(i, s)]
        return [(np.column_stack([slope, -rest])[:most] / error[:most, None], time[:most])
                for slope, (rest, error, time, _) in zip(
                    own, case.rows(self.rest, self.noise), strict=True)]  # fmt: skip

    def remembered(
        self, case: Case, noise: CorrelatedNoise | None = None, most: int | None = None
    ) -> tuple[Memory, CorrelatedNoise, float]:
        """The noise with a memory that the residuals have, of so many of them at most."""
        rows, time = zip(*self.linear_rows(case, most), strict=True)
        prior = np.asarray(self.fit.problem.residual(self.fit.theta))[self.fit.problem.size :]
        known = np.column_stack([self.fit.dense_jacobian[self.fit.problem.size :], prior])
        return noise_of(rows, time, known, noise)

    def drift_degree(self, case: Case) -> int:
        """The degree of drifts that the information criterion wants beside the other numbers.

        All are free in the fit. The noise may have a memory: what wanders at random is no drift.
        """
        memory = self.remembered(case, most=LONGEST)[1] if self.correlated(case) else None
        white = [whitened_rows(*each, memory)[0] for each in self.linear_rows(case)]
        rows = np.concatenate(white)
        drift = np.array([name.startswith("drift[") for name in self.fit.problem.names])
        own, waves = rows[:, :-1][:, ~drift], rows[:, :-1][:, drift]
        without = waves @ self.fit.theta[drift] - rows[:, -1]  # readings less the response
        waves = np.moveaxis(waves.reshape(len(rows), -1, DRIFT), 2, 1).reshape(len(rows), -1)
        columns = np.column_stack([spanned(own), waves, without])
        more = max(0, columns.shape[1] - len(columns))
        triangle = np.linalg.qr(np.pad(columns, ((0, more), (0, 0))), mode="r")
        return int(drift_costs(triangle, waves.shape[1] // DRIFT, len(rows)).argmin())

    def exact(self, case: Case) -> bool:
        """True if the model explains all outputs but for rounding."""
        return all(_exact(n, s.size_y) for row in self.noise
                   for n, s in zip(row, case.seen, strict=True))  # fmt: skip

    def correlated(self, case: Case) -> bool:
        """True if the noise of any output has a memory and exceeds rounding."""
        used = used_by(self.fit)
        return any(remembers(r / error, used) and r.std() > least
                   for r, error, _, least in case.rows(self.rest, self.noise))  # fmt: skip

    @property
    def rms(self) -> np.ndarray:
        """Root mean square of the residuals, by run and output."""
        return np.array([[float(np.sqrt(np.mean(r**2))) for r in row] for row in self.rest])


def _exact(noise: ReadingErrors, size_y: float) -> bool:
    return bool(noise.each.max() <= 1.001 * CLOSE * size_y)


def used_by(fit: Fit) -> int:
    """Number of numbers that the readings determine."""
    return max(round(sum(group.count - group.dof for group in fit.groups)), 1)


def information(
    case: Case, found: Settled, noise: CorrelatedNoise | None, lengths: Sequence[int] | None = None
) -> float:
    """The Bayesian information criterion of a fit under a noise with a memory, or without, by all
    readings or by the last ones of each run and output.
    """
    rows = case.rows(found.rest, found.noise)
    if lengths is not None:
        rows = [(*(each[-n:] for each in row[:3]), row[3])
                for row, n in zip(rows, lengths, strict=True)]  # fmt: skip
    cost = used_by(found.fit) * np.log(sum(len(rest) for rest, *_ in rows))
    return float(cost + sum(_minus(*row, noise) for row in rows))


def _minus(
    rest: np.ndarray,
    error: np.ndarray,
    time: np.ndarray,
    least: float,
    memory: CorrelatedNoise | None,
) -> float:
    """-2 ln L of residuals whose errors have these ratios, their size being their own."""
    scale = error / error.min()
    white, volume = whitened_rows(rest / scale, time, memory)
    size = max(float(np.std(white)), least)
    return 2.0 * (len(rest) * np.log(size) + float(np.log(scale).sum()) + volume)


def _with_gaps(model: Any, course: Any) -> jax.Array:
    return jnp.concatenate(course.shot(model))


def _surprising(model: Any, asked: tuple[Any, jax.Array, jax.Array]) -> jax.Array:
    """Innovations of a run: an output less its prediction from earlier ones, over the errors."""
    course, error, memory = asked
    return filtered(predicted(model, course) / error, course.time, CorrelatedNoise(*memory))


def rounds(found: Any, again: Callable[[Any], Any], gained: float, most: int) -> tuple[Any, bool]:
    """Search again from what was found, until nothing is gained; and whether that came to be."""
    for _ in range(most):
        if not np.isfinite(found.likelihood):
            break
        before, found = found, again(found)
        if abs(before.likelihood - found.likelihood) < gained:
            return found, True
    return found, False


def settled(case: Case, models: Sequence[Any], most: int = ROUNDS) -> Settled:
    """Search from each start for a round, then from the best until nothing is gained."""
    tried = (case.search(model, case.guess) for model in models)
    found = min(tried, key=lambda each: each.likelihood)
    enough = GAINED + EACH * sum(len(rest) for row in found.rest for rest in row)
    found, rests = rounds(found, lambda f: case.search(f.fit.model, f.noise), enough, most)
    return found._replace(rests=rests or found.rests)


def with_memory(case: Case, white: Settled, worse: float = np.inf) -> Settled:
    """The fit again, its noise with a memory, where residuals are correlated.

    It may leave squares larger by the factor `worse`. Errors average over what the residuals leave
    open of the noise also where they look white: a drift may be in the numbers instead.
    """
    if white.exact(case):
        return white
    if not white.correlated(case):
        return white._replace(errors=white.remembered(case, most=LONGEST)[0])

    def again(found: Settled) -> Settled:
        _, memory, size = found.remembered(case, most=LONGEST)
        noise = tuple(tuple(n._replace(each=size * n.each) for n in row) for row in found.noise)
        return case.search(found.fit.model, noise, memory)

    found = rounds(white, again, GAINED, AGAIN)[0]
    if case.squares(found.rest) > worse * case.squares(white.rest):
        # The search took a part of the response for noise that wanders.
        found = white
    errors = found.remembered(case, most=LONGEST)[0]
    if found is not white and max(len(r) for row in found.rest for r in row) > LONGEST:
        errors = found.remembered(case, found.memory)[0]
    return found._replace(rests=white.rests, errors=errors)


def case_of(seen: PreparedOutput, offset: bool, network: bool = False) -> Case:
    """The case of one output: constant raw numbers or a network of them."""
    free = [Free("start", nuisance=True), Free("map", nuisance=network)]
    free += [Free("offset")] if offset else []
    free += [Free("late", *seen.ends)] if seen.ends else []
    return Case((seen,), seen.runs, tuple(free), weight_priors("map") if network else ())


def fitted(case: Case, models: Sequence[Any]) -> Settled:
    """The best fit from some starts, its noise with a memory where residuals are correlated.

    The noise weighs against the priors of a network, so it is taken anew in every round.
    """
    return with_memory(case, settled(case, models))


class Begun(NamedTuple):
    """Runs as a model sees them behind a path, and the fit."""

    case: Case
    path: Path
    settled: Settled

    @property
    def seen(self) -> PreparedOutput:
        """The runs of the first output, which is the only one of a response."""
        return self.case.seen[0]

    @property
    def exact(self) -> float:
        """The delay in samples, by the fit where it is a number of it."""
        late = float(self.settled.fit.model["late"]) if self.seen.ends else 0.0
        return round((self.seen.delay + late) / self.seen.parts, 9)  # an end of a range may be 0

    def contains(self, path: Path) -> bool:
        """True if the fit is by that path, or estimates its delay."""
        low, high = (self.seen.delay + end for end in self.seen.ends or (0.0, 0.0))
        inside = low <= path.delay * self.seen.parts <= high
        return path.law is None and path.way == self.path.way and inside

    def on(self, runs: Sequence[Run]) -> Case:
        """The case of other runs."""
        seen = tuple(prepared(runs, s.output, s.runs[0].physics, self.path) for s in self.case.seen)
        courses = tuple(self.case.courses[0].like(seen, i) for i in range(len(runs)))
        return self.case._replace(seen=seen, courses=courses)

    def again(self, runs: Sequence[Run]) -> Begun:
        """The same model fitted to other runs, for a round."""
        case = self.on(runs)
        return self._replace(case=case, settled=case.search(self.settled.fit.model, case.guess))
