"""A machine file of the simulated injector; magnet, screen and guard without a control system."""

from __future__ import annotations

from contextlib import asynccontextmanager

import numpy as np

from beamfit.io.machine import read_scan_machine
from beamfit.live.devices import Connected, NoSizesError, Shots
from tests.live.faulty import LINE, MACHINE


def written(folder, scheme="", more="", **changed):
    """The machine's files, with some lines changed."""
    text = MACHINE.format(scheme=scheme, more=more)
    for old, new in changed.items():
        text = text.replace(*new) if isinstance(new, tuple) else text.replace(old, new)
    (folder / "line.toml").write_text(LINE)
    path = folder / "machine.toml"
    path.write_text(text)
    return path


class Simulated:
    """Magnet, screen and guard in one: sizes with a waist at 1 T/m, in x alone.

    ``dark`` is a range of settings at which there is nothing on the screen, ``lossy`` one at which
    beam is lost.
    """

    def __init__(self, dark=(9.0, 9.0), lossy=(9.0, 9.0)):
        self.setting, self.puts, self.rng = -2.0, [], np.random.default_rng(3)
        self.dark, self.lossy, self.looks = dark, lossy, 0

    async def put(self, value):
        self.puts.append(value)
        self.setting = value

    async def get(self):
        return self.setting

    async def settled(self, value):
        return self.setting

    async def shots(self):
        if self.dark[0] < self.setting < self.dark[1]:
            raise NoSizesError("no spot", "one")
        size = np.sqrt((40e-6) ** 2 + (90e-6 * (self.setting - 1.0)) ** 2)
        return Shots({"x": size * (1 + 0.02 * self.rng.standard_normal(5))}, 1.7e9)

    @asynccontextmanager
    async def followed(self, value=None):
        async def left(time):
            return await self.amiss() if value is None else ""

        yield left

    async def amiss(self):
        self.looks += 1
        return "beam loss" if self.lossy[0] < self.setting < self.lossy[1] else ""


def connected(folder, device, **changed):
    """The machine with a simulated device in the place of everything."""
    machine = read_scan_machine(written(folder, y=('y = "SIM:SCREEN:Y"\n', ""), **changed))
    return Connected({"Q1": device}, device, device, machine)
