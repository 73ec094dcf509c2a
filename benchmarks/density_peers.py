"""Processor time of a density beside gpsr, on the same SIMULATED images of a quadrupole scan.

    pip install gpsr
    python -m benchmarks.density_peers --epochs 500

gpsr (R. Roussel et al., Phys. Rev. Lett. 130, 145001 (2023)) fits a neural network's beam of 10 000
particles to the images, without errors; an ensemble of them would give some. It is trained from
rays of 1 mm for 500 epochs, after which its emittances still grow. beamfit is given the projections
of these images. Emittances are of all charge; the true one is 0.5 µm in both planes.
"""

from __future__ import annotations

import argparse
import time

import lightning
import numpy as np
import torch
from cheetah.accelerator import Screen
from gpsr.beams import NNParticleBeamGenerator
from gpsr.datasets import QuadScanDataset
from gpsr.modeling import GPSR, GPSRQuadScanLattice
from gpsr.train import LitGPSR
from torch.utils.data import DataLoader

import beamfit
from beamfit.density.fit import fit_density
from beamfit.density.profiles import profile_size
from beamfit.emittance.scan import Profile, QuadScan
from beamfit.optics.elements import Drift, Quadrupole
from beamfit.optics.elements import Screen as Monitor

ENERGY, LENGTH, DRIFT, EMITTANCE = 135.0, 0.108, 2.2094, 0.5e-6
K1, PIXELS, PIXEL = np.linspace(-13.0, 13.0, 7), 100, 2.5e-5
BETA, ALPHA = 6.0, 1.6


def images() -> tuple[np.ndarray, beamfit.Beamline]:
    """Images of a round Gaussian beam, shape (n, pixels, pixels)."""
    line = beamfit.Beamline((Quadrupole("Q", LENGTH), Drift("D", DRIFT), Monitor("S")), ENERGY)
    beam = beamfit.BeamMatrix.from_twiss(EMITTANCE / 264.19, BETA, ALPHA)
    x = (np.arange(PIXELS) - 0.5 * (PIXELS - 1)) * PIXEL
    stack = []
    for k1 in K1:
        matrix = line.matrix({"Q": k1})
        size = [float(beam.transport(each).l11) for each in (matrix.x, matrix.y)]
        across, up = (np.exp(-0.5 * (x / s) ** 2) for s in size)
        stack.append(np.outer(up, across))
    return np.array(stack), line


def by_beamfit(stack: np.ndarray, line: beamfit.Beamline) -> tuple[float, str]:
    """Seconds of processor time, compiled, and the emittances."""
    x = np.arange(PIXELS) * PIXEL
    random, profiles = np.random.default_rng(1), []
    for row, image in enumerate(stack):
        for plane, axis in (("x", 0), ("y", 1)):
            counts = image.sum(axis=axis)
            counts = counts + 0.005 * counts.max() * random.normal(size=PIXELS)
            profiles.append(Profile(plane, row, x, counts, None))
    size = {plane: [profile_size(p) for p in profiles if p.plane == plane] for plane in "xy"}
    scan = QuadScan({"Q": K1}, {"Q": "k1"}, size, profiles=tuple(profiles))
    fit_density(scan, line)
    start = time.process_time()
    fit = fit_density(scan, line)
    said = ", ".join(f"{p.plane} {p.emittance['100 %']}" for p in fit)
    return time.process_time() - start, said


def by_gpsr(stack: np.ndarray, epochs: int) -> tuple[float, str]:
    """Seconds of processor time of the training alone, and the emittances."""
    size = torch.tensor([PIXEL, PIXEL])
    screen = Screen(resolution=(PIXELS, PIXELS), pixel_size=size, method="kde", is_active=True,
                    kde_bandwidth=torch.tensor(PIXEL))  # fmt: skip
    parameters = torch.tensor(K1, dtype=torch.float32).unsqueeze(-1)
    data = QuadScanDataset(parameters, (torch.tensor(stack, dtype=torch.float32),), screen)
    beam = NNParticleBeamGenerator(10_000, 1e6 * ENERGY, output_scale=1e-3)
    model = LitGPSR(GPSR(beam, GPSRQuadScanLattice(LENGTH, DRIFT, screen)), lr=1e-2)
    trainer = lightning.Trainer(max_epochs=epochs, logger=False, enable_checkpointing=False,
                                enable_progress_bar=False, accelerator="cpu")  # fmt: skip
    start = time.process_time()
    trainer.fit(model, DataLoader(data, batch_size=len(K1)))
    spent = time.process_time() - start
    found = model.gpsr_model.beam_generator()
    each = [float(getattr(found, f"normalized_emittance_{p}").detach()) * 1e6 for p in "xy"]
    return spent, f"x {each[0]:.3f} µm, y {each[1]:.3f} µm"


def main() -> None:
    """Print both."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--epochs", type=int, default=500)
    epochs = parser.parse_args().epochs
    stack, line = images()
    ours, said = by_beamfit(stack, line)
    print(f"beamfit, two planes: {ours:.2f} s, {said}", flush=True)
    theirs, said = by_gpsr(stack, epochs)
    print(f"gpsr, {epochs} epochs: {theirs:.1f} s, {said}")
    print(f"gpsr over beamfit: {theirs / ours:.0f}")


if __name__ == "__main__":
    main()
