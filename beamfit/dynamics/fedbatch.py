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
from beamfit.dynamics.answer import NEAR, POINTS, WORSE, Curve, search_failed
from beamfit.dynamics.balances import (
    BEYOND,
    FLOWS,
    RATES,
    STATES,
    STRETCHES,
    TITRE,
    Batches,
    PreparedBatches,
    Stretches,
    bounded,
    course,
    filled,
    known_at,
    known_of,
    padded,
    points_at,
    predicted,
    rates_at,
    seen_of,
    stretches_of,
)
from beamfit.dynamics.model import weight_priors
from beamfit.dynamics.record import Run, ordered
from beamfit.dynamics.search import rounds
from beamfit.errors import Finding, InputError, Status, judge, nearest
from beamfit.greybox.fit import Fit
from beamfit.greybox.mlp import MLP, Port, dense
from beamfit.greybox.problem import Free, Prior, Problem, Record
from beamfit.greybox.solve import solve
from beamfit.noise.memory import is_correlated
from beamfit.statistics import POOR_FIT

# Values, in units of the largest, below which a noise that is a share of them stays the same.
FLOORS = np.geomspace(1e-4, 1.0, 13)
# Percentile of the substrates read that is their scale, unless one is told: below it, where little
# was read, rates fall with the substrate.
LOW = 10.0


class ReadingNoise(NamedTuple):
    """Noise of an output: a share of the value, and a floor; the share is 0 of a constant noise."""

    share: float
    floor: float

    def errors(self, values: np.ndarray) -> np.ndarray:
        """Standard deviation of each value."""
        return np.hypot(self.share * values, self.floor)

    def __str__(self) -> str:
        more = f"{100 * self.share:.2g} % of the value and " if self.share else ""
        return f"{more}{self.floor:.2g}"


def noise_of(rest: np.ndarray, fitted: np.ndarray, read: np.ndarray) -> ReadingNoise:
    """The likeliest noise of one output."""
    top, found = max(float(np.max(np.abs(fitted))), 1e-12), []
    for kind in (ReadingNoise(0.0, top), *(ReadingNoise(1.0, top * floor) for floor in FLOORS)):
        unit = kind.errors(fitted)[read]
        size = max(float(np.sqrt(np.mean((rest[read] / unit) ** 2))), 1e-12)
        noise = ReadingNoise(size * kind.share, size * kind.floor)
        found.append((float(np.sum(np.log(size * unit))), noise))
    return min(found, key=lambda each: each[0])[1]


def errors_of(noise: Iterable[ReadingNoise], values: np.ndarray) -> np.ndarray:
    """Standard deviations of values, the outputs last."""
    return np.stack([each.errors(values[..., k]) for k, each in enumerate(noise)], axis=-1)


# Parts of the model: networks, and numbers at the start of each batch.
NETWORKS, BEGINS = ("rates", "product"), ("start", "begin")


def problem_of(
    seen: PreparedBatches, model: Any, error: np.ndarray, free: Sequence[str], spread: Any = 1.0
) -> Problem:
    """State it; `error`, of the shape of the readings, is a guess that they correct.

    `spread` is by how much batches differ, in logarithms of their rates.
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
    """A network of points (n, names) with small random weights, that begins at usual rates."""
    ports = [Port(n, "", 0, float(s) or 1.0, float(m))
             for n, s, m in zip(names, points.std(0), points.mean(0), strict=True)]  # fmt: skip
    outputs = [Port(name, "", 0, 1.0, float(logit(0.5 / BEYOND))) for name in outputs]
    return dense(ports, outputs, [hidden], seed=seed, spread=0.3)


class HeldBatch(NamedTuple):
    """A batch that is only predicted, from a start that fits it.

    `rms` is by output, in its units; `rest` that of all in units of their errors, of noise, model,
    and how batches differ; `inside` the share of readings within the 95 % band, by output.
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


