"""Fit of a state space whose equations the user writes.

Runs go in segments whose ends must meet (multiple shooting), or run free as one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.answer import Table, answer, json_of
from beamfit.dynamics.answer import ResponseEvidence, judged, limit_words, quantity, quoted
from beamfit.dynamics.checks import Checks, HeldOutRun, RunNoises, RunSlopes, checks_of, percent
from beamfit.dynamics.model import PreparedOutput, readings_of, weight_priors
from beamfit.dynamics.paths import Path, prepared
from beamfit.dynamics.record import Run, Way, checked
from beamfit.dynamics.response import FIRST_ORDER
from beamfit.dynamics.search import (
    DRIFT,
    GAINED,
    Case,
    Settled,
    drift_waves,
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

# Steps of a round, after which the noise is estimated again; most rounds; gain in -2 ln L per
# reading below which they end.
STEPS, ROUNDS, EACH = 25, 80, 1e-4
# Allowed gaps between segments in turn, in units of the states' scatter.
CLOSING = (1.0, 0.1, 1e-2, 1e-3, 1e-4)
# Distance in time between the series of two outputs, in lengths of the run: no correlation is left.
APART = 1e6
# Factor by which a fit with correlated noise may leave larger squares than the fit without.
WORSE = 1.5


class System(Protocol):
    """A system: `beamfit.dynamics.states.StateSpace`, or anything hashable with its `run`."""

    def run(
        self, p: Any, u: jax.Array, dt: jax.Array, x0: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Outputs at the samples and the state after the last."""


@tree.node("system")
class Course:
    """A run as the model sees it: inputs and steps, and which outputs were read, all padded.

    Shapes (samples, m), (samples,); `index` (readings,) points into all outputs one after the
    other, `time` is theirs, s, far apart from output to output; there are `count`. `waves` are
    columns of drifts of each output, (readings, outputs, degrees). `run` is its number.
    """

    system: System
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


def course_of(system: System, seen: Sequence[PreparedOutput], i: int) -> Course:
    """Course of a run, from the prepared outputs."""
    run = seen[0].runs[i]
    index = [k * len(run.u) + s.runs[i].read for k, s in enumerate(seen)]
    span = float(np.sum(np.asarray(run.dt)))
    far = APART * span
    time = [far * k + s.time[i] for k, s in enumerate(seen)]
    index, time = np.concatenate(index), np.concatenate(time)
    readings, waves = readings_of(time, index), np.zeros((0, len(seen), DRIFT))
    for k, s in enumerate(seen):
        own = drift_waves(s.time[i] / span)[:, None]
        waves = np.append(waves, np.pad(own, ((0, 0), (k, len(seen) - 1 - k), (0, 0))), axis=0)
    waves = jnp.asarray(np.pad(waves, ((0, len(readings[0]) - len(waves)), (0, 0), (0, 0))))
    return Course(system, run.u, run.dt, *readings, len(index), waves, run.run)


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
    return settled(case, models, _round, _enough, ROUNDS)


def _enough(found: Settled) -> float:
    return GAINED + EACH * sum(len(rest) for row in found.rest for rest in row)


def beside_drift(case: Case, models: Sequence[Any]) -> tuple[Case, Settled]:
    """The case with the drift that the outputs want beside a model, and its fit.

    All drifts are free first: a state that grows for ever would take a drift for its own.
    """
    whole = case._replace(degree=DRIFT)
    first = settled(whole, [whole.beside_drift(model) for model in models], _round, _enough, 0)
    case = case._replace(degree=first.drift_degree(whole))
    models = [case.beside_drift(model) for model in (*models, first.fit.model)]
    return case, trained(case, models)


def remembering(case: Case, white: Settled) -> Settled:
    """The fit again, its noise with a memory, where residuals are correlated."""
    return with_memory(case, white, _round, WORSE)


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
            | {"checks": {part.output: part.checks._asdict() for part in self.parts}}
            | {"held_back": {k: [h._asdict() for h in v] for k, v in self.held.items()}}
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
    model = {"p": parameters, **begun(start, len(runs[0].outputs))}
    nets = tuple(
        f"p.{path}".rstrip(".") for path, net in _networks(parameters) if isinstance(net, MLP)
    )
    if free is None:
        names = [f"p.{leaf.path}".rstrip(".") for leaf in tree.leaves(parameters)]
        free = [Free(n, nuisance=any(n.startswith(f"{net}.") for net in nets)) for n in names]
    free = [*free, *([] if known else [Free("start", nuisance=True)])]
    inside = [prior for net in nets for prior in weight_priors(net)]
    case = case_of(runs, system, free, (*inside, *priors), 0)
    _check_outputs(case, model)
    found = None if segments is not None and segments > 1 else trained(case, [model])
    if found is None or (segments is None and not min(_explained(case, found)) > ASTRAY):
        nodes, close = _nodes(case, model, segments or SEGMENTS)
        shot = trained(case, [closed(case, model | {"nodes": nodes}, close)])
        found = shot if found is None or shot.likelihood < found.likelihood else found
    case, found = beside_drift(case, [found.fit.model])
    found = remembering(case, found)
    numbers = _numbers(found)
    said = {name.removeprefix("p."): quantity(numbers, i, "")
            for i, name in enumerate(found.fit.problem.names)
            if name.startswith("p.") and not found.fit.problem.nuisance[i]}  # fmt: skip
    return states_answer(case, found, runs, said, held=held, map="network" if nets else "constant")


