"""Titre as a second stage on what the first predicts (report fig 34), and what it hangs on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.answer import answer
from beamfit.dynamics.balances import (
    ABOVE,
    RATES,
    STATES,
    Batches,
    PreparedBatches,
    course,
    filled,
    known_at,
    network_of,
    padded,
    rates_at,
    titre_of,
)
from beamfit.dynamics.fedbatch import (
    RULES,
    FedBatchFit,
    RateEvidence,
    ReadingNoise,
    check_names,
    settled,
)
from beamfit.dynamics.model import weight_priors
from beamfit.errors import InputError
from beamfit.greybox import tree
from beamfit.greybox.covariance import triangle
from beamfit.greybox.fit import Fit
from beamfit.greybox.problem import Free, Prior, Problem, Record
from beamfit.greybox.solve import solve
from beamfit.status import Status
from beamfit.table import Table, json_of
from beamfit.verdict import judge

TITRE = "titre"
# Free parts of the first stage and of this one; steps of the joint search from their two optima.
STAGES, OWN, JOINT = ("rates", "start"), ("make", "begin"), 5


@answer
@dataclass(frozen=True, eq=False)
class TitreFit:
    """Formation of product on top of identified rates.

    Attributes
    ----------
    status : Status
        How far to believe it; ``message`` says why and what to do.
    rates : FedBatchFit
        The first stage.
    seen : PreparedBatches
        Its batches, with the readings of the titre.
    fit : Fit
        Of both stages: the first stage's numbers have its own errors as their prior.
    noise : ReadingNoise
        Of the titre.
    """

    status: Status
    message: str
    rates: FedBatchFit
    seen: PreparedBatches
    fit: Fit
    noise: ReadingNoise

    @property
    def headline(self) -> str:
        """The answer in a line."""
        points = ", ".join(self.fit.model["make"].inputs)
        return f"titre {self.status}: of {points}, noise {self.noise}"

    @cached_property
    def courses(self) -> tuple[np.ndarray, ...]:
        """Biomass, substrate, volume, titre at the rows of each batch, shape (rows, 4)."""
        found = np.asarray(predicted(self.fit.model, self.seen.batches))
        return tuple(x[: len(t)] for x, t in zip(found, self.seen.time, strict=True))

    def tables(self) -> tuple[Table, ...]:
        """All numbers, to be shown."""
        points = ", ".join(self.fit.model["make"].inputs)
        rows = [["formation hangs on", points], ["noise of titre", str(self.noise)]]
        return (Table("titre", [], rows),)

    def to_json(self) -> dict[str, Any]:
        """Give one entry of ``results`` in the JSON contract."""
        return json_of(
            {"output": TITRE, "status": self.status, "message": self.message}
            | {"model": "fed-batch", "map": "network", "noise": {TITRE: self.noise._asdict()}}
            | {"records": [run.path or run.name for run in self.rates.runs]}
        )


def fit_titre(
    rates: FedBatchFit,
    points: Sequence[str] = ("mu_b", "substrate"),
    *,
    hidden: int = 3,
    seed: int = 0,
) -> TitreFit:
    """Fit the formation of product, P' = q X - P feed/V, to the output ``titre`` of the batches.

    Parameters
    ----------
    rates : FedBatchFit
        The first stage, whose biomass, substrate, volume and rates are predicted.
    points : sequence of str
        What q hangs on: mu_b, mu_s, states, inputs.
    hidden, seed : int
        Nodes of the network, and of its first weights.

    Returns
    -------
    TitreFit

    Raises
    ------
    InputError
        If a batch has no titre, or a name is unknown.

    Notes
    -----
    q = bound sigmoid(net), never negative, bounded by four times the most that a batch shows on
    average. The search holds the first stage; then the numbers of both move, those of the first
    with its own information as a normal prior, so that bands of the titre contain its errors.
    """
    b, names = rates.seen.batches, (*RATES, *STATES, *rates.seen.batches.inputs)
    check_names(points, names, "product")
    for run in rates.runs:
        if TITRE not in run.outputs:
            raise run.unusable("no output titre", "a column y_titre")
    measured = padded([run.outputs[TITRE][:, None] for run in rates.runs], b.dt.shape[1], np.nan)
    seen = rates.seen._replace(measured=np.nan_to_num(measured), read=np.isfinite(measured))
    model = dict(rates.fit.model) | _known(rates.fit) | _first(rates, seen, points, hidden, seed)
    fit, noise, rests = settled(seen, model, _state, _titres, (TITRE,))
    y = np.asarray(_titres(fit.model, b))
    found = judge(RateEvidence(fit, rests, seen, y, noise), RULES)
    error = noise[TITRE].errors(y[..., 0])[..., None]
    both = solve(_state(seen, fit.model, error, (*STAGES, *OWN)), iterations=JOINT)
    return TitreFit(found.status, found.message, rates, seen, both, noise[TITRE])


def _known(fit: Fit) -> dict[str, Any]:
    """The first stage's numbers and the root of their information."""
    (group,) = fit.groups
    rows = fit.dense_jacobian
    rows[group.rows] /= group.factor
    root = triangle(rows)
    return {"known": root, "found": root @ fit.theta}


