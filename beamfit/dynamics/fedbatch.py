"""Rates of a fed-batch process, identified from batches: search, noise, bands, verdict."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.answer import answer
from beamfit.dynamics.answer import NEAR, POINTS, WORSE, Curve
from beamfit.dynamics.balances import (
    FLOWS,
    RATES,
    STATES,
    PreparedBatches,
    bounds_of,
    course,
    filled,
    known_at,
    network_of,
    rates_at,
    seen_of,
    state,
)
from beamfit.dynamics.record import Run, ordered
from beamfit.dynamics.search import rounds
from beamfit.errors import InputError, nearest
from beamfit.greybox.fit import Fit
from beamfit.greybox.problem import Free, Problem
from beamfit.greybox.solve import solve
from beamfit.status import Status
from beamfit.table import Table, json_of
from beamfit.verdict import Finding, judge

# Floor of a relative noise, as a share of the one at the largest value.
FLOOR = 0.05
# Standard errors beyond which neighbouring residuals are correlated (p < 1e-3).
ALIKE = 3.1
# Rates above this share of their bound count as at the bound.
BOUND = 0.95


class ReadingNoise(NamedTuple):
    """Noise of an output: a share of the value where `relative`, else the same everywhere."""

    size: float
    relative: bool

    def errors(self, values: np.ndarray) -> np.ndarray:
        """Standard deviation of each value."""
        if not self.relative:
            return np.full_like(values, self.size)
        return self.size * np.hypot(values, FLOOR * np.max(np.abs(values)))

    def __str__(self) -> str:
        return f"{100 * self.size:.2g} % of the value" if self.relative else f"{self.size:.3g}"


def noise_of(rest: np.ndarray, fitted: np.ndarray, read: np.ndarray) -> ReadingNoise:
    """The noise of one output, of the kind that is likelier."""
    found = []
    for relative in (False, True):
        unit = ReadingNoise(1.0, relative).errors(fitted)[read]
        size = max(float(np.sqrt(np.mean((rest[read] / unit) ** 2))), 1e-12)
        found.append((float(np.sum(np.log(size * unit))), ReadingNoise(size, relative)))
    return min(found, key=lambda each: each[0])[1]


class RateEvidence(NamedTuple):
    """Input of the rules; `fitted` has the shape of the readings."""

    fit: Fit
    rests: bool
    seen: PreparedBatches
    fitted: np.ndarray
    noise: dict[str, ReadingNoise]
    curves: tuple[Curve, ...] = ()
    held: Mapping[str, float] = MappingProxyType({})


def _lost(e: RateEvidence) -> Finding | None:
    if e.rests and e.fit.status is not Status.not_finite:
        return None
    lost = e.fit.status is Status.not_finite
    return Finding(Status.not_finite if lost else Status.not_converged, e.fit.message)


def _open(e: RateEvidence) -> Finding | None:
    left = [f"{c.parameter}({c.input})" for c in e.curves
            if not np.any(np.isfinite(c.error) & c.visited & (c.error < c.value))]  # fmt: skip
    if not left:
        return None
    cause = f"The batches do not determine {', '.join(left)}."
    return Finding(Status.unidentified, cause, "Add batches that visit more, or read more often.")


def _bounded(e: RateEvidence) -> Finding | None:
    most = dict(zip(RATES, np.asarray(e.seen.batches.most), strict=True))
    held = {c.parameter for c in e.curves
            if np.any(c.value[c.visited] > BOUND * most[c.parameter])}  # fmt: skip
    if not held:
        return None
    cause = f"{', '.join(sorted(held))} is held by its bound."
    return Finding(Status.at_limit, cause, "Give higher bounds (most=) if the physics allows.")


def _refuted(e: RateEvidence) -> Finding | None:
    """Residuals that follow one another; those of free numbers fitted to them lean away."""
    follow, squares, count = np.zeros(len(e.noise)), np.zeros(len(e.noise)), 0
    for k, noise in enumerate(e.noise.values()):
        rest = (e.seen.measured - e.fitted)[..., k] / noise.errors(e.fitted[..., k])
        each = [r[ok] for r, ok in zip(rest, e.seen.read[..., k], strict=True)]
        follow[k] = sum(float(r[1:] @ r[:-1]) for r in each)
        squares[k], count = sum(float(r @ r) for r in each), count + sum(map(len, each))
    alike = follow.sum() / squares.sum() + 1.0 - e.fit.groups[0].dof / count
    if alike * np.sqrt(count) < ALIKE:
        return None
    name = list(e.noise)[int(np.argmax(follow / squares))]
    cause = (
        f"Residuals follow one another (correlation of neighbours {alike:.2f}), of {name} most: "
        "the rates hang on something else, or a balance lacks a flow."
    )
    remedy = "Give what else was set as an input, or more hidden nodes."
    return Finding(Status.poor_fit, cause, remedy)


def _worse(e: RateEvidence) -> Finding | None:
    bad = {name: r for name, r in e.held.items() if r > WORSE}
    if not bad:
        return None
    name, rest = max(bad.items(), key=lambda each: each[1])
    cause = f"Batch {name}, held back, is predicted with {rest:.1f} times the noise."
    return Finding(Status.poor_fit, cause, "Use batches that cover its range, or fewer nodes.")


def _good(e: RateEvidence) -> Finding:
    said = ", ".join(f"{name} {noise}" for name, noise in e.noise.items())
    cause = f"The balances follow all batches within noise: {said}."
    never = sorted({c.input for c in e.curves if not c.visited.all()})
    more = f" Parts of the range of {', '.join(never)} were not visited." if never else ""
    return Finding(Status.converged, cause + more)


RULES = (_lost, _open, _bounded, _refuted, _worse, _good)


# Steps of a round, after which the noise is estimated again; most rounds; gain in -2 ln L below
# which they end.
STEPS, ROUNDS, GAINED = 60, 8, 0.5
# First estimate of the noise, as a share of the values.
FIRST = 0.1
# A point of a curve is visited if this many rows are NEAR it, and in the other inputs of the rates
# within this share of their range. A curve begins at this share of its end.
VISITS, BESIDE, LEAST = 3, 0.5, 1e-3


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
        Of biomass, substrate and volume.
    held : dict of str to float
        Residual of each batch that was held back, rms in units of the noise.
    """

    status: Status
    message: str
    runs: tuple[Run, ...]
    seen: PreparedBatches
    fit: Fit
    curves: tuple[Curve, ...]
    noise: dict[str, ReadingNoise]
    held: dict[str, float]

    @property
    def headline(self) -> str:
        """The answer in a line."""
        points = ", ".join(self.fit.model["rates"].inputs)
        return f"mu_b, mu_s {self.status}: of {points}, from {len(self.runs)} batches"

    @cached_property
    def courses(self) -> tuple[np.ndarray, ...]:
        """Biomass, substrate and volume at the rows of each batch, shape (rows, 3)."""
        found = np.asarray(course(self.fit.model, self.seen.batches))
        return tuple(x[: len(t)] for x, t in zip(found, self.seen.time, strict=True))

    def tables(self) -> tuple[Table, ...]:
        """All numbers, to be shown."""
        rows = [[f"noise of {name}", str(noise)] for name, noise in self.noise.items()]
        rows += [[f"bound of {r}", f"{m:.3g} 1/h"]
                 for r, m in zip(RATES, self.seen.batches.most, strict=True)]  # fmt: skip
        rows += [[f"{n} held back", f"residual {r:.2f} times the noise"]
                 for n, r in self.held.items()]  # fmt: skip
        return (Table("fed-batch", [], rows), *(curve.table() for curve in self.curves))

    def to_json(self) -> dict[str, Any]:
        """Give one entry of ``results`` in the JSON contract."""
        return json_of(
            {"output": "rates", "status": self.status, "message": self.message}
            | {"model": "fed-batch", "map": "network"}
            | {"records": [run.path or run.name for run in self.runs]}
            | {"curves": [curve.to_json() for curve in self.curves]}
            | {"noise": {name: noise._asdict() for name, noise in self.noise.items()}}
            | {"held_back": self.held}
        )


