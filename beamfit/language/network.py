"""The report's XML form of a multi-layer perceptron (report 3.1.3): text to network and back.

Attributes of the report are kept. Three are beamfit's own: ``lower`` and ``upper`` on an input (the
range over which certified gains hold) and ``cells`` on a gain.
"""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import replace
from xml.etree import ElementTree as Plain

import jax
import jax.numpy as jnp
import numpy as np
from defusedxml import DefusedXmlException, ElementTree

from beamfit.errors import InputError
from beamfit.greybox.mlp import MLP, Gain, Layer, Port, connection
from beamfit.language import document as d
from beamfit.language.expression import error_at

_CLASS = "com.pav.pdas.model.mlp.MlpMapping"


def parse_network(text: str, path: str | os.PathLike[str] | None = None) -> MLP:
    """Read a network from the text of its XML form.

    Parameters
    ----------
    text : str
        A ``<mapping>`` element with layers, connections, inputs, outputs and gains.
    path : path, optional
        Where the text comes from, for messages.

    Returns
    -------
    MLP

    Raises
    ------
    InputError
        If it is not such a document, with the line where the XML itself breaks.

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
        root = ElementTree.fromstring(text)
    except Plain.ParseError as error:
        raise InputError(f"{error}", "well-formed XML", path, error.position[0]) from None
    except DefusedXmlException as error:
        raise InputError(f"{error}", "XML without entities or a document type", path) from None
    try:
        return network_from(root)
    except InputError as error:
        raise InputError(error.found, error.expected, path) from None


def network_from(element: Plain.Element) -> MLP:
    """Read a network from its ``<mapping>`` element, as when it stands inside another document.

    A layer without a ``bias`` attribute has biases unless it is an identity: Appendix B's 22
    weights for 1-5-2 need them, and its layers do not say. Inputs and outputs without ``node`` take
    the nodes of their layer in turn.

    Parameters
    ----------
    element : xml.etree.ElementTree.Element
        The element.

    Returns
    -------
    MLP

    Raises
    ------
    InputError
        If a part is missing or does not fit.
    """
    if element.tag != "mapping":
        raise InputError(f"an element <{element.tag}>", "<mapping>, a network's root element")
    layers = [_layer(e) for e in element.findall("layer")]
    pairs = [(_need(e, "srcName"), _need(e, "dstName")) for e in element.findall("connection")]
    shapes = {layer.name: layer.size for layer in layers}
    biases, weights = {}, {}
    for layer, e in zip(layers, element.findall("layer"), strict=True):
        if layer.bias and _numbers(e) is not None:
            biases[layer.name] = _numbers(e)
    for (source, target), e in zip(pairs, element.findall("connection"), strict=True):
        found = _numbers(e)
        if found is None:
            continue
        wanted = (shapes.get(source, 0), shapes.get(target, 0))
        if found.size != wanted[0] * wanted[1]:
            raise InputError(
                f"{found.size} weights from '{source}' to '{target}'",
                f"{wanted[0]} x {wanted[1]}, one row for each source node",
            )
        weights[connection(source, target)] = found.reshape(wanted)
    return MLP(
        layers,
        pairs,
        _ports(element.findall("input")),
        _ports(element.findall("output")),
        weights,
        biases,
        [_gain(e) for e in element.findall("gain")],
    )


def format_network(net: MLP, name: str = "mlp") -> str:
    """Write a network as XML text; numbers survive exactly.

    Parameters
    ----------
    net : MLP
        The network.
    name : str
        The mapping's name.

    Returns
    -------
    str

    Examples
    --------
    >>> from beamfit.greybox.mlp import dense
    >>> print(format_network(dense(["u"], ["y"], [1])).splitlines()[0])
    <mapping classname="com.pav.pdas.model.mlp.MlpMapping" name="mlp">
    """
    root = Plain.Element("mapping", classname=_CLASS, name=name)
    for tag, ports in (("input", net.input_ports), ("output", net.output_ports)):
        for port in ports:
            e = Plain.SubElement(root, tag, name=port.name, layer=port.layer, node=str(port.node))
            for field, default in Port._field_defaults.items():
                value = getattr(port, field)
                if field != "node" and value != default:
                    e.set(field, repr(float(value)))
    for asked in net.gains:
        by = dict(zip(("da", "db", "dc"), asked.by, strict=False))
        e = Plain.SubElement(root, "gain", name=asked.name, order=str(len(asked.by)))
        e.attrib |= {"type": asked.kind, "dy": asked.output, **by, "cells": str(asked.cells)}
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


def network_of(n: d.Network) -> MLP:
    """Build the network of a document.

    Raises
    ------
    InputError
        With its place, if a part is missing or does not fit.
    """
    root = Plain.Element("mapping")
    for part in n.parts:
        e = Plain.SubElement(root, part.kind, dict(part.attributes))
        e.text = None if part.values is None else ", ".join(map(repr, part.values))
    try:
        return network_from(root)
    except InputError as error:
        raise error_at(n.at, f"{error.found} (network '{n.name}')", error.expected) from None


def weights_of(net: MLP) -> jax.Array:
    """The numbers of a network as one vector: weights of each connection, row by row, then biases.

    Connections and layers stand in the order of the document.
    """
    return jnp.concatenate([jnp.ravel(a) for group in _numbers_of(net) for a in group.values()])


def with_weights(net: MLP, vector: jax.Array) -> MLP:
    """The network with its numbers taken from such a vector."""
    groups, start = [], 0
    for group in _numbers_of(net):
        groups.append({})
        for name, old in group.items():
            groups[-1][name] = vector[start : start + old.size].reshape(old.shape)
            start += old.size
    return replace(net, weights=groups[0], biases=groups[1])


def _numbers_of(net: MLP) -> tuple[dict[str, jax.Array], dict[str, jax.Array]]:
    weights = {(name := connection(*pair)): net.weights[name] for pair in net.connections}
    return weights, {la.name: net.biases[la.name] for la in net.layers if la.bias}


def _need(e: Plain.Element, key: str) -> str:
    """An attribute that must be there."""
    if key not in e.attrib:
        raise InputError(f"<{e.tag} {' '.join(e.attrib.values())}>", f"an attribute {key}")
    return e.attrib[key]


def _number(e: Plain.Element, key: str, default: float, kind: type = float):
    """A numeric attribute."""
    try:
        return kind(e.attrib.get(key, default))
    except ValueError:
        raise InputError(
            f"{key}='{e.attrib[key]}' in <{e.tag}>", f"a number ({kind.__name__})"
        ) from None


def _numbers(e: Plain.Element) -> np.ndarray | None:
    """The comma-separated numbers in an element; None where it is empty."""
    words = (e.text or "").replace(",", " ").split()
    try:
        return np.array([float(word) for word in words]) if words else None
    except ValueError as error:
        raise InputError(f"{error} in <{e.tag}>", "numbers separated by commas") from None


def _layer(e: Plain.Element) -> Layer:
    """A layer's structure."""
    kind = _need(e, "type")
    bias = e.attrib.get("bias", "false" if kind == "identity" else "true").strip().lower()
    if bias not in ("true", "false"):
        raise InputError(f"bias='{bias}' in <layer>", "true or false")
    return Layer(_need(e, "name"), kind, _number(e, "size", 1, int), bias == "true")


