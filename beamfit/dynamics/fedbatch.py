"""Rates of a fed-batch process, identified from batches: search, noise, bands, verdict."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import logit, ndtri

from beamfit.answer import Table, answer, json_of
from beamfit.dynamics.answer import (
    CURVE_POINTS,
    MAX_HELD_OUT_RATIO,
    VISIT_DISTANCE,
    Curve,
    search_failed,
)
from beamfit.dynamics.balances import (
    BOUND_FACTOR,
    FLOWS,
    RATES,
    STATES,
    STRETCHES,
    TITRE,
    Batches,
    PreparedBatches,
    Stretches,
    batch_bounds,
    course,
    interpolate_gaps,
    network_inputs,
    pad_columns,
    predicted,
    prepare_batches,
    product_inputs,
    rates_at,
    row_columns,
    stretches_of,
)
from beamfit.dynamics.model import weight_priors
from beamfit.dynamics.record import Run, reorder_inputs
from beamfit.dynamics.search import repeat_search
from beamfit.errors import Finding, InputError, Status, judge, nearest
from beamfit.greybox.fit import Fit
from beamfit.greybox.mlp import MLP, Port, dense
from beamfit.greybox.problem import Free, Prior, Problem, Record
from beamfit.greybox.solve import solve
from beamfit.noise.memory import is_correlated
from beamfit.statistics import POOR_FIT

# Values, in units of the largest, below which a proportional noise becomes constant.
FLOORS = np.geomspace(1e-4, 1.0, 13)
# Percentile of the substrate readings that is the default scale: rates fall below it, and there are
# few readings.
SCALE_PERCENTILE = 10.0


class ReadingNoise(NamedTuple):
    """Noise of an output: a share of the value and a floor; a constant noise has share 0."""

    share: float
    floor: float

    def errors(self, values: np.ndarray) -> np.ndarray:
        """Standard deviation of each value."""
        return np.hypot(self.share * values, self.floor)

    def __str__(self) -> str:
        more = f"{100 * self.share:.2g} % of the value and " if self.share else ""
        return f"{more}{self.floor:.2g}"


def noise_of(residuals: np.ndarray, fitted: np.ndarray, read: np.ndarray) -> ReadingNoise:
    """Estimate the noise of one output from its residuals."""
    top, found = max(float(np.max(np.abs(fitted))), 1e-12), []
    for kind in (ReadingNoise(0.0, top), *(ReadingNoise(1.0, top * floor) for floor in FLOORS)):
        shape = kind.errors(fitted)[read]
        level = max(float(np.sqrt(np.mean((residuals[read] / shape) ** 2))), 1e-12)
        noise = ReadingNoise(level * kind.share, level * kind.floor)
        found.append((float(np.sum(np.log(level * shape))), noise))
    return min(found, key=lambda each: each[0])[1]


def errors_of(noise: Iterable[ReadingNoise], values: np.ndarray) -> np.ndarray:
    """Standard deviations of values, the outputs along the last axis."""
    return np.stack([each.errors(values[..., k]) for k, each in enumerate(noise)], axis=-1)


# Parts of the model: networks, and numbers at the start of each batch.
NETWORKS, START_NUMBERS = ("rates", "product"), ("start", "begin")


def problem_of(
    seen: PreparedBatches, model: Any, error: np.ndarray, free: Sequence[str], spread: Any = 1.0
) -> Problem:
    """State the fit as a problem.

    `error`, of the shape of the readings, is a first estimate that they correct; `spread` is the
    standard deviation of the logarithms of rates between batches.
    """
    record = Record(
        "batches", predicted, seen.batches, seen.measured, error=error, weight=seen.read * 1.0,
        worth=1.0,
    )  # fmt: skip
    parts = [Free(name, 0.0 if name == "decay" else -np.inf, nuisance=True)
             for name in free if name in model]  # fmt: skip
    priors = [p for name in NETWORKS if name in model for p in weight_priors(name)]
    own = Prior("own", 0.0, np.broadcast_to(spread, model["own"].shape).ravel())
    return Problem(model, parts, [record], [*priors, own])


def network_of(
    names: Sequence[str], points: np.ndarray, outputs: Sequence[str], hidden: int, seed: int
) -> MLP:
    """Make a network of points (n, names) with small random weights and typical rates."""
    ports = [Port(n, "", 0, float(s) or 1.0, float(m))
             for n, s, m in zip(names, points.std(0), points.mean(0), strict=True)]  # fmt: skip
    outputs = [Port(name, "", 0, 1.0, float(logit(0.5 / BOUND_FACTOR))) for name in outputs]
    return dense(ports, outputs, [hidden], seed=seed, spread=0.3)


class HeldBatch(NamedTuple):
    """A held-out batch, predicted from start numbers that are fitted to it.

    `rms` is by output, in its units; `rest` the rms in units of the errors, of noise, model and
    spread of batches; `inside` the share of readings within the 95 % band, by output.
    """

    name: str
    rms: dict[str, float]
    rest: float
    inside: dict[str, float]

    def row(self) -> list[str]:
        """Label and value."""
        each = ", ".join(f"{name} rms {r:.3g}" for name, r in self.rms.items())
        return [f"{self.name} held back", f"{self.rest:.2f} times its error: {each}"]


_fitted = jax.jit(predicted)


@jax.jit  # without it hundreds of small programs are compiled
def predict_batch(model: Any, data: tuple[Batches, Mapping[str, Any]]) -> jax.Array:
    """Predict a batch from start numbers, shape (1, rows, outputs)."""
    b, start = data
    return predicted(model | start, b)


def forecast(
    fit: Fit, b: Batches, start: Mapping[str, Any], spread: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Predict a typical batch, with errors of one that differs, shape (1, rows, outputs)."""
    typical = jnp.zeros((1, len(spread)))
    found = fit.derive(predict_batch, (b, {**start, "own": typical}))
    slope = jax.jacfwd(lambda own: predict_batch(fit.model, (b, {**start, "own": own})))(typical)
    between = np.linalg.norm(np.asarray(slope)[..., 0, :] * spread, axis=-1)
    return found.value, np.hypot(found.error, between)


