"""SIMULATED decays of a stored beam: good ones, traps, and what no record can show.

dI/dt = -(a(I) I + b(t)) I, integrated by scipy where it has no closed form. Currents in mA, times
in s. The truth is what a and b are; a trap without constant a and b leaves open what it cannot say.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache, partial
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp
from scipy.signal import lfilter

HOUR = 3600.0
Spoil = Callable[[np.random.Generator, np.ndarray, np.ndarray], np.ndarray]


class Decay(NamedTuple):
    """One record, and what is true of a, 1/(mA s), and b, 1/s."""

    time: np.ndarray
    current: np.ndarray
    error: np.ndarray | None
    a: float | None
    b: float | None
    lasting: bool = True  # whether 1/(a I + b) is the lifetime at a current I

    def truth(self, name: str, mean_current: float) -> float | None:
        """Of "a", "b" or "lifetime" in s; None where there is none."""
        if name == "lifetime":
            if not self.lasting:
                return None
            rate = self.a * mean_current + self.b
            return 1 / rate if rate > 0 else math.inf
        return {"a": self.a, "b": self.b}[name]


def closed(time, i0, a, b):
    """Report equation 44."""
    gone = -np.expm1(-b * time)
    return i0 * np.exp(-b * time) / (1 + i0 * a * (gone / b if b > 0 else time))


@cache
def integrated(law: Callable, i0: float, span: float, n: int) -> np.ndarray:
    """Currents of dI/dt = -law(I, t) I."""
    found = solve_ivp(
        lambda t, i: -law(i, t) * i, (0, span), [i0], "LSODA",
        np.linspace(0, span, n), rtol=1e-10, atol=1e-12,
    )  # fmt: skip
    return found.y[0]


def decay(
    rng: np.random.Generator,
    i0: float = 200.0,
    a: float = 5e-8,
    b: float = 5e-6,
    span: float = 6 * HOUR,
    n: int = 400,
    noise: float = 0.01,
    memory: float = 0.0,
    stated: float | None = None,
    law: Callable | None = None,
    spoil: Spoil | None = None,
    know: str = "abτ",
) -> Decay:
    """A decay with noise in mA that is autoregressive of first order with `memory`.

    The file says `stated` times the noise, or nothing. `spoil` changes what the monitor shows;
    `know` names what of a, b and τ still has a truth.
    """
    time = np.linspace(0, span, n)
    beam = closed(time, i0, a, b) if law is None else integrated(law, i0, span, n)
    fresh = np.sqrt(1 - memory**2) * rng.normal(size=n + 400)
    beam = beam + noise * lfilter([1.0], [1.0, -memory], fresh)[400:]
    shown = beam if spoil is None else spoil(rng, time, beam)
    error = None if stated is None else np.full(n, stated * noise)
    return Decay(
        time, np.maximum(shown, 0), error, a if "a" in know else None, b if "b" in know else None,
        "τ" in know,
    )  # fmt: skip


def pump_down(i, t):
    """The vacuum after a fill gets better: b falls to half within two hours."""
    return 5e-8 * i + 2.5e-6 * (1 + np.exp(-t / 7200))


def rising(i, t):
    return 5e-8 * i + 5e-6 * (1 + t / (6 * HOUR))


def lengthened(i, t):
    """Bunches lengthen with current: a falls as I^-0.3."""
    return 5e-8 * (i / 150) ** -0.3 * i + 5e-6


def voltage(i, t):
    """The RF voltage changes half-way, a by 30 %, and nobody wrote it down."""
    return 5e-8 * np.where(t < 3 * HOUR, 1, 1.3) * i + 5e-6


def bursts(i, t):
    """Three bursts of gas, ten minutes each."""
    return 5e-8 * i + 5e-6 * (
        1 + 6 * sum(np.exp(-0.5 * ((t / HOUR - c) / 0.1) ** 2) for c in (1, 2.5, 4))
    )


def stepped(rng: np.random.Generator, change: float, i0=200.0, a=5e-8, b=5e-6, n=400) -> Decay:
    """A refill (or a loss) of `change` mA in the middle of six hours, then the same law."""
    time = np.linspace(0, 6 * HOUR, n)
    when = time[-1] * rng.uniform(0.3, 0.7)
    again = closed(np.maximum(time - when, 0), closed(when, i0, a, b) + change, a, b)
    beam = np.where(time < when, closed(time, i0, a, b), again) + 0.01 * rng.normal(size=n)
    return Decay(time, beam, None, a, b)


def spikes(rng, t, i):
    """One reading in a hundred is anything."""
    return np.where(rng.uniform(size=len(i)) < 0.01, i * rng.uniform(0, 1.2, len(i)), i)


def zeros(rng, t, i):
    return np.where(rng.uniform(size=len(i)) < 0.01, 0.0, i)


def tails(rng, t, i):
    return i + 0.01 * rng.standard_t(1.5, len(i))


def ramp(rng, t, i):
    """Injection at the head of the record."""
    return np.where(t < 0.08 * t[-1], i * (0.6 + 0.4 * t / (0.08 * t[-1])), i)


def dumped(rng, t, i):
    return np.where(t > 0.85 * t[-1], np.abs(0.01 * rng.normal(size=len(i))), i)


def stale(rng, t, i):
    """The monitor is read ten times as often as it measures."""
    return np.repeat(i[::10], 10)[: len(i)]


def coarse(rng, t, i):
    return 2.0 * np.round(i / 2.0)


def clipped(rng, t, i):
    return np.minimum(i, 0.95 * i.max())


def wander(rng, t, i):
    """The monitor walks by 0.5 mA over the record."""
    return i + 0.5 * np.cumsum(rng.normal(size=len(i))) / len(i) ** 0.5


def drift(rng, t, i):
    """Under white noise, as large, drifts that last an eighth of the record."""
    kept = math.exp(-8 / len(i))
    new = rng.normal(size=len(i)) * np.append(1.0, np.full(len(i) - 1, (1 - kept**2) ** 0.5))
    return i + 0.02 * (lfilter([1.0], [1.0, -kept], new) + rng.normal(size=len(i)))


def offset(rng, t, i):
    return i + 2.0


def gain_drift(rng, t, i):
    return i * (1 + 0.005 * t / t[-1])


GOOD: dict[str, Callable[[np.random.Generator], Decay]] = {
    "6 h, 400 readings": decay,
    "6 h, errors in the file": partial(decay, stated=1.0),
    "27 readings": partial(decay, n=27, noise=0.02),
    "10 000 readings": partial(decay, n=10_000, noise=0.05),
    "gas alone": partial(decay, a=1e-10, b=2e-5),
    "Touschek alone": partial(decay, i0=500.0, a=4e-8, b=1e-8),
    "500 mA, 8 h": partial(decay, i0=500.0, a=4e-8, b=2e-6, span=8 * HOUR, noise=0.02),
    "half a lifetime": partial(decay, span=3 * HOUR, noise=0.005),
    "four lifetimes": partial(decay, span=60 * HOUR),
    "a minute, lifetime alone": partial(decay, span=60.0, n=120, noise=1e-3),
    "5 mA in a small ring": partial(decay, i0=5.0, a=1e-5, b=1e-4, span=HOUR, noise=1e-3),
    "neighbours correlated by 0.6": partial(decay, memory=0.6),
    "neighbours correlated by 0.9": partial(decay, memory=0.9, n=2000),
}

TRAPS: dict[str, Callable[[np.random.Generator], Decay]] = {
    "no decay, noise": partial(decay, a=0.0, b=0.0),
    "no decay, noise correlated by 0.95": partial(decay, a=0.0, b=0.0, memory=0.95),
    "a minute with 50 µA of noise": partial(decay, span=60.0, n=120, noise=0.05),
    "ten minutes": partial(decay, span=600.0, n=200, noise=0.01),
    "noise correlated by 0.98": partial(decay, memory=0.98, noise=0.05),
    "noise correlated by 0.95, errors in the file": partial(
        decay, memory=0.95, noise=0.05, stated=1.0
    ),
    "errors a third of the noise": partial(decay, noise=0.05, stated=1 / 3),
    "vacuum gets better after the fill": partial(decay, law=pump_down, know="a"),
    "vacuum gets worse": partial(decay, law=rising, know="a"),
    "bunches lengthen with current": partial(
        decay, law=lengthened, know="b", span=24 * HOUR, noise=0.005
    ),
    "RF voltage changed, not logged": partial(decay, law=voltage, know="b"),
    "three bursts of gas": partial(decay, law=bursts, know="a"),
    "a refill of 0.5 mA": partial(stepped, change=0.5),
    "a loss of 2 mA": partial(stepped, change=-2.0),
    "one reading in a hundred is anything": partial(decay, spoil=spikes),
    "one reading in a hundred is zero": partial(decay, spoil=zeros),
    "heavy tails": partial(decay, spoil=tails),
    "injection at the head": partial(decay, spoil=ramp),
    "dumped before the end": partial(decay, spoil=dumped),
    "each reading ten times": partial(decay, noise=0.05, spoil=stale),
    "steps of 2 mA": partial(decay, noise=0.001, spoil=coarse),
    "monitor ends at 95 %": partial(decay, spoil=clipped),
    "monitor walks by 0.5 mA": partial(decay, spoil=wander),
    "monitor drifts under white noise": partial(decay, noise=0.001, spoil=drift),
}

HIDDEN: dict[str, tuple[Callable[[np.random.Generator], Decay], str, float]] = {
    "monitor 2 mA too high": (partial(decay, spoil=offset), "too much", 20.0),
    "monitor's gain drifts by 0.5 %": (partial(decay, spoil=gain_drift), "drifts", 100.0),
    "bunches lengthen, a third of a lifetime": (
        partial(decay, law=lengthened, know="b"), "I^-0.1", 3.0,
    ),
    "time in minutes, said to be seconds": (
        partial(decay, a=5e-8 / 60, b=5e-6 / 60, span=360 * HOUR), "", 0.0,
    ),
}  # fmt: skip