def _ports(elements: list[Plain.Element]) -> list[Port]:
    """Inputs or outputs; those without a node take the next of their layer."""
    used: Counter[str] = Counter()
    ports = []
    for e in elements:
        layer = _need(e, "layer")
        node = _number(e, "node", used[layer], int)
        used[layer] = node + 1
        plain = {
            field: _number(e, field, default)
            for field, default in Port._field_defaults.items()
            if field != "node"
        }
        ports.append(Port(_need(e, "name"), layer, node, **plain))
    return ports


def _gain(e: Plain.Element) -> Gain:
    """A gain; its order says how many of da, db, dc are read."""
    order = _number(e, "order", 1, int)
    if not 1 <= order <= 3:
        raise InputError(f"order {order} of the gain '{e.attrib.get('name', '')}'", "1, 2 or 3")
    by = tuple(_need(e, key) for key in ("da", "db", "dc")[:order])
    kind = e.attrib.get("type", "local")
    return Gain(_need(e, "name"), _need(e, "dy"), by, kind, _number(e, "cells", 64, int))


def _text(values) -> str:
    """Numbers as text that reads back to the same floats, one row a line."""
    rows = np.atleast_2d(np.asarray(values))
    return ",\n".join(", ".join(repr(float(v)) for v in row) for row in rows)
