"""Fit of a state space whose equations the user writes.

Runs go in segments whose ends must meet (multiple shooting), or run free as one.
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
    judged,
    limit_words,
    quantity,
    quoted,
    remarked,
    widened,
)
from beamfit.dynamics.bad_readings import BadReadings, judged_without
from beamfit.dynamics.checks import Checks, HeldOutRun, checks_of, digits_of, held_out, percent
from beamfit.dynamics.model import PreparedOutput, growing_of, readings_of, weight_priors
from beamfit.dynamics.paths import Path, latest, prepared
from beamfit.dynamics.record import Run, Way, checked
from beamfit.dynamics.response import FIRST_ORDER
from beamfit.dynamics.search import (
    DRIFT,
    Begun,
    Case,
    Settled,
    drift_columns,
    settled,
    used_by,
    with_memory,
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

# Allowed gaps between segments in turn, in units of the states' scatter.
CLOSING = (1.0, 0.1, 1e-2, 1e-3, 1e-4)
# Distance in time between the series of two outputs, in lengths of the run: no correlation is left.
APART = 1e6
# A path of inputs that hold from sample to sample and come at once.
PLAIN = Path(None, Way(), 0.0)
# Factor by which a fit with correlated noise may leave larger squares than the fit without.
WORSE = 1.5


@tree.node("system")
class Course:
    """A run as the model sees it: inputs and steps, and which outputs were read, all padded.

    The system is a `beamfit.dynamics.states.StateSpace`, or anything hashable with its `run`.

    Shapes (samples, m), (samples,); `index` (readings,) points into all outputs one after the
    other, `time` is theirs, s, far apart from output to output; there are `count`. `waves` are
    columns of drifts of each output, (readings, outputs, degrees). `run` is its number.
    """

    system: Any
    u: Any
    dt: Any
    time: Any
    index: Any
    count: Any
    waves: Any
    run: Any

    def shot(self, model: Any) -> tuple[jax.Array, jax.Array]:
        """Outputs from every segment's own start, and the gaps where segments meet."""
        nodes = model["nodes"][self.run]
        starts = jnp.concatenate([model["start"][self.run][None], nodes])
        parts = [v.reshape(len(starts), -1, *v.shape[1:]) for v in (self.u, self.dt)]
        y, last = jax.vmap(self.system.run, (None, 0, 0, 0))(model["p"], *parts, starts)
        y = y.reshape(len(self.u), -1)
        return y.T.ravel()[self.index] + self.drift(model), (last[:-1] - nodes).ravel()

    def drift(self, model: Any) -> jax.Array:
        """Drifts of the outputs where they were read, shape (readings,)."""
        return jnp.tensordot(self.waves, model["drift"][self.run], 2)

    def predicted(self, model: Any) -> jax.Array:
        """Outputs where they were read, one after the other, shape (readings,)."""
        return self.shot(model)[0]

    def like(self, seen: Sequence[PreparedOutput], i: int) -> Course:
        """Course of a run with the same system, from the prepared outputs."""
        return course_of(self.system, seen, i)


def course_of(system: Any, seen: Sequence[PreparedOutput], i: int) -> Course:
    """Course of a run, from the prepared outputs."""
    run = seen[0].runs[i]
    index = [k * len(run.u) + s.runs[i].read for k, s in enumerate(seen)]
    span = float(np.sum(np.asarray(run.dt)))
    far = APART * span
    time = [far * k + s.time[i] for k, s in enumerate(seen)]
    index, time = np.concatenate(index), np.concatenate(time)
    readings = readings_of(time, index)
    waves = [drift_columns(s.time[i] / span, k, len(seen)) for k, s in enumerate(seen)]
    waves = np.swapaxes(np.concatenate(waves), 1, 2)
    waves = jnp.asarray(np.pad(waves, ((0, len(readings[0]) - len(waves)), (0, 0), (0, 0))))
    return Course(system, run.u, run.dt, *readings, len(index), waves, run.run)


def closed(case: Case, model: Any, close: np.ndarray) -> Any:
    """The model from where the free run may begin: ends of segments have met.

    `close` (n,) is the states' scatter. H. Bock, multiple shooting, 1983.
    """
    noise = case.guess
    for width in CLOSING:
        shot = case.search(model, noise, gap=width * close)
        if not np.isfinite(shot.likelihood):
            break
        model, noise = shot.fit.model, shot.noise
    return model | {"nodes": model["nodes"][:, :0]}


def begun(case: Case, models: Sequence[Any], path: Path = PLAIN) -> Begun:
    """The fit from some starts, the best first, beside the drift that the outputs want.

    All drifts are free first: a state that grows for ever would take a drift for its own.
    """
    whole = case._replace(degree=DRIFT)
    first = settled(whole, [whole.beside_drift(models[0])], 0)
    case = case._replace(degree=first.drift_degree(whole))
    models = [case.beside_drift(model) for model in (first.fit.model, *models)]
    return Begun(case, path, settled(case, models))


# Percent of an output explained by the free run below which segments are tried.
ASTRAY = 50.0
# Segments of a run in multiple shooting.
SEGMENTS = 32


