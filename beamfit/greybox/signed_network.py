"""Networks that are monotonic by the signs of their weights, at every point and not only at data.

With weights of these signs each path from an input to an output is a product of rising node
functions and weights of one overall sign, so that the gain has that sign everywhere.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import nnls

from beamfit.answer import json_of
from beamfit.errors import InputError
from beamfit.greybox.bounds import KINDS, cells, over_cells
from beamfit.greybox.maps import positions
from beamfit.greybox.mlp import MLP, Port, connection, dense
from beamfit.greybox.problem import Free, Problem

# Largest threshold of a node and random start of a weight: a network's range is -1 to 1.
WIDE = 1.5
# A point is in a box within so much.
ROUNDING = 1e-9


def monotone_signs(net: MLP, signs: Mapping[str, int]) -> dict[str, np.ndarray]:
    """Signs of the weights that make every output monotonic in chosen inputs by construction.

    With weights of these signs (0: free) each path from such an input to an output is a product of
    rising node functions and weights of one overall sign, so the gain has that sign everywhere,
    not only where it was looked at.

    Parameters
    ----------
    net : MLP
        All its node functions between input and output must rise: identity, linear, sigmoid, tanh.
    signs : mapping of str to int
        Input name to +1 (outputs rise) or -1 (outputs fall); other inputs stay free.

    Returns
    -------
    dict of str to array
        Connection name to signs, of the shape of its weights.

    Raises
    ------
    InputError
        If a node function falls somewhere, an input is not the only one of its node, or an input
        layer is fed by another layer.

    Examples
    --------
    >>> signs = monotone_signs(dense(["u", "v"], ["y"], [2]), {"u": -1})
    >>> signs["layer0->layer1"].tolist(), signs["layer1->layer2"].tolist()
    ([[-1.0, -1.0], [0.0, 0.0]], [[1.0], [1.0]])
    """
    positions(list(signs), [port.name for port in net.input_ports], "input")
    entry = {port.layer for port in net.input_ports}
    places = [(port.layer, port.node) for port in net.input_ports]
    falling = [layer.name for layer in net.layers if not KINDS[layer.kind].monotonic]
    if falling:
        raise InputError(f"layers {', '.join(falling)} that fall somewhere", "rising layers only")
    if len(set(places)) < len(places) or any(target in entry for _, target in net.connections):
        raise InputError("shared input nodes or layers that feed the inputs", "plain input layers")
    rows = {name: np.zeros(layer.size) for layer in net.layers if (name := layer.name) in entry}
    for port in net.input_ports:
        rows[port.layer][port.node] = signs.get(port.name, 0) * np.sign(port.scale)
    flips = {np.sign(port.scale) for port in net.output_ports}
    if flips != {1.0}:
        raise InputError("an output with a negative scale", "positive scales for monotonic outputs")
    found = {}
    for a, b in net.connections:
        first = rows[a][:, None] if a in rows else 1.0
        found[connection(a, b)] = np.broadcast_to(first, net.weights[connection(a, b)].shape)
    return found


def signed_network(
    path: str,
    inputs: list[Port],
    outputs: list[Port],
    rising: np.ndarray,
    hidden: int,
    seed: int,
    most: float,
) -> tuple[MLP, list[Free]]:
    """Make a network that starts as a straight line, with bounds that keep it monotonic.

    Parameters
    ----------
    path : str
        Where the network is in the model.
    inputs, outputs : list of Port
        Scaled so that the range of interest is -1 to 1 on both sides.
    rising : ndarray
        Shape (outputs, inputs): +1 where an output must rise with an input, -1 where it must
        fall, 0 where it is free. A row of zeros asks nothing of its output. An input with a
        zero elsewhere is free for all outputs, and so is one that asks of the outputs another
        pattern of signs than the first does.
    hidden, seed : int
        Hidden tanh nodes, and the seed of their thresholds.
    most : float
        Largest magnitude of a weight.

    Returns
    -------
    tuple of MLP and list of Free
        The network, and its weights as free numbers.

    Notes
    -----
    Each hidden node moves one way with an input and each output one way with the node, so each
    gain is a sum of terms of one sign; no point of the range has to be asked. A rising
    function of one input can be approximated by such a sum as well as one likes.
    """
    node, out = _pattern(rising)
    net = dense(inputs, outputs, [hidden], seed=seed)
    first, last = "layer0->layer1", "layer1->layer2"
    thresholds = np.linspace(-WIDE, WIDE, hidden) if hidden > 1 else np.zeros(1)
    start = {first: np.zeros((len(inputs), hidden)), last: np.zeros((hidden, len(outputs)))}
    lead = int(np.argmax(node != 0)) if node.any() else 0
    way = node[lead] or 1.0
    start[first][lead] = way
    towards = np.where(out != 0, out, 1.0)
    # Weights, none negative, with which the nodes add up to a straight line from -1 to 1.
    x = np.linspace(-1.0, 1.0, 41)
    start[last] += nnls(np.tanh(x[:, None] + thresholds), x)[0][:, None] * towards
    biases = {"layer1": way * thresholds, "layer2": np.zeros(len(outputs))}
    net = replace(net, weights=start, biases=biases)
    free = []
    for name, sign in ((first, node[:, None]), (last, out)):
        sign = np.broadcast_to(sign, start[name].shape)
        ends = np.where(sign > 0, 0.0, -most), np.where(sign < 0, 0.0, most)
        free.append(Free(f"{path}.weights.{name}", *ends, (-WIDE, WIDE), nuisance=True))
    return net, [*free, Free(f"{path}.biases", -most, most, (-WIDE, WIDE), nuisance=True)]


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


class Gain(NamedTuple):
    """A gain of a network over a box: its enclosure, and the sign that it must have."""

    name: str
    lower: float
    upper: float
    sign: int

    @property
    def holds(self) -> bool:
        """True if the enclosure keeps to the sign; rounding is part of the enclosure."""
        # Rounded outward, a gain of zero is one of 1e-300 to either side.
        reach = max(1e-12 * max(abs(self.lower), abs(self.upper)), 1e-200)
        if self.sign == 0:
            return True
        return self.upper <= reach if self.sign < 0 else self.lower >= -reach


class GainCertificate(NamedTuple):
    """Certified gains of a fitted network, and the box they hold over."""

    gains: tuple[Gain, ...]
    box: dict[str, tuple[float, float]]

    @property
    def holds(self) -> bool:
        """True if every gain keeps to its sign everywhere in the box."""
        return all(gain.holds for gain in self.gains)

    def holds_at(self, inputs: np.ndarray) -> bool:
        """Test if a point is in the box, within rounding."""
        low, high = np.array([*self.box.values()]).T
        return bool(np.all((inputs >= low - ROUNDING) & (inputs <= high + ROUNDING)))

    def to_json(self) -> dict[str, Any]:
        """Return the verdict, the enclosures and the box as JSON's types."""
        return json_of({"holds": self.holds, **self._asdict()})


