"""Linear state spaces from runs at equal steps: where a search begins, in which numbers it goes.

States are those directions of past inputs and outputs that foretell the future best.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import solve_discrete_lyapunov

from beamfit.dynamics.states import Matrices, contraction, linear_outputs

# Most samples of past and future, and most rows, of the regression.
HORIZON, ROWS = 20, 20_000
# Strides through the samples, for slow responses; fewest rows that must remain.
STRIDES, FEWEST = (1, 5, 25, 125), 100
# Newton steps to the rest of a network.
REST = 20


class Linear:
    """x+ = a x + b u, y = c x + d u in units of the scatter, stable whatever its numbers.

    Of p: ``z`` and ``around`` (`beamfit.dynamics.states.contraction`), ``c``, ``d``, and ``units``,
    pairs of mean and size of the inputs and the outputs. A last input that is 1 stands for offsets:
    of the outputs alone they would have no end where the process integrates.
    """

    def run(self, p: Any, u: Any, dt: Any, x0: Any) -> tuple[jax.Array, jax.Array]:
        """Outputs at the samples and the state after the last."""
        y, last = linear_outputs(self.linear(p), self.scaled(p, u), x0)
        return y * p["units"]["y"][1] + p["units"]["y"][0], last

    def scaled(self, p: Any, u: Any) -> jax.Array:
        """Inputs in their units, and 1 if there are offsets."""
        u = (u - p["units"]["u"][0]) / p["units"]["u"][1]
        return jnp.pad(u, ((0, 0), (0, p["z"].shape[1] - u.shape[1])), constant_values=1.0)

    def linear(self, p: Any) -> Matrices:
        """Matrices of the linear part."""
        return Matrices(*contraction(p["z"], p["around"]), p["c"], p["d"], jnp.zeros(len(p["c"])))

    matrices = linear


class LinearWithNetwork(Linear):
    """The same with x+ = a x + b u + steps * out @ tanh(inside @ (x/sizes, u) + bias)."""

    def run(self, p: Any, u: Any, dt: Any, x0: Any) -> tuple[jax.Array, jax.Array]:
        """Outputs at the samples and the state after the last."""
        linear, u = self.linear(p), self.scaled(p, u)
        n, net = len(x0), p["net"]
        drive, inside = u @ linear.b.T, u @ net["inside"][:, n:].T
        by_state, out = net["inside"][:, :n] / p["sizes"], p["steps"][:, None] * net["out"]

        def step(x, now):
            return linear.a @ x + now[0] + out @ jnp.tanh(by_state @ x + now[1]), x

        last, x = jax.lax.scan(step, x0, (drive, inside))
        y = x @ linear.c.T + u @ linear.d.T
        return y * p["units"]["y"][1] + p["units"]["y"][0], last

    def matrices(self, p: Any) -> Matrices:
        """Matrices linearised about the rest at the mean input."""
        linear, (n, m), net = self.linear(p), p["z"].shape, p["net"]

        def after(x, u):
            inside = net["inside"] @ jnp.concatenate([x / p["sizes"], u])
            return linear.a @ x + linear.b @ u + p["steps"] * (net["out"] @ jnp.tanh(inside))

        x, mean = jnp.zeros(n), jnp.zeros(m).at[p["units"]["u"].shape[1] :].set(1.0)
        for _ in range(REST):
            slope = jnp.eye(n) - jax.jacfwd(after)(x, mean)
            x = x + jnp.linalg.solve(slope, after(x, mean) - x)
        a, b = jax.jacfwd(after, (0, 1))(x, mean)
        shift = (x - a @ x - b @ mean)[:, None] * mean  # so that it rests there
        return linear._replace(a=a, b=b + shift)


LINEAR, NETWORK = Linear(), LinearWithNetwork()


def realisations(
    u: list[np.ndarray], y: list[np.ndarray], order: int
) -> Iterator[tuple[np.ndarray, ...]]:
    """Find linear systems of an order from runs, one for each stride that the runs are long for.

    Parameters
    ----------
    u, y : list of array, shape (samples, m) and (samples, k)
        Inputs and outputs of each run, in units of their scatter, nothing missing.
    order : int
        States.

    Yields
    ------
    tuple of array
        a, b, c, d; the poles of a inside the unit circle.

    Notes
    -----
    Canonical variates (W. Larimore 1990; L. Ljung, System Identification (1999), section 10.6): the
    future is regressed on the past and on future inputs, the singular vectors of the past's part
    are the states, and the matrices a regression of states and outputs on states and inputs.
    """
    longest = max(map(len, y))
    for stride in STRIDES:
        if stride > 1 and longest < stride * FEWEST:
            return
        # An input that changes within a stride counts by its mean.
        mean = [each[: len(each) // stride * stride].reshape(-1, stride, each.shape[1]).mean(1)
                for each in u]  # fmt: skip
        read = [each[::stride][: len(v)] for each, v in zip(y, mean, strict=True)]
        found = _regressed(mean, read, order)
        if found is None:
            continue
        a, b, c, d = found
        values, vectors = np.linalg.eig(a)
        most = np.exp(-stride / (1000.0 * longest))
        values = values * np.minimum(1.0, most / np.maximum(np.abs(values), 1e-12))
        if stride > 1:
            if np.any((np.abs(values.imag) < 1e-9) & (values.real <= 0)):
                continue  # no root of it is real
            values = values ** (1.0 / stride)
        once = (vectors * values) @ np.linalg.pinv(vectors)
        many = sum(np.linalg.matrix_power(once, i) for i in range(stride))
        if np.isfinite(many).all():
            yield once.real, np.linalg.lstsq(many, b, rcond=1e-10)[0].real, c, d


def _regressed(
    u: list[np.ndarray], y: list[np.ndarray], order: int
) -> tuple[np.ndarray, ...] | None:
    m, k = u[0].shape[1], y[0].shape[1]
    count = sum(map(len, y))
    horizon = int(np.clip(count // (4 * (m + k) + 4 * m), order // k + 2, HORIZON))
    rows = [_rows(v, w, horizon) for v, w in zip(u, y, strict=True) if len(v) > 2 * horizon + 1]
    if not rows or sum(len(r[0]) for r in rows) < horizon * (2 * m + k):
        return None
    past, later, future, inputs, now_u, now_y = (
        np.concatenate(parts) for parts in zip(*rows, strict=True)
    )
    by = np.linalg.lstsq(np.hstack([past, inputs]), future, rcond=1e-10)[0][: past.shape[1]]
    triangle = np.linalg.qr(past, mode="r")
    _, _, right = np.linalg.svd(triangle @ by, full_matrices=False)
    if len(right) < order:
        return None
    to_state = by @ right[:order].T
    x, after = past @ to_state, later @ to_state
    size = np.maximum(np.linalg.norm(x, axis=0), 1e-12) / np.sqrt(len(x))
    x, after = x / size, after / size
    ab = np.linalg.lstsq(np.hstack([x, now_u]), after, rcond=1e-10)[0].T
    cd = np.linalg.lstsq(np.hstack([x, now_u]), now_y, rcond=1e-10)[0].T
    return ab[:, :order], ab[:, order:], cd[:, :order], cd[:, order:]


def _rows(u: np.ndarray, y: np.ndarray, horizon: int) -> tuple[np.ndarray, ...]:
    """Past, past a sample later, future, future inputs, and inputs and outputs now, by row."""
    both, count = np.hstack([y, u]), len(y) - 2 * horizon
    at = np.arange(horizon, horizon + count, max(1, count // ROWS))

    def around(of, begin, end):
        return np.concatenate([of[at + k] for k in range(begin, end)], axis=1)

    return (
        around(both, -horizon, 0), around(both, 1 - horizon, 1), around(y, 0, horizon),
        around(u, 0, horizon), u[at], y[at],
    )  # fmt: skip


def normal_form(
    a: np.ndarray, b: np.ndarray, c: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Write a stable system with a aᵀ + b bᵀ = 1.

    Returns
    -------
    tuple of array
        `around` of `beamfit.dynamics.states.contraction`, shape (n + m, n + m), c, and the matrix
        that takes states to the new ones.
    """
    n = len(a)
    reach = solve_discrete_lyapunov(a, b @ b.T)
    reach = 0.5 * (reach + reach.T) + 1e-10 * max(np.trace(reach), 1e-12) * np.eye(n)
    values, vectors = np.linalg.eigh(reach)
    size = np.sqrt(np.maximum(values, 1e-14 * values.max()))
    to, back = (vectors / size) @ vectors.T, (vectors * size) @ vectors.T
    both = np.hstack([to @ a @ back, to @ b])
    left, _, right = np.linalg.svd(both)
    around = right.copy()
    around[:n] = left @ right[:n]  # the rows that are nearest, orthonormal
    return around, c @ back, to


def padded(model: dict[str, Any], size: int) -> dict[str, Any]:
    """The model with further states that nothing moves and nobody reads."""
    p, (n, m) = model["p"], model["p"]["z"].shape
    more, at = size - n, [*range(n), *range(size, size + m)]
    around = np.zeros((size + m, size + m))
    around[np.ix_(at, at)] = p["around"]
    wide = {"z": np.pad(p["z"], ((0, more), (0, 0))), "c": np.pad(p["c"], ((0, 0), (0, more)))}
    start = np.pad(model["start"], ((0, 0), (0, more)))
    nodes = np.zeros((len(start), 0, size))
    return {"p": p | wide | {"around": around}, "start": start, "nodes": nodes}


def stripped(model: dict[str, Any], n: int) -> dict[str, Any]:
    """The model without the states beyond the first n."""
    p, (size, m) = model["p"], model["p"]["z"].shape
    at = np.array([*range(n), *range(size, size + m)])
    less = {"z": p["z"][:n], "c": p["c"][:, :n], "around": p["around"][at][:, at]}
    return {"p": p | less, "start": model["start"][:, :n], "nodes": model["nodes"][:, :, :n]}
