"""State spaces as a problem: runs in segments whose ends must meet, or running free as one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.greybox import tree
from beamfit.greybox.correlated import Memory
from beamfit.greybox.fit import Fit
from beamfit.greybox.problem import Free, Prior, Problem, Record
from beamfit.greybox.solve import solve
from beamfit.status import Status
from beamfit.studies.response.model import CLOSE, Seen
from beamfit.studies.response.noise import Noise, innovations, noise_of, remembers
from beamfit.studies.response.settle import rounds, used_by

# Steps of a round, after which the noise is taken from the residuals again; rounds at most, those
# with a memory of the noise, and the gain in -2 ln L, of a reading and in all, below which nothing
# is gained any more.
STEPS, ROUNDS, AGAIN, EACH, GAINED = 25, 80, 3, 1e-4, 0.05
# Gaps between segments, in units of the states' scatter, through which they are closed.
CLOSING = (1.0, 0.1, 1e-2, 1e-3, 1e-4)
# Time from the last reading of an output to the first of another, in lengths of the run.
APART = 1e6
# Readings of each output that tell the noise with a memory; the share by which it may leave more of
# the outputs than a fit without.
LONGEST, WORSE = 5000, 1.5


class System(Protocol):
    """What runs: `beamfit.dynamics.states.StateSpace`, or anything hashable with its `run`."""

    def run(
        self, p: Any, u: jax.Array, dt: jax.Array, x0: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Outputs at the samples and the state after the last."""


@tree.node("system")
class Course:
    """A run as the model sees it: inputs and steps, padded, and which outputs were read.

    Shapes (samples, m), (samples,); `index` (readings,) points into all outputs one after the
    other, `time` is theirs, s, far apart from output to output; `run` is its number, `noise` that
    of its readings, if it has a memory.
    """

    system: System
    u: Any
    dt: Any
    index: Any
    time: Any
    run: Any
    noise: Noise | None


class Case(NamedTuple):
    """What is to be fitted: each output as seen, each run, its readings, and what is free."""

    seen: tuple[Seen, ...]
    courses: tuple[Course, ...]
    free: tuple[Free, ...]
    priors: tuple[Prior, ...]

    def measured(self, i: int) -> np.ndarray:
        """Readings of a run, one output after the other."""
        return np.concatenate([s.measured[i] for s in self.seen])

    def split(self, i: int, rows: np.ndarray) -> list[np.ndarray]:
        """Rows of the readings of a run, by output."""
        return np.split(rows, np.cumsum([len(s.measured[i]) for s in self.seen])[:-1])


class Trained(NamedTuple):
    """A fit whose noise is that of its own residuals.

    `rest` and `noise` by run and output; `memory` and `errors` of a noise with one; `likelihood` is
    -2 ln L, `rests` whether a further round would gain nothing.
    """

    fit: Fit
    rest: tuple[tuple[np.ndarray, ...], ...]
    noise: np.ndarray
    memory: Noise | None
    errors: Memory | None
    likelihood: float
    rests: bool

    def slopes(self, case: Case) -> list[np.ndarray]:
        """Slopes of each run's outputs by the free numbers; 0 by those that are held."""
        free = self.fit.problem.lower < self.fit.problem.upper
        return [free * self.fit.derive(predicted, course).slope for course in case.courses]

    def remembered(self, case: Case, noise: Noise | None = None) -> tuple[Memory, Noise, float]:
        """The noise with a memory that the residuals have, one of all outputs."""
        problem, part = self.fit.problem, LONGEST if noise is None else None
        size = problem.size
        rows, time = [], []
        for i, slope in enumerate(self.slopes(case)):
            for k, own in enumerate(case.split(i, slope)):
                each = np.column_stack([own, -self.rest[i][k]]) / self.noise[i, k]
                rows.append(each[:part])
                time.append(case.seen[k].time[i][:part])
        prior = np.asarray(problem.residual(self.fit.theta))[size:]
        known = np.column_stack([self.fit.jacobian[size:], prior])
        return noise_of(rows, time, known, noise)


def course_of(system: System, seen: Sequence[Seen], i: int) -> Course:
    """One run, of what is seen of each output."""
    run = seen[0].runs[i]
    index = [k * len(run.u) + np.asarray(s.runs[i].index) for k, s in enumerate(seen)]
    far = APART * float(np.sum(np.asarray(run.dt)))
    time = [far * k + np.asarray(s.runs[i].time) for k, s in enumerate(seen)]
    index, time = (jnp.asarray(np.concatenate(part)) for part in (index, time))
    return Course(system, run.u, run.dt, index, time, run.run, None)


def _shot(model: Any, course: Course) -> tuple[jax.Array, jax.Array]:
    """Outputs from every segment's own start, and the gaps where segments meet."""
    nodes = model["nodes"][course.run]
    starts = jnp.concatenate([model["start"][course.run][None], nodes])
    parts = [v.reshape(len(starts), -1, *v.shape[1:]) for v in (course.u, course.dt)]
    y, last = jax.vmap(course.system.run, (None, 0, 0, 0))(model["p"], *parts, starts)
    y = y.reshape(len(course.u), -1)
    return y.T.ravel()[course.index], (last[:-1] - nodes).ravel()


def predicted(model: Any, course: Course) -> jax.Array:
    """Outputs where they were read, one after the other, shape (readings,)."""
    return _shot(model, course)[0]


