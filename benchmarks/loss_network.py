"""How often the truth lies within the errors of a network of a and b that stands alone.

`python benchmarks/loss_network.py [SHIFTS]`: shifts like measurements/spear3_shift_simulated.csv,
each with its own scales of the mechanisms (25 %), noise and pressure errors; 150 settings in the
box of what was seen, and 150 outside it, in a box a quarter wider.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from beamfit.io.ring import read_operation, read_ring
from beamfit.lifetime.decay_law import current
from beamfit.lifetime.loss_network import Box, NetworkFit, fit_loss_network
from beamfit.lifetime.mechanisms import loss_terms, scaled_losses
from beamfit.lifetime.record import Conditions, DecayRecord
from beamfit.lifetime.ring import Operation
from beamfit.lifetime.study import Decay, Machine, study_record
from beamfit.quantity import HOUR

TOP = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(TOP / "measurements"))
from make_spear3_shift import FILL, NOISE, PRESSURE_ERROR, STEP, settings  # noqa: E402

WITHIN = (1.0, 1.96)
PRESSURES = 1e-9, 1e-5


def shift(seed: int, machine: Machine) -> tuple[list[Decay], Operation, np.ndarray]:
    """SIMULATED: thirty fills; the usual operation and scales they were made with."""
    random = np.random.default_rng(seed)
    scales = np.exp(0.25 * random.normal(size=4))
    usual = machine.operation._replace(pressure_slope=scales[3] * machine.operation.pressure_slope)
    scales[3] = 1.0
    time, decays = np.arange(0.0, FILL, STEP), []
    for number in range(30):
        voltage, scraper, bunches, start = settings(number)
        at = Conditions(1e3 * voltage, 1e-3 * scraper, None, float(bunches))
        said = {n: v for n, v in at._asdict().items() if v is not None}
        a, b = scaled_losses(scales, loss_terms(machine.ring, usual._replace(**said), start))
        beam = np.array(current(time, start, float(a), float(b)))
        pressure = usual.pressure_base + usual.pressure_slope * beam
        columns = {name: np.full(time.size, value) for name, value in said.items()}
        columns["pressure"] = pressure * np.exp(PRESSURE_ERROR * random.normal())
        beam = beam + NOISE * random.normal(size=time.size)
        error = np.full(time.size, NOISE)
        record = DecayRecord(time, beam, error, f"{number}", conditions=Conditions(**columns))
        decays += study_record(record).decays
    return decays, usual, scales


def pulls(
    network: NetworkFit, usual: Operation, scales: np.ndarray, wider: float, seed: int
) -> np.ndarray:
    """Found minus true over the error, of a, b and the lifetime, at settings of a box."""
    random, machine, found = np.random.default_rng(seed), network.machine, []
    low, high = np.array([1.6e6, 2e-3, 70]), np.array([3.2e6, 6e-3, 280])
    middle, half = (low + high) / 2, wider * (high - low) / 2
    while len(found) < 150:
        voltage, scraper, bunches = random.uniform(middle - half, middle + half)
        beam = random.uniform(95.0, 480.0)
        operation = usual._replace(rf_voltage=voltage, scraper_y=scraper, bunches=bunches)
        at = np.array([voltage, scraper, bunches])
        inside = np.all((at >= low) & (at <= high))
        if inside == (wider > 1):
            continue
        a, b = (float(v) for v in scaled_losses(scales, loss_terms(machine.ring, operation, beam)))
        true = a, b, 1 / (a * beam + b) / HOUR
        told = network.predict(operation, beam)
        if any(q.error is None for q in told):
            continue
        found.append([(q.value - t) / q.error for q, t in zip(told, true, strict=True)])
    return np.array(found)


def main() -> None:
    path = TOP / "lattices/spear3_2003.toml"
    machine = Machine(read_ring(path), read_operation(path))
    box = Box((1.2e6, 3.6e6), (1e-3, 7e-3), PRESSURES, (30, 400))
    gathered = {1.0: [], 1.25: []}
    for seed in range(int(sys.argv[1]) if len(sys.argv) > 1 else 8):
        decays, usual, scales = shift(seed, machine)
        network = fit_loss_network(decays, machine, box=box, starts=2, seed=seed)
        print(f"shift {seed}, {network.fit.status}, model error {network.discrepancy.size}")
        for wider, rows in gathered.items():
            rows.append(pulls(network, usual, scales, wider, seed))
            said = [np.mean(np.abs(rows[-1]) < w, axis=0).round(2) for w in WITHIN]
            print(f"  box x {wider}: within 1, 1.96 errors, of a, b, lifetime: {said}", flush=True)
    for wider, rows in gathered.items():
        off = np.abs(np.concatenate(rows))
        print(f"all, box x {wider}: {[np.mean(off < w, axis=0).round(3) for w in WITHIN]}")


if __name__ == "__main__":
    main()
