"""Networks held by signs of their weights, or by limits of gains and a box (Appendix B)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jax import Array
from scipy.optimize import nnls

from beamfit.emittance.assumptions import Assumptions
from beamfit.emittance.model import UNIT, sigma_of
from beamfit.emittance.statement import Seen, beam_problem
from beamfit.emittance.transport import padded
from beamfit.errors import InputError, nearest
from beamfit.greybox.gains import certified_gain
from beamfit.greybox.mlp import MLP, Port, dense
from beamfit.greybox.problem import Constraint, Free, Prior, Problem, Record

# Bounds of the weights: the report's (appendix B).
MOST = 10.0


def signed_network(
    inputs: list[Port], outputs: list[Port], rising: np.ndarray, hidden: int, seed: int
) -> tuple[MLP, dict[str, tuple[np.ndarray, np.ndarray]]]:
    """Make a network that starts as a straight line, with bounds that keep it monotonic.

    Parameters
    ----------
    inputs, outputs : list of Port
        Scaled so that the range of interest is -1 to 1 on both sides.
    rising : ndarray
        Shape (outputs, inputs): +1 where an output must rise with an input, -1 where it must
        fall, 0 where it is free. A row of zeros asks nothing of its output. An input with a
        zero elsewhere is free for all outputs, and so is one that asks of the outputs another
        pattern of signs than the first does.
    hidden, seed : int
        Hidden tanh nodes, and the seed of their thresholds.

    Returns
    -------
    tuple of MLP and dict
        The network, and lower and upper bounds by connection or layer.

    Notes
    -----
    Each hidden node moves one way with an input and each output one way with the node, so each
    gain is a sum of terms of one sign; no point of the range has to be asked. A rising
    function of one input can be approximated by such a sum as well as one likes.
    """
    node, out = _pattern(rising)
    net = dense(inputs, outputs, [hidden], seed=seed)
    first, last = "layer0->layer1", "layer1->layer2"
    thresholds = np.linspace(-1.5, 1.5, hidden) if hidden > 1 else np.zeros(1)
    start = {first: np.zeros((len(inputs), hidden)), last: np.zeros((hidden, len(outputs)))}
    lead = int(np.argmax(node != 0)) if node.any() else 0
    way = node[lead] or 1.0
    start[first][lead] = way
    towards = np.where(out != 0, out, 1.0)
    start[last] += _straight(thresholds)[:, None] * towards
    biases = {"layer1": way * thresholds, "layer2": np.zeros(len(outputs))}
    model = replace(net, weights=start, biases=biases)
    bounds = {
        f"weights.{first}": _ends(np.broadcast_to(node[:, None], (len(inputs), hidden))),
        f"weights.{last}": _ends(np.broadcast_to(out, (hidden, len(outputs)))),
        "biases.layer1": _ends(np.zeros(hidden)),
        "biases.layer2": _ends(np.zeros(len(outputs))),
    }
    return model, bounds


def _straight(thresholds: np.ndarray) -> np.ndarray:
    """Weights, none negative, that make the nodes add up to a straight line from -1 to 1."""
    x = np.linspace(-1.0, 1.0, 41)
    return nnls(np.tanh(x[:, None] + thresholds), x)[0]


def _ends(sign: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.where(sign > 0, 0.0, -MOST), np.where(sign < 0, 0.0, MOST)


def _pattern(rising: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Signs of input to node and of node to output that give the gains their signs."""
    node, out = np.zeros(rising.shape[1]), np.zeros(rising.shape[0])
    asked = rising.any(axis=1)
    for i in range(rising.shape[1]):
        column = rising[:, i]
        if not asked.any() or not column[asked].all():
            continue
        if not out.any():
            out, node[i] = -column, -1.0
        elif np.array_equal(column, -out) or np.array_equal(column, out):
            lead = int(np.argmax(asked))
            node[i] = column[lead] * out[lead]
    return node, out


def weight_free(path: str, bounds: dict[str, tuple[np.ndarray, np.ndarray]]) -> list[Free]:
    """The weights of a network as free numbers that nobody asks for."""
    return [Free(f"{path}.{k}", a, b, (-1.5, 1.5), nuisance=True) for k, (a, b) in bounds.items()]


