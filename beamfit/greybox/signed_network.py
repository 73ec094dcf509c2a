"""Networks that are monotonic everywhere, because their weights have suitable signs.

Each path from an input to an output is then a product of rising node functions and weights with one
overall sign, so that the gain has that sign at every point, not only at the data.
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

# Largest magnitude of a node's threshold and of a random start of a weight. The inputs have the
# range -1 to 1, so that thresholds cover somewhat more than it.
MAX_THRESHOLD = 1.5
# Tolerance within which a point counts as in a box, in the unit of the input.
BOX_TOLERANCE = 1e-9


def monotone_signs(net: MLP, signs: Mapping[str, int]) -> dict[str, np.ndarray]:
    """Find signs of the weights that make every output monotonic in chosen inputs.

    With weights of these signs (0: free) each path from such an input to an output is a product of
    rising node functions and weights with one overall sign, so that the gain has that sign
    everywhere.

    Parameters
    ----------
    net : MLP
        All its node functions must rise: identity, linear, sigmoid, tanh.
    signs : mapping of str to int
        Input name to +1 (outputs rise) or -1 (outputs fall); other inputs stay free.

    Returns
    -------
    dict of str to array
        Name of each connection to an array of signs, of the shape of its weights.

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
    """Make a network that starts as a straight line, with bounds on its weights for monotonicity.

    Parameters
    ----------
    path : str
        Path of the network in the model.
    inputs, outputs : list of Port
        Ports whose scales map the range of interest to -1 to 1.
    rising : ndarray
        Shape (outputs, inputs): +1 where an output must rise with an input, -1 where it must
        fall, 0 where it is free. An output with a row of zeros is not constrained. An input with
        a zero for another output is free for all outputs. So is an input whose pattern of signs
        differs from that of the first constrained input by more than an overall sign.
    hidden, seed : int
        Number of hidden tanh nodes, and the seed of the network.
    most : float
        Largest magnitude of a weight.

    Returns
    -------
    tuple of MLP and list of Free
        The network, and its weights as free numbers.

    Notes
    -----
    Each hidden node is monotonic in an input and each output in the node, so that each gain is a
    sum of terms of one sign at every point. Such a sum can approximate any rising function of one
    input to any accuracy.
    """
    node, out = _weight_signs(rising)
    net = dense(inputs, outputs, [hidden], seed=seed)
    first, last = "layer0->layer1", "layer1->layer2"
    thresholds = np.linspace(-MAX_THRESHOLD, MAX_THRESHOLD, hidden) if hidden > 1 else np.zeros(1)
    start = {first: np.zeros((len(inputs), hidden)), last: np.zeros((hidden, len(outputs)))}
    lead = int(np.argmax(node != 0)) if node.any() else 0
    sign_of_lead = node[lead] or 1.0
    start[first][lead] = sign_of_lead
    out_signs = np.where(out != 0, out, 1.0)
    # Nonnegative weights with which the nodes add up to a straight line from -1 to 1.
    x = np.linspace(-1.0, 1.0, 41)
    start[last] += nnls(np.tanh(x[:, None] + thresholds), x)[0][:, None] * out_signs
    biases = {"layer1": sign_of_lead * thresholds, "layer2": np.zeros(len(outputs))}
    net = replace(net, weights=start, biases=biases)
    free = []
    for name, sign in ((first, node[:, None]), (last, out)):
        sign = np.broadcast_to(sign, start[name].shape)
        ends = np.where(sign > 0, 0.0, -most), np.where(sign < 0, 0.0, most)
        free.append(
            Free(f"{path}.weights.{name}", *ends, (-MAX_THRESHOLD, MAX_THRESHOLD), nuisance=True)
        )
    return net, [
        *free,
        Free(f"{path}.biases", -most, most, (-MAX_THRESHOLD, MAX_THRESHOLD), nuisance=True),
    ]