def _first(
    rates: FedBatchFit, seen: PreparedBatches, points: Sequence[str], hidden: int, seed: int
) -> dict[str, Any]:
    b, top, values = seen.batches, [], []
    for i, (x, t) in enumerate(zip(rates.courses, seen.time, strict=True)):
        u, read = np.asarray(b.u[i, : len(t)]), np.flatnonzero(seen.read[i, :, 0])
        last = read[-1]
        cells = np.trapezoid(x[: last + 1, 0] * x[: last + 1, 2], t[: last + 1])
        top.append(seen.measured[i, last, 0] * x[last, 2] / max(cells, 1e-12))
        values.append(jax.vmap(lambda x, u: _points(b, rates.fit.model, points, x, u))(x, u))
    if not max(top) > 0:
        raise rates.runs[0].unusable("a titre that never rises", "batches that make product")
    net = network_of(points, np.concatenate(values), ["q"], hidden, seed)
    begin = [y[ok][0] for y, ok in zip(seen.measured[..., 0], seen.read[..., 0], strict=True)]
    return {"make": net, "most": 2.0 * ABOVE * max(top), "begin": np.array(begin)}


def _points(b: Batches, model: Any, points: Sequence[str], x: jax.Array, u: jax.Array) -> jax.Array:
    known = known_at(b, x, u) | dict(zip(RATES, rates_at(b, model["rates"], x, u), strict=True))
    return jnp.stack([known[name] for name in points])


def predicted(model: Any, b: Batches) -> jax.Array:
    """Biomass, substrate, volume, titre at the rows of each batch, shape (batches, rows, 4)."""

    def made(x, u):
        q = model["make"].values(_points(b, model, model["make"].inputs, x, u))
        return model["most"] * jax.nn.sigmoid(q[0])

    def one(x, u, out, dt, begin):
        before = jnp.concatenate([x[1:], x[-1:]])
        both = jnp.stack([jax.vmap(made)(x, u), jax.vmap(made)(before, u)])
        return jnp.column_stack([x, titre_of(begin, both, x, out, dt)])

    return jax.vmap(one)(course(model, b), b.u, b.flow.out, b.dt, model["begin"])


def _titres(model: Any, b: Batches) -> jax.Array:
    return predicted(model, b)[..., 3:]


def _held(model: Any) -> jax.Array:
    """The first stage's numbers, in units of their errors."""
    first = {name: model[name] for name in STAGES}
    leaves = [leaf for name in first for leaf in tree.find_leaves(first, name)]
    return model["known"] @ tree.read(first, leaves) - model["found"]


def _state(
    seen: PreparedBatches, model: Any, error: np.ndarray, free: Sequence[str] = OWN
) -> Problem:
    record = Record(
        TITRE, _titres, seen.batches, seen.measured, error=error, weight=seen.read * 1.0, worth=1.0
    )
    held = [Prior("first stage", 0.0, 1.0, _held)] if "rates" in free else []
    priors = [*weight_priors("make"), *held]
    return Problem(model, [Free(name, nuisance=True) for name in free], [record], priors)


# ---- what it hangs on


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
    b, model, parts = rates.seen.batches, rates.fit.model, []
    for i, (run, t, x) in enumerate(zip(rates.runs, rates.seen.time, rates.courses, strict=True)):
        total = np.append(0.0, np.cumsum(run.inputs["feed"][:-1] * np.diff(t)))
        columns = dict(run.inputs) | {"total feed": total}
        for name, y in run.outputs.items():
            if name != output:
                columns[name] = filled(t, y)
        u = np.asarray(b.u[i, : len(t)])
        found = jax.vmap(lambda x, u: rates_at(b, model["rates"], x, u))(x, u)
        for name, y in zip((*STATES, *RATES), np.column_stack([x, found]).T, strict=True):
            columns[f"predicted {name}"] = y
        read = np.isfinite(run.outputs[output])
        parts.append({k: v[read] for k, v in columns.items()} | {None: run.outputs[output][read]})
    whole = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    y = whole.pop(None)
    told = {name: v for name, v in whole.items() if np.ptp(v) > 0}
    found = mutual_info_regression(np.stack(list(told.values()), 1), y, random_state=seed)
    ranked = [Ranked(n, float(i), float(np.sqrt(-np.expm1(-2 * i))))
              for n, i in zip(told, found, strict=True)]  # fmt: skip
    return tuple(sorted(ranked, key=lambda each: -each.information))
