"""Mass balances of a fed-batch process (report eqs 45 and 46), and batches as the model sees them.

Rates come from a network, within bounds; product is formed and decays in addition (fig 34).
Concentrations are in g/L, volumes in L, times in h; rates are per gram of biomass.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.arrays import padded_length
from beamfit.compile_cache import prepare_jax
from beamfit.dynamics.record import Run
from beamfit.greybox import tree
from beamfit.quantity import HOUR

prepare_jax()


class Flow(NamedTuple):
    """Flows of the vessel: feed and outflow in L/h, substrate in the feed in g/L."""

    feed: jax.Array
    fed: jax.Array
    out: jax.Array


def titre_of(
    begin: jax.Array, made: jax.Array, x: jax.Array, lost: jax.Array, dt: jax.Array
) -> jax.Array:
    """Titre along a course: the mass of product over the volume, (P V)' = q X V - lost P V.

    Parameters
    ----------
    begin : array, shape ()
        Titre at the first point, g/L.
    made : array, shape (2, n)
        Formation of product q per gram of biomass, 1/h, just after each point and just before the
        next.
    x : array, shape (n, 3)
        Biomass, substrate, volume.
    lost : array, shape (2, n)
        Loss rate of product by outflow and decay, 1/h, at the same moments.
    dt : array, shape (n,)
        Time to the next point, h; the last is not used.

    Returns
    -------
    jax.Array, shape (n,)
        By the trapezoidal rule: with kept(t) = exp(-∫ lost), P V = kept (P0 V0 + ∫ q X V/kept).

    Examples
    --------
    >>> x, still = jnp.tile(jnp.array([10.0, 1.0, 4.0]), (3, 1)), jnp.zeros((2, 3))
    >>> titre_of(jnp.array(1.0), jnp.full((2, 3), 0.1), x, still, jnp.ones(3)).tolist()
    [1.0, 2.0, 3.0]
    """
    mass, dt, start = x[:, 0] * x[:, 2], dt[:-1], jnp.zeros(1)
    loss = jnp.concatenate([start, jnp.cumsum(0.5 * dt * lost[:, :-1].sum(0))])
    weighted = mass * jnp.exp(loss)
    formed = 0.5 * dt * (made[0, :-1] * weighted[:-1] + made[1, :-1] * weighted[1:])
    total = begin * x[0, 2] + jnp.concatenate([start, jnp.cumsum(formed)])
    return jnp.exp(-loss) * total / x[:, 2]


STATES = ("biomass", "substrate", "volume")
RATES = ("mu_b", "mu_s")
TITRE = "titre"
# Inputs that are flows and not part of the operating point: liquid, and the substrate in it.
FLOWS = ("feed", "feed_substrate", "outflow")
# Bounds of a rate over its extreme means in any of this many stretches of a batch: a mean hides
# what is fast.
BOUND_FACTOR = 4.0
STRETCHES = 8
# Longest integration step in units of the shortest growth time: accurate to 1e-3 over a batch.
MAX_STEP = 0.5
# Smallest substrate in units of its scale: without effect on the rates.
MIN_SUBSTRATE = 1e-9


@tree.node("inputs", "steps")
class Batches:
    """Batches as the model sees them, padded to one length.

    `inputs` names the known columns of every row: inputs, other outputs read on line, and as
    ``measured substrate`` the states as they were read. `u` (batches, rows, inputs) and `flow`
    (batches, rows) hold from row to row. `dt` (batches, rows) is the time to the next row in h, 0
    in the padding. A row has `steps` integration steps. `ends` (2, 2) are the smallest and largest
    rates.
    """

    inputs: tuple[str, ...]
    steps: int
    u: Any
    flow: Any
    dt: Any
    ends: Any


class PreparedBatches(NamedTuple):
    """Batches with readings and their mask, shape (batches, rows, outputs), and times, h."""

    batches: Batches
    measured: np.ndarray
    read: np.ndarray
    time: tuple[np.ndarray, ...]


def network_inputs(b: Batches, half: Any, x: Any, u: Any) -> dict[str, Any]:
    """Inputs of the networks by name: states, and the known columns of the row.

    A substrate enters as the logarithm of itself plus its scale: both ends of the curves of Monod
    and Haldane are then equally smooth.
    """
    inputs = dict(zip((*STATES, *b.inputs), [*x, *u], strict=True))
    for name in inputs:
        if name.endswith("substrate") and name not in FLOWS:
            inputs[name] = jnp.log(jnp.maximum(inputs[name], 0.0) + half)
    return inputs


def shares_at(b: Batches, model: Any, x: jax.Array, u: jax.Array) -> jax.Array:
    """Shares of the rates' ranges that the network gives at a state, shape (2,)."""
    net, inputs = model["rates"], network_inputs(b, model["half"], x, u)
    return jax.nn.sigmoid(net.values(jnp.stack([inputs[name] for name in net.inputs])))


