"""A response and its noise, fitted in turn: residuals tell the noise, the noise weighs them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from beamfit.dynamics.response import FIRST_ORDER, Physics
from beamfit.greybox.correlated import Memory
from beamfit.greybox.fit import Fit
from beamfit.greybox.solve import solve
from beamfit.status import Status
from beamfit.studies.response.limits import Limited
from beamfit.studies.response.model import CLOSE, Seen, output_of, predicted, state
from beamfit.studies.response.noise import Noise, innovations, noise_of, remembers
from beamfit.studies.response.record import Run
from beamfit.studies.response.starts import best_start, driven_by, start_of

# Steps of a round, after which the noise is taken from the residuals again; rounds at most, those
# with a memory of the noise, and the gain in -2 ln L below which nothing is gained any more.
STEPS, ROUNDS, AGAIN, GAINED = 100, 30, 3, 0.05


class Settled(NamedTuple):
    """A fit whose noise is that of its own residuals.

    `errors` average over what is open of a noise with a memory; `likelihood` is -2 ln L with the
    cost of the Bayesian information criterion, `rests` whether a further round would gain nothing.
    """

    fit: Fit
    residuals: tuple[np.ndarray, ...]
    noise: tuple[float, ...]
    memory: Noise | None
    errors: Memory | None
    likelihood: float
    rests: bool

    def start(self) -> tuple[Any, np.ndarray, tuple[float, bool]]:
        """Where a further search begins."""
        model = self.fit.model
        free = any(v.name == "offset" for v in self.fit.variables)
        return model["map"], np.asarray(model["start"]), (float(model["offset"]), free)

    def remembered(self, seen: Seen) -> tuple[Memory, Noise, float]:
        """The noise with a memory that the residuals have."""
        fit, size = self.fit, self.fit.problem.size
        parts = zip(seen.runs, self.residuals, self.noise, strict=True)
        rows = [np.column_stack([fit.derive(predicted, run).slope, -r]) / s for run, r, s in parts]
        prior = np.asarray(fit.problem.residual(fit.theta))[size:]
        return noise_of(rows, seen.time, np.column_stack([fit.jacobian[size:], prior]))


def _round(
    seen: Seen,
    begin: tuple,
    noise: Sequence[float],
    memory: Noise | None = None,
    told: Limited | None = None,
) -> Settled:
    """Fit with the noise that the residuals of the round before had."""
    fit = solve(state(seen, *begin, noise, memory, told), iterations=STEPS)
    pairs = zip(seen.runs, seen.measured, strict=True)
    rest = tuple(y - np.asarray(output_of(fit.model, run)) for run, y in pairs)
    found = tuple(max(float(r.std()), CLOSE * seen.size_y) for r in rest)
    minus = used_by(fit) * np.log(sum(map(len, rest)))
    for r, t in zip(rest, seen.time, strict=True):
        white, volume = (r, 0.0) if memory is None else innovations(r, t, memory)
        size = max(float(np.std(white)), CLOSE * seen.size_y)
        minus += 2.0 * (len(r) * np.log(size) + float(volume))
    rests = fit.status not in (Status.not_finite, Status.not_converged)
    return Settled(fit, rest, found, memory, None, float(minus), rests)


def rounds(found: Any, again: Callable[[Any], Any], gained: float, most: int) -> tuple[Any, bool]:
    """Search again from what was found, until nothing is gained; and whether that came to be."""
    for _ in range(most):
        if not np.isfinite(found.likelihood):
            break
        before, found = found, again(found)
        if abs(before.likelihood - found.likelihood) < gained:
            return found, True
    return found, False


def settled(seen: Seen, begins: Sequence[tuple]) -> Settled:
    """Search from each start for a round, then from the best until nothing is gained.

    The noise weighs against the priors of a network, so it is taken anew in every round.
    """
    wide = [0.1 * seen.size_y] * len(seen.runs)
    tried = (_round(seen, begin, wide) for begin in begins)
    found = min(tried, key=lambda each: each.likelihood)
    gained = GAINED + 1e-9 * abs(found.likelihood)
    found, rests = rounds(found, lambda f: _round(seen, f.start(), f.noise), gained, ROUNDS)
    rests |= found.rests
    if not any(remembers(r, used_by(found.fit)) and r.std() > CLOSE * seen.size_y
               for r in found.residuals):  # fmt: skip
        return found._replace(rests=rests)

    def again(found):
        _, memory, size = found.remembered(seen)
        return _round(seen, found.start(), size * np.array(found.noise), memory)

    found, _ = rounds(found, again, GAINED, AGAIN)
    return found._replace(rests=rests, errors=found.remembered(seen)[0])


class Begun(NamedTuple):
    """Runs as the model sees them, the delay, and the fit with constant parameters."""

    seen: Seen
    delay: float
    plain: Settled


def begun(
    runs: tuple[Run, ...], output: str, physics: Physics, delay: float | None, offset: bool
) -> Begun:
    """Identify with constant parameters; the delay among candidates if None."""
    start, seen, delay = start_of(runs, output, physics, delay, offset)
    return Begun(seen, delay, settled(seen, [start.begin(offset)]))


def is_first_order(found: Begun, offset: bool) -> bool:
    """Whether a first order does as well as a higher one, by the Bayesian information criterion."""
    if found.seen.runs[0].physics is FIRST_ORDER:
        return False
    lower = found.seen._replace(runs=driven_by(found.seen, FIRST_ORDER))
    begin = best_start(lower, offset).begin(offset)
    return settled(lower, [begin]).likelihood <= found.plain.likelihood


def within(seen: Seen, found: Settled, told: Limited) -> Settled:
    """A fit brought within limits; as it is where it keeps them."""
    problem = state(seen, *found.start(), found.noise, found.memory, told)
    values = np.asarray(problem.constraint_values(problem.start))
    kept = (values >= problem.constraint_lower) & (values <= problem.constraint_upper)
    kept = np.append(kept, (problem.start >= problem.lower) & (problem.start <= problem.upper))
    if kept.all():
        return found
    errors = found.errors
    found, _ = rounds(
        found, lambda f: _round(seen, f.start(), f.noise, f.memory, told), GAINED, AGAIN
    )
    return found._replace(errors=errors)


def used_by(fit: Fit) -> int:
    """How many numbers the readings determined."""
    return max(round(sum(group.count - group.dof for group in fit.groups)), 1)
