"""Physics and networks combined: in series, in parallel, and before a difference equation.

The report's figure 2 and its footnote 5 (PV = zT with z a network of T and P). Data are SIMULATED
from formulas the models do not contain.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from beamfit.greybox.equations import TaylorDifference
from beamfit.greybox.maps import Formula, Parallel, Series
from beamfit.greybox.mlp import Port, dense
from beamfit.greybox.problem import Free, Prior, Problem, Record
from beamfit.greybox.solve import solve

GAS = 8.314462618  # J/(mol K), CODATA 2018


def van_der_waals_volume(t, p):
    """Molar volume in m3 of nitrogen, a = 0.137 Pa m6/mol2, b = 3.87e-5 m3/mol, the gas root."""
    a, b = 0.137, 3.87e-5
    roots = np.roots([p, -(p * b + GAS * t), a, -a * b])
    return float(np.max(roots[np.abs(roots.imag) < 1e-9 * np.abs(roots)].real))


def predict(model, x):
    return jax.vmap(model["gas"])(x)[:, 0]


def test_in_series_a_network_finds_a_parameter_nobody_measured():
    """The compressibility z(T, P) from temperature, pressure and volume alone, of five records."""
    ports = [Port("T", "", scale=50.0, bias=325.0), Port("P", "", scale=6e6, bias=1e7)]
    z = dense(ports, [Port("z", "", bias=1.0)], hidden=[6], spread=0.1)
    law = Formula(["z", "T", "P"], ["V"], lambda _, v: 1e6 * v[:1] * GAS * v[1:2] / v[2:])
    model, weak = {"gas": Series(z, law)}, Prior("gas.first", 0.0, 10.0)
    most, inside = [], []
    for seed in range(3, 8):
        random = np.random.default_rng(seed)
        x = np.column_stack([random.uniform(250, 400, 60), random.uniform(1e6, 2e7, 60)])
        volume = np.array([van_der_waals_volume(*row) for row in x])
        error = 3e-3 * volume
        measured = 1e6 * (volume + error * random.normal(size=60))  # cm3
        record = Record("gas", predict, x, measured, 1e6 * error)
        free = [Free("gas", -50, 50, nuisance=True)]
        fit = solve(Problem(model, free, [record], priors=[weak]), starts=3)
        assert fit.chi2 < 1.5 * 60
        new = np.column_stack([random.uniform(260, 390, 40), random.uniform(2e6, 1.9e7, 40)])
        truth = [p * van_der_waals_volume(t, p) / (GAS * t) for t, p in new]
        found = fit.derive(lambda m, x: jax.vmap(m["gas"].first)(x)[:, 0], new)
        most.append(np.max(np.abs(found.value - truth)))
        inside.append(np.mean(np.abs(found.value - truth) < 2 * found.error))
    assert np.median(most) < 6e-3
    assert min(inside) > 0.8


def decay_with_ripple(t):
    return 3.0 * np.exp(-0.8 * t) + 0.2 * np.sin(2 * t)


def physics(rate, x):
    return 3.0 * jnp.exp(-rate * x[:1])


@pytest.mark.parametrize("free_rate", [False, True], ids=["weights", "weights and physics"])
def test_in_parallel_a_network_clears_up_what_physics_leaves(free_rate):
    t = np.linspace(0.0, 4.0, 60)
    noise = 0.02 * np.random.default_rng(5).normal(size=60)
    law = Formula(["t"], ["y"], physics, jnp.array(0.8 if not free_rate else 0.5))
    clean_up = dense(["t"], ["y"], hidden=[5], seed=2, spread=0.5)
    record = Record("r", predict, t[:, None], decay_with_ripple(t) + noise, 0.02)
    free = [Free("gas.parts.1", -20, 20, nuisance=True)]
    if free_rate:
        free.append(Free("gas.parts.0", 0.1, 2.0))
    model = {"gas": Parallel([law, clean_up])}
    fit = solve(Problem(model, free, [record], priors=[Prior("gas.parts.1", 0.0, 3.0)]), starts=3)
    alone = solve(Problem({"gas": law}, [Free("gas", 0.1, 2.0)], [record]))
    assert alone.status == "poor_fit"
    between = np.linspace(0.1, 3.9, 77)
    found = fit.derive(predict, between[:, None])
    assert np.max(np.abs(found.value - decay_with_ripple(between))) < 0.05
    assert np.mean(np.abs(found.value - decay_with_ripple(between)) < 2 * found.error) > 0.8


LAG = TaylorDifference(("u",), ("y",), y_past=1, u_past=0)


def coefficients(net, u):
    """Pole in (0, 1) whatever the weights, so that no start runs away; static gain 1."""
    pole = jax.nn.sigmoid(jax.vmap(net.values)(u)[:, 0])
    return jnp.column_stack([jnp.zeros(len(u)), pole, 1 - pole])


def run(model, data):
    u, y0 = data
    return LAG.simulate(coefficients(model["map"], u), u, y0)[:, 0]


def test_where_no_physics_is_known_a_network_varies_a_difference_equation():
    """A lag whose pole falls with the input, found from input and output alone (eqs 2-4)."""
    random = np.random.default_rng(7)
    u = np.repeat(random.uniform(-1, 1, 80), 5)
    pole = 0.9 - 0.25 * (1 + u)
    y = [0.0]
    for a, now in zip(pole, u, strict=True):
        y.append(a * y[-1] + (1 - a) * now)
    measured = np.array(y[1:]) + 0.01 * random.normal(size=400)
    record = Record("r", run, (u[:, None], np.zeros((1, 1))), measured, 0.01)
    problem = Problem(
        {"map": dense(["u"], ["logit"], hidden=[3], seed=1, spread=0.3)},
        [Free("map", -20, 20, nuisance=True)],
        [record],
        priors=[Prior("map", 0.0, 5.0)],
    )
    fit = solve(problem, starts=2)
    at = np.linspace(-0.9, 0.9, 19)
    found = coefficients(fit.model["map"], at[:, None])[:, 1]
    np.testing.assert_allclose(found, 0.9 - 0.25 * (1 + at), atol=0.02)
    assert fit.chi2 / 400 == pytest.approx(1.0, abs=0.25)
