"""Scans that choose their settings: what they measure, where they stop, that all is put back."""

import asyncio
import json
import re
from contextlib import asynccontextmanager
from dataclasses import replace

import numpy as np
import pytest

import beamfit
from beamfit.cli import cli
from beamfit.cli.scan import _ProgressLines
from beamfit.errors import InputError
from beamfit.io.line import build_line, read_inputs
from beamfit.io.machine import Guard, read_scan_machine
from beamfit.live import devices
from beamfit.live.aims import EmittanceAim, Next, doubt, first_settings, fit_of, sharp
from beamfit.live.channel import LostError, PvReading, SilentError
from beamfit.live.devices import (
    BeamGuard,
    Connected,
    NotSettledError,
    Shots,
    Supply,
    rms_of,
)
from beamfit.live.points import MeasuredPoint, scan_text
from beamfit.live.restore import Journal, NotRestoredError, alone_with, reach, read_journal, restore
from beamfit.live.scan import scan
from tests.live.faulty import LINE, Injector
from tests.live.simulated import Simulated, connected, written
from tests.live.struck import struck


def scanned(at, folder, **told):
    line = build_line(at.machine.lattice)
    return asyncio.run(scan(at, line, folder / "a.journal", **told))


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """A scan to 3 %, all it wrote, and the device."""
    folder, device, texts = tmp_path_factory.mktemp("scan"), Simulated(), []
    at = connected(folder, device)
    at = at._replace(machine=replace(at.machine, goal=0.03, points=20))
    keep = lambda points, before: texts.append(scan_text(points, at.machine, before))  # noqa: E731
    return scanned(at, folder, keep=keep), texts, device, at, folder


def test_a_scan_stops_at_its_goal_and_restores(done):
    found, _, device, at, folder = done
    assert found.reason == "the goal of 3 % is reached"
    assert 6 <= len(found.points) < 15
    assert sharp(found.fit, found.points, 0.03)
    assert found.doubt == ""
    assert device.setting == device.puts[-1] == -2.0
    assert not (folder / "a.journal").exists()
    # Only the fit before the last point was not good enough.
    before = found.points[:-1]
    assert not sharp(fit_of(before, at.machine, found.fit.line), before, 0.03)


def test_a_magnet_is_of_one_scan_whatever_file_names_it(tmp_path):
    device = Simulated()
    at = connected(tmp_path, device)
    [magnet] = at.machine.magnets
    others = [replace(magnet, name="other", set=f"pva://{magnet.set}")]
    with (
        alone_with(tmp_path / "other.journal", others),
        pytest.raises(InputError, match=f"magnet 'Q1' .{magnet.set}., which another scan has"),
    ):
        scanned(at, tmp_path)
    assert device.puts == []
    with alone_with(tmp_path / "a.journal", others):
        pass  # both locks are free again


def test_the_file_is_an_ordinary_scan_with_the_same_fit(done):
    found, texts, _, at, folder = done
    path = folder / "scan.csv"
    path.write_text(texts[-1])
    assert len(texts) == len(found.points)  # written after every point
    measured, described, _ = read_inputs(str(path), at.machine.lattice)
    fit = beamfit.fit_emittance(measured, build_line(described))
    for ours, theirs in zip(found.fit.planes, fit.planes, strict=True):
        assert theirs.emittance.value == pytest.approx(ours.emittance.value, rel=1e-6)
        assert theirs.emittance.error == pytest.approx(ours.emittance.error, rel=1e-4)
    assert any("before the scan -2 T_per_m" in line for line in measured.provenance)
    assert measured.shots.tolist() == [5] * len(found.points)


def test_no_setting_is_outside_the_limits_or_beyond_what_cannot_be_measured(tmp_path):
    device = Simulated(dark=(-9.0, -3.5))
    at = connected(tmp_path, device)
    found = scanned(at, tmp_path)
    assert all(-5.5 <= value <= 2.5 for value in device.puts)
    below = [value for value in device.puts if value < -3.5]
    assert below == [pytest.approx(-4.7)]  # tried once, and never again
    assert len(found.points) == 7


def test_beam_loss_takes_the_magnet_back_before_going_on(tmp_path):
    device, said = Simulated(lossy=(1.5, 9.0)), []
    at = connected(tmp_path, device)
    found = scanned(at, tmp_path, tell=lambda now: said.append(now.news))
    assert "Paused: beam loss" in said
    assert "Going on" in said
    first = next(i for i, value in enumerate(device.puts) if value > 1.5)
    assert device.puts[first + 1] == -2.0
    assert sum(value > 1.5 for value in device.puts) == 2  # tried twice, then left out
    assert all(point.settings["Q1"] < 1.5 for point in found.points)


