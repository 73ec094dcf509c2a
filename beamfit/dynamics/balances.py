"""Mass balances of a fed-batch process (report eqs 45 and 46), and batches as the model sees them.

Concentrations are in g/L, volumes in L, times in h; rates are per gram of biomass.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.compile_cache import prepare_jax
from beamfit.dynamics.model import weight_priors
from beamfit.dynamics.record import Run
from beamfit.dynamics.states import StateSpace
from beamfit.greybox import tree
from beamfit.greybox.mlp import MLP, Port, dense
from beamfit.greybox.problem import Free, Problem, Record
from beamfit.quantity import HOUR

prepare_jax()


class Flow(NamedTuple):
    """Flows of the vessel: feed and outflow in L/h, substrate in the feed in g/L."""

    feed: jax.Array
    fed: jax.Array
    out: jax.Array


def balances(x: jax.Array, rates: jax.Array, flow: Flow) -> jax.Array:
    """Slopes of biomass, substrate and volume.

    Parameters
    ----------
    x : array, shape (3,)
        Biomass X and substrate S in g/L, volume V in L.
    rates : array, shape (2,)
        Growth mu_b and consumption mu_s, both per gram of biomass, 1/h.
    flow : Flow
        The feed brings no biomass; what runs out has the concentrations inside.

    Returns
    -------
    jax.Array, shape (3,)
        Per hour.

    Notes
    -----
    Report eqs 45 and 46, accumulation = in - out + generation, are balances of the masses X V and
    S V: (X V)' = mu_b X V - out X, (S V)' = feed S_f - out S - mu_s X V. With V' = feed - out the
    outflow leaves the concentrations. The report multiplies mu_s by the substrate; a rate of
    consumption is one of the cells, so that it is of the biomass here.

    Examples
    --------
    >>> flow = Flow(jnp.array(0.1), jnp.array(200.0), jnp.array(0.0))
    >>> print(balances(jnp.array([2.0, 5.0, 4.0]), jnp.array([0.2, 0.4]), flow))
    [0.35  4.075 0.1  ]
    """
    thinned = flow.feed / x[2]
    return jnp.stack(
        [
            (rates[0] - thinned) * x[0],
            thinned * (flow.fed - x[1]) - rates[1] * x[0],
            flow.feed - flow.out,
        ]
    )


def titre_of(
    begin: jax.Array, made: jax.Array, x: jax.Array, out: jax.Array, dt: jax.Array
) -> jax.Array:
    """Titre along a course: the mass of product, (P V)' = q X V - out P, over the volume.

    Parameters
    ----------
    begin : array, shape ()
        Titre at the first point, g/L.
    made : array, shape (2, n)
        Product formed, q, per gram of biomass, 1/h: from each point on, and just before the next.
    x : array, shape (n, 3)
        Biomass, substrate, volume.
    out : array, shape (n,)
        Outflow until the next point, L/h.
    dt : array, shape (n,)
        Time to the next point, h; the last is not used.

    Returns
    -------
    jax.Array, shape (n,)
        By the trapezoidal rule: with kept(t) = exp(-∫ out/V), P V = kept (P0 V0 + ∫ q X V/kept).

    Examples
    --------
    >>> x = jnp.tile(jnp.array([10.0, 1.0, 4.0]), (3, 1))
    >>> titre_of(jnp.array(1.0), jnp.full((2, 3), 0.1), x, jnp.zeros(3), jnp.ones(3)).tolist()
    [1.0, 2.0, 3.0]
    """
    mass, dt, start = x[:, 0] * x[:, 2], dt[:-1], jnp.zeros(1)
    lost = 0.5 * out[:-1] * dt * (1.0 / x[:-1, 2] + 1.0 / x[1:, 2])
    lost = jnp.concatenate([start, jnp.cumsum(lost)])
    grown = mass * jnp.exp(lost)
    gained = 0.5 * dt * (made[0, :-1] * grown[:-1] + made[1, :-1] * grown[1:])
    whole = begin * x[0, 2] + jnp.concatenate([start, jnp.cumsum(gained)])
    return jnp.exp(-lost) * whole / x[:, 2]


STATES = ("biomass", "substrate", "volume")
RATES = ("mu_b", "mu_s")
# Inputs that are no operating point but flows: of liquid, and what it brings.
FLOWS = ("feed", "feed_substrate", "outflow")
# Upper bound of a rate, in units of the largest one of any of this many stretches of a batch.
ABOVE, STRETCHES = 2.0, 8
# Percentile of the substrate that serves as its scale; shares of it below which consumption slows
# down, and below which all rates fall in proportion.
USUAL, SHORT, LITTLE = 90.0, 0.1, 0.01
# Longest step of the integration in units of the shortest time of consumption (the method is stable
# to 2.8), and most steps in a row of data.
STABLE, MOST_STEPS = 2.0, 64
# Batches are padded to a multiple of this many rows, so that they share compiled code.
PADDED = 32


@tree.node("inputs", "steps")
class Batches:
    """Batches as the model sees them, padded to one length.

    `steps` is how many steps of the integration a row has. `u` (batches, rows, inputs) holds from
    row to row, `flow` likewise (batches, rows); `dt` (batches, rows) is the time to the next row in
    h, 0 in the padding. `most` (2,) bounds the rates; far below `little` they fall with the
    substrate.
    """

    inputs: tuple[str, ...]
    steps: int
    u: Any
    flow: Any
    dt: Any
    most: Any
    little: Any


class PreparedBatches(NamedTuple):
    """Batches with what was read: `measured` and `read`, shape (batches, rows, outputs)."""

    batches: Batches
    measured: np.ndarray
    read: np.ndarray
    time: tuple[np.ndarray, ...]


def known_at(b: Batches, x: Any, u: Any) -> dict[str, Any]:
    """Inputs of the networks by name: states, with the substrate's logarithm, and batch inputs.

    In the logarithm both ends of Monod's and Haldane's curves are equally smooth.
    """
    known = dict(zip((*STATES, *b.inputs), [*x, *u], strict=True))
    return known | {"substrate": jnp.log(jnp.maximum(x[1], 0.0) + b.little)}


def rates_at(b: Batches, net: Any, x: jax.Array, u: jax.Array) -> jax.Array:
    """Rates at a state, shape (2,): never negative, nothing without substrate, at most `most`."""
    known = known_at(b, x, u)
    level = net.values(jnp.stack([known[name] for name in net.inputs]))
    substrate = jnp.maximum(x[1], 0.0)
    return b.most * substrate / (substrate + b.little) * jax.nn.sigmoid(level)


def course(model: Any, b: Batches) -> jax.Array:
    """States at the rows of each batch, shape (batches, rows, 3), from the start of each."""

    def slope(x, now, p):
        u, *flow = now  # the network is in a tuple: a p that is a map is called with u
        return balances(x, rates_at(b, p[0], x, u), Flow(*flow))

    plant = StateSpace(slope, lambda x, u, p: x, parts=b.steps)

    def one(start, u, flow, dt):
        return plant.run((model["rates"],), (u, *flow), dt, start)[0]

    return jax.vmap(one)(jnp.exp(model["start"]), b.u, b.flow, b.dt)


def padded(columns: Sequence[np.ndarray], n: int, last: float | None = None) -> np.ndarray:
    """Columns of several lengths as one array; the last value is held unless another is given."""
    ends = [np.full_like(c[-1:], c[-1:] if last is None else last) for c in columns]
    return np.stack([np.concatenate([c, np.repeat(e, n - len(c), axis=0)])
                     for c, e in zip(columns, ends, strict=True)])  # fmt: skip


def batches_of(
    times: Sequence[np.ndarray], inputs: Sequence[Mapping[str, np.ndarray]], like: Batches
) -> Batches:
    """Batches by their times (h) and inputs, with names and bounds of others, and their steps."""
    n = -(-max(map(len, times)) // PADDED) * PADDED
    dt = np.stack([np.pad(np.diff(t), (0, n + 1 - len(t))) for t in times])
    finer = 1.0 if like.dt is None else float(dt.max()) / float(np.max(like.dt))

    def column(name: str) -> np.ndarray:
        return padded([np.broadcast_to(u.get(name, 0.0), t.shape).astype(float)
                       for u, t in zip(inputs, times, strict=True)], n)  # fmt: skip

    u = np.stack([column(name) for name in like.inputs], axis=-1)
    flow = Flow(*(jnp.asarray(column(name)) for name in FLOWS))
    steps = _power_of_two(like.steps * finer)
    return Batches(like.inputs, steps, jnp.asarray(u), flow, jnp.asarray(dt), like.most,
                   like.little)  # fmt: skip


def _power_of_two(steps: float) -> int:
    return int(np.clip(2.0 ** np.ceil(np.log2(steps)), 1, MOST_STEPS))


def bounds_of(runs: Sequence[Run], most: tuple[float, float] | None) -> Batches:
    """Names, bounds and steps of batches, without any rows."""
    largest, usual, crowd = _sizes(runs)
    most = ABOVE * largest if most is None else np.asarray(most, float)
    apart = max(float(np.max(np.diff(run.time))) for run in runs) / HOUR
    steps = _power_of_two(apart * most[1] * crowd / (SHORT * usual) / STABLE)
    little = jnp.asarray(LITTLE * usual)
    return Batches(tuple(runs[0].inputs), steps, None, None, None, jnp.asarray(most), little)


def seen_of(runs: Sequence[Run], like: Batches) -> PreparedBatches:
    """Batches as the model sees them, like others."""
    hours = tuple((run.time - run.time[0]) / HOUR for run in runs)
    batches = batches_of(hours, [run.inputs for run in runs], like)
    read = [np.stack([run.outputs[s] for s in STATES], axis=1) for run in runs]
    measured = padded(read, batches.dt.shape[1], np.nan)
    return PreparedBatches(batches, np.nan_to_num(measured), np.isfinite(measured), hours)


def _sizes(runs: Sequence[Run]) -> tuple[np.ndarray, float, float]:
    """Largest rates that stretches of a batch show, usual high substrate, most biomass."""
    found, substrates, crowd = [], [], 0.0
    for run in runs:
        t = run.time / HOUR
        x, s, v = (filled(t, run.outputs[name]) for name in STATES)
        feed, fed, out = (run.inputs.get(name, np.zeros(len(t))) for name in FLOWS)
        brought = np.append(0.0, np.cumsum((feed * fed - out * s)[:-1] * np.diff(t)))
        gone = np.append(0.0, np.cumsum((out * x)[:-1] * np.diff(t)))
        ends = np.unique(np.linspace(0, len(t) - 1, STRETCHES + 1).round().astype(int))
        cells = np.maximum(x * v, 1e-9)
        lived = np.append(0.0, np.cumsum(0.5 * (cells[1:] + cells[:-1]) * np.diff(t)))[ends]
        made, used = np.diff((cells + gone)[ends]), -np.diff((s * v - brought)[ends])
        found.append(np.stack([made, used]) / np.diff(lived))
        substrates.append(s)
        crowd = max(crowd, float(x.max()))
    largest = np.max(np.concatenate(found, axis=1), axis=1)
    if not np.all(largest > 0):
        raise runs[0].unusable("biomass that never grows on substrate", "a batch that does")
    return largest, float(np.percentile(np.concatenate(substrates), USUAL)), crowd


def filled(t: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Readings with straight lines over gaps."""
    read = np.isfinite(y)
    return np.interp(t, t[read], y[read])


def network_of(
    names: Sequence[str], points: np.ndarray, outputs: Sequence[str], hidden: int, seed: int
) -> MLP:
    """A network of points (n, names) with small random weights: levels near 0, half the bound."""
    ports = [Port(n, "", 0, float(s) or 1.0, float(m))
             for n, s, m in zip(names, points.std(0), points.mean(0), strict=True)]  # fmt: skip
    return dense(ports, list(outputs), [hidden], seed=seed, spread=0.3)


def state(seen: PreparedBatches, model: Any, noise: np.ndarray) -> Problem:
    """State the problem; `noise`, of the shape of the readings, is a guess that they correct."""
    record = Record(
        "batches", course, seen.batches, seen.measured, error=noise, weight=seen.read * 1.0,
        worth=1.0,
    )  # fmt: skip
    free = [Free("rates", nuisance=True), Free("start", nuisance=True)]
    return Problem(model, free, [record], weight_priors("rates"))
