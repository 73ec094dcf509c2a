"""Which problems are proved to be convex, and which numbers move together whatever the data."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from beamfit.errors import Status
from beamfit.greybox.convex import convex
from beamfit.greybox.problem import Constraint, Free, Objective, Problem, Record
from beamfit.greybox.solve import solve

CONVEX = {
    "squares": lambda x: (x[0] - 1) ** 2 + 3 * (x[1] - 2) ** 2,
    "quadratic form": lambda x: x @ np.array([[2.0, 1.0], [1.0, 2.0]]) @ x - x[0],
    "written out": lambda x: x[0] * x[0] - x[0] * x[1] + x[1] * x[1],
    "linear": lambda x: 3 * x[0] - x[1],
    "greater of two": lambda x: jnp.maximum(x[0] ** 2, (x[0] - 2) ** 2),
    "absolute": lambda x: jnp.sum(jnp.abs(x - 1)) + jnp.exp(x[0] - x[1]),
    "barrier": lambda x: -jnp.sum(jnp.log(x)),
    "of a product": lambda x: jnp.sum(jnp.square(x @ np.ones((2, 3)) - 1)),
    "fourth power": lambda x: (x[0] - 1) ** 4,
    "recurrence": lambda x: jax.lax.scan(lambda c, u: (0.9 * c + u, c), 1.0, x)[1][-1] ** 2,
    "less a root": lambda x: x[0] - jnp.sqrt(x[1]),
}
NOT = {
    "product": lambda x: x[0] * x[1],
    "indefinite": lambda x: x @ np.array([[1.0, 3.0], [3.0, 1.0]]) @ x,
    "less an absolute": lambda x: -jnp.abs(x[0]),
    "switched": lambda x: jnp.where(x[0] > 0, x[0] ** 2, -(x[0] ** 2)),
    "stairs": lambda x: jnp.floor(x[0]),
    "valley": lambda x: (1 - x[0]) ** 2 + 9 * (x[1] - x[0] ** 2) ** 2,
    "wave": lambda x: jnp.sin(x[0]),
    "lesser of two": lambda x: jnp.minimum(x[0] ** 2, (x[0] - 2) ** 2),
    "cube": lambda x: x[0] ** 3,
    "logarithm": lambda x: jnp.log(x[0]),
    "one over": lambda x: 1 / x[0],
}


def problem(cost, *rules, weight=1.0):
    goal = Objective("f", lambda x, _: cost(x), weight=weight)
    limits = [Constraint("g", lambda x, _, g=g: g(x), None, *ends) for g, *ends in rules]
    return Problem(jnp.array([0.7, 0.4]), [Free("")], constraints=limits, objectives=[goal])


@pytest.mark.parametrize("name", CONVEX)
def test_convex(name):
    assert convex(problem(CONVEX[name]))
    assert not convex(problem(CONVEX[name], weight=-1.0)) or name == "linear"


@pytest.mark.parametrize("name", NOT)
def test_not_proved(name):
    assert not convex(problem(NOT[name]))


@pytest.mark.parametrize(
    ("rule", "proved"),
    [
        ((lambda x: x[0] + x[1], 0.0, 2.0), True),
        ((lambda x: x[0] ** 2 + x[1] ** 2, -np.inf, 2.0), True),
        ((lambda x: x[0] ** 2 + x[1] ** 2, 1.0, np.inf), False),
        ((lambda x: x[0] ** 2 + x[1] ** 2, 2.0, 2.0), False),
        ((lambda x: jnp.log(x), 1.0, np.inf), True),
        ((lambda x: x[0] * x[1], -np.inf, 2.0), False),
    ],
)
def test_limits_make_a_convex_set_or_none(rule, proved):
    assert convex(problem(CONVEX["squares"], rule)) is proved


X = np.linspace(0.0, 3.0, 12)
U = np.sign(np.sin(np.arange(40.0)))


def states(model, u):
    """A state of unknown scale: only the product of b and c acts."""

    def step(s, v):
        return model["k"] * s + model["b"] * v, model["c"] * s

    return jax.lax.scan(step, 0.0, u)[1]


MODELS = {
    "series gain": (lambda m, x: m["a"] * m["b"] * x, {"a": 1.0, "b": 1.5}, X, {"a", "b"}, 1),
    "sum": (lambda m, x: (m["a"] + m["b"]) * x, {"a": 1.0, "b": 1.5}, X, {"a", "b"}, 1),
    "state scale": (states, {"k": 0.5, "b": 1.0, "c": 1.0}, U, {"b", "c"}, 1),
    "three in series": (
        lambda m, x: m["a"] * m["b"] * m["c"] * x, {"a": 1.0, "b": 1.5, "c": 2.0}, X,
        {"a", "b", "c"}, 2,
    ),
}  # fmt: skip


def fitted(predict, model, data, truth, bounds=()):
    measured = np.asarray(predict(truth, jnp.asarray(data)))
    record = Record("r", predict, data, measured, 0.1)
    return solve(Problem(model, [Free(name, *bounds) for name in model], [record]))


@pytest.mark.parametrize("bounds", [(), (0.1, 0.99)], ids=["free", "bounded"])
@pytest.mark.parametrize("name", MODELS)
def test_a_freedom_of_the_model_is_told_as_one(name, bounds):
    predict, model, data, tied, free = MODELS[name]
    fit = fitted(predict, {n: 0.5 for n in model}, data, {n: 0.6 for n in model}, bounds)
    assert fit.status is Status.unidentified
    assert set(fit.about) == tied
    assert "move together" in fit.message
    assert f"fix {'one' if free == 1 else free} of them" in fit.message
    fixed = [Free(n) for n in model if n not in sorted(tied)[:free]]
    alone = solve(Problem(fit.model, fixed, fit.problem.records))
    assert alone.status is Status.converged


def test_what_more_data_would_tell_is_no_freedom_of_the_model():
    """Level and slope from one setting, and a number that nothing depends on."""
    fit = fitted(lambda m, x: m["a"] + m["b"] * x, {"a": 1.0, "b": 1.0}, np.full(4, 3.0),
                 {"a": 0.0, "b": 2.0})  # fmt: skip
    assert "the data do not determine a, b" in fit.message
    fit = fitted(
        lambda m, x: m["a"] * x + 0 * m["b"], {"a": 1.0, "b": 1.0}, X, {"a": 2.0, "b": 1.0}
    )
    assert "the data do not determine b;" in fit.message