class Restless(Simulated):
    """A magnet that leaves a setting during the shots there, the first time or every time."""

    def __init__(self, always=False):
        super().__init__()
        self.restless, self.always = [], always

    @asynccontextmanager
    async def followed(self, value=None):
        leaves = value is not None and value > 0 and (self.always or value not in self.restless)
        self.restless += [value] * leaves

        async def left(time):
            return "Q1 left it" if leaves else ""

        yield left


@pytest.mark.parametrize("always", [False, True])
def test_a_point_during_which_a_magnet_left_is_measured_again_or_dropped_in_words(tmp_path, always):
    device, said = Restless(always), []
    found = scanned(connected(tmp_path, device), tmp_path, tell=lambda now: said.append(now.news))
    assert "Measured again: Q1 left it" in said
    assert any(news.endswith("(Q1 left it)") for news in said) is always
    settings = [point.settings["Q1"] for point in found.points]
    assert (max(settings) > 0) is not always
    assert device.setting == -2.0


class Feed:
    """A variable whose readings are given: some while it is followed, the last when it is asked."""

    name = "FEED"

    def __init__(self, *readings):
        self.readings = [PvReading(value, time) for value, time in readings]

    async def monitor(self):
        for reading in self.readings:
            yield reading
        await asyncio.Event().wait()

    async def get(self):
        return self.readings[-1]


@pytest.mark.parametrize(
    ("readings", "words"),
    [
        ([(1.0, 0.0), (1.005, 5.0)], ""),
        ([(1.0, 0.0), (1.2, 1.0), (1.0, 5.0)], "Q1 left 1 T_per_m, 'SIM:Q1:READ' 1.2"),
        ([(1.0, 0.0), (np.nan, 1.0), (1.0, 5.0)], "Q1 left 1 T_per_m, 'SIM:Q1:READ' nan"),
        ([(1.0, 0.0), (1.0, 3.0)], ""),  # none as new as the last shot: it does not change
    ],
)
def test_a_read_back_is_followed_to_the_last_shot(tmp_path, readings, words):
    [magnet] = read_scan_machine(written(tmp_path)).magnets
    supply = Supply(magnet, Feed((1.0, 0.0)), Feed(*readings))

    async def shots():
        async with supply.followed(1.0) as left:
            return await left(4.0)

    assert asyncio.run(shots()) == words


def test_beam_is_followed_to_the_last_shot_and_a_silent_variable_is_lost(monkeypatch):
    guard = Guard("PRESENT", 0.1, "LOSS", 1.0)
    there, lost = Feed((0.25, 4.0)), Feed((0.1, 0.0), (5.0, 1.0), (0.1, 4.0))

    async def shots(*channels):
        async with BeamGuard(guard, *channels).followed() as left:
            return await left(4.0)

    assert asyncio.run(shots(there, lost)) == "beam loss ('LOSS' reads 5.0)"
    assert asyncio.run(shots(there, None)) == ""
    assert asyncio.run(shots(None, None)) == ""
    monkeypatch.setattr(devices, "FIRST_READING_WAIT", 0.01)
    with pytest.raises(LostError, match="no reading of 'FEED' within"):
        asyncio.run(shots(Feed(), None))


def test_a_variable_that_is_followed_no_more_is_said():
    class Ends(Feed):
        async def monitor(self):
            yield self.readings[0]

    async def shots():
        guard = BeamGuard(Guard("PRESENT", 0.1, None, None), Ends((0.25, 4.0)), None)
        async with guard.followed() as left:
            await asyncio.sleep(0.01)
            return await left(4.0)

    assert asyncio.run(shots()) == "'FEED' is followed no more"


def test_one_outlying_shot_makes_no_mean(done):
    found, _, _, at, folder = done
    last = found.points[-1]
    shots = np.where(np.arange(5) == 2, 3, 1) * last.shots["x"]
    points = [*found.points[:-1], last._replace(shots={"x": shots})]
    path = folder / "outlier.csv"
    path.write_text(scan_text(points, at.machine, {"Q1": 0.0}))
    scan = beamfit.read_quad_scan(path)
    assert 1e6 * scan.shot_size["x"][-1] == pytest.approx(1e6 * points[-1].shots["x"])
    off = fit_of(points, at.machine, found.fit.line).planes[0].emittance
    true = found.fit.planes[0].emittance
    assert abs(off.value - true.value) < 2 * true.error


def test_nothing_to_see_ends_a_scan_with_all_restored(tmp_path):
    device = Simulated(dark=(-9.0, 9.0))
    found = scanned(connected(tmp_path, device), tmp_path)
    assert "no sizes at 3 settings in a row (no spot)" in str(found.problem)
    assert device.setting == -2.0