class StateSpaceOutput(NamedTuple):
    """An output of a state space: its readings, the free run, and the noise of its residuals."""

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
        States.
    runs : tuple of Run
        What it was identified from.
    parts : tuple of StateSpaceOutput
        Each output with its checks.
    fit : Fit
        The grey-box fit; ``fit.model["p"]`` are the parameters, ``["start"]`` the first states.
    quantities : dict of str to Quantity
        What is quoted, with errors.
    noise : array, shape (runs, outputs)
        Rms residuals.
    memory : CorrelatedNoise or None
        How the noise of all outputs wanders; None where it does not.
    held : dict of str to tuple of HeldOutRun
        How runs are predicted that were not used, by output.
    left_out : tuple of BadReadings
        Readings that show no output; they are missing from ``runs``.
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
        """The answer in a line."""
        said = [f"{name} = {q}" for name, q in list(self.quantities.items())[:3]]
        found = ", ".join([f"state space of order {self.order}", *said])
        return f"{self.output} {self.status}: {found}"

    @cached_property
    def fitted(self) -> dict[str, tuple[np.ndarray, ...]]:
        """The free run at the readings of each output, by run."""
        return {part.output: part.fitted for part in self.parts}

    def tables(self) -> tuple[Table, ...]:
        """All numbers, to be shown."""
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
        Where the search begins: numbers, arrays, maps, networks. All are free; weights of networks
        have a normal prior of width 3.
    begin : array, shape (n,) or (runs, n)
        The states at the start of the runs, about.
    known : bool
        Whether they are as given, measured, and not estimated.
    free : sequence of Free, optional
        What is free in the place of all, with bounds, by paths such as ``p.k``.
    priors : sequence of Prior
        Further ones, by the same paths.
    segments : int, optional
        Parts of the runs, to a power of two, that begin with states of their own until their ends
        are made to meet (multiple shooting). One, the free run, unless it goes astray; then 32.
    held : sequence of Run
        Runs that are only predicted.

    Returns
    -------
    StatesFit

    Raises
    ------
    InputError
        If runs do not fit together or shapes do not.

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
    runs, held = checked(runs, held, system.discrete)
    start = np.array(begin, float)
    start = np.tile(start, (len(runs), 1)) if start.ndim < 2 else start
    if len(start) != len(runs):
        raise InputError(f"first states of shape {start.shape}", f"one row for {len(runs)} runs")
    model = {"p": parameters, **at_start(start, len(runs[0].outputs))}
    parts = jax.tree_util.tree_leaves_with_path(parameters, is_leaf=lambda v: isinstance(v, MLP))
    paths = {jax.tree_util.keystr(at, simple=True, separator="."): v for at, v in parts}
    nets = [f"p.{path}".rstrip(".") for path, v in paths.items() if isinstance(v, MLP)]
    if free is None:
        names = [f"p.{leaf.path}".rstrip(".") for leaf in tree.leaves(parameters)]
        free = [Free(n, nuisance=any(n.startswith(f"{net}.") for net in nets)) for n in names]
    free = [*free, *([] if known else [Free("start", nuisance=True)])]
    inside = [prior for net in nets for prior in weight_priors(net)]

    def search(runs: tuple[Run, ...]) -> Begun:
        case = case_of(runs, system, free, (*inside, *priors))
        _check_outputs(case, model)
        return begun(case, [_free_run(case, model, segments).fit.model])

    def answer(runs: tuple[Run, ...], found: Begun, left_out: Any) -> StatesFit:
        found = found._replace(settled=with_memory(found.case, found.settled, WORSE))
        options = {"held": held, "left_out": left_out, "map": "network" if nets else "constant"}
        return states_answer(found, runs, _told(found), **options)

    return judged_without(runs, [search], lambda found: found, answer)


def _free_run(case: Case, model: Any, segments: int | None) -> Settled:
    """The fit of a free run, by segments where that goes astray."""
    found = None if segments is not None and segments > 1 else settled(case, [model])
    if found is None or (segments is None and not min(_explained(case, found)) > ASTRAY):
        nodes, close = _nodes(case, model, segments or SEGMENTS)
        shot = settled(case, [closed(case, model | {"nodes": nodes}, close)])
        found = shot if found is None or shot.likelihood < found.likelihood else found
    return found


def case_of(
    runs: Sequence[Run],
    system: Any,
    free: Sequence[Free],
    priors: Sequence[Prior],
    path: Path = PLAIN,
) -> Case:
    """The runs as the model sees them."""
    seen = tuple(prepared(runs, name, FIRST_ORDER, path) for name in runs[0].outputs)
    courses = tuple(course_of(system, seen, i) for i in range(len(runs)))
    return Case(seen, courses, tuple(free), tuple(priors))


def at_start(start: np.ndarray, outputs: int) -> dict[str, np.ndarray]:
    """First states of runs, shape (runs, n), without segments and drifts, as a model has them."""
    nodes, drift = np.zeros((len(start), 0, start.shape[1])), np.zeros((len(start), outputs, DRIFT))
    return {"start": start, "nodes": nodes, "drift": drift}


