"""AMPL's text form: read as written by hand and by Pyomo, written and read back, read by CasADi."""

import contextlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from beamfit.errors import InputError
from beamfit.greybox.problem import Constraint, Free, Objective, Problem, Record
from beamfit.greybox.solve import solve
from beamfit.io.nl import read_nl
from beamfit.io.nl_writer import write_nl

# min (a - b)^2 + 2a, 1 <= a*b + 3b <= 9, sin(d) - a = -1 where d = a + 2b; a in [0, 5], b >= 0.5
BY_HAND = """g3 1 1 0\t# problem by hand
 2 2 1 1 1
 2 1
 0 0
 2 2 2
 0 0 0 1
 0 0 0 0 0
 4 2
 0 0
 1 0 0 0 0
V2 2 0
0 1
1 2
n0
C0
o2
v0
v1
C1
o41
v2
O0 0
o5
o1
v0
v1
n2
x2
0 1.5
1 0.75
r
0 1 9
4 -1
b
0 0 5
2 0.5
k1
2
J0 2
0 0
1 3
J1 2
0 -1
1 0
G0 2
0 2
1 0
"""


def written(tmp_path, text, **beside):
    for ending, names in beside.items():
        (tmp_path / f"p.{ending}").write_text("\n".join(names) + "\n")
    (tmp_path / "p.nl").write_text(text)
    return read_nl(tmp_path / "p.nl")


def test_a_file_written_by_hand(tmp_path):
    p = written(tmp_path, BY_HAND, col=["a", "b"], row=["both", "wave", "cost"])
    assert p.names == ("a", "b")
    assert p.constraint_names == ("both", "wave")
    a, b = p.start
    assert (a, b) == (1.5, 0.75)
    assert p.cost(p.start) == pytest.approx((a - b) ** 2 + 2 * a, rel=1e-15)
    expected = [a * b + 3 * b, np.sin(a + 2 * b) - a]
    np.testing.assert_allclose(p.constraint_values(p.start), expected, rtol=1e-15)
    np.testing.assert_array_equal([p.lower, p.upper], [[0, 0.5], [5, np.inf]])
    np.testing.assert_array_equal([p.constraint_lower, p.constraint_upper], [[1, -1], [9, -1]])


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("g3", "b3", "p.nl:1: a binary file"),
        (" 0 0 0 0 0\n", " 0 1 0 0 0\n", "p.nl:7: integer variables"),
        ("o41", "o99", "p.nl:20: operation 'o99'"),
        ("v2\nO0", "v7\nO0", "p.nl:21: v7"),
        ("C1", "C5", "p.nl:19: 'C5'; expected C, a number below 2"),
        ("0 1 9", "5 1 9", "p.nl:32: a complementarity"),
        ("n2\n", "nx\n", "p.nl:27: 'nx'"),
        ("k1\n", "L0\n", "p.nl:37: a logical constraint"),
        ("1 0\n", "1\n", "p.nl:"),
        (" 2 2 1 1 1", " 2 0 1 1 1", "p.nl:15: 'C0'"),
        ("v2\n", f"v{'9' * 5000}\n", "p.nl:"),
        ("o41\n", "o54\n2\n" * 2000, "sums nested without end"),
        ("G0 2\n0 2\n1 0\n", "G0 9\n0 2\n1 0\n", "p.nl:47: the end of the file"),
    ],
)
def test_what_is_wrong_is_one_line_with_its_place(tmp_path, old, new, said):
    with pytest.raises(InputError) as error:
        written(tmp_path, BY_HAND.replace(old, new, 1))
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_damaged_files_are_read_or_refused(tmp_path):
    random = np.random.default_rng(5)
    words = ["o", "v9", "-1", "nan", "1e99", "", "o54", "99999999999", "C1", "inf", "b", "1.5"]
    for _ in range(300):
        lines = BY_HAND.splitlines()
        at = random.integers(len(lines))
        parts = lines[at].split(" ")
        parts[random.integers(len(parts))] = words[random.integers(len(words))]
        lines[at] = " ".join(parts)
        text = "\n".join(lines[: random.integers(at, len(lines)) + 1]) + "\n"
        with contextlib.suppress(InputError):
            written(tmp_path, text)


def network(model, x):
    hidden = jnp.tanh(x[:, None] * model["w"] + model["b"])
    return jax.nn.sigmoid(hidden @ model["v"]) * model["scale"]


def stated(kinks=True):
    x = np.linspace(0.2, 2.0, 6)
    model = {"w": np.array([0.3, -0.7, 1.1]), "b": np.array([0.1, 0.2, -0.4]),
             "v": np.array([1.0, 0.5, -2.0]), "scale": 2.0}  # fmt: skip
    rules = [
        Constraint("norm", lambda m, _: jnp.sum(m["w"] ** 2), None, 0.1, 9.0),
        Constraint("tie", lambda m, _: m["v"][::-1] * jnp.exp(-m["b"]), None, -5.0),
        Constraint("same", lambda m, _: jnp.where(m["scale"] > 1, jnp.sqrt(m["scale"]), 0.0), None,
                   1.5, 1.5),
    ]  # fmt: skip
    return Problem(
        model,
        [Free("w", -9, 9), Free("b"), Free("v", -9), Free("scale", 0.1, 9)],
        [Record("scan", network, x, 0.5 + 0.1 * x, 0.05)],
        constraints=rules if kinks else rules[:2],
        objectives=[Objective("size", lambda m, _: jnp.max(jnp.abs(m["v"])), weight=0.1)] * kinks,
    )