def test_a_magnet_that_does_not_come_back_is_an_error_and_stays_in_the_journal(tmp_path):
    class Stiff(Simulated):
        async def settled(self, value):
            if len(self.puts) > 2 and value == -2.0:
                (tmp_path / "a.journal").unlink(missing_ok=True)  # and somebody removes it
                raise NotSettledError("Q1 set to -2, read back 0", "the same")
            return value

    with pytest.raises(NotRestoredError, match=r"Q1 -2 T_per_m not seen to be restored \(Q1 set"):
        scanned(connected(tmp_path, Stiff()), tmp_path)
    journal = read_journal(tmp_path / "a.journal")
    assert [(m.name, value) for m, value in journal.before] == [("Q1", -2.0)]
    with pytest.raises(InputError, match=r"has not restored; expected beamfit scan --recover"):
        scanned(connected(tmp_path, Simulated()), tmp_path)


@pytest.mark.parametrize("setting", [3.0, np.nan])
def test_a_magnet_that_could_not_be_put_back_is_not_moved(tmp_path, setting):
    device = Simulated()
    device.setting = setting
    with pytest.raises(InputError, match=r"a setting of (3|nan) for Q1; expected within its"):
        scanned(connected(tmp_path, device), tmp_path)
    assert device.puts == []
    assert not (tmp_path / "a.journal").exists()


class Breaks(Simulated):
    """A magnet whose library raises errors of its own, some times."""

    def __init__(self, times):
        super().__init__()
        self.times = times

    async def put(self, value):
        self.times -= 1
        if self.times >= 0:
            raise RuntimeError("connection \x1b lost")
        await super().put(value)


@pytest.mark.parametrize("times", [1, 100])
def test_an_error_of_a_library_keeps_no_magnet_from_being_restored(tmp_path, times):
    [magnet] = read_scan_machine(written(tmp_path)).magnets
    other = replace(magnet, name="Q2", set="SIM:Q2:SET")
    devices = {"Q1": Breaks(times), "Q2": Simulated()}
    log = Journal(tmp_path / "a.journal", "m", ((magnet, -1.0), (other, 0.5)), patience=0.1)
    log.write()
    if times > 1:
        said = r"^Q1 -1 T_per_m not seen to be restored \(RuntimeError: connection \\x1b lost\);"
        with pytest.raises(NotRestoredError, match=said):
            asyncio.run(restore(log, devices))
    else:
        asyncio.run(restore(log, devices))
        assert devices["Q1"].setting == -1.0
    assert devices["Q2"].setting == 0.5
    assert log.path.exists() == (times > 1)


DAMAGE = [
    {"magnets": []},  # nothing to restore is not "restored"
    {"tolerance": np.inf},  # would call any read-back restored
    {"settle": np.nan},  # would wait for good
    {"low": -np.inf},
    {"set": 5},
    {"patience": np.nan},
    {"setting": 9.0},  # which nothing would ever write
]


@pytest.mark.parametrize("damage", DAMAGE, ids=lambda damage: next(iter(damage)))
def test_a_journal_that_was_changed_restores_nothing(tmp_path, damage):
    path = tmp_path / "a.journal"
    Journal(path, "m", ((read_scan_machine(written(tmp_path)).magnets[0], -1.0),)).write()
    [(magnet, _)] = read_journal(path).before
    assert magnet.tolerance == 0.01
    said = json.loads(path.read_text())
    (said if damage.keys() <= said.keys() else said["magnets"][0]).update(damage)
    path.write_text(json.dumps(said))
    with pytest.raises(InputError, match="a journal that was changed or cut; expected it as the"):
        read_journal(path)


def test_a_dry_run_recovers_nothing(tmp_path):
    path = tmp_path / "a.journal"
    Journal(path, "m", ((read_scan_machine(written(tmp_path)).magnets[0], -1.0),)).write()
    with pytest.raises(InputError, match="expected --recover JOURNAL alone"):
        cli.main(["scan", "--recover", str(path), "--dry-run"], standalone_mode=False)
    assert path.exists()


def test_a_camera_that_is_stuck_ends_the_scan(tmp_path):
    class Stuck(Simulated):
        async def shots(self):
            found = await super().shots()
            if len(self.puts) > 5:  # new time stamps, the same picture
                found = found._replace(sizes={"x": np.full(5, self.last)})
            self.last = found.sizes["x"][-1]
            return found

    said = []
    found = scanned(connected(tmp_path, Stuck()), tmp_path, tell=lambda now: said.append(now.news))
    assert len(found.points) == 5
    assert "no sizes at 3 settings in a row (x as before the magnets moved" in str(found.problem)
    assert sum(news.startswith("Left out") for news in said) == 3


