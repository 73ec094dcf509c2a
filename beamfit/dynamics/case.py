"""What is fitted to runs, and a search of it in rounds: residuals tell the noise of the next."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.dynamics.model import CLOSE, PreparedOutput, output_of, predicted
from beamfit.dynamics.noise import noise_of
from beamfit.greybox.fit import Fit
from beamfit.greybox.memory import Memory
from beamfit.greybox.problem import Free, Prior, Problem, Record
from beamfit.greybox.solve import solve
from beamfit.noise.correlated import Noise, innovations, remembers
from beamfit.status import Status

# Most rounds with a memory of the noise, and the gain in -2 ln L below which they end.
AGAIN, GAINED = 3, 0.05


class Case(NamedTuple):
    """A fit to be made: prepared outputs, runs, free numbers and priors.

    A course is a run as its model sees it: `model.Driven` or `shooting.Course`.
    """

    seen: tuple[PreparedOutput, ...]
    courses: tuple[Any, ...]
    free: tuple[Free, ...]
    priors: tuple[Prior, ...]

    @property
    def guess(self) -> np.ndarray:
        """The noise by run and output, before anything is known of it."""
        return np.array([[0.1 * s.size_y for s in self.seen]] * len(self.courses))

    @property
    def floor(self) -> np.ndarray:
        """Residual of each output below which the model explains it completely."""
        return np.array([CLOSE * s.size_y for s in self.seen])

    def measured(self, i: int) -> np.ndarray:
        """Readings of a run, one output after the other."""
        return np.concatenate([s.measured[i] for s in self.seen])

    def split(self, i: int, rows: np.ndarray) -> list[np.ndarray]:
        """Rows of the readings of a run, by output."""
        return np.split(rows, np.cumsum([len(s.measured[i]) for s in self.seen])[:-1])

    def rest(self, model: Any) -> tuple[tuple[np.ndarray, ...], ...]:
        """Residuals of a model, by run and output."""
        return tuple(
            tuple(self.split(i, self.measured(i) - np.asarray(output_of(model, course))))
            for i, course in enumerate(self.courses)
        )

    def rows(self, rest: Any) -> list[tuple[np.ndarray, np.ndarray, PreparedOutput]]:
        """Residuals, their times and the output, for each run and output."""
        pairs = ((i, zip(row, self.seen, strict=True)) for i, row in enumerate(rest))
        return [(r, s.time[i], s) for i, row in pairs for r, s in row]

    def squares(self, rest: Any) -> float:
        """Sum of squared residuals, in units of each output's scatter."""
        return sum(float(np.sum((r / s.size_y) ** 2)) for r, _, s in self.rows(rest))

    def problem(
        self, model: Any, noise: np.ndarray, memory: Noise | None = None, gap: Any = ()
    ) -> Problem:
        """State it; `gap` is how far ends of segments may lie apart, shape (states,).

        `noise` by run and output is a guess that the residuals correct, `memory` how it wanders.
        """
        records = []
        cuts = model["nodes"].shape[1] if len(gap) else 0
        for i, course in enumerate(self.courses):
            y, predict = self.measured(i), _with_gaps if cuts else predicted
            error = np.repeat(noise[i], [len(s.measured[i]) for s in self.seen])
            worth = np.inf if np.all(noise[i] <= 1.001 * self.floor) else 1.0
            if cuts:
                y = np.concatenate([y, np.zeros(cuts * len(gap))])
                error = np.concatenate([error, np.tile(gap, cuts)])
            if memory is not None:
                course = replace(course, noise=Noise(*map(jnp.asarray, memory)))
                y = np.asarray(innovations(jnp.asarray(y), course.time, course.noise)[0])
                predict = _surprising
            records.append(Record(f"run {i + 1}", predict, course, y, error, worth=worth))
        free = [*self.free, *([Free("nodes", nuisance=True)] if cuts else [])]
        return Problem(model, free, records, self.priors)

    def search(
        self, model: Any, noise: np.ndarray, steps: int, memory: Noise | None = None, gap: Any = ()
    ) -> Settled:
        """Fit with the noise that the residuals of the round before had."""
        fit = solve(self.problem(model, noise, memory, gap), iterations=steps)
        rest = self.rest(fit.model)
        found = np.maximum([[float(r.std()) for r in row] for row in rest], self.floor)
        minus = sum(_minus(r, t, s.size_y, None) for r, t, s in self.rows(rest))
        minus = minus if np.isfinite(found).all() else np.inf
        rests = fit.status not in (Status.not_finite, Status.not_converged)
        return Settled(fit, rest, found, memory, None, minus, rests)


