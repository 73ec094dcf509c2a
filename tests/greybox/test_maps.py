"""Every map class: values, both directions of differentiation, names and refusals."""

import importlib
import inspect
import pkgutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental import checkify

import beamfit.greybox
from beamfit.errors import InputError
from beamfit.greybox.equations import Implicit, TaylorDifference
from beamfit.greybox.gains import adjoints, gain, sensitivities
from beamfit.greybox.maps import (
    Affine,
    Foreign,
    Formula,
    Map,
    Parallel,
    Series,
)
from beamfit.greybox.mlp import MLP, NetworkGain, dense

AFFINE = Affine(["a", "b"], ["p", "q"], [[1.0, -2.0], [0.5, 3.0]], [0.1, 0.2])
FORMULA = Formula(
    ["p", "q"],
    ["y", "z"],
    lambda c, x: jnp.array([c["k"] * jnp.sin(x[0]) * x[1], jnp.exp(0.3 * x[0]) - x[1] ** 2]),
    {"k": 1.7},
)


def foreign_value(x):
    return np.array([x[0] ** 2 * x[1], np.sin(x[1])])


def foreign_jacobian(x):
    return np.array([[2 * x[0] * x[1], x[0] ** 2], [0.0, np.cos(x[1])]])


def foreign_hessian(x):
    return np.array([[[2 * x[1], 2 * x[0]], [2 * x[0], 0.0]], [[0.0, 0.0], [0.0, -np.sin(x[1])]]])


FOREIGN = Foreign(["a", "b"], ["p", "q"], foreign_value, foreign_jacobian, foreign_hessian)

# One case for each map class; the registry test fails when a class has none.
CASES = {
    Affine: AFFINE,
    Formula: FORMULA,
    Series: Series(AFFINE, FORMULA),
    Parallel: Parallel([AFFINE, FOREIGN]),
    Foreign: FOREIGN,
    Implicit: Implicit(
        ("a", "b"),
        ("y", "z"),
        lambda c, x, y: jnp.array([y[0] ** 3 + c * y[1] - x[0], y[1] + 0.3 * y[0] - x[1]]),
        start=[1.0, 0.0],
        parameters=0.4,
    ),
    MLP: dense(["a", "b"], ["y", "z"], [3, 2], gains=[NetworkGain("dy/da", "y", ("a",))]),
    TaylorDifference: TaylorDifference(("u",), ("y", "z"), y_past=1, u_past=1, degree=2),
}


def map_classes():
    """Every class in the package that has names and can be called at a point."""
    found = set()
    for info in pkgutil.iter_modules(beamfit.greybox.__path__):
        module = importlib.import_module(f"beamfit.greybox.{info.name}")
        for _, cls in inspect.getmembers(module, inspect.isclass):
            named = {"inputs", "outputs"} <= {*dir(cls), *getattr(cls, "__annotations__", {})}
            if named and "__call__" in vars(cls) and cls is not Map:
                found.add(cls)
    return found


def test_every_map_class_has_a_case():
    assert map_classes() == set(CASES)


@pytest.mark.parametrize("cls", CASES, ids=lambda cls: cls.__name__)
def test_forward_and_backward_sweeps_are_adjoint(cls):
    m = CASES[cls]
    random = np.random.default_rng(5)
    x = 0.5 + random.uniform(size=len(m.inputs))
    v, w = random.normal(size=len(m.inputs)), random.normal(size=len(m.outputs))
    forward = jax.jit(lambda x, v: jax.jvp(m, (x,), (v,))[1])(x, v)
    backward = jax.jit(lambda x, w: jax.vjp(m, x)[1](w)[0])(x, w)
    assert forward @ w == pytest.approx(float(v @ backward), rel=1e-12, abs=1e-13)
    assert abs(float(forward @ w)) > 1e-6