def _weight_signs(rising: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the signs of the weights before and after the nodes from those of the gains."""
    node, out = np.zeros(rising.shape[1]), np.zeros(rising.shape[0])
    constrained = rising.any(axis=1)
    for i in range(rising.shape[1]):
        column = rising[:, i]
        if not constrained.any() or not column[constrained].all():
            continue
        if not out.any():
            out, node[i] = -column, -1.0
        elif np.array_equal(column, -out) or np.array_equal(column, out):
            lead = int(np.argmax(constrained))
            node[i] = column[lead] * out[lead]
    return node, out


class Gain(NamedTuple):
    """Enclosure of a network's gain over a box, and the sign that the gain must have."""

    name: str
    lower: float
    upper: float
    sign: int

    @property
    def holds(self) -> bool:
        """True if all gains in the enclosure have the sign, apart from rounding."""
        # Outward rounding changes a gain of zero to ±1e-300.
        reach = max(1e-12 * max(abs(self.lower), abs(self.upper)), 1e-200)
        if self.sign == 0:
            return True
        return self.upper <= reach if self.sign < 0 else self.lower >= -reach


class GainCertificate(NamedTuple):
    """Certified gains of a fitted network, and the box for which they hold."""

    gains: tuple[Gain, ...]
    box: dict[str, tuple[float, float]]

    @property
    def holds(self) -> bool:
        """True if every gain has its sign everywhere in the box."""
        return all(gain.holds for gain in self.gains)

    def holds_at(self, inputs: np.ndarray) -> bool:
        """Test if a point is in the box, within rounding."""
        low, high = np.array([*self.box.values()]).T
        return bool(np.all((inputs >= low - BOX_TOLERANCE) & (inputs <= high + BOX_TOLERANCE)))

    def to_json(self) -> dict[str, Any]:
        """Return the verdict, the enclosures and the box as JSON's types."""
        return json_of({"holds": self.holds, **self._asdict()})


def cells_along(inputs: int) -> int:
    """Return the number of cells along each input in which gains are enclosed."""
    return 32 if inputs == 1 else 8


def certificate_of(problem: Problem, net: MLP) -> GainCertificate:
    """Enclose the gains of a fitted network over the box of its inputs.

    Parameters
    ----------
    problem : Problem
        Problem with a `signed_network`. The bounds of the weights determine the sign of each gain.
        A limit that was given for a gain is a constraint of the problem and requires no sign here.
    net : MLP
        The fitted network.

    Returns
    -------
    GainCertificate
        It holds for every input in the box, not only the measured ones, with outward rounding.
    """
    ports = net.input_ports
    # The box is given by the ports' limits, else by their scales.
    scaled = [(p.bias - p.scale, p.bias + p.scale) for p in ports]
    given = [(p.lower, p.upper) for p in ports]
    low, high = np.where(np.isfinite(given), given, scaled).T
    bound = over_cells(net, *cells(low, high, cells_along(len(ports))))
    lower, upper = np.asarray(bound.lower).min(axis=0), np.asarray(bound.upper).max(axis=0)
    sign = _required_signs(problem, net)
    gains = tuple(
        Gain(f"d{out.name}/d{port.name}", float(lower[o, i]), float(upper[o, i]), int(sign[o, i]))
        for o, out in enumerate(net.output_ports)
        for i, port in enumerate(ports)
    )
    box = {p.name: (float(a), float(b)) for p, a, b in zip(ports, low, high, strict=True)}
    return GainCertificate(gains, box)


def _required_signs(problem: Problem, net: MLP) -> np.ndarray:
    """Find the signs of the gains that the weights' bounds require, shape (outputs, inputs)."""
    ends = {
        f.path.rsplit(".", 1)[-1]: np.sign(np.asarray(f.lower) + np.asarray(f.upper))
        for f in problem.free
        if ".weights." in f.path
    }
    if not ends:  # only limits are required
        return np.zeros((len(net.output_ports), len(net.input_ports)))
    first, last = (ends[f"layer{i}->layer{i + 1}"][...] for i in (0, 1))
    return last[0][:, None] * first[:, 0][None, :]