def test_a_reader_that_goes_ends_no_scan(monkeypatch, capsys):
    class Gone:
        encoding, errors = "utf-8", "strict"

        def write(self, text):
            raise BrokenPipeError

        flush = write

    say = _ProgressLines(err=False)
    say("one")
    monkeypatch.setattr("sys.stdout", Gone())
    say("two")
    monkeypatch.setattr("sys.stderr", Gone())
    say("three")
    monkeypatch.undo()
    assert capsys.readouterr() == ("one\n", "two\n")


def test_odd_names_leave_the_file_a_scan(done):
    found, _, _, at, folder = done
    odd = 'Q,"1'
    machine = replace(
        at.machine, name="a\nQ1_A,size_x_um\x1b[2J",
        magnets=(replace(at.machine.magnets[0], name=odd),),
    )  # fmt: skip
    points = [p._replace(settings={odd: p.settings["Q1"]}) for p in found.points]
    path = folder / "odd.csv"
    path.write_text(scan_text(points, machine, {odd: 0.0}))
    scan = beamfit.read_quad_scan(path)
    assert list(scan.settings) == [odd]
    assert scan.settings[odd] == pytest.approx([p.settings["Q1"] for p in found.points])
    assert "\x1b" not in path.read_text()


def test_whatever_is_raised_all_is_restored(tmp_path):
    class Breaking(Simulated):
        async def shots(self):
            if len(self.puts) == 3:
                raise ZeroDivisionError
            return await super().shots()

    device = Breaking()
    found = scanned(connected(tmp_path, device), tmp_path)
    assert isinstance(found.problem, ZeroDivisionError)
    assert device.setting == -2.0


def test_who_cancels_a_scan_finds_all_restored(tmp_path):
    device = Simulated()
    at = connected(tmp_path, device)
    line = build_line(at.machine.lattice)

    tasks = []

    async def cancelled():
        tell = lambda now: tasks[0].cancel() if now.measured else None  # noqa: E731
        tasks.append(asyncio.ensure_future(scan(at, line, tmp_path / "a.journal", tell=tell)))
        with pytest.raises(asyncio.CancelledError):
            await tasks[0]

    asyncio.run(cancelled())
    assert device.setting == -2.0
    assert not (tmp_path / "a.journal").exists()


def test_who_cancels_while_all_is_restored_waits_for_that(tmp_path):
    class Slow(Simulated):
        async def put(self, value):
            if len(self.puts) > 2 and value == -2.0:
                for _ in range(3):
                    tasks[0].cancel()
                    await asyncio.sleep(0)
            await super().put(value)

    device, tasks = Slow(), []
    at = connected(tmp_path, device)
    at = at._replace(machine=replace(at.machine, points=3, first=(-1.0, 0.0, 1.0)))
    line = build_line(at.machine.lattice)

    async def cancelled():
        tasks.append(asyncio.ensure_future(scan(at, line, tmp_path / "a.journal")))
        with pytest.raises(asyncio.CancelledError):
            await tasks[0]

    asyncio.run(cancelled())
    assert device.setting == -2.0
    assert not (tmp_path / "a.journal").exists()


@pytest.mark.parametrize(
    ("side", "puts"), [("either", [0.0]), ("below", [-0.4, 0.0]), ("above", [0.4, 0.0])]
)
def test_an_undefined_set_point_is_put_back_from_its_side(tmp_path, side, puts):
    class Undefined(Simulated):
        async def get(self):
            raise LostError("'Q1' reads 0.0 (severity 3)", "a number without an INVALID alarm")

    machine = read_scan_machine(written(tmp_path, more=f'approach = "{side}"\napproach_by = 0.4'))
    journal = Journal(tmp_path / "a.journal", "m", ((machine.magnets[0], 0.0),), patience=1e-9)
    journal.write()
    device = Undefined()
    asyncio.run(restore(journal, {"Q1": device}))
    assert device.puts == puts
    assert not journal.path.exists()
    with pytest.raises(LostError):  # a scan moves nothing from where it does not know it to be
        asyncio.run(reach(machine.magnets[0], device, 1.0))
    assert device.puts == puts


@pytest.mark.parametrize(("side", "passed"), [("below", -0.4), ("above", None)])
def test_a_setting_is_reached_from_its_side(tmp_path, side, passed):
    text = f'approach = "{side}"\napproach_by = 0.4'
    machine = read_scan_machine(written(tmp_path, more=text))
    device = Simulated()
    device.setting = 1.0
    asyncio.run(reach(machine.magnets[0], device, 0.0))
    assert device.puts == ([0.0] if passed is None else [passed, 0.0])
    with pytest.raises(InputError, match="expected within its limits"):
        asyncio.run(reach(machine.magnets[0], device, 2.6))
    assert device.puts[-1] == 0.0


