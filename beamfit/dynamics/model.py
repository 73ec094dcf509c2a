"""A response as a problem: runs, a map from the operating point to its parameters, its physics."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.arrays import padded_length
from beamfit.dynamics.response import Physics, even_response, response_at
from beamfit.greybox import tree
from beamfit.greybox.mlp import MLP, Port, dense
from beamfit.greybox.problem import Prior

# Residual, as a share of the output's scatter, below which a fit counts as exact.
CLOSE = 2e-4
# Standard deviation of the prior on a network's weights; inputs and outputs are of size 1.
WEIGHT = 3.0


@tree.node("physics", "turn")
class Driven:
    """A run as the model sees it: inputs, whole rows late, and steps; when and where it was read.

    Shapes (rows, inputs), (rows,), (readings,), (readings,), all padded: there are `count`
    readings. `run` is its number, `part` the part of a row by which inputs come later still. `turn`
    is the number of rows a sample where all steps are equal, 0 where they are not.
    """

    physics: Physics
    u: Any
    dt: Any
    time: Any
    index: Any
    count: Any
    run: Any
    part: Any
    turn: int = 0

    @property
    def read(self) -> np.ndarray:
        """Rows where the output was read."""
        return np.asarray(self.index)[: self.count]

    @staticmethod
    def like(seen: Sequence[PreparedOutput], i: int) -> Driven:
        """A run of an output that was prepared."""
        return seen[0].runs[i]

    def predicted(self, model: Any) -> jax.Array:
        """The output where it was read, running free from the start of the run."""
        of, start, part = model["map"], model["start"][self.run], self.part + model["late"]
        if callable(of):
            return model["offset"] + self.changing(
                parameters_at(self.physics, of, self.u), start, part
            )
        p = self.physics.physical(of, self.u.shape[1])
        return model["offset"] + self.constant(p, start, part)

    def changing(self, p: jax.Array, start: jax.Array, part: Any) -> jax.Array:
        """The response of parameters at every row where it was read, without an offset."""
        return response_at(self.physics, p, self.u, self.dt, start, self.index, part)

    def constant(self, p: jax.Array, start: jax.Array, part: Any) -> jax.Array:
        """The response of constant parameters where it was read, without an offset."""
        if self.turn:
            y = even_response(self.physics, p, self.u, self.dt[0], start, self.turn, part)
            return y[self.index // self.turn]
        return self.changing(jnp.broadcast_to(p, (len(self.u), len(p))), start, part)


class PreparedOutput(NamedTuple):
    """Runs of one output, with what the model needs of them.

    `runs` by `Driven`; `measured` are the readings of each, without missing ones; `wide` and
    `size_y` the scatter of inputs (1 where one does not change) and output; `delay` in rows, of
    which there are `parts` a sample; `ends` between which a delay that is a number of the fit may
    be longer.
    """

    inputs: tuple[str, ...]
    output: str
    runs: tuple[Driven, ...]
    measured: tuple[np.ndarray, ...]
    time: tuple[np.ndarray, ...]
    mean_u: np.ndarray
    wide: np.ndarray
    size_y: float
    delay: float
    parts: int
    ends: tuple[float, float] | None

    @property
    def points(self) -> np.ndarray:
        """The inputs at all readings, shape (readings, inputs)."""
        return np.concatenate([np.asarray(run.u)[run.read] for run in self.runs])

    @property
    def apart(self) -> float:
        """Median time between readings, of the run where it is shortest."""
        return min(float(np.median(np.diff(t))) for t in self.time)

    @property
    def span(self) -> float:
        """Length of the longest run."""
        return max(float(np.ptp(t)) for t in self.time)

    def scaled(self, u: Any) -> np.ndarray:
        """Inputs in units of their scatter."""
        return (np.asarray(u) - self.mean_u) / self.wide


def parameters_at(physics: Physics, of: Any, point: jax.Array, more: Any = 0.0) -> jax.Array:
    """Parameters p at operating points, shape (points, parameters); `of` a map, or raw numbers.

    `more` is added to the raw numbers.
    """
    m = point.shape[1]
    raw = jax.vmap(of)(point) if callable(of) else jnp.broadcast_to(of, (len(point), len(of)))
    return jax.vmap(lambda q: physics.physical(q, m))(raw + more)


def predicted(model: Any, course: Any) -> jax.Array:
    """Readings of a run that a model predicts; the course is a `Driven` or another."""
    return course.predicted(model)


def readings_of(time: np.ndarray, index: np.ndarray) -> tuple[jax.Array, jax.Array]:
    """When and where readings were taken, padded: a noise goes on to the end."""
    more = (0, padded_length(len(time)) - len(time))
    time = np.pad(time, more, "linear_ramp", end_values=2 * time[-1])
    return jnp.asarray(time), jnp.asarray(np.pad(index, more, "edge"))


def filled(course: Any, values: np.ndarray, by: float = 0.0) -> np.ndarray:
    """Values of the readings, along the last axis, as many as the course has with its padding."""
    more = len(course.index) - values.shape[-1]
    return np.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, more)], constant_values=by)


_predicted = jax.jit(predicted)


def output_of(model: Any, course: Any) -> np.ndarray:
    """Those that were taken."""
    return np.asarray(_predicted(model, course))[: course.count]


@jax.jit
def changed_by(model: Any, seen: Driven, scaled: jax.Array) -> jax.Array:
    """Slopes of the output by parameters that change with the operating point.

    The raw numbers get S s more, where s holds the scaled inputs and their squares, shape
    (samples, 2 m); the slopes are by S at 0, shape (readings, parameters * 2 m).
    """
    start = model["start"][seen.run]
    count = parameters_at(seen.physics, model["map"], seen.u[:1]).shape[1]

    def output(more):
        p = parameters_at(seen.physics, model["map"], seen.u, scaled @ more.T)
        return seen.changing(p, start, seen.part + model["late"])

    slopes = jax.jacfwd(output)(jnp.zeros((count, scaled.shape[1])))
    return slopes.reshape(len(slopes), -1)


def growing_of(fitted: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Changes of an output whose delay grows by a sample along the record, and whose gain does by
    itself, as columns.
    """
    through = (time - time[0]) / (time[-1] - time[0]) - 0.5
    late = -through * np.diff(fitted, prepend=fitted[0])
    return np.stack([late, through * (fitted - fitted.mean())], axis=1)


def curves(model: Any, asked: tuple[Driven, Any]) -> jax.Array:
    """Parameters at operating points, shape (points, parameters)."""
    seen, point = asked
    return parameters_at(seen.physics, model["map"], point)


def weight_priors(path: str) -> tuple[Prior, ...]:
    """Priors on the numbers of a network."""
    return tuple(Prior(f"{path}.{part}", 0.0, WEIGHT) for part in ("weights", "biases"))


def network_of(
    seen: PreparedOutput, physics: Physics, raw: np.ndarray, hidden: int, seed: int
) -> MLP:
    """A network that gives constant raw numbers everywhere but for small random weights."""
    m, wide = len(seen.inputs), seen.wide
    ports = [Port(n, "", 0, float(s), float(b))
             for n, s, b in zip(seen.inputs, wide, seen.mean_u, strict=True)]  # fmt: skip
    gain = seen.size_y / float(np.min(wide))
    sizes = [gain if power else 1.0 for _, power in physics.units(m)]
    names = physics.parameters(seen.inputs)
    outputs = [Port(n, "", 0, s, float(b)) for n, s, b in zip(names, sizes, raw, strict=True)]
    return dense(ports, outputs, [hidden], seed=seed, spread=0.3)