def predict_held_batch(
    run: Run, like: Batches, fit: Fit, noise: Mapping[str, ReadingNoise], spread: np.ndarray
) -> HeldBatch:
    """Predict a held-out batch, of which only the start numbers are fitted.

    The error belongs to the larger of reading and prediction: substrate that runs out falls by
    decades at once, and a shift by an hour is not noise of the smaller value.
    """
    seen = prepare_batches([run], like, tuple(noise))

    def with_errors(first):
        value, band = forecast(fit, seen.batches, first, spread)
        error = errors_of(noise.values(), np.maximum(value, seen.measured))
        return value, np.hypot(error, np.nan_to_num(band))

    first = start_numbers(seen)
    problem = problem_of(seen, dict(fit.model) | first, with_errors(first)[1], START_NUMBERS)
    end = solve(problem).model
    value, error = with_errors({name: end[name] for name in first})
    residuals, rms, inside = value - seen.measured, {}, {}
    ratio = np.abs(residuals) / error
    for k, name in enumerate(noise):
        read = seen.read[..., k]
        rms[name] = float(np.sqrt(np.mean(residuals[..., k][read] ** 2)))
        inside[name] = float(np.mean(ratio[..., k][read] < -ndtri(0.025)))
    total = float(np.sqrt(np.mean(ratio[seen.read] ** 2)))
    return HeldBatch(run.name, rms, total, inside)


# ---- the verdict


class BatchEvidence(NamedTuple):
    """Input of the rules; `fitted` has the shape of the readings."""

    fit: Fit
    converged: bool
    seen: PreparedBatches
    fitted: np.ndarray
    noise: dict[str, ReadingNoise]
    curves: tuple[Curve, ...] = ()
    held: Mapping[str, HeldBatch] = MappingProxyType({})


