"""Networks: node functions, connections, scales, gains, the XML form."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from beamfit.errors import InputError
from beamfit.greybox.bounds import KINDS, Range, range_of
from beamfit.greybox.mlp import MLP, Layer, NetworkGain, Port, dense
from beamfit.greybox.signed_network import monotone_signs
from beamfit.language.network_xml import format_network, parse_network

# The report's own example (3.1.3), put together from its fragments; weights are its numbers
# divided by 10 so that no node saturates.
REPORT_NETWORK = """
<mapping>
  <layer name="layer0" type="identity" size="3"/>
  <layer name="layer1" type="tanh" bias="true" size="5">0.54, 0.43, 0.32, 0.21, 0.10</layer>
  <layer name="layer2" type="linear" bias="true" size="2">1.2, 2.3</layer>
  <connection srcName="layer0" dstName="layer1">
    0.11, 0.12, 0.13, 0.14, 0.15, 0.21, 0.22, 0.23, 0.24, 0.25, 0.31, 0.32, 0.33, 0.34, 0.35
  </connection>
  <connection srcName="layer1" dstName="layer2">
    0.11, 0.12, 0.21, 0.22, 0.31, 0.32, 0.41, 0.42, 0.51, 0.52,
  </connection>
  <input name="x1" layer="layer0" scale="1.750" bias="0.03"/>
  <input name="x2" layer="layer0" scale="327.1" bias="65.7"/>
  <input name="x3" layer="layer0" scale="29.48" bias="-3.2"/>
  <output name="y1" layer="layer2" scale="273.1" bias="37.6"/>
  <output name="y2" layer="layer2" scale="2.38" bias="0.19"/>
  <gain name="dy1dx1" dy="y1" da="x1"/>
  <gain name="dy1dx2" dy="y1" da="x2"/>
  <gain name="d2y1dx12" order="2" dy="y1" da="x1" db="x1"/>
  <gain name="d2y1dx1dx2" order="2" dy="y1" da="x1" db="x2"/>
