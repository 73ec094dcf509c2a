"""Mass balances against the SIMULATED plant's own integration by LSODA."""

import runpy

import jax.numpy as jnp
import numpy as np
import pytest

from beamfit.dynamics.balances import Flow, balances, titre_of
from beamfit.dynamics.states import StateSpace


@pytest.fixture(scope="module")
def plant(root):
    return runpy.run_path(str(root / "measurements/make_fedbatch.py"))


def test_balances_and_titre_follow_an_independent_integration(plant):
    steps = 25
    feed, air = np.linspace(0.05, 0.2, steps), np.full(steps, 0.8)
    true = plant["plant"]((2.0, 5.0, 4.0, 0.3), feed, air, apart=0.1)

    def plant_rates(s):
        growth = 0.30 * s / (1.0 + s + s**2 / 20.0) * 0.8 / 1.05
        made = (0.10 * growth + 0.004 * s / (1.0 + s)) / (1.0 + s / 8.0)
        return growth, growth / 0.5 + 0.03 * s / (1.0 + s), made

    def slope(x, u, _):
        return balances(x, jnp.stack(plant_rates(x[1])[:2]), Flow(u[0], plant["FED"], 0.0))

    begin = jnp.array([2.0, 5.0, 4.0])
    space = StateSpace(slope, lambda x, u, p: x, parts=2)
    x, _ = space.run(None, jnp.asarray(feed)[:, None], jnp.full(steps, 0.1), begin)
    np.testing.assert_allclose(x, true[:, :3], rtol=2e-6)
    made = plant_rates(x[:, 1])[2]
    both = jnp.stack([made, jnp.append(made[1:], 0.0)])
    found = titre_of(0.3, both, x, jnp.zeros(steps), jnp.full(steps, 0.1))
    np.testing.assert_allclose(found, true[:, 3], rtol=2e-4)


def test_what_runs_out_leaves_concentrations_and_takes_its_share_of_product():
    """At rest: X V falls by what runs out; product without formation keeps its titre."""
    inside, still = jnp.array([3.0, 2.0, 5.0]), jnp.zeros(2)
    out = balances(inside, still, Flow(0.0, 100.0, 0.4))
    np.testing.assert_allclose(out, [0.0, 0.0, -0.4])
    x = jnp.stack([jnp.full(11, 3.0), jnp.full(11, 2.0), 5.0 - 0.04 * jnp.arange(11)], axis=1)
    found = titre_of(0.7, jnp.zeros((2, 11)), x, jnp.full(11, 0.4), jnp.full(11, 0.1))
    np.testing.assert_allclose(found, 0.7, rtol=1e-5)