def _correlated_residuals(e: BatchEvidence) -> Finding | None:
    """Find the output with the largest correlated residuals."""
    used_share, found = 1.0 - e.fit.groups[0].dof / int(e.seen.read.sum()), []
    for k, (name, noise) in enumerate(e.noise.items()):
        read = e.seen.read[..., k]
        fitted, top = e.fitted[..., k][read], e.seen.measured[..., k].max()
        residuals = e.seen.measured[..., k][read] - fitted
        if is_correlated(
            residuals / noise.errors(fitted), used_share * residuals.size, -ndtri(POOR_FIT)
        ):
            found.append((residuals.std() / top, f"{name}: {residuals.std():.2g} of {top:.3g}"))
    if not found:
        return None
    cause = f"Residuals follow one another and are no noise, of {max(found)[1]} is not explained: "
    cause += "the rates hang on something else, or a balance lacks a flow."
    remedy = "Give what else was set or read on line, or more hidden nodes."
    return Finding(Status.poor_fit, cause, remedy)


def _fails_held_out(e: BatchEvidence) -> Finding | None:
    bad = {name: held.rest for name, held in e.held.items() if held.rest > MAX_HELD_OUT_RATIO}
    if not bad:
        return None
    name, ratio = max(bad.items(), key=lambda each: each[1])
    cause = f"Batch {name}, held back, is {ratio:.1f} times its error off."
    return Finding(Status.poor_fit, cause, "Use batches that cover its range, or fewer nodes.")


def _undetermined(e: BatchEvidence) -> Finding | None:
    left = [
        f"{c.parameter}({c.input})"
        for c in e.curves
        if not np.any(np.isfinite(c.error) & c.visited & (c.error < np.abs(c.value)))
    ]
    if not left:
        return None
    cause = f"The batches do not determine {', '.join(left)}."
    return Finding(Status.unidentified, cause, "Add batches that visit more, or read more often.")


def _at_bound(e: BatchEvidence) -> Finding | None:
    most = dict(zip(RATES, np.asarray(e.seen.batches.ends[1]), strict=True))
    held = {c.parameter for c in e.curves
            if np.any(c.value[c.visited] > AT_BOUND * most[c.parameter])}  # fmt: skip
    if not held:
        return None
    cause = f"{', '.join(sorted(held))} is held by its bound."
    return Finding(Status.at_limit, cause, "Give higher bounds (most=) if the physics allows.")


def _converged(e: BatchEvidence) -> Finding:
    noises = ", ".join(f"{name} {noise}" for name, noise in e.noise.items())
    cause = f"The balances follow all batches within noise: {noises}."
    never = sorted({c.input for c in e.curves if not c.visited.all()})
    more = f" Parts of the range of {', '.join(never)} were not visited." if never else ""
    return Finding(Status.converged, cause + more)


# Rates above this share of their bound count as at the bound.
AT_BOUND = 0.95
RULES = (
    search_failed,
    _correlated_residuals,
    _fails_held_out,
    _undetermined,
    _at_bound,
    _converged,
)


