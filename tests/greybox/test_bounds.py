"""Certified gain bounds: never crossed, by sampling and by search, and tight."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from beamfit.errors import InputError
from beamfit.greybox.bounds import KINDS, cells, gain_bounds, over_cells
from beamfit.greybox.mlp import MLP, Layer, NetworkGain, Port, dense

sampled_gains = jax.jit(lambda net, x: jax.vmap(jax.jacfwd(net.values))(x))
cell_bounds = jax.jit(over_cells)


def tower(kind, seed):
    """Two inputs, a skip connection, two hidden layers of one kind, scales on every port."""
    random = np.random.default_rng(seed)
    layers = [Layer("in", "identity", 2), Layer("h", kind, 3, kind != "identity")]
    layers += [Layer("g", "tanh", 2, True), Layer("out", "linear", 2, True)]
    pairs = [("in", "h"), ("h", "g"), ("g", "out"), ("in", "out"), ("h", "out")]
    size = {layer.name: layer.size for layer in layers}
    return MLP(
        layers,
        pairs,
        [Port("u", "in", 0, 0.7, 0.1), Port("v", "in", 1, 1.3, -0.2)],
        [Port("y", "out", 0, 2.0), Port("z", "out", 1, -0.5, 1.0)],
        {f"{a}->{b}": random.normal(size=(size[a], size[b])) for a, b in pairs},
        {layer.name: random.normal(size=layer.size) for layer in layers if layer.bias},
    )


@pytest.mark.parametrize("kind", KINDS)
def test_no_sampled_gain_leaves_its_cell(kind):
    random = np.random.default_rng(8)
    low, high = cells([-1.0, 0.2], [1.5, 2.0], 6)
    for seed in range(3):
        net = tower(kind, seed)
        bound = cell_bounds(net, *cells((-1.0, 0.2), (1.5, 2.0), 6))
        for _ in range(10):
            inside = low + random.uniform(size=low.shape) * (high - low)
            inside = np.where(random.uniform(size=low.shape) < 0.3, low, inside)
            gains = sampled_gains(net, inside)
            assert (gains >= bound.lower).all()
            assert (gains <= bound.upper).all()
    assert (bound.upper > bound.lower).all()


def test_search_for_a_crossing_finds_none():
    """A local maximiser in every cell, for nets whose gain turns inside."""
    for seed in range(4):
        net = dense(["c"], ["A", "B"], [5], seed=seed, spread=2.0)
        bound = cell_bounds(net, *cells((0.0,), (3.9,), 16))
        low, high = cells([0.0], [3.9], 16)
        for row in range(2):
            slope = jax.jit(jax.grad(lambda c, net=net, row=row: net.values(c[None])[row]))
            for i in range(16):
                for sign, end in ((1, bound.lower), (-1, -bound.upper)):
                    found = minimize_scalar(
                        lambda c, sign=sign, slope=slope: sign * float(slope(c)),
                        bounds=(low[i, 0], high[i, 0]),
                        method="bounded",
                    )
                    assert found.fun >= end[i, row, 0]


def test_rounding_is_outward_at_a_single_point():
    """On a box of one point, the enclosure holds the 50-digit gain and is a few roundings wide."""
    net = dense(["c"], ["A"], [5], seed=1)
    w1, w2 = (np.asarray(net.weights[k]) for k in ("layer0->layer1", "layer1->layer2"))
    b1 = np.asarray(net.biases["layer1"])
    with mpmath.workdps(50):
        for c in np.random.default_rng(0).uniform(-3, 3, 200):
            exact = mpmath.mpf(0)
            for k in range(5):
                t = mpmath.tanh(mpmath.mpf(w1[0, k]) * mpmath.mpf(c) + mpmath.mpf(b1[k]))
                exact += mpmath.mpf(w2[k, 0]) * (1 - t * t) * mpmath.mpf(w1[0, k])
            found = gain_bounds(net, [c], [c])
            low, high = float(found.lower[0, 0]), float(found.upper[0, 0])
            assert mpmath.mpf(low) <= exact <= mpmath.mpf(high)
            assert high - low < 1e-13


def test_64_cells_are_within_two_percent_of_the_true_range():
    """1-5-2 tanh nets with normal weights over the range of Appendix B's current."""
    fine = np.linspace(0.0, 3.9, 20001)[:, None]
    ratios = []
    for seed in range(40):
        net = dense(["c"], ["A", "B"], [5], seed=seed)
        bound = cell_bounds(net, *cells((0.0,), (3.9,), 64))
        gains = sampled_gains(net, fine)[..., 0]
        width = bound.upper.max(0)[:, 0] - bound.lower.min(0)[:, 0]
        ratios += list(np.asarray(width / np.ptp(gains, axis=0)))
    assert min(ratios) >= 1
    assert max(ratios) <= 1.02
    assert np.median(ratios) <= 1.001