@pytest.mark.parametrize(("side", "low", "high"), [("below", -5.1, 2.5), ("above", -5.5, 2.1)])
def test_no_setting_is_chosen_that_cannot_be_passed(tmp_path, side, low, high):
    text = f'approach = "{side}"\napproach_by = 0.4'
    machine = read_scan_machine(written(tmp_path, more=text))
    assert machine.magnets[0].span == pytest.approx((low, high))
    first = first_settings(machine)
    assert (first[0] - low, high - first[-1]) == pytest.approx([0.1 * (high - low)] * 2)
    point = MeasuredPoint({"Q1": low + 5.0}, {"x": np.ones(3) * 1e-4}, 0.0)
    gap = EmittanceAim(machine, None).next([point] * 4, None, (), {"Q1": 0.0})
    assert gap.settings["Q1"] == pytest.approx(low + 2.5)


def test_a_setting_that_was_left_is_reached_again_from_its_side(tmp_path):
    at = connected(tmp_path, device := Restless(), more='approach = "below"\napproach_by = 0.4')
    scanned(at, tmp_path)
    again = next(i for i, value in enumerate(device.puts) if value in device.restless)
    value = device.puts[again]
    assert device.puts[again + 1 : again + 3] == [pytest.approx(value - 0.4), value]


def test_the_first_settings_are_those_of_the_file(tmp_path):
    path = written(tmp_path, points=("points = 7", "points = 7\nfirst = [0.5, -1.5]"))
    machine = read_scan_machine(path)
    point = MeasuredPoint({"Q1": 0.5}, {"x": np.ones(3) * 1e-4}, 0.0)
    aim = EmittanceAim(machine, None)
    assert aim.next([point], None, (), {"Q1": 0.0}).settings == {"Q1": -1.5}
    gap = aim.next([point] * 2, None, (), {"Q1": 0.0})
    assert isinstance(gap, Next)
    assert gap.settings["Q1"] == pytest.approx(-2.5)  # between -5.5 and 0.5


def points_of(line, settings, shots=5, seed=4):
    """What scans of a line would measure with 2 % of noise, SIMULATED by its own matrices."""
    rng, found = np.random.default_rng(seed), []
    for setting in settings:
        matrix = line.matrix(setting)
        r11, r12 = np.asarray(matrix.x)[0, :2]
        size = np.sqrt(2e-9 * (8.0 * r11**2 - 2.0 * r11 * r12 + 0.25 * r12**2))
        sizes = {"x": float(size) * (1 + 0.02 * rng.standard_normal(shots))}
        found.append(MeasuredPoint(dict(setting), sizes, 0.0))
    return found


def two_magnets(folder, drift):
    """A machine of two quadrupoles, the drift behind them as long as is said."""
    path = written(folder, y=('y = "SIM:SCREEN:Y"\n', ""))
    lattice, text = folder / "line.toml", path.read_text()
    element = '[[element]]\ntype = "quadrupole"\nname = "Q1"'
    second = f'[[element]]\ntype = "drift"\nlength_m = 1.0\n{element}\n'.replace("Q1", "Q2")
    second += "length_m = 0.108\ngradient_T_per_m = 0.0\n"
    place = '[[element]]\ntype = "drift"\nname = "D1"'
    lattice.write_text(LINE.replace(place, second + place).replace("2.2094", str(drift)))
    magnet = text[text.index("[[magnet]]") : text.index("[screen]")]
    path.write_text(text.replace("[screen]", magnet.replace("Q1", "Q2") + "[screen]"))
    return read_scan_machine(path)


def test_each_magnet_is_moved_and_a_line_that_is_wrong_is_doubted(tmp_path):
    machine = two_magnets(tmp_path, 2.2)
    line = build_line(machine.lattice)
    aim, before = EmittanceAim(machine, line), {"Q1": -1.0, "Q2": 0.5}
    settings = [before | {"Q1": value} for value in (-5.0, -3.0, -1.0, 1.0)]
    for _ in range(3):  # the second magnet, which no setting has moved yet
        points = points_of(line, settings)
        assert aim.barely_moved(points) == ["Q2"]
        chosen = aim.next(points, aim.fit(points), (), before)
        assert chosen.settings["Q2"] != before["Q2"]
        settings.append(chosen.settings)
    points = points_of(line, settings)
    assert aim.barely_moved(points) == []
    assert aim.doubt(points, aim.fit(points)) == ""
    points = points_of(build_line(two_magnets(tmp_path, 3.0).lattice), settings)
    said = aim.doubt(points, aim.fit(points))
    assert re.fullmatch(
        r"The sizes miss this line .* \(χ² \d+ with 4 degrees .*: is it right\?", said
    )
    assert doubt(None, []) == ""


