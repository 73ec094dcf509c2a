"""A real IOC with a simulated injector and ring: `python -m tests.live.ioc LOG [undefined]`.

SIMULATED. Served by Channel Access and PV Access on the ports of the environment. Every value
written to a magnet is appended to LOG, before anything else is done with it. Faults are variables
(SIM:FAULT:*). With "undefined" set points are so (UDF, INVALID), as of an IOC that was restarted
without autosave. The optics are a thick quadrupole and a drift in numpy, no code of beamfit.
"""

from __future__ import annotations

import asyncio
import os
import sys
import time

import numpy as np
from softioc import asyncio_dispatcher, builder, softioc

from tests.live.truth import BEAM, LIMIT, NOISE, A, B, size

PREFIX, TICK = "SIM", 0.01
RATE, START = 200.0, -2.5  # T/m a second, T/m
SHOT = 0.03  # s between shots
PIXEL, PIXELS = 12.0, 200  # um
MAGNETS = ("Q1", "Q2")
FAULTS = ("STUCK", "DRIFT", "SIGN", "NAN", "STALE", "DEAF", "DARK", "LOSSY", "SLOW")
FAULTS += ("TRIP", "DIM")  # a supply off by so much; a screen that shows sizes of no beam
MONITOR, READ = 0.002, 0.05  # of the ring: noise of the monitor mA, s between readings


class Magnet:
    """A power supply that ramps; its read-back may be at fault, it never is."""

    def __init__(self, name: str, log: str, undefined: bool = False) -> None:
        self.name, self.log, self.true, self.wanted, self.shown = name, log, START, START, START
        self.drifted = 0.0
        how = {"DRVL": -LIMIT, "DRVH": LIMIT, "LOPR": -LIMIT, "HOPR": LIMIT}
        how |= {} if undefined else {"initial_value": START}
        self.set = builder.aOut(
            f"{name}:SET", on_update=self.put, EGU="T/m", PREC=5,
            always_update=True, blocking=True, **how,
        )  # fmt: skip
        self.read = builder.aIn(f"{name}:READ", initial_value=START, EGU="T/m", PREC=5)
        self.truth = builder.aIn(f"{name}:TRUE", initial_value=START, EGU="T/m", PREC=6)

    async def put(self, value: float) -> None:
        with open(self.log, "a") as stream:
            stream.write(f"{time.time():.6f} {self.name} {value!r}\n")
        if not on("DEAF"):
            self.wanted = value
        while abs(self.true - self.wanted) > 1e-9 and not on("SLOW"):
            await asyncio.sleep(TICK)

    def step(self) -> None:
        far = RATE * TICK * (0.01 if on("SLOW") else 1.0)
        wanted = self.wanted + (faults["TRIP"].get() if self is magnets[0] else 0.0)
        self.true += float(np.clip(wanted - self.true, -far, far))
        self.drifted = self.drifted + 0.02 if on("DRIFT") else 0.0
        if not on("STUCK"):
            self.shown = (-1 if on("SIGN") else 1) * self.true + self.drifted
        self.read.set(self.shown + 1e-4 * rng.standard_normal())
        self.truth.set(self.true)


class Ring:
    """A stored beam that decays in simulated time, SPEED seconds of it in one."""

    def __init__(self) -> None:
        self.current = builder.aIn("RING:CURRENT", initial_value=300.0, EGU="mA", PREC=4, TSE=-2)
        self.pressure = builder.aIn("RING:PRESSURE", initial_value=1e-7, EGU="Pa", PREC=10, TSE=-2)
        self.rf = builder.aIn("RING:RF", initial_value=3200.0, EGU="kV", PREC=2, TSE=-2)
        self.beam, self.now = 300.0, time.time()
        self.speed = builder.aOut("RING:SPEED", initial_value=1.0)
        # Factors of a and b that nobody sees, of the pressure, a step of the clock, a silence.
        self.hidden = {
            name: builder.aOut(f"RING:{name}", initial_value=value)
            for name, value in (("A", 1.0), ("B", 1.0), ("P", 1.0), ("CLOCK", 0.0), ("GAP", 0.0))
        }
        self.refill = builder.aOut("RING:REFILL", initial_value=0.0)

    def step(self) -> None:
        a, b, gas, clock, gap = (self.hidden[n].get() for n in ("A", "B", "P", "CLOCK", "GAP"))
        span = READ * self.speed.get()
        self.now += span
        a, b = A * a, B * b * gas
        # The exact solution of dI/dt = -a I² - b I.
        fall = np.exp(-b * span)
        self.beam = self.beam * fall / (1 + a / b * self.beam * (1 - fall))
        if self.beam < self.refill.get():
            self.beam = 300.0
        if gap:
            return
        at = self.now + clock
        self.current.set(self.beam + MONITOR * rng.standard_normal(), timestamp=at)
        self.pressure.set(1e-7 * gas * (1 + 0.002 * rng.standard_normal()), timestamp=at)
        self.rf.set(3200.0, timestamp=at)


def on(fault: str) -> bool:
    return bool(faults[fault].get())


async def each(period: float, *steps) -> None:
    while True:
        for step in steps:
            step()
        await asyncio.sleep(period)


def shots() -> None:
    """One shot: sizes and profiles with one time stamp; the line has the first magnet alone."""
    if on("STALE"):
        return
    now = time.time()
    for plane, record in sizes.items():
        rms = size(plane, magnets[0].true) * (1 + NOISE * rng.standard_normal())
        rms = np.nan if on("NAN") or on("DARK") else 9e-4 if on("DIM") else rms
        rms *= 1.5 if on("LOSSY") else 1.0
        record.set(1e6 * rms, timestamp=now)
        place = PIXEL * (np.arange(PIXELS) - PIXELS / 2) * 1e-6
        counts = 1e3 * np.exp(-0.5 * (place / rms) ** 2) if np.isfinite(rms) else 0 * place
        profiles[plane].set(rng.poisson(counts + 20.0).astype(float), timestamp=now)
    present.set(0.0 if on("DARK") or on("DIM") else 0.25, timestamp=now)
    loss.set(5.0 if on("LOSSY") else 0.1, timestamp=now)


if __name__ == "__main__":
    rng = np.random.default_rng(16)
    dispatcher = asyncio_dispatcher.AsyncioDispatcher()
    builder.SetDeviceName(PREFIX)
    faults = {name: builder.aOut(f"FAULT:{name}", initial_value=0.0) for name in FAULTS}
    magnets = [Magnet(name, *sys.argv[1:]) for name in MAGNETS]
    sizes = {p: builder.aIn(f"SCREEN:{p.upper()}", EGU="um", PREC=3) for p in BEAM}
    profiles = {p: builder.WaveformIn(f"SCREEN:PROF{p.upper()}", length=PIXELS) for p in BEAM}
    present = builder.aIn("BEAM", initial_value=0.25, EGU="nC", PREC=3)
    loss = builder.aIn("LOSS", initial_value=0.1, EGU="V", PREC=3)
    ring = Ring()
    builder.LoadDatabase()
    softioc.iocInit(dispatcher)
    dispatcher(each, func_args=(TICK, *(magnet.step for magnet in magnets)))
    dispatcher(each, func_args=(SHOT, shots))
    dispatcher(each, func_args=(READ, ring.step))
    print("ready", flush=True)
    sys.stdin.read()  # until whoever started it closes the pipe or ends
    os._exit(0)
