"""Posteriors against exact ones: quadrature, and calibration by simulation.

A few simulations run with all tests; the 300 of each kind by `make calibrate`.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

import beamfit
from beamfit.emittance.posterior import beam_target
from beamfit.emittance.scan import QuadScan
from beamfit.lifetime.decay_law import current
from beamfit.lifetime.fit import fit_decay
from beamfit.lifetime.record import DecayRecord
from beamfit.optics.elements import Drift, Quadrupole, Screen
from beamfit.sampling.priors import Uniform
from tests.noise import reference as ref
from tests.sampling.ranks import rank, uniformity


@pytest.fixture(scope="module")
def gtf():
    scan = beamfit.read_quad_scan("measurements/gtf_simulated.csv")
    return scan, beamfit.load_lattice("lattices/gtf.toml")


def moments(values, weight):
    mean = values @ weight / weight.sum()
    return mean, np.sqrt((values - mean) ** 2 @ weight / weight.sum())


@pytest.mark.parametrize("kind", ["stated", "none"])
def test_known_transport_by_quadrature(gtf, kind):
    """Sums over a grid of (σ11, σ12, σ22) and over the noise in plain numpy, with the prior."""
    scan, line = gtf
    if kind == "none":
        scan = replace(scan, error={})
    fit = beamfit.fit_emittance(scan, line)
    found = fit.sample(("x",), seed=2, target_ess=16_000)
    assert found.status.value == "converged"
    p = fit.x.points
    rows = np.stack([p.r11**2, 2 * p.r11 * p.r12, p.r12**2], -1)
    spread = rows / (2 * p.model * p.error)[:, None]
    root = np.linalg.cholesky(np.linalg.inv(spread.T @ spread))
    side = np.linspace(-11.0, 11.0, 33)  # noise that may go on from row to row has wide tails
    steps = np.stack(np.meshgrid(side, side, side, indexing="ij"), -1).reshape(-1, 3)
    grid = fit.seen.solutions["x"].posterior.best + steps @ root.T
    s11, s12, s22 = grid.T
    model = np.sqrt(np.maximum(grid @ rows.T + p.known, 1e-30))
    if kind == "none":
        log = ref.log_unstated(p.size, model, beamfit.Noise())
    else:
        log = ref.log_stated(p.size, model, scan.error["x"], beamfit.Noise())
    log = log + ref.log_prior(rows, p.size, grid)
    weight = np.exp(log - log.max())
    emittance = np.sqrt(np.maximum(s11 * s22 - s12**2, 0.0))
    exact = {"x.sigma11": s11, "x.sigma12": s12, "x.sigma22": s22, "x.emittance": emittance}
    exact["x.beta"] = s11 / np.where(weight > 0, emittance, 1.0)
    for name, values in exact.items():
        mean, sd = moments(values, weight)
        assert found.values(name).mean() == pytest.approx(mean, abs=0.03 * sd)
        assert found.values(name).std() == pytest.approx(sd, rel=0.03)


BOX = {"sigma11": (0.5e-8, 4e-8), "sigma12": (-1e-8, 2.5e-8), "sigma22": (0.3e-8, 2e-8)}
LINE = beamfit.Beamline((Quadrupole("Q", 0.1), Drift("D", 2.0), Screen("S")), 135.0)
SETTINGS = np.linspace(-1.0, 11.0, 9)
SIZE_ERROR = 8e-6
PRIORS = {f"x.{name}": Uniform(*ends) for name, ends in BOX.items()}
# Sure of stated errors and of readings, as they are simulated.
SURE = beamfit.Noise(right=1.0 - 1e-9, bad=1e-12)


def true_sigma(random):
    """Within the box as dσ/ε, the scan's own prior: even in ε, σ12 and ln σ11.

    The mean square over the scan, which it has besides, the sizes tell to a percent.
    """
    (low, high), corner, (least, most) = BOX.values()
    while True:
        s11, s12 = low * (high / low) ** random.uniform(), random.uniform(*corner)
        s22 = (random.uniform(0.0, math.sqrt(high * most)) ** 2 + s12**2) / s11
        if least < s22 < most:
            return np.array([s11, s12, s22])


def scan_ranks(number, seed):
    """Ranks of the true σ and emittance over scans simulated with normal errors of the sizes."""
    random = np.random.default_rng(seed)
    rows = [LINE.matrix({"Q": k}).x for k in SETTINGS]
    a, b = (np.array([float(row[0, j]) for row in rows]) for j in (0, 1))
    ranks = []
    for k in range(number):
        s11, s12, s22 = true_sigma(random)
        size = np.sqrt(a * a * s11 + 2 * a * b * s12 + b * b * s22)
        size = size + SIZE_ERROR * random.normal(size=len(size))
        errors = {"x": np.full(len(size), SIZE_ERROR)}
        scan = QuadScan({"Q": SETTINGS}, {"Q": "k1"}, {"x": np.maximum(size, 1e-6)}, errors)
        fit = beamfit.fit_emittance(scan, LINE, method="size", noise=SURE)
        found = fit.sample(priors=PRIORS, seed=k, target_ess=1000)
        assert found.diagnostics.settled
        truth = {"x.sigma11": s11, "x.sigma12": s12, "x.sigma22": s22}
        truth["x.emittance"] = np.sqrt(s11 * s22 - s12**2)
        ranks.append([rank(found, name, value) for name, value in truth.items()])
    return dict(zip(truth, np.array(ranks).T, strict=True))


# The prior of a decay is flat in its loss rate and in the share of a.
RATES = (5e-6, 1.5e-5)
TIMES = np.linspace(0.0, 2 * 3600.0, 60)
CURRENT_ERROR = 0.02


def decay_ranks(number, seed):
    """Ranks of the true I0, a, b and lifetime over simulated decays."""
    random = np.random.default_rng(seed)
    ranks = []
    for k in range(number):
        rate, share = random.uniform(*RATES), random.uniform()
        truth = {"i0": random.uniform(495.0, 505.0)}
        truth |= {"a": share * rate / 500.0, "b": (1 - share) * rate}
        clean = np.array(current(TIMES, *truth.values()))
        noisy = clean + CURRENT_ERROR * random.normal(size=len(TIMES))
        record = DecayRecord(TIMES, noisy, np.full(len(TIMES), CURRENT_ERROR))
        found = fit_decay(record, law="constant").sample(seed=k, target_ess=1000)
        assert found.diagnostics.settled
        rate = truth["a"] * record.current.mean() + truth["b"]
        truth["lifetime_mean"] = 1 / rate / 3600.0
        ranks.append([rank(found, name, value) for name, value in truth.items()])
    return dict(zip(truth, np.array(ranks).T, strict=True))


def report(ranks, least):
    found = {name: uniformity(values) for name, values in ranks.items()}
    print({name: round(value, 3) for name, value in found.items()})
    assert min(found.values()) > least


@pytest.mark.parametrize("kind", [scan_ranks, decay_ranks])
def test_a_few_simulations_are_ranked_uniformly(kind):
    """Enough to see a posterior that is shifted or much too narrow."""
    report(kind(5, seed=1), 1e-3)


@pytest.mark.calibrate
@pytest.mark.parametrize("kind", [scan_ranks, decay_ranks])
def test_simulation_based_calibration(kind):
    """300 simulations each; fixed seeds, p > 0.01 for every number."""
    report(kind(300, seed=2), 0.01)


def test_a_posterior_that_is_too_narrow_is_found_out():
    """The check can fail: draws pulled towards their mean are not ranked uniformly."""
    random = np.random.default_rng(5)
    narrow = [int(np.sum(0.5 * random.normal(size=99) < random.normal())) for _ in range(300)]
    right = [int(np.sum(random.normal(size=99) < random.normal())) for _ in range(300)]
    assert uniformity(np.array(narrow)) < 1e-6
    assert uniformity(np.array(right)) > 0.01


def test_the_posterior_begins_at_the_fit(gtf):
    """Its density there is that of the sizes, the noise averaged over, with the prior."""
    scan, line = gtf
    fit = beamfit.fit_emittance(scan, line)
    stated = beam_target(fit)
    p, post = fit.x.points, fit.seen.solutions["x"].posterior
    sigma = np.array([q.value for q in fit.x.sigma])
    np.testing.assert_allclose(stated.mode, sigma, rtol=1e-3)
    rows = np.stack([p.r11**2, 2 * p.r11 * p.r12, p.r12**2], -1)
    near = stated.mode * (
        1 + 0.01 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 1], [-1, 0, 1]])
    )
    found = stated.log_probability(near)
    model = np.sqrt(near @ rows.T + p.known)
    log = ref.log_stated(p.size, model, scan.error["x"], beamfit.Noise())
    log = log + ref.log_prior(rows, p.size, near)
    np.testing.assert_allclose(found - found[0], log - log[0], atol=0.05)
    assert post.positive