@answer
@dataclass(frozen=True, eq=False)
class FedBatchFit:
    """Rates of a fed-batch process, identified from batches.

    Attributes
    ----------
    status : Status
        How far to believe it; ``message`` says why and what to do.
    runs : tuple of Run
        The batches.
    seen : PreparedBatches
        The batches as the model sees them.
    fit : Fit
        The grey-box fit.
    curves : tuple of Curve
        mu_b and mu_s against each input of the rates, the others at their means, 1/h.
    noise : dict of str to ReadingNoise
        Noise of biomass, substrate, volume, and titre if it was read.
    spread : dict of str to float
        Relative spread of mu_b, mu_s and product formation between batches.
    held : dict of str to HeldBatch
        Predictions of held-out batches.
    """

    status: Status
    message: str
    runs: tuple[Run, ...]
    seen: PreparedBatches
    fit: Fit
    curves: tuple[Curve, ...]
    noise: dict[str, ReadingNoise]
    spread: dict[str, float]
    held: dict[str, HeldBatch]

    @property
    def headline(self) -> str:
        """The answer in one line."""
        points = ", ".join(self.fit.model["rates"].inputs)
        return f"{self.output} {self.status}: of {points}, from {len(self.runs)} batches"

    @property
    def output(self) -> str:
        """Names of the identified outputs."""
        return "mu_b, mu_s" + ", titre" * (TITRE in self.noise)

    @cached_property
    def courses(self) -> tuple[np.ndarray, ...]:
        """Biomass, substrate, volume and titre at the rows of each batch, shape (rows, outputs)."""
        found = np.asarray(_fitted(self.fit.model, self.seen.batches))
        return tuple(x[: len(t)] for x, t in zip(found, self.seen.time, strict=True))

    @property
    def half(self) -> float:
        """Scale of the substrate, g/L, below which rates fall."""
        return float(self.fit.model["half"])

    def tables(self) -> tuple[Table, ...]:
        """Tables of all numbers."""
        rows = [[f"noise of {name}", str(noise)] for name, noise in self.noise.items()]
        rows += [
            [f"bounds of {r}", f"{low:.3g} to {high:.3g} 1/h"]
            for r, (low, high) in zip(RATES, np.transpose(self.seen.batches.ends), strict=True)
        ]
        rows += [[f"batches differ in {n}", f"{100 * s:.2g} %"] for n, s in self.spread.items()]
        rows += [["scale of the substrate", f"{self.half:.3g} g/L"]]
        if TITRE in self.noise:
            points = ", ".join(self.fit.model["product"].inputs)
            rows += [["product hangs on", points]]
            rows += [["decay of titre", f"{float(self.fit.model['decay']):.2g} 1/h"]]
        rows += [held.row() for held in self.held.values()]
        return (Table("fed-batch", [], rows), *(curve.table() for curve in self.curves))

    def to_json(self) -> dict[str, Any]:
        """Give one entry of ``results`` in the JSON contract."""
        return json_of(
            {"output": self.output, "status": self.status, "message": self.message}
            | {"model": "fed-batch", "map": "network", "substrate_scale": self.half}
            | {"records": [run.path or run.name for run in self.runs]}
            | {"curves": self.curves, "noise": self.noise}
            | {"batch_spread": self.spread, "held_back": self.held}
        )


