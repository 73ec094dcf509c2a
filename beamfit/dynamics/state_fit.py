"""Fit of a state space whose equations the user writes.

Runs are fitted free from their start, or in segments whose ends must meet (multiple shooting).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.answer import Table, answer, json_of
from beamfit.dynamics.answer import (
    ResponseEvidence,
    add_remarks,
    judge_outputs,
    limit_words,
    quantity_at,
    remove_errors_if_wrong,
    widen_errors,
)
from beamfit.dynamics.bad_readings import BadReadings, answer_without_bad_readings
from beamfit.dynamics.checks import (
    Checks,
    HeldOutRun,
    checks_of,
    digit_covariance,
    explained_percent,
    predict_runs,
)
from beamfit.dynamics.model import PreparedOutput, growth_columns, padded_readings, weight_priors
from beamfit.dynamics.paths import DIRECT_PATH, Path, max_delay, prepare_output
from beamfit.dynamics.record import Run, check_runs
from beamfit.dynamics.response import FIRST_ORDER
from beamfit.dynamics.search import (
    MAX_DRIFT_DEGREE,
    Case,
    RunsFit,
    drift_columns,
    effective_parameters,
    fit_correlated_noise,
    fit_in_rounds,
)
from beamfit.dynamics.states import StateSpace
from beamfit.errors import InputError, Status
from beamfit.greybox import tree
from beamfit.greybox.fit import Derived, Fit
from beamfit.greybox.mlp import MLP
from beamfit.greybox.problem import Free, Prior
from beamfit.noise.memory import CorrelatedNoise
from beamfit.quantity import Quantity
from beamfit.statistics import POOR_FIT

# Allowed gaps between segments, one after the other, in units of the states' scatter.
GAP_WIDTHS = (1.0, 0.1, 1e-2, 1e-3, 1e-4)
# Time between the series of two outputs, in lengths of the run: no correlation is left.
OUTPUT_SEPARATION = 1e6
# A fit with correlated noise is dropped if its sum of squares exceeds that of the white-noise fit
# by this factor: chosen.
MAX_SQUARES_RATIO = 1.5


@tree.node("system")
class Course:
    """A run as the model sees it: inputs, steps, and the outputs that were read, all padded.

    `system` is a `beamfit.dynamics.states.StateSpace` or anything hashable with its `run`. `u` and
    `dt` have shapes (samples, m) and (samples,). `index` (readings,) points into all outputs one
    after the other; `time` are their times, s, far apart from output to output; `count` readings
    are real. `waves` are columns of drifts of each output, (readings, outputs, degrees). `run` is
    the number of the run.
    """

    system: Any
    u: Any
    dt: Any
    time: Any
    index: Any
    count: Any
    waves: Any
    run: Any

    def shoot(self, model: Any) -> tuple[jax.Array, jax.Array]:
        """Give the outputs from every segment's own start, and the gaps between segments."""
        nodes = model["nodes"][self.run]
        starts = jnp.concatenate([model["start"][self.run][None], nodes])
        parts = [v.reshape(len(starts), -1, *v.shape[1:]) for v in (self.u, self.dt)]
        y, last = jax.vmap(self.system.run, (None, 0, 0, 0))(model["p"], *parts, starts)
        y = y.reshape(len(self.u), -1)
        return y.T.ravel()[self.index] + self.drift(model), (last[:-1] - nodes).ravel()

    def drift(self, model: Any) -> jax.Array:
        """Drifts of the outputs at the readings, shape (readings,)."""
        return jnp.tensordot(self.waves, model["drift"][self.run], 2)

    def predicted(self, model: Any) -> jax.Array:
        """Outputs at the readings, one output after the other, shape (readings,)."""
        return self.shoot(model)[0]

    def like(self, prepared: Sequence[PreparedOutput], i: int) -> Course:
        """Build the course of run i with the same system from prepared outputs."""
        return course_of(self.system, prepared, i)


