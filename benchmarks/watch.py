"""A week of a stored beam at a reading a second through the core of `beamfit watch`.

`python benchmarks/watch.py [DAYS]`: SIMULATED, 500 mA, ten hours, two thirds of the loss from a, 2
µA of noise; refilled every four hours, in the second half below 480 mA. Gaps, steps of the clock,
IOC restarts (two minutes of silence, then an old time stamp), readings without a number, dropouts
and repeated time stamps at random. Nothing else happens: every alarm is false. CPU time, one core.
Then the watch as it stood before the top-up is followed again, twice, with a loss that steps.
"""

from __future__ import annotations

import resource
import sys
import time

import numpy as np

from beamfit.lifetime.watch import CURRENT, Plan, State, stepped
from beamfit.quantity import HOUR

A, B, FULL, NOISE = 3.7e-8, 9.26e-6, 500.0, 2e-3
DAY = 24 * HOUR


STEP = 1.15


def beam_after(beam, seconds, a=A, b=B):
    gone = np.exp(-b * seconds)
    return beam * gone / (1 + a / b * beam * (1 - gone))


def named_after(plan, state, a, b):
    """Name of what moved, and the minutes after which it was told, where the loss steps now."""
    beam, begun, random = FULL, state.last - state.shift + 1, np.random.default_rng(17)
    for second in range(int(4 * HOUR)):
        beam = float(beam_after(beam, 1.0, a, b))
        state = stepped(plan, state, CURRENT, begun + second, beam + NOISE * random.normal())
        if state.alarms:
            return f"{state.alarms[-1].moved} after {second / 60:.0f} min"
    return "nothing"


def readings(days, random):
    """Time stamp and current, as an archive's monitor would give them."""
    beam, clock, silent, shown = FULL, 1.7e9, 0.0, 0.0
    for second in range(int(days * DAY)):
        beam = float(beam_after(beam, 1.0))
        topped = second > days * DAY / 2
        if second % (4 * HOUR) == 0 or (topped and beam < 480):
            beam = FULL
        chance = random.random()
        if silent > 0:
            silent -= 1
            continue
        if chance < 2e-5:
            silent = random.uniform(100, 4000)
        elif chance < 4e-5:
            clock += random.normal(0, 200)
        elif chance < 5e-5:
            silent = 120.0
            yield shown, beam
        shown = clock + second
        value = beam + NOISE * random.normal()
        value = float("nan") if 0.1 < chance < 0.101 else 0.0 if 0.2 < chance < 0.2003 else value
        yield shown, value
        if 0.3 < chance < 0.301:
            yield shown, value


def memory():
    """Now and at most, MB."""
    with open("/proc/self/statm") as stream:
        pages = int(stream.read().split()[1])
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return pages * resource.getpagesize() / 2**20, most


def main() -> None:
    days = float(sys.argv[1]) if len(sys.argv) > 1 else 7.0
    plan, state, before = Plan(window=2 * HOUR, every=900.0), State(), None
    pulls, fits, total, count, alarms, open_ones = [], 0.0, 0.0, 0, 0, 0
    hour, middle, half_way = 0, None, int(0.45 * days * DAY)
    for stamp, value in readings(days, np.random.default_rng(16)):
        begun = time.process_time()
        state = stepped(plan, state, CURRENT, stamp, value)
        spent = time.process_time() - begun
        total, count = total + spent, count + 1
        middle = state if count == half_way else middle
        raised = sum("alarm: the loss moved" in text for _, text in state.events)
        alarms = max(alarms, raised) if raised else alarms
        if state.answer is not before:
            before, fits = state.answer, fits + spent
            if (found := before.lifetime) is None:
                open_ones += 1
            else:
                truth = 1 / (A * before.window.fit.mean_current + B) / HOUR
                pulls.append((found.value - truth) / found.error)
        if count // 21600 > hour:
            hour = count // 21600
            now, most = memory()
            half = np.array(pulls)
            print(
                f"{count} readings: {now:.0f} MB now, {most:.0f} at most, {len(state.rows)} rows; "
                f"{len(pulls)} lifetimes, pull {half.mean():+.2f} ± {half.std(ddof=1):.2f}, "
                f"{open_ones} open; {alarms} alarms; {state.counts}; "
                f"{1e3 * (total - fits) / count:.2f} ms a reading, "
                f"{1e3 * fits / (len(pulls) + open_ones):.0f} ms a fit",
                flush=True,
            )
    quarters = np.array_split(np.array(pulls), 4)
    print("pulls by quarter:", ", ".join(f"{q.mean():+.2f} ± {q.std():.2f}" for q in quarters))
    print(f"beyond 3: {np.mean(np.abs(pulls) > 3):.1%}, worst {np.max(np.abs(pulls)):.1f}")
    for name, a, b in (("a", STEP * A, B), ("b", A, STEP * B)):
        print(f"{name} times {STEP}: {named_after(plan, middle, a, b)}")


if __name__ == "__main__":
    main()
