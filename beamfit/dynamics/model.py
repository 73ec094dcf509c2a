"""Model of a response: prepared runs, the map from operating point to parameters, the physics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.arrays import padded_length
from beamfit.dynamics.response import Physics, even_response, response_at
from beamfit.greybox import tree
from beamfit.greybox.mlp import MLP, Port, dense
from beamfit.greybox.problem import Prior

# A fit counts as exact if its residuals are below this share of the output's scatter: rounding, or
# the detail of a network.
EXACT_TOLERANCE = 2e-4
# Standard deviation of the normal prior on a network's weights, whose inputs and outputs have unit
# size.
WEIGHT_PRIOR = 3.0


@tree.node("physics", "even_rows")
class DrivenRun:
    """A run as the model sees it: its delayed inputs, its time steps, and its readings.

    `u` (rows, inputs) and `dt` (rows,) are the inputs and steps; `time` and `index` (readings,) are
    the times and rows of the readings. All are padded: `count` readings are real. `run` is the
    number of the run, `delay_fraction` the fraction of a row by which inputs come later still.
    `even_rows` is the number of rows per sample if all steps are equal, else 0.
    """

    physics: Physics
    u: Any
    dt: Any
    time: Any
    index: Any
    count: Any
    run: Any
    delay_fraction: Any
    even_rows: int = 0

    @property
    def read(self) -> np.ndarray:
        """Rows of the readings."""
        return np.asarray(self.index)[: self.count]

    def up_to(self, reading: int) -> DrivenRun:
        """Leave out rows after a reading, if the steps are equal."""
        if self.count <= reading or not self.even_rows:
            return self
        rows = int(self.index[reading - 1]) + self.even_rows
        return replace(
            self, u=self.u[:rows], dt=self.dt[:rows],
            time=self.time[:reading], index=self.index[:reading], count=reading,
        )  # fmt: skip

    @staticmethod
    def like(prepared: Sequence[PreparedOutput], i: int) -> DrivenRun:
        """Give run i of the prepared outputs."""
        return prepared[0].runs[i]

    def predicted(self, model: Any) -> jax.Array:
        """Predict the readings, running free from the start of the run."""
        raw, start = model["map"], model["start"][self.run]
        fraction = self.delay_fraction + model["late"]
        if callable(raw):
            p = parameters_at(self.physics, raw, self.u)
            return model["offset"] + self.varying_response(p, start, fraction)
        p = self.physics.physical(raw)
        return model["offset"] + self.constant_response(p, start, fraction)

    def varying_response(self, p: jax.Array, start: jax.Array, fraction: Any) -> jax.Array:
        """Response at the readings, without an offset, of parameters given for every row."""
        return response_at(self.physics, p, self.u, self.dt, start, self.index, fraction)

    def constant_response(self, p: jax.Array, start: jax.Array, fraction: Any) -> jax.Array:
        """Response at the readings, without an offset, of constant parameters."""
        if self.even_rows:
            y = even_response(self.physics, p, self.u, self.dt[0], start, self.even_rows, fraction)
            return y[self.index // self.even_rows]
        return self.varying_response(jnp.broadcast_to(p, (len(self.u), len(p))), start, fraction)


class PreparedOutput(NamedTuple):
    """Runs of one output, with what the model needs of them.

    `runs` are `DrivenRun`; `measured` and `time` are the readings of each, missing ones left out;
    `input_scale` and `output_scale` the scatter of inputs (1 for one that is constant) and output;
    `delay` is in rows, of which there are `rows_per_sample`; `fraction_limits` bound the fitted
    fraction of a row in the delay, None if it is not fitted.
    """

    inputs: tuple[str, ...]
    output: str
    runs: tuple[DrivenRun, ...]
    measured: tuple[np.ndarray, ...]
    time: tuple[np.ndarray, ...]
    mean_u: np.ndarray
    input_scale: np.ndarray
    output_scale: float
    delay: float
    rows_per_sample: int
    fraction_limits: tuple[float, float] | None

    @property
    def points(self) -> np.ndarray:
        """Inputs at all readings, shape (readings, inputs)."""
        return np.concatenate([np.asarray(run.u)[run.read] for run in self.runs])

    @property
    def floor(self) -> float:
        """Error of a reading below which a fit counts as exact."""
        return EXACT_TOLERANCE * self.output_scale

    @property
    def interval(self) -> float:
        """Shortest median time between readings of any run, s."""
        return min(float(np.median(np.diff(t))) for t in self.time)

    @property
    def duration(self) -> float:
        """Length of the longest run, s."""
        return max(float(np.ptp(t)) for t in self.time)

    def scaled(self, u: Any) -> np.ndarray:
        """Express inputs in units of their scatter about their means."""
        return (np.asarray(u) - self.mean_u) / self.input_scale


def parameters_at(physics: Physics, raw: Any, point: jax.Array, added: Any = 0.0) -> jax.Array:
    """Parameters p at operating points, shape (points, parameters).

    `raw` is a map of the operating point or constant raw numbers; `added` is added to the raw
    numbers.
    """
    q = jax.vmap(raw)(point) if callable(raw) else jnp.broadcast_to(raw, (len(point), len(raw)))
    return jax.vmap(physics.physical)(q + added)


@jax.jit
def predicted(model: Any, course: Any) -> jax.Array:
    """Predict the readings of a course: a `DrivenRun` or a `state_fit.Course`."""
    return course.predicted(model)


def padded_readings(time: np.ndarray, index: np.ndarray) -> tuple[jax.Array, jax.Array]:
    """Pad times and rows of readings; padded times go on, as correlated noise needs."""
    padding = (0, padded_length(len(time)) - len(time))
    time = np.pad(time, padding, "linear_ramp", end_values=2 * time[-1])
    return jnp.asarray(time), jnp.asarray(np.pad(index, padding, "edge"))


def pad_readings(course: Any, values: np.ndarray, by: float = 0.0) -> np.ndarray:
    """Pad values of the readings, along the last axis, to the length of the course."""
    missing = len(course.index) - values.shape[-1]
    padding = [(0, 0)] * (values.ndim - 1) + [(0, missing)]
    return np.pad(values, padding, constant_values=by)


def predict_readings(model: Any, course: Any) -> np.ndarray:
    """Predict the readings of a course, without padding."""
    return np.asarray(predicted(model, course))[: course.count]


@jax.jit
def operating_point_slopes(model: Any, run: DrivenRun, scaled: jax.Array) -> jax.Array:
    """Derivatives of the output by parameters that change with the operating point.

    S s is added to the raw numbers, where s holds the scaled inputs and their squares, shape
    (samples, 2 m). The derivatives are by S at 0, shape (readings, parameters * 2 m).
    """
    start = model["start"][run.run]
    count = parameters_at(run.physics, model["map"], run.u[:1]).shape[1]

    def output(added):
        p = parameters_at(run.physics, model["map"], run.u, scaled @ added.T)
        return run.varying_response(p, start, run.delay_fraction + model["late"])

    slopes = jax.jacfwd(output)(jnp.zeros((count, scaled.shape[1])))
    return slopes.reshape(len(slopes), -1)


def growth_columns(fitted: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Changes of an output whose delay, or whose gain, grows along the record, as columns.

    The delay grows by one sample, the gain by its own mean; both keep their means. Shape (readings,
    2).
    """
    through = (time - time[0]) / (time[-1] - time[0]) - 0.5
    delayed = -through * np.diff(fitted, prepend=fitted[0])
    return np.stack([delayed, through * (fitted - fitted.mean())], axis=1)


