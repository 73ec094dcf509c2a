"""What statements mean, against numpy: index arithmetic, order, recurrences, calls, matrices."""

import jax
import numpy as np
import pytest

from beamfit.language.compiled import compile_mapping
from beamfit.language.parse import parse_document
from beamfit.language.trace import cause_of


def values(text, *names, **inputs):
    program = compile_mapping(parse_document(text).mapping)
    names = names or tuple(program.scope.outputs)
    found = jax.jit(lambda given: program(given, names))(inputs)
    return [np.asarray(found[name]) for name in names]


def test_sums_products_and_sets():
    (m, s, d, n) = values("""
        function square(x) = x*x; function g(x, y) = square(x) + y;
        set I = |1:3|; set J = |1:2|; set S = |7, 3, 5|; set D = |5:1:-2|;
        output m[I, J], s, d[S], n;
        m[i, j] = g(i, 10*j) foreach j in J, i in I;
        s = sum(i in I, j in J | m[i, j]) + sum(k in D | k);
        d[k] = 2*k foreach k in S;
        n = sum(i in I | 2) + prod(j in J | 3) + max(m) + mean(k in S | d[k]) + min(k in S | k);
    """)
    np.testing.assert_array_equal(m, np.add.outer(np.arange(1, 4) ** 2, [10, 20]))
    assert (s, d.tolist(), n) == (118 + 9, [14, 6, 10], 6 + 9 + 29 + 10 + 3)


def test_indices_are_elements_and_arithmetic_shifts_transposes_and_repeats_them():
    x = np.random.default_rng(0).normal(size=(5, 5))
    (a, b, c, d) = values(
        """set I = |3:7|; set L = |4:6|; input x[I, I]; output a[L, I], b[I], c[L], d[I, I];
        a[l, i] = x[i, l+1] - x[l-1, i] foreach l in L, i in I;
        b[i] = x[i, i] foreach i in I;
        c[l] = x[2*l - 5, 7] foreach l in L;
        d[j, i] = x[i, j] foreach i in I, j in I;""",
        x=x,
    )
    np.testing.assert_array_equal(a, x[:, 2:].T - x[:3])
    np.testing.assert_array_equal(b, np.diagonal(x))
    np.testing.assert_array_equal(c, x[[0, 2, 4], 4])
    np.testing.assert_array_equal(d, x.T)


def test_statements_stand_in_any_order_and_pieces_make_an_array():
    text = """output z; real y[4], w; z = w + y[0] + y[3]; y[k] = k^2 foreach k in |1:3|;
              w = 2*y[1]; y[0] = y[2]/4;"""
    assert values(text)[0] == 2 + 1 + 9


def test_earlier_times_become_one_scan():
    u = np.arange(7.0)
    text = """set T = |0:6|; set I = |1:2|; input a[I], u[T]; output y[T]; real x[T];
        y[t] = t foreach t in |0:1|;  x[0] = 0;  x[1] = 3;
        x[t+1] = 2*y[t] + u[t] foreach t in |1:5|;
        y[t] = sum(i in I | a[i]*y[t-i]) + x[t] foreach t in |2:6|;"""
    y, x = [0.0, 1.0], [0.0, 3.0]
    for t in range(2, 7):
        x.append(2 * y[t - 1] + u[t - 1])
        y.append(0.5 * y[t - 1] + 0.25 * y[t - 2] + x[t])
    found = values(text, "y", "x", a=np.array([0.5, 0.25]), u=u)
    np.testing.assert_allclose(found, [y, x], rtol=1e-14)
    program = compile_mapping(parse_document(text).mapping)
    run = lambda u: program({"a": np.array([0.5, 0.25]), "u": u}, ["y"])["y"]  # noqa: E731
    assert "scan" in str(jax.make_jaxpr(run)(u))
    step = 1e-6 * np.eye(7)[1]
    slope = jax.jit(jax.jacfwd(run))(u)[:, 1]
    np.testing.assert_allclose(slope, (run(u + step) - run(u - step)) / 2e-6, atol=1e-8)


