"""Posteriors against plain emcee, side by side in one run: python benchmarks/sampling.py

The peer is what one writes first: emcee's stretch move on a scalar log-probability in numpy, 32
walkers from a ball about the same fit. Both are judged by emcee's own autocorrelation time on a
chain without its beginning; compilation is left out of ours and said.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import emcee
import numpy as np
from rich.console import Console
from rich.table import Table

import beamfit
from beamfit.emittance.model import size_squared
from beamfit.lifetime.decay_law import current
from beamfit.lifetime.fit import fit_decay
from beamfit.lifetime.record import DecayRecord
from beamfit.noise.sizes import averaged, log_likelihood
from beamfit.sampling.posterior import Posterior

WALKERS, STEPS, DISCARD, REPEATS = 32, 4000, 500, 3


def plain(
    log_prob: Callable[[np.ndarray], float],
    start: np.ndarray,
    spread: np.ndarray,
    seed: int,
    steps: int = STEPS,
) -> tuple[float, float, np.ndarray]:
    """Effective samples a second of emcee as it comes, its autocorrelation time, its draws."""
    random = np.random.default_rng(seed)
    walkers = start + random.standard_normal((WALKERS, len(start))) @ np.linalg.cholesky(spread).T
    sampler = emcee.EnsembleSampler(WALKERS, len(start), log_prob)
    sampler.random_state = np.random.RandomState(seed).get_state()
    began = time.process_time()
    sampler.run_mcmc(walkers, steps)
    seconds = time.process_time() - began
    longest = float(np.max(sampler.get_autocorr_time(discard=DISCARD, tol=0, quiet=True)))
    effective = (steps - DISCARD) * WALKERS / longest
    return effective / seconds, longest, sampler.get_chain(discard=DISCARD, flat=True)


def ours(sample: Callable[..., Posterior], seed: int) -> tuple[float, float, Posterior]:
    """The same of beamfit, warm-up and judging included."""
    began = time.process_time()
    found = sample(seed=seed, target_ess=40_000)
    seconds = time.process_time() - began
    d = found.diagnostics
    return float(np.min(d.effective)) / seconds, float(np.max(d.autocorrelation)), found


class Case(NamedTuple):
    """A posterior for both: the peer's numbers are ours times `scale`, near 1."""

    name: str
    log_prob: Callable[[np.ndarray], float]
    start: np.ndarray
    spread: np.ndarray
    scale: np.ndarray
    sample: Callable[..., Posterior]


def scan() -> Case:
    """The 14-point scan: σ11, σ12, σ22, the noise averaged over by both."""
    noise = beamfit.Noise()
    measured = beamfit.read_quad_scan("measurements/gtf_simulated.csv")
    fit = beamfit.fit_emittance(measured, beamfit.load_lattice("lattices/gtf.toml"))
    p, post = fit.x.points, fit.seen.works["x"].posterior
    size = p.size[None] / post.unit

    def log_prob(theta: np.ndarray) -> float:
        s11, s12, s22 = theta * 1e-8
        if not (s11 > 0 and s22 > 0 and s11 * s22 > s12 * s12):
            return -math.inf
        squared = size_squared((s11, s12, s22), p.r11, p.r12, p.known)
        model = np.sqrt(squared)[None] / post.unit
        averages = [
            averaged(log_likelihood(size - model, model, kind, s.scale, noise)[0], s.log_weight)
            + kind.log_weight
            for kind, s in zip(post.kinds, post.scales, strict=True)
        ]
        bright = math.log(post.trace @ (theta * 1e-8))
        flat = -2.0 * bright - 0.5 * bright**2 - 0.5 * math.log(s11 * s22 - s12 * s12)
        return float(np.logaddexp.reduce(averages)) + flat

    scale = np.full(3, 1e8)
    start = np.array([q.value for q in fit.x.sigma]) * scale
    return Case("14-point scan", log_prob, start, fit.x.covariance * 1e16, scale, fit.sample)


def decay() -> Case:
    """A simulated 1000-point decay: I0, a, b."""
    time_s = np.linspace(0.0, 8 * 3600.0, 1000)
    noise = 1e-2 * np.random.default_rng(1).normal(size=1000)
    readings = np.array(current(time_s, 500.0, 2e-8, 1e-6)) + noise
    fit = fit_decay(DecayRecord(time_s, readings, np.full(1000, 1e-2)), law="constant")

    def log_prob(theta: np.ndarray) -> float:
        i0, a, b = theta[0], theta[1] * 1e-8, theta[2] * 1e-6
        if not (i0 > 0 and a >= 0 and b > 0):
            return -math.inf
        model = i0 * np.exp(-b * time_s) / (1 + a / b * i0 * -np.expm1(-b * time_s))
        return -0.5 * float(np.sum(((model - readings) / 1e-2) ** 2))

    scale = np.array([1.0, 1e8, 1e6])
    start = np.array([fit.i0.value, fit.a.value, fit.b.value]) * scale
    errors = np.array([fit.i0.error_raw, fit.a.error_raw, fit.b.error_raw]) * scale
    sample = partial(fit.sample, noise="known")
    return Case("1000-point decay", log_prob, start, np.diag(errors**2), scale, sample)


def main() -> None:
    """Print the table."""
    table = Table(title="Effective samples a second, medians of three runs", box=None)
    for name in ("", "plain emcee", "τ, steps", "beamfit", "τ, steps", "ratio", "means differ by"):
        table.add_column(name, justify="right" if name else "left")
    compiling = []
    for name, log_prob, start, spread, scale, sample in (scan(), decay()):
        began = time.process_time()
        ours(sample, 0)
        compiling.append(f"{name} {time.process_time() - began:.1f} s")
        theirs = [plain(log_prob, start, spread, seed) for seed in range(REPEATS)]
        mine = [ours(sample, 1 + seed) for seed in range(REPEATS)]
        peer, own = (float(np.median([run[0] for run in runs])) for runs in (theirs, mine))
        times = (float(np.median([run[1] for run in runs])) for runs in (theirs, mine))
        off = mine[0][2].draws.mean(axis=0) * scale - theirs[0][2].mean(axis=0)
        off = np.max(np.abs(off) / theirs[0][2].std(axis=0))
        first, second = times
        table.add_row(
            name,
            f"{peer:.0f}/s",
            f"{first:.0f}",
            f"{own:.0f}/s",
            f"{second:.1f}",
            f"{own / peer:.1f}",
            f"{off:.3f} sd",
        )
    console = Console()
    console.print(table)
    console.print("First run of each, compilation included: " + ", ".join(compiling))


if __name__ == "__main__":
    main()