def cells_along(inputs: int) -> int:
    """Cells along each of some inputs in which gains are enclosed."""
    return 32 if inputs == 1 else 8


def certificate_of(problem: Problem, net: MLP) -> GainCertificate:
    """Enclose the gains of a fitted network over the box of its inputs.

    Parameters
    ----------
    problem : Problem
        With `signed_network`; its bounds tell which sign each gain must have. A limit that was
        given for a gain is a constraint of the problem, and asks for no sign here.
    net : MLP
        The fitted network.

    Returns
    -------
    GainCertificate
        For every input in the box, not only the measured ones, outward rounding included.
    """
    ports = net.input_ports
    # A network that is scaled to its box has it in the scales.
    scaled = [(p.bias - p.scale, p.bias + p.scale) for p in ports]
    given = [(p.lower, p.upper) for p in ports]
    low, high = np.where(np.isfinite(given), given, scaled).T
    bound = over_cells(net, *cells(low, high, cells_along(len(ports))))
    lower, upper = np.asarray(bound.lower).min(axis=0), np.asarray(bound.upper).max(axis=0)
    sign = _asked(problem, net)
    gains = tuple(
        Gain(f"d{out.name}/d{port.name}", float(lower[o, i]), float(upper[o, i]), int(sign[o, i]))
        for o, out in enumerate(net.output_ports)
        for i, port in enumerate(ports)
    )
    box = {p.name: (float(a), float(b)) for p, a, b in zip(ports, low, high, strict=True)}
    return GainCertificate(gains, box)


def _asked(problem: Problem, net: MLP) -> np.ndarray:
    """Signs the bounds of the weights ask of the gains, shape (outputs, inputs)."""
    ends = {
        f.path.rsplit(".", 1)[-1]: np.sign(np.asarray(f.lower) + np.asarray(f.upper))
        for f in problem.free
        if ".weights." in f.path
    }
    if not ends:  # limits, and no signs
        return np.zeros((len(net.output_ports), len(net.input_ports)))
    first, last = (ends[f"layer{i}->layer{i + 1}"][...] for i in (0, 1))
    return last[0][:, None] * first[:, 0][None, :]
