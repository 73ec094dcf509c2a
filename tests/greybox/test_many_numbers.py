"""Problems of many free numbers: patterns, sparse factors, answers equal to the dense ones."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import sparse

from beamfit.errors import Status
from beamfit.greybox import assess, covariance, descend
from beamfit.greybox import sparse as sparse_parts
from beamfit.greybox.problem import Free, Prior, Problem, Record
from beamfit.greybox.solve import solve
from beamfit.greybox.sparse import Factor, pattern_at, weakest

N = 12


def swept(function, x):
    """Values of a function at a point, and products of its Jacobian with directions."""
    return lambda seeds: (function(x), jax.vmap(lambda s: jax.jvp(function, (x,), (s,))[1])(seeds))


def pattern_of(function, x, known=None):
    rows = len(jax.eval_shape(function, x))
    return pattern_at(swept(function, x), (rows, len(x)), known)


DIFFERENCES = np.diff(np.eye(N), axis=0)

FUNCTIONS = {
    "elements": lambda x: jax.nn.softplus(jnp.where(x > 0, x, 0.0)) + jnp.clip(x, 0, 1) ** 2.5,
    "moves": lambda x: jnp.concatenate([jnp.roll(x, 2), x[::-1], jnp.pad(x[:3], 2)])[1:-1],
    "written": lambda x: jnp.ones(N).at[3:6].set(x[:3] ** 2).at[np.array([1, 1])].add(x[7:9]),
    "gathered": lambda x: (x**2)[np.array([0, 5, 1, -1])] * x[:4],
    "outside": lambda x: x.at[np.array([1, 200])].get(mode="fill", fill_value=0.0),
    "sums": lambda x: jnp.sum(x.reshape(3, 4) ** 2, axis=1) + jnp.max(x.reshape(4, 3).T, axis=1),
    "known matrix": lambda x: DIFFERENCES @ jnp.sin(x),
    "batched product": lambda x: jnp.einsum("bij,bj->bi", x.reshape(3, 2, 2), x[:6].reshape(3, 2)),
    "two sides": lambda x: x.reshape(4, 3) @ np.diag([1.0, 0.0, 2.0]) @ np.ones((3, 1)),
    "gradient": jax.grad(lambda x: jnp.sum((x[1:] - x[:-1] ** 2) ** 2)),
    "gradient of gathered": jax.grad(lambda x: jnp.sum(x[np.array([0, 3])] * x[np.array([1, 1])])),
    "mapped": lambda x: jax.vmap(lambda a, b: jnp.linalg.norm(jnp.stack([a, b])))(x[1:], x[:-1]),
    "loop": lambda x: jax.lax.scan(lambda c, v: (c * v, c), 1.0, x)[1],
    "table by number": lambda x: jnp.interp(x, jnp.arange(3.0), jnp.arange(3.0) ** 2),
    "switch": lambda x: jax.lax.cond(x[0] > 0, lambda v: v, lambda v: v[::-1], x),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_pattern_misses_nothing(name, monkeypatch):
    """Beside the dense Jacobian at three points; where it misses a place, that is noticed."""
    monkeypatch.setattr(sparse_parts, "MAX_FILL", 2.0)

    def function(x):
        return jnp.ravel(FUNCTIONS[name](x))

    pattern, slopes = None, jax.jit(jax.jacfwd(function))
    for seed in range(3):
        x = jnp.asarray(np.random.default_rng(seed).normal(size=N))
        dense, there = np.asarray(slopes(x)), swept(function, x)
        found = None if pattern is None else pattern.jacobian(there)[1]
        if found is None:
            pattern = pattern_of(function, x, pattern)
            found = pattern.jacobian(there)[1]
        np.testing.assert_allclose(found.toarray(), dense, atol=1e-13)


def test_few_sweeps_and_a_wrong_pattern():
    def function(x):
        return x[2:] - 2 * x[1:-1] ** 2 + x[:-2]

    x = np.linspace(1, 2, 300)
    pattern = pattern_of(function, x)
    assert pattern.places.shape == (298, 300)
    assert len(pattern.seeds) == 4  # three colours and the probe
    assert pattern_of(jnp.cumsum, x) is None
    assert pattern.jacobian(swept(lambda t: function(t) + t[7], x))[1] is None
    # At zero the middle number of each row acts on nothing; at another point it is added.
    fewer = pattern_of(function, np.zeros(300))
    assert fewer.places.nnz < pattern.places.nnz
    assert fewer.jacobian(swept(function, x))[1] is None
    again = pattern_of(function, x, fewer)
    np.testing.assert_array_equal(again.places.toarray(), pattern.places.toarray())


@pytest.mark.parametrize("seed", range(4))
def test_elements_of_an_inverse(seed):
    """Places of the matrix itself, and what the diagonal loses, beside the whole inverse."""
    rng = np.random.default_rng(seed)
    n = 80
    rows = sparse.vstack(
        [sparse.random_array((150, n), density=0.02, rng=rng), sparse.eye_array(n)]
    )
    matrix = sparse.csr_array(rows.T @ rows)
    factor, whole = Factor(matrix), np.linalg.inv(matrix.toarray())
    found = factor.inverse.toarray()
    kept = found != 0
    assert np.all(kept[matrix.toarray() != 0])
    np.testing.assert_allclose(found[kept], whole[kept], rtol=1e-9, atol=1e-12)
    more = rng.uniform(size=n)
    lost = np.diag(whole @ np.diag(more) @ whole)
    np.testing.assert_allclose(factor.loss(more), lost, rtol=1e-9)
    np.testing.assert_allclose(Factor(matrix.toarray()).loss(more), lost, rtol=1e-9)
    with pytest.raises(np.linalg.LinAlgError):
        Factor(-matrix.toarray())


def test_the_weakest_direction():
    rows = sparse.csr_array(sparse.diags_array(np.array([3.0, 1e-3, 2.0, 1.0])))
    assert np.abs(weakest(rows, 1)[:, 0]) == pytest.approx([0, 1, 0, 0], abs=1e-6)


def reading(model, _):
    return model["x"] + 0.1 * model["x"] ** 3


def bend(model):
    x = model["x"]
    return x[2:] - 2 * x[1:-1] + x[:-2]


def curve(n, errors=0.05, smooth=0.01, **bounds):
    """A smooth curve read with noise: each reading sees one number, the prior three."""
    t = np.linspace(0, 6, n)
    measured = np.sin(t) + 0.1 * np.sin(t) ** 3 + 0.05 * np.random.default_rng(1).normal(size=n)
    record = Record("curve", reading, None, measured, errors)
    return Problem(
        {"x": np.zeros(n)}, [Free("x", **bounds)], [record], [Prior("bend", 0.0, smooth, bend)]
    )


def both_ways(problem, monkeypatch):
    """The answer by sparse factors, and by orthogonal ones and singular values."""
    many = solve(problem)
    assert sparse.issparse(many.jacobian)
    for module in (descend, covariance, assess):
        monkeypatch.setattr(module, "MAX_DENSE", 10**9)
    return many, solve(problem)


@pytest.mark.parametrize(
    "stated",
    [
        {},
        {"errors": None},
        {"errors": 0.02},
        {"lower": -0.9, "upper": 0.8},
        {"lower": np.linspace(-2, -0.5, 250), "smooth": 3.0},
    ],
    ids=["errors", "no errors", "errors too small", "at bounds", "rough at bounds"],
)
def test_many_numbers_are_answered_as_few_are(stated, monkeypatch):
    many, dense = both_ways(curve(250, **stated), monkeypatch)
    assert many.status is dense.status
    assert many.message.split("(")[0] == dense.message.split("(")[0]
    assert many.dof == pytest.approx(dense.dof)
    np.testing.assert_allclose(many.theta, dense.theta, atol=1e-7)
    for name in ("error", "error_raw"):
        a, b = ([getattr(v, name) for v in fit.variables] for fit in (many, dense))
        np.testing.assert_allclose(a, b, rtol=1e-6)
    assert [v.state for v in many.variables] == [v.state for v in dense.variables]
    assert [g.dof for g in many.groups] == pytest.approx([g.dof for g in dense.groups])
    np.testing.assert_allclose(many.covariance, dense.covariance, atol=1e-9)

    def parts(model, _):
        return jnp.stack([jnp.mean(model["x"]), model["x"][7] - model["x"][9]])

    a, b = (fit.derive(parts) for fit in (many, dense))
    np.testing.assert_allclose(a.error, b.error, rtol=1e-6)
    np.testing.assert_allclose(a.share, b.share, atol=1e-6)


def steps_of(model, _):
    return jnp.diff(model["x"])


def test_an_open_direction_among_many_is_found():
    """Differences leave the level open."""
    record = Record("steps", steps_of, None, np.ones(249), 0.1)
    fit = solve(Problem({"x": np.zeros(250)}, [Free("x")], [record]))
    assert fit.status is Status.unidentified
    np.testing.assert_allclose(np.diff(fit.theta), 1.0, atol=1e-9)
    assert np.abs(fit.undetermined.ravel()) == pytest.approx(np.full(250, 250**-0.5))


def product(model, matrix):
    return jnp.tanh(matrix @ model["x"])


def test_a_dense_problem_of_many_numbers():
    rng = np.random.default_rng(2)
    matrix, truth = rng.normal(size=(500, 220)) / 15, rng.normal(size=220)
    measured = np.tanh(matrix @ truth) + 0.01 * rng.normal(size=500)
    p = Problem({"x": np.zeros(220)}, [Free("x")], [Record("r", product, matrix, measured, 0.01)])
    fit = solve(p)
    assert not sparse.issparse(fit.jacobian)
    assert fit.status is Status.converged
    rows = (1 - np.tanh(matrix @ fit.theta) ** 2)[:, None] * matrix / 0.01
    assert np.max(np.abs(rows.T @ np.asarray(p.residual(fit.theta)))) < 1e-4
    error = np.sqrt(np.diag(np.linalg.inv(rows.T @ rows))) * fit.scale
    np.testing.assert_allclose([v.error for v in fit.variables], error, rtol=1e-6)