def identify_batches(
    runs: Run | Sequence[Run],
    *,
    points: Sequence[str] | None = None,
    product: Sequence[str] = ("mu_b", "substrate"),
    held: Sequence[Run] = (),
    hidden: int = 5,
    most: tuple[float, float] | None = None,
    half: float | None = None,
    seed: int = 0,
) -> FedBatchFit:
    """Identify the rates of a fed-batch process.

    Parameters
    ----------
    runs : Run or sequence of Run
        Batches, of any lengths: outputs ``biomass`` and ``substrate`` in g/L and ``volume`` in L,
        NaN where nothing was read, and ``titre`` in g/L if all have it; inputs ``feed`` in L/h and
        ``feed_substrate`` in g/L, optionally ``outflow`` in L/h, and whatever else was set.
    points : sequence of str, optional
        Inputs of the rates: states, inputs, outputs that were read on line, and ``measured
        substrate``, ``measured biomass``; the substrate and all inputs but flows if None.
    product : sequence of str
        Inputs of the formation of product: mu_b, mu_s, and possible inputs of the rates.
    held : sequence of Run
        Held-out batches, predicted from start numbers that are fitted to them.
    hidden : int
        Nodes of the network.
    most : (float, float), optional
        Bounds of mu_b and mu_s, 1/h; four times the largest mean of an eighth of a batch if None.
    half : float, optional
        Scale of the substrate, g/L, below which rates fall; the tenth percentile of the readings if
        None.
    seed : int
        Seed of the network's initial weights.

    Returns
    -------
    FedBatchFit

    Raises
    ------
    InputError
        If a column is missing, batches have other columns, the biomass never grows, or a name is
        unknown.

    Notes
    -----
    The balances (report eqs 45 and 46, `beamfit.dynamics.balances.advance`) hold exactly; a network
    gives mu = low + (high S/(S + s) - low) sigmoid(net), so that nothing grows or is consumed
    without substrate; low is 0, or negative for mu_b where the batches show that cells die. Product
    is formed in addition, q = bound sigmoid(net) of the cells, and decays (fig 34). All batches run
    free from states that are estimated. The search starts with the rates of stretches of the
    batches that readings alone give. The noise of each output is a share of the value and a floor,
    estimated from the residuals after every round. Each batch has its own factors of the rates,
    whose scatter is estimated likewise.
    """
    runs = (runs,) if isinstance(runs, Run) else tuple(runs)
    own = [n for n in runs[0].inputs if n not in FLOWS]
    names = ("substrate", *own) if points is None else tuple(points)
    for run in (*runs, *held):
        _check(run, runs[0])
        _check_dependences(names, (*STATES, *row_columns(run)), "rates")
        _check_dependences(product, (*RATES, *STATES, *row_columns(run)), "product")
    if half is not None and not half > 0:
        raise InputError(f"half {half:g}", "a substrate above 0, g/L")
    has_titre = all(TITRE in run.outputs for run in (*runs, *held))
    runs, held = ([reorder_inputs(run, runs[0]) for run in each] for each in (runs, held))
    parts = [stretches_of(run) for run in runs]
    like = batch_bounds(runs, parts, most)
    seen = prepare_batches(runs, like, (*STATES, TITRE) if has_titre else STATES)
    first = _rates_model(seen, names, half, hidden, seed)
    first = _match_stretches(first, seen, parts)
    if has_titre:
        first |= _product_model(first, seen, product, hidden, seed)
    (fit, noise, _, spread, _), converged = search_rates(seen, first)
    curves, fitted = curves_of(fit, seen), np.asarray(_fitted(fit.model, seen.batches))
    predictions = {run.name: predict_held_batch(run, like, fit, noise, spread) for run in held}
    found = judge(BatchEvidence(fit, converged, seen, fitted, noise, curves, predictions), RULES)
    spread = dict(zip((*RATES, TITRE), map(float, spread), strict=False))
    return FedBatchFit(found.status, found.message, tuple(runs), seen, fit, curves, noise, spread,
                       predictions)  # fmt: skip


def _check(run: Run, first: Run) -> None:
    needed = [("output", "y", run.outputs, name) for name in STATES]
    needed += [("input", "u", run.inputs, name) for name in ("feed", "feed_substrate")]
    for kind, prefix, has, name in needed:
        if name not in has:
            raise run.unusable(f"no {kind} {name}", f"a column {prefix}_{name}")
    if set(run.inputs) != set(first.inputs):
        raise run.unusable(f"inputs {', '.join(run.inputs)}", f"those of {first.name}")
    for name in ("biomass", "volume"):
        if (low := np.nanmin(run.outputs[name])) < 0 or np.nanmax(run.outputs[name]) == 0:
            raise run.unusable(f"{name} of {low:g}", "values above 0")


def _check_dependences(names: Sequence[str], columns: Sequence[str], what: str) -> None:
    """Refuse names that are no known column of a row."""
    for name in names:
        if name not in columns:
            raise InputError(f"{what} that hang on '{name}'", nearest(name, list(columns)))