def course_of(system: Any, prepared: Sequence[PreparedOutput], i: int) -> Course:
    """Build the course of run i from prepared outputs."""
    run = prepared[0].runs[i]
    index = [k * len(run.u) + s.runs[i].read for k, s in enumerate(prepared)]
    span = float(np.sum(np.asarray(run.dt)))
    separation = OUTPUT_SEPARATION * span
    time = [separation * k + s.time[i] for k, s in enumerate(prepared)]
    index, time = np.concatenate(index), np.concatenate(time)
    readings = padded_readings(time, index)
    columns = [drift_columns(s.time[i] / span, k, len(prepared)) for k, s in enumerate(prepared)]
    columns = np.swapaxes(np.concatenate(columns), 1, 2)
    columns = jnp.asarray(np.pad(columns, ((0, len(readings[0]) - len(columns)), (0, 0), (0, 0))))
    return Course(system, run.u, run.dt, *readings, len(index), columns, run.run)


def close_segments(case: Case, model: Any, scatter: np.ndarray) -> Any:
    """Narrow the gaps between segments step by step; give the start of a free run.

    `scatter` (n,) is that of the states. H. Bock, multiple shooting, 1983.
    """
    noise = case.initial_noise
    for width in GAP_WIDTHS:
        fit = case.search(model, noise, gap=width * scatter)
        if not np.isfinite(fit.cost):
            break
        model, noise = fit.fit.model, fit.noise
    return model | {"nodes": model["nodes"][:, :0]}


def fit_with_drift(case: Case, models: Sequence[Any]) -> RunsFit:
    """Fit from several starts, the best first, with the drift that the outputs need.

    All drifts are free in the first fit: a state that grows without limit could imitate a drift.
    """
    drifting = case._replace(degree=MAX_DRIFT_DEGREE)
    first = fit_in_rounds(drifting, [drifting.with_best_drift(models[0])], 0)
    case = case._replace(degree=first.drift_degree())
    models = [case.with_best_drift(model) for model in (first.fit.model, *models)]
    return fit_in_rounds(case, models)


# Segments are tried if the free run explains less than this percentage of an output.
MIN_EXPLAINED = 50.0
# Segments of a run in multiple shooting.
SEGMENTS = 32


class StateSpaceOutput(NamedTuple):
    """An output of a state space: its readings, the free run, and the tests of its residuals."""

    output: str
    runs: tuple[Run, ...]
    seen: PreparedOutput
    fitted: tuple[np.ndarray, ...]
    checks: Checks
    curves: tuple = ()


@answer
@dataclass(frozen=True, eq=False)
class StatesFit:
    """An identified state space of all outputs.

    Attributes
    ----------
    status : Status
        How far to believe it; ``message`` says why and what to do.
    map : str
        ``"network"`` if a network is among its parameters, else ``"constant"``.
    order : int
        Number of states.
    runs : tuple of Run
        Runs that it was identified from.
    parts : tuple of StateSpaceOutput
        Each output with its checks.
    fit : Fit
        The grey-box fit; ``fit.model["p"]`` are the parameters, ``["start"]`` the first states.
    quantities : dict of str to Quantity
        Quoted numbers with errors.
    noise : array, shape (runs, outputs)
        Rms residuals.
    memory : CorrelatedNoise or None
        Correlation of the noise of all outputs; None for white noise.
    held : dict of str to tuple of HeldOutRun
        Predictions of held-out runs, by output.
    left_out : tuple of BadReadings
        Readings that do not show the output; they are missing from ``runs``.
    more : dict
        Further entries of the JSON.
    """

    status: Status
    message: str
    map: str
    order: int
    runs: tuple[Run, ...]
    parts: tuple[StateSpaceOutput, ...]
    fit: Fit
    quantities: dict[str, Quantity]
    noise: np.ndarray
    memory: CorrelatedNoise | None
    held: dict[str, tuple[HeldOutRun, ...]]
    left_out: tuple[BadReadings, ...]
    more: dict[str, Any]

    @property
    def output(self) -> str:
        """Names of the outputs."""
        return ", ".join(part.output for part in self.parts)

    @property
    def headline(self) -> str:
        """The answer in one line."""
        quantities = [f"{name} = {q}" for name, q in list(self.quantities.items())[:3]]
        found = ", ".join([f"state space of order {self.order}", *quantities])
        return f"{self.output} {self.status}: {found}"

    @cached_property
    def fitted(self) -> dict[str, tuple[np.ndarray, ...]]:
        """Free run at the readings of each output, by run."""
        return {part.output: part.fitted for part in self.parts}

    def tables(self) -> tuple[Table, ...]:
        """Tables of all numbers."""
        rows = [[name, f"{q} {limit_words(q)}".rstrip()] for name, q in self.quantities.items()]
        found = [Table(f"State space of order {self.order} ({self.map} parameters)", [], rows)]
        if tried := self.more.get("tried"):
            head = ["order", "direct", "BIC"]
            lines = [[str(t["order"]), "yes" if t["direct"] else "no", f"{t['bic']:.1f}"]
                     for t in tried]  # fmt: skip
            found.append(Table("Orders tried", head, lines))
        for part in self.parts:
            held = [each.row() for each in self.held.get(part.output, ())]
            found.append(Table(part.output, [], part.checks.rows() + held))
        return tuple(found)

    def to_json(self) -> dict[str, Any]:
        """Give one entry of ``results`` in the JSON contract."""
        names = ("output", "status", "message", "map", "order")
        return json_of(
            {name: getattr(self, name) for name in names}
            | {"model": "state-space", "outputs": [part.output for part in self.parts]}
            | {"records": [run.path or run.name for run in self.runs]}
            | {"parameters": self.quantities}
            | {"noise_rms": self.noise, "noise_memory": self.memory}
            | {"checks": {part.output: part.checks for part in self.parts}}
            | {"held_back": self.held, "left_out": self.left_out}
            | self.more
        )


