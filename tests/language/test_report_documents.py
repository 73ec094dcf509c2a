"""The report's five documents against models written by hand, in value and gradient.

Data are SIMULATED: the report's 14 points were never published.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from beamfit.greybox.solve import solve
from beamfit.io.formulation import read_formulation, read_numbers
from beamfit.language.compiled import compile_mapping
from beamfit.language.parse import parse_document
from beamfit.language.problem import formulate
from tests.greybox import appendices as by_hand

DATA = "formulations/fitdata_simulated.csv"
NAMES = ["appendix_a", "appendix_b", "appendix_c", "appendix_d", "figure_3"]


@pytest.fixture(scope="module")
def tables(root):
    return {"d": read_numbers(root / DATA)}


def document(root, name, suffix=".bf"):
    return read_formulation(root / "formulations" / f"{name}{suffix}")


def both_agree(program, output, inputs, hand):
    """Value and gradient of an output and of a function written by hand, to 1e-12."""
    ours = jax.jit(jax.value_and_grad(lambda given: jnp.sum(program(given, [output])[output])))
    for found, wanted in zip(
        jax.tree.leaves(ours(inputs)),
        jax.tree.leaves(jax.jit(jax.value_and_grad(hand))(inputs)),
        strict=True,
    ):
        np.testing.assert_allclose(found, wanted, rtol=1e-12, atol=1e-12 * np.max(np.abs(wanted)))


def measured(tables):
    return tables["d"][:, 14], tables["d"][:, 15]


@pytest.mark.parametrize("name", NAMES)
def test_both_forms_are_the_documents_of_the_report(root, name):
    assert document(root, name) == document(root, name, ".xml")


@pytest.mark.parametrize("name", NAMES)
def test_they_are_those_of_the_cleaned_documents(root, shared, name):
    seed = "appendix_" + name[-1].upper() if name != "figure_3" else name
    assert document(root, name) == read_formulation(shared / "seed" / "xml" / f"{seed}.xml")


def test_appendix_a(root, tables):
    size, error = measured(tables)

    def hand(given):
        found = by_hand.squared(given, tables["d"][:, 8], tables["d"][:, 9])
        return jnp.sum(((found - size**2) / (2 * size * error)) ** 2)

    program = compile_mapping(document(root, "appendix_a").mapping, tables)
    both_agree(program, "obj", {"s11": 2.7, "s12": 1.5, "s22": 1.3}, hand)


def network(weights, current):
    """1-5-2, tanh, written out: weights row by row, then biases; values and their slopes."""
    w1, w2, b1, b2 = weights[:5], weights[5:15].reshape(5, 2), weights[15:20], weights[20:]
    node = jnp.tanh(current[:, None] * w1 + b1)
    return node @ w2 + b2, ((1 - node**2) * w1) @ w2


def test_appendix_b(root, tables):
    size, error = measured(tables)
    current = tables["d"][:, 0]

    def hand(given):
        ab, _ = network(given["weights"], current)
        found = by_hand.squared(given, ab[:, 0], ab[:, 1])
        return jnp.sum(((found - size**2) / (2 * size * error)) ** 2)

    def above(given, column, factor):
        _, slope = network(given["weights"], current)
        return jnp.sum(jnp.maximum(factor * slope[:, column] + 1e-2, 0) ** 2)

    weights = np.random.default_rng(5).normal(size=22)
    inputs = {"s11": 2.7, "s12": 1.5, "s22": 1.3, "weights": weights}
    program = compile_mapping(document(root, "appendix_b").mapping, tables)
    both_agree(program, "obj", inputs, hand)
    both_agree(program, "maxdAdc", inputs, lambda given: above(given, 0, 1.2))
    both_agree(program, "maxdBdc", inputs, lambda given: above(given, 1, 5.4))


def test_appendix_c(root, tables):
    size, error = measured(tables)

    def hand(given):
        a, b = by_hand.transport(given, tables["d"][:, 0])
        found = by_hand.size([given[f"s_{k}"] for k in ("11", "12", "22")], a, b)
        return jnp.sum(((found - size) / error) ** 2)

    inputs = {"s_11": 2.7, "s_12": 1.5, "s_22": 1.3, "slope_q3": 1.0, "int_q3": 50.0}
    inputs |= {"slope_q4": 160.0, "int_q4": 43.0}
    program = compile_mapping(document(root, "appendix_c").mapping, tables)
    both_agree(program, "obj", inputs, hand)


def drift(length):
    return jnp.array([[1.0, length], [0.0, 1.0]])


def lens(k, length, sign):
    c, s = (jnp.cos, jnp.sin) if sign < 0 else (jnp.cosh, jnp.sinh)
    return jnp.array(
        [[c(k * length), s(k * length) / k], [sign * k * s(k * length), c(k * length)]]
    )


def test_appendix_d(root):
    length = 0.07677
    sigma = jnp.array([[2.6367971055566173, 1.5738242270790272], [0, 1.435441121463094]])
    sigma = sigma.at[1, 0].set(sigma[0, 1])

    def hand(given):
        lenses = [jnp.sqrt(49.0 / 30.5), jnp.sqrt((167.23 * given["I_2"] + 43.17) / 30.5)]
        quads = (
            lens(lenses[1], length, -1) @ drift(4.36 - 4.173 - length) @ lens(lenses[0], length, 1)
        )
        line = drift(0.4191) @ by_hand.SPEC @ drift(1.873 - length / 2) @ quads
        size, divergence = jnp.sqrt(jnp.diagonal(line @ sigma @ line.T)) * 100
        return (200 - size) ** 2 + (140 - divergence) ** 2

    both_agree(compile_mapping(document(root, "appendix_d").mapping), "obj", {"I_2": 1.4}, hand)


def test_figure_3(root):
    rng = np.random.default_rng(3)
    shapes = {"x1": (10,), "x2": (10,), "x3": (2, 2, 3), "x4": (3, 4)}
    inputs = {name: rng.normal(size=shape) for name, shape in shapes.items()}
    y4 = {"y4": lambda g: g["x4"].sum(axis=1)}
    hand = y4 | {
        "y1": lambda g: g["x1"] + g["x2"],
        "y2": lambda g: g["x1"] * g["x2"],
        "y3": lambda g: 2 * g["x3"],
        "y5": lambda g: 2 * jnp.einsum("kl,ijk->", g["x4"], g["x3"]),
        "y6": lambda g: (jnp.arange(1, 11) / 10 - g["x1"]) ** 2,
    }
    program = compile_mapping(document(root, "figure_3").mapping)
    for name, function in hand.items():
        np.testing.assert_allclose(program(inputs, [name])[name], function(inputs), rtol=1e-12)
        both_agree(program, name, inputs, lambda given, f=function: jnp.sum(f(given)))


@pytest.mark.parametrize("name", ["appendix_a", "appendix_c"])
def test_identifications_end_where_other_formulations_end(root, tables, name):
    made = formulate(document(root, name), tables)
    fit = solve(made.problem)
    other = by_hand.appendix_a if name == "appendix_a" else by_hand.appendix_c
    wanted = solve(other(measured(tables)))
    assert made.squares
    assert fit.status.value == {"appendix_a": "converged", "appendix_c": "at_limit"}[name]
    assert fit.cost * made.factor == pytest.approx(wanted.chi2, rel=1e-8)


def test_the_set_point_is_the_one_known(root):
    made = formulate(document(root, "appendix_d"))
    fit = solve(made.problem)
    assert fit["I_2"].value == pytest.approx(1.0885976, abs=5e-8)
    assert fit.cost * made.factor == pytest.approx(2.1138, abs=5e-5)


def test_limits_without_a_qualification_are_said(root, tables):
    made = formulate(document(root, "appendix_b"), tables)
    assert [("maxdAdc" in n, "maxdBdc" in n) for n in made.notes] == [(True, False), (False, True)]
    assert all("no constraint qualification" in note for note in made.notes)
    assert formulate(document(root, "appendix_b_elementwise"), tables).notes == ()


def test_what_is_said_of_elements_has_their_indices_in_the_document():
    text = """minimize f; set K = |1:2|; variable e in [2, 3]; input e[K]; output f, g[K];
        constraint g <= 1; f = sum(k in K | e[k]); g[k] = e[k] foreach k in K;"""
    made = formulate(parse_document(text))
    assert made.problem.names == ("e[1]", "e[2]")
    assert "'g[1]'" in solve(made.problem).message
