"""Mass balances against the SIMULATED plant's own integration by LSODA."""

import runpy
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from beamfit.dynamics.balances import Batches, Flow, course, predicted, titre_of


@pytest.fixture(scope="module")
def plant(root):
    return runpy.run_path(str(root / "measurements/make_fedbatch.py"))


def batch(feed, air, ends=((0.0, 0.0), (1.0, 2.0)), out=0.0, fed=200.0, dt=0.5):
    flow = Flow(*(jnp.broadcast_to(v, (1, len(feed))) for v in (feed, fed, out)))
    u = jnp.asarray(air, float)[None, :, None]
    return Batches(("air",), 1, u, flow, jnp.full((1, len(feed)), dt), jnp.asarray(ends))


def model(of, start, half=1.0, names=("substrate", "air"), **more):
    """A model whose shares are a formula's in the place of a network's."""
    net = SimpleNamespace(inputs=names, values=lambda known: jax.scipy.special.logit(of(*known)))
    own = {"own": jnp.zeros((1, 3))}
    return {"rates": net, "half": half, "start": jnp.log(jnp.array([start]))} | own | more


def true_shares(log, air):
    """Growth and consumption of the plant over most S/(S + s)."""
    s = jnp.exp(log) - 1.0
    growth = 0.30 / (1.0 + s + s**2 / 20.0) * air / (0.25 + air)
    return jnp.stack([growth, growth + 0.5 * 0.03 / (1.0 + s)]) * (s + 1.0)


def test_balances_and_titre_follow_an_independent_integration(plant):
    rows, random = 80, np.random.default_rng(0)
    feed = np.repeat(random.uniform(0, 0.2, 20), 4) * (np.arange(rows) > 16)
    air = np.repeat(random.uniform(0.3, 1.2, 8), 10)
    true = plant["plant"]((1.0, 8.0, 4.0, 0.3), feed, air)
    of_product = SimpleNamespace(
        inputs=("mu_b", "substrate"),
        values=lambda k: jax.scipy.special.logit(
            (0.10 * k[:1] + 0.004 * (1.0 - jnp.exp(-k[1:]))) / (1.0 + (jnp.exp(k[1:]) - 1.0) / 8.0)
        ),
    )
    more = {"product": of_product, "most": 1.0, "decay": 0.0, "begin": jnp.array([0.3])}
    found = predicted(model(true_shares, (1.0, 8.0, 4.0), **more), batch(feed, air))[0]
    assert np.abs(found / true - 1.0)[:, [0, 2]].max() < 1e-3
    assert np.abs(found - true)[:, 1].max() < 5e-3
    assert np.abs(found - true)[:, 3].max() < 5e-3 * true[:, 3].max()


def test_substrate_that_is_consumed_within_seconds_is_what_the_feed_allows():
    """Of 1000 half-lives in a row: the substrate at rest has the consumption of the feed."""
    feed = np.repeat([0.02, 0.1, 0.05], 20)
    one = model(lambda log, air: jnp.full(2, 0.5), (10.0, 5.0, 4.0), half=1e-3)
    found = np.asarray(course(one, batch(feed, np.ones(60)))[0])
    assert found[:, 1].min() > 0
    x, s, v = found[[19, 39, 59]].T
    mass = feed[[18, 38, 58]] / v * (200.0 - s) / x  # per gram of biomass
    np.testing.assert_allclose(s / (s + 1e-3), mass, rtol=0.05)


def test_cells_die_without_substrate_where_rates_may_be_negative():
    ends, dead = ((-0.1, 0.0), (1.0, 2.0)), model(lambda log, air: jnp.full(2, 0.25), (10.0, 0, 4))
    dead["start"] = dead["start"].at[0, 1].set(-40.0)
    x = np.asarray(course(dead, batch(np.zeros(21), np.ones(21), ends))[0])
    np.testing.assert_allclose(x[-1, 0], 10.0 * np.exp(-0.075 * 10.0), rtol=1e-6)


def test_what_runs_out_leaves_concentrations_and_takes_its_share_of_product():
    """At rest: X V falls by what runs out; product without formation keeps its titre or decays."""
    still = model(lambda log, air: jnp.full(2, 1e-12), (3.0, 2.0, 5.0))
    x = np.asarray(course(still, batch(np.zeros(11), np.ones(11), out=0.4, dt=0.1))[0])
    np.testing.assert_allclose(x[-1], [3.0, 2.0, 4.6], rtol=1e-9)
    lost = jnp.stack([0.4 / x[:, 2], 0.4 / np.append(x[1:, 2], x[-1, 2])])
    for decay in (0.0, 0.5):
        found = titre_of(0.7, jnp.zeros((2, 11)), x, decay + lost, jnp.full(11, 0.1))
        np.testing.assert_allclose(found, 0.7 * np.exp(-decay * 0.1 * np.arange(11)), rtol=1e-5)