def _rates_model(
    seen: PreparedBatches, names: Sequence[str], half: float | None, hidden: int, seed: int
) -> dict[str, Any]:
    """Start model: a network of rates with small random weights."""
    readings = _interpolated_readings(seen)
    s = np.concatenate([x[:, 1] for x in readings])
    half = half or float(np.percentile(s[s > 0], SCALE_PERCENTILE))
    points = [network_inputs(seen.batches, half, x.T[:3], u[: len(x)].T)
              for x, u in zip(readings, np.asarray(seen.batches.u), strict=True)]  # fmt: skip
    points = np.concatenate([np.stack([p[name] for name in names], axis=1) for p in points])
    net = network_of(names, points, RATES, hidden, seed)
    return {"rates": net, "half": half} | start_numbers(seen)


def _interpolated_readings(seen: PreparedBatches) -> list[np.ndarray]:
    """Readings of each batch with gaps interpolated, shape (rows, outputs)."""
    values = np.where(seen.read, seen.measured, np.nan)
    return [np.stack([interpolate_gaps(t, c) for c in x[: len(t)].T], axis=1)
            for x, t in zip(values, seen.time, strict=True)]  # fmt: skip


def start_numbers(seen: PreparedBatches) -> dict[str, np.ndarray]:
    """Numbers at the start of each batch, from the first readings."""
    first = np.array([x[0] for x in _interpolated_readings(seen)])
    floor = 1e-3 * seen.measured.max(axis=(0, 1))
    start = {"start": np.log(np.maximum(first, floor)[:, :3])}
    start |= {"own": np.zeros((len(first), first.shape[1] - 1))}
    return start | ({"begin": first[:, 3]} if first.shape[1] > 3 else {})


def _stretch_rates(model: Any, data: tuple[Batches, Any, Any]) -> jax.Array:
    """Mean rates of stretches at the states that were read."""
    b, x, weight = data
    rates = jax.vmap(jax.vmap(partial(rates_at, b, model)))(x, b.u)
    return jnp.einsum("bsr,brk->bsk", weight, rates)


def _match_stretches(model: Any, seen: PreparedBatches, parts: Sequence[Stretches]) -> Any:
    """Fit the rates of the model to those of the stretches."""
    x = pad_columns([x[:, :3] for x in _interpolated_readings(seen)], seen.batches.dt.shape[1])
    weights = [pad_columns(each.weight, x.shape[1], 0.0) for each in parts]
    weight = pad_columns(weights, STRETCHES, 0.0)
    rates = pad_columns([each.rates for each in parts], STRETCHES, 0.0)
    error = np.broadcast_to(FIRST_NOISE * rates.max(axis=(0, 1)), rates.shape)
    data = seen.batches, jnp.asarray(x), jnp.asarray(weight)
    record = Record("stretches", _stretch_rates, data, rates, error=error)
    free = [Free("rates", nuisance=True)]
    return dict(solve(Problem(model, free, [record], weight_priors("rates"))).model)


def _product_model(
    model: Any, seen: PreparedBatches, names: Sequence[str], hidden: int, seed: int
) -> dict[str, Any]:
    """Product's part of the start model."""
    b, readings = seen.batches, _interpolated_readings(seen)
    largest_rates = [(x[:, 3] * x[:, 2]).max() / np.trapezoid(x[:, 0] * x[:, 2], t)
           for x, t in zip(readings, seen.time, strict=True)]  # fmt: skip
    at_all_rows = jax.jit(jax.vmap(jax.vmap(partial(product_inputs, b, model, names))))
    points = at_all_rows(pad_columns([x[:, :3] for x in readings], b.dt.shape[1]), b.u)
    points = [p[: len(t)] for p, t in zip(np.asarray(points), seen.time, strict=True)]
    if not max(largest_rates) > 0:
        raise InputError("a titre that never rises", "batches that make product")
    net = network_of(names, np.concatenate(points), ["q"], hidden, seed)
    return {"product": net, "most": BOUND_FACTOR * max(largest_rates), "decay": 0.0}


# ---- the search