def _check_outputs(case: Case, model: Any) -> None:
    course = case.courses[0]
    y, x = jax.eval_shape(
        course.system.run, model["p"], course.u, course.dt, jnp.asarray(model["start"][0])
    )
    if y.shape[1] != len(case.seen) or x.shape != model["start"][0].shape:
        found = f"a state space of {y.shape[1]} outputs and {x.shape} next states"
        raise InputError(found, f"{len(case.seen)} outputs and {model['start'][0].shape} states")


def _told(begun: Begun) -> dict[str, Quantity]:
    """The free numbers of the equations with errors."""
    found = begun.settled
    value, error, raw = np.array([(v.value, v.error, v.error_raw) for v in found.fit.variables]).T
    one = np.eye(len(value))
    if found.errors is not None:
        error = np.where(np.isfinite(error), found.errors.moments(one).error, np.nan)
    numbers = widened(Derived(value, error, raw, np.zeros(len(value)), one), digits_of(begun))
    return {name.removeprefix("p."): quantity(numbers, i, "")
            for i, name in enumerate(found.fit.problem.names)
            if name.startswith("p.") and not found.fit.problem.nuisance[i]}  # fmt: skip


def _explained(case: Case, found: Settled) -> list[float]:
    """Explained part of each output in percent, by the free run."""
    return [
        percent(
            np.concatenate([row[k] for row in found.rest]),
            np.concatenate([m - m.mean() for m in s.measured]),
        )
        for k, s in enumerate(case.seen)
    ]


def _nodes(case: Case, model: Any, segments: int) -> tuple[np.ndarray, np.ndarray]:
    """States at the start of segments, from the readings next to them, and their scatter."""
    course = case.courses[0]
    shortest = min(len(c.u) for c in case.courses)
    count = 1 << int(np.log2(np.clip(segments, 2, shortest // 4)))
    found = np.zeros((len(case.courses), count - 1, model["start"].shape[1]))
    for i, course in enumerate(case.courses):
        x = jnp.asarray(model["start"][i])
        for j in range(1, count):
            at = j * len(course.u) // count
            near = [int(np.argmin(np.abs(s.runs[i].read - at))) for s in case.seen]
            y = np.array([s.measured[i][k] for s, k in zip(case.seen, near, strict=True)])
            read = [course.system.read(model["p"], x, course.u[at])]
            slope = jax.jacfwd(course.system.read, 1)(model["p"], x, course.u[at])
            found[i, j - 1] = x + np.linalg.lstsq(np.asarray(slope), y - read[0], rcond=1e-8)[0]
    scatter = found.reshape(-1, found.shape[2]).std(0)
    rest = scatter[scatter > 0].mean() if (scatter > 0).any() else 1.0
    return found, np.where(scatter > 0, scatter, rest)


def states_answer(
    begun: Begun,
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
    """Judge a fit: tests of each output's residuals, held-back runs, the verdict.

    `by_input` names the quantities that are an input's own; `given` tells if the delay is.
    """
    (case, path, found), parts = begun, []
    used = max(1, used_by(found.fit) // len(case.seen)) + (not given)
    for k, s in enumerate(case.seen):
        fitted = tuple(y - row[k] for y, row in zip(s.measured, found.rest, strict=True))
        added = [_added(s, i, y) for i, y in enumerate(fitted)]
        checks = checks_of(begun, k, added, used, gain)
        parts.append(StateSpaceOutput(s.output, runs, s, fitted, checks))
    ahead = held_out(begun, held)
    nothing = all(part.checks.nothing_probability >= POOR_FIT for part in parts)
    joint = {q for name in parts[0].checks.together for q in (by_input or {}).get(name, ())}
    told = {n: q.open() if nothing or n in joint else q for n, q in quantities.items()}
    evidence = {
        part.output: ResponseEvidence(
            found.fit, found.rests, part.checks, told, (), ahead[part.output], map,
            float(np.sqrt(np.mean(found.rms[:, k] ** 2))), 0.0 if given else max(-path.delay, 0.0),
        )
        for k, part in enumerate(parts)
    }  # fmt: skip
    status, message = judged(evidence)
    told, _ = quoted(status, told)
    message = remarked(message, not given and path.delay == latest(runs) > 0, left_out)
    order = order or found.fit.model["start"].shape[1]
    held_back = ahead if held else {}
    return StatesFit(
        status, message, map, order, runs, tuple(parts), found.fit, told, found.rms,
        found.memory, held_back, left_out, dict(more or {}),
    )  # fmt: skip


def _added(seen: PreparedOutput, i: int, fitted: np.ndarray) -> np.ndarray:
    """First terms of a nonlinear state space, products of output and inputs, and what grows."""
    u = seen.scaled(seen.runs[i].u)[seen.runs[i].read]
    y = ((fitted - np.mean(fitted)) / seen.size_y)[:, None]
    growing = growing_of(fitted, seen.time[i])
    return np.concatenate([y**2, y**3, u**2, u * y, growing], axis=1)
