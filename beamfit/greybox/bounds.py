"""Node functions of a network, and certified bounds of its gains over boxes (report 3.1.3).

The derivatives of order 1 to 3 are enclosed over the box by interval arithmetic with outward
rounding (physics.md 5). The enclosure of a gain g is then tightened by Taylor's theorem about the
box's centre c, g(c + d) = g(c) + H(c) d + d T(box) d / 2. Its excess falls with the cube of the
box's size, so that a range is split into cells. All is written in JAX: a bound is differentiable by
the weights and can be a constraint.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from beamfit.errors import InputError


class Activation(NamedTuple):
    """A node function and the turning points of its derivatives.

    Parameters
    ----------
    function : callable
        The node function of a scalar.
    turns : tuple of tuple of float
        Turning points of the function and of its derivatives of order 1 to 3; each is monotonic
        between them.
    monotonic : bool
        True if the function never falls.
    """

    function: Callable[[jax.Array], jax.Array]
    turns: tuple[tuple[float, ...], ...]
    monotonic: bool

    def derivative(self, order: int) -> Callable[[jax.Array], jax.Array]:
        """Return the derivative of an order, computed by JAX."""
        function = self.function
        for _ in range(order):
            function = jax.grad(function)
        return function


@jax.custom_jvp
def _logcosh(s):
    return jnp.logaddexp(s, -s) - math.log(2.0)


# JAX's own derivative of logaddexp loses digits in proportion to |s|; d log cosh(s)/ds = tanh(s).
_logcosh.defjvps(lambda t, _, s: jnp.tanh(s) * t)

# Turning points: zeros of the next derivative. With t = tanh(s), the third derivative of tanh is
# -2 (1-t^2) (1-3t^2), the fourth 8 t (1-t^2) (2-3t^2); sigmoid(s) = (1 + tanh(s/2))/2; those of
# exp(-s^2) are the zeros of the Hermite polynomials of order 1 to 4.
_T2, _T3 = math.atanh(math.sqrt(1 / 3)), math.atanh(math.sqrt(2 / 3))
_G1, _G2 = math.sqrt(1 / 2), math.sqrt(3 / 2)
_G3, _G4 = (math.sqrt((3 + sign * math.sqrt(6)) / 2) for sign in (-1, 1))
_NONE: tuple[tuple[float, ...], ...] = ((), (), (), ())

KINDS: dict[str, Activation] = {
    "identity": Activation(lambda s: s, _NONE, True),
    "linear": Activation(lambda s: s, _NONE, True),
    "quadratic": Activation(lambda s: s * s, ((0.0,), (), (), ()), False),
    "sigmoid": Activation(
        jax.nn.sigmoid, ((), (0.0,), (-2 * _T2, 2 * _T2), (-2 * _T3, 0.0, 2 * _T3)), True
    ),
    "tanh": Activation(jnp.tanh, ((), (0.0,), (-_T2, _T2), (-_T3, 0.0, _T3)), True),
    "gaussian": Activation(
        lambda s: jnp.exp(-s * s),
        ((0.0,), (-_G1, _G1), (-_G2, 0.0, _G2), (-_G4, -_G3, _G3, _G4)),
        False,
    ),
    "logcosh": Activation(_logcosh, ((0.0,), (), (0.0,), (-_T2, _T2)), False),
}
"""Node functions by the report's names; gaussian is exp(-s^2), logcosh is log(cosh(s))."""


class Range(NamedTuple):
    """An enclosure by two ends: all values lie between `lower` and `upper`."""

    lower: jax.Array
    upper: jax.Array

    def widened(self, error: jax.Array) -> Range:
        """Move both ends outward by a rounding error, which is not differentiated."""
        error = jax.lax.stop_gradient(error)
        return Range(self.lower - error, self.upper + error)


# Largest error of one evaluation in units of 1 + |value|: 64 roundings. Tests compare all
# derivatives with 50-digit arithmetic; XLA's tanh and exp are accurate to a few roundings.
_ERROR = 64 * 2.0**-53


