"""The focusing-network scenario: k1 of each scanned magnet is a monotonic network of its current.

Signs of the weights make k1 rise (or fall, as the lattice's own calibration does) with the current
at every current, not only at the measured ones. With hysteresis the network has a second input, the
branch, so that rising and falling currents have curves of their own.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import nnls

from beamfit.errors import InputError
from beamfit.greybox.mlp import MLP, Port, dense
from beamfit.greybox.problem import Free, Problem, Record
from beamfit.studies.scan.assumptions import Assumptions
from beamfit.studies.scan.scenario_data import (
    Seen,
    beam_free,
    beam_numbers,
    branch_of,
    plane_rows,
    size_record,
    varied_magnets,
)
from beamfit.studies.scan.scenario_model import NetworkStrength

__all__ = ["MOST", "first_strength", "focusing_problem", "predict_strength", "signed_network"]

# Bounds of the weights: the report's (appendix B).
MOST = 10.0


def first_strength(seen: Seen, magnet: str, current: np.ndarray) -> np.ndarray:
    """k1 · E in MeV/m² as the lattice has it, at settings of a magnet."""
    element, energy = seen.scanned[magnet], float(seen.scanned.energy)
    each = [element.calibration.k1l(c, element.length, energy) for c in np.atleast_1d(current)]
    return np.asarray(each, float) * energy / element.length


def predict_strength(model, data) -> jax.Array:
    """k1 · E of a magnet's network at settings, for a record of what is known beforehand."""
    (name,) = data.keys()
    return jax.vmap(model[name].network.values)(data[name])[:, 0]


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
    model = MLP(
        net.layers,
        net.connections,
        net.input_ports,
        net.output_ports,
        start,
        {"layer1": way * thresholds, "layer2": np.zeros(len(outputs))},
    )
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


def focusing_problem(seen: Seen, told: Assumptions) -> Problem:
    """State the problem: beams and one network of k1 for each scanned magnet.

    Parameters
    ----------
    seen : Seen
        The scan.
    told : Assumptions
        Hidden nodes, anchor, branches.

    Returns
    -------
    Problem

    Raises
    ------
    InputError
        If a scanned magnet has no length, branches are asked of a scan that has but one, or an
        anchor names a magnet that was not scanned.
    """
    varied, scan = varied_magnets(seen), seen.scan
    branches: dict[str, np.ndarray] = {}
    if told.hysteresis:
        branches = {name: branch_of(scan.settings[name]) for name in varied}
        single = [name for name, b in branches.items() if np.ptp(b) == 0]
        if single:
            raise scan.unusable(
                f"settings of '{single[0]}' that only rise or only fall, with hysteresis",
                "rows in the order of measuring, with rising and falling settings",
                single[0],
            )
    _check_places(told, varied)
    beams = beam_numbers(seen)
    model: dict = {"beam": beams}
    free, records = beam_free(beams), []
    for name in varied:
        if not seen.scanned[name].length:
            raise InputError(f"a network of k1 for '{name}', which has no length", "a quadrupole")
        strength, bounds = _strength(seen, name, told, branches)
        model[name] = strength
        free += weight_free(f"{name}.network", bounds)
        records += _anchors(seen, name, told, branches)
    records = [
        *(size_record(seen, p, plane_rows(seen, p, branches)) for p in seen.planes),
        *records,
    ]
    return Problem(model, free, records)


def _check_places(told: Assumptions, varied: tuple[str, ...]) -> None:
    for place in told.anchor.at:
        for name in place:
            if name not in varied:
                raise InputError(f"an anchor at '{name}'", f"a scanned magnet: {', '.join(varied)}")


def _strength(seen: Seen, name: str, told: Assumptions, branches):
    """A network that starts as the straight line between the lattice's own k1 at both ends."""
    settings = seen.scan.settings[name]
    low, high = float(settings.min()), float(settings.max())
    ends = first_strength(seen, name, np.array([low, high]))
    ports = [Port("I", "", 0, (high - low) / 2, (high + low) / 2)]
    rising = [np.sign(ends[1] - ends[0]) or 1.0]
    if name in branches:
        # A branch moves k1 by a few per cent of its range at most: small weights do it.
        ports.append(Port("branch", "", 0, 10.0, 0.0))
        rising.append(0.0)
    half = abs(float(ends[1] - ends[0])) / 2 or 1.0
    output = Port(f"{name}.k1E", "", 0, half, float(ends.mean()))
    net, bounds = signed_network(ports, [output], np.array([rising]), told.hidden, told.seed)
    return NetworkStrength(net, seen.scanned[name].calibration.unit), bounds


def _anchors(seen: Seen, name: str, told: Assumptions, branches) -> list[Record]:
    """What is known of k1 beforehand, as records."""
    anchor, found = told.anchor, []
    largest = float(np.abs(first_strength(seen, name, seen.scan.settings[name])).max())
    if anchor.deviation is not None:
        at = np.unique(seen.scan.settings[name])
        found.append(_known(seen, name, at, anchor.deviation * largest, branches))
    places = np.array([place[name] for place in anchor.at if name in place], float)
    if len(places):
        found.append(_known(seen, name, places, anchor.sd * largest, branches))
    return found


def _known(seen: Seen, name: str, at: np.ndarray, sd: float, branches) -> Record:
    """k1 · E of the lattice at settings, midway between the branches where there are two."""
    points = np.stack([at, np.zeros(len(at))], -1) if name in branches else at[:, None]
    data = {name: jnp.asarray(points)}
    return Record(f"anchor {name}", predict_strength, data, first_strength(seen, name, at), sd)