def fit_states(
    runs: Run | Sequence[Run],
    system: StateSpace,
    parameters: Any,
    begin: Any,
    *,
    known: bool = False,
    free: Sequence[Free] | None = None,
    priors: Sequence[Prior] = (),
    segments: int | None = None,
    held: Sequence[Run] = (),
) -> StatesFit:
    """Identify the parameters of a state space, and its states at the start of each run.

    Parameters
    ----------
    runs : Run or sequence of Run
        Records with the same inputs and outputs, in the order in which the system has them.
    system : StateSpace
        The equations, written for one point.
    parameters : tree
        Start of the search: numbers, arrays, maps, networks. All are free; weights of networks have
        a normal prior of width 3.
    begin : array, shape (n,) or (runs, n)
        Approximate states at the start of the runs.
    known : bool
        True if these are exact and not estimated.
    free : sequence of Free, optional
        Free numbers, with bounds, by paths such as ``p.k``; all if None.
    priors : sequence of Prior
        Further priors, by the same paths.
    segments : int, optional
        Number of segments of the runs, a power of two, that start with states of their own until
        their ends are made to meet (multiple shooting). If None, the free run, and 32 segments if
        that fails.
    held : sequence of Run
        Held-out runs, which are only predicted.

    Returns
    -------
    StatesFit

    Raises
    ------
    InputError
        If runs or shapes do not fit together.

    Notes
    -----
    Output error: the system runs free from the start of each run. L. Ljung, System Identification
    (1999), chapters 7, 10 and 16; H. Bock, Recent advances in parameter identification techniques
    for ODE (1983), for segments.

    Examples
    --------
    >>> t = np.arange(60.0)
    >>> u = (t // 15) % 2
    >>> y = [0.5]
    >>> for value in u[:-1]:
    ...     y.append(0.8 * y[-1] + 0.4 * value)
    >>> noise = 0.01 * np.random.default_rng(0).normal(size=60)
    >>> lag = StateSpace(lambda x, u, p: p["a"] * x + p["b"] * u, lambda x, u, p: x, discrete=True)
    >>> fit = fit_states(Run(t, {"valve": u}, {"level": y + noise}), lag, {"a": 0.5, "b": 1.0}, [0])
    >>> fit.status.value, abs(fit.quantities["a"].value - 0.8) < 0.01
    ('converged', True)
    """
    runs, held = check_runs(runs, held, system.discrete)
    start = np.array(begin, float)
    start = np.tile(start, (len(runs), 1)) if start.ndim < 2 else start
    if len(start) != len(runs):
        raise InputError(f"first states of shape {start.shape}", f"one row for {len(runs)} runs")
    model = {"p": parameters, **start_model(start, len(runs[0].outputs))}
    parts = jax.tree_util.tree_leaves_with_path(parameters, is_leaf=lambda v: isinstance(v, MLP))
    paths = {jax.tree_util.keystr(at, simple=True, separator="."): v for at, v in parts}
    nets = [f"p.{path}".rstrip(".") for path, v in paths.items() if isinstance(v, MLP)]
    if free is None:
        names = [f"p.{leaf.path}".rstrip(".") for leaf in tree.leaves(parameters)]
        free = [Free(n, nuisance=any(n.startswith(f"{net}.") for net in nets)) for n in names]
    free = [*free, *([] if known else [Free("start", nuisance=True)])]
    inside = [prior for net in nets for prior in weight_priors(net)]

    def search(runs: tuple[Run, ...]) -> RunsFit:
        case = states_case(runs, system, free, (*inside, *priors))
        _check_outputs(case, model)
        return fit_with_drift(case, [_free_run(case, model, segments).fit.model])

    def answer(runs: tuple[Run, ...], found: RunsFit, left_out: Any) -> StatesFit:
        found = fit_correlated_noise(found, MAX_SQUARES_RATIO)
        options = {"held": held, "left_out": left_out, "map": "network" if nets else "constant"}
        return states_answer(found, runs, _parameter_quantities(found), **options)

    return answer_without_bad_readings(runs, [search], lambda found: found, answer)