def rates_from_shares(b: Batches, model: Any, substrate: Any, share: jax.Array) -> jax.Array:
    """Growth mu_b and consumption mu_s, per gram of biomass, 1/h: at most 0 without substrate."""
    full = substrate / (substrate + model["half"]) * b.ends[1]
    return b.ends[0] + (full - b.ends[0]) * share


def rates_at(b: Batches, model: Any, x: jax.Array, u: jax.Array) -> jax.Array:
    """Rates at a state, shape (2,)."""
    return rates_from_shares(b, model, x[1], shares_at(b, model, x, u))


def advance(
    b: Batches, model: Any, x: jax.Array, now: tuple[jax.Array, Flow], h: jax.Array
) -> jax.Array:
    """Advance biomass X, substrate S and volume V by a time h with implicit balances.

    Notes
    -----
    Report eqs 45 and 46, accumulation = in - out + generation, are balances of the masses X V and
    S V: (X V)' = mu_b X V - out X, (S V)' = feed S_f - out S - mu_s X V. With V' = feed - out the
    outflow leaves the concentrations unchanged. The report multiplies mu_s by the substrate; here
    it is multiplied by the biomass, since cells consume.

    Cells short of substrate consume it within seconds, while rows are hours apart: the substrate at
    the end is the positive root of its implicit balance, with consumption c S/(S + s). The
    network's shares are those at the end, found in two rounds.
    """
    u, flow = now
    volume = x[2] + h * (flow.feed - flow.out)
    dilution, half, end = flow.feed / volume, model["half"], x
    supply, factor = x[1] + h * dilution * flow.fed, 1.0 + h * dilution
    for _ in range(2):
        share = shares_at(b, model, end, u)
        middle = factor * half + h * b.ends[1, 1] * share[1] * end[0] - supply
        root = jnp.sqrt(middle**2 + 4.0 * factor * half * supply)
        positive = middle > 0  # each form loses digits where the other does not
        substrate = jnp.where(positive, 2.0 * half * supply, root - middle)
        substrate = substrate / jnp.where(positive, middle + root, 2.0 * factor)
        growth = rates_from_shares(b, model, substrate, share)[0] - dilution
        end = jnp.stack([x[0] * jnp.exp(h * growth), substrate, volume])
    return end


def course(model: Any, b: Batches) -> jax.Array:
    """States at the rows of each batch, shape (batches, rows, 3), from the start of each.

    Each batch has its own logarithmic factors of growth and consumption. A step and its two halves,
    extrapolated in the logarithm, are of second order (E. Hairer, G. Wanner, Solving ODEs II
    (1996), section IV.9) and keep concentrations positive.
    """
    floor = jnp.array([0.0, MIN_SUBSTRATE, 0.0]) * model["half"]

    def one(start, own, *rows):
        scaled = replace(b, ends=b.ends.at[1].multiply(jnp.exp(own[:2])))

        def row(x, now):
            u, flow, dt = now
            h = dt / b.steps

            def substep(_, x):
                halves = x
                for _ in range(2):
                    halves = advance(scaled, model, halves, (u, flow), h / 2)
                return jnp.maximum(halves**2 / advance(scaled, model, x, (u, flow), h), floor)

            return jax.lax.fori_loop(0, b.steps, substep, x), x

        return jax.lax.scan(row, start, rows)[1]

    return jax.vmap(one)(jnp.exp(model["start"]), model["own"], b.u, b.flow, b.dt)


def product_inputs(b: Batches, model: Any, names: Sequence[str], x: jax.Array, u: jax.Array) -> Any:
    """Inputs of the product's network, which may include the rates."""
    inputs = network_inputs(b, model["half"], x, u)
    inputs |= dict(zip(RATES, rates_at(b, model, x, u), strict=True))
    return jnp.stack([inputs[name] for name in names])


def predicted(model: Any, b: Batches) -> jax.Array:
    """Biomass, substrate, volume, and titre if the model has it: (batches, rows, outputs)."""
    states = course(model, b)
    if "product" not in model:
        return states

    @jax.vmap
    def made(x, u):
        q = model["product"].values(product_inputs(b, model, model["product"].inputs, x, u))
        return model["most"] * jax.nn.sigmoid(q[0])

    def one(x, u, out, dt, begin, own):
        after = jnp.concatenate([x[1:], x[-1:]])
        both = jnp.exp(own[2]) * jnp.stack([made(x, u), made(after, u)])
        lost = model["decay"] + out / jnp.stack([x[:, 2], after[:, 2]])
        return jnp.column_stack([x, titre_of(begin, both, x, lost, dt)])

    return jax.vmap(one)(states, b.u, b.flow.out, b.dt, model["begin"], model["own"])