class Settled(NamedTuple):
    """A fit whose noise is that of its own residuals.

    `rest` and `noise` by run and output; `memory` of a noise with one and `errors` that average
    over what is open of it; `likelihood` is -2 ln L, for responses with the cost of the Bayesian
    information criterion; `rests` whether a further round would gain nothing.
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
        free = self.fit.problem.moving
        return [free * self.fit.derive(predicted, course).slope for course in case.courses]

    def remembered(
        self, case: Case, noise: Noise | None = None, most: int | None = None
    ) -> tuple[Memory, Noise, float]:
        """The noise with a memory that the residuals have, of so many of them at most."""
        problem, size, rest = self.fit.problem, self.fit.problem.size, case.rows(self.rest)
        own = [part for i, s in enumerate(self.slopes(case)) for part in case.split(i, s)]
        parts = zip(own, rest, self.noise.ravel(), strict=True)
        rows = [np.column_stack([slope, -r])[:most] / s for slope, (r, _, _), s in parts]
        prior = np.asarray(problem.residual(self.fit.theta))[size:]
        known = np.column_stack([self.fit.dense_jacobian[size:], prior])
        return noise_of(rows, [time[:most] for _, time, _ in rest], known, noise)

    def correlated(self, case: Case) -> bool:
        """True if the noise of any output has a memory and exceeds rounding."""
        used = used_by(self.fit)
        return any(remembers(r, used) and r.std() > CLOSE * s.size_y
                   for r, _, s in case.rows(self.rest))  # fmt: skip


def used_by(fit: Fit) -> int:
    """Number of numbers that the readings determine."""
    return max(round(sum(group.count - group.dof for group in fit.groups)), 1)


def information(case: Case, found: Settled, noise: Noise | None) -> float:
    """The Bayesian information criterion of a fit under a noise with a memory, or without."""
    rows = case.rows(found.rest)
    cost = used_by(found.fit) * np.log(sum(len(rest) for rest, _, _ in rows))
    return float(cost + sum(_minus(r, t, s.size_y, noise) for r, t, s in rows))


def _minus(rest: np.ndarray, time: np.ndarray, size_y: float, noise: Noise | None) -> float:
    """-2 ln L of residuals, their size being their own."""
    white, volume = (rest, 0.0) if noise is None else innovations(rest, time, noise)
    size = max(float(np.std(white)), CLOSE * size_y)
    return 2.0 * (len(rest) * np.log(size) + float(volume))


def _with_gaps(model: Any, course: Any) -> jax.Array:
    return jnp.concatenate(course.shot(model))


def _surprising(model: Any, course: Any) -> jax.Array:
    """Innovations of a run: readings less their prediction from earlier ones."""
    return innovations(predicted(model, course), course.time, course.noise)[0]


def rounds(found: Any, again: Callable[[Any], Any], gained: float, most: int) -> tuple[Any, bool]:
    """Search again from what was found, until nothing is gained; and whether that came to be."""
    for _ in range(most):
        if not np.isfinite(found.likelihood):
            break
        before, found = found, again(found)
        if abs(before.likelihood - found.likelihood) < gained:
            return found, True
    return found, False


def settled(
    case: Case,
    models: Sequence[Any],
    search: Callable[..., Settled],
    gained: Callable[[Settled], float],
    most: int,
) -> Settled:
    """Search from each start for a round, then from the best until nothing is gained."""
    tried = (search(case, model, case.guess) for model in models)
    found = min(tried, key=lambda each: each.likelihood)
    found, rests = rounds(found, lambda f: search(case, f.fit.model, f.noise), gained(found), most)
    return found._replace(rests=rests or found.rests)


def with_memory(
    case: Case, white: Settled, search: Callable[..., Settled], most: int | None = None
) -> Settled:
    """The fit again, the noise of its residuals with a memory."""

    def again(found: Settled) -> Settled:
        _, memory, size = found.remembered(case, most=most)
        return search(case, found.fit.model, size * found.noise, memory=memory)

    return rounds(white, again, GAINED, AGAIN)[0]
