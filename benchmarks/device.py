"""The vectorised parts on the processor and on the first other device of JAX, one after the other.

    python -m benchmarks.device

Wall time of a warm call, the median of several, and the largest difference of the results over the
largest result. Written to docs/python.md; without a GPU only the processor is timed.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax
import numpy as np
from rich.console import Console
from rich.table import Table

import beamfit
from beamfit import fit_sizes
from beamfit.greybox.bounds import over_cells
from beamfit.greybox.mlp import dense
from beamfit.io.ring import read_ring
from beamfit.lifetime.mechanisms import piwinski_rate
from beamfit.sampling.posterior import Posterior

REPEATS = 5


def works() -> Iterator[tuple[str, Callable[[], Any]]]:
    """Work by name, on the default device of the moment."""
    k = np.linspace(-1.0, 1.0, 9)
    for count in (1000, 100_000):
        noise = 1 + 0.02 * np.random.default_rng(1).normal(size=(count, 9))
        size = 1e-4 * np.sqrt(1 + 8 * k**2) * noise
        scans = jax.jit(fit_sizes)
        yield f"{count} scans of 9 sizes", partial(scans, k, np.full(9, 2.0), size, 0.02 * size)
    ring = read_ring("lattices/spear3_2003.toml")
    rates = jax.jit(jax.vmap(lambda at: piwinski_rate(ring, 1e10, 5e-3, at)))
    for count in (100, 3000):
        acceptances = np.linspace(0.01, 0.04, count)
        yield f"Touschek loss at {count} acceptances", partial(rates, acceptances)
    line = beamfit.load_lattice("lattices/lcls_otr2.toml")
    through = jax.jit(jax.vmap(lambda kg: line.matrix({"Q525": kg}).x))
    settings = np.linspace(-6.0, 0.0, 1_000_000)
    yield "transfer matrices of 1000000 settings", partial(through, settings)
    net = dense(["u"], ["y", "z"], hidden=(8,))
    yield (
        "gains of a network bounded in 20000 cells",
        partial(over_cells, net, [0.0], [1.0], 20_000),
    )
    scan = beamfit.read_quad_scan("measurements/gtf_simulated.csv")
    gtf = beamfit.load_lattice("lattices/gtf.toml")
    yield "a scan", partial(beamfit.fit_emittance, scan, gtf)
    fit = beamfit.fit_emittance(scan, gtf)
    yield "20000 draws of its posterior", partial(fit.sample, seed=1, target_ess=20_000)
    network = partial(beamfit.fit_emittance, scan, gtf, scenario="transport-network")
    yield "a transport network", network


def leaves(found: Any) -> list[np.ndarray]:
    """The numbers of a result."""
    if isinstance(found, beamfit.EmittanceFit):
        return [np.array(plane.emittance.value) for plane in found.planes]
    if isinstance(found, Posterior):
        return [np.array(np.std(found.values("x.emittance")))]
    return [np.asarray(leaf) for leaf in jax.tree.leaves(found)]


def timed(device: jax.Device) -> dict[str, tuple[float, list[np.ndarray]]]:
    """Seconds and results of each work on a device."""
    found = {}
    with jax.default_device(device):
        for name, work in works():
            seconds = []
            for _ in range(REPEATS + 1):  # the first compiles
                began = time.perf_counter()
                result = jax.block_until_ready(work())
                seconds.append(time.perf_counter() - began)
            found[name] = float(np.median(seconds[1:])), leaves(result)
            print(f"{device.device_kind}: {name}: {found[name][0]:.4g} s", flush=True)
    return found


def apart(one: list[np.ndarray], other: list[np.ndarray]) -> float:
    """Largest difference of two results over the largest value of each array."""
    sizes = (np.nanmax(np.abs(a)) or 1.0 for a in one)
    pairs = zip(one, other, sizes, strict=True)
    return max(float(np.nanmax(np.abs(1.0 * a - b)) / size) for a, b, size in pairs)


def main() -> None:
    """Print one table."""
    devices = [jax.devices("cpu")[0]]
    devices += [d for d in jax.devices() if d.platform != "cpu"][:1]
    found = [timed(device) for device in devices]
    table = Table("work", *(f"{d.device_kind}, ms" for d in devices), "ratio", "apart")
    for name, (seconds, result) in found[0].items():
        row = [name, *(f"{1e3 * each[name][0]:.3g}" for each in found)]
        for each in found[1:]:
            row += [f"{seconds / each[name][0]:.3g}", f"{apart(result, each[name][1]):.1e}"]
        table.add_row(*row)
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
