"""Posteriors against exact ones: quadrature, and calibration by simulation.

A few simulations run with all tests; the 300 of each kind by `make calibrate`.
"""

from __future__ import annotations

import numpy as np
import pytest

import beamfit
from beamfit.lifetime.decay import current
from beamfit.optics.elements import Drift, Quadrupole, Screen
from beamfit.sampling.priors import Uniform
from beamfit.studies.decay.fit import fit_decay
from beamfit.studies.decay.record import DecayRecord
from beamfit.studies.scan.posterior import beam_target
from beamfit.studies.scan.scans import QuadScan
from tests.sampling.ranks import rank, uniformity


@pytest.fixture(scope="module")
def gtf():
    scan = beamfit.read_quad_scan("measurements/gtf_simulated.csv")
    return scan, beamfit.load_lattice("lattices/gtf.toml")


def moments(values, weight):
    mean = values @ weight / weight.sum()
    return mean, np.sqrt((values - mean) ** 2 @ weight / weight.sum())


@pytest.mark.parametrize("method", ["size_squared", "size"])
@pytest.mark.parametrize("noise", ["known", "inferred"])
def test_known_transport_by_quadrature(gtf, method, noise):
    """Sums over a grid of (σ11, σ12, σ22) in plain numpy, the noise integrated in closed form."""
    fit = beamfit.fit_emittance(*gtf, method=method)
    found = fit.sample(seed=2, noise=noise, target_ess=40_000)
    assert found.status.value == "converged"
    p = fit.x.points
    root = np.linalg.cholesky(fit.x.covariance)
    reach = 8.0 if noise == "inferred" else 6.0
    side = np.linspace(-reach, reach, 81)
    steps = np.stack(np.meshgrid(side, side, side, indexing="ij"), -1).reshape(-1, 3)
    grid = np.array([q.value for q in fit.x.sigma]) + steps @ root.T
    s11, s12, s22 = grid.T
    positive = (s11 > 0) & (s11 * s22 > s12**2)
    chi2 = np.zeros(len(grid))
    columns = (p.r11, p.r12, p.known, p.size, p.error, p.weighed)
    for a, b, known, size, error, weighed in zip(*columns, strict=True):
        squared = a * a * s11 + 2 * a * b * s12 + b * b * s22 + known
        if method == "size":
            chi2 += ((np.sqrt(squared) - size) / error) ** 2
        else:
            chi2 += ((squared - size**2) / (2 * weighed * error)) ** 2
    # ∫ s^-n exp(-chi2/2s²) d ln s is proportional to chi2^(-n/2).
    log = -0.5 * chi2 if noise == "known" else -0.5 * len(p.size) * np.log(chi2)
    weight = np.exp(log - log.max()) * positive
    emittance = np.sqrt(np.where(positive, s11 * s22 - s12**2, 0.0))
    exact = {"x.sigma11": s11, "x.sigma12": s12, "x.sigma22": s22, "x.emittance": emittance}
    exact["x.beta"] = s11 / np.where(positive, emittance, 1.0)
    for name, values in exact.items():
        mean, sd = moments(values, weight)
        assert found.values(name).mean() == pytest.approx(mean, abs=0.02 * sd)
        assert found.values(name).std() == pytest.approx(sd, rel=0.02)


BOX = {"sigma11": (0.5e-8, 4e-8), "sigma12": (-1e-8, 2.5e-8), "sigma22": (0.3e-8, 2e-8)}
LINE = beamfit.Beamline((Quadrupole("Q", 0.1), Drift("D", 2.0), Screen("S")), 135.0)
SETTINGS = np.linspace(-1.0, 11.0, 9)
SIZE_ERROR = 8e-6
PRIORS = {f"x.{name}": Uniform(*ends) for name, ends in BOX.items()}


def true_sigma(random):
    while True:
        sigma = np.array([random.uniform(*ends) for ends in BOX.values()])
        if sigma[0] * sigma[2] > sigma[1] ** 2:
            return sigma


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
        fit = beamfit.fit_emittance(scan, LINE, method="size")
        found = fit.sample(noise="known", priors=PRIORS, seed=k, target_ess=1000)
        assert found.diagnostics.settled
        truth = {"x.sigma11": s11, "x.sigma12": s12, "x.sigma22": s22}
        truth["x.emittance"] = np.sqrt(s11 * s22 - s12**2)
        ranks.append([rank(found, name, value) for name, value in truth.items()])
    return dict(zip(truth, np.array(ranks).T, strict=True))


RANGES = {"i0": (495.0, 505.0), "a": (0.0, 3e-8), "b": (0.0, 3e-6)}
TIMES = np.linspace(0.0, 2 * 3600.0, 60)
CURRENT_ERROR = 0.02


def decay_ranks(number, seed):
    """Ranks of the true I0, a, b and lifetime over simulated decays."""
    random = np.random.default_rng(seed)
    priors = {name: Uniform(*ends) for name, ends in RANGES.items()}
    ranks = []
    for k in range(number):
        truth = {name: random.uniform(*ends) for name, ends in RANGES.items()}
        clean = np.array(current(TIMES, *truth.values()))
        noisy = clean + CURRENT_ERROR * random.normal(size=len(TIMES))
        record = DecayRecord(TIMES, noisy, np.full(len(TIMES), CURRENT_ERROR))
        fit = fit_decay(record)
        found = fit.sample(noise="known", priors=priors, seed=k, target_ess=1000)
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
    report(kind(10, seed=1), 1e-3)


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
    fit = beamfit.fit_emittance(*gtf)
    stated = beam_target(fit)
    at = stated.log_probability(stated.mode[None])[0]
    assert at == pytest.approx(-0.5 * fit.x.chi2, rel=1e-9)