@jax.jit  # op by op, hundreds of small programs are compiled
def ahead(model: Any, asked: tuple[Batches, Mapping[str, Any]]) -> jax.Array:
    """Predict a batch from numbers at its start, shape (1, rows, outputs)."""
    b, begun = asked
    return predicted(model | begun, b)


def forecast(
    fit: Fit, b: Batches, begun: Mapping[str, Any], spread: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """A usual batch, and errors of one that differs as batches do, shape (1, rows, outputs)."""
    usual = jnp.zeros((1, len(spread)))
    found = fit.derive(ahead, (b, {**begun, "own": usual}))
    slope = jax.jacfwd(lambda own: ahead(fit.model, (b, {**begun, "own": own})))(usual)
    differs = np.linalg.norm(np.asarray(slope)[..., 0, :] * spread, axis=-1)
    return found.value, np.hypot(found.error, differs)


def held_back(
    run: Run, like: Batches, fit: Fit, noise: Mapping[str, ReadingNoise], spread: np.ndarray
) -> HeldBatch:
    """Predict a batch of which only the numbers at the start are fitted.

    Substrate that ends falls by decades at once, and an hour too early or late is no noise of the
    smaller value: the larger of what is read and predicted has the error.
    """
    seen = seen_of([run], like, tuple(noise))

    def judged(first):
        value, band = forecast(fit, seen.batches, first, spread)
        error = errors_of(noise.values(), np.maximum(value, seen.measured))
        return value, np.hypot(error, np.nan_to_num(band))

    first = begun(seen)
    problem = problem_of(seen, dict(fit.model) | first, judged(first)[1], BEGINS)
    end = solve(problem).model
    value, error = judged({name: end[name] for name in first})
    rest, rms, inside = value - seen.measured, {}, {}
    off = np.abs(rest) / error
    for k, name in enumerate(noise):
        read = seen.read[..., k]
        rms[name] = float(np.sqrt(np.mean(rest[..., k][read] ** 2)))
        inside[name] = float(np.mean(off[..., k][read] < -ndtri(0.025)))
    whole = float(np.sqrt(np.mean(off[seen.read] ** 2)))
    return HeldBatch(run.name, rms, whole, inside)


# ---- the verdict


class BatchEvidence(NamedTuple):
    """Input of the rules; `fitted` has the shape of the readings."""

    fit: Fit
    rests: bool
    seen: PreparedBatches
    fitted: np.ndarray
    noise: dict[str, ReadingNoise]
    curves: tuple[Curve, ...] = ()
    held: Mapping[str, HeldBatch] = MappingProxyType({})


def _refuted(e: BatchEvidence) -> Finding | None:
    """Find the output of which most is left by residuals that follow one another."""
    lean, found = 1.0 - e.fit.groups[0].dof / int(e.seen.read.sum()), []
    for k, (name, noise) in enumerate(e.noise.items()):
        read = e.seen.read[..., k]
        fitted, top = e.fitted[..., k][read], e.seen.measured[..., k].max()
        rest = e.seen.measured[..., k][read] - fitted
        if is_correlated(rest / noise.errors(fitted), lean * rest.size, -ndtri(POOR_FIT)):
            found.append((rest.std() / top, f"{name}: {rest.std():.2g} of {top:.3g}"))
    if not found:
        return None
    cause = f"Residuals follow one another and are no noise, of {max(found)[1]} is not explained: "
    cause += "the rates hang on something else, or a balance lacks a flow."
    remedy = "Give what else was set or read on line, or more hidden nodes."
    return Finding(Status.poor_fit, cause, remedy)


def _worse(e: BatchEvidence) -> Finding | None:
    bad = {name: held.rest for name, held in e.held.items() if held.rest > WORSE}
    if not bad:
        return None
    name, rest = max(bad.items(), key=lambda each: each[1])
    cause = f"Batch {name}, held back, is {rest:.1f} times its error off."
    return Finding(Status.poor_fit, cause, "Use batches that cover its range, or fewer nodes.")


def _open(e: BatchEvidence) -> Finding | None:
    left = [
        f"{c.parameter}({c.input})"
        for c in e.curves
        if not np.any(np.isfinite(c.error) & c.visited & (c.error < np.abs(c.value)))
    ]
    if not left:
        return None
    cause = f"The batches do not determine {', '.join(left)}."
    return Finding(Status.unidentified, cause, "Add batches that visit more, or read more often.")


def _bounded(e: BatchEvidence) -> Finding | None:
    most = dict(zip(RATES, np.asarray(e.seen.batches.ends[1]), strict=True))
    held = {c.parameter for c in e.curves
            if np.any(c.value[c.visited] > BOUND * most[c.parameter])}  # fmt: skip
    if not held:
        return None
    cause = f"{', '.join(sorted(held))} is held by its bound."
    return Finding(Status.at_limit, cause, "Give higher bounds (most=) if the physics allows.")


def _good(e: BatchEvidence) -> Finding:
    said = ", ".join(f"{name} {noise}" for name, noise in e.noise.items())
    cause = f"The balances follow all batches within noise: {said}."
    never = sorted({c.input for c in e.curves if not c.visited.all()})
    more = f" Parts of the range of {', '.join(never)} were not visited." if never else ""
    return Finding(Status.converged, cause + more)


# Rates above this share of their bound count as at the bound.
BOUND = 0.95
RULES = (search_failed, _refuted, _worse, _open, _bounded, _good)


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
        The same as the model sees them.
    fit : Fit
        The grey-box fit.
    curves : tuple of Curve
        mu_b and mu_s against each thing they hang on, the others at their means, 1/h.
    noise : dict of str to ReadingNoise
        Of biomass, substrate, volume, and titre where it was read.
    spread : dict of str to float
        By how much batches differ in mu_b, mu_s, and the formation of product, as a share.
    held : dict of str to HeldBatch
        How batches are predicted that were held back.
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
        """The answer in a line."""
        points = ", ".join(self.fit.model["rates"].inputs)
        return f"{self.output} {self.status}: of {points}, from {len(self.runs)} batches"

    @property
    def output(self) -> str:
        """Names of what was identified."""
        return "mu_b, mu_s" + ", titre" * (TITRE in self.noise)

    @cached_property
    def courses(self) -> tuple[np.ndarray, ...]:
        """Biomass, substrate, volume and titre at the rows of each batch, shape (rows, outputs)."""
        found = np.asarray(_fitted(self.fit.model, self.seen.batches))
        return tuple(x[: len(t)] for x, t in zip(found, self.seen.time, strict=True))

    @property
    def half(self) -> float:
        """Scale of the substrate, g/L, below which rates fall with it."""
        return float(self.fit.model["half"])

    def tables(self) -> tuple[Table, ...]:
        """All numbers, to be shown."""
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
        What the rates hang on, of states, inputs, outputs that were read on line, and
        ``measured substrate``, ``measured biomass``; the substrate and all inputs that are no flow
        if None.
    product : sequence of str
        What the formation of product hangs on: mu_b, mu_s, and what the rates may hang on.
    held : sequence of Run
        Batches that are only predicted, from numbers at the start that fit them.
    hidden : int
        Nodes of the network.
    most : (float, float), optional
        Bounds of mu_b and mu_s, 1/h; four times the largest that an eighth of a batch shows if
        None.
    half : float, optional
        Scale of the substrate, g/L, below which rates fall with it; the tenth percentile of what
        was read if None.
    seed : int
        Of the network's first weights.

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
    without substrate; low is 0, for mu_b less where the batches show that cells die. On top of them
    product is formed, q = bound sigmoid(net) of the cells, and decays (fig 34). All batches run
    free from states that are estimated. The search begins with the rates that readings alone say of
    stretches of the batches. The noise of each output is a share of the value and a floor, and is
    taken from the residuals after every round. Batches differ: each has its own factors of the
    rates, whose scatter is taken likewise.
    """
    runs = (runs,) if isinstance(runs, Run) else tuple(runs)
    own = [n for n in runs[0].inputs if n not in FLOWS]
    names = ("substrate", *own) if points is None else tuple(points)
    for run in (*runs, *held):
        _check(run, runs[0])
        _check_names(names, (*STATES, *known_of(run)), "rates")
        _check_names(product, (*RATES, *STATES, *known_of(run)), "product")
    if half is not None and not half > 0:
        raise InputError(f"half {half:g}", "a substrate above 0, g/L")
    titred = all(TITRE in run.outputs for run in (*runs, *held))
    runs, held = ([ordered(run, runs[0]) for run in each] for each in (runs, held))
    parts = [stretches_of(run) for run in runs]
    like = bounded(runs, parts, most)
    seen = seen_of(runs, like, (*STATES, TITRE) if titred else STATES)
    first = _first(seen, names, half, hidden, seed)
    first = _matched(first, seen, parts)
    if titred:
        first |= _product(first, seen, product, hidden, seed)
    (fit, noise, _, spread, _), rests = settled(seen, first)
    curves, y = curves_of(fit, seen), np.asarray(_fitted(fit.model, seen.batches))
    told = {run.name: held_back(run, like, fit, noise, spread) for run in held}
    found = judge(BatchEvidence(fit, rests, seen, y, noise, curves, told), RULES)
    spread = dict(zip((*RATES, TITRE), map(float, spread), strict=False))
    return FedBatchFit(found.status, found.message, tuple(runs), seen, fit, curves, noise, spread,
                       told)  # fmt: skip


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


def _check_names(names: Sequence[str], known: Sequence[str], what: str) -> None:
    """Refuse names of nothing that is known of a row."""
    for name in names:
        if name not in known:
            raise InputError(f"{what} that hang on '{name}'", nearest(name, list(known)))


def _first(
    seen: PreparedBatches, names: Sequence[str], half: float | None, hidden: int, seed: int
) -> dict[str, Any]:
    """A model with a network of small random weights."""
    whole = _whole(seen)
    s = np.concatenate([x[:, 1] for x in whole])
    half = half or float(np.percentile(s[s > 0], LOW))
    points = [known_at(seen.batches, half, x.T[:3], u[: len(x)].T)
              for x, u in zip(whole, np.asarray(seen.batches.u), strict=True)]  # fmt: skip
    points = np.concatenate([np.stack([p[name] for name in names], axis=1) for p in points])
    net = network_of(names, points, RATES, hidden, seed)
    return {"rates": net, "half": half} | begun(seen)


def _whole(seen: PreparedBatches) -> list[np.ndarray]:
    """Readings of each batch with straight lines over gaps, shape (rows, outputs)."""
    values = np.where(seen.read, seen.measured, np.nan)
    return [np.stack([filled(t, c) for c in x[: len(t)].T], axis=1)
            for x, t in zip(values, seen.time, strict=True)]  # fmt: skip


def begun(seen: PreparedBatches) -> dict[str, np.ndarray]:
    """The numbers at the start of each batch, as first read."""
    first = np.array([x[0] for x in _whole(seen)])
    floor = 1e-3 * seen.measured.max(axis=(0, 1))
    start = {"start": np.log(np.maximum(first, floor)[:, :3])}
    start |= {"own": np.zeros((len(first), first.shape[1] - 1))}
    return start | ({"begin": first[:, 3]} if first.shape[1] > 3 else {})


def _stretched(model: Any, asked: tuple[Batches, Any, Any]) -> jax.Array:
    """Mean rates of stretches at the states that were read."""
    b, x, weight = asked
    rates = jax.vmap(jax.vmap(partial(rates_at, b, model)))(x, b.u)
    return jnp.einsum("bsr,brk->bsk", weight, rates)


def _matched(model: Any, seen: PreparedBatches, parts: Sequence[Stretches]) -> Any:
    """The model whose rates are those of the stretches, as well as it can."""
    x = padded([x[:, :3] for x in _whole(seen)], seen.batches.dt.shape[1])
    weight = padded([padded(each.weight, x.shape[1], 0.0) for each in parts], STRETCHES, 0.0)
    rates = padded([each.rates for each in parts], STRETCHES, 0.0)
    error = np.broadcast_to(FIRST * rates.max(axis=(0, 1)), rates.shape)
    data = seen.batches, jnp.asarray(x), jnp.asarray(weight)
    record = Record("stretches", _stretched, data, rates, error=error)
    free = [Free("rates", nuisance=True)]
    return dict(solve(Problem(model, free, [record], weight_priors("rates"))).model)


def _product(
    model: Any, seen: PreparedBatches, names: Sequence[str], hidden: int, seed: int
) -> dict[str, Any]:
    """The product's part of the model a search begins with."""
    b, whole = seen.batches, _whole(seen)
    top = [(x[:, 3] * x[:, 2]).max() / np.trapezoid(x[:, 0] * x[:, 2], t)
           for x, t in zip(whole, seen.time, strict=True)]  # fmt: skip
    every = jax.jit(jax.vmap(jax.vmap(partial(points_at, b, model, names))))
    points = every(padded([x[:, :3] for x in whole], b.dt.shape[1]), b.u)
    points = [p[: len(t)] for p, t in zip(np.asarray(points), seen.time, strict=True)]
    if not max(top) > 0:
        raise InputError("a titre that never rises", "batches that make product")
    net = network_of(names, np.concatenate(points), ["q"], hidden, seed)
    return {"product": net, "most": BEYOND * max(top), "decay": 0.0}


# ---- the search

# Steps of a round, after which the noise is estimated again; most rounds; gain in -2 ln L below
# which they end.
STEPS, ROUNDS, GAINED = 60, 20, 0.5
# First estimate of the noise, as a share of the values; how batches of one recipe differ, as far as
# nothing is known: cells of another inoculum grow and produce some per cent faster or slower.
FIRST, DIFFER = 0.1, 0.05


class _Searched(NamedTuple):
    fit: Fit
    noise: dict[str, ReadingNoise]
    error: np.ndarray
    spread: np.ndarray
    likelihood: float


def _own(model: Any, data: Any) -> jax.Array:
    return model["own"]


def settled(seen: PreparedBatches, model: Any) -> tuple[_Searched, bool]:
    """Search in rounds, each with the noise of the last one's residuals, until nothing is gained.

    With the noise, by how much batches differ is taken from the round before (expectation and
    maximisation: their squares and those of their errors, with the prior's worth one batch more).
    The last value says whether the search rests.
    """
    names = (*STATES, TITRE)[: seen.measured.shape[2]]

    def search(model, error, spread):
        free = (*NETWORKS, *BEGINS, "own", "decay")
        fit = solve(problem_of(seen, model, error, free, spread), iterations=STEPS)
        y, own = np.asarray(_fitted(fit.model, seen.batches)), fit.derive(_own)
        rest, known = seen.measured - y, np.where(np.isfinite(own.error), own.error, spread)
        noise = {name: noise_of(rest[..., k], y[..., k], seen.read[..., k])
                 for k, name in enumerate(names)}  # fmt: skip
        error = errors_of(noise.values(), y)
        minus = float(np.sum((rest / error)[seen.read] ** 2 + 2 * np.log(error[seen.read])))
        each = np.vstack([own.value**2 + known**2, np.full((1, len(spread)), DIFFER**2)])
        spread = np.sqrt(each.mean(axis=0))
        return _Searched(fit, noise, error, spread, minus)

    # Begun as a share of the values: where all errors are alike, small values are never looked at.
    low = [np.percentile(y[y > 0], LOW) for y in np.moveaxis(seen.measured, 2, 0)]
    first = errors_of([ReadingNoise(FIRST, FIRST * each) for each in low], seen.measured)
    found, rests = rounds(
        search(model, first, np.full(len(names) - 1, DIFFER)),
        lambda f: search(f.fit.model, f.error, f.spread),
        GAINED, ROUNDS - 1,
    )  # fmt: skip
    return found, rests or found.fit.status is Status.converged


# ---- curves

# A point of a curve is visited if this many rows are NEAR it, and in the other inputs of the rates
# within this share of their range. A curve begins at this share of its end.
VISITS, BESIDE, LEAST = 3, 0.5, 1e-3


def _rates(model: Any, asked: tuple[Any, Any, Any]) -> jax.Array:
    b, x, u = asked
    return jax.vmap(partial(rates_at, b, model))(x, u)


_rated = jax.jit(_rates)


def curves_of(fit: Fit, seen: PreparedBatches) -> tuple[Curve, ...]:
    """Each rate against each thing it hangs on, the others at their means."""
    b = seen.batches
    found = np.asarray(course(fit.model, b))
    rows = np.concatenate([
        np.concatenate([x, u], axis=1)[: len(t)]
        for x, u, t in zip(found, np.asarray(b.u), seen.time, strict=True)
    ])  # fmt: skip
    names, made = (*STATES, *b.inputs), []
    wide = np.where(np.ptp(rows, axis=0) > 0, np.ptp(rows, axis=0), 1.0)
    own = [names.index(name) for name in fit.model["rates"].inputs]
    for j in own:
        grid = np.tile(rows.mean(0), (POINTS, 1))
        high = rows[:, j].max()  # of no substrate rates are nothing, without an error
        grid[:, j] = at = np.linspace(max(rows[:, j].min(), LEAST * high), high, POINTS)
        near = np.where(np.arange(len(names)) == j, NEAR, BESIDE)[own]
        apart = np.abs(rows[None, :, own] - grid[:, None, own]) / wide[own]
        visited = np.sum(np.all(apart <= near, axis=2), axis=1) >= VISITS
        value = fit.derive(_rates, (b, jnp.asarray(grid[:, :3]), jnp.asarray(grid[:, 3:])))
        made += [Curve(rate, names[j], "1/h", at, value.value[:, i], value.error[:, i], visited)
                 for i, rate in enumerate(RATES)]  # fmt: skip
    return tuple(made)


# ---- what an output hangs on


class Ranked(NamedTuple):
    """Dependence of an output on one input: mutual information in nats, and the correlation of
    normal variables with as much, sqrt(1 - e^(-2 I)) (E. H. Linfoot, Information and Control 1
    (1957) 85).
    """

    name: str
    information: float
    correlation: float


def rank_inputs(rates: FedBatchFit, output: str = TITRE, seed: int = 0) -> tuple[Ranked, ...]:
    """Rank what was set, read and predicted by its mutual information with an output (fig 32).

    Parameters
    ----------
    rates : FedBatchFit
        The first stage.
    output : str
        Of the batches.
    seed : int
        Of the noise that breaks ties.

    Returns
    -------
    tuple of Ranked
        The most telling first: inputs, the total feed, other outputs as they were read, and
        ``predicted`` states and rates.

    Raises
    ------
    InputError
        If scikit-learn is not installed, or no batch has the output.

    Notes
    -----
    The estimator of A. Kraskov, H. Stögbauer, P. Grassberger, Phys. Rev. E 69 (2004) 066138, by
    three neighbours, as scikit-learn has it. Inputs that move with time tell an output that does.
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
        columns = known_of(run) | {"total feed": total}
        found = _rated(rates.fit.model, (b, x[:, :3], b.u[i, : len(t)]))
        for name, y in zip((*STATES, *RATES), np.column_stack([x[:, :3], found]).T, strict=True):
            columns[f"predicted {name}"] = y
        read = np.isfinite(run.outputs[output])
        parts.append({k: v[read] for k, v in columns.items()} | {None: run.outputs[output][read]})
    whole = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    y = whole.pop(None)
    told = {name: v for name, v in whole.items()
            if np.ptp(v) > 0 and name not in (output, f"measured {output}")}  # fmt: skip
    found = mutual_info_regression(np.stack(list(told.values()), 1), y, random_state=seed)
    ranked = [Ranked(n, float(i), float(np.sqrt(-np.expm1(-2 * i))))
              for n, i in zip(told, found, strict=True)]  # fmt: skip
    return tuple(sorted(ranked, key=lambda each: -each.information))
