"""Size measurements until a gun is tuned, beside Xopt's expected improvement and Multipoint-BAX.

    pip install xopt bax-algorithms
    python -m benchmarks.tuning_peers --knobs 2 --seeds 6

The same SIMULATED guns, first rows and noise for all (`benchmarks.guns`). Of each gun and method:
sizes (means of 10 shots) from which on the setting called best stays within 5 % of the true
minimum, up to the most that are measured; "-" where it never does.

- beamfit: `beamfit.fit_tuning` and its next row.
- scans: Xopt's ExpectedImprovementGenerator; each evaluation is a scan of 5 sizes at one setting
  of the knobs, its emittance by `beamfit.fit_emittance`. Best is the lowest mean of its model.
- BAX: Xopt's BaxGenerator with PathwiseMinimizeEmittance of bax-algorithms (S. Miskovich et al.,
  arXiv:2209.04587): a Gaussian process of size² over knobs and quadrupole, Matérn times a
  polynomial of second degree in the quadrupole. Best is the minimum of its mean. 16 paths, each
  searched at 192 settings and at as many about the lowest of them.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from bax_algorithms.emittance import PathwiseMinimizeEmittance
from bax_algorithms.pathwise.optimize import DifferentialEvolution
from bax_algorithms.utils import get_bax_mean_prediction
from gpytorch.kernels import MaternKernel, PolynomialKernel, ProductKernel, ScaleKernel
from pandas import DataFrame
from scipy.stats.qmc import Sobol
from xopt import VOCS
from xopt.generators.bayesian import ExpectedImprovementGenerator
from xopt.generators.bayesian.bax_generator import BaxGenerator
from xopt.generators.bayesian.models.standard import StandardModelConstructor

import beamfit
from beamfit.emittance.scan import QuadScan
from beamfit.tuning.minimum import settings_within
from benchmarks.guns import (
    LIMITS,
    LINE,
    QUADRUPOLE,
    SHOTS,
    Gun,
    emittance_at,
    gun_of,
    measured,
    minimum_of,
    spread_rows,
    tuned,
)

# bax-algorithms 0.1.4 calls this by a name that torch has removed.
torch.cholesky = torch.linalg.cholesky
WITHIN, SCAN, UNIT = 0.05, 5, 1e-4  # sizes of a scan; m
# Energy in eV at which bax-algorithms' kG are 1/m of a thin lens.
ENERGY = 299.792458e5
# Paths of BAX, and settings at which each is searched for its minimum.
PATHS, SETTINGS = 16, 192

Course = Iterator[tuple[int, dict[str, float]]]


def ours(gun: Gun, seed: int, first: int, most: int) -> Course:
    for i, fit in enumerate(tuned(gun, seed, first, most, WITHIN)):
        yield first + i, fit.settings


def scans(gun: Gun, seed: int, first: int, most: int) -> Course:
    """Whole scans at each setting: the first so many that they have as many rows as the others."""
    rng = np.random.default_rng(seed)
    vocs = VOCS(variables=limits_of(gun.names), objectives={"emittance": "MINIMIZE"})
    found: list[dict[str, float]] = []
    generator = ExpectedImprovementGenerator(vocs=vocs)
    low, high = np.array([LIMITS[n] for n in gun.names]).T
    grid = 0.5 * (low + high + settings_within(len(gun.names), 11) * (high - low))
    begin = [
        {n: row[n] for n in gun.names} for row in spread_rows(gun, max(4, first // SCAN), seed)
    ]
    while SCAN * len(found) < most:
        at = begin[len(found)] if len(found) < len(begin) else generator.generate(1)[0]
        at = {n: float(at[n]) for n in gun.names}
        rows = [at | {"Q": float(q)} for q in np.linspace(*QUADRUPOLE, SCAN)]
        table = measured(gun, rows, rng)
        strengths = {"Q": np.array([row["Q"] for row in rows])}
        one = QuadScan(strengths, {"Q": "k1l"}, {"x": table.size}, {"x": table.error}, shots=SHOTS)
        value = beamfit.fit_emittance(one, LINE).planes[0].normalized_emittance.value
        found.append(at | {"emittance": 1e6 * value})
        generator.add_data(DataFrame(found[-1:]))
        if len(found) >= len(begin):
            model = generator.train_model()
            with torch.no_grad():
                mean = model.posterior(torch.tensor(grid)).mean.ravel()
            best = grid[int(torch.argmin(mean))]
            yield SCAN * len(found), dict(zip(gun.names, map(float, best), strict=True))


class EachPath(DifferentialEvolution):
    """The lowest of so many settings for each path by itself, then of as many about it.

    Quicker and lower than bax-algorithms' own search, differential evolution of all paths at once.
    """

    def optimize(self, virtual_objective, sample_functions_list, bounds, n_samples,
                 optimization_indeces=None):  # fmt: skip
        low, high = bounds[:, optimization_indeces]
        cube = Sobol(len(low), rng=0).random(SETTINGS * n_samples).reshape(n_samples, SETTINGS, -1)
        cube, best = torch.tensor(cube), 0.5 * (low + high).repeat(n_samples, 1)
        for width in (1.0, 0.2):
            near = best[:, None] + width * (cube - 0.5) * (high - low)
            at = bounds.mean(dim=0).repeat(n_samples, SETTINGS, 1)
            at[..., optimization_indeces] = torch.clamp(near, low, high)
            value = virtual_objective(sample_functions_list, at, bounds).reshape(n_samples, -1)
            lowest = torch.nan_to_num(value, nan=torch.inf).argmin(dim=1)
            best = at[torch.arange(n_samples), lowest][:, optimization_indeces].detach()
        return best[:, None]


def bax(gun: Gun, seed: int, first: int, most: int) -> Course:
    rng, names = np.random.default_rng(seed), (*gun.names, "Q")
    vocs = VOCS(variables=limits_of(names), observables=["square"])
    quad = len(gun.names)
    kernel = ScaleKernel(
        ProductKernel(
            MaternKernel(active_dims=tuple(range(quad)), ard_num_dims=quad),
            PolynomialKernel(power=2, active_dims=(quad,)),
        )
    )
    search = EachPath()
    algorithm = PathwiseMinimizeEmittance(
        x_key="square", observable_names_ordered=["square"], energy=ENERGY, q_len=1.0,
        rmat_x=[[1.0, 2.0], [0.0, 1.0]], meas_dim=quad, thin_lens=True, use_bmag=False,
        n_samples=PATHS, optimizer=search, n_steps_measurement_param=SCAN,
    )  # fmt: skip
    model = StandardModelConstructor(covar_modules={"square": kernel})
    generator = BaxGenerator(vocs=vocs, gp_constructor=model, algorithm=algorithm)
    rows = spread_rows(gun, first, seed)
    count = 0
    while True:
        sizes = measured(gun, rows, rng).size
        squares = [
            row | {"square": float(s / UNIT) ** 2} for row, s in zip(rows, sizes, strict=True)
        ]
        generator.add_data(DataFrame(squares))
        count += len(rows)
        best = get_bax_mean_prediction(generator, search).ravel()
        yield count, dict(zip(gun.names, map(float, best), strict=True))
        if count >= most:
            return
        rows = [{n: float(row[n]) for n in names} for row in generator.generate(1)]


def limits_of(names: tuple[str, ...]) -> dict[str, list[float]]:
    return {n: list((LIMITS | {"Q": QUADRUPOLE})[n]) for n in names}


METHODS: dict[str, Any] = {"beamfit": ours, "BAX": bax, "scans": scans}


def until(gun: Gun, course: Course) -> tuple[float, float]:
    """Sizes from which on the best setting stays within 5 %, infinite if never; the last excess."""
    least, found = minimum_of(gun)[1], []
    for count, best in course:
        found.append((count, emittance_at(gun, best) / least - 1.0))
    far = [i for i, (_, excess) in enumerate(found) if excess > WITHIN]
    after = far[-1] + 1 if far else 0
    return (found[after][0] if after < len(found) else np.inf), found[-1][1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--knobs", type=int, choices=(2, 4, 6), default=2)
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--most", type=int, default=40, help="most sizes of beamfit and BAX")
    parser.add_argument("--scans", type=int, default=40, help="most scans")
    parser.add_argument("--only", choices=tuple(METHODS), nargs="*", default=list(METHODS))
    told = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    print("seed  method   within 5 % from  last excess  CPU s")
    found: dict[str, list[float]] = {name: [] for name in told.only}
    for seed in range(told.seeds):
        gun = gun_of(told.knobs, seed)
        for name in told.only:
            torch.manual_seed(seed)
            most, begun = SCAN * told.scans if name == "scans" else told.most, time.process_time()
            count, excess = until(gun, METHODS[name](gun, seed, 4 * told.knobs, most))
            found[name].append(count)
            spent = time.process_time() - begun
            print(f"{seed:4d}  {name:8s} {count:15g}  {excess:10.1%}  {spent:5.0f}", flush=True)
    for name, counts in found.items():
        reached = np.isfinite(counts).sum()
        print(f"{name}: median {np.median(counts):g} sizes; {reached} of {len(counts)} guns")


if __name__ == "__main__":
    main()
