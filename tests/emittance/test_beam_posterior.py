"""The posterior of a plane against one written out in plain NumPy, and against the sampler."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import multivariate_t

import beamfit
from beamfit.emittance.comparison import (
    AMPLITUDES,
    CURVE_AMPLITUDES,
    CURVE_LENGTHS,
    DEPARTURE_SHARE,
    MODELS,
    weighted_quantiles,
)
from beamfit.noise.model import Noise
from tests.emittance.conftest import TABLE_2, design
from tests.emittance.test_departure import dense_odds
from tests.noise import reference as ref

CURRENTS = {5: np.linspace(0.2, 3.4, 5), 9: np.linspace(0.0, 3.9, 9)}
KINDS = ["stated", "share", "shots", "none"]
ENDS = (0.025, 0.1587, 0.5, 0.8413, 0.975)


@pytest.fixture(scope="module")
def scan_of_kind(gtf):
    def scan(kind, n, relative=0.03, seed=1):
        rng = np.random.default_rng(seed)
        currents = CURRENTS[n]
        true = np.sqrt(design(gtf, {"Q2": currents}) @ TABLE_2)
        if kind == "shots":
            true = true * (1 + 0.02 * rng.normal(size=n))
            shots = true[:, None] * (1 + relative * rng.normal(size=(n, 5)))
            size, more = shots.mean(1), {"shots": np.full(n, 5), "shot_size": {"x": shots}}
            error = {"x": shots.std(1, ddof=1) / np.sqrt(5)}
            return beamfit.QuadScan({"Q2": currents}, {"Q2": "A"}, {"x": size}, error, **more)
        size = true * (1 + relative * rng.normal(size=n))
        error = {"stated": relative * true, "share": relative * size}.get(kind)
        error = {} if error is None else {"x": error}
        return beamfit.QuadScan({"Q2": currents}, {"Q2": "A"}, {"x": size}, error)

    return scan


def likelihood(kind, size, error, noise):
    if kind == "stated":
        return lambda model: ref.log_stated(size, model, error, noise)
    if kind == "share":
        return lambda model: ref.log_share(size, model, error / size, noise)
    if kind == "shots":
        return lambda model: ref.log_of_shots(size, model, error, noise)
    if kind == "same":
        return lambda model: ref.log_same(size, model, noise)
    return lambda model: ref.log_unstated(size, model, noise)


def brute(fit, kind, noise=Noise()):  # noqa: B008
    """Beams and weights of the x plane of a fit, from its sizes alone."""
    p, sizes = fit.x.points, fit.seen.solutions["x"].sizes
    rows = np.stack([p.r11**2, 2 * p.r11 * p.r12, p.r12**2], -1)
    spread = rows / (2 * p.model * p.error)[:, None]
    covariance = 6.0 * np.linalg.inv(spread.T @ spread)
    log = likelihood(kind, sizes.size, sizes.error, noise)
    centre = np.array([q.value for q in fit.x.sigma])
    return ref.weighted_beams(rows, sizes.size, p.known, log, centre, covariance)


def median(fit):
    post = fit.seen.solutions["x"].posterior
    s11, s12, s22 = post.sigma[post.weight > 0].T
    own = np.sqrt(np.maximum(s11 * s22 - s12**2, 0.0))
    return weighted_quantiles(own, post.weight[post.weight > 0], (0.5,))[0]


@pytest.mark.parametrize(("kind", "n"), [("stated", 5), ("share", 9), ("shots", 9), ("none", 5)])
def test_it_is_the_one_written_out(gtf, scan_of_kind, kind, n):
    """Ends of the intervals of the emittance, the draws and the reference each with its scatter."""
    fit = beamfit.fit_emittance(scan_of_kind(kind, n), gtf)
    sigma, weight = brute(fit, kind)
    assert 1.0 / np.sum(weight**2) > 2000
    emittance = np.sqrt(np.maximum(sigma[:, 0] * sigma[:, 2] - sigma[:, 1] ** 2, 0.0))
    low, lower, middle, upper, high = ref.quantiles(emittance, weight, ENDS)
    q, half = fit.x.emittance, 0.5 * (upper - lower)
    assert q.error == pytest.approx(half, rel=0.1)
    for found, end in zip((median(fit), *q.interval_95), (middle, low, high), strict=True):
        assert abs(found - end) < 0.2 * half
    assert abs(q.value - middle) < half  # the best fit, of the same posterior


@pytest.mark.parametrize("kind", ["stated", "none"])
def test_the_low_end_of_a_short_scan_is_the_one_written_out(gtf, kind):
    """In σ the prior has an edge of infinite density at no emittance, where few draws fell: with
    others the low end was up to four times another. Here they are drawn in T p and 2ε."""
    currents = np.linspace(0.2, 1.6, 6)
    true = np.sqrt(design(gtf, {"Q2": currents}) @ TABLE_2)
    size = true * (1 + 0.02 * np.random.default_rng(3).normal(size=6))
    error = {"x": 0.02 * true} if kind == "stated" else {}
    fit = beamfit.fit_emittance(
        beamfit.QuadScan({"Q2": currents}, {"Q2": "A"}, {"x": size}, error), gtf
    )
    p, post = fit.x.points, fit.seen.solutions["x"].posterior
    rows2 = np.stack([p.r11, p.r12], -1)
    rows = np.stack([p.r11**2, 2 * p.r11 * p.r12, p.r12**2], -1)
    turn = ref.coordinates_of(rows2, size)
    back = np.linalg.inv(turn)
    w = np.einsum("ij,djk,lk->dil", back, post.sigma[:, [0, 1, 1, 2]].reshape(-1, 2, 2), back)
    own = np.stack([w[:, 0, 0] - w[:, 1, 1], 2 * w[:, 0, 1]], -1)
    half = np.sqrt(np.linalg.det(w))
    near = np.column_stack([own, half])
    centre, spread = post.weight @ near, np.cov(near.T, aweights=post.weight)
    wide = multivariate_t(centre, 2.0 * spread, df=4)
    s = wide.rvs(60_000, random_state=np.random.default_rng(1))
    s[:, 2] = np.abs(s[:, 2])
    drawn = np.logaddexp(wide.logpdf(s), wide.logpdf(s * (1, 1, -1)))
    t = np.sqrt(s[:, 0] ** 2 + s[:, 1] ** 2 + 4.0 * s[:, 2] ** 2)
    w = 0.5 * np.stack([t + s[:, 0], s[:, 1], s[:, 1], t - s[:, 0]], -1).reshape(-1, 2, 2)
    sigma = np.einsum("ij,djk,lk->dil", turn, w, turn).reshape(-1, 4)[:, [0, 1, 3]]
    model = np.sqrt(np.maximum(sigma @ rows.T + p.known, 1e-30))
    log = np.concatenate(
        [likelihood(kind, size, error.get("x"), Noise())(m) for m in np.array_split(model, 8)]
    )
    log += -0.5 * np.log(t) ** 2 - 3.0 * np.log(t) - drawn
    weight = np.exp(log - logsumexp(log))
    assert 1.0 / np.sum(weight**2) > 2000
    emittance = s[:, 2] * abs(np.linalg.det(turn))
    found = np.sqrt(np.maximum(post.sigma[:, 0] * post.sigma[:, 2] - post.sigma[:, 1] ** 2, 0.0))
    for at in (0.025, 0.16, 0.5, 0.975):
        theirs = ref.quantiles(emittance, weight, at)
        assert weighted_quantiles(found, post.weight, [at])[0] == pytest.approx(theirs, rel=0.15)


@pytest.mark.parametrize("kind", ["stated", "none"])
def test_the_sampler_draws_from_it(gtf, scan_of_kind, kind):
    """Median and 95 % of emcee to 0.1 errors."""
    fit = beamfit.fit_emittance(scan_of_kind(kind, 9), gtf)
    found = fit.sample(seed=1, target_ess=20000)
    own = fit.x.emittance
    ends = found.quantiles("x.emittance", (0.5, 0.025, 0.975))
    for drawn, quoted in zip(ends, (median(fit), *own.interval_95), strict=True):
        assert abs(drawn - quoted) < 0.1 * own.error


def noises(kind, size, error, noise):
    """Kinds of noise as relative deviations of points: what they scale with, and which scales."""
    if kind == "none":
        scale, weight = ref.unstated_scales(noise)
        each = ((noise.share, np.ones_like(size)), (1 - noise.share, np.median(size) / size))
        return [(chance, scale[:, None] * unit, weight) for chance, unit in each]
    if kind == "shots":
        scale, weight = ref.shot_scales(noise)
        return [(1.0, np.hypot(error / size, scale[:, None]), weight)]
    scale, weight = ref.stated_scales(noise, size, error)
    wrong = 0.5 * (1.0 - weight[0])
    weight[1:] *= 0.5
    scatter, further = ref.lognormal_grid(noise.scatter)
    return [
        (1.0 - wrong, scale[:, None] * error / size, weight / weight.sum()),
        (wrong, np.hypot(error / size, scatter[:, None]), further),
    ]


def brute_probabilities(fit, kind, noise):
    """Of a beam and its rivals, by their evidences written out."""
    p, sizes = fit.x.points, fit.seen.solutions["x"].sizes
    size, error, n = sizes.size, sizes.error, len(sizes.size)
    rows2 = np.stack([p.r11, p.r12], -1)
    rows = np.stack([p.r11**2, 2 * p.r11 * p.r12, p.r12**2], -1)
    turn = ref.coordinates_of(rows2, size)
    spread = rows / (2 * p.model * p.error)[:, None]
    covariance = 8.0 * np.linalg.inv(spread.T @ spread)
    post = fit.seen.solutions["x"].posterior
    log = likelihood(kind, size, error, noise)
    drawn = rows, size, p.known, log, post.best, covariance, turn
    beam = ref.log_evidence_of_beam(*drawn, number=80_000)
    # Noise that is a share of the size would vanish where such a beam does: of the best beam's.
    own = {"share": "stated", "none": "same"}.get(kind, kind)
    log = likelihood(own, size, error * p.model / size if kind == "share" else error, noise)
    flat = ref.log_evidence_of_flat_beam(rows2, size, p.known, log, turn)
    mean = np.exp(np.log(size).mean())
    x, walk = np.log(size / mean), np.minimum.outer(np.arange(n), np.arange(n)) * 1.0
    far = np.abs(np.subtract.outer(*2 * [np.argsort(np.argsort(p.r11 / p.r12))])) / n
    parts, near = [], []
    for chance, deviation, weight in noises(kind, size, error, noise):
        found = [ref.log_evidence_of_constant(size, deviation, weight, noise)]
        for kernel in (np.eye(n), walk):
            steps = [a**2 * kernel for a in AMPLITUDES]
            found.append(ref.log_process(x, steps, deviation, weight, noise))
        bends = [
            a**2 * (1 + far / m) * np.exp(-far / m) for m in CURVE_LENGTHS for a in CURVE_AMPLITUDES
        ]
        curve = ref.log_process(size / mean - 1, bends, deviation * size / mean, weight, noise)
        parts.append(np.array([*found, curve + x.sum()]) + np.log(chance))
        model = p.model / mean
        slopes = spread * (p.error / mean)[:, None] * np.abs(post.best)
        odds = dense_odds(
            size / mean - model, slopes, model, far, deviation * model, np.log(weight)
        )
        near.append(beam + odds + np.log(chance))
    # Rivals of slow noise are those of the first kind of noise.
    first = parts[0] - np.log(noises(kind, size, error, noise)[0][0]) + np.log(noise.slow)
    if kind in ("stated", "share"):
        first = first + np.log(ref.stated_scales(noise, size, error)[1][0])
    parts = [part + np.log(1.0 - noise.slow) for part in parts]
    near = [each + np.log(1.0 - noise.slow) for each in near]
    slow = first[-1]
    curves = ref.log_sum(np.array([*parts, np.append(first[:-1], -np.inf)]), 0)
    curves[-1] = np.logaddexp(
        curves[-1] + np.log(1 - DEPARTURE_SHARE),
        ref.log_sum(np.array(near)) + np.log(DEPARTURE_SHARE),
    )
    curves[-1] = np.logaddexp(curves[-1], slow)
    log = np.array([beam, flat, *curves]) + np.log(list(MODELS.values()))
    return dict(zip(MODELS, np.exp(log - ref.log_sum(log)), strict=True))


CASES = [("beam", kind) for kind in KINDS]
CASES += [("noise", "stated"), ("noise", "share"), ("flat", "shots"), ("tent", "none")]


@pytest.mark.parametrize(("case", "kind"), CASES)
def test_rivals_have_the_evidences_written_out(gtf, scan_of_kind, kind, case):
    """Odds of all six models to a factor 1.3, wherever more than one in a million."""
    scan = scan_of_kind(kind, 5, 0.1)
    currents = scan.settings["Q2"]
    rng = np.random.default_rng(3)
    made = {
        "noise": 1e-4 * rng.uniform(0.5, 2.0, 5),
        "flat": 1e-4 * (1 + 0.05 * rng.normal(size=5)),
        "tent": 1e-4 * (0.3 + np.abs(currents - 1.8)),
    }
    if case in made:
        ratio = made[case] / scan.size["x"]
        shots = {"x": scan.shot_size["x"] * ratio[:, None]} if kind == "shots" else {}
        error = {p: v * ratio for p, v in scan.error.items()}
        scan = replace(scan, size={"x": made[case]}, error=error, shot_size=shots)
    fit = beamfit.fit_emittance(scan, gtf)
    found, expected = fit.x.identifiability.probability, brute_probabilities(fit, kind, Noise())
    assert list(found) == list(expected)
    for name in MODELS:
        if max(found[name], expected[name]) > 1e-6:
            assert np.log(found[name] / expected[name]) == pytest.approx(0.0, abs=0.3), name