def test_three_shots_of_a_setting_that_happen_to_agree_are_no_doubt_of_the_line(tmp_path):
    machine = read_scan_machine(written(tmp_path, y=('y = "SIM:SCREEN:Y"\n', "")))
    line, settings = build_line(machine.lattice), [{"Q1": v} for v in np.linspace(-4.7, 1.7, 7)]
    for seed in (10, 29, 2168):  # χ² 97 to 137 with 4 degrees of freedom by the errors of the fit
        points = points_of(line, settings, shots=3, seed=seed)
        assert doubt(fit_of(points, machine, line), points) == ""


class TwoMagnets(Simulated):
    """One of two magnets, and a screen behind them by the matrices of a line."""

    def __init__(self, name, at, line):
        super().__init__()
        self.name, self.at, self.line = name, at, line

    async def put(self, value):
        self.at[self.name] = value

    async def get(self):
        return self.at[self.name]

    async def settled(self, value):
        return self.at[self.name]

    async def shots(self):
        [point] = points_of(self.line, [dict(self.at)])
        scatter = 1 + 0.02 * self.rng.standard_normal(5)
        return Shots({"x": point.shots["x"].mean() * scatter}, 1.7e9)


@pytest.mark.parametrize("factor", [1.0, 4 / 3, 2 / 3])
def test_a_drift_between_two_magnets_a_third_off_is_said(tmp_path, factor):
    machine = replace(two_magnets(tmp_path, 2.2), points=12, goal=0.05)
    line = build_line(machine.lattice)
    [longer, shorter] = EmittanceAim(machine, line).wrong_lines
    assert longer.words == "the drift from Q1 to Q2 times 1.33"
    assert float(longer.line.length) == pytest.approx(float(line.length) + 1 / 3)
    assert float(shorter.line.length) == pytest.approx(float(line.length) - 1 / 3)
    at = {"Q1": -2.0, "Q2": 1.0}
    true = {1.0: line, 4 / 3: longer.line, 2 / 3: shorter.line}[factor]
    magnets = {name: TwoMagnets(name, at, true) for name in at}
    here = Connected(magnets, *[magnets["Q1"]] * 2, machine)
    found = asyncio.run(scan(here, line, tmp_path / "journal"))
    assert bool(found.doubt) == (factor != 1.0)
    if factor == 1.0:
        assert found.reason.startswith("the goal")
        assert EmittanceAim(machine, line).line_test(found.points, found.fit, at) is None


def test_the_setting_that_tells_a_wrong_drift_moves_what_stood_still(tmp_path):
    machine = two_magnets(tmp_path, 2.2)
    line, before = build_line(machine.lattice), {"Q1": -1.0, "Q2": 0.5}
    points = points_of(line, [before | {"Q1": value} for value in (-5.0, -3.5, -2.0, -0.5, 1.0)])
    aim = EmittanceAim(machine, line)
    told = aim.line_test(points, aim.fit(points), before)
    assert "the drift from Q1 to Q2 times" in told.why
    assert told.settings["Q2"] != before["Q2"]
    there, elsewhere = (
        [*points, *points_of(aim.wrong_lines[0].line, [told.settings | more] * 2)]
        for more in ({}, before)
    )
    assert aim.doubt(there, aim.fit(there))
    assert not aim.doubt(elsewhere, aim.fit(elsewhere))


def test_one_magnet_has_no_distance_to_another(tmp_path):
    machine = connected(tmp_path, Simulated()).machine
    assert EmittanceAim(machine, build_line(machine.lattice)).wrong_lines == []


def test_a_projection_has_the_size_of_its_gaussian():
    x = np.arange(300.0)
    rng = np.random.default_rng(1)
    spot = rng.poisson(400 * np.exp(-0.5 * ((x - 130.0) / 17.0) ** 2) + 50.0)
    assert rms_of(spot, 5e-6) == pytest.approx(85e-6, rel=0.03)
    assert rms_of(rng.poisson(np.full(300, 50.0)), 5e-6) is None
    assert rms_of(400 * np.exp(-0.5 * ((x - 130.0) / 120.0) ** 2), 5e-6) is None  # too large
    for size in (6.0, 17.0, 40.0):
        whole = 400 * np.exp(-0.5 * ((x - 130.0) / size) ** 2) + 50.0
        assert rms_of(whole, 5e-6) == pytest.approx(5e-6 * size, rel=0.01)
        assert rms_of(rng.poisson(whole), 5e-6) is not None
        assert rms_of(np.minimum(whole, 0.85 * whole.max()), 5e-6) is None  # saturated


