"""Posteriors against plain emcee, side by side in one run: python benchmarks/sampling.py

The peer is what one writes first: emcee's stretch move on a scalar log-probability in numpy, 32
walkers from a ball about the same fit. Both are judged by emcee's own autocorrelation time on a
chain without its beginning; compilation is left out of ours and said.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import emcee
import jax
import jax.numpy as jnp
import numpy as np
from emcee.autocorr import integrated_time
from rich.console import Console
from rich.table import Table

import beamfit
from beamfit.emittance.model import size_squared
from beamfit.lifetime.decay_law import current
from beamfit.lifetime.fit import fit_decay
from beamfit.lifetime.record import DecayRecord
from beamfit.noise.sizes import log_average, log_likelihood
from beamfit.sampling.posterior import Posterior

WALKERS, STEPS, DISCARD, REPEATS = 32, 4000, 500, 3


def plain(
    log_prob: Callable[[np.ndarray], np.ndarray],
    start: np.ndarray,
    spread: np.ndarray,
    seed: int,
    steps: int = STEPS,
    walkers: int = WALKERS,
    **options,
) -> tuple[float, float, np.ndarray]:
    """Effective samples a second of emcee, its autocorrelation time, its draws."""
    random = np.random.default_rng(seed)
    begin = start + random.standard_normal((walkers, len(start))) @ np.linalg.cholesky(spread).T
    sampler = emcee.EnsembleSampler(walkers, len(start), log_prob, **options)
    sampler.random_state = np.random.RandomState(seed).get_state()
    began = time.process_time()
    sampler.run_mcmc(begin, steps)
    seconds = time.process_time() - began
    longest = float(np.max(sampler.get_autocorr_time(discard=DISCARD, tol=0, quiet=True)))
    effective = (steps - DISCARD) * walkers / longest
    return effective / seconds, longest, sampler.get_chain(discard=DISCARD, flat=True)


def compiled(case: Case, steps: int = STEPS) -> Callable[[int], tuple[float, float, np.ndarray]]:
    """As `plain`, of blackjax's NUTS in one compiled loop: whitened, its step adapted before."""
    import blackjax

    root = np.linalg.cholesky(case.spread)

    def log_density(z: jax.Array) -> jax.Array:
        return case.log_prob((case.start + root @ z)[None])[0]

    adapted = blackjax.window_adaptation(blackjax.nuts, log_density, is_mass_matrix_diagonal=False)
    (state, told), _ = adapted.run(jax.random.key(0), jnp.zeros(len(root)), 1000)
    nuts = blackjax.nuts(log_density, **told)

    @jax.jit
    def chain(key: jax.Array) -> jax.Array:
        def on(at, key):
            at, _ = nuts.step(key, at)
            return at, at.position

        return jax.lax.scan(on, state, jax.random.split(key, steps))[1]

    jax.block_until_ready(chain(jax.random.key(1)))

    def run(seed: int) -> tuple[float, float, np.ndarray]:
        began = time.process_time()
        draws = np.asarray(chain(jax.random.key(seed)))
        seconds = time.process_time() - began
        longest = float(np.max(integrated_time(draws[:, None], tol=0, quiet=True)))
        return steps / longest / seconds, longest, case.start + draws @ root.T

    return run


def ours(sample: Callable[..., Posterior], seed: int) -> tuple[float, float, Posterior]:
    """The same of beamfit, warm-up and judging included."""
    began = time.process_time()
    found = sample(seed=seed, target_ess=40_000)
    seconds = time.process_time() - began
    d = found.diagnostics
    return float(np.min(d.effective)) / seconds, float(np.max(d.autocorrelation)), found


class Case(NamedTuple):
    """A posterior for all: the peers' numbers are ours times `scale`, near 1.

    `log_prob` takes many, shape (w, 3), as NumPy's or JAX's arrays.
    """

    name: str
    log_prob: Callable[[np.ndarray], np.ndarray]
    start: np.ndarray
    spread: np.ndarray
    scale: np.ndarray
    sample: Callable[..., Posterior]