def _with_gaps(model: Any, course: Course) -> jax.Array:
    return jnp.concatenate(_shot(model, course))


def _surprising(model: Any, course: Course) -> jax.Array:
    """What the outputs add to what the readings before foretell."""
    return innovations(predicted(model, course), course.time, course.noise)[0]


output_of = jax.jit(predicted)


def rest_of(case: Case, model: Any) -> tuple[tuple[np.ndarray, ...], ...]:
    """What is left of the readings, by run and output."""
    return tuple(
        tuple(case.split(i, case.measured(i) - np.asarray(output_of(model, course))))
        for i, course in enumerate(case.courses)
    )


def _problem(
    case: Case, model: Any, noise: np.ndarray, memory: Noise | None, gap: np.ndarray
) -> Problem:
    """State it; `gap` is how far ends of segments may lie apart, shape (n,)."""
    records, cuts = [], model["nodes"].shape[1]
    for i, course in enumerate(case.courses):
        y = case.measured(i)
        error = np.concatenate([np.full(len(s.measured[i]), noise[i, k])
                                for k, s in enumerate(case.seen)])  # fmt: skip
        close = all(noise[i, k] <= CLOSE * s.size_y * 1.001 for k, s in enumerate(case.seen))
        worth, predict = np.inf if close else 1.0, _with_gaps if cuts else predicted
        if cuts:
            y = np.concatenate([y, np.zeros(cuts * len(gap))])
            error = np.concatenate([error, np.tile(gap, cuts)])
        if memory is not None:
            course, predict = replace(course, noise=Noise(*map(jnp.asarray, memory))), _surprising
            y = np.asarray(innovations(jnp.asarray(y), course.time, course.noise)[0])
        records.append(Record(f"run {i + 1}", predict, course, y, error, worth=worth))
    free = [*case.free, *([Free("nodes", nuisance=True)] if cuts else [])]
    return Problem(model, free, records, case.priors)


def _round(
    case: Case, model: Any, noise: np.ndarray, memory: Noise | None = None, gap: Any = ()
) -> Trained:
    """Fit with the noise that the residuals of the round before had."""
    fit = solve(_problem(case, model, noise, memory, np.asarray(gap)), iterations=STEPS)
    rest = rest_of(case, fit.model)
    floor = [CLOSE * s.size_y for s in case.seen]
    found = np.array([[max(float(r.std()), f) for r, f in zip(row, floor, strict=True)]
                      for row in rest])  # fmt: skip
    minus = sum(2.0 * len(r) * np.log(s) for row, sizes in zip(rest, found, strict=True)
                for r, s in zip(row, sizes, strict=True))  # fmt: skip
    rests = fit.status not in (Status.not_finite, Status.not_converged)
    minus = float(minus) if np.isfinite(found).all() else np.inf
    return Trained(fit, rest, found, memory, None, minus, rests)


def closed(case: Case, model: Any, close: np.ndarray) -> Any:
    """The model from where the free run may begin: ends of segments have met.

    `close` (n,) is the states' scatter. H. Bock, multiple shooting, 1983.
    """
    noise = _wide(case)
    for width in CLOSING:
        shot = _round(case, model, noise, gap=width * close)
        if not np.isfinite(shot.likelihood):
            break
        model, noise = shot.fit.model, shot.noise
    return model | {"nodes": model["nodes"][:, :0]}


def _wide(case: Case) -> np.ndarray:
    return np.array([[0.1 * s.size_y for s in case.seen]] * len(case.courses))


def trained(case: Case, models: Sequence[Any]) -> Trained:
    """Fit from each start for a round, then from the best until nothing is gained."""
    found = min((_round(case, m, _wide(case)) for m in models), key=lambda each: each.likelihood)
    enough = GAINED + EACH * sum(len(r) for row in found.rest for r in row)
    found, rests = rounds(found, lambda f: _round(case, f.fit.model, f.noise), enough, ROUNDS)
    return found._replace(rests=rests or found.rests)


def begun(case: Case, model: Any, noise: np.ndarray) -> Any:
    """The model with what is free fitted once: the first states of runs that were held back."""
    return solve(_problem(case, model, noise, None, np.zeros(0))).model


def _squares(case: Case, found: Trained) -> float:
    """What is left of the outputs, in units of their scatter."""
    return sum(float(np.sum((r / s.size_y) ** 2)) for row in found.rest
               for r, s in zip(row, case.seen, strict=True))  # fmt: skip


def remembering(case: Case, white: Trained) -> Trained:
    """The fit again, its noise with a memory, where residuals are correlated."""
    rows = [(r, s) for row in white.rest for r, s in zip(row, case.seen, strict=True)]
    used = used_by(white.fit)
    if not any(remembers(r, used) and r.std() > CLOSE * s.size_y for r, s in rows):
        return white

    def again(found):
        _, memory, size = found.remembered(case)
        return _round(case, found.fit.model, size * found.noise, memory)

    found, _ = rounds(white, again, GAINED, AGAIN)
    if _squares(case, found) > WORSE * _squares(case, white):
        # What the model lacks was taken for noise that wanders, and the response with it.
        found = white
    errors = found.remembered(case)[0]
    if found is not white and max(len(r) for r, _ in rows) > LONGEST:
        errors = found.remembered(case, found.memory)[0]
    return found._replace(rests=white.rests, errors=errors)