SECOND = """[[magnet]]
name = "Q1"
set = "pva://SIM:Q2:SET"
read = "SIM:Q2:READ"
unit = "T/m"
low = -1
high = 1
tolerance = 0.01
settle_s = 0.1
"""
BAD = [
    (("low = -5.5", "low = 3.5"), r"machine.toml:\d+: column 'low': limits 3.5 to 2.5"),
    (('unit = "T/m"', 'unit = "A"'), r"column 'unit': unit 'A'; expected T_per_m, as in the"),
    (("tolerance = 0.01", "tolerance = 2"), r"column 'tolerance': tolerance 2; expected less"),
    (('name = "Q1"', 'name = "Q2"'), r"column 'name': no magnet 'Q2'; expected .*Q1"),
    (("points = 7", "points = 7.5"), r"column 'points': 7.5; expected a whole number"),
    (("points = 7", "points = 7\nfirst = [9]"), r"'first': 9; expected numbers within -5.5 and"),
    (("settle_s", 'approach = "above"\napproach_by = 7.95\nsettle_s'), r"room to scan besides"),
    (("present_above = 0.1", ""), r"present and no present_above; expected both"),
    (('lattice = "line.toml"', ""), r"no lattice; expected lattice = "),
    (("settle_s", "setle_s"), r"column 'setle_s': an unknown key; expected .*settle_s"),
    (('x = "SIM:SCREEN:X"', 'profile_x = "A"'), r"column 'x': sizes and projections; expected"),
    (("[screen]", f"{SECOND}[screen]"), r"a magnet or the variable that sets it twice; expected"),
]


@pytest.mark.parametrize(("change", "said"), BAD)
def test_a_machine_file_is_checked_line_by_line(tmp_path, change, said):
    with pytest.raises(InputError, match=said):
        read_scan_machine(written(tmp_path, change=change))


def test_a_magnet_behind_its_screen_is_refused(tmp_path):
    path = written(tmp_path)
    place = tmp_path / "line.toml"
    screen = '[[element]]\ntype = "screen"\nname = "FIRST"\n'
    place.write_text(place.read_text().replace("[[element]]", f"{screen}[[element]]", 1))
    path.write_text(path.read_text().replace("[screen]", '[screen]\nname = "FIRST"'))
    with pytest.raises(InputError, match="column 'name': Q1 behind the screen FIRST; expected"):
        read_scan_machine(path)


@pytest.fixture(scope="module")
def injector(_ioc, tmp_path_factory):
    one = Injector(_ioc, tmp_path_factory.mktemp("injector"))
    yield one
    one.worker.close()


FULL = r"scan.csv: a place that cannot be written \(File too large\).* all is restored"


@pytest.mark.parametrize(
    ("fault", "status", "said"),
    [
        ("limits", 0, r"The scan ended: (all 7 points|the goal).*x converged"),
        ("SIGTERM", 143, "Restored and read back: Q1.*The scan ended: stopped by SIGTERM"),
        ("SIGKILL", None, "Restored and read back: Q1 .* is removed"),
        ("SIGN", 2, r"not seen to be restored \(Q1 set to .* expected beamfit scan --recover"),
        ("NAN", 2, "no sizes at 3 settings in a row .* all is restored"),
        ("IOC back", 2, "all is restored"),
        ("IOC back undefined", 2, "all is restored"),
        ("SIGKILL, IOC back undefined", None, "Restored and read back: Q1 .* is removed"),
        (
            "disk",
            2,
            r"scan.csv: a place that cannot be written \(File too large\).* all is restored",
        ),
    ],
)
def test_a_scan_of_a_real_ioc_leaves_no_magnet_wrong(ioc, injector, fault, status, said):
    fate = injector.scan(fault, seed=2)
    assert fate.recovered
    assert fate.restored or fate.journal
    assert not fate.outside
    if fate.status != 0 or fault == "limits":  # or else the fault came when all was measured
        assert fate.status == status
        assert re.search(said, fate.said, re.DOTALL), fate.said


def test_no_row_of_a_scan_that_is_struck_lies(ioc, injector):
    # A scan may end before its first point, where it is struck too often.
    far = next(filter(None, (struck(injector, seed)[1] for seed in range(3, 8))))
    assert max(far) < 6


def test_a_dry_run_checks_and_moves_nothing(ioc, injector):
    path = written(injector.folder, scheme="pva://")
    injector.worker.begin("scan", str(path), "--dry-run", "--json")
    status, said = injector.worker.end()
    plan = json.loads(said)["results"][0]["plan"]
    assert status == 0
    assert plan["magnets"][0]["now"] == pytest.approx(injector.value("SIM:Q1:SET"))
    assert plan["amiss"] == ""
    assert ioc.puts("Q1") == []


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("SIM:SCREEN:X", "SIM:NONE"), r"no answer from 'SIM:NONE' within 1 s"),
        (("SIM:Q1:READ", "SIM:SCREEN:X"), r"'SIM:SCREEN:X' in 'um'; expected T_per_m"),
        (("shots = 3", 'shots = 3\nunit = "mm"'), r"unit 'um' of 'SIM:SCREEN:X'; expected mm"),
        (("low = -5.5", "low = 2.0"), r"a setting of -2.5 for Q1; expected within its limits"),
    ],
)
def test_what_does_not_fit_the_machine_is_refused_before_anything_moves(
    ioc, injector, change, said
):
    injector.value("SIM:Q1:SET", -2.5)
    ioc.log.write_text("")
    path = written(injector.folder, change=change)
    injector.worker.begin("scan", str(path), "--save", str(injector.folder / "none.csv"))
    status, found = injector.worker.end()
    assert status == 2
    assert re.search(said, found)
    assert ioc.puts("Q1") == []
    assert not injector.journal.exists()