def _free_run(case: Case, model: Any, segments: int | None) -> RunsFit:
    """Fit the free run, with segments if that fails."""
    found = None if segments is not None and segments > 1 else fit_in_rounds(case, [model])
    if found is None or (segments is None and not min(_explained(case, found)) > MIN_EXPLAINED):
        nodes, scatter = _segment_starts(case, model, segments or SEGMENTS)
        closed = fit_in_rounds(case, [close_segments(case, model | {"nodes": nodes}, scatter)])
        found = closed if found is None or closed.cost < found.cost else found
    return found


def states_case(
    runs: Sequence[Run],
    system: Any,
    free: Sequence[Free],
    priors: Sequence[Prior],
    path: Path = DIRECT_PATH,
) -> Case:
    """Prepare runs for a state space."""
    prepared = tuple(prepare_output(runs, name, FIRST_ORDER, path) for name in runs[0].outputs)
    courses = tuple(course_of(system, prepared, i) for i in range(len(runs)))
    return Case(prepared, courses, tuple(free), tuple(priors), path)


def start_model(start: np.ndarray, outputs: int) -> dict[str, np.ndarray]:
    """Model entries for first states of runs, shape (runs, n), without segments and drifts."""
    nodes = np.zeros((len(start), 0, start.shape[1]))
    drift = np.zeros((len(start), outputs, MAX_DRIFT_DEGREE))
    return {"start": start, "nodes": nodes, "drift": drift}


def _check_outputs(case: Case, model: Any) -> None:
    course = case.courses[0]
    y, x = jax.eval_shape(
        course.system.run, model["p"], course.u, course.dt, jnp.asarray(model["start"][0])
    )
    if y.shape[1] != len(case.prepared) or x.shape != model["start"][0].shape:
        found = f"a state space of {y.shape[1]} outputs and {x.shape} next states"
        raise InputError(
            found, f"{len(case.prepared)} outputs and {model['start'][0].shape} states"
        )


def _parameter_quantities(found: RunsFit) -> dict[str, Quantity]:
    """Free numbers of the equations with errors."""
    value, error, raw = np.array([(v.value, v.error, v.error_raw) for v in found.fit.variables]).T
    one = np.eye(len(value))
    if found.errors is not None:
        error = np.where(np.isfinite(error), found.errors.moments(one).error, np.nan)
    numbers = Derived(value, error, raw, np.zeros(len(value)), one)
    numbers = widen_errors(numbers, digit_covariance(found))
    return {name.removeprefix("p."): quantity_at(numbers, i, "")
            for i, name in enumerate(found.fit.problem.names)
            if name.startswith("p.") and not found.fit.problem.nuisance[i]}  # fmt: skip


def _explained(case: Case, found: RunsFit) -> list[float]:
    """Explained part of each output in percent, for the free run."""
    return [
        explained_percent(
            np.concatenate([row[k] for row in found.residuals]),
            np.concatenate([m - m.mean() for m in s.measured]),
        )
        for k, s in enumerate(case.prepared)
    ]


