"""Appendix B stated by hand, and as a transport network with its box and its gains: one problem.

Table 2's second row. Scans are SIMULATED (tests/greybox/appendices.py).
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import beamfit
from beamfit.emittance.assumptions import Assumptions
from beamfit.emittance.statement import prepare
from beamfit.emittance.transport_network import SCENARIO
from beamfit.errors import InputError
from beamfit.greybox.problem import with_slope
from beamfit.greybox.signed_network import certificate_of
from tests.greybox.appendices import (
    CURRENTS,
    LIMITS,
    SIGMA,
    appendix_b,
    certified_constraints,
    simulated_scan,
)

BOX = {"x.sigma11": (2e-8, 3e-8), "x.sigma12": (1e-8, 2e-8), "x.sigma22": (1e-8, 2e-8)}
GAINS = {f"d{e}_x/dQ2": (-np.inf, LIMITS[e]) for e in "AB"}


@pytest.fixture(scope="module")
def line(root):
    return beamfit.load_lattice(root / "lattices/gtf.toml")


@pytest.fixture(scope="module")
def scan():
    size, error = (1e-6 * v for v in simulated_scan(1))
    return beamfit.QuadScan({"Q2": CURRENTS}, {"Q2": "A"}, {"x": size}, {"x": error})


@pytest.fixture(scope="module")
def ours(scan, line):
    """The scenario's problem, with the appendix's weights 1/(2 dx_measured sdx_measured).

    The errors are those of the appendix, which takes them as right.
    """
    seen = prepare(scan, line, ("x",), weights="measured")
    points = seen.solutions["x"].points._replace(error=scan.error["x"])
    seen = seen._replace(solutions={"x": seen.solutions["x"]._replace(points=points)})
    return SCENARIO.state(seen, Assumptions(bounds=BOX, gains=GAINS))


@pytest.fixture(scope="module")
def theirs():
    return appendix_b(simulated_scan(1), certified_constraints())


def numbers(seed):
    """Some beam within the box and some weights, as both problems have them."""
    random = np.random.default_rng(seed)
    s11, s12, s22 = np.array([2.2, 1.1, 1.2]) + 0.5 * random.uniform(size=3)
    return np.array([s11, s12, s22]), random.normal(scale=0.7, size=22)


def factor(sigma):
    l11 = jnp.sqrt(sigma[0])
    l21 = sigma[1] / l11
    return jnp.stack([l11, l21, jnp.sqrt(sigma[2] - l21**2)])


def split(problem):
    """Where the beam's three numbers and the 22 weights stand among the free ones."""
    weights = [i for i, name in enumerate(problem.names) if name.startswith("map.")]
    beam = [i for i in range(len(problem.names)) if i not in weights]
    return beam, weights


def by_numbers(problem, function, beam_of):
    """A function of a problem as one of σ in 1e-8 SI and the weights."""
    beam, weights = split(problem)

    def of(both):
        theta = jnp.zeros(25).at[jnp.array(beam)].set(beam_of(both[:3]))
        return function(theta.at[jnp.array(weights)].set(both[3:]))

    return of


def together(functions):
    return lambda theta: [function(theta) for function in functions]


def test_it_is_the_appendix_in_value_and_gradient(ours, theirs):
    named = [n.split("[")[0] for n in theirs.names if n.startswith("map.")]
    assert [n.split("[")[0] for n in ours.names if n.startswith("map.")] == named
    assert len(named) == 22
    limits = lambda t: ours.constraint_values(t)[:64]  # noqa: E731
    mine = lambda t: ours.residual(t)[:14], limits, ours.cost
    hand = theirs.residual, theirs.constraint_values, theirs.cost
    f, g = (
        jax.jit(partial(with_slope, by_numbers(problem, together(parts), beam_of)))
        for problem, parts, beam_of in ((ours, mine, factor), (theirs, hand, lambda sigma: sigma))
    )
    for seed in (1, 2, 3):
        both = jnp.concatenate([jnp.asarray(v) for v in numbers(seed)])
        for pair in zip(f(both), g(both), strict=True):
            for found, expected in zip(*pair, strict=True):
                scale = np.abs(expected).max()
                np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * scale)