def both(p, theta):
    cost, constraints = jax.value_and_grad(p.cost), p.constraint_values
    return [*cost(theta), constraints(theta), jax.jacfwd(constraints)(theta)]


def test_a_network_with_constraints_is_written_and_read_back(tmp_path):
    p = stated()
    write_nl(p, tmp_path / "net.nl")
    again = read_nl(tmp_path / "net.nl")
    assert (again.names, again.constraint_names) == (p.names, p.constraint_names)
    for ends in ("lower", "upper", "constraint_lower", "constraint_upper", "start"):
        np.testing.assert_array_equal(getattr(again, ends), getattr(p, ends))
    theta = p.start + 0.1 * np.random.default_rng(1).normal(size=len(p.start))
    for mine, theirs in zip(both(p, theta), both(again, theta), strict=True):
        np.testing.assert_allclose(theirs, mine, rtol=1e-12, atol=1e-13)


def test_casadi_reads_the_same_problem(tmp_path):
    casadi = pytest.importorskip("casadi")
    p = stated(kinks=False)  # it has no conditions
    write_nl(p, tmp_path / "net.nl")
    nl = casadi.NlpBuilder()
    nl.import_nl(str(tmp_path / "net.nl"), {"verbose": False})
    x = casadi.vertcat(*nl.x)
    f = casadi.Function("f", [x], [nl.f, casadi.gradient(nl.f, x), casadi.vertcat(*nl.g)])
    theta = p.start + 0.05
    value, slope, limits = (np.array(part).ravel() for part in f(theta))
    np.testing.assert_allclose(value, p.cost(theta), rtol=1e-12)
    np.testing.assert_allclose(slope, jax.grad(p.cost)(theta), rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(limits, p.constraint_values(theta), rtol=1e-12)
    np.testing.assert_array_equal(nl.x_lb, p.lower)


def test_alike_terms_are_computed_together(tmp_path):
    """2000 terms of one form: the program does not grow with their number."""
    n = 2000
    cost = Objective("f", lambda x, _: jnp.sum(jnp.exp(-x) * (x - 1.0) ** 2))
    write_nl(Problem(np.zeros(n), [Free("")], objectives=[cost]), tmp_path / "many.nl")
    p = read_nl(tmp_path / "many.nl")
    assert p.cost(np.zeros(n)) == pytest.approx(n, rel=1e-12)
    assert len(jax.make_jaxpr(p.cost)(np.zeros(n)).eqns) < 60


def test_a_loop_is_refused_by_name(tmp_path):
    def loop(x, _):
        return jax.lax.while_loop(lambda v: v[0] < 9, lambda v: 2 * v, x)[0]

    p = Problem(np.ones(1), [Free("")], objectives=[Objective("f", loop)])
    with pytest.raises(InputError, match="the operation 'while'"):
        write_nl(p, tmp_path / "loop.nl")


def test_pyomo_writes_what_is_read(tmp_path):
    pe = pytest.importorskip("pyomo.environ")
    m = pe.ConcreteModel()
    m.i = pe.RangeSet(1, 4)
    m.x = pe.Var(m.i, initialize=lambda m, i: 0.3 * i, bounds=(-2, 9))
    m.z = pe.Var(initialize=0.2, bounds=(0.01, None))
    m.e = pe.Expression(expr=pe.sin(m.x[1]) * m.z)
    m.o = pe.Objective(expr=-sum((m.x[i] - i) ** 2 for i in m.i) - m.e**2, sense=pe.maximize)
    m.c = pe.Constraint(m.i, rule=lambda m, i: pe.inequality(-9, m.x[i] + pe.log(m.z) / i, 30))
    m.d = pe.Constraint(expr=m.x[1] + 2 * m.x[2] == m.x[3] + m.e)
    m.write(str(tmp_path / "m.nl"), io_options={"symbolic_solver_labels": True})
    p = read_nl(tmp_path / "m.nl")
    values = {v.name: pe.value(v) for v in (*m.x.values(), m.z)}
    assert dict(zip(p.names, p.start, strict=True)) == pytest.approx(values)
    assert float(p.cost(p.start)) == pytest.approx(-pe.value(m.o), rel=1e-12)
    c = dict(zip(p.constraint_names, np.asarray(p.constraint_values(p.start)), strict=True))
    low = dict(zip(p.constraint_names, p.constraint_lower, strict=True))
    for row in (*m.c.values(), m.d):
        assert c[row.name] - low[row.name] == pytest.approx(
            pe.value(row.body) - pe.value(row.lower), rel=1e-12, abs=1e-12
        )
    assert solve(p).status in ("local_optimum", "optimal")
