"""False alarms in 1e6 simulated readings, and the delay after a step of 10 % in a or b.

`python benchmarks/alarm.py [READINGS [CASE ...]]`: 500 mA, ten hours, two thirds of the
loss from a, unless a row says otherwise. No reading is given twice: each beam has its own noise.
"""

from __future__ import annotations

import sys
from typing import NamedTuple

import numpy as np

from beamfit.lifetime.alarm import NAMES, Reading, Reference, initial_state, watched
from beamfit.quantity import HOUR

STARTS, BEFORE = 500.0, 1800


class Case(NamedTuple):
    """A ring, its monitor and what befalls it."""

    name: str
    noise: float = 1e-3  # mA
    correlation: float = 0.0  # s
    interval: float = 1.0  # s
    hours: float = 10.0
    share: float = 2 / 3
    refill: float = 0.0  # share of the current at which the ring is filled up
    trouble: bool = False  # gaps, dropouts, spikes, steps of the clock, lost bunches, drift

    @property
    def reference(self) -> Reference:
        """Its usual loss."""
        rate = 1 / (self.hours * HOUR)
        a, b = self.share * rate / STARTS, (1 - self.share) * rate
        return Reference(a, b, self.noise, self.correlation, self.interval)


CASES = (
    Case("1 µA, white"),
    Case("1 µA over 10 s", correlation=10.0),
    Case("2 µA, white", noise=2e-3),
    Case("1 µA, every 10 s", interval=10.0),
    Case("top-up at 99 %", refill=0.99),
    Case("trouble, top-up", refill=0.99, trouble=True),
    Case("trouble, 1 µA over 10 s", correlation=10.0, trouble=True),
    Case("SPEAR3: 18 h, 92 % a", hours=18.4, share=0.92),
    Case("2 h, 50 % a", hours=2.0, share=0.5),
)


def simulated(case: Case, beams: int, readings: int, seed: int, worse=(1.0, 1.0)):
    """Readings of many beams, one time after another; a and b are worse after `BEFORE` s."""
    random = np.random.default_rng(seed)
    usual, clock = case.reference, np.zeros(beams)
    beam = STARTS * random.uniform(0.9, 1.0, beams)
    memory = np.exp(-case.interval / case.correlation) if case.correlation else 0.0
    noise, drift = random.normal(size=beams), np.zeros(beams)
    for number in range(readings):
        time = number * case.interval
        a, b = (v * (w if time >= BEFORE else 1.0) for v, w in zip(usual[:2], worse, strict=True))
        left = case.interval * np.ones(beams)
        if case.trouble:
            gap = random.random(beams) < 1e-4
            left = np.where(gap, random.uniform(100, 4000, beams), left)
            lost = random.random(beams) < 1e-4
            beam = np.where(lost, beam * random.uniform(0.95, 0.999, beams), beam)
            jump = np.where(random.random(beams) < 1e-4, random.normal(0, 100, beams), 0.0)
            clock = clock + jump
            drift = drift + 1e-6 * random.normal(size=beams)  # 0.17 µA in 8 h
        gone = np.exp(-b * left)
        beam = beam * gone / (1 + a / b * beam * (1 - gone))
        beam = np.where(beam < case.refill * STARTS, STARTS, beam)
        clock = clock + left
        noise = memory * noise + np.sqrt(1 - memory**2) * random.normal(size=beams)
        read = beam + case.noise * noise + drift
        if case.trouble:
            read = np.where(random.random(beams) < 1e-4, read + random.normal(0, 5, beams), read)
            read = np.where(random.random(beams) < 1e-3, np.nan, read)
        yield time, clock, read


def told_of(case: Case, beams: int, readings: int, seed: int, worse=(1.0, 1.0)):
    """When each beam's alarms were raised, and what was told of them."""
    state = initial_state(case.reference, (beams,))
    raised, named = [], []
    for time, clock, read in simulated(case, beams, readings, seed, worse):
        state, told = watched(case.reference, state, Reading(clock, read))
        raised += [(time, beam) for beam in np.flatnonzero(told.raised)]
        named += [(time, NAMES[told.moved[beam]], beam) for beam in np.flatnonzero(told.moved)]
    return raised, named


def first(events, beams: int) -> np.ndarray:
    """Delay of the first event after the step in each beam, s; infinite where there is none."""
    found = np.full(beams, np.inf)
    for time, *_, beam in reversed(events):
        if time >= BEFORE:
            found[beam] = time - BEFORE
    return found


def middle(delay: np.ndarray) -> float:
    """Median; infinite where most see nothing within the hour."""
    return np.quantile(delay, 0.5, method="inverted_cdf")


def most(delay: np.ndarray) -> float:
    """95 % are no longer."""
    return np.quantile(delay, 0.95, method="inverted_cdf")


def main() -> None:
    readings = int(float(sys.argv[1])) if len(sys.argv) > 1 else 1_000_000
    print("case | false alarms | a +10 %: raised s (95 %), named min (95 %), right | the same of b")
    wanted = sys.argv[2:] or [case.name for case in CASES]
    for case in CASES:
        if case.name not in wanted:
            continue
        false, _ = told_of(case, readings // 10_000, 10_000, 1)
        row = [case.name, f"{len(false)} in {readings:.0e}"]
        for which, worse in (("a", (1.1, 1.0)), ("b", (1.0, 1.1))):
            beams, steps = 100, int((BEFORE + 3600) / case.interval)
            raised, named = told_of(case, beams, steps, 2, worse)
            delay, known = first(raised, beams), first(named, beams) / 60
            answers = {beam: what for time, what, beam in reversed(named) if time >= BEFORE}
            right = sum(answer == which for answer in answers.values())
            wrong = sum(answer in ("a", "b") for answer in answers.values()) - right
            row.append(
                f"{middle(delay):.0f} ({most(delay):.0f}), "
                f"{middle(known):.1f} ({most(known):.1f}), {right} %, wrong {wrong}"
            )
        print(" | ".join(row), flush=True)


if __name__ == "__main__":
    main()