def identify_batches(
    runs: Run | Sequence[Run],
    *,
    points: Sequence[str] | None = None,
    held: Sequence[Run] = (),
    hidden: int = 5,
    most: tuple[float, float] | None = None,
    seed: int = 0,
) -> FedBatchFit:
    """Identify the rates of a fed-batch process.

    Parameters
    ----------
    runs : Run or sequence of Run
        Batches, of any lengths: outputs ``biomass`` and ``substrate`` in g/L and ``volume`` in L,
        NaN where nothing was read; inputs ``feed`` in L/h and ``feed_substrate`` in g/L, optionally
        ``outflow`` in L/h, and whatever else was set.
    points : sequence of str, optional
        What the rates hang on, of states and inputs; the substrate and all inputs that are no
        flow if None.
    held : sequence of Run
        Batches that are only predicted, from states at the start that fit them.
    hidden : int
        Nodes of the network.
    most : (float, float), optional
        Bounds of mu_b and mu_s, 1/h; twice the largest that an eighth of a batch shows if None.
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
    The balances (report eqs 45 and 46, `beamfit.dynamics.balances.balances`) hold exactly; a
    network gives mu = bound S/(S + s) sigmoid(net), so that rates are never negative, bounded, and
    nothing without substrate. All batches run free from states that are estimated. The noise of
    each output is the same everywhere or a share of the value, whichever is likelier, and is taken
    from the residuals after every round.
    """
    runs = (runs,) if isinstance(runs, Run) else tuple(runs)
    for run in (*runs, *held):
        _check(run, runs[0])
    runs, held = ([ordered(run, runs[0]) for run in each] for each in (runs, held))
    own = [n for n in runs[0].inputs if n not in FLOWS]
    names = ("substrate", *own) if points is None else tuple(points)
    check_names(names, (*STATES, *runs[0].inputs), "rates")
    seen = seen_of(runs, bounds_of(runs, most))
    fit, noise, rests = settled(seen, _first(seen, names, hidden, seed))
    curves = curves_of(fit, seen)
    ahead = {run.name: _held_back(run, seen, fit, noise) for run in held}
    y = np.asarray(course(fit.model, seen.batches))
    found = judge(RateEvidence(fit, rests, seen, y, noise, curves, ahead), RULES)
    return FedBatchFit(found.status, found.message, tuple(runs), seen, fit, curves, noise, ahead)