def range_of(kind: str, order: int, s: Range) -> Range:
    """Enclose the derivative of a node function over ranges of its argument.

    Between its turning points the derivative is monotonic, so that its range is spanned by its
    values at the ends and at the turning points inside. Rounding widens it.

    Parameters
    ----------
    kind : str
        A key of `KINDS`.
    order : int
        0 to 3.
    s : Range
        Range of the argument, of any shape.

    Returns
    -------
    Range
        Of the same shape as `s`.

    Examples
    --------
    >>> slope = range_of("tanh", 1, Range(jnp.array([-1.0]), jnp.array([2.0])))
    >>> round(float(slope.lower[0]), 4), round(float(slope.upper[0]), 4)
    (0.0707, 1.0)
    """
    turns = KINDS[kind].turns[order]
    at = [s.lower, s.upper, *(jnp.clip(t, s.lower, s.upper) for t in turns)]
    values = jnp.vectorize(KINDS[kind].derivative(order))(jnp.stack(at))
    found = Range(jnp.min(values, axis=0), jnp.max(values, axis=0))
    return found.widened(_ERROR * (1 + jnp.max(jnp.abs(values), axis=0)))


# Relative error of one operation in double precision: half the distance between neighbours.
_ROUNDING = 2.0**-53
# Added to errors to cover underflow, which a relative error does not.
_TINY = 1e-300


class _Ball(NamedTuple):
    """An enclosure of finite numbers by a centre and a radius.

    It is faster than two ends and as tight for narrow ranges, as products need no comparison of
    signs.
    """

    centre: jax.Array
    radius: jax.Array

    def __getitem__(self, at) -> _Ball:
        """Index both parts alike."""
        return _Ball(self.centre[at], self.radius[at])

    @property
    def largest(self) -> jax.Array:
        """Largest magnitude in the ball."""
        return jnp.abs(self.centre) + self.radius


class _Nodes(NamedTuple):
    """Enclosures of the n nodes of a layer and their derivatives, each with one more input axis."""

    value: Range
    first: _Ball
    second: _Ball
    third: _Ball


def _widen(found: _Ball, size: jax.Array, operations: int) -> _Ball:
    """Widen a ball by the rounding of some operations on numbers of a given size."""
    error = 2 * operations * _ROUNDING * jax.lax.stop_gradient(size) + _TINY
    return _Ball(found.centre, found.radius + error)


def _multiply(a: _Ball, b: _Ball) -> _Ball:
    """Enclose a product."""
    radius = jnp.abs(a.centre) * b.radius + a.radius * b.largest
    return _widen(_Ball(a.centre * b.centre, radius), a.largest * b.largest, 4)


def _add(*parts: _Ball) -> _Ball:
    """Enclose a sum."""
    found = _Ball(sum(p.centre for p in parts), sum(p.radius for p in parts))
    return _widen(found, sum(p.largest for p in parts), 2 * len(parts))


def _weighted_sum(a: _Ball, weight: jax.Array) -> _Ball:
    """Enclose the sum over nodes of weight * a, for a of shape (nodes, ...)."""
    size = jnp.abs(weight)
    found = _Ball(*(jnp.tensordot(w, p, (0, 0)) for w, p in zip((weight, size), a, strict=True)))
    return _widen(found, jnp.tensordot(size, a.largest, (0, 0)), 2 * weight.shape[0] + 4)


def _weighted_range(a: Range, weight: jax.Array) -> Range:
    """Enclose the sum over nodes of weight * a, with ends that may be infinite."""
    low, high = (jnp.where(weight == 0, 0.0, weight * end[:, None]) for end in a)
    found = Range(jnp.sum(jnp.minimum(low, high), axis=0), jnp.sum(jnp.maximum(low, high), axis=0))
    size = jnp.sum(jnp.maximum(jnp.abs(low), jnp.abs(high)), axis=0)
    return found.widened(2 * (weight.shape[0] + 2) * _ROUNDING * size + _TINY)


def _add_ranges(a: Range, b: Range) -> Range:
    """Enclose the sum of two ranges."""
    found = Range(a.lower + b.lower, a.upper + b.upper)
    return found.widened(4 * _ROUNDING * (jnp.abs(found.lower) + jnp.abs(found.upper)) + _TINY)


def _ball(a: Range) -> _Ball:
    """Make the ball around a range."""
    centre = 0.5 * (a.lower + a.upper)
    radius = 0.5 * (a.upper - a.lower)
    return _widen(_Ball(centre, radius), jnp.abs(a.lower) + jnp.abs(a.upper), 2)


