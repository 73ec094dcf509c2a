"""Reader and writer of the report's XML form of a multi-layer perceptron (report 3.1.3).

Attributes are those of the report and three extensions: ``lower`` and ``upper`` of an input (the
range over which certified gains hold) and ``cells`` of a gain.
"""

from __future__ import annotations

import os
from collections import Counter
from xml.etree import ElementTree as Plain

import numpy as np

from beamfit.errors import InputError
from beamfit.greybox import tree
from beamfit.greybox.mlp import MLP, Layer, NetworkGain, Port, connection
from beamfit.language import document as d
from beamfit.language.expression import error_at
from beamfit.language.xml import MLP_CLASS, Node, read_elements

# Numeric attributes of a port, with their defaults.
NUMBERS = {name: value for name, value in Port._field_defaults.items() if name != "node"}


def parse_network(text: str, path: str | os.PathLike[str] | None = None) -> MLP:
    """Read a network from the text of its XML form.

    Parameters
    ----------
    text : str
        A ``<mapping>`` element with layers, connections, inputs, outputs and gains.
    path : path, optional
        File of the text, for messages.

    Returns
    -------
    MLP

    Raises
    ------
    InputError
        If it is not such a document; with the line of an error in the XML.

    Examples
    --------
    >>> net = parse_network('''<mapping>
    ...   <layer name="in" type="identity" size="1"/>
    ...   <layer name="out" type="linear" bias="true" size="1">0.5</layer>
    ...   <connection srcName="in" dstName="out">2</connection>
    ...   <input name="u" layer="in"/> <output name="y" layer="out"/>
    ... </mapping>''')
    >>> net([3.0]).tolist()
    [6.5]
    """
    try:
        root = read_elements(text)
        if root.tag != "mapping":
            found = f"an element <{root.tag}>"
            raise root.error(found, "<mapping>, a network's root element")
        return network_from(root)
    except InputError as error:
        raise InputError(error.found, error.expected, path, error.line) from None


def network_from(element: Node) -> MLP:
    """Read a network from its ``<mapping>`` element, which may be part of another document.

    A layer without a ``bias`` attribute has biases unless it is an identity: the 22 weights of the
    1-5-2 network of Appendix B include biases, but its layers have no such attribute. Inputs and
    outputs without ``node`` take the nodes of their layer in turn.

    Parameters
    ----------
    element : Node
        The element.

    Returns
    -------
    MLP

    Raises
    ------
    InputError
        If a part is missing or does not fit.
    """
    layers = [_layer(e) for e in element.all("layer")]
    pairs = [(e.need("srcName"), e.need("dstName")) for e in element.all("connection")]
    shapes = {layer.name: layer.size for layer in layers}
    biases, weights = {}, {}
    for layer, e in zip(layers, element.all("layer"), strict=True):
        if layer.bias and (found := e.numbers()):
            biases[layer.name] = found
    for (source, target), e in zip(pairs, element.all("connection"), strict=True):
        if found := e.numbers():
            wanted = (shapes.get(source, 0), shapes.get(target, 0))
            if len(found) != wanted[0] * wanted[1]:
                expected = f"{wanted[0]} x {wanted[1]}, one row for each source node"
                raise e.error(f"{len(found)} weights from '{source}' to '{target}'", expected)
            weights[connection(source, target)] = np.reshape(found, wanted)
    inputs, outputs = (_ports(element.all(tag)) for tag in ("input", "output"))
    gains = [_gain(e) for e in element.all("gain")]
    return MLP(layers, pairs, inputs, outputs, weights, biases, gains)