def _check(run: Run, first: Run) -> None:
    for kind, has, needs in (
        ("output", run.outputs, STATES),
        ("input", run.inputs, ("feed", "feed_substrate")),
    ):
        missing = [name for name in needs if name not in has]
        if missing:
            prefix = "y" if kind == "output" else "u"
            raise run.unusable(f"no {kind} {missing[0]}", f"a column {prefix}_{missing[0]}")
    if set(run.inputs) != set(first.inputs):
        raise run.unusable(f"inputs {', '.join(run.inputs)}", f"those of {first.name}")
    for name in ("biomass", "volume"):
        if (low := np.nanmin(run.outputs[name])) < 0 or np.nanmax(run.outputs[name]) == 0:
            raise run.unusable(f"{name} of {low:g}", "values above 0")


def check_names(names: Sequence[str], known: Sequence[str], what: str) -> None:
    """Refuse names that are neither states nor inputs."""
    for name in names:
        if name not in known:
            raise InputError(f"{what} that hang on '{name}'", nearest(name, list(known)))


def _first(seen: PreparedBatches, names: Sequence[str], hidden: int, seed: int) -> dict[str, Any]:
    """The model a search begins with: rates of half their bounds, states as first read."""
    b, start, points = seen.batches, [], []
    values = np.where(seen.read, seen.measured, np.nan)
    for x, u, t in zip(values, np.asarray(b.u), seen.time, strict=True):
        whole = np.stack([filled(t, c) for c in x[: len(t)].T])
        known = known_at(b, whole, u[: len(t)].T)
        points.append(np.stack([known[name] for name in names], axis=1))
        start.append(whole[:, 0])
    net = network_of(names, np.concatenate(points), RATES, hidden, seed)
    floor = 1e-3 * np.nanmax(values, axis=(0, 1))
    return {"rates": net, "start": np.log(np.maximum(start, floor))}


# ---- the search


class _Searched(NamedTuple):
    fit: Fit
    model: Any
    noise: list[ReadingNoise]
    error: np.ndarray
    likelihood: float


def _errors(noise: Iterable[ReadingNoise], values: np.ndarray) -> np.ndarray:
    return np.stack([each.errors(values[..., k]) for k, each in enumerate(noise)], axis=-1)


def settled(
    seen: PreparedBatches,
    model: Any,
    stated: Callable[..., Problem] = state,
    fitted: Callable[..., jax.Array] = course,
    names: Sequence[str] = STATES,
) -> tuple[Fit, dict[str, ReadingNoise], bool]:
    """Search in rounds, each with the noise of the last one's residuals, until nothing is gained.

    The third value tells whether the search rests.
    """

    def search(model, error):
        fit = solve(stated(seen, model, error), iterations=STEPS)
        model = jax.tree_util.tree_map(np.asarray, fit.model)
        y = np.asarray(fitted(model, seen.batches))
        rest = seen.measured - y
        noise = [noise_of(rest[..., k], y[..., k], seen.read[..., k]) for k in range(len(names))]
        error = _errors(noise, y)
        minus = float(np.sum((rest / error)[seen.read] ** 2 + 2 * np.log(error[seen.read])))
        return _Searched(fit, model, noise, error, minus)

    # Begun as a share of the values: where all errors are alike, small values are never looked at.
    found = search(model, _errors([ReadingNoise(FIRST, True)] * len(names), seen.measured))
    found, rests = rounds(found, lambda f: search(f.model, f.error), GAINED, ROUNDS - 1)
    rests |= found.fit.status is Status.converged
    return found.fit, dict(zip(names, found.noise, strict=True)), rests


# ---- curves


def _rates(model: Any, asked: tuple[Any, Any, Any]) -> jax.Array:
    b, x, u = asked
    return jax.vmap(lambda x, u: rates_at(b, model["rates"], x, u))(x, u)


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


def _held_back(run: Run, seen: PreparedBatches, fit: Fit, noise: dict[str, ReadingNoise]) -> float:
    """Rms residual, over the noise, of a batch of which only the states at the start are fitted."""
    own, net = seen_of([run], seen.batches), fit.model["rates"]
    model = _first(own, net.inputs, 1, 0) | {"rates": net}
    error = _errors(noise.values(), own.measured)
    stated = state(own, model, error)
    end = solve(Problem(stated.model, [Free("start", nuisance=True)], stated.records))
    rest = (np.asarray(course(end.model, own.batches)) - own.measured) / error
    return float(np.sqrt(np.mean(rest[own.read] ** 2)))
