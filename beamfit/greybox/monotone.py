"""Hard monotonicity: signs of weights that make a network rise or fall by construction."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from beamfit.errors import InputError
from beamfit.greybox.activations import KINDS
from beamfit.greybox.maps import positions
from beamfit.greybox.mlp import MLP, connection

__all__ = ["monotone_signs"]


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
    >>> from beamfit.greybox.mlp import dense
    >>> signs = monotone_signs(dense(["u", "v"], ["y"], [2]), {"u": -1})
    >>> signs["layer0->layer1"].tolist(), signs["layer1->layer2"].tolist()
    ([[-1.0, -1.0], [0.0, 0.0]], [[1.0], [1.0]])
    """
    positions(list(signs), net.inputs, "input")
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
    return {
        connection(a, b): np.broadcast_to(
            rows[a][:, None] if a in rows else 1.0, net.weights[connection(a, b)].shape
        )
        for a, b in net.connections
    }