def case_of(
    runs: Sequence[Run], system: System, free: Sequence[Free], priors: Sequence[Prior], delay: int
) -> Case:
    """The runs as the model sees them."""
    late = Path(None, Way(), float(delay))
    seen = tuple(prepared(runs, name, FIRST_ORDER, late) for name in runs[0].outputs)
    courses = tuple(course_of(system, seen, i) for i in range(len(runs)))
    return Case(seen, courses, tuple(free), tuple(priors))


def begun(start: np.ndarray, outputs: int) -> dict[str, np.ndarray]:
    """First states of runs, shape (runs, n), without segments and drifts, as a model has them."""
    nodes, drift = np.zeros((len(start), 0, start.shape[1])), np.zeros((len(start), outputs, DRIFT))
    return {"start": start, "nodes": nodes, "drift": drift}


def _networks(parameters: Any) -> list[tuple[str, Any]]:
    found = jax.tree_util.tree_leaves_with_path(parameters, is_leaf=lambda v: isinstance(v, MLP))
    return [(jax.tree_util.keystr(path, simple=True, separator="."), v) for path, v in found]


def _check_outputs(case: Case, model: Any) -> None:
    course = case.courses[0]
    y, x = jax.eval_shape(
        course.system.run, model["p"], course.u, course.dt, jnp.asarray(model["start"][0])
    )
    if y.shape[1] != len(case.seen) or x.shape != model["start"][0].shape:
        found = f"a state space of {y.shape[1]} outputs and {x.shape} next states"
        raise InputError(found, f"{len(case.seen)} outputs and {model['start'][0].shape} states")


def _numbers(found: Settled) -> Derived:
    """The free numbers with errors."""
    rows = [(v.value, v.error, v.error_raw) for v in found.fit.variables]
    value, error, raw = np.array(rows).T
    one = np.eye(len(value))
    if found.errors is not None:
        error = np.where(np.isfinite(error), found.errors.moments(one).error, np.nan)
    return Derived(value, error, raw, np.zeros(len(value)), one)


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
    case: Case,
    found: Settled,
    runs: tuple[Run, ...],
    quantities: Mapping[str, Quantity],
    *,
    held: Sequence[Run] = (),
    map: str = "constant",
    order: int | None = None,
    gain: float | None = None,
    delay: int = 0,
    by_input: Mapping[str, Sequence[str]] | None = None,
    more: Mapping[str, Any] | None = None,
) -> StatesFit:
    """Judge a fit: tests of each output's residuals, held-back runs, the verdict.

    `by_input` names the quantities that are an input's own.
    """
    used = used_by(found.fit)
    slopes, drifts, parts = found.slopes(case), case.drifts(found.fit.model), []
    for k, s in enumerate(case.seen):
        rest = tuple(row[k] for row in found.rest)
        own = [case.split(i, each)[k] for i, each in enumerate(slopes)]
        fitted = tuple(y - r for y, r in zip(s.measured, rest, strict=True))
        added = [_added(s, i, y) for i, y in enumerate(fitted)]
        pairs = (RunSlopes(o, a) for o, a in zip(own, added, strict=True))
        noise = RunNoises(s.time, [row[k].each for row in found.noise], found.likely)
        used_each = max(1, used // len(case.seen))
        slow = [row[k] for row in drifts]
        checks = checks_of(s, rest, noise, list(pairs), used_each, gain, delay, slow)
        checks = checks._replace(jitter=float(found.jitter[:, k].max()), drift=case.degree)
        parts.append(StateSpaceOutput(list(runs[0].outputs)[k], runs, s, fitted, checks))
    ahead = _ahead(case, found, held, delay)
    nothing = all(part.checks.nothing_probability >= POOR_FIT for part in parts)
    joint = {q for name in parts[0].checks.together for q in (by_input or {}).get(name, ())}
    told = {n: q.open() if nothing or n in joint else q for n, q in quantities.items()}
    evidence = {
        part.output: ResponseEvidence(
            found.fit, found.rests, part.checks, told, (), ahead[part.output], map,
            float(np.sqrt(np.mean(found.rms[:, k] ** 2))),
        )
        for k, part in enumerate(parts)
    }  # fmt: skip
    status, message = judged(evidence)
    told, _ = quoted(status, told)
    order = order or found.fit.model["start"].shape[1]
    held_back = ahead if held else {}
    return StatesFit(
        status, message, map, order, runs, tuple(parts), found.fit, told, found.rms,
        found.memory, held_back, dict(more or {}),
    )  # fmt: skip


def _added(seen: PreparedOutput, i: int, fitted: np.ndarray) -> np.ndarray:
    """First terms of a nonlinear state space: products of output and inputs."""
    u = seen.scaled(seen.runs[i].u)[seen.runs[i].read]
    y = ((fitted - np.mean(fitted)) / seen.size_y)[:, None]
    return np.concatenate([y**2, y**3, u**2, u * y], axis=1)


def _ahead(
    case: Case, found: Settled, held: Sequence[Run], delay: int
) -> dict[str, tuple[HeldOutRun, ...]]:
    """Predict runs that were held back; only the state at their start is estimated."""
    ahead: dict[str, list[HeldOutRun]] = {name: [] for name in held[0].outputs} if held else {}
    for run in held:
        one = case_of((run,), case.courses[0].system, (), (), delay)
        one = one._replace(degree=case.degree)
        start = begun(np.mean(np.asarray(found.fit.model["start"]), axis=0)[None], len(case.seen))
        for s, r in zip(one.seen, one.ahead(found, start), strict=True):
            ahead[s.output].append(HeldOutRun.of(run.name, r, s.measured[0]))
    names = [s.output for s in case.seen]
    return {name: tuple(ahead.get(name, ())) for name in names}