def curve_values(model: Any, data: tuple[DrivenRun, Any]) -> jax.Array:
    """Parameters at operating points, shape (points, parameters)."""
    run, point = data
    return parameters_at(run.physics, model["map"], point)


def weight_priors(path: str) -> tuple[Prior, ...]:
    """Priors on the weights and biases of a network."""
    return tuple(Prior(f"{path}.{part}", 0.0, WEIGHT_PRIOR) for part in ("weights", "biases"))


def network_of(
    prepared: PreparedOutput, physics: Physics, raw: np.ndarray, hidden: int, seed: int
) -> MLP:
    """Make a network that gives constant raw numbers, up to small random weights."""
    m, scale = len(prepared.inputs), prepared.input_scale
    ports = [Port(n, "", 0, float(s), float(b))
             for n, s, b in zip(prepared.inputs, scale, prepared.mean_u, strict=True)]  # fmt: skip
    gain = prepared.output_scale / float(np.min(scale))
    sizes = [gain if power else 1.0 for _, power in physics.units(m)]
    names = physics.parameters(prepared.inputs)
    outputs = [Port(n, "", 0, s, float(b)) for n, s, b in zip(names, sizes, raw, strict=True)]
    return dense(ports, outputs, [hidden], seed=seed, spread=0.3)
