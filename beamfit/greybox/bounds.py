"""Certified bounds of a network's first-order gains over boxes (report 3.1.3; physics.md 5).

The derivatives of order 1 to 3 are enclosed over the box by interval arithmetic with outward
rounding. The gains are then tightened by Taylor's theorem about the box's centre c,
g(c + d) = g(c) + H(c) d + d T(box) d / 2, whose excess falls with the cube of the box's size; so a
range is split into cells. Everything is JAX: a bound is differentiable by the weights and can be a
constraint.
"""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.errors import InputError
from beamfit.greybox.activations import Range, range_of

if TYPE_CHECKING:
    from beamfit.greybox.mlp import MLP

__all__ = ["cells", "gain_bounds", "over_cells"]

_ROUNDING = 2.0**-53
_TINY = 1e-300  # covers underflow, which a relative error does not


class _Nodes(NamedTuple):
    """Enclosures for the n nodes of a layer; each derivative adds one axis of inputs."""

    value: Range
    first: Range
    second: Range
    third: Range


def _largest(a: Range) -> jax.Array:
    """The largest magnitude in a range."""
    return jnp.maximum(jnp.abs(a.lower), jnp.abs(a.upper))


def _shaped(a: Range, *at) -> Range:
    """Index both ends alike."""
    return Range(a.lower[at], a.upper[at])


def _times(a: Range, b: Range) -> Range:
    """Enclose the product of two ranges; zero times anything is zero, also infinity."""
    ends = jnp.stack(
        [jnp.where((p == 0) | (q == 0), 0.0, p * q) for p, q in product(a, b)]
    )
    found = Range(jnp.min(ends, axis=0), jnp.max(ends, axis=0))
    return found.widened(2 * _ROUNDING * _largest(found) + _TINY)


def _plus(*parts: Range) -> Range:
    """Enclose the sum of ranges."""
    found = Range(sum(p.lower for p in parts), sum(p.upper for p in parts))
    size = sum(_largest(p) for p in parts)
    return found.widened(2 * len(parts) * _ROUNDING * size + _TINY)


def _weighted(a: Range, weight: jax.Array) -> Range:
    """Enclose the sum over nodes of weight * a, for a of shape (nodes, ...)."""
    w = jnp.reshape(weight, weight.shape + (1,) * (a.lower.ndim - 1))
    low, high = (jnp.where(w == 0, 0.0, w * end[:, None]) for end in a)
    found = Range(jnp.sum(jnp.minimum(low, high), axis=0), jnp.sum(jnp.maximum(low, high), axis=0))
    size = jnp.sum(_largest(Range(low, high)), axis=0)
    return found.widened(2 * (weight.shape[0] + 2) * _ROUNDING * size + _TINY)


def _activated(s: _Nodes, kind: str) -> _Nodes:
    """Enclose a layer's nodes from its arguments: the chain rule, to third order, for ranges."""
    new, n = np.newaxis, slice(None)
    value, d1, d2, d3 = (range_of(kind, order, s.value) for order in range(4))
    one, two, three = (n, new), (n, new, new), (n, new, new, new)
    i, j = _shaped(s.first, n, n, new), _shaped(s.first, n, new, n)
    pairs = _times(i, j)
    triples = _times(_shaped(pairs, n, n, n, new), _shaped(s.first, n, new, new, n))
    mixed = _plus(
        _times(_shaped(s.second, n, n, n, new), _shaped(s.first, n, new, new, n)),
        _times(_shaped(s.second, n, n, new, n), _shaped(s.first, n, new, n, new)),
        _times(_shaped(s.second, n, new, n, n), _shaped(s.first, n, n, new, new)),
    )
    first = _times(_shaped(d1, *one), s.first)
    second = _plus(_times(_shaped(d2, *two), pairs), _times(_shaped(d1, *two), s.second))
    third = _plus(
        _times(_shaped(d3, *three), triples),
        _times(_shaped(d2, *three), mixed),
        _times(_shaped(d1, *three), s.third),
    )
    return _Nodes(value, first, second, third)


