"""A tuning at a simulated gun: rows, limits, journal, and that every knob is put back."""

import asyncio
from contextlib import asynccontextmanager

import numpy as np
import pytest

from beamfit.errors import InputError
from beamfit.io.line import build_line
from beamfit.io.machine import read_scan_machine
from beamfit.io.scan import read_tuning_scan
from beamfit.live.aims import TuningAim
from beamfit.live.devices import Connected, Shots
from beamfit.live.points import scan_text
from beamfit.live.scan import scan
from tests.live.faulty import LINE, MACHINE

KNOB = """[[knob]]
name = "phase"
set = "SIM:PHASE:SET"
read = "SIM:PHASE:READ"
unit = "deg"
low = -10.0
high = 10.0
tolerance = 0.05
settle_s = 0.05
"""
BEST, LEAST, GAMMA = 3.0, 0.7e-6, 135.0 / 0.51099895


class Gun:
    """A quadrupole and a phase; the emittance is lowest at 3 degrees."""

    def __init__(self, line, broken=10**6):
        self.at, self.puts, self.line = {"Q1": -2.0, "phase": 0.0}, [], line
        self.rng, self.broken = np.random.default_rng(3), broken

    def device(self, name):
        return Knob(self, name)

    async def shots(self):
        if len(self.puts) > self.broken:
            raise RuntimeError("the camera is gone")
        emittance = LEAST / GAMMA * (1.0 + ((self.at["phase"] - BEST) / 8.0) ** 2)
        r = np.asarray(self.line.matrix({"Q1": self.at["Q1"]}).x)
        sigma = emittance * np.array([[5.0, 1.0], [1.0, 0.4]])
        size = np.sqrt((r[:2, :2] @ sigma @ r[:2, :2].T)[0, 0]) * (1 + 0.01 * self.rng.normal())
        return Shots({"x": size * (1 + 0.01 * self.rng.standard_normal(5))}, 1.7e9)

    async def amiss(self):
        return ""

    @asynccontextmanager
    async def followed(self, value=None):
        async def left(time):
            return ""

        yield left


class Knob:
    def __init__(self, gun, name):
        self.gun, self.name, self.followed = gun, name, gun.followed

    async def put(self, value):
        self.gun.puts.append((self.name, value))
        self.gun.at[self.name] = value

    async def get(self):
        return self.gun.at[self.name]

    async def settled(self, value):
        return self.gun.at[self.name]


def machine_in(folder, **changed):
    (folder / "line.toml").write_text(LINE)
    text = MACHINE.format(scheme="", more="").replace('y = "SIM:SCREEN:Y"\n', "")
    text = text.replace("goal_percent = 0.5\npoints = 7", "goal_percent = 5\npoints = 24")
    text = text.replace("[screen]", KNOB + "[screen]", 1)
    for old, new in changed.items():
        text = text.replace(old, new)
    (folder / "gun.toml").write_text(text)
    return read_scan_machine(folder / "gun.toml")


def tuned(folder, **broken):
    machine = machine_in(folder)
    line = build_line(machine.lattice)
    gun, texts = Gun(line, **broken), []
    at = Connected({n: gun.device(n) for n in ("Q1", "phase")}, gun, gun, machine)
    found = asyncio.run(
        scan(at, line, folder / "a.journal", keep=lambda points, before: texts.append(
            scan_text(points, machine, before)))
    )  # fmt: skip
    return found, gun, texts, machine


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    folder = tmp_path_factory.mktemp("gun")
    return *tuned(folder), folder


def test_a_tuning_finds_the_minimum_within_limits_and_restores_every_knob(done):
    found, gun, _, machine, folder = done
    assert found.problem is None
    assert found.reason == "the best setting is within 5 % of the minimum"
    assert len(found.points) < 24
    assert 1.0 + ((found.fit.settings["phase"] - BEST) / 8.0) ** 2 < 1.05
    spans = {m.name: m.span for m in machine.magnets}
    assert all(spans[name][0] <= value <= spans[name][1] for name, value in gun.puts)
    assert gun.at == {"Q1": -2.0, "phase": 0.0}
    assert not (folder / "a.journal").exists()


def test_its_file_is_a_table_of_tune(done, tmp_path):
    found, _, texts, _, _ = done
    (tmp_path / "t.csv").write_text(texts[-1])
    scan = read_tuning_scan(tmp_path / "t.csv", ["phase"])
    assert len(scan) == len({tuple(p.settings.values()) for p in found.points})
    assert scan.units["phase"] == "knob"


def test_a_fault_puts_every_knob_back(tmp_path):
    found, gun, _, _ = tuned(tmp_path, broken=5)
    assert str(found.problem) == "the camera is gone"
    assert gun.at == {"Q1": -2.0, "phase": 0.0}


def test_nothing_is_chosen_beyond_what_could_not_be_measured(done):
    found, _, _, machine, _ = done
    barred, before = [{"Q1": -2.0, "phase": 8.0}], {"Q1": -2.0, "phase": 0.0}
    aim = TuningAim(machine, build_line(machine.lattice))
    for count in (0, 1, 3):
        chosen = aim.next(found.points[:count], None, barred, before)
        assert chosen.settings["phase"] <= 4.0
    full = aim.next(found.points * 9, None, (), before)
    assert full == "all 24 points are measured"


def test_a_machine_without_knobs_scans_and_has_fewer_points(tmp_path):
    usual = machine_in(tmp_path, **{"points = 24": ""})
    plain = machine_in(tmp_path, **{"points = 24": "", KNOB: ""})
    assert (usual.knobs, usual.points) == (("phase",), 60)
    assert (plain.knobs, plain.points) == ((), 15)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('name = "phase"', 'name = "Q1"', "twice"),
        ("high = 10.0", "high = -20", "limits -10 to -20"),
        ("tolerance = 0.05", "tolerance = 5", "less than a tenth of the range"),
    ],
)
def test_a_wrong_knob_is_refused(tmp_path, old, new, said):
    with pytest.raises(InputError, match=said):
        machine_in(tmp_path, **{old: new})
