"""State spaces as a problem: runs in segments whose ends must meet, or running free as one."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.dynamics.case import (
    GAINED,
    Case,
    Settled,
    settled,
    with_memory,
)
from beamfit.dynamics.model import PreparedOutput
from beamfit.dynamics.noise import Noise
from beamfit.greybox import tree
from beamfit.greybox.solve import solve

# Steps of a round, after which the noise is estimated again; most rounds; gain in -2 ln L per
# reading below which they end.
STEPS, ROUNDS, EACH = 25, 80, 1e-4
# Allowed gaps between segments in turn, in units of the states' scatter.
CLOSING = (1.0, 0.1, 1e-2, 1e-3, 1e-4)
# Distance in time between the series of two outputs, in lengths of the run: no correlation is left.
APART = 1e6
# Most readings of each output that estimate correlated noise; factor by which the fit with it may
# leave larger squares than the fit without.
LONGEST, WORSE = 5000, 1.5


class System(Protocol):
    """A system: `beamfit.dynamics.states.StateSpace`, or anything hashable with its `run`."""

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

    def shot(self, model: Any) -> tuple[jax.Array, jax.Array]:
        """Outputs from every segment's own start, and the gaps where segments meet."""
        nodes = model["nodes"][self.run]
        starts = jnp.concatenate([model["start"][self.run][None], nodes])
        parts = [v.reshape(len(starts), -1, *v.shape[1:]) for v in (self.u, self.dt)]
        y, last = jax.vmap(self.system.run, (None, 0, 0, 0))(model["p"], *parts, starts)
        y = y.reshape(len(self.u), -1)
        return y.T.ravel()[self.index], (last[:-1] - nodes).ravel()

    def predicted(self, model: Any) -> jax.Array:
        """Outputs where they were read, one after the other, shape (readings,)."""
        return self.shot(model)[0]


def course_of(system: System, seen: Sequence[PreparedOutput], i: int) -> Course:
    """Course of a run, from the prepared outputs."""
    run = seen[0].runs[i]
    index = [k * len(run.u) + np.asarray(s.runs[i].index) for k, s in enumerate(seen)]
    far = APART * float(np.sum(np.asarray(run.dt)))
    time = [far * k + np.asarray(s.runs[i].time) for k, s in enumerate(seen)]
    index, time = (jnp.asarray(np.concatenate(part)) for part in (index, time))
    return Course(system, run.u, run.dt, index, time, run.run, None)


_round = partial(Case.search, steps=STEPS)


def closed(case: Case, model: Any, close: np.ndarray) -> Any:
    """The model from where the free run may begin: ends of segments have met.

    `close` (n,) is the states' scatter. H. Bock, multiple shooting, 1983.
    """
    noise = case.guess
    for width in CLOSING:
        shot = _round(case, model, noise, gap=width * close)
        if not np.isfinite(shot.likelihood):
            break
        model, noise = shot.fit.model, shot.noise
    return model | {"nodes": model["nodes"][:, :0]}


def trained(case: Case, models: Sequence[Any]) -> Settled:
    """Fit from each start for a round, then from the best until nothing is gained."""
    enough = GAINED + EACH * sum(len(each) for s in case.seen for each in s.measured)
    return settled(case, models, _round, lambda found: enough, ROUNDS)


def begun(case: Case, model: Any, noise: np.ndarray) -> Any:
    """The model with what is free fitted once: the first states of runs that were held back."""
    return solve(case.problem(model, noise)).model


def remembering(case: Case, white: Settled) -> Settled:
    """The fit again, its noise with a memory, where residuals are correlated."""
    if not white.correlated(case):
        return white
    found = with_memory(case, white, _round, LONGEST)
    if case.squares(found.rest) > WORSE * case.squares(white.rest):
        # What the model lacks was taken for noise that wanders, and the response with it.
        found = white
    errors = found.remembered(case, most=LONGEST)[0]
    if found is not white and max(len(r) for row in found.rest for r in row) > LONGEST:
        errors = found.remembered(case, found.memory)[0]
    return found._replace(rests=white.rests, errors=errors)