def _entered(s: _Nodes, net: MLP, layer: str, box: Range) -> _Nodes:
    """Add the inputs that enter a layer."""
    value, first = s.value, s.first
    for i, port in enumerate(net.input_ports):
        if port.layer != layer:
            continue
        side = _shaped(box, i)
        ends = [(end - port.bias) / port.scale for end in side]
        error = 4 * _ROUNDING * (_largest(side) + abs(port.bias)) / abs(port.scale) + _TINY
        x = Range(jnp.minimum(*ends), jnp.maximum(*ends)).widened(error)
        joined = _plus(_shaped(value, port.node), x)
        value = Range(*(v.at[port.node].set(e) for v, e in zip(value, joined, strict=True)))
        unit = Range(*[jnp.asarray(1 / port.scale)] * 2).widened(2 * _ROUNDING / abs(port.scale))
        joined = _plus(_shaped(first, port.node, i), unit)
        first = Range(*(f.at[port.node, i].set(e) for f, e in zip(first, joined, strict=True)))
    return s._replace(value=value, first=first)


def _enclose(net: MLP, box: Range) -> _Nodes:
    """Enclose the derivatives of every output over a box."""
    inputs = len(net.input_ports)
    done: dict[str, _Nodes] = {}
    for layer in net.order:
        bias = net.biases.get(layer.name, jnp.zeros(layer.size))
        zeros = [jnp.zeros((layer.size, *(inputs,) * order)) for order in (1, 2, 3)]
        s = _Nodes(Range(bias, bias), *(Range(zero, zero) for zero in zeros))
        for source, target in net.connections:
            if target == layer.name:
                weight = net.weights[f"{source}->{target}"]
                s = _Nodes(
                    *(_plus(a, _weighted(b, weight)) for a, b in zip(s, done[source], strict=True))
                )
        done[layer.name] = _activated(_entered(s, net, layer.name, box), layer.kind)
    return _Nodes(*(_read_out(net, done, order) for order in range(4)))


def _read_out(net: MLP, done: dict[str, _Nodes], order: int) -> Range:
    """Gather one derivative of the output nodes and scale it (values keep their node's scale)."""
    rows = [_shaped(done[port.layer][order], port.node) for port in net.output_ports]
    stacked = Range(*(jnp.stack(ends) for ends in zip(*rows, strict=True)))
    scale = jnp.array([port.scale for port in net.output_ports])
    scale = jnp.reshape(scale, (-1,) + (1,) * order)
    return stacked if order == 0 else _times(stacked, Range(scale, scale))


def _highest(slope: jax.Array, bend: jax.Array, radius: jax.Array) -> jax.Array:
    """Largest value of slope*d + bend*d^2/2 over |d| <= radius, for slope >= 0, rounded up."""
    inside = (bend < 0) & (slope < -bend * radius)
    at_edge = slope * radius + 0.5 * bend * radius**2
    peak = 0.5 * slope**2 / jnp.where(inside, -bend, 1.0)
    error = 16 * _ROUNDING * (slope * radius + jnp.abs(bend) * radius**2) + _TINY
    return jnp.where(inside, peak, at_edge) + jax.lax.stop_gradient(error)


def _taylor(net: MLP, box: Range, whole: _Nodes) -> Range:
    """Enclose the gains over a finite box by Taylor's theorem about its centre."""
    centre = 0.5 * (box.lower + box.upper)
    middle = _enclose(net, Range(centre, centre))
    # Rounded up, so that centre +- radius covers the box.
    radius = jnp.maximum(box.upper - centre, centre - box.lower)
    radius = radius + 4 * _ROUNDING * (jnp.abs(box.lower) + jnp.abs(box.upper))
    slope = _largest(middle.second)
    bend_up = jnp.diagonal(whole.third.upper, axis1=-2, axis2=-1)
    bend_down = jnp.diagonal(whole.third.lower, axis1=-2, axis2=-1)
    cross = _largest(whole.third) * (1 - jnp.eye(len(centre)))
    mixed = 0.5 * jnp.einsum("oijk,j,k->oi", cross, radius, radius)
    terms = 8 * _ROUNDING * (len(centre) ** 2 + 2)
    up, down = (
        (jnp.sum(_highest(slope, bend, radius), axis=-1) + mixed) * (1 + terms)
        for bend in (bend_up, -bend_down)
    )
    return _plus(middle.first, Range(-down, up))