def test_an_ioc_that_is_not_there_is_lost_and_said(ioc):
    from beamfit.live.channel import open_channel, run

    with pytest.raises(LostError):
        run(open_channel("SIM:NOWHERE", 0.2).put(1.0))


@pytest.mark.parametrize("answers", [True, False])
def test_a_timeout_names_the_supply_or_the_ioc(tmp_path, answers):
    class Waits(Feed):
        async def put(self, value):
            raise SilentError("no answer from 'SIM:Q1:SET' within 1.5 s", "its IOC")

        async def get(self):
            if not answers:
                raise SilentError("no answer from 'SIM:Q1:SET' within 1.5 s", "its IOC")
            return await super().get()

    [magnet] = read_scan_machine(written(tmp_path)).magnets
    said = "expected a supply that is on; its IOC answers" if answers else "'SIM:Q1:SET' within"
    with pytest.raises(NotSettledError if answers else SilentError, match=said):
        asyncio.run(Supply(magnet, Waits((0.0, 1.0)), Feed((0.0, 1.0))).put(1.0))


def test_nothing_is_compiled_between_the_points(tmp_path):
    from jax import monitoring

    compiled, device = [], Simulated()
    at = connected(tmp_path, device)
    at = at._replace(machine=replace(at.machine, goal=1e-4, points=20))

    def heard(event, seconds, **about):
        if "backend_compile" in event:
            compiled.append(event)

    counts = []
    monitoring.register_event_duration_secs_listener(heard)
    try:
        scanned(at, tmp_path, tell=lambda now: counts.append(len(compiled)))
    finally:
        monitoring.unregister_event_duration_listener(heard)
    assert len(counts) > 12
    assert counts[0] == counts[-1]  # all that is compiled is so before anything moves


def test_nothing_is_compiled_between_the_points_of_two_magnets(tmp_path):
    from jax import monitoring

    machine, compiled = replace(two_magnets(tmp_path, 2.2), points=12), []
    line, before = build_line(machine.lattice), {"Q1": -1.0, "Q2": 0.5}
    settings = [before | {"Q1": value} for value in (-5.0, -3.0, -1.0, 1.0)]
    points_of(line, settings)
    aim = EmittanceAim(machine, line)
    aim.warm()

    def heard(event, seconds, **about):
        if "backend_compile" in event:
            compiled.append(event)

    monitoring.register_event_duration_secs_listener(heard)
    try:
        while len(settings) < 9:
            points = points_of(line, settings)
            chosen = aim.next(points, aim.fit(points), (), before)
            if not isinstance(chosen, Next):
                break
            settings.append(chosen.settings)
    finally:
        monitoring.unregister_event_duration_listener(heard)
    assert len(settings) >= 8
    assert compiled == []


def test_sizes_may_be_of_projections(ioc, injector):
    from beamfit.live.channel import run
    from beamfit.live.devices import connect

    change = (
        'x = "SIM:SCREEN:X"\ny = "SIM:SCREEN:Y"',
        'profile_x = "SIM:SCREEN:PROFX"\nprofile_y = "pva://SIM:SCREEN:PROFY"\npixel_um = 12',
    )
    machine = read_scan_machine(written(injector.folder, change=change))
    injector.value("SIM:Q1:SET", -1.0)

    async def look():
        at = await connect(machine)
        return await at.screen.shots()

    shots = run(look())
    for plane, sizes in shots.sizes.items():
        assert sizes.shape == (3,)
        assert sizes.mean() == pytest.approx(ioc_size(plane, -1.0), rel=0.06)


def ioc_size(plane, gradient):
    """By the line, what the simulated injector computes by formulas of its own."""
    from tests.live.truth import BEAM

    line = beamfit.Beamline(
        (beamfit.Quadrupole("Q1", 0.108), beamfit.Drift("D", 2.2094), beamfit.Screen("S")), 135.0
    )
    matrix = line.matrix({"Q1": gradient * 299.792458 / 135.0})
    r11, r12 = (float(v) for v in np.asarray(getattr(matrix, plane))[0, :2])
    emittance, beta, alpha = BEAM[plane]
    squared = r11**2 * beta - 2 * r11 * r12 * alpha + r12**2 * (1 + alpha**2) / beta
    return np.sqrt(emittance * squared)