</mapping>
"""


def report_network_by_hand(x):
    """The same network written out in NumPy, with physical = scale * node + bias at both ends."""
    node = (np.array(x) - [0.03, 65.7, -3.2]) / [1.750, 327.1, 29.48]
    first = np.array([[11, 12, 13, 14, 15], [21, 22, 23, 24, 25], [31, 32, 33, 34, 35]]) / 100
    last = np.array([[11, 12], [21, 22], [31, 32], [41, 42], [51, 52]]) / 100
    hidden = np.tanh([0.54, 0.43, 0.32, 0.21, 0.10] + node @ first)
    return ([1.2, 2.3] + hidden @ last) * [273.1, 2.38] + [37.6, 0.19]


def test_the_reports_network_reads_and_computes():
    net = parse_network(REPORT_NETWORK)
    assert net.inputs == ("x1", "x2", "x3")
    assert net.outputs == ("y1", "y2", "dy1dx1", "dy1dx2", "d2y1dx12", "d2y1dx1dx2")
    x = np.array([1.0, 200.0, -10.0])
    found = np.asarray(jax.jit(net.__call__)(x))
    np.testing.assert_allclose(found[:2], report_network_by_hand(x), rtol=1e-14)

    def shifted(a=0.0, b=0.0):
        return report_network_by_hand(x + np.array([a, b, 0.0]))[0]

    h, k = 1e-3, 0.3
    np.testing.assert_allclose(found[2], (shifted(h) - shifted(-h)) / (2 * h), rtol=1e-6)
    np.testing.assert_allclose(found[3], (shifted(0, k) - shifted(0, -k)) / (2 * k), rtol=1e-6)
    second = (shifted(h) - 2 * shifted() + shifted(-h)) / h**2
    np.testing.assert_allclose(found[4], second, rtol=1e-5)
    mixed = (shifted(h, k) - shifted(h, -k) - shifted(-h, k) + shifted(-h, -k)) / (4 * h * k)
    np.testing.assert_allclose(found[5], mixed, rtol=1e-5)


def test_third_order_gain_of_a_single_tanh():
    net = MLP(
        [Layer("in", "identity", 1), Layer("out", "tanh", 1, True)],
        [("in", "out")],
        [Port("u", "in")],
        [Port("y", "out", scale=2.0)],
        {"in->out": [[1.5]]},
        {"out": [0.2]},
        [NetworkGain(f"g{n}", "y", ("u",) * n) for n in (1, 2, 3)],
    )
    t = float(mpmath.tanh(mpmath.mpf(1.5) * 0.4 + 0.2))
    slope = 1 - t * t
    expected = [2 * t, 3 * slope, -9 * t * slope, -13.5 * slope * (1 - 3 * t * t)]
    np.testing.assert_allclose(jax.jit(net.__call__)(jnp.array([0.4])), expected, rtol=1e-13)


EXACT = {
    "identity": lambda s: s,
    "linear": lambda s: s,
    "quadratic": lambda s: s * s,
    "sigmoid": lambda s: 1 / (1 + mpmath.exp(-s)),
    "tanh": mpmath.tanh,
    "gaussian": lambda s: mpmath.exp(-s * s),
    "logcosh": lambda s: mpmath.log(mpmath.cosh(s)),
}


@pytest.mark.parametrize("kind", KINDS)
def test_ranges_hold_the_50_digit_derivatives_and_turn_where_they_should(kind):
    points = np.concatenate([np.linspace(-6, 6, 41), [-300.0, -25.0, 1e-9, 18.0, 40.0, 700.0]])
    with mpmath.workdps(50):
        for order in range(4):
            at = jnp.asarray(points)
            found = jax.jit(range_of, static_argnums=(0, 1))(kind, order, Range(at, at))
            for low, high, s in zip(*map(np.asarray, found), points, strict=True):
                exact = mpmath.taylor(EXACT[kind], mpmath.mpf(s), order)[order]
                exact *= mpmath.factorial(order)
                assert mpmath.mpf(low) <= exact <= mpmath.mpf(high), (order, s)
                assert high - low < 1e-13 * (1 + abs(exact))
    random = np.random.default_rng(3)
    ends = np.sort(random.uniform(-4, 4, (200, 2)))
    inside = ends[:, :1] + np.linspace(0, 1, 301) * (ends[:, 1:] - ends[:, :1])
    for order in range(4):
        wide = range_of(kind, order, Range(*jnp.asarray(ends.T)))
        sampled = jnp.vectorize(KINDS[kind].derivative(order))(jnp.asarray(inside))
        assert (sampled.min(1) >= wide.lower).all()
        assert (sampled.max(1) <= wide.upper).all()
        assert (wide.upper - wide.lower <= np.ptp(sampled, axis=1) + 2e-2).all()


def test_skip_connections_and_inputs_on_any_layer():
    net = MLP(
        [
            Layer("out", "linear", 1, True),  # before its sources: order does not matter
            Layer("mid", "quadratic", 2),
            Layer("in", "identity", 1),
        ],
        [("in", "mid"), ("in", "out"), ("mid", "out")],
        [Port("u", "in"), Port("v", "mid", 1)],
        [Port("y", "out"), Port("m", "mid", 1)],
        {"in->mid": [[2.0, 3.0]], "in->out": [[5.0]], "mid->out": [[1.0], [-1.0]]},
        {"out": [0.5]},
    )
    u, v = 0.7, 0.2
    m = (3 * u + v) ** 2
    np.testing.assert_allclose(net(jnp.array([u, v])), [0.5 + 5 * u + 4 * u**2 - m, m], rtol=1e-14)


def test_xml_round_trip_is_exact():
    ports = [Port("u", "", lower=-1.0, upper=2.0, scale=0.1), Port("v", "", bias=1 / 3)]
    gains = [NetworkGain("g", "y", ("u", "v")), NetworkGain("top", "y", ("u",), "upper", 8)]
    net = dense(ports, ["y", "z"], [3, 2], kind="gaussian", seed=4, gains=gains)
    back = parse_network(format_network(net))
    assert jax.tree_util.tree_structure(back) == jax.tree_util.tree_structure(net)
    for a, b in zip(jax.tree_util.tree_leaves(back), jax.tree_util.tree_leaves(net), strict=True):
        np.testing.assert_array_equal(a, b)
    assert format_network(back) == format_network(net)


def test_appendix_b_network_has_22_weights():
    net = parse_network("""<mapping classname='com.pav.pdas.model.mlp.MlpMapping' name='mlp'>
      <input name='c' layer='layer0' node='0' scale='1'/>
      <output name='A' layer='layer2' node='0' scale='1'/>
      <output name='B' layer='layer2' node='1' scale='1'/>
      <gain name='dAdc' order='1' type='local' dy='A' da='c' />
      <layer name='layer0' size='1' type='identity'/>
      <layer name='layer1' size='5' type='tanh'/>
      <layer name='layer2' size='2' type='linear'/>
      <connection srcName='layer0' dstName='layer1'/>
      <connection srcName='layer1' dstName='layer2'/>
    </mapping>""")
    assert sum(leaf.size for leaf in jax.tree_util.tree_leaves(net)) == 22
    assert net.outputs == ("A", "B", "dAdc")


BAD = {
    "line": ("<mapping>\n<layer name='a'\n</mapping>", ":3: "),
    "entity": ("<!DOCTYPE m [<!ENTITY e 'x'>]><mapping>&e;</mapping>", "entities"),
    "root": ("<net/>", "<mapping>"),
    "type": ("<mapping><layer name='a' type='tan' size='1'/></mapping>", "did you mean tanh"),
    "size": ("<mapping><layer name='a' type='tanh' size='x'/></mapping>", "size='x'"),
    "weights": (REPORT_NETWORK.replace("0.11, 0.12, 0.13,", "0.11, 0.12,"), "14 weights"),
    "biases": (REPORT_NETWORK.replace("1.2, 2.3</layer>", "1.2</layer>"), "shape (2,)"),
    "number": (REPORT_NETWORK.replace("1.2, 2.3</layer>", "1.2, two</layer>"), "'two'"),
    "layer": (REPORT_NETWORK.replace('dstName="layer2"', 'dstName="layer3"'), "layer3"),
    "loop": (
        REPORT_NETWORK.replace(
            "</mapping>", '<connection srcName="layer2" dstName="layer1"/></mapping>'
        ),
        "loop",
    ),
    "order": (REPORT_NETWORK.replace('order="2"', 'order="4"'), "order 4"),
    "bound": (REPORT_NETWORK.replace('order="2"', 'order="2" type="upper"'), "order 1"),
    "scale": (REPORT_NETWORK.replace('scale="1.750"', 'scale="0"'), "not zero"),
}


@pytest.mark.parametrize("case", sorted(BAD))
def test_broken_documents_are_refused_with_the_place(case):
    text, said = BAD[case]
    with pytest.raises(InputError) as raised:
        parse_network(text, "net.xml")
    assert "net.xml" in str(raised.value)
    assert said in str(raised.value)


def test_signed_weights_make_every_output_monotonic():
    net = dense(["u", "v"], ["y", "z"], [4, 3], seed=2, spread=2.0)
    signs = monotone_signs(net, {"u": -1})
    weights = {
        k: jnp.where(signs[k] == 0, w, signs[k] * jnp.abs(w)) for k, w in net.weights.items()
    }
    bound = MLP(net.layers, net.connections, net.input_ports, net.output_ports, weights, net.biases)
    points = np.random.default_rng(0).uniform(-3, 3, (2000, 2))
    gains = jax.jit(jax.vmap(jax.jacfwd(bound.values)))(points)
    assert gains[:, :, 0].max() <= 0
    assert gains[:, :, 1].min() < 0 < gains[:, :, 1].max()
    free = jax.jit(jax.vmap(jax.jacfwd(net.values)))(points)
    assert free[:, :, 0].max() > 0


def test_monotonic_networks_refuse_node_functions_that_fall():
    with pytest.raises(InputError, match="layer1"):
        monotone_signs(dense(["u"], ["y"], kind="gaussian"), {"u": 1})
