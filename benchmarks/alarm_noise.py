"""False alarms where the usual loss and the noise are learnt from the readings themselves.

`python benchmarks/alarm_noise.py [NOISE ...]`: SIMULATED, 500 mA, ten hours, two thirds of the loss
from a, refilled at 90 %; a reading every 2 s. Of each noise three beams of 40 tell what is usual in
their first two hours, as a watch learns it, and all of them are watched for 7.8 hours.
"""

from __future__ import annotations

import sys

import numpy as np
from scipy.signal import lfilter

from beamfit.lifetime.alarm import Reading, initial_state, watched
from beamfit.lifetime.watch import State, WindowRow, fit_window, learn_reference

A, B, FULL, APART = 3.7e-8, 9.26e-6, 500.0, 2.0
BEAMS, READINGS, LEARNT, SEEDS = 40, 14_000, 3600, 3
SHAPE = READINGS, BEAMS


def white(random):
    return random.normal(size=SHAPE)


def correlated(readings):
    """Noise with the correlation exp(-n/readings)."""

    def made(random):
        kept, new = np.exp(-1 / readings), random.normal(size=SHAPE)
        first = kept * random.normal(size=(1, BEAMS))
        return lfilter([np.sqrt(1 - kept**2)], [1, -kept], new, axis=0, zi=first)[0]

    return made


def power(law):
    """Noise with the spectrum 1/f^law, of unit variance within 600 readings."""

    def made(random):
        size = 1 << int(np.ceil(np.log2(2 * READINGS)))
        frequency = np.fft.rfftfreq(size)
        frequency[0] = frequency[1]
        spectrum = np.fft.rfft(random.normal(size=(size, BEAMS)), axis=0)
        found = np.fft.irfft(spectrum * frequency[:, None] ** (-law / 2), axis=0)[:READINGS]
        parts = found[: 600 * (READINGS // 600)].reshape(-1, 600, BEAMS)
        return found / np.sqrt(np.mean(np.var(parts, axis=1)))

    return made


# µA and kind of each part, and the last digit, µA.
NOISES = {
    "white 2 µA": ([(2.0, white)], 0.0),
    "white 2 µA, digits of 0.1 mA": ([(2.0, white)], 100.0),
    "5 µA over 600 readings": ([(5.0, correlated(600))], 0.0),
    "white 5 µA, 2.5 µA over 300 readings": ([(2.5, correlated(300)), (5.0, white)], 0.0),
    "1/f 5 µA": ([(5.0, power(1.0))], 0.0),
    "1/f 3 µA, white 6 µA": ([(3.0, power(1.0)), (6.0, white)], 0.0),
    "walk 0.9 µA, white 3 µA": ([(0.9, power(2.0)), (3.0, white)], 0.0),
}


def readings(random, parts, digit):
    """Currents as they are read, mA."""
    beam, beams = random.uniform(440, FULL, BEAMS), np.empty(SHAPE)
    for row in beams:
        row[:] = beam
        half = beam * (1 - APART / 2 * (A * beam + B))
        beam = beam - APART * half * (A * half + B)
        beam = np.where(beam < 0.9 * FULL, FULL, beam)
    read = beams + 1e-3 * sum(size * kind(random) for size, kind in parts)
    return 1e-3 * digit * np.round(read / (1e-3 * digit)) if digit else read


def alarms(random, parts, digit):
    """Count the alarms, None where the first beam tells no usual loss."""
    read, time = readings(random, parts, digit), 1.7e9 + APART * np.arange(READINGS)
    unread = State().settings
    pairs = zip(time[:LEARNT], read[:LEARNT, 0], strict=True)
    rows = [WindowRow(0, float(t), float(current), unread) for t, current in pairs]
    known = learn_reference(None, fit_window(rows, "ring"), rows, None)
    if known is None:
        return None
    state, count = initial_state(known.reference, (BEAMS,)), 0
    read[:LEARNT, 0] = np.nan
    for now, row in zip(time, read, strict=True):
        state, told = watched(known.reference, state, Reading(np.full(BEAMS, now), row))
        count += int(told.raised.sum())
    return count


def main() -> None:
    print("noise | references learnt | false alarms")
    for name in sys.argv[1:] or NOISES:
        found = [alarms(np.random.default_rng([seed, 1]), *NOISES[name]) for seed in range(SEEDS)]
        known = [count for count in found if count is not None]
        many = len(known) * BEAMS * READINGS
        print(f"{name} | {len(known)} of {SEEDS} | {sum(known)} in {many:.1e}", flush=True)


if __name__ == "__main__":
    main()