def test_vectors_and_matrices():
    a, b, u = np.array([[1, 0.1], [-0.1, 0.9]]), np.array([0, 1.0]), np.ones(4)
    (x, z, q) = values(
        """set T = |0:3|; input A[2, 2], b[2], u[T]; output x[T, 2], z, q[2];
        x[0, :] = b;
        x[t, :] = A@x[t-1, :] + b*u[t] foreach t in |1:3|;
        z = norm(x[3, :]) + det(A)*trace(inverse(A)); q = transpose(A)@b;""",
        A=a, b=b, u=u,
    )  # fmt: skip
    states = [b]
    for _ in range(3):
        states.append(a @ states[-1] + b)
    np.testing.assert_allclose(x, states, rtol=1e-14)
    extra = np.linalg.det(a) * np.trace(np.linalg.inv(a))
    np.testing.assert_allclose(z, np.linalg.norm(states[3]) + extra, rtol=1e-13)
    np.testing.assert_allclose(q, a.T @ b)


def test_mappings_are_called_for_all_points_with_gains_of_any_output_by_any_input():
    (y, s, g, h, v) = values("""
        set K = |1:3|; set J = |1:2|;
        mapping f { set I = |1:2|; input p[I], q = 3; output s, r[I];
                    r[i] = p[i]^2*q foreach i in I; s = r[1]*r[2]; }
        output y[K, J], s[K], g[K], h[K], v[K, J];
        f(p[1] = k; p[2] = 2*j; q = j :: y[k, j] = s) foreach k in K, j in J;
        f(p[i] = k + i foreach i in J
          :: s[k] = s; v[k, i] = r[i] foreach i in J; g[k] = gain(s, q); h[k] = gain(s, p[2], p[2]))
          foreach k in K;""")
    k, j = np.arange(1, 4), np.arange(1, 3)
    np.testing.assert_allclose(y, np.outer(k**2, 4 * j**4))
    np.testing.assert_allclose(v, 3 * np.add.outer(k, j) ** 2)
    np.testing.assert_allclose(s, 9 * (k + 1) ** 2 * (k + 2) ** 2)
    np.testing.assert_allclose(g, 6 * (k + 1) ** 2 * (k + 2) ** 2)
    np.testing.assert_allclose(h, 18 * (k + 1) ** 2)


def test_a_call_may_need_its_own_earlier_outputs():
    (x, g) = values("""set T = |0:3|; mapping f { input x, u; output y; y = x^2*u; }
        output x[T], g[T]; x[0] = 1.1; g[0] = 0;
        f(x = x[t-1]; u = t :: x[t] = y; g[t] = gain(y, x)) foreach t in |1:3|;""")
    np.testing.assert_allclose(x, [1.1, 1.21, 2 * 1.21**2, 3 * (2 * 1.21**2) ** 2])
    np.testing.assert_allclose(g, [0, 2.2, 4.84, 6 * 2 * 1.21**2])


@pytest.mark.parametrize(
    "function", ["sin", "exp", "log", "tanh", "atan", "sqrt", "abs", "sigmoid"]
)
def test_built_in_functions(function):
    wanted = {"sigmoid": lambda v: 1 / (1 + np.exp(-v)), "atan": np.arctan}
    found = values(f"output y; y = {function}(0.7);")[0]
    np.testing.assert_allclose(
        found, wanted.get(function, getattr(np, function, None))(0.7), rtol=1e-14
    )


def test_an_infinite_derivative_is_traced_too():
    text = """input a; output y[3]; mapping m { input a; output b; b = sqrt(a) + a^2; }
        m(a = a*i :: y[i] = b) foreach i in |0:2|;"""
    program = compile_mapping(parse_document(text).mapping)
    assert cause_of(program, {"a": 2.0}, ["y"]) is None
    said = (
        "in m for i = 0: sqrt(a) is zero and has an infinite derivative (line 1, column 58): a = 0"
    )
    assert cause_of(program, {"a": 2.0}, ["y"], slopes=True) == said