def pad_columns(columns: Sequence[np.ndarray], n: int, last: float | None = None) -> np.ndarray:
    """Stack columns of several lengths; the last value is repeated unless `last` is given."""
    ends = [np.full_like(c[-1:], c[-1:] if last is None else last) for c in columns]
    return np.stack([np.concatenate([c, np.repeat(e, n - len(c), axis=0)])
                     for c, e in zip(columns, ends, strict=True)])  # fmt: skip


def batches_of(
    times: Sequence[np.ndarray], columns: Sequence[Mapping[str, np.ndarray]], like: Batches
) -> Batches:
    """Build batches from times (h) and known columns of their rows, with the bounds of others."""
    n = padded_length(max(map(len, times)))
    dt = np.stack([np.pad(np.diff(t), (0, n + 1 - len(t))) for t in times])

    def column(name: str) -> np.ndarray:
        return pad_columns([np.broadcast_to(u.get(name, 0.0), t.shape).astype(float)
                       for u, t in zip(columns, times, strict=True)], n)  # fmt: skip

    u = np.stack([column(name) for name in like.inputs], axis=-1)
    flow = Flow(*(jnp.asarray(column(name)) for name in FLOWS))
    steps = int(np.ceil(dt.max() * float(like.ends[1][0]) / MAX_STEP))
    return Batches(like.inputs, max(steps, 1), jnp.asarray(u), flow, jnp.asarray(dt), like.ends)


def row_columns(run: Run) -> dict[str, np.ndarray]:
    """Known columns of the rows of a batch: inputs, and outputs read on line."""
    t = run.time / HOUR
    read = {name: interpolate_gaps(t, y) for name, y in run.outputs.items()}
    own = {f"measured {n}" if n in (*STATES, TITRE) else n: y for n, y in read.items()}
    return dict(run.inputs) | own


def prepare_batches(runs: Sequence[Run], like: Batches, outputs: Sequence[str]) -> PreparedBatches:
    """Prepare runs like other batches."""
    hours = tuple((run.time - run.time[0]) / HOUR for run in runs)
    batches = batches_of(hours, [row_columns(run) for run in runs], like)
    columns = [np.stack([run.outputs[name] for name in outputs], axis=1) for run in runs]
    measured = pad_columns(columns, batches.dt.shape[1], np.nan)
    return PreparedBatches(batches, np.nan_to_num(measured), np.isfinite(measured), hours)


class Stretches(NamedTuple):
    """Stretches of batches, and their rates from readings alone.

    `weight` (batches, stretches, rows) averages values of rows over the cell time; `rates`
    (batches, stretches, 2) are growth and consumption by the balances.
    """

    weight: np.ndarray
    rates: np.ndarray


def stretches_of(run: Run) -> Stretches:
    """Divide one batch into stretches and compute their rates."""
    t = run.time / HOUR
    x, s, v = (interpolate_gaps(t, run.outputs[name]) for name in STATES)
    feed, fed, out = (run.inputs.get(name, np.zeros(len(t))) for name in FLOWS)
    supplied = np.append(0.0, np.cumsum((feed * fed - out * s)[:-1] * np.diff(t)))
    removed = np.append(0.0, np.cumsum((out * x)[:-1] * np.diff(t)))
    ends = np.unique(np.linspace(0, len(t) - 1, STRETCHES + 1).round().astype(int))
    cells = np.maximum(x * v, 1e-9)
    cell_time = np.append(0.5 * (cells[1:] + cells[:-1]) * np.diff(t), 0.0)
    stretch = np.searchsorted(ends, np.arange(len(t)), side="right") - 1
    weight = cell_time * (stretch == np.arange(len(ends) - 1)[:, None])
    total = weight.sum(axis=1, keepdims=True)
    grown, used = np.diff((cells + removed)[ends]), -np.diff((s * v - supplied)[ends])
    return Stretches(weight / total, np.stack([grown, used], axis=1) / total)


def batch_bounds(
    runs: Sequence[Run], parts: Sequence[Stretches], most: tuple[float, float] | None
) -> Batches:
    """Find names and rate bounds of batches, without any rows."""
    rates = np.concatenate([each.rates for each in parts])
    largest = rates.max(axis=0)
    if not np.all(largest > 0):
        raise runs[0].unusable("biomass that never grows on substrate", "a batch that does")
    # Cells die, so growth may be negative; they give no substrate back.
    smallest = BOUND_FACTOR * np.array([min(rates[:, 0].min(), 0.0), 0.0])
    largest = BOUND_FACTOR * largest if most is None else np.asarray(most, float)
    names = set.intersection(*(set(row_columns(run)) for run in runs))
    names = tuple(name for name in row_columns(runs[0]) if name in names)
    return Batches(names, 1, None, None, None, jnp.asarray([smallest, largest]))


def interpolate_gaps(t: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Interpolate missing readings linearly."""
    read = np.isfinite(y)
    return np.interp(t, t[read], y[read])
