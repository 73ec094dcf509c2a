"""SIMULATED families of decays and top-up records: good ones, traps, and what none can show.

Each record is drawn anew; laws and noise are those of benchmarks/decay_families.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy.signal import lfilter

from ..decay_families import FAMILIES, START, Case, Decay, decay, noise_of, pumped, top_up

Draw = Callable[[np.random.Generator], Case]
TOO_SHORT = (2e-4, 2e-3)  # lifetimes in a minute or so


def of(**law) -> Draw:
    """A family of single decays."""
    return lambda random: decay(Decay(**law), random)


def nothing(noise: str) -> Draw:
    """A beam that does not decay, or a monitor that shows none of it: an infinite lifetime."""

    def flat(random, time, current, size):
        return np.full(time.size, START) + size * noise_of(noise, time.size, random)

    def drawn(random: np.random.Generator) -> Case:
        case = decay(Decay(spoil=flat), random)
        return case._replace(law=lambda current: (np.nan, math.inf))

    return drawn


def bursts(random):
    """Three bursts of gas, each of a fortieth of the record."""
    at, height = random.uniform(0.1, 0.9, 3), random.uniform(1.0, 6.0)
    return lambda s: 1 + height * sum(np.exp(-0.5 * ((s - c) / 0.025) ** 2) for c in at)


def voltage(random):
    """The RF voltage changes on the way, a by 10 to 30 %, and nobody wrote it down."""
    when, change = random.uniform(0.3, 0.7), random.uniform(0.1, 0.3) * random.choice([-1, 1])
    return lambda s: np.where(np.asarray(s) < when, 1.0, 1.0 + change)


def spikes(random, time, current, noise):
    """One reading in a hundred is anything."""
    wild = current * random.uniform(0, 1.2, time.size)
    return np.where(random.random(time.size) < 0.01, wild, current)


def zeros(random, time, current, noise):
    return np.where(random.random(time.size) < 0.01, 0.0, current)


def tails(random, time, current, noise):
    return current + noise * random.standard_t(1.5, time.size)


def ramp(random, time, current, noise):
    """Injection at the head of the record."""
    filled = random.uniform(0.03, 0.1) * time[-1]
    return np.where(time < filled, current * (0.6 + 0.4 * time / filled), current)


def dumped(random, time, current, noise):
    end = random.uniform(0.7, 0.95) * time[-1]
    return np.where(time > end, np.abs(noise * random.normal(size=time.size)), current)


def stale(random, time, current, noise):
    """The monitor is read five to ten times as often as it measures."""
    each = int(random.integers(5, 11))
    return np.repeat(current[::each], each)[: time.size]


def digits(random, time, current, noise):
    """Steps of 3 to 30 times the noise."""
    step = noise * 10 ** random.uniform(0.5, 1.5)
    return step * np.round(current / step)


def clipped(random, time, current, noise):
    return np.minimum(current, random.uniform(0.9, 0.98) * current.max())


def walks(random, time, current, noise):
    """The monitor walks by .01 to .3 % of the first current over the record."""
    size = START * 10 ** random.uniform(-4.0, -2.5) / math.sqrt(time.size)
    return current + size * np.cumsum(random.normal(size=time.size))


def drifts(random, time, current, noise):
    """Beneath white noise, as large, drifts that last an eighth of the record."""
    kept = math.exp(-8 / time.size)
    new = random.normal(size=time.size) * math.sqrt(1 - kept**2)
    return current + noise * lfilter([1.0], [1.0, -kept], new)


def offset(random, time, current, noise):
    return current + random.uniform(0.5, 3.0)


def gain(random, time, current, noise):
    return current * (1 + 0.005 * random.choice([-1, 1]) * time / time[-1])


GOOD: dict[str, Draw] = {
    "constant a and b": FAMILIES["constant a and b"],
    "errors stated": FAMILIES["errors stated"],
    "correlated, 0.6-0.98": FAMILIES["correlated, 0.6-0.98"],
    "correlated, errors stated": FAMILIES["correlated, errors stated"],
    "20 to 60 readings": of(readings=(20, 60)),
    "5 000 to 10 000 readings": of(readings=(5000, 10_000)),
    "gas nearly alone": of(share=(0.01, 0.05)),
    "Touschek nearly alone": of(share=(0.95, 0.99)),
    "a third of a lifetime": of(span=(0.2, 0.4)),
    "four lifetimes": of(span=(3.0, 5.0)),
    "a minute, lifetime alone": of(span=TOO_SHORT, level=(-6.0, -5.0), known="τ"),
    "top-up": lambda r: top_up(r, 2.0, 3000),
    "top-up, readings within refills": FAMILIES["top-up, readings within refills"],
    "top-up, shots, the last small": FAMILIES["top-up, shots, the last small"],
}
TRAPS: dict[str, Draw] = {
    "no decay": nothing("white"),
    "no decay, noise correlated": nothing("correlated"),
    "a minute with too much noise": of(span=TOO_SHORT, level=(-4.0, -3.0)),
    "errors stated at a third": of(stated=1 / 3),
    **{name: FAMILIES[name] for name in (
        "a as I^-1/3", "a as I^0.3", "b rises by 10 %", "b falls by 10 %", "1/f",
        "top-up, lifetime wanders", "top-up, loss rate steps", "top-up, monitor walks",
        "archive slower than refills",
    )},
    "vacuum gets better after the fill": of(of_b=pumped),
    "three bursts of gas": of(of_b=bursts, known="a"),
    "RF voltage changed, not logged": of(of_a=voltage, known="τ"),
    "a refill of 0.1-1 %": of(step=(0.001, 0.01)),
    "a loss of 0.3-3 %": of(step=(-0.03, -0.003)),
    "one reading in a hundred is anything": of(spoil=spikes),
    "one reading in a hundred is zero": of(spoil=zeros),
    "heavy tails": of(spoil=tails),
    "injection at the head": of(spoil=ramp),
    "dumped before the end": of(spoil=dumped),
    "each reading five to ten times": of(spoil=stale),
    "digits of 3 to 30 times the noise": of(spoil=digits),
    "monitor ends below the first current": of(spoil=clipped),
    "monitor walks": of(spoil=walks),
    "monitor drifts under white noise": of(spoil=drifts),
}  # fmt: skip
# What no record can show: (family, the cause in beamfit's budget).
HIDDEN: dict[str, tuple[Draw, str]] = {
    "pressure follows the current": (of(follows=0.5), "follows the current"),
    "monitor 0.5-3 mA too high": (of(spoil=offset), "too much"),
    "monitor's gain drifts by 0.5 %": (of(spoil=gain), "drifts"),
}
