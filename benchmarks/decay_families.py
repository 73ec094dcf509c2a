"""Lifetimes of families of simulated decays: how often the 95 % interval holds the truth.

Every record is drawn anew: share of a, length, noise and readings, within
the ranges of `decay` and `top_up`. Truths are integrated by scipy, not by the package.

    python benchmarks/decay_families.py --trials 200
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp
from scipy.signal import lfilter
from scipy.stats import beta

from beamfit.errors import InputError
from beamfit.lifetime.fit import DecayFit
from beamfit.lifetime.record import DecayRecord
from beamfit.lifetime.study import study_record
from beamfit.quantity import HOUR, Quantity

LIFETIME, START = 10.0 * HOUR, 300.0


class Case(NamedTuple):
    """A record with its true a, 1/(mA s), and lifetime, h, at a current; NaN is left open."""

    record: DecayRecord
    law: Callable[[float], tuple[float, float]]
    refilled: bool = False

    def truth(self, current: float | None = None) -> tuple[float, float]:
        """a and lifetime, at the mean current if None."""
        return self.law(float(self.record.current.mean()) if current is None else current)


Course = Callable[[np.random.Generator], Callable[[np.ndarray], np.ndarray]]
Spoil = Callable[[np.random.Generator, np.ndarray, np.ndarray, float], np.ndarray]


class Decay(NamedTuple):
    """The law of a family: exponent of a, courses of a and b over the record, noise, monitor.

    A course draws a factor against time in lengths of the record. `spoil` makes of the time, the
    current and its noise what the monitor shows; `known` names the truths that are left.
    """

    exponent: float = 0.0
    of_a: Course | None = None
    of_b: Course | None = None
    follows: float = 0.0  # part of b that goes with the current
    noise: str = "white"
    stated: float | None = None
    spoil: Spoil | None = None
    step: tuple[float, float] | None = None  # of the beam on the way, parts of the first current
    known: str = "aτ"
    share: tuple[float, float] = (0.15, 0.85)
    span: tuple[float, float] = (0.5, 2.0)  # lifetimes
    readings: tuple[int, int] = (100, 1000)
    level: tuple[float, float] = (-3.5, -2.5)  # log10 of the noise over the first current


def run(slope: Callable, start: float, current: float, times: np.ndarray) -> np.ndarray:
    """Currents at some times, of a beam that starts with one."""
    found = solve_ivp(slope, (start, times[-1]), [current], t_eval=times, rtol=1e-10, atol=1e-9)
    return found.y[0]


def drift(change: float) -> Course:
    """A straight line through the middle of the record."""
    return lambda random: lambda s: 1 + change * (s - 0.5)


def pumped(random: np.random.Generator) -> Callable[[np.ndarray], np.ndarray]:
    """The vacuum after a fill gets better: b falls to between a third and a half."""
    fast = random.uniform(2.0, 6.0)
    return lambda s: (1 + np.exp(-fast * s)) / 1.5


def walks(random: np.random.Generator) -> Callable[[np.ndarray], np.ndarray]:
    """A vacuum that goes by a random walk of 2 to 10 % over the record, in waves down to a sixth of
    it.
    """
    turns = np.pi * np.arange(1, 7)
    waves = random.normal(size=6) * random.uniform(0.02, 0.1) * np.sqrt(2) / turns
    return lambda s: 1 + np.cos(np.multiply.outer(s, turns)) @ waves


def settles(
    random: np.random.Generator, time: np.ndarray, shown: np.ndarray, noise: float
) -> np.ndarray:
    """A monitor that reads .02 to .2 % high or low at first, for .01 to .15 of the record."""
    off = random.choice([-1, 1]) * START * 10 ** random.uniform(-3.7, -2.7)
    return shown + off * np.exp(-time / time[-1] / random.uniform(0.01, 0.15))


def waves(
    random: np.random.Generator, time: np.ndarray, shown: np.ndarray, noise: float
) -> np.ndarray:
    """A monitor that goes up and down one to five times, by 1 to 10 times the noise."""
    turned = time / time[-1] * random.uniform(1.0, 5.0) + random.random()
    return shown + noise * random.uniform(1.0, 10.0) * np.sin(2 * np.pi * turned)


def noise_of(kind: str, count: int, random: np.random.Generator) -> np.ndarray:
    """Noise of variance 1."""
    if kind == "white":
        return random.normal(size=count)
    if kind == "correlated":
        kept = random.uniform(0.6, 0.98)
        rows = random.normal(size=count + 1000)
        return lfilter([np.sqrt(1 - kept**2)], [1, -kept], rows)[-count:]
    j = np.arange(1, 4 * count)
    found = np.convolve(random.normal(size=4 * count), np.append(1, np.cumprod((j - 0.5) / j)))
    return found[3 * count : 4 * count] / found[3 * count : 4 * count].std()


def decay(law: Decay, random: np.random.Generator) -> Case:
    """One decay of a family."""
    share, span = random.uniform(*law.share), LIFETIME * random.uniform(*law.span)
    count, noise = int(random.integers(*law.readings)), START * 10 ** random.uniform(*law.level)
    a, b = share / LIFETIME / START, (1 - share) / LIFETIME
    of_a, of_b = ((c or drift(0.0))(random) for c in (law.of_a, law.of_b))
    time = np.linspace(0.0, span, count)

    def losses(t: float, i: float) -> tuple[float, float]:
        gas = b * of_b(t / span) * (1 + law.follows * (i / START - 1))
        return a * of_a(t / span) * (i / START) ** law.exponent, gas

    def slope(t: float, i: np.ndarray) -> np.ndarray:
        own, gas = losses(t, i)
        return -(own * i + gas) * i

    beam = run(slope, 0.0, START, time)
    if law.step is not None:
        later = int(random.uniform(0.3, 0.7) * count)
        stepped = beam[later] + START * random.uniform(*law.step)
        beam = np.append(beam[:later], run(slope, time[later], stepped, time[later:]))
    shown = beam + noise * noise_of(law.noise, count, random)
    shown = shown if law.spoil is None else law.spoil(random, time, shown, noise)
    error = None if law.stated is None else np.full(count, noise * law.stated)

    def truth(current: float) -> tuple[float, float]:
        own, gas = losses(float(np.interp(-current, -beam, time)), current)
        lifetime = 1 / (own * current + gas) / HOUR
        return own if "a" in law.known else np.nan, lifetime if "τ" in law.known else np.nan

    return Case(DecayRecord(time, np.maximum(shown, 0.0), error), truth)


def stored(lifetime: float) -> Callable[[float], tuple[float, float]]:
    """The truth of a record whose lifetime does not hang on the current, s."""
    return lambda current: (np.nan, lifetime / HOUR)


def top_up(
    random: np.random.Generator, interval: float, count: int, within: float = 0.0, shots: int = 1
) -> Case:
    """Top-up, refilled to one current; refills last `within` s, the last of many shots is small."""
    period, noise = random.uniform(120.0, 300.0), START * 10 ** random.uniform(-4.5, -3.8)
    time, parts = np.arange(count) * interval, np.linspace(1.0, 1.0 if shots == 1 else 0.2, shots)
    begins = np.arange(random.uniform(0.3, 1.0) * period, time[-1] + period, period)
    at, level = [0.0], [START]
    for begin in begins:
        lost = START - level[-1] * np.exp(-(begin - at[-1]) / LIFETIME)
        for k, part in enumerate(parts):
            for step in range(1, 11 if within else 2):
                when = begin + within * (k + step / 10) / shots
                before = level[-1] * np.exp(-(when - at[-1]) / LIFETIME)
                at.append(when)
                level.append(before + part / parts.sum() * lost / (10 if within else 1))
    place = np.searchsorted(at, time, side="right") - 1
    beam = np.array(level)[place] * np.exp(-(time - np.array(at)[place]) / LIFETIME)
    record = DecayRecord(time, beam + noise * random.normal(size=count))
    return Case(record, stored(LIFETIME), True)


def changing_top_up(random: np.random.Generator, course: str, walk: float = 0.0) -> Case:
    """Top-up whose lifetime wanders by 1 to 10 %, or steps; the monitor may walk under white
    noise, by so many of its standard deviations in 20 readings. The truth is the mean loss rate.
    """
    time, period = 5.0 * np.arange(6000), random.uniform(120.0, 300.0)
    turned, rate = time / time[-1] * random.uniform(0.3, 3.0) + random.random(), 1 / LIFETIME
    loss = np.full(time.size, rate)
    if course == "wanders":
        loss = rate / (1 + random.uniform(0.01, 0.1) * np.sin(2 * np.pi * turned))
    elif course == "steps":
        for _ in range(random.integers(1, 4)):
            later = time > random.uniform(0.1, 0.9) * time[-1]
            loss = np.where(later, loss * random.uniform(0.85, 1.15), loss)
    lost = np.append(0.0, np.cumsum(5.0 * loss[:-1]))
    cycle = np.floor(time / period)
    beam = START * np.exp(lost[np.searchsorted(cycle, cycle)] - lost)
    noise = random.normal(size=time.size)
    noise += walk / np.sqrt(20) * np.cumsum(random.normal(size=time.size))
    current = beam + START * 10 ** random.uniform(-5.0, -3.9) * noise
    return Case(DecayRecord(time, current), stored(1 / loss.mean()), True)


FAMILIES: dict[str, Callable[[np.random.Generator], Case]] = {
    "constant a and b": lambda r: decay(Decay(), r),
    "errors stated": lambda r: decay(Decay(stated=1.0), r),
    "a as I^-1/3": lambda r: decay(Decay(exponent=-1 / 3), r),
    "a as I^0.3": lambda r: decay(Decay(exponent=0.3), r),
    "b rises by 10 %": lambda r: decay(Decay(of_b=drift(0.1)), r),
    "b falls by 10 %": lambda r: decay(Decay(of_b=drift(-0.1)), r),
    "b walks": lambda r: decay(Decay(of_b=walks), r),
    "gas is pumped away": lambda r: decay(Decay(of_b=pumped), r),
    "correlated, 0.6-0.98": lambda r: decay(Decay(noise="correlated"), r),
    "correlated, errors stated": lambda r: decay(Decay(noise="correlated", stated=1.0), r),
    "1/f": lambda r: decay(Decay(noise="1/f"), r),
    "top-up, 1 s, 1e5 readings": lambda r: top_up(r, 1.0, 100_000),
    "top-up, readings within refills": lambda r: top_up(r, 10.0, 3000, within=4.0),
    "top-up, shots, the last small": lambda r: top_up(r, 2.0, 3000, within=12.0, shots=4),
    "top-up, lifetime wanders": lambda r: changing_top_up(r, "wanders"),
    "top-up, loss rate steps": lambda r: changing_top_up(r, "steps"),
    "top-up, monitor walks": lambda r: changing_top_up(r, "", walk=0.3),
    "top-up, wanders, monitor walks": lambda r: changing_top_up(r, "wanders", walk=0.3),
    "archive slower than refills": lambda r: top_up(r, r.uniform(310.0, 2000.0), 500),
    "monitor settles": lambda r: decay(Decay(spoil=settles, level=(-4.5, -3.2)), r),
    "monitor waves": lambda r: decay(Decay(spoil=waves, level=(-4.5, -3.5)), r),
}


def holds(found: Quantity, truth: float) -> bool | None:
    """Whether the 95 % interval holds the truth; None where nothing is answered."""
    if found.error is None or not np.isfinite(truth):
        return None
    return bool(found.interval_95[0] <= truth <= found.interval_95[1])


def share(found: list[bool | None]) -> str:
    """Percent of the answers that hold the truth, with binomial limits of 95 %, and answered."""
    answers = [one for one in found if one is not None]
    if not answers:
        return "-"
    good, count = sum(answers), len(answers)
    low = beta.ppf(0.025, good, count - good + 1) if good else 0.0
    high = beta.ppf(0.975, good + 1, count - good) if good < count else 1.0
    answered = 100 * count / len(found)
    return f"{100 * good / count:.0f} ({100 * low:.0f}-{100 * high:.0f}) of {answered:.0f}"


def fitted(case: Case, law: str) -> DecayFit | None:
    """The first answer of the record, or None where it is refused."""
    try:
        return study_record(case.record, law=law).answers[0].fit
    except InputError:
        return None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--family", choices=FAMILIES, action="append")
    parser.add_argument("--law", choices=["free", "constant"], default="free")
    chosen = parser.parse_args()
    print("| family | a, % in 95 % of % answered | lifetime | a beyond 4 errors | error of a "
          "| poor_fit |\n|---|---|---|---|---|---|")  # fmt: skip
    for number, name in enumerate(chosen.family or FAMILIES):
        random = np.random.default_rng([number, chosen.trials])
        cases = [FAMILIES[name](random) for _ in range(chosen.trials)]
        pairs = [(case, fit) for case in cases if (fit := fitted(case, chosen.law))]
        true = [(f, *c.truth(f.mean_current)) for c, f in pairs]
        told = [(f.a, a) for f, a, _ in true if f.a.error is not None and np.isfinite(a)]
        far = sum(abs(q.value - a) > 4 * q.error for q, a in told)
        error = np.median([q.error / a for q, a in told]) if told else np.nan
        a = [holds(f.a, a) for f, a, _ in true]
        lifetime = [holds(f.lifetime_mean, hours) for f, _, hours in true]
        poor = sum(f.status in ("poor_fit", "infeasible") for _, f in pairs) / len(cases)
        print(f"| {name} | {share(a)} | {share(lifetime)} | {far} | {100 * error:.0f} % "
              f"| {100 * poor:.0f} % |", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