def _apply_function(s: _Nodes, kind: str) -> _Nodes:
    """Enclose a layer's nodes from their arguments by the chain rule to third order."""
    if kind in ("identity", "linear"):
        return s
    new, n = np.newaxis, slice(None)
    d1, d2, d3 = (_ball(range_of(kind, order, s.value)) for order in (1, 2, 3))
    i, j, k = s.first[n, n, new, new], s.first[n, new, n, new], s.first[n, new, new, n]
    pairs = _multiply(s.first[n, n, new], s.first[n, new, n])
    mixed = _add(
        _multiply(s.second[n, n, n, new], k),
        _multiply(s.second[n, n, new, n], j),
        _multiply(s.second[n, new, n, n], i),
    )
    second = _add(_multiply(d2[n, new, new], pairs), _multiply(d1[n, new, new], s.second))
    third = _add(
        _multiply(d3[n, new, new, new], _multiply(pairs[n, n, n, new], k)),
        _multiply(d2[n, new, new, new], mixed),
        _multiply(d1[n, new, new, new], s.third),
    )
    return _Nodes(range_of(kind, 0, s.value), _multiply(d1[n, new], s.first), second, third)


def _add_inputs(s: _Nodes, net: Any, layer: str, box: Range) -> _Nodes:
    """Add the inputs that enter a layer."""
    value, first = s.value, s.first
    for i, port in enumerate(net.input_ports):
        if port.layer != layer:
            continue
        side = Range(box.lower[i], box.upper[i])
        ends = [(end - port.bias) / port.scale for end in side]
        size = jnp.maximum(*(jnp.abs(end) for end in side)) + abs(port.bias)
        x = Range(jnp.minimum(*ends), jnp.maximum(*ends))
        x = x.widened(4 * _ROUNDING * size / abs(port.scale) + _TINY)
        joined = _add_ranges(Range(*(v[port.node] for v in value)), x)
        value = Range(*(v.at[port.node].set(e) for v, e in zip(value, joined, strict=True)))
        unit = _widen(_Ball(jnp.asarray(1 / port.scale), 0.0), 1 / abs(port.scale), 1)
        joined = _add(first[port.node, i], unit)
        first = _Ball(*(f.at[port.node, i].set(e) for f, e in zip(first, joined, strict=True)))
    return s._replace(value=value, first=first)


def _enclose(net: Any, box: Range) -> _Nodes:
    """Enclose all outputs' derivatives over a box; values stay in the scale of the nodes."""
    inputs = len(net.input_ports)
    done: dict[str, _Nodes] = {}
    for layer in net.order:
        bias = net.biases.get(layer.name, jnp.zeros(layer.size))
        zeros = [jnp.zeros((layer.size, *(inputs,) * order)) for order in (1, 2, 3)]
        s = _Nodes(Range(bias, bias), *(_Ball(zero, zero) for zero in zeros))
        for source, target in net.connections:
            if target == layer.name:
                weight, before = net.weights[f"{source}->{target}"], done[source]
                value = _add_ranges(s.value, _weighted_range(before.value, weight))
                rest = (
                    _add(a, _weighted_sum(b, weight))
                    for a, b in zip(s[1:], before[1:], strict=True)
                )
                s = _Nodes(value, *rest)
        done[layer.name] = _apply_function(_add_inputs(s, net, layer.name, box), layer.kind)
    rows = [
        jax.tree_util.tree_map(lambda part, p=port: part[p.node], done[port.layer])
        for port in net.output_ports
    ]
    stacked = jax.tree_util.tree_map(lambda *parts: jnp.stack(parts), *rows)
    scale = jnp.array([port.scale for port in net.output_ports])
    scales = (jnp.reshape(scale, (-1, *(1,) * order)) for order in (1, 2, 3))
    rest = (_multiply(b, _Ball(c, 0.0)) for b, c in zip(stacked[1:], scales, strict=True))
    return _Nodes(stacked.value, *rest)


def _maximum(slope: jax.Array, curvature: jax.Array, radius: jax.Array) -> jax.Array:
    """Maximise slope*d + curvature*d^2/2 over |d| <= radius for slope >= 0, rounded up."""
    inside = (curvature < 0) & (slope < -curvature * radius)
    at_edge = slope * radius + 0.5 * curvature * radius**2
    peak = 0.5 * slope**2 / jnp.where(inside, -curvature, 1.0)
    error = 16 * _ROUNDING * (slope * radius + jnp.abs(curvature) * radius**2) + _TINY
    return jnp.where(inside, peak, at_edge) + jax.lax.stop_gradient(error)