def network_problem(
    seen: Seen,
    told: Assumptions,
    inputs: Sequence[str],
    common: Iterable[str],
    rows: Mapping[str, Any],
    part: Mapping[str, Any],
    weights: Iterable[Free],
    records: Iterable[Record],
    limits: Iterable[Constraint] = (),
) -> Problem:
    """Beams and networks, a part of the model, with the error that all settings share.

    A wrong energy or slope moves every setting alike, and does not average out over them. How much
    of a deviation is `common` to each of these nobody knows, so it may be all of it.
    """
    for name in (name for place in told.anchor.at for name in place):
        if name not in inputs:
            raise InputError(f"an anchor at '{name}'", f"a scanned magnet: {', '.join(inputs)}")
    sd = told.anchor.deviation
    shared = {} if sd is None else {"anchor": dict.fromkeys(common, 0.0)}
    names = [f"anchor.{name}" for name in shared.get("anchor", ())]
    free = [*weights, *(Free(name, -0.9, nuisance=True) for name in names)]
    priors = [Prior(name, 0.0, sd) for name in names]
    return beam_problem(seen, rows, {**part, **shared}, free, records, priors, limits)


def known_record(
    name: str, predict: Callable[[Any, Any], Any], data: Any, values: Any, sd: Any
) -> Record:
    """First principles as a record of a network, padded; ``data`` is padded already."""
    values = np.asarray(values, float)
    full = padded(values)
    weight = np.zeros(full.shape)
    weight[: len(values)] = 1.0
    return Record(name, predict, data, full, padded(np.broadcast_to(sd, values.shape)), weight)


SIGMA = ("sigma11", "sigma12", "sigma22")
# The appendix's random start of a weight; it gives the network no straight line to begin with.
START = 0.01


@dataclass(frozen=True)
class _Sigma:
    """σ11, σ12, σ22 of a plane in units of 1e-8 SI; equal ones share their compiled code."""

    plane: str

    def __call__(self, model: Any, data: None) -> Array:
        return sigma_of(model["beam"][self.plane]) / UNIT**2


def beam_box(told: Assumptions, planes: Sequence[str]) -> list[Constraint]:
    """The box of each plane's beam matrix, one constraint a plane that has bounds."""
    found = []
    for plane in planes:
        named = [told.bounds.get(f"{plane}.{name}", (-np.inf, np.inf)) for name in SIGMA]
        low, high = np.array(named).T / UNIT**2
        if np.isfinite(low).any():
            found.append(Constraint(f"box {plane}", _Sigma(plane), None, low, high))
    return found


def limited_network(
    inputs: Sequence[str], box: np.ndarray, outputs: Sequence[str], told: Assumptions, cells: int
) -> tuple[MLP, list[Free], list[Constraint]]:
    """The network of Appendix B: no scales, weights within ± 10, gains limited in a box (2, n)."""
    low, high = box.tolist()
    ports = [Port(n, "", lower=a, upper=b) for n, a, b in zip(inputs, low, high, strict=True)]
    net = dense(ports, outputs, [told.hidden], seed=told.seed, spread=START)
    free = [Free("map", -MOST, MOST, (-START, START), nuisance=True)]
    limits = []
    for name, (least, most) in told.gains.items():
        output, by = _parts(name)
        limits += certified_gain("map", output, by, (low, high), cells, lower=least, upper=most)
    return net, free, limits


def _parts(name: str) -> list[str]:
    """Output and input of a gain: "dA_x/dQ2" is A_x by Q2."""
    return [part.removeprefix("d") for part in name.split("/", 1)]


def check_box(told: Assumptions, inputs: Sequence[str], outputs: Sequence[str], planes) -> None:
    """Refuse bounds and gains of what there is not.

    Raises
    ------
    InputError
        Naming the nearest there is.
    """
    numbers = [f"{plane}.{name}" for plane in planes for name in SIGMA] + list(inputs)
    gains = [f"d{output}/d{by}" for output in outputs for by in inputs]
    for what, named, known in (("bounds on", told.bounds, numbers), ("gain", told.gains, gains)):
        for name in named:
            if name not in known:
                raise InputError(f"{what} '{name}'", nearest(name, known))