def gain_bounds(net: MLP, lower: jax.Array, upper: jax.Array) -> Range:
    """Enclose every first-order gain of a network over one box.

    Parameters
    ----------
    net : MLP
        The network; its own gain outputs play no part.
    lower, upper : array, shape (inputs,)
        Corners of the box; infinite sides are allowed.

    Returns
    -------
    Range
        `lower` and `upper`, each of shape (output ports, inputs): no input in the box has a gain
        outside, rounding included.

    Examples
    --------
    >>> from beamfit.greybox.mlp import dense
    >>> found = gain_bounds(dense(["u"], ["y"]), jnp.array([0.0]), jnp.array([0.1]))
    >>> bool(found.lower[0, 0] < found.upper[0, 0])
    True
    """
    box = Range(jnp.asarray(lower, float), jnp.asarray(upper, float))
    whole = _enclose(net, box)
    finite = jnp.all(jnp.isfinite(box.upper - box.lower))
    tight = _taylor(net, Range(*(jnp.where(finite, end, 0.0) for end in box)), whole)
    return Range(
        jnp.where(finite, jnp.maximum(whole.first.lower, tight.lower), whole.first.lower),
        jnp.where(finite, jnp.minimum(whole.first.upper, tight.upper), whole.first.upper),
    )


def cells(lower, upper, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Split a box into a grid of cells that leave no gap.

    Parameters
    ----------
    lower, upper : array, shape (inputs,)
        Corners of the box, finite.
    number : int
        Cells along each input.

    Returns
    -------
    tuple of numpy.ndarray, shape (cells, inputs)
        Lower and upper corners; neighbours share their faces exactly.

    Raises
    ------
    InputError
        If the box is empty or infinite, or there is no cell.

    Examples
    --------
    >>> low, high = cells([0.0], [1.0], 2)
    >>> low.tolist(), high.tolist()
    ([[0.0], [0.5]], [[0.5], [1.0]])
    """
    lower, upper = np.asarray(lower, float), np.asarray(upper, float)
    if number < 1 or not np.all(np.isfinite(upper - lower)) or np.any(lower > upper):
        raise InputError(
            f"{number} cells from {lower.tolist()} to {upper.tolist()}",
            "at least one cell of a finite box with lower <= upper",
        )
    edges = [np.linspace(a, b, number + 1) for a, b in zip(lower, upper, strict=True)]
    low = np.stack(np.meshgrid(*[e[:-1] for e in edges], indexing="ij"), -1)
    high = np.stack(np.meshgrid(*[e[1:] for e in edges], indexing="ij"), -1)
    return low.reshape(-1, lower.size), high.reshape(-1, lower.size)


def over_cells(net: MLP, lower, upper, number: int) -> Range:
    """Enclose every first-order gain over each cell of a box.

    Parameters
    ----------
    net : MLP
        The network.
    lower, upper : array, shape (inputs,)
        Corners of the box, finite.
    number : int
        Cells along each input.

    Returns
    -------
    Range
        `lower` and `upper`, each of shape (cells, output ports, inputs). A constraint on all of
        them holds everywhere in the box.

    Raises
    ------
    InputError
        As for `cells`.

    Examples
    --------
    >>> from beamfit.greybox.mlp import dense
    >>> over_cells(dense(["u"], ["y", "z"]), [0.0], [1.0], 4).lower.shape
    (4, 2, 1)
    """
    low, high = cells(lower, upper, number)
    return jax.vmap(lambda a, b: gain_bounds(net, a, b))(low, high)