def format_network(net: MLP, name: str = "mlp") -> str:
    """Write a network as XML text; numbers are kept exactly.

    Parameters
    ----------
    net : MLP
        The network.
    name : str
        Name of the mapping.

    Returns
    -------
    str

    Examples
    --------
    >>> from beamfit.greybox.mlp import dense
    >>> print(format_network(dense(["u"], ["y"], [1])).splitlines()[0])
    <mapping classname="com.pav.pdas.model.mlp.MlpMapping" name="mlp">
    """
    root = Plain.Element("mapping", classname=MLP_CLASS, name=name)
    for tag, ports in (("input", net.input_ports), ("output", net.output_ports)):
        for port in ports:
            e = Plain.SubElement(root, tag, name=port.name, layer=port.layer, node=str(port.node))
            for field, default in NUMBERS.items():
                if (value := getattr(port, field)) != default:
                    e.set(field, repr(float(value)))
    for gain in net.gains:
        by = dict(zip(("da", "db", "dc"), gain.by, strict=False))
        e = Plain.SubElement(root, "gain", name=gain.name, order=str(len(gain.by)))
        e.attrib |= {"type": gain.kind, "dy": gain.output, **by, "cells": str(gain.cells)}
    for layer in net.layers:
        bias = str(layer.bias).lower()
        e = Plain.SubElement(
            root, "layer", name=layer.name, type=layer.kind, size=str(layer.size), bias=bias
        )
        if layer.bias:
            e.text = _text(net.biases[layer.name])
    for source, target in net.connections:
        e = Plain.SubElement(root, "connection", srcName=source, dstName=target)
        e.text = _text(net.weights[connection(source, target)])
    Plain.indent(root)
    return Plain.tostring(root, encoding="unicode") + "\n"


def network_of(n: d.NetworkDefinition) -> MLP:
    """Build the network of a document.

    Raises
    ------
    InputError
        With its place, if a part is missing or does not fit.
    """
    parts = []
    for part in n.parts:
        given = dict(part.attributes)
        text = [] if part.values is None else [", ".join(map(repr, part.values))]
        parts.append(Node(part.kind, given, [], text, dict.fromkeys(["", *given], part.at)))
    root = Node("mapping", {}, parts, [], {"": n.at})
    try:
        return network_from(root)
    except InputError as error:
        raise error_at(n.at, f"{error.found} (network '{n.name}')", error.expected) from None


def weight_leaves(net: MLP) -> tuple[tree.Leaf, ...]:
    """Return the numbers of a network: weights of each connection, row by row, then biases.

    Connections and layers are in the order of the document.
    """
    paths = [f"weights.{connection(*pair)}" for pair in net.connections]
    paths += [f"biases.{layer.name}" for layer in net.layers if layer.bias]
    return tuple(leaf for path in paths for leaf in tree.find_leaves(net, path))


def _layer(e: Node) -> Layer:
    """Read a layer."""
    kind = e.need("type")
    bias = e.attributes.get("bias", "false" if kind == "identity" else "true").strip().lower()
    if bias not in ("true", "false"):
        raise e.error(f"bias='{bias}' in <layer>", "true or false", "bias")
    return Layer(e.need("name"), kind, e.number("size", 1, int), bias == "true")


def _ports(elements: list[Node]) -> list[Port]:
    """Read ports; those without ``node`` take the nodes in turn."""
    used: Counter[str] = Counter()
    ports = []
    for e in elements:
        layer = e.need("layer")
        node = e.number("node", used[layer], int)
        used[layer] = node + 1
        plain = {field: e.number(field, default) for field, default in NUMBERS.items()}
        ports.append(Port(e.need("name"), layer, node, **plain))
    return ports


def _gain(e: Node) -> NetworkGain:
    """Read a gain."""
    order = e.number("order", 1, int)
    if not 1 <= order <= 3:
        raise e.error(f"order {order} of the gain '{e.attributes.get('name', '')}'", "1, 2 or 3")
    by = tuple(e.need(key) for key in ("da", "db", "dc")[:order])
    kind = e.attributes.get("type", "local")
    return NetworkGain(e.need("name"), e.need("dy"), by, kind, e.number("cells", 64, int))


def _text(values) -> str:
    """Write numbers that read back to the same floats, one row a line."""
    rows = np.atleast_2d(np.asarray(values))
    return ",\n".join(", ".join(repr(float(v)) for v in row) for row in rows)