def _taylor(at_centre: _Nodes, over_box: _Nodes, radius: jax.Array) -> Range:
    """Enclose the gains over a finite box by Taylor's theorem about its centre."""
    n = len(radius)
    curvature = _Ball(*(jnp.diagonal(part, axis1=-2, axis2=-1) for part in over_box.third))
    cross = over_box.third.largest * (1 - jnp.eye(n))
    mixed = 0.5 * jnp.einsum("oijk,j,k->oi", cross, radius, radius)
    slope = at_centre.second.largest
    up, down = (
        (
            jnp.sum(_maximum(slope, sign * curvature.centre + curvature.radius, radius), axis=-1)
            + mixed
        )
        for sign in (1, -1)
    )
    size = jnp.abs(up) + jnp.abs(down) + mixed + at_centre.first.largest
    reach = at_centre.first.radius + 8 * (n**2 + 2) * _ROUNDING * jax.lax.stop_gradient(size)
    return Range(at_centre.first.centre - down - reach, at_centre.first.centre + up + reach)


@jax.jit
def gain_bounds(net: Any, lower: jax.Array, upper: jax.Array) -> Range:
    """Enclose all first-order gains of a network over one box.

    Parameters
    ----------
    net : MLP
        The network; its gain outputs have no effect.
    lower, upper : array, shape (inputs,)
        Corners of the box; infinite sides are allowed.

    Returns
    -------
    Range
        `lower` and `upper`, each of shape (output ports, inputs). No input in the box has a gain
        outside them, rounding included.

    Examples
    --------
    >>> from beamfit.greybox.mlp import dense
    >>> found = gain_bounds(dense(["u"], ["y"]), jnp.array([0.0]), jnp.array([0.1]))
    >>> bool(found.lower[0, 0] < found.upper[0, 0])
    True
    """
    lower, upper = jnp.asarray(lower, float), jnp.asarray(upper, float)
    finite = jnp.all(jnp.isfinite(upper - lower))
    low, high = (jnp.where(finite, end, 0.0) for end in (lower, upper))
    centre = 0.5 * (low + high)
    # Rounded up, so that centre +- radius covers the box.
    radius = jnp.maximum(high - centre, centre - low)
    radius = radius + 4 * _ROUNDING * (jnp.abs(low) + jnp.abs(high))
    boxes = Range(jnp.stack([lower, centre]), jnp.stack([upper, centre]))
    both = jax.vmap(lambda box: _enclose(net, box))(boxes)
    over_box, at_centre = (jax.tree_util.tree_map(lambda part, i=i: part[i], both) for i in (0, 1))
    tight = _taylor(at_centre, over_box, radius)
    # An infinite slope has no ball: its centre is NaN, and the gain is not limited.
    finite_slope = jnp.isfinite(over_box.first.radius)
    reach = jnp.where(finite_slope, over_box.first.radius, jnp.inf)
    around = jnp.where(finite_slope, over_box.first.centre, 0.0)
    return Range(
        jnp.where(finite, jnp.maximum(around - reach, tight.lower), around - reach),
        jnp.where(finite, jnp.minimum(around + reach, tight.upper), around + reach),
    )


def cells(lower, upper, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Split a box into a grid of cells that leave no gap.

    Parameters
    ----------
    lower, upper : array, shape (inputs,)
        Corners of the box, finite.
    number : int
        Number of cells along each input.

    Returns
    -------
    tuple of numpy.ndarray, shape (cells, inputs)
        Lower and upper corners; neighbouring cells share their faces exactly.

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


def over_cells(net: Any, lower: jax.Array, upper: jax.Array) -> Range:
    """Enclose all first-order gains of a network over several boxes.

    Parameters
    ----------
    net : MLP
        The network.
    lower, upper : array, shape (cells, inputs)
        Corners of the boxes, such as those of `cells`.

    Returns
    -------
    Range
        `lower` and `upper`, each of shape (cells, output ports, inputs). Limits that hold for all
        of them hold everywhere in the boxes.

    Examples
    --------
    >>> from beamfit.greybox.mlp import dense
    >>> over_cells(dense(["u"], ["y", "z"]), *cells([0.0], [1.0], 4)).lower.shape
    (4, 2, 1)
    """
    return jax.vmap(lambda a, b: gain_bounds(net, a, b))(lower, upper)