def _segment_starts(case: Case, model: Any, segments: int) -> tuple[np.ndarray, np.ndarray]:
    """Give states at the start of segments from the nearest readings, and the states' scatter."""
    course = case.courses[0]
    shortest = min(len(c.u) for c in case.courses)
    count = 1 << int(np.log2(np.clip(segments, 2, shortest // 4)))
    found = np.zeros((len(case.courses), count - 1, model["start"].shape[1]))
    for i, course in enumerate(case.courses):
        x = jnp.asarray(model["start"][i])
        for j in range(1, count):
            at = j * len(course.u) // count
            nearest = [int(np.argmin(np.abs(s.runs[i].read - at))) for s in case.prepared]
            y = np.array([s.measured[i][k] for s, k in zip(case.prepared, nearest, strict=True)])
            read = [course.system.read(model["p"], x, course.u[at])]
            slope = jax.jacfwd(course.system.read, 1)(model["p"], x, course.u[at])
            found[i, j - 1] = x + np.linalg.lstsq(np.asarray(slope), y - read[0], rcond=1e-8)[0]
    scatter = found.reshape(-1, found.shape[2]).std(0)
    typical = scatter[scatter > 0].mean() if (scatter > 0).any() else 1.0
    return found, np.where(scatter > 0, scatter, typical)


def states_answer(
    found: RunsFit,
    runs: tuple[Run, ...],
    quantities: Mapping[str, Quantity],
    *,
    held: Sequence[Run] = (),
    left_out: tuple[BadReadings, ...] = (),
    map: str = "constant",
    order: int | None = None,
    gain: float | None = None,
    given: bool = True,
    by_input: Mapping[str, Sequence[str]] | None = None,
    more: Mapping[str, Any] | None = None,
) -> StatesFit:
    """Judge a fit: tests of each output's residuals, held-out runs, and the verdict.

    `by_input` names the quantities that belong to an input; `given` is True if the delay was given.
    """
    case, delay, parts = found.case, found.path.delay, []
    used = max(1, effective_parameters(found.fit) // len(case.prepared)) + (not given)
    for k, s in enumerate(case.prepared):
        fitted = tuple(y - row[k] for y, row in zip(s.measured, found.residuals, strict=True))
        added = [_score_columns(s, i, y) for i, y in enumerate(fitted)]
        checks = checks_of(found, k, added, used, gain)
        parts.append(StateSpaceOutput(s.output, runs, s, fitted, checks))
    predictions = predict_runs(found, held)
    no_response = all(part.checks.nothing_probability >= POOR_FIT for part in parts)
    inseparable = {q for name in parts[0].checks.together for q in (by_input or {}).get(name, ())}
    kept = {n: q.open() if no_response or n in inseparable else q for n, q in quantities.items()}
    evidence = {
        part.output: ResponseEvidence(
            found.fit, found.converged, part.checks, kept, (), predictions[part.output], map,
            float(np.sqrt(np.mean(found.rms[:, k] ** 2))), 0.0 if given else max(-delay, 0.0),
        )
        for k, part in enumerate(parts)
    }  # fmt: skip
    status, message = judge_outputs(evidence)
    kept, _ = remove_errors_if_wrong(status, kept)
    message = add_remarks(message, not given and delay == max_delay(runs) > 0, left_out)
    order = order or found.fit.model["start"].shape[1]
    held_out = predictions if held else {}
    return StatesFit(
        status, message, map, order, runs, tuple(parts), found.fit, kept, found.rms,
        found.memory, held_out, left_out, dict(more or {}),
    )  # fmt: skip


def _score_columns(prepared: PreparedOutput, i: int, fitted: np.ndarray) -> np.ndarray:
    """First terms of a nonlinear state space, products of output and inputs, and growth columns."""
    u = prepared.scaled(prepared.runs[i].u)[prepared.runs[i].read]
    y = ((fitted - np.mean(fitted)) / prepared.output_scale)[:, None]
    growth = growth_columns(fitted, prepared.time[i])
    return np.concatenate([y**2, y**3, u**2, u * y, growth], axis=1)