# Solver steps of a round, after which the noise is estimated anew; largest number of rounds; gain
# in -2 ln L below which they end.
STEPS_PER_ROUND = 60
MAX_ROUNDS = 20
MIN_GAIN = 0.5
# First estimate of the noise, as a share of the values.
FIRST_NOISE = 0.1
# Prior spread between batches of one recipe: cells of another inoculum grow and produce some per
# cent faster or slower.
BATCH_SPREAD = 0.05


class _RatesFit(NamedTuple):
    fit: Fit
    noise: dict[str, ReadingNoise]
    error: np.ndarray
    spread: np.ndarray
    cost: float


def _batch_factors(model: Any, data: Any) -> jax.Array:
    return model["own"]


def search_rates(seen: PreparedBatches, model: Any) -> tuple[_RatesFit, bool]:
    """Search in rounds, each with the noise of the last residuals, until nothing is gained.

    The spread between batches is updated together with the noise by expectation and maximisation:
    the mean of squared factors and their variances, with the prior counted as one more batch. The
    second result is True if the search converged.
    """
    names = (*STATES, TITRE)[: seen.measured.shape[2]]

    def search(model, error, spread):
        free = (*NETWORKS, *START_NUMBERS, "own", "decay")
        fit = solve(problem_of(seen, model, error, free, spread), iterations=STEPS_PER_ROUND)
        y, own = np.asarray(_fitted(fit.model, seen.batches)), fit.derive(_batch_factors)
        residuals = seen.measured - y
        deviation = np.where(np.isfinite(own.error), own.error, spread)
        noise = {name: noise_of(residuals[..., k], y[..., k], seen.read[..., k])
                 for k, name in enumerate(names)}  # fmt: skip
        error = errors_of(noise.values(), y)
        cost = float(np.sum((residuals / error)[seen.read] ** 2 + 2 * np.log(error[seen.read])))
        squares = np.vstack(
            [own.value**2 + deviation**2, np.full((1, len(spread)), BATCH_SPREAD**2)]
        )
        spread = np.sqrt(squares.mean(axis=0))
        return _RatesFit(fit, noise, error, spread, cost)

    # Proportional errors first: with equal errors small values would never count.
    floors = [np.percentile(y[y > 0], SCALE_PERCENTILE) for y in np.moveaxis(seen.measured, 2, 0)]
    noises = [ReadingNoise(FIRST_NOISE, FIRST_NOISE * floor) for floor in floors]
    first = errors_of(noises, seen.measured)
    found, converged = repeat_search(
        search(model, first, np.full(len(names) - 1, BATCH_SPREAD)),
        lambda f: search(f.fit.model, f.error, f.spread),
        MIN_GAIN, MAX_ROUNDS - 1,
    )  # fmt: skip
    return found, converged or found.fit.status is Status.converged


# ---- curves

# A point of a curve is visited if this many rows are within VISIT_DISTANCE of it, and within
# OTHER_DISTANCE in the other inputs of the rates, as shares of their ranges. A curve begins at
# least at this share of its end, as rates without substrate are zero without an error.
MIN_VISITS = 3
OTHER_DISTANCE = 0.5
MIN_SHARE_OF_END = 1e-3


def _rates(model: Any, data: tuple[Any, Any, Any]) -> jax.Array:
    b, x, u = data
    return jax.vmap(partial(rates_at, b, model))(x, u)


_rated = jax.jit(_rates)


