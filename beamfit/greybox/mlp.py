"""Multi-layer perceptrons with gains as outputs (report 3.1.3)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from graphlib import CycleError, TopologicalSorter
from itertools import pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.errors import InputError, nearest
from beamfit.greybox import tree
from beamfit.greybox.bounds import KINDS, cells, over_cells
from beamfit.greybox.gains import gain
from beamfit.greybox.maps import positions


class Layer(NamedTuple):
    """A layer: its name, one of the seven node functions, its size, and whether it has a bias."""

    name: str
    kind: str
    size: int
    bias: bool = False


class Port(NamedTuple):
    """Input or output of a network: outside value = scale * node value + bias.

    The report does not define the direction of scale and bias. This definition is the same for
    inputs and outputs, and the report's example values look like standard deviations and means.
    `lower` and `upper` are the range over which certified gains hold.
    """

    name: str
    layer: str
    node: int = 0
    scale: float = 1.0
    bias: float = 0.0
    lower: float = -np.inf
    upper: float = np.inf


class NetworkGain(NamedTuple):
    """A gain as an additional output: d(output)/d(by[0])..., of order len(by), 1 to 3.

    `kind` is ``local`` (at the point), ``lower`` or ``upper`` (a certified bound over the whole
    input range, split into `cells` along each input; first order only).
    """

    name: str
    output: str
    by: tuple[str, ...]
    kind: str = "local"
    cells: int = 64


def connection(source: str, target: str) -> str:
    """Name the weights between two layers.

    Examples
    --------
    >>> connection("layer0", "layer1")
    'layer0->layer1'
    """
    return f"{source}->{target}"


@tree.node("layers", "connections", "input_ports", "output_ports", "gains")
class MLP:
    """A network of layers with arbitrary connections without loops; they may skip layers.

    A node's argument is its bias plus the weighted nodes of all layers connected to it plus, at an
    input's node, (x - port.bias) / port.scale.

    Parameters
    ----------
    layers : sequence of Layer
        In any order.
    connections : sequence of (str, str)
        Source and target layer; no loops.
    input_ports, output_ports : sequence of Port
        Named inputs and outputs.
    weights : mapping of str to array, optional
        ``"source->target"`` to an array of shape (source size, target size); zero if absent.
    biases : mapping of str to array, optional
        Layer name to shape (size,); zero if absent.
    gains : sequence of NetworkGain, optional
        Gains, computed as outputs after the output ports.

    Raises
    ------
    InputError
        If names, shapes or orders do not fit, or the connections form a loop.

    Examples
    --------
    >>> net = MLP([Layer("in", "identity", 1), Layer("out", "tanh", 1, bias=True)],
    ...           [("in", "out")], [Port("u", "in")], [Port("y", "out")],
    ...           {"in->out": [[2.0]]}, gains=[NetworkGain("dy/du", "y", ("u",))])
    >>> net.outputs, net(jnp.array([0.0])).tolist()
    (('y', 'dy/du'), [0.0, 2.0])
    """

    layers: tuple[Layer, ...]
    connections: tuple[tuple[str, str], ...]
    input_ports: tuple[Port, ...]
    output_ports: tuple[Port, ...]
    weights: Mapping[str, jax.Array] | None = None
    biases: Mapping[str, jax.Array] | None = None
    gains: tuple[NetworkGain, ...] = ()

    def __post_init__(self):
        for name in ("layers", "input_ports", "output_ports", "gains"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        object.__setattr__(self, "connections", tuple(tuple(c) for c in self.connections))
        _check_layers(self)
        _check_ports(self)
        _check_gains(self)
        size = {layer.name: layer.size for layer in self.layers}
        shapes = {connection(a, b): (size[a], size[b]) for a, b in self.connections}
        object.__setattr__(self, "weights", _arrays(self.weights, shapes, "connection"))
        shapes = {layer.name: (layer.size,) for layer in self.layers if layer.bias}
        object.__setattr__(self, "biases", _arrays(self.biases, shapes, "layer with a bias"))

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs."""
        return tuple(port.name for port in self.input_ports)

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs, then of the gains."""
        return tuple(port.name for port in (*self.output_ports, *self.gains))

    @property
    def order(self) -> tuple[Layer, ...]:
        """The layers in an order of computation, sources before targets."""
        named = {layer.name: layer for layer in self.layers}
        before = {name: {a for a, b in self.connections if b == name} for name in named}
        try:
            return tuple(named[name] for name in TopologicalSorter(before).static_order())
        except CycleError as error:
            raise InputError(
                f"a loop of connections {' -> '.join(error.args[1])}", "connections without loops"
            ) from None

    def __call__(self, x: jax.Array) -> jax.Array:
        """Compute outputs and gains at one point."""
        return jnp.concatenate([self.values(x), *(g[None] for g in self._gains(x))])

    def values(self, x: jax.Array) -> jax.Array:
        """Compute the outputs without the gains.

        Parameters
        ----------
        x : array, shape (inputs,)
            The point.

        Returns
        -------
        jax.Array, shape (output ports,)
        """
        nodes: dict[str, jax.Array] = {}
        for layer in self.order:
            s = self.biases.get(layer.name, jnp.zeros(layer.size))
            for source, target in self.connections:
                if target == layer.name:
                    s = s + nodes[source] @ self.weights[connection(source, target)]
            for i, port in enumerate(self.input_ports):
                if port.layer == layer.name:
                    s = s.at[port.node].add((x[i] - port.bias) / port.scale)
            nodes[layer.name] = KINDS[layer.kind].function(s)
        return jnp.stack([p.scale * nodes[p.layer][p.node] + p.bias for p in self.output_ports])

    def _gains(self, x: jax.Array) -> list[jax.Array]:
        """Compute the gains."""
        plain = replace(self, gains=())
        return [
            gain(plain, x, g.output, g.by) if g.kind == "local" else _certified(plain, g)
            for g in self.gains
        ]


def _certified(net: MLP, wanted: NetworkGain) -> jax.Array:
    """Compute the certified bound of a gain over the range of the input ports."""
    (row,) = positions([wanted.output], net.outputs)
    (column,) = positions(wanted.by, net.inputs)
    low = np.array([port.lower for port in net.input_ports])
    high = np.array([port.upper for port in net.input_ports])
    finite = np.all(np.isfinite(high - low))
    corners = cells(low, high, wanted.cells) if finite else (low[None], high[None])
    bound = over_cells(net, *corners)
    if wanted.kind == "lower":
        return jnp.min(bound.lower[:, row, column])
    return jnp.max(bound.upper[:, row, column])


def _check_layers(net: MLP) -> None:
    """Raise an error for unknown node functions, repeated names and wrong connections."""
    names = [layer.name for layer in net.layers]
    for layer in net.layers:
        if names.count(layer.name) > 1:
            raise InputError(f"two layers named '{layer.name}'", "each name once")
        if layer.kind not in KINDS:
            raise InputError(f"layer type '{layer.kind}'", nearest(layer.kind, list(KINDS)))
        if layer.kind == "identity" and layer.bias:
            raise InputError(f"a bias on the identity layer '{layer.name}'", "type linear for it")
        if layer.size < 1:
            raise InputError(f"layer '{layer.name}' of size {layer.size}", "at least one node")
    for pair in net.connections:
        positions(pair, names, "layer")
        if net.connections.count(pair) > 1:
            raise InputError(f"two connections {connection(*pair)}", "each connection once")
    fed = {target for _, target in net.connections} | {port.layer for port in net.input_ports}
    for name in names:
        if name not in fed:
            raise InputError(f"layer '{name}' with nothing before it", "a connection or an input")
    _ = net.order  # raises an error for a loop


def _check_ports(net: MLP) -> None:
    """Raise an error for ports on nodes that do not exist, and scales that are zero."""
    sizes = {layer.name: layer.size for layer in net.layers}
    for port in (*net.input_ports, *net.output_ports):
        positions([port.layer], list(sizes), "layer")
        if not 0 <= port.node < sizes[port.layer]:
            raise InputError(
                f"'{port.name}' at node {port.node} of layer '{port.layer}'",
                f"a node from 0 to {sizes[port.layer] - 1}",
            )
        if port.scale == 0 or not np.isfinite(port.scale):
            raise InputError(f"scale {port.scale} at '{port.name}'", "a finite number, not zero")
    if not net.input_ports or not net.output_ports:
        raise InputError("a network without inputs or outputs", "at least one of each")
    for names in (net.inputs, net.outputs):
        if len(set(names)) < len(names):
            raise InputError(f"names {', '.join(names)}", "each name once")


def _check_gains(net: MLP) -> None:
    """Raise an error for gains of a wrong order or kind."""
    for wanted in net.gains:
        positions([wanted.output], [port.name for port in net.output_ports], "output")
        positions(wanted.by, net.inputs, "input")
        if not 1 <= len(wanted.by) <= 3:
            raise InputError(f"gain '{wanted.name}' of order {len(wanted.by)}", "order 1, 2 or 3")
        if wanted.kind not in ("local", "lower", "upper"):
            raise InputError(
                f"gain type '{wanted.kind}'", nearest(wanted.kind, ["local", "lower", "upper"])
            )
        if wanted.kind != "local" and len(wanted.by) > 1:
            raise InputError(
                f"a {wanted.kind} bound on the gain '{wanted.name}' of order {len(wanted.by)}",
                "order 1: bounds are certified for first-order gains",
            )


def _arrays(given, shapes: Mapping[str, tuple[int, ...]], kind: str) -> dict[str, jax.Array]:
    """Collect arrays by name, zero where none is given."""
    given = dict(given or {})
    positions(list(given), list(shapes), kind)
    found = {}
    for name, shape in shapes.items():
        found[name] = jnp.asarray(given.get(name, np.zeros(shape)), float)
        if found[name].shape != shape:
            raise InputError(
                f"values of shape {found[name].shape} for {kind} '{name}'", f"shape {shape}"
            )
    return found


def dense(
    inputs: Sequence[str | Port],
    outputs: Sequence[str | Port],
    hidden: Sequence[int] = (5,),
    kind: str = "tanh",
    seed: int = 0,
    spread: float = 1.0,
    gains: Sequence[NetworkGain] = (),
) -> MLP:
    """Build a network of fully connected layers with random weights.

    Parameters
    ----------
    inputs, outputs : sequence of str or Port
        Names, or ports that carry scale, bias and range (their layer and node are set here).
    hidden : sequence of int
        Sizes of the hidden layers.
    kind : str
        Node function of the hidden layers; the last layer is linear with a bias.
    seed : int
        Seed of the random weights.
    spread : float
        Weights are normal with standard deviation spread / sqrt(source size), biases with spread.
    gains : sequence of NetworkGain
        Gains to append to the outputs.

    Returns
    -------
    MLP

    Raises
    ------
    InputError
        If the parts do not fit.

    Examples
    --------
    >>> net = dense(["c"], ["A", "B"], hidden=[5])
    >>> [leaf.size for leaf in tree.leaves(net)]
    [5, 10, 5, 2]
    """
    sizes = [len(inputs), *hidden, len(outputs)]
    kinds = ["identity", *[kind] * len(hidden), "linear"]
    names = [f"layer{i}" for i in range(len(sizes))]
    layers = [
        Layer(name, kind, size, i > 0)
        for i, (name, kind, size) in enumerate(zip(names, kinds, sizes, strict=True))
    ]
    random = np.random.default_rng(seed)
    pairs = list(pairwise(names))
    weights = {
        connection(*pair): random.normal(0, spread / np.sqrt(shape[0]), shape)
        for pair, shape in zip(pairs, pairwise(sizes), strict=True)
    }
    biases = {
        name: random.normal(0, spread, n) for name, n in zip(names[1:], sizes[1:], strict=True)
    }
    return MLP(
        layers, pairs, _ports(inputs, names[0]), _ports(outputs, names[-1]), weights, biases, gains
    )


def _ports(given: Sequence[str | Port], layer: str) -> list[Port]:
    """Make ports on the nodes of one layer, in order."""
    ports = [p if isinstance(p, Port) else Port(p, layer) for p in given]
    return [port._replace(layer=layer, node=i) for i, port in enumerate(ports)]
