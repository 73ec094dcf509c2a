"""How often the truth lies within the errors of a network that corrects first principles.

`python benchmarks/loss_network.py [SHIFTS]`: shifts like measurements/spear3_shift_simulated.csv,
each with its own scales of the mechanisms (25 %), noise, pressure errors, and a Touschek loss that
departs from first principles with the RF voltage, by a parabola of 10 % at the ends of its range;
150 settings in the box of what was seen, and 150 outside it, in a box a quarter wider.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

from beamfit.io.ring import read_operation, read_ring
from beamfit.lifetime.decay_law import current
from beamfit.lifetime.loss_network import Box, NetworkFit, fit_loss_network
from beamfit.lifetime.mechanisms import loss_terms, scaled_losses
from beamfit.lifetime.record import Conditions, DecayRecord
from beamfit.lifetime.ring import Operation, Ring
from beamfit.lifetime.scales import ScaleFit, fit_scales
from beamfit.lifetime.study import Decay, Machine, study_record
from beamfit.quantity import HOUR

TOP = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(TOP / "measurements"))
from make_spear3_shift import FILL, NOISE, PRESSURE_ERROR, STEP, settings  # noqa: E402

WITHIN = (1.0, 1.96)
PRESSURES = 1e-9, 1e-5


class Truth(NamedTuple):
    """SIMULATED: a ring at its usual settings, scales, and how Touschek departs by the voltage."""

    ring: Ring
    usual: Operation
    scales: np.ndarray
    departs: np.ndarray

    @classmethod
    def drawn(cls, seed: int, machine: Machine) -> Truth:
        random = np.random.default_rng(seed)
        scales = np.exp(0.25 * random.normal(size=4))
        rises = scales[3] * machine.operation.pressure_slope
        usual = machine.operation._replace(pressure_slope=rises)
        scales[3] = 1.0
        return cls(machine.ring, usual, scales, 0.1 * random.normal(size=2))

    def losses(self, operation: Operation, beam: float) -> tuple[float, float]:
        """a and b."""
        terms = loss_terms(self.ring, operation, beam)
        away = (operation.rf_voltage - 2.4e6) / 0.8e6
        scales = np.append(np.exp(self.departs @ [away, away**2]), [1.0, 1.0, 1.0]) * self.scales
        a, b = scaled_losses(scales, terms)
        return float(a), float(b)


def shift(truth: Truth, seed: int) -> list[Decay]:
    """Thirty fills."""
    random, decays = np.random.default_rng(1000 + seed), []
    time = np.arange(0.0, FILL, STEP)
    for number in range(30):
        voltage, scraper, bunches, start = settings(number)
        said = {"rf_voltage": 1e3 * voltage, "scraper_y": 1e-3 * scraper, "bunches": bunches}
        operation = truth.usual._replace(**{n: float(v) for n, v in said.items()})
        beam = np.array(current(time, start, *truth.losses(operation, start)))
        pressure = operation.pressure_base + operation.pressure_slope * beam
        columns = {name: np.full(time.size, float(value)) for name, value in said.items()}
        columns["pressure"] = pressure * np.exp(PRESSURE_ERROR * random.normal())
        beam = beam + NOISE * random.normal(size=time.size)
        error = np.full(time.size, NOISE)
        record = DecayRecord(time, beam, error, f"{number}", conditions=Conditions(**columns))
        decays += study_record(record).decays
    return decays


def pulls(
    network: NetworkFit | ScaleFit, truth: Truth, wider: float, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Found minus true over the error, and over the truth, of a, b and the lifetime, at settings
    of a box.
    """
    random, found = np.random.default_rng(seed), []
    low, high = np.array([1.6e6, 2e-3, 70]), np.array([3.2e6, 6e-3, 280])
    middle, half = (low + high) / 2, wider * (high - low) / 2
    while len(found) < 150:
        at = random.uniform(middle - half, middle + half)
        beam = random.uniform(95.0, 480.0)
        inside = np.all((at >= low) & (at <= high))
        if inside == (wider > 1):
            continue
        named = dict(zip(("rf_voltage", "scraper_y", "bunches"), map(float, at), strict=True))
        operation = truth.usual._replace(**named)
        a, b = truth.losses(operation, beam)
        true = a, b, 1 / (a * beam + b) / HOUR
        told = network.predict(as_filed(operation, network.usual, beam), beam)
        if any(q.error is None for q in told):
            continue
        pairs = list(zip(told, true, strict=True))
        found.append(
            [[(q.value - t) / q.error for q, t in pairs], [q.value / t - 1 for q, t in pairs]]
        )
    return np.moveaxis(np.array(found), 1, 0)


def as_filed(operation: Operation, filed: Operation, beam: float) -> Operation:
    """The same pressure by a ring file's own P1/P0, which a scale is on."""
    here, there = (o.pressure_base + o.pressure_slope * beam for o in (operation, filed))
    share = here / there
    return operation._replace(
        pressure_base=share * filed.pressure_base, pressure_slope=share * filed.pressure_slope
    )


def main() -> None:
    path = TOP / "lattices/spear3_2003.toml"
    machine = Machine(read_ring(path), read_operation(path))
    box = Box((1.2e6, 3.6e6), (1e-3, 7e-3), PRESSURES, (30, 400))
    gathered = {1.0: [], 1.25: []}
    for seed in range(int(sys.argv[1]) if len(sys.argv) > 1 else 8):
        truth = Truth.drawn(seed, machine)
        decays = shift(truth, seed)
        scales = fit_scales(decays, machine)
        network = fit_loss_network(decays, scales, box=box, starts=2, seed=seed)
        print(
            f"shift {seed}, scales {scales.status}, network {network.fit.status}, "
            f"model error {network.discrepancy.size}"
        )
        for wider, rows in gathered.items():
            rows.append(pulls(network, truth, wider, seed))
            off, relative = rows[-1]
            said = [np.mean(np.abs(off) < w, axis=0).round(2) for w in WITHIN]
            rms = np.sqrt(np.mean(relative**2, axis=0)).round(4)
            print(
                f"  box x {wider}: within 1, 1.96 errors, of a, b, lifetime: {said}; rms {rms}",
                flush=True,
            )
    for wider, rows in gathered.items():
        off, relative = np.concatenate(rows, axis=1)
        said = [np.mean(np.abs(off) < w, axis=0).round(3) for w in WITHIN]
        print(f"all, box x {wider}: {said}; rms {np.sqrt(np.mean(relative**2, axis=0)).round(4)}")


if __name__ == "__main__":
    main()