@pytest.mark.parametrize("cls", CASES, ids=lambda cls: cls.__name__)
def test_derivatives_by_inputs_and_own_numbers_match_differences(cls):
    m = CASES[cls]
    x = jnp.asarray(0.5 + np.random.default_rng(6).uniform(size=len(m.inputs)))
    wide = sensitivities(m, x)
    value = jax.jit(lambda point: m(point))
    step = 1e-5
    for i in range(len(m.inputs)):
        unit = jnp.zeros(len(m.inputs)).at[i].set(step)
        difference = (value(x + unit) - value(x - unit)) / (2 * step)
        np.testing.assert_allclose(wide[:, i], difference, rtol=1e-7, atol=1e-8)
    np.testing.assert_allclose(adjoints(m, x), wide, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(
        adjoints(m, x, m.outputs[-1:], m.inputs[:1]), wide[-1:, :1], rtol=1e-12, atol=1e-13
    )


def test_sensitivities_reach_the_numbers_inside_a_series():
    m = CASES[Series]
    x = jnp.array([0.3, 0.4])
    found = sensitivities(m, x, ["b", "second.parameters.k", "first.offset"])
    assert found.shape == (2, 4)
    at_k = np.sin(float(AFFINE(x)[0])) * float(AFFINE(x)[1])
    np.testing.assert_allclose(found[:, 1], [at_k, 0.0], atol=1e-14)
    np.testing.assert_allclose(adjoints(m, x, ["z"], ["b", "second.parameters.k"])[0], found[1, :2])


def test_series_passes_outside_inputs_by_name_and_in_order():
    second = Formula(["x", "p"], ["y"], lambda _, v: v[:1] - 10 * v[1:])
    m = Series(Affine(["u"], ["p"], [[2.0]]), second)
    assert m.inputs == ("u", "x")
    assert m(jnp.array([3.0, 5.0])).tolist() == [5.0 - 60.0]


def test_foreign_code_works_under_jit_vmap_and_second_derivatives():
    points = jnp.array([[1.0, 2.0], [3.0, 4.0]])
    found = jax.jit(jax.vmap(jax.hessian(lambda x: FOREIGN(x)[0])))(points)
    np.testing.assert_allclose(found, [foreign_hessian(p)[0] for p in np.asarray(points)])


def test_foreign_code_without_second_derivatives_says_so():
    plain = Foreign(["a", "b"], ["p", "q"], foreign_value, foreign_jacobian)
    with pytest.raises(InputError, match="order 2"):
        jax.hessian(lambda x: plain(x)[0])(jnp.ones(2))


def test_implicit_derivatives_of_a_cube_root():
    root = Implicit(("x",), ("y",), lambda _, x, y: y**3 - x, start=[1.0])
    x = jnp.array([8.0])
    expected = [1 / 12, -2 / 9 * 8 ** (-5 / 3), 10 / 27 * 8 ** (-8 / 3)]
    found = [float(jax.jit(lambda x, n=n: gain(root, x, "y", ["x"] * n))(x)) for n in (1, 2, 3)]
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_an_equation_without_a_root_gives_a_status_not_nan():
    m = Implicit(("x",), ("y",), lambda _, x, y: y**2 + x, start=[1.0])
    found = m.root(jnp.array([1.0]))
    assert found.converged == 0
    assert found.defect == pytest.approx(1.0)
    assert np.isfinite(m(jnp.array([1.0]))).all()
    many = checkify.checkify(jax.jit(jax.vmap(m)), errors=checkify.user_checks)
    assert many(jnp.array([[-4.0], [-9.0]]))[0].get() is None
    assert "max |f| = 1" in many(jnp.array([[-4.0], [1.0]]))[0].get()


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Affine(["a"], ["y"], [[1.0, 2.0]]), "shape"),
        (lambda: Affine(["a", "a"], ["y"], [[1.0, 2.0]]), "each name once"),
        (lambda: Parallel([AFFINE, FORMULA]), "same outputs"),
        (lambda: Parallel([]), "no maps"),
        (lambda: gain(AFFINE, jnp.ones(2), "r", ["a"]), "no output 'r'"),
        (lambda: sensitivities(AFFINE, jnp.ones(2), ["matrx"]), "did you mean matrix"),
    ],
)
def test_unusable_input_is_refused_with_the_remedy(make, said):
    with pytest.raises(InputError, match=said):
        make()
