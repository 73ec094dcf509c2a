"""Cover of emittance against charge, on SIMULATED beams drawn anew, and real LCLS files.

    python -m benchmarks.density --scans 60
    python -m benchmarks.density --files ../shared/data/lcls_gui/*.mat

Four beams: Gaussian; a core with a halo of 10 to 30 % that is 2 to 3 times as wide; a banana; a
hollow one. Each scan has 5 to 7 profiles over 90 to 160 degrees, settings that scatter by a share
drawn from the prior of scans, noise of .3 to 2 % of the peak, backgrounds, gains, centres, and a
window of 3.2 to 7 rms. Counted are the answers given: a share that a cut window leaves open is
none. Refused have to be noise alone, scans that see less than 60 degrees, and scans of which one
profile is of another beam.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from beamfit.density.charge import parts_of, powers_of, rms_beam
from beamfit.density.fit import SHARES, PlaneDensity, fit_density
from beamfit.density.profiles import profile_size
from beamfit.emittance.scan import Profile, QuadScan
from beamfit.errors import InputError
from beamfit.io.emittance_gui import read_emittance_gui
from beamfit.particles import ELECTRON_MASS, beta_gamma

BEAMS = ("gaussian", "core and halo", "banana", "hollow")
REFUSED = ("noise alone", "less than 60 degrees", "one profile of another beam")
ENERGY, EMITTANCE = 135.0, 2e-9
FINE = np.arange(-9.0, 9.01, 0.06)


class Mixture(NamedTuple):
    """Gaussians in the phase space in which the whole has unit rms: weights, means, covariances."""

    weight: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray


def mixture(kind: str, random: np.random.Generator) -> Mixture:
    """A beam of a kind, turned at random."""
    if kind == "core and halo":
        share, wide, skew = random.uniform((0.1, 2.0, -0.4), (0.3, 3.0, 0.4))
        weight, mean = np.array([1.0 - share, share]), np.zeros((2, 2))
        covariance = np.array([np.eye(2), wide**2 * np.array([[1.0, skew], [skew, 1.0]])])
    elif kind == "banana":
        t, bend = np.linspace(-2.5, 2.5, 41), random.uniform(0.2, 0.5)
        weight, mean = np.exp(-0.5 * t**2), np.column_stack([t, bend * (t * t - 1.0)])
        covariance = np.tile(np.diag([0.01, 0.2]), (len(t), 1, 1))
    elif kind == "hollow":
        angle, share = np.arange(36) * np.pi / 18.0, random.uniform(0.6, 0.9)
        weight = np.append(np.full(36, share / 36.0), 1.0 - share)
        mean = 1.3 * np.column_stack([np.cos(angle), np.sin(angle)])
        mean = np.vstack([mean, np.zeros(2)])
        covariance = np.tile(np.eye(2), (37, 1, 1))
        covariance[:36] *= random.uniform(0.4, 0.6) ** 2
    else:
        weight, mean, covariance = np.ones(1), np.zeros((1, 2)), np.eye(2)[None]
    weight = weight / weight.sum()
    c, s = np.cos(turn := random.uniform(0.0, np.pi)), np.sin(turn)
    mean = (mean - weight @ mean) @ np.array([[c, -s], [s, c]]).T
    covariance = np.array([[c, -s], [s, c]]) @ covariance @ np.array([[c, s], [-s, c]])
    whole = np.einsum("k,kij->ij", weight, covariance) + (weight * mean.T) @ mean
    back = np.linalg.inv(np.linalg.cholesky(whole))
    return Mixture(weight, mean @ back.T, back @ covariance @ back.T)


def truth(beam: Mixture) -> np.ndarray:
    """Emittance of each share of the charge over that of all."""
    powers = powers_of(FINE)
    (q, p), density = powers[1:3], np.zeros(len(FINE) ** 2)
    for weight, mean, covariance in zip(*beam, strict=True):
        inverse, (dq, dp) = np.linalg.inv(covariance), (q - mean[0], p - mean[1])
        square = inverse[0, 0] * dq**2 + 2.0 * inverse[0, 1] * dq * dp + inverse[1, 1] * dp**2
        density += weight / np.sqrt(np.linalg.det(covariance)) * np.exp(-0.5 * square)
    return np.array(parts_of(density, powers, rms_beam(density, powers)[0], SHARES)[0])


def simulated(kind: str, random: np.random.Generator) -> tuple[QuadScan, Mixture]:
    """SIMULATE a scan of a beam, as the head of this file says."""
    beam = mixture(kind, random)
    span = random.uniform(20.0, 50.0) if kind == REFUSED[1] else random.uniform(90.0, 160.0)
    count = int(random.integers(5, 8))
    angle = np.radians(np.linspace(-0.5, 0.5, count) * span)
    size = 1e-4 * random.uniform(0.7, 2.5, count)
    direction = np.column_stack([np.cos(angle), np.sin(angle)])
    scatter, noise = np.exp(random.normal(np.log(0.05), 0.7)), random.uniform(0.003, 0.02)
    grown, wrong = random.uniform(0.0, 1.0), int(random.integers(count))
    profiles = []
    for i, (d, s) in enumerate(zip(direction, size, strict=True)):
        window = random.uniform(3.2, 7.0) * s
        x = np.arange(-window, window, max(1.2e-5, window / 100.0))
        here = x / s / (1.0 + scatter * random.normal())
        mean, width = beam.mean @ d, np.einsum("i,kij,j->k", d, beam.covariance, d)
        if kind == REFUSED[2] and i == wrong:
            mean, width = np.array([-0.9, 0.9]), np.full(2, 0.19)
        weight = np.full(2, 0.5) if len(mean) != len(beam.weight) else beam.weight
        seen = np.exp(-0.5 * (here[:, None] - mean) ** 2 / width) / np.sqrt(width)
        counts = seen @ weight
        counts *= 1e4 * random.uniform(0.8, 1.2) / counts.max()
        if kind == REFUSED[0]:
            counts *= 0.0
        rms = np.hypot(1e4 * noise, np.sqrt(grown * noise * 1e3 * counts))
        counts = counts + rms * random.normal(size=len(x)) + 1e4 * random.uniform(-0.01, 0.04)
        profiles.append(Profile("x", i, x + random.uniform(-1e-3, 1e-3), counts, None))
    # Matrices of a line before which β is 5 m.
    along = np.sqrt(EMITTANCE * 5.0), np.sqrt(EMITTANCE / 5.0)
    rows = size[:, None] * direction / along
    shown = np.array([profile_size(p) for p in profiles])
    sizes = {"x": np.where(np.isnan(shown), size, shown)}
    scan = QuadScan({}, {}, sizes, energy=ENERGY, transfer={"x": rows}, profiles=tuple(profiles))
    return scan, beam


def fitted(kind: str, seed: int, number: int) -> tuple[PlaneDensity, np.ndarray]:
    """Density of a simulated scan, and the true emittances of the shares."""
    random = np.random.default_rng([seed, number, (*BEAMS, *REFUSED).index(kind)])
    scan, beam = simulated(kind, random)
    whole = EMITTANCE * beta_gamma(ENERGY, ELECTRON_MASS)
    return fit_density(scan)["x"], whole * truth(beam)


def refused(kind: str, seed: int, number: int) -> bool:
    """True if a simulated scan has no density."""
    try:
        return fitted(kind, seed, number)[0].status.value != "converged"
    except InputError:
        return True


def cover(kind: str, seed: int, scans: int) -> Iterator[str]:
    """A table row for each share of the charge."""
    held = {share: [] for share in SHARES}
    statuses, start = [], time.process_time()
    for number in range(scans):
        plane, true = fitted(kind, seed, number)
        statuses.append(plane.status.value)
        for (_, q), share, at in zip(plane.emittance.items(), SHARES, true, strict=True):
            if q.error is not None:
                low, high = q.interval_95
                near = abs(q.value - at) <= q.error
                held[share].append((near, low <= at <= high, q.value / at, q.error / q.value))
    each = (time.process_time() - start) / scans
    for share, found in held.items():
        if found:
            near, within, ratio, error = np.array(found, float).T
            yield (
                f"| {kind} | {share:.0%} | {len(found)} of {scans} | {near.mean():.0%} | "
                f"{within.mean():.0%} | {np.median(ratio):.3f} | {np.median(error):.1%} | "
                f"{each:.2f} |"
            )


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scans", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--beams", nargs="*", default=BEAMS)
    parser.add_argument("--files", nargs="*", default=())
    told = parser.parse_args()
    if told.files:
        for path in told.files:
            for plane in fit_density(read_emittance_gui(path).scan()).planes:
                print(f"| {path[-28:-4]} | {plane.plane} | {plane.phase:.0f}° | "
                      + " | ".join(map(str, plane.emittance.values())) + " |")  # fmt: skip
        return
    print(f"Seed {told.seed}. SIMULATED.\n")
    print("| beam | charge | answered | 68 % held | 95 % held | median ratio | error | s |")
    print("|---|---|---|---|---|---|---|---|")
    for kind in told.beams:
        for row in cover(kind, told.seed, told.scans):
            print(row, flush=True)
    print()
    for kind in REFUSED:
        found = [refused(kind, told.seed, number) for number in range(told.scans)]
        print(f"- {kind}: {sum(found)} of {told.scans} refused")


if __name__ == "__main__":
    main()