def curves_of(fit: Fit, seen: PreparedBatches) -> tuple[Curve, ...]:
    """Curves of each rate against each of its inputs, the others at their means."""
    b = seen.batches
    states = np.asarray(course(fit.model, b))
    rows = np.concatenate([
        np.concatenate([x, u], axis=1)[: len(t)]
        for x, u, t in zip(states, np.asarray(b.u), seen.time, strict=True)
    ])  # fmt: skip
    names, curves = (*STATES, *b.inputs), []
    ranges = np.where(np.ptp(rows, axis=0) > 0, np.ptp(rows, axis=0), 1.0)
    used = [names.index(name) for name in fit.model["rates"].inputs]
    for j in used:
        grid = np.tile(rows.mean(0), (CURVE_POINTS, 1))
        high = rows[:, j].max()
        low = max(rows[:, j].min(), MIN_SHARE_OF_END * high)
        grid[:, j] = at = np.linspace(low, high, CURVE_POINTS)
        limits = np.where(np.arange(len(names)) == j, VISIT_DISTANCE, OTHER_DISTANCE)[used]
        distance = np.abs(rows[None, :, used] - grid[:, None, used]) / ranges[used]
        visited = np.sum(np.all(distance <= limits, axis=2), axis=1) >= MIN_VISITS
        value = fit.derive(_rates, (b, jnp.asarray(grid[:, :3]), jnp.asarray(grid[:, 3:])))
        curves += [Curve(rate, names[j], "1/h", at, value.value[:, i], value.error[:, i], visited)
                 for i, rate in enumerate(RATES)]  # fmt: skip
    return tuple(curves)


# ---- dependence of an output on its inputs


class Ranked(NamedTuple):
    """Dependence of an output on one input.

    `information` is the mutual information in nats, `correlation` that of normal variables with as
    much, sqrt(1 - e^(-2 I)) (E. H. Linfoot, Information and Control 1 (1957) 85).
    """

    name: str
    information: float
    correlation: float


def rank_inputs(rates: FedBatchFit, output: str = TITRE, seed: int = 0) -> tuple[Ranked, ...]:
    """Rank inputs, readings and predictions by their mutual information with an output (fig 32).

    Parameters
    ----------
    rates : FedBatchFit
        The fitted rates.
    output : str
        Name of the output.
    seed : int
        Seed of the noise that breaks ties.

    Returns
    -------
    tuple of Ranked
        Highest information first: inputs, the total feed, other outputs as they were read, and
        ``predicted`` states and rates.

    Raises
    ------
    InputError
        If scikit-learn is not installed, or no batch has the output.

    Notes
    -----
    The estimator of A. Kraskov, H. Stögbauer, P. Grassberger, Phys. Rev. E 69 (2004) 066138, by
    three neighbours, as in scikit-learn. Inputs and outputs that both drift in time seem dependent.
    """
    try:
        from sklearn.feature_selection import mutual_info_regression
    except ImportError:
        expected = "the package scikit-learn; install it with: pip install 'beamfit[mutual]'"
        raise InputError("no scikit-learn", expected) from None
    if any(output not in run.outputs for run in rates.runs):
        raise rates.runs[0].unusable(f"no output {output}", f"a column y_{output}")
    b, parts = rates.seen.batches, []
    for i, (run, t, x) in enumerate(zip(rates.runs, rates.seen.time, rates.courses, strict=True)):
        total = np.append(0.0, np.cumsum(run.inputs["feed"][:-1] * np.diff(t)))
        columns = row_columns(run) | {"total feed": total}
        found = _rated(rates.fit.model, (b, x[:, :3], b.u[i, : len(t)]))
        for name, y in zip((*STATES, *RATES), np.column_stack([x[:, :3], found]).T, strict=True):
            columns[f"predicted {name}"] = y
        read = np.isfinite(run.outputs[output])
        parts.append({k: v[read] for k, v in columns.items()} | {None: run.outputs[output][read]})
    columns_of_all = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    y = columns_of_all.pop(None)
    candidates = {name: v for name, v in columns_of_all.items()
            if np.ptp(v) > 0 and name not in (output, f"measured {output}")}  # fmt: skip
    found = mutual_info_regression(np.stack(list(candidates.values()), 1), y, random_state=seed)
    ranked = [Ranked(n, float(i), float(np.sqrt(-np.expm1(-2 * i))))
              for n, i in zip(candidates, found, strict=True)]  # fmt: skip
    return tuple(sorted(ranked, key=lambda each: -each.information))