def test_the_padding_of_the_scan_weighs_nothing(ours):
    beam, weights = split(ours)
    theta = np.zeros(25)
    theta[beam], theta[weights] = factor(numbers(1)[0]), numbers(1)[1]
    assert not np.asarray(ours.residual(theta))[14:].any()


def test_boxes_and_limits_are_the_appendix_s(ours, theirs):
    for ends in ("lower", "upper"):
        mine, hand = getattr(ours, ends), getattr(theirs, ends)
        np.testing.assert_array_equal(mine[split(ours)[1]], hand[split(theirs)[1]])
        limits = getattr(ours, f"constraint_{ends}")
        np.testing.assert_array_equal(limits[:64], getattr(theirs, f"constraint_{ends}"))
        np.testing.assert_allclose(limits[64:], hand[split(theirs)[0]], rtol=1e-15)
    theta = np.zeros(25)
    theta[split(ours)[0]] = factor(np.array(SIGMA))
    np.testing.assert_allclose(ours.constraint_values(theta)[64:], SIGMA, rtol=1e-14)


def test_the_fit_keeps_to_box_and_gains_and_determines_nothing(scan, line):
    told = {"bounds": BOX, "gains": GAINS, "weights": "measured", "starts": 1, "hidden": 3}
    fit = beamfit.fit_emittance(scan, line, scenario="transport-network", **told)
    assert fit.x.status.value == "unidentified"
    assert "box x" in fit.x.message
    # A corner of the box has no error, which is no knowledge.
    assert (fit.x.error_scale, fit.x.emittance.interval_95) == (1.0, None)
    assert fit.x.emittance.error is None
    sigma = [1e8 * q.value for q in fit.x.sigma]
    for value, (low, high) in zip(sigma, BOX.values(), strict=True):
        assert 1e8 * low - 1e-5 < value < 1e8 * high + 1e-5
    found = certificate_of(fit.problem, fit.fit.model["map"])
    assert found.box == {"Q2": (0.0, 3.9)}
    for gain, top in zip(found.gains, LIMITS.values(), strict=True):
        assert gain.upper < top + 1e-6
    net, between = fit.fit.model["map"], jnp.linspace(0.0, 3.9, 20001)[:, None]
    slopes = jax.jit(jax.vmap(jax.jacfwd(net.values)))(between)[..., 0]
    assert np.all(np.max(slopes, axis=0) <= np.array([*LIMITS.values()]) + 1e-8)
    assert fit.fit.chi2 < 14.0


def test_what_there_is_not_is_named(scan, line):
    def fit(**told):
        return beamfit.fit_emittance(scan, line, scenario="transport-network", **told)

    with pytest.raises(InputError, match=r"gain 'dA/dQ2'.*dA_x/dQ2"):
        fit(gains={"dA/dQ2": (-np.inf, 0.0)})
    with pytest.raises(InputError, match=r"bounds on 'x.sigma1'.*x.sigma11"):
        fit(bounds={"x.sigma1": (1e-8, 2e-8)})
    with pytest.raises(InputError, match="bounds that hold the scan"):
        fit(bounds={"Q2": (0.0, 3.0)})
    with pytest.raises(InputError, match="a finite limit at least"):
        fit(gains={"dA_x/dQ2": (-np.inf, np.inf)})
    with pytest.raises(InputError, match="limits of gains with scenario known"):
        beamfit.fit_emittance(scan, line, gains=GAINS)
    with pytest.raises(InputError, match=r"a prior or bounds on Q2.slope with scenario transport"):
        fit(priors={"Q2.slope": (167.23, 3.0)})