def test_the_excess_falls_with_the_cube_of_the_cell():
    net = dense(["u", "v"], ["y"], [4], seed=3)

    def excess(half):
        box = gain_bounds(net, [0.3 - half, -0.2 - half], [0.3 + half, -0.2 + half])
        grid = np.stack(np.meshgrid(*[np.linspace(-half, half, 41)] * 2), -1).reshape(-1, 2)
        gains = sampled_gains(net, grid + np.array([0.3, -0.2]))
        return float((box.upper - box.lower - np.ptp(gains, axis=0)).max())

    # Off-diagonal second-order terms are bounded by their magnitude, which leaves a square here.
    assert excess(0.02) < 0.3 * excess(0.04)


def test_infinite_boxes_give_the_global_range_of_the_slopes():
    net = dense(["c"], ["A"], [5], seed=1)
    w1, w2 = (np.asarray(w) for w in net.weights.values())
    terms = w1[0] * w2[:, 0]
    found = gain_bounds(net, [-np.inf], [np.inf])
    assert float(found.lower[0, 0]) == pytest.approx(terms[terms < 0].sum(), abs=1e-12)
    assert float(found.upper[0, 0]) == pytest.approx(terms[terms > 0].sum(), abs=1e-12)


def test_bounds_as_outputs_of_the_network():
    gains = [
        NetworkGain("low", "y", ("u",), "lower", 8),
        NetworkGain("high", "y", ("u",), "upper", 8),
    ]
    net = dense([Port("u", "", lower=-1.0, upper=2.0)], ["y"], gains=gains, seed=2)
    _, low, high = (float(v) for v in jax.jit(net.__call__)(jnp.array([0.0])))
    bound = cell_bounds(net, *cells((-1.0,), (2.0,), 8))
    assert low == pytest.approx(float(bound.lower.min()), abs=1e-14)
    assert high == pytest.approx(float(bound.upper.max()), abs=1e-14)
    slopes = sampled_gains(net, np.linspace(-1, 2, 500)[:, None])
    assert low <= slopes.min() <= slopes.max() <= high


def test_bounds_are_differentiable_by_the_weights():
    net = dense(["c"], ["A"], [3], seed=1)

    def worst(w):
        changed = MLP(
            net.layers,
            net.connections,
            net.input_ports,
            net.output_ports,
            {**net.weights, "layer0->layer1": w},
            net.biases,
        )
        return over_cells(changed, *cells((0.0,), (1.0,), 4)).upper.max()

    w = net.weights["layer0->layer1"]
    slope = jax.jit(jax.grad(worst))(w)
    step = jnp.zeros_like(w).at[0, 1].set(1e-6)
    value = jax.jit(worst)
    assert float(slope[0, 1]) == pytest.approx(
        float(value(w + step) - value(w - step)) / 2e-6, rel=1e-6
    )


@pytest.mark.parametrize("box", [([0.0], [np.inf]), ([1.0], [0.0])])
def test_cells_need_a_finite_box(box):
    with pytest.raises(InputError, match="finite box"):
        cells(*box, 4)