def scan() -> Case:
    """The 14-point scan: σ11, σ12, σ22, the noise averaged over by both."""
    noise = beamfit.Noise()
    measured = beamfit.read_quad_scan("measurements/gtf_simulated.csv")
    fit = beamfit.fit_emittance(measured, beamfit.load_lattice("lattices/gtf.toml"))
    p, post = fit.x.points, fit.seen.solutions["x"].posterior
    size = p.size / post.unit
    kinds = tuple(zip(post.kinds, post.scales, strict=True))

    def log_prob(theta: np.ndarray) -> np.ndarray:
        xp = theta.__array_namespace__()
        s11, s12, s22 = xp.moveaxis(theta * 1e-8, -1, 0)[..., None]
        left = s11 * s22 - s12 * s12
        beam = (s11 > 0) & (s22 > 0) & (left > 0)
        # A gradient needs numbers on both sides of a bound.
        s11, s12, s22 = (xp.where(beam, s, t) for s, t in zip((s11, s12, s22), best, strict=True))
        model = xp.sqrt(size_squared((s11, s12, s22), p.r11, p.r12, p.known)) / post.unit
        averages = [
            log_average(log_likelihood(size - model, model, kind, s.scale, noise), s.log_weight)
            + kind.log_weight
            for kind, s in kinds
        ]
        bright = xp.log(sum(t * s for t, s in zip(post.trace, (s11, s12, s22), strict=True)))
        flat = -2.0 * bright - 0.5 * bright**2 - 0.5 * xp.log(s11 * s22 - s12 * s12)
        whole = log_average(xp.stack(averages, -1), 0.0) + flat[:, 0]
        return xp.where(beam[:, 0], whole, -xp.inf)

    best = [q.value for q in fit.x.sigma]
    scale = np.full(3, 1e8)
    start = np.array([q.value for q in fit.x.sigma]) * scale
    return Case("14-point scan", log_prob, start, fit.x.covariance * 1e16, scale, fit.sample)


def decay() -> Case:
    """A simulated 1000-point decay: I0, a, b."""
    time_s = np.linspace(0.0, 8 * 3600.0, 1000)
    noise = 1e-2 * np.random.default_rng(1).normal(size=1000)
    readings = np.array(current(time_s, 500.0, 2e-8, 1e-6)) + noise
    fit = fit_decay(DecayRecord(time_s, readings, np.full(1000, 1e-2)), law="constant")

    def log_prob(theta: np.ndarray) -> np.ndarray:
        xp = theta.__array_namespace__()
        i0, a, b = xp.moveaxis(theta * np.array([1.0, 1e-8, 1e-6]), -1, 0)[..., None]
        beam = (i0 > 0) & (a >= 0) & (b > 0)
        a, b = xp.where(beam, a, 2e-8), xp.where(beam, b, 1e-6)
        model = i0 * xp.exp(-b * time_s) / (1 + a / b * i0 * -xp.expm1(-b * time_s))
        whole = -0.5 * xp.sum(((model - readings) / 1e-2) ** 2, axis=-1)
        return xp.where(beam[:, 0], whole, -xp.inf)

    scale = np.array([1.0, 1e8, 1e6])
    start = np.array([fit.i0.value, fit.a.value, fit.b.value]) * scale
    errors = np.array([fit.i0.error_raw, fit.a.error_raw, fit.b.error_raw]) * scale
    return Case("1000-point decay", log_prob, start, np.diag(errors**2), scale, fit.sample)


def alone(log_prob: Callable[[np.ndarray], np.ndarray], theta: np.ndarray) -> float:
    """The same of one set of numbers, as emcee asks where it is not told that many go at once."""
    return float(log_prob(theta[None])[0])


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
        one = partial(alone, log_prob)
        theirs = [plain(one, start, spread, seed) for seed in range(REPEATS)]
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
